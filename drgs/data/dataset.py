"""Data sets: views of one scene, its points, and which views are held out, by what rule."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from drgs.data.semantics import Semantics
from drgs.data.views import View
from drgs.io.journal import SCHEMA
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import write_json


@dataclasses.dataclass
class Dataset:
    """Views of one scene and, where the data set has them, its points.

    Attributes:
        path: What was loaded.
        format: `colmap`, `transforms`, `llff`, `replica`, `neu3d`, `cameras`, `train_meta`, or what a
            loader from elsewhere calls it.
        views: Views whose image is there, in the order of the data set.
        points: (P,3) float64 world points, or None.
        colors: (P,3) float32 in [0,1], or None.
        point_source: Origin of the points in one line; empty without points.
        test_every: Every how many views one is held out.
        test_offset: index, by name, of the first view that is held out.
        absent: Views that the data set lists, but whose image is not there; they have no camera, and count in `split`
            alone, which therefore stays the same whatever is missing.
        semantics: a teacher's maps, labels and classes, or None where there are none.
        test_cameras: Names of the cameras that are held out at all times, which wins over the other rules; None or
            empty: the other rules hold.
        frames: Numbers of the frames that were used, the same of each video or camera, one for each of `times`; empty
            where there are no synchronous cameras.
        reprojection: Median angle in radians between observations of the data set's points and where its cameras see
            these points; None where it states none.
        tracks: Points (N, 3), 20,000 of the data set's own at most, and view name -> int64 indices of those that this
            view was found to show; None where the data set does not say.
        origin: (3,) float64 world: what Gaussians that are fitted to the data set are relative to. 0 unless the cameras
            stand far from there; cameras and points themselves stay in the world (`drgs.data.load` sets it).
    """

    path: Path
    format: str
    views: list[View]
    points: np.ndarray | None = None
    colors: np.ndarray | None = None
    point_source: str = ""
    test_every: int = 8
    absent: list[View] = dataclasses.field(default_factory=list)
    test_offset: int = 0
    semantics: Semantics | None = None
    test_cameras: tuple[str, ...] | None = None
    frames: tuple[int, ...] = ()
    reprojection: float | None = None
    tracks: tuple[np.ndarray, Mapping[str, np.ndarray]] | None = None
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))

    @property
    def times(self) -> tuple[float, ...]:
        """The distinct times of the views, ascending; empty if none has one."""
        return _times(self.views)

    @property
    def is_dynamic(self) -> bool:
        """Whether the training views were taken at two times or more."""
        return len(_times(self.split()[0])) >= 2

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The names of synchronous cameras, sorted; empty where views are photographs of their own."""
        return tuple(sorted({view.camera_name for view in (*self.views, *self.absent)} - {""}))

    def split(
        self,
        test_every: int | None = None,
        test_offset: int | None = None,
        test_cameras: tuple[str, ...] | None = None,
    ) -> tuple[list[View], list[View]]:
        """(train, test) views, both sorted by name, by the rule that `split_rule` names.

        Cameras that are held out by name win over a split that the data set's own files state (`View.split`), and this
        wins over both numbers.

        Args:
            test_every: 8 holds out every 8th view, 0 none; the data set's own number if left out.
            test_offset: 2 holds out the 3rd view first; the data set's own number if left out, 0 if `test_every` is
                given alone.
            test_cameras: Names of the cameras that are held out at all times; the data set's own if left out.
        Raises:
            ValueError: If a number is out of range, the offset lies beyond the last view, or there is no such camera.
        """
        train, test = self._rule(test_every, test_offset, test_cameras).parts([*self.views, *self.absent])
        there = {id(view) for view in self.views}
        return [view for view in train if id(view) in there], [view for view in test if id(view) in there]

    def split_rule(
        self,
        test_every: int | None = None,
        test_offset: int | None = None,
        test_cameras: tuple[str, ...] | None = None,
    ) -> str:
        """The rule of `split` in words, to be recorded with results."""
        return self._rule(test_every, test_offset, test_cameras).words()

    def _rule(self, test_every: int | None, test_offset: int | None, test_cameras: tuple[str, ...] | None) -> SplitRule:
        if test_offset is None:
            test_offset = self.test_offset if test_every is None else 0
        every = self.test_every if test_every is None else test_every
        cameras = self.test_cameras if test_cameras is None else test_cameras
        return SplitRule.of([*self.views, *self.absent], len(self.views), every, test_offset, cameras or ())


def _times(views: list[View]) -> tuple[float, ...]:
    return tuple(sorted({view.camera.time for view in views if view.camera and view.camera.time is not None}))


@dataclasses.dataclass(frozen=True)
class SplitRule:
    """Every n-th view by name, from an offset on; or what the views say themselves, which wins; or cameras held out at
    all times, which wins over both.

    Attributes:
        every: Every how many views one is held out; 0 for none.
        offset: Index of the first of them.
        stated: Whether the data set's own files say which view is for what.
        cameras: Names of the cameras that are held out at all times.
    """

    every: int
    offset: int
    stated: bool
    cameras: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, listed: Sequence[View], there: int, every: int, offset: int, cameras: tuple[str, ...] = ()
    ) -> SplitRule:
        """The rule for these views.

        Args:
            listed: All views, those included whose image is missing.
            there: How many have their image; of fewer than 2 none is held out.
            every, offset, cameras: The requested split.
        Raises:
            ValueError: If a number is out of range, the offset lies beyond the last view, or cameras are held out that
                there are not, or all that there are.
        """
        if cameras:
            _check_cameras(listed, cameras)
            return cls(every, offset, False, tuple(sorted(set(cameras))))
        if any(view.split for view in listed):
            return cls(every, offset, True)
        if every < 0 or every == 1:
            raise ValueError(f"split: test_every must be 0 (none) or >= 2, got {every}; correct it")
        if not 0 <= offset < max(every, 1):
            raise ValueError(
                f"split: test_offset must be in 0..{max(every, 1) - 1} with test_every {every}, got {offset}; "
                "correct it"
            )
        if there < 2:
            return cls(0, 0, False)
        if every and offset >= len(listed):
            raise ValueError(
                f"split: test_offset must be the index of one of the {len(listed)} views, got {offset}; lower it"
            )
        return cls(every, offset, False)

    def parts(self, listed: Sequence[View]) -> tuple[list[View], list[View]]:
        """(train, test) views, both sorted by name; of a data set without a test split, `val` is the test split."""
        # By name: the order of a data set may be that of its files, and the split must not change with it.
        listed = sorted(listed, key=lambda view: view.name)
        if self.cameras:
            train = [view for view in listed if view.camera_name not in self.cameras]
            return train, [view for view in listed if view.camera_name in self.cameras]
        if self.stated:
            held_out = "test" if any(view.split == "test" for view in listed) else "val"
            train = [view for view in listed if view.split not in ("val", "test")]
            return train, [view for view in listed if view.split == held_out]
        if not self.every:
            return listed, []
        train = [view for index, view in enumerate(listed) if index % self.every != self.offset]
        return train, listed[self.offset :: self.every]

    def words(self) -> str:
        """The rule in words, to be recorded with results."""
        if self.cameras:
            noun = "camera" if len(self.cameras) == 1 else "cameras"
            return f"{noun} {', '.join(self.cameras)} held out at all times"
        if self.stated:
            return "as the data set's files say"
        if self.every == 0:
            return "no view held out"
        return f"views sorted by name, index % {self.every} == {self.offset} held out"


def _check_cameras(listed: Sequence[View], cameras: tuple[str, ...]) -> None:
    """Raise ValueError unless all of `cameras`, and others, have taken views."""
    known = sorted({view.camera_name for view in listed} - {""})
    if not known:
        raise ValueError(
            f"split: test_cameras must be left out where views are of no named cameras, got {', '.join(cameras)}; "
            "use test_every"
        )
    if missing := [name for name in cameras if name not in known]:
        raise ValueError(f"split: test_cameras must be among {', '.join(known)}, got {missing[0]!r}; correct it")
    if set(known) <= set(cameras):
        raise ValueError(f"split: test_cameras must leave a camera to be fitted to, got all {len(known)}; name fewer")


HELD_OUT = "held_out.json"
"""File of a data set that says which of its views are held out."""
_ADVICE = "restore the file, or delete it to hold out every 8th view"


def write_held_out(folder: str | os.PathLike, names: Iterable[str], command: str) -> None:
    """Say which views of a data set are held out from now on.

    Args:
        folder: The data set.
        names: Names of these views.
        command: Name of the command that says so.
    """
    write_json(Path(folder) / HELD_OUT, {"schema": SCHEMA, "command": command, "test": sorted(names)})


def apply_held_out(dataset: Dataset) -> None:
    """Mark the views that `held_out.json` lists as held out, if there is one and the data set's own files have no
    split.

    Raises:
        ValueError: If the file is damaged, or names a view that is not there.
    """
    file = Path(dataset.path) / HELD_OUT
    views = [*dataset.views, *dataset.absent]
    if not file.is_file() or any(view.split for view in views):
        return
    value = read_json(file, "a list of held-out views", _ADVICE)
    check_json(str(file), value, {"test": [str]}, _ADVICE)
    if missing := sorted(set(value["test"]) - {view.name for view in views}):
        raise ValueError(f"{file}: test must name views of the data set, got {missing[0]!r}; {_ADVICE}")
    for view in views:
        view.split = "test" if view.name in value["test"] else "train"
