"""The float64 oracle: every ray against every Gaussian, from the equations, not from the fast code.

All (ray, Gaussian) pairs are evaluated densely with torch in float64, so that torch.autograd gives
the gradients; nothing is left out except where a setting says so. Ray `o + t d` with |d| = 1,
local frame `o' = S^-1 R^T (o - mu)`, `d' = S^-1 R^T d`, peak `t* = -o'.d' / d'.d'`,
`rho^2 = |o' x d'|^2 / |d'|^2`, `a` opacity of a hit, `w = a T` its weight. Which hits exist
and how they are ordered carries no gradient; results that hang on that are marked `ambiguous`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from drgs.cameras import rigid
from drgs.oracle import (
    Footprints,
    OracleRays,
    OracleScene,
    Tiles,
    activate,
    camera_rays,
    check_oracle,
    cull_near,
    float64,
    scale_and_shift,
    screen_rows,
    sh_colors,
    view_rays,
    within,
)
from drgs.settings import EPS_ALPHA, RenderSettings

_TILE = 16  # pixels; both rasterizers' tile size
_FLOAT32 = 2.0**-23  # of a coordinate: twice what rounding it to float32 changes
_FLOAT64 = 2.0**-50  # as much, of the few operations that a pose takes
_PAIRS = 1 << 19  # (ray, Gaussian) pairs held at once: about 0.3 GB of intermediates


@dataclasses.dataclass
class ReferenceOutput:
    """What `render` returns; (H, W) stands for the shape of the rays where rays are given.

    Attributes:
        rgb: (H, W, 3), background included.
        alpha: (H, W), 1 - T behind the last hit.
        depth: (H, W) sum(w t*) / max(alpha, EPS_ALPHA), world units (`ewa`: t* is the order key).
        median_depth: (H, W) t* of the hit where T first falls to 0.5 or below; 0 where never.
        count: (H, W) int64, hits composited.
        visibility: (N,) sum of w over all rays.
        features: (H, W, D) composited like the color, without background; None without features.
        ambiguous: (H, W) bool, the result hangs on a near tie (see `render`).
    """

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    median_depth: torch.Tensor
    count: torch.Tensor
    visibility: torch.Tensor
    features: torch.Tensor | None
    ambiguous: torch.Tensor


def render(
    g: Any,
    cam: Any,
    settings: RenderSettings,
    rays: tuple[torch.Tensor, torch.Tensor] | None = None,
    tolerance: float = 1e-5,
    window: tuple[int, int, int, int] | None = None,
    exact_ties: bool = False,
    effect: float = 1e-7,
    plain_directions: bool = False,
    peaks_behind: bool = False,
) -> ReferenceOutput:
    """Renders by brute force in float64.

    Args:
        g: Anything with `means` (N,3), `quats` (N,4) wxyz, `log_scales` (N,3), `logit_opacities`
            (N,), `sh` (N,K,3), `features` (N,D) or None, and maybe `origin` (3,). Gradients reach
            these tensors.
        cam: Anything with `K`, `w2c`, `width`, `height` as `drgs.Camera`. A torch `w2c` (4,4) gets
            a gradient along rigid motions, as it is read as one (`cameras.rigid`). With `rays` it
            only gives the center for `order="center"` and SH directions and may be None: then that
            center is each ray's own origin.
        settings: The `RenderSettings`; `traversal` plays no role here, and without an `extent` none cuts anything off
            (of order `entry` it is the adaptive one, whose ellipsoids are entered).
        rays: Origins and directions, (..., 3) each, in place of the camera's; not for `ewa`.
        tolerance: A pixel is `ambiguous` when rounding could move a weight by more than `effect`:
            neighbors in the order have keys closer than `tolerance` times the distance (exact ties
            are safe, the index decides; see `exact_ties`), or a hit or T is within a relative `tolerance` of a
            cut-off, clamp, tile border or of T = 0.5. So is a peak that float32 coordinates of the mean and of the
            ray's origin may put before or behind it, as that of a mean at the eye.
        window: (x, y, width, height) in pixels: only these of the camera's image. Unlike a camera with a shifted
            principal point it keeps the tiles and the field-of-view clamp of the whole image. Gaussians that none of
            its rays can meet are left out first, which changes nothing but the time.
        exact_ties: Keys that are equal make a pixel `ambiguous`, too: a renderer that rounds in another way, or sorts
            without the index, may have either order.
        effect: The change of a weight that matters to `ambiguous`.
        plain_directions: Whether rho^2 is |o' x d'|^2, not divided by |d'|^2, as of a rasterizer that does not
            normalize d' (`peak` without a window only).
        peaks_behind: Whether peaks behind the origin of a ray count, too (`peak` only).
    Returns:
        `ReferenceOutput` in float64. `count` sees hits far below 1e-7, which `ambiguous` does not.
    Raises:
        ValueError: If `ewa` meets rays or distortion, or a camera is needed and missing.
    """
    check_oracle("reference.render", g, cam, settings)
    form = _form_of(settings, window, plain_directions, peaks_behind)
    _check_rays(cam, settings, rays)
    scene, view = _prepared(g, cam, settings, rays, window, tolerance)
    job = _Job(scene, settings, form, view.rotation, view.center, tolerance, exact_ties, effect)
    step = max(1, _PAIRS // max(len(scene.index), 1))
    parts = []
    for i in range(0, max(len(view.directions), 1), step):
        rays_of_part = [x[i : i + step] for x in (view.origins, view.directions, view.pixels)]
        # Recomputing a chunk in the backward pass keeps memory bounded by one chunk.
        if torch.is_grad_enabled() and len(view.directions) > step:
            parts.append(checkpoint(_composite, job, *rays_of_part, use_reentrant=False))
        else:
            parts.append(_composite(job, *rays_of_part))
    seen = sum(part.pop("visibility") for part in parts)
    fields: dict[str, Any] = dict.fromkeys(parts[0])
    for name in (name for name in fields if parts[0][name] is not None):
        joined = torch.cat([part[name] for part in parts])
        fields[name] = joined.reshape(*view.shape, *joined.shape[1:])
    seen = torch.zeros(len(g.means), dtype=torch.float64).index_add(0, scene.index, seen)
    return ReferenceOutput(visibility=seen, **fields)


def _form_of(s: RenderSettings, window: tuple | None, plain_directions: bool, peaks_behind: bool) -> _Peak:
    """The equations of the settings' response.

    Raises:
        ValueError: If there are none, or not with the options of `render`.
    """
    if s.response not in _FORMS:
        raise ValueError(
            f"reference.render: response must be one of {', '.join(_FORMS)}, got {s.response!r}; add its equations to "
            "drgs.oracle.reference._FORMS"
        )
    if not (plain_directions or peaks_behind):
        return _FORMS[s.response]
    if s.response != "peak" or (plain_directions and window is not None):
        raise ValueError(
            f"reference.render: plain_directions and peaks_behind need response='peak' and no window, got "
            f"{s.response!r} and {window}"
        )
    return _OddPeak(plain_directions, not peaks_behind)


def _check_rays(cam: Any, s: RenderSettings, rays: tuple | None) -> None:
    """Raise ValueError where settings do not go with rays, or with the camera that they have."""
    if s.planar and (
        rays is not None
        or getattr(cam, "model", "pinhole") != "pinhole"
        or getattr(cam, "shutter", "global") != "global"
    ):
        raise ValueError("reference.render: 'ewa' needs a pinhole camera, got a lens, a rolling shutter or rays")
    if s.culling == "ut" and cam is None:
        raise ValueError("reference.render: culling='ut' needs the pixels of a camera, got rays")
    if cam is None and (rays is None or s.near > 0 or s.depth_key == "z"):
        raise ValueError("reference.render: near, depth_key='z', images need cam, got None")


def _prepared(
    g: Any, cam: Any, s: RenderSettings, rays: tuple | None, window: tuple | None, tolerance: float
) -> tuple[OracleScene, OracleRays]:
    """The Gaussians that may be met, activated and projected, and the rays."""
    scene = activate(g, s)
    view = view_rays(g, cam, rays, window)
    if s.culling == "ut" and rays is not None:
        if view.shape != (cam.height, cam.width):
            raise ValueError(f"reference.render: culling='ut' needs a ray a pixel of cam, got shape {view.shape}")
        view = dataclasses.replace(view, pixels=camera_rays(cam, rigid(float64(cam.w2c))[0])[0])
    if cam is not None:
        scene = cull_near(scene, view.rotation, view.center, s, tolerance)
    if s.planar:
        screen, tiles = _project(scene, cam, view.rotation, view.center, s, tolerance)
        scene = dataclasses.replace(scene, screen=screen, tiles=tiles)
    elif s.culling == "ut":
        offset = float64(getattr(g, "origin", (0, 0, 0)))
        scene = dataclasses.replace(scene, tiles=_unscented(scene, cam, view, offset, tolerance))
    if window is not None:
        scene = _in_window(scene, s, view, window, tolerance)
    if s.sh_direction == "gaussian" and view.center is not None:
        scene = scene.colored(view.center)
    return scene, view


def _project(
    scene: OracleScene, cam: Any, rotation: Tensor, center: Tensor, s: RenderSettings, tolerance: float
) -> tuple[Footprints, Tiles | None]:
    """Gaussians on the image plane, and the tiles that each is culled to."""
    scale, shift = scale_and_shift(cam)
    x, y, z = ((scene.means - center) @ rotation.T).unbind(-1)
    mean2d = torch.stack([x / z, y / z], dim=-1) @ scale.T + shift
    rows = screen_rows(x, y, z, cam, s.fov_clamp, rotation, scene.axes)
    diagonal = rows.square().sum(-1) + s.dilation
    if s.culling == "extent":
        return Footprints(mean2d, rows, diagonal), None
    # Culling has no derivative.
    m = mean2d.detach()
    cov = diagonal.detach()
    alpha = torch.sigmoid(scene.logits.detach())
    bounds = []
    for slack in (-tolerance, 0.0, tolerance):
        if s.culling == "inria":
            # 0.1 is the rasterizer's own floor; no derivative, as above.
            mid = cov.mean(-1)
            det = cov.prod(-1) - rows.detach().prod(1).sum(-1) ** 2
            largest = mid + (mid * mid - det).clamp(min=0.1).sqrt()
            radius = torch.ceil(3 * largest.sqrt() * (1 + slack))[:, None]
            # A pixel is at its integer there, hence the half.
            first = torch.floor((m - 0.5 - radius) / _TILE - slack)
            last = torch.floor((m - 0.5 + radius + _TILE - 1) / _TILE + slack)
        else:
            sigmas = (2 * torch.log((255 * alpha).clamp(min=1))).sqrt().clamp(max=3.33)
            radius = torch.ceil(sigmas[:, None] * cov.sqrt() * (1 + slack))
            first = torch.floor((m - radius) / _TILE - slack)
            last = torch.ceil((m + radius) / _TILE + slack)
            last = torch.where((255 * alpha < 1 - slack)[:, None], first, last)
        bounds.append((first, last))
    return Footprints(mean2d, rows, diagonal), Tiles(_TILE, bounds)


def _unscented(scene: OracleScene, cam: Any, view: OracleRays, offset: Tensor, tolerance: float) -> Tiles:
    """The tiles of gsplat's 3DGUT: of the box of the mean and covariance that the unscented transform finds on the
    image, with alpha = 0.1, beta = 2, kappa = 0 for three dimensions, hence lambda = alpha^2 3 - 3; opacities fainter
    by the square root of the ratio of its determinants without and with dilation, no less than 0.005.
    """
    alpha, beta, dimensions = 0.1, 2.0, 3
    lamb = alpha**2 * dimensions - dimensions
    means = scene.means.detach()  # culling has no derivative
    steps = math.sqrt(dimensions + lamb) * scene.axes.detach().transpose(1, 2)  # nor has this
    points = torch.cat([means[:, None], means[:, None] + steps, means[:, None] - steps], 1).reshape(-1, 3)
    if getattr(cam, "model", "pinhole") == "pinhole" and getattr(cam, "shutter", "global") == "global":
        scale, shift = scale_and_shift(cam)
        local = (points - view.center.detach()) @ view.rotation.detach().T  # nor have boxes, as above
        pixels = local[:, :2] / local[:, 2:] @ scale.T + shift
        seen = local[:, 2] > 0
    else:
        pixels, z = (torch.from_numpy(x) for x in cam.relative_to(offset.numpy()).project(points.numpy()))
        seen = torch.isfinite(pixels).all(-1) & ((z > 0) | (cam.model != "pinhole"))
    pixels = torch.where(seen[:, None], pixels, 0.0).reshape(-1, 7, 2)
    size = torch.tensor([cam.width, cam.height], dtype=torch.float64)
    inside = ((pixels >= -0.1 * size) & (pixels < 1.1 * size)).all(-1)
    weights = torch.full((7,), 0.5 / (dimensions + lamb), dtype=torch.float64)
    weights[0] = lamb / (dimensions + lamb)
    middle = torch.einsum("k,nki->ni", weights, pixels)
    weights[0] += 1 - alpha**2 + beta
    off = pixels - middle[:, None]
    sharp = torch.einsum("k,nki,nkj->nij", weights, off, off)
    cov = sharp + 0.3 * torch.eye(2, dtype=torch.float64)
    det = torch.linalg.det(cov)
    shrunk = (torch.linalg.det(sharp) / det).clamp(min=0.005**2).sqrt()
    opacity = torch.sigmoid(scene.logits.detach()) * shrunk  # nor has this
    extent = (2 * (255 * opacity).clamp(min=1).log()).sqrt().clamp(max=3.33)
    variance = cov.diagonal(dim1=1, dim2=2)
    mid = variance.mean(-1)
    largest = mid + (mid * mid - det).clamp(min=0.01).sqrt()
    reach = extent[:, None] * torch.minimum(variance, largest[:, None]).clamp(min=0).sqrt()
    tile = 8 if cam.height < 1080 else 16
    drawn = (inside & seen.reshape(-1, 7)).any(1) & (det > 0)
    ranges = []
    for slack in (-tolerance, 0.0, tolerance):
        radius = torch.ceil(reach * (1 + slack))
        there = drawn & (255 * opacity >= 1 - slack) & (radius > 0).all(1)
        there &= ((middle + radius > -slack) & (middle - radius < size + slack)).all(1)
        first = torch.floor((middle - radius) / tile - slack)
        last = torch.ceil((middle + radius) / tile + slack)
        ranges.append((first, torch.where(there[:, None], last, first)))
    return Tiles(tile, ranges)


def _in_window(
    scene: OracleScene,
    s: RenderSettings,
    view: OracleRays,
    window: tuple[int, int, int, int],
    tolerance: float,
) -> OracleScene:
    """The Gaussians without those that are cut off on every ray of the window; near misses are kept."""
    if not s.planar:
        return scene.take(within(scene, scene.extent * (1 + 2 * tolerance), view.origins, view.directions))
    screen = scene.screen
    assert screen is not None  # of a planar response
    low = torch.tensor(window[:2], dtype=torch.float64) + 0.5
    high = low + torch.tensor(window[2:], dtype=torch.float64) - 1
    if scene.tiles is None:
        # What is left out has no derivative.
        middle = screen.means.detach()
        reach = (scene.extent[:, None] * screen.diagonal.detach().sqrt()) * (1 + 2 * tolerance)
        return scene.take(((middle + reach >= low) & (middle - reach <= high)).all(1))
    first, last = scene.tiles.ranges[-1]
    tile = scene.tiles.size
    return scene.take(((last > torch.floor(low / tile)) & (first <= torch.floor(high / tile))).all(1))


@dataclasses.dataclass(frozen=True)
class _Job:
    """What all chunks of rays of a call have in common; the last three are arguments of `render`."""

    scene: OracleScene
    settings: RenderSettings
    form: _Peak
    rotation: Tensor
    center: Tensor | None
    tolerance: float
    exact_ties: bool
    effect: float


def _responses(job: _Job, o: Tensor, d: Tensor, pixels: Tensor) -> tuple:
    """What is known of (P, N) pairs before ordering.

    Returns: a, 1 - a, t; and without gradient: order key, exists (bool), margin (relative distance
    to the nearest cut-off of existence, negative beyond it), distance from a to alpha_max, distance
    to the mean.
    """
    scene, s, form, rotation = job.scene, job.settings, job.form, job.rotation
    away = scene.means - o[:, None, :]
    rho2, t, length = form.meet(scene, s, rotation, away, d, pixels)
    a, rest = form.opacity(scene, rho2, t, length)
    # Where it is clamped, and how near to that, are numbers; the value of a clamp that the gradient passes is one, too.
    over = (a > s.alpha_max).detach()
    to_max = (a / s.alpha_max - 1).abs().detach()
    top = torch.full_like(a, s.alpha_max)
    left = torch.full_like(a, 1 - s.alpha_max)
    if s.alpha_max_gradient == "pass":  # the value of the clamp with the derivative of a
        top, left = a + (top - a).detach(), rest + (left - rest).detach()
    a, rest = torch.where(over, top, a), torch.where(over, left, rest)
    with torch.no_grad():  # which hits exist, and in which order, has no derivative
        distance = away.norm(dim=-1)
        exists = torch.ones_like(over)
        margin = torch.full_like(a, math.inf)

        def cut(inside: Tensor, relative: Tensor) -> None:
            exists.logical_and_(inside)
            margin.copy_(torch.minimum(margin, relative))

        if s.culling in ("extent", "ut"):
            rho = rho2.sqrt()
            cut(rho <= scene.extent, (scene.extent - rho) / scene.extent.clamp(min=1e-300))  # no 0 / 0
        if s.culling != "extent":
            assert scene.tiles is not None  # `render` has found them
            tile = torch.floor(pixels / scene.tiles.size)[:, None, :]
            tight, exact, loose = (((tile >= i) & (tile < j)).all(-1) for i, j in scene.tiles.ranges)
            cut(exact, torch.where(tight, math.inf, torch.where(loose, 0.0, -math.inf)))
        if form.front_only:
            cut(t > 0, t / torch.maximum(distance, _sway(scene, o, d) / job.tolerance).clamp(min=1e-300))  # no 0 / 0
        if s.alpha_min > 0:
            cut(a >= s.alpha_min, a / s.alpha_min - 1)
        if scene.near_margin is not None:
            cut(scene.near_margin > 0, scene.near_margin)
        key = t
        if s.order == "center":
            reach = away if job.center is None else scene.means - job.center
            key = reach @ rotation[2] if s.depth_key == "z" else reach.norm(dim=-1)
        elif s.order == "entry":
            key = t - (scene.extent**2 - rho2).clamp(min=0).sqrt() / length
    # The order is a constant of every derivative.
    return a, rest, t, key.detach().expand_as(a), exists, margin, to_max, distance


def _sway(scene: OracleScene, o: Tensor, d: Tensor) -> Tensor:
    """(P, N) by how much a peak moves along its ray if means and origins are rounded: to float32 where they are world
    coordinates, to float64 where they become those of the camera.
    """
    middle = scene.means.new_tensor(scene.middle)
    rounding = 0.0
    for origin, relative in ((middle, _FLOAT32), (0 * middle, _FLOAT64)):
        rounding = rounding + relative * ((scene.means - origin).norm(dim=-1) + (o - origin).norm(dim=-1)[:, None])
    turned = torch.einsum("nij,pj->pni", scene.whiten, d)
    pulled = torch.einsum("nij,pni->pnj", scene.whiten, turned)
    return rounding * pulled.norm(dim=-1) / turned.square().sum(-1)


class _Peak:
    """a = alpha exp(-rho^2 / 2) at the peak of the ray; peaks behind its origin do not count."""

    front_only = True

    def meet(
        self, scene: OracleScene, s: RenderSettings, rotation: Tensor, away: Tensor, d: Tensor, pixels: Tensor
    ) -> tuple:
        """rho^2, t* and |d'| of (P, N) pairs, from the equations at the top of this page, times s_1 s_2 s_3 above and
        below the line: with W = S^-1 R^T, (W a) x (W b) = S R^T (a x b) / (s_1 s_2 s_3). Quotients by a scale would
        cancel in the derivatives of a disc, which are those of a polynomial.
        """
        local = torch.einsum("nij,pnj->pni", scene.adjugate, away)
        slope = torch.einsum("nij,pj->pni", scene.adjugate, d)
        crossed = torch.einsum("nji,pnj->pni", scene.axes, torch.linalg.cross(away, d[:, None, :].expand_as(away)))
        crossed = crossed / scene.width[:, None] / scene.width[:, None]
        length2 = slope.square().sum(-1)
        length = length2.sqrt() / scene.volume / scene.width
        return crossed.square().sum(-1) / length2, (local * slope).sum(-1) / length2, length

    def opacity(self, scene: OracleScene, rho2: Tensor, t: Tensor, length: Tensor) -> tuple:
        """a and 1 - a, neither by a difference that cancels."""
        alpha = torch.sigmoid(scene.logits)
        a = alpha * torch.exp(-rho2 / 2)
        # Each has a derivative that cancels where it is not taken.
        return a, torch.where(scene.logits < 0, 1 - a, torch.sigmoid(-scene.logits) - alpha * torch.expm1(-rho2 / 2))


class _OddPeak(_Peak):
    """A peak whose rho^2 is not divided by |d'|^2, or that counts behind the origin, too."""

    def __init__(self, plain: bool, front_only: bool):
        self.plain = plain
        self.front_only = front_only

    def meet(
        self, scene: OracleScene, s: RenderSettings, rotation: Tensor, away: Tensor, d: Tensor, pixels: Tensor
    ) -> tuple:
        """rho^2 as it is or times |d'|^2, t* and |d'|."""
        rho2, t, length = super().meet(scene, s, rotation, away, d, pixels)
        return rho2 * length.square() if self.plain else rho2, t, length


class _Integral(_Peak):
    """a = 1 - exp(-tau), tau = softplus(logit) exp(-rho^2 / 2) erfc(-u / sqrt 2) / 2, u = t* |d'|."""

    front_only = False

    def opacity(self, scene: OracleScene, rho2: Tensor, t: Tensor, length: Tensor) -> tuple:
        """a and 1 - a."""
        behind = torch.special.erfc(-t * length / math.sqrt(2)) / 2
        tau = scene.softplus * torch.exp(-rho2 / 2) * behind
        return -torch.expm1(-tau), torch.exp(-tau)


class _Ewa(_Peak):
    """a = alpha exp(-rho^2 / 2), rho^2 = d^T Sigma'^-1 d at the pixel's distance d from the projected mean."""

    front_only = False

    def meet(
        self, scene: OracleScene, s: RenderSettings, rotation: Tensor, away: Tensor, d: Tensor, pixels: Tensor
    ) -> tuple:
        """rho^2 and the Gaussian's own depth; there is no d'."""
        assert scene.screen is not None  # `render` has projected them
        dx, dy = (pixels[:, None, :] - scene.screen.means).unbind(-1)
        b1, b2 = scene.screen.rows.unbind(1)
        # det(B B^T + eps I) and the adjugate form as sums of squares: no cancellation when thin.
        det = torch.linalg.cross(b1, b2).square().sum(-1)
        det = det + s.dilation * (scene.screen.diagonal.sum(-1) - s.dilation)
        form = (dx[..., None] * b2 - dy[..., None] * b1).square().sum(-1)
        t = away @ rotation[2] if s.depth_key == "z" else away.norm(dim=-1)
        return (form + s.dilation * (dx * dx + dy * dy)) / det, t, None


# The oracle's own: nothing of it comes from `tracing.responses`, which it checks.
_FORMS = {"peak": _Peak(), "integral": _Integral(), "ewa": _Ewa()}


def _composite(job: _Job, o: Tensor, d: Tensor, pixels: Tensor) -> dict:
    """The fields of `ReferenceOutput` for one chunk of rays."""
    scene, s, tolerance, effect = job.scene, job.settings, job.tolerance, job.effect
    a, rest, t, key, *checks = _responses(job, o, d, pixels)
    # Near misses are sorted in, without effect, to see what they would have done.
    candidate = checks[0] | (checks[1] >= -tolerance)
    key, order = torch.where(candidate, key, math.inf).sort(dim=1, stable=True)
    sort = (a, rest, t, candidate, *checks)
    a, rest, t, candidate, exists, margin, to_max, distance = (x.gather(1, order) for x in sort)
    after = torch.where(exists, rest, 1.0).cumprod(dim=1)
    before = _previous(after, 1.0)
    tested = before if s.stop == "after" else after
    stops = tested < s.transmittance_min
    if s.stop == "before_eq":
        stops = tested <= s.transmittance_min
    alive = exists & ~stops
    rank = exists.cumsum(dim=1)
    if s.max_hits:
        alive &= rank <= s.max_hits
    w = torch.where(alive, a * before, 0.0)
    half = alive & (after <= 0.5) & (before > 0.5)
    weights = torch.zeros_like(w).scatter(1, order, w)  # back in the caller's order
    colors = scene.colors
    if colors is None:
        towards = d[:, None, :] if s.sh_direction == "ray" else scene.means - o[:, None, :]
        colors = sh_colors(scene.sh, towards)
    background = torch.where(alive, rest, 1.0).prod(dim=1)[:, None] * float64(s.background)
    alpha = w.sum(dim=1)  # equals 1 - T_end, without its cancellation
    with torch.no_grad():
        # T's relative error grows with that of each 1 - a in front.
        growth = torch.where(exists, a / rest.clamp(min=1e-300), 0.0).cumsum(dim=1)
        slack = tolerance * (1 + growth)
        off = _previous(slack, tolerance) if s.stop == "after" else slack
        to_stop = (tested - s.transmittance_min).abs() - off * tested
        matters = candidate & (a * before > effect) & (~stops | (to_stop <= 0))
        doubt = matters & ((margin.abs() <= tolerance) | (to_stop <= 0))
        doubt |= alive & ((after - 0.5).abs() <= slack * after)
        if s.alpha_max < 1:
            doubt |= matters & (to_max <= tolerance)
        if s.max_hits:  # a hit more or less in front decides which one is the last
            doubt |= (rank[:, -1:] >= s.max_hits) & candidate & (rank <= s.max_hits) & (margin.abs() <= tolerance)
        # The previous hit that matters; equal keys are safe, the index decides in any precision.
        last, place = torch.where(matters, key, -math.inf).cummax(dim=1)
        place = _previous(place, 0)
        gap = key - _previous(last, -math.inf)
        swap = a * a.gather(1, place) * before.gather(1, place)
        close = gap <= tolerance * torch.maximum(distance, key.abs())
        doubt |= matters & ((gap > 0) | job.exact_ties) & close & (swap > effect)
    return {
        "rgb": (weights[:, :, None] * colors).sum(dim=1) + background,
        "alpha": alpha,
        "depth": (w * t).sum(dim=1) / alpha.clamp(min=EPS_ALPHA),
        "median_depth": torch.where(half, t, 0.0).sum(dim=1),
        "count": alive.sum(dim=1),
        "visibility": weights.sum(dim=0),
        "features": None if scene.features is None else weights @ scene.features,
        "ambiguous": doubt.any(dim=1),
    }


def _previous(x: Tensor, first: float) -> Tensor:
    """(P, n) shifted by one along the order."""
    return torch.cat([torch.full_like(x[:, :1], first), x[:, :-1]], dim=1)
