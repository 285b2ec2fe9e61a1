"""Exact order: what its passes, rows, tables and words must not change."""

from __future__ import annotations

import dense_jacobian as dense
import drjit as dr
import numpy as np
import pytest
import torch
from scenes_random import Oracle, camera, compare, gaussians, relative

from drgs import fisher, reference, runtime
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.settings import PRESETS, RenderSettings
from drgs.tracing import rows, sort_keys, tiles, walk
from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import Call

EXACT = RenderSettings.preset("exact")
RAYS = EXACT.replace(traversal="bvh")


def shallow(monkeypatch):
    """Buffers so short that some rays are walked a second, and some a third time."""
    monkeypatch.setattr(walk, "BUFFER", 2)
    monkeypatch.setattr(walk, "_DEEP_BUFFER", 5)
    monkeypatch.setattr(walk, "_DEEP_FROM", 1)


@pytest.mark.every(3)
@pytest.mark.parametrize("width", [0, 3])
@pytest.mark.parametrize("response", ["peak", "integral"])
def test_rays_walked_three_times(rng, monkeypatch, response, width):
    """Images, adjoint and forward mode against the oracle."""
    shallow(monkeypatch)
    lists, kinds = walk.Part._listed, []
    monkeypatch.setattr(walk.Part, "_listed", lambda part, count: kinds.append(count) or lists(part, count))
    settings = RAYS.replace(response=response, background=(0.2, 0.5, 0.9))
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
    settings = RAYS.replace(background=(0.2, 0.5, 0.9), sh_direction=direction)
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


@pytest.mark.slow
@pytest.mark.parametrize("width", [0, 3])
def test_tables_of_few_tiles(rng, monkeypatch, width):
    """Derivatives whose tables are filled for a few tiles at a time are the same, whatever orders are held."""
    cam, g = camera(rng, (37, 29)), gaussians(rng, 40, 4, width, scale=0.2)
    v = torch.tensor(rng.normal(size=(29, 37, 3)))
    found, parts, room = [], [], tiles._MAX_ORDER_BYTES
    bands = tiles.TileTraversal._bands

    def noted(view, *args):
        made = list(bands(view, *args))
        parts.append((len(made), max(band.slots for band in made)))
        return iter(made)

    monkeypatch.setattr(tiles.TileTraversal, "_bands", noted)
    for size, held in ((tiles.TABLES, room), (60 << 10, room), (60 << 10, 0), (60 << 10, 9000)):
        monkeypatch.setattr(tiles, "TABLES", size)
        monkeypatch.setattr(tiles, "_MAX_ORDER_BYTES", held)
        monkeypatch.setattr(tiles, "_MAX_GPU_BANDS", 1)
        leaves = {name: x.clone().requires_grad_() for name, x in g.detach().parameters().items()}
        out = render(g.detach().replace(**leaves), cam, EXACT)
        ((out.rgb * v).sum() + (out.features.sum() if width else 0)).backward()
        found.append({name: x.grad for name, x in leaves.items()} | fisher.diagonal(g.detach(), cam, EXACT))
    assert parts[0][0] == 1
    assert parts[-1][0] > 2
    for other in found[1:]:
        assert all(relative(other[name].double(), x.double()) < 1e-5 for name, x in found[0].items())


def test_words_of_hits(rng):
    """A hit's word orders like its key, then like its name, at any key that a hit can have."""
    lib = runtime.dr_types()
    keys = np.concatenate([[0.0, 1e-45, 1e-39, 1.3e-38, 1e-30, 1.0, np.nextafter(np.float32(1), np.float32(2)), 3e38]])
    keys = np.concatenate([keys, rng.lognormal(0, 20, 200)]).astype(np.float32)
    names = np.array([0, 1, 5, 2**31, 2**32 - 1], dtype=np.uint32)
    key, name = (x.ravel() for x in np.meshgrid(keys, names, indexing="ij"))
    word = sort_keys.word_of(lib, lib.Float(key), lib.UInt32(name))
    normal = np.maximum(key, np.float32(1.2e-38))  # below, keys are all one
    assert (np.argsort(word.numpy(), kind="stable") == np.lexsort((name, normal))).all()
    assert (word.numpy() > sort_keys.EMPTY).all()
    assert (word.numpy() < sort_keys.BEYOND).all()
    assert (sort_keys.name_of(lib, word).numpy() == name).all()
    assert dr.all(sort_keys.word_of(lib, lib.Float(sort_keys.EMPTY), lib.UInt32(0)) < 0)


@pytest.mark.parametrize("held", [0, 1 << 20])
def test_rows_have_every_hit_in_order(rng, monkeypatch, held):
    """What the oracle finds at a pixel, one Gaussian at a time, is in its row, once, by (t*, index)."""
    monkeypatch.setattr(tiles, "_MAX_ORDER_BYTES", held)
    cam, g, lib = camera(rng, (21, 13)), gaussians(rng, 25, 1, anisotropy=1.2).detach(), runtime.dr_types()
    for x in g.parameters().values():
        x[20:23] = x[20].clone()  # what has the same key goes by the index
    settings = EXACT.replace(extent=3.5)
    call = Call(g, cam, settings, frozenset())
    compositor, arguments = call.prepare({name: to_drjit(lib, x) for name, x in call.inputs.items()})
    compositor.forward(*arguments, keep=True)
    (part,) = compositor.parts
    stream = part.stream.opened()
    assert (part.stream.held is stream) == bool(held)
    hits, start, end = (x.numpy() for x in (stream.hits, stream.start, stream.end))
    entries = hits if held else sort_keys.name_of(lib, stream.hits).numpy()
    listed, found = compositor.traversal.lists.index.numpy(), {}
    for pixel, a, b in zip(part.flat[0].numpy(), start, end, strict=True):
        if a < b:
            found[int(pixel)] = listed[entries[a:b]].tolist()
    true: dict = {}
    for i in range(len(g)):
        one = reference.render(g.take([i]), cam, settings)
        for y, x in (one.count > 0).nonzero().tolist():
            true.setdefault(y * cam.width + x, []).append((one.depth[y, x].item(), i))
    assert {pixel: sorted(row) for pixel, row in found.items()} == {p: sorted(i for _, i in r) for p, r in true.items()}
    depths = {pixel: {i: depth for depth, i in row} for pixel, row in true.items()}
    for pixel, row in found.items():
        along = [depths[pixel][i] for i in row]
        assert all(b - a > -1e-5 * b for a, b in zip(along, along[1:], strict=False))
        together = [i for i in row if 20 <= i < 23]
        assert together == sorted(together)


@pytest.mark.parametrize("threads", [1, 2])
def test_both_ways_to_sort_rows(rng, monkeypatch, threads):
    """By tile, as processors do it, and all at once, as CUDA does."""
    monkeypatch.setattr(rows, "_TILES_PER_TASK", 2)
    lengths = torch.tensor([3, 0, 7, 1, 0, 12])
    counts = torch.stack([torch.from_numpy(rng.integers(0, n + 1, 64)) for n in lengths.tolist()])
    flat, expected = [], []
    for n, own in zip(lengths.tolist(), counts.tolist(), strict=True):
        for count in own:
            row = rng.lognormal(0, 9, count)
            flat += [*row, *[sort_keys.BEYOND] * (n - count)]
            expected += [*sorted(row), *[sort_keys.BEYOND] * (n - count)]
    flat.append(sort_keys.BEYOND)  # buffers have one tile's slots more than they need
    one, other = (torch.tensor(flat, dtype=torch.float64) for _ in range(2))
    rows._sort_by_tile(one, lengths, counts, threads)
    rows._sort_at_once(other, counts)
    assert one[:-1].tolist() == expected
    assert other[:-1].tolist() == expected


@pytest.mark.slow
def test_tails_left_out_of_tiles(rng, monkeypatch):
    """Where a tile lists few of N, more of their tails is left out; derivatives of what is left are the oracle's."""
    cam, g = camera(rng, (40, 32)), gaussians(rng, 3000, 1, 3, scale=0.01, opacity=1.0).detach()
    v = torch.tensor(rng.normal(size=(32, 40, 3)))
    leaves = {name: x.clone().requires_grad_() for name, x in g.parameters().items()}
    short, whole = render(g.replace(**leaves), cam, EXACT, outputs=()), render(g, cam, EXACT)
    assert short.certificate["pairs"] < whole.certificate["pairs"]  # a depth and a count are of every hit
    oracle = reference.render(g.replace(**leaves), cam, EXACT)
    for name in ("rgb", "alpha", "features"):
        assert float((getattr(short, name) - getattr(oracle, name)).detach().abs().max()) < 5e-6 + 1e-6, name
    loss = lambda out: (out.rgb * v).sum() + (out.features * v).sum()  # noqa: E731
    found, true = (torch.autograd.grad(loss(out), leaves.values()) for out in (short, oracle))
    for name, x, y in zip(leaves, found, true, strict=True):
        assert relative(x.double(), y.double()) < 1e-4, name
    diagonal = fisher.diagonal(g, cam, EXACT)
    monkeypatch.setattr(tiles, "shorter", lambda lib, lists, *_: lists)
    for name, x in fisher.diagonal(g, cam, EXACT).items():
        assert relative(diagonal[name].double(), x.double()) < 1e-5, name


@pytest.mark.parametrize("fields", [{"alpha_min": 1 / 255}, {"max_hits": 3}, {"response": "integral"}], ids=str)
def test_what_tails_must_not_touch(rng, fields):
    """Where another cut-off decides, or the bound on tails does not hold, images are what they are with a depth."""
    cam, g = camera(rng, (40, 32)), gaussians(rng, 3000, 1, scale=0.01, opacity=1.0).detach()
    settings = EXACT.replace(**fields)
    short, whole = render(g, cam, settings, outputs=()), render(g, cam, settings)
    assert float((short.rgb - whole.rgb).abs().max()) < 1e-6
    if "alpha_min" not in fields:
        assert short.certificate["pairs"] == whole.certificate["pairs"]


def test_many_rays_in_lists_of_their_own(rng, monkeypatch):
    """Where a word has no room for all lanes beside a Gaussian's index, rays are sorted in several lots."""
    monkeypatch.setattr(walk, "BUFFER", 2)
    monkeypatch.setattr(walk, "_WORD_BITS", 32 - 28)  # bits: 16 lanes of 1 Gaussian
    cam, g = camera(rng, (19, 13)), gaussians(rng, 6, 1, scale=0.4).detach()
    out = render(g, cam, RAYS)
    assert out.certificate["redone"] > 4
    assert relative(out.rgb.double(), reference.render(g, cam, RAYS).rgb) < 1e-5


EVERY = {name: RenderSettings.preset(name) for name in PRESETS}
EVERY |= {f"{name} on bvh": EVERY[name].replace(traversal="bvh") for name in ("exact", "fast")}
EVERY["3dgut on bvh"] = EVERY["3dgut"].replace(traversal="bvh", culling="extent")
EVERY |= {
    f"integral, {order} on {traversal}": EXACT.replace(response="integral", order=order, traversal=traversal)
    for traversal in ("tiles", "bvh")
    for order in ("center", "ray", "entry")
    if (order, traversal) != ("entry", "tiles")
}


@pytest.mark.parametrize("name", EVERY)
def test_the_order_in_memory_changes_no_image(rng, name):
    """Of Gaussians with different keys, a camera inside of several of them too; and the oracle has the same image."""
    settings = EVERY[name]
    cam, g = camera(rng, (24, 16)), gaussians(rng, 24, 4, 2, scale=0.4, opacity=1.5).detach()
    center = torch.tensor(cam.c2w[:3, 3], dtype=torch.float32)
    g.means[:6] = center + 0.2 * torch.tensor(rng.normal(size=(6, 3)), dtype=torch.float32)  # around the camera
    image, truth = render(g, cam, settings), reference.render(g, cam, settings)
    good = ~truth.ambiguous
    assert float(good.double().mean()) > 0.5
    for _ in range(2):
        index = torch.tensor(rng.permutation(len(g)))
        other = render(g.take(index), cam, settings)
        for field in ("rgb", "alpha", "depth", "features"):
            x, y = getattr(image, field), getattr(other, field)
            assert float((x - y).abs().max()) < 2e-6 * max(1.0, float(x.abs().max())), field
    for field in ("rgb", "alpha", "features"):
        x, y = getattr(image, field), getattr(truth, field)
        # On bvh one ray may have lost a hit (docs/numerics.md).
        error = (x - y)[good].detach().abs().reshape(int(good.sum()), -1).amax(1).sort().values
        assert float(error[-2 if "bvh" in name else -1]) < 1e-5 * max(1.0, float(y.abs().max())), field


@pytest.mark.parametrize("name", EVERY)
def test_equal_keys_go_by_the_index(name):
    """Gaussians in the same place and of the same shape are composited as they are stored, as gsplat's sort does."""
    g = Gaussians.from_arrays(
        means=[[0.0, 0.0, 4.0]] * 3,
        quats=[[1.0, 0.0, 0.0, 0.0]] * 3,
        scales=[[0.5, 0.5, 0.5]] * 3,
        opacities=[0.5] * 3,
        sh=np.eye(3),
    )
    cam = Camera(K=[[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]], w2c=np.eye(4), width=8, height=8)
    settings = EVERY[name]
    for index in ([0, 1, 2], [2, 0, 1]):
        image, truth = (draw(g.take(index), cam, settings).rgb for draw in (render, reference.render))
        assert float((image - truth).abs().max()) < 1e-5
    assert float((render(g, cam, settings).rgb - image).abs().max()) > 0.05
