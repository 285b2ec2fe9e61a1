"""Which frames of a video are taken: sharp ones with parallax between them, few of a turn or of a camera at rest."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from made_videos import RATE, film, pictures, turn_cameras, walk_cameras
from test_data_points import HEIGHT, WIDTH

from drgs import cli
from drgs.sfm.video_frames import examine


def kinds(picked) -> list[str]:
    return [finding.kind for finding in picked.findings]


def indices(picked) -> np.ndarray:
    return np.array([frame.frame.index for frame in picked.frames])


@pytest.fixture(scope="module")
def walk():
    """Pictures of a walk of three seconds."""
    return pictures(walk_cameras(3 * RATE))


def test_a_walk_gives_frames_in_even_steps(walk, tmp_path):
    """Times and what moved are kept, the bound is kept, and what is taken has parallax in between."""
    path = film(tmp_path / "walk.mp4", walk)
    told = []
    picked = examine(path, lambda done, total: told.append((done, total))).pick(150)
    taken = indices(picked)
    assert len(taken) == picked.useful_frames <= picked.samples == 30
    assert len(taken) >= 6
    assert np.all(np.diff(taken) > 0)
    assert np.diff(taken).max() <= 3 * np.median(np.diff(taken))
    assert picked.frame_seconds == pytest.approx(1 / RATE)
    assert [frame.seconds for frame in picked.frames] == pytest.approx(taken / RATE)
    assert picked.frames[0].motion == 0
    steps = np.array([frame.parallax for frame in picked.frames[1:]])
    assert 0.004 < np.median(steps) < 0.02
    assert picked.findings == ()
    assert told[0] == (0, 30)
    assert told[-1] == (30, 30)
    few = examine(path).pick(5)
    assert 4 <= len(few.frames) <= 5
    assert few.useful_frames == picked.useful_frames
    assert indices(few)[-1] - indices(few)[0] > 15


def test_frames_are_those_of_the_video(walk, tmp_path):
    """A frame that is taken decodes to the picture of its number."""
    path = film(tmp_path / "walk.mp4", walk)
    for frame in examine(path).pick(4).frames:
        errors = [np.abs(frame.frame.read().astype(float) - image).mean() for image in walk]
        assert int(np.argmin(errors)) == frame.frame.index


def test_a_blurred_frame_is_not_taken_beside_a_sharp_one(walk, tmp_path):
    """Every third frame blurred, and two that follow each other."""
    blurred = {*range(1, 30, 3), 20, 21}
    images = [cv2.GaussianBlur(image, (0, 0), 2.5) if i in blurred else image for i, image in enumerate(walk)]
    picked = examine(film(tmp_path / "walk.mp4", images)).pick(150)
    assert len(picked.frames) >= 6
    assert blurred.isdisjoint(indices(picked).tolist())
    assert min(frame.sharpness for frame in picked.frames) > 0.5


def test_frames_between_looks_are_compared(walk, tmp_path):
    """Of 30 frames a second a look is the sharpest of three, wherever it is among them."""
    images = [cv2.GaussianBlur(image, (0, 0), 2.5) for image in walk for _ in range(3)]
    sharp = [3 * at + at % 3 for at in range(len(walk))]
    for at, image in zip(sharp, walk, strict=True):
        images[at] = image
    picked = examine(film(tmp_path / "walk.mp4", images, rate=30)).pick(150)
    assert picked.samples == len(walk)
    assert set(indices(picked).tolist()) <= set(sharp)


def test_long_blur_is_told(walk, tmp_path):
    """Where there is nothing sharp near by, frames are taken all the same, and a finding says when."""
    images = [cv2.GaussianBlur(image, (0, 0), 2.5) if 12 <= i < 22 else image for i, image in enumerate(walk)]
    picked = examine(film(tmp_path / "walk.mp4", images)).pick(150)
    found = [finding for finding in picked.findings if finding.kind == "blur"]
    assert len(found) == 1
    assert found[0].line().startswith("walk.mp4, 1.2 to 2.1 s: blurred; hold still")


@pytest.mark.parametrize("focal", [0.75, 1.2])
def test_a_turn_on_the_spot(tmp_path, focal):
    """Few frames and a finding, whatever the lens."""
    cameras = turn_cameras(walk_cameras(1, focal=focal)[0], 2 * RATE, step=0.06)
    looked = examine(film(tmp_path / "turn.mp4", pictures(cameras)))
    picked = looked.pick(150)
    assert kinds(picked) == ["turn"]
    assert "only turns, which shows no depth; step sideways" in picked.findings[0].line()
    bridged = 0.06 * 20 * focal / 0.25
    assert 2 <= len(picked.frames) <= 1.5 * bridged + 1
    # Two frames of it would share little: more would do.
    found = [finding.line() for finding in looked.pick(2).findings if finding.kind == "overlap"]
    assert len(found) == 1
    assert f"(--frames {looked.useful_frames})" in found[0]


def test_turns_at_the_end_are_left_out_and_those_between_bridged(tmp_path):
    """Of a turn after which nothing comes no frame is taken, but of one that leads on."""
    first = walk_cameras(15)
    turn = turn_cameras(first[-1], 15, step=0.04)
    images = pictures([*first, *turn])
    path = film(tmp_path / "end.mp4", images)
    picked = examine(path).pick(150)
    assert "turn" in kinds(picked)
    assert (indices(picked) < 15).sum() >= 4
    assert (indices(picked) >= 18).sum() == 0
    back = [*images, *images[::-1]]  # the same backwards: the walk goes on
    picked = examine(film(tmp_path / "between.mp4", back)).pick(150)
    taken = indices(picked)
    between = ((taken >= 18) & (taken < 42)).sum()
    assert 2 <= between <= 8
    assert (taken < 15).sum() >= 4
    assert (taken >= 45).sum() >= 4


def test_a_camera_at_rest(walk, tmp_path):
    """One frame or two, however long it is, and a finding."""
    rng = np.random.default_rng(0)
    images = [np.clip(walk[0] + rng.normal(0, 4, walk[0].shape), 0, 255).astype(np.uint8) for _ in range(30)]
    picked = examine(film(tmp_path / "still.mp4", images)).pick(150)
    assert len(picked.frames) <= 2
    assert kinds(picked) == ["still"]
    assert "hardly moves in 2.9 s; walk around" in picked.findings[0].line()


def test_nothing_to_hold_on_to(tmp_path):
    """A black video has a frame and a finding."""
    picked = examine(film(tmp_path / "night.mp4", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 12)).pick(150)
    assert "blank" in kinds(picked)
    assert len(picked.frames) >= 1


def test_one_frame(walk, tmp_path):
    """A video of one frame is that frame."""
    picked = examine(film(tmp_path / "one.mp4", walk[:1])).pick(150)
    assert indices(picked).tolist() == [0]
    assert picked.frame_seconds == 0


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "gone"])
def test_files_that_are_no_videos(walk, tmp_path, capfd, kind):
    """Each in a line, and nothing is written."""
    path = tmp_path / "walk.mp4"
    if kind == "cut":
        film(path, walk)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind != "gone":
        path.write_bytes(b"" if kind == "empty" else b"not a video at all, but some text")
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["sfm", str(path), "-o", str(tmp_path / "scene"), "--quiet"]) == 2
    told = capfd.readouterr().err
    assert told.count("\n") == 1
    assert "walk.mp4: must " in told
    assert sorted(tmp_path.rglob("*")) == before
