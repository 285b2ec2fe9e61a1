"""`drgs.rasterization`: our renderer behind the call that users of gsplat know.

Argument names, shapes, defaults and meanings are those of `gsplat.rasterization` 1.6, so that a script changes one
import and runs without CUDA: the rasterizer's own model, and, with `with_eval3d`, that of 3DGUT, through lenses,
rolling shutters and rays of the caller's own. What gsplat can do and this cannot is refused by name; what only steers
gsplat's memory and speed (`packed`, `tile_size`, `segmented`, `macro_tile`, `renderer_config`) is accepted and changes
nothing.

What the tensors are in raw parameters is said in splats.py, what the options mean in gsplat_options.py.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.covariances import factors
from drgs.ellipsoids import Y_00
from drgs.gsplat_options import MODES, NEAR, Mode, check_unscented, lenses_of, one_of, refuse, settings_of, shutter_of
from drgs.integrator import render_normals, render_with_offsets
from drgs.projected import projected, unscented
from drgs.runtime import uncompiled
from drgs.settings import EPS_ALPHA, RenderSettings
from drgs.splats import Splats, cameras_of, check_shapes, inside, inside_opacities
from drgs.tracing.harmonics import higher_harmonics
from drgs.tracing.pose import rigid_pose
from drgs.tracing.shutter import middle_pose

__all__ = ["rasterization"]

_FAR = 1e10  # gsplat's default: none


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
    near_plane: float = NEAR,
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
        eps2d: Added to the diagonal of the projected covariance, in px^2.
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
            gsplat's defaults; those without projected covariance (`exact`, `fast`) have no eps2d and no antialiased
            mode, and the z of D is that of the peak on each ray.
    Returns:
        colors (..., C, H, W, X), alphas (..., C, H, W, 1), in the precision of `means`, and a dict: `radii` (..., C, N,
        2) int32 in pixels, 0 where a Gaussian is left out; `means2d` (..., C, N, 2), `depths` (..., C, N), `conics`
        (..., C, N, 3), valid where radii > 0; `opacities` (..., C, N); `width`, `height`, `n_batches`, `n_cameras`;
        None for what only packed arrays have; and what `return_normals` and `extra_signals` ask for. Only `means2d` may
        have a gradient.
    Raises:
        ValueError: If a shape or value is wrong.
        NotImplementedError: If an option of gsplat's is asked for that does not exist here; the way round is named.
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
    one_of("render_mode", render_mode, list(MODES))
    one_of("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    refuse(
        sparse_grad=sparse_grad,
        distributed=distributed,
        lidar_coeffs=lidar_coeffs is not None,
        external_distortion_coeffs=external_distortion_coeffs is not None,
        **{f"camera_model={name!r}": camera_model == name for name in ("ortho", "lidar")},
        **{"with_ut without with_eval3d": with_ut and not with_eval3d and preset is None},
    )
    check_unscented(ut_params)
    if not near_plane < far_plane:
        raise ValueError(
            f"rasterization: near_plane must be less than far_plane, got {near_plane:g} and {far_plane:g}; swap them"
        )
    mode = MODES[render_mode]
    antialiased = rasterize_mode == "antialiased"
    settings = settings_of(preset, near_plane, eps2d, antialiased, with_eval3d, with_ut, global_z_order)
    strains = None
    if covars is not None:
        if return_normals:
            raise NotImplementedError(
                "rasterization: return_normals is not supported with covars, whose axes have no order; pass quats and "
                "scales"
            )
        quats, scales, strains = factors("rasterization", covars, tuple(means.shape[:-1]))
    if quats is None or scales is None:
        raise ValueError("rasterization: quats and scales must be tensors where there are no covars, got None")
    if colors is None or not mode.color:
        colors, sh_degree, backgrounds = torch.zeros_like(means[..., :1]), None, None
    lead = tuple(means.shape[:-2])
    colors = _for_batches(colors, sh_degree, lead)
    shown = colors
    if sh_degree is not None and colors.ndim and colors.shape[-1] != 3:
        shown = colors[..., :1].expand(*colors.shape[:-1], 3)  # SH of other channels: evaluated below
    checked_backgrounds = None if shown is not colors else backgrounds
    lead, count = check_shapes(
        "rasterization", means, quats, scales, opacities, shown, viewmats, Ks, sh_degree, checked_backgrounds
    )
    scales, opacities = inside("rasterization", scales, opacities)
    batches = math.prod(lead)
    if not batches or not count:
        raise ValueError(
            f"rasterization: viewmats must hold at least one camera, got shape {tuple(viewmats.shape)}; skip the call"
        )
    shutter = shutter_of(rolling_shutter, viewmats_rs)
    coefficients = radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs
    lenses = lenses_of(camera_model, lead, count, *coefficients, Ks)
    _check_along_rays(settings, shutter != "global", bool(lenses[0][0]), rays, mode, return_normals)
    _check_rays(rays, (*lead, count, height, width, 6))
    extra = None if extra_signals is None else _for_batches(extra_signals, extra_signals_sh_degree, lead)
    _check_extra(extra, extra_signals_sh_degree, lead, count, means.shape[-2])
    of = lambda x: x.reshape(batches, *x.shape[len(lead) :])  # noqa: E731
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "viewmats": viewmats, "Ks": Ks}
    flat = {name: of(x) for name, x in given.items()}
    ends = None if viewmats_rs is None else of(viewmats_rs)
    leaf = _leaf(means, viewmats, opacities, settings, lead, count)
    absolute = _absolute(leaf) if absgrad else None
    views = []
    for b in range(batches):
        for c in range(count):
            if ends is not None:
                lenses[b][c] |= {"shutter": shutter, "w2c_end": ends[b, c]}
        for c, camera in enumerate(cameras_of(flat["viewmats"][b], flat["Ks"][b], width, height, lenses[b])):
            views.append(
                _View(
                    splats=Splats(
                        means=flat["means"][b],
                        quats=flat["quats"][b],
                        scales=flat["scales"][b],
                        opacities=flat["opacities"][b],
                        colors=_of_view(of(colors), b, c, sh_degree),
                        degree=sh_degree,
                        strains=None if strains is None else of(strains)[b],
                    ),
                    camera=camera,
                    settings=settings,
                    mode=mode,
                    antialiased=antialiased,
                    with_ut=with_ut and with_eval3d,
                    gsplat_depth=with_eval3d and preset is None,
                    near=near_plane if with_eval3d and preset is None else settings.near,
                    far=far_plane,
                    clip=radius_clip,
                    background=None if backgrounds is None else of(backgrounds)[b, c],
                    extra=None if extra is None else _of_view(of(extra), b, c, extra_signals_sh_degree),
                    extra_degree=extra_signals_sh_degree,
                    rays=None if rays is None else of(rays)[b, c],
                    leaf=None if leaf is None else leaf.reshape(batches, count, -1, 2)[b, c],
                    absolute=None if absolute is None else absolute.reshape(batches, count, -1, 2)[b, c],
                    normals=return_normals,
                )
            )
    made = [view.draw() for view in views]
    images, alphas = (
        torch.stack(x).reshape(*lead, count, *x[0].shape) for x in zip(*(v[:2] for v in made), strict=True)
    )
    meta: dict[str, Any] = {
        name: torch.stack([v[2][name] for v in made]).reshape(*lead, count, *made[0][2][name].shape)
        for name in made[0][2]
    }
    if leaf is not None:
        with torch.no_grad():  # its values; the graph of every view begins at the leaf
            leaf.copy_(meta["means2d"])
        meta["means2d"] = leaf
    meta |= {"width": width, "height": height, "n_batches": batches, "n_cameras": count}
    meta |= dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))  # of packed arrays, which these are not
    return images, alphas, meta


@dataclasses.dataclass
class _View:
    """One image of `rasterization`, whose arguments these are, of one scene and camera."""

    splats: Splats
    camera: Camera
    settings: RenderSettings
    mode: Mode
    antialiased: bool
    with_ut: bool
    gsplat_depth: bool
    near: float
    far: float
    clip: float
    background: torch.Tensor | None
    extra: torch.Tensor | None
    extra_degree: int | None
    rays: torch.Tensor | None
    leaf: torch.Tensor | None
    absolute: torch.Tensor | None
    normals: bool

    def draw(self) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """The image (H, W, X), its alpha (H, W, 1), and the arrays of `meta`."""
        camera, settings, splats = self.camera, self.settings, self.splats
        local, center = self._seen()
        own = local[:, 2:] if settings.depth_key == "z" else local.norm(dim=1, keepdim=True)
        cut = (own[:, 0] if self.gsplat_depth else local[:, 2]).detach()  # what near and far planes look at
        meta, compensation = self._projected(cut)
        if compensation is not None:
            splats = dataclasses.replace(splats, opacities=inside_opacities(splats.opacities * compensation))
        # `meta` is to be looked at: no gradient passes through it.
        meta["opacities"] = splats.opacities.detach().to(splats.means.dtype)
        extra = self.extra
        if extra is not None and self.extra_degree is not None:
            extra = _evaluated(extra, self.extra_degree, splats.means - center)
        if splats.degree is not None and (camera.is_rolling or splats.colors.shape[-1] != 3):
            # As gsplat: of a rolling shutter from the middle of both centers; other numbers of channels one by one.
            colors = _evaluated(splats.colors, splats.degree, splats.means - center).clamp_min(0)
            splats = dataclasses.replace(splats, colors=colors, degree=None)
        added = [] if extra is None else [extra]
        if self.mode.depth == "gaussian" and self.gsplat_depth:
            added.append(own.to(splats.means.dtype))
        offsets = None if self.leaf is None else self.leaf - self.leaf.detach()  # zeros with its derivative
        absolute = self.absolute
        kept = self._kept(meta, cut)
        meta["radii"] = meta["radii"] * kept[:, None]
        if not bool(kept.all()) and (self.far < _FAR or self.clip > 0 or self.near > settings.near):
            index = kept.nonzero()[:, 0]
            splats = splats.take(index)
            added = [x[index] for x in added]
            offsets = None if offsets is None else offsets[index]
            absolute = None if absolute is None else absolute[index]
        gaussians, shift = splats.gaussians(with_color=self.mode.color)
        features = [x for x in (gaussians.features, *added) if x is not None]
        if added:
            gaussians = gaussians.replace(features=torch.cat([x.to(features[0].dtype) for x in features], 1))
        asked = ("depth",) if self.mode.depth and not (self.gsplat_depth and self.mode.depth == "gaussian") else ()
        out = render_with_offsets(gaussians, camera, settings, asked, self.rays, offsets, absolute, splats.strains)
        if self.normals:
            meta["normals"] = render_normals(gaussians.replace(features=None), camera, settings, self.rays)
        kind = splats.means.dtype
        image = self._image(out, shift, splats, 0 if extra is None else extra.shape[1], meta)
        return image.to(kind), out.alpha[..., None].to(kind), meta

    def _image(self, out: Any, shift: float, splats: Splats, signals: int, meta: dict) -> torch.Tensor:
        """The channels of the image; the extra signals go to `meta`."""
        alpha = out.alpha[..., None]
        features = out.features if out.features is not None else alpha[..., :0]
        rest = features.shape[-1]
        depth = None
        if self.mode.depth == "gaussian" and self.gsplat_depth:
            rest -= 1
            depth = features[..., rest:]
            depth = depth / alpha.clamp_min(EPS_ALPHA) if self.mode.expected else depth
        elif out.depth is not None:
            depth = out.depth[..., None]
            if self.mode.depth == "gaussian" and not self.settings.planar:
                # Along the ray -> along the axis.
                axis = torch.from_numpy(self.camera.local_directions()[..., 2:])
                depth = depth * axis.to(depth)
            depth = depth if self.mode.expected else depth * alpha.clamp_min(EPS_ALPHA)
        if signals:
            meta["render_extra_signals"] = features[..., rest - signals : rest].to(splats.means.dtype)
            rest -= signals
        channels = []
        if self.mode.color:
            width = 3 if splats.degree is not None else min(3, splats.colors.shape[1])
            color = torch.cat([out.rgb[..., :width] - shift * alpha, features[..., :rest]], -1)
            channels.append(color if self.background is None else color + (1 - alpha) * self.background)
        if depth is not None:
            channels.append(depth)
        return torch.cat(channels, -1)

    def _seen(self) -> tuple[torch.Tensor, torch.Tensor]:
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
        """`meta`, and what opacities are multiplied with."""
        if self.with_ut or self.camera.is_distorted or self.camera.is_rolling:
            return unscented(self.splats, self.camera, depths, self.near), None
        return projected(self.splats, self.camera, self.settings, self.antialiased)

    def _kept(self, meta: dict[str, torch.Tensor], depths: torch.Tensor) -> torch.Tensor:
        """(N,) which Gaussians are drawn: the renderer itself knows no far plane and no smallest radius."""
        depths = meta["depths"] if self.settings.planar else depths
        kept = depths <= self.far
        if self.settings.planar or self.near > 0:
            kept &= depths > self.near
        if self.clip > 0:
            kept &= (meta["radii"] > self.clip).any(-1)
        return kept


def _evaluated(coefficients: torch.Tensor, degree: int, towards: torch.Tensor) -> torch.Tensor:
    """(N, D) 0.5 + SH of coefficients (N, K, D) in directions (N, 3) of any length."""
    used = (degree + 1) ** 2
    # A mean at the center has no direction, but any will do: it has none of the derivative either.
    length = towards.detach().norm(dim=1, keepdim=True) > 0
    unit = torch.nn.functional.normalize(torch.where(length, towards, towards.new_tensor([0.0, 0.0, 1.0])), dim=1)
    x = [torch.full_like(unit[:, 0], Y_00), *higher_harmonics(list(unit.unbind(1)), used)]
    return 0.5 + torch.einsum("nk,nkd->nd", torch.stack(x, 1), coefficients[:, :used])


def _for_batches(x: torch.Tensor, degree: int | None, lead: tuple[int, ...]) -> torch.Tensor:
    """Coefficients (N, K, D) that all batches share, for each of them; others as they are."""
    if degree is not None and lead and isinstance(x, torch.Tensor) and x.ndim == 3:
        return x.expand(*lead, *x.shape)
    return x


def _of_view(x: torch.Tensor, batch: int, camera: int, degree: int | None) -> torch.Tensor:
    """Colors of one view, of those by batch, or by batch and camera."""
    by_camera = x.ndim == (4 if degree is None else 5)
    return x[batch, camera] if by_camera else x[batch]


def _leaf(
    means: torch.Tensor,
    viewmats: torch.Tensor,
    opacities: torch.Tensor,
    settings: RenderSettings,
    lead: tuple[int, ...],
    count: int,
) -> torch.Tensor | None:
    """(..., C, N, 2) what becomes `meta["means2d"]`, where a backward pass may ask for its gradient."""
    wanted = torch.is_grad_enabled() and any(x.requires_grad for x in (means, viewmats, opacities))
    if not wanted or not settings.planar or torch._C._functorch.is_functorch_wrapped_tensor(means):
        return None
    return means.new_zeros(*lead, count, means.shape[-2], 2).requires_grad_()


def _absolute(leaf: torch.Tensor | None) -> torch.Tensor | None:
    """Zeros like the leaf, whose gradient becomes its `absgrad` after each backward pass."""
    if leaf is None:
        return None
    zeros = torch.zeros_like(leaf).requires_grad_()

    def keep(x: torch.Tensor) -> None:
        leaf.absgrad = x.grad  # type: ignore[attr-defined]  # where gsplat's strategies look

    zeros.register_post_accumulate_grad_hook(keep)
    return zeros


def _check_along_rays(
    settings: RenderSettings, rolling: bool, lens: bool, rays: torch.Tensor | None, mode: Mode, normals: bool
) -> None:
    """Refuse what only responses along rays have."""
    asked = {
        "rolling_shutter": rolling,
        "distortion coefficients and camera models other than pinhole": lens,
        "rays": rays is not None,
        "render modes with d and Ed": mode.depth == "hit",
        "return_normals": normals,
    }
    for name, is_asked in asked.items():
        if is_asked and settings.planar:
            raise ValueError(
                f"rasterization: {name} must come with with_eval3d=True, or a preset along rays, got the model of the "
                "image plane; pass with_ut=True, with_eval3d=True"
            )


def _check_rays(rays: torch.Tensor | None, shape: tuple[int, ...]) -> None:
    if rays is not None and tuple(rays.shape) != shape:
        raise ValueError(f"rasterization: rays must have shape {shape}, got {tuple(rays.shape)}")


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
