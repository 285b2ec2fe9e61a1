"""Claims of flights: through their keyframes, smooth, the same backwards, within a bound; files, good and bad."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from drgs.cameras import c2w_to_opengl, look_at
from drgs.data.camera_path import CameraPath, Keyframe, camera_path_json, quaternion_of, read_camera_path, rotation_of

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def key(position=(0, 0, 0), wxyz=IDENTITY, fov=50.0, seconds=0.0, time=None) -> Keyframe:
    wxyz = np.asarray(wxyz, np.float64)
    return Keyframe(np.asarray(position, np.float64), wxyz / np.linalg.norm(wxyz), fov, float(seconds), time)


def some(rng, count: int = 6, loop: bool = False) -> CameraPath:
    """Keyframes anywhere, at uneven steps."""
    seconds = np.cumsum(rng.uniform(0.3, 2.0, count))
    keys = [key(rng.normal(size=3), rng.normal(size=4), rng.uniform(20, 90), s) for s in seconds]
    return CameraPath(tuple(keys), loop=loop)


def arrays(keys) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, rotations and fields of view."""
    return (
        np.array([x.position for x in keys]),
        np.array([rotation_of(x.wxyz) for x in keys]),
        np.array([x.fov for x in keys]),
    )


def shares_of(flight: CameraPath) -> np.ndarray:
    """Where the keyframes are."""
    seconds = np.array([x.seconds for x in flight.keyframes]) - flight.keyframes[0].seconds
    return seconds / flight.seconds


@pytest.mark.parametrize("loop", [False, True])
def test_passes_through_keyframes(rng, loop):
    """At its seconds every keyframe is there, to rounding."""
    for _ in range(20):
        flight = some(rng, loop=loop)
        for made, given in zip(arrays(flight.at(shares_of(flight))), arrays(flight.keyframes), strict=True):
            np.testing.assert_allclose(made, given, atol=1e-9)


@pytest.mark.parametrize("loop", [False, True])
def test_rates_are_continuous(rng, loop):
    """Just before and just behind a keyframe the camera moves, turns and zooms at one rate; a loop's ends, too."""
    step = 1e-8
    for _ in range(20):
        flight = some(rng, loop=loop)
        at = shares_of(flight)[0 if loop else 1 : None if loop else -1]
        before = arrays(flight.at((at - step) % 1.0))
        here = arrays(flight.at(at))
        after = arrays(flight.at(at + step))
        for a, b, c in zip(before, here, after, strict=True):
            np.testing.assert_allclose((b - a) / step, (c - b) / step, rtol=1e-3, atol=2e-3 * flight.seconds)


def test_is_continuous(rng):
    """Nowhere a jump, whatever the turns: between two frames of many it turns by no more than its fastest rate."""
    shares = np.linspace(0, 1, 2001)
    for _ in range(50):
        flight = some(rng, 5)
        position, turn, _ = arrays(flight.at(shares))
        assert np.linalg.norm(np.diff(position, axis=0), axis=1).max() < 0.2
        assert np.linalg.norm(np.diff(turn, axis=0), axis=(1, 2)).max() < 0.2


def test_backwards_is_the_same_way(rng):
    """Keyframes in reverse order make the frames in reverse order."""
    shares = np.linspace(0, 1, 41)
    for _ in range(20):
        flight = some(rng)
        back = CameraPath(tuple(dataclasses.replace(x, seconds=-x.seconds) for x in reversed(flight.keyframes)))
        for a, b in zip(arrays(flight.at(shares)), arrays(back.at(1 - shares)), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)


def test_mirrored_keyframes_make_a_mirrored_flight(rng):
    """Symmetric: what is mirrored at x = 0 and in time lies mirrored."""
    right = [key((x, y, 0.0), seconds=s) for x, y, s in ((1, 0, 1.0), (2, 1, 2.5), (2.5, 3, 3.0))]
    left = [dataclasses.replace(x, position=x.position * [-1, 1, 1], seconds=-x.seconds) for x in reversed(right)]
    position, _, _ = arrays(CameraPath((*left, *right)).at(np.linspace(0, 1, 31)))
    np.testing.assert_allclose(position, position[::-1] * [-1, 1, 1], atol=1e-12)


def test_two_keyframes_are_a_straight_line_at_an_even_pace():
    """Also of the rotation, about one axis."""
    turned = np.array([np.cos(0.6), 0, np.sin(0.6), 0])
    flight = CameraPath((key((0, 0, 0)), key((3, 6, -9), turned, seconds=2)))
    made = flight.at(np.linspace(0, 1, 11))
    position, _, _ = arrays(made)
    np.testing.assert_allclose(position, np.linspace((0, 0, 0), (3, 6, -9), 11), atol=1e-12)
    angles = [2 * np.arctan2(x.wxyz[2], x.wxyz[0]) for x in made]
    np.testing.assert_allclose(angles, np.linspace(0, 1.2, 11), atol=1e-12)


def test_points_on_a_line_stay_on_it_without_turning_back():
    """Whatever the steps, it never goes past a keyframe."""
    flight = CameraPath(tuple(key((x, 0, 0), seconds=s) for x, s in ((0, 0), (1, 3), (10, 3.2), (10.1, 9))))
    position, _, _ = arrays(flight.at(np.linspace(0, 1, 501)))
    assert (np.diff(position[:, 0]) >= -1e-12).all()
    np.testing.assert_allclose(position[:, 1:], 0, atol=1e-12)


def test_stays_within_half_a_chord(rng):
    """The bound that the module states, and a field of view between those of its keyframes."""
    part = np.linspace(0, 1, 33)
    for _ in range(50):
        flight = some(rng)
        ends = shares_of(flight)
        for k, (a, b) in enumerate(zip(flight.keyframes, flight.keyframes[1:], strict=False)):
            position, _, fov = arrays(flight.at(ends[k] + part * (ends[k + 1] - ends[k])))
            straight = a.position + part[:, None] * (b.position - a.position)
            off = np.linalg.norm(position - straight, axis=1).max()
            assert off <= 0.5 * np.linalg.norm(b.position - a.position) + 1e-9
            assert min(a.fov, b.fov) - 1e-9 <= fov.min()
            assert fov.max() <= max(a.fov, b.fov) + 1e-9


def test_one_keyframe_stands_still():
    """One frame, or as many as it lasts."""
    flight = CameraPath((key((1, 2, 3), seconds=7),))
    assert flight.seconds == 0
    assert flight.frame_count(24) == 1
    still = dataclasses.replace(flight, duration=0.5)
    assert still.frame_count(24) == 13
    for x in still.at(still.shares(13)):
        np.testing.assert_array_equal(x.position, (1, 2, 3))
    assert dataclasses.replace(still, loop=True).frame_count(24) == 12


def test_equal_keyframes_are_a_rest():
    """Between two of them nothing moves."""
    turned = np.array([0.8, 0.6, 0, 0])
    flight = CameraPath(
        (
            key((0, 0, 0)),
            key((1, 0, 0), turned, seconds=1),
            key((1, 0, 0), -turned, seconds=2),
            key((5, 1, 0), seconds=3),
        )
    )
    made = flight.at(np.linspace(1 / 3, 2 / 3, 9))
    position, turns, _ = arrays(made)
    np.testing.assert_allclose(position, np.broadcast_to((1.0, 0, 0), position.shape), atol=1e-12)
    np.testing.assert_allclose(turns, np.broadcast_to(rotation_of(turned), turns.shape), atol=1e-12)


def test_half_turns_go_one_way_at_an_even_pace():
    """Two keyframes that look away from each other: half a turn about one axis, no point of it undefined."""
    flight = CameraPath((key(), key(wxyz=(0, 0, 1, 0), seconds=1)))
    turns = arrays(flight.at(np.linspace(0, 1, 19)))[1]
    steps = [np.degrees(np.arccos((np.trace(a.T @ b) - 1) / 2)) for a, b in zip(turns, turns[1:], strict=False)]
    np.testing.assert_allclose(steps, 10, atol=1e-6)
    around = CameraPath((key(), key(wxyz=(0, 0, 1, 0), seconds=1), key(wxyz=(1, 0, 0, 0), seconds=2)))
    assert np.isfinite(arrays(around.at(np.linspace(0, 1, 19)))[1]).all()


def test_signs_of_quaternions_mean_nothing(rng):
    """q and -q are one rotation: the flight is the same."""
    flight = some(rng)
    turned = [dataclasses.replace(x, wxyz=x.wxyz * sign) for x, sign in zip(flight.keyframes, (1, -1) * 3, strict=True)]
    shares = np.linspace(0, 1, 31)
    np.testing.assert_allclose(arrays(flight.at(shares))[1], arrays(CameraPath(tuple(turned)).at(shares))[1], atol=1e-9)


def test_durations_and_frames():
    """A flight of 2 s has 49 frames at 24 a second, both ends; stretched, it shows the same places."""
    keys = tuple(key((x, 0, 0), seconds=x, time=2.0 * x) for x in (0, 0.5, 2))
    flight = CameraPath(keys)
    assert flight.frame_count(24) == 49
    slow = dataclasses.replace(flight, duration=8.0)
    assert slow.frame_count(24) == 193
    shares = np.linspace(0, 1, 9)
    np.testing.assert_array_equal(arrays(flight.at(shares))[0], arrays(slow.at(shares))[0])
    np.testing.assert_allclose([x.time for x in flight.at(shares)], np.linspace(0, 4, 9))
    np.testing.assert_allclose([x.seconds for x in slow.at(shares)], np.linspace(0, 8, 9))
    loop = dataclasses.replace(flight, loop=True)
    assert loop.seconds == 3  # the way back takes as long as the steps do in the mean
    assert loop.frame_count(24) == 72
    assert loop.shares(72)[-1] == pytest.approx(71 / 72)


def test_cameras(rng):
    """Frames look as their keyframes: pose, and field of view of the height."""
    w2c = look_at((1, 2, 3), (0, 0, 0), (0, -1, 0))
    flight = CameraPath((key(-w2c[:3, :3].T @ w2c[:3, 3], quaternion_of(w2c[:3, :3].T), fov=60),))
    camera = flight.cameras(1, 200, 100)[0]
    np.testing.assert_allclose(camera.w2c, w2c, atol=1e-12)
    assert 2 * np.degrees(np.arctan(0.5 * 100 / camera.K[1, 1])) == pytest.approx(60)
    assert camera.K[0, 0] == camera.K[1, 1]
    assert camera.name == "flight_0000"


# ---------------------------------------------------------------------------------------------- files


GOOD = {"position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": 0}


def test_files_there_and_back(rng, tmp_path):
    """What is saved is read as it was."""
    flight = dataclasses.replace(some(rng, loop=True), duration=3.5, fps=30.0, width=320, height=200)
    flight = dataclasses.replace(
        flight, keyframes=tuple(dataclasses.replace(x, time=0.1 * k) for k, x in enumerate(flight.keyframes))
    )
    (tmp_path / "f.json").write_bytes(camera_path_json(flight))
    again = read_camera_path(tmp_path / "f.json")
    for name in ("duration", "loop", "fps", "width", "height"):
        assert getattr(again, name) == getattr(flight, name)
    for a, b in zip(flight.keyframes, again.keyframes, strict=True):
        np.testing.assert_allclose(b.position, a.position, atol=0)
        np.testing.assert_allclose(b.wxyz, a.wxyz, atol=1e-15)
        assert (b.fov, b.seconds, b.time) == (a.fov, a.seconds, a.time)


def test_poses_as_matrices(tmp_path):
    """w2c says the same as position and quaternion."""
    w2c = look_at((1, 2, 3), (0, 0.5, 0), (0, -1, 0))
    (tmp_path / "f.json").write_text(json.dumps({"keyframes": [{"w2c": w2c.tolist(), "fov": 40, "seconds": 0}]}))
    camera = read_camera_path(tmp_path / "f.json").cameras(1, 20, 10)[0]
    np.testing.assert_allclose(camera.w2c, w2c, atol=1e-12)


def test_camera_paths_of_nerfstudio(tmp_path, caplog):
    """OpenGL axes, 16 numbers, vertical fields of view: one keyframe a camera, one frame each; of panoramas, a line."""
    caplog.set_level("INFO", "drgs")
    poses = [np.linalg.inv(look_at((np.sin(a), 0.2, np.cos(a)), (0, 0, 0), (0, 1, 0))) for a in (0, 0.2, 0.4)]
    path = {
        "camera_type": "perspective",
        "render_height": 54,
        "render_width": 96,
        "fps": 30,
        "seconds": 0.1,
        "is_cycle": False,
        "keyframes": [{"matrix": "[1]"}],
        "camera_path": [
            {"camera_to_world": c2w_to_opengl(x).ravel().tolist(), "fov": 50, "aspect": 96 / 54} for x in poses
        ],
    }
    (tmp_path / "path.json").write_text(json.dumps(path))
    flight = read_camera_path(tmp_path / "path.json")
    assert (flight.fps, flight.width, flight.height) == (30.0, 96, 54)
    assert flight.frame_count(flight.fps) == 3
    cameras = flight.cameras(3, 96, 54)
    for camera, pose in zip(cameras, poses, strict=True):
        np.testing.assert_allclose(camera.c2w, pose, atol=1e-9)
    assert not caplog.messages
    (tmp_path / "path.json").write_text(json.dumps(path | {"camera_type": "equirectangular"}))
    assert read_camera_path(tmp_path / "path.json").frame_count(30.0) == 3
    assert "path.json: is of panoramas, add --panorama" in caplog.text
    path["camera_path"][1]["camera_to_world"] = path["camera_path"][1]["camera_to_world"][:12]
    (tmp_path / "path.json").write_text(json.dumps(path))
    with pytest.raises(ValueError, match=r"camera_path\[1\]: camera_to_world must hold 16 numbers, got 12") as error:
        read_camera_path(tmp_path / "path.json")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([], "must be an object, got a list of 0"),
        ({}, "must have the key 'keyframes'"),
        ({"keyframes": []}, "keyframes must hold 1 to 100000 keyframes, got 0"),
        ({"keyframes": [GOOD], "speed": 1}, "must hold known fields, got 'speed'"),
        ({"keyframes": [GOOD], "schema": 9}, "schema must be 1, got 9; was it written by a newer drgs?"),
        ({"keyframes": [GOOD], "loop": 1}, "loop must be true or false, got 1"),
        ({"keyframes": [GOOD], "duration": 0}, "duration must be in [0.001, 86400], got 0"),
        ({"keyframes": [GOOD], "fps": 1000}, "fps must be in [0.1, 240], got 1000"),
        ({"keyframes": [GOOD], "width": 1.5}, "width must be a whole number, got 1.5"),
        ({"keyframes": [GOOD | {"fv": 1}]}, "keyframes[0]: must hold known fields, got 'fv'; did you mean fov?"),
        ({"keyframes": [{"fov": 50, "seconds": 0}]}, "keyframes[0]: must have either position and wxyz, or w2c"),
        ({"keyframes": [GOOD | {"w2c": []}]}, "keyframes[0]: must have either position and wxyz, or w2c"),
        ({"keyframes": [GOOD | {"fov": 180}]}, "keyframes[0]: fov must be in [1, 170], got 180"),
        ({"keyframes": [GOOD | {"fov": True}]}, "keyframes[0]: fov must be a finite number, got true"),
        ({"keyframes": [GOOD | {"wxyz": [2, 0, 0, 0]}]}, "wxyz must be a quaternion of length 1, got length 2"),
        ({"keyframes": [GOOD | {"wxyz": [0, 0, 0, 0]}]}, "wxyz must be a quaternion of length 1, got length 0"),
        ({"keyframes": [GOOD | {"position": [0, 0]}]}, "position must hold 3 numbers and wxyz 4"),
        ({"keyframes": [GOOD | {"position": [0, 0, 1e300]}]}, "keyframes[0]"),
        ({"keyframes": [GOOD | {"time": None}]}, "time must be a finite number, got null"),
        ({"keyframes": [GOOD, GOOD]}, "keyframes[1]: seconds must rise from keyframe to keyframe"),
        ({"keyframes": [GOOD | {"time": 1}, GOOD | {"seconds": 1}]}, "keyframes[1]: must have time as others have"),
        ({"keyframes": [{"w2c": [[1, 0, 0, 0]] * 3, "fov": 50, "seconds": 0}]}, "w2c must be 4x4 by rows"),
        (
            {"keyframes": [{"w2c": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]], "fov": 5, "seconds": 0}]},
            "w2c must begin with a rotation, its rows are off by 3",
        ),
        (
            {"keyframes": [{"w2c": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "fov": 5, "seconds": 0}]},
            "got a reflection",
        ),
        (
            {"camera_path": [], "render_height": 2, "render_width": 2},
            "camera_path must hold 1 to 100000 cameras, got 0",
        ),
        (
            {"camera_path": [{}], "render_height": 2, "render_width": 2, "camera_type": "fisheye"},
            "camera_type must be perspective or equirectangular, got 'fisheye'",
        ),
    ],
)
def test_bad_files_are_refused_in_a_line(tmp_path, found, expected):
    """Where, what must hold, what was got, what to do."""
    path = tmp_path / "f.json"
    path.write_text(json.dumps(found))
    with pytest.raises(ValueError, match=r"f\.json") as error:
        read_camera_path(path)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_no_file(tmp_path):
    """A path that is none."""
    with pytest.raises(FileNotFoundError, match="must be a JSON file of a flight, found none"):
        read_camera_path(tmp_path / "none.json")
