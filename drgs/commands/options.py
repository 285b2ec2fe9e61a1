"""The options of every command: a dataclass each, its docstrings the help texts.

What can be chosen, and what is chosen by default, is read from the record that an option ends up in. Imports nothing
heavy: `drgs --help` reads them all.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from drgs.commands.option_groups import (
    Around,
    Choosing,
    Clustered,
    Common,
    Comparing,
    Data,
    Moments,
    Moving,
    OutputPath,
    SceneFile,
    Seen,
    Settings,
    Split,
    Taught,
    Views,
)
from drgs.commands.overrides import check_color
from drgs.commands.view_options import View
from drgs.fitting.config import (
    ActiveConfig,
    Degree,
    FitConfig,
    InitPoints,
    MaskUse,
    PickPoints,
    Restart,
    Schedule,
    Start,
)
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
class Render(Settings, Around, Views, Moments):
    """Render a file of Gaussians, or a finished run, to pictures or a video."""

    scene: SceneFile
    cameras: str | None = None
    """A data set, a run, a cameras.json or selection.json, or orbit; default orbit, or with --view the run."""
    output: OutputPath = Path("out/render")
    """Folder for the pictures."""
    width: int | None = None
    """Image width in pixels; default the camera's, of an orbit 640."""
    height: int | None = None
    """Image height in pixels; default the camera's."""
    frames: int = 60
    """Views of an orbit, or of one camera over a range of --time."""
    fov: float | None = None
    """Horizontal field of view of an orbit in degrees; default the photographs', else 45."""
    format: str = "png"
    """Comma-separated list of png, exr, webm, and ply: all Gaussians as they are at each time."""
    fps: float = 24.0
    """Frames a second of the video."""
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(Choosing, Clustered, Data, Taught, Moving):
    """Fit Gaussians to photographs with known cameras."""

    data: Positional[Path]
    """COLMAP, transforms.json (D-NeRF too), LLFF, Replica, Neu3D (cam*.mp4), train_meta.json, or folders cam00, ..."""
    output: OutputPath
    """The run folder."""
    preset: Preset = "fast"
    """Render settings of a named system. Train with what will be rendered with: gsplat for viewers of PLY files."""
    max_steps: int = FitConfig.max_steps
    """Optimizer steps."""
    max_pixels: int = FitConfig.max_pixels
    """Images are reduced to at most this many pixels."""
    max_gaussians: int = FitConfig.max_gaussians
    """How many Gaussians there may be."""
    init_points: InitPoints = FitConfig.init_points
    """Initial points: of the training views (views) or of the data set (all); auto: all, or views if --views active."""
    test_every: int = FitConfig.test_every
    """Every n-th view, by name, is held out; 0 holds out none."""
    test_offset: int = FitConfig.test_offset
    """Index of the first of them, below --test-every; a split that the data set itself states wins over both."""
    sh_degree: Degree = FitConfig.sh_degree
    """Highest degree of the view-dependent color."""
    deterministic: bool = FitConfig.deterministic
    """Same seed, same bits; slower. (Images drawn again without gradients differ by 1e-7: docs/numerics.md.)"""
    resume: bool = False
    """Continue from the last checkpoint in the run folder."""
    save_every: int = FitConfig.save_every
    """Steps between checkpoints."""
    save_minutes: float = FitConfig.save_minutes
    """Minutes after which one is written all the same."""
    mask: MaskUse = FitConfig.mask
    """Outside of masks is nothing (object), or something unknown (valid); auto: object if there are mask files."""
    background: tuple[float, float, float] = RenderSettings.background
    """RGB in [0, 1] behind everything."""
    views: Literal["all", "active"] = "all"
    """Fit to all training views, or start with a few and choose more on the way (active; the options below)."""
    schedule: Schedule = ActiveConfig.schedule
    """Pick view by view (views), one camera at each later time (times), or any camera at any (pairs); auto: by data."""
    initial: int = ActiveConfig.initial
    """Views at the start: that of --start, then those farthest away."""
    start: Start = ActiveConfig.start
    """The first of the initial views: the first training view by name, or one that the seed draws."""
    add: int | None = ActiveConfig.add
    """Views to be chosen on the way, others are not read; default 10, or one for every time after the first."""
    every: int | None = ActiveConfig.every
    """Steps before the first pick, and between picks; default 200, with --schedule times or pairs 200 of 17,000."""
    pick_points: PickPoints = ActiveConfig.pick_points
    """Points that a picked view adds: triangulated, and where nothing is yet; auto: none with --init-points all."""
    restart: Restart = ActiveConfig.restart
    """After a pick begin again at points of all views so far: until these are 1,000 (auto), always, or never."""
    measure: tuple[int, ...] = ActiveConfig.measure
    """Numbers of training views at which the held-out views are measured, too, just before the next pick."""
    report: bool = True
    """Write report.html into the run folder at the end, unless --no-report is given, which saves its seconds."""

    def settings(self) -> RenderSettings:
        """As for every command, with the background that the photographs are composited on."""
        if any(text.startswith("background=") for text in self.overrides):
            raise ValueError("--set background: must be --background here, which photographs are composited on as well")
        check_color("--background", self.background)
        return super().settings().replace(background=self.background)

    def active(self) -> ActiveConfig | None:
        """The `ActiveConfig` of --views active, else None.

        Raises:
            ValueError: If an option is out of range, or belongs to --views active and that is missing.
        """
        fields = dataclasses.fields(ActiveConfig)
        if self.views != "active" and (self.scheduler, self.workers) != (None, None):
            raise ValueError(
                "fit: --scheduler and --workers must have --views active, got --views all; workers compute what "
                "candidates tell, the fit itself is one process"
            )
        if self.views == "active":
            return ActiveConfig(**{field.name: getattr(self, field.name) for field in fields})
        for field in fields:
            if getattr(self, field.name) != field.default:
                option = "--" + field.name.replace("_", "-")
                raise ValueError(f"fit: {option} must have --views active, got --views all; add it or drop {option}")
        return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Select(Choosing, Clustered, Comparing):
    """Rank cameras by what their views would add to a run, or to a file of Gaussians."""

    candidates: str
    """A data set or a run (those of its views that are not known), a cameras.json or selection.json, orbit, or dome."""
    k: Annotated[int, arg(aliases=["-k"])] = 1
    """Views to pick, each given the ones before."""
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
class Query(Settings, Around, Views):
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
    fov: float | None = None
    """Horizontal field of view of an orbit in degrees; default the photographs', else 45."""
    output: OutputPath = Path("out/query")
    """Folder for the masks, pictures, query.json, and selected.ply or (--remove) rest.ply."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Write Gaussians in another format: .ply of 3DGS, .spz, or .glb (KHR_gaussian_splatting)."""

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
    lpips_weights: Path | None = None
    """torchvision's AlexNet or VGG16 (README.md names the files), for LPIPS; needs pip install 'drgs[lpips]'."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write what a fit looked like as one HTML file: curves, views, picks, maps, timings, and how to repeat it."""

    run: Positional[Path]
    """A run folder; the fit may still be going on, or have been stopped."""
    output: Annotated[Path | None, arg(aliases=["-o"])] = None
    """The HTML file; default report.html in the run folder. While a fit writes there, name another place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cite(Common):
    """Print BibTeX of what a run used, by its config.json; without a run, of what every use rests on."""

    run: Positional[Path | None] = None
    """A run folder; the fit may still be going on."""
