"""`drgs stress`: its table and files, and that it fails where the renderer does."""

from __future__ import annotations

import dataclasses
import json
import warnings

import numpy as np
import pytest
import torch
from scenes_random import camera

from drgs import cli, fisher
from drgs.lab import accuracy, extremes, stress

pytestmark = pytest.mark.core

TWO = "Gaussian, `gsplat`"  # two cases, on tiles
NAMES = {"1 Gaussian, `gsplat`", "camera inside a Gaussian, `gsplat`"}
# Every item of the design's list of extremes, and part of a name.


def run(monkeypatch, tmp_path, match=TWO):
    """Exit code and rows of the command."""
    monkeypatch.chdir(tmp_path)
    code = cli.main(["stress", "--match", match, "-o", "out"])
    return code, json.loads((tmp_path / "out/stress.json").read_text())


def test_table_and_files(monkeypatch, tmp_path, capsys):
    """Two cases hold: a line each, JSON and Markdown with the same rows, exit code 0."""
    code, report = run(monkeypatch, tmp_path)
    text = capsys.readouterr().out
    assert code == 0, text
    assert {row["case"] for row in report["rows"]} == NAMES
    assert report["verdicts"] == {"holds": 2, "warns": 0, "FAILS": 0}
    assert report["env"]["backend"]["variant"]
    table = (tmp_path / "out/stress.md").read_text()
    for row in report["rows"]:
        assert row["finite"] is True
        assert row["traversal"] == "tiles"
        for name, bound in stress.BOUNDS.items():
            assert 0 <= row[name] <= bound
        assert row["gradient"] > 0
        assert f"| {row['case']} | tiles |" in table
        assert row["case"] in text
    assert "2 rows" in text


@pytest.mark.parametrize("what", ["image", "gradient", "forward", "duality", "fisher", "finite"])
def test_a_broken_renderer_fails(monkeypatch, tmp_path, capsys, what):
    """Any one number that is wrong: exit code 1, and the case is named with the bound it breaks."""
    if what == "fisher":
        true = fisher.diagonal

        def diagonal(*args):
            return {name: 1.001 * x for name, x in true(*args).items()}

        monkeypatch.setattr(fisher, "diagonal", diagonal)
    elif what in ("image", "finite"):
        true, error = accuracy.render, 1e-3 if what == "image" else float("nan")
        monkeypatch.setattr(
            accuracy, "render", lambda *a, **k: dataclasses.replace(out := true(*a, **k), rgb=out.rgb + error)
        )
    elif what == "gradient":
        true = accuracy.gradients
        monkeypatch.setattr(accuracy, "gradients", lambda *a: {n: x * 1.001 for n, x in true(*a).items()})
    elif what == "forward":
        true = accuracy.render_jvp
        monkeypatch.setattr(
            accuracy, "render_jvp", lambda *a, **k: dataclasses.replace(out := true(*a, **k), rgb=out.rgb * 1.001)
        )
    else:  # of duality alone: a bound that nothing meets
        monkeypatch.setitem(stress.BOUNDS, "duality", -1.0)
    code, report = run(monkeypatch, tmp_path)
    text = capsys.readouterr().out
    assert code == 1
    assert report["verdicts"]["FAILS"] == 2
    for row in report["rows"]:
        assert f"FAILS: {row['case']} on tiles" in text
        assert row["finite"] is (what != "finite")
        if what != "finite":
            assert what in row["remark"]


def test_what_raises_becomes_a_row(monkeypatch, tmp_path, capsys):
    """The run goes on; the message is in the table, on one line."""
    true = stress.compare

    def broken(g, *args):
        if len(g) == 1:
            raise RuntimeError("a kernel\nwas not compiled")
        return true(g, *args)

    monkeypatch.setattr(stress, "compare", broken)
    code, report = run(monkeypatch, tmp_path)
    assert code == 1
    rows = {row["case"]: row for row in report["rows"]}
    assert set(rows) == NAMES
    bad = rows.pop("1 Gaussian, `gsplat`")
    assert bad["verdict"] == "FAILS"
    assert bad["remark"] == "raised RuntimeError: a kernel was not compiled"
    assert [bad[name] for name in stress.BOUNDS] == [None] * 5
    assert [row["verdict"] for row in rows.values()] == ["holds"]
    assert "raised RuntimeError" in capsys.readouterr().out


def test_a_scene_that_cannot_be_built_is_a_row_for_each_traversal():
    """So is what goes wrong before the renderer is called."""
    case = extremes.ExtremeCase("broken", lambda rng: 1 / 0)
    rows = list(stress.rows(case))
    assert [row.traversal for row in rows] == ["tiles", "bvh"]
    assert all(row.verdict == "FAILS" and "ZeroDivisionError" in row.remark for row in rows)


@pytest.mark.parametrize("expected", [True, False])
def test_warnings_are_part_of_the_verdict(monkeypatch, expected):
    """A warning that is missing, or that nothing asks for, fails the row."""
    case = next(c for c in extremes.CASES if c.name == "0 Gaussians")
    case = dataclasses.replace(case, bvh="warns" if expected else "holds")
    if not expected:
        true = stress.compare

        def loud(*args):
            warnings.warn("use traversal='tiles'", stacklevel=1)
            return true(*args)

        monkeypatch.setattr(stress, "compare", loud)
    row = stress.row_of(case, "bvh", stress.truth_of(case))
    assert row.verdict == "FAILS"
    assert ("no warning" if expected else "a warning without need") in row.remark


def test_what_is_not_refused_fails():
    """Silence, another message, and an error where a warning was due."""

    def silent():
        yield lambda: 1, "must"

    def other():
        yield lambda: int("x"), "must be finite"

    for attempts in (silent, other):
        row = stress.refused(extremes.Refusal("a", attempts))
        assert row.verdict == "FAILS"
        assert "attempt 1" in row.remark
    assert stress.refused(extremes.Refusal("a", other, warns=True)).verdict == "FAILS"


def test_names_are_unique():
    """`--match` chooses cases by their names, and a row is known by its own."""
    names = [case.name for case in (*extremes.CASES, *extremes.REFUSALS)]
    assert len(set(names)) == len(names)


def test_window_is_the_largest_without_ties():
    """Its pixels see the same rays."""
    cam = camera(np.random.default_rng(0), (9, 7))
    good = torch.ones(7, 9, dtype=torch.bool)
    good[2, 3] = good[6, 0] = False
    view = stress._window(cam, good, 63)
    # Rows 3 to 6 right of the first column, or rows 0 to 6 right of column 3: 32 and 35 pixels.
    assert (view.width, view.height) == (5, 7)
    assert np.allclose(view.pixel_directions(), cam.pixel_directions()[:, 4:])
    small = stress._window(cam, good, 12)
    assert (small.width, small.height) == (5, 2)


def test_bad_input(monkeypatch, tmp_path, capsys):
    """One line on stderr, exit code 2, nothing written."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["stress", "--match", "no such case", "-o", "out"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--match must be part of a case's name, got 'no such case'" in message
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    assert cli.main(["stress", "--match", TWO, "-o", "file"]) == 2
    assert "the output must be a folder" in capsys.readouterr().err
