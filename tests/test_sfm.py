"""Structure from motion: on a small rendered scene, on real photos when present, and its bad
input.
"""

from __future__ import annotations

import os
import re
import shutil

import numpy as np
import pytest
from test_data_points import HEIGHT, WIDTH, plane_views, render_plane, texture

from drgs.cameras import Camera, intrinsics, look_at
from drgs.data import load
from drgs.sfm.mapping import _gaps, name_ranges
from drgs.sfm.matching import FeatureOptions, extract
from drgs.sfm.photo_files import photo_fault
from drgs.sfm.reconstruction import SfmOptions, run_sfm

pytest.importorskip("pycolmap")
cv2 = pytest.importorskip("cv2")


def aligned_error(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance between two point lists after the best similarity, relative to the
    spread.
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1).max() / np.abs(b).max()


def corner_walls(rng) -> list[tuple[np.ndarray, np.ndarray]]:
    """Three walls that meet in a corner: the frame of each in the world, whose square z = 0 it is, and its texture."""
    walls = []
    for axes, center in [
        (([1, 0, 0], [0, 1, 0], [0, 0, 1]), (0, 0, -1.5)),
        (([0, 0, 1], [1, 0, 0], [0, 1, 0]), (0, -1.5, 0)),
        (([0, 1, 0], [0, 0, 1], [1, 0, 0]), (-1.5, 0, 0)),
    ]:
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = np.transpose(axes), center
        walls.append((world, texture(rng)))
    return walls


def corner_photo(camera: Camera, walls: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """(H,W,3) in [0,1], and (H,W) bool of where a wall is seen."""
    photo, seen = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH), bool)
    for world, image in walls:
        local = Camera(camera.K, camera.w2c @ world, WIDTH, HEIGHT)
        color, depth = render_plane(local, image, half=1.5)
        photo = np.where(depth[..., None] > 0, color, photo)
        seen |= depth > 0
    return photo, seen


def corner_camera(index: int, distance: float = 4.0) -> Camera:
    """A step along an arc around the corner."""
    angle = 0.3 + 0.15 * index
    eye = (distance * np.sin(angle), 1.5 + 0.3 * (index % 3), distance * np.cos(angle))
    return Camera(
        intrinsics(384, 384, WIDTH / 2, HEIGHT / 2), look_at(eye, (-0.8, -0.8, -0.8), (0, 1, 0)), WIDTH, HEIGHT
    )


def write_photo(path, photo: np.ndarray) -> None:
    """RGB or RGBA in [0,1]."""
    order = [2, 1, 0, 3][: photo.shape[2]]
    assert cv2.imwrite(str(path), np.round(photo[..., order] * 255).astype(np.uint8))


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """Photos of three textured walls that meet in a corner, and their cameras."""
    folder = tmp_path_factory.mktemp("corner")
    walls = corner_walls(np.random.default_rng(5))
    cameras = [corner_camera(index) for index in range(7)]
    for index, camera in enumerate(cameras):
        write_photo(folder / f"{index}.png", corner_photo(camera, walls)[0])
    return folder, cameras


def add_bad_entries(folder, whole) -> dict[str, str]:
    """What a folder of photographs may also hold: name of each -> what is said of it.

    Args:
        folder: The folder.
        whole: A photograph.
    """
    data = cv2.imencode(".jpg", cv2.imread(str(whole)))[1].tobytes()
    (folder / "cut.jpg").write_bytes(data[: len(data) // 2])
    (folder / "empty.jpg").touch()
    assert cv2.imwrite(str(folder / "tiny.png"), np.zeros((1, 1, 3), np.uint8))
    assert cv2.imwrite(str(folder / "strip.png"), np.zeros((20, 3200, 3), np.uint8))
    os.mkfifo(folder / "pipe.jpg")
    (folder / "gone.jpg").symlink_to("nowhere.jpg")
    (folder / "folder.png").mkdir()
    shutil.copy(whole, folder / "two\nlines.png")
    return {
        "cut.jpg": "must be a whole image, its data end early",
        "empty.jpg": "must be an image, could not be decoded",
        "tiny.png": "must be 16 pixels high and wide to have features, is 1x1",
        "strip.png": "is 3200x20 at 1600 pixels along the longer side",
        "pipe.jpg": "must be a file, is a pipe or a device",
        "gone.jpg": "must be a file, is a link to nowhere.jpg, where nothing is",
        "folder.png": "must be a file, is a folder",
        "two\\nlines.png": "must be one line of UTF-8",
    }


@pytest.fixture(scope="module")
def turntable(tmp_path_factory):
    """Photos of the corner as an object that turns before a camera that stands still, masks, and its cameras."""
    folder = tmp_path_factory.mktemp("turntable")
    rng = np.random.default_rng(6)
    walls, backdrop = corner_walls(rng), cv2.resize(texture(rng), (WIDTH, HEIGHT))
    cameras = [corner_camera(index, distance=7.0) for index in range(5)]
    for name in ("images", "masks", "alpha"):
        (folder / name).mkdir()
    for index, camera in enumerate(cameras):
        photo, seen = corner_photo(camera, walls)
        photo = np.where(seen[..., None], photo, backdrop)
        write_photo(folder / "images" / f"{index}.png", photo)
        write_photo(folder / "alpha" / f"{index}.png", np.concatenate([photo, seen[..., None]], axis=-1))
        # COLMAP's name or the short one, 0 and 255 or 0 and 1.
        name = f"{index}.png.png" if index % 2 else f"{index}.png"
        assert cv2.imwrite(str(folder / "masks" / name), seen.astype(np.uint8) * (255 if index % 3 else 1))
    return folder, cameras


def test_recovers_poses_and_loads(corner, tmp_path, tmp_path_factory):
    """All photos found, centers right up to a similarity, result replaceable; what is no photo is left out."""
    made, cameras = corner
    folder = shutil.copytree(made, tmp_path_factory.mktemp("photos") / "photos")
    add_bad_entries(folder, folder / "0.png")
    stages, doing = [], []
    out = tmp_path / "out"
    summary = run_sfm(folder, out, progress=lambda *step: stages.append(step), status=doing.append)
    assert (summary.registered, summary.total, summary.missing) == (7, 7, ())
    assert summary.explanation == ()
    assert summary.points > 100
    assert summary.reprojection_error < 1.0
    assert {stage for stage, _, _ in stages} == {"features", "matching", "mapping"}
    assert all(done <= total for _, done, total in stages)
    # COLMAP's log is heard, whose lines another version may word in another way.
    for what in (
        "reading the matches",
        "looking for two photos to begin with",
        "triangulating from two photos",
        "finding the pose of a photo",
        "bundle adjustment",
        "retriangulation and bundle adjustment",
        "final retriangulation and bundle adjustment",
    ):
        assert any(text.startswith(what) for text in doing), what
    assert [done for stage, done, _ in stages if stage == "mapping" and done > 1][-1] == 7
    assert (out / "database.db").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    dataset = load(out)
    assert len(dataset.views) == 7
    found = np.stack([view.camera.center for view in dataset.views])
    assert aligned_error(found, np.stack([camera.center for camera in cameras])) < 0.05
    assert dataset.views[0].image().shape == (240, 320, 3)
    assert len(dataset.points) == summary.points
    # Again onto the same place: replaced, whole.
    (out / "notes.txt").write_text("mine")
    again = run_sfm(folder, out, SfmOptions(matching="sequential"))
    assert again.registered == 7
    assert len(load(out).views) == 7
    assert sorted(path.name for path in out.iterdir()) == [
        ".drgs.jsonl", "database.db", "images", "notes.txt", "sparse"
    ]  # fmt: skip
    # Refined by hand: no longer what was made here.
    (out / "sparse" / "0" / "points3D.bin").write_bytes(b"refined")
    with pytest.raises(ValueError, match="sparse: must not be replaced"):
        run_sfm(folder, out)
    assert (out / "sparse" / "0" / "points3D.bin").read_bytes() == b"refined"


@pytest.mark.slow
def test_what_was_turned_is_found_by_its_masks(turntable, tmp_path):
    """Before a background that stands still an object that turns has poses by masks, which the data set keeps."""
    folder, cameras = turntable
    with pytest.raises(ValueError, match=r"no two of 5 could be connected; .* name masks of what was turned"):
        run_sfm(folder / "images", tmp_path / "without")
    for kind, masks in (("images", folder / "masks"), ("alpha", "alpha")):
        out = tmp_path / kind
        assert run_sfm(folder / kind, out, SfmOptions(masks=masks)).registered == 5
        views = load(out).views
        found = np.stack([view.camera.center for view in views])
        assert aligned_error(found, np.stack([cameras[int(view.name)].center for view in views])) < 0.05
        assert all(view.mask_path is not None for view in views)
        assert 0.1 < views[0].mask().mean() < 0.9
        assert (out / "masks").is_symlink() == (kind == "images")
    # Again without: masks of an earlier result would say what no longer holds.
    run_sfm(folder / "alpha", out, SfmOptions(masks=folder / "masks"))
    assert (out / "masks").resolve() == folder / "masks"
    with pytest.raises(ValueError, match="could be connected"):
        run_sfm(folder / "alpha", out)
    assert (out / "masks").is_symlink()  # nothing took the place of that result


@pytest.fixture
def masked(tmp_path, rng):
    """Two photos, one of them with alpha, and a mask of each."""
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    plane_views(photos, rng, count=2)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    for name in ("0.png", "1.png"):
        assert cv2.imwrite(str(masks / name), mask)
    return photos, masks


def _no_folder(photos, masks):
    return masks / "gone", "gone: --masks must be a folder of masks or the word alpha, found none"


def _file(photos, masks):
    return masks / "0.png", "0.png: --masks must be a folder of masks or the word alpha, found a file"


def _empty(photos, masks):
    for file in masks.iterdir():
        file.unlink()
    return masks, "masks: must hold a mask of every photo, named as 0.png.png or 0.png, found none"


def _missing(photos, masks):
    (masks / "1.png").unlink()
    return masks, r"masks: must hold a mask of every photo, .*, has none of 1 of 2 \(1.png\); add them"


def _shape(photos, masks):
    assert cv2.imwrite(str(masks / "1.png"), np.full((HEIGHT, HEIGHT), 255, np.uint8))
    return masks, rf"1.png: must have the shape of its image \({WIDTH}x{HEIGHT}\), got {HEIGHT}x{HEIGHT}"


def _black(photos, masks):
    assert cv2.imwrite(str(masks / "1.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    return masks, r"1.png: must keep something of its photo \(white\), is black all over"


def _no_alpha(photos, masks):
    return "alpha", "0.png: must have an alpha channel for --masks alpha, has none"


def _photos(photos, masks):
    return photos, "photos: must hold a mask of every photo, .*, found none"


@pytest.mark.parametrize("bad", [_no_folder, _file, _empty, _missing, _shape, _black, _no_alpha, _photos])
def test_bad_masks(masked, tmp_path, capfd, bad):
    """Each in a line, before any feature is looked for, and nothing is written."""
    from drgs import cli

    photos, masks = masked
    masks, message = bad(photos, masks)
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["sfm", str(photos), "-o", str(tmp_path / "out"), "--masks", str(masks), "--quiet"]) == 2
    complaint = capfd.readouterr().err
    assert re.search(message, complaint)
    assert complaint.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_name_that_leaves_no_room_for_its_mask(masked, tmp_path, capfd):
    """COLMAP wants .png behind the photo's name, and file systems end names at 255 bytes."""
    from drgs import cli

    photos, _ = masked
    first = sorted(photos.iterdir())[0]
    first.rename(photos / ("a" * 248 + first.suffix))
    line = ["sfm", str(photos), "-o", str(tmp_path / "out"), "--masks", "alpha", "--quiet"]
    assert cli.main(line) == 2
    complaint = capfd.readouterr().err
    assert "with masks, the name of a photo must have at most 251 bytes, got 252: aaa" in complaint
    assert complaint.count("\n") == 1


def test_names_in_words():
    """However many photographs are left out, a line stays a line."""
    names = [f"{i:04d}" for i in range(100)]
    assert name_ranges(names[3:9] + names[20:22], names) == "0003 to 0008, 0020, 0021"
    assert name_ranges(names[::2], names).endswith("0020, 0022, and 38 more")
    found = _gaps(names, {"0010", "0011"}, [["0013"], ["0000", "0001"], ["0050"]], {("0050", "0011"): 7})
    assert found == [("0011", "0050", 7), ("0011", "0013", 0), ("0010", "0001", 0)]


def test_masks_of_others_stay(masked, tmp_path):
    """A folder of masks in the output that was not made here is refused, before any work."""
    photos, masks = masked
    mine = tmp_path / "out" / "masks" / "0.png"
    mine.parent.mkdir(parents=True)
    mine.write_text("hours of work")
    with pytest.raises(ValueError, match="masks.*: must not be replaced"):
        run_sfm(photos, tmp_path / "out", SfmOptions(masks=masks))
    assert mine.read_text() == "hours of work"


@pytest.mark.slow
def test_photos_that_fall_apart(tmp_path, capsys, monkeypatch):
    """Two places and a blank photo: which model was kept, what the other holds, what is in none, and what helps."""
    from drgs import cli
    from drgs.display.progress import Bar

    photos = tmp_path / "photos"
    photos.mkdir()
    for start, seed, count in ((0, 5, 7), (7, 8, 7)):
        walls = corner_walls(np.random.default_rng(seed))
        for index in range(count):
            write_photo(photos / f"{start + index:02d}.png", corner_photo(corner_camera(index), walls)[0])
    write_photo(photos / "14.png", np.full((HEIGHT, WIDTH, 3), 0.5))
    texts, update = set(), Bar.update

    def updated(bar, done, total=None, label=None, text=None):
        texts.add(text)
        update(bar, done, total, label, text)

    monkeypatch.setattr(Bar, "update", updated)
    assert cli.main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    first, second = "00.png to 06.png", "07.png to 13.png"
    if "kept, with 7 photos: 00" not in told:
        first, second = second, first
    assert "7 of 15 photos have a pose" in told
    assert f"the photos fell apart into 2 models; the largest was kept, with 7 photos: {first}" in told
    assert f"model 2, left out, has 7 photos: {second}" in told
    assert "in no model: 1 photos: 14.png" in told
    assert re.search(r"what would help: photos between 0\d.png and 0\d.png \(nothing connects them\)", told)
    assert "what would help: a sharper, brighter photo in place of 14.png (0)" in told
    assert "what would help: --masks, if the object was turned" in told
    assert "--matcher exhaustive" not in told  # which it was
    assert any("attempt 2, retriangulation and bundle adjustment" in text for text in texts if text)


@pytest.mark.parametrize("part", ["images", "sparse", "database.db", "database.db-wal"])
def test_projects_of_others_stay(tmp_path, rng, part):
    """Each part of a COLMAP project is refused by itself, before any work, and neighbors are not touched."""
    photos, project = tmp_path / "photos", tmp_path / "project"
    photos.mkdir()
    plane_views(photos, rng, count=2)
    files = {"images": "images/a.jpg", "sparse": "sparse/0/points3D.bin"}
    for file in (project / files.get(part, part), tmp_path / "project.partial" / "mine"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("hours of work")
    before = sorted(tmp_path.rglob("*"))
    stages = []
    with pytest.raises(ValueError, match=rf"{part}: must not be replaced.*; choose another output \(-o\)") as error:
        run_sfm(photos, project, progress=lambda *step: stages.append(step))
    assert "\n" not in str(error.value)
    assert not stages
    assert sorted(tmp_path.rglob("*")) == before
    assert (project / files.get(part, part)).read_text() == "hours of work"


def test_photos_that_do_not_connect(tmp_path, rng):
    """Nothing is left behind."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for index in range(3):
        assert cv2.imwrite(str(photos / f"{index}.png"), np.full((60, 80, 3), 90 * index, np.uint8))
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="no two of 3 could be connected") as error:
        run_sfm(photos, out)
    assert "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_photo_that_cannot_be_used_is_named(tmp_path, corner):
    """Each with what is wrong with it; where too few are left, in one line."""
    whole = corner[0] / "0.png"
    wanted = add_bad_entries(tmp_path, whole)
    for path in sorted(tmp_path.iterdir()):
        fault = photo_fault(path)
        assert "\n" not in fault
        assert wanted[path.name.replace("\n", "\\n")] in fault
        assert path.name.replace("\n", "\\n") in fault
    assert photo_fault(tmp_path / "strip.png", 3200) == ""
    assert photo_fault(whole) == ""
    with pytest.raises(ValueError, match=r"must hold at least 2 photos that can be used, got 0; .*cut.jpg: must be"):
        run_sfm(tmp_path, tmp_path / "out")
    (tmp_path / "link.jpg").symlink_to("cut.jpg")  # as a capture has them
    assert photo_fault(tmp_path / "link.jpg").startswith(f"{tmp_path / 'cut.jpg'}: must be a whole image")


def test_a_crash_of_the_detector_is_one_line(tmp_path, corner, capfd):
    """COLMAP's own, over a picture that `run_sfm` does not let through; the next ones have features."""
    assert cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((15, 15, 3), np.uint8))
    with pytest.raises(ValueError, match=r"^") as error:
        extract(tmp_path / "a.db", tmp_path, ["tiny.png"], FeatureOptions())
    assert str(error.value) == (
        f"{tmp_path / 'tiny.png'}: must be a photograph that COLMAP finds features in, the process that reads it ended "
        "with SIGSEGV; leave it out"
    )
    assert capfd.readouterr().err == ""
    extract(tmp_path / "b.db", corner[0], ["0.png"], FeatureOptions(max_image_size=160))


def test_bad_input(tmp_path, rng):
    """Each bad argument has its line."""
    with pytest.raises(FileNotFoundError, match="must be a folder of photos"):
        run_sfm(tmp_path / "gone", tmp_path / "out")
    photos = tmp_path / "photos"
    photos.mkdir()
    with pytest.raises(ValueError, match="must hold at least 2 photos, got 0"):
        run_sfm(photos, tmp_path / "out")
    plane_views(photos, rng, count=2)
    with pytest.raises(ValueError, match="camera_model must be one of .*, got 'FOV'"):
        run_sfm(photos, tmp_path / "out", SfmOptions(camera_model="FOV"))
    with pytest.raises(ValueError, match="matching must be auto, exhaustive, sequential or retrieval"):
        run_sfm(photos, tmp_path / "out", SfmOptions(matching="all"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be a folder that can be written, got: File exists"):
        run_sfm(photos, tmp_path / "file")
    (photos / "1.png").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="1.png: must be an image, could not be decoded"):
        run_sfm(photos, tmp_path / "out")


@pytest.mark.slow
def test_real_banana(data_dir, tmp_path):
    """At least 14 of the 16 poses."""
    photos = data_dir / "banana" / "images"
    if not photos.is_dir():
        pytest.skip(f"no banana data set in {data_dir}")
    summary = run_sfm(photos, tmp_path / "out")
    assert summary.total == 16
    assert summary.registered >= 14
    assert summary.reprojection_error < 0.5
    assert len(load(tmp_path / "out").views) == summary.registered
