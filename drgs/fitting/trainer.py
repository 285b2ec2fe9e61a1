"""One fit, a step at a time: the losses and rates of 3DGS and MCMC density control (density.py) with a fixed budget.

All schedules are fractions of `max_steps`, so that a short fit goes through all of them. One view a step, in epochs
of random order. What a fit has besides photographs and Gaussians are its components (`drgs.fitting.components`), whose
methods are called at their times. `drgs.train` adds files, progress and the command.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from drgs.ellipsoids import Gaussians, Scene
from drgs.fitting.components.base import Checkpoint, Component, Setup
from drgs.fitting.components.table import components_of
from drgs.fitting.config import FitConfig
from drgs.fitting.density import add_gaussians, explore, relocate
from drgs.fitting.losses import LossTerm, psnr_of, terms_of
from drgs.fitting.networks import Network, rate_at
from drgs.fitting.rates import means_rate, rates_of
from drgs.fitting.renderers import RendererSchedule
from drgs.fitting.resolution import Resolution
from drgs.fitting.rows import GaussianRows
from drgs.fitting.stages import Stage
from drgs.information.nuisances import NUISANCES, Nuisance
from drgs.integrator import Output, render

if TYPE_CHECKING:
    from drgs.fitting.frames import Frame

_MAX_BAD_STEPS = 10  # steps in a row without finite gradients that end a fit, more than one bad view; chosen
# Parts of names in a checkpoint, not of networks; components have more.
_RESERVED = {"parameter", "adam", "rng", "queue", "policy_rng"}


@dataclasses.dataclass(frozen=True)
class StepResult:
    """Result of one step, of its last update where it has several.

    Attributes:
        loss: Loss of its view, before the update, as all of these.
        terms: Terms of the loss by name, those that this view has.
        psnr: PSNR of this view in dB, of what the update saw of it; None where it is not finite.
        view: Its name.
        events: What is to be logged.
    """

    loss: float
    terms: dict[str, float]
    psnr: float | None
    view: str
    events: list[dict]


class Trainer:
    """The state of a fit, one `step` at a time; a `drgs.fitting.components.base.Fit`.

    Attributes:
        config: The `FitConfig`.
        frames: Training photographs.
        rows: The Gaussians and their optimizer.
        extent: Extent of the scene, its unit of length.
        components: The fit's components, in the order of the table.
        terms: Terms of the loss that every fit has, added up before those of components.
        renderers: What each step is rendered with.
        resolution: How large each step sees the photographs.
        step_index: Steps done.
        bad_steps: Steps skipped because a loss or gradient was not finite.
        reserved: Part of the budget that density control leaves for points of photographs to come.
        generator: Generator of all random choices of the steps.
    """

    def __init__(
        self,
        config: FitConfig,
        frames: list[Frame],
        rows: GaussianRows,
        extent: float,
        components: list[Component] | None = None,
        setup: Setup | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        """A fit at its first step.

        Args:
            components: Their instances, for this fit alone; default those of the table, without evidence of a data set.
            setup: What components begin with; None: they have begun, or have nothing to begin with.
            checkpoint: What they are resumed from.
        Raises:
            ValueError: If there is no photograph or no Gaussian, a tensor has no rate, or two networks have one name.
        """
        if not frames:
            raise ValueError("fit: there must be at least one training view, got none; add photographs")
        if not len(rows):
            raise ValueError("fit: there must be at least one initial point, got none; check the data set")
        self.config = config
        self.frames = frames
        self.rows = rows
        self.extent = extent
        self.components = components_of() if components is None else components
        self.renderers = RendererSchedule.of(config.renderers, config.settings)
        self.resolution = Resolution.of(config)
        self.step_index = self.bad_steps = self._bad_in_a_row = 0
        self._bad: str | None = None  # what was not finite first
        self.generator = torch.Generator().manual_seed(config.seed)
        self._queue = torch.zeros(0, dtype=torch.int64)
        self.reserved = 0
        for component in self.components:
            if setup is not None:
                component.start(self, setup)
            if checkpoint is not None:
                component.resume(self, checkpoint)
        self.terms: list[LossTerm] = terms_of(config, extent, rows.far)
        self._start_count = len(rows)
        self._check()
        if checkpoint is None:
            self._changed()

    @property
    def networks(self) -> list[Network]:
        """Networks that are fitted beside the Gaussians."""
        return [network for component in self.components for network in component.networks]

    @property
    def nuisances(self) -> list[Nuisance]:
        """Unknowns of the photographs that are estimated beside the scene."""
        estimated = {component.nuisance for component in self.components}
        return [name for name in NUISANCES if name in estimated]

    @property
    def part(self) -> float:
        """The fraction of the fit that is done."""
        return self.step_index / self.config.max_steps

    def component(self, name: str) -> Any:
        """The component of a name.

        Raises:
            KeyError: If the fit has none.
        """
        return {component.name: component for component in self.components}[name]

    def network(self, name: str) -> torch.nn.Module | None:
        """The module of the network of a name; None if there is none."""
        return next((network.module for network in self.networks if network.name == name), None)

    def _check(self) -> None:
        """Raise ValueError if a tensor has no rate, or two networks have one name."""
        if missing := sorted(set(self.rows.tensors) - set(self._rates())):
            raise ValueError(
                f"fit: every tensor must have a learning rate, {missing[0]} has none; a component must add it"
            )
        names = [network.name for network in self.networks]
        reserved = _RESERVED.union(*(component.reserved_names for component in self.components))
        if len(set(names)) < len(names) or any(reserved & set(name.split(".")) for name in names):
            raise ValueError(
                f"fit: networks must have names of their own, none of whose parts is {', '.join(sorted(reserved))}, "
                f"got {', '.join(names)}; rename one"
            )

    def _rates(self) -> dict:
        rates = rates_of(self.config, self.extent)
        for component in self.components:
            rates |= component.rates
        return rates

    # --------------------------------------------------------------------- Gaussians and photographs that come and go

    def add_points(self, points: torch.Tensor, colors: torch.Tensor, opacity: float, scale: float) -> None:
        """Add Gaussians at points, as `GaussianRows.from_points` makes them; those that are there stay as they are."""
        rows = GaussianRows.from_points(points, colors, opacity, scale, self.rows.origin)
        new = rows.take(torch.arange(len(points)))
        del new["sh_rest"]  # 0 up to the degree that the others have
        for component in self.components:
            new |= component.new_rows(self, len(points))
        self.rows.append(new)
        self._changed()

    def restart(self, points: torch.Tensor, colors: torch.Tensor) -> None:
        """Begin again with Gaussians at other points; schedules, networks and photographs stay as they are."""
        degree = self.rows.sh_degree
        origin = self.rows.origin
        self.rows = GaussianRows.from_points(points, colors, *self.config.density.start_of(False), origin)
        for component in self.components:
            component.restart(self)
        self.terms = terms_of(self.config, self.extent)
        while self.rows.sh_degree < degree:
            self.rows.raise_sh_degree()
        self._start_count = len(self.rows)
        self._changed()

    def add_frame(self, frame: Frame) -> None:
        """One more photograph; the epoch begins anew, so that it is seen soon."""
        self.frames = [*self.frames, frame]
        self._queue = self._queue[:0]
        self._changed()

    def drop_frame(self, name: str) -> None:
        """Fit no longer to the photograph of that name; the epoch begins anew.

        Raises:
            ValueError: If there is no such photograph, or no other one.
        """
        left = [frame for frame in self.frames if frame.name != name]
        if not left or len(left) == len(self.frames):
            raise ValueError(
                f"fit: drop_frame must name one of {len(self.frames)} photographs and leave another, got {name!r}; "
                "keep it"
            )
        self.frames = left
        self.resolution = Resolution.of(self.config)  # small photographs are kept by their index
        self._queue = self._queue[:0]
        self._changed()

    def _changed(self) -> None:
        for component in self.components:
            component.changed(self)

    def begin_stage(self) -> None:
        """See `Fit`."""
        self._check()
        self._queue = self._queue[:0]
        self._start_count = len(self.rows)

    def reschedule(self, max_steps: int) -> None:
        """Change the number of steps; schedules depend on the share of the steps that is done, and continue.

        Args:
            max_steps: Steps of the whole fit, more than have been done.
        Raises:
            ValueError: If they have been done already, or where the fit has stages, whose rates count steps.
        """
        if any(stage is not None and stage.length for stage in (x.stage(self) for x in self.components)):
            raise ValueError("fit: steps must stay as they are where things move; fit again with others")
        if max_steps <= self.step_index:
            raise ValueError(f"fit: steps must be more than the {self.step_index} done, got {max_steps}; ask for more")
        self.config = self.config.replace(max_steps=max_steps)
        self.resolution = Resolution.of(self.config)

    def trial(self, config: FitConfig, frames: list[Frame], rows: GaussianRows, component: Component) -> Trainer:
        """See `Fit`."""
        others = [component if x.name == component.name else x for x in components_of()]
        return Trainer(config, frames, rows, self.extent, others)

    # ------------------------------------------------------------------------------------------------------- a step

    def step(self) -> StepResult:
        """What is due at a step, and its optimizer updates: one, with one view, or several (resolution.py).

        Raises:
            ValueError: After 10 updates in a row without a finite loss and gradient.
        """
        done = self.step_index
        events = [event for component in self.components for event in component.before_density(self)]
        events += self.resolution.events(done, self.frames)
        events += self._prepare(done)
        events += [event for component in self.components for event in component.before_step(self)]
        for _ in range(self.resolution.updates(done)):
            result = self._update(done, events)
        self.step_index += 1
        return result

    def _update(self, done: int, events: list[dict]) -> StepResult:
        """One view, one optimizer update; `events` gets what is to be logged."""
        index = self._next_view()
        frame = self.frames[index]
        gaussians = self._scene().at(frame.camera.time)
        for component in self.components:
            frame = component.frame(self, frame)
        frame = self.resolution.seen(index, frame, done, self.generator)
        out = self.as_photograph(self._rendered(gaussians, frame), frame)
        loss, values = self._loss(out, frame, gaussians)
        networks = self.networks
        optimizers = [self.rows.optimizer, *(network.optimizer for network in networks)]
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for component in self.components:
            component.after_backward(self)
        with torch.no_grad():  # logged, not optimized
            mse = self._mse(frame, out.rgb)
        if (bad := self._not_finite(loss)) is None:
            self._bad_in_a_row, self._bad = 0, None
            for optimizer in optimizers:
                optimizer.step()
            for network in networks:
                network.hold()
            self._explore(done)
        else:
            events.append(self._skip(bad, frame))
        psnr = psnr_of(mse) if math.isfinite(mse) else None
        return StepResult(float(loss.detach()), values, psnr, frame.name, events)  # logged, not optimized

    def _explore(self, done: int) -> None:
        """The noise of density control after step `done`."""
        density, stage = self.config.density, self.stage()
        if density.noise and done - stage.begin < density.refine_stop * stage.length:
            explore(self.rows, means_rate(self.config, self.part), self.extent, density.noise, self.generator)

    def _skip(self, bad: str, frame: Frame) -> dict:
        """Count a step that changes nothing, since `bad` is not finite; the event for the log.

        Raises:
            ValueError: If it is the last of 10 in a row.
        """
        self.bad_steps += 1
        self._bad_in_a_row += 1
        self._bad = self._bad or bad
        if self._bad_in_a_row == _MAX_BAD_STEPS:
            raise ValueError(
                f"fit: loss and gradients must be finite, were not for {_MAX_BAD_STEPS} steps in a row until step "
                f"{self.step_index} (view {frame.name}), first the {self._bad}; check the cameras, or lower the "
                "learning rates"
            )
        return {"event": "skipped", "view": frame.name, "reason": f"{bad} not finite"}

    def stage(self) -> Stage:
        """See `Fit`."""
        stages = [stage for component in self.components if (stage := component.stage(self)) is not None]
        return stages[0] if stages else Stage(0, self.config.max_steps)

    def photographs(self) -> list[Frame]:
        """See `Fit`."""
        for frame in self.frames:
            for component in self.components:
                frame.camera = component.camera(frame)
        return self.frames

    @property
    def is_sound(self) -> bool:
        """Whether the last step had a finite loss and gradients."""
        return not self._bad_in_a_row

    def gaussians(self) -> Gaussians:
        """See `Fit`."""
        return self._gaussians().detach()

    def scene(self) -> Scene:
        """See `Fit`."""
        scene = self._scene()
        return scene.detach() if isinstance(scene, Gaussians) else scene  # for display, not optimized

    def as_photograph(self, out: Output, frame: Frame) -> Output:
        """See `Fit`."""
        for component in self.components:
            out = component.as_photograph(out, frame)
        return out

    def describe(self, event: Mapping[str, Any]) -> list[str]:
        """Lines on stderr for an event of a step."""
        lines = [self.resolution.describe(event), *(component.describe(event) for component in self.components)]
        return [line for line in lines if line is not None]

    # -------------------------------------------------------------------------------------------------- checkpoints

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and header of a checkpoint."""
        tensors = {**self.rows.state(), "rng": self.generator.get_state(), "queue": self._queue}
        networks = self.networks
        for network in networks:
            tensors |= network.state()
        header = {
            "step": self.step_index,
            "bad_steps": self.bad_steps,
            "start_count": self._start_count,
            "extent": self.extent,
            "views": [frame.name for frame in self.frames],
            "config": self.config.to_json(),
            **({"networks": sorted(network.name for network in networks)} if networks else {}),
            **self.rows.header(),
        }
        for component in self.components:
            more, said = component.state(self)
            tensors |= more
            header |= said
        return tensors, header

    @classmethod
    def from_state(
        cls,
        config: FitConfig,
        frames: list[Frame],
        tensors: dict[str, torch.Tensor],
        header: dict,
        where: str,
        components: list[Component] | None = None,
    ) -> Trainer:
        """Resume from a checkpoint.

        Args:
            config, frames: The same as before, but for `saving`.
            tensors, header: Contents of the checkpoint.
            where: It, for messages.
            components: As of `Trainer`, before they have begun.
        Raises:
            ValueError: If the checkpoint belongs to another config, other views or other networks.
        """
        # Options that an older version did not have are at their defaults.
        before = FitConfig.from_json(header["config"])
        config = config.resuming(before)
        if other := config.difference(before):
            name, now, was = other
            raise ValueError(
                f"{where}: --resume must continue the same fit, {name} was {was!r} and is {now!r}; "
                "repeat the options or choose another run folder"
            )
        if header["views"] != [frame.name for frame in frames]:
            raise ValueError(
                f"{where}: --resume must have the same training views, the data set has changed; choose another folder"
            )
        rows = GaussianRows.from_state(tensors, header)
        checkpoint = Checkpoint(tensors, header, where)
        trainer = cls(config, frames, rows, header["extent"], components, checkpoint=checkpoint)
        old = sorted(header.get("networks", []))
        new = sorted(network.name for network in trainer.networks)
        if old != new:
            raise ValueError(
                f"{where}: --resume must continue the same fit, networks were {old} and are {new}; "
                "repeat the options or choose another run folder"
            )
        for network in trainer.networks:
            network.restore(tensors, where)
        trainer.step_index = header["step"]
        trainer.bad_steps = header["bad_steps"]
        trainer._start_count = header["start_count"]
        trainer.generator.set_state(tensors["rng"])
        trainer._queue = tensors["queue"]
        return trainer

    # ------------------------------------------------------------------------------------------------ within a step

    def _prepare(self, done: int) -> list[dict]:
        """Schedules and density control before step `done`."""
        config = self.config
        density = config.density
        rows = self.rows
        events = []
        # The degree is a quotient, rounded up; 1e-9 keeps a whole one from being rounded up to the next.
        apart = max(1, round(config.rates.sh_every * config.max_steps))
        while rows.sh_degree < min(config.sh_degree, done / apart - 1e-9):
            rows.raise_sh_degree()
            events.append({"event": "sh_degree", "degree": rows.sh_degree})
        stage = self.stage()
        every = max(1, round(density.refine_every * stage.length))
        start = density.refine_start * stage.length
        stop = density.refine_stop * stage.length
        if (done - stage.begin) % every == 0 and max(start, 1) <= done - stage.begin < stop:
            events.append(self._refine(done, start))
        rates = self._rates()
        rows.set_rates({name: rate_at(rates[name], self.part) for name in rows.tensors})
        for network in self.networks:
            network.set_rate(self.part)
        return events

    def _refine(self, done: int, start: float) -> dict:
        """Density control at step `done`; `start`: when the first is due in a stage. What it did, for the log."""
        density = self.config.density
        rows = self.rows
        stage = self.stage()
        moved = relocate(rows, density.min_opacity, density.jitter, self.generator)
        # Growth by a constant factor that reaches the budget at grow_until, whatever the schedule's length.
        full = max(density.grow_until * stage.length - start, 1)
        part = min(1.0, (done - stage.begin - start + density.refine_every * stage.length) / full)
        budget = round(stage.budget * density.max_gaussians) - self.reserved
        wanted = round(self._start_count * (budget / self._start_count) ** part) if self._start_count < budget else 0
        missing = min(wanted, budget) - len(rows)
        added = add_gaussians(rows, missing, density.min_opacity, density.jitter, self.generator)
        self._changed()
        return {"event": "density", "moved": moved, "added": added, "gaussians": len(rows)}

    def _next_view(self) -> int:
        """Index of a photograph, each of those that are fitted to now once an epoch."""
        if not len(self._queue):
            fitted = self.frames
            for component in self.components:
                fitted = component.fitted_frames(fitted)
            chosen = {id(frame) for frame in fitted}
            shown = [i for i, frame in enumerate(self.frames) if id(frame) in chosen]
            self._queue = torch.tensor(shown)[torch.randperm(len(shown), generator=self.generator)]
        view = int(self._queue[0])
        self._queue = self._queue[1:].clone()
        return view

    def _gaussians(self) -> Gaussians:
        """The Gaussians that are shown of the rows; differentiated."""
        gaussians = self.rows.gaussians()
        for component in self.components:
            gaussians = component.gaussians(gaussians)
        return gaussians

    def _scene(self) -> Scene:
        """The scene that a step renders; differentiated."""
        scene: Scene = self._gaussians()
        for component in self.components:
            scene = component.scene(self, scene)
        return scene

    def _all_terms(self) -> list[LossTerm]:
        return [*self.terms, *(term for component in self.components for term in component.terms)]

    def _rendered(self, gaussians: Gaussians, frame: Frame) -> Output:
        """Rendering of the Gaussians by a photograph's camera, with the outputs that the terms of the loss need."""
        options: dict[str, Any] = {}
        for component in self.components:
            gaussians = component.rendered(gaussians, frame)
            options |= component.rendering
        outputs = {name: None for term in self._all_terms() for name in term.outputs}  # each once, in their order
        settings = self.renderers.settings_at(self.step_index)
        return render(gaussians, frame.camera, settings, outputs=tuple(outputs), **options)

    def _loss(self, out: Output, frame: Frame, gaussians: Gaussians) -> tuple[torch.Tensor, dict[str, float]]:
        """The sum of the terms that a view has, and each of them by name."""
        total = None
        values = {}
        for term in self._all_terms():
            value = term(out, frame, gaussians)
            if value is not None:
                total = value if total is None else total + value
                values[term.name] = float(value.detach())  # logged, not optimized
        if total is None:
            raise ValueError(f"fit: a view must have a term of the loss, {frame.name} has none; add one")
        return total, values

    def _mse(self, frame: Frame, rgb: torch.Tensor) -> float:
        error = (rgb.clamp(0, 1) - frame.image()).square().mean(2)
        if frame.mask is None:
            return float(error.mean())
        return float((error * frame.mask).sum() / frame.mask.sum().clamp(min=1))

    def _not_finite(self, loss: torch.Tensor) -> str | None:
        """Name of the first parameter, else of the loss or a gradient, that is not finite; None if all are finite.

        A sum is not finite where one of its numbers is not.
        """
        named = [*self.rows.tensors.items()]
        named += [(f"{n.name}.{key}", x) for n in self.networks for key, x in n.module.named_parameters()]
        # Values, without gradients.
        if all(
            math.isfinite(float(x)) for x in (loss.detach(), *(x.grad.sum() for _, x in named if x.grad is not None))
        ):
            return None
        for name, x in named:
            if not math.isfinite(float(x.detach().sum())):
                return name
        gradients = [(name, x.grad) for name, x in named if x.grad is not None]
        bad = next((name for name, grad in gradients if not math.isfinite(float(grad.sum()))), "")
        if not math.isfinite(float(loss.detach())):
            return f"loss (and the gradient of {bad})" if bad else "loss"
        return f"gradient of {bad}"
