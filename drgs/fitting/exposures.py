"""Gains of photographs, by exposure and white balance, as points that several of them show tell them.

Where several photographs show one point, log c = log gain of the photograph + log color of the point + noise, on the
values of the photographs as they are (sRGB), in which renderings are compared with them. Which photographs show a point
must be known (`drgs.sfm.points`): where half of the points are hidden by others, no robust weight finds the gains. What
depends on the direction, like the light on a thing that is turned, looks like a gain, too; so a gain is of use only if
it lowers the error of the half of its photograph that it was estimated without.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from drgs.fitting.frames import Frame

BRIGHT = 250 / 255
"""Value of a photograph from which on it may be saturated, and hides the gain."""

LEAST_LOWERED = 0.05
"""Share of the error of what is held out that gains must lower; captures of one exposure have up to 0.02, by chance."""

_DARK = 8 / 255  # below it a tone curve hides the gain
_BORDER = 1.5  # pixels from the border, so that a patch of 3x3 is inside
_LEAST_MASK = 0.99  # mask, and alpha, that the whole patch must have
_MOST_OBSERVATIONS = 1_000_000  # photographs times points that are compared: bounds seconds and memory; chosen
_HUBER = 1.345  # times the noise: 95 % efficient where it is normal
_TUKEY = 4.0  # times the noise, beyond which a color is of something else
# Reweighted steps with Huber's weights, whose result does not depend on the start, and in all; chosen.
_HUBER_STEPS, _ROBUST_STEPS = 6, 15
_LEAST_NOISE = 0.01  # of a log color: a byte's rounding at mid-gray
_SHARED_POINTS = 8  # points that two photographs must share for their gains to be compared; chosen, not tuned
_CLEAR_STOPS = 0.1  # stops: three times what two sets of points of one capture differ by in what they say


@dataclasses.dataclass(frozen=True)
class ExposureEstimate:
    """What points say of the gains of V photographs.

    Attributes:
        log_gains: (V, 3) float64 natural logarithms; of zero mean over the photographs of a component, each channel.
        errors: (V, 3) their standard errors.
        observations: How many colors of points were compared.
        components: Sets of photographs that share points; each is centered by itself, for nothing compares them.
        labels: (V,) int32 number of the set of each photograph.
        lowered: Share of the error in halves of photographs that gains lower which were estimated without them;
            negative where they raise it.
        is_confirmed: (V,) bool, whose gains lower it.
        gained: What gains add, in dB, to photographs that short fits did not see; None where that was not tried.
    """

    log_gains: np.ndarray
    errors: np.ndarray
    observations: int
    components: int
    labels: np.ndarray
    lowered: float
    is_confirmed: np.ndarray
    gained: float | None = None

    @property
    def spread(self) -> tuple[float, float, float]:
        """Standard deviation over the photographs of log2 of the gains of R, G and B: in stops of the sRGB values."""
        return _three(self.log_gains.std(axis=0) / math.log(2))

    @property
    def noise(self) -> tuple[float, float, float]:
        """Root mean square over the photographs of the standard errors of log2 of the gains of R, G and B."""
        return _three(np.sqrt(np.square(self.errors).mean(axis=0)) / math.log(2))

    @property
    def is_clear(self) -> bool:
        """Whether the gains differ by more than points can be wrong about: in one channel at least."""
        return any(x**2 - e**2 > _CLEAR_STOPS**2 for x, e in zip(self.spread, self.noise, strict=True))

    @property
    def is_sound(self) -> bool:
        """Whether the gains are clear and lower the error of what is held out."""
        return self.is_clear and self.lowered > LEAST_LOWERED

    def confirmed(self) -> ExposureEstimate:
        """With gain 1 for photographs whose own does not lower the error of what is held out of them."""
        gains, good = self.log_gains.copy(), self.is_confirmed
        for label in np.unique(self.labels[good]):
            mine = self.labels == label
            gains[mine] -= gains[mine & good].mean(axis=0)
        gains[~good] = 0
        return dataclasses.replace(self, log_gains=gains)

    def words(self) -> str:
        """What was found, in one line."""
        spread, noise = (" ".join(f"{x:.3f}" for x in values) for values in (self.spread, self.noise))
        apart = f", in {self.components} sets that share no points" if self.components > 1 else ""
        return (
            f"log2 gains of R G B differ by {spread} between photographs (noise {noise}, {self.observations} colors of "
            f"points{apart}); {self._held_out_words()}"
        )

    def _held_out_words(self) -> str:
        """What was found on halves of photographs that are held out."""
        change = f"{'lower' if self.lowered >= 0 else 'raise'} the error of held-out halves of photographs by "
        change += f"{100 * abs(self.lowered):.0f} %"
        others = int((~self.is_confirmed).sum())
        trial = "" if self.gained is None else f"; photographs held out of short fits change by {self.gained:+.2f} dB"
        left = f" (those of {others} of {len(self.is_confirmed)} do not)" if others else ""
        return f"they {change}{left}{trial}"

    def warning(self) -> str:
        """What a fit without gains is to say of photographs that differ, in one line."""
        spread = " ".join(f"{x:.2f}" for x in self.spread)
        return (
            f"exposure: photographs differ by {spread} stops in R G B (standard deviation, {self.observations} colors "
            "of shared points), and held-out views as much: see cc_psnr; --exposure auto gives each photograph its own "
            "gain if that helps"
        )

    def to_json(self, names: list[str]) -> dict:
        """The estimate as config.json has it; `names` of the photographs."""
        gains = {name: [float(x) for x in row] for name, row in zip(names, np.exp(self.log_gains), strict=True)}
        return {
            "spread": list(self.spread),
            "noise": list(self.noise),
            "observations": self.observations,
            "components": self.components,
            "lowered": self.lowered,
            "gained": self.gained,
            "unconfirmed": [name for name, good in zip(names, self.is_confirmed, strict=True) if not good],
            "gains": gains,
        }


def estimate_exposure(
    frames: list[Frame],
    points: np.ndarray,
    seed: int = 0,
    shown: np.ndarray | None = None,
    most: int = _MOST_OBSERVATIONS,
) -> ExposureEstimate:
    """Gains of photographs from points of the scene, in closed form under robust weights.

    The colors of points are eliminated from the normal equations of each channel, so that V unknowns are left, whose
    gauge is a zero mean. All channels of an observation have one weight: what hides a point changes all of them.

    Args:
        frames: V photographs with their cameras; pixels outside of masks are not used.
        points: (P, 3) world points, of which as many are drawn as memory has room for.
        seed: Seed of this draw.
        shown: (V, P) bool, which photographs were found to show which points; None: unknown, and every photograph into
            which a point is projected may.
        most: Photographs times points that are compared.
    """
    count = max(1, most // max(1, len(frames)))
    if len(points) > count:
        kept = np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))
        points, shown = points[kept], None if shown is None else shown[:, kept]
    logs, there, columns = _observed(frames, points)
    if shown is not None:
        there &= shown[:, :, None]
    there &= (there.any(axis=2).sum(axis=0) >= 2)[None, :, None]  # a point that one photograph shows compares nothing
    gains, errors, label = _robust(logs, there)
    before, after = _held_out_errors(logs, there, columns)
    lowered = 1 - float(after.sum() / before.sum()) if before.any() else 0.0
    observations = int(there.any(axis=2).sum())
    return ExposureEstimate(gains, errors, observations, len(np.unique(label)), label, lowered, after < before)


def _robust(logs: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V, 3) log gains, their (V, 3) standard errors and the (V,) component of each photograph, of (V, P, 3) logs."""
    robust = there.any(axis=2).astype(np.float64)
    label = _components(there)
    gains = np.zeros((len(logs), 3))
    errors = np.zeros((len(logs), 3))
    for step in range(_ROBUST_STEPS if there.any() else 0):
        residual = np.zeros(logs.shape)
        inverses = []
        for channel in range(3):
            weights = there[..., channel] * robust
            gains[:, channel], inverse, colors = _solved(weights, logs[..., channel], label)
            inverses.append(inverse)
            residual[..., channel] = there[..., channel] * (logs[..., channel] - gains[:, channel, None] - colors)
        count = there.sum(axis=2)
        seen = count > 0
        size = np.sqrt(np.square(residual).sum(axis=2) / np.maximum(count, 1))  # 0 where nothing is seen
        noise = max(1.4826 * float(np.median(size[seen])), _LEAST_NOISE)
        errors = np.stack([noise * np.sqrt(np.maximum(np.diag(x), 0)) for x in inverses], axis=1)  # 0 but for rounding
        if step < _HUBER_STEPS:
            robust = seen * np.minimum(1, _HUBER * noise / np.maximum(size, 1e-12))  # a residual may be 0
        else:
            robust = seen * np.square(np.maximum(0, 1 - np.square(size / (_TUKEY * noise))))
    return gains, errors, label


def _held_out_errors(logs: np.ndarray, there: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(V,) sums of absolute errors of each photograph's colors, as other photographs of the same points predict them:
    without gains and with gains that were estimated without this half of it.

    Halves are left and right of the median point: light that falls on a thing from one side, or a point that is taken
    for another one, brightens a part of a photograph, exposure all of it.
    """
    is_right = np.zeros(columns.shape, bool)
    for row, across in enumerate(columns):
        mine = across[there[row].any(axis=1)]
        is_right[row] = across > (np.median(mine) if len(mine) else 0.0)
    others = np.maximum(there.sum(axis=0) - 1, 1)
    errors = np.zeros((2, len(logs)))
    for fold in (False, True):
        held_out = there & (is_right ^ fold)[..., None] & (there.sum(axis=0) > 1)
        rest = there & ~held_out
        gains = _robust(logs, rest & (rest.any(axis=2).sum(axis=0) >= 2)[None, :, None])[0][:, None]
        for sums, shift in zip(errors, (np.zeros_like(gains), gains), strict=True):
            colors = there * (logs - shift)
            predicted = (colors.sum(axis=0) - colors) / others + shift
            sums += (held_out * np.abs(np.exp(predicted) - np.exp(logs))).sum(axis=(1, 2))
    return errors[0], errors[1]


def _observed(frames: list[Frame], points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V, P, 3) logarithms of the mean colors of 3x3 patches, which are there, neither dark nor saturated nor with
    pixels that a mask or alpha channel leaves empty, and the (V, P) columns of the points.
    """
    import cv2

    logs = np.zeros((len(frames), len(points), 3))
    there = np.zeros(logs.shape, bool)
    across = np.zeros(logs.shape[:2])
    square = np.ones((3, 3), np.uint8)
    for row, frame in enumerate(frames):
        image = frame.image().numpy()
        pixels, depth = frame.camera.project(points)
        inside = frame.camera.contains(pixels, depth, _BORDER)
        across[row] = pixels[:, 0]
        index = np.flatnonzero(inside)
        columns, rows = pixels[index].astype(int).T
        empty = frame.empty()
        for shown in (frame.mask, None if empty is None else 1 - empty):
            if shown is not None:
                kept = cv2.erode(shown.numpy(), square)[rows, columns] > _LEAST_MASK
                index, columns, rows = index[kept], columns[kept], rows[kept]
        lowest, highest = (x(image, square)[rows, columns] for x in (cv2.erode, cv2.dilate))
        good = (lowest > _DARK) & (highest < BRIGHT)
        there[row, index] = good
        logs[row, index] = np.log(np.where(good, cv2.blur(image, (3, 3))[rows, columns], 1.0))
    return logs, there, across


def _solved(weights: np.ndarray, logs: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V,) log gains, the (V, V) inverse of their normal equations, and (P,) log colors, of (V, P) observations."""
    of_point = weights.sum(axis=0)
    scale = np.divide(1.0, of_point, out=np.zeros_like(of_point), where=of_point > 0)
    halves = weights * np.sqrt(scale)
    normal = np.diag(weights.sum(axis=1)) - halves @ halves.T
    weighted = weights * logs
    right = weighted.sum(axis=1) - weights @ (weighted.sum(axis=0) * scale)
    # What shifts all photographs of a component alike is in the null space: the pseudo-inverse leaves it 0.
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    gains = inverse @ right
    for component in np.unique(label):
        mine = label == component
        gains[mine] -= gains[mine].mean()
    return gains, inverse, ((weighted.sum(axis=0) - gains @ weights) * scale)


def _components(there: np.ndarray) -> np.ndarray:
    """(V,) label of the set of photographs that share points with each photograph, of (V, P, 3) observations."""
    from scipy.sparse.csgraph import connected_components

    shown = np.asarray(there.any(axis=2), np.float32)
    return connected_components(shown @ shown.T >= _SHARED_POINTS, directed=False)[1]


def _three(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = (float(x) for x in values)
    return red, green, blue
