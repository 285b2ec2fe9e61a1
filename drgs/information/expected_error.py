"""How wrong a pixel's color is expected to be: the variance of a color from misfit, direction, information and what no
view has seen, in squared units of color.

A linear model of the images in which the noise has a variance of its own for each Gaussian and each direction from
which it is seen, instead of 1 everywhere; `docs/maths.md` derives it. Of a pixel with the weights w_i, seen from the
directions d_i, the expected squared error (mean over channels) is the sum of four variances:

    misfit       sum_i w_i (sum_v k_iv R_iv) / (n_i + 1), n_i = sum_v k_iv W_iv: squared residuals of training pixels
                 that saw Gaussian i from about this direction, and (1 - alpha) NEW_DIRECTION s_b^2 of what lies behind
    direction    sum_i w_i NEW_DIRECTION s_i^2 / (n_i + 1): from a direction in which no training view saw it, the error
                 is NEW_DIRECTION times that of the directions which were fitted
    information  OFF_DIAGONAL / 3 sum over channels and parameters k of J_pk^2 s_i(k)^2 / (H_k + 1): what noise of this
                 variance leaves open of the parameters; OFF_DIAGONAL makes up for the entries of H off its diagonal
    unseen       UNSEEN (1 - alpha)^2 t^2 / (H_c + 1): a color behind everything that no view has seen

and their sum x is calibrated: below q it becomes q (x / q)^g. The power g fits squared residuals of a training view to
the misfit and direction that the other training views predict for it; q is PIVOT times the mean of these predictions.

Of errors of another kind, such as those of labels (`residual_record`), misfit and direction are the same sums of their
residuals, information and calibration are left out, and unseen is (1 - alpha)^2 times the error without a Gaussian.

W_iv and R_iv are the sums of view v (misfit.py), k_iv = exp(-angle^2 / (2 ANGLE^2)) of the angle between the pixel's
direction and that of view v, s_i^2 = (sum_v R_iv + s^2) / (sum_v W_iv + 1) the misfit of Gaussian i, shrunk to the mean
s^2 of all of them by one pixel, s_b^2 the same of what lies behind everything, H_c the information about the cell of
the backdrop behind the pixel, and t^2 the mean squared difference of the photographs from the background.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import cropped
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.checks.records import nested, stated
from drgs.ellipsoids import Gaussians, Scene
from drgs.information.backdrop import BACKDROP, Backdrop, Sphere, backdrop_sphere
from drgs.information.diagonal import Diagonal
from drgs.information.gains import variances
from drgs.information.inputs import Masks
from drgs.information.maps import variance_map
from drgs.information.misfit import BEHIND, CONTRAST, RESIDUALS, WEIGHTS, Misfit
from drgs.information.prior import Prior, unit_length
from drgs.information.quantity import Joint, ViewContext, checked_views, once_per_time
from drgs.information.sums import Information, add
from drgs.integrator import render
from drgs.runtime import alone
from drgs.settings import RenderSettings
from drgs.tracing.call import Output
from drgs.tracing.inputs import check_view, gaussians_at

__all__ = ["PARTS", "ErrorRecord", "error_parts", "error_record", "expected_error", "residual_record"]

PARTS = ("misfit", "direction", "information", "unseen")
"""Where the expected error of a pixel comes from."""

# Chosen on half of the captures and made scenes, and measured on the other half: docs/uncertainty.md.
ANGLE = 0.1  # radians between directions at which what one says of the other has fallen to 0.6
NEW_DIRECTION = 2.0  # squared error from a new direction / that from directions that were fitted
OFF_DIAGONAL = 6.0  # variance of a pixel / that by the diagonal of H alone
UNSEEN = 0.6  # squared error where no Gaussian is / the mean squared difference of photographs from the background
PIVOT = 2.5  # squared error from which on all stay as they are, over the mean that training views expect of each other
_PRIOR = Prior(1.0)  # lambda: what one pixel that is wholly the parameter's says; of positions in a length of the scene
_MOST_PLACES = 64  # places that directions are known from; views beyond share the nearest one, so that a record of any
# number of views has at most 512 bytes a Gaussian
_BYTES = 64 << 20  # bytes of the angles that are held at once
# One of three views calibrates, by a quarter of its pixels; 16 at most, 128 bytes a Gaussian while a record is made.
_CALIBRATING = 1 / 3
_MOST_CALIBRATING = 16
_FEWEST_VIEWS = 3  # of two, what one says of the other is too little to calibrate by
_POWERS = (0.25, 1.6)  # what a power is held within: the runs that constants were chosen on have 0.29 to 1.56
_AS_IT_IS = (1.0, 1.0)  # pivot and power that change nothing
_EVEN = 1e-6  # standard deviation of logarithms of what is all the same but for rounding
_HALVINGS = 20  # of that range, for a power known to 2e-6


@dataclasses.dataclass(frozen=True)
class ErrorRecord:
    """What training views say about errors: what `expected_error` needs of them, as `error_record` makes it.

    Attributes:
        settings: Settings with which the views were rendered, and which maps are rendered with.
        views: Number of the views.
        places: (P, 3) float64 camera centers, world frame; of more than 64, means of those that are close together.
        weights: (N, P) float32 sum of w over the pixels of the views from a place, in pixels.
        residuals: (N, P) float32 sum of w times the squared residual (mean over channels), squared units of color.
        behind: (2,) float64, both sums for what lies behind everything, with weights 1 - alpha.
        contrast: (2,) float64 number of pixels, and sum of their squared differences from the background, or of what
            their residuals are where nothing is said.
        information: Group -> float64, that of the views about Gaussians and backdrop, as of `drgs.fisher`; empty of
            residuals that are not those of colors.
        sphere: What the backdrop is painted on; None: nothing is said about it.
        length: World units that positions count in beside a prior, of the views (`drgs.gain.unit_length`).
        pivot, power: The calibration: of a pixel whose parts add up to x, min(x / pivot, 1)^(power - 1) x is expected.
            Pivot in squared units of color.
    """

    settings: RenderSettings
    views: int
    places: torch.Tensor
    weights: torch.Tensor
    residuals: torch.Tensor
    behind: torch.Tensor
    contrast: torch.Tensor
    information: Information
    sphere: Sphere | None
    length: float
    pivot: float = 1.0
    power: float = 1.0

    @property
    def mean_misfit(self) -> float:
        """Mean squared residual of all pixels, weighed by how much of them Gaussians and what lies behind are."""
        pixels = float(self.weights.double().sum() + self.behind[0])
        return float(self.residuals.double().sum() + self.behind[1]) / pixels if pixels else 0.0

    @property
    def misfit(self) -> torch.Tensor:
        """(N,) float64 s_i^2, squared units of color: mean squared residual where a Gaussian is seen, shrunk to that of
        all by one pixel. Its root is an error in units of color.
        """
        return (self.residuals.double().sum(1) + self.mean_misfit) / (self.weights.double().sum(1) + 1)

    @property
    def misfit_behind(self) -> float:
        """The same of what lies behind everything."""
        return float((self.behind[1] + self.mean_misfit) / (self.behind[0] + 1))

    @property
    def of_gaussians(self) -> torch.Tensor:
        """(N,) float64 squared error that is expected of a pixel which shows one Gaussian alone, from where the
        photographs do: `misfit` and `direction` of all views as from one direction. Where many pixels show it, it is
        their mean squared residual, and where none does, that of a new direction.
        """
        pixels = self.weights.double().sum(1)
        total = (self.residuals.double().sum(1) + NEW_DIRECTION * self.misfit) / (pixels + 1)
        return total * self.calibration(total)

    def calibration(self, total: torch.Tensor) -> torch.Tensor:
        """What sums of the parts are multiplied by, so that training views expect of each other what they show."""
        return torch.where(total > 0, (total / self.pivot).clamp(max=1) ** (self.power - 1), 1.0)

    def scaled(self, factor: float) -> ErrorRecord:
        """The record as if there were `factor` times as many views: all sums and the information are multiplied."""
        sums = {name: getattr(self, name) * factor for name in ("weights", "residuals", "behind", "contrast")}
        information = {name: x * factor for name, x in self.information.items()}
        return dataclasses.replace(self, views=round(self.views * factor), information=information, **sums)

    def to_state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Tensors, and what else a file has to hold as JSON, of which `from_state` makes the record again."""
        tensors = {name: getattr(self, name) for name in ("places", "weights", "residuals", "behind", "contrast")}
        tensors |= {f"information.{name}": x for name, x in self.information.items()}
        sphere = None if self.sphere is None else dataclasses.asdict(self.sphere)
        settings = dataclasses.asdict(self.settings)
        numbers = {name: getattr(self, name) for name in ("views", "length", "pivot", "power")}
        return tensors, {**numbers, "settings": settings, "sphere": sphere}

    @classmethod
    def from_state(cls, tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any]) -> ErrorRecord:
        """The record that `to_state` gave these."""
        begin = "information."
        information = {name.removeprefix(begin): x for name, x in tensors.items() if name.startswith(begin)}
        sphere = header["sphere"]
        return cls(
            settings=nested(RenderSettings, None, stated(RenderSettings, header["settings"], "ErrorRecord")),
            views=header["views"],
            information=information,
            sphere=None if sphere is None else Sphere(tuple(sphere["center"]), sphere["radius"]),
            length=header["length"],
            pivot=header["pivot"],
            power=header["power"],
            **{name: x for name, x in tensors.items() if not name.startswith(begin)},
        )


@alone
def error_record(
    scene: Scene,
    cameras: Camera | Sequence[Camera],
    images: torch.Tensor | Sequence[torch.Tensor],
    settings: RenderSettings | None = None,
    *,
    masks: Masks = None,
    sphere: Sphere | None = None,
    advance: Callable[[], None] = lambda: None,
) -> ErrorRecord:
    """What training views and their photographs say about the errors of a scene: made once, for any number of maps.

        record = drgs.error_record(g, cameras, photographs)
        error = drgs.expected_error(g, camera, record).sqrt()  # (H, W), units of color

    It costs what the views' information costs, whose traversal finds the residuals of Gaussians on its way. Of three or
    more views it is calibrated: a quarter of every third, of 16 at most, is rendered once more, with the errors that
    the other views say it has.

    Args:
        scene: N Gaussians, world frame, or a `drgs.ellipsoids.Scene`, whose Gaussians each camera sees at its time.
            Where they move, directions are those from a place to where a Gaussian is when it is looked at.
        cameras: One or several training views.
        images: (H, W, 3) of each camera, as the scene should look in it, in [0, 1]: the photograph on the background of
            the settings, without the exposure and white balance of its own where a fit has estimated them.
        settings: Default `RenderSettings.preset("exact")`.
        masks: One for each camera, (H, W) in [0, 1], which weighs its pixels; or None: 1.
        sphere: What the colors behind everything are painted on, as `drgs.fisher.backdrop_sphere` makes it; None: that
            of the cameras.
        advance: Called after each view.
    Raises:
        ValueError: If there is no view, or images or masks are not of the cameras' sizes, or not finite.
    """
    where = "error_record"
    scene = once_per_time(scene)
    cameras, each, shown = checked_views(where, scene, cameras, settings, masks)
    photographs = _checked_images(where, images, cameras)
    sphere = sphere or backdrop_sphere(scene, cameras)
    parts = (("", Diagonal(without=("features",), of_gaussians=True)), ("", Backdrop(sphere)), ("", Misfit()))
    views = [
        ViewContext(scene, camera, own, mask, photograph=image)
        for camera, own, mask, image in zip(cameras, each, shown, photographs, strict=True)
    ]
    chosen = _calibrating(len(views))
    record, others = _record_of(where, views, Joint(parts), sphere, chosen, advance)
    pixels = [_foretold(views[k], told, turn) for turn, (k, told) in enumerate(zip(chosen, others, strict=True))]
    pivot, power = _calibration(pixels) if pixels else _AS_IT_IS
    return dataclasses.replace(record, pivot=pivot, power=power)


@alone
def residual_record(
    scene: Scene,
    cameras: Camera | Sequence[Camera],
    residuals: torch.Tensor | Sequence[torch.Tensor],
    empty_residual: float,
    settings: RenderSettings | None = None,
    *,
    masks: Masks = None,
    advance: Callable[[], None] = lambda: None,
) -> ErrorRecord:
    """What training views say about errors of another kind than those of colors, for `expected_error`.

    A residual is any number >= 0 of a pixel: 1 where its label is wrong, so that the expected error of a pixel is the
    probability that its label is, or the squared residual of its feature. The record says nothing about parameters: its
    maps have the parts `misfit`, `direction` and `unseen`, which is (1 - alpha)^2 `empty_residual`; the
    part `information` is 0. It is not calibrated, so that it is too even: what is small is expected too large.

    Args:
        scene, cameras, settings, masks, advance: The same as for `error_record`.
        residuals: (H, W) of each camera, in squared units of whatever they are residuals of.
        empty_residual: Mean residual, in the same units, of a prediction without any Gaussian: of labels the most
            frequent one, of features 0.
    Raises:
        ValueError: If there is no view, residuals or masks are not of the cameras' sizes, or a residual, or
            `empty_residual`, is negative or not finite.
    """
    where = "residual_record"
    scene = once_per_time(scene)
    cameras, each, shown = checked_views(where, scene, cameras, settings, masks)
    values = _checked_residuals(where, residuals, cameras)
    if not (isinstance(empty_residual, int | float) and 0 <= empty_residual < math.inf):
        raise ArgumentError(
            f"{where}: empty_residual must be a finite number >= 0, got {empty_residual!r}; pass a mean residual"
        )
    views = [
        ViewContext(scene, camera, own, mask, residual=residual)
        for camera, own, mask, residual in zip(cameras, each, shown, values, strict=True)
    ]
    record, _ = _record_of(where, views, Joint((("", Misfit()),)), None, [], advance)
    pixels = float(sum(x.numel() for x in values))
    return dataclasses.replace(record, contrast=torch.tensor([pixels, pixels * empty_residual], dtype=torch.float64))


def _record_of(
    where: str,
    views: Sequence[ViewContext],
    quantity: Joint,
    sphere: Sphere | None,
    left_out: Sequence[int],
    advance: Callable[[], None],
) -> tuple[ErrorRecord, Iterator[ErrorRecord]]:
    """The record of views of one scene, and what all views but one of them say of misfit, for some of them: one at a
    time, since each is as large as the record.

    Args:
        where: What errors begin with.
        views: The views, with photographs or residuals.
        quantity: What is computed of each: its misfit, and information if any.
        sphere: What the backdrop is painted on; None: nothing is said about it.
        left_out: Numbers of these views.
        advance: Called after each view.
    """
    if not any(float(view.mask.sum()) > 0 if view.mask is not None else True for view in views):
        raise ValueError(f"{where}: masks must leave a pixel whose residual counts, got none above 0; pass other views")
    cameras = [view.camera for view in views]
    places, place_of = _grouped(np.stack([camera.center for camera in cameras]))
    count = len(gaussians_at(where, views[0].scene, cameras[0]))
    columns = {name: torch.zeros(count, len(places)) for name in (WEIGHTS, RESIDUALS)}
    total: dict[str, torch.Tensor] = {}
    own_sums: dict[int, dict[str, torch.Tensor]] = {view: {} for view in left_out}
    for number, (view, place) in enumerate(zip(views, place_of, strict=True)):
        if len(view.gaussians) != count:
            raise ValueError(
                f"{where}: a scene must have as many Gaussians in all views, got {count} in the first and "
                f"{len(view.gaussians)} in cameras[{number}]; take views of one time"
            )
        found = quantity.summand(quantity.compute(view), view.camera, view.mask)
        view.shared_sums.clear()  # which hold buffers of the traversal
        if number in own_sums:
            own_sums[number] = {name: found[name].clone() for name in (WEIGHTS, RESIDUALS, BEHIND)}
        for name, by_place in columns.items():
            by_place[:, place] += found.pop(name)
        add(total, found)
        advance()
    record = ErrorRecord(
        settings=views[0].settings,
        views=len(views),
        places=torch.from_numpy(places),
        weights=columns[WEIGHTS],
        residuals=columns[RESIDUALS],
        behind=total.pop(BEHIND),
        contrast=total.pop(CONTRAST, torch.zeros(2, dtype=torch.float64)),
        information=total,
        sphere=sphere,
        length=unit_length(views[0].scene, cameras),
    )
    return record, (_without(record, place_of[number], sums) for number, sums in own_sums.items())


@alone
def expected_error(scene: Scene, camera: Camera, record: ErrorRecord) -> torch.Tensor:
    """(H, W) float32: the expected squared error of each pixel's color, mean over channels, in squared units of color.

    Its root is an error in units of color; its mean over a view's pixels, the mean squared error that is expected of
    the view. It is the sum of `drgs.information.expected_error.error_parts`, which say why; nothing is differentiated.

    Args:
        scene: The scene of the record.
        camera: The view; it needs no photograph.
        record: What training views say about errors, by `drgs.error_record`.
    Raises:
        ValueError: If the scene has another number of Gaussians than that of the record.
    """
    return torch.stack(list(error_parts(scene, camera, record).values())).sum(0)


@alone
def error_parts(scene: Scene, camera: Camera, record: ErrorRecord) -> dict[str, torch.Tensor]:
    """`expected_error` by where it comes from: each of `PARTS` -> (H, W) float32, squared units of color.

    `misfit` has its remedy in the fit (steps, Gaussians, exposure, poses), `direction` in photographs of the same from
    this direction, `information` in more photographs of it, `unseen` in photographs of what none shows.

    Args:
        scene, camera, record: The same as for `expected_error`.
    """
    where = "expected_error"
    scene = once_per_time(scene)
    seen = gaussians_at(where, scene, camera)
    must_be(where, "record", record, ErrorRecord, "what drgs.error_record returns")
    check_view(where, seen, camera, record.settings)
    if len(seen) != len(record.weights):
        raise ValueError(
            f"{where}: scene must be that of the record, with {len(record.weights)} Gaussians, got {len(seen)}; make a "
            "record of this scene"
        )
    seen = seen.detach()
    (misfit, direction), out = _noise(seen.replace(sh=seen.sh[:, :1]), camera, record)
    view = ViewContext(scene, camera, record.settings, known_opacity=out.alpha.cpu())
    parts = {"misfit": misfit, "direction": direction, **_left_open(view, record)}
    total = torch.stack(list(parts.values())).sum(0)
    factor = record.calibration(total)
    return {name: x * factor for name, x in parts.items()}


def _left_open(view: ViewContext, record: ErrorRecord) -> dict[str, torch.Tensor]:
    """(H, W) each, the parts `information` and `unseen` of a view before they are calibrated."""
    if not record.information:
        unseen = (1 - view.opacity).square() * _difference(record)
        return {"information": torch.zeros_like(unseen), "unseen": unseen}
    weights = variances(record.information, _PRIOR.over(record.length))
    behind = weights.pop(BACKDROP) * (UNSEEN * _difference(record) / 3)
    scale = OFF_DIAGONAL / 3 * record.misfit
    weights = {name: x * scale.reshape(-1, *[1] * (x.dim() - 1)) for name, x in weights.items()}
    return {
        "information": variance_map(view, weights),
        "unseen": variance_map(view, {BACKDROP: behind}, sphere=record.sphere),
    }


def _noise(seen: Gaussians, camera: Camera, record: ErrorRecord) -> tuple[tuple[torch.Tensor, torch.Tensor], Output]:
    """(H, W) each, the parts `misfit` and `direction` of a view before they are calibrated, and the rendering of the
    Gaussians that they come with.
    """
    values = torch.stack(_by_direction(seen, camera, record), 1).to(seen.means.device, torch.float32)
    with torch.no_grad():  # a map is a number a pixel
        out = render(seen.replace(features=values), camera, record.settings, outputs=())
    assert out.features is not None  # two channels were given
    fitted, new = out.features.cpu().unbind(2)
    return (fitted + (1 - out.alpha.cpu()).clamp(min=0) * (NEW_DIRECTION * record.misfit_behind), new), out


def _calibrating(views: int) -> list[int]:
    """Evenly spaced views by which a record of so many is calibrated."""
    count = min(_MOST_CALIBRATING, math.ceil(views * _CALIBRATING)) if views >= _FEWEST_VIEWS else 0
    return [int((k + 0.5) * views / count) for k in range(count)]


def _without(record: ErrorRecord, place: int, own: Information) -> ErrorRecord:
    """What all views but one, from a place, say of misfit."""
    columns = {}
    for name, field in ((WEIGHTS, "weights"), (RESIDUALS, "residuals")):
        columns[field] = getattr(record, field).clone()
        columns[field][:, place] = (columns[field][:, place] - own[name]).clamp(min=0)  # but for rounding it is
    return dataclasses.replace(record, behind=(record.behind - own[BEHIND]).clamp(min=0), **columns)


def _foretold(view: ViewContext, others: ErrorRecord, turn: int) -> torch.Tensor:
    """(3, P) float64 of the pixels of a quarter of a view: the noise that other views expect, squared residual, weight.

    Args:
        view: The view.
        others: The record of the others.
        turn: Which quarter; from corner to corner.
    """
    camera = view.camera
    width, height = -(-camera.width // 2), -(-camera.height // 2)
    x, y = turn % 2 * (camera.width - width), turn // 2 % 2 * (camera.height - height)
    part = slice(y, y + height), slice(x, x + width)
    noise, out = _noise(view.gaussians.detach(), cropped(camera, x, y, width, height), others)
    assert view.photograph is not None  # calibrated is what is about colors
    squared = (out.rgb.cpu().clamp(0, 1) - view.photograph[part].cpu()).square().mean(2)
    weight = torch.ones_like(squared) if view.mask is None else view.mask[part].cpu()
    return torch.stack([noise[0] + noise[1], squared, weight]).double().flatten(1)


def _calibration(pixels: Sequence[torch.Tensor]) -> tuple[float, float]:
    """Pivot and power of a record, by how squared residuals e go with the noise n that other views expect.

    Of exponential variables e with means a n^g, the best a given, minus the mean log-likelihood is log(mean(e n^-g)) +
    g mean(log n) but for a constant. That is convex in g, and its slope's zero is found by halving.

    Args:
        pixels: (3, P) n, e and weight of the pixels of each view; each view counts as much.
    Returns:
        Both; where there is nothing to be found, those that change nothing.
    """
    share = torch.cat([x[2] / x[2].sum().clamp(min=1e-9) for x in pixels])
    expected, squared, _ = torch.cat(list(pixels), 1)
    keep = (expected > 0) & (share > 0)
    share, expected, squared = (x[keep] for x in (share, expected, squared))
    share = share / share.sum()
    mean = float((share * expected).sum())
    logs = (expected / mean).log()
    if not len(logs) or float(logs.std(correction=0)) < _EVEN or not bool((share * squared).sum() > 0):
        return _AS_IT_IS  # nothing is shown, or all is expected to be as wrong, or nothing is wrong
    low, high = _POWERS
    for _ in range(_HALVINGS):
        power = (low + high) / 2
        likely = share * squared * torch.exp(-power * logs)
        slope = float((share * logs).sum() - (likely * logs).sum() / likely.sum())
        low, high = (low, power) if slope > 0 else (power, high)
    return PIVOT * mean, power


def _difference(record: ErrorRecord) -> float:
    """t^2: mean squared difference of the photographs from the background."""
    pixels, squares = record.contrast.tolist()
    return squares / pixels if pixels else 0.0


def _by_direction(seen: Gaussians, camera: Camera, record: ErrorRecord) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) float64 each: what training pixels from about this direction say of a Gaussian's squared error, and what is
    left to the prior of a new direction; their sum is its variance from there.
    """
    # Relative to the Gaussians' origin, as their means are: far from 0 nothing is rounded away.
    means = seen.means.double().cpu()
    places = record.places - torch.from_numpy(seen.origin)
    towards = torch.nn.functional.normalize(means - torch.from_numpy(camera.center - seen.origin), dim=1)
    fitted, pixels = (torch.zeros(len(means), dtype=torch.float64) for _ in range(2))
    rows = max(1, _BYTES // (8 * 3 * max(1, len(places))))
    for start in range(0, len(means), rows):
        part = slice(start, start + rows)
        known = torch.nn.functional.normalize(means[part, None] - places, dim=2)
        # Of the chord, which is exact for small angles, where the cosine is 1 to rounding.
        angle = 2 * torch.asin(((known - towards[part, None]).norm(dim=2) / 2).clamp(max=1))
        near = torch.exp(-0.5 * (angle / ANGLE).square())
        fitted[part] = (near * record.residuals[part]).sum(1)
        pixels[part] = (near * record.weights[part]).sum(1)
    return fitted / (pixels + 1), NEW_DIRECTION * record.misfit / (pixels + 1)


def _grouped(centers: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """(P, 3) places of (V, 3) camera centers, and the place of each: all centers that differ, or 64 means of those that
    are nearest to the same of 64 that are far from each other (farthest point sampling from the first).
    """
    chosen = [0]
    distance = np.linalg.norm(centers - centers[0], axis=1)
    place = np.zeros(len(centers), np.int64)
    while len(chosen) < _MOST_PLACES and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        from_here = np.linalg.norm(centers - centers[chosen[-1]], axis=1)
        place[from_here < distance] = len(chosen) - 1
        distance = np.minimum(distance, from_here)
    return np.stack([centers[place == k].mean(0) for k in range(len(chosen))]), place.tolist()


def _checked_residuals(where: str, residuals: Any, cameras: Sequence[Camera]) -> list[torch.Tensor]:
    """A map for each camera; `ArgumentError` for another number of them, another size, or what is no number >= 0."""
    maps = _one_each(where, "residuals", residuals, cameras, (), "(H, W) >= 0")
    for index, residual in enumerate(maps):
        if not residual.is_floating_point():
            raise ArgumentError(f"{where}: residuals[{index}] must be floats, got {residual.dtype}; use .float()")
        if not bool((torch.isfinite(residual) & (residual >= 0)).all()):
            raise ArgumentError(
                f"{where}: residuals[{index}] must be finite and >= 0, got {float(residual.min()):g} to "
                f"{float(residual.max()):g}; pass squared residuals"
            )
    return maps


def _checked_images(where: str, images: Any, cameras: Sequence[Camera]) -> list[torch.Tensor]:
    """An image for each camera; `ArgumentError` for another number of them, another size or what is not finite."""
    photographs = _one_each(where, "images", images, cameras, (3,), "(H, W, 3) in [0, 1]")
    for index, image in enumerate(photographs):
        if not image.is_floating_point() or not bool(torch.isfinite(image).all()):
            raise ArgumentError(
                f"{where}: images[{index}] must be finite floats in [0, 1], got {image.dtype} or NaN or Inf; divide "
                "bytes by 255"
            )
    return photographs


def _one_each(
    where: str, name: str, given: Any, cameras: Sequence[Camera], channels: tuple[int, ...], hint: str
) -> list[torch.Tensor]:
    """A tensor (H, W, *channels) for each camera, or one of a single camera by itself; `ArgumentError` for others."""
    given = [given] if isinstance(given, torch.Tensor) and given.dim() == 2 + len(channels) else given
    if not isinstance(given, list | tuple | torch.Tensor) or len(given) != len(cameras):
        got = str(len(given)) if isinstance(given, list | tuple | torch.Tensor) else kind_of(given)
        raise ArgumentError(
            f"{where}: {name} must be a list with one for each of {len(cameras)} cameras, got {got}; pass theirs"
        )
    for index, (values, camera) in enumerate(zip(given, cameras, strict=True)):
        must_be(where, f"{name}[{index}]", values, torch.Tensor, hint)
        size = (camera.height, camera.width, *channels)
        if tuple(values.shape) != size:
            raise ArgumentError(
                f"{where}: {name}[{index}] must be {size} like its camera, got {tuple(values.shape)}; resize either"
            )
    return list(given)
