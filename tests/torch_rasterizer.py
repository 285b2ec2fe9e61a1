"""A rasterizer in plain torch (torch_model.py), and copies of it that are broken on purpose.

`DEFECTS` holds one rasterizer per fault, each a single change of the correct one. They have the same signature and are
functions of this module, `defect_<name>`, so that a `module:function` string finds them. Of four kinds:

- gradient: the image is the correct one bit for bit, the gradient of the raw parameters in `groups` is wrong, that of
  the others is right (raw: means, quats, log_scales, logit_opacities, sh; exp and sigmoid are the caller's);
- beside: as gradient, but what is wrong is the gradient of the pose (`viewmats`), or of colors of more than three
  channels (`colors`);
- convention: the image is another one, and the gradient is the gradient of that image;
- cutoff: the same, where what differs is which contributions are left out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch.nn.functional import normalize

if __package__:  # `tests.torch_rasterizer:...` from the root of a checkout
    from .torch_model import CORRECT, Model, rasterization, rasterizer, rotation_of
else:
    from torch_model import CORRECT, Model, rasterization, rasterizer, rotation_of

__all__ = [
    "CORRECT",
    "DEFECTS",
    "GROUPS",
    "PATH_DEFECTS",
    "Defect",
    "Model",
    "PathDefect",
    "PathModel",
    "broken",
    "draw",
    "gradients",
    "paths",
    "random_scene",
    "rasterization",
    "rasterizer",
]

GROUPS = ("means", "quats", "log_scales", "logit_opacities", "sh")


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
class Defect:
    """One fault of a rasterizer.

    Attributes:
        kind: `gradient`, `beside`, `convention` or `cutoff`: see the module's text.
        groups: Raw parameters whose gradient is wrong (kind `gradient`), or `viewmats` or `colors`, else empty.
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


def _translation_only(w2c):
    return torch.cat([w2c[:, :3].detach(), w2c[:, 3:]], 1)


def _sixth_channel(color):
    return torch.cat([color[:, :5], color[:, 5:6].detach(), color[:, 6:]], 1)


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
    "pose_rotation": (
        "beside",
        ("viewmats",),
        ("viewmats",),
        "the gradient of the pose lacks the part of its rotation",
        {"pose": _translation_only},
    ),
    "sixth_channel": (
        "beside",
        ("colors",),
        ("colors",),
        "the gradient of the sixth channel of plain colors is dropped",
        {"color": _sixth_channel},
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


@dataclasses.dataclass(frozen=True)
class PathModel:
    """A rasterizer with depth modes, several cameras and packed arrays. A defect replaces a stage of one path."""

    color: Model = CORRECT
    depth: Model = CORRECT
    own: Callable = lambda depth: depth
    divisor: Callable = lambda alpha: alpha
    packed: Callable = lambda means: means
    of_camera: Callable = lambda index, count, x: x

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
        render_mode="RGB",
        packed=False,
    ):
        """Images of RGB, RGB+D and RGB+ED, with gsplat's arguments."""
        if render_mode not in ("RGB", "RGB+D", "RGB+ED"):
            raise ValueError(f"rasterize: render_mode {render_mode} is not there")
        options = {"near_plane": near_plane, "eps2d": eps2d}
        images, alphas = [], []
        for i, (w2c, K) in enumerate(zip(viewmats, Ks, strict=True)):
            inputs = [self.of_camera(i, len(Ks), x) for x in (means, quats, scales, opacities, colors)]
            if packed:
                inputs[0] = self.packed(inputs[0])
            one = w2c[None], K[None], width, height
            behind = None if backgrounds is None else backgrounds[i : i + 1]
            image, alpha, _ = self.color.rasterize(*inputs, *one, sh_degree=sh_degree, backgrounds=behind, **options)
            if render_mode != "RGB":
                z = self.own((inputs[0] @ w2c[:3, :3].T + w2c[:3, 3])[:, 2:])
                depth, weight, _ = self.depth.rasterize(*inputs[:4], z, *one, **options)
                if render_mode == "RGB+ED":
                    depth = depth / self.divisor(weight).clamp(min=1e-10)
                image = torch.cat([image, depth], -1)
            images.append(image)
            alphas.append(alpha)
        return torch.cat(images), torch.cat(alphas), {}


@dataclasses.dataclass(frozen=True)
class PathDefect:
    """A fault of one path of a rasterizer whose images and gradients of one view are right.

    Attributes:
        what: One line on the fault.
        path: Paths that it shows on.
        verdict: Verdict of the whole.
        call: The rasterizer that has it.
    """

    what: str
    path: tuple[str, ...]
    verdict: str
    call: Callable


paths = PathModel().rasterize
_BOTH_DEPTHS = ("depth RGB+D", "depth RGB+ED")
_PATH_TABLE = {
    "depth_halved": (
        "the gradient of a depth by the depths of Gaussians is halved",
        _BOTH_DEPTHS,
        {"own": lambda depth: _Backward.apply(depth, lambda g: 0.5 * g)},
    ),
    "depth_cross_terms": (
        "the gradient of an expected depth lacks the terms of the alpha that it is divided by",
        _BOTH_DEPTHS[1:],
        {"divisor": torch.Tensor.detach},
    ),
    "depth_clamp_passes": (
        "a clamped alpha passes its gradient through in the depth alone",
        _BOTH_DEPTHS,
        {"depth": dataclasses.replace(CORRECT, **DEFECTS["clamp_passes_gradient"].fields)},
    ),
    "index_shifted": (
        "colors are those of the n-th Gaussian of all, where the n-th that is not culled is meant",
        ("culled Gaussians in front", "near plane"),
        {"color": dataclasses.replace(CORRECT, numbers=lambda index: torch.arange(len(index)))},
    ),
    "one_camera_of_two": (
        "of several cameras in a call only the last one has a gradient",
        ("several cameras in a call",),
        {"of_camera": lambda i, count, x: x if i == count - 1 else x.detach()},
    ),
    "packed_detached": ("packed means are detached", ("packed",), {"packed": torch.Tensor.detach}),
}
PATH_DEFECTS = {
    name: PathDefect(
        what,
        where,
        "model difference" if name == "index_shifted" else "gradient bug",
        PathModel(**fields).rasterize,
    )
    for name, (what, where, fields) in _PATH_TABLE.items()
}
globals().update({f"paths_{name}": defect.call for name, defect in PATH_DEFECTS.items()})


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
    turn = rotation_of(normalize(torch.cat([torch.ones(1, dtype=torch.float64), 0.2 * normal(3)]), dim=0))
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
