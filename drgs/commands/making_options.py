"""What commands that make things can be asked for: photographs to cameras, teachers, scenes, studies, and the demo."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from drgs.commands.option_groups import Clustered, Common, Lenses, OutputPath, SceneFile, Settings, Timed, Views
from drgs.commands.record_options import options_of
from drgs.meshing.options import MeshOptions
from drgs.studies.choices import ExperimentName, ProtocolName, StudyScale

__all__ = ["Capture", "Demo", "Mesh", "Reproduce", "Scene", "Sfm", "Teach"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sfm(Common):
    """Recover cameras and points from plain photographs or videos (COLMAP on the CPU)."""

    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="PATH")]
    """A folder of photographs; a video, whose sharp frames with parallax are taken; or several of both."""
    output: OutputPath
    """Folder for the data set."""
    frames: int = 150
    """At most this many frames of all videos together."""
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = (
        "SIMPLE_RADIAL"
    )
    """COLMAP's name of the lens; photographs of one size and focal length share one camera."""
    matcher: Literal["auto", "exhaustive", "sequential", "retrieval"] = "auto"
    """Match all pairs, neighbors by name (video), or those and the nearest by appearance; auto: all of up to 60."""
    masks: str | None = None
    """Masks of an object that was turned or moved: a folder (NAME.png, white is kept), or alpha, the photos' own."""
    seed: int = 0
    """Seed of all random sampling."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capture(Common):
    """Make a run of photographs or videos in one go: frames, poses, fit, report; each step can be resumed."""

    paths: Annotated[Positional[tuple[Path, ...]], arg(metavar="PATH")] = ()
    """Photographs, videos, folders of both, or one data set that has poses; none with --more."""
    output: OutputPath
    """The run folder; photographs and poses are in its folder capture."""
    budget: str | None = None
    """Time for all of it on this machine (90s, 10min, 2h): sizes and steps are chosen for it; default those of fit."""
    frames: int = 150
    """At most this many frames of all videos together."""
    masks: str | None = None
    """Masks of an object that was turned or moved: a folder (NAME.png, white is kept), or alpha, the photos' own."""
    resume: bool = False
    """Go on where an earlier command was stopped: with the same options, and the same files or none."""
    add: bool = False
    """Further photographs of what RUN shows: they join its data set, and the fit goes on (or, of many, anew)."""
    more: bool = False
    """Say which photographs to take next: where to stand, where to look, and what that is worth."""
    k: Annotated[int, arg(aliases=["-k"])] = 5
    """How many photographs --more suggests."""
    length: str | None = None
    """A distance you know, 'IMG_0001 IMG_0004 1.5 m': places are then told in meters."""
    seed: int = 0
    """Seed of everything random."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Teach(Common, Timed):
    """Add a teacher to a data set: feature maps of its photographs by a local CLIP model, and text embeddings."""

    data: Positional[Path]
    """A data set; the files are written into its folder, where drgs fit finds them. Nothing there is replaced."""
    model: Path
    """Folder of a CLIP model as transformers saves it; needs pip install 'drgs[teacher]'. Nothing is downloaded."""
    classes: str | None = None
    """Names with commas between, or a file of them (.txt, .json); default those that the data set names."""
    size: str | None = None
    """WIDTHxHEIGHT of a map in cells; default 80 along the longer side, of the photograph's shape."""
    scales: str = "0.75,1,1.5"
    """Of the photographs as the model sees them, averaged; 1: the short side is twice the model's image size."""
    flip: bool = True
    """Average with the mirrored photographs, too, unless --no-flip is given, which takes half the time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """Make a still life, fit it, render it and compare presets: a tour in minutes."""

    output: OutputPath = Path("out/demo")
    """Folder for pictures and tables."""
    quick: bool = False
    """Half a minute with poor pictures, to see that everything runs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene(Common):
    """Make a data set by path tracing: a room, a kitchen or hall in motion, a still life, or one like a phone's."""

    name: Positional[Literal["room", "kitchen", "hall", "still_life", "capture"]]
    """Room, kitchen and hall have classes, points and a teacher, the latter two move; capture is like a phone's."""
    output: OutputPath
    """Folder for the data set; an interrupted command is continued there."""
    size: str | None = None
    """WIDTHxHEIGHT of the images in pixels; default 320x240; 240x180 (capture, kitchen), 160x120 (hall)."""
    views: int | None = None
    """How many images; default 75 (room), 32 (still_life) or 28 (capture)."""
    cameras: int | None = None
    """How many cameras film (kitchen, hall); default 15, 12. cam00, in the middle of their arc, is the test view."""
    times: int | None = None
    """How many frames each camera films (kitchen, hall); default 40, 12."""
    seed: int = 0
    """Of shapes, textures, motions, cameras, light paths and all errors that are made on purpose."""
    spp: int | None = None
    """Light paths a pixel; default 25 (room), 16 (kitchen, hall), 30 (still_life), 25 (capture)."""
    teacher_size: str | None = None
    """WIDTHxHEIGHT of the teacher's feature maps; default 80x60 (room), 60x45 (kitchen), 40x30 (hall)."""
    test_every: int | None = None
    """One in how many views is for testing (room); default 5, which is 15 of 75 views."""
    exposure: Literal["auto", "fixed"] | None = None
    """Gains of each photograph (capture): auto exposure and white balance that drifts (default), or one for all."""
    wall: Literal["white", "paper"] | None = None
    """Behind the table (capture): white without texture (default), or papered."""
    shadow: bool = True
    """The photographer's shadow in some photographs (capture), unless --no-shadow is given."""
    passer_by: bool = True
    """Somebody passes by in some photographs (capture), unless --no-passer-by is given."""
    pose_error: str | None = None
    """DEGREES,METERS by which poses of training views are stated wrong (capture); default 0.4,0.006; 0,0 for none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce(Common, Clustered):
    """Compare policies on made scenes or on your data, as arXiv 2512.22771 does: fits by each, means, intervals."""

    what: Positional[ExperimentName]
    """Policies on static scenes, where things move (dynamic), or on captures; lambda (prior); what counts (blocks)."""
    output: OutputPath
    """Folder for scenes, runs, rows.jsonl, tables and figures, of all of these; what is finished there is kept."""
    data: Annotated[tuple[Path, ...], arg(metavar="DATA"), UseAppendAction] = ()
    """A data set to take in place of the made scenes; may be repeated."""
    scale: StudyScale = "small"
    """Of fits and scenes: minutes (tiny), hours (small: 1,400 steps, or 900 where things move), or as in the paper."""
    seeds: int = 3
    """Sets of initial views of each static scene; where things move, kitchens, or fits of each data set."""
    protocol: ProtocolName = "paper"
    """What is known at the start: points of all views (paper), or nothing of unpicked ones (blind, and variants)."""
    policies: Annotated[tuple[str, ...], arg(name="policy", metavar="LABEL"), UseAppendAction] = ()
    """Only this row of the table, by its label in rows.jsonl (docs/results.md lists them); may be repeated."""
    test_every: int = 8
    """Every n-th view of given data, by name, is held out, unless its files state a split."""
    test_offset: int = 0
    """Index of the first of them."""
    lpips_weights: Path | None = None
    """torchvision's AlexNet or VGG16, for LPIPS beside FLIP; needs pip install 'drgs[lpips]'."""
    config: Path | None = None
    """A TOML or JSON file of the configuration, or a run, over the fits of the scale (docs/configuration.md)."""
    figures: bool = True
    """Draw the comparison sheet and the maps at the end, unless --no-figures is given, which saves their seconds."""


_Meshing: Any = options_of(MeshOptions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mesh(_Meshing, Settings, Views, Lenses):
    """Make a surface of triangles with colors, from the depth of a finished run in the views it was fitted to."""

    scene: SceneFile
    output: OutputPath
    """The file, a .ply, .glb or .obj; its suffix says the format."""
    cameras: str | None = None
    """Views whose depth is taken: a data set, a run or a cameras.json; default those that the run was fitted to."""
    info_pixels: int | None = None
    """Views are reduced to at most this many pixels; default as in the fit, or 130000."""
    limit: int | None = None
    """At most this many views, evenly spaced."""
    time: float | None = None
    """Of a run that moves: the surface as it is then."""
