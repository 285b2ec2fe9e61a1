"""`capture.json`: the steps of a capture that are done, with their results; written after each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drgs.io.journal import SCHEMA, check_schema
from drgs.io.json_files import check_json, read_json
from drgs.io.outputs import write_json
from drgs.sfm.findings import Finding

FOLDER = "capture"
"""Folder in the run with the photographs, their data set and `capture.json`."""
_FILE = "capture.json"
_ADVICE = "capture into another folder (-o)"
_STEP = {"name": str, "line": str, "seconds": float}
_FINDING = {"kind": str, "text": str, "advice": str}
_BATCH = {
    "inputs": [list],
    "options": dict,
    "steps": [_STEP],
    "findings": [_FINDING],
    "plan": dict,
    "handover": str,
    "result": dict,
}


@dataclasses.dataclass(frozen=True)
class DoneStep:
    """A step that is done.

    Attributes:
        name: `photos`, `poses`, `fit`, `report` or `share`.
        line: What came out of it.
        seconds: How long it took.
    """

    name: str
    line: str
    seconds: float


@dataclasses.dataclass
class Batch:
    """Photographs that were captured together: the first ones, or ones that joined them.

    Attributes:
        inputs: What was named: path, size in bytes and time of change of each file.
        options: Options by name.
        steps: Steps that are done, in order.
        findings: What is wrong with the photographs, and what to do at the next shoot.
        plan: What the budget is spent on, by step.
        handover: How far the run of the batch before has made room for the next fit. Empty: not yet; `kept`: its
            checkpoint is in the folder of the capture; `cleared`: its files are gone from the run folder, too.
        result: Mean PSNR of the held-out views after the fit, in dB (None: there are none), and the pixels of a
            photograph; empty before.
    """

    inputs: list[list[Any]]
    options: dict[str, Any]
    steps: list[DoneStep] = dataclasses.field(default_factory=list)
    findings: list[Finding] = dataclasses.field(default_factory=list)
    plan: dict[str, Any] = dataclasses.field(default_factory=dict)
    handover: str = ""
    result: dict[str, Any] = dataclasses.field(default_factory=dict)

    def step(self, name: str) -> DoneStep | None:
        """The record of a step; None while it is not done."""
        return next((step for step in self.steps if step.name == name), None)

    def advice(self) -> list[str]:
        """The findings, a line each."""
        return [f"at the next shoot: {finding.line()}" for finding in self.findings]


@dataclasses.dataclass
class CaptureRecord:
    """Contents of `capture.json`.

    Attributes:
        path: Folder of the record.
        batches: The first photographs, and those that joined them, each with the steps that are done.
    """

    path: Path
    batches: list[Batch]

    @property
    def batch(self) -> Batch:
        """The current batch, the last one."""
        return self.batches[-1]

    @classmethod
    def read(cls, path: Path) -> CaptureRecord | None:
        """The record of a folder; None where there is none.

        Raises:
            ValueError: If it is damaged.
        """
        file = path / _FILE
        if not file.is_file():
            return None
        value = read_json(file, "the record of a capture", _ADVICE)
        check_schema(file, value, (SCHEMA,), "schema", _ADVICE)
        check_json(str(file), value, {"batches": [_BATCH]}, _ADVICE)
        if not value["batches"]:
            raise ValueError(f"{file}: batches must be one or more, got none; {_ADVICE}")
        for row in (row for batch in value["batches"] for row in batch["inputs"]):
            if [type(x) for x in row] != [str, int, int]:
                raise ValueError(f"{file}: inputs must be rows of path, size and time, got {row!r:.60}; {_ADVICE}")
        batches = [
            Batch(
                batch["inputs"],
                batch["options"],
                [DoneStep(**{key: step[key] for key in _STEP}) for step in batch["steps"]],
                [Finding(**{key: one[key] for key in _FINDING}) for one in batch["findings"]],
                batch["plan"],
                batch["handover"],
                batch["result"],
            )
            for batch in value["batches"]
        ]
        return cls(path, batches)

    def write(self) -> None:
        """Write the record, atomically."""
        write_json(
            self.path / _FILE,
            {
                "schema": SCHEMA,
                "command": "capture",
                "batches": [dataclasses.asdict(batch) for batch in self.batches],
            },
        )

    def done(self, step: DoneStep, findings: Sequence[Finding] = ()) -> None:
        """Add a step to the last batch, with its findings, and write."""
        self.batch.steps.append(step)
        self.batch.findings += findings
        self.write()


def inputs_of(files: Sequence[Path]) -> list[list[Any]]:
    """Path, size and time of change of each file."""
    stats = [(path, path.stat()) for path in files]
    return [[str(path.resolve()), stat.st_size, stat.st_mtime_ns] for path, stat in stats]
