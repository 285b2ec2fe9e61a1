"""Options that have moved: for one release the old spelling works as before, and says the new one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

__all__ = ["RENAMED", "Renamed", "as_written_now"]


@dataclasses.dataclass(frozen=True)
class Renamed:
    """An option that is written in another way now.

    Attributes:
        commands: Those that had it.
        old: The option.
        new: What is written in its place, as one option and one value; a `{}` for each value of the old one.
        values: How many words followed the old option.
    """

    commands: tuple[str, ...]
    old: str
    new: str
    values: int = 1


_AROUND = ("crossval", "fisher", "query", "render", "select", "tradeoff", "view")

RENAMED = (
    Renamed(_AROUND, "--up", "--orbit up={}"),
    Renamed(_AROUND, "--center", "--orbit center={},{},{}", 3),
    Renamed(_AROUND, "--distance", "--orbit distance={}"),
    Renamed(_AROUND, "--elevation", "--orbit elevation={}"),
    Renamed(_AROUND, "--span", "--orbit span={}"),
    Renamed(("crossval", "query", "render", "tradeoff"), "--fov", "--orbit fov={}"),
)
"""Rows leave with the release after the one that brought them."""


def as_written_now(command: str, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command line with today's options.

    Args:
        command: The command's name.
        words: What follows it.
    Returns:
        The words, and what to say about those that have changed, a line each.
    """
    rows = {row.old: row for row in RENAMED if command in row.commands}
    left = list(words)
    written = list[str]()
    notes = list[str]()
    while left:
        word = left.pop(0)
        option, equals, value = word.partition("=")
        row = rows.get(option)
        values = [value] if equals else left[: row.values] if row else []
        if row is None or len(values) != row.values:  # what is missing, the parser says
            written.append(word)
            continue
        if not equals:
            del left[: row.values]
        new = row.new.format(*values)
        written += new.split(" ", 1)
        notes.append(f"{row.old} is written {new} now; the old way ends with the next release")
    return written, notes
