"""Findings of the expected error at the end of a capture: each part of it where it is, with its own remedy."""

from __future__ import annotations

import math
import types

import numpy as np
import pytest
import torch

import drgs
from drgs.cameras import Camera, intrinsics, look_at
from drgs.capturing.expected_errors import findings_of, of_expected_error
from drgs.capturing.fit import _of_expected_error
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast")
SIZE = 54


def camera_at(eye, name: str) -> Camera:
    return Camera(intrinsics(70, 70, SIZE / 2, SIZE / 2), look_at(eye, (0, 0, 0), (0, 0, 1)), SIZE, SIZE, name=name)


def on_ring(degrees: float, height: float, name: str) -> Camera:
    angle = math.radians(degrees)
    return camera_at((3 * math.cos(angle), 3 * math.sin(angle), height), name)


def wall(n: int, x: tuple[float, float], seed: int) -> drgs.Gaussians:
    """Gaussians of many colors on the plane y = 0, from x to x, that hide what is behind."""
    draw = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=draw) * torch.tensor([x[1] - x[0], 0.02, 2.4]) + torch.tensor([x[0], 0, -1.2])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    scales = torch.full((n, 3), 0.13) * torch.tensor([1, 0.1, 1])
    colors = torch.rand(n, 1, 3, generator=draw) * 3 - 1.5
    return drgs.Gaussians.from_arrays(means, quats, scales, torch.full((n,), 0.97), colors)


@pytest.fixture(scope="module")
def seen():
    """A wall, twelve photographs from in front of it, and what they show."""
    g = wall(700, (-1.6, 1.6), 0)
    cameras = [
        camera_at((0.25 * x - 0.37, -2.5, 0.25 * z - 0.25), f"IMG_{i:02d}") for i, (x, z) in enumerate(np.ndindex(4, 3))
    ]
    return g, cameras, [drgs.render(g, camera, FAST).rgb.clamp(0, 1) for camera in cameras]


def by_kind(found) -> dict[str, str]:
    return {finding.kind: finding.line() for finding in found}


def test_a_photograph_that_disagrees(seen):
    """Where something moved in one photograph, this is named, and what to do with it; elsewhere nothing is wrong."""
    g, cameras, images = seen
    moved = [image + 0.02 * (-1) ** i for i, image in enumerate(images)]
    moved[4] = moved[4].clone()
    moved[4][:18, :18] = 1 - moved[4][:18, :18]
    found = by_kind(findings_of(g, drgs.error_record(g, cameras, moved, FAST), cameras))
    assert found["misfit"].startswith("the top left of IMG_"), found
    assert "as IMG_04 shows it unlike the other photographs (off by 0." in found["misfit"]
    assert "look at IMG_04: mask what moved" in found["misfit"]


def test_what_no_photograph_is_matched_in(seen):
    """Where the fit misses in all of them: steps, or Gaussians where there are as many as there may be."""
    g, cameras, images = seen
    wrong = g.sh.clone()
    wrong[(g.means[:, 0] < -0.4) & (g.means[:, 2] < -0.3)] += 1
    fitted = g.replace(sh=wrong)
    record = drgs.error_record(fitted, cameras, images, FAST)
    line = by_kind(findings_of(fitted, record, cameras))["misfit"]
    assert line.startswith("the bottom left of IMG_")
    assert "as the fit does not match the 12 photographs of it" in line
    assert "fit with more steps" in line
    assert "700 Gaussians" not in line
    line = by_kind(findings_of(fitted, record, cameras, is_full=True))["misfit"]
    assert "with all 700 Gaussians that it may have" in line
    assert "fit with more Gaussians and steps: give a larger --budget" in line


def test_a_direction_that_is_missing():
    """Photographs around a third of a ball: the next one is past the end of their ring, or above or below it."""
    draw = torch.Generator().manual_seed(1)
    means = 0.7 * torch.nn.functional.normalize(torch.randn(500, 3, generator=draw), dim=1)
    colors = torch.rand(500, 1, 3, generator=draw) * 3 - 1.5
    ball = drgs.Gaussians.from_arrays(
        means, torch.randn(500, 4, generator=draw), torch.full((500, 3), 0.07), torch.full((500,), 0.95), colors
    )
    cameras = [on_ring(15 * i, 0.3 * (i % 2), f"IMG_{i:02d}") for i in range(9)]
    images = [drgs.render(ball, x, FAST).rgb.clamp(0, 1) + 0.04 * (-1) ** i for i, x in enumerate(cameras)]
    line = by_kind(findings_of(ball, drgs.error_record(ball, cameras, images, FAST), cameras))["direction"]
    assert "seen from elsewhere: expected error 0." in line
    assert "as photographs from there are missing; take one: go where IMG_0" in line
    past_the_end = ("where IMG_00" in line and "to the left" in line) or (
        "where IMG_08" in line and "to the right" in line
    )
    assert past_the_end or "higher" in line or "lower" in line


def test_what_no_photograph_shows(seen):
    """Past the end of what photographs show; not where masks leave it out."""
    g, cameras, images = seen
    line = by_kind(findings_of(g, drgs.error_record(g, cameras, images, FAST), cameras))["unseen"]
    assert line.startswith("beside what IMG_")
    assert "as no photograph shows what is there; if it should be seen, photograph it: go where IMG_" in line
    small = wall(200, (-0.4, 0.4), 2)
    shown = [drgs.render(small, camera, FAST) for camera in cameras]
    images = [out.rgb.clamp(0, 1) for out in shown]
    masks = [(out.alpha > 0.5).float() for out in shown]
    record = drgs.error_record(small, cameras, images, FAST, masks=masks)
    assert "unseen" not in by_kind(findings_of(small, record, cameras))


def test_a_photograph_alone(seen):
    """Of a single photograph there are findings, too, if there is nothing to compare it with."""
    g, cameras, images = seen
    record = drgs.error_record(g, cameras[:1], [1 - images[0]], FAST)
    found = by_kind(findings_of(g, record, cameras[:1]))
    assert "misfit" not in found  # of a whole picture that is alike nothing is worse than usual
    assert "IMG_00" in found["direction"]
    half = images[0].clone()
    half[:18, :18] = 1 - half[:18, :18]
    record = drgs.error_record(g, cameras[:1], [half], FAST)
    assert "does not match the only photograph of it" in by_kind(findings_of(g, record, cameras[:1]))["misfit"]


def test_photographs_that_are_gone(monkeypatch):
    """One line says so, and the capture goes on."""

    def gone(*args, **options):
        raise FileNotFoundError("scene: must still hold photograph 'IMG_0001', it is gone; restore it")

    said = []
    monkeypatch.setattr("drgs.capturing.fit.of_expected_error", gone)
    capture = types.SimpleNamespace(run=None, refined_dataset=lambda: None, say=said.append)
    assert _of_expected_error(capture) == []
    (line,) = said
    assert line == (
        "fit: it cannot be said where it is wrong, scene: must still hold photograph 'IMG_0001', it is gone; restore it"
    )


def test_what_moves_has_no_place_to_go():
    assert of_expected_error(None, types.SimpleNamespace(times=(0.0, 1.0))) == []
