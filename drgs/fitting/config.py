"""What a fit does, as frozen records by subject; imports nothing heavy, for the options of the command line are theirs.

What `Attributes` say of a field is what `drgs fit --help-all` says of its option; what takes longer to say stands above
them.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from drgs.fitting.motion_config import Dynamics, FieldPreset, LivesUse, MotionConfig
from drgs.fitting.ranges import COUNT, FADING, FRACTION, OPACITY, RATE, WEIGHT
from drgs.fitting.renderers import AUTO, check_renderers, named_renderers, planar_of
from drgs.guards.arguments import check_fields
from drgs.guards.records import Record, first_difference, ways_of
from drgs.information.choices import POLICIES, check_named
from drgs.information.prior import Prior
from drgs.information.scoring import Scoring
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.information.semantics import SemanticMetric

__all__ = [
    "ActiveConfig",
    "DataConfig",
    "Degree",
    "DensityConfig",
    "Dynamics",
    "ExposureUse",
    "FeatureConfig",
    "FeatureSize",
    "FieldPreset",
    "Filter3DUse",
    "FitConfig",
    "InitPoints",
    "LivesUse",
    "LossConfig",
    "MaskUse",
    "MotionConfig",
    "PickPoints",
    "PoseUse",
    "RateConfig",
    "Restart",
    "SavingConfig",
    "Schedule",
    "SelectionConfig",
    "SemanticUse",
    "SkyboxUse",
    "Start",
    "TransientUse",
    "UndistortUse",
    "recorded_config",
]

InitPoints = Literal["auto", "views", "all"]
Filter3DUse = Literal["off", "on"]
ExposureUse = Literal["off", "auto", "points", "learned"]
MaskUse = Literal["auto", "object", "valid", "ignore"]
PickPoints = Literal["auto", "uncovered", "none"]
Restart = Literal["auto", "always", "never"]
Schedule = Literal["auto", "views", "times", "pairs"]
Start = Literal["first", "seed"]
PoseUse = Literal["fixed", "auto", "refined"]
UndistortUse = Literal["auto", "on", "off"]
SkyboxUse = Literal["off", "auto", "on"]
TransientUse = Literal["auto", "mask", "keep"]
Degree = Literal[0, 1, 2, 3]
SemanticUse = Literal["auto", "ignore"]
FeatureSize = Literal["image", "teacher"]

_FAST = RenderSettings.preset("fast")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataConfig(Record):
    """Which photographs are fitted, how large, and where Gaussians begin.

    An active fit reads nothing of a view before it is picked, so that its initial points are of the initial views
    unless `init_points` is `all`. A split that the data set's own files state wins over `test_every` and `test_offset`,
    and `test_cameras` wins over both.

    Attributes:
        max_pixels: Images are reduced to at most this many pixels.
        num_downscales: Start with images of half the width and height, this many times halved; full size is reached in
            the first half of the steps, and no side is below 11 pixels.
        init_points: Initial points: of the training views (views) or of the data set (all); auto: all, or views if
            --views active.
        test_every: Hold out every n-th view, by name; 0 holds out none.
        test_offset: Index of the first held-out view, below --test-every; a split in the data set's files overrides
            both.
        test_cameras: Synchronous cameras to hold out at all times, e.g. cam00,cam07; none: hold out by --test-every.
        times: Number of frames of each synchronous camera, evenly spaced in its video, the first and the last included.
        mask: Outside of masks the scene is empty (object), or unknown (valid); auto: object if all photographs have a
            mask file, valid if only some have one, and for empty corners of undistorted photographs; ignore: no masks.
            With object, and as with masks with auto, transparent pixels of an alpha channel are empty, too.
        undistort: Undistort photographs (on), or fit them as they were taken (off), with renderers along rays (--for
            drgs, exact, fast or 3dgut); auto: off for these renderers if undistorting would crop more than a fifth of
            the picture.
        exposure: Multiply the rendering of each photograph by gains of R, G and B: none (off), estimated from points
            that several show (points), then optimized (learned); auto: points, if gains clearly differ and lower the
            error of held-out photographs in short fits.
        poses: Keep the cameras of training photographs (fixed), or optimize them (refined); auto: refined if
            reprojection errors of a COLMAP model are large.
        skybox: Place a tenth of the Gaussians far around the scene, for the sky and the far background: if photographs
            clearly agree on it (auto; not in active fits and dynamic scenes), always (on), or never (off).
    """

    max_pixels: int = 130_000
    num_downscales: int = 0
    init_points: InitPoints = "auto"
    test_every: int = 8
    test_offset: int = 0
    test_cameras: tuple[str, ...] | None = None
    times: int = 40
    mask: MaskUse = "auto"
    undistort: UndistortUse = "auto"
    exposure: ExposureUse = "off"
    poses: PoseUse = "fixed"
    skybox: SkyboxUse = "auto"
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        low = {"test_every": (0, 10**9), "test_offset": (0, 10**9)}
        check_fields("fit", self, {"max_pixels": COUNT, "num_downscales": (0, 16), "times": (1, 10**6), **low})
        if self.test_every == 1:
            raise ValueError("fit: test_every must be 0 (hold out none) or >= 2, got 1")
        if self.test_offset >= max(self.test_every, 1):
            raise ValueError(
                f"fit: test_offset must be in 0..{max(self.test_every, 1) - 1} with test_every {self.test_every}, got "
                f"{self.test_offset}; lower it"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class DensityConfig(Record):
    """How many Gaussians there are, how new ones look, and when and where they come: MCMC density control [1].

    Points from depth maps cover the surfaces already, and wide transparent Gaussians would only make every ray meet
    hundreds of them: so these begin smaller and more opaque (half the time, for the same PSNR, on the still life and on
    `office`). The exploration noise is off: in 1,500 steps on `banana` it cost 0.4 dB of held-out PSNR (28.0 against
    28.4); MCMC has 5e5, for 30,000 steps.

    Attributes:
        max_gaussians: Largest number of Gaussians, at the start and later.
        initial_opacity: Opacity of every Gaussian at the start.
        dense_opacity: Opacity at the start of Gaussians at points of depth maps.
        dense_scale: Factor of the scales of Gaussians at points of depth maps.
        refine_start: Fraction of the steps at which density control begins.
        refine_stop: Fraction of the steps at which density control ends.
        refine_every: Fraction of the steps between two steps of density control.
        min_opacity: A Gaussian below this opacity is moved elsewhere.
        grow_until: Fraction of the steps at which --max-gaussians is reached, at a constant rate of growth.
        noise: Strength of the exploration noise of MCMC; 0 is none, 5e5 is that of the paper.
        jitter: Displacement of copied Gaussians, in their own standard deviations.
    Reference:
        [1] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
    """

    max_gaussians: int = 30_000
    initial_opacity: float = 0.1
    dense_opacity: float = 0.3
    dense_scale: float = 0.5
    refine_start: float = 1 / 30
    refine_stop: float = 0.8
    refine_every: float = 1 / 30
    min_opacity: float = 0.005
    grow_until: float = 0.5
    noise: float = 0.0
    jitter: float = 0.1
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        shares = ("refine_start", "refine_stop", "refine_every", "min_opacity", "grow_until")
        ranges = {
            "max_gaussians": COUNT,
            "initial_opacity": OPACITY,
            "dense_opacity": OPACITY,
            "dense_scale": (1e-6, 1e6),
            "noise": WEIGHT,
            "jitter": (0.0, 1e3),
        }
        check_fields("fit", self, ranges | dict.fromkeys(shares, FRACTION))

    def start_of(self, dense: bool) -> tuple[float, float]:
        """Opacity, and factor of the scales, of new Gaussians; `dense` for points from depth maps."""
        return (self.dense_opacity, self.dense_scale) if dense else (self.initial_opacity, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RateConfig(Record):
    """Learning rates of Adam, a tensor of the Gaussians each; those of features and of motion have their own records.

    Those of means, scales and SH are four times those of 3DGS, which are for 30,000 steps: in fits of some hundred or
    thousand steps they gain up to 3 dB (docs/real-data.md, "Rates for short fits").

    Attributes:
        means_rate: First and last learning rate of the means, in units of the scene's extent, log-linear between.
        dc_rate: Learning rate of the base color, SH of degree 0.
        rest_rate: Learning rate of the SH of higher degrees.
        opacity_rate: Learning rate of the logits of the opacities.
        scale_rate: Learning rate of the logarithms of the scales.
        rotation_rate: Learning rate of the quaternions.
        sh_every: Fraction of the steps between two degrees of SH.
    """

    means_rate: tuple[float, float] = (6.4e-4, 6.4e-6)
    dc_rate: float = 2.5e-3
    rest_rate: float = 5e-4
    opacity_rate: float = 0.05
    scale_rate: float = 2e-2
    rotation_rate: float = 1e-3
    sh_every: float = 1 / 30
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        single = ("dc_rate", "rest_rate", "opacity_rate", "scale_rate", "rotation_rate")
        check_fields("fit", self, {"means_rate": FADING, "sh_every": FRACTION, **dict.fromkeys(single, RATE)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class LossConfig(Record):
    """Weights of the terms of the loss that every fit has; the photographs' L1 distance has what SSIM leaves of 1.

    Attributes:
        ssim_weight: Weight of 1 - SSIM in the loss, in [0, 1]; the rest is that of the L1 distance.
        outside_weight: Weight of the opacity outside of object masks, and where the alpha channel of a photograph is
            transparent.
        opacity_weight: Weight of the mean opacity, which lets Gaussians of no use fade (MCMC).
        scale_weight: Weight of the mean scale, which keeps Gaussians small (MCMC).
        transients: Leave shadows and passers-by, which single photographs have, out of the loss: never (keep), if
            residuals clearly reveal some (auto), or at all suspicious pixels (mask).
    """

    ssim_weight: float = 0.2
    outside_weight: float = 1.0
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    transients: TransientUse = "keep"
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        weights = ("outside_weight", "opacity_weight", "scale_weight")
        check_fields("fit", self, {"ssim_weight": FRACTION, **dict.fromkeys(weights, WEIGHT)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureConfig(Record):
    """A fit to a teacher's maps, beside the photographs: Feature 3DGS [1], whose rates and weights these are.

    In [1] features are rendered at the size of the image, and the feature image reaches the features alone.

    Attributes:
        semantics: Fit semantic features and a decoder if the data set has a teacher's feature maps (auto), or never
            (ignore).
        feature_width: Feature channels of a Gaussian; a linear decoder maps them to those of the teacher.
        feature_weight: Weight of the distance to the teacher's feature maps in the loss; that of the photographs is 1.
        feature_rate: Learning rate of the features; five times as much for fits of about 1,000 steps
            (docs/semantic.md).
        decoder_rate: Learning rate of the decoder, usually a tenth of that of the features.
        couple_features: Let gradients of the features change the geometry, too, not only those of colors.
        feature_resolution: Render features at the size of the image and reduce them, or, faster, at the size of the
            teacher's map.
    Reference:
        [1] Zhou et al., "Feature 3DGS", CVPR 2024, and its code.
    """

    semantics: SemanticUse = "auto"
    feature_width: int = 128
    feature_weight: float = 1.0
    feature_rate: float = 1e-3
    decoder_rate: float = 1e-4
    couple_features: bool = False
    feature_resolution: FeatureSize = "image"
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        rates = {"feature_rate": RATE, "decoder_rate": RATE}
        check_fields("fit", self, {"feature_width": (1, 4096), "feature_weight": WEIGHT, **rates})


@dataclasses.dataclass(frozen=True, kw_only=True)
class SavingConfig(Record):
    """When checkpoints are written. It changes nothing of what is fitted: a fit may go on with another one.

    Attributes:
        save_every: Steps between checkpoints.
        save_minutes: Minutes between checkpoints, if --save-every takes longer.
    """

    save_every: int = 1000
    save_minutes: float = 10.0
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        check_fields("fit", self, {"save_every": COUNT, "save_minutes": (1e-3, 1e9)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class SelectionConfig(Record):
    """How views are chosen during a fit that begins with a few.

    `schedule`: `views` takes `initial` views, then one after the other. `times`: the static stage on all cameras at the
    first time, then one camera at each later time, in order. `pairs`: the same start, or `initial` views spread over
    cameras and times, then any (camera, time). More in `drgs.fitting.timetable`. The first view that a seed draws comes
    from a generator of its own, so that no policy's draws depend on it.

    `pick_points`: with `uncovered` a picked view brings the points that can be triangulated with it, and more where the
    Gaussians are transparent in it, for density control never leaves what it has covered; the budget is divided evenly
    among the views. With `none` no points come after the start, as in arXiv 2512.22771. `auto` is `none` with initial
    points of the whole data set and at later times, else `uncovered`.

    `restart`: whether the Gaussians begin again after a pick, at points that all views seen so far show together;
    schedules, networks and photographs go on. `auto`: until 1,000 were triangulated at a start; `always`, as FisherRF's
    code; `never`, as arXiv 2512.22771. Not where `pick_points` brings none, with points of depth maps, and where next
    to none can be triangulated.

    Attributes:
        policy: How views are picked: a policy's name, or package.module:function of your own (docs/extending.md).
        scoring: What counts, and how; its settings and the metric of its features are the fit's.
        schedule: Pick view by view (views), one camera at each later time (times), or any camera at any time (pairs);
            auto: times for dynamic scenes, else views.
        initial: Number of initial views: the one of --start, then those farthest away; default 2, or all cameras at the
            first time.
        start: First of the initial views: the first training view by name, or a random one by the seed.
        add: Number of views to pick during the fit; the others are not read; default 10, or one for every time after
            the first.
        every: Steps before the first pick, and between picks; default 200, with --schedule times or pairs 200 of
            17,000.
        info_pixels: Compute information on views of at most this many pixels; default that of the fit.
        pick_points: Points that a picked view adds: triangulated, and where no Gaussian is yet (uncovered), or none;
            auto: none with --init-points all.
        restart: Restart the Gaussians after a pick, at points of all views so far: until these are 1,000 (auto),
            always, or never.
        measure: Numbers of training views at which held-out views are measured, too, just before the next pick.
    """

    policy: str = "fisher"
    scoring: Scoring = dataclasses.field(default_factory=Scoring)
    schedule: Schedule = "auto"
    initial: int = 2
    start: Start = "first"
    add: int | None = None
    every: int | None = None
    info_pixels: int | None = None
    pick_points: PickPoints = "auto"
    restart: Restart = "auto"
    measure: tuple[int, ...] = ()
    where: ClassVar[str] = "active"

    def __post_init__(self) -> None:
        check_named("active", POLICIES, self.policy)
        if self.add == 0:
            raise ValueError("active: add must be >= 1, got 0; without --views active all views are used")
        check_fields("active", self, dict.fromkeys(("initial", "add", "every", "info_pixels", "measure"), COUNT))
        if self.scoring.settings != Scoring.settings or self.scoring.semantics is not None:
            raise ValueError("active: scoring must leave settings and semantics to the fit, got others; drop them")

    def scoring_of(self, settings: RenderSettings, semantics: SemanticMetric | None = None) -> Scoring:
        """As `drgs.select` takes it, for views that are rendered with these settings."""
        return dataclasses.replace(self.scoring, settings=settings, semantics=semantics)

    def flat(self) -> dict[str, Any]:
        """All fields beside each other, as selection.json has them."""
        record = self.to_json()
        scoring = record.pop("scoring")
        prior = scoring.pop("prior") or {"value": None, "relative": False}
        scoring |= scoring.pop("nuisances")
        return record | scoring | {"prior": prior["value"], "relative_prior": prior["relative"]}


def recorded_config(fit: Any, active: Mapping[str, Any] | None = None) -> FitConfig:
    """The config of a run's files.

    Args:
        fit: What `to_json` made, or all fields beside each other, as older versions wrote them.
        active: Those of the selection, which older versions wrote elsewhere. The first did not begin again after a
            pick, and had no field that says so. Nor had they one for renderers, all steps had the same settings, nor
            for lives, all Gaussians were always there.
    Raises:
        ValueError: If a field is unknown or out of range.
    """
    config = FitConfig.from_json(fit)
    if "lives" not in fit.get("motion", fit):
        config = config.replace(motion=dataclasses.replace(config.motion, lives="off"))
    if "renderers" not in fit:
        config = config.replace(renderers=(config.settings.nearest_preset()[0],))
    return config.replace(selection=selection_of_flat({"restart": "never", **active})) if active else config


def selection_of_flat(fields: Mapping[str, Any]) -> SelectionConfig:
    """The record of fields as `drgs.fitting.config.ActiveConfig` had them: lambda as a number and a flag.

    Raises:
        ValueError: If a field is unknown or out of range.
    """
    known: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}
    relative = known.pop("relative_prior", False)
    prior = known.pop("prior", None)
    return SelectionConfig.of(**known, prior=Prior.given(prior, relative))


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig(Record):
    """Everything that determines a fit besides its data. Fractions are of `max_steps`.

    `FitConfig.of(max_steps=500, max_gaussians=5000)` takes any field of any part by its name, as `replace` does.

    `deterministic`: an image that is drawn again without gradients differs from the one that was fitted by 1e-7, the
    rounding of its sums (presets `fast`, `inria` and `gsplat`; those of `exact` and `mitsuba` have the same bits).

    `renderers`: with several of them every step is rendered with the preset that is due (`drgs.fitting.renderers`), and
    `settings`, which are a preset's then, are those of the fit's own pictures and numbers, by which views are chosen as
    well; their background is that of all. A single renderer is drawn with `settings`, whatever fields they replace.
    `auto` is `any`, and with other settings than those of preset `fast` these alone.

    Attributes:
        settings: What `drgs.render` computes.
        renderers: Renderers that the result must look right in, used in turn: any (exact, fast, inria, gsplat, 3dgut),
            drgs (exact, fast), viewers (gsplat, inria), or presets; auto: any, or --preset alone if it is given.
        filter_3d: Limit Gaussians to the sampling rate of the photographs (on), for renderings larger than those of the
            fit: the 3D smoothing filter of Mip-Splatting.
        max_steps: Optimizer steps.
        seed: Random seed.
        sh_degree: Highest degree of the view-dependent color.
        deterministic: Use one Dr.Jit thread, which is slower: the same seed gives the same bits. (Images rendered again
            without gradients differ by 1e-7: docs/numerics.md.)
        data: Photographs, split and initial points.
        density: Numbers of Gaussians, and density control.
        rates: Learning rates.
        loss: Weights of the terms of the loss.
        features: A fit to a teacher's maps.
        motion: A fit to what moves.
        saving: Checkpoints.
        selection: How views are chosen on the way; None: the fit is to all of them.
    Raises:
        ValueError: If a field has another type or is out of its range.
    """

    settings: RenderSettings = _FAST
    renderers: tuple[str, ...] = AUTO
    filter_3d: Filter3DUse = "off"
    max_steps: int = 3000
    seed: int = 0
    sh_degree: Degree = 3
    deterministic: bool = False
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    density: DensityConfig = dataclasses.field(default_factory=DensityConfig)
    rates: RateConfig = dataclasses.field(default_factory=RateConfig)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    features: FeatureConfig = dataclasses.field(default_factory=FeatureConfig)
    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    saving: SavingConfig = dataclasses.field(default_factory=SavingConfig)
    selection: SelectionConfig | None = None
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        check_fields("fit", self, {"max_steps": COUNT, "seed": (0, 2**31 - 1)})  # a seed is what COLMAP takes
        check_renderers(self.renderers, self.settings)
        if self.data.undistort == "off":
            _check_lenses(self)

    def difference(self, other: FitConfig) -> tuple[str, Any, Any] | None:
        """The first field whose value in `other` makes another fit, and both values as JSON has them.

        When checkpoints are written makes none; how views are chosen is compared where it is known what `auto` is.
        """
        mine, theirs = (
            config.replace(
                renderers=named_renderers(config.renderers, config.settings),
                data=dataclasses.replace(
                    config.data, undistort="off" if config.data.undistort == "off" else "on"
                ),  # a run from before `auto` took lenses out
                saving=SavingConfig(),
                selection=None,
            ).to_json()
            for config in (self, other)
        )
        return first_difference(mine, theirs)


def _check_lenses(config: FitConfig) -> None:
    """Refuse what does not work on photographs as they were taken."""
    drawn = planar_of(config.renderers, config.settings)
    if drawn:
        raise ValueError(
            f"fit: undistort off must have renderers along rays alone, got {', '.join(drawn)}; use --for drgs, or "
            "--undistort on"
        )
    if config.data.poses != "fixed":
        poses = config.data.poses
        raise ValueError(f"fit: undistort off must have poses fixed, got {poses}; drop --poses, or use --undistort on")
    if config.selection:
        raise ValueError("fit: undistort off must have --views all, got active; use it, or --undistort on")


# ------------------------------------------------------- as it was written before the records, for one release


def _with_flat_fields(kind: type[FitConfig]) -> None:
    """Let `FitConfig(max_gaussians=5)` and `config.max_gaussians` go on, with a warning that says how it is written."""
    made = kind.__init__

    @functools.wraps(made)
    def begin(self: FitConfig, **fields: Any) -> None:
        own = {field.name for field in dataclasses.fields(kind)}
        if flat := [name for name in fields if name not in own]:
            base = kind(**{name: x for name, x in fields.items() if name in own})
            whole = base.replace(**{name: fields[name] for name in flat})
            _warn(f"FitConfig({flat[0]}=...) is written FitConfig.of({flat[0]}=...)")
            fields = {name: getattr(whole, name) for name in own}
        made(self, **fields)

    kind.__init__ = begin  # type: ignore[method-assign]


def _read_flat(self: Record, name: str) -> Any:
    """A field of a part, read of the whole."""
    kind: Any = type(self)
    way = ways_of(kind).get(name, ())
    value: Any = self
    if len(way) < 2:
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
    for step in way:
        value = getattr(value, step)
    _warn(f"{type(self).__name__}.{name} is written {type(self).__name__}.{'.'.join(way)}")
    return value


def _warn(text: str) -> None:
    warnings.warn(f"{text}; the old way ends with the next release", DeprecationWarning, stacklevel=3)


_with_flat_fields(FitConfig)
FitConfig.__getattr__ = SelectionConfig.__getattr__ = _read_flat  # type: ignore[attr-defined]


def ActiveConfig(**fields: Any) -> SelectionConfig:
    """A `SelectionConfig`, of fields as they stood beside each other; the name ends with the next release."""
    _warn("ActiveConfig(...) is written drgs.train.SelectionConfig.of(...), and lambda as prior=Prior(...)")
    return selection_of_flat(fields)
