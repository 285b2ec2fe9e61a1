"""Files of Gaussians: every format that is read or written, found by what a file holds. One module a format.

| format | read | write |
|---|---|---|
| PLY of 3DGS (INRIA, Nerfstudio's splatfacto, gsplat, Feature 3DGS) | yes | yes |
| PLY as SuperSplat compresses it | yes | no |
| SPZ (Niantic), versions 2 and 3; 4 with the extra `spz` | yes | version 3 |
| .splat (antimatter15) | yes | no |
| .ksplat (mkkellogg), levels 0 to 2 | yes | no |
| SOG (PlayCanvas), versions 1 and 2, as an archive or a folder | yes | no |
| GLB with KHR_gaussian_splatting | yes | yes |

docs/files.md says what each of them loses.
"""

from __future__ import annotations

import logging
import os
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.codecs.folders import file_of_folder, refuse_checkpoint
from drgs.files import atomic_write, load_ply, save_ply
from drgs.guards.arguments import ArgumentError
from drgs.guards.foreign import refuse_foreign

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from drgs.ellipsoids import Gaussians

__all__ = ["READ", "WRITTEN", "check_suffix", "load_gaussians", "save_gaussians"]

READ = ".ply, .spz, .splat, .ksplat, .sog and .glb, a SOG folder or a model folder of INRIA's"
WRITTEN = (".ply", ".spz", ".glb")
_MADE_BY = {
    ".sog": "`npx @playcanvas/splat-transform -g cpu {ply} {path}`, or SuperSplat (superspl.at/editor)",
    ".splat": "`python convert.py {ply} --output {path}` of github.com/antimatter15/splat, or SuperSplat "
    "(superspl.at/editor)",
    ".ksplat": "`node util/create-ksplat.js {ply} {path}` of github.com/mkkellogg/GaussianSplats3D",
    ".compressed.ply": "`npx @playcanvas/splat-transform {ply} {path}`, or SuperSplat (superspl.at/editor)",
}
"""What makes a file that is only read of a PLY."""
_log = logging.getLogger(__name__)


def load_gaussians(path: str | os.PathLike, *, as_stored: bool = False) -> Gaussians:
    """Gaussians from a file or folder of any format that is read, in the axes of 3DGS PLY files.

    The format is found by the first bytes; .splat and .ksplat, which have no mark, by their suffix. SPZ and glTF have
    other axes than PLY files: they are turned, SH included (drgs/codecs/spz.py, drgs/codecs/gltf.py).

    Args:
        path: A .ply (3DGS's or SuperSplat's compressed one), .spz, .splat, .ksplat, .sog or .glb; a folder of a SOG
            scene or its meta.json; a model folder of INRIA's, whose latest iteration is taken.
        as_stored: Of an SPZ, keep the axes of the file: some writers leave out the turn that its specification asks
            for.
    Returns:
        float32 `Gaussians`. Where a byte stands for an opacity of 0 or 1, or a scale is 0, its logit or logarithm is
        finite (drgs/codecs/values.py).
    Raises:
        FileNotFoundError: If there is no such file, or the folder holds none.
        ValueError: If it is damaged, of another kind (which is named, with the way round), or holds values that are
            not finite (the first index is named).
    """
    from drgs.codecs import gltf, ksplat, packed_ply, sog, splat, spz
    from drgs.guards.inputs import check_path

    path = check_path("load_gaussians", path)
    if path.is_dir():
        found = file_of_folder(path)
        if found is None:
            raise FileNotFoundError(f"{path}: must hold Gaussians, holds no file that is known; name one of {READ}")
        path = found
    elif not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file of Gaussians, found none; check the path")
    kind = _kind(path)
    if kind == "spz":
        return spz.load_spz(path, as_stored)
    readers = {"packed": packed_ply.load_packed_ply, "sog": sog.load_sog, "glb": gltf.load_glb}
    readers |= {"splat": splat.load_splat, "ksplat": ksplat.load_ksplat}
    if kind in readers:
        return readers[kind](path)
    if kind == "checkpoint":
        refuse_checkpoint(path)
    if kind == "ply":
        return load_ply(path)
    refuse_foreign(path, "a file of Gaussians")
    raise ValueError(f"{path}: must be a file of Gaussians, is of no format that is known; what is read: {READ}")


def save_gaussians(
    g: Gaussians,
    path: str | os.PathLike,
    *,
    extra: Mapping[str, np.ndarray] | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write Gaussians in the format of a suffix: .ply, .spz (version 3) or .glb (KHR_gaussian_splatting); atomically.

    Args:
        g: In the axes of 3DGS PLY files; SPZ and glTF get theirs.
        path: The file.
        extra, comments: Columns and lines that only a PLY has room for; see `save_ply`.
    Raises:
        ValueError: If the suffix is another one, a parameter is not finite (the first index is named), or the format
            cannot hold it.
    """
    from drgs.codecs.gltf import encode_glb
    from drgs.codecs.spz import encode_spz
    from drgs.guards.inputs import check_path, check_scene

    if isinstance(g, str | os.PathLike):
        raise ArgumentError(
            "save_gaussians: gaussians must come first and the path second, got a path first; swap them"
        )
    check_scene("save_gaussians", g, None)
    path = check_path("save_gaussians", path)
    suffix = check_suffix("save_gaussians", path)
    if suffix == ".ply":
        save_ply(g, path, extra=extra, comments=comments)
        return
    if extra:
        raise ValueError(f"save_gaussians: {', '.join(extra)} must go into a .ply, {suffix} has no room for them")
    g.validate("save_gaussians")
    if g.features is not None:
        _log.warning("%s: left out the %d semantic features, %s has no room", path, g.features.shape[1], suffix)
    data = (encode_spz if suffix == ".spz" else encode_glb)(_plain(g))
    with atomic_write(path) as file:
        file.write(data)


def check_suffix(where: str, path: Path) -> str:
    """The suffix of a file that will be written, in lower case.

    Raises:
        ValueError: If no such format is written; of those that are only read it says which program makes one.
    """
    # A PLY as it is under SuperSplat's name for what it compresses would be taken for compressed.
    suffix = ".compressed.ply" if path.name.lower().endswith(".compressed.ply") else path.suffix.lower()
    if suffix in WRITTEN:
        return suffix
    known = f"{where}: {path.name} must end with {', '.join(WRITTEN)}, got {suffix or 'no suffix'}"
    if path.name.lower() == "meta.json":
        suffix = ".sog"  # the index of the same, in a folder
    if suffix not in _MADE_BY:
        raise ValueError(f"{known}; choose one of these")
    ply = path.with_name(("scene" if path.name.lower() == "meta.json" else path.name[: -len(suffix)]) + ".ply")
    raise ValueError(
        f"{known}, a format that drgs reads and does not write; write {ply}, and make it of that: "
        f"{_MADE_BY[suffix].format(ply=ply, path=path)}"
    )


def _plain(g: Gaussians) -> Gaussians:
    """float32 values on the CPU, without an origin."""
    import numpy as np
    import torch

    values = {name: x.detach().cpu() for name, x in g.parameters().items() if name != "features"}
    if np.any(g.origin):
        values["means"] = values["means"].double() + torch.from_numpy(np.asarray(g.origin, np.float64))
    floats = {name: x.float() for name, x in values.items()}
    return g.replace(**floats, features=None, origin=np.zeros(3))


def _kind(path: Path) -> str | None:
    """Of a file, by its first bytes; by its suffix where a format has no mark."""
    with path.open("rb") as file:
        head = file.read(1 << 18)  # the header of a PLY
    suffix = path.suffix.lower()
    if head.startswith((b"ply\n", b"ply\r")):
        return "packed" if b" packed_position" in head.partition(b"\nend_header")[0] else "ply"
    if head.startswith(b"version https://git-lfs"):
        return None
    if head.startswith(b"NGSP") or (head.startswith(b"\x1f\x8b") and _begin(head).startswith(b"NGSP")):
        return "spz"
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith(b"PK\x03\x04"):
        return _kind_of_zip(path)
    if path.name == "meta.json" and b'"means"' in head:
        return "sog"
    return {".splat": "splat", ".ksplat": "ksplat", ".ckpt": "checkpoint", ".sog": "sog", ".spz": "spz"}.get(suffix)


def _begin(head: bytes) -> bytes:
    """The first bytes of a gzip stream."""
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 16)
    except zlib.error:
        return b""


def _kind_of_zip(path: Path) -> str | None:
    """Of a zip archive, by the names in it."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        names = []
    if any(name.rpartition("/")[2] == "data.pkl" for name in names) or path.suffix.lower() == ".ckpt":
        return "checkpoint"
    known = any(name.rpartition("/")[2] == "meta.json" for name in names)
    return "sog" if known or path.suffix.lower() == ".sog" else None
