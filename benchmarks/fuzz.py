"""Readers under damaged files: whether any of them crashes, hangs, takes memory that a header claims, or fails with
anything but one line.

    python benchmarks/fuzz.py [--seconds 60] [--inputs 1000000] [--readers NAME ...] [--again NUMBER] [--atheris]

Each reader gets valid files of a few pixels that are made here, damaged in one place or a few: bits, numbers, lines,
pieces of other files, JSON of another shape, headers that lie (benchmarks/fuzz_mutators.py, fuzz_formats.py). It reads
them in a process of its own, one after the other. An input is known by its number, so that every one can be repeated
(`--again`, with one reader), and counts go on where they ended. What is found is kept in runs/fuzz/findings. Counts go
to benchmarks/fuzz.json, the sums to docs/reliability.md.

With `--atheris`, inputs are chosen by what they reach in the Python code of a reader (pip install atheris); these are
counted apart, and what reached new lines is kept in runs/fuzz/reached.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import re
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from clocks import processor_seconds  # noqa: E402
from fuzz_targets import TARGETS, Bench  # noqa: E402
from fuzz_worker import SLOW  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import ran  # noqa: E402

from drgs.studies.tables import paragraph  # noqa: E402

COUNTS = ROOT / "benchmarks" / "fuzz.json"
PAGE = ROOT / "docs" / "reliability.md"
FINDINGS = ROOT / "runs" / "fuzz" / "findings"
LOCK = ROOT / "runs" / "fuzz" / "lock"
WORKER = ROOT / "benchmarks" / "fuzz_worker.py"
_MEMORY = Path("/dev/shm")  # noqa: S108 (millions of files are not for disks)
_KEPT = 3  # inputs of one cause
_STUCK = 60.0  # seconds by the clock without an answer, where no processor time is taken
_START = 300.0  # seconds until a process has made its files


class Reader:
    """One reader's inputs and what they came to, over all processes that it took.

    Args:
        name: Name of the reader in `TARGETS`.
        row: Counts of earlier runs; is added to.
        corpus: Folder of what reached new lines, where atheris chooses.
    """

    def __init__(self, name: str, row: dict[str, Any], corpus: Path | None = None) -> None:
        self.name = name
        self.row = row
        self.corpus = corpus
        for key in ("inputs", "findings", "crashes", "hangs"):
            row.setdefault(key, 0)
        row.setdefault("ends", {})
        row.setdefault("slowest", 0.0)
        row.setdefault("grown", 0)
        self.causes: Counter[str] = Counter()

    def go_on(self, inputs: int, seconds: float) -> None:
        """Read more inputs, until there are so many in all or so much time has passed."""
        until = time.monotonic() + seconds
        while self.row["inputs"] < inputs and time.monotonic() < until:
            with tempfile.TemporaryDirectory(prefix="drgs-fuzz-", dir=_MEMORY if _MEMORY.is_dir() else None) as name:
                self._process(Path(name), inputs, until)

    def _process(self, scratch: Path, inputs: int, until: float) -> None:
        """One process, until it is done, time is up, or it is dead or has to be ended."""
        begin = self.row["inputs"]
        line = [sys.executable, str(WORKER), self.name, str(begin), str(inputs)]
        with (scratch / "said").open("w") as said:
            # Without a buffer: a line that lay in one would not be seen by select below, and be waited for.
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": said, "bufsize": 0}
            process = subprocess.Popen([*line, str(scratch), *([str(self.corpus)] if self.corpus else [])], **pipes)
        ended = ""
        number = begin - 1
        since = time.monotonic()
        spent = 0.0
        ready = False
        try:
            while True:
                if select.select([process.stdout], [], [], 0.25)[0]:
                    text = process.stdout.readline()
                    if not text:
                        break
                    ready = True
                    self._hear(json.loads(text), scratch)
                    if b'"finding"' in text:
                        process.stdin.write(b"\n")
                        process.stdin.flush()
                if process.poll() is not None:
                    continue  # until what it said is read
                if not ready:
                    if time.monotonic() - since > _START:
                        raise SystemExit(f"{self.name}: no process starts; {(scratch / 'said').read_text()[-2000:]}")
                    continue
                if time.monotonic() > until:
                    ended = "time"
                    break
                if (now := _number(scratch)) != number:
                    number = now
                    since = time.monotonic()
                    spent = processor_seconds(process.pid)
                elif processor_seconds(process.pid) - spent > SLOW or time.monotonic() - since > _STUCK:
                    ended = "hang"
                    break
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
            process.stdin.close()
        if not ready:
            raise SystemExit(f"{self.name}: the valid files are not read; {(scratch / 'said').read_text()[-2000:]}")
        at = _number(scratch)
        if ended == "time":
            self.row["inputs"] = max(self.row["inputs"], at)
        elif ended == "hang" or process.returncode != 0 or self.row["inputs"] < min(at + 1, inputs):
            crashed = ended != "hang"
            what = f"crash ({process.returncode})" if crashed else f"hang (> {SLOW:g} s)"
            self.row["crashes" if crashed else "hangs"] += 1
            self.row["inputs"] = at + 1
            damaged = _damaged(scratch)
            news = {"file": damaged.name, "data": damaged.read_bytes()} if damaged.is_file() else None
            self._keep(at, what, (scratch / "crash.txt").read_text() + (scratch / "said").read_text()[-2000:], news)

    def _hear(self, news: dict[str, Any], scratch: Path) -> None:
        row = self.row
        if "done" in news:
            row["inputs"] = news["done"]
            for name, count in news["counts"].items():
                row["ends"][name] = row["ends"].get(name, 0) + count
            row["slowest"] = round(max(row["slowest"], news["slowest"]), 3)
            row["grown"] = max(row["grown"], news["grown"])
        elif "finding" in news:
            row["findings"] += 1
            news["data"] = (scratch / "finding").read_bytes()
            told = f"{news['fault']} {news.get('place')}: {news.get('text', '')}"
            self._keep(news["finding"], told, news["trace"], news, f"{news['fault']} {news.get('place')}")

    def _keep(self, number: int, what: str, trace: str, news: dict | None = None, cause: str = "") -> None:
        """Put what was found where it can be looked at; of one cause a few."""
        self.causes[cause or what] += 1
        if self.causes[cause or what] > _KEPT:
            return
        folder = FINDINGS / re.sub(r"\W+", "-", self.name)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{number}.log").write_text(f"{self.name}, input {number}: {what}\n\n{trace}\n", errors="replace")
        if news is not None:
            (folder / f"{number}{Path(news['file']).suffix}").write_bytes(news["data"])
        print(f"{self.name}, input {number}: {what}", flush=True)


def _number(scratch: Path) -> int:
    return struct.unpack_from("<q", (scratch / "number").read_bytes())[0]


def _damaged(scratch: Path) -> Path:
    """The file that was read last."""
    data = (scratch / "number").read_bytes()
    return Path(os.fsdecode(data[10 : 10 + int.from_bytes(data[8:10], "little")]))


def again(name: str, number: int) -> None:
    """Read one input in this process, with its traceback; its files are left in runs/fuzz/again."""
    scratch = ROOT / "runs" / "fuzz" / "again"
    shutil.rmtree(scratch, ignore_errors=True)
    bench = Bench(TARGETS[name], scratch)
    folder, path, data = bench.place(number)
    print(f"{path}: {len(data)} bytes", flush=True)
    bench.target.read(folder)


def table(result: dict[str, Any]) -> str:
    """The part of docs/reliability.md: all readers together."""
    rows = [result["readers"][name] for name in TARGETS if name in result["readers"]]
    ways = ", ".join(f"{row['ends'].get('ended', 0):,} of the videos" for row in rows if row["ends"].get("ended"))
    shares = [row["ends"].get("read", 0) / (sum(row["ends"].values()) or 1) for row in rows]
    told = (
        f"{sum(row['inputs'] for row in rows):,} inputs of {len(rows)} readers, {sum(map(_found, rows))} findings: by "
        f"reader {min(shares):.0%} to {max(shares):.0%} were read all the same, the others refused in one line; the "
        f"slowest took {max(row['slowest'] for row in rows):.2f} s, the most memory was "
        f"{max(row['grown'] for row in rows) / 2**20:.0f} MiB."
    )
    made = f"`python benchmarks/fuzz.py`, {result['machine']}, {result['date']}, commit {result['commit']}"
    reached = [row for row in result.get("reached", {}).values() if row.get("inputs")]
    more = f"; {sum(row['inputs'] for row in reached):,} more by atheris, {sum(map(_found, reached))} findings"
    ended = f" {ways} ended the process that decodes, in one line." if ways else ""
    return paragraph(f"{told} {made} ([each reader](data/fuzz.csv){more if reached else ''}).{ended}")


def sheet(result: dict[str, Any]) -> list[list[str]]:
    """The data file: each reader; `reached` are inputs that atheris chose by the lines that they reach."""
    lines = [["reader", "inputs", "read", "slowest_s", "grown_MiB", "findings", "reached", "kept", "reached_findings"]]
    for name in TARGETS:
        if row := result["readers"].get(name):
            read = row["ends"].get("read", 0) / (sum(row["ends"].values()) or 1)
            cells = [f"{row['inputs']}", f"{read:.3f}", f"{row['slowest']:.2f}", f"{row['grown'] / 2**20:.0f}"]
            more = result.get("reached", {}).get(name, {})
            chosen = [str(more["inputs"]), str(more["kept"]), str(_found(more))] if more.get("inputs") else [""] * 3
            lines.append([name, *cells, str(_found(row)), *chosen])
    return lines


def _found(row: dict[str, Any]) -> int:
    return row["findings"] + row["crashes"] + row["hangs"]


def counted() -> dict[str, Any]:
    """All counts so far."""
    return json.loads(COUNTS.read_text()) if COUNTS.exists() else {"readers": {}}


def save(kind: str, name: str, row: dict[str, Any]) -> None:
    """Write a reader's counts beside those of others, which another process may write as well, and the page."""
    with LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        result = counted() | ran()
        result.setdefault(kind, {})[name] = row
        COUNTS.write_text(json.dumps(result, indent=1) + "\n")
        write_page(result)


def write_page(result: dict[str, Any]) -> None:
    """The table and the data file."""
    fill_between(PAGE, "fuzz", table(result))
    write_csv(PAGE_DATA / "fuzz.csv", sheet(result))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--inputs", type=int, default=1 << 40, help="of each reader, in all")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader, this time")
    parser.add_argument("--again", type=int, help="repeat this input of one reader")
    parser.add_argument("--fresh", action="store_true", help="count from 0, by the first inputs")
    parser.add_argument("--page", action="store_true", help="read nothing, write the table of what is there")
    parser.add_argument("--atheris", action="store_true", help="choose inputs by what they reach")
    args = parser.parse_args()
    if args.page:
        write_page(counted())
        return
    if args.again is not None:
        again(args.readers[0], args.again)
        return
    LOCK.parent.mkdir(parents=True, exist_ok=True)
    kind = "reached" if args.atheris else "readers"
    for name in args.readers:
        corpus = ROOT / "runs" / "fuzz" / "reached" / re.sub(r"\W+", "-", name) if args.atheris else None
        row = {} if args.fresh else counted().get(kind, {}).get(name, {})
        began = time.monotonic()
        before = row.get("inputs", 0)
        reader = Reader(name, row, corpus)
        reader.go_on(args.inputs, args.seconds)
        if corpus is not None:
            row["kept"] = sum(not path.name.startswith("seed") for path in corpus.iterdir())
        print(f"{name}: {row['inputs'] - before} inputs in {time.monotonic() - began:.0f} s, {row}", flush=True)
        save(kind, name, row)


if __name__ == "__main__":
    main()
