"""A rasterizer in plain torch that evaluates Gaussians along rays, as 3DGUT does, and copies broken on purpose.

Written from the equations, from nothing of this package: it imports torch, math and the helpers of torch_model.py. With
o, d the origin and unit direction of a pixel's ray, gro = S^-1 R^T (o - mu), grd = S^-1 R^T d / |S^-1 R^T d|, a
Gaussian's alpha is opacity exp(-|grd x gro|^2 / 2), at most 0.99, nothing below 1/255 or where the exponential is below
0.0113; Gaussians are composited by the z of their mean (or by its distance), and a ray ends before the hit that would
bring its transmittance to 1e-4 or less. Lenses are OpenCV's with gsplat's arguments, rows or columns of a rolling
shutter have the pose of their time: row j of H at j / (H - 1) between `viewmats` and `viewmats_rs`, translations
linearly, rotations along the great circle. Dense: every pixel against every Gaussian.

`DEFECTS` holds one rasterizer per fault, as torch_rasterizer.py has them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch.nn.functional import normalize

if __package__:  # `tests.torch_rays:...` from the root of a checkout
    from .torch_model import _harmonics, rotation_of
    from .torch_rasterizer import Defect, _Backward, _Instead, _without_chain, random_scene
else:
    from torch_model import _harmonics, rotation_of
    from torch_rasterizer import Defect, _Backward, _Instead, _without_chain, random_scene

__all__ = [
    "CORRECT",
    "DEFECTS",
    "LENSES",
    "RayModel",
    "SHUTTERS",
    "broken",
    "end_of",
    "interpolated",
    "lens_detached",
    "ray_scene",
    "rasterization",
    "rasterizer",
    "turned",
]

SHUTTERS = ("rolling_top_to_bottom", "rolling_left_to_right", "rolling_bottom_to_top", "rolling_right_to_left")
# Model and coefficients in OpenCV's order, (k1, k2, p1, p2, k3) of the one, (k1, k2, k3, k4) of the other.
LENSES = {
    "pinhole": ("pinhole", ()),
    "opencv": ("opencv", (0.08, 0.02, 0.03, -0.02, 0.01)),
    "fisheye": ("opencv_fisheye", (0.02, -0.01, 0.003, 0.0005)),
}

_NEWTON = 40  # rounds at most; lenses that images are taken with need five


def _same(x):
    return x


@dataclasses.dataclass(frozen=True)
class RayModel:
    """The stages and constants of one rasterizer. A defect replaces one of them."""

    pose: Callable = _same
    end: Callable = _same
    origin: Callable = _same
    unit: Callable = lambda quats: normalize(quats, dim=-1)
    rotation: Callable = _same
    scale: Callable = _same
    opacity: Callable = _same
    local_direction: Callable = lambda grd: normalize(grd, dim=-1)
    square: Callable = _same
    clamp: Callable = lambda alpha, alpha_max: alpha.clamp(max=alpha_max)
    gathered: Callable = lambda alpha, before, rgb: (alpha * before) @ rgb
    key: Callable = lambda view: view[:, 2]
    radial: Callable = _same
    tangential: Callable = _same
    behind: bool = False
    between: bool = True
    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    density_min: float = 0.0113
    transmittance_min: float = 1e-4
    keeps_last: bool = False

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
        sh_degree=None,
        backgrounds=None,
        camera_model="pinhole",
        radial_coeffs=None,
        tangential_coeffs=None,
        rolling_shutter="global",
        viewmats_rs=None,
    ):
        """See `rasterization`."""
        images, alphas = [], []
        for i, K in enumerate(Ks):
            lens = (None if x is None else x[i] for x in (radial_coeffs, tangential_coeffs))
            local = self._local(K, width, height, camera_model, *lens)
            first = self.pose(viewmats[i])
            last = None if viewmats_rs is None else self.end(viewmats_rs[i])
            o, d = self._rays(local, first, last, shutter_of(rolling_shutter), width, height)
            rgb = self._colors(means, colors, first, last, sh_degree)
            turn, shift = first[:3, :3], first[:3, 3]
            if last is not None:  # depths are those of the middle of the shutter
                turn, shift = (x[0] for x in interpolated(first, last, torch.full((1,), 0.5).to(first)))
            view = means @ turn.T + shift
            shown = view.detach()[:, 2] > near_plane
            order = torch.argsort(self.key(view.detach())[shown], stable=True)
            index = torch.nonzero(shown)[:, 0][order]
            alpha = self._alphas(o, d, means[index], quats[index], scales[index], opacities[index])
            background = means.new_zeros(colors.shape[-1]) if backgrounds is None else backgrounds[i]
            image, light = self._composite(alpha, rgb[index], background)
            images.append(image.reshape(height, width, -1))
            alphas.append(1 - light.reshape(height, width, 1))
        return torch.stack(images), torch.stack(alphas), {"width": width, "height": height}

    @torch.no_grad()
    def _local(self, K, width, height, model, radial, tangential):
        """(P, 3) unit directions in the camera's axes; intrinsics and lenses have no derivative."""
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixels = torch.stack([x, y], -1).reshape(-1, 2).to(K) + 0.5
        plane = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
        radial = plane.new_zeros(0) if radial is None else self.radial(radial)
        if model == "fisheye":
            k = torch.cat([radial, radial.new_zeros(4 - len(radial))])
            distance = plane.norm(dim=1)
            angle = distance.clone()
            powers = torch.arange(1, 5, device=K.device)
            for _ in range(_NEWTON):
                term = angle[:, None] ** (2 * powers) * k
                slope = 1 + (term * (2 * powers + 1)).sum(1)
                angle = angle - (angle * (1 + term.sum(1)) - distance) / slope
            turn = torch.where(distance > 0, angle.sin() / distance.clamp(min=1e-300), 1.0)
            return torch.cat([plane * turn[:, None], angle.cos()[:, None]], 1)
        if model != "pinhole":
            raise ValueError(f"rasterization: camera_model must be pinhole or fisheye, got {model!r}")
        k = torch.cat([radial, radial.new_zeros(6 - len(radial))])
        p = plane.new_zeros(2) if tangential is None else self.tangential(tangential)
        at = _undistorted(plane, k, p)
        return normalize(torch.cat([at, torch.ones_like(at[:, :1])], 1), dim=1)

    def _rays(self, local, first, last, shutter, width, height):
        """(P, 3) origins and unit directions in the world."""
        if shutter == "global":
            turn, shift = first[:3, :3].expand(len(local), 3, 3), first[:3, 3].expand(len(local), 3)
        else:
            turn, shift = interpolated(first, last, times(shutter, width, height).to(local))
        back = turn.transpose(1, 2)
        origin = self.origin(-(back @ shift[:, :, None])[:, :, 0])
        return origin, (back @ local[:, :, None])[:, :, 0]

    def _colors(self, means, colors, first, last, degree):
        if degree is None:
            return colors
        if last is None or self.between:  # as in gsplat
            centers = [torch.linalg.inv(w2c)[:3, 3] for w2c in (first, last) if w2c is not None]
            center = sum(centers) / len(centers)
        else:
            turn, shift = (x[0] for x in interpolated(first, last, torch.full((1,), 0.5).to(first)))
            center = -turn.T @ shift
        basis = _harmonics(normalize(means - center, dim=-1), degree)
        return ((basis[:, :, None] * colors[:, : basis.shape[1]]).sum(1) + 0.5).clamp(min=0)

    def _alphas(self, o, d, means, quats, scales, opacities):
        """(P, M) alphas of M Gaussians, 0 where one is left out."""
        turn = self.rotation(rotation_of(self.unit(quats)))
        whiten = (turn / self.scale(scales)[:, None, :]).transpose(1, 2)
        gro = torch.einsum("mij,pmj->pmi", whiten, o[:, None] - means)
        grd = self.local_direction(torch.einsum("mij,pj->pmi", whiten, d))
        square = self.square(torch.linalg.cross(grd, gro).square().sum(-1))
        density = torch.exp(-0.5 * square)
        alpha = self.clamp(self.opacity(opacities) * density, self.alpha_max)
        with torch.no_grad():
            counts = (alpha >= self.alpha_min) & (density > self.density_min)
            if not self.behind:
                counts &= (grd * gro).sum(-1) < 0
        return torch.where(counts, alpha, 0)

    def _composite(self, alpha, rgb, background):
        """(P, D) colors and (P,) light that is left."""
        with torch.no_grad():  # where a ray ends has no derivative
            left = torch.cumprod(1 - alpha, 1)
            ended = left <= self.transmittance_min
            if self.keeps_last:  # the hit that ends a ray is composited
                ended = torch.cat([torch.zeros_like(ended[:, :1]), ended[:, :-1]], 1)
        alpha = torch.where(ended, 0, alpha)
        left = torch.cumprod(torch.cat([alpha.new_ones(len(alpha), 1), 1 - alpha], 1), 1)
        return self.gathered(alpha, left[:, :-1], rgb) + left[:, -1:] * background, left[:, -1]


def _undistorted(plane, k, p):
    """(P, 2) points on the image plane that the lens moves to `plane`, by Newton's method."""
    at = plane.clone()
    for _ in range(_NEWTON):
        with torch.enable_grad():
            point = at.detach().requires_grad_()
            x, y = point.unbind(1)
            r = x * x + y * y
            factor = (1 + r * (k[0] + r * (k[1] + r * k[2]))) / (1 + r * (k[3] + r * (k[4] + r * k[5])))
            moved = (
                x * factor + 2 * p[0] * x * y + p[1] * (r + 2 * x * x),
                y * factor + p[0] * (r + 2 * y * y) + 2 * p[1] * x * y,
            )
            rows = [torch.autograd.grad(m.sum(), point, retain_graph=True)[0] for m in moved]
        error = torch.stack(moved, 1).detach() - plane
        at = at - torch.linalg.solve(torch.stack(rows, 1), error)
        if not bool((error.abs() > 1e-14).any()):
            break
    return at


def shutter_of(kind) -> str:
    """The name of a shutter, given as text or as a member of gsplat's enumeration."""
    return str(getattr(kind, "name", kind)).lower()


def times(shutter, width, height):
    """(H W,) of every pixel between the two poses, 0 to 1."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    rows, columns = y / max(height - 1, 1), x / max(width - 1, 1)
    kinds = {
        "rolling_top_to_bottom": rows,
        "rolling_bottom_to_top": 1 - rows,
        "rolling_left_to_right": columns,
        "rolling_right_to_left": 1 - columns,
    }
    if shutter not in kinds:
        raise ValueError(f"rasterization: rolling_shutter must be global or one of {', '.join(kinds)}, got {shutter!r}")
    return kinds[shutter].reshape(-1)


def interpolated(first, last, time):
    """(P, 3, 3) rotations along the great circle and (P, 3) translations on the line between two w2c (4, 4)."""
    axis = _log(last[:3, :3] @ first[:3, :3].T)
    turn = turned(time[:, None] * axis) @ first[:3, :3]
    return turn, (1 - time)[:, None] * first[:3, 3] + time[:, None] * last[:3, 3]


def turned(vectors):
    """(P, 3, 3) rotations by rotation vectors (P, 3)."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape[:-1], 3, 3)
    return torch.matrix_exp(cross)


def _log(rotation):
    """(3,) the rotation vector of a rotation by less than a half turn, and not by nothing."""
    part = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = part.norm() / 2
    return part / (2 * sine) * torch.atan2(sine, (rotation.diagonal().sum() - 1) / 2)


CORRECT = RayModel()


def rasterizer(model: RayModel) -> Callable:
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
        sh_degree=None,
        backgrounds=None,
        camera_model="pinhole",
        radial_coeffs=None,
        tangential_coeffs=None,
        rolling_shutter="global",
        viewmats_rs=None,
        **unused,
    ):
        return model.rasterize(
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
            sh_degree=sh_degree,
            backgrounds=backgrounds,
            camera_model=camera_model,
            radial_coeffs=radial_coeffs,
            tangential_coeffs=tangential_coeffs,
            rolling_shutter=rolling_shutter,
            viewmats_rs=viewmats_rs,
        )

    return rasterize


rasterization = rasterizer(CORRECT)
rasterization.__name__ = rasterization.__qualname__ = "rasterization"
rasterization.__doc__ = """Images of N Gaussians from C cameras, evaluated along rays, with gsplat's arguments.

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
    sh_degree: 0..3 or None.
    backgrounds: (C, D) or None for black.
    camera_model: `pinhole` or `fisheye`.
    radial_coeffs: (C, 4) or (C, 6) of OpenCV's lens, or (C, 4) of its fisheye.
    tangential_coeffs: (C, 2).
    rolling_shutter: `global`, or one of the four directions.
    viewmats_rs: (C, 4, 4) poses at the end of the shutter.
    **unused: Other options of gsplat are ignored.
Returns:
    (C, H, W, D) colors, D = 3 with `sh_degree`, (C, H, W, 1) alpha, and a dict.
"""


class _Late(torch.autograd.Function):
    """Weighted colors whose backward pass has the transmittance behind each hit instead of the one in front of it."""

    @staticmethod
    def forward(ctx, alpha, before, rgb):
        ctx.save_for_backward(alpha, before, rgb)
        return (alpha * before) @ rgb

    @staticmethod
    def backward(ctx, gradient):
        alpha, before, rgb = ctx.saved_tensors
        late = before * (1 - alpha)
        each = gradient @ rgb.T
        return each * late, each * alpha, (alpha * late).T @ gradient


class _Unprojected(torch.autograd.Function):
    """A vector's direction, whose backward pass divides by the length and does not project."""

    @staticmethod
    def forward(ctx, v):
        length = v.norm(dim=-1, keepdim=True)
        ctx.save_for_backward(length)
        return v / length

    @staticmethod
    def backward(ctx, gradient):
        return gradient / ctx.saved_tensors[0]


_SHAPE = ("quats", "log_scales")
_GEOMETRY = ("means", *_SHAPE)

# name: kind, groups, words, what, the replaced field. The first ten are kernels that are wrong, the others choose
# another convention.
_TABLE = {
    "rotation_gradient_transposed": (
        "gradient",
        ("quats",),
        ("quats",),
        "the backward pass adds up the transposed gradient of the rotation matrix",
        {"rotation": lambda r: _Backward.apply(r, lambda g: g.transpose(-1, -2))},
    ),
    "half_missing": (
        "gradient",
        (*_GEOMETRY, "viewmats"),
        ("means",),
        "the exponent's gradient lacks the half of exp(-x / 2)",
        {"square": lambda x: _Backward.apply(x, lambda g: 2 * g)},
    ),
    "clamp_passes_gradient": (
        "gradient",
        (*_GEOMETRY, "logit_opacities", "viewmats"),
        ("clamp",),
        "a clamped alpha passes its gradient through",
        {"clamp": lambda alpha, alpha_max: _Instead.apply(alpha.clamp(max=alpha_max), alpha)},
    ),
    "shutter_end_detached": (
        "shutter",
        ("viewmats_rs",),
        ("viewmats",),
        "the pose at the end of the rolling shutter gets no gradient",
        {"end": torch.Tensor.detach},
    ),
    "direction_not_projected": (
        "gradient",
        (*_SHAPE, "viewmats"),
        ("quats",),
        "the gradient of the normalized direction is divided by the length and not projected",
        {"local_direction": _Unprojected.apply},
    ),
    "scale_chain": (
        "gradient",
        ("log_scales",),
        ("log_scales",),
        "returns the derivative by log s where the derivative by s is due",
        {"scale": _without_chain},
    ),
    "tangential_sign": (
        "lens",
        (),
        ("distortion",),
        "the tangential terms of the lens have the wrong sign",
        {"tangential": torch.neg},
    ),
    "origin_detached": (
        "gradient",
        ("viewmats",),
        ("viewmats",),
        "the gradient of the rays' origins is dropped",
        {"origin": torch.Tensor.detach},
    ),
    "transmittance_late": (
        "gradient",
        (*_GEOMETRY, "logit_opacities", "sh", "viewmats"),
        ("sh",),
        "the backward pass has the transmittance behind each hit, one too far, instead of the one in front of it",
        {"gathered": _Late.apply},
    ),
    "quaternion_projection": (
        "gradient",
        ("quats",),
        ("quats",),
        "the backward pass leaves out the normalization of the quaternion",
        {"unit": lambda q: _Instead.apply(normalize(q, dim=-1), q)},
    ),
    "plain_directions": (
        "convention",
        (),
        ("direction",),
        "directions are not normalized in the Gaussian's frame: exp(-(d x o)^2 / 2) without a division by d^2",
        {"local_direction": _same},
    ),
    "peaks_behind": (
        "convention",
        (),
        ("peaks",),
        "peaks behind the ray's origin count",
        {"behind": True},
    ),
    "sort_by_distance": (
        "convention",
        (),
        ("depth",),
        "Gaussians are sorted by distance instead of z",
        {"key": lambda view: view.norm(dim=1)},
    ),
    "alpha_clamp": (
        "convention",
        (),
        ("alpha_max",),
        "alpha is clamped at 0.95",
        {"alpha_max": 0.95},
    ),
    "narrow_cutoff": (
        "convention",
        (),
        ("extent",),
        "Gaussians are cut off at 2.5 standard deviations",
        {"density_min": math.exp(-(2.5**2) / 2)},
    ),
    "eye_between_poses": (
        "shutter",
        (),
        ("direction",),
        "colors are seen from between the centers of both poses of a shutter, as in gsplat, not from its middle pose",
        {"between": True},
    ),
    "stop_behind": (
        "convention",
        (),
        ("stop",),
        "the hit that ends a ray is composited",
        {"keeps_last": True},
    ),
    "lens_ignored": (
        "lens",
        (),
        ("distortion",),
        "the coefficients of the lens are ignored",
        {"radial": torch.zeros_like, "tangential": torch.zeros_like},
    ),
}

DEFECTS = {
    name: Defect(kind, groups, words, what, name, fields)
    for name, (kind, groups, words, what, fields) in _TABLE.items()
}


def broken(name: str, right: RayModel = CORRECT) -> Callable:
    """The rasterizer with that defect, one of `DEFECTS`, beside a right one of other constants."""
    return rasterizer(dataclasses.replace(right, **DEFECTS[name].fields))


def end_of(w2c):
    """A pose (4, 4) at the end of a shutter: a little turned and moved."""
    turn = torch.eye(4).to(w2c)
    turn[:3, :3] = turned(torch.tensor([0.04, -0.06, 0.05]).to(w2c))
    turn[:3, 3] = torch.tensor([0.1, -0.05, 0.08]).to(w2c)
    return turn @ w2c


def ray_scene(seed=0, n=40, width=32, height=24) -> dict:
    """`torch_rasterizer.random_scene` with what shows on rays only: long Gaussians beside the eye, rays that end.

    Four more Gaussians are long, faint and nearly in the plane of the camera, so that peaks lie behind the eye on some
    rays, and three are opaque, one behind the other.
    """
    scene = random_scene(seed, n=n, width=width, height=height, degree=2)
    make = torch.Generator().manual_seed(1000 + seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=make, dtype=torch.float64)

    angle = 2 * math.pi * (torch.arange(4) / 4 + 0.1)
    beside = torch.stack([0.7 * angle.cos(), 0.7 * angle.sin(), uniform(0.05, 0.2, 4)], 1)
    # Their long axis leans from the mean towards the view's axis behind the eye.
    lean = normalize(torch.cat([-beside[:, :2], -uniform(0.5, 0.9, 4, 1)], 1), dim=1)
    turn = _towards(lean)
    center = uniform(-0.3, 0.3, 2)
    stacked = torch.stack(
        [torch.cat([depth * center, depth[None]]) for depth in torch.tensor([2.0, 2.3, 2.6]).double()]
    )
    w2c = scene["viewmat"]
    quats = torch.cat([_product(_conjugate(_quaternion(w2c[:3, :3])), turn), torch.ones(3, 4)])
    more = {
        "means": (torch.cat([beside, stacked]) - w2c[:3, 3]) @ w2c[:3, :3],
        "quats": quats,
        "log_scales": torch.tensor([[-1.6, -1.6, 0.2]] * 4 + [[-0.7, -0.6, -0.8]] * 3).double(),
        "logit_opacities": torch.tensor([-1.0] * 4 + [9.0] * 3).double(),
        "sh": 0.4 * torch.randn(7, scene["sh"].shape[1], 3, generator=make, dtype=torch.float64),
    }
    rounded = {name: x.float().to(scene[name]) for name, x in more.items()}
    return scene | {name: torch.cat([scene[name], x]) for name, x in rounded.items()}


def _towards(axis):
    """(P, 4) unit quaternions that turn the z axis to unit vectors (P, 3)."""
    x, y, z = axis.unbind(1)
    return normalize(torch.stack([1 + z, -y, x, torch.zeros_like(x)], 1), dim=1)


def _quaternion(rotation):
    """(4,) unit quaternion of a rotation by less than a third of a turn."""
    w = (1 + rotation.diagonal().sum()).sqrt() / 2
    part = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return torch.cat([w[None], part / (4 * w)])


def _conjugate(q):
    return q * torch.tensor([1.0, -1, -1, -1]).to(q)


def _product(a, b):
    """Quaternion a (4,) times quaternions b (P, 4)."""
    u, v = a[1:].expand(len(b), 3), b[:, 1:]
    real = a[0] * b[:, :1] - (u * v).sum(1, keepdim=True)
    return torch.cat([real, a[0] * v + b[:, :1] * u + torch.linalg.cross(u, v)], 1)


def lens_detached(model: RayModel) -> Callable:
    """A rasterizer along rays that is right without a lens; with one, the geometry has no gradient."""

    def rasterize(means, quats, scales, radial_coeffs=None, tangential_coeffs=None, **arguments):
        options = {"radial_coeffs": radial_coeffs, "tangential_coeffs": tangential_coeffs}
        inputs = (means, quats, scales)
        if radial_coeffs is not None:
            inputs = tuple(x.detach() for x in inputs)
        return rasterizer(model)(*inputs, **options, **arguments)

    return rasterize
