"""Claims of drgs.io.interrupts: signals end a command soon and cleanly, and a fit at a step's end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import drgs
from drgs.information import jacobian
from drgs.io import interrupts
from drgs.tracing.composite import Compositor

# A command that waits in Python, or in native code that no signal ends, which takes minutes.
_COMMAND = """
import hashlib, sys, time
from pathlib import Path
from drgs.io import interrupts
from drgs.io import outputs
from drgs.io import atomic

def native():
    hashlib.pbkdf2_hmac("sha256", b"x", b"y", 10**9)

def wait(kind):
    print("ready", flush=True)
    if kind == "python":
        while True:
            time.sleep(0.01)
    native()

try:
    say = lambda error: type(error).__name__ + "\\n"
    with interrupts.handled(outputs.clean, say):
        with outputs.lock_folder(sys.argv[1], "fit"), atomic.temporary_folder("sfm", sys.argv[1]) as folder:
            (folder / "a").write_text("b")
            if sys.argv[2] == "callback":
                with interrupts.in_native_code():
                    wait("python")
            elif sys.argv[2] == "step":
                with interrupts.between_steps() as is_interrupted:
                    print("ready", flush=True)
                    for _ in range(200):
                        hashlib.pbkdf2_hmac("sha256", b"x", b"y", 300_000)
                        if is_interrupted():
                            print("saved", flush=True)
                            raise interrupts.interruption("saved")
            elif sys.argv[2] == "long step":
                with interrupts.between_steps():
                    wait("native")
            else:
                wait(sys.argv[2])
except KeyboardInterrupt as error:
    sys.stderr.write(say(error))
    sys.exit(interrupts.exit_code(error))
"""


@pytest.fixture
def start(tmp_path):
    """Starts the command in a place; it is waiting when this returns."""
    started = []

    def run(kind: str) -> subprocess.Popen:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        process = subprocess.Popen([sys.executable, "-c", _COMMAND, tmp_path / "out", kind], **pipes)
        started.append(process)
        assert process.stdout.readline() == "ready\n"
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("kind", "signum", "code", "name"),
    [
        ("python", signal.SIGINT, 130, "KeyboardInterrupt"),
        ("python", signal.SIGTERM, 143, "Terminated"),
        ("native", signal.SIGINT, 130, "KeyboardInterrupt"),
        ("native", signal.SIGTERM, 143, "Terminated"),
        ("native", signal.SIGHUP, 129, "Terminated"),
        ("callback", signal.SIGTERM, 143, "Terminated"),
    ],
)
def test_signal_ends_a_command(start, tmp_path, kind, signum, code, name):
    """Within 3 s (measured: 0.1, and 0.8 in native code), one line, and nothing is left."""
    process = start(kind)
    began = time.perf_counter()
    process.send_signal(signum)
    _, error = process.communicate(timeout=30)
    assert time.perf_counter() - began < 3
    assert (process.returncode, error) == (code, f"{name}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [(Compositor, "composited", drgs.render), (jacobian, "weighted_squares", drgs.diagonal)],
    ids=["operation", "walk"],
)
def test_what_is_inside_of_drjit_is_interrupted_as_python_is(monkeypatch, owner, name, call):
    """Most of a render is inside Dr.Jit's operation, which makes errors of its own of whatever is raised there;
    information is asked in loops and branches that Dr.Jit traces, with no operation around them.
    """

    def interrupted(*_):
        raise interrupts.Terminated(signal.SIGTERM)

    monkeypatch.setattr(owner, name, interrupted)
    one = drgs.Gaussians.from_arrays([[0, 0, 2.0]], [[1.0, 0, 0, 0]], [[0.1] * 3], [0.5], [[[0.0] * 3]])
    K = np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]])
    with pytest.raises(interrupts.Terminated):
        call(one, drgs.Camera(K=K, w2c=np.eye(4), width=8, height=8))


def test_step_is_finished_and_the_same_signal_twice_is_one(start):
    """`timeout` signals a process and then its group: that must not cost what would have been saved."""
    process = start("step")
    process.send_signal(signal.SIGTERM)
    time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    out, error = process.communicate(timeout=30)
    assert (process.returncode, out, error) == (143, "saved\n", "Terminated\n")


@pytest.mark.parametrize("wait", ["", "time.sleep(0.5)"])
def test_the_same_signal_again_once_the_command_has_ended(wait):
    """While the process says its line, and while Python shuts down; a second later it is one more, which ends it."""
    code = f"""
import atexit, os, signal, time
from drgs.io import interrupts
atexit.register(lambda: (os.kill(os.getpid(), signal.SIGTERM), print("still here", flush=True)))
try:
    with interrupts.handled(lambda: None, str):
        signal.raise_signal(signal.SIGTERM)
except interrupts.Terminated:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)
    print("ended", flush=True)
{wait}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "ended\nstill here\n", "")


def test_another_signal_later_is_no_repetition():
    """A program that goes on after a command was ended has its own handlers back after that second."""
    code = """
import signal, time
from drgs.io import interrupts
try:
    with interrupts.handled(lambda: None, str):
        signal.raise_signal(signal.SIGTERM)
except interrupts.Terminated:
    print("ended", flush=True)
time.sleep(1.1)
signal.raise_signal(signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, "ended\n", "")


def test_second_signal_ends_a_long_step(start, tmp_path):
    """The first one waits for its end, the next one does not."""
    process = start("long step")
    process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(1.3)  # longer than native code is given otherwise
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert (process.returncode, error) == (130, "KeyboardInterrupt\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_loop_that_does_not_ask(signum):
    """A signal in the last step is raised at the end of the block, not lost; a part that may be left anywhere, is."""
    done = []

    def last_step():
        with interrupts.between_steps():
            signal.raise_signal(signum)
            done.append("step")

    def pick():
        with interrupts.between_steps(), interrupts.at_once():
            signal.raise_signal(signum)
            done.append("pick")

    for part in (last_step, pick):
        with pytest.raises(KeyboardInterrupt) as error:
            part()
        assert isinstance(error.value, interrupts.Terminated) == (signum == signal.SIGTERM)
    assert done == ["step"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ignored_signals_stay_ignored():
    """nohup ignores SIGHUP, so that a fit outlives its terminal."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts.between_steps() as is_interrupted:
            signal.raise_signal(signal.SIGHUP)
            assert not is_interrupted()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_pycolmap_does_not_take_sigterm(tmp_path):
    """Imported where drgs imports it, SIGTERM is still ours; by itself it prints a stack of C++ frames."""
    code = (
        "import signal, os; from drgs.io import interrupts\n"
        "with interrupts.between_steps() as is_interrupted:\n"
        "    from drgs.data.colmap_bindings import pycolmap\n"
        "    os.kill(os.getpid(), signal.SIGTERM); print(is_interrupted(), flush=True)\n"
    )
    pytest.importorskip("pycolmap")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout == "True\n"
    assert "stack trace" not in done.stderr


def test_pycolmap_is_imported_in_one_place():
    """Else the first import elsewhere would take SIGTERM."""
    folder = Path(interrupts.__file__).parents[1]
    lines = [(path.name, line.strip()) for path in folder.rglob("*.py") for line in path.read_text().splitlines()]
    assert [name for name, line in lines if line == "import pycolmap"] == ["colmap_bindings.py"]
