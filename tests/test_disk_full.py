"""A disk that is full: every writer ends in one line, leaves no half-written file, and keeps the old one."""

from __future__ import annotations

import os
import subprocess
import sys

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
