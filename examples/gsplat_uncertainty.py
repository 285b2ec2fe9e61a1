"""Where a splat is wrong, and which photograph to add, from within a training script of gsplat: its tensors, its loop.

    pip install gsplat==1.5.3
    python examples/gsplat_uncertainty.py

`where_is_it_wrong` is what to copy: it takes `splats` of simple_trainer as they are, on a card or a CPU. The
rest of this file is a training loop as short as one can be, on photographs of a made scene. Without a card it calls
gsplat's own torch code (examples/gsplat_torch.py).
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

import drgs
from drgs.cameras import orbit

SIZE = 40  # pixels of a side
STEPS = 60


def where_is_it_wrong(
    splats: Mapping[str, torch.Tensor],
    cameras: Sequence[drgs.Camera],
    photographs: Sequence[torch.Tensor],
    others: Sequence[drgs.Camera],
) -> tuple[list[torch.Tensor], int]:
    """What a splat is expected to get wrong in views without a photograph, and which of them to photograph next.

    Args:
        splats: means, scales (logarithms), quats (wxyz), opacities (logits), sh0 (N, 1, 3), shN (N, K - 1, 3).
        cameras: Cameras of the photographs: `drgs.Camera(K=K, w2c=viewmat, width=width, height=height)`.
        photographs: (H, W, 3) in [0, 1] each.
        others: Cameras of other views.
    Returns:
        Of each other view the (H, W) expected error, in units of color, and the index of the one to add.
    """
    sh = torch.cat([splats["sh0"], splats["shN"]], 1)
    g = drgs.Gaussians(splats["means"], splats["quats"], splats["scales"], splats["opacities"], sh).detach()
    settings = drgs.RenderSettings.preset("fast")
    record = drgs.error_record(g, cameras, photographs, settings)
    errors = [drgs.expected_error(g, camera, record).sqrt() for camera in others]
    picked = drgs.select_views(g, others, cameras, k=1, scoring=drgs.Scoring(settings=settings)).picks[0]
    return errors, picked.index


def rasterizer() -> Callable:
    """gsplat's rasterization, on a CPU its torch code."""
    if torch.cuda.is_available() and importlib.util.find_spec("gsplat"):
        return importlib.import_module("gsplat").rasterization
    sys.path.insert(0, str(Path(__file__).parents[1]))
    return importlib.import_module("examples.gsplat_torch").rasterization


def train(
    rasterization: Callable, cameras: Sequence[drgs.Camera], photographs: Sequence[torch.Tensor], device: str
) -> dict[str, torch.Tensor]:
    """A splat of 150 Gaussians after `STEPS` steps."""
    generator = torch.Generator().manual_seed(0)
    n = 150
    splats = {
        "means": torch.randn(n, 3, generator=generator) * 0.5,
        "scales": torch.full((n, 3), 0.12).log(),
        "quats": torch.randn(n, 4, generator=generator),
        "opacities": torch.zeros(n),
        "sh0": torch.rand(n, 1, 3, generator=generator) - 0.5,
        "shN": torch.zeros(n, 3, 3),
    }
    splats = {name: x.to(device).requires_grad_() for name, x in splats.items()}
    optimizer = torch.optim.Adam([{"params": [x], "lr": 5e-4 if name == "shN" else 1e-2} for name, x in splats.items()])
    for step in range(STEPS):
        camera, photograph = cameras[step % len(cameras)], photographs[step % len(cameras)].to(device)
        image, _, _ = rasterization(
            splats["means"],
            splats["quats"],
            splats["scales"].exp(),
            splats["opacities"].sigmoid(),
            torch.cat([splats["sh0"], splats["shN"]], 1),
            torch.tensor(camera.w2c, dtype=torch.float32, device=device)[None],
            torch.tensor(camera.K, dtype=torch.float32, device=device)[None],
            camera.width,
            camera.height,
            sh_degree=1,
        )
        (image[0] - photograph).abs().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    return splats


def main(rasterization: Callable | None = None) -> tuple[list[float], list[float], int]:
    """Train with a few photographs of one side, and ask about views all around.

    Returns:
        Of each other view the true and the expected root mean squared error, and the index of the one to add.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    generator = torch.Generator().manual_seed(1)
    truth = drgs.Gaussians.from_arrays(
        torch.randn(40, 3, generator=generator) * 0.5,
        torch.randn(40, 4, generator=generator),
        0.08 + 0.15 * torch.rand(40, 3, generator=generator),
        torch.full((40,), 0.9),
        torch.rand(40, 1, 3, generator=generator) * 3 - 1,
    )
    cameras = orbit((0, 0, 0), 3.0, 12, width=SIZE, height=SIZE)
    photographs = [drgs.render(truth, camera).rgb.clamp(0, 1) for camera in cameras]
    known = [0, 1, 2, 3]
    splats = train(rasterization or rasterizer(), [cameras[i] for i in known], [photographs[i] for i in known], device)

    others = [i for i in range(len(cameras)) if i not in known]
    errors, pick = where_is_it_wrong(
        splats, [cameras[i] for i in known], [photographs[i] for i in known], [cameras[i] for i in others]
    )

    sh = torch.cat([splats["sh0"], splats["shN"]], 1)
    g = drgs.Gaussians(splats["means"], splats["quats"], splats["scales"], splats["opacities"], sh).detach().to("cpu")
    shown = [drgs.render(g, cameras[i], drgs.RenderSettings.preset("fast")).rgb.clamp(0, 1) for i in others]
    true = [float((a - photographs[i]).square().mean().sqrt()) for a, i in zip(shown, others, strict=True)]
    expected = [float(error.square().mean().sqrt()) for error in errors]
    for i, a, b in zip(others, true, expected, strict=True):
        print(f"view {i}: expected error {b:.3f}, true error {a:.3f}")
    print(f"photograph view {others[pick]} next")
    return true, expected, pick


if __name__ == "__main__":
    main()
