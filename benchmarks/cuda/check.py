"""Everything that a machine with an NVIDIA card can tell, by one command, in one file to send back.

    make cuda-check                                      into out/cuda-check.json
    python benchmarks/cuda/check.py [-o FILE] [--quick]

The suite on `cuda_ad_rgb`, `drgs stress`, crossval against gsplat's own kernels on both of its paths (rasterization,
and Gaussians along rays: `with_ut`, `with_eval3d`) and the times of frames, on the card and on LLVM, each in a process
of its own whose end the file keeps, whatever happens to it. What the machine lacks is said in one line, before anything
runs.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.metadata
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

TAIL = 20_000  # characters of what a process prints that are kept
SEEDS = range(10)


def missing() -> str | None:
    """What a machine must have and this one has not, in one line; None if nothing."""
    try:
        code = ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1").cuInit(0)
    except OSError:
        return "an NVIDIA driver must be there, libcuda.so.1 was not found; run this on a machine with a card"
    if code:
        return f"the NVIDIA driver must have a card, cuInit returned {code}; run this on a machine with a card"
    import torch

    if torch.version.cuda is None:
        return "torch must be built for CUDA, is for the CPU; make PIP_FLAGS= clean setup"
    if not torch.cuda.is_available():
        return f"torch must see the card, does not (built for CUDA {torch.version.cuda}); use a build for the driver"
    from drgs import runtime

    usable, reason = runtime.cuda_status()
    if not usable:
        return f"Dr.Jit must be able to use the card, but {reason}"
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat must be installed, is not; pip install gsplat"
    return None


def ended(command: list[str], limit: float, **environ: str) -> dict:
    """How a process ended, after how many seconds, and the end of what it printed."""
    began = time.perf_counter()
    full = {**os.environ, "PYTHONPATH": str(ROOT), **environ}
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=full, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=limit
        )
        code: int | str = done.returncode
        told = done.stdout
    except subprocess.TimeoutExpired as error:
        code, told = f"stopped after {limit:g} s", error.stdout or b""
    text = told.decode(errors="replace")[-TAIL:]
    return {"command": command, "code": code, "seconds": time.perf_counter() - began, "output": text}


def versus_gsplat() -> list[dict]:
    """Verdicts of crossval against gsplat's kernels, a row for each path and scene."""
    from drgs.crossval import crossval
    from drgs.lab.rasterizers import load_rasterizer
    from drgs.testing import random_scene

    rows = []
    for preset, along_rays in (("gsplat", False), ("3dgut", True)):
        for seed in SEEDS:
            g, views = random_scene(seed)
            row: dict = {"preset": preset, "along_rays": along_rays, "seed": seed}
            try:
                fields = {"background": (0.2, 0.4, 0.7)}
                theirs = load_rasterizer("gsplat", g, views, fields, along_rays)
                found = crossval(theirs, g, views, preset, fields)
                row |= {"verdict": found.verdict, "lines": found.lines()}
            except (ValueError, RuntimeError, NotImplementedError) as error:
                row["error"] = str(error)
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def timed() -> list[dict]:
    """Seconds of frames on this process's backend: medians of 7 after a warm-up, and Dr.Jit's launches."""
    import cubes
    import torch

    import drgs
    from drgs import fisher

    where = "cuda" if drgs.runtime.backend().name == "cuda" else "cpu"
    rows = []
    for count, size in ((100_000, (512, 512)), (1_000_000, (1920, 1080))):
        g, camera = cubes.cube(count).to(where), cubes.camera(*size)
        for preset in ("fast", "gsplat", "exact"):
            settings = drgs.RenderSettings.preset(preset)

            def forward(settings: drgs.RenderSettings = settings, g: drgs.Gaussians = g, camera=camera) -> None:
                with torch.no_grad():
                    drgs.render(g, camera, settings, outputs=()).rgb.sum().item()

            def step(settings: drgs.RenderSettings = settings, g: drgs.Gaussians = g, camera=camera) -> None:
                own = drgs.Gaussians(**{k: x.detach().requires_grad_() for k, x in g.parameters().items()})
                drgs.render(own, camera, settings, outputs=()).rgb.square().mean().backward()
                own.means.grad.sum().item()

            def diagonal(settings: drgs.RenderSettings = settings, g: drgs.Gaussians = g, camera=camera) -> None:
                fisher.diagonal(g, camera, settings)

            for kind in (forward, step, diagonal):
                seconds = []
                for _ in range(8):
                    began = time.perf_counter()
                    kind()
                    seconds.append(time.perf_counter() - began)
                own = sorted(seconds[1:])
                row = {"gaussians": count, "size": size, "preset": preset, "kind": kind.__name__, "first": seconds[0]}
                rows.append(row | {"median": own[3], "least": own[0], "most": own[-1]})
                print(json.dumps(rows[-1]), flush=True)
    return rows


def described() -> dict:
    """The machine, the card and all versions."""
    from drgs import runtime

    card = ended(["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.max.sm", "--format=csv"], 60)
    kernels = importlib.metadata.version("gsplat")
    return {"drgs": runtime.info(), "gsplat": kernels, "card": card["output"].splitlines()}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "out" / "cuda-check.json")
    parser.add_argument("--quick", action="store_true", help="a tenth of the suite, for a first look")
    parser.add_argument("--part", choices=("gsplat", "times"), help="one part, in this process")
    args = parser.parse_args()
    if lacks := missing() if args.part is None else None:
        print(f"cuda-check: {lacks}", file=sys.stderr)
        return 2
    if args.part is not None:
        {"gsplat": versus_gsplat, "times": timed}[args.part]()
        return 0
    python, own = sys.executable, str(HERE / "check.py")
    suite = ["tests/test_integrator.py", "tests/test_tiles.py", "tests/test_fisher.py"] if args.quick else []
    card = {"DRGS_VARIANT": "cuda_ad_rgb"}
    with tempfile.TemporaryDirectory() as folder:
        parts = {
            "times on the card": ([python, own, "--part", "times"], 1200, card),
            "crossval against gsplat": ([python, own, "--part", "gsplat"], 1800, card),
            "stress": ([python, "-m", "drgs", "stress", "-o", f"{folder}/stress"], 1800, card),
            "suite": ([python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rfE", *suite], 7200, card),
            "times on LLVM": ([python, own, "--part", "times"], 2400, {"DRGS_VARIANT": "llvm_ad_rgb"}),
        }
        args.output.parent.mkdir(parents=True, exist_ok=True)
        report: dict = {"machine": described()}
        for name, (command, limit, environ) in parts.items():
            print(f"cuda-check: {name}", flush=True)
            report[name] = ended(command, limit, **environ)
            stress = Path(folder) / "stress" / "stress.json"
            if name == "stress" and stress.exists():
                report["stress rows"] = json.loads(stress.read_text())
            # After each part: what there is counts, whatever the next one does.
            args.output.write_text(json.dumps(report, indent=1) + "\n")
            print(f"cuda-check: {name}: {report[name]['code']}, {report[name]['seconds']:.0f} s", flush=True)
    print(f"cuda-check: send back {args.output}")
    return int(any(report[name]["code"] for name in parts))


if __name__ == "__main__":
    sys.exit(main())
