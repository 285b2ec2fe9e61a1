"""A table-top in a kitchen where five things move, filmed by an arc of cameras: the data set for dynamic Gaussians.

A seed decides where things stand, their colors and textures, and every motion (`scenes.moving`: rigid, articulated and
deforming). World: meters, +z up, worktop at z = 0. All cameras film at the same times, k / (times - 1) in [0, 1].
cam00 is in the middle of the arc, where Neu3D has its test view; cam01 ... go from left to right.

Files: `scenes.filmed`.
"""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import numpy as np

from drgs.scenes import fabrics, moving, tabletop, teacher
from drgs.scenes.filmed import Play, arc, film
from drgs.scenes.moving import MOVING

__all__ = ["CLASSES", "CONFUSIONS", "MOVING", "PLAY", "generate", "parts"]

CLASSES = (
    "wall", "worktop", "rail", "utensil", "towel", "board", "lemon", "plate", "jelly", "mug", "orange", "tongs",
    "canister", "bottle", "bowl", "plant",
)  # fmt: skip
CONFUSIONS = teacher.Confusions(
    {
        "wall": "worktop", "worktop": "board", "rail": "utensil", "utensil": "tongs", "towel": "wall",
        "board": "worktop", "lemon": "orange", "plate": "bowl", "jelly": "bowl", "mug": "canister", "orange": "lemon",
        "tongs": "utensil", "canister": "mug", "bottle": "canister", "bowl": "plate", "plant": "towel",
    },
    (("wall", "worktop", "board"), ("rail", "utensil", "tongs"), ("lemon", "orange"), ("plate", "bowl", "jelly"),
     ("mug", "canister", "bottle")),
)  # fmt: skip

# RGB, like the colors below; pairs and triples are darker to lighter tones
_ACCENTS = ((190, 62, 46), (44, 98, 140), (222, 162, 48), (60, 120, 84), (122, 62, 104), (214, 108, 60))
_LIGHT = ((236, 230, 216), (222, 206, 178), (206, 218, 214), (232, 216, 206))
_JELLIES = (((150, 16, 40), (214, 60, 78)), ((36, 110, 40), (120, 176, 70)), ((190, 92, 10), (240, 166, 60)))
_WOODS = (((92, 56, 32), (172, 116, 70)), ((132, 92, 56), (208, 164, 112)), ((54, 38, 30), (112, 80, 58)))
_CLAYS = ((178, 84, 56), (150, 110, 86), (112, 122, 128))
_WORDS = ("FLOUR", "SUGAR", "SALT", "RICE")
_SPOTS = ((-0.285, -0.005), (0.0, -0.02), (0.285, 0.0))  # (x, y) in front
_BACK = ((-0.38, 0.235), (-0.145, 0.25), (0.125, 0.25), (0.365, 0.235))  # (x, y) along the wall


def parts(seed):
    """Yield what is in the kitchen: `Mover`s, and for what stands still the arguments of `scenes.shape`."""
    rng = np.random.default_rng([seed, 31])
    accents = rng.permutation(np.array(_ACCENTS))
    light = rng.permutation(np.array(_LIGHT))
    order = list(itertools.permutations(_SPOTS))[(5 * seed + 2) % 6]  # six seeds, six arrangements
    for_mug, for_jelly, for_tongs = (np.array(at) + rng.uniform(-0.012, 0.012, 2) for at in order)
    back = [np.array(at) + rng.uniform(-0.02, 0.02, 2) * (1, 0.5) for at in rng.permutation(np.array(_BACK))]
    word = rng.permutation(np.array(_WORDS))

    yield from tabletop.shell(rng, seed)
    yield from tabletop.rail(rng, accents[4])
    yield from tabletop.bowl(rng, back[0], light[1], accents[1])
    yield from tabletop.canister(rng, back[1], light[2], accents[2], word[0])
    yield from tabletop.bottle(rng, back[2] + (-0.05, 0), ((44, 66, 30), (92, 52, 22), (26, 58, 62))[rng.integers(3)])
    yield from tabletop.bottle(rng, back[2] + (0.045, 0.03), (150, 112, 30))
    yield from tabletop.herbs(rng, back[3], _CLAYS[rng.integers(3)])
    yield from tabletop.board(rng, for_tongs, fabrics.wood(rng, *_WOODS[rng.integers(3)]))
    yield from tabletop.lemon(rng, (*for_tongs, 0.014 + moving.LEMON))
    yield from tabletop.plate(rng, for_jelly, light[0], accents[0])
    yield from moving.mug(rng, for_mug, light[3], accents[3])
    low, high = rng.uniform((-0.27, 0.17), (-0.19, 0.27))
    ways = [(low, -0.235 + rng.uniform(-0.02, 0.02)), (high, -0.235 + rng.uniform(-0.02, 0.02))]
    yield from moving.orange(rng, *ways)
    yield from moving.tongs(rng, for_tongs, accents[5])
    yield from moving.jelly(rng, for_jelly, _JELLIES[rng.integers(3)])
    hung = (back[0][0], tabletop.WALL - 0.058, tabletop.RAIL + 0.008)
    yield from moving.towel(rng, hung, light[0], accents[1])


def _lights(mi):
    """A window on the left, a lamp above the cameras, and what the rest of the room reflects."""
    lights = {}
    for name, origin, target, half, value, weight in (
        ("window", (-1.25, -0.75, 1.25), (0, 0.05, 0), 0.5, (8.2, 8.6, 9.2), 0.5),
        ("lamp", (0.55, -0.45, 1.7), (0, 0.1, 0), 0.4, (8.6, 7.4, 5.6), 0.35),
    ):
        to_world = mi.ScalarTransform4f().look_at(origin, target, (0, 0, 1)).scale([half, half, 1])
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(value)}, "sampling_weight": weight}
        lights[name] = {"type": "rectangle", "to_world": to_world, "emitter": emitter}
    radiance = {"type": "rgb", "value": [0.54, 0.51, 0.47]}
    return lights | {"room": {"type": "constant", "radiance": radiance, "sampling_weight": 0.15}}


# ------------------------------------------------------------------------------- data set
PLAY = Play(
    name="kitchen",
    version=1,
    classes=CLASSES,
    moving=MOVING,
    confusions=CONFUSIONS,
    parts=parts,
    lights=_lights,
    arc=functools.partial(arc, target=(0.0, 0.05, 0.085), distance=1.08, spread=88.0, elevations=(20.0, 33.0)),
    box=((-tabletop.SIDE, tabletop.WALL - 1.6, 0.0), (tabletop.SIDE, tabletop.WALL, 0.95)),
    fov_x=46.0,
    exposure=1.25,
)
"""What is filmed."""


def generate(
    out_dir,
    cameras=15,
    times=40,
    width=240,
    height=180,
    spp=16,
    seed=0,
    teacher_width=60,
    teacher_height=45,
    free=False,
    progress=None,
) -> Path:
    """Make the data set, unless `out_dir` already holds it; an interrupted call is continued.

    Noise of a pixel at the defaults (standard deviation of the sRGB value in [0, 1], five views, two seeds of the light
    paths): 0.019 RMS, 34.6 dB. Time at the defaults: 1.0 seconds of processor a frame, of 600. 1.7 GB, nearly all of
    it the teacher's features.

    Args:
        out_dir: Folder to make. Everything appears in it when it is complete; a kill loses the frame that is being
            traced. One made here with other parameters is replaced; anything else that is not empty is refused.
        cameras: Number of cameras on the arc.
        times: Number of frames of each camera.
        width, height: Size of the frames in pixels, even numbers.
        spp: Light paths a pixel.
        seed: Seed of things, motions, cameras, light paths, sparse points and the teacher's errors.
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
