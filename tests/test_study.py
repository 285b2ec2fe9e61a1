"""Cells of a study: what is run, skipped, resumed and recorded; and what the statistics say of the rows."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import multiprocessing
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from test_active import write_still
from test_data import write_transforms
from test_dynamic_data import cameras, coded, write_poses, write_video

from drgs import train
from drgs.files import Run
from drgs.fitting.config import FitConfig
from drgs.io.locks import InUse
from drgs.io.outputs import write_json
from drgs.studies import cells as engine
from drgs.studies.cells import Metric, Study, distinct_seeds, run_cell, run_cells
from drgs.studies.rows import Cell, append_row, cell_of, read_study
from drgs.studies.statistics import (
    at_views,
    coverage,
    differences,
    estimate,
    unit_of,
    view_counts,
)
from drgs.studies.tables import comparison_table, explained

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from pages import draw_curves, fill_between

METRICS = (
    Metric("psnr", "PSNR", 2),
    Metric("flip", "FLIP", 3, larger=False),
    Metric("steps", "steps", 0, path=("step",)),
)
SPLIT = (4, 1)


def small(folder: Path, **fields) -> Study:
    """Two policies, ten steps; `fields` of the FitConfig."""
    config = {"renderers": ("fast",), "max_steps": 10, "max_gaussians": 60, "sh_degree": 1, "save_every": 3, **fields}
    return Study(
        name="tiny",
        folder=lambda scene, split: folder,
        policies={"farthest": {"policy": "farthest"}, "Random, 1": {"policy": "random"}},
        fit=FitConfig().replace(**{"initial": 2, "add": 2, "every": 3, **config}),
        metrics=METRICS,
        reference="Random, 1",
    )


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    write_still(folder)
    return folder


@pytest.fixture
def faked(monkeypatch):
    """`fit` is replaced by one that writes what a run folder has at the end; the configs that it was given."""
    seen = []

    def fit(dataset, folder, config, *, resume, progress):
        seen.append(config)
        fakes(folder, config, *([view.name for view in part] for part in dataset.split()))

    monkeypatch.setattr(engine, "fit", fit)
    return seen


def fakes(folder, config, train=("a", "b", "c"), test=("t",)):
    """The files of a finished run; without a selection, of a fit to all views."""
    active = config.selection
    schema = {"schema": 1, "command": "fit"}
    recorded = {"data": "x", "train": train[:2] if active else train, "test": test, "fit": config.to_json()}
    write_json(folder / "config.json", {**schema, **recorded})
    write_json(folder / "env.json", {"schema": 1, "commit": "0123456789", "drgs": "9"})
    picks = [{"index": 2, "name": train[2], "seconds": 0.5}]
    start = [{"index": i, "name": name} for i, name in enumerate(train[:2])]
    leak = config.data.init_points == "all"
    if active:
        write_json(folder / "selection.json", {**schema, "start": start, "picks": picks, "pool_leak": leak})
    mean = {"psnr": 20.0 + config.seed, "flip": None}
    counts = {"count": len(test), "gaussians": 3, "step": config.max_steps, "seconds": 1.5}
    write_json(folder / "metrics.json", {"schema": 1, "split": "test", "mean": mean, **counts})


def units(seeds=(0, 1)):
    return [("still", SPLIT, "seed", protocol, seed) for seed in seeds for protocol in ("blind", "paper")]


def test_units_are_outermost(still, faked, tmp_path):
    """After any number of whole units every policy has been run on each of them; a second call runs nothing."""
    study, rows = small(still), tmp_path / "rows.jsonl"
    cells = study.cells(units())
    assert len(cells) == len(set(cells)) == len({cell.name for cell in cells}) == 8
    assert [cell.policy for cell in cells] == ["farthest", "Random, 1"] * 4
    said = []
    assert run_cells(study, cells[:4], tmp_path, rows, said.append) == ([], {})
    assert [cell_of(row) for row in read_study(rows)] == [("tiny", cell) for cell in cells[:4]]
    assert len(faked) == 4
    assert run_cells(study, cells, tmp_path, rows, said.append) == ([], {})
    assert len(faked) == 8
    assert [cell_of(row)[1] for row in read_study(rows)] == cells


def test_a_cell_says_what_its_fit_is_told(still, faked, tmp_path):
    """Seed, split, start, policy and protocol arrive; rows say what came of them, with the commit and the version."""
    study = small(still)
    for cell in study.cells(units((5,)))[::2]:
        row = run_cell(study, cell, tmp_path)
        config, selection = faked[-1], faked[-1].selection
        assert (config.seed, config.data.test_every, config.data.test_offset) == (5, 4, 1)
        assert (selection.start, selection.policy) == ("seed", "farthest")
        assert config.data.init_points == {"blind": "views", "paper": "all"}[cell.protocol]
        assert row["pool_leak"] is (cell.protocol == "paper")
        assert row["initial"] == ["0", "2"]
        assert (row["picks"], row["views"], row["gaussians"]) == (["3"], 2, 3)
        assert row["metrics"] == {"psnr": 25.0, "flip": None, "steps": 10.0}
        assert (row["seconds"], row["pick_seconds"], row["commit"], row["drgs"]) == (1.5, 0.5, "0123456789", "9")


def test_a_folder_of_another_fit_is_refused(still, faked, tmp_path):
    """A study whose numbers have changed under the same name does not take old runs for its own."""
    study = small(still)
    cell = study.cells(units())[0]
    run_cell(study, cell, tmp_path)
    run_cell(dataclasses.replace(study, fit=study.fit.replace(save_every=9)), cell, tmp_path)
    other = dataclasses.replace(study, fit=study.fit.replace(max_steps=11))
    with pytest.raises(ValueError, match="must be the run of this cell, max_steps was 10 and is 11; give the study"):
        run_cell(other, cell, tmp_path)
    other = dataclasses.replace(study, fit=study.fit.replace(every=4))
    with pytest.raises(ValueError, match="must be the run of this cell, every was 3 and is 4"):
        run_cell(other, cell, tmp_path)
    assert len(faked) == 1
    said = []
    assert run_cells(other, [cell], tmp_path, tmp_path / "rows.jsonl", said.append)[1].keys() == {cell}
    assert "failed: " in said[-1]
    assert "every was 3" in said[-1]


def test_a_stated_split_is_refused(still, tmp_path):
    """Files that say what is held out win over the cell's split: taken if they say the same."""
    study = small(still)
    data = json.loads((still / "transforms.json").read_text())
    data["test_filenames"] = [data["frames"][0]["file_path"]]
    data["train_filenames"] = [frame["file_path"] for frame in data["frames"][1:]]
    folder = tmp_path / "stated"
    folder.mkdir()
    for name in ("images", "masks", "depth"):
        (folder / name).symlink_to(still / name)
    (folder / "transforms.json").write_text(json.dumps(data))
    stated = dataclasses.replace(study, folder=lambda scene, split: folder)
    with pytest.raises(ValueError, match="must hold out every 4th view from index 1 on, as the cell does, its files"):
        run_cell(stated, study.cells(units())[0], tmp_path)
    same = Cell("still", (9, 0), "seed", "farthest", "blind", 0)
    assert [view.name for view in stated.dataset(same).split()[1]] == ["0"]


def test_seeds_are_of_different_initial_views(still):
    """Those that are left out would have repeated a unit; the order of two initial views does not matter."""
    study = small(still)
    seeds = distinct_seeds(study, "still", SPLIT, 4)
    assert seeds == sorted(seeds)
    assert len(set(seeds)) == 4
    views = study.dataset(study.cells(units())[0]).split()[0]
    sets = []
    for seed in range(seeds[-1] + 1):
        plan = engine.ActiveViews(views, study.fit.replace(start="seed", seed=seed))
        sets.append(frozenset(plan.chosen))
    assert [sets.index(chosen) for chosen in dict.fromkeys(sets)] == seeds
    with pytest.raises(ValueError, match="must have 1000 sets of initial views"):
        distinct_seeds(study, "still", SPLIT, 1000)
    assert distinct_seeds(study, "still", SPLIT, 4, "paper") == seeds


def test_seeds_are_of_the_protocols_initial_views(tmp_path):
    """Two views that differ may lead to the same ten: as many sets as wanted all the same, or one line that says why
    there are none.
    """
    write_transforms(tmp_path, count=24)
    study = small(tmp_path)
    train = study.dataset(study.cells(units())[0]).split()[0]
    sets = {}
    for protocol in ("blind", "nbv-gym"):
        for seed in distinct_seeds(study, "still", SPLIT, 8, protocol):
            cell = Cell("still", SPLIT, "seed", "farthest", "nbv-gym", seed)
            sets.setdefault(protocol, set()).add(frozenset(engine.ActiveViews(train, study.config_of(cell)).chosen))
    assert len(sets["nbv-gym"]) == 8
    assert len(sets["blind"]) < 8, "else this test tells nothing"
    many = dataclasses.replace(study, fit=study.fit.replace(add=None))
    with pytest.raises(ValueError, match="still: must have 20 training views for protocol nbv-gym, 10 at the start"):
        distinct_seeds(many, "still", SPLIT, 2, "nbv-gym")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Four cameras that film six frames."""
    folder = tmp_path_factory.mktemp("filmed")
    for k in range(4):
        write_video(folder / f"cam{k:02d}.mp4", [coded(i, k) for i in range(6)])
    write_poses(folder, cameras())
    return folder


def test_units_of_held_out_cameras(filmed, faked, tmp_path):
    """A unit may be (scene, camera held out): the fit and the data set are told so, the row says so and is read back,
    and two cameras are two units; a policy that picks nothing has no active config and no seconds a pick.
    """
    study = dataclasses.replace(
        small(filmed, times=3, schedule="times"),
        policies={"farthest": {"policy": "farthest"}, "all": None},
    )
    cells = study.cells([("film", camera, "first", "blind", 0) for camera in ("cam01", "cam02")])
    assert [cell.name for cell in cells[::2]] == [f"film-{name}-first0-blind-farthest" for name in ("cam01", "cam02")]
    data = study.dataset(cells[2])
    assert data.times == (0.0, 0.4, 1.0)
    assert {view.camera_name for view in data.split()[1]} == {"cam02"}
    with pytest.raises(ValueError, match="cam9"):
        study.dataset(dataclasses.replace(cells[0], camera="cam9"))
    rows = tmp_path / "rows.jsonl"
    assert run_cells(study, cells, tmp_path, rows, str) == ([], {})
    assert [config.data.test_cameras for config in faked] == [("cam01",), ("cam01",), ("cam02",), ("cam02",)]
    assert [config.selection and config.selection.schedule for config in faked] == ["times", None, "times", None]
    found = read_study(rows)
    assert [cell_of(row)[1] for row in found] == cells
    assert [(row["picks"], row["pick_seconds"]) for row in found[:2]] == [(["cam00/0005"], 0.5), ([], None)]
    assert found[0]["initial"] != found[1]["initial"]
    assert len({unit_of(row) for row in found}) == 2


# ---- files


def row_of(scene="s", split=(8, 0), policy="p", seed=0, psnr=0.0, **fields):
    cell = Cell(scene, split, "seed", policy, "blind", seed)
    metrics = {"psnr": psnr, "flip": psnr, "steps": 1.0}
    row = {"study": "tiny", **cell.to_json(), "initial": [f"v{seed}"], "metrics": metrics, "pick_seconds": 1.0}
    return {**row, "commit": "abcdefghi", **fields}


def test_rows_survive_a_kill_and_merge(tmp_path):
    """Half a last line is dropped and written over; damaged lines before it are named; later files win."""
    path, other = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    assert read_study(path) == []
    append_row(path, row_of(seed=0))
    with path.open("ab") as file:
        file.write(b'{"study": "ti')
    assert [row["seed"] for row in read_study(path)] == [0]
    append_row(path, row_of(seed=1))
    append_row(path, row_of(seed=1, psnr=9.0))
    assert [(row["seed"], row["metrics"]["psnr"]) for row in read_study(path)] == [(0, 0.0), (1, 0.0)]
    assert path.read_bytes().count(b"\n") == 2
    append_row(other, row_of(seed=1, psnr=7.0))
    assert [row["metrics"]["psnr"] for row in read_study(path, other)] == [0.0, 7.0]
    path.write_bytes(b"{}\n" + path.read_bytes())
    with pytest.raises(ValueError, match=r"a\.jsonl: line 1 must be a row of a study, is not \('scene'\)"):
        read_study(path)


def _append(path, numbers):
    for number in numbers:
        append_row(path, row_of(seed=number))


def test_many_processes_write_one_file(tmp_path):
    """No row is lost or doubled, though both write the middle ones."""
    path = tmp_path / "rows.jsonl"
    context = multiprocessing.get_context("fork")
    both = [context.Process(target=_append, args=(path, range(start, start + 40))) for start in (0, 20)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert sorted(row["seed"] for row in read_study(path)) == list(range(60))


def test_a_fit_without_memory_is_one_that_fails(still, faked, tmp_path, monkeypatch):
    """It is told and left for the next call; the others go on."""
    study, rows, fake = small(still), tmp_path / "rows.jsonl", engine.fit
    cells = study.cells(units((0,)))

    def fit(dataset, folder, *arguments, **options):
        if Path(folder).name == cells[0].name:
            raise MemoryError(f"{folder}: there must be more memory")
        fake(dataset, folder, *arguments, **options)

    monkeypatch.setattr(engine, "fit", fit)
    said = []
    taken, failed = run_cells(study, cells, tmp_path, rows, said.append)
    assert (taken, list(failed)) == ([], cells[:1])
    assert "there must be more memory" in failed[cells[0]]
    assert [cell_of(row)[1] for row in read_study(rows)] == cells[1:]


def test_a_cell_that_another_process_has_is_left_to_it(still, faked, tmp_path):
    """Two processes at once: the second goes on with the next cell, and says which it left."""
    study = small(still)
    cells = study.cells(units((0,)))
    folder = tmp_path / study.name / cells[0].name
    folder.mkdir(parents=True)
    code = f"import time; from pathlib import Path; from drgs.io.locks import acquire; " \
           f"acquire(Path({str(folder)!r}), 'fit'); print('held', flush=True); time.sleep(60)"  # fmt: skip
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        with pytest.raises(InUse, match="must not be written by two commands at once"):
            run_cell(study, cells[0], tmp_path)
        left = run_cells(study, cells, tmp_path, tmp_path / "rows.jsonl", lambda line: None)
        assert left == ([cells[0]], {})
    finally:
        other.kill()
        other.wait()
    assert run_cells(study, cells, tmp_path, tmp_path / "rows.jsonl", lambda line: None) == ([], {})
    assert len(faked) == len(cells)


def test_a_data_set_that_another_process_makes_is_waited_for(still, faked, tmp_path, monkeypatch, caplog):
    """The first processes of a study all want the same data set: one makes it, the others wait, and say so once."""
    calls = []

    def folder(scene, split):
        calls.append(scene)
        if len(calls) < 3:
            raise InUse(f"{still}: must not be written by two commands at once")
        return still

    monkeypatch.setattr(engine, "_RETRY_SECONDS", 0.0)
    study = dataclasses.replace(small(still), folder=folder)
    assert run_cells(study, study.cells(units((0,)))[:1], tmp_path, tmp_path / "rows.jsonl", str) == ([], {})
    assert len(calls) == 3
    assert caplog.text.count("waiting: ") == 1


def test_lpips_comes_later(still, faked, tmp_path, monkeypatch):
    """Finished cells get it without another fit, once; a row that has it, or says that it cannot be, is left alone."""
    rows, measured = tmp_path / "rows.jsonl", []
    study = small(still)
    cell = study.cells(units((0,)))[0]
    assert run_cells(study, [cell], tmp_path, rows, str) == ([], {})

    def evaluate(run, claimed, lpips):
        measured.append(lpips)
        found = json.loads((run.path / "metrics.json").read_text())
        write_json(run.path / "metrics.json", {**found, "mean": {**found["mean"], "lpips": 0.25}})

    monkeypatch.setattr(engine, "evaluate_run", evaluate)
    monkeypatch.setattr(engine, "Lpips", lambda weights: weights)
    weighed = dataclasses.replace(study, metrics=(*METRICS, Metric("lpips", "LPIPS")), lpips=tmp_path / "w.pth")
    for _ in range(2):
        assert run_cells(weighed, [cell], tmp_path, rows, str) == ([], {})
    assert len(faked) == 1
    assert measured == [tmp_path / "w.pth"]
    assert [row["metrics"]["lpips"] for row in read_study(rows)] == [0.25]
    assert run_cells(study, [cell], tmp_path, rows, str) == ([], {}), "without weights it is done as well"


def test_a_cell_that_was_evaluated_again(still, faked, tmp_path, monkeypatch):
    """`drgs eval` writes metrics.json anew, without the seconds where no checkpoint is left: the row is taken all the
    same.
    """
    real, said, rows = engine._row, [], tmp_path / "rows.jsonl"
    monkeypatch.setattr(engine, "_row", lambda *arguments: {**real(*arguments), "seconds": None})
    study = small(still)
    assert run_cells(study, study.cells(units((0,)))[:1], tmp_path, rows, said.append) == ([], {})
    assert [row["seconds"] for row in read_study(rows)] == [None]
    assert said[-1].endswith("steps 10")


# ---- one real cell


@pytest.mark.same_bits
def test_a_killed_cell_goes_on(still, tmp_path, monkeypatch):
    """A fit that is killed after a pick is resumed from its checkpoint and ends as one that was not."""
    study = small(still, deterministic=True)
    study = dataclasses.replace(study, fit=study.fit.replace(measure=(2, 3)))
    cell = study.cells(units((3,)))[1]
    whole = run_cell(study, cell, tmp_path / "whole")

    class Killed(BaseException):
        """Nothing catches it."""

    real, saved = train.save_state, []

    def save(*arguments):
        real(*arguments)
        saved.append(1)
        if len(saved) == 2:
            raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(train, "save_state", save)
        with pytest.raises(Killed):
            run_cell(study, cell, tmp_path / "killed")
    folder = tmp_path / "killed" / study.name / cell.name
    assert not (folder / "metrics.json").exists()
    assert (folder / "state.safetensors").exists()
    row = run_cell(study, cell, tmp_path / "killed")
    events = [json.loads(line)["event"] for line in (folder / "log.jsonl").read_text().splitlines()]
    assert "resume" in events
    same = ("initial", "picks", "metrics", "gaussians", "pool_leak", "commit")
    assert {key: row[key] for key in same} == {key: whole[key] for key in same}
    assert len(row["picks"]) == 2
    assert row["metrics"]["psnr"] > 5.0
    assert row["medians"]["psnr"] > 5.0
    assert list(row["curve"]) == ["2", "3"]
    assert row["curve"]["3"].keys() == row["metrics"].keys()
    assert row["curve"]["3"]["steps"] == 6


# ---- statistics


def test_units_are_paired_and_repeats_averaged():
    """Fits of one unit are averaged before they are subtracted; what has no partner is left out."""
    rows = [
        row_of(policy="p", seed=0, psnr=3.0),
        row_of(policy="p", seed=9, psnr=5.0, initial=["v0"]),
        row_of(policy="r", seed=0, psnr=1.0),
        row_of(policy="p", seed=1, psnr=8.0),
        row_of(policy="r", seed=2, psnr=8.0),
        row_of(policy="p", seed=3, psnr=2.0, split=(8, 4)),
        row_of(policy="r", seed=3, psnr=2.5, split=(8, 4)),
    ]
    found = differences(rows, "psnr", "p", "r")
    assert found == {("s", (8, 0), ("v0",)): 3.0, ("s", (8, 4), ("v3",)): -0.5}
    assert unit_of(row_of(initial=["b", "a"])) == unit_of(row_of(initial=["a", "b"]))


@pytest.mark.parametrize("sizes", [(2, 1), (2, 2), (3,)])
def test_intervals_are_those_of_all_resamples(rng, sizes):
    """Mean and 95 % interval against every possible draw of scenes, then units.

    A quantile of a few dozen values is one of them; it may be the next one where the draws fall on its edge.
    """
    values = {(f"s{s}", (8, 0), (str(k),)): float(rng.normal()) for s, n in enumerate(sizes) for k in range(n)}
    scenes = [[value for unit, value in values.items() if unit[0] == f"s{s}"] for s in range(len(sizes))]
    means, weights = [], []
    for drawn in itertools.product(scenes, repeat=len(scenes)):
        count = np.prod([len(scene) ** len(scene) for scene in drawn])
        for resampled in itertools.product(*(itertools.product(scene, repeat=len(scene)) for scene in drawn)):
            means.append(np.mean([np.mean(units) for units in resampled]))
            weights.append(1 / count)
    order = np.argsort(means)
    means, weights = np.array(means)[order], np.array(weights)[order] / np.sum(weights)
    mean = np.sum(means * weights)
    found = estimate(values)
    assert found.mean == pytest.approx(np.mean([np.mean(scene) for scene in scenes]))
    assert mean == pytest.approx(found.mean)
    below = np.cumsum(weights)
    for quantile, got in ((0.025, found.low), (0.975, found.high)):
        low, high = (means[np.searchsorted(below, q)] for q in (quantile - 0.006, min(quantile + 0.006, 1 - 1e-9)))
        assert low - 1e-9 <= got <= high + 1e-9, "within four standard errors of the share below it"
    assert (found.units, found.scenes) == (sum(sizes), len(sizes))
    assert found.positive == sum(value > 0 for value in values.values())
    assert found.positive + found.negative == found.units


def test_what_is_detectable_is_students(rng):
    """The number is that of a t test of the scenes' means, of one scene of its units, and none where a single mean says
    nothing of its spread.
    """
    values = {(f"s{s}", (8, 0), (str(k),)): float(rng.normal()) for s, n in enumerate((3, 3, 6)) for k in range(n)}
    scenes = [[x for unit, x in values.items() if unit[0] == f"s{s}"] for s in range(3)]
    for given, means in ((values, [np.mean(x) for x in scenes]), ({u: values[u] for u in list(values)[:3]}, scenes[0])):
        wanted = (stats.t.ppf(0.975, 2) + stats.t.ppf(0.8, 2)) * stats.sem(means)
        assert estimate(given, draws=2).detectable == pytest.approx(wanted, rel=1e-9)
    assert estimate({("s", (8, 0), ("0",)): 1.0}, draws=2).detectable is None


@pytest.mark.parametrize("sizes", [(1, 1, 1), (3, 3, 6), (5,) * 8])
def test_what_is_detectable_is_detected(sizes):
    """4 of 5 studies tell a true difference of that size from 0 by Student's t, and 1 of 20 one of nothing.

    600 studies know a share of 0.8 to 0.016, one of 0.05 to 0.009: three of these. Of three means the sum of quantiles
    falls a little short of the quantile of the noncentral distribution: a power of 0.77.
    """
    rng, found = np.random.default_rng(3), []
    for _ in range(600):
        means = rng.normal(size=len(sizes))
        found.append(
            estimate(
                {(f"s{s}", (8, 0), (str(k),)): means[s] + rng.normal() for s, n in enumerate(sizes) for k in range(n)},
                draws=2,
            )
        )
    degrees = len(sizes) - 1
    factor = stats.t.ppf(0.975, degrees) + stats.t.ppf(0.8, degrees)
    size = np.sqrt(np.mean([one.detectable**2 for one in found]))  # squares of standard errors are unbiased
    for true, share, room in ((size, 0.79, 0.055), (0.0, 0.05, 0.027)):
        told = [abs(one.mean + true) > stats.t.ppf(0.975, degrees) * one.detectable / factor for one in found]
        assert abs(np.mean(told) - share) < room


def test_intervals_are_explained_for_what_is_there():
    """The number of scenes, the coverage and the degrees of freedom of this table; lines that are not there, and pairs
    too few for a verdict, are no intervals that could exclude 0.
    """

    def said(scenes, seeds, more=()):
        rows = [row_of(f"s{k}", policy=p, seed=s, psnr=s) for p in ("p", "r") for k in range(scenes) for s in seeds]
        pairs = [("p", "r"), ("nobody", "r"), ("few", "r")]
        return explained(small(Path("x")), [*rows, *more], pairs)

    many = said(8, range(5), [row_of("s0", policy="few", seed=s, psnr=s) for s in range(2)])
    assert "bootstrap over 8 scenes first" in many
    assert "Of 8 scenes the interval holds the true mean in about 95 % of studies." in many
    assert "about 0.2 of the 3 intervals" in many, "three metrics of the one pair that has at least six units"
    assert "a t test of 8 scenes (7 degrees of freedom, 5 % of false alarms)" in many
    three = said(3, range(4))
    assert "Of 3 scenes that differ as much as their units do, the interval holds the true mean in about 82 %" in three
    assert "about 0.5 of the 3 intervals would exclude" in three
    assert "a t test of 3 scenes (2 degrees" in three
    one = said(1, range(3))
    assert "bootstrap over the 3 units of one scene" in one
    assert "Of 3 units the interval holds the true mean in about 75 % of studies." in one
    assert "No verdicts: 3 units cannot" in one
    assert "95 % of studies" not in three + one
    assert "no interval" in said(1, [0])
    assert "every scene counts alike" not in one


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sizes", "spread", "share"),
    [
        ((3, 3, 6), 0.0, 0.94),
        ((3, 3, 6), 0.5, 0.89),
        ((3, 3, 6), 1.0, 0.82),
        ((1, 1, 1), 0.0, 0.75),
        ((3,), 0.0, 0.75),
        ((3,) * 4, 1.0, 0.86),
        ((5,) * 8, 0.5, 0.95),
    ],
)
def test_how_often_intervals_hold_the_truth(rng, sizes, spread, share):
    """The shares that study_statistics states, of scenes whose means spread that much as units of one scene do.

    Within 4 standard errors of a share in as many studies, and 0.005 of rounding.
    """
    studies, held = 1000, 0
    for _ in range(studies):
        means = spread * rng.normal(size=len(sizes))
        values = {
            (f"s{s}", (8, 0), (str(k),)): float(means[s] + rng.normal()) for s, n in enumerate(sizes) for k in range(n)
        }
        found = estimate(values, draws=1000)
        held += found.low <= 0 <= found.high
    assert abs(held / studies - share) < 4 * np.sqrt(share * (1 - share) / studies) + 0.005
    if spread == (0.5 if len(sizes) >= 8 else 1.0) or len(set(sizes)) == len(sizes) == 1 or sizes == (1, 1, 1):
        assert coverage(len(sizes), sum(sizes)) == share


def told(rows):
    """How a table of differences is to be read, and the table."""
    study = dataclasses.replace(small(Path("x")), policies={"p": {}, "Random, 1": {}})
    pairs = [("p", "Random, 1")]
    return f"{explained(study, rows, pairs)}\n{comparison_table(study, rows, pairs)}"


def test_a_table_says_gain_and_loss():
    """Larger PSNR is a gain, the same of FLIP a loss; noise is neither; few units: no verdict."""
    rng = np.random.default_rng(0)
    rows = []
    for seed in range(8):
        base = float(rng.normal())
        rows += [row_of(policy="p", seed=seed, psnr=base + 2 + 0.1 * float(rng.normal()))]
        rows += [row_of(policy="Random, 1", seed=seed, psnr=base)]
    text = told(rows)
    line = next(line for line in text.splitlines() if line.startswith("| p | +"))
    assert "**gain**, 8 of 8" in line
    assert "**loss**, 0 of 8" in line
    assert "Were all policies equal, about 0.4 of the 3 intervals would exclude it as well." in text
    for row in rows[::2]:
        row["metrics"]["psnr"] = row["metrics"]["flip"] = float(rng.normal())
    line = next(line for line in told(rows).splitlines() if line.startswith("| p | "))
    assert "**" not in line
    few = told(rows[:6])
    assert "No verdicts: 3 units" in few
    assert "**gain**" not in few
    single = next(line for line in told(rows[:2]).splitlines() if line.startswith("| p |") and ", 1 unit |" in line)
    assert "[" not in single  # an interval of one unit would have no width


def test_text_between_markers(tmp_path):
    """What stands between the two is replaced; a page without them is refused."""
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- x: begin -->\nold\n<!-- x: end -->\nb\n")
    fill_between(page, "x", "new")
    assert page.read_text() == "a\n<!-- x: begin -->\n\nnew\n\n<!-- x: end -->\nb\n"
    with pytest.raises(ValueError, match="must have <!-- y: begin --> and <!-- y: end -->"):
        fill_between(page, "y", "new")


def test_curves_are_of_the_metrics_of_then(tmp_path):
    """At each number of views that was measured, the end among them; rows that were not measured on the way count at
    the end only; the picture has a panel a scene.
    """
    rows = []
    for seed in range(6):
        for policy, less in (("p", 0.0), ("Random, 1", 1.0)):
            curve = {str(n): {"psnr": 10.0 + n - less * n, "flip": 1.0, "steps": n} for n in (3, 4)}
            row = row_of(policy=policy, seed=seed, psnr=30.0 - less, picks=["a", "b", "c", "d"], curve=curve)
            rows.append({**row, "initial": [f"v{seed}", "w"]})
    rows.append({**row_of(policy="p", seed=7, psnr=30.0, picks=["a"] * 4), "initial": ["v7", "w"]})
    assert view_counts(rows) == [3, 4, 6]
    assert [row["metrics"]["psnr"] for row in at_views(rows, 4)[:2]] == [14.0, 10.0]
    assert len(at_views(rows, 6)) == 13
    assert view_counts(rows[-1:]) == []
    study = dataclasses.replace(small(tmp_path), policies={"p": {}, "Random, 1": {}})
    assert not draw_curves(study, rows[-1:], METRICS[0], tmp_path / "none.png")
    pytest.importorskip("matplotlib")
    for scenes in (1, 5):
        there = [{**row, "scene": f"s{k}"} for k in range(scenes) for row in rows]
        assert draw_curves(study, there, METRICS[0], tmp_path / f"{scenes}.png")
        assert (tmp_path / f"{scenes}.png").stat().st_size > 5000


def test_a_page_comes_from_its_rows(monkeypatch):
    """The table of docs/next-views.md and its data files are what benchmarks/policies.py makes of its rows; of the
    differences, whose intervals take long, those of PSNR.
    """
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(root / "benchmarks")
    policies, studies = importlib.import_module("policies"), importlib.import_module("studies")
    rows = read_study(policies.ROWS)
    assert {row["policy"] for row in rows} == {policies.DEFAULT, *policies.OTHERS}
    assert policies.table(rows) in policies.PAGE.read_text()
    for name, lines in (
        ("scenes", policies.scene_lines(rows)),
        ("units", policies.unit_lines(rows)),
        ("choosing", policies.choosing_lines(read_study(policies.CHOSEN))),
    ):
        assert (policies.DATA / f"policies-{name}.csv").read_text() == studies.csv_text(lines), name
    there = (policies.DATA / "policies-differences.csv").read_text().splitlines(keepends=True)
    made = studies.csv_text(policies.difference_lines(rows, policies.METRICS[:1]))
    assert made == "".join(line for line in there if ",psnr," in line or line is there[0])


def test_the_semantic_data_files_come_from_their_rows(monkeypatch, tmp_path):
    """Of the data files those that have no intervals, which take long."""
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(root / "benchmarks")
    semantic, studies = importlib.import_module("semantic"), importlib.import_module("studies")
    study = dataclasses.replace(semantic.study_of("small", tmp_path), comparisons=())
    rows = [row for row in read_study(root / "benchmarks" / "static.jsonl") if row["study"] == study.name]
    monkeypatch.setattr(studies, "difference", lambda *args: iter(()))
    sheets = studies.study_sheets(study, rows)
    assert sheets["differences"] == [["protocol", "policy", "against", "metric", *studies.DIFFERENCE]]
    for name in ("units", "scenes"):
        there = (studies.PAGE_DATA / f"semantic-{name}.csv").read_text()
        assert there == studies.csv_text(sheets[name]), name


def test_data_files_come_from_their_rows(monkeypatch):
    """Those of benchmarks/predict.py and benchmarks/uncertainty.py, which make them without running anything."""
    root = Path(__file__).parents[1]
    monkeypatch.syspath_prepend(root / "benchmarks")
    predict, uncertainty = importlib.import_module("predict"), importlib.import_module("uncertainty")
    written = {}
    for module, words in ((predict, ["--page"]), (uncertainty, [])):
        monkeypatch.setattr(module.studies, "write_csv", lambda path, lines: written.update({path: list(lines)}))
        monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *words])
        assert not module.main()
    assert sorted(path.name for path in written) == ["predict-psnr.csv", "predict.csv", "uncertainty.csv"]
    for path, lines in written.items():
        assert path.read_text() == predict.studies.csv_text(lines), path.name


def test_auto_of_lenses_is_what_the_run_has_made_of_it(tmp_path):
    """A cell that leaves it to the photographs goes on with its run, whose config.json says what that was."""
    run = Run(tmp_path / "run")
    done = FitConfig().replace(renderers=("fast",), undistort="off")
    run.start({"schema": 1, "command": "fit", "data": str(tmp_path), "train": ["a"], "test": [], "fit": done.to_json()})
    engine._check_same(run, FitConfig().replace(renderers=("fast",)))
    with pytest.raises(ValueError, match="must be the run of this cell, undistort was 'off' and is 'on'"):
        engine._check_same(run, FitConfig().replace(renderers=("fast",), undistort="on"))
