"""Names of files: whatever a system allows works, from photographs to a report; what no model can hold is one line."""

from __future__ import annotations

import html
import json
import os
import shlex
import shutil

import numpy as np
import pytest
from test_sfm import corner  # noqa: F401 (a fixture)

from drgs.cli import main
from drgs.data import load
from drgs.data.images import list_images
from drgs.display.pictures import file_names
from drgs.sfm.reconstruction import run_sfm

pycolmap = pytest.importorskip("pycolmap")

NAMES = (
    "photo (1).png",
    'it\'s "q" [2].png',
    "é 写真 🙂.PNG",
    "100% #1 & co;?.png",
    "-dash  two.png",
    "back\\slash <b>$HOME`x`|*.png",
    "x" * 196 + ".png",
)


@pytest.fixture(scope="module")
def named(corner, tmp_path_factory):  # noqa: F811
    """A data set of photographs with such names, made by `drgs sfm`; its folder has one, too."""
    folder = tmp_path_factory.mktemp("names")
    photos = folder / "my photos (é) #1"
    photos.mkdir()
    for path, name in zip(list_images(corner[0]), NAMES, strict=True):
        shutil.copy(path, photos / name)
    out = folder / "the scene [1] & 'more'"
    assert main(["sfm", str(photos), "-o", str(out), "--quiet"]) == 0
    return out


@pytest.mark.slow
def test_from_photographs_to_a_report(named, tmp_path, capsys):
    """Every command that reads or writes them; each view has a picture of its own, and the report shows the names."""
    run, tiny = tmp_path / "a run (é) %20", ["--width", "40", "--height", "30"]
    data = load(named)
    assert [view.image_path.name for view in data.views] == sorted(NAMES)
    assert len({view.name for view in data.views}) == 7
    assert data.views[0].image().shape == (240, 320, 3)
    options = ["--max-steps", "4", "--max-gaussians", "200", "--test-every", "2", "--quiet"]
    assert main(["fit", str(named), "-o", str(run), *options]) == 0
    assert main(["eval", str(run), "--quiet"]) == 0
    told = json.loads((run / "metrics.json").read_text())
    test = {view.name for view in data.split(test_every=2)[1]}
    assert {name for name in test if json.dumps(name) in json.dumps(told)} == test
    pictures = tmp_path / "pictures & more"
    cameras = ["--cameras", str(named), "--split", "all"]
    assert main(["render", str(run), *cameras, *tiny, "--format", "png", "-o", str(pictures), "--quiet"]) == 0
    assert len(list(pictures.glob("*.png"))) == 7
    chosen = tmp_path / "picks #1.json"
    assert main(["select", str(run), "--candidates", str(named), "-k", "1", "-o", str(chosen), "--quiet"]) == 0
    assert json.loads(chosen.read_text())["picks"][0]["name"] in test
    assert main(["report", str(run), "--quiet"]) == 0
    page = html.unescape((run / "report.html").read_text())
    assert all(name in page for name in test)
    assert capsys.readouterr().err == ""


def test_commands_that_are_proposed_can_be_typed(corner, tmp_path, monkeypatch, capsys):  # noqa: F811
    """Quoted as a shell wants it."""
    from drgs.commands import sfm
    from drgs.sfm.reconstruction import SfmSummary

    out = tmp_path / "my scene (1)"
    monkeypatch.setattr(sfm, "run_sfm", lambda *_, **__: SfmSummary(7, 7, 10, 0.5, 1, {"features": 1.0}, ()))
    assert main(["sfm", str(corner[0]), "-o", str(out)]) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("next: "))
    assert shlex.split(line)[1:] == ["drgs", "fit", str(out), "-o", "RUN"]


@pytest.mark.parametrize("points", [True, False])
def test_colmap_text(named, tmp_path, points):
    """A name is the rest of its line, whatever pycolmap makes of it."""
    (tmp_path / "sparse").mkdir()
    pycolmap.Reconstruction(str(named / "sparse/0")).write_text(str(tmp_path / "sparse"))
    (tmp_path / "images").symlink_to(named / "images")
    data = load(tmp_path, points=points)
    assert [view.image_path.name for view in data.views] == sorted(NAMES)
    binary = load(named)
    assert all(
        np.allclose(a.camera.w2c, b.camera.w2c, atol=1e-6) for a, b in zip(data.views, binary.views, strict=True)
    )
    file = tmp_path / "sparse/images.txt"
    file.write_text(file.read_text().replace("\n1 ", "\n1.5 ", 1))
    with pytest.raises(ValueError, match=r"images\.txt: line \d+ must hold a whole number as its ID, got 1\.5"):
        load(tmp_path)


def test_transforms(named, tmp_path):
    """And in JSON, with and without the suffix."""
    (tmp_path / "images").symlink_to(named / "images")
    frames = [
        {"file_path": f"images/{name if i % 2 else name[:-4]}", "transform_matrix": np.eye(4).tolist()}
        for i, name in enumerate(NAMES)
    ]
    for i, frame in enumerate(frames):
        frame["transform_matrix"][0][3] = float(i)
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    data = load(tmp_path)
    assert {view.image_path.name for view in data.views} == set(NAMES)
    assert {view.name for view in data.views} == {name[:-4] for name in NAMES}


@pytest.mark.parametrize("name", ["two\nlines.png", "tab\there.png", os.fsdecode(b"latin \xe9.png")])
def test_names_that_no_model_can_hold(corner, tmp_path, name, capsys):  # noqa: F811
    """One line, before any work, where too few others are left; else they are left out (test_sfm.py)."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for path in list_images(corner[0])[:1]:
        shutil.copy(path, photos)
    try:
        shutil.copy(path, os.path.join(photos, name))
    except OSError as error:
        pytest.skip(f"this file system has no such names: {error}")
    assert main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "the name of a photo must be one line of UTF-8 without control characters, got " in told[0]
    assert not (tmp_path / "out").exists()


def test_hidden_photos_are_said(corner, tmp_path, caplog):  # noqa: F811
    """Left out, as on every system; not those that macOS makes of others."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.png", ".IMG 1.png", "._a.png"):
        shutil.copy(list_images(corner[0])[0], photos / name)
    with pytest.raises(ValueError, match="must hold at least 2 photos, got 1"):
        run_sfm(photos, tmp_path / "out")
    assert "1 hidden photos are left out (.IMG 1.png); rename them to use them" in caplog.text


def test_names_of_pictures():
    """As long as every file system allows, in bytes, and all different."""
    names = ["写" * 150, "写" * 149 + "x", "a/b", "a b", "🙂", "..", "", "é" * 60]
    found = file_names(names)
    assert len(set(found)) == len(names)
    assert max(len(name.encode()) for name in found) <= 110
    assert not any(name.startswith(".") or "/" in name for name in found)
    found = file_names(["a_0002", "a", "a", "a/b", "a_b", ""])  # a number must not make two of them equal
    assert found[:2] == ["a_0002", "a"]
    assert len(set(found)) == 6
