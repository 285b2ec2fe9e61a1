"""The rows of `drgs tradeoff`: settings, and the records of their errors and times."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np

from drgs.settings import RenderSettings

CLOCKS = ("forward", "forward_backward", "fisher")
"""What is timed: an image; an image and its gradients; the Fisher diagonal of a view."""

NEGLIGIBLE = 1e-6  # share of the largest group, and of a diagonal's largest entry: smaller ones have no relative error
_SIGNIFICANCE = 0.05  # two-sided level of the interval of a time ratio (sign test): 95 %, the usual one


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
    least = NEGLIGIBLE**2 * max((x for name, x in sizes.items() if name != "means"), default=0.0)
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
