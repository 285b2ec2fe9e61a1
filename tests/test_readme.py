"""The README is run: its commands on a tiny scene, its Python block by block, its links and names looked up."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import drgs
from drgs import cli
from drgs.cameras import c2w_to_opengl, orbit
from drgs.files import save_ply

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")

# What makes a command of the README small. Later options win over earlier ones.
_SMALLER = {
    "fit": ["--max-steps", "6", "--max-gaussians", "200"],
    "render": ["--frames", "2", "--width", "24"],
    "select": ["--count", "6"],
    "fisher": ["--limit", "1"],
    "crossval": ["--limit", "1", "--max-pixels", "192", "--no-ladder"],
    "tradeoff": ["--limit", "1", "--max-pixels", "192", "--repeats", "1"],
    "stress": ["--match", "1 Gaussian"],
    "query": ["--limit", "1", "--threshold", "0"],  # six steps have taught nothing
    "demo": ["--quick"],
}
# Structure from motion needs real texture, the demo half a minute, a room ten seconds, a teacher a model,
# a viewer ends by Ctrl-C alone: tests/test_sfm.py, test_demo.py, test_room.py, test_teach.py, test_view.py.
_ELSEWHERE = ("sfm", "demo", "scene", "teach", "view")
_KITCHEN = "kitchen"  # of what moves: tests/test_dynamic_fit.py, and `make smoke`


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


def _commands() -> list[list[str]]:
    lines = "\n".join(_blocks("bash")).splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("drgs ")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with `scene`, nine posed pictures of a few Gaussians, `data/room`, the same with a teacher's maps, and
    `point_cloud.ply`."""
    import cv2

    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("readme")
    n = 40
    g = drgs.Gaussians.from_arrays(
        (rng.normal(size=(n, 3)) * 0.5).astype(np.float32),
        rng.normal(size=(n, 4)),
        rng.uniform(0.05, 0.2, (n, 3)),
        rng.uniform(0.5, 0.95, n),
        rng.normal(size=(n, 4, 3)) * 0.5,
    )
    save_ply(g, folder / "point_cloud.ply")
    (folder / "scene").mkdir()
    frames = []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=32, height=24, up=(0, -1, 0))):
        out = drgs.render(g, camera)
        image = (out.rgb.numpy().clip(0, 1) * 255).round().astype(np.uint8)
        z = out.median_depth if out.median_depth is not None else out.depth
        cv2.imwrite(str(folder / f"scene/{i}.png"), image[..., ::-1])
        cv2.imwrite(str(folder / f"scene/{i}.depth.png"), (z.numpy() * 1000).round().astype(np.uint16))
        frames.append(
            {
                "file_path": f"{i}.png",
                "depth_file_path": f"{i}.depth.png",
                "transform_matrix": c2w_to_opengl(camera.c2w).tolist(),
            }
        )
    K = camera.K
    lens = {"w": 32, "h": 24, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    transforms = {"camera_model": "OPENCV", **lens, "depth_unit_scale_factor": 1e-3, "frames": frames}
    (folder / "scene/transforms.json").write_text(json.dumps(transforms))
    room = folder / "data/room"  # in place of the made one: the same views, with maps of chairs left and walls right
    shutil.copytree(folder / "scene", room)
    (room / "rgb_feature_langseg").mkdir()
    maps = torch.zeros(2, 6, 8, dtype=torch.half)
    maps[0, :, :4] = maps[1, :, 4:] = 1
    for i in range(9):
        torch.save(maps, room / f"rgb_feature_langseg/{i}_fmap_CxHxW.pt")
    np.save(room / "text_embeddings.npy", np.eye(2, dtype=np.float32))
    (room / "classes.txt").write_text("chair\nwall\n")
    return folder


def test_first_lines():
    """A stranger sees the title and a picture, reads why, and then two commands that the Makefile has."""
    lines = README.splitlines()
    assert lines[0] == "# drgs"
    picture = ROOT / re.match(r"!\[[^]]+\]\((.+)\)$", lines[2])[1]
    assert picture.stat().st_size < 300_000
    first = re.search(r"```\n(.*?)```", README, flags=re.S)
    assert [line.split()[:2] for line in first[1].splitlines()] == [["make", "demo"], ["make", "test"]]
    assert README[: first.start()].count("\n") < 15
    makefile = (ROOT / "Makefile").read_text()
    assert all(re.search(rf"^{name}:", makefile, flags=re.M) for name in ("demo", "test", "smoke"))


def test_every_command_is_shown():
    """The list of commands is complete."""
    assert {command[0] for command in _commands()} == set(cli._OPTIONS)


def test_commands_run(folder, monkeypatch, capsys):
    """The commands run in the order of the README, each on what the ones before have left."""
    monkeypatch.chdir(folder)
    for command in _commands():
        if command[0] in _ELSEWHERE or any(_KITCHEN in word for word in command):
            cli._parse_arguments(command)
            continue
        smaller = _SMALLER.get(command[0], []) + (["--add", "2", "--every", "2"] if "active" in command else [])
        code = cli.main([*command, *smaller])
        captured = capsys.readouterr()
        assert code == 0, f"{command}: {captured.err}"
        if "-o" in command:
            path = folder / command[command.index("-o") + 1]
            assert path.is_file() or any(path.iterdir()), command


def test_quiet_commands_print_nothing(folder, monkeypatch, capsys):
    """With --quiet the files are the result."""
    monkeypatch.chdir(folder)
    done = set()
    for command in _commands():
        if command[0] not in ("fit", "eval", "render", "select", "fisher") or command[0] in done:
            continue
        done.add(command[0])
        new = ["-o", "runs/quiet"] if command[0] == "fit" else []
        assert cli.main([*command, *_SMALLER.get(command[0], []), *new, "--quiet"]) == 0
        captured = capsys.readouterr()
        assert (captured.out, captured.err) == ("", ""), command


def test_python_runs(tmp_path):
    """Each Python block runs by itself, in a process and a folder of its own, and leaves no file."""
    started = []
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    for number, block in enumerate(_blocks("python")):
        place = tmp_path / str(number)
        place.mkdir()
        command = [sys.executable, "-c", block]
        started.append((place, subprocess.Popen(command, cwd=place, env=environ, stderr=subprocess.PIPE, text=True)))
    assert len(started) == 3
    for place, process in started:
        _, error = process.communicate(timeout=300)
        assert process.returncode == 0, error
        assert not any(place.iterdir())


def test_terms_are_explained():
    """Words of the field are explained where they come first."""
    for term, explanation in {
        "dB": "dB is PSNR, the squared error on a logarithmic scale",
        "FLIP": "FLIP what an eye sees when it flips between two images",
        "Fisher information": "**Fisher information** about a parameter is the sum over the pixels",
        "`logdet`": "`logdet` adds up log(1 + that ratio)",
        "`eig`": "`eig`, as in FisherRF, adds up its information over that of the views so far",
        "oracle": "the oracle: float64, brute force",
    }.items():
        assert explanation in " ".join(README.split()), term


def test_presets_and_settings_exist():
    """The table names every preset, and nothing else."""
    from drgs.settings import PRESETS

    table = README.split("## Presets")[1].split("## ")[0]
    assert re.findall(r"^\| `(\w+)`", table, flags=re.M) == list(PRESETS)


def test_links_lead_somewhere():
    """Files that the README and the documentation link to are there."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"
