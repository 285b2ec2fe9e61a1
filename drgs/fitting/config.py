"""Configuration of a fit, frozen records by subject; imports nothing heavy, as the command line reads its options here.

A field is an option of `drgs fit`: its text and its range are stated beside its default, and nowhere else. What takes
longer to say stands in the docstring of its record.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

from drgs.checks.records import Record, first_difference, one_of, option, part
from drgs.fitting.renderers import AUTO, check_renderers, named_renderers, planar_of
from drgs.information.choices import POLICIES, POLICY_NAMES, check_named
from drgs.information.region import REGION_FORMS, RegionText
from drgs.information.scoring import Scoring
from drgs.settings import RenderSettings

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
DepthUse = Literal["auto", "on", "off"]
Degree = Literal[0, 1, 2, 3]
SemanticUse = Literal["auto", "ignore"]
FeatureSize = Literal["image", "teacher"]
Dynamics = Literal["auto", "ignore"]
FieldPreset = Literal["neu3d", "dnerf"]
LivesUse = Literal["auto", "off"]

# Ranges of numbers, both ends included.
COUNT = (1, 10**9)  # more is a typing error
SEED = (0, 2**31 - 1)  # what COLMAP takes
FRACTION = (0.0, 1.0)
RATE = (0.0, 1e6)  # learning rates; larger ones are typing errors, and stay finite in float32
FADING = (1e-30, 1e6)  # of rates whose logarithms are interpolated
WEIGHT = (0.0, 1e6)  # of a term of the loss, likewise
OPACITY = (1e-6, 1 - 1e-6)  # its logit is finite in float32

ROUNDS = 5
"""Rounds of `drgs.prune`; docs/prune.md has what one, ten and twenty reach."""

_FAST = RenderSettings.preset("fast")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataConfig(Record):
    """Which photographs are fitted, how large, and where Gaussians begin.

    An active fit reads nothing of a view before it is picked, so that its initial points are of the initial views
    unless `init_points` is `all`. A split that the data set's own files state wins over `test_every` and `test_offset`,
    and `test_cameras` wins over both.
    """

    max_pixels: int = option(130_000, "Images are reduced to at most this many pixels.", within=COUNT)
    updates_per_step: int | None = option(
        None,
        "Optimizer updates per step, each on another photograph: reduced ones at first, then random quarters, and one"
        " update on a whole photograph in the last fifth of the steps. 1: no quarters. auto: 3, which take as long, in"
        " static fits on all views without teacher or depth maps, if photographs have 25,000 pixels, and two for each"
        " of --max-gaussians; else 1.",
        within=(1, 64),
        rare=True,
        none="auto",
        metavar="N|auto",
    )
    num_downscales: int | None = option(
        None,
        "Start with images of half the width and height, this many times halved; full size is reached in the "
        "first half of the steps, and no side is below 11 pixels; auto: 1 where a step has several updates, else 0.",
        within=(0, 16),
        rare=True,
        none="auto",
        metavar="N|auto",
    )
    init_points: InitPoints = option(
        "auto",
        "Initial points: of the training views (views) or of the data set (all); auto: all, or views if --views "
        "active.",
        rare=True,
    )
    test_every: int = option(8, "Hold out every n-th view, by name; 0 holds out none.", within=(0, 10**9))
    test_offset: int = option(
        0,
        "Index of the first held-out view, below --test-every; a split in the data set's files overrides both.",
        within=(0, 10**9),
        rare=True,
    )
    test_cameras: tuple[str, ...] | None = option(
        None,
        "Synchronous cameras to hold out at all times, e.g. cam00,cam07; none: hold out by --test-every.",
        rare=True,
        commas=True,
        none="none",
        metavar="CAMERA,CAMERA|none",
    )
    times: int = option(
        40,
        "Number of frames of each synchronous camera, evenly spaced in its video, the first and the last included.",
        within=(1, 10**6),
    )
    mask: MaskUse = option(
        "auto",
        "Outside of masks the scene is empty (object), or unknown (valid); auto: object if all photographs have a"
        " mask file, valid if only some have one, and for empty corners of undistorted photographs; ignore: no "
        "masks. Pixels that an alpha channel leaves transparent are outside, too, with object and auto; with the others"
        " they show the background color.",
    )
    undistort: UndistortUse = option(
        "auto",
        "Undistort photographs (on), or fit them as they were taken (off), with renderers along rays (--for drgs,"
        " exact, fast or 3dgut); auto: off for these renderers if undistorting would crop more than a fifth of "
        "the picture.",
        rare=True,
    )
    exposure: ExposureUse | None = option(
        None,
        "Multiply the rendering of each photograph by gains of R, G and B: none (off), estimated from points that"
        " several show (points), then optimized (learned); auto: points, if gains clearly differ and lower the "
        "error of held-out photographs in short trial fits. Default: auto in static fits on all views, if the trials "
        "take at most a tenth of the fit and no photographs have to be matched for it; else off.",
        rare=True,
    )
    poses: PoseUse = option(
        "fixed",
        "Keep the cameras of training photographs (fixed), or optimize them (refined); auto: refined if "
        "reprojection errors of a COLMAP model are large.",
        rare=True,
    )
    skybox: SkyboxUse = option(
        "auto",
        "Place a tenth of the Gaussians far around the scene, for the sky and the far background: if photographs "
        "clearly agree on it (auto; not in active fits and dynamic scenes), always (on), or never (off).",
        rare=True,
    )
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Data"

    def __post_init__(self) -> None:
        super().__post_init__()
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

    Reference:
        [1] Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
    """

    max_gaussians: int = option(30_000, "Largest number of Gaussians, at the start and later.", within=COUNT)
    initial_opacity: float = option(0.1, "Opacity of every Gaussian at the start.", within=OPACITY, rare=True)
    dense_opacity: float = option(
        0.3, "Opacity at the start of Gaussians at points of depth maps.", within=OPACITY, rare=True
    )
    dense_scale: float = option(
        0.5, "Factor of the scales of Gaussians at points of depth maps.", within=(1e-6, 1e6), rare=True
    )
    refine_start: float = option(
        1 / 30, "Fraction of the steps at which density control begins.", within=FRACTION, rare=True
    )
    refine_stop: float = option(0.8, "Fraction of the steps at which density control ends.", within=FRACTION, rare=True)
    refine_every: float = option(
        1 / 30, "Fraction of the steps between two steps of density control.", within=FRACTION, rare=True
    )
    min_opacity: float = option(0.005, "A Gaussian below this opacity is moved elsewhere.", within=FRACTION, rare=True)
    grow_until: float = option(
        0.5,
        "Fraction of the steps at which --max-gaussians is reached, at a constant rate of growth.",
        within=FRACTION,
        rare=True,
    )
    noise: float = option(
        0.0, "Strength of the exploration noise of MCMC; 0 is none, 5e5 is that of the paper.", within=WEIGHT, rare=True
    )
    dropout: float | None = option(
        None,
        "Share of the Gaussians that a step leaves out at random, rising from 0 to this at the end; auto: 0.4 for up"
        " to 3 photographs, else 0.",
        within=(0.0, 0.9),
        rare=True,
        none="auto",
        metavar="SHARE|auto",
    )
    prune_loss: float = option(
        0.0,
        "When density control ends, remove as many Gaussians as lower the PSNR of training photographs by at most "
        "this, in dB, which the last steps recover; 0: none. 0.3 removes about half (docs/real-data.md).",
        within=(0.0, 100.0),
        rare=True,
    )
    jitter: float = option(
        0.1, "Displacement of copied Gaussians, in their own standard deviations.", within=(0.0, 1e3), rare=True
    )
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Quality"

    def start_of(self, dense: bool) -> tuple[float, float]:
        """Opacity, and factor of the scales, of new Gaussians; `dense` for points from depth maps."""
        return (self.dense_opacity, self.dense_scale) if dense else (self.initial_opacity, 1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RateConfig(Record):
    """Learning rates of Adam, a tensor of the Gaussians each; those of features and of motion have their own records.

    Those of means, scales and SH are four times those of 3DGS, which are for 30,000 steps: in fits of some hundred or
    thousand steps they gain up to 3 dB (docs/real-data.md, "Rates for short fits").
    """

    means_rate: tuple[float, float] = option(
        (6.4e-4, 6.4e-6),
        "First and last learning rate of the means, in units of the scene's extent, log-linear between.",
        within=FADING,
        rare=True,
    )
    dc_rate: float = option(2.5e-3, "Learning rate of the base color, SH of degree 0.", within=RATE, rare=True)
    rest_rate: float = option(5e-4, "Learning rate of the SH of higher degrees.", within=RATE, rare=True)
    opacity_rate: float = option(0.05, "Learning rate of the logits of the opacities.", within=RATE, rare=True)
    scale_rate: float = option(2e-2, "Learning rate of the logarithms of the scales.", within=RATE, rare=True)
    rotation_rate: float = option(1e-3, "Learning rate of the quaternions.", within=RATE, rare=True)
    sh_every: float = option(1 / 30, "Fraction of the steps between two degrees of SH.", within=FRACTION, rare=True)
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Quality"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LossConfig(Record):
    """Weights of the terms of the loss that every fit has; the photographs' L1 distance has what SSIM leaves of 1."""

    ssim_weight: float = option(
        0.2,
        "Weight of 1 - SSIM in the loss, in [0, 1]; the rest is that of the L1 distance.",
        within=FRACTION,
        rare=True,
    )
    outside_weight: float = option(
        1.0,
        "Weight of the opacity outside of object masks, and where the alpha channel of a photograph is transparent.",
        within=WEIGHT,
        rare=True,
    )
    opacity_weight: float = option(
        0.01, "Weight of the mean opacity, which lets Gaussians of no use fade (MCMC).", within=WEIGHT, rare=True
    )
    scale_weight: float = option(
        0.01, "Weight of the mean scale, which keeps Gaussians small (MCMC).", within=WEIGHT, rare=True
    )
    transients: TransientUse = option(
        "keep",
        "Leave shadows and passers-by, which single photographs have, out of the loss: never (keep), if residuals"
        " clearly reveal some (auto), or at all suspicious pixels (mask).",
        rare=True,
    )
    depth: DepthUse = option(
        "off",
        "Fit to the depth maps of the data set: never (off), if they agree with points that photographs triangulate"
        " (auto), or always (on; relative ones as far as points give their scale).",
        rare=True,
    )
    depth_weight: tuple[float, float] = option(
        (3.0, 0.3),
        "First and last weight of the relative error of rendered depth, log-linear between.",
        within=FADING,
        rare=True,
    )
    depth_behind: float = option(
        0.1,
        "Factor of --depth-weight where rendered depth is behind the map's, as mirror images are; 1: both sides count"
        " alike.",
        within=FRACTION,
        rare=True,
    )
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Quality"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureConfig(Record):
    """A fit to a teacher's maps, beside the photographs: Feature 3DGS [1], whose rates and weights these are.

    In [1] features are rendered at the size of the image, and the feature image reaches the features alone.

    Reference:
        [1] Zhou et al., "Feature 3DGS", CVPR 2024, and its code.
    """

    semantics: SemanticUse = option(
        "auto",
        "Fit semantic features and a decoder if the data set has a teacher's feature maps (auto), or never (ignore).",
    )
    feature_width: int = option(
        128,
        "Feature channels of a Gaussian; a linear decoder maps them to those of the teacher.",
        within=(1, 4096),
        rare=True,
    )
    feature_weight: float = option(
        1.0,
        "Weight of the distance to the teacher's feature maps in the loss; that of the photographs is 1.",
        within=WEIGHT,
        rare=True,
    )
    feature_rate: float = option(
        1e-3,
        "Learning rate of the features; five times as much for fits of about 1,000 steps (docs/semantic.md).",
        within=RATE,
        rare=True,
    )
    decoder_rate: float = option(
        1e-4, "Learning rate of the decoder, usually a tenth of that of the features.", within=RATE, rare=True
    )
    couple_features: bool = option(
        False, "Let gradients of the features change the geometry, too, not only those of colors.", rare=True
    )
    feature_resolution: FeatureSize = option(
        "image",
        "Render features at the size of the image and reduce them, or, faster, at the size of the teacher's map.",
        rare=True,
    )
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Features"


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionConfig(Record):
    """Gaussians that a deformation field moves [1], where the training views are of two times or more.

    The static stage fits Gaussians that stand still to the first time of all training cameras (to all times, where
    fewer than 3 photographs, or less than half of all places, are of the first). The dynamic stage continues with them
    and with their optimizer's moments, and adds the field. Rates and SH follow one schedule over both; those of the
    field begin with the dynamic stage. Density control goes through its schedule in each stage: the static one up to
    half of `max_gaussians`, the dynamic one up to all, so that there are some left for what appears later. Initial
    points are not held to that half: as many of them as `max_gaussians` leave what appears later no room but that of
    Gaussians that have faded.

    The field's rates are ten times those of [1], which are for 14,000 steps: in some hundred or thousand, motion must
    be found before what is in the wrong place has become transparent. A gate is a logit a Gaussian; what no photograph
    shows to move comes to a rest by their weight, and is not deformed.

    Where something moves between photographs by more than its size, or appears, Gaussians are added where photographs
    of its time show it: with a center and a width in time and a velocity of their own, so that no photograph of
    another time fades them (`drgs.fitting.components.lifespans`).

    Reference:
        [1] Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, and its code.
    """

    dynamics: Dynamics = option(
        "auto",
        "Fit a deformation field if the views have several times (auto), or static Gaussians to all times (ignore).",
    )
    static_share: float = option(
        3 / 17,
        "Fraction of the steps that fit static Gaussians to the first time, before the deformation field is "
        "added; 0: none.",
        within=FRACTION,
        rare=True,
    )
    field_preset: FieldPreset = option(
        "neu3d",
        "Size of the deformation field: for videos of several cameras (neu3d), or one camera around an object (dnerf).",
        rare=True,
    )
    grid_rate: tuple[float, float] = option(
        (1.6e-2, 1.6e-3), "First and last learning rate of the field's planes.", within=FADING, rare=True
    )
    field_rate: tuple[float, float] = option(
        (1.6e-3, 1.6e-4), "First and last learning rate of the field's MLP.", within=FADING, rare=True
    )
    motion_rate: float = option(
        120.0,
        "Learning rate of the gates (for each Gaussian a logit of whether it moves) is this / steps of the dynamic "
        "stage, at most 0.5.",
        within=RATE,
        rare=True,
    )
    motion_weight: float = option(
        0.03, "Weight of the mean gate in the loss: the larger, the fewer Gaussians move.", within=WEIGHT, rare=True
    )
    smooth_weight: float = option(1e-3, "Weight of the smoothness of the field along time.", within=WEIGHT, rare=True)
    plane_weight: float = option(
        2e-4, "Weight of the smoothness of the field's spatial planes (xy, xz, yz).", within=WEIGHT, rare=True
    )
    l1_time_weight: float = option(
        1e-4,
        "Weight of the L1 distance of the field's temporal planes from 1, where they have no effect.",
        within=WEIGHT,
        rare=True,
    )
    lives: LivesUse = option(
        "auto",
        "Add Gaussians with a limited lifetime where photographs of one time differ from the static Gaussians "
        "(auto), or none (off).",
        rare=True,
    )
    life_weight: float = option(
        0.1,
        "Weight of the mean of (time between photographs / width of a Gaussian's lifetime) where this ratio is below "
        "1: the larger, the longer they live.",
        within=WEIGHT,
        rare=True,
    )
    where: ClassVar[str] = "fit"
    heading: ClassVar[str] = "Motion"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.static_share == 1:
            raise ValueError("fit: static_share must be below 1, got 1; --dynamics ignore fits no motion at all")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SavingConfig(Record):
    """When checkpoints are written. This does not change the fit, which may be resumed with another one."""

    save_every: int = option(1000, "Steps between checkpoints.", within=COUNT, rare=True)
    save_minutes: float = option(
        10.0, "Minutes between checkpoints, if --save-every takes longer.", within=(1e-3, 1e9), rare=True
    )
    where: ClassVar[str] = "fit"


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

    `region`: candidates are scored by what is still unknown of the pixels that show this part of the scene, given the
    Gaussians at each pick. With `masks` only the masks of photographs that have been picked are read. While no view
    shows any of the region, the whole scene counts.
    """

    policy: str = option(
        "fisher",
        "How views are picked: a policy's name, or package.module:function of your own (docs/extending.md).",
        metavar=one_of(POLICY_NAMES),
    )
    scoring: Scoring = part(Scoring(), rare=True)
    region: str | None = option(
        None,
        "Part of the scene that counts: a box or a sphere (world coordinates), what masks of some photographs show, or"
        " a class of a scene with labels; default all.",
        metavar="|".join(REGION_FORMS),
        rare=True,
    )
    schedule: Schedule = option(
        "auto",
        "Pick view by view (views), one camera at each later time (times), or any camera at any time (pairs); "
        "auto: times for dynamic scenes, else views.",
        rare=True,
    )
    initial: int = option(
        2,
        "Number of initial views: the one of --start, then those farthest away; default 2, or all cameras at the "
        "first time.",
        within=COUNT,
        rare=True,
    )
    start: Start = option(
        "first", "First of the initial views: the first training view by name, or a random one by the seed.", rare=True
    )
    add: int | None = option(
        None,
        "Number of views to pick during the fit; the others are not read; default 10, or one for every time after"
        " the first.",
        within=COUNT,
    )
    every: int | None = option(
        None,
        "Steps before the first pick, and between picks; default 200, with --schedule times or pairs --max-steps * "
        "200 / 17,000 (as in arXiv 2512.22771), counted from the end of the static stage.",
        within=COUNT,
        rare=True,
    )
    info_pixels: int | None = option(
        None,
        "Compute information on views of at most this many pixels; default that of the fit.",
        within=COUNT,
        rare=True,
    )
    pick_points: PickPoints = option(
        "auto",
        "Points that a picked view adds: triangulated, and where no Gaussian is yet (uncovered), or none; auto: "
        "none with --init-points all or --schedule times or pairs, else uncovered.",
        rare=True,
    )
    restart: Restart = option(
        "auto",
        "Restart the Gaussians after a pick, at points of all views so far: until these are 1,000 (auto), always,"
        " or never.",
        rare=True,
    )
    measure: tuple[int, ...] = option(
        (),
        "Numbers of training views at which held-out views are measured, too, just before the next pick.",
        within=COUNT,
        rare=True,
    )
    where: ClassVar[str] = "active"
    heading: ClassVar[str] = "Views"

    def __post_init__(self) -> None:
        check_named("active", POLICIES, self.policy)
        if self.region is not None:
            RegionText.of(self.region, "active")
        if self.add == 0:
            raise ValueError("active: add must be >= 1, got 0; without --views active all views are used")
        super().__post_init__()
        if self.scoring.settings != Scoring.settings or self.scoring.semantics is not None:
            raise ValueError("active: scoring must leave settings and semantics to the fit, got others; drop them")

    def flat(self) -> dict[str, Any]:
        """All fields beside each other, as selection.json has them."""
        record = self.to_json()
        scoring = record.pop("scoring")
        prior = scoring.pop("prior") or {"value": None, "relative": False, "length": None}
        scoring |= scoring.pop("nuisances")
        return (
            record
            | scoring
            | {
                "prior": prior["value"],
                "relative_prior": prior["relative"],
                "prior_length": prior["length"],
            }
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig(Record):
    """Everything that determines a fit besides its data. Fractions are of `max_steps`.

    `FitConfig().replace(max_steps=500, max_gaussians=5000)` takes any field of any of its records by its name.

    `deterministic`: an image that is drawn again without gradients differs from the one that was fitted by 1e-7, the
    rounding of its sums (presets `fast`, `inria` and `gsplat`; those of `exact` and `mitsuba` have the same bits).

    `renderers`: steps take these presets in turn (`drgs.fitting.renderers`). With several, `settings` must be a
    preset's, and are used for previews, metrics and view selection; their background holds for all. With one,
    `settings` are its settings. `auto` is `any` if `settings` are those of preset `fast`, else `settings` alone.

    Raises:
        ValueError: If a field has another type or is out of its range.
    """

    settings: RenderSettings = _FAST
    renderers: tuple[str, ...] = option(
        AUTO,
        "Renderers that the result must look right in, used in turn: any (exact, fast, inria, gsplat, 3dgut), "
        "drgs (exact, fast), viewers (gsplat, inria), or presets; exact among others with a tolerance of 0.01. auto: "
        "any, or --preset alone if it is given.",
        heading="Rendering",
        flag="for",
        commas=True,
        metavar="any|drgs|viewers|PRESET,PRESET",
    )
    filter_3d: Filter3DUse = option(
        "off",
        "Limit Gaussians to the sampling rate of the photographs (on), for renderings larger than those of the "
        "fit: the 3D smoothing filter of Mip-Splatting.",
        rare=True,
        heading="Quality",
    )
    max_steps: int = option(3000, "Optimizer steps.", within=COUNT)
    seed: int = option(0, "Random seed.", within=SEED)
    sh_degree: Degree = option(3, "Highest degree of the view-dependent color.", heading="Quality")
    deterministic: bool = option(
        False,
        "Use one Dr.Jit thread, which is slower: the same seed gives the same bits. (Images rendered again "
        "without gradients differ by 1e-7: docs/numerics.md.)",
        rare=True,
        heading="Machine",
    )
    data: DataConfig = part(DataConfig())
    density: DensityConfig = part(DensityConfig())
    rates: RateConfig = part(RateConfig())
    loss: LossConfig = part(LossConfig())
    features: FeatureConfig = part(FeatureConfig())
    motion: MotionConfig = part(MotionConfig())
    saving: SavingConfig = part(SavingConfig())
    selection: SelectionConfig | None = part(None)
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_renderers(self.renderers, self.settings)
        if self.data.undistort == "off":
            _check_lenses(self)

    def resuming(self, before: FitConfig) -> FitConfig:
        """This configuration for resuming a fit of `before`, whose resolved values it takes for `updates_per_step`,
        `num_downscales` and `exposure` where they are not stated, and for `renderers` if `settings` are the same.
        `undistort` stays as it is: photographs are there already, as this configuration has them.
        """
        config = self
        if config.renderers == AUTO and config.settings == before.settings:
            config = config.replace(renderers=before.renderers)
        for name in ("updates_per_step", "num_downscales", "exposure"):
            if getattr(config.data, name) is None:
                config = config.replace(**{name: getattr(before.data, name)})
        return config

    def difference(self, other: FitConfig) -> tuple[str, Any, Any] | None:
        """The first field by which `other` is another fit, and both values as JSON has them; None if there is none.

        `saving` is not compared, nor is `selection`, which is compared once `auto` is resolved
        (`ActiveViews.restore`).
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
    """Refuse renderers that cannot draw photographs as they were taken."""
    drawn = planar_of(config.renderers, config.settings)
    if drawn:
        raise ValueError(
            f"fit: undistort off must have renderers along rays alone, got {', '.join(drawn)}; use --for drgs, or "
            "--undistort on"
        )


def check_amount(where: str, keep: float | None, loss: float | None, rounds: int = ROUNDS) -> None:
    """Raise ValueError unless exactly one of `keep` and `loss` is given, and numbers are as `prune` takes them."""
    if (keep is None) == (loss is None):
        raise ValueError(
            f"{where}: either keep or loss must say how many Gaussians are removed, got "
            f"{'none' if keep is None else 'both'}; e.g. keep 0.5, or loss 0.1 dB"
        )
    if keep is not None and not 0 < keep < 1:
        hint = "to remove nothing, leave the scene as it is" if keep == 1 else "0.5 keeps half of the Gaussians"
        raise ValueError(f"{where}: keep must be a share above 0 and below 1, got {keep:g}; {hint}")
    if loss is not None and not 0 < loss < math.inf:
        raise ValueError(f"{where}: loss must be above 0 dB and finite, got {loss:g}; try 0.1")
    if not (isinstance(rounds, int) and rounds >= 1):
        raise ValueError(f"{where}: rounds must be a whole number >= 1, got {rounds!r}; try {ROUNDS}")
