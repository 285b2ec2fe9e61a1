"""A fit as studies make it, step by step in memory with the time of each step, and its pictures in several renderers.

`drgs.train.fit` writes a run folder, measures on the way, and counts that in its seconds; here is nothing but steps.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path

from where import DATA

from drgs.data import Dataset, View, load
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame, frames_for
from drgs.fitting.metrics import through_renderers
from drgs.fitting.start import start_plain
from drgs.settings import RenderSettings

__all__ = ["Fit", "fitted", "folder_of", "psnr_by_renderer", "split_of"]

_MADE = ("still0", "still7", "room21", "room22")  # docs/real-data.md has their commands
_PATHS = {"street": "street/sparse_dev/0"}


def folder_of(scene: str, made: Path, data: Path = DATA) -> Path:
    """The data set of a capture, or of a made scene in a folder of such."""
    return made / scene if scene in _MADE else data / _PATHS.get(scene, scene)


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fit after its last step.

    Attributes:
        gaussians: What was fitted.
        frames: Training photographs, at the size of the fit.
        test: Held-out views, which nothing has read yet.
        step_seconds: Seconds on the clock of each step.
        process_seconds: Seconds that the process computed in all steps, whatever ran beside it.
    """

    gaussians: Gaussians
    frames: list[Frame]
    test: list[View]
    step_seconds: list[float]
    process_seconds: float

    @property
    def seconds(self) -> float:
        """Seconds on the clock of all steps."""
        return sum(self.step_seconds)


def split_of(dataset: Dataset, config: FitConfig) -> tuple[list[View], list[View]]:
    """(train, test) views of a data set, as a fit of this configuration has them."""
    return dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)


def fitted(scene: str, config: FitConfig) -> Fit:
    """Fit Gaussians to a capture, all steps of the configuration.

    Args:
        scene: Name of a capture, or a folder.
        config: Configuration of the fit.
    """
    dataset = load(DATA / scene)
    train, test = split_of(dataset, config)
    frames = frames_for(train, config.data)
    trainer = start_plain(dataset, train, frames, config)
    took: list[float] = []
    began = time.process_time()
    while trainer.step_index < config.max_steps:
        step_began = time.perf_counter()
        trainer.step()
        took.append(time.perf_counter() - step_began)
    return Fit(trainer.gaussians(), frames, test, took, time.process_time() - began)


def psnr_by_renderer(
    gaussians: Gaussians, frames: list[Frame], renderers: Mapping[str, RenderSettings], most: int | None = None
) -> dict[str, list[float]]:
    """Renderer -> PSNR of each photograph, in dB.

    Args:
        gaussians: What is shown.
        frames: Photographs to compare with, at least one.
        renderers: Name -> settings.
        most: Photographs that are compared at most, evenly spaced; None takes all.
    """
    found = through_renderers(gaussians, frames, renderers, "test", most)
    if found is None:
        raise ValueError("fits: there must be a held-out view, got none; hold some out (test_every)")
    return {row["name"]: [view["psnr"] for view in row["views"]] for row in found["rows"]}
