"""Memory, launches and waits of frames that nobody has run on a card, and a prediction of their time.

    python benchmarks/cuda/frames.py [--folder FOLDER]

Each frame of `cases.FRAMES` is driven in a process of its own, whose memory is counted by the driver without a card
(libcuda.c). What is predicted are a frame and its gradient of the cube of 100,000 Gaussians at 512x512, from
instructions (PTX lines of Dr.Jit's kernels times how often warps run them, counted on LLVM) and from bytes that must be
moved. Each part takes the longest of three times: that of all instructions, of those in float64, and of the bytes.
With --folder what was driven before is not driven again.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(HERE)]

import kernels  # noqa: E402

WARP = 32
RECORD = 96  # bytes
KEY = 192  # bytes that Dr.Jit's sort of a 64-bit key moves: 8 passes that read twice and write once
HIT = 652
"""Bytes that `rows._sort_at_once` moves for a hit, if `torch.sort` sorts 8 bits a pass, of float64 words and int32 rows
with int64 places, and a number that is fetched from anywhere costs a sector of 32 bytes.
"""
SLOT = 11  # and for each place of a row, to find the hits


class Card(NamedTuple):
    """Warps' instructions a second, how many of them one in float64 takes, and bytes a second."""

    issued: float
    wide: float
    bandwidth: float


CARDS = {
    "H100": Card(132 * 4 * 1.7e9, 2, 3.35e12),
    "RTX 4090": Card(128 * 4 * 2.5e9, 64, 1.0e12),
}


class Work(NamedTuple):
    """Warps' instructions, those of them in float64, and bytes."""

    instructions: float = 0
    wide: float = 0
    moved: float = 0

    def seconds(self, card: Card) -> float:
        """The longest of the three times."""
        return max(self.instructions / card.issued, self.wide * card.wide / card.issued, self.moved / card.bandwidth)


def lines(text: list[str]) -> tuple[int, int]:
    """Instructions among lines of PTX, and those in float64."""
    own = [x.strip() for x in text if x.strip().endswith(";") and not x.strip().startswith(".")]
    return len(own), sum(".f64" in x for x in own)


def parts(folder: Path) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Of a frame's kernels, in their order: bodies of loops and kernels without one, of more than 100 and 400 lines."""
    loops, straight = [], []
    for path in sorted((folder / "modules").glob("*.ptx")):
        text = path.read_text()
        if not kernels.is_own(text):
            continue
        body = text.splitlines()
        at = {m[1]: i for i, x in enumerate(body) if (m := re.match(r"\s*([\w$]+):", x))}
        back = [(at[m[1]], i) for i, x in enumerate(body) if (m := re.search(r"\bbra\S*\s+([\w$]+)", x)) and m[1] in at]
        found = [lines(body[first : last + 1]) for first, last in back if first < last]
        if not found and lines(body)[0] > 400:
            straight.append(lines(body))
        loops += [x for x in found if x[0] > 100]
    return loops, straight


def counted(preset: str) -> dict:
    """Of the cube at 512x512: Gaussians, sorted keys, entries of lists, and iterations of warps along them; in exact
    order places of rows, hits, those that rays walk along, and iterations of warps along these.
    """
    import cubes
    import drjit as dr
    import numpy as np

    from drgs.settings import RenderSettings
    from drgs.tracing import rows, tiles
    from drgs.tracing.bridge import to_drjit
    from drgs.tracing.call import Call

    found = {"gaussians": 100_000, "keys": 0, "slots": 0, "hits": 0}
    sort, ascending = rows._sort, tiles.ascending

    def noted(words, lengths, counts) -> None:  # type: ignore[no-untyped-def]
        found["slots"] += words.numel()
        found["hits"] += int(counts.long().sum())
        sort(words, lengths, counts)

    def keyed(lib, keys):  # type: ignore[no-untyped-def]
        found["keys"] += dr.width(keys)
        return ascending(lib, keys)

    rows._sort, tiles.ascending = noted, keyed
    call = Call(cubes.cube().detach(), cubes.camera(), RenderSettings.preset(preset), frozenset({"count"}))
    compositor, arguments = call.prepare({n: to_drjit(call.lib, x) for n, x in call.inputs.items()})
    with dr.suspend_grad():
        compositor.forward(*arguments, keep=True)
    rows._sort, tiles.ascending = sort, ascending
    lists = compositor.traversal.lists
    # A warp has two tiles, four pixels a lane, and goes on to the end of the longer list.
    lengths = (lists.end.numpy().astype(np.int64) - lists.start.numpy()).reshape(-1, 2)
    warps = json.loads((HERE / "warps.json").read_text())["found"][f"cube, {preset}"]
    walk = next(iter(warps.values()))
    found |= {"entries": int(lengths.sum()), "along lists": int(lengths.max(1).sum()), "walked": walk["turns"]}
    return found | {"passed": round(walk["slots"] * walk["busy"])}


def works(preset: str, n: dict, loops: list[tuple[int, int]], straight: list[tuple[int, int]]) -> dict[str, Work]:
    """What each part of a frame and its gradient does.

    Args:
        n: `counted`.
        loops, straight: `parts`: the last ones are the backward pass.
    """
    warps = n["gaussians"] / WARP

    def along(body: tuple[int, int], turns: float, moved: float = 0) -> Work:
        return Work(body[0] * turns, body[1] * turns, moved)

    ahead, back = straight[:-1], straight[-1]
    own = [sum(x[k] for x in ahead) for k in (0, 1)]
    each = 2 * RECORD + 4 * 59  # what a Gaussian is described by, and its record
    made = {
        "projection": along((own[0], own[1]), warps, n["gaussians"] * each),
        "projection, backward": along(back, warps, n["gaussians"] * 2 * each),
        "lists": along(loops[0], n["keys"] / WARP, KEY * n["keys"]),
    }
    if preset != "exact":
        _, forward, backward = loops
        read = 2 * RECORD * n["walked"]  # of the two tiles of a warp
        return made | {
            "compositing": along(forward, n["walked"], read),
            "compositing, backward": along(backward, n["walked"], 2 * read),
        }
    backward = max(loops)
    find, forward, fill = loops[1], loops[2], loops[loops.index(backward) - 1]
    apart = RECORD * n["passed"]  # each lane is at a Gaussian of its own
    return made | {
        "finding hits": along(find, n["along lists"], 16 * n["slots"]),
        "sorting hits": Work(moved=HIT * n["hits"] + SLOT * n["slots"]),
        "compositing": along(forward, n["walked"], apart),
        "table for the backward pass": along(fill, n["walked"], apart + 32 * n["passed"] + 8 * n["slots"]),
        "compositing, backward": along(backward, n["along lists"], 8 * n["slots"]),
    }


def predicted(made: dict[str, dict[str, Work]]) -> list[str]:
    """Markdown: milliseconds of each part, by preset and card."""
    named = [f"`{preset}`, {card}" for preset in made for card in CARDS]
    table = ["| part, ms | " + " | ".join(named) + " |", "|---|" + "---|" * len(named)]
    order = list(dict.fromkeys(part for own in made.values() for part in own))
    order.sort(key=lambda part: list(made["exact"]).index(part))
    for part in [*order, "sum"]:
        cells = []
        for own in made.values():
            chosen = own.values() if part == "sum" else [own[part]] if part in own else []
            cells += [f"{1e3 * sum(x.seconds(c) for x in chosen):.2f}" if chosen else "" for c in CARDS.values()]
        table.append(f"| {part} | " + " | ".join(cells) + " |")
    return table


def memory(frames: dict[str, dict]) -> list[str]:
    """Launches, waits and Dr.Jit's peak of memory of the steps of several sizes, a line each."""
    made = []
    for name, found in frames.items():
        waits = found["synchronizations"] + found["torch_waits"]
        made.append(f"{name}: {found['launches']} launches, {waits} waits, {found['peak_bytes'] / 1e9:.2f} GB")
    return made


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, help="what was driven before, and will be")
    args = parser.parse_args()
    if lacks := kernels.missing():
        print(f"frames.py: {lacks}", file=sys.stderr)
        return 2
    from cases import FRAMES
    from where import ran

    from drgs.studies.tables import fill_between

    frames, made, counts = {}, {}, {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        for name in (x for x in FRAMES if x.count(",") == 3):
            own = folder / re.sub("[ ,]", "_", name)
            told = own / "cases.json"
            frames |= json.loads(told.read_text()) if told.exists() else kernels.driven(own, [name], optix=False)
        for preset in ("fast", "exact"):
            counts[preset] = counted(preset)
            made[preset] = works(preset, counts[preset], *parts(folder / f"step__{preset}__100000__960x540"))
    table = predicted(made)
    print("\n".join([*memory(frames), *table]))
    fill_between(ROOT / "docs" / "cuda.md", "predicted", "\n".join(table))
    told = {name: {k: v for k, v in found.items() if k != "modules"} for name, found in frames.items()}
    works_of = {preset: {part: x._asdict() for part, x in own.items()} for preset, own in made.items()}
    data = {"ran": ran(), "frames": told, "counted": counts, "work": works_of}
    (HERE / "frames.json").write_text(json.dumps(data, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
