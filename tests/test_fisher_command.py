"""`drgs fisher`: information in a file, maps whose sums are the scores, pose information, and bad input."""

from __future__ import annotations

import dataclasses
import json
import re

import cv2
import numpy as np
import pytest
import torch
from scenes_random import assert_same_sums
from test_active import SIZE, config, lazily, plan, write_still

from drgs import cli, fisher
from drgs.cameras import Camera, look_at, orbit
from drgs.cameras.sizes import at_most
from drgs.commands.fisher import map_weights
from drgs.commands.frames import _moved, in_frame_of_data
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.display.pictures import map_picture
from drgs.files import load_ply, load_state, save_ply
from drgs.fitting.components.table import held_components
from drgs.fitting.errors import run_error_record
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.records import load_run
from drgs.gain import Prior, unit_length
from drgs.information.expected_error import error_record, expected_error
from drgs.integrator import render
from drgs.io.run import Run
from drgs.settings import RenderSettings
from drgs.train import fit


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, an active run `run` on it, `scene.ply`, `cameras.json`."""
    folder = tmp_path_factory.mktemp("fisher")
    save_ply(write_still(folder / "data"), folder / "scene.ply")
    fit(lazily(folder / "data"), folder / "run", config(max_steps=12, selection=plan()), progress=False)
    save_cameras_json(folder / "cameras.json", orbit((0, 0, 0), 3.0, 5, width=SIZE, height=20))
    return folder


def run(line: str, place, monkeypatch, capsys) -> tuple[dict, str]:
    monkeypatch.chdir(place)
    assert cli.main(["fisher", *line.split(), "-o", "out"]) == 0, capsys.readouterr().err
    return json.loads((place / "out/fisher.json").read_text()), capsys.readouterr().out


def test_information_of_a_run(place, monkeypatch, capsys):
    """The file holds the sum over the run's views, group by group; maps are drawn for them."""
    report, text = run("run --limit 3 --preset fast --blocks geometry", place, monkeypatch, capsys)
    tensors, header = load_state(place / "out/information.safetensors")
    from drgs.settings import RenderSettings

    views = {view.name: view.camera for view in load(place / "data").views}
    cameras = [views[name] for name in report["known"]["names"]]
    truth = fisher.diagonal(load_ply(place / "run/point_cloud.ply"), cameras, RenderSettings.preset("fast"))
    assert list(tensors) == sorted(truth)
    for name, x in truth.items():
        assert tensors[name].dtype == torch.float64
        torch.testing.assert_close(tensors[name], x, rtol=1e-5, atol=1e-9 * float(x.max()))
    assert header["views"] == report["known"]["names"]
    assert len(report["views"]) == 3
    for row in report["views"]:
        for file in row["files"]:
            assert cv2.imread(str(place / "out" / file)).shape == (SIZE, SIZE + 76, 3)
    assert "information of 4 views (run)" in text
    assert "pose" not in text


def test_expected_error_of_a_run(place, monkeypatch, capsys, caplog):
    """Of a run, the first map of a view is its expected error, told first; without photographs it is left out."""
    report, text = run("run --limit 2 --preset fast --blocks geometry", place, monkeypatch, capsys)
    record = run_error_record(Run(place / "run"), RenderSettings.preset("fast"), report["pixels"])
    assert report["misfit"] == pytest.approx(record.mean_misfit**0.5)
    views = {view.name: view.camera for view in load(place / "data").views}
    scene = load_run(place / "run").scene
    for row in report["views"]:
        assert row["files"][0] == f"{row['name']}.error.png"
        assert cv2.imread(str(place / "out" / row["files"][0])).shape == (SIZE, SIZE + 76, 3)
        told = expected_error(scene, views[row["name"]], record)
        assert row["error"]["rmse"] == pytest.approx(float(told.mean().sqrt()), rel=1e-3)
        assert sum(row["error"]["parts"].values()) == pytest.approx(1)
    assert text.startswith("expected error")
    assert " ".join(text.splitlines()[1].split()).startswith("view of a color expected PSNR misfit ")
    report, text = run("scene.ply --train cameras.json --limit 2", place, monkeypatch, capsys)
    assert report["misfit"] is None
    assert "error" not in report["views"][0]
    assert "expected error" not in text
    assert caplog.text.count("cameras.json: has no photographs: only information is written, no expected error") == 1


def test_expected_error_of_a_splat(place, monkeypatch, capsys, caplog):
    """Of a file of Gaussians with the photographs of a data set, or those of a run, as of the run itself."""
    settings = "--limit 2 --preset fast --blocks geometry --info-pixels 300"
    splat = "scene.ply --cameras cameras.json --train"
    g, views = load_ply(place / "scene.ply"), load(place / "data").views
    for train in ("data", "run"):
        report, text = run(f"{splat} {train} {settings}", place, monkeypatch, capsys)
        known = [view for view in views if view.name in report["known"]["names"]]
        frames = load_frames(known, 300)
        images, masks = [x.image() for x in frames], [x.mask for x in frames]
        record = error_record(g, [x.camera for x in frames], images, RenderSettings.preset("fast"), masks=masks)
        assert report["misfit"] == pytest.approx(record.mean_misfit**0.5, rel=1e-4)
        camera = at_most(load_cameras_json(place / "cameras.json")[0], 300)
        told = float(expected_error(g, camera, record).mean().sqrt())
        assert report["views"][0]["error"]["rmse"] == pytest.approx(told, rel=1e-3)
        assert text.startswith("expected error")
    assert len(known) < len(views)  # a run has not seen all
    assert "without photographs" not in caplog.text


def test_photographs_without_their_exposure():
    """A photograph is divided by its own gain, but for what is known to be background; and not without gains."""
    camera = orbit((0, 0, 0), 3.0, 2, width=4, height=3)[0]
    frame = Frame("a", camera, torch.full((3, 4, 3), 0.4), mask=torch.zeros(3, 4), is_object=True)
    frame.mask[:, :2] = 1
    networks = {"exposure": {"log_gains": torch.tensor([[2.0, 1.0, 0.5]]).log()}}
    (held,) = held_components(["a"], networks, RenderSettings())
    shown = held.as_shown(frame.image(), frame)
    torch.testing.assert_close(shown[0, 0], torch.tensor([0.2, 0.4, 0.8]))
    torch.testing.assert_close(shown[0, 3], torch.full((3,), 0.4))
    assert held_components(["a"], {}, RenderSettings()) == []


def test_maps_add_up_to_the_scores(place, monkeypatch, capsys):
    """The sum of the variance map is `eig`, that of the share map is `logdet`, to 1e-4 (measured: 1e-6)."""
    report, _ = run("run --cameras cameras.json --limit 2", place, monkeypatch, capsys)
    for row in report["views"]:
        assert row["variance"]["sum"] == pytest.approx(row["gain"]["eig"], rel=1e-4)
        assert row["share"]["sum"] == pytest.approx(row["gain"]["logdet"], rel=1e-4)
        assert row["gain"]["logdet"] < row["gain"]["eig"]


def test_lambda_is_one_unless_told_otherwise(place, monkeypatch, capsys):
    """Not the one that views are chosen with; --relative-prior alone keeps its own, 1e-6 of the median."""
    line = "run --limit 1 --preset fast --blocks geometry"
    default, _ = run(line, place, monkeypatch, capsys)
    given, _ = run(f"{line} --prior 1", place, monkeypatch, capsys)
    views = {view.name: view.camera for view in load(place / "data").views}
    known = [views[name] for name in default["known"]["names"]]
    length = unit_length(load_ply(place / "run/point_cloud.ply"), known)
    assert default["prior"] == given["prior"] == {"value": 1.0, "relative": False, "length": pytest.approx(length)}
    gains = [found["views"][0]["gain"] for found in (default, given)]
    assert gains[0].keys() == gains[1].keys()
    assert_same_sums(*(list(gain.values()) for gain in gains))
    relative, _ = run(f"{line} --relative-prior", place, monkeypatch, capsys)
    assert relative["prior"] == {"value": 1e-6, "relative": True, "length": pytest.approx(length)}


def test_lambda_zero_leaves_unseen_parameters_out(place, monkeypatch, capsys):
    """One known view and lambda = 0: finite maps, and still the scores' sums."""
    known = load_cameras_json(place / "cameras.json")[:1]
    save_cameras_json(place / "one.json", known)
    line = "scene.ply --train one.json --cameras cameras.json --prior 0 --limit 2"
    report, _ = run(line, place, monkeypatch, capsys)
    for row in report["views"]:
        assert row["variance"]["sum"] == pytest.approx(row["gain"]["eig"], rel=1e-4)
        assert row["share"]["sum"] == pytest.approx(row["gain"]["logdet"], rel=1e-4)


def test_share_tends_to_the_variance():
    """A parameter that the view hardly sees weighs the same in both; one that nothing sees at lambda = 0 weighs 0."""
    H = {"means": torch.tensor([[2.0, 0.0, 4.0]], dtype=torch.float64)}
    Hc = {"means": torch.tensor([[0.0, 3.0, 1e-9]], dtype=torch.float64)}
    variance, share = map_weights(H, Hc, Prior(0.0))
    assert variance["means"].tolist() == [[0.5, 0.0, 0.25]]
    torch.testing.assert_close(share["means"], variance["means"])
    _, share = map_weights(H, {"means": torch.full((1, 3), 2.0)}, Prior(0.0))
    assert share["means"][0, 0] == pytest.approx(np.log(2) / 2)


def test_pose_information(place, monkeypatch, capsys):
    """--pose: the 6x6 matrix of drgs.fisher, symmetric, with its eigenvalues in the table."""
    report, text = run("scene.ply --cameras cameras.json --limit 1 --pose", place, monkeypatch, capsys)
    (row,) = report["views"]
    camera = load_cameras_json(place / "cameras.json")[0]
    truth = fisher.pose_information(load_ply(place / "scene.ply"), camera)
    np.testing.assert_allclose(row["pose"]["information"], truth.numpy(), rtol=1e-5)
    np.testing.assert_allclose(row["pose"]["eigenvalues"], np.linalg.eigvalsh(truth.numpy()), rtol=1e-4)
    assert min(row["pose"]["eigenvalues"]) > 0
    assert f"{row['pose']['eigenvalues'][0]:.2g}" in text


def test_plain_ply(place, monkeypatch, capsys):
    """Without a record the cameras given are the known ones, unless --train names others."""
    report, _ = run("scene.ply --cameras cameras.json", place, monkeypatch, capsys)
    assert (len(report["known"]["names"]), len(report["views"])) == (5, 4)
    report, _ = run("scene.ply --train cameras.json --cameras orbit --count 3 --orbit up=z", place, monkeypatch, capsys)
    assert [row["name"] for row in report["views"]] == ["orbit_0000", "orbit_0001", "orbit_0002"]
    report, _ = run("run --cameras data --split test", place, monkeypatch, capsys)
    assert [row["name"] for row in report["views"]] == ["0", "4", "8"]


def test_views_that_see_nothing(place, monkeypatch, capsys):
    """Zero information: maps are gray, sums 0, nothing fails."""
    away = Camera(
        load(place / "data").views[0].camera.K, look_at((0, 0, 50), (0, 0, 60), (0, 1, 0)), SIZE, SIZE, name="away"
    )
    save_cameras_json(place / "away.json", [away])
    report, _ = run("run --cameras away.json --pose --blocks geometry", place, monkeypatch, capsys)
    (row,) = report["views"]
    assert row["gain"] == {"logdet": 0, "eig": 0}
    assert row["pose"]["eigenvalues"] == [0] * 6
    assert (cv2.imread(str(place / "out/away.variance.png"))[:, :SIZE] == 64).all()


# --------------------------------------------------------------------------- frames

TURN = look_at((0, 0, 0), (1, 2, 3))[:3, :3]  # any rotation
SHIFT, SCALE = np.array([5.0, -40.0, 8.0]), 0.2


def nerfstudio_splat(place, folder, applied):
    """Of `scene.ply` a splat as ns-export writes it, what says so beside it, and a file with applied_transform."""
    folder.mkdir()
    g = load_ply(place / "scene.ply")
    save_ply(_moved(g, TURN, SCALE * SHIFT, SCALE), folder / "splat.ply")
    orient = np.vstack([np.c_[TURN, SHIFT], [0, 0, 0, 1]])
    stated = {"transform": (orient @ applied)[:3].tolist(), "scale": SCALE}
    (folder / "dataparser_transforms.json").write_text(json.dumps(stated))
    poses = folder / "transforms.json"
    poses.write_text(json.dumps({"frames": [], "applied_transform": applied[:3].tolist()}))
    return g, folder / "splat.ply", poses


def test_a_scene_and_a_camera_that_are_moved_together_look_the_same(place):
    """By rotation, scale and shift, of Gaussians with all SH: the image stays."""
    rng = torch.Generator().manual_seed(1)
    g = load_ply(place / "scene.ply")
    g = g.replace(sh=torch.randn(len(g), 16, 3, generator=rng) * 0.3)
    camera = load_cameras_json(place / "cameras.json")[1]
    c2w = camera.c2w.copy()
    c2w[:3, :3] = TURN @ c2w[:3, :3]
    c2w[:3, 3] = TURN @ (SCALE * c2w[:3, 3]) + SHIFT
    other = dataclasses.replace(camera, w2c=np.linalg.inv(c2w))
    settings = RenderSettings.preset("exact", near=0.0)
    one, two = render(g, camera, settings), render(_moved(g, TURN, SHIFT, SCALE), other, settings)
    assert one.rgb.std() > 0.05
    torch.testing.assert_close(one.rgb, two.rgb, atol=2e-3, rtol=0)


def test_a_splat_of_nerfstudio_is_brought_to_the_cameras(place, tmp_path, capsys, caplog):
    """`dataparser_transforms.json` beside it is applied, over the `applied_transform` of the poses; without it fisher
    says that the views show nothing.
    """
    applied = np.array([[0.0, 1, 0, 0], [1, 0, 0, 2], [0, 0, -1, 0], [0, 0, 0, 1]])
    g, splat, poses = nerfstudio_splat(place, tmp_path / "export", applied)
    found = in_frame_of_data(load_ply(splat), splat, poses)
    for name, x in g.parameters().items():
        y = found.parameters()[name]
        if name == "quats":
            x, y = (torch.nn.functional.normalize(q, dim=1) for q in (x, y))
            y = y * (x * y).sum(1, keepdim=True).sign()
        torch.testing.assert_close(y, x, atol=1e-4, rtol=1e-4)
    line = ["fisher", str(splat), "--train", str(place / "data"), "--limit", "1", "--preset", "fast"]
    line += ["--blocks", "geometry", "-o"]
    stated = {"transform": np.c_[TURN, SHIFT].tolist(), "scale": SCALE}
    (splat.parent / "dataparser_transforms.json").write_text(json.dumps(stated))
    assert cli.main([*line, str(tmp_path / "one")]) == 0
    assert f"splat.ply: is in another frame, brought to that of {place / 'data'} by {splat.parent}" in caplog.text
    (splat.parent / "dataparser_transforms.json").unlink()
    assert cli.main([*line, str(tmp_path / "two")]) == 0
    assert "results below mean nothing; name the data set that it was fitted to (of nerfstudio" in caplog.text
    assert re.search(r"[5-9] of 9 known views show nothing of the scene: do the cameras belong to it", caplog.text)
    capsys.readouterr()
    reports = [json.loads((tmp_path / name / "fisher.json").read_text()) for name in ("one", "two")]
    assert reports[0]["groups"]["means"]["zero"] == 0 < reports[1]["groups"]["means"]["zero"]
    for stated in ({"scale": 1}, {"transform": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1}, {"scale": "x"}):
        (splat.parent / "dataparser_transforms.json").write_text(json.dumps(stated))
        assert cli.main([*line, str(tmp_path / "three")]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_large_views_are_said(place, monkeypatch, capsys):
    """Where views are large, how to have smaller ones; nothing where they are small, or their size was chosen."""
    line = "scene.ply --train cameras.json --limit 1 --preset fast"
    assert "--info-pixels" not in run(line, place, monkeypatch, capsys)[1]
    monkeypatch.setattr("drgs.commands.fisher._LARGE_VIEW", 100)
    assert "--info-pixels 48 takes half of the time or less" in run(line, place, monkeypatch, capsys)[1]
    assert "takes half" not in run(f"{line} --info-pixels 300", place, monkeypatch, capsys)[1]


def test_picture_is_logarithmic():
    """Each decade takes the same part of the bar, zero is gray, and the largest value is brightest."""
    values = np.array([[0.0, 1.0, 10.0, 100.0]] * 50)
    picture = map_picture(values).astype(int)
    assert picture.shape == (50, 80, 3)
    assert (picture[:, 0] == 64).all()
    brightness = picture[0, 1:4].sum(1)
    assert brightness[0] < brightness[1] < brightness[2]
    np.testing.assert_array_equal(picture[0, 3], picture[0, 4 + 4])  # the top of the bar
    assert map_picture(np.zeros((1, 3))).shape == (1, 79, 3)
    assert map_picture(np.full((2, 2), 5.0)).dtype == np.uint8


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("scene.ply", "--train or --cameras must name a data set, a run or a cameras.json"),
        ("scene.ply --cameras dome", "--train or --cameras must name a data set, a run or a cameras.json"),
        ("run --limit 0", "--limit must be in [1, 10000], got 0"),
        ("run --cameras cameras.json --split test", "--split test must have --cameras DATA"),
        ("run --prior nan", "lambda (value) must be in [0, inf), got nan"),
        ("nowhere.ply", "nowhere.ply: must be a file of Gaussians or a run, nothing is there"),
        ("early", "must hold state.safetensors or point_cloud.ply, found none"),
    ],
)
def test_bad_input_is_one_line(place, tmp_path, monkeypatch, capsys, line, message):
    """Exit code 2, one line, no folder."""
    monkeypatch.chdir(place)
    (place / "early").mkdir(exist_ok=True)
    (place / "early/config.json").write_text((place / "run/config.json").read_text())
    assert cli.main(["fisher", *line.split(), "-o", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "none").exists()
