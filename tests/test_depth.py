"""Claims of drgs.fitting.components.depth on photographs of a painted square, whose depth is known."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_data_points import plane_views
from test_transients import wall

import drgs
from drgs import cli
from drgs.cameras import intrinsics, look_at
from drgs.data import Dataset, View
from drgs.fitting.components.base import Checkpoint
from drgs.fitting.components.depth import DepthComponent, compare
from drgs.fitting.depths import depth_error
from drgs.fitting.frames import Frame
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.train import FitConfig, SelectionConfig, fit

POINTS = np.stack([*np.meshgrid(*2 * [np.linspace(-1.5, 1.5, 12)]), np.zeros((12, 12))], axis=-1).reshape(-1, 3)


@pytest.fixture
def square(tmp_path, rng):
    """Views of the square, with metric depth maps in millimeters."""
    return plane_views(tmp_path, rng, depth=True)


def against(views: list[View]):
    """What maps say of points on the square, a tenth of which are wrong."""
    wrong = np.where(np.arange(len(POINTS)) % 10, 0.0, 1.0)
    return compare(views, POINTS + wrong[:, None] * [0, 0, 1], np.ones((len(views), len(POINTS)), bool))


def relative(view: View, function) -> View:
    """With a map of some function of z in place of the metric one."""
    file = view.depth_path.with_suffix(".npy")
    with np.errstate(divide="ignore"):
        np.save(file, function(view.depth()))
    return dataclasses.replace(view, depth_path=None, relative_depth_path=file)


def test_maps_that_agree_with_points(square):
    """Up to the points that are wrong."""
    found = against(square)
    assert found.is_clear
    assert found.agreeing == pytest.approx(0.9, abs=0.05)
    assert found.ratio == pytest.approx(1, abs=1e-3)
    assert not found.left_out
    assert "agree within 10 % at 9" in found.words()


def test_maps_of_another_unit(square):
    """Millimeters for meters: no map is used, and the line says which factor is missing."""
    for view in square:
        view.depth_scale = 1.0
    found = against(square)
    assert found.has_wrong_unit
    assert not found.is_clear
    component = DepthComponent()
    component.found = found
    assert "multiply depth_unit_scale_factor by 0.001" in component._effect()
    assert all(view.depth_path is None for view in component.initial_views(square))


def test_the_map_of_another_photograph_is_left_out(square):
    """The others are used; it gives no initial points either."""
    square[0].depth_path = square[-1].depth_path
    square[0].camera = dataclasses.replace(square[0].camera, w2c=look_at((6, -0.6, 2), (0, 0, 0), (0, 1, 0)))
    found = against(square)
    assert found.is_clear
    assert found.left_out == (square[0].name,)
    component = DepthComponent()
    component.found, component.used = found, True
    assert [view.depth_path is None for view in component.initial_views(square)] == [True, False, False, False, False]


@pytest.mark.parametrize("value", [0, np.nan])
def test_maps_that_know_nothing(square, value):
    """There is nothing to compare, so they are not used, and nothing else changes."""
    np.save(square[0].depth_path.parent / "none.npy", np.full((240, 320), value))
    for view in square:
        view.depth_path = square[0].depth_path.parent / "none.npy"
    found = against(square)
    assert not found.is_clear
    assert found.points == 0
    assert "too few" in found.words()


@pytest.mark.parametrize("function", [lambda z: 0.3 * z - 0.2, lambda z: 7 / z + 3], ids=["depth", "inverse"])
def test_scale_and_shift_of_relative_maps(square, function):
    """Both kinds of network are found, with the depth that they mean."""
    views = [relative(view, function) for view in square]
    found = against(views)
    assert found.is_clear
    assert len(found.lines) == len(views)
    for view, other in zip(views, square, strict=True):
        z, expected = found.lines[view.name].z(view.relative_depth()), other.depth()
        known = (expected > 0) & (z > 0)
        assert known.mean() > 0.9 * (expected > 0).mean()
        assert np.abs(z[known] / expected[known] - 1).max() < 0.02


def frames_of(off: float = 0.0) -> tuple[list[Frame], GaussianRows]:
    """Gray photographs of a wall that says nothing of its depth, wide, with its depth; first Gaussians before it."""
    frames = []
    for i in range(3):
        pose = look_at((0.5 * i - 0.5, 0.0, -2.0), target=(0.5 * i - 0.5, 0, 0), up=(0, -1, 0))
        camera = drgs.Camera(intrinsics(24.0, 24.0, 24.0, 24.0), pose, 48, 48, name=str(i))
        rgb = torch.full((48, 48, 3), 0.5)
        frames.append(Frame(str(i), camera, rgb, depth=lambda: np.full((48, 48), 2.0, np.float32)))
    means = wall().means * 1.5 + torch.tensor([0.0, 0.0, off])
    return frames, GaussianRows.from_points(means, torch.full((len(means), 3), 0.5), 0.9)


@pytest.mark.parametrize("name", ["fast", "gsplat"])
def test_depth_is_z_whatever_is_rendered(name):
    """Of a wall across the axis, also in the corners of a wide picture, where the distance is 1.7 times z."""
    settings = drgs.RenderSettings.preset(name)
    frames, _ = frames_of()
    flat = wall().replace(means=wall().means * 1.5, log_scales=torch.tensor([0.2, 0.2, 0.005]).log().expand(400, 3))
    out = drgs.render(flat, frames[1].camera, settings)
    assert depth_error(out, frames[1], settings) < 0.03
    assert depth_error(out, dataclasses.replace(frames[1], depth=None), settings) is None


@pytest.mark.parametrize("name", ["fast", "gsplat"])
def test_gaussians_move_to_the_depth_of_maps(name):
    """Gray photographs leave them where they are, 15 % too near; halved photographs at first do no harm."""
    errors = {}
    for use in ("off", "on"):
        settings = drgs.RenderSettings.preset(name)
        frames, rows = frames_of(off=-0.3)
        config = FitConfig().replace(
            settings=settings,
            renderers=(name,),
            max_steps=60,
            max_gaussians=400,
            sh_degree=0,
            num_downscales=1,
            means_rate=(5e-3, 5e-3),
        )
        trainer = Trainer(config, frames, rows, 2.0)
        component = trainer.component("depth")
        if use == "on":
            record = {"used": True, "kind": "metric", "maps": 3, "points": 0, "agreeing": 0.0, "ratio": 1.0}
            record |= {"at_ratio": 0.0, "left_out": [], "lines": {}}
            component.resume(trainer, Checkpoint({}, {"depth": record}, "here"))
        for _ in range(60):
            trainer.step()
        out = drgs.render(trainer.gaussians(), frames[1].camera, settings)
        errors[use] = depth_error(out, frames[1], settings)
    assert errors["off"] > 0.1
    assert errors["on"] < 0.5 * errors["off"]


def config_of(**fields) -> FitConfig:
    short = {"max_steps": 8, "max_pixels": 3000, "max_gaussians": 300, "renderers": ("fast",), "test_every": 4}
    return FitConfig().replace(**{**short, "deterministic": True, "depth": "auto", "skybox": "off", **fields})


def test_a_fit_uses_maps_and_goes_on_with_them(square, tmp_path):
    """By what photographs triangulate; a fit that was interrupted ends with the same bits; metrics have the error."""
    dataset = Dataset(tmp_path, "test", square)
    whole = fit(dataset, tmp_path / "whole", config_of(), progress=False)
    found = whole.run.config()["depth"]
    assert found["used"]
    assert found["points"] >= 100
    assert whole.metrics["mean"]["depth_error"] < 1
    assert "depth_error" in whole.metrics["variants"]
    part = config_of(save_every=4)

    def interrupted(done: int, of: int) -> int:
        if done == 6:
            raise KeyboardInterrupt
        return of

    with pytest.raises(KeyboardInterrupt):
        fit(dataset, tmp_path / "part", part, progress=False, pace=interrupted)
    ended = fit(dataset, tmp_path / "part", part, progress=False, resume=True)
    assert torch.equal(ended.gaussians.means, whole.gaussians.means)
    assert ended.run.config()["depth"] == found
    off = fit(dataset, tmp_path / "off", config_of(depth="off"), progress=False)
    assert "depth" not in off.run.config()
    assert "depth_error" in off.metrics["mean"]
    assert not torch.equal(off.gaussians.means, whole.gaussians.means)


def test_maps_that_cannot_be_used_are_refused_before_the_first_step(square, tmp_path, capsys):
    """Another shape than the photograph's; no map at all where they are asked for, by exit code 2 and one line."""
    np.save(tmp_path / "wide.npy", np.ones((100, 320)))
    broken = [*square[:-1], dataclasses.replace(square[-1], depth_path=tmp_path / "wide.npy")]
    with pytest.raises(ValueError, match=r"wide.npy: must have the shape of its image \(320x240\), got 320x100"):
        fit(Dataset(tmp_path, "test", broken), tmp_path / "run", config_of(), progress=False)
    frames = [
        {"file_path": view.image_path.name, "transform_matrix": np.linalg.inv(view.camera.w2c).tolist()}
        for view in square
    ]
    text = {"fl_x": 300, "cx": 150.5, "cy": 128.0, "w": 320, "h": 240, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(text))
    code = cli.main(["fit", str(tmp_path), "-o", str(tmp_path / "none"), "--depth", "on", "--max-steps", "4"])
    assert code == 2
    assert "must have depth maps for --depth on, has none" in capsys.readouterr().err
    assert not (tmp_path / "none" / "config.json").exists()


def test_active_fits_read_maps_of_picked_views_alone(square, tmp_path, monkeypatch):
    """What is found is found again with each pick, and recorded."""
    read = set()
    plain = View.depth

    def noted(view: View, *size: int):
        read.add(view.name)
        return plain(view, *size)

    monkeypatch.setattr(View, "depth", noted)
    dataset = Dataset(tmp_path, "test", square)
    config = config_of(test_every=0, selection=SelectionConfig(policy="farthest", initial=2, add=1, every=3))
    result = fit(dataset, tmp_path / "run", config, progress=False)
    picked = set(result.metrics["fitted"])
    assert len(picked) == 3
    assert read == picked
    assert result.run.config()["depth"]["maps"] == 3
    assert [x["maps"] for x in result.run.events() if x["event"] == "depth"] == [3]
