"""A pick among 80 candidates by 1, 2 and 5 worker processes: seconds, bytes, and whether the bits are the same.

    python benchmarks/cluster.py [--candidates 80] [--gaussians 4000] [--counts 1 2 5] [--print]

Writes benchmarks/cluster.json, docs/data/cluster.csv and the paragraph of docs/many-machines.md.

Run it with DRGS_THREADS=1, so that the process without workers computes as one worker does, on a machine that does
little else: the load beside each row says whether it did. The same pick is made once before it is timed, in each
process, so that kernels are compiled and loaded.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import ran  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera, intrinsics_from_fov, look_at  # noqa: E402
from drgs.cluster.connect import opened  # noqa: E402
from drgs.cluster.payloads import Payload  # noqa: E402
from drgs.io.outputs import write_json  # noqa: E402
from drgs.select import Selection, select  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

KNOWN = 4
SIZE = 160, 120
TOLD = {"settings": drgs.RenderSettings.preset("fast"), "criterion": "v_opt"}


def scene(count: int) -> drgs.Gaussians:
    """Gaussians on the faces of a few boxes on a table, harmonics of degree 3."""
    rng = np.random.default_rng(5)
    boxes = np.concatenate([rng.uniform(-0.8, 0.8, (9, 2)), rng.uniform(0.1, 0.4, (9, 3))], axis=1)
    box = boxes[rng.integers(len(boxes), size=count)]
    places = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(3, size=count)
    places[np.arange(count), face] = np.sign(places[np.arange(count), face])
    means = np.stack([box[:, 0] + places[:, 0] * box[:, 2], box[:, 1] + places[:, 1] * box[:, 3]], 1)
    means = np.concatenate([means, (box[:, 4] * (1 + places[:, 2]))[:, None]], 1)
    table = rng.random(count) < 0.3
    means[table] = np.concatenate([rng.uniform(-1.2, 1.2, (int(table.sum()), 2)), np.zeros((int(table.sum()), 1))], 1)
    return drgs.Gaussians.from_arrays(
        means.astype(np.float32),
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(-3.6, 0.4, (count, 3))),
        rng.uniform(0.3, 0.95, count),
        rng.normal(0, 0.3, (count, 16, 3)),
    )


def ring(count: int) -> list[Camera]:
    """Cameras on a dome around the table, in rings of different heights."""
    K = intrinsics_from_fov(50.0, *SIZE)
    found = []
    for i in range(count):
        angle = 2.399963 * i  # the golden angle
        height = 0.25 + 1.0 * (i + 0.5) / count
        across = np.sqrt(max(2.6**2 - (2 * height) ** 2, 0.2))
        eye = (across * np.cos(angle), across * np.sin(angle), 2 * height)
        w2c = look_at(eye, (0.0, 0.0, 0.2), (0.0, 0.0, 1.0))
        found.append(Camera(K=K, w2c=w2c, width=SIZE[0], height=SIZE[1], name=f"dome_{i:03d}"))
    return found


def bits(selection: Selection) -> str:
    """Everything of it but the seconds, floats as they are."""
    return json.dumps({**dataclasses.asdict(selection), "seconds": None}, sort_keys=True)


def bandwidth(cluster) -> float:
    """Bytes a second of 32 MB to every worker, without opening them there."""
    payload = np.random.default_rng(0).integers(0, 255, 32 << 20, np.uint8)
    before = cluster.sent_seconds
    cluster.send(payload)
    seconds = cluster.sent_seconds - before
    cluster.forget()
    return len(payload) * len(cluster.workers()) / seconds


def measured(arguments: argparse.Namespace) -> dict:
    """Rows for each number of workers, the first one for none."""
    g = scene(arguments.gaussians)
    cameras = ring(arguments.candidates + KNOWN)
    known = cameras[:: len(cameras) // KNOWN][:KNOWN]
    candidates = [camera for camera in cameras if all(camera is not other for other in known)]
    rows = []
    reference = None
    for count in (0, *arguments.counts):
        load = os.getloadavg()[0]
        began = time.perf_counter()
        with opened(workers=count or None) as cluster:
            row = {"workers": count, "load": load, "start_seconds": time.perf_counter() - began}
            began = time.perf_counter()
            select(g, candidates[: 2 * max(count, 1)], known, workers=cluster, **TOLD)
            row["first_seconds"] = time.perf_counter() - began
            if cluster:
                cluster.view_seconds.clear()
                cluster.views.clear()
                cluster.cpu_seconds = 0.0
                sent = cluster.sent_bytes
                took = cluster.sent_seconds
                back = cluster.received_bytes
            fresh = g.replace(means=g.means + 0)  # the same values in the same bytes, which workers have already
            began, cpu = time.perf_counter(), time.process_time()
            found = select(fresh, candidates, known, workers=cluster, **TOLD)
            row |= {"seconds": time.perf_counter() - began, "own_cpu_seconds": time.process_time() - cpu}
            row["views"] = len(candidates) + len(known)
            if cluster:
                answers = len(cluster.view_seconds)
                row |= {
                    "answers": answers,
                    "worker_seconds": sum(cluster.view_seconds),
                    "worker_cpu_seconds": cluster.cpu_seconds,
                    "by_worker": sorted(cluster.views.values()),
                    "received_bytes": cluster.received_bytes - back,
                    "sent_bytes": cluster.sent_bytes - sent,
                    "sent_seconds": cluster.sent_seconds - took,
                    "bandwidth": bandwidth(cluster),
                }
        reference = reference or bits(found)
        row["same_bits"] = bits(found) == reference
        rows.append(row)
        print(json.dumps(row), flush=True)
    return {
        "ran": ran(),
        "gaussians": arguments.gaussians,
        "candidates": len(candidates),
        "known": len(known),
        "size": SIZE,
        "scene_bytes": len(Payload.of(g).data),
        "rows": rows,
    }


def sheet(r: dict) -> list[list[str]]:
    """The data file: a line for each number of workers; the first is of none."""
    heads = ["workers", "load_before", "start_s", "pick_s", "view_on_worker_s", "view_on_worker_cpu_s"]
    lines = [[*heads, "own_cpu_a_view_s", "kilobytes_a_view", "same_bits"]]
    for row in r["rows"]:
        views = row["views"]
        of_workers = ("worker_seconds", "worker_cpu_seconds")
        each = [f"{row[key] / views:.3f}" if row["workers"] else "" for key in of_workers]
        back = f"{row['received_bytes'] / views / 1e3:.0f}" if row["workers"] else ""
        seconds = [f"{row[key]:.1f}" for key in ("load", "start_seconds", "seconds")]
        own = f"{row['own_cpu_seconds'] / views:.4f}"
        lines.append([str(row["workers"]), *seconds, *each, own, back, "yes" if row["same_bits"] else "no"])
    return lines


def report(r: dict) -> str:
    """The paragraph of the page."""
    where, (alone, *others) = r["ran"], r["rows"]
    seconds = ", ".join(f"{row['seconds']:.1f} s with {row['workers']}" for row in others)
    same = all(row["same_bits"] for row in others)
    return paragraph(
        f"A pick among {r['candidates']} candidates, {r['size'][0]}x{r['size'][1]}, of {r['gaussians']:,} Gaussians "
        f"takes {alone['seconds']:.1f} s without workers, {seconds}, with {'the same' if same else '**other**'} bits "
        f"([all numbers](data/cluster.csv); `python benchmarks/cluster.py`, {where['machine']}, {where['date']})."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--candidates", type=int, default=80)
    parser.add_argument("--gaussians", type=int, default=4000)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 5])
    parser.add_argument("--print", action="store_true", help="only write what was measured before")
    arguments = parser.parse_args()
    path = ROOT / "benchmarks" / "cluster.json"
    if not arguments.print:
        write_json(path, measured(arguments))
    text = report(json.loads(path.read_text()))
    fill_between(ROOT / "docs" / "many-machines.md", "cluster", text)
    write_csv(PAGE_DATA / "cluster.csv", sheet(json.loads(path.read_text())))
    print(text)


if __name__ == "__main__":
    main()
