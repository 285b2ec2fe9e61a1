"""The protocol of a component: something that a fit estimates, or decides, besides the Gaussians.

A component is a class with one row in `drgs.fitting.components.table.COMPONENTS`. `drgs.train.fit` and the `Trainer`
call its methods below at their times and know no component by name. Every method has a default that does nothing, so
that a component overrides only those that it needs. They are called in this order:

    prepare      before photographs are decoded: what the cameras and the configuration say
    setting      whether it is to be part of this fit; then conflicts are refused
    begin        photographs are there, of a new fit and of one that is resumed
    start        a new fit has its first Gaussians: networks, rows, evidence
    resume       instead of `start`, from a checkpoint
    before_density, before_step, frame, gaussians, scene, rendered, as_photograph, terms, after_backward       each step
    changed, new_rows, restart, join                                    Gaussians or photographs come, or are replaced
    state, write_files                                                                                  each checkpoint
    record, log_fields, describe, evaluation, metrics                                 its part of files and of stderr

Class methods read what a run folder says, when no fit is there: `load_gaussians`, `load_scene`, `held`, `run_metrics`,
`report` and the checks of a checkpoint.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch

if TYPE_CHECKING:
    import numpy as np

    from drgs.cameras import Camera
    from drgs.data import Dataset, View
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame
    from drgs.fitting.losses import LossTerm
    from drgs.fitting.networks import Network, Rate
    from drgs.fitting.renderers import RendererSchedule
    from drgs.fitting.rows import GaussianRows
    from drgs.fitting.stages import Stage
    from drgs.information.choices import Block
    from drgs.information.nuisances import Nuisance
    from drgs.information.scoring import Scoring
    from drgs.integrator import Output
    from drgs.settings import RenderSettings
    from drgs.sfm.guided import Matches

MODES = {
    "selection": "where views are chosen on the way",
    "begin": "where the fit begins with the Gaussians of another",
    "pace": "where the number of steps follows the time that there is",
}
"""Modes of a fit that a component may not support: name, as in `Conflict.other`, -> a clause for messages."""


@dataclasses.dataclass(frozen=True)
class Conflict:
    """Another component, or a mode of the fit, with which a component cannot be combined.

    Attributes:
        other: Name of another component, or of one of `MODES`.
        why: The reason, a clause.
        advice: What to do.
    """

    other: str
    why: str
    advice: str


@dataclasses.dataclass
class Setup:
    """State of a fit before its first step.

    Attributes:
        dataset: The data set.
        config: Configuration; components replace `auto` in it by what they choose.
        train, test: The two splits.
        views: Training views that may be read at the start: all, or the first ones of an active fit.
        times: Distinct times of the views that the fit distinguishes, sorted; none of a static fit.
        components: Components of the fit, in their order.
        modes: The fit's modes, of `MODES`.
        frames, held_out: Photographs of the views that are fitted to at the start, and of `test`, once decoded.
        reserved: Gaussians of the budget that components will add at the start.
        points: (P, 3) initial points, world, once there are some.
        matches: Matches between the photographs of `views` for the initial points; None where none were made, or of
            some of these alone.
        picked_points: Of an active fit, `ActiveViews.compared_points`.
    """

    dataset: Dataset
    config: FitConfig
    train: list[View]
    test: list[View]
    views: list[View]
    times: tuple[float, ...]
    components: Sequence[Component]
    modes: frozenset[str] = frozenset()
    frames: list[Frame] = dataclasses.field(default_factory=list)
    held_out: list[Frame] = dataclasses.field(default_factory=list)
    reserved: int = 0
    points: np.ndarray | None = None
    matches: Matches | None = None
    picked_points: Callable[[np.ndarray | None], tuple[np.ndarray, np.ndarray | None]] | None = None

    @property
    def is_active(self) -> bool:
        """Whether views are chosen on the way."""
        return "selection" in self.modes

    def conflict(self, component: Component) -> tuple[Conflict, str] | None:
        """The first conflict of a component within this fit, and its clause for messages."""
        there = {name: MODES[name] for name in MODES if name in self.modes}
        there |= {x.name: x.where for x in self.components if x is not component and x.setting(self) is not None}
        return next(((x, there[x.other]) for x in component.conflicts if x.other in there), None)


def check_conflicts(setup: Setup) -> None:
    """Raise NotImplementedError if components of this fit cannot be combined.

    Raises:
        NotImplementedError: On the first, in one line.
    """
    for component in setup.components:
        value = component.setting(setup)
        if value is None or (clash := setup.conflict(component)) is None:
            continue
        conflict, where = clash
        option, neutral = component.option
        raise NotImplementedError(
            f"fit: {option} must be {neutral} {where}, got {value}: {conflict.why}; {conflict.advice}"
        )


class Fit(Protocol):
    """The part of a `drgs.fitting.trainer.Trainer` that components read and change."""

    config: FitConfig
    frames: list[Frame]
    rows: GaussianRows
    extent: float
    renderers: RendererSchedule
    step_index: int
    reserved: int
    generator: torch.Generator
    components: list[Component]

    @property
    def part(self) -> float:
        """The fraction of the steps that is done."""

    def stage(self) -> Stage:
        """The steps that density control runs over now."""

    def photographs(self) -> list[Frame]:
        """The training photographs, with their cameras as estimated now."""

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are shown and saved, without a graph; at rest where they move."""

    def scene(self) -> Scene:
        """The scene that a step renders, without gradients to Gaussians."""

    def as_photograph(self, out: Output, frame: Frame) -> Output:
        """A rendering as the photograph's own exposure and the like change it."""

    def begin_stage(self) -> None:
        """Begin a stage in which other parameters are fitted: the epoch, and density control's growth, start again."""

    def trial(self, config: FitConfig, frames: list[Frame], rows: GaussianRows, component: Component) -> Fit:
        """A fit of other Gaussians for a trial, with this component in place of the one of its name."""

    def step(self) -> Any:
        """One step."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Contents of state.safetensors.

    Attributes:
        tensors, header: As `drgs.io.checkpoint.load_state` returns them.
        where: The file, for messages.
    """

    tensors: Mapping[str, torch.Tensor]
    header: Mapping[str, Any]
    where: str


@dataclasses.dataclass(frozen=True)
class RunViews:
    """A run that `drgs eval` measures again.

    Attributes:
        scene: The scene of the run.
        settings: Settings of the fit's renderings.
        refined: Whether the run has refined cameras.
        stated: Cameras of the training photographs that were fitted to, as the data set states them.
        cameras: The same as the run has them.
        held_out: Photographs that were not fitted to, at the size of the fit; none where others are measured.
        names: Names of the photographs that were fitted to, in the order of the fit.
        photographs: Reads these, at the size of the fit.
        networks: Networks of the fit, by name: what `torch.nn.Module.load_state_dict` takes.
    """

    scene: Scene
    settings: RenderSettings
    refined: bool
    stated: list[Camera]
    cameras: list[Camera]
    held_out: list[Frame]
    names: list[str]
    photographs: Callable[[], list[Frame]]
    networks: Mapping[str, Mapping[str, torch.Tensor]]


class Component:
    """A component of a fit. Every fit has instances of its own.

    Attributes:
        name: Its name in the table.
        option: Option that switches it on, and the value, or values, that leave it out; for messages.
        where: Clause for messages of components that conflict with it, e.g. `where exposure is fitted`.
        conflicts: Components and modes that it cannot be combined with. Each pair is declared once, by the one that
            gives way.
        block: Block of information that needs this component, and what a fit without it is, in words; None: none.
        reserved_names: Names in a checkpoint, or their first parts up to a dot, that no network may have.
        files: Names of the files that it writes into a run folder.
        record_kinds, header_kinds: Keys of its part of config.json that are read again, and of a checkpoint's header ->
            kind, as of `drgs.io.json_files.check_json`.
        terms: Terms of the loss, added up after those that every fit has.
        rates: Learning rates by the name of a tensor of `GaussianRows`, also of one that every fit has.
        networks: Networks that it fits beside the Gaussians.
        nuisance: The unknown of each photograph that it estimates, eliminated from information; None: none.
        pictures: Suffixes of the pictures that measuring a view draws besides that of its colors.
        rendering: Arguments of `drgs.render` of a step.
        field_length: Unit of length of the field that moves the Gaussians, world units; None: it has no field.
    """

    name: ClassVar[str]
    option: ClassVar[tuple[str, str]] = ("", "")
    where: ClassVar[str] = ""
    conflicts: ClassVar[tuple[Conflict, ...]] = ()
    block: ClassVar[tuple[Block, str] | None] = None
    reserved_names: ClassVar[tuple[str, ...]] = ()
    files: ClassVar[tuple[str, ...]] = ()
    record_kinds: ClassVar[Mapping[str, Any]] = {}
    header_kinds: ClassVar[Mapping[str, Any]] = {}
    terms: Sequence[LossTerm] = ()
    rates: Mapping[str, Rate] = {}
    networks: Sequence[Network] = ()
    nuisance: Nuisance | None = None
    pictures: Sequence[str] = ()
    rendering: Mapping[str, Any] = {}
    field_length: float | None = None

    # -------------------------------------------------------------------------------------- before the first step

    def prepare(self, setup: Setup) -> None:
        """Read the configuration and the views, which are not decoded yet; may replace `setup.config`."""

    def setting(self, setup: Setup) -> str | None:
        """The value of its option if it is to be part of this fit (a conflict is then refused); else None."""

    def begin(self, setup: Setup, resumed: bool) -> None:
        """Check the decoded photographs, and decide by them; may reserve Gaussians of the budget.

        Args:
            setup: With its photographs.
            resumed: Whether the fit is resumed from a checkpoint.
        """

    def initial_views(self, views: list[View]) -> list[View]:
        """Views that initial points may come from."""
        return views

    def start(self, fit: Fit, setup: Setup) -> None:
        """Begin with a new fit, which has its first Gaussians."""

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """Begin from a checkpoint; the tensors of `networks` that are made here are restored afterwards."""

    # ---------------------------------------------------------------------------------------------------- each step

    def before_density(self, fit: Fit) -> list[dict]:
        """Act before schedules and density control; returns events for the log."""
        return []

    def before_step(self, fit: Fit) -> list[dict]:
        """Act after these, before a photograph is drawn; returns events for the log."""
        return []

    def stage(self, fit: Fit) -> Stage | None:
        """The steps over which density control runs now; None: the whole fit."""

    def fitted_frames(self, frames: list[Frame]) -> list[Frame]:
        """Photographs that steps are fitted to now."""
        return frames

    def frame(self, fit: Fit, frame: Frame) -> Frame:
        """The photograph that a step is compared with; its camera may be differentiated."""
        return frame

    def camera(self, frame: Frame) -> Camera:
        """The camera of a training photograph as it is now, without a graph."""
        return frame.camera

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians that are rendered and saved, from those that are fitted; differentiated."""
        return gaussians

    def scene(self, fit: Fit, scene: Scene) -> Scene:
        """The scene that is rendered, from the Gaussians; differentiated."""
        return scene

    def rendered(self, gaussians: Gaussians, frame: Frame) -> Gaussians:
        """The Gaussians that are rendered for a photograph, from those at its time."""
        return gaussians

    def as_photograph(self, out: Output, frame: Frame) -> Output:
        """A rendering with the photograph's own exposure and the like, for the loss; differentiated."""
        return out

    def as_shown(self, image: torch.Tensor, frame: Frame) -> torch.Tensor:
        """The inverse: the image (H, W, 3) of a photograph without an exposure of its own and the like; no graph."""
        return image

    def after_backward(self, fit: Fit) -> None:
        """Change gradients before optimizers step."""

    # ------------------------------------------------------------------------- Gaussians and photographs that come

    def changed(self, fit: Fit) -> None:
        """Gaussians or photographs have been added or removed."""

    def new_rows(self, fit: Fit, count: int) -> dict[str, torch.Tensor]:
        """Rows of its tensors for Gaussians that are added at points; left out, they are 0."""
        return {}

    def restart(self, fit: Fit) -> None:
        """All Gaussians have been replaced by new ones at points; networks and schedules continue."""

    def join(self, fit: Fit, frame: Frame, setup: Setup) -> list[dict]:
        """A photograph is about to be added to `fit.frames`; returns events for the log, with which config.json is
        written anew.
        """
        return []

    # ------------------------------------------------------------------------------- files, log, metrics and report

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and header that a checkpoint has besides those of `networks` and rows."""
        return {}, {}

    def write_files(self, folder: Path) -> None:
        """Write its `files` into the run folder, atomically: when a run begins, and after every checkpoint."""

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """Its part of config.json; `before` is the one of a fit that is resumed, else empty."""
        return {}

    def scoring(self, scoring: Scoring) -> Scoring:
        """How candidates of an active fit are scored."""
        return scoring

    def labels(self) -> tuple[Classes | None, Decoder | None]:
        """The classes of the scene, and the decoder of its features, by which a class is found; None without."""
        return None, None

    def log_fields(self, fit: Fit, terms: Sequence[Mapping[str, float]]) -> dict[str, Any]:
        """Its part of the `train` events; `terms` of the loss by name, of the steps since the last event."""
        return {}

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """The line on stderr for one of its own events of the log; None for others."""

    def evaluation(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """Arguments of `drgs.fitting.metrics.evaluate`."""
        return {}

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """Its part of metrics.json at the end of the fit."""
        return {}

    # ------------------------------------------------------------------------------------- what a run folder says

    @classmethod
    def tensor_kinds(cls, checkpoint: Checkpoint, count: int) -> dict[str, tuple[torch.dtype, tuple[int, ...]]]:
        """Type and shape of its tensors in a checkpoint of `count` Gaussians."""
        return {}

    @classmethod
    def check(cls, checkpoint: Checkpoint) -> str | None:
        """The first problem of its part of a checkpoint, in words; None: none."""

    @classmethod
    def load_gaussians(cls, gaussians: Gaussians, checkpoint: Checkpoint) -> Gaussians:
        """As `gaussians`, of a checkpoint."""
        return gaussians

    @classmethod
    def load_scene(cls, scene: Scene, checkpoint: Checkpoint) -> Scene:
        """As `scene`, of a checkpoint; for rendering, not fitted."""
        return scene

    @classmethod
    def held(
        cls, names: list[str], networks: Mapping[str, Mapping[str, torch.Tensor]], settings: RenderSettings
    ) -> Component | None:
        """With what its networks say of photographs, which stays: for `as_photograph` and `as_shown` without a fit.

        Args:
            names: Photographs that were fitted to, in the order of the fit.
            networks: As of `RunViews`.
            settings: Settings of the renderings.
        Returns:
            None where they say nothing.
        Raises:
            ValueError: If they are not of these photographs.
        """
        return None

    @classmethod
    def run_evaluation(cls, run: RunViews) -> dict[str, Any]:
        """Arguments of `drgs.fitting.metrics.evaluate` where a run is measured again."""
        return {}

    @classmethod
    def run_metrics(cls, run: RunViews) -> dict[str, Any]:
        """Its part of metrics.json where a run is measured again."""
        return {}

    @classmethod
    def report(cls, config: Mapping[str, Any], metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Its lines on the report page, each a name and a text, of the contents of config.json and metrics.json."""
        return []
