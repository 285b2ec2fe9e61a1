"""`.ksplat`, the format of mkkellogg's viewer GaussianSplats3D, at its compression levels 0, 1 and 2.

Decoded here: no package for Python reads it. The layout is that of mkkellogg/GaussianSplats3D
(src/loaders/SplatBuffer.js), with the order of SH as playcanvas/splat-transform reads it (read-ksplat.ts at 1723aab):

    4096 bytes       version, numbers of sections and Gaussians, level, range of 8-bit SH
    1024 a section   its numbers of Gaussians and buckets, size of a block, SH degree
    then each section: sizes of buckets that are not full, centers of all buckets, and the Gaussians

Level 0 has float32 throughout; level 1 has means as 16 bits within the block around a bucket's center and the rest as
half floats; level 2 has SH in bytes. Scales are linear, quaternions wxyz, colors and opacities bytes. SH of a degree
stand channel by channel. Axes are those of the PLY.
"""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np

from drgs.codecs.codec import Codec
from drgs.codecs.splat import LEAST_FLOAT
from drgs.codecs.values import SH_COUNTS, assembled, check_count, dc_of_colors, log_of_scales, logits_of_bytes
from drgs.ellipsoids import Gaussians

_HEADER_BYTES = 4096  # bytes of the header of a file
_SECTION_BYTES = 1024  # bytes of the header of a section
_LEAST_HALF = 2.0**-26  # the middle of what rounds to 0 as a half float
_DAMAGED = "it is truncated or damaged, copy it again"


@dataclasses.dataclass(frozen=True)
class _Section:
    """A section's header, and where it lies in the file."""

    count: int
    capacity: int
    buckets: int
    block: float
    bucket_bytes: int
    steps: int
    full: int
    partial: int
    degree: int
    start: int
    row: np.dtype

    @property
    def rows_at(self) -> int:
        """Where its Gaussians begin."""
        return self.start + 4 * self.partial + self.bucket_bytes * self.buckets


def load_ksplat(path: Path) -> Gaussians:
    """Gaussians of a .ksplat file; sections of a lower SH degree than the highest get zeros.

    Raises:
        ValueError: If it is damaged, of another version or level, or a value is not finite (the first index is named).
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES or data[0] != 0 or data[1] < 1:
        raise ValueError(
            f"{path}: must be a .ksplat file of version 0.1, got {tuple(data[:2])} in {len(data)} bytes; {_DAMAGED}"
        )
    (sections, _, _, count, level) = struct.unpack_from("<IIIIH", data, 4)
    low, high = struct.unpack_from("<ff", data, 36)
    if level > 2:
        raise ValueError(f"{path}: the compression level of a .ksplat file must be 0, 1 or 2, got {level}; {_DAMAGED}")
    if _HEADER_BYTES + sections * _SECTION_BYTES > len(data):
        raise ValueError(f"{path}: the header claims {sections} sections, the file holds {len(data)} bytes; {_DAMAGED}")
    found = []
    start = _HEADER_BYTES + sections * _SECTION_BYTES
    for i in range(sections):
        section, start = _section(path, data, i, level, start)
        found.append(section)
    found = [section for section in found if section.count]
    if count == 0 or sum(section.count for section in found) != count:
        there = sum(section.count for section in found)
        raise ValueError(f"{path}: the header claims {count} Gaussians, its sections {there}; {_DAMAGED}")
    degree = max(section.degree for section in found)
    check_count(path, count, SH_COUNTS[degree])
    parts = [_decoded(path, data, section, level, degree, (low or -1.5, high or 1.5)) for section in found]
    means, quats, scales, colors, sh = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return assembled(
        path,
        means,
        quats,
        log_of_scales(path, scales, LEAST_FLOAT if level == 0 else _LEAST_HALF),
        logits_of_bytes(colors[:, 3]),
        np.concatenate([dc_of_colors(colors[:, :3] / 255.0), sh], axis=1),
    )


def _section(path: Path, data: bytes, index: int, level: int, start: int) -> tuple[_Section, int]:
    """A section's header, compared with the file, and where the next one's data begin."""
    at = _HEADER_BYTES + index * _SECTION_BYTES
    count, room, capacity, buckets, block, bucket_bytes = struct.unpack_from("<IIIIfH", data, at)
    (steps,) = struct.unpack_from("<I", data, at + 24)
    full, partial, degree = struct.unpack_from("<IIH", data, at + 32)
    if degree > 2:
        raise ValueError(f"{path}: section {index} must have SH of degree 0, 1 or 2, got {degree}; {_DAMAGED}")
    short = level > 0
    row = np.dtype(
        [
            ("mean", "<u2" if short else "<f4", 3),
            ("scale", "<f2" if short else "<f4", 3),
            ("quat", "<f2" if short else "<f4", 4),
            ("color", "u1", 4),
            ("sh", ("<f4", "<f2", "u1")[level], 3 * (SH_COUNTS[degree] - 1)),
        ]
    )
    steps = steps or (32767 if short else 1)
    section = _Section(count, capacity, buckets, block, bucket_bytes, steps, full, partial, degree, start, row)
    end = section.rows_at + row.itemsize * max(room, count)
    if section.rows_at + row.itemsize * count > len(data):
        raise ValueError(
            f"{path}: section {index} claims {count} Gaussians in {buckets} buckets, the file holds {len(data)} bytes; "
            f"{_DAMAGED}"
        )
    if short and count and (bucket_bytes < 12 or full + partial > buckets or not np.isfinite(block)):
        raise ValueError(
            f"{path}: section {index} must have buckets of 12 bytes and a finite size, got {bucket_bytes} bytes for "
            f"{full} + {partial} of {buckets} and {block:g}; {_DAMAGED}"
        )
    return section, end


def _decoded(
    path: Path, data: bytes, section: _Section, level: int, degree: int, span: tuple[float, float]
) -> tuple[np.ndarray, ...]:
    """Means, quaternions, linear scales, RGBA bytes and (N, K - 1, 3) SH of a section."""
    rows = np.frombuffer(data, section.row, section.count, section.rows_at)
    means = rows["mean"]
    if level:
        centers = _bucket_centers(path, data, section)
        # float64: 16 bits less their middle wrap around in the type that they are stored in.
        means = (means.astype(np.float64) - section.steps) * (section.block / 2 / section.steps) + centers
    stored = rows["sh"].astype(np.float32)
    if level == 2:
        stored = (span[0] + stored / 255 * (span[1] - span[0])).astype(np.float32)
    sh = np.zeros((section.count, SH_COUNTS[degree] - 1, 3), np.float32)
    at = 0
    for d in range(1, section.degree + 1):
        width = 2 * d + 1
        block = stored[:, 3 * at : 3 * (at + width)].reshape(-1, 3, width)
        # Stored channel by channel; ours are coefficient by coefficient.
        sh[:, at : at + width] = block.transpose(0, 2, 1)
        at += width
    return means, rows["quat"].astype(np.float32), rows["scale"].astype(np.float32), rows["color"], sh


def _bucket_centers(path: Path, data: bytes, section: _Section) -> np.ndarray:
    """(N, 3) center of each Gaussian's bucket: those of full buckets come first, then the others by their sizes."""
    sizes = np.frombuffer(data, "<u4", section.partial, section.start).astype(np.int64)
    # Summed and looked up, not spelled out: sizes are the file's word.
    ends = section.full * section.capacity + np.cumsum(sizes)
    index = np.arange(section.count)
    bucket = index // max(section.capacity, 1)
    is_partial = index >= section.full * section.capacity
    bucket[is_partial] = section.full + np.searchsorted(ends, index[is_partial], side="right")
    if section.count and bucket.max() >= section.full + section.partial:
        raise ValueError(
            f"{path}: buckets must hold all {section.count} Gaussians of their section, hold fewer; {_DAMAGED}"
        )
    at = section.start + 4 * section.partial
    stride = section.bucket_bytes
    raw = np.frombuffer(data, np.uint8, stride * section.buckets, at).reshape(section.buckets, stride)[:, :12]
    return np.ascontiguousarray(raw).view("<f4")[bucket].astype(np.float64)


KSPLAT = Codec(
    ".ksplat",
    load_ksplat,
    made_by="`node util/create-ksplat.js {ply} {path}` of github.com/mkkellogg/GaussianSplats3D",
)
