"""The Gaussians of a page: an archive of SOG, and where in it a page finds the spherical harmonics."""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np

from drgs.codecs.bounded import pixels_of_webp
from drgs.codecs.sog import encode_sog
from drgs.ellipsoids import Gaussians


def archive_of(g: Gaussians) -> tuple[bytes, dict[str, Any] | None]:
    """The archive, and where in it spherical harmonics are; None where there are none.

    Spark reads the archive, but cuts SH off: `gaussians.js` reads them again, from the bytes that are named here.

    Args:
        g: Gaussians, at least one.
    """
    data = encode_sog(g)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        harmonics = json.loads(archive.read("meta.json")).get("shN")
        if harmonics is None:
            return data, None
        spans, sums = [], []
        for name in harmonics["files"]:
            content = archive.read(name)
            start = data.index(content, archive.getinfo(name).header_offset)
            spans.append([start, start + len(content)])
            sums.append(_checksum(content))
    each = (harmonics["bands"] + 1) ** 2 - 1
    known = {"each": each, "rows": harmonics["count"], "codebook": harmonics["codebook"]}
    return data, {**known, "centroids": spans[0], "labels": spans[1], "sums": sums}


def _checksum(webp: bytes) -> int:
    """Checksum of a picture, by which a page finds out whether its browser decodes pictures unchanged."""
    values = pixels_of_webp("share", webp, 1, 1 << 28).reshape(-1).astype(np.uint64)
    weights = (np.arange(len(values), dtype=np.uint64) & 255) + 1
    return int((values * weights).sum() % (1 << 32))
