"""The engine's parts fit together: a response is one class, known by one name to settings, engine and oracle."""

from __future__ import annotations

import dataclasses
import math
import typing

import torch
from scenes_random import camera, gaussians

from drgs import fisher, reference, settings
from drgs.integrator import render, render_jvp
from drgs.tracing.responses import RESPONSES
from drgs.tracing.responses.peak import Peak


def test_responses_are_known_by_the_same_names():
    """Settings, engine and oracle have the same responses."""
    names = typing.get_args(typing.get_type_hints(settings.RenderSettings)["response"])
    assert tuple(RESPONSES) == names == tuple(reference._FORMS)
    assert {name for name in names if settings.RenderSettings(response=name).planar} == set(settings._PLANAR)


class Narrow(Peak):
    """a = alpha exp(-rho^2): that of `peak` for Gaussians thinner by sqrt(2)."""

    name = "narrow"

    def along(self, r, ray, world):
        rho2, key, u = super().along(r, ray, world)
        return 2 * rho2, key, u

    def slopes(self, r, extra, ray, world):
        *moves, strength = super().slopes(r, extra, ray, world)
        return [*(2 * x for x in moves), strength]


def test_a_response_is_one_class(rng, monkeypatch):
    """A new one renders, and has gradients, tangents and information, with nothing else told of it."""
    monkeypatch.setitem(RESPONSES, "narrow", Narrow())
    plain = settings.RenderSettings(order="ray", extent=5.0)
    narrow = dataclasses.replace(plain)
    object.__setattr__(narrow, "response", "narrow")  # the settings' own list of names is not part of this test
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
