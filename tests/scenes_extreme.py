"""The extremes that the renderer must stand, as named scenes; shared by the tests and benchmarks/numerics.py.

A case builds (Gaussians, camera, settings); all leaves are float32 unless the case is about float64 means.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch
from scenes_random import camera, gaussians

from drgs.settings import RenderSettings

SIZE = (9, 7)
EXACT = RenderSettings.preset("exact")


@dataclasses.dataclass(frozen=True)
class Case:
    """One line of the table.

    Attributes:
        name: As printed.
        build: rng -> (Gaussians, Camera).
        fields: Settings that differ from `exact`.
        bvh: Whether `bvh` keeps the bounds as well; `warns` where it cannot and says so, `skip` where it is not run.
        depth: Whether the bounds hold for the derivative of depth too.
        remark: What a reader should know.
    """

    name: str
    build: Callable
    fields: dict = dataclasses.field(default_factory=dict)
    bvh: str = "holds"
    depth: bool = True
    remark: str = ""

    @property
    def settings(self) -> RenderSettings:
        return EXACT.replace(**self.fields)


def _base(rng, size=SIZE, n=12, K=4, D=0, **options):
    return gaussians(rng, n, K, D, **options), camera(rng, size)


def _change(change, **options):
    """A case's builder: a random scene, changed in place by `change(g, cam)`."""

    def build(rng):
        g, cam = _base(rng, **options)
        with torch.no_grad():
            change(g, cam)
        return g, cam

    return build


def _at_camera(offset, scale=0.3):
    """The first Gaussian, round, at `offset` (camera axes) from the camera center."""

    def change(g, cam):
        c2w = cam.c2w
        g.means[0] = torch.tensor(c2w[:3, :3] @ np.asarray(offset, float) + c2w[:3, 3])
        g.log_scales[0] = math.log(scale) + torch.tensor([0.0, 0.2, -0.2])
        g.logit_opacities[0] = 0.5

    return _change(change)


def _on_axes(rng):
    """Means exactly on the camera's axes and diagonal, Gaussians aligned with them: ties of every choice of a frame."""
    g, cam = gaussians(rng, 12, 4), camera(rng, SIZE, turn=0.0)
    places = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [1, 1, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]]
    with torch.no_grad():
        cam.w2c[:3, 3] = torch.tensor([0.125, -0.125, 4.0])  # as a float32 mean can be
        for i, place in enumerate(places):
            g.means[i] = torch.tensor(cam.center + 0.25 * np.array(place))
            g.quats[i] = torch.tensor([1.0, 0, 0, 0])
            g.log_scales[i] = math.log(0.25)
            g.logit_opacities[i] = -1.0
    return g, cam


def _scaled(factor):
    """Everything, the camera's distance included, in other units."""

    def build(rng):
        g, cam = _base(rng)
        with torch.no_grad():
            g.means.mul_(factor)
            g.log_scales.add_(math.log(factor))
            pose = cam.w2c.clone()
            pose[:3, 3] *= factor
        return g, dataclasses.replace(cam, w2c=pose.requires_grad_())

    return build


def _on_rays(g, cam, which):
    """Move Gaussians onto rays through pixel centers, so that even the thinnest is hit."""
    d = cam.pixel_directions().reshape(-1, 3)[3 :: len(cam.pixel_directions().reshape(-1, 3)) // len(g) or 1]
    for k, i in enumerate(which):
        g.means[i] = torch.tensor(cam.center + (3.5 + 0.1 * i) * d[k % len(d)])


def _scales(g, cam):
    _on_rays(g, cam, range(4))
    g.log_scales[:4] = math.log(1e-7)
    g.log_scales[4:6] = math.log(1e4)


def _huge(g, cam):
    g.log_scales[:3] = math.log(1e4)
    g.logit_opacities[:3] = -2.0


def _needles(g, cam):
    _on_rays(g, cam, range(len(g)))
    g.log_scales[:, 0], g.log_scales[:, 1:] = 0.0, math.log(1e-6)


def _sheets(g, cam):
    g.log_scales[:, :2], g.log_scales[:, 2] = math.log(0.5), math.log(0.5e-6)


def _opacities(g, cam):
    g.logit_opacities[:4] = math.log(1e-8)
    g.logit_opacities[4:8] = 16.1
    g.logit_opacities[8:10] = -100.0
    g.logit_opacities[10:] = 100.0


def _coincident(g, cam):
    for x in (g.means, g.quats, g.log_scales):
        x[:] = x[:1]
    g.means[:] = 0
    g.log_scales[:] = torch.tensor([0.3, 0.4, 0.6]).log()
    g.logit_opacities[:] = -5.0 + torch.rand(len(g), generator=torch.Generator().manual_seed(0))


def _equal_depths(rng):
    """A plane of equal camera z, mirrored pairs at equal distance."""
    g, cam = gaussians(rng, 12, 4), camera(rng, SIZE, turn=0.0)
    with torch.no_grad():
        g.means[:, 2] = 0.5
        g.means[:, 0] = 0.1 + 0 * g.means[:, 0]
        g.means[:, 1] = torch.linspace(-0.8, 0.8, 12)
        g.quats[:] = torch.tensor([1.0, 0, 0, 0])
    return g, cam


def _offset(rng, where):
    """A world 1e6 from zero whose detail is 1e-2: float64 means, or float32 means relative to `origin`."""
    g, cam = _base(rng)
    shift = np.array([1e6, -7e5, 3e5])
    with torch.no_grad():
        g.means.mul_(0.1)
        g.log_scales.fill_(math.log(1e-2)).add_(0.3 * torch.tensor(rng.normal(size=(len(g), 3))))
        pose = cam.w2c.clone()
        pose[:3, 3] *= 0.1
        pose[:3, 3] -= pose[:3, :3] @ torch.tensor(shift)
        means = g.means.double() + (torch.tensor(shift) if where == "means" else 0)
    means = (means if where == "means" else means.float()).requires_grad_()
    origin = np.zeros(3) if where == "means" else shift
    return g.replace(means=means, origin=origin), dataclasses.replace(cam, w2c=pose.requires_grad_())


def _focal(focal):
    def build(rng):
        g = gaussians(rng, 12, 4)
        cam = camera(rng, SIZE, focal=focal, turn=0.0)
        if focal > 100:
            # The image spans 1e-4 of the distance.
            with torch.no_grad():
                g.means[:, :2].mul_(1e-4).sub_(torch.tensor([0.1, -0.1]))
                g.log_scales.fill_(math.log(5e-5)).add_(0.3 * torch.tensor(rng.normal(size=(12, 3))))
        return g, cam

    return build


def _covering(g, cam):
    g.means[0] = torch.tensor(cam.c2w[:3, :3] @ [0, 0, 1.0] + cam.c2w[:3, 3])
    g.log_scales[0] = math.log(100.0)


def _layers(rng):
    """1,000 opaque layers: T underflows within a few of them."""
    g, cam = gaussians(rng, 1000, 1), camera(rng, SIZE)
    with torch.no_grad():
        g.log_scales[:] = torch.tensor([0.4, 0.5, 0.7]).log()
        g.logit_opacities[:] = 6.0
    return g, cam


def _quaternions(g, cam):
    g.quats[:4] *= 1e-20
    g.quats[4:8] *= 1e15
    g.quats[8:] *= -1


def _negative(g, cam):
    g.sh[:, 0] = -4.0
    g.sh[::2, 0, 1] = 1.0


def _one(rng):
    return _base(rng, n=1)


def _none(rng):
    return _base(rng, n=0)


_THIN = "depth derivatives: 6e-8 x distance / scale"
_BEHIND = {"remark": "`integral`: the tail in front of the camera counts"}
CASES = (
    Case("scale 1e-7 to 1e4 in one scene", _change(_scales), bvh="warns", depth=False, remark=_THIN),
    Case("world in units of 1e-7", _scaled(1e-7)),
    Case("world in units of 1e4", _scaled(1e4)),
    Case("scale 1e4 around the camera", _change(_huge)),
    Case("anisotropy 1e6:1, needles", _change(_needles), bvh="warns", depth=False, remark=_THIN),
    Case("anisotropy 1e6:1, sheets", _change(_sheets)),
    Case("opacity 1e-8 to 1 - 1e-7, logits of 100", _change(_opacities)),
    Case("opacity 1e-8 to 1 - 1e-7, `integral`", _change(_opacities), {"response": "integral"}),
    Case("2,000 coincident Gaussians", _change(_coincident, n=2000, K=1)),
    Case("equal depths, `center`", _equal_depths, {"order": "center", "depth_key": "z"}),
    Case("equal depths", _equal_depths),
    Case("camera inside a Gaussian", _at_camera([0.05, 0.02, 0.1])),
    Case("camera inside, `integral`", _at_camera([0.05, 0.02, 0.1]), {"response": "integral"}),
    Case("camera on the surface (1 sigma)", _at_camera([0, 0, 0.3])),
    Case("camera just in front of a mean", _at_camera([0, 0, -1e-3])),
    Case("camera just in front, `integral`", _at_camera([0, 0, -1e-3]), {"response": "integral"}, **_BEHIND),
    Case("camera just behind a mean", _at_camera([0, 0, 1e-3])),
    Case("camera at a mean", _at_camera([0, 0, 0]), {"response": "integral"}),
    Case("mean in the camera plane", _at_camera([0.2, 0.1, 0])),
    Case("mean in the camera plane, `integral`", _at_camera([0.2, 0.1, 0]), {"response": "integral"}),
    Case("mean on the camera's x axis", _at_camera([0.2, 0, 0]), {"response": "integral"}),
    Case("means exactly on the camera's axes", _on_axes),
    Case("means exactly on the camera's axes, `integral`", _on_axes, {"response": "integral"}),
    Case("mean just off the camera plane", _at_camera([0.2, 0.1, 1e-6]), {"response": "integral"}),
    Case("crossing the near plane", _at_camera([0, 0, 0.21]), {"near": 0.2}),
    Case("covering the screen, sigma 100", _change(_covering)),
    Case("`ewa` close to the camera plane", _at_camera([0.001, 0, 0.01], 0.1), {"response": "ewa", "order": "center"}),
    Case("world offset 1e6, detail 1e-2, float64 means", lambda rng: _offset(rng, "means")),
    Case("world offset 1e6, detail 1e-2, `origin`", lambda rng: _offset(rng, "origin")),
    Case("focal length 1 px", _focal(1.0)),
    Case("focal length 1e5 px", _focal(1e5), bvh="warns", depth=False, remark=_THIN),
    Case("image 1x1", lambda rng: _base(rng, (1, 1))),
    Case("image 4096x1", lambda rng: _base(rng, (4096, 1))),
    Case("image 1x4096", lambda rng: _base(rng, (1, 4096))),
    Case("0 Gaussians", _none),
    Case("1 Gaussian", _one),
    Case("quaternions near 0, huge and negated", _change(_quaternions)),
    Case("negative colors", _change(_negative)),
    Case("1,000 opaque layers", _layers),
    Case("1,000 opaque layers, `center`", _layers, {"order": "center"}),
    Case("1,000 opaque layers, `integral`", _layers, {"response": "integral"}),
    Case("D = 1", lambda rng: _base(rng, D=1)),
    Case("D = 512", lambda rng: _base(rng, D=512), bvh="skip"),
)


def _huge_crowd(g):
    g.log_scales[:20], g.logit_opacities[:20] = math.log(1e4), -3.0


def _large_crowd(g):
    g.log_scales[::5] += 4.0
    g.logit_opacities[::5] = -3.0


def _tiny_one(g):
    g.log_scales[0] = math.log(1e-4)


def _far_one(g):
    g.means[0] = 1e5


# Crowds in which the acceleration structure may lose hits: name -> (options of `gaussians`, distance of the camera,
# change in place).
CROWDS = {
    "20 hits a ray": ({"n": 150, "scale": 0.12}, 4.0, None),
    "170 hits a ray": ({"n": 1000, "scale": 0.12}, 4.0, None),
    "170 hits a ray, one Gaussian tiny": ({"n": 1000, "scale": 0.12}, 4.0, _tiny_one),
    "160 hits a ray, thin (log-scales spread by 1.8)": ({"n": 1000, "scale": 0.07, "anisotropy": 1.8}, 4.0, None),
    "50 hits a ray, 20 Gaussians of scale 1e4": ({"n": 300, "scale": 0.1}, 4.0, _huge_crowd),
    "85 hits a ray, every fifth Gaussian 55 times as large": ({"n": 300, "scale": 0.1}, 4.0, _large_crowd),
    "30 hits a ray, one Gaussian 1e5 away": ({"n": 300, "scale": 0.1}, 4.0, _far_one),
    "40 hits a ray, 5,000 sigma away": ({"n": 300, "scale": 0.12}, 600.0, None),
}


def crowd(name, rng, size):
    """(Gaussians, Camera) of one of `CROWDS`, detached."""
    options, distance, change = CROWDS[name]
    g = gaussians(rng, **options).detach()
    if change:
        change(g)
    return g, camera(rng, size, distance=distance)
