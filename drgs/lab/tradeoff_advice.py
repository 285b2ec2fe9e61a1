"""Which setting `drgs tradeoff` recommends, by measured times and errors.

Settings are compared in pairs of times: a setting's over that of `exact` in the same round and view. The interval of
the median of these ratios says how well it is known; `exact` against itself, measured as every other setting, says how
much equal work scatters. A setting has a gain if its whole interval lies below 1 and below that of `exact` against
itself; recommended is the fastest one within a budget of error that has a gain.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from drgs.lab.tradeoff_rows import Measured, TradeoffRow

USES = {
    "image": ("forward", ("image",)),
    "gradients": ("forward_backward", ("gradient",)),
    "information": ("fisher", ("information",)),
    "everything": ("forward_backward", ("image", "gradient", "information")),
}
"""Use -> the time that counts, and the errors that must be within the budget."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """The recommended setting for a use and a budget.

    Attributes:
        use: One of `USES`.
        budget: Largest error that is allowed.
        clock: Name of the time that counts.
        name: Name of the row that is chosen; None where no setting is within the budget, and then all that follows
            `reason` is None.
        gain: Whether it is faster than `exact`.
        reason: Why there is no setting, or no gain.
        kind, flags: The row's fields of these names.
        error: The row's largest error that counts.
        full: Whether its time is of views as large as they are drawn.
        ratio, low, high, rounds: Its times over exact's, as an `Interval`.
    """

    use: str
    budget: float
    clock: str
    name: str | None = None
    gain: bool = False
    reason: str | None = None
    kind: str | None = None
    flags: str | None = None
    error: float | None = None
    full: bool | None = None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    rounds: int | None = None

    def to_json(self) -> dict[str, Any]:
        """The advice as tradeoff.json holds it: what there is no setting for has no numbers."""
        value = dataclasses.asdict(self)
        return value if self.name else {k: value[k] for k in ("use", "budget", "clock", "name", "gain", "reason")}


def leaders(measured: Measured, clock: str, budgets: Sequence[float]) -> list[str]:
    """Names of the rows that are worth timing at full size: the fastest within each budget, and preset `fast`."""
    names = []
    for use, (timed, _) in USES.items():
        for budget in budgets if timed == clock else ():
            rows = [row for row, _ in _within(measured, use, budget) if row.times[clock].ratio < 1]
            names += [min(rows, key=lambda row: row.times[clock].ratio).name] if rows else []
    fast = [row.name for row in measured.rows if row.name == "fast" and row.skipped is None and row.times[clock]]
    return list(dict.fromkeys([*fast, *names]))


def recommend(measured: Measured, use: str, budgets: Sequence[float]) -> list[Advice]:
    """Choose for each budget the fastest setting with a gain, the most exact one of those as fast, or say why not.

    Args:
        measured: What `measure` returned, and what `measure_full` added to its rows under
            `full`: where a clock was read at full size, only that counts. Rows of a reduced resolution and rows that
            were measured on a sample of the rays are no candidates.
        use: One of `USES`.
        budgets: Largest errors that are allowed, each > 0.
    """
    clock = USES[use][0]
    scatter = measured.scatter[clock]
    sure = min(1.0, scatter.low) if scatter else 1.0
    picks = []
    for budget in budgets:
        within = _within(measured, use, budget)
        full = any(row.full.get(clock) for row, _ in within)
        timed = [(row, error, row.full.get(clock) if full else row.times[clock]) for row, error in within]
        faster = [(row, error, times) for row, error, times in timed if times and times.high < sure]
        exact = next((entry for entry in timed if entry[0] is measured.truth), None)
        reason = None
        if faster:
            least = min(faster, key=lambda entry: entry[2].ratio)
            alike = [entry for entry in faster if entry[2].low <= least[2].high]
            row, error, times = min(alike, key=lambda entry: entry[1])
        elif exact:
            row, error, times = exact
            times = times or row.times[clock]
            reason = "no measurable gain over exact"
        else:
            picks.append(Advice(use=use, budget=budget, clock=clock, reason=_why_none(measured, use)))
            continue
        numbers = {name: getattr(times, name) for name in ("ratio", "low", "high", "rounds")}
        fields = {"name": row.name, "kind": row.kind, "flags": row.flags, "gain": bool(faster), "full": full}
        picks.append(Advice(use=use, budget=budget, clock=clock, reason=reason, error=error, **fields, **numbers))
    return picks


def _why_none(measured: Measured, use: str) -> str:
    """Why a budget has no setting."""
    every = _within(measured, use, math.inf)
    if not every:
        return f"there is no setting whose {' and '.join(USES[use][1])} error could be measured"
    row, error = min(every, key=lambda entry: entry[1])
    return f"no setting is within it, the least error is {error:.1e} ({row.name})"


def _within(measured: Measured, use: str, budget: float) -> list[tuple[TradeoffRow, float]]:
    """Candidates whose errors are within the budget, with the largest of them."""
    clock, kinds = USES[use]
    rows = [row for row in measured.rows if row.skipped is None and row.share == 1 and row.by == "view"]
    errors = [(row, row.errors.worst(kinds)) for row in rows if row.times[clock] is not None]
    return [(row, error) for row, error in errors if error is not None and error <= budget]
