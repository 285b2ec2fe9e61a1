"""`drgs share`: a scene as one HTML file that opens from disk."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.commands.orbit_keys import UP
from drgs.commands.orbits import scene_orbit, seen_distance
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewed import ranking_of
from drgs.data.capture import Focus, upright
from drgs.files import Run
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fitted_views, is_run
from drgs.fitting.renderers import VIEWERS, planar_of
from drgs.fitting.resume import claim_run
from drgs.guards.outputs import check_file
from drgs.information.nuisances import Nuisances
from drgs.report.pictures import spread
from drgs.sharing.layers import classes_layer, uncertainty_of
from drgs.sharing.page import SHARED_BY
from drgs.sharing.write import Shared, write_page
from drgs.sizes import at_most
from drgs.viewing.placed_views import placed_views_of

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.options import Share
    from drgs.ellipsoids import Gaussians
    from drgs.sharing.placing import PhotoKind

__all__ = ["SHARED_FILE", "is_page", "run", "shared_of"]

SHARED_FILE = "scene.html"
_COUNTED = 24  # photographs whose information is added up; of more, these stand for all, as in the report
_INFO_PIXELS = 30_000  # of each of them
_VIEW = 960, 640  # pixels of a view of what has no photographs
_MOST_MOMENTS = 200

_log = logging.getLogger(__name__)


def run(args: Share) -> None:
    """`drgs share SCENE`."""
    if not 2 <= args.moments <= _MOST_MOMENTS:
        raise ValueError(f"share: --moments must be in [2, {_MOST_MOMENTS}], got {args.moments}; correct it")
    path = _output(args)
    is_inside = args.output is None and is_run(args.scene)
    with claim_run(Run(args.scene), "share") if is_inside else contextlib.nullcontext() as held:
        if held is not None:
            held.check([SHARED_FILE])
        shared = shared_of(args)
        sizes = write_page(shared, path)
    if not args.quiet:
        told = ", ".join(f"{name} {size / 1e6:.2f} MB" for name, size in sizes.items())
        print(f"{len(shared.gaussians)} Gaussians: {path} ({path.stat().st_size / 1e6:.2f} MB: {told})")


def _output(args: Share) -> Path:
    """The file to write, which outside of a run is free or a page that this command wrote."""
    path = args.output
    if path is None and is_run(args.scene):
        return args.scene / SHARED_FILE
    path = path or args.scene.with_suffix(".html")
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: must be named *.html, which is what is written; choose another (-o)")
    inputs = [args.scene / "config.json" if args.scene.is_dir() else args.scene, args.selection or ""]
    check_file(path, "share", inputs, is_page)
    return path


def is_page(path: Path) -> bool:
    """Whether a file says that `drgs share` wrote it."""
    with path.open("rb") as file:
        return f'<meta name="generator" content="{SHARED_BY}">'.encode() in file.read(1000)


def shared_of(args: Share) -> Shared:
    """What the page of a command line shows.

    Raises:
        FileNotFoundError, ValueError: If a file that was named is not there or damaged.
    """
    given = SceneInput.at(args.scene)
    if not len(given.gaussians):
        raise ValueError(f"{args.scene}: there must be at least one Gaussian, got none; fit longer, or name another")
    times = _times(given, args.moments)
    # The page itself says when what is there for a time is there.
    gaussians = given.gaussians if given.moving is None else given.moving.without_lives().at(times[0])
    gaussians = gaussians.replace(features=None).detach()
    cameras = _cameras(args, given)
    fitted = [camera for kind, camera in cameras if kind == "fitted"]
    target = None
    up = np.array(UP["minus-y"], np.float64)
    if fitted:
        up = upright(fitted)
        focus = Focus.of(fitted, None, seen_distance(gaussians))
        target = None if focus is None else focus.center
    if not cameras:
        (around,) = scene_orbit(gaussians, 1, width=_VIEW[0], height=_VIEW[1])
        cameras = [("other", dataclasses.replace(around, name="all of it"))]
    return Shared(
        title=args.scene.stem if given.run is None else args.scene.resolve().name,
        lines=_lines(args, given),
        gaussians=gaussians,
        cameras=cameras,
        target=_middle(gaussians, cameras[0][1]) if target is None else target,
        up=up,
        background=given.background if given.record is None else given.record.config.settings.background,
        uncertainty=_uncertainty(given, fitted) if args.uncertainty else None,
        classes=_classes(given),
        moving=given.moving,
        times=times,
    )


def _lines(args: Share, given: SceneInput) -> list[str]:
    """What a page says of its scene; what does not carry over is said in the log, too."""
    count = f"{len(given.gaussians):,} Gaussians"
    if given.record is None or given.run is None:
        return [f"{count}."]
    lines = [f"{count}, fitted to {len(fitted_views(given.run, given.record)):,} photographs."]
    config = given.record.config
    if not planar_of(config.renderers, config.settings):
        found = f"fitted for {', '.join(config.renderers)} alone; pages draw as {VIEWERS} does, where it may look worse"
        _log.warning("%s: %s: fit with --for any or --for viewers (docs/one-model.md)", args.scene, found)
        lines.append(found[0].upper() + found[1:] + ".")
    return lines


def _classes(given: SceneInput) -> tuple[dict[str, Any], np.ndarray] | None:
    """Names, colors and each Gaussian's class; None where they have none."""
    features, classes, decoder = given.gaussians.features, given.classes, given.decoder
    if features is None or decoder is None or classes is None or classes.embeddings is None:
        return None
    return classes_layer(features, classes, decoder)


def _cameras(args: Share, given: SceneInput) -> list[tuple[PhotoKind, Camera]]:
    """Cameras of the photographs that a run was fitted to, and of those to take next; none where nobody knows."""
    ranking = ranking_of(args.selection, given)
    views, names = [], []
    if given.run is not None and given.record is not None:
        record = given.record
        try:
            dataset = load_dataset(record.data, record.config, lazy=True, points=False, semantics=False)
            views = record.with_refined_poses(dataset).views
            names = fitted_views(given.run, record)
        except (OSError, ValueError) as error:
            _log.warning("%s; the page goes without the photographs' cameras", str(error).partition(";")[0])
    placed = placed_views_of(views, names, ranking)
    fitted = [place.camera for place in placed if place.kind == "training"]
    picks = {place.best.pick: place.best.camera for place in placed if place.kind != "training" and place.best.pick}
    following = [dataclasses.replace(picks[k], name=f"{k}. {picks[k].name}") for k in sorted(picks)]
    ordered: list[tuple[PhotoKind, Camera]] = [("fitted", camera) for camera in sorted(fitted, key=lambda x: x.name)]
    return ordered + [("next", camera) for camera in following]


def _times(given: SceneInput, count: int) -> tuple[float, ...]:
    """At most so many times, from the first to the last; none where nothing moves."""
    if given.moving is None:
        return ()
    low, high = (float(x) for x in given.moving.field.grid.span)
    if given.record is not None and given.record.times:
        known = given.record.times
        if len(known) <= count:
            return known
        low, high = known[0], known[-1]
    return tuple(float(x) for x in np.linspace(low, high, count))


def _uncertainty(given: SceneInput, fitted: list[Camera]) -> np.ndarray | None:
    """(N,) what the photographs leave uncertain of where each Gaussian is."""
    if given.record is None:
        return None
    if given.moving is not None:
        fitted = [camera for camera in fitted if camera.time is not None]
    if not fitted:
        return None
    cameras = [at_most(camera, min(_INFO_PIXELS, given.record.config.data.max_pixels)) for camera in fitted]
    settings = given.record.config.settings
    scene = given.colors if given.moving is None else given.moving
    return uncertainty_of(scene, spread(cameras, _COUNTED), settings, Nuisances(eliminate=given.record.estimated))


def _middle(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """(3,) the point of a camera's axis that is as far away as what is before it."""
    axis = camera.c2w[:3, 2]
    means = gaussians.means.double().numpy() + np.array(gaussians.origin, np.float64)
    ahead = (means - camera.center) @ axis
    ahead = ahead[ahead > 0]
    return camera.center + axis * (float(np.median(ahead)) if len(ahead) else 1.0)
