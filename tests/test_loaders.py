"""Claims of drgs.data.LOADERS: a format is a row; one from elsewhere is asked last, and gets the options it has."""

from __future__ import annotations

import inspect

import cv2
import numpy as np
import pytest

from drgs import data
from drgs.cameras import Camera, look_at
from drgs.data import LOADERS, Dataset, Format, View, load

pytestmark = pytest.mark.core


def load_stills(path, background=(0.0, 0.0, 0.0), lazy=False):
    """A view of every image, from one place each."""
    K = np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])
    views = []
    for k, image in enumerate(sorted(path.glob("*.png"))):
        pose = look_at((3 * np.cos(k), 3 * np.sin(k), 1), (0, 0, 0), (0, 0, 1))
        views.append(View(Camera(K, pose, 32, 24), image.stem, image, background=background, is_checked=not lazy))
    return Dataset(path, "stills", views)


@pytest.fixture
def stills(tmp_path):
    """A folder of four images and a file that marks it; the table is as it was afterwards."""
    folder = tmp_path / "stills"
    folder.mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((24, 32, 3), 40 * k, np.uint8))
    (folder / "stills.json").write_text("{}")
    yield folder
    LOADERS.pop("stills", None)


def is_stills(path):
    return path.name == "stills.json" if path.is_file() else (path / "stills.json").is_file()


def test_a_row_of_a_script(stills):
    """An assignment is enough: the folder is recognized, splits and semantics are as of any format."""
    with pytest.raises(FileNotFoundError, match="must hold camera poses, found 4 photos without"):
        load(stills)
    LOADERS["stills"] = Format(is_stills, load_stills, ("stills.json",))
    dataset = load(stills, background=(1.0, 0.5, 0.0), test_every=2)
    assert dataset.format == "stills"
    assert [view.name for view in dataset.split()[1]] == ["0", "2"]
    assert dataset.views[0].background == (1.0, 0.5, 0.0)


def test_a_file_that_is_named_itself(stills):
    """A JSON file that a format recognizes is not taken for a transforms.json, which may have any name."""
    LOADERS["stills"] = Format(is_stills, lambda path, lazy: load_stills(path.parent), ("stills.json",))
    assert load(stills / "stills.json").format == "stills"
    (stills / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="must be an object with a list `frames`"):
        load(stills / "other.json")


def test_options_that_a_format_has(stills):
    """A loader gets the options that it has parameters for, and no other."""
    got = {}

    def loader(path, strict, times, test_cameras):
        got.update(strict=strict, times=times, test_cameras=test_cameras)
        return load_stills(path)

    LOADERS["stills"] = Format(is_stills, loader)
    load(stills, strict=True, times=7, lazy=True)
    assert got == {"strict": True, "times": 7, "test_cameras": None}


def test_a_loader_that_cannot_be(stills):
    """A parameter that is no option, which would never be given, and a result that is no data set are one line each."""
    LOADERS["stills"] = Format(is_stills, lambda path, backgruond=(0, 0, 0): load_stills(path))
    with pytest.raises(ValueError, match=r"loader of format 'stills' must take a path and, .* has a parameter backgru"):
        load(stills)
    LOADERS["stills"] = Format(is_stills, lambda path: [])
    with pytest.raises(ValueError, match="loader of format 'stills' must return a drgs.data.Dataset, got list"):
        load(stills)
    with pytest.raises(ValueError, match="data set format 'stills': must be a drgs.data.formats.Format, got function"):
        LOADERS["stills"] = load_stills


def test_own_formats_come_first(stills):
    """Nothing that is added changes what a folder of a known format is."""
    LOADERS["stills"] = Format(is_stills, load_stills)
    (stills / "transforms.json").write_text("{}")
    with pytest.raises(ValueError, match="transforms.json: must be an object with a list `frames`"):
        load(stills)


def test_every_format_has_options_of_load_alone():
    """No loader of the package swallows what it does not know: `**` would take a mistyped option in silence."""
    options = {"background", "lazy", "points", "strict", "test_every", "test_offset", "times", "test_cameras"}
    assert options <= set(inspect.signature(load).parameters)
    for name, form in LOADERS.items():
        _, *parameters = inspect.signature(form.load).parameters.values()
        assert {p.name for p in parameters} <= options, name
        assert all(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters), name
    with pytest.raises(TypeError, match="tset_every"):
        load("nowhere", tset_every=3)


def test_the_message_is_made_of_the_rows(tmp_path, stills):
    """What was looked for, in the order in which it was, names formats from elsewhere, too."""
    LOADERS["stills"] = Format(is_stills, load_stills, ("stills.json",))
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError) as error:
        data.load(tmp_path / "empty")
    said = str(error.value)
    names = [name for form in LOADERS.values() for name in form.looks_for]
    assert ", ".join(names) in said
    assert names[0] == "transforms.json"
    assert names[-1] == "stills.json"
