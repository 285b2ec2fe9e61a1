"""Information that is kept while the scene drifts: what a change is, what is given again, and of which size."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scenes_random import gaussians

from drgs.cameras import orbit
from drgs.ellipsoids import Gaussians
from drgs.selection.cache import Cache, NotCached, view_key
from drgs.selection.drift import Shapes

pytestmark = pytest.mark.core


def scene(n=12, K=4, seed=0) -> Gaussians:
    return gaussians(np.random.default_rng(seed), n, K, scale=0.2).detach()


def cameras(count=4):
    return orbit((0, 0, 0), 4.0, count, width=24, height=18)


def change(before: Gaussians, now: Gaussians) -> torch.Tensor:
    return Shapes.of(before).change_to(Shapes.of(now))


def key_of(camera, quantity="what"):
    return view_key(quantity, camera)


def information(g: Gaussians, value=1.0):
    return {"means": torch.full((len(g), 3), value), "sh": torch.full(tuple(g.sh.shape), value)}


# ------------------------------------------------------------------------------------------------------------ a change


def test_what_a_change_is():
    """In sizes, logarithms, radians, opacity and color; the largest counts, and nothing is more than 1."""
    g = scene()
    size = g.log_scales.mean(1).exp()
    assert not change(g, g).any()
    step = torch.tensor([1.0, 0, 0])
    assert change(g, g.replace(means=g.means + 0.3 * size[:, None] * step)).tolist() == pytest.approx([0.3] * 12, 1e-3)
    assert change(g, g.replace(means=g.means + 9 * size[:, None] * step)).tolist() == [1.0] * 12
    longer = g.log_scales + 0.2 * step
    assert change(g, g.replace(log_scales=longer)).tolist() == pytest.approx([0.2] * 12, rel=1e-4)
    both = g.replace(log_scales=longer, means=g.means + 0.3 * size[:, None] * step)
    assert change(g, both).tolist() == pytest.approx([0.3] * 12, rel=1e-3)
    clear = g.replace(logit_opacities=torch.zeros(12))
    dense = g.replace(logit_opacities=torch.full((12,), math.log(3)))
    assert change(clear, dense).tolist() == pytest.approx([0.25] * 12, rel=1e-5)
    gray = g.replace(sh=torch.zeros_like(g.sh))
    lighter = gray.sh.clone()
    lighter[:, 0, 1] = 0.1 / 0.28209479177387814
    assert change(gray, gray.replace(sh=lighter)).tolist() == pytest.approx([0.1] * 12, rel=1e-5)


def test_a_sphere_does_not_turn():
    """A turn counts by how unlike the scales are; q and -q are one rotation."""
    g = scene()
    turned = torch.zeros(12, 4)
    turned[:, 0], turned[:, 3] = math.cos(0.1), math.sin(0.1)  # 0.2 about z
    still = g.replace(quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(12, 1))
    for scales, want in (((0.0, 0.0, 0.0), 0.0), ((0.0, 0.0, math.log(0.25)), 0.2 * 0.75)):
        shaped = still.replace(log_scales=torch.tensor([scales]).repeat(12, 1))
        assert change(shaped, shaped.replace(quats=turned)).tolist() == pytest.approx([want] * 12, abs=1e-6)
        assert change(shaped, shaped.replace(quats=-turned)).tolist() == pytest.approx([want] * 12, abs=1e-6)


def test_the_world_is_compared_not_the_origin():
    """Means count from the origin; a new Gaussian has changed altogether, and one that has gone is no matter."""
    g = scene()
    moved = dataclasses.replace(g, means=g.means - 1, origin=np.ones(3))
    assert float(change(g, moved).max()) < 1e-5
    more = scene(15)
    assert change(g.replace(**{k: v[:9] for k, v in g.parameters().items()}), g).tolist() == [0.0] * 9 + [1.0] * 3
    assert len(change(more, g)) == 12


# ----------------------------------------------------------------------------------------------------------- the cache


def test_an_answer_lasts_while_little_changes():
    """Below the bound it is given again, above it is not; where nothing more is computed it is given all the same."""
    g, (camera, *_) = scene(), cameras()
    cache = Cache(bound=0.1)
    cache.expect([camera])
    key = key_of(camera)
    assert cache.find(g, key) is None
    assert cache.change(g, camera) == math.inf
    cache.keep(g, key, information(g))
    assert cache.find(g, key)["means"] is not None
    assert cache.changes == {key[1]: 0.0}
    little = g.replace(log_scales=g.log_scales + 0.05)
    assert torch.equal(cache.find(little, key)["means"], information(g)["means"])
    assert cache.changes[key[1]] == pytest.approx(0.05, rel=1e-4)
    much = g.replace(log_scales=g.log_scales + 0.3)
    assert cache.change(much, camera) == pytest.approx(0.3, rel=1e-4)
    assert cache.find(much, key) is None
    cache.computes = False
    assert cache.find(much, key) is not None
    with pytest.raises(NotCached) as lacking:
        cache.find(much, key_of(camera, "something else"))
    assert lacking.value.quantity == "something else"
    assert cache.keeps("what", camera)
    assert not cache.keeps("something else", camera)


def test_what_a_view_does_not_see_may_change():
    """The mean is over what makes up the image: here the first Gaussian alone, then the first two, unevenly."""
    g, (camera, *_) = scene(), cameras()
    cache = Cache(bound=1.0)
    cache.expect([camera])
    told = information(g, 0.0)
    told["sh"][0, 0] = 1.0
    cache.keep(g, key_of(camera), told)
    scales = g.log_scales.clone()
    scales[1:] += 0.5
    assert cache.change(g.replace(log_scales=scales), camera) == 0
    told = {name: x.clone() for name, x in told.items()}
    told["sh"][1, 0] = 3.0
    cache.keep(g, key_of(camera), told)
    assert cache.change(g.replace(log_scales=scales), camera) == pytest.approx(0.375, rel=1e-4)
    assert cache.image_weights(g, camera)[:3].tolist() == [3.0, 9.0, 0.0]


def test_new_gaussians_count_where_they_are_seen():
    """One in the image counts as the average one; one behind the camera does not. Answers get zeros for them."""
    g, (camera, *_) = scene(), cameras()
    front, back = (camera.center + z * camera.c2w[:3, 2] for z in (3.0, -3.0))
    for place, want in ((front, 1 / 13), (back, 0.0)):
        cache = Cache(bound=1.0)
        cache.expect([camera])
        cache.keep(g, key_of(camera), information(g))
        more = {name: torch.cat([x, x[:1]]) for name, x in g.parameters().items()}
        more["means"][12] = torch.from_numpy(place).float()
        grown = g.replace(**more)
        assert cache.change(grown, camera) == pytest.approx(want, abs=1e-6)
        found = cache.find(grown, key_of(camera))
        assert {name: tuple(x.shape) for name, x in found.items()} == {"means": (13, 3), "sh": (13, 4, 3)}
        assert not found["means"][12].any()
        assert torch.equal(found["means"][:12], information(g)["means"])
    cache = Cache(bound=1.0)
    cache.expect([camera])
    cache.keep(g, key_of(camera), information(g))
    sharper = g.replace(sh=torch.cat([g.sh, torch.zeros(12, 5, 3)], 1))
    found = cache.find(sharper, key_of(camera))["sh"]
    assert tuple(found.shape) == (12, 9, 3)
    assert torch.equal(found[:, :4], information(g)["sh"])


def test_only_what_is_expected_is_kept():
    """Answers of other cameras go; of too many bytes the one that was used least recently."""
    g, views = scene(), cameras()
    size = sum(x.nbytes for x in information(g).values())
    cache = Cache(bound=0.1, max_bytes=2 * size)
    cache.expect(views[:3])
    for camera in views[:3]:
        cache.keep(g, key_of(camera), information(g))
    assert [cache.find(g, key_of(camera)) is not None for camera in views[:3]] == [False, True, True]
    assert cache.evictions == 1
    cache.keep(g, key_of(views[3]), information(g))
    assert cache.find(g, key_of(views[3])) is None
    cache.expect(views[2:])
    assert (len(cache), cache.bytes) == (1, size)
    assert cache.image_weights(g, views[1]) is None
    cache.invalidate()
    assert (len(cache), cache.bytes, cache.change(g, views[2])) == (0, 0, math.inf)


def test_a_shorter_list_is_another_scene():
    """Nothing says which Gaussians have gone: everything is forgotten, and cameras are still expected."""
    g, (camera, *_) = scene(), cameras()
    cache = Cache(bound=1.0)
    cache.expect([camera])
    cache.keep(g, key_of(camera), information(g))
    fewer = g.replace(**{name: x[:7] for name, x in g.parameters().items()})
    assert cache.find(fewer, key_of(camera)) is None
    assert cache.image_weights(fewer, camera) is None
    cache.keep(fewer, key_of(camera), information(fewer))
    assert cache.find(g, key_of(camera))["means"].shape == (12, 3)
    flat = g.replace(sh=g.sh[:, :1])
    assert cache.find(flat, key_of(camera)) is None
