"""Selection in a loop, as a robot does it: what views tell is computed once, in a bounded number of bytes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import gaussians
from test_select import ring

from drgs import fisher
from drgs.select import Cache, select
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast")
PICKS, LEFT, NEW = 10, 6, 2  # of the loop; candidates at its start, and those that come with each pick


@pytest.fixture
def still(rng):
    """Gaussians that views look past, and more cameras around them than a loop needs."""
    g = gaussians(rng, 12, 1, scale=0.4).detach()
    return g.replace(logit_opacities=g.logit_opacities + 3), ring(rng, 2 + LEFT + PICKS * NEW)


def loop(g, cameras, rng, cache):
    """Names of ten picks and all scores: the view picked becomes known, others come into reach, in no fixed order."""
    coming, known, left = list(cameras[2 + LEFT :]), list(cameras[:2]), list(cameras[2 : 2 + LEFT])
    picks, scores = [], []
    for _ in range(PICKS):
        found = select(g, left, known, 1, settings=FAST, cache=cache)
        assert "backdrop" in found.blocks
        picks.append(found.picks[0].name)
        scores += found.scores
        known.append(left.pop(found.picks[0].index))
        left += [coming.pop() for _ in range(NEW)]
        left, known = ([some[i] for i in rng.permutation(len(some))] for some in (left, known))
        # Poses come out of a planner anew each time.
        left = [dataclasses.replace(camera, w2c=camera.w2c.copy()) for camera in left]
    return picks, scores


def test_a_robots_loop_computes_each_view_once(still):
    """Ten picks: what each view that comes into sight tells is computed once, and how far away its surfaces are at most
    once; all else is found. Picks and scores are those without a cache.
    """
    g, cameras = still
    cache = Cache()
    with_cache = loop(g, cameras, np.random.default_rng(0), cache)
    views = 2 + LEFT + (PICKS - 1) * NEW
    pools = [2 + LEFT + i * NEW for i in range(PICKS)]
    assert views < cache.misses <= 2 * views
    assert cache.misses + cache.hits == sum(pools) + sum(min(16, n) for n in pools)
    assert (len(cache), cache.evictions) == (cache.misses, 0)
    without = loop(g, cameras, np.random.default_rng(0), None)
    assert with_cache[0] == without[0]
    assert with_cache[1] == pytest.approx(without[1], rel=1e-5)


def test_the_order_and_the_names_of_views_do_not_matter(still):
    """The same views in another order, under other names: nothing is computed anew; the sphere has the same bits."""
    g, cameras = still
    cache = Cache()
    select(g, cameras[3:9], cameras[:3], settings=FAST, cache=cache)
    sphere = fisher.backdrop_sphere(g, cameras)
    for seed in range(20):
        order = np.random.default_rng(seed).permutation(len(cameras))
        assert fisher.backdrop_sphere(g, [cameras[i] for i in order]) == sphere
    misses = cache.misses
    renamed = [dataclasses.replace(camera, name=f"step 2, {i}") for i, camera in enumerate(cameras[8:2:-1])]
    again = select(g, renamed, cameras[2::-1], settings=FAST, cache=cache)
    assert (again.computed, cache.misses) == (0, misses)


@pytest.mark.every(3)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "columns"},
        {"blocks": ("backdrop",)},
        {"combine": "zscore"},
        {"empty_outside": True},
        {"policy": "coverage"},
        {"policy": "moments"},
    ],
)
def test_a_cache_changes_nothing(still, options):
    """Scores and parts out of a cache whose sphere was elsewhere are those of a call of its own, also behind masks."""
    g, cameras = still
    masks = None if options.get("policy") == "moments" else [torch.arange(120).reshape(10, 12) % 7 / 6.0, None]
    run = lambda views, **cache: select(g, views, cameras[:2], 2, settings=FAST, masks=masks, **options, **cache)  # noqa: E731
    cache = Cache()
    run(cameras[2:6], cache=cache)
    misses = cache.misses
    found, wanted = run(cameras[3:7], cache=cache), run(cameras[3:7])
    assert 0 < cache.misses - misses <= 2, "one view is new"
    assert found.scores == pytest.approx(wanted.scores, rel=1e-5)
    for one, other in zip(found.parts, wanted.parts, strict=True):
        assert one == pytest.approx(other, rel=1e-4, abs=1e-6)
    assert [pick.index for pick in found.picks] == [pick.index for pick in wanted.picks]


@pytest.mark.slow
def test_a_cache_is_bounded_in_bytes(still):
    """What was used least recently goes; the picks stay what they are, and what does not fit is said."""
    g, cameras = still
    whole = Cache()
    picks = loop(g, cameras, np.random.default_rng(0), whole)[0]
    assert whole.bytes == sum(x.nbytes for kept in whole._kept.values() for x in kept.computed.values()) > 0
    for share in (0.5, 0.05):
        cache = Cache(max_bytes=int(share * whole.bytes))
        assert loop(g, cameras, np.random.default_rng(0), cache)[0] == picks
        assert cache.bytes <= cache.max_bytes
        assert cache.evictions == cache.misses - len(cache) > 0
    assert cache.hits + cache.misses == whole.hits + whole.misses
    found = select(g, cameras[2:9], cameras[:2], settings=FAST, cache=cache)
    (note,) = (note for note in found.notes if note.startswith("cache: "))
    needed = int(note.split("at least ")[1].split()[0])
    roomy = Cache(max_bytes=needed + 100_000)  # and the surfaces
    for computed in (9, 0):
        found = select(g, cameras[2:9], cameras[:2], settings=FAST, cache=roomy)
        assert (found.computed, found.notes) == (computed, [])
    nothing = Cache(max_bytes=0)
    assert loop(g, cameras, np.random.default_rng(0), nothing)[0] == picks
    assert (len(nothing), nothing.bytes, nothing.hits) == (0, 0, 0)


def test_the_least_recently_used_goes_first(still):
    """By the order of use, not of arrival; what is larger than the cache does not come in, and pushes out none."""
    g, _ = still
    cache = Cache(max_bytes=300)

    def ask(key, size):
        if cache.find(g, key) is None:
            cache.keep(g, key, {"means": torch.zeros(size, dtype=torch.uint8)})

    for key in "abc":
        ask(key, 100)
    assert cache.find(g, "a") is not None
    ask("d", 100)
    assert [cache.find(g, key) is not None for key in "abcd"] == [True, False, True, True]
    assert (cache.bytes, cache.evictions, cache.misses) == (300, 1, 4)
    assert repr(cache) == "Cache(3 answers, 0.0 of 0.0 MB, 4 hits, 4 misses, 1 evictions)"
    ask("large", 301)
    assert cache.find(g, "large") is None
    assert (len(cache), cache.bytes, cache.evictions) == (3, 300, 2)


def test_a_call_within_a_call_takes_nothing_of_it(still):
    """Another call that computes the same views meanwhile, as another Python thread may: every view keeps its own
    answer, in this call and in the cache.
    """
    g, cameras = still
    cache, inner = Cache(), []

    def meanwhile(done, total):
        if not inner:
            inner.append(None)
            select(g, cameras[6:9], cameras[:2], settings=FAST, cache=cache)

    expected = select(g, cameras[2:9], cameras[:2], settings=FAST).scores
    within = select(g, cameras[2:9], cameras[:2], settings=FAST, cache=cache, progress=meanwhile).scores
    assert within == pytest.approx(expected, rel=1e-5)
    assert select(g, cameras[2:9], cameras[:2], settings=FAST, cache=cache).scores == pytest.approx(expected, rel=1e-5)
    assert len({round(score, 9) for score in expected}) == len(expected)
    assert cache.bytes == sum(x.nbytes for kept in cache._kept.values() for x in kept.computed.values())


def test_a_scene_that_changes_leaves_nothing(still):
    """A map that grows between calls: all is computed anew, and nothing of the old one is kept."""
    g, cameras = still
    cache, sizes = Cache(), []
    for step in range(3):
        found = select(g, cameras[2:6], cameras[:2], settings=FAST, cache=cache)
        assert found.computed == 6
        sizes.append((len(cache), cache.bytes))
        with torch.no_grad():
            g.means[step] += 0.01
    assert len({count for count, _ in sizes}) == 1
    assert max(size for _, size in sizes) < 1.5 * min(size for _, size in sizes)
    assert cache.hits == 0
    cache.invalidate()
    assert (len(cache), cache.bytes) == (0, 0)


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (-1, "Cache: max_bytes must be at least 0, got -1; 0 keeps nothing"),
        ("1 GB", "Cache: max_bytes must be an int, got the str '1 GB'; bytes that may be kept, e.g. 1 << 30"),
    ],
)
def test_bounds_that_are_none(size, message):
    """In one line."""
    with pytest.raises(ValueError) as error:  # noqa: PT011
        Cache(max_bytes=size)
    assert str(error.value) == message
