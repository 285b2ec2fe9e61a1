"""Things that move fast, filmed by one camera at a time, in scenes that others made: what a fit shows of them.

    python benchmarks/bodies.py [NAME ...] [--page] [--pictures FOLDER]

Appends one row a scene, background, seed and kind of fit to benchmarks/bodies.jsonl as it ends, leaves out what is
there, then writes docs/data/moving-bodies.csv (every fit) and a paragraph of docs/dynamic-data.md (those before white).
Scenes are those of the folder `bodies`: the layout of D-NeRF, masks of instances beside the photographs. PSNR is also
that of the pixels of bodies that move alone, and their masks are compared with what is rendered as moving: where
Gaussians that the field moves or that are there for a time make up more than half of a pixel. Pixels outside the masks
that change all the same, such as those of shadows, count neither way: where a photograph differs from the median of
those of its camera.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.display.pictures import write_png  # noqa: E402
from drgs.ellipsoids import Y_00  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import Frame, load_frames  # noqa: E402
from drgs.fitting.metrics import psnr  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "bodies.jsonl"
PAGE = ROOT / "docs" / "dynamic-data.md"
CSV = ROOT / "docs" / "data" / "moving-bodies.csv"
SCENES = ("collision", "occlusion", "deformation")
STILL = ("background", "wall", "cube")
"""Instances that stand still."""
GROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
SEEDS = (0, 1, 2)
CHANGES = 0.05  # mean difference of the colors of a pixel from what its camera sees at most times
CONFIG = FitConfig().replace(
    max_steps=3000, max_pixels=150 * 150, max_gaussians=8000, field_preset="dnerf", renderers=("fast",)
)


def bodies(scene: str, frame: Frame) -> torch.Tensor:
    """(H, W) bool, where a photograph shows one that moves."""
    folder = DATA / "bodies" / scene
    names = json.loads((folder / "class_mapping.json").read_text())
    split, name = frame.name.split("/")
    labels = cv2.imread(str(folder / split / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    labels = cv2.resize(labels, (frame.camera.width, frame.camera.height), interpolation=cv2.INTER_NEAREST)
    return torch.from_numpy(~np.isin(labels, [int(key) for key, what in names.items() if what in STILL]))


def usual(frames: list[Frame], one: Frame) -> torch.Tensor:
    """(H, W, 3) what the camera of a photograph sees at most times."""
    same = [frame.image() for frame in frames if np.allclose(frame.camera.w2c, one.camera.w2c, atol=1e-6)]
    return torch.stack(same).median(0).values


def measured(scene: str, run: Path, ground: tuple[float, ...], pictures: Path | None = None) -> dict:
    """What the test views of a run show."""
    dataset = load(DATA / "bodies" / scene, background=ground)
    everything = load_frames(dataset.views, CONFIG.data.max_pixels)
    names = {view.name for view in dataset.split()[1]}
    moving = load_run(run).scene
    shown = moving.moving | moving.has_lifespan
    rows, strips = [], []
    for frame in (frame for frame in everything if frame.name in names):
        at = moving.at(frame.camera.time)
        with torch.no_grad():  # looked at
            image = render(at, frame.camera, CONFIG.settings.replace(background=ground)).rgb.cpu().clamp(0, 1)
            sh = torch.full((len(at), 1, 3), -0.5 / Y_00)
            sh[shown] = 0.5 / Y_00
            found = render(at.replace(sh=sh), frame.camera, CONFIG.settings).rgb[..., 0].cpu() > 0.5
        mask, truth = bodies(scene, frame), frame.image()
        neither = ~mask & ((truth - usual(everything, frame)).abs().mean(2) > CHANGES)
        union = (found & ~neither) | mask
        rows.append(
            {
                "view": frame.name,
                "psnr": psnr(image, truth),
                "psnr_moving": psnr(image, truth, mask.float()) if mask.any() else None,
                "overlap": float((found & mask).sum() / union.sum()) if mask.any() else None,
            }
        )
        maps = [mask, found]
        strips.append(torch.cat([truth, image, *[x[..., None].float().expand(-1, -1, 3) for x in maps]], 0))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        write_png(pictures / f"{run.name}.png", torch.cat(strips, 1).numpy())
    told = {"views": rows, "share": float(shown.float().mean())}
    for key in ("psnr", "psnr_moving", "overlap"):
        values = [row[key] for row in rows if row[key] is not None]
        told |= {key: float(np.mean(values)), f"worst_{key}": float(np.min(values))}
    return told


def summary(rows: list[dict]) -> str:
    """What docs/dynamic-data.md says, before white: means over seeds of both kinds of fit, and the worst overlap."""
    told = []
    fits = [row for row in rows if row["ground"] == "white" and row["lives"] == "auto"]
    for scene in SCENES:
        auto = [row for row in fits if row["scene"] == scene]
        off = [row for row in rows if (row["scene"], row["ground"], row["lives"]) == (scene, "white", "off")]
        psnr, psnr_off = (np.mean([row["psnr_moving"] for row in kind]) for kind in (auto, off))
        told.append(f"{psnr:.1f} ({psnr_off:.1f}) dB in `{scene}`")
    overlap = min(row["worst_overlap"] for row in fits)
    return paragraph(
        "Pixels of bodies moved by a physics simulator, photographed by one of 12 cameras at each time, have "
        f"{told[0]}, {told[1]} and {told[2]} (in parentheses: `--lives off`); the IoU of their masks with rendered "
        f"motion is {overlap:.2f} at worst ([{len(fits)} fits](data/moving-bodies.csv), `python benchmarks/bodies.py`, "
        f"{fits[-1]['machine']}, {fits[-1]['date']})."
    )


def csv_lines(rows: list[dict]) -> Iterator[list[str]]:
    """Every fit: means over its test views, and the worst of them."""
    kinds = ("scene", "ground", "lives", "seed")
    digits = {"psnr": 2, "psnr_moving": 2, "overlap": 3}
    yield [
        *kinds,
        *(name for key in digits for name in (key, f"worst_{key}")),
        *("share_that_moves_or_lives", "seconds", "machine", "date", "commit"),
    ]
    order = lambda row: (SCENES.index(row["scene"]), row["ground"] != "white", row["lives"], row["seed"])  # noqa: E731
    for row in sorted(rows, key=order):
        values = [f"{row[name]:.{x}f}" for key, x in digits.items() for name in (key, f"worst_{key}")]
        ran_at = [row["machine"], row["date"], row["commit"]]
        yield [*(str(row[key]) for key in kinds), *values, f"{row['share']:.3f}", f"{row['seconds']:.0f}", *ran_at]


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=SCENES, help="scenes; default all")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the page of what is there")
    parser.add_argument("--pictures", type=Path, help="where truth, image and both masks of all views are drawn")
    parser.add_argument("--seeds", type=int, nargs="*", default=SEEDS, help="default 0 1 2")
    parser.add_argument("--kinds", default="white:auto,white:off,black:auto,black:off", help="background:lives, ...")
    args = parser.parse_args()
    key = lambda row: tuple(row[k] for k in ("scene", "ground", "lives", "seed"))  # noqa: E731
    for seed in () if args.page else args.seeds:
        for kind in args.kinds.split(","):
            for scene in args.names:
                ground, lives = kind.split(":")
                if (scene, ground, lives, seed) in {key(row) for row in read_rows(ROWS)}:
                    continue
                settings = CONFIG.settings.replace(background=GROUNDS[ground])
                motion = {"lives": lives}
                config = CONFIG.replace(seed=seed, settings=settings).replace(**motion)
                with tempfile.TemporaryDirectory() as folder:
                    run = Path(folder) / f"{scene}_{ground}_{lives}_{seed}"
                    began = time.process_time()
                    fit(load(DATA / "bodies" / scene, background=GROUNDS[ground]), run, config, progress=False)
                    row = {"scene": scene, "ground": ground, "lives": lives, "seed": seed}
                    row |= {"seconds": time.process_time() - began}
                    row |= measured(scene, run, GROUNDS[ground], args.pictures)
                add_row(ROWS, row | ran())
                print({k: x for k, x in row.items() if k != "views"}, flush=True)
    rows = read_rows(ROWS)
    write_csv(CSV, csv_lines(rows))
    fill_between(PAGE, "bodies", summary(rows))


if __name__ == "__main__":
    main()
