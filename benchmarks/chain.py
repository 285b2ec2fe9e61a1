"""How far the criteria are from the mutual information they stand for, on scenes where it can be computed.

    python benchmarks/chain.py [--scenes 24]     benchmarks/chain.json
    python benchmarks/chain.py --page            measures nothing

Random scenes of 12 Gaussians (SH degree 0, 156 parameters), Jacobians of the float64 oracle at 12x10 pixels; 1, 2 or 4
training views and 8 candidates in random directions. Both write docs/data/criteria.csv and the paragraph of docs/
information.md.
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
from pages import fill_between  # noqa: E402
from scenes_random import camera, gaussians  # noqa: E402
from studies import rank_correlation, read_rows, write_csv, write_rows  # noqa: E402
from where import ran  # noqa: E402

from drgs import reference  # noqa: E402
from drgs.gain import dense  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

RESULTS = ROOT / "benchmarks" / "chain.json"
DATA = ROOT / "docs" / "data" / "criteria.csv"
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


def measure(scenes: int) -> list[dict]:
    """A row for each scene, number of training views, lambda and form: ratios of the candidates, tau and regret."""
    found = []
    for seed in range(scenes):
        J, labels = views(seed)
        for count in TRAIN:
            for value in LAMBDAS:
                chains = [dense(x, torch.cat(J[:count]), value, labels) for x in J[max(TRAIN) :]]
                truth = np.array([x.mutual_information for x in chains])
                for form in FORMS:
                    scores = np.array([getattr(x, form) for x in chains])
                    regret = 1 - truth[scores.argmax()] / truth.max()
                    tau = rank_correlation(scores, truth, "kendall")
                    row = {"scene": seed, "training_views": count, "lambda": value, "form": form}
                    ratios = [float(f"{ratio:.4g}") for ratio in scores / truth]
                    found.append(row | {"ratios": ratios, "tau": round(float(tau), 4), "regret": round(regret, 5)})
    return found


def summary(rows: list[dict]) -> dict[str, float]:
    """Of rows of one form: quantiles of the ratios of all candidates, means of tau and regret, the worst regret."""
    low, middle, high = np.quantile(np.concatenate([row["ratios"] for row in rows]), (0.05, 0.5, 0.95))
    regrets = [row["regret"] for row in rows]
    return {
        "ratio_5": low,
        "ratio_median": middle,
        "ratio_95": high,
        "tau": np.mean([row["tau"] for row in rows]),
        "regret": np.mean(regrets),
        "worst_regret": max(regrets),
    }


def groups(rows: list[dict]) -> dict[tuple, dict[str, float]]:
    """(training views, lambda, form) -> what the scenes say."""
    keys = dict.fromkeys((row["training_views"], row["lambda"], row["form"]) for row in rows)
    return {
        key: summary([row for row in rows if (row["training_views"], row["lambda"], row["form"]) == key])
        for key in keys
    }


def text(result: dict) -> str:
    """What the page says: ranges over lambda and the numbers of training views."""
    found = groups(result["rows"])
    told = []
    for form in FORMS:
        own = [x for (_, _, name), x in found.items() if name == form]
        means, worst = [100 * x["regret"] for x in own], 100 * max(x["worst_regret"] for x in own)
        told.append(f"`{form}` {min(means):.1f} to {max(means):.1f} % ({worst:.0f} %)")
    return paragraph(
        f"Mean regret (and the worst one; the [trace bound](maths.md#scores) is no criterion): {', '.join(told)} "
        f"([each case](data/criteria.csv); `python benchmarks/chain.py`, {result['machine']}, {result['date']})."
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--page", action="store_true", help="measure nothing, write what there is")
    args = parser.parse_args()
    if not args.page:
        write_rows(RESULTS, {**ran(), "rows": measure(args.scenes)})
    result = read_rows(RESULTS, None)
    found = groups(result["rows"])
    heads = ["training_views", "lambda", "form", *next(iter(found.values()))]
    write_csv(DATA, [heads, *([*map(str, key), *(f"{x:.3g}" for x in row.values())] for key, row in found.items())])
    fill_between(ROOT / "docs" / "information.md", "chain", text(result))


if __name__ == "__main__":
    main()
