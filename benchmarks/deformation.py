"""What views say about a deformation field: how far the estimates of it are off, whether they rank alike, their cost.

    python benchmarks/deformation.py [--quick]     writes benchmarks/deformation.json and data files
    python benchmarks/deformation.py --page        measures nothing, writes the data files

Data files are docs/data/moving-network.csv (errors of the estimates), moving-network-tau.csv and
moving-network-seconds.csv.

The scene is made here: a cloud of Gaussians, a part of which swings around a pillar, and a small field that is fitted
to renders of it. All cameras at the first time are known, candidates are these cameras at other times. Times are CPU
time of the process, which other programs on the machine change little, peers taking turns, medians; run it with
DRGS_THREADS=1.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from studies import rank_correlation, write_csv  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import fisher  # noqa: E402
from drgs.cameras import Camera, orbit  # noqa: E402
from drgs.deform import DeformationField, DynamicGaussians, FieldConfig  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.gain import Information, information_gain  # noqa: E402

FAST = drgs.RenderSettings.preset("fast")
COUNTS = (1, 2, 4, 8, 16)
SOME = (4, 16)  # of what costs more
TIMES = (0.0, 0.25, 0.5, 0.75, 1.0)
RESULT = ROOT / "benchmarks" / "deformation.json"
DATA = ROOT / "docs" / "data"
ESTIMATES = {
    "`ratio`": "ratio, same",
    "`ratio`, each view its own signs": "ratio, own",
    "`trace`, reverse": "trace, same",
    "`trace`, forward": "forward",
    "`paper`": "paper",
}
"""What the data files call an estimate -> what the results do."""


def cloud(count: int, rng: np.random.Generator) -> tuple[Gaussians, torch.Tensor]:
    """Gaussians on a floor, in a pillar and in a ball that swings around it, and which of them swing."""
    kind = rng.choice(3, count, p=(0.5, 0.25, 0.25))
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    floor = np.c_[rng.uniform(-1, 1, (count, 2)), 0.02 * unit[:, 2] - 0.5]
    pillar = np.c_[0.15 * unit[:, :2], rng.uniform(-0.5, 0.5, count)]
    ball = 0.2 * unit + (0.6, 0.0, 0.0)
    means = np.choose(kind[:, None], (floor, pillar, ball))
    scale = 0.9 * count ** (-1 / 3) * np.exp(0.3 * rng.normal(size=(count, 3))) * 0.3
    colors = rng.uniform(-1.5, 1.5, (count, 1, 3))
    g = Gaussians.from_arrays(means.astype(np.float32), rng.normal(size=(count, 4)), scale, np.full(count, 0.8), colors)
    return g, torch.from_numpy(kind == 2)


def swung(g: Gaussians, swings: torch.Tensor, time: float) -> Gaussians:
    """The cloud at a time: the ball has gone a sixth of a turn at 1."""
    angle = time * np.pi / 3
    turn = torch.tensor([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return g.replace(means=torch.where(swings[:, None], g.means @ turn.T.float(), g.means))


def fitted(g: Gaussians, swings: torch.Tensor, cameras: list[Camera], config: FieldConfig, steps: int) -> tuple:
    """The cloud with a field that was fitted to renders of its swing, and the distance that is left of its means."""
    bounds = torch.stack([g.means.amin(0), g.means.amax(0)])
    scene = DynamicGaussians(g, DeformationField(config, bounds), torch.where(swings, 4.0, -4.0))
    optimizer = torch.optim.Adam(
        [{"params": scene.field.grid.parameters(), "lr": 1e-2}, {"params": scene.field.mlp.parameters(), "lr": 1e-3}]
    )
    draw = np.random.default_rng(0)
    for _ in range(steps):
        camera = dataclasses.replace(cameras[draw.integers(len(cameras))], time=float(draw.uniform()))
        target = drgs.render(swung(g, swings, camera.time), camera, FAST, outputs=()).rgb
        optimizer.zero_grad()
        (drgs.render(scene, camera, FAST, outputs=()).rgb - target).abs().mean().backward()
        optimizer.step()
    with torch.no_grad():
        left = [(scene.at(t).means - swung(g, swings, t).means)[swings].norm(dim=1).mean() for t in TIMES]
    return scene, float(torch.stack(left).mean())


def told(scene: DynamicGaussians, views: list[Camera], probes: int, seed: int, own: bool, **how: str) -> list[dict]:
    """What each view says, by the same random signs in all views or by signs of its own."""
    return [
        fisher.network(scene, view, FAST, probes=probes, seed=seed + (10_000 * k if own else 0), **how)
        for k, view in enumerate(views)
    ]


def ratios(found: list[Information], known: int) -> np.ndarray:
    """`eig` of each view after the known ones."""
    H = {name: torch.stack([x[name] for x in found[:known]]).sum(0) for name in found[0]}
    return np.array([information_gain(x, H, "eig").total for x in found[known:]])


def traces(found: list[Information], known: int) -> np.ndarray:
    """Traces of each view after the known ones."""
    return np.array([sum(float(part.sum()) for part in x.values()) for x in found[known:]])


def judged(scores: list[np.ndarray], truth: np.ndarray) -> list[float]:
    """Bias, error and rank correlation of scores, and what their best view lacks of the best: averages over seeds."""
    rows = []
    for y in scores:
        tau = rank_correlation(truth, y, "kendall")
        rows.append((np.mean(y / truth), np.std(y / truth), tau, 1 - truth[y.argmax()] / truth.max()))
    return np.mean(rows, 0).tolist()


def errors(scene: DynamicGaussians, views: list[Camera], known: int, exact: int, seeds: int) -> dict:
    """Errors of every estimate against `exact` probes, by score."""
    candidates = views[known:]
    halves = [told(scene, views, exact // 2, seed, True) for seed in (77, 78)]
    many = [{name: (a[name] + b[name]) / 2 for name in a} for a, b in zip(*halves, strict=True)]
    truth = {name: made(many, known) for name, made in SCORES.items()}
    paper = traces(told(scene, candidates, exact // 8, 77, True, estimate="paper"), 0)
    first, second = ({name: made(half, known) for name, made in SCORES.items()} for half in halves)
    result: dict = {"halves": {name: rank_correlation(first[name], second[name], "kendall") for name in SCORES}}
    for K in COUNTS:
        for name, own in (("same", False), ("own", True)):
            if own and K not in SOME:
                continue
            runs = [told(scene, views, K, seed, own) for seed in range(seeds)]
            for score, made in SCORES.items():
                result[f"{score}, {name} {K}"] = judged([made(x, known) for x in runs], truth[score])
        if K in SOME:
            forward = [told(scene, candidates, K, s, False, estimate="trace", mode="forward") for s in range(seeds)]
            result[f"forward {K}"] = judged([traces(x, 0) for x in forward], truth["trace"])
            literal = [told(scene, candidates, K, s, False, estimate="paper") for s in range(seeds)]
            result[f"paper {K}"] = judged([traces(x, 0) for x in literal], paper)
        print(K, {name: [f"{v:.3g}" for v in x] for name, x in result.items() if name.endswith(f" {K}")}, flush=True)
    still = [fisher.diagonal(scene.at(view.time), view, FAST) for view in views]
    scores = {**truth, "paper": paper, "geometry": ratios(still, known)}
    names = list(scores)
    result["tau"] = {a: {b: rank_correlation(scores[a], scores[b], "kendall") for b in names} for a in names}
    return result


SCORES = {"ratio": ratios, "trace": traces}


def costs(count: int, size: tuple[int, int], share: float, turns: int) -> dict[str, float]:
    """CPU seconds of one view of a field of the paper's size."""
    g, _ = cloud(count, np.random.default_rng(1))
    motion = torch.where(torch.arange(count) < share * count, 4.0, -4.0)
    config = FieldConfig.preset("neu3d", times=40, last_std=1e-2)
    scene = DynamicGaussians(g, DeformationField(config, torch.stack([g.means.amin(0), g.means.amax(0)])), motion)
    camera = dataclasses.replace(orbit((0, 0, 0), 3.0, 1, width=size[0], height=size[1])[0], time=0.4)
    H = fisher.network(scene, camera, FAST, probes=1)
    weights = {name: 1 / (x + 1e-6) for name, x in H.items()}
    seen = scene.at(camera.time).detach()
    runs = {
        "render": lambda: drgs.render(seen, camera, FAST, outputs=()),
        "geometry, exact": lambda: fisher.diagonal(seen, camera, FAST),
        "diagonal": lambda: fisher.network(scene, camera, FAST),
        "trace, forward": lambda: fisher.network(scene, camera, FAST, estimate="trace", mode="forward"),
        "paper": lambda: fisher.network(scene, camera, FAST, estimate="paper"),
        "map": lambda: fisher.network_variance_map(scene, camera, weights, FAST),
    }
    return interleaved(runs, turns, time.process_time)


def error_lines(r: dict) -> Iterator[list[str]]:
    """Every estimate by every number of probes."""
    yield ["estimate", "probes", "mean of scores over the right ones", "standard deviation of that", "tau", "regret"]
    for title, name in ESTIMATES.items():
        for K in COUNTS:
            if found := r["errors"].get(f"{name} {K}"):
                yield [title.replace("`", ""), str(K), *(f"{x:.3f}" for x in found)]
    for name, tau in r["errors"]["halves"].items():
        half = str(r["exact"] // 2)
        yield [f"{name}, half of the right scores' probes against the others", half, "", "", f"{tau:.3f}", ""]


def tau_lines(r: dict) -> Iterator[list[str]]:
    """Kendall's tau between the right scores of the candidates, by what they are of."""
    tau = r["errors"]["tau"]
    yield ["", *tau]
    for name, found in tau.items():
        yield [name, *(f"{found[other]:.2f}" for other in tau)]


def second_lines(r: dict) -> Iterator[list[str]]:
    """CPU seconds of one view, by the share of Gaussians that move."""
    yield ["one view, 16 probes, CPU seconds", *(f"{share} moving" for share in r["costs"])]
    for name in next(iter(r["costs"].values())):
        yield [name, *(f"{spent[name]:.2f}" for spent in r["costs"].values())]


def write_page(r: dict) -> None:
    """The data files."""
    write_csv(DATA / "moving-network.csv", error_lines(r))
    write_csv(DATA / "moving-network-tau.csv", tau_lines(r))
    write_csv(DATA / "moving-network-seconds.csv", second_lines(r))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the data files of what is there")
    args = parser.parse_args()
    if args.page:
        write_page(json.loads(RESULT.read_text()))
        return
    rng = np.random.default_rng(0)
    count, size, steps = (40, (16, 12), 5) if args.quick else (400, (48, 36), 300)
    g, swings = cloud(count, rng)
    cameras = [dataclasses.replace(x, time=0.0) for x in orbit((0, 0, 0), 3.0, 5, width=size[0], height=size[1])]
    config = FieldConfig(channels=4, resolution=8, time_resolution=5, levels=(1,), width=16)
    scene, left = fitted(g, swings, cameras, config, steps)
    print(f"fitted: means are {left:.3f} off", flush=True)
    views = [dataclasses.replace(camera, time=t, name=f"{k}/{t}") for t in TIMES for k, camera in enumerate(cameras)]
    exact, seeds = (8, 1) if args.quick else (128, 2)
    many, large = (300, (32, 24)) if args.quick else (50_000, (320, 240))
    result: dict = {
        **ran(),
        "gaussians": count,
        "moving": int(scene.moving.sum()),
        "weights": sum(x.numel() for x in scene.field.parameters()),
        "steps": steps,
        "left": left,
        "known": len(cameras),
        "candidates": len(views) - len(cameras),
        "size": f"{size[0]}x{size[1]}",
        "exact": exact,
        "seeds": seeds,
        "many": many,
        "large": f"{large[0]}x{large[1]}",
    }
    result["errors"] = errors(scene, views, len(cameras), exact, seeds)
    print(json.dumps(result), flush=True)  # what follows takes as long again
    turns = 1 if args.quick else 2
    result["costs"] = {f"{share:.0%}": costs(many, large, share, turns) for share in (0.1, 1.0)}
    if not args.quick:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
        write_page(result)


if __name__ == "__main__":
    main()
