"""Policies `blur` and `renderers`: their scores from renders that are made here, and what they rank first."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from test_semantic_information import gaussians, ring

import drgs
from drgs.information.quantity import ViewContext
from drgs.select import select
from drgs.selection.pictures import _Blur, _Renderers
from drgs.settings import RenderSettings


@pytest.fixture(scope="module")
def world():
    """12 Gaussians, two known views and four candidates."""
    rng = np.random.default_rng(0)
    cameras = ring(rng, 6)
    return gaussians(rng, 12, 4, scale=0.25).detach(), cameras[:2], cameras[2:]


def test_blur_is_the_laplacian_of_the_luma(world):
    """Minus the log of its variance, by numpy on the render; known views do not matter, two picks are the best."""
    g, train, candidates = world
    settings = RenderSettings.preset("fast", background=(0.2, 0.3, 0.1))
    found = select(g, candidates, train, 2, "blur", settings=settings)
    for camera, score in zip(candidates, found.scores, strict=True):
        y = drgs.render(g, camera, settings).rgb.double().numpy() @ [0.299, 0.587, 0.114]
        laplacian = y[:-2, 1:-1] + y[2:, 1:-1] + y[1:-1, :-2] + y[1:-1, 2:] - 4 * y[1:-1, 1:-1]
        assert score == pytest.approx(-np.log(laplacian.var() + 1e-12), rel=1e-5)
    assert [pick.index for pick in found.picks] == np.argsort(-np.array(found.scores))[:2].tolist()
    assert "blur ranks candidates one by one" in found.notes[0]
    assert select(g, candidates, [], 1, "blur", settings=settings).scores == found.scores


def test_blur_of_nothing(world):
    """A view of the background alone is the least sharp one there can be, and a picture of two pixels has no inside."""
    g, train, candidates = world
    gone = g.replace(logit_opacities=g.logit_opacities - 40)
    assert select(gone, candidates, train, 1, "blur").scores == pytest.approx([12 * np.log(10)] * 4)
    tiny = [camera.resized(2, 2) for camera in candidates]
    assert select(g, tiny, train, 1, "blur").scores == pytest.approx([12 * np.log(10)] * 4)


def test_renderers_disagree(world):
    """The variance of the four presets' renders; 0 where there is nothing to disagree about."""
    g, train, candidates = world
    found = select(g, candidates, train, 1, "renderers")
    for camera, score in zip(candidates, found.scores, strict=True):
        shown = [
            drgs.render(g, camera, RenderSettings.preset(name)).rgb.double().numpy()
            for name in ("exact", "fast", "gsplat", "3dgut")
        ]
        assert score == pytest.approx(np.var(shown, axis=0).mean(), rel=1e-5)
        assert score > 0
    gone = g.replace(logit_opacities=g.logit_opacities - 40)
    assert select(gone, candidates, train, 1, "renderers").scores == pytest.approx([0.0] * 4, abs=1e-12)


def test_workers_can_be_sent_them(world):
    """The quantities survive pickling, are computed alike and keep no graph."""
    g, _, candidates = world
    live = g.replace(means=g.means.clone().requires_grad_())
    settings = RenderSettings.preset("fast")
    for quantity in (_Blur(), _Renderers()):
        copy = pickle.loads(pickle.dumps(quantity))
        (again,) = copy.compute(ViewContext(live, candidates[0], settings)).values()
        (value,) = quantity.compute(ViewContext(g, candidates[0], settings)).values()
        assert torch.equal(again, value)
        assert not again.requires_grad
