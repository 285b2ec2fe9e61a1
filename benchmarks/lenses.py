"""What a lens costs on tiles, and what fits gain that see photographs as they were taken.

    python benchmarks/lenses.py [--scenes street banana fisheye] [--seeds 2] [--page]
    python benchmarks/lenses.py --times

Fits with and without --undistort, both seen on the held-out photographs as they were taken and on undistorted ones: one
row a fit in benchmarks/lenses.jsonl, and docs/data/lenses.csv. `--times` measures a frame of the wolf through lenses
and a rolling shutter, in turn in one process, and writes lens-times.csv beside it. Scenes are captures by name, or
folders; `fisheye` is made: photographs of 150 degrees, walked along Gaussians that are all around. One thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from fits import fitted, psnr_by_renderer  # noqa: E402
from studies import PAGE_DATA, table_lines, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, look_at  # noqa: E402
from drgs.display.pictures import write_png  # noqa: E402
from drgs.fitting.components.lens import lost_share  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import load_frames  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "lenses.jsonl"
TIMES = ROOT / "benchmarks" / "lenses.json"
MADE = "fisheye"
SCENES = ("street", "banana", MADE)
SIZE = {"max_steps": 400, "max_pixels": 12_000, "max_gaussians": 8_000}
KEY = ("scene", "undistort", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")
WOLF = DATA / "splats" / "wolf" / "wolf.ply"
WIDTH, HEIGHT = 480, 320
TURNS = 9
SETTINGS = {
    "`fast`": RenderSettings.preset("fast"),
    "`3dgut`": RenderSettings.preset("3dgut"),
    "`3dgut`, `culling=extent`": RenderSettings.preset("3dgut", culling="extent"),
    "`exact`": RenderSettings.preset("exact"),
}


def made_fisheye(folder: Path) -> Path:
    """A transforms.json of 25 photographs, 120x100, of 1,500 Gaussians before and beside a fisheye of 150 degrees."""
    generator = torch.Generator().manual_seed(0)
    count, width, height = 1_500, 120, 100
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    means *= 2 + 3 * torch.rand(count, 1, generator=generator)
    means[:, 2] = means[:, 2].abs() - 0.3
    quats = torch.randn(count, 4, generator=generator)
    scales = 0.03 + 0.2 * torch.rand(count, 3, generator=generator)
    colors = (torch.rand(count, 3, generator=generator) - 0.5) / 0.2820948
    g = drgs.Gaussians.from_arrays(means, quats, scales, torch.full((count,), 0.9), colors)
    focal = width / 2 / np.radians(75)
    frames = []
    for k in range(25):
        eye = (0.08 * (k - 12), 0.25 * np.sin(2.0 * k), 0.2 * np.cos(1.3 * k))
        pose = look_at(eye, (0.1 * np.sin(k), 0, 10), (0, -1, 0))
        camera = Camera(
            intrinsics(focal, focal, width / 2, height / 2), pose, width, height, "opencv_fisheye", (0,) * 4
        )
        with torch.no_grad():
            write_png(folder / f"{k:02}.png", drgs.render(g, camera, RenderSettings.preset("exact")).rgb.numpy())
        frames.append({"file_path": f"{k:02}.png", "transform_matrix": c2w_to_opengl(camera.c2w).tolist()})
    noisy = means + 0.05 * torch.randn(count, 3, generator=generator)
    head = [f"property float {k}" for k in "xyz"] + [f"property uchar {k}" for k in ("red", "green", "blue")]
    points = [f"{x:.5f} {y:.5f} {z:.5f} 128 128 128" for x, y, z in noisy.tolist()]
    ply = ["ply", "format ascii 1.0", f"element vertex {count}", *head, "end_header", *points]
    (folder / "points.ply").write_text("\n".join(ply) + "\n")
    lens = {"camera_model": "OPENCV_FISHEYE", "fl_x": focal, "fl_y": focal, "w": width, "h": height}
    data = {**lens, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def measured(scene: str, undistort: str, seed: int, offset: int) -> dict:
    """One fit for `fast`, and its held-out photographs, undistorted (on) and as they were taken (off)."""
    fast = RenderSettings.preset("fast")
    config = FitConfig().replace(
        settings=fast,
        renderers=("fast",),
        undistort=undistort,
        skybox="off",
        seed=seed,
        test_offset=offset,
        **SIZE,
    )
    done = fitted(scene, config)
    psnr = {}
    for use in ("on", "off"):
        frames = load_frames(done.test, config.data.max_pixels, config.data.mask, use)
        psnr[use] = psnr_by_renderer(done.gaussians, frames, {"fast": fast})["fast"]
    return {
        **dict(zip(KEY, (Path(scene).name, undistort, seed, offset, *SIZE.values()), strict=True)),
        "psnr": psnr,
        "cropped": statistics.mean(lost_share(view.camera) for view in done.test),
        "seconds": done.process_seconds,
        **ran(),
    }


def table(found: list[dict]) -> str:
    """Held-out PSNR of both fits of each capture and seed."""
    lines = ["| capture, seed (held out) | cropped | fitted to | seen as taken | seen undistorted | seconds |"]
    lines += ["|---|---|---|---|---|---|"]
    words = {"on": "undistorted photographs", "off": "photographs as taken"}
    for row in sorted(found, key=lambda row: (row["scene"], row["seed"], row["undistort"])):
        cells = [
            f"{row['scene']}, {row['seed']} ({len(row['psnr']['on'])})",
            f"{row['cropped']:.1%}",
            words[row["undistort"]],
        ]
        for use in ("off", "on"):
            cells.append(f"{statistics.mean(row['psnr'][use]):.2f} / {min(row['psnr'][use]):.2f}")
        lines.append(f"| {' | '.join(cells)} | {row['seconds']:.0f} |")
    return "\n".join(lines)


def cameras(center: np.ndarray, reach: float) -> dict[str, Camera]:
    """A camera before the wolf, with lenses of one focal length, and with a rolling shutter."""
    w2c = look_at(center + np.array([0.36, -0.24, -2.28]) * reach, center, (0, -1, 0))
    focal = 1.1 * WIDTH
    pinhole = Camera(intrinsics(focal, focal, WIDTH / 2 + 3, HEIGHT / 2 - 5), w2c, WIDTH, HEIGHT)
    end = pinhole.w2c.copy()
    end[:3, 3] += np.array([0.02, 0.01, 0.0]) * reach
    return {
        "pinhole": pinhole,
        "opencv": dataclasses.replace(pinhole, model="opencv", distortion=(-0.1, 0.02, 1e-3, -5e-4)),
        "fisheye": dataclasses.replace(pinhole, model="opencv_fisheye", distortion=(0.03, -0.01, 0.004, -0.001)),
        "f-theta": dataclasses.replace(
            pinhole, model="ftheta", distortion=(1.0, 0.01, -0.02, 0.004, -0.001, 1.0, 0.0, 0.0)
        ),
        "rolling": dataclasses.replace(pinhole, shutter="rolling_top_to_bottom", w2c_end=end),
    }


def frame(g: drgs.Gaussians, camera: Camera, settings: RenderSettings, backward: bool):
    """A frame, with or without the gradients of its sum of squares."""
    leaves = {name: x.detach().clone().requires_grad_(backward) for name, x in g.parameters().items()}
    moving = g.replace(**leaves)

    def run() -> None:
        with torch.set_grad_enabled(backward):
            out = drgs.render(moving, camera, settings, outputs=())
        if backward:
            out.rgb.square().sum().backward()
            for leaf in leaves.values():
                leaf.grad = None

    return run


def times() -> dict:
    """Milliseconds of a frame, by preset, with and without gradients, and by lens."""
    g = drgs.load_ply(WOLF)
    means = g.means.detach().numpy()
    center = np.median(means, 0)
    views = cameras(center, float(np.quantile(np.linalg.norm(means - center, axis=1), 0.9)))
    found = []
    for preset, settings in SETTINGS.items():
        for backward in (False, True):
            runs = {name: frame(g, view, settings, backward) for name, view in views.items()}
            took = interleaved(runs, TURNS, time.process_time)
            found.append({"preset": preset, "backward": backward, "ms": {name: 1000 * x for name, x in took.items()}})
    return {"gaussians": len(g), "times": found, **ran()}


def times_table(result: dict) -> str:
    """Milliseconds of a pinhole's frame, and what lenses take over it."""
    lines = ["| preset | | pinhole | `opencv` | `opencv_fisheye` | `ftheta` | rolling shutter |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for row in result["times"]:
        plain = row["ms"]["pinhole"]
        ratios = [f"{row['ms'][name] / plain:.2f}" for name in ("opencv", "fisheye", "f-theta", "rolling")]
        what = "image and gradients" if row["backward"] else "image"
        lines.append(f"| {row['preset']} | {what} | {plain:.0f} ms | {' | '.join(ratios)} |")
    return "\n".join(lines)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of captures, or folders")
    parser.add_argument("--seeds", type=int, default=2, choices=range(1, len(UNITS) + 1))
    parser.add_argument("--times", action="store_true", help="measure what lenses cost, fit nothing")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the tables of what there is")
    args = parser.parse_args()
    if args.times:
        TIMES.write_text(json.dumps(times(), indent=1) + "\n")
    done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
    made = tempfile.TemporaryDirectory()
    for name in [] if args.page or args.times else args.scenes:
        scene = name
        if name == MADE:
            (folder := Path(made.name) / MADE).mkdir()
            scene = str(made_fisheye(folder))
        for seed, offset in UNITS[: args.seeds]:
            for undistort in ("on", "off"):
                if (Path(scene).name, undistort, seed, offset, *SIZE.values()) not in done:
                    row = measured(scene, undistort, seed, offset)
                    add_row(ROWS, row)
                    print(
                        scene, undistort, seed, {use: statistics.mean(x) for use, x in row["psnr"].items()}, flush=True
                    )
    made.cleanup()
    texts = {"lenses": table(read_rows(ROWS))}
    if TIMES.exists():
        texts["lens-times"] = times_table(json.loads(TIMES.read_text()))
    for name, text in texts.items():
        print(text)
        write_csv(PAGE_DATA / f"{name}.csv", table_lines(text))


if __name__ == "__main__":
    main()
