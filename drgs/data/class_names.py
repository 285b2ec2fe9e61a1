"""What the numbers in label images mean: `classes.json`, `classes.txt`, and Replica's `info_semantic.json`."""

from __future__ import annotations

from pathlib import Path

from drgs.data.checks import read_text
from drgs.io.json_files import check_json, read_json

__all__ = ["CLASS_FILES", "NO_CLASS", "read_class_names"]

CLASS_FILES = ("classes.json", "classes.txt", "info_semantic.json")
# Names of what is no class, case aside.
NO_CLASS = ("unlabelled", "unlabeled", "void", "ignore", "undefined", "none")
_LARGEST = 1 << 20  # bytes; a thousand classes take some 20 KB
_ADVICE = 'write {"classes": [{"id": 1, "name": "wall"}, ...]}'


def read_class_names(path: Path) -> tuple[dict[int, str], set[int]]:
    """The classes that a file names, in its order.

    JSON: an object with `classes`, a list of objects with `id` and `name` (drgs, Replica), or a list of names,
    which are 1, 2, .... Text: a line a class, `NUMBER NAME`, or names alone, which are 1, 2, ....

    Returns:
        Number in label images -> name; and the numbers of what is no class (`NO_CLASS`).
    Raises:
        FileNotFoundError: No such file.
        ValueError: Not that layout, a number twice, or no class at all.
    """
    read = _json_rows if path.suffix == ".json" else _text_rows
    names: dict[int, str] = {}
    void: set[int] = set()
    for where, number, name in read(path):
        if number in names or number in void:
            raise ValueError(f"{where}: must have a number of its own, {number} is there twice; correct it")
        if name.casefold() in NO_CLASS:
            void.add(number)
        else:
            names[number] = name
    if not names:
        raise ValueError(f"{path}: must name at least one class, names none; {_ADVICE}")
    return names, void


def _json_rows(path: Path) -> list[tuple[str, int, str]]:
    """(where, number, name) of each class of a JSON file."""
    data = read_json(path, "a file of class names", _ADVICE)
    rows = data.get("classes") if isinstance(data, dict) else data
    if not isinstance(rows, list):
        raise ValueError(f"{path}: must be a list of classes, or an object with one named `classes`; {_ADVICE}")
    found = []
    for index, row in enumerate(rows):
        where = f"{path}: class {index}"
        if not isinstance(row, str):
            check_json(where, row, {"id": int, "name": str}, _ADVICE)
        number, name = (index + 1, row) if isinstance(row, str) else (row["id"], row["name"])
        found.append((where, number, _name(where, name)))
    return found


def _text_rows(path: Path) -> list[tuple[str, int, str]]:
    """(where, number, name) of each line of a text file; empty lines and those that begin with # are left out."""
    lines = read_text(path, "a file of class names", _LARGEST).splitlines()
    rows = [(number, line.split()) for number, line in enumerate(lines, 1)]
    rows = [(number, words) for number, words in rows if words and not words[0].startswith("#")]
    numbered = [words[0].isascii() and words[0].isdigit() and len(words) > 1 for _, words in rows]
    if any(numbered) and not all(numbered):
        line = rows[numbered.index(False)][0]
        raise ValueError(f"{path}: line {line} must be `NUMBER NAME` as other lines are, is not; correct it")
    found = []
    for index, (line, words) in enumerate(rows, 1):
        where = f"{path}: line {line}"
        if any(numbered) and len(words[0]) > 9:
            raise ValueError(f"{where} must begin with a number of at most 9 digits, does not; correct it")
        number, name = (int(words[0]), " ".join(words[1:])) if any(numbered) else (index, " ".join(words))
        found.append((where, number, _name(where, name)))
    return found


def _name(where: str, name: str) -> str:
    name = " ".join(name.split())
    if not name:
        raise ValueError(f"{where}: must have a name, it is empty; correct it")
    return name
