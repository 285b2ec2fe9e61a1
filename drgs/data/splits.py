"""Which views of a data set are held out, and in which words results say so."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.data.views import View

__all__ = ["SplitRule"]


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
            every, offset, cameras: What is asked for.
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
        """To be recorded with results."""
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
