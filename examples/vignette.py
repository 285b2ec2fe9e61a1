"""A component of fits: each photograph may be darker towards its corners (docs/extending.md)."""

import dataclasses

import torch

from drgs.fitting.components.base import Component, Conflict
from drgs.fitting.networks import Network


class Strengths(torch.nn.Module):
    """By how much the corners of each photograph are darker, in [0, 1] where it is one."""

    def __init__(self, names):
        super().__init__()
        self.names = list(names)
        self.strengths = torch.nn.Parameter(torch.zeros(len(names)))

    def add(self, name):
        """One more photograph."""
        self.names.append(name)
        self.strengths = torch.nn.Parameter(torch.cat([self.strengths.detach(), torch.zeros(1)]))


class Vignette(Component):
    """A photograph is its rendering times 1 - s r^2, where r is 0 in the middle and 1 in the corners."""

    name = "vignette"
    option = ("vignette", "off")
    where = "where photographs have a vignette"
    conflicts = (Conflict("exposure", "both say how bright a photograph is", "use --exposure off"),)
    module = None

    def setting(self, setup):
        """Of a fit that asks for it."""
        return "on"

    def start(self, fit, setup):
        """A strength for each photograph, 0 at first."""
        self.module = Strengths([frame.name for frame in fit.frames])
        self.networks = [Network("vignette", self.module, 1e-2)]  # with a learning rate

    def resume(self, fit, checkpoint):
        """As at the start: what the checkpoint holds of networks is restored afterwards."""
        self.start(fit, None)

    def as_photograph(self, out, frame):
        """The rendering as the photograph would show it."""
        if self.module is None:
            return out
        height, width, _ = out.rgb.shape
        y, x = (torch.linspace(-1, 1, side) ** 2 / 2 for side in (height, width))
        strength = self.module.strengths[self.module.names.index(frame.name)]
        return dataclasses.replace(out, rgb=out.rgb * (1 - strength * (y[:, None] + x))[..., None])

    def join(self, fit, frame, setup):
        """A photograph more, in an active fit."""
        self.networks[0].extend(lambda: self.module.add(frame.name))
        return []

    def record(self, fit, before):
        """For config.json."""
        return {"vignette": {"photographs": len(self.module.names)}}

    def metrics(self, fit, held_out):
        """For metrics.json."""
        return {"vignette": {"mean": float(self.module.strengths.detach().mean())}}

    @classmethod
    def report(cls, config, metrics):
        """A line of the report."""
        found = metrics.get("vignette")
        return [("Vignette", f"corners of photographs are darker by {found['mean']:.1%}")] if found else []
