"""Claims of drgs.fitting.components.pruning: who is removed, when, that moments stay, and that off is off."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from resuming import stopped_and_resumed
from test_dropout import run_to, same
from test_train import config, dataset, scene  # noqa: F401 (a fixture)

from drgs.fitting.components.base import Setup
from drgs.fitting.components.exposure import exposure_network
from drgs.fitting.components.table import components_of
from drgs.fitting.frames import load_frames
from drgs.fitting.losses import psnr
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.integrator import render
from drgs.io.checkpoint import load_state
from drgs.settings import RenderSettings
from drgs.train import fit


def trainer_of(dataset, with_row=True, **fields) -> Trainer:  # noqa: F811
    cfg = config(max_steps=20, **fields)
    frames = load_frames(dataset.views, cfg.data.max_pixels)
    g = scene()
    rows = GaussianRows.from_points(g.means, torch.full((len(g), 3), 0.5), 0.8)
    components = [x for x in components_of() if with_row or x.name != "pruning"]
    setup = Setup(dataset, cfg, dataset.views, [], dataset.views, (), components)
    return Trainer(cfg, frames, rows, 3.0, components, setup)


def mean_psnr(trainer: Trainer) -> float:
    fast = RenderSettings.preset("fast")
    found = [psnr(render(trainer.gaussians(), x.camera, fast).rgb.clamp(0, 1), x.image()) for x in trainer.frames]
    return sum(found) / len(found)


def test_superfluous_gaussians_go_when_density_control_ends(dataset):  # noqa: F811
    """As many as the loss allows; the others keep values and moments, and far ones all stay. None come back."""
    trainer = run_to(trainer_of(dataset, prune_loss=0.3, refine_stop=0.8), 16)
    trainer.rows.far = 3
    before, old = mean_psnr(trainer), trainer.rows.state()
    (event,) = trainer.component("pruning").before_density(trainer)
    left = len(trainer.rows)
    assert event == {"event": "pruned", "before": len(old["parameter.means"]), "gaussians": left}
    assert left < event["before"]
    assert mean_psnr(trainer) >= before - 0.3
    places = [(old["parameter.means"] == x).all(1).nonzero()[0, 0] for x in trainer.rows.tensors["means"].detach()]
    assert [int(x) for x in places[:3]] == [0, 1, 2]
    for name, x in trainer.rows.state().items():
        assert torch.equal(x, old[name][torch.stack(places)] if x.dim() else old[name]), name
    assert trainer.component("pruning").before_density(trainer) == []
    assert len(run_to(trainer, 20).rows) == left


def test_a_fit_with_more_steps_does_not_grow_again(dataset):  # noqa: F811
    """Where the clock gives it twice the steps, density control would be due again by its share of them."""
    trainer = run_to(trainer_of(dataset, prune_loss=0.3, refine_stop=0.8), 18)
    left, (before, _) = len(trainer.rows), trainer.component("pruning").counts
    trainer.reschedule(40)
    events = [event["event"] for _ in range(14) for event in trainer.step().events]
    assert "density" not in events
    assert len(trainer.rows) == left < before


def test_photographs_are_compared_by_their_exposure(dataset):  # noqa: F811
    """At half the brightness, with gains that say so, as many go as at their own; without gains others would."""
    left = []
    for brightness, gain in ((1.0, 1.0), (0.5, 0.5), (0.5, 1.0)):
        trainer = trainer_of(dataset, prune_loss=1.0, refine_stop=0.8)
        g = scene()
        trainer.rows = GaussianRows(
            {name: getattr(g, name) for name in ("means", "quats", "log_scales", "logit_opacities")}
            | {"sh_dc": g.sh[:, :1], "sh_rest": g.sh[:, 1:]},
            g.origin,
        )
        trainer.step_index = 16
        for frame in trainer.frames:
            frame.pixels = brightness * (0.8 * frame.image() + 0.05)
        gains = torch.full((len(trainer.frames), 3), math.log(gain)).numpy()
        trainer.component("exposure").module = exposure_network(trainer.frames, False, gains).module
        (event,) = trainer.component("pruning").before_density(trainer)
        left.append(event["gaussians"])
    assert left[0] == left[1] != left[2]


def test_a_photograph_whose_mask_keeps_nothing_is_left_out(dataset):  # noqa: F811
    """It has no PSNR: a fit must not end in an error, with most of its steps done."""
    trainer = run_to(trainer_of(dataset, prune_loss=0.3, refine_stop=0.8), 16)
    trainer.frames[0].mask = torch.zeros(trainer.frames[0].pixels.shape[:2])
    (event,) = trainer.component("pruning").before_density(trainer)
    assert event["gaussians"] < event["before"]


def test_density_control_must_end_before_the_fit(dataset, tmp_path):  # noqa: F811
    """Else nothing would ever be removed."""
    with pytest.raises(ValueError, match="refine_stop must be below 1 for prune_loss"):
        fit(dataset, tmp_path / "run", config(prune_loss=0.3, refine_stop=1.0), progress=False)


@pytest.mark.same_bits
def test_off_has_the_bits_of_a_fit_without_it(dataset):  # noqa: F811
    assert same(*(run_to(trainer_of(dataset, with_row=x), 20) for x in (True, False)))


@pytest.mark.same_bits
@pytest.mark.parametrize("step", [12, 18], ids=["before", "after"])
def test_a_fit_goes_on_with_the_same_bits(dataset, tmp_path, step):  # noqa: F811
    """Killed and resumed before and after Gaussians are removed; files say how many were."""
    few = dataclasses.replace(dataset, views=dataset.views[:4])
    cfg = config(prune_loss=0.3, max_steps=20, save_every=5, test_every=4, deterministic=True, seed=3)
    whole = fit(few, tmp_path / "whole", cfg, progress=False)
    stopped_and_resumed(lambda: few, tmp_path / "stopped", cfg, step)
    (one, header), (other, _) = (load_state(tmp_path / x / "state.safetensors") for x in ("whole", "stopped"))
    assert all(torch.equal(x, other[name]) for name, x in one.items())
    before, left = header["pruned"]
    assert whole.metrics["pruned"] == {"before": before, "gaussians": left}
    assert len(one["parameter.means"]) == left < before
