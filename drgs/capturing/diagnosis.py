"""Problems of a shoot that photographs, poses and held-out views show, and advice for the next one.

Every rule compares photographs with those next to them by name, which is the order in which a phone takes them: how
sharp, how far apart, how much turned. Lengths are in units of the median distance of what a photograph shows, since
structure from motion knows no meters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.data.images import read_image
from drgs.display.pictures import shrunk
from drgs.display.progress import Bar
from drgs.fitting.components.exposure import estimate_exposure
from drgs.fitting.frames import load_frames
from drgs.sfm.findings import Finding
from drgs.sfm.mapping import name_ranges
from drgs.sfm.points import shared_points

if TYPE_CHECKING:
    from drgs.data import Dataset, View
    from drgs.sfm.reconstruction import SfmSummary

_SHARPNESS_SIZE = 640  # pixels of the longer side at which sharpness is measured: noise of single pixels is gone
_COMPARED = 3  # photographs on each side that say how sharp one should be: they show much the same
_BLURRED = 0.3  # of the sharpness of its neighbors: below it a photograph is blurred
_DARK, _BRIGHT = 0.06, 0.97  # mean gray, in [0, 1], below and above which a photograph shows next to nothing
_FEW_POSES = 12  # photographs with a pose, below which a scene has holes
_LEAST_TURN = 8.0  # degrees between neighbors that count as a turn
_SPOT_SHARE = 0.2  # of the way that a walk around what is seen would take for the same turn
_FEWEST_TURNS = 2  # turns in a row that are worth a sentence
_WIDEST_STEP = 35.0  # degrees between neighbors, seen from what they show, above which they show little in common
_SHOWN = 3  # names, or gaps, that a finding repeats: it is one line
_EXPOSURE_PIXELS = 20_000  # pixels of a photograph whose colors are compared: points are few, their colors smooth
_BAD_DB = 3.0  # dB below the median of the other held-out views
_FAR_VIEW = 1.5  # times the usual distance (`_distance_to_nearest`) to the nearest training view
_FAR_ALONE = 3.0  # the same, of the only held-out view, whose PSNR nothing is there to compare with
_SPACING_VIEWS = 40  # photographs that say how far apart they usually are; more would take seconds
_LOWERED_DB = 1.0  # dB by which a single view lowers the mean of all, that are worth a sentence


def of_photographs(
    folder: Path, names: Sequence[str], decode: Callable[[Path], np.ndarray] = read_image
) -> list[Finding]:
    """Blurred and dark photographs.

    Args:
        folder, names: The photographs, in the order in which they were taken.
        decode: As `drgs.data.images.read_image`.
    """
    import cv2

    sharp, gray = [], []
    with Bar("sharpness", len(names)) as bar:
        for name in names:
            image = decode(folder / name)
            plain = image if image.ndim == 2 else np.ascontiguousarray(image[..., :3]).mean(axis=2)
            plain = (plain / (255.0 if image.dtype == np.uint8 else 65535.0)).astype(np.float32)
            plain = shrunk(plain, _SHARPNESS_SIZE)
            sharp.append(float(cv2.Laplacian(plain, cv2.CV_32F).var()))
            gray.append(float(plain.mean()))
            bar.advance()
    findings = []
    if blurred := [name for name, share in zip(names, _over_neighbors(sharp), strict=True) if share < _BLURRED]:
        one, them = ("is", "it") if len(blurred) == 1 else ("are", "them")
        findings.append(
            Finding(
                "blur",
                f"{_few_names(blurred)} {one} blurred, compared with the photographs next to {them}",
                "take these again: hold the phone still, with more light or a shorter exposure",
            )
        )
    if dark := [name for name, mean in zip(names, gray, strict=True) if not _DARK < mean < _BRIGHT]:
        findings.append(
            Finding(
                "blank",
                f"{_few_names(dark)} show next to nothing, too dark or too bright",
                "leave these out, or take them again in other light",
            )
        )
    return findings


def _over_neighbors(values: Sequence[float]) -> list[float]:
    """Each value over the median of its neighbors."""
    ratios = []
    for index, value in enumerate(values):
        first = max(0, index - _COMPARED)
        near = [x for other, x in enumerate(values[first : index + _COMPARED + 1], first) if other != index]
        usual = max(float(np.median(near)), 1e-12) if near else value  # a blank neighbor has a sharpness of 0
        ratios.append(value / usual if usual else 1.0)
    return ratios


def of_poses(dataset: Dataset, names: Sequence[str], summary: SfmSummary | None = None) -> list[Finding]:
    """Photographs without a pose, gaps between those that have one, and turns on the spot.

    Args:
        dataset: The data set, with points.
        names: All photographs, in the order in which they were taken.
        summary: Summary of structure from motion; None where it was not run.
    """
    findings = []
    count = len(dataset.views)
    if summary is not None and summary.missing:
        advice = [line.removeprefix("what would help: ") for line in summary.explanation if line.startswith("what")]
        advice = [line for line in advice if not line.startswith("--matcher")]
        findings.append(
            Finding(
                "poses",
                f"{len(summary.missing)} of {summary.total} photographs have no pose: "
                f"{name_ranges(summary.missing, names)}",
                f"take {advice[0]}" if advice and advice[0].startswith("photos") else (advice or ["take more"])[0],
            )
        )
    if count < _FEW_POSES:
        findings.append(
            Finding(
                "poses",
                f"only {count} photographs have a pose",
                "take thirty to eighty, each overlapping the one before by two thirds",
            )
        )
    if dataset.points is None or not len(dataset.points) or count < 3 or dataset.times:
        return findings
    return findings + _of_neighbors(sorted(dataset.views, key=lambda view: view.name), dataset.points)


def _of_neighbors(views: list[View], points: np.ndarray) -> list[Finding]:
    """Turns on the spot, and gaps, from one photograph to the next.

    Args:
        views: In the order in which they were taken.
        points: (P, 3) of the data set.
    """
    depths = [_depth(view, points) for view in views]
    usual = float(np.median([depth for depth in depths if depth is not None] or [1.0]))
    spots, gaps, findings = list[list[str]](), list[tuple[float, str, str]](), []
    for before, view, depth in zip(views[:-1], views[1:], depths[1:], strict=True):
        near = depth or usual
        moved = float(np.linalg.norm(view.camera.center - before.camera.center))
        turned = _angle(view.camera.c2w[:3, 2], before.camera.c2w[:3, 2])
        if turned > _LEAST_TURN and moved < _SPOT_SHARE * near * math.radians(turned):
            if spots and spots[-1][-1] == before.name:
                spots[-1].append(view.name)
            else:
                spots.append([before.name, view.name])
        target = before.camera.center + near * before.camera.c2w[:3, 2]
        parallax = _angle(view.camera.center - target, before.camera.center - target)
        if min(parallax, 180.0) > _WIDEST_STEP and turned > _WIDEST_STEP / 2:
            gaps.append((parallax, before.name, view.name))
    if turns := [spot for spot in spots if len(spot) > _FEWEST_TURNS]:
        shown = ", ".join(f"{spot[0]} to {spot[-1]}" for spot in turns[:_SHOWN])
        findings.append(
            Finding(
                "turn",
                f"from {shown} you turned on the spot",
                "take a step to the side with every photograph: from one place nothing has a depth",
            )
        )
    gaps.sort(reverse=True)
    # The jump from one round to the next is no gap: others stand in between.
    wide = [gap for gap in gaps if not _is_filled(gap, views, usual)][:_SHOWN]
    if wide:
        shown = ", ".join(f"{a} and {b} ({angle:.0f} degrees apart)" for angle, a, b in wide)
        findings.append(
            Finding("overlap", f"too little overlap between {shown}", "take two or three photographs in between")
        )
    return findings


def _is_filled(gap: tuple[float, str, str], views: Sequence[View], usual: float) -> bool:
    """Whether each end of a gap has another photograph near it, besides those next to it by name."""
    angle, *names = gap
    by_name = {view.name: view for view in views}
    ends = [by_name[name] for name in names]
    closest = 2 * math.sin(math.radians(min(angle, 180.0)) / 4) * usual  # as far as half of the gap is wide
    for end, other in zip(ends, ends[::-1], strict=True):
        way = other.camera.center - end.camera.center
        ahead = [
            view
            for view in views
            if view.name not in names
            and np.linalg.norm(view.camera.center - end.camera.center) < closest
            and (view.camera.center - end.camera.center) @ way > 0
        ]
        if not ahead:
            return False
    return True


def of_exposure(dataset: Dataset, seed: int = 0) -> list[Finding]:
    """Photographs whose exposure or white balance differs from that of the others.

    Args:
        dataset: The data set.
        seed: Seed of the choice of points.
    """
    views = sorted(dataset.views, key=lambda view: view.name)
    if dataset.times or (compared := shared_points(dataset, views, seed)) is None:
        return []
    points, seen = compared
    estimate = estimate_exposure(load_frames(views, _EXPOSURE_PIXELS), points, seed, seen)
    if not estimate.is_sound:
        return []
    stops = estimate.log_gains / math.log(2)
    order = np.argsort(-np.abs(stops).max(axis=1), kind="stable")[:_SHOWN]
    shown = ", ".join(f"{views[i].name} ({max(stops[i], key=abs):+.1f} stops)" for i in order)
    return [
        Finding(
            "exposure",
            f"exposure or white balance changes between photographs, most in {shown}",
            "lock both before the first photograph: on most phones, hold a finger on the subject",
        )
    ]


def of_views(dataset: Dataset, train: Sequence[str], psnr: Mapping[str, float]) -> list[Finding]:
    """Held-out views that are much worse than the others, what that does to their mean, and whether photographs near
    them are missing.

    Args:
        dataset: The data set.
        train: Names of the views that were fitted to.
        psnr: Held-out view -> PSNR in dB.
    """
    if not psnr or dataset.times:
        return []
    by_name = {view.name: view for view in dataset.views}
    fitted = [by_name[name] for name in train if name in by_name]
    apart = {name: _distance_to_nearest(by_name[name], fitted) for name in psnr if name in by_name}
    some = fitted[:: -(-len(fitted) // _SPACING_VIEWS)] if fitted else []
    spacing = [_distance_to_nearest(view, [other for other in fitted if other is not view]) for view in some]
    usual = float(np.median([*spacing, *apart.values()])) if fitted else 0.0
    others = {name: [x for other, x in psnr.items() if other != name] for name in psnr}
    if len(psnr) > 1:
        bad = sorted((value, name) for name, value in psnr.items() if value < np.median(others[name]) - _BAD_DB)
    else:
        bad = [(value, name) for name, value in psnr.items() if apart.get(name, 0.0) > _FAR_ALONE * usual]
    findings = []
    for value, name in bad[:_SHOWN]:
        far = apart.get(name, 0.0) > _FAR_VIEW * usual
        text = f"held-out view {name} has {value:.1f} dB"
        if others[name]:
            text += f", the others {np.median(others[name]):.1f}"
            mean, without = np.mean(list(psnr.values())), np.mean(others[name])
            if without - mean >= _LOWERED_DB:
                text += f", and their mean is {mean:.1f} dB, without it {without:.1f}"
        else:
            text += ", and is the only one"
        nearest = (
            min(fitted, key=lambda view: _distance_to_nearest(by_name[name], [view])).name
            if fitted and name in by_name
            else ""
        )
        why = f": the nearest photograph, {nearest}, looks from elsewhere, maybe nothing else shows what it does"
        advice = (
            f"take two or three photographs around where {name} was taken"
            if far
            else f"look at it in the report: is {name} blurred, or is something in it that moved?"
        )
        findings.append(Finding("view", f"{text}{why if far and nearest else ''}", advice))
    return findings


def of_held_out(dataset: Dataset, train: Sequence[str], metrics: Mapping[str, Any]) -> list[Finding]:
    """The findings of `of_views` in the metrics of a fit (metrics.json); none where these are of other views."""
    if metrics["split"] != "test":
        return []
    return of_views(
        dataset, train, {row["name"]: row["psnr"] for row in metrics["views"] if row.get("psnr") is not None}
    )


def _distance_to_nearest(view: View, others: Sequence[View]) -> float:
    """Distance of the nearest other camera: degrees between axes, and distance in units of their spread."""
    if not others:
        return 0.0
    centers = np.stack([other.camera.center for other in others])
    spread = max(float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()), 1e-12)  # all at one place: 0
    axes = np.stack([other.camera.c2w[:3, 2] for other in others])
    turned = np.degrees(np.arccos(np.clip(axes @ view.camera.c2w[:3, 2], -1, 1)))
    return float((turned + 60.0 * np.linalg.norm(centers - view.camera.center, axis=1) / spread).min())


def _depth(view: View, points: np.ndarray) -> float | None:
    """Median distance along the axis of the points in the picture; None without any."""
    camera = view.camera.undistorted()
    pixels, depth = camera.project(points)
    inside = camera.contains(pixels, depth)
    return float(np.median(depth[inside])) if inside.any() else None


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two directions."""
    length = max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)  # a camera at the point itself
    return math.degrees(math.acos(float(np.clip(a @ b / length, -1, 1))))


def _few_names(names: Sequence[str]) -> str:
    """A few names, and how many more there are."""
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
