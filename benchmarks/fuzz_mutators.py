"""Damage to files, as the fuzzers do it (benchmarks/fuzz.py, tests/test_fuzz.py): bytes, numbers, and what a format is
made of, so that what is damaged is still read as far as possible: JSON stays JSON, archives and PNG keep their check
sums. Everything is drawn from one `random.Random`, so that a number stands for an input.
"""

from __future__ import annotations

import copy
import json
import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

__all__ = ["WORDS", "damaged", "json_of", "json_lines", "lines_of", "text_of"]

_WHOLE = (0, 1, 2, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 1 << 20, 1 << 24, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_WHOLE_64 = (*_WHOLE, 1 << 32, 1 << 40, (1 << 62) + 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e-300, 1e300, -1.0, 3.5e38, 1e19)
WORDS = (
    *(b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"-0.0", b"1e-400", b"99999999999999999999", b"4294967296"),
    *(
        b"9223372036854775808",
        b"2147483648",
        b"1e30",
        b"0x10",
        b"1_0",
        b"",
        b"x",
        b"\xd9\xa1",
        b"1.5",
        b"007",
        b"9" * 400,
    ),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_ODD = (
    *(None, True, False, 0, -1, 1, 0.5, 1e308, float("nan"), float("inf"), 1 << 31, 1 << 63, -(1 << 63), 10**30),
    *("", "x", "nan", "../../etc/passwd", "/etc/passwd", "a" * 300, "\0", "\ud800", "\n", "é", "1e400", ".", "..", "/"),
    *([], {}, [[]], [None], {"": None}, [0] * 3, [[0] * 4] * 4, "1" * 5000),
)


def damaged(data: bytes, draw: Random, others: Sequence[bytes] = ()) -> bytes:
    """What is done to any file."""
    if not data:
        return draw.randbytes(draw.randrange(1, 64))
    return draw.choice(_BYTES)(data, draw, others)


def _flip(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    out = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8, 64))):
        out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def _set(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    out = bytearray(data)
    at = draw.randrange(len(data))
    length = min(draw.choice((1, 1, 2, 4, 16, 256)), len(out) - at)
    out[at : at + length] = bytes([draw.choice((0, 255, 127, 128, 10, 32, draw.randrange(256)))]) * length
    return bytes(out)


def _cut(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    return data[: draw.randrange(len(data))] if draw.random() < 0.8 else data[draw.randrange(len(data)) :]


def _insert(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    at = draw.randrange(len(data) + 1)
    kind = draw.random()
    new = draw.randbytes(draw.choice((1, 2, 4, 8, 100))) if kind < 0.5 else draw.choice(WORDS)
    return data[:at] + new + data[at:]


def _chunk(data: bytes, draw: Random) -> tuple[int, int]:
    begin = draw.randrange(len(data))
    return begin, min(len(data), begin + draw.choice((1, 2, 4, 8, 16, 64, 256, 1024, len(data))))


def _remove(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    begin, end = _chunk(data, draw)
    return data[:begin] + data[end:]


def _repeat(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    begin, end = _chunk(data, draw)
    at = draw.choice((end, draw.randrange(len(data))))
    return data[:at] + data[begin:end] * draw.choice((1, 1, 2, 16)) + data[at:]


def _splice(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    other = draw.choice(others) if others else data
    if not other:
        return data
    begin, end = _chunk(other, draw)
    if draw.random() < 0.5:
        return data[: draw.randrange(len(data))] + other[begin:]
    at = draw.randrange(len(data))
    return data[:at] + other[begin:end] + data[at + end - begin :]


def _number(data: bytes, draw: Random, others: Sequence[bytes]) -> bytes:
    """Another number of 2, 4 or 8 bytes; or one that is there, a little larger or smaller."""
    size = draw.choice((2, 4, 4, 8, 8))
    if len(data) < size:
        return data + bytes(size)
    at = draw.randrange(len(data) - size + 1)
    at -= at % size if draw.random() < 0.5 else 0
    order = "big" if draw.random() < 0.2 else "little"
    if size > 2 and draw.random() < 0.3:
        packed = struct.pack("<f" if size == 4 else "<d", _as_float(draw.choice(_FLOATS), size))
    elif draw.random() < 0.3:
        value = int.from_bytes(data[at : at + size], order) + draw.choice((-1, 1, -2, 16, 1 << 16))
        packed = (value % (1 << 8 * size)).to_bytes(size, order)
    else:
        packed = (draw.choice(_WHOLE_64) % (1 << 8 * size)).to_bytes(size, order)
    return data[:at] + packed + data[at + size :]


def _as_float(value: float, size: int) -> float:
    return value if size == 8 or value != value or abs(value) <= 3.4e38 else float("inf")


def _text_number(data: bytes, draw: Random, others: Sequence[bytes] = ()) -> bytes:
    """Another word where a number stands in digits."""
    start = draw.randrange(len(data)) if data else 0
    found = _NUMBER.search(data, start) or _NUMBER.search(data)
    if found is None:
        return data + draw.choice(WORDS)
    return data[: found.start()] + draw.choice(WORDS) + data[found.end() :]


def lines_of(data: bytes, draw: Random, others: Sequence[bytes] = ()) -> bytes:
    """A line that is gone, there twice, elsewhere, cut, or of other words."""
    lines = data.split(b"\n")
    i = draw.randrange(len(lines))
    j = draw.randrange(len(lines))
    what = draw.randrange(6)
    words = lines[i].split(b" ")
    k = draw.randrange(len(words))
    if what == 0:
        del lines[i]
    elif what == 1:
        lines[i:i] = [lines[i]] * draw.choice((1, 2, 40))
    elif what == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif what == 3:
        lines[i] = b" ".join(words[:k])
    elif what == 4:
        lines[i] = b" ".join([*words[:k], draw.choice(WORDS), *words[k:]])
    else:
        lines[i] = b" ".join([*words[:k], draw.choice(WORDS), *words[k + 1 :]])
    return b"\n".join(lines)


_BYTES: tuple[Callable[[bytes, Random, Sequence[bytes]], bytes], ...] = (
    *(_flip, _flip, _set, _cut, _insert, _remove, _repeat, _splice, _number, _number, _text_number, lines_of),
)


def text_of(data: bytes, draw: Random) -> bytes:
    return draw.choice((_text_number, lines_of))(data, draw)


# ------------------------------------------------------------------------------------ JSON


def json_of(data: bytes, draw: Random) -> bytes:
    """JSON of another shape: a value that is gone, is another one, of another type, nested, there twice, or renamed."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return _text_number(data, draw)
    for _ in range(draw.choice((1, 1, 1, 2, 5))):
        value = _changed(value, draw)
    if draw.random() < 0.03:  # deeper than parsers go
        return b"[" * draw.choice((500, 3000, 100_000)) + data
    try:
        text = json.dumps(value)
    except (ValueError, RecursionError):
        return data
    return text.replace('"1e400"', "1e400").encode("utf-8", "replace")


def _changed(value: Any, draw: Random) -> Any:
    parent, key = _place(value, draw)
    if parent is None:
        return copy.deepcopy(draw.choice(_ODD)) if draw.random() < 0.2 else value
    held = parent[key]
    what = draw.randrange(9)
    if what <= 2:
        parent[key] = copy.deepcopy(draw.choice(_ODD))
    elif what == 3:
        del parent[key]
    elif what == 4:
        parent[key] = draw.choice(([held], {"x": held}, [held, held], [held] * 50, str(held)[:2000]))
    elif what == 5:  # another type of the same content
        parent[key] = _retyped(held, draw)
    elif what == 6 and isinstance(parent, dict):
        parent[draw.choice((*parent, f"{key}x", ""))] = parent.pop(key)
    elif what == 7:
        other, place = _place(value, draw)
        if other is not None:
            parent[key] = _copy(other[place])
    elif isinstance(held, list):
        held[:] = draw.choice((held * 2, held[::-1], held[:1], held[1:], []))
    elif isinstance(held, int | float):
        parent[key] = draw.choice((-held, held + 1, held * 10**9, held + 1000, 1 << 40))
    else:
        parent[key] = copy.deepcopy(draw.choice(_ODD))
    return value


def _place(value: Any, draw: Random) -> tuple[Any, Any]:
    """A random entry somewhere in a value, as (what holds it, its key)."""
    parent = key = None
    while isinstance(value, dict | list) and value:
        parent = value
        key = draw.choice(list(value)) if isinstance(value, dict) else draw.randrange(len(value))
        value = parent[key]
        if draw.random() < 0.25:
            break
    return parent, key


def _retyped(held: Any, draw: Random) -> Any:
    if isinstance(held, str):
        return draw.choice((held.encode("utf-8", "replace").hex(), len(held), [held], list(held)[:100], {held: held}))
    if isinstance(held, dict):
        return draw.choice((list(held), list(held.values()), len(held)))
    if isinstance(held, list):
        return draw.choice((dict(enumerate(map(str, held[:50]))), len(held), held[0] if held else None))
    return draw.choice((str(held), [held], {"value": held}, bool(held), None))


def _copy(value: Any) -> Any:
    return json.loads(json.dumps(value))


def json_lines(data: bytes, draw: Random) -> bytes:
    lines = data.split(b"\n")
    i = draw.randrange(len(lines))
    lines[i] = json_of(lines[i], draw)
    return b"\n".join(lines)
