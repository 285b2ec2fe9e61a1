"""What commands that make things can be asked for: photographs to cameras, teachers, scenes, studies, and the demo."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from drgs.commands.option_groups import Clustered, Common, Lenses, OutputPath, SceneFile, Settings, Timed, Views
from drgs.commands.record_options import options_of
from drgs.meshing.options import MeshOptions
from drgs.studies.protocols import ExperimentName, ProtocolName, StudyScale

__all__ = ["Capture", "Demo", "Mesh", "Reproduce", "Scene", "Sfm", "Teach"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sfm(Common):
    """Recover cameras and points from plain photographs or videos (COLMAP on the CPU)."""

    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="PATH")]
    """Folders of photographs, or videos, of which sharp frames with parallax are taken."""
    output: OutputPath
    """Folder for the data set."""
    frames: int = 150
    """At most this many frames of all videos together."""
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = (
        "SIMPLE_RADIAL"
    )
    """COLMAP's camera model; photographs of one size and focal length share one camera."""
    matcher: Literal["auto", "exhaustive", "sequential", "retrieval"] = "auto"
    """Match all pairs, neighbors by name (video), or those and the most similar images; auto: all pairs of up to 60."""
    masks: str | None = None
    """Masks of an object that was turned or moved: a folder (NAME.png, white is kept), or alpha, the alpha channels."""
    seed: int = 0
    """Random seed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capture(Common):
    """Make a scene from photographs or videos in one command: frames, poses, fit, report; can be resumed."""

    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="PATH")] = ()
    """Photographs, videos, folders of both, or one data set that has poses; none with --more."""
    output: OutputPath
    """The run folder; photographs and poses are in its folder capture."""
    budget: str | None = None
    """Time for the whole command (90s, 10min, 2h), from which sizes and steps follow; default those of drgs fit."""
    frames: int = 150
    """At most this many frames of all videos together."""
    masks: str | None = None
    """Masks of an object that was turned or moved: a folder (NAME.png, white is kept), or alpha, the alpha channels."""
    resume: bool = False
    """Continue a command that was stopped, with the same options, and the same files or none."""
    add: bool = False
    """Add photographs of the same scene to the run and continue the fit (or, if they are many, begin it again)."""
    more: bool = False
    """Print which photographs to take next: where to stand, where to look, and how much they would tell."""
    k: Annotated[int, arg(aliases=["-k"])] = 5
    """Number of photographs that --more suggests."""
    length: str | None = None
    """Measured distance of two photographs, 'IMG_0001 IMG_0004 1.5 m', so that --more prints meters."""
    seed: int = 0
    """Random seed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Teach(Common, Timed):
    """Add a teacher's feature maps, by a local CLIP model, and text embeddings to a data set."""

    data: Positional[Path]
    """Data set; files are written into its folder, where drgs fit finds them, and none is replaced."""
    model: Path
    """Folder of a CLIP model as transformers saves it; needs pip install 'drgs[teacher]'. Nothing is downloaded."""
    classes: str | None = None
    """Class names, with commas between, or a file (.txt, .json); default those of the data set."""
    size: str | None = None
    """WIDTHxHEIGHT of a feature map; default 80 along the longer side, in the photograph's shape."""
    scales: str = "0.75,1,1.5"
    """Scales of the photographs to average over; at 1 the short side is twice the model's image size."""
    flip: bool = True
    """Average with the mirrored photographs, unless --no-flip is given, which takes half the time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """Make a still life, fit it, render it and compare presets: a tour in minutes."""

    output: OutputPath = Path("out/demo")
    """Folder for pictures and tables."""
    quick: bool = False
    """Take half a minute, with poor images, to see that everything runs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene(Common):
    """Make a synthetic data set by path tracing: a room, a dynamic kitchen or hall, a still life, a phone capture."""

    name: Positional[Literal["room", "kitchen", "hall", "still_life", "capture"]]
    """Room, kitchen and hall have classes, points and teacher's maps; kitchen and hall are dynamic."""
    output: OutputPath
    """Folder for the data set; an interrupted command is continued there."""
    size: str | None = None
    """WIDTHxHEIGHT of the images in pixels; default 320x240; 240x180 (capture, kitchen), 160x120 (hall)."""
    views: int | None = None
    """Number of images; default 75 (room), 32 (still_life) or 28 (capture)."""
    cameras: int | None = None
    """Number of video cameras (kitchen, hall); default 15, 12. cam00, in the middle of their arc, is the test view."""
    times: int | None = None
    """Number of frames of each camera (kitchen, hall); default 40, 12."""
    seed: int = 0
    """Random seed of shapes, textures, motions, cameras, light paths and simulated errors."""
    spp: int | None = None
    """Samples (light paths) a pixel; default 25 (room), 16 (kitchen, hall), 30 (still_life), 25 (capture)."""
    teacher_size: str | None = None
    """WIDTHxHEIGHT of the teacher's feature maps; default 80x60 (room), 60x45 (kitchen), 40x30 (hall)."""
    test_every: int | None = None
    """Hold out every n-th view (room); default 5, which is 15 of 75 views."""
    exposure: Literal["auto", "fixed"] | None = None
    """Exposure and white balance (capture): automatic and drifting (auto, the default), or the same for all."""
    wall: Literal["white", "paper"] | None = None
    """Wall behind the table (capture): white without texture (default), or papered."""
    shadow: bool = True
    """Add the photographer's shadow to some photographs (capture), unless --no-shadow is given."""
    passer_by: bool = True
    """Add a passer-by to some photographs (capture), unless --no-passer-by is given."""
    pose_error: str | None = None
    """DEGREES,METERS of simulated errors of training poses (capture); default 0.4,0.006; 0,0 for none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce(Common, Clustered):
    """Compare policies of view selection on synthetic scenes or on your data, as arXiv 2512.22771 does."""

    what: Positional[ExperimentName]
    """Study: policies on static scenes, dynamic scenes or captures, values of lambda (prior), or blocks."""
    output: OutputPath
    """Folder for scenes, runs, rows.jsonl, tables and figures; finished fits there are kept."""
    data: Annotated[tuple[Path, ...], arg(metavar="DATA"), UseAppendAction] = ()
    """Data set instead of the synthetic scenes; may be repeated."""
    scale: StudyScale = "small"
    """Size of fits and scenes: minutes (tiny), hours (small: 1,400 steps, dynamic 900), or as in the paper."""
    seeds: int = 3
    """Number of sets of initial views of each static scene; dynamic: of kitchens, or of fits of each data set."""
    protocol: ProtocolName = "paper"
    """Initial points: of all views (paper), or of picked views only (blind, and variants; docs/glossary.md)."""
    policies: Annotated[tuple[str, ...], arg(name="policy", metavar="LABEL"), UseAppendAction] = ()
    """Run only this row of the table, by its label in rows.jsonl (docs/results.md); may be repeated."""
    test_every: int = 8
    """Hold out every n-th view of --data, by name, unless its files state a split."""
    test_offset: int = 0
    """Index of the first held-out view."""
    lpips_weights: Path | None = None
    """torchvision's AlexNet or VGG16, to measure LPIPS, too; needs pip install 'drgs[lpips]'."""
    config: Path | None = None
    """Configuration that replaces that of --scale: a TOML or JSON file, or a run (docs/configuration.md)."""
    figures: bool = True
    """Draw the comparison sheet and the maps at the end, unless --no-figures is given."""


_Meshing: Any = options_of(MeshOptions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(_Meshing, Settings, Views, Lenses):
    """Make a triangle mesh with colors from the depth of a run in the views that it was fitted to."""

    scene: SceneFile
    output: OutputPath
    """Output file: .ply, .glb or .obj."""
    cameras: str | None = None
    """Views whose depth is used: a data set, a run or a cameras.json; default those that the run was fitted to."""
    info_pixels: int | None = None
    """Views are reduced to at most this many pixels; default that of the fit, or 130000."""
    limit: int | None = None
    """At most this many views, evenly spaced."""
    time: float | None = None
    """Dynamic scenes: the time of the surface."""
