"""What float64 reciprocals of 20 bits would do to images: those of PTX's `rcp.approx.ftz.f64`, imitated on LLVM.

    python benchmarks/cuda/reciprocals.py

By NVIDIA's description the instruction reads the upper 32 bits of its operand and returns the upper 32 bits of a
result; here both are cut off, and the reciprocal between them is exact, which is the best that it may be. Printed are
the largest differences of a color to the same frame with reciprocals that are rounded to nearest.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import drjit as dr  # noqa: E402

import drgs  # noqa: E402
from drgs import testing  # noqa: E402

UPPER = 0xFFFFFFFF00000000


def main() -> None:
    exactly = dr.rcp, dr.rsqrt

    def cut(x: object) -> object:
        lib = drgs.runtime.dr_types()
        return dr.reinterpret_array(lib.Float64, dr.reinterpret_array(lib.UInt64, lib.Float64(x)) & UPPER)

    def is_wide(x: object) -> bool:
        return dr.is_array_v(x) and dr.type_v(x) == dr.VarType.Float64

    def rcp(x: object) -> object:
        return cut(exactly[0](cut(x))) if is_wide(x) else exactly[0](x)

    def rsqrt(x: object) -> object:
        return dr.sqrt(rcp(x)) if is_wide(x) else exactly[1](x)

    g, (camera,) = testing.random_scene()
    scenes = {
        "random_scene, 60 Gaussians, 48x40": (g, camera),
        "the same, 1/30 as wide": (g.replace(log_scales=g.log_scales - 3.4), camera),
        "cube, 100,000 Gaussians, 512x512": (cubes.cube(), cubes.camera()),
    }
    for name, (shown, view) in scenes.items():
        for preset in ("exact", "gsplat"):
            images = []
            for dr.rcp, dr.rsqrt in (exactly, (rcp, rsqrt)):
                images.append(drgs.render(shown.detach(), view, drgs.RenderSettings.preset(preset)).rgb)
            off = (images[1] - images[0]).abs()
            print(f"{name}, {preset}: largest {off.max():.1e}, on average {off.mean():.1e}")


if __name__ == "__main__":
    main()
