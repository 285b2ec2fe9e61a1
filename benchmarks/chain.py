"""How far the criteria are from the mutual information they stand for, on scenes where it can be computed.

python benchmarks/chain.py [--scenes 24] [--print]

Random scenes of 12 Gaussians (SH degree 0, 156 parameters), Jacobians of the float64 oracle at 12x10 pixels; 1, 2 or 4
training views and 8 candidates in random directions. Writes the table of docs/information.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "tests")]

import dense_jacobian  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from scenes_random import camera, gaussians  # noqa: E402
from studies import rank_correlation  # noqa: E402

from drgs import reference  # noqa: E402
from drgs.gain import dense  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import fill_between  # noqa: E402

FORMS = ("trace_bound", "eig", "logdet", "block_logdet")
GAUSSIANS = 12
CANDIDATES = 8
TRAIN = (1, 2, 4)
LAMBDAS = (1e-6, 1e-3, 1.0)


def views(seed: int) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Jacobians of max(TRAIN) + CANDIDATES views of a random scene, and the Gaussian of each column."""
    rng = np.random.default_rng(seed)
    settings = RenderSettings.preset("exact")
    rows = []
    g = gaussians(rng, GAUSSIANS, 1, scale=0.25)
    for _ in range(max(TRAIN) + CANDIDATES):
        out = reference.render(g, camera(rng, (12, 10), turn=1.5), settings)
        rows.append(dense_jacobian.stacked(dense_jacobian.jacobian(g, out)))
    return [x.flatten(1) for x in rows], torch.arange(13 * GAUSSIANS) // 13


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--print", action="store_true", help="do not touch docs/information.md")
    args = parser.parse_args()
    found = {}
    for seed in range(args.scenes):
        J, labels = views(seed)
        for count in TRAIN:
            for value in LAMBDAS:
                chains = [dense(x, torch.cat(J[:count]), value, labels) for x in J[max(TRAIN) :]]
                truth = np.array([x.mutual_information for x in chains])
                for form in FORMS:
                    scores = np.array([getattr(x, form) for x in chains])
                    regret = 1 - truth[scores.argmax()] / truth.max()
                    tau = rank_correlation(scores, truth, "kendall")
                    found.setdefault((value, count, form), []).append((scores / truth, tau, regret))
    lines = [
        "| lambda | training views | form | form / mutual information: median (5 %, 95 %) | Kendall tau "
        "| regret: mean, worst |",
        "|---|---|---|---|---|---|",
    ]
    for (value, count, form), results in found.items():
        ratios, tau, regret = (np.concatenate([x[0] for x in results]), *np.array([x[1:] for x in results]).T)
        low, middle, high = np.quantile(ratios, (0.05, 0.5, 0.95))
        lines.append(
            f"| {value:g} | {count} | `{form}` | {middle:.3g} ({low:.3g}, {high:.3g}) | {tau.mean():.2f} "
            f"| {100 * regret.mean():.1f} %, {100 * regret.max():.0f} % |"
        )
    print("\n".join(lines))
    if not args.print:
        fill_between(ROOT / "docs" / "information.md", "chain", "\n".join(lines))


if __name__ == "__main__":
    main()
