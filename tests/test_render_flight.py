"""Claims of `drgs render --path`, `--duration` and `--panorama`: films of a flight, and pictures all round."""

from __future__ import annotations

import importlib.util
import json

import cv2
import numpy as np
import pytest
import torch

import drgs
from drgs import cli
from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.commands.films import level_panorama
from drgs.data.camera_lists import save_cameras_json
from drgs.display.mp4 import Mp4
from drgs.files import save_ply

needs_av = pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="no PyAV: pip install 'drgs[video]'")


@pytest.fixture
def scene(tmp_path):
    """Six balls around the origin, red, green and blue on +x, +y, +z, dark on the other sides."""
    means = torch.cat([4 * torch.eye(3), -4 * torch.eye(3)])
    colors = torch.cat([torch.eye(3), torch.full((3, 3), 0.2)])
    g = drgs.Gaussians.from_arrays(
        means, [[1.0, 0, 0, 0]] * 6, [[0.5] * 3] * 6, [0.95] * 6, (colors[:, None] - 0.5) / 0.28
    )
    save_ply(g, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.fixture
def flight(tmp_path):
    """From (0, 0, -8) to (1, 0, -8) in half a second, looking along +z."""
    keys = [{"position": [x, 0, -8], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": x / 2} for x in (0, 1)]
    path = tmp_path / "flight.json"
    path.write_text(json.dumps({"keyframes": keys, "fps": 20}))
    return path


def rendered(*words) -> int:
    return cli.main(["render", *(str(word) for word in words), "--preset", "fast", "--quiet"])


def film(path) -> tuple[list[np.ndarray], float]:
    """Frames as OpenCV decodes them, RGB, and frames a second."""
    video = cv2.VideoCapture(str(path))
    frames = []
    while True:
        is_there, frame = video.read()
        if not is_there:
            return frames, video.get(cv2.CAP_PROP_FPS)
        frames.append(frame[..., ::-1])


@pytest.mark.parametrize("end", [pytest.param("mp4", marks=needs_av), "webm"])
@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_a_film_shows_what_the_pictures_show(scene, flight, tmp_path, end, size):
    """As many frames as the flight lasts, at its rate; odd sides get one more pixel, as chroma is halved."""
    out = tmp_path / "out"
    words = ("--path", flight, "--width", size[0], "--height", size[1], "--format", f"png,{end}", "-o", out)
    assert rendered(scene, *words) == 0
    report = json.loads((out / "render.json").read_text())
    assert report["flight"] == {"path": str(flight), "keyframes": 2, "loop": False, "seconds": 0.5}
    assert (report["video"], report["videos"], report["fps"]) == (f"flight.{end}", [f"flight.{end}"], 20.0)
    frames, rate = film(out / f"flight.{end}")
    assert (len(frames), rate) == (11, 20.0)
    for k, frame in enumerate(frames):
        picture = cv2.imread(str(out / f"flight_{k:04d}.png"))[..., ::-1]
        assert frame.shape == (48, 64, 3)
        assert np.abs(frame[: size[1], : size[0]].astype(int) - picture).mean() < 4  # of an encoder with loss
    centers = [np.array(view["camera"]["c2w"])[:3, 3] for view in report["views"]]
    np.testing.assert_allclose(centers, [[x, 0, -8] for x in np.linspace(0, 1, 11)], atol=1e-6)


def test_how_many_frames(scene, flight, tmp_path, capsys):
    """--frames, or --duration and --fps, say it; both together are refused."""
    for k, (words, count) in enumerate(
        [("--frames 3", 3), ("--duration 1", 21), ("--duration 1 --fps 4", 5), ("--fps 4", 3), ("--limit 2", 2)]
    ):
        out = tmp_path / f"out{k}"
        assert rendered(scene, "--path", flight, "--width", 8, *words.split(), "-o", out) == 0
        assert len(list(out.glob("flight_*.png"))) == count, words
    orbit = tmp_path / "orbit"
    assert rendered(scene, "--duration", "0.5", "--fps", "8", "--width", 8, "-o", orbit) == 0
    assert len(list(orbit.glob("*.png"))) == 4


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--path {flight} --frames 3 --duration 2", "--duration must be alone, --frames and --fps say how long"),
        ("--path {flight} --duration 0", "--duration must be in [0.001, 86400], got 0"),
        ("--path {flight} --duration 86400 --fps 240", "there must be at most 100000 frames, got 20736001"),
        ("--path {flight} --orbit up=z", "--path must be alone, --orbit names other cameras"),
        ("--path {flight} --split test", "--path must be alone, --split is of the views of a data set"),
        ("--path nowhere.json", "nowhere.json"),
        ("--path {broken}", "keyframes must hold 1 to"),
        ("--panorama", "--panorama must have a place, a file of Gaussians has none; add --path or --cameras"),
        ("--panorama --path {flight} --width 30 --height 30", "--panorama must be twice as wide as high, got 30x30"),
        ("--panorama --path {flight} --preset gsplat", "--panorama must have settings that follow rays"),
        ("--panorama --path {flight} --preset 3dgut", "--panorama must have near 0, got 0.01, which leaves out all"),
        ("--panorama --path {flight} --preset 3dgut --set near=0", "--panorama must have culling by extent"),
    ],
)
def test_bad_input(scene, flight, tmp_path, capsys, words, expected):
    """One line, exit code 2, nothing written."""
    (tmp_path / "broken.json").write_text('{"keyframes": []}')
    before = sorted(tmp_path.iterdir())
    line = words.format(flight=flight, broken=tmp_path / "broken.json").split()
    preset = [] if "--preset" in line else ["--preset", "fast"]
    assert cli.main(["render", str(scene), *line, *preset, "-o", str(tmp_path / "out"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_without_pyav(scene, flight, tmp_path, capsys, monkeypatch):
    """The extra is named, before anything is drawn."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    assert rendered(scene, "--path", flight, "--format", "mp4", "-o", tmp_path / "out") == 2
    assert "mp4 must have the package av (PyAV), which is missing; pip install 'drgs[video]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@needs_av
def test_half_an_mp4_is_none(tmp_path):
    """A film appears when it is whole; of frames that differ in size it says so."""

    def two_sizes():
        with Mp4(tmp_path / "a.mp4") as movie:
            movie.write(np.zeros((8, 8, 3), np.uint8))
            movie.write(np.zeros((8, 16, 3), np.uint8))

    with pytest.raises(ValueError, match=r"all frames of a video must have one size, got \(8, 8\) and \(16, 8\)"):
        two_sizes()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("settings", ["--preset exact", "--preset fast"])
def test_a_panorama_shows_what_is_all_round(scene, tmp_path, settings):
    """Up is what it is to all cameras together, ahead is in the middle, right is right: the balls lie where their
    directions say."""
    looks = [(0, 0.3, 1), (1, 0.3, 0), (0, 0.3, -1), (-1, 0.3, 0)]  # all of them down
    cameras = [
        Camera(K=intrinsics_from_fov(60, 24, 16), w2c=look_at((0, 0, 0), x, (0, -1, 0)), width=24, height=16, name=name)
        for name, x in zip("abcd", looks, strict=True)
    ]
    save_cameras_json(tmp_path / "cameras.json", cameras)
    words = f"{scene} --cameras {tmp_path / 'cameras.json'} --limit 1 --panorama --width 80 --format png,jpg"
    assert cli.main(["render", *words.split(), *settings.split(), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    image = cv2.imread(str(tmp_path / "out" / "a.png"))[..., ::-1].astype(int)
    assert image.shape == (40, 80, 3)
    assert image[20, 40].argmax() == 2  # blue, +z, ahead: leveled, though the camera looks down
    assert image[20, [40, 60]].max(1).min() > 200
    assert image[20, 60].argmax() == 0  # red, +x, a quarter to the right
    assert (image[39].argmax(1) == 1).all()  # green, +y, below
    assert 20 < image[20, 20].max() < 100  # dark, -x, a quarter to the left
    assert 20 < image[20, 0].max() < 100  # dark, -z, behind
    data = (tmp_path / "out" / "a.jpg").read_bytes()
    assert b'GPano:ProjectionType="equirectangular"' in data[:1000]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (40, 80, 3)


def test_a_level_panorama_of_a_camera_that_looks_up():
    """What the upper edge of its image shows behind, or the lower one ahead, is in the middle."""
    up = np.array([0.0, -1.0, 0.0])
    for target in ((0, -1, 0), (0, 1, 0)):
        camera = Camera(
            K=intrinsics_from_fov(60, 8, 8),
            w2c=look_at((1, 2, 3), np.add((1, 2, 3), target), (0, 0, 1)),
            width=8,
            height=8,
        )
        level = level_panorama(camera, up, 40, 20)
        np.testing.assert_allclose(level.center, (1, 2, 3), atol=1e-12)
        np.testing.assert_allclose(level.c2w[:3, 1], -up, atol=1e-12)
        assert abs(np.linalg.det(level.c2w[:3, :3]) - 1) < 1e-12


@pytest.mark.parametrize("end", [pytest.param("mp4", marks=needs_av), "webm"])
def test_a_film_alone(scene, flight, tmp_path, end):
    """-o with the name of a film: that file and no other, written anew as often as asked, never over another's."""
    out = tmp_path / "out" / f"a flight.{end}"
    for seconds, count in ((0.2, 5), (0.1, 3)):
        assert rendered(scene, "--path", flight, "--duration", seconds, "--width", 16, "-o", out) == 0
        assert [path.name for path in out.parent.iterdir() if not path.name.startswith(".")] == [out.name]
        assert len(film(out)[0]) == count
    foreign = tmp_path / f"foreign.{end}"
    foreign.write_bytes(b"mine")
    assert rendered(scene, "--path", flight, "--width", 16, "-o", foreign) == 2
    assert foreign.read_bytes() == b"mine"


def test_a_picture_alone(scene, flight, tmp_path):
    """-o with the name of a picture: one view, in the format that the name says."""
    out = tmp_path / "out" / "all-round.jpg"
    assert rendered(scene, "--path", flight, "--limit", 1, "--panorama", "--width", 40, "-o", out) == 0
    assert [path.name for path in out.parent.iterdir() if not path.name.startswith(".")] == [out.name]
    assert cv2.imread(str(out)).shape == (20, 40, 3)
    folder = tmp_path / "pictures.png"
    folder.mkdir()
    assert rendered(scene, "--path", flight, "--limit", 2, "--width", 8, "-o", folder) == 0
    assert len(list(folder.glob("*.png"))) == 2


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("-o {dir}/a.webm --format png", "--format must be left out with -o {dir}/a.webm, got 'png'"),
        ("-o {dir}/a.webm --depth", "--depth must have a folder to write into, -o {dir}/a.webm is one file"),
        ("-o {dir}/a.WEBM", "{dir}/a.WEBM: must end in .webm in small letters"),
        ("-o {dir}/a.png", "{dir}/a.png: must be a folder for 11 views, a file holds one; name a folder"),
        ("-o {dir}/a+b.png --limit 1", "{dir}/a+b.png: must have a name of letters, digits, - _ and . alone"),
    ],
)
def test_a_lone_file_that_cannot_be(scene, flight, tmp_path, capsys, words, expected):
    """One line, exit code 2, nothing written."""
    before = sorted(tmp_path.iterdir())
    assert rendered(scene, "--path", flight, "--width", 8, *words.format(dir=tmp_path).split()) == 2
    error = capsys.readouterr().err
    assert expected.format(dir=tmp_path) in error
    assert error.count("\n") == 1
    assert [path for path in sorted(tmp_path.iterdir()) if not path.name.startswith(".")] == before
