"""Which views an option names: --cameras, --candidates and --train, the same for every command.

    orbit, dome     cameras made around what there is to see (orbits.py)
    a cameras.json  its list; a model folder of INRIA's stands for the one in it; a selection.json or another file of a
                    command, its picks or views
    a run           the views of its data set, split as for its fit; as known views, those that it was fitted to
    a data set      its views, split as for the fit of the command's run, if there is one

No image is decoded. Where views are compared with known ones none is even opened: their size is what the camera file
states (that of a known view of a run: of its image file).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from drgs import data
from drgs.cameras.sizes import at_most, resized_alike
from drgs.codecs.folders import cameras_of_model
from drgs.commands.frames import DATAPARSER_TRANSFORMS
from drgs.commands.options import SIDE, Crossval, Fisher, Query, Render, Select, Tradeoff, Views
from drgs.commands.orbits import capture_orbit, dome, scene_orbit
from drgs.commands.values import UP, OrbitShape
from drgs.data.camera_lists import is_camera_list, load_cameras_json
from drgs.fitting.config import FitConfig
from drgs.fitting.records import FitRecord, fit_record, fitted_views, is_run
from drgs.io.run import Run
from drgs.meshing.depths import seen_distance

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from drgs.cameras import Camera
    from drgs.commands.scene_input import SceneInput
    from drgs.data import Dataset, View
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

_DEFAULT_PIXELS = 130_000  # pixels of a view without a run, as `max_pixels` of a fit
# At most so many are checked for whether cameras see any of the scene at all; chosen for their seconds.
_CHECKED_GAUSSIANS = 20_000
_CHECKED_CAMERAS = 50
_log = logging.getLogger(__name__)
_NOUNS = {"orbit": "an orbit", "dome": "a dome", "list": "a list of cameras"}


@dataclasses.dataclass(frozen=True)
class Source:
    """Where views come from, as an option says it.

    Attributes:
        option: Name of the option, for messages.
        text: Value of the option.
        kind: `orbit`, `dome`, `list` (of cameras, in JSON), `run` or `data`.
        given: The command's scene, so that the record of its run is read once.
    """

    option: str
    text: str
    kind: Literal["orbit", "dome", "list", "run", "data"]
    given: SceneInput | None = None

    @classmethod
    def of(cls, option: str, text: str, generated: tuple[str, ...] = (), given: SceneInput | None = None) -> Source:
        """The meaning of a text.

        Args:
            option, text: Name and value of the option.
            generated: Those of `orbit` and `dome` that the option may be.
            given: The command's scene.
        """
        if text in generated:
            return cls(option, text, text)
        path = cameras_of_model(Path(text)) or Path(text)
        text = str(path)
        return cls(option, text, "list" if is_camera_list(path) else "run" if is_run(path) else "data", given)

    @classmethod
    def known(cls, text: str | None, given: SceneInput) -> Source:
        """The views of `--train`, else those of the command's run."""
        return cls("--train", str(given.run.path), "run", given) if text is None else cls.of("--train", text, (), given)

    @functools.cached_property
    def record(self) -> FitRecord | None:
        """The record of its fit, if it is a run."""
        if self.kind != "run":
            return None
        run = Run(Path(self.text))
        if (
            self.given is not None
            and self.given.run is not None
            and self.given.run.path.resolve() == run.path.resolve()
        ):
            return self.given.record
        return fit_record(run)

    def check_split(self, split: str) -> None:
        """Raise ValueError if `--split` asks for a part of what has none."""
        if split != "all" and self.kind in _NOUNS:
            noun = _NOUNS[self.kind]
            raise ValueError(f"--split {split} must have {self.option} DATA, {noun} has no split; drop it")

    def listed(self) -> list[Camera]:
        """The cameras of a list."""
        return load_cameras_json(Path(self.text))

    def dataset(self, args: Views, given: SceneInput, lazy: bool = True) -> Dataset:
        """The data set, or that of a run, without points, maps and labels; of videos, the frames and test cameras that
        `args` names, else those of the run that is named, else of the command's run.

        Raises:
            FileNotFoundError, ValueError: If there is none, or a run's is no longer where it was.
        """
        place = Path(self.text)
        if self.record is not None:
            self.record.check_data(place, f"name cameras with {self.option}")
            place = self.record.data
        config = record.config if (record := self.record or given.record) else FitConfig()
        dataset = data.load(
            place,
            lazy=lazy,
            points=False,
            strict=args.strict,
            semantics=False,
            times=config.data.times if args.times is None else args.times,
            test_cameras=config.data.test_cameras if args.test_cameras is None else args.test_cameras,
        )
        if record is None or record.data.resolve() != place.resolve():
            return dataset
        return record.with_refined_poses(dataset)

    def split(self, dataset: Dataset, part: str, given: SceneInput) -> list[View]:
        """The views of `--split`, by the rule of the run that is named, else of the command's run, else every
        8th view.

        Raises:
            ValueError: If there is none.
        """
        record = self.record or given.record
        held_out = (record.config.data.test_every, record.config.data.test_offset) if record else ()
        train, test = dataset.split(*held_out)
        views = {"all": sorted(train + test, key=lambda view: view.name), "train": train, "test": test}[part]
        if not views:
            rule = dataset.split_rule(*held_out)
            raise ValueError(f"{self.text}: split {part} must hold a view, holds none ({rule}); use --split all")
        return views


# ------------------------------------------------------------------------------- views that are rendered


def views_to_render(
    args: Render | Crossval | Query | Tradeoff,
    text: str,
    given: SceneInput,
    frames: int,
    size: tuple[int | None, int | None] = (None, None),
    returns: bool = False,
) -> tuple[list[Camera], str]:
    """The cameras of `--cameras` as they are, and where they come from in words.

    Args:
        args: Options of the command, of which `split` and those of orbits apply.
        text: What `--cameras` says.
        given: The command's scene, around which an orbit goes, like the photographs of its run if there is one.
        frames, size: Number of views of an orbit and their (width, height); where one is None, 640 wide and of the
            photographs' shape, else 4:3.
        returns: Whether an orbit that is no full circle goes back and forth.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If an option is out of range or a file damaged, or a split has no view.
    """
    source = Source.of("--cameras", text, ("orbit",), given)
    source.check_split(args.split)
    if source.kind == "orbit":
        return _orbit_to_render(args, given, frames, size, returns)
    if source.kind == "list":
        return source.listed(), str(Path(text))
    views = source.split(source.dataset(args, given, lazy=False), args.split, given)
    return [_with_name(view) for view in views], f"{Path(text)} ({args.split})"


def views_to_sample(
    args: Crossval | Query | Tradeoff, given: SceneInput, lenses: bool = False
) -> tuple[list[Camera], str]:
    """At most `--limit` cameras of `--cameras`, at the size that is rendered; and where they come from, in words.

    Args:
        args: Options of the command.
        given: The command's scene.
        lenses: Cameras keep their lenses; else all are pinholes.
    Raises:
        FileNotFoundError, ValueError: As `views_to_render`.
    """
    text = args.cameras or ("orbit" if given.run is None else str(given.run.path))
    cameras, source = views_to_render(args, text, given, args.limit)
    return [_with_lens(camera, lenses) for camera in evenly(cameras, args.limit)], source


def _orbit_to_render(
    args: Render | Crossval | Query | Tradeoff,
    given: SceneInput,
    frames: int,
    size: tuple[int | None, int | None],
    returns: bool,
) -> tuple[list[Camera], str]:
    """An orbit like the photographs of the run were taken, else around the Gaussians; and its description."""
    captured = captured_cameras(given)
    shape = captured[0].height / captured[0].width if captured else 0.75
    width, height = frame_size(*size, shape)
    fixed = args.orbit_shape
    how = {"width": width, "height": height, "fixed": fixed, "returns": returns}
    cameras, source = capture_orbit(captured, frames, distance_of=seen_distance(given.gaussians), **how)
    if cameras:
        args.say(source)
        return cameras, source
    if fixed.up is None:
        args.say("orbit with minus-y up, as COLMAP's worlds stand; turn it with --orbit up=z")
    up = next(name for name, direction in UP.items() if direction == (fixed.up or UP["minus-y"]))
    return scene_orbit(given.gaussians, frames, **how), f"orbit, up {up}"


def captured_cameras(given: SceneInput) -> list[Camera]:
    """Cameras of the photographs that a run was fitted to, in their order; none if they are no longer there."""
    if given.run is None:
        return []
    try:
        names = set(fitted_views(given.run, given.record))
        views = given.record.dataset().views
    except (ValueError, OSError, KeyError):
        return []
    return [view.camera.undistorted() for view in views if view.name in names]


def frame_size(width: int | None, height: int | None, shape: float) -> tuple[int, int]:
    """Width and height of an orbit's frames, the missing ones by their shape (height / width)."""
    if width is None:
        width = 640 if height is None else max(1, min(SIDE[1], round(height / shape)))
    return width, height or max(1, min(SIDE[1], round(width * shape)))


# ----------------------------------------------------------------- views that are compared with known ones


@dataclasses.dataclass(frozen=True)
class Known:
    """Views whose information is known already.

    Attributes:
        cameras: Reduced; pinholes, unless lenses are kept.
        source: Where they come from, in words.
        pixels: Largest number of pixels of these views and of those that are compared with them.
        data: The data set that they are of, or None.
        sizes: Stated size -> size of the image file, as far as known.
        lenses: Cameras that are compared with them keep their lenses as these do.
        views: Views of a data set that the cameras are of, in their order; none of a list of cameras.
    """

    cameras: list[Camera]
    source: str
    pixels: int
    data: Path | None = None
    sizes: dict[tuple[int, int], tuple[int, int]] = dataclasses.field(default_factory=dict)
    lenses: bool = False
    views: Sequence[View] = ()


def known_views(
    text: str | None, args: Views, given: SceneInput, lenses: bool = False, pixels: int | None = None
) -> Known:
    """The views of `--train`, else those that the run was fitted to.

    Args:
        text: A data set (all its views), a run (those it was fitted to), a cameras.json, or None.
        args: How data sets are read.
        given: The command's scene, whose run is taken where `text` is None.
        lenses: Cameras keep their lenses, these and those that are compared with them.
        pixels: Largest number of pixels of a view; None: that of the fit.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a file of Gaussians comes without `--train`, or a run's data set no longer has its views.
    """
    if text is None and given.run is None:
        raise ValueError(
            "a file of Gaussians has no record of its views: --train must name a data set, a run or a cameras.json, "
            "e.g. the photographs and poses that it was trained on"
        )
    known = _known_views(text, args, given, lenses, pixels)
    if text is not None:
        warn_of_unseen(given.gaussians, known.cameras)
    return known


def _known_views(text: str | None, args: Views, given: SceneInput, lenses: bool, pixels: int | None) -> Known:
    """The views of `known_views`; not checked for whether they show the scene."""
    source = Source.known(text, given)
    pixels = pixels or (_DEFAULT_PIXELS if given.record is None else given.record.config.data.max_pixels)
    where = str(Path(source.text))
    if source.kind == "list":
        cameras = [at_most(_with_lens(camera, lenses), pixels) for camera in source.listed()]
        return Known(cameras, where, pixels, lenses=lenses)
    views = source.dataset(args, given).views
    if source.kind == "data":
        cameras = [_camera(view, {}, pixels, lenses) for view in views]
        return Known(cameras, where, pixels, Path(source.text).resolve(), lenses=lenses, views=views)
    place = source.record.data
    names = fitted_views(Run(Path(source.text)), source.record)
    named = {view.name: view for view in views}
    if missing := [name for name in names if name not in named]:
        raise ValueError(
            f"{place}: must still hold the {len(names)} views of {where}, {missing[0]!r} is gone; restore it"
        )
    stated = [named[name] for name in names]
    checked = [view.checked() for view in stated]  # the fit has opened these images too
    size = lambda view: (view.camera.width, view.camera.height)  # noqa: E731
    sizes = {size(a): size(b) for a, b in zip(stated, checked, strict=True)}
    cameras = [_camera(view, {}, pixels, lenses) for view in checked]
    return Known(cameras, where, pixels, place.resolve(), sizes, lenses, checked)


def held_out_views(args: Views, given: SceneInput, known: Known) -> list[Camera]:
    """Cameras of the views that a run was not fitted to, reduced as the known ones are.

    Args:
        args: How data sets are read.
        given: The command's scene, a run.
        known: The views that it was fitted to.
    Raises:
        FileNotFoundError, ValueError: If its data set has gone, or there is none.
    """
    assert given.run is not None
    source = Source("--cameras", str(given.run.path), "run", given)
    views = source.split(source.dataset(args, given), "test", given)
    return [_camera(view, known.sizes, known.pixels, known.lenses) for view in views]


def warn_of_unseen(gaussians: Gaussians, cameras: list[Camera]) -> None:
    """Warn if most of the cameras see no Gaussian's center: the file may be in another coordinate frame."""
    means = gaussians.means[:: max(1, len(gaussians) // _CHECKED_GAUSSIANS)].detach().cpu().numpy() + gaussians.origin
    looked = evenly(cameras, _CHECKED_CAMERAS)
    blind = sum(not camera.contains(camera.project(means)[0]).any() for camera in looked)
    if blind > len(looked) / 2:
        _log.warning(
            "%d of %d known views show nothing of the scene: do the cameras belong to it? (a splat of ns-export is in "
            "nerfstudio's frame: put %s of its run beside the file)",
            blind,
            len(looked),
            DATAPARSER_TRANSFORMS,
        )


def views_to_compare(
    option: str, text: str, args: Select | Fisher, given: SceneInput, known: Known, fresh: bool
) -> tuple[list[Camera], str]:
    """Cameras to be compared with known views, reduced like these, and where they come from, in words.

    Args:
        option: Name of the option, for messages.
        text: Value of the option.
        args: Options of the command, of which `split`, `count` and those of orbits apply.
        given: The command's scene.
        known: Views that are left out if `fresh`; the first one's lens serves orbits and domes.
        fresh: Leave out known views of the same data set.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If an option is out of range or a file damaged, or no view is left.
    """
    source = Source.of(option, text, ("orbit", "dome"), given)
    source.check_split(args.split)
    if source.kind in ("list", "data") and not Path(source.text).exists():
        raise FileNotFoundError(
            f"{option} {text}: must be cameras, a data set or a run, found no such file or folder; check the path, or "
            f"take {option} dome or orbit, which need none"
        )
    if source.kind == "orbit":
        return _compared_orbit(args.orbit_shape, given, known, args.count), f"orbit of {args.count}"
    if source.kind == "dome":
        fixed = args.orbit_shape
        if fixed.span is not None:
            raise ValueError(f"--orbit span must have {option} orbit, a dome goes all the way round; drop it")
        circle = dataclasses.replace(fixed, elevation=0.0, span=360.0)
        return dome(_compared_orbit(circle, given, known, 24), args.count), f"dome of {args.count}"
    if source.kind == "list":
        return [at_most(_with_lens(camera, known.lenses), known.pixels) for camera in source.listed()], text
    views = source.split(source.dataset(args, given), args.split, given)
    same = (source.record.data if source.kind == "run" else Path(text)).resolve() == known.data
    used = {camera.name for camera in known.cameras} if same and fresh else set()
    left = [view for view in views if view.name not in used]
    if not left:
        raise ValueError(
            f"{text}: must hold a view that is not known yet, all {len(views)} of split {args.split} are; "
            f"use {option} orbit or dome, or another data set"
        )
    sizes = known.sizes if same else {}
    return [_camera(view, sizes, known.pixels, known.lenses) for view in left], f"{text} ({args.split})"


def with_times(cameras: list[Camera], args: Select | Fisher, given: SceneInput) -> list[Camera]:
    """Cameras with the time of `--time` where they state none, if the scene moves.

    Raises:
        ValueError: If one has no time then.
    """
    if given.moving is None:
        return cameras
    found = [camera if camera.time is not None else dataclasses.replace(camera, time=args.time) for camera in cameras]
    for camera in found:
        if camera.time is None:
            raise ValueError(
                f"{args.scene}: cameras must have a time, as the scene moves, {camera.name or 'one'!r} has none; "
                "say --time"
            )
    return found


def _compared_orbit(fixed: OrbitShape, given: SceneInput, known: Known, count: int) -> list[Camera]:
    """An orbit around what the known views look at, else around the Gaussians, with the first known view's lens.

    It is a full circle, as candidates are to cover what known views do not.
    """
    lens = known.cameras[0]
    fov = min(2 * math.degrees(math.atan(0.5 * lens.width / lens.K[0, 0])), 170.0)
    how = {"width": lens.width, "height": lens.height, "fixed": dataclasses.replace(fixed, fov=fov)}
    walked = sorted(known.cameras, key=lambda camera: camera.name)  # an active run has them as they were picked
    cameras, _ = capture_orbit(walked, count, distance_of=seen_distance(given.gaussians), beyond=True, **how)
    if not cameras:
        cameras = scene_orbit(given.gaussians, count, **how)
    own = {"K": lens.K, "model": lens.model, "distortion": lens.distortion}
    return [dataclasses.replace(camera, **own) for camera in cameras]


def _camera(view: View, sizes: dict[tuple[int, int], tuple[int, int]], pixels: int, lenses: bool) -> Camera:
    """A view's camera: of the size that its image probably has, then reduced; a pinhole unless lenses are kept."""
    return at_most(resized_alike(_with_lens(_with_name(view), lenses), sizes), pixels)


def _with_lens(camera: Camera, lenses: bool) -> Camera:
    """The camera itself where lenses are kept, else the pinhole in its place."""
    return camera if lenses else camera.undistorted()


def _with_name(view: View) -> Camera:
    """A view's camera under the view's name."""
    return view.camera if view.camera.name == view.name else dataclasses.replace(view.camera, name=view.name)


# ------------------------------------------------------------------------------------------ both


def evenly(views: list, limit: int) -> list:
    """At most `limit` items, evenly spaced, with the first one."""
    if len(views) <= limit:
        return views
    return [views[i * len(views) // limit] for i in range(limit)]


def one_a_place(cameras: list[Camera]) -> list[Camera]:
    """The first camera of each pose and intrinsics, in their order."""
    first = {(camera.w2c.tobytes(), camera.K.tobytes()): camera for camera in reversed(cameras)}
    return list(reversed(first.values()))


def check_lenses(command: str, settings: RenderSettings, cameras: Iterable[Camera]) -> None:
    """Raise ValueError if a camera has a lens and the settings render pinholes alone."""
    bent = sum(camera.is_distorted for camera in cameras) if settings.planar else 0
    if bent:
        raise ValueError(
            f"{command}: through a lens settings must follow rays, response {settings.response!r} is a model of a "
            f"pinhole's image plane, and {bent} cameras have a lens; use --preset exact, fast or 3dgut, or "
            "--undistort on"
        )
