"""Initial points where photographs do not show the background: a ball before nothing, filmed from far away."""

import dataclasses

import cv2
import numpy as np
import pytest

from drgs.cameras import Camera, intrinsics, look_at
from drgs.data import View
from drgs.sfm.guided import Triangulated
from drgs.sfm.points import initial_points
from drgs.sfm.proposals import VisualHull

RADIUS = 1.0
DISTANCE = 60.0
SIZE = 96


def around(folder, count=6, behind=(0.0, 0.0, 0.0), ball=(0.6, 0.5, 0.4), away=0.0):
    """Photographs of a ball, which spans half of each image, from a ring of cameras with long lenses.

    `away` moves the ball to the side, by turns to the one and the other: then silhouettes meet nowhere.
    """
    focal = SIZE / 4 * DISTANCE / RADIUS
    views = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        eye = DISTANCE * np.array([np.sin(angle), 0.2 * (-1) ** index, np.cos(angle)])
        camera = Camera(intrinsics(focal, focal, SIZE / 2, SIZE / 2), look_at(eye, (0, 0, 0), (0, 1, 0)), SIZE, SIZE)
        middle = np.array([SIZE / 2 + away * (-1) ** index, SIZE / 2 + away * (-1) ** index])
        rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
        inside = np.hypot(columns - middle[0], rows - middle[1]) < SIZE / 4
        image = np.where(inside[..., None], np.asarray(ball), np.asarray(behind))
        path = folder / f"{index}.png"
        assert cv2.imwrite(str(path), np.round(image[..., ::-1] * 255).astype(np.uint8))
        views.append(View(camera, f"{index}", image_path=path, background=behind))
    return views


@pytest.mark.parametrize("behind", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_points_are_where_the_ball_is(tmp_path, behind):
    """Six silhouettes, of cameras sixty radii away: rays are nearly parallel, and no pixel says how far away it is."""
    points, colors, source = initial_points(around(tmp_path, behind=behind), max_points=3000)
    assert source.startswith("random where none of 6 cameras sees the background, 3000 points")
    # The hull of six silhouettes reaches a little beyond the ball, and all of the ball is in it.
    far = np.linalg.norm(points, axis=1)
    assert far.max() < 1.4 * RADIUS
    assert (far < RADIUS).mean() > 0.8
    assert np.abs(points.mean(axis=0)).max() < 0.1
    np.testing.assert_allclose(colors, np.broadcast_to((0.6, 0.5, 0.4), colors.shape), atol=2 / 255)


def test_places_are_looked_at_in_all_photographs(tmp_path):
    """How many show a place, of those that none shows as empty; and that nothing is behind a camera."""
    hull = VisualHull.of(around(tmp_path))
    places = np.array([[0, 0, 0], [0, 1.5, 0], [0, 9.0, 0], [0, 0.4 * DISTANCE, 2 * DISTANCE]])
    assert hull.support(places).tolist() == [6, -1, 0, 1]
    assert hull.is_contradicted(places).tolist() == [False, True, False, False]
    np.testing.assert_allclose(hull.colors(places[:1]), [(0.6, 0.5, 0.4)], atol=2 / 255)
    np.testing.assert_allclose(hull.center, 0, atol=1e-6)


def test_edges_deny_nothing(tmp_path):
    """Each point of a surface is at the edge of some silhouette of many, and stays; what stands off goes."""
    hull = VisualHull.of(around(tmp_path, count=60))
    way = np.random.default_rng(0).normal(size=(500, 3))
    surface = RADIUS * way / np.linalg.norm(way, axis=1, keepdims=True)
    assert (hull.support(surface) < 0).mean() > 0.1  # a pixel of some photograph says so
    assert not hull.is_contradicted(surface).any()
    assert hull.is_contradicted(1.2 * surface).all()


def test_how_far_it_is_is_told(tmp_path):
    """Stages with what is done of them: many photographs take seconds."""
    told = []
    views = around(tmp_path)
    hull = VisualHull.of(views, lambda *stage: told.append(stage))
    hull.points(100, np.random.default_rng(0), lambda *stage: told.append(stage))
    assert told[:7] == [("silhouettes", number, 6) for number in range(7)]
    assert told[-1] == ("room for points", 100, 100)


def test_nothing_is_said_where_photographs_do_not_tell(tmp_path):
    """Two views, views of several times, next to no background, cameras that look apart; silhouettes that meet nowhere
    leave no room, and points are guessed as before.
    """
    views = around(tmp_path)
    assert VisualHull.of(views) is not None
    assert VisualHull.of(views[:2]) is None
    assert VisualHull.of(around(tmp_path, behind=(0.5, 0.5, 0.5), ball=(0.0, 0.0, 0.0))) is not None
    for view in views:
        view.background = (0.3, 0.0, 0.0)
    assert VisualHull.of(views) is None
    apart = around(tmp_path, away=SIZE / 4 + 4)
    assert VisualHull.of(apart).points(1000, np.random.default_rng(0)) is None
    source = initial_points(apart, max_points=100)[2]
    assert source.startswith("random where 6 cameras look")


def test_views_of_several_times_say_nothing(tmp_path):
    """Where something moves a place is empty at one time and not at another."""
    views = around(tmp_path)
    for index, view in enumerate(views):
        view.camera = dataclasses.replace(view.camera, time=float(index % 2))
    assert VisualHull.of(views) is None
    for view in views:
        view.camera = dataclasses.replace(view.camera, time=0.5)
    assert VisualHull.of(views) is not None


def test_matches_that_a_third_photograph_denies_are_left_out(tmp_path, monkeypatch):
    """Two photographs agree about a place in front of the ball, which others show as empty."""
    right, wrong = np.random.default_rng(0).normal(size=(2, 60, 3))
    right *= 0.5 * RADIUS / np.linalg.norm(right, axis=1, keepdims=True)
    wrong *= 1.8 * RADIUS / np.linalg.norm(wrong, axis=1, keepdims=True)
    found = np.concatenate([right, wrong])
    monkeypatch.setattr(
        "drgs.sfm.points._triangulated",
        lambda views, *_: Triangulated(found, np.ones((120, 3), np.float32), np.ones((len(views), 120), bool)),
    )
    points, _, source = initial_points(around(tmp_path), max_points=3000)
    what = f"120 points; {len(points)} with proposed ones where there are none"
    assert source == f"triangulated from 6 given poses, {what}"
    assert {tuple(point) for point in right} <= {tuple(point) for point in points}
    assert not {tuple(point) for point in wrong} & {tuple(point) for point in points}
    assert np.linalg.norm(points, axis=1).max() < 1.4 * RADIUS
