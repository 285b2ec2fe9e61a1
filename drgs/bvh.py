"""Arbitrary rays through Mitsuba's acceleration structure.

Mitsuba's `ellipsoids` shape is used as a proxy only: it says which Gaussian a ray may meet next, the response is always
evaluated from our own records. What is done about its known faults (Mitsuba 3.9.1):

- the intersection divides by |d| instead of |d|^2: rays are traced with directions as long as the thinnest proxy;
- its discriminant is rounded to about 6e-8 (distance / radius)^2: proxies are not smaller than 1e-3 of their distance;
- rays that start inside a proxy see nothing of it: origins are moved back behind everything they could be inside of;
- the restart behind a hit loses what enters within the step: the step is about one unit in
  the last place, doubled on a repeated hit;
- of coincident proxies only one is found, of nested ones not all: Gaussians with the same center, rotation and shape
  share one primitive, the largest, whose members the stream delivers one by one.
"""

from __future__ import annotations

import warnings

import drjit as dr
import numpy as np

from drgs import runtime
from drgs.tiles import _argsort
from drgs.walk import EMPTY, Part

__all__ = ["Proxies", "proxy_scene"]

_STEP = 1e-8  # of the scene's size
_GRAZE = 1e-7  # of (distance / radius)^2: what rounding takes from the discriminant, with a margin
_FAR = 4e3  # distance / radius from which float32 loses more than 1e-3 of a hit
_THIN = 1e-3  # smallest proxy radius, relative to the distance it is traced over


class Proxies:
    """A Mitsuba scene of proxy ellipsoids.

    Attributes:
        scene: mi.Scene.
        members, first: Gaussian indices grouped by primitive, and the first of each (one more entry than primitives).
        back: How far an origin must be moved back along its ray.
        scale: Length of traced directions.
        step: Restart step.
    """

    def __init__(self, scene, members, first, back, scale, step):
        self.scene, self.members, self.first = scene, members, first
        self.back, self.scale, self.step = back, scale, step


def proxy_scene(t, means, quats, radii, alive, origins, nested: bool = True) -> Proxies | None:
    """Build the proxies, or None when nothing can be hit.

    Args:
        means, quats, radii: (N, 3), (N, 4) wxyz, (N, 3) half axes in world units, NumPy.
        alive: (N,) bool.
        origins: (P, 3) ray origins: decide how far everything can be.
        nested: Ellipsoids that only differ in size share a proxy; otherwise only equal ones do.
    """
    mi = runtime.mitsuba()
    index = np.flatnonzero(alive & np.isfinite(means).all(1) & np.isfinite(radii).all(1))
    if len(index) == 0 or len(origins) == 0:
        return None
    means, quats, radii = means[index], quats[index], radii[index]
    longest = radii.max(1)
    # Rounded: the radii differ by the extents, which are multiplied in.
    shape = np.round(radii / longest[:, None], 9) if nested else radii
    rows = np.ascontiguousarray(np.concatenate([means, quats, shape], 1), np.float64)
    _, primitive, inverse = np.unique(rows.view(np.dtype((np.void, rows.itemsize * 10))).ravel(), True, True)
    grouped = np.argsort(inverse, kind="stable")
    members = index[grouped]
    first = np.concatenate([[0], np.cumsum(np.bincount(inverse, minlength=len(primitive)))])
    growth = np.maximum.reduceat(longest[grouped], first[:-1]) / longest[primitive]
    means, quats, radii = means[primitive], quats[primitive], radii[primitive] * growth[:, None]
    low, high = (means - radii.max(1, keepdims=True)).min(0), (means + radii.max(1, keepdims=True)).max(0)
    far = np.maximum(high - origins.min(0), origins.max(0) - low)
    size = float(np.linalg.norm(np.maximum(far, high - low)))
    # How far a ray may be from a primitive: as far as its farthest origin, plus the move back.
    center = 0.5 * (origins.min(0) + origins.max(0))
    spread = 0.5 * float(np.linalg.norm(origins.max(0) - origins.min(0)))
    distance = np.linalg.norm(means - center, axis=1) + spread
    widest = radii.max(1)
    # Only primitives that an origin can be inside of matter.
    around = widest[distance - widest <= 2 * spread]
    back = 2.0 * float(around.max()) if len(around) else 0.0
    reach = (distance + back)[:, None]
    # Grazing rays are lost to rounding unless the proxy is larger than the Gaussian by as much.
    grown = 1 + 1e-4 + _GRAZE * (reach / np.maximum(radii.min(1, keepdims=True), _THIN * reach)) ** 2
    radii = np.maximum(radii * grown, _THIN * reach)
    norm = np.linalg.norm(quats, axis=1, keepdims=True)
    xyzw = (quats / norm)[:, [1, 2, 3, 0]]
    data = np.concatenate([means, radii, xyzw], 1).astype(np.float32)
    shape = {
        "type": "ellipsoids",
        "centers": mi.TensorXf(data[:, :3]),
        "scales": mi.TensorXf(data[:, 3:6]),
        "quaternions": mi.TensorXf(data[:, 6:]),
        "extent": 1.0,
    }
    scene = mi.load_dict({"type": "scene", "gaussians": shape})
    # Where the scaled direction is longer than a proxy is thick, thick hits are lost as well as grazing ones.
    scale = dr.opaque(t.Float, float(radii.min()))
    step = dr.opaque(t.Float, _STEP * size)
    return Proxies(
        scene,
        t.UInt32(members.astype(np.uint32)),
        t.UInt32(first.astype(np.uint32)),
        dr.opaque(t.Float, back),
        scale,
        step,
    )


class _Stream:
    """Proxies along rays in the order of their entry points."""

    def __init__(self, t, proxies: Proxies, ray, bounded: bool, active):
        self.t, self.proxies, self.bounded, self.active = t, proxies, bounded, active
        self.mi = runtime.mitsuba()
        self.o, self.d = ray.lane[-6:-3], ray.lane[-3:]

    def begin(self):
        """(hits so far, parameter, step, primitive, next member, end of members, something left)."""
        t, p = self.t, self.proxies
        width = dr.width(self.d)
        if p is None:
            return t.UInt32(0), *([t.Float(0)] * 2), *([t.UInt32(0)] * 3), t.UInt32(0)
        some = dr.select(self.active, t.UInt32(1), dr.zeros(t.UInt32, width))
        none = t.UInt32(0xFFFFFFFF)
        return t.UInt32(0), -p.back + dr.zeros(t.Float, width), t.Float(p.step), none, t.UInt32(0), t.UInt32(0), some

    def more(self, s):
        """Whether the ray goes on."""
        return s[6] != 0

    def next(self, s, active):
        """One member of the current primitive, or the next primitive (whose members follow)."""
        t, p, mi = self.t, self.proxies, self.mi
        if p is None:
            return t.UInt32(0), t.Bool(False), t.Float(EMPTY), s
        count, at, step, last, member, end, some = s
        inside = member < end
        trace = active & ~inside & (some != 0)
        o = [dr.fma(d, at, x) for x, d in zip(self.o, self.d, strict=True)]
        ray = mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*[d * p.scale for d in self.d]))
        pi = p.scene.ray_intersect_preliminary(ray, coherent=False, active=trace)
        found = trace & pi.is_valid()
        primitive = dr.select(found, pi.prim_index, 0)
        again = found & (primitive == last)
        fresh = found & ~again
        entry = at + dr.select(found, pi.t, 0) * p.scale
        first, behind = (
            dr.gather(t.UInt32, p.first, primitive, fresh),
            dr.gather(t.UInt32, p.first, primitive + 1, fresh),
        )
        member, end = dr.select(fresh, first, member), dr.select(fresh, behind, end)
        step = dr.select(again, 2 * step, dr.select(fresh, p.step, step))
        # Far along the ray the step is less than one unit in the last place.
        forward = dr.maximum(step, 1.2e-7 * abs(entry))
        at = dr.select(found, entry + forward, at)
        last = dr.select(fresh, primitive, last)
        some = dr.select(trace & ~found, 0, some)
        valid = active & (member < end)
        index = dr.gather(t.UInt32, p.members, member, valid)
        bound = dr.maximum(entry, 0) * (1 - 1e-5) if self.bounded else t.Float(EMPTY)
        member = dr.select(valid, member + 1, member)
        return index, valid, bound, (count + 1, at, step, last, member, end, some)


def parts_of(view, model, buffer, ray_of, share):
    """All rays of a view as one part."""
    t, s = view.t, view.settings
    i = dr.arange(t.UInt32, view.pixels)
    inside = t.Bool(True) if view.pixels else t.Bool(False)
    ray = ray_of(None, None, i, t.Bool(True))
    if "proxies" not in view.extra:
        view.extra["proxies"] = None
        view.proxies = _build(view, ray)

    def stream_of(lanes):
        r = ray if lanes is None else type(ray)(lane=[dr.gather(t.Float, v, lanes) for v in ray.lane], basis=ray.basis)
        return _Stream(t, view.proxies, r, s.order == "ray", t.Bool(True))

    center = view.projected.key if s.order == "center" else None
    if center is not None and s.depth_key == "z":
        # Behind the camera plane z is negative, which no order key may be: the rank orders as well.
        center = dr.zeros(t.Float, dr.width(view.projected.key))
        rank = dr.arange(t.UInt32, dr.width(center))
        dr.scatter(center, t.Float(rank), _argsort(t, view.projected.key, rank))
    return [Part(t, model, buffer, [ray], [i], [inside], stream_of, s.order != "entry", center)]


def _build(view, ray):
    """Proxies of the view's ellipsoids, for rays with these origins."""
    dr.eval(view.projected.ellipsoids, view.projected.alive)
    ellipsoids = np.stack([x.numpy() for x in view.projected.ellipsoids], 1)
    origins = np.stack([v.numpy() for v in ray.lane[-6:-3]], 1).astype(np.float64)
    alive = view.projected.alive.numpy() & np.ones(len(ellipsoids), bool)
    _warn_of_rounding(ellipsoids[alive], origins)
    nested = view.settings.order != "entry"
    return proxy_scene(view.t, ellipsoids[:, :3], ellipsoids[:, 3:7], ellipsoids[:, 7:], alive, origins, nested)


def _warn_of_rounding(ellipsoids, origins):
    """Tell of Gaussians too thin, in two of their axes, for hits in float32 world space."""
    if len(ellipsoids) == 0 or len(origins) == 0:
        return
    distance = np.linalg.norm(ellipsoids[:, :3] - 0.5 * (origins.min(0) + origins.max(0)), axis=1)
    ratio = distance / np.maximum(np.median(ellipsoids[:, 7:], axis=1), 1e-300)
    share = float((ratio > _FAR).mean())
    if share > 0.01:
        warnings.warn(
            f"render: traversal='bvh' must have Gaussians wider than 1/{_FAR:g} of their distance in two axes, got "
            f"{share:.0%} thinner, down to 1/{ratio.max():.1g}; expect errors in their hits or use traversal='tiles'",
            stacklevel=2,
        )
