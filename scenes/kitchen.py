"""A table-top in a kitchen where five things move, filmed by an arc of cameras: the data set for dynamic Gaussians.

A seed decides where things stand, their colors and textures, and every motion (`scenes.moving`: rigid, articulated and
deforming). World: meters, +z up, worktop at z = 0. All cameras film at the same times, k / (times - 1) in [0, 1].
cam00 is in the middle of the arc, where Neu3D has its test view; cam01 ... go from left to right.

Files, in the layout of Neu3D:

- cam00.mp4 ...: FFV1, lossless; 30 frames a second,
- poses_bounds.npy: (cameras, 17) float64, LLFF's rows: 3x4 pose with axes down, right, backward; height, width, focal
  length in pixels; nearest and farthest depth in frame 0,
- semantic_class/camNN/semantic_class_TTTT.png: class of the surface at the pixel's center, 8-bit, no anti-aliasing;
  classes.json names them, 0 is unlabelled; moving_classes.json lists the names of those that move,
- rgb_feature_langseg/camNN_TTTT_fmap_CxHxW.pt: the teacher's features (512, h, w) float16, `drgs.scenes.teacher`, with
  text_embeddings.npy, (classes, 512), and how often the teacher is right in teacher.json,
- frame0/: a COLMAP data set of frame 0: images/camNN.png, sparse/0 (model, text; points: `scenes.colmap`; cam00 has a
  pose, but no point comes from it nor is observed by it),
- params.json.
"""

from __future__ import annotations

import functools
import itertools
import json
import shutil
from pathlib import Path

import numpy as np

from drgs import runtime, scenes
from drgs.scenes import fabrics, labelled, moving, output, tabletop, teacher, videos
from drgs.scenes.colmap import SparsePoints, back_project, sparse_points, write_model
from drgs.scenes.moving import MOVING, Mover

__all__ = ["CLASSES", "CONFUSIONS", "MOVING", "Stage", "arc", "generate", "intrinsics", "parts"]

_VERSION = 1  # bump when a file changes: finished folders of another version are made again
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

_ACCENTS = ((190, 62, 46), (44, 98, 140), (222, 162, 48), (60, 120, 84), (122, 62, 104), (214, 108, 60))
_LIGHT = ((236, 230, 216), (222, 206, 178), (206, 218, 214), (232, 216, 206))
_JELLIES = (((150, 16, 40), (214, 60, 78)), ((36, 110, 40), (120, 176, 70)), ((190, 92, 10), (240, 166, 60)))
_WOODS = (((92, 56, 32), (172, 116, 70)), ((132, 92, 56), (208, 164, 112)), ((54, 38, 30), (112, 80, 58)))
_CLAYS = ((178, 84, 56), (150, 110, 86), (112, 122, 128))
_WORDS = ("FLOUR", "SUGAR", "SALT", "RICE")
_SPOTS = ((-0.285, -0.005), (0.0, -0.02), (0.285, 0.0))  # (x, y) in front
_BACK = ((-0.38, 0.235), (-0.145, 0.25), (0.125, 0.25), (0.365, 0.235))  # (x, y) along the wall

_FOV_X = 46.0  # degrees across the image width
_TARGET = (0.0, 0.05, 0.085)  # what all cameras look at, in meters
_ARC = 88.0  # degrees of azimuth that they cover
_DISTANCE = 1.08  # meters from the target
_ELEVATIONS = (20.0, 33.0)  # degrees, of every other camera
_EXPOSURE = 1.25
# Samples of the lights, beside one of the surface, of each light path; the light `room` stands for further bounces.
_LIGHT_SAMPLES = 3
_POINTS = 8000  # sparse points that are drawn


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


class Stage:
    """The Mitsuba scene of a seed, built once; what moves is put where it is at a time.

    Attributes:
        scene: The Mitsuba scene.
        table: Class of each shape by Dr.Jit's number, as `scenes.first_hits` gives it.
        movers: Identifier of a shape -> `Mover`.
    """

    def __init__(self, seed):
        mi = runtime.mitsuba()
        placed = []
        self.movers = {}
        for k, part in enumerate(parts(seed)):
            if isinstance(part, Mover):
                self.movers[f"part{k:03d}"] = part
                part = part.name, part.at(0.0), part.bsdf, part.paint, part.two_sided
            placed.append(part)
        self.scene, self.table = labelled.build(placed, CLASSES, _lights(mi))
        self._parameters = mi.traverse(self.scene)

    def set(self, time):
        """Move what moves to where it is at a time in [0, 1]."""
        import mitsuba as mi

        for key, mover in self.movers.items():
            points, _, _, normals = mover.at(time)
            for what, value in (("positions", points), ("normals", normals)):
                value = mi.Float(np.ascontiguousarray(value, np.float32).ravel())
                self._parameters[f"{key}.vertex_{what}"] = value
        self._parameters.update()


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


# -------------------------------------------------------------------------------- cameras
def intrinsics(width, height):
    """K (3, 3) in pixels."""
    return labelled.intrinsics(width, height, _FOV_X)


def arc(cameras, seed):
    """Camera-to-world matrices (cameras, 4, 4): cam00 in the middle, the others from left to right around it."""
    rng = np.random.default_rng([seed, 32])
    poses = np.tile(np.eye(4), (cameras, 1, 1))
    middle = cameras // 2
    places = [middle, *(k for k in range(cameras) if k != middle)]
    for pose, place, jitter in zip(poses, places, rng.uniform(-1, 1, (cameras, 6)), strict=True):
        part = (place - middle) / max(cameras - 1, 1)
        azimuth = np.radians(-90 + _ARC * part + (1.5 * jitter[0] if place != middle else 0))
        high = 26.0 if place == middle else _ELEVATIONS[(place + (place > middle)) % 2] + 2.0 * jitter[1]
        high = np.radians(high)
        way = np.array([np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)])
        eye = np.array(_TARGET) + _DISTANCE * (1 + 0.04 * jitter[2]) * way
        forward = np.array(_TARGET) + 0.015 * jitter[3:6] - eye
        forward /= np.linalg.norm(forward)
        pose[:3, :3] = scenes.axes(forward)
        pose[:3, 3] = eye
    return poses


# ------------------------------------------------------------------------------- data set
class _Recording:
    """A kitchen that is filmed into a folder, frame by frame, and the data set of what was filmed."""

    def __init__(self, folder, poses, times, size, teacher_size, spp, seed):
        self.folder = folder
        self.poses = poses
        self.times = times
        self.width, self.height = size
        self.teacher_size = teacher_size
        self.spp = scenes.strata(spp)
        self.seed = seed
        self.K = intrinsics(*size)
        digits = max(2, len(str(len(poses) - 1)))  # readers sort by name
        self.names = [f"cam{k:0{digits}d}" for k in range(len(poses))]
        self.digits = max(4, len(str(times - 1)))
        for name in ("rgb_feature_langseg", "frame0/images", "frame0/sparse/0", *map("frames/{}".format, self.names)):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for name in self.names:
            (folder / "semantic_class" / name).mkdir(parents=True, exist_ok=True)

    @functools.cached_property
    def stage(self):
        """The scene, built when something is left to trace."""
        return Stage(self.seed)

    def paths(self, camera, k):
        """(image, labels, features) of a camera's frame; images are gone when the videos are made."""
        name = self.names[camera]
        number = f"{k:0{self.digits}d}"
        return (
            self.folder / "frames" / name / f"{number}.png",
            self.folder / "semantic_class" / name / f"semantic_class_{number}.png",
            self.folder / "rgb_feature_langseg" / f"{name}_{number}_fmap_CxHxW.pt",
        )

    def film(self, progress):
        """Trace every frame that is not finished; the image comes last, and with it the frame is.

        A camera's light paths are drawn by the same numbers at all times: where nothing changes, neither do pixels.
        """
        count = len(self.poses) * self.times
        for k in range(self.times):
            left = [c for c in range(len(self.poses)) if not self.paths(c, k)[0].exists()]
            if left:
                self.stage.set(k / max(self.times - 1, 1))
            for c in left:
                self._trace(c, k)
                if progress is not None:
                    progress(k * len(self.poses) + c + 1, count)

    def _trace(self, camera, k):
        """Trace one frame: labels, features, image."""
        import mitsuba as mi

        image_path, label_path, feature_path = self.paths(camera, k)
        c2w = self.poses[camera]
        number = k * len(self.poses) + camera
        labels, points, _ = self._seen(camera)
        feature = teacher.feature_map(labels, points, CLASSES, self.teacher_size, self.seed, number, CONFUSIONS)
        sensor = scenes.sensor(self.K, self.width, self.height)
        scenes.aim(sensor, c2w)
        integrator = mi.load_dict({"type": "direct", "emitter_samples": _LIGHT_SAMPLES, "bsdf_samples": 1})
        seed = self.seed * 65536 + camera
        image = mi.render(self.stage.scene, sensor=sensor, integrator=integrator, spp=self.spp, seed=seed)
        output.write_png(label_path, labels)
        output.write_file(feature_path, teacher.tensor_bytes(feature))
        image = scenes.encode_srgb(np.asarray(image) * _EXPOSURE)
        output.write_png(image_path, image[..., ::-1])  # as BGR; last, since with it the frame is finished

    def _seen(self, camera):
        """(labels, world points, depth) of the surfaces at a camera's pixel centers."""
        c2w = self.poses[camera]
        depth, numbers = scenes.first_hits(self.stage.scene, self.K, c2w, self.width, self.height)
        return self.stage.table[numbers], back_project(self.K, c2w, depth), depth

    def finish(self):
        """Write what belongs to all frames; with poses_bounds.npy, the last file, the data set is complete."""
        import cv2

        folder = self.folder
        first = []
        vectors = teacher.embeddings(CLASSES, self.seed, CONFUSIONS)
        np.save(folder / "text_embeddings.npy", vectors)
        some = [(c, k) for k in range(0, self.times, 10) for c in range(len(self.poses))]
        right = teacher.accuracy(((teacher.load(self.paths(*at)[2]), self._labels(*at)) for at in some), vectors)
        self.stage.set(0.0)
        for c in range(len(self.poses)):
            image = cv2.imread(str(self.paths(c, 0)[0]))
            output.write_png(folder / "frame0" / "images" / f"{self.names[c]}.png", image)
            labels, _, depth = self._seen(c)
            first.append((image[..., ::-1].copy(), depth, labels))
        self._write_frame0(first)
        for name in self.names:
            frames = (cv2.imread(str(path)) for path in sorted((folder / "frames" / name).iterdir()))
            videos.write(folder / f"{name}.mp4", frames)
        for name, content in (
            ("classes", labelled.class_file(CLASSES)),
            ("moving_classes", MOVING),
            ("teacher", {"pixel_accuracy": right, "views": len(some)}),
        ):
            (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
        bounds = [(0.9 * depth.min(), 1.1 * depth.max()) for _, depth, _ in first]
        rows = videos.llff_rows(self.K, self.poses, self.width, self.height, np.array(bounds))
        np.save(folder / "poses_bounds.part.npy", rows)
        (folder / "poses_bounds.part.npy").replace(folder / "poses_bounds.npy")

    def _labels(self, camera, k):
        import cv2

        return cv2.imread(str(self.paths(camera, k)[1]), cv2.IMREAD_UNCHANGED)

    def _write_frame0(self, views):
        """Write the COLMAP model of frame 0 from each camera's (image, depth, labels); cam00 gives it no points."""
        rest = slice(1, None) if len(views) > 1 else slice(None)
        points = sparse_points(self.K, self.poses[rest], views[rest].__getitem__, _POINTS, self.seed)
        if len(views) > 1:
            tracks = [(np.zeros(0, int), np.zeros((0, 2))), *points.tracks]
            points = SparsePoints(points.xyz, points.exact, points.rgb, points.label, points.outlier, tracks)
        names = [f"{name}.png" for name in self.names]
        folder = self.folder / "frame0" / "sparse" / "0"
        write_model(folder, self.K, self.poses, names, self.width, self.height, points)


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
        progress: Function that is called with (frames done, frames) after each frame.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    where = "drgs.scenes.kitchen"
    values = {"cameras": cameras, "times": times, "width": width, "height": height, "spp": spp, "seed": seed}
    values |= {"teacher_width": teacher_width, "teacher_height": teacher_height}
    output.check_numbers(values, where)
    if width % 2 or height % 2:
        raise ValueError(f"{where}: width and height must be even, as videos have them, got {width}x{height}; add 1")
    parameters = {"scene": "kitchen", "version": _VERSION, **values}

    def fill(folder):
        size = min(teacher_width, width), min(teacher_height, height)
        work = _Recording(folder, arc(cameras, seed), times, (width, height), size, spp, seed)
        if not (folder / "poses_bounds.npy").exists():
            work.film(progress)
            work.finish()
        shutil.rmtree(folder / "frames")

    return output.publish(Path(out_dir), parameters, fill, where)
