"""The kitchen: labels, motions, cameras and files against its geometry; seeds, resuming, the command."""

from __future__ import annotations

import functools
import itertools
import json

import numpy as np
import pytest
from json_page import OF_CAPTURE, check
from plain_stage import plain_stage

from drgs import cli, scenes
from drgs.scenes import filmed, kitchen, labelled, moving, tabletop, teacher, videos
from drgs.scenes.colmap import project

WIDTH, HEIGHT, CAMERAS, TIMES = 32, 24, 3, 3
SMALL = {"cameras": CAMERAS, "times": TIMES, "width": WIDTH, "height": HEIGHT, "spp": 1}
SMALL |= {"teacher_width": 8, "teacher_height": 6}
NUMBERS = {name: k + 1 for k, name in enumerate(kitchen.CLASSES)}
MOVING = [NUMBERS[name] for name in kitchen.MOVING]


@pytest.fixture(scope="module")
def stage():
    return plain_stage(kitchen.PLAY)


@pytest.fixture(scope="module")
def made(stage, tmp_path_factory):
    """A small data set, finished by a third call after interruptions while it is filmed and while it is finished."""
    folder, traced = tmp_path_factory.mktemp("kitchen") / "data", []

    def stop(done, total):
        assert total == CAMERAS * TIMES
        if done == 4:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(filmed, "Stage", lambda play, seed: stage)
        with pytest.raises(KeyboardInterrupt):
            kitchen.generate(folder, **SMALL, progress=stop)
        assert [path.name for path in folder.iterdir()] == [".drgs.scene"]
        trace = filmed._Recording._trace
        patch.setattr(filmed._Recording, "_trace", lambda *args: traced.append(args[1:]) or trace(*args))
        with pytest.MonkeyPatch.context() as broken:
            broken.setattr(videos, "write", lambda *args: stop(4, CAMERAS * TIMES))
            with pytest.raises(KeyboardInterrupt):
                kitchen.generate(folder, **SMALL)
        kitchen.generate(folder, **SMALL)
    # What was finished is not traced again.
    assert traced == [(1, 1), (2, 1), (0, 2), (1, 2), (2, 2)]
    return folder


@pytest.fixture(scope="module")
def frames(made):
    """(images, labels), each of shape (cameras, times, height, width, ...), as a reader of videos gets them."""
    import cv2

    images, labels = [], []
    for c in range(CAMERAS):
        video = cv2.VideoCapture(str(made / f"cam{c:02d}.mp4"))
        images.append([video.read()[1][..., ::-1] for _ in range(TIMES)])
        assert not video.read()[0]
        names = [made / "semantic_class" / f"cam{c:02d}" / f"semantic_class_{k:04d}.png" for k in range(TIMES)]
        labels.append([cv2.imread(str(name), cv2.IMREAD_UNCHANGED) for name in names])
    return np.array(images), np.array(labels)


@functools.cache
def parts(seed):
    """(names of all classes that are there, `Mover`s) of a seed."""
    all_parts = list(kitchen.parts(seed))
    movers = [part for part in all_parts if isinstance(part, moving.Mover)]
    return {part.name if isinstance(part, moving.Mover) else part[0] for part in all_parts}, movers


def cameras(made):
    """(K (3, 3), c2w (cameras, 4, 4)) of poses_bounds.npy, read as LLFF is: axes down, right, backward."""
    rows = np.load(made / "poses_bounds.npy")
    matrix = rows[:, :15].reshape(-1, 3, 5)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.stack([matrix[..., 1], matrix[..., 0], -matrix[..., 2], matrix[..., 3]], -1)
    height, width, focal = matrix[0, :, 4]
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), poses, rows[:, 15:]


def test_files(made):
    """Everything is there under the names of the layout, nothing else is, and the maps have their shape."""
    assert {path.name for path in made.iterdir()} == {
        ".drgs.jsonl", "cam00.mp4", "cam01.mp4", "cam02.mp4", "classes.json", "frame0", "moving_classes.json",
        "params.json", "poses_bounds.npy", "rgb_feature_langseg", "semantic_class", "teacher.json",
        "text_embeddings.npy",
    }  # fmt: skip
    absent = ("depth_unit", "test_every", "views", "free", *OF_CAPTURE)
    check("params.json", json.loads((made / "params.json").read_text()), absent=absent)
    assert not [path for path in made.rglob("*") if ".part" in path.name]
    maps = sorted(path.name for path in (made / "rgb_feature_langseg").iterdir())
    assert maps == [f"cam{c:02d}_{k:04d}_fmap_CxHxW.pt" for c in range(CAMERAS) for k in range(TIMES)]
    assert teacher.load(made / "rgb_feature_langseg" / maps[-1]).shape == (512, 6, 8)
    assert np.load(made / "text_embeddings.npy").shape == (len(kitchen.CLASSES), 512)
    listed = json.loads((made / "classes.json").read_text())["classes"]
    assert {entry["name"]: entry["id"] for entry in listed} == NUMBERS
    assert set(json.loads((made / "moving_classes.json").read_text())) == set(kitchen.MOVING) < set(NUMBERS)


def test_videos_are_exact(made, frames):
    """A decoded frame is what was rendered, to the bit: frame 0 is kept as PNG as well; seeking finds frames."""
    import cv2

    for c in range(CAMERAS):
        image = cv2.imread(str(made / "frame0" / "images" / f"cam{c:02d}.png"))[..., ::-1]
        assert np.array_equal(image, frames[0][c, 0])
        video = cv2.VideoCapture(str(made / f"cam{c:02d}.mp4"))
        video.set(cv2.CAP_PROP_POS_FRAMES, 2)
        assert np.array_equal(video.read()[1][..., ::-1], frames[0][c, 2])


def test_poses_are_the_cameras_of_the_pictures(made, stage, frames):
    """Rays through the pixels of poses_bounds.npy's cameras meet the classes of the labels, between the bounds."""
    K, poses, bounds = cameras(made)
    assert np.allclose(poses, kitchen.PLAY.arc(CAMERAS, 0), atol=1e-12)
    stage.set(0.5)
    for c in range(CAMERAS):
        depth, numbers = scenes.first_hits(stage.scene, K, poses[c], WIDTH, HEIGHT)
        assert np.array_equal(stage.table[numbers], frames[1][c, 1])
    stage.set(0.0)
    for c in range(CAMERAS):
        depth = scenes.z_depth(stage.scene, K, poses[c], WIDTH, HEIGHT)
        assert bounds[c, 0] < depth.min()
        assert depth.max() < bounds[c, 1]


@pytest.mark.parametrize("seed", [0, 1])
def test_cameras_face_the_table(seed):
    """cam00 is in the middle of an arc of 80 to 100 degrees; all stand right way up and see what moves."""
    poses = kitchen.PLAY.arc(15, seed)
    eyes = poses[:, :3, 3]
    azimuth = np.degrees(np.arctan2(eyes[:, 0], -eyes[:, 1] + 0.05))
    assert abs(azimuth[0]) < 1
    assert (np.diff(azimuth[1:]) > 0).all()
    assert 80 < np.ptp(azimuth) < 100
    assert (poses[:, 2, 1] < -0.7).all()  # their downward axis points down
    K = labelled.intrinsics(240, 180, kitchen.PLAY.fov_x)
    seen = []
    for mover in parts(seed)[1]:
        for time in (0.0, 0.4, 1.0):
            middle = mover.at(time)[0].mean(0)[None]
            pixels, z = (np.array(v) for v in zip(*(project(K, pose, middle) for pose in poses), strict=True))
            assert (z > 0.4).all()
            seen.append(((pixels[:, 0] > 0) & (pixels[:, 0] < (240, 180))).all(1).mean())
    assert np.mean(seen) > 0.9  # now and then something is outside of the picture of a camera at an end of the arc
    assert min(seen) > 0.4


def test_labels_agree_with_the_things(stage):
    """Vertices of a thing that nothing hides lie on pixels of its class, at every time, or one pixel beside them."""
    K, poses, found = (
        labelled.intrinsics(120, 90, kitchen.PLAY.fov_x),
        kitchen.PLAY.arc(15, 0),
        dict.fromkeys(kitchen.MOVING, 0),
    )
    for time in (0.0, 0.6):
        stage.set(time)
        for pose in poses[[0, 4]]:
            depth, numbers = scenes.first_hits(stage.scene, K, pose, 120, 90)
            labels = np.pad(stage.table[numbers], 1)
            near = np.stack([labels[1 + i : 91 + i, 1 + j : 121 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
            for mover in stage.movers.values():
                pixels, z = project(K, pose, mover.at(time)[0])
                inside = ((pixels > 0) & (pixels < (120, 90))).all(1)
                x, y = pixels[inside].astype(int).T
                front = z[inside] < depth[y, x] + 1e-3
                assert (near[:, y, x] == NUMBERS[mover.name]).any(0)[front].all()
                found[mover.name] += front.sum()
    assert min(found.values()) > 400


def test_every_kind_of_motion():
    """Rigid things keep all distances and the orange does not slip; arms of the tongs turn against each other and their
    tips close on the lemon; the jelly keeps its volume and its foot; the towel keeps its upper edge. All move."""
    movers = {}
    for part in parts(0)[1]:
        movers.setdefault(part.name, []).append(part)
    assert set(movers) == set(kitchen.MOVING)
    times = np.linspace(0, 1, 40)
    places = {name: np.stack([parts[0].at(t)[0] for t in times]) for name, parts in movers.items()}
    for name, points in places.items():
        assert np.linalg.norm(points - points[:1], axis=-1).max() > 0.03, name
        assert np.linalg.norm(np.diff(points, axis=0), axis=-1).max() < 0.06, name  # meters a step, of 40: no jumps

    def stretch(points):
        far = np.linalg.norm(points - points[:, :1], axis=-1)
        return np.abs(far - far[:1]).max()

    assert max(stretch(places[name]) for name in ("mug", "orange", "tongs")) < 1e-9
    assert min(stretch(places[name]) for name in ("jelly", "towel")) > 0.01
    arms = np.concatenate([np.stack([part.at(t)[0] for t in times]) for part in movers["tongs"][:2]], 1)
    assert stretch(arms) > 0.01  # each is rigid, both together are not

    # Without slipping: what the middle moves by is the angle of the turn times the radius, on the worktop.
    ball = places["orange"]
    middle = 0.5 * (ball.max(1) + ball.min(1))  # of the mesh's box: off by less than 0.2 mm
    assert np.abs(ball[..., 2].min(1)).max() < 2e-4
    way = np.linalg.norm(np.diff(middle[:, :2], axis=0), axis=1)
    rest = ball - ball.mean(1, keepdims=True)
    angle = [_angle(a, b) for a, b in zip(rest[:-1], rest[1:], strict=True)]
    assert np.allclose(angle, way / moving.ORANGE, atol=0.01)

    tips = [np.stack([part.at(t)[0][:21].mean(0) for t in times]) for part in movers["tongs"][:2]]
    apart = np.linalg.norm(tips[0] - tips[1], axis=1)
    assert 2 * moving.LEMON < apart.min() < 2.8 * moving.LEMON
    assert apart.max() > 1.7 * apart.min()

    jelly = places["jelly"]
    volumes = [_volume(movers["jelly"][0].at(t)) for t in times]
    assert np.ptp(volumes) < 0.005 * np.mean(volumes)  # of a mesh that bends
    assert np.abs(jelly[:, :97] - jelly[:1, :97]).max() < 1e-3
    assert np.ptp(jelly[..., 2].max(1)) > 0.02
    towel = places["towel"].reshape(40, 36, 30, 3)
    assert np.abs(towel[:, -1] - towel[:1, -1]).max() < 1e-9
    assert towel[..., 1].max() < tabletop.WALL  # before the wall


def _angle(a, b):
    """Of the rotation that takes points (n, 3) a to b, in radians (Kabsch)."""
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))


def _volume(mesh):
    """Enclosed by a mesh and the plane under it, by the divergence theorem; its foot is at z = 0.012."""
    points, faces, *_ = mesh
    a, b, c = (points[faces[:, k]] - (0, 0, 0.012) for k in range(3))
    return np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6


def test_things_do_not_meet():
    """At two seeds, in two arrangements, what moves keeps 3 cm apart at all times; nothing is in the worktop."""
    for seed in range(2):
        for time in np.linspace(0, 1, 9):
            places = {}
            for mover in parts(seed)[1]:
                points = mover.at(time)[0]
                assert points[:, 2].min() > -2e-3
                places.setdefault(mover.name, []).append(points[::17])
            places = {name: np.concatenate(points) for name, points in places.items()}
            for a, b in itertools.combinations(("mug", "orange", "jelly", "tongs"), 2):
                gap = np.linalg.norm(places[a][:, None] - places[b][None], axis=-1).min()
                assert gap > 0.03, (seed, time, a, b)


def test_what_moves_and_what_does_not(frames, stage):
    """Labels change only at or beside moving classes; pixels of surfaces that see no moving thing stay to the bit."""
    images, labels = frames
    moves = np.isin(labels, MOVING)
    assert moves.mean() > 0.1
    assert all((labels == number).any() for number in MOVING)
    changed = (labels != labels[:, :1]).any(1)
    assert changed.any()
    assert not (changed & ~moves.any(1)).any()
    still = ~moves.any(1)
    same = (images == images[:, :1]).all((1, 4))
    assert same[still].mean() > 0.5  # the rest is reached by shadows that move
    inside = moves.any(1)
    assert same[inside].mean() < 0.3  # paint of one color in an unchanged light


def test_sparse_points_of_frame_0(made, frames):
    """Points of frame0 lie on what frame 0 shows, none is observed by the test view cam00, and poses are the arc's."""
    from drgs.data.colmap import load_colmap

    dataset = load_colmap(made / "frame0")
    assert [view.name for view in dataset.views] == ["cam00", "cam01", "cam02"]
    for view, pose in zip(dataset.views, kitchen.PLAY.arc(CAMERAS, 0), strict=True):
        assert np.allclose(view.camera.c2w, pose, atol=1e-6)
    lines = (made / "frame0" / "sparse" / "0" / "images.txt").read_text().split("\n")
    assert lines[0].endswith("cam00.png")
    assert lines[1] == ""
    K, poses = labelled.intrinsics(WIDTH, HEIGHT, kitchen.PLAY.fov_x), kitchen.PLAY.arc(CAMERAS, 0)
    pixels, z = project(K, poses[1], dataset.points)
    x, y = np.clip(pixels.astype(int), 0, (WIDTH - 1, HEIGHT - 1)).T
    color = frames[0][1, 0][y, x].astype(float)
    assert len(dataset.points) > 100
    # Most points are seen by cam01, and then have the color of its pixel, up to the point's error, texture and noise.
    assert np.median(np.abs(color / 255 - dataset.colors).max(1)) < 0.2
    assert z.min() > 0


def test_seeds(stage, made, tmp_path, monkeypatch):
    """The same seed gives the same files to the bit, in one call or three; others give other things and motions."""
    monkeypatch.setattr(filmed, "Stage", lambda play, seed: stage)
    kitchen.generate(tmp_path / "set", **SMALL)
    files = sorted(path.relative_to(made) for path in made.rglob("*") if path.is_file() and path.name != ".drgs.jsonl")
    assert all((tmp_path / "set" / name).read_bytes() == (made / name).read_bytes() for name in files)
    (names, movers), (other_names, others) = parts(0), parts(1)
    assert names == other_names == set(kitchen.CLASSES)
    for a, b in zip(movers, others, strict=True):
        assert a.name == b.name
        assert np.abs(a.at(0.5)[0] - b.at(0.5)[0]).max() > 0.01
    assert not np.array_equal(kitchen.PLAY.arc(5, 0), kitchen.PLAY.arc(5, 1))


def test_command(stage, tmp_path, monkeypatch, capsys):
    """`drgs scene kitchen` writes a data set, says what to do next, and keeps a finished one."""
    monkeypatch.setattr(filmed, "Stage", lambda play, seed: stage)
    out = tmp_path / "set"
    command = ["scene", "kitchen", "-o", str(out), "--size", "32x24", "--cameras", "2", "--times", "1", "--spp", "1"]
    command += ["--teacher-size", "8x6"]
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert "2 views of 32x24, 1 held out\n16 classes, 5 of them move, teacher right at" in said
    assert f"next: drgs fit {out} -o RUN\n" in said
    assert len(list((out / "rgb_feature_langseg").iterdir())) == 2
    monkeypatch.setattr(filmed, "Stage", lambda play, seed: pytest.fail("made again"))
    assert cli.main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert cli.main([*command, "--free"]) == 2
    assert "holds one with free False, not True" in capsys.readouterr().err


def test_a_video_that_cannot_be_written(tmp_path):
    """Where OpenCV cannot write a video, one line says so, and no broken file stays."""
    with pytest.raises(OSError, match="must be writable as FFV1"):
        videos.write(tmp_path / "none" / "cam00.mp4", [np.zeros((24, 32, 3), np.uint8)])
    assert not list(tmp_path.iterdir())
