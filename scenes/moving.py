"""What moves on the kitchen's table-top: meshes of constant topology whose vertices are functions of the time.

A time is a float in [0, 1], over the sequence. Each thing has a motion of its own kind: the mug slides and turns, the
orange rolls without slipping, both rigid; the tongs are articulated, two arms on one pin that close on a lemon and
open again; the jelly and the towel deform, one wobbles on its plate, the other sways in a draft. What they are made of
is drawn from the generator `rng`, and so are paths, amplitudes, frequencies and phases.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from drgs.scenes import fabrics, grid, mix, noise, ramp, revolve, spline, tube
from drgs.scenes.furniture import GLAZE, MATTE, METAL, SATIN

__all__ = ["MOVING", "Mover", "jelly", "mug", "orange", "rigid", "rotation", "tongs", "towel"]

MOVING = ("mug", "orange", "tongs", "jelly", "towel")
ORANGE = 0.044  # radius in meters
JELLY = 0.115  # height in meters, at rest
_UP = np.array([0.0, 0.0, 1.0])
_ARM = 0.205  # meters from the pin of the tongs to the tips
LEMON = 0.031  # radius of what the tongs close on, in meters


@dataclasses.dataclass(frozen=True)
class Mover:
    """A part that moves.

    Attributes:
        name: Class of the part.
        at: Function of a time in [0, 1]: the mesh (`scenes.grid`'s four arrays); faces and texture coordinates stay.
        bsdf, paint, two_sided: Arguments of `scenes.shape`.
    """

    name: str
    at: Callable[[float], tuple]
    bsdf: dict
    paint: object
    two_sided: bool = False


def rotation(vector):
    """(3, 3) of a rotation vector in radians."""
    import cv2

    return cv2.Rodrigues(np.asarray(vector, np.float64))[0]


def _posed(mesh, pose):
    """A mesh under a pose (rotation (3, 3), shift (3,))."""
    points, faces, uv, normals = mesh
    rotation, shift = pose
    return points @ rotation.T + shift, faces, uv, normals @ rotation.T


def rigid(mesh, pose):
    """`at` of a mesh whose pose is a function of the time."""
    return lambda time: _posed(mesh, pose(time))


def _wave(rng, low, high):
    """A sine of the time, of `low` to `high` periods in the sequence, with a phase that is drawn."""
    periods = rng.uniform(low, high)
    phase = rng.uniform(0, 2 * np.pi)
    return lambda time: np.sin(2 * np.pi * periods * time + phase)


# ---------------------------------------------------------------------------------- rigid
def mug(rng, spot, color, accent):
    """A mug that slides on a small ellipse around `spot` (x, y) and turns, back and forth."""
    profile = [(0, 0), (0.036, 0), (0.043, 0.005), (0.046, 0.03), (0.045, 0.085), (0.048, 0.108), (0.046, 0.11)]
    body = revolve(spline(np.array([*profile, (0.042, 0.09), (0.041, 0.02), (0.036, 0.009), (0, 0.008)]), 80))
    curve = [(0.044, 0, 0.09), (0.07, 0, 0.092), (0.083, 0, 0.06), (0.068, 0, 0.03), (0.044, 0, 0.026)]
    handle = tube(spline(np.array(curve), 28), 0.007)
    radii = rng.uniform((0.04, 0.03), (0.05, 0.045))
    start = rng.uniform(0, 360)
    slide, spin = _wave(rng, 0.8, 1.2), _wave(rng, 0.7, 1.1)

    def pose(time):
        angle = np.radians(start + 130 * slide(time))
        shift = np.array([*(spot + radii * (np.cos(angle), np.sin(angle))), 0.0])
        return rotation(np.radians(start + 110 * spin(time)) * _UP), shift

    yield Mover("mug", rigid(body, pose), GLAZE, _glaze(rng, color, accent))
    yield Mover("mug", rigid(handle, pose), GLAZE, accent)


def _glaze(rng, color, accent, height=256, width=512):
    """A mug's picture; its outer side is the lower half: bands, and dots, diamonds or leaves between them."""
    import cv2

    out = ramp(noise(rng, height, width, 20, 3), 0.93 * np.asarray(color), 1.03 * np.asarray(color))
    accent = tuple(float(v) for v in accent)
    kind = rng.integers(3)
    for y, thick in ((0.87, 8), (0.82, 3), (0.58, 3), (0.52, 9)):
        cv2.line(out, (0, int(y * height)), (width, int(y * height)), accent, thick)
    for k in range(10):
        x = int((k + 0.5) * width / 10)
        y = int(0.72 * height)
        if kind == 0:
            cv2.circle(out, (x, y), 17, accent, -1, cv2.LINE_AA)
            cv2.circle(out, (x, y), 8, (240, 230, 205), -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.fillPoly(out, [np.array([(x - 20, y), (x, y - 24), (x + 20, y), (x, y + 24)])], accent)
        else:
            for angle in (35, 90, 145):
                cv2.ellipse(out, (x, y + 6), (22, 6), angle, 0, 360, accent, -1, cv2.LINE_AA)
    cv2.rectangle(out, (0, int(0.60 * height)), (26, int(0.84 * height)), (206, 160, 60), -1)  # one side is marked
    return out


def orange(rng, start, end):
    """An orange that rolls from `start` to `end` (x, y) and back, without slipping."""
    phi = np.linspace(-np.pi / 2, np.pi / 2, 48)
    ball = revolve(ORANGE * np.stack([np.cos(phi), np.sin(phi)], 1), turn=(90, 25, 0), segments=64)
    start = np.asarray(start)
    end = np.asarray(end)
    roll = _wave(rng, 0.45, 0.65)
    way = (end - start) / np.linalg.norm(end - start)
    axis = np.cross(_UP, [*way, 0.0])
    way_length = np.linalg.norm(end - start)

    def pose(time):
        along = way_length * (0.5 + 0.5 * roll(time))
        return rotation(along / ORANGE * axis), np.array([*(start + along * way), ORANGE])

    yield Mover("orange", rigid(ball, pose), SATIN, _peel(rng))


def _peel(rng, height=256, width=512):
    """Orange skin with pores, darker toward its ends, and a sticker."""
    import cv2

    y = np.linspace(-1, 1, height)[:, None]
    out = ramp(
        np.clip(noise(rng, height, width, 8, 5) - 0.3 * y**4, 0, 1), (196, 84, 8), (232, 124, 20), (246, 152, 44)
    )
    for x, y, tone in rng.integers((0, 8, 0), (width, height - 8, 60), (2200, 3)):
        cv2.circle(out, (int(x), int(y)), 1, (170 + int(tone), 76 + int(tone), 10), -1)
    cv2.circle(out, (width // 2, height // 2), 30, (30, 84, 52), -1, cv2.LINE_AA)
    cv2.circle(out, (width // 2, height // 2), 21, (244, 226, 120), -1, cv2.LINE_AA)
    cv2.circle(out, (width // 8, height // 2), 20, (112, 58, 10), -1, cv2.LINE_AA)
    cv2.circle(out, (0, 8), 14, (70, 92, 30), -1)
    out[:12] = (84, 104, 36)
    return out


# ---------------------------------------------------------------------------- articulated
def tongs(rng, spot, accent):
    """Tongs of two arms on a pin that close on what lies at `spot` (x, y), open, and are lifted a little meanwhile."""
    turn = np.radians(rng.uniform(-25, 25))
    lean = np.radians(rng.uniform(12, 26) * (1 if rng.random() < 0.5 else -1))
    base = rotation(turn * _UP) @ rotation((lean, 0, 0))
    grasp = _wave(rng, 1.6, 2.2)
    lift = _wave(rng, 0.8, 1.1)
    rock = _wave(rng, 0.7, 1.0)
    tip = np.array([*spot, LEMON])
    closed = np.arcsin((LEMON + 0.004) / _ARM)

    def pose(time):
        tilt = rotation(0.12 * rock(time) * _UP) @ base
        return tilt, tip + tilt @ (0, 0, 0.97 * _ARM) + (0, 0, 0.014 * (1 + lift(time)))

    def arm(side):
        mesh = _arm(side)
        half = np.radians(10.5)

        def at(time):
            open_by = rotation((0, -side * (closed + half * (1 + grasp(time))), 0))
            tilt, shift = pose(time)
            return _posed(mesh, (tilt @ open_by, shift))

        return at

    steel = ramp(noise(rng, 256, 64, 4, 4, stretch=0.2), (128, 130, 134), (196, 198, 202))
    v = np.linspace(1, 0, 256)
    steel[v < 0.24] = accent  # tips of silicone
    steel[(v > 0.5) & (v < 0.9) & ((v * 20).astype(int) % 2 > 0)] = 0.55 * np.asarray(accent) + 20  # grips
    for side in (-1, 1):
        yield Mover("tongs", arm(side), METAL, steel)
    around = np.linspace(0, np.pi, 20)
    ring = np.stack([0.012 * np.cos(around), 0 * around, 0.012 * np.sin(around) + 0.004], 1)
    yield Mover("tongs", rigid(tube(ring, 0.006), pose), METAL, (90, 92, 96))


def _arm(side):
    """One arm of the tongs: a bowed strip from its tip, below, to the pin at the origin; `side` is where it bows to."""
    v = np.linspace(0, 1, 40)
    angle = np.linspace(0, 2 * np.pi, 21)
    wide = 0.014 + 0.007 * np.exp(-(((v - 0.07) / 0.09) ** 2))
    wide[[0, -1]] *= 0.4
    thick = np.where(v < 0.22, 0.0075, 0.005)
    bow = 0.024 * np.sin(np.pi * v) ** 0.9 * (v > 0) - 0.004 * (v < 0.02)
    x = side * bow[:, None] + thick[:, None] * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6
    y = wide[:, None] * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.6
    z = (_ARM * (v - 1))[:, None] + 0 * angle
    return grid(np.stack([x, y, z], -1), closed=True)


# ------------------------------------------------------------------------------ deforming
def jelly(rng, spot, colors):
    """A jelly that wobbles on its plate at `spot` (x, y): squashed at constant volume, sheared and twisted."""
    profile = [(0.098, 0.0), (0.1, 0.008), (0.094, 0.04), (0.083, 0.075), (0.066, 0.1), (0.045, 0.112)]
    profile = spline(np.array([*profile, (0.02, JELLY), (0, JELLY)]), 60)
    lobes = int(rng.integers(8, 13))
    angle = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    fluting = 0.055 * np.cos(lobes * angle)[None] * np.clip(1.6 - 1.6 * profile[:, 1:] / JELLY, 0, 1)
    rest = revolve(profile, segments=96, bumps=fluting)
    shape = (60, 97)
    uv = rest[2].reshape(60, 97, 2)
    squash, shear_x, shear_y, twist = (_wave(rng, *r) for r in ((2.0, 2.6), (1.4, 2.0), (1.0, 1.6), (0.8, 1.4)))
    much = rng.uniform((0.12, 0.2, 0.12, 0.25), (0.17, 0.3, 0.2, 0.45))

    def at(time):
        x, y, z = rest[0].T
        h = z / JELLY
        strain = much[0] * squash(time)
        stretch = 1 + strain * np.clip(2 * h, 0, 1)  # the foot sticks to the plate
        turn = much[3] * twist(time) * h**2
        c, s = np.cos(turn) / np.sqrt(stretch), np.sin(turn) / np.sqrt(stretch)
        high = z + strain * JELLY * np.where(h < 0.5, h**2, h - 0.25)  # its derivative is `stretch`: no volume is lost
        moved = c * x - s * y + much[1] * shear_x(time) * h**1.5 * high, s * x + c * y
        points = np.stack([moved[0], moved[1] + much[2] * shear_y(time) * h**1.5 * high, high], -1)
        return grid(points.reshape(*shape, 3) + (*spot, 0.012), closed=True, uv=uv)

    v = np.linspace(1, 0, 256)[:, None].repeat(512, 1)
    paint = ramp(np.clip(v + 0.25 * (noise(rng, 256, 512, 12, 4) - 0.5), 0, 1), colors[0], colors[0], colors[1])
    drip = 0.70 + 0.07 * np.sin(np.arange(512) * 2 * np.pi * 7 / 512) + 0.03 * np.sin(np.arange(512) * np.pi * 22 / 512)
    paint = mix(paint, (246, 236, 214), np.clip(60 * (v - drip), 0, 1))
    crumbs = (noise(rng, 256, 512, 64, 1) > 0.88) & (v < drip)
    paint[crumbs] = 0.5 * np.asarray(colors[0]) + 16
    yield Mover("jelly", at, GLAZE, paint)


def towel(rng, middle, color, accent):
    """A towel that hangs from a rail, its upper edge's middle at `middle` (x, y, z), and sways before the wall."""
    wide, long = rng.uniform((0.19, 0.2), (0.23, 0.23))
    v, u = np.meshgrid(np.linspace(0, 1, 36), np.linspace(-0.5, 0.5, 30), indexing="ij")
    waves = [_wave(rng, *r) for r in ((1.0, 1.5), (1.6, 2.2), (0.8, 1.2))]
    folds, lag = rng.uniform(2.0, 3.0), rng.uniform(1.0, 2.0)
    uv = np.stack([u + 0.5, v], -1)

    def at(time):
        down = 1 - v  # v = 0 is the lower edge
        swing = 0.030 * waves[0](time) + 0.012 * np.sin(lag * 4 * u + 2 * np.pi * waves[2](time)) * down
        out = 0.038 * down**1.3 - swing * down**1.4 + 0.010 * np.cos(2 * np.pi * folds * u) * (0.4 + 0.6 * down)
        x = wide * u * (1 - 0.06 * down) + 0.045 * waves[1](time) * down**1.6
        points = np.stack([x, -out, -long * down], -1) + np.asarray(middle)
        return grid(points, uv=uv)

    kind = ("stripes", "checks", "dots", "zigzag")[rng.integers(4)]
    paint = fabrics.cloth(rng, color, kind, accent)
    paint[-34:-22] = paint[18:26] = accent
    yield Mover("towel", at, MATTE, paint, True)
