"""Times and errors of render settings against preset `exact`: what `drgs tradeoff` measures.

Ratios change with the size of an image: what a setting does once a Gaussian weighs less in a large one. So the settings
that lead at the reduced size are timed again on views as large as `drgs render` draws them, within a number of seconds
that the user gives (`measure_full`). Where one round would take longer, views are reduced just so far that it does not,
and the report says so. Where there is no time for three rounds, intervals are as wide as the scatter of equal work at
the reduced size.
"""

from __future__ import annotations

import dataclasses
import random
import statistics
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch

from drgs import fisher, reference, runtime
from drgs.cameras.sizes import at_most, by_share
from drgs.integrator import Output, render, render_rays
from drgs.lab.accuracy import gradient_by
from drgs.lab.tradeoff_advice import leaders
from drgs.lab.tradeoff_rows import (
    CLOCKS,
    NEGLIGIBLE,
    FullTime,
    GradientError,
    ImageError,
    InformationError,
    Interval,
    Measured,
    TradeoffRow,
    Variant,
    WorstErrors,
    interval,
    rows_of,
    why_skipped,
)
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.information.choices import Method

Tensors = dict[str, torch.Tensor]
_Result = TypeVar("_Result")

# ------------------------------------------------------------------------------------------------------------ measuring

# seconds after which no further round begins: of the clock or, where others use the machine, of the processor. Chosen
_ROUNDS_SECONDS = 100.0
_MIN_ROUNDS = 3  # rounds of timing, at least: fewer have no median
_BVH_RAYS = 200  # rays of a sample on Mitsuba's traversal, where a whole view without cut-offs takes minutes
_ORACLE_PAIRS = 6_000_000  # (ray, Gaussian) pairs of the oracle's sample: 10 s
_EMPTY_ALPHA = 1e-6  # largest alpha of a view that shows nothing


def measure(
    gaussians: Gaussians,
    cameras: list[Camera],
    variants: tuple[Variant, ...],
    fields: dict | None = None,
    repeats: int = 5,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> Measured:
    """Times and errors of settings.

    Args:
        gaussians: Gaussians of the scene, at least one.
        cameras: Pinhole cameras, at least one.
        variants: Variants to be measured, a row each; the first one is the truth.
        fields: Settings that hold in every row that does not say otherwise.
        repeats: Rounds of timing at most; they end after 100 seconds if three are done.
        seed: Seed of the cotangents, of the samples of pixels and of the order within a round.
        advance: Called after each measurement.
    Returns:
        A row for each of `variants`. Where there is no number there is None, and the reason in `skipped` or `notes`.
    Raises:
        ValueError: If no view shows a Gaussian, or the truth cannot be computed.
    """
    gaussians = placed(gaussians)
    setup = _Setup(gaussians, cameras, seed)
    rows = rows_of(variants, fields or {})
    measurements = [_Measurement(row, setup) for row in rows if row.skipped is None and row.by == "view"]
    truth = measurements[0]
    others = measurements[1:]
    # The truth once more in every round: how much equal work scatters.
    again = _Measurement(dataclasses.replace(truth.row), setup)
    others.append(again)
    order = random.Random(seed)
    done = 0
    began = time.perf_counter(), time.process_time()
    # The first pass compiles. Every view has a turn, so that errors are of all of them.
    for number in range(max(repeats, len(cameras) - 1) + 1):
        timed = 1 <= number <= repeats
        spent = min(time.perf_counter() - began[0], time.process_time() - began[1])
        if number >= len(cameras) and done >= _MIN_ROUNDS and spent > _ROUNDS_SECONDS:
            break
        truth.measure(number, timed)
        if number == 0:
            setup.check(truth.settings)
        for measurement in order.sample(others, len(others)):
            measurement.measure(number, timed)
            advance()
        advance()
        done += timed
    for measurement in (*measurements, again):
        measurement.finish(truth)
    own = _sampled(rows, setup, truth, seed)
    for row in rows:
        row.errors = row.bound(own)
    pixels = statistics.mean(camera.width * camera.height for camera in cameras)
    return Measured(rows, own, again.row.times, pixels, done, _clock_name())


def placed(gaussians: Gaussians) -> Gaussians:
    """Gaussians on the device that they are rendered on, without a graph."""
    device = "cuda" if runtime.backend().name == "cuda" else "cpu"
    # Forward times are of images without derivatives; the leaves of the others are made of these (`_Setup`).
    return gaussians.replace(**{k: x.detach().to(device) for k, x in gaussians.parameters().items()})


@dataclasses.dataclass(frozen=True)
class _ViewResult:
    """Image, gradients and information of one view with one setting.

    Attributes:
        image: (H, W, 3) colors, on the CPU.
        gradients: J^T u by group.
        information: The Fisher diagonal by group; None where the setting has none.
    """

    image: torch.Tensor
    gradients: Tensors
    information: Tensors | None


class _Setup:
    """What all settings are measured on: Gaussians, views, cotangents, and the truth about each view once it is known.

    Attributes:
        shown: Whether a view has shown anything.
        sampled: The view of which rays are sampled.
    """

    def __init__(self, gaussians: Gaussians, cameras: list[Camera], seed: int):
        self.gaussians = gaussians
        self.cameras = cameras
        self.leaves = {name: x.clone().requires_grad_() for name, x in gaussians.parameters().items()}
        self.moving = gaussians.replace(**self.leaves)
        generator = torch.Generator().manual_seed(seed)
        sizes = [(camera.height, camera.width, 3) for camera in cameras]
        device = gaussians.means.device
        self.cotangents = [
            (torch.randint(0, 2, size, generator=generator) * 2 - 1).float().to(device) for size in sizes
        ]
        self.truth: dict[int, _ViewResult] = {}
        self.shown = False
        self.sampled = 0

    def image(self, g: Gaussians, camera: Camera, settings: RenderSettings, share: float) -> torch.Tensor:
        """(H, W, 3), whatever the share of its resolution that is rendered."""
        out = render(g, by_share(camera, share), settings, outputs=())
        self.shown = self.shown or bool(out.alpha.detach().amax() > _EMPTY_ALPHA)  # a yes or no has no derivative
        if share == 1:
            return out.rgb
        size = (camera.height, camera.width)
        image = out.rgb.permute(2, 0, 1)[None]  # torch interpolates images whose channels come first
        return torch.nn.functional.interpolate(image, size=size, mode="bilinear")[0].permute(1, 2, 0)

    def check(self, settings: RenderSettings) -> None:
        """Find a view that shows something.

        Raises:
            ValueError: If there is none.
        """
        for index, camera in enumerate(self.cameras):
            if not self.shown:
                self.image(self.gaussians, camera, settings, 1)
            if self.shown:
                self.sampled = index
                return
        count = len(self.cameras)
        raise ValueError(f"tradeoff: one of {count} cameras must show a Gaussian, all are empty; choose others")

    def gradient(self, image: torch.Tensor, cotangent: torch.Tensor) -> Tensors:
        """J^T u by group."""
        return gradient_by((image * cotangent).sum(), self.leaves)


class _Measurement:
    """One row's measurements, view by view and round by round."""

    def __init__(self, row: TradeoffRow, setup: _Setup):
        self.row = row
        self.setup = setup
        self.settings = row.settings
        self.seconds = {name: {} for name in CLOCKS}
        self.pixels = []
        self.gradients = {}
        self.diagonals = {}
        self.medians = {}
        self.first = 0.0

    def measure(self, number: int, timed: bool) -> None:
        """Render, differentiate and inform one view; errors if it is new."""
        if self.row.skipped is not None:
            return
        try:
            self._measure(number, timed)
        except (ValueError, NotImplementedError, OSError, RuntimeError) as error:
            if number % len(self.setup.cameras) not in self.setup.truth:
                raise  # this is the truth
            self.row.skipped = why_skipped(error)

    def _measure(self, number: int, timed: bool) -> None:
        """`measure`, unless the row is skipped.

        Raises:
            ValueError, NotImplementedError, OSError, RuntimeError: If the setting cannot be, or gives no numbers.
        """
        setup = self.setup
        view = number % len(self.setup.cameras)
        share = self.row.share
        camera = setup.cameras[view]
        took = {}
        with torch.no_grad():  # what an image alone takes
            _, took["forward"] = clocked(lambda: setup.image(setup.gaussians, camera, self.settings, share).cpu())

        def both():
            image = setup.image(setup.moving, camera, self.settings, share)
            # The image needs no graph here: `gradient` builds its own.
            return image.detach().cpu(), setup.gradient(image, setup.cotangents[view])

        (image, gradients), took["forward_backward"] = clocked(both)
        diagonal = None
        if "information" not in self.row.notes:
            try:
                diagonal, took["fisher"] = clocked(
                    lambda: scaled_diagonal(setup.gaussians, camera, self.settings, share)
                )
            except NotImplementedError as error:
                self.row.notes["information"] = why_skipped(error)
        if number == 0:
            self.first = sum(took.values())
        if timed:
            for name, seconds in took.items():
                self.seconds[name][number] = seconds
        if number < len(setup.cameras):
            if not all(bool(torch.isfinite(x).all()) for x in (image, *gradients.values(), *(diagonal or {}).values())):
                raise ValueError(f"{self.row.name}: must be finite, view {camera.name or view} has NaN or Inf")
            result = _ViewResult(image, gradients, diagonal)
            self._compare(setup.truth.setdefault(view, result), result)

    def _compare(self, truth: _ViewResult, result: _ViewResult) -> None:
        """Add one view's differences from the truth: sizes of pixels', sums by group, medians of entries."""
        # In float64 from here on: squares of differences of 1e-6 are summed over all pixels.
        self.pixels.append((result.image - truth.image).abs().double().reshape(-1).numpy())
        for name, x in result.gradients.items():
            a, b = self.gradients.get(name, (0.0, 0.0))
            y = truth.gradients[name]
            self.gradients[name] = a + _squares(x - y), b + _squares(y)
        for name, x in (result.information or {}).items() if truth.information else ():
            y = truth.information[name]
            a, b = self.diagonals.get(name, (0.0, 0.0))
            self.diagonals[name] = a + float((x - y).abs().sum()), b + float(y.sum())
            known = y > NEGLIGIBLE * y.max()
            if bool(known.any()):
                self.medians.setdefault(name, []).append(float(((x - y).abs()[known] / y[known]).median()))

    def finish(self, truth: _Measurement) -> None:
        """Fill the row."""
        if self.row.skipped is not None:
            return
        self.row.image = ImageError.of(np.concatenate(self.pixels))
        self.row.gradient = GradientError.of(self.gradients)
        if self.diagonals:
            medians = {name: statistics.mean(x) for name, x in self.medians.items()}
            self.row.information = InformationError.of(self.diagonals, medians)
        warm, times = {}, {}
        for name, x in self.seconds.items():
            both = x.keys() & truth.seconds[name].keys()
            warm[name] = statistics.median(x.values()) if x else None
            times[name] = interval([x[k] / truth.seconds[name][k] for k in both])
        self.row.seconds = warm
        self.row.times = times
        self.row.ratio = {name: x and x.ratio for name, x in times.items()}
        self.row.first_call = max(self.first - sum(x for x in warm.values() if x is not None), 0.0)


def _sampled(rows: list[TradeoffRow], setup: _Setup, truth: _Measurement, seed: int) -> WorstErrors:
    """Rows that are measured on a sample of one view's rays; errors of the truth against the oracle."""
    camera = setup.cameras[setup.sampled]
    count = len(setup.gaussians)
    pixels = camera.width * camera.height
    places = torch.randperm(pixels, generator=torch.Generator().manual_seed(seed))
    own = WorstErrors()
    for row in rows:
        if row.skipped is not None or row.by == "view":
            continue
        count_of_rays = _BVH_RAYS if row.by == "rays" else max(32, min(_BVH_RAYS, _ORACLE_PAIRS // count))
        chosen = places[:count_of_rays].sort().values
        try:
            errors = _by_rays(row, setup, truth, chosen)
        except (ValueError, NotImplementedError, OSError, RuntimeError) as error:
            row.skipped = why_skipped(error)
            continue
        if row.by == "oracle":
            own = errors
    return own


def _by_rays(row: TradeoffRow, setup: _Setup, truth: _Measurement, chosen: torch.Tensor) -> WorstErrors:
    """One row on some pixels of a view: errors against the truth's image, time scaled to all of them."""
    camera = setup.cameras[setup.sampled]
    oracle = row.by == "oracle"
    whole = setup.cotangents[setup.sampled]
    pixels = camera.width * camera.height
    forward, both = _tracer(setup, row.settings, chosen, oracle)
    fixed = [0.0, 0.0]
    start = 0.0
    if not oracle:
        # The acceleration structure does not grow with the number of rays. The first call compiles.
        few = _tracer(setup, row.settings, chosen[:1], oracle)
        start = sum(clocked(work)[1] for work in few)
        fixed = [clocked(work)[1] for work in few]
    out, first = clocked(forward)
    good = ~out.ambiguous if oracle else torch.ones(len(chosen), dtype=torch.bool)
    gradients, second = clocked(lambda: both(good))
    off = (out.rgb.cpu().double() - setup.truth[setup.sampled].image.reshape(-1, 3)[chosen].double()).abs()
    row.image = ImageError.of(off[good].numpy().reshape(-1))
    u = torch.zeros_like(whole)
    u.reshape(-1, 3)[chosen[good]] = whole.reshape(-1, 3)[chosen[good]]
    right = setup.gradient(setup.image(setup.moving, camera, truth.settings, 1), u)
    # Relative to whichever is the better of the two.
    row.gradient = GradientError.of(
        {name: (_squares(gradients[name] - x), _squares(gradients[name] if oracle else x)) for name, x in right.items()}
    )
    times = [a + max(b - a, 0.0) * pixels / len(chosen) for a, b in zip(fixed, (first, second), strict=True)]
    names = ("forward", "forward_backward")
    row.seconds = dict(zip(names, times, strict=True)) | {"fisher": None}
    exact = truth.row.seconds
    row.ratio = {k: x / exact[k] if x and exact[k] else None for k, x in row.seconds.items()}
    row.first_call = max(start - sum(fixed), 0.0)
    row.notes |= {
        "sample": f"{len(chosen)} of {pixels} rays of one view; times scaled to all of them",
        "information": "not measured on single rays",
    }
    if oracle:
        row.notes |= {"ties": int((~good).sum()), "max with ties": float(off.max())}
    own = row.gradient.worst
    # |x^2 - y^2| = |x - y| |x + y|, summed: at most 2 e + e^2 of sum y^2 where x - y is e of y in the L2 norm.
    return WorstErrors(row.image.max, own, own and 2 * own + own**2)


def _tracer(
    setup: _Setup, settings: RenderSettings, chosen: torch.Tensor, oracle: bool
) -> tuple[Callable[[], Output], Callable[..., Tensors]]:
    """Functions that trace these pixels' rays: the image, and the gradients of some of them."""
    camera = setup.cameras[setup.sampled]
    directions = torch.from_numpy(camera.pixel_directions().reshape(-1, 3))[chosen]
    origins = torch.from_numpy(camera.center.copy()).expand(directions.shape)

    def trace(g):
        if oracle:
            return reference.render(g, camera, settings, rays=(origins, directions))
        return render_rays(g, origins, directions, settings, outputs=())

    def forward():
        with torch.no_grad():  # what images alone take
            return trace(setup.gaussians)

    def both(good=None):
        image = trace(setup.moving).rgb
        u = setup.cotangents[setup.sampled].reshape(-1, 3)[chosen].to(image)
        return setup.gradient(image, u if good is None else u * good.to(u)[:, None])

    return forward, both


def _squares(x: torch.Tensor) -> float:
    return float(x.double().square().sum())


def scaled_diagonal(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, share: float = 1.0, method: Method = "exact"
) -> Tensors:
    """The Fisher diagonal by group, scaled to all pixels whatever the share of them that is computed.

    Args:
        gaussians: Gaussians of the scene.
        camera: View at full size.
        settings: Render settings.
        share: Share of the view's width and height that is computed.
        method: Method of `drgs.fisher.diagonal`.
    """
    small = by_share(camera, share)
    diagonal = fisher.diagonal(gaussians, small, settings, method)
    scale = camera.width * camera.height / (small.width * small.height)
    return {name: x * scale for name, x in diagonal.items()} if share != 1 else diagonal


def clocked(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """What it returns, and the seconds until it was computed."""
    import drjit as dr

    now = time.process_time if _clock_name() == "processor" else time.perf_counter
    began = now()
    result = work()
    dr.sync_thread()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return result, now() - began


def _clock_name() -> str:
    """The clock: of one thread the processor's time, which nothing else on the machine stretches; else the wall's."""
    backend = runtime.backend()
    return "processor" if backend.name == "llvm" and backend.threads == 1 else "wall"


# ------------------------------------------------------------------------------------- views as large as they are drawn

_FULL_SIZE_ROUNDS = 3  # rounds at full size: the fewest that show how times scatter
_FORWARD_SHARE = 0.6  # share of the seconds for images, the rest for gradients and information; chosen
_PIXEL_GROWTH = 4  # times as many pixels are tried next, on the way to full size; chosen


@dataclasses.dataclass(frozen=True)
class FullSize:
    """Times of full-size views on a clock, in the order of tradeoff.json.

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
        measured: What `measure` returned.
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
        share = seconds * (_FORWARD_SHARE if clock == "forward" and len(chosen) > 1 else 1 / (len(chosen) - k))
        # What a round takes, in units of exact's time: at full size the others take a smaller share of it, if any.
        units = 1 + sum(rows[name].times[clock].ratio for name in names)
        views, spent = _sized(work, cameras, exact, measured.pixels, share, units, say)
        if not views:
            seconds = max(seconds - spent, 0.0)
            report[clock] = FullSize(None, drawn, 0, [])
            continue
        took: dict[str, list[float]] = {name: [] for name in (exact.name, *names)}
        for number in range(max(repeats, _FULL_SIZE_ROUNDS)):
            a_round = sum(x[-1] for x in took.values()) if number else 0.0
            if number and spent + a_round > share:
                break
            camera = views[number % len(views)]
            for name in (exact.name, *order.sample(names, len(names))):
                say(_status(clock, camera, name))
                took[name].append(work(camera, rows[name]))
                spent += took[name][-1]
        seconds = max(seconds - spent, 0.0)
        for name, times in took.items():
            ratios = interval([a / b for a, b in zip(times, took[exact.name], strict=True)])
            if ratios.rounds < _FULL_SIZE_ROUNDS and name != exact.name:
                ratios = _widened(ratios, measured.scatter[clock])
            rows[name].full[clock] = FullTime(**dataclasses.asdict(ratios), seconds=statistics.median(times))
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
        works = {"forward": self._forward, "forward_backward": self._forward_backward, "fisher": self._fisher}
        self.work = works[clock]
        self.gaussians = gaussians
        self.seed = seed
        self.leaves = {name: x.clone().requires_grad_() for name, x in gaussians.parameters().items()}
        self.moving = gaussians.replace(**self.leaves)

    def __call__(self, camera: Camera, row: TradeoffRow) -> float:
        """Seconds that a row's settings take."""
        return clocked(lambda: self.work(camera, row.settings))[1]

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
        say(_status(work.clock, camera, "exact"))
        took = work(camera, exact)
        spent += took
        # Time grows with the pixels at most. What is tried on the way is spent, too.
        fits = pixels * (seconds - spent) / (units * took)
        following = min(whole, _PIXEL_GROWTH * pixels)
        if following * _PIXEL_GROWTH >= fits or following >= whole:
            break
        pixels = following
    return [at_most(camera, int(min(whole, fits))) for camera in cameras if fits >= least], spent


def _status(clock: str, camera: Camera, name: str) -> str:
    return f"{clock.replace('_', ' + ')} at {camera.width}x{camera.height}: {name}"
