"""Times and errors of render settings against preset `exact`: what `drgs tradeoff` measures, draws and recommends.

Settings are compared in pairs of times: a setting's over that of `exact` in the same round and view. The interval of
the median of these ratios says how well it is known; `exact` against itself, measured as every other setting, says how
much equal work scatters. A setting has a gain if its whole interval lies below 1 and below that of `exact` against
itself; recommended is the fastest one within a budget of error that has a gain.

Ratios change with the size of an image: what a setting does once a Gaussian weighs less in a large one. So the settings
that lead at the reduced size are timed again on views as large as `drgs render` draws them, within a number of seconds
that the user gives (`measure_full`). Where one round would take longer, views are reduced just so far that it does not,
and the report says so. Where there is no time for three rounds, intervals are as wide as the scatter of equal work at
the reduced size.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from drgs import fisher, reference, runtime
from drgs.cameras.sizes import at_most, by_share
from drgs.integrator import Output, render, render_rays
from drgs.io.outputs import replacing
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians
    from drgs.information.choices import Method

CLOCKS = ("forward", "forward_backward", "fisher")
"""What is timed: an image; an image and its gradients; the Fisher diagonal of a view."""

_NEGLIGIBLE = 1e-6  # share of the largest group, and of a diagonal's largest entry: smaller ones have no relative error


# ------------------------------------------------------------------------------------------------------ which settings


@dataclasses.dataclass(frozen=True)
class Variant:
    """One row: settings, and how much of the image they are used for.

    Attributes:
        kind: `approximation` (of exact's model), `model` (another response or view direction: a difference, not an
            error), `resolution`, or `precision`.
        preset: Preset that the settings start from.
        fields: Settings that differ from the preset.
        share: Share of width and height that is rendered; the image is enlarged bilinearly, information scaled by the
            number of pixels.
        by: What is measured: a whole `view`, a sample of its `rays`, or that sample by the float64 `oracle`.
    """

    kind: str
    preset: str = "exact"
    fields: dict = dataclasses.field(default_factory=dict)
    share: float = 1.0
    by: str = "view"

    @property
    def name(self) -> str:
        """A short name for people."""
        if self.by == "oracle":
            return "float64 oracle"
        text = " ".join(f"{key}={_short(value)}" for key, value in self.fields.items())
        text = text if self.preset == "exact" and text else f"{self.preset} {text}".strip()
        return text + {1.0: "", 0.5: ", half resolution", 0.25: ", quarter resolution"}[self.share]

    def flags(self, overrides: tuple[str, ...] = ()) -> str:
        """Options of the other commands for these settings, after the user's own."""
        kept = [text for text in overrides if text.partition("=")[0] not in self.fields]
        texts = [*(f"{key}={str(value).lower()}" for key, value in self.fields.items()), *kept]
        return " ".join([f"--preset {self.preset}", *(f"--set {text}" for text in texts)])


def _rows(kind: str, preset: str, key: str, *values) -> list[Variant]:
    return [Variant(kind, preset, {key: value}) for value in values]


_EWA = {"response": "ewa", "order": "center"}
TRADEOFF_VARIANTS = (
    Variant("precision"),
    Variant("precision", by="oracle"),
    # One switch away from exact.
    *_rows("model", "exact", "response", "integral"),
    Variant("model", fields=_EWA),
    Variant("model", fields=_EWA | {"dilation": 0.3}),
    *_rows("model", "exact", "sh_direction", "ray"),
    *_rows("approximation", "exact", "order", "center"),
    Variant("approximation", fields={"order": "center", "depth_key": "z"}),
    Variant("approximation", fields={"traversal": "bvh"}, by="rays"),
    Variant("approximation", fields={"traversal": "bvh", "order": "entry"}, by="rays"),
    *_rows("approximation", "exact", "tolerance", 1e-5, 1e-4, 1e-3, 1e-2, 1e-1),
    *_rows("approximation", "exact", "extent", 4.0, 3.33, 3.0, 2.5, 2.0),
    *_rows("approximation", "exact", "alpha_min", 1e-5, 1e-4, 1e-3, 1 / 255),
    *_rows("approximation", "exact", "alpha_max", 0.999, 0.99),
    Variant("approximation", fields={"alpha_max": 0.99, "alpha_max_gradient": "pass"}),
    *_rows("approximation", "exact", "transmittance_min", 1e-6, 1e-4, 1e-3, 1e-2),
    # Several at a time.
    Variant("approximation", fields={"alpha_min": 1e-3, "transmittance_min": 1e-4}),
    Variant("approximation", fields={"alpha_min": 1 / 255, "transmittance_min": 1e-4}),
    Variant("approximation", fields={"order": "center", "alpha_min": 1e-4, "transmittance_min": 1e-6}),
    Variant("approximation", "fast"),
    *_rows("approximation", "fast", "order", "ray"),
    *_rows("approximation", "fast", "depth_key", "z"),
    *_rows("approximation", "fast", "extent", None, 4.0, 3.33, 2.5, 2.0),
    *_rows("approximation", "fast", "alpha_min", 1 / 255),
    *_rows("approximation", "fast", "alpha_max", 1.0),
    *_rows("approximation", "fast", "transmittance_min", 1e-4, 1e-3),
    *_rows("model", "fast", "response", "integral"),
    Variant("model", "mitsuba"),
    Variant("model", "inria"),
    Variant("model", "gsplat"),
    Variant("approximation", "3dgut"),
    *(Variant("resolution", preset, share=share) for preset in ("exact", "fast") for share in (0.5, 0.25)),
)


def _short(value) -> str:
    if value == 1 / 255:
        return "1/255"
    if not isinstance(value, float):
        return str(value).lower()
    return f"{value:g}" if value >= 0.01 else f"{value:.0e}".replace("e-0", "e-")


def why_skipped(error: Exception) -> str:
    """Why something was skipped."""
    return " ".join(str(error).split()).removeprefix("RenderSettings: ") or type(error).__name__


# ------------------------------------------------------------------------------ what is measured


@dataclasses.dataclass(frozen=True)
class ImageError:
    """Absolute differences of all values of all views: RMS, 99.9th percentile, largest; PSNR for peak 1, None of 0."""

    rms: float
    p999: float
    max: float
    psnr: float | None

    @classmethod
    def of(cls, off: np.ndarray) -> ImageError:
        """Compute the errors from absolute differences (P,).

        Raises:
            ValueError: If there is none.
        """
        if not off.size:
            raise ValueError("every sampled pixel is a tie; choose another --seed")
        rms = float(np.sqrt(np.mean(off**2)))
        psnr = -20 * math.log10(rms) if rms > 0 else None
        return cls(rms, float(np.quantile(off, 0.999)), float(off.max()), psnr)


@dataclasses.dataclass(frozen=True)
class GradientError:
    """Relative L2 errors of a gradient.

    Attributes:
        all: Error over all groups together; None where there is no gradient.
        worst: Largest error of a group; None where no group has one.
        group: Name of that group.
        groups: Group -> its error; None where it has no gradient to speak of.
    """

    all: float | None
    worst: float | None
    group: str | None
    groups: dict[str, float | None]

    @classmethod
    def of(cls, squares: dict[str, tuple[float, float]]) -> GradientError:
        """Compute the errors from sums of squares of the difference and of the truth, by group."""
        names = _compared({name: b for name, (_, b) in squares.items()})
        groups = {name: math.sqrt(a / b) if name in names else None for name, (a, b) in squares.items()}
        worst = max(names, key=groups.get, default=None)
        total = sum(b for _, b in squares.values())
        whole = math.sqrt(sum(a for a, _ in squares.values()) / total) if total else None
        return cls(whole, groups[worst] if worst else None, worst, groups)


@dataclasses.dataclass(frozen=True)
class GroupInformation:
    """Relative errors of a group's diagonal: L1, and the median of its entries'; None where it is all but 0."""

    l1: float | None
    median: float | None


@dataclasses.dataclass(frozen=True)
class InformationError:
    """Relative errors of the Fisher diagonal.

    Attributes:
        groups: Group -> its errors.
        group: Group with the largest error; None where no group has one.
        l1, median: The errors of that group.
    """

    groups: dict[str, GroupInformation]
    group: str | None
    l1: float | None
    median: float | None

    @classmethod
    def of(cls, sums: dict[str, tuple[float, float]], medians: dict[str, float]) -> InformationError:
        """Compute the errors from sums of absolute differences and of the truth and from medians of relative ones."""
        names = _compared({name: b for name, (_, b) in sums.items()})
        nothing = GroupInformation(None, None)
        groups = {n: GroupInformation(a / b, medians[n]) if n in names else nothing for n, (a, b) in sums.items()}
        worst = max(names, key=lambda name: max(groups[name].l1, groups[name].median), default=None)
        chosen = groups[worst] if worst else nothing
        return cls(groups, worst, chosen.l1, chosen.median)


def _compared(sizes: dict[str, float]) -> list[str]:
    """Groups that have a relative error: rotating spheres changes nothing, and rounding would look like an error."""
    # Means have a unit, the others do not.
    least = _NEGLIGIBLE**2 * max((x for name, x in sizes.items() if name != "means"), default=0.0)
    return [name for name, x in sizes.items() if x > (0.0 if name == "means" else least)]


@dataclasses.dataclass(frozen=True)
class WorstErrors:
    """The errors that a budget is compared with, by kind; None where there is no number."""

    image: float | None = None
    gradient: float | None = None
    information: float | None = None

    def worst(self, kinds: Sequence[str]) -> float | None:
        """The largest of some kinds, None if one of them is missing."""
        values = [getattr(self, kind) for kind in kinds]
        return None if None in values else max(values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interval:
    """A median of ratios of times, the two order statistics between which it lies with 95 %, and how many there are."""

    ratio: float
    low: float
    high: float
    rounds: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class FullTime(Interval):
    """Times of a row on views as large as they are drawn: ratios to exact's, and the median in seconds."""

    seconds: float


@dataclasses.dataclass(kw_only=True)
class TradeoffRow:
    """A variant of the settings with its times and errors, in the order of tradeoff.json.

    Attributes:
        name, kind, share, by: The variant's fields of these names.
        skipped: Why nothing was measured, else None.
        settings: The variant's settings with the user's; None where these cannot be.
        image, gradient, information: Differences from the truth; None where there are none.
        notes: What a reader should know, by subject.
        seconds: Clock -> median time in seconds; None where a clock was not read.
        ratio: Clock -> median ratio of the times to the truth's.
        times: Clock -> these ratios with their interval; None of what was measured once, on a sample.
        first_call: Seconds that the first view took longer than others.
        full: Clock -> ratios on views as large as they are drawn (`measure_full`), where they were timed.
        errors: What budgets are compared with: the worst measure of each kind, plus the truth's own error.
        flags: Options of other commands for these settings; None of the oracle.
    """

    name: str
    kind: str
    share: float = 1.0
    by: str = "view"
    skipped: str | None = None
    settings: RenderSettings | None = None
    image: ImageError | None = None
    gradient: GradientError | None = None
    information: InformationError | None = None
    notes: dict[str, Any] = dataclasses.field(default_factory=dict)
    seconds: dict[str, float | None] | None = None
    ratio: dict[str, float | None] | None = None
    times: dict[str, Interval | None] | None = None
    first_call: float | None = None
    full: dict[str, FullTime] = dataclasses.field(default_factory=dict)
    errors: WorstErrors = WorstErrors()
    flags: str | None = None

    def bound(self, own: WorstErrors) -> WorstErrors:
        """`errors`, where the truth's own are known."""
        if self.skipped is not None or self.by == "oracle":
            return WorstErrors()
        errors = {}
        if self.image:
            errors["image"] = max(self.image.rms, self.image.p999)
        if self.gradient and self.gradient.worst is not None:
            errors["gradient"] = self.gradient.worst
        if self.information and self.information.group:
            errors["information"] = max(self.information.l1, self.information.median)
        return WorstErrors(**{kind: x + (getattr(own, kind) or 0.0) for kind, x in errors.items()})

    def to_json(self) -> dict[str, Any]:
        """As tradeoff.json holds it."""
        value = dataclasses.asdict(self)
        if self.information and self.information.group is None:
            del value["information"]["l1"], value["information"]["median"]
        return value


@dataclasses.dataclass(frozen=True)
class Measured:
    """Times and errors of settings.

    Attributes:
        rows: Rows in the order of the variants; the first one is the truth.
        own: Errors of the truth against the oracle.
        scatter: Clock -> the truth's times against itself.
        pixels: Number of pixels of one view, on average.
        rounds: Number of rounds of timing.
        clock: Clock that was read, `wall` or `processor`.
    """

    rows: list[TradeoffRow]
    own: WorstErrors
    scatter: dict[str, Interval | None]
    pixels: float
    rounds: int
    clock: str

    @property
    def truth(self) -> TradeoffRow:
        """The setting that the others are compared with."""
        return self.rows[0]

    def to_json(self) -> dict[str, Any]:
        """As tradeoff.json holds it."""
        return dataclasses.asdict(self) | {"rows": [row.to_json() for row in self.rows]}


def rows_of(variants: Sequence[Variant], fields: dict[str, Any]) -> list[TradeoffRow]:
    """Rows without numbers; those that cannot or need not be measured say why."""
    rows = []
    first_names = {}
    for variant in variants:
        row = TradeoffRow(name=variant.name, kind=variant.kind, share=variant.share, by=variant.by)
        try:
            row.settings = RenderSettings.preset(variant.preset, **{**fields, **variant.fields})
        except (ValueError, NotImplementedError) as error:
            if not rows:
                raise  # the truth itself
            row.skipped = why_skipped(error)
        else:
            same = first_names.setdefault((row.settings, variant.share, variant.by == "oracle"), variant.name)
            if same != variant.name:
                row.skipped = f"the same as {same}, with these --set"
        rows.append(row)
    return rows


# -------------------------------------------------------------------------------------------------- what is recommended

USES = {
    "image": ("forward", ("image",)),
    "gradients": ("forward_backward", ("gradient",)),
    "information": ("fisher", ("information",)),
    "everything": ("forward_backward", ("image", "gradient", "information")),
}
"""Use -> the time that counts, and the errors that must be within the budget."""

_SIGNIFICANCE = 0.05  # two-sided level of the interval of a time ratio (sign test): 95 %, the usual one


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """The recommended setting for a use and a budget.

    Attributes:
        use: One of `USES`.
        budget: Largest error that is allowed.
        clock: Name of the time that counts.
        name: Name of the row that is chosen; None where no setting is within the budget, and then all that follows
            `reason` is None.
        gain: Whether it is faster than `exact`.
        reason: Why there is no setting, or no gain.
        kind, flags: The row's fields of these names.
        error: The row's largest error that counts.
        full: Whether its time is of views as large as they are drawn.
        ratio, low, high, rounds: Its times over exact's, as an `Interval`.
    """

    use: str
    budget: float
    clock: str
    name: str | None = None
    gain: bool = False
    reason: str | None = None
    kind: str | None = None
    flags: str | None = None
    error: float | None = None
    full: bool | None = None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    rounds: int | None = None

    def to_json(self) -> dict[str, Any]:
        """The advice as tradeoff.json holds it: what there is no setting for has no numbers."""
        value = dataclasses.asdict(self)
        return value if self.name else {k: value[k] for k in ("use", "budget", "clock", "name", "gain", "reason")}


def interval(ratios: Sequence[float]) -> Interval | None:
    """The median and the two order statistics between which it lies with 95 %; fewer than six: all of them.

    Returns:
        None of an empty list.
    """
    if not ratios:
        return None
    x = sorted(ratios)
    n = len(ratios)
    k = 0
    tail = 0.5 ** len(ratios)
    while 2 * (tail + math.comb(n, k + 1) * 0.5**n) <= _SIGNIFICANCE:
        k += 1
        tail += math.comb(n, k) * 0.5**n
    return Interval(ratio=statistics.median(x), low=x[k], high=x[-1 - k], rounds=n)


def leaders(measured: Measured, clock: str, budgets: Sequence[float]) -> list[str]:
    """Names of the rows that are worth timing at full size: the fastest within each budget, and preset `fast`."""
    names = []
    for use, (timed, _) in USES.items():
        for budget in budgets if timed == clock else ():
            rows = [row for row, _ in _within(measured, use, budget) if row.times[clock].ratio < 1]
            names += [min(rows, key=lambda row: row.times[clock].ratio).name] if rows else []
    fast = [row.name for row in measured.rows if row.name == "fast" and row.skipped is None and row.times[clock]]
    return list(dict.fromkeys([*fast, *names]))


def recommend(measured: Measured, use: str, budgets: Sequence[float]) -> list[Advice]:
    """Choose for each budget the fastest setting with a gain, the most exact one of those as fast, or say why not.

    Args:
        measured: What `measure` returned, and what `measure_full` added to its rows under
            `full`: where a clock was read at full size, only that counts. Rows of a reduced resolution and rows that
            were measured on a sample of the rays are no candidates.
        use: One of `USES`.
        budgets: Largest errors that are allowed, each > 0.
    """
    clock = USES[use][0]
    scatter = measured.scatter[clock]
    sure = min(1.0, scatter.low) if scatter else 1.0
    picks = []
    for budget in budgets:
        within = _within(measured, use, budget)
        full = any(row.full.get(clock) for row, _ in within)
        timed = [(row, error, row.full.get(clock) if full else row.times[clock]) for row, error in within]
        faster = [(row, error, times) for row, error, times in timed if times and times.high < sure]
        exact = next((entry for entry in timed if entry[0] is measured.truth), None)
        reason = None
        if faster:
            least = min(faster, key=lambda entry: entry[2].ratio)
            alike = [entry for entry in faster if entry[2].low <= least[2].high]
            row, error, times = min(alike, key=lambda entry: entry[1])
        elif exact:
            row, error, times = exact
            times = times or row.times[clock]
            reason = "no measurable gain over exact"
        else:
            picks.append(Advice(use=use, budget=budget, clock=clock, reason=_why_none(measured, use)))
            continue
        numbers = {name: getattr(times, name) for name in ("ratio", "low", "high", "rounds")}
        fields = {"name": row.name, "kind": row.kind, "flags": row.flags, "gain": bool(faster), "full": full}
        picks.append(Advice(use=use, budget=budget, clock=clock, reason=reason, error=error, **fields, **numbers))
    return picks


def _why_none(measured: Measured, use: str) -> str:
    """Why a budget has no setting."""
    every = _within(measured, use, math.inf)
    if not every:
        return f"there is no setting whose {' and '.join(USES[use][1])} error could be measured"
    row, error = min(every, key=lambda entry: entry[1])
    return f"no setting is within it, the least error is {error:.1e} ({row.name})"


def _within(measured: Measured, use: str, budget: float) -> list[tuple[TradeoffRow, float]]:
    """Candidates whose errors are within the budget, with the largest of them."""
    clock, kinds = USES[use]
    rows = [row for row in measured.rows if row.skipped is None and row.share == 1 and row.by == "view"]
    errors = [(row, row.errors.worst(kinds)) for row in rows if row.times[clock] is not None]
    return [(row, error) for row, error in errors if error is not None and error <= budget]


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
        derivatives = torch.autograd.grad((image * cotangent).sum(), list(self.leaves.values()), allow_unused=True)
        pairs = zip(self.leaves.items(), derivatives, strict=True)
        return {name: torch.zeros_like(x) if y is None else y for (name, x), y in pairs}


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
            known = y > _NEGLIGIBLE * y.max()
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


# ------------------------------------------------------------------------------------------------------------- the plot

Point = tuple[float, float, TradeoffRow]
"""Ratio of times, error, and whose they are."""

_PANELS = (
    ("image", "forward", "image error (larger of RMS and 99.9 %)"),
    ("gradient", "forward_backward", "gradient error (worst group)"),
    ("information", "fisher", "information error (worst group)"),
)
_COLORS = {"approximation": "#1f77b4", "model": "#d62728", "resolution": "#2ca02c", "precision": "#7f7f7f"}


def plot(measured: Measured, budgets: Sequence[float], title: str, path: Path) -> bool:
    """Write error against time for each use, one panel below the other.

    Args:
        measured: Times and errors of all rows; those of samples are left out.
        budgets: Errors that are drawn as lines.
        title: Text above the plot.
        path: File to write, a .png.
    Returns:
        False where there is no matplotlib.
    """
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(3, 1, figsize=(10, 15), dpi=90)
    for axis, (kind, clock, label) in zip(panels, _PANELS, strict=True):
        rows = [row for row in measured.rows if row.skipped is None and row.by == "view"]
        points = [(row.ratio[clock], getattr(row.errors, kind), row) for row in rows]
        points = [(x, y, row) for x, y, row in points if x and y]
        for name, color in _COLORS.items():
            part = [(x, y) for x, y, row in points if row.kind == name]
            axis.plot(*zip(*part, strict=True), "o", ms=5, color=color, label=name) if part else None
        points.sort(key=lambda p: p[:2])
        front = [p for i, p in enumerate(points) if all(p[1] < q[1] for q in points[:i])]
        axis.plot([p[0] for p in front], [p[1] for p in front], "-", lw=1, color="black", label="front", zorder=0)
        curve = sorted(p[:2] for p in points if p[2] is measured.truth or p[2].name.startswith("tolerance="))
        axis.plot(*zip(*curve, strict=True), "--", lw=1, color="black", label="tolerance") if curve else None
        axis.set(xscale="log", yscale="log", ylabel=label, xlabel=f"time, {clock.replace('_', ' + ')} / exact")
        axis.margins(x=0.25, y=0.12)
        for budget in budgets:
            axis.axhline(budget, lw=0.6, ls=":", color="gray", zorder=0)
        axis.legend(fontsize=7, loc="upper right")
        # The front first: what finds no free place is left without a label.
        rest = [p for p in points if p not in front]
        _labels(figure, axis, [*front, *rest], points)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout(rect=(0, 0, 1, 0.985))
    with replacing(path, path.suffix) as name:
        figure.savefig(name)
    plt.close(figure)
    return True


def _labels(figure: Figure, axis: Axes, points: list[Point], dots: list[Point]) -> None:
    """Names beside points, without overlaps; a point whose surroundings are full goes without."""
    from matplotlib.transforms import Bbox

    figure.tight_layout(rect=(0, 0, 1, 0.985))  # places do not move any more
    renderer = figure.canvas.get_renderer()
    inside = axis.get_window_extent()
    places = [axis.transData.transform(p[:2]) for p in dots]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in places]
    taken.append(axis.get_legend().get_window_extent(renderer))
    for x, y, row in points:
        for reach, angle in itertools.product((6, 16, 30, 46), (0, 180, 90, 270, 45, 315, 135, 225)):
            dx = reach * math.cos(math.radians(angle))
            dy = reach * math.sin(math.radians(angle))
            text = axis.annotate(
                row.name,
                (x, y),
                xytext=(dx, dy),
                textcoords="offset points",
                fontsize=7.5,
                color=_COLORS[row.kind],
                ha="left" if dx > 1 else "right" if dx < -1 else "center",
                va="bottom" if dy > 1 else "top" if dy < -1 else "center",
                arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "gray"} if reach > 6 else None,
            )
            box = text.get_window_extent(renderer)
            corners = (box.x0, box.y0), (box.x1, box.y1)
            if all(inside.contains(*corner) for corner in corners) and not box.count_overlaps(taken):
                taken.append(box)
                break
            text.remove()
