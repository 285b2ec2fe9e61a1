"""Arbitrary rays through Mitsuba's acceleration structure.

Mitsuba's `ellipsoids` shape is used as a proxy only: it says which Gaussian a ray may meet next, the response is always
evaluated from our own records. What is done about its known faults (Mitsuba 3.9.1):

- the intersection divides by |d| instead of |d|^2: rays are traced with directions as long as the thinnest proxy;
- its discriminant is rounded to about 6e-8 (distance / radius)^2: rays start where they enter the box of all proxies,
  proxies are not smaller than 1e-3 of their distance, and larger than their Gaussians by what rounding may take;
- rays that start inside a proxy see nothing of it: the few that an origin can be inside of are not traced but listed,
  and every ray is offered them first. Where they are many because origins lie apart, origins are moved back behind
  them, which costs precision: everything is that much farther away;
- the restart behind a hit loses what enters within the step: the step is about one unit in
  the last place, doubled on a repeated hit;
- of coincident proxies only one is found, of nested ones not all: Gaussians with the same center, rotation and shape
  share one primitive, the largest, whose members the stream delivers one by one;
- proxies are entered before their Gaussians, tiny ones long before: rays sort their hits by the Gaussians' own entries.

Rays are taken in an order in which neighbors are alike (`_coherent`): a packet of lanes walks through the same part of
the structure.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

from drgs import runtime
from drgs.settings import RenderSettings
from drgs.tracing import walk
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.kernels import HitModel
from drgs.tracing.primitives import Projected, Ray
from drgs.tracing.protocols import DividedStream
from drgs.tracing.sort_keys import EMPTY, positive
from drgs.tracing.tiles import depth_order
from drgs.tracing.walk import Part

# relative rounding of the coordinates of a ray's origin: one unit in the last place of float32
_ORIGIN_ROUNDING = 1.2e-7
_GRAZING = 1e-7  # relative to (distance / radius)^2: what rounding takes from the discriminant, with a margin
_FAR_RATIO = 4e3  # distance / radius of the extent from which float32 loses more than 1e-3 of a hit
_MIN_RADIUS = 1e-3  # smallest proxy radius, relative to the distance it is traced over
# primitives around an origin that are listed and tested by every ray before the tree is traced, where origins differ;
# chosen
_MAX_LISTED = 1000
_ENTRY_BUFFER = 6  # hits that a ray in order of entry is sorted among: proxies come nearly in that order
_INSIDE_MARGIN = 1.05  # half axes of a proxy within which an origin counts as inside: 5 % more than it needs


class BvhTraversal:
    """Any rays, through an acceleration structure of proxies; a `Traversal`.

    Args:
        rays: Number of rays; origin and direction are the last six floats that they carry.
        holes: (rays,) 0 for what is no ray; None if all are.
    """

    world = True

    def __init__(
        self, lib: Lib, settings: RenderSettings, projected: Projected, rays: int, holes: UInt32 | None = None
    ) -> None:
        self.lib = lib
        self.settings = settings
        self.projected = projected
        self.rays = rays
        self.holes = holes
        self.certificate: dict = {}

    def start(self, model: HitModel, records: Float, carried: list[Float], basis: int, replayed: bool) -> None:
        """Build the proxies, and find the order of the rays."""
        self.model = model
        self.records = records
        self.carried = carried
        self.basis = basis
        lib, s = self.lib, self.settings
        every = self._ray(dr.arange(lib.UInt32, self.rays))
        self.proxies = self._proxies(every)
        self.order = _coherent(lib, every.carried[-6:])
        self.center_key = self.projected.key if s.order == "center" else None
        if s.order == "center" and s.depth_key == "z":
            # Behind the camera plane z is negative, which no order key may be: the rank orders as well.
            self.center_key = dr.zeros(lib.Float, dr.width(self.projected.key))
            rank = dr.arange(lib.UInt32, dr.width(self.center_key))
            dr.scatter(self.center_key, lib.Float(rank), depth_order(lib, self.projected.key, rank))

    def parts(self, share: int) -> list[Part]:
        """All rays as one part, one a lane."""
        lib, s = self.lib, self.settings
        ray = self._ray(self.order)
        inside = lib.Bool(bool(self.rays))
        if self.holes is not None:
            inside = dr.gather(lib.UInt32, self.holes, self.order) != 0
        stream = _ProxyStream(lib, self.proxies, ray, s.order, self.model.signed)
        part = Part(
            lib,
            self.model,
            self.records,
            [ray],
            [self.order],
            [inside],
            stream,
            ordered=True,
            center_key=self.center_key,
            buffer=_ENTRY_BUFFER if s.order == "entry" else walk.BUFFER,  # as it is now: tests shorten it
        )
        return [part]

    def weighed(self, share: int, size: int) -> list[Part]:
        """What `parts` returns: there are no lists that rays have in common."""
        return self.parts(share)

    def _ray(self, i: UInt32) -> Ray:
        carried = [dr.gather(self.lib.Float, c, i) for c in self.carried]
        return Ray(carried=carried, basis=self.basis)

    def _proxies(self, ray: Ray) -> Proxies | None:
        """Proxies of the view's ellipsoids, for rays with these origins."""
        if self.rays == 0:
            return None
        projected = self.projected
        corners = [f(x) for f in (dr.min, dr.max) for x in ray.carried[-6:-3]]
        dr.eval(projected.ellipsoids, projected.alive, corners)
        ellipsoids = np.array([x.numpy() for x in projected.ellipsoids])
        alive = projected.alive.numpy() & np.ones(ellipsoids.shape[1], bool)
        origins = np.array([float(x[0]) for x in corners]).reshape(2, 3).T
        _warn_of_rounding(ellipsoids, alive, origins)
        tails = not self.model.response.front_only
        return proxy_scene(self.lib, ellipsoids[:3], ellipsoids[3:7], ellipsoids[7:], alive, origins, tails)


class Proxies:
    """A Mitsuba scene of proxy ellipsoids.

    Attributes:
        scene: mi.Scene, or None when all Gaussians are listed.
        members, first: Gaussian indices grouped by primitive, and the first of each. Behind the primitives follows one
            more group: the Gaussians that every ray is offered first.
        listed: First and last of `members` in that group.
        low, high, size: Corners (3,) of the box of all primitives, and its diagonal.
        back: How far an origin must be moved back along its ray.
        scale: Length of traced directions.
    """

    def __init__(
        self,
        lib: Lib,
        scene: Any,
        members: np.ndarray,
        first: np.ndarray,
        box: Sequence[np.ndarray] | np.ndarray,
        back: float,
        scale: float,
    ) -> None:
        self.scene = scene
        self.listed = [dr.opaque(lib.UInt32, int(x)) for x in first[-2:]]
        self.members = lib.UInt32(members.astype(np.uint32))
        self.first = lib.UInt32(first.astype(np.uint32))
        self.low, self.high = ([dr.opaque(lib.Float, float(x)) for x in corner] for corner in box)
        size = np.linalg.norm(box[1] - box[0])
        self.size, self.back, self.scale = (dr.opaque(lib.Float, float(x)) for x in (size, back, scale))


def proxy_scene(
    lib: Lib,
    means: np.ndarray,
    quats: np.ndarray,
    radii: np.ndarray,
    alive: np.ndarray,
    origins: np.ndarray,
    tails: bool = False,
) -> Proxies | None:
    """The Mitsuba scene of proxies around the Gaussians, or None when no Gaussian can be hit.

    Args:
        means, quats, radii: (3, N), (4, N) wxyz, (3, N) half axes in world units, NumPy.
        alive: (N,) bool.
        origins: (3, P) ray origins: decide how far everything can be.
        tails: What a ray meets behind its origin counts: all that it can meet close by is listed.
    """
    mi = runtime.mitsuba()
    index = np.flatnonzero(alive & np.isfinite(means).all(0) & np.isfinite(radii).all(0))
    if len(index) == 0 or origins.shape[1] == 0:
        return None
    means, radii, quats = (x[:, index].astype(np.float64) for x in (means, radii, quats))
    quats /= np.sqrt((quats * quats).sum(0))
    longest = radii.max(0)
    # Those that only differ in size share a proxy. Rounded: the radii differ by the extents, which are multiplied in.
    grouped, first = _groups(np.concatenate([means, quats, np.round(radii / longest, 9)]))
    members = index[grouped]
    primitive = grouped[first[:-1]]
    growth = np.maximum.reduceat(longest[grouped], first[:-1]) / longest[primitive]
    means = means[:, primitive]
    quats = quats[:, primitive]
    radii = radii[:, primitive] * growth
    low, high = origins.min(1), origins.max(1)
    spread = 0.5 * float(np.linalg.norm(high - low))
    to = means - 0.5 * (low + high)[:, None]
    distance = np.sqrt((to * to).sum(0)) + spread
    back = 0.0
    proxies = _grown(radii, means, distance)
    around = _around(to, quats, proxies, spread, distance, tails)
    # Of a single origin all are candidates of every ray, and listed they are cheaper than traced.
    most = _MAX_LISTED if spread > 0 else len(around)
    if len(around) > most:
        # The largest are listed all the same: a move back behind them would cost the others their precision.
        around = around[np.argsort(radii[:, around].max(0), kind="stable")]
        moved = around[: len(around) - most]
        around = around[len(moved) :]
        back = 2.5 * float(proxies[:, moved].max())
    if len(around):
        kept = np.delete(np.arange(len(primitive)), around)
        counts = np.diff(first)
        listed = np.isin(np.repeat(np.arange(len(primitive)), counts), around)
        members = np.concatenate([members[~listed], members[listed]])
        first = np.concatenate([[0], np.cumsum(counts[kept])])
        means = means[:, kept]
        quats = quats[:, kept]
        radii = radii[:, kept]
        distance = distance[kept]
    first = np.append(first, len(members))
    if means.shape[1] == 0:
        return Proxies(lib, None, members, first, np.zeros((2, 3)), 0, 1)
    proxies = _grown(radii, means, distance + back)
    # One flat array: of three centers, or anything else in three rows, `load_dict` tries to make a color, and nanobind
    # prints that it failed.
    data = np.concatenate([means, proxies, quats[[1, 2, 3, 0]]]).T
    shape = {"type": "ellipsoids", "data": mi.TensorXf(data.astype(np.float32).ravel()), "extent": 1.0}
    scene = mi.load_dict({"type": "scene", "gaussians": shape})
    # A sphere around each, and a margin for rounding.
    widest = 1.001 * proxies.max(0)
    box = (means - widest).min(1), (means + widest).max(1)
    # Where the scaled direction is longer than a proxy is thick, thick hits are lost as well as grazing ones.
    return Proxies(lib, scene, members, first, box, back, proxies.min())


def _groups(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of equal columns (k, N) side by side, and where each group starts, one more at the end."""
    # Stable: primitives come in an order that no sort chooses.
    order = np.argsort(columns[0], kind="stable")
    x = columns[0, order]
    equal = np.flatnonzero(x[1:] == x[:-1])
    tied = np.zeros(len(order), bool)
    tied[equal] = True
    tied[equal + 1] = True
    # Comparing whole columns is slow: only those whose first numbers are equal.
    some, alone = order[tied], order[~tied]
    if len(some) == 0:
        return alone, np.arange(len(alone) + 1)
    rows = np.ascontiguousarray(columns[:, some].T + 0.0)
    _, group = np.unique(rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel(), return_inverse=True)
    sizes = np.concatenate([np.bincount(group), np.ones(len(alone), int)])
    return np.concatenate([some[np.lexsort((some, group))], alone]), np.concatenate([[0], np.cumsum(sizes)])


def _grown(radii: np.ndarray, means: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Half axes of proxies that are traced over `distance`, or through the box of all of them where that is shorter."""
    widest = radii.max(0)
    size = np.linalg.norm((means + widest).max(1) - (means - widest).min(1))
    reach = np.minimum(distance, size)
    # Grazing rays are lost to rounding unless the proxy is larger than the Gaussian by as much; 1e-4 is for the rest of
    # what float32 does to a hit.
    graze = _GRAZING * (reach / np.maximum(radii.min(0), _MIN_RADIUS * reach)) ** 2
    return np.maximum(radii * (1 + 1e-4 + graze), _MIN_RADIUS * reach)


def _around(
    to: np.ndarray, quats: np.ndarray, radii: np.ndarray, spread: float, distance: np.ndarray, spheres: bool
) -> np.ndarray:
    """Indices of ellipsoids that a point within `spread` of 0 may be inside of; boxes, or spheres, stand for them."""
    widest = radii.max(0)
    if spheres:
        return np.flatnonzero(distance <= 2 * spread + _INSIDE_MARGIN * widest)
    near = np.flatnonzero(distance <= 2 * spread + 2 * widest)
    w, x, y, z = quats[:, near]
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = abs((axes * to[:, near]).sum(1))
    return near[(local <= _INSIDE_MARGIN * radii[:, near] + spread).all(0)]


class _ProxyStream(DividedStream):
    """Listed Gaussians, then the proxies along rays in the order of their entry points; a `Stream`."""

    def __init__(self, lib: Lib, proxies: Proxies | None, ray: Ray, order: str, signed: bool) -> None:
        self.lib = lib
        self.signed = signed
        self.proxies = proxies
        self.ray = ray
        self.order = order
        self.mi = runtime.mitsuba()
        self.d = ray.carried[-3:]
        if proxies is not None:
            # Parameters along a ray count from where it starts, so that they are small and their rounding is.
            self.start = self._enter(proxies, ray.carried[-6:-3])
            self.o = [dr.fma(d, self.start, x) for x, d in zip(ray.carried[-6:-3], self.d, strict=True)]
            size = dr.maximum(dr.maximum(abs(self.o[0]), abs(self.o[1])), abs(self.o[2]))
            self.step = _ORIGIN_ROUNDING * dr.maximum(size, proxies.scale)

    def begin(self) -> tuple:
        """(candidates so far, parameter, step, primitive, next member, end of members, something left)."""
        lib, p = self.lib, self.proxies
        width = dr.width(self.d)
        if p is None:
            return lib.UInt32(0), *([lib.Float(0)] * 2), *([lib.UInt32(0)] * 3), lib.UInt32(0)
        some = dr.full(lib.UInt32, 1, width)
        none = lib.UInt32(0xFFFFFFFF)
        at = dr.zeros(lib.Float, width)
        return lib.UInt32(0), at, lib.Float(self.step), none, *(lib.UInt32(x) for x in p.listed), some

    def _enter(self, p: Proxies, origin: list[Float]) -> Float:
        """Where a ray starts: at the box of all primitives, but not before it was moved back."""
        near = self.lib.Float(-p.back)
        for o, d, low, high in zip(origin, self.d, p.low, p.high, strict=True):
            along = dr.minimum((low - o) / d, (high - o) / d)
            along -= 1e-6 * (abs(along) + p.size)  # earlier by more than rounding
            # A ray within the plane of a side divides 0 by 0.
            near = dr.maximum(near, dr.select(abs(along) < 1e30, along, near))
        return near

    def more(self, s: tuple) -> Mask:
        """Whether the ray goes on."""
        return s[6] != 0

    def of(self, lanes: UInt32) -> _ProxyStream:
        """The stream of some of the rays."""
        carried = [dr.gather(self.lib.Float, v, lanes) for v in self.ray.carried]
        return _ProxyStream(self.lib, self.proxies, Ray(carried=carried, basis=self.ray.basis), self.order, self.signed)

    def next(self, s: tuple, active: Mask) -> tuple[UInt32, Mask, list, Float, tuple]:
        """One member of the current primitive, or the next primitive (whose members follow)."""
        lib, p, mi = self.lib, self.proxies, self.mi
        if p is None:
            return lib.UInt32(0), lib.Bool(False), [s[0]], lib.Float(EMPTY), s
        count, at, step, last, member, end, some = s
        inside = member < end
        trace = active & ~inside & (some != 0)
        hit = lib.Bool(False)
        primitive = lib.UInt32(0)
        entry = at
        if p.scene is not None:
            o = [dr.fma(d, at, x) for x, d in zip(self.o, self.d, strict=True)]
            ray = mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*[d * p.scale for d in self.d]))
            pi = p.scene.ray_intersect_preliminary(ray, coherent=False, active=trace)
            hit = trace & pi.is_valid()
            primitive = dr.select(hit, pi.prim_index, 0)
            entry = at + dr.select(hit, pi.t, 0) * p.scale
        again = hit & (primitive == last)
        fresh = hit & ~again
        first = dr.gather(lib.UInt32, p.first, primitive, fresh)
        behind = dr.gather(lib.UInt32, p.first, primitive + 1, fresh)
        member, end = dr.select(fresh, first, member), dr.select(fresh, behind, end)
        step = dr.select(again, 2 * step, dr.select(fresh, self.step, step))
        # Far along the ray the step is less than one unit in the last place: 1.2e-7.
        forward = dr.maximum(step, 1.2e-7 * abs(entry))
        at = dr.select(hit, entry + forward, at)
        last = dr.select(fresh, primitive, last)
        some = dr.select(trace & ~hit, 0, some)
        valid = active & (member < end)
        index = dr.gather(lib.UInt32, p.members, member, valid)
        bound = lib.Float(EMPTY)
        if self.order != "center":
            # Listed ones come first, whatever their keys. The factor is the rounding of entries.
            least = self.start + entry
            least -= 1e-4 * abs(least)
            bound = dr.select(last == 0xFFFFFFFF, EMPTY, positive(lib, least) if self.signed else least)
        member = dr.select(valid, member + 1, member)
        return index, valid, [count], bound, (count + 1, at, step, last, member, end, some)


def _coherent(lib: Lib, rays: list[Float]) -> UInt32:
    """Order of rays (o, d) in which neighbors are alike: along a Morton curve of directions and origins."""
    count = dr.width(rays)
    if count <= 16:
        return dr.arange(lib.UInt32, count)
    key = lib.UInt64(0)
    for group, triple in ((3, rays[:3]), (0, rays[3:])):
        low = [dr.min(x) for x in triple]
        sizes = [dr.max(x) - y for x, y in zip(triple, low, strict=True)]
        size = dr.maximum(dr.maximum(sizes[0], sizes[1]), sizes[2])
        scale = dr.select(size > 0, 1023 / size, 0)
        for k, (x, y) in enumerate(zip(triple, low, strict=True)):
            bits = lib.UInt64((x - y) * scale)
            for b in range(10):
                key |= ((bits >> b) & 1) << (6 * b + group + k)
    # Only which rays share a packet: each is composited on its own, so that the image is the same in any order.
    order = lib.UInt32(dr.argsort(key))
    dr.eval(order)
    return order


def _warn_of_rounding(ellipsoids: np.ndarray, alive: np.ndarray, origins: np.ndarray) -> None:
    """Warn of Gaussians too thin, in two of their axes, for hits in float32 world space."""
    to = ellipsoids[:3] - origins.mean(1, keepdims=True)
    a, b, c = ellipsoids[7:]
    middle = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    ratio = (np.sqrt((to * to).sum(0)) / np.maximum(middle, 1e-300))[alive]  # a scale may underflow to 0
    if (share := float((ratio > _FAR_RATIO).sum()) / max(len(ratio), 1)) > 0.01:
        warnings.warn(
            f"render: traversal='bvh' must have extents wider than 1/{_FAR_RATIO:g} of their distance in two axes, "
            f"got {share:.0%} thinner, down to 1/{ratio.max():.1g}; expect errors in their hits or use "
            "traversal='tiles'",
            stacklevel=2,
        )
