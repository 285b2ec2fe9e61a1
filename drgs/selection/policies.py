"""Look up a policy by its name, call it, and check the selection that it returns."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from drgs.checks.arguments import kind_of, must_be
from drgs.information.choices import POLICIES, check_named
from drgs.runtime.threads import fewer_torch_threads
from drgs.selection.pool import Pick, Pool, Selection

_INFORMED = ("fisher", "fisherrf", "coverage")
"""Policies that score a camera by the information of its view."""


def choose(policy: str, pool: Pool) -> Selection:
    """The choice of a policy from a pool.

    Raises:
        ValueError: If the pool has what means nothing to the policy, or the policy returns something else than a choice
            of k candidates.
    """
    function = policy_named(policy)
    if policy in POLICIES and policy not in _INFORMED:
        unfit = (("information", pool.information, ""), ("refine", pool.refine, ", which score any camera"))
        for name, field, advice in unfit:
            if field is not None:
                raise ValueError(
                    f"select: {name} must be None with policy {policy}, got some; use {', '.join(_INFORMED)}{advice}"
                )
    check_region(None if pool.region is None else pool.region.text, policy)
    with fewer_torch_threads():
        selection = function(pool)
    _check_selection(f"select: policy {policy}", pool, selection)
    return selection


def check_region(region: str | None, policy: str) -> None:
    """Raise ValueError if there is a region, and the policy does not look at what views show."""
    if region is not None and policy in POLICIES and policy not in _INFORMED:
        raise ValueError(
            f"select: region must be none with policy {policy}, which does not score by what pixels show, got "
            f"{region}; use {', '.join(_INFORMED)}"
        )


def policy_named(name: str) -> Callable[[Pool], Selection]:
    """The policy of a name, or the function that `package.module:function` names.

    Raises:
        ValueError: If there is none.
    """
    check_named("select", POLICIES, name)
    return POLICIES.find("--policy", name)


def _check_selection(where: str, pool: Pool, selection: Any) -> None:
    """Refuse what is no choice from the pool; its scores become plain numbers."""
    advice = "make picks with pool.pick(index, score)"
    must_be(where, "what it returns", selection, Selection, f"e.g. Selection(picks, scores); {advice}")
    picks = selection.picks
    scores = selection.scores
    count = len(pool.candidates)
    if not isinstance(picks, list | tuple) or any(not isinstance(pick, Pick) for pick in picks):
        raise ValueError(f"{where}: picks must be a list of Pick, got {kind_of(picks)}; {advice}")
    indices = [pick.index for pick in picks]
    possible = all(isinstance(i, int) and 0 <= i < count for i in indices)
    if not possible or len(indices) != pool.k or len(set(indices)) != pool.k:
        raise ValueError(
            f"{where}: picks must be k = {pool.k} different ones of {count} candidates, got indices {indices}; {advice}"
        )
    try:
        plain = scores.detach().cpu() if isinstance(scores, torch.Tensor) else scores
        numbers = np.asarray(plain, dtype=np.float64) if not np.iscomplexobj(plain) else np.empty(0)
    except (TypeError, ValueError, NotImplementedError):  # lists of other lengths, text; a tensor on `meta`
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"{where}: scores must be a finite number for each of {count} candidates, got {kind_of(scores)}; "
            "before the first pick, in their order"
        )
    selection.scores = numbers.tolist()  # plain, as files hold them
    for name, one in (("parts", selection.parts), ("unseen", selection.unseen)):
        if not isinstance(one, list) or len(one) not in (0, count):
            raise ValueError(
                f"{where}: {name} must be a list for each of {count} candidates, or empty, got {kind_of(one)}; "
                "leave them out"
            )
