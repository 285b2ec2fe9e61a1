"""What stands in a room: every piece as parts, each with its class, in a frame of its own.

A piece stands on z = 0 with its back to y = 0 and its front toward +y, in the middle of x; `room` puts it against a
wall. A part is (class, mesh, bsdf, paint, two_sided), what `scenes.shape` takes, with a class for a name; a sixth entry
is the radiance of a part that shines.
"""

from __future__ import annotations

import numpy as np

from drgs.scenes import box, fabrics, grid, join, ramp, revolve, spline, tube, turned

__all__ = [
    "bookcase", "cabinet", "chair", "coffee_table", "curtain", "door", "flat", "floor_lamp", "moved", "pendant",
    "picture", "plant", "slab", "sofa", "table", "vase", "window",
]  # fmt: skip

MATTE = {"type": "diffuse"}
# Materials as Mitsuba takes them; alpha is the roughness of the microfacets.
SATIN = {"type": "roughplastic", "alpha": 0.35, "nonlinear": True}
GLAZE = {"type": "roughplastic", "alpha": 0.15, "nonlinear": True}
METAL = {"type": "roughplastic", "alpha": 0.25, "nonlinear": True}


def slab(size, center, tile=1.0, turn=0.0, fit=False):
    """A box whose picture repeats every `tile` (width, height) meters on each face, or fills each with `fit`."""
    points, faces, uv, normals = box(size, center, turn)
    x, y, z = size
    uv = uv.copy()
    for k, wide in enumerate(((x, y), (x, y), (x, z), (x, z), (y, z), (y, z))):
        extent = (1.0, 1.0) if fit else np.asarray(wide) / np.broadcast_to(tile, 2)
        uv[4 * k : 4 * k + 4] = np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * extent
    return points, faces, uv, normals


def soft(size, center, power=0.3, repeat=1.0):
    """A cushion: a superellipsoid between a box (power 0) and an ellipsoid (1)."""

    def bent(wave, exponent):
        return np.sign(wave) * np.abs(wave) ** exponent

    up = np.linspace(-np.pi / 2, np.pi / 2, 40)
    around = np.linspace(-np.pi, np.pi, 81)
    level = bent(np.cos(up), power)[:, None]
    parts = level * bent(np.cos(around), power), level * bent(np.sin(around), power), bent(np.sin(up), power)[:, None]
    points = np.stack(np.broadcast_arrays(*parts), -1) * np.asarray(size) / 2
    uv = points[..., :2] / max(size) * repeat + 0.5 + points[..., 2:] / max(size) * repeat * (0.3, 1.0)
    return grid(points + np.asarray(center), closed=True, uv=uv)


def flat(width, height, center, repeat=1.0):
    """A sheet in the plane y = 0 that faces +y, its picture upright as seen from there."""
    x, z = np.meshgrid((width / 2, -width / 2), (-height / 2, height / 2))
    uv = np.stack(np.meshgrid((0, repeat), (0, repeat)), -1)
    return grid(np.stack([x, 0 * x, z], -1) + np.asarray(center), uv=uv)


def moved(mesh, turn, shift):
    """A mesh turned about z by degrees, then shifted."""
    points, faces, uv, normals = mesh
    return turned(points, turn) + np.asarray(shift), faces, uv, turned(normals, turn)


def _legs(width, depth, height, thick, middle):
    corners = [(sx * (width - thick) / 2, sy * (depth - thick) / 2) for sx in (-1, 1) for sy in (-1, 1)]
    return [slab((thick, thick, height), (x, middle + y, height / 2), 0.5) for x, y in corners]


def sofa(rng, color, accents):
    """A sofa of two seats or three, with cushions."""
    seats = int(rng.integers(2, 4))
    wide = 0.64 * seats
    fabric = fabrics.cloth(rng, color, ("plain", "checks", "plain")[rng.integers(3)], 0.85 * np.asarray(color))
    base = [slab((wide + 0.36, 0.78, 0.2), (0, 0.45, 0.2), 0.5), soft((wide + 0.3, 0.24, 0.72), (0, 0.16, 0.5), 0.25)]
    base += [soft((0.2, 0.84, 0.5), (s * (wide / 2 + 0.1), 0.45, 0.34), 0.3, 2) for s in (-1, 1)]
    for k in range(seats):
        x = (k + 0.5) * 0.64 - wide / 2
        base.append(soft((0.63, 0.62, 0.2), (x, 0.55, 0.38), 0.28, 1.5))
        base.append(soft((0.62, 0.22, 0.44), (x, 0.3, 0.66), 0.38, 1.5))
    yield "sofa", join(base), MATTE, fabric
    yield "sofa", join(_legs(wide + 0.2, 0.66, 0.1, 0.05, 0.45)), SATIN, (60, 40, 28)
    for k in range(seats):
        x = (k - (seats - 1) / 2) * wide / seats * 1.12 + rng.uniform(-0.06, 0.06)
        kind = ("stripes", "dots", "zigzag", "checks")[rng.integers(4)]
        mesh = moved(soft((0.42, 0.15, 0.4), (0, 0, 0), 0.55), rng.uniform(-14, 14), (x, 0.5, 0.66))
        yield "cushion", mesh, MATTE, fabrics.cloth(rng, accents[k % len(accents)], kind)


def coffee_table(rng, wood, clay):
    """A low table with books and a vase on it; its middle is at y = 0."""
    wide, deep, top = rng.uniform((0.9, 0.5), (1.15, 0.62)).tolist() + [0.42]
    yield "table", slab((wide, deep, 0.035), (0, 0, top), 0.8), SATIN, wood
    yield "table", slab((wide - 0.12, deep - 0.1, 0.02), (0, 0, 0.14), 0.8), SATIN, wood
    yield "table", join(_legs(wide - 0.06, deep - 0.06, top, 0.05, 0)), SATIN, wood
    z = top + 0.018
    for size, color in (((0.28, 0.2, 0.03), (44, 76, 120)), ((0.24, 0.17, 0.025), (196, 84, 52))):
        mesh = slab(size, (0.22 * wide, 0.02, z + size[2] / 2), 1, rng.uniform(-30, 30))
        yield "book", mesh, SATIN, color
        z += size[2]
    yield from moved_parts(vase(rng, clay, 0.24), 0, (-0.24 * wide, 0, top + 0.018))


def moved_parts(parts, turn, shift):
    """Parts, each `moved`."""
    for name, mesh, *rest in parts:
        yield name, moved(mesh, turn, shift), *rest


def vase(rng, color, height):
    """A glazed vase with bands."""
    belly, neck = rng.uniform((0.26, 0.1), (0.36, 0.16))
    profile = [(0, 0), (0.2, 0), (belly, 0.35), (0.9 * belly, 0.55), (neck, 0.82), (neck + 0.06, 1.0), (neck, 0.99)]
    mesh = revolve(spline(np.array([*profile, (0.8 * neck, 0.7), (0, 0.6)]) * height, 60), segments=48)
    y = np.linspace(0, 1, 128)[:, None].repeat(64, 1)
    paint = ramp(y, color, np.asarray(color) * 0.8 + 50, color)
    for at in (0.52, 0.6, 0.78):
        paint[int(at * 128) : int(at * 128) + 6] = (236, 228, 206)
    yield "vase", mesh, GLAZE, paint


def table(rng, wood):
    """A table for two; its middle is at y = 0."""
    wide, deep = rng.uniform((1.15, 0.72), (1.4, 0.8))
    yield "table", slab((wide, deep, 0.04), (0, 0, 0.73), 0.9), SATIN, wood
    yield "table", join([slab((wide - 0.14, deep - 0.14, 0.07), (0, 0, 0.68), 0.9)]), SATIN, wood
    yield "table", join(_legs(wide - 0.06, deep - 0.06, 0.72, 0.065, 0)), SATIN, wood
    yield from moved_parts(vase(rng, rng.integers(60, 190, 3), 0.3), 0, (rng.uniform(-0.2, 0.2), 0, 0.75))


def chair(wood, seat):
    """A chair; its middle is at y = 0, its front toward +y."""
    frame = _legs(0.42, 0.42, 0.45, 0.04, 0)
    frame += [slab((0.04, 0.035, 0.5), (s * 0.19, -0.2, 0.68), 0.5) for s in (-1, 1)]
    frame += [slab((0.36, 0.025, h), (0, -0.2, z), 0.5) for z, h in ((0.88, 0.09), (0.74, 0.05), (0.62, 0.05))]
    yield "chair", join([*frame, slab((0.44, 0.44, 0.03), (0, 0, 0.445), 0.5)]), SATIN, wood
    yield "chair", soft((0.42, 0.42, 0.06), (0, 0.01, 0.48), 0.35), MATTE, seat


def bookcase(rng, wood, clay):
    """A bookcase of five boards, with rows of books and a vase."""
    wide = rng.uniform(0.9, 1.25)
    deep = 0.3
    high = rng.uniform(1.85, 2.05)
    case = [slab((0.035, deep, high), (s * wide / 2, deep / 2, high / 2), 0.8) for s in (-1, 1)]
    levels = np.linspace(0.08, high - 0.02, 6)
    case += [slab((wide, deep, 0.03), (0, deep / 2, z), 0.8) for z in levels]
    case.append(slab((wide, 0.02, high), (0, 0.01, high / 2), 0.8))
    yield "shelf", join(case), SATIN, wood
    books = []
    empty = int(rng.integers(1, 4))
    for level, z in enumerate(levels[:-1]):
        x = -wide / 2 + 0.04
        end = wide / 2 - 0.06
        end -= rng.uniform(0.1, 0.45) if level != empty else 0.55 * wide
        while x < end:
            thick, tall, long = rng.uniform((0.025, 0.2, 0.16), (0.055, 0.29, 0.22))
            points, faces, uv, normals = slab((thick, long, tall), (x + thick / 2, 0.03 + long / 2, 0), 1, fit=True)
            uv = np.stack([(rng.integers(64) + 0.1 + 0.8 * uv[:, 0]) / 64, uv[:, 1]], 1)
            books.append((points + (0, 0, z + 0.016 + tall / 2), faces, uv, normals))
            x += thick + 0.002
        if level == empty:
            yield from moved_parts(vase(rng, clay, 0.26), 0, (wide / 2 - 0.2, 0.15, z + 0.015))
    yield "book", join(books), SATIN, fabrics.spines(rng)


def cabinet(rng, wood, clay):
    """A sideboard with doors, a vase and books on it."""
    wide = rng.uniform(1.2, 1.5)
    deep = 0.42
    high = 0.72
    yield "cabinet", slab((wide, deep, high - 0.12), (0, deep / 2, high / 2 + 0.06), 0.9), SATIN, wood
    fronts = [
        slab((wide / 3 - 0.03, 0.02, high - 0.18), ((k - 1) * wide / 3, deep, high / 2 + 0.06), 0.9) for k in range(3)
    ]
    yield "cabinet", join(fronts), SATIN, 0.82 * wood
    knobs = [slab((0.02, 0.03, 0.1), ((k - 1) * wide / 3 + 0.12, deep + 0.02, high / 2 + 0.1), 1) for k in range(3)]
    yield "cabinet", join([*knobs, *_legs(wide - 0.1, deep - 0.06, 0.12, 0.04, deep / 2)]), METAL, (50, 42, 36)
    yield from moved_parts(vase(rng, clay, 0.34), 0, (-0.3 * wide, deep / 2, high))
    z = high
    for color in ((150, 44, 40), (226, 206, 150), (50, 90, 84)):
        size = rng.uniform((0.2, 0.16, 0.025), (0.27, 0.2, 0.045))
        yield "book", slab(size, (0.28 * wide, deep / 2, z + size[2] / 2), 1, rng.uniform(-20, 20)), SATIN, color
        z += size[2]


def floor_lamp():
    """A lamp of a foot, a pole and a shade that glows."""
    foot = revolve(np.array([(0.15, 0), (0.15, 0.02), (0.02, 0.035), (0.014, 0.05)]), segments=48)
    at_height = 1.5
    pole = tube(np.array([(0, 0, 0.03), (0, 0, 0.7), (0, 0, at_height)]), 0.013)
    yield "lamp", join([foot, pole]), METAL, (64, 54, 44)
    shade = revolve(
        spline(np.array([(0.19, at_height), (0.17, at_height + 0.14), (0.14, at_height + 0.28)]), 12), segments=48
    )
    top = revolve(np.array([(0.14, at_height + 0.28), (0.0, at_height + 0.281)]), segments=48)
    under = revolve(np.array([(0.0, at_height - 0.001), (0.19, at_height)]), segments=48)
    yield "lamp", join([top, under]), MATTE, (236, 220, 180)
    yield "lamp", shade, MATTE, (220, 200, 160), False, ((2.6, 2.0, 1.2), 0.15)


def pendant():
    """A lamp under the ceiling z = 0, a drum that glows."""
    drum = revolve(np.array([(0.28, -0.172), (0.29, -0.16), (0.29, -0.05), (0.27, -0.04)]), segments=64)
    yield "lamp", drum, MATTE, (236, 226, 204)
    disk = revolve(np.array([(0.0, -0.17), (0.28, -0.17)]), segments=48)
    yield "lamp", disk, MATTE, (230, 226, 214), False, ((24.0, 21.0, 17.0), 0.5)
    yield "lamp", revolve(np.array([(0.1, -0.045), (0.1, 0.0)]), segments=32), METAL, (190, 180, 160)


def plant(rng, clay):
    """A plant of a pot and broad leaves."""
    pot = [(0, 0), (0.13, 0), (0.17, 0.3), (0.18, 0.31), (0.165, 0.31), (0.15, 0.27), (0, 0.26)]
    yield "plant", revolve(np.array(pot), segments=48), SATIN, clay
    leaves, stems = [], []
    for k in range(22):
        turn = 2.4 * k + rng.uniform(-0.3, 0.3)
        lean = rng.uniform(0.08, 0.3)
        high = rng.uniform(0.25, 0.95)
        way = np.array([np.cos(turn), np.sin(turn), 0])
        up = np.array([0, 0, 1.0])
        path = spline(
            np.array([0.27 * up, 0.4 * lean * way + (0.27 + 0.6 * high) * up, lean * way + (0.3 + high) * up]), 10
        )
        stems.append(tube(path, 0.006, 6))
        u, v = np.meshgrid(np.linspace(-1, 1, 7), np.linspace(0, 1, 12))
        wide = rng.uniform(0.06, 0.09) * np.sin(np.pi * np.clip(v, 0.02, 1) ** 0.7)
        blade = (u * wide)[..., None] * np.cross(way, up) + (0.3 * v)[..., None] * (0.9 * way + 0.4 * up)
        leaves.append(grid(blade + (0.6 * wide * u**2 - 0.16 * v**2)[..., None] * up + path[-1]))
    yield "plant", join(stems), MATTE, (84, 110, 56)
    yield "plant", join(leaves), SATIN, fabrics.leaf(rng), True


def picture(rng, kind, width, height, middle):
    """A framed picture on the wall."""
    yield (
        "picture",
        slab((width + 0.07, 0.03, height + 0.07), (0, 0.015, middle), 0.4),
        SATIN,
        rng.integers(30, 110) * np.array([1.0, 0.8, 0.6]),
    )
    yield "picture", flat(width, height, (0, 0.032, middle)), MATTE, fabrics.art(rng, kind)


def door(rng, color):
    """A door of a leaf with panels, its frame and a handle."""
    yield "door", slab((0.86, 0.03, 2.04), (0, 0.02, 1.02), 1, fit=True), SATIN, fabrics.panel(rng, color)
    frame = [slab((0.09, 0.05, 2.12), (s * 0.475, 0.025, 1.06), 1) for s in (-1, 1)]
    yield "door", join([*frame, slab((1.04, 0.05, 0.09), (0, 0.025, 2.085), 1)]), SATIN, 0.92 * np.asarray(color)
    handle = tube(np.array([(0.36, 0.03, 1.0), (0.36, 0.075, 1.0), (0.33, 0.08, 1.0), (0.24, 0.08, 1.0)]), 0.012)
    yield "door", handle, METAL, (70, 62, 52)


def window(rng, width, height, middle, glow):
    """A window of a frame with bars and a sill, and daylight."""
    yield "window", flat(width, height, (0, 0.012, middle)), MATTE, fabrics.outdoors(rng), False, glow
    low = middle - height / 2
    high = middle + height / 2
    bars = [slab((0.07, 0.06, height + 0.14), (s * (width / 2 + 0.03), 0.03, middle), 1) for s in (-1, 1)]
    bars += [slab((width + 0.06, 0.06, 0.07), (0, 0.03, z), 1) for z in (low - 0.03, high + 0.03)]
    bars += [slab((0.045, 0.04, height), (0, 0.03, middle), 1), slab((width, 0.035, 0.035), (0, 0.03, middle + 0.2), 1)]
    yield "window", join(bars), SATIN, (232, 230, 222)
    yield "window", slab((width + 0.24, 0.14, 0.035), (0, 0.07, low - 0.08), 1), SATIN, (226, 222, 212)


def curtain(rng, color, accent, width, top, side):
    """A curtain of one cloth in folds, from a rod at `top` nearly to the floor, left (-1) or right (1) of a window."""
    u, v = np.meshgrid(np.linspace(0, 1, 90), np.linspace(0, 1, 24))
    folds = 0.035 * np.sin(2 * np.pi * 5.5 * u + rng.uniform(0, 6) + 0.5 * v) * (0.6 + 0.4 * v)
    x = side * (width / 2 + 0.14) + (u - 0.5) * 0.44
    sheet = np.stack([x, 0.11 + folds, top - v * (top - 0.06)], -1)
    mesh = grid(sheet, uv=np.stack([u * 1.2, 1 - v * 3], -1))
    yield "curtain", mesh, MATTE, fabrics.cloth(rng, color, "stripes", accent), True
