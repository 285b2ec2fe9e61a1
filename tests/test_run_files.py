"""docs/data/run-files.csv against the files that are written: every field is told, and what is told is there.

docs/run-files.md names the files, and the fields of those that a fit leaves. demo.json, reproduce.json and teach.json
are held to the rows where tests make them (test_demo.py, test_reproduce.py, test_teach.py), a data set's where its
scene is rendered (test_room.py, test_kitchen.py).
"""

from __future__ import annotations

import ast
import dataclasses
import json
import re

import json_page
import numpy as np
import pytest
from doc_pages import ROOT
from json_page import PAGE, check, section, titles
from json_page import names as _names
from test_active import SIZE, config, lazily, plan, write_still
from test_query import decoder, embeddings
from test_query import scene as labelled

from drgs import cli, runtime
from drgs.cameras import orbit
from drgs.commands import tradeoff
from drgs.data import load
from drgs.data.camera_lists import save_cameras_json
from drgs.features.decoder import save_decoder
from drgs.files import save_ply
from drgs.lab.crossval import Crop
from drgs.testing import random_scene
from drgs.train import SelectionConfig, fit

_SOMETIMES = {
    "config.json": {
        *{
            "begin",
            "frames",
            "absent",
            "semantics",
            "times",
            "poses",
            "exposure",
            "depth",
            "estimated",
            "lenses",
            "origin",
        },
    },
    "metrics.json": {"segmentation", "motion", "transients", "dropout", "pruned", "poses", "skybox", "scale"},
    "fisher.json": {"nuisances"},
}
"""Fields of data sets that the tests here do not make, videos, missing images, lenses, a teacher, several times; and of
what is not asked for: exposure, poses, a skybox, transients, dropout, pruning, larger pictures, eliminated unknowns;
of a fit that begins with the Gaussians of another one, and of a world far from 0.
"""


def _rows(title: str) -> list[tuple[set[str], set[str]]]:
    """The names among the fields of each row of a file, and those in their meaning."""
    return [(_names(first), _names(" ".join(others))) for first, *others in section(title)]


def _fields(title: str) -> set[str]:
    return set().union(*(first for first, _ in _rows(title)))


def _told_of(title: str, field: str) -> set[str]:
    return set().union(*(others for first, others in _rows(title) if field in first))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`all`, a fit to all views; `active`, one that picks; `out/fisher.json` and `selection.json` of the former."""
    folder = tmp_path_factory.mktemp("files")
    write_still(folder / "data")
    save_cameras_json(folder / "cameras.json", orbit((0, 0, 0), 3.0, 4, width=SIZE, height=20))
    fit(load(folder / "data"), folder / "all", config(max_steps=20), progress=False)
    fit(lazily(folder / "data"), folder / "active", config(max_steps=12, selection=plan(measure=(3,))), progress=False)
    run = str(folder / "all")
    assert cli.main(["fisher", run, "--limit", "1", "--pose", "--quiet", "-o", str(folder / "out")]) == 0
    candidates = ["--candidates", str(folder / "cameras.json"), "-o", str(folder / "selection.json")]
    assert cli.main(["select", run, *candidates, "--quiet"]) == 0
    return folder


def _read(path):
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["config.json", "metrics.json"])
def test_files_of_fits(place, name):
    """Of a fit to all views and of an active one."""
    found = set().union(*(_read(place / run / name) for run in ("all", "active"))) - {"schema"}
    assert found == _fields(name) - _SOMETIMES[name]


def test_why_there_is_no_skybox(place):
    """Of a fit whose photographs were asked, and of one that picks views."""
    recorded = [_read(place / run / "config.json")["skybox"] for run in ("all", "active")]
    assert set().union(*recorded) <= _told_of("config.json", "skybox")
    assert recorded[0]["reason"] is not None
    assert recorded[1] == {"gaussians": 0, "reason": "views are chosen on the way"}


def test_evaluating_keeps_what_the_fit_said(place):
    """`drgs eval` writes the same fields, and those of the fit with the same values."""
    fitted = _read(place / "active/metrics.json")
    assert cli.main(["eval", str(place / "active"), "--quiet"]) == 0
    again = _read(place / "active/metrics.json")
    assert set(again) == set(fitted)
    for name in ("step", "seconds", "bad_steps", "fitted", "pool_leak", "split_rule", "gaussians"):
        assert again[name] == fitted[name], name


def test_metrics_inside(place):
    """Of views, and of what each renderer shows."""
    metrics = _read(place / "all/metrics.json")
    measured = {name for name in re.findall(r"`(\w+)`", PAGE.split("The metrics of a view are ")[1].split(".")[0])}
    assert set(metrics["mean"]) <= measured
    assert set(metrics["views"][0]) == _told_of("metrics.json", "views") | set(metrics["mean"])
    (row, *_) = metrics["renderers"]["rows"]
    told = _told_of("metrics.json", "renderers")
    assert {*metrics["renderers"], *row, *row["worst"], *row["views"][0]} <= told
    assert metrics["scores"] == metrics["mean"]  # of a run without labels


def test_log(place):
    """Every event that was logged, with its fields."""
    logged = set()
    for run in ("all", "active"):
        for line in (place / run / "log.jsonl").read_text(encoding="utf-8").splitlines():
            event = json.loads(line)
            logged.add(event["event"])
            assert set(event) - {"schema", "time", "event", "step"} <= _told_of("log.jsonl", event["event"]), event
    assert {"start", "train", "preview", "density", "pick", "checkpoint", "done"} <= logged <= _fields("log.jsonl")


def test_selections(place):
    """Of `drgs select` and of an active fit, down to a pick and a candidate."""
    chosen, active = _read(place / "selection.json"), _read(place / "active/selection.json")
    title = "selection.json"
    own = set(active) - set(SelectionConfig().flat())
    assert set(chosen) | own | {"start"} == _fields(title) | {"schema", "measured"}
    assert active["measured"]
    for record in (chosen["picks"][0], active["picks"][0], *active["picks"][0]["candidates"], chosen["candidates"][0]):
        told = _told_of(title, "picks") | _told_of(title, "candidates")
        assert set(record) <= told, set(record) - told
    assert set(chosen["candidates"][0]) == _told_of(title, "candidates")
    assert set(active["measured"][0]) <= _told_of(title, "measured")


def test_fisher(place):
    """Its fields, a group's and a view's; and what is said about the sums of maps."""
    report = _read(place / "out/fisher.json")
    view = report["views"][0]
    assert set(report) | set(view) == _fields("fisher.json") - _SOMETIMES["fisher.json"] | {"schema"}
    assert set(report["groups"]["means"]) == _told_of("fisher.json", "groups")
    for map_name, criterion in (("variance", "eig"), ("share", "logdet")):
        assert view[map_name]["sum"] == pytest.approx(view["gain"][criterion], rel=1e-4)
    assert report["prior"]["value"] == 1


_WRITERS = {
    "capturing/next_views.py": {"next.json"},
    "capturing/record.py": {"capture.json"},
    "commands/crossval.py": {"crossval.json"},
    "commands/demo.py": {"demo.json"},
    "commands/fisher.py": {"fisher.json"},
    "commands/prune.py": {"prune.json"},
    "commands/query.py": {"query.json"},
    "commands/render.py": {"render.json"},
    "commands/reproduce.py": {"reproduce.json"},  # and data.json, a map
    "commands/select.py": {"selection.json"},
    "commands/stress.py": {"stress.json"},
    "commands/teach.py": {"teach.json", "classes.json"},
    "commands/tradeoff.py": {"tradeoff.json"},
    "data/camera_lists.py": {"cameras.json"},
    "sfm/image_folder.py": {"frames.json"},
    "data/dataset.py": {"held_out.json"},
    "io/run.py": {"config.json", "env.json", "log.jsonl"},
    "fitting/active.py": {"selection.json"},
    "fitting/metrics.py": {"metrics.json"},
}
"""Module that writes JSON for users -> the files whose fields are told."""
_OTHERS = {
    "codecs/glb.py",  # the header of a .glb
    "codecs/sog.py",  # the index in a .sog
    "commands/info.py",  # stdout
    "commands/report.py",  # options on a line of a report
    "data/camera_path.py",  # flight.json: docs/view.md
    "data/reader_process.py",  # between processes
    "io/checkpoint.py",  # the header of a checkpoint
    "io/journal.py",  # lines of log.jsonl, rows.jsonl, .drgs.jsonl
    "io/json_files.py",  # a message
    "io/locks.py",  # .drgs.lock
    "io/outputs.py",  # .drgs.jsonl
    "pages/report/page.py",  # a cell of the report
    "pages/sharing/page.py",  # what a page is told
    "planner/file.py",  # the header of Planner.save's file: docs/planner.md
}
"""Modules that make JSON which is no such file."""


@pytest.mark.parametrize("title", ["config.json", "log.jsonl", "metrics.json", "selection.json"])
def test_the_page_names_every_field(title):
    """Of the files that a fit leaves, at the top; what is inside of a field is in the table alone."""
    told = PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    common = PAGE.partition("**Common fields**")[2].partition("\n\n")[0]
    assert _fields(title) - _names(told) - _names(common) == set()


@pytest.mark.parametrize("title", sorted(titles()))
def test_the_page_names_every_file(title):
    """In the table of other files, or under a heading."""
    assert f"`{title}`" in PAGE or f"\n## {title}\n" in PAGE


def test_every_writer_has_its_rows():
    """A module that calls `write_json`, or makes JSON itself, has rows for its files; no other file has."""
    found = set()
    for path in (ROOT / "drgs").rglob("*.py"):
        if any(
            isinstance(node, ast.Call) and ast.unparse(node.func) in ("write_json", "json.dumps", "json.dump")
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        ):
            found.add(path.relative_to(ROOT / "drgs").as_posix())
    assert found == {*_WRITERS, *_OTHERS}
    # By scenes/, and appended to by studies/rows.py.
    made = {"params.json", "teacher.json", "truth.json", "motion.json", "rows.jsonl"}
    assert set().union(*_WRITERS.values()) | made == titles()


def test_the_check_finds_what_is_missing(monkeypatch):
    """A field that is not told, at any depth, and one that no file has."""
    monkeypatch.setattr(
        json_page, "ROWS", [{"file": "a.json", "part": "", "field": "`one`, `two`", "meaning": "`three`"}]
    )
    whole = {"schema": 1, "one": 1, "two": [{"three": 3}]}
    check("a.json", whole)
    check("a.json", {**whole, "two": [{"chair": {"three": 3}}]}, maps=("two",))
    with pytest.raises(AssertionError, match=r"does not tell: \['four'\]"):
        check("a.json", {**whole, "two": [{"three": {"four": 4}}]})
    with pytest.raises(AssertionError, match=r"what no a.json has: \['two'\]"):
        check("a.json", {"one": {"three": 3}})


def test_env(place):
    """Where a fit ran."""
    on_card = runtime.backend().name == "cuda"
    check("env.json", _read(place / "all/env.json"), maps=("packages",), absent=("lanes",) if on_card else ())


def test_render_and_query(place):
    """With a film, PLY files and maps; what a text means in a PLY with its decoder."""
    cameras = ["--cameras", str(place / "cameras.json"), "--limit", "1", "--quiet"]
    made = ["--format", "png,webm,ply", "--depth", "-o", str(place / "rendered")]
    assert cli.main(["render", str(place / "all"), *cameras, *made]) == 0
    flown = [
        "--path",
        str(place / "flight.json"),
        "--frames",
        "2",
        "--width",
        "24",
        "-o",
        str(place / "flown"),
        "--quiet",
    ]
    key = {"position": [0, 0, -3], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": 0}
    (place / "flight.json").write_text(json.dumps({"keyframes": [key, key | {"seconds": 1}]}))
    assert cli.main(["render", str(place / "all"), *flown]) == 0
    check("render.json", *(_read(place / name / "render.json") for name in ("rendered", "flown")))
    check("cameras.json", _read(place / "rendered/cameras.json"), absent=("time",))
    save_ply(labelled(), place / "labelled.ply")
    save_decoder(decoder(), place / "decoder.pth")
    np.save(place / "chair.npy", embeddings()[1].numpy())
    wanted = ["--text-embedding", str(place / "chair.npy"), "--threshold", "0.9"]
    given = ["--decoder", str(place / "decoder.pth"), "-o", str(place / "found")]
    assert cli.main(["query", str(place / "labelled.ply"), *cameras, *wanted, *given]) == 0
    check("query.json", _read(place / "found/query.json"))


@pytest.mark.slow
def test_crossval_tradeoff_and_stress(tmp_path, monkeypatch):
    """Of a rasterizer that is wrong forward, with its ladder, and of one with another convention; of a small scene; of
    a case.
    """
    g, cameras = random_scene(0, count=20, width=16, height=12)
    save_ply(g, tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "cameras.json", cameras)
    (tmp_path / "dark_rasterizer.py").write_text(
        "import torch_rasterizer\n"
        "def dark(**arguments):\n"
        "    image, alpha, info = torch_rasterizer.rasterization(**arguments)\n"
        "    return 0.75 * image, alpha, info\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    seen = [str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--quiet"]
    made = []
    for name, ladder in (("dark_rasterizer:dark", ()), ("torch_rasterizer:defect_channels_swapped", ("--no-ladder",))):
        options = ["--preset", "gsplat", "--set", "background=0.3,0.6,0.2", "-o", str(tmp_path / "crossval"), *ladder]
        assert cli.main(["crossval", *seen, "--rasterizer", name, *options]) == 0
        made.append(_read(tmp_path / "crossval/crossval.json"))
    crop = {"crops": [dataclasses.asdict(Crop(0, 0, 8, 8, [16, 12]))]}  # only of a large scene
    groups = ("groups", "not_offered", "gradient", "switched")
    check("crossval.json", *made, crop, maps=groups, elsewhere=("start", "end"))
    monkeypatch.setattr(tradeoff, "TRADEOFF_VARIANTS", tradeoff.TRADEOFF_VARIANTS[::4])  # their rows have the same keys
    assert cli.main(["tradeoff", *seen, "--repeats", "1", "--seconds", "1", "-o", str(tmp_path / "tradeoff")]) == 0
    uses = ("full", "scatter", "times", "seconds", "ratio", "notes", "groups")
    report = _read(tmp_path / "tradeoff/tradeoff.json")
    check("tradeoff.json", report, maps=uses, elsewhere=("views", "fields"))
    assert cli.main(["stress", "--match", "D = 1", "--quiet", "-o", str(tmp_path / "stress")]) == 0
    check("stress.json", _read(tmp_path / "stress/stress.json"))
