"""What a fit does, as two frozen records; imports nothing heavy, for the options of the command line read it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from drgs.guards.arguments import check_fields, must_be
from drgs.information.choices import (
    POLICIES,
    Block,
    Combine,
    Method,
    NetworkScore,
    check_combined,
    check_named,
    checked_blocks,
)
from drgs.information.criteria import CRITERIA
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.information.semantics import SemanticMetric
    from drgs.select import Scoring

__all__ = [
    "ActiveConfig",
    "Degree",
    "Dynamics",
    "FeatureSize",
    "FieldPreset",
    "FitConfig",
    "InitPoints",
    "MaskUse",
    "PickPoints",
    "SAVING",
    "Schedule",
    "SemanticUse",
    "Start",
]

InitPoints = Literal["auto", "views", "all"]
MaskUse = Literal["auto", "object", "valid", "ignore"]
PickPoints = Literal["auto", "uncovered", "none"]
Restart = Literal["auto", "always", "never"]
Schedule = Literal["auto", "views", "times", "pairs"]
Start = Literal["first", "seed"]
Degree = Literal[0, 1, 2, 3]
SemanticUse = Literal["auto", "ignore"]
FeatureSize = Literal["image", "teacher"]
Dynamics = Literal["auto", "ignore"]
FieldPreset = Literal["neu3d", "dnerf"]

SAVING = ("save_every", "save_minutes")
"""Fields of `FitConfig` that change nothing of what is fitted: a fit may go on with others."""

_COUNT = (1, 10**9)
_SHARE = (0.0, 1.0)
_RATE = (0.0, 1e6)
_WEIGHT = (0.0, 1e6)
_RANGES = {
    **dict.fromkeys(("max_steps", "max_pixels", "max_gaussians", "save_every"), _COUNT),
    "save_minutes": (1e-3, 1e9),
    "test_every": (0, 10**9),
    "test_offset": (0, 10**9),
    "seed": (0, 2**31 - 1),  # what COLMAP takes
    "means_rate": (1e-30, 1e6),  # their logarithms are interpolated
    **dict.fromkeys(("dc_rate", "rest_rate", "opacity_rate", "scale_rate", "rotation_rate"), _RATE),
    **dict.fromkeys(("outside_weight", "opacity_weight", "scale_weight", "noise"), _WEIGHT),
    **dict.fromkeys(("initial_opacity", "dense_opacity"), (1e-6, 1 - 1e-6)),
    **dict.fromkeys(("ssim_weight", "sh_every", "refine_start", "refine_stop", "refine_every"), _SHARE),
    **dict.fromkeys(("min_opacity", "grow_until"), _SHARE),
    "dense_scale": (1e-6, 1e6),
    "feature_width": (1, 4096),
    "feature_weight": _WEIGHT,
    **dict.fromkeys(("feature_rate", "decoder_rate"), _RATE),
    "jitter": (0.0, 1e3),
    "times": (1, 10**6),
    "static_share": _SHARE,
    **dict.fromkeys(("grid_rate", "field_rate"), (1e-30, 1e6)),  # their logarithms are interpolated
    "motion_rate": _RATE,
    **dict.fromkeys(("motion_weight", "smooth_weight", "plane_weight", "l1_time_weight"), _WEIGHT),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Everything that determines a fit besides its data. Fractions are of `max_steps`.

    Attributes:
        settings: What `drgs.render` computes.
        max_steps: Optimizer steps.
        max_pixels: Images are reduced to at most this many pixels.
        max_gaussians: Budget of the density control, at the start as later.
        init_points: `auto` (the data set's points, else `views`), `views` (only what the training views show) or, in
            an active fit, where `auto` is `views`, `all` (the data set's points, else what all its views show).
        test_every: Every n-th view by name is held out; 0 holds out none.
        test_offset: Index of the first view that is held out, below `test_every`. A split that the data set's own files
            state wins over both.
        test_cameras: Names of the cameras that are held out at all times, of videos and of captures by several cameras,
            which wins over what is above; None: as the data set has it, where there are videos the first; empty: none.
        times: How many synchronous frames of every camera are taken, evenly over the whole length.
        seed: Of everything random.
        sh_degree: Highest degree of the view-dependent color.
        deterministic: One Dr.Jit thread, hence the same bits for the same seed. An image that is drawn again without
            gradients differs from the one that was fitted by 1e-7, the rounding of its sums (presets `fast`, `inria`
            and `gsplat`; those of `exact` and `mitsuba` have the same bits).
        save_every: Steps between checkpoints.
        save_minutes: A checkpoint is written after so many minutes, too, however few steps these were.
        mask: `object` (nothing is outside), `valid` (anything may be outside), `ignore`, or `auto`: `object` where
            the data set has mask files, `valid` where undistorted photographs have empty corners.
        means_rate: First and last learning rate of the means, in units of the scene's extent, log-linear between.
        dc_rate, rest_rate, opacity_rate, scale_rate, rotation_rate: Learning rates of the other parameters.
        ssim_weight: Of 1 - SSIM against L1.
        outside_weight: Of the opacity outside an `object` mask.
        opacity_weight, scale_weight: Regularizers of MCMC density control.
        initial_opacity: Of every Gaussian at the start.
        dense_opacity, dense_scale: The same, and a factor of the scales, for points from depth maps: these cover the
            surfaces already, and wide transparent Gaussians would only make every ray meet hundreds of them (half the
            time, for the same PSNR, on the still life and on `office`).
        sh_every: Fraction between two degrees of SH.
        refine_start, refine_stop, refine_every: Fractions between which, and how often, density is controlled.
        min_opacity: Below it a Gaussian is moved elsewhere.
        grow_until: Fraction at which the budget is reached, at a constant rate of growth.
        noise: Strength of the exploration noise (5e5 in MCMC, for 30,000 steps). Off: in 1,500 steps on `banana` it
            cost 0.4 dB of held-out PSNR (28.0 against 28.4).
        jitter: Displacement of copies in their own standard deviations.
        semantics: `auto` fits features and a decoder where the data set has maps of a teacher (Feature 3DGS [1]);
            `ignore` never does, and reads none of them.
        feature_width: Channels D of the features that are rendered; the decoder makes those of the teacher of them.
        feature_weight: gamma, of the L1 distance between decoded features and the teacher's map.
        feature_rate, decoder_rate: Learning rates of the features and of the decoder, as in [1].
        couple_features: Let the feature image move the geometry, too; in [1] it reaches the features alone.
        feature_resolution: Features are rendered at the size of the `image` and then reduced to the teacher's, as in
            [1], or at the size of the `teacher`'s map.
        dynamics: `auto` fits Gaussians that a deformation field moves [2] where the training views are of two times or
            more; `ignore` fits Gaussians that stand still to the photographs of all times.
        static_share: Fraction of the steps of the static stage, which fits Gaussians that stand still to the first time
            of all training cameras (to all times, where fewer than 3 photographs show the first); 0 leaves it out. The
            dynamic stage goes on with them, and with their moments in the optimizer, and adds the field. Rates and SH
            follow one schedule over both; those of the field begin with the dynamic stage. Density control goes
            through its schedule in each stage, `refine_start` to `refine_stop` of its steps: the static one up to half
            of `max_gaussians`, the dynamic one up to all, so that there are some left for what appears later.
        field_preset: Size of the deformation field, as in [2] for videos of several cameras (`neu3d`) or for one camera
            around an object (`dnerf`).
        grid_rate, field_rate: First and last learning rate of the field's planes and of its MLP, log-linear between.
            Ten times those of [2], which are for 14,000 steps: in some hundred or thousand, motion must be found
            before what is in the wrong place has become transparent.
        motion_rate: How far the logit of a gate, one a Gaussian, that says what moves can go in the dynamic stage: its
            learning rate is that divided by the steps.
        motion_weight: Of the mean of all gates: what no photograph shows to move comes to a rest, and is not deformed.
        smooth_weight: Of the second differences along time of the field's planes of space and time, as in [2].
        plane_weight: The same, of its planes of space.
        l1_time_weight: Of the distance from 1, which is rest, of its planes of space and time, as in [2].

    Reference:
        [1] Zhou et al., "Feature 3DGS", CVPR 2024, and its code.
        [2] Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, and its code.
    """

    settings: RenderSettings = dataclasses.field(default_factory=lambda: RenderSettings.preset("fast"))
    max_steps: int = 3000
    max_pixels: int = 130_000
    max_gaussians: int = 30_000
    init_points: InitPoints = "auto"
    test_every: int = 8
    test_offset: int = 0
    test_cameras: tuple[str, ...] | None = None
    times: int = 40
    seed: int = 0
    sh_degree: Degree = 3
    deterministic: bool = False
    save_every: int = 1000
    save_minutes: float = 10.0
    mask: MaskUse = "auto"
    means_rate: tuple[float, float] = (1.6e-4, 1.6e-6)
    dc_rate: float = 2.5e-3
    rest_rate: float = 1.25e-4
    opacity_rate: float = 0.05
    scale_rate: float = 5e-3
    rotation_rate: float = 1e-3
    ssim_weight: float = 0.2
    outside_weight: float = 1.0
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    initial_opacity: float = 0.1
    dense_opacity: float = 0.3
    dense_scale: float = 0.5
    sh_every: float = 1 / 30
    refine_start: float = 1 / 30
    refine_stop: float = 0.8
    refine_every: float = 1 / 30
    min_opacity: float = 0.005
    grow_until: float = 0.5
    noise: float = 0.0
    jitter: float = 0.1
    semantics: SemanticUse = "auto"
    feature_width: int = 128
    feature_weight: float = 1.0
    feature_rate: float = 1e-3
    decoder_rate: float = 1e-4
    couple_features: bool = False
    feature_resolution: FeatureSize = "image"
    dynamics: Dynamics = "auto"
    static_share: float = 3 / 17
    field_preset: FieldPreset = "neu3d"
    grid_rate: tuple[float, float] = (1.6e-2, 1.6e-3)
    field_rate: tuple[float, float] = (1.6e-3, 1.6e-4)
    motion_rate: float = 120.0
    motion_weight: float = 0.03
    smooth_weight: float = 1e-3
    plane_weight: float = 2e-4
    l1_time_weight: float = 1e-4

    def __post_init__(self) -> None:
        check_fields("fit", self, _RANGES)
        if self.static_share == 1:
            raise ValueError("fit: static_share must be below 1, got 1; --dynamics ignore fits no motion at all")
        if self.test_every == 1:
            raise ValueError("fit: test_every must be 0 (hold out none) or >= 2, got 1")
        if self.test_offset >= max(self.test_every, 1):
            raise ValueError(
                f"fit: test_offset must be in 0..{max(self.test_every, 1) - 1} with test_every {self.test_every}, got "
                f"{self.test_offset}; lower it"
            )

    def start_of(self, dense: bool) -> tuple[float, float]:
        """Opacity, and factor of the scales, of new Gaussians; `dense` for points from depth maps."""
        return (self.dense_opacity, self.dense_scale) if dense else (self.initial_opacity, 1.0)

    def to_json(self) -> dict:
        """As config.json holds it."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_json(cls, value: dict) -> FitConfig:
        """The inverse of `to_json`; unknown fields raise ValueError."""
        known = {field.name for field in dataclasses.fields(cls)}
        must_be("fit", "config", value, dict, "as FitConfig.to_json() makes it")
        must_be("fit", "settings", value.get("settings", {}), dict, "the fields of a RenderSettings")
        if unknown := sorted(set(value) - known):
            raise ValueError(f"fit: config must hold known fields, got {unknown[0]!r}; was it written by a newer drgs?")
        settings = RenderSettings().replace(**value.get("settings", {}))
        value = {k: tuple(v) if isinstance(v, list) else v for k, v in value.items()}
        return cls(**{**value, "settings": settings})


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActiveConfig:
    """How views are chosen during a fit.

    Attributes:
        policy: A name in `drgs.select.POLICIES`, or `package.module:function` of one's own.
        criterion: Of policy `fisher`, a name in `drgs.gain.CRITERIA`, or `package.module:function` of one's own.
        method: Of the diagonal, see `drgs.fisher.diagonal`.
        schedule: `views`: `initial` views, then one after the other. `times`: the static stage on all cameras at the
            first time, then one camera at each later time, in order. `pairs`: the same start, then any (camera, time).
            `auto`: `times` where a deformation is fitted, else `views`. More in `drgs.fitting.timetable`.
        initial: Of `views`: views at the start: one by `start`, then those farthest from all before.
        start: The first of them: `first` of the training split by name, or one of it drawn by the fit's `seed`, from a
            generator of its own, so that no policy's draws depend on it.
        add: Views to be added, one at a time; None: 10, and of `times` and `pairs` as many as there are later times.
        every: Steps between two of them, and before the first, in the dynamic stage; None: 200, and of `times` and
            `pairs` that part of 17,000 of `max_steps`, as in arXiv 2512.22771.
        info_pixels: Pixels of the views that information is computed from; None: those of the fit.
        prior: lambda, the prior precision of every parameter; None: as in `drgs.select.Scoring`.
        relative_prior: lambda is `prior` times the median of the group's positive information.
        pick_points: `uncovered`: a picked view brings the points that can be triangulated with it, and more where the
            Gaussians are transparent in it, for density control never leaves what it has covered; the budget is divided
            evenly among the views. `none`: no points after the start, as in arXiv 2512.22771. `auto`: `none` with
            initial points of the whole data set and at later times, else `uncovered`.
        restart: Whether the Gaussians begin again after a pick, at points that all views seen so far show together;
            schedules, networks and photographs go on. `auto`: until 1,000 were triangulated at a start; `always`, as
            FisherRF's code; `never`, as arXiv 2512.22771. Not where `pick_points` brings none, with points of depth
            maps, and where next to none can be triangulated.
        blocks, network, combine, probes: What counts in policy `fisher`, and how, as in `drgs.select.Scoring`; blocks
            None: all that the fit has.
        measure: Numbers of views at which the held-out views are measured on the way, just before the next one is
            picked; selection.json has the averages. What all picks lead to is in metrics.json as ever.
    """

    policy: str = "fisher"
    criterion: str = "v_opt"
    method: Method = "exact"
    schedule: Schedule = "auto"
    initial: int = 2
    start: Start = "first"
    add: int | None = None
    every: int | None = None
    info_pixels: int | None = None
    prior: float | None = None
    relative_prior: bool = False
    pick_points: PickPoints = "auto"
    blocks: tuple[Block, ...] | None = None
    network: NetworkScore = "ratio"
    combine: Combine | None = None
    probes: int = 16
    restart: Restart = "auto"
    measure: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        from drgs.information.prior import Prior

        check_named("active", POLICIES, self.policy)
        check_named("active", CRITERIA, self.criterion)
        if self.add == 0:
            raise ValueError("active: add must be >= 1, got 0; without --views active all views are used")
        if self.blocks is not None:
            object.__setattr__(self, "blocks", checked_blocks("active", self.blocks, self.method))
        count = (1, 10**9)
        ranges = dict.fromkeys(("initial", "add", "every", "info_pixels", "probes", "measure"), count)
        check_fields("active", self, ranges)
        check_combined("active", self.blocks, self.criterion, self.network, self.combine)
        Prior.given(self.prior, self.relative_prior)

    @classmethod
    def recorded(cls, config: Mapping[str, Any]) -> dict:
        """A recorded config with what an earlier version did not know: as it did, which never began again."""
        return {**cls().to_json(), "restart": "never", **config}

    def scoring(self, settings: RenderSettings, semantics: SemanticMetric | None = None) -> Scoring:
        """As `drgs.select` takes it, for views that are rendered with these settings."""
        from drgs.information.prior import Prior
        from drgs.select import Scoring

        return Scoring(
            criterion=self.criterion,
            settings=settings,
            method=self.method,
            prior=Prior.given(self.prior, self.relative_prior),
            blocks=self.blocks,
            semantics=semantics,
            network=self.network,
            combine=self.combine,
            probes=self.probes,
        )

    def to_json(self) -> dict:
        """As config.json, selection.json and the checkpoint hold it."""
        return json.loads(json.dumps(dataclasses.asdict(self)))
