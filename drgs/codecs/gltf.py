"""glTF with KHR_gaussian_splatting, as a `.glb`: float32 throughout, as ratified by Khronos (read and written).

Written here: a GLB is a header, a JSON text and one buffer; `pygltflib` knows no attributes of extensions and checks no
sizes. The layout is KHR_gaussian_splatting at KhronosGroup/glTF, main: points with POSITION and the attributes ROTATION
(xyzw, length 1), SCALE, OPACITY and SH_DEGREE_l_COEF_n (RGB). Scales are linear and opacities in [0, 1]. Files that
were written to the review draft of before February 2026, splat-transform's of before June 2026 among them, have log
scales (KhronosGroup/glTF issue 2563, playcanvas/splat-transform pull request 268): negative ones tell them apart.

Axes: glTF has y up and z to the front, PLY files of 3DGS y down and z to the front. Between the two, x and y turn their
signs (a half turn about z, as splat-transform does it), and with them those of quaternions and SH. What positions are
relative to is `asset.extras.offset`, in the axes of glTF; no node moves them there, for viewers are float32.
"""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras.origins import check_origin
from drgs.codecs.codec import Codec
from drgs.codecs.glb import BIN, JSON, glb_of
from drgs.codecs.values import SH_COUNTS, assembled, check_count, flipped, log_of_scales, logits_of_opacities
from drgs.ellipsoids import Y_00, Gaussians
from drgs.io.json_files import check_json, parse_json

_AXES = (-1, -1, 1)  # signs of x, y and z between glTF and PLY
_NAME = "KHR_gaussian_splatting"
_FLOAT = 5126  # component type of float32 in glTF (GL_FLOAT)
_BYTE = 5121  # of uint8 (GL_UNSIGNED_BYTE)
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}  # numbers of an element, by accessor type
# Component type -> its dtype and, where it is normalized, what 1 is.
_KINDS = {5126: ("<f4", 1), 5120: ("i1", 127), 5121: ("u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535)}
_LEAST = float(np.finfo(np.float32).tiny)  # what a scale of 0 is taken for
_ADVICE = "export it as a GLB that is not compressed, or as a PLY"
_log = logging.getLogger(__name__)


def encode_glb(g: Gaussians) -> bytes:
    """A GLB of Gaussians in the axes of PLY files; their features are left out."""
    g = flipped(g, _AXES)
    quats = g.quats.numpy().astype(np.float64)
    quats /= np.abs(quats).max(axis=1, keepdims=True, initial=0.0)  # first, so that no square under- or overflows
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    # float64, rounded once: exp and sigmoid of float32 are off by a last digit or two.
    opacities = g.logit_opacities.double().sigmoid().numpy()
    scales = g.log_scales.double().exp().numpy()
    sh = g.sh.numpy()
    colors = np.column_stack([sh[:, 0] * Y_00 + 0.5, opacities])
    # A scale that float32 cannot hold becomes infinite, and is refused below.
    with np.errstate(over="ignore"):
        arrays = {
            "POSITION": g.means.numpy(),
            f"{_NAME}:ROTATION": quats[:, [1, 2, 3, 0]],
            f"{_NAME}:SCALE": scales.astype(np.float32),
            f"{_NAME}:OPACITY": opacities[:, None],
            **{f"{_NAME}:SH_DEGREE_{d}_COEF_{n}": sh[:, k] for k, (d, n) in enumerate(_orders(g.sh_degree))},
        }
    if not np.isfinite(arrays[f"{_NAME}:SCALE"]).all():
        raise ValueError(
            "save_gaussians: glTF holds linear scales as float32, a log scale above 88 is none; write a PLY"
        )
    parts = {name: np.ascontiguousarray(x, "<f4") for name, x in arrays.items()}
    # For viewers that show points only.
    parts["COLOR_0"] = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    accessors = []
    for x in parts.values():
        kind: dict[str, Any] = {"type": next(key for key, width in _WIDTHS.items() if width == x.shape[1])}
        kind |= {"componentType": _BYTE, "normalized": True} if x.dtype == np.uint8 else {"componentType": _FLOAT}
        accessors.append((x, kind, 34962))
    primitive = {
        "attributes": {name: i for i, name in enumerate(parts)},
        "mode": 0,
        "extensions": {_NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return glb_of("save_gaussians", accessors, primitive, {"extensionsUsed": [_NAME]}, g.origin)


def load_glb(path: Path) -> Gaussians:
    """Gaussians of a GLB with one primitive of KHR_gaussian_splatting, without compression or a node's transform.

    Raises:
        ValueError: If it is damaged or of another kind, or a value is not finite (the first index is named).
    """
    document, buffer = _chunks(path)
    primitive = _primitive(path, document)
    names = primitive["attributes"]
    reader = _Accessors(path, document, buffer)
    count = reader.count(names["POSITION"])
    orders = [(d, n) for d, n in _orders(3) if f"{_NAME}:SH_DEGREE_{d}_COEF_{n}" in names]
    if len(orders) not in SH_COUNTS or orders != _orders(SH_COUNTS.index(len(orders))):
        raise ValueError(
            f"{path}: SH must be whole up to a degree of 0 to 3, got {len(orders)} coefficients; {_ADVICE}"
        )
    if f"{_NAME}:SH_DEGREE_4_COEF_0" in names:
        _log.warning("%s: left out the SH coefficients of degree 4, there is no such color here", path)
    for name, index in names.items():
        if (name == "POSITION" or name.startswith(f"{_NAME}:")) and reader.count(index) != count:
            raise ValueError(f"{path}: {name} must have {count} values as POSITION has; {_ADVICE}")
    check_count(path, count, len(orders))
    wanted = ("POSITION", *(f"{_NAME}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))
    widths = (3, 4, 3, 1)
    means, quats, scales, opacities = (
        reader.read(names[name], width) for name, width in zip(wanted, widths, strict=True)
    )
    sh = np.stack([reader.read(names[f"{_NAME}:SH_DEGREE_{d}_COEF_{n}"], 3) for d, n in orders], axis=1)
    if (scales < 0).any():
        _log.warning(
            "%s: scales below 0 are none of the ratified glTF; taken for log scales, as its draft had them", path
        )
        log_scales = scales
    else:
        log_scales = log_of_scales(path, scales, _LEAST)
    made = assembled(path, means, quats[:, [3, 0, 1, 2]], log_scales, logits_of_opacities(opacities[:, 0]), sh)
    asset = document.get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    if isinstance(extras, dict) and "offset" in extras:
        made = made.replace(origin=check_origin(f"{path}: asset.extras.offset", extras["offset"]))
    return flipped(made, _AXES)


def _orders(degree: int) -> list[tuple[int, int]]:
    """Degree and number of each SH coefficient."""
    return [(d, n) for d in range(degree + 1) for n in range(2 * d + 1)]


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The JSON text, parsed, and the buffer of a GLB."""
    data = memoryview(path.read_bytes())
    damaged = "it is truncated or damaged, copy it again"
    if data[:4] != b"glTF":
        raise ValueError(f"{path}: must be a GLB (glTF in one binary file), is none; {_ADVICE}")
    if len(data) < 20 or struct.unpack_from("<I", data, 4)[0] != 2:
        raise ValueError(f"{path}: must be a GLB of version 2, is none; {damaged}")
    length, kind = struct.unpack_from("<II", data, 12)
    if kind != JSON or 20 + length > len(data):
        raise ValueError(f"{path}: the header claims {length} bytes of JSON, the file holds {len(data)}; {damaged}")
    document = parse_json(bytes(data[20 : 20 + length]), str(path), _ADVICE)
    shape = {"meshes": [{"primitives": [{"attributes": dict}]}], "accessors": [dict], "bufferViews": [dict]}
    check_json(str(path), document, shape, _ADVICE)
    at = 20 + length + -length % 4
    if at + 8 > len(data):
        return document, data[:0]
    size, kind = struct.unpack_from("<II", data, at)
    if kind != BIN or at + 8 + size > len(data):
        raise ValueError(f"{path}: the buffer claims {size} bytes, the file holds {len(data)}; {damaged}")
    return document, data[at + 8 : at + 8 + size]


def _primitive(path: Path, document: dict[str, Any]) -> dict[str, Any]:
    """The one primitive of Gaussians; what would change them is refused."""
    found = []
    for index, mesh in enumerate(document["meshes"]):
        for primitive in mesh["primitives"]:
            extensions = primitive.get("extensions")
            if isinstance(extensions, dict) and isinstance(extensions.get(_NAME), dict):
                found.append((index, primitive, extensions[_NAME]))
    if len(found) != 1:
        raise ValueError(f"{path}: must have one primitive of {_NAME}, has {len(found)}; {_ADVICE}")
    mesh, primitive, extension = found[0]
    others = {*(extension.get("extensions") or {})} | {x for x in primitive["extensions"] if x != _NAME}
    if others:
        raise ValueError(f"{path}: its Gaussians are packed by {', '.join(sorted(map(str, others)))[:80]}; {_ADVICE}")
    required = ["POSITION", *(f"{_NAME}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))]
    missing = [name for name in required if name not in primitive["attributes"]]
    if missing:
        raise ValueError(f"{path}: Gaussians of glTF must have the attribute {missing[0]}, have none; {_ADVICE}")
    nodes = document.get("nodes")
    for node in nodes if isinstance(nodes, list) else []:
        if isinstance(node, dict) and {"matrix", "translation", "rotation", "scale"} & set(node):
            raise ValueError(f"{path}: nodes must not be moved or turned, one is; apply its transform and export again")
    return primitive


class _Accessors:
    """Arrays of a GLB by their numbers, each compared with the buffer before it is read."""

    def __init__(self, path: Path, document: dict[str, Any], buffer: memoryview):
        self._path = path
        self._document = document
        self._buffer = buffer

    def _accessor(self, index: Any) -> dict[str, Any]:
        accessors = self._document["accessors"]
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(accessors):
            raise ValueError(f"{self._path}: an attribute must be an accessor, got {repr(index)[:40]}; {_ADVICE}")
        shape = {"count": int, "type": str, "componentType": int, "bufferView": int}
        check_json(f"{self._path}: accessor {index}", accessors[index], shape, _ADVICE)
        return accessors[index]

    def count(self, index: Any) -> int:
        """Values of an accessor."""
        return self._accessor(index)["count"]

    def read(self, index: Any, width: int) -> np.ndarray:
        """(N, width) numbers, normalized where the file says so."""
        accessor = self._accessor(index)
        where = f"{self._path}: accessor {index}"
        views, number = self._document["bufferViews"], accessor["bufferView"]
        known = accessor["componentType"] in _KINDS and _WIDTHS.get(accessor["type"]) == width
        if not known or "sparse" in accessor or not 0 <= number < len(views):
            raise ValueError(f"{where}: must be {width} numbers a Gaussian, not sparse, is another array; {_ADVICE}")
        kind, one = _KINDS[accessor["componentType"]]
        dtype = np.dtype(kind)
        view, count = views[number], accessor["count"]
        check_json(f"{self._path}: bufferView {number}", view, {"byteLength": int}, _ADVICE)
        stride = view.get("byteStride", dtype.itemsize * width)
        start, offset = view.get("byteOffset", 0), accessor.get("byteOffset", 0)
        if view.get("buffer", 0) != 0 or not all(
            isinstance(x, int) and 0 <= x < 1 << 63 for x in (start, offset, stride, count)
        ):
            raise ValueError(f"{where}: must lie in the file's own buffer, does not; {_ADVICE}")
        end = start + offset + stride * max(count - 1, 0) + dtype.itemsize * width * min(count, 1)
        if stride < dtype.itemsize * width or end > len(self._buffer):
            raise ValueError(
                f"{where}: claims {count} values up to byte {end}, the buffer holds {len(self._buffer)}; "
                "it is truncated or damaged, copy it again"
            )
        if count == 0:
            return np.zeros((0, width), np.float32)
        raw = np.ndarray((count, width), dtype, self._buffer, start + offset, (stride, dtype.itemsize))
        if not accessor.get("normalized"):
            return raw.astype(np.float32)
        # -128 of a normalized byte, and -32768 of a short, are -1 as their neighbors are: ranges are symmetric.
        return np.maximum(raw.astype(np.float32) / one, -1.0)


GLB = Codec(
    ".glb",
    load_glb,
    lambda path, head: head.startswith(b"glTF"),
    by_suffix=False,
    encode=encode_glb,
    keeps_origin=True,
)
