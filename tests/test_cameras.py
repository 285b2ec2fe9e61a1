"""Cameras: conventions by projected points, lenses by re-projection and against OpenCV, files, bad
input.
"""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from drgs import runtime
from drgs.cameras import (
    Camera,
    c2w_from_llff,
    c2w_from_opengl,
    c2w_to_mitsuba,
    c2w_to_opengl,
    intrinsics,
    intrinsics_from_fov,
    look_at,
    orbit,
)
from drgs.data.camera_lists import load_cameras_json, save_cameras_json

pytestmark = pytest.mark.core

POSE = look_at((1.0, 2.0, 3.0), (0.2, -0.1, 0.3))
OPENCV = (-0.2, 0.05, 1e-3, -2e-3, 0.01)
FISHEYE = (-0.02, 0.005, 1e-3, -2e-4)
PRISM = (*OPENCV, 0.02, 0.01, -0.005, 0.02, -0.01, -0.015, 0.01)
FTHETA = (1.0, 0.01, -0.05, 0.02, -0.003, 1.02, 0.01, -0.02)
LENSES = [
    ("pinhole", ()),
    ("opencv", OPENCV),
    ("opencv", PRISM),
    ("opencv_fisheye", FISHEYE),
    ("ftheta", FTHETA),
    ("ftheta_inverse", FTHETA),
    ("equirectangular", ()),
]


def make(**changes) -> Camera:
    """A camera with an off-center principal point; fields may be changed."""
    fields = {"K": intrinsics(100, 105, 60.5, 40.25), "w2c": POSE, "width": 128, "height": 80}
    return Camera(**{**fields, **changes})


def test_projects_by_opencv_axes_with_centers_at_half():
    """x right, y down, z forward; behind the camera there is no pixel."""
    camera = make(w2c=np.eye(4))
    pixels, z = camera.project(np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [0, 0, -1]]))
    np.testing.assert_allclose(pixels[:3], [[60.5, 40.25], [110.5, 40.25], [60.5, 92.75]])
    assert np.isnan(pixels[3]).all()
    np.testing.assert_allclose(z, [2, 2, 2, -1])


def test_which_pixels_lie_in_the_image():
    """The image goes from 0 to its size, the end left out; NaN and what is behind the camera lie nowhere."""
    camera = make()
    pixels = np.array([[0.0, 0], [127.9, 79.9], [128, 40], [64, 80], [-0.1, 40], [np.nan, 40]])
    assert camera.contains(pixels).tolist() == [True, True, False, False, False, False]
    assert camera.contains(pixels, np.array([1.0, -1, 1, 1, 1, 1])).tolist() == [True] + 5 * [False]
    assert camera.contains(pixels, margin=1.0).tolist() == 6 * [False]
    assert camera.contains(pixels, margin=-1.0).tolist() == 5 * [True] + [False]


def test_opengl_frame_by_projected_point():
    """A point right of and above a camera that looks along -z."""
    # A Blender camera at the origin looks along -z with +y up.
    c2w = c2w_from_opengl(np.eye(4))
    camera = make(w2c=np.linalg.inv(c2w))
    pixels, z = camera.project(np.array([[0.5, 0.25, -2.0]]))
    np.testing.assert_allclose(pixels[0], [60.5 + 25.0, 40.25 - 105 * 0.125])
    assert z[0] == 2
    np.testing.assert_allclose(c2w_to_opengl(c2w), np.eye(4))


def test_llff_frame_by_projected_point():
    """A point right of and below a camera given as (down, right, backward)."""
    # Columns down, right, backward: a camera at (1, 2, 3) whose axes are the world's OpenCV axes.
    pose = np.array([[0.0, 1, 0, 1], [1, 0, 0, 2], [0, 0, -1, 3]])
    camera = make(w2c=np.linalg.inv(c2w_from_llff(pose)))
    pixels, z = camera.project(np.array([[1.5, 2.25, 5.0]]))
    np.testing.assert_allclose(pixels[0], [60.5 + 25.0, 40.25 + 105 * 0.125])
    assert z[0] == 2


def test_mitsuba_frame_looks_along_z_with_x_left():
    """Mitsuba keeps our forward axis and turns x around."""
    to_world = c2w_to_mitsuba(make().c2w)
    np.testing.assert_allclose(to_world[:3, 2], make().c2w[:3, 2])
    np.testing.assert_allclose(to_world[:3, 0], -make().c2w[:3, 0])
    np.testing.assert_allclose(np.linalg.det(to_world[:3, :3]), 1.0)


def test_mitsuba_sensor_traces_our_pixel_rays():
    """Mitsuba's own rays at pixel centers equal ours, principal point off center."""
    mi = runtime.mitsuba()
    camera = make(K=intrinsics(100, 100, 60.5, 31.25))
    sensor = mi.load_dict(camera.to_mitsuba(near=1e-3))
    directions = camera.pixel_directions()
    for column, row in [(0, 0), (127, 79), (60, 31), (5, 70)]:
        position = mi.Point2f((column + 0.5) / 128, (row + 0.5) / 80)
        ray, _ = sensor.sample_ray(0.0, 0.0, position, mi.Point2f(0.5, 0.5))
        direction = np.array(ray.d, dtype=np.float64).ravel()
        np.testing.assert_allclose(direction, directions[row, column], atol=1e-6)
        np.testing.assert_allclose(np.array(ray.o).ravel(), camera.center, atol=2e-3)


def test_mitsuba_sensor_refuses_what_it_cannot_do():
    """Lenses and oblong pixels are refused, each with its way out."""
    pytest.importorskip("mitsuba")
    with pytest.raises(ValueError, match="undistorted camera, got model opencv"):
        make(model="opencv", distortion=OPENCV).to_mitsuba()
    with pytest.raises(ValueError, match="square pixels, got fx 100, fy 105"):
        make().to_mitsuba()


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_pixel_directions_project_back_to_their_pixels(model, distortion):
    """Undistortion is converged: every pixel returns to itself."""
    camera = make(model=model, distortion=distortion)
    directions = camera.pixel_directions()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    pixels, _ = camera.project(camera.center + 3.0 * directions.reshape(-1, 3))
    columns, rows = np.meshgrid(np.arange(128) + 0.5, np.arange(80) + 0.5)
    expected = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    assert np.abs(pixels - expected).max() < 1e-6


@pytest.mark.parametrize(("model", "distortion"), [("opencv", OPENCV), ("opencv", PRISM), ("opencv_fisheye", FISHEYE)])
def test_lenses_agree_with_opencv(model, distortion, rng):
    """Our two lens models are OpenCV's."""
    cv2 = pytest.importorskip("cv2")
    camera = make(w2c=np.eye(4), model=model, distortion=distortion)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], axis=1)
    zero, coefficients = np.zeros(3), np.array(distortion)
    if model == "opencv":
        expected = cv2.projectPoints(points[:, None], zero, zero, camera.K, coefficients)[0]
    else:
        # OpenCV's fisheye functions insist on this exact layout.
        expected = cv2.fisheye.projectPoints(
            points[:, None], zero[:, None], zero[:, None], np.array(camera.K), coefficients
        )[0]
    np.testing.assert_allclose(camera.project(points)[0], expected.reshape(-1, 2), atol=1e-9)


def test_fisheye_sees_beyond_180_degrees():
    """Rays of an equidistant fisheye may point backward."""
    camera = make(K=intrinsics(25, 25, 64, 40), w2c=np.eye(4), model="opencv_fisheye", distortion=(0,) * 4)
    directions = camera.pixel_directions()
    assert directions[40, 0, 2] < 0
    np.testing.assert_allclose(np.arccos(directions[40, 127, 2]), np.hypot(63.5, 0.5) / 25)


def test_panoramas_see_everything():
    """Forward in the middle, backward at both sides, up in the first row and down in the last one."""
    K = intrinsics(128 / (2 * np.pi), 80 / np.pi, 64, 40)
    camera = make(K=K, w2c=np.eye(4), model="equirectangular")
    points = np.array([[0.0, 0, 2], [3, 0, 0], [-3, 0, 0], [0, 1, 0], [0, -1, 0], [1e-9, 0, -1], [-1e-9, 0, -1]])
    pixels, z = camera.project(points)
    expected = [[64, 40], [96, 40], [32, 40], [64, 80], [64, 0], [128, 40], [0, 40]]
    np.testing.assert_allclose(pixels, expected, atol=1e-6)
    np.testing.assert_allclose(z, points[:, 2])
    directions = camera.pixel_directions()
    half = np.pi / 128
    np.testing.assert_allclose(
        directions[40, 127, [0, 2]], np.array([np.sin(half), -np.cos(half)]) * np.cos(half * 0.8)
    )
    # A solid angle of 4 pi in all.
    latitude = (np.arange(80) + 0.5 - 40) * np.pi / 80
    np.testing.assert_allclose((np.cos(latitude) / (K[0, 0] * K[1, 1])).sum() * 128, 4 * np.pi, rtol=1e-3)
    assert not camera.undistorted().is_distorted


def test_ftheta_is_a_polynomial_of_the_angle():
    """As many pixels from the middle as it says, sheared by c, d and e, in front of the camera and behind."""
    camera = make(K=intrinsics(20, 20, 64, 40), w2c=np.eye(4), model="ftheta", distortion=FTHETA)
    k, (c, d, e) = FTHETA[:5], FTHETA[5:]
    for angle in (0.3, 1.2, 1.9):
        for turn in (0.0, 2.0):
            point = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
            r = 20 * sum(x * angle ** (i + 1) for i, x in enumerate(k))
            x, y = r * np.cos(turn), r * np.sin(turn)
            np.testing.assert_allclose(camera.project([point])[0], [[64 + c * x + d * y, 40 + e * x + y]])


def test_warns_where_a_lens_has_no_inverse():
    """A lens polynomial that folds is reported with the number of pixels."""
    with pytest.warns(UserWarning, match=r"lens cannot be inverted at \d+ of 10240 pixels"):
        make(model="opencv", distortion=(-2.0, 0.0, 0.0, 0.0)).pixel_directions()


def test_resized_scales_k_exactly_and_undistorted_drops_the_lens():
    """Pixels scale with the image, and a plain pinhole of the same K remains."""
    camera = make(model="opencv", distortion=OPENCV)
    small = camera.resized(64, 20)
    np.testing.assert_allclose(small.K, [[50, 0, 30.25], [0, 26.25, 10.0625], [0, 0, 1]])
    point = np.array([[0.1, 0.0, 0.4]])
    np.testing.assert_allclose(small.project(point)[0], camera.project(point)[0] * [0.5, 0.25])
    plain = camera.undistorted()
    assert (plain.model, plain.distortion, plain.is_distorted) == ("pinhole", (), False)
    assert (plain.width, plain.height) == (camera.width, camera.height)


@pytest.mark.parametrize("kind", ["bfloat16", "float16", "float8_e5m2"])
def test_tensors_of_types_that_numpy_has_not(kind):
    """A pose and intrinsics of any floating type of torch, as mixed precision leaves them."""
    torch = pytest.importorskip("torch")
    dtype = getattr(torch, kind)
    w2c = torch.eye(4).to(dtype)
    camera = Camera(K=torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]).to(dtype), w2c=w2c, width=16, height=16)
    np.testing.assert_array_equal(camera.c2w, np.eye(4))
    assert camera.K[0].tolist() == [16, 0, 8]


def test_keeps_a_torch_pose_with_its_gradient():
    """The very tensor is kept, through a resize too."""
    torch = pytest.importorskip("torch")
    pose = torch.tensor(POSE, requires_grad=True)
    camera = make(w2c=pose)
    assert camera.w2c is pose
    assert camera.resized(64, 40).w2c is pose
    np.testing.assert_allclose(camera.center, [1, 2, 3])


def test_field_of_view_and_look_at():
    """Focal length from an angle, up is up, right is right."""
    K = intrinsics_from_fov(90.0, 200, 100)
    np.testing.assert_allclose(K, [[100, 0, 100], [0, 100, 50], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(intrinsics_from_fov(90.0, 200, 100, axis="y")[0, 0], 50.0)
    camera = make(w2c=look_at((0, -5, 0), (0, 0, 0)))
    above, z = camera.project(np.array([[0.0, 0, 1]]))
    assert above[0, 1] < camera.K[1, 2]  # up is up
    right, _ = camera.project(np.array([[1.0, 0, 0]]))
    assert right[0, 0] > camera.K[0, 2]
    assert z[0] == 5
    with pytest.raises(ValueError, match="must not lie on one line"):
        look_at((0, 0, 5), (0, 0, 0))
    with pytest.raises(ValueError, match="fov must lie between"):
        intrinsics_from_fov(180, 10, 10)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 2, 3)])
def test_orbit_looks_at_its_center_from_its_radius(up):
    """Distance, elevation and target hold for any up direction."""
    cameras = orbit((1, 2, 3), 4.0, 7, elevation=30.0, up=up, width=64, height=48)
    assert len(cameras) == 7
    for camera in cameras:
        np.testing.assert_allclose(camera.project(np.array([[1.0, 2, 3]]))[0][0], [32, 24], atol=1e-9)
        offset = camera.center - (1, 2, 3)
        np.testing.assert_allclose(np.linalg.norm(offset), 4.0)
        np.testing.assert_allclose(offset @ up / np.linalg.norm(up), 2.0)


def test_cameras_json_round_trip_and_optional_center(tmp_path):
    """INRIA's layout, with and without cx, cy."""
    path = tmp_path / "cameras.json"
    save_cameras_json(path, [make(name="a"), make(w2c=np.eye(4), name="b")])
    back = load_cameras_json(path)
    assert [camera.name for camera in back] == ["a", "b"]
    np.testing.assert_allclose(back[0].w2c, POSE, atol=1e-12)
    np.testing.assert_allclose(back[0].K, make().K)
    entries = json.loads(path.read_text())
    np.testing.assert_allclose(entries[0]["rotation"], make().c2w[:3, :3])
    np.testing.assert_allclose(entries[0]["position"], [1, 2, 3])
    del entries[0]["cx"], entries[0]["cy"]
    path.write_text(json.dumps(entries))
    np.testing.assert_allclose(load_cameras_json(path)[0].K[:2, 2], [64, 40])


def test_cameras_json_bad_input(tmp_path):
    """Each broken file names the file and the camera."""
    path = tmp_path / "cameras.json"
    with pytest.raises(FileNotFoundError, match="must be a cameras.json file"):
        load_cameras_json(path)
    path.write_text("[{")
    with pytest.raises(ValueError, match="must be valid JSON"):
        load_cameras_json(path)
    path.write_text("{}")
    with pytest.raises(ValueError, match="must be a list of at least one camera"):
        load_cameras_json(path)
    save_cameras_json(path, [make(), make()])
    entries = json.loads(path.read_text())
    del entries[1]["fx"]
    path.write_text(json.dumps(entries))
    with pytest.raises(ValueError, match="camera 1: it must have the key 'fx'"):
        load_cameras_json(path)
    entries[1]["fx"], entries[1]["rotation"] = 100, [[float("nan")] * 3] * 3
    path.write_text(json.dumps(entries))
    with pytest.raises(ValueError, match=r"camera 1: rotation\[0\]\[0\] must be a finite number, got NaN"):
        load_cameras_json(path)
    with pytest.raises(ValueError, match="camera 0 .* is not one; use camera.undistorted"):
        save_cameras_json(path, [make(model="opencv", distortion=OPENCV)])


BAD_POSE = POSE.copy()
BAD_POSE[1, 2] = np.inf
FLIPPED = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": np.eye(4)}, r"K must have shape \(3, 3\), got \(4, 4\)"),
        ({"K": intrinsics(np.nan, 1, 1, 1)}, "K must be finite, got nan"),
        ({"K": intrinsics(-5, 1, 1, 1)}, "focal lengths must be positive, got -5 and 1"),
        ({"K": intrinsics(5, 1, 1, 1).T}, r"K must be \[\[fx, s, cx\]"),
        ({"w2c": np.eye(3)}, r"w2c must have shape \(4, 4\), got \(3, 3\)"),
        ({"w2c": BAD_POSE}, r"the pose must be finite, got inf at \[1, 2\]"),
        ({"w2c": POSE.T}, "the last row of w2c must be 0 0 0 1"),
        ({"w2c": np.diag([1.001, 1, 1, 1])}, "orthonormal to 1e-4"),
        ({"w2c": FLIPPED}, r"got a reflection.*negate the one that .* column 2 of camera-to-world.*negate one row"),
        ({"width": 0}, "width must be a whole number of pixels >= 1, got 0"),
        ({"height": 2.5}, "height must be a whole number of pixels >= 1, got 2.5"),
        ({"width": float("nan")}, "width must be a whole number of pixels >= 1, got nan"),
        (
            {"model": "fov"},
            "model must be one of pinhole, opencv, opencv_fisheye, ftheta, ftheta_inverse, equirectangular, got 'fov'",
        ),
        (
            {"model": "ftheta", "distortion": (1, 0, 0, 0, 0, 0.5, 1, 0.5)},
            r"must have an inverse, got \(0.5, 1.0, 0.5\)",
        ),
        (
            {"model": "opencv", "distortion": (1, 2)},
            "takes 4 or 5 or 8 or 12 distortion coefficients, got 2",
        ),
        ({"distortion": (0.1,)}, "pinhole takes 0 distortion coefficients, got 1"),
    ],
)
def test_refuses_bad_cameras_in_one_line(changes, message):
    """Every field has its own message, which names the camera."""
    with pytest.raises(ValueError, match=message) as error:
        make(name="c7", **changes)
    assert "\n" not in str(error.value)
    assert "'c7'" in str(error.value)


def test_what_is_so_already_is_the_same_camera():
    """A pinhole camera without its lens, or at its own size, is itself: nothing is checked anew."""
    pinhole = orbit((0, 0, 0), 3.0, 1, width=32, height=24)[0]
    assert pinhole.undistorted() is pinhole
    assert pinhole.resized(32, 24) is pinhole
    bent = dataclasses.replace(pinhole, model="opencv", distortion=(0.1, 0.0, 0.0, 0.0))
    assert bent.resized(32, 24) is bent
    plain = bent.undistorted()
    assert (plain.model, plain.distortion) == ("pinhole", ())
    assert pinhole.resized(64, 24).width == 64
