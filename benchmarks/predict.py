"""Does the score of a view predict what adding it does?

    python benchmarks/predict.py [--scenes office head still_life] [--runs runs/studies]

On a fit to 6 views every other view of the pool is added alone, the fit goes on for a while, and the drop of the error
of held-out views is compared with the score that each policy gave the view before. Results go to docs/active-static.md
and benchmarks/predict.json; candidates that have been measured are not measured again.
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
from drgs.studies.tables import fill_between

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
            label: select(g, candidates, known, **told, **options).scores for label, options in SCORES.items()
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


def report(result: dict, made: str) -> str:
    """The part of docs/active-static.md."""
    names = list(result)
    lines = [
        f"Made by {made}",
        "",
        f"A fit to {VIEWS} views ({STEPS:,} steps, {studies.BASE['max_gaussians']:,} Gaussians, at most "
        f"{studies.BASE['max_pixels']:,} pixels), then each candidate added alone for {MORE} more",
        "steps.",
        "Spearman's rho between the score and the realised drop of the held-out squared error, over the candidates;",
        "in brackets what 95 % of random rankings stay below.",
        "",
        "| score | " + " | ".join(f"{name}, {len(result[name]['names'])} candidates" for name in names) + " | mean |",
        "|---|" + "---|" * (len(names) + 1),
    ]
    for label in SCORES:
        values = []
        for name in names:
            r = result[name]
            drop = np.mean(r["control"]) - np.asarray(r["after"])
            values.append(studies.rank_correlation(r["scores"][label], drop))
        lines.append(f"| {label} | " + " | ".join(f"{v:.2f}" for v in values) + f" | {np.mean(values):.2f} |")
    bounds = [1.645 / math.sqrt(len(result[name]["names"]) - 1) for name in names]
    lines.append("| (random) | " + " | ".join(f"({b:.2f})" for b in bounds) + " | |")
    lines += [
        "",
        "Held-out PSNR of these fits, in dB:",
        "",
        "| | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    psnr = lambda x: -10 * math.log10(x)  # noqa: E731
    for label, of in (
        ("no view added (3 seeds)", lambda r: f"{psnr(np.mean(r['control'])):.2f}"),
        ("spread of these seeds", lambda r: f"{psnr(min(r['control'])) - psnr(max(r['control'])):.2f}"),
        ("worst view added", lambda r: f"{psnr(max(r['after'])):.2f}"),
        ("median view added", lambda r: f"{psnr(np.median(r['after'])):.2f}"),
        ("best view added", lambda r: f"{psnr(min(r['after'])):.2f}"),
        (
            "picked by fisher, logdet",
            lambda r: f"{psnr(r['after'][int(np.argmax(r['scores']['fisher, logdet']))]):.2f}",
        ),
        (
            "picked by fisher, v_opt, with backdrop",
            lambda r: f"{psnr(r['after'][int(np.argmax(r['scores']['fisher, v_opt, with backdrop']))]):.2f}",
        ),
        ("picked by fisherrf", lambda r: f"{psnr(r['after'][int(np.argmax(r['scores']['fisherrf']))]):.2f}"),
        ("picked by coverage", lambda r: f"{psnr(r['after'][int(np.argmax(r['scores']['coverage']))]):.2f}"),
        ("picked by farthest", lambda r: f"{psnr(r['after'][int(np.argmax(r['scores']['farthest']))]):.2f}"),
    ):
        lines.append(f"| {label} | " + " | ".join(of(result[name]) for name in names) + " |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=list(studies.SCENES))
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "studies")
    args = parser.parse_args()
    result = {name: drops(name, args.runs) for name in args.scenes}
    made = studies.stamp("predict")
    text = report(result, made)
    print(text)
    if tuple(args.scenes) == studies.SCENES:
        studies.write_rows(ROOT / "benchmarks" / "predict.json", {"made": made, "scenes": result})
        fill_between(ROOT / "docs" / "active-static.md", "predict", text)


if __name__ == "__main__":
    main()
