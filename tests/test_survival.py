"""Fits that end before their time: killed, without memory, without room on the disk, in a folder that is read-only."""

from __future__ import annotations

import importlib.util
import stat
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import torch
from test_active import write_still

from drgs import cli
from drgs.files import Run, load_state
from drgs.fitting.trainer import Trainer
from drgs.runtime.memory import is_out_of_memory

ROOT = Path(__file__).parents[1]
OPTIONS = "--max-steps 8 --max-gaussians 60 --sh-degree 1 --save-every 2 --deterministic --no-report --quiet"

# The command line, with something done to this process before its fifth step.
TROUBLED = """
import os, resource, sys
from pathlib import Path
from drgs import cli
from drgs.fitting.trainer import Trainer
run, trouble, step = Path(sys.argv[1]), sys.argv[2], Trainer.step
def in_trouble(self):
    if self.step_index == 4:
        if trouble == "disk":  # no file may grow beyond what a short line takes
            resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))
        elif trouble == "memory":
            held = int(next(x for x in open("/proc/self/status") if x.startswith("VmSize")).split()[1]) << 10
            resource.setrlimit(resource.RLIMIT_AS, (held, held))
            import torch
            self.rows.tensors["ballast"] = torch.ones(1 << 28)
        elif trouble == "folder":
            run.chmod(0o555)
            if os.geteuid() == 0:  # whom no permission stops, as long as this thread has CAP_DAC_OVERRIDE
                import ctypes
                libc, head, held = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
                assert libc.capget(head, held) == 0
                held[0], held[1] = held[0] & ~2, held[1] & ~2
                assert libc.capset(head, held) == 0
    return step(self)
Trainer.step = in_trouble
sys.exit(cli.main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def kills():
    """The benchmark that kills fits."""
    spec = importlib.util.spec_from_file_location("kills", ROOT / "benchmarks/kills.py")
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = before
    return module


@pytest.mark.slow
@pytest.mark.same_bits
def test_a_killed_fit_goes_on(kills, tmp_path):
    """Three kills at random moments: every file is whole, and the end has the bits and picks of a fit left in peace."""
    row = kills.campaign("active", tmp_path, kills=3)
    assert row["kills"] == 3
    assert row["same bits"] == row["finished"] >= 1


def test_a_kill_that_loses_something_is_seen(kills, tmp_path):
    """The checks themselves: half a file, a checkpoint behind the log, another bit."""
    write_still(tmp_path / "data")
    assert cli.main(f"fit {tmp_path / 'data'} -o {tmp_path / 'run'} {OPTIONS}".split()) == 0
    assert kills.check_whole(tmp_path / "run") == 8
    tensors, picks = kills.outcome(tmp_path / "run")
    assert kills.same((tensors, picks), kills.outcome(tmp_path / "run"))
    moved = {name: x.clone() for name, x in tensors.items()}
    moved["parameter.means"][0, 0] = torch.nextafter(moved["parameter.means"][0, 0], torch.tensor(9e9))
    assert not kills.same((tensors, picks), (moved, picks))
    with (tmp_path / "run/log.jsonl").open("a") as file:
        file.write('{"event": "checkpoint", "step": 9}\n')
    with pytest.raises(AssertionError, match="the checkpoint is at step 8, the log said 9"):
        kills.check_whole(tmp_path / "run")
    state = tmp_path / "run/state.safetensors"
    state.write_bytes(state.read_bytes()[:-9])
    with pytest.raises(ValueError, match="must be a checkpoint"):
        kills.check_whole(tmp_path / "run")


@pytest.mark.same_bits
@pytest.mark.every(3)
@pytest.mark.skipif(sys.platform != "linux", reason="limits and capabilities are those of Linux")
@pytest.mark.parametrize(
    ("trouble", "expected"),
    [
        ("disk", "must be written, got: File too large; free some space or choose another folder"),
        ("memory", "there must be more memory, none was left; what the last checkpoint holds is kept"),
        ("folder", "must be written, got: Permission denied; allow it or choose another folder"),
    ],
)
def test_a_fit_in_trouble(tmp_path, trouble, expected):
    """One line with the path, exit code 2, the checkpoint before it whole; once it is over, --resume ends with the bits
    of a fit that had none.
    """
    run = tmp_path / "run"
    write_still(tmp_path / "data")
    fit = ["fit", str(tmp_path / "data"), *OPTIONS.split()]
    line = [sys.executable, "-c", TROUBLED, run, trouble, *fit, "-o", run]
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2, done.stderr
    said = done.stderr.strip().splitlines()
    assert len(said) == 1, done.stderr
    assert said[0].startswith(f"drgs fit: {run}")
    assert expected in said[0]
    run.chmod(stat.S_IRWXU)
    assert load_state(run / "state.safetensors")[1]["step"] >= 2
    assert cli.main([*fit, "-o", str(run), "--resume"]) == 0
    assert cli.main([*fit, "-o", str(tmp_path / "peace")]) == 0
    assert (run / "point_cloud.ply").read_bytes() == (tmp_path / "peace/point_cloud.ply").read_bytes()


def test_which_errors_are_of_memory():
    """Python's, NumPy's and torch's are; others are not."""
    import numpy as np

    for allocate in (lambda: np.empty(1 << 60, np.uint8), lambda: torch.empty(1 << 60, dtype=torch.uint8)):
        with pytest.raises((MemoryError, RuntimeError)) as error:
            allocate()
        assert is_out_of_memory(error.value)
    assert not is_out_of_memory(RuntimeError("shapes do not match"))


def test_a_command_without_memory_says_so(tmp_path, monkeypatch, capsys):
    """Any command, in one line; other errors of the same type keep their traceback."""
    write_still(tmp_path / "data")
    assert cli.main(f"fit {tmp_path / 'data'} -o {tmp_path / 'run'} {OPTIONS}".split()) == 0
    for error in (MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")):

        def fail(*_, error=error, **__):
            raise error

        monkeypatch.setattr("drgs.fitting.evaluation.evaluate", fail)
        assert cli.main(["eval", str(tmp_path / "run"), "--quiet"]) == 2
        assert capsys.readouterr().err == (
            "drgs eval: there must be more memory, none was left; free some, or ask for smaller views\n"
        )

    def broken(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr("drgs.fitting.evaluation.evaluate", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main(["eval", str(tmp_path / "run"), "--quiet"])


def test_checkpoints_by_the_clock(tmp_path, monkeypatch):
    """After --save-minutes one is due, however few steps these were; a fit may go on with another number."""
    write_still(tmp_path / "data")
    clock, step = [0.0], Trainer.step

    def slow(self):
        clock[0] += 40.0
        return step(self)

    monkeypatch.setattr(Trainer, "step", slow)
    monkeypatch.setattr(
        "drgs.train.time", types.SimpleNamespace(monotonic=lambda: clock[0], perf_counter=time.perf_counter)
    )
    line = f"fit {tmp_path / 'data'} -o {tmp_path / 'run'} {OPTIONS} --save-every 1000 --save-minutes 1"
    assert cli.main(line.split()) == 0
    monkeypatch.undo()
    saved = [event["step"] for event in Run(tmp_path / "run").events() if event["event"] == "checkpoint"]
    assert saved == [2, 4, 6, 8]
    assert cli.main(f"{line} --resume --save-minutes 5".split()) == 0
