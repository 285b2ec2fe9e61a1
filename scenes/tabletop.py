"""What stands still in the kitchen: worktop, tiled wall, rail, and the things that are used for cooking.

World: meters, +z up, the worktop at z = 0; the tiled wall is the plane y = `WALL`, cameras look at it from -y.
"""

from __future__ import annotations

import numpy as np

from drgs.scenes import fabrics, grid, join, mix, noise, ramp, revolve, spline, tube
from drgs.scenes.furniture import GLAZE, MATTE, METAL, SATIN, moved, moved_parts, slab
from drgs.scenes.moving import LEMON

__all__ = ["SIDE", "WALL", "board", "bottle", "bowl", "canister", "herbs", "lemon", "plate", "rail", "shell"]

WALL = 0.40  # y of the tiles
RAIL = 0.335  # height of the rail
SIDE = 1.5  # x of the side walls
_TILES = (
    ((214, 222, 218), (64, 112, 148)),
    ((226, 214, 190), (170, 84, 58)),
    ((196, 212, 196), (54, 104, 82)),
    ((222, 220, 214), (196, 148, 52)),
)
_WORKTOPS = (
    ("wood", ((122, 78, 46), (170, 116, 72), (202, 152, 104))),
    ("stone", ((62, 66, 72), (104, 108, 112), (150, 152, 150))),
    ("wood", ((84, 54, 38), (120, 80, 54), (150, 106, 74))),
    ("stone", ((168, 160, 148), (204, 196, 182), (226, 220, 208))),
)


def shell(rng, style):
    """Worktop, tiled wall and side walls; `style` chooses among the pictures."""
    kind, colors = _WORKTOPS[style % len(_WORKTOPS)]
    paint = fabrics.planks(rng, colors).transpose(1, 0, 2) if kind == "wood" else _stone(rng, colors)
    yield "worktop", slab((2 * SIDE, 1.05, 0.05), (0, WALL - 0.525, -0.025), 0.9), SATIN, paint
    base, accent = _TILES[(style // 2 + style) % len(_TILES)]
    x, z = np.meshgrid((SIDE, -SIDE), (0.0, 0.9))
    sheet = grid(np.stack([-x, 0 * x + WALL, z], -1))
    yield "wall", sheet, SATIN, _tiles(rng, base, accent)
    plain = fabrics.plaster(rng, 0.92 * np.asarray(base), "plain")
    for side in (-1, 1):
        yield "wall", slab((0.05, 1.6, 1.0), (side * (SIDE + 0.025), WALL - 0.8, 0.45), 1.0), MATTE, plain


def _stone(rng, colors, size=768):
    """Speckled stone."""
    out = ramp(0.7 * noise(rng, size, size, 7, 4) + 0.3 * noise(rng, size, size, 60, 2), *colors)
    for color, above in ((np.asarray(colors[2]) * 1.08, 0.80), (np.asarray(colors[0]) * 0.75, 0.84)):
        out = mix(out, color, 0.6 * np.clip(12 * (noise(rng, size, size, 70, 1) - above), 0, 1))
    return out


def _tiles(rng, base, accent, side=40, across=30, up=9):
    """Square tiles of 10 cm with joints, each a little different; every fourth or so is decorated."""
    import cv2

    base, accent = np.asarray(base, np.float32), np.asarray(accent, np.float32)
    height, width = up * side, across * side
    tone = np.kron(rng.uniform(0.90, 1.06, (up, across)), np.ones((side, side)))[..., None]
    out = ramp(noise(rng, height, width, 90, 4), 0.94 * base, 1.04 * base) * tone
    for i in range(up):
        for j in range(across):
            x = j * side + side // 2
            y = i * side + side // 2
            kind = (3 * i + 2 * j + int(rng.integers(2))) % 7
            ink = tuple((accent * rng.uniform(0.85, 1.15)).tolist())
            if kind == 0:
                cv2.circle(out, (x, y), 13, ink, 3, cv2.LINE_AA)
                cv2.circle(out, (x, y), 5, ink, -1, cv2.LINE_AA)
            elif kind == 3:
                for angle in (45, 135, 225, 315):
                    tip = (x + int(9 * np.cos(np.radians(angle))), y + int(9 * np.sin(np.radians(angle))))
                    cv2.ellipse(out, tip, (8, 4), angle, 0, 360, ink, -1, cv2.LINE_AA)
            elif kind == 5:
                out[y - side // 2 : y + side // 2, x - side // 2 : x + side // 2] *= 0.55 + 0.45 * accent / 255
    joint = (np.arange(width) % side < 2)[None] | (np.arange(height) % side < 2)[:, None]
    out[joint] = 0.62 * base
    return out


def rail(rng, accent):
    """A rail on the wall with a ladle, a whisk and a spatula; their order is drawn."""
    y = WALL - 0.045
    bar = tube(np.array([(-0.72, y, RAIL), (0, y, RAIL), (0.72, y, RAIL)]), 0.007)
    ends = [
        tube(np.array([(x, y, RAIL), (x, y + 0.02, RAIL), (x, WALL + 0.01, RAIL)]), 0.006) for x in (-0.7, 0.0, 0.7)
    ]
    yield "rail", join([bar, *ends]), METAL, (120, 118, 112)
    for x, kind in zip((-0.52, -0.40, 0.42, 0.56), rng.permutation(4), strict=True):
        yield from moved_parts(_utensil(kind, accent), 0, (x + rng.uniform(-0.02, 0.02), y - 0.012, RAIL))


def _utensil(kind, accent):
    """A spatula, ladle, whisk or spoon that hangs from z = 0."""
    handle = tube(np.array([(0, 0, 0.005), (0, 0, -0.05), (0, 0, -0.12)]), 0.0075)
    yield "utensil", handle, SATIN, accent if kind % 2 else (70, 44, 28)
    neck = tube(np.array([(0, 0, -0.11), (0, 0, -0.16), (0, 0, -0.19)]), 0.0035)
    if kind == 0:
        head = [slab((0.06, 0.004, 0.075), (0, 0, -0.222), 1)]
    elif kind == 1:
        cup = revolve(spline(np.array([(0, -0.03), (0.026, -0.022), (0.034, 0), (0.031, 0.0), (0.0, -0.024)]), 30))
        head = [moved(cup, 0, (0, -0.02, -0.2))]
    elif kind == 2:
        v = np.linspace(0, np.pi, 24)
        ring = np.stack([0.028 * np.sin(v), 0 * v, -0.15 - 0.1 * (1 - np.cos(v)) / 2], 1)
        head = [moved(tube(ring, 0.0018, 8), turn, (0, 0, 0)) for turn in range(0, 360, 60)]
    else:
        v = np.linspace(-np.pi / 2, np.pi / 2, 24)
        oval = revolve(np.stack([0.026 * np.cos(v), 0.04 * np.sin(v)], 1), segments=32)
        head = [(oval[0] * (1, 0.3, 1) + (0, 0, -0.22), *oval[1:])]
    yield "utensil", join([neck, *head]), METAL, (170, 172, 176) if kind else (62, 62, 66)


def board(rng, spot, wood):
    """A board for cutting at `spot` (x, y), 14 mm thick."""
    yield "board", slab((0.25, 0.2, 0.014), (*spot, 0.007), 0.3, rng.uniform(-18, 18)), SATIN, wood


def lemon(rng, place, scale=1.0):
    """A lemon that lies at `place` (x, y, z of its middle)."""
    phi = np.linspace(-np.pi / 2, np.pi / 2, 40)
    r, h = np.cos(phi), np.sin(phi)
    profile = (
        scale * LEMON * np.stack([r * (1 - 0.25 * np.abs(h) ** 6), 1.25 * h + 0.12 * np.sign(h) * np.abs(h) ** 9], 1)
    )
    paint = ramp(noise(rng, 128, 256, 50, 3), (212, 168, 24), (240, 208, 60), (250, 226, 104))
    paint[:8] = paint[-8:] = (150, 150, 44)
    yield "lemon", revolve(profile, place, (90, 0, rng.uniform(-180, 180)), segments=48), SATIN, paint


def plate(rng, spot, color, accent):
    """The plate under the jelly at `spot` (x, y)."""
    profile = [(0, 0), (0.07, 0), (0.085, 0.004), (0.128, 0.013), (0.13, 0.016), (0.118, 0.0145), (0.09, 0.0115)]
    mesh = revolve(spline(np.array([*profile, (0, 0.0115)]), 60), (*spot, 0), segments=96)
    v = np.linspace(1, 0, 256)[:, None].repeat(64, 1)
    paint = ramp(noise(rng, 256, 64, 8, 3), 0.95 * np.asarray(color), color)
    for low, high in ((0.40, 0.43), (0.50, 0.56)):
        paint[(v > low) & (v < high)] = accent
    yield "plate", mesh, GLAZE, paint


def canister(rng, place, color, accent, text):
    """Earthenware with a lid of wood and a word on it, at `place` (x, y)."""
    import cv2

    high = rng.uniform(0.17, 0.21)
    profile = [(0, 0), (0.055, 0), (0.062, 0.008), (0.062, 0.9 * high), (0.057, high), (0, high)]
    paint = ramp(noise(rng, 256, 512, 14, 5), 0.9 * np.asarray(color), 1.04 * np.asarray(color))
    accent = tuple(float(v) for v in accent)
    for y in (86, 200):
        cv2.line(paint, (0, y), (512, y), accent, 7)
    for x in (116, 372):  # faces the cameras whichever way it is turned
        paint = _lettered(paint, text, (x - 84, 160), 1.7, 4, accent)
    mesh = revolve(np.array(_fine(profile)), segments=72)
    yield "canister", moved(mesh, rng.uniform(-15, 15) + 8, (*place, 0)), GLAZE, paint
    lid = revolve(spline(np.array([(0.06, high), (0.06, high + 0.016), (0.014, high + 0.02), (0, high + 0.04)]), 30))
    yield "canister", moved(lid, 0, (*place, 0)), SATIN, fabrics.wood(rng, (92, 56, 32), (172, 116, 70), 128)


def _lettered(paint, text, at, size, thick, ink):
    """A picture with a word in it."""
    import cv2

    mask = np.zeros(paint.shape[:2], np.uint8)
    cv2.putText(mask, text, at, cv2.FONT_HERSHEY_DUPLEX, size, 255, thick, cv2.LINE_AA)
    return mix(paint, ink, mask / 255.0)


def _fine(profile, each=8):
    """A profile with more points on its straight parts."""
    rows = [np.linspace(a, b, each, endpoint=False) for a, b in zip(profile[:-1], profile[1:], strict=True)]
    return [*np.concatenate(rows), np.asarray(profile[-1], float)]


def bottle(rng, place, color):
    """Oil, with a label and a cork, at `place` (x, y)."""
    profile = [(0, 0), (0.034, 0), (0.037, 0.006), (0.037, 0.13), (0.033, 0.165), (0.014, 0.2), (0.0125, 0.255)]
    profile = _fine([*profile, (0.015, 0.256), (0.015, 0.266), (0.0, 0.266)])
    mesh = revolve(np.array(profile), segments=64)
    paint = ramp(noise(rng, 512, 256, 5, 3), 0.8 * np.asarray(color), 1.2 * np.asarray(color))
    v = np.linspace(1, 0, 512)
    rows = np.flatnonzero((v > 0.24) & (v < 0.32))
    paint[rows] = (228, 216, 184)
    for x in (30, 158):
        paint = _lettered(paint, "OLIO", (x, int(rows.mean()) + 9), 0.9, 2, (96, 40, 24))
    yield "bottle", moved(mesh, rng.uniform(0, 360), (*place, 0)), GLAZE, paint
    yield "bottle", revolve(np.array([(0.011, 0.26), (0.011, 0.285), (0, 0.286)]), (*place, 0)), MATTE, (176, 132, 88)


def bowl(rng, place, color, accent):
    """Three lemons in a bowl at `place` (x, y)."""
    profile = [(0, 0), (0.04, 0), (0.045, 0.008), (0.075, 0.035), (0.098, 0.075), (0.095, 0.077), (0.07, 0.04)]
    mesh = revolve(spline(np.array([*profile, (0.04, 0.016), (0, 0.014)]), 60), (*place, 0), segments=80)
    v = np.linspace(1, 0, 256)[:, None].repeat(256, 1)
    u = np.linspace(0, 2 * np.pi, 256)[None]
    paint = mix(np.full((256, 256, 3), color, np.float32), accent, np.clip(30 * (np.sin(14 * u + 30 * v) - 0.5), 0, 1))
    paint *= (0.92 + 0.12 * noise(rng, 256, 256, 30, 3))[..., None]
    yield "bowl", mesh, GLAZE, paint
    for k in range(3):
        way = 2 * np.pi * (k / 3 + rng.uniform(-0.05, 0.05))
        at = (place[0] + 0.042 * np.cos(way), place[1] + 0.042 * np.sin(way), 0.066)
        yield from lemon(rng, at, 1.05)


def herbs(rng, place, clay):
    """Basil in a pot at `place` (x, y)."""
    pot = spline(
        np.array([(0, 0), (0.044, 0), (0.06, 0.085), (0.064, 0.088), (0.064, 0.1), (0.055, 0.1), (0, 0.088)]), 50
    )
    paint = ramp(noise(rng, 128, 256, 20, 4), 0.85 * np.asarray(clay), 1.1 * np.asarray(clay))
    yield "plant", revolve(pot, (*place, 0), segments=56), MATTE, paint
    leaves, stems = [], []
    for k in range(34):
        turn = 2.4 * k
        lean = rng.uniform(0.01, 0.075)
        high = rng.uniform(0.03, 0.13)
        way = np.array([np.cos(turn), np.sin(turn), 0])
        path = spline(
            np.array([(0, 0, 0.085), 0.5 * lean * way + (0, 0, 0.09 + 0.6 * high), lean * way + (0, 0, 0.09 + high)]), 8
        )
        stems.append(tube(path + (*place, 0), 0.002, 6))
        u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 1, 7))
        wide = 0.019 * np.sin(np.pi * np.clip(v, 0.03, 1) ** 0.8)
        across = np.cross(way, (0, 0, 1.0))
        blade = (u * wide)[..., None] * across + (0.05 * v)[..., None] * (0.8 * way + (0, 0, 0.35))
        leaves.append(grid(blade + (0.3 * wide * u**2 - 0.02 * v**2)[..., None] * (0, 0, 1.0) + path[-1] + (*place, 0)))
    yield "plant", join(stems), MATTE, (84, 110, 56)
    yield "plant", join(leaves), SATIN, fabrics.leaf(rng), True
