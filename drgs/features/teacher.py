"""Feature maps of a teacher on disk: a vector for each cell of a photograph, read where it is used.

A file holds one tensor (C, h, w) as `torch.save` writes it, in half or single precision. The encoders of Feature 3DGS
(Zhou et al., CVPR 2024) write half precision for LSeg, 512 channels at 480x360, and single precision for SAM, 256
channels, cropped to the photograph: a view into a larger tensor, not contiguous. The map covers its whole photograph,
whose shape it need not have.
"""

from __future__ import annotations

import math
import os
import pickle
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.checks.arguments import said
from drgs.io.archives import check_archive
from drgs.io.foreign import refuse_foreign

if TYPE_CHECKING:
    import torch

# `CxHxW` are the letters in the files of Feature 3DGS; numbers in their place must agree with the tensor.
_NAME = re.compile(r"(.+)_fmap_(CxHxW|(\d+)x(\d+)x(\d+))\.pt")
_ZIP = b"PK\x03\x04"
_finite: set[tuple[Path, int, int]] = set()  # files (path, size, time of change) that have been looked through


def map_name(path: str | os.PathLike) -> str | None:
    """The image's stem that a file's name says it is the map of, `rgb_000` of `rgb_000_fmap_CxHxW.pt`.

    Returns:
        None if it is not named as a map.
    """
    found = _NAME.fullmatch(Path(path).name)
    return found[1] if found else None


def read_map(path: str | os.PathLike) -> torch.Tensor:
    """A teacher's map (C, h, w), float16 or float32, memory-mapped: nothing but its header is read before it is used.

    Writing into the tensor changes a private copy of the pages written to, never the file. Nothing in the file is
    executed: only tensors are unpickled.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not one plain tensor of three dimensions and one of these types, has another shape than the
            file's name says, is cut short, or claims more numbers than the file has.
    """
    import torch

    path = Path(path)
    value = read_tensor(path, "a teacher's feature map")
    if value.ndim != 3 or not value.numel():
        raise ValueError(f"{path}: must hold a tensor (C, h, w), got shape {tuple(value.shape)}; save one map a file")
    if value.dtype not in (torch.float16, torch.float32):
        raise ValueError(f"{path}: must hold float16 or float32, got {value.dtype}; save tensor.half()")
    named = _NAME.fullmatch(path.name)
    if named and named[3] and tuple(map(int, named.groups()[2:])) != tuple(value.shape):
        raise ValueError(f"{path}: must hold what its name says, {named[2]}, got {tuple(value.shape)}; rename it")
    return value


def read_tensor(path: str | os.PathLike, what: str = "a tensor's file") -> torch.Tensor:
    """The one plain tensor of a file that `torch.save` wrote, memory-mapped; nothing in the file is executed.

    Args:
        path: File to read.
        what: Kind of file that it must be, for the message.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is anything but one plain tensor, is cut short, or claims more numbers than the file has.
    """
    import torch

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be {what}, found none; check the path")
    with path.open("rb") as file:
        head = file.read(len(_ZIP))
    if head != _ZIP:
        refuse_foreign(path, what)
        raise ValueError(
            f"{path}: must be a zip file as torch.save writes it, got other bytes; save the tensor with torch.save"
        )
    check_archive(path)
    try:
        with warnings.catch_warnings():  # of pickle protocols that no one uses; what they say comes to nothing
            warnings.simplefilter("ignore")
            value = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except pickle.UnpicklingError:
        raise ValueError(
            f"{path}: must hold one plain tensor, got other Python objects, which are never unpickled; "
            "save the tensor alone"
        ) from None
    except Exception as error:  # torch's reader raises whatever its parts do: RuntimeError, KeyError, EOFError
        raise ValueError(
            f"{path}: must hold one plain tensor, whole, torch says {said(error)!r}; copy it again, or save the tensor "
            "alone"
        ) from None
    if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
        kind = type(value).__name__ if not isinstance(value, torch.Tensor) else f"tensor of layout {value.layout}"
        raise ValueError(f"{path}: must hold one plain tensor, got a {kind}; save the tensor alone")
    # Of a tensor that repeats its numbers (a stride of 0), a kilobyte would be read for minutes.
    claimed = math.prod(value.shape) * value.element_size()
    if claimed > path.stat().st_size:
        raise ValueError(
            f"{path}: must hold every number that it claims, {tuple(value.shape)} takes {claimed} bytes, the file has "
            f"{path.stat().st_size}; save tensor.contiguous()"
        )
    return value.detach()  # a tensor that was saved while it wanted a gradient still wants one


def check_finite(values: torch.Tensor, path: str | os.PathLike) -> None:
    """Look through a map, one channel at a time.

    Args:
        values: (C, h, w) map, float16 or float32.
        path: File of the map, for the message.
    Raises:
        ValueError: If a value is NaN or infinite; names the first one's place.
    """
    for channel, plane in enumerate(values.detach().cpu().numpy()):  # NumPy takes no tensor with a gradient
        # Exponents of ones alone: several times as fast as numpy's isfinite in half precision.
        bits, ones = (
            (plane.view(np.uint16), 0x7C00) if plane.dtype == np.float16 else (plane.view(np.uint32), 0x7F800000)
        )
        bad = (bits & bits.dtype.type(ones)) == ones
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"{path}: must be finite, got {plane[row, column]} at channel {channel}, row {row}, column {column}; "
                "make this map again"
            )


def used_map(path: str | os.PathLike) -> torch.Tensor:
    """`read_map`, looked through for NaN when a file, as it is now, is used for the first time in this process.

    Raises:
        FileNotFoundError, ValueError: As `read_map` and `check_finite`.
    """
    values = read_map(path)
    state = os.stat(path)
    key = Path(path).absolute(), state.st_size, state.st_mtime_ns
    if key not in _finite:
        check_finite(values, path)
        _finite.add(key)
    return values
