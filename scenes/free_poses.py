"""Poses as a robot may choose them: anywhere in the free space of a scene, looking anywhere.

Scenes are in meters with +z up.
"""

from __future__ import annotations

import numpy as np

from drgs import scenes

__all__ = ["CLEARANCE", "distances", "free_poses"]

CLEARANCE = 0.35
"""Meters between a camera and the nearest surface, at least; but for those that look at one from near."""

_NEAR = 0.2  # meters from what these are in front of
_STEEPEST = 0.98  # sine of the largest elevation: 11 degrees around straight up and down are left out


def free_poses(built, box, views, rng):
    """Camera-to-world matrices (views, 4, 4): at uniform places in free space, in uniform directions of the sphere.

    About a third are 20 cm in front of what is there, a wall, the ceiling, a window, a thing, and look at it; the
    others are at least `CLEARANCE` from everything and from the sides of the box. None looks to where nothing is, nor
    within 11 degrees of straight up or down.

    Args:
        built: Mitsuba scene, with what moves in it where it is at the time of the views.
        box: (2, 3) lowest and highest corner of where a camera may be, in meters.
        views: Number of poses.
        rng: Generator that they are drawn from.
    """
    low, high = np.asarray(box, float)
    poses = []
    while len(poses) < views:
        eye, forward = rng.uniform(low + CLEARANCE, high - CLEARANCE), rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        is_near = rng.uniform() < 1 / 3
        if abs(forward[2]) > _STEEPEST or not _is_free(built, eye, CLEARANCE):
            continue
        ahead = distances(built, eye, forward[None])[0][0]
        if not np.isfinite(ahead):
            continue
        if is_near:
            eye = eye + (ahead - _NEAR) * forward
            if (eye < low).any() or (eye > high).any() or not _is_free(built, eye, _NEAR / 2):
                continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = scenes.axes(forward), eye
        poses.append(pose)
    return np.stack(poses)


def distances(built, eye, ways=None):
    """Of the first surfaces around a place: distances (K,), infinite where none is, and whether their front is seen.

    Args:
        built: Mitsuba scene.
        eye: (3,) place.
        ways: Unit vectors (K, 3); default 400 that are spread evenly.
    """
    import drjit as dr
    import mitsuba as mi

    ways = _around() if ways is None else ways
    x, y, z = np.ascontiguousarray(ways.T, np.float32)
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in eye))  # a literal is another kernel in each place
    hit = built.ray_intersect(mi.Ray3f(origin, mi.Vector3f(mi.Float(x), mi.Float(y), mi.Float(z))))
    return hit.t.numpy(), -(np.array(hit.n).T * ways).sum(1) > 0


def _is_free(built, eye, clearance):
    """Whether everything around a place is so many meters away, and it is not inside of anything."""
    distance, is_front = distances(built, eye)
    is_front |= ~np.isfinite(distance)
    return distance.min() > clearance and is_front.mean() > 0.9


def _around():
    """400 unit vectors that are spread evenly."""
    k = np.arange(400) + 0.5
    z = 1 - 2 * k / 400
    around = np.pi * (1 + 5**0.5) * k
    level = np.sqrt(1 - z**2)
    return np.stack([level * np.cos(around), level * np.sin(around), z], 1)
