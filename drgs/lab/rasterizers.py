"""Rasterizers to be compared: ours, gsplat, any torch function with gsplat's arguments, or a dump in a file.

Each is given raw parameters (drgs.ellipsoids) and a camera and returns an image that torch can differentiate;
activations (exp, sigmoid) are applied here, so that derivatives arrive at the raw parameters, and the camera is moved
here (parameters.posed), so that they arrive at its motion. A rasterizer on another machine is given a scene as a file
(`export`) and writes a dump of its images and gradients, which cannot be evaluated again (`Dump`).
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import inspect
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.checks.imports import imported_function
from drgs.data.checks import check_npz
from drgs.ellipsoids import Gaussians, sh_degree_of
from drgs.integrator import render
from drgs.io.foreign import refuse_foreign
from drgs.io.outputs import atomic_write
from drgs.lab.parameters import (
    BACKGROUNDS,
    COLORS,
    MOTIONS,
    PARAMETERS,
    POSE,
    around_origin,
    gaussians_of,
    image_of,
    posed,
    raw_of,
    with_pose,
)
from drgs.oracle import float64
from drgs.settings import PRESETS, RenderSettings


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
        several: (raw parameters, one a batch; cameras; their backgrounds; further arguments of the function; channels
            of its image) -> images (B C, H, W, channels), alphas (B C, H, W) of one call; None of what has no arguments
            of gsplat's.
        named: Arguments that its signature names.
    """

    name: str
    draw: Callable[[dict, Camera, tuple], tuple[torch.Tensor, torch.Tensor]]
    dtype: torch.dtype = torch.float64
    device: str = "cpu"
    preset: str | None = None
    several: Callable[[list[dict], list[Camera], list[tuple], dict, int], tuple[torch.Tensor, torch.Tensor]] | None = (
        None
    )
    named: frozenset[str] = frozenset()

    def image(self, raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """Image and alpha without derivatives, float64 on the CPU."""
        with torch.no_grad():
            image, alpha = self.draw(self.prepared(raw), camera, background)
        # A function may turn gradients on for itself: its graph would be kept with the image.
        return image.detach().double().cpu(), alpha.detach().double().cpu()

    def gradient(self, raw: dict, camera: Camera, background: tuple, cotangent: torch.Tensor) -> dict:
        """float64 gradient of <cotangent, image> by group; None where the image does not depend on it.

        Raises:
            ValueError: If torch finds no graph at all.
        """
        leaves = {name: x.requires_grad_() for name, x in self.prepared(raw).items()}
        try:
            image, _ = self.draw(leaves, camera, background)
            if not image.requires_grad:
                raise ValueError(f"--rasterizer {self.name}: its image must be differentiable by torch, has no graph")
            loss = (image * cotangent.to(image)).sum()
            derivatives = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        except Exception:
            moving = [name for name in MOTIONS if name in raw]
            if not moving:
                raise
            # It may make an array of the pose, or refuse one that wants a gradient: the others are taken alone.
            fixed = {name: x for name, x in raw.items() if name not in MOTIONS}
            return {**self.gradient(fixed, camera, background, cotangent), **dict.fromkeys(moving)}
        # Gradients are numbers from here on; a function may have built a graph of them.
        return {
            name: None if x is None else x.detach().double().cpu() for name, x in zip(leaves, derivatives, strict=True)
        }

    def prepared(self, raw: dict) -> dict:
        """Copies of the parameters in the precision and on the device of the rasterizer."""
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
        along_rays: Whether a function is called for Gaussians along rays (`with_ut`, `with_eval3d`), as it always is
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
    imported = imported_function("--rasterizer", text, "drgs:PRESET, gsplat, a file .npz or .safetensors, or ")
    return function(imported, text, along_rays)


def is_along_rays(preset: str, name: str = "") -> bool:
    """Whether a rasterizer is compared with Gaussians along rays: of presets that have no image plane.

    Args:
        preset: The preset that it claims to be; `auto` is that of `drgs:PRESET`, else the image plane.
        name: Name of the rasterizer, as `load_rasterizer` takes it; a dump is of pinholes.
    """
    own = name.removeprefix("drgs:") if name.startswith("drgs:") else "auto"
    claimed = own if own in PRESETS and preset == "auto" else preset
    if claimed == "auto" or name.endswith(SUFFIXES):
        return False
    return not RenderSettings.preset(claimed).planar


def ours(settings: RenderSettings, name: str, preset: str | None = None) -> Rasterizer:
    """`drgs.render` with these settings."""

    def draw(raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        g, shift = gaussians_of(raw)
        out = render(g, posed(raw, camera), settings.replace(background=background[:3]), outputs=())
        return image_of(out, raw, shift), out.alpha

    return Rasterizer(name, draw, torch.float64, "cpu", preset)


def function(call: Callable, name: str, along_rays: bool = False) -> Rasterizer:
    """A function with gsplat's argument names, in float64 if it takes that, on a GPU if there is one and it needs it.

    Args:
        call: The function.
        name: Its name in messages.
        along_rays: Whether it is called for Gaussians along rays, as `load_rasterizer` says.
    """
    accepted = inspect.signature(call).parameters
    open_ended = any(p.kind is p.VAR_KEYWORD for p in accepted.values())

    def arguments(raw: dict, cameras: list[Camera], backgrounds: list[tuple]) -> dict:
        """Arguments of one batch that it takes."""
        means = raw["means"]
        cameras = [posed(raw, camera) for camera in cameras]
        like = {"dtype": means.dtype, "device": means.device}
        always = {
            "means": means,
            "quats": raw["quats"],
            "scales": raw["log_scales"].exp(),
            "opacities": raw["logit_opacities"].sigmoid(),
            "colors": raw[COLORS] if COLORS in raw else raw["sh"],
            "viewmats": torch.stack([float64(camera.w2c).to(**like) for camera in cameras]),
            "Ks": torch.stack([float64(camera.K).to(**like) for camera in cameras]),
            "width": cameras[0].width,
            "height": cameras[0].height,
        }
        options = {"backgrounds": torch.tensor(backgrounds, **like), "packed": False}
        if BACKGROUNDS in raw:
            options["backgrounds"] = raw[BACKGROUNDS]
        if COLORS not in raw:
            options["sh_degree"] = sh_degree_of(raw["sh"].shape[1])
        lenses = [_lens_arguments(camera, like, accepted) for camera in cameras]
        lens = {
            k: torch.cat([of_camera[k] for of_camera in lenses]) if isinstance(x, torch.Tensor) else x
            for k, x in lenses[0].items()
        }
        if lens or along_rays:
            options |= {"with_ut": True, "with_eval3d": True}
        if missing := [] if open_ended else [k for k in lens if k not in accepted]:
            raise ValueError(
                f"--rasterizer {name}: must take {missing[0]} for a camera of model {cameras[0].model!r}, does not; "
                "compare it on undistorted cameras"
            )
        return always | {k: v for k, v in options.items() if open_ended or k in accepted} | lens

    def several(
        raws: list[dict], cameras: list[Camera], backgrounds: list[tuple], changed: dict, channels: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The function's images and alphas, or one line that says how it failed."""
        batches = [arguments(raw, cameras, backgrounds) for raw in raws]
        given = batches[0]
        if len(batches) > 1:
            given = {
                k: torch.stack([batch[k] for batch in batches]) if isinstance(x, torch.Tensor) else x
                for k, x in given.items()
            }
        try:
            returned = call(**(given | changed))
        except Exception as error:
            takes_any = "; who takes **arguments gets all of gsplat's: name those that it knows"
            advice = takes_any if open_ended and isinstance(error, TypeError) else ""
            raise ValueError(
                f"--rasterizer {name}: raised {type(error).__name__}: {one_line(error)}{advice}"
            ) from error
        image, alpha = _checked(name, returned, cameras[0], len(raws), len(cameras), channels)
        if "backgrounds" not in given:
            behind = torch.tensor(backgrounds, dtype=image.dtype, device=image.device)[:, None, None]
            behind = behind.repeat(len(raws), 1, 1, 1)
            width = behind.shape[-1]  # behind a depth there is nothing
            seen = image[..., :width] + (1 - alpha[..., None]) * behind
            image = torch.cat([seen, image[..., width:]], -1)
        return image, alpha

    def draw(raw: dict, camera: Camera, background: tuple) -> tuple[torch.Tensor, torch.Tensor]:
        """Image and alpha of one view."""
        images, alphas = several([raw], [camera], [background], {}, len(background))
        return images[0], alphas[0]

    dtype, device = _precision_and_device(draw)
    return Rasterizer(name, draw, dtype, device, None, several, frozenset(accepted))


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
    arguments: dict[str, Any] = {}
    if camera.model == "opencv_fisheye":
        arguments |= {"camera_model": "fisheye", "radial_coeffs": torch.tensor([camera.distortion], **like)}
    elif camera.is_distorted:
        k1, k2, p1, p2, *rest = camera.distortion
        rest = [*rest, *[0.0] * (8 - len(rest))]  # k3 to k6, and a thin prism's s1 to s4
        arguments |= {
            "camera_model": "pinhole",
            "radial_coeffs": torch.tensor([[k1, k2, *rest[:4]]], **like),
            "tangential_coeffs": torch.tensor([[p1, p2]], **like),
        }
        if any(rest[4:]):
            arguments["thin_prism_coeffs"] = torch.tensor([rest[4:]], **like)
    if camera.is_rolling:
        # gsplat's is a member of an enumeration, whose type its default has.
        kinds = type(accepted["rolling_shutter"].default) if "rolling_shutter" in accepted else str
        kind = kinds[camera.shutter.upper()] if issubclass(kinds, enum.Enum) else camera.shutter
        arguments |= {"rolling_shutter": kind, "viewmats_rs": float64(camera.w2c_end).to(**like)[None]}
    return arguments


def _precision_and_device(draw: Callable) -> tuple[torch.dtype, str]:
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
            with torch.no_grad():  # only whether it draws is of interest
                image, _ = draw({k: x.to(device, dtype) for k, x in raw.items()}, camera, (0.0, 0.0, 0.0))
            if image.dtype == dtype:
                return dtype, device
        except ValueError as error:
            problem = error
    if problem is not None:
        raise problem
    return torch.float32, "cpu"


def _checked(
    name: str, returned: object, camera: Camera, batches: int, count: int, channels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B C, H, W, channels) and (B C, H, W) of what a function returned."""
    if not isinstance(returned, tuple | list) or len(returned) < 2:
        got = type(returned).__name__
        raise ValueError(f"--rasterizer {name}: must return (image, alpha, info), got {got}")
    image, alpha = returned[:2]
    size = camera.height, camera.width
    for what, x, last in (("image", image, channels), ("alpha", alpha, 1)):
        if not isinstance(x, torch.Tensor):
            raise ValueError(f"--rasterizer {name}: its {what} must be a torch tensor, got {type(x).__name__}")
        wanted = (count, *size, last) if batches == 1 else (batches, count, *size, last)
        if tuple(x.shape) != wanted and (batches * count > 1 or tuple(x.shape) != (*size, last)):
            raise ValueError(f"--rasterizer {name}: its {what} must have shape {wanted}, got {tuple(x.shape)}")
    return image.reshape(-1, *size, channels), alpha.reshape(-1, *size)


# -------------------------------------------------------------------------------------------- scenes and dumps as files

SUFFIXES = (".npz", ".safetensors")
_EXPORT = "drgs_export"  # an array that an export has, and a dump, which holds more, has not
_POSE = "grad_viewmat"  # (C, 4, 4); may be left out
_LARGEST = 4 << 30  # bytes of a dump, beyond which it is refused unread: it would not fit beside the comparison


@dataclasses.dataclass(frozen=True)
class Dump:
    """Images and gradients that a rasterizer wrote to a file: see `drgs.lab.rasterizers.load_rasterizer`.

    Attributes:
        name: Path of the file.
        images: (C, H, W, 3) float64 colors.
        alphas: (C, H, W) float64 opacities.
        cotangents: (C, H, W, 3) weights that the gradients belong to.
        gradients: Group -> gradient of sum <cotangents, images>, raw parameters, all views together; and maybe
            `viewmats` (C, 6).
    """

    name: str
    images: torch.Tensor
    alphas: torch.Tensor
    cotangents: torch.Tensor
    gradients: dict


def cotangents(cameras: list[Camera], seed: int, channels: int = 3) -> torch.Tensor:
    """(C, H, W, channels) of +-1: the mean square of an error of J^T u is the error's Frobenius norm squared.

    Raises:
        ValueError: If the cameras differ in size.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"crossval: cameras must have one image size, got {len(sizes)}; choose some with --limit")
    generator = torch.Generator().manual_seed(seed)
    shape = (len(cameras), *sizes.pop(), channels)
    return torch.randint(0, 2, shape, generator=generator).double() * 2 - 1


def scene_arrays(g: Gaussians, cameras: list[Camera], background: tuple) -> dict[str, np.ndarray]:
    """The arrays that identify a scene: float32 raw parameters, cameras and background, relative to its origin."""
    g, cameras = around_origin(g, cameras)
    arrays = {name: x.float().numpy() for name, x in raw_of(g).items()}
    # A file holds values, in float32 as rasterizers take them; a pose may be a leaf.
    arrays["viewmat"] = np.stack([float64(c.w2c).detach().float().numpy() for c in cameras])
    arrays["K"] = np.stack([np.asarray(c.K, np.float32) for c in cameras])
    arrays["width"] = np.int64(cameras[0].width)
    arrays["height"] = np.int64(cameras[0].height)
    arrays["background"] = np.asarray(background, np.float32)
    return arrays


def export(path: Path, g: Gaussians, cameras: list[Camera], background: tuple, seed: int) -> None:
    """Write the scene, its cameras and cotangents for a rasterizer on another machine (.npz).

    Arrays: `means` (N,3), `quats` (N,4), `log_scales` (N,3), `logit_opacities` (N,), `sh` (N,K,3), `viewmat` (C,4,4),
    `K` (C,3,3), `width`, `height`, `background` (3,), `cotangent` (C,H,W,3). Of a scene far from 0 `offset` (3,), what
    means and poses are relative to.

    Raises:
        ValueError: If a camera has a lens or a rolling shutter.
    """
    if any(camera.is_distorted or camera.is_rolling for camera in cameras):
        raise ValueError(
            "crossval: cameras that are exported must be pinholes, got a lens or a rolling shutter; undistort them"
        )
    arrays = scene_arrays(g, cameras, background)
    arrays["cotangent"] = cotangents(cameras, seed).float().numpy()
    if np.any(g.origin):
        arrays["offset"] = np.asarray(g.origin, np.float64)
    arrays[_EXPORT] = _signature(arrays)
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)


def is_export(path: Path) -> bool:
    """Whether `export` wrote a file; a dump that was made of one holds more arrays."""
    try:
        check_npz(path)
        with np.load(path, allow_pickle=False) as arrays:
            return np.array_equal(arrays[_EXPORT], _signature({*arrays.files} - {_EXPORT}))
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile):
        return False


def _signature(names: Iterable[str]) -> np.ndarray:
    """The mark of an export, as numbers: readers may make tensors of all arrays that they find."""
    return np.frombuffer(hashlib.sha256(" ".join(sorted(names)).encode()).digest(), np.uint8)


def read_dump(path: Path, g: Gaussians, cameras: list[Camera], background: tuple) -> Dump:
    """A dump of this scene.

    Raises:
        ValueError: If it is damaged, or of another scene; one line.
    """
    arrays = _arrays(path)
    scene = scene_arrays(g, cameras, background)
    count = len(cameras)
    size = (cameras[0].height, cameras[0].width)
    shapes = {"image": (*size, 3), "alpha": size, "cotangent": (*size, 3)}
    names = [*shapes, *(f"grad_{name}" for name in PARAMETERS), *scene]
    pose = [_POSE] if _POSE in arrays else []
    missing = [name for name in names if name not in arrays]
    if "image" not in arrays and all(name in arrays for name in scene):
        raise ValueError(
            f"{path}: must hold {', '.join(names)}, holds the scene alone, as --export writes it; render it by your "
            "rasterizer (examples/dump_rasterizer.py), and name the file that this writes"
        )
    if missing:
        raise ValueError(f"{path}: must hold {', '.join(names)}; {missing[0]} is missing; write it anew from --export")
    for name, array in arrays.items():
        if name in (*names, *pose) and not np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(np.atleast_1d(array)))[0])
            if not name.startswith("grad_"):  # a gradient that is not finite is a finding
                raise ValueError(f"{path}: {name} must be finite, is {np.atleast_1d(array)[index]} at {index}")
    for name, wanted in scene.items():
        got = arrays[name].reshape(wanted.shape) if arrays[name].size == wanted.size else arrays[name]
        if got.shape != wanted.shape:
            raise ValueError(f"{path}: {name} must have shape {wanted.shape}, got {got.shape}: it is of another scene")
        # Arrays of float32, which the other side may have computed again from its own parameters.
        if not np.allclose(got, wanted, rtol=1e-5, atol=1e-6):
            what = "the same scene, cameras and background"
            raise ValueError(f"{path}: must be of {what}, its {name} differs; write it anew from --export")
    for name, shape in shapes.items():
        got = arrays[name].squeeze(-1) if name == "alpha" and arrays[name].shape[-1:] == (1,) else arrays[name]
        if got.shape == shape and count == 1:
            got = got[None]
        if got.shape != (count, *shape):
            raise ValueError(f"{path}: {name} must have shape {(count, *shape)}, got {arrays[name].shape}")
        arrays[name] = got
    for name in PARAMETERS:
        if arrays[f"grad_{name}"].shape != scene[name].shape:
            wanted = scene[name].shape
            got = arrays[f"grad_{name}"].shape
            raise ValueError(f"{path}: grad_{name} must have shape {wanted}, got {got}")
    if pose and arrays[_POSE].reshape(-1).shape != scene["viewmat"].reshape(-1).shape:
        raise ValueError(f"{path}: {_POSE} must have shape {scene['viewmat'].shape}, got {arrays[_POSE].shape}")
    # Through float64 of this machine: files may have another byte order, which torch refuses.
    as_tensor = {name: torch.from_numpy(arrays[name].astype(np.float64)) for name in names if name not in scene}
    gradients = {name: as_tensor[f"grad_{name}"] for name in PARAMETERS}
    if pose:
        slopes = torch.from_numpy(arrays[_POSE].astype(np.float64)).reshape(count, 4, 4)
        gradients[POSE] = along_motions(g, cameras, slopes)
    return Dump(str(path), as_tensor["image"], as_tensor["alpha"], as_tensor["cotangent"], gradients)


def along_motions(g: Gaussians, cameras: list[Camera], slopes: torch.Tensor) -> torch.Tensor:
    """(C, 6) derivatives by the motions of `parameters.posed` of those by the entries of w2c, (C, 4, 4), of a world
    whose 0 is the origin of the Gaussians.
    """
    g, cameras = around_origin(g, cameras)
    rows = []
    for camera, slope in zip(cameras, slopes, strict=True):
        raw = with_pose(raw_of(g))
        raw[POSE].requires_grad_()
        rows.append(torch.autograd.grad(posed(raw, camera).w2c, raw[POSE], slope)[0])
    return torch.stack(rows)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file; nothing in it is executed."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a file, there is none")
    refuse_foreign(path, f"a {path.suffix} file of arrays")
    if path.stat().st_size > _LARGEST:
        raise ValueError(f"{path}: must have at most {_LARGEST >> 30} GiB, has {path.stat().st_size >> 30}")
    try:
        if path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            return load_file(path)
        check_npz(path)
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: must be a {path.suffix} file of arrays, got {one_line(error)}") from None


def one_line(error: Exception) -> str:
    """The first line of an error's text."""
    return (str(error).strip().splitlines() or ["without a message"])[0][:200]
