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
    """A data set, a run, a cameras.json or selection.json, or orbit; default orbit, or with --view the run."""
    output: OutputPath = Path("out/render")
    """Folder for the pictures; or a file: NAME.mp4 or .webm for the film alone, NAME.png, .jpg or .exr for one view."""
    width: int | None = None
    """Image width in pixels; default the camera's, of an orbit or a flight 640, of a panorama 2048."""
    height: int | None = None
    """Image height in pixels; default the camera's."""
    path: Path | None = None
    """A flight through keyframes, as drgs view saves it, or a camera path of Nerfstudio's viewer (docs/view.md)."""
    panorama: bool = False
    """All-round pictures (360 by 180 degrees, upright) from where the cameras are; default the middle photograph's."""
    frames: int | None = None
    """Views of an orbit, a flight, or one camera over a range of --time; default 60, of a flight as it lasts."""
    duration: float | None = None
    """Seconds that the film of an orbit, a flight or a range of --time lasts, instead of --frames."""
    format: str | None = None
    """List of png, jpg, exr, webm, mp4 and ply (all Gaussians at each time), by commas; default png, or as -o ends."""
    fps: float | None = None
    """Frames a second of the video; default 24, of a flight what its file says."""
    depth: bool = False
    """Write color-mapped depth too; exr files hold it anyway."""
    features: bool = False
    """Write pictures of the semantic features too, three principal components as colors."""
    labels: bool = False
    """Write pictures of the classes too, of a run that has been fitted with some."""
    overlay: bool = False
    """Write pictures of the classes over the colors too."""
    split: Split = "all"
    """Which views of a data set."""
    limit: int | None = None
    """At most this many views."""


_ON_THE_WAY = ("schedule", "initial", "start", "add", "every", "pick_points", "restart", "measure")
_Fitted: Any = options_of(FitConfig, without=("settings", "selection"))
_Selecting: Any = options_of(SelectionConfig, only=_ON_THE_WAY)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(_Fitted, _Selecting, Choosing, Clustered, Data):
    """Fit Gaussians to photographs with known cameras."""

    data: Positional[Path]
    """COLMAP, transforms.json (D-NeRF too), LLFF, Replica, Neu3D (cam*.mp4), train_meta.json, or folders cam00, ..."""
    output: OutputPath
    """The run folder."""
    preset: Preset | None = None
    """Render settings of a named system: fit for it alone, or with --for of several draw previews and views by it."""
    resume: bool = False
    """Continue from the last checkpoint in the run folder."""
    background: tuple[float, float, float] = RenderSettings.background
    """RGB in [0, 1] behind everything."""
    views: Literal["all", "active"] = "all"
    """Fit to all training views, or start with a few and choose more on the way (active; the options below)."""
    report: bool = True
    """Write report.html into the run folder at the end, unless --no-report is given, which saves its seconds."""

    def settings(self) -> RenderSettings:
        """As for every command, with the background that the photographs are composited on; without --preset those of
        the renderer that the fit is for, `fast` of several.
        """
        if any(text.startswith("background=") for text in self.overrides):
            raise ValueError("--set background: must be --background here, which photographs are composited on as well")
        check_color("--background", self.background)
        preset = self.preset or own_preset(self.renderers)
        return RenderSettings.preset(preset, **self.replaced()).replace(background=self.background)

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
    """A data set or a run (those of its views that are not known), a cameras.json or selection.json, orbit, or dome."""
    k: Annotated[int, arg(aliases=["-k"])] = 1
    """Views to pick, each given the ones before."""
    refine: int = 0
    """Move each pick to where its view tells more, by scoring so many further cameras at most; 0: it stays."""
    refine_box: str | None = None
    """X0,Y0,Z0,X1,Y1,Z1: where cameras may be moved to, world units; default the box around candidates and known."""
    output: OutputPath = Path("out/select.json")
    """The JSON file."""
    preset: Preset = "fast"
    """Render settings of a named system; fast ranks as exact does, in a fraction of the time (docs)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fisher(Comparing):
    """Write the information that known views have about every Gaussian, and maps of what they leave uncertain."""

    cameras: str | None = None
    """Views to draw maps for: a data set, a run, a cameras.json or selection.json, orbit or dome; default the known."""
    output: OutputPath = Path("out/fisher")
    """Folder for information.safetensors, fisher.json and the maps."""
    limit: int = 4
    """Maps of at most this many views, evenly spaced."""
    pose: bool = False
    """Also report what each of these views says about its own pose, a 6x6 matrix."""
    maps: bool = False
    """Also write each view beside its maps of moments, of fisherrf and of every block, as one picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Informed, Around, Views):
    """Look at a run or a Gaussian PLY in the browser, while it is fitted, too."""

    scene: Positional[Path]
    """A run folder, a 3DGS point_cloud.ply, or Gaussians in another format (docs/files.md)."""
    train: str | None = None
    """Known views, whose cameras are shown: a data set, a run, a cameras.json or selection.json; default the run's."""
    selection: Path | None = None
    """Scores of cameras, as drgs select writes them; default those of the run, if it chose its views."""
    blocks: Annotated[tuple[Block, ...] | None, BLOCKS_TEXT] = ("geometry", "backdrop")
    """What of an image tells, for the map of information: geometry, semantic, deformation, backdrop."""
    max_pixels: int = 500_000
    """Our pictures have at most this many pixels, whatever the window."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0: all of this machine's, for browsers of others, which then need a token."""
    port: int = 8080
    """Port to listen at; 0: any that is free."""
    token: str | None = None
    """What a browser must know; default nothing on this machine, else one that is made up and printed."""
    open: bool = False
    """Open the page in a browser, too."""
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")  # the browser has its own


@dataclasses.dataclass(frozen=True, kw_only=True)
class Crossval(Seen):
    """Compare a rasterizer's image and gradients with ours and name what differs, group by group."""

    rasterizer: str = "drgs:ewa"
    """drgs:ewa or drgs:PRESET, gsplat, package.module:function, or a dump (.npz, .safetensors)."""
    preset: Literal["auto", Preset] = "auto"
    """The model that it claims to compute; auto: the one whose image is nearest."""
    ladder: bool = True
    """Say which approximations make that model differ from the exact one, unless --no-ladder, which saves the time."""
    strict: bool = False
    """Conventions that differ and known deviations fail, too, and so does a data set with images that are missing."""
    export: Path | None = None
    """Only write the scene, the cameras and cotangents to this .npz, for a rasterizer on another machine."""
    output: OutputPath = Path("out/crossval")
    """Folder for report.html and crossval.json."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tradeoff(Seen):
    """Time every accuracy/speed setting on a scene, with its image, gradient and information error."""

    max_error: tuple[float, ...] = (1e-4, 1e-3, 1e-2)
    """Budgets: one setting is recommended for each, the fastest whose errors are all below it."""
    repeats: int = 5
    """Interleaved rounds of timing."""
    seconds: float = 300.0
    """For timing the leading settings on views as large as they are drawn; less time, smaller views."""
    output: OutputPath = Path("out/tradeoff")
    """Folder for tradeoff.json, tradeoff.md and the plot."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(Settings, Around, Views, Lenses):
    """Find what a text means: masks of views, and a PLY of the Gaussians that are it, or of all others."""

    scene: Positional[Path]
    """A run that was fitted with semantics, or a 3DGS PLY with features."""
    classes: Annotated[tuple[str, ...], arg(name="class", metavar="NAME"), UseAppendAction] = ()
    """A class of the run; may be repeated."""
    text_embedding: Path | None = None
    """Embeddings of texts by the teacher's text encoder: .npy or .pt, of shape (C,) or (K, C)."""
    threshold: float | None = None
    """What the score must reach: of classes their probability, of embeddings the cosine; default the largest wins."""
    temperature: float | None = None
    """Cosines are divided by it before the softmax that makes probabilities of them; default 0.01, CLIP's."""
    decoder: Path | None = None
    """Decoder of a PLY, as Feature 3DGS writes it (decoder_chkpnt*.pth); a run has its own."""
    remove: bool = False
    """Write all Gaussians but the selected ones."""
    preset: Preset = "fast"
    """Render settings of a named system."""
    cameras: str | None = None
    """A data set, a run, a cameras.json or selection.json, or orbit; default a run's own, else orbit."""
    split: Split = "all"
    """Which views of a data set."""
    limit: int = 4
    """Masks of at most this many views, evenly spaced."""
    max_pixels: int | None = None
    """Views are reduced to at most this many pixels; default as in the fit."""
    output: OutputPath = Path("out/query")
    """Folder for the masks, pictures, query.json, and selected.ply or (--remove) rest.ply."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Write Gaussians in another format: .ply, .spz, .sog, .splat, .compressed.ply or .glb (KHR_gaussian_splatting)."""

    scene: SceneFile
    out: Positional[Path]
    """The file; its suffix says the format."""
    as_stored: bool = False
    """Of an .spz, keep its axes: some programs write those of PLY files and not those that the format states."""
    time: float | None = None
    """Of a run that moves: the Gaussians as they are then."""
    uncertainty: Path | None = None
    """information.safetensors of drgs fisher: what it leaves uncertain goes into the PLY, a column a group."""
    prior: float = 1.0
    """For --uncertainty: how firmly every number counts as known beforehand (lambda), as in the maps of drgs fisher."""
    labels: bool = False
    """Of a run that was fitted with classes: a column with the class of each Gaussian is added to the PLY."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stress(Common):
    """Run the extremes of the renderer on this machine against the float64 oracle and print their errors."""

    match: str = ""
    """Only the cases with this text in their name."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """Folder for stress.json and stress.md; default none is written."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Common, Data):
    """Measure a run on held-out views: PSNR, SSIM, FLIP, and LPIPS when weights are given."""

    run: Positional[Path]
    """A run folder."""
    split: Split = "test"
    """Which views."""
    preset: Literal["all", Preset] | None = None
    """Renderers to measure with, beside the run's own settings; default those that it was fitted for, and gsplat."""
    scale: float = 1.0
    """Measure pictures this many times as wide and high as those of the fit, up to the photographs' own size."""
    lpips_weights: Path | None = None
    """torchvision's AlexNet or VGG16 (docs/install.md names the files), for LPIPS; needs pip install 'drgs[lpips]'."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write what a fit looked like as one HTML file: curves, views, picks, maps, timings, and how to repeat it."""

    run: Positional[Path]
    """A run folder; the fit may still be going on, or have been stopped."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """The HTML file; default report.html in the run folder. While a fit writes there, name another place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share(Common):
    """Write a run or a file of Gaussians as one HTML page that opens from disk, on a phone too."""

    scene: SceneFile
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """The HTML file; default scene.html in the run folder, of a file the same name with .html."""
    selection: Path | None = None
    """Photographs to take next, as drgs select writes them; default those of the run, if it chose its views."""
    uncertainty: bool = True
    """With a layer of what the photographs leave uncertain, unless --no-uncertainty, which saves the time."""
    moments: int = 12
    """Of a scene that moves: at so many times it is written, the page draws those between on straight lines."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cite(Common):
    """Print BibTeX of what a run used, by its config.json; without a run, of what every use rests on."""

    run: Positional[Path | None] = None
    """A run folder; the fit may still be going on."""
