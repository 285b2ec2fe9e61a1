"""What a fit does with what moves: a record of `drgs.fitting.config`, whose text says what its own says."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from drgs.fitting.ranges import FADING, FRACTION, RATE, WEIGHT
from drgs.guards.arguments import check_fields
from drgs.guards.records import Record

__all__ = ["Dynamics", "FieldPreset", "LivesUse", "MotionConfig"]

Dynamics = Literal["auto", "ignore"]
FieldPreset = Literal["neu3d", "dnerf"]
LivesUse = Literal["auto", "off"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionConfig(Record):
    """Gaussians that a deformation field moves [1], where the training views are of two times or more.

    The static stage fits Gaussians that stand still to the first time of all training cameras (to all times, where
    fewer than 3 photographs show the first). The dynamic stage goes on with them, and with their moments in the
    optimizer, and adds the field. Rates and SH follow one schedule over both; those of the field begin with the dynamic
    stage. Density control goes through its schedule in each stage: the static one up to half of `max_gaussians`, the
    dynamic one up to all, so that there are some left for what appears later.

    The field's rates are ten times those of [1], which are for 14,000 steps: in some hundred or thousand, motion must
    be found before what is in the wrong place has become transparent. A gate is a logit a Gaussian; what no photograph
    shows to move comes to a rest by their weight, and is not deformed.

    Something that goes further between photographs than it is large, or that appears, is born where photographs of its
    time show it: Gaussians with a center and a width in time and a velocity of their own, so that no photograph of
    another time fades them (`drgs.fitting.lives`).

    Attributes:
        dynamics: Fit a deformation field if the views have several times (auto), or static Gaussians to all times
            (ignore).
        static_share: Fraction of the steps that fit static Gaussians to the first time, before the deformation field is
            added; 0: none.
        field_preset: Size of the deformation field: for videos of several cameras (neu3d), or one camera around an
            object (dnerf).
        grid_rate: First and last learning rate of the field's planes.
        field_rate: First and last learning rate of the field's MLP.
        motion_rate: Learning rate of the gates (for each Gaussian a logit of whether it moves), times the steps of the
            dynamic stage.
        motion_weight: Weight of the mean gate in the loss: the larger, the fewer Gaussians move.
        smooth_weight: Weight of the smoothness of the field along time.
        plane_weight: Weight of the smoothness of the field's spatial planes (xy, xz, yz).
        l1_time_weight: Weight of the L1 distance of the field's temporal planes from 1, where they have no effect.
        lives: Add Gaussians with a limited lifetime where photographs of one time differ from the static Gaussians
            (auto), or none (off).
        life_weight: Weight of the mean ratio of the time between photographs to a Gaussian's lifetime, where it is
            below 1: the larger, the longer they live.
    Reference:
        [1] Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, and its code.
    """

    dynamics: Dynamics = "auto"
    static_share: float = 3 / 17
    field_preset: FieldPreset = "neu3d"
    grid_rate: tuple[float, float] = (1.6e-2, 1.6e-3)
    field_rate: tuple[float, float] = (1.6e-3, 1.6e-4)
    motion_rate: float = 120.0
    motion_weight: float = 0.03
    smooth_weight: float = 1e-3
    plane_weight: float = 2e-4
    l1_time_weight: float = 1e-4
    lives: LivesUse = "auto"
    life_weight: float = 0.1
    where: ClassVar[str] = "fit"

    def __post_init__(self) -> None:
        weights = ("motion_weight", "smooth_weight", "plane_weight", "l1_time_weight", "life_weight")
        rates = {"grid_rate": FADING, "field_rate": FADING, "motion_rate": RATE}
        check_fields("fit", self, {"static_share": FRACTION, **rates, **dict.fromkeys(weights, WEIGHT)})
        if self.static_share == 1:
            raise ValueError("fit: static_share must be below 1, got 1; --dynamics ignore fits no motion at all")
