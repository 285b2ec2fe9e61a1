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
inform about means, rotations, log-scales and opacities, too (coupled), and a channel of a feature has on average gamma
tr(W^T W) / D sum_p w_p^2. Without, they inform about themselves only (uncoupled).

Sources: Jiang et al. 2024 (FisherRF) for the criterion, with what its code computes instead under method "fisherrf";
Wilson et al. 2025 (POp-GS) for blocks. `exact` costs one more traversal than rendering. All of it stands on the
quantities of a view (`drgs.information.quantity`), which scores of candidates and all maps use as well. Nothing that is
returned has a graph: information is a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Unpack

import torch

from drgs.cameras import Camera
from drgs.checks.arguments import ArgumentError, must_be
from drgs.ellipsoids import Scene
from drgs.information.backdrop import BACKDROP, Backdrop, Sphere, backdrop_sphere
from drgs.information.choices import METHODS, Method, NetworkEstimate
from drgs.information.columns import PoseInformation, jacobian_columns
from drgs.information.diagonal import Coverage, DenseBlocks, Diagonal
from drgs.information.gains import DENSE, information_gain
from drgs.information.groups import GROUPS
from drgs.information.inputs import Masks, three_weights
from drgs.information.jacobian import BlockSums
from drgs.information.maps import variance_map as map_of_variance
from drgs.information.nuisances import NO_NUISANCES, Nuisances
from drgs.information.prior import Prior
from drgs.information.quantity import ViewContext, checked_views, once_per_time, sum_over_views
from drgs.information.removal import REMOVAL, RemovalError
from drgs.information.semantics import SemanticMetric
from drgs.information.sums import Information
from drgs.runtime import alone
from drgs.settings import RenderSettings
from drgs.splats import SplatScene, SplatTensors, scene_of
from drgs.tracing.inputs import check_view, gaussians_at

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
    "removal_error",
    "variance_map",
]

BLOCK = BlockSums.SIZE  # 13: means 3, rotations 3, log-scales 3, logit-opacity 1, base color 3


@alone
def diagonal(
    gaussians: Scene | None = None,
    cameras: Camera | Sequence[Camera] | None = None,
    settings: RenderSettings | None = None,
    method: Method = "exact",
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
        semantics: The metric in which features inform about the geometry; None: they do not (`exact`, `columns`,
            `probes`; only `exact` makes use of its `estimate`).
        masks: One for each camera: (H, W) in [0, 1] what its image is multiplied by before it is compared, as a fit
            does, so that squares are multiplied by its square; or None: 1. Outside, a view has no information.
        nuisances: Unknowns of each view that are eliminated from its information, its exposure and its pose
            (`drgs.information.elimination`); None: there are none. Not of `fisherrf`. Features inform about themselves
            alone, as they are, unless semantics make them a part of the image.
        splats: Instead of Gaussians and cameras the tensors of `drgs.rasterization`, by its names and in its shapes
            without leading axes: `means`, `quats`, `scales`, `opacities`, `colors`, `viewmats`, `Ks`, `width`,
            `height`, and maybe `sh_degree` and `backgrounds`.
    Returns:
        Group -> float64 tensor on the CPU. Given tensors, it is still about the raw parameters: for the
        scales divide H of `log_scales` by scales^2, for the opacities H of `logit_opacities` by
        (opacities (1 - opacities))^2. Of plain colors (N, D) the first three channels are `sh` (N, 1, min(D, 3)), for
        the colors to be divided by 1 / (4 pi); the others are `features`, which say nothing about the geometry.
    Raises:
        ValueError: If a method, group, weight or tensor is unknown or wrong, a parameter is not finite, or the
            Gaussians of a scene are not as many in all views.
    """
    backgrounds: list[tuple[float, ...]] = []
    weights = three_weights("fisher.diagonal", channel_weights)
    channels = 3
    if splats or isinstance(gaussians, torch.Tensor):
        given = _scene_of_tensors(gaussians, cameras, splats)
        settings = settings or RenderSettings.preset("gsplat")
        gaussians = given.gaussians
        cameras = given.cameras
        backgrounds = given.backgrounds
        channels = given.channels
        weights = [weight if k < channels else 0.0 for k, weight in enumerate(weights)]
    gaussians = once_per_time(gaussians)
    views, each, shown = checked_views("fisher.diagonal", gaussians, cameras, settings, masks)
    assert gaussians is not None  # which has been refused
    if backgrounds:  # every view has its own
        each = [own.replace(background=color) for own, color in zip(each, backgrounds, strict=True)]
    quantity = Diagonal(
        method,
        groups,
        probes=probes,
        seed=seed,
        channel_weights=weights,
        semantics=semantics,
        nuisances=nuisances or NO_NUISANCES,
    )
    total = sum_over_views(quantity, gaussians, views, each, shown)
    if "sh" in total:
        total["sh"] = total["sh"][..., :channels]
    return total


def _scene_of_tensors(gaussians: object, cameras: object, splats: SplatTensors) -> SplatScene:
    """The scene and cameras that the tensors of `drgs.rasterization` are; `diagonal` must get nothing beside them."""
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
        (N, 13, 13) float64 on the CPU: means 3, rotations 3, log-scales 3, logit-opacity 1, base color sh[0] 3.
    Raises:
        ValueError: If a weight, mask or parameter is wrong, or the Gaussians of a scene are not as many in all views.
    """
    gaussians = once_per_time(gaussians)
    views = checked_views("fisher.blocks", gaussians, cameras, settings, masks)
    weights = three_weights("fisher.blocks", channel_weights)
    return sum_over_views(DenseBlocks(weights, semantics, nuisances or NO_NUISANCES), gaussians, *views)[DENSE]


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
    gaussians = once_per_time(gaussians)
    views = checked_views("fisher.coverage", gaussians, cameras, settings, masks)
    return sum_over_views(Coverage(), gaussians, *views)["coverage"]


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
        semantics: The metric of the features, which help to determine the nuisances; no effect without any. None:
            only colors help.
    """
    gaussians = once_per_time(gaussians)
    cameras, each, shown = checked_views("fisher.backdrop", gaussians, cameras, settings, masks)
    if seen_opacity is not None and [x.shape for x in seen_opacity] != [(c.height, c.width) for c in cameras]:
        raise ValueError(
            f"fisher.backdrop: seen_opacity must be of the {len(cameras)} views and their sizes, got "
            f"{[tuple(x.shape) for x in seen_opacity]}; pass the alpha that drgs.render gives of the same views"
        )
    weights = three_weights("fisher.backdrop", channel_weights)
    quantity = Backdrop(sphere, False, weights, semantics, nuisances or NO_NUISANCES)
    return sum_over_views(quantity, gaussians, cameras, each, shown, seen_opacity)[BACKDROP]


@alone
def removal_error(
    scene: Scene,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    power: float = 2,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
    masks: Masks = None,
) -> torch.Tensor:
    """(N,) float64 change of the images if one Gaussian alone were not there: exact, in one traversal a view.

        error = drgs.fisher.removal_error(g, cameras)
        smaller = g.take(error > error.quantile(0.5))

    What no view shows has error 0. Errors of several Gaussians do not add up: of two that hide each other each has a
    small one. `drgs.prune` removes in rounds, therefore. See `drgs.information.removal`.

    Args:
        scene: N Gaussians, world frame, or a `drgs.ellipsoids.Scene`, whose Gaussians each camera sees at its time.
        cameras, settings: The same as for `diagonal`.
        power: Exponent of the norm, over the channels, of a pixel's change, summed over pixels and views: 2 sums
            squared colors. 1.5 and 1 say more of what many Gaussians change together.
        channel_weights: Factors of the squares of R, G and B.
        semantics: The metric in which features are a part of the image; None: colors are all of it.
        masks: One for each camera: (H, W) in [0, 1] what its image is multiplied by before it is compared; or None: 1.
    Raises:
        ValueError: If a power, weight or mask is wrong, or the Gaussians of a scene are not as many in all views.
    """
    if power not in (1, 1.5, 2):
        raise ValueError(f"fisher.removal_error: power must be 1, 1.5 or 2, got {power!r}; 2 sums up squares")
    scene = once_per_time(scene)
    views = checked_views("fisher.removal_error", scene, cameras, settings, masks)
    weights = three_weights("fisher.removal_error", channel_weights)
    return sum_over_views(RemovalError(power, weights, semantics), scene, *views)[REMOVAL]


@alone
def network(
    scene: Scene,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    *,
    estimate: NetworkEstimate = "diagonal",
    mode: str = "reverse",
    probes: int = 16,
    seed: int = 0,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
    masks: Masks = None,
    nuisances: Nuisances | None = None,
) -> Information:
    """Information of views about a scene's deformation network, summed over views; an estimate.

    Args:
        scene: A `drgs.ellipsoids.DeformableScene` with parameters named `phi.grid.*` or `phi.mlp.*`.
        cameras: One or several; each has a time.
        settings: Default `RenderSettings.preset("exact")`.
        estimate: `diagonal`, `trace` or `paper`, see `drgs.information.network`.
        mode: Mode of `trace`: `reverse`, or `forward`, whose tangents are carried some at a time through one
            traversal. With `diagonal` and `paper`, which itself uses both, pass `reverse`.
        probes: K, of each view; the error falls as 1 / sqrt(K).
        seed: Seed of the random signs, the same in all views.
        channel_weights: Inverse noise variances of R, G and B.
        semantics: The metric in which decoded features are rows, too; its `estimate` says how many channels they take.
        masks, nuisances: The same as for `drgs.fisher.diagonal`. J is then W^(1/2) J, W what the unknowns leave of the
            rows (`drgs.information.elimination`): each estimate is of H = J^T W J, and as unbiased as without.
    Returns:
        Group (`grid`, `mlp`; those that there are) -> float64 on the CPU: (P,) of its P parameters in the order of
        `scene.parameters()`, of `trace` and `paper` a number ().
    Raises:
        ValueError: If the scene has no such parameters, a name is unknown or a number out of range.
    """
    from drgs.information.network import NetworkInformation  # scenes that do not move have none

    scene = once_per_time(scene)
    views = checked_views("fisher.network", scene, cameras, settings, masks)
    quantity = NetworkInformation(
        estimate, mode, probes, seed, None, channel_weights, semantics, nuisances or NO_NUISANCES
    )
    return sum_over_views(quantity, scene, *views)


@alone
def network_variance_map(
    scene: Scene,
    camera: Camera,
    weights: Information,
    settings: RenderSettings | None = None,
    *,
    probes: int = 16,
    seed: int = 0,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    semantics: SemanticMetric | None = None,
) -> torch.Tensor:
    """(H, W) float32: an estimate of the sum over rows of a pixel and parameters k of phi of J_pk^2 weights_k.

    With weights 1 / (H_k + lambda) this is the predictive variance of a pixel because of the deformation. It is the
    mean of (J v)^2 over v = z sqrt(weights), z random signs: forward mode.

    Args:
        scene, camera, settings, probes, seed, channel_weights, semantics: The same as for `network`; the
            relative error of a pixel is about sqrt(2 / probes) at most, and sqrt(2 / (n probes)) if its n rows are
            orthogonal and equally long.
        weights: Group -> (P,) as `network` returns it, >= 0; groups that are missing weigh 0.
    Raises:
        ValueError: If the scene has no network, or a weight is negative, not finite or of another shape.
    """
    from drgs.information.network import NetworkInformation  # scenes that do not move have none

    view = _view("fisher.network_variance_map", scene, camera, settings)
    quantity = NetworkInformation("diagonal", "reverse", probes, seed, None, channel_weights, semantics)
    return quantity.variance_map(view, weights)


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
    Raises:
        ValueError: If a weight is not finite, or of an unknown group or another shape than its information.
    """
    where = "fisher.variance_map"
    view = _view(where, gaussians, camera, settings)
    must_be(where, "weights", weights, Mapping, "group -> tensor, as fisher.diagonal returns")
    return map_of_variance(view, weights, three_weights(where, channel_weights), semantics, sphere)


def pose_information(gaussians: Scene, camera: Camera, settings: RenderSettings | None = None) -> torch.Tensor:
    """(6, 6) float64: the information of a view about its own pose.

    Of the twist c2w <- exp(xi) c2w, rotation (radians) first, then translation (world units), in the axes of the world
    and about the Gaussians' origin, which is the world's 0 unless that is far away.
    """
    return PoseInformation().compute(_view("fisher.pose_information", gaussians, camera, settings))["pose"]


def _view(where: str, scene: Scene, camera: Camera, settings: RenderSettings | None) -> ViewContext:
    """One view, if these are a scene, a camera and settings."""
    scene = once_per_time(scene)
    check_view(where, gaussians_at(where, scene, camera), camera, settings)
    return ViewContext(scene, camera, settings or RenderSettings.preset("exact"))
