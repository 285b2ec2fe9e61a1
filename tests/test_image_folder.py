"""Photographs and videos of any number in one folder, with the times of frames beside them; and poses of such a mix."""

from __future__ import annotations

import json
import os
import re
import shutil

import cv2
import numpy as np
import pytest
from json_page import check
from made_videos import film, pictures, walk_cameras
from test_sfm import write_photo

from drgs import cli
from drgs.data import load
from drgs.data.images import list_images
from drgs.io.outputs import lock_folder
from drgs.sfm.image_folder import FRAMES, joined_frames, make_image_folder, named_files, recorded_frames, usable_files


@pytest.fixture(scope="module")
def walk():
    """Pictures of a walk."""
    return pictures(walk_cameras(12, step=0.08))


@pytest.fixture
def shoot(walk, tmp_path):
    """A folder with two photographs, one of them with its moment, and a video; and one with a video of that name."""
    photos, other = tmp_path / "photos", tmp_path / "other"
    photos.mkdir()
    other.mkdir()
    for name in ("IMG_1.jpg", "IMG_2.png"):
        assert cv2.imwrite(str(photos / name), walk[0])
    film(photos / "clip.mp4", walk)
    shutil.copyfile(photos / "clip.mp4", photos / "IMG_1.MOV")
    film(other / "clip.mp4", walk[::-1])
    shutil.copyfile(photos / "IMG_1.jpg", other / "IMG_1.jpg")
    return photos, other


def rows_of(folder):
    return json.loads((folder / FRAMES).read_text())


def test_what_is_named(shoot, tmp_path, caplog):
    """Folders and files, each once; the moment of a photograph is left out unless it is named itself."""
    photos, other = shoot
    found = named_files([photos, other / "clip.mp4", photos / "IMG_2.png", photos / ".." / "photos" / "clip.mp4"])
    assert [path.name for path in found[0]] == ["IMG_1.jpg", "IMG_2.png"]
    assert found[1] == [photos / "clip.mp4", other / "clip.mp4"]
    assert named_files([photos / "IMG_1.MOV"]) == ([], [photos / "IMG_1.MOV"])
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "link.mp4").symlink_to("gone.mp4")
    found = named_files([tmp_path / "pipe.jpg", photos / "IMG_2.png", tmp_path / "link.mp4"])
    assert found == ([photos / "IMG_2.png"], [])
    assert caplog.messages == [
        f"left out: {tmp_path}/pipe.jpg: must be a file, is a pipe or a device; restore or remove it",
        f"left out: {tmp_path}/link.mp4: must be a file, is a link to gone.mp4, where nothing is; restore or remove it",
    ]
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "gone", "gone: must be photographs or a video, found none"),
        (tmp_path / "empty", "empty: must hold photographs or videos, holds none"),
    ):
        with pytest.raises(FileNotFoundError, match=message):
            named_files([path])
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"notes.txt: must be a photograph or a video \(.*, got .txt; convert it"):
        named_files([tmp_path / "notes.txt"])


def test_one_folder(shoot, walk, tmp_path):
    """Names stay, those that are taken get their folder's; frames follow each other by name, with all that is known."""
    photos, other = shoot
    files = named_files([photos, other])
    told = []
    with lock_folder(tmp_path / "out", "sfm") as held:
        found = make_image_folder(*files, held, "pictures", 10, lambda *step: told.append(step))
    folder = tmp_path / "out" / "pictures"
    assert found.folder == folder
    names = [path.name for path in list_images(folder)]
    assert {"IMG_1.jpg", "IMG_2.png", "other_IMG_1.jpg"} <= set(names)
    assert (folder / "IMG_1.jpg").resolve() == photos / "IMG_1.jpg"
    assert (found.photographs, found.frames) == (3, len(names) - 3)
    assert found.line() == f"3 photographs and {found.frames} frames of videos"
    assert 4 <= found.frames <= 10
    listed = rows_of(folder)
    check("frames.json", {**listed, "findings": [{"kind": "blur", "text": "blurred", "advice": "hold still"}]})
    assert [row["video"] for row in listed["videos"]] == [str(path) for path in files[1]]
    assert [row["frames"] for row in listed["videos"]] == [
        sum(row["video"] == str(path) for row in listed["frames"]) for path in files[1]
    ]
    assert all(
        row["frame_seconds"] == pytest.approx(0.1) and row["readout_seconds"] is None for row in listed["videos"]
    )
    for video, prefix in zip(files[1], ("clip_", "other_clip_"), strict=True):
        rows = [row for row in listed["frames"] if row["video"] == str(video)]
        assert [row["file"] for row in rows] == [f"{prefix}{row['index']:06d}.jpg" for row in rows]
        assert [row["seconds"] for row in rows] == pytest.approx([row["index"] / 10 for row in rows])
        shown = walk if video.parent == photos else walk[::-1]
        for row in rows:
            picture = cv2.imread(str(folder / row["file"]))[..., ::-1]
            errors = [np.abs(picture.astype(float) - image).mean() for image in shown]
            assert int(np.argmin(errors)) == row["index"]
    assert {stage for stage, _, _ in told} == {"looking at clip.mp4", "frames"}
    assert all(done <= total for _, done, total in told)


def test_what_was_recorded_goes_on(shoot, tmp_path):
    """Pictures with a frames.json of ours join others; one that is not ours says nothing, a damaged one is told."""
    photos, _ = shoot
    with lock_folder(tmp_path / "out", "sfm") as held:
        make_image_folder([], [photos / "clip.mp4"], held, "first", 5)
        files = list_images(tmp_path / "out" / "first")
        make_image_folder(files, [], held, "second")
        make_image_folder([photos / "IMG_1.jpg"], [], held, "third")
    first, second = (rows_of(tmp_path / "out" / name) for name in ("first", "second"))
    assert second["frames"] == first["frames"]
    assert second["videos"] == first["videos"]
    assert not (tmp_path / "out" / "third" / FRAMES).exists()
    renamed = joined_frames(None, files[1:], [f"new_{file.name}" for file in files[1:]], "sfm")
    assert [row["file"] for row in renamed["frames"]] == [f"new_{row['file']}" for row in first["frames"][1:]]
    (photos / FRAMES).write_text('{"frames": 3}')
    assert recorded_frames(photos) is None
    (photos / FRAMES).write_text(json.dumps({**first, "frames": [{"file": 3, "video": "a"}]}))
    with pytest.raises(ValueError, match=r"frames.json: .*frames\[0\]"):
        recorded_frames(photos)


def test_a_video_that_is_cut_off_stops_nothing(shoot, tmp_path, caplog):
    """It is named and left out; one alone is refused."""
    photos, other = shoot
    data = (other / "clip.mp4").read_bytes()
    (other / "clip.mp4").write_bytes(data[: len(data) // 2])
    pictures, films = named_files([photos, other])
    found = usable_files(pictures, films, photos, 2)
    assert found == (pictures, films[:1])
    (told,) = caplog.messages
    assert told.startswith(f"left out: {other / 'clip.mp4'}: must ")
    with pytest.raises(ValueError, match=r"at least 1 videos that can be used, got 0; .*clip.mp4: must "):
        usable_files([], films[1:], other, 2)


def test_too_few_frames_for_the_videos(shoot, tmp_path):
    """One of each at least, and nothing is left behind."""
    photos, other = shoot
    with (
        lock_folder(tmp_path / "out", "sfm") as held,
        pytest.raises(ValueError, match="frames: must be at least one of each video, 2, got 1"),
    ):
        make_image_folder([], [photos / "clip.mp4", other / "clip.mp4"], held, "pictures", 1)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_poses_of_a_video_and_photographs(walk, tmp_path, capsys):
    """One command for both: all have a pose, the video has a camera of its own, and frames.json the times."""
    path = film(tmp_path / "clip.mp4", walk)
    photos = tmp_path / "photos"
    photos.mkdir()
    for index, image in enumerate(pictures(walk_cameras(2, step=0.4))):
        write_photo(photos / f"{index}.png", image / 255)
    out = tmp_path / "scene"
    assert cli.main(["sfm", str(path), str(photos), "-o", str(out), "--frames", "5"]) == 0
    told = capsys.readouterr().out
    frames = len(rows_of(out / "images")["frames"])
    assert 3 <= frames <= 5
    assert f"{frames} of the photos are frames of videos; images/frames.json has their times" in told
    assert f"{frames + 2} of {frames + 2} photos have a pose" in told
    dataset = load(out)
    assert len(dataset.views) == frames + 2
    focal = {view.image_path.name: view.camera.K[0, 0] for view in dataset.views}
    assert len(set(focal.values())) == 2
    assert len({value for name, value in focal.items() if name.startswith("clip")}) == 1


def test_what_a_video_lacks_is_in_the_error(tmp_path, capfd):
    """The one line ends with what to do at the next shoot, and nothing is left behind."""
    blank = film(tmp_path / "night.mp4", [np.zeros((240, 320, 3), np.uint8)] * 8)
    assert cli.main(["sfm", str(blank), "-o", str(tmp_path / "scene"), "--quiet"]) == 2
    told = capfd.readouterr().err
    assert told.count("\n") == 1
    assert re.search(r"night.mp4: .* no two of 2 could be connected; .*; night.mp4, .*hardly anything to hold on", told)
    assert cli.main(["sfm", str(blank), "-o", str(tmp_path / "scene"), "--frames", "0", "--quiet"]) == 2
    assert "frames: must be at least one of each video, 1, got 0" in capfd.readouterr().err
    assert not (tmp_path / "scene").exists()
