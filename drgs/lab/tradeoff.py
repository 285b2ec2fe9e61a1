"""Times and errors of render settings against preset `exact` (what they are: commands/tradeoff.py)."""

from __future__ import annotations

import dataclasses
import random
import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch

from drgs import fisher, reference, runtime
from drgs.integrator import render, render_rays
from drgs.lab.tradeoff_advice import interval
from drgs.lab.tradeoff_rows import (
    CLOCKS,
    GradientError,
    ImageError,
    InformationError,
    Measured,
    TradeoffRow,
    Variant,
    WorstErrors,
    rows_of,
    why_skipped,
)
from drgs.sizes import by_share

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.information.choices import Method
    from drgs.integrator import Output
    from drgs.settings import RenderSettings

__all__ = ["clocked", "measure", "placed", "scaled_diagonal"]

Tensors = dict[str, torch.Tensor]
_Result = TypeVar("_Result")

_SECONDS = 100.0  # rounds end after so many of the clock or, where others use the machine, of the processor
_AT_LEAST = 3  # rounds, before which they do not end
_RAYS = 200  # rays of a sample on Mitsuba's traversal
_PAIRS = 6_000_000  # (ray, Gaussian) pairs of the oracle's sample: 10 s
_NOTHING = 1e-6  # alpha of a view that shows nothing
_UNSEEN = 1e-6  # share of the largest: smaller entries of the diagonal are left out of relative errors


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
        advance: Called after each turn.
    Returns:
        A row for each of `variants`. Where there is no number there is None, and the reason in `skipped` or `notes`.
    Raises:
        ValueError: If no view shows a Gaussian, or the truth cannot be computed.
    """
    gaussians = placed(gaussians)
    stage = _Stage(gaussians, cameras, seed)
    rows = rows_of(variants, fields or {})
    turns = [_Turn(row, stage) for row in rows if row.skipped is None and row.by == "view"]
    truth = turns[0]
    others = turns[1:]
    # The truth once more in every round: how much equal work scatters.
    again = _Turn(dataclasses.replace(truth.row), stage)
    others.append(again)
    order = random.Random(seed)
    done = 0
    began = time.perf_counter(), time.process_time()
    # The first pass compiles. Every view has a turn, so that errors are of all of them.
    for number in range(max(repeats, len(cameras) - 1) + 1):
        timed = 1 <= number <= repeats
        spent = min(time.perf_counter() - began[0], time.process_time() - began[1])
        if number >= len(cameras) and done >= _AT_LEAST and spent > _SECONDS:
            break
        truth.take(number, timed)
        if number == 0:
            stage.check(truth.settings)
        for turn in order.sample(others, len(others)):
            turn.take(number, timed)
            advance()
        advance()
        done += timed
    for turn in (*turns, again):
        turn.finish(truth)
    own = _sampled(rows, stage, truth, seed)
    for row in rows:
        row.errors = row.bound(own)
    pixels = statistics.mean(camera.width * camera.height for camera in cameras)
    return Measured(rows, own, again.row.times, pixels, done, _clock_name())


def placed(gaussians: Gaussians) -> Gaussians:
    """Gaussians on the device that they are rendered on, without a graph."""
    device = "cuda" if runtime.backend().name == "cuda" else "cpu"
    # Forward times are of images without derivatives; the leaves of the others are made of these (`_Stage`).
    return gaussians.replace(**{k: x.detach().to(device) for k, x in gaussians.parameters().items()})


@dataclasses.dataclass(frozen=True)
class _Answer:
    """What a setting makes of a view.

    Attributes:
        image: (H, W, 3) colors, on the CPU.
        slopes: J^T u by group.
        information: The Fisher diagonal by group; None where the setting has none.
    """

    image: torch.Tensor
    slopes: Tensors
    information: Tensors | None


class _Stage:
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
        self.truth: dict[int, _Answer] = {}
        self.shown = False
        self.sampled = 0

    def image(self, g: Gaussians, camera: Camera, settings: RenderSettings, share: float) -> torch.Tensor:
        """(H, W, 3), whatever the share of its resolution that is rendered."""
        out = render(g, by_share(camera, share), settings, outputs=())
        self.shown = self.shown or bool(out.alpha.detach().amax() > _NOTHING)  # a yes or no has no derivative
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

    def pull(self, image: torch.Tensor, cotangent: torch.Tensor) -> Tensors:
        """J^T u by group."""
        found = torch.autograd.grad((image * cotangent).sum(), list(self.leaves.values()), allow_unused=True)
        pairs = zip(self.leaves.items(), found, strict=True)
        return {name: torch.zeros_like(x) if y is None else y for (name, x), y in pairs}

    def information(self, camera: Camera, settings: RenderSettings, share: float) -> Tensors:
        """The Fisher diagonal by group."""
        return scaled_diagonal(self.gaussians, camera, settings, share)


class _Turn:
    """One row's measurements, view by view and round by round."""

    def __init__(self, row: TradeoffRow, stage: _Stage):
        self.row = row
        self.stage = stage
        self.settings = row.settings
        self.seconds = {name: {} for name in CLOCKS}
        self.pixels = []
        self.slopes = {}
        self.parts = {}
        self.medians = {}
        self.first = 0.0

    def take(self, number: int, timed: bool) -> None:
        """Render, differentiate and inform one view; errors if it is new."""
        if self.row.skipped is not None:
            return
        try:
            self._take(number, timed)
        except (ValueError, NotImplementedError, OSError, RuntimeError) as error:
            if number % len(self.stage.cameras) not in self.stage.truth:
                raise  # this is the truth
            self.row.skipped = why_skipped(error)

    def _take(self, number: int, timed: bool) -> None:
        """`take`, unless the row is skipped.

        Raises:
            ValueError, NotImplementedError, OSError, RuntimeError: If the setting cannot be, or gives no numbers.
        """
        stage = self.stage
        view = number % len(self.stage.cameras)
        share = self.row.share
        camera = stage.cameras[view]
        took = {}
        with torch.no_grad():  # what an image alone takes
            _, took["forward"] = clocked(lambda: stage.image(stage.gaussians, camera, self.settings, share).cpu())

        def both():
            image = stage.image(stage.moving, camera, self.settings, share)
            # The image is looked at only: its graph is that of `pull`.
            return image.detach().cpu(), stage.pull(image, stage.cotangents[view])

        (image, slopes), took["forward_backward"] = clocked(both)
        parts = None
        if "information" not in self.row.notes:
            try:
                parts, took["fisher"] = clocked(lambda: stage.information(camera, self.settings, share))
            except NotImplementedError as error:
                self.row.notes["information"] = why_skipped(error)
        if number == 0:
            self.first = sum(took.values())
        if timed:
            for name, seconds in took.items():
                self.seconds[name][number] = seconds
        if number < len(stage.cameras):
            if not all(bool(torch.isfinite(x).all()) for x in (image, *slopes.values(), *(parts or {}).values())):
                raise ValueError(f"{self.row.name}: must be finite, view {camera.name or view} has NaN or Inf")
            seen = _Answer(image, slopes, parts)
            self._compare(stage.truth.setdefault(view, seen), seen)

    def _compare(self, truth: _Answer, seen: _Answer) -> None:
        """Add one view's differences from the truth: sizes of pixels', sums by group, medians of entries."""
        # In float64 from here on: squares of differences of 1e-6 are summed over all pixels.
        self.pixels.append((seen.image - truth.image).abs().double().reshape(-1).numpy())
        for name, x in seen.slopes.items():
            a, b = self.slopes.get(name, (0.0, 0.0))
            y = truth.slopes[name]
            self.slopes[name] = a + _squares(x - y), b + _squares(y)
        for name, x in (seen.information or {}).items() if truth.information else ():
            y = truth.information[name]
            a, b = self.parts.get(name, (0.0, 0.0))
            self.parts[name] = a + float((x - y).abs().sum()), b + float(y.sum())
            known = y > _UNSEEN * y.max()
            if bool(known.any()):
                self.medians.setdefault(name, []).append(float(((x - y).abs()[known] / y[known]).median()))

    def finish(self, truth: _Turn) -> None:
        """Fill the row."""
        if self.row.skipped is not None:
            return
        self.row.image = ImageError.of(np.concatenate(self.pixels))
        self.row.gradient = GradientError.of(self.slopes)
        if self.parts:
            medians = {name: statistics.mean(x) for name, x in self.medians.items()}
            self.row.information = InformationError.of(self.parts, medians)
        warm, times = {}, {}
        for name, x in self.seconds.items():
            both = x.keys() & truth.seconds[name].keys()
            warm[name] = statistics.median(x.values()) if x else None
            times[name] = interval([x[k] / truth.seconds[name][k] for k in both])
        self.row.seconds = warm
        self.row.times = times
        self.row.ratio = {name: x and x.ratio for name, x in times.items()}
        self.row.first_call = max(self.first - sum(x for x in warm.values() if x is not None), 0.0)


def _sampled(rows: list[TradeoffRow], stage: _Stage, truth: _Turn, seed: int) -> WorstErrors:
    """Rows that are measured on a sample of one view's rays; errors of the truth against the oracle."""
    camera = stage.cameras[stage.sampled]
    count = len(stage.gaussians)
    pixels = camera.width * camera.height
    places = torch.randperm(pixels, generator=torch.Generator().manual_seed(seed))
    own = WorstErrors()
    for row in rows:
        if row.skipped is not None or row.by == "view":
            continue
        wanted = _RAYS if row.by == "rays" else max(32, min(_RAYS, _PAIRS // count))
        chosen = places[:wanted].sort().values
        try:
            found = _by_rays(row, stage, truth, chosen)
        except (ValueError, NotImplementedError, OSError, RuntimeError) as error:
            row.skipped = why_skipped(error)
            continue
        if row.by == "oracle":
            own = found
    return own


def _by_rays(row: TradeoffRow, stage: _Stage, truth: _Turn, chosen: torch.Tensor) -> WorstErrors:
    """One row on some pixels of a view: errors against the truth's image, time scaled to all of them."""
    camera = stage.cameras[stage.sampled]
    oracle = row.by == "oracle"
    whole = stage.cotangents[stage.sampled]
    pixels = camera.width * camera.height
    forward, both = _tracer(stage, row.settings, chosen, oracle)
    fixed = [0.0, 0.0]
    start = 0.0
    if not oracle:
        # The acceleration structure does not grow with the number of rays. The first call compiles.
        few = _tracer(stage, row.settings, chosen[:1], oracle)
        start = sum(clocked(work)[1] for work in few)
        fixed = [clocked(work)[1] for work in few]
    out, first = clocked(forward)
    good = ~out.ambiguous if oracle else torch.ones(len(chosen), dtype=torch.bool)
    slopes, second = clocked(lambda: both(good))
    off = (out.rgb.cpu().double() - stage.truth[stage.sampled].image.reshape(-1, 3)[chosen].double()).abs()
    row.image = ImageError.of(off[good].numpy().reshape(-1))
    u = torch.zeros_like(whole)
    u.reshape(-1, 3)[chosen[good]] = whole.reshape(-1, 3)[chosen[good]]
    right = stage.pull(stage.image(stage.moving, camera, truth.settings, 1), u)
    # Relative to whichever is the better of the two.
    row.gradient = GradientError.of(
        {name: (_squares(slopes[name] - x), _squares(slopes[name] if oracle else x)) for name, x in right.items()}
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
    stage: _Stage, settings: RenderSettings, chosen: torch.Tensor, oracle: bool
) -> tuple[Callable[[], Output], Callable[..., Tensors]]:
    """Functions that trace these pixels' rays: the image, and the gradients of some of them."""
    camera = stage.cameras[stage.sampled]
    directions = torch.from_numpy(camera.pixel_directions().reshape(-1, 3))[chosen]
    origins = torch.from_numpy(camera.center.copy()).expand(directions.shape)

    def trace(g):
        if oracle:
            return reference.render(g, camera, settings, rays=(origins, directions))
        return render_rays(g, origins, directions, settings, outputs=())

    def forward():
        with torch.no_grad():  # what images alone take
            return trace(stage.gaussians)

    def both(good=None):
        image = trace(stage.moving).rgb
        u = stage.cotangents[stage.sampled].reshape(-1, 3)[chosen].to(image)
        return stage.pull(image, u if good is None else u * good.to(u)[:, None])

    return forward, both


def _squares(x: torch.Tensor) -> float:
    return float(x.double().square().sum())


def scaled_diagonal(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, share: float = 1.0, method: Method = "exact"
) -> Tensors:
    """The Fisher diagonal by group, scaled to all pixels whatever the share of them that is looked at.

    Args:
        gaussians: Gaussians of the scene.
        camera: View at full size.
        settings: Render settings.
        share: Share of the view's width and height that is looked at.
        method: Method of `drgs.fisher.diagonal`.
    """
    small = by_share(camera, share)
    found = fisher.diagonal(gaussians, small, settings, method)
    scale = camera.width * camera.height / (small.width * small.height)
    return {name: x * scale for name, x in found.items()} if share != 1 else found


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
