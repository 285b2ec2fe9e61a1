"""One view composited: records, features and rays in, flat images and their derivatives out.

`Compositor` is plain: color, depth and coverage come out of a first traversal, its adjoint replays it, its forward mode
carries any number of tangents through one traversal. Feature channels are products with the weights that the first
traversal writes down (weights.py) where rays walk along lists of tiles; elsewhere they come out of further traversals,
`CHUNK` channels each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import torch

from drgs.settings import RenderSettings
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.derivatives import Adjoint, Tangent
from drgs.tracing.harmonics import sh_basis
from drgs.tracing.hit_table import Table, along_lists
from drgs.tracing.kernels import Channels, Emit, HitModel, Primal
from drgs.tracing.records import RECORD, count_of, pack, pack_records
from drgs.tracing.sums import add_row
from drgs.tracing.walk import Part, Traversal, pixels_a_lane
from drgs.tracing.weights import MATRIX, PIXELS, Weights, in_rows, without_graph

CHUNK = 32  # feature channels of one traversal


class Arguments(NamedTuple):
    """The arguments of `Compositor.forward`, attached to the graph of a call's inputs."""

    record: list
    sh: Any
    features: Any
    carried: list
    absolute: Any = None


def compositor_of(
    lib: Lib,
    settings: RenderSettings,
    traversal: Traversal,
    p: dict,
    coefficients: int,
    origins: list[Float] | None = None,
    directions: list[Float] | None = None,
    shifts: list[Float] | None = None,
    want: frozenset = frozenset(),
    width: int = 0,
    couple: bool = True,
    oriented: bool = False,
) -> tuple[Compositor, Arguments]:
    """The compositor of a view, and the arguments of its `forward`.

    Args:
        lib, settings, traversal, want, width, couple, oriented: Arguments of `Compositor`.
        p: Flat raw parameters by name, of which `sh` and `features` are read.
        coefficients: SH coefficients in `p["sh"]`.
        origins, directions: Three (P,) columns each, unit directions, both in the world of the means. Needed where rays
            carry something: themselves through a world, an SH basis where colors are evaluated along them.
        shifts: Three (P,) columns, `LensMotion.shifts`, where rays of the screen move with the lens.
    """
    along_ray = settings.sh_direction == "ray"
    basis: list[Float] = []
    if along_ray:
        assert directions is not None
        basis = sh_basis(directions, coefficients)
        # The first harmonic is a constant of width 1, but rays carry an entry each.
        basis[0] = basis[0] + dr.zeros(lib.Float, traversal.rays)
    carried = list(basis)
    if traversal.world:
        assert origins is not None
        assert directions is not None
        carried += [*origins, *directions]
    elif shifts is not None:
        carried += shifts
    compositor = Compositor(lib, settings, traversal, want, width, len(basis), couple, oriented)
    # Casts: parameters may be float64, where means are; hits are composited in float32.
    sh = lib.Float(p["sh"]) if along_ray else None
    features = lib.Float(p["features"]) if width else None
    return compositor, Arguments(traversal.projected.record, sh, features, carried, p.get("mean_absolute"))


class Compositor:
    """The compositing of one view, and its derivatives once it was done.

    No dataclass on purpose: Dr.Jit would take it for a tree of arrays and copy it.

    Args:
        settings: Settings of the render.
        traversal: Rays of this view, and where they look for Gaussians.
        want: Extra outputs: `depth`, `median`, `count`, `visibility`.
        width: Number of feature channels.
        basis: How many of the arrays that rays carry are SH basis values.
        couple: Derivatives of the feature image reach all that it depends on; else only the features.
        oriented: The features are axes that are turned towards each ray: `Channels.oriented`.
        model: That of the settings and the traversal, if it is made already.
    Attributes:
        certificate: Numbers of rays, of redone rays and of listed entries, after `forward`.
        extra: Outputs without a derivative, after `forward`.
        passes: What each traversal composited, after `forward`.
        finals: (part, final states) pairs of each traversal, after `forward`.
    """

    def __init__(
        self,
        lib: Lib,
        settings: RenderSettings,
        traversal: Traversal,
        want: frozenset,
        width: int = 0,
        basis: int = 0,
        couple: bool = True,
        oriented: bool = False,
        model: HitModel | None = None,
    ) -> None:
        self.lib = lib
        self.oriented = oriented
        self.settings = settings
        self.traversal = traversal
        self.want = want
        self.width = width
        self.basis = basis
        self.rays = traversal.rays
        self.couple = couple
        self.model = model or HitModel(lib, settings, traversal.world)
        self.certificate: dict = {}
        self.extra: dict = {}

    # -- forward -----------------------------------------------------------------------------------------------------

    @without_graph
    def forward(
        self,
        record: list[Float],
        sh: Float | None,
        features: Float | None,
        carried: list[Float],
        absolute: Float | None,
        keep: bool,
        columns: int = 0,
        joint: int = 0,
    ) -> dict:
        """Flat images rgb, alpha, and where there are any depth and features.

        Args:
            record: Columns (N,) of floats, laid out as `records` says.
            sh: Flat (N K 3) when SH are evaluated along rays, else None.
            features: Flat (N D) or None.
            carried: Columns (rays,): SH basis values, then o and d of world rays or shifts of others.
            absolute: Flat (N 2) zeros whose gradient is to be the sum of each pixel's absolute gradient by projected
                means; None: not needed.
            keep: The adjoint may follow.
            columns: So many tangents may follow.
            joint: Feature channels that the first traversal composites with the colors, none or all, so that each of
                its hits knows all that it composites (`information.replay`).
        """
        view = self.traversal
        buffers = {"record": pack_records(self.lib, record)}
        if sh is not None:
            buffers["sh"] = sh
        if features is not None:
            buffers["features"] = features
        self.ready(buffers, len(record), carried, absolute)
        dr.eval(self.buffers, carried)
        view.start(self.model, self.buffers["record"], carried, self.basis, keep)
        self.certificate.update(view.certificate)
        joint = self.width if self.oriented else joint
        self.passes = [self._channels(0, joint, color=True)]
        chunks = range(joint, self.width, CHUNK)
        self.passes += [self._channels(k, min(CHUNK, self.width - k)) for k in chunks]
        in_lists = self.settings.order == "center" and self.settings.traversal == "tiles"
        share = pixels_a_lane(self.basis) if in_lists else 1
        weighed = self.width > joint
        self.parts = view.weighed(share, MATRIX // (1 + columns)) if weighed else view.parts(share)
        out = self.composited(frozenset(self.want | ({"replay"} if keep else set())), count_of(record))
        for name in ("visibility", "median", "count"):
            if name in out:
                self.extra[name] = out.pop(name)
        dr.eval(out, self.extra)
        return out

    def ready(self, buffers: dict, entries: int, carried: Sequence[Float] = (), absolute: Float | None = None) -> None:
        """Take what hits read: the buffers, with so many columns of records; other arguments are those of `forward`."""
        self.absolute: Any = absolute
        self.entries = entries
        self.carried = list(carried)
        self.buffers = buffers
        self.passes = [self._channels(color=True)]

    def again(self, features: Float, count: int) -> tuple[Channels, list[tuple[Part, list[dict]]]]:
        """Another traversal after `forward`, with the colors beside other features: as `passes` and `finals` hold it.

        Args:
            features: Flat (N count), all of them composited.
        """
        channels = Channels({**self.buffers, "features": features}, count, 0, count, True)
        done = []
        kernel = Primal(self.model, channels, frozenset({"replay"}))
        for part in self.parts:
            done.append((part, part.run(kernel)))
            dr.eval(done[-1][1])  # one at a time: each has rows to sort
        return channels, done

    def composited(self, want: frozenset, count: int = 0) -> dict:
        """Flat images, `count` visibilities among them, from all passes."""
        lib = self.lib
        out = self._images()
        if self.traversal.holes is not None:
            for c, x in enumerate(self.model.background):
                dr.scatter(out["rgb"], x, 3 * dr.arange(lib.UInt32, self.rays) + c)
        self.finals = []
        for name, kind in (("median", lib.Float), ("count", lib.UInt32)):
            if name in want:
                out[name] = dr.zeros(kind, self.rays)
        if "visibility" in want:
            out["visibility"] = dr.zeros(lib.Float, count)
        keep = "replay" in want and len(self.parts) == 1
        image = self._no_rows(self.rays) if self._weights_are_held else None
        for channels in self.passes:
            done = []
            for part in self._parts(channels):  # gets longer where rays are redone
                states, buffer = self._primal(part, channels, want, out.get("visibility"))
                done.append((part, states))
                if part.weights is not None and image is not None:
                    part.weights.survey(buffer)
                    part.weights.image(buffer, in_rows(self.buffers["features"], self.width), image)
                    part.weights.kept = buffer if keep else None
            if image is not None and channels.color:
                out["features"] = lib.Float(image.view(-1))
            for part, states in done:
                self._write(out, channels, part, states)
            self.finals.append(done)
        return out

    def _channels(self, first: int = 0, channels: int = 0, color: bool = False) -> Channels:
        return Channels(self.buffers, self.width, first, channels, color, self.oriented)

    def _images(self) -> dict:
        """Flat images of zeros."""
        zeros = lambda channels: dr.zeros(self.lib.Float, channels * self.rays)  # noqa: E731
        out = {"rgb": zeros(3), "alpha": zeros(1)}
        if "depth" in self.want:
            out["depth"] = zeros(1)
        if self.width:
            out["features"] = zeros(self.width)
        return out

    def _parts(self, channels: Channels) -> list[Part]:
        """The parts that a pass walks: features need none where their weights are held."""
        return [x for x in self.parts if x.weights is None] if channels.channels and not channels.color else self.parts

    def _primal(
        self, part: Part, channels: Channels, want: frozenset, visibility: Float | None
    ) -> tuple[list[dict], Float | None]:
        """Final states of a part, and its weights if they are held; adds a part of rays that are to be redone."""
        if not channels.color:
            want = want & {"replay"}
            visibility = None
        # In exact order the first traversal decides which rays are redone.
        check = part.ordered and channels.color
        if check and visibility is not None:
            # It is summed up on the way, so rays that turn out wrong must be known beforehand.
            dr.eval(part.run(Primal(self.model, self._channels(), frozenset()), check=True), part.failed)
            self.parts += self._redo(part)
            check = False
        buffer = part.weights.zeros() if part.weights is not None else None
        kernel = Primal(self.model, channels, want - {"visibility"}, _emit_weights(part, buffer, visibility))
        states = part.run(kernel, check=check)
        dr.eval(states, part.failed if check else None, buffer)  # together: one kernel
        if check:
            self.parts += self._redo(part)
        return states, buffer

    def _redo(self, part: Part) -> list[Part]:
        """Take the rays that the certificate rejects out of `part`, into parts of their own."""
        again = part.reject()
        self.certificate["rays"] = self.rays
        if part.first:  # those walked a third time are among them
            self.certificate["redone"] = self.certificate.get("redone", 0) + dr.width(again)
        return part.again(again)

    @property
    def _weights_are_held(self) -> bool:
        """Whether the weights of the colors' traversal are held for products with features."""
        return any(part.weights is not None for part in self.parts)

    def _no_rows(self, count: int) -> torch.Tensor:
        """Zeros of all channels."""
        return in_rows(dr.zeros(self.lib.Float, count * self.width), self.width)

    def _write(self, out: dict, channels: Channels, part: Part, states: list[dict]) -> None:
        """Scatter the states of a part into the images."""
        lib = self.lib
        for st, at, inside in zip(states, part.flat, part.inside, strict=True):
            sums = [lib.Float(s) for s in st["sum"]]
            if channels.color:
                for c in range(3):
                    value = dr.fma(st["T"], self.model.background[c], sums[c])
                    dr.scatter(out["rgb"], value, 3 * at + c, inside)
                dr.scatter(out["alpha"], lib.Float(st["alpha"]), at, inside)
                for name in self.want & {"depth", "median", "count"}:
                    dr.scatter(out[name], type(out[name])(st[name]), at, inside)
            for k, x in enumerate(sums[3 if channels.color else 0 :]):
                dr.scatter(out["features"], x, at * self.width + channels.first + k, inside)

    # -- reverse -----------------------------------------------------------------------------------------------------

    @without_graph
    def adjoint(self, g: dict) -> dict:
        """Replay every traversal with the cotangents `g` of its images: gradients of `forward`'s arguments by name."""
        lib = self.lib
        grads = {name: dr.zeros(lib.Float, dr.width(x)) for name, x in self.buffers.items()}
        carried = [dr.zeros(lib.Float, self.rays) for _ in self.carried]
        absolute = None if self.absolute is None else dr.zeros(lib.Float, dr.width(self.absolute))
        dr.eval(g)
        slopes = self._no_rows(dr.width(grads["features"]) // self.width) if self._weights_are_held else None
        for channels, done in zip(self.passes, self.finals, strict=True):
            for part, states in done:
                with dr.suspend_grad():  # this is the derivative; nothing differentiates it again
                    self._adjoint(g, channels, part, states, grads, carried, slopes, absolute)
        if slopes is not None:
            grads["features"] += lib.Float(slopes.view(-1))
        i = dr.arange(lib.UInt32, dr.width(grads["record"]) // RECORD)
        used = set(self.model.slots("depth" in self.want))
        record = grads.pop("record")
        grads["record"] = [
            dr.gather(lib.Float, record, i * RECORD + k) if k in used else dr.zeros(lib.Float, dr.width(i))
            for k in range(self.entries)
        ]
        if absolute is not None:
            grads["absolute"] = type(self.absolute)(absolute)
        return grads | ({"carried": carried} if carried else {})

    def _adjoint(
        self,
        g: dict,
        channels: Channels,
        part: Part,
        finals: list[dict],
        grads: dict,
        carried: list[Float],
        slopes: torch.Tensor | None,
        absolute: Float | None,
    ) -> None:
        """Add the gradient from a part with its final states to `grads`, `carried`, the `slopes` of features,
        `absolute`.
        """
        depth = "depth" in self.want and channels.color
        scalars = None
        cotangents = self._cotangents(g, channels, part)
        if part.weights is not None and slopes is not None:
            scalars, sums = self._products(part, part.weights, in_rows(g["features"], self.width), slopes)
            if scalars is not None:
                cotangents = [{**own, "rest": rest} for own, rest in zip(cotangents, sums, strict=True)]
        if channels.channels and not self.couple:
            self._feature_gradient(grads["features"], channels, part, cotangents)
            return

        def kernel(part: Part, finals: list[dict], table: Table | None = None) -> Adjoint:
            own = cotangents if table is None else self._cotangents(g, channels, part)
            scalar = None
            if scalars is not None:
                scalar = lambda k, place, ok: dr.gather(self.lib.Float, scalars, part.slot(k, place), ok)  # noqa: E731
            return Adjoint(self.model, channels, grads, finals, own, depth, part.reduction, scalar, table, absolute)

        part, finals, table = along_lists(self.lib, part, finals, 1, kernel)
        states = part.run(kernel(part, finals, table))
        for st, at, inside in zip(states, part.flat, part.inside, strict=True):
            for total, x in zip(carried, st["carried"], strict=True):
                dr.scatter_add(total, x, at, inside)
        dr.eval(grads, carried, absolute)

    def _products(
        self, part: Part, weights: Weights, g: torch.Tensor, slopes: torch.Tensor
    ) -> tuple[Float | None, list[Float]]:
        """Add the gradient of the features in a part to `slopes`; if coupled, a table of what they add to s.

        Returns:
            The table, and per shared ray the sum of it over the ray's weights, in float64; or None and nothing.
        """
        lib, buffer = self.lib, weights.kept
        slots = part.slots
        assert slots is not None  # weights are held of rays through tiles
        if not bool(g.any()):
            return None, []
        if buffer is None:
            buffer = weights.zeros()
            dr.eval(part.run(Primal(self.model, self._channels(), frozenset(), _emit_weights(part, buffer))), buffer)
        features = in_rows(self.buffers["features"], self.width) if self.couple else None
        found = weights.gradient(buffer, g, slopes, features)
        if found is None:
            return None, []
        scalars, totals = found
        tile = dr.arange(lib.UInt32, dr.width(slots.columns[0])) // (PIXELS // len(slots.columns))
        return scalars, [dr.gather(lib.Float64, totals, tile * PIXELS + column) for column in slots.columns]

    def _feature_gradient(self, grad: Float, channels: Channels, part: Part, cotangents: list[dict]) -> None:
        """Add w times the cotangents of a feature pass to the gradient of its features: dL/df_i = sum w_i dL/dF."""

        def emit(index: UInt32, k: int, place: list, w: Float, ok: Mask) -> None:
            slopes = [w * cotangent for cotangent in cotangents[k]["sum"]]
            add_row(self.lib, grad, slopes, index, self.width, channels.first, ok, part.reduction)

        dr.eval(part.run(Primal(self.model, self._channels(), frozenset(), emit)), grad)

    def _cotangents(self, g: dict, channels: Channels, part: Part) -> list[dict]:
        """What `Adjoint` needs of the images' cotangents, per shared ray of a part."""
        return [self._cotangent(g, channels, *at) for at in zip(part.flat, part.inside, strict=True)]

    def _cotangent(self, g: dict, channels: Channels, at: UInt32, inside: Mask) -> dict:
        """The cotangents at the pixels `at` of one shared ray; 0 where they are not inside."""
        lib = self.lib
        gathered = lambda name, i: dr.gather(lib.Float, g[name], i, inside)  # noqa: E731
        sums = [gathered("rgb", 3 * at + c) for c in range(3)] if channels.color else []
        base = at * self.width + channels.first
        sums += [gathered("features", base + k) for k in range(channels.channels)]
        depth = "depth" in self.want and channels.color
        return {
            "sum": sums,
            "alpha": gathered("alpha", at) if channels.color else lib.Float(0),
            "depth": gathered("depth", at) if depth else lib.Float(0),
            "carried": len(self.carried),
        }

    # -- tangents ----------------------------------------------------------------------------------------------------

    @without_graph
    def tangents(self, buffers: list[dict], carried: list[list[Float]]) -> list[dict]:
        """Images of K tangents: dicts like the output of `forward`.

        Args:
            buffers: How, for each tangent, the arguments `record` (a list), `sh` and `features` change.
            carried: How, for each tangent, the argument `carried` changes.
        """
        lib = self.lib
        slots = self.model.slots("depth" in self.want)
        count = dr.width(self.buffers["record"]) // RECORD
        records = pack(lib, [b["record"][k] for k in slots for b in buffers], count)
        rest = [{name: x for name, x in b.items() if name != "record"} for b in buffers]
        for b in rest:
            for name, x in b.items():
                b[name] = x + dr.zeros(lib.Float, dr.width(self.buffers[name]))
        dr.eval(records, rest, carried)
        results = [self._images() for _ in buffers]
        images = [self._no_rows(self.rays) for _ in buffers] if self._weights_are_held else []
        features = [b["features"] for b in (self.buffers, *rest)] if self._weights_are_held else []
        for channels in self.passes:
            depth = self.want & {"depth"} if channels.color else frozenset()
            if channels.channels and not self.couple:
                for out, b in zip(results, rest, strict=True):
                    self._feature_tangent(out, channels, b["features"])
                continue
            for part in self._parts(channels):
                own = [
                    [[dr.gather(lib.Float, v, at, inside) for v in per_tangent] for per_tangent in carried]
                    for at, inside in zip(part.flat, part.inside, strict=True)
                ]
                buffer = None
                moved = []
                if part.weights is not None:
                    buffer = part.weights.zeros()
                    moved = [part.weights.zeros() for _ in rest] if self.couple else []
                primal = Primal(self.model, channels, depth, _emit_weights(part, buffer))
                states = part.run(Tangent(primal, records, slots, rest, own, [_emit_weights(part, x) for x in moved]))
                dr.eval(states, buffer, moved)
                if part.weights is not None:
                    f, *slopes = (in_rows(x, self.width) for x in features)
                    part.weights.push(buffer, moved, f, slopes, images)
                for at, inside, state in zip(part.flat, part.inside, states, strict=True):
                    for out, d in zip(results, state["d"], strict=True):
                        self._write_tangent(out, channels, at, inside, d)
            if channels.color:
                for out, image in zip(results, images, strict=False):
                    out["features"] = lib.Float(image.view(-1))
        return results

    def _feature_tangent(self, out: dict, channels: Channels, features: Float) -> None:
        """Composite the tangent of the features alone: the image is linear in them, sum w_i df_i."""
        moved = dataclasses.replace(channels, buffers=self.buffers | {"features": features})
        for part in self._parts(channels):
            states = part.run(Primal(self.model, moved, frozenset()))
            dr.eval(states)
            self._write(out, channels, part, states)

    def _write_tangent(self, out: dict, channels: Channels, at: UInt32, inside: Mask, d: dict) -> None:
        """Scatter one tangent of a part's states into its images."""
        if channels.color:
            for c in range(3):
                dr.scatter(out["rgb"], dr.fma(d["T"], self.model.background[c], d["sum"][c]), 3 * at + c, inside)
            dr.scatter(out["alpha"], -d["T"], at, inside)
            if "depth" in d:
                dr.scatter(out["depth"], d["depth"], at, inside)
        first = 3 if channels.color else 0
        for k in range(channels.channels):
            dr.scatter(out["features"], d["sum"][first + k], at * self.width + channels.first + k, inside)


class Composite(dr.CustomOp):
    """`Compositor.forward` as one differentiable operation of Dr.Jit.

    `dr.custom(Composite, compositor, *arguments, keep)`; `keep` says whether a derivative may follow.
    """

    def eval(
        self,
        compositor: Compositor,
        record: list[Float],
        sh: Float | None,
        features: Float | None,
        carried: list[Float],
        absolute: Float | None,
        keep: bool,
    ) -> dict:
        """The images, under the name that `dr.CustomOp` calls."""
        self.compositor = compositor
        return compositor.forward(record, sh, features, carried, absolute, keep)

    def backward(self) -> None:
        """Gradients of the arguments from those of the images, in Dr.Jit's reverse mode."""
        for name, x in self.compositor.adjoint(self.grad_out()).items():
            self.set_grad_in(name, x)

    def forward(self) -> None:
        """The tangent of the images from that of the arguments, in Dr.Jit's forward mode."""
        c = self.compositor
        tangent = {name: self.grad_in(name) for name in c.buffers}
        carried = self.grad_in("carried") if c.carried else []
        self.set_grad_out(c.tangents([tangent], [carried])[0])


def _emit_weights(part: Part, buffer: Float | None, visibility: Float | None = None) -> Emit | None:
    """Writes the weights of a part into a buffer, and sums up those of each Gaussian; None if nothing is to be done."""
    if buffer is None and visibility is None:
        return None

    def emit(index: UInt32, k: int, place: list, w: Float, ok: Mask) -> None:
        if buffer is not None:
            dr.scatter(buffer, w, part.slot(k, place), ok)
        if visibility is not None:
            dr.scatter_add(visibility, w, index, ok)

    return emit
