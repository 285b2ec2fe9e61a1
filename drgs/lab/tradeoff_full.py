"""Times of a few settings on views as large as `drgs render` draws them, for `drgs tradeoff`.

Ratios change with the size of an image: what a setting does once a Gaussian weighs less in a large one. So the settings
that lead at the reduced size are timed again on the cameras themselves, within a number of seconds that the user gives.
Where one round would take longer, views are reduced just so far that it does not, and the report says so. Where there
is no time for three rounds, intervals are as wide as the scatter of equal work at the reduced size.
"""

from __future__ import annotations

import dataclasses
import random
import statistics
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch

from drgs import fisher
from drgs.integrator import render
from drgs.lab.tradeoff import clocked, placed
from drgs.lab.tradeoff_advice import interval, leaders
from drgs.lab.tradeoff_rows import CLOCKS, FullTime, Interval, Measured, TradeoffRow
from drgs.sizes import at_most

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["FullSize", "measure_full"]

_ROUNDS = 3  # rounds that say how much times scatter
_FORWARD = 0.6  # share of the seconds for images, which is what is drawn at full size
_GROW = 4  # times as many pixels are tried next, on the way to full size


@dataclasses.dataclass(frozen=True)
class FullSize:
    """What was timed with a clock, in the order of tradeoff.json.

    Attributes:
        size: (width, height) of the first view as it was timed; None where there was no time.
        drawn: (width, height) of the first view as it is drawn.
        rounds: Number of rounds of timing.
        names: Names of the rows that were timed.
    """

    size: list[int] | None
    drawn: list[int]
    rounds: int
    names: list[str]


def measure_full(
    measured: Measured,
    gaussians: Gaussians,
    cameras: list[Camera],
    budgets: Sequence[float],
    repeats: int,
    seconds: float,
    seed: int,
    say: Callable[[str], None],
) -> dict[str, FullSize]:
    """Times at full size, into the rows' `full`: clock -> `FullTime`.

    Args:
        measured: What `tradeoff.measure` returned.
        gaussians: Gaussians of the scene, at least one.
        cameras: Pinhole cameras, as large as they are drawn.
        budgets: Largest errors that are allowed.
        repeats: Largest number of rounds.
        seconds: Time for all three clocks together.
        seed: Seed of the order within a round and of the cotangent.
        say: Called with what is being timed, before each.
    Returns:
        Clock -> what was timed with it.
    """
    rows = {row.name: row for row in measured.rows}
    exact = measured.truth
    order = random.Random(seed)
    report = {}
    gaussians = placed(gaussians)
    chosen = {clock: leaders(measured, clock, budgets) for clock in CLOCKS}
    chosen = {clock: names for clock, names in chosen.items() if names}
    drawn = [cameras[0].width, cameras[0].height]
    for k, (clock, names) in enumerate(chosen.items()):
        work = _Work(clock, gaussians, seed)
        share = seconds * (_FORWARD if clock == "forward" and len(chosen) > 1 else 1 / (len(chosen) - k))
        # What a round takes, in units of exact's time: at full size the others take a smaller share of it, if any.
        units = 1 + sum(rows[name].times[clock].ratio for name in names)
        views, spent = _sized(work, cameras, exact, measured.pixels, share, units, say)
        if not views:
            seconds = max(seconds - spent, 0.0)
            report[clock] = FullSize(None, drawn, 0, [])
            continue
        took: dict[str, list[float]] = {name: [] for name in (exact.name, *names)}
        for number in range(max(repeats, _ROUNDS)):
            a_round = sum(x[-1] for x in took.values()) if number else 0.0
            if number and spent + a_round > share:
                break
            camera = views[number % len(views)]
            for name in (exact.name, *order.sample(names, len(names))):
                say(_said(clock, camera, name))
                took[name].append(work(camera, rows[name]))
                spent += took[name][-1]
        seconds = max(seconds - spent, 0.0)
        for name, times in took.items():
            found = interval([a / b for a, b in zip(times, took[exact.name], strict=True)])
            if found.rounds < _ROUNDS and name != exact.name:
                found = _widened(found, measured.scatter[clock])
            rows[name].full[clock] = FullTime(**dataclasses.asdict(found), seconds=statistics.median(times))
        report[clock] = FullSize([views[0].width, views[0].height], drawn, len(took[exact.name]), list(took))
    return report


def _widened(times: Interval, scatter: Interval) -> Interval:
    """Ratios of too few rounds, with an interval at least as wide as equal work scatters."""
    low = min(times.low, times.ratio * scatter.low)
    high = max(times.high, times.ratio * scatter.high)
    return dataclasses.replace(times, low=low, high=high)


class _Work:
    """One clock: what is done to a view between its two readings."""

    def __init__(self, clock: str, gaussians: Gaussians, seed: int):
        self.clock = clock
        self.gaussians = gaussians
        self.seed = seed
        self.leaves = {name: x.clone().requires_grad_() for name, x in gaussians.parameters().items()}
        self.moving = gaussians.replace(**self.leaves)

    def __call__(self, camera: Camera, row: TradeoffRow) -> float:
        """Seconds that a row's settings take."""
        return clocked(lambda: getattr(self, "_" + self.clock)(camera, row.settings))[1]

    def _forward(self, camera: Camera, settings: RenderSettings) -> object:
        with torch.no_grad():  # what an image alone takes
            out = render(self.gaussians, camera, settings, outputs=())
        return out.rgb.cpu(), out.alpha.cpu()  # as `drgs render` takes them

    def _forward_backward(self, camera: Camera, settings: RenderSettings) -> object:
        image = render(self.moving, camera, settings, outputs=()).rgb
        signs = torch.randint(0, 2, image.shape, generator=torch.Generator().manual_seed(self.seed)) * 2 - 1
        return torch.autograd.grad((image * signs.to(image)).sum(), list(self.leaves.values()), allow_unused=True)

    def _fisher(self, camera: Camera, settings: RenderSettings) -> object:
        return fisher.diagonal(self.gaussians, camera, settings)


def _sized(
    work: _Work,
    cameras: list[Camera],
    exact: TradeoffRow,
    pixels: float,
    seconds: float,
    units: float,
    say: Callable[[str], None],
) -> tuple[list[Camera], float]:
    """The cameras, reduced until a round fits into the seconds, and how many of these finding out took.

    No cameras if a round fits at no more than the pixels that all rows were measured with already. Four times as many
    pixels are tried each time, so that nothing far too large is ever begun.
    """
    whole = max(camera.width * camera.height for camera in cameras)
    spent = 0.0
    least = pixels = min(pixels, whole)
    while True:
        camera = at_most(cameras[0], int(pixels))
        say(_said(work.clock, camera, "exact"))
        took = work(camera, exact)
        spent += took
        # Time grows with the pixels at most. What is tried on the way is spent, too.
        fits = pixels * (seconds - spent) / (units * took)
        following = min(whole, _GROW * pixels)
        if following * _GROW >= fits or following >= whole:
            break
        pixels = following
    return [at_most(camera, int(min(whole, fits))) for camera in cameras if fits >= least], spent


def _said(clock: str, camera: Camera, name: str) -> str:
    return f"{clock.replace('_', ' + ')} at {camera.width}x{camera.height}: {name}"
