"""errors.safetensors: the record of a run's errors is read in place of photographs, if it is of the run's scene."""

from __future__ import annotations

import shutil

import pytest
import torch
from test_active import config, plan, write_still
from test_dynamic_fit import _small_field  # noqa: F401 (fixture)
from test_dynamic_fit import config as moving_config
from test_dynamic_fit import dataset as moving_dataset  # noqa: F401 (fixture)

import drgs
from drgs.data import load
from drgs.files import load_state, save_state
from drgs.fitting import errors
from drgs.fitting.errors import run_error_record, saved_error_record
from drgs.fitting.records import load_run
from drgs.io.run import Run
from drgs.settings import RenderSettings
from drgs.train import fit

FAST = RenderSettings.preset("fast")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run, and one of fewer steps, on six of the same nine photographs."""
    folder = tmp_path_factory.mktemp("errors")
    write_still(folder / "data")
    for steps in (12, 6):
        fit(load(folder / "data"), folder / f"{steps}", config(max_steps=steps), progress=False)
    return folder


@pytest.fixture
def run(fitted, tmp_path):
    """A copy of the first run."""
    shutil.copytree(fitted / "12", tmp_path / "run")
    return Run(tmp_path / "run")


@pytest.fixture
def decoded(monkeypatch):
    """How many photographs were decoded by each record that was made."""
    made = []
    real = errors.frames_for
    monkeypatch.setattr(errors, "frames_for", lambda views, *rest: made.append(len(views)) or real(views, *rest))
    return made


def same(a, b) -> bool:
    """Whether records are equal to the float32 that a file keeps."""
    tensors, others = a.to_state()[0], b.to_state()[0]
    assert tensors.keys() == others.keys()
    return all(torch.allclose(x.double(), others[name].double(), rtol=1e-5, atol=1e-12) for name, x in tensors.items())


def test_a_fit_leaves_its_record(run, decoded):
    """It is what photographs give once more, and is read in place of them, from all or from fewer."""
    saved = run_error_record(run, FAST)
    assert run_error_record(run, FAST, most=3).views == saved.views == 6
    assert decoded == []
    (event,) = [event for event in run.events() if event["event"] == "errors"]
    assert event["photographs"] == 6
    assert event["misfit"] == pytest.approx(saved.mean_misfit**0.5)
    run.errors.unlink()
    again = run_error_record(run, FAST)
    assert decoded == [6]
    assert same(saved, again)
    run_error_record(run, FAST)
    assert decoded == [6]  # kept, as of an older run


def of_another_scene(run, fitted):
    shutil.copy(fitted / "6/errors.safetensors", run.errors)


def of_three(run, _):
    run.errors.unlink()
    run_error_record(run, FAST, most=3)


def damaged(run, _):
    run.errors.write_bytes(run.errors.read_bytes()[:900])


def of_other_sums(run, _):
    tensors, header = load_state(run.errors)
    del tensors["contrast"]
    save_state(run.errors, tensors, header)


@pytest.mark.parametrize("changed", [of_another_scene, of_three, damaged, of_other_sums])
def test_what_is_not_of_this_scene_is_made_anew(run, fitted, decoded, caplog, changed):
    """And what is damaged, which is said."""
    right = run_error_record(run, FAST)
    changed(run, fitted)
    decoded.clear()
    assert same(run_error_record(run, FAST), right)
    assert decoded == [6]
    assert ("is made anew" in caplog.text) == (changed in (damaged, of_other_sums))


def test_other_settings_and_sizes_are_made_anew(run, decoded):
    """The record of the fit is not theirs, and stays."""
    settings = FAST.replace(background=(1.0, 0.0, 0.0))
    assert run_error_record(run, settings).settings == settings
    run_error_record(run, FAST, max_pixels=100)
    assert decoded == [6, 6]
    assert run_error_record(run, FAST).settings == FAST
    assert decoded == [6, 6]


def test_where_nothing_can_be_written(run, decoded, monkeypatch):
    """The record is made all the same."""
    run.errors.unlink()

    def refused(*_):
        raise ValueError("another process writes there")

    monkeypatch.setattr(errors, "lock_run", refused)
    assert run_error_record(run, FAST).views == 6
    assert not run.errors.exists()


def test_it_is_updated_as_a_fit_goes(fitted, tmp_path, monkeypatch):
    """At checkpoints, once enough steps have passed since the last; of active fits, of what was picked by then."""
    monkeypatch.setattr(errors, "_STEPS_A_PHOTOGRAPH", 1)
    run = fit(load(fitted / "data"), tmp_path / "a", config(max_steps=24, save_every=4), progress=False).run
    steps = [event["step"] for event in run.events() if event["event"] == "errors"]
    assert steps == [8, 16, 24]  # six photographs
    active = config(max_steps=12, selection=plan())
    run = fit(load(fitted / "data", lazy=True, points=False), tmp_path / "b", active, progress=False).run
    scene = load_run(run).scene
    assert saved_error_record(run, scene, FAST, 130_000, 4).views == 4
    assert saved_error_record(run, scene, FAST, 130_000, 5) is None


def test_of_what_moves(moving_dataset, tmp_path):  # noqa: F811
    """The file belongs to the Gaussians and to what moves them."""
    run = fit(moving_dataset, tmp_path / "run", moving_config(max_steps=8), progress=False).run
    loaded = load_run(run)
    pixels = loaded.record.config.data.max_pixels
    assert isinstance(loaded.scene, drgs.DynamicGaussians)
    assert saved_error_record(run, loaded.scene, loaded.record.config.settings, pixels, 1) is not None
    with torch.no_grad():
        next(loaded.scene.field.parameters()).add_(1e-3)
    assert saved_error_record(run, loaded.scene, loaded.record.config.settings, pixels, 1) is None
