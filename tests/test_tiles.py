"""Tile lists: complete, ordered, no longer than the screen bounds allow."""

from __future__ import annotations

import dataclasses
import math

import drjit as dr
import numpy as np
import pytest
import torch
from scenes_random import around_camera, camera, gaussians

from drgs import reference, runtime
from drgs.integrator import render
from drgs.settings import RenderSettings
from drgs.tracing import tiles
from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import Call
from drgs.tracing.recordings import without_recordings
from drgs.tracing.records import pack_records
from drgs.tracing.tiles import TILE, build


def _scene(g, cam, settings):
    """The `Projected` and the `Lists` of a view."""
    call = Call(g.detach(), dataclasses.replace(cam, w2c=cam.w2c.detach()), settings, frozenset())
    lib = runtime.dr_types()
    compositor, (record, *_) = call.prepare({n: to_drjit(lib, x) for n, x in call.inputs.items()})
    projected = compositor.traversal.projected
    lens = compositor.traversal.lens
    lists = build(lib, projected, settings, cam.width, cam.height, pack_records(lib, record), lens=lens)
    dr.eval(lists.index, lists.start, lists.end)
    return projected, lists


def _listed(lists):
    """Tile -> list of Gaussians, in order."""
    start, end, index = (np.asarray(x.numpy()) for x in (lists.start, lists.end, lists.index))
    return [index[a:b].tolist() for a, b in zip(start, end, strict=True)]


def listed_gaussians(g, cam, settings):
    """Lists of a view's tiles, and how many of these are in a row."""
    lists = _scene(g, cam, settings)[1]
    return _listed(lists), lists.columns


@pytest.mark.parametrize("response", ["peak", "integral", "ewa"])
@pytest.mark.parametrize("near", [False, True])
def test_every_hit_is_listed(rng, response, near):
    """Whatever the oracle finds at a pixel is in the list of its tile."""
    order = "center" if response == "ewa" else "ray"
    settings = RenderSettings(response=response, order=order)
    for _ in range(6):
        cam = camera(rng, (37, 21))
        g = gaussians(rng, 25, 1, anisotropy=1.2)
        g = (around_camera(g, cam) if near else g).detach()
        listed = _listed(_scene(g, cam, settings)[1])
        columns = -(-37 // TILE)
        extent = (2 * torch.log((g.opacities.double() * 25 / 1e-5).clamp(min=1))).sqrt()
        for i in range(len(g)):
            one = reference.render(g.take([i]), cam, settings.replace(extent=max(float(extent[i]), 1e-3)))
            hit = (one.count > 0) & (one.alpha > 1e-12)
            for y, x in hit.nonzero().tolist():
                assert i in listed[(y // TILE) * columns + x // TILE], (i, x, y)


def test_bounds_are_tight(rng):
    """In front of the camera, a Gaussian is listed in no tile that its silhouette's box does not touch."""
    settings = RenderSettings(extent=3.0)
    for _ in range(4):
        cam, g = camera(rng, (64, 48)), gaussians(rng, 20, 1, anisotropy=0.8, scale=0.05)
        projected, lists = _scene(g, cam, settings)
        box = np.stack([b.numpy() for b in projected.bounds], 1)
        # The silhouette by sampling the ellipsoid: its box, to the density of the samples.
        d = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(20000, 3))), dim=1)
        for i in range(len(g)):
            w, x, y, z = (g.quats[i] / g.quats[i].norm()).double().tolist()
            R = torch.tensor(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ],
                dtype=torch.float64,
            )
            points = (3 * d * g.scales[i].double()) @ R.T + g.means[i].double()
            pixels, _ = cam.project(points.detach().numpy())
            want = np.concatenate([pixels.min(0), pixels.max(0)])
            size = (pixels.max(0) - pixels.min(0)).max()
            assert np.abs(box[i] - want).max() < 0.02 * size + 2e-3


def test_order(rng):
    """`center` lists are sorted by (depth, index); ranges cover all entries exactly once."""
    cam, g = camera(rng, (40, 30)), gaussians(rng, 60, 1, scale=0.3)
    with torch.no_grad():
        g.means[30:40] = g.means[29]  # ties fall by index
    projected, lists = _scene(g, cam, RenderSettings())
    key, listed = projected.key.numpy(), _listed(lists)
    assert sum(map(len, listed)) == lists.pairs
    for entries in listed:
        assert entries == sorted(entries, key=lambda i: (key[i], i))


def test_nothing_listed(rng):
    """All Gaussians behind the camera or off the screen: empty lists, a black image."""
    cam, g = camera(rng, (9, 7)), gaussians(rng, 12, 1)
    with torch.no_grad():
        g.means.add_(torch.tensor(cam.c2w[:3, :3] @ [0, 0, -50.0] + cam.center))
    for order in ("center", "ray"):
        out = render(g, cam, RenderSettings(order=order), outputs="all")
        assert out.certificate["pairs"] == 0
        assert not out.rgb.any()
        assert not out.visibility.any()
        (found,) = torch.autograd.grad(out.rgb.sum(), g.means)
        assert not found.any()


def test_image_smaller_than_a_tile_and_larger(rng):
    """Sizes around multiples of the tile give the same pixels as the larger image they are cut from."""
    cam, g = camera(rng, (17, 17)), gaussians(rng, 20, 1, scale=0.3).detach()
    settings = RenderSettings.preset("exact")
    whole = render(g, cam, settings).rgb
    for width, height in ((1, 1), (7, 9), (8, 8), (16, 1), (17, 15)):
        part = dataclasses.replace(cam, width=width, height=height)
        torch.testing.assert_close(render(g, part, settings).rgb, whole[:height, :width], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_too_many_pairs(monkeypatch):
    """2^32 list entries are refused before anything of that size is allocated, however much memory there is."""
    monkeypatch.setattr("drgs.runtime.memory.available", lambda: None)
    rng = np.random.default_rng(0)
    cam, g = camera(rng, (2**15, 2**15)), gaussians(rng, 300, 1, scale=1e3)
    with pytest.raises(ValueError, match="fewer than 2\\^32 entries.*lower extent or image size"):
        _scene(g, cam, RenderSettings())


_CUT = {"alpha_min": 1 / 255, "transmittance_min": 1e-4}


@pytest.mark.parametrize("anisotropy", [0.5, 2.5])
@pytest.mark.parametrize(
    "fields",
    [
        {"order": "ray"},
        {"order": "ray", **_CUT},
        {"response": "integral", "order": "ray"},
        {"response": "integral", **_CUT},
        {"response": "ewa", "dilation": 0.3},
        {"response": "ewa", "dilation": 0.3, "culling": "gsplat", "fov_clamp": "gsplat", **_CUT},
        {"extent": 3.0},
    ],
    ids=lambda f: "-".join(map(str, f.values())),
)
def test_tiles_left_out_change_nothing(rng, monkeypatch, fields, anisotropy):
    """Listing a Gaussian only where a pixel may be hit gives the same bits as listing it in its whole box."""
    settings, pairs = RenderSettings(**fields), []
    monkeypatch.setattr(tiles, "_TEST_TILES_FROM", 0)
    for _ in range(3):
        cam = camera(rng, (61, 45))
        g = around_camera(gaussians(rng, 40, 4, scale=0.1, anisotropy=anisotropy, opacity=2.5), cam)
        images = []
        for whole in (False, True):
            with monkeypatch.context() as patch, without_recordings():
                if whole:
                    patch.setattr(tiles._Tiles, "may_hit", lambda self, x, y: self.lib.Bool(True))
                out = render(g.detach(), cam, settings, outputs=("count", "depth"))
                images.append(
                    torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None], out.count[..., None]], -1)
                )
                pairs.append(out.certificate["pairs"])
        assert torch.equal(*images)
    assert sum(pairs[::2]) < sum(pairs[1::2])


def test_a_gaussian_behind_the_camera_is_listed_where_it_reaches(rng):
    """What crosses the camera plane has the whole screen for its box, and few tiles that it can be seen in."""
    cam = camera(rng, (320, 240), turn=0.0)
    g = gaussians(rng, 50, 1).detach()
    c2w = torch.tensor(cam.c2w)
    local = torch.tensor(np.stack([rng.uniform(3, 4, 50), rng.uniform(3, 4, 50), rng.uniform(-0.5, 0.5, 50)], 1))
    g.means[:] = (local @ c2w[:3, :3].T + c2w[:3, 3]).float()
    g.log_scales[:] = math.log(0.3)
    settings = RenderSettings(extent=3.0)
    projected, lists = _scene(g, cam, settings)
    tiles_of_screen = lists.columns * lists.rows
    full = np.asarray(projected.alive.numpy()).sum()
    assert full > 20
    assert lists.pairs < 0.1 * full * tiles_of_screen


@pytest.mark.parametrize("preset", ["fast", "gsplat"])
def test_lists_of_other_lengths_need_no_other_kernel(rng, preset):
    """A kernel that knew how long the lists are would be compiled, and kept, for every picture of a fit."""
    settings = RenderSettings.preset(preset)
    g = gaussians(rng, 40, 1).detach()
    cameras = [camera(rng, (37, 21)) for _ in range(16)]
    lengths = {_scene(g, cam, settings)[1].pairs for cam in cameras}
    assert len(lengths) > 10

    def kernels(cam):
        """Of a picture."""
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            render(g, cam, settings)
            return {row["hash"] for row in dr.kernel_history() if row["type"] == dr.KernelType.JIT}

    kernels(cameras[0])  # what tests before this one have left to be evaluated is no picture's
    first = kernels(cameras[0])
    assert first
    # Dr.Jit may put the same operations in another order, which is another kernel; it does so now and then.
    others = set().union(*map(kernels, cameras)) - first
    assert len(others) < len(lengths) // 2
