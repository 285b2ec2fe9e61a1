"""How precisely parameters are known before any view; imports nothing heavy, as `drgs.information.scoring`.

Positions alone have a unit of length (rotations are radians; log-scales, logits and SH have none). One lambda for all
parameters would therefore mean another thing in a world of millimeters. So lambda is about positions in a length of the
scene, `unit_length`: information about the means, in inverse squared world units, gets lambda / length^2, and so do the
weights of a network that are lengths, as its means' are.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from drgs.checks.records import TRANSIENT, option

if TYPE_CHECKING:
    import torch

    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene

_POSITIONS = "means"  # the group whose parameters are lengths
_USUAL_EXTENT = 5.6  # world units: median of `scene_extent` over eight captures, as COLMAP and LLFF scale them
_ONE_PLACE = 1e-8  # of coordinates, and of 1: more than cameras differ by that `scene_extent` takes as of one place


@dataclasses.dataclass(frozen=True)
class Prior:
    """lambda: how precisely each parameter is known before any view, added to H once.

    `value` is about positions in units of `length`: the means get value / length^2. None is the length of the scene,
    `unit_length`, where there are cameras to tell it (`drgs.select`, maps), so that the unit of the world cancels;
    functions of H alone (`drgs.gain.information_gain`) take 1 world unit, as policy `fisherrf` does. `groups` are as
    they are, in the inverse squared unit of each parameter.

    A relative one makes `eig` and `logdet` independent of the unit of any group. A group that no view sees has no
    median: its lambda is 0.

    `lengths`: group of a network -> (P,) bool, which of its parameters are lengths; `in_scene` finds them.

    Raises:
        ValueError: If a lambda is negative, infinite or NaN, or the length is not above 0.
    """

    value: float = option(
        1e-6,
        "What is known of every parameter before any view (lambda, FisherRF's reg_lambda), added to the information of "
        "the training views: 1e-2 with v_opt, 1 in drgs fisher, else 1e-6. With 0, parameters that no training view "
        "sees are left out of every score.",
        flag="prior",
        shown="",
    )
    relative: bool = option(
        False,
        "lambda is its value (--prior) times the median of the nonzero information of a parameter's group.",
        rare=True,
        flag="relative_prior",
    )
    groups: Mapping[str, float] = option(
        {}, "Group -> lambda in place of `value`.", name="prior_groups", file_only=True
    )
    length: float | None = option(
        None,
        "World units in which positions count for lambda; default the extent of all cameras over 5.6, about 1 in "
        "the units of COLMAP.",
        name="prior_length",
        file_only=True,
    )
    lengths: Mapping[str, torch.Tensor] = dataclasses.field(
        default_factory=dict, compare=False, repr=False, metadata=TRANSIENT
    )
    heading: ClassVar[str] = "Views"

    def __post_init__(self) -> None:
        for name, value in (("value", self.value), *self.groups.items()):
            if not (isinstance(value, numbers.Real) and 0 <= value < math.inf):
                raise ValueError(f"Prior: lambda ({name}) must be in [0, inf), got {value!r}; try 1e-6")
        if self.length is not None:
            if not (isinstance(self.length, numbers.Real) and 0 < self.length < math.inf):
                raise ValueError(
                    f"Prior: length must be above 0 and finite, got {self.length!r}; leave it out, or try 1"
                )
            object.__setattr__(self, "length", float(self.length))
        if not isinstance(self.value, (int, float)):  # NumPy's, which no file holds
            object.__setattr__(self, "value", float(self.value))

    def to_json(self) -> dict:
        """As files hold it."""
        return {"value": self.value, "relative": self.relative, "length": self.length}

    def over(self, length: float) -> Prior:
        """With this unit of positions, unless it has one itself."""
        return self if self.length is not None else dataclasses.replace(self, length=length)

    def in_scene(self, scene: Scene, cameras: Sequence[Camera]) -> Prior:
        """About the parameters of a scene: with its unit of positions, unless it has one itself.

        Args:
            scene, cameras: The same as for `unit_length`.
        """
        from drgs.information.network_groups import network_lengths  # with torch, which an option list does not need

        prior = self if self.length is not None else self.over(unit_length(scene, cameras))
        return dataclasses.replace(prior, lengths=network_lengths(scene))

    def per_group(self, train: Mapping[str, torch.Tensor]) -> dict[str, float | torch.Tensor]:
        """lambda of every group of H: a number, or one for each parameter.

        Raises:
            ValueError: If `groups` names one that H does not have.
        """
        for name in self.groups:
            if name not in train:
                raise ValueError(f"Prior: groups must be among {', '.join(train)}, got {name!r}; correct or drop it")
        values: dict[str, float | torch.Tensor] = {name: float(self.groups.get(name, self.value)) for name in train}
        if self.length is not None and not self.relative:
            for name in {_POSITIONS, *self.lengths} & train.keys() - self.groups.keys():
                of_length = self.value / self.length**2
                values[name] = of_length if name == _POSITIONS else self._mixed(self.lengths[name], of_length)
        if self.relative:
            for name, H in train.items():
                positive = H[H > 0]
                values[name] *= float(positive.median()) if positive.numel() else 0.0
        return values

    def _mixed(self, is_length: torch.Tensor, of_length: float) -> torch.Tensor:
        """(P,) float64 lambda of parameters some of which are lengths."""
        values = is_length.double()
        return values.fill_(self.value).masked_fill_(is_length, of_length)


def unit_length(scene: Scene, cameras: Sequence[Camera]) -> float:
    """The length of a scene in which lambda is about positions, in world units: the extent of its cameras over 5.6.

    That is about 1 where COLMAP or LLFF have scaled the world (0.9 to 1.4 for eight captures), for which the values of
    lambda were chosen. It scales with the world, and depends neither on the order of the cameras nor on photographs.
    Cameras that are all at one place have no extent: there it goes by the median distance of the Gaussians from them.

    Args:
        scene: The scene that is seen.
        cameras: All cameras that are compared, known ones and others; at least one.
    """
    import numpy as np

    from drgs.data.camera_layout import scene_extent

    in_order = sorted(cameras, key=lambda camera: camera.center.tolist())  # the last bits of a mean depend on the order
    centers = np.stack([camera.center for camera in in_order])
    points = None
    if np.ptp(centers, axis=0).max() <= _ONE_PLACE * max(1.0, float(np.abs(centers).max())):
        seen = scene.at(in_order[0].time)
        points = seen.means.detach().double().cpu().numpy() + seen.origin  # a length has no gradient
    return scene_extent(in_order, points) / _USUAL_EXTENT
