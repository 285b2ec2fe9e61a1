"""Does the score of a view predict what adding it does?

    python benchmarks/predict.py [--scenes office head still_life] [--runs runs/studies]
    python benchmarks/predict.py --page                 runs nothing: docs/data/predict.csv and predict-psnr.csv

On a fit to 6 views every other view of the pool is added alone, the fit goes on for a while, and the drop of the error
of held-out views is compared with the score that each policy gave the view before. Results go to
benchmarks/predict.json and to the data files of docs/next-views.md; candidates that have been measured are not
measured again.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import studies
import torch
from studies import ROOT

import drgs
from drgs.gain import Prior
from drgs.select import Cache, select

VIEWS = 6
STEPS = 1000
MORE = 200
ALONE = {"policy": "fisher", "blocks": ("geometry",)}
RELATIVE = {**ALONE, "prior": Prior(1e-3, relative=True)}
BOTH = ("geometry", "backdrop")
SCORES = {
    "fisher, logdet": {**ALONE, "criterion": "logdet"},
    "fisher, logdet, relative 1e-3": {**RELATIVE, "criterion": "logdet"},
    "fisher, eig": {**ALONE, "criterion": "eig"},
    "fisher, eig, relative 1e-3": {**RELATIVE, "criterion": "eig"},
    "fisher, trace_cov": {**ALONE, "criterion": "trace_cov"},
    "fisher, trace_cov, relative 1e-3": {**RELATIVE, "criterion": "trace_cov"},
    "fisher, block_logdet": {**ALONE, "criterion": "block_logdet"},
    "fisher, v_opt": {**ALONE, "criterion": "v_opt"},
    "fisher, eig, with backdrop": {"policy": "fisher", "criterion": "eig", "blocks": BOTH},
    "fisher, v_opt, with backdrop": {"policy": "fisher", "criterion": "v_opt", "blocks": BOTH},
    "fisher, v_opt, backdrop alone": {"policy": "fisher", "criterion": "v_opt", "blocks": ("backdrop",)},
    "fisherrf": {"policy": "fisherrf"},
    "coverage": {"policy": "coverage"},
    "farthest": {"policy": "farthest"},
}


def error(g, frames: list, settings) -> float:
    """Mean squared error of held-out views, inside their masks."""
    values = []
    for frame in frames:
        with torch.no_grad():
            rgb = drgs.render(g, frame.camera, settings, outputs=()).rgb.clamp(0, 1)
        wrong = (rgb - frame.image()).square().mean(2)
        weight = torch.ones_like(wrong) if frame.mask is None else frame.mask
        values.append(float((wrong * weight).sum() / weight.sum()))
    return float(np.mean(values))


def drops(name: str, runs: Path) -> dict:
    """Scores and realised drops of every candidate of a scene."""
    trainer, pool, chosen, held_out = studies.base(name, runs, VIEWS, STEPS)
    left = [i for i in range(len(pool)) if i not in chosen]
    train = [pool[i] for i in chosen]
    settings = trainer.config.settings
    g = trainer.gaussians()
    store = runs / "predict" / f"{name}.json"
    done = studies.read_rows(store, {})
    if "scores" not in done:
        cache = Cache()
        candidates = [pool[i].camera for i in left]
        known = [frame.camera for frame in train]
        told = {"settings": settings, "cache": cache, "masks": [frame.mask for frame in train]}
        done["scores"] = {
            label: select(g, candidates, known, halving=False, **told, **options).scores
            for label, options in SCORES.items()
        }
        # What going on without a new view does is no merit of a view; the seeds say what chance does.
        control = [
            error(studies.continued(trainer, train, MORE, seed).gaussians(), held_out, settings) for seed in range(3)
        ]
        done |= {"names": [pool[i].name for i in left], "control": control, "after": []}
        studies.write_rows(store, done)
    while len(done["after"]) < len(left):
        i = left[len(done["after"])]
        done["after"].append(error(studies.continued(trainer, [*train, pool[i]], MORE).gaussians(), held_out, settings))
        studies.write_rows(store, done)
        print(name, len(done["after"]), "of", len(left), flush=True)
    return done


def rank_lines(result: dict) -> list[list[str]]:
    """Spearman's rho between scores and realised drops over the candidates, and what 95 % of rankings stay below."""
    lines = [["score", *(f"{name}, {len(one['names'])} candidates" for name, one in result.items()), "mean"]]
    for label in SCORES:
        values = []
        for one in result.values():
            drop = np.mean(one["control"]) - np.asarray(one["after"])
            values.append(studies.rank_correlation(one["scores"][label], drop))
        lines.append([label, *(f"{value:.2f}" for value in values), f"{np.mean(values):.2f}"])
    bounds = [1.645 / math.sqrt(len(one["names"]) - 1) for one in result.values()]
    return [*lines, ["95 % of random rankings are below", *(f"{bound:.2f}" for bound in bounds), ""]]


def psnr_lines(result: dict) -> list[list[str]]:
    """Held-out PSNR of the fits, in dB."""
    psnr = lambda x: -10 * math.log10(x)  # noqa: E731
    picked = lambda label: lambda one: psnr(one["after"][int(np.argmax(one["scores"][label]))])  # noqa: E731
    shown = {
        "no view added, mean of 3 seeds": lambda one: psnr(np.mean(one["control"])),
        "spread of these seeds": lambda one: psnr(min(one["control"])) - psnr(max(one["control"])),
        "worst view added": lambda one: psnr(max(one["after"])),
        "median view added": lambda one: psnr(np.median(one["after"])),
        "best view added": lambda one: psnr(min(one["after"])),
        **{
            f"picked by {label}": picked(label)
            for label in ("fisher, logdet", "fisher, v_opt, with backdrop", "fisherrf", "coverage", "farthest")
        },
    }
    lines = [[label, *(f"{of(one):.2f}" for one in result.values())] for label, of in shown.items()]
    return [["fit", *result], *lines]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=list(studies.SCENES))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--page", action="store_true", help="run nothing, write the data files of what is there")
    args = parser.parse_args()
    results = ROOT / "benchmarks" / "predict.json"
    if args.page:
        result = studies.read_rows(results, {})["scenes"]
    else:
        result = {name: drops(name, args.runs) for name in args.scenes}
    ranks, fits = rank_lines(result), psnr_lines(result)
    print(studies.csv_text([*ranks, [], *fits]))
    if tuple(result) != studies.SCENES:
        return
    if not args.page:
        studies.write_rows(results, {"made": studies.stamp("predict"), "scenes": result})
    studies.write_csv(ROOT / "docs" / "data" / "predict.csv", ranks)
    studies.write_csv(ROOT / "docs" / "data" / "predict-psnr.csv", fits)


if __name__ == "__main__":
    main()
