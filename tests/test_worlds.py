"""One capture in several worlds, end to end: in millimeters, in kilometers, and at UTM coordinates it is what it is.

Fit, choice of views, page, files of six formats, mesh and planner: what they say of a world scaled by s and moved by z
is what they say of the capture itself, lengths times s and places moved, too.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from test_meshing import shell
from test_share import told, viewer  # noqa: F401 (a fixture)

import drgs
from drgs import cli
from drgs.cameras import Camera, orbit
from drgs.codecs import load_gaussians
from drgs.data import load
from drgs.data.camera_lists import save_cameras_json
from drgs.data.camera_path import quaternion_of
from drgs.display.pictures import write_png
from drgs.ellipsoids import Gaussians
from drgs.planner import Planner, default_config

SIZE = 40
UTM = np.array([500_000.0, 5_400_000.0, 120.0])
STEPS = {".ply": 1e-6, ".splat": 1e-6, ".spz": 2**-12, ".compressed.ply": 1e-3, ".sog": 1e-3, ".glb": 1e-6}
"""Suffix -> error of a position that the format may make, in units of the capture."""


class World(NamedTuple):
    """Each point x of the capture is at scale x + zero."""

    scale: float = 1.0
    zero: np.ndarray = np.zeros(3)

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees what this one sees of the capture."""
        w2c = camera.w2c.copy()
        w2c[:3, 3] = self.scale * w2c[:3, 3] - w2c[:3, :3] @ self.zero
        return dataclasses.replace(camera, w2c=w2c)

    def back(self, places: np.ndarray) -> np.ndarray:
        """Places of this world in the capture's."""
        return (np.asarray(places) - self.zero) / self.scale


WORLDS = {"mm": World(1e3), "utm": World(1.0, UTM), "km": World(1e-3), "utm-mm": World(1e3, 1e3 * UTM)}


def write_colmap(folder: Path, world: World, g: Gaussians, cameras: list[Camera]) -> None:
    """Photographs of Gaussians, and the world that structure from motion has found."""
    (folder / "images").mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    K = cameras[0].K
    (folder / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {SIZE} {SIZE} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    lines = []
    for i, camera in enumerate(cameras, 1):
        write_png(folder / f"images/{camera.name}.png", drgs.render(g, camera).rgb.numpy())
        there = world.camera(camera).w2c
        pose = [*quaternion_of(there[:3, :3]), *there[:3, 3]]
        lines += [f"{i} {' '.join(repr(float(x)) for x in pose)} 1 {camera.name}.png", ""]
    (folder / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    rng = np.random.default_rng(0)
    points = world.scale * (g.means.double().numpy() + 0.02 * rng.standard_normal((len(g), 3))) + world.zero
    rows = (f"{i} {' '.join(repr(float(x)) for x in point)} 128 128 128 0.5" for i, point in enumerate(points, 1))
    (folder / "sparse/0/points3D.txt").write_text("\n".join(rows) + "\n")


class Made(NamedTuple):
    """A world with the fit to it."""

    folder: Path
    world: World
    psnr: dict[str, float]

    def gaussians(self) -> Gaussians:
        """Those of the fit."""
        return load_gaussians(self.folder / "run/point_cloud.ply")

    def selected(self) -> dict:
        """What `drgs select` says of eight further cameras, k = 2."""
        cameras = orbit((0, 0, 0), 3.2, 8, 55.0, width=SIZE, height=SIZE)
        save_cameras_json(self.folder / "cameras.json", [self.world.camera(camera) for camera in cameras])
        words = [str(self.folder / x) for x in ("run", "cameras.json", "select.json")]
        line = ["select", words[0], "--candidates", words[1], "-o", words[2], "-k", "2", "--quiet", "--preset", "fast"]
        assert cli.main(line) == 0
        return json.loads((self.folder / "select.json").read_text())


def fitted(data: Path, folder: Path, world: World, *words: str) -> Made:
    """A short deterministic fit by the command."""
    line = ["fit", str(data), "-o", str(folder / "run"), "--for", "drgs", "--deterministic", "--no-report", "--quiet"]
    assert cli.main([*line, *words]) == 0
    rows = json.loads((folder / "run/metrics.json").read_text())["renderers"]["rows"]
    return Made(folder, world, {row["name"]: row["mean"]["psnr"] for row in rows})


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Makes the fit of a world, once each."""
    g = shell(250)
    rings = [
        *orbit((0, 0, 0), 3.0, 7, 15.0, width=SIZE, height=SIZE),
        *orbit((0, 0, 0), 3.3, 3, -40.0, width=SIZE, height=SIZE),
    ]
    cameras = [dataclasses.replace(camera, name=f"view{i:02d}") for i, camera in enumerate(rings)]
    made: dict[str, Made] = {}

    def of(name: str) -> Made:
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            world = WORLDS.get(name, World())
            write_colmap(folder / "data", world, g, cameras)
            words = ("--max-steps", "60", "--max-gaussians", "300", "--test-every", "5")
            made[name] = fitted(folder / "data", folder, world, *words)
        return made[name]

    return of


def check_same_fit(found: Made, wanted: Made) -> None:
    """The same photographs of held-out views, in renderers that have no length of their own."""
    for renderer in ("exact", "fast"):
        assert found.psnr[renderer] == pytest.approx(wanted.psnr[renderer], abs=0.05)
    middle = lambda made: made.world.back(np.median(places(made.gaussians()), axis=0))  # noqa: E731
    np.testing.assert_allclose(middle(found), middle(wanted), atol=0.02)


def places(g: Gaussians) -> np.ndarray:
    """(N, 3) means in the world."""
    return g.means.double().numpy() + g.origin


def check_same_choice(found: dict, wanted: dict) -> None:
    """Scores to the rounding of two fits, whose picks therefore may only fall differently where scores are alike."""
    scores = [{row["name"]: row["score"] for row in report["candidates"]} for report in (found, wanted)]
    assert scores[0] == pytest.approx(scores[1], rel=0.05)
    first = [report["picks"][0]["name"] for report in (found, wanted)]
    assert scores[1][first[0]] >= 0.97 * scores[1][first[1]]


@pytest.mark.parametrize("name", WORLDS)
def test_a_fit_and_its_choice_of_views(capture, name):
    found, wanted = capture(name), capture("near")
    assert wanted.psnr["exact"] > 18
    check_same_fit(found, wanted)
    reports = found.selected(), wanted.selected()
    check_same_choice(*reports)
    assert reports[0]["prior"]["length"] == pytest.approx(found.world.scale * reports[1]["prior"]["length"])


@pytest.mark.parametrize("name", WORLDS)
def test_the_page(capture, viewer, name):  # noqa: F811
    """It opens where the capture's opens: clip planes, steps (`reach`) and photographs, in its own unit."""
    pages = []
    for made in (capture(name), capture("near")):
        path = made.folder / "page.html"
        assert cli.main(["share", str(made.folder / "run"), "-o", str(path), "--quiet"]) == 0
        pages.append(told(path))
    found, wanted = pages
    scale = capture(name).world.scale
    for key in ("near", "far", "reach"):
        assert found[key] == pytest.approx(scale * wanted[key], rel=0.03)
    assert 0 < found["near"] < 0.01 * found["reach"] < found["far"]
    assert [photo["name"] for photo in found["photos"]] == [photo["name"] for photo in wanted["photos"]]
    assert [page["scale"]["name"] for page in pages] == ["error", "error"]
    ends = [page["scale"][key] for page in pages for key in ("low", "high")]
    assert ends[:2] == pytest.approx(ends[2:], rel=0.3)  # in units of color, which the world's unit does not change


@pytest.mark.parametrize("suffix", STEPS)
@pytest.mark.parametrize("name", WORLDS)
def test_six_formats(capture, tmp_path, name, suffix):
    """What comes back are the Gaussians, in the world, as far as the format holds positions and sizes."""
    made = capture(name)
    path = tmp_path / f"scene{suffix}"
    assert cli.main(["convert", str(made.folder / "run"), str(path), "--quiet"]) == 0
    g, back = made.gaussians(), load_gaussians(path)
    # Formats may have an order of their own.
    away = [np.sort(made.world.back(places(x)), axis=0) for x in (back, g)]
    np.testing.assert_allclose(*away, atol=3 * STEPS[suffix])
    sizes = [np.sort(x.log_scales.amax(1).numpy()) for x in (back, g)]
    np.testing.assert_allclose(*sizes, atol=0.05)


@pytest.mark.parametrize("name", WORLDS)
def test_the_mesh(capture, name):
    """The same surface in the same place, and a voxel in the world's unit."""
    import plyfile

    vertices = []
    for made in (capture(name), capture("near")):
        path = made.folder / "mesh.ply"
        assert cli.main(["mesh", str(made.folder / "run"), "-o", str(path), "--preset", "fast", "--quiet"]) == 0
        ply = plyfile.PlyData.read(path)
        offset = next((x.split()[1:] for x in ply.comments if x.startswith("offset ")), (0, 0, 0))
        found = np.stack([ply["vertex"][axis] for axis in "xyz"], 1).astype(np.float64)
        vertices.append(made.world.back(found + np.array(offset, np.float64)))
    assert len(vertices[0]) == pytest.approx(len(vertices[1]), rel=0.1)
    for q in (0.02, 0.5, 0.98):
        np.testing.assert_allclose(*(np.quantile(x, q, axis=0) for x in vertices), atol=0.05)


@pytest.mark.parametrize("name", WORLDS)
def test_the_planner(capture, name):
    """A robot whose maps are in another unit or place goes where the other one went."""
    plans = []
    for made in (capture(name), capture("near")):
        data = load(made.folder / "data")
        planner = Planner(default_config().replace(max_gaussians=300, max_steps=100, deterministic=True))
        for view in data.views[:4]:
            planner.observe(view.image(), view.camera)
        planner.fit(steps=20)
        candidates = [made.world.camera(x) for x in orbit((0, 0, 0), 3.2, 6, 55.0, width=SIZE, height=SIZE)]
        planner.scores(candidates)
        plans.append(planner.next(2))
    found, wanted = plans
    assert found.scores == pytest.approx(wanted.scores, rel=0.05)
    assert wanted.scores[found.picks[0].index] >= 0.97 * max(wanted.scores)


@pytest.fixture(scope="module")
def banana(tmp_path_factory, data_dir):
    """Makes a fit to photographs of a world of `banana`, once each."""
    pycolmap, capture = pytest.importorskip("pycolmap"), data_dir / "banana"
    made: dict[str, Made] = {}

    def of(name: str) -> Made:
        if name not in made:
            folder, world = tmp_path_factory.mktemp(name), WORLDS.get(name, World())
            (folder / "data/sparse/0").mkdir(parents=True)
            (folder / "data/images").symlink_to(capture / "images")
            model = pycolmap.Reconstruction(str(next(capture.glob("sparse/**/cameras.*")).parent))
            model.transform(pycolmap.Sim3d(world.scale, pycolmap.Rotation3d(), world.zero))
            model.write(str(folder / "data/sparse/0"))
            words = ("--max-steps", "200", "--max-pixels", "15000", "--max-gaussians", "5000")
            made[name] = fitted(folder / "data", folder, world, *words)
        return made[name]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_a_capture(banana, name):
    """`banana`, 200 steps: PSNR is the same within 0.05 dB."""
    check_same_fit(banana(name), banana("near"))
