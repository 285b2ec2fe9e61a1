"""One capture: its options, its photographs, its data set and its run, handed from step to step.

Photographs are decoded once, while there is room to keep them, and the data set is loaded once after its poses are
known: looking at photographs, planning, the checks of a shoot, fit, report and page all get these.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drgs.capturing.record import FOLDER, Batch, CaptureRecord
from drgs.data import Dataset
from drgs.data.images import read_image
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_dataset
from drgs.fitting.records import fit_record, is_run
from drgs.io.checkpoint import state_header
from drgs.io.run import Run
from drgs.runtime import memory

SCENE = "scene"
"""Folder of the data set that structure from motion makes, in that of the capture."""

_PHOTOS = "photos"
_KEPT_BYTES = 1 << 30  # of decoded photographs: 28 of 12 megapixels
_KEPT_SHARE = 1 / 8  # of the memory that is free: the fit needs the rest


@dataclasses.dataclass(frozen=True)
class CaptureOptions:
    """Options of a capture; `drgs capture` has them under these names.

    Attributes:
        paths: Photographs, videos, folders of both, or one data set with poses; none to go on with those before.
        output: The run folder.
        budget: Seconds for the whole capture; None: sizes and steps are those of the fit's configuration.
        frames: Largest number of frames of all videos together.
        masks: Folder of masks, or `alpha`, as `drgs.sfm.reconstruction.run_sfm` takes them; None without.
        seed: Seed of everything random.
        resume: Go on with a capture that was stopped.
        add: The photographs join those of a capture that is done.
        progress: Whether to show it.
    """

    paths: tuple[Path, ...]
    output: Path
    budget: float | None = None
    frames: int = 150
    masks: str | None = None
    seed: int = 0
    resume: bool = False
    add: bool = False
    progress: bool = True


class Clock:
    """Time of a capture.

    Attributes:
        began: Time of its beginning, in seconds of `time.monotonic`.
        end: Time at which it is to be done, likewise; None without a budget.
        budget: Seconds of all of it; None without.
    """

    def __init__(self, budget: float | None) -> None:
        self.began = time.monotonic()
        self.budget = budget
        self.end = None if budget is None else self.began + budget

    @property
    def left(self) -> float:
        """Seconds that are left; infinite without a budget."""
        return float("inf") if self.end is None else self.end - time.monotonic()

    @property
    def used(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self.began


class Photographs:
    """Cache of decoded photographs, bounded in bytes; read-only."""

    def __init__(self) -> None:
        free = memory.available()
        self._room = _KEPT_BYTES if free is None else min(_KEPT_BYTES, int(_KEPT_SHARE * free))
        self._kept: dict[tuple[Path, int, int], np.ndarray] = {}

    def decode(self, path: Path) -> np.ndarray:
        """The pixels of an image file, as `drgs.data.images.read_image` has them, with its errors."""
        try:
            file = path.resolve()
            status = file.stat()
        except OSError:
            return read_image(path)
        key = file, status.st_size, status.st_mtime_ns
        pixels = self._kept.get(key)
        if pixels is None:
            pixels = read_image(path)
            pixels.flags.writeable = False
            # The first ones are kept: photographs are gone through in order, the latest would be gone when they return.
            if pixels.nbytes <= self._room:
                self._kept[key] = pixels
                self._room -= pixels.nbytes
        return pixels

    def forget(self) -> None:
        """Give the memory back."""
        self._room += sum(pixels.nbytes for pixels in self._kept.values())
        self._kept.clear()


class Capture:
    """One capture, whose steps read and change it (`drgs.capturing.steps`).

    Attributes:
        options: Its options.
        clock: How much time there is.
        record: Which steps are done.
        photographs: The decoded photographs.
        config: How Gaussians are fitted: as the run in the folder says, where there is one.
        say: Prints a line.
        run: The run folder.
        folder: Folder of the capture in it.
        photos: Folder of this batch's pictures.
        scene: Folder of the data set.
        has_poses: Whether what was named is a data set, whose photographs have poses.
    """

    def __init__(
        self,
        options: CaptureOptions,
        clock: Clock,
        record: CaptureRecord,
        photographs: Photographs,
        config: FitConfig,
        say: Callable[[str], None],
        given: Dataset | None = None,
    ) -> None:
        self.options = options
        self.clock = clock
        self.record = record
        self.photographs = photographs
        self.say = say
        self.run = Run(options.output)
        self.folder = options.output / FOLDER
        number = len(record.batches)
        self.photos = self.folder / (f"{_PHOTOS}_{number}" if number > 1 else _PHOTOS)
        self.config = self._config_of_run() or config
        self.has_poses = given is not None
        self.scene = self.folder / SCENE if given is None else given.path
        self._dataset = None if given is None else self._sharing(given)

    @property
    def batch(self) -> Batch:
        """The photographs that are being worked at."""
        return self.record.batch

    @property
    def is_added(self) -> bool:
        """Whether these photographs are added to those of an earlier batch."""
        return len(self.record.batches) > 1

    @property
    def dataset(self) -> Dataset:
        """The data set, with points; loaded when it is first needed."""
        if self._dataset is None:
            self._dataset = self._sharing(load_dataset(self.scene, self.config))
        return self._dataset

    def poses_changed(self) -> None:
        """Forget the data set, whose files have changed."""
        self._dataset = None

    def refined_dataset(self) -> Dataset:
        """A copy of `dataset` with the poses as the fit has refined them."""
        views = [dataclasses.replace(view) for view in self.dataset.views]
        return fit_record(self.run).with_refined_poses(dataclasses.replace(self.dataset, views=views))

    def plan(self, step: str, plan: Any) -> None:
        """Record the plan of a step."""
        self.batch.plan[step] = dataclasses.asdict(plan)
        self.record.write()

    def _sharing(self, dataset: Dataset) -> Dataset:
        """A data set whose views share the cache of decoded photographs."""
        for view in dataset.views:
            view.decode = self.photographs.decode
        return dataset

    def _config_of_run(self) -> FitConfig | None:
        """Configuration of the run in the folder, or when further photographs were added; None without a run."""
        if is_run(self.options.output):
            return config_of(self.run)
        before = self.batch.plan.get("before")
        return None if before is None else FitConfig.from_json(before["config"])


def config_of(run: Run) -> FitConfig:
    """The configuration with which a fit is continued: the checkpoint's. On a full disk, config.json and files that are
    made of the checkpoint may be older.
    """
    if run.state.is_file():
        return FitConfig.from_json(state_header(run.state)["config"])
    return fit_record(run).config
