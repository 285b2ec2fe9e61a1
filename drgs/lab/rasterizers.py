"""Rasterizers to be compared: ours, gsplat, any torch function with gsplat's arguments, or what one wrote to a file.

Each is given raw parameters (drgs.ellipsoids) and a camera and returns an image that torch can differentiate;
activations (exp, sigmoid) are applied here, so that derivatives arrive at the raw parameters, and the camera is moved
here (raw.posed), so that they arrive at its motion. A dump has an image and gradients only: it cannot be asked again.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, sh_degree_of
from drgs.guards.imports import imported_function
from drgs.integrator import render
from drgs.lab.dumps import SUFFIXES, Dump, one_line, read_dump
from drgs.lab.raw import COLORS, MOTIONS, gaussians_of, image_of, posed
from drgs.oracle import float64
from drgs.settings import PRESETS, RenderSettings

__all__ = ["Rasterizer", "function", "load_rasterizer", "ours"]


@dataclasses.dataclass(frozen=True)
class Rasterizer:
    """A function that draws.

    Attributes:
        name: Name of the rasterizer, as the user gave it.
        draw: (raw parameters by group, camera, background) -> image (H, W, 3), alpha (H, W); differentiable. With
            `colors` (N, D) instead of `sh` the image has D channels and the background D zeros; with `viewmats`, a
            motion of the camera, its gradient arrives there.
        dtype: Precision of the parameters that it is given.
        device: Device that it wants them on.
        preset: Preset that it is, if it is ours.
    """

    name: str
    draw: Callable[[dict, Camera, tuple], tuple[torch.Tensor, torch.Tensor]]
    dtype: torch.dtype = torch.float64
    device: str = "cpu"
    preset: str | None = None

    def image(self, raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """Image and alpha without derivatives, float64 on the CPU."""
        with torch.no_grad():
            image, alpha = self.draw(self.taken(raw), camera, background)
        # A function may turn gradients on for itself: its graph would be kept with the image.
        return image.detach().double().cpu(), alpha.detach().double().cpu()

    def gradient(self, raw: dict, camera: Camera, background: tuple, cotangent: torch.Tensor) -> dict:
        """float64 gradient of <cotangent, image> by group; None where the image does not depend on it.

        Raises:
            ValueError: If torch finds no graph at all.
        """
        leaves = {name: x.requires_grad_() for name, x in self.taken(raw).items()}
        try:
            image, _ = self.draw(leaves, camera, background)
            if not image.requires_grad:
                raise ValueError(f"--rasterizer {self.name}: its image must be differentiable by torch, has no graph")
            loss = (image * cotangent.to(image)).sum()
            found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        except Exception:
            moving = [name for name in MOTIONS if name in raw]
            if not moving:
                raise
            # It may make an array of the pose, or refuse one that wants a gradient: the others are asked for alone.
            fixed = {name: x for name, x in raw.items() if name not in MOTIONS}
            return {**self.gradient(fixed, camera, background, cotangent), **dict.fromkeys(moving)}
        # Gradients are numbers from here on; a function may have asked for a graph of them.
        return {name: None if x is None else x.detach().double().cpu() for name, x in zip(leaves, found, strict=True)}

    def taken(self, raw: dict) -> dict:
        """Copies of the parameters as it wants them."""
        # New leaves: gradients are to end at these, whatever the raw parameters were made of.
        return {name: x.detach().to(self.device, self.dtype, copy=True) for name, x in raw.items()}


def load_rasterizer(
    text: str,
    g: Gaussians | None = None,
    cameras: list[Camera] | None = None,
    fields: dict | None = None,
    along_rays: bool = False,
) -> Rasterizer | Dump:
    """A rasterizer by its name.

    Args:
        text: `drgs:ewa` (preset gsplat) or `drgs:PRESET`; `gsplat`; `package.module:function`, a function with the
            argument names of gsplat's `rasterization` that returns (image (C,H,W,3), alpha (C,H,W,1), anything); or a
            file .npz or .safetensors with `image` (C,H,W,3), `alpha` (C,H,W), `cotangent` (C,H,W,3), `grad_means`,
            `grad_quats`, `grad_log_scales`, `grad_logit_opacities`, `grad_sh` (of raw parameters), maybe `grad_viewmat`
            (C,4,4), and the arrays of the scene as `export` wrote them (C = 1 may be left out).
        g: Scene that a dump must be of.
        cameras: Views that a dump must be of.
        fields: Settings that hold whatever the preset is: ours are drawn with them, a dump is of their background.
        along_rays: Whether a function is asked for Gaussians along rays (`with_ut`, `with_eval3d`), as it always is
            for a lens or a rolling shutter.
    Returns:
        A `Rasterizer` or a `Dump`.
    Raises:
        ValueError: If there is no such rasterizer, or a dump is damaged or of another scene; one line.
    """
    fields = fields or {}
    if Path(text).suffix in SUFFIXES:
        return read_dump(Path(text), g, cameras, tuple(fields.get("background", (0.0, 0.0, 0.0))))
    if text.startswith("drgs:"):
        name = text.removeprefix("drgs:")
        preset = "gsplat" if name == "ewa" else name
        if preset not in PRESETS:
            raise ValueError(f"--rasterizer {text}: must be drgs:ewa or drgs: and one of {', '.join(PRESETS)}")
        return ours(RenderSettings.preset(preset, **fields), text, preset)
    if text == "gsplat":
        try:
            from gsplat import rasterization
        except ImportError:
            raise ValueError("--rasterizer gsplat: must be installed, is not; run pip install gsplat") from None
        if not torch.cuda.is_available():
            raise ValueError("--rasterizer gsplat: must have a CUDA card, torch finds none; use a dump made on one")
        return function(_three_channels_along_rays(rasterization), text, along_rays)
    found = imported_function("--rasterizer", text, "drgs:PRESET, gsplat, a file .npz or .safetensors, or ")
    return function(found, text, along_rays)


def ours(settings: RenderSettings, name: str, preset: str | None = None) -> Rasterizer:
    """`drgs.render` with these settings."""

    def draw(raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        g, shift = gaussians_of(raw)
        out = render(g, posed(raw, camera), settings.replace(background=background[:3]), outputs=())
        return image_of(out, raw, shift), out.alpha

    return Rasterizer(name, draw, torch.float64, "cpu", preset)


def function(call: Callable, name: str, along_rays: bool = False) -> Rasterizer:
    """A function with gsplat's argument names, in float64 if it takes that, on a card if there is one and it asks.

    Args:
        call: The function.
        name: Its name in messages.
        along_rays: Whether it is asked for Gaussians along rays, as `load_rasterizer` says.
    """
    accepted = inspect.signature(call).parameters
    open_ended = any(p.kind is p.VAR_KEYWORD for p in accepted.values())

    def draw(raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """The function's image and alpha, or one line that says how it failed."""
        means = raw["means"]
        camera = posed(raw, camera)
        like = {"dtype": means.dtype, "device": means.device}
        arguments = {
            "means": means,
            "quats": raw["quats"],
            "scales": raw["log_scales"].exp(),
            "opacities": raw["logit_opacities"].sigmoid(),
            "colors": raw[COLORS] if COLORS in raw else raw["sh"],
            "viewmats": float64(camera.w2c).to(**like)[None],
            "Ks": float64(camera.K).to(**like)[None],
            "width": camera.width,
            "height": camera.height,
        }
        options = {"backgrounds": torch.tensor([background], **like), "packed": False}
        if COLORS not in raw:
            options["sh_degree"] = sh_degree_of(raw["sh"].shape[1])
        lens = _lens_arguments(camera, like, accepted)
        if lens or along_rays:
            options |= {"with_ut": True, "with_eval3d": True}
        if missing := [] if open_ended else [k for k in lens if k not in accepted]:
            raise ValueError(
                f"--rasterizer {name}: must take {missing[0]} for a camera of model {camera.model!r}, does not; "
                "compare it on undistorted cameras"
            )
        given = {k: v for k, v in options.items() if open_ended or k in accepted} | lens
        try:
            returned = call(**arguments, **given)
        except Exception as error:
            raise ValueError(f"--rasterizer {name}: raised {type(error).__name__}: {one_line(error)}") from error
        image, alpha = _checked(name, returned, camera, len(background))
        if "backgrounds" not in given:
            image = image + (1 - alpha[..., None]) * torch.tensor(background, **like)
        return image, alpha

    return Rasterizer(name, draw, *_taste(draw))


def _three_channels_along_rays(rasterization: Callable) -> Callable:
    """gsplat's function, without the images that end the process: along rays its kernels assert three channels."""

    @functools.wraps(rasterization)
    def checked(**arguments: Any) -> Any:
        channels = arguments["colors"].shape[-1]
        if arguments.get("with_eval3d") and channels != 3:
            raise NotImplementedError(f"along rays its images have 3 channels, not {channels}")
        return rasterization(**arguments)

    return checked


def _lens_arguments(camera: Camera, like: dict, accepted: Mapping[str, inspect.Parameter]) -> dict:
    """A camera's lens and shutter as gsplat's arguments; none of a pinhole that stands still."""
    found: dict[str, Any] = {}
    if camera.model == "opencv_fisheye":
        found |= {"camera_model": "fisheye", "radial_coeffs": torch.tensor([camera.distortion], **like)}
    elif camera.is_distorted:
        k1, k2, p1, p2, *rest = camera.distortion
        rest = [*rest, *[0.0] * (8 - len(rest))]  # k3 to k6, and a thin prism's s1 to s4
        found |= {
            "camera_model": "pinhole",
            "radial_coeffs": torch.tensor([[k1, k2, *rest[:4]]], **like),
            "tangential_coeffs": torch.tensor([[p1, p2]], **like),
        }
        if any(rest[4:]):
            found["thin_prism_coeffs"] = torch.tensor([rest[4:]], **like)
    if camera.is_rolling:
        # gsplat's is a member of an enumeration, whose type its default has.
        kinds = type(accepted["rolling_shutter"].default) if "rolling_shutter" in accepted else str
        kind = kinds[camera.shutter.upper()] if issubclass(kinds, enum.Enum) else camera.shutter
        found |= {"rolling_shutter": kind, "viewmats_rs": float64(camera.w2c_end).to(**like)[None]}
    return found


def _taste(draw: Callable) -> tuple[torch.dtype, str]:
    """The precision and the place that a function works in, tried on one Gaussian."""
    camera = Camera(K=np.array([[8.0, 0, 4], [0, 8.0, 4], [0, 0, 1]]), w2c=np.eye(4), width=8, height=8)
    raw = {
        "means": torch.tensor([[0.0, 0.0, 3.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "log_scales": torch.zeros(1, 3),
        "logit_opacities": torch.zeros(1),
        "sh": torch.zeros(1, 1, 3),
    }
    places = [(torch.float64, "cpu"), (torch.float32, "cpu")]
    if torch.cuda.is_available():
        places = [(torch.float32, "cuda"), (torch.float64, "cuda"), *places]
    problem = None
    for dtype, device in places:
        try:
            with torch.no_grad():  # asked only whether it draws
                image, _ = draw({k: x.to(device, dtype) for k, x in raw.items()}, camera, (0.0, 0.0, 0.0))
            if image.dtype == dtype:
                return dtype, device
        except ValueError as error:
            problem = error
    if problem is not None:
        raise problem
    return torch.float32, "cpu"


def _checked(name: str, returned: object, camera: Camera, channels: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, channels) and (H, W) of what a function returned."""
    if not isinstance(returned, tuple | list) or len(returned) < 2:
        got = type(returned).__name__
        raise ValueError(f"--rasterizer {name}: must return (image, alpha, info), got {got}")
    image, alpha = returned[:2]
    size = camera.height, camera.width
    for what, x, last in (("image", image, channels), ("alpha", alpha, 1)):
        if not isinstance(x, torch.Tensor):
            raise ValueError(f"--rasterizer {name}: its {what} must be a torch tensor, got {type(x).__name__}")
        if tuple(x.shape) not in ((1, *size, last), (*size, last)):
            wanted = f"(1, {size[0]}, {size[1]}, {last})"
            raise ValueError(f"--rasterizer {name}: its {what} must have shape {wanted}, got {tuple(x.shape)}")
    return image.reshape(*size, channels), alpha.reshape(size)
