"""The options of every command: a dataclass each, its docstrings the help texts.

What can be chosen, and what is chosen by default, is read from the record that an option ends up in. Imports nothing
heavy: `drgs --help` reads them all.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, UseAppendAction, arg

from drgs.commands.option_groups import (
    Around,
    Choosing,
    Clustered,
    Common,
    Comparing,
    Data,
    Informed,
    Lenses,
    Moments,
    OutputPath,
    SceneFile,
    Seen,
    Settings,
    Split,
    Views,
)
from drgs.commands.orbit_keys import ORBIT_KEYS
from drgs.commands.overrides import check_color
from drgs.commands.record_options import BLOCKS_TEXT, options_of
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.renderers import AUTO, own_preset
from drgs.guards.records import ways_of
from drgs.information.choices import Block
from drgs.settings import Preset, RenderSettings

__all__ = [
    "Cite",
    "Convert",
    "Crossval",
    "Eval",
    "Fisher",
    "Fit",
    "Info",
    "Query",
    "Render",
    "Report",
    "Select",
    "Share",
    "Stress",
    "Tradeoff",
    "View",
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Info(Common):
    """Report backend, libLLVM, CUDA, threads and package versions."""

    json: bool = False
    """Print JSON."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Render(Settings, Around, Views, Moments, Lenses):
    """Render a file of Gaussians, or a finished run, to pictures or a video."""

    scene: SceneFile
    cameras: str | None = None
    """Views: a data set, a run, a cameras.json or selection.json, or orbit; default orbit, or with --view the run."""
    output: OutputPath = Path("out/render")
    """Folder for the images, or one file: a video NAME.mp4 or .webm, or one view NAME.png, .jpg or .exr."""
    width: int | None = None
    """Image width in pixels; default that of the camera; 640 for an orbit or a flight, 2048 for a panorama."""
    height: int | None = None
    """Image height in pixels; default that of the camera."""
    path: Path | None = None
    """Camera path: a flight.json saved by drgs view, or a camera_path.json of Nerfstudio's viewer (docs/view.md)."""
    panorama: bool = False
    """Panoramas (360 by 180 degrees, upright) at the places of the cameras; default that of the middle photograph."""
    frames: int | None = None
    """Number of images of an orbit, a flight or a range of --time; default 60, for a flight by its seconds."""
    duration: float | None = None
    """Seconds of the video of an orbit, a flight or a range of --time, instead of --frames."""
    format: str | None = None
    """List of png, jpg, exr, webm, mp4 and ply (all Gaussians at each time), by commas; default png, or by -o."""
    fps: float | None = None
    """Frames a second of the video; default 24, for a flight the rate in its file."""
    depth: bool = False
    """Write color-mapped depth too; exr files hold it anyway."""
    features: bool = False
    """Write images of the semantic features too, three principal components as colors."""
    labels: bool = False
    """Write images of the classes too, for a run that was fitted with classes."""
    overlay: bool = False
    """Write images of the classes over the colors too."""
    split: Split = "all"
    """Which views of a data set to take."""
    limit: int | None = None
    """At most this many views."""


_ON_THE_WAY = ("schedule", "initial", "start", "add", "every", "pick_points", "restart", "measure")
_Fitted: Any = options_of(FitConfig, without=("settings", "selection"))
_Selecting: Any = options_of(SelectionConfig, only=_ON_THE_WAY)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(_Fitted, _Selecting, Choosing, Clustered, Data):
    """Fit Gaussians to photographs with known cameras."""

    data: Positional[Path]
    """Data set: COLMAP, transforms.json, LLFF, Replica, Neu3D (cam*.mp4), train_meta.json, folders cam00, ..."""
    output: OutputPath
    """The run folder."""
    preset: Preset | None = None
    """Fit for the renderer of this name alone; with several renderers in --for, render previews and views by it."""
    resume: bool = False
    """Continue from the last checkpoint in the run folder."""
    background: tuple[float, float, float] | None = None
    """Background color: RGB in [0, 1]; default black, or for photographs with transparency as docs/datasets.md says."""
    views: Literal["all", "active"] = "all"
    """Fit to all training views, or start with a few and choose more during the fit (active; options below)."""
    report: bool = True
    """Write report.html into the run folder at the end, unless --no-report is given."""

    def settings(self) -> RenderSettings:
        """As for every command, with the background that the photographs are composited on; without --preset those of
        the renderer that the fit is for, `fast` of several.
        """
        if any(text.startswith("background=") for text in self.overrides):
            raise ValueError("--set background: must be --background here, which photographs are composited on as well")
        background = RenderSettings.background if self.background is None else self.background
        check_color("--background", background)
        preset = self.preset or own_preset(self.renderers)
        return RenderSettings.preset(preset, **self.replaced()).replace(background=background)

    def fit_config(self) -> FitConfig:
        """What these options say of the fit, its selection with --views active.

        Raises:
            ValueError: If an option is out of range, or belongs to --views active and that is missing.
        """
        names = {*ways_of(FitConfig)} & {field.name for field in dataclasses.fields(_Fitted)}
        fields = {name: getattr(self, name) for name in names}
        if self.renderers == AUTO and self.preset == "fast":
            fields["renderers"] = ("fast",)  # asked for by name, it is not the default
        config = FitConfig.of(settings=self.settings(), **fields)
        if self.views != "active" and (self.scheduler, self.workers) != (None, None):
            raise ValueError(
                "fit: --scheduler and --workers must have --views active, got --views all; workers compute what "
                "candidates tell, the fit itself is one process"
            )
        selection = {name: getattr(self, name) for name in ("policy", "info_pixels", *_ON_THE_WAY)}
        if self.views == "active":
            return config.replace(selection=SelectionConfig.of(scoring=self.scoring(), **selection))
        names = {*ways_of(SelectionConfig), "relative_prior"}
        for field in dataclasses.fields(self) if self.config is None else ():  # a file may well say more
            if field.name in names and getattr(self, field.name) != _default(field):
                option = "--" + field.name.replace("_", "-")
                raise ValueError(f"fit: {option} must have --views active, got --views all; add it or drop {option}")
        return config


def _default(field: dataclasses.Field) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Select(Choosing, Clustered, Comparing):
    """Rank cameras by what their views would add to a run, or to a file of Gaussians."""

    candidates: str
    """A data set or a run (its views without the training views), a cameras.json or selection.json, orbit, or dome."""
    k: Annotated[int, arg(aliases=["-k"])] = 1
    """Number of views to pick, one after the other."""
    refine: int = 0
    """Move each pick to a better pose near it, by scoring at most this many further cameras; 0: keep it."""
    refine_box: str | None = None
    """X0,Y0,Z0,X1,Y1,Z1: box for --refine, world units; default the box around candidates and training views."""
    output: OutputPath = Path("out/select.json")
    """The JSON file."""
    preset: Preset = "fast"
    """Preset of render settings; fast ranks like exact in a fraction of the time (docs/tradeoff-fisher.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fisher(Comparing):
    """Write the Fisher information of training views about every Gaussian, and maps of the remaining uncertainty."""

    cameras: str | None = None
    """Views for maps: a data set, a run, a cameras.json or selection.json, orbit or dome; default training views."""
    output: OutputPath = Path("out/fisher")
    """Folder for information.safetensors, fisher.json and the maps."""
    limit: int = 4
    """At most this many views for maps, evenly spaced."""
    pose: bool = False
    """Also report the information of each of these views about its own pose, a 6x6 matrix."""
    maps: bool = False
    """Also write an image of each view side by side with its maps of moments, of fisherrf and of every block."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Informed, Around, Views):
    """Look at a run or a file of Gaussians in the browser, also during a fit."""

    scene: Positional[Path]
    """A run folder, a 3DGS point_cloud.ply, or Gaussians in another format (docs/files.md)."""
    train: str | None = None
    """Training views to display: a data set, a run, a cameras.json or selection.json; default those of the run."""
    selection: Path | None = None
    """Scores of cameras, a file that drgs select wrote; default those of the run, if it chose its views."""
    blocks: Annotated[tuple[Block, ...] | None, BLOCKS_TEXT] = ("geometry", "backdrop")
    """Outputs that count in the map of uncertainty: geometry, semantic, deformation, backdrop."""
    max_pixels: int = 500_000
    """Images rendered by drgs have at most this many pixels, also in a larger window."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0: all addresses of this machine, for other machines, which then need a token."""
    port: int = 8080
    """Port to listen at; 0: any free port."""
    token: str | None = None
    """Token that browsers must send; default none on this machine, else a random one, which is printed."""
    open: bool = False
    """Open the page in a browser."""
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")  # the browser has its own


@dataclasses.dataclass(frozen=True, kw_only=True)
class Crossval(Seen):
    """Compare a rasterizer's image and gradients with a reference and name differences, by parameter group."""

    rasterizer: str = "drgs:ewa"
    """drgs:ewa or drgs:PRESET, gsplat, package.module:function, or a dump (.npz, .safetensors)."""
    preset: Literal["auto", Preset] = "auto"
    """Model that the rasterizer implements; auto: the preset with the nearest image."""
    ladder: bool = True
    """Measure which approximations of that model cause its difference from exact, unless --no-ladder is given."""
    strict: bool = False
    """Fail also for other conventions, known deviations and missing images of a data set."""
    export: Path | None = None
    """Only write scene, cameras and cotangents to this .npz, for a rasterizer on another machine."""
    output: OutputPath = Path("out/crossval")
    """Folder for report.html and crossval.json."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tradeoff(Seen):
    """Measure time and errors (image, gradient, information) of every accuracy setting on a scene."""

    max_error: tuple[float, ...] = (1e-4, 1e-3, 1e-2)
    """Error budgets: for each, the fastest setting whose errors are all below it is recommended."""
    repeats: int = 5
    """Rounds of timing, in each of which all settings are timed in turn."""
    seconds: float = 300.0
    """Seconds for timing the best settings on views of full size; with less time the views are smaller."""
    output: OutputPath = Path("out/tradeoff")
    """Folder for tradeoff.json, tradeoff.md and the plot."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(Settings, Around, Views, Lenses):
    """Find objects by text: write masks of views, and a PLY of the Gaussians of the objects, or of all others."""

    scene: Positional[Path]
    """A run that was fitted with semantics, or a 3DGS PLY with features."""
    classes: Annotated[tuple[str, ...], arg(name="class", metavar="NAME"), UseAppendAction] = ()
    """Name of a class of the run; may be repeated."""
    text_embedding: Path | None = None
    """Embeddings of texts by the teacher's text encoder: .npy or .pt, of shape (C,) or (K, C)."""
    threshold: float | None = None
    """Least score: probability of a class, or cosine of an embedding; default the largest wins."""
    temperature: float | None = None
    """Temperature of the softmax over cosines; default 0.01, that of CLIP."""
    decoder: Path | None = None
    """Decoder for a PLY, a decoder_chkpnt*.pth of Feature 3DGS; a run has its own."""
    remove: bool = False
    """Write all Gaussians except the selected ones."""
    preset: Preset = "fast"
    """Preset of render settings."""
    cameras: str | None = None
    """Views: a data set, a run, a cameras.json or selection.json, or orbit; default those of the run, else orbit."""
    split: Split = "all"
    """Which views of a data set to take."""
    limit: int = 4
    """At most this many views for masks, evenly spaced."""
    max_pixels: int | None = None
    """Views are reduced to at most this many pixels; default that of the fit."""
    output: OutputPath = Path("out/query")
    """Folder for masks, images, query.json, and selected.ply or (--remove) rest.ply."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Write Gaussians in another format: .ply, .spz, .sog, .splat, .compressed.ply or .glb (KHR_gaussian_splatting)."""

    scene: SceneFile
    out: Positional[Path]
    """Output file; its suffix is the format."""
    as_stored: bool = False
    """Do not turn the axes of an .spz: some programs write the axes of PLY files instead of the format's."""
    time: float | None = None
    """Dynamic scenes: the time at which Gaussians are written."""
    uncertainty: Path | None = None
    """information.safetensors of drgs fisher: adds a column of standard deviations for each group to the PLY."""
    prior: float = 1.0
    """For --uncertainty: prior information about every parameter (lambda), as in the maps of drgs fisher."""
    labels: bool = False
    """Add a column with the class of each Gaussian to the PLY, for a run that was fitted with classes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stress(Common):
    """Test the renderer on extreme scenes on this machine and print its errors, compared with a float64 oracle."""

    match: str = ""
    """Run only the cases with this text in their name."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Folder for stress.json and stress.md; by default none is written."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Common, Data):
    """Measure a run on held-out views: PSNR, SSIM, FLIP, and LPIPS if weights are given."""

    run: Positional[Path]
    """A run folder."""
    split: Split = "test"
    """Which views to measure."""
    preset: Literal["all", Preset] | None = None
    """Further renderers to measure with; default those that the run was fitted for, and gsplat."""
    scale: float = 1.0
    """Factor of width and height of the images over those of the fit, up to the size of the photographs."""
    lpips_weights: Path | None = None
    """torchvision's AlexNet or VGG16 (docs/install.md names the files), for LPIPS; needs pip install 'drgs[lpips]'."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write a report of a fit as one HTML file: curves, views, picks, maps, timings, and the command."""

    run: Positional[Path]
    """A run folder; the fit may still run, or have been stopped."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Output HTML file; default report.html in the run folder. While a fit writes there, name another place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share(Common):
    """Write a run or a file of Gaussians as one HTML page that opens from disk, on a phone too."""

    scene: SceneFile
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Output HTML file; default scene.html in the run folder, for a file its name with .html."""
    selection: Path | None = None
    """Photographs to take next, a file that drgs select wrote; default those of the run, if it chose its views."""
    uncertainty: bool = True
    """Add a layer of the uncertainty that the photographs leave, unless --no-uncertainty is given."""
    moments: int = 12
    """Dynamic scenes: number of times to store; the page interpolates linearly between them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cite(Common):
    """Print BibTeX of what a run used, by its config.json; without a run, of what drgs always uses."""

    run: Positional[Path | None] = None
    """A run folder; the fit may still run."""
