"""Places where photographs were taken or proposed, with the scores of a selection."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drgs.cameras import Camera
from drgs.data import View
from drgs.data.camera_lists import camera_from_json
from drgs.io.json_files import check_json, read_json

Kind = Literal["training", "held out", "candidate"]

NEXT = "next.json"
"""File of a run with the places of the next photographs, as `drgs capture --more` writes it."""

_ADVICE = "name what drgs select or an active fit has written"
_SCORED = {"name": str, "score": (None, float), "parts": (None, dict)}
_WAY = {"origin": [float], "text": str}
_TRAINING = (66, 135, 245)  # RGB of photographs that were fitted to
_PLAIN = (150, 150, 150)  # RGB of places without a score


@dataclasses.dataclass(frozen=True)
class Score:
    """Score of a view by a selection.

    Attributes:
        total: The score.
        parts: Group of parameters -> its part of it.
        rank: Rank among the views that were scored with it, from 1.
        of: Number of these views.
    """

    total: float
    parts: dict[str, float]
    rank: int
    of: int


@dataclasses.dataclass(frozen=True)
class Ranking:
    """A selection: views with scores, and which of them were picked.

    Attributes:
        title: Policy and criterion that the views were scored by.
        scores: Name -> score.
        picked: Names of the picks, the first one first.
        cameras: Cameras of candidates, where the file has them: they may be of no data set.
        ways: Name -> how to get there, of places for next photographs.
    """

    title: str
    scores: dict[str, Score]
    picked: tuple[str, ...]
    cameras: tuple[Camera, ...] = ()
    ways: Mapping[str, Way] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Way:
    """How to get to a place for a next photograph.

    Attributes:
        origin: (x, y, z) in the world, where the photograph was taken that the way begins at.
        text: What to do, in words.
    """

    origin: tuple[float, float, float]
    text: str


@dataclasses.dataclass(frozen=True, eq=False)
class Sight:
    """The photograph or candidate at a place and a time.

    Attributes:
        camera: Camera with the view's name and time, undistorted.
        photograph: Function that reads the photograph, at most so many pixels wide: (H, W, 3) float in [0, 1]; or None.
        score: Score of the view; None where it has none.
        pick: Number of the view among the picks, from 1; None: not picked.
        way: How to get there, of a place for a next photograph.
    """

    camera: Camera
    photograph: Callable[[int], np.ndarray] | None = None
    score: Score | None = None
    pick: int | None = None
    way: Way | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class PlacedView:
    """A camera pose with a lens: of synchronous cameras there is one for all times.

    Attributes:
        kind: Use of its views; `training` if one of them was fitted to.
        sights: What was seen from here, in the order of the times; at least one.
    """

    kind: Kind
    sights: tuple[Sight, ...]

    @property
    def camera(self) -> Camera:
        """Camera of its first sight."""
        return self.sights[0].camera

    @property
    def best(self) -> Sight:
        """The sight with the highest score; the first one where none has any."""
        return max(self.sights, key=lambda sight: -np.inf if sight.score is None else sight.score.total)

    def at(self, time: float | None) -> Sight:
        """The sight nearest to a time; the best one where nothing has a time."""
        timed = [sight for sight in self.sights if sight.camera.time is not None]
        if time is None or not timed:
            return self.best
        return min(timed, key=lambda sight: abs((sight.camera.time or 0.0) - time))


def placed_views_of(views: Sequence[View], fitted: Iterable[str], ranking: Ranking | None) -> tuple[PlacedView, ...]:
    """Places of a data set's views, and of the candidates that a ranking states cameras of.

    Args:
        views: Views of the data set, without their images.
        fitted: Names of the views that were fitted to.
        ranking: Scores of some of the views.
    """
    known = set(fitted)
    scores = {} if ranking is None else ranking.scores
    picks = {} if ranking is None else {name: k for k, name in enumerate(ranking.picked, 1)}
    found: dict[tuple, list[tuple[Kind, Sight]]] = {}

    def add(kind: Kind, sight: Sight) -> None:
        camera = sight.camera
        found.setdefault((camera.K.tobytes(), np.asarray(camera.w2c).tobytes()), []).append((kind, sight))

    for view in views:
        score = scores.get(view.name)
        name = view.name
        kind: Kind = "training" if name in known else "candidate" if score else "held out"
        camera = dataclasses.replace(view.camera.undistorted(), name=name)
        add(kind, Sight(camera, _reader(view) if view.has_image else None, score, picks.get(name)))
    there = {view.name for view in views}
    for camera in ranking.cameras if ranking else ():
        if camera.name not in there:
            name = camera.name
            way = ranking.ways.get(name) if ranking else None
            add("candidate", Sight(camera.undistorted(), None, scores.get(name), picks.get(name), way))
    placed_views = []
    for sights in found.values():
        kinds = {kind for kind, _ in sights}
        kind = next(kind for kind in ("training", "candidate", "held out") if kind in kinds)
        ordered = sorted((sight for _, sight in sights), key=lambda sight: sight.camera.time or 0.0)
        placed_views.append(PlacedView(kind, tuple(ordered)))
    return tuple(placed_views)


def read_ranking(path: Path) -> Ranking:
    """What `drgs select` or `drgs capture --more` has written, or an active fit so far: its last pick and those before.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or of something else.
    """
    selection = read_json(path, "a selection", _ADVICE)
    where = str(path)
    check_json(where, selection, {"picks": [{"name": str}]}, _ADVICE)
    if selection.get("command") in ("select", "capture"):
        check_json(where, selection, {"policy": str, "criterion": (None, str), "candidates": [_SCORED]}, _ADVICE)
        rows = selection["candidates"]
        if selection["command"] == "capture":
            check_json(where, rows, [_WAY], _ADVICE)
            if wrong := [len(row["origin"]) for row in rows if len(row["origin"]) != 3]:
                raise ValueError(f"{where}: origin must be 3 numbers, got {wrong[0]}; {_ADVICE}")
        criterion = selection["criterion"]
        policy = selection["policy"]
    else:
        check_json(
            where, selection, {"picks": [{"policy": str, "criterion": (None, str), "candidates": [_SCORED]}]}, _ADVICE
        )
        last = selection["picks"][-1] if selection["picks"] else {"candidates": [], "criterion": None, "policy": ""}
        rows, criterion, policy = last["candidates"], last["criterion"], last["policy"]
    cameras = [
        dataclasses.replace(camera_from_json(f"{where}: {row['name']}", row["camera"]), name=row["name"])
        for row in rows
        if isinstance(row.get("camera"), dict)  # of a fit of what moves it is a name
    ]
    return Ranking(
        f"{policy}, {criterion}" if criterion else policy,
        _scores(where, rows),
        tuple(pick["name"] for pick in selection["picks"]),
        tuple(cameras),
        {row["name"]: Way(tuple(row["origin"]), row["text"]) for row in rows if "origin" in row and "text" in row},
    )


def score_colors(placed_views: Sequence[PlacedView]) -> tuple[list[tuple[int, int, int]], tuple[float, float] | None]:
    """A color for each place, and the scores at the ends of their scale; None where no candidate has one.

    Places of photographs that were fitted to are blue, those without a score gray.
    """
    totals = [placed.best.score.total for placed in placed_views if placed.kind == "candidate" and placed.best.score]
    if not totals:
        return [_TRAINING if placed.kind == "training" else _PLAIN for placed in placed_views], None
    low, high = min(totals), max(totals)
    colors = []
    for placed in placed_views:
        if placed.kind == "candidate" and placed.best.score:
            share = (placed.best.score.total - low) / (high - low) if high > low else 1.0
            colors.append(_on_scale(share))
        else:
            colors.append(_TRAINING if placed.kind == "training" else _PLAIN)
    return colors, (low, high)


def scale_colors(count: int) -> list[tuple[int, int, int]]:
    """Colors of the scale of scores, evenly from the lowest to the highest; at least two."""
    return [_on_scale(k / (count - 1)) for k in range(count)]


def _on_scale(share: float) -> tuple[int, int, int]:
    """The color of a place on the scale, 0 to 1."""
    import cv2

    red, green, blue = cv2.applyColorMap(np.array([[round(255 * share)]], np.uint8), cv2.COLORMAP_PLASMA)[0, 0, ::-1]
    return int(red), int(green), int(blue)


def _scores(where: str, rows: list[dict[str, Any]]) -> dict[str, Score]:
    """Name -> score, with its rank, of the rows that have one."""
    scored = [row for row in rows if row["score"] is not None]
    ordered = sorted(scored, key=lambda row: -row["score"])
    scores: dict[str, Score] = {}
    for rank, row in enumerate(ordered, 1):
        parts = row["parts"] or {}
        check_json(f"{where}: {row['name']}: parts", list(parts.values()), [float], _ADVICE)
        check_json(f"{where}: {row['name']}: parts", list(parts), [str], _ADVICE)
        scores.setdefault(row["name"], Score(float(row["score"]), parts, rank, len(ordered)))
    return scores


def _reader(view: View) -> Callable[[int], np.ndarray]:
    """A function that reads a view's photograph, reduced; the file is opened at its first call."""

    def read(width: int) -> np.ndarray:
        seen = view.checked()
        scale = min(1.0, width / seen.camera.width)
        return seen.image(max(1, round(seen.camera.width * scale)), max(1, round(seen.camera.height * scale)))

    return read
