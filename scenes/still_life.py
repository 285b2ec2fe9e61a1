"""A path-traced still life: the data set that `make demo` fits, made from this file and a seed.

Meshes (surfaces of revolution, tubes, sheets) with NumPy-painted textures stand on a round table in
a papered room; Mitsuba 3 path traces them from a dome of cameras. There is no Gaussian in it, so a
fit has to work for its result: porcelain, fruit skin and brushed copper change with the view, the
cloth has folds, the stems are two pixels thin.

World: meters, +z up, table top at z = 0, objects near the origin. The data set is Nerfstudio's
layout: `transforms.json` (OpenGL camera axes), 8-bit sRGB `images/`, 16-bit z-depth in `depth/` in
tenths of a millimeter, 0 = nothing hit, which does not happen: the room closes every view.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from drgs import runtime, scenes
from drgs.display.progress import Bar
from drgs.scenes import box, grid, join, mix, noise, output, ramp, revolve, spline, tube, turned
from drgs.scenes.free_poses import free_poses

__all__ = ["generate", "main", "objects", "stone", "table", "wallpaper"]

_VERSION = 1  # bump when the pictures change: finished folders of another version are made again
_FOV_X = 50.0  # degrees across the image width
_CENTER_SHIFT = (0.018, -0.014)  # principal point off the image center, in widths and heights
_MAX_DEPTH = 4  # vertices of a path after the camera; a fifth would add 0.5 % of light
_EXPOSURE = 0.85  # factor on radiance of the camera
_RADIUS, _FLOOR, _HIGH = 1.9, -0.75, 1.25  # meters: the round room's radius, its floor, its walls' upper edge
_BOX = (-_RADIUS, -_RADIUS, _FLOOR), (_RADIUS, _RADIUS, _HIGH)
# meters; turn in degrees about z
_BOOK = {"size": (0.20, 0.145, 0.034), "center": (0.225, -0.10, 0.045), "turn": -24.0}

_MATTE = {"type": "diffuse"}
_SATIN = {"type": "roughplastic", "alpha": 0.3, "nonlinear": True}
_GLAZE = {"type": "roughplastic", "alpha": 0.12, "nonlinear": True}
_COPPER = {"type": "roughconductor", "material": "Cu", "alpha": 0.35, "distribution": "ggx"}


# ---------------------------------------------------------------------------------- paint
def _petals(picture, x, y, reach, axes, step, color):
    """A ring of ellipses around (x, y)."""
    import cv2

    for angle in range(0, 360, step):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        at = (int(x + reach * c), int(y + reach * s))
        cv2.ellipse(picture, at, axes, angle, 0, 360, color, -1, cv2.LINE_AA)


def _wood(rng, size=1024, planks=8):
    """Planks along x with grain and dark joints."""
    v = np.linspace(0, planks, size, endpoint=False)
    tone = rng.uniform(-0.16, 0.16, planks)[v.astype(int)][:, None]
    grain = 1.1 * (noise(rng, size, size, 3, 6, stretch=14.0) - 0.5)
    out = ramp(np.clip(0.5 + grain + tone, 0, 1), (92, 52, 28), (158, 98, 54), (206, 148, 92))
    out[np.abs(v - np.round(v)) < 0.018] *= 0.42
    return out


def _porcelain(rng, height=640, width=1024):
    """White glaze with cobalt bands, medallions and leaves, for the vase's profile in `objects`.

    The art fills the rows that the outer side covers; base and inside stay white.
    """
    import cv2

    art = np.zeros((height, width), np.uint8)
    bands = ((0.31, 10), (0.335, 3), (0.47, 3), (0.49, 11), (0.77, 11), (0.79, 3), (0.865, 9))
    for y, thick in bands:
        cv2.line(art, (0, int(y * height)), (width, int(y * height)), 255, thick)
    for k in range(8):
        x = int((k + 0.5) * width / 8)
        y = int(0.63 * height)
        if k % 2:
            _petals(art, x, y, 34, (22, 10), 45, 200)
            cv2.circle(art, (x, y), 11, 255, -1, cv2.LINE_AA)
        else:
            for r in (58, 40, 22):
                cv2.ellipse(art, (x, y), (int(0.8 * r), r), 0, 0, 360, 255, 5, cv2.LINE_AA)
        for dy in (0.40, 0.83):
            cv2.ellipse(art, (x, int(dy * height)), (42, 13), 18, 0, 360, 190, -1, cv2.LINE_AA)
            cv2.circle(art, (x + width // 16, int(dy * height)), 8, 255, -1, cv2.LINE_AA)
    base = ramp(noise(rng, height, width, 10, 3), (224, 226, 222), (240, 239, 233))
    return mix(base, (22, 52, 138), art / 255.0 * (0.7 + 0.3 * noise(rng, height, width, 24)))


def _gingham(size=768, checks=14):
    """Red and cream checks with a woven thread and a blue hem."""
    t = np.arange(size) * checks / size
    stripe = (t % 1 < 0.5) * 0.5
    thread = 0.93 + 0.07 * np.outer(np.sin(np.arange(size) * 2.1), np.sin(np.arange(size) * 2.1))
    out = mix((232, 222, 200), (178, 26, 34), stripe[None] + stripe[:, None]) * thread[..., None]
    edge = np.minimum(np.arange(size), np.arange(size)[::-1])
    hem = np.minimum(edge[:, None], edge[None, :])
    out[(hem > 10) & (hem < 24)] = (38, 62, 118)
    return out


def _skin(rng, colors, speck, density, blush=0.0, height=256, width=512):
    """Fruit skin: noise, shifted by latitude through `blush`, looked up in colors, with specks."""
    import cv2

    latitude = np.linspace(-1, 1, height)[:, None]
    skin = ramp(np.clip(noise(rng, height, width, 6, 5) + blush * latitude, 0, 1), *colors)
    dots = np.zeros((height, width), np.uint8)
    for x, y, r, tone in rng.integers((0, 0, 1, 90), (width, height, 3, 230), (density, 4)):
        cv2.circle(dots, (int(x), int(y)), int(r), int(tone), -1, cv2.LINE_AA)
    return mix(skin, speck, dots / 255.0)


def _cover(rng, color, ink, title, lines):
    """A book's picture of 3x2 cells: cover, back, spine | three sides of pages."""
    import cv2

    h, w = 290, 400
    front = (np.array(color) * (0.88 + 0.12 * noise(rng, h, w, 40, 3)[..., None])).astype(np.uint8)
    back, spine = front.copy(), front.copy()
    for k in range(5):
        a = 12 + 7 * k
        line = ink if k % 2 else (240, 232, 210)
        cv2.rectangle(front, (a, a), (w - a, h - a), line, 3)
    font = cv2.FONT_HERSHEY_DUPLEX
    cv2.putText(front, title, (62, 110), font, 1.7, ink, 4, cv2.LINE_AA)
    for k, text in enumerate(lines):
        cv2.putText(front, text, (64, 168 + 48 * k), font, 1.1, ink, 2, cv2.LINE_AA)
    (reach, _), _ = cv2.getTextSize(title, font, 1.0, 1)
    cv2.putText(spine, title, (40, 190), font, (w - 80) / reach, ink, 8, cv2.LINE_AA)
    for x in range(0, w + 90, 50):
        cv2.line(back, (x, 0), (x - 90, h), ink, 12)
    leaves = np.repeat(rng.random((h // 7 + 1, 1)), 7, 0)[:h].repeat(w, 1)
    pages = mix((208, 196, 166), (240, 234, 216), leaves)
    return np.concatenate([np.concatenate([front, back, spine], 1), np.concatenate([pages] * 3, 1)])


def wallpaper(rng, height=640, width=4096):
    """Rows of flowers above a paneled dado, with pictures hung on them; x runs once around."""
    import cv2

    out = ramp(noise(rng, height, width, 40), (66, 110, 112), (96, 144, 138))
    for x in range(0, width, 64):
        cv2.line(out, (x, 0), (x, height), (130, 164, 150), 3, cv2.LINE_AA)
    colors = ((214, 150, 96), (206, 106, 96), (222, 200, 140))
    for i in range(width // 128):
        for j, y in enumerate(range(40, int(0.66 * height), 84)):
            x = 32 + 128 * i + 64 * (j % 2)
            _petals(out, x, y, 15, (13, 7), 60, colors[rng.integers(3)])
            cv2.circle(out, (x, y), 7, (240, 228, 190), -1, cv2.LINE_AA)
    y0 = int(0.73 * height)
    panel = ramp(noise(rng, height - y0, width, 30, 5, 0.2), (104, 66, 44), (146, 98, 64))
    for x in range(0, width, 128):
        cv2.rectangle(panel, (x + 16, 26), (x + 112, height - y0 - 26), (78, 46, 30), 5)
    out[y0:] = panel
    cv2.line(out, (0, y0), (width, y0), (222, 206, 170), 14)
    for k in range(11):  # a sky, a sun and hills in each frame
        w, h, y = (int(v) for v in rng.integers((130, 110, 215), (210, 170, 265)))
        x = int((k + rng.uniform(0.25, 0.5)) * width / 11.5)
        sky = np.linspace(0, 1, h)[:, None].repeat(w, 1)
        art = ramp(sky, rng.integers(40, 140, 3), rng.integers(150, 250, 3), (250, 220, 150))
        sun = (int(rng.integers(30, w - 30)), int(0.45 * h))
        cv2.circle(art, sun, int(rng.integers(12, 24)), (252, 236, 160), -1, cv2.LINE_AA)
        for layer in range(3):
            wave = np.sin(np.arange(w) / rng.uniform(10, 26) + rng.uniform(0, 6))
            hills = h * (0.55 + 0.16 * layer) + 16 * wave
            art[np.arange(h)[:, None] > hills[None]] = rng.integers(30, 170, 3)
        out[y : y + h, x : x + w] = art
        cv2.rectangle(out, (x, y), (x + w, y + h), (70, 44, 24), 11)
        cv2.rectangle(out, (x, y), (x + w, y + h), (206, 168, 92), 4)
    return out


def stone(rng, size=1024, tiles=14):
    """Checkered floor."""
    t = np.arange(size) * tiles // size
    vein = noise(rng, size, size, 24, 5)
    dark = ramp(vein, (96, 88, 84), (132, 122, 112))
    light = ramp(vein, (186, 176, 158), (222, 212, 192))
    return mix(dark, light, (t[:, None] + t[None]) % 2)


# -------------------------------------------------------------------------------- objects
def _room(rng):
    """Yield the arguments of `scenes.shape` for what stands around."""
    mesh = list(revolve(np.array([[_RADIUS, _HIGH], [_RADIUS, _FLOOR]]), segments=128))
    mesh[2] = mesh[2] * (1, -1) + (0, 1)  # its profile runs downward because it is seen from inside
    yield "wall", mesh, _MATTE, wallpaper(rng)
    plane = np.stack(np.meshgrid((-1.95, 1.95), (-1.95, 1.95), _FLOOR), -1)[:, :, 0]
    yield "floor", grid(plane), _MATTE, stone(rng)
    yield from table(rng)


def table(rng):
    """Yield the arguments of `scenes.shape` for the round table."""
    profile = [(0.26, -0.76), (0.25, -0.74), (0.07, -0.6), (0.05, -0.3), (0.07, -0.1)]
    profile += [(0.12, -0.032), (0.6, -0.03), (0.612, -0.026), (0.618, -0.014), (0.612, -0.004)]
    profile = np.array([*profile, (0.6, 0), (0, 0)])
    profile = [np.linspace(a, b, 5)[:-1] for a, b in pairwise(profile)]
    mesh = list(revolve(np.concatenate([*profile, [(0, 0)]]), segments=128))
    mesh[2] = mesh[0][:, :2] * 0.8 + 0.5 + mesh[0][:, 2:] * 0.3  # planks run straight across
    yield "table", mesh, _SATIN, _wood(rng)


def objects(rng):
    """Yield the arguments of `scenes.shape` for what stands on the table."""
    t = np.linspace(-0.5, 0.5, 90)
    x, y = np.meshgrid(t * 0.62, t * 0.5)
    waves = np.maximum(0, np.sin(24 * x + 9 * y + 1)) ** 2
    z = 0.010 * noise(rng, 90, 90, 5, 2) + 0.006 * waves
    calm = np.exp(-(((x + 0.02) / 0.16) ** 2) - ((y - 0.05) / 0.13) ** 2)  # flat under the vase
    x, y, z = x + 0.006 * np.sin(30 * y), y + 0.006 * np.sin(26 * x), z * (1 - calm)
    cloth = turned(np.stack([x, y, z], -1), 28.6) + (-0.07, -0.04, 0.002)
    yield "cloth", grid(cloth), _MATTE, _gingham()

    vase = [(0, 0), (0.045, 0), (0.05, 0.006), (0.062, 0.05), (0.086, 0.12), (0.084, 0.175)]
    vase += [(0.05, 0.23), (0.033, 0.262), (0.036, 0.285), (0.049, 0.302), (0.047, 0.304)]
    vase = spline(vase + [(0.032, 0.286), (0.028, 0.25), (0, 0.2)], 120)
    yield "vase", revolve(vase, (-0.06, 0.10, 0.003), segments=128), _GLAZE, _porcelain(rng)
    yield from _bouquet(rng, np.array([-0.06, 0.10, 0.29]))
    yield from _fruits(rng)

    low = {"size": (0.225, 0.165, 0.026), "center": (0.235, -0.09, 0.0145), "turn": -8.0}
    ochre = _cover(rng, (196, 120, 40), (60, 24, 16), "STILL LIFE", ("with lemon", "1889"))
    blue = _cover(rng, (28, 74, 120), (244, 206, 110), "RAYS", ("and where", "they end"))
    yield "book_low", box(**low), _SATIN, ochre
    yield "book", box(**_BOOK), _SATIN, blue

    mug = [(0, 0), (0.034, 0), (0.038, 0.004), (0.039, 0.045), (0.042, 0.09), (0.0405, 0.092)]
    mug = spline(mug + [(0.037, 0.06), (0.034, 0.01), (0, 0.008)], 80)
    handle = [(0.038, 0, 0.078), (0.062, 0, 0.078), (0.072, 0, 0.05), (0.058, 0, 0.026)]
    handle = turned(spline(handle + [(0.037, 0, 0.02)], 32), -34.0) + (0.13, 0.14, 0)
    yield "mug", revolve(mug, (0.13, 0.14, 0), segments=96), _COPPER, None
    yield "handle", tube(handle, 0.0055), _COPPER, None


def _fruits(rng):
    """Two apples, an orange, a pear and a lemon; yields as `objects`."""
    phi = np.linspace(-np.pi / 2, np.pi / 2, 60)
    r, h = np.cos(phi), np.sin(phi)
    top = np.exp(-((r / 0.3) ** 2)) * (h > 0)
    bottom = np.exp(-((r / 0.22) ** 2)) * (h < 0)
    apple = 0.047 * np.stack([r * (1 + 0.10 * h), 0.88 * h * (1 - 0.42 * top - 0.2 * bottom)], 1)
    wobble = 0.05 * (noise(rng, 60, 72, 3, 2) - 0.5) * r[:, None]
    red = ((222, 178, 62), (206, 92, 40), (168, 22, 28), (140, 12, 26))
    green = ((128, 160, 44), (160, 190, 62), (196, 208, 92))
    apples = (
        ("apple", (-0.20, -0.13, 0.043), -35, _skin(rng, red, (240, 214, 150), 700, 0.15)),
        ("granny", (-0.285, -0.03, 0.042), 60, _skin(rng, green, (232, 234, 170), 800, -0.1)),
    )
    for name, center, turn, skin in apples:
        tilt = (9, 13, 0)
        mesh = list(revolve(apple, turn=tilt, bumps=wobble))
        mesh[0] = turned(mesh[0], turn) + center
        mesh[3] = turned(mesh[3], turn)
        yield name, mesh, _GLAZE, skin
        stem = spline([(-0.006, 0.002, 0.02), (-0.001, 0, 0.04), (0.014, -0.008, 0.058)], 10)
        yield name + "_stem", tube(turned(stem, turn) + center, 0.0022), _MATTE, (92, 62, 36)
    peel = _skin(rng, ((222, 108, 12), (234, 130, 20), (240, 146, 36)), (172, 80, 12), 2600)
    orange = 0.046 * np.stack([r, 0.95 * h], 1)
    orange = revolve(orange, (-0.085, -0.195, 0.048), (70, 20, 0), bumps=wobble / 2)
    yield "orange", orange, _SATIN, peel
    pear = [(0, 0), (0.022, 0), (0.044, 0.022), (0.047, 0.05), (0.034, 0.082), (0.022, 0.106)]
    pear = spline(pear + [(0.015, 0.122), (0, 0.127)], 60)
    colors = ((206, 120, 60), (222, 190, 74), (196, 178, 56), (150, 150, 40))
    skin = _skin(rng, colors, (120, 84, 40), 1500, 0.2)
    yield "pear", revolve(pear, (0.045, -0.235, 0.004), (0, 5, 0), bumps=wobble), _SATIN, skin
    stem = spline([(0.055, -0.235, 0.127), (0.057, -0.234, 0.14), (0.064, -0.232, 0.152)], 8)
    yield "pear_stem", tube(stem, 0.002), _MATTE, (84, 56, 32)
    zest = _skin(rng, ((228, 186, 28), (240, 208, 44), (244, 218, 80)), (208, 162, 24), 1800)
    lemon = [(0, -0.047), (0.008, -0.043), (0.024, -0.03), (0.031, 0), (0.025, 0.026)]
    lemon = spline(lemon + [(0.009, 0.041), (0.005, 0.048), (0, 0.05)], 60)
    yield "lemon", revolve(lemon, (0.33, -0.225, 0.031), (90, 20, 30), bumps=wobble), _SATIN, zest


def _bouquet(rng, mouth):
    """Stems, leaves and flowers that rise from the vase's mouth; yields as `objects`."""
    stems, leaves = [], []
    angle = np.linspace(0, 2 * np.pi, 145)[None]
    out = np.linspace(0, 1, 16)[:, None]
    white = ((244, 240, 226), (248, 226, 186))
    rose = ((222, 88, 112), (246, 184, 190))
    gold = ((244, 190, 54), (222, 116, 26))
    for k in range(9):
        turn = 2 * np.pi * k / 9 + rng.uniform(-0.2, 0.2)
        lean, height, size = rng.uniform((0.05, 0.07, 0.026), (0.13, 0.17, 0.036))
        way = np.array([np.cos(turn), np.sin(turn), 0])
        up = np.array([0, 0, 1.0])
        path = [0.012 * way - 0.06 * up, 0.02 * way, 0.3 * lean * way + 0.55 * height * up]
        path = spline(mouth + np.array([*path, lean * way + height * up]), 24)
        stems.append(tube(path, 0.0022, 8))
        axis = (0.75 * way + 0.65 * up) / np.hypot(0.75, 0.65)
        side = np.cross(way, up)
        frame = np.stack([side, np.cross(axis, side), axis])
        radius = size * out * (0.42 + 0.58 * np.abs(np.cos(4.5 * angle)) ** 0.5)
        cup = size * (0.42 * out**2 - 0.06 * np.cos(9 * angle) * out)
        head = np.stack([radius * np.cos(angle), radius * np.sin(angle), cup], -1)
        head = head @ frame + path[-1]
        inner, outer = (white, rose, gold)[k % 3]
        color = ramp(out.repeat(145, 1), outer, inner, inner, (190, 120, 20), (92, 52, 20))
        color = mix(color, (255, 255, 255), 0.2 * noise(rng, 16, 145, 36, 2))
        yield f"flower{k}", grid(head, closed=True), _MATTE, color, True
        u, v = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 1, 18))
        width = 0.013 * np.sin(np.pi * v**0.8)
        blade = (u * width)[..., None] * side + (0.07 * v)[..., None] * (0.9 * way + 0.35 * up)
        leaves.append(grid(blade + (0.7 * width * u**2 - 0.03 * v**2)[..., None] * up + path[10]))
    yield "stems", join(stems), _MATTE, (70, 108, 50)
    u, v = np.meshgrid(np.linspace(-1, 1, 128), np.linspace(0, 60, 256))
    veins = np.clip(0.3 + 0.6 * u**2 + 0.15 * np.sin(v + 6 * np.abs(u)), 0, 1)
    color = ramp(veins, (150, 178, 84), (70, 120, 52), (36, 84, 40))
    yield "leaves", join(leaves), _SATIN, color, True


def _scene(seed):
    """The Mitsuba scene without a camera."""
    mi = runtime.mitsuba()
    rng = np.random.default_rng(seed)
    scene = {"type": "scene"}
    for part in (*_room(rng), *objects(rng)):
        scene[part[0]] = scenes.shape(*part)
    # A warm lamp from the left and a cool skylight; a faint sky gives the rest of the open roof.
    # Their sampling weights follow their share of the light, which lowers the noise by a tenth.
    lights = (
        ("lamp", (-0.75, -0.75, 1.75), (0, 0, 0.05), 0.7, (11.5, 9.8, 7.6), 0.55),
        ("skylight", (0, 0, 2.3), (0, 0, 0), 1.3, (2.3, 2.6, 3.1), 0.43),
    )
    for name, origin, target, half, value, weight in lights:
        to_world = mi.ScalarTransform4f().look_at(origin, target, (0, 1, 0)).scale([half, half, 1])
        radiance = {"type": "rgb", "value": list(value)}
        emitter = {"type": "area", "radiance": radiance, "sampling_weight": weight}
        scene[name] = {"type": "rectangle", "to_world": to_world, "emitter": emitter}
    radiance = {"type": "rgb", "value": [0.10, 0.11, 0.13]}
    scene["sky"] = {"type": "constant", "radiance": radiance, "sampling_weight": 0.02}
    return mi.load_dict(scene)


# -------------------------------------------------------------------------------- cameras
def _intrinsics(width, height):
    """K (3, 3) in pixels."""
    focal = 0.5 * width / np.tan(np.radians(_FOV_X) / 2)
    cx, cy = width * (0.5 + _CENTER_SHIFT[0]), height * (0.5 + _CENTER_SHIFT[1])
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])


# ------------------------------------------------------------------------------- data set
def generate(out_dir, views=32, width=320, height=240, spp=30, seed=0, free=False, progress=None) -> Path:
    """Make the data set, unless `out_dir` already holds it.

    Noise of a pixel at the defaults (standard deviation of the sRGB value in [0, 1], six views, two
    seeds of the light paths): 0.017 RMS. Time at the defaults: 77 seconds of processor; 49 to 121
    by the clock on two cores that others used as well.

    Args:
        out_dir: Folder to make. It appears when it is complete. One made here with other
            parameters is replaced; anything else that is not empty is refused.
        views: Number of cameras.
        width, height: Image size in pixels.
        spp: Light paths a pixel.
        seed: Seed of the textures, shapes, poses and light paths.
        free: Cameras anywhere in the room, looking anywhere (`scenes.free_poses`), in place of a dome.
        progress: Function that is called with (views done, views) after each view.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    where = "drgs.scenes.still_life"
    values = {"views": views, "width": width, "height": height, "spp": spp, "seed": seed}
    output.check_numbers(values, where)
    parameters = {"scene": "still_life", "version": _VERSION, **values}
    parameters |= {"free": True} if free else {}  # others keep the mark that they have had

    def fill(folder):
        built = _scene(seed)
        if free:
            poses = free_poses(built, _BOX, views, np.random.default_rng([seed, 9]))
        else:
            poses = scenes.dome(views, seed, (0, -0.02, 0.14), 1.10, 200.0, (15.0, 30.0, 47.0))
        cameras = _intrinsics(width, height), poses, width, height
        settings = {"spp": spp, "max_depth": _MAX_DEPTH, "exposure": _EXPOSURE, "seed": seed}
        scenes.write_views(folder, built, *cameras, **settings, progress=progress)

    return output.publish(Path(out_dir), parameters, fill, where)


def main(argv=None) -> int:
    """The command line: `python -m drgs.scenes.still_life OUT`."""
    parser = argparse.ArgumentParser("drgs.scenes.still_life", description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to make")
    for name, default in (("views", 32), ("width", 320), ("height", 240), ("spp", 30), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default, help="default: %(default)s")
    options = vars(parser.parse_args(argv))

    try:
        with Bar("path tracing", options["views"], show=True) as bar:
            folder = generate(options.pop("out"), **options, progress=bar.update)
        print(folder)
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
