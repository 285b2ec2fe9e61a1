"""Sparse points from the surfaces that the cameras see, and a COLMAP model of them, as text."""

from __future__ import annotations

import numpy as np

__all__ = ["SparsePoints", "back_project", "project", "sparse_points", "write_model"]

_SIDE = 0.002  # standard deviation of an error in every direction, as a share of the distance
_ALONG = 0.006  # and of one along the ray
_OUTLIERS = 0.02  # share of the points that were matched wrongly
_FAR = (0.6, 1.5)  # how far along the ray these are, as a share of the distance
_PIXEL = 0.5  # standard deviation of what is observed, in pixels
_SLACK = 0.01  # share of the depth: a point is seen where it is no deeper than the surface by more


class SparsePoints:
    """Points as structure from motion would find them.

    Attributes:
        xyz: (n, 3) positions with their errors.
        exact: (n, 3) positions without them.
        rgb: (n, 3) uint8 color of the pixel that a point came from.
        label: (n,) class of that pixel.
        outlier: (n,) whether the point was matched wrongly.
        tracks: Pair (ids (k,), pixels (k, 2)) a view, of the points that it observes.
    """

    def __init__(self, xyz, exact, rgb, label, outlier, tracks):
        self.xyz = xyz
        self.exact = exact
        self.rgb = rgb
        self.label = label
        self.outlier = outlier
        self.tracks = tracks


def back_project(K, c2w, depth):
    """World points (height, width, 3) of a depth map."""
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    ray = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    return (ray * depth[..., None]) @ c2w[:3, :3].T + c2w[:3, 3]


def project(K, c2w, points):
    """(pixels (n, 2), z (n,)) of world points (n, 3)."""
    camera = (points - c2w[:3, 3]) @ c2w[:3, :3]
    z = camera[:, 2]
    safe = np.where(z > 1e-6, z, 1e-6)  # a point in the camera plane would divide by 0; callers check z
    return np.stack([K[0, 0] * camera[:, 0] / safe + K[0, 2], K[1, 1] * camera[:, 1] / safe + K[1, 2]], 1), z


def sparse_points(K, poses, views, count, seed, pixel=_PIXEL):
    """About `count` points on surfaces, where pictures have texture, with errors.

    A view gives count / views pixels, drawn by the gradient of its picture plus a tenth of that gradient's mean.
    Errors: normal, 0.2 % of the distance in every direction and 0.6 % more along the ray of that view; 2 % of the
    points lie at 0.6 to 1.5 times their distance. Observations: in every view where the exact point is not hidden,
    off by `pixel` (standard deviation of x and y, in pixels); points have at least two, where there are three views or
    more.

    Args:
        K: (3, 3) intrinsics in pixels.
        poses: (views, 4, 4) camera-to-world, OpenCV axes.
        views: Function of a view's number: (image (h, w, 3) uint8, depth (h, w) in meters, labels (h, w)).
        count: Number of points to draw.
        seed: Seed of everything random.
    """
    import cv2

    rng = np.random.default_rng([seed, 21])
    each = max(1, round(count / len(poses)))
    found = []
    for k, c2w in enumerate(poses):
        image, depth, labels = views(k)
        gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
        weight = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
        # A picture without any texture, too, has points: its weights are equal instead of 0.
        weight = ((weight + 0.1 * weight.mean() + 1e-3) * (depth > 0)).ravel().astype(np.float64)
        picked = rng.choice(weight.size, min(each, int((weight > 0).sum())), replace=False, p=weight / weight.sum())
        at = back_project(K, c2w, depth).reshape(-1, 3)[picked]
        found.append((at, at - c2w[:3, 3], image.reshape(-1, 3)[picked], labels.ravel()[picked]))
    exact, ray, rgb, label = (np.concatenate(part) for part in zip(*found, strict=True))
    far = np.linalg.norm(ray, axis=1, keepdims=True)
    outlier = rng.random(len(exact)) < _OUTLIERS
    along = np.where(outlier, rng.uniform(*_FAR, len(exact)) - 1, _ALONG * rng.standard_normal(len(exact)))
    xyz = exact + along[:, None] * ray + _SIDE * far * rng.standard_normal(exact.shape)
    tracks = []
    seen = np.zeros(len(exact), int)
    for k, c2w in enumerate(poses):
        _, depth, _ = views(k)
        height, width = depth.shape
        pixels, z = project(K, c2w, exact)
        ids = np.flatnonzero((z > 0.05) & (pixels > 0).all(1) & (pixels[:, 0] < width) & (pixels[:, 1] < height))
        x, y = pixels[ids].astype(int).T
        ids = ids[np.abs(z[ids] - depth[y, x]) < _SLACK * z[ids]]
        tracks.append((ids, pixels[ids] + pixel * rng.standard_normal((len(ids), 2))))
        seen[ids] += 1
    keep = seen >= (2 if len(poses) > 2 else 0)
    number = np.cumsum(keep) - 1
    tracks = [(number[ids[keep[ids]]], pixels[keep[ids]]) for ids, pixels in tracks]
    return SparsePoints(xyz[keep], exact[keep], rgb[keep], label[keep], outlier[keep], tracks)


def write_model(folder, K, poses, names, width, height, points, errors=None):
    """Write cameras.txt, images.txt and points3D.txt of one PINHOLE camera.

    Args:
        folder: Existing folder.
        K: (3, 3) intrinsics in pixels.
        poses: (views, 4, 4) camera-to-world, OpenCV axes.
        names: File names of the images.
        width, height: Size of the images in pixels.
        points: The `SparsePoints` that the images show.
        errors: (n,) mean reprojection error of each point in pixels, which the file states; None: the standard
            deviation of what is observed.
    """
    if errors is None:
        errors = np.full(len(points.xyz), _PIXEL)
    (folder / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {K[0, 0]:.17g} {K[1, 1]:.17g} {K[0, 2]:.17g} {K[1, 2]:.17g}\n"
    )
    lines = []
    observed = [[] for _ in points.xyz]
    for k, (c2w, name, (ids, pixels)) in enumerate(zip(poses, names, points.tracks, strict=True)):
        rotation = c2w[:3, :3].T
        pose = [*_quaternion(rotation), *(-rotation @ c2w[:3, 3])]
        lines.append(f"{k + 1} {' '.join(f'{v:.17g}' for v in pose)} 1 {name}")
        lines.append(" ".join(f"{x:.3f} {y:.3f} {i + 1}" for (x, y), i in zip(pixels, ids, strict=True)))
        for index, i in enumerate(ids):
            observed[i].append(f"{k + 1} {index}")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{i + 1} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} {error:.6g} {' '.join(observed[i])}".rstrip()
        for i, ((x, y, z), (r, g, b), error) in enumerate(zip(points.xyz, points.rgb, errors, strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def _quaternion(rotation):
    """(w, x, y, z) of a rotation (3, 3), w >= 0: the eigenvector of Bar-Itzhack's symmetric matrix."""
    r = rotation
    form = np.zeros((4, 4))
    form[0] = r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    form[1, 1:] = r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    form[2, 2:] = r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]
    form[3, 3] = r[2, 2] - r[0, 0] - r[1, 1]
    q = np.linalg.eigh(form, UPLO="U")[1][:, -1]
    return q if q[0] >= 0 else -q
