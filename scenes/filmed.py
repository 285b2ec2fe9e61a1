"""Rooms in motion, filmed by cameras that stand still: the files of a data set for dynamic Gaussians.

All cameras film at the same times, k / (times - 1) in [0, 1]. cam00 is where Neu3D has its test view. Files, in the
layout of Neu3D:

- cam00.mp4 ...: FFV1, lossless; 30 frames a second,
- poses_bounds.npy: (cameras, 17) float64, LLFF's rows: 3x4 pose with axes down, right, backward; height, width, focal
  length in pixels; nearest and farthest depth in frame 0,
- semantic_class/camNN/semantic_class_TTTT.png: class of the surface at the pixel's center, 8-bit, no anti-aliasing;
  classes.json names them, 0 is unlabelled; moving_classes.json lists the names of those that move,
- rgb_feature_langseg/camNN_TTTT_fmap_CxHxW.pt: the teacher's features (512, h, w) float16, `drgs.scenes.teacher`, with
  text_embeddings.npy, (classes, 512), and how often the teacher is right in teacher.json,
- frame0/: a COLMAP data set of frame 0: images/camNN.png, sparse/0 (model, text; points: `scenes.colmap`; cam00 has a
  pose, but no point comes from it nor is observed by it),
- motion.json, where the play has one: what is where in each frame (docs/run-files.md),
- params.json.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drgs import runtime, scenes
from drgs.scenes import labelled, output, teacher, videos
from drgs.scenes.colmap import SparsePoints, back_project, sparse_points, write_model
from drgs.scenes.moving import Mover

__all__ = ["Play", "Stage", "arc", "film"]

# Samples of the lights, beside one of the surface, of each light path; a constant light stands for further bounces.
_LIGHT_SAMPLES = 3
_POINTS = 8000  # sparse points that are drawn


@dataclasses.dataclass(frozen=True)
class Play:
    """What is filmed, and from where.

    Attributes:
        name: The module that makes it.
        version: Changes when a file does: finished folders of another version are made again.
        classes: Names of all classes.
        moving: Names of those that move or change.
        confusions: What the teacher takes for what.
        parts: Function of a seed: `Mover`s, and for what stands still the arguments of `scenes.shape`.
        lights: Function of the module `mitsuba`: what else is in the scene, as `mi.load_dict` takes it; one that is
            called as a class is of that class.
        light_at: Function of the time: parameters of lights, as `mi.traverse` names them, and their values.
        truth: Function of the time: what motion.json says of a frame beside its time; None writes no such file.
        arc: Function of the number of cameras and the seed: camera-to-world matrices (cameras, 4, 4).
        fov_x: Degrees across the image width.
        exposure: Factor of the light before it is encoded.
    """

    name: str
    version: int
    classes: tuple[str, ...]
    moving: tuple[str, ...]
    confusions: teacher.Confusions
    parts: Callable
    lights: Callable
    arc: Callable
    fov_x: float
    exposure: float
    light_at: Callable[[float], dict] = lambda time: {}
    truth: Callable[[float], dict] | None = None


class Stage:
    """The Mitsuba scene of a play and a seed, built once; what moves is put where it is at a time.

    Attributes:
        scene: The Mitsuba scene.
        table: Class of each shape by Dr.Jit's number, as `scenes.first_hits` gives it.
        movers: Identifier of a shape -> `Mover`.
    """

    def __init__(self, play, seed):
        mi = runtime.mitsuba()
        placed = []
        self.movers = {}
        for k, part in enumerate(play.parts(seed)):
            if isinstance(part, Mover):
                self.movers[f"part{k:03d}"] = part
                part = part.name, part.at(0.0), part.bsdf, part.paint, part.two_sided
            placed.append(part)
        self.scene, self.table = labelled.build(placed, play.classes, play.lights(mi))
        self._light_at = play.light_at
        self._parameters = mi.traverse(self.scene)

    def set(self, time):
        """Move what moves to where it is at a time in [0, 1], and light what is lit then."""
        import mitsuba as mi

        for key, mover in self.movers.items():
            points, _, _, normals = mover.at(time)
            for what, value in (("positions", points), ("normals", normals)):
                value = mi.Float(np.ascontiguousarray(value, np.float32).ravel())
                self._parameters[f"{key}.vertex_{what}"] = value
        for key, value in self._light_at(time).items():
            self._parameters[key] = value
        self._parameters.update()


def arc(cameras, seed, *, target, distance, spread, elevations):
    """Camera-to-world matrices (cameras, 4, 4): cam00 in the middle, the others from left to right around it.

    Args:
        cameras: Number of cameras.
        seed: Seed of their jitter.
        target: (3,) what all look at, from -y, in meters.
        distance: Meters from it.
        spread: Degrees of azimuth that they cover.
        elevations: Degrees, of every other camera; cam00 is at 26.
    """
    rng = np.random.default_rng([seed, 32])
    target = np.array(target)
    poses = np.tile(np.eye(4), (cameras, 1, 1))
    middle = cameras // 2
    places = [middle, *(k for k in range(cameras) if k != middle)]
    for pose, place, jitter in zip(poses, places, rng.uniform(-1, 1, (cameras, 6)), strict=True):
        part = (place - middle) / max(cameras - 1, 1)
        azimuth = np.radians(-90 + spread * part + (1.5 * jitter[0] if place != middle else 0))
        high = 26.0 if place == middle else elevations[(place + (place > middle)) % 2] + 2.0 * jitter[1]
        high = np.radians(high)
        way = np.array([np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)])
        eye = target + distance * (1 + 0.04 * jitter[2]) * way
        forward = target + 0.015 * jitter[3:6] - eye
        forward /= np.linalg.norm(forward)
        pose[:3, :3] = scenes.axes(forward)
        pose[:3, 3] = eye
    return poses


class _Recording:
    """A play that is filmed into a folder, frame by frame, and the data set of what was filmed."""

    def __init__(self, play, folder, poses, times, size, teacher_size, spp, seed):
        self.play = play
        self.folder = folder
        self.poses = poses
        self.times = times
        self.width, self.height = size
        self.teacher_size = teacher_size
        self.spp = scenes.strata(spp)
        self.seed = seed
        self.K = labelled.intrinsics(*size, play.fov_x)
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
        return Stage(self.play, self.seed)

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
        labels, points, _ = self._visible_surfaces(camera)
        feature = teacher.feature_map(
            labels, points, self.play.classes, self.teacher_size, self.seed, number, self.play.confusions
        )
        sensor = scenes.sensor(self.K, self.width, self.height)
        scenes.aim(sensor, c2w)
        integrator = mi.load_dict({"type": "direct", "emitter_samples": _LIGHT_SAMPLES, "bsdf_samples": 1})
        seed = self.seed * 65536 + camera
        image = scenes.traced(self.stage.scene, sensor, integrator, self.spp, seed)
        output.write_png(label_path, labels)
        output.write_file(feature_path, teacher.tensor_bytes(feature))
        image = scenes.encode_srgb(image * self.play.exposure)
        output.write_png(image_path, image[..., ::-1])  # as BGR; last, since with it the frame is finished

    def _visible_surfaces(self, camera):
        """(labels, world points, depth) of the surfaces at a camera's pixel centers."""
        c2w = self.poses[camera]
        depth, numbers = scenes.first_hits(self.stage.scene, self.K, c2w, self.width, self.height)
        return self.stage.table[numbers], back_project(self.K, c2w, depth), depth

    def finish(self):
        """Write what belongs to all frames; with poses_bounds.npy, the last file, the data set is complete."""
        import cv2

        folder = self.folder
        first = []
        vectors = teacher.embeddings(self.play.classes, self.seed, self.play.confusions)
        np.save(folder / "text_embeddings.npy", vectors)
        some = [(c, k) for k in range(0, self.times, 10) for c in range(len(self.poses))]
        right = teacher.accuracy(((teacher.load(self.paths(*at)[2]), self._labels(*at)) for at in some), vectors)
        self.stage.set(0.0)
        for c in range(len(self.poses)):
            image = cv2.imread(str(self.paths(c, 0)[0]))
            output.write_png(folder / "frame0" / "images" / f"{self.names[c]}.png", image)
            labels, _, depth = self._visible_surfaces(c)
            first.append((image[..., ::-1].copy(), depth, labels))
        self._write_frame0(first)
        for name in self.names:
            frames = (cv2.imread(str(path)) for path in sorted((folder / "frames" / name).iterdir()))
            videos.write(folder / f"{name}.mp4", frames)
        for name, content in (
            ("classes", labelled.class_file(self.play.classes)),
            ("moving_classes", self.play.moving),
            ("teacher", {"pixel_accuracy": right, "views": len(some)}),
        ):
            (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
        if self.play.truth is not None:
            moments = [k / max(self.times - 1, 1) for k in range(self.times)]
            truth = {"frames": [{"time": moment, **self.play.truth(moment)} for moment in moments]}
            (folder / "motion.json").write_text(json.dumps(truth, indent=1) + "\n")
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


def film(play, out_dir, values, teacher_size, progress=None) -> Path:
    """Make the data set of a play, unless `out_dir` already holds it; an interrupted call is continued.

    Args:
        play: The play.
        out_dir: Folder to make. Everything appears in it when it is complete; a kill loses the frame that is being
            traced. One made here with other parameters is replaced; anything else that is not empty is refused.
        values: Numbers of cameras, times, width and height (even, in pixels), spp (light paths a pixel) and seed (of
            things, motions, cameras, light paths, sparse points and the teacher's errors).
        teacher_size: (width, height) of the teacher's maps; smaller where the frames are.
        progress: Function that is called with (frames done, frames) after each frame.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    where = f"drgs.scenes.{play.name}"
    width, height = values["width"], values["height"]
    numbers = {**values, "teacher_width": teacher_size[0], "teacher_height": teacher_size[1]}
    output.check_numbers(numbers, where)
    if width % 2 or height % 2:
        raise ValueError(f"{where}: width and height must be even, as videos have them, got {width}x{height}; add 1")
    parameters = {"scene": play.name, "version": play.version, **numbers}

    def fill(folder):
        size = min(teacher_size[0], width), min(teacher_size[1], height)
        poses = play.arc(values["cameras"], values["seed"])
        work = _Recording(play, folder, poses, values["times"], (width, height), size, values["spp"], values["seed"])
        if not (folder / "poses_bounds.npy").exists():
            work.film(progress)
            work.finish()
        shutil.rmtree(folder / "frames")

    return output.publish(Path(out_dir), parameters, fill, where)
