"""`drgs.rasterization`: our renderer behind the call that users of gsplat know.

Argument names, shapes, defaults and meanings are those of `gsplat.rasterization` 1.5.3, so that a script changes one
import and runs without CUDA. What gsplat can do and this cannot is refused by name; what only steers gsplat's memory
and speed (`packed`, `tile_size`, `channel_chunk`, `segmented`) is accepted and changes nothing.

What the tensors are in raw parameters is said in splats.py. Depth of the rasterizers' model is a Gaussian's own z, as
in gsplat.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import semi_axes
from drgs.integrator import render
from drgs.runtime import uncompiled
from drgs.settings import EPS_ALPHA, RenderSettings
from drgs.splats import Splats, cameras_of, check_shapes, inside, inside_opacities

__all__ = ["rasterization"]

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Defaults of gsplat's signature: another preset's own constants hold unless an argument differs from these.
_NEAR = 0.01
_FAR = 1e10
_DILATION = 0.3
# What to do instead of an option that does not exist here.
_RAYS = "use drgs.integrator.render_rays with your own rays"
_LENSES = "lenses are traced by drgs.render with traversal='bvh'"
_INSTEAD = {
    "sparse_grad": "gradients are dense here; drop it",
    "absgrad": "there are no gradients of projected means; use gsplat's MCMCStrategy, which needs none",
    "distributed": "one process renders; split the cameras among processes yourself",
    "covars": "pass quats and scales, e.g. from an eigendecomposition",
    "with_ut": "there is no unscented transform; preset='exact' evaluates along true rays",
    "with_eval3d": "preset='exact' or 'fast' evaluates the response in 3D",
    "radial_coeffs": _LENSES,
    "tangential_coeffs": _LENSES,
}


@uncompiled
def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = _NEAR,
    far_plane: float = _FAR,
    radius_clip: float = 0.0,
    eps2d: float = _DILATION,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: object | None = None,
    rolling_shutter: object | None = None,
    viewmats_rs: torch.Tensor | None = None,
    *,
    preset: str | RenderSettings = "gsplat",
) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """Draw Gaussians from C cameras, as `gsplat.rasterization` does.

        colors, alphas, info = drgs.rasterization(means, quats, scales, opacities, rgb, viewmats, Ks, width, height)

    Args:
        means: (..., N, 3), world frame.
        quats: (..., N, 4) wxyz, not necessarily normalized.
        scales: (..., N, 3) standard deviations, >= 0.
        opacities: (..., N) in [0, 1].
        colors: (..., N, D) or (..., C, N, D), used as they are, any D; with `sh_degree` coefficients (..., N, K, 3) or
            (..., C, N, K, 3), of which the first (sh_degree + 1)^2 are used.
        viewmats: (..., C, 4, 4) world to camera, OpenCV axes.
        Ks: (..., C, 3, 3) in pixels, pixel centers at +0.5. A skew is followed (gsplat ignores it).
        width, height: Size of every image, in pixels.
        near_plane, far_plane: Means outside of (near_plane, far_plane] in camera z are left out.
        radius_clip: Gaussians whose radius (`meta["radii"]`) is at most this many pixels in both axes are left out.
        eps2d: Added to the diagonal of the projected covariance, in px^2.
        sh_degree: 0 to 3, or None for plain colors.
        backgrounds: (..., C, D) or None for black; behind a depth there is 0.
        render_mode: RGB, D (sum w z), ED (that over alpha), RGB+D or RGB+ED (depth as the last channel).
        rasterize_mode: classic, or antialiased: opacities times sqrt(det Sigma / det (Sigma + eps2d I)).
        preset: A preset's name or `RenderSettings`. Of others than `gsplat`, `near_plane` and `eps2d` replace the
            preset's own constants only where they are not gsplat's defaults; those without projected covariance
            (`exact`, `fast`) have no eps2d and no antialiased mode, and their z is that of the peak on each ray.
    Returns:
        colors (..., C, H, W, X), alphas (..., C, H, W, 1), in the precision of `means`, and a dict: `radii` (..., C, N,
        2) int32 in pixels, 0 where a Gaussian is left out; `means2d` (..., C, N, 2), `depths` (..., C, N), `conics`
        (..., C, N, 3), valid where radii > 0, without a graph; `opacities` (..., C, N); `width`, `height`,
        `n_batches`, `n_cameras`.
    Raises:
        ValueError: If a shape or value is wrong.
        NotImplementedError: If an option of gsplat's is asked for that does not exist here; the way round is named.
    Gradients:
        With respect to means, quats, scales, opacities, colors, viewmats and backgrounds, in reverse and forward mode;
        with respect to viewmats along rigid motions only (`drgs.cameras.rigid`): what a 4x4 matrix can do besides, and
        gsplat differentiates too, is no motion of a camera.
        No gradient passes through `means2d`: density control that needs its norm (gsplat's DefaultStrategy) has none,
        gsplat's MCMCStrategy works.
    Reference:
        V. Ye et al., gsplat, JMLR 26, 2025; Z. Yu et al., Mip-Splatting, CVPR 2024 (antialiased).
    """
    _refuse(
        sparse_grad=sparse_grad,
        absgrad=absgrad,
        distributed=distributed,
        covars=covars is not None,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None,
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        rolling_shutter=rolling_shutter is not None and getattr(rolling_shutter, "name", "") != "GLOBAL",
        viewmats_rs=viewmats_rs is not None,
        camera_model=camera_model != "pinhole",
    )
    if not near_plane < far_plane:
        raise ValueError(
            f"rasterization: near_plane must be less than far_plane, got {near_plane:g} and {far_plane:g}; swap them"
        )
    _one_of("render_mode", render_mode, RENDER_MODES)
    _one_of("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    settings = _settings(preset, near_plane, eps2d, rasterize_mode)
    lead, count = check_shapes(
        "rasterization", means, quats, scales, opacities, colors, viewmats, Ks, sh_degree, backgrounds
    )
    scales, opacities = inside("rasterization", scales, opacities)
    by_camera = colors.ndim == len(lead) + (3 if sh_degree is None else 4)
    batches = math.prod(lead)
    if not batches or not count:
        raise ValueError(
            f"rasterization: viewmats must hold at least one camera, got shape {tuple(viewmats.shape)}; skip the call"
        )
    of = lambda x: x.reshape(batches, *x.shape[len(lead) :])  # noqa: E731
    means_b, quats_b, scales_b, opacities_b, colors_b, viewmats_b, Ks_b = map(
        of, (means, quats, scales, opacities, colors, viewmats, Ks)
    )
    behind_b = None if backgrounds is None else of(backgrounds)
    made = []
    for b in range(batches):
        for c, camera in enumerate(cameras_of(viewmats_b[b], Ks_b[b], width, height)):
            shown = colors_b[b, c] if by_camera else colors_b[b]
            made.append(
                _view(
                    Splats(means_b[b], quats_b[b], scales_b[b], opacities_b[b], shown, sh_degree),
                    camera,
                    settings,
                    render_mode,
                    rasterize_mode == "antialiased",
                    (far_plane, radius_clip),
                    None if behind_b is None else behind_b[b, c],
                )
            )
    images, alphas = (
        torch.stack(x).reshape(*lead, count, *x[0].shape) for x in zip(*(v[:2] for v in made), strict=True)
    )
    meta: dict[str, Any] = {
        name: torch.stack([v[2][name] for v in made]).reshape(*lead, count, *made[0][2][name].shape)
        for name in made[0][2]
    }
    meta |= {"width": width, "height": height, "n_batches": batches, "n_cameras": count}
    return images, alphas, meta


def _view(
    splats: Splats,
    camera: Camera,
    settings: RenderSettings,
    mode: str,
    antialiased: bool,
    limits: tuple[float, float],
    background: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    """One image (H, W, X), its alpha (H, W, 1), and the arrays of `meta`."""
    far, clip = limits
    meta, compensation = _projected(splats, camera, settings, antialiased)
    if compensation is not None:
        splats = dataclasses.replace(splats, opacities=inside_opacities(splats.opacities * compensation))
    # `meta` is to be looked at: no gradient passes through it.
    meta["opacities"] = splats.opacities.detach().to(splats.means.dtype)
    # A Gaussian that is left out must not be drawn: the renderer itself knows no far plane and no smallest radius.
    kept = (meta["depths"] <= far) & (meta["depths"] > settings.near)
    if clip > 0:
        kept &= (meta["radii"] > clip).any(-1)
    meta["radii"] = meta["radii"] * kept[:, None]
    if not bool(kept.all()) and (far < _FAR or clip > 0):
        splats = splats.take(kept.nonzero()[:, 0])
    gaussians, shift = splats.gaussians(with_color="RGB" in mode)
    out = render(gaussians, camera, settings, outputs=("depth",) if "D" in mode else ())
    alpha = out.alpha[..., None]
    channels = []
    if "RGB" in mode:
        width = 3 if splats.degree is not None else min(3, splats.colors.shape[1])
        color = out.rgb[..., :width] - shift * alpha
        if out.features is not None:
            color = torch.cat([color, out.features], -1)
        channels.append(color if background is None else color + (1 - alpha) * background)
    if out.depth is not None:
        depth = out.depth[..., None]
        if not settings.planar:
            depth = depth * _z_of_rays(camera).to(depth)  # along the ray -> along the axis
        channels.append(depth if "ED" in mode else depth * alpha.clamp_min(EPS_ALPHA))
    kind = splats.means.dtype
    return torch.cat(channels, -1).to(kind), alpha.to(kind), meta


def _projected(
    splats: Splats, camera: Camera, settings: RenderSettings, antialiased: bool
) -> tuple[dict[str, torch.Tensor], torch.Tensor | None]:
    """gsplat's `meta` of a view, without a graph, and the compensation of opacities, (N,), with one.

    Sigma' = J W Sigma W^T J^T, J the derivative of the projection at the mean, its slopes clamped where the settings
    clamp them.
    """
    with torch.set_grad_enabled(antialiased and torch.is_grad_enabled()):
        like: dict[str, Any] = {"dtype": torch.float64, "device": splats.means.device}
        w2c = torch.as_tensor(camera.w2c).to(**like)
        fx, skew, cx, fy, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
        x, y, z = (splats.means.to(**like) @ w2c[:3, :3].T + w2c[:3, 3]).unbind(1)
        valid = z.detach() > settings.near  # which ones are drawn is a constant of every derivative
        z = torch.where(valid, z, 1)  # the others have no projection
        u, v = x / z, y / z
        means2d = torch.stack([fx * u + skew * v + cx, fy * v + cy], 1)
        # The Jacobian of a mean far outside of the view is that at the view's widened edge, and has no derivative by
        # where the mean is along that axis: the rasterizers' own rule.
        if settings.fov_clamp == "gsplat":
            half = 0.15 * camera.width / fx, 0.15 * camera.height / fy
            u = u.clamp(-cx / fx - half[0], (camera.width - cx) / fx + half[0])
            v = v.clamp(-cy / fy - half[1], (camera.height - cy) / fy + half[1])
        elif settings.fov_clamp == "inria":
            u, v = (a.clamp(-0.65 * n / f, 0.65 * n / f) for a, n, f in ((u, camera.width, fx), (v, camera.height, fy)))
        zero = torch.zeros_like(z)
        rows = [fx / z, skew / z + zero, -(fx * u + skew * v) / z, zero, fy / z, -fy * v / z]
        half_axes = (
            torch.stack(rows, 1).reshape(-1, 2, 3)
            @ w2c[:3, :3]
            @ semi_axes(splats.quats.to(**like), splats.scales.to(**like))
        )
        a, b = half_axes.unbind(1)
        # The Gram determinant of the rows: thin projections do not cancel as in xx yy - xy^2.
        sharp = torch.linalg.cross(a, b).square().sum(1)
        xx = a.square().sum(1)
        yy = b.square().sum(1)
        xy = (a * b).sum(1)
        eps = settings.dilation
        blurred = sharp + eps * (xx + yy + eps)
        compensation = None
        if antialiased:
            # The square root has no derivative at 0, where the opacity is 0 anyway.
            compensation = (sharp.clamp_min(1e-30) / blurred).sqrt().to(splats.means.dtype)
    with torch.no_grad():  # `meta` has no graph
        opacity = splats.opacities.to(**like) * (1 if compensation is None else compensation)
        extent = (2 * (255 * opacity).clamp_min(1).log()).sqrt().clamp_max(3.33)
        valid = valid & (opacity >= 1 / 255)  # not in place: the graph of z keeps the mask
        radii = torch.ceil(extent[:, None] * torch.stack([xx + eps, yy + eps], 1).sqrt())
        size = torch.tensor([camera.width, camera.height], **like)
        valid = valid & ((means2d + radii > 0) & (means2d - radii < size)).all(1)
        conics = torch.stack([yy + eps, -xy, xx + eps], 1) / blurred[:, None]
        kind = splats.means.dtype
        meta = {
            "radii": (radii * valid[:, None]).to(torch.int32),
            "means2d": means2d.detach().to(kind),  # has a graph in antialiased mode
            "depths": torch.where(valid, z, 0).to(kind),
            "conics": conics.detach().to(kind),  # as means2d
        }
    return meta, compensation


def _z_of_rays(camera: Camera) -> torch.Tensor:
    """(H, W, 1) z of the unit direction of every pixel."""
    identity = dataclasses.replace(camera, w2c=torch.eye(4, dtype=torch.float64).numpy())
    return torch.from_numpy(identity.pixel_directions()[..., 2:])


def _settings(preset: str | RenderSettings, near: float, eps2d: float, mode: str) -> RenderSettings:
    """The preset with gsplat's arguments put in, on a black background (ours are added in torch)."""
    settings = preset if isinstance(preset, RenderSettings) else RenderSettings.preset(preset)
    black = settings.replace(background=(0.0, 0.0, 0.0))
    if preset == "gsplat" or near != _NEAR:
        black = black.replace(near=near)
    if preset == "gsplat" or eps2d != _DILATION:
        black = black.replace(dilation=eps2d)
    if mode == "antialiased" and not black.planar:
        raise NotImplementedError(
            "rasterization: rasterize_mode='antialiased' must have a preset with projected covariances, got "
            f"preset={preset!r}; use preset='gsplat' or 'inria', or rasterize_mode='classic'"
        )
    return black


def _refuse(**asked: bool) -> None:
    """Raise NotImplementedError for the first option of gsplat's that is asked for."""
    for name, is_asked in asked.items():
        if is_asked:
            raise NotImplementedError(f"rasterization: {name} is not supported; {_INSTEAD.get(name, _RAYS)}")


def _one_of(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ValueError(f"rasterization: {name} must be one of {', '.join(allowed)}, got {value!r}")
