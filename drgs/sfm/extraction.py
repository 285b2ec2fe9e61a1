"""SIFT features with COLMAP, in a process of its own (reader_process.py): the detector crashes over some photos."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

from drgs.data.colmap_bindings import pycolmap
from drgs.data.reader_process import serve

_MASKED_CONTRAST = 0.002  # a third of COLMAP's: an object alone has few features, and weak ones match as well
# of which COLMAP's own handlers print a stack on stderr
_CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)


def extract_features(path: Path, names: list[str], options: dict[str, Any], report: Any) -> int | None:
    """SIFT features of some images into a COLMAP database.

    Args:
        path: The images, as messages name them; not read.
        names: Names of the images in their folder.
        options: `database`, `folder` and `threads` of `drgs.sfm.matching.extract`, and its `FeatureOptions`.
    Returns:
        Number of the camera that the images share; None where each has one of its own.
    """
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = options["threads"]
    if options["max_image_size"]:
        extraction.max_image_size = options["max_image_size"]
    extraction.sift.estimate_affine_shape = True
    extraction.sift.domain_size_pooling = True
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = options["camera_model"]
    if options["masks"] is not None:
        reader.mask_path = options["masks"]
        extraction.sift.peak_threshold = _MASKED_CONTRAST
    if options["camera"] is not None:
        reader.existing_camera_id = options["camera"]
    is_shared = options["is_shared"]
    pycolmap.extract_features(
        options["database"],
        options["folder"],
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE if is_shared else pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    if not is_shared or options["camera"] is not None:
        return options["camera"]
    with pycolmap.Database.open(options["database"]) as handle:  # the one that this call made is the newest
        return max(found.camera_id for found in handle.read_all_cameras())


def ready(path: Path, report: Any) -> bool:
    """That the process has started."""
    return True


if __name__ == "__main__":
    pycolmap.logging.minloglevel = 3  # errors included: they arrive as exceptions
    for crash in _CRASHES:
        signal.signal(crash, signal.SIG_DFL)
    serve({"extract_features": extract_features, "ready": ready})
