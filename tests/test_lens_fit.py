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
from drgs.cameras import intrinsics, orbit
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.fitting.components.base import Setup, check_conflicts
from drgs.fitting.components.lens import lens_choice, lost_share
from drgs.fitting.components.table import components_of
from drgs.fitting.frames import load_frames
from drgs.io.checkpoint import load_state
from drgs.train import FitConfig, fit

BARREL = ("opencv", (-0.3, 0.08, 0.002, -0.003))


# Name -> model, distortion, focal length (None: of a whole panorama) and distance of the cameras.
WIDE = {
    "fisheye": ("opencv_fisheye", (0.01, 0.0, 0.0, 0.0), 0.35, 1.2),
    "panorama": ("equirectangular", (), None, 1.0),
}


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Nine photographs of the scene of test_train.py through a lens, and points near the true means."""
    return _photographed(tmp_path_factory.mktemp("bent"), *BARREL, 0.5 / np.tan(np.radians(30)), 3.0)


@pytest.fixture(scope="module", params=WIDE)
def wide(request, tmp_path_factory):
    """The same from close by, through lenses that no pinhole holds."""
    return _photographed(tmp_path_factory.mktemp(request.param), *WIDE[request.param])


def _photographed(folder, model, distortion, focal, distance):
    g, views = scene(), []
    K = intrinsics(SIZE * (focal or 0.5 / np.pi), SIZE * (focal or 1 / np.pi), SIZE / 2, SIZE / 2)
    for i, camera in enumerate(orbit((0, 0, 0), distance, 9, width=SIZE, height=SIZE)):
        camera = dataclasses.replace(camera, K=K, model=model, distortion=distortion)
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


@pytest.mark.same_bits
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
    other = fit(bent, tmp_path / "plain", config(max_steps=100, undistort="on"), progress=False)
    frames = load_frames(bent.split()[1], 10**6, undistort="off")
    scores = [_psnr(x.gaussians.detach(), frames) for x in (result, other)]
    assert scores[0] > scores[1] - 0.3
    runs = whole_and_resumed(bent, config(max_steps=6, save_every=3, undistort="off", deterministic=True), 4)
    states = [load_state(run.state)[0] for run in runs]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    with pytest.raises(ValueError, match="--resume must continue the same fit, undistort was 'off' and is 'on'"):
        fit(
            bent,
            tmp_path / "whole",
            config(max_steps=6, save_every=3, undistort="on", deterministic=True),
            resume=True,
            progress=False,
        )


@pytest.mark.slow
def test_wide_lenses_are_kept_where_renderers_can(wide, tmp_path):
    """Auto fits what no pinhole holds through its lens, learns, and says why; where it cannot, it says what would."""
    result = fit(wide, tmp_path / "run", config(max_steps=200), progress=False)
    told = result.run.config()
    assert told["fit"]["data"]["undistort"] == "off"
    assert told["lenses"]["undistort"] == "off"
    assert 0.2 < told["lenses"]["lost"] < 1
    previews = [e["test_psnr"] for e in result.run.events() if e["event"] == "preview"]
    assert previews[-1] > previews[0] + 1
    again = fit(wide, tmp_path / "run", config(max_steps=200), resume=True, progress=False)
    assert again.run.config()["lenses"] == told["lenses"]
    train = wide.split()[0]
    for fields, because in (({"renderers": ("any",)}, "--for drgs"), ({"poses": "refined"}, "--poses fixed")):
        setup = Setup(wide, config(**fields), train, [], train, (), components_of())
        lens = next(x for x in setup.components if x.name == "lens")
        lens.prepare(setup)
        choice = lens.choice
        assert choice.undistort == setup.config.data.undistort == "on"
        assert because in choice.words()
    assert lens_choice(config(), train).words().endswith("they are fitted through their lenses")
    behind = any((view.camera.local_directions()[..., 2] < 0).any() for view in train)
    choice = lens_choice(config(renderers=("fast", "3dgut")), train)
    assert (choice.undistort == "on") == behind == ("behind the camera's plane" in choice.words())


def test_ordinary_lenses_are_taken_out(tmp_path):
    """Auto does what it did before there was a choice: a twentieth lost is nothing to be said."""
    bent = _photographed(tmp_path, "opencv", (-0.1, 0.01, 0.0, 0.0), 0.5 / np.tan(np.radians(30)), 3.0)
    choice = lens_choice(config(), bent.split()[0])
    assert choice.undistort == "on"
    assert 0.01 < choice.lost < 0.2
    assert not choice.words()
    runs = [fit(bent, tmp_path / use, config(max_steps=4, undistort=use), progress=False) for use in ("auto", "on")]
    assert runs[0].run.config()["fit"] == runs[1].run.config()["fit"]
    assert runs[0].run.config()["lenses"] == choice.to_json()
    assert lost_share(orbit((0, 0, 0), 3.0, 1)[0]) == 0
    assert FitConfig().replace().difference(FitConfig().replace(undistort="on")) is None
    assert (
        FitConfig()
        .replace(renderers=("fast",), undistort="off")
        .difference(FitConfig().replace(renderers=("fast",)))[0]
        == "undistort"
    )


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"renderers": ("any",)}, "renderers along rays alone, got inria, gsplat; use --for drgs"),
        ({"renderers": ("auto",)}, "renderers along rays alone, got inria, gsplat; use --for drgs"),
        ({"renderers": ("fast", "gsplat")}, "got gsplat; use --for drgs"),
        ({"renderers": ("fast",), "undistort": "yes"}, "undistort must be"),
    ],
)
def test_what_does_not_work_is_refused(fields, told):
    """In one line, before anything is read."""
    with pytest.raises(ValueError, match=told):
        FitConfig().replace(**{"undistort": "off", **fields})


@pytest.mark.parametrize(
    ("fields", "ways", "told"),
    [
        ({"poses": "refined"}, (), "undistort must be on where poses are optimized, got off: .*; use --poses fixed"),
        ({}, ("selection",), "undistort must be on where views are chosen on the way, got off: .*; use --views all"),
    ],
)
def test_what_it_cannot_stand_beside_is_refused(fields, ways, told):
    """Poses are refined, and candidates scored, through pinhole cameras."""
    how = FitConfig().replace(undistort="off", renderers=("fast",), **fields)
    with pytest.raises(NotImplementedError, match=told):
        check_conflicts(Setup(None, how, [], [], [], (), components_of(), frozenset(ways)))


def _psnr(g, frames):
    errors = [float((drgs.render(g, x.camera, FAST).rgb - x.image()).square().mean()) for x in frames]
    return float(-10 * np.log10(errors).mean())
