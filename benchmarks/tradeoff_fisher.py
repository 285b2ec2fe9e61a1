"""What cheaper estimates of the Fisher information cost in accuracy and give in speed.

    python benchmarks/tradeoff_fisher.py [--scenes office still_life cube] [--runs runs/studies]

Every method computes H of the training views and of every candidate, scores the candidates by `logdet` (relative prior
1e-3) and picks; `exact` on preset `exact` is the truth. Results go to benchmarks/tradeoff_fisher.json, the table and
the picture of docs/tradeoff.md and docs/data/tradeoff-fisher.csv.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import studies
import torch
from cubes import cube
from pages import fill_between
from studies import ROOT

import drgs
from drgs import fisher
from drgs.cameras import Camera, look_at
from drgs.gain import Prior, information_gain
from drgs.lab.tradeoff import scaled_diagonal
from drgs.studies.tables import markdown_table, paragraph

Preset = drgs.RenderSettings.preset
PRIOR = Prior(1e-3, relative=True)
CHUNKS = (1, 3, 12, 48)  # probes are drawn in these, so that K = 1, 4, 16, 64 share them
_LONGEST = 10.0  # seconds a view that nobody would spend on probes
METHODS = {
    "exact": (Preset("exact"), "exact", 1.0),
    "integral": (Preset("exact", response="integral"), "exact", 1.0),
    "order=center": (Preset("exact", order="center"), "exact", 1.0),
    "fast": (Preset("fast"), "exact", 1.0),
    "fast, half resolution": (Preset("fast"), "exact", 0.5),
    "fast, quarter resolution": (Preset("fast"), "exact", 0.25),
    "gsplat (ewa)": (Preset("gsplat"), "exact", 1.0),
    "fisherrf": (Preset("exact"), "fisherrf", 1.0),
    "fisherrf, inria": (Preset("inria"), "fisherrf", 1.0),
}


def made_cube() -> tuple:
    """Random Gaussians in a cube, 20 cameras around it."""
    g = cube(15_000, scale=0.03, sh_degree=1)
    rng = np.random.default_rng(0)
    cameras = []
    for k in range(20):
        eye = rng.normal(size=3)
        eye *= 4 / np.linalg.norm(eye)
        K = np.array([[180.0, 0, 80], [0, 180.0, 60], [0, 0, 1]])
        cameras.append(Camera(K=K, w2c=look_at(eye, rng.normal(size=3) * 0.2), width=160, height=120, name=f"{k:02d}"))
    return g, cameras[:6], cameras[6:]


def scene(name: str, runs: Path) -> tuple:
    """(Gaussians, training cameras, candidates)."""
    if name == "cube":
        return made_cube()
    trainer, pool, chosen, _ = studies.base(name, runs, 6, 1000)
    left = [frame.camera for i, frame in enumerate(pool) if i not in chosen]
    return trainer.gaussians(), [pool[i].camera for i in chosen], left[:24]


def information(g, camera, settings, method: str, share: float) -> fisher.Information:
    """One view's, at a share of its resolution, per full-size pixel."""
    return {name: x.float() for name, x in scaled_diagonal(g, camera, settings, share, method).items()}


def measure(g, train: list, candidates: list) -> list[dict]:
    """A row a method."""
    views = [*train, *candidates]
    found = {}
    seconds = {}
    for name, (settings, method, share) in METHODS.items():
        information(g, views[0], settings, method, share)  # compiles
        start = time.process_time()
        found[name] = [information(g, camera, settings, method, share) for camera in views]
        seconds[name] = (time.process_time() - start) / len(views)
        print(f"  {name}: {seconds[name]:.3f} s a view", flush=True)
    for label, settings in (("exact", Preset("exact")), ("fast", Preset("fast"))):
        total, drawn, spent = None, 0, 0.0
        for chunk in CHUNKS:
            if 4 * spent > _LONGEST * len(views):
                break
            start = time.process_time()
            new = [
                fisher.diagonal(g, camera, settings, "probes", probes=chunk, seed=1000 * k + drawn)
                for k, camera in enumerate(views)
            ]
            spent += time.process_time() - start
            new = [{name: x.float() * chunk for name, x in part.items()} for part in new]
            total = new if total is None else [{n: a[n] + b[n] for n in a} for a, b in zip(total, new, strict=True)]
            drawn += chunk
            name = f"probes on {label}, K = {drawn}"
            found[name] = [{n: x / drawn for n, x in part.items()} for part in total]
            seconds[name] = spent / len(views)
            print(f"  {name}: {seconds[name]:.3f} s a view", flush=True)
    return [row(name, found[name], found["exact"], seconds, len(train)) for name in found]


def row(name: str, parts: list, truth: list, seconds: dict, trained: int) -> dict:
    """Errors of one method's information, of its ranking and of its choice."""
    scores, true = (score(x, trained) for x in (parts, truth))
    best, chosen = int(np.argmax(true)), int(np.argmax(scores))
    errors = {}
    for group in parts[0]:
        a, b = (torch.stack([part[group].reshape(-1) for part in x]).double() for x in (parts, truth))
        seen = b > 1e-6 * b.max()
        errors[group] = float(((a - b).abs() / b)[seen].median())
    return {
        "method": name,
        "seconds": seconds[name],
        "speed-up": seconds["exact"] / seconds[name],
        "errors": errors,
        "error": float(np.median(list(errors.values()))),
        "tau": studies.rank_correlation(scores, true, "kendall"),
        "regret": (true[best] - true[chosen]) / true[best],
        "spread": (true[best] - float(np.median(true))) / true[best],
    }


def score(parts: list, trained: int) -> list[float]:
    """logdet of every candidate."""
    groups = parts[0]
    H = {name: sum(part[name].double() for part in parts[:trained]) for name in groups}
    return [information_gain(part, H, "logdet", PRIOR).total for part in parts[trained:]]


SHOWN = ("fast", "fast, half resolution", "fisherrf", "probes on fast, K = 1")
"""Methods of the page; the others are in the data file."""


def plot(result: dict, path: Path) -> None:
    """Error against time, a panel a scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(result), figsize=(4.6 * len(result), 4.2), sharey=True, squeeze=False)
    for axis, (name, rows) in zip(panels[0], result.items(), strict=True):
        for kind, marker in (("probes on exact", "o-"), ("probes on fast", "s-")):
            part = [r for r in rows if r["method"].startswith(kind)]
            axis.plot([r["seconds"] for r in part], [r["error"] for r in part], marker, label=f"{kind}, K = 1..64")
        for r in rows:
            if "probes" not in r["method"] and r["error"] > 0:
                axis.plot(r["seconds"], r["error"], "x", color="black")
                axis.annotate(
                    r["method"], (r["seconds"], r["error"]), fontsize=7, xytext=(3, 3), textcoords="offset points"
                )
        axis.axvline(next(r["seconds"] for r in rows if r["method"] == "exact"), color="gray", lw=0.8, ls=":")
        axis.set(title=name, xscale="log", yscale="log", xlabel="processor seconds a view")
    panels[0][0].set_ylabel("median relative error of the diagonal")
    panels[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def table(result: dict) -> str:
    """A row a method of `SHOWN`: what each scene has, in their order."""
    lines = []
    for method in SHOWN:
        rows = [next(r for r in rows if r["method"] == method) for rows in result.values()]
        whole = [next(r for r in rows if r["method"] == "exact")["seconds"] for rows in result.values()]
        times = [f"{r['seconds'] / full:.2f}" for r, full in zip(rows, whole, strict=True)]
        each = [times, [f"{100 * r['error']:.0f} %" for r in rows], [f"{r['tau']:.2f}" for r in rows]]
        lines.append([f"`{method}`", *(" / ".join(x) for x in each), f"{100 * max(r['regret'] for r in rows):.1f} %"])
    return markdown_table(["method", "time", "error of the diagonal", "tau", "most regret"], lines)


def sheet(result: dict) -> list[list[str]]:
    """The data file: every method on every scene."""
    lines = [["scene", "method", "seconds", "error", "tau", "regret", "median_view_below_best"]]
    for name, rows in result.items():
        for r in rows:
            numbers = (r[key] for key in ("seconds", "error", "tau", "regret", "spread"))
            lines.append([name, r["method"], *(f"{x:.4g}" for x in numbers)])
    return lines


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=["office", "still_life", "cube"])
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--page", action="store_true", help="the page of the results that there are")
    args = parser.parse_args()
    store = ROOT / "benchmarks" / "tradeoff_fisher.json"
    result = studies.read_rows(store, {"made": "", "scenes": {}})
    for name in [] if args.page else args.scenes:
        print(name, flush=True)
        result["scenes"][name] = measure(*scene(name, args.runs))
        result["made"] = studies.stamp("tradeoff_fisher")
        studies.write_rows(store, result)
    plot(result["scenes"], ROOT / "docs" / "pictures" / "tradeoff-fisher.png")
    text = table(result["scenes"])
    print(text)
    fill_between(ROOT / "docs" / "tradeoff.md", "methods", f"{text}\n\n{paragraph(result['made'])}")
    studies.write_csv(studies.PAGE_DATA / "tradeoff-fisher.csv", sheet(result["scenes"]))


if __name__ == "__main__":
    main()
