"""Fits that are killed again and again: whether anything is lost beyond the last checkpoint.

    python benchmarks/kills.py [--kills 26] [--folder runs/kills] [--kinds static active semantic dynamic]

Each kind of fit runs by the command line on a small made scene, deterministically, and is killed (SIGKILL, and one time
in four SIGTERM, as a cluster does) at a random moment, time and again, until it is done; then another one begins, until
there were so many kills. After each kill every file in the run folder must be whole and the checkpoint at least as far
as the log says; at the end every bit of the checkpoint and every pick must be that of a fit that nobody disturbed. Rows
go to benchmarks/kills.json, the sums to docs/reliability.md.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import torch  # noqa: E402
from pages import fill_between  # noqa: E402
from where import ran  # noqa: E402

from drgs.files import Run, load_ply, load_state  # noqa: E402
from drgs.io import atomic  # noqa: E402
from drgs.scenes import kitchen, room, still_life  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

SIZE = {"width": 48, "height": 36, "spp": 2, "seed": 1}
MAPS = {"teacher_width": 12, "teacher_height": 9}
COMMON = "--max-gaussians 500 --sh-degree 1 --save-every 2 --deterministic --no-report"
KINDS = {
    "static": (still_life, {"views": 12}, "--max-steps 100"),
    "active": (still_life, {"views": 12}, "--max-steps 60 --views active --add 4 --every 10"),
    "semantic": (room, {"views": 12, **MAPS}, "--max-steps 60 --feature-width 8"),
    "dynamic": (kitchen, {"cameras": 4, "times": 3, **MAPS}, "--max-steps 60 --semantics ignore"),
}
"""Kind -> what makes its scene, how large, and the options of its fit."""

_LONGEST = 300.0  # seconds that a fit may take before something is wrong
_WINDOW = 4.0  # seconds after the first step within which a process is killed
_EARLY = 0.15  # part of the kills that come before that


def fit_line(kind: str, folder: Path, run: str) -> list[str]:
    """The command of a fit of a kind, into a run folder of `folder`; the scene is made if it is not there."""
    maker, size, options = KINDS[kind]
    data = maker.generate(folder / maker.__name__.rpartition(".")[2], **SIZE, **size)
    line = [sys.executable, "-m", "drgs", "fit", str(data), "-o", str(folder / run), "--resume", "--quiet"]
    return [*line, *COMMON.split(), *options.split()]


def killed(line: list[str], run: Path, draw: random.Random) -> int | None:
    """Start a fit and kill it at a random moment; None where it was done before, else the signal."""
    log = run / "log.jsonl"
    signum = signal.SIGTERM if draw.random() < 0.25 else signal.SIGKILL
    held = log.stat().st_size if log.exists() else 0
    began = time.monotonic()
    process = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, env=environment())
    try:
        if draw.random() < _EARLY:
            time.sleep(draw.uniform(0.0, 5.0))
        else:
            while process.poll() is None and not (log.exists() and log.stat().st_size > held):
                assert time.monotonic() - began < _LONGEST, "no step was made"
                time.sleep(0.01)
            time.sleep(draw.uniform(0.0, _WINDOW))
        if process.poll() is None:
            process.send_signal(signum)
        said = process.communicate(timeout=_LONGEST)[1]
    finally:
        process.kill()
    assert process.returncode in (0, -signal.SIGKILL, 128 + signal.SIGTERM, -signal.SIGTERM), said
    return None if process.returncode == 0 else signum


def environment() -> dict[str, str]:
    """One thread, and this checkout."""
    return {**os.environ, "DRGS_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def check_whole(path: Path) -> int:
    """Every file of a run folder is whole; the step of its checkpoint, which is as far as the log says."""
    run = Run(path)
    logged = 0
    for file in sorted(path.rglob("*")):
        if not file.is_file() or atomic.PATTERN.fullmatch(file.name) or file.name.startswith("."):
            continue
        if file.suffix == ".json":
            json.loads(file.read_text())
        elif file.suffix == ".safetensors":
            load_state(file)
        elif file.suffix == ".ply":
            load_ply(file)
        elif file.suffix == ".jsonl":
            for text in file.read_bytes().split(b"\n")[:-1]:
                event = json.loads(text)
                # A fit that goes on from a checkpoint forgets what was logged after it.
                logged = event["step"] if event["event"] in ("checkpoint", "resume") else logged
    step = load_state(run.state)[1]["step"] if run.state.exists() else 0
    assert step >= logged, f"{path}: the checkpoint is at step {step}, the log said {logged}"
    return step


def outcome(path: Path) -> tuple[dict[str, torch.Tensor], list[str]]:
    """What two fits must share: all tensors of the last checkpoint, and what was picked."""
    picks = path / "selection.json"
    names = [pick["name"] for pick in json.loads(picks.read_text())["picks"]] if picks.exists() else []
    return load_state(path / "state.safetensors")[0], names


def same(a: tuple[dict[str, torch.Tensor], list[str]], b: tuple[dict[str, torch.Tensor], list[str]]) -> bool:
    """Whether two outcomes are equal to the last bit."""
    return a[1] == b[1] and a[0].keys() == b[0].keys() and all(torch.equal(x, b[0][name]) for name, x in a[0].items())


def campaign(kind: str, folder: Path, kills: int, seed: int = 0) -> dict:
    """Kill fits of a kind so many times.

    Args:
        kind: Kind of fit, a key of `KINDS`.
        folder: Folder for scenes and runs.
        kills: Number of kills.
        seed: Seed of the moments.
    Returns:
        Kind, kills, those by SIGTERM and before the first checkpoint, fits that were finished, how many of these are
        the undisturbed one to the last bit, and seconds.
    """
    draw = random.Random(f"{kind} {seed}")
    began = time.monotonic()
    subprocess.run(fit_line(kind, folder, f"{kind}-whole"), check=True, env=environment(), timeout=_LONGEST)
    wanted = outcome(folder / f"{kind}-whole")
    row = {"kind": kind, "kills": 0, "by SIGTERM": 0, "before a checkpoint": 0, "finished": 0, "same bits": 0}
    while row["kills"] < kills or not row["finished"]:
        run = folder / f"{kind}-killed"
        shutil.rmtree(run, ignore_errors=True)
        line = fit_line(kind, folder, run.name)
        done = False
        while not done:
            left = row["kills"] < kills
            signum = killed(line, run, draw) if left else subprocess.run(line, check=True, env=environment()).returncode
            done = not left or signum is None
            if done:
                break
            step = check_whole(run) if run.exists() else 0
            row["kills"] += 1
            row["by SIGTERM"] += signum == signal.SIGTERM
            row["before a checkpoint"] += step == 0
            print(f"{kind}: {row['kills']} of {kills}, at step {step}", flush=True)
        row["finished"] += 1
        row["same bits"] += same(outcome(run), wanted)
    return row | {"seconds": time.monotonic() - began}


def table(result: dict) -> str:
    """The part of docs/reliability.md."""
    names = ("kills", "by SIGTERM", "before a checkpoint", "finished", "same bits")
    kills, saved, early, finished, alike = (sum(row[name] for row in result["rows"]) for name in names)
    return paragraph(
        f"{kills} kills of {len(result['rows'])} kinds of fits, {saved} by SIGTERM, {early} before a checkpoint; of "
        f"{finished} finished fits {alike} have the same bits (`python benchmarks/kills.py`, {result['machine']}, "
        f"{result['date']}, commit {result['commit']}, [by kind](../benchmarks/kills.json))."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=26)
    parser.add_argument("--folder", type=Path, default=ROOT / "runs" / "kills")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    args = parser.parse_args()
    result = ran() | {"rows": []}
    for kind in args.kinds:
        result["rows"].append(campaign(kind, args.folder, args.kills))
    if set(args.kinds) == set(KINDS):
        (ROOT / "benchmarks" / "kills.json").write_text(json.dumps(result, indent=1) + "\n")
        fill_between(ROOT / "docs" / "reliability.md", "kills", table(result))
    print(table(result))


if __name__ == "__main__":
    main()
