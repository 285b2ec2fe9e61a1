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

With free poses (`scenes.free_poses`) each camera takes one photograph instead, at one of the times, from a place that
is free at that time: what one camera gets that goes about. Then videos, poses_bounds.npy and frame0/ give way to

- images/rgb_NNN.png and transforms.json, in Nerfstudio's layout, with a `time` in each frame; every eighth photograph,
  from the first, is listed as held out,

and labels and features are semantic_class/semantic_class_NNN.png and rgb_feature_langseg/rgb_NNN_fmap_CxHxW.pt.
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
from drgs.scenes.free_poses import free_poses
from drgs.scenes.moving import Mover

__all__ = ["Play", "Stage", "arc", "film"]

# Samples of the lights, beside one of the surface, of each light path; a constant light stands for further bounces.
_LIGHT_SAMPLES = 3
_POINTS = 8000  # sparse points that are drawn
_TEST_EVERY = 8  # of photographs from free poses


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
        box: Lowest and highest corner of where a camera with a free pose may be, in meters.
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
    box: tuple[tuple[float, float, float], tuple[float, float, float]]
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


class _Tracer:
    """What traces the views of a play: the scene, the camera, the teacher."""

    def __init__(self, play, size, teacher_size, spp, seed):
        self.play = play
        self.width, self.height = size
        self.teacher_size = teacher_size
        self.spp = scenes.strata(spp)
        self.seed = seed
        self.K = labelled.intrinsics(*size, play.fov_x)

    @functools.cached_property
    def stage(self):
        """The scene, built when something is left to trace."""
        return Stage(self.play, self.seed)

    def trace(self, c2w, paths, number, camera):
        """Trace a view into its files, (image, labels, features); the image comes last, and with it the view is.

        Args:
            c2w: (4, 4) camera to world.
            paths: The three files.
            number: Number of the view, of its own: the teacher errs by it.
            camera: Number that its light paths are drawn by.
        """
        import mitsuba as mi

        image_path, label_path, feature_path = paths
        labels, points, _ = self.visible_surfaces(c2w)
        feature = teacher.feature_map(
            labels, points, self.play.classes, self.teacher_size, self.seed, number, self.play.confusions
        )
        sensor = scenes.sensor(self.K, self.width, self.height)
        scenes.aim(sensor, c2w)
        integrator = mi.load_dict({"type": "direct", "emitter_samples": _LIGHT_SAMPLES, "bsdf_samples": 1})
        image = scenes.traced(self.stage.scene, sensor, integrator, self.spp, self.seed * 65536 + camera)
        output.write_png(label_path, labels)
        output.write_file(feature_path, teacher.tensor_bytes(feature))
        image = scenes.encode_srgb(image * self.play.exposure)
        output.write_png(image_path, image[..., ::-1])  # as BGR

    def visible_surfaces(self, c2w):
        """(labels, world points, depth) of the surfaces at a camera's pixel centers."""
        depth, numbers = scenes.first_hits(self.stage.scene, self.K, c2w, self.width, self.height)
        return self.stage.table[numbers], back_project(self.K, c2w, depth), depth

    def finish(self, folder, files, times):
        """Write what belongs to all views: classes, how good the teacher is in some views, what is where when.

        Args:
            folder: The data set.
            files: (features, labels) of these views.
            times: Number of times.
        """
        vectors = teacher.embeddings(self.play.classes, self.seed, self.play.confusions)
        np.save(folder / "text_embeddings.npy", vectors)
        right = teacher.accuracy(((teacher.load(path), _read_labels(labels)) for path, labels in files), vectors)
        for name, content in (
            ("classes", labelled.class_file(self.play.classes)),
            ("moving_classes", self.play.moving),
            ("teacher", {"pixel_accuracy": right, "views": len(files)}),
        ):
            (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
        if self.play.truth is not None:
            moments = [_moment(k, times) for k in range(times)]
            truth = {"frames": [{"time": time, **self.play.truth(time)} for time in moments]}
            (folder / "motion.json").write_text(json.dumps(truth, indent=1) + "\n")


def _read_labels(path):
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def _moment(k, times):
    """The k-th of so many times, in [0, 1]."""
    return k / max(times - 1, 1)


class _Recording:
    """A play that is filmed into a folder, frame by frame, and the data set of what was filmed."""

    def __init__(self, tracer, folder, poses, times):
        self.tracer = tracer
        self.folder = folder
        self.poses = poses
        self.times = times
        digits = max(2, len(str(len(poses) - 1)))  # readers sort by name
        self.names = [f"cam{k:0{digits}d}" for k in range(len(poses))]
        self.digits = max(4, len(str(times - 1)))
        for name in ("rgb_feature_langseg", "frame0/images", "frame0/sparse/0", *map("frames/{}".format, self.names)):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for name in self.names:
            (folder / "semantic_class" / name).mkdir(parents=True, exist_ok=True)

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
                self.tracer.stage.set(_moment(k, self.times))
            for c in left:
                self._trace(c, k)
                if progress is not None:
                    progress(k * len(self.poses) + c + 1, count)

    def _trace(self, camera, k):
        """Trace one frame: labels, features, image."""
        self.tracer.trace(self.poses[camera], self.paths(camera, k), k * len(self.poses) + camera, camera)

    def finish(self):
        """Write what belongs to all frames; with poses_bounds.npy, the last file, the data set is complete."""
        import cv2

        folder, tracer = self.folder, self.tracer
        first = []
        some = [self.paths(c, k) for k in range(0, self.times, 10) for c in range(len(self.poses))]
        tracer.finish(folder, [(features, labels) for _, labels, features in some], self.times)
        tracer.stage.set(0.0)
        for c in range(len(self.poses)):
            image = cv2.imread(str(self.paths(c, 0)[0]))
            output.write_png(folder / "frame0" / "images" / f"{self.names[c]}.png", image)
            labels, _, depth = tracer.visible_surfaces(self.poses[c])
            first.append((image[..., ::-1].copy(), depth, labels))
        self._write_frame0(first)
        for name in self.names:
            frames = (cv2.imread(str(path)) for path in sorted((folder / "frames" / name).iterdir()))
            videos.write(folder / f"{name}.mp4", frames)
        bounds = [(0.9 * depth.min(), 1.1 * depth.max()) for _, depth, _ in first]
        rows = videos.llff_rows(tracer.K, self.poses, tracer.width, tracer.height, np.array(bounds))
        np.save(folder / "poses_bounds.part.npy", rows)
        (folder / "poses_bounds.part.npy").replace(folder / "poses_bounds.npy")

    def _write_frame0(self, views):
        """Write the COLMAP model of frame 0 from each camera's (image, depth, labels); cam00 gives it no points."""
        rest = slice(1, None) if len(views) > 1 else slice(None)
        tracer = self.tracer
        points = sparse_points(tracer.K, self.poses[rest], views[rest].__getitem__, _POINTS, tracer.seed)
        if len(views) > 1:
            tracks = [(np.zeros(0, int), np.zeros((0, 2))), *points.tracks]
            points = SparsePoints(points.xyz, points.exact, points.rgb, points.label, points.outlier, tracks)
        names = [f"{name}.png" for name in self.names]
        folder = self.folder / "frame0" / "sparse" / "0"
        write_model(folder, tracer.K, self.poses, names, tracer.width, tracer.height, points)


class _Walk:
    """Photographs of a play from free poses, each at one of the times: drawn, taken into a folder, and listed."""

    def __init__(self, tracer, folder, views, times):
        self.tracer = tracer
        self.folder = folder
        self.times = times
        rng = np.random.default_rng([tracer.seed, 33])
        self.at = rng.integers(times, size=views)
        self.poses = np.zeros((views, 4, 4))
        for k in np.unique(self.at):
            now = np.flatnonzero(self.at == k)
            tracer.stage.set(_moment(int(k), times))
            self.poses[now] = free_poses(tracer.stage.scene, tracer.play.box, len(now), rng)
        for name in ("images", "semantic_class", "rgb_feature_langseg"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def paths(self, view):
        """(image, labels, features) of a photograph."""
        return (
            self.folder / "images" / f"rgb_{view:03d}.png",
            self.folder / "semantic_class" / f"semantic_class_{view:03d}.png",
            self.folder / "rgb_feature_langseg" / f"rgb_{view:03d}_fmap_CxHxW.pt",
        )

    def film(self, progress):
        """Trace every photograph that is not finished, in the order of their times."""
        for done, view in enumerate(np.argsort(self.at, kind="stable").tolist(), 1):
            if not self.paths(view)[0].exists():
                self.tracer.stage.set(_moment(int(self.at[view]), self.times))
                self.tracer.trace(self.poses[view], self.paths(view), view, view)
            if progress is not None:
                progress(done, len(self.at))

    def finish(self):
        """Write what belongs to all photographs."""
        tracer = self.tracer
        every = [self.paths(view) for view in range(len(self.at))]
        tracer.finish(self.folder, [(features, labels) for _, labels, features in every], self.times)
        names = [f"images/{image.name}" for image, _, _ in every]
        transforms = {
            **scenes.pinhole_keys(tracer.K, tracer.width, tracer.height),
            "test_filenames": names[::_TEST_EVERY],
            "train_filenames": [name for k, name in enumerate(names) if k % _TEST_EVERY],
            "frames": [
                {"file_path": name, "time": _moment(int(k), self.times), "transform_matrix": scenes.opengl(c2w)}
                for name, k, c2w in zip(names, self.at, self.poses, strict=True)
            ],
        }
        (self.folder / "transforms.json").write_text(json.dumps(transforms, indent=1) + "\n")


def film(play, out_dir, values, teacher_size, free=False, progress=None) -> Path:
    """Make the data set of a play, unless `out_dir` already holds it; an interrupted call is continued.

    Args:
        play: The play.
        out_dir: Folder to make. Everything appears in it when it is complete; a kill loses the frame that is being
            traced. One made here with other parameters is replaced; anything else that is not empty is refused.
        values: Numbers of cameras, times, width and height (even, in pixels), spp (light paths a pixel) and seed (of
            things, motions, cameras, light paths, sparse points and the teacher's errors).
        teacher_size: (width, height) of the teacher's maps; smaller where the frames are.
        free: Each camera takes one photograph at one of the times, from a free pose, in place of an arc of videos.
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
    parameters |= {"free": True} if free else {}  # others keep the mark that they have had

    def fill(folder):
        size = min(teacher_size[0], width), min(teacher_size[1], height)
        tracer = _Tracer(play, (width, height), size, values["spp"], values["seed"])
        cameras, times = values["cameras"], values["times"]
        if free:
            walk = _Walk(tracer, folder, cameras, times)
            walk.film(progress)
            walk.finish()
            return
        work = _Recording(tracer, folder, play.arc(cameras, values["seed"]), times)
        if not (folder / "poses_bounds.npy").exists():
            work.film(progress)
            work.finish()
        shutil.rmtree(folder / "frames")

    return output.publish(Path(out_dir), parameters, fill, where)
