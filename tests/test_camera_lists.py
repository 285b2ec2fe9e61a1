"""One JSON form of cameras, written by commands and read wherever cameras are named."""

from __future__ import annotations

import dataclasses
import json
import zlib

import numpy as np
import pytest
from test_active import SIZE, config, lazily, plan, write_still

from drgs import cli
from drgs.cameras import Camera, orbit
from drgs.data import load
from drgs.data.camera_lists import camera_to_json, is_camera_list, load_cameras_json, save_cameras_json
from drgs.files import save_ply
from drgs.train import fit
from drgs.viewing.placed_views import read_ranking


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, `scene.ply`, `cameras.json`, and `picked.json`, three of an orbit of nine that `drgs select` picked."""
    folder = tmp_path_factory.mktemp("cameras")
    save_ply(write_still(folder / "data"), folder / "scene.ply")
    save_cameras_json(folder / "cameras.json", orbit((0, 0, 0), 3.0, 4, width=SIZE, height=20))
    orbit_of = "--candidates orbit --count 9 --orbit up=z"
    line = f"select {folder}/scene.ply --train {folder}/cameras.json {orbit_of} -k 3 --quiet"
    assert cli.main([*line.split(), "--policy", "random", "--seed", "1", "-o", f"{folder}/picked.json"]) == 0
    return folder


def test_what_was_picked_is_rendered(place, monkeypatch):
    """The round trip: exactly the picked views, in the order of picking, with their poses, sizes and pinholes."""
    monkeypatch.chdir(place)
    picks = json.loads((place / "picked.json").read_text())["picks"]
    names = [pick["name"] for pick in picks]
    assert names != sorted(names), "an order that no list of files has by itself"
    line = "render scene.ply --cameras picked.json --preset fast -o out --quiet"
    assert cli.main(line.split()) == 0
    drawn = json.loads((place / "out/render.json").read_text())["views"]
    assert [view["camera"]["name"] for view in drawn] == names
    for view, pick in zip(drawn, picks, strict=True):
        np.testing.assert_allclose(view["camera"]["c2w"], pick["camera"]["c2w"], atol=1e-12)
        assert [view["camera"][key] for key in ("K", "width")] == [pick["camera"][key] for key in ("K", "width")]
        assert (place / "out" / view["files"][0]).is_file()
    for again in ("out/render.json", "out/cameras.json"):
        assert [camera.name for camera in load_cameras_json(place / again)] == names


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("line", "file", "count"),
    [
        ("select scene.ply --train cameras.json --candidates picked.json --policy uniform", "select.json", 3),
        ("select scene.ply --train picked.json --candidates cameras.json --policy uniform", "select.json", 4),
        ("fisher scene.ply --train cameras.json --cameras picked.json --preset fast", "fisher.json", 3),
        ("crossval scene.ply --cameras picked.json --rasterizer drgs:fast --no-ladder", "crossval.json", 2),
    ],
)
def test_commands_read_what_commands_write(place, tmp_path, monkeypatch, line, file, count):
    """`--cameras`, `--candidates` and `--train` alike."""
    monkeypatch.chdir(place)
    output = tmp_path / (file if line.startswith("select") else "")
    assert cli.main([*line.split(), "--quiet", "-o", str(output)]) == 0
    found = json.loads((tmp_path / file).read_text())
    assert len(found.get("candidates") or found.get("views") or found["cameras"]) == count


def test_an_active_fit_says_where_it_looked_from(place, tmp_path, monkeypatch):
    """The views it was fitted to, from its start on, as its data set has them; `--train` takes the file for the run."""
    fit(lazily(place / "data"), tmp_path / "run", config(max_steps=12, selection=plan()), progress=False)
    record = json.loads((tmp_path / "run/selection.json").read_text())
    names = [view["name"] for view in (*record["start"], *record["picks"])]
    cameras = load_cameras_json(tmp_path / "run/selection.json")
    assert [camera.name for camera in cameras] == names
    views = {view.name: view.camera for view in load(place / "data").views}
    for camera in cameras:
        np.testing.assert_allclose(camera.w2c, views[camera.name].w2c, atol=1e-9)
        np.testing.assert_allclose(camera.K, views[camera.name].K)
    monkeypatch.chdir(tmp_path)
    line = f"select run --train run/selection.json --candidates {place}/data --policy farthest --quiet -o out.json"
    assert cli.main(line.split()) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["known"]["names"] == names


def test_cameras_of_any_lens_and_time_come_back(tmp_path):
    """A list of what commands write, an object with it, and INRIA's layout beside it."""
    cameras = orbit((0, 0, 0), 3.0, 2, width=12, height=9)
    bent = dataclasses.replace(cameras[1], model="opencv", distortion=(0.1, 0.01, 0.0, 0.0), time=0.5, name="bent")
    save_cameras_json(tmp_path / "inria.json", cameras)
    both = [*json.loads((tmp_path / "inria.json").read_text()), camera_to_json(bent)]
    for written in (both, {"cameras": both}, {"schema": 1, "command": "x", "cameras": "words", "views": both}):
        path = tmp_path / "some.json"
        path.write_text(json.dumps(written))
        assert is_camera_list(path)
        found = load_cameras_json(path)
        assert [camera.name for camera in found] == [*(camera.name for camera in cameras), "bent"]
        assert (found[2].model, found[2].distortion, found[2].time) == (bent.model, bent.distortion, bent.time)
        np.testing.assert_allclose(found[2].w2c, bent.w2c, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"command": "fit", "picks": []}', "must be a list of at least one camera, or have `cameras`, or poses in"),
        (
            '{"command": "fit", "picks": [{"name": "a", "camera": "cam0"}]}',
            "poses in `picks` or `views`, got none;",
        ),
        ('{"command": "select", "picks": [{"camera": {"c2w": 1}}]}', "picks 0: it must have the key 'name'"),
        ('{"command": "eval", "views": [{"name": "a"}]}', "views 0: it must have the key 'width'"),
        ("[3]", "camera 0: it must be "),
        ("[]", "must be a list of at least one camera, got "),
    ],
)
def test_files_without_cameras(tmp_path, place, capsys, text, message):
    """One line, exit code 2: where, and what must be there."""
    path = tmp_path / "some.json"
    path.write_text(text)
    assert cli.main(["render", f"{place}/scene.ply", "--cameras", str(path), "-o", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert str(path) in told
    assert told.count("\n") == 1


def test_a_data_set_is_no_list_of_cameras(tmp_path):
    """Whatever the first key of a transforms.json is; an empty list of cameras hides no picks."""
    (tmp_path / "transforms.json").write_text('{"cameras": [], "fl_x": 10, "frames": [{"file_path": "a.png"}]}')
    assert not is_camera_list(tmp_path / "transforms.json")
    camera = Camera(K=np.diag([9.0, 9, 1]), w2c=np.eye(4), width=4, height=4, name="a")
    path = tmp_path / "selection.json"
    path.write_text(
        json.dumps({"schema": 1, "command": "select", "cameras": [], "picks": [{"camera": camera_to_json(camera)}]})
    )
    assert is_camera_list(path)
    assert [camera.name for camera in load_cameras_json(path)] == ["a"]


def test_a_camera_that_is_a_name_is_no_pose(tmp_path):
    """An active fit of what moves names the camera of each candidate; `drgs view` ranks by it all the same."""
    row = {"name": "a@0", "camera": "a", "time": 0.0, "score": 1.0, "parts": {}}
    pick = {"name": "a@0", "policy": "farthest", "criterion": None, "candidates": [row], "camera": "a", "time": 0.0}
    path = tmp_path / "selection.json"
    path.write_text(json.dumps({"schema": 1, "command": "fit", "picks": [pick]}))
    assert read_ranking(path).cameras == ()


def test_a_transposed_pose_is_refused(tmp_path):
    """Its rotation is one, too, and its position would be 0."""
    value = camera_to_json(orbit((0, 0, 0), 3.0, 1, width=12, height=9)[0])
    value["c2w"] = np.transpose(value["c2w"]).tolist()
    path = tmp_path / "some.json"
    path.write_text(json.dumps([value]))
    with pytest.raises(ValueError, match=r"camera 0: the pose must be camera-to-world by rows .* is it transposed"):
        load_cameras_json(path)


def test_json_has_limits(tmp_path):
    """Nesting, integers of thousands of digits, and files that are not UTF-8 end in one line."""
    path = tmp_path / "cameras.json"
    for data, told in (
        (b"[" * 200_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b"\xff\xfe[]", "must be valid JSON"),
        (zlib.compress(b"[]"), "must be valid JSON"),
    ):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=told) as error:
            load_cameras_json(path)
        assert "\n" not in str(error.value)
    entry = '{"width": 8, "height": 6, "fx": 9, "fy": 9, "position": [0, 0, %s], "rotation": [[1,0,0],[0,1,0],[0,0,1]]}'
    for digits in (30, 400, 5000):
        path.write_text("[" + entry % ("9" * digits) + "]")
        with pytest.raises(ValueError, match=r"position\[2\] must be a finite number|must be within 1e\+15"):
            load_cameras_json(path)
    path.write_bytes(b"\xef\xbb\xbf[" + (entry % "1").encode() + b"]")  # Windows' mark of UTF-8
    assert len(load_cameras_json(path)) == 1
