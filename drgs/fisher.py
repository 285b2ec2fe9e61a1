"""Fisher information of a view about the Gaussians that it shows.

Model: an image is y = S(parameters) with unit Gaussian noise in every channel of every pixel, so the information is
J^T J of the Jacobian J of S (Gauss-Newton; no photograph is needed). Parameters are the raw ones, in groups:

    means (N, 3)             world axes
    rotations (N, 3)         world-frame left perturbation R <- exp([w]x) R, radians
    log_scales (N, 3)
    logit_opacities (N,)
    sh (N, K, 3)             the direction that colors are evaluated at moves with the mean
    features (N,)            every channel of a feature has the same information, sum_p w_p^2

Sources: Jiang et al. 2024 (FisherRF) for the criterion, with what its code computes instead under method "fisherrf";
Wilson et al. 2025 (POp-GS) for blocks. `exact` costs one more traversal than rendering (jacobian.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import Scene, quaternion_product, render_jvp, to_drjit
from drgs.settings import RenderSettings

import drjit as dr  # isort: skip  (after the integrator, which chooses libLLVM)

from drgs import projection  # noqa: E402
from drgs.composite import Composite  # noqa: E402
from drgs.jacobian import GEOMETRY, Blocks, Diagonal, Rows, Variance, extras  # noqa: E402

__all__ = [
    "BLOCK",
    "GROUPS",
    "Information",
    "blocks",
    "coverage",
    "diagonal",
    "jacobian_columns",
    "pose_information",
    "variance_map",
]

GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh", "features")
METHODS = ("exact", "columns", "probes", "fisherrf")
BLOCK = 13  # means 3, rotations 3, log-scales 3, logit-opacity 1, base color 3
_ENTRIES = {"means": (0, 1, 2), "rotations": (3, 4, 5), "log_scales": (6, 7, 8), "logit_opacities": (9,)}
_BATCH = 16  # tangents of one traversal

Information = dict[str, torch.Tensor]


def diagonal(
    gaussians: Gaussians,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    method: str = "exact",
    *,
    groups: Sequence[str] | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    probes: int = 16,
    seed: int = 0,
) -> Information:
    """The diagonal of J^T J, summed over views.

    Args:
        gaussians: N Gaussians, world frame.
        cameras: One or several; nothing of a view is kept but its sum.
        settings: Default `RenderSettings.preset("exact")`.
        method: `exact`: squares of every pixel's and channel's derivative, in one traversal after the primal one.
            `columns`: the same from forward-mode columns, one for every parameter: for checks on small scenes.
            `probes`: mean of (J^T v)^2 over Rademacher v, unbiased, relative error about sqrt(2 / probes).
            `fisherrf`: what FisherRF's rasterizer computes: channels are summed before squaring, and the derivative of
            an activation is multiplied once instead of squared; no rotations.
        groups: Those wanted; default all that the Gaussians have.
        channel_weights: Inverse noise variances of R, G and B (`exact`, `columns`, `probes`).
        probes, seed: Of method `probes`.
    Returns:
        Group -> float64 tensor on the CPU.
    Raises:
        ValueError: If a method, group or weight is unknown or wrong, or a parameter is not finite.
        NotImplementedError: For SH along each ray, by `exact` and `fisherrf` (use `columns` or `probes`).
    """
    settings = settings or RenderSettings.preset("exact")
    if method not in METHODS:
        raise ValueError(f"fisher.diagonal: method must be one of {', '.join(METHODS)}, got {method!r}")
    cameras, wanted = _cameras(cameras), _groups(gaussians, groups)
    weights = [float(x) for x in channel_weights]
    if len(weights) != 3 or not all(np.isfinite(weights)) or min(weights) < 0:
        raise ValueError(f"fisher.diagonal: channel_weights must be 3 finite numbers >= 0, got {channel_weights}")
    if method == "fisherrf":
        wanted = tuple(name for name in wanted if name != "rotations")
    total = {name: torch.zeros(_shape(gaussians, name), dtype=torch.float64) for name in wanted}
    for number, camera in enumerate(cameras):
        if not len(gaussians):
            break
        if method == "columns":
            part = _by_columns(gaussians, camera, settings, wanted, weights)
        elif method == "probes":
            part = _by_probes(gaussians, camera, settings, wanted, weights, probes, seed + number)
        else:
            part = _Pass(gaussians, camera, settings).diagonal(wanted, weights, method == "fisherrf")
        for name in wanted:
            total[name] += part[name]
    return total


def blocks(
    gaussians: Gaussians,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
) -> torch.Tensor:
    """One dense block of J^T J for every Gaussian, summed over views.

    Args:
        gaussians, cameras, settings, channel_weights: As for `diagonal`.
    Returns:
        (N, 13, 13) float64: means 3, rotations 3, log-scales 3, logit-opacity 1, base color sh[0] 3.
    """
    settings = settings or RenderSettings.preset("exact")
    total = torch.zeros(len(gaussians), BLOCK, BLOCK, dtype=torch.float64)
    for camera in _cameras(cameras):
        if len(gaussians):
            total += _Pass(gaussians, camera, settings).blocks([float(x) for x in channel_weights])
    return total


def coverage(
    gaussians: Gaussians, cameras: Camera | Sequence[Camera], settings: RenderSettings | None = None
) -> torch.Tensor:
    """(N,) float64 sum over views and pixels of w^2: the information about a color without direction."""
    settings = settings or RenderSettings.preset("exact")
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    for camera in _cameras(cameras):
        if len(gaussians):
            total += _Pass(gaussians, camera, settings, geometry=False).sums((GEOMETRY,), [1.0] * 3)[:, GEOMETRY]
    return total


def variance_map(
    gaussians: Gaussians,
    camera: Camera,
    weights: Information,
    settings: RenderSettings | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
) -> torch.Tensor:
    """(H, W) float32: sum over channels and parameters k of J_pk^2 weights_k.

    With weights 1 / (H_k + lambda) this is the predictive variance of a pixel, high where it is uncertain.

    Args:
        gaussians, camera, settings, channel_weights: As for `diagonal`.
        weights: Group -> tensor shaped like its information; groups that are missing weigh 0.
    """
    settings = settings or RenderSettings.preset("exact")
    for name, x in weights.items():
        if name not in GROUPS:
            raise ValueError(f"fisher.variance_map: weights must be of {', '.join(GROUPS)}, got {name!r}")
        if tuple(x.shape) != _shape(gaussians, name):
            raise ValueError(
                f"fisher.variance_map: weights of {name} must have shape {_shape(gaussians, name)}, "
                f"got {tuple(x.shape)}"
            )
    if not len(gaussians):
        return torch.zeros(camera.height, camera.width)
    return _Pass(gaussians, camera, settings).variance(weights, [float(x) for x in channel_weights])


def jacobian_columns(
    gaussians: Gaussians, camera: Camera, index: dict, settings: RenderSettings | None = None, batch: int = _BATCH
) -> torch.Tensor:
    """Columns of the Jacobian by forward mode: how the image changes with single parameters.

    Args:
        gaussians, camera, settings: As for `render`.
        index: Group -> integers. (M, 1 + axes) rows (gaussian, component...), (M,) for logit_opacities; `features` rows
            are (gaussian, channel); `camera` (M,) of 0..5, the world-frame twist, rotation first.
        batch: Columns carried through one traversal.
    Returns:
        (columns, H, W, 3), float32, in the order of `index`; with features (columns, H, W, 3 + D).
    Raises:
        ValueError: If a group or an index is unknown.
    """
    chosen = []
    for name, rows in index.items():
        shape = (6,) if name == "camera" else _column_shape(gaussians, name)
        rows = np.asarray(rows, np.int64)
        rows = rows[:, None] if rows.ndim == 1 else rows
        if rows.ndim != 2 or rows.shape[1] != len(shape) or (rows < 0).any() or (rows >= shape).any():
            raise ValueError(
                f"fisher.jacobian_columns: index of {name} must be rows of {len(shape)} integers below {shape}, got "
                f"shape {rows.shape}" + (f" up to {rows.max(0).tolist()}" if rows.size else "")
            )
        chosen += [(name, tuple(row)) for row in rows.tolist()]
    images = []
    for start in range(0, len(chosen), batch):
        part = chosen[start : start + batch]
        tangents = {}
        for k, (name, at) in enumerate(part):
            shape = (6,) if name == "camera" else _column_shape(gaussians, name)
            tangents.setdefault(name, torch.zeros(len(part), *shape, dtype=torch.float64))[(k, *at)] = 1
        out = render_jvp(gaussians, camera, tangents, settings, outputs=())
        images.append(out.rgb if out.features is None else torch.cat([out.rgb, out.features], -1))
    if images:
        return torch.cat(images)
    width = 3 + (0 if gaussians.features is None else gaussians.features.shape[1])
    return torch.zeros(0, camera.height, camera.width, width)


def pose_information(gaussians: Gaussians, camera: Camera, settings: RenderSettings | None = None) -> torch.Tensor:
    """(6, 6) float64: what a view says about its own pose.

    Of the world-frame twist c2w <- exp(xi) c2w, rotation (radians) first, then translation (world units).
    """
    columns = jacobian_columns(gaussians, camera, {"camera": range(6)}, settings)[..., :3]
    flat = columns.reshape(6, -1).double()
    return flat @ flat.T


def _cameras(cameras) -> list[Camera]:
    cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if not cameras:
        raise ValueError("fisher: there must be at least one camera, got none")
    return cameras


def _groups(gaussians: Gaussians, groups) -> tuple[str, ...]:
    there = [name for name in GROUPS if name != "features" or gaussians.features is not None]
    for name in groups or ():
        if name not in there:
            raise ValueError(f"fisher.diagonal: groups must be among {', '.join(there)}, got {name!r}")
    return tuple(name for name in there if groups is None or name in groups)


def _shape(gaussians: Gaussians, group: str) -> tuple[int, ...]:
    """Of a group's information."""
    n = len(gaussians)
    if group == "sh":
        return tuple(gaussians.sh.shape)
    return (n,) if group in ("logit_opacities", "features") else (n, 3)


def _column_shape(gaussians: Gaussians, group: str) -> tuple[int, ...]:
    """Of a group's tangent."""
    if group not in GROUPS or (group == "features" and gaussians.features is None):
        raise ValueError(f"fisher: a parameter group must be one of {', '.join(GROUPS)} or camera, got {group!r}")
    return tuple(gaussians.features.shape) if group == "features" else _shape(gaussians, group)


class _Pass:
    """A view rendered once, to be replayed for information."""

    def __init__(self, gaussians: Gaussians, camera: Camera, settings: RenderSettings, geometry: bool = True):
        if settings.sh_direction == "ray":
            raise NotImplementedError(
                "fisher: sh_direction must be 'gaussian' here, got 'ray'; use method 'columns' or 'probes'"
            )
        self.scene = scene = Scene(gaussians.detach().replace(features=None), camera, settings, frozenset())
        self.t, self.settings, self.count = scene.t, settings, len(gaussians)
        self.featured = gaussians.features is not None
        t = self.t
        self.inputs = {name: to_drjit(t, x) for name, x in scene.inputs.items()}
        view, arguments = scene.prepare(self.inputs)
        self.view, self.operation = view, Composite()
        with dr.suspend_grad():
            self.operation.eval(*arguments[:-1], True)
        p = {name: x.array for name, x in self.inputs.items()}
        self.color, self.extras = False, None
        if not geometry:
            return
        self.lit, self.basis, moved_color = self._colors(p)
        self.color = moved_color is not None
        self.extras = extras(t, settings, p, view.projected, view.world, self._moved_records(), moved_color)
        dr.eval(self.extras, self.lit, self.basis)

    def _colors(self, p):
        """Per channel where the color is not clamped, the SH basis, and dc/dmu (None for degree 0)."""
        t, K = self.t, self.scene.coefficients
        i = dr.arange(t.UInt32, self.count)
        v = [[dr.gather(t.Float64, p["w2c"], t.UInt32(4 * r + c)) for c in range(4)] for r in range(3)]
        mean = [t.Float64(dr.gather(type(p["means"]), p["means"], 3 * i + k)) for k in range(3)]
        # c - o in world axes, through the camera's, as the colors are computed.
        local = [v[r][0] * mean[0] + v[r][1] * mean[1] + v[r][2] * mean[2] + v[r][3] for r in range(3)]
        away = [v[0][k] * local[0] + v[1][k] * local[1] + v[2][k] * local[2] for k in range(3)]
        squared = away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
        inverse = t.Float(dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0))
        d = [t.Float(x * t.Float64(inverse)) for x in away]
        basis = projection.sh_basis(d, K)
        coefficient = lambda k, c: dr.gather(t.Float, p["sh"], 3 * K * i + (3 * k + c))  # noqa: E731
        rgb = projection.sh_color(basis, coefficient)
        lit = [dr.select(x > 0, t.Float(1), 0) for x in rgb]
        zero = dr.zeros(t.Float, self.count)
        basis_width = [x + zero for x in basis]
        if K == 1:
            return lit, basis_width, None
        turned = []  # per axis, d basis / d direction
        for axis in range(3):
            along = [t.Float(x) + 0 for x in d]
            dr.enable_grad(along[axis])
            dr.set_grad(along[axis], 1)
            values = projection.sh_basis(along, K)
            dr.forward_to(values[1:], flags=dr.ADFlag.ClearEdges)
            turned.append([t.Float(0)] + [dr.grad(x) for x in values[1:]])
        moved = []
        for c in range(3):
            slope = [sum(coefficient(k, c) * turned[axis][k] for k in range(1, K)) for axis in range(3)]
            radial = slope[0] * d[0] + slope[1] * d[1] + slope[2] * d[2]
            moved.append([lit[c] * inverse * (slope[j] - radial * d[j]) for j in range(3)])
        return lit, basis_width, moved

    def _moved_records(self):
        """`ewa` only: tangents of the records along means, rotations and log-scales."""
        if self.settings.response != "ewa":
            return None
        t, scene, inputs, moved = self.t, self.scene, self.inputs, []
        axes = [("means", _unit(k)) for k in range(3)] + [("quats", _unit(k)) for k in range(3)]
        for name, axis in [*axes, *(("log_scales", _unit(k)) for k in range(3))]:
            x = scene.inputs[name]
            tangent = torch.tensor(axis, dtype=torch.float64, device=x.device).expand(self.count, 3)
            if name == "quats":
                tangent = 0.5 * quaternion_product(tangent, x.double())
            dr.enable_grad(inputs[name])
            dr.set_grad(inputs[name], to_drjit(t, tangent.to(x.dtype)))
            _, arguments = scene.prepare(inputs)
            record = arguments[1]
            dr.forward_to(record, flags=dr.ADFlag.ClearEdges)
            moved.append([dr.detach(dr.grad(r)) for r in record])
            dr.disable_grad(inputs[name])
        return moved

    def _run(self, sink_of):
        """Replay with `sink_of(reduce mode)`; yields (part, final states, sink)."""
        for part, finals in self.operation.finals[0]:
            mode = dr.ReduceMode.Direct if part.ordered else dr.ReduceMode.Local
            sink = sink_of(mode)
            with dr.suspend_grad():
                rows = Rows(self.operation.model, self.operation.passes[0], self.extras, sink, finals, self.color)
                yield part, part.run(rows), sink

    def sums(self, entries, weights, summed: bool = False) -> torch.Tensor:
        """(N, 11) float64: squares of the geometry, and sum w^2."""
        total = torch.zeros(self.count, Diagonal.WIDTH, dtype=torch.float64)
        for _, states, sink in self._run(lambda mode: Diagonal(self.t, self.count, weights, entries, mode, summed)):
            dr.eval(states, sink.buffer)
            total += _torch(sink.buffer).reshape(total.shape)
        return total

    def diagonal(self, wanted, weights, fisherrf: bool) -> Information:
        """`diagonal` of one view."""
        entries = [k for name in wanted for k in _ENTRIES.get(name, ())]
        entries += [GEOMETRY] if {"sh", "features"} & set(wanted) else []
        sums = self.sums(entries, weights, fisherrf)
        result = {name: sums[:, k] for name, k in _ENTRIES.items() if name in wanted}
        if "logit_opacities" in wanted:
            result["logit_opacities"] = sums[:, 9]
        if fisherrf:
            self._activate_once(result)
        if "sh" in wanted:
            scale = torch.tensor([1.0] * 3 if fisherrf else weights, dtype=torch.float64)
            squared = torch.stack([_torch(x) for x in self.basis], 1).square()
            result["sh"] = sums[:, GEOMETRY, None, None] * squared[:, :, None] * (self._lit() * scale)[:, None, :]
        if "features" in wanted:
            result["features"] = sums[:, GEOMETRY]
        return result

    def _activate_once(self, result: Information) -> None:
        """FisherRF squares the derivative by s and alpha, then multiplies by ds/dlog s and dalpha/dlogit once."""
        g = self.scene.inputs
        if "log_scales" in result:
            result["log_scales"] = result["log_scales"] / g["log_scales"].cpu().double().exp()
        if "logit_opacities" in result:
            opacity = g["logit_opacities"].cpu().double().sigmoid()
            slope = opacity * (1 - opacity)
            result["logit_opacities"] = result["logit_opacities"] / slope.clamp_min(1e-300)

    def blocks(self, weights) -> torch.Tensor:
        """`blocks` of one view."""
        t, size = self.t, Blocks.SIZE
        lit = [x * float(projection._SH[0]) for x in self.lit]
        dr.eval(lit)
        total = torch.zeros(self.count, Blocks.WIDTH, dtype=torch.float64)
        for _, states, sink in self._run(lambda mode: Blocks(t, self.count, weights, mode, lit)):
            dr.eval(states, sink.buffer)
            total += _torch(sink.buffer).reshape(total.shape)
        row, column = torch.tril_indices(size, size)
        full = torch.zeros(self.count, size, size, dtype=torch.float64)
        full[:, row, column] = total
        full[:, column, row] = total
        return full

    def variance(self, information: Information, weights) -> torch.Tensor:
        """`variance_map`."""
        t, camera = self.t, self.scene.camera
        table = torch.zeros(self.count, 16, dtype=torch.float64)
        for name, entries in _ENTRIES.items():
            if name in information:
                table[:, list(entries)] = information[name].double().reshape(self.count, -1).cpu()
        if "sh" in information:
            squared = torch.stack([_torch(x) for x in self.basis], 1).square()
            along = (squared[:, :, None] * information["sh"].double().cpu()).sum(1)
            table[:, GEOMETRY : GEOMETRY + 3] = along * self._lit()
        if not torch.isfinite(table).all():
            raise ValueError("fisher.variance_map: weights must be finite, got NaN or Inf; raise lambda above 0")
        buffer = to_drjit(t, table.float().reshape(-1).to(self.scene.home)).array
        image = dr.zeros(t.Float, camera.width * camera.height)
        for part, states, _ in self._run(lambda mode: Variance(buffer, weights)):
            for state, at, inside in zip(states, part.flat, part.inside, strict=True):
                dr.scatter(image, state["variance"], at, inside)
        dr.eval(image)
        return image.torch().cpu().reshape(camera.height, camera.width)

    def _lit(self) -> torch.Tensor:
        return torch.stack([_torch(x) for x in self.lit], 1)


def _by_columns(gaussians, camera, settings, wanted, weights) -> Information:
    """From every column of the Jacobian."""
    result = {}
    scale = torch.tensor(weights, dtype=torch.float64)
    for name in wanted:
        shape = _column_shape(gaussians, name)
        rows = np.stack(np.unravel_index(np.arange(int(np.prod(shape))), shape), 1)
        squares = []
        for start in range(0, len(rows), _BATCH):
            columns = jacobian_columns(gaussians, camera, {name: rows[start : start + _BATCH]}, settings).double()
            if name == "features":
                squares.append(columns[..., 3:].square().sum((1, 2, 3)))
            else:
                squares.append((columns[..., :3].square() * scale).sum((1, 2, 3)))
        full = torch.cat(squares).reshape(shape).cpu()
        result[name] = full.mean(1) if name == "features" else full
    return result


def _by_probes(gaussians, camera, settings, wanted, weights, probes: int, seed: int) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v."""
    if probes < 1:
        raise ValueError(f"fisher.diagonal: probes must be >= 1, got {probes}")
    scene = Scene(gaussians.detach(), camera, settings, frozenset())
    t, generator = scene.t, torch.Generator().manual_seed(seed)
    inputs = {name: to_drjit(t, x) for name, x in scene.inputs.items()}
    names = {"means": "means", "rotations": "quats", "log_scales": "log_scales"}
    wanted_inputs = {names.get(name, name) for name in wanted}
    dr.enable_grad([inputs[name] for name in wanted_inputs])
    view, arguments = scene.prepare(inputs)
    operation = Composite()
    with dr.suspend_grad():
        operation.eval(view, *dr.detach(list(arguments[1:5])), True)
    attached = {"record": arguments[1], "sh": arguments[2], "features": arguments[3]}
    total = {name: torch.zeros(_shape(gaussians, name), dtype=torch.float64) for name in wanted}
    pixels, root = view.pixels, torch.tensor(weights).sqrt()
    sign = lambda *shape: torch.randint(0, 2, shape, generator=generator).float() * 2 - 1  # noqa: E731
    for _ in range(probes):
        cotangent = {"rgb": (sign(pixels, 3) * root).reshape(-1), "alpha": torch.zeros(pixels)}
        if view.width:
            cotangent["features"] = sign(pixels * view.width)
        g = {name: to_drjit(t, x.to(scene.home)).array for name, x in cotangent.items()}
        with dr.suspend_grad():
            grads = operation.adjoint(g)
        found = [(attached[name], grads[name]) for name in attached if attached[name] is not None]
        for x, slope in found:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in found])
        # The graph is used again by the next probe.
        dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
        for name in wanted:
            x = inputs[names.get(name, name)]
            slope = dr.grad(x).torch().double().cpu()
            if name == "rotations":
                slope = _turned(scene.inputs["quats"].double().cpu(), slope)
            total[name] += slope.square().mean(1) if name == "features" else slope.square()
        for name in wanted_inputs:
            dr.set_grad(inputs[name], 0)
    return {name: x / probes for name, x in total.items()}


def _turned(quats: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
    """(N, 3) derivative by a world-frame rotation, from the one by the quaternion."""
    axes = torch.eye(3, dtype=torch.float64)
    return torch.stack(
        [(slope * 0.5 * quaternion_product(axis.expand(len(quats), 3), quats)).sum(1) for axis in axes], 1
    )


def _unit(k: int) -> list[float]:
    return [float(j == k) for j in range(3)]


def _torch(x) -> torch.Tensor:
    return x.torch().double().cpu()
