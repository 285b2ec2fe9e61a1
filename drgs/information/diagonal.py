"""The diagonal of J^T J, summed over views, and the opacity found on the way; `drgs.fisher` is the public side."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import DeformableScene, Scene
from drgs.guards.inputs import Masks, check_any_scene, check_scene, gaussians_at, mask_list, some_cameras
from drgs.information.choices import METHODS
from drgs.information.columns import by_columns
from drgs.information.complement import left
from drgs.information.elimination import ViewRows
from drgs.information.groups import Group, groups_of
from drgs.information.nuisances import Nuisances
from drgs.information.probes import by_probes
from drgs.information.replay import Replay, WalkSums
from drgs.information.semantics import SemanticMetric
from drgs.runtime import alone
from drgs.settings import RenderSettings

__all__ = ["check_same_parameters", "diagonal_and_opacity"]


@alone
def diagonal_and_opacity(
    gaussians: Scene | None,
    cameras: Camera | Sequence[Camera] | None,
    settings: RenderSettings | None,
    method: str,
    *,
    groups: Sequence[str] | None = None,
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0),
    probes: int = 16,
    seed: int = 0,
    semantics: SemanticMetric | None = None,
    masks: Masks = None,
    nuisances: Nuisances | None = None,
    backgrounds: Sequence[tuple[float, ...]] = (),
    beside: Sequence[WalkSums] = (),
) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
    """The diagonal of J^T J, and the opacity of the views that it is of.

    Methods `exact` and `fisherrf` replay a traversal that composites the view, and so have its opacity for nothing: the
    block `backdrop`, which is about (1 - opacity)^2, then need not render the view a second time.

    Args:
        gaussians, cameras, settings, method, groups, channel_weights, probes, seed, semantics, masks, nuisances: Those
            of `drgs.fisher.diagonal`, of which messages speak.
        backgrounds: One for each view, in place of that of the settings; empty: none.
        beside: Sums of the hits of the one view that there is, with this mask and these semantics. Methods `exact` and
            `fisherrf` add to them on their way.
    Returns:
        Group -> float64 tensor on the CPU; and (H, W) float32 opacities on the CPU, one for each view, none of other
        methods and of views without a Gaussian.
    Raises:
        ValueError: As `drgs.fisher.diagonal`.
    """
    check_any_scene("fisher.diagonal", gaussians)
    cameras = some_cameras("fisher.diagonal", cameras)
    seen = gaussians_at("fisher.diagonal", gaussians, cameras[0])
    check_scene("fisher.diagonal", seen, settings)
    settings = settings or RenderSettings.preset("exact")
    if nuisances is not None and nuisances.names and method == "fisherrf":
        raise ValueError("fisher.diagonal: method fisherrf must have no nuisances, got some; it knows images only")
    wanted = _checked_groups(groups_of(seen, groups, gaussians), method, semantics)
    if semantics is not None:
        semantics.check("fisher.diagonal", seen)
    opacities: list[torch.Tensor] = []
    shapes = {name: group.shape(seen) for name, group in wanted.items()}
    total: dict[str, torch.Tensor] = {}
    shown = mask_list("fisher.diagonal", masks, cameras)
    for number, camera in enumerate(cameras):
        seen = gaussians_at("fisher.diagonal", gaussians, camera)
        for name, group in wanted.items():
            check_same_parameters("fisher.diagonal", name, shapes[name], group.shape(seen))
        if not len(seen):
            continue
        if backgrounds:  # every view has its own
            settings = settings.replace(background=backgrounds[number])
        own = {name: group for name, group in wanted.items() if group.owner == "scene"}
        theirs = {name: group for name, group in wanted.items() if name not in own}
        network = gaussians if isinstance(gaussians, DeformableScene) else None  # whose groups are `own`
        part: dict[str, torch.Tensor] = {}
        if method == "columns":
            rest = (shown[number], nuisances)
            part |= by_columns(seen, camera, settings, theirs, channel_weights, semantics, None, *rest)
            part |= by_columns(seen, camera, settings, own, channel_weights, semantics, network, *rest)
        elif method == "probes":
            draw = (probes, seed + number)
            rest = (shown[number], nuisances)
            part |= by_probes(seen, camera, settings, theirs, channel_weights, *draw, semantics, None, *rest)
            if own:
                part |= by_probes(seen, camera, settings, own, channel_weights, *draw, semantics, network, *rest)
        else:
            replay = Replay(seen, camera, settings, semantics=semantics, mask=shown[number])
            part |= replay.diagonal(wanted, channel_weights, method == "fisherrf", beside)
            opacities.append(replay.opacity)
            rows = ViewRows.of(seen, camera, settings, channel_weights, semantics, shown[number], nuisances)
            if rows is not None:
                part |= {name: left(part[name], lost) for name, lost in rows.lost(wanted).items()}
        for name in wanted:
            found = part[name].to(torch.float64)
            total[name] = total[name].add_(found) if name in total else found
    if not total:  # no view has Gaussians
        total = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items()}
    return total, opacities


def _checked_groups(wanted: dict[str, Group], method: str, semantics: SemanticMetric | None) -> dict[str, Group]:
    """Those of the wanted groups that a method has, which must know tensors of a scene where there are any."""
    if method not in METHODS:
        raise ValueError(f"fisher.diagonal: method must be one of {', '.join(METHODS)}, got {method!r}")
    if semantics is not None and method == "fisherrf":
        raise ValueError("fisher.diagonal: method fisherrf must have no semantics, got some; it is about colors only")
    for name, group in wanted.items():
        methods = ("columns",) if group.outputs != (0, 3) else ("columns", "probes")
        if group.owner == "scene" and method not in methods:
            raise ValueError(
                f"fisher.diagonal: method of group {name!r} must be {' or '.join(map(repr, methods))}, got {method!r}; "
                "it is a tensor of the scene: for those of its Gaussians pass scene.at(time)"
            )
    known = {name: group for name, group in wanted.items() if method != "fisherrf" or group.fisherrf}
    if wanted and not known:
        raise ValueError(
            f"fisher.diagonal: groups of method fisherrf must have more than {', '.join(wanted)}, which it does not "
            "know; name another one, or use method exact"
        )
    return known


def check_same_parameters(where: str, name: str, first: tuple[int, ...], shape: tuple[int, ...]) -> None:
    """Refuse to add up what views say about Gaussians that are not as many in each."""
    if first != shape:
        raise ValueError(
            f"{where}: a scene must have as many Gaussians and coefficients in all views, got {name} of shape "
            f"{first} in the first and {shape} in another; take views of one time"
        )
