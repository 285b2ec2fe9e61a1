"""What it costs to know what features say about the geometry, and how far the estimates of it are off.

    python benchmarks/coupled.py RUN [--quick] [--print]     benchmarks/coupled.json and what --page writes
    python benchmarks/coupled.py --page                      the paragraph of docs/semantic.md, docs/data/coupled.csv

RUN is a run that was fitted with features. Times are CPU time of the process, which other programs on the machine
change little, peers taking turns, medians; run it with DRGS_THREADS=1. Errors are against the estimate `exact`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, rank_correlation, write_csv  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import fisher  # noqa: E402
from drgs.cameras import Camera  # noqa: E402
from drgs.data import load  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.files import Run  # noqa: E402
from drgs.fisher import SemanticMetric  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.gain import information_gain  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

Preset = drgs.RenderSettings.preset
GEOMETRY = ("means", "rotations", "log_scales", "logit_opacities")
COUNTS = (1, 2, 4, 8, 16)
RESULTS = ROOT / "benchmarks" / "coupled.json"
CRITERIA = ("eig", "logdet")


def costs(g: Gaussians, camera: Camera, metric: SemanticMetric, preset: str, turns: int) -> dict[str, float]:
    """Seconds of one view: rendered, its diagonal of colors, and with features by every estimate."""
    settings = Preset(preset)
    colors = g.replace(features=None)
    runs = {
        "render": lambda: drgs.render(colors, camera, settings, outputs=()),
        "colors": lambda: fisher.diagonal(colors, camera, settings),
        "colors, blocks": lambda: fisher.blocks(colors, camera, settings),
    }
    for K in COUNTS:
        m = dataclasses.replace(metric, samples=K)
        runs[f"{K}"] = lambda m=m: fisher.diagonal(g, camera, settings, semantics=m)
    runs["8, blocks"] = lambda: fisher.blocks(g, camera, settings, semantics=metric)
    exact = dataclasses.replace(metric, estimate="exact")
    runs["exact"] = lambda: fisher.diagonal(g, camera, settings, semantics=exact)
    return interleaved(runs, turns, time.process_time)


def added(a: dict, b: dict) -> dict:
    """Information of two kinds of rows."""
    return {name: a.get(name, 0) + b.get(name, 0) for name in {**a, **b}}


def errors(g: Gaussians, views: list[Camera], metric: SemanticMetric, seeds: int) -> dict:
    """Errors of entries and of the scores of all views but the first two, which are known, by estimate, on `fast`."""
    settings = Preset("fast")
    colors = [fisher.diagonal(g, view, settings, groups=(*GEOMETRY, "sh")) for view in views]

    def features(m: SemanticMetric) -> list[dict]:
        groups = (*GEOMETRY, "features")
        none = (0.0, 0.0, 0.0)
        return [fisher.diagonal(g, x, settings, semantics=m, channel_weights=none, groups=groups) for x in views]

    def scores(found: list[dict], criterion: str) -> np.ndarray:
        both = [added(a, b) for a, b in zip(colors, found, strict=True)]
        H = added(both[0], both[1])
        return np.array([information_gain(x, H, criterion).total for x in both[2:]])

    exact = features(dataclasses.replace(metric, estimate="exact"))
    truth = {criterion: scores(exact, criterion) for criterion in CRITERIA}
    only = scores([{"features": x["features"]} for x in exact], "eig")
    trace = [sum(float(x[name].sum()) for x in kind for name in GEOMETRY) for kind in (exact, colors)]
    best, second = np.sort(truth["eig"])[::-1][:2]
    result: dict = {
        "share of the trace": trace[0] / sum(trace),
        "tau of uncoupled": rank_correlation(only, truth["eig"], "kendall"),
        "margin": float((best - second) / best),
        "views": len(views) - 2,
    }
    for estimate in ("collapsed", "principal"):
        for K in COUNTS:
            rows = []
            for seed in range(seeds):
                found = features(dataclasses.replace(metric, estimate=estimate, samples=K, seed=seed))
                ratios = torch.cat(
                    [
                        (a[name] / b[name])[b[name] > 1e-6 * b[name].max()].reshape(-1) - 1
                        for a, b in zip(found, exact, strict=True)
                        for name in GEOMETRY
                    ]
                )
                row = [float(ratios.abs().median()), float(ratios.square().mean().sqrt())]
                for criterion, x in truth.items():
                    y = scores(found, criterion)
                    row += [float(np.std(y / x)), rank_correlation(x, y, "kendall"), float(1 - x[y.argmax()] / x.max())]
                rows.append(row)
            result[f"{estimate} {K}"] = np.mean(rows, 0).tolist()
            print(estimate, K, result[f"{estimate} {K}"], flush=True)
    return result


def report(r: dict) -> str:
    """What docs/semantic.md says."""
    errors, fast, exact = r["errors"]["principal 8"], r["fast"], r["exact"]
    ours, whole = ([t[key] / t["colors"] for t in (fast, exact)] for key in ("8", "exact"))
    return paragraph(
        f"With {r['width']} channels and {r['gaussians']:,} Gaussians a view's diagonal takes {ours[0]:.2f} times as "
        f"long as of the colors alone by `fast` and {ours[1]:.2f} by `exact`, where all directions take {whole[0]:.1f} "
        f"and {whole[1]:.1f}. Its entries are off by {100 * errors[0]:.2g} % (median) and scores of `eig` by "
        f"{100 * errors[2]:.2g} % ([every estimate](data/coupled.csv); `python benchmarks/coupled.py RUN`, "
        f"{r['machine']}, {r['date']})."
    )


def sheet(r: dict) -> list[list[str]]:
    """The data file: every estimate, one view's diagonal in milliseconds of the processor, and all errors."""
    errors = [f"{of}_{what}" for of in ("eig", "logdet") for what in ("error", "tau", "regret")]
    lines = [["estimate", "channels", "fast_ms", "exact_ms", "entries_median", "entries_rms", *errors]]
    times = [f"{1e3 * r[preset]['colors']:.1f}" for preset in ("fast", "exact")]
    uncoupled = f"{r['errors']['tau of uncoupled']:.3f}"
    lines.append(["colors and uncoupled features", "0", *times, "", "", "", uncoupled, "", "", "", ""])
    for estimate in ("collapsed", "principal"):
        for K in COUNTS:
            times = [f"{1e3 * r[preset][str(K)]:.1f}" for preset in ("fast", "exact")]
            lines.append([estimate, str(K), *times, *(f"{x:.3g}" for x in r["errors"][f"{estimate} {K}"])])
    times = [f"{1e3 * r[preset]['exact']:.1f}" for preset in ("fast", "exact")]
    lines.append(["exact", str(r["rank"]), *times, "0", "0", "0", "1", "0", "0", "1", "0"])
    return lines


def write_page(r: dict) -> None:
    """The paragraph and the data file."""
    fill_between(ROOT / "docs" / "semantic.md", "coupled", report(r))
    write_csv(PAGE_DATA / "coupled.csv", sheet(r))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path, nargs="?", help="a run that was fitted with features")
    parser.add_argument("--page", action="store_true", help="measure nothing, write what is in coupled.json")
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--print", action="store_true", help="do not touch docs/semantic.md")
    args = parser.parse_args()
    if args.page:
        write_page(json.loads(RESULTS.read_text()))
        return
    if args.run is None:
        parser.error("needs RUN, a run folder, or --page")
    loaded = load_run(Run(args.run))
    if loaded.decoder is None or loaded.gaussians.features is None:
        sys.exit(f"{args.run}: must be a run with features, has none; fit a data set with teacher maps")
    views = load(Run(args.run).config()["data"], points=False).views
    cameras = [view.camera.undistorted() for view in views]
    g = loaded.gaussians.detach()
    metric = SemanticMetric(loaded.decoder.metric())
    sizes = {"fast": (40, 30) if args.quick else (320, 240), "exact": (40, 30) if args.quick else (160, 120)}
    count, width = (4, 40) if args.quick else (14, 80)
    few = [cameras[k].resized(width, width * 3 // 4) for k in np.linspace(0, len(cameras) - 1, count).astype(int)]
    result = {
        **ran(),
        "run": args.run.name,
        "gaussians": len(g),
        "width": metric.width,
        "rank": int(torch.linalg.matrix_rank(metric.matrix)),
        "size": {preset: f"{w}x{h}" for preset, (w, h) in sizes.items()},
    }
    for preset, turns in (("fast", 5), ("exact", 3)):
        camera = cameras[len(cameras) // 2].resized(*sizes[preset])
        result[preset] = costs(g, camera, metric, preset, 1 if args.quick else turns)
        print(preset, result[preset], flush=True)
    result["errors"] = errors(g, few, metric, 1 if args.quick else 3)
    text = report(result)
    print(text)
    if not (args.print or args.quick):
        write_page(result)
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
