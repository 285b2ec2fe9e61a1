"""Options that several commands have: what `options.py` builds those of each command from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

from drgs.commands.overrides import parsed
from drgs.fitting.config import ActiveConfig
from drgs.information.choices import Block, Criterion, Method, Policy
from drgs.settings import Preset, RenderSettings

__all__ = ["Around", "Choosing", "Common", "Data", "Informed", "OutputPath", "Settings", "Split"]

OutputPath = Annotated[Path, arg(aliases=["-o"])]
Split = Literal["all", "train", "test"]

# One text, `geometry,semantic`; what is none of the names is refused where the blocks are used.
_BLOCKS: Any = PrimitiveConstructorSpec(
    nargs=1,
    metavar="BLOCK,BLOCK",
    instance_from_str=lambda texts: tuple(name.strip() for name in texts[0].split(",")),
    is_instance=lambda x: x is None or isinstance(x, tuple),
    str_from_instance=lambda x: ["all there is" if x is None else ",".join(x)],
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Common:
    """Options that every command has."""

    variant: Literal["auto", "llvm_ad_rgb", "cuda_ad_rgb"] = "auto"
    """Backend; auto follows DRGS_VARIANT, then CUDA if it works, else LLVM."""
    threads: int | None = None
    """Threads of Dr.Jit and torch; default DRGS_THREADS, else every usable core."""
    quiet: bool = False
    """Print neither progress nor results, which are in the files; only warnings and errors."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """Options of commands that render."""

    preset: Preset = "exact"
    """Render settings of a named system."""
    overrides: Annotated[
        tuple[str, ...],
        arg(name="set", metavar="KEY=VALUE", help="Replace one render setting, e.g. order=ray."),
        UseAppendAction,
    ] = ()

    def settings(self) -> RenderSettings:
        """The `RenderSettings` that --preset and --set describe.

        Raises:
            ValueError: If an override is no KEY=VALUE, names no field or has the wrong type.
        """
        return RenderSettings.preset(self.preset, **self.replaced())

    def replaced(self) -> dict[str, Any]:
        """The fields that --set replaces.

        Raises:
            ValueError: If one is no KEY=VALUE, names no field or has the wrong type.
        """
        return parsed(self.overrides)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Data:
    """Options of commands that load data sets."""

    strict: bool = False
    """Refuse a data set that lists images which are not there; else at least 3 must be, and the others are left out."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Around:
    """Options of commands that can make cameras around a scene; what is not given is as a run's photographs or the
    known views have it, where there are any.
    """

    up: Literal["auto", "x", "y", "z", "minus-x", "minus-y", "minus-z"] = "auto"
    """World direction that is up on an orbit or a dome; auto: as the photographs, else minus-y."""
    center: tuple[float, float, float] | None = None
    """World point that an orbit or a dome looks at; default as the photographs, else the middle of the Gaussians."""
    distance: float | None = None
    """From that point, in scene units; default the photographs' median, else so that all is in the frame."""
    elevation: float | None = None
    """Degrees of an orbit above its center; default the photographs' median, else 20."""
    span: float | None = None
    """Degrees of an orbit; default as the photographs (select, fisher: 360 if they look at a point), else 360."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Informed(Settings):
    """Options of commands that compute Fisher information."""

    method: Method = ActiveConfig.method
    """How information is computed: exactly (columns: slowly), by 16 random probes, or as FisherRF's code does."""
    prior: float = ActiveConfig.prior
    """How firmly every parameter counts as known beforehand (lambda); 0 leaves out what no training view has seen."""
    relative_prior: bool = ActiveConfig.relative_prior
    """lambda is --prior times the median information of a parameter's group, where it is not 0."""
    info_pixels: int | None = ActiveConfig.info_pixels
    """Information is computed on views of at most this many pixels; default as in the fit."""
    blocks: Annotated[tuple[Block, ...] | None, _BLOCKS] = ActiveConfig.blocks
    """What of an image tells: geometry (its colors), semantic (its features), or geometry,semantic; default all."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choosing(Informed):
    """Options of commands that choose views."""

    policy: Policy = ActiveConfig.policy
    """How the next view is chosen (docs/information.md)."""
    criterion: Criterion = ActiveConfig.criterion
    """Score of policy fisher; eig chose better views than logdet where views were few (docs/active-static.md)."""
    seed: int = 0
    """Seed of everything random."""
