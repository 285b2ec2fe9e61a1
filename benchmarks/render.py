"""How fast the renderer is, against Mitsuba's `volprim_rf_basic` on the same work.

    python benchmarks/render.py [--quick]     a part of docs/benchmarks.md, benchmarks/render.json
    python benchmarks/render.py --page        that part, of the results that there are

Everything a frame needs is inside the clock (projection, lists, sorting, shading, torch bridge). Peers take turns in
one process, every figure is the median of at least five turns after a warm-up, and what counts are the ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from clocks import interleaved  # noqa: E402
from pages import fill_between  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs import runtime  # noqa: E402
from drgs.ellipsoids import semi_axes  # noqa: E402
from drgs.runtime.machine import peak_memory  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402

PAGE = ROOT / "docs" / "benchmarks.md"
Preset = drgs.RenderSettings.preset


def forward(gaussians, camera, settings, outputs=()):
    """A frame without gradients."""

    def run():
        with torch.no_grad():
            return drgs.render(gaussians, camera, settings, outputs=outputs)

    return run


def backward(gaussians, camera, settings):
    """A frame and the gradients of its sum with respect to every parameter."""
    leaves = {k: v.clone().requires_grad_() for k, v in gaussians.parameters().items()}
    moving = gaussians.replace(**leaves)

    def run():
        drgs.render(moving, camera, settings, outputs=()).rgb.sum().backward()
        for leaf in leaves.values():
            leaf.grad = None

    return run


def volprim(gaussians, camera, differentiate: bool, **shape):
    """`volprim_rf_basic` as shipped, without its sRGB step (whose gradient is wrong) and with unlimited depth.

    Args:
        shape: Properties of the shape, beside or instead of what `ellipsoids_shape` says.
    """
    mi = runtime.mitsuba()
    import drjit as dr

    from drgs.ellipsoids import ellipsoids_shape

    sensor = camera.to_mitsuba()
    sensor["sampler"] = {"type": "independent", "sample_count": 1}
    integrator = {"type": "volprim_rf_basic", "max_depth": -1, "srgb_primitives": False}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor,
            "integrator": integrator,
            "gaussians": {**ellipsoids_shape(gaussians), **shape},
        }
    )
    params = mi.traverse(scene)
    keys = ["gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs"]
    if differentiate:
        for key in keys:
            dr.enable_grad(params[key])
    seed = iter(range(1, 10**9))

    def run():
        if differentiate:
            image = mi.render(scene, params=params, spp=1, seed=next(seed))
            dr.backward(dr.sum(image.array))
            dr.eval([dr.grad(params[key]) for key in keys])
            for key in keys:
                dr.clear_grad(params[key])
        else:
            dr.eval(mi.render(scene, spp=1, seed=next(seed)))
        dr.sync_thread()

    return run


def headline(turns: int) -> dict:
    """The cube scene against volprim_rf_basic."""
    g, cam = cubes.cube(), cubes.camera()
    fast, exact = Preset("fast"), Preset("exact")
    return interleaved(
        {
            "volprim forward": volprim(g, cam, False),
            "volprim forward+backward": volprim(g, cam, True),
            "fast forward": forward(g, cam, fast),
            "fast forward+backward": backward(g, cam, fast),
            "fast, order ray, forward": forward(g, cam, fast.replace(order="ray")),
            "fast, order ray, forward+backward": backward(g, cam, fast.replace(order="ray")),
            "exact forward": forward(g, cam, exact),
            "exact forward+backward": backward(g, cam, exact),
            "gsplat forward": forward(g, cam, Preset("gsplat")),
            "gsplat forward+backward": backward(g, cam, Preset("gsplat")),
            "mitsuba (bvh, entry) forward": forward(g, cam, Preset("mitsuba")),
            "fast on bvh, order ray, forward": forward(g, cam, fast.replace(order="ray", traversal="bvh")),
        },
        turns,
        warm=True,
    )


def volprim_hits(gaussians, camera) -> int:
    """Distinct true (ray, Gaussian) hits that volprim_rf_basic's traversal meets: its own loop, writing them down."""
    mi = runtime.mitsuba()
    import drjit as dr

    from drgs.ellipsoids import ellipsoids_shape

    scene = mi.load_dict({"type": "scene", "gaussians": ellipsoids_shape(gaussians)})
    d = np.asarray(camera.pixel_directions(), np.float32).reshape(-1, 3)
    direction = mi.Vector3f(*[mi.Float(np.ascontiguousarray(d[:, k])) for k in range(3)])
    origin = mi.Point3f(*[mi.Float(np.full(len(d), v, np.float32)) for v in camera.center])
    mean = mi.Float(gaussians.means.numpy().ravel())
    capacity = 400 * len(d)
    used = mi.UInt32(0)
    pairs = dr.zeros(mi.UInt64, capacity)
    lane = dr.arange(mi.UInt32, len(d))

    def body(o, go):
        si = scene.ray_intersect(mi.Ray3f(o, direction), ray_flags=mi.RayFlags.All, coherent=False, active=go != 0)
        ok = (go != 0) & si.is_valid()
        # A hit counts when the ray really passes within three standard deviations.
        true = ok & _within(dr, mi, si.prim_index, origin, direction, ok)
        slot = dr.scatter_inc(used, mi.UInt32(0), true)
        dr.scatter(
            pairs, (mi.UInt64(lane) << 32) | mi.UInt64(si.prim_index) | (1 << 63), slot, true & (slot < capacity)
        )
        return dr.select(ok, si.p + direction * 1e-4, o), dr.select(ok, mi.UInt32(1), 0)

    local = semi_axes(gaussians.quats.double(), 1 / gaussians.scales.double()).mT.reshape(-1).float().numpy()
    matrix = mi.Float(np.ascontiguousarray(local))

    def _within(dr, mi, index, o, d, active):
        m = [dr.gather(mi.Float, matrix, index * 9 + k, active) for k in range(9)]
        to = [o[k] - dr.gather(mi.Float, mean, index * 3 + k, active) for k in range(3)]
        a = mi.Vector3f(*[m[3 * r] * to[0] + m[3 * r + 1] * to[1] + m[3 * r + 2] * to[2] for r in range(3)])
        b = mi.Vector3f(*[m[3 * r] * d[0] + m[3 * r + 1] * d[1] + m[3 * r + 2] * d[2] for r in range(3)])
        return dr.squared_norm(dr.cross(a, b)) <= 9 * dr.squared_norm(b)

    with dr.suspend_grad():
        dr.eval(dr.while_loop((origin, dr.full(mi.UInt32, 1, len(d))), lambda o, go: go != 0, body), used, pairs)
    met = np.unique(pairs.numpy()[: int(used[0])])
    return int((met > 0).sum())


def hits() -> dict:
    """Share of the true hits that each traversal finds, and what one of them costs."""
    g = cubes.cube()
    cam = cubes.camera(256)
    all_hits = Preset("fast").replace(transmittance_min=0.0)
    on_bvh = all_hits.replace(traversal="bvh", order="entry")
    true = int(drgs.render(g, cam, all_hits, outputs=("count",)).count.sum())
    # In exact order the two traversals draw the same picture where they met the same Gaussians.
    a, b = (
        drgs.render(g, cam, all_hits.replace(order="ray", traversal=x), outputs=("count",)) for x in ("tiles", "bvh")
    )
    found = int(torch.minimum(a.count, b.count).sum())
    same = float(((a.rgb - b.rgb).abs().amax(-1) < 1e-4).float().mean())
    theirs = volprim_hits(g, cam)
    transparent = g.replace(logit_opacities=torch.full((len(g),), -14.0))  # their loop stops at T = 0.01
    seconds = interleaved({"ours": forward(transparent, cam, on_bvh), "theirs": volprim(transparent, cam, False)}, 5)
    return {
        "true hits": true,
        "rays equal on both traversals": same,
        "bvh finds": found / true,
        "volprim finds": theirs / true,
        "bvh ns per true hit": 1e9 * seconds["ours"] / found,
        "volprim ns per true hit": 1e9 * seconds["theirs"] / theirs,
    }


def peak_flops() -> float:
    """float32 operations a second of fused multiply-adds in registers: what a Dr.Jit kernel can reach here."""
    import drjit as dr

    t = runtime.dr_types()
    rounds = 20_000
    start = [dr.opaque(t.Float, 1.0 + k, 1 << 16) for k in range(8)]

    def body(i, x):
        return i + 1, [dr.fma(v, 0.999, 0.001) for v in x]

    def once():
        state = dr.while_loop((t.UInt32(0), [t.Float(v) for v in start]), lambda i, x: i < rounds // 8, body)
        dr.eval(state)
        dr.sync_thread()

    seconds = interleaved({"peak": once}, 3)["peak"]
    return 2.0 * 8 * (rounds // 8) * (1 << 16) / seconds


def rates(seconds: float) -> dict:
    """Hits a second of `fast` forward on the cube scene, and its share of the machine's float32 peak."""
    g, cam = cubes.cube(), cubes.camera()
    out = drgs.render(g, cam, Preset("fast"), outputs=("count",))
    # Every entry of a tile's list is tested on 64 pixels until the tile is opaque: an upper bound of the tests. One
    # test is about 62 operations (kernels.py: 31 for rho^2 and t*, 19 for exp, 12 for compositing).
    tests = 64.0 * out.certificate["pairs"]
    peak = peak_flops()
    return {
        "hits per second": float(out.count.sum()) / seconds,
        "tests per second at most": tests / seconds,
        "peak Gflop/s": peak / 1e9,
        "share of peak at most": 62 * tests / seconds / peak,
    }


def growth(counts, sizes, turns: int) -> list[dict]:
    """Seconds of `fast` over the number of Gaussians (512 x 512) and of pixels (100,000 Gaussians)."""
    rows = []
    for count, size in [(n, 512) for n in counts] + [(100_000, s) for s in sizes if s != 512]:
        g, cam = cubes.cube(count), cubes.camera(size)
        pairs = drgs.render(g, cam, Preset("fast"), outputs=()).certificate["pairs"]
        t = interleaved({"f": forward(g, cam, Preset("fast")), "b": backward(g, cam, Preset("fast"))}, turns)
        rows.append({"gaussians": count, "size": size, "pairs": pairs, "forward": t["f"], "forward+backward": t["b"]})
        print(rows[-1], flush=True)
    return rows


def child(task: str, cache: str | None = None) -> dict:
    """Run a task of this script in a fresh process."""
    env = dict(os.environ, **({"DRJIT_CACHE_DIR": cache} if cache else {}))
    out = subprocess.run(
        [sys.executable, __file__, "--task", task], env=env, capture_output=True, text=True, check=True
    )
    return json.loads(out.stdout.strip().splitlines()[-1])


def task_memory() -> dict:
    """Peak memory of one frame forward and backward, 1,000,000 Gaussians at 1024 x 1024."""
    g, cam = cubes.cube(1_000_000), cubes.camera(1024)
    start = time.perf_counter()
    backward(g, cam, Preset("fast"))()
    return {
        "peak GB": (peak_memory() or 0) / 1e9,
        "seconds with compilation": time.perf_counter() - start,
    }


def task_first() -> dict:
    """First frame of a process minus a warm one: tracing and compilation."""
    g, cam = cubes.cube(1000), cubes.camera(64)
    run = backward(g, cam, Preset("fast"))
    times = []
    for _ in range(4):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return {"first": times[0], "warm": min(times[1:])}


def headline_rows(h: dict) -> list[list[str]]:
    """A row a renderer: milliseconds of both kinds of frames, and how many times faster than `volprim_rf_basic`."""
    kinds = ("forward", "forward+backward")
    names = dict.fromkeys(re.sub(r",? forward(\+backward)?$", "", name) for name in h)
    lines = []
    for name in names:
        found = [next((h[key] for key in (f"{name} {kind}", f"{name}, {kind}") if key in h), None) for kind in kinds]
        base = [h[f"volprim {kind}"] for kind in kinds]
        times = [f"{1e3 * t:.0f} ({b / t:.1f}x)" if t else "" for t, b in zip(found, base, strict=True)]
        lines.append([name, *times])
    return lines


def report(result: dict) -> str:
    """The part of the page."""
    parts = [
        paragraph(
            f"`python benchmarks/render.py`, {result['machine']}, {result['date']}, commit {result['commit']}: "
            "milliseconds, in brackets how many times faster than Mitsuba's `volprim_rf_basic`, whose cut-offs `fast` "
            "has. 100,000 Gaussians in [-1, 1]^3, median standard deviation 0.01, seen from distance 4 at 45 degrees, "
            "512x512, one ray a pixel."
        ),
        markdown_table(["", "forward", "forward + backward"], headline_rows(result["headline"])),
    ]
    if "rates" in result:
        r = result["rates"]
        parts.append(
            paragraph(
                f"`fast` forward composites {r['hits per second'] / 1e6:.0f} million hits a second, at most "
                f"{100 * r['share of peak at most']:.0f} % of the peak of a Dr.Jit kernel here."
            )
        )
    if "hits" in result:
        x = result["hits"]
        parts.append(
            paragraph(
                f"Of {x['true hits']:,} true hits (within 3 sigma, counted by `tiles`) `bvh` finds "
                f"{100 * x['bvh finds']:.2f} %, `volprim_rf_basic` {100 * x['volprim finds']:.2f} %, in "
                f"{x['bvh ns per true hit']:.0f} and {x['volprim ns per true hit']:.0f} ns each; "
                "`volprim_rf_basic` misses a lone Gaussian of this size on 40 % of its rays."
            )
        )
    growth = "; ".join(
        f"{1e3 * r['forward']:.0f} and {1e3 * r['forward+backward']:.0f} ms for {r['gaussians']:,} at {r['size']}^2"
        for r in result["growth"]
        if r["size"] == 1024 or (r["size"] == 512 and r["gaussians"] != 10_000)  # the others are in render.json
    )
    parts += [
        paragraph(f"**Growth**, `fast`, forward and forward + backward: {growth}."),
        paragraph(
            "**Memory**: 1,000,000 Gaussians at 1024x1024, forward + backward, take "
            f"{result['memory']['peak GB']:.2f} GB, torch included. **Compilation**: the first image forward + "
            f"backward takes {result['first']['first']:.2f} s with nothing cached, {result['second']['first']:.2f} s "
            "in a second process."
        ),
    ]
    return "\n\n".join(parts)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="small and few: checks that the script runs")
    parser.add_argument("--page", action="store_true", help="the page of the results that there are")
    parser.add_argument("--task", choices=("memory", "first"))
    args = parser.parse_args()
    store = ROOT / "benchmarks" / "render.json"
    if args.page:
        fill_between(PAGE, "render", report(json.loads(store.read_text())))
        return
    if args.task:
        print(json.dumps({"memory": task_memory, "first": task_first}[args.task]()))
        return
    result = ran()
    with tempfile.TemporaryDirectory() as cache:
        result["first"] = child("first", cache)
        result["second"] = child("first", cache)
    result["memory"] = child("memory")
    turns = 2 if args.quick else 7
    result["headline"] = headline(turns)
    print(json.dumps(result, indent=1), flush=True)
    result["rates"] = rates(result["headline"]["fast forward"])
    result["hits"] = hits()
    counts = (1000, 10_000) if args.quick else (1000, 10_000, 100_000, 1_000_000, 3_000_000)
    result["growth"] = growth(counts, () if args.quick else (64, 128, 256, 512, 1024), 2 if args.quick else 5)
    text = report(result)
    print(text)
    if not args.quick:
        fill_between(PAGE, "render", text)
        store.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
