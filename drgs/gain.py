"""Information gain of a view, given the information of the known views: criteria of Fisher information.

The public side of `drgs.information.gains` and `drgs.information.criteria`, which say what each is.
"""

from drgs.information.choices import METHODS
from drgs.information.criteria import CRITERIA, ViewCriterion, criterion_named
from drgs.information.gains import (
    BLOCK_LAYOUT,
    Chain,
    Gain,
    block_gain,
    check,
    dense,
    information_gain,
    scorer,
    variances,
)
from drgs.information.prior import Prior, unit_length
from drgs.information.sums import Information

__all__ = [
    "BLOCK_LAYOUT",
    "CRITERIA",
    "METHODS",
    "Chain",
    "Gain",
    "Information",
    "Prior",
    "ViewCriterion",
    "block_gain",
    "check",
    "criterion_named",
    "dense",
    "information_gain",
    "scorer",
    "unit_length",
    "variances",
]
