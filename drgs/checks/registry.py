"""Registries of functions and classes by name, to which other packages add rows: policies, loaders, codecs,
responses.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping, MutableMapping
from importlib.metadata import EntryPoint
from typing import Any, Generic, TypeVar

from drgs.checks.imports import imported_function

T = TypeVar("T")


class Registry(MutableMapping[str, T], Generic[T]):
    """Name -> the function or class of that name, in the order in which rows were added.

    A row of this package is written where the table is made, as the value itself or as `module:attribute`, which is
    imported at its first lookup: a table that the command line reads for its names loads nothing heavy. Another
    package adds rows by entry points of the group, which are found when it is installed:

        [project.entry-points."drgs.policies"]
        mine = "my_package.policies:mine"

    and a script by an assignment, `POLICIES["mine"] = mine`. A row of this package cannot be replaced by an entry
    point, so that installing something never changes what a name means.

    Args:
        kind: What a row is, for messages: "policy".
        group: Group of the entry points: "drgs.policies".
        rows: Those of this package.
        row: Type that a row must have; None where any will do, as functions that are checked by what they return.
    """

    def __init__(self, kind: str, group: str, rows: Mapping[str, T | str], row: type[T] | None = None) -> None:
        self.kind = kind
        self.group = group
        self.row = row
        self._rows: dict[str, Any] = dict(rows)

    def __getitem__(self, name: str) -> T:
        if name in self._rows:
            row = self._rows[name]
            if isinstance(row, str):
                module, _, attribute = row.partition(":")
                self._rows[name] = row = getattr(importlib.import_module(module), attribute)
            return row
        point = _entry_points(self.group)[name]
        try:
            row = point.load()
        except Exception as error:  # whatever the other package raises, the line names it
            raise ValueError(
                f"{self.kind} {name!r} of {_package(point)}: must be importable, got {type(error).__name__}: {error}"
            ) from error
        self._rows[name] = self._checked(f"{self.kind} {name!r} of {_package(point)}", row)
        return row

    def __setitem__(self, name: str, value: T) -> None:
        self._rows[name] = self._checked(f"{self.kind} {name!r}", value)

    def _checked(self, where: str, row: T) -> T:
        """The row; ValueError where it has another type than rows of this table have."""
        if self.row is None or isinstance(row, self.row):
            return row
        wanted = f"{self.row.__module__}.{self.row.__name__}"
        raise ValueError(f"{where}: must be a {wanted}, got {type(row).__name__}; make one of it")

    def __delitem__(self, name: str) -> None:
        del self._rows[name]

    def __iter__(self) -> Iterator[str]:
        yield from dict.fromkeys([*self._rows, *_entry_points(self.group)])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self._rows or name in _entry_points(self.group)

    def find(self, where: str, name: str) -> T:
        """The row of a name that a user typed, or the function of another package that `package.module:function` names.

        Never for a name that a file holds: importing runs the module.

        Args:
            where: What an error begins with, e.g. `--policy`.
            name: A row's, or `package.module:function`.
        Raises:
            ValueError: If there is neither; one line that names all rows.
        """
        if name in self:
            return self[name]
        if ":" in name:
            return imported_function(where, name)  # type: ignore[return-value]  # its caller checks what it gets
        known = ", ".join(self)
        raise ValueError(
            f"{where}: {self.kind} must be one of {known}, or package.module:function, got {name!r}; choose one"
        )


@functools.cache
def _entry_points(group: str) -> dict[str, EntryPoint]:
    """Rows of installed packages by name; of two of a name the first that is found."""
    import importlib.metadata  # a quarter of what `import drgs.settings` takes, which looks up no table

    found: dict[str, EntryPoint] = {}
    for point in importlib.metadata.entry_points(group=group):
        found.setdefault(point.name, point)
    return found


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else point.value
