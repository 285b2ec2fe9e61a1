"""Maps in the pixels of a view: the predictive variance, and the scores of other methods (FisherRF, Magic Moments).

Moments of the features along rays say how far what a pixel is made of differs from what the pixel shows:
Var_c = sum_i w_i f_ic^2 - (sum_i w_i f_ic)^2 in a pixel, w_i the weights of compositing. As sum w <= 1 it is >= 0, and
what is missing to 1 counts as a feature of 0. It is large where a ray mixes unlike things, whether or not any view has
seen them: dispersion along the ray, no uncertainty about parameters, so it needs no training views. The baseline
"Magic Moments" of [1] in the reading that is stated here: the sum over channels, averaged over pixels, for [1] does not
say how it becomes one number.

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from drgs.checks.arguments import must_be
from drgs.ellipsoids import Y_00, Gaussians
from drgs.information.backdrop import BACKDROP, CELLS, Sphere, backdrop_variance
from drgs.information.gains import variances
from drgs.information.groups import groups_of
from drgs.information.prior import Prior
from drgs.information.replay import Replay
from drgs.information.sums import Information
from drgs.integrator import render
from drgs.oracle import sh_colors

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.information.quantity import ViewContext
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings


def variance_map(
    view: ViewContext,
    weights: Information,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
    sphere: Sphere | None = None,
) -> torch.Tensor:
    """(H, W) float32: sum over channels and parameters k of J_pk^2 weights_k; see `drgs.fisher.variance_map`.

    Args:
        view: The view; a map has no mask.
        weights, channel_weights, semantics, sphere: The same as for `drgs.fisher.variance_map`.
    """
    where, seen = "fisher.variance_map", view.gaussians
    if semantics is not None:
        semantics.check(where, seen)
    known = {name: group for name, group in groups_of(seen).items() if name != "features" or semantics is not None}
    shapes = {BACKDROP: (CELLS, 3)} | {name: group.shape(seen) for name, group in known.items()}
    for name, x in weights.items():
        if name not in shapes:
            raise ValueError(f"{where}: weights must be of {', '.join(shapes)}, got {name!r}")
        must_be(where, f"weights of {name}", x, torch.Tensor, "as fisher.diagonal returns")
        if tuple(x.shape) != shapes[name]:
            raise ValueError(f"{where}: weights of {name} must have shape {shapes[name]}, got {tuple(x.shape)}")
    of_gaussians = {name: x for name, x in weights.items() if name != BACKDROP}
    variance = torch.zeros(view.camera.height, view.camera.width)
    if len(seen) and of_gaussians:
        variance = Replay(seen, view.camera, view.settings, semantics=semantics).variance(of_gaussians, channel_weights)
    if BACKDROP in weights:
        variance = variance + backdrop_variance(view, weights[BACKDROP], channel_weights, sphere)
    return variance


def fisherrf_map(
    gaussians: Gaussians, camera: Camera, known: Information, prior: Prior, settings: RenderSettings
) -> torch.Tensor:
    """(H, W) float32: each pixel's share of the score that FisherRF's rasterizer would give the view.

    It sums the channels before it squares: what it looks at is one gray image, the sum of the colors. Each parameter's
    square is divided by what is known of it, and by the derivative of its activation, which it multiplies once instead
    of twice. The map adds up to `eig` of method `fisherrf`.

    Args:
        gaussians: The Gaussians as the camera sees them.
        camera, settings: The same as for `drgs.render`.
        known: `drgs.fisher.diagonal(..., method="fisherrf")` of the known views.
        prior: lambda; that of a group which FisherRF does not have is not read.
    """
    g = gaussians.detach().replace(features=None)  # a map is numbers, of colors alone
    weights = {}
    own = dataclasses.replace(prior, groups={name: x for name, x in prior.groups.items() if name in known})
    variance = variances(known, own)
    inputs = g.parameters()
    for name, group in groups_of(g).items():
        if name in known and group.fisherrf is not None:
            weights[name] = variance[name] / group.fisherrf(inputs)
    # A color that is clamped at 0 is no part of the gray, and nothing is known by it. In float64, so that rounding does
    # not decide which these are.
    lit = (_colors(g, camera) > 0).to(g.sh)
    sh = torch.zeros_like(g.sh)
    count = lit.sum(1)
    sh[..., 0] = (g.sh * lit[:, None]).sum(2)
    sh[:, 0, 0] += torch.where(count > 0, 0.5 * count - 0.5, -1.0) / Y_00  # a color is 0.5 + Y sh: of n, 0.5 n
    if "sh" in weights:
        gray = torch.zeros_like(weights["sh"])
        gray[..., 0] = (weights["sh"] * lit.cpu()[:, None]).sum(2)
        weights["sh"] = gray
    behind = (float(sum(settings.background)), 0.0, 0.0)
    return Replay(g.replace(sh=sh), camera, settings.replace(background=behind)).variance(weights, (1.0, 0.0, 0.0))


def moments_map(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> torch.Tensor:
    """(H, W) float32 variance along the ray of every pixel, summed over channels, from one render of D + 1 channels.

    The channels are the features as they are stored, not decoded; of Gaussians without features the three colors, seen
    from the camera (without the background, and towards the means whatever `sh_direction` is).

    Args:
        gaussians: The Gaussians as the camera sees them.
        camera, settings: The same as for `drgs.render`.
    """
    g = gaussians.detach()  # a map is numbers
    values = g.features
    if values is None:
        values = _colors(g, camera)
    values = values.double()  # squares are rounded once, to the float32 that is rendered
    # sum_c w f_c^2 = w |f|^2 is one more channel.
    moments = torch.cat([values, values.square().sum(1, keepdim=True)], 1).float()
    features = render(g.replace(sh=g.sh[:, :1], features=moments), camera, settings, outputs=()).features
    assert features is not None  # there is at least one channel
    features = features.double().cpu()
    # A difference of equal numbers where a pixel shows one thing: rounding makes some of them negative.
    return (features[..., -1] - features[..., :-1].square().sum(-1)).clamp_min(0).float()


def _colors(g: Gaussians, camera: Camera) -> torch.Tensor:
    """(N, 3) float64 colors towards the means."""
    away = torch.from_numpy(g.origin - camera.center).to(g.means.device)
    return sh_colors(g.sh.double(), g.means.double() + away)
