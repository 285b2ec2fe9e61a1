"""Whether synchronous cameras are in step: what moves in one of them moves in the others at the same time."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

__all__ = ["LateCamera", "late_cameras"]

_FEWEST_CAMERAS = 3  # of two that disagree, nothing tells which one is wrong
_FEWEST = 10  # changes that two curves must share to be compared
_AGREES = 0.7  # correlation at the best shift from which on it is believed
_IN_STEP = 0.5  # correlation of the other cameras with each other, in the median of pairs, below which none is late
_GAIN = 0.25  # correlation that the shift must gain: curves that vary slowly agree at neighboring shifts, too


@dataclasses.dataclass(frozen=True)
class LateCamera:
    """A camera whose frames show what the others show later or earlier.

    Attributes:
        name: The camera's.
        shift: How many pictures later the others show what it shows, as of a camera that started late; negative:
            earlier.
        agreement, without: Correlation of its motion energy with that of the others, with and without this shift.
    """

    name: str
    shift: float
    agreement: float
    without: float

    def words(self, spacing: float = 1.0) -> str:
        """What is wrong and what to do, in one line.

        Args:
            spacing: Frames of the video from one picture to the next.
        """
        count = max(1, round(abs(self.shift) * spacing))
        noun = "frame" if count == 1 else "frames"
        kind, where = ("late", "of the other cameras") if self.shift > 0 else ("early", "of this one")
        return (
            f"camera {self.name} seems to start {count} {noun} {kind}: how much moves over time agrees with the other "
            f"cameras by {self.agreement:.2f} with this shift, by {self.without:.2f} without (1 is equal); cut the "
            f"first {count} {noun} {where}, or leave this camera out"
        )


def late_cameras(pictures: Mapping[str, np.ndarray]) -> list[LateCamera]:
    """The cameras that are out of step with the others, by how much pictures change from one to the next.

    That is compared as a curve over time, of each camera with the median of the others, at every shift that leaves two
    thirds of it. Cameras stand still; one that moves, or that does not see what moves, agrees with the others nowhere,
    and nothing is said of it.

    Args:
        pictures: Camera -> (T, H, W) gray pictures at the same numbers of frames, of any size.
    """
    curves = {name: _energy(x) for name, x in pictures.items()}
    count = min((len(x) for x in curves.values()), default=0)
    most = min(count // 3, count - _FEWEST)
    if len(curves) < _FEWEST_CAMERAS or most < 1:
        return []
    table = np.array(list(curves.values()))
    pairs = np.array([[_correlation(a, b) for b in table] for a in table])
    found = []
    for index, (name, curve) in enumerate(curves.items()):
        rest = np.delete(np.arange(len(table)), index)
        among = pairs[np.ix_(rest, rest)][np.triu_indices(len(rest), 1)]
        if np.median(among) < _IN_STEP:
            continue
        others = np.median(table[rest], axis=0)
        shifts = range(-most, most + 1)
        agreement = {s: _correlation(curve[max(-s, 0) : count - max(s, 0)], others[max(s, 0) :]) for s in shifts}
        best = max(shifts, key=lambda s: (agreement[s], -abs(s)))
        if best and agreement[best] >= _AGREES and agreement[best] - agreement[0] >= _GAIN:
            shift = best + _peak(*(agreement.get(best + step, -1.0) for step in (-1, 0, 1)))
            found.append(LateCamera(name, shift, agreement[best], agreement[0]))
    return found


def _energy(pictures: np.ndarray) -> np.ndarray:
    """(T - 1,) mean change from each picture to the next, of mean 0 and standard deviation 1."""
    change = np.abs(np.diff(pictures.astype(np.float64), axis=0)).mean(axis=(1, 2))
    return (change - change.mean()) / max(change.std(), 1e-12)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of two curves, as far as both go; 0 of one that is constant."""
    a, b = a[: len(b)], b[: len(a)]
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-12))


def _peak(before: float, here: float, after: float) -> float:
    """Where a parabola through three values, the middle one the largest, is largest: within half a step."""
    bend = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
