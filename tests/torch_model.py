"""The stages of a differentiable EWA rasterizer in plain torch, with gsplat's conventions and arguments.

Written from the conventions that gsplat publishes (docs/conventions.md lists them with their source lines), from
nothing of this package: it imports torch and math. torch differentiates it, in float32 or float64, whatever the inputs
are. Dense within tiles of 16 x 16 pixels. torch_rasterizer.py breaks single stages of it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch.nn.functional import normalize

TILE = 16


def _same(x):
    return x


@dataclasses.dataclass(frozen=True)
class Model:
    """The stages and constants of one rasterizer. A defect replaces one of them."""

    pose: Callable = _same
    mean: Callable = lambda means, depths, near: means
    unit: Callable = lambda quats: normalize(quats, dim=-1)
    rotation: Callable = _same
    scale: Callable = _same
    opacity: Callable = _same
    covariance: Callable = _same
    off_diagonal: Callable = _same
    compensation: Callable = lambda before, after: torch.ones_like(after)
    direction: Callable = lambda means, center: normalize(means - center, dim=-1)
    coefficients: Callable = _same
    color: Callable = _same
    numbers: Callable = _same
    key: Callable = lambda view: view[:, 2]
    clamp: Callable = lambda alpha, alpha_max: alpha.clamp(max=alpha_max)
    behind: Callable = lambda transmittance, background: transmittance[:, None] * background
    pixel: float = 0.5
    dilation: float = 1.0
    alpha_min: float = 1 / 255
    alpha_max: float = 0.999
    transmittance_min: float = 1e-4
    extend: float = 3.33

    def rasterize(
        self,
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
        eps2d=0.3,
        sh_degree=None,
        backgrounds=None,
    ):
        """See `rasterization`."""
        if sh_degree is not None and (sh_degree + 1) ** 2 > colors.shape[1]:
            raise ValueError(f"rasterization: degree {sh_degree} must have more coefficients than {colors.shape[1]}")
        dtype = means.dtype
        images, alphas, depths = [], [], []
        for i in range(len(viewmats)):
            w2c, K = self.pose(viewmats[i].to(dtype)), Ks[i].to(dtype)
            background = means.new_zeros(colors.shape[-1]) if backgrounds is None else backgrounds[i].to(dtype)
            splats = self._project(means, quats, scales, opacities, w2c, K, width, height, near_plane, eps2d)
            rgb = self._colors(means, colors, w2c, sh_degree)[splats["index"]]
            image, alpha = self._composite(splats, rgb, background, width, height)
            images.append(image)
            alphas.append(alpha)
            depths.append(splats["depth"])
        return torch.stack(images), torch.stack(alphas), {"depths": depths, "width": width, "height": height}

    def _colors(self, means, colors, w2c, degree):
        if degree is not None:
            count = (degree + 1) ** 2
            center = torch.linalg.inv(w2c)[:3, 3]
            basis = _harmonics(self.direction(means, center), degree)
            colors = (basis[:, :, None] * self.coefficients(colors[:, :count])).sum(1) + 0.5
            colors = colors.clamp(min=0)
        return self.color(colors)

    def _project(self, means, quats, scales, opacities, w2c, K, width, height, near, eps2d):
        """Gaussians in front of the camera that touch the image, sorted by depth: ellipses and tiles."""
        turn, fx, fy, cx, cy = w2c[:3, :3], K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        depths = (means.detach() @ turn.T + w2c[:3, 3])[:, 2]
        index = torch.nonzero(depths > near)[:, 0]
        view = self.mean(means, depths, near)[index] @ turn.T + w2c[:3, 3]
        x, y, z = view.unbind(1)
        margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
        # Within the clamp's limits this is x and y; outside, the Jacobian's direction stops following the mean.
        tx = z * torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
        ty = z * torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
        zero = torch.zeros_like(z)
        rows = [fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2]
        jacobian = torch.stack(rows, 1).reshape(-1, 2, 3) @ turn
        factor = self.rotation(rotation_of(self.unit(quats[index]))) * self.scale(scales[index])[:, None, :]
        cov = jacobian @ self.covariance(factor @ factor.transpose(1, 2)) @ jacobian.transpose(1, 2)
        a, b, c = cov[:, 0, 0], self.off_diagonal(cov[:, 0, 1]), cov[:, 1, 1]
        before = a * c - b * b
        a, c = a + self.dilation * eps2d, c + self.dilation * eps2d
        det = a * c - b * b
        opacity = self.opacity(opacities[index]) * self.compensation(before, det)
        at = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
        with torch.no_grad():
            extend = torch.full_like(z, self.extend)
            if self.alpha_min > 0:
                extend = extend.minimum((2 * (opacity / self.alpha_min).log().clamp(min=0)).sqrt())
            radius = torch.ceil(extend[:, None] * torch.stack([a, c], 1).clamp(min=0).sqrt())
            size = at.new_tensor([width, height])
            keep = (det > 0) & (opacity >= self.alpha_min) & ((at + radius > 0) & (at - radius < size)).all(1)
            order = torch.argsort(self.key(view), stable=True)
            order = order[keep[order]]
            first, last = torch.floor((at - radius) / TILE), torch.ceil((at + radius) / TILE)
        splats = {"index": self.numbers(index), "depth": z, "at": at, "opacity": opacity, "first": first, "last": last}
        splats = {name: value[order] for name, value in splats.items()}
        # Divided only where kept: a determinant of 0 would give NaN in the gradient.
        a, b, c, det = (value[order] for value in (a, b, c, det))
        return {**splats, "conic": torch.stack([c / det, -b / det, a / det], 1)}

    def _composite(self, splats, rgb, background, width, height):
        """One tile after the other: its pixels against the Gaussians that touch it."""
        rows = []
        for top in range(0, height, TILE):
            row = []
            for left in range(0, width, TILE):
                tile = rgb.new_tensor([left // TILE, top // TILE])
                touched = ((splats["first"] <= tile) & (tile < splats["last"])).all(1).nonzero()[:, 0]
                py = torch.arange(top, min(top + TILE, height), device=rgb.device)
                px = torch.arange(left, min(left + TILE, width), device=rgb.device)
                y, x = torch.meshgrid(py.to(rgb.dtype), px.to(rgb.dtype), indexing="ij")
                pixels = torch.stack([x.reshape(-1), y.reshape(-1)], 1) + self.pixel
                inside = {name: splats[name][touched] for name in ("at", "conic", "opacity")}
                weights, light = self._weights(pixels, **inside)
                color = weights @ rgb[touched] + self.behind(light, background)
                row.append(torch.cat([color, 1 - light[:, None]], 1).reshape(len(py), len(px), -1))
            rows.append(torch.cat(row, 1))
        image = torch.cat(rows)
        return image[..., :-1], image[..., -1:]

    def _weights(self, pixels, at, conic, opacity):
        """(P, M) weights of M Gaussians in order at P pixels, and what light is left (P,)."""
        if len(at) == 0:
            return pixels.new_zeros(len(pixels), 0), pixels.new_ones(len(pixels))
        dx, dy = (at[None] - pixels[:, None]).unbind(2)
        sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = self.clamp(opacity * torch.exp(-sigma.clamp(min=0)), self.alpha_max)
        with torch.no_grad():
            counts = (sigma >= 0) & (alpha >= self.alpha_min)
            # It only falls: behind the first that would leave too little, nothing counts.
            counts &= torch.cumprod(1 - alpha * counts, 1) > self.transmittance_min
        alpha = torch.where(counts, alpha, 0)
        left = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
        return alpha * before, left[:, -1]


CORRECT = Model()


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
    eps2d=0.3,
    sh_degree=None,
    backgrounds=None,
    **unused,
):
    """Images of N Gaussians from C pinhole cameras, with gsplat's arguments.

    Args:
        means: (N, 3), world frame.
        quats: (N, 4) wxyz, any length but 0.
        scales: (N, 3) standard deviations.
        opacities: (N,) in (0, 1).
        colors: (N, K, 3) SH coefficients when `sh_degree` is given, else (N, D).
        viewmats: (C, 4, 4) world to camera, +x right, +y down, +z forward.
        Ks: (C, 3, 3) in pixels.
        width, height: Pixels.
        near_plane: Means with z <= near_plane are left out.
        eps2d: Added to the diagonal of projected covariances, px^2.
        sh_degree: 0..3 or None.
        backgrounds: (C, D) or None for black.
        **unused: Other options of gsplat are ignored.
    Returns:
        (C, H, W, D) colors, D = 3 with `sh_degree`, (C, H, W, 1) alpha, and a dict.
    """
    options = {"near_plane": near_plane, "eps2d": eps2d, "sh_degree": sh_degree, "backgrounds": backgrounds}
    return CORRECT.rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options)


def rasterizer(model: Model) -> Callable:
    """A function like `rasterization` that computes with another model."""

    def rasterize(
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
        eps2d=0.3,
        sh_degree=None,
        backgrounds=None,
        **unused,
    ):
        options = {"near_plane": near_plane, "eps2d": eps2d, "sh_degree": sh_degree, "backgrounds": backgrounds}
        return model.rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options)

    return rasterize


def rotation_of(q):
    w, x, y, z = q.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, -1).reshape(*q.shape[:-1], 3, 3)


def _harmonics(d, degree):
    """(N, (degree + 1)^2) real spherical harmonics at unit directions, in the order and with the signs of 3DGS."""
    x, y, z = d.unbind(1)
    found = [torch.full_like(x, 0.5 / math.sqrt(math.pi))]
    if degree > 0:
        c = math.sqrt(3 / (4 * math.pi))
        found += [-c * y, c * z, -c * x]
    if degree > 1:
        c = math.sqrt(15 / math.pi) / 2
        found += [c * x * y, -c * y * z, math.sqrt(5 / math.pi) / 4 * (3 * z * z - 1), -c * x * z]
        found += [c / 2 * (x * x - y * y)]
    if degree > 2:
        c1, c2, c3 = (math.sqrt(k / math.pi) / 4 for k in (10.5, 105, 17.5))
        found += [-c3 * y * (3 * x * x - y * y), 2 * c2 * x * y * z, -c1 * y * (5 * z * z - 1)]
        found += [math.sqrt(7 / math.pi) / 4 * z * (5 * z * z - 3), -c1 * x * (5 * z * z - 1)]
        found += [c2 * z * (x * x - y * y), -c3 * x * (x * x - 3 * y * y)]
    return torch.stack(found, 1)
