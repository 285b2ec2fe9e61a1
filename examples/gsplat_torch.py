"""gsplat 1.5.3's own pure-torch rasterizer on a CPU, as a function with the arguments of its `rasterization`.

    pip install gsplat==1.5.3
    drgs crossval scene.ply --cameras cameras.json --rasterizer examples.gsplat_torch:rasterization -o out

gsplat carries `rendering._rasterization`, a version of its rasterizer that torch differentiates. It still calls CUDA
for what has no derivative, and nerfacc for compositing, so that it does not run without a card. Here it does:

- gsplat's, unchanged: `_rasterization` itself, `_quat_scale_to_covar_preci`, `_fully_fused_projection` (with
  `_world_to_cam` and `_persp_proj`), `_rasterize_to_pixels`, `accumulate` (alphas), and, in place of the CUDA functions
  of the same names, its torch versions `_spherical_harmonics`, `_isect_tiles` and `_isect_offset_encode`;
- ours: `listed`, the pairs of pixels and Gaussians that count (gsplat has that in CUDA only: 1/255, 0.999, 1e-4), and
  two functions of nerfacc, front-to-back weights and their sum.

All derivatives are torch's, through gsplat's functions; the compiled CUDA code plays no part.
"""

from __future__ import annotations

import contextlib
import sys
import types
from unittest import mock

import torch

_ALPHA_MIN, _ALPHA_MAX, _TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4


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
    eps2d=0.3,
    sh_degree=None,
    backgrounds=None,
    render_mode="RGB",
    rasterize_mode="classic",
    **unused,
):
    """(..., C, H, W, 3) image, (..., C, H, W, 1) alpha and gsplat's dict; arguments as gsplat's `rasterization`.

    Raises:
        ImportError: If gsplat 1.5.3 is not installed, or a version without these functions.
    """
    try:
        from gsplat import rendering
        from gsplat.cuda import _torch_impl, _wrapper

        isect_tiles, offset_encode = _torch_impl._isect_tiles, _torch_impl._isect_offset_encode
        harmonics, call = _torch_impl._spherical_harmonics, rendering._rasterization
    except (ImportError, AttributeError) as error:
        raise ImportError(f"examples.gsplat_torch: gsplat 1.5.3 must be installed, got: {error}") from None

    def tiles(means2d, radii, depths, tile_size, tile_width, tile_height, **only_cuda):
        return isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height)

    nerfacc = types.ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha, nerfacc.accumulate_along_rays = weights_from_alpha, accumulated
    with contextlib.ExitStack() as stack:
        for module, name, value in (
            (rendering, "isect_tiles", tiles),
            (rendering, "isect_offset_encode", offset_encode),
            (rendering, "spherical_harmonics", lambda degree, dirs, sh, masks=None: harmonics(degree, dirs, sh)),
            (_wrapper, "rasterize_to_indices_in_range", listed),
        ):
            stack.enter_context(mock.patch.object(module, name, value))
        stack.enter_context(mock.patch.dict(sys.modules, nerfacc=nerfacc))
        return call(
            means,
            quats,
            scales,
            opacities,
            colors,
            viewmats,
            Ks,
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            eps2d=eps2d,
            sh_degree=sh_degree,
            backgrounds=backgrounds,
            render_mode=render_mode,
            rasterize_mode=rasterize_mode,
        )


@torch.no_grad()
def listed(
    range_start,
    range_end,
    transmittances,
    means2d,
    conics,
    opacities,
    width,
    height,
    tile_size,
    isect_offsets,
    flatten_ids,
):
    """Indices (Gaussian, pixel, image), three times (M,), of the hits of one range, by pixel and then front to back.

    As gsplat's CUDA function of the same arguments: a range counts batches of tile_size^2 Gaussians of a tile's list;
    alphas below 1/255 do not count, and a pixel ends before the hit that would leave no more than 1e-4.
    """
    images, rows, columns = isect_offsets.shape[:-2].numel(), *isect_offsets.shape[-2:]
    offsets = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    at, conic, opacity = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    front = transmittances.reshape(images, -1)
    block, found = tile_size * tile_size, []
    for k in range(images * rows * columns):
        image, row, column = k // (rows * columns), k // columns % rows, k % columns
        first, last = offsets[k] + range_start * block, min(offsets[k] + range_end * block, offsets[k + 1])
        ids = flatten_ids[first:last].long()
        y = torch.arange(row * tile_size, min((row + 1) * tile_size, height))
        x = torch.arange(column * tile_size, min((column + 1) * tile_size, width))
        pixel = (y[:, None] * width + x).reshape(-1)
        if len(ids) == 0:
            continue
        dx, dy = ((pixel % width + 0.5)[:, None] - at[ids, 0]), ((pixel // width + 0.5)[:, None] - at[ids, 1])
        a, b, c = conic[ids].unbind(1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacity[ids] * torch.exp(-sigma)).clamp(max=_ALPHA_MAX)
        counts = (sigma >= 0) & (alpha >= _ALPHA_MIN)
        left = torch.cumprod(torch.where(counts, 1 - alpha, 1), 1) * front[image][pixel][:, None]
        p, i = (counts & (left > _TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        found.append(torch.stack([ids[i] % means2d.shape[-2], pixel[p], torch.full_like(p, image)]))
    gaussians, pixels, where = torch.cat(found, 1) if found else torch.zeros(3, 0, dtype=torch.int64)
    order = torch.argsort(where * (width * height) + pixels, stable=True)
    return gaussians[order], pixels[order], where[order]


def weights_from_alpha(alphas, ray_indices, n_rays):
    """(M,) weights a T and transmittances T in front of each of M hits, sorted by ray, front to back."""
    counts = torch.bincount(ray_indices, minlength=n_rays)
    rank = torch.arange(len(alphas)) - (torch.cumsum(counts, 0) - counts)[ray_indices]
    table = alphas.new_ones(n_rays, int(counts.max()) + 1).index_put((ray_indices, rank + 1), 1 - alphas)
    front = torch.cumprod(table, 1)[ray_indices, rank]
    return front * alphas, front


def accumulated(weights, values=None, ray_indices=None, n_rays=None):
    """(n_rays, D) sums over the hits of each ray of weights times values, or of the weights."""
    source = weights[:, None] if values is None else weights[:, None] * values
    return source.new_zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)
