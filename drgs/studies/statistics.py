"""What a study says: differences of policies within a unit, and intervals over scenes and units.

A unit is (scene, split, initial views): what a policy is given before it picks; of what several cameras film at once
it is (scene, camera held out), for all others are known at the first time. Fits of one unit that differ by the
seed alone are averaged first. Two policies are compared by their differences within units; the mean of the scenes'
means is the estimate, so that a scene with more units does not count more, and its 95 % interval comes from a bootstrap
that draws scenes first and then units of each.

How often that interval holds the true mean, in 1,500 to 3,000 simulated studies each of normal differences (`coverage`
has the others): of 3 scenes with 3, 3 and 6 units in 94 % where scenes do not differ, in 89 % and 82 % where their
means spread by half as much, and as much, as units of one scene; of 8 scenes with 5 units each in 98, 95 and 92 %; of 3
scenes with one unit each, or 3 units of one scene, in 75 %. What is detectable is therefore said of a t test, which
keeps its 5 % of false alarms however few scenes there are.

A race of policies [1]: the machine's hours go to pairs that are still open. A policy leaves when the interval of its
difference from the reference excludes 0: PSNR, averaged over all numbers of views that were measured, in at least six
units. The interval is computed after every fit, so it is a wide one, 99 %; and as a policy leaves when its difference
happens to look large, what is then known of it is on average too large. Units that are still to come are for those that
stay.

Reference:
    [1] Maron and Moore: Hoeffding races, 1993.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

Unit = tuple[str, tuple[int, int], tuple[str, ...]]
"""Scene, split, and what was given before the first pick."""

FEWEST_UNITS = 6
"""Units from which on there is a verdict: five that all agree do so by chance in one of 16 studies (two-sided)."""

_BOOTSTRAP_DRAWS = 10_000  # of the bootstrap: the ends of an interval are then known to 0.5 % of its draws
# Count -> share of 95 % intervals that hold the true mean: of scenes with one unit, or of units of one scene; of scenes
# with 3 to 5 units that differ as much as their units do, from 8 on half as much.
_COVERAGE = {2: 0.50, 3: 0.75, 4: 0.79, 5: 0.83, 6: 0.86, 8: 0.88, 10: 0.89, 12: 0.90, 15: 0.92}
_COVERAGE_SCENES = {2: 0.71, 3: 0.82, 4: 0.86, 5: 0.90, 7: 0.91, 8: 0.95}
# 5 % of false alarms on both sides together, and 4 of 5 studies that find the difference
_QUANTILE = 0.975
_POWER = 0.8


@dataclasses.dataclass(frozen=True)
class Effect:
    """A mean difference.

    Attributes:
        mean: Mean of the scenes' means.
        low, high: Its interval, of 95 % by default.
        detectable: How large a true difference has to be for a t test of so many scenes' means (of one scene: of its
            units) to tell it from 0 in 4 of 5 studies, with 5 % of false alarms; None with a single mean.
        units, scenes: How many there are.
        positive, negative: Units in which the difference is above 0, and below.
    """

    mean: float
    low: float
    high: float
    detectable: float | None
    units: int
    scenes: int
    positive: int
    negative: int


def unit_of(row: Mapping[str, Any]) -> Unit:
    """The unit of a row: initial views count as a set. Where they were not recorded: what drew them. Where a camera is
    held out, which says what is known at the start, it stands for them.
    """
    if row.get("camera"):
        return row["scene"], tuple(row["split"]), (row["camera"],)
    drawn = (f"seed {row['seed']}",) if row["start"] == "seed" else ("first",)
    return row["scene"], tuple(row["split"]), tuple(sorted(row.get("initial") or drawn))


def view_counts(rows: Iterable[Mapping[str, Any]]) -> list[int]:
    """Numbers of views at which rows say how good a fit was; none where none was measured on the way."""
    rows = [row for row in rows if row.get("curve")]
    return sorted({int(count) for row in rows for count in row["curve"]} | {_last(row) for row in rows})


def at_views(rows: Iterable[Mapping[str, Any]], count: int) -> list[dict[str, Any]]:
    """The rows that were measured with so many views, on the way or at the end, with the metrics of then."""
    measured = []
    for row in rows:
        metrics = row["metrics"] if _last(row) == count else row.get("curve", {}).get(str(count))
        if metrics is not None:
            measured.append({**row, "metrics": metrics})
    return measured


def _last(row: Mapping[str, Any]) -> int:
    """Views of the end of a fit."""
    return len(row.get("initial") or ()) + len(row.get("picks") or ())


def values_of(rows: Iterable[Mapping[str, Any]], metric: str, policy: str) -> dict[Unit, float]:
    """Unit -> mean of a metric over the fits of a policy; fits that have none are left out."""
    by_unit: dict[Unit, list[float]] = {}
    for row in rows:
        if row["policy"] == policy and row["metrics"].get(metric) is not None:
            by_unit.setdefault(unit_of(row), []).append(row["metrics"][metric])
    return {unit: float(np.mean(values)) for unit, values in by_unit.items()}


def differences(rows: Sequence[Mapping[str, Any]], metric: str, policy: str, reference: str) -> dict[Unit, float]:
    """Unit -> policy minus reference, where there are both."""
    ours = values_of(rows, metric, policy)
    theirs = values_of(rows, metric, reference)
    return {unit: value - theirs[unit] for unit, value in ours.items() if unit in theirs}


def estimate(values: Mapping[Unit, float], draws: int = _BOOTSTRAP_DRAWS, share: float = 0.95) -> Effect:
    """Mean over scenes of the means over their units, and how certain it is.

    Args:
        values: Unit -> difference, at least one.
        draws: Draws of the bootstrap, the same ones every time.
        share: Share of the drawn means that is within the interval.
    """
    scenes: dict[str, list[float]] = {}
    for unit, value in values.items():
        scenes.setdefault(unit[0], []).append(value)
    rng = np.random.default_rng(0)
    count = len(scenes)
    # A scene that is drawn twice has its units drawn twice, independently.
    means = np.stack(
        [np.asarray(x)[rng.integers(len(x), size=(draws, count, len(x)))].mean(2) for x in scenes.values()]
    )
    drawn = rng.integers(count, size=(draws, count))
    resampled = np.take_along_axis(means, drawn[None], axis=0)[0].mean(1)
    low, high = np.quantile(resampled, ((1 - share) / 2, (1 + share) / 2))
    return Effect(
        mean=float(np.mean([np.mean(x) for x in scenes.values()])),
        low=float(low),
        high=float(high),
        detectable=_detectable([float(np.mean(x)) for x in scenes.values()] if count > 1 else list(values.values())),
        units=len(values),
        scenes=count,
        positive=sum(value > 0 for value in values.values()),
        negative=sum(value < 0 for value in values.values()),
    )


def coverage(scenes: int, units: int) -> float:
    """The share of studies whose 95 % interval holds the true mean, as it was simulated for so many or fewer.

    Args:
        scenes, units: How many there are, at least two units in all.
    """
    if scenes == 1 or units < 2 * scenes:
        count = units if scenes == 1 else scenes
        table = _COVERAGE
    else:
        count, table = scenes, _COVERAGE_SCENES
    return table[max(key for key in table if key <= count)]


def _detectable(means: Sequence[float]) -> float | None:
    """`Effect.detectable` of independent means."""
    degrees = len(means) - 1
    if degrees < 1:
        return None
    error = float(np.std(means, ddof=1)) / math.sqrt(len(means))
    # Quantiles of Student's t distribution.
    return float(stdtrit(degrees, _QUANTILE) + stdtrit(degrees, _POWER)) * error


# ------------------------------------------------------------------------------------------------------------- the race

# Coverage of the interval that must exclude 0: with 95 %, computed after every fit, chance decides too often.
_RACE_SHARE = 0.99
_RACE_METRIC = "psnr"


def decided(rows: Sequence[Mapping[str, Any]], reference: str, protocol: str) -> dict[str, str]:
    """Policies whose difference from the reference is known, and a sentence that says so.

    Args:
        rows: Rows of one study.
        reference: Label of the policy that the others race with.
        protocol: Protocol of the rows that count.
    """
    mine = [over_views(row, _RACE_METRIC) for row in rows if row["protocol"] == protocol]
    sentences = {}
    for label in dict.fromkeys(row["policy"] for row in mine if row["policy"] != reference):
        values = differences(mine, _RACE_METRIC, label, reference)
        if len(values) < FEWEST_UNITS:
            continue
        effect = estimate(values, share=_RACE_SHARE)
        if effect.low <= 0 <= effect.high:
            continue
        sentences[label] = (
            f"{label} has left after {effect.units} units: {effect.mean:+.2f} dB [{effect.low:+.2f}, "
            f"{effect.high:+.2f}] against {reference}, on average over numbers of views."
        )
    return sentences


def over_views(row: Mapping[str, Any], metric: str) -> dict[str, Any]:
    """A row with the mean of a metric over all numbers of views at which it was measured, in place of its last one."""
    last = row["metrics"].get(metric)
    values = [x for at in row.get("curve", {}).values() if (x := at.get(metric)) is not None]
    return {**row, "metrics": {metric: None if last is None else float(np.mean([*values, last]))}}
