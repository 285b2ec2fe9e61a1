"""Policies that go by what may be where the model has nothing: places, what views see of them, and their scores."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import drgs
from drgs.cameras import Camera, orbit
from drgs.policies.facility import overlap
from drgs.policies.field import wrong
from drgs.policies.places import Sight, places, sight_of
from drgs.select import select


@pytest.fixture(scope="module")
def scene():
    """A wall of blobs around the origin."""
    rng = np.random.default_rng(0)
    n = 120
    points = rng.normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return drgs.Gaussians.from_arrays(
        points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.15), np.full(n, 0.95), rng.normal(size=(n, 1, 3))
    )


@pytest.fixture(scope="module")
def ring():
    return [
        dataclasses.replace(c, name=f"{i:02d}") for i, c in enumerate(orbit((0, 0, 0), 4.0, 10, width=40, height=30))
    ]


def flat(camera, depth=2.0, alpha=0.75):
    """A view that shows something at one distance along every ray."""
    size = camera.height, camera.width
    return Sight(camera, np.full(size, alpha), np.full(size, depth))


def test_reach_is_the_transmittance_of_the_model(ring):
    """1 in front of what the view shows, 1 - opacity behind it, 0 outside of the image and behind the camera."""
    camera = ring[0]
    sight, ray = flat(camera), camera.pixel_directions()[15, 20]
    other = camera.pixel_directions()[0, 0] - 2 * camera.pixel_directions()[15, 20] * 0
    points = np.stack([camera.center + d * ray for d in (1.0, 2.05, 3.0, -1.0)])
    aside = camera.center + 2 * (other + 3 * camera.c2w[:3, 0])
    assert sight.reach(np.vstack([points, aside[None]])).tolist() == [1.0, 1.0, 0.25, 0.0, 0.0]


def test_sights_see_surfaces(scene, ring):
    """Opaque pixels have the distance of the wall, empty ones none."""
    sight = sight_of(scene, ring[0], 300)
    assert sight.camera.width * sight.camera.height <= 300
    solid = sight.alpha > 0.9
    assert solid.any()
    assert 3.0 < np.median(sight.depth[solid]) < 3.6
    assert np.isinf(sight.depth[sight.alpha == 0]).all()


def test_places_of_a_view_weigh_one(scene, ring, rng):
    """What a pixel shows and what may be in it are its whole; free places are at depths that known views have seen."""
    sights = [sight_of(scene, camera) for camera in ring]
    at = places(sights, 2, 50, rng)
    assert np.bincount(at.views, at.weights) == pytest.approx(np.ones(len(ring)))
    origins = np.stack([camera.center for camera in ring])[at.views]
    assert at.points == pytest.approx(origins + at.distances[:, None] * at.rays)
    assert 2.5 < at.distances.min() < at.distances.max() < 6
    empty = [Sight(camera, np.zeros((30, 40)), np.full((30, 40), np.inf)) for camera in ring]
    free = places(empty, 2, 50, rng)
    assert np.bincount(free.views, free.weights) == pytest.approx(np.ones(len(ring)))
    assert free.distances.max() / free.distances.min() > 10


def test_facility_is_monotone_and_submodular(scene, ring, rng):
    """Every view adds something or nothing, and the less the more views there are."""
    sights = [sight_of(scene, camera) for camera in ring]
    at = places(sights, 2, 40, rng)
    k = np.stack([overlap(sight, at) for sight in sights])
    assert (k >= 0).all()
    assert (k <= 1 + 1e-12).all()
    score = lambda views: float(at.weights @ k[views].max(0)) if len(views) else 0.0  # noqa: E731
    for _ in range(50):
        order = rng.permutation(len(ring))
        small, large, new = order[:2], order[:5], order[5]
        more = score([*large, new]) - score(large)
        assert -1e-12 <= more <= score([*small, new]) - score(small) + 1e-12


def test_errors_fall_with_what_is_told(rng):
    """In [0, 1), the more precise the smaller; a direction that q does not see does not count."""
    root = torch.from_numpy(rng.normal(size=(20, 3, 3)))
    known, more = torch.eye(3, dtype=torch.float64) + root @ root.mT, torch.from_numpy(rng.normal(size=(20, 3, 1)))
    ray = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    seen = (torch.eye(3, dtype=torch.float64) - torch.outer(ray, ray)).expand(20, 3, 3)
    before, after = wrong(known, seen), wrong(known + more @ more.mT, seen)
    assert bool((after <= before + 1e-12).all())
    assert 0 <= float(after.min()) <= float(before.max()) < 1
    along = 1e9 * torch.outer(ray, ray)
    eye = torch.eye(3, dtype=torch.float64)
    assert float(wrong(eye + along, seen[0])) == pytest.approx(float(wrong(eye, seen[0])))


@pytest.mark.parametrize("policy", ["field", "facility", "poses"])
def test_no_unit_of_length_matters(scene, ring, policy):
    """The same world ten times as large, somewhere else: the same scores (of a ring, whose ties may fall otherwise)."""
    train, candidates = ring[:2], ring[2:]
    found = select(scene, candidates, train, 3, policy)

    def moved(camera: Camera) -> Camera:
        c2w = np.array(camera.c2w)
        c2w[:3, 3] = 10 * c2w[:3, 3] + 7
        return dataclasses.replace(camera, w2c=np.linalg.inv(c2w))

    far = scene.replace(means=10 * scene.means + 7, log_scales=scene.log_scales + np.log(10))
    again = select(far, [moved(c) for c in candidates], [moved(c) for c in train], 3, policy)
    assert [p.score for p in again.picks] == pytest.approx([p.score for p in found.picks], rel=1e-3)
    assert again.scores == pytest.approx(found.scores, rel=2e-2)  # a few points lie elsewhere by rounding
    assert all(score >= 0 for score in found.scores)


@pytest.mark.parametrize("policy", ["field", "facility", "poses"])
def test_views_beside_known_ones_are_not_wanted(scene, ring, policy):
    """Of a ring of which one half is known, the middle of the other half comes first; a known view twice, last."""
    train = ring[:5]
    twice = dataclasses.replace(ring[2], name="twice")
    found = select(scene, [twice, *ring[5:]], train, 1, policy)
    assert found.picks[0].name in ("06", "07", "08")
    assert found.scores[0] == min(found.scores)
    assert found.scores[0] < (0.9 if policy == "field" else 0.3) * max(found.scores)  # a field adds up what repeats


def test_switch_goes_by_emptiness(scene, ring):
    """Distance where candidates see past everything, information where they see nothing but Gaussians."""
    train, candidates = ring[:2], ring[2:]
    found = select(scene, candidates, train, 2, "switch")
    assert found.scores == select(scene, candidates, train, 2, "farthest").scores
    assert "emptiness" in found.notes[-1]
    wall = scene.replace(log_scales=scene.log_scales + np.log(6), logit_opacities=scene.logit_opacities + 3)
    assert select(wall, candidates, train, 2, "switch").scores == select(wall, candidates, train, 2, "fisher").scores


def test_diverse_is_information_of_other_poses(scene, ring):
    """At most the information alone; of a pose that is known nothing is left, and one pick makes its like worthless."""
    train, twice = ring[:2], dataclasses.replace(ring[1], name="twice")
    candidates = [twice, *ring[2:], dataclasses.replace(ring[7], name="also 07")]
    told = select(scene, candidates, train, policy="fisher").scores
    found = select(scene, candidates, train, 4, "diverse")
    assert (np.array(found.scores) <= np.array(told) * (1 + 1e-9)).all()
    assert found.scores[0] < 1e-3 * max(found.scores)
    assert not {"twice"} & {p.name for p in found.picks}
    assert len({"07", "also 07"} & {p.name for p in found.picks}) < 2
