"""`RenderSettings.tolerance`: cut-offs change a color by less than it, in any scene, and time is saved for it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scenes_random import around_camera, camera, gaussians

from drgs import reference, render
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.settings import RenderSettings

C0 = math.sqrt(1 / (4 * math.pi))  # of SH of degree 0
EXACT = RenderSettings.preset("exact")
KINDS = {
    "tiles": EXACT,
    "bvh": EXACT.replace(traversal="bvh"),
    "center": EXACT.replace(order="center"),
    "integral": EXACT.replace(response="integral"),
    "ewa": EXACT.replace(response="ewa", order="center"),
}
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
ROUNDING = 2e-6  # of float32, relative to the range of a color


def errors(g, cam, settings, outputs=()):
    """Tolerance -> largest error of colors and features against the oracle without a cut, over their range."""
    truth = reference.render(g, cam, settings.replace(transmittance_min=0.0))
    clear = ~truth.ambiguous
    shown = {"rgb": (C0 * g.sh[:, 0].detach() + 0.5).clamp(min=0), "features": g.features.detach()}
    found = {}
    for tolerance in TOLERANCES:
        out = render(g.detach(), cam, settings.replace(tolerance=tolerance), outputs=outputs)
        found[tolerance] = (out.alpha.double() - truth.alpha)[clear].abs().max().item()
        for name, values in shown.items():
            span = torch.cat([values, torch.zeros(1, values.shape[1])])  # the background is 0
            off = (getattr(out, name).double() - getattr(truth, name))[clear].abs().amax(0)
            found[tolerance] = max(found[tolerance], (off.detach() / (span.amax(0) - span.amin(0))).max().item())
    return found


@pytest.mark.parametrize("name", KINDS)
def test_the_bound_holds_on_random_scenes(rng, name):
    """For a few Gaussians and for many, before and around the camera, with a depth and without."""
    settings = KINDS[name]
    for k, count in enumerate((8, 25, 150)):
        cam = camera(rng, (16, 11), skew=0.2)
        g = gaussians(rng, count, 1, 2, anisotropy=(0.1, 0.5, 1.2)[k], opacity=(1.0, 3.0, 8.0)[k])
        if k == 1:
            around_camera(g, cam)
        for outputs in ((), ("depth",)):
            for tolerance, error in errors(g, cam, settings, outputs).items():
                assert error <= tolerance + ROUNDING


def wall(count, sigmas, opacity, width=9):
    """Equal white Gaussians in a row behind one another, whose tails the middle of the view sees at `sigmas`."""
    f = 40.0
    K = np.array([[f, 0, width / 2], [0, f, width / 2], [0, 0, 1.0]])
    cam = Camera(K=K, w2c=torch.eye(4, dtype=torch.float64), width=width, height=width)
    scale = 0.05
    depth = torch.linspace(4.0, 4.4, count)
    means = torch.stack([sigmas * scale * torch.ones(count), torch.zeros(count), depth], 1)
    sh = torch.full((count, 1, 3), 0.5 / C0)
    logits = torch.full((count,), math.log(opacity / (1 - opacity)))
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    g = Gaussians(means, quats, torch.full((count, 3), math.log(scale)), logits, sh)
    return g, cam


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3])
def test_the_bound_is_tight_where_tails_add_up(tolerance):
    """60 tails just beyond the extent add up to more than a fifth of what is allowed, and not to more than it."""
    worst = 0.0
    for sigmas in np.arange(2.0, 6.0, 0.05):
        g, cam = wall(60, float(sigmas), 0.9)
        truth = reference.render(g, cam, EXACT.replace(transmittance_min=0.0)).rgb[4, 4]
        found = render(g, cam, EXACT.replace(tolerance=tolerance), outputs=()).rgb[4, 4]
        worst = max(worst, float((found - truth).abs().max()))
    assert 0.2 * tolerance < worst <= tolerance + ROUNDING


def test_a_ray_ends_where_the_tolerance_allows_it():
    """A tenth of the tolerance may be behind the end of a ray, unless transmittance_min is larger."""
    assert EXACT.replace(tolerance=1e-3).least_transmittance == pytest.approx(1e-4)
    assert EXACT.replace(tolerance=1e-3, transmittance_min=0.5).least_transmittance == 0.5
    assert EXACT.least_transmittance == EXACT.transmittance_min
    g, cam = wall(60, 0.0, 0.8)
    counts = [
        int(render(g, cam, EXACT.replace(tolerance=t), outputs=("count",)).count[4, 4]) for t in (1e-1, 1e-3, 1e-5)
    ]
    assert counts == [3, 6, 9]  # T = 0.2^n falls below 1e-2, 1e-4, 1e-6


def test_lists_are_shorter_for_a_larger_tolerance(rng):
    """What a tile lists falls with the tolerance, and none is what it was."""
    cam, g = camera(rng, (32, 24)), gaussians(rng, 600, 1, 2, scale=0.04)
    pairs = [
        render(g.detach(), cam, EXACT.replace(tolerance=t), outputs=()).certificate["pairs"] for t in (None, 1e-4, 1e-2)
    ]
    assert pairs[0] > pairs[1] > pairs[2]


@pytest.mark.parametrize(("fields", "message"), [({"tolerance": 0.0}, "must be > 0"), ({"tolerance": 2.0}, "1")])
def test_a_tolerance_is_a_share(fields, message):
    """0 and more than the whole range are refused."""
    with pytest.raises(ValueError, match=message):
        EXACT.replace(**fields)


def test_an_extent_and_a_tolerance_contradict_each_other():
    """The message says what to use."""
    with pytest.raises(NotImplementedError, match="tolerance decides on the extent, use extent=None"):
        RenderSettings.preset("fast", tolerance=1e-3)
