"""`drgs capture --more -o RUN`: which photographs to take next, where to stand and where to look, in words."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.capturing.places import Place, meters_of, places_around
from drgs.data import View
from drgs.data.camera_layout import upright
from drgs.data.camera_lists import camera_to_json
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians
from drgs.fitting.records import LoadedRun, fitted_views, load_run
from drgs.information.region import Region, RegionText, masked_photographs
from drgs.information.scoring import Scoring
from drgs.information.semantics import SemanticMetric
from drgs.integrator import render
from drgs.io.journal import SCHEMA
from drgs.io.outputs import lock_folder, write_json
from drgs.io.run import Run
from drgs.meshing.depths import seen_distance
from drgs.select import select
from drgs.selection.cache import Cache
from drgs.settings import RenderSettings
from drgs.viewing.placed_views import NEXT

_INFORMATION_PIXELS = 20_000  # pixels of a view whose information is compared: a ranking takes many views
_SOLID_OPACITY = 0.3  # opacity of Gaussians that one does not walk through
_MOST_OBSTACLES = 20_000  # of these, that paths are compared with
_MOST_EMPTY = 0.25  # share of a picture that may show nothing beyond what photographs leave empty: holes are wanted
_EMPTY_PIXELS = 2_500  # pixels of the picture that says so
_COMPARED_PHOTOGRAPHS = 8  # of those there are, whose own gain a place's is divided by
_FARTHEST = 3.0  # times the median distance of Gaussians from the cameras: beyond are floaters


def rank_next(
    run: Path, k: int, length: str | None, show: bool = True, region: str | None = None
) -> list[dict[str, Any]]:
    """Rank places for the next photographs, and write them into the run as `next.json`.

    Args:
        run: A run folder.
        k: How many places.
        length: Two photographs and the distance between them, from which meters follow; None: shares of the way.
        show: Whether to show progress.
        region: Text of the part of the scene that counts; None: all of it.
    Returns:
        The picks of the file, the best first, with `text`: what to do, and `gain`: its information gain over that of
        one of the photographs that are there beside all others, on average.
    Raises:
        FileNotFoundError: If it is no run, or its data set has gone.
        ValueError: If things move, the photographs say nothing of where one can stand, `length` is wrong, or there is
            no such region.
    """
    text = None if region is None else RegionText.of(region, "capture")
    folder = Run(run)
    with lock_folder(run, "capture", [NEXT]), Bar("next photographs", show=show) as bar:
        loaded = load_run(folder)
        record = loaded.record
        if loaded.moving is not None:
            raise ValueError(f"{run}: --more must have a scene that stands still, this one moves; use drgs select")
        record.check_data(run)
        pixels = min(_INFORMATION_PIXELS, record.config.data.max_pixels)
        views = {view.name: view for view in record.dataset().views}
        cameras = {name: pinhole_of(view, pixels) for name, view in views.items()}
        meters = None if length is None else meters_of(length, {name: x.center for name, x in cameras.items()})
        train = [cameras[name] for name in fitted_views(folder, record) if name in cameras]
        settings = RenderSettings.preset("fast")
        places = reachable_places(loaded.gaussians, list(cameras.values()), train, settings)
        if not places:
            raise ValueError(f"{run}: there must be a place to stand at, found none that is free; use drgs select")
        metric = None if loaded.decoder is None else SemanticMetric(loaded.decoder.metric())
        scoring, cache = Scoring(settings=settings, semantics=metric).over(record.estimated), Cache()
        counts = None
        if text is not None:
            seen = [views[camera.name] for camera in train]
            labels = (loaded.classes, loaded.decoder)
            counts = text.region(
                lambda masks: masked_photographs(masks, seen, train, "capture"), lambda: labels, settings, "capture"
            )
        bar.update(0, len(train) + len(places))
        ranked = select(
            loaded.scene,
            [place.camera for place in places],
            train,
            min(k, len(places)),
            scoring=scoring,
            cache=cache,
            progress=bar.update,
            region=counts,
        )
        usual = statistics.mean(_gains_of_photographs(loaded, train, places, scoring, cache, counts))
        rows = [{"index": i, "name": place.camera.name} for i, place in enumerate(places)]
        after = [_place_json(place, meters) for place in places]
        picks = [
            {"rank": rank, **pick, "gain": pick["score"] / usual if usual > 0 else None}
            for rank, pick in enumerate(ranked.picks_json(rows, after), 1)
        ]
        write_json(
            run / NEXT,
            {
                "schema": SCHEMA,
                "command": "capture",
                "policy": "fisher",
                "criterion": scoring.criterion,
                "region": region,
                "known": [camera.name for camera in train],
                "meters": meters,
                "picks": picks,
                "candidates": ranked.candidates_json(rows, after),
                "seconds": ranked.seconds,
            },
        )
    return picks


def _gains_of_photographs(
    loaded: LoadedRun,
    train: list[Camera],
    places: list[Place],
    scoring: Scoring,
    cache: Cache,
    region: Region | None,
) -> Iterator[float]:
    """Information gain of each of a few existing photographs, given all others.

    The places are candidates, too: `v_opt` adds up the variances of all views that it is given, so that gains compare
    only if these are the same.
    """
    cameras = [place.camera for place in places]
    for one in train[:: -(-len(train) // _COMPARED_PHOTOGRAPHS)]:
        others = [camera for camera in train if camera is not one]
        yield select(loaded.scene, [one, *cameras], others, 1, scoring=scoring, cache=cache, region=region).scores[0]


def reachable_places(
    gaussians: Gaussians, cameras: list[Camera], train: list[Camera], settings: RenderSettings, most: int = 48
) -> list[Place]:
    """Places where a person can stand, and whose view is not emptier than the photographs; `most` at most."""
    obstacles = _obstacles(gaussians, train)
    places = places_around(cameras, upright(cameras), seen_distance(gaussians), obstacles, most)
    # What looks past the scene would tell most, of what nobody wants to see.
    emptiest = _MOST_EMPTY + max(_empty_share(gaussians, camera, settings) for camera in train)
    return [place for place in places if _empty_share(gaussians, place.camera, settings) <= emptiest]


def _place_json(place: Place, meters: float | None) -> dict[str, Any]:
    """A place as next.json holds it."""
    return {
        "base": place.base,
        "origin": place.origin.tolist(),
        "text": place.words(meters),
        "camera": camera_to_json(place.camera),
    }


def pinhole_of(view: View, pixels: int) -> Camera:
    """The pinhole camera of a photograph, reduced in size."""
    return at_most(dataclasses.replace(view.camera.undistorted(), name=view.name), pixels)


def _empty_share(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> float:
    """Share of a picture's pixels that no Gaussian covers."""
    with torch.no_grad():  # measured, not optimized
        alpha = render(gaussians, at_most(camera, _EMPTY_PIXELS), settings, outputs=()).alpha
    return float((alpha.cpu() < 0.5).float().mean())


def _obstacles(gaussians: Gaussians, cameras: list[Camera]) -> np.ndarray:
    """(P, 3) centers of the Gaussians that block a path, world."""
    means = gaussians.means.detach().cpu().double().numpy() + gaussians.origin  # measured, not optimized
    solid = means[gaussians.opacities.detach().cpu().numpy() > _SOLID_OPACITY]
    middle = np.median(np.stack([camera.center for camera in cameras]), axis=0)
    far = np.linalg.norm(solid - middle, axis=1)
    solid = solid[far <= _FARTHEST * np.median(far)] if len(solid) else solid
    return solid[:: max(1, -(-len(solid) // _MOST_OBSTACLES))]
