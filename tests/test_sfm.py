"""Structure from motion: on a small rendered scene, on real photos when present, and its bad
input.
"""

from __future__ import annotations

import numpy as np
import pytest
from test_data_points import HEIGHT, WIDTH, plane_views, render_plane, texture

from drgs.cameras import Camera, intrinsics, look_at
from drgs.data import load
from drgs.data.sfm import run_sfm

pytest.importorskip("pycolmap")
cv2 = pytest.importorskip("cv2")


def aligned_error(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance between two point lists after the best similarity, relative to the
    spread.
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1).max() / np.abs(b).max()


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """Photos of three textured walls that meet in a corner, and their cameras."""
    folder = tmp_path_factory.mktemp("corner")
    rng = np.random.default_rng(5)
    K = intrinsics(384, 384, WIDTH / 2, HEIGHT / 2)
    # Each wall is the square z = 0 of a frame of its own: its axes and center in the world.
    walls = []
    for axes, center in [
        (([1, 0, 0], [0, 1, 0], [0, 0, 1]), (0, 0, -1.5)),
        (([0, 0, 1], [1, 0, 0], [0, 1, 0]), (0, -1.5, 0)),
        (([0, 1, 0], [0, 0, 1], [1, 0, 0]), (-1.5, 0, 0)),
    ]:
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = np.transpose(axes), center
        walls.append((world, texture(rng)))
    cameras = []
    for index in range(7):
        angle = 0.3 + 0.15 * index
        eye = (4 * np.sin(angle), 1.5 + 0.3 * (index % 3), 4 * np.cos(angle))
        camera = Camera(K, look_at(eye, (-0.8, -0.8, -0.8), (0, 1, 0)), WIDTH, HEIGHT)
        photo = np.zeros((HEIGHT, WIDTH, 3))
        for world, image in walls:
            local = Camera(K, camera.w2c @ world, WIDTH, HEIGHT)
            color, depth = render_plane(local, image, half=1.5)
            photo = np.where(depth[..., None] > 0, color, photo)
        assert cv2.imwrite(str(folder / f"{index}.png"), np.round(photo * 255).astype(np.uint8))
        cameras.append(camera)
    return folder, cameras


def test_recovers_poses_and_loads(corner, tmp_path):
    """All photos found, centers right up to a similarity, result replaceable."""
    folder, cameras = corner
    stages = []
    out = tmp_path / "out"
    summary = run_sfm(folder, out, progress=lambda *step: stages.append(step))
    assert (summary.registered, summary.total, summary.missing) == (7, 7, ())
    assert summary.points > 100
    assert summary.reprojection_error < 1.0
    assert {stage for stage, _, _ in stages} == {"features", "matching", "mapping"}
    assert all(done <= total for _, done, total in stages)
    assert (out / "database.db").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    dataset = load(out)
    assert len(dataset.views) == 7
    found = np.stack([view.camera.center for view in dataset.views])
    assert aligned_error(found, np.stack([camera.center for camera in cameras])) < 0.05
    assert dataset.views[0].image().shape == (240, 320, 3)
    assert len(dataset.points) == summary.points
    # Again onto the same place: replaced, whole.
    (out / "notes.txt").write_text("mine")
    again = run_sfm(folder, out, matching="sequential")
    assert again.registered == 7
    assert len(load(out).views) == 7
    assert sorted(path.name for path in out.iterdir()) == [
        ".drgs.jsonl", "database.db", "images", "notes.txt", "sparse"
    ]  # fmt: skip
    # Refined by hand: no longer what was made here.
    (out / "sparse" / "0" / "points3D.bin").write_bytes(b"refined")
    with pytest.raises(ValueError, match="sparse: must not be replaced"):
        run_sfm(folder, out)
    assert (out / "sparse" / "0" / "points3D.bin").read_bytes() == b"refined"


@pytest.mark.parametrize("part", ["images", "sparse", "database.db", "database.db-wal"])
def test_projects_of_others_stay(tmp_path, rng, part):
    """Each part of a COLMAP project is refused by itself, before any work, and neighbors are not touched."""
    photos, project = tmp_path / "photos", tmp_path / "project"
    photos.mkdir()
    plane_views(photos, rng, count=2)
    files = {"images": "images/a.jpg", "sparse": "sparse/0/points3D.bin"}
    for file in (project / files.get(part, part), tmp_path / "project.partial" / "mine"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("hours of work")
    before = sorted(tmp_path.rglob("*"))
    stages = []
    with pytest.raises(ValueError, match=rf"{part}: must not be replaced.*; choose another output \(-o\)") as error:
        run_sfm(photos, project, progress=lambda *step: stages.append(step))
    assert "\n" not in str(error.value)
    assert not stages
    assert sorted(tmp_path.rglob("*")) == before
    assert (project / files.get(part, part)).read_text() == "hours of work"


def test_photos_that_do_not_connect(tmp_path, rng):
    """Nothing is left behind."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(3):
        assert cv2.imwrite(str(photos / f"{index}.png"), np.full((60, 80, 3), 90 * index, np.uint8))
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="no two of 3 could be connected") as error:
        run_sfm(photos, out)
    assert "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_bad_input(tmp_path, rng):
    """Each bad argument has its line."""
    with pytest.raises(FileNotFoundError, match="must be a folder of photos"):
        run_sfm(tmp_path / "gone", tmp_path / "out")
    photos = tmp_path / "photos"
    photos.mkdir()
    with pytest.raises(ValueError, match="must hold at least 2 photos, got 0"):
        run_sfm(photos, tmp_path / "out")
    plane_views(photos, rng, count=2)
    with pytest.raises(ValueError, match="camera_model must be one of .*, got 'FOV'"):
        run_sfm(photos, tmp_path / "out", camera_model="FOV")
    with pytest.raises(ValueError, match="matching must be auto, exhaustive or sequential"):
        run_sfm(photos, tmp_path / "out", matching="all")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be a folder that can be written, got: File exists"):
        run_sfm(photos, tmp_path / "file")
    (photos / "1.png").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="1.png: must be an image, could not be decoded"):
        run_sfm(photos, tmp_path / "out")


@pytest.mark.slow
def test_real_banana(data_dir, tmp_path):
    """At least 14 of the 16 poses."""
    photos = data_dir / "banana" / "images"
    if not photos.is_dir():
        pytest.skip(f"no banana data set in {data_dir}")
    summary = run_sfm(photos, tmp_path / "out")
    assert summary.total == 16
    assert summary.registered >= 14
    assert summary.reprojection_error < 0.5
    assert len(load(tmp_path / "out").views) == summary.registered
