"""Claims of drgs.fitting.components.transients on a painted wall before which somebody stands in one photograph."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

import drgs
from drgs.cameras import intrinsics, look_at
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.ellipsoids import Gaussians
from drgs.files import load_state, save_state
from drgs.fitting.components.transients import TransientsComponent, line_of, masked_share, transient_masks
from drgs.fitting.frames import Frame
from drgs.fitting.losses import Photometric
from drgs.fitting.records import check_checkpoint
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.integrator import Output
from drgs.train import FitConfig, fit

SIZE = 48
VIEWS = 8
FAST = drgs.RenderSettings.preset("fast")
GSPLAT = drgs.RenderSettings.preset("gsplat")


def wall(brighter: float = 0.0) -> Gaussians:
    """A painted wall at z = 0; `brighter` adds to the colors of its right half."""
    x, y = (a.reshape(-1) for a in np.meshgrid(*2 * [np.linspace(-2, 2, 20)]))
    colors = 0.45 + 0.25 * np.stack([np.sin(3 * x), np.cos(2 * y + x), np.sin(2 * x * y)], axis=1)
    colors += brighter * (x > 0)[:, None]
    sh = torch.from_numpy((colors - 0.5) * math.sqrt(4 * math.pi)).float()
    means = torch.from_numpy(np.stack([x, y, 0 * x], axis=1)).float()
    quats = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(len(x), 1)
    return Gaussians.from_arrays(means, quats, torch.full((len(x), 3), 0.13), torch.full((len(x),), 0.95), sh)


def photographs(person: bool = True) -> tuple[list[Frame], torch.Tensor]:
    """Photographs of the wall, and where somebody in red stands in that of number 3."""
    there = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    there[10:40, 18:28] = True
    frames = []
    for i, angle in enumerate(np.linspace(0, 2 * math.pi, VIEWS, endpoint=False)):
        pose = look_at((math.cos(angle), math.sin(angle), -3.0), target=(0, 0, 0), up=(0, -1, 0))
        camera = drgs.Camera(intrinsics(55.0, 55.0, SIZE / 2, SIZE / 2), pose, width=SIZE, height=SIZE, name=str(i))
        pixels = drgs.render(wall(), camera, FAST).rgb.clamp(0, 1)
        if person and i == 3:
            pixels = torch.where(there[..., None], torch.tensor([0.9, 0.1, 0.1]), pixels)
        frames.append(Frame(str(i), camera, pixels))
    return frames, there


def trainer_of(frames: list[Frame], **fields) -> Trainer:
    """A fit whose first Gaussians are gray and on the wall."""
    short = {"max_steps": 88, "max_gaussians": 400, "sh_degree": 0, "renderers": ("fast",), "dc_rate": 0.03}
    short["transients"] = "auto"
    points = wall().means
    rows = GaussianRows.from_points(points, torch.full((len(points), 3), 0.5), 0.8)
    return Trainer(FitConfig().replace(**short | fields), frames, rows, 3.0)


def run_to(trainer: Trainer, step: int) -> list[dict]:
    """The events of looks until then."""
    events = []
    while trainer.step_index < step:
        events += [event for event in trainer.step().events if event["event"] == "transients"]
    return events


@pytest.mark.parametrize("settings", [FAST, GSPLAT], ids=["fast", "gsplat"])
def test_what_one_photograph_shows_is_found(settings):
    """Its mask covers the person and at most two pixels around, the other photographs have none."""
    frames, there = photographs()
    masks, shares = transient_masks(frames, wall(), settings)
    found = masks[3]
    assert float(found[there].float().mean()) > 0.98
    assert not found[:8].any()
    assert not found[42:].any()
    assert not found[:, :16].any()
    assert not found[:, 30:].any()
    assert shares[3] > 0.8 * float(there.float().mean())
    assert not any(mask.any() for i, mask in enumerate(masks) if i != 3)


def test_what_is_not_fitted_yet_is_not_found():
    """A half of the wall that is off by 0.3 in every photograph is no transient, and the person still is."""
    frames, there = photographs()
    masks, shares = transient_masks(frames, wall(brighter=-0.3), FAST)
    assert max(share for i, share in enumerate(shares) if i != 3) < 0.025
    assert float(masks[3][there].float().mean()) > 0.7


def test_exposure_is_not_found():
    """A photograph of 0.7 times the light, and warmer, has no mask."""
    frames, _ = photographs(person=False)
    frames[5].pixels = frames[5].pixels * torch.tensor([0.7, 0.65, 0.5])
    masks, shares = transient_masks(frames, wall(), FAST)
    assert not any(mask.any() for mask in masks)
    assert max(shares) == 0


def test_outside_of_masks_nothing_is_looked_for():
    """The person is outside the mask of the photograph."""
    frames, there = photographs()
    frames[3].mask = (~there).float()
    masks, _ = transient_masks(frames, wall(), FAST)
    assert float(masks[3][there].float().mean()) < 0.05


def test_the_loss_leaves_it_out():
    """Gradients are exactly 0 where the mask is and others elsewhere; without a mask the loss is what it was."""
    frames, there = photographs()
    frame = dataclasses.replace(frames[3], transient=there)
    rgb = torch.rand(SIZE, SIZE, 3).requires_grad_()
    Photometric(0.2)(Output(rgb, torch.ones(SIZE, SIZE)), frame, wall()).backward()
    assert float(rgb.grad[there].abs().max()) == 0
    assert float(rgb.grad[~there].abs().min()) > 0


def test_auto_decides_by_evidence():
    """At the first look somebody is found in one photograph of eight, which the next look agrees with."""
    frames, there = photographs()
    trainer = trainer_of(frames)
    events = run_to(trainer, 45)
    assert [event["found"] for event in events] == [True, True]
    assert events[0]["photographs"] == 1
    assert line_of(events[0]).startswith(f"1 of {VIEWS} photographs show")
    assert masked_share(frames)["masked"] == 1
    assert float(frames[3].transient[there].float().mean()) > 0.7


@pytest.mark.same_bits
def test_a_clean_fit_has_the_same_bits():
    """One look, nothing found, and the Gaussians of a fit that never looked."""
    ends = []
    for use in ("auto", "keep"):
        frames, _ = photographs(person=False)
        trainer = trainer_of(frames, transients=use)
        found = [event["found"] for event in run_to(trainer, 36)]
        assert found == ([False] if use == "auto" else [])
        assert all(frame.transient is None for frame in frames)
        ends.append(trainer.rows.state())
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def test_few_photographs_or_steps_are_not_looked_at():
    """Three photographs have too few neighbors, and each must have been fitted four times."""
    looks = TransientsComponent()
    assert not looks.is_due("mask", 45, 120, 3)
    assert looks.is_due("mask", 45, 120, 11)
    assert not looks.is_due("mask", 45, 120, 12)
    assert not looks.is_due("mask", 46, 120, 11)
    assert looks.is_due("mask", 60, 120, 12)
    assert not looks.is_due("keep", 60, 120, 12)


@pytest.mark.same_bits
def test_resumed_fit_goes_on_with_its_masks(tmp_path):
    """A fit from a checkpoint after the first look ends as the one that was not interrupted."""
    frames, _ = photographs()
    whole = trainer_of(frames)
    run_to(whole, 34)
    tensors, header = whole.state()
    header |= {"point_source": "the wall"}
    save_state(tmp_path / "state.safetensors", tensors, header)
    run_to(whole, 40)
    tensors, header = load_state(tmp_path / "state.safetensors")
    check_checkpoint(tmp_path / "state.safetensors", tensors, header)
    again = Trainer.from_state(whole.config, photographs()[0], tensors, header, "here")
    assert again.component("transients").present
    run_to(again, 40)
    one, two = whole.rows.state(), again.rows.state()
    assert all(torch.equal(one[name], two[name]) for name in one)
    bad = {**tensors, "transient.3": tensors["transient.3"][1:].clone()}
    with pytest.raises(ValueError, match="transient.3 must have the size"):
        Trainer.from_state(whole.config, photographs()[0], bad, header, "here")
    with pytest.raises(ValueError, match="transient.3 must be torch.uint8"):
        check_checkpoint(tmp_path / "x", {**tensors, "transient.3": tensors["transient.3"].float()}, header)


def test_a_run_says_what_was_left_out(tmp_path):
    """log.jsonl has every look with its evidence, and metrics.json how much was left out at the end."""
    frames, _ = photographs()
    views = []
    for frame in frames:
        write_png(tmp_path / f"{frame.name}.png", frame.pixels.numpy())
        views.append(View(camera=frame.camera, name=frame.name, image_path=tmp_path / f"{frame.name}.png"))
    points = wall().means.double().numpy()
    data = Dataset(tmp_path, "transforms", views, points, np.full(points.shape, 0.5, np.float32), "made for a test")
    fields = {
        "max_steps": 88,
        "max_gaussians": 400,
        "sh_degree": 0,
        "renderers": ("fast",),
        "dc_rate": 0.03,
        "test_every": 0,
        "transients": "auto",
    }
    result = fit(data, tmp_path / "run", FitConfig().replace(**fields, initial_opacity=0.8), progress=False)
    looks = [event for event in result.run.events() if event["event"] == "transients"]
    assert [look["step"] for look in looks] == [33, 44, 55, 66, 77]
    assert looks[0]["found"]
    assert result.metrics["transients"]["masked"] == 1
    assert 0.05 < VIEWS * result.metrics["transients"]["share"] < 0.25
