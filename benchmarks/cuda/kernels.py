"""Every CUDA kernel of the package, compiled for real cards on a machine without one.

    python benchmarks/cuda/kernels.py           a table, and benchmarks/cuda/kernels.json
    python benchmarks/cuda/kernels.py --check [CASE ...]      writes nothing; 1 if anything is wrong

A process of its own (drive.py) runs the cases on LLVM and on a driver that has no card behind it, which keeps the PTX
that Dr.Jit writes. NVIDIA's ptxas, of which PyPI has a wheel (`pip install drgs[ptxas]`), compiles it for each
architecture and tells registers, spilled bytes, local and shared memory. Dr.Jit writes other PTX for cards before
sm_80, which have a run of their own (`--old`). OptiX's compiler is in the driver only: the kernels of `traversal="bvh"`
are parsed, with the functions of OptiX declared; nothing is known of their registers.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(HERE)]

OLD, NEW = ("sm_75",), ("sm_80", "sm_90", "sm_100")
ARCHITECTURES = (*OLD, *NEW)
NUMBERS = ("registers", "spilled", "local", "shared")
_SPILLED = 4096
_TOLD = (
    "peak, order of centers",
    "peak, exact order",
    "ewa, gsplat",
    "information, exact order",
    "information, order of centers",
    "information, 40 features",
    "columns, order of centers",
    "bvh, exact order",
)
_DATA = HERE / "kernels.json"


def ptxas() -> Path | None:
    """NVIDIA's assembler: that of the wheel beside this Python, else on the path; or None."""
    if (given := os.environ.get("DRGS_PTXAS")) and Path(given).is_file():
        return Path(given)
    try:
        found = importlib.util.find_spec("nvidia.cuda_nvcc")
    except ModuleNotFoundError:
        found = None
    for folder in found.submodule_search_locations or [] if found else []:
        if (made := Path(folder) / "bin" / "ptxas").is_file():
            return made
    there = shutil.which("ptxas")
    return Path(there) if there else None


def missing() -> str | None:
    """What this needs and the machine lacks, in one line; None if nothing."""
    if shutil.which("gcc") is None:
        return "gcc, which builds a driver without a card, was not found; apt-get install gcc"
    if ptxas() is None:
        return "ptxas was not found; pip install 'drgs[ptxas]', or name one in DRGS_PTXAS"
    return None


def driven(folder: Path, names: Iterable[str] = (), capability: int = 80, optix: bool = True) -> dict[str, dict]:
    """What each case has asked of a card of this compute capability, and the modules, which are in `folder`.

    Raises:
        RuntimeError: If the process that drives them fails.
    """
    import card

    folder.mkdir(parents=True, exist_ok=True)
    library = card.build(folder)
    rays = folder / "libnvoptix.so"
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", str(HERE / "libnvoptix.c"), "-o", str(rays)], check=True)
    modules = folder / "modules"
    modules.mkdir()
    # An empty cache: what Dr.Jit finds there it does not write again.
    environ = {
        **os.environ,
        "DRJIT_LIBCUDA_PATH": str(library),
        "DRJIT_LIBOPTIX_PATH": str(rays) if optix else "",
        "CARD_CAPABILITY": str(capability),
        "DRJIT_CACHE_DIR": str(folder / "cache"),
        "CARD_MODULES": str(modules),
        "DRGS_THREADS": "1",
        "DRGS_VARIANT": "",
    }
    (folder / "cache").mkdir()
    out = folder / "cases.json"
    command = [sys.executable, str(HERE / "drive.py"), str(out), *names]
    done = subprocess.run(command, env=environ, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-2000:]}")
    return json.loads(out.read_text())


# -- PTX -----------------------------------------------------------------------------------------------------------


def declared(text: str) -> str:
    """A module for OptiX with the functions of OptiX declared, as their first calls in it use them."""
    kinds = {"%r": "b32", "%f": "f32", "%rd": "b64", "%d": "f64", "%p": "pred", "%w": "b16"}
    for kind, names in re.findall(r"\.reg\s*\.(\w+)\s+([^;<]+);", text):
        kinds |= dict.fromkeys((x.strip() for x in names.split(",")), kind)

    def of(name: str) -> str:
        kind = kinds.get(name) or kinds.get(re.sub(r"\d+$", "", name)) or ("b32" if "_" in name else "b64")
        return {"pred": "b32", "u32": "b32", "s32": "b32", "u64": "b64", "f32": "b32", "f64": "b64"}.get(kind, kind)

    head: dict[str, str] = {}
    for out, name, given in re.findall(r"call\s+(?:\(([^)]*)\),\s*)?(_optix_\w+),\s*\(([^)]*)\)", text):
        sides = [[of(x.strip()) for x in side.split(",") if x.strip()] for side in (out, given)]
        ends = [
            ", ".join(f".reg .{kind} {s}{k}" for k, kind in enumerate(side))
            for s, side in zip("ra", sides, strict=True)
        ]
        head.setdefault(name, f".extern .func {f'({ends[0]}) ' if ends[0] else ''}{name}({ends[1]});")
    at = re.search(r"\.address_size 64[^\n]*\n", text)
    assert at is not None, "a module says how wide addresses are"
    return text[: at.end()] + "\n".join(head.values()) + "\n" + text[at.end() :]


def compiled(module: Path, architecture: str) -> dict[str, Any]:
    """Registers, and bytes spilled, of local and of shared memory, of the kernel in a module; or what ptxas says."""
    source = module
    target = architecture
    if module.name.startswith("optix"):
        source = module.with_suffix(".declared")
        source.write_text(declared(module.read_text()))
        target = architecture.replace("sm", "compute")  # parsed, and no code made
    # What is written for one architecture is not refused by another: the target is only the least.
    text = re.sub(r"\.target sm_\d+", f".target {architecture}", source.read_text(), count=1)
    own = module.with_suffix(f".{architecture}")
    own.write_text(text)
    command = [str(ptxas()), "-v", "-arch", target, str(own), "-o", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True)
    told = done.stderr + done.stdout
    if done.returncode:
        return {"error": next((x for x in told.splitlines() if "error" in x), told[-300:])}

    def largest(pattern: str) -> int:
        return max((int(x) for x in re.findall(pattern, told)), default=0)

    return {
        "registers": largest(r"Used (\d+) registers"),
        "spilled": largest(r"(\d+) bytes spill stores") + largest(r"(\d+) bytes spill loads"),
        "local": largest(r"(\d+) bytes stack frame"),
        "shared": largest(r"(\d+) bytes smem"),
    }


def is_own(text: str) -> bool:
    """Whether a module is one that Dr.Jit has written for this package, not one that came with it or with Mitsuba."""
    return ".entry drjit_" in text or "__raygen__" in text


def counted(text: str) -> Counter:
    """How often a module has each kind of instruction whose rounding or order matters."""
    body = [line.strip() for line in text.splitlines()]
    found = Counter()
    for line in body:
        line = re.sub(r"^@!?%\w+\s+", "", line)
        if match := re.match(r"(ex2|lg2|sin|cos|rsqrt|sqrt|rcp|div|tanh|fma|add|sub|mul|red|atom)\.([\w.:]+)", line):
            found[f"{match[1]}.{match[2]}"] += 1
    return found


def rows(folder: Path, cases: dict[str, dict], architectures: Sequence[str]) -> list[dict]:
    """A row for each kernel, which belongs to the first case that has asked for it."""
    made = []
    for case, found in cases.items():
        for name in found.get("modules", []):
            text = (folder / "modules" / name).read_text()
            if not is_own(text):
                continue
            row: dict[str, Any] = {"case": case, "optix": name.startswith("optix"), "lines": text.count("\n")}
            row["loops"] = len(re.findall(r"\bbra\b", text))
            row["instructions"] = dict(sorted(counted(text).items()))
            row |= {own: compiled(folder / "modules" / name, own) for own in architectures}
            made.append(row)
    return made


def faults(cases: dict[str, dict], kernels: Sequence[dict]) -> list[str]:
    """One line for each case that failed, and for each kernel that does not compile or spills.

    A kernel without a loop does its work once for each Gaussian, which `_SPILLED` bytes slow down little. One that
    walks along hits may spill nothing.
    """
    lines = [f"{case}: {found['error']}" for case, found in cases.items() if "error" in found]
    for row in kernels:
        for name in (x for x in ARCHITECTURES if x in row):
            own = row[name]
            if "error" in own:
                lines.append(f"{row['case']}: {name}: {own['error']}")
            elif own["spilled"] > (0 if row["loops"] else _SPILLED):
                lines.append(f"{row['case']}: {name}: {own['spilled']} bytes spilled, {own['registers']} registers")
        if rough := row["instructions"].get("rcp.approx.ftz.f64"):
            lines.append(f"{row['case']}: {rough} float64 reciprocals of 20 bits: runtime.exactly")
    return lines


# -- the page ------------------------------------------------------------------------------------------------------


def table(kernels: Sequence[dict], cases: dict[str, dict]) -> list[str]:
    """Markdown: a row for each case of `_TOLD`, or all if none of these were driven: its largest kernel anywhere."""
    cases = {case: cases[case] for case in _TOLD if case in cases} or cases
    lines = [
        "| case | kernels | most registers | spilled | in loops | launches | waits |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, found in cases.items():
        own = [row for row in kernels if row["case"] == case]
        if not own:
            continue
        most, spilled, looped = (
            max(
                (row[x].get(key, 0) for row in own for x in ARCHITECTURES if x in row and (row["loops"] or not only)),
                default=0,
            )
            for key, only in (("registers", False), ("spilled", False), ("spilled", True))
        )
        waits = found["synchronizations"] + found["torch_waits"]
        numbers = f"{len(own)} | {most} | {spilled} B | {looped} B | {found['launches']} | {waits}"
        lines.append(f"| {case} | {numbers} |")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--old", action="store_true", help="a second run, of the PTX for sm_75")
    parser.add_argument("--keep", type=Path, help="leave modules in this folder")
    parser.add_argument("cases", nargs="*")
    args = parser.parse_args()
    if lacks := missing():
        print(f"kernels.py: {lacks}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        cases = driven(folder / "80", args.cases)
        kernels = rows(folder / "80", cases, NEW)
        old = driven(folder / "75", args.cases, 75, optix=False) if args.old else {}
        before = rows(folder / "75", old, OLD)
    print("\n".join(table(kernels, cases)))
    if not args.check:
        from where import ran

        if not args.old and _DATA.exists():
            before = json.loads(_DATA.read_text()).get("old", [])
        told = {"ran": ran(), "cases": cases, "kernels": kernels, "old": before}
        _DATA.write_text(json.dumps(told, indent=None, separators=(",", ":")).replace('{"case"', '\n{"case"') + "\n")
    wrong = faults(cases, kernels) + faults(old, before)
    print("\n".join(wrong), file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
