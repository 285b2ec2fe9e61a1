"""`drgs stress`: the extremes of the renderer as a table, and whether every claim holds on this machine."""

from __future__ import annotations

import dataclasses
import math
import textwrap
import time
from typing import TYPE_CHECKING

from drgs import runtime
from drgs.display.progress import Bar
from drgs.io.journal import SCHEMA
from drgs.io.outputs import lock_folder, write_json, write_whole
from drgs.lab import extremes
from drgs.lab.stress import BOUNDS, StressRow, rows

if TYPE_CHECKING:
    from drgs.commands.options import Stress

COLUMNS = {
    "image": "image",
    "gradient": "gradient",
    "forward": "forward mode",
    "duality": "adjoint against forward",
    "fisher": "Fisher diagonal",
}


def run(args: Stress) -> int:
    """`drgs stress`: exit code 1 if a bound is broken."""
    known = (*extremes.CASES, *extremes.REFUSALS)
    chosen = [case for case in known if args.match.lower() in case.name.lower()]
    if not chosen:
        raise ValueError(f"stress: --match must be part of a case's name, got {args.match!r}; drgs stress lists all")
    if args.output is not None:
        lock_folder(args.output, "stress", ["stress.json", "stress.md"])
    start = time.perf_counter()
    found = []
    if not args.quiet:
        print(f"{len(chosen)} cases; the first run compiles their kernels: minutes. Later ones take one or two.")
        print(_line("on", "", "image", "gradient", "forward", "adj/fwd", "Fisher"))
    with Bar("stress", len(chosen), not args.quiet) as bar:
        for number, case in enumerate(chosen):
            bar.update(number, text=case.name)
            measured = list(rows(case))
            found += measured
            shown = [_printed(row) for row in measured if not args.quiet or row.verdict == "FAILS"]
            if shown:
                print("\n".join([case.name, *shown]), flush=True)
    seconds = time.perf_counter() - start
    failed = [row for row in found if row.verdict == "FAILS"]
    if args.output is not None:
        _write(args, found, seconds)
    if not args.quiet:
        held, warned = (sum(row.verdict == verdict for row in found) for verdict in ("holds", "warns"))
        print(
            f"\n{len(found)} rows in {seconds:.0f} s: {held} hold, {warned} refused or warned about, {len(failed)} fail"
        )
        for row in failed:
            print(f"FAILS: {row.case} on {row.traversal}: {row.remark}")
        if args.output is not None:
            print(f"stress.json and stress.md: {args.output}")
    return 1 if failed else 0


def _line(traversal: str, verdict: str, image: str, gradient: str, *others: str) -> str:
    return f"  {traversal:<5}  {verdict:<5}  {image:>7}  {gradient:<22}" + "".join(f"{x:>9}" for x in others)


def _number(x: float | None) -> str:
    return "-" if x is None else f"{x:.0e}"


def _finite(row: StressRow) -> str:
    return "-" if row.finite is None else "yes" if row.finite else "NO"


def _printed(row: StressRow) -> str:
    """Lines of at most 80 characters; the case has a line of its own."""
    gradient = " ".join((_number(row.gradient), row.group)).strip()
    others = (_number(row.forward), _number(row.duality), _number(row.fisher))
    remarks = "; ".join(["not finite"] * (row.finite is False) + [row.remark] * bool(row.remark))
    remark = textwrap.wrap(remarks, 80, initial_indent=" " * 4, subsequent_indent=" " * 4)
    return "\n".join([_line(row.traversal, row.verdict, _number(row.image), gradient, *others), *remark])


def markdown(found: list[StressRow]) -> list[str]:
    """The lines of a table."""
    lines = [
        "| case | traversal | " + " | ".join(COLUMNS.values()) + " | finite | verdict | remark |",
        "|---" * (len(COLUMNS) + 5) + "|",
    ]
    for row in found:
        numbers = [_number(getattr(row, name)) for name in COLUMNS]
        numbers[1] += f" ({row.group.replace('_', ' ')})" if row.group and row.gradient else ""
        remark = row.remark.replace("|", "\\|")
        lines.append(
            f"| {row.case} | {row.traversal} | {' | '.join(numbers)} | {_finite(row)} | {row.verdict} | {remark} |"
        )
    return lines


def _write(args: Stress, found: list[StressRow], seconds: float) -> None:
    """stress.json, and stress.md with the table."""
    env = runtime.info()
    report = {
        "schema": SCHEMA,
        "command": "stress",
        "match": args.match,
        "bounds": BOUNDS,
        "seconds": seconds,
        "verdicts": {name: sum(row.verdict == name for row in found) for name in ("holds", "warns", "FAILS")},
        "rows": [_finite_numbers(dataclasses.asdict(row)) for row in found],
        "env": env,
    }
    write_json(args.output / "stress.json", report)
    text = "\n".join([f"drgs {env['drgs']}, {env['cpu']}, {env['backend']['variant']}.", "", *markdown(found), ""])
    write_whole(args.output / "stress.md", text.encode())


def _finite_numbers(row: dict) -> dict:
    """JSON has no NaN: such a number is its name."""
    return {k: str(x) if isinstance(x, float) and not math.isfinite(x) else x for k, x in row.items()}
