"""`drgs info`: backend, libLLVM, CUDA, threads and package versions of this machine."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

from drgs import runtime

if TYPE_CHECKING:
    from drgs.commands.options import Info


def run(args: Info) -> None:
    """`drgs info`: exit code 2 when nothing can be rendered here."""
    report = runtime.info()
    if args.json:
        print(json.dumps(report, indent=2))
    else:
        print(_plain(report))
    if report["backend"]["error"]:
        raise ValueError(report["backend"]["error"])


def _plain(report: dict) -> str:
    """The report of `runtime.info()` as aligned lines."""
    llvm, cuda, optix = report["llvm"], report["cuda"], report["optix"]
    cores, target = report["cores"], llvm["target"]
    others = [x["path"] for x in llvm["found"] if x["path"] != llvm["path"]]
    rows = {
        "drgs": f"{report['drgs']} (commit {report['commit'] or 'unknown'})",
        "python": f"{report['python']} on {report['platform']}",
        "cpu": f"{report['cpu']}, {cores['usable']} of {cores['machine']} cores",
        "backend": report["backend"]["variant"] or "none",
        "libLLVM": f"{llvm['version']} ({llvm['path']})" if llvm["version"] else "not in use",
        "compiled for": f"{target['cpu']}, {target['lanes']} lanes" if target else "unknown",
        "also found": ", ".join(others) or "no other libLLVM",
        "threads": ", ".join(f"{name} {count}" for name, count in report["threads"].items() if count) or "unknown",
        "CUDA": cuda["device"] or "yes" if cuda["available"] else f"no: {cuda['reason']}",
        "OptiX": "yes" if optix["available"] else f"no: {optix['reason']}",
        **{name: version or "not installed" for name, version in report["packages"].items()},
    }
    width = max(map(len, rows))
    return re.sub(r" +$", "", "\n".join(f"{k:<{width}}  {v}" for k, v in rows.items()), flags=re.M)
