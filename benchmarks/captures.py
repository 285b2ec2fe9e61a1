"""The races on captures and among free poses of docs/next-views.md and their data files, of rows that are there.

    python benchmarks/captures.py        runs nothing

Rows of captures are benchmarks/captures.jsonl, made by

    drgs reproduce captures --protocol blind --seeds 5 --data office --data lego --data bonsai --data watch \
        --policy uniform --policy farthest --policy fisherrf --policy blur --policy "geometry+backdrop, v_opt" -o OUT

where `bonsai` is every fourth photograph, and `watch` has its cameras by `drgs sfm`. Rows of free poses are
benchmarks/free_poses.jsonl: pools as a robot has them, of rooms that nothing was chosen on, made by

    drgs scene room --free --views 225 --size 160x120 --spp 16 --seed 31 --teacher-size 8x8 -o free31

for seeds 31, 32 and 33, and in the same way with two starts each

    drgs reproduce captures --protocol blind --seeds 2 --data free31 --policy random --policy farthest \
        --policy fisherrf --policy "geometry+backdrop, v_opt" -o OUT

Named before any fit ran: these rooms, starts and policies (`uniform` is by name, which says nothing here, as `random`).
Six starts can tell about 0.6 to 1.0 dB, by how much starts in rooms have differed. Named on 2026-11-29, before they
ran: `coverage` and `moments` on the same starts, for which the default's rows are those of before.

Named before any fit ran: still lifes 41 and 42 with three starts each, with the same policies; halls 43 and 44,
kitchens 45 and 46 with two starts each. Nothing was chosen on them. Still lifes are made and
raced by

    drgs scene still_life --free --views 225 --size 160x120 --spp 16 --seed 41 -o still41
    sed -i /depth_file_path/d still41/transforms.json        fits are by color alone, as in rooms
    drgs reproduce captures --protocol blind --seeds 3 --data still41 --data still42 --policy random \
        --policy farthest --policy fisherrf --policy "geometry+backdrop, v_opt" -o OUT

The protocol of captures takes no data set that moves. There `dynamic` has one of a camera that goes about: 24 initial
(pose, time), then 12 picks among all others, one every 18 steps; by color alone with 1,500 steps, as kitchens of
arcs (benchmarks/kitchen.py; max_steps = 1500 and semantics = "ignore" in fit.toml):

    drgs scene hall --free --cameras 225 --times 14 --size 160x120 --spp 16 --seed 43 --teacher-size 8x8 -o hall43
    drgs reproduce dynamic --protocol blind --seeds 2 --config fit.toml --data hall43 --data hall44 --data kitchen45 \
        --data kitchen46 --policy random --policy farthest --policy fisherrf --policy "joint+backdrop, v_opt" \
        --no-figures -o OUT

Named on 2026-11-29, before they ran: on all of these starts, farthest point sampling of positions and directions
(benchmarks/farthest_poses.py); in the rooms, views of one object with `region` (benchmarks/regions.py). Of halls and
kitchens one start each is run first. Fits of commit 8da4b168 began with the four photographs of the first time; since
f9c1d494 they begin with those of all times (kitchen45 by `random` and `farthest` has 4.5 dB more), so that their rows
have been replaced. Run so far: both starts of halls, one of each kitchen; by `coverage` and `moments` one of each room.

As starts in the rooms have differed (a standard deviation of 0.6 to 1.5 dB of the average over numbers of views, by the
other policy), a paired t test finds 0.8 to 2.1 dB with six starts and 0.7 to 1.7 dB with eight, in 4 of 5 studies; four
starts would find 1.2 to 3.2 dB. Two still lifes say nothing about others, whatever their starts say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pages import fill_between
from studies import PAGE_DATA, ROOT, lead, write_csv

from drgs.studies.rows import read_study
from drgs.studies.statistics import (
    at_views,
    coverage,
    differences,
    estimate,
    over_views,
    unit_of,
    values_of,
    view_counts,
)
from drgs.studies.tables import markdown_table, paragraph

Rows = Sequence[dict[str, Any]]

PAGE = ROOT / "docs" / "next-views.md"
ROWS = ROOT / "benchmarks" / "captures.jsonl"
FREE_ROWS = ROOT / "benchmarks" / "free_poses.jsonl"
POOL_ROWS = ROOT / "benchmarks" / "pools.jsonl"
DEFAULT = "geometry+backdrop, v_opt"
OTHERS = ("farthest", "fisherrf", "uniform")
POOL_OTHERS = ("random", "uniform", "farthest", "fisherrf")
FREE_OTHERS = ("random", "farthest", "farthest, directions", "fisherrf", "coverage", "moments")
FREE_KINDS = {"Rooms": ("free",), "Still lifes": ("still",), "Halls and kitchens": ("hall", "kitchen")}
"""Kind of free poses -> how names of its scenes begin."""
MOVING_DEFAULT = "joint+backdrop, v_opt"
LEFT = "blur"
SHOWN = (10, 20)  # views

OUTSIDE = (
    ("Blender, mean of 8 scenes", 23.32, 24.59, 25.52),
    ("Mip-NeRF 360, mean of its scenes", 17.29, 16.81, 17.95),
)
"""PSNR with 10 views of uniform picks, FisherRF and POp-GS's D-optimality, as these two papers state it."""
ALIKE = {"lego": "Blender's lego at 100x100", "bonsai": "Mip-NeRF 360's bonsai, a quarter of its photographs"}


def compared(rows: Rows, other: str) -> str:
    """The default less another policy: mean and interval."""
    return lead(differences(rows, "psnr", DEFAULT, other), 2)


def section(rows: Rows) -> str:
    """The text and the table of the page."""
    over = [over_views(row, "psnr") for row in rows]
    units = sorted({unit_of(row) for row in rows})
    counts = {scene: sum(unit[0] == scene for unit in units) for scene in dict.fromkeys(row["scene"] for row in rows)}
    each = ", ".join(f"`{scene}` {count}" for scene, count in counts.items())
    whole = [estimate(differences(over, "psnr", DEFAULT, other)) for other in OTHERS]
    left = estimate(differences(over, "psnr", DEFAULT, LEFT), share=0.99)
    detectable = [one.detectable for one in whole if one.detectable is not None]
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    head = (
        f"PSNR of the default less that of others, in dB; first the average over {len(view_counts(rows))} numbers of "
        f"views. {len(rows)} fits by `drgs reproduce captures --protocol blind`, commits {commits} "
        f"([rows](../benchmarks/captures.jsonl), [by fit](data/captures.csv)); starts, named before any fit ran: "
        f"{each}. {coverage(len(counts), len(units)):.0%} of such intervals contain the true mean; "
        f"{min(detectable):.1f} to {max(detectable):.1f} dB were detectable."
    )
    tail = (
        f"`{LEFT}`, least sharp rendering, was dropped {left.mean:.2f} dB behind [{left.low:.2f}, {left.high:.2f}]. "
        "Fits are for `fast` alone; `gsplat` shows those of `watch` 7 to 9 dB worse. POp-GS and FisherRF had other "
        "steps, sizes and scenes ([beside ours](data/captures-outside.csv))."
    )
    return "\n\n".join([paragraph(head), compared_with(rows, OTHERS), paragraph(tail)])


def free_section(rows: Rows) -> str:
    """The text and the tables of free poses: rooms, still lifes, and where things move."""
    parts = []
    for kind, beginnings in FREE_KINDS.items():
        own = [row for row in rows if row["scene"].startswith(beginnings)]
        scenes, commits = (", ".join(sorted({row[key] for row in own})) for key in ("scene", "commit"))
        commits = f"commit{'s' * (',' in commits)} {commits}"
        whole = {unit_of(row) for row in own if row["policy"] in (DEFAULT, MOVING_DEFAULT)}
        head = f"**{kind}** ({scenes}): {len(own)} fits, {len(whole)} starts, {commits}."
        moves = any(row["policy"] == MOVING_DEFAULT for row in own)
        parts += [paragraph(head), moving_table(own) if moves else compared_with(own, FREE_OTHERS)]
    return "\n\n".join(parts)


def moving_table(rows: Rows) -> str:
    """The table of the default less others where things move, after all picks."""
    lines = []
    for other in FREE_OTHERS:
        psnr, moving = (differences(rows, metric, MOVING_DEFAULT, other) for metric in ("psnr", "psnr_moving"))
        if psnr:
            lines.append([f"`{other}`", str(len(psnr)), lead(psnr, 2), lead(moving, 2)])
    return markdown_table(["against", "starts", "PSNR", "moving pixels"], lines)


def pool_section(rows: Rows) -> str:
    """The text and the table of pools as people leave them."""
    pools, commits = (", ".join(sorted({row[key] for row in rows})) for key in ("scene", "commit"))
    head = (
        f"{pools}, named before any fit ran: {len(rows)} fits, {len({unit_of(row) for row in rows})} starts, commits "
        f"{commits} ([rows](../benchmarks/pools.jsonl))."
    )
    return paragraph(head) + "\n\n" + compared_with(rows, POOL_OTHERS)


def compared_with(rows: Rows, others: Sequence[str]) -> str:
    """The table of the default less others, averaged over numbers of views and at `SHOWN` ones."""
    over = [over_views(row, "psnr") for row in rows]
    lines = [
        [f"`{other}`", str(len(differences(over, "psnr", DEFAULT, other))), compared(over, other)]
        + [compared(at_views(rows, count), other) for count in SHOWN]
        for other in others
        if differences(over, "psnr", DEFAULT, other)
    ]
    return markdown_table(["against", "starts", "3 to 20 views", *(f"{count} views" for count in SHOWN)], lines)


def by_fit(rows: Rows) -> Iterator[list[str]]:
    """A line a fit: PSNR at each number of views, and the picks."""
    counts = view_counts(rows)
    yield ["scene", "split", "initial views", "policy", *(f"{count} views" for count in counts), "minutes", "commit"]
    for row in rows:
        psnr = [next((f"{x['metrics']['psnr']:.2f}" for x in at_views([row], count)), "") for count in counts]
        every, offset = row["split"]
        split = f"{every}+{offset}" if every else "of the files"
        initial = " ".join(row["initial"])
        yield [row["scene"], split, initial, row["policy"], *psnr, f"{row['seconds'] / 60:.1f}", row["commit"]]


def beside(rows: Rows) -> Iterator[list[str]]:
    """A line a data set: what papers report with ten views, and what ours have on the scene that is most like it."""
    yield ["data", "uniform", "FisherRF", "POp-GS, D-optimality", "farthest", "drgs"]
    for name, uniform, fisherrf, popgs in OUTSIDE:
        yield [name, f"{uniform:.2f}", f"{fisherrf:.2f}", f"{popgs:.2f}", "", ""]
    for scene, told in ALIKE.items():
        own = at_views([row for row in rows if row["scene"] == scene], 10)
        mean = {}
        for policy in (*OTHERS, DEFAULT):
            found = list(values_of(own, "psnr", policy).values())
            mean[policy] = f"{sum(found) / len(found):.2f}"
        yield [f"{told}, here", mean["uniform"], mean["fisherrf"], "", mean["farthest"], mean[DEFAULT]]


def main() -> None:
    """The program."""
    rows = read_study(ROWS)
    fill_between(PAGE, "captures", section(rows))
    write_csv(PAGE_DATA / "captures.csv", by_fit(rows))
    write_csv(PAGE_DATA / "captures-outside.csv", beside(rows))
    fill_between(PAGE, "free", free_section(read_study(FREE_ROWS)))
    fill_between(PAGE, "pools", pool_section(read_study(POOL_ROWS)))


if __name__ == "__main__":
    main()
