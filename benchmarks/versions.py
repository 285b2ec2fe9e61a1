"""What commits gained or lost: the same frames by two checkouts of drgs in turns, and fits of equal processor time.

    git worktree add ../before COMMIT
    python benchmarks/versions.py ../before [RUN ...] [--turns 9]   rows: benchmarks/versions.jsonl
    python benchmarks/versions.py --fits 60 ../before DATA ...      rows: benchmarks/versions_fits.jsonl
    python benchmarks/versions.py --page                            the tables of docs/benchmarks-versions.md

One process a checkout, one thread each, taking turns; what counts is the median of the ratios of processor time of two
neighboring turns, which other work on the machine changes little. Scenes are the cube of `render.py` and, of each RUN
(a fit, at 320x240), its fifth camera. With a RUN that has 47 cameras or more a pick among 80 candidates is timed, too.

With `--fits` both checkouts run `drgs fit` on each data set, side by side, one thread each, with as many steps as take
those seconds of processor time: a fit of one step and a short one say what a step takes, for schedules are fractions of
the steps. All held-out views are drawn in the renderers of metrics.json by `drgs eval` of this checkout, which does not
count.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
CODE = Path(os.environ.get("DRGS_CHECKOUT", ROOT))
sys.path[:0] = [str(CODE), str(ROOT / "benchmarks")]

ROWS = ROOT / "benchmarks" / "versions.jsonl"
FIT_ROWS = ROOT / "benchmarks" / "versions_fits.jsonl"
PAGE = ROOT / "docs" / "benchmarks-versions.md"
CUBE = "cube"
POSES = 80  # candidates of a pick
LEAST = 50  # steps of a fit that compiles kernels
PILOT = 0.2  # part of the seconds, about, of the fit that says what a step takes
ALIKE = 0.85  # share of the other's processor seconds from which on two fits have taken equally long; chosen
SIZES = {60: (30_000, 12_000), 300: (60_000, 20_000), 900: (130_000, 30_000)}
"""Processor seconds of a fit -> pixels of a photograph and Gaussians, at most: what that time is enough for."""
ON_WHITE = ("lego",)
"""Photographs with an alpha channel: 864f204 put them on black unless told, and PSNR on black is another number."""
SEEN = ("fast", "exact", "gsplat", "3dgut")
SHOWN_SECONDS, SHOWN_RENDERERS = (60, 300), ("fast", "gsplat")  # of the page's table; all are in its data file
CHOOSING = ("banana", "fern", "statue", "office", "watch", "blowtorch")
"""Captures on which updates a step (the first three), the trial of gains and guesses beside points (the last three)
were chosen; a mean of its own is of the others."""


def frames(scene: str) -> dict[str, Callable[[], object]]:
    """What is timed of a scene, by name: imports drgs from the checkout of this process."""
    import cubes
    import numpy as np
    import torch

    import drgs
    from drgs.data import load
    from drgs.fitting.records import load_run
    from drgs.select import select

    if scene == CUBE:
        g, camera, cameras = cubes.cube(), cubes.camera(), []
    else:
        run = load_run(scene)
        views = load(run.record.data).views
        cameras = [view.camera.undistorted().resized(320, 240) for view in views]
        g, camera = drgs.load_ply(Path(scene) / "point_cloud.ply"), cameras[5 % len(cameras)]
    timed: dict[str, Callable[[], object]] = {}
    for preset in ("fast", "exact"):
        settings = drgs.RenderSettings.preset(preset)

        def forward(settings: drgs.RenderSettings = settings) -> None:
            with torch.no_grad():
                drgs.render(g, camera, settings, outputs=())

        def backward(settings: drgs.RenderSettings = settings) -> None:
            leaves = {name: x.detach().clone().requires_grad_() for name, x in g.parameters().items()}
            drgs.render(g.replace(**leaves), camera, settings, outputs=()).rgb.square().sum().backward()

        timed |= {f"{preset}, forward": forward, f"{preset}, forward + backward": backward}
        timed[f"{preset}, Fisher diagonal"] = lambda settings=settings: drgs.fisher.diagonal(g, camera, settings)
    timed["fast, Fisher blocks"] = lambda: drgs.fisher.blocks(g, camera, drgs.RenderSettings.preset("fast"))
    if len(cameras) >= 47:
        rng = np.random.default_rng(0)
        poses = []
        for k in range(POSES):
            moved = cameras[k % len(cameras)]
            shift = 0.05 * rng.normal(size=3) * (k >= len(cameras))
            w2c = moved.w2c.copy()
            w2c[:3, 3] -= w2c[:3, :3] @ shift
            poses.append(dataclasses.replace(moved, w2c=w2c, name=f"pose {k}"))
        fast = drgs.RenderSettings.preset("fast")
        timed["a pick of 80"] = lambda: select(g, poses, cameras[:12], 1, settings=fast)
    return timed


def work(scene: str) -> None:
    """Time everything once for each line that comes in."""
    timed = frames(scene)
    for run in timed.values():
        run()
    print("ready", flush=True)
    for _ in sys.stdin:
        seconds = {}
        for name, run in timed.items():
            began = time.process_time()
            run()
            seconds[name] = time.process_time() - began
        print(json.dumps(seconds), flush=True)


def compared(before: Path, scene: str, turns: int) -> dict[str, list[tuple[float, float]]]:
    """Name -> seconds before and now, turn by turn."""
    processes = []
    for checkout in (before, ROOT):
        environment = {**os.environ, "DRGS_CHECKOUT": str(checkout.resolve())}
        command = [sys.executable, __file__, "--work", scene]
        processes.append(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
        )
    found: dict[str, list[tuple[float, float]]] = {}
    answers = []
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready", f"{scene}: a process has failed"
    for _ in range(turns):
        answers = []
        for process in processes:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write("go\n")
            process.stdin.flush()
            answers.append(json.loads(process.stdout.readline()))
        for name in answers[0]:
            found.setdefault(name, []).append((answers[0][name], answers[1][name]))
    for process in processes:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()
    return found


def fit_once(checkout: Path, data: Path, run: Path, steps: int, seconds: int) -> float:
    """Processor seconds of one `drgs fit`, all of it."""
    pixels, gaussians = SIZES[seconds]
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
    options = ["--max-steps", str(steps), "--max-pixels", str(pixels), "--max-gaussians", str(gaussians)]
    options += ["--background", "1", "1", "1"] if data.name in ON_WHITE else []
    command = [sys.executable, "-m", "drgs", "fit", str(data), "-o", str(run), *options, "--no-report", "--quiet"]
    process = subprocess.Popen(command, env=environment, cwd=run.parent)
    _, status, used = os.wait4(process.pid, 0)
    assert status == 0, f"{data}: a fit has failed"
    return used.ru_utime + used.ru_stime


def fit_for(checkout: Path, data: Path, seconds: int) -> dict:
    """What a checkout's fit of these processor seconds has at held-out views."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compiled = fit_once(checkout, data, folder / "compiled", LEAST, seconds)
        one = fit_once(checkout, data, folder / "one", 1, seconds)
        pilot = max(LEAST, round(PILOT * seconds * (LEAST - 1) / max(compiled - one, 1)))
        step = (fit_once(checkout, data, folder / "pilot", pilot, seconds) - one) / (pilot - 1)
    return fit_of(checkout, data, seconds, max(LEAST, round((seconds - one) / step))) | {"first": one}


def fit_of(checkout: Path, data: Path, seconds: int, steps: int) -> dict:
    """What a checkout's fit of so many steps has at held-out views, of the size of fits of `seconds`.

    A fit draws some of many held-out views in several renderers; here all are drawn, by this checkout.
    """
    with tempfile.TemporaryDirectory() as name:
        run = Path(name) / "run"
        took = fit_once(checkout, data, run, steps, seconds)
        command = [sys.executable, "-m", "drgs", "eval", str(run), "--quiet"]
        subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=run.parent, check=True)
        metrics = json.loads((run / "metrics.json").read_text())
    seen = {row["name"]: {view["name"]: view["psnr"] for view in row["views"]} for row in metrics["renderers"]["rows"]}
    return {"steps": steps, "took": took, "psnr": seen}


def fit_as_long(checkout: Path, data: Path, seconds: int, fit: dict, took: float) -> dict:
    """A fit of as many steps as are to take so many processor seconds, by what another of them took."""
    steps = round(fit["steps"] * (took - fit["first"]) / (fit["took"] - fit["first"]))
    return fit_of(checkout, data, seconds, steps) | {"first": fit["first"]}


def fits_compared(before: Path, data: Path, seconds: int) -> dict:
    """Fits of both checkouts, side by side: other work on the machine slows both.

    A short fit says badly what a step takes. Where one has taken much less than the other it is fitted again, with as
    many steps as are to take as long as the other; `first` is what a fit of one step takes.
    """
    with ThreadPoolExecutor(2) as pool:
        old, new = pool.map(lambda checkout: fit_for(checkout, data, seconds), (before, ROOT))
    if old["took"] < ALIKE * new["took"]:
        old = fit_as_long(before, data, seconds, old, new["took"])
    elif new["took"] < ALIKE * old["took"]:
        new = fit_as_long(ROOT, data, seconds, new, old["took"])
    return {"scene": data.name, "seconds": seconds, "before": old, "now": new}


def last_rows() -> list[dict]:
    """The last row of each scene and number of seconds, by seconds."""
    from where import read_rows

    rows = {(row["seconds"], row["scene"]): row for row in read_rows(FIT_ROWS)}
    return sorted(rows.values(), key=lambda row: row["seconds"])


def gains_of(row: dict, renderer: str) -> tuple[float, float, float]:
    """Held-out PSNR of the second checkout, its gain on average and in the worst view."""
    before, now = row["before"]["psnr"][renderer], row["now"]["psnr"][renderer]
    old, new = zip(*((before[view], now[view]) for view in before if view in now), strict=True)
    return statistics.mean(new), statistics.mean(new) - statistics.mean(old), min(new) - min(old)


def fits_sheet() -> list[list[str]]:
    """A data file: every fit in every renderer."""
    sheet = [["data", "seconds", "taken_before", "taken", "steps_before", "steps", "commit", "machine"]]
    sheet[0] += [f"{name}_{what}" for name in SEEN for what in ("psnr", "gain", "worst_gain")]
    for row in last_rows():
        both = row["before"], row["now"]
        line = [row["scene"], str(row["seconds"])]
        line += [str(round(x[key])) for key in ("took", "steps") for x in both]
        line += [row["commit"], row["machine"].split(",")[0]]
        sheet.append(line + [f"{value:.2f}" for name in SEEN for value in gains_of(row, name)])
    return sheet


def fits_table() -> str:
    """What the second checkout gains on average and in the worst view, by scene, seconds and renderer."""
    from drgs.studies.tables import markdown_table

    rows = {(row["scene"], row["seconds"]): row for row in last_rows()}
    shown = [(seconds, name) for seconds in SHOWN_SECONDS for name in SHOWN_RENDERERS]
    scenes = list(dict.fromkeys(scene for scene, _ in rows))

    def cell(among: list[str], seconds: int, name: str) -> str:
        found = [gains_of(rows[scene, seconds], name)[1:] for scene in among if (scene, seconds) in rows]
        mean, worst = (statistics.mean(values) for values in zip(*found, strict=True))
        return f"{mean:+.2f} / {worst:+.2f}"

    lines = [[scene, *(cell([scene], *at) for at in shown)] for scene in scenes]
    lines.append(["**mean**", *(cell(scenes, *at) for at in shown)])
    untuned = [scene for scene in scenes if scene not in CHOOSING]
    lines.append(["**of those that nothing was tuned on**", *(cell(untuned, *at) for at in shown)])
    return markdown_table(["data", *(f"{seconds} s, `{name}`" for seconds, name in shown)], lines)


def page() -> None:
    """Write the tables."""
    from pages import fill_between
    from studies import PAGE_DATA, write_csv
    from where import read_rows

    from drgs.studies.tables import paragraph

    rows = read_rows(ROWS)
    last = rows[-1]
    timed: dict[str, list[float]] = {}
    for row in rows:
        if "backward" in row["timed"] or "pick" in row["timed"]:  # the others are in the rows
            timed.setdefault(row["timed"], []).append(row["ratio"])
    ratios = "; ".join(
        f"{name} {' to '.join(dict.fromkeys(f'{of(found):.2f}' for of in (min, max)))}" for name, found in timed.items()
    )
    text = paragraph(
        f"Commit {last['commit']} in multiples of the time of {last['before_commit']}, on the cube and on `office`: "
        f"{ratios} (`python benchmarks/versions.py`, {last['machine']}, {last['date']}, other work running, "
        "[rows](../benchmarks/versions.jsonl))."
    )
    fill_between(PAGE, "versions", text)
    if FIT_ROWS.exists():
        rows = last_rows()
        commits, machines, days = (
            " and ".join(dict.fromkeys(row[key] for row in rows)) for key in ("commit", "machine", "date")
        )
        text = paragraph(
            f"Commit {commits} beside {rows[-1]['before_commit']}: `python benchmarks/versions.py --fits`, {machines}, "
            f"{days} ([every renderer, PSNR, seconds and steps](data/versions-fits.csv))."
        )
        write_csv(PAGE_DATA / "versions-fits.csv", fits_sheet())
        fill_between(PAGE, "fits", text + "\n\n" + fits_table())


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", nargs="?", type=Path, help="checkout that is compared with this one")
    parser.add_argument("runs", nargs="*", help="fits; with --fits data sets")
    parser.add_argument("--fits", type=int, choices=SIZES, help="fit in so many seconds of processor time")
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--page", action="store_true", help="write the table of what is there")
    parser.add_argument("--work", metavar="SCENE", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        work(args.work)
        return
    if args.page:
        page()
        return
    if args.before is None:
        parser.error("name a checkout to compare with")
    from where import add_row, ran

    described = ["git", "-C", str(args.before), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(described, capture_output=True, text=True, check=True).stdout.strip()
    if args.fits:
        for data in args.runs:
            row = fits_compared(args.before, Path(data).resolve(), args.fits) | {"before_commit": commit} | ran()
            add_row(FIT_ROWS, row)
            print(row, flush=True)
        return
    for scene in (CUBE, *args.runs):
        for name, pairs in compared(args.before, scene, args.turns).items():
            row = {
                "scene": Path(scene).name,
                "timed": name,
                "ratio": statistics.median(now / before for before, now in pairs),
                "before": statistics.median(before for before, _ in pairs),
                "now": statistics.median(now for _, now in pairs),
                "before_commit": commit,
            }
            add_row(ROWS, row | ran())
            print(row, flush=True)


if __name__ == "__main__":
    main()
