"""The tables of docs/results.md, of the rows of the studies: benchmarks/static.jsonl and benchmarks/dynamic.jsonl.

    python benchmarks/results.py        runs nothing

The cells are those of `drgs reproduce static|dynamic|prior|blocks --scale small`; benchmarks/semantic.py and kitchen.py
have run them (both the protocols `blind` and `paper` on the first room), and other scenes and policies besides.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from where import ran  # noqa: E402

from drgs.studies.experiments import EXPERIMENTS, study_of  # noqa: E402
from drgs.studies.results import results_page  # noqa: E402
from drgs.studies.rows import read_study  # noqa: E402
from drgs.studies.tables import fill_between  # noqa: E402

PAGE = ROOT / "docs" / "results.md"
TOLD = {
    "static": "Besides the made rooms, `statue`, a capture that people labelled.",
    "dynamic": "Rows that were measured before class means and peak memory were recorded have none.",
}


def text() -> str:
    """The four sections."""
    at = ran()
    parts = []
    for name, experiment in EXPERIMENTS.items():
        study = study_of(experiment.study, "small", ROOT / "runs" / "studies" / "scenes")
        rows = read_study(ROOT / "benchmarks" / f"{experiment.study}.jsonl")
        parts.append(results_page(study, experiment, rows, told=[TOLD[name]] if name in TOLD else []))
    return "\n\n".join([f"`python benchmarks/results.py`, {at['machine']}, {at['date']}.", *parts])


if __name__ == "__main__":
    fill_between(PAGE, "results", text())
