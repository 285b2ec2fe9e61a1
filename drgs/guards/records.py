"""Frozen records that are made of others: every field can be named alone, and files hold them as nested objects."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

from drgs.guards.arguments import ArgumentError, kind_of, must_be

__all__ = ["TRANSIENT", "Record", "first_difference", "hints_of", "nearest", "part_of", "stated", "texts_of", "ways_of"]

TRANSIENT: Mapping[str, Any] = {"transient": True}
"""Metadata of a field that is found out at run time: no file holds it, and nobody names it among those of a record."""


class Record:
    """What a frozen dataclass inherits whose fields may be records again.

    Names of fields are unique in all of them, so that `max_gaussians` says enough: `of` and `replace` take any.

    Attributes:
        where: How messages call it. A message about a part names the record that was being made.
    """

    where: ClassVar[str] = ""

    @classmethod
    def of(cls, **fields: Any) -> Self:
        """The record with these fields, of whichever part; all others have their defaults.

        Raises:
            ArgumentError: If there is no field of a name.
            ValueError: As the records say.
        """
        return _with(cls, None, fields)

    def replace(self, **fields: Any) -> Self:
        """A copy with these fields, of whichever part.

        Raises:
            ArgumentError, ValueError: As `of`.
        """
        return _with(type(self), self, fields)

    def to_json(self) -> dict:
        """The nested object of a file: `from_json` reads it."""
        kind: Any = type(self)
        return {name: _plain(getattr(self, name)) for name in hints_of(kind)}

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """The inverse of `to_json`. A field may also stand beside the parts, as older versions wrote all of them.

        Raises:
            ValueError: If a field is unknown or has another type, and as the records say.
        """
        return _with(cls, None, stated(cls, value))


def _with(kind: Any, base: Any, fields: Mapping[str, Any]) -> Any:
    """A record of a kind like `base` (None: the defaults), with fields of it and of its parts."""
    ways = ways_of(kind)
    own: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in fields.items():
        if name not in ways:
            raise ArgumentError(
                f"{kind.__name__}: there must be a field of the name, got {name!r}; {nearest(name, ways)}"
            )
        if len(ways[name]) == 1:
            own[name] = value
        else:
            inner.setdefault(ways[name][0], {})[name] = value
    defaults = {field.name: field for field in dataclasses.fields(kind)}
    for name, changed in inner.items():
        part = part_of(hints_of(kind)[name])
        factory: Any = defaults[name].default_factory
        usual = None if factory is dataclasses.MISSING else factory()
        before = own[name] if name in own else usual if base is None else getattr(base, name)
        try:
            own[name] = _with(part, before, changed)
        except ArgumentError:
            raise
        except ValueError as error:
            raise type(error)(_renamed(str(error), part, kind)) from None
    kept = {} if base is None else {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    return kind(**{**kept, **own})


def _renamed(message: str, part: Any, kind: Any) -> str:
    """A message of a part as the record that holds it says it."""
    was = f"{part.where}: "
    return f"{kind.where}: {message.removeprefix(was)}" if message.startswith(was) else message


def nearest(name: str, known: Iterable[str]) -> str:
    """What to do about a name that is unknown: `did you mean max_gaussians?`."""
    found = difflib.get_close_matches(name, list(known), 1, 0.5)
    return f"did you mean {found[0]}?" if found else "none has a name like it"


@functools.cache
def hints_of(kind: type) -> Mapping[str, Any]:
    """Field -> its type, in their order; of records without those that are `TRANSIENT`."""
    space = vars(sys.modules[kind.__module__])
    found: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if not field.metadata.get("transient"):
            alone = types.SimpleNamespace(__annotations__={field.name: field.type})
            found |= typing.get_type_hints(alone, space)
    return types.MappingProxyType(found)


@functools.cache
def ways_of(kind: type) -> Mapping[str, tuple[str, ...]]:
    """Field, of the record and of its parts -> the names on the way to it: max_pixels -> (data, max_pixels)."""
    hints = hints_of(kind)
    found: dict[str, tuple[str, ...]] = {name: (name,) for name in hints}
    for name, hint in hints.items():
        if part := part_of(hint):
            for inner, way in ways_of(part).items():
                assert inner not in found, f"{kind.__name__}: {inner} is the name of two fields"
                found[inner] = (name, *way)
    return types.MappingProxyType(found)


def part_of(hint: Any) -> Any:
    """The record that a field of a type holds, be it optional; None of other types."""
    kinds = typing.get_args(hint) or (hint,)
    return next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Record)), None)


@functools.cache
def texts_of(kind: type) -> Mapping[str, str]:
    """Field, of the record and of its parts -> what its docstring's `Attributes` say of it, as one line."""
    found: dict[str, str] = {}
    # Python 3.13 takes the indentation of the code off docstrings, those before do not.
    told = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2]
    for block in re.split(r"\n(?= {4}\w)", "\n" + told.partition("\nRaises:")[0].partition("\nReference:")[0]):
        names, colon, text = block.strip().partition(": ")
        if colon:
            found |= {name: " ".join(text.split()) for name in names.split(", ") if name in hints_of(kind)}
    for hint in hints_of(kind).values():
        if part := part_of(hint):
            found |= texts_of(part)
    return types.MappingProxyType(found)


def stated(kind: Any, value: Any) -> dict[str, Any]:
    """What a nested object says, as fields by their names; those of parts stand beside the others.

    A part that may be None and is there has itself an entry, with its defaults.

    Raises:
        ValueError: If a field is unknown, or one that is a record is none.
    """
    where = kind.where
    must_be(where, "config", value, dict, f"as {kind.__name__}.to_json() makes it")
    ways = ways_of(kind)
    found: dict[str, Any] = {}
    for name, x in value.items():
        if name not in ways:
            raise ValueError(
                f"{where}: config must hold known fields, got {name!r}; {nearest(str(name), ways)} "
                "(or was it written by a newer drgs?)"
            )
        hint = _hint(kind, ways[name])
        part = part_of(hint)
        if part is None:
            found[name] = _converted(where, name, x, hint)
        elif x is None and type(None) in typing.get_args(hint):
            found[name] = None
        elif isinstance(x, dict):
            if type(None) in typing.get_args(hint):
                found[name] = part()
            found |= stated(part, x)
        else:
            raise ValueError(f"{where}: {name} must be an object with fields of {part.__name__}, got {kind_of(x)}")
    return found


def _hint(kind: Any, way: tuple[str, ...]) -> Any:
    """The type of the field at the end of a way."""
    for name in way[:-1]:
        kind = part_of(hints_of(kind)[name])
    return hints_of(kind)[way[-1]]


def _converted(where: str, name: str, value: Any, hint: Any) -> Any:
    """A value of a file as its field holds it: an object becomes the dataclass that is meant, a list a tuple."""
    kinds = typing.get_args(hint) or (hint,)
    whole: Any = next((kind for kind in kinds if dataclasses.is_dataclass(kind)), None)
    if whole is None:
        return tuple(value) if isinstance(value, list) else value
    if not isinstance(value, dict):
        if value is None and type(None) in kinds:
            return None
        must_be(where, name, value, dict, f"the fields of a {whole.__name__}")
    known = hints_of(whole)
    if unknown := [key for key in value if key not in known]:
        raise ValueError(f"{where}: {name} must hold known fields, got {unknown[0]!r}; {nearest(unknown[0], known)}")
    return whole(**{key: tuple(x) if isinstance(x, list) else x for key, x in value.items()})


def _plain(value: Any) -> Any:
    """A value as JSON holds it."""
    if isinstance(value, Record):
        return value.to_json()
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(x) for key, x in value.items()}
    return [_plain(x) for x in value] if isinstance(value, list | tuple) else value


def first_difference(mine: dict, theirs: dict) -> tuple[str, Any, Any] | None:
    """The first key, in the innermost of two JSON objects of the same keys, with other values, and both values."""
    for name, x in mine.items():
        y = theirs[name]
        if isinstance(x, dict) and isinstance(y, dict):
            if found := first_difference(x, y):
                return found
        elif x != y:
            return name, x, y
    return None
