"""Fewer Gaussians for nearly the same images: those without which given views change least are removed, in rounds.

A round takes how much the images change without each one of the Gaussians (`drgs.fisher.removal_error`), exactly, and
removes those of the least. What one says holds while all others are there: where two stand for each other, each alone
can go. So a round removes a part, and the next one looks at what is left.

What changes no given view has error 0, and is another matter than what changes them little: it may be what other views
show. It is kept, unless the caller says otherwise.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Generic, Literal, TypeVar

import numpy as np
import torch

from drgs.cameras import Camera, some_cameras
from drgs.data import scene_extent
from drgs.deform import DynamicGaussians
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians, Scene, check_gaussians, colors_only
from drgs.fisher import removal_error
from drgs.fitting.components.base import Component
from drgs.fitting.config import ROUNDS, FitConfig, RateConfig, check_amount
from drgs.fitting.frames import Frame
from drgs.fitting.losses import psnr
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.information.inputs import Masks, mask_list
from drgs.information.region import Region
from drgs.information.semantics import SemanticMetric
from drgs.integrator import Output, render
from drgs.runtime.threads import fewer_torch_threads
from drgs.settings import RenderSettings

Unseen = Literal["keep", "remove"]

_S = TypeVar("_S", Gaussians, DynamicGaussians)

POWER = 1.5
"""Power of `drgs.fisher.removal_error` that `prune` ranks by: of three that were tried near the best on every scene."""

_log = logging.getLogger(__name__)
_BISECTIONS = 8  # renderings of all views for a `loss`: as many are removed as it allows, but for 1/256 of them

_BEGUN = 0.5  # part of the schedule that `fit_on` takes as done: 0 to 0.9 end within 0.1 dB on `banana`


@dataclasses.dataclass(frozen=True)
class Round:
    """A round of `prune`.

    Attributes:
        removed: How many Gaussians it removed.
        error: Sum of their errors (`drgs.fisher.removal_error` of the power that was asked for), each as if it alone
            were removed.
        psnr: Mean PSNR of the views behind it, in dB; None where no images were given.
    """

    removed: int
    error: float
    psnr: float | None = None


@dataclasses.dataclass(frozen=True)
class Pruned(Generic[_S]):
    """Result of `prune`.

    Attributes:
        gaussians: Those that are left, in their order; of a scene that moves, with what moves them.
        kept: (N,) bool, which of the given ones these are.
        unseen: How many of the given ones change no given view.
        rounds: What each round removed.
        psnr: Mean PSNR of the views before, in dB; None where no images were given.
    """

    gaussians: _S = dataclasses.field(repr=False)
    kept: torch.Tensor = dataclasses.field(repr=False)
    unseen: int
    rounds: tuple[Round, ...]
    psnr: float | None = None


def prune(
    gaussians: _S,
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    *,
    keep: float | None = None,
    loss: float | None = None,
    images: Sequence[torch.Tensor] | None = None,
    masks: Masks = None,
    as_photographs: Sequence[Callable[[Output], Output]] | None = None,
    rounds: int = ROUNDS,
    unseen: Unseen = "keep",
    semantics: SemanticMetric | None = None,
    power: float = POWER,
    region: Region | None = None,
) -> Pruned[_S]:
    """Remove the Gaussians that given views need least.

        smaller = drgs.prune(g, cameras, keep=0.5).gaussians

    Args:
        gaussians: N Gaussians, world frame, or a `DynamicGaussians`, whose Gaussians each camera sees at its time;
            they are not changed.
        cameras: The views, which should show all that matters.
        settings: Default `RenderSettings.preset("fast")`: what it removes costs no more in other renderers than what
            `exact` does, which takes six to seven times as long (docs/prune.md).
        keep: Share of the Gaussians that is left, in (0, 1), of those that change a view. Either this or `loss`.
        loss: By how much the mean PSNR of the views may fall, in dB, > 0; needs `images`. As many are removed as that
            allows, to within some percent of it.
        images: (H, W, 3) in [0, 1], a photograph of each camera.
        masks: One for each camera: (H, W) in [0, 1] what counts of its image; or None: all.
        as_photographs: What each camera's rendering goes through before it is compared with its image, as by a gain of
            that image's exposure; None: nothing.
        rounds: In how many rounds; more are better, each takes a traversal of every view.
        unseen: What becomes of Gaussians that change no view: `keep` or `remove`.
        semantics: The metric in which features are a part of the image; None: colors are all of it.
        power: That of `drgs.fisher.removal_error`.
        region: The part of the scene whose pixels count, each by how much of it shows the region; also in PSNRs. What
            no such pixel shows goes first, that without which other pixels change least before the rest of it. None:
            all pixels of all views.
    Raises:
        ValueError: If a number is out of range, or the views show nothing of the scene, or of the region.
    """
    where = "prune"
    check_gaussians(where, gaussians.gaussians if isinstance(gaussians, DynamicGaussians) else gaussians)
    cameras = some_cameras(where, cameras)
    check_amount(where, keep, loss, rounds)
    if unseen not in ("keep", "remove"):
        raise ValueError(f"{where}: unseen must be 'keep' or 'remove', got {unseen!r}; choose one")
    if loss is not None and images is None:
        raise ValueError(
            f"{where}: loss must have images that the views are compared with, got none; pass keep instead"
        )
    settings = settings or RenderSettings.preset("fast")
    shares = None if region is None else region.shares(gaussians, cameras, settings, where)
    if shares is not None and shares.note:
        _log.warning("prune: %s", shares.note)
    with Bar("errors without a Gaussian", (rounds + (region is not None)) * len(cameras)) as bar:
        shown = None if shares is None else shares.shares
        as_photographs = as_photographs or [lambda out: out] * len(cameras)
        listed = mask_list(where, masks, cameras)
        views = _Views(cameras, settings, listed, images, as_photographs, semantics, power, bar, shown)
        return _pruned(gaussians, views, keep, loss, rounds, unseen)


def _pruned(
    gaussians: _S, views: _Views, keep: float | None, loss: float | None, rounds: int, unseen: Unseen
) -> Pruned[_S]:
    """`prune`, of arguments that have been checked."""
    start = views.psnr(gaussians)
    left = torch.arange(len(gaussians))
    # What no pixel of a region shows has error 0, but other pixels may show it: it is no Gaussian that no view shows.
    elsewhere = torch.zeros(len(gaussians)) if views.shares is None else views.everywhere.removal_error(gaussians)
    ever_seen = elsewhere > 0
    seen = 0  # in the first round; a share of these is kept
    done = []
    for number in range(rounds):
        error = views.removal_error(gaussians.take(left))
        ever_seen[left] |= error > 0
        seen = seen or int(ever_seen.sum())
        if not seen:
            raise ValueError(
                f"prune: the views must show something of the scene, the {len(views.cameras)} given ones show nothing; "
                "check that they are of this scene, and in its frame"
            )
        # Least first; what changes nothing is no candidate.
        order = error.argsort()[int((error == 0).sum()) :]
        if views.shares is not None:
            outside = ((error == 0) & ever_seen[left]).nonzero()[:, 0]
            order = torch.cat([outside[elsewhere[left[outside]].argsort()], order])
        part = (number + 1) / rounds
        if keep is not None:
            # Every round keeps the same share of what there is; something is left of the last one.
            goal = len(gaussians) - seen + max(1, round(seen * keep**part))
            count = max(0, len(left) - goal)
        elif loss is not None and start is not None:
            count = views.most_removed(gaussians, left, order, start - loss * part)
        error_of_these = float(error[order[:count]].sum())
        left = _without(left, order[:count])
        done.append(Round(count, error_of_these, views.psnr(gaussians.take(left))))
    if unseen == "remove":
        left = left[ever_seen[left]]
    kept = torch.zeros(len(gaussians), dtype=torch.bool)
    kept[left] = True
    return Pruned(gaussians.take(left), kept, int((~ever_seen).sum()), tuple(done), start)


@dataclasses.dataclass(frozen=True)
class _Views:
    """What Gaussians are pruned by."""

    cameras: list[Camera]
    settings: RenderSettings
    masks: list[torch.Tensor | None]
    images: Sequence[torch.Tensor] | None
    as_photographs: Sequence[Callable[[Output], Output]]
    semantics: SemanticMetric | None
    power: float
    bar: Bar
    shares: list[torch.Tensor] | None = None  # of each pixel, that shows a region

    @property
    def everywhere(self) -> _Views:
        """The same of all pixels."""
        return dataclasses.replace(self, shares=None)

    def removal_error(self, gaussians: Gaussians | DynamicGaussians) -> torch.Tensor:
        """(N,) summed over the views."""
        total = torch.zeros(len(gaussians), dtype=torch.float64)
        # A mask multiplies an image, so that the error of a pixel is multiplied by a power of it.
        for camera, mask in zip(self.cameras, self._masks(1 / self.power), strict=True):
            total += removal_error(gaussians, camera, self.settings, self.power, semantics=self.semantics, masks=[mask])
            self.bar.advance()
        return total

    def psnr(self, gaussians: Scene) -> float | None:
        """Mean PSNR of the views in dB; None without images."""
        if self.images is None:
            return None
        found = []
        views = zip(self.cameras, self.images, self._masks(1), self.as_photographs, strict=True)
        for camera, target, mask, as_photograph in views:
            if self.shares is not None and mask is not None and not bool((mask > 0).any()):
                continue
            with torch.no_grad():  # a measure
                seen = colors_only(gaussians, camera.time)
                out = as_photograph(render(seen, camera, self.settings, outputs=()))
            found.append(psnr(out.rgb.cpu().clamp(0, 1), target, mask))
        return float(np.mean(found))

    def _masks(self, power: float) -> list[torch.Tensor | None]:
        """The mask of each view, times this power of the shares of a region."""
        if self.shares is None:
            return self.masks
        masks = zip(self.masks, self.shares, strict=True)
        return [share**power if mask is None else mask.cpu() * share**power for mask, share in masks]

    def most_removed(self, gaussians: _S, left: torch.Tensor, order: torch.Tensor, least: float) -> int:
        """How many of `left` may go, in an order, so that the PSNR stays at `least` dB or above: by bisection."""
        low, high = 0, len(order)
        for _ in range(_BISECTIONS):
            count = (low + high) // 2
            reached = self.psnr(gaussians.take(_without(left, order[:count])))
            assert reached is not None  # there are images
            low, high = (count, high) if reached >= least else (low, count)
        return low


def _without(left: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Indices without those at some places, in their order."""
    is_left = torch.ones(len(left), dtype=torch.bool)
    is_left[places] = False
    return left[is_left]


def fit_on(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    config: FitConfig,
    steps: int,
    far: int = 0,
    components: Sequence[Component] = (),
) -> Gaussians:
    """Fit Gaussians to photographs for some steps more: colors, shapes and places, not how many there are.

    Args:
        gaussians: What a fit, or `prune`, has left; features stay as they are.
        frames: Photographs, at the size of the fit; their cameras stay as they are.
        config: Configuration of the fit: its loss, renderers and learning rates, which are those of its second half.
        steps: How many, at least 1.
        far: How many of the first Gaussians are those of a skybox.
        components: What else renderings go through before they are compared, as the fit has left it: exposures.
    """
    dc, rest = gaussians.sh.detach()[:, :1], gaussians.sh.detach()[:, 1:]
    parameters = {name: getattr(gaussians, name) for name in ("means", "quats", "log_scales", "logit_opacities")}
    rows = GaussianRows({**parameters, "sh_dc": dc, "sh_rest": rest}, gaussians.origin)
    rows.far = far
    done = round(steps * _BEGUN / (1 - _BEGUN))
    fixed = dataclasses.replace(config.density, refine_stop=0.0)  # as many rows as there are, and no noise
    config = config.replace(max_steps=done + steps, density=fixed, sh_degree=gaussians.sh_degree)
    extent = scene_extent([frame.camera for frame in frames])
    trainer = Trainer(config, list(frames), rows, extent, list(components))
    trainer.step_index = done
    with fewer_torch_threads(), Bar("fitting on", steps) as bar:
        for step in range(steps):
            # To 0, so that the end is no step of Adam away from what fits best.
            trainer.config = config.replace(rates=_faded(config.rates, 1 - step / steps))
            trainer.step()
            bar.advance()
    return trainer.gaussians().replace(features=gaussians.features)


def _faded(rates: RateConfig, factor: float) -> RateConfig:
    """All learning rates times a factor."""
    names = ("dc_rate", "rest_rate", "opacity_rate", "scale_rate", "rotation_rate")
    first, last = rates.means_rate
    faded = {name: factor * getattr(rates, name) for name in names}
    return dataclasses.replace(rates, means_rate=(factor * first, factor * last), **faded)
