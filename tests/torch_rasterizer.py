"""A differentiable EWA rasterizer in plain torch, and copies of it that are broken on purpose.

Written from the conventions that gsplat publishes (docs/conventions.md lists them with their source lines), from
nothing of this package: it imports torch and math. `rasterization` takes gsplat's arguments and returns what gsplat
returns; torch differentiates it, in float32 or float64, whatever the inputs are. Dense within tiles of 16 x 16 pixels.

`DEFECTS` holds one rasterizer per fault, each a single change of the correct one. They have the same signature and are
functions of this module, `defect_<name>`, so that a `module:function` string finds them. Of three kinds:

- gradient: the image is the correct one bit for bit, the gradient of the raw parameters in `groups` is wrong, that of
  the others is right (raw: means, quats, log_scales, logit_opacities, sh; exp and sigmoid are the caller's);
- convention: the image is another one, and the gradient is the gradient of that image;
- cutoff: the same, where what differs is which contributions are left out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch.nn.functional import normalize

TILE = 16
GROUPS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def _same(x):
    return x


class _Backward(torch.autograd.Function):
    """The input itself, with the gradient that `change` makes of the one that arrives."""

    @staticmethod
    def forward(ctx, x, change):
        ctx.change = change
        return x.view_as(x)

    @staticmethod
    def backward(ctx, gradient):
        return ctx.change(gradient), None


class _Instead(torch.autograd.Function):
    """The value of `x`, with the gradient passed on to `source` unchanged."""

    @staticmethod
    def forward(ctx, x, source):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        return None, gradient


@dataclasses.dataclass(frozen=True)
class Model:
    """The stages and constants of one rasterizer. A defect replaces one of them."""

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
            w2c, K = viewmats[i].to(dtype), Ks[i].to(dtype)
            background = means.new_zeros(3) if backgrounds is None else backgrounds[i].to(dtype)
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
        factor = self.rotation(_rotation(self.unit(quats[index]))) * self.scale(scales[index])[:, None, :]
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
        splats = {"index": index, "depth": z, "at": at, "opacity": opacity, "first": first, "last": last}
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
                row.append(torch.cat([color, 1 - light[:, None]], 1).reshape(len(py), len(px), 4))
            rows.append(torch.cat(row, 1))
        image = torch.cat(rows)
        return image[..., :3], image[..., 3:]

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
        colors: (N, K, 3) SH coefficients when `sh_degree` is given, else (N, 3).
        viewmats: (C, 4, 4) world to camera, +x right, +y down, +z forward.
        Ks: (C, 3, 3) in pixels.
        width, height: Pixels.
        near_plane: Means with z <= near_plane are left out.
        eps2d: Added to the diagonal of projected covariances, px^2.
        sh_degree: 0..3 or None.
        backgrounds: (C, 3) or None for black.
        **unused: Other options of gsplat are ignored.
    Returns:
        (C, H, W, 3) colors, (C, H, W, 1) alpha, and a dict.
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


def _rotation(q):
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


# ---------------------------------------------------------------------------------------------------------------------
# Defects
# ---------------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Defect:
    """One fault of a rasterizer.

    Attributes:
        kind: `gradient`, `convention` or `cutoff`: see the module's text.
        groups: Raw parameters whose gradient is wrong (kind `gradient`), else empty.
        words: What a report on it must mention, lower case: any one of them will do.
        what: One line on the fault.
        name: As in `DEFECTS`.
        fields: The stage or constant of `Model` that it replaces.
    """

    kind: str
    groups: tuple[str, ...]
    words: tuple[str, ...]
    what: str
    name: str
    fields: dict

    def make(self) -> Callable:
        """The rasterizer that has the fault, a function of this module."""
        return globals()[f"defect_{self.name}"]


def _without_chain(scales):
    values = scales.detach()
    return _Backward.apply(scales, lambda g: g * values)


def _detached_background(transmittance, background):
    return CORRECT.behind(transmittance.detach(), background)


def _upper_triangle(gradient):
    # What arrives is the derivative by nine entries of which six are independent.
    return torch.triu(0.5 * (gradient + gradient.transpose(-1, -2)))


def _nan_where_culled(means, depths, near):
    culled = (depths <= near)[:, None]
    return _Backward.apply(means, lambda g: torch.where(culled, torch.nan, g))


def _wrong_band(sh):
    return torch.cat([sh[:, :1], _Backward.apply(sh[:, 1:4], torch.neg), sh[:, 4:]], 1)


def _phase(sh):
    # Coefficient k = l (l + 1) + m, and l (l + 1) is even: m is odd where k is.
    return torch.where(torch.arange(sh.shape[1]) % 2 == 1, -1, 1).to(sh)[:, None]


_SHAPE = ("quats", "log_scales")
_GEOMETRY = ("means", *_SHAPE)

# name: kind, groups, words, what, the replaced field
_TABLE = {
    "covariance_off_diagonal": (
        "gradient",
        _GEOMETRY,
        ("covariance", "quats", "log_scales"),
        "the backward pass counts the off-diagonal entry of the projected covariance twice (the factor debated in "
        "graphdeco-inria/gaussian-splatting#551)",
        {"off_diagonal": lambda b: _Backward.apply(b, lambda g: 2 * g)},
    ),
    "covariance_triangle": (
        "gradient",
        _SHAPE,
        ("covariance", "quats", "log_scales"),
        "the backward pass uses the upper triangle of the 3D covariance's gradient only (a covariance gradient that "
        "weak tests let pass, as in nerfstudio-project/gsplat#136)",
        {"covariance": lambda cov: _Backward.apply(cov, _upper_triangle)},
    ),
    "view_direction_detached": (
        "gradient",
        ("means",),
        ("direction", "means"),
        "the view direction of the SH is detached from the means",
        {"direction": lambda means, center: CORRECT.direction(means.detach(), center)},
    ),
    "opacity_detached": (
        "gradient",
        ("logit_opacities",),
        ("logit_opacities",),
        "opacities are detached",
        {"opacity": torch.Tensor.detach},
    ),
    "scale_chain_missing": (
        "gradient",
        ("log_scales",),
        ("log_scales",),
        "returns the derivative by log s where the derivative by s is due",
        {"scale": _without_chain},
    ),
    "background_gradient": (
        "gradient",
        (*_GEOMETRY, "logit_opacities"),
        ("background", "logit_opacities"),
        "the transmittance in front of the background is detached",
        {"behind": _detached_background},
    ),
    "clamp_passes_gradient": (
        "gradient",
        (*_GEOMETRY, "logit_opacities"),
        ("clamp", "logit_opacities"),
        "a clamped alpha passes its gradient through (as in INRIA's rasterizer)",
        {"clamp": lambda alpha, alpha_max: _Instead.apply(alpha.clamp(max=alpha_max), alpha)},
    ),
    "quaternion_projection": (
        "gradient",
        ("quats",),
        ("quats", "quaternion"),
        "the backward pass leaves out the normalization of the quaternion",
        {"unit": lambda q: _Instead.apply(normalize(q, dim=-1), q)},
    ),
    "sh_gradient_sign": (
        "gradient",
        ("sh",),
        ("sh",),
        "the gradient of the SH band of degree 1 has the wrong sign",
        {"coefficients": _wrong_band},
    ),
    "nan_culled": (
        "gradient",
        ("means",),
        ("nan", "finite", "means"),
        "Gaussians behind the camera get NaN as the gradient of their means",
        {"mean": _nan_where_culled},
    ),
    "quaternion_order": (
        "convention",
        (),
        ("quaternion",),
        "quaternions are read as xyzw",
        {"unit": lambda q: normalize(q, dim=-1)[..., [3, 0, 1, 2]]},
    ),
    "rotation_transposed": (
        "convention",
        (),
        ("rotation", "transpose"),
        "the rotation is transposed",
        {"rotation": lambda r: r.transpose(-1, -2)},
    ),
    "sort_by_distance": (
        "convention",
        (),
        ("sort", "depth"),
        "Gaussians are sorted by distance instead of z",
        {"key": lambda view: view.norm(dim=1)},
    ),
    "pixel_center": (
        "convention",
        (),
        ("pixel",),
        "pixel centers lie at integers",
        {"pixel": 0.0},
    ),
    "channels_swapped": (
        "convention",
        (),
        ("channel", "bgr"),
        "channels come as BGR",
        {"color": lambda rgb: rgb.flip(-1)},
    ),
    "compensated_opacity": (
        "convention",
        (),
        ("compensat", "dilation", "antialias"),
        "opacities are compensated for the dilation, sqrt(det / det dilated), in what claims to be the classic mode",
        {"compensation": lambda before, after: (before.clamp(min=0) / after).clamp(min=1e-12).sqrt()},
    ),
    "no_dilation": (
        "convention",
        (),
        ("dilation",),
        "projected covariances are not dilated",
        {"dilation": 0.0},
    ),
    "background_ignored": (
        "convention",
        (),
        ("background",),
        "the background is left out",
        {"behind": lambda transmittance, background: 0 * CORRECT.behind(transmittance, background)},
    ),
    "opacity_logits": (
        "convention",
        (),
        ("opacit", "activation", "logit"),
        "opacities are taken for logits: a sigmoid is applied to them once more",
        {"opacity": torch.sigmoid},
    ),
    "sh_phase": (
        "convention",
        (),
        ("sh",),
        "the SH basis lacks the factor (-1)^m",
        {"coefficients": lambda sh: sh * _phase(sh)},
    ),
    "sh_direction_reversed": (
        "convention",
        (),
        ("direction", "sh"),
        "SH are evaluated from the Gaussian to the camera",
        {"direction": lambda means, center: -CORRECT.direction(means, center)},
    ),
    "early_stop": (
        "cutoff",
        (),
        ("transmittance", "stop"),
        "rays end at a transmittance of 1e-2 instead of 1e-4",
        {"transmittance_min": 1e-2},
    ),
}


def _function(defect: Defect) -> Callable:
    function = rasterizer(dataclasses.replace(CORRECT, **defect.fields))
    function.__name__ = function.__qualname__ = f"defect_{defect.name}"
    function.__doc__ = f"`rasterization`, but {defect.what}."
    return function


DEFECTS = {
    name: Defect(kind, groups, words, what, name, fields)
    for name, (kind, groups, words, what, fields) in _TABLE.items()
}
globals().update({f"defect_{name}": _function(defect) for name, defect in DEFECTS.items()})


def broken(defect: str) -> Callable:
    """The rasterizer with that defect, one of `DEFECTS`."""
    return DEFECTS[defect].make()


def random_scene(seed=0, n=60, width=48, height=40, dtype=torch.float64, degree=2) -> dict:
    """Raw parameters and a camera on which every defect shows, as a dict.

    Keys means, quats, log_scales, logit_opacities, sh, viewmat (4, 4), K (3, 3), width, height, background (3,): a wide
    field of view (so that z and distance sort differently), layers of nearly opaque Gaussians (so that rays end and
    alphas are clamped), small ones (dilation), some behind the camera, quaternions of any length.
    """
    make = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=make, dtype=torch.float64)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=make, dtype=torch.float64)

    depth = uniform(2.0, 5.0, n)
    means = torch.stack([depth * uniform(-0.9, 0.9, n), depth * uniform(-0.75, 0.75, n), depth], 1)
    log_scales = math.log(0.25) + 0.7 * normal(n, 3)
    logits = 1.5 * normal(n)
    focal = 0.55 * width
    center = torch.tensor([width, height]) * uniform(0.42, 0.58, 2)
    clamped, opaque, behind = n // 6, n // 3, max(2, n // 15)
    logits[:opaque] = uniform(3.0, 5.0, opaque)
    # The first ones are in front, all but opaque, and nearly centered on a pixel, where their alpha is clamped.
    sigma, near = uniform(2.0, 3.0, clamped, 1), uniform(1.6, 1.9, clamped, 1)
    pixel = torch.stack([uniform(4, width - 4, clamped), uniform(4, height - 4, clamped)], 1).floor() + 0.5
    pixel = pixel + 0.03 * sigma * normalize(normal(clamped, 2), dim=1)
    means[:clamped] = near * torch.cat([(pixel - center) / (focal * torch.tensor([1, 1.03])), near / near], 1)
    log_scales[:clamped] = (sigma * near / focal).log() + 0.2 * normal(clamped, 3)
    logits[:clamped] = uniform(8.0, 10.0, clamped)
    means[n - behind :, 2] *= -0.5
    turn = _rotation(normalize(torch.cat([torch.ones(1, dtype=torch.float64), 0.2 * normal(3)]), dim=0))
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = turn, 0.3 * normal(3)
    means = (means - viewmat[:3, 3]) @ turn
    tensors = {
        "means": means,
        "quats": normal(n, 4) * uniform(0.3, 3.0, n, 1),
        "log_scales": log_scales,
        "logit_opacities": logits,
        "sh": 0.4 * normal(n, (degree + 1) ** 2, 3),
        "viewmat": viewmat,
        "K": torch.tensor([[focal, 0, center[0]], [0, 1.03 * focal, center[1]], [0, 0, 1]], dtype=torch.float64),
        "background": uniform(0.2, 0.9, 3),
    }
    # Rounded, so that float32 and float64 renderers see the same Gaussians.
    tensors = {name: (x if name in ("viewmat", "K") else x.float()).to(dtype) for name, x in tensors.items()}
    return {**tensors, "width": width, "height": height}


def draw(function, scene: dict) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 3) image and (H, W) alpha of a scene of raw parameters, through exp and sigmoid."""
    image, alpha, _ = function(
        scene["means"],
        scene["quats"],
        scene["log_scales"].exp(),
        torch.sigmoid(scene["logit_opacities"]),
        scene["sh"],
        scene["viewmat"][None],
        scene["K"][None],
        scene["width"],
        scene["height"],
        sh_degree=math.isqrt(scene["sh"].shape[1]) - 1,
        backgrounds=scene["background"][None],
    )
    return image[0], alpha[0, ..., 0]


def gradients(function, scene: dict, cotangent: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image, and the gradient of sum <cotangent, image> by raw parameter; what is not reached gets 0."""
    leaves = {name: scene[name].detach().clone().requires_grad_() for name in GROUPS}
    image, _ = draw(function, {**scene, **leaves})
    found = torch.autograd.grad(image, list(leaves.values()), cotangent, allow_unused=True, materialize_grads=True)
    return image.detach(), dict(zip(leaves, found, strict=True))
