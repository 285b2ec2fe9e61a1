"""A hall in which things go far, appear and are uncovered, filmed by an arc of cameras: what a deformation field cannot
show.

Between two of the default's 12 times a ball flies five of its diameters, to and fro along the wall, and bounces; a lamp
goes on; a door opens and shows a niche that was hidden. A seed decides colors, textures and what stands around. World:
meters, +z up, the floor at z = 0, the wall at y = 0; cameras look at it from -y. cam00 is in the middle of the arc.

Files: `scenes.filmed`, and motion.json, which has of each frame where the ball's center is (its radius is `BALL`), how
far the door is open, and whether the lamp is on.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from drgs.scenes import fabrics, grid, join, ramp, revolve, teacher, tube
from drgs.scenes.filmed import Play, arc, film
from drgs.scenes.furniture import GLAZE, MATTE, METAL, SATIN, flat, moved, moved_parts, plant, slab, vase
from drgs.scenes.moving import Mover, rigid, rotation

__all__ = ["BALL", "CLASSES", "CONFUSIONS", "MOVING", "PLAY", "ball_at", "generate", "lamp_at", "opening_at", "parts"]

CLASSES = ("wall", "floor", "door", "niche", "vase", "bench", "cushion", "plant", "picture", "ball", "lamp")
MOVING = ("door", "ball", "lamp")
CONFUSIONS = teacher.Confusions(
    {
        "wall": "niche", "floor": "bench", "door": "wall", "niche": "picture", "vase": "lamp", "bench": "floor",
        "cushion": "bench", "plant": "vase", "picture": "niche", "ball": "cushion", "lamp": "vase",
    },
    (("wall", "door", "niche", "picture"), ("floor", "bench", "cushion"), ("vase", "lamp", "ball"), ("plant",)),
)  # fmt: skip

BALL = 0.08  # radius in meters
_TIMES = 12  # the default, at which the ball flies five of its diameters from frame to frame
_PATH = 5 * 2 * BALL * (_TIMES - 1)  # meters along the wall in the sequence
_REACH = 1.1  # meters to the left and right of the middle that it flies
_FRONT = -0.75  # y of its path
_HEIGHT = 0.75  # meters that it bounces
_BOUNCES = 3.5  # bounces of the ball in the sequence
_DOOR = (-0.15, 0.5, 1.35)  # left, right and upper edge of the opening, which is a niche in the wall
_DEEP = 0.35  # meters
_OPENS = (0.2, 0.55)  # when the door begins to open, and is open
_OPEN = 105.0  # degrees
_LAMP_ON = 0.5  # time, in [0, 1], at which the lamp is switched on
_LAMP = (-0.85, -0.3, 1.25)  # center of the globe
_GLOBE = 0.11  # its radius
_GLOWS = np.array([13.0, 9.5, 5.5])  # radiance when it is on
_SIDE = 2.2  # x of the side walls
_HIGH = 2.2  # meters, height of the ceiling
_ACCENTS = ((196, 62, 46), (44, 98, 150), (222, 162, 48), (60, 130, 84), (132, 62, 114))  # RGB, like the colors below
_WALLS = ((222, 212, 190), (196, 212, 210), (220, 200, 190))


def ball_at(time):
    """(3,) where the ball's center is: to and fro along the wall at an even speed, in bounces without loss."""
    way = (time * _PATH) % (4 * _REACH)
    x = -_REACH + (way if way < 2 * _REACH else 4 * _REACH - way)
    part = (time * _BOUNCES + 0.5) % 1
    return np.array([x, _FRONT, BALL + 0.02 + _HEIGHT * 4 * part * (1 - part)])


def opening_at(time):
    """Degrees by which the door is open."""
    part = np.clip((time - _OPENS[0]) / (_OPENS[1] - _OPENS[0]), 0, 1)
    return float(_OPEN * part * part * (3 - 2 * part))


def lamp_at(time):
    """Whether the lamp is on."""
    return time >= _LAMP_ON


def parts(seed):
    """Yield what is in the hall: `Mover`s, and for what stands still the arguments of `scenes.shape`."""
    rng = np.random.default_rng([seed, 41])
    accents = rng.permutation(np.array(_ACCENTS))
    paper = fabrics.plaster(rng, _WALLS[rng.integers(3)], "stripes")
    yield (
        "floor",
        slab((2 * _SIDE, 3.0, 0.05), (0, -1.5, -0.025), 0.9),
        SATIN,
        fabrics.planks(rng, ((122, 78, 46), (170, 116, 72), (202, 152, 104))),
    )
    left, right, top = _DOOR
    for low, high, bottom in ((-_SIDE, left, 0.0), (right, _SIDE, 0.0), (left, right, top)):
        size = (high - low, 0.06, _HIGH - bottom)
        yield "wall", slab(size, ((low + high) / 2, 0.03, (bottom + _HIGH) / 2), 1.2), MATTE, paper
    for side in (-1, 1):
        yield "wall", slab((0.05, 3.0, _HIGH), (side * (_SIDE + 0.025), -1.5, _HIGH / 2), 1.2), MATTE, paper
    yield from _niche(rng, accents)
    yield from _door(rng, accents[0])
    yield from _bench(rng, accents[3])
    yield from moved_parts(plant(rng, (150, 110, 86)), rng.uniform(0, 360), (1.45, -0.3, 0))
    # The number is not used, but drawn: else a seed would make another hall than in the studies that are committed.
    rng.integers(3)
    yield "picture", moved(flat(0.5, 0.4, (0, 0, 0)), 180, (0.95, -0.005, 1.5)), MATTE, fabrics.art(rng, "flower")
    foot = revolve(np.array([(0.13, 0), (0.13, 0.02), (0.03, 0.035), (0.014, 0.05)]), segments=48)
    pole = tube(np.array([(0, 0, 0.03), (0, 0, 0.6), (0, 0, _LAMP[2] - _GLOBE + 0.01)]), 0.013)
    yield "lamp", moved(join([foot, pole]), 0, (*_LAMP[:2], 0)), METAL, (64, 54, 44)
    yield from _ball(rng, accents[1], accents[2])


def _niche(rng, accents):
    """What the door hides: a back wall with a pattern, a shelf, and two vases."""
    left, right, top = _DOOR
    middle, wide = (left + right) / 2, right - left
    yield (
        "niche",
        flat(wide, top, (middle, _DEEP - 0.02, top / 2), 2),
        MATTE,
        fabrics.cloth(rng, accents[2], "stripes", accents[4]),
    )
    boards = [slab((wide, _DEEP, 0.03), (middle, _DEEP / 2, z), 1) for z in (0.015, 0.7, top - 0.015)]
    boards += [slab((0.03, _DEEP, top), (x, _DEEP / 2, top / 2), 1) for x in (left + 0.015, right - 0.015)]
    yield "niche", join(boards), SATIN, (214, 204, 184)
    for x, z, color, high in ((left + 0.2, 0.03, accents[1], 0.5), (right - 0.2, 0.715, accents[4], 0.4)):
        yield from moved_parts(vase(rng, color, high), 0, (x, 0.55 * _DEEP, z))


def _door(rng, color):
    """A leaf that turns about its left edge, towards the cameras."""
    left, right, top = _DOOR
    wide = right - left
    leaf = slab((wide, 0.03, top), (wide / 2, -0.015, top / 2), 1, fit=True)
    knob = revolve(np.array([(0.012, 0), (0.012, 0.03), (0.026, 0.04), (0.026, 0.055), (0, 0.06)]), segments=32)
    turn = rotation((np.pi / 2, 0, 0))  # its axis along -y
    knob = knob[0] @ turn.T + (wide - 0.07, -0.03, 0.7), knob[1], knob[2], knob[3] @ turn.T

    def pose(time):
        return rotation((0, 0, -np.radians(opening_at(time)))), np.array([left, 0, 0])

    yield Mover("door", rigid(leaf, pose), SATIN, fabrics.panel(rng, color))
    yield Mover("door", rigid(knob, pose), METAL, (70, 62, 52))


def _bench(rng, color):
    """A bench at the wall, and a cushion on it."""
    seat = slab((0.7, 0.34, 0.05), (-0.95, -0.75, 0.42), 0.5)
    legs = [slab((0.05, 0.3, 0.4), (x, -0.75, 0.2), 0.5) for x in (-1.25, -0.65)]
    wood = fabrics.wood(rng, (92, 56, 32), (172, 116, 70))
    yield "bench", moved(join([seat, *legs]), 0, (0.1, 0.35, 0)), SATIN, wood
    yield "cushion", slab((0.3, 0.3, 0.1), (-0.72, -0.4, 0.495), 0.3, 12.0), MATTE, fabrics.cloth(rng, color)


def _ball(rng, color, accent, height=64, width=128):
    """A ball of two colors in gores, which rolls as it flies."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(-np.pi / 2, np.pi / 2, 25))
    way = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], -1)
    uv = np.stack([u / (2 * np.pi), v / np.pi + 0.5], -1)
    mesh = grid(BALL * way, closed=True, uv=uv)
    gores = np.tile(np.arange(width) * 6 // width % 2, (height, 1)).astype(np.float32)
    paint = ramp(gores, np.asarray(color), np.asarray(accent))
    spin = rng.uniform(1.5, 2.5)

    def pose(time):
        return rotation((0.3, 2 * np.pi * spin * time, 0)), ball_at(time)

    yield Mover("ball", rigid(mesh, pose), GLAZE, paint)


def _lights(mi):
    """Daylight from the left and from above, what other walls reflect, and the lamp's globe, which is off at first."""
    lights = {}
    for name, origin, target, half, value, weight in (
        ("window", (-1.5, -2.6, 2.6), (0, -0.3, 0.5), 0.6, (9.0, 9.4, 10.0), 0.4),
        ("skylight", (0.9, -1.4, 3.0), (0, -0.4, 0.3), 0.5, (6.0, 6.0, 6.0), 0.2),
    ):
        to_world = mi.ScalarTransform4f().look_at(origin, target, (0, 0, 1)).scale([half, half, 1])
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(value)}, "sampling_weight": weight}
        lights[name] = {"type": "rectangle", "to_world": to_world, "emitter": emitter}
    glow = {"type": "area", "radiance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}, "sampling_weight": 0.25}
    glass = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.39, 0.36]}}
    lights["lamp"] = {"type": "sphere", "center": list(_LAMP), "radius": _GLOBE, "emitter": glow, "bsdf": glass}
    radiance = {"type": "rgb", "value": [0.5, 0.49, 0.47]}
    return lights | {"room": {"type": "constant", "radiance": radiance, "sampling_weight": 0.15}}


def _light_at(time):
    """What the lamp radiates."""
    return {"lamp.emitter.radiance.value": (_GLOWS * lamp_at(time)).tolist()}


def _truth(time):
    """What a frame's entry of motion.json says beside its time."""
    return {"ball": ball_at(time).tolist(), "door": opening_at(time), "lamp": bool(lamp_at(time))}


PLAY = Play(
    name="hall",
    version=1,
    classes=CLASSES,
    moving=MOVING,
    confusions=CONFUSIONS,
    parts=parts,
    lights=_lights,
    arc=functools.partial(arc, target=(0.0, -0.35, 0.7), distance=2.9, spread=70.0, elevations=(14.0, 24.0)),
    box=((-_SIDE, -3.0, 0.0), (_SIDE, 0.0, _HIGH)),
    fov_x=54.0,
    exposure=1.25,
    light_at=_light_at,
    truth=_truth,
)
"""What is filmed."""


def generate(
    out_dir,
    cameras=12,
    times=_TIMES,
    width=160,
    height=120,
    spp=16,
    seed=0,
    teacher_width=40,
    teacher_height=30,
    free=False,
    progress=None,
) -> Path:
    """Make the data set, unless `out_dir` already holds it; an interrupted call is continued.

    Args:
        out_dir: Folder to make, as of `scenes.kitchen.generate`.
        cameras: Number of cameras on the arc.
        times: Number of frames of each camera; with fewer than 12 the ball flies further between them.
        width, height: Size of the frames in pixels, even numbers.
        spp: Light paths a pixel.
        seed: Seed of things, cameras, light paths, sparse points and the teacher's errors.
        teacher_width, teacher_height: Size of the teacher's maps; smaller where the frames are.
        free: Each camera takes one photograph at one of the times, from a pose that is free then (`scenes.free_poses`),
            in place of an arc of cameras that film at all times.
        progress: Function that is called with (frames done, frames) after each frame.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    values = {"cameras": cameras, "times": times, "width": width, "height": height, "spp": spp, "seed": seed}
    return film(PLAY, out_dir, values, (teacher_width, teacher_height), free, progress)
