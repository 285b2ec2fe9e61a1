"""A format of files of Gaussians: a row of `drgs.codecs.CODECS`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians


@dataclasses.dataclass(frozen=True)
class Codec:
    """How files of one format are recognized, read and, of some, written.

    Gaussians are in the axes of 3DGS PLY files on both sides: right, down, front.

        POINTS = Codec(".points", load_points, lambda path, head: head.startswith(b"POINTS"), encode=encode_points)

    Attributes:
        suffix: Suffix of its files, in lower case and with its dot.
        load: Reads a file.
        recognizes: Whether a file is of the format, by its path and its first bytes (256 KiB); None where the format
            has no mark.
        by_suffix: Whether a file of this suffix that no codec recognizes is of the format: it has no mark, or its
            reader says best what is wrong.
        load_as_stored: Reads a file in the axes that it states, where there are writers that leave out the turn which
            the specification requires.
        encode: Makes the bytes of a file, of float32 values on the CPU, without features; None where the format is
            only read.
        keeps_origin: Whether files have room for `Gaussians.origin`, which `encode` writes and `load` reads. Of other
            formats, `encode` gets none: it is written beside the file.
        made_by: Program that makes such a file of a PLY, with the places `{ply}` and `{path}`; for the message where it
            is only read.
    """

    suffix: str
    load: Callable[[Path], Gaussians]
    recognizes: Callable[[Path, bytes], bool] | None = None
    by_suffix: bool = True
    load_as_stored: Callable[[Path], Gaussians] | None = None
    encode: Callable[[Gaussians], bytes] | None = None
    keeps_origin: bool = False
    made_by: str = ""
