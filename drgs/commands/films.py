"""Frames of films for `drgs render`: how many there are, which times they show, flights and all-round views."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras import Camera, intrinsics
from drgs.codecs.ply import note_offset, save_ply
from drgs.commands.viewpoints import frame_size, one_a_place
from drgs.data.camera_layout import level_frame, upright
from drgs.data.camera_path import CameraPath, read_camera_path
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from drgs.commands.options import Render
    from drgs.commands.scene_input import SceneInput
    from drgs.ellipsoids import Scene
    from drgs.settings import RenderSettings

_DEFAULT_FRAMES = 60  # frames of an orbit, 2.5 s at 24 frames a second; chosen
_DEFAULT_FPS = 24.0  # frames a second, as in the cinema
_MOST_FRAMES = 100_000  # frames, more than an hour: a typing error
_PANORAMA_WIDTH = 2048  # pixels of width of a panorama: 0.18 degrees a pixel; chosen


@dataclasses.dataclass(frozen=True)
class Film:
    """How many frames there are, and how fast they are shown.

    Attributes:
        frames: Number of frames.
        fps: Frames a second.
        flight: The flight of --path, with --duration where it is given, else None.
    """

    frames: int
    fps: float
    flight: CameraPath | None = None


def check_flight_options(args: Render) -> None:
    """Raise ValueError for options that say the same twice, or that a flight, or a panorama, has no meaning for."""
    if args.duration is not None and args.frames is not None:
        raise ValueError(
            "render: --duration must be alone, --frames and --fps say how long a film is; drop one of both"
        )
    if args.path is not None:
        for option, value in (("--cameras", args.cameras), ("--view", args.view), ("--orbit", args.orbit)):
            if value:
                raise ValueError(f"render: --path must be alone, {option} names other cameras; drop one of both")
        if args.split != "all":
            raise ValueError("render: --path must be alone, --split is of the views of a data set; drop it")
    if args.panorama and args.width is not None and args.height is not None and args.width != 2 * args.height:
        raise ValueError(
            f"render: --panorama must be twice as wide as high, got {args.width}x{args.height}; drop one of the sides"
        )


def film_of(args: Render) -> Film:
    """What --path, --frames, --duration and --fps say together.

    Raises:
        FileNotFoundError, ValueError: If there is no such flight, or there would be too many frames.
    """
    flight = None if args.path is None else read_camera_path(args.path)
    stated = flight.fps if flight is not None else None
    fps = args.fps if args.fps is not None else stated or _DEFAULT_FPS
    if flight is not None and args.duration is not None:
        flight = dataclasses.replace(flight, duration=args.duration)
    if args.frames is not None:
        frames = args.frames
    elif flight is not None:
        frames = flight.frame_count(fps)
    else:
        frames = _DEFAULT_FRAMES if args.duration is None else max(1, round(args.duration * fps))
    if frames > _MOST_FRAMES:
        raise ValueError(
            f"render: there must be at most {_MOST_FRAMES} frames, got {frames}; lower --duration or --fps"
        )
    return Film(frames, fps, flight)


def flight_cameras(args: Render, film: Film, given: SceneInput, shape: float) -> tuple[list[Camera], str]:
    """Cameras of a flight's frames, and where they come from in words.

    Args:
        args: Options of the command, of which `path`, `width`, `height` and `time` apply.
        film: What they say of frames.
        given: What is drawn: only of what moves do times matter.
        shape: Height over width of frames, where neither the options nor the file say both.
    Raises:
        ValueError: If the flight has times, and `--time` says others, or they lie outside of the run's.
    """
    flight = film.flight
    assert flight is not None
    if flight.width is not None and flight.height is not None:
        shape = flight.height / flight.width
    is_sized = args.width is not None or args.height is not None
    size = (args.width, args.height) if is_sized else (flight.width, flight.height)
    cameras = flight.cameras(film.frames, *frame_size(*size, shape))
    if given.moving is None:
        return [dataclasses.replace(camera, time=None) for camera in cameras], f"flight {args.path}"
    if flight.keyframes[0].time is not None:
        if args.time is not None:
            raise ValueError("render: --time must be left out, the keyframes of --path have times; drop it")
        times = given.record.times if given.record else ()
        first, last = (times[0], times[-1]) if times else (-math.inf, math.inf)
        for k, key in enumerate(flight.keyframes):
            if key.time is not None and not first <= key.time <= last:
                raise ValueError(
                    f"{args.path}: keyframes[{k}]: time must be in {first:g}..{last:g}, the times of the run, got "
                    f"{key.time:g}; correct it"
                )
    return cameras, f"flight {args.path}"


# ------------------------------------------------------------------------------------------ panoramas


def check_panorama(settings: RenderSettings) -> None:
    """Raise ValueError for settings that draw pinholes alone, or leave out what is behind the camera."""
    if settings.planar:
        raise ValueError(
            f"render: --panorama must have settings that follow rays, response {settings.response!r} is a model of a "
            "pinhole's image plane; use --preset exact or fast"
        )
    if settings.near > 0:
        raise ValueError(
            f"render: --panorama must have near 0, got {settings.near:g}, which leaves out all behind the camera; use "
            "--preset exact or fast"
        )
    if settings.culling == "ut":
        raise ValueError(
            "render: --panorama must have culling by extent, the points of 'ut' do not reach around the poles; use "
            "--preset exact or fast"
        )


def panorama_size(args: Render) -> tuple[int, int]:
    """Width and height in pixels, 2:1."""
    width = args.width or (2 * args.height if args.height else _PANORAMA_WIDTH)
    return width, args.height or max(1, width // 2)


def level_panorama(camera: Camera, up: np.ndarray, width: int, height: int) -> Camera:
    """The camera that sees all round from a camera's place: upright, in its middle where the camera looks, leveled.

    Args:
        camera: Any camera.
        up: (3,) world direction of length 1 that is up.
        width, height: Pixels of the picture, 360 by 180 degrees.
    """
    right, _, ahead = level_frame(camera, up)
    rotation = np.stack([right, -up, ahead])
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    w2c[:3, 3] = -rotation @ camera.center
    K = intrinsics(width / (2 * math.pi), height / math.pi, width / 2, height / 2)
    return Camera(K=K, w2c=w2c, width=width, height=height, model="equirectangular", name=camera.name, time=camera.time)


def up_of(cameras: list[Camera], wished: tuple[float, float, float] | None) -> np.ndarray:
    """(3,) up: what --orbit up= says, else that of the cameras, the photographs' where there are some."""
    if wished is not None:
        return np.asarray(wished, np.float64) / np.linalg.norm(wished)
    return upright(cameras)


# ------------------------------------------------------------------------------------------------------ times of frames


def named_view(cameras: list[Camera], name: str | None, where: str) -> list[Camera]:
    """The camera of a name, or the first view of a camera of that name; all without a name.

    Raises:
        ValueError: If there is none.
    """
    if name is None:
        return cameras
    named = [camera for camera in cameras if camera.name == name or camera.name.startswith(f"{name}/")]
    if not named:
        known = list(dict.fromkeys(camera.name.rpartition("/")[0] or camera.name for camera in cameras))
        shown = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
        raise ValueError(f"--view must name one of the {len(cameras)} views of {where}: {shown}; got {name!r}")
    return named[:1]


def at_times(
    cameras: list[Camera], text: str | None, frames: int, given: SceneInput, is_film: bool = False
) -> list[Camera]:
    """The cameras with the times that they are drawn at.

    Args:
        cameras: The cameras of `--cameras`; at least one.
        text: What `--time` says; None: their own times or, where they have none, all times of the run, evenly.
        frames: How many of one camera, if the time alone moves.
        given: What is drawn; where it stands still, times mean nothing, and cameras stay as they are.
        is_film: Whether they are the frames of a film, each of which has its time; else equal poses count once.
    Returns:
        With one time, each pose once. With a range, the cameras in their order at times from its begin to its end; or
        `frames` times one camera, named by their numbers.
    Raises:
        ValueError: If nothing moves and there is a text, it is no time, or lies outside of the run's times.
    """
    if given.moving is None:
        if text is not None:
            raise ValueError("--time must have a scene that moves, this one stands still; drop it")
        return cameras
    times = given.record.times if given.record else ()
    first, last = (times[0], times[-1]) if times else (-math.inf, math.inf)
    if text is None:
        if all(camera.time is not None for camera in cameras):
            return cameras
        begin, end = first, last
    else:
        begin, end = _range(text)
        if not (first <= begin <= last and first <= end <= last):
            raise ValueError(f"--time must be in {first:g}..{last:g}, the times of the run, got {text!r}; correct it")
    if not is_film:
        cameras = one_a_place(cameras)  # synchronous cameras have a view for every time
    if begin == end:
        return [dataclasses.replace(camera, time=begin) for camera in cameras]
    if len(cameras) == 1 and not is_film:
        name = cameras[0].name or "view"
        cameras = [dataclasses.replace(cameras[0], name=f"{name}_{k:04d}") for k in range(frames)]
    moments = np.linspace(begin, end, len(cameras)) if len(cameras) > 1 else [begin]
    return [dataclasses.replace(camera, time=float(t)) for camera, t in zip(cameras, moments, strict=True)]


def _range(text: str) -> tuple[float, float]:
    """Begin and end of a range; one time is both."""
    try:
        ends = [float(part) for part in text.split("..")]
    except ValueError:
        ends = []
    if len(ends) not in (1, 2) or not all(math.isfinite(x) for x in ends):
        raise ValueError(f"--time must be a time or a range of two, e.g. 0.5 or 0..1, got {text!r}; correct it")
    return ends[0], ends[-1]


def ply_names(cameras: list[Camera]) -> dict[str, float | None]:
    """A file name for each distinct time, in the order of the cameras."""
    times = dict.fromkeys(camera.time for camera in cameras)
    return {f"gaussians_{k:04d}.ply": time for k, time in enumerate(times)}


def write_plys(scene: Scene, cameras: list[Camera], folder: Path, moving: bool, features: bool) -> list[dict]:
    """Write the Gaussians of each distinct time, every field as it is then.

    Args:
        scene: What is drawn.
        cameras: Cameras whose times count.
        folder: Folder of the files, which are named as `ply_names` says.
        moving: Whether only Gaussians that move, or are there for a time, are written.
        features: Whether they are written with their features, if they have any.
    Returns:
        JSON-serializable: file, time and number of Gaussians of each.
    Raises:
        ValueError: If only those that move are wanted, and none does.
    """
    from drgs.deform import DynamicGaussians

    chosen = scene.moving | scene.has_lifespan if isinstance(scene, DynamicGaussians) else None
    if moving and (chosen is None or not bool(chosen.any())):
        raise ValueError("--moving must have a scene where something moves, nothing does here; drop it")
    names = ply_names(cameras)
    written = []
    with Bar("PLY files", len(names)) as bar:
        for name, time in names.items():
            seen = scene.at(time).detach()  # a file holds values
            seen = seen if features else seen.replace(features=None)
            seen = seen.take(chosen) if moving else seen
            save_ply(seen, folder / name)
            written.append({"file": name, "time": time, "gaussians": len(seen)})
            bar.advance()
    note_offset(folder, seen.origin, "which headers state")
    return written
