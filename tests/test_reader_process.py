"""Claims of drgs.data.reader_process: a library that crashes over a file takes no fit with it; answers stay apart."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_dynamic_data import coded, decoded, write_video

from drgs.data import videos
from drgs.data.reader_process import Child
from drgs.data.videos import VideoFrame

MODULE = """
import logging, os, time
from pathlib import Path
import numpy as np
from drgs.data.reader_process import serve

def fail(path, kind, report):
    raise {"ValueError": ValueError, "FileNotFoundError": FileNotFoundError, "KeyError": KeyError}[kind](f"{path}: no")

def count(path, number, report):
    for i in range(number):
        report(i)
    logging.getLogger("drgs").warning("%s: counted", path)
    return number

def read(path, report):
    return path.read_text()

def zeros(path, shape, report):
    return np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)

if __name__ == "__main__":
    serve({"fail": fail, "count": count, "read": read, "zeros": zeros,
           "abort": lambda path, report: os.abort(), "sleep": lambda path, report: time.sleep(60)})
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    """A process whose functions do what libraries do."""
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "foreign_reader.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path / "served")
    made = Child("foreign_reader", "a file that can be read", "copy it again")
    yield made
    made.end()


def stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def test_answers(child, tmp_path, caplog):
    """Values, arrays, errors, warnings and what is told on the way; one process for all."""
    told = []
    assert child.call("count", Path("a"), 3, progress=told.append) == 3
    pid = child.pid
    assert told == [0, 1, 2]
    assert caplog.messages == ["a: counted"]
    array = child.call("zeros", Path("a"), [300, 400, 3])
    assert (array.shape, array.dtype, array.flags.writeable) == ((300, 400, 3), np.uint8, True)
    np.testing.assert_array_equal(array.ravel(), np.arange(360_000).astype(np.uint8))
    assert child.call("zeros", Path("a"), [0, 3]).shape == (0, 3)
    for kind in (ValueError, FileNotFoundError):
        with pytest.raises(kind, match=r"^a/b: no$"):
            child.call("fail", Path("a/b"), kind.__name__)
    with pytest.raises(ValueError, match=r"^a/b: must be readable, got KeyError: 'a/b: no'; copy it again$"):
        child.call("fail", Path("a/b"), "KeyError")
    assert child.pid == pid


def test_relative_paths_are_where_this_process_is(child, tmp_path, monkeypatch):
    """Also after it went elsewhere."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
        monkeypatch.chdir(tmp_path / name)
        assert child.call("read", Path("a")) == name


def test_a_crash_is_one_line_and_the_next_file_is_read(child, capfd):
    """A real SIGABRT within the question."""
    with pytest.raises(ValueError, match="^") as error:
        child.call("abort", Path("a/b"))
    wanted = "a/b: must be a file that can be read, the process that reads it ended with SIGABRT; copy it again"
    assert str(error.value) == wanted
    assert child.pid is None
    assert child.call("count", Path("a"), 2) == 2
    assert "Traceback" not in capfd.readouterr().err


def test_an_interrupt_leaves_no_answer_for_the_next_question(child):
    """What was asked for before is not taken for what is asked for now."""

    def interrupt(number):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        child.call("count", Path("a"), 3, progress=interrupt)
    assert child.call("zeros", Path("a"), [2]).tolist() == [0, 1]


def test_ctrl_c_and_sigterm_do_not_reach_it(child):
    """A fit that is told to end saves first, and may read files until then."""
    child.call("count", Path("a"), 1)
    for name in (signal.SIGINT, signal.SIGTERM):
        os.kill(child.pid, name)
    assert os.getpgid(child.pid) != os.getpgid(0)
    assert child.call("count", Path("a"), 2) == 2


def test_it_ends_with_this_process(child):
    """Nothing is left behind, whatever ended it: the socket is closed."""
    child.call("count", Path("a"), 1)
    process = child._process
    child._file.close()
    child._socket.close()
    assert process.wait(10) == 0


def test_a_fork_gets_a_process_of_its_own(child):
    """Two processes on one socket would read each other's answers."""
    child.call("count", Path("a"), 1)
    pid = child.pid
    forked = os.fork()
    if forked == 0:
        answer = child.pid is None and child.call("count", Path("a"), 5) == 5 and child.pid != pid
        child.end()
        os._exit(0 if answer else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(forked, 0)[1]) == 0
    assert (child.call("count", Path("a"), 2), child.pid) == (2, pid)


def test_threads_take_turns(child):
    """Each gets its own answer."""
    wrong = []

    def ask(n):
        for _ in range(20):
            if child.call("zeros", Path("a"), [n]).shape != (n,):
                wrong.append(n)

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
def test_a_decoder_that_is_killed_while_it_reads(tmp_path, caplog):
    """A real SIGKILL within a frame of a video: one line that names the file, and the next frame is read."""
    path = write_video(tmp_path / "cam00.mp4", [coded(i) for i in range(6)], "mp4v")
    assert decoded(VideoFrame(path, 1).read()) == (0, 1)
    pid = videos._decoder.pid
    os.kill(pid, signal.SIGSTOP)
    ended = []

    def read():
        try:
            VideoFrame(path, 2).read()
        except ValueError as error:
            ended.append(str(error))

    thread = threading.Thread(target=read)
    thread.start()
    while not stopped(pid):
        time.sleep(0.01)
    time.sleep(0.2)  # the question is asked
    assert thread.is_alive()
    os.kill(pid, signal.SIGKILL)
    thread.join(10)
    assert ended == [
        f"{path}: must be a video that can be decoded, the process that reads it ended with SIGKILL; convert it with "
        "ffmpeg, or leave it out"
    ]
    with caplog.at_level(logging.WARNING):
        assert decoded(VideoFrame(path, 3).read()) == (0, 3)
    assert videos._decoder.pid not in (None, pid)
    assert caplog.messages == []
