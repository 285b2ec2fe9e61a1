"""Make and write the page of a scene."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import zipfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.codecs.bounded import pixels_of_webp
from drgs.codecs.clustering import morton_order
from drgs.codecs.sog import encode_sog
from drgs.data.camera_layout import middle_camera
from drgs.display.progress import Bar
from drgs.io.outputs import write_whole
from drgs.pages.sharing.layers import GaussianScale, motion_layer, scale_layer
from drgs.pages.sharing.npm import viewer_files
from drgs.pages.sharing.page import scene_html
from drgs.pages.sharing.placing import PhotoKind, columns, photo, upright_matrix

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.deform import DynamicGaussians
    from drgs.ellipsoids import Gaussians

_NEAR_SHARE = 2e-3  # near plane over the distance to what is looked at: about gsplat's 0.01 in the units of COLMAP
_FAR_FACTOR = 10.0  # far plane over the distance of the farthest Gaussian: a reader may step back as far; chosen


@dataclasses.dataclass(frozen=True, eq=False)
class Shared:
    """Contents of a page.

    Attributes:
        title: Name of the scene.
        lines: Sentences about it.
        gaussians: Gaussians, at least one; of a scene that moves, as they are at the first of `times`.
        cameras: Cameras with what they are of; at least one, pinholes.
        target: (3,) point of the world that the first camera looks at.
        up: (3,) direction of the world that is up, of length 1.
        background: RGB in [0, 1].
        scale: How wrong each Gaussian is expected to be, or how uncertain; None: no such layer.
        classes: Names and colors of classes, and the class of each Gaussian (`layers.classes_layer`); None: none.
        moving: The Gaussians and what moves them; None where nothing does.
        times: Times at which it is written, ascending.
    """

    title: str
    lines: Sequence[str]
    gaussians: Gaussians
    cameras: Sequence[tuple[PhotoKind, Camera]]
    target: np.ndarray
    up: np.ndarray
    background: tuple[float, float, float]
    scale: GaussianScale | None = None
    classes: tuple[dict[str, Any], np.ndarray] | None = None
    moving: DynamicGaussians | None = None
    times: Sequence[float] = ()


def write_page(shared: Shared, path: str | os.PathLike) -> dict[str, int]:
    """Write the page, atomically.

    Args:
        shared: What it shows.
        path: HTML file to write.
    Returns:
        Bytes of its parts, as they are in the page: `gaussians`, each layer's, `viewer` with the viewer's code and
        ours.
    Raises:
        OSError: If the viewer's code is not there and cannot be fetched, or the file not be written.
    """
    viewer = viewer_files()  # first: without it there is no page
    # The archive is in this order already, and what else is known of each Gaussian goes into it, too.
    order = morton_order(shared.gaussians.means.numpy())
    origin = np.array(shared.gaussians.origin, np.float64)
    with Bar("packing"):
        archive, harmonics = archive_of(shared.gaussians)
    first = [camera for _, camera in shared.cameras]
    fitted = [camera for kind, camera in shared.cameras if kind == "fitted"] or first
    begin = middle_camera(fitted)
    distances = np.linalg.norm(shared.gaussians.means.numpy() + origin - begin.center, axis=1)
    reach = float(np.linalg.norm(shared.target - begin.center))
    scene: dict[str, Any] = {
        "background": list(shared.background),
        "near": _NEAR_SHARE * reach,
        "far": _FAR_FACTOR * max(float(distances.max()), reach),
        "reach": reach,
        "offset": origin.tolist(),  # what positions are relative to
        "target": (shared.target - origin).tolist(),
        "upright": columns(upright_matrix(shared.up)),
        "photos": [photo(camera, kind, origin) for kind, camera in shared.cameras],
        "first": next(i for i, camera in enumerate(first) if camera is begin),
        "harmonics": harmonics,
    }
    parts = {"gaussians": archive}
    if shared.scale is not None:
        scene["scale"], parts["scale"] = scale_layer(shared.scale, order)
    if shared.classes is not None:
        scene["classes"], labels = shared.classes
        parts["classes"] = labels[order].astype("<u2").tobytes()
    if shared.moving is not None:
        scene["moments"], parts["moving"], parts["moments"], parts["lives"] = motion_layer(
            shared.moving, shared.times, shared.gaussians, order
        )
    page, sizes = scene_html(shared.title, shared.lines, scene, parts, viewer)
    write_whole(path, page.encode())
    return sizes


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
