"""Rasterizers to be compared: ours, gsplat, any torch function with gsplat's arguments, or what one wrote to a file.

Each is given raw parameters (drgs.ellipsoids) and a pinhole camera and returns an image that torch can differentiate;
activations (exp, sigmoid) are applied here, so that derivatives arrive at the raw parameters. A dump has an image and
gradients only: it cannot be asked again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import inspect
import sys
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians, sh_degree_of
from drgs.files import atomic_write
from drgs.guards.foreign import refuse_foreign
from drgs.integrator import render
from drgs.settings import PRESETS, RenderSettings

__all__ = ["PARAMETERS", "Dump", "Rasterizer", "cotangents", "export", "is_export", "load", "raw_of"]

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh")  # raw, as crossval and the ladder compare them
_DUMPS = (".npz", ".safetensors")
_EXPORT = "drgs_export"  # an array by which an export can be told from a dump, which holds more
_LARGEST = 4 << 30  # bytes of a dump


@dataclasses.dataclass(frozen=True)
class Rasterizer:
    """A function that draws.

    Attributes:
        name: As the user gave it.
        draw: (raw parameters by group, camera, background (3,)) -> image (H, W, 3), alpha (H, W); differentiable.
        dtype: Of the parameters that it is given.
        device: Where it wants them.
        preset: The preset that it is, if it is ours.
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
        return image.detach().double().cpu(), alpha.detach().double().cpu()

    def gradient(self, raw: dict, camera: Camera, background: tuple, cotangent: torch.Tensor) -> dict:
        """float64 gradient of <cotangent, image> by group; None where the image does not depend on it.

        Raises:
            ValueError: If torch finds no graph at all.
        """
        leaves = {name: x.requires_grad_() for name, x in self.taken(raw).items()}
        image, _ = self.draw(leaves, camera, background)
        if not image.requires_grad:
            raise ValueError(f"--rasterizer {self.name}: its image must be differentiable by torch, has no graph")
        loss = (image * cotangent.to(image)).sum()
        found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        return {name: None if x is None else x.detach().double().cpu() for name, x in zip(leaves, found, strict=True)}

    def taken(self, raw: dict) -> dict:
        """Copies of the parameters as it wants them."""
        return {name: x.detach().to(self.device, self.dtype, copy=True) for name, x in raw.items()}


@dataclasses.dataclass(frozen=True)
class Dump:
    """What a rasterizer wrote: see `load`.

    Attributes:
        name: The file.
        images, alphas: (C, H, W, 3) and (C, H, W) float64.
        cotangents: (C, H, W, 3).
        gradients: Group -> gradient of sum <cotangents, images>, raw parameters, all views together.
    """

    name: str
    images: torch.Tensor
    alphas: torch.Tensor
    cotangents: torch.Tensor
    gradients: dict


def raw_of(g: Gaussians) -> dict[str, torch.Tensor]:
    """Raw parameters in float64, world frame: what is differentiated."""
    raw = {name: getattr(g, name).detach().double().cpu() for name in PARAMETERS}
    raw["means"] = raw["means"] + torch.tensor(np.asarray(g.origin, float))
    return raw


def load(text: str, g: Gaussians | None = None, cameras: list[Camera] | None = None, fields: dict | None = None):
    """A rasterizer by its name.

    Args:
        text: `drgs:ewa` (preset gsplat) or `drgs:PRESET`; `gsplat`; `package.module:function`, a function with the
            argument names of gsplat's `rasterization` that returns (image (C,H,W,3), alpha (C,H,W,1), anything); or a
            file .npz or .safetensors with `image` (C,H,W,3), `alpha` (C,H,W), `cotangent` (C,H,W,3), `grad_means`,
            `grad_quats`, `grad_log_scales`, `grad_logit_opacities`, `grad_sh` (of raw parameters), and the arrays of
            the scene as `export` wrote them (C = 1 may be left out).
        g, cameras: What a dump must be of.
        fields: Settings that hold whatever the preset is: ours are drawn with them, a dump is of their background.
    Returns:
        A `Rasterizer` or a `Dump`.
    Raises:
        ValueError: If there is no such rasterizer, or a dump is damaged or of another scene; one line.
    """
    fields = fields or {}
    if Path(text).suffix in _DUMPS:
        return _dump(Path(text), g, cameras, tuple(fields.get("background", (0.0, 0.0, 0.0))))
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
        return function(rasterization, text)
    module, colon, attribute = text.partition(":")
    if not (colon and module and attribute):
        raise ValueError(
            f"--rasterizer {text}: must be drgs:PRESET, gsplat, package.module:function, or a file .npz or .safetensors"
        )
    if "" not in sys.path:  # a function beside the user, also when `drgs` is an installed script
        sys.path.insert(0, "")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:
        raise ValueError(f"--rasterizer {text}: must be importable, got {type(error).__name__}: {error}") from error
    if not callable(found):
        raise ValueError(f"--rasterizer {text}: {module} must have a function {attribute}, has none")
    return function(found, text)


def ours(settings: RenderSettings, name: str, preset: str | None = None) -> Rasterizer:
    """`drgs.render` with these settings."""

    def draw(raw: dict, camera: Camera, background: tuple):
        out = render(Gaussians(**raw), camera, settings.replace(background=background), outputs=())
        return out.rgb, out.alpha

    return Rasterizer(name, draw, torch.float64, "cpu", preset)


def function(call: Callable, name: str) -> Rasterizer:
    """A function with gsplat's argument names, in float64 if it takes that, on a card if there is one and it asks."""
    accepted = inspect.signature(call).parameters
    open_ended = any(p.kind is p.VAR_KEYWORD for p in accepted.values())

    def draw(raw: dict, camera: Camera, background: tuple):
        means = raw["means"]
        like = {"dtype": means.dtype, "device": means.device}
        arguments = {
            "means": means,
            "quats": raw["quats"],
            "scales": raw["log_scales"].exp(),
            "opacities": raw["logit_opacities"].sigmoid(),
            "colors": raw["sh"],
            "viewmats": _tensor(camera.w2c).to(**like)[None],
            "Ks": _tensor(camera.K).to(**like)[None],
            "width": camera.width,
            "height": camera.height,
        }
        options = {
            "sh_degree": sh_degree_of(raw["sh"].shape[1]),
            "backgrounds": torch.tensor([background], **like),
            "packed": False,
        }
        given = {k: v for k, v in options.items() if open_ended or k in accepted}
        try:
            returned = call(**arguments, **given)
        except Exception as error:
            raise ValueError(f"--rasterizer {name}: raised {type(error).__name__}: {_line(error)}") from error
        image, alpha = _checked(name, returned, camera)
        if "backgrounds" not in given:
            image = image + (1 - alpha[..., None]) * torch.tensor(background, **like)
        return image, alpha

    return Rasterizer(name, draw, *_taste(draw))


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
            with torch.no_grad():
                image, _ = draw({k: x.to(device, dtype) for k, x in raw.items()}, camera, (0.0, 0.0, 0.0))
            if image.dtype == dtype:
                return dtype, device
        except ValueError as error:
            problem = error
    if problem is not None:
        raise problem
    return torch.float32, "cpu"


def _checked(name: str, returned, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 3) and (H, W) of what a function returned."""
    if not isinstance(returned, tuple | list) or len(returned) < 2:
        got = type(returned).__name__
        raise ValueError(f"--rasterizer {name}: must return (image, alpha, info), got {got}")
    image, alpha = returned[:2]
    size = camera.height, camera.width
    for what, x, last in (("image", image, 3), ("alpha", alpha, 1)):
        if not isinstance(x, torch.Tensor):
            raise ValueError(f"--rasterizer {name}: its {what} must be a torch tensor, got {type(x).__name__}")
        if tuple(x.shape) not in ((1, *size, last), (*size, last)):
            wanted = f"(1, {size[0]}, {size[1]}, {last})"
            raise ValueError(f"--rasterizer {name}: its {what} must have shape {wanted}, got {tuple(x.shape)}")
    return image.reshape(*size, 3), alpha.reshape(size)


def _tensor(x) -> torch.Tensor:
    """Of a tensor, or of an array that may be read-only."""
    return x.detach() if isinstance(x, torch.Tensor) else torch.tensor(np.asarray(x))


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["without a message"])[0][:200]


# ------------------------------------------------------------------------------------------- dumps


def cotangents(cameras: list[Camera], seed: int) -> torch.Tensor:
    """(C, H, W, 3) of +-1: the mean square of an error of J^T u is the error's Frobenius norm squared.

    Raises:
        ValueError: If the cameras differ in size.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"crossval: cameras must have one image size, got {len(sizes)}; choose some with --limit")
    generator = torch.Generator().manual_seed(seed)
    shape = (len(cameras), *sizes.pop(), 3)
    return torch.randint(0, 2, shape, generator=generator).double() * 2 - 1


def scene_arrays(g: Gaussians, cameras: list[Camera], background: tuple) -> dict[str, np.ndarray]:
    """What tells a scene from another: float32 raw parameters, world frame, cameras and background."""
    arrays = {name: x.float().numpy() for name, x in raw_of(g).items()}
    arrays["viewmat"] = np.stack([_tensor(c.w2c).float().numpy() for c in cameras])
    arrays["K"] = np.stack([np.asarray(c.K, np.float32) for c in cameras])
    arrays["width"], arrays["height"] = np.int64(cameras[0].width), np.int64(cameras[0].height)
    arrays["background"] = np.asarray(background, np.float32)
    return arrays


def export(path: Path, g: Gaussians, cameras: list[Camera], background: tuple, seed: int) -> None:
    """Write the scene, its cameras and cotangents for a rasterizer on another machine (.npz).

    Arrays: `means` (N,3), `quats` (N,4), `log_scales` (N,3), `logit_opacities` (N,), `sh` (N,K,3), `viewmat` (C,4,4),
    `K` (C,3,3), `width`, `height`, `background` (3,), `cotangent` (C,H,W,3).
    """
    arrays = scene_arrays(g, cameras, background)
    arrays["cotangent"] = cotangents(cameras, seed).float().numpy()
    arrays[_EXPORT] = _signature(arrays)
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)


def is_export(path: Path) -> bool:
    """Whether `export` wrote a file; a dump that was made of one holds more arrays."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return np.array_equal(arrays[_EXPORT], _signature({*arrays.files} - {_EXPORT}))
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile):
        return False


def _signature(names: Iterable[str]) -> np.ndarray:
    """Of an export: numbers, for readers that make tensors of all that they find."""
    return np.frombuffer(hashlib.sha256(" ".join(sorted(names)).encode()).digest(), np.uint8)


def _dump(path: Path, g: Gaussians, cameras: list[Camera], background: tuple) -> Dump:
    found = _arrays(path)
    scene = scene_arrays(g, cameras, background)
    count, size = len(cameras), (cameras[0].height, cameras[0].width)
    shapes = {"image": (*size, 3), "alpha": size, "cotangent": (*size, 3)}
    names = [*shapes, *(f"grad_{name}" for name in PARAMETERS), *scene]
    if missing := [name for name in names if name not in found]:
        raise ValueError(f"{path}: must hold {', '.join(names)}; {missing[0]} is missing; write it anew from --export")
    for name, array in found.items():
        if name in names and not np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(np.atleast_1d(array)))[0])
            if not name.startswith("grad_"):  # a gradient that is not finite is a finding
                raise ValueError(f"{path}: {name} must be finite, is {np.atleast_1d(array)[index]} at {index}")
    for name, wanted in scene.items():
        got = found[name].reshape(wanted.shape) if found[name].size == wanted.size else found[name]
        if got.shape != wanted.shape:
            raise ValueError(f"{path}: {name} must have shape {wanted.shape}, got {got.shape}: it is of another scene")
        if not np.allclose(got, wanted, rtol=1e-5, atol=1e-6):
            what = "the same scene, cameras and background"
            raise ValueError(f"{path}: must be of {what}, its {name} differs; write it anew from --export")
    for name, shape in shapes.items():
        got = found[name].squeeze(-1) if name == "alpha" and found[name].shape[-1:] == (1,) else found[name]
        if got.shape == shape and count == 1:
            got = got[None]
        if got.shape != (count, *shape):
            raise ValueError(f"{path}: {name} must have shape {(count, *shape)}, got {found[name].shape}")
        found[name] = got
    for name in PARAMETERS:
        if found[f"grad_{name}"].shape != scene[name].shape:
            wanted, got = scene[name].shape, found[f"grad_{name}"].shape
            raise ValueError(f"{path}: grad_{name} must have shape {wanted}, got {got}")
    as_tensor = {name: torch.tensor(found[name], dtype=torch.float64) for name in names if name not in scene}
    gradients = {name: as_tensor[f"grad_{name}"] for name in PARAMETERS}
    return Dump(str(path), as_tensor["image"], as_tensor["alpha"], as_tensor["cotangent"], gradients)


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
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:
        raise ValueError(f"{path}: must be a {path.suffix} file of arrays, got {_line(error)}") from None
