"""What a rasterizer may do differently, as variations of a model that we can render, and the search for those it does.

A `Model` is a preset and what is unusual about it: the order of quaternions, where pixels are, what is done to
opacities, and so on. Each variation is a change of our renderer's input, settings or output, differentiable as the
rest, so that gradients can be compared at the conventions that were found.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import torch

from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.oracle import activate, screen_rows
from drgs.settings import RenderSettings

__all__ = ["LEAST", "Finding", "Found", "Model", "find"]

_SH0 = math.sqrt(1 / (4 * math.pi))
_SHARE = 0.3  # of the remaining difference that a variation must explain to be named
_ORDERS = ("rgb", "bgr", "rbg", "grb", "gbr", "brg")
_WINDOW = 16  # pixels a side
_NEAR = 2e-6  # of the distance: some ten times what float32 loses where it computes a depth
_EFFECT = 1e-5  # of a weight: what moves less moves no gradient by what counts
LEAST = 0.1  # of the pixels: fewer that are without near ties say nothing
_COMPENSATION_FLOOR = 0.005**2  # of the ratio of determinants


@dataclasses.dataclass(frozen=True)
class Model:
    """A preset and what is unusual about it.

    Attributes:
        settings: Response, order, cut-offs, background.
        quaternions: `wxyz`, or `xyzw`: how the four numbers are read.
        rotation: `as given`, or `transposed`.
        scales: `linear`, or `exponential`: exp is applied to what already is a standard deviation.
        opacities: `linear`, or `sigmoid`: the logistic function is applied to what already is an opacity.
        compensation: `none`, or opacities times sqrt(det / det after dilation) as in anti-aliased modes: `full`, or `at
            least 0.005`.
        direction: Where SH are evaluated: `to the mean`, `to the camera` (the opposite), or `camera frame` (to the
            mean, in camera axes). Along each pixel's ray is `settings.sh_direction`.
        direction_gradient: Whether the mean gets a gradient through that direction.
        sh_degree: Bands above it are left out.
        sh_sign: Coefficients whose sign is turned: `none`, `odd m` (a basis without the factor (-1)^m), or a band.
        channels: Order of the color channels of the image, or of the Gaussians' colors alone (`bgr, not behind`).
        transfer: `none`, or `sRGB to linear`: applied to the finished image, or to what is in front of the background
            (`sRGB to linear, not behind`).
        pixel_center: Of column 0 and row 0.
        flip: `none`, `vertical`, `horizontal`.
        pose: `w2c`, or `c2w`: how the camera matrix is read.
    """

    settings: RenderSettings
    quaternions: str = "wxyz"
    rotation: str = "as given"
    scales: str = "linear"
    opacities: str = "linear"
    compensation: str = "none"
    direction: str = "to the mean"
    direction_gradient: bool = True
    sh_degree: int = 3
    sh_sign: str = "none"
    channels: str = "rgb"
    transfer: str = "none"
    pixel_center: tuple[float, float] = (0.5, 0.5)
    flip: str = "none"
    pose: str = "w2c"

    def draw(self, raw: dict, camera: Camera, oracle: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """Image (H, W, 3) and alpha (H, W), differentiable by torch with respect to the raw parameters.

        Args:
            raw: Raw parameters by group, float64.
            camera: Pinhole.
            oracle: By the float64 oracle instead of the renderer.
        """
        rows: dict[int, list] = {}
        for (y, _), image, alpha in self._pieces(raw, camera, oracle):
            rows.setdefault(y, []).append(torch.cat([image, alpha[..., None]], -1))
        whole = self._flipped(torch.cat([torch.cat(row, 1) for row in rows.values()]))
        return whole[..., :3], whole[..., 3]

    def gradient(self, raw: dict, camera: Camera, cotangent: torch.Tensor, oracle: bool = False) -> dict:
        """float64 gradient of <cotangent, image> by group."""
        leaves = {name: x.detach().clone().requires_grad_() for name, x in raw.items()}
        total = {name: torch.zeros_like(x) for name, x in raw.items()}
        cotangent = self._flipped(cotangent)  # of what is not flipped yet
        # One piece at a time: what autograd keeps of it is freed before the next one is drawn.
        for (y, x), image, _ in self._pieces(leaves, camera, oracle):
            if image.requires_grad:
                loss = (image * cotangent[y : y + image.shape[0], x : x + image.shape[1]]).sum()
                found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True, retain_graph=True)
                for name, slope in zip(leaves, found, strict=True):
                    total[name] += 0 if slope is None else slope.double()
        return total

    def near_ties(self, raw: dict, camera: Camera) -> torch.Tensor:
        """(H, W) bool: pixels that hang on what float32 cannot tell, by the float64 oracle.

        Two Gaussians whose depths are as good as equal, or a hit or a ray on the very edge of a cut-off, as
        `drgs.reference` marks them `ambiguous`: two correct renderers differ there, the gradient more than the image.
        """
        camera = self._camera(camera)
        found = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        with torch.no_grad():
            g = Gaussians(**self._parameters(raw, camera))
            for x, y, width, height in _windows(camera):
                window = (x, y, width, height)
                out = reference.render(
                    g, camera, self.settings, tolerance=_NEAR, window=window, exact_ties=True, effect=_EFFECT
                )
                found[y : y + height, x : x + width] = out.ambiguous
        return self._flipped(found)

    def _pieces(self, raw: dict, camera: Camera, oracle: bool) -> Iterator[tuple]:
        """The image before it is flipped, in pieces: (row, column) of its corner, image and alpha."""
        camera = self._camera(camera)
        g = Gaussians(**self._parameters(raw, camera))
        if not oracle:
            yield ((0, 0), *self._developed(render(g, camera, self.settings, outputs=())))
            return
        for x, y, width, height in _windows(camera):
            window = (x, y, width, height)
            yield ((y, x), *self._developed(reference.render(g, camera, self.settings, window=window)))

    def _developed(self, out) -> tuple[torch.Tensor, torch.Tensor]:
        """Image and alpha, float64, with this model's channels and transfer function."""
        image, alpha = out.rgb.double(), out.alpha.double()
        if self.channels in _ORDERS:
            image = image[..., ["rgb".index(c) for c in self.channels]]
        if self.transfer != "none":
            behind = 0.0
            if self.transfer.endswith("behind"):
                behind = (1 - alpha[..., None]) * torch.tensor(self.settings.background, dtype=torch.float64)
            image = _linear(image - behind) + behind
        return image, alpha

    def _flipped(self, picture: torch.Tensor) -> torch.Tensor:
        return picture if self.flip == "none" else picture.flip(("vertical", "horizontal").index(self.flip))

    def replace(self, **fields) -> Model:
        """A copy with fields, or fields of the settings, replaced."""
        own = {k: v for k, v in fields.items() if k in {f.name for f in dataclasses.fields(self)}}
        rest = {k: v for k, v in fields.items() if k not in own}
        settings = own.pop("settings", self.settings)
        return dataclasses.replace(self, settings=settings.replace(**rest), **own)

    def _camera(self, camera: Camera) -> Camera:
        K = np.array(camera.K, float)
        K[:2, 2] += 0.5 - np.asarray(self.pixel_center)
        w2c = camera.w2c
        w2c = w2c.detach().double().numpy() if isinstance(w2c, torch.Tensor) else np.array(w2c, float)
        return dataclasses.replace(camera, K=K, w2c=np.linalg.inv(w2c) if self.pose == "c2w" else w2c)

    def _parameters(self, raw: dict, camera: Camera) -> dict:
        raw = dict(raw)
        if self.quaternions == "xyzw":
            raw["quats"] = raw["quats"][:, [3, 0, 1, 2]]
        if self.rotation == "transposed":
            raw["quats"] = raw["quats"] * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
        if self.scales == "exponential":
            raw["log_scales"] = raw["log_scales"].exp()
        if self.opacities == "sigmoid":
            raw["logit_opacities"] = raw["logit_opacities"].sigmoid()
        if self.compensation != "none" and self.settings.dilation > 0:
            floor = 1e-12 if self.compensation == "full" else _COMPENSATION_FLOOR
            alpha = raw["logit_opacities"].sigmoid() * _compensation(raw, camera, self.settings, floor)
            raw["logit_opacities"] = torch.logit(alpha.clamp(1e-12, 1 - 1e-12))
        raw["sh"] = self._sh(raw, camera)
        if self.channels not in _ORDERS:
            raw["sh"] = raw["sh"][..., ["rgb".index(c) for c in self.channels[:3]]]
        return raw

    def _sh(self, raw: dict, camera: Camera) -> torch.Tensor:
        """Coefficients that give the colors of this model: as they are, or of degree 0 where the direction is odd."""
        sh = raw["sh"]
        orders = [(degree, m) for degree in range(4) for m in range(-degree, degree + 1)][: sh.shape[1]]
        factor = torch.tensor([float(degree <= self.sh_degree) for degree, _ in orders], dtype=torch.float64)
        turned = [m % 2 == 1 if self.sh_sign == "odd m" else self.sh_sign == f"band {degree}" for degree, m in orders]
        factor = torch.where(torch.tensor(turned), -factor, factor)
        if not bool((factor == 1).all()):
            sh = sh * factor[:, None]
        if (self.direction == "to the mean" and self.direction_gradient) or sh.shape[1] == 1:
            return sh
        center = torch.tensor(camera.center)
        means = raw["means"] if self.direction_gradient else raw["means"].detach()
        towards = means - center
        towards = towards / towards.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        if self.direction == "to the camera":
            towards = -towards
        elif self.direction == "camera frame":
            towards = towards @ torch.tensor(camera.w2c[:3, :3]).T
        color = 0.5 + (reference.sh_basis(towards, sh.shape[1])[..., None] * sh).sum(1)
        return ((color - 0.5) / _SH0)[:, None]  # the renderer clamps at 0 as ever


def _windows(camera: Camera) -> Iterator[tuple[int, int, int, int]]:
    """(x, y, width, height) of squares that cover the image: the oracle takes of each the Gaussians that it can see."""
    for y in range(0, camera.height, _WINDOW):
        for x in range(0, camera.width, _WINDOW):
            yield x, y, min(_WINDOW, camera.width - x), min(_WINDOW, camera.height - y)


def _compensation(raw: dict, camera: Camera, s: RenderSettings, floor: float) -> torch.Tensor:
    """(N,) sqrt(det Sigma' / det(Sigma' + dilation I)) of the projected covariances, as Mip-Splatting has it."""
    w2c = torch.tensor(camera.w2c)
    x, y, z = (raw["means"] @ w2c[:3, :3].T + w2c[:3, 3]).unbind(-1)
    z = torch.where(z > 1e-6, z, 1e-6)
    axes = activate(SimpleNamespace(**raw, features=None), s).axes
    a, b = screen_rows(x, y, z, camera, s.fov_clamp, w2c[:3, :3], axes).unbind(1)
    det = torch.linalg.cross(a, b).square().sum(-1)
    trace = (a * a + b * b).sum(-1)
    ratio = det / (det + s.dilation * (trace + s.dilation))
    return ratio.clamp_min(floor).sqrt()


def _linear(x: torch.Tensor) -> torch.Tensor:
    """Linear light of sRGB values."""
    return torch.where(x <= 0.04045, x / 12.92, ((x.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)


# ---------------------------------------------------------------------------------------- search


@dataclasses.dataclass(frozen=True)
class Finding:
    """A convention that differs.

    Attributes:
        name: What it is about, e.g. `quaternion order`.
        expected, found: The preset's and the rasterizer's.
        without, with_it: RMS of the image's difference if everything but this, or everything, is taken into account.
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
    "channels": ("channel order", ("sh",), (*_ORDERS, *(f"{order}, not behind" for order in _ORDERS[1:]))),
    "transfer": ("transfer function", ("sh",), ("none", "sRGB to linear", "sRGB to linear, not behind")),
    "direction": ("SH direction", ("means", "sh"), ("to the mean", "to the camera", "camera frame")),
    "sh_direction": ("SH direction", ("means", "sh"), ("gaussian", "ray")),
    "sh_degree": ("SH bands", ("sh",), (0, 1, 2, 3)),
    "sh_sign": ("SH sign", ("sh",), ("none", "odd m", "band 1", "band 2", "band 3")),
    "background": ("background", ("logit_opacities",), ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))),
    "compensation": ("dilation compensation", ("logit_opacities", *_SHAPE), ("none", "full", "at least 0.005")),
    "depth_key": ("depth sort key", _ALL, ("z", "distance")),
    "fov_clamp": ("field-of-view clamp", _SHAPE, ("none", "inria", "gsplat")),
    "culling": ("culling", _ALL, ("extent", "inria", "gsplat")),
    "near": ("near plane", _ALL, (0.0, 0.01, 0.1, 0.2)),
    "stop": ("stop rule", _ALL, ("after", "before", "before_eq")),
    "dilation": ("dilation", _SHAPE, (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)),
    "alpha_min": ("alpha_min", _ALL, (0.0, 1e-4, 1e-3, 1 / 255, 1e-2, 0.05)),
    "alpha_max": ("alpha_max", ("logit_opacities",), (0.9, 0.95, 0.99, 0.999, 0.9999, 1.0)),
    "transmittance_min": ("transmittance_min", _ALL, (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.05, 0.1)),
}
_FITTED = ("dilation", "alpha_min", "alpha_max", "transmittance_min")  # refined around the best value


def find(
    image: torch.Tensor,
    starts: list[Model],
    draw: Callable[[Model], torch.Tensor],
    near_ties: Callable[[Model], torch.Tensor],
    settled: float = 1e-5,
) -> Found:
    """The model whose image is nearest to a given one, and what is unusual about it.

    Variations are added one at a time, each time the one that explains most of what is left, as long as that is at
    least 30 %; what a later one makes needless is dropped. Where an image is not the nearest start's at once, pixels
    that hang on near ties of that start do not count: a tie that fell the other way must not be taken for an order.

    Args:
        image: (H, W, 3) of the rasterizer.
        starts: Models that may be meant: the claimed one, or one a preset. What differs is counted from the one that
            needs least.
        draw: Model -> its (H, W, 3) image of that view.
        near_ties: Model -> (H, W) bool.
        settled: RMS below which two images are one: what their rounding does.
    """
    known: dict[Model, torch.Tensor] = {}
    counts = torch.ones(image.shape[:2], dtype=torch.bool)

    def distance(model: Model) -> float:
        if model not in known:
            known[model] = (draw(model) - image).square().mean(-1)
        return float(known[model][counts].mean().sqrt())

    start = min(starts, key=distance)
    if distance(start) > settled:
        counts = _countable(near_ties(start))
    model = _descend(distance, start, start, settled)
    odd = [field for field in _different(model, start) if not hasattr(model, field) and field != "background"]
    for other in starts if odd or distance(model) > settled else ():
        # Beside a gross difference the nearest preset need not be the right one.
        moved = dataclasses.replace(model, settings=other.settings.replace(background=model.settings.background))
        if other != start and distance(moved) < 2 * distance(start):
            moved = _descend(distance, moved, other, settled)
            few, many = (len(_different(*pair)) for pair in ((moved, other), (model, start)))
            near, far = max(distance(moved), settled), max(distance(model), settled)
            if near < 0.8 * far or (near <= 1.1 * far and few < many):
                model, start = moved, other
    findings = []
    for field in _different(model, start):
        name, groups, _ = _VARIATIONS[field]
        usual = _get(start, field)
        without = distance(model.replace(**{field: usual}))
        findings.append(Finding(name, _text(usual), _text(_get(model, field)), without, distance(model), groups))
    return Found(start, model, distance(start), distance(model), findings)


def _countable(ties: torch.Tensor) -> torch.Tensor:
    """Pixels to be compared: those without near ties, or all where there would be next to none."""
    return ~ties if float((~ties).double().mean()) >= LEAST else torch.ones_like(ties)


@dataclasses.dataclass(frozen=True)
class Found:
    """What `find` found.

    Attributes:
        start, model: The preset, and the model with what is unusual.
        before, after: RMS of the image's difference to each of them.
        findings: What differs between the two.
    """

    start: Model
    model: Model
    before: float
    after: float
    findings: list[Finding]


def _descend(distance: Callable[[Model], float], model: Model, start: Model, settled: float) -> Model:
    """Add variations while they explain much, then drop those that `start` does without as well."""
    while distance(model) > settled:
        tried = list(_variations(model))
        best = min(distance(new) for new, _ in tried)
        # Of those that explain as much, the first one listed: what differs then is rounding.
        new, field = next(pair for pair in tried if distance(pair[0]) <= max(1.001 * best, settled))
        if distance(new) > (1 - _SHARE) * distance(model):
            break
        model = _refined(distance, new, field, settled) if field in _FITTED else new
    for field in _different(model, start):
        without = model.replace(**{field: _get(start, field)})
        if distance(without) <= 1.05 * max(distance(model), settled):
            model = without
    return model


def _variations(model: Model) -> Iterator[tuple[Model, str]]:
    """Everything that is one step away and legal."""
    for field, (_, _, values) in _VARIATIONS.items():
        for value in values:
            if value == _get(model, field):
                continue
            try:
                yield model.replace(**{field: value}), field
            except NotImplementedError:  # not with this response or order
                continue


def _refined(distance, model: Model, field: str, settled: float) -> Model:
    """The number that fits best, by golden section on a logarithmic scale around the one that was tried."""
    value = _get(model, field)
    flip = field == "alpha_max"  # what matters there is the distance from 1
    if distance(model) <= settled or value == float(flip):
        return model
    center, ratio = math.log(1 - value if flip else value), (math.sqrt(5) - 1) / 2
    low, high = center - 1.0, min(center + 1.0, -1e-3)

    def at(x: float) -> Model:
        return model.replace(**{field: 1 - math.exp(x) if flip else math.exp(x)})

    for _ in range(12):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        if distance(at(a)) < distance(at(b)):
            high = b
        else:
            low = a
    new = at((low + high) / 2)
    # The round number is kept unless another one is clearly nearer.
    return new if distance(new) < 0.5 * distance(model) else model


def _get(model: Model, field: str):
    return getattr(model if hasattr(model, field) else model.settings, field)


def _different(model: Model, start: Model) -> list[str]:
    return [field for field in _VARIATIONS if _get(model, field) != _get(start, field)]


def _text(value) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
