"""Options that several commands have: what `options.py` builds those of each command from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, UseAppendAction, arg

from drgs.commands.orbit_keys import ORBIT_KEYS
from drgs.commands.overrides import parsed
from drgs.commands.record_options import CAMERAS_TEXT, CARRIED, HIDDEN, options_of
from drgs.fitting.config import SelectionConfig, UndistortUse
from drgs.guards.records import texts_of
from drgs.information.nuisances import Nuisances
from drgs.information.prior import Prior
from drgs.information.scoring import Scoring
from drgs.settings import Preset, RenderSettings

__all__ = [
    "Around",
    "Choosing",
    "Clustered",
    "Common",
    "Comparing",
    "Data",
    "Informed",
    "Lenses",
    "Moments",
    "OutputPath",
    "SceneFile",
    "Seen",
    "Settings",
    "Split",
    "Timed",
    "Views",
]

OutputPath = Annotated[Path, arg(aliases=["-o"])]
SceneFile = Annotated[
    Positional[Path],
    arg(help="A run folder, or Gaussians: .ply, .spz, .splat, .ksplat, .sog, .glb, a SOG or INRIA model folder."),
]
Split = Literal["all", "train", "test"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Common:
    """Options that every command has."""

    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb"] = "auto"
    """Backend; auto follows DRGS_VARIANT, then CUDA if it works, else LLVM."""
    threads: int | None = None
    """Threads of Dr.Jit and torch; default DRGS_THREADS, else every usable core."""
    quiet: bool = False
    """Print only warnings and errors; results are in the files."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """Options of commands that render."""

    preset: Preset = "exact"
    """Preset of render settings."""
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
    """Refuse a data set with missing images; by default they are left out, and at least 3 must remain."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Timed(Data):
    """Options of commands that load data sets of one time or of several."""

    times: int | None = None
    """Number of frames of each synchronous camera, evenly spaced in its video; default that of the run, else 40."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views(Timed):
    """Options of commands that take some of the views of a data set."""

    test_cameras: Annotated[tuple[str, ...] | None, CAMERAS_TEXT] = None
    """Synchronous cameras to hold out at all times (cam00,cam05), or none; default those of the run, else the first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lenses:
    """Options of commands that can look through lenses."""

    undistort: UndistortUse = "auto"
    """Undistort cameras (on), render through their lenses, by presets along rays (off), or do as the run did (auto)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Around:
    """Options of commands that can make cameras around a scene."""

    orbit: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE"), UseAppendAction] = ()
    """Shape of an orbit or a dome, e.g. elevation=30,span=180; by default chosen from the photographs' cameras."""
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(ORBIT_KEYS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seen(Settings, Around, Views):
    """Options of commands that look at a scene from a few cameras."""

    scene: SceneFile
    cameras: str | None = None
    """Views: a data set, a run, a cameras.json or selection.json, or orbit; default those of the run, else orbit."""
    split: Split = "all"
    """Which views of a data set to take."""
    limit: int = 2
    """At most this many views, evenly spaced."""
    max_pixels: int = 20_000
    """Views are reduced to at most this many pixels."""
    seed: int = 0
    """Random seed."""


_UNKNOWN = ("eliminate", "exposure_std", "pose_std")
_Information: Any = options_of(Scoring, only=("method", "blocks", "probes", *_UNKNOWN))
_Pixels: Any = options_of(SelectionConfig, only=("info_pixels",))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Informed(Settings, _Information, _Pixels):
    """Options of commands that compute Fisher information."""

    prior: Annotated[float | None, arg(help=texts_of(Scoring)["prior"])] = None
    relative_prior: Annotated[bool, arg(help=texts_of(Prior)["relative"])] = Prior.relative
    prior_groups: CARRIED = dataclasses.field(default_factory=dict, metadata={HIDDEN: True})

    def given_nuisances(self) -> Nuisances:
        """Unknowns of views as these options name them.

        Raises:
            ValueError: If one is unknown, or a standard deviation out of range.
        """
        return Nuisances(**{name: getattr(self, name) for name in _UNKNOWN})

    def given_prior(self) -> Prior | None:
        """lambda as these options name it; None where they leave it to the criterion.

        Raises:
            ValueError: If it is negative, infinite or NaN.
        """
        given = Prior.given(self.prior, self.relative_prior)
        if not self.prior_groups:
            return given
        return dataclasses.replace(given or Prior(), groups=self.prior_groups)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparing(Informed, Around, Views, Lenses):
    """Options of commands that compare views with known ones."""

    scene: SceneFile
    train: str | None = None
    """Training views: a data set, a run, a cameras.json or a selection.json; default those of the run."""
    split: Split = "all"
    """Which views of the data set of --candidates or --cameras to take."""
    count: int = 40
    """Number of cameras of an orbit or a dome."""
    time: float | None = None
    """Dynamic scenes: the time of cameras that have none, such as those of an orbit."""
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")  # known views have a lens


_Choice: Any = options_of(SelectionConfig, only=("policy", "criterion", "network", "combine", "weights", "groups"))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choosing(Informed, _Choice):
    """Options of commands that choose views."""

    seed: int = 0
    """Random seed."""
    config: Path | None = None
    """Configuration: a TOML or JSON file, or a run; options of the command line override it (docs/configuration.md)."""

    def scoring(self) -> Scoring:
        """What these options say of scores.

        Raises:
            ValueError: If they cannot be, or not together.
        """
        names = ("criterion", "method", "weights", "groups", "blocks", "network", "combine", "probes")
        given = {"prior": self.given_prior(), "nuisances": self.given_nuisances()}
        return Scoring(**given, **{name: getattr(self, name) for name in names})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clustered:
    """Options of commands that can let other processes compute."""

    scheduler: str | None = None
    """HOST:PORT of a Dask cluster that computes information of views, or whole fits (docs/many-machines.md)."""
    workers: int | None = None
    """Number of worker processes, of one thread each, on this machine; the same as --scheduler without a cluster."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moments:
    """Options of commands that draw a scene that moves."""

    time: str | None = None
    """Dynamic scenes: one time, or a range (0..1) over all views; default that of each view, else all times."""
    view: str | None = None
    """Only the view, or the camera, of this name; with a range of --time, --frames images of it."""
    moving: bool = False
    """Write only moving Gaussians to ply files."""
