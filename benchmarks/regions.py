"""Do views that are chosen for one object show it better? From two photographs to twelve, with `--region` and without.

    python benchmarks/regions.py [--scenes room51 statue ...] [--starts 2] [--runs runs/regions] [--page]

Units, policies, sizes and what is compared are on docs/active-region.md, and were there before any fit ran; so were,
on 2026-11-29, free31, free32 and free33 with two starts: free poses, of which 1 to 6 held-out ones show an object.
Appends a row a fit to benchmarks/regions.jsonl as it ends, leaves out what is there; with --page it writes tables,
picture and data of that page. A fit that fails is a row with its error. One thread; captures are in $DRGS_DATA.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from pages import draw_curves, fill_between  # noqa: E402
from studies import PAGE_DATA, lead, write_csv  # noqa: E402
from where import DATA, add_row, ran, read_rows  # noqa: E402

from drgs import scenes  # noqa: E402
from drgs.cameras import Camera  # noqa: E402
from drgs.data import Dataset, View, load  # noqa: E402
from drgs.data.semantics import plain_labels  # noqa: E402
from drgs.display.progress import Bar  # noqa: E402
from drgs.fitting.active import ActiveViews  # noqa: E402
from drgs.fitting.components.base import Component, Fit, Setup  # noqa: E402
from drgs.fitting.components.table import COMPONENTS  # noqa: E402
from drgs.fitting.config import FitConfig, SelectionConfig  # noqa: E402
from drgs.fitting.frames import Frame, frames_for, load_dataset  # noqa: E402
from drgs.fitting.losses import psnr  # noqa: E402
from drgs.information.region import RegionText  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.scenes import labelled, room  # noqa: E402
from drgs.scenes.output import write_png  # noqa: E402
from drgs.selection.pool import Pool, Selection  # noqa: E402
from drgs.selection.spread import farthest  # noqa: E402
from drgs.studies.cells import FAILURES, Metric  # noqa: E402
from drgs.studies.cells import Study as StudyOfFits  # noqa: E402
from drgs.studies.statistics import FEWEST_UNITS, at_views, coverage, differences, estimate, over_views  # noqa: E402
from drgs.studies.tables import markdown_table, paragraph  # noqa: E402
from drgs.train import fit  # noqa: E402

ROWS = ROOT / "benchmarks" / "regions.jsonl"
COUNTS = (2, 3, 4, 6, 8, 10, 12)
"""Numbers of views at which regions are measured."""

# ------------------------------------------------------------------------------------------------------ made rooms

ROOMS = {"room51": 51, "room52": 52, "room53": 53}
"""Name -> seed; no constant of anything here was chosen on them. `room1` is for trying this file."""
OBJECTS = {"table": ("table", "vase", "chair"), "sofa": ("sofa", "cushion"), "bookcase": ("shelf", "vase", "book")}
"""Object -> classes of the parts that it has: the first run of such parts that begins with the first class."""
MARGIN = 0.05  # meters that the box of an object is larger than it, on each side
SIZE = (128, 96)  # width, height in pixels
FOV_X = 60.0  # degrees across the width
POOL = 64  # views to choose from
HELD_OUT = 8  # views that show an object, of each object
SEES = 0.02  # share of a view's pixels from which on it sees an object
SHOWS = 0.05  # share of a held-out view's pixels that the object has at least
LIGHT_PATHS = 16  # a pixel
CLEARANCE = 0.5  # meters between a camera and the nearest surface, at least


FREE = {"free31": 31, "free32": 32, "free33": 33}
"""Name -> seed of a room whose 200 candidates and 25 held-out views are free poses (docs/next-views.md)."""


def _parts(seed: int) -> list[tuple]:
    """The parts of a room, those of an object called as it, all others `other`."""
    parts = [list(part) for part in room.parts(seed)]
    names = [part[0] for part in parts]
    for part in parts:
        part[0] = "other"
    for name, classes in OBJECTS.items():
        k = names.index(classes[0])
        while k < len(names) and names[k] in classes:
            parts[k][0] = name
            k += 1
    return [tuple(part) for part in parts]


def _drawn_poses(built: Any, size: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Camera-to-world matrices (4, 4) of cameras anywhere in a room, at eye height, that look anywhere."""
    import mitsuba as mi

    around = rng.normal(size=(200, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    ways = mi.Vector3f(*(mi.Float(np.ascontiguousarray(x, np.float32)) for x in around.T))
    while True:
        x, y = rng.uniform(-0.5, 0.5, 2) * size[:2]
        eye = np.array([x, y, rng.uniform(1.1, 1.7)])
        origin = mi.Point3f(*(mi.Float(float(v)) for v in eye))
        yaw, pitch = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(-25, 5))
        if built.ray_intersect_preliminary(mi.Ray3f(origin, ways), coherent=False).t.numpy().min() < CLEARANCE:
            continue
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        pose = np.eye(4)
        pose[:3, :3] = scenes.axes(forward)
        pose[:3, 3] = eye
        yield pose


def made_room(seed: int, folder: Path) -> Path:
    """Photographs, depth maps and truth of a room, unless they are there.

    The folder has `pool` and `held_out`, each a data set with truth/NNN.png (0 none, k the k-th object), and
    boxes.json: object -> corners of its box.
    """
    if (folder / "boxes.json").exists():
        return folder
    parts = _parts(seed)
    built, table = _built(parts)
    K = labelled.intrinsics(*SIZE, FOV_X)
    poses = _drawn_poses(built, room.Layout(seed).size, np.random.default_rng([seed, 55]))

    def labels_of(pose: np.ndarray) -> np.ndarray:
        return table[scenes.first_hits(built, K, pose, *SIZE)[1]]

    chosen = {"pool": [next(poses) for _ in range(POOL)], "held_out": []}
    lacking = dict.fromkeys(range(1, len(OBJECTS) + 1), HELD_OUT)
    while any(x > 0 for x in lacking.values()):
        pose = next(poses)
        labels = labels_of(pose)
        shown = [k for k in lacking if lacking[k] > 0 and (labels == k).mean() >= SHOWS]
        for k in shown:
            lacking[k] -= 1
        if shown:
            chosen["held_out"].append(pose)
    for k, (name, some) in enumerate(chosen.items()):
        (folder / name / "truth").mkdir(parents=True, exist_ok=True)
        for i, pose in enumerate(some):
            write_png(folder / name / "truth" / f"{i:03d}.png", labels_of(pose))
        with Bar(f"path tracing {folder.name}, {name}", show=True) as bar:
            scenes.write_views(
                folder / name, built, K, np.stack(some), *SIZE, spp=LIGHT_PATHS, max_depth=3, exposure=1.8,
                seed=2 * seed + k, progress=bar.update,
            )  # fmt: skip
    (folder / "boxes.json").write_text(json.dumps(_boxes(parts), indent=1) + "\n")
    return folder


def _built(parts: list[tuple]) -> tuple[Any, np.ndarray]:
    """A room's Mitsuba scene, and a table from its shapes to objects: 0 none, k the k-th object."""
    built, table = labelled.build(parts, ("other", *OBJECTS))
    return built, np.maximum(table, 1) - 1


def _boxes(parts: list[tuple]) -> dict[str, list[list[float]]]:
    """Object -> corners of its box."""
    boxes = {}
    for name in OBJECTS:
        points = np.concatenate([np.asarray(part[1][0]) for part in parts if part[0] == name])
        boxes[name] = [(points.min(0) - MARGIN).tolist(), (points.max(0) + MARGIN).tolist()]
    return boxes


# ----------------------------------------------------------------------------------------------- what is measured


@dataclasses.dataclass(frozen=True)
class Subject:
    """An object whose views are chosen, and what it is measured by.

    Attributes:
        name: Its name.
        seen: Names of the views of the pool that see it.
        frames: Held-out photographs that show it.
        masks: (H, W) bool, where each of them shows it.
        region: The option `--region` by the folder of a start's masks.
    """

    name: str
    seen: frozenset[str]
    frames: list[Frame]
    masks: list[torch.Tensor]
    region: str

    def measured(self, fit_: Fit) -> dict[str, float]:
        """Of its pixels, means over held-out views: PSNR, and IoU with what the Gaussians of its region cover."""
        gaussians = fit_.gaussians()
        region = RegionText.of(self.region).region(lambda folder: _masks_in(folder, fit_), lambda: (None, None))
        members = region.members(gaussians)
        gaussians = gaussians.replace(features=members[:, None])
        values, overlaps = [], []
        for frame, mask in zip(self.frames, self.masks, strict=True):
            with torch.no_grad():
                out = render(gaussians, frame.camera, fit_.config.settings, outputs=())
            values.append(psnr(out.rgb.clamp(0, 1), frame.image(), mask.float()))
            shown = out.features[..., 0] > 0.5
            overlaps.append(float((shown & mask).sum() / (shown | mask).sum()))
        found = {"psnr": float(np.mean(values)), "iou": float(np.mean(overlaps))}
        return found | {"gaussians": float(members.sum())}


def _masks_in(folder: Path, fit_: Fit) -> tuple[list[torch.Tensor], list[Camera]]:
    """Masks in a folder, at the size of the photographs of a fit that have one, and their cameras."""
    masks, cameras = [], []
    for frame in fit_.frames:
        path = folder / f"{frame.name}.png"
        if path.exists():
            size = frame.camera.width, frame.camera.height
            mask = cv2.resize(plain_labels(path) / np.float32(255), size, interpolation=cv2.INTER_AREA)
            masks.append(torch.from_numpy(mask).clamp(0, 1))  # sums are rounded
            cameras.append(frame.camera)
    return masks, cameras


class Meter(Component):
    """Measures subjects on the way, before each view that is added and at the end; it changes nothing."""

    name = "meter"

    def __init__(self, subjects: Sequence[Subject]) -> None:
        self.subjects = subjects
        self.curve: dict[str, dict[str, dict[str, float]]] = {}

    def join(self, fit_: Fit, frame: Frame, setup: Setup) -> list[dict]:
        self._measure(fit_)
        return []

    def metrics(self, fit_: Fit, held_out: list[Frame]) -> dict[str, Any]:
        self._measure(fit_)
        return {}

    def _measure(self, fit_: Fit) -> None:
        count = len(fit_.frames)
        if count in COUNTS:
            self.curve[str(count)] = {subject.name: subject.measured(fit_) for subject in self.subjects}


_seen: frozenset[str] = frozenset()
"""Views that see the object of the fit that runs now, for `farthest_seeing`."""


def farthest_seeing(pool: Pool) -> Selection:
    """`farthest` among the candidates that see the object, by the truth; among all once there are none."""
    order = farthest(pool)
    seeing = [i for i, camera in enumerate(pool.candidates) if camera.name in _seen]
    if not seeing:
        return order
    best = max(seeing, key=lambda i: (order.scores[i], -i))
    return dataclasses.replace(order, picks=[pool.pick(best, order.scores[best])])


# ------------------------------------------------------------------------------------------------------------ fits

POLICIES: Mapping[str, dict[str, Any]] = {
    "region": {},
    "default": {},
    "farthest, seeing": {"policy": "regions:farthest_seeing"},
    "farthest": {"policy": "farthest"},
    "uniform": {"policy": "uniform"},
}
"""Policy -> fields of a `SelectionConfig`; `region` is the default with the region of the object."""
OF_OBJECT = ("region", "farthest, seeing")
"""Policies that know the object. The fits of the others are shared by all objects of a scene."""
SELECTION = {"initial": 2, "add": 10, "every": 40, "start": "seed", "info_pixels": 3_072}
FIT = FitConfig(selection=SelectionConfig()).replace(
    renderers=("fast",), max_pixels=SIZE[0] * SIZE[1], max_gaussians=8_000, max_steps=500, **SELECTION
)


@dataclasses.dataclass(frozen=True)
class Study:
    """Objects of a scene, and views to choose from.

    Attributes:
        name: Its name.
        dataset: Data set of the pool; nothing of a view that is not picked is read.
        subjects: Its objects.
        config: Of every fit, but for start and policy.
    """

    name: str
    dataset: Dataset
    subjects: tuple[Subject, ...]
    config: FitConfig

    @property
    def train(self) -> list[View]:
        """The views to choose from."""
        return self.dataset.split(self.config.data.test_every, self.config.data.test_offset)[0]

    def policies(self) -> list[tuple[str, Subject | None]]:
        """Policies and the object that each knows. Where all views see the object, those that do are no others."""
        found: list[tuple[str, Subject | None]] = []
        for policy in POLICIES:
            if policy not in OF_OBJECT:
                found.append((policy, None))
                continue
            every = frozenset(view.name for view in self.train)
            found += [(policy, x) for x in self.subjects if policy == "region" or x.seen < every]
        return found

    def starts(self, count: int) -> list[int]:
        """The first seeds that draw different pairs of views."""
        pairs: dict[frozenset[str], int] = {}
        for seed in range(100):
            pairs.setdefault(frozenset(ActiveViews(self.train, self.config.replace(seed=seed)).names), seed)
        return list(pairs.values())[:count]


def made_study(name: str, runs: Path) -> Study:
    """A room."""
    folder = made_room(int(name.removeprefix("room")), runs / name)
    boxes = json.loads((folder / "boxes.json").read_text())
    config = FIT.replace(test_every=0)
    pool, held_out = (load(folder / part, lazy=True) for part in ("pool", "held_out"))
    frames = frames_for(held_out.views, config.data)
    seen, shown = (
        [plain_labels(folder / part / "truth" / f"{view.name}.png") for view in data.views]
        for part, data in (("pool", pool), ("held_out", held_out))
    )
    return Study(name, pool, _subjects(boxes, [view.name for view in pool.views], seen, frames, shown), config)


def free_study(name: str, runs: Path) -> Study:
    """A room with free poses, as `drgs scene room --free` makes it."""
    seed = FREE[name]
    with Bar(f"path tracing {name}", show=True) as bar:
        folder = room.generate(
            runs / name, views=225, width=160, height=120, spp=LIGHT_PATHS, seed=seed, teacher_width=8,
            teacher_height=8, free=True, progress=bar.update,
        )  # fmt: skip
    config = FIT.replace(semantics="ignore")
    dataset = load_dataset(folder, config, lazy=True, points=False)
    train, test = dataset.split()
    frames = frames_for(test, config.data)
    built, table = _built(_parts(seed))

    def labels_of(camera: Camera) -> np.ndarray:
        return table[scenes.first_hits(built, camera.K, camera.c2w, camera.width, camera.height)[1]]

    seen, shown = [labels_of(view.camera) for view in train], [labels_of(frame.camera) for frame in frames]
    subjects = _subjects(_boxes(_parts(seed)), [view.name for view in train], seen, frames, shown)
    return Study(name, dataset, subjects, config)


def _subjects(
    boxes: Mapping[str, Any],
    pool: Sequence[str],
    seen: Sequence[np.ndarray],
    frames: list[Frame],
    shown: Sequence[np.ndarray],
) -> tuple[Subject, ...]:
    """The objects of a room that held-out views show.

    Args:
        boxes: Object -> corners of its box.
        pool: Names of the views to choose from.
        seen: (H, W) of each of them, 0 none, k the k-th object.
        frames, shown: Held-out photographs, and the same of them.
    """  # fmt: skip
    subjects = []
    for k, (name, box) in enumerate(boxes.items(), 1):
        sees = frozenset(view for view, labels in zip(pool, seen, strict=True) if (labels == k).mean() >= SEES)
        masks = [torch.from_numpy(labels == k) for labels in shown]
        showing = [i for i, mask in enumerate(masks) if mask.float().mean() >= SHOWS][:HELD_OUT]
        region = "box:" + ",".join(f"{x:.3f}" for corner in box for x in corner)
        if showing:
            subjects.append(Subject(name, sees, [frames[i] for i in showing], [masks[i] for i in showing], region))
    return tuple(subjects)


# -------------------------------------------------------------------------------------------------------- captures

CAPTURES = ("statue", "head")


def captured_study(name: str, runs: Path) -> Study:
    """`statue-1` is the capture `statue` with every third photograph held out, from the second on.

    The region is masks of the two photographs of a start, which `Study.region_at` writes.
    """
    capture, offset = name.split("-")
    config = FIT.replace(test_every=3, test_offset=int(offset))
    dataset = load_dataset(DATA / capture, config, lazy=True, points=False)
    train, test = dataset.split(3, int(offset))
    frames = frames_for(test, config.data)
    masks = [_object_in(view, frame.camera) > 0.5 for view, frame in zip(test, frames, strict=True)]
    region = f"masks:{runs / name}"
    return Study(name, dataset, (Subject(capture, frozenset(x.name for x in train), frames, masks, region),), config)


def _object_in(view: View, camera: Camera | None = None) -> torch.Tensor:
    """(H, W) in [0, 1], where a photograph shows the object of its capture, at the size of a camera."""
    seen = camera or view.checked().camera
    mask = view.mask(seen.width, seen.height) if view.mask_path else view.labels(seen.width, seen.height) == 1
    return torch.from_numpy(np.asarray(mask, np.float32))


def _write_masks(study: Study, start: int, folder: Path) -> None:
    """Masks of the two photographs of a start, and no others."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    views = ActiveViews(study.train, study.config.replace(seed=start))
    for i in views.chosen:
        mask = (_object_in(study.train[i]) * 255).round().byte().numpy()
        write_png(folder / f"{study.train[i].name}.png", mask)


def study_of(name: str, runs: Path) -> Study:
    """A room or a capture."""
    if name in FREE:
        return free_study(name, runs)
    return (captured_study if name.partition("-")[0] in CAPTURES else made_study)(name, runs)


def fitted(study: Study, start: int, policy: str, subject: Subject | None, folder: Path) -> dict[str, Any]:
    """The row of a fit: what was picked, and what it shows of each object with so many views."""
    global _seen
    _seen = subject.seen if subject else frozenset()
    fields = {"region": subject.region} if policy == "region" and subject else POLICIES[policy]
    meter = Meter([subject] if subject else study.subjects)
    dataset = dataclasses.replace(study.dataset, views=[*study.dataset.views])
    shutil.rmtree(folder, ignore_errors=True)
    began = time.process_time()
    config = study.config.replace(seed=start, **fields)
    fit(dataset, folder, config, components=[*COMPONENTS.values(), lambda: meter], progress=False)
    chosen = json.loads((folder / "selection.json").read_text())
    picks = chosen["picks"]
    return {
        "initial": [view["name"] for view in chosen["start"]],
        "picks": [pick["name"] for pick in picks],
        "notes": sorted({note for pick in picks for note in pick["notes"]}),
        "seeing": {x.name: sum(pick["name"] in x.seen for pick in picks) for x in meter.subjects},
        "curve": meter.curve,
        "pick_seconds": sum(pick["seconds"] for pick in picks),
        "process_seconds": time.process_time() - began,
    }


def run(study: Study, starts: int, runs: Path, rows: Path) -> None:
    """All fits of a scene that are not there yet, start by start: what is there at any time is a study of fewer."""
    for start in study.starts(starts):
        if study.name.partition("-")[0] in CAPTURES:
            _write_masks(study, start, runs / study.name)
        for policy, subject in study.policies():
            key = {"scene": study.name, "start": start, "policy": policy, "object": subject.name if subject else ""}
            if any(key.items() <= row.items() for row in read_rows(rows)):
                continue
            try:
                row = fitted(study, start, policy, subject, runs / f"fit-{os.getpid()}")
            except FAILURES as error:
                row = {"error": f"{type(error).__name__}: {error}"}
            add_row(rows, key | row | ran())
            print(key, row.get("error") or row["curve"], flush=True)


# ------------------------------------------------------------------------------------------------------------ page

PAGE = ROOT / "docs" / "active-region.md"
PICTURE = ROOT / "docs" / "pictures" / "active-region.png"
METRICS = (Metric("psnr", "PSNR, dB", 2), Metric("iou", "IoU"))
REFERENCE = "region"
SHOWN = (4, 6, 12)  # views
GROUPS = {"rooms": tuple(ROOMS), "free poses": tuple(FREE), "captures": CAPTURES}
"""Name -> scenes whose means are averaged."""

Rows = Sequence[Mapping[str, Any]]


def study_rows(rows: Rows) -> list[dict[str, Any]]:
    """A row a fit and object, as those of `drgs.studies`; a unit is an object, or a split of a capture, and a start."""
    found = []
    for row in rows:
        scene, _, offset = row["scene"].partition("-")
        for name in () if "error" in row else row["curve"]["12"]:
            curve = {n: {metric.key: at[name][metric.key] for metric in METRICS} for n, at in row["curve"].items()}
            found.append(
                {
                    "scene": scene,
                    "split": (3, int(offset)) if offset else (0, 0),
                    "start": "seed",
                    "seed": row["start"],
                    "initial": [name, f"start {row['start']}"],
                    "policy": row["policy"],
                    "picks": row["picks"],
                    "metrics": curve["12"],
                    "curve": {count: at for count, at in curve.items() if count not in ("2", "12")},
                    "seeing": row["seeing"][name],
                    "object": name,
                    "commit": row["commit"],
                }
            )
    return found


def compared(rows: Rows, metric: Metric, other: str) -> str:
    """`region` less another policy: mean and interval; bold where that excludes 0."""
    return lead(differences(rows, metric.key, REFERENCE, other), metric.digits)


def main_lines(rows: Rows) -> list[list[str]]:
    """The heads, and a row a group of scenes, metric and other policy."""
    shown = [f"{count} views" for count in SHOWN]
    lines = [["", "`region` less", "units", "wins", "3 to 12 views", *shown, "detectable"]]
    for metric in METRICS:
        over = [over_views(row, metric.key) for row in rows]
        for group, scenes_ in GROUPS.items():
            own = [row for row in over if row["scene"] in scenes_]
            for other in POLICIES:
                values = differences(own, metric.key, REFERENCE, other)
                if other == REFERENCE or not values:
                    continue
                whole = estimate(values)
                detectable = "" if whole.detectable is None else f"{whole.detectable:.{metric.digits}f}"
                at = [compared([x for x in at_views(rows, n) if x["scene"] in scenes_], metric, other) for n in SHOWN]
                counted = [str(whole.units), str(whole.positive), compared(own, metric, other)]
                lines.append([f"{group}, {metric.title}", f"`{other}`", *counted, *at, detectable])
    return lines


def data_lines(rows: Rows) -> Iterator[list[str]]:
    """A line a fit and object."""
    counts = [str(count) for count in COUNTS if count > 2]
    heads = [f"{metric.key}_{count}" for metric in METRICS for count in counts]
    yield ["scene", "split", "object", "start", "policy", "picks_that_see_it", *heads, "commit"]
    for row in rows:
        curve = {**row["curve"], "12": row["metrics"]}
        numbers = [f"{curve[count][metric.key]:.{metric.digits}f}" for metric in METRICS for count in counts]
        given = [row["scene"], str(row["split"][1]), row["object"], str(row["seed"]), row["policy"], str(row["seeing"])]
        yield [*given, *numbers, row["commit"]]


def write_page() -> None:
    """Tables, picture and data file of the rows that there are."""
    told = read_rows(ROWS)
    rows = study_rows(told)
    study = StudyOfFits(
        name="regions", folder=Path, policies=POLICIES, fit=FIT, metrics=METRICS, reference="farthest",
        comparisons=((REFERENCE, "default"),),
    )  # fmt: skip
    draw_curves(study, rows, METRICS[0], PICTURE)
    dates = " and ".join(sorted({row["date"] for row in told}))
    head = (
        "PSNR of the object with `region` less that of another policy, in dB, with 95 % intervals "
        f"({coverage(3, 18):.0%} contain the true mean); bold where that excludes 0 and there "
        f"are {FEWEST_UNITS} units; *wins*: units in which `region` is better, 3 to 12 views. {len(told)} fits by "
        f"`python benchmarks/regions.py`, {told[0]['machine']}, {dates} "
        "([rows](../benchmarks/regions.jsonl), [by fit](data/active-region.csv), [4 views, and "
        "IoU](data/active-region-differences.csv))."
    )
    heads, *lines = main_lines(rows)
    told = [[line[0].split(",")[0], *line[1:5], *line[6:8]] for line in lines if METRICS[0].title in line[0]]
    text = [paragraph(head), markdown_table(["scenes", *heads[1:5], *heads[6:8]], told)]
    fill_between(PAGE, "regions", "\n\n".join(text))
    write_csv(PAGE_DATA / "active-region-differences.csv", [["scenes, metric", *heads[1:]], *lines])
    write_csv(PAGE_DATA / "active-region.csv", data_lines(rows))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=[])
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "regions")
    parser.add_argument("--rows", type=Path, default=ROWS)
    parser.add_argument("--page", action="store_true", help="then write the page of the rows that there are")
    args = parser.parse_args()
    for name in args.scenes:
        run(study_of(name, args.runs), args.starts, args.runs, args.rows)
    if args.page:
        write_page()
    return 0


if __name__ == "__main__":
    sys.modules["regions"] = sys.modules["__main__"]  # where `--policy regions:farthest_seeing` looks for it
    sys.exit(main())
