"""The compressed PLY of SuperSplat and the PlayCanvas engine: 16 bytes a Gaussian and 72 a chunk of 256, SH in bytes.

Read by plyfile, once the header has been compared with the file, and unpacked here. The layout is that of
playcanvas/splat-transform (decompress-ply.ts at d29f7b8): each chunk states the range of its means, log scales and (in
newer files) colors; a Gaussian has 11, 10 and 11 bits for its mean and for its log scales, 2 + 3 x 10 for its rotation,
8 for each color and its opacity. Axes are those of the PLY.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from drgs.codecs.clustering import morton_order
from drgs.codecs.codec import Codec
from drgs.codecs.ply import note_antialiased
from drgs.codecs.ply_headers import PlyElement, is_antialiased, offset_line, ply_offset, ply_source, read_ply_header
from drgs.codecs.values import (
    assembled,
    check_count,
    dc_of_colors,
    logits_of_bytes,
    quats_of_smallest,
    smallest_of_quats,
)
from drgs.ellipsoids import Y_00, Gaussians

_log = logging.getLogger(__name__)

_CHUNK_GAUSSIANS = 256  # Gaussians that share one range of values, as SuperSplat's format has it
_MAX_LOG_SCALE = 20.0
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_ADVICE = "export it again from SuperSplat (superspl.at/editor)"


def load_packed_ply(path: Path) -> Gaussians:
    """Gaussians of a PLY in PlayCanvas' compressed layout.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged or of another layout, or a value is not finite (the first index is named).
    """
    import plyfile

    elements = {element.name: element for element in read_ply_header(path)}
    count, coefficients = _check(path, elements)
    check_count(path, count, coefficients)
    if is_antialiased(path):
        note_antialiased(path)
    try:
        ply = plyfile.PlyData.read(ply_source(path))
    except (plyfile.PlyParseError, ValueError, OSError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path}: must be a readable PLY, got {text}; {_ADVICE}") from None
    wanted = {"chunk": elements["chunk"].columns, "vertex": _PACKED, "sh": ()}
    if coefficients > 1:
        wanted["sh"] = elements["sh"].columns
    for name, columns in wanted.items():
        lists = [column for column in columns if ply[name].data.dtype[column].hasobject]
        if lists:
            raise ValueError(f"{path}: the {name} column {lists[0]} must be a number, is a list; {_ADVICE}")
    chunks, vertex = ply["chunk"].data, ply["vertex"].data
    chunk = np.arange(count) // _CHUNK_GAUSSIANS
    # In the order of this machine's bytes, and without a sign: the bits are shifted apart.
    position, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
    rgba = np.stack([color >> shift & 255 for shift in (24, 16, 8, 0)], axis=1)
    colors = rgba[:, :3] / 255.0
    if "min_r" in elements["chunk"].columns:
        colors = _between(chunks, ("r", "g", "b"), chunk, colors)
    others = np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023.0
    sh = dc_of_colors(colors)
    if coefficients > 1:
        sh = np.concatenate([sh, _higher(ply["sh"].data, coefficients - 1)], axis=1)
    made = assembled(
        path,
        _between(chunks, ("x", "y", "z"), chunk, _unpacked(position)),
        quats_of_smallest((rotation >> 30).astype(int), (others - 0.5) * 2**0.5),
        _between(chunks, ("scale_x", "scale_y", "scale_z"), chunk, _unpacked(scale)),
        logits_of_bytes(rgba[:, 3]),
        sh,
    )
    offset = ply_offset(path)
    return made if offset is None else made.replace(origin=offset)


def _check(path: Path, elements: dict[str, PlyElement]) -> tuple[int, int]:
    """Numbers of Gaussians and of SH coefficients, if all columns are there and of their kinds."""
    ranges = ("x", "y", "z", "scale_x", "scale_y", "scale_z")
    wanted = {"chunk": [f"{end}_{name}" for end in ("min", "max") for name in ranges], "vertex": list(_PACKED)}
    if "chunk" in elements and "min_r" in elements["chunk"].columns:
        wanted["chunk"] += [f"{end}_{name}" for end in ("min", "max") for name in "rgb"]
    for name, columns in wanted.items():
        kinds = ("float", "float32") if name == "chunk" else ("uint", "uint32")
        there = dict(zip(elements[name].columns, elements[name].kinds, strict=True)) if name in elements else {}
        missing = [column for column in columns if there.get(column) not in kinds]
        if missing:
            raise ValueError(
                f"{path}: a compressed PLY must have the {name} columns {', '.join(columns[:3])}, ... of type "
                f"{kinds[0]}, {missing[0]} is missing; {_ADVICE}"
            )
    count, chunks = elements["vertex"].rows, elements["chunk"].rows
    if chunks * _CHUNK_GAUSSIANS < count:
        raise ValueError(
            f"{path}: must have a chunk for every {_CHUNK_GAUSSIANS} Gaussians, got {chunks} for {count}; {_ADVICE}"
        )
    sh = elements.get("sh")
    if sh is None:
        return count, 1
    names = {f"f_rest_{i}" for i in range(len(sh.columns))}
    fits = set(sh.columns) == names and len(names) in (9, 24, 45) and {*sh.kinds} <= {"uchar", "uint8"}
    if sh.rows != count or not fits:
        raise ValueError(
            f"{path}: the element sh must have {count} rows of 9, 24 or 45 bytes f_rest_0, ..., got {sh.rows} of "
            f"{len(sh.columns)}; {_ADVICE}"
        )
    return count, len(names) // 3 + 1


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """(N, 3) fractions of 11, 10 and 11 bits."""
    return np.stack([(packed >> 21) / 2047.0, (packed >> 11 & 1023) / 1023.0, (packed & 2047) / 2047.0], axis=1)


def _between(chunks: np.ndarray, names: tuple[str, ...], chunk: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Values at fractions of their chunk's ranges."""
    low, high = (np.stack([chunks[f"{end}_{name}"] for name in names], axis=1)[chunk] for end in ("min", "max"))
    with np.errstate(invalid="ignore"):  # of infinite ends; what comes of them is refused
        return low * (1 - part) + high * part


def _higher(rows: np.ndarray, coefficients: int) -> np.ndarray:
    """(N, coefficients, 3) of bytes channel by channel: steps of 1/32 from -4 to 4, the outer ones at the ends."""
    stored = np.stack([rows[f"f_rest_{i}"] for i in range(3 * coefficients)], axis=1)
    table = (np.arange(256, dtype=np.float32) + 0.5) / 256
    table[[0, 255]] = 0, 1
    values = (table - 0.5) * 8
    # Stored channel by channel; ours are coefficient by coefficient.
    return values[stored].reshape(-1, 3, coefficients).transpose(0, 2, 1)


def _is_packed(path: Path, head: bytes) -> bool:
    """Whether a PLY has packed columns in its header."""
    return head.startswith((b"ply\n", b"ply\r")) and b" packed_position" in head.partition(b"\nend_header")[0]


def encode_packed_ply(g: Gaussians) -> bytes:
    """A compressed PLY of Gaussians in the axes of PLY files; their features are left out.

    Gaussians are in Morton order, so that those of a chunk are close and its range is small. Log scales are kept
    between -20 and 20, as SuperSplat keeps them, SH above degree 0 between -4 and 4.
    """
    order = morton_order(g.means.numpy()) if len(g) else np.zeros(0, np.int64)
    sh = g.sh.numpy()[order].astype(np.float64)
    log_scales = g.log_scales.numpy()[order].astype(np.float64)
    outside = {
        "log scales": int((np.abs(log_scales) > _MAX_LOG_SCALE).sum()),
        "SH coefficients": int((np.abs(sh[:, 1:]) > 4 + 1 / 64).sum()),
    }
    for name, count in outside.items():
        if count:
            _log.warning("compressed PLY: %d %s were out of its range and went to its end", count, name)
    fields = {
        "xyz": g.means.numpy()[order].astype(np.float64),
        "scale": np.clip(log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE),
        "rgb": sh[:, 0] * Y_00 + 0.5,
    }
    ranges, parts = list[np.ndarray](), dict[str, np.ndarray]()
    for name, values in fields.items():
        low, high, parts[name] = _in_chunks(values)
        ranges += [low, high]
    # float64: a logit that was read from a byte must go back to that byte.
    opacities = g.logit_opacities.double().sigmoid().numpy()[order]
    colors = np.concatenate([parts["rgb"], opacities[:, None]], axis=1)
    vertices = [
        _packed(parts["xyz"], (11, 10, 11)),
        _packed_quats(g.quats.numpy().astype(np.float64)[order]),
        _packed(parts["scale"], (11, 10, 11)),
        _packed(colors, (8, 8, 8, 8)),
    ]
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]
    names += [f"{end}_{axis}" for end in ("min", "max") for axis in ("r", "g", "b")]
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {offset_line(g.origin)}"] if g.origin.any() else []
    lines += [f"element chunk {len(ranges[0])}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element vertex {len(g)}", *(f"property uint {name}" for name in _PACKED)]
    body = [
        np.concatenate(ranges, axis=1).astype("<f4").tobytes(),
        np.stack(vertices, axis=1).astype("<u4").tobytes(),
    ]
    if g.sh_degree:
        # Ours are coefficient by coefficient, stored channel by channel.
        rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(g), 3 * (sh.shape[1] - 1))
        lines += [f"element sh {len(g)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        body.append(np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes())
    return "\n".join([*lines, "end_header", ""]).encode() + b"".join(body)


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest of (N, 3) values of each chunk, and where between them each value is, 0 to 1."""
    if not len(values):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), values
    starts = np.arange(0, len(values), _CHUNK_GAUSSIANS)
    low, high = (how.reduceat(values, starts, axis=0).astype(np.float32) for how in (np.minimum, np.maximum))
    first, last = (np.repeat(x, _CHUNK_GAUSSIANS, axis=0)[: len(values)].astype(np.float64) for x in (low, high))
    return low, high, np.clip((values - first) / np.where(last > first, last - first, 1), 0, 1)


def _packed(part: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """(N,) uint32 of fractions (N, K), each in so many bits, the first one highest."""
    packed = np.zeros(len(part), np.uint32)
    for k, width in enumerate(bits):
        packed = packed << np.uint32(width) | np.rint(part[:, k] * ((1 << width) - 1)).astype(np.uint32)
    return packed


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """(N,) uint32: 2 bits for the place of the largest component, 10 for each of the others."""
    largest, others = smallest_of_quats(quats)
    return _packed(np.clip(others / 2**0.5 + 0.5, 0, 1), (10, 10, 10)) | largest.astype(np.uint32) << np.uint32(30)


PACKED_PLY = Codec(
    ".compressed.ply", load_packed_ply, _is_packed, by_suffix=False, encode=encode_packed_ply, keeps_origin=True
)
