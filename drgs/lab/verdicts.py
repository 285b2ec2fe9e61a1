"""Compare a rasterizer's image and gradients with a model's, and explain the difference: verdicts of groups.

Pixels with near ties, where two correct renderers differ, are left out before a difference counts; then known
deviations explain what they can, and the rasterizer's own central differences decide the rest: what its gradient has to
agree with, whatever its model is. An image that is cut off somewhere (alpha below 1/255, transmittance below 1e-4,
tiles, order) jumps where a parameter moves a pixel across. Pixels that jump on any of the steps are left out, of the
differences and, by a masked cotangent, of the gradient; so are entries that do not converge with the square of the
step. `dataclasses.asdict` of the rows is what `crossval.json` holds.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.lab.conventions import BETWEEN, LEAST, ReferenceModel
from drgs.lab.image_errors import OFF, ErrorRow, Pattern, error_row, pattern_of
from drgs.lab.parameters import MOTIONS
from drgs.lab.rasterizers import Dump, Rasterizer
from drgs.oracle import float64

VERDICTS = ("gradient bug", "undecided", "model difference", "other convention", "known deviation", "agreement")


@dataclasses.dataclass(frozen=True)
class WorstPixel:
    """A pixel where two images differ most."""

    x: int
    y: int
    difference: float


@dataclasses.dataclass(frozen=True)
class AlphaRow:
    """How far alpha is off: root of the mean square, and the mean."""

    rms: float
    bias: float


@dataclasses.dataclass(frozen=True)
class ViewRow:
    """One view's image beside the model's.

    Attributes:
        view: The camera's name, or its number where it has none.
        rms: Root of the mean square of the difference.
        max: Largest difference.
        share: Share of the pixels that differ by more than 0.001.
        alpha: Difference of the alphas.
        near_ties: Number of pixels that do not count.
        worst: Up to five pixels of the largest difference.
        error: Place and look of the error; null where the image is the model's.
    """

    view: str
    rms: float
    max: float
    share: float
    alpha: AlphaRow
    near_ties: int
    worst: list[WorstPixel]
    error: ErrorRow | None = None


@dataclasses.dataclass(frozen=True)
class WorstGaussian:
    """A Gaussian (of `viewmats`: a view) whose gradient is off by most, as a norm."""

    gaussian: int
    difference: float


@dataclasses.dataclass(frozen=True)
class OwnRow:
    """A gradient beside the rasterizer's own central differences.

    Attributes:
        entries: Flat indices of the group's parameters.
        central: Central difference at each of them.
        uncertainty: Error bar of each central difference.
        gradient: The rasterizer's gradient at each of them.
        relative: L2 norm of the error over that of the differences.
        left_out: Number of entries that did not converge.
        bug: Whether the gradient contradicts the differences.
        what: The finding in words.
        pixels_left_out: Number of pixels that jump on one of the steps.
    """

    entries: list[int]
    central: list[float]
    uncertainty: list[float]
    gradient: list[float]
    relative: float
    left_out: int
    bug: bool
    what: str
    pixels_left_out: int


@dataclasses.dataclass
class GroupRow:
    """One parameter group's gradient beside the model's.

    Attributes:
        verdict: One of `crossval.VERDICTS`, None while it is to be explained.
        why: The reason in words.
        worst: Up to five Gaussians of the largest difference.
        relative: L2 norm of the difference over that of the model's gradient.
        cosine: Cosine of the angle between the two gradients.
        bias: How much too long the gradient is along the model's.
        max: Largest difference.
        norm: L2 norm of the model's gradient.
        differences: Central differences that decided, where they were taken.
    """

    verdict: str | None
    why: str
    worst: list[WorstGaussian]
    relative: float
    cosine: float
    bias: float
    max: float
    norm: float
    differences: OwnRow | None = None

    def settle(self, verdict: str, why: str) -> None:
        """Give it its verdict."""
        self.verdict = verdict
        self.why = why

    def json(self) -> dict:
        """The row as crossval.json holds it, without `differences` where there are none."""
        return {name: x for name, x in dataclasses.asdict(self).items() if name != "differences" or x is not None}


# ------------------------------------------------------------------------------------------------------------- verdicts

# Chosen; benchmarks/crossval_broken.json has the verdicts with them on rasterizers that were broken on purpose.
# share of the pixels: if so few are off, a cut-off or the order decided them, and they are left out
_MAX_PIXELS_OFF = 0.01
_IMAGE_TOLERANCE = 1e-3  # RMS difference of images that agree, colors in [0, 1]
_MIN_CONVERGED = 3  # central differences that have converged, which a verdict needs
_BUG_TOLERANCE = 0.02  # relative difference of a gradient from the rasterizer's own central differences that is a bug


@dataclasses.dataclass(frozen=True)
class Deviation:
    """A documented difference of gradients that a rasterizer has on purpose.

    Attributes:
        name: The deviation in words.
        where: The code that it is known from.
        change: Fields of the model that have it.
    """

    name: str
    where: str
    change: dict


_DETACHED = Deviation(
    "view direction of SH detached",
    "training code that evaluates SH on detached directions",
    {"direction_gradient": False},
)
_PASSED = Deviation("clamped alpha passes its gradient", "INRIA, backward.cu:977", {"alpha_max_gradient": "pass"})
_ZEROED = Deviation(
    "clamped alpha has no gradient", "gsplat, RasterizeToPixels3DGSDevice.cuh:155", {"alpha_max_gradient": "zero"}
)
_BETWEEN = Deviation(
    "colors seen from between both poses of the shutter", "gsplat, rendering.py", {"direction": BETWEEN}
)


@dataclasses.dataclass(frozen=True)
class Case:
    """What is compared, and how: arguments of `crossval`.

    Attributes:
        first: The view whose central differences are taken.
        near_ties: Function of a view's index: (H, W) bool, the pixels that hang on near ties of the model.
    """

    rasterizer: Rasterizer | Dump
    raw: dict
    cameras: list[Camera]
    background: tuple
    oracle: bool
    tolerance: float
    entries: int
    first: int
    seed: int
    near_ties: Callable[[int], torch.Tensor]
    say: Callable[[str], None]

    def of_view(self, **changed: Any) -> Case:
        """The first view alone, drawn in another way."""
        ties = lambda _: self.near_ties(self.first)  # noqa: E731
        return dataclasses.replace(self, cameras=[self.cameras[self.first]], first=0, near_ties=ties, **changed)

    def theirs(self, u: torch.Tensor) -> dict:
        """The rasterizer's gradient, summed over views, of poses (C, 6); None where there is none."""
        if isinstance(self.rasterizer, Dump):
            return dict(self.rasterizer.gradients)
        pairs = zip(self.cameras, u, strict=True)
        return _joined([self.rasterizer.gradient(self.raw, camera, self.background, w) for camera, w in pairs])

    def ours(self, model: ReferenceModel, u: torch.Tensor) -> dict:
        """The model's gradient, summed over views, of poses (C, 6)."""
        return _joined([model.gradient(self.raw, c, w, self.oracle) for c, w in zip(self.cameras, u, strict=True)])


def _joined(views: list[dict]) -> dict:
    """Gradients of parameters that views share are added, those of their poses are not."""
    join = dict.fromkeys(MOTIONS, torch.stack)
    return {
        name: None if x is None else join.get(name, sum)([part[name] for part in views]) for name, x in views[0].items()
    }


@dataclasses.dataclass
class Compared:
    """Images and gradients beside the model's, before anything is explained.

    Attributes:
        views: A row a view.
        agrees: Whether the images are the model's.
        u: (C, H, W, 3) cotangents, 0 at pixels that do not count.
        theirs: Gradients of the rasterizer, by group.
        groups: A row a group; of the pose only where the rasterizer has a gradient of it.
        ties: (C, H, W) bool, pixels that hang on near ties, looked for where something is to be explained.
        counted: Whether these count all the same, because next to nothing would be left.
    """

    views: list[ViewRow]
    agrees: bool
    u: torch.Tensor
    theirs: dict
    groups: dict[str, GroupRow]
    ties: torch.Tensor
    counted: bool


def compared(
    case: Case,
    model: ReferenceModel,
    signs: torch.Tensor,
    pictures: list[torch.Tensor],
    alphas: list[torch.Tensor],
    drawn: list[tuple[torch.Tensor, torch.Tensor]],
) -> Compared:
    """Two correct renderers differ where pixels hang on near ties: these are left out before a difference counts."""
    ties = torch.zeros(signs.shape[:3], dtype=torch.bool)
    counted = False
    while True:
        left = ties & (not counted)
        views = [_image_row(*row) for row in zip(case.cameras, pictures, alphas, drawn, ~left, strict=True)]
        agrees = all(_is_same(row) for row in views)
        u = signs
        if not isinstance(case.rasterizer, Dump):  # whose gradients are of its own cotangents
            off = torch.stack([(a - s).abs().amax(-1) > OFF for a, (s, _) in zip(pictures, drawn, strict=True)])
            u = signs * ~(left | (off & agrees))[..., None]
        case.say("gradients")
        theirs = case.theirs(u)
        ours = case.ours(model, u)
        # Who has a gradient of one pose of a shutter and none of the other has lost it.
        poses = any(theirs.get(name) is not None for name in MOTIONS)
        offered = [name for name, x in theirs.items() if name not in MOTIONS or poses]
        groups = {name: gradient_row(theirs[name], ours[name], case.tolerance) for name in offered}
        comparison = Compared(views, agrees, u, theirs, groups, ties, counted)
        if ties.any() or (agrees and all(row.verdict for row in groups.values())):
            return comparison
        ties = torch.stack([case.near_ties(view) for view in range(len(case.cameras))])
        counted = float((~ties).double().mean()) < LEAST
        if counted or not ties.any():
            return dataclasses.replace(comparison, ties=ties, counted=counted)


def judge(case: Case, model: ReferenceModel, compared: Compared) -> None:
    """Give every group that differs its verdict."""
    rasterizer, agrees, groups = case.rasterizer, compared.agrees, compared.groups
    if agrees:
        _explain_by_known_choices(case, model, compared)
    names = [name for name, row in groups.items() if row.verdict is None]
    if names and isinstance(rasterizer, Rasterizer):
        case.say("central differences")
        _decide(case, model if agrees else None, compared, names)
    elif names:
        verdict = "undecided"
        why = "the image is of another model, and a dump has no central differences"
        open_to = dict.fromkeys(names, 0.0)
        if agrees:
            verdict, why = "gradient bug", "the image is the model's, the gradient is not"
            # Its cotangents cannot be masked: what pixels with near ties add may be another in its order.
            tied = case.ours(model, compared.u * compared.ties[..., None])
            open_to = {name: float(tied[name].norm()) for name in names}
        for name in names:
            groups[name].settle(verdict, why)
            if groups[name].relative * groups[name].norm <= open_to[name]:
                count = int(compared.ties.sum())
                groups[name].settle(
                    "undecided", f"{count} pixels that hang on near ties could explain it; choose other views"
                )
    if compared.counted:
        share = float(compared.ties.double().mean())
        for row in groups.values():
            if row.verdict == "model difference":
                row.settle("undecided", f"{share:.0%} of the pixels hang on near ties; choose other views")


def with_errors(
    comparison: Compared,
    pictures: list[torch.Tensor],
    models: dict[str, ReferenceModel],
    draw: Callable[[ReferenceModel, int], tuple[torch.Tensor, torch.Tensor]],
) -> list[ViewRow]:
    """The rows of views, those whose image is not the model's with where it is wrong and what its error looks like.

    Patterns are looked for beside every model, since what is no convention of a renderer, such as a factor, may have
    been taken for conventions that explain a part of it. The model whose images they explain best is named.

    Args:
        comparison: That of these views.
        pictures: (H, W, 3) images of the rasterizer.
        models: Name in words -> the model; the first is the one at the rasterizer's conventions, whose pixels are
            compared.
        draw: Function of a model and a view's index: its (H, W, 3) image and (H, W) alpha.
    """
    off = [k for k, row in enumerate(comparison.views) if not _is_same(row)]
    counts = {k: (~comparison.ties[k] | comparison.counted).numpy() for k in off}
    wrong = {k: pictures[k].numpy() for k in off}
    patterns: dict[str, dict[int, Pattern]] = {}
    for name, model in models.items():
        drawn = {k: (x.numpy() for x in draw(model, k)) for k in off}
        patterns[name] = {k: pattern_of(wrong[k], *drawn[k], model.settings.background, counts[k]) for k in off}
    name = max(models, key=lambda name: sum(x.explained for x in patterns[name].values() if x.is_change))
    first = next(iter(models.values()))
    rows = list(comparison.views)
    for k in off:
        image = draw(first, k)[0].numpy()
        rows[k] = dataclasses.replace(rows[k], error=error_row(wrong[k], image, counts[k], patterns[name][k], name))
    return rows


def _is_same(row: ViewRow) -> bool:
    """Whether a view's image is the model's."""
    return row.rms <= _IMAGE_TOLERANCE and row.share <= _MAX_PIXELS_OFF


def _image_row(camera: Camera, image: torch.Tensor, alpha: torch.Tensor, drawn: tuple, counts: torch.Tensor) -> ViewRow:
    """How far two images are apart, at the pixels that count."""
    same, same_alpha = drawn
    error = (image - same).abs().amax(-1) * counts
    worst = torch.topk(error.reshape(-1), min(5, error.numel())).indices
    at = [WorstPixel(int(i) % camera.width, int(i) // camera.width, float(error.view(-1)[i])) for i in worst]
    return ViewRow(
        view=camera.name,
        rms=_mean((image - same).square().mean(-1), counts) ** 0.5,
        max=float(error.max()),
        share=_mean((error > OFF).double(), counts),
        alpha=AlphaRow(rms=_mean((alpha - same_alpha).square(), counts) ** 0.5, bias=_mean(alpha - same_alpha, counts)),
        near_ties=int((~counts).sum()),
        worst=at,
    )


def _mean(values: torch.Tensor, counts: torch.Tensor) -> float:
    return float((values * counts).sum()) / max(int(counts.sum()), 1)


def gradient_row(theirs: torch.Tensor | None, ours: torch.Tensor, tolerance: float) -> GroupRow:
    """How far two gradients are apart; `verdict` is None where that is still to be explained."""
    verdict, why = None, ""
    if theirs is None:
        theirs = torch.zeros_like(ours)
        why = "the image does not depend on it"
    finite = torch.isfinite(theirs)
    if not finite.all():
        index = [int(i) for i in torch.nonzero(~finite)[0]]
        verdict = "gradient bug"
        why = f"not finite, first at {index}"
        theirs = torch.where(finite, theirs, 0.0)
    a, b = theirs.reshape(-1), ours.reshape(-1)
    norm = float(b.norm())
    largest = float((a - b).abs().max())
    relative = float((a - b).norm()) / max(norm, 1e-12)  # of a gradient that is 0: of next to nothing
    each = (theirs - ours).reshape(len(ours), -1).norm(dim=1)
    worst = torch.topk(each, min(5, len(each))).indices
    # Both are 0 up to rounding: what is left of 1e-9 has no direction to be compared.
    if verdict is None and (relative <= tolerance or (norm < 1e-9 and largest < 1e-9)):
        verdict, why = "agreement", ""
    return GroupRow(
        verdict=verdict,
        why=why,
        worst=[WorstGaussian(int(i), float(each[i])) for i in worst],
        relative=relative,
        # Underflow, not 0, is kept from the division: the case of 0 has a branch of its own.
        cosine=float(a @ b / (a.norm() * b.norm()).clamp_min(1e-300)) if norm > 0 else float(not a.any()),
        # The same floor as of `relative`.
        bias=float(a @ b) / max(norm, 1e-12) ** 2 - 1 if norm > 0 else 0.0,
        max=largest,
        norm=norm,
    )


def _explain_by_known_choices(case: Case, model: ReferenceModel, compared: Compared) -> None:
    """Explain gradients by documented choices of rasterizers: the fewest of them that settle most groups."""
    groups, theirs = compared.groups, compared.theirs
    open_ones = [name for name, row in groups.items() if row.verdict is None and theirs[name] is not None]
    if not open_ones:
        return
    clamp = _PASSED if model.settings.alpha_max_gradient == "zero" else _ZEROED
    choices = [_DETACHED] if "sh" in case.raw and case.raw["sh"].shape[1] > 1 else []
    choices += [clamp] if model.settings.alpha_max < 1 else []
    # A convention that changes an image by less than what is looked for may show in the gradients of both poses.
    choices += [_BETWEEN] if choices[:1] == [_DETACHED] and any(c.is_rolling for c in case.cameras) else []
    best: tuple[list, tuple] = ([], ())
    for size in range(1, len(choices) + 1):
        for chosen in itertools.combinations(choices, size):
            changed = model.replace(**{k: v for c in chosen for k, v in c.change.items()})
            ours = case.ours(changed, compared.u)
            settled = [n for n in open_ones if gradient_row(theirs[n], ours[n], case.tolerance).verdict == "agreement"]
            if len(settled) > len(best[0]):
                best = settled, chosen
    for name in best[0]:
        groups[name].settle("known deviation", "; ".join(f"{c.name} ({c.where})" for c in best[1]))


def _decide(case: Case, model: ReferenceModel | None, compared: Compared, names: list[str]) -> None:
    """Compare with the rasterizer's own central differences; `model` is given if the image is its."""
    groups = compared.groups
    rasterizer = case.rasterizer
    raw = case.raw
    background = case.background
    camera, u = case.cameras[case.first], compared.u[case.first]
    gradients = rasterizer.gradient(raw, camera, background, u)
    gradients = {name: torch.zeros_like(raw[name]) if x is None else x for name, x in gradients.items()}
    expected = gradients if model is None else model.gradient(raw, camera, u)
    chosen = {name: _entries(gradients[name], expected[name], case.entries) for name in names}
    own = central(rasterizer, raw, camera, background, u, chosen)
    kept = rasterizer.gradient(raw, camera, background, u * own.kept[..., None])
    expected = None if model is None else model.gradient(raw, camera, u * own.kept[..., None])
    for name in names:
        there = torch.zeros_like(raw[name]) if kept[name] is None else kept[name]
        row = _own_row(there, None if expected is None else expected[name], own, name)
        groups[name].differences = row
        if len(own.entries[name]) < _MIN_CONVERGED:
            groups[name].settle("undecided", f"{row.left_out} of its differences did not converge")
        elif row.bug:
            groups[name].settle("gradient bug", row.what)
        else:
            why = "agrees with its own central differences"
            why += "; its image is of another model" if model is None else ", which differ from the model's gradient"
            groups[name].settle("model difference", why)


def _entries(theirs: torch.Tensor, ours: torch.Tensor, count: int) -> list[int]:
    """Flat indices at which the two differ most, and at which the gradient is largest: half of each."""
    a = torch.nan_to_num(theirs).reshape(-1)  # NaN sorts before every number: nothing else would be chosen
    b = ours.reshape(-1)
    order = [torch.argsort(x.abs(), descending=True).tolist() for x in (a - b, b)]
    return list(dict.fromkeys(order[0][: count // 2] + order[1][:count]))[:count]


def _own_row(gradient: torch.Tensor, expected: torch.Tensor | None, own: Differences, name: str) -> OwnRow:
    """A gradient, and the model's if it has the same image, against central differences at their entries."""
    values, bars = own.values[name], own.uncertainty[name]
    there = gradient.reshape(-1)[own.entries[name]]
    error = float((there - values).norm())
    size = float(values.norm())
    noise = float(bars.norm())
    ratios = there[values.abs() > 3 * bars] / values[values.abs() > 3 * bars]
    ratio = float(ratios.median()) if len(ratios) else float("nan")
    spread = float((ratios - ratio).abs().median()) if len(ratios) else float("nan")
    bug = error > _BUG_TOLERANCE * size + 3 * noise
    if expected is not None:  # a small error, too, if the differences clearly side with the model
        other = float((expected.reshape(-1)[own.entries[name]] - values).norm())
        bug |= error > 3 * max(noise, other)
    if not there.any() and bug:
        what = "it is 0, its own central differences are not"
    elif spread < 0.02 and abs(ratio - 1) > 0.02:
        what = f"it is {ratio:.3g} times its own central differences"
    else:
        # Differences that are all 0 are divided by, too.
        what = f"it is off its own central differences by {error / max(size, 1e-300):.2g} of their size"
    return OwnRow(
        entries=own.entries[name],
        central=values.tolist(),
        uncertainty=bars.tolist(),
        gradient=there.tolist(),
        relative=error / max(size, 1e-300),  # all of them 0: any error is infinitely large beside them
        left_out=own.left_out[name],
        bug=bool(bug),
        what=what,
        pixels_left_out=int((~own.kept).sum()),
    )


# -------------------------------------------------------------------------------------------------- central differences

_STEP_COUNT = 4  # steps of central differences, each half of the one before
# first step, in units of the change of a parameter that changes the image by its own norm
_FIRST_STEP = {torch.float64: 2e-3, torch.float32: 1.6e-2}
# relative rounding of an image, as renderers of that precision have it
_IMAGE_ROUNDING = {torch.float64: 1e-9, torch.float32: 2e-7}
# share of the pixels that an entry changes which must be kept for its difference to count; chosen
_MIN_PIXELS_KEPT = 0.5
_JUMP_SHARE = 0.05  # share of the largest slope that no smooth change over half a step reaches; chosen


@dataclasses.dataclass(frozen=True)
class Differences:
    """Central differences at some entries.

    Attributes:
        entries: Group -> list of flat indices that converged.
        values: Group -> central differences there of <cotangent, image>, over the pixels that are kept.
        uncertainty: Group -> error bars of `values`.
        left_out: Group -> number of entries that did not converge, or lost most of their pixels.
        kept: (H, W) bool, pixels that no step made jump.
    """

    entries: dict[str, list[int]]
    values: dict[str, torch.Tensor]
    uncertainty: dict[str, torch.Tensor]
    left_out: dict[str, int]
    kept: torch.Tensor


def central(
    rasterizer: Rasterizer,
    raw: dict,
    camera: Camera,
    background: tuple,
    cotangent: torch.Tensor,
    entries: dict[str, list[int]],
) -> Differences:
    """Central differences at chosen entries, four steps each, accumulated in float64.

    Args:
        rasterizer: The rasterizer whose image is differenced.
        raw: Raw parameters, float64.
        camera, background: The view.
        cotangent: (H, W, 3) weights of the image's values.
        entries: Group -> flat indices of the parameters that are moved.
    """
    slopes: dict[str, list[list[torch.Tensor]]] = {}
    steps: dict[str, list[list[float]]] = {}
    kept = torch.ones(cotangent.shape[:2], dtype=torch.bool)
    noise = _IMAGE_ROUNDING[rasterizer.dtype]
    for group, indices in entries.items():
        slopes[group] = []
        steps[group] = []
        for index in indices:
            differences, used = _slopes(rasterizer, raw, camera, background, group, index)
            largest = max(float(x.abs().max()) for x in differences)
            for a, b, h in zip(differences, differences[1:], used[1:], strict=False):
                kept &= ~((a - b).abs() > _JUMP_SHARE * largest + 8 * noise / h).any(-1)
            slopes[group].append(differences)
            steps[group].append(used)
    weight = cotangent * kept[..., None]
    good = {group: [] for group in entries}
    values, bars = ({group: [] for group in entries} for _ in range(2))
    left_out = dict.fromkeys(entries, 0)
    for group, indices in entries.items():
        for index, differences, used in zip(indices, slopes[group], steps[group], strict=True):
            sums = [float((weight * x).sum()) for x in differences]
            changed = differences[-1] != 0
            touched = int((changed & kept[..., None]).sum())
            if touched < _MIN_PIXELS_KEPT * int(changed.sum()):  # what is left says nothing about this entry
                left_out[group] += 1
                continue
            # Each pixel's rounding is divided by the step; random signs add up as a square root.
            bar = [noise * math.sqrt(max(touched, 1)) / h for h in used]
            value, error = _extrapolated(sums, bar)
            if value is None:
                left_out[group] += 1
                continue
            good[group].append(index)
            values[group].append(value)
            bars[group].append(error)
    return Differences(
        good,
        {group: torch.tensor(x, dtype=torch.float64) for group, x in values.items()},
        {group: torch.tensor(x, dtype=torch.float64) for group, x in bars.items()},
        left_out,
        kept,
    )


def _slopes(
    rasterizer: Rasterizer, raw: dict, camera: Camera, background: tuple, group: str, index: int
) -> tuple[list[torch.Tensor], list[float]]:
    """(I(+h) - I(-h)) / 2h for each step, as (H, W, 3), and the steps as they were after rounding."""
    first = _FIRST_STEP[rasterizer.dtype] * _unit(raw, camera, group, index)
    found, used = [], []
    for k in range(_STEP_COUNT):
        images, places = [], []
        for sign in (1, -1):
            moved = dict(raw)
            moved[group] = raw[group].clone()
            moved[group].view(-1)[index] += sign * first / 2**k
            places.append(float(moved[group].view(-1)[index].to(rasterizer.dtype)))
            images.append(rasterizer.image(moved, camera, background)[0])
        width = places[0] - places[1]
        used.append(width / 2)
        found.append((images[0] - images[1]) / width if width > 0 else torch.zeros_like(images[0]))
    # A step that rounding has taken away is 0, and is divided by: its rounding then counts for everything.
    return found, [max(h, 1e-300) for h in used]


def _unit(raw: dict, camera: Camera, group: str, index: int) -> float:
    """The change of a parameter that changes its Gaussian's part of the image by about its own size."""
    if group not in ("means", "quats", *MOTIONS):
        return 1.0
    # A step is a number: it scales what is measured and is differentiated by nothing.
    w2c = float64(camera.w2c).detach()
    scales = raw["log_scales"].exp()
    depths = raw["means"] @ w2c[2, :3] + w2c[2, 3]
    # Nothing in the image is thinner than this.
    thin = scales.amin(1).maximum(0.3 * depths.abs() / float(camera.K[0][0]))
    if group in MOTIONS:  # an angle, or a part of the depth: all Gaussians move by as much as one of them is thin
        ahead = depths > 0
        return float((thin / depths)[ahead].median()) if bool(ahead.any()) else 1.0
    i = index // raw[group].shape[1]
    if group == "means":
        return float(thin[i])
    return float(raw["quats"][i].norm()) * min(1.0, float(thin[i]) / float(scales[i].max()))


def _extrapolated(sums: list[float], bars: list[float]) -> tuple[float | None, float]:
    """The limit of central differences at h, h/2, h/4, h/8, or None where they do not converge with h^2.

    Returns:
        The best Richardson value and its uncertainty.
    """
    gaps = [abs(a - b) for a, b in zip(sums, sums[1:], strict=False)]
    best = None
    for k, (gap, bar) in enumerate(zip(gaps, bars[1:], strict=True)):
        value = sums[k + 1] + (sums[k + 1] - sums[k]) / 3
        error = gap / 3 + bar
        if best is None or error < best[1]:
            best = value, error, k
    value, error, k = best
    # An error of 1e-3 is far below what is a bug (verdicts._BUG_TOLERANCE).
    if error <= 1e-3 * abs(value) or all(gap <= 4 * bar for gap, bar in zip(gaps, bars[1:], strict=True)):
        return value, error  # settled, or below rounding on all steps
    # A gap of 0 has a logarithm, too, far from 2.
    ratios = [math.log2(max(a, 1e-300) / b) for a, b, bar in zip(gaps, gaps[1:], bars[2:], strict=False) if b > 4 * bar]
    if ratios and all(1.5 <= ratio <= 2.5 for ratio in ratios):
        return value, error
    return None, math.inf
