"""Recognize files of another kind than a reader expects, name their kind, and advise how to convert them.

Known by their first bytes, and by their extension where a format has no mark of its own.
"""

from __future__ import annotations

import re
import shlex
import zipfile
import zlib
from pathlib import Path

_HEAD_BYTES = 4096  # bytes from the start of a file, enough for every mark that is looked for
_SPLATS = {
    ".spz": "an SPZ file (Niantic's compressed Gaussians)",
    ".sog": "a SOG file (PlayCanvas' compressed Gaussians)",
    ".splat": "a .splat file (32 bytes a Gaussian, no SH)",
    ".ksplat": "a .ksplat file (compressed Gaussians of mkkellogg's viewer)",
    ".lcc": "an LCC file (XGRIDS' compressed Gaussians)",
}


def is_file(path: Path) -> bool:
    """Whether there is a file; there is none of a name that no file can have, as one of 1,000 letters."""
    try:
        return path.is_file()
    except OSError:
        return False


def refuse_foreign(path: Path, wanted: str) -> None:
    """Raise ValueError if a file is known to be of another kind than its reader expects; else do nothing.

    Args:
        path: The file, or a folder; it must exist.
        wanted: What the reader expects, for the message.
    """
    if path.is_dir():  # of folders, only that of an unbundled SOG scene is known, by its index
        path = path / "meta.json"
        if not path.is_file():
            return
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    other = _lfs(head, path) or _splats(head, path) or _other_file(head, path)
    if other:
        raise ValueError(f"{path}: must be {wanted}, is {other[0]}; {other[1]}")


def _conversion(path: Path, suffix: str) -> str:
    """The command that converts Gaussians of another format to PLY; most formats drgs converts itself."""
    name = "scene" if path.name == "meta.json" else path.stem.removesuffix(".compressed")
    target = path.with_name(f"{name}.ply")
    if target == path:
        target = path.with_name(f"{name}_3dgs.ply")
    source = shlex.quote(str(path.parent if path.name == "meta.json" else path))
    ply = shlex.quote(str(target))
    if suffix != ".lcc":
        return f"convert it with `drgs convert {source} {ply}`, or read it with drgs.load_gaussians"
    return (
        f"convert it with `npx @playcanvas/splat-transform {source} {ply}`, "
        "or open it in SuperSplat (superspl.at/editor) and export a PLY that is not compressed"
    )


def _lfs(head: bytes, path: Path) -> tuple[str, str] | None:
    if head.startswith(b"version https://git-lfs.github.com/spec/"):
        return (
            "a Git LFS pointer, the note that stands for a file which was not downloaded",
            f"run `git lfs install` once and then `git lfs pull` in {path.parent}",
        )
    return None


def _splats(head: bytes, path: Path) -> tuple[str, str] | None:
    """Gaussians in another project's format."""
    suffix = path.suffix.lower()
    kind = None
    if head.startswith(b"NGSP") or (head.startswith(b"\x1f\x8b") and _unpacked(head).startswith(b"NGSP")):
        kind = _SPLATS[".spz"]
    elif head.startswith(b"PK\x03\x04") and _is_sog(path):
        kind = _SPLATS[".sog"]
    elif path.suffix == ".json" and _is_sog_meta(head):
        kind = "the index of an unbundled SOG scene (PlayCanvas' compressed Gaussians)"
    elif suffix in _SPLATS and not head.startswith(b"ply"):
        kind = _SPLATS[suffix]
    elif head.startswith(b"ply") and b" packed_position" in head:
        kind = "a PLY in PlayCanvas' compressed layout"
    return (kind, _conversion(path, suffix)) if kind else None


def _other_file(head: bytes, path: Path) -> tuple[str, str] | None:
    """Other kinds of files that are often passed by mistake."""
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")[:16].lower()
    brand = head[8:12] if head[4:8] == b"ftyp" else b""
    if head.startswith(b"glTF") or path.suffix.lower() == ".gltf":
        return "a glTF file", "pack it into one .glb, uncompressed, and read that with drgs.load_gaussians"
    if start.startswith((b"<!doctype", b"<html")):
        return "a web page", "download the file itself (on GitHub: the link named Raw)"
    if brand in (b"heic", b"heix", b"mif1", b"msf1", b"avif"):
        return "an HEIC or AVIF photograph", "convert it to JPEG or PNG"
    if brand or head.startswith(b"\x1aE\xdf\xa3") or head[8:12] == b"AVI ":
        return "a video", f"find its cameras first: `drgs sfm {shlex.quote(str(path))} -o scene`"
    if head.startswith(b"PK\x03\x04") and path.suffix.lower() != ".npz":
        return "a zip archive", "unpack it first"
    if head.startswith(b"\x1f\x8b"):
        return "a gzip file", "unpack it first with gunzip"
    return None


def _unpacked(head: bytes) -> bytes:
    """The first bytes of a gzip stream."""
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 16)
    except zlib.error:
        return b""


def _is_sog(path: Path) -> bool:
    if path.suffix.lower() == ".sog":
        return True
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.rpartition("/")[2] == "meta.json" for name in archive.namelist())
    except Exception:  # zipfile raises whatever the damage leads to
        return False


def _is_sog_meta(head: bytes) -> bool:
    # An object of that name: a run's config.json may list `means` among groups, and has a `means_rate`.
    return re.search(rb'"means"\s*:\s*\{', head) is not None and b"means_" in head
