"""`drgs render`: files, cameras, orbits, and one line for everything that can be wrong."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import drgs
from drgs import cli
from drgs.cameras import Camera, intrinsics_from_fov, look_at, orbit
from drgs.commands import orbits
from drgs.commands.values import UP, OrbitShape
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.display import pictures
from drgs.files import save_ply

N = 60


@pytest.fixture
def gaussians(rng):
    """A small cloud around (1, 2, 3), opaque enough to be seen."""
    means = (rng.normal(size=(N, 3)) * 0.3 + (1, 2, 3)).astype(np.float32)
    quats, scales = rng.normal(size=(N, 4)), rng.uniform(0.05, 0.15, (N, 3))
    return drgs.Gaussians.from_arrays(means, quats, scales, rng.uniform(0.3, 0.9, N), rng.normal(size=(N, 4, 3)) * 0.4)


@pytest.fixture
def scene(gaussians, tmp_path):
    save_ply(gaussians, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.fixture
def camera():
    w2c = look_at((1, 2, 0), (1, 2, 3), (0, -1, 0))
    return Camera(K=intrinsics_from_fov(60, 24, 16), w2c=w2c, width=24, height=16, name="a/b c")


def test_what_is_made_once(scene, camera, tmp_path, made):
    """Of a file of Gaussians the settings are made once, and each camera as it is read; once more at another size."""
    save_cameras_json(tmp_path / "cameras.json", [camera, camera, camera])
    line = f"render {scene} --cameras {tmp_path / 'cameras.json'} --preset fast --quiet"
    made["Camera"] = 0
    assert cli.main([*line.split(), "-o", str(tmp_path / "out")]) == 0
    assert made == {"Camera": 3, "RenderSettings": 1}
    assert cli.main([*line.split(), "--width", "12", "-o", str(tmp_path / "small")]) == 0
    assert made == {"Camera": 9, "RenderSettings": 2}


def _read_exr(path) -> dict[str, np.ndarray]:
    import drjit as dr

    mi, threads = drgs.runtime.mitsuba(), dr.thread_count()
    try:
        # The decoder waits for the thread pool, with a pool of one for ever.
        dr.set_thread_count(max(2, threads))
        bitmap = mi.Bitmap(str(path))
    finally:
        dr.set_thread_count(threads)
    data = np.array(bitmap)
    return {field.name: data[..., i] for i, field in enumerate(bitmap.struct_())}


def _read_png(path) -> np.ndarray:
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


def test_files_hold_the_render(scene, gaussians, camera, tmp_path, capsys):
    """PNG is the clamped image without a transfer function; EXR holds color, alpha, depth as floats."""
    save_cameras_json(tmp_path / "cameras.json", [camera])
    out = tmp_path / "out"
    line = f"render {scene} --cameras {tmp_path / 'cameras.json'} -o {out} --format png,exr --depth"
    assert cli.main(line.split()) == 0
    truth = drgs.render(gaussians, camera)
    rgb, depth = truth.rgb.numpy(), truth.depth.numpy()
    png = _read_png(out / "a_b_c.png")
    assert np.abs(png / 255.0 - np.clip(rgb, 0, 1)).max() <= 0.5 / 255 + 1e-5
    exr = _read_exr(out / "a_b_c.exr")
    for name, value in {
        "R": rgb[..., 0],
        "G": rgb[..., 1],
        "B": rgb[..., 2],
        "A": truth.alpha.numpy(),
        "Z": depth,
    }.items():
        np.testing.assert_allclose(exr[name], value, atol=2e-5)
    assert _read_png(out / "a_b_c.depth.png").shape == (16, 24 + 76, 3)
    report = json.loads((out / "render.json").read_text())
    assert report["settings"]["order"] == "ray"
    assert report["rays"] == 24 * 16
    assert report["redone"] == truth.certificate["redone"]
    assert report["views"][0]["seconds"] > 0
    again = load_cameras_json(out / "cameras.json")
    np.testing.assert_allclose(again[0].w2c, camera.w2c, atol=1e-12)
    assert "exact order:" not in capsys.readouterr().out  # it has something to say of `bvh` alone
    assert [path.name for path in out.iterdir() if path.name.startswith(".")] == [".drgs.jsonl"]


def test_orbit_frames_the_scene(gaussians):
    """From every side all but outliers are inside the frame, and nearly fill it."""
    far = drgs.Gaussians.from_arrays([[500.0, 0, 0]], [[1.0, 0, 0, 0]], [[1.0] * 3], [0.9], np.zeros((1, 4, 3)))
    both = gaussians.replace(**{name: torch.cat([x, getattr(far, name)]) for name, x in gaussians.parameters().items()})
    for up in ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)):
        cameras = orbits.scene_orbit(both, 12, width=64, height=48, fixed=OrbitShape(up=up))
        reach = []
        for camera in cameras:
            pixels, z = camera.project(gaussians.means.numpy())
            assert (z > 0).all()
            reach.append(np.abs(pixels / (64, 48) - 0.5).max())
            assert np.dot(-camera.c2w[:3, 1], up) > 0.8  # the image's up
        assert 0.3 < max(reach) <= 0.5


def test_orbit_of_one_gaussian():
    """A single Gaussian has no spread: its own size decides."""
    one = drgs.Gaussians.from_arrays([[0.0, 0, 5]], [[1.0, 0, 0, 0]], [[0.2] * 3], [0.9], np.zeros((1, 1, 3)))
    (camera,) = orbits.scene_orbit(one, 1, width=32, height=32)
    out = drgs.render(one, camera)
    assert out.alpha.max() > 0.8
    assert out.alpha[0].max() < 0.3
    with pytest.raises(ValueError, match="at least one Gaussian"):
        orbits.scene_orbit(one.take(slice(0, 0)), 1, width=32, height=32)


def test_turntable(scene, tmp_path, capsys):
    """An orbit becomes a VP9 video of even size, and nothing else is asked for or written."""
    import cv2

    out = tmp_path / "out"
    line = f"render {scene} --frames 3 --width 33 --height 21 --format webm --preset fast -o {out} --orbit up=z"
    assert cli.main(line.split()) == 0
    assert sorted(path.name for path in out.glob("[!.]*")) == ["cameras.json", "render.json", "turntable.webm"]
    video = cv2.VideoCapture(str(out / "turntable.webm"))
    frames = []
    while (got := video.read())[0]:
        frames.append(got[1])
    assert len(frames) == 3
    assert frames[0].shape == (22, 34, 3)
    assert capsys.readouterr().err == ""


def test_video_sizes_must_agree(tmp_path):
    """A frame of another size is refused, and no file is left."""

    def write():
        with pictures.Video(tmp_path / "x.webm") as video:
            video.write(np.zeros((16, 16, 3)))
            video.write(np.zeros((16, 20, 3)))

    with pytest.raises(ValueError, match="one size"):
        write()
    assert not list(tmp_path.iterdir())


def test_data_set_split_limit_and_size(scene, tmp_path):
    """Views of a data set: the held-out ones, at most so many, at another size."""
    import cv2

    data = tmp_path / "data"
    (data / "images").mkdir(parents=True)
    frames = []
    for i, camera in enumerate(orbit((1, 2, 3), 3.0, 10, width=24, height=16, up=(0, -1, 0))):
        cv2.imwrite(str(data / f"images/{i:02d}.png"), np.zeros((16, 24, 3), np.uint8))
        pose = drgs.cameras.c2w_to_opengl(camera.c2w).tolist()
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": pose})
    lens = {"w": 24, "h": 16, "fl_x": 30.0, "fl_y": 30.0, "cx": 12.0, "cy": 8.0, "k1": 0.1}
    (data / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))
    command = ["render", str(scene), "--cameras", str(data), "--preset", "fast", "--width", "12"]
    assert cli.main([*command, "--split", "test", "-o", str(tmp_path / "test")]) == 0
    assert sorted(path.name for path in (tmp_path / "test").glob("*.png")) == ["00.png", "08.png"]
    assert cli.main([*command, "--limit", "3", "-o", str(tmp_path / "few")]) == 0
    made = load_cameras_json(tmp_path / "few" / "cameras.json")
    assert [(c.width, c.height) for c in made] == [(12, 8)] * 3


def test_lens(scene, gaussians, tmp_path, capsys):
    """Tiles draw a camera with a lens without it and say so; bvh follows its true rays."""
    transforms = {"camera_model": "OPENCV_FISHEYE", "w": 20, "h": 20, "fl_x": 9.0, "fl_y": 9.0, "cx": 10.0, "cy": 10.0}
    c2w = look_at((1, 2, 0), (1, 2, 3), (0, -1, 0))
    camera = Camera(
        K=intrinsics_from_fov(96, 20, 20),
        w2c=c2w,
        width=20,
        height=20,
        model="opencv_fisheye",
        distortion=(0.05, 0, 0, 0),
    )
    import cv2

    data = tmp_path / "data"
    data.mkdir()
    cv2.imwrite(str(data / "x.png"), np.zeros((20, 20, 3), np.uint8))
    pose = drgs.cameras.c2w_to_opengl(camera.c2w).tolist()
    transforms |= {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "k1": 0.05, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    transforms["frames"] = [{"file_path": "x.png", "transform_matrix": pose}]
    (data / "transforms.json").write_text(json.dumps(transforms))
    command = ["render", str(scene), "--cameras", str(data), "--preset", "fast", "--format", "exr"]
    assert cli.main([*command, "-o", str(tmp_path / "tiles")]) == 0
    assert "1 cameras have a lens" in capsys.readouterr().out
    assert cli.main([*command, "--set", "traversal=bvh", "-o", str(tmp_path / "bvh")]) == 0
    assert "no cameras.json" in capsys.readouterr().out
    assert not (tmp_path / "bvh" / "cameras.json").exists()
    settings = drgs.RenderSettings.preset("fast", traversal="bvh")
    truth = drgs.render(gaussians, camera, settings).rgb.numpy()
    flat = drgs.render(gaussians, camera.undistorted(), drgs.RenderSettings.preset("fast")).rgb.numpy()
    assert np.abs(_read_exr(tmp_path / "bvh" / "x.exr")["G"] - truth[..., 1]).max() < 1e-5
    assert np.abs(_read_exr(tmp_path / "tiles" / "x.exr")["G"] - flat[..., 1]).max() < 1e-5
    assert np.abs(truth - flat).max() > 0.05  # the two are not the same picture


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nowhere.ply", "nowhere.ply: must be a file of Gaussians or a run, nothing is there"),
        ("{dir}", "must be a run folder, found no config.json"),
        ("{scene} --set sigma=3", "--set: must be a render setting, got 'sigma=3'"),
        ("{scene} --format gif", "--format must be a list of png, jpg, exr, webm, mp4, ply, got 'gif'"),
        ("{scene} --format ,", "--format must be a list of png, jpg, exr, webm, mp4"),
        ("{scene} --cameras nowhere", "nowhere: must be a data set, found no such file or folder"),
        ("{scene} --cameras cameras.json", "cameras.json: must be a cameras.json file, found none"),
        ("{scene} --cameras {nan}", "camera 0: position[0] must be a finite number, got NaN"),
        ("{scene} --cameras {text}", "broken.json: must be valid JSON"),
        ("{scene} --split test", "an orbit has no split"),
        ("{scene} --cameras {good} --split test", "a list of cameras has no split"),
        ("{scene} --width 0", "--width must be in [1, 16384], got 0"),
        ("{scene} --frames 0", "--frames must be in [1, 100000], got 0"),
        ("{scene} --limit 0", "--limit must be in"),
        ("{scene} --orbit fov=180", "--orbit fov must be in [1, 170] degrees, got 180"),
        ("{scene} --orbit elevation=90", "--orbit elevation must be in [-89, 89] degrees, got 90"),
        ("{scene} --orbit distance=0", "--orbit distance must be positive and finite, got 0"),
        ("{scene} --orbit span=400", "--orbit span must be in [0, 360] degrees, got 400"),
        ("{scene} --fps 0", "--fps must be in [0.001, 240], got 0"),
        ("{scene} -o {scene}", "the output must be a folder that can be written"),
        ("{scene} -o {scene}/inside", "the output must be a folder that can be written"),
        ("{broken}", "means must be finite"),
    ],
)
def test_bad_input(scene, gaussians, camera, tmp_path, capsys, line, expected):
    """Exit code 2, one line on stderr, nothing written."""
    save_cameras_json(tmp_path / "good.json", [camera])
    entry = json.loads((tmp_path / "good.json").read_text())[0] | {"img_name": "x", "position": [float("nan"), 0, 0]}
    (tmp_path / "nan.json").write_text(json.dumps([entry]))
    (tmp_path / "broken.json").write_text("[{")
    bad = bytearray(scene.read_bytes())
    at = bad.index(b"end_header\n") + len(b"end_header\n")
    bad[at : at + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "bad.ply").write_bytes(bytes(bad))
    before = sorted(tmp_path.rglob("*"))
    names = {"scene": scene, "dir": tmp_path, "nan": tmp_path / "nan.json", "text": tmp_path / "broken.json"}
    names |= {"good": tmp_path / "good.json", "broken": tmp_path / "bad.ply"}
    arguments = line.format(**names).split()
    if "-o" not in arguments:
        arguments += ["-o", str(tmp_path / "out")]
    assert cli.main(["render", *arguments]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["view.png", "render.json", "turntable.webm", "cameras.json"])
def test_files_of_others_stay(scene, camera, tmp_path, capsys, monkeypatch, name):
    """Whatever -o is: what is there and was not rendered here is refused before the first frame."""
    monkeypatch.setattr("drgs.commands.render.render_views", lambda *_, **__: pytest.fail("rendered"))
    save_cameras_json(tmp_path / "other.json", [dataclasses.replace(camera, name="view")])
    (tmp_path / name).write_text("[1, 2]")
    cameras = "orbit" if name.endswith("webm") else tmp_path / "other.json"
    line = f"render {scene} --cameras {cameras} -o {tmp_path} --format png,webm"
    assert cli.main(line.split()) == 2
    assert f"{name}: must not be replaced" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "[1, 2]"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["other.json", "scene.ply", name])


def test_input_is_no_output(scene, camera, tmp_path, capsys, monkeypatch):
    """`cd OUT; drgs render --cameras cameras.json -o .`, where OUT was rendered into before; elsewhere it works."""
    save_cameras_json(tmp_path / "other.json", [camera])
    fast = f"render {scene} --preset fast --width 16"
    assert cli.main(f"{fast} --cameras {tmp_path / 'other.json'} -o {tmp_path / 'out'}".split()) == 0
    assert cli.main(f"{fast} --cameras {tmp_path / 'other.json'} -o {tmp_path / 'out'}".split()) == 0  # and again
    before = (tmp_path / "out" / "cameras.json").read_bytes()
    monkeypatch.chdir(tmp_path / "out")
    capsys.readouterr()
    assert cli.main(f"{fast} --cameras cameras.json -o .".split()) == 2
    assert "cameras.json: must not be read and replaced, it is an input" in capsys.readouterr().err
    assert Path("cameras.json").read_bytes() == before
    assert cli.main(f"{fast} --cameras cameras.json -o again".split()) == 0


def test_names_that_repeat_or_escape(gaussians, camera, tmp_path):
    """Names become file names inside the folder, each its own."""
    from drgs.commands.render import render_views

    cameras = [dataclasses.replace(camera, name=name) for name in ("../x", "../x", "", "..")]
    report = render_views(gaussians, cameras, drgs.RenderSettings.preset("fast"), tmp_path / "out")
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert len(files) == 4
    assert sorted(name for view in report["views"] for name in view["files"]) == files
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_depth_picture():
    """Near is brighter than far, unknown is gray, and nothing known is no error."""
    depth = np.tile(np.linspace(1, 2, 64), (64, 1))
    alpha = np.ones((64, 64))
    alpha[:8] = 0
    picture = pictures.depth_picture(depth, alpha)
    assert (picture[:8, :64] == 64).all()
    assert picture[30, 2].astype(int).sum() > picture[30, 60].astype(int).sum() + 200
    pictures.depth_picture(depth, np.zeros((64, 64)))
    pictures.depth_picture(np.full((2, 2), np.nan), np.ones((2, 2)))


def test_command_line(scene, tmp_path):
    """The command as a stranger types it prints where the pictures are."""
    command = [
        sys.executable,
        "-m",
        "drgs",
        "render",
        str(scene),
        "--frames",
        "1",
        "--width",
        "16",
        "-o",
        str(tmp_path / "o"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 views of 60 Gaussians" in done.stdout
    assert (tmp_path / "o" / "orbit_0000.png").is_file()


@pytest.mark.real_data
def test_wolf(data_dir, tmp_path):
    """A trained scene from elsewhere stands upright, fills the frame and is opaque where it is."""
    path = data_dir / "splats" / "wolf" / "wolf.ply"
    if not path.is_file():
        pytest.skip(f"no {path}")
    g = drgs.load_ply(path)
    for camera in orbits.scene_orbit(g, 3, width=96, height=72, fixed=OrbitShape(up=UP["y"])):
        alpha = drgs.render(g, camera, drgs.RenderSettings.preset("fast")).alpha.numpy()
        rows, columns = np.nonzero(alpha > 0.5)
        assert rows.min() > 3
        assert rows.max() < 71
        assert columns.max() - columns.min() > 24 or rows.max() - rows.min() > 36
        legs, back = (alpha[a:b] > 0.5 for a, b in ((rows.max() - 9, rows.max()), (rows.min(), rows.max() - 9)))
        assert legs.sum() < back.sum()
        assert (alpha[(rows.min() + rows.max()) // 2] > 0.95).any()


def test_exr_with_one_thread(scene, tmp_path):
    """Mitsuba's encoder waits for a second thread: it gets one."""
    command = [sys.executable, "-m", "drgs", "render", str(scene), "--frames", "1", "--width", "16", "--threads", "1"]
    command += ["--format", "exr", "-o", str(tmp_path / "o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "o").glob("*.exr"))) == 1
