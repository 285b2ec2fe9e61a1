"""Does the expected error say where a model is wrong? AUSE, reliability and ranks of views, on held-out views of fits.

    python benchmarks/expected_error.py [RUN ...]

Runs are folders of `drgs fit` whose data set is there. Normalized AUSE: the area between the curve of the mean squared
error of the pixels that are left when those with the largest map are taken out, and the curve by the true error; 0
sorts as the true errors do, 1 as chance. Rows are kept (benchmarks/expected_error.jsonl); docs/uncertainty.md has the
tables.
Constants of the expected error were chosen on CHOOSING, and all other runs measured once.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np
import studies
import torch
from pages import fill_between
from studies import ROOT
from where import ran, rows_of_runs

import drgs
from drgs import fisher
from drgs.ellipsoids import Scene, colors_only
from drgs.files import Run
from drgs.fitting.frames import Frame, frames_for, load_dataset
from drgs.fitting.records import fitted_views, load_run
from drgs.gain import Prior, variances
from drgs.information.expected_error import PARTS, error_parts, error_record
from drgs.studies.tables import markdown_table, paragraph

CHOOSING = ("banana", "fern", "office", "still0", "room21")
MADE = ("still0", "room21", "still7", "room22")
MOVING = (
    "collision",
    "occlusion",
)  # around what moves there all is empty, and right: pixels that Gaussians cover count
TOLD = "expected error"
MAPS = {"variance, lambda 1": Prior(1.0), "variance, lambda 1e-2": Prior(1e-2)}  # of the blocks geometry and backdrop
ROWS = ROOT / "benchmarks" / "expected_error.jsonl"
PAGE = ROOT / "docs" / "uncertainty.md"
PICKED = "-blind-"  # in names of runs of `drgs reproduce captures`
VIEWS = 12  # of those held out at most, evenly spaced
BINS = (0.0, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, np.inf)  # expected root of the squared error, units of color
FEWEST = 0.01  # share of the pixels that a bin must have to be reported
TIMED = 10  # training views whose record is timed, at most
ROUNDS = 3


def ause(wrong: np.ndarray, order: np.ndarray) -> float:
    """Normalized area, of 20 shares of pixels taken out, 0 to 0.95."""
    left = [round(len(wrong) * (1 - share)) for share in np.linspace(0, 0.95, 20)]
    mean = lambda by: np.mean(np.cumsum(wrong[np.argsort(by, kind="stable")])[np.array(left) - 1] / left)  # noqa: E731
    best = mean(wrong)
    return float((mean(order) - best) / (wrong.mean() - best))


def measured(path: Path) -> dict:
    """The row of a run."""
    loaded = load_run(path)
    config, scene = loaded.record.config, loaded.scene
    settings = config.settings
    dataset = loaded.record.with_refined_poses(load_dataset(loaded.record.data, config, points=False))
    fitted = set(fitted_views(Run(path), loaded.record))  # of a pool only those that were picked
    train, test = dataset.split()
    train = frames_for([view for view in train if view.name in fitted], config.data)
    test = frames_for(test, config.data)
    test = test[:: -(-len(test) // VIEWS)]
    cameras, masks = [frame.camera for frame in train], [frame.mask for frame in train]
    record = error_record(scene, cameras, [frame.image() for frame in train], settings, masks=masks)
    wrong: list[np.ndarray] = []
    maps: dict[str, list[np.ndarray]] = {}
    for frame in test:
        error, by_map = _view(scene, frame, record, loaded.moving is not None)
        wrong.append(error)
        for name, x in by_map.items():
            maps.setdefault(name, []).append(x)
    error = np.concatenate(wrong)
    whole = {name: np.concatenate(x) for name, x in maps.items()}
    return {
        "run": path.name,
        "views": [len(train), len(test)],
        "psnr": [-10 * np.log10(record.mean_misfit), float(-10 * np.log10(error.mean()))],
        "ause": {name: ause(error, x) for name, x in whole.items()},
        "told": [float(x.mean()) for x in maps[TOLD]],
        "true": [float(x.mean()) for x in wrong],
        "parts": {name: float(whole[name].mean() / whole[TOLD].mean()) for name in PARTS},
        "bins": _bins(error, whole[TOLD]),
        "seconds": _seconds(scene, train[:TIMED], settings),
        **ran(),
    }


def _view(
    scene: Scene, frame: Frame, record: drgs.ErrorRecord, is_moving: bool
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Squared errors of a held-out view's pixels, and each map of it."""
    camera, settings = frame.camera, record.settings
    with torch.no_grad():
        out = drgs.render(colors_only(scene, camera.time), camera, settings, outputs=())
    keep = torch.ones(camera.height, camera.width, dtype=torch.bool) if frame.mask is None else frame.mask > 0.5
    keep = keep & (out.alpha > 0.5) if is_moving else keep
    maps = error_parts(scene, camera, record)
    maps[TOLD] = torch.stack(list(maps.values())).sum(0)
    for name, prior in MAPS.items():
        weights = variances(record.information, prior)
        maps[name] = fisher.variance_map(scene, camera, weights, settings, sphere=record.sphere)
    maps["1 - alpha"] = 1 - out.alpha
    error = (out.rgb.clamp(0, 1) - frame.image()).square().mean(2)
    return error[keep].double().numpy(), {name: x[keep].double().numpy() for name, x in maps.items()}


def _bins(error: np.ndarray, told: np.ndarray) -> list[list[float]]:
    """(share of the pixels, told, true mean squared error) of the pixels in each bin of the expected error."""
    bins = np.digitize(np.sqrt(told), BINS) - 1
    own = [(bins == k) for k in range(len(BINS) - 1)]
    return [[x.mean(), told[x].mean() if x.any() else 0, error[x].mean() if x.any() else 0] for x in own]


def _seconds(scene: Scene, frames: list[Frame], settings: drgs.RenderSettings) -> list[float]:
    """CPU seconds of some views' information, as maps have needed it so far, and of their record; medians in turn."""
    cameras, masks = [frame.camera for frame in frames], [frame.mask for frame in frames]
    images = [frame.image() for frame in frames]
    sphere = fisher.backdrop_sphere(scene, cameras)

    def information() -> None:
        fisher.diagonal(scene, cameras, settings, masks=masks)
        fisher.backdrop(scene, cameras, settings, masks=masks, sphere=sphere)

    def record() -> None:
        error_record(scene, cameras, images, settings, masks=masks, sphere=sphere)

    taken: list[list[float]] = [[], []]
    for _ in range(ROUNDS + 1):
        for work, times in zip((information, record), taken, strict=True):
            start = time.process_time()
            work()
            times.append(time.process_time() - start)
    return [statistics.median(times[1:]) for times in taken]  # the first round compiles kernels


def within(row: dict) -> tuple[int, int]:
    """How many of the bins that count have a true error within 30 % of what is expected, and how many there are."""
    ratios = [true / told for share, told, true in row["bins"] if share >= FEWEST]
    return sum(0.7 <= x <= 1.3 for x in ratios), len(ratios)


def worst_rank(row: dict) -> int:
    """Rank, 1 the worst, that the view with the largest true error has by what is expected."""
    order = np.argsort(row["told"])[::-1].tolist()
    return order.index(int(np.argmax(row["true"]))) + 1


def scores(row: dict) -> list[str]:
    """Of a run: true over expected error, bins within 30 %, Spearman's rho over views, rank of the worst view."""
    views = len(row["true"])
    rho = f"{studies.rank_correlation(row['told'], row['true']):.2f}" if views > 2 else ""
    ratio = statistics.mean(row["true"]) / statistics.mean(row["told"])
    inside, bins = within(row)
    return [f"{ratio:.2f}", f"{inside} of {bins}", rho, f"{worst_rank(row)} of {views}"]


SCORES = ("true / expected", "bins within 30 %", "views: Spearman", "worst view: rank")


def main_table(rows: list[dict]) -> str:
    """A row a run; the data file has more of each."""
    names = [TOLD, next(iter(MAPS)), "1 - alpha"]
    lines = []
    for row in rows:
        ratio, _, _, worst = scores(row)
        cells = [f"{row['ause'][name]:.2f}" for name in names]
        lines.append([row["run"], *cells, ratio, worst])
    return markdown_table(["run", *names, SCORES[0], SCORES[3]], lines)


def halves(rows: list[dict]) -> dict[str, list[dict]]:
    """The runs that constants were chosen on, captures and made scenes that only report, and fits to picked views."""
    moving = [row for row in rows if row["run"] in MOVING]
    picked = [row for row in rows if PICKED in row["run"]]
    rows = [row for row in rows if row["run"] not in MOVING and PICKED not in row["run"]]
    other = [row for row in rows if row["run"] not in CHOOSING]
    return {
        "choosing": [row for row in rows if row["run"] in CHOOSING],
        "moving": moving,
        "captures": [row for row in other if row["run"] not in MADE],
        "made": [row for row in other if row["run"] in MADE],
        "picked": picked,
    }


def summary(rows: list[dict]) -> str:
    """What the runs that only report say together, captures and made scenes apart."""
    sentences = []
    parts = halves(rows)
    kinds = {"captures": "captures that nothing was tuned on", "made": "made scenes that nothing was tuned on"}
    kinds["picked"] = "fits to 20 views that the default picked among free poses or in pools as people leave them"
    for kind, what in kinds.items():
        some = parts[kind]
        if not some:
            continue
        names = [TOLD, next(iter(MAPS)), "1 - alpha"]
        means = (f"{statistics.mean(row['ause'][name] for row in some):.2f} ({name})" for name in names)
        told, true = ([x for row in some for x in row[key]] for key in ("told", "true"))
        sentences.append(
            f"On {len(some)} {what}, mean AUSE: {', '.join(means)}; Spearman's rho of views' errors, over "
            f"{len(true)}, {studies.rank_correlation(told, true):.2f}."
        )
    ratio = statistics.median(row["seconds"][1] / row["seconds"][0] for row in rows)
    cost = f"A record takes {ratio:.2f} times the CPU time of the same views' information."
    return " ".join([*sentences, cost])


def reliability(rows: list[dict]) -> list[list[str]]:
    """The data file: a line a run and bin."""
    lines = [["run", "half", "from", "to", "share", "told_rmse", "true_rmse", "true_over_told_mse"]]
    for half, some in halves(rows).items():
        for row in some:
            for low, high, (share, told, true) in zip(BINS[:-1], BINS[1:], row["bins"], strict=True):
                if share >= FEWEST:
                    numbers = (f"{share:.3f}", f"{told**0.5:.4f}", f"{true**0.5:.4f}", f"{true / told:.2f}")
                    lines.append([row["run"], half, f"{low:g}", f"{high:g}", *numbers])
    return lines


def data_lines(rows: list[dict]) -> list[list[str]]:
    """The data file of all maps, parts, and times."""
    names = [TOLD, *MAPS, "1 - alpha", *PARTS]
    heads = ["run", "half", "train_views", "held_out_views", "train_psnr", "held_out_psnr"]
    heads += [f"AUSE {name}" for name in names]
    lines = [[*heads, *SCORES, *(f"share of {x}" for x in PARTS), "information_s", "record_s", "commit"]]
    for half, some in halves(rows).items():
        for row in some:
            numbers = [*(f"{x:.2f}" for x in row["psnr"]), *(f"{row['ause'][name]:.3f}" for name in names)]
            numbers += scores(row)
            numbers += [f"{row['parts'][name]:.3f}" for name in PARTS] + [f"{x:.2f}" for x in row["seconds"]]
            lines.append([row["run"], half, *map(str, row["views"]), *numbers, row["commit"]])
    return lines


def main() -> int:
    rows = rows_of_runs(ROWS, measured, __doc__)
    parts = halves(rows)
    text = [paragraph(f"`python benchmarks/expected_error.py`, {studies.made(rows)}.")]
    text += [paragraph(summary(rows))] if parts["captures"] else []
    text += [main_table([*parts["captures"], *parts["made"], *parts["moving"]])]
    print("\n\n".join(text))
    if PAGE.exists():
        fill_between(PAGE, "expected-error", "\n\n".join(text))
    studies.write_csv(studies.PAGE_DATA / "expected-error.csv", data_lines(rows))
    studies.write_csv(studies.PAGE_DATA / "expected-error-bins.csv", reliability(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
