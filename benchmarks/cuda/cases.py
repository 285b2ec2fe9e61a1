"""What drives the package's kernels: every case is a call that a user makes, on 60 Gaussians and 48x40 pixels.

A case is a function of no arguments. What it draws is the same each time, so that a run on the card asks for what a run
on LLVM has answered.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

import drgs
from drgs import fisher
from drgs.cameras import Camera, look_at
from drgs.deform import DeformationField, DynamicGaussians, FieldConfig
from drgs.ellipsoids import Gaussians
from drgs.integrator import render_normals, render_with_offsets
from drgs.select import select
from drgs.settings import RenderSettings
from drgs.testing import random_scene

__all__ = ["CASES", "FRAMES", "OPTIX"]

Preset = RenderSettings.preset
EXACT, FAST = Preset("exact"), Preset("fast")
BVH = Preset("exact", traversal="bvh")
COUNT = 60
home = torch.device("cpu")
"""Where the Gaussians of a case are; drive.py sets it."""
GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh")


def scene(width: int = 0, grad: bool = True) -> tuple[Gaussians, Camera]:
    """The scene, with so many feature channels, and its camera."""
    g, (camera,) = random_scene()
    fields = dict(g.parameters())
    if width:
        fields["features"] = torch.randn(COUNT, width, generator=torch.Generator().manual_seed(3))
    return Gaussians(**{name: x.detach().to(home).requires_grad_(grad) for name, x in fields.items()}), camera


def with_lens(camera: Camera, model: str, distortion: tuple, **fields: Any) -> Camera:
    """The camera with a lens."""
    return dataclasses.replace(camera, model=model, distortion=distortion, **fields)


def loss(out: Any) -> torch.Tensor:
    """A number that everything differentiable in an output moves."""
    shown = [x for x in (out.rgb, out.alpha, out.depth, out.features) if x is not None]
    return sum((x.square().sum() for x in shown), torch.zeros((), device=out.rgb.device))


def both_ways(settings: RenderSettings, width: int = 0, couple: bool = True, **given: Any) -> None:
    """Forward with every output, backward, and forward mode with three tangents."""
    g, camera = scene(width)
    camera = given.pop("camera", camera)
    with torch.no_grad():
        drgs.render(g, camera, settings, outputs="all", couple_features=couple, **given)
    loss(drgs.render(g, camera, settings, couple_features=couple, **given)).backward()
    draw = torch.Generator().manual_seed(5)
    tangents = {name: torch.randn(3, *x.shape, generator=draw).to(home) for name, x in of(g).items()}
    drgs.render_jvp(g.detach(), camera, tangents, settings, couple_features=couple, **given)


def of(g: Gaussians) -> Mapping[str, torch.Tensor]:
    """Parameters by name, without a graph."""
    return g.detach().parameters()


def pose_gradient(settings: RenderSettings) -> None:
    """Gradients by the pose, and by the lens where rays have one."""
    g, camera = scene(grad=False)
    pose = torch.tensor(camera.w2c, requires_grad=True)
    loss(drgs.render(g, dataclasses.replace(camera, w2c=pose), settings)).backward()
    if not settings.planar:
        lens = torch.tensor(camera.lens_parameters, requires_grad=True)
        loss(drgs.render(g, camera, settings, lens=lens)).backward()


def rolling() -> None:
    """A rolling shutter: rays without a common origin."""
    g, camera = scene()
    end = look_at(np.array([0.35, 0.1, -0.1]), np.array([0.3, -0.2, 4.0]), np.array([0.1, -1.0, 0.05]))
    both_ways(EXACT, camera=dataclasses.replace(camera, w2c_end=end, shutter="rolling_top_to_bottom"))


def own_rays(traversal: str = "tiles") -> None:
    """Rays of the caller's, some of which are none."""
    g, camera = scene()
    rays = torch.cat([torch.zeros(40, 48, 3), torch.randn(40, 48, 3) * 0.05], -1).double()
    rays[..., :3] += torch.tensor(camera.c2w[:3, 3])
    rays[..., 3:] += torch.tensor(camera.c2w[:3, 2])
    rays[:3, :3, 3:] = 0
    both_ways(EXACT.replace(traversal=traversal), rays=rays.requires_grad_())


def projected_means() -> None:
    """What density control reads: gradients by projected means, their absolute sums, and by covariances."""
    g, camera = scene()
    offsets = torch.zeros(COUNT, 2, device=home, requires_grad=True)
    absolute = torch.zeros(COUNT, 2, device=home, requires_grad=True)
    strains = torch.zeros(COUNT, 6, device=home, requires_grad=True)
    out = render_with_offsets(
        g, camera, Preset("gsplat"), mean_offsets=offsets, mean_absolute=absolute, strains=strains
    )
    loss(out).backward()


def functional() -> None:
    """`torch.func` and dual numbers."""
    g, camera = scene(grad=False)
    image = lambda x: drgs.render(g.replace(means=x), camera, FAST).rgb  # noqa: E731
    torch.func.jvp(image, (g.means,), (torch.ones_like(g.means),))
    torch.func.grad(lambda x: image(x).sum())(g.means)


def rasterizer() -> None:
    """gsplat's function."""
    g, camera = scene()
    tensors = {"means": g.means, "quats": g.quats, "scales": g.log_scales.exp(), "colors": g.sh}
    image, _, _ = drgs.rasterization(
        **tensors,
        opacities=g.logit_opacities.sigmoid(),
        viewmats=torch.tensor(camera.w2c[None], dtype=torch.float32, device=home),
        Ks=torch.tensor(camera.K[None], dtype=torch.float32, device=home),
        width=camera.width,
        height=camera.height,
        sh_degree=2,
        render_mode="RGB+ED",
    )
    image.square().sum().backward()


def information(settings: RenderSettings) -> None:
    """Diagonal, blocks, probes, columns, maps: what `drgs.fisher` offers of a scene that stands still."""
    g, camera = scene(grad=False)
    found = fisher.diagonal(g, camera, settings, groups=GROUPS)
    fisher.diagonal(g, camera, settings, "fisherrf", groups=("means", "log_scales", "logit_opacities", "sh"))
    fisher.diagonal(g, camera, settings, "probes", groups=GROUPS, probes=2)
    fisher.blocks(g, camera, settings)
    fisher.coverage(g, camera, settings)
    fisher.pose_information(g, camera, settings)
    fisher.jacobian_columns(g, camera, {"means": [(0, 0), (3, 2)], "sh": [(1, 0, 0)]}, settings)
    fisher.variance_map(g, camera, {name: 1 / (x + 1) for name, x in found.items()}, settings)


def columns(settings: RenderSettings) -> None:
    """Information by columns of the Jacobian, of which one traversal carries many."""
    g, camera = scene(grad=False)
    fisher.diagonal(g, camera, settings, "columns", groups=("logit_opacities",))
    fisher.pose_information(g, camera, settings)


def nuisances() -> None:
    """Information that pose and exposure of a view are eliminated from."""
    g, camera = scene(grad=False)
    unknown = fisher.Nuisances(eliminate=("pose", "exposure"))
    fisher.diagonal(g, camera, EXACT, groups=GROUPS, nuisances=unknown)
    fisher.blocks(g, camera, EXACT, nuisances=unknown)


def semantics(settings: RenderSettings = EXACT, width: int = 5) -> None:
    """Information of decoded features, and its map."""
    g, camera = scene(width, grad=False)
    W = torch.randn(width + 3, width, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    metric = fisher.SemanticMetric(W.T @ W, weight=0.7, estimate="exact")
    groups = ("means", "log_scales", "features")
    found = fisher.diagonal(g, camera, settings, groups=groups, semantics=metric)
    fisher.diagonal(g, camera, settings, "probes", groups=groups, semantics=metric, probes=2)
    fisher.blocks(g, camera, settings, semantics=metric)
    weights = {name: 1 / (x + 1) for name, x in found.items()}
    fisher.variance_map(g, camera, weights, settings, semantics=metric)


def moving() -> None:
    """A scene that a network moves, through `dr.wrap`: gradients, tangents, information."""
    g, camera = scene(grad=False)
    camera = dataclasses.replace(camera, time=0.4)
    config = FieldConfig(channels=2, resolution=3, time_resolution=3, levels=(1,), width=3, last_std=0.5)
    bounds = torch.stack([g.means.amin(0), g.means.amax(0)])
    swarm = DynamicGaussians(g, DeformationField(config, bounds.cpu(), seed=0).to(home))
    for x in swarm.parameters().values():
        if x.is_floating_point():
            x.requires_grad_()
    loss(drgs.render(swarm, camera, FAST)).backward()
    tangents = {
        name: torch.ones(2, *x.shape, device=home)
        for name, x in swarm.parameters().items()
        if x.is_floating_point() and not name.startswith("phi.")
    }
    drgs.render_jvp(swarm, camera, {**tangents, "time": torch.ones(2)}, EXACT)
    found = fisher.network(swarm, camera, EXACT, probes=2)
    fisher.network(swarm, camera, EXACT, estimate="trace", mode="forward", probes=2)
    fisher.network_variance_map(swarm, camera, {name: 1 / (x + 1) for name, x in found.items()}, EXACT, probes=2)
    fisher.diagonal(swarm.at(camera.time), camera, EXACT, groups=GROUPS)


def chosen() -> None:
    """Views that are chosen, exactly evaluated with blocks."""
    g, camera = scene(grad=False)
    others = [
        dataclasses.replace(camera, w2c=look_at(np.array([x, 0.1, 0.0]), np.array([0.3, -0.2, 4.0]), camera.w2c[1, :3]))
        for x in (-0.5, 0.4, 0.8)
    ]
    select(g, others, [camera], k=2)


def traced(order: str, response: str = "peak") -> None:
    """Rays through Mitsuba's structure."""
    both_ways(BVH.replace(order=order, response=response), width=3)


def deep() -> None:
    """So many Gaussians on a ray that its buffer overflows: rays that are walked again along sorted lists."""
    g, camera = scene(grad=False)
    many = {name: x.repeat(4, *[1] * (x.ndim - 1)) for name, x in of(g).items()}
    many["logit_opacities"] = many["logit_opacities"] * 0 - 4
    many["log_scales"] = many["log_scales"] + math.log(2.0)
    many["means"] = many["means"] + 0.05 * torch.randn(4 * COUNT, 3, generator=torch.Generator().manual_seed(1)).to(
        home
    )
    crowd = Gaussians(**{name: x.requires_grad_() for name, x in many.items()})
    loss(drgs.render(crowd, camera, BVH)).backward()


def frame(count: int, width: int, height: int, settings: RenderSettings) -> None:
    """One frame of the cube of the benchmarks and its gradient: a step of a fit without its optimizer."""
    cube = importlib.import_module("cubes")
    fields = of(cube.cube(count, sh_degree=3))
    g = Gaussians(**{name: x.to(home).requires_grad_() for name, x in fields.items()})
    drgs.render(g, cube.camera(width, height), settings, outputs=()).rgb.square().mean().backward()


def plugin() -> None:
    """`mi.render` with the integrator, and its gradient."""
    import drjit as dr

    from drgs import runtime
    from drgs.ellipsoids import ellipsoids_shape

    mi = runtime.mitsuba()
    importlib.reload(importlib.import_module("drgs.plugin"))  # registered with one variant at a time

    g, camera = scene(grad=False)
    sensor = dataclasses.replace(camera, K=np.array([[40, 0, 24], [0, 40, 20], [0, 0, 1.0]])).to_mitsuba()
    made = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "drgs", "preset": "exact"},
            "shape": ellipsoids_shape(g),
            "sensor": sensor,
        }
    )
    params = mi.traverse(made)
    key = next(k for k in params.keys() if k.endswith("data"))  # noqa: SIM118
    dr.enable_grad(params[key])
    dr.backward(dr.sum(mi.render(made, params, spp=1), axis=None))


FISHEYE = ("opencv_fisheye", (0.05, -0.02, 0.01, -0.003))
WIDE = ("opencv_fisheye", (-0.03, 0.004, 0.0, 0.0))
PRISM = ("opencv", (0.2, -0.1, 0.01, -0.01, 0.05, 0.1, 0.1, 0.02, 0.06, -0.02, -0.05, 0.03))
FTHETA = ("ftheta", (1.0, 0.02, -0.06, 0.01, -0.002, 1.05, 0.03, -0.02))


def lens(model: str, distortion: tuple, zoom: float, settings: RenderSettings) -> None:
    """A camera with a lens, both ways."""
    _, camera = scene()
    K = camera.K.copy()
    K[:2, :2] *= zoom
    both_ways(settings, camera=with_lens(camera, model, distortion, K=K))


def normals() -> None:
    """Axes that are turned towards the camera."""
    g, camera = scene()
    render_normals(g, camera, EXACT).square().sum().backward()


_Case = Callable[[], None]
CASES: dict[str, _Case] = {
    "peak, order of centers": functools.partial(both_ways, FAST),
    "peak, exact order": functools.partial(both_ways, EXACT),
    "integral, order of centers": functools.partial(both_ways, FAST.replace(response="integral")),
    "integral, exact order": functools.partial(both_ways, EXACT.replace(response="integral")),
    "ewa, gsplat": functools.partial(both_ways, Preset("gsplat")),
    "ewa, inria": functools.partial(both_ways, Preset("inria")),
    "3dgut": functools.partial(both_ways, Preset("3dgut")),
    "sh along rays": functools.partial(both_ways, EXACT.replace(sh_direction="ray")),
    "sh along rays, centers": functools.partial(both_ways, FAST.replace(sh_direction="ray", max_hits=8)),
    "8 features": functools.partial(both_ways, FAST, 8),
    "8 features, uncoupled": functools.partial(both_ways, FAST, 8, False),
    "128 features, exact order": functools.partial(both_ways, EXACT, 128),
    "pose and lens, exact order": functools.partial(pose_gradient, EXACT),
    "pose, gsplat": functools.partial(pose_gradient, Preset("gsplat")),
    "fisheye": functools.partial(lens, *FISHEYE, 1.0, EXACT),
    "half sphere": functools.partial(lens, *WIDE, 0.3, EXACT),
    "thin prism": functools.partial(lens, *PRISM, 0.8, FAST),
    "f-theta": functools.partial(lens, *FTHETA, 0.3, EXACT),
    "rolling shutter": rolling,
    "rays": own_rays,
    "projected means and strains": projected_means,
    "torch.func": functional,
    "drgs.rasterization": rasterizer,
    "normals": normals,
    "information, exact order": functools.partial(information, EXACT),
    "information, order of centers": functools.partial(information, FAST),
    "information, gsplat": functools.partial(information, Preset("gsplat")),
    "information, integral": functools.partial(information, EXACT.replace(response="integral")),
    "information, sh along rays": functools.partial(information, EXACT.replace(sh_direction="ray")),
    "information, nuisances": nuisances,
    "information, features": semantics,
    "information, 8 features": functools.partial(semantics, FAST, 8),
    "information, 40 features": functools.partial(semantics, FAST, 40),
    "columns, order of centers": functools.partial(columns, FAST),
    "columns, exact order": functools.partial(columns, EXACT),
    "deformation network": moving,
    "select": chosen,
}
"""Cases that need no OptiX."""

OPTIX: dict[str, _Case] = {
    "bvh, exact order": functools.partial(traced, "ray"),
    "bvh, order of centers": functools.partial(traced, "center"),
    "bvh, order of entries": functools.partial(traced, "entry"),
    "bvh, integral": functools.partial(traced, "ray", "integral"),
    "bvh, deep": deep,
    "bvh, information": functools.partial(information, BVH),
    "bvh, rays": functools.partial(own_rays, "bvh"),
    "bvh, mitsuba": functools.partial(both_ways, Preset("mitsuba")),
    "mi.render": plugin,
}

SIZES = ((100_000, 960, 540), (200_000, 960, 540))
LARGE = ((100_000, 1920, 1080), (200_000, 1920, 1080), (1_000_000, 1920, 1080))
"""(Gaussians, width, height) of the steps of which frames.py counts memory, the large ones of `fast` alone: LLVM takes
minutes for their rows in exact order.
"""
FRAMES: dict[str, _Case] = {
    f"step, {name}, {count}, {width}x{height}": functools.partial(frame, count, width, height, Preset(name))
    for name, sizes in (("fast", SIZES + LARGE), ("exact", SIZES))
    for count, width, height in sizes
}
"""Frames whose launches, waits and memory are counted."""
