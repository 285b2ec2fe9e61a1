"""The float64 oracles, `reference` and `volume`, and their common parts: activated Gaussians, rays of a camera, colors.

Torch in float64; autograd gives the gradients of whatever is built on it. The room stands below the engine and imports
nothing of it, so that what is checked cannot be borrowed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch

from drgs.cameras import check_camera, rigid
from drgs.checks.arguments import ArgumentError
from drgs.checks.derivatives import refuse_meta
from drgs.ellipsoids import check_gaussians
from drgs.settings import RenderSettings, check_settings


@dataclasses.dataclass(frozen=True)
class Footprints:
    """Gaussians on the image plane, for `ewa`; N of them.

    Attributes:
        means: (N, 2) projected means, pixels.
        rows: (N, 2, 3) rows of J W R S, pixels: the semi-axes as the local affine approximation projects them.
        diagonal: (N, 2) diagonal of Sigma', dilation included, px^2.
    """

    means: torch.Tensor
    rows: torch.Tensor
    diagonal: torch.Tensor

    def take(self, keep: torch.Tensor) -> Footprints:
        """The footprints at `keep`, a mask or an index."""
        return Footprints(self.means[keep], self.rows[keep], self.diagonal[keep])


@dataclasses.dataclass(frozen=True)
class Tiles:
    """The tiles that a rasterizer looks for Gaussians in; N of them.

    Attributes:
        size: Pixels of a tile in a row.
        ranges: Three pairs (first, last) of (N, 2) tile coordinates, `last` exclusive: shrunk by the tolerance, exact,
            grown by it.
    """

    size: int
    ranges: list[tuple[torch.Tensor, torch.Tensor]]

    def take(self, keep: torch.Tensor) -> Tiles:
        """The ranges at `keep`, a mask or an index."""
        return Tiles(self.size, [(first[keep], last[keep]) for first, last in self.ranges])


@dataclasses.dataclass(frozen=True)
class OracleScene:
    """Activated Gaussians in float64, in a world whose 0 is their origin; N of them are left.

    Attributes:
        means: (N, 3) world units.
        axes: (N, 3, 3), columns are the semi-axes R S.
        whiten: (N, 3, 3) S^-1 R^T, from world axes to the local frame.
        width: (N,) largest scale, a number: relative to it products of scales do not underflow.
        adjugate: (N, 3, 3) s_1 s_2 s_3 S^-1 R^T of scales relative to `width`, of their products: right for discs,
            which `whiten` is not.
        volume: (N,) s_1 s_2 s_3 of scales relative to `width`.
        logits: (N,) raw opacities.
        softplus: (N,) softplus(logit), the optical depth of a full pass through the center.
        sh: (N, K, 3) coefficients.
        features: (N, D), or None.
        middle: (3,) about where world coordinates are rounded: the mean of float64 means, 0 of float32 ones.
        extent: (N,) cut-off radius in standard deviations; where settings have none, so large that nothing is cut off.
        index: (N,) places among the Gaussians that were passed in.
        colors: (N, 3) where they are those towards the means; None where they depend on the ray.
        near_margin: (N,) z / near - 1, where means behind `near` were culled; else None.
        screen: Footprints on the image plane, of `ewa`; else None.
        tiles: Tiles that Gaussians are culled to; None without such culling.
    """

    means: torch.Tensor
    axes: torch.Tensor
    whiten: torch.Tensor
    width: torch.Tensor
    adjugate: torch.Tensor
    volume: torch.Tensor
    logits: torch.Tensor
    softplus: torch.Tensor
    sh: torch.Tensor
    features: torch.Tensor | None
    middle: list[float]
    extent: torch.Tensor
    index: torch.Tensor
    colors: torch.Tensor | None = None
    near_margin: torch.Tensor | None = None
    screen: Footprints | None = None
    tiles: Tiles | None = None

    def take(self, keep: torch.Tensor) -> OracleScene:
        """The Gaussians at `keep`, a mask or an index."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        taken: dict[str, Any] = {name: x[keep] for name, x in fields.items() if isinstance(x, torch.Tensor)}
        parts = {"screen": self.screen, "tiles": self.tiles}
        taken |= {name: part.take(keep) for name, part in parts.items() if part is not None}
        return dataclasses.replace(self, **taken)

    def colored(self, center: torch.Tensor) -> OracleScene:
        """The scene with the colors towards the means from a camera's center (3,)."""
        return dataclasses.replace(self, colors=sh_colors(self.sh, self.means - center))


@dataclasses.dataclass(frozen=True)
class OracleRays:
    """The rays to render, in the frame that the Gaussians' origin is 0 of; P of them.

    Attributes:
        rotation: (3, 3) of w2c, of a rolling shutter in the middle of the exposure, and
        center: (3,) of that camera; None without a camera, and then nobody reads them.
        origins: (P, 3) world units.
        directions: (P, 3) unit length.
        pixels: (P, 2) pixel centers; 0 for rays of no camera.
        shape: Shape of the image or of the rays.
    """

    rotation: torch.Tensor | Any
    center: torch.Tensor | Any
    origins: torch.Tensor
    directions: torch.Tensor
    pixels: torch.Tensor
    shape: tuple[int, ...]


# Standard deviations, beyond which there is at most exp(-40.5) = 3e-18 of an opacity: float64 ends at 1e-16.
_NO_EXTENT = 9.0
_COLUMNS = ("rolling_left_to_right", "rolling_right_to_left")
_BACKWARD = ("rolling_bottom_to_top", "rolling_right_to_left")
_GLOBAL = {"shutter": "global", "w2c_end": None}


def sh_basis(dirs: torch.Tensor, K: int) -> torch.Tensor:
    """(..., K) real spherical harmonics of (..., 3) unit directions, K = 1, 4, 9 or 16.

    3DGS order and sign: by degree, then m = -l..l; odd m carry the sign (-1)^m.
    """
    x, y, z = dirs.unbind(-1)
    basis = [torch.full_like(x, math.sqrt(1 / (4 * math.pi)))]
    if K > 1:
        c = math.sqrt(3 / (4 * math.pi))
        basis += [-c * y, c * z, -c * x]
    if K > 4:
        c = math.sqrt(15 / (4 * math.pi))
        zonal = c / math.sqrt(12) * (2 * z * z - x * x - y * y)
        basis += [c * x * y, -c * y * z, zonal, -c * x * z, c / 2 * (x * x - y * y)]
    if K > 9:
        c3, c2, c1, c0 = (math.sqrt(v / math.pi) for v in (35 / 32, 105 / 4, 21 / 32, 7 / 16))
        outer = 4 * z * z - x * x - y * y
        basis += [-c3 * y * (3 * x * x - y * y), c2 * x * y * z, -c1 * y * outer]
        basis += [c0 * z * (2 * z * z - 3 * x * x - 3 * y * y), -c1 * x * outer]
        basis += [c2 / 2 * z * (x * x - y * y), -c3 * x * (x * x - 3 * y * y)]
    return torch.stack(basis, dim=-1)


def float64(x: Any) -> torch.Tensor:
    """A tensor keeps its graph, anything else is copied."""
    if isinstance(x, torch.Tensor):
        return x.to("cpu", torch.float64)
    return torch.tensor(x, dtype=torch.float64)


def activate(g: Any, s: RenderSettings) -> OracleScene:
    """Activated parameters in float64, relative to the Gaussians' origin; `view_rays` says where that is."""
    raw = (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)
    means, quats, log_scales, logits, sh = map(float64, raw)
    n = len(means)
    rotation = _rotations(*(quats / quats.norm(dim=-1, keepdim=True)).unbind(-1))
    softplus = torch.logaddexp(logits, torch.zeros_like(logits))
    extent = torch.full((n,), s.extent or _NO_EXTENT, dtype=torch.float64)
    if s.extent is None and s.order == "entry":
        extent = _entered(torch.sigmoid(logits) if s.response == "peak" else softplus)
    scales = log_scales.exp()
    width = scales.detach().amax(1)
    relative = scales / width[:, None]
    others = relative[:, [1, 2, 0]] * relative[:, [2, 0, 1]]
    return OracleScene(
        means=means,
        axes=rotation * scales[:, None, :],
        whiten=(-log_scales).exp()[:, :, None] * rotation.transpose(1, 2),
        width=width,
        adjugate=others[:, :, None] * rotation.transpose(1, 2),
        volume=relative.prod(1),
        logits=logits,
        softplus=softplus,
        sh=sh,
        features=None if g.features is None else float64(g.features),
        # Float64 means are moved to their middle before they are rounded to float32; a number, no derivative.
        middle=means.detach().mean(0).tolist() if n and g.means.dtype == torch.float64 else [0.0, 0.0, 0.0],
        extent=extent,
        index=torch.arange(n),
    )


def _rotations(w: torch.Tensor, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) of unit quaternions, whose parts are (N,)."""
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def _entered(strength: torch.Tensor) -> torch.Tensor:
    """(N,) radii r of the ellipsoids whose entry points order hits, in standard deviations: with N times a strength, or
    1 if that is less, strength (1 + r^2) exp(-r^2 / 2) = 1e-5.
    """
    # Which hit comes first has no derivative.
    least = torch.log((strength.detach() * len(strength)).clamp(min=1) / 1e-5)
    half = least
    for _ in range(4):
        half = least + torch.log1p(2 * half)
    return (2 * half).sqrt()


def scale_and_shift(cam: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """The part (2, 2) of K that acts on x/z and y/z, skew included, and the principal point (2,), both in pixels.

    Raises:
        ValueError: If the last row of K is not 0 0 1: that is no camera with its axis along z.
    """
    K = float64(cam.K).detach()  # intrinsics are not differentiated
    if tuple(K.shape) != (3, 3) or K[2].tolist() != [0, 0, 1]:
        raise ValueError(f"reference: K must be (3, 3) with last row 0 0 1, got {K.tolist()}; see drgs.Camera")
    return K[:2, :2], K[:2, 2]


def camera_rays(cam: Any, rotation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel centers (H*W, 2) and directions (H*W, 3) in camera axes; of a lens by the camera's, whose pose `rotation`
    undoes.
    """
    v, u = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (cam.height, cam.width))
    u, v = u.repeat(cam.height), v.repeat_interleave(cam.width)  # rows of the image
    if getattr(cam, "model", "pinhole") == "pinhole":
        scale, shift = scale_and_shift(cam)
        plane = torch.linalg.solve(scale, (torch.stack([u, v], dim=-1) - shift).T).T
        local = torch.cat([plane, torch.ones_like(u)[:, None]], dim=-1)
    else:
        # The lens acts in the camera frame: only the rotation out of it carries the pose gradient.
        still = cam if getattr(cam, "shutter", "global") == "global" else dataclasses.replace(cam, **_GLOBAL)
        local = float64(still.pixel_directions()).reshape(-1, 3) @ rotation.detach().T
    return torch.stack([u, v], dim=-1), local


def rolling_poses(cam: Any, origin: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation (P, 3, 3) and translation (P, 3) of w2c for each pixel of a rolling shutter, and, last, in the middle of
    the exposure: rotations by slerp of unit quaternions, translations linearly (shutters.py). Of a world whose 0 is
    `origin` (3,), by default the camera's.
    """
    (R0, t0), (R1, t1) = (rigid(float64(pose)) for pose in (cam.w2c, cam.w2c_end))
    if origin is not None:
        t0, t1 = t0 + R0 @ origin, t1 + R1 @ origin
    row, column = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64) for n in (cam.height, cam.width)), indexing="ij"
    )
    line, count = (column, cam.width) if cam.shutter in _COLUMNS else (row, cam.height)
    times = line / (count - 1) if count > 1 else torch.full_like(line, 0.5)
    times = 1 - times if cam.shutter in _BACKWARD else times
    times = torch.cat([times.reshape(-1), torch.tensor([0.5], dtype=torch.float64)])
    turn = R1 @ R0.T
    # The quaternion of a turn by less than half a circle has a positive first entry.
    w = (1 + turn.diagonal().sum()).sqrt() / 2
    v = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (4 * w)
    squared = (v * v).sum()
    still = squared.detach() < 1e-16  # no turn: slerp is linear there
    length = torch.where(still, 1.0, squared).sqrt()
    half = torch.atan2(length, w) * times
    w = torch.where(still, torch.ones_like(times), half.cos())
    x, y, z = (torch.where(still, times * c, half.sin() * c / length) for c in v)
    return _rotations(w, x, y, z) @ R0, (1 - times)[:, None] * t0 + times[:, None] * t1


def cull_near(
    scene: OracleScene, rotation: torch.Tensor, center: torch.Tensor, s: RenderSettings, tolerance: float
) -> OracleScene:
    """Without the means with camera z <= near; those within the tolerance stay, for `ambiguous`."""
    z = ((scene.means - center) @ rotation[2]).detach()  # culling has no derivative
    if s.near > 0:
        return dataclasses.replace(scene, near_margin=z / s.near - 1).take(z > s.near * (1 - tolerance))
    return scene.take(z > 0) if s.planar else scene


def screen_rows(
    x: torch.Tensor,
    y: torch.Tensor,
    z: torch.Tensor,
    cam: Any,
    fov_clamp: str,
    rotation: torch.Tensor,
    axes: torch.Tensor,
) -> torch.Tensor:
    """(N, 2, 3) rows of J W R S: semi-axes (N, 3, 3) projected by the local affine approximation of the perspective.

    Args:
        x, y, z: (N,) means in the camera's frame.
        cam: Camera that has `K`, `width` and `height`.
        fov_clamp: `RenderSettings.fov_clamp`.
        rotation: (3, 3) of w2c.
        axes: (N, 3, 3) semi-axes in its columns, world axes.
    """
    scale, shift = scale_and_shift(cam)
    slopes = []
    axes_of = zip((x / z, y / z), scale.diagonal(), shift, (cam.width, cam.height), strict=True)
    for slope, f, c, size in axes_of:  # no rasterizer's clamp knows of skew
        tan = size / (2 * f)
        if fov_clamp == "inria":
            slope = slope.clamp(-1.3 * tan, 1.3 * tan)
        elif fov_clamp == "gsplat":
            slope = slope.clamp(-(c / f + 0.3 * tan), (size - c) / f + 0.3 * tan)
        slopes.append(slope)
    jacobian = [1 / z, 0 * z, -slopes[0] / z, 0 * z, 1 / z, -slopes[1] / z]
    return scale @ torch.stack(jacobian, dim=-1).reshape(-1, 2, 3) @ rotation @ axes


def sh_colors(sh: torch.Tensor, towards: torch.Tensor) -> torch.Tensor:
    """max(0.5 + SH, 0) of coefficients (N, K, 3) for directions (..., N, 3) of any length."""
    length = towards.norm(dim=-1, keepdim=True)
    if sh.shape[1] == 1:  # no direction, so no gradient to it either
        towards = torch.zeros(1, 3, dtype=torch.float64)
        length = torch.ones(1, 1)
    basis = sh_basis(towards / torch.where(length > 0, length, 1.0), sh.shape[1])
    return (0.5 + (basis[..., None] * sh).sum(-2)).clamp(min=0)


def view_rays(g: Any, cam: Any, rays: Sequence | None, window: Sequence[int] | None = None) -> OracleRays:
    """The rays of a camera, or those that are given.

    Args:
        g: Gaussians, whose origin is read.
        cam, rays: The arguments of `reference.render`.
        window: (x, y, width, height) in pixels: only these pixels of the camera's image.
    """
    offset = float64(getattr(g, "origin", (0, 0, 0)))
    rotation: torch.Tensor | Any = None  # Any: no camera, no pose, and then it is not read
    center: torch.Tensor | Any = None
    rolling = cam is not None and getattr(cam, "shutter", "global") != "global"
    if rolling:
        turns, translations = rolling_poses(cam, offset)
        rotation = turns[-1]
        center = -rotation.T @ translations[-1]
    elif cam is not None:
        rotation, translation = rigid(float64(cam.w2c))
        center = -rotation.T @ translation - offset
    if rays is None:
        pixels, local = camera_rays(cam, rigid(float64(cam.w2c))[0])
        if rolling:
            directions = torch.einsum("pj,pjk->pk", local, turns[:-1])
            origins = -torch.einsum("pj,pjk->pk", translations[:-1], turns[:-1])
        else:
            directions = local @ rotation
            origins = center.expand_as(directions)
        shape = (cam.height, cam.width)
        if window is not None:
            x, y, width, height = window
            inside = torch.arange(cam.height * cam.width).reshape(shape)[y : y + height, x : x + width]
            if min(x, y) < 0 or tuple(inside.shape) != (height, width) or not inside.numel():
                raise ValueError(
                    f"window: must lie in the image of {cam.width}x{cam.height} pixels, got x, y, width, height = "
                    f"{tuple(window)}; correct it"
                )
            shape = (height, width)
            inside = inside.reshape(-1)
            pixels, origins, directions = pixels[inside], origins[inside], directions[inside]
    else:
        if window is not None:
            raise ValueError("window: must come with a camera's own rays, got rays; choose among them instead")
        pair = torch.broadcast_tensors(*map(float64, rays))
        shape = pair[0].shape[:-1]
        origins = pair[0].reshape(-1, 3) - offset
        directions = pair[1].reshape(-1, 3)
        pixels = torch.zeros(len(directions), 2, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return OracleRays(rotation, center, origins, directions, pixels, tuple(shape))


def within(scene: OracleScene, reach: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """(N,) bool, False only where no ray, extended to both sides, comes within `reach` (N,) sigma of a mean.

    Compares each bounding sphere with the cone around the rays; rays without a common origin keep all.
    """
    # What is left out has no derivative; 1e-300 keeps 0 / 0 out of directions that do not matter.
    n = len(scene.means)
    o = origins.detach()
    d = directions.detach()
    if not len(d) or not bool((o == o[:1]).all()):
        return torch.ones(n, dtype=torch.bool)
    axis = d.mean(0)
    axis = axis / axis.norm().clamp(min=1e-300)
    # The chord keeps the digits of small angles that a cosine loses.
    half = 2 * torch.asin(((d - axis).norm(dim=1).max() / 2).clamp(max=1))
    away = scene.means.detach() - o[0]  # as above, down to the margin of 1e-9 radians for rounding
    angle = torch.atan2(torch.linalg.cross(away, axis.expand_as(away)).norm(dim=1), (away @ axis).abs())
    # No derivative, and no 0 / 0, as above.
    radius = reach * scene.axes.detach().norm(dim=1).amax(1)
    spread = torch.asin((radius / away.norm(dim=1).clamp(min=1e-300)).clamp(max=1))
    return (angle - spread <= half + 1e-9) | (half > 1.5)


def check_oracle(where: str, gaussians: Any, camera: Any, settings: Any) -> None:
    """What the oracles need, which take anything that has the fields of Gaussians and of a Camera."""
    if hasattr(camera, "log_scales"):
        raise ArgumentError(f"{where}: gaussians must come first and the camera second, got them swapped; swap them")
    if not hasattr(gaussians, "log_scales"):
        check_gaussians(where, gaussians)
    if camera is not None and not hasattr(camera, "w2c"):
        check_camera(where, camera)
    check_settings(where, settings)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh", "features"):
        if isinstance(x := getattr(gaussians, name, None), torch.Tensor):
            refuse_meta(where, name, x)
