"""Mitsuba scenes of things that have classes: what the room and the kitchen have in common."""

from __future__ import annotations

import numpy as np

from drgs import runtime, scenes

__all__ = ["build", "class_file", "intrinsics"]


def build(parts, classes, lights=None):
    """A scene, and the class of each of its shapes.

    Args:
        parts: Arguments of `scenes.shape` of each part, whose names are classes; the k-th one has the identifier
            `part{k:03d}`.
        classes: Names of the classes, of which labels are the numbers from 1.
        lights: Dict of what else is in the scene, as `mi.load_dict` takes it; a shape that is called as a class is of
            that class.
    Returns:
        The Mitsuba scene, and (numbers,) uint8 labels by Dr.Jit's number of a shape, as `scenes.first_hits` gives it;
        0 for other lights and for none.
    """
    mi = runtime.mitsuba()
    import drjit as dr

    content = {"type": "scene"}
    materials = {}
    for k, (name, mesh, bsdf, paint, *rest) in enumerate(parts):
        # Pictures are distinguished by their identity: `parts` keeps them all.
        color = tuple(paint) if np.ndim(paint) == 1 else id(paint)
        key = bsdf["type"], bsdf.get("alpha"), color, bool(rest and rest[0])
        if key not in materials:
            materials[key] = scenes.material(bsdf, paint, *rest[:1])
        content[f"part{k:03d}"] = scenes.shape(name, mesh, materials[key], paint, *rest)
    scene = mi.load_dict(content | (lights or {}))
    numbers = {shape.id(): int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()}
    table = np.zeros(max(numbers.values()) + 1, np.uint8)
    for k, (name, *_) in enumerate(parts):
        table[numbers[f"part{k:03d}"]] = classes.index(name) + 1
    for name in set(lights or {}) & set(classes):
        table[numbers[name]] = classes.index(name) + 1
    return scene, table


def intrinsics(width, height, fov_x):
    """K (3, 3) in pixels of a field of view of `fov_x` degrees across the width."""
    focal = 0.5 * width / np.tan(np.radians(fov_x) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def class_file(classes):
    """The content of classes.json."""
    return {"unlabelled": 0, "classes": [{"id": k + 1, "name": name} for k, name in enumerate(classes)]}
