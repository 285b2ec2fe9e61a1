"""Claims of drgs.io.outputs and drgs.io.locks: what drgs did not make stays, and a folder has one writer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drgs.files import atomic_write
from drgs.io import locks, outputs
from drgs.io.atomic import temporary_folder
from drgs.io.outputs import check_file, lock_folder, replacing, write_json


def put(path: Path, text: str) -> None:
    with atomic_write(path) as file:
        file.write(text.encode())


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith(".drgs"))


def test_what_is_somebody_elses_stays(tmp_path):
    """Found out by `lock_folder` before any work, and again when the file is put in its place."""
    (tmp_path / "a.png").write_text("mine")
    with pytest.raises(ValueError, match=r"a.png: must not be replaced, .* move it away or choose another output"):
        lock_folder(tmp_path, "render", ["a.png"])
    with lock_folder(tmp_path, "render"), pytest.raises(ValueError, match="must not be replaced"):
        put(tmp_path / "a.png", "ours")
    assert (tmp_path / "a.png").read_text() == "mine"
    assert visible(tmp_path) == ["a.png"]


def test_what_drgs_made_is_replaced(tmp_path):
    """Again and again, also in a copy of the folder; the record says which command made it."""
    for text in ("one", "two", "two"):
        with lock_folder(tmp_path / "out", "render", ["a.png", "b/c.png"]):
            put(tmp_path / "out" / "a.png", text)
            put(tmp_path / "out" / "b" / "c.png", text)
    assert (tmp_path / "out" / "b" / "c.png").read_text() == "two"
    subprocess.run(["cp", "-r", tmp_path / "out", tmp_path / "copy"], check=True)
    with lock_folder(tmp_path / "copy", "render", ["a.png"]) as held:
        assert held.is_ours(tmp_path / "copy" / "b", by=("render",))
        assert not held.is_ours(tmp_path / "copy" / "b", by=("fit",))


def test_what_was_edited_stays(tmp_path):
    """A file of ours with another content, or a link in its place, is the user's."""
    with lock_folder(tmp_path, "render"):
        put(tmp_path / "a.png", "ours")
        put(tmp_path / "b.png", "ours")
    (tmp_path / "a.png").write_text("edited")
    with pytest.raises(ValueError, match="a.png: must not be replaced"):
        lock_folder(tmp_path, "render", ["a.png"])
    (tmp_path / "b.png").unlink()
    (tmp_path / "b.png").symlink_to("a.png")
    with pytest.raises(ValueError, match="b.png: must not be replaced"):
        lock_folder(tmp_path, "render", ["b.png"])


def test_killed_between_record_and_file(tmp_path):
    """The record comes first: a file that appears is known, and the one that it would have replaced still is."""
    with lock_folder(tmp_path, "render") as held:
        put(tmp_path / "a.png", "old")
        (tmp_path / "new").write_text("new")
        held.record("a.png", tmp_path / "new")  # killed here
    with (tmp_path / outputs.JOURNAL).open("ab") as file:
        file.write(b'{"file": "a.p')
    with lock_folder(tmp_path, "render", ["a.png"]):
        put(tmp_path / "a.png", "new")
    with lock_folder(tmp_path, "render", ["a.png"]):
        pass


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
def test_inputs_are_never_outputs(tmp_path, link):
    """By what a path leads to, through links of both kinds, also where drgs made the file."""
    with lock_folder(tmp_path / "out", "render"):
        put(tmp_path / "out" / "cameras.json", "[]")
    source = tmp_path / "out" / "cameras.json"
    if link:
        link(source, tmp_path / "linked.json")
        source = tmp_path / "linked.json"
    os.chdir(tmp_path / "out")
    with pytest.raises(ValueError, match="cameras.json: must not be read and replaced, it is an input"):
        lock_folder(".", "render", ["cameras.json"], inputs=[source])
    with pytest.raises(ValueError, match="must not be read and replaced"):
        check_file("cameras.json", "select", [source])


def test_one_file(tmp_path):
    """`select` replaces what `select` wrote and nothing else; what cannot be written is found out before."""
    check_file(tmp_path / "new" / "x.json", "select")
    assert not list(tmp_path.iterdir())
    for value in ({"schema": 1, "command": "select"}, {"schema": 1, "command": "fit"}, {"command": "select"}, [1]):
        write_json(tmp_path / "x.json", value)
        if value == {"schema": 1, "command": "select"}:
            check_file(tmp_path / "x.json", "select")
            continue
        with pytest.raises(ValueError, match=r"x.json: must not be replaced, `drgs select` did not make it"):
            check_file(tmp_path / "x.json", "select")
    with pytest.raises(ValueError, match="must be a JSON file, is a folder; name a file in it, e.g. .*/select.json"):
        check_file(tmp_path, "select")
    with pytest.raises(ValueError, match="x.json: the output must be a folder that can be written, got"):
        check_file(tmp_path / "x.json" / "y.json", "select")


def test_folders_that_cannot_be_written(tmp_path):
    """A file in the way, anywhere in the path, and /proc; nothing is left behind."""
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "out", Path("/proc/out")):
        with pytest.raises(ValueError, match=r"output must be a folder that can be written, got: .*; choose another"):
            lock_folder(path, "fit")
    assert visible(tmp_path) == ["file"]


def test_nothing_is_left_of_a_command_that_wrote_nothing(tmp_path):
    """Folders that were made for it go, those that were there stay."""
    with lock_folder(tmp_path / "a" / "b", "fit"):
        assert (tmp_path / "a" / "b" / locks.NAME).is_file()
    assert not list(tmp_path.iterdir())
    (tmp_path / "a").mkdir()
    with lock_folder(tmp_path / "a" / "b", "fit"):
        pass
    assert visible(tmp_path) == ["a"]


def test_sweep_takes_only_unfinished_files_of_ours(tmp_path):
    """A killed process leaves a file and a folder, which the next one removes; names like them stay."""
    code = (
        "import os, sys; from drgs.io.outputs import *; from drgs.io.atomic import *\n"
        "with lock_folder(sys.argv[1], 'fit'), temporary_folder('sfm', sys.argv[1]) as folder:\n"
        "    (folder / 'database.db').write_text('x')\n"
        "    with replacing(sys.argv[1] + '/state.safetensors') as name:\n"
        "        open(name, 'w').write('half'); os._exit(9)\n"
    )
    mine = [".state.safetensors.abcdefgh.tmp", ".drgs.notes.tmp", "x.tmp", ".drgs.tmp"]
    for name in mine:
        (tmp_path / name).write_text("mine")
    assert subprocess.run([sys.executable, "-c", code, tmp_path], check=False).returncode == 9
    assert len(list(tmp_path.iterdir())) == len(mine) + 3  # a folder, a file, the lock
    with lock_folder(tmp_path, "fit"):
        assert sorted(x.name for x in tmp_path.iterdir()) == sorted([*mine, locks.NAME])


def test_temporary_things_go(tmp_path):
    """With the block, and when the process ends in the middle."""
    with temporary_folder("sfm", tmp_path) as folder:
        (folder / "a").mkdir()
    assert not list(tmp_path.iterdir())
    block = replacing(tmp_path / "x")
    Path(block.__enter__()).write_text("half")
    with temporary_folder("sfm", tmp_path):
        outputs.clean()
    assert not list(tmp_path.iterdir())


def test_removal_spares_what_was_added(tmp_path):
    """A folder of ours with a file of the user's in it is refused as a whole."""
    with lock_folder(tmp_path, "sfm") as held, temporary_folder("sfm", tmp_path) as made:
        (made / "sparse" / "0").mkdir(parents=True)
        (made / "sparse" / "0" / "cameras.bin").write_text("ours")
        held.put(made / "sparse", "sparse")
    (tmp_path / "sparse" / "0" / "notes.txt").write_text("mine")
    with lock_folder(tmp_path, "sfm") as held:
        with pytest.raises(ValueError, match="sparse: must not be replaced"):
            held.remove(tmp_path / "sparse")
        assert (tmp_path / "sparse" / "0" / "cameras.bin").exists()
        (tmp_path / "sparse" / "0" / "notes.txt").unlink()
        held.remove(tmp_path / "sparse")
    assert visible(tmp_path) == []


def test_record_stays_short(tmp_path, monkeypatch):
    """A thousand checkpoints do not make a thousand lines for good, and the last one is still known."""
    with lock_folder(tmp_path, "fit"):
        for i in range(250):
            monkeypatch.setattr(os, "fsync", lambda _: None)
            put(tmp_path / "state", str(i))
    assert len((tmp_path / outputs.JOURNAL).read_bytes().splitlines()) == 250
    with lock_folder(tmp_path, "fit", ["state"]):
        assert len((tmp_path / outputs.JOURNAL).read_bytes().splitlines()) == 1


def test_a_damaged_journal_is_read_as_far_as_it_goes(tmp_path):
    """Lines that are no rows, deeper than Python reads, or of other types: the folder can be written all the same."""
    rows = [b"[" * 100_000, b"5", b"[]", b'{"file": 5, "sha256": "a", "command": "fit"}']
    rows += [b'{"file": "a", "sha256": ["a"], "command": "fit"}', b'{"file": "\\u0000", "sha256": "a", "command": "x"}']
    (tmp_path / outputs.JOURNAL).write_bytes(b"\n".join(rows * 60) + b"\n")
    with outputs.lock_folder(tmp_path, "fit", ["x"]), replacing(tmp_path / "x") as name:
        Path(name).write_text("whole")
    assert (tmp_path / "x").read_text() == "whole"


# ---- locks


def foreign_lock(folder: Path, **fields) -> None:
    """A lock of the process that runs this test's parent, changed by `fields`."""
    folder.mkdir(exist_ok=True)
    pid = os.getppid()
    owner = {**locks._this_process(), "pid": pid, "started": locks._started(pid), "command": "fit", "since": "today"}
    (folder / locks.NAME).write_text(json.dumps({**owner, **fields}))


def test_a_lock_that_is_nested_too_deeply_says_nothing(tmp_path):
    """It is one that cannot be read, as an empty one: old, it is removed."""
    (tmp_path / locks.NAME).write_bytes(b"[" * 60_000)
    os.utime(tmp_path / locks.NAME, (0, 0))
    with outputs.lock_folder(tmp_path, "fit"):
        pass


def test_living_process_is_not_disturbed(tmp_path):
    """Named with command, process and machine; the folder stays as it is."""
    foreign_lock(tmp_path)
    with pytest.raises(ValueError, match=rf"`drgs fit` \(process {os.getppid()} on .*writes there; wait for it"):
        lock_folder(tmp_path, "eval")
    assert [path.name for path in tmp_path.iterdir()] == [locks.NAME]


def test_other_machines_are_believed(tmp_path):
    """Their processes cannot be looked at; the message says which file to delete, and that works."""
    for fields in ({"host": "elsewhere", "pid": 1}, {"space": "pid:[1]"}):
        foreign_lock(tmp_path, **fields)
        with pytest.raises(ValueError, match=r"delete .*\.drgs\.lock if that process no longer runs"):
            lock_folder(tmp_path, "fit")
    (tmp_path / locks.NAME).unlink()
    with lock_folder(tmp_path, "fit"):
        pass


@pytest.mark.parametrize("fields", [{"pid": 4194305}, {"started": "boot 17"}, {"pid": "x"}, {"pid": -1}])
def test_stale_lock_is_named_and_taken_over(tmp_path, caplog, fields):
    """Of a process that is gone, or whose number another one has now."""
    foreign_lock(tmp_path, **fields)
    with lock_folder(tmp_path, "fit"):
        assert "ended without unlocking it, goes on here" in caplog.text
        assert str(fields.get("pid", os.getppid())) in caplog.text
        assert json.loads((tmp_path / locks.NAME).read_text())["pid"] == os.getpid()
    assert not (tmp_path / locks.NAME).exists()


def test_half_written_lock(tmp_path):
    """Just now: somebody begins. Old: of a process that was killed while it wrote it."""
    (tmp_path / locks.NAME).write_text("")
    with pytest.raises(ValueError, match="another one begins"):
        lock_folder(tmp_path, "fit")
    os.utime(tmp_path / locks.NAME, (0, 0))
    with lock_folder(tmp_path, "fit"):
        pass


def test_lock_of_another_thread(tmp_path):
    """Two fits in one process are two writers, too; within a thread a claim nests."""
    import threading

    said = []

    def other():
        try:
            lock_folder(tmp_path, "fit")
        except ValueError as error:
            said.append(str(error))

    with lock_folder(tmp_path, "demo"), lock_folder(tmp_path, "fit") as inner:
        assert inner.command == "demo"
        inner.release()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert (tmp_path / locks.NAME).exists()
        lock_folder(tmp_path, "fit")
    assert "two threads" in said[0]
    assert not (tmp_path / locks.NAME).exists()


def test_only_one_takes_over_a_stale_lock(tmp_path):
    """Six processes find the same stale lock at once: one gets in, each of the others is told who."""
    foreign_lock(tmp_path, pid=4194305)
    code = (
        "import sys; from pathlib import Path; from drgs.io import locks\n"
        "print('ready', flush=True); sys.stdin.readline()\n"
        "try: locks.acquire(Path(sys.argv[1]), 'fit'); print('in', flush=True)\n"
        "except ValueError as error: print(error, flush=True)\n"
        "sys.stdin.readline()\n"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    several = [subprocess.Popen([sys.executable, "-c", code, tmp_path], **pipes) for _ in range(6)]
    try:
        for process in several:
            assert process.stdout.readline() == "ready\n"
        for process in several:
            process.stdin.write("\n")
            process.stdin.flush()
        answers = [process.stdout.readline() for process in several]
    finally:
        for process in several:
            process.communicate("\n")
    assert answers.count("in\n") == 1
    assert sum("writes there" in answer for answer in answers) == 5
