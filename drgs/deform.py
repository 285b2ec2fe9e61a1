"""Gaussians that move: a field of place and time deforms those that its gate lets move.

The field is that of 4D Gaussian Splatting: a HexPlane (`drgs.dynamics.hexplane`) and a small MLP with a head each for
position, rotation and scale, whose outputs are added to the raw parameters. It is the identity at the start. Opacities,
colors and features stay what they are.

Reference:
    Wu et al. 2024 (4D Gaussian Splatting), section 4; Cao & Johnson 2023 (HexPlane).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch

from drgs.checks.arguments import ArgumentError, must_be
from drgs.checks.derivatives import ends_of
from drgs.dynamics.hexplane import HexPlane, corners_of, features, product
from drgs.dynamics.jacobian import scene_jacobian
from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS, Lifespans, drift, is_limited, logit_at
from drgs.ellipsoids import Gaussians

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["DeformationField", "Deltas", "DynamicGaussians", "FieldConfig"]

_HEADS = {"means": 3, "quats": 4, "log_scales": 3}
_SPAN_TOLERANCE = 1e-6  # fraction of the span by which rounding may put a time outside of it
_LEAST_SIDE = 1e-3  # shortest side of the bounds / longest: keeps divisors of flat scenes above 0; chosen
PHI = "phi."
LENGTHS = ("mlp.means.3.weight", "mlp.means.3.bias")
"""Weights of a field that are lengths: the last of the head for means, whose outputs are in world units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """Sizes of a `DeformationField`.

    Attributes:
        channels: Features of a plane at each of its nodes.
        resolution: Nodes along an axis of space at level 1.
        time_resolution: Nodes along the time, at all levels.
        levels: Factors that the resolution in space is multiplied by, one a level.
        width: Width of the MLP's layers.
        depth: Layers of the trunk, which stands before the heads: at least the one that mixes the features. (The code
            of 4DGS makes this network of 0 and of 1.)
        last_std: Standard deviation of the heads' last weights at the start. 0 is the identity, where only these
            weights have gradients and information.
    """

    channels: int = 16
    resolution: int = 64
    time_resolution: int = 150
    levels: tuple[int, ...] = (1, 2)
    width: int = 128
    depth: int = 1
    last_std: float = 0.0

    def __post_init__(self) -> None:
        least = {"channels": 1, "resolution": 2, "time_resolution": 2, "width": 1, "depth": 1}
        for name, low in least.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ArgumentError(
                    f"FieldConfig: {name} must be a whole number >= {low}, got {value!r}; choose another"
                )
        object.__setattr__(self, "levels", tuple(self.levels))
        if not self.levels or any(isinstance(x, bool) or not isinstance(x, int) or x < 1 for x in self.levels):
            raise ArgumentError(f"FieldConfig: levels must be whole numbers >= 1, got {self.levels!r}; e.g. (1, 2)")
        if not 0 <= self.last_std < math.inf:
            raise ArgumentError(f"FieldConfig: last_std must be >= 0 and finite, got {self.last_std!r}; choose another")

    @classmethod
    def preset(cls, name: Literal["neu3d", "dnerf"], times: int | None = None, **fields: Any) -> FieldConfig:
        """The sizes of 4D Gaussian Splatting for videos of rooms (`neu3d`) or for one synthetic object (`dnerf`).

        Args:
            name: Name of the preset.
            times: How many distinct times there are; there is a node in time for every two of them, as in 4DGS. None
                for those of its own data sets: 300 (`neu3d`) and 100 (`dnerf`).
            **fields: Fields that replace the preset's.
        """
        presets = {
            "neu3d": {"channels": 16, "resolution": 64, "levels": (1, 2), "width": 128},
            "dnerf": {"channels": 32, "resolution": 64, "levels": (1, 2), "width": 64},
        }
        if name not in presets:
            raise ArgumentError(f"FieldConfig: preset must be among {', '.join(presets)}, got {name!r}; choose one")
        times = {"neu3d": 300, "dnerf": 100}[name] if times is None else times
        return cls(**{**presets[name], "time_resolution": max(2, math.ceil(times / 2)), **fields})


class Deltas(NamedTuple):
    """What is added to the raw parameters: (N, 3) means, (N, 4) quats, (N, 3) log_scales."""

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor


class DeformationField(torch.nn.Module):
    """(N, 3) canonical means and a time -> `Deltas`.

    Args:
        config: Sizes of its planes and layers.
        bounds: (2, 3) lowest and highest corner of the canonical means, in world units; means outside see the border.
            A side shorter than 1e-3 of the longest is widened to that, and a single point to sides of 1.
        span: First and last time of the field; other times are refused, as it has learned nothing of them. They
            may be one, at which the field is as at the first node.
        seed: Seed that the weights at the start are drawn by.
    Attributes:
        grid: The `HexPlane`; its parameters are `grid.0`, ..., its buffers `grid.bounds` and `grid.span`.
        mlp: `mlp.trunk`, and the heads `mlp.means`, `mlp.quats` and `mlp.log_scales`.
    """

    def __init__(
        self,
        config: FieldConfig,
        bounds: ArrayLike | torch.Tensor,
        span: tuple[float, float] = (0.0, 1.0),
        seed: int = 0,
    ) -> None:
        super().__init__()
        must_be("DeformationField", "config", config, FieldConfig, 'FieldConfig.preset("neu3d") makes one')
        self.config = config
        with torch.random.fork_rng(devices=[]):  # whoever draws random numbers besides draws the same
            torch.manual_seed(seed)
            resolutions = [config.resolution * level for level in config.levels]
            box, times = _checked_bounds(bounds), _checked_span(span)
            self.grid = HexPlane(config.channels, resolutions, config.time_resolution, box, times)
            self.mlp = _mlp(config)

    def forward(self, means: torch.Tensor, time: float | torch.Tensor, origin: ArrayLike | None = None) -> Deltas:
        """Deltas of canonical means at a time.

        Args:
            means: (N, 3), relative to `origin`.
            time: A number, or a scalar tensor, which the deltas are then differentiated by.
            origin: (3,) world units, or None for 0.
        Returns:
            Deltas in the dtype of the weights, differentiable in both modes by weights, means and time. At a node of
            the time grid the derivative with respect to time is the right-sided one (the left-sided one at the last
            node).
        Raises:
            ValueError: If the time lies outside of the span.
        """
        return self.evaluate(dict(self.named_parameters()), means, time, origin)

    def evaluate(
        self,
        weights: Mapping[str, torch.Tensor],
        means: torch.Tensor,
        time: float | torch.Tensor,
        origin: ArrayLike | None = None,
    ) -> Deltas:
        """`forward` of a field with these weights, named as in `named_parameters`; from any number of threads."""
        planes = [weights[f"grid.{k}"] for k in range(len(self.grid))]
        return _deltas(weights, features(planes, self._places(means, origin), self._moment(time, means.device)))

    def squared_vjps(
        self, means: torch.Tensor, time: float, cotangents: Deltas, origin: ArrayLike | None = None
    ) -> dict[str, torch.Tensor]:
        """Squares of J^T u, J the derivative of the deltas by the parameters, summed over K cotangents u.

        The field is evaluated once, and only nodes of the planes that the means read are touched.

        Args:
            means, time, origin: The same as for `forward`.
            cotangents: (K, N, 3), (K, N, 4) and (K, N, 3), of the deltas.
        Returns:
            A tensor of the shape of each parameter, named as in `named_parameters`.
        """
        weights = {name: x.detach() for name, x in self.named_parameters()}  # leaves of a graph of their own
        planes = {name: x for name, x in weights.items() if name.startswith("grid.")}
        mlp = {name: x.requires_grad_() for name, x in weights.items() if name not in planes}
        with torch.no_grad():  # which nodes are read, and of which weights, is the derivative by the planes
            corners = corners_of(list(planes.values()), self._places(means, origin), self._moment(time, means.device))
            found = [own.read(plane) for own, plane in zip(corners, planes.values(), strict=True)]
        leaves = [*mlp.values(), *(x.requires_grad_() for x in found)]
        with torch.enable_grad():
            deltas = _deltas(mlp, product(found))
        squared = [torch.zeros_like(x, requires_grad=False) for x in mlp.values()]
        by_nodes = [own.squares(torch.zeros_like(x)) for own, x in zip(corners, found, strict=True)]
        for some in zip(*cotangents, strict=True):  # one by one: copies for all would cost more than they spare
            by_leaf = torch.autograd.grad(deltas, leaves, some, retain_graph=True)
            squared = [x.add_(slope.square()) for x, slope in zip(squared, by_leaf, strict=False)]
            for k, own in enumerate(corners):
                by_nodes[k] += own.squares(by_leaf[len(mlp) + k])
        total = dict(zip(mlp, squared, strict=True))
        for (name, plane), own, x in zip(planes.items(), corners, by_nodes, strict=True):
            total[name] = own.spread(x, plane)
        return {name: total[name] for name in weights}

    def _places(self, means: torch.Tensor, origin: ArrayLike | None) -> torch.Tensor:
        """Means as parts of the way from the lower to the upper bound: float64 differences of what is far from 0."""
        low, high = self.grid.bounds.to(means.device)  # a call on a card moves parameters there, and no buffers
        start = low if origin is None else low - torch.as_tensor(np.asarray(origin, np.float64), device=low.device)
        return (means - start.to(means.dtype)) / (high - low).to(means.dtype)

    def _moment(self, time: float | torch.Tensor, device: torch.device) -> torch.Tensor:
        """The time as a part of the span."""
        first, last = (float(x) for x in self.grid.span)
        value = float(time.detach() if isinstance(time, torch.Tensor) else time)  # a check
        slack = _SPAN_TOLERANCE * (last - first)
        if not first - slack <= value <= last + slack:
            raise ArgumentError(
                f"DeformationField: time must be in [{first:g}, {last:g}], the span of the field, got {value:g}; ask "
                "for a time in it"
            )
        given = time if isinstance(time, torch.Tensor) else torch.tensor(value, dtype=torch.float64)
        moment = given.to(device, self.grid.span.dtype)
        return (moment - first) / ((last - first) or math.inf)  # of one time there is no other


def _mlp(config: FieldConfig) -> torch.nn.ModuleDict:
    """Layers of the trunk and the heads, as they are at the start."""
    width = config.width
    trunk: list[torch.nn.Module] = [torch.nn.Linear(config.channels * len(config.levels), width)]
    for _ in range(config.depth - 1):
        trunk += [torch.nn.ReLU(), torch.nn.Linear(width, width)]
    made = {"trunk": torch.nn.Sequential(*trunk)}
    for name, size in _HEADS.items():
        last = torch.nn.Linear(width, size)
        torch.nn.init.normal_(last.weight, std=config.last_std)
        torch.nn.init.zeros_(last.bias)
        made[name] = torch.nn.Sequential(torch.nn.ReLU(), torch.nn.Linear(width, width), torch.nn.ReLU(), last)
    return torch.nn.ModuleDict(made)


def _deltas(weights: Mapping[str, torch.Tensor], features: torch.Tensor) -> Deltas:
    """The MLP: hidden layers of all heads in one product."""
    linear = torch.nn.functional.linear
    hidden, layer = features, 0
    while f"mlp.trunk.{layer}.weight" in weights:
        hidden = linear(hidden, weights[f"mlp.trunk.{layer}.weight"], weights[f"mlp.trunk.{layer}.bias"]).relu_()
        layer += 2
    inner = [torch.cat([weights[f"mlp.{name}.1.{kind}"] for name in _HEADS]) for kind in ("weight", "bias")]
    parts = linear(hidden, *inner).relu_().chunk(len(_HEADS), 1)
    last = [(weights[f"mlp.{name}.3.weight"], weights[f"mlp.{name}.3.bias"]) for name in _HEADS]
    return Deltas(*(linear(part, *own) for part, own in zip(parts, last, strict=True)))


class DynamicGaussians:
    """Canonical Gaussians, and the field that moves some of them: a `DeformableScene`.

        sizes = drgs.deform.FieldConfig.preset("neu3d")
        field = drgs.DeformationField(sizes, bounds=[[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], span=(0.0, 1.0))
        moving = drgs.DynamicGaussians(g, field)
        drgs.render(moving, dataclasses.replace(camera, time=0.5)).rgb

    A Gaussian's gate is sigmoid(motion). From 0.5 on it moves, by 2 gate - 1 times the field's deltas: continuously,
    and at most as far as the field says. Below, it is still, and nothing is computed for it.

    Args:
        gaussians: The canonical ones.
        field: What moves them.
        motion: (N,) logit of the gate; None: all move as the field says.
        lifespans: When each is visible, and how it moves then; None: all are visible at all times.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        field: DeformationField,
        motion: torch.Tensor | None = None,
        lifespans: Lifespans | None = None,
    ) -> None:
        must_be("DynamicGaussians", "gaussians", gaussians, Gaussians, "the canonical ones")
        must_be(
            "DynamicGaussians", "field", field, DeformationField, "DeformationField(config, bounds, span) makes one"
        )
        if motion is not None:
            must_be("DynamicGaussians", "motion", motion, torch.Tensor, "(N,) floats, one logit per Gaussian")
            if tuple(motion.shape) != (len(gaussians),) or not motion.is_floating_point():
                raise ArgumentError(
                    f"DynamicGaussians: motion must be {len(gaussians)} floats, one a Gaussian, got {motion.dtype} of "
                    f"shape {tuple(motion.shape)}; pass None to let all move"
                )
        if lifespans is not None:
            _check_lifespans(lifespans, len(gaussians))
        self.gaussians = gaussians
        self.field = field
        self.motion = motion
        self.lifespans = lifespans

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def moving(self) -> torch.Tensor:
        """(N,) bool, which Gaussians the field is evaluated for."""
        if self.motion is None:
            return torch.ones(len(self), dtype=torch.bool, device=self.gaussians.means.device)
        return self.motion.detach() >= 0  # the choice has no derivative

    @property
    def has_lifespan(self) -> torch.Tensor:
        """(N,) bool, which Gaussians have a limited lifespan."""
        if self.lifespans is None:
            return torch.zeros(len(self), dtype=torch.bool, device=self.gaussians.means.device)
        first, last = (float(x) for x in self.field.grid.span)
        return is_limited(self.lifespans.log_widths, last - first)

    def without_lifespans(self) -> DynamicGaussians:
        """The same scene with unlimited lifespans: each mean is where it is at its reference time."""
        return DynamicGaussians(self.gaussians, self.field, self.motion)

    def take(self, index: torch.Tensor) -> DynamicGaussians:
        """The Gaussians at `index`, in that order, with the same field."""
        motion = None if self.motion is None else self.motion[index]
        lifespans = None if self.lifespans is None else self.lifespans.take(index)
        return DynamicGaussians(self.gaussians.take(index), self.field, motion, lifespans)

    def parameters(self) -> dict[str, torch.Tensor]:
        """Raw parameters of the Gaussians, `motion` if there is one, those of `lifespans`, and the field's:
        `phi.grid.*`, `phi.mlp.*`.
        """
        gate = {} if self.motion is None else {"motion": self.motion}
        gate |= {} if self.lifespans is None else dict(zip(LIFESPAN_PARAMETERS, self.lifespans, strict=False))
        return self.gaussians.parameters() | gate | {PHI + name: x for name, x in self.field.named_parameters()}

    def at(self, time: float | torch.Tensor | None) -> Gaussians:
        """The Gaussians at a time.

        Args:
            time: A number, or a scalar tensor, which they are then differentiated by.
        Raises:
            ValueError: If there is no time, it lies outside of the field's span, or what deforms is not finite (the
                parameter is named).
        """
        parameters = self.parameters()
        seen = self.deform(parameters, time)
        moved = seen.means, seen.quats, seen.log_scales
        with torch.no_grad():  # a check, which leaves no graph
            checked = [*moved]
            checked += [] if self.motion is None else [self.motion]
            checked += [] if self.lifespans is None else [seen.logit_opacities, *self.lifespans]
            if not all(is_finite(x) for x in checked):
                _name_what_is_not_finite(parameters, dict(zip(Deltas._fields, moved, strict=True)))
        return seen

    def deform(self, parameters: dict[str, torch.Tensor], time: float | torch.Tensor | None) -> Gaussians:
        """`at(time)` of a scene with these parameters, for `torch.func`; nothing is checked but the time."""
        if time is None:
            raise ArgumentError("DynamicGaussians.at: the view must have a time, got None; set Camera.time")
        fields = dict(parameters)
        phi = {name.removeprefix(PHI): fields.pop(name) for name in parameters if name.startswith(PHI)}
        motion = fields.pop("motion", None)
        lifespans = (
            None
            if self.lifespans is None
            else Lifespans.of(fields, self.lifespans.reference_times.to(fields["means"].device))
        )
        fields = {name: x for name, x in fields.items() if name not in LIFESPAN_PARAMETERS}
        means = fields["means"]
        index = None
        if motion is not None:
            index = (motion.detach() >= 0).nonzero()[:, 0]  # the choice has no derivative
            means = means[index]
        deltas = self.field.evaluate(phi, means, time, self.gaussians.origin)
        for name, delta in zip(Deltas._fields, deltas, strict=True):
            delta = delta.to(fields[name].dtype)
            if motion is None or index is None:
                fields[name] = fields[name] + delta
            else:
                factor = (0.5 * motion[index]).tanh()  # 2 sigmoid(m) - 1
                fields[name] = fields[name].index_add(0, index, delta * factor.to(delta.dtype)[:, None])
        if lifespans is not None:
            self._apply_lifespans(fields, lifespans, time)
        return self.gaussians.replace(**fields)

    def squared_vjps(
        self, time: float, index: torch.Tensor, cotangents: Mapping[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Squares of J^T u, J the derivative of raw fields by the field's parameters, summed over K cotangents u.

        Args:
            time: The time.
            index: (M,) int64: Gaussians whose cotangents are given; all others have 0.
            cotangents: (K, M, 3) `means`, (K, M, 4) `quats`, (K, M, 3) `log_scales`.
        Returns:
            A tensor of the shape of each parameter, named as in `parameters`: `phi.grid.*`, `phi.mlp.*`.
        """
        home = self.field.grid[0]
        index = index.to(home.device)
        moves = self.moving[index]
        index = index[moves]
        of_deltas = [cotangents[name].to(home)[:, moves] for name in Deltas._fields]
        if self.motion is not None:
            factor = (0.5 * self.motion.detach()[index]).tanh().to(home.dtype)
            of_deltas = [x * factor[:, None] for x in of_deltas]
        means = self.gaussians.means.detach()[index]
        found = self.field.squared_vjps(means, time, Deltas(*of_deltas), self.gaussians.origin)
        return {PHI + name: x for name, x in found.items()}

    def _apply_lifespans(
        self, fields: dict[str, torch.Tensor], lifespans: Lifespans, time: float | torch.Tensor
    ) -> None:
        """Set the mean and the opacity of the Gaussians with a limited lifespan at a time, in `fields`."""
        index = self.has_lifespan.nonzero()[:, 0].to(fields["means"].device)  # a call may have moved the fields alone
        limited = lifespans.take(index)
        fields["means"] = fields["means"].index_add(0, index, drift(limited, time).to(fields["means"].dtype))
        logits = fields["logit_opacities"]
        fields["logit_opacities"] = logits.index_copy(0, index, logit_at(logits[index], limited, time))


@scene_jacobian.register(DynamicGaussians)
class _FieldJacobian:
    """J^T by a field's parameters: all images at once, and only of nodes that moving Gaussians read."""

    fields = frozenset(Deltas._fields)

    def __init__(self, scene: DynamicGaussians, time: float, names: Sequence[str]) -> None:
        self.moving = scene.moving
        self._scene = scene
        self._time = time
        self._names = names

    def squared_vjps(self, index: torch.Tensor, cotangents: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """As `drgs.dynamics.jacobian.SceneJacobian`."""
        found = self._scene.squared_vjps(self._time, index, cotangents)
        return {name: found[name] for name in self._names}


def is_finite(x: torch.Tensor) -> bool:
    """Whether all entries are: NaN passes through the reduction."""
    return x.numel() == 0 or all(map(math.isfinite, ends_of(x)))


def _check_lifespans(lifespans: Lifespans, count: int) -> None:
    """Raise ValueError unless every tensor has a row for each of `count` Gaussians."""
    must_be("DynamicGaussians", "lifespans", lifespans, Lifespans, "from drgs.dynamics.lifespans, a row per Gaussian")
    for name, x in zip(Lifespans._fields, lifespans, strict=True):
        shape = (count, 3) if name in ("velocities", "accelerations") else (count,)
        if tuple(x.shape) != shape or not x.is_floating_point():
            raise ArgumentError(
                f"DynamicGaussians: lifespans.{name} must be floats of shape {shape}, got {x.dtype} of shape "
                f"{tuple(x.shape)}; give each Gaussian its own"
            )


def _name_what_is_not_finite(parameters: dict[str, torch.Tensor], moved: dict[str, torch.Tensor]) -> None:
    """Raise ValueError about the first parameter that is not finite; else about what finite ones came to."""
    named = parameters | {f"deltas of {name}": x for name, x in moved.items()}
    for name, x in named.items():
        if not is_finite(x):
            bad = ~torch.isfinite(x)
            at = tuple(bad.nonzero()[0].tolist())
            raise ArgumentError(
                f"DynamicGaussians.at: {name} must be finite, got {float(x[at]):g} at index {list(at)} "
                f"({int(bad.sum())} of {x.numel()}); go back to weights that were finite"
            )


def _checked_bounds(bounds: ArrayLike | torch.Tensor) -> torch.Tensor:
    """(2, 3) float64, no side of it too short to divide by."""
    box = torch.as_tensor(bounds, dtype=torch.float64).detach()  # where the field lies is a constant
    if tuple(box.shape) != (2, 3) or not bool(torch.isfinite(box).all()) or bool((box[0] > box[1]).any()):
        raise ArgumentError(
            f"DeformationField: bounds must be (2, 3), lowest and highest corner, finite, got {box.tolist()}; take "
            "torch.stack([means.amin(0), means.amax(0)])"
        )
    middle = box.mean(0)
    size = box[1] - box[0]
    # Coordinates are divided by it: a flat scene has a side of 0, a single point three.
    size = size.clamp_min(_LEAST_SIDE * float(size.max()) or 1.0)
    return torch.stack([middle - size / 2, middle + size / 2])


def _checked_span(span: tuple[float, float]) -> torch.Tensor:
    first, last = (float(x) for x in span)
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise ArgumentError(
            f"DeformationField: span must be the first and the last time, finite, got {tuple(span)!r}; e.g. (0.0, 1.0)"
        )
    return torch.tensor([first, last], dtype=torch.float64)
