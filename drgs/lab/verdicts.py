"""What a rasterizer's image and gradients are beside a model's, and what explains the difference: verdicts of groups.

Pixels that hang on near ties, where two correct renderers differ, are left out before a difference counts; then known
deviations explain what they can, and the rasterizer's own central differences decide the rest.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import torch

from drgs.cameras import Camera
from drgs.lab.conventions import LEAST
from drgs.lab.differences import Differences, central
from drgs.lab.dumps import Dump
from drgs.lab.image_errors import OFF, Pattern, error_row, pattern_of
from drgs.lab.rasterizers import Rasterizer
from drgs.lab.raw import MOTIONS
from drgs.lab.reference_model import BETWEEN, ReferenceModel
from drgs.lab.rows import AlphaRow, GroupRow, OwnRow, ViewRow, WorstGaussian, WorstPixel

__all__ = ["Case", "Compared", "compared", "judge", "with_errors"]

_FEW = 0.01  # share of the pixels: so few that are off hang on a cut-off or on the order, and are left out
_IMAGE = 1e-3  # RMS of images that agree
_ENOUGH = 3  # converged differences that a verdict needs
_OWN = 0.02  # relative difference from its own central differences that is a bug


@dataclasses.dataclass(frozen=True)
class Deviation:
    """A difference of gradients that is made on purpose.

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
    """What is compared, and how: arguments of `crossval`; `first` is the view that is asked for differences."""

    rasterizer: Rasterizer | Dump
    raw: dict
    cameras: list[Camera]
    background: tuple
    oracle: bool
    tolerance: float
    entries: int
    first: int
    say: Callable[[str], None]

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
    near_ties: Callable[[int], torch.Tensor],
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
        groups = {name: _group_row(theirs[name], ours[name], case.tolerance) for name in offered}
        found = Compared(views, agrees, u, theirs, groups, ties, counted)
        if ties.any() or (agrees and all(row.verdict for row in groups.values())):
            return found
        ties = torch.stack([near_ties(view) for view in range(len(case.cameras))])
        counted = float((~ties).double().mean()) < LEAST
        if counted or not ties.any():
            return dataclasses.replace(found, ties=ties, counted=counted)


def judge(case: Case, model: ReferenceModel, compared: Compared) -> None:
    """Give every group that differs its verdict."""
    rasterizer, agrees, groups = case.rasterizer, compared.agrees, compared.groups
    if agrees:
        _known(case, model, compared)
    names = [name for name, row in groups.items() if row.verdict is None]
    if names and isinstance(rasterizer, Rasterizer):
        case.say("central differences")
        _decide(case, model if agrees else None, compared, names)
    elif names:
        verdict = "undecided"
        why = "the image is of another model, a dump cannot be asked for central differences"
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
    found: Compared,
    pictures: list[torch.Tensor],
    models: dict[str, ReferenceModel],
    draw: Callable[[ReferenceModel, int], tuple[torch.Tensor, torch.Tensor]],
) -> list[ViewRow]:
    """The rows of views, those whose image is not the model's with where it is wrong and what its error looks like.

    Patterns are looked for beside every model, since what is no convention of a renderer, such as a factor, may have
    been taken for conventions that explain a part of it. The model whose images they explain best is named.

    Args:
        found: The comparison of these views.
        pictures: (H, W, 3) images of the rasterizer.
        models: Name in words -> the model; the first is the one at the rasterizer's conventions, whose pixels are
            compared.
        draw: Function of a model and a view's index: its (H, W, 3) image and (H, W) alpha.
    """
    off = [k for k, row in enumerate(found.views) if not _is_same(row)]
    counts = {k: (~found.ties[k] | found.counted).numpy() for k in off}
    wrong = {k: pictures[k].numpy() for k in off}
    seen: dict[str, dict[int, Pattern]] = {}
    for name, model in models.items():
        drawn = {k: (x.numpy() for x in draw(model, k)) for k in off}
        seen[name] = {k: pattern_of(wrong[k], *drawn[k], model.settings.background, counts[k]) for k in off}
    name = max(models, key=lambda name: sum(x.explained for x in seen[name].values() if x.is_change))
    first = next(iter(models.values()))
    rows = list(found.views)
    for k in off:
        image = draw(first, k)[0].numpy()
        rows[k] = dataclasses.replace(rows[k], error=error_row(wrong[k], image, counts[k], seen[name][k], name))
    return rows


def _is_same(row: ViewRow) -> bool:
    """Whether a view's image is the model's."""
    return row.rms <= _IMAGE and row.share <= _FEW


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


def _group_row(theirs: torch.Tensor | None, ours: torch.Tensor, tolerance: float) -> GroupRow:
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
        # Underflow, not 0, is kept from the division: the case of 0 is told apart.
        cosine=float(a @ b / (a.norm() * b.norm()).clamp_min(1e-300)) if norm > 0 else float(not a.any()),
        # The same floor as of `relative`.
        bias=float(a @ b) / max(norm, 1e-12) ** 2 - 1 if norm > 0 else 0.0,
        max=largest,
        norm=norm,
    )


def _known(case: Case, model: ReferenceModel, compared: Compared) -> None:
    """Explain what documented choices explain: the fewest of them that settle most groups."""
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
            settled = [n for n in open_ones if _group_row(theirs[n], ours[n], case.tolerance).verdict == "agreement"]
            if len(settled) > len(best[0]):
                best = settled, chosen
    for name in best[0]:
        groups[name].settle("known deviation", "; ".join(f"{c.name} ({c.where})" for c in best[1]))


def _decide(case: Case, model: ReferenceModel | None, compared: Compared, names: list[str]) -> None:
    """Ask the rasterizer's own central differences; `model` is given if the image is its."""
    groups = compared.groups
    rasterizer = case.rasterizer
    raw = case.raw
    background = case.background
    camera, u = case.cameras[case.first], compared.u[case.first]
    found = rasterizer.gradient(raw, camera, background, u)
    found = {name: torch.zeros_like(raw[name]) if x is None else x for name, x in found.items()}
    wanted = found if model is None else model.gradient(raw, camera, u)
    chosen = {name: _entries(found[name], wanted[name], case.entries) for name in names}
    own = central(rasterizer, raw, camera, background, u, chosen)
    kept = rasterizer.gradient(raw, camera, background, u * own.kept[..., None])
    wanted = None if model is None else model.gradient(raw, camera, u * own.kept[..., None])
    for name in names:
        there = torch.zeros_like(raw[name]) if kept[name] is None else kept[name]
        row = _own_row(there, None if wanted is None else wanted[name], own, name)
        groups[name].differences = row
        if len(own.entries[name]) < _ENOUGH:
            groups[name].settle("undecided", f"{row.left_out} of its differences did not converge")
        elif row.bug:
            groups[name].settle("gradient bug", row.what)
        else:
            why = "agrees with its own central differences"
            why += "; its image is of another model" if model is None else ", which differ from the model's gradient"
            groups[name].settle("model difference", why)


def _entries(theirs: torch.Tensor, ours: torch.Tensor, count: int) -> list[int]:
    """Flat indices at which the two differ most, and at which the gradient is largest: half of each."""
    a = torch.nan_to_num(theirs).reshape(-1)  # NaN sorts before every number: nothing else would be looked at
    b = ours.reshape(-1)
    order = [torch.argsort(x.abs(), descending=True).tolist() for x in (a - b, b)]
    return list(dict.fromkeys(order[0][: count // 2] + order[1][:count]))[:count]


def _own_row(gradient: torch.Tensor, wanted: torch.Tensor | None, own: Differences, name: str) -> OwnRow:
    """A gradient, and the model's if it has the same image, against central differences at their entries."""
    values, bars = own.values[name], own.uncertainty[name]
    there = gradient.reshape(-1)[own.entries[name]]
    error = float((there - values).norm())
    size = float(values.norm())
    noise = float(bars.norm())
    ratios = there[values.abs() > 3 * bars] / values[values.abs() > 3 * bars]
    ratio = float(ratios.median()) if len(ratios) else float("nan")
    spread = float((ratios - ratio).abs().median()) if len(ratios) else float("nan")
    bug = error > _OWN * size + 3 * noise
    if wanted is not None:  # a small error, too, if the differences clearly side with the model
        other = float((wanted.reshape(-1)[own.entries[name]] - values).norm())
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
