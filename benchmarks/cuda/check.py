"""Everything that a machine with an NVIDIA card can tell, by one command, in one file to send back.

    make cuda-check                                      into out/cuda-check.json
    python benchmarks/cuda/check.py [-o FILE] [--quick]
    python benchmarks/cuda/check.py --page               table of docs/cuda.md, from h200.json

Images, gradients and information of the card beside those of LLVM, times of frames and of a pick beside gsplat's own
kernels, crossval against these on both of their paths (rasterization, and Gaussians along rays: `with_ut`,
`with_eval3d`), `drgs stress`, the suite on `cuda_ad_rgb`, and the times on LLVM, each in a process of its own whose end
the file keeps, whatever happens to it. What the machine lacks is said in one line, before anything runs.

A machine without libLLVM compares with what another one has computed: `check.py --part frames --npz FILE` there, and
`check.py --part compare --npz FILE` here.
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
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch

    import drgs

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

TAIL = 20_000  # characters of what a process prints that are kept
SEEDS = range(10)
PRESETS = ("exact", "fast", "gsplat", "3dgut", "mitsuba")


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
    from drgs.lab.crossval import crossval
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


def scenes() -> dict:
    """Gaussians and a camera by name: of these, all that a backend computes is compared."""
    import cubes

    from drgs.testing import random_scene

    found = {"cube": (cubes.cube(5_000, sh_degree=1), cubes.camera(160))}
    for seed in range(3):
        g, views = random_scene(seed)
        found[f"random {seed}"] = (g, views[0])
    return found


def frames() -> Iterator[tuple[str, np.ndarray]]:
    """(name, array) of images, gradients and information of this process's backend."""
    import torch

    import drgs
    from drgs import fisher

    for scene, (g, camera) in scenes().items():
        weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(5))
        for preset in PRESETS:
            settings = drgs.RenderSettings.preset(preset)
            own = drgs.Gaussians(**{k: x.detach().requires_grad_() for k, x in g.parameters().items()})
            out = drgs.render(own, camera, settings, outputs=("depth",))
            (out.rgb * weights).sum().backward()
            for name in ("rgb", "alpha", "depth"):
                yield f"{scene}/{preset}/{name}", getattr(out, name).detach().numpy()
            for name, x in own.parameters().items():
                yield f"{scene}/{preset}/gradient of {name}", x.grad.numpy()
            if settings.traversal == "tiles":
                for name, x in fisher.diagonal(g, camera, settings).items():
                    yield f"{scene}/{preset}/information of {name}", x.numpy()


def compared(theirs: dict[str, np.ndarray]) -> None:
    """Print how far this backend's arrays are from another's: the largest difference over the largest number, and rms
    over rms.
    """
    for name, x in frames():
        y = theirs[name].astype(np.float64)
        both = np.isfinite(x) & np.isfinite(y)
        off = np.where(both, x - y, 0.0)
        size = np.where(both, np.abs(y), 0.0)
        row: dict = {"name": name, "elsewhere finite": int((np.isfinite(x) != np.isfinite(y)).sum())}
        row["largest"] = float(np.abs(off).max() / max(size.max(), 1e-30))
        row["rms"] = float(np.sqrt((off**2).mean() / max((size**2).mean(), 1e-60)))
        print(json.dumps(row), flush=True)


def medians(kinds: dict, **named: Any) -> None:
    """Print seconds of each kind: the first call, and median, least and most of seven more, in turns."""
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    for _ in range(8):
        for kind, call in kinds.items():
            began = time.perf_counter()
            call()
            seconds[kind].append(time.perf_counter() - began)
    for kind, all_ in seconds.items():
        own = sorted(all_[1:])
        row = {**named, "kind": kind, "first": all_[0], "median": own[3], "least": own[0], "most": own[-1]}
        print(json.dumps(row), flush=True)


def gsplat_frames(g: drgs.Gaussians, camera: drgs.Camera) -> dict:
    """The same frames by gsplat's kernels, as its users call them."""
    import torch
    from gsplat import rasterization

    viewmats = torch.tensor(camera.w2c, dtype=torch.float32, device="cuda")[None]
    Ks = torch.tensor(camera.K, dtype=torch.float32, device="cuda")[None]
    degree = round(g.sh.shape[1] ** 0.5) - 1

    def drawn(*raw: torch.Tensor) -> torch.Tensor:
        means, quats, log_scales, logit_opacities, sh = raw
        activated = (means, quats, log_scales.exp(), logit_opacities.sigmoid(), sh)
        size = {"width": camera.width, "height": camera.height}
        return rasterization(*activated, viewmats, Ks, sh_degree=degree, packed=False, **size)[0]

    raw = [x.detach() for x in (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)]

    def forward() -> None:
        with torch.no_grad():
            drawn(*raw).sum().item()

    def step() -> None:
        leaves = [x.clone().requires_grad_() for x in raw]
        drawn(*leaves).square().mean().backward()
        leaves[0].grad.sum().item()

    return {"forward": forward, "step": step}


def timed() -> None:
    """Seconds of frames, on this process's backend and by gsplat's kernels, and of a pick."""
    import cubes
    import torch

    import drgs
    from drgs import fisher

    is_card = drgs.runtime.backend().name == "cuda"
    for count, size in ((100_000, (512, 512)), (1_000_000, (1920, 1080))):
        g, camera = cubes.cube(count).to("cuda" if is_card else "cpu"), cubes.camera(*size)
        named = {"gaussians": count, "size": size}
        if is_card:
            medians(gsplat_frames(g, camera), renderer="gsplat's kernels", **named)
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
                fisher.diagonal(g, camera, settings)["means"].sum().item()

            medians({"forward": forward, "step": step, "diagonal": diagonal}, renderer=preset, **named)
    g = cubes.cube(20_000, sh_degree=3).to("cuda" if is_card else "cpu")
    around = drgs.cameras.orbit((0.0, 0.0, 0.0), 4.0, 88, width=320, height=240)
    for criterion in ("eig", "v_opt"):
        began = time.perf_counter()
        found = drgs.select_views(g, around[8:], around[:8], criterion=criterion)
        row = {"pick": criterion, "candidates": 80, "seconds": time.perf_counter() - began}
        print(json.dumps(row | {"picked": found.picks[0].name}), flush=True)


def page() -> list[str]:
    """Markdown: milliseconds of frames on the card of h200.json."""
    rows = json.loads((HERE / "h200.json").read_text())["times"]
    found = {(r["renderer"], r["gaussians"], r["kind"]): r for r in rows if "kind" in r}
    columns = list(dict.fromkeys((r["gaussians"], tuple(r["size"])) for r in rows if "kind" in r))
    kinds = {"forward": "forward", "step": "with gradient", "diagonal": "Fisher diagonal"}
    named = [f"{count:,} Gaussians, {width}x{height}" for count, (width, height) in columns]
    made = ["| " + " | ".join(["ms: " + ", ".join(kinds.values()), *named]) + " |", "|---|" + "---|" * len(named)]
    for renderer in dict.fromkeys(name for name, *_ in found):
        own = [[found.get((renderer, count, kind)) for kind in kinds] for count, _ in columns]
        cells = [", ".join(f"{1e3 * r['median']:.1f}" for r in rows if r) for rows in own]
        label = renderer if "kernels" in renderer else f"`{renderer}`"
        made.append(f"| {label} | " + " | ".join(cells) + " |")
    return made


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
    parser.add_argument("--part", choices=("frames", "compare", "gsplat", "times"), help="one part, in this process")
    parser.add_argument("--npz", type=Path, default=ROOT / "out" / "cuda-frames.npz", help="arrays of part frames")
    parser.add_argument("--page", action="store_true", help="write the table of docs/cuda.md, and nothing else")
    args = parser.parse_args()
    if args.page:
        from pages import fill_between

        fill_between(ROOT / "docs" / "cuda.md", "measured", "\n".join(page()))
        return 0
    if lacks := missing() if args.part is None else None:
        print(f"cuda-check: {lacks}", file=sys.stderr)
        return 2
    if args.part is not None:
        if args.part == "frames":
            args.npz.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(args.npz, **{name: x.astype(np.float32) for name, x in frames()})
        elif args.part == "compare":
            with np.load(args.npz) as theirs:
                compared(dict(theirs))
        else:
            {"gsplat": versus_gsplat, "times": timed}[args.part]()
        return 0
    python, own = sys.executable, str(HERE / "check.py")
    suite = ["tests/test_integrator.py", "tests/test_tiles.py", "tests/test_fisher.py"] if args.quick else []
    card, llvm = {"DRGS_VARIANT": "cuda_ad_rgb"}, {"DRGS_VARIANT": "llvm_ad_rgb"}
    with tempfile.TemporaryDirectory() as folder:
        arrays = ["--npz", f"{folder}/frames.npz"]
        parts = {
            "frames on LLVM": ([python, own, "--part", "frames", *arrays], 1200, llvm),
            "frames on the card": ([python, own, "--part", "compare", *arrays], 1200, card),
            "times on the card": ([python, own, "--part", "times"], 1200, card),
            "crossval against gsplat": ([python, own, "--part", "gsplat"], 1800, card),
            "stress": ([python, "-m", "drgs", "stress", "-o", f"{folder}/stress"], 1800, card),
            "suite": ([python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rfE", *suite], 7200, card),
            "times on LLVM": ([python, own, "--part", "times"], 2400, llvm),
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
