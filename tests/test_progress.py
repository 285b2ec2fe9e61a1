"""Progress: lines on a pipe from work of any kind, a bar on a terminal, nothing where it was not asked for."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
import types

import pytest

from drgs import cli
from drgs.display import progress
from drgs.display.progress import Bar


@pytest.fixture
def soon(monkeypatch):
    """Lines come after hundredths of a second."""
    monkeypatch.setattr(progress, "FIRST", 0.02)
    monkeypatch.setattr(progress, "EVERY", 0.1)
    monkeypatch.setattr(progress, "LEAST_OFTEN", 0.1)


def test_lines_of_a_silent_stage(soon, capsys):
    """A stage that never reports is named soon after its start and every so often; the thread ends with it."""
    with Bar("one long call", show=True):
        time.sleep(0.5)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 7  # 1 + 0.5 s / 0.1 s; fewer where the machine is busy
    assert set(lines) <= {"one long call: 0 s", "one long call: 1 s"}
    assert not [t for t in threading.enumerate() if t.name == "drgs progress"]
    assert (progress._bars, progress._output) == ([], None)


def test_lines_become_rarer(monkeypatch):
    """Every 2 s in the first 10 s of a stage, also late in a command of a minute; later up to 30 s apart."""
    for name, seconds in (("FIRST", 1.0), ("EVERY", 2.0), ("LEAST_OFTEN", 30.0)):
        monkeypatch.setattr(progress, name, seconds)
    now = [0.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    with Bar("fisher", show=True):
        now[0] = 40.0
        with Bar("residuals", 20) as bar:
            pauses = [progress._output.pause(bar, 40.0 + seconds) for seconds in (0, 10, 50, 1000)]
    assert pauses == pytest.approx([2, 2.5, 10, 30])


def test_lines_of_steps(soon, capsys):
    """Steps, their number, what else is known and the time that is left; the last line says that it is done."""
    with Bar("features", 4, show=True) as bar:
        time.sleep(0.1)
        bar.update(1, text="good")
        time.sleep(0.3)
        bar.update(4)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "features: 0 of 4, 0 s"
    assert any(line.startswith("features: 1 of 4, good, ") for line in lines)
    assert lines[-1] == "features: 4 of 4, good, 0 s"


def test_time_that_is_left(monkeypatch):
    """Of the steps done so far, and less while the next one is being done; nothing once that is over."""
    now = [100.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    with Bar("features", 10, show=False, done=2) as bar:
        now[0] = 106.0
        bar.update(4)
        assert bar.line() == "features: 4 of 10, 6 s, about 18 s left"
        now[0] = 116.0
        assert bar.line() == "features: 4 of 10, 16 s, about 8 s left"
        now[0] = 130.0
        assert bar.line() == "features: 4 of 10, 30 s"


def test_steps_that_compile_tell_nothing(monkeypatch):
    """The first ones of a fit, of every renderer, take many times as long: no time is told of them, now or later."""
    now = [0.0]
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    with Bar("fit", 400, show=False) as bar:
        for step in range(1, 25):
            now[0] += 30.0 if step <= 12 else 1.0
            bar.update(step)
            if step == 3:
                assert bar.line() == "fit: 3 of 400, 90 s"
        assert bar.line() == "fit: 24 of 400, 372 s, about 376 s left"
        bar.update(2)  # as a mapping that begins anew
        assert bar.line() == "fit: 2 of 400, 372 s"


def test_short_stages_are_silent(monkeypatch, capsys):
    """What takes less than a second needs no line."""
    monkeypatch.setattr(progress, "FIRST", 1.0)
    with Bar("outer", show=True), Bar("inner", 3) as bar:
        bar.advance()
    assert capsys.readouterr().err == ""


def test_nested(soon, capsys):
    """The innermost bar speaks; a library's bar is shown where the one around it is, and only there."""
    with Bar("alone"):
        time.sleep(0.1)
    with Bar("hidden", show=False), Bar("in hidden"):
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
    with Bar("outer", show=True), Bar("inner", 2) as bar:
        time.sleep(0.1)
        bar.stage("other", 0, 5)  # another stage, whose time starts now
        time.sleep(0.1)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()][:3] == [
        "inner: 0 of 2",
        "inner: 0 of 2",
        "other: 0 of 5",
    ]


def test_many_short_stages_are_not_silent(soon, monkeypatch, capsys):
    """Stages too short for a line of their own, one after the other, are reported all the same."""
    monkeypatch.setattr(progress, "FIRST", 0.08)
    with Bar("outer", show=True):
        for i in range(30):
            with Bar(f"stage {i}"):
                time.sleep(0.02)
    assert "stage" in capsys.readouterr().err


def test_notes(soon, capsys):
    """A note is a line of its own, and none where the bar is hidden."""
    for show in (True, False):
        with Bar("fit", 3, show) as bar:
            bar.note("added view 7")
    assert capsys.readouterr().err == "added view 7\n"


def test_failed_stage_says_nothing_at_its_end(soon, capsys):
    """After an error no line claims that the stage is done."""

    def fail():
        with Bar("features", 4, show=True):
            time.sleep(0.06)
            raise ValueError("bad")

    with pytest.raises(ValueError, match="bad"):
        fail()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["features: 0 of 4, 0 s"]
    assert progress._bars == []


@pytest.mark.parametrize("quiet", [False, True])
def test_every_command_reports(soon, monkeypatch, capsys, quiet):
    """A command that works without any bar of its own is not silent on a pipe, unless --quiet says so."""
    stub = types.SimpleNamespace(run=lambda args: time.sleep(0.15))
    monkeypatch.setitem(sys.modules, "drgs.commands.stress", stub)
    assert cli.main(["stress", *["--quiet"] * quiet]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert bool(lines) != quiet
    assert all(line.startswith("drgs stress: ") for line in lines)


def test_bar_on_a_terminal():
    """On a terminal of 80 columns the innermost bar is drawn, whole; notes stay, bars go."""
    pty = pytest.importorskip("pty")
    import os

    code = (
        "import time\nfrom drgs.display.progress import Bar\n"
        "with Bar('root', show=True, lines_only=True), Bar('fit', 3000, done=1500) as bar:\n"
        "    for i in range(1500, 1520):\n"
        "        bar.update(i, text='27.13 dB, 123456 Gaussians')\n        time.sleep(0.02)\n"
        "    bar.note('a note')\n    time.sleep(0.2)\n"
    )
    ours, theirs = pty.openpty()
    environ = {**os.environ, "COLUMNS": "80", "TERM": "xterm"}
    done = subprocess.Popen([sys.executable, "-c", code], stderr=theirs, stdout=subprocess.DEVNULL, env=environ)
    os.close(theirs)
    text = b""
    try:
        while chunk := os.read(ours, 4096):
            text += chunk
    except OSError:  # the other end is closed
        pass
    assert done.wait() == 0
    text = text.decode()
    assert "1519/3000" in text
    assert "27.13 dB, 123456 Gaussians" in text
    assert "a note" in text
    assert "root" not in text
    assert "…" not in text
