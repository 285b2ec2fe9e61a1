"""Pixels of `exact` whose color hangs on an order that float32 cannot tell, by brute force in float64.

    python benchmarks/cuda/ties.py

Counted in the cube of `check.scenes`, in which a card is compared with LLVM: pixels with two neighboring hits that lie
within `NEAR` of their distance and whose exchange would move a channel by `MOVED` or more.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "benchmarks" / "cuda")]

from check import scenes  # noqa: E402

from drgs.ellipsoids import semi_axes  # noqa: E402
from drgs.oracle import sh_colors  # noqa: E402

NEAR, MOVED = 6e-7, 1e-4
SEEN = 1e-6  # least alpha of a hit


def moved(alpha: np.ndarray, t: np.ndarray, color: np.ndarray) -> float:
    """The most that exchanging two neighboring hits of a ray moves a channel, of those that are `NEAR`."""
    hits = np.flatnonzero(alpha > SEEN)
    hits = hits[np.argsort(t[hits])]
    a, c, t = alpha[hits], color[hits], t[hits]
    before = np.concatenate([[1.0], np.cumprod(1 - a)])[: len(a) - 1]
    change = (before * a[:-1] * a[1:])[:, None] * np.abs(np.diff(c, axis=0))
    near = np.diff(t) < NEAR * t[1:]
    return float(change[near].max(initial=0.0))


def main() -> None:
    g, camera = scenes()["cube"]
    of = {name: x.detach().double() for name, x in g.parameters().items()}
    away = of["means"] - torch.as_tensor(camera.center)
    color = sh_colors(of["sh"], away).numpy()
    inward = semi_axes(of["quats"], (-of["log_scales"]).exp()).transpose(1, 2).numpy()  # S^-1 R^T
    opacity = of["logit_opacities"].sigmoid().numpy()
    mean = np.einsum("nij,nj->ni", inward, away.numpy())
    found = []
    for y in range(camera.height):
        pixel = np.stack([np.arange(camera.width) + 0.5, np.full(camera.width, y + 0.5), np.ones(camera.width)], 1)
        ray = pixel @ np.linalg.inv(camera.K).T @ np.asarray(camera.c2w)[:3, :3].T
        ray = np.einsum("nij,pj->pni", inward, ray / np.linalg.norm(ray, axis=1, keepdims=True))
        t = (ray * mean).sum(2) / (ray**2).sum(2)
        alpha = opacity * np.exp(-((t[..., None] * ray - mean) ** 2).sum(2) / 2) * (t > 0)
        found += [change for x in range(camera.width) if (change := moved(alpha[x], t[x], color)) >= MOVED]
    print(f"{len(found)} of {camera.width * camera.height} pixels, by {min(found):.1e} to {max(found):.1e}")


if __name__ == "__main__":
    main()
