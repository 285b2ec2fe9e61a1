"""Which views are known and which could be added, for commands that compare them: poses only, no image is opened.

The size of a view is what its camera file states (that of a known view of a run: of its image file).
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera, orbit
from drgs.commands.orbits import Wish, capture_orbit, scene_orbit, seen_distance
from drgs.commands.render import cameras_of, is_camera_list, load_scene
from drgs.data.camera_lists import load_cameras_json
from drgs.data.sizes import at_most, resized_alike
from drgs.files import Run
from drgs.fitting.records import fit_record, fitted_views
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.commands.options import Crossval, Fisher, Select, Tradeoff
    from drgs.data import View
    from drgs.ellipsoids import Gaussians

__all__ = ["Known", "Scene", "dome", "evenly", "known_views", "other_views", "scene_of", "seen_views"]

_PIXELS = 130_000  # of a view where there is no fit that says
_MAX_COUNT = 10_000


@dataclasses.dataclass(frozen=True)
class Scene:
    """What a command was given.

    Attributes:
        gaussians: Of the PLY.
        run: The run folder, or None.
        settings: Of the renderer, over the run's background.
        pixels: Views are reduced to at most so many.
        strict: Refuse data sets that list images which are not there.
    """

    gaussians: Gaussians
    run: Run | None
    settings: RenderSettings
    pixels: int
    strict: bool = False


@dataclasses.dataclass(frozen=True)
class Known:
    """Views that count as known.

    Attributes:
        cameras: Pinhole, reduced.
        source: Where they come from, in words.
        data: The data set that they are of, or None.
        sizes: Stated size -> size of the image file, as far as known.
    """

    cameras: list[Camera]
    source: str
    data: Path | None = None
    sizes: dict[tuple[int, int], tuple[int, int]] = dataclasses.field(default_factory=dict)


def scene_of(args: Select | Fisher) -> Scene:
    """The scene that a command names, and how its views are rendered.

    Raises:
        FileNotFoundError: If there is no such PLY, or the run has no checkpoint yet.
        ValueError: If an option is out of range or a file damaged.
    """
    for option, value, low, high in (
        ("--count", args.count, 1, _MAX_COUNT),
        ("--info-pixels", args.info_pixels, 1, 10**9),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{option} must be in [{low}, {high}], got {value}; correct it")
    Wish.of(args)
    settings = args.settings()
    gaussians, run = load_scene(args.scene)
    pixels = args.info_pixels or _PIXELS
    if run is not None:
        pixels = args.info_pixels or fit_record(run).config.max_pixels
        if not any(text.startswith("background=") for text in args.overrides):
            settings = settings.replace(background=fit_record(run).config.settings.background)
    return Scene(gaussians, run, settings, pixels, args.strict)


def known_views(text: str | None, scene: Scene) -> Known:
    """The views of `--train`, else those that the run was fitted to.

    Args:
        text: A data set (all its views), a run (those it was fitted to), a cameras.json, or None.
        scene: Whose run is taken where `text` is None.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a PLY comes without `--train`, or a run's data set no longer has its views.
    """
    if text is None and scene.run is None:
        raise ValueError("a PLY has no record of its views: --train must name a data set, a run or a cameras.json")
    path = scene.run.path if text is None else Path(text)
    if is_camera_list(path):
        return Known([at_most(camera, scene.pixels) for camera in load_cameras_json(path)], str(path))
    if not _is_run(path):
        views = _load(path, scene).views
        return Known([_camera(view, {}, scene.pixels) for view in views], str(path), path.resolve())
    run = Run(path)
    data, names = fit_record(run).data, fitted_views(run)
    views = {view.name: view for view in _load(data, scene).views}
    if missing := [name for name in names if name not in views]:
        raise ValueError(
            f"{data}: must still hold the {len(names)} views of {path}, {missing[0]!r} is gone; restore it"
        )
    stated = [views[name] for name in names]
    checked = [view.checked() for view in stated]  # the fit has opened these images too
    size = lambda view: (view.camera.width, view.camera.height)  # noqa: E731
    sizes = {size(a): size(b) for a, b in zip(stated, checked, strict=True)}
    return Known([_camera(view, {}, scene.pixels) for view in checked], str(path), data.resolve(), sizes)


def other_views(option: str, text: str, args: Select | Fisher, scene: Scene, known: Known, fresh: bool):
    """Cameras of a data set, a run, a cameras.json, or made on an orbit or a dome; and where they come from.

    Args:
        option: Name of the option, for messages.
        text: Its value.
        args: Whose `split`, `count` and options of orbits apply.
        scene: For what is turned around.
        known: Views that are left out if `fresh`; the first one's lens serves orbits and domes.
        fresh: Leave out known views of the same data set.
    Returns:
        Cameras and a line of text.
    """
    path = Path(text)
    is_set = text not in ("orbit", "dome") and not is_camera_list(path)
    if args.split != "all" and not is_set:
        raise ValueError(f"--split {args.split} must have {option} DATA, {text} has no split; drop it")
    if text == "orbit":
        return _orbit(Wish.of(args), scene, known, args.count), f"orbit of {args.count}"
    if text == "dome":
        if args.span is not None:
            raise ValueError(f"--span must have {option} orbit, a dome goes all the way round; drop it")
        circle = dataclasses.replace(Wish.of(args), elevation=0.0, span=360.0)
        return dome(_orbit(circle, scene, known, 24), args.count), f"dome of {args.count}"
    if not is_set:
        return [at_most(camera, scene.pixels) for camera in load_cameras_json(path)], text
    every = 8
    if _is_run(path):
        record = fit_record(Run(path))
        path, every = record.data, record.config.test_every
    elif scene.run is not None:
        every = fit_record(scene.run).config.test_every
    dataset = _load(path, scene)
    train, test = dataset.split(every)
    views = {"all": sorted(train + test, key=lambda view: view.name), "train": train, "test": test}[args.split]
    same = path.resolve() == known.data
    used = {camera.name for camera in known.cameras} if same and fresh else set()
    left = [view for view in views if view.name not in used]
    if not left:
        raise ValueError(
            f"{text}: must hold a view that is not known yet, all {len(views)} of split {args.split} are; "
            f"use {option} orbit or dome, or another data set"
        )
    return [_camera(view, known.sizes if same else {}, scene.pixels) for view in left], f"{text} ({args.split})"


def dome(circle: list[Camera], count: int) -> list[Camera]:
    """Cameras on the upper half of a sphere, evenly: rings of equal steps in elevation.

    Args:
        circle: Cameras around the sphere's equator, evenly spaced, looking at its center; their lens is taken.
        count: How many.
    """
    centers = np.stack([camera.center for camera in circle])
    middle, up = centers.mean(axis=0), -circle[0].c2w[:3, 1]
    radius = float(np.linalg.norm(centers - middle, axis=1).mean())
    rings = max(1, round(math.sqrt(count * math.pi / 8)))  # as far apart as the cameras of a ring are
    elevations = 90 * (np.arange(rings) + 0.5) / rings
    share = np.cumsum(np.cos(np.radians(elevations)))
    ends = np.round(count * share / share[-1]).astype(int)
    made = []
    for elevation, number in zip(elevations, np.diff(ends, prepend=0), strict=True):
        if number:
            made += orbit(middle, radius, int(number), float(elevation), up=up)
    return [
        dataclasses.replace(circle[0], w2c=camera.w2c, name=f"dome_{index:04d}") for index, camera in enumerate(made)
    ]


def evenly(views: list, limit: int) -> list:
    """At most `limit` of them, the first one among them."""
    if len(views) <= limit:
        return views
    return [views[i * len(views) // limit] for i in range(limit)]


def seen_views(args: Crossval | Tradeoff) -> tuple[Gaussians, dict, list[Camera], str]:
    """What a command looks at and from where.

    Returns:
        The Gaussians; the settings that hold whatever the preset is (what --set says, over the run's background);
        pinhole cameras, as large as they are drawn; and where they come from in words.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If an option is out of range or a file damaged.
    """
    for option, value, low, high in (
        ("--limit", args.limit, 1, _MAX_COUNT),
        ("--max-pixels", args.max_pixels, 1, 10**9),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{option} must be in [{low}, {high}], got {value}; correct it")
    Wish.of(args)
    gaussians, run = load_scene(args.scene)
    fields = args.replaced()
    if run is not None:
        fields = {"background": fit_record(run).config.settings.background} | fields
    text = args.cameras or ("orbit" if run is None else str(run.path))
    cameras, source = cameras_of(args, text, gaussians, run, args.limit, (None, None))
    return gaussians, fields, [camera.undistorted() for camera in evenly(cameras, args.limit)], source


def _orbit(wish: Wish, scene: Scene, known: Known, count: int) -> list[Camera]:
    """Around what the known views look at, else around the Gaussians, with the first known view's lens.

    All the way round: what known views do not cover is what candidates are for.
    """
    lens = known.cameras[0]
    fov = min(2 * math.degrees(math.atan(0.5 * lens.width / lens.K[0, 0])), 170.0)
    how = {"width": lens.width, "height": lens.height, "wish": dataclasses.replace(wish, fov=fov)}
    walked = sorted(known.cameras, key=lambda camera: camera.name)  # an active run has them as they were picked
    cameras, _ = capture_orbit(walked, count, distance_of=seen_distance(scene.gaussians), beyond=True, **how)
    if not cameras:
        cameras = scene_orbit(scene.gaussians, count, **how)
    return [dataclasses.replace(camera, K=lens.K) for camera in cameras]


def _is_run(path: Path) -> bool:
    return (path / "config.json").is_file() and (path / "log.jsonl").is_file()


def _load(path: Path, scene: Scene):
    from drgs.data import load

    return load(path, lazy=True, points=False, strict=scene.strict)


def _camera(view: View, sizes: dict, pixels: int) -> Camera:
    camera = dataclasses.replace(view.camera.undistorted(), name=view.name)
    return at_most(resized_alike(camera, sizes), pixels)
