"""Commands on a run that was fitted through lenses: pictures, maps, scores and selection look through them, too."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from test_train import FAST, SIZE, scene

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, orbit
from drgs.data import View
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.display.pictures import write_png
from drgs.files import Run
from drgs.pages.report import pictures
from drgs.pages.report.account import account_of
from drgs.pages.report.write import _Cameras

LENS = (-0.3, 0.08, 0.002, -0.003, 0.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, nine photographs through a lens, and `run`, fitted to them as they were taken."""
    folder = tmp_path_factory.mktemp("lens")
    data = folder / "data"
    data.mkdir()
    g, frames = scene(), []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=SIZE, height=SIZE, fov=60.0)):
        bent = dataclasses.replace(camera, model="opencv", distortion=LENS)
        write_png(data / f"{i}.png", drgs.render(g, bent, FAST).rgb.numpy())
        frames.append({"file_path": f"{i}.png", "transform_matrix": c2w_to_opengl(camera.c2w).tolist()})
    K = camera.K
    told = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIZE, "h": SIZE}
    told |= dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
    (data / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **told, "frames": frames}))
    options = "--undistort off --for fast --preset fast --max-steps 60 --skybox off --quiet --no-report"
    assert cli.main(["fit", str(data), "-o", str(folder / "run"), *options.split()]) == 0
    return folder


def bent_views(place):
    """The views of the data set by name."""
    return {view.name: view for view in drgs.data.load(place / "data").views}


@pytest.mark.slow
def test_pictures_of_a_run(place, tmp_path, capsys):
    """Its views are drawn as they were taken, unless undistorted ones are asked for; presets of a plane are refused."""
    command = ["render", str(place / "run"), "--cameras", str(place / "run"), "--format", "png,exr", "--limit", "2"]
    assert cli.main([*command, "--preset", "fast", "-o", str(tmp_path / "off")]) == 0
    report = json.loads((tmp_path / "off/render.json").read_text())
    assert [view["camera"]["distortion"] for view in report["views"]] == [list(LENS)] * 2
    g = drgs.load_ply(place / "run/point_cloud.ply")
    name = report["views"][0]["camera"]["name"]
    camera = bent_views(place)[name].camera
    drawn = cv2.imread(str(tmp_path / "off" / f"{name}.png"))[..., ::-1]
    for seen, is_that in ((camera, True), (camera.undistorted(), False)):
        truth = (drgs.render(g, seen, FAST).rgb.detach().clamp(0, 1) * 255).round().numpy()
        assert (np.abs(drawn - truth).max() <= 1) == is_that
    capsys.readouterr()
    assert cli.main([*command, "--preset", "fast", "--undistort", "on", "-o", str(tmp_path / "on")]) == 0
    assert "2 cameras have a lens: drawn without it; --undistort off draws through it" in capsys.readouterr().out
    assert len(load_cameras_json(tmp_path / "on/cameras.json")) == 2
    assert cli.main([*command, "--preset", "gsplat", "-o", str(tmp_path / "planar")]) == 2
    assert "render: through a lens settings must follow rays, response 'ewa'" in capsys.readouterr().err
    assert cli.main([*command, "--preset", "gsplat", "--undistort", "on", "-o", str(tmp_path / "planar")]) == 0


def test_a_list_of_cameras_with_lenses(place, tmp_path):
    """Of a file of Gaussians, lenses are looked through where that is asked for; what is written can be read again."""
    ply = str(place / "run/point_cloud.ply")
    command = [
        "render",
        ply,
        "--cameras",
        str(place / "data"),
        "--limit",
        "1",
        "--preset",
        "3dgut",
        "--undistort",
        "off",
    ]
    assert cli.main([*command, "-o", str(tmp_path / "a")]) == 0
    again = ["render", ply, "--cameras", str(tmp_path / "a/render.json"), "--preset", "3dgut"]
    assert cli.main([*again, "--undistort", "off", "-o", str(tmp_path / "b")]) == 0
    assert cli.main([*again, "-o", str(tmp_path / "c")]) == 0
    a, b, c = (cv2.imread(str(tmp_path / folder / "0.png")) for folder in "abc")
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.every(3)
@pytest.mark.parametrize("candidates", ["data", "orbit", "dome"])
def test_selection(place, monkeypatch, capsys, candidates):
    """Candidates and known views have the lens, those that are made, too; asked for, none has."""
    monkeypatch.chdir(place)
    line = f"select run --candidates {candidates} --count 3 -k 1 --preset fast --quiet"
    scores = []
    for undistort in ("", " --undistort on"):
        assert cli.main((line + undistort).split()) == 0
        report = json.loads((place / "out/select.json").read_text())
        lenses = {tuple(row["camera"]["distortion"]) for row in report["candidates"]}
        assert lenses == ({()} if undistort else {LENS})
        scores.append(report["picks"][0]["score"])
    assert scores[0] != scores[1]
    assert cli.main([*line.split(), "--preset", "inria"]) == 2
    assert "select: through a lens settings must follow rays" in capsys.readouterr().err


def test_information_through_the_lens(place, tmp_path):
    """`drgs fisher` says of a run's views what the library says of their cameras."""
    line = f"fisher {place / 'run'} --preset fast --limit 1 --quiet --info-pixels 1000 -o {tmp_path / 'out'}"
    assert cli.main(line.split()) == 0
    report = json.loads((tmp_path / "out/fisher.json").read_text())
    assert report["views"][0]["camera"]["distortion"] == list(LENS)


def test_maps_of_a_report(place, monkeypatch):
    """They are of the photographs as they were taken, as the pictures beside them."""
    account = account_of(Run(place / "run"))
    cast = _Cameras.of(account, drgs.data.load(account.record.data))
    cameras = [*cast.fitted, *cast.held.values()]
    assert len(cameras) >= 9
    assert {camera.distortion for camera in cameras} == {LENS}
    looked = []
    draw = pictures.opacity_of

    def looking(g, camera, *rest, **more):
        looked.append(camera)
        return draw(g, camera, *rest, **more)

    monkeypatch.setattr(pictures, "opacity_of", looking)
    assert cli.main(["report", str(place / "run"), "--quiet"]) == 0
    assert looked
    assert all(camera.distortion == LENS for camera in looked)


def test_eval_looks_through_the_lens(place):
    """Numbers are of photographs as they were taken: PSNR is that of a picture through the lens, at any size."""
    assert cli.main(["eval", str(place / "run"), "--quiet"]) == 0
    rows = json.loads((place / "run/metrics.json").read_text())["views"]
    g = drgs.load_ply(place / "run/point_cloud.ply")
    for row in rows:
        view = dataclasses.replace(bent_views(place)[row["name"]], keeps_lens=True)
        error = (
            (drgs.render(g, view.camera, FAST).rgb.detach().clamp(0, 1) - torch.tensor(view.image())).square().mean()
        )
        assert row["psnr"] == pytest.approx(-10 * np.log10(float(error)), abs=0.02)


def test_what_belongs_to_a_photograph_lines_up(tmp_path):
    """Masks, labels, depths and a teacher's maps are those of the files, pixel by pixel; undistorted all move alike."""
    size = (60, 40)
    rng = np.random.default_rng(3)
    blocks = np.kron(rng.integers(1, 5, (8, 12)), np.ones((5, 5))).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "image.png"), np.repeat(blocks[..., None] * 50, 3, 2))
    cv2.imwrite(str(tmp_path / "mask.png"), (blocks > 2).astype(np.uint8) * 255)
    cv2.imwrite(str(tmp_path / "labels.png"), blocks)
    np.save(tmp_path / "depth.npy", blocks.astype(np.float32))
    torch.save(torch.from_numpy(blocks).float()[None], tmp_path / "map.pt")
    K = drgs.cameras.intrinsics_from_fov(70, *size)
    camera = Camera(K, np.eye(4), *size, "opencv", (-0.25, 0.05, 0.0, 0.0))
    paths = {"image_path": "image.png", "mask_path": "mask.png", "label_path": "labels.png"}
    paths |= {"depth_path": "depth.npy", "teacher_path": "map.pt"}
    view = View(camera, "x", **{name: tmp_path / file for name, file in paths.items()})
    taken = dataclasses.replace(view, keeps_lens=True)
    assert taken.shown_camera is camera
    assert np.array_equal((taken.image()[..., 0] * 255).round(), blocks * 50)
    assert np.array_equal(taken.mask(), blocks > 2)
    assert np.array_equal(taken.labels(), blocks)
    assert np.array_equal(taken.depth(), blocks)
    assert np.array_equal(taken.teacher()[0].numpy(), blocks)
    for of in (view, taken):
        # Away from the edges of blocks, what is resampled agrees with what is not.
        image = of.image()[..., 0] * 255 / 50
        sure = (np.abs(image - image.round()) < 0.02) & (of.labels() > 0)
        sure &= cv2.erode(sure.astype(np.uint8), np.ones((3, 3))).astype(bool)
        assert sure.mean() > 0.15
        assert (of.labels()[sure] == image.round()[sure]).mean() > 0.98
        assert (of.mask()[sure] == (image.round() > 2)[sure]).mean() > 0.98
    assert not np.array_equal(view.labels(), taken.labels())


def test_cameras_json_has_no_lens(place, tmp_path):
    """A list without lenses is drawn as ever, whatever is said of lenses."""
    cameras = orbit((0, 0, 0), 3.0, 1, width=12, height=12)
    save_cameras_json(tmp_path / "cameras.json", cameras)
    for undistort in ("on", "off"):
        command = ["render", str(place / "run"), "--cameras", str(tmp_path / "cameras.json"), "--preset", "gsplat"]
        assert cli.main([*command, "--undistort", undistort, "-o", str(tmp_path / undistort)]) == 0
