"""SOG, PlayCanvas' format: bytes of quantized values in lossless WebP images, and a meta.json that says what they mean.

Decoded here, the images by OpenCV: `sogs` on PyPI only writes, on CUDA. The layout is the specification
(developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, version 2) and, of version 1, what
playcanvas/splat-transform reads (read-sog-v1.ts at 27048b2).

    means_l, means_u   16 bits within [mins, maxs] of sign(x) log(1 + |x|)
    quats              the three smaller components in bytes, and 252 plus the place (wxyz) of the largest
    scales, sh0        bytes that choose of a codebook, opacities in 255ths; version 1: [mins, maxs], logits
    shN_labels         16 bits that choose a row of shN_centroids, whose bytes choose of a codebook

A scene is a zip archive (`.sog`) or a folder with these files. Axes are those of the PLY that it was made of, as
splat-transform writes and reads it (the specification calls them x right, y up, z back). What positions are relative to
is `asset.offset` of meta.json, which other readers leave alone.
"""

from __future__ import annotations

import io
import json
import logging
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from drgs.cameras.origins import check_origin
from drgs.codecs.bounded import Archive, pixels_of_webp, webp_of_pixels
from drgs.codecs.clustering import codebook, morton_order, palette
from drgs.codecs.codec import Codec
from drgs.codecs.folders import is_checkpoint, names_in_archive
from drgs.codecs.ply import note_antialiased
from drgs.codecs.values import SH_COUNTS, assembled, check_count, logits_of_bytes, quats_of_smallest, smallest_of_quats
from drgs.ellipsoids import Gaussians
from drgs.io.json_files import check_json, parse_json

_log = logging.getLogger(__name__)
_MAX_META_BYTES = 4 << 20  # bytes
# of log scales below the largest: fits make disks whose thickness is 1e-9, and 256 entries are few
_LOG_SCALE_RANGE = 8.0
_GAUSSIANS_PER_ROW = 3  # Gaussians for each row of the palette; chosen
_FEWEST_ROWS, _MOST_ROWS = 64, 1 << 16
_PALETTE = 64  # rows of SH side by side
_ADVICE = "export it again with splat-transform or SuperSplat"
_FILES = {"files": [str]}
_RANGE = {"mins": [float], "maxs": [float], **_FILES}
_BOOK = {"codebook": [float], **_FILES}
_VERSION_1 = {"means": {"shape": [int], **_RANGE}, "scales": _RANGE, "quats": _FILES, "sh0": _RANGE}
_VERSION_2 = {"count": int, "means": _RANGE, "scales": _BOOK, "quats": _FILES, "sh0": _BOOK}
_SH_1 = {"mins": float, "maxs": float, **_FILES}
_SH_2 = {"count": int, "bands": int, **_BOOK}


def load_sog(path: Path) -> Gaussians:
    """Gaussians of a SOG scene, version 1 or 2.

    Args:
        path: The archive, the folder, or the folder's meta.json.
    Raises:
        FileNotFoundError: If an image of a folder is missing.
        ValueError: If it is damaged or of another version, or a value is not finite (the first index is named).
    """
    if path.name == "meta.json":
        path = path.parent
    with Archive(path) as files:
        meta = parse_json(files.read("meta.json", _MAX_META_BYTES), f"{path}: meta.json", _ADVICE)
        version = meta.get("version", 1) if isinstance(meta, dict) else 1
        if version not in (1, 2):
            raise ValueError(f"{path}: SOG must be of version 1 or 2, got {repr(version)[:40]}; {_ADVICE}")
        return _Reader(path, files, meta, version).gaussians()


class _Reader:
    """One scene: its files, what meta.json says, and the bytes of its Gaussians."""

    def __init__(self, path: Path, files: Archive, meta: Any, version: int):
        self.path = path
        self.files = files
        self.meta = meta
        self.version = version
        check_json(f"{path}: meta.json", meta, _VERSION_2 if version == 2 else _VERSION_1, _ADVICE)
        self.has_sh = meta.get("shN") is not None
        if self.has_sh:
            check_json(f"{path}: meta.json: shN", meta["shN"], _SH_2 if version == 2 else _SH_1, _ADVICE)
        self.count = meta["count"] if version == 2 else (meta["means"]["shape"] or [0])[0]
        # WebP images have 2^28 pixels at most; no image is decoded before its own header is compared with the count.
        if not 0 < self.count <= 1 << 28:
            raise ValueError(f"{path}: meta.json: count must be in [1, 2^28], got {self.count}; {_ADVICE}")

    def gaussians(self) -> Gaussians:
        """The Gaussians of the scene."""
        low, high = (self._image("means", i) for i in (0, 1))  # first: they are as large as the count says
        degree = self._degree()
        check_count(self.path, self.count, SH_COUNTS[degree])
        # Two bytes make a whole number of 16 bits.
        code = low[:, :3].astype(np.float64) + 256.0 * high[:, :3]
        wide = self._lerped("means", code / 65535, 3)
        with np.errstate(over="ignore"):  # what float32 cannot hold is refused
            means = np.copysign(np.expm1(np.abs(wide)), wide)
        scales, base = self._image("scales"), self._image("sh0")
        if self.version == 2:
            log_scales = self._chosen("scales", scales[:, :3])
            dc = self._chosen("sh0", base[:, :3])
            logits = logits_of_bytes(base[:, 3])
        else:
            log_scales = self._lerped("scales", scales[:, :3] / 255.0, 3)
            lerped = self._lerped("sh0", base / 255.0, 4)
            dc = lerped[:, :3]
            logits = lerped[:, 3]
        sh = np.concatenate([dc[:, None, :].astype(np.float32), self._higher(degree)], axis=1)
        made = assembled(self.path, means, self._quats(), log_scales, logits, sh)
        if self.meta.get("antialias") is True:
            note_antialiased(self.path)
        asset = self.meta.get("asset")
        if not isinstance(asset, dict) or "offset" not in asset:
            return made
        return made.replace(origin=check_origin(f"{self.path}: meta.json: asset.offset", asset["offset"]))

    def _image(self, field: str, index: int = 0) -> np.ndarray:
        """(N, 4) bytes of an image with a pixel a Gaussian."""
        most = 4 * self.count + (1 << 16)  # rows are padded
        return self._pixels(field, index, self.count, most).reshape(-1, 4)[: self.count]

    def _pixels(self, field: str, index: int, least: int, most: int) -> np.ndarray:
        names = self.meta[field]["files"]
        if index >= len(names):
            raise ValueError(
                f"{self.path}: meta.json: {field} must name {index + 1} files, got {len(names)}; {_ADVICE}"
            )
        data = self.files.read(names[index], 8 * most + (1 << 16))
        return pixels_of_webp(f"{self.path}: {names[index]}", data, least, most)

    def _lerped(self, field: str, part: np.ndarray, width: int) -> np.ndarray:
        """Values at fractions of meta.json's ranges."""
        ends = [self.meta[field][name] for name in ("mins", "maxs")]
        if any(len(end) != width for end in ends):
            raise ValueError(f"{self.path}: meta.json: {field} must have {width} mins and maxs; {_ADVICE}")
        low, high = (np.asarray(end, np.float64) for end in ends)
        return low + (high - low) * part

    def _chosen(self, field: str, codes: np.ndarray) -> np.ndarray:
        """Values of a codebook."""
        book = np.asarray(self.meta[field]["codebook"], np.float64)
        largest = int(codes.max(initial=0))
        if largest >= len(book):
            raise ValueError(
                f"{self.path}: meta.json: {field}.codebook must have {largest + 1} entries, has {len(book)}; {_ADVICE}"
            )
        return book[codes]

    def _quats(self) -> np.ndarray:
        codes = self._image("quats")
        bad = codes[:, 3] < 252
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            raise ValueError(
                f"{self.path}: quats must name their largest component (252 to 255), got {int(codes[i, 3])} at index "
                f"{i} ({int(bad.sum())} of {self.count}); {_ADVICE}"
            )
        return quats_of_smallest(codes[:, 3].astype(int) - 252, (codes[:, :3] / 127.5 - 1.0) / 2**0.5)

    def _degree(self) -> int:
        """Degree of the SH; in version 1 by the width of the palette's image."""
        if not self.has_sh:
            return 0
        if self.version == 1:
            width = self._palette(1, 1 << 22).shape[1]
            found = [d for d in (1, 2, 3) if width == _PALETTE * (SH_COUNTS[d] - 1)]
        else:
            found = [d for d in (0, 1, 2, 3) if d == self.meta["shN"]["bands"]]
        if not found:
            raise ValueError(f"{self.path}: shN must have 1 to 3 bands, has another number or width; {_ADVICE}")
        return found[0]

    def _palette(self, least: int, most: int) -> np.ndarray:
        return self._pixels("shN", 0, least, most)

    def _higher(self, degree: int) -> np.ndarray:
        """(N, K - 1, 3) SH above degree 0."""
        each = SH_COUNTS[degree] - 1
        if each == 0:
            return np.zeros((self.count, 0, 3), np.float32)
        labels = self._image_of_labels()
        if self.version == 2:
            rows = self.meta["shN"]["count"]
            if not 0 < rows <= 1 << 16:
                raise ValueError(f"{self.path}: meta.json: shN.count must be in [1, 65536], got {rows}; {_ADVICE}")
            palette = self._palette(each * rows, _PALETTE * each * (-(-rows // _PALETTE) + _PALETTE))
        else:
            palette = self._palette(1, 1 << 22)
            rows = palette.shape[0] * _PALETTE
        if palette.shape[1] != _PALETTE * each:
            raise ValueError(
                f"{self.path}: the palette of shN must be {_PALETTE * each} wide, is {palette.shape[1]}; {_ADVICE}"
            )
        if (bad := labels >= rows).any():
            i = int(np.flatnonzero(bad)[0])
            raise ValueError(
                f"{self.path}: labels of shN must be below {rows}, got {int(labels[i])} at index {i} "
                f"({int(bad.sum())} of {self.count}); {_ADVICE}"
            )
        codes = palette[..., :3].reshape(-1, _PALETTE, each, 3).reshape(-1, each, 3)[:rows]
        if self.version == 2:
            values = self._chosen("shN", codes)
        else:
            low, high = self.meta["shN"]["mins"], self.meta["shN"]["maxs"]
            values = low + (high - low) * (codes / 255.0)
        return values.astype(np.float32)[labels]

    def _image_of_labels(self) -> np.ndarray:
        """(N,) 16-bit numbers of rows of the palette."""
        most = 4 * self.count + (1 << 16)
        codes = self._pixels("shN", 1, self.count, most).reshape(-1, 4)[: self.count].astype(np.int64)
        return codes[:, 0] + 256 * codes[:, 1]


def _is_sog(path: Path, head: bytes) -> bool:
    """Whether it is an archive with a meta.json, or the meta.json of a folder."""
    if head.startswith(b"PK\x03\x04"):
        known = path.suffix.lower() == ".sog" or "meta.json" in names_in_archive(path)
        return known and not is_checkpoint(path, head)
    return path.name == "meta.json" and b'"means"' in head


def encode_sog(g: Gaussians) -> bytes:
    """A SOG archive of version 2 of Gaussians in the axes of PLY files; their features are left out.

    Gaussians are in Morton order, in which images of neighbors pack best.

    Raises:
        ValueError: If there are more than 2^28 Gaussians, or none.
    """
    if not 0 < len(g) <= 1 << 28:
        raise ValueError(f"save_gaussians: .sog must hold 1 to 2^28 Gaussians, got {len(g)}; write a PLY")
    order = morton_order(g.means.numpy())
    width = 4 * -(-(math.isqrt(len(g) - 1) + 1) // 4)  # about square

    def image(*channels: np.ndarray) -> bytes:
        """A lossless WebP with a pixel a Gaussian, of bytes (N, C); alpha is 255 where there are three channels."""
        values = np.concatenate([x.reshape(len(g), -1) for x in channels], axis=1).astype(np.uint8)
        pixels = np.zeros((-(-len(g) // width) * width, 4), np.uint8)
        pixels[:, 3] = 255
        pixels[: len(g), : values.shape[1]] = values
        return webp_of_pixels(pixels.reshape(-1, width, 4))

    means = g.means.numpy().astype(np.float64)[order]
    wide = np.copysign(np.log1p(np.abs(means)), means)
    low, high = wide.min(0), wide.max(0)
    codes = np.rint((wide - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    log_scales = g.log_scales.numpy()[order]
    thin = log_scales < log_scales.max(1, keepdims=True) - _LOG_SCALE_RANGE
    if thin.any():
        _log.info("SOG: %d scales were below 1/3000 of the largest of their Gaussian and went there", int(thin.sum()))
    weights = _weights(g)[order]
    scale_book, scales = codebook(np.maximum(log_scales, log_scales.max(1, keepdims=True) - _LOG_SCALE_RANGE), weights)
    sh = g.sh.numpy()[order]
    color_book, colors = codebook(sh[:, 0], weights)
    # float64: a logit that was read from a byte must go back to that byte.
    opacities = np.rint(255 * g.logit_opacities.double().sigmoid().numpy()[order])
    files = {
        "means_l.webp": image(codes & 255),
        "means_u.webp": image(codes >> 8),
        "scales.webp": image(scales),
        "quats.webp": image(_bytes_of_quats(g.quats.numpy().astype(np.float64)[order])),
        "sh0.webp": image(colors, opacities),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "drgs"} | ({"offset": g.origin.tolist()} if g.origin.any() else {}),
        "count": len(g),
        "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    if g.sh_degree:
        count, book, centroids, labels = _higher_sh(sh[:, 1:], weights)
        files["shN_centroids.webp"] = centroids
        files["shN_labels.webp"] = image(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1))
        meta["shN"] = {
            "count": count,
            "bands": g.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # without a time: same Gaussians, same bytes
    return packed.getvalue()


def _higher_sh(sh: np.ndarray, weights: np.ndarray) -> tuple[int, np.ndarray, bytes, np.ndarray]:
    """A palette of (N, C, 3) coefficients above degree 0: its length, codebook and image, and (N,) rows of it."""
    n, each, _ = sh.shape
    rows, labels = palette(sh.reshape(n, -1), weights, min(_MOST_ROWS, max(_FEWEST_ROWS, n // _GAUSSIANS_PER_ROW)))
    book, entries = codebook(rows)
    pixels = np.full((-(-len(rows) // _PALETTE) * _PALETTE, each, 4), 255, np.uint8)
    pixels[..., :3] = 0
    pixels[: len(rows), :, :3] = entries.reshape(-1, each, 3)
    return len(rows), book, webp_of_pixels(pixels.reshape(-1, _PALETTE * each, 4)), labels


def _weights(g: Gaussians) -> np.ndarray:
    """(N,) how much errors of each Gaussian count: the root of its opacity times the area that it covers.

    Between the thousandth part and a thousand times the median, so that none is given up.
    """
    area = np.sort(g.log_scales.numpy().astype(np.float64), axis=1)[:, 1:].sum(1)
    opacities = g.logit_opacities.double().sigmoid().numpy()
    shown = area + np.log(np.maximum(opacities, np.finfo(np.float64).tiny))
    return np.exp(0.5 * np.clip(shown - np.median(shown), -np.log(1e3), np.log(1e3)))


def _bytes_of_quats(quats: np.ndarray) -> np.ndarray:
    """(N, 4) bytes that `_Reader._quats` reads: the three smaller components, and the place of the largest."""
    largest, others = smallest_of_quats(quats)
    codes = np.clip(np.rint((others * 2**0.5 + 1) * 127.5), 0, 255)
    return np.concatenate([codes, 252 + largest[:, None]], axis=1)


SOG = Codec(".sog", load_sog, _is_sog, encode=encode_sog, keeps_origin=True)
