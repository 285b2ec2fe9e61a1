"""A furnished room, path traced, with the true class of every pixel: the data set for semantic Gaussians.

A seed decides the room's size, which walls have the window, the sofa and the door, the furniture, textures and colors.
World: meters, +z up, floor at z = 0, room around the z axis. The camera goes twice around the middle at eye height and
looks across the room, as one that is carried through it. Every fifth view, from the first, is for testing by default.

Files, in COLMAP's layout as Feature 3DGS reads it:

- images/rgb_NNN.png (8-bit sRGB), sparse/0 (COLMAP model, text; points: `scenes.colmap`),
- semantic_class/semantic_class_NNN.png: class of the surface at the pixel's center, 8-bit, no anti-aliasing;
  classes.json names them, 0 is unlabelled,
- depth/depth_NNN.png: 16-bit z-depth in tenths of a millimeter,
- rgb_feature_langseg/rgb_NNN_fmap_CxHxW.pt: the teacher's features (512, h, w) float16, `drgs.scenes.teacher`, with
  text_embeddings.npy, (classes, 512), and how often the teacher is right in teacher.json,
- test_views.txt: names of the test views, those that `drgs fit --test-every 5` holds out (or the N of
  `drgs scene room --test-every N`); params.json.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from drgs import scenes
from drgs.scenes import fabrics, furniture, labelled, output, teacher
from drgs.scenes.colmap import back_project, sparse_points, write_model
from drgs.scenes.free_poses import CLEARANCE, distances, free_poses
from drgs.scenes.furniture import MATTE, SATIN, moved, moved_parts, slab

__all__ = ["CLASSES", "TEST_EVERY", "Layout", "generate", "parts", "scene", "trajectory"]

_VERSION = 1  # bump when a file changes: finished folders of another version are made again
CLASSES = (
    "wall", "floor", "ceiling", "window", "door", "curtain", "sofa", "cushion", "table", "chair", "lamp", "rug",
    "plant", "picture", "shelf", "book", "vase", "cabinet",
)  # fmt: skip

_WALLS = (
    ((196, 204, 190), "rings"),
    ((212, 200, 178), "stripes"),
    ((176, 196, 206), "plain"),
    ((214, 190, 170), "plain"),
)
# RGB, like the other colors here
_FABRICS = ((86, 110, 138), (150, 92, 74), (96, 122, 96), (168, 150, 122), (122, 88, 120))
_ACCENTS = ((206, 152, 60), (188, 78, 60), (64, 128, 132), (226, 214, 190), (108, 76, 128))
_WOODS = (((92, 56, 32), (172, 116, 70)), ((132, 92, 56), (208, 164, 112)), ((54, 38, 30), (112, 80, 58)))
_FLOORS = (
    ((104, 68, 42), (158, 108, 68), (196, 150, 104)),
    ((140, 112, 84), (188, 160, 126), (216, 194, 162)),
    ((84, 58, 44), (128, 90, 64), (160, 120, 88)),
)
_CLAYS = ((178, 84, 56), (46, 92, 142), (60, 122, 104), (208, 168, 70), (148, 60, 70))


TEST_EVERY = 5  # every fifth photograph is a test view
_FOV_X = 72.0  # degrees across the image width
_CEILING = 0.4  # radiance of a white ceiling that glows: it stands for the light of many bounces
_EXPOSURE = 1.8  # factor on radiance of the camera
_MAX_DEPTH = 3  # vertices of a path after the camera
_POINTS = 8000  # sparse points that are drawn


class Layout:
    """Sizes, sides and colors of one room; everything that a seed decides first.

    The room spans `size` (x, y, z) meters around the z axis, floor at 0. Walls are 0 south, 1 north (along x), 2 west
    and 3 east (along y).
    """

    def __init__(self, seed):
        self.rng = rng = np.random.default_rng([seed, 7])
        self.size = np.round(rng.uniform((4.8, 4.0, 2.55), (5.5, 4.5, 2.75)), 2)
        # Walls of the window and of the sofa; with the seed added, neighbors among the seeds are arranged differently.
        self.sunny = 2 + (int(rng.integers(2)) + seed) % 2
        self.cozy = (int(rng.integers(2)) + seed // 2) % 2

    @property
    def box(self):
        """(2, 3) lowest and highest corner."""
        x, y, z = self.size
        return np.array([(-x / 2, -y / 2, 0), (x / 2, y / 2, z)])

    def at(self, wall, along, out=0.0, up=0.0):
        """(turn, shift) that put a piece's origin on a wall, `along` it to the right of who faces the room."""
        x, y, _ = self.size
        turn, middle = ((0, (0, -y / 2)), (180, (0, y / 2)), (-90, (-x / 2, 0)), (90, (x / 2, 0)))[wall]
        shift = furniture.turned(np.array([along, out, 0.0]), turn)
        return turn, shift + (*middle, up)

    def toward(self, wall, other):
        """Whether going `along` a wall (+1, -1) leads toward another wall, which is not opposite."""
        turn, _ = self.at(wall, 0)
        way = furniture.turned(np.array([1.0, 0, 0]), turn)
        return 1 if way @ self.at(other, 0)[1] > 0 else -1


def _pick(rng, choices):
    return choices[rng.integers(len(choices))]


def parts(seed):
    """Yield the arguments of `scenes.shape` for everything in the room; names are classes."""
    layout = Layout(seed)
    rng, sunny, cozy = layout.rng, layout.sunny, layout.cozy
    yield from _shell(layout)
    wood, second = (fabrics.wood(rng, *colors) for colors in rng.permutation(np.array(_WOODS))[:2])
    accents = rng.permutation(np.array(_ACCENTS))
    clays = rng.permutation(np.array(_CLAYS))

    def put(pieces, wall, along, out=0.0, up=0.0, turn=0.0):
        on, shift = layout.at(wall, along, out, up)
        yield from moved_parts(pieces, on + turn, shift)

    # The sunny side: window, curtains, a table for two.
    wide, high = rng.uniform((1.5, 1.25), (1.8, 1.4))
    yield from put(furniture.window(rng, wide, high, 1.5, (1.5, 0.12)), sunny, 0)
    cloth = _pick(rng, _FABRICS)
    for side in (-1, 1):
        yield from put(furniture.curtain(rng, cloth, accents[3], wide, 2.4, side), sunny, 0)
    yield from put(furniture.table(rng, wood), sunny, 0, 0.85)
    seat = fabrics.cloth(rng, accents[1], "plain")
    for side in (-1, 1):
        turn = -90 * side + rng.uniform(-15, 15)
        yield from put(furniture.chair(wood, seat), sunny, 0.62 * side, 0.9, turn=-turn)

    # The cozy side: sofa, table, rug, pictures, lamp.
    away = -layout.toward(cozy, sunny)
    yield from put(furniture.sofa(rng, _pick(rng, _FABRICS), accents), cozy, 0.5 * away, 0.02)
    yield from put(furniture.coffee_table(rng, second, clays[0]), cozy, 0.5 * away, 1.35)
    colors = rng.permutation(np.array(_ACCENTS))[:3]
    mesh = slab((2.3, 1.6, 0.012), (0, 0, 0.006), 1, fit=True)
    yield from put([("rug", mesh, MATTE, fabrics.rug(rng, *colors))], cozy, 0.5 * away, 1.4)
    yield from put(furniture.floor_lamp(), cozy, -0.95 * away, 0.32)
    for k, kind in enumerate(rng.permutation(["hills", "shapes", "flower"])[:2]):
        w, h = rng.uniform((0.55, 0.42), (0.75, 0.55))
        yield from put(furniture.picture(rng, kind, w, h, 1.6), cozy, (0.5 + 0.85 * (k - 0.5)) * away)

    # Opposite: cabinet, bookcase, pictures; then the door, and plants in the corners.
    other = 1 - cozy
    near = layout.toward(other, sunny)
    yield from put(furniture.cabinet(rng, second, clays[1]), other, 0.75 * near)
    yield from put(furniture.picture(rng, _pick(rng, ("hills", "shapes")), 0.95, 0.62, 1.5), other, 0.75 * near)
    yield from put(furniture.bookcase(rng, wood, clays[2]), other, -0.95 * near)
    yield from put(furniture.plant(rng, clays[3]), other, near * (layout.size[0] / 2 - 0.42), 0.45)
    back = 5 - sunny
    side = layout.toward(back, other)
    yield from put(
        furniture.door(rng, _pick(rng, ((226, 222, 210), (150, 104, 66), (96, 116, 122)))), back, 0.55 * side
    )
    yield from put(furniture.picture(rng, "flower", 0.5, 0.62, 1.55), back, -0.7 * side)
    yield from put(furniture.plant(rng, clays[4]), back, -side * (layout.size[1] / 2 - 0.45), 0.45)
    yield from moved_parts(furniture.pendant(), 0, (0, 0, layout.size[2]))


def _shell(layout):
    """Walls with baseboards, floor and ceiling."""
    rng = layout.rng
    x, y, z = layout.size
    accent, plain = rng.permutation(len(_WALLS))[:2]
    for wall in range(4):
        color, kind = _WALLS[accent if wall == layout.cozy else plain]
        long = (x, x, y, y)[wall]
        turn, shift = layout.at(wall, 0)
        paint = fabrics.plaster(rng, color, kind if wall == layout.cozy else "plain")
        mesh = slab((long + 0.2, 0.1, z), (0, -0.05, z / 2), (z * 2, z))
        yield "wall", moved(mesh, turn, shift), MATTE, paint
        yield "wall", moved(slab((long, 0.016, 0.1), (0, 0.008, 0.05), 1), turn, shift), SATIN, (226, 222, 212)
    floor = fabrics.planks(rng, _pick(rng, _FLOORS))
    yield "floor", slab((x, y, 0.1), (0, 0, -0.05), 1.6), SATIN, floor
    u, v = np.meshgrid((0, 1), (0, 1))
    mesh = scenes.grid(np.stack([(u - 0.5) * x, (0.5 - v) * y, np.full((2, 2), z)], -1))
    yield "ceiling", mesh, MATTE, fabrics.plaster(rng, (232, 230, 224), "plain"), False, (_CEILING, 0.3)


def scene(seed):
    """(Mitsuba scene, class of each of its shapes by Dr.Jit's number)."""
    return labelled.build(list(parts(seed)), CLASSES)


def trajectory(layout, views, seed):
    """Camera-to-world matrices (views, 4, 4): two rounds through the middle of the room, looking across it."""
    rng = np.random.default_rng([seed, 8])
    x, y, _ = layout.size
    phase = rng.uniform(0, 2 * np.pi)
    poses = np.tile(np.eye(4), (views, 1, 1))
    for k in range(views):
        t = (k + 0.5) / views
        angle = phase + 4 * np.pi * t
        eye = np.array([0.24 * x * np.cos(angle), 0.20 * y * np.sin(angle), 1.5 + 0.14 * np.sin(6 * np.pi * t)])
        yaw = angle + np.pi + np.radians(38) * np.sin(10 * np.pi * t)
        pitch = np.radians(-9 + 10 * np.sin(2 * np.pi * 5.3 * t))
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        poses[k, :3, :3] = scenes.axes(forward)
        poses[k, :3, 3] = eye
    return poses


def _clear(built, poses):
    """Poses whose cameras keep their distance from every surface: those too near go toward the middle."""
    out = poses.copy()
    for pose in out:
        for _ in range(20):
            if distances(built, pose[:3, 3])[0].min() > CLEARANCE:
                break
            pose[:2, 3] *= 0.85
        else:
            raise RuntimeError("drgs.scenes.room: the middle of the room must be free, it is not; choose another seed")
    return out


def _intrinsics(width, height):
    """K (3, 3) in pixels."""
    return labelled.intrinsics(width, height, _FOV_X)


class _Views:
    """The views of a room in a folder: traced into it, and read again."""

    def __init__(self, folder, size, teacher_size, spp, seed):
        self.folder = folder
        self.width, self.height = size
        self.teacher_size = teacher_size
        self.spp = scenes.strata(spp)
        self.seed = seed
        self.K = _intrinsics(*size)
        for name in ("images", "semantic_class", "depth", "rgb_feature_langseg", "sparse/0"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def paths(self, k):
        """(image, labels, depth, features) of a view."""
        stem = f"{k:03d}"
        return (
            self.folder / "images" / f"rgb_{stem}.png",
            self.folder / "semantic_class" / f"semantic_class_{stem}.png",
            self.folder / "depth" / f"depth_{stem}.png",
            self.folder / "rgb_feature_langseg" / f"rgb_{stem}_fmap_CxHxW.pt",
        )

    def trace(self, built, table, poses, progress):
        """Trace every view that is not finished; the image comes last, and with it the view is."""
        import mitsuba as mi

        camera = scenes.sensor(self.K, self.width, self.height)
        integrator = mi.load_dict({"type": "path", "max_depth": _MAX_DEPTH, "rr_depth": 2 * _MAX_DEPTH})
        for k, c2w in enumerate(poses):
            image_path, label_path, depth_path, feature_path = self.paths(k)
            if not image_path.exists():
                depth, numbers = scenes.first_hits(built, self.K, c2w, self.width, self.height)
                labels = table[numbers]
                points = back_project(self.K, c2w, depth)
                feature = teacher.feature_map(labels, points, CLASSES, self.teacher_size, self.seed, k)
                scenes.aim(camera, c2w)
                seed = self.seed * 65536 + k
                image = scenes.traced(built, camera, integrator, self.spp, seed)
                output.write_png(label_path, labels)
                output.write_depth(depth_path, depth)
                output.write_file(feature_path, teacher.tensor_bytes(feature))
                image = scenes.encode_srgb(image * _EXPOSURE)
                output.write_png(image_path, image[..., ::-1])  # as BGR; last, since with it the view is finished
            if progress is not None:
                progress(k + 1, len(poses))

    def read(self, k):
        """(image (h, w, 3) uint8, depth (h, w) in meters, labels (h, w)) of a view."""
        import cv2

        image, labels, depth, _ = (str(path) for path in self.paths(k))
        depth = cv2.imread(depth, cv2.IMREAD_UNCHANGED) * output.DEPTH_UNIT
        return cv2.imread(image)[..., ::-1].copy(), depth, cv2.imread(labels, cv2.IMREAD_UNCHANGED)

    def finish(self, poses, test_every):
        """Write what belongs to all views: the COLMAP model, names, and how good the teacher is."""
        folder = self.folder
        count = len(poses)
        names = [self.paths(k)[0].name for k in range(count)]
        points = sparse_points(self.K, poses, self.read, _POINTS, self.seed)
        write_model(folder / "sparse" / "0", self.K, poses, names, self.width, self.height, points)
        vectors = teacher.embeddings(CLASSES, self.seed)
        np.save(folder / "text_embeddings.npy", vectors)
        right = teacher.accuracy(((teacher.load(self.paths(k)[3]), self.read(k)[2]) for k in range(count)), vectors)
        (folder / "classes.json").write_text(json.dumps(labelled.class_file(CLASSES), indent=1) + "\n")
        (folder / "teacher.json").write_text(json.dumps({"pixel_accuracy": right, "views": count}) + "\n")
        (folder / "test_views.txt").write_text("".join(name + "\n" for name in names[::test_every]))


def generate(
    out_dir,
    views=75,
    width=320,
    height=240,
    spp=25,
    seed=0,
    teacher_width=80,
    teacher_height=60,
    test_every=TEST_EVERY,
    free=False,
    progress=None,
) -> Path:
    """Make the data set, unless `out_dir` already holds it; an interrupted call is continued.

    Noise of a pixel at the defaults (standard deviation of the sRGB value in [0, 1], five views, two seeds of the light
    paths): 0.017 RMS. Time at the defaults: 341 seconds of processor, 5.4 minutes by the clock on two cores that others
    used as well. 373 MB, nearly all of it the teacher's features.

    Args:
        out_dir: Folder to make. Everything appears in it when it is complete; a kill loses the view that is being
            traced. One made here with other parameters is replaced; anything else that is not empty is refused.
        views: Number of cameras along the way.
        width, height: Image size in pixels.
        spp: Light paths a pixel.
        seed: Seed of the room, the poses, the light paths, the sparse points and the teacher's errors.
        teacher_width, teacher_height: Size of the teacher's maps; smaller where the images are.
        test_every: Distance of two test views among the views, counted from the first; they are drawn along the same
            way as the others. 3 gives 25 of 75.
        free: Cameras anywhere in the room, looking anywhere (`scenes.free_poses`), in place of two rounds through its
            middle.
        progress: Function that is called with (views done, views) after each view.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    where = "drgs.scenes.room"
    values = {"views": views, "width": width, "height": height, "spp": spp, "seed": seed}
    values |= {"teacher_width": teacher_width, "teacher_height": teacher_height}
    output.check_numbers(values | {"test_every": test_every}, where)
    parameters = {"scene": "room", "version": _VERSION, "test_every": test_every, "depth_unit": output.DEPTH_UNIT}
    parameters |= {"free": True} if free else {}  # others keep the mark that they have had

    def fill(folder):
        built, table = scene(seed)
        layout = Layout(seed)
        if free:
            poses = free_poses(built, layout.box, views, np.random.default_rng([seed, 9]))
        else:
            poses = _clear(built, trajectory(layout, views, seed))
        size = min(teacher_width, width), min(teacher_height, height)
        work = _Views(folder, (width, height), size, spp, seed)
        work.trace(built, table, poses, progress)
        work.finish(poses, test_every)

    return output.publish(Path(out_dir), {**parameters, **values}, fill, where)
