"""One view as a single differentiable Dr.Jit operation: records, features and rays in, flat images out.

Color, depth and coverage come out of a first traversal, feature channels out of further ones, `CHUNK` channels each.
Its adjoint replays them; its forward mode carries any number of tangents through one traversal each.
"""

from __future__ import annotations

import drjit as dr

from drgs.tracing.derivatives import Adjoint, Tangent
from drgs.tracing.kernels import Model, Primal, Ray, Source, pack
from drgs.tracing.projection import RECORD
from drgs.tracing.walk import Part

__all__ = ["CHUNK", "Composite", "View"]

CHUNK = 32  # feature channels of one traversal


class View:
    """What stays constant while a view is composited and differentiated.

    No dataclass on purpose: Dr.Jit would take it for a tree of arrays and copy it.

    Attributes:
        t: Dr.Jit types.
        settings: RenderSettings.
        pixels: Number of rays.
        projected: `Projected` of the view.
        basis: Of the arrays that rays carry, how many are SH basis values.
        width: Feature channels.
        want: Extra outputs: `depth`, `median`, `count`, `visibility`.
        parts_of: (view, model, record buffer, ray_of, share) -> list of Part.
        length: (x, y) -> |d| of a pinhole ray; None for world rays.
        world: Records are world records.
        certificate: Filled by the primal pass: rays, redone rays, entries listed.
        extra: Filled by the primal pass: outputs without a derivative.
        lists: Tile lists, or `proxies` and the order of rays `lanes` on `bvh`: kept from the first call of `parts_of`.
    """

    def __init__(self, t, settings, pixels, projected, basis, width, want, parts_of, length, world):
        self.t, self.settings, self.pixels, self.projected = t, settings, pixels, projected
        self.basis, self.width, self.want, self.parts_of = basis, width, want, parts_of
        self.length, self.world = length, world
        self.certificate, self.extra = {}, {}
        self.lists = self.proxies = self.lanes = None


class Composite(dr.CustomOp):
    """`dr.custom(Composite, view, record, sh, features, lanes)` -> dict rgb, alpha, depth, features of flat arrays.

    record: list of per-Gaussian floats. sh: flat N K 3 when SH are evaluated along rays, else None. features: flat N D
    or None. lanes: list of per-pixel floats that rays carry (SH basis values, then o and d of world rays).
    """

    def eval(self, view, record, sh, features, lanes, keep):
        """keep: the adjoint or forward mode may follow."""
        t = view.t
        self.view, self.entries, self.lanes = view, len(record), lanes
        buffers = {"record": _pack(t, record)}
        if sh is not None:
            buffers["sh"] = sh
        if features is not None:
            buffers["features"] = features
        dr.eval(buffers, lanes)
        self.buffers, self.model = buffers, Model(t, view.settings, view.world)
        want = set(view.want) - {"visibility"} | ({"replay"} if keep else set())
        visibility = dr.zeros(t.Float, len_of(record)) if "visibility" in view.want else None
        share = 4 if view.settings.order == "center" and not view.world and not view.basis else 1
        self.passes = [self._source(color=True)]
        self.passes += [self._source(first=k, channels=min(CHUNK, view.width - k)) for k in range(0, view.width, CHUNK)]
        self.parts = {share: view.parts_of(view, self.model, buffers["record"], self._ray, share)}
        if view.width and share != 1:
            self.parts[1] = view.parts_of(view, self.model, buffers["record"], self._ray, 1)
        out = {"rgb": dr.zeros(t.Float, 3 * view.pixels), "alpha": dr.zeros(t.Float, view.pixels)}
        for name, kind in (("depth", t.Float), ("median", t.Float), ("count", t.UInt32)):
            if name in view.want:
                out[name] = dr.zeros(kind, view.pixels)
        if view.width:
            out["features"] = dr.zeros(t.Float, view.width * view.pixels)
        self.finals = []
        for number, source in enumerate(self.passes):
            first = number == 0
            kernel = Primal(
                self.model, source, frozenset(want if first else want & {"replay"}), visibility if first else None
            )
            self.finals.append(self._primal(kernel, first))
            for part, states in self.finals[-1]:
                self._write(out, source, part, states)
        if visibility is not None:
            view.extra["visibility"] = visibility
        for name in ("median", "count"):
            if name in out:
                view.extra[name] = out.pop(name)
        dr.eval(out, view.extra)
        return out

    def _source(self, first=0, channels=0, color=False) -> Source:
        return Source(self.buffers, self.view.width, first, channels, color)

    def _ray(self, x, y, flat, active) -> Ray:
        t, view = self.view.t, self.view
        length = view.length(x, y) if view.length else None
        lane = [dr.gather(t.Float, v, flat, active) for v in self.lanes]
        return Ray(x, y, length, lane, view.basis)

    def _parts(self, source) -> list[Part]:
        return self.parts[min(self.parts)] if source.channels else self.parts[max(self.parts)]

    def _primal(self, kernel, first):
        """(part, final states) pairs; in exact order the first traversal decides which rays are redone."""
        parts, done = self._parts(kernel.source), []
        for part in list(parts):
            # Visibility is scattered on the way, so rays that turn out wrong must be known beforehand.
            check = part.ordered and first
            if check and kernel.visibility is not None:
                probe = Primal(self.model, self._source(), frozenset())
                dr.eval(part.run(probe, check=True), part.failed)
                parts += self._redo(part)
                check = False
            states = part.run(kernel, check=check)
            dr.eval(states, part.failed if check else None)  # together: one kernel
            if check:
                parts += self._redo(part)
            done.append((part, states))
        for part in parts[len(done) :]:
            states = part.run(kernel)
            dr.eval(states)
            done.append((part, states))
        return done

    def _redo(self, part) -> list[Part]:
        """Take the rays that the certificate rejects out of `part`."""
        failed = part.failed & part.inside[0]
        lanes = dr.compress(failed)
        part.inside = [part.inside[0] & ~failed]
        dr.eval(part.inside)
        self.view.certificate["rays"] = self.view.pixels
        self.view.certificate["redone"] = dr.width(lanes)
        return part.listed(lanes)

    def _write(self, out, source, part, states):
        """Scatter the states of a part into the images."""
        t, view = self.view.t, self.view
        for st, at, inside in zip(states, part.flat, part.inside, strict=True):
            sums = [t.Float(s) for s in st["sum"]]
            if source.color:
                for c in range(3):
                    value = dr.fma(st["T"], self.model.background[c], sums[c])
                    dr.scatter(out["rgb"], value, 3 * at + c, inside)
                dr.scatter(out["alpha"], t.Float(st["alpha"]), at, inside)
                for name in view.want & {"depth", "median", "count"}:
                    dr.scatter(out[name], type(out[name])(st[name]), at, inside)
            for k in range(source.channels):
                dr.scatter(out["features"], sums[k], at * view.width + source.first + k, inside)

    def _grads(self) -> dict:
        return {name: dr.zeros(self.view.t.Float, dr.width(x)) for name, x in self.buffers.items()}

    def backward(self):
        """Dr.Jit reverse mode."""
        for name, x in self.adjoint(self.grad_out()).items():
            self.set_grad_in(name, x)

    def adjoint(self, g: dict) -> dict:
        """Replay every traversal with the cotangents `g` of its outputs: gradients of the arguments by name."""
        t, view = self.view.t, self.view
        grads = self._grads()
        lanes = [dr.zeros(t.Float, view.pixels) for _ in self.lanes]
        dr.eval(g)
        gathered = lambda name, i, active: dr.gather(t.Float, g[name], i, active)  # noqa: E731
        for source, done in zip(self.passes, self.finals, strict=True):
            depth = "depth" in view.want and source.color
            for part, finals in done:
                cotangents = []
                for at, inside in zip(part.flat, part.inside, strict=True):
                    sums = [gathered("rgb", 3 * at + c, inside) for c in range(3)] if source.color else []
                    base = at * view.width + source.first
                    sums += [gathered("features", base + k, inside) for k in range(source.channels)]
                    cotangents.append(
                        {
                            "sum": sums,
                            "alpha": gathered("alpha", at, inside) if source.color else t.Float(0),
                            "depth": gathered("depth", at, inside) if depth else t.Float(0),
                            "lanes": len(self.lanes),
                        }
                    )
                # In order, a packet of lanes meets the same Gaussian: reduce it first. Sorted lanes do not.
                mode = dr.ReduceMode.Direct if part.ordered else dr.ReduceMode.Local
                with dr.suspend_grad():
                    kernel = Adjoint(self.model, source, grads, finals, cotangents, depth, mode)
                    states = part.run(kernel)
                    for st, at, inside in zip(states, part.flat, part.inside, strict=True):
                        for total, x in zip(lanes, st["lane"], strict=True):
                            dr.scatter_add(total, x, at, inside)
                    dr.eval(grads, lanes)
        i = dr.arange(t.UInt32, dr.width(grads["record"]) // RECORD)
        used = set(self.model.slots("depth" in view.want))
        record = grads.pop("record")
        grads["record"] = [
            dr.gather(t.Float, record, i * RECORD + k) if k in used else dr.zeros(t.Float, dr.width(i))
            for k in range(self.entries)
        ]
        return grads | ({"lanes": lanes} if lanes else {})

    def forward(self):
        """Dr.Jit forward mode: one tangent."""
        tangent = {"record": self.grad_in("record")}
        for name in ("sh", "features"):
            if name in self.buffers:
                tangent[name] = self.grad_in(name)
        lanes = self.grad_in("lanes") if self.lanes else []
        self.set_grad_out(self.tangents([tangent], [lanes])[0])

    def tangents(self, buffers: list[dict], lanes: list[list]) -> list[dict]:
        """Images of K tangents: dicts like the output of `eval`.

        Args:
            buffers: Per tangent, that of the arguments `record` (a list), `sh` and `features`.
            lanes: Per tangent, that of the argument `lanes`.
        """
        t, view, results = self.view.t, self.view, []
        slots = self.model.slots("depth" in view.want)
        count = dr.width(self.buffers["record"]) // RECORD
        records = pack(t, [b["record"][k] for k in slots for b in buffers], count)
        rest = [{name: x for name, x in b.items() if name != "record"} for b in buffers]
        for b in rest:
            for name, x in b.items():
                b[name] = x + dr.zeros(t.Float, dr.width(self.buffers[name]))
        dr.eval(records, rest, lanes)
        for _ in buffers:
            out = {"rgb": dr.zeros(t.Float, 3 * view.pixels), "alpha": dr.zeros(t.Float, view.pixels)}
            if "depth" in view.want:
                out["depth"] = dr.zeros(t.Float, view.pixels)
            if view.width:
                out["features"] = dr.zeros(t.Float, view.width * view.pixels)
            results.append(out)
        for source in self.passes:
            depth = view.want & {"depth"} if source.color else frozenset()
            for part in self._parts(source):
                carried = [
                    [[dr.gather(t.Float, v, at, inside) for v in per_tangent] for per_tangent in lanes]
                    for at, inside in zip(part.flat, part.inside, strict=True)
                ]
                states = part.run(Tangent(Primal(self.model, source, depth), records, slots, rest, carried))
                dr.eval(states)
                for at, inside, state in zip(part.flat, part.inside, states, strict=True):
                    for out, d in zip(results, state["d"], strict=True):
                        self._write_tangent(out, source, at, inside, d)
        return results

    def _write_tangent(self, out, source, at, inside, d):
        view = self.view
        if source.color:
            for c in range(3):
                dr.scatter(out["rgb"], dr.fma(d["T"], self.model.background[c], d["sum"][c]), 3 * at + c, inside)
            dr.scatter(out["alpha"], -d["T"], at, inside)
            if "depth" in d:
                dr.scatter(out["depth"], d["depth"], at, inside)
        first = 3 if source.color else 0
        for k in range(source.channels):
            dr.scatter(out["features"], d["sum"][first + k], at * view.width + source.first + k, inside)


def len_of(record) -> int:
    """Number of Gaussians of a list of records (constants have width 1)."""
    return max(dr.width(x) for x in record)


def _pack(t, record):
    """Interleave per-Gaussian floats into one buffer of stride RECORD."""
    count = len_of(record)
    i = dr.arange(t.UInt32, count)
    spread = [x if dr.width(x) == count else x + dr.zeros(t.Float, count) for x in record]
    spread += [dr.zeros(t.Float, count)] * (RECORD - len(record))
    buffer = dr.zeros(t.Float, count * RECORD)
    dr.scatter(buffer, t.ArrayXf(spread), i)
    return buffer
