"""The true volume: emission and absorption of the summed densities along a ray, in float64.

Sorted compositing treats each Gaussian as a point on the ray. Here they overlap: Gaussian i has on a ray the density
`s_i(t) = tau_i N(t; t*_i, 1/|d'_i|)` with `tau_i = softplus(logit_i) exp(-rho_i^2 / 2)`, of which a single one is
exactly `response="integral"`, and `C = int_0^inf T(t) sum_i s_i(t) c_i dt + T_end background`. The optical depth
`-log T(t) = sum_i tau_i (Phi(u_i(t)) - Phi(u_i(0)))`, `u_i(t) = (t - t*_i) |d'_i|`, is closed form, hence every
interval of a ray can be integrated on its own: intervals are halved until none is long against a Gaussian in it, then
until the 10-point Gauss rule agrees with the 21-point Kronrod rule that contains it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from drgs.oracle import OracleScene, activate, check_oracle, cull_near, float64, sh_colors, view_rays, within
from drgs.settings import EPS_ALPHA, RenderSettings

_MIN_OPTICAL_DEPTH = 1e-12  # optical depth on a ray below which a Gaussian is left out of it
_NEGLIGIBLE_DEPTH = 1e-16  # optical depth inside an interval that is taken for 0
_SUPPORT_SIGMA = 8.5  # sigma; beyond lies 1e-17 of a Gaussian
_INTERVAL_SIGMA = 4.0  # sigma; intervals start no longer than this
_MIN_SIGMA = 1e-12  # relative to t: thinner Gaussians have no room between neighboring float64 numbers
_MAX_HALVINGS = 200  # halvings; 60 take the largest interval to the smallest
_RAYS_AT_ONCE = 64  # rays at once; bounds memory
_PAIRS_AT_ONCE = 1 << 21  # (node, Gaussian) pairs at once: about 0.15 GB of intermediates

# QUADPACK's pair of 10-point Gauss and 21-point Kronrod rules (Piessens et al. 1983), nodes >= 0 on [-1, 1].
_NODES = (
    0.995657163025808080735527280689003,
    0.973906528517171720077964012084452,
    0.930157491355708226001207180059508,
    0.865063366688984510732096688423493,
    0.780817726586416897063717578345042,
    0.679409568299024406234327365114874,
    0.562757134668604683339000099272694,
    0.433395394129247190799265943165784,
    0.294392862701460198131126603103866,
    0.148874338981631210884826001129720,
    0.0,
)
_KRONROD = (
    0.011694638867371874278064396062192,
    0.032558162307964727478818972459390,
    0.054755896574351996031381300244580,
    0.075039674810919952767043140916190,
    0.093125454583697605535065465083366,
    0.109387158802297641899210590325805,
    0.123491976262065851077958109585166,
    0.134709217311473325928054001771707,
    0.142775938577060080797094273138717,
    0.147739104901338491374841515972068,
    0.149445554002916905664936468389821,
)
_GAUSS = (
    0.066671344308688137593568809893332,
    0.149451349150580593145863396957658,
    0.219086362515982043995534934228163,
    0.269266719309996355091226921569469,
    0.295524224714752870173815619188769,
)


@dataclasses.dataclass
class Volume:
    """What `render_volume` returns; (H, W) stands for the shape of the window or of the rays where these are given.

    Attributes:
        rgb: (H, W, 3), background included.
        alpha: (H, W), 1 - T_end.
        depth: (H, W) int T s t dt / max(alpha, 1e-10), world units along the ray.
        features: (H, W, D) integrated like the color, without background; None without features.
        error: (H, W) estimate of rgb's quadrature error (Gauss against Kronrod, pessimistic: the Kronrod value is
            kept) plus the opacity of all that was left out, per unit of color.
        nodes: (H, W) int64, points at which the densities were summed.
    """

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    features: torch.Tensor | None
    error: torch.Tensor
    nodes: torch.Tensor


@dataclasses.dataclass
class _Line:
    """A chunk of rays with the M Gaussians that matter to each: (P, M) tensors, tau = 0 where there are fewer.

    Attributes:
        tau, t, slope: Optical depth of the whole Gaussian, t*, |d'|.
        start: Phi(u(0)): the share that lies behind the camera.
        values: (P, M, C) what is integrated: color, 1 for the alpha, features.
    """

    tau: torch.Tensor
    t: torch.Tensor
    slope: torch.Tensor
    start: torch.Tensor
    values: torch.Tensor


def render_volume(
    g: Any,
    cam: Any,
    settings: RenderSettings | None = None,
    rays: tuple[torch.Tensor, torch.Tensor] | None = None,
    *,
    window: tuple[int, int, int, int] | None = None,
    tolerance: float = 1e-10,
    split: int = 1,
) -> Volume:
    """Emission and absorption of the sum of all densities, by adaptive quadrature in float64.

    Args:
        g, cam, rays: Arguments of `drgs.reference.render`; gradients reach the raw parameters and a torch `w2c`.
        settings: Settings of which `background`, `near` and `sh_direction` apply; default
            `RenderSettings.preset("exact")`.
        window: (x, y, width, height) in pixels: only these of the camera's image.
        tolerance: An interval is halved until its error estimate falls below tolerance times its weight T(a) - T(b);
            the estimates of a ray then sum to at most tolerance * alpha times the largest color.
        split: Cuts every interval of the final rule in so many: 2 doubles the nodes, to see that they suffice.
    Returns:
        A `Volume`. Memory is that of a chunk of 64 rays; a Gaussian is left out of a ray where its optical depth is
        below 1e-12, and what lies behind an optical depth of 33.
    Raises:
        ValueError: If a camera is needed and missing, or an argument is out of range.
    Gradients:
        Of the rule: its intervals are constants, so that the error of a gradient is the quadrature's too (tested with
        twice the nodes). Any optical depth is stood: the rule follows the thin layer that is seen of an opaque one.
        Gaussians thinner along a ray than 1e-12 of their distance are widened to that.
    Reference:
        Max 1995, "Optical models for direct volume rendering", the emission-absorption integral.
    """
    check_oracle("reference.render_volume", g, cam, settings)
    s = settings or RenderSettings.preset("exact")
    if cam is None and (rays is None or s.near > 0):
        raise ValueError("reference.render_volume: near and images need cam, got None")
    if split < 1 or not 0 < tolerance < 1:
        raise ValueError(
            f"reference.render_volume: split must be >= 1 and tolerance in (0, 1), got {split}, {tolerance}"
        )
    scene = activate(g, s)
    view = view_rays(g, cam, rays, window)
    if cam is not None:
        scene = cull_near(scene, view.rotation, view.center, s, 0.0)
        if s.near > 0:
            assert scene.near_margin is not None  # `cull_near` has set it
            scene = scene.take(scene.near_margin > 0)
    # What can be left out, and where to sum, are choices without a derivative.
    reach = (2 * torch.log((scene.softplus.detach() / _MIN_OPTICAL_DEPTH).clamp(min=1))).sqrt()
    keep = within(scene, reach, view.origins, view.directions)
    scene = scene.take(keep)
    reach = reach[keep]
    if s.sh_direction == "gaussian" and view.center is not None:
        scene = scene.colored(view.center)
    parts = [
        _chunk(
            scene,
            reach,
            s,
            view.origins[i : i + _RAYS_AT_ONCE],
            view.directions[i : i + _RAYS_AT_ONCE],
            tolerance,
            split,
        )
        for i in range(0, max(len(view.directions), 1), _RAYS_AT_ONCE)
    ]
    fields: dict[str, Any] = {}
    for name in parts[0]:
        joined = torch.cat([part[name] for part in parts])
        fields[name] = joined.reshape(*view.shape, *joined.shape[1:])
    return Volume(**{"features": None, **fields})


def _chunk(
    scene: OracleScene, reach: Tensor, s: RenderSettings, o: Tensor, d: Tensor, tolerance: float, split: int
) -> dict[str, Tensor]:
    """The fields of `Volume` for a few rays."""
    keep = within(scene, reach, o, d)
    index = torch.nonzero(keep)[:, 0]
    with torch.no_grad():  # which ones are used, and in which order, has no derivative
        tau, t, slope = _meet(scene, index.expand(len(o), -1), o, d)
        ahead = tau * _phi(t * slope)
        used = ahead > _MIN_OPTICAL_DEPTH
        left_out = torch.where(used, 0.0, ahead).sum(1)
        M = int(used.sum(1).max()) if used.numel() else 0
        # Those that are used, nearest first, padded with others that get tau = 0.
        order = torch.where(used, t, math.inf).argsort(dim=1, stable=True)[:, :M]
        index = index[order]
        used = used.gather(1, order)
    differentiate = torch.is_grad_enabled()

    def line(o: Tensor, d: Tensor) -> tuple[Tensor, ...]:
        tau, t, slope = _meet(scene, index, o, d)
        colors = scene.colors[index] if scene.colors is not None else None
        if colors is None:
            towards = d[:, None, :] if s.sh_direction == "ray" else scene.means[index] - o[:, None, :]
            shape = (*index.shape, 3)
            colors = sh_colors(scene.sh[index].flatten(0, 1), towards.expand(shape).flatten(0, 1)).reshape(shape)
        values = [colors, torch.ones_like(colors[..., :1])]
        if scene.features is not None:
            values.append(scene.features[index])
        return torch.where(used, tau, 0.0), t, slope, _phi(-t * slope), torch.cat(values, -1)

    made = _Line(*(checkpoint(line, o, d, use_reentrant=False) if differentiate else line(o, d)))
    fixed = _Line(*(x.detach() for x in vars(made).values()))  # the rule is a constant of the derivative
    with torch.no_grad():
        ray, a, h, error, tried = _plan(fixed, tolerance)
        error += left_out
        step = torch.arange(split, dtype=torch.float64)
        ray = ray.repeat_interleave(split)
        a = (a[:, None] + h[:, None] * step / split).reshape(-1)
        h = (h / split).repeat_interleave(split)
        nodes = tried + torch.bincount(ray, minlength=len(o)) * (2 * len(_NODES) - 1)
    shape = (len(o), made.values.shape[-1])
    total = torch.zeros(shape, dtype=torch.float64)
    moment = torch.zeros(len(o), dtype=torch.float64)
    with torch.no_grad():  # only says which Gaussians matter where
        batches = list(_batches(fixed, ray, a, h))
    for part, active in batches:
        args = (made, ray[part], a[part], h[part], active)
        sums, t = checkpoint(_integrate, *args, use_reentrant=False) if differentiate else _integrate(*args)
        total = total.index_add(0, ray[part], sums[0])
        moment = moment.index_add(0, ray[part], t)
    end = -(made.tau * _phi(made.t * made.slope)).sum(1)
    alpha = -torch.expm1(end)
    out = {
        "rgb": total[:, :3] + torch.exp(end)[:, None] * float64(s.background),
        "alpha": alpha,
        "depth": moment / alpha.clamp(min=EPS_ALPHA),
        "error": error,
        "nodes": nodes,
    }
    return out if scene.features is None else {**out, "features": total[:, 4:]}


def _phi(u: Tensor) -> Tensor:
    """The normal distribution function; its lower tail keeps its digits."""
    return torch.special.erfc(-u / math.sqrt(2)) / 2


def _meet(scene: OracleScene, index: Tensor, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """tau, t*, |d'| of (P, M) pairs of ray and Gaussian."""
    whiten = scene.whiten[index]
    local = torch.einsum("pnij,pnj->pni", whiten, o[:, None, :] - scene.means[index])
    step = torch.einsum("pnij,pj->pni", whiten, d)
    length2 = step.square().sum(-1)
    t = -(local * step).sum(-1) / length2
    rho2 = torch.linalg.cross(local, step).square().sum(-1) / length2
    tau = scene.softplus[index] * torch.exp(-rho2 / 2)
    # Where to widen is a choice; 1e-300 keeps the quotient finite for a peak at the origin.
    return tau, t, torch.minimum(length2.sqrt(), 1 / (_MIN_SIGMA * t.detach().abs()).clamp(min=1e-300))


def _plan(line: _Line, tolerance: float) -> tuple:
    """Intervals (ray, start, length) that integrate every ray, the estimated error (P,) and the nodes spent (P,)."""
    rays = len(line.tau)
    error = torch.zeros(rays, dtype=torch.float64)
    nodes = torch.zeros(rays, dtype=torch.int64)
    last = torch.where(line.tau > 0, line.t + _SUPPORT_SIGMA / line.slope, 0.0)
    b = last.amax(1) if last.numel() else torch.zeros(rays, dtype=torch.float64)
    ray = torch.nonzero(b > 0)[:, 0]
    b = b[ray]
    a = torch.zeros(len(ray), dtype=torch.float64)
    accepted = [(ray[:0], a[:0], a[:0])]
    for _ in range(_MAX_HALVINGS):
        if not len(ray):
            break
        again = []
        step = max(1, _PAIRS_AT_ONCE // line.tau.shape[1])
        for part in (slice(i, i + step) for i in range(0, len(ray), step)):
            r, low, high = ray[part], a[part], b[part]
            h = high - low
            before, inside = _depths(line, r, low, h)
            front = torch.exp(-before.sum(1))
            weight = front * -torch.expm1(-inside.sum(1))
            # Behind an opaque layer, or where nothing is: its weight is what it could add to a color of 1. Some ten
            # roundings of 1 are not worth a rule, and count as error.
            nothing = weight < 3e-15
            error.index_add_(0, r[nothing], weight[nothing])
            # The others add less than a hundredth of the tolerance each.
            matters = inside * front[:, None] > 1e-2 * tolerance * weight[:, None]
            coarse = (matters & (h[:, None] * line.slope[r] > _INTERVAL_SIGMA)).any(1)
            final = h <= 1e-15 * high  # a few float64 numbers long: no use in halving
            look = torch.nonzero(~nothing & (~coarse | final))[:, 0]
            bad = ~nothing & coarse & ~final
            for batch, active in _batches(line, r[look], low[look], h[look], inside[look]):
                at = look[batch]
                (kronrod, gauss), _ = _integrate(line, r[at], low[at], h[at], active, before[at].sum(1))
                off = (kronrod - gauss)[:, :4].abs().amax(1)
                # Two sums of float64 terms around 1 differ by 1e-16 anyway.
                poor = (off > tolerance * weight[at] + 1e-16) & ~final[at]
                bad[at] = poor
                nodes.index_add_(0, r[at[poor]], torch.full_like(r[at[poor]], 2 * len(_NODES) - 1))
                error.index_add_(0, r[at[~poor]], off[~poor])
                accepted.append((r[at[~poor]], low[at[~poor]], h[at[~poor]]))
            middle = low[bad] + h[bad] / 2
            again += [(r[bad], low[bad], middle), (r[bad], middle, high[bad])]
        ray, a, b = (torch.cat(x) for x in zip(*again, strict=True))
    ray, a, h = (torch.cat(x) for x in zip(*accepted, strict=True))
    return ray, a, h, error, nodes


def _depths(line: _Line, ray: Tensor, a: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Optical depth (Q, M) of each Gaussian from the camera to a, and from a to a + h."""
    tau, slope = line.tau[ray], line.slope[ray]
    offset = a[:, None] - line.t[ray]
    at = _phi(offset * slope)
    return tau * (at - line.start[ray]), tau * (_phi((offset + h[:, None]) * slope) - at)


def _batches(
    line: _Line, ray: Tensor, a: Tensor, h: Tensor, inside: Tensor | None = None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yields (index into the intervals, (Q, A) the Gaussians that change T within them, -1 where fewer)."""
    step = max(1, _PAIRS_AT_ONCE // max(line.tau.shape[1], 1))
    for i in range(0, len(ray), step):
        part = slice(i, i + step)
        depths = _depths(line, ray[part], a[part], h[part])[1] if inside is None else inside[part]
        counts, order = (depths > _NEGLIGIBLE_DEPTH).sum(1).sort()
        first = 0
        # Intervals with few Gaussians apart from those with many: the product of both sizes is the cost.
        while first < len(order):
            most = int(counts[min(first + _size(counts[first]), len(order)) - 1])
            chosen = order[first : first + _size(most)]
            most = max(int(counts[first : first + len(chosen)].max()), 1)
            largest = depths[chosen].topk(most, dim=1)
            yield i + chosen, torch.where(largest.values > _NEGLIGIBLE_DEPTH, largest.indices, -1)
            first += len(chosen)


def _size(count: int | Tensor) -> int:
    """Intervals at once where each has so many Gaussians."""
    return max(1, _PAIRS_AT_ONCE // (4 * len(_NODES) * max(int(count), 8)))


def _integrate(
    line: _Line, ray: Tensor, a: Tensor, h: Tensor, active: Tensor, before: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """int T s v dt of Q intervals by both rules, (2, Q, C), and int T s t dt (Q,).

    Args:
        active: (Q, A) Gaussians that change T inside, -1 for none; the others only count up to a.
        before: (Q,) optical depth up to a, if known.
    """
    half = torch.tensor(_NODES, dtype=torch.float64)
    x = (1 + torch.cat([-half, half[:-1].flip(0)])) / 2
    kronrod = torch.tensor(_KRONROD + _KRONROD[-2::-1], dtype=torch.float64) / 2
    gauss = torch.zeros_like(kronrod)
    gauss[1::2] = torch.tensor(_GAUSS + _GAUSS[::-1], dtype=torch.float64) / 2
    if before is None:
        before = _depths(line, ray, a, h)[0].sum(1)
    pick = active.clamp(min=0)
    row = ray[:, None]
    tau = torch.where(active >= 0, line.tau[row, pick], 0.0)
    slope = line.slope[row, pick]
    offset = a[:, None] - line.t[row, pick]
    # a - t* is exact where they are close, so that u keeps its digits in the thinnest Gaussian.
    u = (offset[:, None, :] + (h[:, None] * x)[:, :, None]) * slope[:, None, :]
    depth = (tau[:, None, :] * (_phi(u) - _phi(offset * slope)[:, None, :])).sum(-1)
    front = torch.exp(-(before[:, None] + depth)) * h[:, None]
    density = (tau * slope)[:, None, :] * torch.exp(-u * u / 2) / math.sqrt(2 * math.pi)
    emitted = torch.bmm(density, line.values[row, pick]) * front[..., None]
    rules = torch.stack([kronrod, gauss])
    sums = torch.einsum("rk,qkc->rqc", rules, emitted)
    return sums, (emitted[..., 3] * kronrod * (a[:, None] + h[:, None] * x)).sum(1)
