"""The hall: a ball at five diameters a frame, a lamp that goes on, a door that opens; labels and truth beside them."""

from __future__ import annotations

import functools
import json

import numpy as np
import pytest
from json_page import check
from plain_stage import plain_stage

from drgs import cli, scenes
from drgs.data import load
from drgs.scenes import filmed, hall, labelled
from drgs.scenes.colmap import project
from drgs.scenes.moving import Mover

CAMERAS, TIMES, WIDTH, HEIGHT = 2, 5, 64, 48
NUMBERS = {name: k + 1 for k, name in enumerate(hall.CLASSES)}
K = labelled.intrinsics(WIDTH, HEIGHT, hall.PLAY.fov_x)


@functools.cache
def parts(seed):
    return list(hall.parts(seed))


@pytest.fixture(scope="module")
def stage():
    return plain_stage(hall.PLAY)


@pytest.fixture(scope="module")
def made(stage, tmp_path_factory):
    """A small data set that the command makes."""
    folder = tmp_path_factory.mktemp("hall") / "data"
    command = ["scene", "hall", "-o", str(folder), "--size", f"{WIDTH}x{HEIGHT}", "--cameras", str(CAMERAS)]
    command += ["--times", str(TIMES), "--spp", "4", "--teacher-size", "8x6", "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(filmed, "Stage", lambda play, seed: stage)
        assert cli.main(command) == 0
    return folder


def test_the_ball_flies_five_diameters_a_frame():
    """At the default number of times, but where it turns round; it meets neither floor, nor walls, nor the door."""
    times = np.linspace(0, 1, 12)
    way = np.linalg.norm(np.diff([hall.ball_at(time) for time in times], axis=0), axis=1) / (2 * hall.BALL)
    assert np.median(way) > 5
    movers = {}
    for part in parts(0):
        if isinstance(part, Mover):
            movers.setdefault(part.name, []).append(part)
    for time in np.linspace(0, 1, 200):
        center = hall.ball_at(time)
        assert center[2] > hall.BALL
        points = np.concatenate([part.at(time)[0] for part in movers["door"]])
        # The leaf's corners and edges bound it: how near its plane comes is known from these.
        assert np.linalg.norm(points - center, axis=1).min() > hall.BALL
        assert points[:, 1].min() > center[1] + hall.BALL
        ball = movers["ball"][0].at(time)[0]
        np.testing.assert_allclose(np.linalg.norm(ball - center, axis=1), hall.BALL, atol=1e-9)


def test_truth_is_what_labels_show(made, stage):
    """The ball is labelled where motion.json has it; the niche appears with the door's angle; all are listed."""
    content = json.loads((made / "motion.json").read_text())
    check("motion.json", content)
    truth = content["frames"]
    assert [entry["time"] for entry in truth] == [0, 0.25, 0.5, 0.75, 1]
    assert [entry["lamp"] for entry in truth] == [False, False, True, True, True]
    assert truth[0]["door"] == 0
    assert truth[-1]["door"] == pytest.approx(105)
    assert json.loads((made / "moving_classes.json").read_text()) == ["door", "ball", "lamp"]
    poses = hall.PLAY.arc(CAMERAS, 0)
    for entry in truth:
        stage.set(entry["time"])
        depth, numbers = scenes.first_hits(stage.scene, K, poses[0], WIDTH, HEIGHT)
        labels = stage.table[numbers]
        pixel, far = project(K, poses[0], np.array([entry["ball"]]))
        column, row = pixel[0].astype(int)
        assert labels[row, column] == NUMBERS["ball"]
        assert depth[row, column] == pytest.approx(far[0], abs=1.5 * hall.BALL)
        assert ((labels == NUMBERS["niche"]).sum() > 0) == (entry["door"] > 30)
        assert (labels == NUMBERS["lamp"]).sum() > 10


def test_the_lamp_goes_on(made):
    """Its globe and the wall beside it are brighter in frames of which the truth says so; the data set is dynamic."""
    dataset = load(made)
    assert dataset.is_dynamic
    assert dataset.camera_names == ("cam00", "cam01")
    assert set(dataset.semantics.moving) == set(hall.MOVING)
    shown = [view.image() for view in dataset.views if view.camera_name == "cam00"]
    pixel, _ = project(K, hall.PLAY.arc(CAMERAS, 0)[0], np.array([hall._LAMP]))
    column, row = pixel[0].astype(int)
    globe = np.array([image[row, column].mean() for image in shown])
    assert globe[2:].min() > globe[:2].max() + 0.1
    wall = np.array([image[row - 2 : row + 3, column + 5 : column + 9].mean() for image in shown])
    assert wall[2:].min() > wall[:2].max() + 0.02


def test_seeds_differ():
    """Colors and textures are drawn; what moves goes the same way."""
    first, second = parts(0), parts(1)
    assert len(first) == len(second)
    paints = [
        (a.paint if isinstance(a, Mover) else a[3], b.paint if isinstance(b, Mover) else b[3])
        for a, b in zip(first, second, strict=True)
    ]
    assert sum(np.shape(a) != np.shape(b) or not np.allclose(a, b) for a, b in paints) > len(paints) / 2
