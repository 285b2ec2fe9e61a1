"""Valid files of Gaussians in the formats of other programs, a few points large, which the fuzzers damage
(benchmarks/fuzz.py); the tests of the codecs make them by the same functions (tests/splat_samples.py).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

import splat_encoders as encode  # noqa: E402
from splat_samples import sog_scene, write_sample  # noqa: E402

__all__ = ["GLB", "KSPLAT", "MODEL", "PACKED_PLY", "SOG", "SOG_FOLDER", "SPLAT", "SPZ"]

Seed = Callable[[Path], None]


def _sample(name: str) -> Seed:
    """A file of tests/splat_samples.py."""

    def write(folder: Path) -> None:
        write_sample(folder / name, name, np.random.default_rng(1))

    return write


def _saved(name: str) -> Seed:
    """A file as drgs writes it."""

    def write(folder: Path) -> None:
        from fuzz_seeds import gaussians

        from drgs.codecs import save_gaussians

        save_gaussians(gaussians(degree=2), folder / name)

    return write


def _sog(version: int, bundled: bool) -> Seed:
    def write(folder: Path) -> None:
        meta, images, _ = sog_scene(np.random.default_rng(1), version=version, degree=version)
        files = encode.sog_files(meta, images)
        if bundled:
            (folder / "a.sog").write_bytes(encode.zipped(files, "" if version == 2 else "a/"))
            return
        for name, data in files.items():
            (folder / name).write_bytes(data)

    return write


def _model(folder: Path) -> None:
    """A model folder of INRIA's, of two iterations."""
    from fuzz_seeds import gaussians

    from drgs.files import save_ply

    for iteration in (7000, 30000):
        file = folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        file.parent.mkdir(parents=True)
        save_ply(gaussians(degree=1), file)


SPZ = (_sample("v2.spz"), _sample("v3.spz"), _sample("v4.spz"), _sample("raw.spz"), _saved("a.spz"))
SPLAT = (_sample("a.splat"),)
KSPLAT = (_sample("0.ksplat"), _sample("1.ksplat"), _sample("2.ksplat"))
PACKED_PLY = (_sample("packed.ply"),)
SOG = (_sog(1, True), _sog(2, True), _sample("a.sog"))
SOG_FOLDER = (_sog(1, False), _sog(2, False))
GLB = (_sample("a.glb"), _saved("a.glb"))
MODEL = (_model,)
