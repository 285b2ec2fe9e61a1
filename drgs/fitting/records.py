"""What a run folder says about itself, validated once, here: config.json, selection.json and the checkpoint's header.

People copy, move and edit run folders. Whatever is read from one has the types, ranges and shapes that its readers
count on, or is refused in one line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.cameras.origins import check_origin
from drgs.codecs import CODECS
from drgs.codecs.folders import file_of_folder
from drgs.codecs.ply import load_ply
from drgs.data.camera_lists import load_cameras_json
from drgs.fitting.components.base import Checkpoint, Setup
from drgs.fitting.components.poses import CAMERAS
from drgs.fitting.components.semantics import SemanticRecord
from drgs.fitting.components.table import COMPONENTS
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame, load_dataset
from drgs.fitting.networks import saved_networks
from drgs.fitting.rows import GaussianRows
from drgs.information.nuisances import NUISANCES, Nuisance
from drgs.io.checkpoint import load_state
from drgs.io.json_files import check_json, parse_json, read_json
from drgs.io.run import CONFIG_SCHEMA, Run

if TYPE_CHECKING:
    from drgs.data import Dataset
    from drgs.deform import DynamicGaussians
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.fitting.active import ActiveViews
    from drgs.fitting.trainer import Trainer

__all__ = [
    "FitRecord",
    "LoadedRun",
    "check_checkpoint",
    "config_record",
    "fit_record",
    "fitted_views",
    "is_fit_config",
    "is_run",
    "load_run",
    "of_some",
    "pick_seconds",
    "seconds_of",
]

_log = logging.getLogger(__name__)

_CONFIG = {"data": str, "train": [str], "test": [str], "fit": {"settings": dict}}
_OPTIONAL = {"estimated": [str], "pool": [str]}
_VIEW = {"index": int, "name": str}
_HEADER = {
    "step": int,
    "bad_steps": int,
    "start_count": int,
    "extent": float,
    "views": [str],
    "config": dict,
    "point_source": str,
}
_OF_A_PICK = ("number", "step", "index")  # by which an event of the log is a pick of the checkpoint
_TIMED = ("train", "preview", "checkpoint", "done")  # events whose `seconds` are those of all steps so far
_ACTIVE = {"pool": [str], "picks": [{"number": int, "step": int, **_VIEW}]}


@dataclasses.dataclass(frozen=True)
class FitRecord:
    """What config.json of a run says about its fit.

    Attributes:
        data: The data set.
        train, test: Names of the views of the two splits; of an active run, `train` are those it began with.
        config: How it was fitted.
        semantics: What its features were fitted to; None where it has none.
        times: Times of the views, sorted, where it was fitted to what moves; else none.
        estimated: Unknowns of the photographs that were estimated beside the scene: information about the scene is
            what is left when they are eliminated.
        refined: Photograph -> world-to-camera pose (4, 4) as refined beside the scene, which the data set states
            otherwise; empty where poses were fixed, or before the first checkpoint.
    """

    data: Path
    train: tuple[str, ...]
    test: tuple[str, ...]
    config: FitConfig
    semantics: SemanticRecord | None = None
    times: tuple[float, ...] = ()
    estimated: tuple[Nuisance, ...] = ()
    refined: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def with_refined_poses(self, dataset: Dataset) -> Dataset:
        """The data set with the cameras of the photographs where the fit has found them.

        Whoever compares photographs with a run, or computes the information of known views, has to load them so.
        """
        for view in dataset.views:
            if view.name in self.refined:
                view.camera = dataclasses.replace(view.camera, w2c=self.refined[view.name])
        return dataset

    def dataset(self) -> Dataset:
        """The data set for its cameras, where the fit has found them: no view opened, no points, maps or labels.

        Raises:
            FileNotFoundError, ValueError: As `drgs.data.load`.
        """
        found = load_dataset(self.data, self.config, lazy=True, points=False, semantics=False)
        return self.with_refined_poses(found)

    @property
    def is_active(self) -> bool:
        """Whether views were chosen during the fit."""
        return self.config.selection is not None

    def check_data(self, run: Path, otherwise: str = "") -> None:
        """Raise FileNotFoundError if the data set is no longer where it was fitted; `otherwise` is advice, too."""
        if not self.data.exists():
            advice = f"move it back, or {otherwise}" if otherwise else "move it back"
            raise FileNotFoundError(f"{run}: the data set of the run must be at {self.data}, found none; {advice}")


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """What a run holds.

    Attributes:
        gaussians: Gaussians of the last checkpoint, or of the PLY where none can be read; at rest, where they move.
        record: How they were fitted.
        step: Step of the checkpoint; None where only the PLY could be read.
        seconds, bad_steps: Seconds that the steps up to there took, and how many of these were skipped; None as `step`.
        networks: What was fitted beside them, by name: what `torch.nn.Module.load_state_dict` takes.
        decoder: What makes a teacher's features of the Gaussians'; None where it has none, or only the PLY could be
            read.
        classes: What the data set that was fitted calls things; None where it does not.
        moving: The Gaussians with the field that moves them; None where they stand still, or only the PLY could be
            read.
    """

    gaussians: Gaussians
    record: FitRecord
    step: int | None
    seconds: float | None = None
    bad_steps: int | None = None
    networks: dict[str, dict[str, torch.Tensor]] = dataclasses.field(default_factory=dict)
    decoder: Decoder | None = None
    classes: Classes | None = None
    moving: DynamicGaussians | None = None

    @property
    def scene(self) -> Scene:
        """What is rendered: the Gaussians, or those that a deformation field moves."""
        return self.gaussians if self.moving is None else self.moving


def load_run(run: Run | str | os.PathLike) -> LoadedRun:
    """What a run holds, from its last checkpoint; point_cloud.ply holds less, and is for other programs.

        scene = drgs.load_run("runs/scene").scene
        image = drgs.render(scene, camera).rgb

    Where the checkpoint is missing or damaged, the PLY is taken. Where both are there but differ, because somebody has
    edited the PLY, the checkpoint is taken; `drgs.load_ply` reads the PLY. Either way the log has one line about it.

    Args:
        run: Run folder.
    Raises:
        FileNotFoundError: If it is no run folder, or has neither a checkpoint nor a PLY.
        ValueError: If config.json or the classes' embeddings are damaged, or everything else.
    """
    run = run if isinstance(run, Run) else Run(run)
    record = fit_record(run)
    known = record.semantics
    decoder = None
    moving = None
    classes = None if known is None else known.read_classes(run.path)
    try:
        tensors, header = load_state(run.state)
        check_checkpoint(run.state, tensors, header)
        checkpoint = Checkpoint(tensors, header, str(run.state))
        gaussians = GaussianRows.from_state(tensors, header).gaussians().detach()  # for rendering, not to be fitted
        for component in COMPONENTS.values():
            gaussians = component.load_gaussians(gaussians, checkpoint)
        gaussians.validate(str(run.state))
        networks = saved_networks(tensors, header)
        if known is not None:
            decoder = known.decoder(networks, gaussians, str(run.state))
        scene: Any = gaussians
        for component in COMPONENTS.values():
            scene = component.load_scene(scene, checkpoint)
        moving = None if scene is gaussians else scene
    except (FileNotFoundError, ValueError) as error:
        if not run.point_cloud.is_file():
            if run.state.exists():
                raise
            raise FileNotFoundError(
                f"{run.path}: must hold {run.state.name} or {run.point_cloud.name}, found none; the fit has not "
                "reached its first checkpoint"
            ) from None
        gaussians = load_ply(run.point_cloud)
        what = f"{run.point_cloud.name}, where nothing moves," if record.times else run.point_cloud.name
        _log.warning("%s; %s is taken instead", str(error).partition(";")[0], what)
        return LoadedRun(gaussians, record, None, classes=classes)
    if run.point_cloud.is_file() and not _shows(run.point_cloud, gaussians):
        _log.warning(
            "%s: differs from %s (edited, or of another step); the checkpoint is used, name the PLY to use that",
            run.point_cloud,
            run.state.name,
        )
    done = {name: header[name] for name in ("step", "bad_steps")} | {"seconds": seconds_of(run, header)}
    return LoadedRun(gaussians, record, **done, networks=networks, decoder=decoder, classes=classes, moving=moving)


def seconds_of(run: Run, header: dict) -> float | None:
    """What the steps of a checkpoint took, by `log.jsonl`, None where that does not say: a checkpoint holds nothing of
    the clock's, so that two fits to the same bits have the same file. Those of older versions say it themselves.
    """
    if "seconds" in header:
        return header["seconds"]
    times = [event for event in _logged(run) if event["event"] in _TIMED and _is_time(event.get("seconds"))]
    # Steps that were done again after a resume are logged again: the last word counts.
    known = [x["seconds"] for x in times if isinstance(x.get("step"), int) and x["step"] <= header["step"]]
    return known[-1] if known else None


def pick_seconds(run: Run, picks: list[dict]) -> list[dict]:
    """The picks of a checkpoint with what choosing each took, by `log.jsonl`; 0 where that does not say."""
    times = {
        tuple(str(event.get(name)) for name in _OF_A_PICK): event["seconds"]
        for event in _logged(run)
        if event["event"] == "pick" and _is_time(event.get("seconds"))
    }
    known = [times.get(tuple(str(pick[name]) for name in _OF_A_PICK), 0.0) for pick in picks]
    return [{"seconds": seconds, **pick} for pick, seconds in zip(picks, known, strict=True)]


def _logged(run: Run) -> list[dict]:
    """The events of a log that somebody may have edited: none of one that cannot be read."""
    try:
        return [event for event in run.events() if isinstance(event, dict) and isinstance(event.get("event"), str)]
    except (OSError, ValueError):
        return []


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf


def _shows(path: Path, gaussians: Gaussians) -> bool:
    """Whether a PLY holds the same bits, as far as its layout has room for them; a damaged one does not."""
    try:
        shown = load_ply(path)
    except ValueError:
        return False
    held = gaussians.parameters()
    same = np.array_equal(shown.origin, gaussians.origin)
    return same and all(torch.equal(x, held[name]) for name, x in shown.parameters().items())


def is_run(path: Path) -> bool:
    """Whether a folder has a fit in it, however far that came and whatever else is missing: its config.json says so.

    One that does not, because it was damaged or edited, counts beside a checkpoint or a log: its reader says what is
    wrong with it.
    """
    config = path / "config.json"
    others = ("state.safetensors", "log.jsonl")
    return config.is_file() and (is_fit_config(config) or any((path / name).is_file() for name in others))


def is_fit_config(path: Path) -> bool:
    """Whether a config.json can be read and is of a fit."""
    try:
        value = parse_json(path.read_bytes(), str(path))
    except (OSError, ValueError):
        return False
    return isinstance(value, dict) and value.get("command") == "fit" and isinstance(value.get("schema"), int)


def config_record(
    setup: Setup,
    trainer: Trainer,
    source: str,
    plan: ActiveViews | None,
    before: Mapping[str, Any],
    begin: Path | None,
) -> dict:
    """What config.json is to say of a fit, for `drgs.io.run.Run.start`; `fit_record` reads it.

    Args:
        setup, trainer, plan: What the fit begins with, at its first step or resumed, and its views if they are chosen.
        source: Where the first Gaussians come from, in words.
        before: Contents of config.json of a fit that is resumed; else empty.
        begin: Checkpoint whose Gaussians it begins with.
    """
    dataset, data, frames = setup.dataset, trainer.config.data, setup.frames
    recorded: dict[str, Any] = {
        "schema": CONFIG_SCHEMA,
        "command": "fit",
        "data": str(Path(dataset.path).resolve()),
        "format": dataset.format,
        "split_rule": dataset.split_rule(data.test_every, data.test_offset, data.test_cameras),
        "train": plan.names[: len(plan.timetable.start)] if plan else [frame.name for frame in frames],
        "test": [view.name for view in setup.test],  # also those whose mask keeps nothing, which are not measured
        "size": sorted({(f.camera.width, f.camera.height) for f in frames + setup.held_out}),
        "masks": sorted({kind for frame in frames for kind in _mask_kinds(frame)}),
        "points": source,
        **({"origin": trainer.rows.origin.tolist()} if trainer.rows.origin.any() else {}),
        **({"frames": list(dataset.frames)} if dataset.frames else {}),
        **({"absent": [view.name for view in dataset.absent]} if dataset.absent else {}),
        "fit": trainer.config.to_json(),
    }
    if plan:
        recorded |= {"pool": [view.name for view in plan.views], "pool_leak": plan.pool_leak}
    for component in trainer.components:
        recorded |= component.record(trainer, before)
    recorded |= {"estimated": trainer.nuisances} if trainer.nuisances else {}
    began = before.get("begin", None if begin is None else str(begin))
    return recorded | ({} if began is None else {"begin": began})


def _is_of_gaussians(path: Path) -> bool:
    """Whether it is a file that `load_gaussians` reads by its suffix, or a folder of another trainer."""
    if path.is_file():
        return path.name.lower().endswith((".ply", *(codec.suffix for codec in CODECS.values())))
    with contextlib.suppress(FileNotFoundError, ValueError):  # what is wrong with it matters to who reads it
        return path.is_dir() and file_of_folder(path) is not None
    return False


def fit_record(run: Run) -> FitRecord:
    """The record of a run.

    Raises:
        FileNotFoundError: If it is no run folder; of Gaussians alone, with what there is for these.
        ValueError: If config.json is damaged, of another version, or says something that no fit has written.
    """
    if not is_run(run.path) and _is_of_gaussians(run.path):
        raise FileNotFoundError(
            f"{run.path}: must be a run folder, holds Gaussians alone; drgs fisher {shlex.quote(str(run.path))} "
            "--train DATA -o OUT says what error to expect of these, drgs render --cameras DATA -o OUT their PSNR"
        )
    config = run.config()
    where = f"{run.path / 'config.json'}"
    advice = "restore the file, or fit again in another folder"
    optional = dict(_OPTIONAL)
    for component in COMPONENTS.values():
        optional |= component.record_kinds
    check_json(where, config, _CONFIG | {name: x for name, x in optional.items() if name in config}, advice)
    try:
        fit = FitConfig.from_json(config["fit"])
    except (ValueError, NotImplementedError) as error:
        raise ValueError(f"{where}: {error}; {advice}") from None
    estimated = tuple(config.get("estimated", ()))
    if odd := [name for name in estimated if name not in NUISANCES]:
        raise ValueError(f"{where}: estimated must be among {', '.join(NUISANCES)}, got {odd[0]!r}; {advice}")
    return FitRecord(
        Path(config["data"]),
        tuple(config["train"]),
        tuple(config["test"]),
        fit,
        SemanticRecord.from_json(config.get("semantics"), f"{where}: semantics"),
        tuple(config.get("times", ())),
        estimated,
        _refined_poses(run, config, advice),
    )


def _refined_poses(run: Run, config: dict, advice: str) -> dict[str, np.ndarray]:
    """The poses that a fit has refined, by photograph.

    Raises:
        FileNotFoundError: If there is a checkpoint of such a fit, but not the file with its cameras.
        ValueError: If that is damaged, or has other photographs.
    """
    if not config.get("poses", {"refined": False})["refined"]:
        return {}
    path = run.path / CAMERAS
    if not path.is_file():
        if run.state.is_file():
            raise FileNotFoundError(
                f"{path}: must hold the cameras that the fit has refined, found none; go on with the fit (--resume), "
                "which writes them again"
            )
        return {}
    poses = {camera.name: camera.w2c for camera in load_cameras_json(path)}
    # In an active fit photographs of the pool have joined those that it began with.
    if not set(config["train"]) <= set(poses) <= set(config.get("pool", config["train"])):
        raise ValueError(f"{path}: must hold the {len(config['train'])} training photographs, does not; {advice}")
    return poses


def fitted_views(run: Run, record: FitRecord | None = None) -> list[str]:
    """Names of the views that a run was fitted to: all of its training split, or those chosen so far.

    Args:
        run: The run folder.
        record: Its `fit_record`, where that has been read already.
    Raises:
        FileNotFoundError: If it is no run folder, or an active run without selection.json.
        ValueError: If a file is damaged.
    """
    record = record or fit_record(run)
    if not record.is_active:
        return list(record.train)
    path = run.path / "selection.json"
    advice = "move it away and resume the fit"
    selection = read_json(path, "the record of the chosen views", advice)
    check_json(str(path), selection, {"start": [_VIEW], "picks": [_VIEW]}, advice)
    return [view["name"] for view in (*selection["start"], *selection["picks"])]


def check_checkpoint(path: Path, tensors: dict[str, torch.Tensor], header: dict) -> None:
    """Refuse a checkpoint that no fit has written.

    Args:
        path: File that messages name.
        tensors, header: Result of `drgs.io.checkpoint.load_state`.
    Raises:
        ValueError: If the header lacks a field, or a value is of another type or out of range, or a tensor is missing
            or has another shape than the number of Gaussians asks for, or a network has no tensor.
    """
    advice = "restore the file, or fit again in another folder"
    kind = dict(_HEADER)
    if header.get("active") is not None:
        found = isinstance(header["active"], dict) and "exposure" in header["active"]
        kind |= {"active": _ACTIVE | ({"exposure": dict} if found else {})}
    kind |= {"networks": [str]} if "networks" in header else {}
    kind |= {"seconds": float} if "seconds" in header else {}  # of older versions
    for component in COMPONENTS.values():
        kind |= {name: x for name, x in component.header_kinds.items() if name in header}
    kind |= {"skybox": int} if "skybox" in header else {}
    kind |= {"origin": [float]} if "origin" in header else {}
    check_json(str(path), header, kind, advice)
    try:
        FitConfig.from_json(header["config"])
    except (ValueError, NotImplementedError) as error:
        raise ValueError(f"{path}: {error}; {advice}") from None
    least = {"step": 0, "bad_steps": 0, "start_count": 1, "seconds": 0}
    for name, low in least.items():
        if header.get(name, low) < low:
            raise ValueError(f"{path}: {name} must be >= {low}, got {header[name]}; {advice}")
    check_origin(f"{path}: origin", header.get("origin", [0.0] * 3))
    skybox = header.get("skybox", 0)
    if skybox and "parameter.means" in tensors and not 0 < skybox < len(tensors["parameter.means"]):
        most = len(tensors["parameter.means"]) - 1
        raise ValueError(f"{path}: skybox must be in 1..{most}, got {skybox}; {advice}")
    if not header["extent"] > 0:
        raise ValueError(f"{path}: extent must be > 0, got {header['extent']}; {advice}")
    if header.get("active") is not None:
        pool = header["active"]["pool"]
        for pick in header["active"]["picks"]:
            if not (0 <= pick["index"] < len(pool) and pool[pick["index"]] == pick["name"]):
                raise ValueError(f"{path}: pick {pick['name']!r} must be of the pool, is not; {advice}")
    for name, held in saved_networks(tensors, header).items():
        if not held:  # every network has parameters: an optimizer of none is refused by torch
            raise ValueError(f"{path}: network {name!r} must have parameters, got none; {advice}")
    for name, (dtype, shape) in _expected(Checkpoint(tensors, header, str(path))).items():
        x = tensors.get(name)
        if x is None or x.dtype != dtype or tuple(x.shape) != shape:
            got = "none" if x is None else f"{x.dtype} of shape {tuple(x.shape)}"
            raise ValueError(f"{path}: {name} must be {dtype} of shape {shape}, got {got}; {advice}")
    queue = tensors["queue"]
    if queue.numel() and not (int(queue.min()) >= 0 and int(queue.max()) < len(header["views"])):
        raise ValueError(f"{path}: queue must hold numbers of the {len(header['views'])} views; {advice}")
    for name in ("rng", "policy_rng"):
        try:
            if name in tensors:
                torch.Generator().set_state(tensors[name])
        except RuntimeError:
            raise ValueError(f"{path}: {name} must be a state of torch's generator, is damaged; {advice}") from None


def of_some(checkpoint: Checkpoint, kept: torch.Tensor) -> Checkpoint:
    """A checkpoint with some of its Gaussians; what has no row a Gaussian stays as it is.

    Args:
        kept: (N,) bool, which these are.
    """
    far = int(kept[: checkpoint.header.get("skybox", 0)].sum())
    header = {name: x for name, x in checkpoint.header.items() if name != "skybox"} | ({"skybox": far} if far else {})
    kinds = _expected(checkpoint)
    has_rows = lambda name: name in kinds and kinds[name][0].is_floating_point and kinds[name][1][:1] == kept.shape  # noqa: E731
    tensors = {name: x[kept] if has_rows(name) else x for name, x in checkpoint.tensors.items()}
    return dataclasses.replace(checkpoint, tensors=tensors, header=header)


def _expected(checkpoint: Checkpoint) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
    """Type and shape of the tensors of a checkpoint, of as many Gaussians as there are means."""
    tensors, header = checkpoint.tensors, checkpoint.header
    length = lambda name, axis: x.shape[axis] if (x := tensors.get(name)) is not None and x.ndim > axis else 0  # noqa: E731
    count, rest = length("parameter.means", 0), length("parameter.sh_rest", 1)
    rest = next((k for k in (0, 3, 8, 15) if k >= rest), 0)
    columns = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh_dc": (1, 3)}
    expected = {}
    columns |= {"sh_rest": (rest, 3)}
    for key, x in tensors.items():  # of any other tensor it is known only that it has a row a Gaussian
        if key.startswith("parameter."):
            columns.setdefault(key.removeprefix("parameter."), tuple(x.shape[1:]))
    for name, tail in columns.items():
        expected[f"parameter.{name}"] = torch.float32, (count, *tail)
        if any(key.startswith(f"adam.{name}.") for key in tensors):
            expected[f"adam.{name}.exp_avg"] = expected[f"adam.{name}.exp_avg_sq"] = torch.float32, (count, *tail)
            expected[f"adam.{name}.step"] = torch.float32, ()
    state = torch.Generator().get_state()
    generators = ("rng",) if header.get("active") is None else ("rng", "policy_rng")
    expected |= {name: (state.dtype, tuple(state.shape)) for name in generators}
    for component in COMPONENTS.values():
        expected |= component.tensor_kinds(checkpoint, count)
    return expected | {"queue": (torch.int64, (length("queue", 0),))}


def _mask_kinds(frame: Frame) -> list[str]:
    """What says of a photograph where nothing is, or where that is not known."""
    kinds = [] if frame.mask is None else ["object" if frame.is_object else "valid"]
    kinds += [] if frame.alpha is None else ["alpha"]
    return kinds or ["none"]
