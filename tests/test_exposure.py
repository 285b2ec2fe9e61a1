"""Claims of components.exposure: gains are recovered, the gauge holds exactly, and a fit with gains goes on."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
import torch
from test_active_unknowns import GAINS, VIEWS, write_photographs
from test_train import config, dataset  # noqa: F401 (a fixture)

from drgs.cameras import orbit
from drgs.data import load
from drgs.files import load_state
from drgs.fitting import start as starting
from drgs.fitting.components import exposure as exposures
from drgs.fitting.components.base import Setup
from drgs.fitting.components.exposure import Exposure, Meter, exposure_network
from drgs.fitting.evaluation import evaluate_run
from drgs.fitting.exposures import estimate_exposure
from drgs.fitting.frames import Frame
from drgs.fitting.records import fit_record
from drgs.fitting.resume import lock_run
from drgs.tracing.call import Output
from drgs.train import fit


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


def test_one_photograph_at_half_brightness_is_recovered():
    """Its gain is a half, to 2 %, those of the others are equal; nothing of it is taken for another color."""
    gains = np.ones((8, 3))
    gains[3] = 0.5
    found = estimate_exposure(*_photographs(gains, 0.1))
    relative = np.exp(found.log_gains - np.delete(found.log_gains, 3, axis=0).mean(axis=0))
    assert np.abs(relative - gains).max() < 0.02
    assert found.is_confirmed.all()
    assert found.is_sound
    assert found.lowered > 0.5


def test_light_from_one_side_is_no_gain():
    """Where each photograph is bright on one side, as of a thing that is turned in front of a lamp, gains of points
    differ; but a gain of one half does not make the other half right, so that none is clear.
    """
    frames, points = _photographs(np.ones((8, 3)))
    rng = np.random.default_rng(1)
    for frame in frames:
        center = rng.uniform(0, 300)
        frame.pixels *= torch.exp(-(((torch.arange(300) - center) / 150) ** 2))[None, :, None]
    found = estimate_exposure(frames, points)
    assert found.is_clear
    assert not found.is_sound
    assert not found.is_confirmed.all()
    kept = found.confirmed()
    assert not kept.log_gains[~found.is_confirmed].any()
    assert np.abs(kept.log_gains.mean(axis=0)).max() < 1e-12


def test_pixels_that_show_nothing_are_not_compared():
    """A gray background that an alpha channel leaves free is that of every photograph, whatever its exposure: with it
    gains would seem nearer to 1 than they are.
    """
    gains = np.exp(np.linspace(-0.4, 0.4, 6))[:, None] * np.ones(3)
    frames, points = _photographs(gains)
    for frame in frames:
        pixels, _ = frame.camera.project(points)
        alpha = torch.zeros(300, 300)
        for x, y in pixels[:100].astype(int):
            alpha[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3] = 1
        frame.pixels = torch.where(alpha[..., None] > 0, frame.pixels, torch.tensor(0.5))
        frame.alpha = alpha
    found = estimate_exposure(frames, points)
    assert np.abs(found.log_gains - np.log(gains)).max() < 0.02


def test_gains_leave_the_background_and_what_is_saturated():
    """An empty pixel on white stays white, whatever the gain, and a half covered one stays half white; where the
    photograph is saturated, a brighter rendering is right and gets no gradient, a darker one is wrong.
    """
    frames, _ = _photographs(np.ones((2, 3)))
    gains = exposure_network(frames, False, np.log([[0.5] * 3, [2.0] * 3]), (1.0, 1.0, 1.0)).module
    rgb = torch.tensor([[1.0, 0.6, 0.7, 0.4]])[..., None].repeat(1, 1, 3).requires_grad_()
    alpha = torch.tensor([[0.0, 0.5, 1.0, 1.0]])
    photograph = torch.tensor([[1.0, 0.5, 1.0, 1.0]])[..., None].repeat(1, 1, 3)
    for frame, expected in zip(frames, ([1.0, 0.55, 0.35, 0.2], [1.0, 0.7, 1.0, 0.8]), strict=True):
        shown = dataclasses.replace(frame, pixels=photograph, alpha=alpha)
        found = gains(Output(rgb=rgb, alpha=alpha), shown).rgb
        torch.testing.assert_close(found[0, :, 0], torch.tensor(expected))
    (gradient,) = torch.autograd.grad(found.sum(), rgb)  # of the second photograph
    assert gradient[0, :, 0].tolist() == [2.0, 2.0, 0.0, 2.0]


@pytest.mark.parametrize(("gains", "told"), [((1.0, 0.5), True), ((1.0, 1.0), False)])
def test_a_fit_without_gains_says_that_photographs_differ(tmp_path, capsys, gains, told):
    """One line, before the first step, if every other photograph has half the brightness; and no gain is fitted."""
    write_photographs(tmp_path / "data", np.resize(gains, (VIEWS, 1)) * np.ones(3))
    run = fit(load(tmp_path / "data"), tmp_path / "run", config(max_steps=1), progress=True).run
    lines = [line for line in capsys.readouterr().err.splitlines() if "--exposure auto" in line]
    assert len(lines) == told
    assert not told or float(re.search(r"differ by (\S+)", lines[0])[1]) == pytest.approx(0.5, abs=0.03)
    assert "exposure" not in run.config()


def test_auto_is_as_photographs_that_short_fits_did_not_see_say(tmp_path, monkeypatch, capsys):
    """Gains that are clear by points are fitted if, and only if, such photographs gain; line and record say it."""
    monkeypatch.setitem(exposures._TRIAL, "max_steps", 20)
    write_photographs(tmp_path / "data", GAINS)
    settings = config(max_steps=1, exposure="auto")
    run = fit(load(tmp_path / "data"), tmp_path / "run", settings, progress=True).run
    found = run.config()["exposure"]
    assert found["lowered"] > 0.05
    assert (found["gained"] > 0) == ("estimated" in run.config())
    said = "each has its own" if found["gained"] > 0 else "off, all have the same"
    assert f"change by {found['gained']:+.2f} dB; {said}" in capsys.readouterr().err


def test_by_default_gains_are_tried_where_the_fit_is_long(tmp_path, monkeypatch, capsys):
    """The trial of `auto` runs unasked where it is a tenth of the fit; a shorter fit names the option instead. Each
    records what it has taken.
    """
    monkeypatch.setitem(exposures._TRIAL, "max_steps", 2)
    write_photographs(tmp_path / "data", GAINS)
    data = load(tmp_path / "data")
    long = fit(data, tmp_path / "long", config(max_steps=40), progress=True).run
    assert "gained" in long.config()["exposure"]
    assert long.config()["fit"]["data"]["exposure"] == "auto"
    assert "dB; " in capsys.readouterr().err
    short = fit(data, tmp_path / "short", config(max_steps=30), progress=True).run
    assert "exposure" not in short.config()
    assert short.config()["fit"]["data"]["exposure"] == "off"
    assert "--exposure auto" in capsys.readouterr().err


def test_matches_of_the_first_time_are_not_those_of_all_photographs(dataset, monkeypatch):  # noqa: F811
    """A fit of what stands still to views of several times makes initial points of the first time alone."""
    made = np.random.default_rng(0).random((9, 3)), np.full((9, 3), 0.5, np.float32), "made for a test"
    monkeypatch.setattr(starting, "initial_points", lambda *_: made)
    for times in ((None,) * 9, (0.0,) * 9, (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0)):
        cameras = [dataclasses.replace(dataset.views[i % 3].camera, time=time) for i, time in enumerate(times)]
        views = [dataclasses.replace(view, camera=x) for view, x in zip(dataset.views, cameras, strict=True)]
        bare = dataclasses.replace(dataset, views=views, points=None, colors=None)
        setup = Setup(bare, config(dynamics="ignore"), views, [], views, (), ())
        starting._rows_at_points(setup)
        assert (setup.matches is None) == (len(set(times)) > 1)


def test_a_meter_predicts_what_was_left_out():
    """Log gains that follow the mean color come back, and `lowered` is what refitting without each photograph gives;
    gains that follow nothing, and of few photographs, have no meter. None is predicted beyond those that were seen.
    """
    rng = np.random.default_rng(0)
    seen = rng.normal(-1, 0.5, (20, 3))
    law = np.array([[0.1, 0.0, -0.1], [-0.6, 0.1, 0.0], [0.0, -0.8, 0.2], [0.1, 0.0, -0.5]])
    terms = np.column_stack([np.ones(20), seen])
    gains = terms @ law + rng.normal(0, 0.05, (20, 3))
    meter = Meter.fitted(seen, gains, (0.0, 0.0, 0.0))
    assert np.abs(meter.coefficients - law).max() < 0.1
    left = [np.linalg.lstsq(np.delete(terms, i, 0), np.delete(gains, i, 0))[0] for i in range(20)]
    errors = gains - np.stack([terms[i] @ left[i] for i in range(20)])
    assert meter.lowered == pytest.approx(1 - np.square(errors).sum() / np.square(gains).sum(), abs=1e-9)
    assert meter.lowered > 0.9
    assert Meter.fitted(seen, rng.normal(0, 0.3, (20, 3)), (0.0, 0.0, 0.0)) is None
    assert Meter.fitted(seen[:7], gains[:7], (0.0, 0.0, 0.0)) is None
    frame = _photographs(np.ones((1, 3)))[0][0]
    dark = Output(rgb=torch.full((2, 2, 3), 1e-3), alpha=torch.ones(2, 2))
    torch.testing.assert_close(meter(dark, frame).rgb[0, 0] / 1e-3, torch.tensor(gains.max(axis=0)).exp().float())


def test_a_meter_reads_what_is_covered_and_leaves_the_background():
    """Half an image of 0.25 in front of white, by its alpha channel, is metered as 0.25; the white half stays white.
    Where nothing says what is empty, all of the image has the gain.
    """
    law = np.zeros((4, 3))
    law[1:] = np.eye(3)
    meter = Meter(law, np.full(3, -9.0), np.full(3, 9.0), (1.0, 1.0, 1.0), 1.0)
    alpha = torch.tensor([[1.0, 0.0]])
    out = Output(rgb=torch.tensor([[[0.25] * 3, [1.0] * 3]]), alpha=alpha)
    frame = _photographs(np.ones((1, 3)))[0][0]
    shown = meter(out, dataclasses.replace(frame, pixels=torch.ones(1, 2, 3), alpha=alpha)).rgb
    torch.testing.assert_close(shown[0, :, 0], torch.tensor([0.0625, 1.0]))
    torch.testing.assert_close(meter(out, frame).rgb[0, :, 0], torch.tensor([0.0625, 0.25]))


def test_held_out_views_are_metered_in_fits_and_measured_again(tmp_path, monkeypatch):
    """What a fit with gains measures of its held-out views, `drgs eval` finds again, in every renderer; without the
    meter it is something else.
    """
    monkeypatch.setattr("drgs.fitting.exposures.LEAST_LOWERED", -math.inf)
    write_photographs(tmp_path / "data", GAINS)
    settings = config(max_steps=2, exposure="points", test_every=9)
    result = fit(load(tmp_path / "data", test_every=9), tmp_path / "run", settings)
    first = result.metrics
    with lock_run(result.run, "eval") as output:
        again = evaluate_run(result.run, output)
        assert first["mean"]["psnr"] == pytest.approx(again["mean"]["psnr"], abs=1e-4)
        rows = [[row["mean"]["psnr"] for row in one["renderers"]["rows"]] for one in (first, again)]
        assert rows[0] == pytest.approx(rows[1], abs=1e-4)
        monkeypatch.setattr("drgs.fitting.exposures.LEAST_LOWERED", math.inf)
        assert abs(evaluate_run(result.run, output)["mean"]["psnr"] - first["mean"]["psnr"]) > 0.01


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
