"""The made capture: what its truth says is what its photographs and its model show."""

from __future__ import annotations

import json

import numpy as np
import pytest
from json_page import check

import drgs
from drgs import cli
from drgs.scenes import capture

SIZE = {"views": 11, "width": 64, "height": 48, "spp": 9}


@pytest.fixture(scope="module")
def stage():
    """What stands in the scene, whose textures take seconds to paint."""
    return capture._standing(0, "white")


@pytest.fixture(scope="module")
def made(stage, tmp_path_factory):
    """A small data set with all ingredients."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture, "_standing", lambda seed, wall: stage)
        return capture.generate(tmp_path_factory.mktemp("capture") / "all", **SIZE)


@pytest.fixture(scope="module")
def calm(stage, tmp_path_factory):
    """The same scene without any of them, but for the wall."""
    out = tmp_path_factory.mktemp("capture") / "calm"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture, "_standing", lambda seed, wall: stage)
        return capture.generate(out, **SIZE, exposure="fixed", shadow=False, passer_by=False, pose_error=(0, 0))


def truth_of(folder):
    return json.loads((folder / "truth.json").read_text())


def test_files_are_what_the_page_says(made):
    """params.json and truth.json have the fields of docs/run-files.md, and no others."""
    others = ("cameras", "times", "test_every", "free", "depth_unit", "teacher_width", "teacher_height")
    check("params.json", json.loads((made / "params.json").read_text()), absent=others)
    check("truth.json", truth_of(made), maps=("log_gains", "shadow", "passer_by", "camera_to_world"))


def picture(path):
    import cv2

    return cv2.imread(str(path))[..., ::-1].astype(np.float64)


def test_log_gains_are_what_photographs_differ_by(made, calm):
    """A value is the fixed camera's times exp(log gain), to a rounding; gains differ, with zero mean in training."""
    truth = truth_of(made)
    gains = {name: np.array(gain) for name, gain in truth["log_gains"].items()}
    train = [name for name in gains if name not in truth["held_out"]]
    assert np.abs(np.mean([gains[name] for name in train], 0)).max() < 1e-12
    assert (np.std([gains[name] for name in train], 0) > 0.05).all()
    people = {*truth["shadow"], *truth["passer_by"]}
    for name in set(gains) - people:
        seen, fixed = picture(made / "images" / name), picture(calm / "images" / name)
        inside = (seen < 254.5) & (fixed < 254.5)
        off = np.abs(seen - fixed * np.exp(gains[name]))[inside]
        assert inside.mean() > 0.5
        # Two roundings to 8 bits, one of them times a gain of at most 1.7 here.
        assert off.max() <= 0.5 * (1 + np.exp(np.abs(gains[name]).max())) + 1e-6
    assert truth_of(calm)["log_gains"] == {name: [0, 0, 0] for name in gains}


def test_masks_are_where_somebody_was(made, calm):
    """A shadow darkens, both are in training photographs alone, and outside of a mask nothing changes by much."""
    truth = truth_of(made)
    for kind in ("shadow", "passer_by"):
        assert truth[kind]
        for name, path in truth[kind].items():
            assert name not in truth["held_out"]
            mask = picture(made / path)[..., 0] > 0
            seen = np.minimum(picture(made / "images" / name) * np.exp(-np.array(truth["log_gains"][name])), 255)
            change = seen - picture(calm / "images" / name)
            # 0.02 of the mean of 3x3 pixels is 5.1 of 255; single pixels may differ by more at an edge.
            assert np.abs(change[~mask]).mean() < 3
            assert 0.02 < mask.mean() < 0.6
            assert np.abs(change[mask]).mean() > 8
            if kind == "shadow":
                assert (change[mask].mean(1) < 0).mean() > 0.9
    assert not set(truth["shadow"]) & set(truth["passer_by"])
    assert not truth_of(calm)["shadow"]
    assert not (calm / "truth").exists()


def test_poses_are_wrong_by_what_was_asked_for(made):
    """Training poses are off by 0.4 degrees and 6 mm, hold no common motion, and held-out ones are true."""
    truth = truth_of(made)
    dataset = drgs.load_data(made)
    stated = {view.image_path.name: np.linalg.inv(view.camera.w2c) for view in dataset.views}
    true = {name: np.array(pose) for name, pose in truth["camera_to_world"].items()}
    train, test = dataset.split()
    assert [view.image_path.name for view in test] == truth["held_out"]
    for name in truth["held_out"]:
        assert np.abs(stated[name] - true[name]).max() < 1e-9
    names = [view.image_path.name for view in train]
    turns = [stated[name][:3, :3] @ true[name][:3, :3].T for name in names]
    angles = np.degrees([np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns])
    centers = np.array([true[name][:3, 3] for name in names])
    moves = np.array([stated[name][:3, 3] for name in names]) - centers
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.4, rel=1e-6)
    assert np.sqrt((moves**2).sum(1).mean()) == pytest.approx(0.006, rel=1e-6)
    arms = centers - centers.mean(0)
    for common in (moves.mean(0), np.cross(arms, moves).mean(0), (arms * moves).sum(1).mean()):
        assert np.abs(common).max() < 1e-9


def test_the_model_shows_how_wrong_poses_are(made, calm):
    """Reprojection errors that the model states are larger where poses are wrong; observations belong to true poses."""
    dataset = drgs.load_data(made)
    assert dataset.format == "colmap"
    medians = []
    for folder in (made, calm):
        lines = [line.split() for line in (folder / "sparse" / "0" / "points3D.txt").read_text().splitlines()]
        medians.append(np.median([float(line[7]) for line in lines]))
    # Measured at 64 pixels: 0.57 of the points' own errors, 0.76 with those of poses.
    assert medians[0] > 1.15 * medians[1]


def test_command(stage, tmp_path, monkeypatch, capsys):
    """`drgs scene capture` makes a data set, says what is in it, and passes on what is to be left out."""
    monkeypatch.setattr(capture, "_standing", lambda seed, wall: stage)
    out = tmp_path / "set"
    command = ["scene", "capture", "-o", str(out), "--size", "16x12", "--views", "4", "--spp", "1", "--no-shadow"]
    assert cli.main([*command, "--no-passer-by", "--pose-error", "1,0"]) == 0
    said = capsys.readouterr().out
    assert "4 views of 16x12, 1 held out\n0 photographs with a shadow, 0 with a passer-by" in said
    assert f"next: drgs fit {out} -o RUN\n" in said
    truth = truth_of(out)
    assert truth["pose_error"] == {"degrees": 1, "meters": 0}
    assert not truth["passer_by"]
    assert not (out / "light").exists()
