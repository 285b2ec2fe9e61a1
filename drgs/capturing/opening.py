"""Which capture a command begins, resumes or extends; what contradicts it is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drgs.capturing.capture import SCENE, CaptureOptions
from drgs.capturing.record import FOLDER, Batch, CaptureRecord, inputs_of
from drgs.fitting.records import is_run


def new_files(
    options: CaptureOptions,
    before: CaptureRecord,
    photographs: Sequence[Path],
    videos: Sequence[Path],
    say: Callable[[str], None],
) -> tuple[list[Path], list[Path]]:
    """Photographs and videos that are not in a capture yet: a phone's folder has the old ones, too.

    Args:
        options: Options of the command.
        before: The capture that they join.
        photographs, videos: What was named.
        say: Prints how many are in the capture already.
    Raises:
        ValueError: If all are.
    """
    others = before.batches
    if len(others) > 1 and (options.resume or _has_no_poses(before)):
        others = others[:-1]
    known = [row for batch in others for row in batch.inputs]
    new = [[path for path in paths if inputs_of([path])[0] not in known] for paths in (photographs, videos)]
    if not any(new):
        raise ValueError(f"{options.paths[0]}: --add must have photographs that are not in the capture yet, got none")
    if old := len(photographs) + len(videos) - sum(map(len, new)):
        say(f"{old} of the files are in the capture already")
    return new[0], new[1]


def open_record(options: CaptureOptions, inputs: list[list[Any]], is_dataset: bool) -> CaptureRecord:
    """The record of the capture to continue; its last batch is the current one.

    Args:
        options: Options of the command.
        inputs: `inputs_of` the files that were named.
        is_dataset: Whether they are a data set with poses.
    Raises:
        ValueError: If there is one and neither --resume nor --add is given, its files or options were others, or it
            cannot be added to.
    """
    folder = options.output / FOLDER
    before = CaptureRecord.read(folder)
    batch = Batch(inputs, {"frames": options.frames, "masks": options.masks, "seed": options.seed})
    # What ended before its first photographs had poses is begun anew by the same command.
    is_new = before is None or (len(before.batches) == 1 and _has_no_poses(before) and not options.resume)
    if options.add and not options.resume and before is not None:
        return _with_new_batch(options, before, batch)
    if is_new or before is None:
        if options.add:
            raise ValueError(f"{options.output}: --add must have a capture to add to, found none; leave --add out")
        if is_run(options.output):
            raise ValueError(
                f"{options.output}: must be a new folder, or that of a capture, holds a run of `drgs fit`; choose "
                "another"
            )
        record = CaptureRecord(folder, [batch])
        record.write()
        return record
    if not options.resume:
        raise ValueError(
            f"{options.output}: must be a new folder, holds a capture already; add --resume or --add, or choose another"
        )
    _check_same(options, before, batch, is_dataset)
    return before


def _has_no_poses(record: CaptureRecord) -> bool:
    """Whether the last photographs have no poses yet, so that they have changed nothing."""
    return record.batch.step("poses") is None


def _check_same(options: CaptureOptions, before: CaptureRecord, batch: Batch, is_dataset: bool) -> None:
    """Refuse to resume with other files or options than those of the capture."""
    where = f"{options.output}: --resume must continue"
    if options.add != (len(before.batches) > 1):
        now, advice = (
            ("first", "leave --add out") if options.add else ("added", "say --add, too, or name no photographs")
        )
        raise ValueError(f"{where} the last photographs, the {now} ones; {advice}")
    was = before.batch.options
    if other := next((name for name, value in batch.options.items() if was.get(name) != value), None):
        raise ValueError(
            f"{where} the same capture, --{other} was {was.get(other)!r} and is {batch.options[other]!r}; repeat the "
            "options or choose another folder"
        )
    if before.batch.inputs != batch.inputs:
        rows = [*before.batch.inputs, *batch.inputs]
        changed = next(
            (row[0] for row in rows if row not in before.batch.inputs or row not in batch.inputs), "their order"
        )
        kind = "the data set" if is_dataset else "the photographs"
        raise ValueError(
            f"{where} the same capture, {kind} changed: {changed}; name the same files or choose another folder"
        )


def _with_new_batch(options: CaptureOptions, record: CaptureRecord, batch: Batch) -> CaptureRecord:
    """The record with a new last batch, which replaces one without poses."""
    if len(record.batches) > 1 and _has_no_poses(record):
        record.batches.pop()
    if any(record.batch.step(name) is None for name in ("fit", "report")):
        raise ValueError(
            f"{options.output}: --add must follow a capture that is done, this one is not; go on with --resume first"
        )
    if not (record.path / SCENE).is_dir():
        raise ValueError(
            f"{options.output}: --add must have a capture of photographs, this one was of a data set with poses; fit "
            "anew to all of it"
        )
    if batch.options["masks"] is not None or record.batches[0].options.get("masks") is not None:
        raise ValueError(f"{options.output}: --add must have photographs without masks; capture all of them anew")
    record.batches.append(batch)
    record.write()
    return record
