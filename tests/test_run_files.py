"""docs/run-files.md against the files that are written: every field is told, and every field that is told is there."""

from __future__ import annotations

import json
import re

import pytest
from doc_pages import ROOT
from test_active import SIZE, config, lazily, plan, write_still

from drgs import cli
from drgs.cameras import orbit
from drgs.data import load
from drgs.data.camera_lists import save_cameras_json
from drgs.train import ActiveConfig, fit

_PAGE = (ROOT / "docs" / "run-files.md").read_text(encoding="utf-8")
_SOMETIMES = {
    "config.json": {"frames", "absent", "semantics", "times"},
    "metrics.json": {"segmentation", "motion"},
}
"""Fields of data sets that the tests here do not make: videos, missing images, a teacher, several times."""


def _rows(title: str) -> list[tuple[set[str], set[str]]]:
    """The names in the first cell of each row of a section's tables, and those in its other cells."""
    section = _PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    cells = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| `")]
    assert cells
    return [(_names(first), _names(" ".join(others))) for first, *others in cells]


def _names(text: str) -> set[str]:
    return set(re.findall(r"`([\w, -]+)`", text))


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
    fit(lazily(folder / "data"), folder / "active", config(max_steps=12), active=plan(measure=(3,)), progress=False)
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


def test_evaluating_keeps_what_the_fit_said(place):
    """`drgs eval` writes the same fields, and those of the fit with the same values."""
    fitted = _read(place / "active/metrics.json")
    assert cli.main(["eval", str(place / "active"), "--quiet"]) == 0
    again = _read(place / "active/metrics.json")
    assert set(again) == set(fitted)
    for name in ("step", "seconds", "bad_steps", "fitted", "pool_leak", "split_rule", "gaussians"):
        assert again[name] == fitted[name], name


def test_metrics_inside(place):
    """Of views, and of what viewers show."""
    metrics = _read(place / "all/metrics.json")
    measured = {name for name in re.findall(r"`(\w+)`", _PAGE.split("The metrics of a view are ")[1].split(".")[0])}
    assert set(metrics["mean"]) <= measured
    assert set(metrics["views"][0]) == _told_of("metrics.json", "views") | set(metrics["mean"])
    assert set(metrics["viewers"]) == _told_of("metrics.json", "viewers")


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
    own = set(active) - set(ActiveConfig().to_json())
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
    assert set(report) | set(view) == _fields("fisher.json") | {"schema"}
    assert set(report["groups"]["means"]) == _told_of("fisher.json", "groups")
    for map_name, criterion in (("variance", "eig"), ("share", "logdet")):
        assert view[map_name]["sum"] == pytest.approx(view["gain"][criterion], rel=1e-4)
    assert report["prior"]["value"] == 1
