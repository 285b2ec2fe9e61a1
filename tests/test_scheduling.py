"""Claims of tests/scheduling.py: a test that hangs, or takes its process with it, fails once; all others are run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("xdist", reason="no pytest-xdist")

CONFTEST = """
from scheduling import FilesOnce

def pytest_xdist_make_scheduler(config, log):
    return FilesOnce(config, log)
"""
LAST_OF_TWO = "import {module}\ndef test_first(): pass\ndef test_last(): {end}\n"
ONE_OF_TWELVE = """
import os, pytest

@pytest.mark.parametrize("n", range(12))
def test_one(n):
    if n == 3:
        os.abort()
"""


@pytest.mark.slow
def test_each_test_has_one_turn(tmp_path):
    """Real processes that wait for ever, are killed and abort, at a file's end and within: each is named, with stacks
    where it waited, and what comes after it is run by others."""
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_waits.py").write_text(LAST_OF_TWO.format(module="threading", end="threading.Event().wait()"))
    (tmp_path / "test_ends.py").write_text(LAST_OF_TWO.format(module="os", end="os.kill(os.getpid(), 9)"))
    (tmp_path / "test_twelve.py").write_text(ONE_OF_TWELVE)
    (tmp_path / "test_alone.py").write_text("def test_alone(): pass\n")
    (tmp_path / "pytest.ini").touch()
    limits = ["-o", "faulthandler_timeout=3", "-o", "faulthandler_exit_on_timeout=true"]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, *limits, "-o", f"pythonpath={Path(__file__).parent}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    failed = re.findall(r"^FAILED (\S+)", done.stdout, re.MULTILINE)
    assert sorted(failed) == ["test_ends.py::test_last", "test_twelve.py::test_one[3]", "test_waits.py::test_last"]
    assert "3 failed, 14 passed" in done.stdout
    assert "in test_last" in done.stderr + done.stdout
