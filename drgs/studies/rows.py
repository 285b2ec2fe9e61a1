"""The cells of studies, and their rows: JSON lines that several processes append to, one for each finished cell."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drgs.fitting.config import Start
from drgs.io.journal import Journal


@dataclasses.dataclass(frozen=True)
class Cell:
    """One fit of a study.

    Attributes:
        scene: Name of a data set of the study.
        split: (n, k): every n-th view by name is held out, from index k on; (0, 0): those that the data set states.
        start: `first` view by name, or the one that the `seed` draws; the others of the initial views follow from it.
        policy: Label of a policy of the study.
        protocol: A name of `drgs.studies.protocols.PROTOCOLS`.
        seed: Seed of everything random in the fit.
        camera: Camera that is held out at all times, where several film at once, in place of `split`, which
            is (0, 0); what is known at the start is what all others see at the first time, whatever `start` says.
    """

    scene: str
    split: tuple[int, int]
    start: Start
    policy: str
    protocol: str
    seed: int
    camera: str = ""

    @property
    def name(self) -> str:
        """Of its run folder."""
        words = re.sub(r"[^a-z0-9.+]+", "-", self.policy.lower()).strip("-")
        held_out = self.camera or "{}+{}".format(*self.split)
        return f"{self.scene}-{held_out}-{self.start}{self.seed}-{self.protocol}-{words}"

    def to_json(self) -> dict:
        """As a row begins; without a camera where none is held out, as in rows of studies that know none."""
        fields = {**dataclasses.asdict(self), "split": list(self.split)}
        return fields if self.camera else {name: x for name, x in fields.items() if name != "camera"}


def cell_of(row: Mapping[str, Any]) -> tuple[str, Cell]:
    """The study and the cell of a row."""
    fields = {field.name: row[field.name] for field in dataclasses.fields(Cell) if field.name != "camera"}
    return row["study"], Cell(**{**fields, "split": tuple(fields["split"]), "camera": row.get("camera", "")})


def read_study(*paths: Path) -> list[dict]:
    """The rows of JSON-lines files (`drgs.io.journal`), merged by cell; of two rows of one cell the later one counts.

    Raises:
        ValueError: If a line is damaged.
    """
    rows = [row for path in paths for row in Journal(path).rows(cell_of, "a row of a study")]
    return list({cell_of(row): row for row in rows}.values())


def is_done(study: str, cell: Cell, rows: Iterable[Mapping[str, Any]], keys: Iterable[str]) -> bool:
    """Whether a cell has a row that holds these metrics, be it None for what could not be computed."""
    matching = [row for row in rows if cell_of(row) == (study, cell)]
    return any(set(keys) <= set(row["metrics"]) for row in matching)


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row to a file that other processes add to as well, unless one that says as much of its cell is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Journal(path, durable=True).append(row, unless=lambda rows: is_done(*cell_of(row), rows, row["metrics"]))
