"""One fit, a step at a time: the losses and rates of 3DGS and MCMC density control (density.py) with a fixed budget.

All schedules are fractions of `max_steps`, so that a short fit goes through all of them. One view a step, in epochs
of random order. What moves is fitted in two stages (dynamics.py). `drgs.train` adds files, progress and the command.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import torch

from drgs.ellipsoids import Gaussians
from drgs.fitting.config import FitConfig
from drgs.fitting.density import add_gaussians, explore, relocate
from drgs.fitting.exposure import Exposure
from drgs.fitting.filter_3d import VARIANCES
from drgs.fitting.losses import psnr_of
from drgs.fitting.networks import rate_at
from drgs.fitting.parts import Parts, means_rate, parts_of, with_exposure, with_skybox, without_exposure
from drgs.fitting.poses import is_due
from drgs.fitting.renderers import AUTO, RendererSchedule
from drgs.fitting.resolution import Resolution
from drgs.fitting.rows import GaussianRows
from drgs.fitting.stages import Stage
from drgs.fitting.transients import Transients
from drgs.integrator import render

if TYPE_CHECKING:
    from drgs.ellipsoids import Scene
    from drgs.fitting.dynamics import Motion
    from drgs.fitting.exposure import ExposureEstimate
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output

__all__ = ["StepResult", "Trainer"]

_MAX_BAD_STEPS = 10
# Parts of names in a checkpoint, not of networks.
_RESERVED = {"parameter", "adam", "rng", "queue", "policy_rng", "transient", VARIANCES}


@dataclasses.dataclass(frozen=True)
class StepResult:
    """What one step was.

    Attributes:
        loss: Loss of its view, before the step, as all of these.
        terms: Terms of the loss by name, those that this view has.
        psnr: PSNR of this view in dB, at the size that the step saw it; None where it is not finite.
        view: Its name.
        events: What is to be logged.
    """

    loss: float
    terms: dict[str, float]
    psnr: float | None
    view: str
    events: list[dict]


class Trainer:
    """The state of a fit, one `step` at a time.

    Attributes:
        config: The `FitConfig`.
        frames: Training photographs.
        rows: The Gaussians and their optimizer.
        extent: Extent of the scene, its unit of length.
        parts: Terms of the loss, learning rates, networks, and what is rendered.
        motion: The stages of a fit to what moves; None of what stands still.
        renderers: What each step is rendered with.
        resolution: How large each step sees the photographs.
        transients: What single photographs alone show.
        step_index: Steps done.
        bad_steps: Steps skipped because a loss or gradient was not finite.
        reserved: Part of the budget that density control leaves for points of photographs to come.
    """

    def __init__(
        self,
        config: FitConfig,
        frames: list[Frame],
        rows: GaussianRows,
        extent: float,
        parts: Parts | None = None,
        motion: Motion | None = None,
    ) -> None:
        """A fit at its first step.

        Args:
            parts: Default those of `config`.
            motion: Stage that a fit of what moves is in, and what comes with the next.
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
        self.parts = with_skybox(parts_of(config, extent) if parts is None else parts, rows.skybox)
        self.motion = motion
        self._check_parts()
        self.renderers = RendererSchedule.of(config.renderers, config.settings, config.max_steps)
        self.resolution = Resolution(config.data.num_downscales, config.max_steps)
        self.transients = Transients(config.loss.transients)
        self.step_index = self.bad_steps = self._bad_in_a_row = 0
        self._bad: str | None = None  # what was not finite first
        self._generator = torch.Generator().manual_seed(config.seed)
        self._queue = torch.zeros(0, dtype=torch.int64)
        self._start_count = len(rows)
        self.reserved = 0
        self._sample()

    def _check_parts(self) -> None:
        """Raise ValueError if a tensor has no rate, or two networks have one name."""
        rows = self.rows
        if missing := sorted(set(rows.tensors) - set(self.parts.rates)):
            raise ValueError(f"fit: every tensor must have a learning rate, {missing[0]} has none; add it to the parts")
        names = [network.name for network in self.parts.networks]
        if len(set(names)) < len(names) or any(_RESERVED & set(name.split(".")) for name in names):
            raise ValueError(
                f"fit: networks must have names of their own, none of whose parts is {', '.join(sorted(_RESERVED))}, "
                f"got {', '.join(names)}; rename one"
            )

    def add_points(self, points: torch.Tensor, colors: torch.Tensor, opacity: float, scale: float) -> None:
        """Add Gaussians at points, as `GaussianRows.from_points` makes them; those that are there stay as they are."""
        new = GaussianRows.from_points(points, colors, opacity, scale).take(torch.arange(len(points)))
        del new["sh_rest"]  # 0 up to the degree that the others have
        if self.motion is not None:
            new |= self.motion.new_gates(len(points), self.rows)
        self.rows.append(new)
        self._sample()

    def restart(self, points: torch.Tensor, colors: torch.Tensor) -> None:
        """Begin again with Gaussians at other points; schedules, networks and photographs stay as they are."""
        features = self.rows.tensors.get("features")
        width = 0 if features is None else features.shape[1]
        degree = self.rows.sh_degree
        self.rows = GaussianRows.from_points(points, colors, *self.config.density.start_of(False), features=width)
        self.parts = with_skybox(self.parts, 0)
        while self.rows.sh_degree < degree:
            self.rows.raise_sh_degree()
        self._start_count = len(self.rows)
        self._sample()

    def add_unknowns(self, frame: Frame, estimate: ExposureEstimate | None = None) -> None:
        """Begin with what is unknown of a photograph that is about to be added, besides the scene.

        The scene's colors change by what the gauge of the gains does, so that the other photographs look as before.

        Args:
            frame: The photograph; it gets a pose where the others have.
            estimate: What points say of the gains of all photographs, of this one last. From now on each has its own;
                None: nothing is said of gains.
        """
        poses = self.parts.poses
        if poses is not None:
            for network in self.parts.networks:
                if network.module is poses:
                    network.extend(lambda: poses.join(frame.camera, self.gaussians(), self.rows.skybox))
        if estimate is None:
            return
        if self.parts.exposure is None:
            self.parts = with_exposure(self.parts, self.frames, self.config)
        names = [frame.name for frame in (*self.frames, frame)]
        for network in self.parts.networks:
            gains = network.module
            if isinstance(gains, Exposure):
                grown = network.extend(functools.partial(gains.join, names, estimate))
                self.rows.scale_colors((-grown).exp())

    def drop_exposure(self) -> None:
        """From now on all photographs have the same gain; that of theirs was 1 on average, so that colors stay."""
        if self.parts.exposure is not None:
            self.parts = without_exposure(self.parts)

    def add_frame(self, frame: Frame) -> None:
        """One more photograph; the epoch begins anew, so that it is seen soon."""
        self.frames = [*self.frames, frame]
        self._queue = self._queue[:0]
        self._sample()

    def drop_frame(self, name: str) -> None:
        """Fit no longer to the photograph of that name; the epoch begins anew.

        Raises:
            ValueError: If there is no such photograph, or no other one.
        """
        left = [frame for frame in self.frames if frame.name != name]
        if not left or len(left) == len(self.frames):
            raise ValueError(f"fit: {name!r} must be one of two photographs or more, is not; keep it")
        self.frames = left
        self._queue = self._queue[:0]
        self._sample()

    def reschedule(self, max_steps: int) -> None:
        """Let the fit end at another step; schedules go by the share of the steps that is done, so that they go on.

        Args:
            max_steps: Steps of the whole fit, more than have been done.
        Raises:
            ValueError: If they have been done already, or where things move, whose rates count steps.
        """
        if self.motion is not None:
            raise ValueError("fit: steps must stay as they are where things move; fit again with others")
        if max_steps <= self.step_index:
            raise ValueError(f"fit: steps must be more than the {self.step_index} done, got {max_steps}; ask for more")
        self.config = self.config.replace(max_steps=max_steps)
        self.renderers = RendererSchedule.of(self.config.renderers, self.config.settings, max_steps)
        self.resolution = Resolution(self.config.data.num_downscales, max_steps)

    def step(self) -> StepResult:
        """One view, one optimizer step, and what is due at it.

        Raises:
            ValueError: After 10 steps in a row without a finite loss and gradient.
        """
        config, rows, done = self.config, self.rows, self.step_index
        events = self._begin_motion() if self.motion is not None and self.motion.is_due(done) else []
        if self.motion is not None and self.motion.is_to_look(done, self.frames):
            events += self._look_for_births()
        events += self.resolution.events(done, self.frames)
        events += self._prepare(done)
        if self.transients.is_due(done, config.max_steps, len(self.frames)):
            events.append(self.transients.look(self.photographs(), self.gaussians(), config.settings))
        index = self._next_view()
        frame = self.frames[index]
        gaussians = self._fitted_scene().at(frame.camera.time)
        if self.parts.poses is not None:
            frame = self._posed(frame)
        frame = self.resolution.seen(index, frame, done)
        out = self._shown(gaussians, frame)
        if self.parts.exposure is not None:
            out = self.parts.exposure(out, frame)
        loss, terms = self._loss(out, frame, gaussians)
        optimizers = [rows.optimizer, *(network.optimizer for network in self.parts.networks)]
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if self.motion is not None:
            self.motion.hold(self.rows)
        with torch.no_grad():  # told, not optimized
            mse = self._mse(frame, out.rgb)
        if (bad := self._not_finite(loss)) is None:
            self._bad_in_a_row = 0
            self._bad = None
            for optimizer in optimizers:
                optimizer.step()
            for network in self.parts.networks:
                network.hold()
            stage = self._stage()
            density = config.density
            if density.noise and done - stage.begin < density.refine_stop * stage.length:
                explore(rows, means_rate(config, self._part()), self.extent, density.noise, self._generator)
        else:
            self.bad_steps += 1
            self._bad_in_a_row += 1
            self._bad = self._bad or bad
            events.append({"event": "skipped", "view": frame.name, "reason": f"{bad} not finite"})
            if self._bad_in_a_row == _MAX_BAD_STEPS:
                raise ValueError(
                    f"fit: loss and gradients must be finite, were not for {_MAX_BAD_STEPS} steps in a row until step "
                    f"{done} (view {frame.name}), first the {self._bad}; check the cameras, or lower the learning rates"
                )
        self.step_index += 1
        psnr = psnr_of(mse) if math.isfinite(mse) else None
        return StepResult(float(loss.detach()), terms, psnr, frame.name, events)  # told, not optimized

    def photographs(self) -> list[Frame]:
        """The training photographs, whose cameras are put where they are now."""
        if self.parts.poses is not None:
            for frame in self.frames:
                frame.camera = self.parts.poses.camera(frame.name)
        return self.frames

    def network(self, name: str) -> torch.nn.Module | None:
        """What is fitted beside the Gaussians under a name, as it is now; None if there is nothing."""
        return next((network.module for network in self.parts.networks if network.name == name), None)

    @property
    def is_sound(self) -> bool:
        """Whether the last step had a finite loss and gradients."""
        return not self._bad_in_a_row

    def gaussians(self) -> Gaussians:
        """The Gaussians that the rows are shown as, without a graph: those of a scene that moves are at rest."""
        gaussians = self.rows.gaussians()
        if self.parts.filter_3d is not None:
            gaussians = self.parts.filter_3d(gaussians)
        return gaussians.detach()

    def scene(self) -> Scene:
        """What a step renders, to be looked at: `gaussians`, or the scene that the parts make of the rows."""
        scene = self.parts.scene(self.rows)
        return scene.detach() if isinstance(scene, Gaussians) else scene  # looked at, not optimized

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and header of a checkpoint."""
        tensors = {**self.rows.state(), "rng": self._generator.get_state(), "queue": self._queue}
        for network in self.parts.networks:
            tensors |= network.state()
        if self.parts.filter_3d is not None:
            tensors[VARIANCES] = self.parts.filter_3d.variances
        masks, found = self.transients.state(self.frames)
        tensors |= masks
        header = {
            "step": self.step_index,
            "bad_steps": self.bad_steps,
            "start_count": self._start_count,
            "extent": self.extent,
            "views": [frame.name for frame in self.frames],
            "config": self.config.to_json(),
            **({"networks": sorted(network.name for network in self.parts.networks)} if self.parts.networks else {}),
            **({"skybox": self.rows.skybox} if self.rows.skybox else {}),
            **(self.motion.header() if self.motion is not None else {}),
            **found,
        }
        return tensors, header

    @classmethod
    def from_state(
        cls,
        config: FitConfig,
        frames: list[Frame],
        tensors: dict[str, torch.Tensor],
        header: dict,
        where: str,
        parts: Parts | None = None,
        motion: Motion | None = None,
    ) -> Trainer:
        """Continue from a checkpoint.

        Args:
            config, frames: The same as before, but for `saving`.
            tensors, header: Contents of the checkpoint.
            where: It, for messages.
            parts: Parts of the first step; networks are overwritten by those of the checkpoint.
            motion: Motion of the first step.
        Raises:
            ValueError: If the checkpoint belongs to another config, other views or other networks.
        """
        # What an older drgs did not know, it did as the defaults say.
        before = FitConfig.from_json(header["config"])
        if config.renderers == AUTO and config.settings == before.settings:
            config = config.replace(renderers=before.renderers)  # `auto` goes on with what the fit began with
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
        rows = GaussianRows.from_state(tensors)
        extent = header["extent"]
        parts = parts_of(config, extent) if parts is None else parts
        rows.skybox = header.get("skybox", 0)
        if motion is not None and motion.has_begun(rows):
            parts = motion.restored(rows, parts, header, where)
        trainer = cls(config, frames, rows, extent, parts, motion)
        was = sorted(header.get("networks", []))
        now = sorted(network.name for network in trainer.parts.networks)
        if was != now:
            raise ValueError(
                f"{where}: --resume must continue the same fit, networks were {was} and are {now}; "
                "repeat the options or choose another run folder"
            )
        for network in trainer.parts.networks:
            network.restore(tensors, where)
        if parts.filter_3d is not None:
            parts.filter_3d.variances = tensors[VARIANCES]
        trainer.transients.restore(frames, tensors, header, where)
        trainer.step_index = header["step"]
        trainer.bad_steps = header["bad_steps"]
        trainer._start_count = header["start_count"]
        trainer._generator.set_state(tensors["rng"])
        trainer._queue = tensors["queue"]
        return trainer

    def _part(self) -> float:
        """The fraction of the fit that is done."""
        return self.step_index / self.config.max_steps

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
        stage = self._stage()
        every = max(1, round(density.refine_every * stage.length))
        start = density.refine_start * stage.length
        stop = density.refine_stop * stage.length
        if (done - stage.begin) % every == 0 and max(start, 1) <= done - stage.begin < stop:
            events.append(self._refine(done, start))
        rows.set_rates({name: rate_at(self.parts.rates[name], self._part()) for name in rows.tensors})
        for network in self.parts.networks:
            network.set_rate(self._part())
        return events

    def _refine(self, done: int, start: float) -> dict:
        """Density control at step `done`; `start`: when the first is due in a stage. What it did, for the log."""
        density = self.config.density
        rows = self.rows
        stage = self._stage()
        moved = relocate(rows, density.min_opacity, density.jitter, self._generator)
        # Growth by a constant factor that reaches the budget at grow_until, whatever the schedule's length.
        full = max(density.grow_until * stage.length - start, 1)
        part = min(1.0, (done - stage.begin - start + density.refine_every * stage.length) / full)
        budget = round(stage.budget * density.max_gaussians) - self.reserved
        wanted = round(self._start_count * (budget / self._start_count) ** part) if self._start_count < budget else 0
        missing = min(wanted, budget) - len(rows)
        added = add_gaussians(rows, missing, density.min_opacity, density.jitter, self._generator)
        self._sample()
        return {"event": "density", "moved": moved, "added": added, "gaussians": len(rows)}

    def _sample(self) -> None:
        """How finely the photographs sample the Gaussians, after one or the other has changed."""
        if self.parts.filter_3d is not None:
            cameras = [frame.camera for frame in self.photographs()]
            self.parts.filter_3d.sample(self.rows.tensors["means"], cameras, self.rows.skybox)

    def _stage(self) -> Stage:
        """The steps that density control runs over now."""
        return Stage(0, self.config.max_steps) if self.motion is None else self.motion.stage()

    def _begin_motion(self) -> list[dict]:
        """From the static to the dynamic stage: gates, a field, its rates and terms, and photographs of all times."""
        assert self.motion is not None
        self.parts = self.motion.begin(self.rows, self.parts, self.extent)
        self._check_parts()
        self._queue = self._queue[:0]
        self._start_count = len(self.rows)
        return [{"event": "stage", "name": "dynamic", "gaussians": len(self.rows)}]

    def _look_for_births(self) -> list[dict]:
        """Add Gaussians where photographs of a time show what the scene does not."""
        from drgs.fitting.births import find_births
        from drgs.fitting.lives import MOST_BORN

        assert self.motion is not None
        most = round(MOST_BORN * self.config.density.max_gaussians) - self.reserved
        if most <= 0:
            return []
        found = find_births(
            self.photographs(),
            self.scene(),
            self.config.settings,
            self.extent,
            most,
            self._generator,
            self.parts.exposure,
        )
        self.motion.give_birth(self.rows, found)
        return [
            {
                "event": "births",
                "found": len(found.points),
                "photographs": found.photographs,
                "of": len(self.frames),
                "gaussians": len(self.rows),
            }
        ]

    def _fitted_scene(self) -> Scene:
        """What a step renders and differentiates."""
        if self.motion is not None and self.motion.has_begun(self.rows):
            self.motion.prepare(self.rows, self.step_index)
        return self.parts.scene(self.rows)

    def _next_view(self) -> int:
        """Index of a photograph, each once an epoch; in a static stage, those of the first time alone."""
        if not len(self._queue):
            shown = range(len(self.frames)) if self.motion is None else self.motion.shown(self.frames)
            self._queue = torch.tensor(shown)[torch.randperm(len(shown), generator=self._generator)]
        view = int(self._queue[0])
        self._queue = self._queue[1:].clone()
        return view

    def _posed(self, frame: Frame) -> Frame:
        """A photograph with its camera as it is now; gradients reach the pose while poses are fitted."""
        poses = self.parts.poses
        assert poses is not None
        if is_due(self._part()):
            if not poses.has_begun:
                poses.begin(self.gaussians(), self.rows.skybox)
            return poses(frame)
        return dataclasses.replace(frame, camera=poses.camera(frame.name))

    def _shown(self, gaussians: Gaussians, frame: Frame) -> Output:
        """What the terms need to see of the Gaussians in a photograph's view."""
        parts = self.parts
        if gaussians.features is not None and parts.shows_features and not parts.shows_features(frame):
            gaussians = gaussians.replace(features=None)
        outputs = {name: None for term in parts.terms for name in term.outputs}  # each once, in their order
        return render(
            gaussians,
            frame.camera,
            self.renderers.settings_at(self.step_index),
            outputs=tuple(outputs),
            couple_features=parts.couple_features,
        )

    def _loss(self, out: Output, frame: Frame, gaussians: Gaussians) -> tuple[torch.Tensor, dict[str, float]]:
        """The sum of the terms that a view has, and each of them by name."""
        total = None
        told = {}
        for term in self.parts.terms:
            value = term(out, frame, gaussians)
            if value is not None:
                total = value if total is None else total + value
                told[term.name] = float(value.detach())  # to be looked at
        if total is None:
            raise ValueError(f"fit: a view must have a term of the loss, {frame.name} has none; add one")
        return total, told

    def _mse(self, frame: Frame, rgb: torch.Tensor) -> float:
        error = (rgb.clamp(0, 1) - frame.image()).square().mean(2)
        if frame.mask is None:
            return float(error.mean())
        return float((error * frame.mask).sum() / frame.mask.sum().clamp(min=1))

    def _not_finite(self, loss: torch.Tensor) -> str | None:
        """What of a parameter, the loss and every gradient is not finite, the first of them; None if all are.

        A sum is not finite where one of its numbers is not.
        """
        named = [*self.rows.tensors.items()]
        named += [(f"{n.name}.{key}", x) for n in self.parts.networks for key, x in n.module.named_parameters()]
        # Values that are looked at.
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
