"""The table of components: a name and a class each. Another package adds a row by the entry point `drgs.components`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from drgs.checks.registry import Registry
from drgs.fitting.components.base import Component

if TYPE_CHECKING:
    import torch

    from drgs.settings import RenderSettings

_HERE = "drgs.fitting.components"

COMPONENTS: Registry[type[Component]] = Registry(
    "component",
    "drgs.components",
    {
        # In the order in which their methods are called. The lens says what photographs are; terms of the loss are
        # added up in this order; a pose is rendered before an exposure scales the colors; lifespans belong to
        # what motion has begun.
        "lens": f"{_HERE}.lens:LensComponent",
        "filter_3d": f"{_HERE}.filter_3d:Filter3DComponent",
        "skybox": f"{_HERE}.skybox:SkyboxComponent",
        "semantics": f"{_HERE}.semantics:SemanticsComponent",
        "depth": f"{_HERE}.depth:DepthComponent",
        "poses": f"{_HERE}.poses:PosesComponent",
        "exposure": f"{_HERE}.exposure:ExposureComponent",
        "transients": f"{_HERE}.transients:TransientsComponent",
        "dropout": f"{_HERE}.dropout:DropoutComponent",
        "motion": f"{_HERE}.motion:MotionComponent",
        "lifespans": f"{_HERE}.lifespans:LifespansComponent",
        "pruning": f"{_HERE}.pruning:PruningComponent",
    },
    row=type,
)
"""Name -> class of everything that a fit may have besides photographs and Gaussians."""


def components_of(kinds: Sequence[Callable[[], Component]] | None = None) -> list[Component]:
    """New instances for a fit; `kinds`: what makes them, default all rows of the table."""
    return [kind() for kind in (COMPONENTS.values() if kinds is None else kinds)]


def component_files() -> list[str]:
    """Names of the files that components write into a run folder."""
    return [name for kind in COMPONENTS.values() for name in kind.files]


def held_components(
    names: list[str], networks: Mapping[str, Mapping[str, torch.Tensor]], settings: RenderSettings
) -> list[Component]:
    """What the fit of a run has left that is said of photographs; arguments as of `Component.held`."""
    held = (kind.held(names, networks, settings) for kind in COMPONENTS.values())
    return [component for component in held if component is not None]
