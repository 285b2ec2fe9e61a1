"""The error without a Gaussian against the float64 oracle without it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.information.diagonal import Diagonal
from drgs.information.quantity import Joint, ViewContext
from drgs.information.removal import REMOVAL, RemovalError, seen_through
from drgs.information.semantics import SemanticMetric
from drgs.settings import RenderSettings

Preset = RenderSettings.preset


def _errors_by_removing(g, cameras, settings, masks=None, metric=None, power=2):
    """(N,) by rendering the scene without each Gaussian; features in the metric W^T W of (K, D) W."""
    found = torch.zeros(len(g), dtype=torch.float64)
    everyone = torch.arange(len(g))
    with torch.no_grad():
        for k, cam in enumerate(cameras):
            whole = reference.render(g, cam, settings)
            for i in range(len(g)):
                without = reference.render(g.take(everyone[everyone != i]), cam, settings)
                square = (whole.rgb - without.rgb).square().sum(-1)
                if metric is not None:
                    square += ((whole.features - without.features) @ metric.T).square().sum(-1)
                if masks is not None and masks[k] is not None:
                    square *= masks[k].double() ** 2
                found[i] += square.pow(power / 2).sum()
    return found


def _scene(rng, alpha=None, **fields):
    """Twelve Gaussians, the first six of which have an opacity."""
    g = gaussians(rng, 12, 4, **fields).detach()
    if alpha is not None:
        logits = g.logit_opacities.clone()
        logits[:6] = math.log(alpha) - math.log1p(-alpha)
        g = g.replace(logit_opacities=logits)
    return g


@pytest.mark.core
@pytest.mark.every(4)
@pytest.mark.parametrize("alpha", [None, 1 - 1e-3, 1 - 1e-7, 1 - 1e-8])
@pytest.mark.parametrize("preset", ["exact", "fast", "inria", "gsplat", "3dgut", "integral"])
def test_error_without_each_gaussian(preset, alpha):
    """To 5e-6 of the largest, also where what is removed hides all behind it, whose alpha float32 may round to 1.

    The oracle's rays end where those of the sums do: what `transmittance_min` leaves out is of the images with and
    without the Gaussian alike.
    """
    settings = Preset("exact", response="integral") if preset == "integral" else Preset(preset)
    settings = settings.replace(background=(0.2, 0.5, 0.7))
    rng = np.random.default_rng(len(preset))
    g, cam = _scene(rng, alpha), camera(rng)
    deep = settings.replace(transmittance_min=seen_through(settings).transmittance_min)
    for power in (2, 1.5, 1):
        truth = _errors_by_removing(g, [cam], deep, power=power)
        found = fisher.removal_error(g, cam, settings, power)
        assert found.dtype == torch.float64
        assert float((truth > 1e-3 * truth.max()).double().mean()) > 0.5
        assert float((found - truth).abs().max() / truth.max()) < 5e-6


def test_rays_through_bvh():
    """Mitsuba's acceleration structure gives the same sums."""
    rng = np.random.default_rng(5)
    g, cam = _scene(rng, 1 - 1e-7), camera(rng)
    tiles = fisher.removal_error(g, cam, Preset("exact"))
    bvh = fisher.removal_error(g, cam, Preset("exact", traversal="bvh"))
    assert float((tiles - bvh).abs().max() / tiles.max()) < 1e-5


def test_diagonal_of_the_logit():
    """Of the response `peak` it is that over (1 - alpha)^2, where 1 - alpha has digits."""
    rng = np.random.default_rng(6)
    g, cam = _scene(rng), camera(rng)
    diagonal = fisher.diagonal(g, cam, groups=["logit_opacities"])["logit_opacities"]
    left = 1 - g.logit_opacities.double().sigmoid()
    torch.testing.assert_close(diagonal / left**2, fisher.removal_error(g, cam), rtol=1e-4, atol=1e-9)


def test_views_masks_and_weights_add_up():
    """Views add up, a mask multiplies what its view shows, weights the channels."""
    rng = np.random.default_rng(7)
    g, cams = _scene(rng), [camera(rng), camera(rng)]
    mask = torch.from_numpy(rng.uniform(0, 1, (22, 24))).float()
    found = fisher.removal_error(g, cams, masks=[mask, None])
    truth = _errors_by_removing(g, cams, Preset("exact"), masks=[mask, None])
    assert float((found - truth).abs().max() / truth.max()) < 5e-6
    parts = [fisher.removal_error(g, cams[0], channel_weights=np.eye(3)[c]) for c in range(3)]
    torch.testing.assert_close(sum(parts), fisher.removal_error(g, cams[0]), rtol=1e-5, atol=1e-12)


def test_features_in_the_metric_of_a_decoder():
    """Features are a part of the image where a metric says so; 17 channels take two traversals."""
    rng = np.random.default_rng(8)
    g, cam = _scene(rng, D=20), camera(rng)
    W = torch.from_numpy(rng.normal(size=(17, 20)))
    metric = SemanticMetric(W.T @ W, estimate="exact")
    found = fisher.removal_error(g, cam, semantics=metric)
    truth = _errors_by_removing(g, [cam], Preset("exact"), metric=W)
    assert float((found - truth).abs().max() / truth.max()) < 5e-6
    with pytest.raises(ValueError, match="features"):
        fisher.removal_error(g.replace(features=None), cam, semantics=metric)


def test_scene_that_moves():
    """Each view has its Gaussians: the sum over times is that of the Gaussians at these times."""
    rng = np.random.default_rng(9)
    g, cam = _scene(rng), camera(rng)
    step = torch.from_numpy(rng.normal(size=(12, 3))).float() * 0.3

    class Moving:
        def at(self, time):
            return g.replace(means=g.means + (time or 0) * step)

        def parameters(self):
            return g.parameters()

    cams = [dataclasses.replace(cam, time=time) for time in (0.0, 0.5, 1.0)]
    parts = [fisher.removal_error(Moving().at(x.time), x) for x in cams]
    torch.testing.assert_close(fisher.removal_error(Moving(), cams), sum(parts))


def test_what_no_view_shows():
    """Exactly 0, and of no Gaussians nothing."""
    rng = np.random.default_rng(10)
    g, cam = _scene(rng), camera(rng)
    away = g.replace(means=g.means + torch.tensor([0.0, 0.0, -100.0]))
    assert not fisher.removal_error(away, cam).any()
    assert fisher.removal_error(g.take([]), cam).shape == (0,)


def test_beside_other_quantities():
    """In one context with the diagonal, whose rays end earlier, neither changes the other's numbers."""
    rng = np.random.default_rng(11)
    g, cam, settings = _scene(rng, 1 - 1e-3), camera(rng), Preset("fast")
    both = Joint((("", Diagonal()), ("", RemovalError()))).compute(ViewContext(g, cam, settings))
    torch.testing.assert_close(both[REMOVAL], fisher.removal_error(g, cam, settings).float())
    torch.testing.assert_close(both["means"], fisher.diagonal(g, cam, settings)["means"].float())


def test_refuses_wrong_weights_and_masks():
    """In one line each."""
    rng = np.random.default_rng(12)
    g, cam = _scene(rng), camera(rng)
    with pytest.raises(ValueError, match=r"fisher.removal_error: power must be 1, 1.5 or 2, got 3"):
        fisher.removal_error(g, cam, power=3)
    with pytest.raises(ValueError, match=r"fisher.removal_error: channel_weights must be 3"):
        fisher.removal_error(g, cam, channel_weights=(1.0, -1.0, 1.0))
    with pytest.raises(ValueError, match=r"fisher.removal_error: masks\[0\] must have"):
        fisher.removal_error(g, cam, masks=[torch.ones(2, 2)])
