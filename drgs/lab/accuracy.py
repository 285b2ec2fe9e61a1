"""The renderer against the float64 oracle: images, derivatives both ways, Fisher information; random scenes for it.

`J` is the Jacobian of everything a view shows by the raw parameters and the pose. The oracle (`reference.render`) gets
the float32-rounded parameters; its pixels that hang on a near tie are left out of every comparison.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import Output, render, render_jvp
from drgs.lab.parameters import twist_basis
from drgs.settings import RenderSettings

FIELDS = ("rgb", "alpha", "depth", "features")
_LEAST_ALPHA = 1e-3  # of rays whose depth is compared: 100 times what an image may be off by
_JACOBIAN_ENTRIES = 1 << 22  # entries of an intermediate of the dense Jacobian that are held at once: 32 MB


# -------------------------------------------------- random scenes


def rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation by a rotation vector."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_camera(
    rng: np.random.Generator,
    size: tuple[int, int] = (24, 22),
    distance: float = 4.0,
    focal: float | None = None,
    turn: float = 0.2,
    center: tuple[float, float] | None = None,
    skew: float = 0.0,
) -> Camera:
    """A camera that looks at the origin from `distance` away, off its axis, with an off-center principal point.

    The focal length keeps 2 world units around the origin in the image unless it is given; `skew` is a multiple of it.
    """
    width, height = size
    focal = focal or 0.5 * max(width, height, 6) * distance / 2
    w2c = np.eye(4)
    w2c[:3, :3] = rotation(turn * rng.normal(size=3))
    w2c[:3, 3] = [0.1, -0.1, distance]
    cx, cy = center or (width * rng.uniform(0.3, 0.7), height * rng.uniform(0.3, 0.7))
    K = np.array([[focal, skew * focal, cx], [0, 1.04 * focal, cy], [0, 0, 1]])
    pose = torch.tensor(w2c, dtype=torch.float64).requires_grad_()
    return Camera(K=K, w2c=pose, width=width, height=height)


def random_gaussians(
    rng: np.random.Generator,
    n: int = 20,
    K: int = 4,
    D: int = 0,
    scale: float = 0.15,
    spread: float = 1.0,
    anisotropy: float = 0.5,
    opacity: float = 1.5,
) -> Gaussians:
    """N Gaussians in a cube of half size `spread` around the origin, float32, all leaves.

    Args:
        anisotropy: Standard deviation of each log-scale around log(scale).
        opacity: Standard deviation of the logits.
    """
    values = {
        "means": rng.uniform(-spread, spread, (n, 3)),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.3, 3, (n, 1)),
        "log_scales": np.log(scale) + anisotropy * rng.normal(size=(n, 3)),
        "logit_opacities": opacity * rng.normal(size=n),
        "sh": rng.normal(size=(n, K, 3)) * 0.4,
    }
    if D:
        values["features"] = rng.normal(size=(n, D))
    return Gaussians(**{k: torch.tensor(v, dtype=torch.float32).requires_grad_() for k, v in values.items()})


# -------------------------------------------------- derivatives both ways


def pose_gradient(w2c: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """(6,) the part of a gradient of w2c along the world twists c2w <- exp(xi) c2w."""
    change = -w2c.detach() @ twist_basis()  # the directions are constants: the pose's own graph has no part in them
    return (change * gradient).sum((1, 2))


def leaves(g: Gaussians, cam: Camera) -> dict[str, torch.Tensor]:
    """Everything that is differentiated, by group name."""
    return {**g.parameters(), **_poses(cam)}


def _poses(cam: Camera) -> dict[str, torch.Tensor]:
    """The poses of a camera by the names that tangents have: one, or two of a rolling shutter."""
    return {"camera": cam.w2c} | ({"camera_end": cam.w2c_end} if cam.is_rolling else {})


def inner(a: Mapping[str, torch.Tensor], b: Mapping[str, torch.Tensor]) -> float:
    """Sum over groups of <a, b>."""
    return float(sum((a[name] * b[name]).sum() for name in a))


def relative(a: torch.Tensor, b: torch.Tensor, floor: float = 1e-6) -> float:
    """|a - b| / max(|b|, floor) in the L2 norm; the floor stands for a gradient that is 0."""
    return float((a - b).norm() / b.norm().clamp_min(floor))  # b = 0 would give NaN for a = 0


class Oracle:
    """The float64 oracle on one scene: images, J^T u for random u, J v for a random v.

    Attributes:
        out: `reference.ReferenceOutput`.
        good: (H, W) pixels that do not hang on a near tie, and are not in `skip`.
        u, back: Cotangents of the images, 0 where not `good`, and the gradient they give, by group. That of the depth
            has the weights that depths are compared with (`weight_of`).
        v, push: Tangents of the groups and the tangent images they give.
    """

    def __init__(
        self,
        g: Gaussians,
        cam: Camera,
        settings: RenderSettings,
        rng: np.random.Generator,
        tolerance: float = 1e-5,
        names: Sequence[str] = FIELDS,
        skip: torch.Tensor | None = None,
    ):
        self.out = reference.render(g, cam, settings, tolerance=tolerance)
        self.good = ~self.out.ambiguous
        if skip is not None:
            self.good &= ~skip
        images = {name: x for name in names if (x := getattr(self.out, name)) is not None}
        self.u = {}
        for name, x in images.items():
            mask = self.good.reshape(*self.good.shape, *[1] * (x.ndim - self.good.ndim))
            self.u[name] = torch.tensor(rng.normal(size=tuple(x.shape))) * mask * weight_of(name, self.out)
            self.u[name].requires_grad_()
        self.v = {name: torch.tensor(rng.normal(size=tuple(x.shape))) for name, x in g.parameters().items()}
        self.v |= {name: torch.tensor(rng.normal(size=6)) for name in _poses(cam)}
        # J^T u is linear in u: differentiating <v, J^T u> by u gives J v.
        loss = sum((images[name] * u).sum() for name, u in self.u.items())
        groups = leaves(g, cam)
        back = gradient_by(loss, groups, create_graph=True)
        # Tangents are constants: with the pose's graph, the second differentiation below would go through it again.
        change = dict(self.v)
        for name, pose in _poses(cam).items():
            change[name] = -pose.detach() @ (self.v[name][:, None, None] * twist_basis()).sum(0)
        self.push = gradient_by(sum((back[name].double() * change[name]).sum() for name in back), self.u)
        # The graph has served; kept, it would hold every intermediate of the oracle for as long as this object lives.
        self.back = {n: x.detach().double() for n, x in back.items()}
        self.back |= {name: pose_gradient(pose, self.back[name]) for name, pose in _poses(cam).items()}
        self.u = {name: u.detach() for name, u in self.u.items()}  # it was a variable to get J v, and is a number now


def weight_of(name: str, out: reference.ReferenceOutput) -> torch.Tensor | float:
    """What errors of an image are multiplied by: of a depth, a mean over what a ray meets, alpha, and 0 where that is
    below `_LEAST_ALPHA`: the depth of a ray that meets tails alone is that of those which are not cut off.
    """
    alpha = out.alpha.detach()  # a weight is a number
    return torch.where(alpha < _LEAST_ALPHA, 0.0, alpha) if name == "depth" else 1.0


def gradient_by(loss: torch.Tensor, groups: Mapping[str, torch.Tensor], **options: bool) -> dict[str, torch.Tensor]:
    """Derivative of a number by each group, 0 where it does not depend on it; options of `torch.autograd.grad`."""
    if not loss.requires_grad:
        return {name: torch.zeros_like(x) for name, x in groups.items()}
    derivatives = torch.autograd.grad(loss, list(groups.values()), allow_unused=True, **options)
    return {n: torch.zeros_like(x) if y is None else y for (n, x), y in zip(groups.items(), derivatives, strict=True)}


def gradients(
    g: Gaussians, cam: Camera, out: Output | reference.ReferenceOutput, u: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """float64 gradient of sum <u, image> by group, `camera` and `camera_end` as twists."""
    # Sums over an image in float64: in float32 they lose more digits than the gradients are compared by.
    loss = sum((getattr(out, name).double() * w).sum() for name, w in u.items())
    derivatives = {name: x.double() for name, x in gradient_by(loss, leaves(g, cam)).items()}
    return derivatives | {name: pose_gradient(pose, derivatives[name]) for name, pose in _poses(cam).items()}


@dataclasses.dataclass
class Errors:
    """Renderer against oracle on one scene, outside of ambiguous pixels.

    Attributes:
        image: Output name -> largest absolute error, of depths and visibilities relative to the largest, or 1; depths
            but for the median are weighted (`weight_of`).
        gradient: Group -> relative L2 error of the adjoint.
        forward: Output name -> relative L2 error of the forward mode.
        joint: Relative L2 error of the forward mode over all outputs but depth.
        duality: |<Jv, u> - <v, J^T u>| / (|Jv| |u|).
        finite: Every output, gradient and tangent is finite, ambiguous pixels included.
        count: Largest difference of the number of hits of a pixel; 0 without an extent, where the oracle counts tails
            without an end.
        out: The renderer's `Output`.
    """

    image: dict[str, float]
    gradient: dict[str, float]
    forward: dict[str, float]
    joint: float
    duality: float
    finite: bool
    count: int
    out: Output


def compare(
    g: Gaussians, cam: Camera, settings: RenderSettings, oracle: Oracle, outputs: tuple[str, ...] | str = "all"
) -> Errors:
    """Render, differentiate both ways and compare with the oracle.

    Args:
        outputs: Outputs that are rendered besides color, alpha and features: those of `oracle.u` at least. With a depth
            or a count tiles leave fewer tails out.
    """
    out = render(g, cam, settings, outputs=outputs)
    ref = oracle.out
    good = oracle.good
    size = max([1.0, *ref.depth.detach().abs().reshape(-1).tolist()])  # a list holds numbers
    image = {}
    finite = True
    for name in (*FIELDS, "median_depth"):
        a, b = getattr(out, name), getattr(ref, name)
        if a is not None and b is not None:
            finite &= bool(torch.isfinite(a).all())
            error = (a.double() - b) * weight_of(name, ref)
            image[name] = _largest(error[good]) / (size if "depth" in name else 1.0)
    if good.all() and out.visibility is not None:
        image["visibility"] = _largest(out.visibility.double() - ref.visibility) / (1 + _largest(ref.visibility))
    ours = gradients(g, cam, out, oracle.u)
    pushed = render_jvp(g, cam, oracle.v, settings, outputs=tuple({"depth"} & set(oracle.u)))
    jv = {name: getattr(pushed, name).double() for name in oracle.u}
    finite &= all(bool(torch.isfinite(x).all()) for x in (*ours.values(), *jv.values()))
    scale = (inner(jv, jv) * inner(oracle.u, oracle.u)) ** 0.5
    weighted = lambda name, x: (x * weight_of(name, ref))[good]  # noqa: E731
    colors = [name for name in jv if name != "depth"]
    both = [torch.cat([x[name][good].reshape(-1) for name in colors] or [torch.zeros(0)]) for x in (jv, oracle.push)]
    return Errors(
        image=image,
        gradient={name: relative(x, oracle.back[name]) for name, x in ours.items()},
        forward={name: relative(*(weighted(name, y) for y in (x, oracle.push[name]))) for name, x in jv.items()},
        joint=relative(*both),
        duality=abs(inner(jv, oracle.u) - inner(oracle.v, ours)) / max(scale, 1e-12),  # both 0: an error of 0
        finite=finite,
        count=int(_largest((out.count - ref.count)[good])) if settings.extent and out.count is not None else 0,
        out=out,
    )


def _largest(x: torch.Tensor) -> float:
    return float(x.detach().abs().max()) if x.numel() else 0.0  # an error is a number


# -------------------------------------------------- the dense Jacobian


def jacobian(g: Gaussians, out: reference.ReferenceOutput, features: bool = False) -> dict[str, torch.Tensor]:
    """Group of `drgs.fisher` -> (3 P, parameters...) float64 derivative of the oracle's rgb.

    Args:
        g: The Gaussians, leaves.
        out: `reference.ReferenceOutput` with its graph.
        features: Whether `features` (P, N), the derivative of a pixel's feature by those of the Gaussians, is added.
    """
    wanted = {name: x for name, x in g.parameters().items() if name != "features"}
    J = dict(zip(wanted, _dense(out.rgb.reshape(-1), list(wanted.values())), strict=True))
    # Quaternions say where the derivative is taken; `turn` is linear in `slope` alone.
    J["rotations"] = turn(g.quats.detach().double(), J.pop("quats"))
    J = {name: J[name] for name in ("means", "rotations", "log_scales", "logit_opacities", "sh")}
    if features and g.features is not None:
        # Channels do not mix, and all have the same derivative: that of the first.
        J["features"] = _dense(out.features[..., 0].reshape(-1), [g.features])[0][..., 0]
    return J


def turn(quats: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
    """(..., N, 3) derivative by a world-frame rotation R <- exp([w]x) R of one by the quaternion (..., N, 4)."""
    w, x, y, z = quats.unbind(1)
    moves = torch.stack(  # dq/dw_k = (0, e_k) q / 2, written out
        [torch.stack([-x, w, -z, y], 1), torch.stack([-y, z, w, -x], 1), torch.stack([-z, -y, x, w], 1)], 1
    )
    return 0.5 * torch.einsum("...nq,nkq->...nk", slope, moves)


def squares(J: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The diagonal of J^T J by group."""
    return {name: x.square().sum(0) for name, x in J.items()}


def entry_error(a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest difference, relative to the largest entry of b."""
    return _largest(a - b) / max(_largest(b), 1e-12)  # where b is 0, the difference itself, times 1e12


def _dense(flat: torch.Tensor, inputs: list[torch.Tensor]) -> list[torch.Tensor]:
    """(len(flat), *shape) derivative by each input: row by row, or column by column where these are fewer."""
    zeros = [torch.zeros(len(flat), *x.shape, dtype=torch.float64) for x in inputs]
    if not flat.requires_grad or not any(x.numel() for x in inputs):
        return zeros
    step = max(1, _JACOBIAN_ENTRIES // (len(flat) * len(inputs[0])))
    if len(flat) <= sum(x.numel() for x in inputs):
        rows = _batched(flat, inputs, step)
        return [zero if row is None else row.double() for zero, row in zip(zeros, rows, strict=True)]
    # J^T u is linear in u: its derivatives by u are the columns.
    u = torch.zeros_like(flat, requires_grad=True)
    back = torch.autograd.grad(flat @ u, inputs, create_graph=True, allow_unused=True)
    columns = [None if x is None else _batched(x.reshape(-1), [u], step)[0] for x in back]
    return [zero if x is None else x.double().T.reshape(zero.shape) for zero, x in zip(zeros, columns, strict=True)]


def _batched(flat: torch.Tensor, inputs: list[torch.Tensor], step: int) -> list[torch.Tensor | None]:
    """The Jacobian of `flat` by each input, `step` rows at a time."""
    parts = []
    for start in range(0, len(flat), step):
        stop = min(start + step, len(flat))
        rows = torch.zeros(stop - start, len(flat), dtype=flat.dtype)
        rows[torch.arange(stop - start), torch.arange(start, stop)] = 1
        parts.append(torch.autograd.grad(flat, inputs, rows, True, is_grads_batched=True, allow_unused=True))
    return [None if part[0] is None else torch.cat(part) for part in zip(*parts, strict=True)]
