"""Rows of `drgs tradeoff`: the settings that are compared with preset `exact`."""

from __future__ import annotations

import dataclasses

from drgs.settings import RenderSettings

__all__ = ["VARIANTS", "Variant", "one_line", "rows_of"]


@dataclasses.dataclass(frozen=True)
class Variant:
    """One row: settings, and how much of the image they are used for.

    Attributes:
        kind: `approximation` (of exact's model), `model` (another response or view direction: a difference, not an
            error), `resolution`, or `precision`.
        preset, fields: Of the settings.
        share: Of width and height; the image is enlarged bilinearly, information scaled by the number of pixels.
        by: `view`; `rays`, a sample of the rays; `oracle`, the same in float64.
    """

    kind: str
    preset: str = "exact"
    fields: dict = dataclasses.field(default_factory=dict)
    share: float = 1.0
    by: str = "view"

    @property
    def name(self) -> str:
        """For people, short."""
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
VARIANTS = (
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
    *(Variant("resolution", preset, share=share) for preset in ("exact", "fast") for share in (0.5, 0.25)),
)


def rows_of(variants, fields: dict) -> list[dict]:
    """Rows without numbers; those that cannot or need not be measured say why."""
    rows, seen = [], {}
    for variant in variants:
        row = {"name": variant.name, "kind": variant.kind, "share": variant.share, "by": variant.by, "skipped": None}
        row |= {"settings": None, "image": None, "gradient": None, "information": None, "notes": {}}
        row |= {"seconds": None, "ratio": None, "times": None, "first_call": None, "full": {}}
        try:
            settings = RenderSettings.preset(variant.preset, **{**fields, **variant.fields})
        except (ValueError, NotImplementedError) as error:
            if not rows:
                raise  # the truth itself
            row["skipped"] = one_line(error)
        else:
            row["settings"] = dataclasses.asdict(settings)
            same = seen.setdefault((settings, variant.share, variant.by == "oracle"), variant.name)
            if same != variant.name:
                row["skipped"] = f"the same as {same}, with these --set"
        rows.append(row)
    return rows


def _short(value) -> str:
    if value == 1 / 255:
        return "1/255"
    if not isinstance(value, float):
        return str(value).lower()
    return f"{value:g}" if value >= 0.01 else f"{value:.0e}".replace("e-0", "e-")


def one_line(error: Exception) -> str:
    """Why something was skipped."""
    return " ".join(str(error).split()).removeprefix("RenderSettings: ") or type(error).__name__
