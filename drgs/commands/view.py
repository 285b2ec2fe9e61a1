"""`drgs view`: a scene in the browser, and a run while it is being fitted."""

from __future__ import annotations

import threading
import warnings
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.commands.orbits import capture_orbit, scene_orbit
from drgs.commands.scene_input import SELECTION, SceneInput, ranking_of
from drgs.commands.semantic_pictures import PICTURE_KINDS, PictureFunction, picture_functions
from drgs.commands.values import UP
from drgs.commands.viewpoints import Known, Source, evenly, known_views
from drgs.data import View as DataView
from drgs.data.camera_layout import Focus, upright
from drgs.display.progress import Bar, quietly
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import DataConfig
from drgs.fitting.errors import error_record_of_views, run_error_record, saved_error_record
from drgs.fitting.records import fitted_views
from drgs.information.blocks import MAP_PRIOR, SceneBlocks
from drgs.information.sums import together
from drgs.io import interrupts
from drgs.io.checkpoint import state_header
from drgs.io.run import Run
from drgs.meshing.depths import seen_distance
from drgs.viewing.client import pose_of
from drgs.viewing.installation import require_viser
from drgs.viewing.layers import SKETCH_VIEWS, ExpectedError, Uncertainty, layers_of
from drgs.viewing.placed_views import NEXT, PlacedView, Ranking, placed_views_of
from drgs.viewing.subject import FirstView, Subject

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.options import View
    from drgs.information.expected_error import ErrorRecord
    from drgs.viewing.server import Viewer

_POLL_SECONDS = 2.0  # seconds between two looks at the files; chosen
_STOP_SECONDS = 0.5  # seconds that a running computation gets to end; chosen


def run(args: View) -> None:
    """`drgs view SCENE`; returns by Ctrl-C alone."""
    if args.scene.exists():  # else `SceneInput` says so: who names a wrong path need not install anything to be told
        require_viser()
    with Bar("the scene", show=not args.quiet):
        stamps = _stamps(watched_files(args))
        given = SceneInput.of(args)
        from drgs.viewing.server import Viewer

        # A browser may be closed while something is on its way to it: that is no news.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        subject = subject_of(args, given)
    viewer = Viewer(subject, args.host, args.port, args.token, args.preset, args.max_pixels)
    try:
        print(f"{viewer.address}  (Ctrl-C ends)", flush=True)
        if args.open:
            webbrowser.open(viewer.address)
        with quietly():
            _watch(args, viewer, stamps)
    finally:
        if not viewer.worker.close(_STOP_SECONDS):
            interrupts.leave()
        viewer.stop()


def _watch(args: View, viewer: Viewer, stamps: dict[Path, tuple[int, int, int]]) -> None:
    """Look at the files now and then, and read them again when one has changed."""
    never = threading.Event()
    while not never.wait(_POLL_SECONDS):
        now = _stamps(watched_files(args))
        if now != stamps and not viewer.worker.has("files"):
            stamps = now
            viewer.worker.put("files", _reload_job(args, viewer))


def _reload_job(args: View, viewer: Viewer) -> Iterator[None]:
    """A job that shows the files' present contents in all browsers."""
    viewer.replace(subject_of(args, SceneInput.of(args), viewer.subject))
    yield


def _stamps(paths: list[Path]) -> dict[Path, tuple[int, int, int]]:
    """Path -> size and time of change, which a replaced file changes; missing files are left out."""
    stamps = {}
    for path in paths:
        try:
            seen = path.stat()
        except OSError:
            continue
        stamps[path] = seen.st_mtime_ns, seen.st_size, seen.st_ino
    return stamps


# ---------------------------------------------------------------------------------------------------- the subject


_FIRST_SIZE = 640, 480  # pixels of the view that a browser begins with: its shape says how much of the scene is in it


def watched_files(args: View) -> list[Path]:
    """The files that are read again when they change."""
    named = [] if args.selection is None else [args.selection]
    if not args.scene.is_dir():
        return [args.scene, *named]
    run = Run(args.scene)
    return [run.state, run.point_cloud, *(named or [run.path / SELECTION, run.path / NEXT])]


def subject_of(args: View, given: SceneInput, before: Subject | None = None) -> Subject:
    """The viewer's subject: the scene, its photographs and its pictures.

    Args:
        args: The options of the command line.
        given: The scene that they name.
        before: The subject before a file changed: browsers keep their places.
    Raises:
        FileNotFoundError, ValueError: If a file that was named is not there or damaged.
    """
    notes: list[str] = []
    known = _known_views(args, given, notes)
    ranking = ranking_of(args.selection, given)
    placed_views = _placed_views(args, given, ranking)
    found = [shown for shown in (_expected_error(args, given, known), _uncertainty(args, given, known)) if shown]
    maps = {shown.name: shown for shown in found}
    origin = np.array(given.gaussians.origin, np.float64)
    if before is not None and np.array_equal(before.origin, origin):  # the client's frame is what it was
        first = before.first
    else:
        first = _first_camera(args, given.gaussians, known.cameras if known else [])
    # What a network leaves uncertain takes tangents of all pixels; the rest of a map costs no more than a picture.
    pixels = known.pixels if known and given.moving is not None else None
    if before is not None and _same_places(before.placed_views, placed_views) and before.ranking == ranking:
        placed_views = before.placed_views
    return Subject(
        name="/".join(args.scene.resolve().parts[-2:]),
        state=_state(given),
        count=len(given.gaussians),
        scene=given.scene,
        origin=origin,
        times=_times(given),
        settings=given.settings,
        layers=layers_of(_picture_functions(args, given), maps.values(), pixels),
        placed_views=placed_views,
        ranking=ranking,
        maps=maps,
        first=first,
        background=given.background,
        notes=tuple(notes),
    )


def _state(given: SceneInput) -> str:
    """The step of the checkpoint, where there is one that can be read."""
    if given.run is None:
        return ""
    try:
        step = state_header(given.run.state).get("step")
    except (OSError, ValueError):
        return ""
    return f"step {step:,} of {given.record.config.max_steps:,}" if isinstance(step, int) else ""


def _times(given: SceneInput) -> tuple[float, ...]:
    """Of what moves: those of the photographs, else the ends of the field's span; none where nothing does."""
    if given.moving is None:
        return ()
    if given.record is not None and given.record.times:
        return given.record.times
    return tuple(dict.fromkeys(float(x) for x in given.moving.field.grid.span))


def _picture_functions(args: View, given: SceneInput) -> dict[str, PictureFunction]:
    """Kind -> function that makes pictures of features and labels, of those that the scene has."""
    functions: dict[str, PictureFunction] = {}
    if given.gaussians.features is None:
        return functions
    for kind in PICTURE_KINDS:
        try:
            functions |= picture_functions([kind], given, args.scene)
        except ValueError:  # no decoder, no classes: not offered
            continue
    return functions


def _known_views(args: View, given: SceneInput, notes: list[str]) -> Known | None:
    """The views that the run was fitted to; None without a run, or where its data set has gone."""
    if args.train is None and given.run is None:
        return None
    try:
        return known_views(args.train, args, given, given.keeps_lenses(), args.info_pixels)
    except (OSError, ValueError) as error:
        if args.train is not None:
            raise
        notes.append(f"no cameras: {error}")
        return None


def _placed_views(args: View, given: SceneInput, ranking: Ranking | None) -> tuple[PlacedView, ...]:
    """Where photographs were taken or could be."""
    if args.train is None and given.run is None:
        return placed_views_of([], (), ranking)
    source = Source.known(args.train, given)
    if source.kind == "list":
        views = [DataView(camera, camera.name) for camera in source.listed()]
        return placed_views_of(views, [view.name for view in views], ranking)
    try:
        views = source.dataset(args, given).views
        fitted = [view.name for view in views]
        if source.kind == "run":
            fitted = fitted_views(Run(Path(source.text)), source.record)
    except (OSError, ValueError):
        if args.train is not None:
            raise
        return placed_views_of([], (), ranking)  # `_known_views` has said why
    return placed_views_of(views, fitted, ranking)


def _expected_error(args: View, given: SceneInput, known: Known | None) -> ExpectedError | None:
    """The expected error by the photographs, with the fast settings; of many, 24 stand for all."""
    settings = given.settings("fast")
    if args.train is None and given.run is not None and given.record is not None:
        run, pixels = given.run, args.info_pixels or given.record.config.data.max_pixels
        count = min(SKETCH_VIEWS, len(fitted_views(run, given.record)))

        def saved() -> ErrorRecord | None:
            return saved_error_record(run, given.scene, settings, pixels, 1)  # of as many as the fit has looked at

        if known is None and saved() is None:  # no photographs, as `_known_views` has said
            return None
        return ExpectedError(
            given.scene, count, saved, lambda most: run_error_record(run, settings, most or pixels, SKETCH_VIEWS)
        )
    if known is None or not known.views:
        return None
    views, pixels = evenly(list(known.views), SKETCH_VIEWS), known.pixels
    data = DataConfig(undistort="off" if known.lenses else "on")

    def made(most: int | None) -> ErrorRecord:
        return error_record_of_views(given.scene, views, settings, data, most or pixels).scaled(
            len(known.views) / len(views)
        )

    return ExpectedError(given.scene, len(views), lambda: None, made)


def _uncertainty(args: View, given: SceneInput, known: Known | None) -> Uncertainty | None:
    """Uncertainty given the photographs, with the fast settings, whose maps are like those of exact ones."""
    if known is None or not known.cameras:
        return None
    cameras = known.cameras
    if given.moving is not None:
        cameras = [camera for camera in cameras if camera.time is not None]
    if not cameras:
        return None
    scoring = given.scoring(args.scoring, given.settings("fast"))
    blocks = SceneBlocks.of(given.scene, scoring, cameras, "fisher")
    prior = (args.scoring.prior or MAP_PRIOR).in_scene(given.scene, cameras)
    return Uncertainty(
        cameras,
        lambda camera: together(blocks.information(camera)),
        lambda camera, weights: blocks.variance_map(camera, weights).numpy(),
        prior,
    )


def _first_camera(args: View, gaussians: Gaussians, captured: list[Camera]) -> FirstView:
    """Where the photographs were taken, towards what they look at; of a bare PLY, so that all of it is seen."""
    if not len(gaussians):
        raise ValueError(f"{args.scene}: there must be at least one Gaussian, got none; fit longer, or name another")
    fixed = args.orbit_shape
    distance_of = seen_distance(gaussians)
    captured = sorted(captured, key=lambda camera: camera.name)  # an active run has them as they were picked
    width, height = _FIRST_SIZE
    orbit, _ = capture_orbit(captured, 1, width=width, height=height, fixed=fixed, distance_of=distance_of)
    camera = (orbit or captured[:1] or scene_orbit(gaussians, 1, width=width, height=height, fixed=fixed))[0]
    up = np.array(fixed.up or (upright(captured) if captured else UP["minus-y"]), np.float64)
    focus = Focus.of(captured, fixed.center, distance_of) if orbit else None
    pose = pose_of(camera, gaussians.origin)
    axis = camera.c2w[:3, 2]
    if focus is not None:
        target = focus.center - gaussians.origin
    else:
        means = gaussians.means.detach().cpu().double().numpy() + gaussians.origin
        ahead = (means - camera.center) @ axis
        ahead = ahead[ahead > 0]
        target = pose.position + axis * (float(np.median(ahead)) if len(ahead) else 1.0)
    return FirstView(pose, target, up / np.linalg.norm(up))


def _same_places(before: tuple[PlacedView, ...], after: tuple[PlacedView, ...]) -> bool:
    """Whether both are the same places with the same names: then a browser need not draw them again."""
    return [_key(placed) for placed in before] == [_key(placed) for placed in after]


def _key(placed: PlacedView) -> tuple:
    camera = placed.camera
    return placed.kind, camera.name, np.asarray(camera.w2c).tobytes(), len(placed.sights)
