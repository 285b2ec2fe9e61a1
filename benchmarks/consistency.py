"""A term that holds two renderers together where nobody took a photograph: what it adds to renderers in turn.

    python benchmarks/consistency.py [--scenes lego ...] [--weights 0.2 1.0] [--seeds 1] [--page]

Every fourth step also renders the Gaussians with `fast` and with `gsplat`, from a camera between those of two
photographs that are near each other, and adds the L1 distance of the two images to the loss, times four times the
weight: gradients reach both. Appends one row a fit to benchmarks/consistency.jsonl as it ends, leaves out what is
there, then writes docs/data/consistency.csv. Scenes are captures by name, or folders. One thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import statistics
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from fits import fitted, psnr_by_renderer  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.cameras import Camera  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import Frame, frames_for  # noqa: E402
from drgs.fitting.metrics import psnr  # noqa: E402
from drgs.fitting.renderers import renderers_to_measure  # noqa: E402
from drgs.integrator import Output, render  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "consistency.jsonl"
SCENES = ("lego", "statue", "fern", "banana")
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
KEY = ("scene", "weight", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")
PAIR = ("fast", "gsplat")
SEEN = ("exact", "fast", "gsplat", "3dgut")
EVERY = 4
NEAR = 5  # photographs among which the other one is drawn
MOST = 13  # held-out views, evenly spaced


class Consistency:
    """The distance between two renderers' images from a camera that nobody photographed; a `LossTerm`."""

    name = "consistency"
    outputs = ()

    def __init__(self, frames: list[Frame], weight: float, seed: int) -> None:
        self._cameras = [frame.camera for frame in frames]
        self._weight = weight
        self._rng = np.random.default_rng(seed)
        self._settings = [RenderSettings.preset(name) for name in PAIR]
        self._steps = 0

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `drgs.fitting.losses.LossTerm`."""
        self._steps += 1
        if self._steps % EVERY:
            return None
        first = self._cameras[self._rng.integers(len(self._cameras))]
        nearest = sorted(self._cameras, key=lambda other: float(np.linalg.norm(other.center - first.center)))
        second = nearest[self._rng.integers(1, min(NEAR + 1, len(nearest)))]
        camera = between(first, second, self._rng.uniform())
        one, other = (render(gaussians, camera, settings, outputs=()).rgb for settings in self._settings)
        return EVERY * self._weight * (one - other).abs().mean()


def between(first: Camera, second: Camera, share: float) -> Camera:
    """A camera with the lens of the first, whose center and orientation are interpolated."""
    c2w = np.eye(4)
    c2w[:3, 3] = (1 - share) * first.center + share * second.center
    left, _, right = np.linalg.svd((1 - share) * first.c2w[:3, :3] + share * second.c2w[:3, :3])
    c2w[:3, :3] = left @ right  # the rotation that is nearest to the mean matrix
    return dataclasses.replace(first, w2c=np.linalg.inv(c2w))


def measured(scene: str, weight: float, seed: int, offset: int) -> dict:
    """One fit: its held-out views in each renderer, and how alike two renderers' images of them are."""
    config = FitConfig().replace(renderers=("any",), seed=seed, test_offset=offset, skybox="off", **SIZE)
    fit = fitted(scene, config, lambda frames: [Consistency(frames, weight, seed)] if weight else [])
    chosen = np.unique(np.linspace(0, len(fit.test) - 1, MOST).round().astype(int))
    held_out = frames_for([fit.test[i] for i in chosen], config.data)
    renderers = renderers_to_measure(("any",), config.settings, "all")
    alike = []
    for frame in held_out:
        images = (render(fit.gaussians, frame.camera, RenderSettings.preset(name), outputs=()).rgb for name in PAIR)
        one, other = (image.clamp(0, 1) for image in images)
        alike.append(psnr(one, other))
    return {
        **dict(zip(KEY, (Path(scene).name, weight, seed, offset, *SIZE.values()), strict=True)),
        "psnr": psnr_by_renderer(fit.gaussians, held_out, renderers),
        "alike": alike,
        "seconds": fit.process_seconds,
        **ran(),
    }


def table(found: list[dict]) -> str:
    """Means and worst views without the term, and what it adds; averages over seeds."""
    lines = [f"| capture | weight | {' | '.join(f'`{name}`' for name in SEEN)} | `fast` against `gsplat` | seconds |"]
    lines += ["|---|---|" + "---|" * len(SEEN) + "---|---|"]
    for scene in dict.fromkeys(row["scene"] for row in found):
        for weight in sorted({row["weight"] for row in found if row["scene"] == scene}):
            group = [row for row in found if (row["scene"], row["weight"]) == (scene, weight)]
            cells = []
            for name in SEEN:
                mean = statistics.mean(statistics.mean(row["psnr"][name]) for row in group)
                worst = statistics.mean(min(row["psnr"][name]) for row in group)
                cells.append(f"{mean:.2f} / {worst:.2f}")
            cells.append(f"{statistics.mean(statistics.mean(row['alike']) for row in group):.2f}")
            cells.append(f"{statistics.mean(row['seconds'] for row in group):.0f}")
            lines.append(f"| {scene} | {weight or 'none'} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures, or folders")
    parser.add_argument("--weights", nargs="+", type=float, default=[0.2, 1.0])
    parser.add_argument("--seeds", type=int, default=1, choices=range(1, len(UNITS) + 1))
    parser.add_argument("--page", action="store_true", help="fit nothing, write the table of the rows that there are")
    args = parser.parse_args()
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    for seed, offset in UNITS[: args.seeds]:
        for scene in [] if args.page else args.scenes:
            for weight in (0.0, *args.weights):
                if (Path(scene).name, weight, seed, offset, *SIZE.values()) not in done:
                    row = measured(scene, weight, seed, offset)
                    add_row(ROWS, row)
                    means = {name: round(statistics.mean(row["psnr"][name]), 2) for name in SEEN}
                    print(scene, weight, seed, means, f"alike {statistics.mean(row['alike']):.2f} dB", flush=True)
    text = table(read_rows(ROWS))
    print(text)
    write_csv(PAGE_DATA / "consistency.csv", table_lines(text))


if __name__ == "__main__":
    main()
