"""The room: labels, depth, points and teacher against its geometry; seeds, files, resuming, the command."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
from json_page import OF_CAPTURE, check

from drgs import cli, data, scenes
from drgs.scenes import output, room, teacher
from drgs.scenes.colmap import back_project, project, sparse_points

WIDTH, HEIGHT, VIEWS = 32, 24, 6
SMALL = {"views": VIEWS, "width": WIDTH, "height": HEIGHT, "spp": 2}


@pytest.fixture(scope="module")
def built():
    """The Mitsuba scene of seed 0 and the classes of its shapes."""
    return room.scene(0)


@pytest.fixture(scope="module")
def made(built, tmp_path_factory):
    """A small data set, finished by a second call after an interruption."""
    folder = tmp_path_factory.mktemp("room") / "data"

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "scene", lambda seed: built)
        with pytest.raises(KeyboardInterrupt):
            room.generate(folder, **SMALL, progress=stop)
        assert [path.name for path in folder.iterdir()] == [".drgs.scene"]
        aimed, aim = [], scenes.aim
        patch.setattr(scenes, "aim", lambda *args: aimed.append(1) or aim(*args))
        room.generate(folder, **SMALL)
    assert len(aimed) == VIEWS - 2  # finished views are not traced again
    return folder


@pytest.fixture(scope="module")
def views(made):
    """The data set as `drgs fit` loads it, with (image, depth, labels) of each view."""
    dataset = data.load(made, test_every=room.TEST_EVERY)
    work = room._Views(made, (WIDTH, HEIGHT), (WIDTH, HEIGHT), 2, 0)
    return dataset, [work.read(k) for k in range(VIEWS)]


def test_files(made, views):
    """Everything is there under the names that Feature 3DGS reads; test views are those that a fit holds out."""
    dataset, _ = views
    assert len(dataset.views) == VIEWS
    assert dataset.points.shape[0] > 300
    held_out = [f"{view.name}.png" for view in dataset.split()[1]]
    assert held_out == (made / "test_views.txt").read_text().split() == ["rgb_000.png", "rgb_005.png"]
    absent = ("cameras", "times", "free", *OF_CAPTURE)
    check("params.json", json.loads((made / "params.json").read_text()), absent=absent)
    check("teacher.json", json.loads((made / "teacher.json").read_text()))
    check("classes.json", json.loads((made / "classes.json").read_text()), absent=("command",))
    names = {path.name for path in made.iterdir()}
    assert names == {
        ".drgs.jsonl", "classes.json", "depth", "images", "params.json", "rgb_feature_langseg", "semantic_class",
        "sparse", "teacher.json", "test_views.txt", "text_embeddings.npy",
    }  # fmt: skip
    assert not [path for path in made.rglob("*.part")]
    for view in dataset.views:
        feature = teacher.load(made / "rgb_feature_langseg" / f"{view.name}_fmap_CxHxW.pt")
        assert feature.shape == (512, HEIGHT, WIDTH)
        assert np.isfinite(feature).all()


def test_classes(made, views):
    """At least 12 classes are seen, every pixel has one that classes.json names."""
    listed = json.loads((made / "classes.json").read_text())
    ids = [entry["id"] for entry in listed["classes"]]
    assert ids == list(range(1, 19))
    assert [entry["name"] for entry in listed["classes"]] == list(room.CLASSES)
    seen = np.unique([labels for _, _, labels in views[1]])
    assert set(seen) <= set(ids)
    assert len(seen) >= 12


def test_depth_and_labels_are_those_of_the_first_surface(built, views):
    """A ray cast from the loaded cameras, pixel by pixel, meets the file's class at the file's depth."""
    import drjit as dr
    import mitsuba as mi

    def number(shape):
        return dr.reinterpret_array(mi.UInt32, shape).numpy()

    parts = [part[0] for part in room.parts(0)]
    names = {int(number(mi.ShapePtr(shape))[0]): parts[int(shape.id()[4:])] for shape in built[0].shapes()}
    rng = np.random.default_rng(0)
    for view, (_, depth, labels) in zip(views[0].views[:3], views[1], strict=False):
        K, c2w = view.camera.K, view.camera.c2w
        x, y = rng.integers((0, 0), (WIDTH, HEIGHT), (40, 2)).T
        ways = (c2w[:3, :3] @ np.linalg.inv(K) @ (x + 0.5, y + 0.5, np.ones(40))).astype(np.float32)
        eye = mi.Point3f(*(float(v) for v in c2w[:3, 3]))
        hit = built[0].ray_intersect(mi.Ray3f(eye, mi.Vector3f(*(mi.Float(way) for way in ways))))
        # 16-bit rounding is 0.05 mm; float32 rays over 6 m are off by less than 0.1 mm.
        assert np.abs(hit.t.numpy() - depth[y, x]).max() < 2e-4
        assert [room.CLASSES[label - 1] for label in labels[y, x]] == [names[n] for n in number(hit.shape)]


def test_geometry_of_classes(views):
    """Back-projected pixels: the floor is at 0, the ceiling at its height, walls on the room's sides."""
    x, y, z = room.Layout(0).size
    for view, (_, depth, labels) in zip(views[0].views, views[1], strict=True):
        points = back_project(view.camera.K, view.camera.c2w, depth)
        floor, ceiling, wall = (points[labels == room.CLASSES.index(name) + 1] for name in ("floor", "ceiling", "wall"))
        # 1e-3: depth's rounding and float32 poses, seen at a slant. A wall has a baseboard, 16 mm thick.
        assert np.abs(floor[:, 2]).max(initial=0) < 1e-3
        assert np.abs(ceiling[:, 2] - z).max(initial=0) < 1e-3
        to_side = np.minimum(np.abs(np.abs(wall[:, 0]) - x / 2), np.abs(np.abs(wall[:, 1]) - y / 2))
        assert to_side.max(initial=0) < 0.018


def test_sparse_points_lie_on_what_they_were_drawn_from(views):
    """Exact points project to pixels of their class; errors have the stated size; tracks are near the projections."""
    dataset, content = views
    K, poses = dataset.views[0].camera.K, np.array([view.camera.c2w for view in dataset.views])
    points = sparse_points(K, poses, lambda k: content[k], room._POINTS, 0)
    assert np.allclose(np.sort(points.xyz, 0), np.sort(dataset.points, 0), atol=2e-3)  # those that were written
    agree = total = 0
    for k, (ids, pixels) in enumerate(points.tracks):
        exact, z = project(K, poses[k], points.exact[ids])
        assert (z > 0).all()
        assert np.abs(exact - pixels).max() < 5 * 0.5  # five standard deviations
        x, y = exact.astype(int).T
        labels = np.pad(content[k][2], 1, mode="edge")
        around = np.stack([labels[y + i, x + j] for i in range(3) for j in range(3)])
        inside = (around == around[:1]).all(0)
        agree += int((around[4] == points.label[ids])[inside].sum())
        total += int(inside.sum())
    assert total > 300
    # A point beside a thin thing, or in a shelf, can be seen at the same depth as its neighbor: few.
    assert agree / total > 0.98
    off = np.linalg.norm(points.xyz - points.exact, axis=1)
    assert 0.003 < np.median(off[~points.outlier]) < 0.03  # 0.2 % and 0.6 % of 1 to 5 m
    assert 0.005 < points.outlier.mean() < 0.05
    assert np.median(off[points.outlier]) > 0.3


def test_cameras_keep_their_distance(built):
    """Every camera of the default way is at eye height and clear of every surface, also of what is behind it."""
    import mitsuba as mi

    poses = room._clear(built[0], room.trajectory(room.Layout(0), 75, 0))
    assert ((poses[:, 2, 3] > 1.3) & (poses[:, 2, 3] < 1.7)).all()
    ways = np.random.default_rng(0).standard_normal((3, 2000)).astype(np.float32)
    ways /= np.linalg.norm(ways, axis=0)
    for pose in poses[::5]:
        ray = mi.Ray3f(mi.Point3f(*(float(v) for v in pose[:3, 3])), mi.Vector3f(*(mi.Float(way) for way in ways)))
        assert built[0].ray_intersect_preliminary(ray, coherent=False).t.numpy().min() > 0.3  # 0.35 by 400 other rays


def test_teacher_errs_as_stated(built):
    """At 80x60, 78 to 88 % of the pixels are right, fewer at boundaries; two views err in different places."""
    vectors = teacher.embeddings(room.CLASSES)
    cosines = vectors @ vectors.T
    assert np.allclose(np.diag(cosines), 1, atol=1e-5)
    same = [
        cosines[room.CLASSES.index(a), room.CLASSES.index(b)] for g in teacher.GROUPS for a in g for b in g if a < b
    ]
    assert min(same) > 0.7
    assert np.mean(same) > 0.77
    assert 0.55 < np.median(cosines) < 0.68
    K, found = room._intrinsics(80, 60), []
    poses = room.trajectory(room.Layout(0), 8, 0)
    for k, pose in enumerate(poses):
        depth, numbers = scenes.first_hits(built[0], K, pose, 80, 60)
        labels = built[1][numbers]
        feature = teacher.feature_map(labels, back_project(K, pose, depth), room.CLASSES, (80, 60), 0, k)
        assert feature.dtype == np.float16
        assert 3 < np.linalg.norm(feature.astype(np.float32), axis=0).mean() < 5.5
        if k == 0:
            again = teacher.feature_map(labels, back_project(K, pose, depth), room.CLASSES, (80, 60), 0, 0)
            other = teacher.feature_map(labels, back_project(K, pose, depth), room.CLASSES, (80, 60), 0, 1)
            assert np.array_equal(feature, again)
            wrong = [teacher.read_labels(f.astype(np.float32), vectors) != labels for f in (feature, other)]
            assert 0.02 < (wrong[0] & ~wrong[1]).mean() < 0.2
        found.append((feature.astype(np.float32), labels))
    assert 0.78 < teacher.accuracy(found, vectors) < 0.88
    edge = np.concatenate([(np.abs(np.diff(x.astype(int), axis=1))[:, :79] > 0).ravel() for _, x in found])
    right = np.concatenate([(teacher.read_labels(f, vectors) == x)[:, :79].ravel() for f, x in found])
    assert right[edge].mean() < right[~edge].mean() - 0.1


def test_maps_of_any_size(rng):
    """A map's size need not divide the image's."""
    labels = rng.integers(0, len(room.CLASSES) + 1, (48, 64))
    feature = teacher.feature_map(labels, None, room.CLASSES, (60, 45), 0, 0)
    assert feature.shape == (512, 45, 60)


def test_seeds(built, made, tmp_path, monkeypatch):
    """The same seed gives the same parts and files to the bit; another gives another room."""
    first, again, other = (list(room.parts(seed)) for seed in (0, 0, 1))
    assert len(first) == len(again)
    for a, b in zip(first, again, strict=True):
        assert a[0] == b[0]
        assert all(np.array_equal(x, y) for x, y in zip(a[1], b[1], strict=True))
        assert np.array_equal(a[3], b[3])
    assert {part[0] for part in first} == {part[0] for part in other} == set(room.CLASSES)
    assert not np.array_equal(room.Layout(0).size, room.Layout(1).size)
    assert len({(room.Layout(seed).sunny, room.Layout(seed).cozy) for seed in range(4)}) == 4  # every arrangement
    monkeypatch.setattr(room, "scene", lambda seed: built)
    room.generate(tmp_path / "set", **SMALL)  # at once, what `made` did in two calls
    files = sorted(path.relative_to(made) for path in made.rglob("*") if path.is_file() and path.name != ".drgs.jsonl")
    assert all((tmp_path / "set" / name).read_bytes() == (made / name).read_bytes() for name in files)


def test_rooms_that_are_there_are_kept(tmp_path, monkeypatch):
    """What the defaults are recorded as has not changed: a finished room of the same files is not made again."""
    recorded = []
    monkeypatch.setattr(output, "publish", lambda folder, parameters, fill, where: recorded.append(parameters))
    room.generate(tmp_path / "a")
    digest = hashlib.sha256(json.dumps(recorded[0], sort_keys=True).encode()).hexdigest()
    assert digest == "42882fada0fa1a89f527fb6a7cce9a90c7739ecf6a1b4d229280818933fb837c"


def test_command(built, tmp_path, monkeypatch, capsys):
    """`drgs scene room` writes a data set, says what to do next, and keeps a finished one."""
    monkeypatch.setattr(room, "scene", lambda seed: built)
    out = tmp_path / "set"
    command = [
        "scene",
        "room",
        "-o",
        str(out),
        "--size",
        "24x16",
        "--views",
        "3",
        "--spp",
        "1",
        "--teacher-size",
        "12x8",
        "--test-every",
        "2",
    ]
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert "3 views of 24x16, 2 held out\n18 classes, teacher right at" in said
    assert f"next: drgs fit {out} -o RUN --test-every 2" in said
    assert (out / "test_views.txt").read_text().split() == ["rgb_000.png", "rgb_002.png"]
    assert teacher.load(out / "rgb_feature_langseg" / "rgb_001_fmap_CxHxW.pt").shape == (512, 8, 12)
    monkeypatch.setattr(room, "scene", lambda seed: pytest.fail("made again"))
    assert cli.main([*command, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert cli.main(command) == 0
    assert capsys.readouterr().out == f"{out}: already complete\n{said}"
    for other, told in ((["--seed", "1"], "seed 0, not 1"), (["--size", "320x240"], "width 24, not 320")):
        assert cli.main([*command, *other]) == 2
        assert f"{out}: -o must be a new folder or hold the same data set, holds one with {told}; choose" in (
            capsys.readouterr().err
        )
    assert cli.main(["scene", "kitchen", "-o", str(out)]) == 2
    assert "holds one with scene 'room', not 'kitchen'" in capsys.readouterr().err
