"""JSON, and TOML, that others wrote or edited: parsed with limits, and validated before use."""

from __future__ import annotations

import json
import math
import tomllib
import unicodedata
from pathlib import Path
from typing import Any

from drgs.io.foreign import refuse_foreign

_MAX_JSON_BYTES = 1 << 29  # bytes; ten thousand photographs with all their fields take some 20 MB
_MAX_TOML_BYTES = 1 << 20  # bytes; a file of all options has some 10 KB
_INT64 = 1 << 63  # integers beyond are no 64-bit ones


def read_json(path: Path, what: str = "a JSON file", advice: str = "write the file again") -> Any:
    """Parse a JSON file.

    Args:
        path: The file.
        what: What it must be, and what to do if it is not, for the message.
        advice: See `what`.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not JSON, too large or too deeply nested, or known to be of another kind.
    """
    return parse_json(read_bounded(path, what, advice, _MAX_JSON_BYTES), str(path), advice)


def read_toml(path: Path, what: str = "a TOML file", advice: str = "write the file again") -> dict[str, Any]:
    """Parse a TOML file, of at most 1 MiB: people write these.

    Args, Raises: As `read_json`.
    """
    data = read_bounded(path, what, advice, _MAX_TOML_BYTES)
    try:
        return tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n"))
    except RecursionError:
        raise ValueError(f"{path}: must be valid TOML, got one that is nested too deeply; {advice}") from None
    except ValueError as error:
        raise ValueError(f"{path}: must be valid TOML, got {' '.join(str(error).split())}; {advice}") from None


def read_bounded(path: Path, what: str, advice: str, largest: int) -> bytes:
    """The bytes of a file that is not too large, and not known to be of another kind.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Larger, or of another format.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be {what}, found none; check the path")
    refuse_foreign(path, what)
    if path.stat().st_size > largest:
        raise ValueError(f"{path}: must be {what} of at most {largest >> 20} MiB, is larger; {advice}")
    return path.read_bytes()


def parse_json(data: bytes | str, where: str, advice: str = "write the file again") -> Any:
    """The value of a JSON text in UTF-8.

    Integers that no 64 bits hold become floats (infinite ones, if need be), so that a check for finite numbers is all
    that a reader must do; NaN and Infinity, which Python writes, are read as such for the same reason.

    Raises:
        ValueError: If it is not JSON, or nested deeper than Python reads.
    """
    try:
        text = data.decode("utf-8-sig") if isinstance(data, bytes) else data
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError(f"{where}: must be valid JSON, got one that is nested too deeply; {advice}") from None
    except ValueError as error:
        raise ValueError(f"{where}: must be valid JSON, got {' '.join(str(error).split())}; {advice}") from None


def _integer(digits: str) -> int | float:
    value = int(digits) if len(digits) < 20 else math.inf
    return value if abs(value) < _INT64 else float(digits)


def check_json(where: str, value: Any, kind: Any, advice: str) -> None:
    """Raise ValueError, in one line, unless a JSON value has the fields and types that its reader uses.

    Args:
        where: The file, for the message.
        value: What `parse_json` returned.
        kind: `int`, `float` (a finite number), `str` (of characters that a file name may have), `bool`, `dict` or
            `list`; `[kind]` for a list of it; `{key: kind}` for an object with at least these keys; a tuple of kinds
            for any of them, None among them where null may stand.
        advice: What to do about it.
    """
    problem = _problem(value, kind, "")
    if problem:
        raise ValueError(f"{where}: {problem}; {advice}")


def _problem(value: Any, kind: Any, at: str) -> str | None:
    """What must be where instead of what, of the first problem."""
    if isinstance(kind, tuple):
        problems = [_problem(value, option, at) for option in kind]
        # What the last kind misses is the most telling: null stands first.
        return None if None in problems else problems[-1]
    if isinstance(kind, dict) and isinstance(value, dict):
        for key, inner in kind.items():
            if key not in value:
                return f"{at or 'it'} must have the key {key!r}, found none"
            if problem := _problem(value[key], inner, f"{at}.{key}" if at else key):
                return problem
        return None
    if isinstance(kind, list) and isinstance(value, list):
        return next((p for i, x in enumerate(value) if (p := _problem(x, kind[0], f"{at}[{i}]"))), None)
    return None if _is(value, kind) else f"{at or 'it'} must be {_name(kind)}, got {_shown(value)}"


def _is(value: Any, kind: Any) -> bool:
    if kind is None:
        return value is None
    if kind in (int, float):
        whole = isinstance(value, int) and not isinstance(value, bool)
        return whole or (kind is float and isinstance(value, float) and math.isfinite(value))
    if kind is str:
        return isinstance(value, str) and not any(unicodedata.category(c) in ("Cc", "Cs") for c in value)
    return isinstance(kind, type) and isinstance(value, kind)


def _name(kind: Any) -> str:
    """The name of a value's kind in an error."""
    if isinstance(kind, list | dict):
        kind = type(kind)
    names = {
        int: "a whole number",
        float: "a finite number",
        str: "a text without control characters",
        bool: "true or false",
        dict: "an object",
        list: "a list",
        None: "null",
    }
    return names[kind]


def _shown(value: Any) -> str:
    """A value as an error shows it: short."""
    if isinstance(value, dict | list):
        return f"{_name(type(value))} of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."
