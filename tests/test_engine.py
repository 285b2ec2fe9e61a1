"""The engine's parts fit together: a response is one class, known by one name to settings, engine and oracle."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys

import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, settings
from drgs.checks import registry
from drgs.integrator import render, render_jvp
from drgs.oracle import reference
from drgs.tracing.responses import RESPONSES, response_of
from examples.narrow_response import NARROW


def test_responses_are_known_by_the_same_names():
    """Settings, engine and oracle have the same responses."""
    assert tuple(RESPONSES) == tuple(settings._PLANAR) == tuple(reference._FORMS)
    # Settings say it without loading the engine.
    assert {name: response.planar for name, response in RESPONSES.items()} == settings._PLANAR


def test_names_of_responses_load_nothing():
    """Settings are made, and a name that there is not is refused with those that there are, without Dr.Jit."""
    code = """
import sys
from drgs.settings import PRESETS, RenderSettings
[RenderSettings.preset(name) for name in PRESETS]
try:
    RenderSettings(response="narrow")
except ValueError as error:
    print(error)
print({"drjit", "torch"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    error = "RenderSettings: response must be one of peak, integral, ewa, got 'narrow'"
    assert done.stdout.splitlines() == [error, "set()"]


def test_a_response_of_another_package(tmp_path, monkeypatch):
    """An entry point of an installed package is a name for settings; what it can be combined with it says itself."""
    (tmp_path / "flat.py").write_text("from drgs.tracing.ewa import Ewa\nclass Flat(Ewa): pass\nFLAT = Flat()\n")
    info = tmp_path / "flat-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flat\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[drgs.responses]\nflat = flat:FLAT\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(RESPONSES, "_rows", dict(RESPONSES._rows))
    registry._entry_points.cache_clear()
    try:
        flat = settings.RenderSettings(response="flat", dilation=0.3)
        assert flat.planar
        assert response_of(flat) is sys.modules["flat"].FLAT
        with pytest.raises(NotImplementedError, match="response='flat' has one depth per Gaussian, use order='center'"):
            flat.replace(order="ray")
    finally:
        registry._entry_points.cache_clear()
        sys.modules.pop("flat", None)


def test_a_response_is_one_class(rng, monkeypatch):
    """A new one renders, and has gradients, tangents and information, with nothing else told of it."""
    monkeypatch.setitem(RESPONSES, "narrow", NARROW)
    plain = settings.RenderSettings(order="ray", extent=5.0)
    narrow = plain.replace(response="narrow")
    g, cam = gaussians(rng, 12, 4).detach(), camera(rng, (17, 13))
    cam = dataclasses.replace(cam, w2c=cam.w2c.detach())
    thin = g.replace(log_scales=g.log_scales - 0.5 * math.log(2))
    tangents = {"means": torch.randn(12, 3), "rotations": torch.randn(12, 3)}
    found, want = [], []
    for results, scene, s in ((found, g, narrow), (want, thin, plain)):
        leaves = {name: x.clone().requires_grad_() for name, x in scene.parameters().items()}
        out = render(scene.replace(**leaves), cam, s)
        results += [out.rgb.detach(), out.depth.detach(), *torch.autograd.grad(out.rgb.square().sum(), leaves.values())]
        results += [render_jvp(scene, cam, tangents, s).rgb, *fisher.diagonal(scene, cam, s).values()]
    for a, b in zip(found, want, strict=True):
        # The same numbers but for float32: 1e-7 of each hit, a few hundred of it in sums that cancel.
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))
