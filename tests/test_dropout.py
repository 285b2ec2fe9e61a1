"""Claims of drgs.fitting.components.dropout: who is left out of a step, of which fits, and that off is off."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from resuming import stopped_and_resumed
from test_train import config, dataset, scene  # noqa: F401 (a fixture)

from drgs.fitting.components.base import Setup
from drgs.fitting.components.dropout import DropoutComponent, fewer
from drgs.fitting.components.table import components_of
from drgs.fitting.frames import load_frames
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.io.checkpoint import load_state
from drgs.train import fit


def trainer_of(dataset, with_row=True, photographs=6, **fields) -> Trainer:  # noqa: F811
    """A fit as `drgs fit` begins it, or without the row of the table."""
    cfg = config(**fields)
    views = dataset.views[:photographs]
    frames = load_frames(views, cfg.data.max_pixels)
    g = scene()
    rows = GaussianRows.from_points(g.means, torch.full((len(g), 3), 0.5), 0.8)
    components = [x for x in components_of() if with_row or x.name != "dropout"]
    return Trainer(cfg, frames, rows, 3.0, components, Setup(dataset, cfg, views, [], views, (), components))


def run_to(trainer: Trainer, step: int) -> Trainer:
    while trainer.step_index < step:
        trainer.step()
    return trainer


def same(one: Trainer, other: Trainer) -> bool:
    return all(torch.equal(x, other.rows.tensors[name]) for name, x in one.rows.tensors.items())


def test_opacities_of_those_kept_stand_for_those_left_out():
    """Divided by the share that is kept, below 1; gradients reach those that are kept alone."""
    g = scene(4)
    logits = torch.logit(torch.tensor([0.1, 0.3, 0.5, 0.9])).requires_grad_()
    few = fewer(g.replace(logit_opacities=logits), torch.tensor([0, 2, 3]), 0.5)
    assert torch.allclose(few.opacities, torch.tensor([0.2, 1.0, 1.0]), atol=1e-4)
    assert torch.isfinite(few.logit_opacities).all()
    assert torch.equal(few.means, g.means[[0, 2, 3]])
    fewer(g.replace(logit_opacities=logits), torch.tensor([0, 1]), 0.5).opacities.sum().backward()
    assert torch.allclose(logits.grad[:2], 2 * torch.tensor([0.1 * 0.9, 0.3 * 0.7]), atol=1e-5)
    assert not logits.grad[2:].any()
    faint = torch.tensor([-200.0, -95.0, 0.0, 0.0]).requires_grad_()  # opacities that are 0 in float32
    found = fewer(g.replace(logit_opacities=faint), torch.tensor([0, 1]), 0.4).logit_opacities
    found.sum().backward()
    assert torch.allclose(found, torch.tensor([-199.489, -94.489]), atol=1e-3)
    assert torch.allclose(faint.grad[:2], torch.ones(2))


def test_the_share_rises_to_what_is_given_and_far_gaussians_stay(dataset):  # noqa: F811
    trainer = trainer_of(dataset, dropout=0.5, max_steps=40)
    trainer.rows.far = 8
    component: DropoutComponent = trainer.component("dropout")
    shares = []
    for trainer.step_index in range(40):
        component.before_step(trainer)
        kept = torch.arange(len(trainer.rows)) if component._kept is None else component._kept
        assert torch.equal(kept[:8], torch.arange(8))
        shares.append(1 - (len(kept) - 8) / (len(trainer.rows) - 8))
    assert shares[0] == 0
    assert sum(shares[:10]) < sum(shares[-10:])
    assert sum(shares[-10:]) / 10 == pytest.approx(0.5 * 35 / 40, abs=0.1)


@pytest.mark.same_bits
@pytest.mark.parametrize("fields", [{"dropout": 0.0}, {"dropout": None, "photographs": 4}], ids=["off", "many"])
def test_off_has_the_bits_of_a_fit_without_it(dataset, fields):  # noqa: F811
    """So has `auto` where there are more photographs than it looks at."""
    fields = fields | {"max_steps": 6}
    assert same(*(run_to(trainer_of(dataset, with_row=x, **fields), 6) for x in (True, False)))


def test_auto_is_for_three_photographs_of_a_scene_at_rest(dataset):  # noqa: F811
    """Not for four, nor where others are chosen on the way or things move."""
    trainer = trainer_of(dataset, photographs=3, dropout=None)
    component: DropoutComponent = trainer.component("dropout")
    setup = Setup(dataset, trainer.config, [], [], [], (), trainer.components)
    assert component.share == 0.4
    assert trainer_of(dataset, photographs=4, dropout=None).component("dropout").share == 0
    for other in ({"modes": frozenset({"selection"})}, {"times": (0.0, 1.0)}):
        component.start(trainer, dataclasses.replace(setup, **other))
        assert component.share == 0


@pytest.mark.same_bits
@pytest.mark.parametrize("share", [0.4, None], ids=["given", "auto"])
def test_a_fit_goes_on_with_the_same_bits(dataset, tmp_path, share):  # noqa: F811
    """Killed and resumed while Gaussians are left out; files have the share."""
    three = dataclasses.replace(dataset, views=dataset.views[:4])
    cfg = config(dropout=share, max_steps=20, save_every=5, test_every=4, deterministic=True, seed=3)
    whole = fit(three, tmp_path / "whole", cfg, progress=False)
    stopped_and_resumed(lambda: three, tmp_path / "stopped", cfg, 12)
    (one, header), (other, _) = (load_state(tmp_path / x / "state.safetensors") for x in ("whole", "stopped"))
    assert all(torch.equal(x, other[name]) for name, x in one.items())
    assert header["dropout"] == whole.metrics["dropout"] == 0.4
