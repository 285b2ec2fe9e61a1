"""A race of policies: who is known to be better or worse than the reference is given no more fits.

The machine's hours go to pairs that are still open [1]. A policy leaves when the interval of its difference from the
reference excludes 0: PSNR, averaged over all numbers of views that were measured, in at least six units. The interval
is looked at after every fit, so it is a wide one, 99 %; and as a policy leaves when its difference happens to look
large, what is then known of it is on average too large. Units that are still to come are for those that stay.

Reference:
    [1] Maron and Moore: Hoeffding races, 1993.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drgs.studies.statistics import FEWEST_UNITS, differences, estimate

__all__ = ["decided", "over_views"]

_SHARE = 0.99
_BY = "psnr"


def decided(rows: Sequence[Mapping[str, Any]], reference: str, protocol: str) -> dict[str, str]:
    """Policies whose difference from the reference is known, and a sentence that says so.

    Args:
        rows: Rows of one study.
        reference: Label of the policy that the others race with.
        protocol: Protocol of the rows that count.
    """
    mine = [over_views(row, _BY) for row in rows if row["protocol"] == protocol]
    found = {}
    for label in dict.fromkeys(row["policy"] for row in mine if row["policy"] != reference):
        values = differences(mine, _BY, label, reference)
        if len(values) < FEWEST_UNITS:
            continue
        effect = estimate(values, share=_SHARE)
        if effect.low <= 0 <= effect.high:
            continue
        found[label] = (
            f"{label} has left after {effect.units} units: {effect.mean:+.2f} dB [{effect.low:+.2f}, "
            f"{effect.high:+.2f}] against {reference}, on average over numbers of views."
        )
    return found


def over_views(row: Mapping[str, Any], metric: str) -> dict[str, Any]:
    """A row with the mean of a metric over all numbers of views at which it was measured, in place of its last one."""
    last = row["metrics"].get(metric)
    values = [x for at in row.get("curve", {}).values() if (x := at.get(metric)) is not None]
    return {**row, "metrics": {metric: None if last is None else float(np.mean([*values, last]))}}
