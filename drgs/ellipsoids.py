"""Gaussians: their parameters, activations, validation, and the Mitsuba shape that bounds them.

A Gaussian i has mean mu (3), quaternion q (wxyz, any length but 0), log-scale (3), logit-opacity (1), SH coefficients
(K, 3) with K = (degree + 1)^2, and optionally features (D). What is stored is what is optimized and differentiated:
the raw parameters. World frame and world units throughout; means are relative to `origin` (float64), so that a world
far from zero keeps its detail in float32.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch

from drgs.cameras.origins import origin_text
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.checks.derivatives import check_has_numbers, ends_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = [
    "LOGIT_ENDS",
    "Y_00",
    "DeformableScene",
    "Gaussians",
    "Scene",
    "check_any_scene",
    "check_gaussians",
    "colors_only",
    "ellipsoids_shape",
    "semi_axes",
    "sh_degree_of",
]

Y_00 = 0.28209479177387814  # the spherical harmonic of degree 0, sqrt(1 / (4 pi))
LOGIT_ENDS = (-151 * math.log(2), math.log(2**26 - 1))
"""Logits, -104.7 and 18.0, that an opacity of 0 and of 1 become where a file holds these: of 2^-151 and 1 - 2^-26, the
middle of what rounds to them in float32, so that `Gaussians.opacities` are 0 and 1."""
_FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh", "features")
_MAKE = "drgs.load_ply(path) or drgs.Gaussians.from_arrays(means, quats, scales, opacities, sh) makes one"
# float32 keeps 2^-24 of a coordinate: past this ratio of |mean| to scale the detail of a Gaussian is lost.
_FAR_RATIO = 1e5


def sh_degree_of(coefficients: int) -> int:
    """Degree 0..3 of `coefficients` = (degree + 1)^2; anything else raises ValueError."""
    degree = math.isqrt(coefficients) - 1
    if degree not in (0, 1, 2, 3) or (degree + 1) ** 2 != coefficients:
        raise ValueError(f"Gaussians: sh must have 1, 4, 9 or 16 coefficients (degree 0..3), got {coefficients}")
    return degree


def semi_axes(quats: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) R S of (N, 4) wxyz quaternions of any length and (N, 3) scales: columns are the semi-axes."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3) * scales[:, None, :]


@runtime_checkable
class Scene(Protocol):
    """What is rendered: Gaussians, or anything that has Gaussians at any time."""

    def at(self, time: float | None) -> Gaussians:
        """The Gaussians at the time of a view (`Camera.time`).

        None of a view that states no time: a scene that moves raises ValueError then.
        """

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors, by name, that `at` computes from and that an optimizer may change."""


@runtime_checkable
class DeformableScene(Scene, Protocol):
    """A scene whose Gaussians are a pure function of its parameters: these, too, have tangents and information.

    `render_jvp` takes tangents named after `parameters()`, and of the time; `fisher.diagonal` groups. Its J^T is
    torch's reverse mode through `deform`, unless it registers a faster one (`drgs.dynamics.jacobian.scene_jacobian`).
    """

    def deform(self, parameters: dict[str, torch.Tensor], time: float | torch.Tensor | None) -> Gaussians:
        """`at(time)` of a scene with these parameters, by operations that `torch.func` differentiates in both modes.

        The time is a number, or a float64 scalar where derivatives by it are wanted.
        """


@dataclasses.dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians as raw parameters (torch tensors on any device; autograd graphs are kept).

        g = drgs.Gaussians.from_arrays(means, quats, scales, opacities, sh)  # linear scales, opacities in (0, 1)
        bigger = g.replace(log_scales=g.log_scales + 0.1)

    Attributes:
        means: (N, 3) float32 or float64, relative to `origin`.
        quats: (N, 4) wxyz, unnormalized; q and s q (s != 0) are the same rotation.
        log_scales: (N, 3) natural logarithm of the standard deviations along the local axes.
        logit_opacities: (N,) logit of the opacity.
        sh: (N, K, 3), K in {1, 4, 9, 16}; color = max(0.5 + sum_k sh_k Y_k(direction), 0).
        features: (N, D) or None, composited with the weights of the color.
        origin: (3,) float64, added to the means.
    """

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor
    features: torch.Tensor | None = None
    origin: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name in _FIELDS:
            x = getattr(self, name)
            if x is None and name == "features":
                continue
            must_be("Gaussians", name, x, torch.Tensor, "Gaussians.from_arrays takes arrays too")
            if x.dtype not in (torch.float32, torch.float64):
                raise ArgumentError(f"Gaussians: {name} must be float32 or float64, got {x.dtype}; use {name}.float()")
            if x.device != self.means.device:
                raise ArgumentError(
                    f"Gaussians: all tensors must be on one device, got means on {self.means.device} and {name} on "
                    f"{x.device}; move them with .to()"
                )
        if self.means.ndim == 0:
            _check_shape("means", self.means, ("N", 3), 0)
        n = len(self.means)
        want = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        for name, shape in want.items():
            _check_shape(name, getattr(self, name), shape, n)
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            _check_shape("sh", self.sh, (n, "K", 3), n)
        sh_degree_of(self.sh.shape[1])
        if self.features is not None and (self.features.ndim != 2 or len(self.features) != n):
            _check_shape("features", self.features, (n, "D"), n)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def from_arrays(
        cls,
        means: ArrayLike,
        quats: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        sh: ArrayLike,
        features: ArrayLike | None = None,
        origin: ArrayLike | None = None,
    ) -> Gaussians:
        """Gaussians from the usual linear arrays.

        Args:
            means: (N, 3). float64 keeps its precision; float32 input far from 0 is warned about.
            quats: (N, 4) wxyz.
            scales: (N, 3) standard deviations, > 0.
            opacities: (N,) in (0, 1).
            sh: (N, K, 3), or (N, 3) for degree 0.
            features: (N, D) or None.
            origin: (3,) float64 that the means are relative to, or None for 0.
        Raises:
            ValueError: If a shape is wrong or a value is not finite or out of range (the first index is named).
        Gradients:
            Reach the tensors passed in: scales and opacities through their logarithm and logit.
        """
        means, quats, scales, opacities, sh = (
            _tensor(name, x)
            for name, x in zip(
                ("means", "quats", "scales", "opacities", "sh"),
                (means, quats, scales, opacities, sh),
                strict=True,
            )
        )
        if sh.ndim == 2:
            sh = sh[:, None, :]
        if opacities.ndim == 2 and opacities.shape[1] == 1:
            opacities = opacities[:, 0]
        _check_range("scales", scales, 0.0, math.inf, "log_scales are stored: scales must be linear and > 0")
        _check_range("opacities", opacities, 0.0, 1.0, "logits are stored: clamp to (0, 1)")
        made = cls(
            means,
            quats,
            torch.log(scales),
            torch.log(opacities) - torch.log1p(-opacities),
            sh,
            None if features is None else _tensor("features", features),
            np.zeros(3) if origin is None else np.asarray(origin, np.float64).reshape(3),
        )
        made.validate("Gaussians.from_arrays")
        if means.dtype == torch.float32 and len(made):
            with torch.no_grad():  # for a warning
                ratio = (means.abs().amax(1) / scales.amin(1)).max()
            if ratio > _FAR_RATIO:
                warnings.warn(
                    f"Gaussians.from_arrays: float32 means are up to {float(ratio):.1g} standard deviations from 0, "
                    "their detail is rounded away: pass float64 means, they are re-centered for each view",
                    stacklevel=2,
                )
        return made

    @property
    def sh_degree(self) -> int:
        """The degree of `sh`, 0 to 3."""
        return sh_degree_of(self.sh.shape[1])

    @property
    def scales(self) -> torch.Tensor:
        """(N, 3) standard deviations."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> torch.Tensor:
        """(N,) in (0, 1)."""
        return torch.sigmoid(self.logit_opacities)

    def at(self, time: float | None = None) -> Gaussians:
        """The Gaussians themselves, for they do not move: the `Scene` that is the same at all times."""
        return self

    def parameters(self) -> dict[str, torch.Tensor]:
        """The raw parameter tensors by group name; `features` only when there are any."""
        return {name: x for name in _FIELDS if (x := getattr(self, name)) is not None}

    def replace(self, **fields: Any) -> Gaussians:
        """A copy with the given fields replaced."""
        return dataclasses.replace(self, **fields)

    def to(self, device: str | torch.device) -> Gaussians:
        """The same values on another device; gradients pass, and tensors that are there already are not copied."""
        device = torch.device(device)
        return self.replace(**{name: x.to(device) for name, x in self.parameters().items()})

    def detach(self) -> Gaussians:
        """The same values without an autograd graph."""
        return self.replace(**{name: x.detach() for name, x in self.parameters().items()})

    def take(self, index: torch.Tensor | slice | Sequence[int]) -> Gaussians:
        """The Gaussians at `index` (anything that indexes a tensor), in that order."""
        return self.replace(**{name: x[index] for name, x in self.parameters().items()})

    def validate(self, where: str) -> None:
        """Raise ValueError, naming the first index, if a parameter is NaN or infinite or a quaternion is 0."""
        with torch.no_grad():  # a check, which leaves no graph
            for name, x in self.parameters().items():
                check_has_numbers(where, name, x)
                # One reduction decides, NaN passes through it; the index is looked for only if there is one to report.
                if x.numel() and not all(map(math.isfinite, ends_of(x))):
                    bad = ~torch.isfinite(x).reshape(len(x), -1).all(1)
                    if bool(bad.any()):
                        i = int(bad.nonzero()[0, 0])
                        raise ValueError(
                            f"{where}: {name} must be finite, got {x[i].reshape(-1)[:4].tolist()} at index {i} "
                            f"({int(bad.sum())} of {len(x)}); drop or repair these Gaussians"
                        )
            zero = self.quats.abs().amax(1) == 0 if len(self) else None
            if zero is not None and bool(zero.any()):
                i = int(zero.nonzero()[0, 0])
                raise ValueError(
                    f"{where}: quats must not be 0, got {self.quats[i].tolist()} at index {i}; use (1, 0, 0, 0)"
                )


def check_gaussians(where: str, gaussians: Any) -> None:
    """Raise `ArgumentError` unless these are Gaussians."""
    must_be(where, "gaussians", gaussians, Gaussians, _MAKE)


def check_any_scene(where: str, scene: Any) -> None:
    """Raise `ArgumentError` unless this is a `Scene`, which names its parameters (a torch Module does not)."""
    if not isinstance(scene, Scene):
        check_gaussians(where, scene)
    hint = "return {name: tensor}; a torch.nn.Module returns dict(self.named_parameters())"
    must_be(where, "scene.parameters()", scene.parameters(), Mapping, hint)


def colors_only(scene: Scene, time: float | None) -> Scene:
    """What is seen of a scene at a time without its features, which then cost nothing: itself if it has none."""
    seen = scene.at(time) if isinstance(scene, Scene) else scene  # `render` says what is wrong with anything else
    return scene if getattr(seen, "features", None) is None else seen.replace(features=None)


def _tensor(name: str, x: ArrayLike) -> torch.Tensor:
    """An argument of `from_arrays` as a float tensor; of arrays, only means keep float64."""
    if isinstance(x, torch.Tensor):
        check_has_numbers("Gaussians.from_arrays", name, x)
        return x if x.is_floating_point() else x.to(torch.float32)
    try:
        array = np.asarray(x)
    except ValueError:  # lists of different lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        raise ArgumentError(f"Gaussians.from_arrays: {name} must be an array of numbers, got {kind_of(x)}")
    dtype = np.float64 if array.dtype == np.float64 and name == "means" else np.float32
    return torch.from_numpy(np.ascontiguousarray(array, dtype))


def _check_shape(name: str, x: torch.Tensor, shape: tuple, n: int) -> None:
    if tuple(x.shape) != shape:
        want = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"Gaussians: {name} must have shape {want} with N = {n} from means, got {tuple(x.shape)}")


def _check_range(name: str, x: torch.Tensor, low: float, high: float, hint: str) -> None:
    with torch.no_grad():  # a check, which leaves no graph
        bad = ~((x > low) & (x < high)) if x.numel() else None
        if bad is not None and bool(bad.any()):
            i = int(bad.reshape(len(x), -1).any(1).nonzero()[0, 0])
            raise ValueError(
                f"Gaussians.from_arrays: {name} must be in ({low:g}, {high:g}), got "
                f"{x[i].reshape(-1).tolist()} at index {i}; {hint}"
            )


def ellipsoids_shape(gaussians: Gaussians, extent: float = 3.0) -> dict:
    """The Gaussians as a Mitsuba `ellipsoids` shape, for `mi.load_dict`.

    Args:
        gaussians: One Gaussian or more.
        extent: Radius in standard deviations that Mitsuba bounds them by (the integrator `drgs` uses its own).
    Returns:
        A dict with centers, scales, quaternions (xyzw, normalized) and the attributes `opacities` (N, 1) and
        `sh_coeffs` (N, 3 K) that the integrators `drgs` and `volprim_rf_basic` read. Values are detached. Mitsuba is
        float32: centers are relative to `gaussians.origin`, and so must sensors be
        (`camera.relative_to(gaussians.origin).to_mitsuba()`); an origin that is not 0 is warned about.
    Raises:
        ValueError: If there are no Gaussians (Mitsuba refuses an empty shape).
    """
    if len(gaussians) == 0:
        raise ValueError("ellipsoids_shape: Mitsuba must have at least one Gaussian, got 0")
    from drgs import runtime

    mi = runtime.mitsuba()
    g = gaussians.detach()  # Mitsuba takes values; gradients of its scene parameters are its own
    quats = torch.nn.functional.normalize(g.quats.double(), dim=1)[:, [1, 2, 3, 0]]
    if np.any(g.origin):
        warnings.warn(
            f"ellipsoids_shape: centers are relative to the Gaussians' origin {origin_text(g.origin)}, and so must "
            "sensors be: camera.relative_to(gaussians.origin).to_mitsuba()",
            stacklevel=2,
        )
    arrays = {
        "centers": g.means,
        "scales": g.scales,
        "quaternions": quats,
        "opacities": g.opacities[:, None],
        "sh_coeffs": g.sh.reshape(len(g), -1),
    }
    tensors = {k: mi.TensorXf(np.ascontiguousarray(v.cpu().numpy(), np.float32)) for k, v in arrays.items()}
    return {"type": "ellipsoids", "extent": extent, **tensors}
