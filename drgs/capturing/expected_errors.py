"""Findings of the expected error: where a fit is wrong, which part of the expected error says so, and what helps.

Each part has a remedy of its own, so that the worst ninth of a picture is looked for by part:

    misfit       in photographs: they are not matched; all of them alike, or one that disagrees with the others
    information  in photographs: they leave open how this looks
    direction    from places that a person can reach: photographs look at this from elsewhere
    unseen       from there, too: no photograph shows what is there
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.capturing.next_views import pinhole_of, reachable_places
from drgs.capturing.places import Place
from drgs.data import Dataset
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians
from drgs.fitting.errors import run_error_record
from drgs.fitting.records import fitted_views, load_run
from drgs.information.expected_error import ErrorRecord, error_parts
from drgs.information.quantity import opacity_of
from drgs.integrator import render
from drgs.io.run import Run
from drgs.sfm.findings import Finding

_Any = TypeVar("_Any")

_MOST_RESIDUALS = 24  # photographs whose residuals stand for those of all, as in the report; chosen for its seconds
_MOST_PHOTOGRAPHS, _MOST_PLACES = 6, 10  # whose maps are looked at, evenly of all; chosen for their seconds
_PIXELS = 3_000  # pixels of a map: its ninths are compared
_LEAST_WEIGHT = 0.02  # of what all photographs show of something: one that shows less says nothing of it
_LEAST_SHOWN = 0.25  # share of a ninth that Gaussians cover, or that is empty where this is what counts
_WORSE = 2.0  # times the squared error that is usual, 3 dB: below, a place is not worth a sentence
_LEAST_ERROR = 0.04  # units of color: 28 dB; a smaller error is not seen without looking for it
_DISAGREES = 4.0  # times the squared residual that others have where one photograph alone is not matched
_ROWS, _COLUMNS = ("top", "", "bottom"), ("left", "", "right")


@dataclasses.dataclass(frozen=True)
class _Ninth:
    """A ninth of a picture.

    Attributes:
        camera: Of the picture.
        row, column: Which ninth it is, 0 to 2 from the top and the left.
        error: Root of the mean expected squared error of its pixels that count, units of color.
        parts: Part -> its mean, squared units of color.
    """

    camera: Camera
    row: int
    column: int
    error: float
    parts: dict[str, float]

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns of its pixels."""
        return _third(self.camera.height, self.row), _third(self.camera.width, self.column)

    @property
    def words(self) -> str:
        """Which ninth it is."""
        return _words(self.row, self.column)


def of_expected_error(run: Run, dataset: Dataset) -> list[Finding]:
    """Where the fit of a run is expected to be wrong, why, and what to do: at most one finding for each part of the
    expected error, the worst first, and last what is past the photographs. None of a scene that moves.

    Args:
        run: The run folder.
        dataset: Its data set.
    Raises:
        FileNotFoundError, ValueError: If photographs are gone or cannot be read.
    """
    if dataset.times:
        return []
    loaded = load_run(run)
    config = loaded.record.config
    errors = run_error_record(run, config.settings, most=_MOST_RESIDUALS, dataset=dataset)
    cameras = {view.name: pinhole_of(view, _PIXELS) for view in dataset.views}
    photographs = [cameras[name] for name in fitted_views(run, loaded.record)]
    is_full = len(loaded.gaussians) >= config.density.max_gaussians
    return findings_of(loaded.gaussians, errors, photographs, is_full)


def findings_of(
    gaussians: Gaussians, errors: ErrorRecord, photographs: Sequence[Camera], is_full: bool = False
) -> list[Finding]:
    """The same of Gaussians.

    Args:
        gaussians: The Gaussians, which stand still.
        errors: What photographs say about their errors.
        photographs: The cameras of all photographs that were fitted to, by name, a few thousand pixels each.
        is_full: Whether there are as many Gaussians as there may be.
    """
    some = _evenly(photographs, _MOST_PLACES)
    places = reachable_places(gaussians, some, some, errors.settings, _MOST_PLACES)
    place_of = {place.camera.name: place for place in places}
    shown = _evenly(photographs, _MOST_PHOTOGRAPHS)
    with Bar("expected error", len(shown) + len(places)) as bar:
        covered, empty = _ninths(gaussians, shown, errors, bar)
        covered_there, empty_there = _ninths(gaussians, [place.camera for place in places], errors, bar)
    found = list[tuple[float, Finding]]()
    if ninth := _worst("misfit", covered, _mean("misfit", covered)):
        seen = _photographs_of(gaussians, ninth, errors, photographs)
        found.append((ninth.error, _misfit(ninth, seen, len(gaussians) if is_full else 0)))
    if ninth := _worst("information", covered, _mean("information", covered)):
        found.append((ninth.error, _information(ninth)))
    if ninth := _worst("direction", covered_there, _mean("direction", covered)):
        seen = _photographs_of(gaussians, ninth, errors, photographs)
        where = _where(gaussians, ninth, seen, errors)
        found.append((ninth.error, _direction(ninth, where, place_of[ninth.camera.name])))
    findings = [finding for _, finding in sorted(found, key=lambda pair: -pair[0])]
    # What masks leave out of the photographs is unseen in these, too, and not wanted anywhere.
    if ninth := _worst("unseen", empty_there, max((x.parts["unseen"] for x in empty), default=0.0)):
        findings.append(_unseen(ninth, place_of[ninth.camera.name]))
    return findings


def _words(row: int, column: int) -> str:
    """A ninth of a picture."""
    words = f"{_ROWS[row]} {_COLUMNS[column]}".strip()
    return f"the {words}" if words else "the middle"


def _evenly(items: Sequence[_Any], most: int) -> list[_Any]:
    """So many of these at most, evenly."""
    return list(items[:: max(1, -(-len(items) // most))])


def _ninths(
    gaussians: Gaussians, cameras: Sequence[Camera], errors: ErrorRecord, bar: Bar
) -> tuple[list[_Ninth], list[_Ninth]]:
    """Ninths of pictures, of the pixels that Gaussians cover, and of those that they do not; none of too few pixels."""
    covered, empty = list[_Ninth](), list[_Ninth]()
    for camera in cameras:
        parts = {name: x.numpy() for name, x in error_parts(gaussians, camera, errors).items()}
        alpha = opacity_of(gaussians, camera, errors.settings).numpy()
        for row, column in np.ndindex(3, 3):
            ninth = _third(camera.height, row), _third(camera.width, column)
            for some, counts in ((covered, alpha[ninth] > 0.5), (empty, alpha[ninth] <= 0.5)):
                if counts.mean() >= _LEAST_SHOWN:
                    means = {name: float(x[ninth][counts].mean()) for name, x in parts.items()}
                    some.append(_Ninth(camera, row, column, sum(means.values()) ** 0.5, means))
        bar.advance()
    return covered, empty


def _third(size: int, index: int) -> slice:
    """A third of so many pixels."""
    return slice(size * index // 3, size * (index + 1) // 3)


def _mean(part: str, ninths: Sequence[_Ninth]) -> float:
    """A part's mean over ninths of pictures."""
    return float(np.mean([ninth.parts[part] for ninth in ninths])) if ninths else 0.0


def _worst(part: str, ninths: Sequence[_Ninth], usual: float) -> _Ninth | None:
    """The ninth of a picture in which a part is largest, of those where it is the largest part of an error that is
    worth a sentence; None where there is none.
    """
    bad = [
        ninth
        for ninth in ninths
        if ninth.error >= _LEAST_ERROR
        and ninth.parts[part] == max(ninth.parts.values())
        and ninth.parts[part] > _WORSE * usual
    ]
    return max(bad, key=lambda ninth: ninth.parts[part], default=None)


@dataclasses.dataclass(frozen=True)
class _Seen:
    """A photograph of what a ninth of another picture shows.

    Attributes:
        camera: Of the photograph.
        weight: How much of it that is, over that of all photographs.
        residual: Root of the mean squared residual there, units of color.
        others: The same in the other photographs of these Gaussians.
        is_single: Whether these are numbers of this photograph, and not of several that were taken near it.
    """

    camera: Camera
    weight: float
    residual: float
    others: float
    is_single: bool

    @property
    def name(self) -> str:
        """Name of the photograph."""
        return self.camera.name


def _photographs_of(
    gaussians: Gaussians, ninth: _Ninth, errors: ErrorRecord, photographs: Sequence[Camera]
) -> list[_Seen]:
    """The photographs that show what a ninth of a picture shows, the one that shows most of it first."""
    # What the others say of the Gaussians that a photograph shows; it itself, of those that it shows most of.
    weights, residuals = errors.weights.double(), errors.residuals.double()
    rest = weights.sum(1, keepdim=True) - weights
    of_others = (residuals.sum(1, keepdim=True) - residuals) * weights / rest
    of_others = torch.where(rest > weights, of_others, residuals)
    sums = torch.cat([weights, residuals, of_others], 1).to(gaussians.means.device, torch.float32)
    with torch.no_grad():  # measured, not optimized
        out = render(
            gaussians.detach().replace(sh=gaussians.sh[:, :1], features=sums),
            ninth.camera,
            errors.settings,
            outputs=(),
        )
    assert out.features is not None  # they were given
    by_place = out.features[ninth.pixels].double().sum((0, 1)).cpu().reshape(3, -1).T.numpy()
    total = by_place[:, 0].sum()
    centers = np.stack([camera.center for camera in photographs])
    seen = list[_Seen]()
    for place, (weight, residual, expected) in zip(errors.places.numpy(), by_place, strict=True):
        if weight > _LEAST_WEIGHT * total:
            apart = np.linalg.norm(centers - place, axis=1)
            is_single = bool(np.isclose(apart.min(), 0, atol=1e-6 * apart.max()))
            nearest = photographs[int(apart.argmin())]
            own, others = (math.sqrt(max(x, 0.0) / weight) for x in (residual, expected))
            seen.append(_Seen(nearest, weight / total, own, others, is_single))
    return sorted(seen, key=lambda one: -one.weight)


def _misfit(ninth: _Ninth, seen: Sequence[_Seen], full: int) -> Finding:
    """Photographs are not matched: one of them, or all; `full` is how many Gaussians there are, if all that may be."""
    where = f"{ninth.words} of {ninth.camera.name}: expected error {ninth.error:.2f} of color"
    odd = max(seen, key=lambda one: one.residual / max(one.others, 1e-12), default=None)
    if odd is not None and odd.is_single and odd.residual**2 > _DISAGREES * odd.others**2:
        return Finding(
            "misfit",
            f"{where}, as {odd.name} shows it unlike the other photographs (off by {odd.residual:.2f}, these by "
            f"{odd.others:.2f})",
            f"look at {odd.name}: mask what moved or shines in it; if it is blurred or lit otherwise, leave it out",
        )
    usual = float(np.median([one.residual for one in seen])) if seen else ninth.parts["misfit"] ** 0.5
    count = "the only photograph" if len(seen) == 1 else f"the {len(seen)} photographs"
    full_text = f", with all {full:,} Gaussians that it may have" if full else ""
    return Finding(
        "misfit",
        f"{where}, as the fit does not match {count} of it (off by {usual:.2f}{full_text})",
        f"fit with more {'Gaussians and ' if full else ''}steps: give a larger --budget, in another folder (-o); if "
        "something moves or shines there, mask it",
    )


def _information(ninth: _Ninth) -> Finding:
    """Photographs leave open how something looks."""
    return Finding(
        "information",
        f"{ninth.words} of {ninth.camera.name}: expected error {ninth.error:.2f} of color, as too few photographs show "
        "it, or from too far away",
        f"take two or three more of it: go closer than where {ninth.camera.name} was taken, and a step to each side",
    )


def _direction(ninth: _Ninth, where: str, place: Place) -> Finding:
    """Photographs show something from elsewhere only."""
    return Finding(
        "direction",
        f"{where}, seen from elsewhere: expected error {ninth.error:.2f} of color, as photographs from there are "
        "missing",
        f"take one: {place.words()}",
    )


def _unseen(ninth: _Ninth, place: Place) -> Finding:
    """No photograph shows what is somewhere."""
    turn = "" if (ninth.row, ninth.column) == (1, 1) else f", then turn to {ninth.words}"
    return Finding(
        "unseen",
        f"beside what {place.base} shows: expected error {ninth.error:.2f} of color, as no photograph shows what is "
        "there",
        f"if it should be seen, photograph it: {place.words()}{turn}",
    )


def _where(gaussians: Gaussians, ninth: _Ninth, seen: Sequence[_Seen], errors: ErrorRecord) -> str:
    """Where the photograph that shows most of it shows what a ninth of another picture shows."""
    camera = ninth.camera
    if not seen:
        return f"what is at {ninth.words} of a picture of what {camera.name} looks at"
    with torch.no_grad():  # measured, not optimized
        out = render(gaussians.detach().replace(features=None), camera, errors.settings, outputs=("depth",))
    assert out.depth is not None  # it was asked for
    rows, columns = ninth.pixels
    depth = out.depth[ninth.pixels][out.alpha[ninth.pixels] > 0.5].median().item()
    middle = np.array([(columns.start + columns.stop) / 2, (rows.start + rows.stop) / 2, 1.0])
    ray = camera.c2w[:3, :3] @ np.linalg.solve(camera.K, middle)
    point = camera.center + depth * ray / np.linalg.norm(ray)
    shown = seen[0].camera
    pixel, ahead = shown.project(point[None])
    if not shown.contains(pixel, ahead)[0]:
        return f"what {shown.name} shows"
    x, y = pixel[0]
    return f"{_words(int(3 * y / shown.height), int(3 * x / shown.width))} of {shown.name}"
