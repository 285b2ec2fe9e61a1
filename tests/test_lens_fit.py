"""A fit of photographs as they were taken: no pixel is lost or resampled, and what does not work on them is refused."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from test_train import FAST, SIZE, config, scene

import drgs
from drgs.cameras import orbit
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.files import load_state
from drgs.fitting.frames import load_frames
from drgs.train import FitConfig, SelectionConfig, fit

BARREL = ("opencv", (-0.3, 0.08, 0.002, -0.003))


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Nine photographs of the scene of test_train.py through a lens, and points near the true means."""
    folder = tmp_path_factory.mktemp("bent")
    g, views = scene(), []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=SIZE, height=SIZE, fov=60.0)):
        camera = dataclasses.replace(camera, model=BARREL[0], distortion=BARREL[1])
        write_png(folder / f"{i}.png", drgs.render(g, camera, FAST).rgb.numpy())
        views.append(View(camera=camera, name=str(i), image_path=folder / f"{i}.png"))
    points = g.means.double().numpy() + 0.05 * np.random.default_rng(0).standard_normal((len(g), 3))
    return Dataset(folder, "transforms", views, points, np.full((len(g), 3), 0.5, np.float32), "made for a test")


def test_photographs_are_those_of_the_files(bent):
    """Off: the very pixels, none masked, of the camera with its lens. On: resampled, of a pinhole, corners masked."""
    (taken,) = load_frames(bent.views[:1], 10**6, undistort="off")
    (plain,) = load_frames(bent.views[:1], 10**6)
    assert taken.camera.distortion == BARREL[1]
    assert taken.mask is None
    stored = cv2.cvtColor(cv2.imread(str(bent.views[0].image_path)), cv2.COLOR_BGR2RGB)
    assert np.array_equal((taken.image() * 255).round().numpy(), stored)
    assert plain.camera.model == "pinhole"
    assert float((plain.image() - taken.image()).abs().max()) > 0.05
    (small,) = load_frames(bent.views[:1], 300, undistort="off")
    assert small.camera.distortion == BARREL[1]
    assert small.camera.K[0, 0] == pytest.approx(taken.camera.K[0, 0] * small.camera.width / SIZE)


def test_a_fit_through_the_lens(bent, tmp_path, whole_and_resumed):
    """It learns, says how it was made, is measured through the lens, again, too, and goes on bit for bit."""
    settings = config(max_steps=100, undistort="off")
    result = fit(bent, tmp_path / "run", settings, progress=False)
    told = result.run.config()["fit"]["data"]
    assert told["undistort"] == "off"
    previews = [e["test_psnr"] for e in result.run.events() if e["event"] == "preview"]
    assert previews[-1] > previews[0] + 1
    rows = json.loads((result.run.path / "metrics.json").read_text())["renderers"]["rows"]
    assert [row["name"] for row in rows] == ["fast"]
    other = fit(bent, tmp_path / "plain", config(max_steps=100), progress=False)
    frames = load_frames(bent.split()[1], 10**6, undistort="off")
    scores = [_psnr(x.gaussians.detach(), frames) for x in (result, other)]
    assert scores[0] > scores[1] - 0.3
    runs = whole_and_resumed(bent, config(max_steps=6, save_every=3, undistort="off", deterministic=True), 4)
    states = [load_state(run.state)[0] for run in runs]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    with pytest.raises(ValueError, match="--resume must continue the same fit, undistort was 'off' and is 'on'"):
        fit(
            bent, tmp_path / "whole", config(max_steps=6, save_every=3, deterministic=True), resume=True, progress=False
        )


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"renderers": ("any",)}, "renderers along rays alone, got inria, gsplat; use --for drgs"),
        ({"renderers": ("auto",)}, "renderers along rays alone, got inria, gsplat; use --for drgs"),
        ({"renderers": ("fast", "gsplat")}, "got gsplat; use --for drgs"),
        ({"renderers": ("fast",), "poses": "refined"}, "must have poses fixed, got refined; drop --poses"),
        ({"renderers": ("fast",), "selection": SelectionConfig(initial=2, add=1)}, "must have --views all, got active"),
        ({"renderers": ("fast",), "undistort": "yes"}, "undistort must be"),
    ],
)
def test_what_does_not_work_is_refused(fields, told):
    """In one line, before anything is read."""
    with pytest.raises(ValueError, match=told):
        FitConfig.of(**{"undistort": "off", **fields})


def _psnr(g, frames):
    errors = [float((drgs.render(g, x.camera, FAST).rgb - x.image()).square().mean()) for x in frames]
    return float(-10 * np.log10(errors).mean())
