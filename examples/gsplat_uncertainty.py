"""Where a splat is wrong, and which photograph to add, from within a training script of gsplat: its tensors, its loop.

    pip install gsplat==1.5.3
    python examples/gsplat_uncertainty.py

`where_is_it_wrong` is what to copy: it takes `splats` of simple_trainer as they are, on a card or a CPU. The rest
trains some on renderings of another scene; without a card by gsplat's own torch code (examples/gsplat_torch.py).
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

import drgs
from drgs.cameras import orbit

Splats = dict[str, torch.Tensor]
"""means, scales (logarithms), quats (wxyz), opacities (logits), sh0 (N, 1, 3), shN (N, K - 1, 3)."""

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def gaussians_of(splats: Splats) -> drgs.Gaussians:
    """A splat as drgs has it."""
    sh = torch.cat([splats["sh0"], splats["shN"]], 1)
    return drgs.Gaussians(splats["means"], splats["quats"], splats["scales"], splats["opacities"], sh).detach()


def where_is_it_wrong(
    splats: Splats, cameras: Sequence[drgs.Camera], photographs: Sequence[torch.Tensor], others: Sequence[drgs.Camera]
) -> tuple[list[torch.Tensor], int]:
    """Of each other view the (H, W) expected error, in units of color, and the index of the one to photograph.

    A camera is `drgs.Camera(K=K, w2c=viewmat, width=width, height=height)`, its photograph (H, W, 3) in [0, 1].
    """
    g, settings = gaussians_of(splats), drgs.RenderSettings.preset("fast")
    record = drgs.error_record(g, cameras, photographs, settings)
    errors = [drgs.expected_error(g, camera, record).sqrt() for camera in others]
    picked = drgs.select_views(g, others, cameras, k=1, scoring=drgs.Scoring(settings=settings)).picks[0]
    return errors, picked.index


def train(rasterization: Callable, cameras: Sequence[drgs.Camera], photographs: Sequence[torch.Tensor]) -> Splats:
    """150 Gaussians after 60 steps."""
    torch.manual_seed(0)
    splats = {
        "means": torch.randn(150, 3) * 0.5,
        "scales": torch.full((150, 3), 0.12).log(),
        "quats": torch.randn(150, 4),
        "opacities": torch.zeros(150),
        "sh0": torch.rand(150, 1, 3) - 0.5,
        "shN": torch.zeros(150, 3, 3),
    }
    splats = {name: x.to(DEVICE).requires_grad_() for name, x in splats.items()}
    optimizer = torch.optim.Adam([{"params": [x], "lr": 5e-4 if name == "shN" else 1e-2} for name, x in splats.items()])
    for step in range(60):
        camera, photograph = cameras[step % len(cameras)], photographs[step % len(cameras)].to(DEVICE)
        shapes = splats["means"], splats["quats"], splats["scales"].exp()
        seen = splats["opacities"].sigmoid(), torch.cat([splats["sh0"], splats["shN"]], 1)
        pose, K = (torch.tensor(x, dtype=torch.float32, device=DEVICE)[None] for x in (camera.w2c, camera.K))
        image, _, _ = rasterization(*shapes, *seen, pose, K, camera.width, camera.height, sh_degree=1)
        (image[0] - photograph).abs().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    return splats


def main(rasterization: Callable | None = None) -> tuple[list[float], list[float], int]:
    """Train with four photographs of one side, and ask about views all around.

    Returns:
        Of each other view the true and the expected root mean squared error, and the index of the one to add.
    """
    if rasterization is None:
        sys.path.insert(0, str(Path(__file__).parents[1]))
        has_kernels = torch.cuda.is_available() and importlib.util.find_spec("gsplat")
        rasterization = importlib.import_module("gsplat" if has_kernels else "examples.gsplat_torch").rasterization
    torch.manual_seed(1)
    shapes = torch.randn(40, 3) * 0.5, torch.randn(40, 4), 0.08 + 0.15 * torch.rand(40, 3)
    truth = drgs.Gaussians.from_arrays(*shapes, torch.full((40,), 0.9), torch.rand(40, 1, 3) * 3 - 1)
    cameras = orbit((0, 0, 0), 3.0, 12, width=40, height=40)
    photographs = [drgs.render(truth, camera).rgb.clamp(0, 1) for camera in cameras]
    known, others = cameras[:4], cameras[4:]
    splats = train(rasterization, known, photographs[:4])
    errors, pick = where_is_it_wrong(splats, known, photographs[:4], others)

    g, true, expected = gaussians_of(splats).to("cpu"), [], []
    for i, (camera, photograph, error) in enumerate(zip(others, photographs[4:], errors, strict=True), 4):
        shown = drgs.render(g, camera, drgs.RenderSettings.preset("fast")).rgb.clamp(0, 1)
        true.append(float((shown - photograph).square().mean().sqrt()))
        expected.append(float(error.square().mean().sqrt()))
        print(f"view {i}: expected error {expected[-1]:.3f}, true error {true[-1]:.3f}")
    print(f"photograph view {4 + pick} next")
    return true, expected, pick


if __name__ == "__main__":
    main()
