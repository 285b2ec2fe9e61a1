"""Errors of the renderer against the float64 oracle at the extremes; writes the table of docs/numerics.md.

python benchmarks/numerics.py [--print]

The same rows as `drgs stress`.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

from where import ran  # noqa: E402

from drgs.commands.stress import markdown  # noqa: E402
from drgs.lab.extremes import CASES  # noqa: E402
from drgs.lab.refusals import REFUSALS  # noqa: E402
from drgs.lab.stress import rows  # noqa: E402
from drgs.studies.tables import fill_between  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--print", action="store_true", help="do not touch docs/numerics.md")
    args = parser.parse_args()
    found = []
    for case in (*CASES, *REFUSALS):
        for row in rows(case):
            found.append(row)
            print(markdown([row])[-1], flush=True)
    at = ran()
    made = f"`python benchmarks/numerics.py`, {at['machine']}, {at['date']}, commit {at['commit']}."
    if not args.print:
        fill_between(ROOT / "docs" / "numerics.md", "table", "\n".join([made, "", *markdown(found)]))
    return int(any(row.verdict == "FAILS" for row in found))


if __name__ == "__main__":
    sys.exit(main())
