"""The conventions that a rasterizer may have: variations of a model that we can render, and the search for its own.

A `ReferenceModel` is a preset and what is unusual about it: the order of quaternions, where pixels are, what is done to
opacities, and so on. Each variation is a change of our renderer's input, settings or output, differentiable as the
rest, so that gradients can be compared at the rasterizer's conventions. `find` varies a model until its image is the
rasterizer's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, get_args, get_type_hints

import numpy as np
import torch

from drgs import reference
from drgs.cameras import Camera, rigid
from drgs.cameras.shutters import SHUTTERS
from drgs.display.srgb import linear_from_srgb
from drgs.ellipsoids import Y_00
from drgs.integrator import render
from drgs.lab.accuracy import gradient_by
from drgs.lab.parameters import COLORS, gaussians_of, image_of, posed
from drgs.oracle import activate, float64, rolling_poses, screen_rows
from drgs.settings import RenderSettings

ORDERS = ("rgb", "bgr", "rbg", "grb", "gbr", "brg")
BETWEEN = "to the mean, from between both poses"  # as gsplat has it
# What may be made of OpenCV's (k1, k2, p1, p2, k3, ...): name -> the coefficients that it amounts to.
DISTORTIONS = {
    "as given": lambda k1, k2, p1, p2, *rest: (k1, k2, p1, p2, *rest),
    "ignored": lambda *given: (0.0,) * len(given),
    "tangential terms negated": lambda k1, k2, p1, p2, *rest: (k1, k2, -p1, -p2, *rest),
    "tangential terms swapped": lambda k1, k2, p1, p2, *rest: (k1, k2, p2, p1, *rest),
    "no tangential terms": lambda k1, k2, p1, p2, *rest: (k1, k2, 0.0, 0.0, *rest),
    "in the order k1, k2, k3, p1, p2": lambda k1, k2, p1, p2, *rest: (k1, k2, *_later(p1, p2, *rest)),
}
_ORACLE_WINDOW = 16  # pixels a side of the squares that the oracle draws one at a time, to bound its memory
# (pixel, Gaussian) pairs of a view that are drawn densely where our renderer lacks a convention
_DENSE_PAIRS = 4_000_000
# relative difference of depths that counts as a tie: some ten times float32's rounding where it computes a depth
_NEAR_TIE = 2e-6
_MIN_WEIGHT_CHANGE = 1e-5  # change of a compositing weight; a smaller one moves no gradient by what counts. Chosen
_COMPENSATION_FLOOR = 0.005**2  # smallest ratio of determinants: gsplat's smallest factor, squared


@dataclasses.dataclass(frozen=True)
class ReferenceModel:
    """A preset and the conventions in which a model differs from it.

    Attributes:
        settings: Response, order, cut-offs and background.
        quaternions: Order in which the four numbers are read, `wxyz` or `xyzw`.
        rotation: Whether the rotation is taken `as given` or `transposed`.
        scales: `linear`, or `exponential`: exp is applied to what already is a standard deviation.
        opacities: `linear`, or `sigmoid`: the logistic function is applied to what already is an opacity.
        compensation: `none`, or opacities times sqrt(det / det after dilation) as in anti-aliased modes: `full`, or `at
            least 0.005`.
        direction: Direction that SH are evaluated in: `to the mean`, `to the camera` (the opposite), or `camera frame`
            (to the mean, in camera axes). Along each pixel's ray is `settings.sh_direction`. Of a rolling shutter it
            starts at the center of the pose in the middle of the exposure, or at the point between the centers of both
            poses (`BETWEEN`).
        direction_gradient: Whether the mean gets a gradient through that direction.
        sh_degree: Largest SH degree that counts; bands above it are left out.
        sh_sign: Coefficients whose sign is turned: `none`, `odd m` (a basis without the factor (-1)^m), or a band.
        channels: Order of the color channels of the image, or of the Gaussians' colors alone (`bgr, not behind`).
        transfer: `none`, or `sRGB to linear`: applied to the finished image, or to what is in front of the background
            (`sRGB to linear, not behind`).
        pixel_center: Coordinates of the center of column 0 and row 0, in pixels.
        flip: How the image is mirrored: `none`, `vertical`, `horizontal`.
        pose: How the camera matrix is read, `w2c` or `c2w`.
        ray_direction: The direction of a ray in a Gaussian's own frame: `normalized`, or `not normalized`, where
            rho^2 = |d' x o'|^2 is not divided by |d'|^2.
        peaks: Whether peaks of Gaussians count `in front` of the ray's origin only, or `everywhere`.
        distortion: What is made of the coefficients of a lens: `as given`, or one of the others of `DISTORTIONS`.
        shutter: Direction of a rolling shutter: `as given`, or one of `drgs.cameras.shutters.SHUTTERS`.
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
    ray_direction: str = "normalized"
    peaks: str = "in front"
    distortion: str = "as given"
    shutter: str = "as given"

    def suits(self, camera: Camera, count: int) -> bool:
        """Whether a view of so many Gaussians can be drawn of this model, and needs each of its conventions.

        False where a simpler model draws the same: a lens is of cameras that have one, a shutter of those that move,
        and where a ray meets a Gaussian of rays.
        """
        if self.settings.planar and (camera.is_distorted or camera.is_rolling):
            return False
        if self.distortion != "as given" and not self._reads(camera):
            return False
        if self.direction == BETWEEN and not camera.is_rolling:
            return False
        if self.shutter != "as given" and (not camera.is_rolling or self.shutter == camera.shutter):
            return False
        pairs = camera.width * camera.height * count
        return not self._needs_oracle or (self.settings.response == "peak" and pairs <= _DENSE_PAIRS)

    @property
    def _needs_oracle(self) -> bool:
        """Whether a ray meets Gaussians as in none of our renderers: the oracle draws that, every pair of a view."""
        return (self.ray_direction, self.peaks) != ("normalized", "in front")

    def _reads(self, camera: Camera) -> bool:
        """Whether the coefficients of this lens mean something else in this model."""
        if camera.model == "opencv_fisheye":  # which has no tangential terms
            return self.distortion in ("as given", "ignored") and any(camera.distortion)
        return camera.is_distorted and _distorted(self.distortion, camera.distortion) != tuple(camera.distortion)

    def draw(self, raw: dict, camera: Camera, oracle: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """Image (H, W, 3) and alpha (H, W), differentiable by torch with respect to the raw parameters.

        Args:
            raw: Raw parameters by group, float64, and maybe a motion of the camera, `viewmats`. With `colors` (N, D)
                instead of `sh` the image has D channels, on black.
            camera: Camera, with a lens where the response is along rays.
            oracle: Whether the float64 oracle draws instead of the renderer.
        """
        rows: dict[int, list] = {}
        for (y, _), image, alpha in self._pieces(raw, camera, oracle):
            rows.setdefault(y, []).append(torch.cat([image, alpha[..., None]], -1))
        whole = self._flipped(torch.cat([torch.cat(row, 1) for row in rows.values()]))
        return whole[..., :-1], whole[..., -1]

    def gradient(self, raw: dict, camera: Camera, cotangent: torch.Tensor, oracle: bool = False) -> dict:
        """float64 gradient of <cotangent, image> by group."""
        # New leaves: gradients are to end at these, whatever the raw parameters were made of.
        leaves = {name: x.detach().clone().requires_grad_() for name, x in raw.items()}
        total = {name: torch.zeros_like(x) for name, x in raw.items()}
        cotangent = self._flipped(cotangent)  # of what is not flipped yet
        # One piece at a time: what autograd keeps of it is freed before the next one is drawn.
        for (y, x), image, _ in self._pieces(leaves, camera, oracle):
            loss = (image * cotangent[y : y + image.shape[0], x : x + image.shape[1]]).sum()
            for name, slope in gradient_by(loss, leaves, retain_graph=True).items():
                total[name] += slope.double()
        return total

    def near_ties(self, raw: dict, camera: Camera) -> torch.Tensor:
        """(H, W) bool: pixels whose order float32 cannot resolve, by the float64 oracle.

        Two Gaussians whose depths are as good as equal, or a hit or a ray on the very edge of a cut-off, as
        `drgs.reference` marks them `ambiguous`: two correct renderers differ there, the gradient more than the image.
        """
        camera = self._camera(camera)
        ties = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        with torch.no_grad():  # marks of pixels have no derivative
            g, _ = gaussians_of(self._parameters(raw, camera))
            for x, y, width, height in _windows(camera, self._needs_oracle):
                window = None if self._needs_oracle else (x, y, width, height)
                out = reference.render(
                    g,
                    camera,
                    self.settings,
                    tolerance=_NEAR_TIE,
                    window=window,
                    exact_ties=True,
                    effect=_MIN_WEIGHT_CHANGE,
                    **self._oracle_arguments(),
                )
                ties[y : y + height, x : x + width] = out.ambiguous
        return self._flipped(ties)

    def _pieces(self, raw: dict, camera: Camera, oracle: bool) -> Iterator[tuple]:
        """The image before it is flipped, in pieces: (row, column) of its corner, image and alpha."""
        camera = self._camera(posed(raw, camera))
        g, shift = gaussians_of(self._parameters(raw, camera))
        settings = self.settings.replace(background=(0.0, 0.0, 0.0)) if COLORS in raw else self.settings
        for x, y, width, height in _windows(camera, whole=self._needs_oracle or not oracle):
            if self._needs_oracle:
                out = reference.render(g, camera, settings, **self._oracle_arguments())
            elif oracle:
                out = reference.render(g, camera, settings, window=(x, y, width, height))
            else:
                out = render(g, camera, settings, outputs=())
            yield ((y, x), *self._developed(image_of(out, raw, shift), out.alpha))

    def _oracle_arguments(self) -> dict[str, bool]:
        """Arguments of the oracle for what our renderer does not have."""
        return {
            "plain_directions": self.ray_direction != "normalized",
            "peaks_behind": self.peaks != "in front",
        }

    def _developed(self, image: torch.Tensor, alpha: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Image and alpha, float64, with this model's channels and transfer function."""
        image, alpha = image.double(), alpha.double()
        if image.shape[-1] == 3 and self.channels in ORDERS:
            image = image[..., ["rgb".index(c) for c in self.channels]]
        if self.transfer != "none":
            background = 0.0
            if self.transfer.endswith("behind"):
                background = (1 - alpha[..., None]) * torch.tensor(self.settings.background, dtype=torch.float64)
            image = linear_from_srgb(image - background) + background
        return image, alpha

    def _flipped(self, picture: torch.Tensor) -> torch.Tensor:
        return picture if self.flip == "none" else picture.flip(("vertical", "horizontal").index(self.flip))

    def replace(self, **fields) -> ReferenceModel:
        """A copy with fields, or fields of the settings, replaced."""
        own = {k: v for k, v in fields.items() if k in {f.name for f in dataclasses.fields(self)}}
        rest = {k: v for k, v in fields.items() if k not in own}
        settings = own.pop("settings", self.settings)
        return dataclasses.replace(self, settings=settings.replace(**rest), **own)

    def _camera(self, camera: Camera) -> Camera:
        """What this model reads of a camera; a torch pose keeps its graph."""
        K = np.array(camera.K, float)
        K[:2, 2] += 0.5 - np.asarray(self.pixel_center)
        poses = {"w2c": camera.w2c, **({"w2c_end": camera.w2c_end} if camera.is_rolling else {})}
        if self.pose == "c2w":
            poses = {k: (torch if isinstance(x, torch.Tensor) else np).linalg.inv(x) for k, x in poses.items()}
        fields: dict[str, Any] = {"K": K, **poses}
        if self.distortion != "as given":
            fields["distortion"] = _distorted(self.distortion, camera.distortion)
        if self.shutter != "as given":
            fields["shutter"] = self.shutter
            if self.shutter == "global":
                fields["w2c_end"] = None
        return dataclasses.replace(camera, **fields)

    def _parameters(self, raw: dict, camera: Camera) -> dict:
        """The raw parameters that have this model's meaning in ours."""
        raw = dict(raw)
        if self.quaternions == "xyzw":
            raw["quats"] = raw["quats"][:, [3, 0, 1, 2]]  # its real part stands last, ours first
        if self.rotation == "transposed":
            raw["quats"] = raw["quats"] * torch.tensor([1.0, -1, -1, -1], dtype=torch.float64)
        if self.scales == "exponential":
            raw["log_scales"] = raw["log_scales"].exp()
        if self.opacities == "sigmoid":
            raw["logit_opacities"] = raw["logit_opacities"].sigmoid()
        if self.compensation != "none" and self.settings.dilation > 0:
            # The root has no derivative at 0; gsplat has no floor, and 1e-6 of an opacity is not drawn by anyone.
            floor = 1e-12 if self.compensation == "full" else _COMPENSATION_FLOOR
            alpha = raw["logit_opacities"].sigmoid() * _compensation(raw, camera, self.settings, floor)
            # Logits of 0 and 1 are infinite; an opacity of 1e-12 is never drawn.
            raw["logit_opacities"] = torch.logit(alpha.clamp(1e-12, 1 - 1e-12))
        if COLORS in raw:
            return raw
        raw["sh"] = self._sh(raw, camera)
        if self.channels not in ORDERS:
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
        towards = raw["means"] - _eye(camera, self.direction == BETWEEN)
        # What is known as a detached direction is so for the mean and the camera.
        towards = towards if self.direction_gradient else towards.detach()
        # A mean at the camera has no direction: 0 instead of NaN.
        towards = towards / towards.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        if self.direction == "to the camera":
            towards = -towards
        elif self.direction == "camera frame":
            towards = towards @ float64(camera.w2c)[:3, :3].T
        color = 0.5 + (reference.sh_basis(towards, sh.shape[1])[..., None] * sh).sum(1)
        return ((color - 0.5) / Y_00)[:, None]  # the renderer clamps at 0 as ever


def _later(k3: float, p1: float, p2: float = 0.0, *rest: float) -> tuple[float, ...]:
    """The coefficients behind k2 in OpenCV's order, of those that come as k3, p1, p2."""
    return (p1, p2, k3, *rest)


def _distorted(how: str, given: tuple[float, ...]) -> tuple[float, ...]:
    """The coefficients of a lens as OpenCV reads them, of what a model makes of the given ones."""
    if how == "as given" or not given:
        return tuple(given)
    return DISTORTIONS[how](*given)


def _windows(camera: Camera, whole: bool = False) -> Iterator[tuple[int, int, int, int]]:
    """(x, y, width, height) of squares that cover the image: the oracle takes of each the Gaussians that it can see."""
    if whole:
        yield 0, 0, camera.width, camera.height
        return
    for y in range(0, camera.height, _ORACLE_WINDOW):
        for x in range(0, camera.width, _ORACLE_WINDOW):
            yield x, y, min(_ORACLE_WINDOW, camera.width - x), min(_ORACLE_WINDOW, camera.height - y)


def _eye(camera: Camera, between: bool) -> torch.Tensor:
    """(3,) the point that colors are seen from, float64: the camera's center, of a rolling shutter that of the pose in
    the middle of the exposure, or the point between the centers of both poses.
    """
    if camera.is_rolling and not between:
        turns, shifts = rolling_poses(camera)
        return -turns[-1].T @ shifts[-1]
    ends = [camera.w2c, camera.w2c_end] if camera.is_rolling else [camera.w2c]
    centers = [-rotation.T @ translation for rotation, translation in (rigid(float64(w2c)) for w2c in ends)]
    return torch.stack(centers).mean(0)


def _compensation(raw: dict, camera: Camera, s: RenderSettings, floor: float) -> torch.Tensor:
    """(N,) sqrt(det Sigma' / det(Sigma' + dilation I)) of the projected covariances, as Mip-Splatting has it."""
    w2c = float64(camera.w2c)
    x, y, z = (raw["means"] @ w2c[:3, :3].T + w2c[:3, 3]).unbind(-1)
    z = torch.where(z > 1e-6, z, 1e-6)  # behind the camera nothing is drawn: any number without a derivative
    axes = activate(gaussians_of(raw)[0], s).axes
    a, b = screen_rows(x, y, z, camera, s.fov_clamp, w2c[:3, :3], axes).unbind(1)
    det = torch.linalg.cross(a, b).square().sum(-1)
    trace = (a * a + b * b).sum(-1)
    ratio = det / (det + s.dilation * (trace + s.dilation))
    return ratio.clamp_min(floor).sqrt()  # at 0 the root's derivative is infinite


# ----------------------------------------------------------------------------------------------------------- the search

_MIN_EXPLAINED_SHARE = 0.3  # share of the remaining difference that a variation must explain to be named; chosen
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
# Pixel centers that are tried, in pixels.
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
) -> SearchResult:
    """The model whose image is nearest to a given one, and the conventions in which it differs from its preset.

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
        ties = near_ties(start)
        counts = ~ties if float((~ties).double().mean()) >= LEAST else counts  # next to none are left
    model = _descend(distance, legal, start, start, settled)
    unusual = [field for field in _different(model, start) if not hasattr(model, field) and field != "background"]
    for other in starts if unusual or distance(model) > settled else ():
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
    return SearchResult(start, model, distance(start), distance(model), findings)


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Result of `find`.

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
        if distance(new) > (1 - _MIN_EXPLAINED_SHARE) * distance(model):
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
