"""Quantities of a view: how one is computed, how it adds up over views, and the context that quantities of a view
share.

A `Quantity` is a frozen dataclass of plain data. Caches keep what is computed of a view by it, other processes are sent
it, and everything that looks at views computes them by it: `drgs.fisher`, the scores of candidates, all maps.

    Diagonal            diagonal.py    diagonal of J^T J about Gaussians, or about tensors of a scene
    DenseBlocks         diagonal.py    one block of J^T J a Gaussian
    Coverage            diagonal.py    sum over pixels of squared weights
    RemovalError        removal.py     change of the image without a Gaussian
    NetworkInformation  network.py     J^T J about the network that moves Gaussians, by random probes
    Backdrop            backdrop.py    about the color behind all Gaussians
    SurfaceDepths       backdrop.py    how far away surfaces are
    PoseInformation     columns.py     about the pose of the view's camera
    Misfit              misfit.py      squared residuals of the view's photograph, by Gaussian
    Joint               this module    several of these, in one context

A view's own unknowns (`Nuisances`) and the metric of decoded features (`SemanticMetric`) are fields of these. Policies
that look at renderings have quantities of their own (`drgs.selection.pictures`).
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, cast

import torch

from drgs.cameras import Camera, some_cameras
from drgs.ellipsoids import DeformableScene, Gaussians, Scene, check_any_scene, colors_only
from drgs.information.inputs import Masks, mask_list
from drgs.information.sums import Information, add
from drgs.settings import RenderSettings
from drgs.tracing.inputs import check_scene, gaussians_at

if TYPE_CHECKING:
    from drgs.information.replay import Replay, WalkSums
    from drgs.information.semantics import SemanticMetric


class SharedSums(Protocol):
    """A quantity's sums over the hits of a view, which a traversal of the view for another quantity may fill.

    Attributes:
        sums: The sums.
        semantics: The metric of the features that the traversal must composite; None: colors alone.
    """

    sums: WalkSums
    semantics: SemanticMetric | None

    def information(self) -> Information:
        """The computed quantity; a traversal of its own fills the sums if none has."""


@dataclasses.dataclass(eq=False)
class ViewContext:
    """One view while quantities of it are computed: what one computes on its way, others need not compute again.

    Attributes:
        scene: The scene as numbers, without a graph; the Gaussians of each time are computed once.
        camera: The view's camera.
        settings: Settings of the renderer.
        mask: (H, W) in [0, 1] what the image is multiplied by; None: 1.
        number: Place of the view in a sum over views, for random images that differ between them.
        photograph: (H, W, 3) what the view should show; None: there is none, or no quantity asks for it.
        residual: (H, W) how wrong each pixel is, where that is known; None: as far as its color is from the photograph.
        known_opacity: (H, W) float32, where it is known; None: a traversal gives it, or it is rendered (`opacity`).
        shared_sums: Quantity -> its sums over hits that are still to be filled, or have been.
    """

    scene: Scene
    camera: Camera
    settings: RenderSettings
    mask: torch.Tensor | None = None
    number: int = 0
    photograph: torch.Tensor | None = None
    residual: torch.Tensor | None = None
    known_opacity: torch.Tensor | None = None
    shared_sums: dict[Quantity, SharedSums] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.scene = once_per_time(self.scene)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians at the time of the view."""
        return self.scene.at(self.camera.time)

    @property
    def opacity(self) -> torch.Tensor:
        """(H, W) float32 on the CPU, rendered where no traversal has given it."""
        if self.known_opacity is None:
            self.known_opacity = opacity_of(self.scene, self.camera, self.settings)
        return self.known_opacity

    def replay(self, semantics: SemanticMetric | None = None, geometry: bool = True) -> Replay:
        """The view's Gaussians, rendered once to be replayed for each hit; the opacity is known then."""
        from drgs.information.replay import Replay  # loads Dr.Jit, which poses alone need not have

        replay = Replay(self.gaussians, self.camera, self.settings, geometry, semantics, self.mask)
        if self.known_opacity is None:
            self.known_opacity = replay.opacity
        return replay


class Quantity:
    """Something that is computed of a view; frozen dataclasses of plain data inherit from it.

    Attributes:
        where: What its errors begin with.
        needs_known_views: Whether a score of a candidate also needs the quantity of the known views.
    """

    where: ClassVar[str] = "information"
    needs_known_views: bool = True

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """The tensors of one view alone, by name: caches keep them, other processes return them."""
        raise NotImplementedError(f"blocks: {type(self).__name__} must have a method `compute`, has none; add it")

    def summand(self, computed: Information, camera: Camera, mask: torch.Tensor | None) -> Information:
        """The part of `computed` that adds up over views, group of parameters -> tensor; by default all of it."""
        return computed

    def variance_map(self, view: ViewContext, weights: Information) -> torch.Tensor:
        """(H, W) float32: sum over rows of a pixel and parameters k of J_pk^2 weights_k."""
        raise NotImplementedError(f"blocks: {type(self).__name__} must have a method `variance_map`, has none; add it")

    def key(self, camera: Camera, settings: RenderSettings) -> Hashable:
        """What caches tell `compute`'s results apart by, besides scene, camera and mask: without what only `summand`
        reads. By default the quantity and the settings."""
        return self, settings

    @property
    def signed(self) -> tuple[str, ...]:
        """Names of what is computed that may be negative."""
        return ()

    def of_part(self) -> Quantity:
        """The same, of those pixels of a view that a mask keeps: what is known of the others does not count."""
        return self

    def shared_sums(self, view: ViewContext) -> SharedSums | None:
        """Sums over hits that a traversal for another quantity may fill; None: there are none."""
        return None


@dataclasses.dataclass(frozen=True)
class Joint(Quantity):
    """Several quantities of one view, computed in one context: what one computes, those after it use.

    Attributes:
        parts: (block, quantity) in the order of computing. Names begin with `block.` if it is not "".
    """

    parts: tuple[tuple[str, Quantity], ...]

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """In float32, as it is kept: half the memory, of sums that are of float32 images."""
        result: dict[str, torch.Tensor] = {}
        with torch.no_grad():  # information is a number
            if len(self.parts) > 1:  # else no other quantity walks along the view
                found = {quantity: quantity.shared_sums(view) for _, quantity in self.parts}
                view.shared_sums = {quantity: sums for quantity, sums in found.items() if sums is not None}
            for block, quantity in self.parts:
                result |= _named(block, quantity.compute(view))
        return {name: x.to(torch.float32) for name, x in result.items()}

    def summand(self, computed: Information, camera: Camera, mask: torch.Tensor | None) -> dict[str, torch.Tensor]:
        """That of each part, in float32."""
        rest = dict(computed)
        for block, quantity in self.parts:
            # Where all blocks are scored together, a part gets all that was computed, and returns the rest as it is.
            own = {name: rest.pop(name) for name in [*rest] if not block or name.startswith(f"{block}.")}
            plain = {name.removeprefix(f"{block}."): x for name, x in own.items()} if block else own
            rest |= _named(block, quantity.summand(plain, camera, mask))
        return {name: x.to(torch.float32) for name, x in rest.items()}

    def key(self, camera: Camera, settings: RenderSettings) -> Hashable:
        """That of each part."""
        return tuple((block, quantity.key(camera, settings)) for block, quantity in self.parts)

    def of_part(self) -> Joint:
        """That of each part."""
        return Joint(tuple((block, quantity.of_part()) for block, quantity in self.parts))

    @property
    def signed(self) -> tuple[str, ...]:
        """Those of all parts."""
        return tuple(name for block, quantity in self.parts for name in _named(block, dict.fromkeys(quantity.signed)))


def _named(block: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by names that begin with their block, if it has one."""
    return {f"{block}.{name}" if block else name: x for name, x in values.items()}


def sum_over_views(
    quantity: Quantity,
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Sequence[RenderSettings],
    masks: Sequence[torch.Tensor | None],
    opacities: Sequence[torch.Tensor | None] | None = None,
) -> dict[str, torch.Tensor]:
    """A quantity of several views, added up: group -> float64 tensor on the CPU.

    Args:
        quantity: What is computed of each view.
        scene: The scene, by `once_per_time`.
        cameras, settings, masks: The views, see `checked_views`.
        opacities: (H, W) of each view, where they are known; None: they are not.
    Raises:
        ValueError: If the scene's Gaussians are not as many in all views.
    """
    total: dict[str, torch.Tensor] = {}
    for number, (camera, own, mask) in enumerate(zip(cameras, settings, masks, strict=True)):
        gaussians_at(quantity.where, scene, camera)  # refuses what has no Gaussians then
        known = opacities[number] if opacities else None
        view = ViewContext(scene, camera, own, mask, number, known_opacity=known)
        part = quantity.summand(quantity.compute(view), camera, mask)
        for name, x in part.items():
            if name in total and total[name].shape != x.shape:
                raise ValueError(
                    f"{quantity.where}: a scene must have as many Gaussians and coefficients in all views, got {name} "
                    f"of shape {tuple(total[name].shape)} in the first and {tuple(x.shape)} in another; take views of "
                    "one time"
                )
        if len(cameras) == 1:  # nothing is added to it, and no copy of it is needed
            return {name: x.to(torch.float64) for name, x in part.items()}
        add(total, part)
    return total


def checked_views(
    where: str, scene: Any, cameras: Any, settings: RenderSettings | None, masks: Masks = None
) -> tuple[list[Camera], list[RenderSettings], list[torch.Tensor | None]]:
    """Cameras, settings and masks of views of a scene, as `sum_over_views` takes them.

    Raises:
        ArgumentError: If these are no scene, cameras, settings or masks; settings default to preset `exact`.
    """
    check_any_scene(where, scene)
    cameras = some_cameras(where, cameras)
    check_scene(where, gaussians_at(where, scene, cameras[0]), settings)
    settings = settings or RenderSettings.preset("exact")
    return cameras, [settings] * len(cameras), mask_list(where, masks, cameras)


def opacity_of(scene: Scene, camera: Camera, settings: RenderSettings) -> torch.Tensor:
    """(H, W) float32 opacity alpha of a view, on the CPU."""
    from drgs.integrator import render  # loads Dr.Jit, which poses alone need not have

    with torch.no_grad():  # information is a number
        return render(colors_only(scene, camera.time), camera, settings, outputs=()).alpha.cpu()


# -------------------------------------------------- Gaussians of a time, computed once

_Any = TypeVar("_Any")
_Scene = TypeVar("_Scene", bound=Scene)

_TIMES_BYTES = 64 << 20  # bytes that the Gaussians of several times may take, or those of one time; chosen


def once_per_time(scene: _Any) -> _Any:
    """The scene as it is now, its Gaussians as numbers, without a graph, each time's computed once.

    Parameters may not change while it is in use, so that it lives no longer than one call. What else the scene has is
    there, too. Gaussians, and what is no scene, are returned as they are.
    """
    if isinstance(scene, Gaussians | _OncePerTime) or not isinstance(scene, Scene):
        return scene
    wrapper = _DeformableOncePerTime if isinstance(scene, DeformableScene) else _OncePerTime
    return cast("_Any", wrapper(scene))  # has what the scene has


def original(scene: _Scene) -> _Scene:
    """What `once_per_time` was made of."""
    return cast("_Scene", scene._scene) if isinstance(scene, _OncePerTime) else scene


class _OncePerTime:
    """Such a scene; the times that were used least recently are given up for new ones."""

    def __init__(self, scene: Scene) -> None:
        self._scene: Any = scene
        self._gaussians: OrderedDict[float | None, Gaussians] = OrderedDict()
        self._most = 0  # times that are held; known when there are two

    def at(self, time: float | None) -> Gaussians:
        """The Gaussians at a time."""
        if time not in self._gaussians:
            with torch.no_grad():  # information is a number
                self._gaussians[time] = self._scene.at(time)
            if len(self._gaussians) > 1:
                self._most = self._most or max(1, _TIMES_BYTES // max(1, self._own_bytes(self._gaussians[time])))
                if len(self._gaussians) > self._most:
                    self._gaussians.popitem(last=False)
        self._gaussians.move_to_end(time)
        return self._gaussians[time]

    def parameters(self) -> dict[str, torch.Tensor]:
        """Those of the scene."""
        return self._scene.parameters()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def _own_bytes(self, gaussians: Gaussians) -> int:
        """Bytes of the tensors that are not parameters of the scene."""
        shared = {x.data_ptr() for x in self.parameters().values()}
        return sum(x.nbytes for x in gaussians.parameters().values() if x.data_ptr() not in shared)


class _DeformableOncePerTime(_OncePerTime):
    """The same of a scene that is a function of its parameters."""

    def deform(self, parameters: dict[str, torch.Tensor], time: float | torch.Tensor | None) -> Gaussians:
        """As the scene."""
        return self._scene.deform(parameters, time)
