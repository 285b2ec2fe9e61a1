"""Files of Gaussians: every format that is read or written, found by what a file holds. One module a format.

| format | read | write |
|---|---|---|
| PLY of 3DGS (INRIA, Nerfstudio's splatfacto, gsplat, Feature 3DGS) | yes | yes |
| PLY as SuperSplat compresses it (.compressed.ply) | yes | yes |
| SPZ (Niantic), versions 2 and 3; 4 with the extra `spz` | yes | version 3 |
| .splat (antimatter15) | yes | yes |
| .ksplat (mkkellogg), levels 0 to 2 | yes | no |
| SOG (PlayCanvas), versions 1 and 2, as an archive or a folder | yes | version 2, an archive |
| GLB with KHR_gaussian_splatting | yes | yes |
| checkpoints of gsplat's simple_trainer and nerfstudio's splatfacto (.pt, .ckpt) | yes | no |

docs/files.md says what each of them loses.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras.origins import origin_of_text, origin_text
from drgs.checks.arguments import ArgumentError, check_path
from drgs.checks.registry import Registry
from drgs.codecs.codec import Codec
from drgs.codecs.folders import file_of_folder
from drgs.codecs.ply import load_ply, note_offset, save_ply
from drgs.io.foreign import refuse_foreign
from drgs.io.outputs import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drgs.ellipsoids import Gaussians

__all__ = ["CODECS", "Codec", "check_suffix", "load_gaussians", "origin_file", "readable", "save_gaussians"]

CODECS: Registry[Codec] = Registry(
    "format of Gaussians",
    "drgs.codecs",
    {
        "packed_ply": "drgs.codecs.packed_ply:PACKED_PLY",
        "ply": Codec(
            ".ply",
            load_ply,
            lambda path, head: head.startswith((b"ply\n", b"ply\r")),
            by_suffix=False,
            keeps_origin=True,
        ),
        "spz": "drgs.codecs.spz:SPZ",
        "splat": "drgs.codecs.splat:SPLAT",
        "ksplat": "drgs.codecs.ksplat:KSPLAT",
        "sog": "drgs.codecs.sog:SOG",
        "glb": "drgs.codecs.gltf:GLB",
        "checkpoint": "drgs.codecs.checkpoints:CHECKPOINT",
    },
    Codec,
)
"""Formats of Gaussians, in the order in which they are tried; those of other packages and
scripts come after these. PLY is written by `drgs.save_ply`, which alone has room for more columns.
"""

_OFFSET_BYTES = 200  # of a file with an offset, whose three numbers take 75 at most
_HEAD = 1 << 18  # bytes: the longest header of a PLY
_WHATEVER_THE_SUFFIX = (b"version https://git-lfs", b"PK\x03\x04")  # pointers and archives, which no reader opens
_log = logging.getLogger(__name__)


def load_gaussians(path: str | os.PathLike, *, as_stored: bool = False) -> Gaussians:
    """Gaussians from a file or folder of any format that is read, in the axes of 3DGS PLY files.

        g = drgs.load_gaussians("point_cloud.ply")

    The format is found by the first bytes; .splat and .ksplat, which have no mark, by their suffix. SPZ and glTF have
    other axes than PLY files: they are turned, SH included (drgs/codecs/spz.py, drgs/codecs/gltf.py).

    Args:
        path: A .ply (3DGS's or SuperSplat's compressed one), .spz, .splat, .ksplat, .sog, .glb, or a checkpoint of
            gsplat's simple_trainer or of splatfacto; a folder of a SOG scene or its meta.json; a model folder of
            INRIA's, the results of simple_trainer or a run of splatfacto, whose last step is taken.
        as_stored: Keep the axes of the file, where the format (SPZ) has others than PLY: some writers leave out the
            turn that its specification requires.
    Returns:
        float32 `Gaussians`, relative to the `origin` that the file states, or that stands beside it (`origin_file`).
        Where a byte stands for an opacity of 0 or 1, or a scale is 0, its logit or logarithm is
        finite (drgs/codecs/values.py).
    Raises:
        FileNotFoundError: If there is no such file, or the folder holds none.
        ValueError: If it is damaged, of another kind (which is named, with the way round), or holds values that are
            not finite (the first index is named).
    """

    path = check_path("load_gaussians", path)
    if path.is_dir():
        found = file_of_folder(path)
        if found is None:
            raise FileNotFoundError(
                f"{path}: must hold Gaussians, holds no file that is known; name one of {readable()}"
            )
        path = found
    elif not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file of Gaussians or a run, nothing is there; check the path")
    with path.open("rb") as file:
        head = file.read(_HEAD)
    codec = _codec_of(path, head)
    if codec is not None:
        made = codec.load_as_stored(path) if as_stored and codec.load_as_stored else codec.load(path)
        return made if codec.keeps_origin else _with_origin_beside(path, made)
    refuse_foreign(path, "a file of Gaussians")
    raise ValueError(f"{path}: must be a file of Gaussians, is of no format that is known; what is read: {readable()}")


def readable() -> str:
    """What `load_gaussians` reads, for messages."""
    suffixes = dict.fromkeys(codec.suffix for codec in CODECS.values())
    # Without .compressed.ply, which ends with .ply, too.
    *others, last = [x for x in suffixes if not any(x != other and x.endswith(other) for other in suffixes)]
    return f"{', '.join(others)} and {last}, a SOG folder or the folder of a trainer (INRIA's, gsplat's, splatfacto)"


def save_gaussians(
    g: Gaussians,
    path: str | os.PathLike,
    *,
    extra: Mapping[str, np.ndarray] | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write Gaussians in the format of a suffix, atomically: .ply, .spz (version 3), .sog (version 2), .splat,
    .compressed.ply (SuperSplat's) or .glb (KHR_gaussian_splatting). docs/files.md says what each of them loses.

        drgs.save_gaussians(g, "scene.spz")

    Args:
        g: Gaussians in the axes of 3DGS PLY files; SPZ and glTF get theirs.
        path: The file. The Gaussians in .sog and .compressed.ply are in another order (Morton's), in .splat those that
            show most come first.
        extra, comments: Columns and lines that only a PLY has room for; see `save_ply`.
    Raises:
        ValueError: If the suffix is another one, a parameter is not finite (the first index is named), the format
            cannot hold it, or another file has the place of the offset's (`origin_file`).
    """
    from drgs.ellipsoids import check_gaussians

    if isinstance(g, str | os.PathLike):
        raise ArgumentError(
            "save_gaussians: gaussians must come first and the path second, got a path first; swap them"
        )
    check_gaussians("save_gaussians", g)
    path = check_path("save_gaussians", path)
    suffix = check_suffix("save_gaussians", path)
    if suffix == ".ply":
        from drgs.codecs.values import recentered

        g = recentered(g)
        save_ply(g, path, extra=extra, comments=comments)
        note_offset(path, g.origin)
        return
    if extra:
        raise ValueError(f"save_gaussians: {', '.join(extra)} must go into a .ply, {suffix} has no room for them")
    g.validate("save_gaussians")
    if g.features is not None:
        _log.warning("%s: left out the %d semantic features, %s has no room", path, g.features.shape[1], suffix)
    codec = next(codec for codec in CODECS.values() if codec.suffix == suffix and codec.encode)
    assert codec.encode is not None  # asked for
    beside = origin_file(path)
    if not codec.keeps_origin and beside.is_file():
        _offset_in(beside)  # what holds no offset is a file of somebody else, and is not overwritten
    plain = _plain(g)
    data = codec.encode(plain if codec.keeps_origin else plain.replace(origin=np.zeros(3)))
    write_whole(path, data)
    # One that is there already must not go on saying where an older file was.
    if not codec.keeps_origin and (plain.origin.any() or beside.is_file()):
        write_whole(beside, f"{origin_text(plain.origin)}\n".encode())
    where = "which it states" if codec.keeps_origin else f"which {suffix} has no room for: {beside.name} states it"
    note_offset(path, plain.origin, where)


def origin_file(path: Path) -> Path:
    """The text beside a file of Gaussians whose format has no room for an offset: three numbers, as in the `offset.xyz`
    of Pix4D.
    """
    return path.with_name(path.name + ".offset.xyz")


def _with_origin_beside(path: Path, g: Gaussians) -> Gaussians:
    """Gaussians of a file, relative to the offset that stands beside it, if there is one."""
    beside = origin_file(path)
    return g.replace(origin=_offset_in(beside)) if beside.is_file() else g


def _offset_in(beside: Path) -> np.ndarray:
    """(3,) float64 offset in the text beside a file; ValueError if it holds anything else."""
    with beside.open("rb") as file:
        text = file.read(_OFFSET_BYTES).decode("utf-8", "replace").strip()
    return origin_of_text(str(beside), text)


def check_suffix(where: str, path: Path) -> str:
    """The suffix of a file that will be written, in lower case.

    Raises:
        ValueError: If no such format is written; of those that are only read it says which program makes one.
    """
    name = path.name.lower()
    written = [".ply", *(codec.suffix for codec in CODECS.values() if codec.encode)]
    # The longest: a PLY as it is under SuperSplat's name for what it compresses would be taken for compressed.
    found = [codec for codec in CODECS.values() if name.endswith(codec.suffix) and name != codec.suffix]
    codec = max(found, key=lambda codec: len(codec.suffix), default=None)
    if codec is not None and codec.suffix in written:
        return codec.suffix
    got = (codec.suffix if codec else path.suffix.lower()) or "no suffix"
    known = f"{where}: {path.name} must end with {', '.join(written)}, got {got}"
    if codec is None or not codec.made_by:
        raise ValueError(f"{known}; choose one of these")
    ply = path.with_name(path.name[: -len(codec.suffix)] + ".ply")
    raise ValueError(
        f"{known}, a format that drgs reads and does not write; write {ply}, and make it of that: "
        f"{codec.made_by.format(ply=ply, path=path)}"
    )


def _plain(g: Gaussians) -> Gaussians:
    """float32 values on the CPU."""
    from drgs.codecs.values import recentered

    g = recentered(g)
    # A file holds values: nothing of it is differentiated.
    floats = {name: x.detach().cpu().float() for name, x in g.parameters().items() if name != "features"}
    return g.replace(**floats, features=None)


def _codec_of(path: Path, head: bytes) -> Codec | None:
    """The codec of a file, by its first bytes; by its suffix where none recognizes them."""
    for codec in CODECS.values():
        if codec.recognizes is not None and codec.recognizes(path, head):
            return codec
    if head.startswith(_WHATEVER_THE_SUFFIX):
        return None
    return next((x for x in CODECS.values() if x.by_suffix and x.suffix == path.suffix.lower()), None)
