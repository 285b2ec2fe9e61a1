"""Scenes and cameras as gsplat's users hold them, tensors of activated values, as `Gaussians` and `Camera`s.

Raw parameters are logarithms and logits: values at the ends of their range (a scale of 0, an opacity of 0 or 1) are
moved inside by less than float32 resolves, and keep their derivative.

Channels: rendering is linear in the colors, so up to three of them travel as the color of SH degree 0, shifted above
the clamp at 0 (what the shift adds to an image is taken off again), and the others as features.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import torch

from drgs.cameras import Camera
from drgs.checks.arguments import ArgumentError
from drgs.checks.derivatives import check_has_numbers, unwrapped
from drgs.ellipsoids import Y_00, Gaussians

__all__ = [
    "SplatScene",
    "SplatTensors",
    "Splats",
    "cameras_of",
    "check_shapes",
    "color_of",
    "inside",
    "inside_opacities",
    "scene_of",
]

# Scales of 0 have no logarithm, opacities of 0 and 1 no logit: gsplat takes them, and these look the same.
_LEAST_SCALE = 1e-20  # scene units
_LEAST_OPACITY = 1e-12  # logit -27.6
_MOST_OPACITY = 1 - 2.0**-26  # logit 18.0


class SplatTensors(TypedDict, total=False):
    """The arguments of `drgs.rasterization` that describe Gaussians and cameras."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int
    sh_degree: int | None
    backgrounds: torch.Tensor | None


@dataclasses.dataclass
class Splats:
    """One scene as gsplat stores it: means (N, 3), quats (N, 4), scales (N, 3), opacities (N,), and colors (N, D), or
    with a degree (N, K, 3); strains (N, 6) where Gaussians are given by covariances.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    degree: int | None
    strains: torch.Tensor | None = None

    def take(self, index: torch.Tensor) -> Splats:
        """The Gaussians at `index`."""
        parts: dict[str, Any] = {name: x[index] for name, x in vars(self).items() if isinstance(x, torch.Tensor)}
        return Splats(**parts, degree=self.degree)

    def gaussians(self, with_color: bool = True) -> tuple[Gaussians, float]:
        """Raw parameters, and the number added to the first three channels to keep them above the clamp."""
        shift, features = 0.0, None
        if not with_color:
            sh = self.means.new_zeros(len(self.means), 1, 3)
        elif self.degree is not None:
            sh = self.colors[:, : (self.degree + 1) ** 2]
        else:
            sh, features, shift = color_of(self.colors)
        opacities = self.opacities.double()  # near 1 float32 cannot hold 1 - opacity
        logits = torch.log(opacities) - torch.log1p(-opacities)
        return Gaussians(self.means, self.quats, torch.log(self.scales), logits, sh, features), shift


@dataclasses.dataclass(frozen=True)
class SplatScene:
    """One scene and its views, in the renderer's own terms.

    Attributes:
        gaussians: Raw parameters; plain colors are shifted, and the backgrounds with them, which no derivative sees.
        cameras: One a view.
        backgrounds: (R, G, B) a view.
        channels: How many of R, G and B there are: fewer than 3 of colors (N, 1) and (N, 2).
    """

    gaussians: Gaussians
    cameras: list[Camera]
    backgrounds: list[tuple[float, ...]]
    channels: int


def scene_of(where: str, splats: SplatTensors) -> SplatScene:
    """The scene and the views of `drgs.rasterization`'s arguments, without leading axes; gradients are kept.

    Raises:
        ValueError: If an argument is missing, unknown, or has a wrong shape or value.
    """
    known = list(SplatTensors.__annotations__)
    optional = ("sh_degree", "backgrounds")
    if unknown := [name for name in splats if name not in known]:
        raise ArgumentError(f"{where}: tensors must be among {', '.join(known)}, got {unknown[0]}; drop it")
    if missing := [name for name in known if name not in splats and name not in optional]:
        raise ArgumentError(f"{where}: tensors must include {missing[0]}, as drgs.rasterization takes it; pass it")
    degree, backgrounds = splats.get("sh_degree"), splats.get("backgrounds")
    colors, viewmats, Ks = splats["colors"], splats["viewmats"], splats["Ks"]
    parts = (splats["means"], splats["quats"], splats["scales"], splats["opacities"], colors)
    lead, count = check_shapes(where, *parts, viewmats, Ks, degree, backgrounds)
    if lead or colors.ndim != (2 if degree is None else 3):
        raise ArgumentError(
            f"{where}: tensors must be of one scene whose colors are the same in every view, got means of shape "
            f"{tuple(splats['means'].shape)} and colors of shape {tuple(colors.shape)}; call it for each scene or view"
        )
    scales, opacities = inside(where, splats["scales"], splats["opacities"])
    gaussians, shift = Splats(splats["means"], splats["quats"], scales, opacities, colors, degree).gaussians()
    cameras = cameras_of(viewmats, Ks, splats["width"], splats["height"])
    behind = torch.zeros(count, 3) if backgrounds is None else backgrounds[:, :3].detach()  # settings are no parameters
    behind = torch.nn.functional.pad(behind, (0, 3 - behind.shape[1])) + shift
    channels = min(3, colors.shape[-1])
    return SplatScene(gaussians, cameras, [tuple(row) for row in behind.tolist()], channels)


def color_of(colors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None, float]:
    """SH (N, 1, 3), features (N, D - 3) or None, and the shift of the first three channels, of plain colors (N, D)."""
    first = colors[:, :3]
    rest = colors[:, 3:]
    # At exactly 0 the clamp would end the gradient; one half is exact and keeps black clear of it.
    # The shift is taken off the image again: whatever it is, the gradient is the same.
    shift = 0.5 - min(0.0, float(first.detach().min()) if first.numel() else 0.0)
    first = torch.nn.functional.pad(first, (0, 3 - first.shape[1]))
    return ((first + (shift - 0.5)) / Y_00)[:, None, :], rest if rest.shape[1] else None, shift


def cameras_of(
    viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int, lenses: Sequence[Mapping[str, Any]] = ()
) -> list[Camera]:
    """Cameras of (C, 4, 4) poses, whose gradients they keep, and (C, 3, 3) intrinsics.

    Args:
        viewmats, Ks, width, height: Arguments of `drgs.rasterization`.
        lenses: Fields of `Camera` that say what lens and shutter each camera has, K among them where it is not that of
            `Ks`; empty: pinholes.
    """
    return [
        Camera(
            **{"K": unwrapped(K, lambda K: K.cpu().double().numpy()), **lens},
            w2c=viewmat,
            width=width,
            height=height,
        )
        for viewmat, K, lens in zip(viewmats, Ks, lenses or [{}] * len(Ks), strict=True)
    ]


def inside(where: str, scales: torch.Tensor, opacities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales and opacities that have logarithms and logits.

    Raises:
        ValueError: If a value is out of range; the renderer checks the rest.
    """
    for name, x, high in (("scales", scales, math.inf), ("opacities", opacities, 1.0)):
        bad = ~((x.detach() >= 0) & (x.detach() <= high))  # the comparison has no derivative
        if bool(bad.any()):
            at = tuple(bad.nonzero()[0].tolist())
            allowed = "[0, 1], as sigmoid gives" if name == "opacities" else "[0, inf), linear, as exp gives"
            raise ValueError(f"{where}: {name} must be in {allowed}, got {float(x[at]):g} at index {list(at)}")
    return _inside(scales, _LEAST_SCALE, math.inf), inside_opacities(opacities)


def inside_opacities(opacities: torch.Tensor) -> torch.Tensor:
    """Opacities that have logits."""
    return _inside(opacities, _LEAST_OPACITY, _MOST_OPACITY)


def _inside(x: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """x moved into [low, high], with the derivative of x: at the ends gsplat's functions have one."""
    # The value of the clamp without its derivative. In float32, 1 - 2^-26 would be 1, whose logit is infinite.
    return x + (x.detach().double().clamp(low, high) - x.detach()) if x.numel() else x


def check_shapes(
    where: str,
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    degree: int | None,
    backgrounds: torch.Tensor | None,
) -> tuple[tuple[int, ...], int]:
    """Leading axes, and the number of cameras.

    Raises:
        ValueError: If something is no tensor or has not the shape that the others ask for.
    """
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    tensors |= {"viewmats": viewmats, "Ks": Ks} | ({} if backgrounds is None else {"backgrounds": backgrounds})
    for name, x in tensors.items():
        if not isinstance(x, torch.Tensor):
            raise ValueError(f"{where}: {name} must be a torch tensor, got {type(x).__name__}; use torch.as_tensor")
        check_has_numbers(where, name, x)
    if means.ndim < 2 or means.shape[-1] != 3:
        raise ValueError(f"{where}: means must have shape (..., N, 3), got {tuple(means.shape)}")
    if viewmats.ndim < 3:
        raise ValueError(
            f"{where}: viewmats must have shape (..., C, 4, 4), got {tuple(viewmats.shape)}; add an axis for the "
            "cameras, viewmat[None]"
        )
    lead = tuple(means.shape[:-2])
    n = means.shape[-2]
    cameras = viewmats.shape[-3]
    if degree is None:
        shown: list[tuple] = [(n, "D"), (cameras, n, "D")]
    else:
        if degree not in (0, 1, 2, 3):
            raise ValueError(f"{where}: sh_degree must be None or 0 to 3, got {degree!r}")
        shown = [(n, "K", 3), (cameras, n, "K", 3)]
    wanted: dict[str, list[tuple]] = {"quats": [(n, 4)], "scales": [(n, 3)], "opacities": [(n,)], "colors": shown}
    wanted |= {"viewmats": [(cameras, 4, 4)], "Ks": [(cameras, 3, 3)]}
    if backgrounds is not None:
        wanted["backgrounds"] = [(cameras, 3 if degree is not None else colors.shape[-1])]
    for name, shapes in wanted.items():
        got = tuple(tensors[name].shape)
        if not any(_fits(got, lead + shape) for shape in shapes):
            allowed = " or ".join("(" + ", ".join(map(str, lead + shape)) + ")" for shape in shapes)
            raise ValueError(
                f"{where}: {name} must have shape {allowed} (N = {n} from means, C = {cameras} from viewmats"
                f"{'' if name != 'colors' else f', sh_degree = {degree}'}), got {got}"
            )
    if not colors.shape[-1]:
        raise ValueError(f"{where}: colors must have at least one channel, got {tuple(colors.shape)}; give them one")
    if degree is not None and colors.shape[-2] < (degree + 1) ** 2:
        raise ValueError(
            f"{where}: colors must have at least {(degree + 1) ** 2} coefficients for sh_degree {degree}, got "
            f"{colors.shape[-2]}"
        )
    return lead, cameras


def _fits(got: tuple, wanted: tuple) -> bool:
    return len(got) == len(wanted) and all(isinstance(w, str) or g == w for g, w in zip(got, wanted, strict=True))
