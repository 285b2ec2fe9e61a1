"""`capture.json`: which steps of a capture are done, and what came out of each; written after each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drgs.data.shooting import Finding
from drgs.files import SCHEMA, write_json
from drgs.guards.json_files import check_json, read_json

__all__ = ["FOLDER", "CaptureRecord", "Step", "inputs_of"]

FOLDER = "capture"
"""Folder in the run: photographs, the data set that is made of them, and `capture.json`."""
_FILE = "capture.json"
_ADVICE = "capture into another folder (-o)"
_STEP = {"name": str, "line": str, "seconds": float}
_FINDING = {"kind": str, "text": str, "advice": str}


@dataclasses.dataclass(frozen=True)
class Step:
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
class CaptureRecord:
    """What `capture.json` holds.

    Attributes:
        path: Folder of the record.
        inputs: What was named: path, size in bytes and time of change of each file.
        options: Options by name.
        steps: Steps that are done, in order.
        findings: What is wrong with the capture, and what to do at the next shoot.
        plan: What the budget is spent on, by step.
    """

    path: Path
    inputs: list[list[Any]]
    options: dict[str, Any]
    steps: list[Step] = dataclasses.field(default_factory=list)
    findings: list[Finding] = dataclasses.field(default_factory=list)
    plan: dict[str, Any] = dataclasses.field(default_factory=dict)

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
        check_json(
            str(file),
            value,
            {"inputs": [list], "options": dict, "steps": [_STEP], "findings": [_FINDING], "plan": dict},
            _ADVICE,
        )
        steps = [Step(**{key: step[key] for key in _STEP}) for step in value["steps"]]
        findings = [Finding(**{key: one[key] for key in _FINDING}) for one in value["findings"]]
        return cls(path, value["inputs"], value["options"], steps, findings, value["plan"])

    def write(self) -> None:
        """Write the record, atomically."""
        write_json(
            self.path / _FILE,
            {
                "schema": SCHEMA,
                "command": "capture",
                "inputs": self.inputs,
                "options": self.options,
                "plan": self.plan,
                "steps": [dataclasses.asdict(step) for step in self.steps],
                "findings": [dataclasses.asdict(finding) for finding in self.findings],
            },
        )

    def step(self, name: str) -> Step | None:
        """A step that is done; None where it is not."""
        return next((step for step in self.steps if step.name == name), None)

    def done(self, step: Step, findings: Sequence[Finding] = ()) -> None:
        """Add a step, with what was found in it, and write."""
        self.steps.append(step)
        self.findings += findings
        self.write()


def inputs_of(files: Sequence[Path]) -> list[list[Any]]:
    """Path, size and time of change of each file."""
    stats = [(path, path.stat()) for path in files]
    return [[str(path.resolve()), stat.st_size, stat.st_mtime_ns] for path, stat in stats]
