"""Which setting `drgs tradeoff` recommends: the fastest within a budget of error, if it is faster than times scatter.

Times are compared in pairs: a setting's over that of `exact` in the same round and view. The interval of the median of
these ratios says how well it is known; `exact` against itself, measured as every other setting, how much equal work
scatters. A setting has a gain if its whole interval lies below 1 and below that of `exact` against itself.
"""

from __future__ import annotations

import math
import statistics

__all__ = ["USES", "interval", "leaders", "recommend"]

USES = {
    "image": ("forward", ("image",)),
    "gradients": ("forward_backward", ("gradient",)),
    "information": ("fisher", ("information",)),
    "everything": ("forward_backward", ("image", "gradient", "information")),
}
"""Use -> the time that counts, and the errors that must be within the budget."""

_SURE = 0.05  # two-sided; of the interval, by the sign test


def interval(ratios: list[float]) -> dict | None:
    """The median and the two order statistics between which it lies with 95 %; fewer than six: all of them.

    Returns:
        `ratio`, `low`, `high` and `rounds`; None of an empty list.
    """
    if not ratios:
        return None
    x, n, k, tail = sorted(ratios), len(ratios), 0, 0.5 ** len(ratios)
    while 2 * (tail + math.comb(n, k + 1) * 0.5**n) <= _SURE:
        k += 1
        tail += math.comb(n, k) * 0.5**n
    return {"ratio": statistics.median(x), "low": x[k], "high": x[-1 - k], "rounds": n}


def leaders(measured: dict, clock: str, budgets) -> list[str]:
    """Names of the rows that are worth timing at full size: the fastest within each budget, and preset `fast`."""
    names = []
    for use, (its, _) in USES.items():
        for budget in budgets if its == clock else ():
            rows = [row for row, _ in _within(measured, use, budget) if row["times"][clock]["ratio"] < 1]
            names += [min(rows, key=lambda row: row["times"][clock]["ratio"])["name"]] if rows else []
    fast = [r["name"] for r in measured["rows"] if r["name"] == "fast" and r["skipped"] is None and r["times"][clock]]
    return list(dict.fromkeys([*fast, *names]))


def recommend(measured: dict, use: str, budgets) -> list[dict]:
    """For each budget the fastest setting with a gain, the most exact one of those as fast, or why there is none.

    Args:
        measured: Of `tradeoff.measure`, and what `tradeoff_full.measure_full` added to its rows under `full`:
            where a clock was read at full size, only that counts. Rows of a reduced resolution and rows that were
            measured on a sample of the rays are no candidates.
        use: One of `USES`.
        budgets: > 0.
    """
    clock, kinds = USES[use]
    scatter = measured["scatter"][clock]
    sure = min(1.0, scatter["low"]) if scatter else 1.0
    picks = []
    for budget in budgets:
        pick = {"use": use, "budget": budget, "clock": clock, "name": None, "gain": False, "reason": None}
        within = _within(measured, use, budget)
        full = any(row["full"].get(clock) for row, _ in within)
        timed = [(row, error, row["full"].get(clock) if full else row["times"][clock]) for row, error in within]
        faster = [(row, error, times) for row, error, times in timed if times and times["high"] < sure]
        exact = next((entry for entry in timed if entry[0] is measured["rows"][0]), None)
        if faster or exact:
            if faster:
                least = min(faster, key=lambda entry: entry[2]["ratio"])
                alike = [entry for entry in faster if entry[2]["low"] <= least[2]["high"]]
                row, error, times = min(alike, key=lambda entry: entry[1])
            else:
                row, error, times = exact
                times = times or row["times"][clock]
                pick["reason"] = "no measurable gain over exact"
            pick |= {"name": row["name"], "kind": row["kind"], "flags": row.get("flags"), "gain": bool(faster)}
            pick |= {"error": error, "full": full, **{k: times[k] for k in ("ratio", "low", "high", "rounds")}}
        else:
            every = _within(measured, use, math.inf)
            if every:
                row, error = min(every, key=lambda entry: entry[1])
                pick["reason"] = f"no setting is within it, the least error is {error:.1e} ({row['name']})"
            else:
                pick["reason"] = f"there is no setting whose {' and '.join(kinds)} error could be measured"
        picks.append(pick)
    return picks


def _within(measured: dict, use: str, budget: float) -> list[tuple[dict, float]]:
    """Candidates whose errors are within the budget, with the largest of them."""
    clock, kinds = USES[use]
    rows = [r for r in measured["rows"] if r["skipped"] is None and r["share"] == 1 and r["by"] == "view"]
    rows = [r for r in rows if all(r["errors"][k] is not None for k in kinds) and r["times"][clock] is not None]
    found = [(row, max(row["errors"][k] for k in kinds)) for row in rows]
    return [(row, error) for row, error in found if error <= budget]
