"""Structure from motion: which pairs of photographs are matched, and COLMAP's own pipeline on the same photographs.

    python benchmarks/sfm.py [--scenes banana bonsai] [--seeds 1] [--page]

Appends one row a scene, method and seed to benchmarks/sfm.jsonl as it ends, leaves out what is there, then writes
docs/data/datasets-sfm.csv, which docs/datasets.md links to. `drgs` finds features as `drgs sfm` does (affine shapes,
pooled scales), once, and matches all pairs, the next ones by name, or the nearest by appearance; `COLMAP` is pycolmap's
extract_features, match_exhaustive and incremental_mapping with its own options, but for one thread and the same size of
photographs: with the cameras that it makes by default, and with one that all photographs share, as drgs does. Camera
centers are compared with those of the model beside the photographs. Seconds are those that the process computed, with
one thread. The seed is that of pairs, verification and mapping; COLMAP runs once, with its own.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import pycolmap  # noqa: E402
from studies import write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.data.images import list_images  # noqa: E402
from drgs.sfm import matching  # noqa: E402
from drgs.sfm.mapping import MappingProgress, map_photos  # noqa: E402
from drgs.sfm.matching import FeatureOptions, extract, match, quiet  # noqa: E402
from drgs.sfm.pairing import choose_pairs  # noqa: E402

ROWS = ROOT / "benchmarks" / "sfm.jsonl"
TABLE = ROOT / "docs" / "data" / "datasets-sfm.csv"
SCENES = {"banana": (16, 752), "bonsai": (110, 320)}
"""Name of a capture -> how many of its photographs, evenly spaced, and the pixels of their longer side."""
MATCHED = ("exhaustive", "retrieval", "sequential")
OWN = {"COLMAP": pycolmap.CameraMode.AUTO, "COLMAP, one camera": pycolmap.CameraMode.SINGLE}
FEW = 30


class Seconds(dict):
    """Stage -> seconds that the process computed, and those beside it that have ended."""

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Time what is done inside."""
        began = sum(os.times()[:4])
        yield
        self[stage] = sum(os.times()[:4]) - began


def photographs(scene: str) -> list[str]:
    """Names of the photographs of a scene."""
    names = [path.name for path in list_images(DATA / scene / "images")]
    count = min(SCENES[scene][0], len(names))
    return [names[round(i)] for i in np.linspace(0, len(names) - 1, count)]


def own_features(scene: str, names: list[str], database: Path) -> Seconds:
    """Features as `drgs sfm` finds them."""
    seconds = Seconds()
    with seconds.of("features"):
        extract(
            database,
            DATA / scene / "images",
            names,
            FeatureOptions(is_shared=True, max_image_size=SCENES[scene][1]),
            said(scene),
        )
        matching._extractor.end()
    return seconds


def by_drgs(scene: str, names: list[str], database: Path, matching: str, seed: int) -> tuple[Seconds, int, object]:
    """Matching and mapping as `drgs sfm` does: seconds, pairs and the model."""
    seconds = Seconds()
    with seconds.of("matching"):
        pairs = choose_pairs(database, names, matching, False, seed).pairs
        match(database, pairs, seed=seed, progress=said(scene))
    with seconds.of("mapping"):
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = seed
        folder = database.parent / "models"
        folder.mkdir()
        progress = MappingProgress(len(names), said(scene), lambda text: None)
        models = map_photos(database, DATA / scene / "images", folder, options, progress)
    return seconds, len(pairs), largest(models)


def by_colmap(scene: str, names: list[str], database: Path, mode: object) -> tuple[Seconds, int, object]:
    """COLMAP's own pipeline: seconds, pairs and the model."""
    seconds = Seconds()
    images = DATA / scene / "images"
    with seconds.of("features"):
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = 1
        options.max_image_size = SCENES[scene][1]
        cpu = pycolmap.Device.cpu
        pycolmap.extract_features(
            database, images, image_names=names, camera_mode=mode, extraction_options=options, device=cpu
        )
    with seconds.of("matching"):
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads = 1
        pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
    with seconds.of("mapping"):
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.num_threads = pipeline.mapper.num_threads = 1
        folder = database.parent / "models"
        folder.mkdir()
        models = pycolmap.incremental_mapping(database, images, folder, options=pipeline)
    return seconds, len(names) * (len(names) - 1) // 2, largest(models)


def said(scene: str) -> Callable[[str, int, int], None]:
    """Progress of a stage, on one line."""
    return lambda stage, done, total: print(f"\r{scene}: {stage} {done} of {total}  ", end="", flush=True)


def largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction:
    """The model with the most photographs."""
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))


def centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Camera center of each photograph that has a pose."""
    return {model.images[i].name: model.images[i].projection_center() for i in model.reg_image_ids()}


def off(model: pycolmap.Reconstruction, scene: str) -> float:
    """Median distance of camera centers from those of the model beside the photographs, after the best similarity, over
    the root mean square of their distances from the middle.
    """
    found, true = centers(model), centers(pycolmap.Reconstruction(str(DATA / scene / "sparse" / "0")))
    names = sorted(found.keys() & true.keys())
    a, b = (np.array([where[name] for name in names]) for where in (found, true))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    errors = np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1)
    return float(np.median(errors) / np.sqrt((b**2).sum(axis=1).mean()))


def row(scene: str, names: list[str], method: str, seed: int, seconds: Seconds, pairs: int, model: object) -> dict:
    """What a method found."""
    return {
        "scene": scene,
        "method": method,
        "seed": seed,
        "photographs": len(names),
        "longer_side": SCENES[scene][1],
        "seconds": {stage: round(value, 1) for stage, value in seconds.items()},
        "pairs": pairs,
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "reprojection_error": model.compute_mean_reprojection_error(),
        "off": off(model, scene),
        **ran(),
    }


def measure(scene: str, seeds: int) -> None:
    """All methods and seeds of a scene that have no row yet."""
    names = photographs(scene)
    done = {(found["method"], found["seed"]) for found in read_rows(ROWS) if found["scene"] == scene}
    with tempfile.TemporaryDirectory() as temporary, quiet():
        features = Path(temporary) / "features.db"
        seconds = Seconds()
        cells = [(method, seed) for seed in range(seeds) for method in MATCHED] + [(method, 0) for method in OWN]
        for method, seed in cells:
            # Of few photographs all are among the nearest.
            if (method, seed) in done or (method == "retrieval" and len(names) < FEW):
                continue
            folder = Path(temporary) / f"{method}_{seed}"
            folder.mkdir()
            if method in OWN:
                found = by_colmap(scene, names, folder / "database.db", OWN[method])
            else:
                if not features.exists():
                    seconds = own_features(scene, names, features)
                shutil.copyfile(features, folder / "database.db")
                found = by_drgs(scene, names, folder / "database.db", method, seed)
                found[0].update(seconds)
            add_row(ROWS, row(scene, names, method, seed, *found))
            print(f"\r{scene}: {read_rows(ROWS)[-1]}", flush=True)


def table(found: list[dict]) -> list[list[str]]:
    """A row a scene and method: means of seconds and pairs over the seeds, and the rest of each."""
    lines = [
        ["photographs", "method", "pairs", "features, matching, mapping (s)"]
        + ["with a pose", "points", "reprojection (px)", "centers off"]
    ]
    for scene, method in [(scene, method) for scene in SCENES for method in (*MATCHED, *OWN)]:
        mine = sorted(
            (one for one in found if (one["scene"], one["method"]) == (scene, method)), key=lambda one: one["seed"]
        )
        if not mine:
            continue
        stages = ", ".join(
            f"{statistics.mean(one['seconds'][stage] for one in mine):.0f}"
            for stage in ("features", "matching", "mapping")
        )
        columns = [
            f"`{scene}`, {mine[0]['photographs']} at {mine[0]['longer_side']}",
            method if method in OWN else f"drgs, {method}",
            f"{statistics.mean(one['pairs'] for one in mine):,.0f}",
            stages,
            " / ".join(f"{one['registered']}" for one in mine),
            " / ".join(f"{one['points']:,}" for one in mine),
            " / ".join(f"{one['reprojection_error']:.2f}" for one in mine),
            " / ".join(f"{one['off']:.2%}" for one in mine),
        ]
        lines.append(columns)
    return lines


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES), help="names of captures")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of what drgs does")
    parser.add_argument(
        "--page", action="store_true", help="run nothing, write the data file of the rows that there are"
    )
    args = parser.parse_args()
    for scene in [] if args.page else args.scenes:
        measure(scene, args.seeds)
    write_csv(TABLE, table(read_rows(ROWS)))


if __name__ == "__main__":
    main()
