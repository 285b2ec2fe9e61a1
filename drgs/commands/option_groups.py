"""Options that several commands have: what `options.py` builds those of each command from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

from drgs.commands.overrides import parsed
from drgs.fitting.config import ActiveConfig, Dynamics, FeatureSize, FieldPreset, FitConfig, SemanticUse
from drgs.information.choices import Block, Combine, Criterion, Method, NetworkScore, Policy
from drgs.settings import Preset, RenderSettings

__all__ = [
    "BLOCKS_TEXT",
    "Around",
    "Choosing",
    "Clustered",
    "Common",
    "Comparing",
    "Data",
    "Informed",
    "Moments",
    "Moving",
    "OutputPath",
    "SceneFile",
    "Seen",
    "Settings",
    "Split",
    "Taught",
    "Timed",
    "Views",
]

OutputPath = Annotated[Path, arg(aliases=["-o"])]
SceneFile = Annotated[
    Positional[Path],
    arg(help="A run folder, or Gaussians: .ply, .spz, .splat, .ksplat, .sog, .glb, a SOG or INRIA model folder."),
]
Split = Literal["all", "train", "test"]

# One text, `geometry,semantic`; what is none of the names is refused where the blocks are used.
BLOCKS_TEXT: Any = PrimitiveConstructorSpec(
    nargs=1,
    metavar="BLOCK,BLOCK",
    instance_from_str=lambda texts: tuple(name.strip() for name in texts[0].split(",")),
    is_instance=lambda x: x is None or isinstance(x, tuple),
    str_from_instance=lambda x: ["all there is" if x is None else ",".join(x)],
)
# One text, `cam00,cam05`; `none` is the empty tuple.
_CAMERAS: Any = PrimitiveConstructorSpec(
    nargs=1,
    metavar="CAMERA,CAMERA|none",
    instance_from_str=lambda texts: () if texts[0] == "none" else tuple(name.strip() for name in texts[0].split(",")),
    is_instance=lambda x: x is None or isinstance(x, tuple),
    str_from_instance=lambda x: ["the first" if x is None else ",".join(x) or "none"],
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Common:
    """Options that every command has."""

    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb"] = "auto"
    """Backend; auto follows DRGS_VARIANT, then CUDA if it works, else LLVM."""
    threads: int | None = None
    """Threads of Dr.Jit and torch; default DRGS_THREADS, else every usable core."""
    quiet: bool = False
    """Print neither progress nor results, which are in the files; only warnings and errors."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """Options of commands that render."""

    preset: Preset = "exact"
    """Render settings of a named system."""
    overrides: Annotated[
        tuple[str, ...],
        arg(name="set", metavar="KEY=VALUE", help="Replace one render setting, e.g. order=ray."),
        UseAppendAction,
    ] = ()

    def settings(self) -> RenderSettings:
        """The `RenderSettings` that --preset and --set describe.

        Raises:
            ValueError: If an override is no KEY=VALUE, names no field or has the wrong type.
        """
        return RenderSettings.preset(self.preset, **self.replaced())

    def replaced(self) -> dict[str, Any]:
        """The fields that --set replaces.

        Raises:
            ValueError: If one is no KEY=VALUE, names no field or has the wrong type.
        """
        return parsed(self.overrides)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Data:
    """Options of commands that load data sets."""

    strict: bool = False
    """Refuse a data set that lists images which are not there; else at least 3 must be, and the others are left out."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Timed(Data):
    """Options of commands that load data sets of one time or of several."""

    times: int | None = None
    """How many frames of each synchronous camera are used, evenly over its video; default as the run, else 40."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views(Timed):
    """Options of commands that take some of the views of a data set."""

    test_cameras: Annotated[tuple[str, ...] | None, _CAMERAS] = None
    """Synchronous cameras that are held out at all times (cam00,cam05), or none; default as the run, else the first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Around:
    """Options of commands that can make cameras around a scene; what is not given is as a run's photographs or the
    known views have it, where there are any.
    """

    up: Literal["auto", "x", "y", "z", "minus-x", "minus-y", "minus-z"] = "auto"
    """World direction that is up on an orbit or a dome; auto: as the photographs, else minus-y."""
    center: tuple[float, float, float] | None = None
    """World point that an orbit or a dome looks at; default as the photographs, else the middle of the Gaussians."""
    distance: float | None = None
    """From that point, in scene units; default the photographs' median, else so that all is in the frame."""
    elevation: float | None = None
    """Degrees of an orbit above its center; default the photographs' median, else 20."""
    span: float | None = None
    """Degrees of an orbit; default as the photographs (select, fisher: 360 if they look at a point), else 360."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seen(Settings, Around, Views):
    """Options of commands that look at a scene from a few cameras."""

    scene: SceneFile
    cameras: str | None = None
    """A data set, a run, a cameras.json or selection.json, or orbit; default a run's own, else orbit."""
    split: Split = "all"
    """Which views of a data set."""
    limit: int = 2
    """At most this many views, evenly spaced."""
    max_pixels: int = 20_000
    """Views are reduced to at most this many pixels."""
    fov: float | None = None
    """Horizontal field of view of an orbit in degrees; default the photographs', else 45."""
    seed: int = 0
    """Seed of everything random."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Informed(Settings):
    """Options of commands that compute Fisher information."""

    method: Method = ActiveConfig.method
    """How information is computed: exactly (columns: slowly), by random probes, or as FisherRF's code does."""
    prior: float | None = ActiveConfig.prior
    """How firmly every parameter counts as known beforehand (lambda): 1e-2 with v_opt, 1 in drgs fisher, else 1e-6."""
    relative_prior: bool = ActiveConfig.relative_prior
    """lambda is --prior times the median information of a parameter's group, where it is not 0."""
    info_pixels: int | None = ActiveConfig.info_pixels
    """Information is computed on views of at most this many pixels; default as in the fit."""
    blocks: Annotated[tuple[Block, ...] | None, BLOCKS_TEXT] = ActiveConfig.blocks
    """What of an image tells: geometry (colors), semantic (features), deformation (what moves), backdrop (gaps)."""
    probes: int = ActiveConfig.probes
    """Random probes of each view, for what it tells about a deformation field, and for --method probes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparing(Informed, Around, Views):
    """Options of commands that compare views with known ones."""

    scene: SceneFile
    train: str | None = None
    """Views that are known: a data set, a run, a cameras.json or a selection.json; default the run's."""
    split: Split = "all"
    """Which of the other views, where they are a data set's."""
    count: int = 40
    """Cameras of an orbit or a dome."""
    time: float | None = None
    """Of cameras that state none, in a run that moves: e.g. those of an orbit."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choosing(Informed):
    """Options of commands that choose views."""

    policy: Policy | str = ActiveConfig.policy
    """How the next view is chosen (docs/information.md), or a function of your own: package.module:function."""
    criterion: Criterion | str = ActiveConfig.criterion
    """Score of policy fisher, or a function of your own: package.module:function. v_opt chose the best views from six
    on, level below (docs/active-static.md)."""
    network: NetworkScore = ActiveConfig.network
    """How the block deformation scores: against what known views say of the field (ratio), or alone (trace, paper)."""
    combine: Combine | None = ActiveConfig.combine
    """Scores of several blocks are added up, or as z-scores over the candidates; default zscore with a trace."""
    seed: int = 0
    """Seed of everything random."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clustered:
    """Options of commands that can let other processes compute."""

    scheduler: str | None = None
    """HOST:PORT of a Dask cluster that computes: information of views, or whole fits (docs/many-machines.md)."""
    workers: int | None = None
    """The same on this machine: so many processes of one thread each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Taught:
    """Options of a fit to a teacher's maps."""

    semantics: SemanticUse = FitConfig.semantics
    """Fit features and a decoder, too, where the data set has maps of a teacher (auto), or never (ignore)."""
    feature_width: int = FitConfig.feature_width
    """Feature channels of a Gaussian; a linear decoder makes the teacher's of them."""
    feature_weight: float = FitConfig.feature_weight
    """Weight of the features' distance to the teacher's maps in the loss; that of the photographs' is 1."""
    feature_rate: float = FitConfig.feature_rate
    """Learning rate of the features; five times as much for fits of about 1,000 steps (docs/semantic.md)."""
    decoder_rate: float = FitConfig.decoder_rate
    """Learning rate of the decoder, a tenth of the features' as a rule."""
    feature_resolution: FeatureSize = FitConfig.feature_resolution
    """Features are rendered at the size of the image and then reduced, or at that of the teacher's map: faster."""
    couple_features: bool = FitConfig.couple_features
    """Let features move the geometry, too; else only colors do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moments:
    """Options of commands that draw a scene that moves."""

    time: str | None = None
    """Of a scene that moves: one time, or a range (0..1) over all views; default the views' own, else all times."""
    view: str | None = None
    """Only the view, or the camera, of this name; with a range of --time, --frames pictures of it."""
    moving: bool = False
    """Into ply files only what moves."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moving:
    """Options of a fit to what moves."""

    times: int = FitConfig.times
    """How many frames of each synchronous camera are used, evenly over its video, the first and the last included."""
    test_cameras: Annotated[tuple[str, ...] | None, _CAMERAS] = FitConfig.test_cameras
    """Synchronous cameras that are held out at all times, e.g. cam00,cam07; none leaves it to --test-every."""
    dynamics: Dynamics = FitConfig.dynamics
    """Fit a deformation field where the views have several times (auto), or static Gaussians to all times (ignore)."""
    static_share: float = FitConfig.static_share
    """Fraction of the steps that fit static Gaussians to the first time, before the deformation field is added."""
    field_preset: FieldPreset = FitConfig.field_preset
    """Size of the deformation field: for videos of several cameras (neu3d), or one camera around an object (dnerf)."""
    grid_rate: tuple[float, float] = FitConfig.grid_rate
    """First and last learning rate of the field's planes."""
    field_rate: tuple[float, float] = FitConfig.field_rate
    """First and last learning rate of the field's MLP."""
    motion_rate: float = FitConfig.motion_rate
    """Learning rate of the gates (a logit each Gaussian: does it move?), times the steps of the dynamic stage."""
    motion_weight: float = FitConfig.motion_weight
    """Weight in the loss of the mean of all gates: the larger, the fewer Gaussians move."""
    smooth_weight: float = FitConfig.smooth_weight
    """Weight of the field's smoothness along time."""
    plane_weight: float = FitConfig.plane_weight
    """Weight of the smoothness of the field's planes of space (x and y, x and z, y and z)."""
    l1_time_weight: float = FitConfig.l1_time_weight
    """Weight of the L1 distance of the field's planes of time from 1, at which they change nothing."""
