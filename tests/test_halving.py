"""One pick whose candidates are first scored by a quarter of their pixels: against the pick by all pixels."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from scenes_random import gaussians
from test_select_command import place, select  # noqa: F401

from drgs.cameras import orbit
from drgs.select import Cache, Region
from drgs.select import select as choose
from drgs.settings import RenderSettings

WIDTH, HEIGHT = 48, 36
WHOLE, QUARTER = WIDTH * HEIGHT, (WIDTH // 2) * (HEIGHT // 2)
GREEDY = "drgs.selection.greedy."


@pytest.fixture(scope="module")
def world():
    """60 Gaussians, two known views and twelve candidates on a circle."""
    g = gaussians(np.random.default_rng(3), 60, 1, scale=0.3).detach()
    cameras = orbit((0, 0, 0), 4.0, 14, width=WIDTH, height=HEIGHT)
    return {"gaussians": g, "candidates": cameras[2:], "train": cameras[:2], "settings": RenderSettings.preset("fast")}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Views of tests are small."""
    monkeypatch.setattr(GREEDY + "_LEAST_PIXELS", WHOLE)


def test_the_pick_is_that_by_all_pixels(world):
    """Its score, too, but for what estimates of other candidates change; what is estimated is told, and is close."""
    full, halved = choose(**world, halving=False), choose(**world)
    assert full.pixels == []
    assert not any("halving" in note for note in full.notes)
    assert halved.picks[0].index == full.picks[0].index
    assert halved.picks[0].score == pytest.approx(full.picks[0].score, rel=0.05)
    np.testing.assert_allclose(halved.scores, full.scores, rtol=0.3)
    estimates = [score for score, n in zip(halved.scores, halved.pixels, strict=True) if n == QUARTER]
    assert set(halved.pixels) == {WHOLE, QUARTER}
    assert halved.pixels[halved.picks[0].index] == WHOLE
    assert max(estimates) < 0.9 * halved.picks[0].score
    assert halved.computed == 2 + 12 + halved.pixels.count(WHOLE)
    assert any(f"the scores of {len(estimates)} of 12 candidates are estimates" in note for note in halved.notes)
    rows = halved.candidates_json([{"index": i} for i in range(12)])
    assert [row["pixels"] for row in rows] == halved.pixels
    assert "pixels" not in full.candidates_json([{"index": i} for i in range(12)])[0]


def test_all_in_full_is_no_approximation(world, monkeypatch):
    """Where no margin tells candidates apart all are computed twice, and nothing of the estimates is left."""
    monkeypatch.setattr(GREEDY + "_MARGIN", 1.0)
    full, halved = choose(**world, halving=False), choose(**world)
    assert halved.pixels == [WHOLE] * 12
    np.testing.assert_allclose(halved.scores, full.scores, rtol=1e-9)
    assert halved.picks[0].margin == pytest.approx(full.picks[0].margin, rel=1e-6)


def test_same_again(world, monkeypatch):
    """The same picks and scores out of a cache, and where information is not kept for want of memory."""
    plain = lambda x: dataclasses.replace(x, seconds=0.0, computed=0)  # noqa: E731
    cache, first = Cache(), choose(**world)
    for _ in range(2):
        again = choose(**world, cache=cache)
        assert plain(again) == plain(first)
    assert again.computed == 0
    seen = []
    monkeypatch.setattr(GREEDY + "available", lambda: 0)
    assert plain(choose(**world, progress=lambda *x: seen.append(x))) == plain(first)
    assert seen[-1][0] <= seen[-1][1]


@pytest.mark.parametrize(
    "options",
    [
        {"k": 2},
        {"criterion": "eig"},
        {"policy": "coverage"},
        {"region": Region.sphere((0.0, 0.0, 0.0), 0.5)},
        {"candidates": slice(0, 7)},
    ],
    ids=lambda options: next(iter(options)),
)
def test_where_it_is_not_done(world, options):
    """Scores of what was not measured are those by all pixels."""
    if "candidates" in options:
        options = {"candidates": world["candidates"][options["candidates"]]}
    full, same = (choose(**world | options, halving=halving) for halving in (False, True))
    assert (same.scores, same.picks, same.pixels) == (full.scores, full.picks, [])


def test_few_pixels(world, monkeypatch):
    """A view costs what its Gaussians do."""
    monkeypatch.setattr(GREEDY + "_LEAST_PIXELS", WHOLE + 1)
    assert choose(**world).pixels == []


def test_command(place, monkeypatch, capsys):  # noqa: F811
    """`drgs select` does it, and says so in its file, unless it is told not to."""
    monkeypatch.setattr(GREEDY + "_LEAST_PIXELS", 64)
    line = "run --candidates dome --count 10 --preset fast"
    halved, text = select(line, place, monkeypatch, capsys)
    assert "note: halving: " in text
    pick = halved["picks"][0]["index"]
    assert halved["candidates"][pick]["pixels"] == max(row["pixels"] for row in halved["candidates"])
    full, text = select(f"{line} --no-halving", place, monkeypatch, capsys)
    assert "halving" not in text + json.dumps(full)
