"""Incremental mapping by COLMAP: its progress while it runs, and which photographs were registered.

pycolmap calls back once a photograph has a pose, and between two of these calls minutes of bundle adjustment may pass.
What goes on then is in COLMAP's log, which is followed here in a file.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drgs.io.atomic import check_room
from drgs.runtime import thread_count
from drgs.sfm.matching import Progress

_EVERY = 0.25  # seconds between two looks at the log
_FEW_FEATURES = 200  # with fewer of its own a photograph is blurred, dark or blank, or its mask is small
_ADVISED = 3  # gaps that are named
_STRETCHES = 12  # of names that follow each other
# Bytes in the files of a model: of a feature its place and point (24), of that its share in a track (8) and in a point
# of 51 bytes that two features show at least.
_FEATURE_BYTES = 60

# What COLMAP's log says -> what that is. Lines that are not known, of another version, change nothing.
_DOING = {
    "Loading database": "reading the matches",
    "Finding good initial image pair": "looking for two photos to begin with",
    "Registering initial image pair": "triangulating from two photos",
    "Registering image": "finding the pose of a photo",
    "Global bundle adjustment": "bundle adjustment",
    "Retriangulation and Global bundle adjustment": "retriangulation and bundle adjustment",
    "Discarding reconstruction": "dropping a model that is too small",
}
_LINE = re.compile(rb"^[IWEF]\d{8} \S+ +\d+ [^\]]+\] (.*)$")


class MappingProgress:
    """Reports how many photographs have a pose in the model that COLMAP is making, and what it is doing.

    Args:
        total: Number of all photographs.
        progress: Called with ("mapping", poses in the current model, total), also from another thread.
        status: Called with what is being done, in words, also from another thread.
        registered: Number of photographs in the model that mapping begins with.
    """

    def __init__(self, total: int, progress: Progress, status: Callable[[str], None], registered: int = 0) -> None:
        self.total = total
        self._progress = progress
        self._status = status
        self.registered = registered
        self._model = 0
        self._what = "reading the matches"
        self._since = time.monotonic()
        self._lock = threading.Lock()  # COLMAP's thread calls back, another one follows the log

    def model_begun(self) -> None:
        """A model has its first two photographs, all adjusted."""
        with self._lock:
            self.registered = 2
            self._model = self._model + 1
            self._report()

    def image_registered(self) -> None:
        """One photograph more has a pose, all adjusted."""
        with self._lock:
            self.registered += 1
            self._report()

    def log_line(self, text: str) -> None:
        """A line of COLMAP's log."""
        what = next((what for begins, what in _DOING.items() if text.startswith(begins)), None)
        if what is not None:
            with self._lock:
                self._what = what
                self._since = time.monotonic()
                self._report()

    def refresh(self) -> None:
        """Report once more, with the time that the current step has taken."""
        with self._lock:
            self._report()

    def _report(self) -> None:
        parts = [f"attempt {self._model}"] if self._model > 1 else []  # that was kept, or was too small
        is_last = "bundle adjustment" in self._what and self.registered >= self.total
        what = f"final {self._what}" if is_last else self._what
        seconds = time.monotonic() - self._since
        parts.append(f"{what} for {seconds:.0f} s" if seconds >= 2 else what)
        self._progress("mapping", min(self.registered, self.total), self.total)
        self._status(", ".join(parts))


def map_photos(
    database: Path,
    image_dir: Path,
    folder: Path,
    options: Any,
    progress: MappingProgress,
    base: Path | None = None,
) -> dict[int, Any]:
    """COLMAP's incremental mapping.

    Args:
        database: COLMAP's database, with verified matches.
        image_dir: Folder that the names in the database are relative to.
        folder: Folder that COLMAP writes models into; it must exist. Its log lies there meanwhile.
        options: pycolmap.IncrementalPipelineOptions.
        progress: Hears of every photograph that gets a pose, and of COLMAP's log.
        base: Folder of a model to go on with; default none.
    Returns:
        pycolmap's models by number; empty if no two photographs could be connected.
    """
    from drgs.data.colmap_bindings import opened_database, pycolmap

    options.num_threads = options.mapper.num_threads = thread_count()
    progress.refresh()
    with opened_database(database) as handle:
        check_room(folder, 2 * handle.num_keypoints() * _FEATURE_BYTES)  # COLMAP writes a model, and then we do
    with _followed(folder, progress):
        return pycolmap.incremental_mapping(
            database,
            image_dir,
            folder,
            options=options,
            input_path=base or "",
            initial_image_pair_callback=progress.model_begun,
            next_image_callback=progress.image_registered,
        )


def posed_names(model: Any) -> set[str]:
    """Names of the photographs that have a pose in pycolmap's model."""
    return {model.images[number].name for number in model.reg_image_ids()}


def write_model(model: Any, folder: Path) -> None:
    """Write pycolmap's model as the files of a data set; COLMAP does not say where there was no room for all of it."""
    check_room(folder, sum(image.num_points2D() for image in model.images.values()) * _FEATURE_BYTES)
    model.write_binary(folder)


@contextlib.contextmanager
def _followed(folder: Path, progress: MappingProgress) -> Iterator[None]:
    """COLMAP's log goes to a file in a folder, and `progress` hears of every line soon after it is written."""
    from drgs.data.colmap_bindings import pycolmap

    log = pycolmap.logging
    before = log.minloglevel, log.logtostderr, log.alsologtostderr, log.stderrthreshold
    levels = log.Level.WARNING, log.Level.ERROR, log.Level.FATAL
    for level in levels:  # would each have a file of their own in the system's temporary folder
        log.set_log_destination(level, "")
    log.set_log_destination(log.Level.INFO, str(folder / "log.0."))
    log.logtostderr = False
    log.alsologtostderr = False
    log.stderrthreshold = 3
    log.minloglevel = 0
    is_over = threading.Event()

    def follow() -> None:
        for number in itertools.count():
            is_last = is_over.wait(_EVERY)
            # The log keeps lines back for half a minute, until its file is closed: another one takes its place.
            log.set_log_destination(log.Level.INFO, "" if is_last else str(folder / f"log.{number + 1}."))
            with contextlib.suppress(OSError):  # without the log only the time is reported, not what is being done
                for file in folder.glob(f"log.{number}.*"):
                    for found in map(_LINE.match, file.read_bytes().splitlines()):
                        if found:
                            progress.log_line(found[1].decode("utf-8", "replace"))
                    file.unlink()
            if is_last:
                return
            progress.refresh()

    thread = threading.Thread(target=follow, name="drgs mapping", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        log.minloglevel, log.logtostderr, log.alsologtostderr, log.stderrthreshold = before


@dataclass(frozen=True)
class PhotoGroups:
    """The groups into which photographs separated, one of them the model that was kept.

    Attributes:
        kept: Names of the photographs of the model that was kept, sorted.
        others: Names of those of each other model, the largest first. Models may share photographs.
        alone: Names of the photographs that are in no model.
        gaps: Pairs between which photographs are missing, the best first: one of the kept model, one that is not in it,
            and how many verified matches they share, 0 where no two share any and the two are merely neighbors by name.
        featureless: Names and numbers of features of those photographs alone that have next to none.
    """

    kept: tuple[str, ...]
    others: tuple[tuple[str, ...], ...]
    alone: tuple[str, ...]
    gaps: tuple[tuple[str, str, int], ...]
    featureless: tuple[tuple[str, int], ...]

    @staticmethod
    def of(database: Path, names: Sequence[str], kept: set[str], others: Sequence[set[str]]) -> PhotoGroups:
        """The parts of all `names`, in their order, as the database's matches connect them."""
        others = sorted(others, key=len, reverse=True)
        placed = kept.union(*others)
        alone = tuple(name for name in names if name not in placed)
        features, matches = _counts_in(database)
        lost = [[name for name in names if name in other - kept] for other in others] + [[name] for name in alone]
        gaps = _gaps(names, kept, [group for group in lost if group], matches)
        return PhotoGroups(
            kept=tuple(sorted(kept)),
            others=tuple(tuple(sorted(other)) for other in others),
            alone=alone,
            gaps=tuple(gaps),
            featureless=tuple((name, features[name]) for name in alone if features.get(name, 0) < _FEW_FEATURES),
        )

    def lines(self, names: Sequence[str], is_masked: bool, is_partial: bool) -> list[str]:
        """Whole sentences for people; none where every photograph is in the kept model.

        Args:
            names: Names of all photographs, in their order.
            is_masked: Whether masks said where features may lie.
            is_partial: Whether some pairs of photographs were not compared.
        """
        if len(self.kept) == len(names):
            return []
        sentences = []
        if self.others:
            count = len(self.others) + 1
            sentences.append(
                f"the photos fell apart into {count} models; the largest was kept, with {len(self.kept)} photos: "
                f"{name_ranges(self.kept, names)}"
            )
            for number, other in enumerate(self.others, 2):
                shared = len(set(other) & set(self.kept))
                also = f", {shared} of them also in the kept one" if shared else ""
                sentences.append(
                    f"model {number}, left out, has {len(other)} photos{also}: {name_ranges(other, names)}"
                )
        if self.alone:
            sentences.append(f"in no model: {len(self.alone)} photos: {name_ranges(self.alone, names)}")
        return sentences + [f"what would help: {advice}" for advice in self._advice(is_masked, is_partial)]

    def _advice(self, is_masked: bool, is_partial: bool) -> Iterator[str]:
        """What would bring more photographs into the kept model, the surest first, by what the database shows."""
        dull = {name for name, _ in self.featureless}
        for ours, theirs, matches in [gap for gap in self.gaps if gap[1] not in dull][:_ADVISED]:
            why = f"{matches} matches connect them" if matches else "nothing connects them"
            yield f"photos between {ours} and {theirs} ({why}), each overlapping the one before by two thirds"
        if self.featureless:
            shown = ", ".join(f"{name} ({count})" for name, count in self.featureless[:_ADVISED])
            more = f" and {len(self.featureless) - _ADVISED} more" if len(self.featureless) > _ADVISED else ""
            where = "a larger mask, or a sharper photo" if is_masked else "a sharper, brighter photo"
            yield f"{where} in place of {shown}{more}: too few features, their number is in brackets"
        if is_partial:
            yield "--matcher exhaustive: not all pairs of photos were compared"
        if not is_masked:
            yield "--masks, if the object was turned or moved between photos while its background stood still"


def _counts_in(database: Path) -> tuple[dict[str, int], dict[tuple[str, str], int]]:
    """Number of features by photograph, and of verified matches by pair."""
    from drgs.data.colmap_bindings import opened_database, pycolmap

    with opened_database(database) as handle:
        images = {image.image_id: image.name for image in handle.read_all_images()}
        features = {name: handle.num_keypoints_for_image(number) for number, name in images.items()}
        pairs, counts = handle.read_two_view_geometry_num_inliers()
    matches = {}
    for pair, count in zip(pairs, counts, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        if count:
            matches[images[a], images[b]] = count
    return features, matches


def _gaps(
    names: Sequence[str], kept: set[str], lost: Sequence[Sequence[str]], matches: dict[tuple[str, str], int]
) -> list[tuple[str, str, int]]:
    """Where each lost group is nearest to the kept photographs, by verified matches, else by place in the list; the
    best first.
    """
    groups_of: dict[str, list[int]] = {}
    for number, group in enumerate(lost):
        for name in group:
            groups_of.setdefault(name, []).append(number)
    best: list[tuple[str, str, int]] = [("", "", 0)] * len(lost)
    for (a, b), count in matches.items():
        ours, theirs = (a, b) if a in kept else (b, a)
        for number in groups_of.get(theirs, ()) if ours in kept else ():
            if count > best[number][2]:
                best[number] = ours, theirs, count
    place = {name: index for index, name in enumerate(names)}
    ordered = sorted(place[name] for name in kept)
    for number, group in enumerate(lost):
        if not best[number][2]:
            near = [(abs(place[name] - at), at, name) for name in group for at in _around(ordered, place[name])]
            _, at, theirs = min(near)
            best[number] = names[at], theirs, 0
    return sorted(best, key=lambda gap: -gap[2])


def _around(ordered: Sequence[int], at: int) -> Sequence[int]:
    """The one or two of the places, in rising order, that are next to a place."""
    right = bisect.bisect(ordered, at)
    return ordered[max(0, right - 1) : right + 1]


def name_ranges(some: Sequence[str], names: Sequence[str]) -> str:
    """Names in words: those that follow each other in the list of all names as first and last."""
    place = {name: index for index, name in enumerate(names)}
    stretches: list[list[str]] = []
    for name in sorted(some, key=lambda name: place[name]):
        if stretches and place[stretches[-1][-1]] + 1 == place[name]:
            stretches[-1].append(name)
        else:
            stretches.append([name])
    shown = [f"{part[0]} to {part[-1]}" if len(part) > 2 else ", ".join(part) for part in stretches[:_STRETCHES]]
    rest = sum(map(len, stretches[_STRETCHES:]))
    return ", ".join([*shown, f"and {rest} more"] if rest else shown)
