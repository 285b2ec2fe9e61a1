"""What is left of a scene when Gaussians are removed: by their removal error, and by the scores of other methods.

    python benchmarks/prune.py --runs runs/prune [--scenes banana head] [--page]

Scenes are fits of captures in folders of --runs by the capture's name, each made as

    drgs fit $DRGS_DATA/NAME -o runs/prune/NAME --max-steps 700 --max-pixels 30000 --max-gaussians 12000 --for fast

(every 8th view held out), and two splats that others trained, without photographs: their truth is what the whole splat
shows in views of an orbit, every 4th of them held out. Every method sees the same training views, removes to the same
number of Gaussians, and is measured in the held-out views: what is left as it is and, of four methods, after 200 steps
of `drgs.pruning.fit_on`, which fits a splat as `drgs fit` does by default. Appends a row for each to
benchmarks/prune.jsonl, leaves out what is there, and writes table, picture and data of docs/prune.md. One thread.

Scores, the larger the more needed:

    opacity         alpha
    weight          sum over pixels of the compositing weight
    lightgaussian   hits x alpha x (volume / V)^0.1, V the volume that 90 % exceed; a hit is a pixel where preset
                    `inria` composites it. Fan et al., NeurIPS 2024, and `calculate_v_imp_score` of its code
    pup             log det of the 6x6 block of J^T J by mean and scales. Hanson et al., CVPR 2025, eq. 8
    pup_log         the same by mean and log-scales, as its code without CUDA has it
    gaussianpop     the squared removal error, once: the criterion of arXiv 2602.06830
    squared         the same in five rounds
    lengths         the sum of lengths |C - C'| in place of squares, in five rounds
    removal         the sum of |C - C'|^1.5 in five rounds: `drgs.prune`, whose power was chosen of these three on
                    `banana`, `head` and `train_1000`

Of two captures, at half of the Gaussians, `drgs.prune` is measured with more rounds and by other renderers, too.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import drjit as dr  # noqa: E402
import torch  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs import fisher  # noqa: E402
from drgs.cameras import Camera, orbit  # noqa: E402
from drgs.codecs import load_gaussians  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import Frame, frames_for, load_dataset  # noqa: E402
from drgs.fitting.metrics import through_renderers  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.information.quantity import ViewContext  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.pruning import fit_on, prune  # noqa: E402
from drgs.settings import PRESETS, RenderSettings  # noqa: E402
from drgs.studies.tables import markdown_table  # noqa: E402
from drgs.tracing.sums import add_row as add_sums  # noqa: E402

ROWS = ROOT / "benchmarks" / "prune.jsonl"
PAGE = ROOT / "docs" / "prune.md"
PICTURE = ROOT / "docs" / "pictures" / "prune.png"
CAPTURES = ("banana", "bonsai", "head", "lego")
SPLATS = {"wolf": "splats/wolf/wolf.ply", "train_1000": "splats/train_1000/train-1000.ply"}
METHODS = ("opacity", "weight", "lightgaussian", "pup", "pup_log", "gaussianpop", "squared", "lengths", "removal")
POWERS = {"squared": {"power": 2}, "lengths": {"power": 1}}
VARIANTS: dict[str, dict] = {
    "1 round": {"rounds": 1},
    "20 rounds": {"rounds": 20},
    "by exact": {"preset": "exact"},
    "by gsplat": {"preset": "gsplat"},
}
"""Name -> how `drgs.prune` differs from its defaults; of `VARIED` at a share of `VARIED_KEEP` alone."""
VARIED = ("banana", "head")
VARIED_KEEP = 0.5
KEEP = (0.7, 0.5, 0.3, 0.1)
STEPS = 200
REFITTED = ("removal", "opacity", "lightgaussian", "pup")
"""Methods whose Gaussians are fitted on, too."""
RENDERERS = tuple(name for name in PRESETS if name != "mitsuba")
SHOWN = "fast"
"""The renderer of the page's table; the baselines are measured by it and by `gsplat` alone."""
MOST_VIEWS = 24  # training views, evenly spaced
HELD_OUT = 6  # likewise
ORBIT = 24  # views of a splat without photographs


class Scene:
    """A scene with its views.

    Attributes:
        name: Its name.
        gaussians: All of it.
        train, held_out: Photographs, or what stands for them.
        config: Configuration to fit on with.
    """

    def __init__(self, name: str, runs: Path) -> None:
        self.name = name
        self.config = FitConfig()
        if name in SPLATS:
            self.gaussians = load_gaussians(DATA / SPLATS[name])
            frames = [self._frame(camera) for camera in self._orbit()]
            self.held_out = frames[::4]
            self.train = [frame for k, frame in enumerate(frames) if k % 4]
            return
        run = load_run(runs / name)
        self.gaussians = run.gaussians
        self.config = config = run.record.config
        dataset = load_dataset(DATA / name, config, points=False, semantics=False)
        train, test = run.record.with_refined_poses(dataset).split()
        self.train = frames_for(evenly(train, MOST_VIEWS), config.data)
        self.held_out = frames_for(evenly(test, HELD_OUT), config.data)

    def _orbit(self) -> list[Camera]:
        """Around the middle of the Gaussians, so far that nine of ten are in the picture; at three heights."""
        means = self.gaussians.means.double()
        middle = means.median(0).values
        size = float((means - middle).norm(dim=1).quantile(0.9))
        turns = [
            orbit(tuple(middle.tolist()), 2.2 * size, ORBIT, width=200, height=150, elevation=e, up=(0.0, -1.0, 0.0))
            for e in (-10.0, 15.0, 40.0)
        ]
        return [turns[k % 3][k] for k in range(ORBIT)]

    def _frame(self, camera: Camera) -> Frame:
        """What the whole splat shows, in the order of exact rays."""
        image = render(self.gaussians, camera, RenderSettings.preset("exact"), outputs=()).rgb.clamp(0, 1)
        return Frame(camera.name, camera, image)

    def settings(self, preset: str) -> RenderSettings:
        """A preset over the scene's background."""
        return RenderSettings.preset(preset, background=self.config.settings.background)

    def views(self) -> Iterator[tuple[Camera, torch.Tensor | None]]:
        """Cameras and masks of the training views."""
        return ((frame.camera, frame.mask) for frame in self.train)

    def pruned(self, keep: float, preset: str = "fast", **options: int) -> Gaussians:
        """What `drgs.prune` leaves, without what no view shows, as other methods remove that first."""
        cameras, masks = zip(*self.views(), strict=True)
        settings = self.settings(preset)
        return prune(
            self.gaussians, list(cameras), settings, keep=keep, masks=list(masks), unseen="remove", **options
        ).gaussians

    def psnr(self, gaussians: Gaussians, renderers: tuple[str, ...] = RENDERERS) -> dict[str, float]:
        """Renderer -> mean PSNR of the held-out views; of the object where masks or alpha say where that is."""
        settings = {name: self.settings(name) for name in renderers}
        rows = through_renderers(gaussians, self.held_out, settings, "test")["rows"]
        return {row["name"]: row["mean"].get("psnr_object", row["mean"]["psnr"]) for row in rows}


def evenly(views: list, most: int) -> list:
    """At most so many, evenly spaced."""
    return [views[k * len(views) // most] for k in range(most)] if len(views) > most else views


class _Hits:
    """A sink of `drgs.information.replay.Replay` that counts hits."""

    needs_color = False

    def __init__(self, lib, count: int, mode: dr.ReduceMode) -> None:
        self.buffer = dr.zeros(lib.Float, count)
        self.mode = mode

    def init(self, k: int) -> dict:
        return {}

    def take(self, lib, index, hits, rows, states):
        total = sum((dr.select(row.w > 0, lib.Float(1), 0) for row in rows), lib.Float(0))
        add_sums(lib, self.buffer, [total], index, 1, 0, hits, self.mode)
        return states


class _CountedHits:
    """Sums over the hits of a view: how many pixels composite each Gaussian."""

    def __init__(self, count: int) -> None:
        self.total = torch.zeros(count, dtype=torch.float64)
        self._sinks: list[_Hits] = []

    def sink(self, replay, walk) -> _Hits:
        self._sinks.append(_Hits(replay.lib, replay.count, walk.part.reduction))
        return self._sinks[-1]

    def counts(self) -> torch.Tensor:
        return sum((sink.buffer.torch().double() for sink in self._sinks), self.total)


def score(method: str, scene: Scene) -> torch.Tensor:
    """(N,) the larger, the more a method needs a Gaussian."""
    g, fast = scene.gaussians, scene.settings("fast")
    alpha = g.logit_opacities.double().sigmoid()
    if method == "opacity":
        return alpha
    if method == "gaussianpop":
        views = list(scene.views())
        return fisher.removal_error(g, [x for x, _ in views], fast, masks=[mask for _, mask in views])
    total = torch.zeros(len(g), dtype=torch.float64)
    if method == "weight":
        for camera, _ in scene.views():
            total += render(g, camera, fast, outputs=("visibility",)).visibility
        return total
    if method == "lightgaussian":
        for camera, _ in scene.views():
            hits = _CountedHits(len(g))
            ViewContext(g, camera, scene.settings("inria")).replay(geometry=False).add_up(hits)
            total += hits.counts()
        volume = g.log_scales.double().sum(1).exp()
        large = volume.sort(descending=True).values[int(0.9 * len(g))]
        return total * alpha * (volume / large) ** 0.1
    views = list(scene.views())
    blocks = fisher.blocks(g, [x for x, _ in views], fast, masks=[mask for _, mask in views])
    which = torch.tensor([0, 1, 2, 6, 7, 8])  # means and log-scales
    found = torch.linalg.slogdet(blocks[:, which][:, :, which]).logabsdet
    return found - (2 * g.log_scales.double().sum(1) if method == "pup" else 0)


def measure(scene: Scene, done: set[tuple], methods: list[str], shares: list[float], is_fitted_on: bool) -> None:
    """Add the rows of a scene that are not there; those that are fitted on only where that is asked for."""
    stamp = ran()

    def add(method: str, keep: float, steps: int, gaussians: Gaussians, seconds: float) -> None:
        row = {"scene": scene.name, "method": method, "keep": keep, "steps": steps, "gaussians": len(gaussians)}
        renderers = RENDERERS if method in ("whole", "removal") else (SHOWN, "gsplat")
        add_row(ROWS, {**row, "psnr": scene.psnr(gaussians, renderers), "seconds": round(seconds, 1), **stamp})
        print(scene.name, method, keep, steps, flush=True)

    g = scene.gaussians

    def steps_of(method: str) -> list[int]:
        return [0, STEPS] if is_fitted_on and method in ("whole", *REFITTED) else [0]

    for steps in steps_of("whole"):
        if (scene.name, "whole", 1.0, steps) not in done:
            add("whole", 1.0, steps, fit_on(g, scene.train, scene.config, steps) if steps else g, 0.0)
    known = [row for row in read_rows(ROWS) if (row["scene"], row["method"]) == (scene.name, "removal")]
    counts = {row["keep"]: row["gaussians"] for row in known}
    scores: dict[str, tuple[torch.Tensor, float]] = {}
    for method in methods:
        if method in VARIANTS and scene.name not in VARIED:
            continue
        for keep in (VARIED_KEEP,) if method in VARIANTS else shares:
            missing = [x for x in steps_of(method) if (scene.name, method, keep, x) not in done]
            if not missing:
                continue
            began = time.perf_counter()
            how = {"removal": {}, **POWERS, **VARIANTS}
            if method in how:
                left = scene.pruned(keep, **how[method])
            else:
                if method not in scores:
                    scores[method] = score(method, scene), time.perf_counter() - began
                left = g.take(scores[method][0].argsort(descending=True)[: counts.get(keep, round(keep * len(g)))])
            counts[keep] = len(left)
            seconds = time.perf_counter() - began
            for steps in missing:
                fitted = fit_on(left, scene.train, scene.config, steps) if steps else left
                add(method, keep, steps, fitted, seconds)


# ------------------------------------------------------------------------------------------ page


def found(rows: list[dict]) -> dict[tuple, float]:
    """(scene, method, keep, steps) -> held-out PSNR of the renderer that is shown."""
    return {(r["scene"], r["method"], r["keep"], r["steps"]): r["psnr"][SHOWN] for r in rows}


def scenes_of(rows: list[dict]) -> list[str]:
    """Scenes that drgs has been measured on at every share, in their order."""
    values = found(rows)
    return [x for x in (*CAPTURES, *SPLATS) if all((x, "removal", keep, 0) in values for keep in KEEP)]


def halves(rows: list[dict]) -> str:
    """Half of the Gaussians: scenes against methods."""
    values = found(rows)
    named = {
        "whole": 1.0,
        **dict.fromkeys(("removal", "lightgaussian", "opacity", "pup"), 0.5),
    }
    fitted = {"whole": 1.0, "removal": 0.5, "lightgaussian": 0.5}
    lines = []
    for scene in scenes_of(rows):
        keys = [(scene, x, keep, 0) for x, keep in named.items()]
        keys += [(scene, x, keep, STEPS) for x, keep in fitted.items()]
        lines.append([scene, *(f"{values[key]:.2f}" if key in values else "" for key in keys)])
    titles = {"removal": "drgs"}
    heads = [titles.get(x, x) for x in named] + [f"{titles.get(x, x)}, {STEPS} steps" for x in fitted]
    return markdown_table(["scene", *heads], lines)


def sheet(rows: list[dict]) -> list[list[str]]:
    """The data file: every row."""
    lines = [["scene", "method", "keep", "steps", "gaussians", *RENDERERS, "seconds", "commit", "date", "machine"]]
    rank = {name: k for k, name in enumerate((*CAPTURES, *SPLATS, "whole", *METHODS, *VARIANTS))}
    for row in sorted(rows, key=lambda row: (rank[row["scene"]], rank[row["method"]], -row["keep"], row["steps"])):
        psnr = [f"{row['psnr'][x]:.3f}" if x in row["psnr"] else "" for x in RENDERERS]
        head = [row["scene"], row["method"], f"{row['keep']:g}", str(row["steps"]), str(row["gaussians"])]
        lines.append([*head, *psnr, f"{row['seconds']:g}", row["commit"][:8], row["date"], row["machine"]])
    return lines


def plot(rows: list[dict]) -> None:
    """Curves of every method, a panel a scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    values, scenes = found(rows), scenes_of(rows)
    figure, panels = plt.subplots(2, -(-len(scenes) // 2), figsize=(12, 6.4), squeeze=False)
    styles = {
        "removal": ("black", "-"),
        "squared": ("tab:purple", "-"),
        "lengths": ("gray", "-"),
        "gaussianpop": ("tab:purple", ":"),
        "weight": ("tab:green", "-"),
    }
    styles |= {"opacity": ("tab:orange", "-"), "lightgaussian": ("tab:blue", "-"), "pup": ("tab:red", "-")}
    styles |= {"pup_log": ("tab:red", ":")}
    for panel in panels.flat[len(scenes) :]:
        panel.set_axis_off()
    for scene, panel in zip(scenes, panels.flat, strict=False):
        whole = values[scene, "whole", 1.0, 0]
        for method, (color, line) in styles.items():
            curve = [values.get((scene, method, keep, 0), float("nan")) for keep in KEEP]
            label = {
                "removal": "drgs",
                "squared": "squared error, five rounds",
                "gaussianpop": "squared error, one round",
            }
            label = label.get(method, method)
            keep = KEEP if scene in SPLATS else (1.0, *KEEP)
            panel.plot(keep, curve if scene in SPLATS else [whole, *curve], line, color=color, label=label)
        for method in REFITTED:
            fitted = [keep for keep in KEEP if (scene, method, keep, STEPS) in values]
            curve = [values[scene, method, keep, STEPS] for keep in fitted]
            label = f"{'drgs' if method == 'removal' else method}, {STEPS} steps"
            panel.plot(fitted, curve, "o--", color=styles[method][0], ms=4, label=label)
        panel.set_title(scene)
        panel.set_xlabel("share that is kept")
        panel.invert_xaxis()
        panel.grid(alpha=0.3)
    for row in panels:
        row[0].set_ylabel("held-out PSNR, dB")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), ncol=4, loc="lower center", frameon=False)
    figure.tight_layout(rect=(0, 0.13, 1, 1))
    figure.savefig(PICTURE, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/prune"))
    parser.add_argument("--scenes", nargs="*", default=[*CAPTURES, *SPLATS])
    # Ours first: all methods keep as many Gaussians as it does.
    methods = ["removal", *(x for x in METHODS if x != "removal"), *VARIANTS]
    parser.add_argument("--methods", nargs="*", default=methods)
    parser.add_argument("--shares", nargs="*", type=float, default=KEEP)
    parser.add_argument("--no-refit", action="store_true", help="only rows that are not fitted on")
    parser.add_argument("--page", action="store_true", help="only write the page")
    args = parser.parse_args()
    for name in () if args.page else args.scenes:
        done = {tuple(row[key] for key in ("scene", "method", "keep", "steps")) for row in read_rows(ROWS)}
        measure(Scene(name, args.runs), done, args.methods, args.shares, not args.no_refit)
    rows = read_rows(ROWS)
    fill_between(PAGE, "halves", halves(rows))
    write_csv(PAGE_DATA / "prune.csv", sheet(rows))
    plot(rows)


if __name__ == "__main__":
    main()
