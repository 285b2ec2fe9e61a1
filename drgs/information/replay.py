"""A view rendered once, to be replayed for what every hit says about its Gaussian (fisher.py is the public side)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import torch

from drgs.information.groups import GROUPS, Information
from drgs.information.jacobian import GEOMETRY, Blocks, Diagonal, Rows, Variance, extras
from drgs.tracing import projection
from drgs.tracing.call import Scene, quaternion_product, to_drjit
from drgs.tracing.composite import Composite

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["Replay", "by_probes"]


class Replay:
    """A view rendered once, to be replayed for information."""

    def __init__(self, gaussians: Gaussians, camera: Camera, settings: RenderSettings, geometry: bool = True):
        self.scene = scene = Scene(gaussians.detach().replace(features=None), camera, settings, frozenset())
        self.t, self.settings, self.count = scene.t, settings, len(gaussians)
        t = self.t
        self.inputs = {name: to_drjit(t, x) for name, x in scene.inputs.items()}
        view, arguments = scene.prepare(self.inputs)
        self.view, self.operation = view, Composite()
        with dr.suspend_grad():
            self.operation.eval(*arguments[:-1], True)
        p = {name: x.array for name, x in self.inputs.items()}
        self.along_ray = settings.sh_direction == "ray"
        self.color, self.extras, self.light = False, None, None
        if not geometry:
            return
        moved_color = None
        if not self.along_ray:  # there colors do not depend on the mean, but on the pixel
            self.lit, self.basis, moved_color = self._colors(p)
            dr.eval(self.lit, self.basis)
        self.color = moved_color is not None
        self.extras = extras(t, settings, p, view.projected, self._moved_records(), moved_color)
        dr.eval(self.extras)

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
        sh = t.Float(p["sh"])  # may be float64
        coefficient = lambda k, c: dr.gather(t.Float, sh, 3 * K * i + (3 * k + c))  # noqa: E731
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
        """(N, 11) float64: squares of the geometry, and sum w^2; those of SH along each ray are kept in `light`."""
        bands = self.scene.coefficients if self.along_ray and self.extras is not None and GEOMETRY in entries else 0
        total = torch.zeros(self.count, GEOMETRY + 1 + 3 * bands, dtype=torch.float64)
        made = lambda mode: Diagonal(self.t, self.count, weights, entries, mode, bands, summed)  # noqa: E731
        for _, states, sink in self._run(made):
            dr.eval(states, sink.buffer)
            total += _torch(sink.buffer).reshape(total.shape)
        self.light = total[:, GEOMETRY + 1 :].reshape(self.count, bands, 3)
        return total[:, : GEOMETRY + 1]

    def diagonal(self, groups: dict, weights, fisherrf: bool) -> Information:
        """`fisher.diagonal` of one view."""
        entries = sorted({k for group in groups.values() for k in group.entries})
        sums, result = self.sums(entries, weights, fisherrf), {}
        scale = torch.tensor([1.0] * 3 if fisherrf else weights, dtype=torch.float64)
        for name, group in groups.items():
            result[name] = group.collect(sums[:, group.entries], self, scale)
            if fisherrf:
                result[name] = result[name] / group.fisherrf(self.scene.inputs)
        return result

    def blocks(self, weights) -> torch.Tensor:
        """`blocks` of one view."""
        t, size = self.t, Blocks.SIZE
        total = torch.zeros(self.count, Blocks.WIDTH, dtype=torch.float64)
        for _, states, sink in self._run(lambda mode: Blocks(t, self.count, weights, mode)):
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
        for name, values in information.items():
            group = GROUPS[name]
            spread = group.spread(values.double().cpu(), self)
            # Squared weights w^2 are of one channel each.
            first = group.entries[0]
            table[:, first : first + spread.shape[1]] = spread
        if not torch.isfinite(table).all():
            raise ValueError("fisher.variance_map: weights must be finite, got NaN or Inf; raise lambda above 0")
        buffer = to_drjit(t, table.float().reshape(-1).to(self.scene.home)).array
        image = dr.zeros(t.Float, camera.width * camera.height)
        light = None if self.light is None else to_drjit(t, self.light.float().reshape(-1).to(self.scene.home)).array
        for part, states, _ in self._run(lambda mode: Variance(buffer, weights, light)):
            for state, at, inside in zip(states, part.flat, part.inside, strict=True):
                dr.scatter(image, state["variance"], at, inside)
        dr.eval(image)
        return image.torch().cpu().reshape(camera.height, camera.width)

    def sh_information(self, squares: torch.Tensor) -> torch.Tensor:
        """(N, K, 3) squares of the derivatives by SH, from (N, 1) sum w^2; call after `sums`."""
        if self.along_ray:
            return self.light
        basis, lit = self._squared_basis()
        return squares[:, :, None] * basis[:, :, None] * lit[:, None, :]

    def sh_spread(self, weights: torch.Tensor) -> torch.Tensor:
        """(N, 3) weights of w^2 in each channel, from (N, K, 3) of SH; along rays they stay with the pixel."""
        if self.along_ray:
            self.light = weights
            return torch.zeros(self.count, 3, dtype=torch.float64)
        basis, lit = self._squared_basis()
        return (basis[:, :, None] * weights).sum(1) * lit

    def _squared_basis(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, K) squares of the SH basis towards the Gaussians, and (N, 3) 1 where a channel is above 0, else 0."""
        return torch.stack([_torch(x) for x in self.basis], 1).square(), torch.stack([_torch(x) for x in self.lit], 1)


def by_probes(gaussians, camera, settings, groups: dict, weights, probes: int, seed: int) -> Information:
    """Mean of (J^T v)^2 over Rademacher images v of RGB; what only other channels tell about is exact."""
    if probes < 1:
        raise ValueError(f"fisher.diagonal: probes must be >= 1, got {probes}")
    other = {name: group for name, group in groups.items() if group.outputs != (0, 3)}
    groups = {name: group for name, group in groups.items() if name not in other}
    total = {name: torch.zeros(group.shape(gaussians), dtype=torch.float64) for name, group in groups.items()}
    scene = Scene(gaussians.detach().replace(features=None), camera, settings, frozenset())
    t, generator = scene.t, torch.Generator().manual_seed(seed)
    inputs = {name: to_drjit(t, x) for name, x in scene.inputs.items()}
    dr.enable_grad([inputs[group.input] for group in groups.values()])
    view, arguments = scene.prepare(inputs)
    operation = Composite()
    with dr.suspend_grad():
        operation.eval(view, *dr.detach(list(arguments[1:5])), True)
    attached = {"record": arguments[1], "sh": arguments[2]}
    root = torch.tensor(weights).sqrt()
    for _ in range(probes if groups else 0):
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
        for name, group in groups.items():
            slope = dr.grad(inputs[group.input]).torch().double().cpu()
            total[name] += group.pull(slope, scene.inputs[group.input].double().cpu()).square()
        for group in groups.values():
            dr.set_grad(inputs[group.input], 0)
    result = {name: x / probes for name, x in total.items()}
    if other:
        result |= Replay(gaussians, camera, settings, geometry=False).diagonal(other, weights, False)
    return result


def _unit(k: int) -> list[float]:
    return [float(j == k) for j in range(3)]


def _torch(x) -> torch.Tensor:
    return x.torch().double().cpu()
