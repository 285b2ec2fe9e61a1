"""docs/data/run-files.csv: the fields that it names of each JSON file, and whether a real file has just these."""

from __future__ import annotations

import csv
import re

from doc_pages import ROOT

PAGE = (ROOT / "docs" / "run-files.md").read_text(encoding="utf-8")
"""What people read: every file, and the fields of those that a fit leaves."""
with (ROOT / "docs" / "data" / "run-files.csv").open(encoding="utf-8", newline="") as _file:
    ROWS = list(csv.DictReader(_file))
OF_CAPTURE = ("exposure", "wall", "shadow", "passer_by", "pose_error")
"""Fields of params.json that only `drgs scene capture` writes."""
_ELSEWHERE = ("settings", "camera", "env")
"""Fields whose content is told elsewhere: of `RenderSettings`, of selection.json, of env.json."""


def titles() -> set[str]:
    """The files that are told."""
    return {row["file"] for row in ROWS}


def section(title: str) -> list[list[str]]:
    """Fields and their meaning, of each row of a file."""
    rows = [[row["field"], row["meaning"]] for row in ROWS if row["file"] == title]
    assert rows, f"no rows of {title}"
    return rows


def names(text: str) -> set[str]:
    """What is in backticks."""
    return set(re.findall(r"`([\w, -]+)`", text))


def names_of(record: object, maps: dict[str, int], opaque: set[str], field: str = "") -> set[str]:
    """The fields in a file, at any depth.

    Args:
        record: A value of JSON.
        maps: Field -> how many levels of its keys are names of groups, of metrics, ..., not of fields.
        opaque: Fields whose content is told elsewhere.
        field: That this is the value of.
    """
    found: set[str] = set()
    if isinstance(record, list):
        for value in record:
            found |= names_of(value, maps, opaque, field)
    elif isinstance(record, dict):
        levels = maps.get(field.rstrip("/"), 0) - field.count("/")
        for name, value in record.items():
            if levels > 0:
                found |= names_of(value, maps, opaque, f"{field}/")
            else:
                found.add(name)
                found |= names_of(value, maps, opaque, name) if name not in opaque else set()
    return found


def check(
    title: str,
    *records: object,
    maps: tuple[str, ...] = (),
    absent: tuple[str, ...] = (),
    elsewhere: tuple[str, ...] = (),
) -> None:
    """Assert that the rows of a file name every field of real ones, and no other.

    Args:
        title: Name of the file.
        records: What such files hold, together every field that there is.
        maps: Fields whose own keys are data; twice, where those of their values are, too.
        absent: Fields of the rows that only other files than these have.
        elsewhere: Further fields whose content is told elsewhere.
    """
    levels = {name: maps.count(name) for name in maps}
    found = set().union(*(names_of(record, levels, {*_ELSEWHERE, *elsewhere}) for record in records)) - {"schema"}
    told = set().union(*(names(" ".join(cells)) for cells in section(title)))
    assert found - told == set(), f"fields that {title} does not tell: {sorted(found - told)}"
    assert told - found == set(absent), f"what no {title} has: {sorted(told - found - set(absent))}"
