"""Extreme inputs that the renderer must render correctly, as named scenes, and input that it must refuse or warn about.

`drgs stress` and the tests run them. A case builds (Gaussians, camera, settings); all leaves are float32 unless the
case is about float64 means. Camera axes are +x right, +y down, +z forward.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from drgs import fisher
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab.accuracy import random_camera, random_gaussians
from drgs.settings import RenderSettings

SIZE = (9, 7)
"""Width and height of the images, unless a case says otherwise."""

Built = tuple[Gaussians, Camera]
Builder = Callable[[np.random.Generator], Built]


@dataclasses.dataclass(frozen=True)
class ExtremeCase:
    """One scene at an extreme.

    Attributes:
        name: Name of the case, as it is printed.
        build: Function of a random generator: Gaussians and camera.
        preset: Preset that the settings start from.
        fields: Settings that differ from the preset.
        bvh: Whether `bvh` keeps the bounds as well; `rounds` where it keeps those of its rounding (docs/numerics.md),
            `warns` where it keeps none and says so, `skip` where it is not run.
        depth: Whether the bounds hold for the derivative of depth too.
        gain: Whether the information gain of a second view with lambda = 0 is compared, too.
        remark: What a reader should know.
    """

    name: str
    build: Builder
    preset: str = "exact"
    fields: dict = dataclasses.field(default_factory=dict)
    bvh: str = "holds"
    depth: bool = True
    gain: bool = False
    remark: str = ""

    @property
    def settings(self) -> RenderSettings:
        """Render settings of the case, for the traversal `tiles`."""
        return RenderSettings.preset(self.preset, **self.fields)

    @property
    def oracle_settings(self) -> RenderSettings:
        """Settings of the oracle: `exact` is held to what it stands for, rays that no transmittance ends."""
        return self.settings.replace(transmittance_min=0.0) if self.preset == "exact" else self.settings

    @property
    def traversals(self) -> tuple[str, ...]:
        """Traversals that the case is run on."""
        return ("tiles",) if self.bvh == "skip" or self.settings.planar else ("tiles", "bvh")


def _base(
    rng: np.random.Generator, size: tuple[int, int] = SIZE, n: int = 12, K: int = 4, D: int = 0, **options
) -> Built:
    return random_gaussians(rng, n, K, D, **options), random_camera(rng, size)


def _change(change: Callable[[Gaussians, Camera], None], **options) -> Builder:
    """A case's builder: a random scene, changed in place by `change(g, cam)`."""

    def build(rng: np.random.Generator) -> Built:
        g, cam = _base(rng, **options)
        change(g, cam)
        return g, cam

    return build


def _at_camera(offset: Sequence[float], scale: float = 0.3) -> Builder:
    """The first Gaussian, round, at `offset` (camera axes) from the camera center."""

    def change(g: Gaussians, cam: Camera) -> None:
        c2w = cam.c2w
        g.means[0] = torch.tensor(c2w[:3, :3] @ np.asarray(offset, float) + c2w[:3, 3])
        g.log_scales[0] = math.log(scale) + torch.tensor([0.0, 0.2, -0.2])
        g.logit_opacities[0] = 0.5

    return _change(change)


def _on_axes(rng: np.random.Generator) -> Built:
    """Means exactly on the camera's axes and diagonal, Gaussians aligned with them: ties of every choice of a frame."""
    g = random_gaussians(rng, 12, 4)
    cam = random_camera(rng, SIZE, turn=0.0)
    places = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]]
    cam.w2c[:3, 3] = torch.tensor([0.125, -0.125, 4.0])  # as a float32 mean can be
    for i, place in enumerate(places):
        g.means[i] = torch.tensor(cam.center + 0.25 * np.array(place))
        g.quats[i] = torch.tensor([1.0, 0, 0, 0])
        g.log_scales[i] = math.log(0.25)
        g.logit_opacities[i] = -1.0
    return g, cam


def _scaled(factor: float) -> Builder:
    """Everything, the camera's distance included, in other units."""

    def build(rng: np.random.Generator) -> Built:
        g, cam = _base(rng)
        g.means.mul_(factor)
        g.log_scales.add_(math.log(factor))
        pose = cam.w2c.clone()
        pose[:3, 3] *= factor
        return g, dataclasses.replace(cam, w2c=pose.requires_grad_())

    return build


def _on_rays(g: Gaussians, cam: Camera, which: Sequence[int]) -> None:
    """Move Gaussians onto rays through pixel centers, so that even the thinnest is hit."""
    d = cam.pixel_directions().reshape(-1, 3)[3 :: len(cam.pixel_directions().reshape(-1, 3)) // len(g) or 1]
    for k, i in enumerate(which):
        g.means[i] = torch.tensor(cam.center + (3.5 + 0.1 * i) * d[k % len(d)])


def _scales(g: Gaussians, cam: Camera) -> None:
    """The thinnest and the widest, both in the picture."""
    _on_rays(g, cam, range(4))
    g.log_scales[:4] = math.log(1e-7)
    g.log_scales[4:6] = math.log(1e4)


def _huge(g: Gaussians, cam: Camera) -> None:
    """Three so wide that the camera is inside."""
    g.log_scales[:3] = math.log(1e4)
    g.logit_opacities[:3] = -2.0


def _needles(g: Gaussians, cam: Camera) -> None:
    """Each on a ray of its own."""
    _on_rays(g, cam, range(len(g)))
    g.log_scales[:, 0] = 0.0
    g.log_scales[:, 1:] = math.log(1e-6)


def _sheets(g: Gaussians, cam: Camera) -> None:
    """As wide as the scene, and without thickness."""
    g.log_scales[:, :2] = math.log(0.5)
    g.log_scales[:, 2] = math.log(0.5e-6)


def _opacities(g: Gaussians, cam: Camera) -> None:
    """From nothing to 1 - 1e-7, and logits whose sigmoid is 0 or 1 in float32."""
    g.logit_opacities[:4] = math.log(1e-8)
    g.logit_opacities[4:8] = 16.1
    g.logit_opacities[8:10] = -100.0
    g.logit_opacities[10:] = 100.0


def _faint(g: Gaussians, cam: Camera) -> None:
    """Opacities of 1e-4 and 1e-5: what derivatives have is theirs."""
    g.log_scales.add_(0.7)
    g.logit_opacities[::2] = math.log(1e-4)
    g.logit_opacities[1::2] = math.log(1e-5)


def _fisheye(rng: np.random.Generator) -> Built:
    """A fisheye that sees 175 degrees from side to side, with Gaussians in front of it and around it."""
    g, cam = _base(rng, (24, 20), spread=2.0)
    f = 0.5 * cam.width / math.radians(87.5)
    K = np.array([[f, 0, cam.width / 2], [0, f, cam.height / 2], [0, 0, 1]])
    g.means[:6] += torch.tensor(cam.center)
    return g, dataclasses.replace(cam, K=K, model="opencv_fisheye", distortion=(0.02, -0.01, 0.0, 0.0))


def _half(g: Gaussians, cam: Camera) -> None:
    """Half of the Gaussians: logit 0, where the two branches of a stable sigmoid meet."""
    g.logit_opacities[::2] = 0.0


def _coincident(g: Gaussians, cam: Camera) -> None:
    """All at one place, of one shape, faint enough that the last one shows."""
    for x in (g.means, g.quats, g.log_scales):
        x[:] = x[:1]
    g.means[:] = 0
    g.log_scales[:] = torch.tensor([0.3, 0.4, 0.6]).log()
    g.logit_opacities[:] = -5.0 + torch.rand(len(g), generator=torch.Generator().manual_seed(0))


def _equal_depths(rng: np.random.Generator) -> Built:
    """A plane of equal camera z, mirrored pairs at equal distance."""
    g = random_gaussians(rng, 12, 4)
    cam = random_camera(rng, SIZE, turn=0.0)
    g.means[:, 2] = 0.5
    g.means[:, 0] = 0.1 + 0 * g.means[:, 0]
    g.means[:, 1] = torch.linspace(-0.8, 0.8, 12)
    g.quats[:] = torch.tensor([1.0, 0, 0, 0])
    return g, cam


def _offset(rng: np.random.Generator, where: str) -> Built:
    """A world 1e6 from zero whose detail is 1e-2: float64 means, or float32 means relative to `origin`."""
    g, cam = _base(rng)
    shift = np.array([1e6, -7e5, 3e5])
    g.means.mul_(0.1)
    g.log_scales.fill_(math.log(1e-2)).add_(0.3 * torch.tensor(rng.normal(size=(len(g), 3))))
    pose = cam.w2c.clone()
    pose[:3, 3] *= 0.1
    pose[:3, 3] -= pose[:3, :3] @ torch.tensor(shift)
    means = g.means.double() + (torch.tensor(shift) if where == "means" else 0)
    means = (means if where == "means" else means.float()).requires_grad_()
    origin = np.zeros(3) if where == "means" else shift
    return g.replace(means=means, origin=origin), dataclasses.replace(cam, w2c=pose.requires_grad_())


def _focal(focal: float) -> Builder:
    """A view with this focal length in pixels; with a long one, of Gaussians small and close enough to be in it."""

    def build(rng: np.random.Generator) -> Built:
        g = random_gaussians(rng, 12, 4)
        cam = random_camera(rng, SIZE, focal=focal, turn=0.0)
        if focal > 100:
            # The image spans 1e-4 of the distance.
            g.means[:, :2].mul_(1e-4).sub_(torch.tensor([0.1, -0.1]))
            g.log_scales.fill_(math.log(5e-5)).add_(0.3 * torch.tensor(rng.normal(size=(12, 3))))
        return g, cam

    return build


def _covering(g: Gaussians, cam: Camera) -> None:
    """One that is opaque over the whole picture, one unit away."""
    g.means[0] = torch.tensor(cam.c2w[:3, :3] @ [0, 0, 1.0] + cam.c2w[:3, 3])
    g.log_scales[0] = math.log(100.0)


def _layers(rng: np.random.Generator, n: int = 1000) -> Built:
    """Opaque layers: T underflows within a few of them."""
    g = random_gaussians(rng, n, 1)
    cam = random_camera(rng, SIZE)
    g.log_scales[:] = torch.tensor([0.4, 0.5, 0.7]).log()
    g.logit_opacities[:] = 6.0
    return g, cam


def _quaternions(g: Gaussians, cam: Camera) -> None:
    """Lengths far from 1, and the negative, which is the same rotation."""
    g.quats[:4] *= 1e-20
    g.quats[4:8] *= 1e15
    g.quats[8:] *= -1


def _negative(g: Gaussians, cam: Camera) -> None:
    """Colors below 0, which are clamped; every other one in two channels only."""
    g.sh[:, 0] = -4.0
    g.sh[::2, 0, 1] = 1.0


def _subpixel(g: Gaussians, cam: Camera) -> None:
    """Standard deviations of 1e-3 pixels; the second half between pixel centers, where only a dilation shows them."""
    sigma = 1e-3 * 4 / float(cam.K[0, 0])
    g.log_scales[:] = math.log(sigma) + torch.tensor([0.0, 0.3, -0.3])
    _on_rays(g, cam, range(6))
    g.means[:6] += 0.5 * sigma * torch.tensor([1.0, -1.0, 0.0])


def _behind_clamp(g: Gaussians, cam: Camera) -> None:
    """On all four sides, beyond the field of view at which rasterizers clamp x/z and y/z, and large enough to show."""
    tan = cam.width / (2 * cam.K[0, 0]), cam.height / (2 * cam.K[1, 1])
    for i, (x, y) in enumerate(((3, 0.2), (-3, 0.1), (0.1, 3), (-0.3, -3), (2, 2), (1.31, 0))):
        z = 2 + 0.1 * i
        g.means[i] = torch.tensor(cam.c2w[:3, :3] @ [z * x * tan[0], z * y * tan[1], z] + cam.c2w[:3, 3])
        g.log_scales[i] = math.log(0.9) + torch.tensor([0.0, 0.2, -0.2])
        g.logit_opacities[i] = 0.0


def _at_near(near: float) -> Builder:
    """One just beyond the near plane, one just before it, both reaching through it."""

    def change(g: Gaussians, cam: Camera) -> None:
        for i, z in enumerate((1.001 * near, 0.999 * near)):
            g.means[i] = torch.tensor(cam.c2w[:3, :3] @ [0.3 * z, -0.2 * z, z] + cam.c2w[:3, 3])
            g.log_scales[i] = math.log(near)
            g.logit_opacities[i] = -0.5

    return _change(change)


def _translucent_layers(rng: np.random.Generator) -> Built:
    """Layers that end a ray at a transmittance of 1e-4 and are not clamped, so that no product is a tie."""
    g, cam = _layers(rng, 300)
    g.logit_opacities[:] = torch.tensor(rng.uniform(0, 2, len(g)))
    return g, cam


def _beyond_float32(g: Gaussians, cam: Camera) -> None:
    """Activations that overflow or vanish in float32."""
    g.log_scales[0] = 60.0
    g.log_scales[1] = -60.0
    g.log_scales[2] = torch.tensor([-40.0, 0.0, 40.0])
    g.logit_opacities[3] = 3e4
    g.logit_opacities[4] = -3e4
    g.means[5] = 1e15
    g.means[6] = -1e15


def _hidden(g: Gaussians, cam: Camera) -> None:
    """Two Gaussians behind the camera, two that only a view of what is to the right of the image sees."""
    for i, place in enumerate(([0, 0, -3.0], [0.5, 0.3, -2.0], [3.2, 0, 4.0], [3.4, 0.2, 4.0])):
        g.means[i] = torch.tensor(cam.c2w[:3, :3] @ place + cam.c2w[:3, 3])


_MODES = {
    "exact": {},
    "center": {"fields": {"order": "center"}},
    "integral": {"fields": {"response": "integral"}},
    "ewa": {"fields": {"response": "ewa", "order": "center"}},
    "inria": {"preset": "inria"},
    "gsplat": {"preset": "gsplat"},
}


def _cases(name: str, build: Builder, modes: str = "exact", **options) -> list[ExtremeCase]:
    """A scene in each of the modes, which are named where they are not `exact`."""
    fields = options.pop("fields", {})
    return [
        ExtremeCase(
            name if mode == "exact" else f"{name}, `{mode}`",
            torch.no_grad()(build),  # which changes leaves in place
            preset=_MODES[mode].get("preset", "exact"),
            fields={**_MODES[mode].get("fields", {}), **fields},
            **options,
        )
        for mode in modes.split()
    ]


_THIN = {"bvh": "warns", "depth": False, "remark": "depth derivatives: 6e-8 x distance / scale"}
_TAIL = {"remark": "`integral`: the tail in front of the camera counts"}
_ALL = "exact integral ewa inria gsplat"
CASES = (
    *_cases("scale 1e-7 to 1e4 in one scene", _change(_scales), _ALL, **_THIN),
    *_cases("world in units of 1e-7", _scaled(1e-7), "exact integral ewa"),
    *_cases("world in units of 1e4", _scaled(1e4), _ALL),
    *_cases("scale 1e4 around the camera", _change(_huge), _ALL),
    *_cases("anisotropy 1e6:1, needles", _change(_needles), _ALL, **_THIN),
    *_cases("anisotropy 1e6:1, sheets", _change(_sheets), _ALL),
    *_cases("sub-pixel Gaussians, sigma 1e-3 px", _change(_subpixel), _ALL, bvh="rounds"),
    *_cases("opacity 1e-8 to 1 - 1e-7, logits of 100", _change(_opacities), _ALL),
    *_cases("every opacity 1e-5 or 1e-4", _change(_faint), "exact integral ewa"),
    *_cases("fisheye of 175 degrees", _fisheye, "exact integral"),
    *_cases("opacity exactly 1/2 (logit 0)", _change(_half), _ALL),
    *_cases("activations beyond float32", _change(_beyond_float32), _ALL, bvh="warns"),
    *_cases("2,000 coincident Gaussians", _change(_coincident, n=2000, K=1), "exact center integral"),
    *_cases("equal depths", _equal_depths, "exact integral gsplat"),
    *_cases("equal depths", _equal_depths, "center", fields={"depth_key": "z"}),
    *_cases("camera inside a Gaussian", _at_camera([0.05, 0.02, 0.1]), _ALL),
    *_cases("camera on the surface (1 sigma)", _at_camera([0, 0, 0.3]), _ALL),
    *_cases("camera just in front of a mean", _at_camera([0, 0, -1e-3])),
    *_cases("camera just in front of a mean", _at_camera([0, 0, -1e-3]), "integral", **_TAIL),
    *_cases("camera just behind a mean", _at_camera([0, 0, 1e-3]), "exact integral ewa"),
    *_cases("camera at a mean", _at_camera([0, 0, 0]), "integral"),
    *_cases("mean in the camera plane", _at_camera([0.2, 0.1, 0]), "exact integral ewa"),
    *_cases("mean on the camera's x axis", _at_camera([0.2, 0, 0]), "exact integral"),
    *_cases("means exactly on the camera's axes", _on_axes, _ALL),
    *_cases("mean just off the camera plane", _at_camera([0.2, 0.1, 1e-6]), "exact integral"),
    *_cases("close to the camera plane", _at_camera([0.001, 0, 0.01], 0.1), "ewa"),
    *_cases("crossing the near plane", _at_near(0.2), "exact integral ewa", fields={"near": 0.2}),
    *_cases("crossing the near plane", _at_near(0.2), "inria"),
    *_cases("crossing the near plane", _at_near(0.01), "gsplat"),
    *_cases("behind the clamp of the field of view", _change(_behind_clamp), _ALL),
    *_cases("covering the screen, sigma 100", _change(_covering), _ALL),
    *_cases("world offset 1e6, detail 1e-2, float64 means", lambda rng: _offset(rng, "means"), "exact ewa"),
    *_cases("world offset 1e6, detail 1e-2, `origin`", lambda rng: _offset(rng, "origin"), _ALL),
    *_cases("focal length 1 px", _focal(1.0), _ALL),
    *_cases("focal length 1e5 px", _focal(1e5), _ALL, **_THIN),
    # Every shape of tile has kernels of its own, which take long to compile.
    *_cases("image 1x1", lambda rng: _base(rng, (1, 1)), "exact gsplat"),
    *_cases("image 4096x1", lambda rng: _base(rng, (4096, 1)), "exact inria"),
    *_cases("image 1x4096", lambda rng: _base(rng, (1, 4096)), "exact gsplat"),
    *_cases("0 Gaussians", lambda rng: _base(rng, n=0), _ALL),
    *_cases("1 Gaussian", lambda rng: _base(rng, n=1), _ALL),
    *_cases("quaternions near 0, huge and negated", _change(_quaternions), _ALL),
    *_cases("negative colors", _change(_negative), _ALL),
    *_cases("1,000 opaque layers", _layers, "exact center integral ewa"),
    *_cases("300 layers to the early stop", _translucent_layers, "inria gsplat"),
    *_cases("D = 1", lambda rng: _base(rng, D=1), _ALL),
    *_cases("D = 512", lambda rng: _base(rng, D=512)),
    *_cases("lambda = 0, some Gaussians unseen", _change(_hidden), _ALL, gain=True),
)


# ------------------------------------------------------------------------------------------------------ input to refuse

Attempts = Iterator[tuple[Callable[[], object], str]]


@dataclasses.dataclass(frozen=True)
class Refusal:
    """One kind of such input.

    Attributes:
        name: Name of the kind, as it is printed.
        attempts: Function that yields pairs of a call and a text that its message must have.
        warns: Whether the message is a warning; else it is a ValueError.
    """

    name: str
    attempts: Callable[[], Attempts]
    warns: bool = False


def _scene() -> tuple[Gaussians, Camera]:
    rng = np.random.default_rng(0)
    # No leaves: their values are changed in place, which torch refuses of leaves.
    return random_gaussians(rng, 4, 4, 2).detach(), random_camera(rng, (9, 7))


def _with(field: str, value: float) -> Gaussians:
    """A small scene with a Gaussian's parameter replaced."""
    g, _ = _scene()
    getattr(g, field)[2] = value
    return g


def _not_finite() -> Attempts:
    """Every parameter, NaN and both infinities, rendered and differentiated."""
    _, cam = _scene()
    for field in ("means", "quats", "log_scales", "logit_opacities", "sh", "features"):
        for value in (math.nan, math.inf, -math.inf):
            g = _with(field, value)
            message = f"{field} must be finite"
            for traversal in ("tiles", "bvh"):
                settings = RenderSettings.preset("exact", traversal=traversal)
                yield lambda g=g, settings=settings: render(g, cam, settings), message
                if field != "features":  # which information does not depend on
                    yield lambda g=g, settings=settings: fisher.diagonal(g, cam, settings), message


def _zero_quaternion() -> Attempts:
    _, cam = _scene()
    g = _with("quats", 0.0)
    for traversal in ("tiles", "bvh"):
        settings = RenderSettings.preset("exact", traversal=traversal)
        yield lambda settings=settings: render(g, cam, settings), "quats must not be 0"


def _broken_camera() -> Attempts:
    """A camera is refused when it is made, and once more when its pose has been moved since."""
    g, cam = _scene()
    for value in (math.nan, math.inf):
        # Copies without a graph: their values are changed in place, which torch refuses of leaves.
        K = cam.K.copy()
        w2c = cam.w2c.detach().clone()
        K[0, 0] = w2c[0, 3] = value
        yield lambda K=K: dataclasses.replace(cam, K=K), "K must"
        yield lambda w2c=w2c: dataclasses.replace(cam, w2c=w2c), "pose must be finite"
        moved = dataclasses.replace(cam, w2c=cam.w2c.detach().clone())  # no leaf: it is changed in place
        moved.w2c[0, 3] = value  # a pose that an optimizer moved
        for traversal in ("tiles", "bvh"):
            settings = RenderSettings.preset("exact", traversal=traversal)
            yield lambda moved=moved, settings=settings: render(g, moved, settings), "pose must be finite"


def _far_away() -> Attempts:
    means = np.array([[1e6, 0.0, 0.0]], np.float32)
    arrays = means, np.eye(4)[:1], np.full((1, 3), 1e-2), np.full(1, 0.5), np.zeros((1, 3))
    yield lambda: Gaussians.from_arrays(*arrays), "float64 means"


REFUSALS = (
    Refusal("NaN and infinite parameters", _not_finite),
    Refusal("quaternion exactly 0", _zero_quaternion),
    Refusal("NaN and infinite cameras", _broken_camera),
    Refusal("world offset 1e6, detail 1e-2, float32 means", _far_away, warns=True),
)
