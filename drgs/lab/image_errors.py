"""Classify the error of an image: simple changes of the right image that reproduce the wrong one.

Each pattern is fitted to the image by least squares, where it has numbers, and counts as found if it explains nine
tenths of the squared error. Of patterns that explain it equally well, the simplest is taken, in the order of
`PATTERNS`. Where none does, it is said where the error lies, if it lies in one kind of place.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator

import cv2
import numpy as np

from drgs.display.srgb import linear_from_srgb, srgb_from_linear

PATTERNS = {
    "flipped": "mirrored, or turned by half a turn",
    "channels": "its channels are in another order",
    "factor": "times one number",
    "offset": "plus one number",
    "foreground": "what Gaussians add is times one number, the background is not",
    "background": "another background, or none",
    "transfer": "a transfer function: sRGB, or a power",
    "shift": "moved within the image",
    "zoom": "magnified about the middle of the image, and moved",
    "blur": "blurred",
    "channel factors": "each channel times a number of its own",
    "channel offsets": "each channel plus a number of its own",
    "blank": "where it is off it has one color",
    "border": "off along one side of the image only",
    "edges": "off where the image is steepest only",
    "few pixels": "off in few pixels",
    "none": "no known pattern",
}
"""Key -> what it means, the simplest first."""

OFF = 1e-3
"""A pixel that differs by more is off."""
_PLACES = ("border", "edges", "few pixels", "none")
# Shares are chosen by hand; tests/test_image_errors.py breaks images in each of these ways.
_MIN_EXPLAINED = 0.9  # share of the squared error that a pattern must explain to be named
_TIE = 0.01  # share of the squared error: of patterns that differ by less the simplest is taken
_MAX_BORDER = 0.1  # share of the width or height that a border is at most
_EDGE_SHARE = 0.1  # share of the pixels that count as edges, those of the largest gradient
_FEW_PIXELS = 0.05  # share of the pixels that counts as few
# standard deviations of the blurs that are tried, px
_BLUR_SIGMAS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.25, 1.5, 2.0, 3.0)
_MAX_SHIFT_STEPS = 20  # steps of Gauss-Newton for a shift, at most; each about squares the error of the one before
_SHIFT_CONVERGED = 1e-4  # px: a smaller step ends them


@dataclasses.dataclass(frozen=True)
class Pattern:
    """A kind of error: a change of the right image that explains it.

    Attributes:
        name: A key of `PATTERNS`.
        what: The pattern in words that follow "the image of the model".
        explained: Share of the squared error; NaN for `none`.
    """

    name: str
    what: str
    explained: float

    @property
    def is_change(self) -> bool:
        """Whether it makes the wrong image of the right one, rather than say where they differ."""
        return self.name not in _PLACES


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """Where an image is wrong, and which pattern explains its error.

    Attributes:
        pixels: Number of pixels that count and differ by more than 0.001.
        box: The smallest rectangle that holds them: x and y of its first and of its last pixel.
        x, y: Column and row of the worst of them.
        rasterizer: RGB of that pixel in the rasterizer's image.
        model: RGB of that pixel in the model's image.
        pattern: One of `drgs.lab.image_errors.PATTERNS`.
        what: The pattern in words, with its numbers.
        explained: Share of the squared error that the pattern explains, or that lies where it says; null for `none`.
    """

    pixels: int
    box: list[int]
    x: int
    y: int
    rasterizer: list[float]
    model: list[float]
    pattern: str
    what: str
    explained: float | None


@dataclasses.dataclass(frozen=True)
class _Case:
    """(H, W, 3) images and, of the right one, (H, W) alpha and the RGB of its background; (H, W) pixels that count."""

    wrong: np.ndarray
    right: np.ndarray
    alpha: np.ndarray
    background: np.ndarray
    counts: np.ndarray

    def explained(self, changed: np.ndarray, known: np.ndarray | None = None) -> float:
        """Share of the squared error that is gone with `changed`, which is known at (H, W) pixels, default at all."""
        counts = self.counts if known is None else self.counts & known
        before, after = (((x - self.wrong) ** 2)[counts].sum() for x in (self.right, changed))
        return 1 - float(after / before) if before > 0 else 0.0


def error_row(
    wrong: np.ndarray, model: np.ndarray, counts: np.ndarray, pattern: Pattern, changed: str
) -> ErrorRow | None:
    """The place where an image is off the model's, with a pattern; None where no pixel is off.

    Args:
        wrong: (H, W, 3) image that is looked at.
        model: (H, W, 3) image of the model.
        counts: (H, W) bool, the pixels that count.
        pattern: Pattern of the error, as `pattern_of` finds it.
        changed: What the pattern changes, in words.
    """
    error = np.abs(wrong - model).max(-1) * counts
    ys, xs = np.nonzero(error > OFF)
    if len(xs) == 0:
        return None
    y, x = np.unravel_index(int(error.argmax()), error.shape)
    known = not math.isnan(pattern.explained)
    return ErrorRow(
        pixels=len(xs),
        box=[int(xs.min()), int(ys.min()), int(xs.max()), int(ys.max())],
        x=int(x),
        y=int(y),
        rasterizer=[float(v) for v in wrong[y, x]],
        model=[float(v) for v in model[y, x]],
        pattern=pattern.name,
        what=f"the image of {changed}, {pattern.what}" if known else pattern.what,
        explained=pattern.explained if known else None,
    )


def error_line(error: ErrorRow, size: list[int]) -> str:
    """The row of a view of (width, height) in words."""
    colors = (_numbers(np.array(rgb)) for rgb in (error.rasterizer, error.model))
    left, top, right, bottom = error.box
    looks = f"it looks like {error.what}" if error.explained is not None else f"its error has {error.what}"
    if error.pattern not in _PLACES:
        looks += f", which explains {error.explained:.1%} of the squared error"
    return (
        f"{error.pixels:,} of {size[0] * size[1]:,} pixels are off by more than {OFF:g}, in x {left} to {right} and y "
        f"{top} to {bottom}, most at ({error.x}, {error.y}): {' instead of '.join(colors)}; {looks}"
    )


def pattern_of(
    wrong: np.ndarray, right: np.ndarray, alpha: np.ndarray, background: tuple, counts: np.ndarray
) -> Pattern:
    """The simplest pattern that makes a wrong image of the right one.

    Args:
        wrong: (H, W, 3) image that is looked at.
        right: (H, W, 3) image that it should be.
        alpha: (H, W) opacity of the right image.
        background: RGB background of both.
        counts: (H, W) bool, the pixels that count.
    """
    case = _Case(*(np.asarray(x, np.float64) for x in (wrong, right, alpha, background)), np.asarray(counts, bool))
    if not np.any((case.wrong - case.right)[case.counts]):
        return Pattern("none", "no error where pixels count", math.nan)
    patterns = sorted(_changes(case), key=lambda pattern: list(PATTERNS).index(pattern.name))
    best = max(pattern.explained for pattern in patterns)
    if best >= _MIN_EXPLAINED:
        return next(pattern for pattern in patterns if pattern.explained >= best - _TIE)
    return _place(case) or Pattern("none", "no known pattern", math.nan)


def _changes(case: _Case) -> Iterator[Pattern]:
    """Every change of the right image, with its best numbers."""
    for kind in (_flips, _orders, _sums, _backgrounds, _transfers, _moves, _blurs, _blank):
        for name, what, changed, *known in kind(case):
            yield Pattern(name, what, case.explained(changed, *known))


def _flips(case: _Case) -> Iterator[tuple]:
    right = case.right
    yield "flipped", "mirrored top to bottom", right[::-1]
    yield "flipped", "mirrored left to right", right[:, ::-1]
    yield "flipped", "turned by half a turn", right[::-1, ::-1]
    if right.shape[0] == right.shape[1]:
        yield "flipped", "its rows and columns exchanged", right.transpose(1, 0, 2)
        yield "flipped", "turned by a quarter to the left", np.rot90(right)
        yield "flipped", "turned by a quarter to the right", np.rot90(right, -1)


def _orders(case: _Case) -> Iterator[tuple]:
    for order in itertools.permutations(range(3)):
        yield "channels", f"its channels in the order {''.join('RGB'[i] for i in order)}", case.right[..., list(order)]


def _sums(case: _Case) -> Iterator[tuple]:
    """Factors and summands, of all channels or of each."""
    x, y = case.right[case.counts], case.wrong[case.counts]
    factor = _ratio(x, y)
    factors = np.array([_ratio(x[:, k], y[:, k]) for k in range(3)])
    summands = (y - x).mean(0)
    summand = float(summands.mean())
    yield "factor", f"times {factor:.4g}", factor * case.right
    yield "offset", f"plus {summand:.4g}", case.right + summand
    yield "channel factors", f"its channels times {_numbers(factors)}", case.right * factors
    yield "channel offsets", f"its channels plus {_numbers(summands)}", case.right + summands


def _backgrounds(case: _Case) -> Iterator[tuple]:
    """The two parts of an image: what Gaussians add, and what is seen of the background."""
    transmittance = (1 - case.alpha)[..., None]
    front = case.right - transmittance * case.background
    difference = case.wrong - case.right
    factor = 1 + _ratio(front[case.counts], difference[case.counts])
    yield "foreground", f"what its Gaussians add times {factor:.4g}", case.right + (factor - 1) * front
    added = np.array([_ratio(transmittance[..., 0][case.counts], difference[..., k][case.counts]) for k in range(3)])
    now = case.background + added
    was = _numbers(case.background)
    missing = np.abs(now).max() < 0.01 < np.abs(case.background).max()
    what = f"its background {was} missing" if missing else f"its background {_numbers(now)} instead of {was}"
    yield "background", what, case.right + transmittance * added


def _transfers(case: _Case) -> Iterator[tuple]:
    right = case.right.clip(0)  # a power of a negative color is NaN
    yield "transfer", "encoded as sRGB", srgb_from_linear(right)
    yield "transfer", "decoded as if it were sRGB", linear_from_srgb(right)
    usable = case.counts & ((right > 0.01) & (np.abs(right - 1) > 0.01) & (case.wrong > 0.01)).all(-1)
    if usable.any():
        power = float(np.median(np.log(case.wrong[usable]) / np.log(right[usable])))
        if 0.1 < power < 10:
            yield "transfer", f"to the power of {power:.3g}", right**power


def _moves(case: _Case) -> Iterator[tuple]:
    """A shift, and one with a magnification, by Gauss-Newton on the difference of the images."""
    height, width = case.counts.shape
    if min(height, width) < 2:  # no window for the correlation
        return
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = x - (width - 1) / 2, y - (height - 1) / 2
    pair = (np.ascontiguousarray(image.mean(-1)) for image in (case.right, case.wrong))
    (far_x, far_y), _ = cv2.phaseCorrelate(*pair, cv2.createHanningWindow((width, height), cv2.CV_64F))
    for name, count in (("shift", 2), ("zoom", 3)):
        ends = []
        for start in ((0.0, 0.0, 0.0), (far_x, far_y, 0.0)):
            move = np.array(start)
            for _ in range(_MAX_SHIFT_STEPS):
                changed, known = _moved(case.right, move)
                use = case.counts & known
                if not use.any():
                    break
                down, across = np.gradient(changed, axis=(0, 1))
                slopes = [-across, -down, -(across * x[..., None] + down * y[..., None])][:count]
                table = np.stack([slope[use].ravel() for slope in slopes])
                square = table @ table.T
                right = table @ (case.wrong - changed)[use].ravel()
                step = np.linalg.lstsq(square, right, rcond=None)[0].clip(-2, 2)  # of a flat image no move is best
                move[:count] += step
                if np.abs(step * (1, 1, max(width, height))[:count]).max() < _SHIFT_CONVERGED:
                    break
            move[:2] = move[:2].clip(-width, width)  # a search that diverged stays in numbers that can be warped by
            changed, known = _moved(case.right, move)
            if (case.counts & known).sum() > 0.25 * case.counts.sum():
                ends.append((case.explained(changed, known), move, changed, known))
        if ends:
            _, move, changed, known = max(ends, key=lambda end: end[0])
            enlarged = f"magnified {1 + move[2]:.4g} times and " if count == 3 else ""
            yield name, f"{enlarged}moved by {_way(*move[:2])}", changed, known


def _moved(image: np.ndarray, move: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An (H, W, 3) image moved by (dx, dy) pixels and magnified by 1 + s about its middle, and where that is known."""
    height, width = image.shape[:2]
    dx = move[0]
    dy = move[1]
    zoom = 1 + float(np.clip(move[2], -0.5, 0.5))  # at -1 nothing would be left, beyond it all is mirrored
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    matrix = np.column_stack([zoom * np.eye(2), middle - zoom * middle + (dx, dy)])

    def warped(x: np.ndarray, border: int) -> np.ndarray:
        x = x.astype(np.float32)  # OpenCV 5.0 interpolates float64 wrongly by cubics
        return cv2.warpAffine(x, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=border).astype(float)

    known = warped(np.ones((height, width)), cv2.BORDER_CONSTANT) > 1 - 1e-5
    return warped(image, cv2.BORDER_REPLICATE), known


def _blurs(case: _Case) -> Iterator[tuple]:
    for sigma in _BLUR_SIGMAS:
        blurred = cv2.GaussianBlur(case.right, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        yield "blur", f"blurred by {sigma:g} pixels", blurred


def _blank(case: _Case) -> Iterator[tuple]:
    """One color in all pixels that are off, where the right image has several."""
    off = case.counts & (np.abs(case.wrong - case.right).max(-1) > OFF)
    if off.sum() < 4:
        return
    color = case.wrong[off].mean(0)
    if np.abs(case.wrong[off] - color).max() < OFF < case.right[off].std(0).max():
        changed = np.where(off[..., None], color, case.right)
        yield "blank", f"with nothing but {_numbers(color)} in the pixels that are off", changed


def _place(case: _Case) -> Pattern | None:
    """The kind of place where an error lies that is like nothing known; None where it lies everywhere."""
    error = ((case.wrong - case.right) ** 2).sum(-1) * case.counts
    total = error.sum()
    sides = {"left": (1, 1), "right": (1, -1), "top": (0, 1), "bottom": (0, -1)}
    for side, (axis, way) in sides.items():
        along = np.cumsum(error.sum(1 - axis)[::way]) / total
        depth = int(np.searchsorted(along, _MIN_EXPLAINED)) + 1
        if depth <= max(1, _MAX_BORDER * len(along)):
            share = float(along[depth - 1])
            return Pattern("border", f"but off along its {side} side: {share:.0%} of the error is there", share)
    few = np.sort(error[case.counts])[::-1]
    share = min(1.0, float(few[: max(1, int(_FEW_PIXELS * len(few)))].sum() / total))  # of sums in another order
    if share >= _MIN_EXPLAINED:
        return Pattern(
            "few pixels", f"but off in few pixels: {_FEW_PIXELS:.0%} of them have {share:.0%} of the error", share
        )
    steep = sum((x**2).sum(-1) for x in np.gradient(case.right, axis=(0, 1)))
    edges = steep >= np.quantile(steep[case.counts], 1 - _EDGE_SHARE)
    share = float(error[edges].sum() / total)
    if share >= _MIN_EXPLAINED:
        what = f"but off at edges: the steepest {_EDGE_SHARE:.0%} of its pixels have {share:.0%} of the error"
        return Pattern("edges", what, share)
    return None


def _ratio(x: np.ndarray, y: np.ndarray) -> float:
    """The number times x that is nearest to y."""
    square = float((x * x).sum())
    return float((x * y).sum()) / square if square > 1e-12 * x.size else 0.0  # of a black image: no number is nearest


def _numbers(values: np.ndarray) -> str:
    return f"({', '.join(f'{0.0 if abs(x) < 5e-5 else x:.4g}' for x in values)})"


def _way(dx: float, dy: float) -> str:
    """(dx, dy) pixels in words."""
    parts = [
        f"{abs(d):.2f} pixels {way[int(d < 0)]}"
        for d, way in ((dx, ("to the right", "to the left")), (dy, ("down", "up")))
        if abs(d) >= 0.005
    ]
    return " and ".join(parts) or "nothing"
