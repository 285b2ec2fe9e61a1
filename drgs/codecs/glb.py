"""Binary glTF 2.0 of one mesh with one primitive: the container that Gaussians and triangles are written into."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["BIN", "JSON", "glb_of"]

JSON, BIN = 0x4E4F534A, 0x004E4942
"""Kinds of chunks."""


def glb_of(
    where: str,
    arrays: Sequence[tuple[np.ndarray, Mapping[str, Any], int]],
    primitive: Mapping[str, Any],
    more: Mapping[str, Any],
    offset: np.ndarray | None = None,
) -> bytes:
    """The bytes of a file.

    Args:
        where: Name of what writes it, for the message.
        arrays: Accessors in their order, each with its values (little-endian, each row a multiple of 4 bytes), its
            fields beside view and count, and the target of its view. The first one is POSITION, whose range is stated.
        primitive: The primitive of the mesh.
        more: Further fields of the document.
        offset: (3,) what positions are relative to, in the axes of glTF: `asset.extras.offset`; None or 0: left out.
    Raises:
        ValueError: If it takes more than 4 GiB.
    """
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for array, kind, target in arrays:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": len(accessors), "count": len(array), **kind})
        at += array.nbytes
    positions = arrays[0][0]
    if len(positions):
        accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    extras = {} if offset is None or not offset.any() else {"extras": {"offset": offset.tolist()}}
    document = {
        "asset": {"version": "2.0", "generator": "drgs", **extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
        **more,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + at
    if total >= 1 << 32:
        raise ValueError(f"{where}: a GLB must have less than 4 GiB, this one takes {total} bytes; write a PLY")
    chunks = [struct.pack("<4sII", b"glTF", 2, total), struct.pack("<II", len(text), JSON), text]
    return b"".join([*chunks, struct.pack("<II", at, BIN), *(array.tobytes() for array, *_ in arrays)])
