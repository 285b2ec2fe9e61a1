"""Data sets on disk: nothing half-written, and what is finished is kept when making them is interrupted."""

from __future__ import annotations

import hashlib
import json
import os

import numpy as np

from drgs.io import atomic
from drgs.io.outputs import lock_folder

__all__ = ["DEPTH_UNIT", "check_numbers", "publish", "write_depth", "write_file", "write_png"]

DEPTH_UNIT = 1e-4  # meters a 16-bit step: reaches 6.5 m, finer than a pixel's footprint indoors
_PARTIAL = ".drgs.scene"


def check_numbers(values, where):
    """Refuse numbers of a data set that are none.

    Args:
        values: Name -> number: views, seed, sizes in pixels, light paths a pixel.
        where: Name of the caller, for the error.
    Raises:
        ValueError: If one is not an integer in its range.
    """
    for name, value in values.items():
        low = {"seed": 0, "width": 8, "height": 8, "test_every": 2}.get(name, 1)
        if not isinstance(value, int) or not low <= value <= 16384:
            raise ValueError(
                f"{where}: {name} must be an integer from {low} to 16384, got {value!r}; choose another {name}"
            )


def publish(out_dir, parameters, fill, where):
    """Make a folder whose params.json comes last: with it, the folder is complete, whenever the process dies.

    Until then everything lies in a hidden folder in it, `.drgs.scene`: an interrupted call with the same parameters
    goes on there, one with others starts anew.

    Args:
        out_dir: Folder to make. One that was published with the same parameters is kept, one that was published with
            others is replaced, and one that holds anything else is refused.
        parameters: JSON-serializable dict that determines the content.
        fill: Function that is called with the hidden folder to write the content into. What an interrupted call has
            left is still there: it must keep whatever is finished and write the rest, each file at once (`write_file`).
        where: Name of the caller, for the error.
    Returns:
        `out_dir`.
    Raises:
        ValueError: If `out_dir` holds something that was not published here, or was changed since.
    """
    digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode()).hexdigest()
    stamp = out_dir / "params.json"
    if stamp.is_file() and digest in stamp.read_text():
        return out_dir
    with lock_folder(out_dir, where) as output:
        for path in _content(output):
            if not output.is_ours(path, (where,)):
                raise ValueError(
                    f"{where}: the output must be a new folder or as it was made here, {path} is not; "
                    "name another or move it away"
                )
        partial = output.path / _PARTIAL
        mark = partial / ".parameters"
        if not _is_ours(partial, mark):
            raise ValueError(
                f"{where}: {partial} must be what an interrupted call has left, it was not made here; move it away"
            )
        if not (mark.is_file() and mark.read_text() == digest):
            atomic.delete(partial)
            partial.mkdir()
            write_file(mark, digest.encode())
        try:
            fill(partial)
        except BaseException:
            if not any(path.is_file() and path != mark for path in partial.rglob("*")):
                atomic.delete(partial)  # nothing to go on with
            raise
        stamped = json.dumps({"sha256": digest, **parameters}, indent=1) + "\n"
        write_file(partial / "params.json", stamped.encode())
        for path in _content(output):
            output.remove(path)
        for path in sorted(partial.iterdir(), key=lambda path: path.name == "params.json"):
            if path != mark:  # last: while anything is in the folder, the mark says whose it is
                output.put(path, path.name)
        mark.unlink()
        partial.rmdir()
    return out_dir


def _is_ours(partial, mark):
    """Whether there is nothing of somebody else's at the hidden folder: no folder, an empty one, or one with a mark."""
    if not os.path.lexists(partial):
        return True
    if partial.is_symlink() or not partial.is_dir():
        return False
    return mark.is_file() or all(path.name == _part(mark).name for path in partial.iterdir())


def _content(output):
    """What people see of a claimed folder."""
    return [path for path in output.path.iterdir() if not path.name.startswith(".drgs.")]


def write_file(path, content):
    """Write bytes under a name that appears when they are complete."""
    hidden = _part(path)
    try:
        hidden.write_bytes(content)
        os.replace(hidden, path)
    except OSError as error:
        hidden.unlink(missing_ok=True)
        raise OSError(f"scenes: {path} must be writable, got: {error.strerror}; free space") from None


def _part(path):
    """What a file is called while `write_file` writes it."""
    return path.with_name(f".{path.name}.part")


def write_png(path, picture):
    """Write a picture, BGR or gray, at once."""
    import cv2

    write_file(path, cv2.imencode(".png", picture)[1].tobytes())


def write_depth(path, depth):
    """Write depth in meters as 16-bit multiples of `DEPTH_UNIT`."""
    write_png(path, np.minimum(np.rint(depth / DEPTH_UNIT), 65535).astype(np.uint16))
