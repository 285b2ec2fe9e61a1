"""The color behind everything: its cells, its information, its variance, and what it is worth in a score."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import drgs
from drgs import fisher
from drgs.cameras import Camera, intrinsics_from_fov, look_at, orbit
from drgs.gain import Prior, information_gain, variances
from drgs.information.background import CELLS, background_cells
from drgs.select import select
from drgs.settings import RenderSettings

SETTINGS = RenderSettings.preset("exact")


@pytest.fixture(scope="module")
def blob():
    """A single half-open Gaussian at the origin."""
    return drgs.Gaussians.from_arrays([[0.0, 0, 0]], [[1.0, 0, 0, 0]], [[0.3] * 3], [0.8], np.zeros((1, 1, 3)))


@pytest.fixture(scope="module")
def ring():
    return [
        dataclasses.replace(camera, name=f"{i}")
        for i, camera in enumerate(orbit((0, 0, 0), 3.0, 8, width=24, height=18))
    ]


def test_cells_are_about_as_large():
    """Directions all over the sphere fall into all cells; none is more than twice as large as another, and cameras in
    one place that look elsewhere agree about a direction.
    """
    K, size = intrinsics_from_fov(90.0, width=160, height=160), 160
    axes = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    cameras = [Camera(K, look_at((0, 0, 0), axis, np.roll(np.abs(axis), 1)), size, size) for axis in axes]
    solid = np.concatenate([(1 / np.linalg.norm(rays_of(c), axis=-1) ** 3).ravel() for c in cameras])
    areas = np.bincount(np.concatenate([background_cells(c).numpy().ravel() for c in cameras]), solid, CELLS)
    assert areas.min() > 0
    assert areas.max() < 2 * areas.min()
    tilted = Camera(K, look_at((0, 0, 0), (1, 0.4, 0.2), (0, 0, 1)), size, size)
    direction = tilted.pixel_directions()[40, 70]
    pixel, _ = cameras[0].project(direction[None])
    column, row = np.floor(pixel[0]).astype(int)
    assert int(background_cells(tilted)[40, 70]) == int(background_cells(cameras[0])[row, column])


def rays_of(camera):
    """Directions of pixels whose part along the axis is 1."""
    rays = camera.pixel_directions()
    return rays / (rays @ camera.c2w[:3, 2])[..., None]


def test_information_is_the_squared_derivative(blob, ring):
    """An image is linear in the background, with 1 - alpha; what a view says adds up over its pixels and over views."""
    camera, lit = ring[0], SETTINGS.replace(background=(1.0, 1.0, 1.0))
    with torch.no_grad():
        slope = (drgs.render(blob, camera, lit).rgb - drgs.render(blob, camera, SETTINGS).rgb)[..., 0].double()
    H = fisher.background(blob, camera, SETTINGS)
    cells = background_cells(camera)
    truth = torch.zeros(CELLS, dtype=torch.float64).index_add_(0, cells.flatten(), slope.square().flatten())
    torch.testing.assert_close(H, truth[:, None].expand(-1, 3), rtol=1e-4, atol=1e-5)
    assert 0.1 < float(H.sum()) / (3 * cells.numel()) < 1
    both = fisher.background(blob, ring[:2], SETTINGS)
    torch.testing.assert_close(both, H + fisher.background(blob, ring[1], SETTINGS))
    weighted = fisher.background(blob, camera, SETTINGS, channel_weights=(1.0, 0.5, 0.0))
    torch.testing.assert_close(weighted, H * torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))


def test_variance_is_high_where_nothing_was_seen(blob, ring):
    """A pixel's variance adds up to `eig` of the group; what a known view has looked through is known."""
    known, new = ring[0], ring[4]
    H, prior = {"background": fisher.background(blob, known, SETTINGS)}, Prior(1e-2)
    found = fisher.variance_map(blob, new, variances(H, prior), SETTINGS)
    Hc = {"background": fisher.background(blob, new, SETTINGS)}
    assert float(found.double().sum()) == pytest.approx(information_gain(Hc, H, "eig", prior).total, rel=1e-5)
    again = fisher.variance_map(blob, known, variances(H, prior), SETTINGS)
    assert float(again.max()) < 0.1 * float(found.max())
    assert found[9, 12] < found[0, 0], "the blob hides what is behind it"


@pytest.mark.parametrize("criterion", ["eig", "logdet", "v_opt", "block_logdet"])
def test_empty_views_are_wanted(blob, ring, criterion):
    """Of views of a direction that was seen and of one that was not, the latter; of Gaussians alone they are alike."""
    train, candidates = ring[:1], [dataclasses.replace(ring[0], name="again"), ring[4]]
    found = select(blob, candidates, train, blocks=("geometry", "background"), criterion=criterion, prior=Prior(1e-2))
    assert found.picks[0].name == "4"
    assert found.parts[1]["background"] > 2 * found.parts[0]["background"]
    assert found.blocks == ["geometry", "background"]


def test_wrong_weights_are_refused(blob, ring):
    """Of another number of cells."""
    with pytest.raises(ValueError, match=r"weights of background must have shape \(1536, 3\), got \(3,\)"):
        fisher.variance_map(blob, ring[0], {"background": torch.ones(3)})
