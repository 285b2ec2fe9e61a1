"""Superfluous Gaussians, which are removed when density control ends: the last steps make up for what they showed.

A fit of few Gaussians is worse than one of many that is pruned to as few (docs/real-data.md). So density control has
its whole budget, and then those go without which photographs change least, as many as lower their PSNR by less than
`prune_loss`: `drgs.prune`, in one round. That is how much a scene requires; a fixed share takes too much of some.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from drgs.fitting.components.base import Checkpoint, Component, Fit, Setup
from drgs.fitting.frames import Frame
from drgs.fitting.pruning import prune
from drgs.fitting.stages import Stage

_PHOTOGRAPHS = 24  # training photographs, evenly spaced, that are looked at: each is rendered about ten times


class PruningComponent(Component):
    """Gaussians removed when density control ends: `prune_loss`, in dB of the mean PSNR of training photographs.

    Attributes:
        counts: Gaussians before and after; none until then, and where none are to be removed.
    """

    name = "pruning"
    option = ("prune_loss", "0")
    where = "where superfluous Gaussians are removed"
    header_kinds = {"pruned": [int]}

    def __init__(self) -> None:
        self.counts: list[int] = []

    def prepare(self, setup: Setup) -> None:
        """See `Component`.

        Raises:
            ValueError: If density control lasts as long as the fit.
        """
        density = setup.config.density
        if density.prune_loss and density.refine_stop == 1:
            raise ValueError(
                "fit: refine_stop must be below 1 for prune_loss, which removes Gaussians when density control ends, "
                "got 1; use --refine-stop 0.8, or leave --prune-loss out"
            )

    def stage(self, fit: Fit) -> Stage | None:
        """See `Component`: no step any more once Gaussians are removed, also where a fit is given more steps then."""
        return Stage(0, 0) if self.counts else None

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        self.counts = checkpoint.header.get("pruned", [])

    def before_density(self, fit: Fit) -> list[dict]:
        """See `Component`: the first step without density control, of the last stage that has it."""
        loss, stage = fit.config.density.prune_loss, fit.stage()
        end = stage.begin + fit.config.density.refine_stop * stage.length
        if not loss or self.counts or stage.end < fit.config.max_steps or fit.step_index < end:
            return []
        photographs = [frame for frame in fit.photographs() if frame.is_measurable]
        chosen = np.linspace(0, len(photographs) - 1, min(_PHOTOGRAPHS, len(photographs))).round().astype(int)
        frames = [photographs[i] for i in chosen]
        images, masks = [frame.image() for frame in frames], [frame.mask for frame in frames]
        scene: Any = fit.scene()  # Gaussians, or a DynamicGaussians
        found = prune(
            scene,
            [frame.camera for frame in frames],
            loss=loss,
            images=images,
            masks=masks,
            as_photographs=[functools.partial(fit.as_photograph, frame=frame) for frame in frames],
            rounds=1,
        )
        found.kept[: fit.rows.far] = True  # a skybox stays whole
        before = len(fit.rows)
        fit.rows.keep(found.kept.nonzero()[:, 0])
        for component in fit.components:
            component.changed(fit)
        self.counts = [before, len(fit.rows)]
        return [{"event": "pruned", "before": before, "gaussians": len(fit.rows)}]

    def describe(self, event: Mapping[str, Any]) -> str | None:
        """See `Component`."""
        if event["event"] != "pruned":
            return None
        return f"{event['before'] - event['gaussians']:,} of {event['before']:,} Gaussians are superfluous and removed"

    def state(self, fit: Fit) -> tuple[dict, dict]:
        """See `Component`."""
        return {}, {"pruned": self.counts} if self.counts else {}

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        return {"pruned": dict(zip(("before", "gaussians"), self.counts, strict=True))} if self.counts else {}

    @classmethod
    def report(cls, config: Mapping[str, Any], metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
        """See `Component`."""
        found = metrics.get("pruned")
        return [("Pruning", f"{found['gaussians']:,} of {found['before']:,} Gaussians are left")] if found else []
