"""Sizes and steps that a budget of time allows, from short measurements on this machine.

Poses are planned first: two of the photographs are matched, and the seconds of that decide how large photographs may be
for structure from motion. The rest of the time is the fit's: some steps of it are timed, in growing sizes, with as many
Gaussians as it will have on average, and the largest size that fits gets as many steps as there is time for. No fit is
cut off while it runs: learning rates end where they should.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from drgs.data import Dataset, View
from drgs.data.images import image_size, read_image
from drgs.data.videos import VideoFrame, read_video
from drgs.display.pictures import shrunk
from drgs.display.progress import Bar, duration
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import frames_for
from drgs.fitting.start import start_plain
from drgs.io.atomic import temporary_folder
from drgs.runtime.threads import fewer_torch_threads
from drgs.sfm.matching import FeatureOptions, extract, match, quiet, start_extraction
from drgs.sfm.pairing import MAX_EXHAUSTIVE

FEWEST_STEPS = 100
"""Least number of steps of a fit, however little time is left: fewer give no usable picture. Chosen."""

# How the number of steps follows the clock (`Pacer`).
_STEPS_BETWEEN_LOOKS = 20  # steps between two looks at the clock: often enough to end within a few seconds
_STEPS_AVERAGED = 60  # latest steps whose time is that of those to come: five cycles of the longest list of renderers
_STEPS_OF_COMPILATION = 40  # steps before the first look: every renderer compiles its kernels in its first ones
_GROWTH_ENDS = 0.5  # share of the steps from which on Gaussians do not grow in number (`DensityConfig.grow_until`)
_LEAST_CHANGE = 0.03  # share of the steps; a smaller change would reschedule rates for less than the clock's noise
_MOST_STEPS = 4.0  # times the planned steps, however fast they are: a plan timed beside other programs is too short

_LEAST_REST = 30.0  # seconds after poses: fewer are not enough for a fit. Chosen

# Poses: what two photographs take says what all of them take.
_MEASURED_SIZE = 800  # pixels of the longer side at which two photographs are timed: a second or two
_IMAGE_SIZES = (1600, 1200, 1000, 800, 640, 480)  # pixels of the longer side that poses may be computed at
_POSES_SHARE = 0.4  # of the budget, that poses should not exceed: the rest is the fit's
# Mapping of 16 photographs of 752 pixels (`banana`) took 1.1 times as long as features of one of them, of 292 of 800
# pixels (`bonsai`) 507 times: what features take says how fast the machine is. Measured of smaller ones: a third.
_MAPPING_FACTOR, _MAPPING_POWER = 1.1 / 16**2.11, 2.11  # features' seconds of one photograph, power of their number
_PAIRS_EACH = 18  # pairs of each photograph where those near by name and by appearance are matched
_MOST_MATCHING = 4.0  # times the matches of `_MEASURED_SIZE`: COLMAP finds at most 8192 features, whatever the size
_FEWEST_FRAMES = 20  # of videos, however little time there is: fewer do not connect

_FEWER_STEPS, _MORE_STEPS = 0.5, 1.5  # of the steps of a size that it may have; beyond, another size is better
_TIMED_VIEWS = 8  # photographs that timed steps go through, evenly of all
_TIMED_STEPS = 12  # steps that are timed: twice the longest cycle of renderers
_RESERVE = 0.05  # of what is left, for steps that take longer than the timed ones
_REPORT_SECONDS = 9.0  # of held-out views, findings of the expected error and report, whatever the size
_TRAINING_STEPS, _HELD_OUT_STEPS = 2.0, 4.0  # and, in steps, of each view: a held-out one is drawn by each renderer


@dataclasses.dataclass(frozen=True)
class _FitSize:
    """A size of a fit: pixels of a photograph, Gaussians, steps."""

    pixels: int
    gaussians: int
    steps: int


_SIZES = (  # each takes about three times as long as the one before
    _FitSize(12_000, 8_000, 400),
    _FitSize(30_000, 12_000, 800),
    _FitSize(60_000, 20_000, 1_500),
    _FitSize(130_000, 30_000, 3_000),
    _FitSize(250_000, 60_000, 5_000),
    _FitSize(430_000, 120_000, 9_000),
)


@dataclasses.dataclass(frozen=True)
class PosePlan:
    """Size of the photographs for structure from motion.

    Attributes:
        max_image_size: Pixels of the longer side.
        seconds: How long that is expected to take.
    """

    max_image_size: int
    seconds: float


@dataclasses.dataclass(frozen=True)
class FitPlan:
    """How large a fit is.

    Attributes:
        max_pixels: Pixels of a photograph.
        max_gaussians: Number of Gaussians.
        max_steps: Number of steps.
        seconds: How long the steps are expected to take.
        after: How long held-out views and the report are expected to take.
    """

    max_pixels: int
    max_gaussians: int
    max_steps: int
    seconds: float
    after: float = 0.0

    def config(self, config: FitConfig) -> FitConfig:
        """A configuration with these sizes."""
        return config.replace(
            max_steps=self.max_steps,
            data=dataclasses.replace(config.data, max_pixels=self.max_pixels),
            density=dataclasses.replace(config.density, max_gaussians=self.max_gaussians),
        )

    def line(self, left: float, used: float) -> str:
        """The plan in one line, with the seconds that it needs where the budget is too small.

        Args:
            left, used: Seconds of the budget that are left, less than 0 where it is used up, and that have been used.
        """
        size = (
            f"{self.max_steps} steps at {self.max_pixels} pixels with up to {self.max_gaussians} Gaussians, about "
            f"{duration(self.seconds)}, and {duration(self.after)} for what follows"
        )
        needed = self.seconds + self.after
        if left >= needed:
            return f"plan for the {duration(left)} left: {size}"
        left_of_it = f"only {duration(left)} of the budget are left" if left >= 1 else "the budget is used up"
        return f"{left_of_it}: the smallest fit has {size}, about {duration(used + needed)} in all"


class Pacer:
    """Number of steps with which a fit ends in time; the argument `pace` of `drgs.train.fit`.

    While Gaussians still grow in number, later steps take longer than those seen so far: steps are only taken away
    then, where even these are too slow. After that their number follows the clock in both directions, up to 4 times
    what was planned. Schedules of a fit go by the share of its steps that is done, so that they end where they should.

    Args:
        end: Time at which the last step is to be done, as `clock` counts.
        planned: Steps that were planned.
        clock: Seconds of a monotonic clock.
    """

    def __init__(self, end: float, planned: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._end = end
        self._most = round(_MOST_STEPS * planned)
        self._clock = clock
        self._marks: deque[tuple[int, float]] = deque(maxlen=_STEPS_AVERAGED)
        self._first: int | None = None

    def __call__(self, done: int, total: int) -> int:
        """Steps of the whole fit.

        Args:
            done: Steps that are done.
            total: Steps that the fit has so far.
        """
        now = self._clock()
        if self._first is None:
            self._first = done
        self._marks.append((done, now))
        if done - self._first < _STEPS_OF_COMPILATION or done % _STEPS_BETWEEN_LOOKS or done >= total:
            return total
        first, began = self._marks[0]
        each = (now - began) / (done - first)
        possible = max(done + max(1, int((self._end - now) / max(each, 1e-9))), min(total, FEWEST_STEPS))
        wanted = min(possible, total if done < _GROWTH_ENDS * total else max(total, self._most))
        return (
            wanted
            if abs(wanted - total) > _LEAST_CHANGE * total or wanted <= done + _STEPS_BETWEEN_LOOKS < total
            else total
        )


def plan_poses(
    folder: Path, names: Sequence[str], budget: float, decode: Callable[[Path], np.ndarray] = read_image
) -> PosePlan:
    """Size of the photographs for structure from motion, from the seconds that two of them take.

    Args:
        folder, names: The photographs, at least two.
        budget: Seconds of the whole capture.
        decode: As `drgs.data.images.read_image`.
    """
    largest = max(image_size(folder / names[0]))
    chosen = [names[len(names) // 3], names[min(len(names) // 3 + 1, len(names) - 1)]]
    with Bar("estimating the time of poses"):
        features, pair = _timed_pair([decode(folder / name) for name in chosen])
    measured = min(_MEASURED_SIZE, largest)
    sizes = [size for size in _IMAGE_SIZES if size < largest]
    sizes += [largest] if largest <= _IMAGE_SIZES[0] else []
    plans = [PosePlan(size, _pose_seconds(len(names), features, pair, size / measured)) for size in sorted(sizes)[::-1]]
    return next((plan for plan in plans if plan.seconds <= _POSES_SHARE * budget), plans[-1])


def plan_frames(video: Path, photographs: int, most: int, budget: float) -> int:
    """How many frames of videos there may be at most, so that poses, at the smallest size, leave time for the fit.

    Args:
        video: One of the videos; two of its frames are timed.
        photographs: Number of photographs beside them.
        most: Largest number of frames.
        budget: Seconds of the whole capture.
    """
    read = read_video(video)
    first = read.count // 3
    with Bar("estimating the time of poses"):
        features, pair = _timed_pair([VideoFrame(video, min(first + k, read.count - 1)).read() for k in (0, 10)])
    largest = max(read.width, read.height)
    scale = min(_IMAGE_SIZES[-1], largest) / min(_MEASURED_SIZE, largest)
    allowed = _POSES_SHARE * budget
    for count in range(most, _FEWEST_FRAMES, -1):
        if _pose_seconds(photographs + count, features, pair, scale) <= allowed:
            return count
    return min(most, _FEWEST_FRAMES)


def _timed_pair(images: Sequence[np.ndarray]) -> tuple[float, float]:
    """Seconds that features of a photograph take, and to match two of them, at `_MEASURED_SIZE` pixels."""
    with temporary_folder("plan") as folder:
        database = folder / "database.db"
        names = [f"{number}.png" for number in range(len(images))]
        for name, image in zip(names, images, strict=True):
            _write_small(image, folder / name)
        start_extraction()
        began = time.perf_counter()
        with quiet():
            extract(database, folder, names, FeatureOptions())
            features = (time.perf_counter() - began) / len(names)
            began = time.perf_counter()
            match(database, [(names[0], names[1])])
            pair = time.perf_counter() - began
    return features, pair


def planned_poses(plan: PosePlan, count: int, left: float, budget: float) -> str:
    """The plan in one line, with the seconds that it needs where the budget is too small.

    Args:
        plan: Size of the photographs.
        count: Number of photographs.
        left: Seconds that are left of the budget.
        budget: Seconds of the whole capture.
    """
    size, rest = plan.max_image_size, left - plan.seconds
    if rest >= _LEAST_REST:
        return (
            f"plan for {duration(budget)}: {count} photographs at {size} pixels for poses, about "
            f"{duration(plan.seconds)}; then a fit as large as the {duration(rest)} after it allow, by timed steps"
        )
    enough = math.ceil(plan.seconds / _POSES_SHARE / 60)
    return (
        f"{duration(budget)} are not enough and are exceeded: poses of {count} photographs take about "
        f"{duration(plan.seconds)} even at {size} pixels, and the smallest fit follows; --budget {enough}min leaves "
        "time for a fit, fewer photographs take less"
    )


def _write_small(image: np.ndarray, target: Path) -> None:
    """A photograph as PNG of at most `_MEASURED_SIZE` pixels along the longer side."""
    import cv2

    image = image[..., 2::-1] if image.ndim == 3 else image
    target.write_bytes(cv2.imencode(".png", shrunk(np.ascontiguousarray(image), _MEASURED_SIZE))[1].tobytes())


def _pose_seconds(count: int, features: float, pair: float, scale: float) -> float:
    """Seconds of poses of `count` photographs at `scale` times the size at which `features` and `pair` were taken."""
    pairs = count * (count - 1) / 2 if count <= MAX_EXHAUSTIVE else count * _PAIRS_EACH
    # There are as many features as pixels, and they are compared all to all.
    return (
        count * features * scale**2
        + pairs * pair * min(scale**4, _MOST_MATCHING)
        + _MAPPING_FACTOR * features * scale**2 * count**_MAPPING_POWER
    )


def plan_fit(
    dataset: Dataset, config: FitConfig, left: float, least: int = 1, stopwatch: Stopwatch | None = None
) -> FitPlan:
    """How large a fit of a data set may be, from timed steps.

    Args:
        dataset: The data set, with points.
        config: What else the fit does; its renderers are those that are timed.
        left: Seconds that are left, for the fit and what follows it.
        least: Gaussians that there are already, of which none are taken away.
        stopwatch: What times steps; default one of this machine.
    """
    stopwatch = stopwatch or Stopwatch()
    train, test = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)
    largest = max(view.camera.width * view.camera.height for view in train)
    best: FitPlan | None = None
    end = stopwatch.now() + left
    before: float | None = None
    with Bar("how long steps take") as bar:
        for number, allowed in enumerate(_SIZES):
            pixels, fewest = min(allowed.pixels, largest), _FEWER_STEPS * allowed.steps
            bar.update(number, text=f"at {pixels} pixels")
            # A step takes about twice as long as in the size before.
            needed = 0.0 if before is None else 2 * before * (fewest + _TIMED_STEPS)
            if best is not None and needed > end - stopwatch.now() - best.after:
                break
            size = FitPlan(pixels, max(allowed.gaussians, least), allowed.steps, 0.0)
            each = stopwatch.step(train, dataset, size.config(config), is_first=number == 0)
            after = _REPORT_SECONDS + each * (_TRAINING_STEPS * len(train) + _HELD_OUT_STEPS * len(test))
            room = (1 - _RESERVE) * (end - stopwatch.now() - after)
            possible = math.floor(room / each)
            if best is not None and possible < fewest:
                break
            count = int(min(max(possible, FEWEST_STEPS), _MORE_STEPS * allowed.steps))
            best = FitPlan(size.max_pixels, size.max_gaussians, count, count * each, after)
            before = each
            if pixels >= largest:
                break
    assert best is not None
    return best


class Stopwatch:
    """Times steps of a fit on this machine."""

    def now(self) -> float:
        """Seconds of a monotonic clock."""
        return time.monotonic()

    def step(self, train: list[View], dataset: Dataset, config: FitConfig, is_first: bool) -> float:
        """Seconds that a step takes on average, with as many Gaussians as there are on average.

        Args:
            train: Training views.
            dataset: The data set.
            config: Configuration with the sizes.
            is_first: Whether to take all renderers' first steps, which compile, beforehand.
        """
        views = train[:: max(1, len(train) // _TIMED_VIEWS)]
        with Bar("", show=False), _without_log(), fewer_torch_threads():  # that of how long steps take is shown
            frames = frames_for(views, config.data)
            timed = config.replace(data=dataclasses.replace(config.data, skybox="off", exposure="off", poses="fixed"))
            trainer = start_plain(_with_more_points(dataset, config), views, frames, timed)
            # As late in a fit, where all degrees of color are there.
            while trainer.rows.sh_degree < config.sh_degree:
                trainer.rows.raise_sh_degree()
            for _ in range(_TIMED_STEPS if is_first else 0):
                trainer.step()
            began = time.perf_counter()
            for _ in range(_TIMED_STEPS):
                trainer.step()
            return (time.perf_counter() - began) / _TIMED_STEPS


@contextlib.contextmanager
def _without_log() -> Iterator[None]:
    """Hide the log lines of a fit that is only timed."""
    log = logging.getLogger("drgs.train")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(level)


def _with_more_points(dataset: Dataset, config: FitConfig) -> Dataset:
    """The data set with as many points as a fit has Gaussians on average: between its points and its most.

    Points are repeated, displaced by a little of their own spread.
    """
    points, colors = dataset.points, dataset.colors
    if points is None or not len(points):
        return dataset
    most = config.density.max_gaussians
    # Growing evenly up to half of the steps, and full from there on.
    wanted = min(most, int(0.25 * min(len(points), most) + 0.75 * most))
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(points), wanted)
    spread = np.median(np.abs(points - np.median(points, axis=0)), axis=0)
    moved = points[chosen] + 0.01 * spread * rng.normal(size=(wanted, 3))
    shown = None if colors is None else colors[chosen]
    return dataclasses.replace(dataset, points=moved, colors=shown, tracks=None)
