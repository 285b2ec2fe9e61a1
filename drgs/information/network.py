"""Fisher information of a view about the network that moves a scene's Gaussians, by random probes.

phi, the network's parameters, is the scene's tensors named `phi.grid.*` and `phi.mlp.*`. The image's rows are its
colors and, with semantics, its decoded features, each divided by its noise; J is their Jacobian by phi, through the
Gaussians at the time of the view, and H = J^T J. A parameter of phi moves many Gaussians, so nothing is exact that is
cheap:

    diagonal   mean of (J^T u)^2, u random signs in every row: the diagonal of H [1]; relative error of an entry
               sqrt(2 / probes)
    trace      mean of |J^T u|^2 (reverse mode: the diagonal's sum) or of |J v|^2 (forward mode), v random signs in
               every parameter: tr H
    paper      mean of |H v|^2, the estimator that [2] states: tr(H^2), not tr H

Each by group: `grid` and `mlp`. Of `paper`, a group's part is the sum over its rows of H, whose columns are all of
phi, so that the parts add up to tr(H^2).

The random signs are the same in each view. Then equal views say the same, a candidate that repeats a known view has a
ratio of at most 1 as it should, and a cache may keep what was estimated. 1 / H is too large on average by a factor of
about K / (K - 2) where one view of K probes is all that is known of a parameter: take 8 or more.

Reference:
    [1] Bekas, Kokiopoulou, Saad: An estimator for the diagonal of a matrix, 2007; Hutchinson 1990 for the trace.
    [2] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771, section 3.3.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import torch

from drgs.cameras import Camera
from drgs.ellipsoids import DeformableScene
from drgs.guards.arguments import must_be
from drgs.guards.inputs import (
    Masks,
    check_any_scene,
    check_view,
    gaussians_at,
    mask_list,
    some_cameras,
    three_weights,
)
from drgs.information.choices import NETWORK_ESTIMATES, NetworkEstimate
from drgs.information.complement import Eliminated
from drgs.information.elimination import eliminated_of
from drgs.information.hit_sums import HitSums
from drgs.information.jacobian import GEOMETRY
from drgs.information.network_groups import NETWORK_GROUPS, network_groups
from drgs.information.network_rows import NetworkRows
from drgs.information.nuisances import Nuisances
from drgs.information.once_per_time import once_per_time
from drgs.information.pullback import Pullback
from drgs.runtime import alone
from drgs.settings import RenderSettings
from drgs.tracing.call import Call
from drgs.tracing.errors import own_errors
from drgs.tracing.tangents import push_forward

if TYPE_CHECKING:
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.information.semantics import SemanticMetric
    from drgs.information.sums import Information

__all__ = ["NetworkProbes", "network", "network_variance_map"]

_FLOATS = 1 << 23  # of the tangents that one traversal carries, or of images and what is summed up along them
_BATCH = 16  # tangents of one traversal


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
    """What views say about a scene's deformation network, summed over views; an estimate.

    Args:
        scene: A `drgs.ellipsoids.DeformableScene` with parameters named `phi.grid.*` or `phi.mlp.*`.
        cameras: One or several; each has a time.
        settings: Default `RenderSettings.preset("exact")`.
        estimate: `diagonal`, `trace` or `paper`, see the module's text.
        mode: Mode of `trace`: `reverse`, or `forward`, whose tangents are carried some at a time through one
            traversal. `diagonal` has reverse mode only, `paper` needs both.
        probes: K, of each view; the error falls as 1 / sqrt(K).
        seed: Seed of the random signs, the same in all views.
        channel_weights: Inverse noise variances of R, G and B.
        semantics: The metric in which decoded features tell, too; its `estimate` says how many channels they take.
        masks, nuisances: The same as for `drgs.fisher.diagonal`. J is then W^(1/2) J, W what the unknowns leave of the
            rows (`drgs.information.elimination`): each estimate is of H = J^T W J, and as unbiased as without.
    Returns:
        Group (`grid`, `mlp`; those that there are) -> float64 on the CPU: (P,) of its P parameters in the order of
        `scene.parameters()`, of `trace` and `paper` a number ().
    Raises:
        ValueError: If the scene has no such parameters, a name is unknown or a number out of range.
    """
    where = "fisher.network"
    moving, groups = _checked(where, once_per_time(scene), estimate, mode, probes)
    total = {name: torch.zeros(_size(own) if estimate == "diagonal" else (), dtype=torch.float64)
             for name, own in groups.items()}  # fmt: skip
    views = some_cameras(where, cameras)
    for camera, mask in zip(views, mask_list(where, masks, views), strict=True):
        view = _View.of(where, moving, camera, settings, channel_weights, semantics, mask, nuisances)
        if view is None:
            continue
        with own_errors():
            for part in _ESTIMATORS[estimate, mode](view, groups, probes, torch.Generator().manual_seed(seed)):
                for name, x in part.items():
                    total[name] += x.cpu()  # where the field's parameters live is the caller's
    return {name: x / probes for name, x in total.items()}


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
        scene, camera, settings, probes, seed, channel_weights, semantics: The same as for `network`; a pixel of n rows
            has a relative error of about sqrt(2 / (n probes)) at most sqrt(2 / probes).
        weights: Group -> (P,) as `network` returns it, >= 0; groups that are missing weigh 0.
    """
    where = "fisher.network_variance_map"
    moving, groups = _checked(where, scene, "diagonal", "reverse", probes)
    must_be(where, "weights", weights, Mapping, "group -> tensor, as fisher.network returns")
    for name, x in weights.items():
        if name not in groups:
            raise ValueError(f"{where}: weights must be of {', '.join(groups)}, got {name!r}; drop it")
        size = _size(groups[name])
        if tuple(x.shape) != (size,):
            raise ValueError(f"{where}: weights of {name} must have shape ({size},), got {tuple(x.shape)}")
        if not bool((torch.isfinite(x) & (x >= 0)).all()):
            raise ValueError(f"{where}: weights of {name} must be finite and >= 0, got others; raise lambda above 0")
    view = _View.of(where, moving, camera, settings, channel_weights, semantics)
    total = torch.zeros(camera.height * camera.width, dtype=torch.float64)
    if view is None or not weights:
        return total.float().reshape(camera.height, camera.width)
    roots = {name: x.double().cpu().sqrt() for name, x in weights.items()}
    generator = torch.Generator().manual_seed(seed)
    with own_errors():
        for count in view.batches(groups, probes):
            tangents: dict[str, torch.Tensor] = {}
            for name, root in roots.items():
                tangents |= _unflat(groups[name], _signs(generator, count, len(root)) * root)
            total += view.push(tangents).square().sum((0, 2))
    return (total / probes).float().reshape(camera.height, camera.width)  # a map, as `fisher.variance_map` gives it


Groups = Mapping[str, Mapping[str, torch.Tensor]]  # group -> name -> parameter


class NetworkProbes:
    """Estimate `diagonal` of `network` of one view, whose hits may be summed up by a traversal for something else.

    Attributes:
        sums: The sums of the hits along the random images. Whoever replays the view may add to them, if colors, and
            features by `semantics`, are what it replays; otherwise it is done as they are needed.
        semantics: The metric of the features; None: colors alone.
    """

    def __init__(self, rows: NetworkRows, sums: HitSums, groups: Groups, semantics: SemanticMetric | None) -> None:
        self.sums = sums
        self.semantics = semantics
        self._rows = rows
        self._groups = groups

    @classmethod
    @alone
    def of(
        cls,
        scene: Scene,
        camera: Camera,
        settings: RenderSettings,
        *,
        probes: int,
        channel_weights: Sequence[float],
        semantics: SemanticMetric | None,
        mask: torch.Tensor | None,
        nuisances: Nuisances | None,
    ) -> NetworkProbes | None:
        """None where more than the geometry of Gaussians moves, images do not fit at a time, or nothing is seen.

        Args:
            scene, camera, settings, probes, channel_weights, semantics, mask, nuisances: The same as for `network`.
        """
        where = "fisher.network"
        moving, groups = _checked(where, scene, "diagonal", "reverse", probes)
        view = _View.of(where, moving, camera, settings, channel_weights, semantics, mask, nuisances)
        rows = None if view is None else view.network_rows(groups)
        if view is None or rows is None or probes > view.most_images:
            return None
        images = _first_signs(probes, view.pixels, view.rows)
        return cls(rows, rows.along(view.cotangents(images)), groups, semantics)

    @alone
    def information(self) -> Information:
        """What `network` returns of the view."""
        with own_errors():
            found = _by_group(self._groups, self._rows.squares(self.sums))
        return {name: x.double().div_(len(self.sums.images)) for name, x in found.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class _View:
    """The rows of a view's image, each divided by its noise, as a function of phi.

    Attributes:
        scene: What it shows.
        seen: Its Gaussians at the time of the view, without a graph: Dr.Jit differentiates through `deformed`, of which
            these are only the values now.
        deformed: The scene with the features that are rows, if any.
        camera, settings: The view.
        semantics: The metric of these features.
        weights: (C,) what rows are multiplied by: colors, then semantic channels.
        mask: (H, W) what all of them are multiplied by besides; None: 1.
        nuisances: The view's own unknowns, which rows are freed of.
    """

    scene: DeformableScene
    seen: Gaussians
    deformed: DeformableScene
    camera: Camera
    settings: RenderSettings
    semantics: SemanticMetric | None
    weights: torch.Tensor
    mask: torch.Tensor | None = None
    nuisances: Nuisances | None = None

    @classmethod
    def of(
        cls,
        where: str,
        scene: DeformableScene,
        camera: Camera,
        settings: RenderSettings | None,
        channel_weights: Sequence[float],
        semantics: SemanticMetric | None,
        mask: torch.Tensor | None = None,
        nuisances: Nuisances | None = None,
    ) -> _View | None:
        """A scene at the time of a camera; None if there is nothing to see."""
        with torch.no_grad():  # derivatives are taken from Dr.Jit's side
            seen = gaussians_at(where, scene, camera)
        check_view(where, seen, camera, settings)
        if not len(seen) or not camera.width * camera.height:
            return None
        weights = torch.tensor(three_weights(where, channel_weights), dtype=torch.float64).sqrt()
        deformed: DeformableScene = scene
        if semantics is None:
            seen = seen.replace(features=None)
        else:
            semantics.check(where, seen)
            assert seen.features is not None  # `check` has refused it
            # Squares of few channels add up to those of all decoded ones, in one traversal.
            directions = semantics.directions(seen.features)
            deformed = reduced = _Reduced(scene, directions)
            seen = reduced.reduced(seen)
            weights = torch.cat([weights, torch.full((directions.shape[1],), semantics.weight**0.5)])
        settings = settings or RenderSettings.preset("exact")
        return cls(scene, seen.detach(), deformed, camera, settings, semantics, weights, mask, nuisances)

    @functools.cached_property
    def call(self) -> Call:
        """The call of the view."""
        return Call(self.seen, self.camera, self.settings, frozenset(), scene=self.deformed)

    @functools.cached_property
    def scales(self) -> torch.Tensor:
        """(C,) what the call's channels are multiplied by; with a mask (pixels, C)."""
        if self.mask is None:
            return self.weights
        return self.mask.detach().double().cpu().reshape(-1, 1) * self.weights  # a number, whatever graph it is in

    @functools.cached_property
    def eliminated(self) -> Eliminated | None:
        """What the view's own unknowns explain of the rows, which are freed of it; None: nothing."""
        if self.nuisances is None or not self.nuisances.names:
            return None
        return eliminated_of(self.call, self.scales, self.nuisances)

    @property
    def pixels(self) -> int:
        """How many there are."""
        return self.camera.width * self.camera.height

    @property
    def rows(self) -> int:
        """C, rows of a pixel."""
        return len(self.weights)

    @property
    def most_images(self) -> int:
        """How many images are pulled back at a time."""
        return max(1, _FLOATS // max(self.pixels * self.rows, len(self.seen) * GEOMETRY))

    def squares(self, groups: Groups) -> Callable[[torch.Tensor], Information]:
        """Squares of J^T u, summed over (K, pixels, C) rows u: group -> (P,)."""
        rows = self.network_rows(groups)
        if rows is not None:
            return lambda images: _by_group(groups, rows.squares(rows.along(self.cotangents(images))))
        pull = Pullback(self.call, [name for own in groups.values() for name in own])

        def each(images: torch.Tensor) -> Information:
            total = {name: torch.zeros_like(x) for own in groups.values() for name, x in own.items()}
            for image in self.cotangents(images, self.scales):
                for name, slope in pull(image[:, :3], image[:, 3:] if image.shape[1] > 3 else None).items():
                    total[name] += slope.square()
            return _by_group(groups, total)

        return each

    def network_rows(self, groups: Groups) -> NetworkRows | None:
        """J^T by the geometry that phi moves; None where it reaches the image otherwise, too."""
        names = [name for own in groups.values() for name in own]
        rows = NetworkRows(self.scene, self.camera, self.settings, self.semantics, names, self.mask)
        return rows if rows.are_of_geometry else None

    def cotangents(self, images: torch.Tensor, scales: torch.Tensor | None = None) -> torch.Tensor:
        """(K, pixels, C) rows as float32 cotangents of channels, which the scales multiply; None: the weights."""
        if self.eliminated is not None:
            images = self.eliminated.root(images.double())
        factors = self.weights if scales is None else scales
        return (images * factors.to(images.dtype)).float()

    def push(self, tangents: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """(K, pixels, C) float64 tangents of the rows, along (K, ...) tangents of phi by name."""
        out = push_forward(self.call, dict(tangents))
        rows = out.rgb if out.features is None else torch.cat([out.rgb, out.features], -1)
        scaled = rows.double().cpu().flatten(1, 2) * self.scales
        return scaled if self.eliminated is None else self.eliminated.root(scaled)

    def batches(self, groups: Groups, count: int) -> Iterator[int]:
        """How many of `count` tangents are carried through each traversal."""
        largest = max(self.pixels * self.rows, sum(_size(own) for own in groups.values()))
        step = max(1, min(_BATCH, _FLOATS // largest))
        return iter([min(step, count - start) for start in range(0, count, step)])


class _Reduced:
    """A scene whose features are replaced by a few channels of them."""

    def __init__(self, scene: DeformableScene, directions: torch.Tensor) -> None:
        self.scene = scene
        self.directions = directions

    def parameters(self) -> dict[str, torch.Tensor]:
        """Those of the scene."""
        return self.scene.parameters()

    def at(self, time: float | None) -> Gaussians:
        """As the scene, reduced."""
        return self.reduced(self.scene.at(time))

    def deform(self, parameters: dict[str, torch.Tensor], time: float | torch.Tensor | None) -> Gaussians:
        """As the scene, reduced."""
        return self.reduced(self.scene.deform(parameters, time))

    def reduced(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians with (N, K) channels for features."""
        assert gaussians.features is not None  # those of the views have some
        features = gaussians.features
        return gaussians.replace(features=features @ self.directions.to(features.device, features.dtype))


# -------------------------------------------------- estimators: what each probe adds, by group


def _diagonal(view: _View, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    squares = view.squares(groups)
    for start in range(0, probes, view.most_images):
        count = min(view.most_images, probes - start)
        yield squares(_signs(generator, count, view.pixels, view.rows, dtype=torch.float32))


def _trace_reverse(view: _View, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    for part in _diagonal(view, groups, probes, generator):
        yield {name: x.sum() for name, x in part.items()}


def _trace_forward(view: _View, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    for name, own in groups.items():
        for count in view.batches(groups, probes):
            yield {name: view.push(_unflat(own, _signs(generator, count, _size(own)))).square().sum()}


def _paper(view: _View, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    squares = view.squares(groups)
    for count in view.batches(groups, probes):
        tangents: dict[str, torch.Tensor] = {}
        for own in groups.values():
            tangents |= _unflat(own, _signs(generator, count, _size(own)))
        yield {name: x.sum() for name, x in squares(view.push(tangents)).items()}


_ESTIMATORS = {
    ("diagonal", "reverse"): _diagonal,
    ("trace", "reverse"): _trace_reverse,
    ("trace", "forward"): _trace_forward,
    ("paper", "reverse"): _paper,
}


def _signs(generator: torch.Generator, *shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """-1 or 1; the same of each type."""
    return torch.randint(0, 2, shape, generator=generator, dtype=dtype).mul_(2).sub_(1)


@functools.lru_cache(maxsize=1)
def _first_signs(*shape: int) -> torch.Tensor:
    """Random images as of seed 0, the same for each view of a size: not to be changed."""
    return _signs(torch.Generator().manual_seed(0), *shape, dtype=torch.float32)


def _by_group(groups: Groups, found: Mapping[str, torch.Tensor]) -> Information:
    """Group -> (P,) of what is known by parameter."""
    return {group: torch.cat([found[name].flatten() for name in own]) for group, own in groups.items()}


def _size(own: Mapping[str, torch.Tensor]) -> int:
    return sum(x.numel() for x in own.values())


def _unflat(own: Mapping[str, torch.Tensor], rows: torch.Tensor) -> dict[str, torch.Tensor]:
    """(K, P) rows as tensors (K, ...) by name."""
    parts = rows.split([x.numel() for x in own.values()], 1)
    return {name: part.reshape(len(rows), *x.shape) for (name, x), part in zip(own.items(), parts, strict=True)}


# -------------------------------------------------- arguments


def _checked(
    where: str, scene: Scene, estimate: str, mode: str, probes: int
) -> tuple[DeformableScene, dict[str, dict[str, torch.Tensor]]]:
    """The scene and its groups, if all else is right, too."""
    check_any_scene(where, scene)
    if estimate not in NETWORK_ESTIMATES:
        known = ", ".join(NETWORK_ESTIMATES)
        raise ValueError(f"{where}: estimate must be one of {known}, got {estimate!r}; choose one")
    modes = [known for name, known in _ESTIMATORS if name == estimate]
    if mode not in modes:
        raise ValueError(f"{where}: mode of estimate {estimate!r} must be {' or '.join(modes)}, got {mode!r}; use that")
    if not (isinstance(probes, int) and probes >= 1):
        raise ValueError(f"{where}: probes must be a whole number >= 1, got {probes!r}; try 16")
    groups = network_groups(scene)
    if not (isinstance(scene, DeformableScene) and groups):
        beginnings = " or ".join(f"{prefix}*" for prefix in NETWORK_GROUPS.values())
        raise ValueError(
            f"{where}: scene must have float parameters named {beginnings}, has none; use fisher.diagonal for those of "
            "Gaussians and of other networks"
        )
    return scene, groups
