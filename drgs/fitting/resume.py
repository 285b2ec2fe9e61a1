"""Which run folder a fit may write into, and the checkpoint from which it is resumed."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from drgs.fitting.components.table import component_files
from drgs.fitting.records import check_checkpoint, is_fit_config, is_run
from drgs.io.checkpoint import load_state
from drgs.io.outputs import LockedFolder, lock_folder, replacing
from drgs.io.run import Run

PREVIOUS = "state.previous.safetensors"
_CHECKPOINTS = ("state.safetensors", PREVIOUS)


def run_files() -> tuple[str, ...]:
    """Names of what a fit writes into its run folder, besides `renders/`, for components as they are by now."""
    before = "config.json", "env.json", "log.jsonl", "metrics.json", "selection.json", *component_files()
    return *before, "point_cloud.ply", "errors.safetensors", "report.html", *_CHECKPOINTS


_log = logging.getLogger(__name__)


def lock_output(folder: Path, command: str, names: Iterable[str], inputs: Iterable[str | os.PathLike]) -> LockedFolder:
    """Lock a folder for what a command makes of a scene (`drgs.io.outputs.lock_folder`), which is no run folder.

    Raises:
        ValueError: If it is one, and as `lock_folder`.
    """
    if is_run(folder):
        raise ValueError(
            f"{folder}: -o must be another folder than that of a run, with whose files those of `drgs {command}` would "
            f"be mixed; name another, e.g. {Path('out', command)}"
        )
    return lock_folder(folder, command, names, inputs)


def lock_run(run: Run, command: str, resume: bool = True, inputs: Iterable = ()) -> LockedFolder:
    """Lock a run folder for a command that writes into it (`drgs.io.outputs.lock_folder`).

    Args:
        run: The folder.
        command: Name of the command.
        resume: A run is there already, or may be.
        inputs: What the command reads.
    Raises:
        ValueError: If another process writes there, there is a run and `resume` is False, or one of `run_files` is not
            what drgs wrote.
    """
    held = lock_folder(run.path, command, inputs=inputs)
    try:
        is_fit = is_fit_config(run.path / "config.json")
        if is_fit and resume:
            pictures = ("preview_*.png", "test/*.png", "train/*.png", "all/*.png")
            drawn = [str(path.relative_to(run.path)) for kind in pictures for path in run.renders.glob(kind)]
            held.record_existing([*run_files(), *drawn], "fit")  # a copy without hidden files
        if is_fit and not resume:
            raise ValueError(
                f"{run.path}: must be a new run folder, holds a run already; add --resume or choose another"
            )
        held.check(name for name in run_files() if not (resume and name in _CHECKPOINTS))  # those: `last_checkpoint`
        there = [name for name in run_files() if (run.path / name).exists()]
        if there and not resume:
            raise ValueError(
                f"{run.path}: must be a new run folder, holds {there[0]} of one; add --resume or choose another"
            )
        if command == "fit" and "point_cloud.ply" in there and not {*_CHECKPOINTS} & {*there}:
            raise ValueError(
                f"{run.path}: must hold a checkpoint to go on from, holds none; choose another run folder (-o), "
                "this one keeps its point_cloud.ply"
            )
        held.remove_unfinished("renders", *(f"renders/{split}" for split in ("test", "train", "all")))
    except BaseException:
        held.release()
        raise
    return held


def last_checkpoint(run: Run) -> tuple[dict, dict] | tuple[None, None]:
    """Tensors and header of the last checkpoint that can be read; None, None where there is none yet.

    The run is claimed. A damaged checkpoint is kept under another name, and the one before it is taken.

    Raises:
        ValueError: If there is one but none can be read; then nothing is renamed.
    """
    problem = None
    for path in (run.state, run.path / PREVIOUS):
        if not path.is_file():
            continue
        try:
            tensors, header = load_state(path)
            check_checkpoint(path, tensors, header)
        except ValueError as error:
            problem = problem or str(error).partition(";")[0]
            continue
        with lock_folder(run.path, "fit") as held:
            held.record(path.name, path)  # it says itself that it is of drgs, wherever it was copied from
            for other in {run.state, run.path / PREVIOUS} - {path}:
                _put_aside(other, held, problem is not None)
        if problem:
            _log.warning("%s; resuming from the one before it, step %d", problem, header["step"])
        return tensors, header
    if problem:
        raise ValueError(
            f"{problem}; there is none before it to go on from: fit into another run folder (-o), this one keeps its "
            "point_cloud.ply and log.jsonl"
        )
    return None, None


def keep_previous(run: Run) -> None:
    """Keep the checkpoint that is about to be replaced, for the case that the new one is damaged."""
    previous = run.path / PREVIOUS
    if not run.state.is_file() or previous.exists() and os.path.samefile(previous, run.state):
        return  # killed between this and the new one: moving a link onto another of the same file does nothing
    with replacing(previous) as name:
        try:
            os.unlink(name)
            os.link(run.state, name)
        except OSError:  # a file system without links
            shutil.copyfile(run.state, name)


def _put_aside(path: Path, held: LockedFolder, is_damaged: bool) -> None:
    """Rename a checkpoint that is not as drgs wrote it, so that the next one does not replace it."""
    if path.is_file() and (is_damaged or not held.is_ours(path)):
        names = ("state.damaged.safetensors", *(f"state.damaged.{i}.safetensors" for i in range(2, 1000)))
        name = next(name for name in names if not os.path.lexists(path.with_name(name)))
        os.rename(path, path.with_name(name))
        _log.warning("%s: not as it was written, kept as %s", path, name)
