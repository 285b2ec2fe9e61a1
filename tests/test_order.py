"""Exact order on tiles: what its three passes, its tables and its words must not change."""

from __future__ import annotations

import dense_jacobian as dense
import drjit as dr
import numpy as np
import pytest
import torch
from scenes_random import Oracle, camera, compare, gaussians, relative
from test_tiles import _scene

from drgs import fisher, reference, runtime
from drgs.integrator import render
from drgs.settings import RenderSettings
from drgs.tracing import tiles, walk
from drgs.tracing.tiles import TILE

EXACT = RenderSettings.preset("exact")


def shallow(monkeypatch):
    """Buffers so short that some rays are walked a second, and some a third time."""
    monkeypatch.setattr(walk, "BUFFER", 2)
    monkeypatch.setattr(walk, "_DEEP", 5)
    monkeypatch.setattr(walk, "_MANY", 1)


@pytest.mark.parametrize("width", [0, 3])
@pytest.mark.parametrize("response", ["peak", "integral"])
def test_rays_walked_three_times(rng, monkeypatch, response, width):
    """Images, adjoint and forward mode against the oracle."""
    shallow(monkeypatch)
    lists, kinds = walk.Part._listed, []
    monkeypatch.setattr(walk.Part, "_listed", lambda part, count: kinds.append(count) or lists(part, count))
    settings = EXACT.replace(response=response, background=(0.2, 0.5, 0.9))
    cam, g = camera(rng, (19, 13)), gaussians(rng, 30, 4, width, scale=0.3, opacity=3.0)
    errors = compare(g, cam, settings, Oracle(g, cam, settings, rng))
    assert errors.finite
    assert errors.out.certificate["redone"] > max(kinds) > 0  # a second time, and a third
    assert all(error <= 1e-5 * (4 if name == "features" else 1) for name, error in errors.image.items()), errors.image
    assert all(error <= 1e-4 for error in (*errors.gradient.values(), *errors.forward.values()))
    assert errors.duality <= 1e-4


@pytest.mark.parametrize("direction", ["gaussian", "ray"])
def test_information_of_rays_walked_three_times(rng, monkeypatch, direction):
    """Diagonal, blocks and variance map against the oracle's dense Jacobian."""
    settings = EXACT.replace(background=(0.2, 0.5, 0.9), sh_direction=direction)
    g, cam, out = dense.scene(rng, settings, n=14)
    J = dense.jacobian(g, out)
    truth, rows = dense.squares(J), dense.stacked(J)
    weights = {name: torch.rand_like(x) for name, x in truth.items()}
    maps = fisher.variance_map(g, cam, weights, settings)
    shallow(monkeypatch)
    found = fisher.diagonal(g, cam, settings)
    assert all(dense.error(found[name], x) <= 1e-4 for name, x in truth.items())
    assert relative(fisher.variance_map(g, cam, weights, settings), maps) < 1e-5
    if direction == "gaussian":  # blocks know no other
        assert dense.error(fisher.blocks(g, cam, settings), torch.einsum("pni,pnj->nij", rows, rows)) <= 1e-4


@pytest.mark.parametrize("width", [0, 3])
def test_tables_of_few_tiles(rng, monkeypatch, width):
    """Derivatives whose tables are filled for a few tiles at a time are the same."""
    cam, g = camera(rng, (37, 29)), gaussians(rng, 40, 4, width, scale=0.2)
    v = torch.tensor(rng.normal(size=(29, 37, 3)))
    found, parts = [], []
    bands = tiles.TileTraversal._bands

    def noted(view, *args):
        made = list(bands(view, *args))
        parts.append((len(made), max(part.slots.size for part, _ in made)))
        return iter(made)

    monkeypatch.setattr(tiles.TileTraversal, "_bands", noted)
    for size in (tiles.TABLES, 60 << 10):
        monkeypatch.setattr(tiles, "TABLES", size)
        leaves = {name: x.clone().requires_grad_() for name, x in g.detach().parameters().items()}
        out = render(g.detach().replace(**leaves), cam, EXACT)
        ((out.rgb * v).sum() + (out.features.sum() if width else 0)).backward()
        found.append({name: x.grad for name, x in leaves.items()} | fisher.diagonal(g.detach(), cam, EXACT))
    assert parts[0][0] == 1
    assert parts[-1][0] > 2
    for name, x in found[0].items():
        assert relative(found[1][name].double(), x.double()) < 1e-5, name


def test_words(rng):
    """A hit's word orders like its key, then like its name, at any key that a hit can have."""
    lib = runtime.dr_types()
    keys = np.concatenate([[0.0, 1e-45, 1e-39, 1.3e-38, 1e-30, 1.0, np.nextafter(np.float32(1), np.float32(2)), 3e38]])
    keys = np.concatenate([keys, rng.lognormal(0, 20, 200)]).astype(np.float32)
    names = np.array([0, 1, 5, 2**31, 2**32 - 1], dtype=np.uint32)
    key, name = (x.ravel() for x in np.meshgrid(keys, names, indexing="ij"))
    word = walk._word(lib, lib.Float(key), lib.UInt32(name))
    normal = np.maximum(key, np.float32(1.2e-38))  # below, keys are all one
    assert (np.argsort(word.numpy(), kind="stable") == np.lexsort((name, normal))).all()
    assert (word.numpy() > walk.EMPTY).all()
    assert (word.numpy() < walk._BEHIND).all()
    assert dr.all(walk._word(lib, lib.Float(walk.EMPTY), lib.UInt32(0)) < 0)


def test_blocks_list_every_hit(rng):
    """What the oracle finds at a pixel is in the list of its block, which orders by t* in its middle."""
    cam, g = camera(rng, (37, 21)), gaussians(rng, 25, 1, anisotropy=1.2).detach()
    _, lists = _scene(g, cam, EXACT)
    index, place, start, end = (getattr(lists.blocks, name).numpy() for name in ("index", "place", "start", "end"))
    assert (lists.index.numpy()[place] == index).all()
    for tile in range(lists.columns * lists.rows):
        own = lists.index.numpy()[lists.start.numpy()[tile] : lists.end.numpy()[tile]]
        assert (np.diff(own) > 0).all()  # in the order of indices: names of hits with the same key
        at = np.concatenate([place[start[4 * tile + k] : end[4 * tile + k]] for k in range(4)])
        assert ((at >= lists.start.numpy()[tile]) & (at < lists.end.numpy()[tile])).all()
    assert len(index) < 4 * lists.pairs  # not every block of a tile
    extent = (2 * torch.log((g.opacities.double() * 25 / 1e-5).clamp(min=1))).sqrt()
    for i in range(len(g)):
        one = reference.render(g.take([i]), cam, EXACT.replace(extent=max(float(extent[i]), 1e-3)))
        for y, x in ((one.count > 0) & (one.alpha > 1e-12)).nonzero().tolist():
            tile, inner = (y // TILE) * lists.columns + x // TILE, y % TILE // 4 * 2 + x % TILE // 4
            assert i in index[start[4 * tile + inner] : end[4 * tile + inner]]


def test_many_rays_in_lists_of_their_own(rng, monkeypatch):
    """Where a word has no room for all lanes beside a Gaussian's index, rays are sorted in several lots."""
    monkeypatch.setattr(walk, "BUFFER", 2)
    monkeypatch.setattr(walk, "_WORD", 32 - 28)  # bits: 16 lanes of 1 Gaussian
    cam, g = camera(rng, (19, 13)), gaussians(rng, 6, 1, scale=0.4).detach()
    out = render(g, cam, EXACT)
    assert relative(out.rgb.double(), reference.render(g, cam, EXACT).rgb) < 1e-5
