"""gsplat 1.6's own torch code of Gaussians along rays (`with_eval3d`, 3DGUT) on a CPU, called as its `rasterization`.

    pip install gsplat==1.6.0
    drgs crossval scene.ply --cameras cameras.json --rasterizer examples.gsplat_eval3d:rasterization --preset 3dgut

gsplat checks its CUDA kernels against torch code that wants CUDA around it: for lists of tiles, for enumerations, and
for nerfacc. Here it runs without:

- gsplat's, unchanged: `accumulate_eval3d` (the response along rays, clamp, cut-offs, early end), `_generate_rays` with
  the camera models (pinhole, OpenCV's lens and fisheye, rolling shutter) and `_spherical_harmonics`;
- ours: the call, near plane and order by z at the middle of the shutter, every pixel with every Gaussian in place of
  tiles by the unscented transform, the enumeration of shutters, and three functions of nerfacc.

All derivatives are torch's, through gsplat's functions; the compiled CUDA code plays no part.
"""

from __future__ import annotations

import contextlib
import enum
import sys
import types
from unittest import mock

import torch

if __package__:
    from .gsplat_torch import accumulated, weights_from_alpha
else:
    from gsplat_torch import accumulated, weights_from_alpha

Shutter = enum.Enum(
    "Shutter",
    "GLOBAL ROLLING_TOP_TO_BOTTOM ROLLING_LEFT_TO_RIGHT ROLLING_BOTTOM_TO_TOP ROLLING_RIGHT_TO_LEFT",
)


def rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    *,
    near_plane=0.01,
    far_plane=1e10,
    sh_degree=None,
    backgrounds=None,
    camera_model="pinhole",
    radial_coeffs=None,
    tangential_coeffs=None,
    thin_prism_coeffs=None,
    rolling_shutter="global",
    viewmats_rs=None,
    **unused,
):
    """(C, H, W, D) image, (C, H, W, 1) alpha and an empty dict; arguments as gsplat's `rasterization`, without batches.

    Raises:
        ImportError: If gsplat 1.6 is not installed, or a version without these functions.
    """
    try:
        from gsplat.cuda import _torch_cameras, _torch_impl, _torch_impl_eval3d

        accumulate, rays_of = _torch_impl_eval3d.accumulate_eval3d, _torch_impl_eval3d._generate_rays
        harmonics, create = _torch_impl._spherical_harmonics, _torch_cameras._BaseCameraModel.create
        to_pose, between = _torch_cameras._viewmat_to_pose, _torch_cameras._interpolate_shutter_pose
    except (ImportError, AttributeError) as error:
        raise ImportError(f"examples.gsplat_eval3d: gsplat 1.6 must be installed, got: {error}") from None

    shutter = Shutter[str(getattr(rolling_shutter, "name", rolling_shutter)).upper()]
    nerfacc = types.ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha, nerfacc.accumulate_along_rays = _weights, accumulated
    nerfacc.pack_info = _packed
    images, alphas = [], []
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(_torch_cameras, "ShutterType", Shutter))
        stack.enter_context(mock.patch.dict(sys.modules, nerfacc=nerfacc))
        for i in range(len(viewmats)):
            one = slice(i, i + 1)
            ends = None if viewmats_rs is None else viewmats_rs[one]
            lens = {
                "radial_coeffs": radial_coeffs,
                "tangential_coeffs": tangential_coeffs,
                "thin_prism_coeffs": thin_prism_coeffs,
            }
            camera = create(
                width=width,
                height=height,
                camera_model=camera_model,
                focal_lengths=Ks[one][:, [0, 1], [0, 1]],
                principal_points=Ks[one][:, [0, 1], [2, 2]],
                rs_type=shutter,
                **{name: x[one] for name, x in lens.items() if x is not None},
            )
            rays = rays_of(camera, width, height, viewmats[one], ends)
            poses = [to_pose(x) for x in (viewmats[one], viewmats[one] if ends is None else ends)]
            middle = between(*poses, torch.full((1,), 0.5).to(means))[0]
            with torch.no_grad():  # which Gaussians are drawn, and their order, has no derivative
                z = _depths(middle, means)
                order = torch.argsort(z, stable=True)
                order = order[((z > near_plane) & (z < far_plane))[order]]
            shown = _shown(means, colors, viewmats[i], None if ends is None else ends[0], sh_degree, harmonics)
            pixels = width * height
            image, alpha, *_ = accumulate(
                means,
                quats,
                scales,
                opacities[None],
                shown[None],
                order.repeat(pixels),
                torch.arange(pixels).repeat_interleave(len(order)),
                torch.zeros(pixels * len(order), dtype=torch.long),
                width,
                height,
                torch.arange(pixels * len(order)),
                rays,
            )
            behind = torch.zeros_like(image[0, 0, 0]) if backgrounds is None else backgrounds[i]
            images.append(image[0] + (1 - alpha[0]) * behind)
            alphas.append(alpha[0])
    return torch.stack(images), torch.stack(alphas), {}


def _depths(pose, means):
    """(N,) z of the means in the frame of a pose (7,): translation, then quaternion wxyz of the rotation to it."""
    w, x, y, z = pose[3:]
    row = torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    return means @ row + pose[2]


def _shown(means, colors, w2c, end, degree, harmonics):
    """(N, D) colors: as they are, or of SH in the directions from the middle between the eyes of both poses."""
    if degree is None:
        return colors
    eyes = [torch.linalg.inv(x)[:3, 3] for x in (w2c, end) if x is not None]
    return (harmonics(degree, means - sum(eyes) / len(eyes), colors) + 0.5).clamp(min=0)


def _weights(alphas, packed_info):
    """Weights and transmittances of hits that are packed by ray."""
    counts = packed_info[:, 1]
    rays = torch.arange(len(counts)).repeat_interleave(counts)
    return weights_from_alpha(alphas, rays, len(counts))


def _packed(ray_indices, n_rays):
    """(n_rays, 2) index of the first hit of every ray, and number of its hits."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    return torch.stack([torch.cumsum(counts, 0) - counts, counts], -1)
