"""Behind drgs.fisher and drgs.gain: quantities of a view (quantity.py), their sums over views, and their scores."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
