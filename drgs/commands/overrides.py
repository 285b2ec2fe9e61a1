"""`--set KEY=VALUE`: render settings as text. Imports nothing heavy: the options of every command read it."""

from __future__ import annotations

import re
import typing
from collections.abc import Sequence
from typing import Any

from drgs.settings import RenderSettings

__all__ = ["check_color", "override", "parsed", "parsed_size"]


def parsed(texts: Sequence[str]) -> dict[str, Any]:
    """The fields that texts like `order=ray` replace.

    Raises:
        ValueError: If one is no KEY=VALUE, names no field or has the wrong type.
    """
    hints = typing.get_type_hints(RenderSettings)
    values = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or key not in hints:
            what = "KEY=VALUE" if not equals else "a render setting"
            raise ValueError(f"--set: must be {what}, got {text!r}; known: {', '.join(hints)}")
        values[key] = _parse(key, hints[key], value)
    if "background" in values:
        check_color("--set background", values["background"])
    return values


def override(name: str, value: Any) -> str:
    """The text that `parsed` reads a field from."""
    if isinstance(value, tuple):
        return f"{name}={','.join(map(repr, value))}"
    if isinstance(value, bool):
        return f"{name}={str(value).lower()}"
    return f"{name}={value!r}" if isinstance(value, float) else f"{name}={value}"


def check_color(option: str, color: tuple[float, ...]) -> None:
    """Raise ValueError unless a color of an option is one that a photograph can have: R, G, B in [0, 1]."""
    if len(color) != 3 or not all(0 <= x <= 1 for x in color):
        got = " ".join(f"{x:g}" for x in color)
        raise ValueError(f"{option} must be R, G and B in [0, 1], got {got}; 255 is 1.0 here")


def parsed_size(option: str, text: str) -> tuple[int, int]:
    """(width, height) of a WIDTHxHEIGHT; ValueError if it is none."""
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
    if not found:
        raise ValueError(f"{option}: must be WIDTHxHEIGHT, got {text!r}; say e.g. 320x240")
    return int(found[1]), int(found[2])


def _parse(key: str, hint: Any, text: str) -> Any:
    """One --set value by its field's type: str, float, `float | None`, or a tuple of floats."""
    kinds = typing.get_args(hint) or (hint,)
    try:
        if typing.get_origin(hint) is tuple:
            return tuple(float(part) for part in text.strip("()[] ").split(","))
        if type(None) in kinds and text.lower() == "none":
            return None
        if bool in kinds:
            return {"true": True, "false": False}[text.lower()]
        number = next((kind for kind in (int, float) if kind in kinds), None)
        return number(text) if number else text
    except (ValueError, KeyError):
        kind = hint.__name__ if kinds == (hint,) else hint
        raise ValueError(f"--set {key}: must be of type {kind}, got {text!r}") from None
