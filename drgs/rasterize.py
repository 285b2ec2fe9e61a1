"""`drgs.rasterization`: our renderer behind the call that users of gsplat know.

Argument names, shapes, defaults and meanings are those of `gsplat.rasterization` 1.6, so that a script changes one
import and runs without CUDA: the rasterizer's own model, and, with `with_eval3d`, that of 3DGUT, through lenses,
rolling shutters and rays of the caller's own. What gsplat can do and this cannot is refused by name; what only steers
gsplat's memory and speed (`packed`, `tile_size`, `segmented`, `macro_tile`, `renderer_config`) is accepted and changes
nothing.

What the tensors are in raw parameters is said in splats.py, how covariances are differentiated in covariances.py.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.shutters import SHUTTERS
from drgs.checks.arguments import ArgumentError
from drgs.checks.torch_func import is_wrapped
from drgs.ellipsoids import Y_00, semi_axes
from drgs.integrator import render_normals, render_with_offsets
from drgs.runtime import uncompiled
from drgs.settings import EPS_ALPHA, RenderSettings
from drgs.splats import Splats, cameras_of, check_shapes, inside, inside_opacities
from drgs.splats.covariances import factors, strained
from drgs.tracing.harmonics import higher_harmonics
from drgs.tracing.pose import rigid_pose
from drgs.tracing.shutter import middle_pose
from drgs.tracing.unscented import (
    COVARIANCE_WEIGHTS,
    DILATION,
    EXTENT,
    LEAST_COMPENSATION,
    LEAST_OPACITY,
    MARGIN,
    MEAN_WEIGHTS,
    SPREAD,
)

__all__ = ["rasterization"]

# Defaults of gsplat's signature: another preset's own constants hold unless an argument differs from these.
_NEAR = 0.01  # scene units
_FAR = 1e10  # scene units: no far plane
_DILATION = 0.3  # px^2


@dataclasses.dataclass(frozen=True)
class _Mode:
    """The outputs of a `render_mode`.

    Attributes:
        color: Colors.
        depth: A last channel: `gaussian`, the depth of each Gaussian, `hit`, the distance along the ray, or none.
        expected: That channel is divided by alpha.
    """

    color: bool
    depth: str | None = None
    expected: bool = False


_MODES = {
    "RGB": _Mode(True),
    "D": _Mode(False, "gaussian"),
    "ED": _Mode(False, "gaussian", True),
    "RGB+D": _Mode(True, "gaussian"),
    "RGB+ED": _Mode(True, "gaussian", True),
    "d": _Mode(False, "hit"),
    "Ed": _Mode(False, "hit", True),
    "RGB-d": _Mode(True, "hit"),
    "RGB-Ed": _Mode(True, "hit", True),
}
"""gsplat's `render_mode`s."""

# What to do instead of an option that does not exist here.
_RAYS = "pass its rays as rays=, with with_eval3d=True"
_INSTEAD = {
    "sparse_grad": "gradients are dense here; drop it",
    "distributed": "one process renders; split the cameras among processes yourself",
    "lidar_coeffs": _RAYS,
    "external_distortion_coeffs": _RAYS,
    "camera_model='ortho'": _RAYS,
    "camera_model='lidar'": _RAYS,
    "with_ut without with_eval3d": "2D Gaussians come from EWA only; pass with_eval3d=True, too, or drop with_ut",
}


@uncompiled
def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor | None,
    scales: torch.Tensor | None,
    opacities: torch.Tensor,
    colors: torch.Tensor | None,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = _NEAR,
    far_plane: float = _FAR,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: torch.Tensor | None = None,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: object | None = None,
    lidar_coeffs: object | None = None,
    external_distortion_coeffs: object | None = None,
    rolling_shutter: object | None = None,
    viewmats_rs: torch.Tensor | None = None,
    ut_params: object | None = None,
    extra_signals: torch.Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: object | None = None,
    *,
    channel_chunk: int = 32,
    preset: str | RenderSettings | None = None,
) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """Draw Gaussians from C cameras, as `gsplat.rasterization` does.

        colors, alphas, info = drgs.rasterization(means, quats, scales, opacities, rgb, viewmats, Ks, width, height)

    Args:
        means: (..., N, 3), world frame.
        quats: (..., N, 4) wxyz, not necessarily normalized; None with `covars`.
        scales: (..., N, 3) standard deviations, >= 0; None with `covars`.
        opacities: (..., N) in [0, 1].
        colors: (..., N, D) or (..., C, N, D), used as they are, any D; with `sh_degree` coefficients (N, K, D), shared
            by all batches and cameras, or (..., N, K, D) or (..., C, N, K, D), of which the first (sh_degree + 1)^2 are
            used. None where only a depth is drawn.
        viewmats: (..., C, 4, 4) world to camera, OpenCV axes.
        Ks: (..., C, 3, 3) in pixels, pixel centers at +0.5. A skew is followed (gsplat ignores it).
        width, height: Size of every image, in pixels.
        near_plane, far_plane: Means outside of (near_plane, far_plane] in camera z are left out, in distance with
            `with_eval3d` and `global_z_order=False`.
        radius_clip: Gaussians whose radius (`meta["radii"]`) is at most this many pixels in both axes are left out.
        eps2d: Added to the diagonal of the projected covariance, in px^2. With `with_eval3d` nothing is
            added; the boxes of `with_ut` always have 0.3.
        sh_degree: 0 to 3, or None for plain colors.
        backgrounds: (..., C, D) or None for black; behind a depth there is 0.
        render_mode: RGB; D (sum w z), ED (that over alpha), RGB+D, RGB+ED: the Gaussian's own depth as the last
            channel; d, Ed, RGB-d, RGB-Ed: the distance along the ray, of responses along rays.
        absgrad: Whether a backward pass leaves the sum over all pixels of the absolute gradients by projected means in
            `meta["means2d"].absgrad`, in pixels; of the rasterizer's own model.
        rasterize_mode: classic, or antialiased: opacities times sqrt(det Sigma / det (Sigma + eps2d I)).
        camera_model: One of pinhole and fisheye, which are OpenCV's, and ftheta, NVIDIA's.
        covars: (..., N, 3, 3) covariances instead of `quats` and `scales`, symmetric: both elements off the diagonal
            get half of the derivative by their common value.
        with_eval3d: Gaussians are evaluated along rays, as 3DGUT does: preset `3dgut`.
        with_ut: Whether, with `with_eval3d`, tiles are those of the boxes of the unscented transform, as gsplat's are;
            else nothing is left out.
        return_normals: `meta["normals"]` (..., C, H, W, 3), sum w n of the axis that looks against the ray.
        global_z_order: Gaussians are sorted by z; else by their distance, which is the depth of D and ED then.
        rays: (..., C, H, W, 6) origin and direction of each pixel, world frame, differentiable; with `with_eval3d`.
        radial_coeffs: (..., C, 6) k1 to k6 of a pinhole, (..., C, 4) k1 to k4 of a fisheye; no gradient.
        tangential_coeffs: (..., C, 2) p1, p2.
        thin_prism_coeffs: (..., C, 4) s1 to s4.
        ftheta_coeffs: Parameters of camera_model ftheta: gsplat's `FThetaCameraDistortionParameters`, or what has its
            attributes, whose reference is the polynomial from angles to pixels.
        rolling_shutter: A member of gsplat's `RollingShutterType`, or its name.
        viewmats_rs: (..., C, 4, 4) poses at the end of the exposure, of rolling shutters.
        extra_signals: (..., N, E) or (..., C, N, E), more channels, drawn to `meta["render_extra_signals"]` (..., C, H,
            W, E) on nothing; with `extra_signals_sh_degree` coefficients (N, K, E).
        preset: A preset's name or `RenderSettings`; None is gsplat's own, `gsplat`, or `3dgut` with `with_eval3d`. Of
            others than `gsplat`, `near_plane` and `eps2d` replace the preset's own constants only where they are not
            gsplat's defaults, and its own depth key and culling hold; those without projected covariance (`exact`,
            `fast`) have no eps2d and no antialiased mode, and the z of D is that of the peak on each ray.
    Returns:
        colors (..., C, H, W, X), alphas (..., C, H, W, 1), in the precision of `means`, and a dict: `radii` (..., C, N,
        2) int32 in pixels, 0 where a Gaussian is left out; `means2d` (..., C, N, 2), `depths` (..., C, N), `conics`
        (..., C, N, 3), valid where radii > 0; `opacities` (..., C, N); `width`, `height`, `n_batches`, `n_cameras`;
        None for what only packed arrays have; and what `return_normals` and `extra_signals` add. Only `means2d` may
        have a gradient.
    Raises:
        ValueError: If a shape or value is wrong.
        NotImplementedError: If an option of gsplat's is used that does not exist here; the way round is named.
    Gradients:
        With respect to means, quats, scales, covars, opacities, colors, extra signals, viewmats, viewmats_rs, rays and
        backgrounds, in reverse and forward mode; with respect to viewmats along rigid motions only
        (`drgs.cameras.rigid`): what a 4x4 matrix can do besides, and gsplat differentiates too, is no motion of a
        camera. Of the rasterizer's model `meta["means2d"]` is a leaf whose gradient is that of the projected means, in
        pixels, as gsplat's density control reads it; `means` have their own, of which that is a part.
    Reference:
        V. Ye et al., gsplat, JMLR 26, 2025; Z. Yu et al., Mip-Splatting, CVPR 2024 (antialiased); Q. Wu et al., 3DGUT,
        CVPR 2025.
    """
    _one_of("render_mode", render_mode, list(_MODES))
    _one_of("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    _refuse(
        sparse_grad=sparse_grad,
        distributed=distributed,
        lidar_coeffs=lidar_coeffs is not None,
        external_distortion_coeffs=external_distortion_coeffs is not None,
        **{f"camera_model={name!r}": camera_model == name for name in ("ortho", "lidar")},
        **{"with_ut without with_eval3d": with_ut and not with_eval3d},
    )
    _check_unscented(ut_params)
    if not near_plane < far_plane:
        raise ValueError(
            f"rasterization: near_plane must be less than far_plane, got {near_plane:g} and {far_plane:g}; swap them"
        )
    mode = _MODES[render_mode]
    antialiased = rasterize_mode == "antialiased"
    settings = _settings_of(preset, near_plane, eps2d, antialiased, with_eval3d, with_ut, global_z_order)
    quats, scales, strains = _shapes_of(quats, scales, covars, tuple(means.shape[:-1]), return_normals)
    if colors is None or not mode.color:
        colors, sh_degree, backgrounds = torch.zeros_like(means[..., :1]), None, None
    lead = tuple(means.shape[:-2])
    colors = _expanded_to_batches(colors, sh_degree, lead)
    shown = colors
    if sh_degree is not None and colors.ndim and colors.shape[-1] != 3:
        shown = colors[..., :1].expand(*colors.shape[:-1], 3)  # SH of other channels: evaluated by `_View`
    checked_backgrounds = None if shown is not colors else backgrounds
    lead, count = check_shapes(
        "rasterization", means, quats, scales, opacities, shown, viewmats, Ks, sh_degree, checked_backgrounds
    )
    _check_shape("backgrounds", backgrounds, (*lead, count, colors.shape[-1]))
    _check_shape("viewmats_rs", viewmats_rs, (*lead, count, 4, 4))
    scales, opacities = inside("rasterization", scales, opacities)
    batches = math.prod(lead)
    if not batches or not count:
        raise ValueError(
            f"rasterization: viewmats must hold at least one camera, got shape {tuple(viewmats.shape)}; skip the call"
        )
    shutter = _shutter_of(rolling_shutter, viewmats_rs)
    coefficients = radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs
    lenses = _lenses_of(camera_model, lead, count, *coefficients, Ks)
    _check_along_rays(settings, shutter != "global", bool(lenses[0][0]), rays, mode, return_normals)
    _check_shape("rays", rays, (*lead, count, height, width, 6))
    extra = None if extra_signals is None else _expanded_to_batches(extra_signals, extra_signals_sh_degree, lead)
    _check_extra(extra, extra_signals_sh_degree, lead, count, means.shape[-2])
    options = _Options(
        settings=settings,
        mode=mode,
        antialiased=antialiased,
        with_ut=with_ut and with_eval3d,
        gsplat_depth=with_eval3d and preset is None,
        near=near_plane if with_eval3d and preset is None else settings.near,
        far=far_plane,
        clip=radius_clip,
        extra_degree=extra_signals_sh_degree,
        normals=return_normals,
    )
    leaf = _means2d_leaf(means, viewmats, opacities, settings, lead, count)
    absolute = _absgrad_leaf(leaf) if absgrad else None

    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "strains": strains}
    given |= {"colors": colors, "extra": extra, "viewmats": viewmats, "viewmats_rs": viewmats_rs, "Ks": Ks}
    given |= {"backgrounds": backgrounds, "rays": rays, "leaf": leaf, "absolute": absolute}
    # All leading axes as one.
    flat = {name: x.reshape(batches, *x.shape[len(lead) :]) for name, x in given.items() if x is not None}
    views = []
    for b in range(batches):
        if "viewmats_rs" in flat:
            ends = zip(lenses[b], flat["viewmats_rs"][b], strict=True)
            lenses[b] = [lens | {"shutter": shutter, "w2c_end": end} for lens, end in ends]
        for c, camera in enumerate(cameras_of(flat["viewmats"][b], flat["Ks"][b], width, height, lenses[b])):
            # Each view has slices of its own: gradients are then added up view by view.
            views.append(_view_of(options, {name: x[b] for name, x in flat.items()}, c, camera, sh_degree))
    images, alphas, meta = _drawn(views, (*lead, count))
    if leaf is not None:
        with torch.no_grad():  # its values; the graph of every view begins at the leaf
            leaf.copy_(meta["means2d"])
        meta["means2d"] = leaf
    meta |= {"width": width, "height": height, "n_batches": batches, "n_cameras": count}
    meta |= dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))  # of packed arrays, which these are not
    return images, alphas, meta


@dataclasses.dataclass(frozen=True)
class _Options:
    """The settings that all views of a call share.

    Attributes:
        settings: The renderer.
        mode: What is drawn.
        antialiased: Opacities are compensated for the dilation.
        with_ut: `meta` is that of the unscented transform.
        gsplat_depth: Depths are the Gaussians' own by `depth_key`, drawn as a feature.
        near, far: Means whose depth is not in (near, far] are left out.
        clip: Gaussians of at most this radius, in pixels, are left out.
        extra_degree: SH degree of the extra signals; None of plain ones.
        normals: Whether normals are drawn, too.
    """

    settings: RenderSettings
    mode: _Mode
    antialiased: bool
    with_ut: bool
    gsplat_depth: bool
    near: float
    far: float
    clip: float
    extra_degree: int | None
    normals: bool


@dataclasses.dataclass
class _View:
    """One image of `rasterization`.

    Attributes:
        options: What it has in common with the others.
        splats, camera: What is drawn, and from where.
        extra: (N, E) or (N, K, E) extra signals.
        background: (D,) behind the colors.
        rays: (H, W, 6) of the caller's own.
        leaf: (N, 2) part of what becomes `meta["means2d"]`.
        absolute: (N, 2) zeros, for absolute gradients.
    """

    options: _Options
    splats: Splats
    camera: Camera
    extra: torch.Tensor | None
    background: torch.Tensor | None
    rays: torch.Tensor | None
    leaf: torch.Tensor | None
    absolute: torch.Tensor | None

    def draw(self) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """The image (H, W, X), its alpha (H, W, 1), and the arrays of `meta`."""
        o, camera, splats = self.options, self.camera, self.splats
        settings = o.settings
        local, center = self._means_in_camera()
        own = local[:, 2:] if settings.depth_key == "z" else local.norm(dim=1, keepdim=True)
        cut = (own[:, 0] if o.gsplat_depth else local[:, 2]).detach()  # what near and far planes look at
        meta, compensation = self._projected(cut)
        if compensation is not None:
            splats = dataclasses.replace(splats, opacities=inside_opacities(splats.opacities * compensation))
        # `meta` is for reading: no gradient passes through it.
        meta["opacities"] = splats.opacities.detach().to(splats.means.dtype)
        extra = self.extra
        if extra is not None and o.extra_degree is not None:
            extra = _evaluated(extra, o.extra_degree, splats.means - center)
        if splats.degree is not None and (camera.is_rolling or splats.colors.shape[-1] != 3):
            # As gsplat: of a rolling shutter from the middle of both centers; other numbers of channels one by one.
            colors = _evaluated(splats.colors, splats.degree, splats.means - center).clamp_min(0)
            splats = dataclasses.replace(splats, colors=colors, degree=None)
        added = [] if extra is None else [extra]
        own_depth = o.gsplat_depth and o.mode.depth == "gaussian"
        if own_depth:
            added.append(own.to(splats.means.dtype))
        offsets = None if self.leaf is None else self.leaf - self.leaf.detach()  # zeros with its derivative
        absolute = self.absolute
        kept = self._is_drawn(meta, cut)
        meta["radii"] = meta["radii"] * kept[:, None]
        if not bool(kept.all()) and (o.far < _FAR or o.clip > 0 or o.near > settings.near):
            index = kept.nonzero()[:, 0]
            splats = splats.take(index)
            added = [x[index] for x in added]
            offsets = None if offsets is None else offsets[index]
            absolute = None if absolute is None else absolute[index]
        gaussians, shift = splats.gaussians(with_color=o.mode.color)
        features = [x for x in (gaussians.features, *added) if x is not None]
        if added:
            gaussians = gaussians.replace(features=torch.cat([x.to(features[0].dtype) for x in features], 1))
        outputs = ("depth",) if o.mode.depth and not own_depth else ()
        out = render_with_offsets(gaussians, camera, settings, outputs, self.rays, offsets, absolute, splats.strains)
        if o.normals:
            meta["normals"] = render_normals(gaussians.replace(features=None), camera, settings, self.rays)
        kind = splats.means.dtype
        image = self._image(out, shift, splats, 0 if extra is None else extra.shape[1], meta)
        return image.to(kind), out.alpha[..., None].to(kind), meta

    def _image(self, out: Any, shift: float, splats: Splats, signals: int, meta: dict) -> torch.Tensor:
        """The channels of the image; the extra signals go to `meta`."""
        mode, alpha = self.options.mode, out.alpha[..., None]
        features = out.features if out.features is not None else alpha[..., :0]
        rest = features.shape[-1]
        depth = None
        if mode.depth == "gaussian" and self.options.gsplat_depth:
            rest -= 1
            depth = features[..., rest:]
            depth = depth / alpha.clamp_min(EPS_ALPHA) if mode.expected else depth
        elif out.depth is not None:
            depth = out.depth[..., None]
            if mode.depth == "gaussian" and not self.options.settings.planar:
                depth = self._along_axis(depth, alpha)
            depth = depth if mode.expected else depth * alpha.clamp_min(EPS_ALPHA)
        if signals:
            meta["render_extra_signals"] = features[..., rest - signals : rest].to(splats.means.dtype)
            rest -= signals
        channels = []
        if mode.color:
            width = 3 if splats.degree is not None else min(3, splats.colors.shape[1])
            color = torch.cat([out.rgb[..., :width] - shift * alpha, features[..., :rest]], -1)
            channels.append(color if self.background is None else color + (1 - alpha) * self.background)
        if depth is not None:
            channels.append(depth)
        return torch.cat(channels, -1)

    def _along_axis(self, depth: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        """(H, W, 1) camera z of what is at a distance along each ray; 0 where nothing is."""
        if self.rays is None:
            return depth * torch.from_numpy(self.camera.local_directions()[..., 2:]).to(depth)
        axis = rigid_pose(self.camera)[2].to(self.rays)
        origins, directions = self.rays[..., :3], torch.nn.functional.normalize(self.rays[..., 3:], dim=-1)
        z = (origins @ axis[:3] + axis[3])[..., None] + (directions @ axis[:3])[..., None] * depth
        return torch.where(alpha > 0, z, 0).to(depth)

    def _means_in_camera(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 3) means in the axes of the camera whose depths count, and where colors are seen from, (3,)."""
        camera = self.camera
        means = self.splats.means.double()
        start = rigid_pose(camera).to(means.device)
        pose, center = start, -start[:, 3] @ start[:, :3]
        if camera.is_rolling:
            end = rigid_pose(camera, "w2c_end").to(means.device)
            pose = middle_pose(start, end)
            center = 0.5 * (center - end[:, 3] @ end[:, :3])
        return means @ pose[:, :3].T + pose[:, 3], center.to(self.splats.means.dtype)

    def _projected(self, depths: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor | None]:
        """`meta`, and the factor of opacities (compensation), None without one."""
        if self.options.with_ut or self.camera.is_distorted or self.camera.is_rolling:
            return _projected_by_points(self.splats, self.camera, depths, self.options.near), None
        return _projected_by_jacobian(self.splats, self.camera, self.options.settings, self.options.antialiased)

    def _is_drawn(self, meta: dict[str, torch.Tensor], depths: torch.Tensor) -> torch.Tensor:
        """(N,) bool, which Gaussians are drawn: the renderer itself has no far plane and no smallest radius."""
        depths = meta["depths"] if self.options.settings.planar else depths
        kept = depths <= self.options.far
        if self.options.settings.planar or self.options.near > 0:
            kept &= depths > self.options.near
        if self.options.clip > 0:
            kept &= (meta["radii"] > self.options.clip).any(-1)
        return kept


def _view_of(options: _Options, own: dict[str, torch.Tensor], number: int, camera: Camera, degree: int | None) -> _View:
    """A view of a batch, by what the batch has of the tensors of a call; `degree` is that of its colors."""
    splats = Splats(
        means=own["means"],
        quats=own["quats"],
        scales=own["scales"],
        opacities=own["opacities"],
        colors=_colors_of_view(own["colors"], number, degree),
        degree=degree,
        strains=own.get("strains"),
    )
    extra = _colors_of_view(own["extra"], number, options.extra_degree) if "extra" in own else None
    of_view = (own[name][number] if name in own else None for name in ("backgrounds", "rays", "leaf", "absolute"))
    return _View(options, splats, camera, extra, *of_view)


def _drawn(views: list[_View], axes: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """What views have, with the leading axes and that of cameras: images, alphas and the arrays of `meta`."""
    images, alphas, metas = zip(*(view.draw() for view in views), strict=True)
    joined = lambda parts: torch.stack(parts).reshape(*axes, *parts[0].shape)  # noqa: E731
    meta = {name: joined([of_view[name] for of_view in metas]) for name in metas[0]}
    return joined(images), joined(alphas), meta


def _shapes_of(
    quats: torch.Tensor | None,
    scales: torch.Tensor | None,
    covars: torch.Tensor | None,
    shape: tuple[int, ...],
    with_normals: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Quaternions, scales and, where they are those of covariances, strains of Gaussians of a shape (..., N)."""
    if covars is not None:
        if with_normals:
            raise NotImplementedError(
                "rasterization: return_normals is not supported with covars, whose axes have no order; pass quats and "
                "scales"
            )
        return factors("rasterization", covars, shape)
    if quats is None or scales is None:
        raise ValueError("rasterization: quats and scales must be tensors where there are no covars, got None")
    return quats, scales, None


def _evaluated(coefficients: torch.Tensor, degree: int, towards: torch.Tensor) -> torch.Tensor:
    """(N, D) 0.5 + SH of coefficients (N, K, D) in directions (N, 3) of any length."""
    used = (degree + 1) ** 2
    # A mean at the center has no direction, but any will do: it has none of the derivative either.
    length = towards.detach().norm(dim=1, keepdim=True) > 0
    unit = torch.nn.functional.normalize(torch.where(length, towards, towards.new_tensor([0.0, 0.0, 1.0])), dim=1)
    x = [torch.full_like(unit[:, 0], Y_00), *higher_harmonics(list(unit.unbind(1)), used)]
    return 0.5 + torch.einsum("nk,nkd->nd", torch.stack(x, 1), coefficients[:, :used])


def _expanded_to_batches(x: torch.Tensor, degree: int | None, lead: tuple[int, ...]) -> torch.Tensor:
    """Coefficients (N, K, D) that all batches share, expanded to each of them; others as they are."""
    if degree is not None and lead and isinstance(x, torch.Tensor) and x.ndim == 3:
        return x.expand(*lead, *x.shape)
    return x


def _colors_of_view(x: torch.Tensor, camera: int, degree: int | None) -> torch.Tensor:
    """Colors of one view, from those of its batch, which all cameras share or which have an axis of them."""
    return x[camera] if x.ndim == (3 if degree is None else 4) else x


def _means2d_leaf(
    means: torch.Tensor,
    viewmats: torch.Tensor,
    opacities: torch.Tensor,
    settings: RenderSettings,
    lead: tuple[int, ...],
    count: int,
) -> torch.Tensor | None:
    """(..., C, N, 2) zeros that become `meta["means2d"]`, whose gradient a backward pass may request; None where it
    cannot.
    """
    wanted = torch.is_grad_enabled() and any(x.requires_grad for x in (means, viewmats, opacities))
    if not wanted or not settings.planar or is_wrapped(means):
        return None
    return means.new_zeros(*lead, count, means.shape[-2], 2).requires_grad_()


def _absgrad_leaf(leaf: torch.Tensor | None) -> torch.Tensor | None:
    """Zeros like the leaf, whose gradient becomes its `absgrad` after each backward pass."""
    if leaf is None:
        return None
    zeros = torch.zeros_like(leaf).requires_grad_()

    def keep(x: torch.Tensor) -> None:
        leaf.absgrad = x.grad  # type: ignore[attr-defined]  # where gsplat's strategies look

    zeros.register_post_accumulate_grad_hook(keep)
    return zeros


def _check_along_rays(
    settings: RenderSettings, rolling: bool, lens: bool, rays: torch.Tensor | None, mode: _Mode, normals: bool
) -> None:
    """Refuse what only responses along rays have."""
    used = {
        "rolling_shutter": rolling,
        "distortion coefficients and camera models other than pinhole": lens,
        "rays": rays is not None,
        "render modes with d and Ed": mode.depth == "hit",
        "return_normals": normals,
    }
    for name, is_used in used.items():
        if is_used and settings.planar:
            raise ValueError(
                f"rasterization: {name} must come with with_eval3d=True, or a preset along rays, got the model of the "
                "image plane; pass with_ut=True, with_eval3d=True"
            )


def _check_shape(name: str, x: torch.Tensor | None, shape: tuple[int, ...]) -> None:
    """Raise ValueError for a tensor of another shape; None is none."""
    if x is not None and tuple(x.shape) != shape:
        raise ValueError(f"rasterization: {name} must have shape {shape}, got {tuple(x.shape)}; correct it")


def _check_extra(
    extra: torch.Tensor | None, degree: int | None, lead: tuple[int, ...], count: int, gaussians: int
) -> None:
    """Refuse extra signals of a wrong shape."""
    if extra is None:
        return
    if degree not in (None, 0, 1, 2, 3):
        raise ValueError(f"rasterization: extra_signals_sh_degree must be None or 0 to 3, got {degree!r}")
    tail = 1 if degree is None else 2
    fits = [(*lead, gaussians), (*lead, count, gaussians)]
    least = 0 if degree is None else (degree + 1) ** 2
    if tuple(extra.shape[:-tail]) not in fits or (tail == 2 and extra.shape[-2] < least):
        wanted = "(..., N, E) or (..., C, N, E)" if degree is None else f"(N, K, E) with K >= {least}"
        raise ValueError(f"rasterization: extra_signals must have shape {wanted}, got {tuple(extra.shape)}")


# ------------------------------------------------------------------------------------------------ what the options mean


def _refuse(**options: bool) -> None:
    """Raise NotImplementedError for the first of gsplat's options that is used and does not exist here."""
    for name, is_used in options.items():
        if is_used:
            raise NotImplementedError(f"rasterization: {name} is not supported; {_INSTEAD[name]}")


def _check_unscented(params: object) -> None:
    """Raise NotImplementedError for parameters of the unscented transform that are not gsplat's defaults."""
    defaults = {"alpha": 0.1, "beta": 2.0, "kappa": 0.0, "in_image_margin_factor": 0.1}
    for name, usual in {**defaults, "require_all_sigma_points_valid": False}.items():
        value = getattr(params, name, usual)
        if value != usual:
            raise NotImplementedError(
                f"rasterization: ut_params must have gsplat's default {name}={usual}, got {value}; pass None, or drop "
                "with_ut"
            )


def _one_of(name: str, value: str, allowed: Sequence[str]) -> None:
    """Raise ValueError for a value that is none of those allowed."""
    if value not in allowed:
        raise ArgumentError(f"rasterization: {name} must be one of {', '.join(allowed)}, got {value!r}")


def _settings_of(
    preset: str | RenderSettings | None,
    near: float,
    eps2d: float,
    antialiased: bool,
    along_rays: bool,
    with_ut: bool,
    by_z: bool,
) -> RenderSettings:
    """The renderer that the options mean, on a black background (colors behind are added in torch).

    Args:
        preset: The caller's, whose own constants hold where `near` and `eps2d` are gsplat's defaults; None: gsplat's.
        near: Means nearer than that are left out.
        eps2d: Added to projected covariances, in px^2.
        antialiased: Opacities are compensated for it.
        along_rays: Option `with_eval3d`.
        with_ut: Tiles are those of the unscented transform's boxes.
        by_z: Option `global_z_order`.
    """
    if preset is None:
        key = "z" if by_z else "distance"
        if along_rays:
            culling = "ut" if with_ut else "extent"
            # What is too near by its distance is left out by `rasterization`.
            near = near if by_z else 0.0
            settings = RenderSettings.preset("3dgut", depth_key=key, culling=culling, near=near)
        else:
            settings = RenderSettings.preset("gsplat", depth_key=key, dilation=eps2d, near=near)
    else:
        settings = preset if isinstance(preset, RenderSettings) else RenderSettings.preset(preset)
        if preset == "gsplat":
            settings = settings.replace(depth_key="z" if by_z else "distance")
        if preset == "gsplat" or near != _NEAR:
            settings = settings.replace(near=near)
        if preset == "gsplat" or eps2d != _DILATION:
            settings = settings.replace(dilation=eps2d)
    if antialiased and not settings.planar:
        raise NotImplementedError(
            "rasterization: rasterize_mode='antialiased' must have a preset with projected covariances, got "
            f"{'with_eval3d' if preset is None else f'preset={preset!r}'}; use preset='gsplat' or 'inria', or "
            "rasterize_mode='classic'"
        )
    return settings.replace(background=(0.0, 0.0, 0.0))


def _lenses_of(
    model: str,
    lead: tuple[int, ...],
    count: int,
    radial: torch.Tensor | None,
    tangential: torch.Tensor | None,
    prism: torch.Tensor | None,
    ftheta: Any,
    Ks: torch.Tensor,
) -> list[list[dict[str, Any]]]:
    """Of each batch and camera, the fields of `Camera` that say what lens it has; empty ones of pinholes.

    gsplat's radial coefficients of a pinhole are OpenCV's k1 to k6, whose order has the tangential p1, p2 behind k2; of
    a fisheye its k1 to k4.
    """
    _one_of("camera_model", model, ("pinhole", "fisheye", "ftheta"))
    if (model == "ftheta") != (ftheta is not None):
        raise ArgumentError(
            f"rasterization: ftheta_coeffs must come with camera_model='ftheta', and with no other, got {model!r} and "
            f"{'none' if ftheta is None else 'some'}; change one of them"
        )
    given = {
        "radial_coeffs": (radial, 4 if model == "fisheye" else 6),
        "tangential_coeffs": (tangential, 2),
        "thin_prism_coeffs": (prism, 4),
    }
    values: dict[str, torch.Tensor] = {}
    for name, (x, width) in given.items():
        if x is None:
            continue
        if model == "ftheta" or (model == "fisheye" and name != "radial_coeffs"):
            raise ArgumentError(f"rasterization: {name} must be of camera_model='pinhole', got {model}; drop it")
        if tuple(x.shape) != (*lead, count, width):
            raise ArgumentError(
                f"rasterization: {name} must have shape {(*lead, count, width)} for camera_model={model!r}, got "
                f"{tuple(x.shape)}"
            )
        values[name] = x.detach().cpu().double().reshape(-1, count, width)  # as of intrinsics, no gradient
    batches = math.prod(lead)
    if model == "ftheta":
        centers = Ks.detach().cpu().double().reshape(batches, count, 3, 3)[..., :2, 2]  # no gradient, as of others
        return [[_ftheta(ftheta, *center.tolist()) for center in batch] for batch in centers]
    if model == "pinhole" and not values:
        return [[{} for _ in range(count)] for _ in range(batches)]
    zeros = {name: torch.zeros(batches, count, width, dtype=torch.float64) for name, (_, width) in given.items()}
    k, p, s = ({**zeros, **values}[name] for name in given)
    if model == "fisheye":
        return [[{"model": "opencv_fisheye", "distortion": tuple(row.tolist())} for row in batch] for batch in k]
    every = torch.cat([k[..., :2], p, k[..., 2:], *([s] if "thin_prism_coeffs" in values else [])], -1)
    return [[{"model": "opencv", "distortion": tuple(row.tolist())} for row in batch] for batch in every]


def _ftheta(coefficients: Any, cx: float, cy: float) -> dict[str, Any]:
    """Fields of `Camera` of gsplat's `FThetaCameraDistortionParameters`: its reference polynomial, from angles to
    pixels or back; the principal point counts from the center of the first pixel. `max_angle` plays no role for rays.
    """
    kind = str(getattr(coefficients.reference_poly, "name", coefficients.reference_poly))
    forward = kind.endswith("ANGLE_TO_PIXELDIST")
    polynomial = [
        float(x) for x in (coefficients.angle_to_pixeldist_poly if forward else coefficients.pixeldist_to_angle_poly)
    ]
    if polynomial[0] != 0 or not polynomial[1] > 0:
        raise NotImplementedError(
            "rasterization: ftheta_coeffs must have a reference polynomial without a constant term that grows from 0 "
            f"on, got {kind} with {polynomial[0]:g} and {polynomial[1]:g}; {_RAYS}"
        )
    # The focal length belongs into K: bounds of silhouettes are of an equidistant fisheye of that K.
    focal = polynomial[1] if forward else 1 / polynomial[1]
    scaled = [x / focal if forward else x * focal**i for i, x in enumerate(polynomial)][1:]
    K = np.array([[focal, 0.0, cx + 0.5], [0.0, focal, cy + 0.5], [0.0, 0.0, 1.0]])
    linear = [float(x) for x in coefficients.linear_cde]
    return {"K": K, "model": "ftheta" if forward else "ftheta_inverse", "distortion": (*scaled, *linear)}


def _shutter_of(rolling_shutter: Any, viewmats_rs: torch.Tensor | None) -> str:
    """`Camera.shutter` of a member of gsplat's `RollingShutterType`, of its name, or of ours."""
    name = getattr(rolling_shutter, "name", rolling_shutter)
    shutter = "global" if name is None else str(name).lower()
    if shutter not in SHUTTERS:
        raise ArgumentError(
            f"rasterization: rolling_shutter must be one of {', '.join(SHUTTERS)}, got {rolling_shutter!r}"
        )
    if (shutter == "global") != (viewmats_rs is None):
        raise ArgumentError(
            f"rasterization: viewmats_rs must be there for rolling shutters, and for no other, got {shutter} and "
            f"{'none' if viewmats_rs is None else 'some'}; change one of them"
        )
    return shutter


# ----------------------------------------------------------------------------- `meta`: where Gaussians are on the image


def _projected_by_jacobian(
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
        scales = splats.scales.to(**like)
        axes = semi_axes(splats.quats.to(**like), torch.ones_like(scales))
        if splats.strains is not None:
            axes = strained(axes, splats.strains)
        axes = axes * scales[:, None, :]
        half_axes = torch.stack(rows, 1).reshape(-1, 2, 3) @ w2c[:3, :3] @ axes
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
            compensation = (sharp / blurred).clamp_min(LEAST_COMPENSATION**2).sqrt().to(splats.means.dtype)
    with torch.no_grad():  # `meta` has no graph
        opacity = splats.opacities.to(**like) * (1 if compensation is None else compensation)
        extent = (2 * (opacity / LEAST_OPACITY).clamp_min(1).log()).sqrt().clamp_max(EXTENT)
        valid = valid & (opacity >= LEAST_OPACITY)  # not in place: the graph of z keeps the mask
        radii = torch.ceil(extent[:, None] * torch.stack([xx + eps, yy + eps], 1).sqrt())
        covariance = torch.stack([xx + eps, xy, yy + eps], 1)
        meta = _meta(splats, camera, means2d.detach(), covariance, blurred, radii, valid, z)
    return meta, compensation


def _projected_by_points(splats: Splats, camera: Camera, depths: torch.Tensor, near: float) -> dict[str, torch.Tensor]:
    """gsplat's `meta` of a view by the unscented transform (3DGUT: alpha 0.1, beta 2, kappa 0), without a graph.

    Args:
        depths: (N,) camera z or distance of the means, of a rolling shutter in the middle of the exposure.
        near: Means of no larger depth are left out.
    """
    with torch.no_grad():  # `meta` has no graph
        means = splats.means.detach().cpu().double()
        steps = SPREAD * semi_axes(splats.quats.detach().cpu().double(), splats.scales.detach().cpu().double())
        steps = steps.mT  # rows are half axes
        points = torch.cat([means[:, None], means[:, None] + steps, means[:, None] - steps], 1)
        at, _ = camera.project(points.reshape(-1, 3).numpy())
        seen = np.isfinite(at).all(1)
        pixels = torch.from_numpy(np.where(seen[:, None], at, 0.0)).reshape(-1, 7, 2)
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        within = ((pixels >= -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(-1) & torch.from_numpy(seen).reshape(
            -1, 7
        )
        of_mean, of_covariance = (torch.tensor(x, dtype=torch.float64) for x in (MEAN_WEIGHTS, COVARIANCE_WEIGHTS))
        means2d = torch.einsum("k,nki->ni", of_mean, pixels)
        off = pixels - means2d[:, None]
        xx, xy, yy = (
            torch.einsum("k,nk,nk->n", of_covariance, off[..., i], off[..., j]) for i, j in ((0, 0), (0, 1), (1, 1))
        )
        sharp = xx * yy - xy * xy
        xx, yy = xx + DILATION, yy + DILATION
        det = xx * yy - xy * xy
        # As if what the dilation widens was made fainter, although the opacity along rays is not.
        shrunk = (sharp / det.clamp_min(1e-30)).clamp_min(LEAST_COMPENSATION**2).sqrt()
        opacity = splats.opacities.detach().cpu().double() * shrunk
        extent = (2 * (opacity / LEAST_OPACITY).clamp_min(1).log()).sqrt().clamp_max(EXTENT)
        middle = 0.5 * (xx + yy)
        largest = middle + (middle * middle - det).clamp_min(0.01).sqrt()
        variance = torch.minimum(torch.stack([xx, yy], 1), largest[:, None]).clamp_min(0)
        radii = torch.ceil(extent[:, None] * variance.sqrt())
        valid = within.any(1) & (det > 0) & (depths.detach().cpu() > near) & (opacity >= LEAST_OPACITY)
        covariance = torch.stack([xx, xy, yy], 1)
        return _meta(splats, camera, means2d, covariance, det, radii, valid, depths.detach().cpu().double())


def _meta(
    splats: Splats,
    camera: Camera,
    means2d: torch.Tensor,
    covariance: torch.Tensor,
    det: torch.Tensor,
    radii: torch.Tensor,
    valid: torch.Tensor,
    z: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """The dictionary's arrays: 0 where a Gaussian is not seen."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64, device=radii.device)
    valid = valid & ((means2d + radii > 0) & (means2d - radii < size)).all(1)
    xx, xy, yy = covariance.unbind(1)
    conics = torch.stack([yy, -xy, xx], 1) / det[:, None]
    kind: dict[str, Any] = {"dtype": splats.means.dtype, "device": splats.means.device}
    return {
        "radii": (radii * valid[:, None]).to(torch.int32).to(splats.means.device),
        "means2d": means2d.to(**kind),
        "depths": torch.where(valid, z, 0).to(**kind),
        "conics": conics.to(**kind),
    }
