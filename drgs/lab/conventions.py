"""The search for the conventions that a rasterizer has: variations of a model, until its image is the rasterizer's."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, get_args, get_type_hints

import torch

from drgs.lab.reference_model import BETWEEN, DISTORTIONS, ORDERS, ReferenceModel
from drgs.settings import RenderSettings
from drgs.shutters import SHUTTERS

__all__ = ["LEAST", "Finding", "Found", "find"]

_SHARE = 0.3  # share of the remaining difference that a variation must explain to be named
LEAST = 0.1  # share of the pixels: fewer that are without near ties say nothing


@dataclasses.dataclass(frozen=True)
class Finding:
    """A convention that differs.

    Attributes:
        name: Name of the convention, e.g. `quaternion order`.
        expected: Value that the preset has.
        found: Value that the rasterizer has.
        without: RMS of the image's difference if everything but this is taken into account.
        with_it: RMS of the image's difference if everything is.
        groups: Raw parameters whose gradient it changes most directly.
    """

    name: str
    expected: str
    found: str
    without: float
    with_it: float
    groups: tuple[str, ...]


_SHAPE = ("quats", "log_scales")
_ALL = ("means", *_SHAPE, "logit_opacities", "sh")
_CULLINGS = get_args(get_type_hints(RenderSettings)["culling"])
# exp(-extent^2 / 2) = 0.0113 is the least density that 3DGRUT counts, and gsplat along rays.
_DENSITY_CUTOFF = math.sqrt(-2 * math.log(0.0113))
_POINTS = tuple((x, y) for x in (0.5, 0.0, 1.0) for y in (0.5, 0.0, 1.0))
# Field of the model or of its settings -> (name, groups, values to be tried).
_VARIATIONS: dict[str, tuple[str, tuple, tuple]] = {
    "quaternions": ("quaternion order", ("quats",), ("wxyz", "xyzw")),
    "rotation": ("rotation", ("quats",), ("as given", "transposed")),
    "scales": ("activation of scales", ("log_scales",), ("linear", "exponential")),
    "opacities": ("activation of opacities", ("logit_opacities",), ("linear", "sigmoid")),
    "pixel_center": ("pixel center", _ALL, _POINTS),
    "flip": ("image axes", _ALL, ("none", "vertical", "horizontal")),
    "pose": ("camera matrix", _ALL, ("w2c", "c2w")),
    "channels": ("channel order", ("sh",), (*ORDERS, *(f"{order}, not behind" for order in ORDERS[1:]))),
    "transfer": ("transfer function", ("sh",), ("none", "sRGB to linear", "sRGB to linear, not behind")),
    "direction": ("SH direction", ("means", "sh"), ("to the mean", "to the camera", "camera frame", BETWEEN)),
    "sh_direction": ("SH direction", ("means", "sh"), ("gaussian", "ray")),
    "sh_degree": ("SH bands", ("sh",), (0, 1, 2, 3)),
    "sh_sign": ("SH sign", ("sh",), ("none", "odd m", "band 1", "band 2", "band 3")),
    "background": ("background", ("logit_opacities",), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))),
    "compensation": ("dilation compensation", ("logit_opacities", *_SHAPE), ("none", "full", "at least 0.005")),
    "depth_key": ("depth sort key", _ALL, ("z", "distance")),
    "fov_clamp": ("field-of-view clamp", _SHAPE, ("none", "inria", "gsplat")),
    "culling": ("culling", _ALL, _CULLINGS),
    "near": ("near plane", _ALL, (0.0, 0.01, 0.1, 0.2)),
    "stop": ("stop rule", _ALL, ("after", "before", "before_eq")),
    "dilation": ("dilation", _SHAPE, (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)),
    "alpha_min": ("alpha_min", _ALL, (0.0, 1e-4, 1e-3, 1 / 255, 1e-2, 0.05)),
    "alpha_max": ("alpha_max", ("logit_opacities",), (0.9, 0.95, 0.99, 0.999, 0.9999, 1.0)),
    "transmittance_min": ("transmittance_min", _ALL, (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.1)),
    "extent": ("extent", _ALL, (None, 3.33, 3.0, _DENSITY_CUTOFF, 2.5, 2.0)),
    "distortion": ("lens distortion", _ALL, tuple(DISTORTIONS)),
    "shutter": ("shutter", _ALL, SHUTTERS),
    "ray_direction": ("ray direction in a Gaussian's frame", _ALL, ("normalized", "not normalized")),
    "peaks": ("peaks that count", _ALL, ("in front", "everywhere")),
    "response": ("response", _ALL, ("peak", "ewa")),
}
# What else a response has or cannot have: taken with it, and no findings of their own.
_COMPANIONS: dict[str, dict[str, Any]] = {
    "peak": {"dilation": 0.0, "fov_clamp": "none", "culling": "extent", "extent": None},
    "ewa": {"dilation": 0.3, "fov_clamp": "gsplat", "culling": "gsplat", "extent": None},
}
_FITTED = ("dilation", "alpha_min", "alpha_max", "transmittance_min")  # refined around the best value


def find(
    image: torch.Tensor,
    starts: list[ReferenceModel],
    draw: Callable[[ReferenceModel], torch.Tensor],
    near_ties: Callable[[ReferenceModel], torch.Tensor],
    settled: float = 1e-5,
    suits: Callable[[ReferenceModel], bool] = lambda model: True,
) -> Found:
    """The model whose image is nearest to a given one, and what is unusual about it.

    Variations are added one at a time, each time the one that explains most of what is left, as long as that is at
    least 30 %; what a later one makes needless is dropped. Where an image is not the nearest start's at once, pixels
    that hang on near ties of that start do not count: a tie that fell the other way must not be taken for an order.

    Args:
        image: (H, W, 3) image of the rasterizer.
        starts: Models that may be meant: the claimed one, or one a preset. What differs is counted from the one that
            needs least.
        draw: Function of a model: its (H, W, 3) image of that view.
        near_ties: Function of a model: (H, W) bool, the pixels that hang on near ties.
        settled: RMS below which two images are one: what their rounding does.
        suits: Function of a model: whether the view can be drawn of it, and by no simpler one.
    """
    # Where starts differ in their response, the nearest start says which it is.
    fixed = {"response"} if len({start.settings.response for start in starts}) > 1 else set()

    def legal(model: ReferenceModel, field: str) -> bool:
        return field not in fixed and suits(model)

    known: dict[ReferenceModel, torch.Tensor] = {}
    counts = torch.ones(image.shape[:2], dtype=torch.bool)

    def distance(model: ReferenceModel) -> float:
        if model not in known:
            known[model] = (draw(model) - image).square().mean(-1)
        return float(known[model][counts].mean().sqrt())

    start = min(starts, key=distance)
    if distance(start) > settled:
        counts = _countable(near_ties(start))
    model = _descend(distance, legal, start, start, settled)
    odd = [field for field in _different(model, start) if not hasattr(model, field) and field != "background"]
    for other in starts if odd or distance(model) > settled else ():
        # Beside a gross difference the nearest preset need not be the right one.
        moved = dataclasses.replace(model, settings=other.settings.replace(background=model.settings.background))
        if other != start and suits(moved) and distance(moved) < 2 * distance(start):
            moved = _descend(distance, legal, moved, other, settled)
            few, many = (len(_different(*pair)) for pair in ((moved, other), (model, start)))
            near, far = max(distance(moved), settled), max(distance(model), settled)
            if near < 0.8 * far or (near <= 1.1 * far and few < many):
                model, start = moved, other
    findings = []
    for field in _different(model, start):
        name, groups, _ = _VARIATIONS[field]
        usual = _usual(model, start, field)
        changed = _changed(model, field, usual, start)
        without = distance(changed if suits(changed) else start)
        findings.append(Finding(name, _text(usual), _text(_get(model, field)), without, distance(model), groups))
    return Found(start, model, distance(start), distance(model), findings)


def _countable(ties: torch.Tensor) -> torch.Tensor:
    """Pixels to be compared: those without near ties, or all where there would be next to none."""
    return ~ties if float((~ties).double().mean()) >= LEAST else torch.ones_like(ties)


@dataclasses.dataclass(frozen=True)
class Found:
    """What `find` found.

    Attributes:
        start: The preset.
        model: The preset with what is unusual.
        before: RMS of the image's difference to `start`.
        after: RMS of the image's difference to `model`.
        findings: What differs between the two.
    """

    start: ReferenceModel
    model: ReferenceModel
    before: float
    after: float
    findings: list[Finding]


def _descend(
    distance: Callable[[ReferenceModel], float],
    legal: Callable[[ReferenceModel, str], bool],
    model: ReferenceModel,
    start: ReferenceModel,
    settled: float,
) -> ReferenceModel:
    """Add variations while they explain much, then drop those that `start` does without as well."""
    while distance(model) > settled:
        tried = [pair for pair in _variations(model, start) if legal(*pair)]
        best = min(distance(new) for new, _ in tried)
        # Of those that explain as much, the first one listed: what differs then is rounding.
        new, field = next(pair for pair in tried if distance(pair[0]) <= max(1.001 * best, settled))
        if distance(new) > (1 - _SHARE) * distance(model):
            break
        model = _refined(distance, new, field, settled) if field in _FITTED else new
    for field in _different(model, start):
        without = _changed(model, field, _usual(model, start, field), start)
        if legal(without, field) and distance(without) <= 1.05 * max(distance(model), settled):
            model = without
    return model


def _variations(model: ReferenceModel, start: ReferenceModel) -> Iterator[tuple[ReferenceModel, str]]:
    """Everything that is one step away and legal."""
    for field, (_, _, values) in _VARIATIONS.items():
        for value in values:
            if value == _get(model, field):
                continue
            try:
                yield _changed(model, field, value, start), field
            except NotImplementedError:  # not with this response or order
                continue


def _refined(
    distance: Callable[[ReferenceModel], float], model: ReferenceModel, field: str, settled: float
) -> ReferenceModel:
    """The number that fits best, by golden section on a logarithmic scale around the one that was tried."""
    value = _get(model, field)
    flip = field == "alpha_max"  # what matters there is the distance from 1
    if distance(model) <= settled or value == float(flip):
        return model
    center = math.log(1 - value if flip else value)
    ratio = (math.sqrt(5) - 1) / 2
    # What is searched for stays below 1.
    low = center - 1.0
    high = min(center + 1.0, -1e-3)

    def at(x: float) -> ReferenceModel:
        return model.replace(**{field: 1 - math.exp(x) if flip else math.exp(x)})

    for _ in range(12):
        a = high - ratio * (high - low)
        b = low + ratio * (high - low)
        if distance(at(a)) < distance(at(b)):
            high = b
        else:
            low = a
    new = at((low + high) / 2)
    # The round number is kept unless another one is clearly nearer.
    return new if distance(new) < 0.5 * distance(model) else model


def _get(model: ReferenceModel, field: str) -> Any:
    return getattr(model if hasattr(model, field) else model.settings, field)


def _changed(model: ReferenceModel, field: str, value: Any, start: ReferenceModel) -> ReferenceModel:
    """A model with a field changed, and with what belongs to a response where it is that."""
    if field != "response":
        return model.replace(**{field: value})
    names = _COMPANIONS["peak"]
    mine = value == start.settings.response
    return model.replace(response=value, **{k: _get(start, k) if mine else _COMPANIONS[value][k] for k in names})


def _usual(model: ReferenceModel, start: ReferenceModel, field: str) -> Any:
    """The value of a field that is no finding: the start's, or what another response than its has."""
    response = model.settings.response
    if response != start.settings.response and field in _COMPANIONS.get(response, {}):
        return _COMPANIONS[response][field]
    return _get(start, field)


def _different(model: ReferenceModel, start: ReferenceModel) -> list[str]:
    return [field for field in _VARIATIONS if _get(model, field) != _usual(model, start, field)]


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
