"""Masks in Fisher information: outside of them a view tells nothing, whichever way it is asked."""

from __future__ import annotations

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from dense_jacobian import GROUPS, error
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.checks.arguments import ArgumentError
from drgs.gain import Prior, information_gain
from drgs.information.semantics import SemanticMetric
from drgs.select import Cache, select
from drgs.settings import RenderSettings

KINDS = {
    "tiles": {},
    "center": {"order": "center"},
    "bvh": {"traversal": "bvh"},
    "ewa": {"response": "ewa", "order": "center", "dilation": 0.3},
    "along rays": {"sh_direction": "ray"},
}


def soft(rng, cam):
    """(H, W): a third 0, a third 1, the rest between."""
    drawn = torch.from_numpy(rng.uniform(-1, 2, (cam.height, cam.width))).float()
    return drawn.clamp(0, 1)


@pytest.mark.every(3)
@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_multiplied(kind, rng):
    """The oracle's Jacobian with each row times its pixel's mask: diagonal, blocks, columns."""
    settings = RenderSettings.preset("exact", **KINDS[kind]).replace(background=(0.2, 0.5, 0.7))
    g, cam, out = dense.scene(rng, settings, K=4)
    mask = soft(rng, cam)
    factor = mask.double().reshape(-1).repeat_interleave(3)
    J = {name: x * factor.reshape(-1, *[1] * (x.ndim - 1)) for name, x in dense.jacobian(g, out).items()}
    truth, rows = dense.squares(J), dense.stacked(J)
    found = fisher.diagonal(g, cam, settings, masks=[mask])
    for name in GROUPS:
        assert error(found[name], truth[name]) <= 1e-4, name
    blocks = torch.einsum("pni,pnj->nij", rows, rows)
    assert float((fisher.blocks(g, cam, settings, masks=[mask]) - blocks).abs().max()) <= 1e-4 * float(blocks.max())
    columns = fisher.diagonal(g, cam, settings, "columns", masks=[mask], groups=["means", "sh"])
    for name, x in columns.items():
        assert error(x, truth[name]) <= 1e-4, name


@pytest.mark.parametrize("what", ["exact", "fisherrf", "coverage", "blocks", "semantic"])
def test_halves_add_up(what, rng):
    """What a view says inside of a sharp mask and outside of it is what it says."""
    g, cam, settings = gaussians(rng, 10, 4, D=3, scale=0.25).detach(), camera(rng, (12, 10)), None
    inside = (torch.from_numpy(rng.uniform(size=(cam.height, cam.width))) < 0.5).float()
    asked = {
        "exact": lambda **x: fisher.diagonal(g, cam, settings, **x),
        "fisherrf": lambda **x: fisher.diagonal(g, cam, settings, "fisherrf", **x),
        "coverage": lambda **x: {"coverage": fisher.coverage(g, cam, settings, **x)},
        "blocks": lambda **x: {"blocks": fisher.blocks(g, cam, settings, **x)},
        "semantic": lambda **x: fisher.diagonal(g, cam, settings, semantics=SemanticMetric.of(None, 3), **x),
    }[what]
    whole, one, other = asked(), asked(masks=[inside]), asked(masks=[1 - inside])
    for name, x in whole.items():
        assert float(one[name].abs().max()) > 0
        torch.testing.assert_close(one[name] + other[name], x, rtol=1e-5, atol=1e-6 * float(x.abs().max()))


@pytest.mark.parametrize("method", ["exact", "columns", "probes"])
def test_masks_in_a_graph(method, rng):
    """Information is a number on the CPU, also where a mask is something that is learned."""
    g, cam = gaussians(rng, 3, 1, scale=0.25).detach(), camera(rng, (6, 5))
    mask = soft(rng, cam)
    ask = lambda x: fisher.diagonal(g, cam, method=method, probes=2, groups=["means"], masks=[x])["means"]  # noqa: E731
    found = ask(mask.clone().requires_grad_())
    assert (found.requires_grad, found.device.type) == (False, "cpu")
    torch.testing.assert_close(found, ask(mask))


def test_probes_know_masks(rng):
    """One channel of one pixel, or half of its light, is one row of J, of which random signs lose nothing."""
    g, cam = gaussians(rng, 6, 1, scale=0.25).detach(), camera(rng, (12, 10))
    seen = reference.render(g, cam, RenderSettings.preset("exact")).alpha.argmax()
    mask = torch.zeros(cam.height * cam.width)
    mask[seen] = 0.5
    ask = {"channel_weights": (1.0, 0.0, 0.0), "masks": [mask.reshape(cam.height, cam.width)]}
    found = fisher.diagonal(g, cam, method="probes", probes=2, **ask)
    truth = fisher.diagonal(g, cam, **ask)
    assert float(truth["means"].max()) > 0
    for name in GROUPS:
        torch.testing.assert_close(found[name], truth[name], rtol=1e-4, atol=1e-6 * float(truth[name].max()))


def test_known_views_tell_less(rng):
    """`select` asks known views within their masks, candidates as they are; a cache keeps both apart."""
    g, cache = gaussians(rng, 8, 1, scale=0.25).detach(), Cache()
    cameras = [camera(rng, (12, 10)) for _ in range(3)]
    known, candidates = cameras[:1], cameras[1:]
    mask = soft(rng, known[0])
    ask = {"criterion": "eig", "blocks": ("geometry",), "cache": cache}
    plain, masked = select(g, candidates, known, **ask), select(g, candidates, known, masks=[mask], **ask)
    assert masked.computed == 1
    assert all(a >= b for a, b in zip(masked.scores, plain.scores, strict=True))
    H, prior = fisher.diagonal(g, known, masks=[mask]), Prior(1e-6).in_scene(g, cameras)
    for camera_, score in zip(candidates, masked.scores, strict=True):
        gain = information_gain(fisher.diagonal(g, camera_), H, "eig", prior=prior)
        assert score == pytest.approx(gain.total, rel=1e-4)


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ([], "masks must be a list with one for each of 1 cameras, got 0"),
        (torch.ones(10, 12), "masks must be a list with one for each of 1 cameras, got a Tensor of shape"),
        ([torch.ones(3, 4)], r"masks\[0\] must have its camera's shape \(10, 12\)"),
        ([torch.full((10, 12), 2.0)], r"values in \[0, 1\], got \(10, 12\) within 2 and 2"),
        ([torch.full((10, 12), float("nan"))], r"values in \[0, 1\], got \(10, 12\) within nan"),
        ([np.ones((10, 12))], r"masks\[0\] must be .*Tensor"),
    ],
)
def test_bad_masks(rng, masks, message):
    """One line that names the mask."""
    g, cam = gaussians(rng, 3, 1).detach(), camera(rng, (12, 10))
    with pytest.raises(ArgumentError, match=message):
        fisher.diagonal(g, cam, masks=masks)
