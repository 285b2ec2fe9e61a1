"""`drgs render`: pictures and videos of a file of Gaussians or a finished run, from any cameras.

Which cameras, which settings, which files; the drawing is `drgs.render`, the files are pictures.py.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import statistics
import time
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera
from drgs.cameras.sizes import cropped
from drgs.commands.films import (
    Film,
    at_times,
    check_flight_options,
    check_panorama,
    film_of,
    flight_cameras,
    level_panorama,
    named_view,
    panorama_size,
    ply_names,
    up_of,
    write_plys,
)
from drgs.commands.options import Render
from drgs.commands.scene_input import SceneInput
from drgs.commands.semantic_pictures import PICTURE_KINDS, PictureFunction, picture_functions
from drgs.commands.values import parsed_formats
from drgs.commands.viewpoints import captured_cameras, check_lenses, views_to_render
from drgs.data.camera_layout import middle_camera
from drgs.data.camera_lists import camera_to_json, save_cameras_json
from drgs.display import pictures
from drgs.display.mp4 import Mp4, need_mp4
from drgs.display.progress import Bar, duration
from drgs.ellipsoids import Gaussians, Scene, colors_only
from drgs.fitting.resume import lock_output
from drgs.integrator import render
from drgs.io.journal import SCHEMA
from drgs.io.outputs import lock_folder, write_json
from drgs.runtime import memory
from drgs.settings import RenderSettings

_log = logging.getLogger(__name__)

_FORECAST_PIXELS = 500_000  # pixels of all views; for fewer, a forecast takes as long as rendering
_LONG_SECONDS = 10.0  # seconds from which on the forecast is printed; chosen
_FILMS: Mapping[str, Any] = {"webm": pictures.Video, "mp4": Mp4}
_PICTURES = ("png", "jpg", "exr")
_EXTRA_PICTURES = ("depth", "features", "labels", "overlay", "moving")  # options that write more files than one
_BAND_PLACES = (0.125, 0.375, 0.625, 0.875)  # of the height: where bands are timed, one in each quarter
_BAND_HEIGHT = 1 / 32  # of the height: each band; an eighth of the view is rendered for the forecast


def run(args: Render) -> None:
    """`drgs render SCENE`."""
    settings = args.settings()
    single = single_file(args)
    if single is not None:
        args = dataclasses.replace(args, output=single.folder, format=single.format)
    formats = parsed_formats("png" if args.format is None else args.format)
    _check(args, settings, formats)
    film = film_of(args)
    views = _views_of(args)
    movie = "flight" if args.path is not None else "turntable" if views == "orbit" else "video"
    if single is not None:
        movie = single.stem
    kinds = [kind for kind in PICTURE_KINDS if getattr(args, kind)]
    movies = [_movie_of(movie, kind, end) for end in _FILMS if end in formats for kind in ("", *kinds)]
    fixed = ["render.json", "cameras.json", *movies] if single is None else [single.name]
    lock = lock_output if single is None else lock_folder  # one file is named, and may well be in a run folder
    output = lock(args.output, "render", fixed, [args.scene, views, *([args.path] if args.path else [])])
    given = SceneInput.of(args)
    paint = picture_functions(kinds, given, args.scene)
    gaussians = given.gaussians if paint else given.colors
    settings = given.over_background(settings)
    settings = settings if "exr" in formats else settings.for_pictures()
    cameras, source = _cameras_of(args, views, film, given, settings)
    if single is not None:
        cameras = single.named(cameras)
    _check_memory(cameras, settings, formats, 0 if gaussians.features is None else gaussians.features.shape[1])
    ends = [*(kind for kind in formats if kind not in (*_FILMS, "ply")), *(["depth.png"] * args.depth)]
    ends += [f"{kind}.png" for kind in kinds]
    output.check(f"{name}.{end}" for name in pictures.file_names([x.name for x in cameras]) for end in ends)
    if "ply" in formats:
        output.check(ply_names(cameras))
    if not args.quiet:
        _print_forecast(args, gaussians, cameras, settings)
    with Bar("render", len(cameras), not args.quiet) as bar:
        report = render_views(
            gaussians if given.moving is None else given.moving,
            cameras,
            settings,
            args.output,
            formats=formats,
            depth=args.depth,
            fps=film.fps,
            video=movie,
            paint=paint,
            advance=bar.advance,
        )
    report = {"scene": str(args.scene), "cameras": source, "gaussians": len(gaussians)} | report
    if single is not None:
        args.say(_summary(report, single.path))
        return
    _write_lists(args, report, film, given, cameras, formats)
    args.say(_summary(report, args.output))


def _check(args: Render, settings: RenderSettings, formats: tuple[str, ...]) -> None:
    """Raise ValueError for options that contradict each other, before anything is read."""
    check_flight_options(args)
    if args.moving and "ply" not in formats:
        raise ValueError("render: --moving must have ply among --format, which only it means; add it or drop --moving")
    if args.panorama:
        check_panorama(settings)
    if "mp4" in formats:
        need_mp4("render: --format mp4")


def _write_lists(
    args: Render, report: dict[str, Any], film: Film, given: SceneInput, cameras: list[Camera], formats: tuple[str, ...]
) -> None:
    """Write the files beside pictures and films: ply files, cameras.json, render.json."""
    if film.flight is not None:
        report["flight"] = {
            "path": str(args.path),
            "keyframes": len(film.flight.keyframes),
            "loop": film.flight.loop,
            "seconds": film.flight.seconds,
        }
    if "ply" in formats:
        report["ply"] = write_plys(given.scene, cameras, args.output, args.moving, args.features)
    if all(not camera.is_distorted and camera.K[0, 1] == 0 for camera in cameras):
        save_cameras_json(args.output / "cameras.json", cameras)
    else:
        args.say(
            "no cameras.json: its layout has no lens and no skew; render.json holds the cameras, --cameras reads it",
        )
    write_json(args.output / "render.json", {"schema": SCHEMA, "command": "render"} | report)


def _is_one_place(args: Render) -> bool:
    """Whether there is one panorama, from where the middle photograph was taken."""
    return args.panorama and not (args.path or args.cameras or args.view or args.orbit)


def _views_of(args: Render) -> str:
    """Where cameras come from: what `--cameras` names, else the run or an orbit.

    Raises:
        ValueError: If a panorama has no place.
    """
    is_of_run = (args.view or _is_one_place(args)) and args.scene.is_dir()
    views = args.cameras or (str(args.scene) if is_of_run else "orbit")
    if _is_one_place(args) and views == "orbit":
        raise ValueError("render: --panorama must have a place, a file of Gaussians has none; add --path or --cameras")
    return views


def _cameras_of(
    args: Render, views: str, film: Film, given: SceneInput, settings: RenderSettings
) -> tuple[list[Camera], str]:
    """The cameras that are drawn, at their sizes and times, and where they come from in words."""
    is_flight = film.flight is not None
    photographs = captured_cameras(given) if args.panorama or is_flight else []
    if is_flight:
        shape = photographs[0].height / photographs[0].width if photographs else 0.75
        cameras, source = flight_cameras(args, film, given, shape)
    else:
        cameras, source = views_to_render(args, views, given, film.frames, (args.width, args.height), returns=True)
        cameras = [middle_camera(cameras)] if _is_one_place(args) else named_view(cameras, args.view, source)
    placed = photographs or cameras
    cameras = at_times(cameras[: args.limit], args.time, film.frames, given, is_film=is_flight)
    if args.panorama:
        up, across = up_of(placed, args.orbit_shape.up), panorama_size(args)
        cameras = [level_panorama(camera, up, *across) for camera in cameras]
    else:
        cameras = [_resized(camera, args.width, args.height) for camera in cameras]
    follows = args.undistort == "auto" and settings.traversal == "bvh"
    bent = sum(camera.is_distorted for camera in cameras)
    if bent and not args.panorama and not (follows or given.keeps_lenses(args.undistort)):
        cameras = [camera.undistorted() for camera in cameras]
        args.say(f"{bent} cameras have a lens: drawn without it; --undistort off draws through it")
    check_lenses("render", settings, cameras)
    return cameras, source


def render_views(
    scene: Scene,
    cameras: list[Camera],
    settings: RenderSettings,
    out_dir: Path,
    *,
    formats: tuple[str, ...] = ("png",),
    depth: bool = False,
    fps: float = 24.0,
    video: str = "video",
    paint: Mapping[str, PictureFunction] = types.MappingProxyType({}),
    advance: Callable[[], None] | None = None,
) -> dict:
    """Render cameras to files, each of which appears once it is complete.

    Args:
        scene, cameras, settings: Arguments of `drgs.render`, with a list of cameras; without `paint`, features are left
            out.
        out_dir: Folder of the files; made if absent.
        formats: Any of png (8 bits, clamped, no transfer function), jpg (quality 95), exr (float32; R G B, A, and Z,
            the distance along the ray), webm and mp4 (one video each); others are left to the caller.
        depth: A color-mapped `NAME.depth.png` for each view, too.
        fps: Frames a second of the video.
        video: Name of the video without its suffix.
        paint: Kind -> what draws it, a `NAME.KIND.png` for each view, and `VIDEO.KIND.webm` or `.mp4` beside the video.
        advance: Called after each view.
    Returns:
        JSON-serializable: settings, backend, seconds (first, median of the others, total), rays and
        redone (rays whose exact order took more than one pass, on bvh; None where the order is not exact),
        and views (camera, files, seconds, rays, redone).
    """
    outputs = ("depth",) if depth or "exr" in formats else ()
    views: list[dict[str, Any]] = []
    seen = False
    with contextlib.ExitStack() as stack:
        films = {end: film for end, film in _FILMS.items() if end in formats}
        movies: dict[str, list] = {
            kind: [stack.enter_context(film(out_dir / _movie_of(video, kind, end), fps)) for end, film in films.items()]
            for kind in ("", *paint)
        }
        for camera, name in zip(cameras, pictures.file_names([camera.name for camera in cameras]), strict=True):
            began = time.perf_counter()
            with torch.no_grad():  # a picture
                out = render(scene if paint else colors_only(scene, camera.time), camera, settings, outputs)
            rgb, alpha = out.rgb.cpu().numpy(), out.alpha.cpu().numpy()
            seconds = time.perf_counter() - began
            distance = out.depth.cpu().numpy() if out.depth is not None and outputs else None
            files = _write_pictures(out_dir, name, camera, rgb, alpha, distance, (*formats, *["depth"] * depth))
            for kind, painter in paint.items():
                painted = painter(out)
                files.append(f"{name}.{kind}.png")
                pictures.write_png(out_dir / files[-1], painted)
                for movie in movies[kind]:
                    movie.write(painted)
            for movie in movies[""]:
                movie.write(rgb)
            seen = seen or bool(alpha.any())
            counts = {key: _number(out.certificate.get(key)) for key in ("rays", "redone")}
            views.append({"camera": camera_to_json(camera), "files": files, "seconds": seconds, **counts})
            if advance:
                advance()
    if not seen:
        text = "none of the %d views shows anything of the scene: do the cameras belong to it? (near is %g, extent %s)"
        _log.warning(text, len(views), settings.near, settings.extent)
    return _report(settings, views, [movie.path.name for some in movies.values() for movie in some], fps)


def _write_pictures(
    folder: Path,
    name: str,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    distance: np.ndarray | None,
    kinds: tuple[str, ...],
) -> list[str]:
    """Write the pictures of a view that are among its kinds; the names of their files."""
    files = []
    if "png" in kinds:
        files.append(f"{name}.png")
        pictures.write_png(folder / files[-1], rgb)
    if "jpg" in kinds:
        files.append(f"{name}.jpg")
        pictures.write_jpg(folder / files[-1], rgb, is_panorama=_is_full_panorama(camera))
    if "exr" in kinds:
        files.append(f"{name}.exr")
        pictures.write_exr(folder / files[-1], rgb, A=alpha, Z=distance)
    if "depth" in kinds:
        files.append(f"{name}.depth.png")
        pictures.write_png(folder / files[-1], pictures.depth_picture(distance, alpha))
    return files


def _report(settings: RenderSettings, views: list[dict[str, Any]], movies: list[str], fps: float) -> dict[str, Any]:
    """Result of `render_views`."""
    times = [view["seconds"] for view in views]
    return {
        "settings": dataclasses.asdict(settings),
        "backend": runtime.backend().variant,
        "threads": runtime.backend().threads,
        "seconds": {"first": times[0], "median": statistics.median(times[1:] or times), "total": sum(times)},
        **{key: _total(view[key] for view in views) for key in ("rays", "redone")},
        "video": movies[0] if movies else None,
        "videos": movies,
        "fps": fps if movies else None,
        "views": views,
    }


# ------------------------------------------------------------------------------------------ inputs


def _movie_of(video: str, kind: str, end: str) -> str:
    """File name of the video of a kind of picture, "" of the colors."""
    return f"{video}.{kind}.{end}" if kind else f"{video}.{end}"


def _is_full_panorama(camera: Camera) -> bool:
    """Whether a camera sees all round, 360 by 180 degrees."""
    if camera.model != "equirectangular":
        return False
    return math.isclose(camera.K[0, 0] * math.tau, camera.width) and math.isclose(
        camera.K[1, 1] * math.pi, camera.height
    )


def _resized(camera: Camera, width: int | None, height: int | None) -> Camera:
    """The camera at --width and --height; one of these alone keeps the shape."""
    if width is None and height is None:
        return camera
    if width is None:
        width = max(1, round(camera.width * height / camera.height))
    if height is None:
        height = max(1, round(camera.height * width / camera.width))
    return camera.resized(width, height)


def _check_memory(cameras: list[Camera], settings: RenderSettings, formats: tuple[str, ...], features: int) -> None:
    """Refuse a view that is too large to be rendered and written, before the first one is."""
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    pixels = largest.width * largest.height
    pictures_need = max(memory.PICTURES.get(name, 0) for name in formats)
    where = f"view {largest.name!r}"
    what = f"its {largest.width}x{largest.height} pixels"
    needed = memory.frame_bytes(pixels, settings.traversal, features)
    if runtime.backend().name == "cuda":
        memory.require(where, needed, what, "lower --width or --height", cuda=True)
        needed = 0
    memory.require(where, needed + pictures_need * pixels, what, "lower --width or --height")


# ----------------------------------------------------------------------------------------- outputs


def _number(value: torch.Tensor | int | None) -> int | None:
    return None if value is None else int(value)


def _total(values: Iterable[int | None]) -> int | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _summary(report: dict, folder: Path) -> str:
    views, seconds = report["views"], report["seconds"]
    text = (
        f"{len(views)} views of {report['gaussians']} Gaussians in {seconds['total']:.1f} s "
        f"(first {seconds['first']:.2f} s, then {seconds['median']:.3f} s a view): {folder}"
    )
    if report["redone"]:
        share = report["redone"] / max(report["rays"], 1)
        text += f"\nexact order: {report['redone']} of {report['rays']} rays ({share:.2%}) took more than one pass"
    return text


def _print_forecast(args: Render, gaussians: Gaussians, cameras: list[Camera], settings: RenderSettings) -> None:
    """Print a forecast of the time with exact order on every ray, which may take minutes."""
    if settings.order != "ray" or sum(camera.width * camera.height for camera in cameras) < _FORECAST_PIXELS:
        return
    seconds = forecast(gaussians, cameras, settings)
    if seconds > _LONG_SECONDS:
        what = f"{args.preset}, {len(cameras)} views of {cameras[0].width}x{cameras[0].height}"
        args.say(
            f"{what} will take about {duration(seconds)} on this machine; --preset fast takes a small part of that",
        )


# ---------------------------------------------------------------------------------------------------- how long it takes


def forecast(gaussians: Gaussians, cameras: list[Camera], settings: RenderSettings) -> float:
    """Forecast of the seconds of all views, kernels compiled; it takes about a fifth of one view's time itself.

    Args:
        gaussians: Gaussians to be rendered.
        cameras: Views to be rendered, at least one.
        settings: Settings that they are rendered by.
    """
    first = cameras[0]
    rows = max(2, round(first.height * _BAND_HEIGHT))

    def seconds(place: float, height: int) -> float:
        band = cropped(first, 0, int(place * max(first.height - height, 0)), first.width, height)
        began = time.perf_counter()
        with torch.no_grad():  # as views are drawn: a graph would take time of its own
            render(gaussians, band, settings, ()).rgb.cpu().numpy()
        return time.perf_counter() - began

    with Bar("how long it will take", len(_BAND_PLACES)) as bar:
        seconds(0.5, rows)  # compiles the kernels
        view = row = 0.0
        for place in _BAND_PLACES:
            # What projecting and sorting all Gaussians takes, however small the image is, and what its rows take.
            least = seconds(place, 1)
            each = max(seconds(place, rows) - least, 0.0) / (rows - 1)
            view += max(least - each, 0.0) / len(_BAND_PLACES)
            row += each / len(_BAND_PLACES)
            bar.advance()
    pixels = sum(camera.width * camera.height for camera in cameras)
    return view * len(cameras) + row * pixels / first.width


# --------------------------------------------------------------------------------------- one file and nothing beside it


@dataclasses.dataclass(frozen=True)
class SingleFile:
    """A film, or a picture, that is written alone.

    Attributes:
        path: Path of the file, as it was given.
    """

    path: Path

    @property
    def folder(self) -> Path:
        """Folder of the file."""
        return self.path.parent

    @property
    def name(self) -> str:
        """Name of the file in its folder."""
        return self.path.name

    @property
    def stem(self) -> str:
        """Name of the film, or of the view, without its suffix."""
        return self.path.stem

    @property
    def format(self) -> str:
        """Its format."""
        return self.path.suffix[1:]

    def named(self, cameras: list[Camera]) -> list[Camera]:
        """The cameras, the one of a picture by the name of the file.

        Raises:
            ValueError: If a picture would be of several cameras.
        """
        if self.format in _FILMS:
            return cameras
        if len(cameras) != 1:
            raise ValueError(
                f"{self.path}: must be a folder for {len(cameras)} views, a file holds one; name a folder, or choose "
                "with --view or --limit 1"
            )
        return [dataclasses.replace(cameras[0], name=self.stem)]


def single_file(args: Render) -> SingleFile | None:
    """The file that `-o` names; None where it names a folder: one that is there, or a name without such a suffix.

    Raises:
        ValueError: If `--format`, or an option that writes more files, says otherwise; or for a picture's name that
            would be written otherwise.
    """
    path = args.output
    known = (*_FILMS, *_PICTURES)
    if path.suffix[1:].lower() not in known or path.is_dir():
        return None
    if path.suffix[1:] not in known:
        raise ValueError(f"{path}: must end in {path.suffix.lower()} in small letters; rename it")
    single = SingleFile(path)
    if args.format not in (None, single.format):
        raise ValueError(
            f"render: --format must be left out with -o {path}, got {args.format!r}; drop it, or name a folder"
        )
    for name in _EXTRA_PICTURES:
        if getattr(args, name):
            raise ValueError(f"render: --{name} must have a folder to write into, -o {path} is one file; name a folder")
    if single.format in _PICTURES and pictures.file_names([single.stem]) != [single.stem]:
        raise ValueError(f"{path}: must have a name of letters, digits, - _ and . alone; rename it")
    return single
