"""Surfaces of made scenes against the true ones: how far off, and how much of them is there.

    python benchmarks/mesh.py [--page]

Fits Gaussians to photographs of a still life, from points that are matched between photographs (what the scene's files
know of depth is kept from the fit), makes meshes of them in several ways, and compares each with the triangles that the
photographs were traced from. Appends a row a mesh to benchmarks/mesh.jsonl as it ends, leaves out what is there, then
writes the paragraph of docs/mesh.md. One thread, one seed.

Accuracy is the distance of points on the mesh, evenly over its area, to the nearest point of the true surface;
completeness that of points of the true surface, which at least two of the photographs show, to the mesh. Both surfaces
are sampled densely and compared by nearest points, whose spacing is what a distance cannot fall below. Distances above
`FAR` count as that. Of the still life, the table top and what stands on it count; `anywhere` is the accuracy of the
whole mesh, with the room around it, whose walls are in the background of photographs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
from fits import Fit, fitted  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.meshing.depths import depth_views  # noqa: E402
from drgs.meshing.extraction import TriangleMesh, deviations_of, mesh_of_depths  # noqa: E402
from drgs.meshing.options import MeshOptions  # noqa: E402
from drgs.scenes import still_life  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "mesh.jsonl"
PAGE = ROOT / "docs" / "mesh.md"
SIZE = {"max_pixels": 20_000, "max_gaussians": 10_000, "test_every": 0}
SCENE = "still_life"
PHOTOGRAPHS = 28
STEPS = (800, 300)
FAR = 0.05  # meters
NEAR = 0.005  # meters
SPACING = 0.0012  # meters
WAYS: dict[str, dict] = {
    "default": {"crop": MeshOptions.crop},
    "no crop": {},
    "expected depth": {"depth": "expected"},
    "trunc 2": {"trunc": 2.0},
    "trunc 8": {"trunc": 8.0},
    "voxel / 2": {"voxels": 0.5},
    "voxel x 2": {"voxels": 2.0},
    "crop 0.5": {"crop": 0.5},
    "crop 2": {"crop": 2.0},
}
"""Name -> what is done in another way than by default; but for the first, nothing is cut that is uncertain. The row of
another way is of code that changed nothing and was not kept.
"""


# ------------------------------------------------------------------------------------------ scenes


def data_in(folder: Path) -> Path:
    """The still life without its depth; it is made where it is not there."""
    made, out = folder / SCENE, folder / f"{SCENE}-{PHOTOGRAPHS}"
    still_life.generate(made, views=PHOTOGRAPHS, width=240, height=180)
    out.mkdir(exist_ok=True)
    cameras = json.loads((made / "transforms.json").read_text())
    plain = [{key: x for key, x in frame.items() if key != "depth_file_path"} for frame in cameras["frames"]]
    (out / "transforms.json").write_text(json.dumps({**cameras, "frames": plain}))
    if not (out / "images").exists():
        (out / "images").symlink_to(made / "images")
    return out


def true_triangles() -> np.ndarray:
    """(F, 3, 3) corners of the true surface, in meters."""
    rng = np.random.default_rng(0)
    parts = [*still_life._room(rng), *still_life.objects(rng)]  # in the order in which the scene draws its numbers
    return np.concatenate([np.asarray(mesh[0])[np.asarray(mesh[1])] for _, mesh, *_ in parts]).astype(np.float64)


def in_region(points: np.ndarray) -> np.ndarray:
    """Which points are of what is looked at: table top and what stands on it."""
    return (np.hypot(points[:, 0], points[:, 1]) < 0.6) & (points[:, 2] > -0.02) & (points[:, 2] < 0.7)


def sampled(corners: np.ndarray, spacing: float, seed: int = 0) -> np.ndarray:
    """(P, 3) points on triangles, evenly over their area, about `spacing` apart."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rng = np.random.default_rng(seed)
    count = int(min(area.sum() / spacing**2, 6e6))
    which = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    return a[which] + u * (b - a)[which] + v * (c - a)[which]


class Truth:
    """The true surface of a scene, as the cameras of a fit see it."""

    def __init__(self, fit: Fit):
        from scipy.spatial import cKDTree

        corners = true_triangles()
        self.all = cKDTree(sampled(corners, SPACING))
        keep = in_region(corners.mean(1)) | (np.abs(corners[..., 2]) < 0.02).all(1)  # the table's reach out of it
        points = sampled(corners[keep], SPACING)
        points = points[in_region(points)]
        self.tree = cKDTree(points)
        few = points[np.random.default_rng(1).permutation(len(points))[:60_000]]
        self.visible = few[self._seen(corners, few, fit) >= 2]

    @staticmethod
    def _seen(corners: np.ndarray, points: np.ndarray, fit: Fit) -> np.ndarray:
        """How many photographs show each point: it is in the image and nothing is in front of it."""
        from drgs import runtime

        mi = runtime.mitsuba()
        mesh = mi.Mesh("truth", 3 * len(corners), len(corners))
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(corners.astype(np.float32).ravel())
        params["faces"] = mi.UInt32(np.arange(3 * len(corners), dtype=np.uint32))
        params.update()
        built = mi.load_dict({"type": "scene", "truth": mesh})
        count = np.zeros(len(points), int)
        for frame in fit.frames:
            camera = frame.camera
            pixels, z = camera.project(points)
            inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
            way = points - camera.center
            ray = mi.Ray3f(
                mi.Point3f(*[float(x) for x in camera.center]),
                mi.Vector3f(*[mi.Float(np.ascontiguousarray(way[:, k], np.float32)) for k in range(3)]),
            )
            t = built.ray_intersect_preliminary(ray, coherent=False).t.numpy()  # 1 at the point itself
            count += inside & (t > 1 - 2e-3)
        return count

    def compare(self, mesh: TriangleMesh) -> dict[str, float]:
        """Accuracy and completeness in millimeters, and shares of what is near enough."""
        from scipy.spatial import cKDTree

        points = sampled(mesh.vertices[mesh.faces], SPACING, 2)
        own = cKDTree(points)
        anywhere = points[np.random.default_rng(4).permutation(len(points))[:60_000]]
        inside = points[in_region(points)]
        inside = inside[np.random.default_rng(3).permutation(len(inside))[:60_000]]
        off = np.minimum(self.tree.query(inside)[0], FAR)
        missing = np.minimum(own.query(self.visible)[0], FAR)
        precision, recall = float((off < NEAR).mean()), float((missing < NEAR).mean())
        return {
            "accuracy_mm": 1e3 * float(off.mean()),
            "completeness_mm": 1e3 * float(missing.mean()),
            "anywhere_mm": 1e3 * float(np.minimum(self.all.query(anywhere)[0], FAR).mean()),
            "precision": precision,
            "recall": recall,
            "f": 2 * precision * recall / max(precision + recall, 1e-9),
        }


# ----------------------------------------------------------------------------------------- meshes


class Views:
    """Depth images of a fit, each kind rendered once."""

    def __init__(self, fit: Fit):
        self.fit = fit
        self.cameras = [frame.camera for frame in fit.frames]
        self.known: dict = {}
        self.deviations = deviations_of(fit.gaussians, self.cameras, RenderSettings.preset("fast"))

    def of(self, depth: str) -> list:
        """The depth images of a kind."""
        if depth not in self.known:
            settings = RenderSettings.preset("exact")
            self.known[depth] = depth_views(self.fit.gaussians, self.cameras, settings, depth, self.deviations)
        return self.known[depth]


def mesh_in(way: dict, views: Views) -> tuple[TriangleMesh, float]:
    """The mesh that is made in a way, and the processor seconds that fusion took."""
    from drgs.meshing import extraction
    from drgs.meshing.depths import footprint

    way = dict(way)
    voxels = way.pop("voxels", 1.0)
    shown = views.of(way.get("depth", MeshOptions.depth))
    options = MeshOptions(**{"crop": 0.0, **way})
    if voxels != 1.0:
        options = options.replace(voxel=voxels * footprint(shown) * extraction.FINENESS)
    began = time.process_time()
    mesh = mesh_of_depths(shown, options)
    return mesh, time.process_time() - began


def measure(steps: int, ways: list[str], folder: Path) -> None:
    """Rows of one fit."""
    key = {"scene": SCENE, "photographs": PHOTOGRAPHS, "steps": steps}
    there = {row["way"] for row in read_rows(ROWS) if all(row[name] == x for name, x in key.items())}
    ways = [way for way in ways if way not in there]
    if not ways:
        return
    fit = fitted(str(data_in(folder)), FitConfig().replace(max_steps=steps, **SIZE))
    truth = Truth(fit)
    views = Views(fit)
    for way in ways:
        mesh, seconds = mesh_in(WAYS[way], views)
        found = truth.compare(mesh)
        row = {**key, "way": way, "voxel_mm": 1e3 * mesh.voxel, "triangles": len(mesh.faces), "seconds": seconds}
        add_row(ROWS, {**row, **found, "fit_seconds": fit.seconds, **ran()})
        print(
            json.dumps({name: round(x, 4) if isinstance(x, float) else x for name, x in (row | found).items()}),
            flush=True,
        )


# ------------------------------------------------------------------------------------------- page


def in_order(rows: list[dict]) -> list[dict]:
    """As `STEPS` and `WAYS` have them, other ways last."""
    ways = [*WAYS]
    rank = lambda way: ways.index(way) if way in WAYS else len(ways)  # noqa: E731
    return sorted(rows, key=lambda row: (STEPS.index(row["steps"]), rank(row["way"])))


def summary(rows: list[dict]) -> str:
    """What docs/mesh.md says, of the longer fit."""
    found = {row["way"]: row for row in rows if row["steps"] == max(STEPS)}
    told = {
        way: f"{row['accuracy_mm']:.1f} and {row['completeness_mm']:.1f} mm, {row['seconds']:.0f} s"
        for way, row in found.items()
    }
    removed = 1 - found["default"]["triangles"] / found["no crop"]["triangles"]
    default = found["default"]
    return paragraph(
        f"By default, with voxels of {default['voxel_mm']:.1f} mm, accuracy and completeness are {told['default']}; "
        f"with half the voxel {told['voxel / 2']}; with `--crop 0.5` {told['crop 0.5']}; with `--depth expected` "
        f"{told['expected depth']}. The default crop worsens no distance (on the table, all that is measured here) and "
        f"removes {100 * removed:.0f} % of the triangles ([all rows](data/mesh.csv); `python "
        f"benchmarks/mesh.py`, {default['machine']}, {default['date']}, one seed, processor time without rendering)."
    )


def sheet(rows: list[dict]) -> list[list[str]]:
    """The data file: every row."""
    names = (
        "voxel_mm",
        "triangles",
        "accuracy_mm",
        "anywhere_mm",
        "completeness_mm",
        "precision",
        "recall",
        "f",
        "seconds",
    )
    lines = [["scene", "photographs", "steps", "way", *names]]
    for row in in_order(rows):
        cells = [
            "" if name not in row else f"{row[name]:.4g}" if name != "triangles" else str(row[name]) for name in names
        ]
        lines.append([row["scene"], str(row["photographs"]), str(row["steps"]), row["way"], *cells])
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ways", nargs="*", default=list(WAYS))
    parser.add_argument("--folder", type=Path, default=Path("out/mesh"), help="where made scenes are put")
    parser.add_argument("--page", action="store_true", help="only write the page")
    args = parser.parse_args()
    if not args.page:
        args.folder.mkdir(parents=True, exist_ok=True)
        for steps in STEPS:
            measure(steps, args.ways, args.folder.resolve())
    rows = read_rows(ROWS)
    fill_between(PAGE, "rows", summary(rows))
    write_csv(PAGE_DATA / "mesh.csv", sheet(rows))


if __name__ == "__main__":
    main()
