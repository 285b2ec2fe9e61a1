"""Random damage to files, for readers that must refuse it in one line."""

from __future__ import annotations

import copy
import json
import math
import random

__all__ = ["damaged_bytes", "damaged_json"]

_VALUES = (
    None, True, False, 0, -1, 1, 7, 2**31, 2**63, 2**64, 10**400, -(10**25), 1e-320, 1e308, -1e308, math.nan, math.inf,
    0.5, "", "x", "1", "\0", "\ud800", "a\nb", "../../etc/passwd", "x" * 5000, [], {}, [[]], [None], {"a": 1},
    [1, 2, 3], [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
)  # fmt: skip


def damaged_json(value, rng: random.Random) -> bytes:
    """The JSON text of `value` after one to three random edits, sometimes cut or nested as deep as no reader goes."""
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        value = _edited(value, rng)
    text = json.dumps(value)
    if rng.random() < 0.1:
        text = text[: rng.randrange(len(text) + 1)]
    if rng.random() < 0.02:
        text = "[" * 100_000 + text
    if rng.random() < 0.02:
        text = text.replace("1", "9" * 5000, 1)
    return text.encode("utf-8", "surrogatepass")


def damaged_bytes(data: bytes, rng: random.Random, head: int = 0) -> bytes:
    """The file after one to eight random bytes (of the first `head`, if given) have changed, or after it was cut."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(min(head, len(data)) or len(data))
        changed[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    if rng.random() < 0.2:
        del changed[rng.randrange(len(changed)) :]
    return bytes(changed)


def _edited(value, rng: random.Random):
    """One edit somewhere in a JSON value."""
    if not isinstance(value, dict | list) or not value or rng.random() < 0.1:
        return copy.deepcopy(rng.choice(_VALUES))
    keys = list(value) if isinstance(value, dict) else range(len(value))
    key = rng.choice(list(keys))
    action = rng.random()
    if action < 0.2:
        del value[key]
    elif action < 0.3 and isinstance(value, dict):
        value[rng.choice(("extra", "k1", "w", "active", "is_fisheye"))] = copy.deepcopy(rng.choice(_VALUES))
    elif action < 0.35 and isinstance(value, list):
        value.append(copy.deepcopy(value[key]))
    elif action < 0.6:
        value[key] = copy.deepcopy(rng.choice(_VALUES))
    else:
        value[key] = _edited(value[key], rng)
    return value
