"""Parameter groups of Fisher information. A group is one entry of `GROUPS`; nothing else knows its name.

A group belongs to the Gaussians, as a view sees them, or to the scene that they come from: each float tensor of a
`DeformableScene`, such as a weight of a network, is a group of that name (`scene_groups`). Where both have the name,
such as `means`, it is the scene's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch

from drgs.ellipsoids import DeformableScene, Gaussians, Scene
from drgs.information.jacobian import GEOMETRY
from drgs.information.sums import Information
from drgs.tracing.pose import quaternion_product

__all__ = ["GROUPS", "Group", "Information", "groups_of", "scene_groups"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Group:
    """What a group is shaped like, and where its numbers come from.

    Attributes:
        owner: `gaussians` or `scene`: of which of them `input` and the tangents are.
        shape: Gaussians -> shape of its information.
        entries: What it is made from, of the sums of a replay (`jacobian.SquareSums`), one after the other; empty where
            that knows nothing.
        from_sums: (N, entries) sums, `Replay`, channel weights -> its information; None likewise.
        pixel_weights: Weights shaped like its information, `Replay` -> (N, entries or 3) weights of squares in a pixel
            (`jacobian.VarianceSums`); None where a pixel's RGB do not depend on it.
        input: The tensor that reverse mode differentiates by.
        to_group: (derivative by `input`, `input`) -> derivative by the group.
        fisherrf: Inputs by name -> what FisherRF divides the squares by; None where it leaves the group out.
        columns: Gaussians -> shape of a tangent, where it is not `shape`.
        outputs: First and last (exclusive) channel of a column that informs about it: RGB, then features.
        merge: Squares of all columns, shaped `columns` -> information.
        exists: Gaussians -> whether they have it.
    """

    shape: Callable
    input: str
    entries: tuple[int, ...] = ()
    from_sums: Callable | None = None
    owner: str = "gaussians"
    pixel_weights: Callable | None = None
    to_group: Callable = lambda slope, _: slope
    fisherrf: Callable | None = lambda _: 1.0
    columns: Callable | None = None
    outputs: tuple = (0, 3)
    merge: Callable = lambda squares: squares
    exists: Callable = lambda _: True

    def tangent(self, gaussians: Gaussians) -> tuple[int, ...]:
        """Shape of a tangent in `render_jvp`."""
        return (self.columns or self.shape)(gaussians)


def _geometry(first: int, count: int, name: str, **options: Any) -> Group:
    """`count` numbers a Gaussian from entry `first` of the rows on."""
    shape = (lambda g: (len(g), count)) if count > 1 else (lambda g: (len(g),))
    return Group(
        shape=shape,
        entries=tuple(range(first, first + count)),
        from_sums=lambda sums, replay, weights: sums if count > 1 else sums[:, 0],
        pixel_weights=lambda values, replay: values.reshape(len(values), count),
        input=name,
        **options,
    )


def _turned(slope: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    """(N, 3) derivative by a world-frame rotation, from the one by the quaternion."""
    axes = torch.eye(3, dtype=torch.float64)
    return torch.stack([(slope * 0.5 * quaternion_product(x.expand(len(quats), 3), quats)).sum(1) for x in axes], 1)


def _opacity_slope(inputs: dict) -> torch.Tensor:
    # opacity (1 - opacity), without the cancellation by which it is 0 from a logit of 37 on, where squares are not.
    e = (-inputs["logit_opacities"].cpu().double().abs()).exp()
    return (e / (1 + e).square()).clamp_min(1e-300)  # divided by: 0 beyond a logit of 745


# Colors are linear: dC_c / d sh_kc = w Y_k, 0 where the color is clamped.
GROUPS = {
    "means": _geometry(0, 3, "means"),
    "rotations": _geometry(3, 3, "quats", to_group=_turned, fisherrf=None),
    # FisherRF squares derivatives by s and alpha, then multiplies by ds/dlog s and dalpha/dlogit once.
    "log_scales": _geometry(6, 3, "log_scales", fisherrf=lambda inputs: inputs["log_scales"].cpu().double().exp()),
    "logit_opacities": _geometry(9, 1, "logit_opacities", fisherrf=_opacity_slope),
    "sh": Group(
        shape=lambda g: tuple(g.sh.shape),
        entries=(GEOMETRY,),
        from_sums=lambda sums, replay, weights: replay.sh_information(sums, weights),
        pixel_weights=lambda values, replay: replay.sh_pixel_weights(values),
        input="sh",
    ),
    "features": Group(
        shape=lambda g: (len(g),),
        entries=(GEOMETRY,),
        from_sums=lambda sums, replay, weights: sums[:, 0] * replay.feature_scale,
        pixel_weights=lambda values, replay: values[:, None] * replay.feature_scale,
        input="features",
        columns=lambda g: tuple(g.features.shape),
        outputs=(3, None),
        merge=lambda squares: squares.mean(1),
        exists=lambda g: g.features is not None,
    ),
}


def scene_groups(scene: Scene | None) -> dict[str, Group]:
    """The groups of a scene itself: none, unless it is a `DeformableScene`, which may share names with its Gaussians.

    Those that have `quats` have `rotations`, too.
    """
    if not isinstance(scene, DeformableScene):
        return {}
    shapes = {name: tuple(x.shape) for name, x in scene.parameters().items() if x.is_floating_point()}
    own = {name: _own(name, shape) for name, shape in shapes.items()}
    if "quats" in shapes:
        own["rotations"] = dataclasses.replace(_own("quats", (shapes["quats"][0], 3)), to_group=_turned)
    return own


def _own(name: str, shape: tuple[int, ...]) -> Group:
    """A scene's tensor; images of features inform about features only, RGB about all others."""
    outputs = GROUPS["features"].outputs if name == "features" else (0, 3)
    return Group(shape=lambda _: shape, input=name, owner="scene", fisherrf=None, outputs=outputs)


def groups_of(
    gaussians: Gaussians, wanted: str | Sequence[str] | None = None, scene: Scene | None = None
) -> dict[str, Group]:
    """The groups that Gaussians have; or those that are wanted, of their scene where it has the name, else of them.

    Raises:
        ValueError: If one is wanted that neither has.
    """
    if isinstance(wanted, str):
        wanted = (wanted,)
    there = {name: group for name, group in GROUPS.items() if group.exists(gaussians)}
    if wanted is not None:
        there |= scene_groups(scene)
    for name in wanted or ():
        if name not in there:
            raise ValueError(f"fisher: groups must be among {', '.join(there)}, got {name!r}")
    return {name: group for name, group in there.items() if wanted is None or name in wanted}
