"""Exposure of photographs where things move: each has its own, a frame of a video as any other; poses are refused."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from resuming import stopped_and_resumed
from test_active_unknowns import same_run
from test_dynamic_fit import FAST, TIMES, _small_field, config  # noqa: F401  (a fixture)

from drgs.cameras import orbit
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.ellipsoids import Gaussians
from drgs.files import Run, load_state
from drgs.fitting.config import SelectionConfig
from drgs.fitting.records import fit_record
from drgs.integrator import render
from drgs.train import fit

CAMERAS = 5
LOGS = np.random.default_rng(2).normal(0, 0.15, (CAMERAS, len(TIMES), 3))


def scene():
    """A plane of 64 flat Gaussians, and before it three darker ones; colors are below saturation, whatever the gain,
    and change slowly, so that each point has one from everywhere.
    """
    draw = torch.Generator().manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(-0.9, 0.9, 8), torch.linspace(-0.9, 0.9, 8), indexing="ij")
    plane = torch.stack([x.flatten(), y.flatten(), torch.zeros(64)], 1)
    group = torch.tensor([[-0.3, 0.0, -0.8]]) + 0.12 * torch.randn(3, 3, generator=draw)
    scales = torch.cat([torch.tensor([[0.16, 0.16, 0.002]]).repeat(64, 1), torch.full((3, 3), 0.1)])
    sh = 0.3 * torch.rand(67, 3, generator=draw) - 0.5
    sh[-3:] -= 0.7
    return Gaussians.from_arrays(torch.cat([plane, group]), torch.eye(4)[[0] * 67], scales, torch.full((67,), 0.95), sh)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Five synchronous cameras, the second held out, around a plane before which three Gaussians move; each photograph
    has its own gains, and points are on the plane and, at the first time, on what moves.
    """
    folder = tmp_path_factory.mktemp("moving")
    g, views = scene(), []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, CAMERAS, width=60, height=48, up=(0, 0, -1), elevation=70.0)):
        for k, time in enumerate(TIMES):
            means = g.means.clone()
            means[-3:, 0] += 0.7 * time
            name = f"cam{i}_{k}"
            seen = dataclasses.replace(camera, time=time, name=name)
            image = render(g.replace(means=means), seen, FAST).rgb.numpy() * np.exp(LOGS[i, k])
            write_png(folder / f"{name}.png", image.clip(0, 1))
            split = "test" if i == 1 else "train"
            views.append(View(camera=seen, name=name, image_path=folder / f"{name}.png", split=split))
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-0.6, 0.6, (120, 2)), np.zeros((120, 1))], axis=1)
    points = np.concatenate([flat, g.means[-3:].double().numpy()])
    return Dataset(folder, "transforms", views, points, np.full((len(points), 3), 0.5, np.float32), "made")


def truth(names):
    """(V, 3) log gains of photographs, less their mean."""
    logs = np.array([LOGS[int(name[3]), int(name[5])] for name in names])
    return logs - logs.mean(axis=0)


def settings(**fields):
    return config(max_gaussians=140, **fields)


@pytest.mark.slow
def test_each_frame_has_its_own_gain(dataset, tmp_path):
    """Gains of four cameras at three times come back within 0.03, though something moved; the scene is fitted with
    them, and the run says so.
    """
    fit(dataset, tmp_path / "run", settings(exposure="points"), progress=False)
    recorded = Run(tmp_path / "run").config()
    names = list(recorded["exposure"]["gains"])
    assert len(names) == 12
    assert np.abs(np.log([recorded["exposure"]["gains"][name] for name in names]) - truth(names)).max() < 0.03
    assert recorded["exposure"]["components"] == 1
    assert fit_record(Run(tmp_path / "run")).estimated == ("exposure",)
    tensors, header = load_state(tmp_path / "run" / "state.safetensors")
    assert header["networks"] == ["deformation.grid", "deformation.mlp", "exposure"]
    assert np.abs(tensors["exposure.parameter.log_gains"].numpy() - truth(names)).max() < 0.03


@pytest.mark.slow
def test_photographs_fit_better_with_gains(dataset, tmp_path):
    """The loss of the photographs falls further: their own gains are what no field can explain."""
    last = []
    for use in ("off", "auto"):
        run = Run(tmp_path / use)
        fit(dataset, run.path, settings(exposure=use, max_steps=60), progress=False)
        last.append([event["psnr"] for event in run.events() if event["event"] == "train"][-1])
    assert last[1] > last[0] + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("at", [3, 9], ids=["static", "dynamic"])
@pytest.mark.same_bits
def test_learned_gains_go_on_in_either_stage(dataset, whole_and_resumed, at):
    """Stopped before a step of either stage and resumed it ends with the same bits, the gauge held over all
    photographs, those of later times included.
    """
    runs = whole_and_resumed(dataset, settings(exposure="learned", deterministic=True), at)
    states = [load_state(run.state)[0] for run in runs]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    assert float(states[0]["exposure.parameter.log_gains"].mean(dim=0).abs().max()) < 1e-7
    assert runs[0].config()["exposure"] == runs[1].config()["exposure"]


@pytest.mark.slow
def test_frames_that_join_get_their_gains(dataset, tmp_path):
    """An active fit at later times: a frame that is picked has its gain beside the others', and exposure is eliminated
    from what all of them tell about the field; killed and resumed it ends in the same bits.
    """
    active = SelectionConfig().replace(policy="fisher", schedule="times", every=2, probes=4)
    how = settings(exposure="points", init_points="all", deterministic=True, selection=active, save_every=1000)
    fit(dataset, tmp_path / "a", how, progress=False)
    gains = Run(tmp_path / "a").config()["exposure"]["gains"]
    assert len(gains) == 4 + 2
    assert np.abs(np.log(list(gains.values())) - truth(list(gains))).max() < 0.03
    picks = json.loads((tmp_path / "a" / "selection.json").read_text())["picks"]
    assert all(pick["nuisances"]["eliminate"] == ["exposure"] for pick in picks)
    stopped_and_resumed(lambda: dataset, tmp_path / "b", how, picks[1]["step"])
    same_run(tmp_path / "a", tmp_path / "b")


@pytest.mark.parametrize("use", ["refined", "auto"])
def test_poses_are_refused_where_things_move(dataset, tmp_path, use):
    """In one line that says why and what to do, before anything is written; what stands still may be refined."""
    with pytest.raises(NotImplementedError, match="poses must be fixed where things move.*--dynamics ignore"):
        fit(dataset, tmp_path / "run", settings(poses=use), progress=False)
    assert not (tmp_path / "run" / "config.json").exists()
