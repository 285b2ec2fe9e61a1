"""Reading files that may be wrong: claimed sizes are compared with the file's before anything is allocated; poses must
be finite and rigid.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import shutil
import tempfile
import unicodedata
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from drgs.cameras.checks import check_distance
from drgs.checks.arguments import said
from drgs.io.foreign import is_file, refuse_foreign
from drgs.io.json_files import read_bounded
from drgs.runtime import memory

_MAX_NPY_HEADER = 65536  # bytes: a dtype of many fields takes a few hundred
_DEFLATE = 1032  # bytes that one byte of deflate can become
_MAX_NAME = 1024  # characters, folders included
# Poses printed with a few digits are repaired up to this error; anything larger is no rotation.
_ROUNDING = 1e-2

_log = logging.getLogger(__name__)


def file_inside(folder: Path, name: str, where: str) -> Path:
    """The file that a data set's own file names: data sets come from elsewhere, and may name nothing outside of theirs.

    Links that lie in the folder are followed: whoever put them there knows where they lead.

    Args:
        folder: That the name is relative to.
        name: What the file says.
        where: Place of the name, for the message.
    Raises:
        ValueError: If it leaves the folder, or no file can have that name.
    """
    # Names of 1,000 letters and of several lines are none; messages would repeat them.
    is_name = len(name) <= _MAX_NAME and not any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in name)
    if not is_name or not Path(os.path.abspath(folder / name)).is_relative_to(os.path.abspath(folder)):
        raise ValueError(
            f"{where} must name a file in {folder}, got {name[:80]!r}; move or link the file there and name it so"
        )
    return folder / name


def local_names(
    where: str, folder: Path, names: list[str], is_there: Callable[[Path], bool] = is_file
) -> Callable[[str], str] | None:
    """What makes names of files of another machine, or of Windows, relative to a folder of this one.

    Of absolute names the beginning is dropped without which the first one that can be found is a file of the folder;
    names that begin otherwise stay, for `file_inside` to refuse.

    Args:
        where: File that has the names, for the message.
        folder: Folder that they shall be relative to.
        names: Names of files that must be there.
        is_there: Whether there is a file of such a path.
    Returns:
        A function of a name; None where names need not change.
    """
    is_windows = any("\\" in name and not is_there(folder / name) for name in names)
    slashed = [name.replace("\\", "/") if is_windows else name for name in names]
    prefix = next((found for name in slashed if (found := _foreign_prefix(folder, name, is_there))), "")
    if prefix:
        _log.warning("%s: names files in %s, which are taken from %s", where, prefix, folder)
    if not prefix and not is_windows:
        return None
    return lambda name: (name.replace("\\", "/") if is_windows else name).removeprefix(prefix)


def _foreign_prefix(folder: Path, name: str, is_there: Callable[[Path], bool]) -> str:
    """How a name that leads out of a folder begins, if its end names a file in the folder; else empty."""
    is_inside = Path(os.path.abspath(folder / name)).is_relative_to(os.path.abspath(folder))
    if is_inside and not re.match("[A-Za-z]:/", name):
        return ""
    places = [match.end() for match in re.finditer("/", name)]
    ends = (name[at:] for at in places if ".." not in name[at:].split("/"))
    return next((name[: -len(end)] for end in ends if end and is_there(folder / end)), "")


def read_text(path: Path, what: str, largest: int) -> str:
    """The content of a text file in UTF-8.

    Args:
        what: It must be, for messages, e.g. "a list of poses".
        largest: Bytes that it may have.
    Raises:
        FileNotFoundError: No such file.
        ValueError: larger, of another format, or bytes that are no text.
    """
    data = read_bounded(path, what, "name another", largest)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: must be {what} in UTF-8, got other bytes; write it again") from None


def read_npy(path: Path) -> np.ndarray:
    """Read a plain numeric `.npy` array; the shape in its header is checked against the file
    size first.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a numeric npy file, or shorter than its header claims.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a .npy file, found none; check the path")
    refuse_foreign(path, "a .npy file")
    with path.open("rb") as file:
        _check_npy(f"{path}", file, path.stat().st_size)
    try:
        return np.load(path, allow_pickle=False)
    except ValueError as error:
        raise ValueError(f"{path}: must be a .npy file, got {error}; save it with numpy.save") from None


def _check_npy(where: str, file: IO[bytes], size: int) -> None:
    """Raise ValueError unless a header claims plain numbers, as many as its `size` bytes hold: NumPy allocates them."""
    try:
        version = np.lib.format.read_magic(file)
        stated = file.read(2 if version == (1, 0) else 4)
        if int.from_bytes(stated, "little") > _MAX_NPY_HEADER:  # which NumPy would allocate as well
            raise ValueError(f"a header of {int.from_bytes(stated, 'little')} bytes")
        file.seek(-len(stated), os.SEEK_CUR)
        read = np.lib.format.read_array_header_1_0
        if version >= (2, 0):
            read = np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file, max_header_size=_MAX_NPY_HEADER)
        start = file.tell()
    except Exception as error:  # NumPy's parser of headers raises whatever Python's tokenizer does
        raise ValueError(f"{where}: must be a .npy file, got {said(error)}; save it with numpy.save") from None
    if dtype.hasobject or dtype.kind not in "fiub":
        raise ValueError(f"{where}: must hold plain numbers, got dtype {dtype}; save a float array")
    # Python integers: a claimed shape of 10^12 x 10^12 must not wrap around.
    claimed = dtype.itemsize
    for side in shape:
        claimed *= int(side)
    if any(side < 0 for side in shape) or claimed > size - start:
        raise ValueError(
            f"{where}: the header claims shape {shape} ({claimed} bytes), the file holds {size - start} bytes; it is "
            "truncated or damaged, copy it again"
        )


def check_npz(path: Path) -> list[str]:
    """The names of the arrays of an `.npz` archive, none of which claims more bytes than the file can hold.

    Raises:
        ValueError: Another archive, or one that lies.
    """
    names = []
    with _reading_archive(path, "arrays of numbers"), zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{info.filename} in a compression that NumPy does not write")
            if info.file_size > _DEFLATE * min(info.compress_size, path.stat().st_size) or info.filename in names:
                raise ValueError(f"{info.file_size} bytes of {info.filename}")
            with archive.open(info) as member:
                _check_npy(info.filename, member, info.file_size)
            names.append(info.filename)
    return [name.removesuffix(".npy") for name in names]


def read_npz(path: Path, name: str) -> np.ndarray:
    """Read one plain numeric array of an `.npz` archive.

    Raises:
        FileNotFoundError: No such file.
        ValueError: No such archive or array, or as `read_npy`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be an .npz file, found none; check the path")
    refuse_foreign(path, "an .npz file")
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder) / f"{name}.npy"
        with _reading_archive(path, f"an array {name!r}"), zipfile.ZipFile(path) as archive:
            size = archive.getinfo(unpacked.name).file_size
        memory.require(f"{path}", size, f"{size} bytes of {name}", "make it smaller")
        with (
            _reading_archive(path, f"an array {name!r}"),
            zipfile.ZipFile(path) as archive,
            unpacked.open("wb") as file,
        ):
            shutil.copyfileobj(archive.open(unpacked.name), file)
        try:
            return read_npy(unpacked)
        except ValueError as error:
            raise ValueError(str(error).replace(str(unpacked), f"{path}: {name}")) from None


@contextlib.contextmanager
def _reading_archive(path: Path, what: str) -> Iterator[None]:
    """Make one ValueError of whatever zipfile and the decoders of its parts raise of a damaged archive."""
    try:
        yield
    except Exception as error:
        # Decoders raise OSError without a number, and a place before the beginning of a file is invalid; any other is
        # of the disk.
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno not in (None, errno.EINVAL)):
            raise
        raise ValueError(f"{path}: must hold {what}, got {said(error)}; save it with numpy.savez") from None


@contextlib.contextmanager
def said_of(where: str) -> Iterator[None]:
    """A ValueError of the block names what it is about: the file, and the place in it."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def inverse_pose(where: str, c2w: np.ndarray) -> np.ndarray:
    """(4,4) w2c of a c2w (3 or 4 rows) that a file states; the inverse of its rotation is its transpose.

    `Camera` then refuses what is no rotation.

    Raises:
        ValueError: a number is not finite or beyond reason, or a fourth row is not 0 0 0 1.
    """
    c2w = np.asarray(c2w, np.float64)
    if not np.isfinite(c2w).all():
        raise ValueError(f"{where}: the pose must be finite, got NaN or Inf; drop this view")
    check_distance(where, c2w)
    check_last_row(f"{where}: the pose", c2w)
    w2c = np.eye(4)
    w2c[:3, :3] = c2w[:3, :3].T
    w2c[:3, 3] = -c2w[:3, :3].T @ c2w[:3, 3]
    return w2c


def check_last_row(what: str, c2w: np.ndarray) -> None:
    """Raise ValueError unless a pose of 4 rows ends in 0 0 0 1, which one that is written by columns does not."""
    if not np.allclose(c2w[3:], (0, 0, 0, 1)):
        last = " ".join(f"{x:g}" for x in c2w[3])
        raise ValueError(f"{what} must be camera-to-world by rows and end in 0 0 0 1, got {last}; is it transposed?")


def repaired_pose(pose: np.ndarray) -> np.ndarray:
    """A pose (4,4) whose rotation was printed with a few digits, with the nearest rotation; others as they are."""
    rotation = pose[:3, :3]
    is_close = np.abs(rotation).max() < 2 and np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROUNDING
    if not (is_close and np.linalg.det(rotation) > 0):
        return pose
    u, _, vt = np.linalg.svd(rotation)
    repaired = pose.copy()
    repaired[:3, :3] = u @ vt
    return repaired
