"""`drgs reproduce`: which cells there are, what the tables say of their rows, figures, and what it refuses."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from json_page import check
from test_active import write_still
from test_dynamic_data import cameras, coded, write_dnerf, write_poses, write_video

from drgs import cli
from drgs.studies.experiments import EXPERIMENTS, SIZES, study_of
from drgs.studies.plan import plan_of
from drgs.studies.protocols import PROTOCOLS
from drgs.studies.results import best_of_units, results_page, results_rows
from drgs.studies.rows import Cell, read_study
from drgs.studies.statistics import at_views

DRGS = [sys.executable, "-m", "drgs"]


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """Photographs without labels or teacher."""
    folder = tmp_path_factory.mktemp("reproduce") / "still"
    write_still(folder)
    return folder


def rows_of(study, policies, units=3, **values) -> list[dict]:
    """A row for each policy and unit; `values` policy -> PSNR."""
    found = []
    for unit in range(units):
        for policy in policies:
            cell = Cell(f"room-{unit % 2 + 1}", (3, 0), "seed", policy, "paper", unit)
            metrics = {m.key: 0.5 for m in study.metrics} | {"psnr": values.get(policy, 20.0) + 0.1 * unit}
            found.append(
                {
                    "study": study.name,
                    **cell.to_json(),
                    "initial": [f"a{unit}", "b"],
                    "picks": [],
                    "metrics": metrics,
                    "medians": {},
                    "curve": {},
                    "views": 8,
                    "seconds": 90.0,
                    "peak_memory": 2_500_000_000 if policy != "uniform" else None,
                    "pick_seconds": 1.5,
                    "commit": "0123456789",
                }
            )
    return found


# --------------------------------------------------------------------------------------------------------------- plan


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_cells_of_made_scenes(name, tmp_path, monkeypatch):
    """Every policy on a unit before the next, as many units as scenes and seeds say; configs are legal and differ."""
    monkeypatch.setattr(
        "drgs.studies.plan.distinct_seeds", lambda study, scene, split, count, protocol: list(range(count))
    )
    for scale in ("tiny", "small", "paper"):
        plan = plan_of(name, scale, tmp_path, seeds=2)
        labels = list(plan.experiment.policies)
        scenes = 1 if scale == "tiny" or plan.experiment.study == "dynamic" else 2
        assert [cell.policy for cell in plan.cells] == 2 * scenes * labels
        assert len({cell.name for cell in plan.cells}) == len(plan.cells)
        assert len({repr(plan.study.config_of(cell)) for cell in plan.cells[: len(labels)]}) == len(labels)
        assert {plan.study.config_of(cell).data.init_points for cell in plan.cells} == {"all"}
    assert not list(tmp_path.iterdir()), "nothing is made before it is needed"


def test_protocols(tmp_path):
    """What a name does to the two configs of a cell, and that pool leaks are marked."""
    study = study_of("static", "paper", tmp_path)
    found = {name: study.config_of(Cell("room-1", (3, 0), "seed", "fisherrf", name, 0)) for name in PROTOCOLS}
    assert {name: fit.data.init_points for name, fit in found.items()} == {
        "blind": "views",
        "paper": "all",
        "fisherrf": "views",
        "nbv-gym": "views",
    }
    assert [name for name, x in PROTOCOLS.items() if x.leaks] == ["paper"]
    fit, active = found["paper"], found["paper"].selection
    assert (fit.max_steps, active.initial, active.every, active.add, active.restart) == (7000, 2, 200, None, "auto")
    assert found["fisherrf"].selection.restart == "always"
    few = found["nbv-gym"].selection
    assert (few.initial, few.every) == (10, 200)


def test_data_that_is_given(still, tmp_path):
    """Without a teacher: policies that need one are left out, said, and so are the numbers; split by --test-every."""
    plan = plan_of("static", "tiny", tmp_path, [still], seeds=2, split=(4, 1))
    assert {cell.scene for cell in plan.cells} == {"still"}
    assert {cell.split for cell in plan.cells} == {(4, 1)}
    assert "geometry+semantic, eig" not in {cell.policy for cell in plan.cells}
    assert plan.notes[0].startswith("still has no teacher's maps: its rows have no accuracies and no mIoU")
    assert "geometry+semantic, eig" in plan.notes[0]


def test_a_split_that_is_stated(still, tmp_path):
    """It counts whatever --test-every says, 0 included."""
    data = json.loads((still / "transforms.json").read_text())
    files = [frame["file_path"] for frame in data["frames"]]
    folder = tmp_path / "stated"
    folder.mkdir()
    for name in ("images", "masks", "depth"):
        (folder / name).symlink_to(still / name)
    stated = {**data, "test_filenames": files[:2], "train_filenames": files[2:]}
    (folder / "transforms.json").write_text(json.dumps(stated))
    for split in ((0, 0), (4, 1)):
        plan = plan_of("static", "tiny", tmp_path, [folder], seeds=1, split=split)
        assert {cell.split for cell in plan.cells} == {(0, 0)}
    with pytest.raises(ValueError, match="fit: test_every must be a whole number in .*, got -3"):
        plan_of("static", "tiny", tmp_path, [folder], seeds=1, split=(-3, 0))


def test_cameras_that_are_given(tmp_path):
    """Of videos the camera that the data set holds out; a static experiment refuses them."""
    folder = tmp_path / "filmed"
    folder.mkdir()
    write_poses(folder, cameras())
    for number in range(len(cameras())):
        write_video(folder / f"cam{number:02}.mp4", [coded(number, k) for k in range(4)])
    plan = plan_of("dynamic", "tiny", tmp_path, [folder], seeds=2, policies=["random"])
    assert [(cell.camera, cell.seed) for cell in plan.cells] == [("cam00", 0), ("cam00", 1)]
    with pytest.raises(ValueError, match="must show a scene at one time, shows several"):
        plan_of("static", "tiny", tmp_path, [folder])


def test_one_camera_that_films_what_moves(tmp_path):
    """In D-NeRF's layout each time has one photograph: seeds draw the views that a fit begins with, and the split is
    that of the files.
    """
    folder = tmp_path / "ball"
    folder.mkdir()
    write_dnerf(folder, {"train": tuple(t / 8 for t in range(9)), "test": (0.25, 0.75)})
    plan = plan_of("dynamic", "tiny", tmp_path, [folder], seeds=2, policies=["random"])
    assert [(cell.camera, cell.split, cell.start, cell.seed) for cell in plan.cells] == [
        ("", (0, 0), "seed", seed) for seed in range(2)
    ]
    selection = plan.study.config_of(plan.cells[0]).selection
    assert (selection.schedule, selection.initial, selection.add) == ("pairs", 6, 3)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"name": "dynamic", "protocol": "fisherrf"}, "must be one of blind, paper where things move, got fisherrf"),
        ({"name": "static", "policies": ["best"]}, "--policy must be one of: random; uniform; .* got 'best'"),
        ({"name": "static", "seeds": 0}, "--seeds must be at least 1"),
        ({"name": "dynamic", "given": True}, "must show a scene at several times, shows one"),
        ({"name": "static", "given": True, "split": (-3, 0)}, "fit: test_every must be a whole number in .*, got -3"),
        (
            {"name": "static", "given": True, "split": (1, 0)},
            "fit: test_every must be 0 .hold out none. or >= 2, got 1",
        ),
        ({"name": "static", "given": True, "split": (4, 9)}, "fit: test_offset must be in 0..3 .* got 9; lower it"),
        ({"name": "static", "given": True, "split": (0, 0)}, "must hold out views, holds out none"),
        ({"name": "static", "given": True, "protocol": "nbv-gym"}, "must have 13 training views for protocol nbv-gym"),
    ],
)
def test_what_cannot_be(options, told, still, tmp_path):
    """One line each."""
    options = {**options, "given": [still] if options.get("given") else []}
    with pytest.raises(ValueError, match=told) as error:
        plan_of(scale="tiny", made=tmp_path, **options)
    assert "\n" not in str(error.value)


# -------------------------------------------------------------------------------------------------------------- tables


def test_who_is_best(tmp_path):
    """Counted in units that all policies have, whatever is fitted to all views aside; equal ones both win."""
    study = study_of("dynamic", "small", tmp_path)
    rows = rows_of(
        study, ("random", "joint", "farthest", "all views"), joint=21.0, farthest=21.0, **{"all views": 30.0}
    )
    assert best_of_units(rows) == ({"random": 0, "joint": 3, "farthest": 3}, 3)
    assert best_of_units(rows[1:]) == ({"random": 0, "joint": 2, "farthest": 2}, 2)
    assert best_of_units([]) == ({}, 0)


def test_the_page(tmp_path):
    """Means, costs, the paper's numbers marked as another data set's, the leak, differences within units."""
    study, experiment = study_of("static", "small", tmp_path), EXPERIMENTS["static"]
    rows = rows_of(study, experiment.policies, units=6, fisherrf=22.0)
    text = results_page(study, experiment, rows, remarks=("Something is missing.",))
    line = next(x for x in text.splitlines() if x.startswith("| FisherRF |"))
    cells = [x.strip() for x in line.strip("|").split("|")]
    assert cells == ["FisherRF", "0.500", "22.25", *["0.500"] * 4, "6", "6", "1.50", "2.50", "1.50", "32.17"]
    assert next(x for x in text.splitlines() if x.startswith("| uniform |")).split("|")[11].strip() == "none"
    for words in ("Something is missing.", "Pool leak", "another data set and other", "best PSNR (of 6)"):
        assert words in text
    assert "+2.00 [+2.00, +2.00] **gain**, 6 of 6" in text
    found = {row["policy"]: row for row in results_rows(study, experiment, rows)}
    assert found["fisherrf"]["psnr"] == pytest.approx(22.25)
    assert found["fisherrf"]["best"] == {"units": 6, "of": 6}
    assert found["uniform"]["peak_memory"] is None
    assert "No cell is finished." in results_page(study, experiment, [])


def test_minutes_are_of_steps_and_picks(tmp_path):
    """What a fit takes: its steps and its picks; on the page and for machines. A row that knows no seconds has none."""
    study, experiment = study_of("static", "small", tmp_path), EXPERIMENTS["static"]
    rows = rows_of(study, ("random", "fisherrf", "uniform"))
    for row in rows:
        if row["policy"] == "fisherrf":
            row |= {"picks": ["a"] * 10, "pick_seconds": 63.0}
        if row["policy"] == "uniform":
            row["seconds"] = None
    text = results_page(study, experiment, rows)
    heads, *lines = ([x.strip() for x in line.strip("|").split("|")] for line in text.splitlines() if "|" in line)
    at = heads.index("minutes (steps and picks)")
    assert {line[0]: line[at] for line in lines[1:4]} == {"random": "1.50", "uniform": "none", "FisherRF": "12.00"}
    found = {row["policy"]: row["minutes"] for row in results_rows(study, experiment, rows)}
    assert found == {"random": pytest.approx(1.5), "fisherrf": pytest.approx(12.0), "uniform": None}


def test_means_of_different_units_are_said_to_be_such(tmp_path):
    """Each row says how many units it has; where they are not the same ones, a sentence says what compares."""
    study, experiment = study_of("static", "small", tmp_path), EXPERIMENTS["static"]
    rows = rows_of(study, ("random", "farthest"), units=6)
    sentence = "Means of rows with different units do not compare; the differences within units do."
    assert sentence not in results_page(study, experiment, rows)
    text = results_page(study, experiment, rows[:-3])
    assert sentence in text
    heads, *lines = ([x.strip() for x in line.strip("|").split("|")] for line in text.splitlines() if "|" in line)
    assert {line[0]: line[heads.index("units")] for line in lines[1:3]} == {"random": "5", "farthest": "4"}
    assert sentence in results_page(study, experiment, [rows[0], rows[3]]), "as many, but others"


def test_only_intervals_that_are_there_are_counted(tmp_path):
    """A policy that shares no unit with the reference has no line, and no interval that could exclude 0."""
    study, experiment = study_of("static", "small", tmp_path), EXPERIMENTS["static"]
    rows = rows_of(study, ("random", "farthest"), units=6)
    alone = [row | {"initial": ["c", "d"]} for row in rows_of(study, ("uniform",), units=1)]
    text = results_page(study, experiment, [*rows, *alone])
    assert text.count("**gain**, ") + text.count(", 0 of 6 |") == len(study.metrics)
    assert f"of the {len(study.metrics)} intervals would exclude" in " ".join(text.split())


def test_the_paper_is_quoted_as_it_stands():
    """Differences that its text states: 1.43 and 0.94 dB over FisherRF (so rounded), 0.08 and 0.24 over moments."""
    for name, joint, rival, moments in (
        ("static", "geometry+semantic, eig", 1.43, 0.08),
        ("dynamic", "joint", 0.95, 0.24),
    ):
        paper = EXPERIMENTS[name].paper
        assert paper[joint]["psnr"] - paper["fisherrf"]["psnr"] == pytest.approx(rival, abs=1e-9)
        assert paper[joint]["psnr"] - paper["moments"]["psnr"] == pytest.approx(moments, abs=1e-9)
    assert all(set(x.paper) <= set(x.policies) for x in EXPERIMENTS.values())


# --------------------------------------------------------------------------------------------------------- the command


def test_what_is_refused_leaves_nothing(still, tmp_path, capsys):
    """Weights that are not there, and a split that cannot be: one line before any fit, and no data set is remembered
    for the next call.
    """
    out = tmp_path / "out"
    line = ["reproduce", "static", "--scale", "tiny", "--seeds", "1", "--data", str(still), "-o", str(out), "--quiet"]
    for more, told in (
        (["--lpips-weights", str(tmp_path / "none.pth")], "must be weights of AlexNet or VGG16, found none"),
        (["--test-every", "1"], "test_every must be 0"),
    ):
        assert cli.main([*line, *more]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert told in said[-1]
        assert [path.name for path in out.glob("*") if not path.name.startswith(".")] == []


def test_rows_of_another_configuration(tmp_path, monkeypatch, capsys):
    """A folder has one configuration of a study: another --config, of fits or of picks, is refused before any cell, and
    that of before goes on. Rows alone, copied or of a time before this was kept, are taken as they are.
    """
    monkeypatch.setattr("drgs.commands.reproduce.run_cells", lambda *_: ([], {}))
    out, copied = tmp_path / "out", tmp_path / "copied"
    line = ["reproduce", "dynamic", "--scale", "tiny", "--seeds", "1", "--no-figures", "--quiet"]
    line += ["--policy", "random", "-o"]
    assert cli.main([*line, str(out)]) == 0
    for name, value, before in (("opacity_rate", 0.5, 0.05), ("every", 7, None)):
        config = tmp_path / f"{name}.toml"
        config.write_text(f"{name} = {value}\n")
        assert cli.main([*line, str(out), "--config", str(config)]) == 2
        (told,) = capsys.readouterr().err.splitlines()
        assert f"{out}: must be of one configuration of dynamic-tiny, {name} was {before} and is {value}; " in told
    assert cli.main([*line, str(out)]) == 0
    study = study_of("dynamic", "tiny", tmp_path)
    copied.mkdir()
    row = rows_of(study, ["random"], 1)[0] | Cell("kitchen-1", (0, 0), "first", "random", "paper", 0, "cam00").to_json()
    (copied / "rows.jsonl").write_text(json.dumps(row) + "\n")
    assert cli.main([*line, str(copied), "--config", str(config)]) == 0
    assert json.loads((copied / "dynamic.json").read_text())["finished"] == 1
    assert cli.main([*line, str(copied)]) == 2
    (out / "fits.json").write_text('{"dynamic-tiny": 3}')
    assert cli.main([*line, str(out)]) == 2
    assert "fits.json" in capsys.readouterr().err.splitlines()[-1]


def test_tables_without_figures(tmp_path, monkeypatch, capsys):
    """Figures that cannot be drawn take no tables with them."""

    def fail(*_):
        raise ValueError("no figures")

    monkeypatch.setattr("drgs.commands.reproduce.run_cells", lambda *_: ([], {}))
    monkeypatch.setattr("drgs.commands.reproduce._figures", fail)
    out = tmp_path / "out"
    assert cli.main(f"reproduce dynamic --scale tiny --seeds 1 --quiet --policy random -o {out}".split()) == 2
    assert "no figures" in capsys.readouterr().err
    assert (out / "dynamic.md").is_file()
    assert (out / "dynamic.json").is_file()


def test_workers_get_whole_paths(tmp_path, monkeypatch):
    """What is sent to workers, which have working directories of their own, does not depend on this one."""
    pytest.importorskip("cloudpickle")
    from drgs.cluster.payloads import Payload

    sent = []

    def run_cells(study, *rest):
        sent.append(Payload.of(study))
        return [], {}

    monkeypatch.setattr("drgs.commands.reproduce.run_cells", run_cells)
    monkeypatch.setattr("drgs.commands.reproduce.Lpips", lambda path: None)  # these would be weights
    monkeypatch.chdir(tmp_path)
    line = "reproduce dynamic --scale tiny --seeds 1 --no-figures --quiet -o out --lpips-weights w.pth --policy random"
    assert cli.main(line.split()) == 0
    study = pickle.loads(sent[0].data)
    assert study.lpips == tmp_path.resolve() / "w.pth"
    assert study.folder.args[2] == tmp_path.resolve() / "out" / "scenes" / "tiny"
    page = (tmp_path / "out" / "dynamic.md").read_text()
    assert "`drgs reproduce dynamic -o out --scale tiny --seeds 1 --protocol paper --policy random" in page
    assert "--lpips-weights w.pth --no-figures`" in page


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on(tmp_path):
    """SIGKILL in the middle of the second cell: the first is kept, the rest is done, tables and figures are there; what
    is finished is not done again, and a row that lost its end is.
    """
    out = tmp_path / "out"
    line = ["reproduce", "static", "--scale", "tiny", "--seeds", "1", "--policy", "random", "--policy", "farthest"]
    line += ["-o", str(out), "--quiet"]
    process = subprocess.Popen([*DRGS, *line], stderr=subprocess.PIPE)
    until = time.monotonic() + 240
    while time.monotonic() < until and process.poll() is None and not list(out.glob("runs/*/*farthest/log.jsonl")):
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    rows = out / "rows.jsonl"
    assert [row["policy"] for row in read_study(rows)] == ["random"]
    before = rows.read_bytes()
    (out / "static-maps").mkdir()
    (out / "static-maps" / "other.maps.png").write_bytes(b"of another data set")
    assert cli.main(line) == 0
    assert rows.read_bytes().startswith(before)
    found = read_study(rows)
    assert [row["policy"] for row in found] == ["random", "farthest"]
    assert all(row["peak_memory"] > 1e8 and row["pool_leak"] for row in found)
    assert all(row["metrics"]["miou"] > 0.05 for row in found)
    page = (out / "static.md").read_text()
    assert all(text in page for text in ("![", "| random |", "| farthest |", ".maps.png)"))
    assert "other.maps.png" not in page
    assert f"`drgs {line[0]} static -o {out} --scale tiny --seeds 1 --protocol paper --policy random --policy" in page
    written = json.loads((out / "static.json").read_text())
    assert [row["policy"] for row in written["rows"]] == ["random", "farthest"]
    check("reproduce.json", written, maps=("paper",))
    check("rows.jsonl", *found, maps=("metrics", "medians", "curve", "curve"))
    import cv2

    sheet = cv2.imread(str(out / "static.png"))
    height, width = sheet.shape[:2]
    assert width > 4 * 300, "four columns"
    assert height > 3 * 220, "two policies and the truth"
    assert np.std(sheet) > 20
    assert list((out / "static-maps").glob("*.maps.png"))
    stamp = rows.stat().st_mtime_ns
    assert cli.main([*line, "--no-figures"]) == 0
    assert rows.stat().st_mtime_ns == stamp, "nothing was left to do"
    assert at_views(found, 5), "two views and three picks"


def test_data_without_labels(still, tmp_path, capsys):
    """Rows without numbers of labels, said on stdout and on the page; another data set of that name is refused."""
    out = tmp_path / "out"
    line = ["reproduce", "static", "--scale", "tiny", "--seeds", "1", "--policy", "uniform", "--data", str(still)]
    line += ["-o", str(out)]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    assert "note: still has no teacher's maps" in said
    assert "mIoU" not in said.partition("Policies on static scenes")[2]
    row = read_study(out / "rows.jsonl")[0]
    assert row["metrics"]["miou"] is None
    assert row["metrics"]["psnr"] > 5
    page = " ".join((out / "static.md").read_text().split())
    assert "no accuracies and no mIoU" in page
    assert f"--data {still} --policy uniform --test-every 8 --test-offset 0`" in page
    write_still(tmp_path / "still")
    assert cli.main([*line[:-3], str(tmp_path / "still"), "-o", str(out)]) == 2
    assert "must be of one still, holds rows of" in capsys.readouterr().err


@pytest.mark.slow
def test_no_room_for_a_study(still, tmp_path):
    """A disk that is full in the middle: one line that says so, exit code 2, and nothing lost once there is room."""
    out = tmp_path / "out"
    line = ["reproduce", "static", "--scale", "tiny", "--seeds", "1", "--policy", "uniform", "--no-figures", "--quiet"]
    line += ["--data", str(still), "-o", str(out)]
    code = (
        "import resource, sys\n"
        "from drgs import cli\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "sys.exit(cli.main(sys.argv[1:]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *line], capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 2, done.stderr
    assert "free some space" in done.stderr
    assert "Traceback" not in done.stderr
    assert not read_study(out / "rows.jsonl")
    assert cli.main(line) == 0
    assert len(read_study(out / "rows.jsonl")) == 1


def test_sizes_are_those_of_the_paper():
    """7,000 steps and a view every 200 of them; 17,000 where things move."""
    assert (SIZES["static", "paper"].fit.max_steps, SIZES["static", "paper"].every) == (7000, 200)
    assert SIZES["dynamic", "paper"].fit.max_steps == 17_000


@pytest.mark.slow
def test_a_scheduler_that_is_not_there(tmp_path, capsys):
    """One line, before anything is made."""
    pytest.importorskip("distributed")
    line = ["reproduce", "static", "--scale", "tiny", "--scheduler", "127.0.0.1:9", "-o", str(tmp_path / "out")]
    assert cli.main(line) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert "127.0.0.1:9" in said[-1]
    assert not list((tmp_path / "out").glob("scenes/*/*/images")), "nothing was made"
