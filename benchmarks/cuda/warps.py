"""How much of a warp idles: iterations of the compositing loop, counted on LLVM and laid out as a card would run them.

    python benchmarks/cuda/warps.py [--print]     benchmarks/cuda/warps.json; two minutes

A warp of 32 lanes goes on until the last of its lanes has finished. A lane of the tile walk in the order of centers
has four pixels, and finishes when its list ends or all four are opaque; in exact order it has one pixel and a row of
its own hits. Counted are, of layouts that a card might run, the slots (lanes times iterations times pixels of a lane),
the share of them in which a pixel was still looking, and the iterations of warps, each of which loads a record. Where a
preset drops the hit that ends a ray (`gsplat`), the entries between the last hit and that one are not counted.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cubes  # noqa: E402
import drjit as dr  # noqa: E402
import numpy as np  # noqa: E402
from exact import scene  # noqa: E402
from where import ran  # noqa: E402

from drgs.settings import RenderSettings  # noqa: E402
from drgs.tracing.bridge import to_drjit  # noqa: E402
from drgs.tracing.call import Call  # noqa: E402

WARP = 32
SCENES = ("cube", "wolf")
PRESETS = ("fast", "gsplat", "exact")
LAYOUTS = {
    "8x8 tiles, 4 pixels a lane": (8, 4, False),
    "the same, lists by length": (8, 4, True),
    "8x8 tiles, 2 pixels a lane": (8, 2, False),
    "8x8 tiles, 1 pixel a lane": (8, 1, False),
    "16x16 tiles, 4 pixels a lane": (16, 4, False),
    "16x16 tiles, 1 pixel a lane": (16, 1, False),
}
ROWS = {"rows of 64 pixels, 1 pixel a lane": False, "the same, pixels by length": True}


def traced(name: str, preset: str) -> dict:
    """What each pixel of a view has done.

    Returns:
        `start`, `end` (tiles,) of the lists, `index` (entries,) of Gaussians, `rank` (N,) of these by depth, `columns`,
        `size` (W, H); `last` (H, W): the place in the list of the hit that ended a pixel, -1 where the list did; in
        exact order `hits` (H, W) of the pixel's row that it has walked along.
    """
    found = (cubes.cube(), cubes.camera()) if name == "cube" else scene(name, ROOT / "runs" / "exact")
    assert found is not None, f"{name}: its files are not there; set DRGS_DATA"
    g, camera = found
    settings = RenderSettings.preset(preset)
    call = Call(g.detach(), camera, settings, frozenset({"count"}))
    compositor, arguments = call.prepare({n: to_drjit(call.lib, x) for n, x in call.inputs.items()})
    with dr.suspend_grad():
        compositor.forward(*arguments, keep=True)
    view = compositor.traversal
    lists = view.lists
    last = np.full(camera.height * camera.width, -1, np.int64)
    hits = np.zeros(camera.height * camera.width, np.int64)
    limit = settings.transmittance_min
    for part, states in compositor.finals[0]:
        for st, at, inside in zip(states, part.flat, part.inside, strict=True):
            ok = np.asarray((inside & (at == at)).numpy()) & np.ones(dr.width(at), bool)
            flat, place = at.numpy()[ok], st["place"].numpy()[ok].astype(np.int64)
            # The state says that a ray has ended by `alive`; where the list ended first, every entry was looked at.
            done = st["alive"].numpy()[ok] == 0
            last[flat] = np.where(done & (place != 0xFFFFFFFF), place, -1)
            hits[flat] = st["count"].numpy()[ok] if "count" in st else 0
    key = view.projected.key.numpy()
    rank = np.empty(len(key), np.int64)
    rank[np.lexsort((np.arange(len(key)), key))] = np.arange(len(key))
    return {
        "start": lists.start.numpy().astype(np.int64),
        "end": lists.end.numpy().astype(np.int64),
        "index": lists.index.numpy(),
        "rank": rank,
        "columns": lists.columns,
        "size": (camera.width, camera.height),
        "last": last.reshape(camera.height, camera.width),
        "hits": hits.reshape(camera.height, camera.width),
        "limit": limit,
    }


def iterations(t: dict, tile: int) -> np.ndarray:
    """(tiles, tile, tile) entries that each pixel looks at along the list of its tile; 0 outside of the image."""
    width, height = t["size"]
    columns, rows = -(-width // tile), -(-height // tile)
    looked = np.zeros((rows * tile, columns * tile), np.int64)
    if tile == 8:
        own = np.arange(height)[:, None] // 8 * t["columns"] + np.arange(width) // 8
        length = (t["end"] - t["start"])[own]
        looked[:height, :width] = np.where(t["last"] >= 0, t["last"] - t["start"][own] + 1, length)
    else:
        # The list of the larger tile is the union of its four, in the order of depths.
        for tile_row in range(rows):
            for tile_column in range(columns):
                fours = [
                    (2 * tile_row + a) * t["columns"] + 2 * tile_column + b
                    for a in (0, 1)
                    for b in (0, 1)
                    if 2 * tile_column + b < t["columns"] and 16 * tile_row + 8 * a < height
                ]
                union = np.unique(np.concatenate([t["rank"][t["index"][t["start"][k] : t["end"][k]]] for k in fours]))
                box = np.s_[16 * tile_row : min(16 * tile_row + 16, height), 16 * tile_column : 16 * tile_column + 16]
                last = t["last"][box]
                at = np.searchsorted(union, t["rank"][t["index"][np.maximum(last, 0)]]) + 1
                block = np.where(last >= 0, at, len(union))
                looked[16 * tile_row : 16 * tile_row + block.shape[0], 16 * tile_column :][:, : block.shape[1]] = block
    blocks = looked.reshape(rows, tile, columns, tile).transpose(0, 2, 1, 3)
    return blocks.reshape(rows * columns, tile, tile)


def lanes(blocks: np.ndarray, share: int) -> np.ndarray:
    """(tiles, lanes) iterations of lanes that have `share` pixels each, 4 apart as in tiles.py."""
    tile = blocks.shape[1]
    # 16 lanes are 4x4 pixels of each of the tile's quarters, or halves, or of one.
    quarters = blocks.reshape(-1, tile // 4, 4, tile // 4, 4).transpose(0, 1, 3, 2, 4).reshape(len(blocks), -1, 16)
    grouped = quarters.reshape(len(blocks), -1, share, 16)
    return grouped.max(2).reshape(len(blocks), -1)


def slots(own: np.ndarray, share: int, sort: bool) -> tuple[int, int]:
    """(slots, warps' iterations) of lanes (tiles, lanes), tiles in their order or by their longest lane."""
    if sort:
        own = own[np.argsort(-own.max(1), kind="stable")]
    flat = own.reshape(-1)
    flat = np.concatenate([flat, np.zeros(-len(flat) % WARP, np.int64)])
    turns = flat.reshape(-1, WARP).max(1).sum()
    return int(turns) * WARP * share, int(turns)


def measured(name: str, preset: str) -> dict[str, dict]:
    """Layout -> slots, share of them in which a pixel was looking, and iterations of warps."""
    t = traced(name, preset)
    made = {}
    if preset == "exact":
        width, height = t["size"]
        padded = np.zeros((-(-height // 8) * 8, -(-width // 8) * 8), np.int64)
        padded[:height, :width] = t["hits"]
        blocks = padded.reshape(padded.shape[0] // 8, 8, -1, 8).transpose(0, 2, 1, 3).reshape(-1, 8, 8)
        useful = int(t["hits"].sum())
        for layout, sort in ROWS.items():
            own = lanes(blocks, 1)
            if sort:
                own = -np.sort(-own.reshape(-1))[None]
            total, turns = slots(own, 1, False)
            made[layout] = {"slots": total, "busy": useful / total, "turns": turns}
        return made
    looked = {tile: iterations(t, tile) for tile in (8, 16)}
    for layout, (tile, share, sort) in LAYOUTS.items():
        total, turns = slots(lanes(looked[tile], share), share, sort)
        made[layout] = {"slots": total, "busy": int(looked[tile].sum()) / total, "turns": turns}
    return made


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--print", action="store_true", help="write nothing")
    args = parser.parse_args()
    found = {f"{name}, {preset}": measured(name, preset) for name in SCENES for preset in PRESETS}
    for case, layouts in found.items():
        first = next(iter(layouts.values()))
        for layout, x in layouts.items():
            slots, loads = (x[key] / first[key] for key in ("slots", "turns"))
            print(f"{case}, {layout}: {slots:.2f}x slots, {x['busy']:.0%} of them busy, {loads:.2f}x loads")
    if not args.print:
        (HERE / "warps.json").write_text(json.dumps({"ran": ran(), "found": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
