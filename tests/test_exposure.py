"""Claims of drgs.fitting.exposure: gains are recovered, the gauge holds exactly, and a fit with gains goes on."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_train import config, dataset  # noqa: F401 (a fixture)

from drgs.cameras import orbit
from drgs.files import load_state
from drgs.fitting.exposure import Exposure, estimate_exposure, exposure_network
from drgs.fitting.frames import Frame
from drgs.fitting.records import fit_record


def _photographs(gains, hidden=0.0, seed=0):
    """Views of a cloud of colored points, with gains; a share of the 5x5 squares are of something else."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (150, 3))
    colors = rng.uniform(0.2, 0.5, (150, 3))
    frames = []
    cameras = orbit((0, 0, 0), 4.0, len(gains), width=300, height=300)
    for camera, gain in zip(cameras, gains, strict=True):
        image = np.full((300, 300, 3), 0.3)
        pixels, depth = camera.project(points)
        for (x, y), color in zip(pixels[np.argsort(-depth)].astype(int), colors[np.argsort(-depth)], strict=True):
            seen = rng.uniform(0.2, 0.5, 3) if rng.uniform() < hidden else color
            image[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3] = seen
        image = image * gain * np.exp(rng.normal(0, 0.02, image.shape))
        frames.append(Frame(camera.name or str(len(frames)), camera, torch.from_numpy(image.astype(np.float32))))
    names = [f"p{i}" for i in range(len(frames))]
    return [dataclasses.replace(frame, name=name) for frame, name in zip(frames, names, strict=True)], points


@pytest.mark.parametrize("hidden", [0.0, 0.2])
def test_known_gains_are_recovered(hidden):
    """Log gains with a spread of 0.2 come back within 0.02, where a fifth of the points are hidden, too; their mean is
    zero to rounding, for a mean of all would tint what viewers show.
    """
    rng = np.random.default_rng(3)
    logs = rng.normal(0, 0.2, (8, 3))
    logs -= logs.mean(axis=0)
    found = estimate_exposure(*_photographs(np.exp(logs), hidden))
    assert found.components == 1
    assert np.abs(found.log_gains - logs).max() < 0.02
    assert np.abs(found.log_gains.mean(axis=0)).max() < 1e-12
    assert found.is_clear
    assert found.spread == pytest.approx(logs.std(axis=0) / np.log(2), abs=0.02)


def test_only_photographs_that_show_a_point_are_compared():
    """Most points are behind something dark in one photograph, which then seems dark; where it is known who shows
    which, nothing hides.
    """
    frames, points = _photographs(np.ones((6, 3)))
    pixels, _ = frames[0].camera.project(points)
    hidden = pixels[:, 0] > 120
    frames[0].pixels[:, 117:] *= 0.6
    assert 0.6 < hidden.mean() < 0.9
    shown = np.ones((6, len(points)), bool)
    shown[0, hidden] = False
    fooled = estimate_exposure(frames, points)
    assert fooled.log_gains[0].max() < -0.3
    found = estimate_exposure(frames, points, shown=shown)
    assert np.abs(found.log_gains).max() < 0.02
    assert found.observations == pytest.approx(fooled.observations - hidden.sum(), abs=3)  # some were too dark


def test_equal_photographs_have_no_clear_gains():
    """Of photographs of one exposure, what is left is noise: no fit turns gains on for it."""
    found = estimate_exposure(*_photographs(np.ones((6, 3)), 0.2))
    assert max(found.spread) < 0.02
    assert not found.is_clear


def test_photographs_without_common_points_keep_gain_one():
    """Nothing compares photographs that share no point: each is a set of its own, and its gain is 1."""
    frames, points = _photographs(np.array([[1.0] * 3, [0.5] * 3]))
    found = estimate_exposure(frames, points[:0])
    assert (found.components, found.observations) == (2, 0)
    assert not found.log_gains.any()
    assert not found.is_clear
    assert "2 sets" in found.words()


def test_learned_gains_keep_zero_mean_and_held_ones_stay():
    """After a step of learned gains and the constraint their mean is 0 to float32; those from points never move."""
    frames, _ = _photographs(np.ones((3, 3)))
    start = np.array([[0.1] * 3, [0.0] * 3, [-0.1] * 3])
    learned = exposure_network(frames, True, start)
    (learned.module.log_gains[0] * torch.tensor([1.0, -2.0, 3.0])).sum().backward()
    learned.optimizer.step()
    learned.constraint()
    assert not torch.equal(learned.module.log_gains.detach(), torch.tensor(start, dtype=torch.float32))
    assert float(learned.module.log_gains.detach().mean(dim=0).abs().max()) < 1e-7
    held = exposure_network(frames, False, start)
    assert isinstance(held.module, Exposure)
    assert not held.module.log_gains.requires_grad
    assert held.constraint is None
    assert json.dumps(held.module.log_gains.tolist())


@pytest.mark.same_bits
def test_a_fit_with_gains_goes_on(dataset, whole_and_resumed):  # noqa: F811
    """Stopped in its middle and resumed it ends with the same gains, Gaussians and record; information about the scene
    is asked for with exposure eliminated.
    """
    settings = config(max_steps=6, save_every=3, exposure="learned", deterministic=True)
    runs = whole_and_resumed(dataset, settings, 4)
    states = [load_state(run.state)[0] for run in runs]
    assert states[0].keys() == states[1].keys()
    assert any(name.startswith("exposure.") for name in states[0])
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    exposures = [run.config()["exposure"] for run in runs]
    assert exposures[0] == exposures[1]
    assert [fit_record(run).estimated for run in runs] == [("exposure",)] * 2
