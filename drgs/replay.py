"""A view rendered once, to be replayed for what every hit says about its Gaussian (fisher.py is the public side)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from drgs.scene import Scene, quaternion_product, to_drjit

import drjit as dr  # isort: skip  (after the scene, which chooses libLLVM)

from drgs import projection  # noqa: E402
from drgs.composite import Composite  # noqa: E402
from drgs.jacobian import GEOMETRY, Blocks, Diagonal, Rows, Variance, extras  # noqa: E402

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["GEOMETRY", "Information", "Replay", "by_probes"]

Information = dict[str, torch.Tensor]
_ENTRIES = {"means": (0, 1, 2), "rotations": (3, 4, 5), "log_scales": (6, 7, 8), "logit_opacities": (9,)}


class Replay:
    """A view rendered once, to be replayed for information."""

    def __init__(self, gaussians: Gaussians, camera: Camera, settings: RenderSettings, geometry: bool = True):
        if geometry and settings.sh_direction == "ray":
            raise NotImplementedError(
                "fisher: sh_direction must be 'gaussian' here, got 'ray'; use method 'columns' or 'probes'"
            )
        self.scene = scene = Scene(gaussians.detach().replace(features=None), camera, settings, frozenset())
        self.t, self.settings, self.count = scene.t, settings, len(gaussians)
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


def by_probes(gaussians, camera, settings, shapes: dict, weights, probes: int, seed: int) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v; features, whose information is sum w^2, are exact."""
    if probes < 1:
        raise ValueError(f"fisher.diagonal: probes must be >= 1, got {probes}")
    total = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items() if name != "features"}
    scene = Scene(gaussians.detach().replace(features=None), camera, settings, frozenset())
    t, generator = scene.t, torch.Generator().manual_seed(seed)
    inputs = {name: to_drjit(t, x) for name, x in scene.inputs.items()}
    names = {"means": "means", "rotations": "quats", "log_scales": "log_scales"}
    wanted = {names.get(name, name) for name in total}
    dr.enable_grad([inputs[name] for name in wanted])
    view, arguments = scene.prepare(inputs)
    operation = Composite()
    with dr.suspend_grad():
        operation.eval(view, *dr.detach(list(arguments[1:5])), True)
    attached = {"record": arguments[1], "sh": arguments[2]}
    root = torch.tensor(weights).sqrt()
    for _ in range(probes if total else 0):
        sign = torch.randint(0, 2, (view.pixels, 3), generator=generator).float() * 2 - 1
        cotangent = {"rgb": (sign * root).reshape(-1), "alpha": torch.zeros(view.pixels)}
        g = {name: to_drjit(t, x.to(scene.home)).array for name, x in cotangent.items()}
        with dr.suspend_grad():
            grads = operation.adjoint(g)
        found = [(attached[name], grads[name]) for name in attached if attached[name] is not None]
        for x, slope in found:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in found])
        # The graph is used again by the next probe.
        dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
        for name in total:
            slope = dr.grad(inputs[names.get(name, name)]).torch().double().cpu()
            if name == "rotations":
                slope = _turned(scene.inputs["quats"].double().cpu(), slope)
            total[name] += slope.square()
        for name in wanted:
            dr.set_grad(inputs[name], 0)
    result = {name: x / probes for name, x in total.items()}
    if "features" in shapes:
        result["features"] = Replay(gaussians, camera, settings, geometry=False).sums((GEOMETRY,), weights)[:, GEOMETRY]
    return result


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
