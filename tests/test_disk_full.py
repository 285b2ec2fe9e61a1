"""A disk that is full: every writer ends in one line, leaves no half-written file, and keeps the old one."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest
import torch

from drgs import cli
from drgs.display.progress import Bar
from drgs.files import load_state

WRITERS = """
import os, resource, sys
from pathlib import Path
import numpy as np, torch
import drgs
from drgs import files
from drgs.data import camera_lists
from drgs.display import pictures
from drgs.cameras import orbit

folder = Path(sys.argv[1])
noise = np.random.default_rng(0).random((120, 120, 3)).astype(np.float32)
n = 300
g = drgs.Gaussians(torch.rand(n, 3), torch.rand(n, 4), torch.rand(n, 3), torch.rand(n), torch.rand(n, 16, 3))
def video(path):
    with pictures.Video(path) as movie:
        for i in range(4):
            movie.write(np.random.default_rng(i).random((120, 120, 3)).astype(np.float32))
writers = {
    "a.png": lambda path: pictures.write_png(path, noise),
    "a.exr": lambda path: pictures.write_exr(path, noise, A=noise[..., 0]),
    "a.webm": video,
    "a.ply": lambda path: files.save_ply(g, path),
    "a.safetensors": lambda path: files.save_state(path, {"x": torch.rand(9999)}, {}),
    "a.json": lambda path: files.write_json(path, list(range(9999))),
    "cameras.json": lambda path: camera_lists.save_cameras_json(path, orbit((0, 0, 0), 3.0, 99, width=8, height=8)),
}
for name, write in writers.items():
    write(folder / name)  # all of them succeed while there is room
whole = {name: (folder / name).read_bytes() for name in writers}
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
for name, write in writers.items():
    try:
        write(folder / name)
        print(f"{name}: wrote")
    except OSError as error:
        is_clear = str(folder / name) in str(error) and "free some space" in str(error) and "\\n" not in str(error)
        print(f"{name}: {'clear' if is_clear else error}")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole, name
"""


def test_no_room_for_any_file(tmp_path):
    """Files may grow to 5,000 bytes (as a full disk, for a process): 7 writers, 7 sentences, the 7 old files."""
    done = subprocess.run(
        [sys.executable, "-c", WRITERS, tmp_path], capture_output=True, text=True, check=False, env={**os.environ}
    )
    assert done.returncode == 0, done.stderr
    assert [line.split(": ")[1] for line in done.stdout.splitlines()] == ["clear"] * 7, done.stdout


class Disk:
    """A disk of a few megabytes, which others fill and free again."""

    def __init__(self, path: Path):
        self.path = path
        self.size = 64 << 20
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={self.size}", "tmpfs", path], check=True, stderr=-1)

    def leave(self, free: int) -> None:
        """So many bytes are free from now on; 0 for none."""
        used = os.statvfs(self.path)
        size = (used.f_blocks - used.f_bfree) * used.f_frsize + free
        subprocess.run(["mount", "-o", f"remount,size={max(size, 1)}", self.path], check=True)

    def free(self) -> None:
        """There is room again."""
        subprocess.run(["mount", "-o", f"remount,size={self.size}", self.path], check=True)


@pytest.fixture
def disk(tmp_path):
    path = tmp_path / "disk"
    path.mkdir()
    try:
        made = Disk(path)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"a small disk takes the right to mount one: {error}")
    yield made
    subprocess.run(["umount", "-l", path], check=True)


@contextlib.contextmanager
def filled_at(disk: Disk, label: str):
    """A disk that is full from where a bar has this name to the end of the block."""
    enter, update = Bar.__enter__, Bar.update

    def begun(bar):
        if bar.label == label:
            disk.leave(0)
        return enter(bar)

    def told(bar, *args, **kwargs):
        update(bar, *args, **kwargs)
        if bar.label == label:
            disk.leave(0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bar, "__enter__", begun)
        patch.setattr(Bar, "update", told)
        yield
    disk.free()


def said(capsys) -> str:
    """The one line on stderr."""
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


@pytest.mark.same_bits
def test_a_fit_goes_on_after_a_full_disk(disk, tmp_path, capsys):
    """However little room there was, more of it lets --resume end with the bits of a fit that had enough."""
    from test_active import write_still

    write_still(tmp_path / "data")
    fit = ["fit", str(tmp_path / "data"), "--no-report", "--quiet", "--deterministic"]
    fit += ["--max-steps", "8", "--max-gaussians", "60", "--sh-degree", "1", "--save-every", "2"]
    assert cli.main([*fit, "-o", str(tmp_path / "peace")]) == 0
    wanted = load_state(tmp_path / "peace/state.safetensors")[0]
    found = set()
    for number, kib in enumerate([4, 16, 36, 52, 60, 100]):
        run = disk.path / f"run_{number}"
        disk.leave(kib << 10)
        assert cli.main([*fit, "-o", str(run)]) == 2
        line = said(capsys)
        assert line.startswith(f"drgs fit: {disk.path}")
        assert "No space left on device; " in line
        found.add(tuple((run / name).exists() for name in ("state.safetensors", "point_cloud.ply")))
        disk.free()
        assert cli.main([*fit, "-o", str(run), "--resume"]) == 0, kib
        state = load_state(run / "state.safetensors")[0]
        assert all(torch.equal(x, state[name]) for name, x in wanted.items()), kib
    # What is made of a checkpoint comes after it.
    assert found == {(False, False), (True, False), (True, True)}


def test_a_capture_goes_on_after_a_full_disk(disk, tmp_path, capsys, monkeypatch):
    """The disk fills up at the beginning of each step, and within poses of each stage, whose library would end the
    process: one line, the steps before it stay, and --resume continues with them.
    """
    pytest.importorskip("pycolmap")
    import cv2
    import numpy as np
    from test_capture_command import CONFIG, steps_of
    from test_sfm import corner_camera, corner_photo, corner_walls, write_photo
    from test_share import write_viewer

    from drgs.commands import capture
    from drgs.pages.sharing import npm

    write_viewer(tmp_path / "npm")
    monkeypatch.setattr(npm, "cache_folder", lambda: tmp_path / "npm")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(capture, "FitConfig", lambda: types.SimpleNamespace(replace=lambda **_: CONFIG))
    walls = corner_walls(np.random.default_rng(5))
    (tmp_path / "photos").mkdir()
    for index in range(3):
        photo = cv2.resize(corner_photo(corner_camera(index), walls)[0], None, fx=0.5, fy=0.5, interpolation=3)
        write_photo(tmp_path / f"photos/{index}.png", photo)
    run, words = disk.path / "run", [str(tmp_path / "photos")]
    done = {
        "photos": [],
        "features": ["photos"],
        "matching": ["photos"],
        "mapping": ["photos"],
        "fit": ["photos", "poses"],
        "report": ["photos", "poses", "fit"],
        "packing": ["photos", "poses", "fit", "report"],
    }
    for label, steps in done.items():
        with filled_at(disk, label):
            assert cli.main(["capture", *words, "-o", str(run), "--quiet"]) == 2, label
        line = said(capsys)
        assert line.startswith(f"drgs capture: {disk.path}"), label
        assert "free some space or choose another folder" in line, label
        assert steps_of(run) == steps, label
        words = ["--resume"]
    assert cli.main(["capture", "--resume", "-o", str(run), "--quiet"]) == 0
    assert steps_of(run) == ["photos", "poses", "fit", "report", "share"]
    assert not list(run.rglob(".drgs.*.tmp*"))
