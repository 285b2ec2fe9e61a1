"""J^T of a view by a scene's own parameters: what images say through the geometry of the Gaussians that these move.

A hit h of Gaussian n on pixel p moves channel c there by g_hc s_hj along geometry j of n and, where colors depend on
the mean, by w_h dc_nc / dmu (jacobian.py). These numbers are written down once; J^T of any number of images u is then a
sum over the hits of each Gaussian,

    (J^T u)_nj = sum_h s_hj sum_c g_hc u_pc + sum_c dc_nc / dmu_j sum_h w_h u_pc

instead of a traversal for each. Only the Gaussians that the parameters move are asked. From there on it is torch's
reverse mode through the scene, whose graph is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import torch

from drgs.information.jacobian import GEOMETRY, Row
from drgs.information.replay import Replay
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.bridge import to_drjit
from drgs.tracing.pose import quaternion_product
from drgs.tracing.records import load_packed, packed_size

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import DeformableScene
    from drgs.information.replay import Walk
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

__all__ = ["NetworkRows"]

_FIELDS = {"means": 0, "quats": 3, "log_scales": 6, "logit_opacities": 9}
"""Fields of Gaussians -> where the geometry of a row has theirs; rotations in place of quats."""

_MOST = 1 << 23  # hits of a traversal that are written down: about 1 GB, sorted


class NetworkRows:
    """J^T of a view by parameters of its scene."""

    def __init__(self, fields: _Fields, hits: list[_Hits], asked: torch.Tensor, replay: Replay) -> None:
        """
        Args:
            asked: (M,) int64, ascending: the Gaussians whose hits are known.
        """
        self._fields = fields
        self._hits = hits
        self._asked = asked
        self._replay = replay

    @classmethod
    def of(
        cls,
        scene: DeformableScene,
        camera: Camera,
        settings: RenderSettings,
        semantics: SemanticMetric | None,
        names: Sequence[str],
    ) -> NetworkRows | None:
        """That of a view; None where these parameters reach the image by more than the geometry of its Gaussians, or
        hits are too many to be written down.

        Args:
            scene: The scene; where it knows which of its Gaussians `moving`, (N,) bool, says move, the others are not
                asked.
            camera, settings: The view.
            semantics: The metric of the features, whose channels follow the colors; None: colors alone.
            names: Parameters of the scene.
        """
        fields = _Fields.of(scene, camera.time, names)
        if not set(fields.made) <= set(_FIELDS):
            return None
        with torch.no_grad():  # information is a number
            seen = scene.at(camera.time)
        replay = Replay(seen if semantics else seen.replace(features=None), camera, settings, semantics=semantics)
        moves = getattr(scene, "moving", None)
        which = torch.ones(len(seen), dtype=torch.bool) if moves is None else moves.cpu()
        lib = replay.lib
        flags = lib.UInt32(to_drjit(lib, which.float().to(replay.call.home)).array)
        dr.eval(flags)
        hits = []
        for walk in replay.walks((1.0, 1.0, 1.0)):
            firsts, each = _counted(replay, walk, flags)
            if int(each.sum()) > _MOST:
                return None
            if each.any():
                hits.append(_written(replay, walk, flags, firsts, each))
        return cls(fields, hits, which.nonzero()[:, 0].to(replay.call.home), replay)

    def __call__(self, images: torch.Tensor) -> Iterator[dict[str, torch.Tensor]]:
        """Slopes of the parameters by name along each of (K, pixels, C) cotangents of the rows."""
        geometry = self._geometry(images.to(self._replay.call.home, torch.float32))
        raw = _raw(geometry, self._replay.call.inputs["quats"][self._asked])
        for k in range(len(images)):
            yield self._fields.pull({name: x[k] for name, x in raw.items()}, self._asked)

    def _geometry(self, images: torch.Tensor) -> torch.Tensor:
        """(K, M, 10) slopes of the geometry of those that are asked, rotations for quats."""
        total = images.new_zeros(len(self._asked), GEOMETRY, len(images))
        color = self._replay.moved_color
        for hits in self._hits:
            some = images[..., hits.channels].permute(1, 2, 0)  # (pixels, c, K)
            sums = hits.product(self._replay.lib, some)
            at = torch.searchsorted(self._asked, hits.owners)
            total.index_add_(0, at, sums[:, :GEOMETRY])
            if color is not None and hits.is_colored:
                turned = torch.stack([torch.stack([x.torch()[hits.owners] for x in axes], 1) for axes in color], 1)
                by_mean = torch.einsum("mca,mck->mak", turned, sums[:, GEOMETRY:])
                total[:, :3].index_add_(0, at, by_mean)
        return total.permute(2, 0, 1)


class _Hits(NamedTuple):
    """The hits of one traversal, by Gaussian.

    Attributes:
        channels: Channels of the rows that it composites.
        is_colored: Colors are among them.
        rows: (H S) packed: slopes of the opacity by the geometry, those of the channels by the opacity, the weight.
        pixels: (H,) of each.
        owners: (M,) int64, Gaussians that have hits.
        starts: (M + 1,) where those of each begin.
    """

    channels: slice
    is_colored: bool
    rows: Float
    pixels: UInt32
    owners: torch.Tensor
    starts: UInt32

    def product(self, lib: Lib, images: torch.Tensor) -> torch.Tensor:
        """(M, 10 or 13, K): along (pixels, c, K) images, geometry's slopes and, of colors, sums of weights."""
        _, width, K = images.shape
        u = to_drjit(lib, images.reshape(-1)).array
        count, at = dr.opaque(lib.UInt32, K), dr.arange(lib.UInt32, len(self.owners) * K)
        owner, number = at // count, at % count
        size = packed_size(_row_width(width))

        def body(h: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
            row = load_packed(lib, self.rows, size, h, lib.Bool(True))
            pixel = dr.gather(lib.UInt32, self.pixels, h)
            values = [dr.gather(lib.Float, u, (pixel * width + c) * count + number) for c in range(width)]
            z = sum((row[GEOMETRY + c] * x for c, x in enumerate(values)), lib.Float(0))
            new = [dr.fma(row[j], z, sums[j]) for j in range(GEOMETRY)]
            if self.is_colored:
                new += [dr.fma(row[GEOMETRY + width], values[c], sums[GEOMETRY + c]) for c in range(3)]
            return h + 1, new

        start, end = (dr.gather(lib.UInt32, self.starts, owner + k) for k in range(2))
        sums = [dr.zeros(lib.Float, dr.width(at)) for _ in range(GEOMETRY + 3 * self.is_colored)]
        with dr.suspend_grad():  # this is the derivative
            found = dr.while_loop((start, sums), lambda h, sums: h < end, body)[1]
        dr.eval(found)
        return torch.stack([x.torch().reshape(-1, K) for x in found], 1)


def _row_width(channels: int) -> int:
    return GEOMETRY + channels + 1


def _counted(replay: Replay, walk: Walk, flags: UInt32) -> tuple[list[UInt32], torch.Tensor]:
    """Number of the first hit of each ray on the Gaussians whose flag is not 0, one array a shared ray; and how many
    each ray has, of all shared rays one after the other.
    """
    lib = replay.lib
    counts = [state["count"] for state in replay.run(walk, _Counted(lib, flags))]
    dr.eval(counts)
    each = torch.cat([x.torch().to(torch.int64) for x in counts])
    firsts = (each.cumsum(0) - each).split([dr.width(x) for x in counts])
    return [_integers(lib, x) for x in firsts], each


def _written(replay: Replay, walk: Walk, flags: UInt32, firsts: list[UInt32], each: torch.Tensor) -> _Hits:
    """The hits that `_counted` has counted, by Gaussian."""
    lib = replay.lib
    channels = slice(0, walk.channels.outputs) if walk.first else slice(walk.start, walk.start + walk.channels.channels)
    sink = _Written(lib, flags, firsts, int(each.sum()), channels.stop - channels.start)
    dr.eval(replay.run(walk, sink), sink.rows, sink.owners)
    rays = [x + dr.zeros(lib.UInt32, dr.width(first)) for x, first in zip(walk.part.flat, firsts, strict=True)]
    pixels = torch.cat([x.torch().to(torch.int64) for x in rays]).repeat_interleave(each)
    owners = sink.owners.torch().to(torch.int64)
    order = torch.argsort(owners, stable=True)
    names, lengths = torch.unique_consecutive(owners[order], return_counts=True)
    starts = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    rows = to_drjit(lib, sink.rows.torch().reshape(len(owners), -1)[order].reshape(-1)).array
    return _Hits(channels, walk.first, rows, _integers(lib, pixels[order]), names, _integers(lib, starts))


def _integers(lib: Lib, x: torch.Tensor) -> UInt32:
    return lib.UInt32(lib.Int32(x.int()))


class _Counted:
    """A sink that counts the hits of each ray on some Gaussians."""

    needs_color = False

    def __init__(self, lib: Lib, flags: UInt32) -> None:
        self.lib = lib
        self.flags = flags

    def init(self, k: int) -> dict:
        """None yet."""
        return {"count": self.lib.UInt32(0)}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Count those of one Gaussian."""
        asked = dr.gather(lib.UInt32, self.flags, index, hits) != 0
        return [
            {**state, "count": state["count"] + dr.select(asked & (row.w > 0), lib.UInt32(1), 0)}
            for row, state in zip(rows, states, strict=True)
        ]


class _Written:
    """A sink that writes the rows of these hits down.

    Args:
        firsts: Number of the first hit of each ray, one array a shared ray.
        total: How many there are.
        width: How many of their last channels are wanted.
    """

    needs_color = True

    def __init__(self, lib: Lib, flags: UInt32, firsts: list[UInt32], total: int, width: int) -> None:
        self.flags = flags
        self.firsts = firsts
        self.width = width
        self.size = packed_size(_row_width(width))
        self.rows = dr.zeros(lib.Float, total * self.size)
        self.owners = dr.zeros(lib.UInt32, total)

    def init(self, k: int) -> dict:
        """Where the next one goes."""
        return {"at": type(self.firsts[k])(self.firsts[k])}

    def take(self, lib: Lib, index: UInt32, hits: Mask, rows: list[Row], states: list[dict]) -> list[dict]:
        """Write those of one Gaussian."""
        asked = dr.gather(lib.UInt32, self.flags, index, hits) != 0
        out = []
        for row, state in zip(rows, states, strict=True):
            ok = asked & (row.w > 0)
            values = [*row.slopes, *row.g[len(row.g) - self.width :], row.w]
            values += [lib.Float(0)] * (self.size - len(values))
            for k in range(0, self.size, 16):
                dr.scatter(self.rows, lib.ArrayXf(values[k : k + 16]), state["at"] * (self.size // 16) + k // 16, ok)
            dr.scatter(self.owners, index, state["at"], ok)
            out.append({**state, "at": state["at"] + dr.select(ok, lib.UInt32(1), 0)})
        return out


class _Fields(NamedTuple):
    """Fields of a scene's Gaussians at a time, as a function of some of its parameters.

    Attributes:
        leaves: The parameters by name.
        made: The fields that depend on them.
    """

    leaves: dict[str, torch.Tensor]
    made: dict[str, torch.Tensor]

    @classmethod
    def of(cls, scene: DeformableScene, time: float | None, names: Sequence[str]) -> _Fields:
        """The scene as it is; its graph is kept."""
        values = {name: x.detach() for name, x in scene.parameters().items()}  # leaves of a graph of their own
        leaves = {name: values[name].clone().requires_grad_() for name in names}
        with torch.enable_grad():
            fields = scene.deform({**values, **leaves}, time).parameters()
        return cls(leaves, {name: x for name, x in fields.items() if x.requires_grad})

    def pull(self, slopes: Mapping[str, torch.Tensor], rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """Slopes of the parameters from those of the fields in some rows; in the others they are 0."""
        if not self.made:
            return {name: torch.zeros_like(x) for name, x in self.leaves.items()}
        whole = [
            torch.zeros_like(x).index_copy_(0, rows.to(x.device), slopes[name].to(x)) for name, x in self.made.items()
        ]
        found = torch.autograd.grad(
            list(self.made.values()),
            list(self.leaves.values()),
            whole,
            retain_graph=True,
            materialize_grads=True,
            allow_unused=True,
        )
        return dict(zip(self.leaves, found, strict=True))


def _raw(geometry: torch.Tensor, quats: torch.Tensor) -> dict[str, torch.Tensor]:
    """Slopes of raw fields, (K, M, ...) each, from (K, M, 10) ones of the geometry; `quats` are (M, 4).

    A rotation w, of the world, changes q by (0, w) q / 2. Along q nothing changes, so that the slope of q is in the
    span of these three, each |q| / 2 long and at right angles to the others.
    """
    q = quats.double()  # its square may be far from 1
    axes = torch.eye(3, dtype=q.dtype, device=q.device)
    ways = torch.stack([quaternion_product(axis.expand(len(q), 3), q) for axis in axes], 1)  # (M, 3, 4)
    ways = (ways * (2 / q.square().sum(1))[:, None, None]).to(geometry.dtype)
    parts = {name: geometry[..., at : at + 3] for name, at in _FIELDS.items()}
    by_quats = (parts["quats"][..., None] * ways).sum(-2)
    return parts | {"quats": by_quats, "logit_opacities": geometry[..., 9]}
