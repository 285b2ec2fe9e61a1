"""What the options of gsplat's `rasterization` mean here: renderer, lenses, shutters, modes, and what is refused."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from drgs.guards.arguments import ArgumentError
from drgs.settings import RenderSettings
from drgs.shutters import SHUTTERS

__all__ = ["MODES", "NEAR", "Mode", "check_unscented", "lenses_of", "one_of", "refuse", "settings_of", "shutter_of"]

# Defaults of gsplat's signature: another preset's own constants hold unless an argument differs from these.
NEAR = 0.01
_DILATION = 0.3


@dataclasses.dataclass(frozen=True)
class Mode:
    """What a `render_mode` draws.

    Attributes:
        color: Colors.
        depth: A last channel: `gaussian`, the depth of each Gaussian, `hit`, the distance along the ray, or none.
        expected: That channel is divided by alpha.
    """

    color: bool
    depth: str | None = None
    expected: bool = False


MODES = {
    "RGB": Mode(True),
    "D": Mode(False, "gaussian"),
    "ED": Mode(False, "gaussian", True),
    "RGB+D": Mode(True, "gaussian"),
    "RGB+ED": Mode(True, "gaussian", True),
    "d": Mode(False, "hit"),
    "Ed": Mode(False, "hit", True),
    "RGB-d": Mode(True, "hit"),
    "RGB-Ed": Mode(True, "hit", True),
}
"""gsplat's `render_mode`s."""

# What to do instead of an option that does not exist here.
_RAYS = "pass its rays as rays=, with with_eval3d=True"
_INSTEAD = {
    "sparse_grad": "gradients are dense here; drop it",
    "distributed": "one process renders; split the cameras among processes yourself",
    "lidar_coeffs": _RAYS,
    "external_distortion_coeffs": _RAYS,
    "camera_model='ortho'": _RAYS,
    "camera_model='lidar'": _RAYS,
    "with_ut without with_eval3d": "the image plane's Gaussians are those of the EWA model here; pass both, or neither",
}


def refuse(**asked: bool) -> None:
    """Raise NotImplementedError for the first option of gsplat's that is asked for and does not exist here."""
    for name, is_asked in asked.items():
        if is_asked:
            raise NotImplementedError(f"rasterization: {name} is not supported; {_INSTEAD[name]}")


def check_unscented(params: object) -> None:
    """Raise NotImplementedError for parameters of the unscented transform that are not gsplat's defaults."""
    defaults = {"alpha": 0.1, "beta": 2.0, "kappa": 0.0, "in_image_margin_factor": 0.1}
    for name, usual in {**defaults, "require_all_sigma_points_valid": False}.items():
        value = getattr(params, name, usual)
        if value != usual:
            raise NotImplementedError(
                f"rasterization: ut_params must be alpha 0.1, beta 2, kappa 0, got {name}={value:g}; leave with_ut "
                "out, and nothing is culled by boxes"
            )


def one_of(name: str, value: str, allowed: Sequence[str]) -> None:
    """Raise ValueError for a value that is none of those allowed."""
    if value not in allowed:
        raise ArgumentError(f"rasterization: {name} must be one of {', '.join(allowed)}, got {value!r}")


def settings_of(
    preset: str | RenderSettings | None,
    near: float,
    eps2d: float,
    antialiased: bool,
    along_rays: bool,
    with_ut: bool,
    by_z: bool,
) -> RenderSettings:
    """The renderer that the options mean, on a black background (colors behind are added in torch).

    Args:
        preset: The caller's, whose own constants hold where `near` and `eps2d` are gsplat's defaults; None: gsplat's.
        near: Means nearer than that are left out.
        eps2d: Added to projected covariances, in px^2.
        antialiased: Opacities are compensated for it.
        along_rays: Option `with_eval3d`.
        with_ut: Tiles are those of the unscented transform's boxes.
        by_z: Option `global_z_order`.
    """
    if preset is None:
        key = "z" if by_z else "distance"
        if along_rays:
            culling = "ut" if with_ut else "extent"
            # What is too near by its distance is left out by `rasterization`.
            near = near if by_z else 0.0
            settings = RenderSettings.preset("3dgut", depth_key=key, culling=culling, near=near)
        else:
            settings = RenderSettings.preset("gsplat", depth_key=key, dilation=eps2d, near=near)
    else:
        settings = preset if isinstance(preset, RenderSettings) else RenderSettings.preset(preset)
        if preset == "gsplat" or near != NEAR:
            settings = settings.replace(near=near)
        if preset == "gsplat" or eps2d != _DILATION:
            settings = settings.replace(dilation=eps2d)
    if antialiased and not settings.planar:
        raise NotImplementedError(
            "rasterization: rasterize_mode='antialiased' must have a preset with projected covariances, got "
            f"{'with_eval3d' if preset is None else f'preset={preset!r}'}; use preset='gsplat' or 'inria', or "
            "rasterize_mode='classic'"
        )
    return settings.replace(background=(0.0, 0.0, 0.0))


def lenses_of(
    model: str,
    lead: tuple[int, ...],
    count: int,
    radial: torch.Tensor | None,
    tangential: torch.Tensor | None,
    prism: torch.Tensor | None,
    ftheta: Any,
    Ks: torch.Tensor,
) -> list[list[dict[str, Any]]]:
    """Of each batch and camera, the fields of `Camera` that say what lens it has; empty ones of pinholes.

    gsplat's radial coefficients of a pinhole are OpenCV's k1 to k6, whose order has the tangential p1, p2 behind k2; of
    a fisheye its k1 to k4.
    """
    one_of("camera_model", model, ("pinhole", "fisheye", "ftheta"))
    if (model == "ftheta") != (ftheta is not None):
        raise ArgumentError(
            f"rasterization: ftheta_coeffs must come with camera_model='ftheta', and with no other, got {model!r} and "
            f"{'none' if ftheta is None else 'some'}; change one of them"
        )
    given = {
        "radial_coeffs": (radial, 4 if model == "fisheye" else 6),
        "tangential_coeffs": (tangential, 2),
        "thin_prism_coeffs": (prism, 4),
    }
    values: dict[str, torch.Tensor] = {}
    for name, (x, width) in given.items():
        if x is None:
            continue
        if model == "ftheta" or (model == "fisheye" and name != "radial_coeffs"):
            raise ArgumentError(f"rasterization: {name} must be of camera_model='pinhole', got {model}; drop it")
        if tuple(x.shape) != (*lead, count, width):
            raise ArgumentError(
                f"rasterization: {name} must have shape {(*lead, count, width)} for camera_model={model!r}, got "
                f"{tuple(x.shape)}"
            )
        values[name] = x.detach().cpu().double().reshape(-1, count, width)  # as of intrinsics, no gradient
    batches = math.prod(lead)
    if model == "ftheta":
        centers = Ks.detach().cpu().double().reshape(batches, count, 3, 3)[..., :2, 2]  # no gradient, as of others
        return [[_ftheta(ftheta, *center.tolist()) for center in batch] for batch in centers]
    if model == "pinhole" and not values:
        return [[{} for _ in range(count)] for _ in range(batches)]
    zeros = {name: torch.zeros(batches, count, width, dtype=torch.float64) for name, (_, width) in given.items()}
    k, p, s = ({**zeros, **values}[name] for name in given)
    if model == "fisheye":
        return [[{"model": "opencv_fisheye", "distortion": tuple(row.tolist())} for row in batch] for batch in k]
    every = torch.cat([k[..., :2], p, k[..., 2:], *([s] if "thin_prism_coeffs" in values else [])], -1)
    return [[{"model": "opencv", "distortion": tuple(row.tolist())} for row in batch] for batch in every]


def _ftheta(coefficients: Any, cx: float, cy: float) -> dict[str, Any]:
    """Fields of `Camera` of gsplat's `FThetaCameraDistortionParameters`: its reference polynomial, from angles to
    pixels or back; the principal point counts from the center of the first pixel. `max_angle` plays no role for rays.
    """
    kind = str(getattr(coefficients.reference_poly, "name", coefficients.reference_poly))
    forward = kind.endswith("ANGLE_TO_PIXELDIST")
    polynomial = [
        float(x) for x in (coefficients.angle_to_pixeldist_poly if forward else coefficients.pixeldist_to_angle_poly)
    ]
    if polynomial[0] != 0 or not polynomial[1] > 0:
        raise NotImplementedError(
            "rasterization: ftheta_coeffs must have a reference polynomial without a constant term that grows from 0 "
            f"on, got {kind} with {polynomial[0]:g} and {polynomial[1]:g}; {_RAYS}"
        )
    # The focal length belongs into K: bounds of silhouettes are of an equidistant fisheye of that K.
    focal = polynomial[1] if forward else 1 / polynomial[1]
    scaled = [x / focal if forward else x * focal**i for i, x in enumerate(polynomial)][1:]
    K = np.array([[focal, 0.0, cx + 0.5], [0.0, focal, cy + 0.5], [0.0, 0.0, 1.0]])
    linear = [float(x) for x in coefficients.linear_cde]
    return {"K": K, "model": "ftheta" if forward else "ftheta_inverse", "distortion": (*scaled, *linear)}


def shutter_of(rolling_shutter: Any, viewmats_rs: torch.Tensor | None) -> str:
    """`Camera.shutter` of a member of gsplat's `RollingShutterType`, of its name, or of ours."""
    name = getattr(rolling_shutter, "name", rolling_shutter)
    shutter = "global" if name is None else str(name).lower()
    if shutter not in SHUTTERS:
        raise ArgumentError(
            f"rasterization: rolling_shutter must be one of {', '.join(SHUTTERS)}, got {rolling_shutter!r}"
        )
    if (shutter == "global") != (viewmats_rs is None):
        raise ArgumentError(
            f"rasterization: viewmats_rs must be there for rolling shutters, and for no other, got {shutter} and "
            f"{'none' if viewmats_rs is None else 'some'}; change one of them"
        )
    return shutter
