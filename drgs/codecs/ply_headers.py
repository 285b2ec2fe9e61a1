"""PLY files before anybody reads them: what a header claims is compared with the size of the file, and lists, whose
lengths no header has, are read from memory, where they can claim nothing.
"""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from drgs.cameras.origins import origin_of_text, origin_text

EXTRA = ("uncertainty_", "label")
"""Beginnings of columns that `drgs.save_ply` adds, and viewers leave out."""

_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8", "i1", "u1"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "i2", "u2"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32", "i4", "u4", "f4"), 4),
    **dict.fromkeys(("double", "float64", "f8"), 8),
}
"""Type of a column -> bytes of a number; plyfile reads NumPy's names, too."""
_MAX_HEADER = 1 << 18  # bytes; some 9,000 columns


@dataclasses.dataclass(frozen=True)
class PlyElement:
    """An element: what it is called, how many rows it has, and its columns.

    Attributes:
        kinds: The type of each column, as the file names it; of a list, that of its length.
    """

    name: str
    rows: int
    columns: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    def with_column(self, kind: str, name: str) -> PlyElement:
        """The same with one more column."""
        return dataclasses.replace(self, columns=(*self.columns, name), kinds=(*self.kinds, kind))

    def least_bytes(self, is_text: bool) -> int:
        """Bytes that its rows take at least: of text, a digit and a separator a value."""
        each = 2 * len(self.columns) if is_text else sum(_SIZES[kind] for kind in self.kinds)
        return self.rows * each


def read_ply_header(path: Path) -> list[PlyElement]:
    """The elements of a PLY file, once it is known to be as long as its header claims.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no PLY, its header is damaged, or the file is shorter.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a PLY file, found none; check the path")
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
    if not head.startswith((b"ply\n", b"ply\r")):
        raise ValueError(f"{path}: must be a PLY file, got {head[:8]!r}; convert it to PLY")
    # Not the word in a comment. Behind lines that end with \r alone the first byte of the data may be a \n.
    newline = rb"\r?\n" if b"\n" in head[3:5] else rb"\r"
    last = re.search(rb"[\r\n]end_header[^\r\n]*" + newline, head)
    if last is None:
        raise ValueError(
            f"{path}: the header of a PLY must end with end_header within {_MAX_HEADER} bytes, does not; it is "
            "truncated or damaged, copy it again"
        )
    elements: list[PlyElement] = []
    text_format = None
    for line in re.split(r"\r\n|\r|\n", head[: last.start()].decode("ascii", "replace")):
        match line.split():
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as kind, _]:
                text_format = kind
            case ["element", name, count] if count.isdecimal() and len(count) < 1000:
                elements.append(PlyElement(name, int(count)))
            case ["property", kind, name] | ["property", "list", kind, _, name] if elements and kind in _SIZES:
                elements[-1] = elements[-1].with_column(kind, name)
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise ValueError(f"{path}: PLY header must be well-formed, got {line[:60]!r}; export it again")
    if empty := next((element.name for element in elements if element.rows and not element.columns), None):
        raise ValueError(f"{path}: element {empty!r} of a PLY must have a property, has none; export it again")
    is_text = text_format == "ascii"
    claimed = sum(element.least_bytes(is_text) for element in elements)
    held = path.stat().st_size - last.end()
    if claimed > held + is_text:
        counts = ", ".join(f"{element.rows} {element.name}" for element in elements)
        raise ValueError(
            f"{path}: the header claims {counts} ({claimed} bytes), the file holds {held} bytes; "
            "it is truncated or damaged, copy it again"
        )
    return elements


def is_antialiased(path: Path) -> bool:
    """Whether a PLY, whose header has been read, says that its Gaussians were fitted by antialiased rasterization.

    Brush and gsplat write `comment SplatRenderMode: mip`, Postshot `comment antialiased 1`; the last such line counts.
    """
    said = _comments(path, rb"(?:SplatRenderMode:[ \t]*(mip|default)|antialiased[ \t]+([01]))[ \t]*$")
    return bool(said) and (said[-1][0].lower(), said[-1][1]) in ((b"mip", b""), (b"", b"1"))


def offset_line(origin: np.ndarray) -> str:
    """The comment that says what positions are relative to: to be added to them."""
    return f"offset {origin_text(origin)}"


def ply_offset(path: Path) -> np.ndarray | None:
    """(3,) float64 offset of the positions of a PLY, whose header has been read; None where it states none.

    A line `comment offset X Y Z`, also with a colon; what has no number behind the word is prose.

    Raises:
        ValueError: If it is not three finite numbers, or two lines differ.
    """
    lines = _comments(path, rb"offset:?[ \t]+([-+.0-9]|nan|inf)([^\r\n]*)")
    texts = {(first + rest).decode("ascii", "replace").strip() for first, rest in lines}
    if len(texts) > 1:
        raise ValueError(f"{path}: must state one offset, states {' and '.join(sorted(texts))[:80]}; remove the others")
    return origin_of_text(f"{path}: comment offset", texts.pop()) if texts else None


def _comments(path: Path, pattern: bytes) -> list[tuple[bytes, ...]]:
    """The groups of a pattern in each comment of a header that it matches, case aside."""
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
    lines = head[: head.find(b"\nend_header")].replace(b"\r", b"\n")
    return re.findall(rb"^comment[ \t]+" + pattern, lines, re.IGNORECASE | re.MULTILINE)


def extra_kind(name: str, values: np.ndarray, count: int) -> str:
    """The type of an extra column of (N,) values.

    Raises:
        ValueError: If it has another name or length, or a value that the file cannot hold.
    """
    if not name.startswith(EXTRA) or not name.isidentifier() or values.shape != (count,):
        raise ValueError(
            f"save_ply: extra columns must be named uncertainty_* or label* and have {count} values, got {name!r} of "
            f"shape {values.shape}; correct it"
        )
    if values.dtype.kind in "iu":
        ends = int(values.min(initial=0)), int(values.max(initial=0))
        if ends[0] < 0 or ends[1] > 65535:
            raise ValueError(f"save_ply: {name} must be in 0..65535, got {ends[0]}..{ends[1]}; number them anew")
        return "u1" if ends[1] < 256 else "<u2"
    if not np.isfinite(values).all():
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(f"save_ply: {name} must be finite, got {values[i]} at index {i}; leave it out or repair it")
    return "<f4"


def ply_source(path: Path) -> BinaryIO | str:
    """What plyfile is to read: the path, which it maps; or the whole file, where it has lists or other characters than
    ASCII in its header, as a comment may.

    plyfile asks the file for as many bytes as a list claims, and a file makes room for them before it reads. It decodes
    the header, of which nobody needs such characters: they become question marks.
    """
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
    last = re.search(rb"[\r\n]end_header", head)
    head = head[: last.start()] if last else head
    if head.isascii() and not re.search(rb"property\s+list", head):
        return str(path)
    data = path.read_bytes()
    return io.BytesIO(re.sub(rb"[\x80-\xff]", b"?", head) + data[len(head) :])
