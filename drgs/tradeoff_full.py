"""Times of a few settings on views as large as `drgs render` draws them, for `drgs tradeoff`.

Ratios change with the size of an image: what a setting does once a Gaussian weighs less in a large one. So the settings
that lead at the reduced size are timed again on the cameras themselves, within a number of seconds that the user gives.
Where three rounds of `exact` would take longer, views are reduced just so far that they do not, and the report says so.
"""

from __future__ import annotations

import random
import statistics
from collections.abc import Callable

import torch

import drgs
from drgs.active import at_most
from drgs.settings import RenderSettings
from drgs.tradeoff_advice import interval, leaders
from drgs.tradeoff_measure import clocked, placed

__all__ = ["measure_full"]

_ROUNDS = 3  # at least
_GROW = 4  # times as many pixels are tried next, on the way to full size


def measure_full(
    measured: dict, gaussians, cameras: list, budgets, repeats: int, seconds: float, seed: int, say: Callable
) -> dict:
    """Times at full size, into the rows' `full`: clock -> ratio, low, high, rounds, seconds.

    Args:
        measured: Of `tradeoff_measure.measure`.
        gaussians: On the device that they are rendered on.
        cameras: Pinhole, as large as they are drawn.
        budgets: Of errors.
        repeats: Rounds at most.
        seconds: For all three clocks together.
        seed: Of the order within a round.
        say: Called with what is being timed, before each.
    Returns:
        Clock -> `size` of the first view as it was timed, `drawn`, its own size, `rounds` and `names` of the rows.
    """
    rows = {row["name"]: row for row in measured["rows"]}
    exact, order, report = measured["rows"][0], random.Random(seed), {}
    gaussians = placed(gaussians)
    chosen = {clock: leaders(measured, clock, budgets) for clock in ("forward", "forward_backward", "fisher")}
    chosen = {clock: names for clock, names in chosen.items() if names}
    for k, (clock, names) in enumerate(chosen.items()):
        work = _Work(clock, gaussians, seed)
        share = seconds / (len(chosen) - k)
        # What a round takes, in units of exact's time: at full size the others take a smaller share of it, if any.
        units = 1 + sum(rows[name]["times"][clock]["ratio"] for name in names)
        views, spent = _sized(work, cameras, exact, measured["pixels"], share / (_ROUNDS * units), say)
        took: dict[str, list[float]] = {name: [] for name in (exact["name"], *names)}
        for number in range(max(repeats, _ROUNDS)):
            a_round = sum(x[-1] for x in took.values()) if number else 0.0
            if number >= _ROUNDS and spent + a_round > share:
                break
            camera = views[number % len(views)]
            for name in (exact["name"], *order.sample(names, len(names))):
                say(_said(clock, camera, name))
                took[name].append(work(camera, rows[name]))
                spent += took[name][-1]
        seconds = max(seconds - spent, 0.0)
        for name, times in took.items():
            ratios = [a / b for a, b in zip(times, took[exact["name"]], strict=True)]
            rows[name]["full"][clock] = {**interval(ratios), "seconds": statistics.median(times)}
        report[clock] = {
            "size": [views[0].width, views[0].height],
            "drawn": [cameras[0].width, cameras[0].height],
            "rounds": len(took[exact["name"]]),
            "names": list(took),
        }
    return report


class _Work:
    """One clock: what is done to a view between its two readings."""

    def __init__(self, clock: str, gaussians, seed: int):
        self.clock, self.gaussians, self.seed = clock, gaussians, seed
        self.leaves = {name: x.clone().requires_grad_() for name, x in gaussians.parameters().items()}
        self.moving = gaussians.replace(**self.leaves)

    def __call__(self, camera, row: dict) -> float:
        """Seconds that a row's settings take."""
        return clocked(lambda: getattr(self, "_" + self.clock)(camera, RenderSettings(**row["settings"])))[1]

    def _forward(self, camera, settings):
        with torch.no_grad():
            out = drgs.render(self.gaussians, camera, settings, outputs=())
        return out.rgb.cpu(), out.alpha.cpu()  # as `drgs render` takes them

    def _forward_backward(self, camera, settings):
        image = drgs.render(self.moving, camera, settings, outputs=()).rgb
        signs = torch.randint(0, 2, image.shape, generator=torch.Generator().manual_seed(self.seed)) * 2 - 1
        return torch.autograd.grad((image * signs.to(image)).sum(), list(self.leaves.values()), allow_unused=True)

    def _fisher(self, camera, settings):
        return drgs.fisher.diagonal(self.gaussians, camera, settings)


def _sized(work: _Work, cameras: list, exact: dict, pixels: float, allowed: float, say) -> tuple[list, float]:
    """The cameras, reduced until one of `exact` takes no longer than allowed; and the seconds that finding out took.

    Four times as many pixels are tried each time, so that nothing far too large is ever begun.
    """
    whole, spent = max(camera.width * camera.height for camera in cameras), 0.0
    while True:
        camera = at_most(cameras[0], int(min(pixels, whole)))
        say(_said(work.clock, camera, "exact"))
        took = work(camera, exact)
        spent += took
        if pixels >= whole or took * _GROW > allowed:
            break
        pixels *= _GROW
    # Time grows with the pixels at most.
    pixels = min(whole, pixels * max(allowed / took, 1.0 if took <= allowed else 0.0))
    return [at_most(camera, max(1, int(pixels))) for camera in cameras], spent


def _said(clock: str, camera, name: str) -> str:
    return f"{clock.replace('_', ' + ')} at {camera.width}x{camera.height}: {name}"
