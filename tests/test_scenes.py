"""The still life: geometry of the files, noise and light of the pictures, atomic writing."""

from __future__ import annotations

import json

import numpy as np
import pytest

from drgs import cli, scenes
from drgs.scenes import output, still_life

WIDTH, HEIGHT, VIEWS = 64, 48, 3


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small data set."""
    folder = tmp_path_factory.mktemp("scenes") / "still_life"
    seen = []
    out = still_life.generate(
        folder,
        VIEWS,
        WIDTH,
        HEIGHT,
        spp=30,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert out == folder
    assert seen == [(1, VIEWS), (2, VIEWS), (3, VIEWS)]
    return folder


@pytest.fixture(scope="module")
def views(made):
    """(K, w2c in OpenCV axes, image in [0, 1], z-depth in meters) of each view, from the files."""
    import cv2

    meta = json.loads((made / "transforms.json").read_text())
    K = np.array([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]])
    assert (meta["w"], meta["h"]) == (WIDTH, HEIGHT)
    out = []
    for frame in meta["frames"]:
        c2w = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        image = cv2.imread(str(made / frame["file_path"]))[..., ::-1] / 255.0
        depth = cv2.imread(str(made / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        out.append((K, np.linalg.inv(c2w), image, depth * meta["depth_unit_scale_factor"]))
    return out


def project(K, w2c, points):
    """Pixels (n, 2) and z (n,) of world points (n, 3)."""
    camera = points @ w2c[:3, :3].T + w2c[:3, 3]
    pixels = camera @ K.T
    return pixels[:, :2] / pixels[:, 2:], camera[:, 2]


def back_project(K, w2c, depth):
    """World points (h * w, 3) of a depth map."""
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    camera = np.stack([x * depth, y * depth, depth], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    return (camera - w2c[:3, 3]) @ w2c[:3, :3]


def test_files(made, views):
    """Layout, frames, exposure; nothing but surfaces in view."""
    assert len(views) == VIEWS
    assert sorted(p.name for p in made.iterdir()) == [
        ".drgs.jsonl", "depth", "images", "params.json", "transforms.json"
    ]  # fmt: skip
    K = views[0][0]
    assert abs(K[0, 2] - WIDTH / 2) > 0.5  # off the center on purpose
    for _, w2c, image, depth in views:
        assert np.allclose(w2c[:3, :3] @ w2c[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(w2c[:3, :3]) > 0
        assert 0.2 < depth.min() < depth.max() < 4.0  # no hole: the room closes every view
        assert 0.25 < image.mean() < 0.6  # exposed
        assert (image > 0.995).all(-1).mean() < 0.03  # and not burned
        assert np.ptp(image, axis=-1).mean() > 0.1  # colorful


def test_known_points_project_to_their_depth(views):
    """Points on the book's lid have the depth that the files' cameras give them."""
    # The lid's middle and its corners pulled in by a fifth, so that no pixel straddles the edge.
    box = still_life._BOOK
    lid = scenes.box_corners(**box)[:, :, 1].reshape(4, 3)
    points = np.concatenate([lid.mean(0)[None], lid.mean(0) + 0.8 * (lid - lid.mean(0))])
    checked = 0
    for K, w2c, _, depth in views:
        pixels, z = project(K, w2c, points)
        for (x, y), expected in zip(pixels, z, strict=True):
            if not (1 <= x < WIDTH - 1 and 1 <= y < HEIGHT - 1):
                continue
            # The lid is oblique: over one pixel its depth varies by about z / f times a slope.
            near = depth[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2]
            hidden = near.min() < expected - 0.05
            assert hidden or near.min() - 2e-3 <= expected <= near.max() + 2e-3
            checked += not hidden
    assert checked >= 6


def test_image_pixels_are_where_the_intrinsics_say(views):
    """The sensor that made the images sends each pixel's ray through the files' pixel center."""
    from drgs import runtime

    mi = runtime.mitsuba()
    for K, w2c, _, _ in views[:2]:
        camera = scenes.sensor(K, WIDTH, HEIGHT)
        scenes.aim(camera, np.linalg.inv(w2c))
        for x, y in ((0.5, 0.5), (40.5, 7.5), (63.5, 47.5)):
            at = mi.Point2f(x / WIDTH, y / HEIGHT)
            ray, _ = camera.sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
            pixels, z = project(K, w2c, (np.array(ray.o) + 2 * np.array(ray.d)).reshape(1, 3))
            assert z > 0
            assert np.allclose(pixels, [x, y], atol=2e-3)


def test_depth_agrees_between_views(views):
    """Back-projected points of one view, projected into another, lie on its surface or behind."""
    (K, w2c, _, depth), (_, other, _, other_depth) = views[0], views[1]
    pixels, z = project(K, other, back_project(K, w2c, depth))
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 1) & (x < WIDTH - 1) & (y >= 1) & (y < HEIGHT - 1) & (z > 0)
    x, y, z = x[inside], y[inside], z[inside]
    window = np.stack([other_depth[y + i, x + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    slack = 2e-3
    behind = z > window.min(0) - slack  # in front of everything around would be floating in the air
    assert len(z) > 500
    assert behind.mean() > 0.99
    assert ((z < window.max(0) + slack) & behind).mean() > 0.6  # the rest is occluded


def test_images_show_what_the_geometry_says(views):
    """The green apple's mask, found by depth around its known center, is green without a shift."""
    center, reach = np.array((-0.285, -0.03, 0.045)), 0.05
    shifts = [(dx, dy) for dx in (-2, -1, 0, 1, 2) for dy in (-2, -1, 0, 1, 2)]
    green = np.zeros(len(shifts))
    for K, w2c, image, depth in views:
        points = back_project(K, w2c, depth)
        apple = (np.linalg.norm(points - center, axis=1) < reach) & (points[:, 2] > 0.02)
        y, x = np.nonzero(apple.reshape(depth.shape))
        y, x = y[(y > 1) & (y < HEIGHT - 2)], x[(y > 1) & (y < HEIGHT - 2)]
        assert len(x) > 8
        for k, (dx, dy) in enumerate(shifts):
            r, g, b = image[y + dy, np.clip(x + dx, 0, WIDTH - 1)].mean(0)
            green[k] += g - (r + b) / 2
    assert max(map(abs, shifts[green.argmax()])) == 0


@pytest.mark.slow
def test_same_parameters_are_reused_and_others_replace(made, tmp_path, monkeypatch):
    """A finished folder is kept, another seed replaces it, the first seed gives the same bits."""
    with monkeypatch.context() as patch:
        patch.setattr(still_life, "_scene", lambda seed: pytest.fail("rendered again"))
        still_life.generate(made, VIEWS, WIDTH, HEIGHT, spp=30)
    folder = still_life.generate(tmp_path / "set", 1, 16, 12, spp=4)
    first = (folder / "images" / "000.png").read_bytes()
    still_life.generate(folder, 1, 16, 12, spp=4, seed=1)
    assert (folder / "images" / "000.png").read_bytes() != first
    still_life.generate(folder, 1, 16, 12, spp=4)
    assert (folder / "images" / "000.png").read_bytes() == first  # deterministic
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_interrupted_run_goes_on(tmp_path, monkeypatch):
    """Finished views stay in a hidden folder, are not traced again, and what comes out is what comes out at once."""

    def stop(done, total):
        raise KeyboardInterrupt

    built = still_life._scene(0)
    monkeypatch.setattr(still_life, "_scene", lambda seed: built)
    with pytest.raises(KeyboardInterrupt):
        still_life.generate(tmp_path / "set", 2, 16, 12, spp=1, progress=stop)
    hidden = tmp_path / "set" / ".drgs.scene"
    assert {path.name for path in (tmp_path / "set").iterdir()} == {".drgs.scene"}
    assert [path.name for path in (hidden / "images").iterdir()] == ["000.png"]
    aimed, aim = [], scenes.aim
    monkeypatch.setattr(scenes, "aim", lambda *args: aimed.append(1) or aim(*args))
    still_life.generate(tmp_path / "set", 2, 16, 12, spp=1)
    assert len(aimed) == 1
    assert not hidden.exists()
    still_life.generate(tmp_path / "other", 2, 16, 12, spp=1)
    for name in ("images/000.png", "images/001.png", "depth/001.png", "params.json", "transforms.json"):
        assert (tmp_path / "set" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_other_parameters_start_anew(tmp_path):
    """What an interrupted call has left is used by the same call only; a failure before anything leaves nothing."""

    def half(folder):
        output.write_file(folder / "a", b"half")
        raise OSError("no space")

    def fail(folder):
        raise OSError("no space")

    with pytest.raises(OSError, match="no space"):
        output.publish(tmp_path / "set", {"n": 1}, fail, "test")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="no space"):
        output.publish(tmp_path / "set", {"n": 1}, half, "test")
    output.publish(tmp_path / "set", {"n": 2}, lambda folder: output.write_file(folder / "b", b"whole"), "test")
    assert sorted(p.name for p in (tmp_path / "set").iterdir()) == [".drgs.jsonl", "b", "params.json"]


def test_a_hidden_folder_of_the_users_stays(tmp_path):
    """A `.drgs.scene` without the mark of an interrupted call is refused, be it a folder, a file or a link."""
    (tmp_path / "users").mkdir()
    (tmp_path / "users" / "mine").write_text("precious")
    for kind in ("folder", "file", "link"):
        hidden = tmp_path / kind / ".drgs.scene"
        hidden.parent.mkdir()
        if kind == "link":
            hidden.symlink_to(tmp_path / "users")
        elif kind == "file":
            hidden.write_text("precious")
        else:
            hidden.mkdir()
            (hidden / "mine").write_text("precious")
        with pytest.raises(ValueError, match="it was not made here; move it away"):
            output.publish(tmp_path / kind, {"n": 1}, lambda folder: None, "test")
        assert (hidden if kind == "file" else hidden / "mine").read_text() == "precious"


def test_killed_while_it_is_published(tmp_path, monkeypatch):
    """Whichever file was moved last, the same call then makes the whole set."""

    def fill(folder):
        for name in ("a", "b", "c"):
            output.write_file(folder / name, name.encode())

    from drgs.io.outputs import LockedFolder

    put = LockedFolder.put
    for moved in range(4):
        left = [moved]

        def stop(claim, path, name, left=left):
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            put(claim, path, name)

        monkeypatch.setattr(LockedFolder, "put", stop)
        with pytest.raises(KeyboardInterrupt):
            output.publish(tmp_path / str(moved), {"n": 1}, fill, "test")
        monkeypatch.setattr(LockedFolder, "put", put)
        output.publish(tmp_path / str(moved), {"n": 1}, fill, "test")
        names = sorted(path.name for path in (tmp_path / str(moved)).iterdir())
        assert names == [".drgs.jsonl", "a", "b", "c", "params.json"]


def test_leftovers_of_killed_runs_go(tmp_path):
    """What a killed process left is removed by the next run."""
    (tmp_path / "set" / ".drgs.scene.abcdefgh.tmp").mkdir(parents=True)
    (tmp_path / ".set.99999999.partial").mkdir()  # the user's
    output.publish(tmp_path / "set", {}, lambda folder: (folder / "a").write_text("b"), "test")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".set.99999999.partial", "set"]
    assert sorted(p.name for p in (tmp_path / "set").iterdir()) == [".drgs.jsonl", "a", "params.json"]


def test_what_was_added_to_a_published_folder_stays(tmp_path):
    """Other parameters replace what was made here, and refuse to while something else is in the folder."""

    def publish(number):
        output.publish(tmp_path / "set", {"n": number}, lambda folder: (folder / "a").write_text(str(number)), "test")

    publish(1)
    (tmp_path / "set" / "run").mkdir()
    (tmp_path / "set" / "run" / "point_cloud.ply").write_text("hours of work")
    with pytest.raises(ValueError, match=r"must be a new folder or as it was made here, .*run is not; name another"):
        publish(2)
    assert (tmp_path / "set" / "run" / "point_cloud.ply").read_text() == "hours of work"
    assert (tmp_path / "set" / "a").read_text() == "1"
    (tmp_path / "set" / "run").rename(tmp_path / "elsewhere")
    publish(2)
    assert (tmp_path / "set" / "a").read_text() == "2"


def test_bad_input(tmp_path, capsys):
    """One line that says what to do; nothing written."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "photo.jpg").write_text("x")
    with pytest.raises(ValueError, match="the output must be a new folder"):
        still_life.generate(tmp_path / "mine", 1, 16, 12)
    with pytest.raises(ValueError, match="views must be an integer from 1"):
        still_life.generate(tmp_path / "new", 0)
    assert not (tmp_path / "new").exists()
    assert still_life.main([str(tmp_path / "new"), "--spp", "0"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "spp" in error


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("room --size 320", "--size: must be WIDTHxHEIGHT, got '320'"),
        ("room --size 4x4", "width must be an integer from 8"),
        ("room --views 0", "views must be an integer from 1"),
        ("room --spp 0", "spp must be an integer from 1"),
        ("room --teacher-size 0x1", "teacher_width must be an integer from 1"),
        ("room --test-every 1", "test_every must be an integer from 2"),
        ("kitchen --size 4x4", "width must be an integer from 8"),
        ("kitchen --size 24x17", "width and height must be even, as videos have them, got 24x17"),
        ("kitchen --cameras 0", "cameras must be an integer from 1"),
        ("kitchen --times 0", "times must be an integer from 1"),
        ("kitchen --seed -1", "--seed must be in [0, 2147483647]"),
        ("kitchen --teacher-size 0x1", "teacher_width must be an integer from 1"),
        (
            "kitchen --views 3",
            "--views: is for `drgs scene capture` and `drgs scene room` and `drgs scene still_life`, not for kitchen",
        ),
        ("kitchen --test-every 3", "--test-every: is for `drgs scene room`, not for kitchen"),
        ("capture --views 3", "views must be at least 4, got 3"),
        ("capture --pose-error 1", "--pose-error: must be DEGREES,METERS, got '1'"),
        ("capture --pose-error 11,0", "pose_error must be degrees from 0 to 10 and meters from 0 to 0.1"),
        ("room --exposure auto", "--exposure: is for `drgs scene capture`, not for room"),
        ("still_life --no-shadow", "--no-shadow: is for `drgs scene capture`, not for still_life"),
        ("still_life --teacher-size 8x8", "is for `drgs scene room`"),
        ("still_life --test-every 3", "is for `drgs scene room`"),
        ("capture --free", "and `drgs scene hall`, not for capture; leave it out"),
        ("bathroom", "NAME must be one of room"),
    ],
)
def test_bad_arguments(words, says, tmp_path, capsys):
    """Of every scene: one line, exit code 2, nothing written."""
    name, *options = words.split()
    assert cli.main(["scene", name, "-o", str(tmp_path / "x"), *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert says in error
    assert list(tmp_path.iterdir()) == []
