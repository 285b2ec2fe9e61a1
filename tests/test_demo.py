"""`drgs demo --quick`: every stage runs, and the numbers it prints are sane."""

from __future__ import annotations

import contextlib
import io
import json
import re

import pytest
from json_page import check

from drgs import cli
from drgs.commands import demo


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder, the report and the text of one tiny demo."""
    out, said = tmp_path_factory.mktemp("demo") / "out", io.StringIO()
    with contextlib.redirect_stdout(said):
        report = demo.make_demo(out, demo.Plan.quick(), progress=True)
    return out, report, said.getvalue()


def test_files(result):
    """Pictures, video, run folder and JSON are there, and nothing half-written."""
    out, report, _ = result
    names = {path.name for path in out.iterdir()}
    pictures = {"overview.png", "comparison.png", "turntable.webm"}
    assert names == {".drgs.jsonl", "still_life", "run", "demo.json"} | pictures
    written = json.loads((out / "demo.json").read_text())
    assert written["presets"] == report["presets"]
    check("demo.json", written, maps=("seconds",), elsewhere=("mean",), absent=("total",))
    assert (out / "run" / "point_cloud.ply").is_file()


def test_picture_and_video(result):
    """The sheet has six columns; the video has the planned frames."""
    import cv2

    out, _, _ = result
    plan = demo.Plan.quick()
    sheet = cv2.imread(str(out / "comparison.png"))
    assert sheet.shape == (2 * (plan.height + 20), 6 * plan.width, 3)
    video, count = cv2.VideoCapture(str(out / "turntable.webm")), 0
    while video.read()[0]:
        count += 1
    assert count == plan.frames


def test_numbers(result):
    """`exact` is the oracle's image; the other presets are near it, each at its own distance."""
    _, report, _ = result
    rows = {row["preset"]: row for row in report["presets"]}
    assert set(rows) == {"exact", "fast", "inria", "gsplat", "3dgut", "mitsuba"}
    assert report["oracle"]["max_error"] < 1e-5
    assert rows["exact"]["psnr_to_exact"] is None
    assert all(25 < row["psnr_to_exact"] < 99 for name, row in rows.items() if name != "exact")
    assert rows["fast"]["psnr_to_exact"] > rows["inria"]["psnr_to_exact"]
    assert all(row["seconds"] > 0 for row in rows.values())
    assert report["peer"]["psnr_between"] > 20
    assert report["fit"]["mean"]["psnr"] > 10


def test_text(result):
    """What is said names the held-out views, the oracle and the files, without superlatives."""
    out, report, said = result
    text = said
    is_part = re.compile(r"\d\. ").match
    assert [line[0] for line in said.splitlines() if is_part(line)] == list("123456")
    assert max(len(line) for line in said.splitlines() if not is_part(line) and str(out) not in line) <= 80
    assert "never saw" in text
    assert f"{report['oracle']['max_error']:.1e}" in text
    assert str(out / "demo.json") in text


@pytest.mark.slow
def test_again(result, monkeypatch, capsys):
    """A second demo in the same folder keeps the still life and replaces the run."""
    out, _, _ = result
    assert cli.main(["eval", str(out / "run")]) == 0  # measured again: still the demo's own
    capsys.readouterr()
    stamp = (out / "still_life" / "params.json").stat().st_mtime_ns
    before = (out / "run" / "config.json").stat().st_mtime_ns
    assert cli.main(["demo", "--quick", "--quiet", "-o", str(out)]) == 0
    assert (out / "still_life" / "params.json").stat().st_mtime_ns == stamp
    assert (out / "run" / "config.json").stat().st_mtime_ns > before
    assert capsys.readouterr().out == ""


def test_bad_output(tmp_path, capsys):
    """A folder that holds something else is refused in one line, before anything is computed."""
    (tmp_path / "still_life").mkdir()
    (tmp_path / "still_life" / "mine.txt").touch()
    assert cli.main(["demo", "--quick", "-o", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["still_life", "mine.txt"]


def test_run_of_somebody_else_stays(result, tmp_path, capsys):
    """A fit in X/run, or a file that was added to the demo's own, is refused in one line and left as it is."""
    import shutil

    out, _, _ = result
    shutil.copytree(out / "run", tmp_path / "run")
    (tmp_path / "run" / ".drgs.jsonl").unlink()  # then it is as a `drgs fit` of the user's
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert cli.main(["demo", "--quick", "-o", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "must not be deleted, `drgs demo` did not make it" in error
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    (out / "run" / "renders" / "notes.txt").write_text("mine")
    assert cli.main(["demo", "--quick", "-o", str(out)]) == 2
    assert (out / "run" / "point_cloud.ply").is_file()
    (out / "run" / "renders" / "notes.txt").unlink()
