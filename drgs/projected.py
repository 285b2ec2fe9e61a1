"""`meta` of gsplat's `rasterization`: where Gaussians are on the image, by the Jacobian or the unscented transform."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.covariances import strained
from drgs.ellipsoids import semi_axes
from drgs.settings import RenderSettings
from drgs.splats import Splats
from drgs.tracing.unscented import (
    DILATION,
    EXTENT,
    LEAST_COMPENSATION,
    LEAST_OPACITY,
    MARGIN,
    OF_COVARIANCE,
    OF_MEAN,
    SPREAD,
)

__all__ = ["projected", "unscented"]


def projected(
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


def unscented(splats: Splats, camera: Camera, depths: torch.Tensor, near: float) -> dict[str, torch.Tensor]:
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
        of_mean, of_covariance = (torch.tensor(x, dtype=torch.float64) for x in (OF_MEAN, OF_COVARIANCE))
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
