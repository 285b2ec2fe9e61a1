"""Commands on a run whose data set stands at map coordinates: what they write is what they write near 0, moved."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_active import config, lazily, write_still
from test_share import told, viewer  # noqa: F401 (a fixture)

from drgs import cli
from drgs.data.camera_lists import load_cameras_json
from drgs.data.images import read_image
from drgs.train import fit

UTM = np.array([500000.0, 5400000.0, 120.0])
WORLDS = {"near": np.zeros(3), "utm": UTM}
ORIGIN = UTM + (0, 0, 1)  # the middle of the cameras, which stand one unit above what they look at


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """In `near` and `utm` a data set, `data`, and a run on it, `run`."""
    folder = tmp_path_factory.mktemp("worlds")
    for name, place in WORLDS.items():
        write_still(folder / name / "data")
        path = folder / name / "data/transforms.json"
        meta = json.loads(path.read_text())
        for frame in meta["frames"]:
            for row, x in zip(frame["transform_matrix"], place, strict=False):
                row[3] += x
        path.write_text(json.dumps(meta))
        fit(lazily(folder / name / "data"), folder / name / "run", config(max_steps=12), progress=False)
    return folder


def both(worlds, line: str, capsys, monkeypatch) -> dict[str, str]:
    """What a command line prints in each world."""
    told_of = {}
    for name in WORLDS:
        monkeypatch.chdir(worlds / name)
        assert cli.main(line.split()) == 0, capsys.readouterr().err
        told_of[name] = capsys.readouterr().out
    return told_of


def test_select(worlds, capsys, monkeypatch):
    """The same picks, whose cameras are in the world."""
    line = "select run --candidates dome --count 8 -k 2 --preset fast --refine 4 -o select.json"
    both(worlds, line, capsys, monkeypatch)
    near, far = (json.loads((worlds / name / "select.json").read_text()) for name in WORLDS)
    assert [pick["name"] for pick in far["picks"]] == [pick["name"] for pick in near["picks"]]
    for a, b in zip(near["picks"], far["picks"], strict=True):
        assert np.abs(np.array(b["camera"]["c2w"])[:3, 3] - UTM - np.array(a["camera"]["c2w"])[:3, 3]).max() < 1e-3
        assert b["score"] == pytest.approx(a["score"], rel=0.02)  # of fits that differ by rounding


def test_render(worlds, capsys, monkeypatch):
    """The same pictures from an orbit, whose cameras.json is in the world and can be rendered again."""
    both(worlds, "render run --cameras orbit --frames 3 --width 32 --preset fast -o orbit", capsys, monkeypatch)
    near, far = (load_cameras_json(worlds / name / "orbit/cameras.json") for name in WORLDS)
    for a, b in zip(near, far, strict=True):
        assert np.abs(b.center - UTM - a.center).max() < 1e-3
        pictures = [read_image(worlds / name / f"orbit/{a.name}.png").astype(float) for name in WORLDS]
        assert np.abs(pictures[1] - pictures[0]).mean() < 0.5  # of 255
    both(worlds, "render run --cameras orbit/cameras.json --preset fast -o again", capsys, monkeypatch)
    first, again = (read_image(worlds / f"utm/{folder}/{far[0].name}.png") for folder in ("orbit", "again"))
    assert np.abs(first.astype(int) - again).max() <= 1


def test_mesh(worlds, capsys, monkeypatch):
    pytest.importorskip("skimage")
    trimesh = pytest.importorskip("trimesh")
    line = "mesh run --voxel 0.25 --crop 0 --min-piece 0 --preset fast -o mesh.ply"
    told_of = both(worlds, line, capsys, monkeypatch)
    assert "positions are relative to the offset" not in told_of["near"]
    assert "positions are relative to the offset 500000 5400000 121, which the file states" in told_of["utm"]
    near, far = (trimesh.load(worlds / name / "mesh.ply", process=False) for name in WORLDS)
    assert np.abs(far.bounds + ORIGIN - UTM - near.bounds).max() < 0.25  # of a voxel of another lattice


def test_share(worlds, viewer, capsys, monkeypatch):  # noqa: F811
    """Of a run and of its file."""
    for scene in ("run", "run/point_cloud.ply"):
        told_of = both(worlds, f"share {scene} -o page.html", capsys, monkeypatch)
        assert "positions are relative to the offset 500000 5400000 121, which the page states" in told_of["utm"]
        near, far = (told(worlds / name / "page.html") for name in WORLDS)
        assert (near["offset"], far["offset"]) == ([0, 0, 0], ORIGIN.tolist())
        for a, b in zip(near["photos"], far["photos"], strict=True):
            moved = np.array(b["pose"]) + [*[0] * 12, *(ORIGIN - UTM), 0]  # column by column
            assert moved == pytest.approx(a["pose"], abs=1e-2 if scene == "run/point_cloud.ply" else 1e-4)


def test_capture_more(worlds, capsys, monkeypatch):
    """The same instructions; where they begin is in the world."""
    both(worlds, "capture --more -o run", capsys, monkeypatch)
    near, far = (json.loads((worlds / name / "run/next.json").read_text()) for name in WORLDS)
    assert far["picks"][0]["text"] == near["picks"][0]["text"]
    assert far["picks"][0]["origin"] == pytest.approx(UTM + near["picks"][0]["origin"], abs=1e-4)


def test_a_view_begins_at_the_same_place(worlds):
    """In the browser's frame, which is the Gaussians'; frusta and photographs are where they are."""
    pytest.importorskip("viser")
    from drgs.commands.options import View
    from drgs.commands.scene_input import SceneInput
    from drgs.commands.view import subject_of
    from drgs.viewing.client import pose_of

    looked = []
    for name in WORLDS:
        args = View(scene=worlds / name / "run")
        looked.append(subject_of(args, SceneInput.of(args)))
    near, far = looked
    assert far.origin.tolist() == ORIGIN.tolist()
    lift = ORIGIN - UTM
    assert far.first.pose.position + lift == pytest.approx(near.first.pose.position, abs=1e-4)
    assert far.first.target + lift == pytest.approx(near.first.target, abs=1e-4)
    for a, b in zip(near.placed_views, far.placed_views, strict=True):
        assert b.camera.center == pytest.approx(UTM + a.camera.center, abs=1e-4)  # the fit refines them
        assert pose_of(b.camera, ORIGIN).position + lift == pytest.approx(a.camera.center, abs=1e-4)
