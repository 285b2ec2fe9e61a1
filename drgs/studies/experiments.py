"""The experiments: those of arXiv 2512.22771, one a table of the paper, and one of our own; their policies and sizes.

    static     policies on static scenes with labels
    dynamic    policies where things move: one camera at each later time
    prior      lambda, where things move
    blocks     what the criterion counts, where things move
    captures   policies on photographs, by color alone, from 2 views to 20; not the paper's

`dynamic`, `prior` and `blocks` are of one study: they share cells. Policies' labels are names in rows, and stay.

The data sets are rooms and kitchens that are path traced where they are not there yet, and those that are given.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drgs.display.progress import Bar
from drgs.fitting.config import FitConfig, Schedule, SelectionConfig
from drgs.information.prior import Prior
from drgs.studies.cells import Metric, Study
from drgs.studies.protocols import ExperimentName, StudyName, StudyScale

# -------------------------------------------------------------------------------------------------- sizes and data sets

MADE_SPLIT = (3, 0)
"""Of a room's views: every third is for testing, drawn as the candidates are."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How large the fits of a study are, and the scenes that are made for it.

    Attributes:
        fit: Configuration of every cell.
        image, teacher: (width, height) of images and of a teacher's maps.
        every: Steps between two picks; None: by the number of steps, where things move.
        add: Views to be picked; None: 10, or one at each later time.
        measure: Numbers of views at which the held-out views are measured, before the end.
        views: Views of a room.
        cameras: Cameras of a kitchen; it has as many times as the fit takes.
        of_one_camera: Views at the start and views to be picked, where one camera moves about and films what moves.
        info_pixels: Pixels of the views that information is computed from; None: those of the fit.
    """

    fit: FitConfig
    image: tuple[int, int]
    teacher: tuple[int, int]
    every: int | None = None
    add: int | None = None
    measure: tuple[int, ...] = ()
    views: int = 0
    cameras: int = 0
    info_pixels: int | None = None
    of_one_camera: tuple[int, int] | None = None


def _made(
    study: StudyName,
    sizes: Sizes,
    made: Path,
    given: Mapping[str, Path],
    scene: str,
    split: tuple[int, int],
) -> Path:
    """The room `room-N` or the kitchen `kitchen-N`, of seed N."""
    if scene in given:
        return given[scene]
    from drgs.scenes import kitchen, room

    (width, height) = sizes.image
    (w, h) = sizes.teacher
    size = {"width": width, "height": height, "teacher_width": w, "teacher_height": h, "seed": _number(scene)}
    with Bar(f"path tracing {scene}") as bar:
        if study != "dynamic":
            return room.generate(made / scene, views=sizes.views, test_every=split[0], progress=bar.update, **size)
        times = sizes.fit.data.times
        return kitchen.generate(made / scene, cameras=sizes.cameras, times=times, progress=bar.update, **size)


def _number(scene: str) -> int:
    """Of `room-2`: 2."""
    return int(scene.rpartition("-")[2])


PaperNumbers = Mapping[str, float]
"""Metric -> what the paper states."""

# --------------------------------------------------------------------------------------------- policies and experiments

_BASELINES = ("random", "uniform", "farthest", "moments", "fisherrf")
_JOINT = "geometry+semantic, eig"
_DEFAULT = "geometry+semantic+backdrop, v_opt"
_MOVING_DEFAULT = "joint+backdrop, v_opt"
_COLOR_DEFAULT = "geometry+backdrop, v_opt"


def fisher_policy(criterion: str, *blocks: str, prior: float | None = None) -> dict[str, Any]:
    """Fields of a `SelectionConfig` of policy `fisher` with a criterion, blocks and, unless it is None, lambda."""
    fields = {} if prior is None else {"prior": Prior(prior)}
    return {"policy": "fisher", "criterion": criterion, "blocks": blocks, **fields}


_EVERYTHING = ("geometry", "semantic", "deformation")
_POLICIES: Mapping[str, Mapping[str, Any] | None] = {
    **{name: {"policy": name} for name in _BASELINES},
    _JOINT: fisher_policy("eig", "geometry", "semantic"),
    _DEFAULT: {"policy": "fisher"},
    "geometry": fisher_policy("eig", "geometry"),
    "geometry+semantic": fisher_policy("eig", "geometry", "semantic"),
    "geometry+deformation": fisher_policy("eig", "geometry", "deformation"),
    "joint": fisher_policy("eig", *_EVERYTHING),
    **{f"joint, lambda {x}": fisher_policy("eig", *_EVERYTHING, prior=float(x)) for x in ("0", "1e-7", "1e-5")},
    _MOVING_DEFAULT: {"policy": "fisher"},
    **{name: {"policy": name} for name in ("blur", "renderers", "coverage")},
    _COLOR_DEFAULT: {"policy": "fisher"},
    "all views": None,
}


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A table of the paper.

    Attributes:
        title, description: What it shows.
        study: The study that its cells are of.
        policies: Label -> what the table calls it.
        reference: The label that the others are compared with.
        paper: Label -> the paper's numbers, as far as its text states them.
        source: Place in the paper, and its data.
        race: Its study is one, see `Study`; and units take two splits of a data set in turn.
    """

    title: str
    description: str
    study: StudyName
    policies: Mapping[str, str]
    reference: str
    paper: Mapping[str, PaperNumbers]
    source: str
    race: bool = False


_NAMES = {name: name for name in _BASELINES} | {"moments": "Magic Moments", "fisherrf": "FisherRF"}
_REPLICA = "Replica, 640x480, 7,000 steps, an L40, single runs"
_NEU3D = "Neural 3D Video, 1352x1014, 17,000 steps, an L40, single runs"

EXPERIMENTS: Mapping[ExperimentName, Experiment] = {
    "static": Experiment(
        "Policies on static scenes",
        "Two views, one more every so many steps; color and labels of held-out views.",
        "static",
        {**_NAMES, _JOINT: "the paper's: geometry + semantic, eig", _DEFAULT: "drgs: with backdrop, v_opt"},
        "random",
        {_JOINT: {"psnr": 33.60}, "fisherrf": {"psnr": 32.17}, "moments": {"psnr": 33.52}},
        _REPLICA,
    ),
    "dynamic": Experiment(
        "Policies where things move",
        "All cameras but the held-out one at the first time, then one camera at each later time.",
        "dynamic",
        {
            **_NAMES,
            "joint": "the paper's: geometry + semantic + deformation, eig",
            _MOVING_DEFAULT: "drgs: with backdrop, v_opt",
            "all views": "all cameras at all times",
        },
        "random",
        {"joint": {"psnr": 28.62}, "fisherrf": {"psnr": 27.67}, "moments": {"psnr": 28.38}},
        _NEU3D,
    ),
    "prior": Experiment(
        "lambda",
        "The joint criterion by its prior precision, where things move.",
        "dynamic",
        {
            "joint, lambda 0": "lambda 0",
            "joint, lambda 1e-7": "lambda 1e-7",
            "joint": "lambda 1e-6",
            "joint, lambda 1e-5": "lambda 1e-5",
        },
        "joint",
        {
            "joint, lambda 0": {"psnr": 28.59},
            "joint, lambda 1e-7": {"psnr": 28.06},
            "joint": {"psnr": 28.62},
            "joint, lambda 1e-5": {"psnr": 28.53},
        },
        _NEU3D,
    ),
    "blocks": Experiment(
        "What the criterion counts",
        "Of an image: its colors about the Gaussians, its features, and both about the deformation network.",
        "dynamic",
        {
            "geometry": "geometry",
            "geometry+semantic": "+ semantic",
            "geometry+deformation": "+ deformation",
            "joint": "all",
        },
        "geometry",
        {"joint": {"psnr": 28.62}},
        _NEU3D,
    ),
    "captures": Experiment(
        "Policies on captures",
        "Two views, one more every so many steps until 20; color of held-out views, no features.",
        "captures",
        {
            **{name: name for name in ("random", "uniform", "farthest", "blur", "renderers", "coverage")},
            **{name: _NAMES[name] for name in ("moments", "fisherrf")},
            "geometry": "geometry, eig",
            _COLOR_DEFAULT: "drgs: with backdrop, v_opt",
        },
        _COLOR_DEFAULT,
        {},
        "",
        race=True,
    ),
}
"""The paper's numbers are those that its text states: PSNR of its own criterion, of FisherRF and of Magic Moments (by
their distances), and of every lambda."""


def _fit(**fields: Any) -> FitConfig:
    return FitConfig().replace(**{"renderers": ("fast",), "feature_rate": 5e-3, "decoder_rate": 5e-4, **fields})


_TINY: Mapping[str, Any] = {"max_gaussians": 500, "feature_width": 8, "feature_rate": 5e-2, "decoder_rate": 1e-2}
_FAST_FIELD: Mapping[str, Any] = {"grid_rate": (8e-3, 8e-4), "field_rate": (8e-4, 8e-5)}

SIZES: Mapping[tuple[str, StudyScale], Sizes] = {
    ("static", "tiny"): Sizes(
        _fit(max_pixels=1_200, max_steps=150, **_TINY),
        (40, 30),
        (20, 15),
        every=20,
        add=3,
        views=24,
    ),
    ("static", "small"): Sizes(
        _fit(max_pixels=10_800, max_gaussians=8_000, max_steps=1400, feature_width=32),
        (160, 120),
        (40, 30),
        every=40,
        views=84,
    ),
    ("static", "paper"): Sizes(
        FitConfig(renderers=("fast",), max_steps=7000), (320, 240), (80, 60), every=200, views=84
    ),
    ("captures", "tiny"): Sizes(
        _fit(max_pixels=1_200, max_steps=150, max_gaussians=500, semantics="ignore"),
        (40, 30),
        (20, 15),
        every=20,
        add=3,
        measure=(3,),
        views=24,
    ),
    ("captures", "small"): Sizes(
        _fit(max_pixels=10_800, max_gaussians=8_000, max_steps=1400, semantics="ignore"),
        (160, 120),
        (40, 30),
        every=40,
        add=18,
        measure=(3, 4, 6, 8, 10, 12),
        views=84,
    ),
    ("captures", "paper"): Sizes(
        FitConfig().replace(renderers=("fast",), max_steps=7000, semantics="ignore"),
        (320, 240),
        (80, 60),
        every=200,
        add=18,
        measure=(3, 4, 6, 8, 10, 12),
        views=84,
    ),
    ("dynamic", "tiny"): Sizes(
        _fit(
            times=4,
            max_pixels=800,
            max_steps=120,
            **_TINY,
            **_FAST_FIELD,
        ),
        (32, 24),
        (16, 12),
        cameras=5,
        of_one_camera=(6, 3),
    ),
    ("dynamic", "small"): Sizes(
        _fit(
            times=14,
            max_pixels=10_800,
            max_gaussians=8_000,
            max_steps=900,
            feature_width=32,
            **_FAST_FIELD,
        ),
        (120, 90),
        (40, 30),
        cameras=10,
        info_pixels=2_700,
        of_one_camera=(24, 12),
    ),
    ("dynamic", "paper"): Sizes(
        FitConfig(renderers=("fast",), max_steps=17_000), (240, 180), (60, 45), cameras=15, of_one_camera=(24, 39)
    ),
}
"""Of the fits, and of the scenes that are made. As `small` has a fifth of the paper's steps on static scenes, and a
nineteenth on those that move, features and decoder go five times as fast, and there the field, too."""


def metrics_of(study: StudyName, lpips: bool = False) -> tuple[Metric, ...]:
    """What a row holds; those of labels are None where a data set has none."""
    color = [Metric("ssim", "SSIM"), Metric("psnr", "PSNR", 2), Metric("flip", "FLIP", larger=False)]
    if lpips:
        color.append(Metric("lpips", "LPIPS", larger=False))
    if study == "dynamic":
        color.append(Metric("psnr_moving", "PSNR, moving pixels", 2, optional=True))
    if study == "captures":
        return tuple(color)
    labels = {"pixel_accuracy": "pixel accuracy", "class_accuracy": "class-mean accuracy", "miou": "mIoU"}
    return (
        *color,
        *(Metric(key, title, path=("segmentation", "run", key), optional=True) for key, title in labels.items()),
    )


def study_of(
    study: StudyName,
    scale: StudyScale,
    made: Path,
    given: Mapping[str, Path] | None = None,
    policies: Mapping[str, Mapping[str, Any] | None] | None = None,
    lpips: Path | None = None,
) -> Study:
    """The study that an experiment's cells are of.

    Args:
        study: Name of the study.
        scale: Scale of its fits, and of the scenes that are made.
        made: Folder of the scenes that are made.
        given: Scene -> data set, of those that are not made.
        policies: Label -> fields of `SelectionConfig`; default those of all its experiments.
        lpips: Weights of a backbone, for LPIPS.
    """
    sizes = SIZES[study, scale]
    own = [label for x in EXPERIMENTS.values() if x.study == study for label in x.policies]
    schedule: Schedule = "times" if study == "dynamic" else "auto"
    selection = SelectionConfig(
        add=sizes.add, every=sizes.every, info_pixels=sizes.info_pixels, schedule=schedule, measure=sizes.measure
    )
    one = None if sizes.of_one_camera is None else dict(zip(("initial", "add"), sizes.of_one_camera, strict=True))
    return Study(
        name=f"{study}-{scale}",
        folder=functools.partial(
            _made, study, sizes, made / scale, dict(given or {})
        ),  # other processes can be sent it
        policies=policies or {label: _POLICIES[label] for label in dict.fromkeys(own)},
        fit=sizes.fit.replace(selection=selection),
        metrics=metrics_of(study, lpips is not None),
        reference=next(x.reference for x in EXPERIMENTS.values() if x.study == study),
        race=any(x.race for x in EXPERIMENTS.values() if x.study == study),
        of_one_camera={} if one is None else {"schedule": "pairs", **one},
        lpips=lpips,
    )
