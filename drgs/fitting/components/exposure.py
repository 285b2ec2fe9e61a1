"""Exposure and white balance of photographs in a fit: a gain a photograph and channel.

A camera that chooses its exposure, or its white balance, anew for each photograph multiplies what it sees by a number
a channel. What points say of these numbers is in `drgs.fitting.exposures`.

A photograph that is not fitted to has a gain that nobody knows. But a camera chose it by what is in view, and gains of
the others say how; so held-out views are measured with the gain that the camera would have chosen for what is rendered.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.cameras.sizes import reduced_size
from drgs.data.resampling import resize_area
from drgs.display.progress import Bar
from drgs.ellipsoids import Y_00, Scene, colors_only
from drgs.fitting import exposures
from drgs.fitting.components.base import Checkpoint, Component, Fit, RunViews, Setup
from drgs.fitting.exposures import BRIGHT, ExposureEstimate, estimate_exposure
from drgs.fitting.frames import Frame, frames_for
from drgs.fitting.losses import psnr
from drgs.fitting.networks import Network
from drgs.fitting.rows import GaussianRows
from drgs.integrator import Output, render
from drgs.sfm.guided import Matches
from drgs.sfm.points import shared_points

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from drgs.data import View
    from drgs.fitting.config import ExposureUse, FitConfig
    from drgs.settings import RenderSettings

_Points = tuple[np.ndarray, np.ndarray | None]  # (P, 3), and which of V photographs show which, (V, P) bool

NETWORK = "exposure"
"""Name of the gains in a checkpoint."""

# Photographs times points of the look that nobody has asked for: 1.5 s; a gain still has hundreds of points.
_FIRST_OBSERVATIONS = 250_000
_RATE = 1e-3  # learning rate of natural log gains: a factor of e in 1,000 steps; chosen
_METERED = 48  # photographs that are rendered to find how the camera exposes; bounds seconds
_METERED_PIXELS = 3_000  # of such a rendering, of which nothing but the mean is used; chosen
_BLACK = 1 / 255  # least mean brightness whose logarithm is taken
# Of a short fit that tries gains.
_TRIAL = {"max_steps": 100, "max_gaussians": 4_000, "updates_per_step": 1, "num_downscales": 0}
_TRIAL_PIXELS = 6_000  # of its photographs; two such fits take 6 to 12 s on one core
_TRIAL_SHARE = 0.1  # steps times pixels of both, at most, in those of a fit that tries gains on its own; chosen
_TRIAL_EVERY = 5  # photographs of which it holds one out


class Exposure(torch.nn.Module):
    """Log gains of photographs, which multiply what is rendered for each before it is compared.

    A background behind what a photograph shows by its mask or alpha channel is put there later, and no camera's. Nor
    does a photograph that is saturated say how bright a thing is, but for the least that it is: what is rendered
    brighter there is right. (A white ground would be gray in half of the photographs otherwise, and in new views.)

    Attributes:
        log_gains: (V, 3) float32 natural logarithms.
    """

    def __init__(
        self,
        names: list[str],
        log_gains: np.ndarray,
        learned: bool,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """
        Args:
            names: V names of photographs.
            log_gains: (V, 3) first log gains.
            learned: Whether they are fitted, too.
            background: Color behind everything.
        """
        super().__init__()
        self._background = background
        self._rows = {name: row for row, name in enumerate(names)}
        self._learned = learned
        start = torch.tensor(log_gains, dtype=torch.float32)
        self.log_gains = torch.nn.Parameter(start, requires_grad=learned)

    def forward(self, output: Output, frame: Frame) -> Output:
        """The output as its photograph shows it; gradients reach both."""
        shown = _exposed(output, frame, self.log_gains[self._rows[frame.name]], self._background)
        target = frame.image().to(shown.device)
        return dataclasses.replace(output, rgb=torch.where((target >= BRIGHT) & (shown > target), target, shown))

    def of(self, frame: Frame) -> torch.Tensor:
        """(3,) the log gain of a photograph, a value without a graph."""
        return self.log_gains[self._rows[frame.name]].detach()

    def meter(self, frames: list[Frame], scene: Scene, settings: RenderSettings) -> Meter | None:
        """The `Meter` of photographs that have a gain, of which as many are rendered as `_METERED` says; None where it
        would not predict the gains of others.
        """
        frames = frames[:: -(-len(frames) // _METERED)]
        seen = []
        for frame in frames:
            camera = frame.camera.resized(*reduced_size(frame.camera, _METERED_PIXELS))
            with torch.no_grad():  # a measure
                output = render(colors_only(scene, camera.time), camera, settings, outputs=())
            seen.append(_brightness(output, frame, self._background))
        rows = [self._rows[frame.name] for frame in frames]
        return Meter.fitted(np.array(seen), self.log_gains.detach().double().cpu().numpy()[rows], self._background)

    def join(self, names: list[str], estimate: ExposureEstimate) -> torch.Tensor:
        """Go on with photographs that have been joined by others, each with a gain of its own.

        Gains that are not learned are those of the new estimate, which is of more photographs. Learned ones stay, and
        new ones stand to them as the estimate says: their log gain is the estimate's, plus what was learned beyond it,
        on average over the photographs of the same set; 0 where there is none. Then all have zero mean again.

        Args:
            names: V names, those that were there first.
            estimate: What points say of all of them.
        Returns:
            (3,) float32, by how much the log gains of those that were there have grown, on average: the scene's colors
            are to be divided by this, so that these look as before.
        """
        before = self.log_gains.detach()  # values, which go on in a parameter with more rows
        estimated = torch.tensor(estimate.log_gains, dtype=torch.float32)
        labels = torch.from_numpy(estimate.labels)
        old = len(before)
        after = estimated.clone()
        if self._learned:
            beyond = before - estimated[:old]
            after[:old] = before
            for row in range(old, len(estimated)):
                mine = labels[:old] == labels[row]
                after[row] = estimated[row] + beyond[mine].mean(dim=0) if mine.any() else 0.0
            after -= after.mean(dim=0)
        self._rows = {name: row for row, name in enumerate(names)}
        self.log_gains = torch.nn.Parameter(after, requires_grad=self._learned)
        return (after[:old] - before).mean(dim=0)

    def center(self) -> None:
        """Give the log gains zero mean over the photographs: gain 1, which viewers show, is the mean exposure."""
        with torch.no_grad():  # a gauge, no step
            self.log_gains.sub_(self.log_gains.mean(dim=0))


@dataclasses.dataclass(frozen=True)
class Meter:
    """How a camera exposes what it sees: log gain = (1, log R, log G, log B) @ coefficients of the mean color.

    Attributes:
        coefficients: (4, 3) for R, G and B.
        least, most: (3,) log gains of the photographs that these are fitted to; no predicted one is beyond.
        background: Color behind everything, which has no gain.
        lowered: Share of the squared log gains that it predicts, each of a photograph that it is fitted without.
    """

    coefficients: np.ndarray
    least: np.ndarray
    most: np.ndarray
    background: tuple[float, float, float]
    lowered: float

    @classmethod
    def fitted(
        cls, brightness: np.ndarray, log_gains: np.ndarray, background: tuple[float, float, float]
    ) -> Meter | None:
        """Least squares over V photographs; None where that does not predict the gains of each by the others.

        Args:
            brightness: (V, 3) logarithms of the mean R, G and B of renderings with gain 1.
            log_gains: (V, 3) their log gains.
            background: Color behind everything.
        """
        terms = np.column_stack([np.ones(len(brightness)), brightness])
        if len(terms) < 2 * terms.shape[1] or not log_gains.any():
            return None
        inverse = np.linalg.pinv(terms)
        coefficients = inverse @ log_gains
        # What is left of a photograph that was left out, without fitting anew: 1 - h, h on the diagonal of the hat.
        left = np.maximum(1 - np.sum(terms * inverse.T, axis=1), 1e-12)[:, None]
        lowered = 1 - float(np.square((log_gains - terms @ coefficients) / left).sum() / np.square(log_gains).sum())
        if lowered < exposures.LEAST_LOWERED:
            return None
        return cls(coefficients, log_gains.min(axis=0), log_gains.max(axis=0), background, lowered)

    def __call__(self, output: Output, frame: Frame) -> Output:
        """The rendering of a photograph's view as the camera would have exposed it."""
        seen = np.append(1.0, _brightness(output, frame, self.background))
        log_gain = torch.from_numpy((seen @ self.coefficients).clip(self.least, self.most)).to(output.rgb)
        return dataclasses.replace(output, rgb=_exposed(output, frame, log_gain, self.background))


def exposure_network(
    frames: list[Frame],
    learned: bool,
    log_gains: np.ndarray | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Network:
    """The gains of photographs as a part of a fit.

    Args:
        frames: V training photographs.
        learned: Whether they are fitted, too.
        log_gains: (V, 3) first log gains; 0 where a checkpoint brings them.
        background: Color behind everything.
    """
    start = np.zeros((len(frames), 3)) if log_gains is None else log_gains
    module = Exposure([frame.name for frame in frames], start, learned, background)
    return Network(NETWORK, module, _RATE if learned else 0.0, constraint=module.center if learned else None)


def _exposed(
    output: Output, frame: Frame, log_gain: torch.Tensor, background: tuple[float, float, float]
) -> torch.Tensor:
    """(H, W, 3) colors of a rendering with a (3,) log gain, but for a background behind what the photograph shows."""
    rgb = output.rgb
    gain = log_gain.exp().to(rgb.device)
    shown = rgb * gain
    if frame.empty() is not None:
        behind = (1 - output.alpha)[..., None] * torch.tensor(background, device=rgb.device)
        shown = shown + behind * (1 - gain)
    return shown


def _brightness(output: Output, frame: Frame, background: tuple[float, float, float]) -> np.ndarray:
    """(3,) logarithms of the mean R, G and B of what Gaussians cover in a rendering, inside the photograph's mask."""
    alpha, behind = output.alpha[..., None], torch.tensor(background, device=output.rgb.device)
    weight = torch.ones_like(alpha)
    if frame.mask is not None:  # at the size of the photograph
        size = alpha.shape[1], alpha.shape[0]
        weight = torch.from_numpy(resize_area(frame.mask.numpy(), *size))[..., None].to(alpha)
    colors = output.rgb.clamp(0, 1) - (1 - alpha) * behind
    mean = (weight * colors).sum(dim=(0, 1)) / (weight * alpha).sum().clamp(min=1e-12)
    return mean.clamp(min=_BLACK).log().double().cpu().numpy()


class ExposureComponent(Component):
    """Gains of the photographs of a fit: `exposure` points, learned, or auto, where they are of use.

    Attributes:
        module: The gains; None where all photographs have the same.
        evidence: The last estimate of them, as config.json has it; None where there was none.
    """

    name = "exposure"
    option = ("exposure", "off")
    where = "where each photograph has an exposure of its own"
    header_kinds = {"exposure": dict}

    def __init__(self) -> None:
        self.module: Exposure | None = None
        self.evidence: dict[str, Any] | None = None

    @classmethod
    def held(
        cls, names: list[str], networks: Mapping[str, Mapping[str, torch.Tensor]], settings: RenderSettings
    ) -> ExposureComponent | None:
        """See `Component`."""
        if NETWORK not in networks:
            return None
        gains, wanted = networks[NETWORK].get("log_gains"), (len(names), 3)
        if gains is None or tuple(gains.shape) != wanted:
            got = "none" if gains is None else tuple(gains.shape)
            raise ValueError(
                f"state.safetensors: {NETWORK}.parameter.log_gains must have shape {wanted}, got {got}; the run is "
                "damaged, restore it or fit again"
            )
        component = cls()
        component.module = Exposure(names, gains.numpy(), False, settings.background)
        return component

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        use = setup.config.data.exposure
        return None if use == "off" else use

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`: gains from the points that photographs share, if the option or their use says so."""
        compared = _compared(setup)
        use = _use_of(setup, compared)
        setup.config = fit.config = fit.config.replace(exposure=use)
        if use == "off":
            return
        with Bar("exposure") as bar:
            estimate, is_on = _decided(fit, setup, compared)
            now = " for now" if setup.is_active and use == "auto" else ""
            bar.note(f"exposure: {estimate.words()}; {_effect(is_on)}{now}")
        self.evidence = estimate.to_json([frame.name for frame in fit.frames])
        if is_on:
            self.use(fit.config, fit.frames, estimate)

    def use(self, config: FitConfig, frames: list[Frame], estimate: ExposureEstimate | None = None) -> None:
        """From now on photographs have gains: those of the estimate, or 1 where a checkpoint brings them."""
        gains = None if estimate is None else estimate.log_gains
        network = exposure_network(frames, config.data.exposure == "learned", gains, config.settings.background)
        self.networks = [network]
        self.module = network.module  # type: ignore[assignment]  # an `Exposure`
        self.nuisance = "exposure"

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        if NETWORK in checkpoint.header.get("networks", ()):
            self.use(fit.config, fit.frames)
        active = checkpoint.header.get("active") or {}
        self.evidence = checkpoint.header.get("exposure", active.get("exposure"))  # version 0.2.0 wrote it there

    def as_photograph(self, out: Output, frame: Frame) -> Output:
        """See `Component`."""
        return out if self.module is None else self.module(out, frame)

    def as_shown(self, image: torch.Tensor, frame: Frame) -> torch.Tensor:
        """See `Component`; a background that was put behind a photograph later has no gain."""
        if self.module is None:
            return image
        corrected = (image / self.module.of(frame).cpu().exp()).clamp(0, 1)
        empty = frame.empty()
        return corrected if empty is None else torch.lerp(corrected, image, empty[..., None])

    def meter(self, fit: Fit) -> Meter | None:
        """The `Meter` of the fit's photographs; None where they have no gains, or these do not predict each other."""
        if self.module is None:
            return None
        return self.module.meter(fit.photographs(), fit.scene(), fit.config.settings)

    def evaluation(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        return {"as_photograph": self.meter(fit)}

    @classmethod
    def run_evaluation(cls, run: RunViews) -> dict[str, Any]:
        """See `Component`."""
        held = cls.held(run.names, run.networks, run.settings)
        if held is None or held.module is None:
            return {}
        return {"as_photograph": held.module.meter(run.photographs(), run.scene, run.settings)}

    def join(self, fit: Fit, frame: Frame, setup: Setup) -> list[dict]:
        """See `Component`: gains are estimated again, with the points of the new photograph."""
        if self.evidence is None or setup.picked_points is None:
            return []
        frames = [*fit.photographs(), frame]
        with Bar("exposure") as bar:
            points, shown = setup.picked_points(setup.dataset.points)
            estimate = estimate_exposure(frames, points, fit.config.seed, shown)
            # A few points of the first photographs may have said something else than all of them do.
            is_on = fit.config.data.exposure != "auto" or estimate.is_clear
            if is_on != (self.module is not None):
                bar.note(f"exposure: {estimate.words()}; {_effect(is_on)} from step {fit.step_index} on")
        self.evidence = estimate.to_json([frame.name for frame in frames])
        if is_on:
            self.extend(fit, frame, estimate)
        else:  # gains were 1 on average, so that colors stay
            self.module, self.networks, self.nuisance = None, (), None
        return [{"event": "exposure", **{key: x for key, x in self.evidence.items() if key != "gains"}, "used": is_on}]

    def extend(self, fit: Fit, frame: Frame, estimate: ExposureEstimate) -> None:
        """One photograph more; the scene's colors change by what the gauge of the gains does, so that the others look
        as before.

        Args:
            fit: The fit, without the photograph.
            frame: The photograph.
            estimate: What points say of the gains of all photographs, of this one last.
        """
        if self.module is None:
            self.use(fit.config, fit.frames)
        assert self.module is not None
        names = [one.name for one in (*fit.frames, frame)]
        grown = self.networks[0].extend(functools.partial(self.module.join, names, estimate))
        fit.rows.scale_colors((-grown).exp())

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        return {}, {} if self.evidence is None else {"exposure": self.evidence}

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        # Checkpoints of version 0.2.0 say nothing of fits to all views.
        known = before.get("exposure") if self.evidence is None else self.evidence
        return {} if known is None else {"exposure": known}


def _compared(setup: Setup) -> _Points | None:
    """By what the exposure of photographs is compared.

    Returns:
        None where nothing says what hides points, and where nobody asks for exposure and to look would take matching;
        None for who shows them where every photograph may.
    """
    is_asked_for = setup.config.data.exposure not in (None, "off")
    if setup.picked_points is not None:
        return setup.picked_points(setup.dataset.points) if is_asked_for else None
    if setup.times:  # photographs of other times do not show the same
        return None
    matches = Matches() if setup.matches is None and is_asked_for else setup.matches
    with Bar("points that photographs share") as bar:
        return shared_points(setup.dataset, setup.views, setup.config.seed, matches, bar.stage)


def _use_of(setup: Setup, compared: _Points | None) -> ExposureUse:
    """`exposure` of a fit. Where it is not stated: auto if photographs differ at a first look, which costs little, and
    a trial is short beside the fit, else off. A fit that is to have no gains says that photographs differ.
    """
    stated = setup.config.data.exposure
    if stated not in (None, "off"):
        return stated
    if compared is None:
        return "off"
    with Bar("exposure") as bar:
        first = estimate_exposure(setup.frames, compared[0], setup.config.seed, compared[1], _FIRST_OBSERVATIONS)
        if first.is_sound and stated is None and _is_trial_short(setup):
            return "auto"
        if first.is_sound:
            bar.note(first.warning())
    return "off"


def _decided(fit: Fit, setup: Setup, compared: _Points | None) -> tuple[ExposureEstimate, bool]:
    """The gains of a fit's photographs, and whether it uses them: unless it is to decide by itself, always."""
    assert setup.points is not None  # initial ones are there
    points, shown = compared or (setup.points, None)
    estimate = estimate_exposure(fit.frames, points, fit.config.seed, shown)
    if fit.config.data.exposure != "auto":
        return estimate, True
    # A trial takes photographs that are there and stand still, and points of which it is known who shows them.
    if compared is None or setup.is_active:
        return estimate, estimate.is_clear
    if not estimate.is_sound:
        return estimate, False
    estimate = estimate.confirmed()
    gained = _trial(fit, setup.views, estimate)
    return dataclasses.replace(estimate, gained=gained), gained > 0


def _effect(is_on: bool) -> str:
    return "each has its own" if is_on else "off, all have the same"


def _is_trial_short(setup: Setup) -> bool:
    """Whether a plain fit is long enough for a trial that nobody has asked for."""
    config = setup.config
    pixels = min(frame.camera.width * frame.camera.height for frame in setup.frames)
    trial = 2 * _TRIAL["max_steps"] * min(_TRIAL_PIXELS, pixels)
    return not setup.modes and trial <= _TRIAL_SHARE * config.max_steps * pixels


def _trial(fit: Fit, views: list[View], estimate: ExposureEstimate) -> float:
    """By how many dB gains change photographs that two short fits, with them and without, did not see: the
    mean of what they change at the gain of a meter, as held-out views are shown, and at that which suits each best.
    Points say nothing of a white wall, which has none.

    Args:
        fit: The fit, with the Gaussians that it begins with.
        views: V views.
        estimate: What points say of the gains of the V photographs.
    """
    config = fit.config
    frames = frames_for(views, config.data, min(_TRIAL_PIXELS, config.data.max_pixels))
    held_out = [frame for frame in frames[_TRIAL_EVERY // 2 :: _TRIAL_EVERY] if frame.is_measurable]
    rest = [row for row in range(len(frames)) if row % _TRIAL_EVERY != _TRIAL_EVERY // 2]
    if not held_out:
        return 0.0
    short = config.replace(**_TRIAL, max_pixels=_TRIAL_PIXELS)
    gains = estimate.log_gains[rest] - estimate.log_gains[rest].mean(axis=0)
    quality = []
    with Bar("whether exposure is of use", 2 * short.max_steps) as bar:
        for used in (None, dataclasses.replace(estimate, log_gains=gains)):
            component = ExposureComponent()
            if used is not None:
                component.use(short, [frames[row] for row in rest], used)
            trial = fit.trial(short, [frames[row] for row in rest], _first_rows(fit, short), component)
            for _ in range(short.max_steps):
                trial.step()
                bar.advance()
            meter = component.meter(trial)
            quality.append(np.mean([_psnr(trial, frame, way) for frame in held_out for way in (meter, _suited)]))
    return float(quality[1] - quality[0])


def _first_rows(fit: Fit, config: FitConfig) -> GaussianRows:
    """Some of the Gaussians that a fit begins with, by their places and colors, for a fit of this configuration."""
    rows = fit.rows
    begin = rows.gaussians().detach()  # where it begins
    kept = torch.randperm(len(begin) - rows.far, generator=torch.Generator().manual_seed(config.seed))
    kept = kept[: config.density.max_gaussians] + rows.far
    colors = (0.5 + Y_00 * begin.sh[kept, 0]).clamp(0, 1)
    return GaussianRows.from_points(rows.places()[kept], colors, *config.density.start_of(False), rows.origin)


def _psnr(fit: Fit, frame: Frame, as_photograph: Callable[[Output, Frame], Output] | None) -> float:
    """Of a photograph that the fit has not seen, in dB, with the gain that a meter or `_suited` gives it."""
    with torch.no_grad():  # a measure
        out = render(fit.scene(), frame.camera, fit.config.settings, outputs=())
        out = out if as_photograph is None else as_photograph(out, frame)
    return psnr(out.rgb.cpu().clamp(0, 1), frame.image(), frame.mask)


def _suited(output: Output, frame: Frame) -> Output:
    """A rendering with the gains of R, G and B that suit its photograph best."""
    rgb, target = output.rgb.clamp(0, 1), frame.image().to(output.rgb.device)
    weight = 1.0 if frame.mask is None else frame.mask[..., None].to(target)
    gain = (weight * rgb * target).sum(dim=(0, 1)) / (weight * rgb * rgb).sum(dim=(0, 1)).clamp(min=1e-12)
    return dataclasses.replace(output, rgb=gain * rgb)
