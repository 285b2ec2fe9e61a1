"""Fisher information of a view about the weights of a deformation network, by random probes.

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

J^T has two factors: slopes of images by the raw fields of the Gaussians, and from there to phi
`drgs.dynamics.jacobian.scene_jacobian`. Where phi moves geometry alone, the first are sums over the hits of one
traversal for all images (hit_sums.py); else a reverse pass for each (pullback.py).

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
from typing import TYPE_CHECKING, ClassVar

import torch

from drgs.checks.arguments import must_be
from drgs.dynamics.jacobian import SceneJacobian, scene_jacobian
from drgs.ellipsoids import DeformableScene, Gaussians, Scene
from drgs.information.choices import NETWORK_ESTIMATES, NetworkEstimate
from drgs.information.complement import Eliminated
from drgs.information.elimination import eliminated_of
from drgs.information.hit_sums import HitSums
from drgs.information.inputs import three_weights
from drgs.information.jacobian import GEOMETRY
from drgs.information.network_groups import NETWORK_GROUPS, network_groups
from drgs.information.nuisances import NO_NUISANCES, Nuisances
from drgs.information.pullback import Pullback
from drgs.information.quantity import Quantity, ViewContext, original
from drgs.information.replay import Replay
from drgs.information.sums import Information
from drgs.runtime import alone
from drgs.tracing.call import Call
from drgs.tracing.errors import own_errors
from drgs.tracing.pose import quaternion_product
from drgs.tracing.tangents import push_forward

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.information.semantics import SemanticMetric
    from drgs.settings import RenderSettings

_FLOATS = 1 << 23  # of the tangents that one traversal carries, or of images and what is summed up along them: 32 MiB
_BATCH = 16  # tangents of one traversal; chosen: bounds memory

_GEOMETRY_FIELDS = {"means": 0, "quats": 3, "log_scales": 6, "logit_opacities": 9}
"""Raw fields of Gaussians -> first place of theirs in the geometry of a row, where rotations stand for quats."""

Groups = Mapping[str, Mapping[str, torch.Tensor]]  # group -> name -> parameter


@dataclasses.dataclass(frozen=True)
class NetworkInformation(Quantity):
    """About the network that moves a scene's Gaussians; `drgs.fisher.network` has more about each field.

    Attributes:
        estimate: What is estimated of H.
        mode: Mode of `trace`.
        probes, seed: Random images, or tangents, and their seed, the same in each view.
        groups: Groups of the network that count; None: all.
        channel_weights: Inverse noise variances of R, G and B.
        semantics: The metric of the features that are rows of the image; None: they are none.
        nuisances: Unknowns of the view that are eliminated.
    """

    estimate: NetworkEstimate = "diagonal"
    mode: str = "reverse"
    probes: int = 16
    seed: int = 0
    groups: tuple[str, ...] | None = None
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = NO_NUISANCES
    where: ClassVar[str] = "fisher.network"

    @property
    def needs_known_views(self) -> bool:  # type: ignore[override]
        """A trace is scored without what is known."""
        return self.estimate == "diagonal"

    @alone
    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Group -> float64 on the CPU: (P,) of its parameters, of `trace` and `paper` a number ()."""
        if sums := view.shared_sums.get(self):
            result = sums.information()
        else:
            result = self._estimated(view)
        return {name: x for name, x in result.items() if self.groups is None or name in self.groups}

    def _estimated(self, view: ViewContext) -> dict[str, torch.Tensor]:
        groups = self._checked(view.scene)
        shapes = {name: (_size(own),) if self.estimate == "diagonal" else () for name, own in groups.items()}
        total = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items()}
        rows = _Rows.of(self.where, view, self)
        if rows is not None:
            generator = torch.Generator().manual_seed(self.seed)
            with own_errors():
                for part in _ESTIMATORS[self.estimate, self.mode](rows, groups, self.probes, generator):
                    for name, x in part.items():
                        total[name] += x.cpu()  # where the field's parameters live is the caller's
        return {name: x / self.probes for name, x in total.items()}

    @alone
    def shared_sums(self, view: ViewContext) -> NetworkSums | None:
        """None where more than the geometry of Gaussians moves, images do not fit at a time, or nothing is seen."""
        if self.estimate != "diagonal" or self.seed != 0:
            return None
        groups = self._checked(view.scene)
        rows = _Rows.of(self.where, view, self)
        if rows is None or self.probes > rows.most_images:
            return None
        jacobian = rows.jacobian(groups)
        if not jacobian.fields <= {*_GEOMETRY_FIELDS}:
            return None
        return NetworkSums(rows, jacobian, groups, _first_signs(self.probes, rows.pixels, rows.channels))

    @alone
    def variance_map(self, view: ViewContext, weights: Information) -> torch.Tensor:
        """As `drgs.fisher.network_variance_map`: mean of (J v)^2 over v = z sqrt(weights), z random signs."""
        where = "fisher.network_variance_map"
        groups = self._checked(view.scene, where)
        must_be(where, "weights", weights, Mapping, "group -> tensor, as fisher.network returns")
        for name, x in weights.items():
            if name not in groups:
                raise ValueError(f"{where}: weights must be of {', '.join(groups)}, got {name!r}; drop it")
            size = _size(groups[name])
            if tuple(x.shape) != (size,):
                raise ValueError(f"{where}: weights of {name} must have shape ({size},), got {tuple(x.shape)}")
            if not bool((torch.isfinite(x) & (x >= 0)).all()):
                raise ValueError(
                    f"{where}: weights of {name} must be finite and >= 0, got {float(x.min()):g} to "
                    f"{float(x.max()):g}; raise lambda above 0"
                )
        rows = _Rows.of(where, view, dataclasses.replace(self, nuisances=NO_NUISANCES))
        camera = view.camera
        total = torch.zeros(camera.height * camera.width, dtype=torch.float64)
        if rows is None or not weights:
            return total.float().reshape(camera.height, camera.width)
        roots = {name: x.double().cpu().sqrt() for name, x in weights.items()}
        generator = torch.Generator().manual_seed(self.seed)
        with own_errors():
            for count in rows.batches(groups, self.probes):
                tangents: dict[str, torch.Tensor] = {}
                for name, root in roots.items():
                    tangents |= _unflat(groups[name], _signs(generator, count, len(root)) * root)
                total += rows.push(tangents).square().sum((0, 2))
        return (total / self.probes).float().reshape(camera.height, camera.width)  # as `fisher.variance_map` gives it

    def _checked(self, scene: Scene, where: str = "fisher.network") -> dict[str, dict[str, torch.Tensor]]:
        """The groups of the scene's network, if all else is right, too."""
        if self.estimate not in NETWORK_ESTIMATES:
            known = ", ".join(NETWORK_ESTIMATES)
            raise ValueError(f"{where}: estimate must be one of {known}, got {self.estimate!r}; choose one")
        modes = [known for name, known in _ESTIMATORS if name == self.estimate]
        if self.mode not in modes:
            raise ValueError(
                f"{where}: mode of estimate {self.estimate!r} must be {' or '.join(modes)}, got {self.mode!r}; use that"
            )
        if not (isinstance(self.probes, int) and self.probes >= 1):
            raise ValueError(f"{where}: probes must be a whole number >= 1, got {self.probes!r}; try 16")
        groups = network_groups(scene)
        if not groups:
            beginnings = " or ".join(f"{prefix}*" for prefix in NETWORK_GROUPS.values())
            raise ValueError(
                f"{where}: scene must have float parameters named {beginnings}, has none; use fisher.diagonal for "
                "those of Gaussians and of other networks"
            )
        return groups


class NetworkSums:
    """Estimate `diagonal` of one view, from sums over its hits that a traversal for another quantity may fill.

    Attributes:
        sums: The sums of the hits along the random images. Whoever replays the view may add to them, if colors, and
            features by `semantics`, are what it replays.
        semantics: The metric of the features; None: colors alone.
    """

    def __init__(self, rows: _Rows, jacobian: SceneJacobian, groups: Groups, images: torch.Tensor) -> None:
        self.sums = rows.hit_sums(jacobian, images)
        self.semantics = rows.semantics
        self._rows = rows
        self._jacobian = jacobian
        self._groups = groups

    @alone
    def information(self) -> dict[str, torch.Tensor]:
        """Group -> (P,) float64 on the CPU."""
        with own_errors():
            squares = _by_group(self._groups, self._rows.squares_of_hits(self._jacobian, self.sums))
        return {name: x.double().div_(len(self.sums.images)).cpu() for name, x in squares.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class _Rows:
    """The rows of a view's image, each divided by its noise, as a function of phi.

    Attributes:
        scene: The scene.
        gaussians: Its Gaussians at the time of the view.
        rendered: The same with the channels of features that are rows, if any.
        deformed: The scene with these features; forward mode leads through it.
        camera, settings: The view.
        semantics: The metric of these features.
        directions: (D, K) P, of which features P^T f are rows; None where they are none.
        weights: (C,) what rows are multiplied by: colors, then semantic channels.
        mask: (H, W) what all of them are multiplied by besides; None: 1.
        nuisances: The view's own unknowns, which rows are freed of.
    """

    scene: DeformableScene
    gaussians: Gaussians
    rendered: Gaussians
    deformed: DeformableScene
    camera: Camera
    settings: RenderSettings
    semantics: SemanticMetric | None
    directions: torch.Tensor | None
    weights: torch.Tensor
    mask: torch.Tensor | None
    nuisances: Nuisances

    @classmethod
    def of(cls, where: str, view: ViewContext, quantity: NetworkInformation) -> _Rows | None:
        """The rows that a quantity is of; None if there is nothing to see."""
        rendered, semantics, scene = view.gaussians, quantity.semantics, view.scene
        assert isinstance(scene, DeformableScene)  # it has groups
        if not len(rendered) or not view.camera.width * view.camera.height:
            return None
        weights = torch.tensor(three_weights(where, quantity.channel_weights), dtype=torch.float64).sqrt()
        deformed: DeformableScene = scene
        directions = None
        if semantics is None:
            rendered = rendered.replace(features=None)
        else:
            semantics.check(where, rendered)
            assert rendered.features is not None  # `check` has refused it
            # Squares of few channels add up to those of all decoded ones, in one traversal.
            directions = semantics.directions(rendered.features)
            deformed = reduced = _Reduced(scene, directions)
            rendered = reduced.reduced(rendered)
            weights = torch.cat([weights, torch.full((directions.shape[1],), semantics.weight**0.5)])
        return cls(
            scene=original(scene),
            gaussians=view.gaussians,
            rendered=rendered.detach(),
            deformed=deformed,
            camera=view.camera,
            settings=view.settings,
            semantics=semantics,
            directions=directions,
            weights=weights,
            mask=view.mask,
            nuisances=quantity.nuisances,
        )

    @functools.cached_property
    def call(self) -> Call:
        """The call of the view, by which forward mode leads from phi to the image."""
        return Call(self.rendered, self.camera, self.settings, frozenset(), scene=self.deformed)

    @functools.cached_property
    def scales(self) -> torch.Tensor:
        """(C,) what the call's channels are multiplied by; with a mask (pixels, C)."""
        if self.mask is None:
            return self.weights
        return self.mask.detach().double().cpu().reshape(-1, 1) * self.weights  # a number, whatever graph it is in

    @functools.cached_property
    def eliminated(self) -> Eliminated | None:
        """What the view's own unknowns explain of the rows, which are freed of it; None: nothing."""
        if not self.nuisances.names:
            return None
        return eliminated_of(self.call, self.scales, self.nuisances)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.camera.width * self.camera.height

    @property
    def channels(self) -> int:
        """C, rows of a pixel."""
        return len(self.weights)

    @property
    def most_images(self) -> int:
        """How many images are pulled back at a time."""
        return max(1, _FLOATS // max(self.pixels * self.channels, len(self.rendered) * GEOMETRY))

    def jacobian(self, groups: Groups) -> SceneJacobian:
        """J of the Gaussians by phi."""
        return scene_jacobian(self.scene, self.camera.time, [name for own in groups.values() for name in own])

    def squares(self, groups: Groups) -> Callable[[torch.Tensor], Information]:
        """Squares of J^T u, summed over (K, pixels, C) rows u: group -> (P,)."""
        jacobian = self.jacobian(groups)
        if jacobian.fields <= {*_GEOMETRY_FIELDS}:
            squares = lambda images: self.squares_of_hits(jacobian, self.hit_sums(jacobian, images))  # noqa: E731
        else:
            squares = self._squares_of_passes(jacobian)
        return lambda images: _by_group(groups, squares(images))

    def hit_sums(self, jacobian: SceneJacobian, images: torch.Tensor) -> HitSums:
        """Sums over the view's hits along (K, pixels, C) rows, none added yet."""
        moving = jacobian.moving
        which = torch.ones(len(self.rendered), dtype=torch.bool) if moving is None else moving.cpu()
        return HitSums(self.cotangents(images), which)

    def squares_of_hits(self, jacobian: SceneJacobian, sums: HitSums) -> dict[str, torch.Tensor]:
        """Squared slopes of the parameters by name, summed over the images; the hits are walked along if no other
        traversal has added them.
        """
        if not sums.is_full:
            gaussians = (
                self.rendered if self.semantics is None else self.gaussians
            )  # a replay reduces features by itself
            Replay(gaussians, self.camera, self.settings, semantics=self.semantics, mask=self.mask).add_up(sums)
        geometry = sums.geometry()
        moved = geometry.any(2).any(0)  # a view shows few of those that move
        index = sums.wanted.to(moved.device)[moved]
        quats = self.rendered.quats.to(geometry.device)
        return jacobian.squared_vjps(index, _field_slopes(geometry[:, moved], quats[index]))

    def _squares_of_passes(self, jacobian: SceneJacobian) -> Callable[[torch.Tensor], dict[str, torch.Tensor]]:
        """The same by a reverse pass for each image, for fields beyond the geometry."""
        pull = Pullback(Call(self.rendered, self.camera, self.settings, frozenset()), sorted(jacobian.fields))
        index = torch.arange(len(self.rendered))

        def squares(images: torch.Tensor) -> dict[str, torch.Tensor]:
            total: dict[str, torch.Tensor] = {}
            for image in self.cotangents(images, self.scales):
                slopes = pull(image[:, :3], image[:, 3:] if image.shape[1] > 3 else None)
                if "features" in slopes and self.directions is not None:
                    slopes["features"] = slopes["features"] @ self.directions.T
                for name, x in jacobian.squared_vjps(index, {n: slope[None] for n, slope in slopes.items()}).items():
                    total[name] = total[name] + x if name in total else x
            return total

        return squares

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
        largest = max(self.pixels * self.channels, sum(_size(own) for own in groups.values()))
        step = max(1, min(_BATCH, _FLOATS // largest))
        return iter([min(step, count - start) for start in range(0, count, step)])


def _field_slopes(geometry: torch.Tensor, quats: torch.Tensor) -> dict[str, torch.Tensor]:
    """Slopes of raw fields, (K, M, ...) each, from (K, M, 10) ones of the geometry; `quats` are (M, 4).

    A rotation w, of the world, changes q by (0, w) q / 2. Along q nothing changes, so that the slope of q is in the
    span of these three, each |q| / 2 long and at right angles to the others.
    """
    q = quats.double()  # its square may be far from 1
    axes = torch.eye(3, dtype=q.dtype, device=q.device)
    ways = torch.stack([quaternion_product(axis.expand(len(q), 3), q) for axis in axes], 1)  # (M, 3, 4)
    ways = (ways * (2 / q.square().sum(1))[:, None, None]).to(geometry.dtype)
    parts = {name: geometry[..., at : at + 3] for name, at in _GEOMETRY_FIELDS.items()}
    by_quats = (parts["quats"][..., None] * ways).sum(-2)
    return parts | {"quats": by_quats, "logit_opacities": geometry[..., 9]}


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


def _diagonal(rows: _Rows, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    squares = rows.squares(groups)
    for start in range(0, probes, rows.most_images):
        count = min(rows.most_images, probes - start)
        yield squares(_signs(generator, count, rows.pixels, rows.channels, dtype=torch.float32))


def _trace_reverse(rows: _Rows, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    for part in _diagonal(rows, groups, probes, generator):
        yield {name: x.sum() for name, x in part.items()}


def _trace_forward(rows: _Rows, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    for name, own in groups.items():
        for count in rows.batches(groups, probes):
            yield {name: rows.push(_unflat(own, _signs(generator, count, _size(own)))).square().sum()}


def _paper(rows: _Rows, groups: Groups, probes: int, generator: torch.Generator) -> Iterator[Information]:
    squares = rows.squares(groups)
    for count in rows.batches(groups, probes):
        tangents: dict[str, torch.Tensor] = {}
        for own in groups.values():
            tangents |= _unflat(own, _signs(generator, count, _size(own)))
        yield {name: x.sum() for name, x in squares(rows.push(tangents)).items()}


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


def _by_group(groups: Groups, tensors: Mapping[str, torch.Tensor]) -> Information:
    """Group -> (P,) of what is known by parameter."""
    return {group: torch.cat([tensors[name].flatten() for name in own]) for group, own in groups.items()}


def _size(own: Mapping[str, torch.Tensor]) -> int:
    return sum(x.numel() for x in own.values())


def _unflat(own: Mapping[str, torch.Tensor], rows: torch.Tensor) -> dict[str, torch.Tensor]:
    """(K, P) rows as tensors (K, ...) by name."""
    parts = rows.split([x.numel() for x in own.values()], 1)
    return {name: part.reshape(len(rows), *x.shape) for (name, x), part in zip(own.items(), parts, strict=True)}
