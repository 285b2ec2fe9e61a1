"""Fisher information of a view about the Gaussians that it shows.

Model: an image is y = S(parameters) with unit Gaussian noise in every channel of every pixel, so the information is
J^T J of the Jacobian J of S (Gauss-Newton; no photograph is needed). Parameters are the raw ones, in groups:

    means (N, 3)             world axes
    rotations (N, 3)         world-frame left perturbation R <- exp([w]x) R, radians
    log_scales (N, 3)
    logit_opacities (N,)
    sh (N, K, 3)             the direction that colors are evaluated at moves with the mean
    features (N,)            every channel of a feature has the same information, sum_p w_p^2

With `semantics` the features that are composited are part of the image, decoded: y = [RGB; sqrt(gamma) W F]. Then they
tell about means, rotations, log-scales and opacities, too (coupled), and a channel of a feature has gamma tr(W^T W) / D
sum_p w_p^2 on average. Without, they tell about themselves only (uncoupled).

Sources: Jiang et al. 2024 (FisherRF) for the criterion, with what its code computes instead under method "fisherrf";
Wilson et al. 2025 (POp-GS) for blocks. `exact` costs one more traversal than rendering (replay.py, jacobian.py).
What views say about a network that moves the Gaussians is in information/network.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Unpack

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Scene
from drgs.guards.arguments import ArgumentError, must_be
from drgs.guards.inputs import (
    Masks,
    check_any_scene,
    check_scene,
    check_view,
    gaussians_at,
    mask_list,
    some_cameras,
    three_weights,
)
from drgs.information.backdrop import (
    BACKDROP,
    CELLS,
    Sphere,
    backdrop_sphere,
    backdrop_variance,
    opacity_of,
    painted_opacity,
)
from drgs.information.choices import METHODS
from drgs.information.columns import jacobian_columns
from drgs.information.diagonal import check_same_parameters, diagonal_and_opacity
from drgs.information.elimination import BLOCK_INPUTS, ViewRows, backdrop_taken
from drgs.information.gains import information_gain
from drgs.information.groups import GROUPS, Information, groups_of
from drgs.information.jacobian import GEOMETRY
from drgs.information.nuisances import Nuisances
from drgs.information.prior import Prior
from drgs.information.replay import Replay
from drgs.information.semantics import SemanticMetric
from drgs.runtime import alone
from drgs.settings import RenderSettings
from drgs.splats import SplatScene, SplatTensors, scene_of

if TYPE_CHECKING:
    from drgs.information.network import network, network_variance_map

__all__ = [
    "BLOCK",
    "GROUPS",
    "METHODS",
    "Information",
    "Nuisances",
    "Prior",
    "SemanticMetric",
    "backdrop",
    "backdrop_sphere",
    "blocks",
    "coverage",
    "diagonal",
    "information_gain",
    "jacobian_columns",
    "network",
    "network_variance_map",
    "pose_information",
    "variance_map",
]

BLOCK = 13  # means 3, rotations 3, log-scales 3, logit-opacity 1, base color 3


def __getattr__(name: str) -> Any:
    """What is about networks is loaded at first access (PEP 562): scenes that do not move have none."""
    if name not in ("network", "network_variance_map"):
        raise AttributeError(f"module 'drgs.fisher' has no attribute {name!r}")
    from drgs.information import network as module

    return getattr(module, name)


@alone
def diagonal(
    gaussians: Scene | None = None,
    cameras: Camera | Sequence[Camera] | None = None,
    settings: RenderSettings | None = None,
    method: str = "exact",
    *,
    groups: Sequence[str] | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    probes: int = 16,
    seed: int = 0,
    semantics: SemanticMetric | None = None,
    masks: Masks = None,
    nuisances: Nuisances | None = None,
    **splats: Unpack[SplatTensors],
) -> Information:
    """The diagonal of J^T J, summed over views.

        information = drgs.diagonal(g, cameras)
        information["means"]  # (N, 3)

    Args:
        gaussians: N Gaussians, world frame, or a `drgs.ellipsoids.Scene`, whose Gaussians each camera sees at its time.
        cameras: One or several; nothing of a view is kept but its sum.
        settings: Default `RenderSettings.preset("exact")`; of tensors `preset("gsplat")`, as in `drgs.rasterization`.
        method: `exact`: squares of every pixel's and channel's derivative, in one traversal after the primal one.
            `columns`: the same from forward-mode columns, one for every parameter: for checks on small scenes.
            `probes`: mean of (J^T v)^2 over Rademacher v, unbiased, relative error about sqrt(2 / probes).
            `fisherrf`: what FisherRF's rasterizer computes: channels are summed before squaring, and the derivative of
            an activation is multiplied once instead of squared; no rotations.
        groups: Those wanted; default all of the Gaussians as the views see them. Of a `drgs.ellipsoids.DeformableScene`
            a name in its `parameters()`, such as a weight of a network, is the scene's own tensor (`columns`,
            `probes`), also where its Gaussians have the same name; `rotations` are then those of its `quats`.
        channel_weights: Inverse noise variances of R, G and B (`exact`, `columns`, `probes`).
        probes: Number of random images of method `probes`, of each view.
        seed: Seed of these.
        semantics: The metric in which features tell about the geometry; None: they do not (`exact`, `columns`,
            `probes`; only `exact` makes use of its `estimate`).
        masks: One for each camera: (H, W) in [0, 1] what its image is multiplied by before it is compared, as a fit
            does, so that squares are multiplied by its square; or None: 1. Outside, a view tells nothing.
        nuisances: Unknowns of each view that are eliminated from what it tells, its exposure and its pose
            (`drgs.information.elimination`); None: there are none. Not of `fisherrf`. Features tell about themselves
            alone, as they are, unless semantics make them a part of the image.
        splats: Instead of Gaussians and cameras the tensors of `drgs.rasterization`, by its names and in its shapes
            without leading axes: `means`, `quats`, `scales`, `opacities`, `colors`, `viewmats`, `Ks`, `width`,
            `height`, and maybe `sh_degree` and `backgrounds`.
    Returns:
        Group -> float64 tensor on the CPU. Of tensors, too, about the raw parameters: H of `log_scales` divided by
        scales^2 is about the scales, H of `logit_opacities` divided by (opacities (1 - opacities))^2 about the
        opacities. Of plain colors (N, D) the first three channels are `sh` (N, 1, min(D, 3)), divided by
        1 / (4 pi) about the colors themselves; the others are `features`, which say nothing about the geometry.
    Raises:
        ValueError: If a method, group, weight or tensor is unknown or wrong, a parameter is not finite, or the
            Gaussians of a scene are not as many in all views.
    """
    backgrounds: list[tuple[float, ...]] = []
    weights = three_weights("fisher.diagonal", channel_weights)
    channels = 3
    if splats or isinstance(gaussians, torch.Tensor):
        scene = _scene_of_tensors(gaussians, cameras, splats)
        settings = settings or RenderSettings.preset("gsplat")
        gaussians = scene.gaussians
        cameras = scene.cameras
        backgrounds = scene.backgrounds
        channels = scene.channels
        weights = [weight if k < channels else 0.0 for k, weight in enumerate(weights)]
    total, _ = diagonal_and_opacity(
        gaussians,
        cameras,
        settings,
        method,
        groups=groups,
        channel_weights=weights,
        probes=probes,
        seed=seed,
        semantics=semantics,
        masks=masks,
        nuisances=nuisances,
        backgrounds=backgrounds,
    )
    if "sh" in total:
        total["sh"] = total["sh"][..., :channels]
    return total


def _scene_of_tensors(gaussians: object, cameras: object, splats: SplatTensors) -> SplatScene:
    """What `diagonal` is asked about by the tensors of `drgs.rasterization`, which must then be all that it gets."""
    if isinstance(gaussians, torch.Tensor):
        raise ArgumentError(
            "fisher.diagonal: tensors must be passed by name, got one by place; use means=..., quats=..."
        )
    if gaussians is not None or cameras is not None:
        raise ArgumentError(
            f"fisher.diagonal: it must get Gaussians and cameras or the tensors of both, got {next(iter(splats))} "
            "besides; pass either"
        )
    return scene_of("fisher.diagonal", splats)


@alone
def blocks(
    gaussians: Scene,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
    masks: Masks = None,
    nuisances: Nuisances | None = None,
) -> torch.Tensor:
    """One dense block of J^T J for every Gaussian, summed over views.

    Args:
        gaussians, cameras, settings, channel_weights, semantics, masks, nuisances: The same as for `diagonal`.
    Returns:
        (N, 13, 13) float64: means 3, rotations 3, log-scales 3, logit-opacity 1, base color sh[0] 3.
    """
    cameras = _cameras_of("fisher.blocks", gaussians, cameras, settings)
    settings = settings or RenderSettings.preset("exact")
    count = len(gaussians_at("fisher.blocks", gaussians, cameras[0]))
    weights = three_weights("fisher.blocks", channel_weights)
    total = torch.zeros(count, BLOCK, BLOCK, dtype=torch.float64)
    for camera, mask in zip(cameras, mask_list("fisher.blocks", masks, cameras), strict=True):
        seen = gaussians_at("fisher.blocks", gaussians, camera)
        check_same_parameters("fisher.blocks", "blocks", tuple(total.shape), (len(seen), BLOCK, BLOCK))
        if semantics is not None:
            semantics.check("fisher.blocks", seen)
        if len(seen):
            total += Replay(seen, camera, settings, semantics=semantics, mask=mask).blocks(weights)
            rows = ViewRows.of(seen, camera, settings, weights, semantics, mask, nuisances)
            if rows is not None:
                total -= rows.taken_of_blocks(groups_of(seen, BLOCK_INPUTS))
    return total


@alone
def coverage(
    gaussians: Scene,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    masks: Masks = None,
) -> torch.Tensor:
    """(N,) float64 sum over views and pixels of w^2: the information about a color without direction.

    Args:
        gaussians, cameras, settings, masks: The same as for `diagonal`.
    """
    cameras = _cameras_of("fisher.coverage", gaussians, cameras, settings)
    settings = settings or RenderSettings.preset("exact")
    total = torch.zeros(len(gaussians_at("fisher.coverage", gaussians, cameras[0])), dtype=torch.float64)
    for camera, mask in zip(cameras, mask_list("fisher.coverage", masks, cameras), strict=True):
        seen = gaussians_at("fisher.coverage", gaussians, camera)
        check_same_parameters("fisher.coverage", "coverage", tuple(total.shape), (len(seen),))
        if len(seen):
            replay = Replay(seen, camera, settings, geometry=False, mask=mask)
            total += replay.sums((GEOMETRY,), [1.0] * 3)[:, GEOMETRY].cpu()
    return total


@alone
def backdrop(
    gaussians: Scene,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    masks: Masks = None,
    sphere: Sphere | None = None,
    seen_opacity: Sequence[torch.Tensor] | None = None,
    nuisances: Nuisances | None = None,
    semantics: SemanticMetric | None = None,
) -> torch.Tensor:
    """(1536, 3) float64 sum over views and pixels of (1 - alpha)^2: the information about the color behind everything,
    a row for each cell. See `drgs.information.backdrop`.

    Args:
        gaussians, cameras, settings, channel_weights, masks: The same as for `diagonal`.
        sphere: What the color is painted on, the same for all views that are compared, as `backdrop_sphere` makes it;
            None: infinitely far away.
        seen_opacity: (H, W) of each view, where they are known, as `drgs.render` gives them; None: they are rendered.
        nuisances: The same as for `diagonal`.
        semantics: The metric of the features, which show where the camera stands, too; None: only colors do.
    """
    cameras = _cameras_of("fisher.backdrop", gaussians, cameras, settings)
    if seen_opacity is not None and [x.shape for x in seen_opacity] != [(c.height, c.width) for c in cameras]:
        raise ValueError(
            f"fisher.backdrop: seen_opacity must be of the {len(cameras)} views and their sizes, got "
            f"{[tuple(x.shape) for x in seen_opacity]}; pass the alpha that drgs.render gives of the same views"
        )
    settings = settings or RenderSettings.preset("exact")
    weights = three_weights("fisher.backdrop", channel_weights)
    total = torch.zeros(CELLS, 3, dtype=torch.float64)
    known: Sequence[torch.Tensor | None] = seen_opacity or [None] * len(cameras)
    for camera, mask, opacity in zip(cameras, mask_list("fisher.backdrop", masks, cameras), known, strict=True):
        seen = opacity_of(gaussians, camera, settings) if opacity is None else opacity
        taken = backdrop_taken(gaussians, camera, settings, weights, semantics, mask, nuisances)
        total += painted_opacity(seen, camera, weights, mask, sphere, taken)
    return total


@alone
def variance_map(
    gaussians: Scene,
    camera: Camera,
    weights: Information,
    settings: RenderSettings | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
    sphere: Sphere | None = None,
) -> torch.Tensor:
    """(H, W) float32: sum over channels and parameters k of J_pk^2 weights_k.

    With weights 1 / (H_k + lambda) this is the predictive variance of a pixel, high where it is uncertain. With
    semantics it is that of the pixel's color and decoded features together; with channel weights 0, of the latter.

    Args:
        gaussians, camera, settings, channel_weights, semantics: The same as for `diagonal`.
        weights: Group -> tensor shaped like its information; groups that are missing weigh 0. `backdrop`,
            (1536, 3), is that of the color behind what the Gaussians leave open. Those above 3e32, as lambda = 0 makes
            them of what was hardly seen, count as 3e32.
        sphere: The same as for `backdrop`.
    """
    seen = gaussians_at("fisher.variance_map", gaussians, camera)
    check_view("fisher.variance_map", seen, camera, settings)
    must_be("fisher.variance_map", "weights", weights, Mapping, "group -> tensor, as fisher.diagonal returns")
    settings = settings or RenderSettings.preset("exact")
    if semantics is not None:
        semantics.check("fisher.variance_map", seen)
    known = {name: group for name, group in groups_of(seen).items() if name != "features" or semantics is not None}
    shapes = {BACKDROP: (CELLS, 3)} | {name: group.shape(seen) for name, group in known.items()}
    for name, x in weights.items():
        if name not in shapes:
            raise ValueError(f"fisher.variance_map: weights must be of {', '.join(shapes)}, got {name!r}")
        must_be("fisher.variance_map", f"weights of {name}", x, torch.Tensor, "as fisher.diagonal returns")
        if tuple(x.shape) != shapes[name]:
            raise ValueError(
                f"fisher.variance_map: weights of {name} must have shape {shapes[name]}, got {tuple(x.shape)}"
            )
    behind = weights.get(BACKDROP)
    if behind is not None and not bool(torch.isfinite(behind).all()):
        raise ValueError("fisher.variance_map: weights must be finite, got NaN or Inf; raise lambda above 0")
    weights = {name: x for name, x in weights.items() if name != BACKDROP}
    factors = three_weights("fisher.variance_map", channel_weights)
    found = torch.zeros(camera.height, camera.width)
    if len(seen) and weights:
        found = Replay(seen, camera, settings, semantics=semantics).variance(weights, factors)
    if behind is not None:
        found = found + backdrop_variance(seen, camera, behind, settings, factors, sphere).float()
    return found


def pose_information(gaussians: Scene, camera: Camera, settings: RenderSettings | None = None) -> torch.Tensor:
    """(6, 6) float64: what a view says about its own pose.

    Of the world-frame twist c2w <- exp(xi) c2w, rotation (radians) first, then translation (world units).
    """
    seen = gaussians_at("fisher.pose_information", gaussians, camera)
    check_view("fisher.pose_information", seen, camera, settings)
    colors = seen.replace(features=None)  # else their columns would be computed, too, for nothing
    flat = jacobian_columns(colors, camera, {"camera": range(6)}, settings).reshape(6, -1).double()
    return flat @ flat.T


def _cameras_of(where: str, scene: object, cameras: object, settings: RenderSettings | None) -> list[Camera]:
    """The cameras, if these are a scene and settings, too."""
    check_any_scene(where, scene)
    cameras = some_cameras(where, cameras)
    check_scene(where, gaussians_at(where, scene, cameras[0]), settings)
    return cameras
