"""Fewer Gaussians for nearly the same images, for users.

The work is done by `drgs.fitting.pruning`.
"""

from __future__ import annotations

from drgs.fitting.pruning import POWER, ROUNDS, Pruned, Round, Unseen, check_amount, fit_on, prune

__all__ = ["POWER", "ROUNDS", "Pruned", "Round", "Unseen", "check_amount", "fit_on", "prune"]
