"""Every choice the renderer makes, as one frozen record, and the presets that other systems correspond to.

A field here is an accuracy/speed (or a compatibility) choice that a user can name, switch and measure. Nothing that
changes an image lives anywhere else. Symbols: `a` opacity of one hit, `alpha_i` opacity of Gaussian i,
`T` transmittance in front of a hit, `rho` Mahalanobis distance of a ray to a mean.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable
from typing import Any, Literal

from drgs.checks.arguments import check_fields, must_be
from drgs.checks.registry import Registry

__all__ = [
    "EPS_ALPHA",
    "PRESETS",
    "RESPONSES",
    "TOLERANCE_OF_END",
    "TOLERANCE_OF_PICTURES",
    "Preset",
    "RenderSettings",
    "check_settings",
    "why_illegal",
]

Preset = Literal["exact", "fast", "inria", "gsplat", "3dgut", "mitsuba"]
PRESETS: tuple[Preset, ...] = typing.get_args(Preset)

# Depth is sum w t* / max(alpha, EPS_ALPHA): 0, not NaN, in pixels that no Gaussian covers.
EPS_ALPHA = 1e-10

TOLERANCE_OF_PICTURES = 1 / 512
"""Half a step of 8 bits, which is all that files of pictures and screens hold."""
TOLERANCE_OF_END = 0.1
"""Share of `tolerance` for ending rays early, which happens in few pixels; the rest is for the tails that are cut off,
which is in all.
"""

RESPONSES: Registry[Any] = Registry(
    "response",
    "drgs.responses",
    {
        "peak": "drgs.tracing.peak:PEAK",
        "integral": "drgs.tracing.integral:INTEGRAL",
        "ewa": "drgs.tracing.ewa:EWA",
    },
)
"""Name -> `drgs.tracing.responses.Response`. The table stands here, below the engine, so that settings know its names
without loading Dr.Jit.
"""

# `Response.planar` of this package's own, for the same reason.
_PLANAR = {"peak": False, "integral": False, "ewa": True}

# Of each preset, what differs from the defaults of `RenderSettings`.
_TABLE: dict[str, dict[str, Any]] = {
    "exact": {"order": "ray"},
    "fast": {"extent": 3.0, "transmittance_min": 0.01, "alpha_max": 0.9999},
    "mitsuba": {
        "order": "entry",
        "traversal": "bvh",
        "extent": 3.0,
        "transmittance_min": 0.01,
        "alpha_max": 0.9999,
        "max_hits": 64,
        "sh_direction": "ray",
    },
    "inria": {
        "response": "ewa",
        "depth_key": "z",
        "alpha_min": 1 / 255,
        "alpha_max": 0.99,
        "alpha_max_gradient": "pass",
        "transmittance_min": 1e-4,
        "stop": "before",
        "dilation": 0.3,
        "near": 0.2,
        "fov_clamp": "inria",
        "culling": "inria",
    },
    "gsplat": {
        "response": "ewa",
        "depth_key": "z",
        "alpha_min": 1 / 255,
        "alpha_max": 0.999,
        "transmittance_min": 1e-4,
        "stop": "before_eq",
        "dilation": 0.3,
        "near": 0.01,
        "fov_clamp": "gsplat",
        "culling": "gsplat",
    },
    "3dgut": {
        "depth_key": "z",
        "extent": 3.33,
        "alpha_min": 1 / 255,
        "alpha_max": 0.99,
        "transmittance_min": 1e-4,
        "stop": "before_eq",
        "near": 0.01,
        "culling": "ut",
    },
}

_RANGES = {
    "extent": (0.0, 1e3),
    "alpha_min": (0.0, 1.0),
    "alpha_max": (0.0, 1.0),
    "transmittance_min": (0.0, 1.0),
    "tolerance": (0.0, 1.0),
    "dilation": (0.0, 1e3),
    "near": (0.0, 1e30),  # float32 holds it
    "max_hits": (1, 1 << 30),
    "background": (-1e30, 1e30),
}


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """Settings of `drgs.render`: response, order, traversal and cut-offs.

    Attributes:
        response: `peak` (a = alpha exp(-rho^2/2) at the ray's peak), `integral` (a = 1 - exp(-optical depth from the
            camera on)), `ewa` (the rasterizers' projected covariance), or a name that was added to `RESPONSES`.
        order: `center` (one depth per Gaussian and view), `ray` (exact order of (t*, index) on each ray) or `entry`
            (Mitsuba's order of entry points, `bvh` only).
        traversal: `tiles` (the pixels of a camera, the fast path) or `bvh` (Mitsuba's acceleration structure, any ray).
        depth_key: Key of `order="center"`: `distance` to the camera center or camera-space `z`.
        extent: Cut-off radius in standard deviations. None is the adaptive radius r that bounds what derivatives lose:
            max(alpha_i N, 1) (1 + r^2) exp(-r^2 / 2) = 1e-5 (of `integral` with softplus(logit_i) in place of alpha_i),
            at least 5.47, however faint a Gaussian is. In order `ray` on tiles n, what a tile lists, takes the place
            of N, unless depth or count is asked for.
        alpha_min: Hits with a < alpha_min are skipped.
        alpha_max: a is clamped to this value.
        alpha_max_gradient: `zero` or `pass`: the derivative of the clamp.
        transmittance_min: A ray ends once T falls below it; see `stop`.
        stop: `after` composites the hit, then tests T; `before` tests T (1 - a) < transmittance_min and drops the hit
            (INRIA), `before_eq` the same with <= (gsplat).
        tolerance: Largest error of a color, in units of the range that the view's colors and its background span, that
            cut-offs may make, from which extents and the T at which a ray ends follow (docs/numerics.md has the proof);
            with `extent=None` only. None: what derivatives need.
        max_hits: A ray ends behind so many hits, whatever is left of T; None is no limit.
        dilation: Added to the diagonal of the projected covariance, in px^2 (`ewa` only).
        near: Gaussians whose mean has camera z <= near are left out; 0 leaves none out.
        fov_clamp: Clamp of x/z and y/z in the `ewa` Jacobian: `none`, `inria` (symmetric) or `gsplat` (off-center).
        culling: `extent` (the extent above), `inria` (16x16-pixel tiles touched by the square of the 3-sigma radius),
            `gsplat` (per-axis radius min(3.33, sqrt(2 ln(255 alpha))) sigma; no other cut than alpha_min) or, for
            responses along rays on tiles, `ut` (the extent, and the tiles of the box that the unscented transform
            gives: what gsplat's 3DGUT does not look at).
        sh_direction: SH are evaluated towards each Gaussian's mean (`gaussian`) or along each pixel's ray (`ray`).
        background: RGB composited behind everything.
    """

    response: str = "peak"
    order: Literal["center", "ray", "entry"] = "center"
    traversal: Literal["tiles", "bvh"] = "tiles"
    depth_key: Literal["distance", "z"] = "distance"
    extent: float | None = None
    alpha_min: float = 0.0
    alpha_max: float = 1.0
    alpha_max_gradient: Literal["zero", "pass"] = "zero"
    transmittance_min: float = 1e-10
    stop: Literal["after", "before", "before_eq"] = "after"
    tolerance: float | None = None
    max_hits: int | None = None
    dilation: float = 0.0
    near: float = 0.0
    fov_clamp: Literal["none", "inria", "gsplat"] = "none"
    culling: Literal["extent", "inria", "gsplat", "ut"] = "extent"
    sh_direction: Literal["gaussian", "ray"] = "gaussian"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not isinstance(self.response, str) or self.response not in RESPONSES:
            raise ValueError(f"RenderSettings: response must be one of {', '.join(RESPONSES)}, got {self.response!r}")
        check_fields("RenderSettings", self, _RANGES)
        for name in ("extent", "alpha_max", "tolerance"):
            if getattr(self, name) == 0:
                raise ValueError(f"RenderSettings: {name} must be > 0, got 0")
        problem = why_illegal(self)
        if problem:
            raise NotImplementedError(f"RenderSettings: {problem}")

    @property
    def planar(self) -> bool:
        """Whether the response is a model of the image plane (`ewa`), not of rays: pinhole cameras only, one depth a
        Gaussian. Dilation, the clamp of the field of view and the culling by radius are of such models only.
        """
        if self.response in _PLANAR:
            return _PLANAR[self.response]
        return bool(RESPONSES[self.response].planar)

    def for_pictures(self) -> RenderSettings:
        """Settings for files and screens of 8 bits: of preset `exact` with a tolerance of half a step of theirs."""
        is_exact = self.nearest_preset() == ("exact", {})
        return self.replace(tolerance=TOLERANCE_OF_PICTURES) if is_exact else self

    @property
    def least_transmittance(self) -> float:
        """The T below which a ray ends: `transmittance_min`, or more where `tolerance` allows it."""
        if self.tolerance is None:
            return self.transmittance_min
        return max(self.transmittance_min, TOLERANCE_OF_END * self.tolerance)

    @classmethod
    def preset(cls, name: str, **overrides: Any) -> RenderSettings:
        """Settings of a named system.

        `exact` is the claim of this package: images within 1e-5, derivatives within 1e-4 of rays without a cut in
        float64, where pixels see more of Gaussians than their tails (docs/numerics.md). `fast` has the cut-offs of
        Mitsuba's `volprim_rf_basic` and draws the previews of fits; `mitsuba` is that integrator's model: its
        acceleration structure, order of entry points, SH along each ray, 64 hits a ray, without the hits that it loses.
        `inria` and `gsplat` are those rasterizers' models. `3dgut` is what gsplat composites with `with_ut` and
        `with_eval3d`: the peak on each ray, with the rasterizer's cut-offs, in the tiles of the boxes that the
        unscented transform gives, which leave out what they misjudge; `culling="extent"` draws that, too.
        docs/conventions.md lists the source of every constant.

        Args:
            name: One of `PRESETS`.
            **overrides: Fields that replace the preset's.
        Raises:
            ValueError: If the name or a field is unknown.
        """
        must_be("RenderSettings.preset", "name", name, str, 'e.g. RenderSettings.preset("fast", extent=4.0)')
        if name not in _TABLE:
            raise ValueError(f"RenderSettings.preset: name must be one of {', '.join(PRESETS)}, got {name!r}")
        _refuse_unknown(overrides)
        return cls(**{**_TABLE[name], **overrides})

    def nearest_preset(self) -> tuple[str, dict[str, Any]]:
        """Name of the preset from which, whatever the background, the fewest fields differ, `fast` among equals, and
        these fields.
        """
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        differences = {}
        for name in ("fast", *PRESETS):
            preset = {**defaults, **_TABLE[name], "background": self.background}
            differences[name] = {x: getattr(self, x) for x in defaults if getattr(self, x) != preset[x]}
        return min(differences.items(), key=lambda item: len(item[1]))

    def replace(self, **fields: Any) -> RenderSettings:
        """A copy with the given fields replaced; unknown names raise ValueError."""
        _refuse_unknown(fields)
        return dataclasses.replace(self, **fields)


def _refuse_unknown(fields: Iterable[str]) -> None:
    known = {field.name for field in dataclasses.fields(RenderSettings)}
    unknown = sorted(set(fields) - known)
    if unknown:
        raise ValueError(f"RenderSettings: unknown field {unknown[0]!r}; the fields are {', '.join(sorted(known))}")


def why_illegal(s: RenderSettings) -> str | None:
    """Why a combination of response, order and traversal does not exist, or None when it does."""
    if s.planar and s.traversal == "bvh":
        return f"response={s.response!r} is defined on the image plane, use traversal='tiles' (got 'bvh')"
    if s.planar and s.order != "center":
        return f"response={s.response!r} has one depth per Gaussian, use order='center' (got {s.order!r})"
    if s.tolerance is not None and s.extent is not None:
        return f"tolerance decides on the extent, use extent=None (got {s.extent!r}) or tolerance=None"
    if s.order == "entry" and s.traversal == "tiles":
        return "order='entry' is Mitsuba's order of entry points, use traversal='bvh' (got 'tiles')"
    if s.culling == "ut" and (s.planar or s.traversal != "tiles"):
        return (
            "culling='ut' belongs to responses along rays on traversal='tiles', use culling='extent' (got "
            f"{s.response!r} on {s.traversal!r})"
        )
    if s.culling not in ("extent", "ut") and not s.planar:
        return f"culling={s.culling!r} belongs to response='ewa', use culling='extent' (got {s.response!r})"
    if s.fov_clamp != "none" and not s.planar:
        return f"fov_clamp={s.fov_clamp!r} belongs to response='ewa', use fov_clamp='none' (got {s.response!r})"
    if s.dilation > 0 and not s.planar:
        return f"dilation belongs to response='ewa', use dilation=0 (got {s.response!r})"
    return None


def check_settings(where: str, settings: Any) -> None:
    """Raise `ArgumentError` unless these are RenderSettings, or None."""
    if settings is not None:
        must_be(where, "settings", settings, RenderSettings, 'drgs.RenderSettings.preset("exact") makes them')
