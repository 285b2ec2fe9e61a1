"""Arguments of the wrong kind, and fields out of range: refused at the door, in one sentence."""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import os
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class ArgumentError(TypeError, ValueError):
    """An argument of the wrong kind: a TypeError, and a ValueError, which the command line prints as one line."""


def must_be(where: str, name: str, value: Any, kinds: type | tuple[type, ...], hint: str) -> None:
    """Raise `ArgumentError` unless `value` is an instance of one of `kinds`.

    Args:
        where: The function.
        name: The argument.
        value: What was passed.
        kinds: What it may be.
        hint: What to pass instead, for the message.
    """
    if isinstance(value, kinds):
        return
    names = " or ".join(kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
    article = "an" if names[0] in "AEIOUaeiou" else "a"
    raise ArgumentError(f"{where}: {name} must be {article} {names}, got {kind_of(value)}; {hint}")


def said(error: Exception, longest: int = 120) -> str:
    """The message of a library's error in one line of at most so many characters; its type where there is none."""
    return " ".join(str(error).split())[:longest] or type(error).__name__


def kind_of(value: Any) -> str:
    """A value in a few words: its type, and its shape, length or text."""
    if value is None:
        return "None"
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple):
        return f"a {type(value).__name__} of shape {tuple(shape)}"
    if isinstance(value, str | int | float | bool):
        text = repr(value)
        return f"the {type(value).__name__} {text if len(text) <= 40 else text[:37] + '...'}"
    if isinstance(value, list | tuple) and value:
        return f"a {type(value).__name__} of {len(value)} ({', '.join(sorted({type(x).__name__ for x in value}))})"
    return f"a value of type {type(value).__name__}"


def check_path(where: str, path: Any) -> Path:
    """A file name as a Path."""
    must_be(where, "path", path, (str, os.PathLike), 'a file name, e.g. "point_cloud.ply"')
    return Path(path)


def check_fields(
    where: str,
    record: Any,
    ranges: Mapping[str, tuple[float, float]] = {},
    words: Mapping[str, str] = {},
) -> None:
    """Raise ValueError unless the fields of a frozen dataclass have their annotated types and lie in their ranges.

    Of a field annotated as a `Literal`, the value is one of those. Numbers are finite; a whole number may stand for a
    float, and a NumPy or torch scalar for a Python one, which replaces it in the record.

    Args:
        where: The record, for the message.
        record: An instance of a dataclass.
        ranges: Field -> (lowest, highest), both allowed; of tuples, each of their numbers.
        words: Field -> what a command line calls its None.
    """
    for name, hint in _hints(type(record)).items():  # type: ignore[arg-type]  # a class is hashable
        value = getattr(record, name)
        if typing.get_origin(hint) is typing.Literal:
            choices = typing.get_args(hint)
            if isinstance(value, bool) or not any(isinstance(value, type(x)) and value == x for x in choices):
                shown = ", ".join(map(str, choices))
                raise ValueError(f"{where}: {name} must be one of {shown}, got {value!r}")
            continue
        low, high = ranges.get(name, (-math.inf, math.inf))
        checked, problem = _checked(value, hint, low, high)
        if problem:
            called = f" ({words[name]})" if name in words else ""
            raise ValueError(f"{where}: {name} must be {problem}{called}, got {value!r}")
        if checked is not value:
            object.__setattr__(record, name, checked)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _checked(value: Any, hint: Any, low: float, high: float) -> tuple[Any, str | None]:
    """The value as its field holds it, and what it must be instead if it cannot."""
    kinds = typing.get_args(hint)
    if type(None) in kinds:
        if value is None:
            return None, None
        checked, problem = _checked(value, next(kind for kind in kinds if kind is not type(None)), low, high)
        return checked, f"{problem}, or None" if problem else None
    if typing.get_origin(hint) is typing.Literal:
        return value, None if value in kinds else f"one of {', '.join(map(str, kinds))}"
    if typing.get_origin(hint) is tuple and kinds[-1] is Ellipsis:
        if not isinstance(value, list | tuple):
            return value, "a tuple"
        problems = (_checked(x, kinds[0], low, high)[1] for x in value)
        return tuple(value), next((f"a tuple, each {problem}" for problem in problems if problem), None)
    if typing.get_origin(hint) is tuple:
        listed = value.tolist() if hasattr(value, "tolist") else value
        if isinstance(listed, list | tuple) and len(listed) == len(kinds):
            pairs = [_checked(x, kind, low, high) for x, kind in zip(listed, kinds, strict=True)]
            if not any(problem for _, problem in pairs):
                return tuple(x for x, _ in pairs), None
        return value, f"{len(kinds)} finite numbers{_between(low, high)}"
    if hint in (int, float):
        what = "a whole number" if hint is int else "a finite number"
        if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
            value = value.item()
        is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        good = is_number and (hint is float or isinstance(value, int)) and _finite(value) and low <= value <= high
        return value, None if good else what + _between(low, high)
    return value, None if isinstance(value, hint) else {bool: "True or False", str: "a text"}.get(
        hint, f"a {getattr(hint, '__name__', hint)}"
    )


def _finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer that no float holds
        return False


def _between(low: float, high: float) -> str:
    if low == -math.inf and high == math.inf:
        return ""
    if high == math.inf:
        return f" >= {low:g}"
    shown = (f"{int(x)}" if x == int(x) and abs(x) < 1e15 else f"{x:g}" for x in (low, high))
    return f" in [{', '.join(shown)}]"
