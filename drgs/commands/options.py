"""The options of every command: a frozen dataclass each, whose fields define name, type, default and help.

The name of a field is that of the option, its type what may be chosen, and `option` has its default, text and range;
`part` holds a record of the package, whose fields are options in the same way (`drgs.checks.records`). The command
line, its help and configuration files are read from these alone (`command_line.py`). Imports nothing heavy: `drgs
--help` reads it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from drgs.checks.records import check_ranges, option, options_in, part, same_option
from drgs.cluster.options import check_options
from drgs.commands.values import (
    ORBIT_KEYS,
    OrbitShape,
    check_color,
    parsed,
    parsed_cells,
    parsed_decibels,
    parsed_formats,
    parsed_orbit,
    parsed_scales,
    seconds_of_budget,
)
from drgs.fitting.config import COUNT, SEED, FitConfig, SelectionConfig, UndistortUse, check_amount
from drgs.fitting.renderers import AUTO, own_preset
from drgs.information.choices import POLICIES, check_named
from drgs.information.region import RegionText
from drgs.information.scoring import Scoring
from drgs.meshing.options import MeshOptions
from drgs.settings import Preset, RenderSettings
from drgs.studies.protocols import ExperimentName, ProtocolName, StudyScale

if TYPE_CHECKING:
    from drgs.cluster.workers import Cluster

Split = Literal["all", "train", "test"]

SIDE = (1, 16_384)  # pixels; a mistyped size shall not ask for terabytes
VIEWS = (1, 10_000)  # views of one command; more is a typing error

of_views = functools.partial(option, heading="Views")
"""An option of a command that says which views it takes."""


def _scene() -> Any:
    """The scene of a command, its first argument."""
    return option(
        help="A run folder, or Gaussians: .ply, .spz, .splat, .ksplat, .sog, .glb and .pt, a SOG folder or the folder "
        "of a trainer (INRIA's, gsplat's, splatfacto).",
        positional=True,
    )


# ------------------------------------------------------------------------------- what several commands have


@dataclasses.dataclass(frozen=True, kw_only=True)
class Common:
    """Options that every command has."""

    heading: ClassVar[str] = "Machine"

    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb"] = option(
        "auto", "Backend; auto follows DRGS_VARIANT, then CUDA if it works, else LLVM."
    )
    threads: int | None = option(None, "Threads of Dr.Jit and torch; default DRGS_THREADS, else every usable core.")
    quiet: bool = option(False, "Print only warnings and errors; results are in the files.")
    debug: bool = option(False, "Show the traceback of an error.")

    def __post_init__(self) -> None:
        check_ranges(self)

    def say(self, text: str) -> None:
        """Print a line, unless --quiet is given."""
        if not self.quiet:
            print(text, flush=True)

    @classmethod
    def values(cls, given: Mapping[str, Any], line: Collection[str]) -> dict[tuple[str, ...], Any]:
        """Path of a field -> its value, as `drgs.checks.records.nested` makes these options of them.

        Args:
            given: Name of an option -> its value, of a file of --config and of the command line, which wins.
            line: Those that the command line names.
        Raises:
            ValueError: If options contradict each other.
        """
        return {options_in(cls)[name].path: value for name, value in given.items()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """Options of commands that render."""

    heading: ClassVar[str] = "Rendering"

    preset: Preset = option("exact", "Preset of render settings.")
    overrides: tuple[str, ...] = option(
        (), "Replace one render setting, e.g. order=ray.", repeat=True, metavar="KEY=VALUE", flag="set"
    )
    tolerance: float | None = option(
        None,
        "Error of colors that cut-offs may make, e.g. 1e-3, in place of those of --preset exact: faster, with a bound.",
        rare=True,
    )
    draws_presets: ClassVar[bool] = False  # several, some of which may not have what --set says

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.draws_presets:
            self.replaced()
        else:
            self.settings()

    def settings(self) -> RenderSettings:
        """The `RenderSettings` that --preset and --set describe.

        Raises:
            ValueError: If an override is no KEY=VALUE, names no field or has the wrong type.
        """
        return self._settings

    @functools.cached_property
    def _settings(self) -> RenderSettings:
        return RenderSettings.preset(self.preset, **self.replaced())

    def replaced(self) -> dict[str, Any]:
        """The fields that --set and --tolerance replace.

        Raises:
            ValueError: If one is no KEY=VALUE, names no field or has the wrong type.
        """
        fields = parsed(self.overrides)
        return fields if self.tolerance is None else {**fields, "tolerance": self.tolerance}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Data:
    """Options of commands that load data sets."""

    heading: ClassVar[str] = "Data"

    strict: bool = option(
        False,
        "Refuse a data set with missing images; by default they are left out, and at least 3 must remain.",
        rare=True,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimedData(Data):
    """Options of commands that load data sets of one time or of several."""

    heading: ClassVar[str] = "Data"

    times: int | None = option(
        None,
        "Number of frames of each synchronous camera, evenly spaced in its video; default that of the run, else 40.",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views(TimedData):
    """Options of commands that take some of the views of a data set."""

    heading: ClassVar[str] = "Data"

    test_cameras: tuple[str, ...] | None = option(
        None,
        "Synchronous cameras to hold out at all times (cam00,cam05), or none; default those of the run, else "
        "the first.",
        commas=True,
        none="none",
        metavar="CAMERA,CAMERA|none",
        rare=True,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lenses:
    """Options of commands that can look through lenses."""

    heading: ClassVar[str] = "Data"

    undistort: UndistortUse = option(
        "auto",
        "Undistort cameras (on), render through their lenses, by presets along rays (off), or do as the run "
        "did (auto).",
        rare=True,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Orbits(Common):
    """Options of commands that can make cameras around a scene."""

    heading: ClassVar[str] = "Views"

    orbit: tuple[str, ...] = option(
        (),
        "Shape of an orbit or a dome, e.g. elevation=30,span=180; by default chosen from the photographs' cameras.",
        repeat=True,
        metavar="KEY=VALUE",
    )
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(ORBIT_KEYS)

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.orbit_shape  # refuses what cannot be

    @functools.cached_property
    def orbit_shape(self) -> OrbitShape:
        """The shape that --orbit fixes.

        Raises:
            ValueError: If it names what there is not, or a value is out of range.
        """
        return OrbitShape(**parsed_orbit(self.orbit, self.orbit_keys))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SampledViews(Settings, Orbits, Views):
    """Options of commands that look at a scene from a few cameras."""

    draws_presets: ClassVar[bool] = True

    scene: Path = _scene()
    cameras: str | None = of_views(
        None,
        "Views: a data set, a run, a cameras.json or selection.json, or orbit; default those of the run, else orbit.",
    )
    split: Split = of_views("all", "Which views of a data set to take.", rare=True)
    limit: int = of_views(2, "At most this many views, evenly spaced.", within=VIEWS)
    max_pixels: int = option(20000, "Views are reduced to at most this many pixels.", within=COUNT)
    seed: int = option(0, "Random seed.", within=SEED, rare=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Information(Settings):
    """Options of commands that compute Fisher information."""

    scoring: Scoring = part(Scoring(), only=("method", "blocks", "prior", "probes", "nuisances"))
    info_pixels: int | None = same_option(SelectionConfig, "info_pixels", rare=False, heading="Views")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedViews(Information, Orbits, Views, Lenses):
    """Options of commands that compare views with known ones."""

    scene: Path = _scene()
    train: str | None = of_views(
        None, "Training views: a data set, a run, a cameras.json or a selection.json; default those of the run."
    )
    split: Split = of_views("all", "Which views of the data set of --candidates or --cameras to take.", rare=True)
    count: int = of_views(40, "Number of cameras of an orbit or a dome.", within=VIEWS)
    time: float | None = of_views(
        None, "Dynamic scenes: the time of cameras that have none, such as those of an orbit."
    )
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Workers(Common):
    """Options of commands that can let other processes compute."""

    heading: ClassVar[str] = "Machine"

    scheduler: str | None = option(
        None,
        "HOST:PORT of a Dask cluster that computes information of views, or whole fits (docs/many-machines.md).",
        rare=True,
    )
    workers: int | None = option(
        None,
        "Number of worker processes, of one thread each, on this machine; the same as --scheduler without a cluster.",
        rare=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_options(self.scheduler, self.workers)

    def cluster(self) -> AbstractContextManager[Cluster | None]:
        """The workers that they name, for the length of a block; None where they name none: then Dask is not loaded."""
        if self.scheduler is None and self.workers is None:
            return contextlib.nullcontext()
        from drgs.cluster.connect import opened

        return opened(self.scheduler, self.workers)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneTimes:
    """Options of commands that draw a scene that moves."""

    time: str | None = of_views(
        None, "Dynamic scenes: one time, or a range (0..1) over all views; default that of each view, else all times."
    )
    view: str | None = of_views(
        None, "Only the view, or the camera, of this name; with a range of --time, --frames images of it."
    )
    moving: bool = option(False, "Write only moving Gaussians to ply files.", rare=True)


# ------------------------------------------------------------------------------------------ commands


@dataclasses.dataclass(frozen=True, kw_only=True)
class Info(Common):
    """Report backend, libLLVM, CUDA, threads and package versions."""

    json: bool = option(False, "Print JSON.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Render(Settings, Orbits, Views, SceneTimes, Lenses):
    """Render a file of Gaussians, or a finished run, to pictures or a video."""

    scene: Path = _scene()
    cameras: str | None = of_views(
        None,
        "Views: a data set, a run, a cameras.json or selection.json, or orbit; default orbit, or with --view the run.",
    )
    output: Path = option(
        Path("out/render"),
        "Folder for the images, or one file: a video NAME.mp4 or .webm, or one view NAME.png, .jpg or .exr.",
        short="o",
    )
    width: int | None = option(
        None,
        "Image width in pixels; default that of the camera; 640 for an orbit or a flight, 2048 for a panorama.",
        heading="Rendering",
        within=SIDE,
    )
    height: int | None = option(
        None, "Image height in pixels; default that of the camera.", heading="Rendering", within=SIDE
    )
    path: Path | None = option(
        None,
        "Camera path: a flight.json saved by drgs view, or a camera_path.json of Nerfstudio's viewer (docs/view.md).",
        rare=True,
    )
    panorama: bool = option(
        False,
        "Panoramas (360 by 180 degrees, upright) at the places of the cameras; default that of the middle photograph.",
        rare=True,
    )
    frames: int | None = of_views(
        None,
        "Number of images of an orbit, a flight or a range of --time; default 60, for a flight by its seconds.",
        within=(1, 100_000),
    )
    duration: float | None = option(
        None,
        "Seconds of the video of an orbit, a flight or a range of --time, instead of --frames.",
        rare=True,
        within=(1e-3, 86_400),
    )
    format: str | None = option(
        None, "List of png, jpg, exr, webm, mp4 and ply (all Gaussians at each time), by commas; default png, or by -o."
    )
    fps: float | None = option(
        None,
        "Frames a second of the video; default 24, for a flight the rate in its file.",
        rare=True,
        within=(1e-3, 240),
    )
    depth: bool = option(False, "Write color-mapped depth too; exr files hold it anyway.")
    features: bool = option(False, "Write images of the semantic features too, three principal components as colors.")
    labels: bool = option(False, "Write images of the classes too, for a run that was fitted with classes.")
    overlay: bool = option(False, "Write images of the classes over the colors too.", rare=True)
    split: Split = of_views("all", "Which views of a data set to take.", rare=True)
    limit: int | None = of_views(None, "At most this many views.", within=COUNT)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.format is not None:
            parsed_formats(self.format)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Information, Orbits, Views):
    """Look at a run or a file of Gaussians in the browser, also during a fit."""

    scene: Path = _scene()
    train: str | None = of_views(
        None,
        "Training views to display: a data set, a run, a cameras.json or selection.json; default those of the run.",
    )
    selection: Path | None = of_views(
        None,
        "Scores of cameras, a file that drgs select wrote; default those of the run, if it chose its views, or of drgs"
        " capture --more.",
    )
    scoring: Scoring = part(
        Scoring(blocks=("geometry", "backdrop")), only=("method", "blocks", "prior", "probes", "nuisances")
    )
    max_pixels: int = option(
        500000, "Images rendered by drgs have at most this many pixels, also in a larger window.", within=(100, 1 << 24)
    )
    host: str = option(
        "127.0.0.1",
        "Address to listen at; 0.0.0.0: all addresses of this machine, for other machines, which then need a token.",
    )
    port: int = option(8080, "Port to listen at; 0: any free port.", within=(0, 65_535))
    token: str | None = option(
        None, "Token that browsers must send; default none on this machine, else a random one, which is printed."
    )
    open: bool = option(False, "Open the page in a browser.")
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(Workers, Data):
    """Fit Gaussians to photographs with known cameras."""

    data: Path = option(
        help="Data set: COLMAP, transforms.json, LLFF, Replica, Neu3D (cam*.mp4), train_meta.json, folders cam00, ...",
        positional=True,
    )
    output: Path = option(help="The run folder.", short="o")
    config: Path | None = option(
        None,
        "Configuration: a TOML or JSON file, or a run; options of the command line override it "
        "(docs/configuration.md).",
    )
    resume: bool = option(False, "Continue from the last checkpoint in the run folder.")
    views: Literal["all", "active"] = of_views(
        "all", "Fit to all training views, or start with a few and choose more during the fit (active; options below)."
    )
    report: bool = option(True, "Leave out report.html, which a fit ends with.", rare=True)
    fit: FitConfig = part(FitConfig())
    preset: Preset | None = option(
        None,
        "Fit for the renderer of this name alone; with several renderers in --for, render previews and views by it.",
        heading="Rendering",
    )
    overrides: tuple[str, ...] = option(
        (),
        "Replace one render setting, e.g. order=ray.",
        repeat=True,
        metavar="KEY=VALUE",
        flag="set",
        heading="Rendering",
        rare=True,
    )
    background: tuple[float, float, float] | None = option(
        None,
        "Background color: RGB in [0, 1]; default black, or for photographs with transparency as "
        "docs/datasets.md says.",
        heading="Rendering",
    )

    @classmethod
    def values(cls, given: Mapping[str, Any], line: Collection[str]) -> dict[tuple[str, ...], Any]:
        """As for every command, with the render settings of the fit, and its selection with --views active alone."""
        values = super().values(given, line)
        if any(text.startswith("background=") for text in given.get("overrides", ())):
            raise ValueError("--set background: must be --background here, which photographs are composited on as well")
        background = given.get("background") or RenderSettings.background
        check_color("--background", background)
        renderers, preset = given.get("renderers", AUTO), given.get("preset")
        if renderers == AUTO and preset == "fast":
            values["fit", "renderers"] = ("fast",)  # named, it is not what `auto` means
        settings = RenderSettings.preset(preset or own_preset(renderers), **parsed(given.get("overrides", ())))
        values["fit", "settings"] = settings.replace(background=background)
        if given.get("views") == "active":
            return {("fit", "selection"): SelectionConfig(), **values}
        if given.get("scheduler") is not None or given.get("workers") is not None:
            raise ValueError(
                "fit: --scheduler and --workers must have --views active, got --views all; workers compute what "
                "candidates tell, the fit itself is one process"
            )
        for name in line if "config" not in given else ():  # a file may well say more
            one = options_in(cls)[name]
            if one.path[:2] == ("fit", "selection") and given[name] != one.default:
                raise ValueError(
                    f"fit: {one.flag} must have --views active, got --views all; add it or drop {one.flag}"
                )
        return {path: value for path, value in values.items() if path[:2] != ("fit", "selection")}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Common, Data):
    """Measure a run on held-out views: PSNR, SSIM, FLIP, and LPIPS if weights are given."""

    run: Path = option(help="A run folder.", positional=True)
    split: Split = of_views("test", "Which views to measure.")
    preset: Literal["all", Preset] | None = option(
        None,
        "Further renderers to measure with; default those that the run was fitted for, and gsplat.",
        heading="Rendering",
    )
    scale: float = option(
        1.0,
        "Factor of width and height of the images over those of the fit, up to the size of the photographs.",
        heading="Rendering",
        within=(1, 1000),
    )
    lpips_weights: Path | None = option(
        None,
        "torchvision's AlexNet or VGG16 (docs/install.md names the files), for LPIPS; needs pip install 'drgs[lpips]'.",
        heading="Data",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write a report of a fit as one HTML file: curves, views, picks, maps, timings, and the command."""

    run: Path = option(help="A run folder; the fit may still run, or have been stopped.", positional=True)
    output: Path | None = option(
        None,
        "Output HTML file; default report.html in the run folder. While a fit writes there, name another place.",
        short="o",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share(Views, Common):
    """Write a run or a file of Gaussians as one HTML page that opens from disk, on a phone too."""

    scene: Path = _scene()
    output: Path | None = option(
        None, "Output HTML file; default scene.html in the run folder, for a file its name with .html.", short="o"
    )
    train: str | None = of_views(
        None,
        "Training views of a file of Gaussians, for the page's cameras and expected error: a data set, a run, a "
        "cameras.json.",
    )
    selection: Path | None = of_views(
        None,
        "Photographs to take next, a file that drgs select wrote; default those of the run, if it chose its views, or"
        " of drgs capture --more.",
    )
    uncertainty: bool = option(True, "Leave out the layer of the expected error (docs/uncertainty.md).")
    moments: int = option(
        12, "Dynamic scenes: number of times to store; the page interpolates linearly between them.", within=(2, 200)
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Select(ComparedViews, Workers):
    """Rank cameras by what their views would add to a run, or to a file of Gaussians."""

    candidates: str = of_views(
        help="A data set or a run (its views without the training views), a cameras.json or selection.json, orbit,"
        " or dome.",
        metavar="dome|orbit|PATH",
    )
    k: int = of_views(1, "Number of views to pick, one after the other.", short="k", within=COUNT)
    halving: bool = of_views(
        True,
        "Score every candidate by all of its pixels; by default, for a single pick from large views, only those that a "
        "quarter of the pixels puts within a tenth of the best (docs/information.md).",
        rare=True,
    )
    region: str | None = same_option(SelectionConfig, "region", rare=False, heading="Views")
    refine: int = option(
        0,
        "Move each pick to a better pose near it, by scoring at most this many further cameras; 0: keep it.",
        rare=True,
    )
    refine_box: str | None = option(
        None,
        "X0,Y0,Z0,X1,Y1,Z1: box for --refine, world units; default the box around candidates and training views.",
        rare=True,
    )
    output: Path = option(Path("out/select.json"), "The JSON file.", short="o")
    preset: Preset = option(
        "fast",
        "Preset of render settings; fast ranks like exact in a fraction of the time (docs/tradeoff.md).",
        heading="Rendering",
    )
    policy: str = same_option(SelectionConfig, "policy", heading="Views")
    scoring: Scoring = part(Scoring())
    config: Path | None = same_option(Fit, "config")
    seed: int = option(0, "Random seed.", within=SEED, rare=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_named("select", POLICIES, self.policy)
        if self.region is not None:
            RegionText.of(self.region)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fisher(ComparedViews):
    """Write where a scene is wrong, the Fisher information of training views about every Gaussian, and maps of both."""

    cameras: str | None = of_views(
        None,
        "Views for maps: a data set, a run, a cameras.json or selection.json, orbit or dome; default training views.",
    )
    output: Path = option(
        Path("out/fisher"), "Folder for information.safetensors, fisher.json and the maps.", short="o"
    )
    limit: int = of_views(4, "At most this many views for maps, evenly spaced.", within=VIEWS)
    region: str | None = same_option(
        SelectionConfig,
        "region",
        rare=False,
        help="Also report results of the pixels alone that show this part of the scene: a box or a sphere (world"
        " coordinates), what masks of some photographs show, or a class of a scene with labels.",
        heading="Views",
    )
    pose: bool = option(False, "Also report the information of each of these views about its own pose, a 6x6 matrix.")
    maps: bool = option(
        False, "Also write an image of each view side by side with its maps of moments, of fisherrf and of every block."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.region is not None:
            RegionText.of(self.region, "fisher")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(Settings, Orbits, Views, Lenses):
    """Find objects by text: write masks of views, and a PLY of the Gaussians of the objects, or of all others."""

    scene: Path = option(help="A run that was fitted with semantics, or a 3DGS PLY with features.", positional=True)
    classes: tuple[str, ...] = option(
        (), "Name of a class of the run; may be repeated.", repeat=True, metavar="NAME", flag="class"
    )
    text_embedding: Path | None = option(
        None, "Embeddings of texts by the teacher's text encoder: .npy or .pt, of shape (C,) or (K, C)."
    )
    threshold: float | None = option(
        None, "Least score: probability of a class, or cosine of an embedding; default the largest wins."
    )
    temperature: float | None = option(
        None, "Temperature of the softmax over cosines; default 0.01, that of CLIP.", rare=True
    )
    decoder: Path | None = option(
        None, "Decoder for a PLY, a decoder_chkpnt*.pth of Feature 3DGS; a run has its own.", rare=True
    )
    remove: bool = option(False, "Write all Gaussians except the selected ones.")
    preset: Preset = option("fast", "Preset of render settings.", heading="Rendering")
    cameras: str | None = same_option(SampledViews, "cameras")
    split: Split = of_views("all", "Which views of a data set to take.", rare=True)
    limit: int = of_views(4, "At most this many views for masks, evenly spaced.", within=VIEWS)
    max_pixels: int | None = option(
        None, "Views are reduced to at most this many pixels; default that of the fit.", within=COUNT
    )
    output: Path = option(
        Path("out/query"), "Folder for masks, images, query.json, and selected.ply or (--remove) rest.ply.", short="o"
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Write Gaussians in another format: .ply, .spz, .sog, .splat, .compressed.ply or .glb (KHR_gaussian_splatting)."""

    scene: Path = _scene()
    out: Path = option(help="Output file; its suffix is the format.", positional=True)
    as_stored: bool = option(
        False, "Do not turn the axes of an .spz: some programs write the axes of PLY files instead of the format's."
    )
    time: float | None = of_views(None, "Dynamic scenes: the time at which Gaussians are written.")
    uncertainty: Path | None = option(
        None, "information.safetensors of drgs fisher: adds a column of standard deviations for each group to the PLY."
    )
    prior: float = of_views(
        1.0, "For --uncertainty: prior information about every parameter (lambda), as in the maps of drgs fisher."
    )
    labels: bool = option(
        False, "Add a column with the class of each Gaussian to the PLY, for a run that was fitted with classes."
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prune(Settings, Views, Lenses):
    """Remove the Gaussians that the photographs need least, and say what it costs in every renderer."""

    scene: Path = _scene()
    output: Path = option(
        help="Output file, whose suffix is the format (docs/files.md); of a run also a folder, for a smaller run.",
        short="o",
    )
    data: str | None = of_views(
        None, "Photographs of the scene: a data set or a run, or a cameras.json without any; default those of the run."
    )
    keep: float | None = option(None, "Share of the Gaussians to keep, of those that the views show, e.g. 0.3.")
    loss: str | None = option(
        None, "Remove as many as the mean PSNR of the training photographs may fall by, e.g. 0.1dB.", metavar="DB"
    )
    region: str | None = same_option(
        SelectionConfig,
        "region",
        rare=False,
        help="Part of the scene whose pixels count: a box or a sphere (world coordinates), what masks of some"
        " photographs show, or a class of a scene with labels. What is elsewhere goes first; default all.",
        heading="Views",
    )
    unseen: Literal["keep", "remove"] = option("keep", "What becomes of Gaussians that no training view shows.")
    refit: int | None = option(
        None, "Fit the Gaussians that are left to the photographs again, for so many steps.", within=COUNT
    )
    rounds: int | None = option(
        None, "Number of rounds in which they are removed, default 5; more cost less PSNR, and more time.", within=COUNT
    )
    max_pixels: int | None = option(
        None, "Views are reduced to at most this many pixels; default that of the fit, or 130000.", within=COUNT
    )
    preset: Preset = option(
        "fast",
        "Preset that errors are computed with; fast removes what exact does in a fraction of the time.",
        heading="Rendering",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_amount("prune", self.keep, None if self.loss is None else parsed_decibels(self.loss))
        if self.region is not None:
            RegionText.of(self.region, "prune")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(Settings, Views, Lenses):
    """Make a triangle mesh with colors from the depth of a run in the views that it was fitted to."""

    scene: Path = _scene()
    output: Path = option(help="Output file: .ply, .glb or .obj.", short="o")
    meshing: MeshOptions = part(MeshOptions())
    cameras: str | None = of_views(
        None,
        "Views whose depth is used: a data set, a run or a cameras.json; default those that the run was fitted to.",
    )
    info_pixels: int | None = same_option(Prune, "max_pixels")
    limit: int | None = of_views(None, "At most this many views, evenly spaced.", within=COUNT)
    time: float | None = of_views(None, "Dynamic scenes: the time of the surface.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Crossval(SampledViews):
    """Compare a rasterizer's image and gradients with a reference and name differences, by parameter group."""

    rasterizer: str = option(
        "drgs:ewa", "drgs:ewa or drgs:PRESET, gsplat, package.module:function, or a dump (.npz, .safetensors)."
    )
    preset: Literal["auto", Preset] = option(
        "auto", "Model that the rasterizer implements; auto: the preset with the nearest image.", heading="Rendering"
    )
    ladder: bool = option(True, "Leave out which approximations of the model cause its difference from exact.")
    strict: bool = option(
        False, "Fail also for other conventions, known deviations and missing images of a data set.", heading="Data"
    )
    export: Path | None = option(
        None, "Only write scene, cameras and cotangents to this .npz, for a rasterizer on another machine."
    )
    output: Path = option(Path("out/crossval"), "Folder for report.html and crossval.json.", short="o")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tradeoff(SampledViews):
    """Measure time and errors (image, gradient, information) of every accuracy setting on a scene."""

    max_error: tuple[float, ...] = option(
        (0.0001, 0.001, 0.01),
        "Error budgets: for each, the fastest setting whose errors are all below it is recommended.",
    )
    repeats: int = option(5, "Rounds of timing, in each of which all settings are timed in turn.", within=(1, 1000))
    seconds: float = option(
        300.0,
        "Seconds for timing the best settings on views of full size; with less time the views are smaller.",
        within=(1, 1e6),
    )
    output: Path = option(Path("out/tradeoff"), "Folder for tradeoff.json, tradeoff.md and the plot.", short="o")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stress(Common):
    """Test the renderer on extreme scenes on this machine and print its errors, compared with a float64 oracle."""

    match: str = option("", "Run only the cases with this text in their name.")
    output: Path | None = option(None, "Folder for stress.json and stress.md; by default none is written.", short="o")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capture(Common):
    """Make a scene from photographs or videos in one command: frames, poses, fit, report; can be resumed."""

    paths: tuple[Path, ...] = option(
        (),
        "Photographs, videos, folders of both, or one data set that has poses; none with --more.",
        positional=True,
        metavar="PATH",
    )
    output: Path = option(help="The run folder; photographs and poses are in its folder capture.", short="o")
    budget: str | None = option(
        None,
        "Time for the whole command (90s, 10min, 2h), from which sizes and steps follow; default those of drgs fit.",
    )
    frames: int = of_views(150, "At most this many frames of all videos together.")
    masks: str | None = option(
        None,
        "Masks of an object that was turned or moved: a folder (NAME.png, white is kept), or alpha, the alpha"
        " channels.",
    )
    resume: bool = option(
        False, "Continue a command that was stopped, with the same options, and the same files or none."
    )
    add: bool = option(
        False,
        "Add photographs of the same scene to the run and continue the fit (or, if they are many, begin it again).",
    )
    more: bool = option(
        False, "Print which photographs to take next: where to stand, where to look, and how much they would tell."
    )
    k: int = of_views(5, "Number of photographs that --more suggests.", short="k", within=COUNT)
    region: str | None = same_option(SelectionConfig, "region", rare=False, heading="Views")
    length: str | None = option(
        None, "Measured distance of two photographs, 'IMG_0001 IMG_0004 1.5 m', so that --more prints meters."
    )
    seed: int = option(0, "Random seed.", within=SEED)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.budget is not None:
            seconds_of_budget(self.budget)
        if self.region is not None:
            RegionText.of(self.region, "capture")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sfm(Common):
    """Recover cameras and points from plain photographs or videos (COLMAP on the CPU)."""

    paths: tuple[Path, ...] = option(
        help="Folders of photographs, or videos, of which sharp frames with parallax are taken.",
        positional=True,
        metavar="PATH",
    )
    output: Path = option(help="Folder for the data set.", short="o")
    frames: int = of_views(150, "At most this many frames of all videos together.")
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = option(
        "SIMPLE_RADIAL", "COLMAP's camera model; photographs of one size and focal length share one camera."
    )
    matcher: Literal["auto", "exhaustive", "sequential", "retrieval"] = option(
        "auto",
        "Match all pairs, neighbors by name (video), or those and the most similar images; auto: all pairs of"
        " up to 60.",
    )
    masks: str | None = same_option(Capture, "masks")
    seed: int = option(0, "Random seed.", within=SEED)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Teach(Common, TimedData):
    """Add a teacher's feature maps, by a local CLIP model, and text embeddings to a data set."""

    data: Path = option(
        help="Data set; files are written into its folder, where drgs fit finds them, and none is replaced.",
        positional=True,
    )
    model: Path = option(
        help="Folder of a CLIP model as transformers saves it; needs pip install 'drgs[teacher]'. Nothing is "
        "downloaded.",
    )
    classes: str | None = option(
        None, "Class names, with commas between, or a file (.txt, .json); default those of the data set."
    )
    size: str | None = option(
        None, "WIDTHxHEIGHT of a feature map; default 80 along the longer side, in the photograph's shape."
    )
    scales: str = option(
        "0.75,1,1.5", "Scales of the photographs to average over; at 1 the short side is twice the model's image size."
    )
    flip: bool = option(
        True, "Leave out the mirrored photographs, whose maps are averaged with the others; takes half the time."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        parsed_scales(self.scales)
        if self.size is not None:
            parsed_cells(self.size)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene(Common):
    """Make a synthetic data set by path tracing: a room, a dynamic kitchen or hall, a still life, a phone capture."""

    name: Literal["room", "kitchen", "hall", "still_life", "capture"] = option(
        help="Room, kitchen and hall have classes, points and teacher's maps; kitchen and hall are dynamic.",
        positional=True,
    )
    output: Path = option(help="Folder for the data set; an interrupted command is continued there.", short="o")
    size: str | None = option(
        None, "WIDTHxHEIGHT of the images in pixels; default 320x240; 240x180 (capture, kitchen), 160x120 (hall)."
    )
    views: int | None = of_views(None, "Number of images; default 75 (room), 32 (still_life) or 28 (capture).")
    cameras: int | None = of_views(
        None,
        "Number of video cameras (kitchen, hall); default 15, 12. cam00, in the middle of their arc, is the test view.",
    )
    times: int | None = option(None, "Number of frames of each camera (kitchen, hall); default 40, 12.", heading="Data")
    seed: int = option(
        0, "Random seed of shapes, textures, motions, cameras, light paths and simulated errors.", within=SEED
    )
    spp: int | None = option(
        None, "Samples (light paths) a pixel; default 25 (room), 16 (kitchen, hall), 30 (still_life), 25 (capture)."
    )
    teacher_size: str | None = option(
        None, "WIDTHxHEIGHT of the teacher's feature maps; default 80x60 (room), 60x45 (kitchen), 40x30 (hall)."
    )
    test_every: int | None = option(None, "Hold out every n-th view (room); default 5, which is 15 of 75 views.")
    free: bool = option(
        False,
        "Cameras anywhere in free space, looking anywhere, a third of them at a surface 20 cm away (not of capture); "
        "in kitchen and hall each takes one photograph, at one of the times.",
        heading="Views",
    )
    exposure: Literal["auto", "fixed"] | None = option(
        None, "Exposure and white balance (capture): automatic and drifting (auto, the default), or the same for all."
    )
    wall: Literal["white", "paper"] | None = option(
        None, "Wall behind the table (capture): white without texture (default), or papered."
    )
    shadow: bool = option(True, "Leave out the photographer's shadow, which is in some photographs (capture).")
    passer_by: bool = option(True, "Leave out the passer-by, who is in some photographs (capture).")
    pose_error: str | None = option(
        None, "DEGREES,METERS of simulated errors of training poses (capture); default 0.4,0.006; 0,0 for none."
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce(Workers):
    """Compare policies of view selection on synthetic scenes or on your data, as arXiv 2512.22771 does."""

    what: ExperimentName = option(
        help="Study: policies on static scenes, dynamic scenes or captures, values of lambda (prior), or blocks.",
        positional=True,
    )
    output: Path = option(
        help="Folder for scenes, runs, rows.jsonl, tables and figures; finished fits there are kept.", short="o"
    )
    data: tuple[Path, ...] = option(
        (), "Data set instead of the synthetic scenes; may be repeated.", repeat=True, metavar="DATA"
    )
    scale: StudyScale = option(
        "small",
        "Size of fits and scenes: minutes (tiny), hours (small: 1,400 steps, dynamic 900), or as in the paper.",
        heading="Rendering",
    )
    seeds: int = option(
        3, "Number of sets of initial views of each static scene; dynamic: of kitchens, or of fits of each data set."
    )
    protocol: ProtocolName = option(
        "paper",
        "Initial points: of all views (paper), or of picked views only (blind, and variants; docs/glossary.md).",
    )
    policies: tuple[str, ...] = option(
        (),
        "Run only this row of the table, by its label in rows.jsonl (docs/next-views.md); may be repeated.",
        repeat=True,
        metavar="LABEL",
        flag="policy",
    )
    test_every: int = option(8, "Hold out every n-th view of --data, by name, unless its files state a split.")
    test_offset: int = option(0, "Index of the first held-out view.")
    lpips_weights: Path | None = option(
        None, "torchvision's AlexNet or VGG16, to measure LPIPS, too; needs pip install 'drgs[lpips]'.", heading="Data"
    )
    config: Path | None = option(
        None, "Configuration that replaces that of --scale: a TOML or JSON file, or a run (docs/configuration.md)."
    )
    figures: bool = option(True, "Leave out the comparison sheet and the maps at the end.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """Make a still life, fit it, render it and compare presets: a tour in minutes."""

    output: Path = option(Path("out/demo"), "Folder for pictures and tables.", short="o")
    quick: bool = option(False, "Take half a minute, with poor images, to see that everything runs.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cite(Common):
    """Print BibTeX of what a run used, by its config.json; without a run, of what drgs always uses."""

    run: Path | None = option(None, "A run folder; the fit may still run.", positional=True)


COMMANDS: dict[str, type[Common]] = {
    "info": Info,
    "render": Render,
    "view": View,
    "fit": Fit,
    "eval": Eval,
    "report": Report,
    "share": Share,
    "select": Select,
    "fisher": Fisher,
    "query": Query,
    "convert": Convert,
    "prune": Prune,
    "mesh": Mesh,
    "crossval": Crossval,
    "tradeoff": Tradeoff,
    "stress": Stress,
    "capture": Capture,
    "sfm": Sfm,
    "teach": Teach,
    "scene": Scene,
    "reproduce": Reproduce,
    "demo": Demo,
    "cite": Cite,
}
"""Command -> its options, in the order of `drgs --help`; the module of drgs.commands of that name does the work."""
