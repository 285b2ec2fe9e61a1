"""The public renderer: torch in, torch out, differentiable in both modes.

One call (tracing/call.py) projects the Gaussians (projection.py), lists or traces them (tiles.py, bvh.py), composites
them in order (walk.py, kernels.py) and returns torch tensors. Compositing is one Dr.Jit operation with its own adjoint
and forward mode (composite.py); what a Gaussian needs once a view is differentiated by Dr.Jit's AD. Two
`autograd.Function`s are the bridge to torch (bridge.py). All may be called from any number of Python threads
(runtime.alone).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera, cameras_of_one_size
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.ellipsoids import DeformableScene, Gaussians, Scene
from drgs.settings import RenderSettings
from drgs.tracing.bridge import differentiable
from drgs.tracing.call import Call, Output
from drgs.tracing.errors import own_errors
from drgs.tracing.inputs import check_scene, check_view, gaussians_at
from drgs.tracing.tangents import push_forward

__all__ = ["OUTPUTS", "Output", "render", "render_jvp", "render_normals", "render_rays", "render_with_offsets"]

OUTPUTS = ("depth", "median_depth", "count", "visibility")
_NAMES = {"depth": "depth", "median_depth": "median", "count": "count", "visibility": "visibility"}


@runtime.alone
def render(
    gaussians: Scene,
    camera: Camera | list[Camera] | tuple[Camera, ...],
    settings: RenderSettings | None = None,
    outputs: tuple[str, ...] | str = ("depth",),
    couple_features: bool = True,
    lens: torch.Tensor | None = None,
    rays: torch.Tensor | np.ndarray | None = None,
) -> Output:
    """Render a view, or several of one size.

        g.means.requires_grad_()
        out = drgs.render(g, camera, drgs.RenderSettings.preset("fast"), outputs="depth")
        (out.rgb - photograph).square().mean().backward()  # out.rgb: (H, W, 3); now g.means.grad is there

    Args:
        gaussians: N Gaussians, world frame, or a `drgs.ellipsoids.Scene`, whose Gaussians at `camera.time` are seen.
        camera: A camera, or a list of cameras of one image size. The pose is differentiated when `camera.w2c` is a
            torch tensor that requires a gradient.
        settings: Default `RenderSettings.preset("exact")`.
        outputs: What to compute besides rgb, alpha and features: any of `OUTPUTS`, or "all". What is not asked for
            costs nothing.
        couple_features: Whether the feature image has derivatives by all that it depends on. If not, only by
            `features`: what is learned about them moves no Gaussian (Zhou et al. 2024, Feature 3DGS).
        lens: (5 + D,) a torch tensor in place of the cameras' `lens_parameters` (fx, fy, cx, cy, skew, distortion),
            which is differentiated, for responses along rays. Pixels at which a lens has no inverse have derivative 0.
        rays: (H, W, 6) origin and direction of each pixel, world frame, differentiable, instead of those of the camera,
            which still says whose z and distance count, and from where colors are seen; for responses along rays. A
            direction of 0 is no ray: its pixel shows the background. Fastest if origins lie close together: the list of
            Gaussians of a tile serves the rays from all of them.
    Returns:
        An `Output`; of a list of C cameras each tensor has a leading axis C, and `certificate` is a list.
    Raises:
        ValueError: If a parameter is not finite, an output is unknown, or cameras differ in size.
        NotImplementedError: If a model of the image plane (`ewa`) is used with a camera that has distortion or a
            rolling shutter, or with rays.
    Gradients:
        Of rgb, alpha, depth and features, with respect to means, quats, log_scales, logit_opacities, sh, features and
        the pose, in reverse mode (`backward`, `torch.func.grad`) and forward mode (`torch.func.jvp`,
        `torch.autograd.forward_ad`). Order, cut-offs and the extent are constants of the derivative. There are no
        second ones: what differentiates a derivative, or calls this from `torch.func.vmap`, as `jacrev`, `jacfwd` and
        `hessian` do, gets NotImplementedError. `torch.compile` leaves it out of its graphs.
    Reference:
        Kerbl et al. 2023 (compositing, SH); Moenne-Loccoz et al. 2024 (response at the peak of the ray).
    """
    if isinstance(camera, list | tuple):
        cameras = cameras_of_one_size("render", camera)
        wanted = _checked_outputs(outputs)
        return _batch([_view(gaussians, each, settings, wanted, couple_features, lens, rays) for each in cameras])
    return _view(gaussians, camera, settings, _checked_outputs(outputs), couple_features, lens, rays)


def _view(
    gaussians: Scene,
    camera: Camera,
    settings: RenderSettings | None,
    wanted: frozenset,
    couple: bool,
    lens: torch.Tensor | None,
    rays: torch.Tensor | np.ndarray | None,
) -> Output:
    if lens is not None:
        must_be("render", "lens", lens, torch.Tensor, "e.g. torch.tensor(camera.lens_parameters)")
        camera = camera.with_lens(lens)
        lens = lens.to("cpu", torch.float64)
    seen = gaussians_at("render", gaussians, camera)
    check_view("render", seen, camera, settings)
    settings = settings or RenderSettings.preset("exact")
    call = Call(seen, camera, settings, wanted, couple=couple, lens=lens, pixel_rays=rays)
    with own_errors():
        return call.output(differentiable(call))


def _batch(views: list[Output]) -> Output:
    """Views of one size with a leading axis."""
    parts = {field.name: [getattr(view, field.name) for view in views] for field in dataclasses.fields(Output)}
    certificates = parts.pop("certificate")
    stacked: dict[str, Any] = {name: None if x[0] is None else torch.stack(x) for name, x in parts.items()}
    return Output(**stacked, certificate=certificates)


@runtime.alone
def render_jvp(
    gaussians: Scene,
    camera: Camera,
    tangents: Mapping[str, torch.Tensor | Mapping[str, torch.Tensor]],
    settings: RenderSettings | None = None,
    outputs: tuple[str, ...] | str = ("depth",),
    couple_features: bool = True,
    rays: torch.Tensor | np.ndarray | None = None,
) -> Output:
    """Forward mode: how a view changes along tangents of its parameters.

        moved = drgs.render_jvp(g, camera, {"camera": torch.eye(6)}).rgb  # (6, H, W, 3): by each twist of the pose

    Args:
        gaussians, camera, settings, outputs, couple_features, rays: Arguments of `render` (median depth, count and
            visibility have no tangent).
        tangents: Name -> tangent of the raw parameter, shaped like it, optionally with a leading axis K (the same
            for all names). Names: `means`, `quats`, `log_scales`, `logit_opacities`, `sh`, `features`;
            `rotations` (N, 3), a world-frame left perturbation R <- exp([w]x) R; `camera` (6,), a world-frame twist of
            the pose, rotation first: c2w <- exp(xi) c2w, of a rolling shutter of the first line's, and `camera_end`
            (6,) of the last line's; `lens` (5 + D,), of the camera's `lens_parameters`; `rays` (H, W, 6) where these
            are given, which `camera` does not move. Of a `drgs.ellipsoids.DeformableScene` the names are those of its
            `parameters()` that are floats, `camera`, `lens`, and `rotations` where it has `quats`; `time`, a number:
            the tangent of the view's time; and `phi`, a mapping of x to the tangent of `phi.x`. So none of its own may
            be called `camera`, `camera_end`, `lens`, `rays`, `rotations`, `time`, `phi`, `w2c`, `ray_origins`,
            `ray_directions` or `ray_shifts`. The derivative with respect to time is the scene's own, one-sided at a
            kink (`drgs.DeformationField`).
    Returns:
        An `Output` of image-shaped tangents, with the leading axis K if the tangents had one. All K are carried
        through one traversal. They have no graph: nothing differentiates a tangent.
    Raises:
        ValueError: If a name or shape is wrong.
    """
    scene = gaussians if isinstance(gaussians, DeformableScene) else None
    seen = gaussians_at("render_jvp", gaussians, camera)
    check_view("render_jvp", seen, camera, settings)
    must_be("render_jvp", "tangents", tangents, Mapping, 'e.g. {"camera": torch.eye(6)}')
    tangents = dict(tangents)
    if isinstance(phi := tangents.get("phi"), Mapping):
        del tangents["phi"]
        tangents |= {f"phi.{name}": x for name, x in phi.items()}
    settings = settings or RenderSettings.preset("exact")
    # The tangents are given: a graph of torch would lead nowhere.
    want = _checked_outputs(outputs) & {"depth"}
    timed = "time" in tangents and camera.time is not None
    lens = torch.from_numpy(camera.lens_parameters) if "lens" in tangents else None
    call = Call(
        seen.detach(),
        camera,
        settings,
        want,
        scene=scene,
        couple=couple_features,
        timed=timed,
        lens=lens,
        pixel_rays=rays,
    )
    with own_errors():
        return push_forward(call, tangents)


@runtime.alone
def render_with_offsets(
    gaussians: Gaussians,
    camera: Camera,
    settings: RenderSettings,
    outputs: tuple[str, ...] | str = (),
    rays: torch.Tensor | np.ndarray | None = None,
    mean_offsets: torch.Tensor | None = None,
    mean_absolute: torch.Tensor | None = None,
    strains: torch.Tensor | None = None,
) -> Output:
    """`render` with derivatives by more than parameters of Gaussians: by projected means, which density control of
    rasterizers reads, and by covariances.

    Args:
        gaussians, camera, settings, outputs, rays: Arguments of `render`.
        mean_offsets: (N, 2) zeros in pixels, added to the projected means of a model of the image plane; the derivative
            by them is that by the projected means, all else held.
        mean_absolute: (N, 2) zeros; what a backward pass gives as their gradient is the sum over all pixels of the
            absolute value of each pixel's gradient by the projected means (Ye et al. 2024, AbsGS).
        strains: (N, 6) zeros, the elements xx, xy, xz, yy, yz, zz of a symmetric E that stretches each Gaussian by
            I + E along its own axes: `drgs.splats.covariances.factors`.
    Returns:
        An `Output`, with the gradients of `render` and by these three.
    """
    check_view("render", gaussians, camera, settings)
    of_means = {"mean_offsets": mean_offsets, "mean_absolute": mean_absolute, "strains": strains}
    call = Call(gaussians, camera, settings, _checked_outputs(outputs), pixel_rays=rays, of_means=of_means)
    with own_errors():
        return call.output(differentiable(call))


@runtime.alone
def render_normals(
    gaussians: Scene,
    camera: Camera,
    settings: RenderSettings | None = None,
    rays: torch.Tensor | np.ndarray | None = None,
) -> torch.Tensor:
    """(H, W, 3) sum of w n over the Gaussians of each pixel, world frame: n is the third axis of a Gaussian's rotation,
    that of its two directions that looks against the ray.

    It is neither of unit length nor divided by alpha, as gsplat's `return_normals`. A disc's third axis is its normal
    where its third scale is the smallest; of other Gaussians an axis is what it is.

    Args:
        gaussians, camera, settings, rays: Arguments of `render`; for responses along rays.
    Raises:
        NotImplementedError: If the response is a model of the image plane (`ewa`).
    Gradients:
        Those of `render`, in reverse and forward mode; which of the two directions is taken has none.
    """
    seen = gaussians_at("render_normals", gaussians, camera)
    check_view("render_normals", seen, camera, settings)
    settings = settings or RenderSettings.preset("exact")
    if settings.planar:
        raise NotImplementedError(
            f"render_normals: the response must be one along rays, got {settings.response!r}; use preset exact, fast "
            "or 3dgut"
        )
    w, x, y, z = torch.nn.functional.normalize(seen.quats.double(), dim=1).unbind(1)
    axis = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    # SH of degree 1 along each ray give hits its direction; their color is not used.
    plain = seen.replace(sh=seen.sh.new_zeros(len(seen), 4, 3), features=axis.to(seen.sh.dtype))
    black = settings.replace(sh_direction="ray", background=(0.0, 0.0, 0.0))
    call = Call(plain, camera, black, frozenset(), pixel_rays=rays, oriented=True)
    with own_errors():
        found = call.output(differentiable(call)).features
    assert found is not None  # three channels of features were given
    return found


@runtime.alone
def render_rays(
    gaussians: Gaussians,
    origins: torch.Tensor | np.ndarray,
    directions: torch.Tensor | np.ndarray,
    settings: RenderSettings | None = None,
    outputs: tuple[str, ...] | str = ("depth",),
    couple_features: bool = True,
) -> Output:
    """Render arbitrary rays on the `bvh` traversal: fisheye, panoramas, lidar, thin lenses.

    Args:
        origins, directions: (..., 3) world frame, of shapes that broadcast; directions need not be normalized.
            Differentiable torch tensors or arrays. With SH of degree 1 to 3 and `sh_direction="gaussian"`, which gives
            a Gaussian one color for all rays, all origins are the same.
        settings: Settings with traversal `bvh`; default `exact`. `order="center"` sorts by the distance to the first
            origin.
        outputs, couple_features: Arguments of `render`.
    Returns:
        An `Output` with the leading shape of the rays instead of (H, W).
    Raises:
        ValueError: If a ray is not finite, a direction is 0, shapes do not broadcast, origins differ where they must
            not, or settings are about a camera's axis (`near`, `z`).
        NotImplementedError: If the traversal is not `bvh`.
    Gradients:
        Those of `render`, with respect to origins and directions in place of the pose. Of origins that are the same,
        what colors say by SH is shared among all evenly.
    """
    if isinstance(gaussians, Scene) and not isinstance(gaussians, Gaussians):
        raise ArgumentError(
            f"render_rays: gaussians must be Gaussians, as rays have no time, got {kind_of(gaussians)}; "
            "use scene.at(time)"
        )
    check_scene("render_rays", gaussians, settings)
    settings = settings or RenderSettings.preset("exact", traversal="bvh")
    if settings.traversal != "bvh":
        raise NotImplementedError("render_rays: arbitrary rays must have traversal='bvh', got 'tiles'")
    call = Call(
        gaussians, None, settings, _checked_outputs(outputs), rays=(origins, directions), couple=couple_features
    )
    with own_errors():
        return call.output(differentiable(call))


def _checked_outputs(outputs: Iterable[str]) -> frozenset[str]:
    if outputs == "all":
        outputs = OUTPUTS
    if isinstance(outputs, str):
        outputs = (outputs,)
    must_be("render", "outputs", outputs, Iterable, f'any of {", ".join(OUTPUTS)}, or "all"')
    unknown = [name for name in outputs if name not in OUTPUTS]
    if unknown:
        raise ValueError(f"render: outputs must be among {', '.join(OUTPUTS)}, got {unknown[0]!r}")
    return frozenset(_NAMES[name] for name in outputs)
