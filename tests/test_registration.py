"""Further photographs get poses in the world of a data set that is there, whose own poses stay as they are."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
from test_sfm import (
    aligned_error,
    corner,  # noqa: F401 (a fixture)
    write_photo,
)

from drgs.data import load
from drgs.data.images import list_images
from drgs.io.outputs import lock_folder
from drgs.sfm.image_folder import FRAMES
from drgs.sfm.reconstruction import SfmOptions, run_sfm
from drgs.sfm.registration import register

pytest.importorskip("pycolmap")
FIRST = (0, 1, 3, 5)


@pytest.fixture(scope="module")
def first(corner, tmp_path_factory):  # noqa: F811
    """A data set of four of the seven photographs of the corner; treat as read-only."""
    photos, _ = corner
    folder = tmp_path_factory.mktemp("first")
    (folder / "photos").mkdir()
    for index in FIRST:
        shutil.copyfile(photos / f"{index}.png", folder / "photos" / f"{index}.png")
    assert run_sfm(folder / "photos", folder / "scene").registered == 4
    return folder


@pytest.fixture
def scene(first, tmp_path):
    """A copy of it."""
    shutil.copytree(first / "scene", tmp_path / "scene", symlinks=True)
    return tmp_path / "scene"


def content(folder) -> dict:
    """Every file and link in a folder, but the journal."""
    files = (path for path in folder.rglob("*") if path.is_symlink() or path.is_file())
    return {
        path.relative_to(folder): path.resolve() if path.is_symlink() else path.read_bytes()
        for path in files
        if path.name != ".drgs.jsonl"
    }


def poses(folder) -> dict[str, np.ndarray]:
    return {view.image_path.name: view.camera.w2c for view in load(folder).views}


@pytest.mark.slow
def test_a_second_batch(corner, first, scene, tmp_path):  # noqa: F811
    """Poses that were there stay, new ones are right in the same world, and what was shown stays shown."""
    photos, cameras = corner
    more = tmp_path / "more"
    more.mkdir()
    # One of a name that is taken, one under its own, and one that shows something else.
    shutil.copyfile(photos / "2.png", more / "0.png")
    shutil.copyfile(photos / "4.png", more / "new.png")
    write_photo(more / "else.png", np.full((240, 320, 3), 0.5))
    row = {"file": "new.png", "video": "clip.mp4", "index": 7, "seconds": 0.7}
    listed = {"schema": 1, "command": "sfm", "videos": [{"video": "clip.mp4"}], "frames": [row], "findings": []}
    (more / FRAMES).write_text(json.dumps(listed))
    before, width = poses(scene), load(scene).views[0].camera.K[0, 0]
    stages = []
    found = register(scene, list_images(more), progress=lambda *step: stages.append(step))
    assert found.added == ("0_2.png", "else.png", "new.png")
    assert found.posed == ("0_2.png", "new.png")
    assert found.moved < 1e-9
    assert (found.summary.registered, found.summary.total, found.summary.missing) == (6, 7, ("else.png",))
    assert any("in no model: 1 photos: else.png" in line for line in found.summary.explanation)
    assert any("a sharper, brighter photo in place of else.png" in line for line in found.summary.explanation)
    assert found.summary.reprojection_error < 1.0
    assert {stage for stage, _, _ in stages} == {"features", "matching", "mapping"}
    after = poses(scene)
    assert after.keys() == before.keys() | set(found.posed)
    for name, pose in before.items():
        assert np.abs(after[name] - pose).max() < 1e-9
    order = [*(f"{index}.png" for index in FIRST), "0_2.png", "new.png"]
    centers = np.stack([-after[name][:3, :3].T @ after[name][:3, 3] for name in order])
    true = np.stack([cameras[index].center for index in (*FIRST, 2, 4)])
    assert aligned_error(centers, true) < 0.05
    views = load(scene).views
    assert {view.camera.K[0, 0] for view in views} == {width}  # one lens, which did not change
    assert views[0].image().shape == (240, 320, 3)
    # The folder of the first photographs was not added to; that of the data set leads to all.
    assert len(list_images(first / "photos")) == 4
    assert (scene / "images" / "0_2.png").resolve() == more / "0.png"
    assert json.loads((scene / "images" / FRAMES).read_text())["frames"] == [row]
    assert {path.name for path in scene.iterdir()} == {".drgs.jsonl", "database.db", "images", "sparse"}
    # A third one, with a lens of its own: of another size.
    import cv2

    third = tmp_path / "6.png"
    image = cv2.imread(str(photos / "6.png"))
    assert cv2.imwrite(str(third), cv2.resize(image, None, fx=1.5, fy=1.5))
    again = register(scene, [third])
    assert again.posed == ("6.png",)
    last = poses(scene)
    assert all(np.abs(last[name] - pose).max() < 1e-9 for name, pose in after.items())
    focal = {view.image_path.name: view.camera.K[0, 0] for view in load(scene).views}
    assert focal["6.png"] == pytest.approx(1.5 * width, rel=0.05)
    with pytest.raises(ValueError, match="6.png: must be a new photograph, is in .* already"):
        register(scene, [third])
    # All at once replaces it: everything in it is drgs' own.
    assert run_sfm(first / "photos", scene, SfmOptions(matching="sequential")).registered == 4
    assert (scene / "images").resolve() == first / "photos"


def test_what_cannot_be_connected_changes_nothing(scene, tmp_path):
    """One line that says what would help."""
    before = content(scene)
    write_photo(tmp_path / "blank.png", np.full((240, 320, 3), 0.5))
    with pytest.raises(ValueError, match="none of 1 could be connected; what would help: ") as error:
        register(scene, [tmp_path / "blank.png"])
    assert "\n" not in str(error.value)
    assert content(scene) == before


def test_what_is_refused(corner, scene, tmp_path):  # noqa: F811
    """Each before any work, and nothing changes."""
    photos, _ = corner
    new = photos / "2.png"
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "masked").mkdir()
    shutil.copytree(scene, tmp_path / "masked", symlinks=True, dirs_exist_ok=True)
    (tmp_path / "masked" / "masks").mkdir()
    before = content(tmp_path)
    for folder, files, error, message in (
        (tmp_path / "gone", [new], FileNotFoundError, "must be a data set that `drgs sfm` made, has no database.db"),
        (tmp_path / "masked", [new], ValueError, "must be a data set without masks"),
        (scene, [], ValueError, "there must be photographs to join to it, got none"),
        (scene, [photos / "gone.png"], FileNotFoundError, "gone.png: must be a photograph, found none"),
        (scene, [tmp_path / "notes.txt"], ValueError, "notes.txt: must be a photograph"),
        (scene, [new, new], ValueError, "2.png: must be a new photograph, .* named twice"),
        (scene, [scene / "images" / "0.png"], ValueError, "0.png: must be a new photograph"),
    ):
        with pytest.raises(error, match=message):
            register(folder, files)
    (scene / "sparse" / "0" / "points3D.bin").write_bytes(b"refined")
    with pytest.raises(ValueError, match=re.escape("sparse: must not be replaced")):
        register(scene, [new])
    (scene / "sparse" / "0" / "points3D.bin").write_bytes(
        before[(scene / "sparse/0/points3D.bin").relative_to(tmp_path)]
    )
    assert content(tmp_path) == before


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
def test_a_damaged_model_is_refused_in_our_words(corner, scene, name):  # noqa: F811
    """As of a copy that was cut short, whose files no record has: the file is named, not COLMAP's code."""
    file = scene / "sparse" / "0" / name
    file.write_bytes(file.read_bytes()[:-9])
    (scene / ".drgs.jsonl").unlink()
    with lock_folder(scene, "sfm") as output:
        output.record_existing([path.relative_to(scene).as_posix() for path in scene.rglob("*")], "sfm")
    before = content(scene)
    with pytest.raises(ValueError, match=rf"{re.escape(str(file))}: must hold .* copy it again$"):
        register(scene, [corner[0] / "2.png"])
    assert content(scene) == before
