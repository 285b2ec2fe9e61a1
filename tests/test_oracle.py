"""The float64 oracle against a renderer that shares nothing with it: plain loops, from the equations alone.

`naive` unprojects pixels with the inverses of K and w2c, has Gaussians as their covariance matrices, and projects them
with the Jacobian of the projection by complex steps. It knows nothing of axes, whitening, tiles or torch.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh", "features")
FIELDS = ("rgb", "alpha", "depth", "features")
CUTS = {
    "extent": 2.5,
    "alpha_min": 0.02,
    "alpha_max": 0.7,
    "transmittance_min": 0.2,
    "near": 3.6,
    "background": (0.2, 0.5, 0.9),
}
SETTINGS = {
    "peak ray": {"order": "ray", "background": (0.1, 0.9, 0.3)},
    "peak center": {"extent": 3.0, "sh_direction": "ray"},
    "peak center z, cut": {**CUTS, "depth_key": "z", "stop": "before"},
    "peak entry": {"order": "entry", "extent": 3.0, "traversal": "bvh", "max_hits": 2},
    "integral ray": {"response": "integral", "order": "ray", "sh_direction": "ray"},
    "integral center, cut": {**CUTS, "response": "integral"},
    "ewa": {"response": "ewa", "dilation": 0.3},
    "ewa z, cut": {**CUTS, "response": "ewa", "depth_key": "z", "stop": "before_eq", "fov_clamp": "gsplat"},
    "ewa, inria's clamp": {"response": "ewa", "fov_clamp": "inria", "sh_direction": "ray"},
}


# ------------------------------------------------------------------------------------- the naive one


def naive(p: dict, K, w2c, size, s: RenderSettings, pixel_to_plane=None) -> dict:
    """Pictures by name, of raw parameters (NumPy), K (3, 3), w2c (4, 4) and size (width, height).

    Args:
        pixel_to_plane: (x, y) -> direction in camera axes; default through the inverse of K.
    """
    width, height = size
    c2w = np.linalg.inv(w2c)
    eye, forward = c2w[:3, 3], w2c[2, :3]
    n = len(p["means"])
    alpha = 1 / (1 + np.exp(-p["logit_opacities"]))
    depth_log = np.log1p(np.exp(p["logit_opacities"]))
    covariances = [covariance(q, scales) for q, scales in zip(p["quats"], p["log_scales"], strict=True)]
    extent = np.full(n, s.extent or 9.0)  # the oracle's, without one
    z_of = [float(forward @ (mean - eye)) for mean in p["means"]]
    reach = [z if s.depth_key == "z" else math.dist(mean, eye) for z, mean in zip(z_of, p["means"], strict=True)]
    screen = [None] * n
    if s.response == "ewa":
        screen = [splat(mean, cov, K, w2c, size, s) for mean, cov in zip(p["means"], covariances, strict=True)]
    shapes = {"rgb": 3, "alpha": 0, "depth": 0, "median_depth": 0, "count": 0, "features": p["features"].shape[1]}
    out = {name: np.zeros((height, width, width_) if width_ else (height, width)) for name, width_ in shapes.items()}
    out["visibility"] = np.zeros(n)
    for row in range(height):
        for column in range(width):
            pixel = np.array([column + 0.5, row + 0.5])
            d = np.linalg.inv(K) @ [*pixel, 1] if pixel_to_plane is None else pixel_to_plane(pixel)
            d = c2w[:3, :3] @ d
            d = d / math.sqrt(d @ d)
            hits = []
            for i in range(n):
                if (s.near > 0 and z_of[i] <= s.near) or (s.response == "ewa" and z_of[i] <= 0):
                    continue
                if s.response == "ewa":
                    center, inverse = screen[i]
                    rho2, t = (pixel - center) @ inverse @ (pixel - center), reach[i]
                else:
                    # The quadratic (o + t d - mu)^T Sigma^-1 (o + t d - mu) and its lowest point.
                    precision, away = np.linalg.inv(covariances[i]), eye - p["means"][i]
                    curve = d @ precision @ d
                    t = -(d @ precision @ away) / curve
                    rest = away + t * d
                    rho2 = rest @ precision @ rest
                if rho2 > extent[i] ** 2 or (s.response == "peak" and t <= 0):
                    continue
                if s.response == "integral":
                    passed = 0.5 * math.erfc(-t * math.sqrt(curve) / math.sqrt(2))
                    a = 1 - math.exp(-depth_log[i] * math.exp(-rho2 / 2) * passed)
                else:
                    a = alpha[i] * math.exp(-rho2 / 2)
                a = min(a, s.alpha_max)
                if a < s.alpha_min:
                    continue
                key = {"center": reach[i], "ray": t if s.response == "peak" else max(t, 0.0)}.get(s.order)
                if s.order == "entry":
                    key = t - math.sqrt((extent[i] ** 2 - rho2) / curve)
                hits.append((key, i, a, t))
            T = 1.0
            for _, i, a, t in sorted(hits):
                if s.stop == "after" and s.transmittance_min > T:
                    break
                if s.stop == "before" and T * (1 - a) < s.transmittance_min:
                    break
                if s.stop == "before_eq" and T * (1 - a) <= s.transmittance_min:
                    break
                towards = d if s.sh_direction == "ray" else p["means"][i] - eye
                x, y, z = towards / math.sqrt(towards @ towards)
                sh = p["sh"][i]  # of degree 1
                color = 0.5 + 0.28209479177387814 * sh[0] + 0.4886025119029199 * (-y * sh[1] + z * sh[2] - x * sh[3])
                w = a * T
                out["rgb"][row, column] += w * np.maximum(color, 0)
                out["features"][row, column] += w * p["features"][i]
                out["alpha"][row, column] += w
                out["depth"][row, column] += w * t
                out["count"][row, column] += 1
                out["visibility"][i] += w
                if T > 0.5 >= T * (1 - a):
                    out["median_depth"][row, column] = t
                T *= 1 - a
                if out["count"][row, column] == s.max_hits:
                    break
            out["rgb"][row, column] += T * np.array(s.background)
            out["depth"][row, column] /= max(out["alpha"][row, column], 1e-10)
    return out


def covariance(q, log_scales) -> np.ndarray:
    """(3, 3) sum of squared semi-axes, each turned as q v q*, by the product of quaternions."""
    w, v = q[0], q[1:]
    total = np.zeros((3, 3))
    for axis, log_scale in zip(np.eye(3), log_scales, strict=True):
        u = w * axis + np.cross(v, axis)  # q (0, axis) = (-v . axis, u)
        turned = (v @ axis) * v + w * u + np.cross(v, u)
        turned = math.exp(log_scale) * turned / (q @ q)
        total += np.outer(turned, turned)
    return total


def splat(mean, covariance, K, w2c, size, s: RenderSettings):
    """Projected mean (2,) and inverse of the projected covariance (2, 2), by complex steps of the projection."""
    local = w2c[:3, :3] @ mean + w2c[:3, 3]

    def project(x):
        u = K @ x
        return u[:2] / u[2]

    at = local.copy()
    for k in range(2):
        f, c, half = K[k, k], K[k, 2], 0.5 * size[k] / K[k, k]
        low, high = -math.inf, math.inf
        if s.fov_clamp == "inria":
            low, high = -1.3 * half, 1.3 * half
        elif s.fov_clamp == "gsplat":
            low, high = -(c / f + 0.3 * half), (size[k] - c) / f + 0.3 * half
        at[k] = min(max(local[k] / local[2], low), high) * local[2]
    jacobian = np.stack([project(at + 1e-30j * axis).imag / 1e-30 for axis in np.eye(3)], axis=1)
    turned = jacobian @ w2c[:3, :3]
    return project(local), np.linalg.inv(turned @ covariance @ turned.T + s.dilation * np.eye(2))


# ------------------------------------------------------------------------------------------- scenes


def pose(rng, distance=4.0) -> np.ndarray:
    """(4, 4) w2c looking at the origin from any side, a little off."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    w2c = np.eye(4)
    w2c[:3, :3] = rotation * np.linalg.det(rotation)
    w2c[:3, 3] = [*rng.uniform(-0.3, 0.3, 2), distance]
    return w2c


def lens(rng, size) -> np.ndarray:
    """(3, 3) K with nothing left at its default: fx, fy, skew, a principal point outside of the middle."""
    f = size[0] * rng.uniform(0.8, 1.2)
    cx, cy = size * rng.uniform(0.1, 0.9, 2)
    return np.array(
        [[f, f * rng.choice([-1, 1]) * rng.uniform(0.2, 0.4), cx], [0, f * rng.uniform(0.7, 1.4), cy], [0, 0, 1]]
    )


def parameters(rng, n=6) -> dict:
    """Raw parameters in float64 around the origin."""
    return {
        "means": rng.normal(size=(n, 3)) * 0.7,
        "quats": rng.normal(size=(n, 4)),
        "log_scales": rng.normal(size=(n, 3)) * 0.5 - 1.0,
        "logit_opacities": rng.normal(size=n) * 1.5,
        "sh": rng.normal(size=(n, 4, 3)) * 0.3,
        "features": rng.normal(size=(n, 2)),
    }


def splats(p: dict, origin=(0.0, 0.0, 0.0), grad=False) -> Gaussians:
    return Gaussians(**{k: torch.tensor(x).requires_grad_(grad) for k, x in p.items()}, origin=np.array(origin))


def close(out, want: dict, tolerance: float):
    for name in (*FIELDS, "median_depth", "count", "visibility"):
        got = getattr(out, name).detach().double().numpy()
        # The depth of a ray that meets tails alone is a quotient of small numbers.
        relative = 100 * tolerance if name == "depth" else tolerance
        np.testing.assert_allclose(got, want[name], rtol=relative, atol=tolerance, err_msg=name)


# -------------------------------------------------------------------------------------------- tests

SIZE = np.array([6, 5])


@pytest.mark.parametrize("fields", SETTINGS.values(), ids=SETTINGS)
def test_images(rng, fields):
    """Every output to 1e-12, for any pose and any K: float64 rounding of depths of 4, in all responses and orders."""
    s, seen = RenderSettings(**fields), 0
    for _ in range(3):
        p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)
        want = naive(p, K, w2c, SIZE, s)
        close(reference.render(splats(p), Camera(K, w2c, *SIZE), s), want, 1e-12)
        seen += want["count"].sum()
        # Without the skew it is another picture, or this would not show that it is read.
        straight = np.where([[True, False, True]] + [[True] * 3] * 2, K, 0.0)
        assert abs(naive(p, straight, w2c, SIZE, s)["rgb"] - want["rgb"]).max() > 1e-3
    assert seen > 20


@pytest.mark.parametrize("fields", SETTINGS.values(), ids=SETTINGS)
def test_gradients(rng, fields):
    """Of every group and of the pose, along random directions, against central differences of the naive pictures.

    The differences end at 1e-11 / 1e-5 of rounding and (1e-5)^2 of curvature: 1e-6, with hundreds of pixels added up.
    """
    s = RenderSettings(**fields)
    p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)
    g, cam = splats(p, grad=True), Camera(K, torch.tensor(w2c).requires_grad_(), *SIZE)
    out = reference.render(g, cam, s)
    weights = {name: rng.normal(size=getattr(out, name).shape) for name in FIELDS}
    weights["depth"] *= out.alpha.detach().numpy()  # where only tails are met, depths bend within the step
    sum((getattr(out, name) * torch.tensor(w)).sum() for name, w in weights.items()).backward()

    def value(p, w2c):
        pictures = naive(p, K, w2c, SIZE, s)
        return sum((pictures[name] * w).sum() for name, w in weights.items())

    h = 1e-5
    for name in NAMES:
        v = rng.normal(size=p[name].shape)
        ends = [value({**p, name: p[name] + sign * h * v}, w2c) for sign in (1, -1)]
        got = float((getattr(g, name).grad * torch.tensor(v)).sum())
        assert got == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-6, abs=1e-6), name
    w, v = rng.normal(size=(2, 3))
    twist = np.zeros((4, 4))
    twist[:3] = np.column_stack([[0, w[2], -w[1]], [-w[2], 0, w[0]], [w[1], -w[0], 0], v])
    ends = [value(p, w2c @ (np.eye(4) + sign * h * twist)) for sign in (1, -1)]
    got = float((cam.w2c.grad * torch.tensor(w2c @ twist)).sum())
    assert got == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-6, abs=1e-6)


def test_far_worlds(rng):
    """A world 1e6 away, as float64 means or as an origin: 1e-8, what float64 keeps of a detail there."""
    s = RenderSettings(order="ray")
    p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)
    want, shift = naive(p, K, w2c, SIZE, s), np.array([1e6, -7e5, 3e5])
    moved = w2c.copy()
    moved[:3, 3] -= w2c[:3, :3] @ shift
    cam = Camera(K, moved, *SIZE)
    close(reference.render(splats({**p, "means": p["means"] + shift}), cam, s), want, 1e-8)
    close(reference.render(splats(p, origin=shift), cam, s), want, 1e-8)
    # And the renderer, whose float32 is held to 1e-5 as ever.
    got = render(splats(p, origin=shift), cam, s, outputs="all")
    np.testing.assert_allclose(got.rgb.numpy(), want["rgb"], atol=1e-5)


def test_windows(rng):
    """A window is that part of the picture, skew and clamps of the whole image included."""
    for fields in SETTINGS.values():
        s = RenderSettings(**fields)
        p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)
        want = naive(p, K, w2c, SIZE, s)
        got = reference.render(splats(p), Camera(K, w2c, *SIZE), s, window=(2, 1, 3, 4))
        np.testing.assert_allclose(got.rgb.numpy(), want["rgb"][1:5, 2:5], atol=1e-12)


def test_the_volume_reads_the_same_camera(rng):
    """`render_volume` of one Gaussian, which nothing overlaps, is the naive `integral`: 1e-9 is its quadrature's."""
    s = RenderSettings(response="integral", order="ray", extent=9.0, transmittance_min=0.0)
    p, K, w2c = parameters(rng, 1), lens(rng, SIZE), pose(rng)
    got = reference.render_volume(splats(p), Camera(K, w2c, *SIZE), s)
    np.testing.assert_allclose(got.rgb.numpy(), naive(p, K, w2c, SIZE, s)["rgb"], atol=1e-9)


def opencv(x, y, k):
    """OpenCV's rational radial and tangential model, as its manual has it."""
    r2 = x * x + y * y
    radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
    return (
        x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
        y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
    )


def fisheye(x, y, k):
    """OpenCV's fisheye model."""
    r = math.hypot(x, y)
    angle = math.atan(r)
    factor = angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(k))) / r
    return x * factor, y * factor


@pytest.mark.parametrize(
    ("model", "bend", "coefficients"),
    [
        ("opencv", opencv, (-0.2, 0.05, 0.01, -0.02, 0.01, 0.03, -0.01, 0.004)),
        ("opencv_fisheye", fisheye, (0.05, -0.02, 0.01, -0.003)),
    ],
)
def test_lenses(rng, model, bend, coefficients):
    """Both lens models with skew, inverted here by Newton's method with differences: 1e-9 is what inverses leave."""
    s = RenderSettings(order="ray", traversal="bvh")
    p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)

    def direction(pixel):
        x = np.linalg.inv(K) @ [*pixel, 1]
        goal, x = x[:2], x[:2].copy()
        for _ in range(60):
            miss = np.array(bend(*x, coefficients)) - goal
            columns = [(np.array(bend(*(x + e), coefficients)) - miss - goal) / 1e-7 for e in 1e-7 * np.eye(2)]
            x = x - np.linalg.solve(np.stack(columns, 1), miss)
        return np.array([*x, 1])

    cam = Camera(K, w2c, *SIZE, model=model, distortion=coefficients)
    want = naive(p, K, w2c, SIZE, s, direction)
    close(reference.render(splats(p), cam, s), want, 1e-9)
    got = render(splats(p), cam, s, outputs=())
    np.testing.assert_allclose(got.rgb.numpy(), want["rgb"], atol=1e-5)


@pytest.mark.parametrize("kind", [np.array, torch.tensor], ids=["numpy", "torch"])
def test_rounded_poses(rng, kind):
    """A pose rounded to float32 or 5 digits, in a world 100 away, is one camera to the oracle, the tiles and `bvh`.

    That camera is the nearest rotation, about the point that the given matrix maps to 0.
    """
    s = RenderSettings.preset("exact")
    for digits in (5, 7):
        p, K, w2c = parameters(rng), lens(rng, 20 * SIZE), pose(rng)
        p["means"] = p["means"] + [100.0, -60.0, 30.0]
        w2c[:3, :3] = np.round(w2c[:3, :3], digits)
        w2c[:3, 3] -= w2c[:3, :3] @ [100.0, -60.0, 30.0]
        u, _, vt = np.linalg.svd(w2c[:3, :3])
        true = np.eye(4)
        true[:3, :3] = u @ vt
        true[:3, 3] = u @ vt @ np.linalg.solve(w2c[:3, :3], w2c[:3, 3])
        cam, g = Camera(K, kind(w2c), *(20 * SIZE)), splats(p)
        good = reference.render(g, Camera(K, true, *(20 * SIZE)), s)
        same = reference.render(g, cam, s)
        torch.testing.assert_close(same.rgb, good.rgb, rtol=0, atol=1e-9)
        for traversal in ("tiles", "bvh"):
            got = render(g, cam, s.replace(traversal=traversal), outputs=()).rgb.double()
            torch.testing.assert_close(got[~good.ambiguous], good.rgb[~good.ambiguous], rtol=0, atol=1e-5)
        np.testing.assert_allclose(cam.center, np.linalg.inv(w2c)[:3, 3], atol=1e-9)


@dataclasses.dataclass
class Other:
    """A camera that is none of ours, as the oracle accepts them."""

    K: np.ndarray
    w2c: np.ndarray
    width: int = 6
    height: int = 5


def test_what_is_no_camera_is_refused(rng):
    """A K with a last row of its own is no pinhole camera: refused, not read as one; a lower-left entry is honored."""
    s = RenderSettings()
    p, K, w2c = parameters(rng), lens(rng, SIZE), pose(rng)
    K[1, 0] = 0.3 * K[0, 0]
    want = naive(p, K, w2c, SIZE, s)
    close(reference.render(splats(p), Other(K, w2c), s), want, 1e-12)
    with pytest.raises(ValueError, match="K must be"):
        Camera(K, w2c, *SIZE)
    K[2] = [0, 0, 2]
    with pytest.raises(ValueError, match="last row 0 0 1"):
        reference.render(splats(p), Other(K, w2c), s)
