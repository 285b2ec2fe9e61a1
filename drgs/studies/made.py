"""The data sets of studies: rooms and kitchens that are made where they are not there yet, and those that are given."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path

from drgs.display.progress import Bar
from drgs.fitting.config import FitConfig
from drgs.studies.choices import StudyName

__all__ = ["MADE_SPLIT", "Sizes", "made_folder"]

MADE_SPLIT = (3, 0)
"""Of a room's views: every third is for testing, drawn as the candidates are."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How large the fits of a study are, and the scenes that are made for it.

    Attributes:
        fit: Configuration of every cell.
        image, teacher: (width, height) of images and of a teacher's maps.
        every: Steps between two picks; None: by the number of steps, where things move.
        add: Views to be picked; None: 10, or one at each later time.
        measure: Numbers of views at which the held-out views are measured, before the end.
        views: Views of a room.
        cameras: Cameras of a kitchen; it has as many times as the fit takes.
        of_one_camera: Views at the start and views to be picked, where one camera moves about and films what moves.
        info_pixels: Pixels of the views that information is computed from; None: those of the fit.
    """

    fit: FitConfig
    image: tuple[int, int]
    teacher: tuple[int, int]
    every: int | None = None
    add: int | None = None
    measure: tuple[int, ...] = ()
    views: int = 0
    cameras: int = 0
    info_pixels: int | None = None
    of_one_camera: tuple[int, int] | None = None


def made_folder(
    study: StudyName, sizes: Sizes, made: Path, given: Mapping[str, Path]
) -> Callable[[str, tuple[int, int]], Path]:
    """Scene and split -> folder of the data set, as `Study.folder`; other processes can be sent it."""
    return functools.partial(_made, study, sizes, made, dict(given))


def _made(
    study: StudyName,
    sizes: Sizes,
    made: Path,
    given: Mapping[str, Path],
    scene: str,
    split: tuple[int, int],
) -> Path:
    """The room `room-N` or the kitchen `kitchen-N`, of seed N."""
    if scene in given:
        return given[scene]
    from drgs.scenes import kitchen, room

    (width, height) = sizes.image
    (w, h) = sizes.teacher
    size = {"width": width, "height": height, "teacher_width": w, "teacher_height": h, "seed": _number(scene)}
    with Bar(f"path tracing {scene}") as bar:
        if study != "dynamic":
            return room.generate(made / scene, views=sizes.views, test_every=split[0], progress=bar.update, **size)
        times = sizes.fit.data.times
        return kitchen.generate(made / scene, cameras=sizes.cameras, times=times, progress=bar.update, **size)


def _number(scene: str) -> int:
    """Of `room-2`: 2."""
    return int(scene.rpartition("-")[2])
