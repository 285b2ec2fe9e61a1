"""Contents of the page of a scene: Gaussians, cameras of photographs, expected errors and classes."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.origins import origin_text
from drgs.cameras.sizes import at_most
from drgs.data import Dataset, View
from drgs.data.camera_layout import Focus, upright
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import DataConfig
from drgs.fitting.errors import error_record_of_views, run_error_record
from drgs.fitting.records import LoadedRun, fitted_views, load_run
from drgs.fitting.renderers import VIEWERS, planar_of
from drgs.information.nuisances import Nuisances
from drgs.io.run import Run
from drgs.meshing.depths import seen_distance
from drgs.pages.report.pictures import spread
from drgs.pages.sharing.layers import GaussianScale, classes_layer, error_of, uncertainty_of
from drgs.pages.sharing.placing import PhotoKind
from drgs.pages.sharing.write import Shared
from drgs.settings import RenderSettings
from drgs.viewing.placed_views import NEXT, Ranking, placed_views_of, read_ranking

FILE = "scene.html"
"""The page in a run folder."""

STORED_TIMES = 12
"""Times at which a moving scene is stored, by default; the size of the page grows with it. Chosen, not tuned."""

_UP = np.array((0.0, -1.0, 0.0))  # as COLMAP's worlds stand, where no photographs say
# Photographs whose information is summed, spread evenly over more; chosen for its seconds, as in the report.
_MOST_PHOTOGRAPHS = 24
_INFORMATION_PIXELS = 30_000  # pixels of each of these photographs, at most; chosen for its seconds

_log = logging.getLogger(__name__)


def scene_of_file(
    gaussians: Gaussians,
    title: str,
    around: Callable[[Gaussians], Camera],
    ranking: Ranking | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    photographs: Sequence[Camera] = (),
    views: Sequence[View] = (),
    uncertainty: bool = True,
) -> Shared:
    """Contents of the page of Gaussians of a file.

    Args:
        gaussians: At least one.
        title: Name of the scene.
        around: A camera that sees all of it, where a ranking has no cameras.
        ranking: Photographs to take next.
        background: RGB in [0, 1].
        photographs: Cameras of the photographs that they were fitted to, if they are known.
        views: These photographs; none where only their cameras are there.
        uncertainty: Whether to add the errors that are expected, or, without photographs, what cameras leave uncertain.
    """
    shown = gaussians.replace(features=None).detach()
    lines = [f"{len(gaussians):,} Gaussians{f', with {len(photographs):,} photographs' if photographs else ''}."]
    fitted: list[tuple[PhotoKind, Camera]] = [("fitted", camera) for camera in photographs]
    cameras = [*fitted, *_cameras([], (), ranking)]
    page = _with_photographs(shown, title, lines, cameras, around, background)
    if not (photographs and uncertainty):
        return page
    settings = RenderSettings.preset("fast", background=background)
    if views:
        some = spread(views, _MOST_PHOTOGRAPHS)
        record = error_record_of_views(shown, some, settings, DataConfig(), _INFORMATION_PIXELS)
        return dataclasses.replace(page, scale=error_of(record.scaled(len(views) / len(some))))
    small = spread([at_most(camera, _INFORMATION_PIXELS) for camera in photographs], _MOST_PHOTOGRAPHS)
    return dataclasses.replace(page, scale=uncertainty_of(shown, small, settings, Nuisances()))


def scene_of_run(
    run: Run,
    dataset: Dataset | None,
    *,
    loaded: LoadedRun | None = None,
    ranking: Ranking | None = None,
    around: Callable[[Gaussians], Camera] | None = None,
    moments: int = STORED_TIMES,
    uncertainty: bool = True,
) -> Shared:
    """Contents of the page of a run.

    Args:
        run: The run folder.
        dataset: The data set that was fitted, with the poses that the fit has found; None where it has gone.
        loaded: What the run holds, where it has been read already.
        ranking: Photographs to take next; default those of the run.
        around: A camera that sees all of it, where there are no others.
        moments: Number of times at which what moves is stored, at most.
        uncertainty: Whether to add the errors that are expected, or, where photographs are gone but their cameras are
            not, what these leave uncertain.
    Raises:
        FileNotFoundError, ValueError: If the run is none, damaged, or has no Gaussians.
    """
    loaded = loaded or load_run(run)
    if not len(loaded.gaussians):
        raise ValueError(f"{run.path}: there must be at least one Gaussian, got none; fit longer, or name another")
    record, moving = loaded.record, loaded.moving
    times = _times(loaded, moments)
    # The page itself says when what is there for a time is there.
    gaussians = loaded.gaussians if moving is None else moving.without_lifespans().at(times[0])
    names = fitted_views(run, record)
    views, fitted_names = ([], []) if dataset is None else (dataset.views, names)
    cameras = _cameras(views, fitted_names, ranking or _ranking_of(run, loaded))
    fitted = [camera for kind, camera in cameras if kind == "fitted"]
    return dataclasses.replace(
        _with_photographs(
            gaussians.replace(features=None).detach(),
            run.path.resolve().name,
            _lines(run, loaded, len(names)),
            cameras,
            around,
            record.config.settings.background,
        ),
        scale=_scale(run, loaded, dataset, fitted) if uncertainty else None,
        classes=_classes(loaded),
        moving=moving,
        times=times,
    )


def _with_photographs(
    gaussians: Gaussians,
    title: str,
    lines: Sequence[str],
    cameras: list[tuple[PhotoKind, Camera]],
    around: Callable[[Gaussians], Camera] | None,
    background: tuple[float, float, float],
) -> Shared:
    """Contents of a page that begins at the photographs' cameras."""
    fitted = [camera for kind, camera in cameras if kind == "fitted"]
    target, up = None, _UP
    if fitted:
        up = upright(fitted)
        focus = Focus.of(fitted, None, seen_distance(gaussians))
        target = None if focus is None else focus.center
    if not cameras:
        if around is None:
            raise ValueError(f"{title}: there must be a camera that sees the scene, got none; restore its data set")
        cameras = [("other", dataclasses.replace(around(gaussians), name="all of it"))]
    if np.any(gaussians.origin):
        lines = [*lines, f"Positions are relative to the offset {origin_text(gaussians.origin)}."]
    return Shared(
        title=title,
        lines=lines,
        gaussians=gaussians,
        cameras=cameras,
        target=_subject_point(gaussians, cameras[0][1]) if target is None else target,
        up=up,
        background=background,
    )


def _ranking_of(run: Run, loaded: LoadedRun) -> Ranking | None:
    """Views that an active fit chose, or places of next photographs; None where the run has neither."""
    path = run.path / ("selection.json" if loaded.record.is_active else NEXT)
    return read_ranking(path) if path.is_file() else None


def _lines(run: Run, loaded: LoadedRun, photographs: int) -> list[str]:
    """Lines of text about the scene; what the page cannot show is logged, too."""
    config = loaded.record.config
    lines = [f"{len(loaded.gaussians):,} Gaussians, fitted to {photographs:,} photographs."]
    if not planar_of(config.renderers, config.settings):
        text = f"fitted for {', '.join(config.renderers)} alone; pages draw as {VIEWERS} does, where it may look worse"
        _log.warning("%s: %s: fit with --for any or --for viewers (docs/one-model.md)", run.path, text)
        lines.append(text[0].upper() + text[1:] + ".")
    return lines


def _classes(loaded: LoadedRun) -> tuple[dict[str, Any], np.ndarray] | None:
    """Names, colors and each Gaussian's class; None where they have none."""
    features, classes, decoder = loaded.gaussians.features, loaded.classes, loaded.decoder
    if features is None or decoder is None or classes is None or classes.embeddings is None:
        return None
    return classes_layer(features, classes, decoder)


def _cameras(views: Sequence, names: Sequence[str], ranking: Ranking | None) -> list[tuple[PhotoKind, Camera]]:
    """Cameras of a run's photographs and of the photographs to take next; none where they are not known."""
    placed = placed_views_of(views, names, ranking)
    fitted = [place.camera for place in placed if place.kind == "training"]
    # Not of places: at the place of a pick, others may have been scored higher or fitted to, at other times.
    sights = [sight for place in placed for sight in place.sights if sight.camera.name not in names]
    picks = {sight.pick: sight.camera for sight in sights if sight.pick}
    following = [dataclasses.replace(picks[k], name=f"{k}. {picks[k].name}") for k in sorted(picks)]
    ordered: list[tuple[PhotoKind, Camera]] = [("fitted", camera) for camera in sorted(fitted, key=lambda x: x.name)]
    return ordered + [("next", camera) for camera in following]


def _times(loaded: LoadedRun, count: int) -> tuple[float, ...]:
    """At most `count` times from the first to the last; none of a static scene."""
    if loaded.moving is None:
        return ()
    low, high = (float(x) for x in loaded.moving.field.grid.span)
    known = loaded.record.times
    if known:
        if len(known) <= count:
            return known
        low, high = known[0], known[-1]
    return tuple(float(x) for x in np.linspace(low, high, count))


def _scale(run: Run, loaded: LoadedRun, dataset: Dataset | None, fitted: list[Camera]) -> GaussianScale | None:
    """The errors that are expected; where the photographs cannot be read, what their cameras leave uncertain."""
    config = loaded.record.config
    try:
        return error_of(run_error_record(run, config.settings, most=_MOST_PHOTOGRAPHS, dataset=dataset))
    except (OSError, ValueError) as error:
        _log.warning("%s; the page goes without the expected error", str(error).partition(";")[0])
    if loaded.moving is not None:
        fitted = [camera for camera in fitted if camera.time is not None]
    if not fitted:
        return None
    cameras = [at_most(camera, min(_INFORMATION_PIXELS, config.data.max_pixels)) for camera in fitted]
    scene = loaded.gaussians.replace(features=None) if loaded.moving is None else loaded.moving
    nuisances = Nuisances(eliminate=loaded.record.estimated)
    return uncertainty_of(scene, spread(cameras, _MOST_PHOTOGRAPHS), config.settings, nuisances)


def _subject_point(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """(3,) the point of a camera's axis that is as far away as what is before it."""
    axis = camera.c2w[:3, 2]
    means = gaussians.means.double().numpy() + np.array(gaussians.origin, np.float64)
    ahead = (means - camera.center) @ axis
    ahead = ahead[ahead > 0]
    return camera.center + axis * (float(np.median(ahead)) if len(ahead) else 1.0)
