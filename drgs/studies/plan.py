"""The cells of an experiment on scenes that are made, or on data sets that are given: which, and what is left out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from drgs import data
from drgs.studies.cells import Study, distinct_seeds
from drgs.studies.experiments import EXPERIMENTS, MADE_SPLIT, Experiment, study_of
from drgs.studies.protocols import PROTOCOLS, ExperimentName, ProtocolName, StudyScale
from drgs.studies.rows import Cell

_ROOMS = {"tiny": ("room-1",), "small": ("room-1", "room-2"), "paper": ("room-1", "room-2")}
_CAMERA = "cam00"  # of a kitchen: in the middle of the arc
_STATED_SPLIT = (0, 0)  # the split that a data set states


@dataclasses.dataclass(frozen=True)
class StudyPlan:
    """What is to be done.

    Attributes:
        experiment: Experiment, a table of the paper.
        study: Study of its cells.
        cells: Units outermost.
        notes: Sentences about what is left out, and why.
    """

    experiment: Experiment
    study: Study
    cells: tuple[Cell, ...]
    notes: tuple[str, ...]


def plan_of(
    name: ExperimentName,
    scale: StudyScale,
    made: Path,
    given: Sequence[Path] = (),
    seeds: int = 3,
    protocol: ProtocolName = "paper",
    policies: Sequence[str] = (),
    split: tuple[int, int] = (8, 0),
    lpips: Path | None = None,
    fields: Mapping[str, Any] = MappingProxyType({}),
) -> StudyPlan:
    """The cells of an experiment.

    Args:
        name: Name of the experiment.
        scale: Scale of fits and of the scenes that are made.
        made: Folder of these.
        given: Data sets in place of them.
        seeds: Sets of initial views of each static scene; where things move, kitchens, or fits of each data set.
        protocol: A name of `PROTOCOLS`.
        policies: Labels of the experiment; default all.
        split: (n, k) of given data sets that state none: every n-th view is held out, from the k-th on.
        lpips: Weights of a backbone, for LPIPS.
        fields: Fields of `FitConfig` and its parts in place of those of the scale; what a cell says goes before.
    Raises:
        ValueError: If an argument is unknown or out of range, a data set is not of the experiment's kind, or has too
            few views for the protocol.
    """
    experiment = EXPERIMENTS[name]
    moves = experiment.study == "dynamic"
    _check_options(experiment, moves, protocol, policies, seeds)
    wanted = [label for label in experiment.policies if not policies or label in policies]
    scenes = {path.resolve().name: path.resolve() for path in given}
    if len(scenes) < len(given):
        raise ValueError("reproduce: --data must be folders of different names, got one twice; rename or link one")
    study = study_of(experiment.study, scale, made, scenes, lpips=lpips)
    own = {name: x for name, x in fields.items() if name != "selection"}  # every fit of a study has one
    if "settings" in own:  # the scale's renderer is not that of other settings
        own = {"renderers": (own["settings"].nearest_preset()[0],), **own}
    study = dataclasses.replace(
        study, policies={label: study.policies[label] for label in wanted}, fit=study.fit.replace(**own)
    )
    study.fit.replace(test_every=split[0], test_offset=split[1])  # refuses numbers that cannot be
    turns, notes, lacking = list[list](), list[str](), set[tuple[str, str]]()
    for scene, path in scenes.items():
        dataset = data.load(
            path, test_every=split[0], test_offset=split[1], lazy=True, points=False, times=study.fit.data.times
        )
        splits = _splits(split) if experiment.race else [split]
        turns.append(_units_of(study, scene, dataset, moves, splits, seeds, protocol))
        sentences, missing = _missing(study, scene, dataset)
        notes += sentences
        lacking |= {(scene, label) for label in missing}
    units = [turn[k] for k in range(seeds) for turn in turns]  # seeds outermost, as of scenes that are made
    if not given:
        units = _units_of_generated(study, scale, moves, seeds, protocol)
    cells = [cell for cell in study.cells(units) if (cell.scene, cell.policy) not in lacking]
    return StudyPlan(experiment, study, tuple(cells), tuple(notes))


def _splits(split: tuple[int, int]) -> list[tuple[int, int]]:
    """A split and, where it holds anything out, one whose held-out views lie half-way between."""
    every, offset = split
    return [split, (every, (offset + every // 2) % every)] if every else [split]


def _check_options(
    experiment: Experiment, moves: bool, protocol: ProtocolName, policies: Sequence[str], seeds: int
) -> None:
    """Refuse options that an experiment does not have."""
    if moves and PROTOCOLS[protocol].static:
        able = ", ".join(key for key, x in PROTOCOLS.items() if not x.static)
        raise ValueError(f"reproduce: --protocol must be one of {able} where things move, got {protocol}; choose one")
    if unknown := [label for label in policies if label not in experiment.policies]:
        known = "; ".join(experiment.policies)
        raise ValueError(f"reproduce: --policy must be one of: {known}; got {unknown[0]!r}; correct it")
    if seeds < 1:
        raise ValueError(f"reproduce: --seeds must be at least 1, got {seeds}; raise it")


def _units_of_generated(study: Study, scale: StudyScale, moves: bool, seeds: int, protocol: ProtocolName) -> list:
    """Units of scenes that are made, seeds outermost."""
    if moves:
        return [(f"kitchen-{seed}", _CAMERA, "first", protocol, 0) for seed in range(1, seeds + 1)]
    drawn = {scene: distinct_seeds(study, scene, MADE_SPLIT, seeds, protocol) for scene in _ROOMS[scale]}
    return [(scene, MADE_SPLIT, "seed", protocol, drawn[scene][k]) for k in range(seeds) for scene in drawn]


def _units_of(
    study: Study,
    scene: str,
    dataset: data.Dataset,
    moves: bool,
    splits: Sequence[tuple[int, int]],
    seeds: int,
    protocol: str,
) -> list:
    """Those of a data set that was given; they take the splits in turn, unless its files state one."""
    if dataset.is_dynamic != moves:
        want, is_one = ("several times", "one") if moves else ("one time", "several")
        raise ValueError(f"{dataset.path}: must show a scene at {want}, shows {is_one}; choose another experiment")
    train, test = dataset.split()
    if not test:
        raise ValueError(f"{dataset.path}: must hold out views, holds out none; give --test-every")
    if moves:
        cameras = sorted({view.camera_name for view in test})
        if cameras == [""]:  # one camera that moves about and films, whose files state a split
            return [(scene, _STATED_SPLIT, "seed", protocol, seed) for seed in range(seeds)]
        if len(cameras) > 1:
            raise ValueError(
                f"{dataset.path}: must hold out one of several synchronous cameras, holds out "
                f"{', '.join(cameras)}; correct its split"
            )
        return [(scene, cameras[0], "first", protocol, seed) for seed in range(seeds)]
    names = sorted(view.name for view in (*train, *test, *dataset.absent))
    every, offset = splits[0]
    stated = set(names[offset::every] if every else ()) - {view.name for view in dataset.absent}
    own = splits if {view.name for view in test} == stated else [_STATED_SPLIT]
    units = dict[int, tuple]()
    for place, held_out in enumerate(own):
        turns = range(place, seeds, len(own))
        drawn = distinct_seeds(study, scene, held_out, len(turns), protocol) if turns else []
        units |= {k: (scene, held_out, "seed", protocol, seed) for k, seed in zip(turns, drawn, strict=True)}
    return [units[k] for k in range(seeds)]


def _missing(study: Study, scene: str, dataset: data.Dataset) -> tuple[list[str], list[str]]:
    """What is said of a data set without a teacher or without labels, and the policies that it has nothing for."""
    if study.fit.features.semantics == "ignore":
        return [], []
    known = dataset.semantics
    if known is not None and known.maps:
        if known.labels:
            return [], []
        return [f"{scene} has no labels: its accuracies and mIoU are against the teacher's own labels."], []
    lacks = [
        label
        for label, fields in study.policies.items()
        if fields is not None and "semantic" in (fields.get("blocks") or ())
    ]
    text = f"{scene} has no teacher's maps: its rows have no accuracies and no mIoU"
    return [f"{text}, and without features there is no {'; '.join(lacks)}." if lacks else f"{text}."], lacks
