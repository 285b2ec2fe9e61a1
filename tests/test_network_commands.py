"""`drgs fisher` and `drgs select` of a scene that moves, and maps of different rules beside each other."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians
from test_network_information import swarm

from drgs import cli, fisher, gain
from drgs.commands.scene_input import SceneInput
from drgs.data.camera_lists import save_cameras_json
from drgs.files import save_ply
from drgs.information.maps import fisherrf_map
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast")
SIZE = (16, 16)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A scene that moves as `scene.ply`, and two cameras at three times; the first two views are in `known.json`."""
    rng = np.random.default_rng(4)
    g = gaussians(rng, 8, 1).detach()
    cams = [camera(rng, SIZE) for _ in range(2)]
    views = [
        dataclasses.replace(cam, w2c=cam.w2c.detach().numpy(), time=t, name=f"cam{k:02d}/{round(2 * t):04d}")
        for k, cam in enumerate(cams)
        for t in (0.0, 0.5, 1.0)
    ]
    save_ply(g, tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "known.json", views[:2])
    save_cameras_json(tmp_path / "cameras.json", views[2:])
    moving = swarm(g)
    monkeypatch.setattr(SceneInput, "at", classmethod(lambda cls, path: cls(g, moving=moving)))
    monkeypatch.chdir(tmp_path)
    return moving, views


def test_fisher_of_what_moves(place, tmp_path, capsys):
    """Groups of the field are in the file and in the tables; maps of the deformation are among the pictures."""
    scene, views = place
    line = "fisher scene.ply --train known.json --cameras cameras.json --limit 2 --preset fast --probes 2 --maps -o out"
    assert cli.main([*line.split(), "--blocks", "geometry,deformation"]) == 0, capsys.readouterr().err
    report = json.loads((tmp_path / "out/fisher.json").read_text())
    assert report["blocks"] == ["geometry", "deformation"]
    assert report["probes"] == 2
    want = fisher.network(scene, views[:2], FAST, probes=2)
    for name, x in want.items():
        assert report["groups"][name]["sum"] == pytest.approx(float(x.sum()), rel=1e-6)
        assert report["groups"][name]["blocks"]["geometry"] == 0
    for view in report["views"]:
        kinds = [file.removeprefix(view["files"][0][: -len("variance.png")]) for file in view["files"]]
        assert {"variance.png", "deformation.variance.png", "deformation.share.png", "maps.png"} <= set(kinds)
        parts = view["blocks"]
        total = parts["geometry"]["variance"]["sum"] + parts["deformation"]["variance"]["sum"]
        assert view["variance"]["sum"] == pytest.approx(total)
        assert view["camera"]["time"] in (0.0, 0.5, 1.0)
        row = cv2.imread(str(tmp_path / "out" / view["files"][-1]))
        panels = 5  # the view, moments, fisherrf, geometry, deformation; maps have a bar beside them
        assert row.shape[1] == panels * 208 + (panels - 1) * 76
    assert "deformation %" in capsys.readouterr().out


def test_select_among_cameras_and_times(place, tmp_path, capsys):
    """Choosing by a field's information from the command line: its parts, its score's name, the candidates' times."""
    scene, views = place
    line = "select scene.ply --train known.json --candidates cameras.json --probes 2 -k 2 -o picks.json"
    assert cli.main([*line.split(), "--network", "trace"]) == 0, capsys.readouterr().err
    assert "deformation: z" in capsys.readouterr().out
    report = json.loads((tmp_path / "picks.json").read_text())
    assert report["network"] == {"score": "trace", "probes": 2}
    assert report["combine"] == "zscore"
    assert {"geometry.means", "deformation.grid", "deformation.mlp"} <= set(report["picks"][0]["parts"])
    assert [row["time"] for row in report["candidates"]] == [view.time for view in views[2:]]
    assert cli.main([*line.split(), "--blocks", "deformation"]) == 0, capsys.readouterr().err
    assert "grid %" in capsys.readouterr().out
    report = json.loads((tmp_path / "picks.json").read_text())
    assert list(report["picks"][0]["parts"]) == ["grid", "mlp"]
    assert report["picks"][0]["camera"]["time"] in (0.0, 0.5, 1.0)


def test_cameras_without_a_time(place, capsys):
    """An orbit has none: --time says it, else one line does."""
    line = "select scene.ply --train known.json --candidates orbit --count 2 --blocks deformation --probes 1 --quiet"
    assert cli.main([*line.split(), "-o", "picks.json"]) == 2
    assert "cameras must have a time, as the scene moves" in capsys.readouterr().err
    assert cli.main([*line.split(), "-o", "picks.json", "--time", "0.5"]) == 0, capsys.readouterr().err


def test_map_of_fisherrf(rng):
    """It adds up to the score that FisherRF's rasterizer would give the view, colors that are clamped left out."""
    g, cam = gaussians(rng, 8, 4).detach(), camera(rng, SIZE)
    g.sh[:, 0] -= torch.tensor([0.0, 1.0, 1.5])
    cam = dataclasses.replace(cam, w2c=cam.w2c.detach())
    settings = FAST.replace(background=(0.1, 0.2, 0.3))
    told = fisher.diagonal(g, cam, settings, "fisherrf")
    known = {name: x * torch.rand(x.shape, dtype=torch.float64) for name, x in told.items()}
    assert 0 < int((told["sh"].sum(1) == 0).sum()) < 24
    prior = gain.Prior(1e-2, groups={"means": 0.5})
    also = dataclasses.replace(prior, groups={**prior.groups, "rotations": 1.0})  # which FisherRF does not have
    found = fisherrf_map(g, cam, known, also, settings)
    want = gain.information_gain(told, known, "eig", prior).total
    assert float(found.double().sum()) == pytest.approx(want, rel=1e-4)
    assert found.shape == SIZE[::-1]
