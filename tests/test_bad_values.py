"""Values that are numbers and yet make no sense are refused or warned about: settings, colors, lenses, poses, seeds."""

from __future__ import annotations

import dataclasses
import logging
import math

import numpy as np
import pytest
from test_data import gradient, poses, save, write_image, write_transforms

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, orbit
from drgs.data import load
from drgs.data.images import stated_size
from drgs.data.view_checks import check_parallax
from drgs.data.views import View
from drgs.settings import RenderSettings
from drgs.train import FitConfig

pytestmark = pytest.mark.core


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("near", math.inf, r"a finite number in \[0, 1e\+30\], got inf"),
        ("near", -1.0, "a finite number"),
        ("near", 10**400, "a finite number"),
        ("extent", math.nan, "a finite number"),
        ("extent", "3", r"a finite number in \[0, 1000\], or None, got '3'"),
        ("extent", 0, "> 0"),
        ("alpha_max", True, "a finite number"),
        ("alpha_min", 1.5, "a finite number"),
        ("transmittance_min", None, "a finite number"),
        ("dilation", math.inf, "a finite number"),
        ("background", (0, 0, math.nan), "3 finite numbers"),
        ("background", (0, 0), "3 finite numbers"),
        ("background", 1.0, "3 finite numbers"),
        ("order", ["ray"], "one of center, ray, entry"),
        ("order", None, "one of center, ray, entry"),
    ],
)
def test_every_field_of_the_settings_is_checked(field, value, told):
    """Type, finiteness and range of each field, in one line that names it."""
    with pytest.raises(ValueError, match=f"RenderSettings: {field} must be {told}") as error:
        RenderSettings(**{field: value})
    assert "\n" not in str(error.value)


def test_scalars_of_arrays_are_numbers():
    """NumPy's and torch's scalars may stand for Python's, and become them: settings are written as JSON."""
    made = RenderSettings(extent=np.float32(3), near=np.float64(0.5), background=np.array([1, 0, 0.5]))
    assert (made.extent, made.near, made.background) == (3.0, 0.5, (1.0, 0.0, 0.5))
    assert all(type(x) in (str, float, int, tuple, type(None)) for x in vars(made).values())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("means_rate", (0.0, 1e-6)),
        ("means_rate", 1e-4),
        ("opacity_rate", math.nan),
        ("sh_degree", True),
        ("max_steps", 10.0),
        ("seed", 2**31),
        ("deterministic", 1),
        ("initial_opacity", 1.0),
        ("refine_every", -0.1),
        ("test_every", 1),
        ("test_offset", 8),
        ("settings", {"order": "ray"}),
    ],
)
def test_every_field_of_a_fit_is_checked(field, value):
    """What a hand-edited config.json may say is refused before anything is read."""
    with pytest.raises(ValueError, match=f"fit: {field} must be") as error:
        FitConfig().replace(**{field: value})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("fit DATA -o RUN --background 5 5 5", "--background must be R, G and B in [0, 1], got 5 5 5; 255 is 1.0 here"),
        ("render SCENE --set background=0,0,-1", "--set background must be R, G and B in [0, 1], got 0 0 -1"),
        ("render SCENE --set near=inf", "near must be a finite number in [0, 1e+30], got inf"),
        ("render SCENE --set extent=nan", "extent must be a finite number"),
        ("fit DATA -o RUN --seed 99999999999999999999", "seed must be a whole number in [0, 2147483647]"),
        ("select SCENE --candidates orbit --seed -1", "--seed must be in [0, 2147483647], got -1"),
    ],
)
def test_bad_options_are_one_line(capsys, line, told):
    """They are refused before any file is opened."""
    assert cli.main(line.split()) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def test_lens_that_does_not_belong_to_its_photo(tmp_path, caplog):
    """k1 = 1000 shows nothing of the undistorted image: refused. k1 = -1.5 folds back inside it: warned about."""
    data = write_transforms(tmp_path, camera_model="OPENCV", k1=1000.0)
    with pytest.raises(ValueError, match=r"its lens must show what .*, 9\d% of that lie outside .*; check the coeff"):
        load(tmp_path).views[0].image()
    data["k1"] = -1.5
    save(tmp_path, data)
    with caplog.at_level(logging.WARNING):
        assert np.isfinite(load(tmp_path).views[0].image()).all()
    assert "was not seen by the photo, the lens folds back inside it" in caplog.text
    caplog.clear()
    data["k1"] = -0.1  # an ordinary lens
    save(tmp_path, data)
    load(tmp_path).views[0].image()
    assert not caplog.text
    data["k1"] = 1e300
    save(tmp_path, data)
    with pytest.raises(ValueError, match=r"frame 0: .*distortion must be finite, no coefficient above 1e\+06"):
        load(tmp_path)


def test_poses_that_tell_no_depth(tmp_path, caplog):
    """One pose for all views is refused by `fit`; one place for all, and some poses twice, are warned about."""
    data = write_transforms(tmp_path, count=4)
    for shade, frame in enumerate(data["frames"]):
        frame["transform_matrix"] = c2w_to_opengl(np.linalg.inv(poses(1)[0])).tolist()
        write_image(tmp_path / frame["file_path"], gradient() // (1 + shade))  # four photographs, not one
    save(tmp_path, data)
    assert cli.main(["fit", str(tmp_path), "-o", str(tmp_path / "run"), "--quiet"]) == 2
    assert not (tmp_path / "run").exists()
    around = orbit((0, 0, 0), 3.0, 4, width=8, height=6)
    views = [View(camera, str(i)) for i, camera in enumerate(around)]
    check_parallax(views)
    assert not caplog.text
    check_parallax([*views, views[0]])
    assert "1 of the 5 training views have the pose of another one" in caplog.text
    turned = []
    for view in views:
        w2c = view.camera.w2c.copy()
        w2c[:3, 3] = 0
        turned.append(View(dataclasses.replace(view.camera, w2c=w2c), view.name))
    check_parallax(turned)
    assert "all 4 training views stand in one place" in caplog.text


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"width": 10**9, "height": 10**9}, "an image must have at most 2.31 pixels, got 1000000000x1000000000"),
        ({"width": 10**400}, "an image must have at most 2.31 pixels, got 10.12 or morex6"),
        ({"width": "8"}, "width must be a whole number of pixels >= 1, got '8'"),
        ({"width": None}, "width must be a whole number of pixels >= 1, got None"),
        (
            {"K": intrinsics(1e-300, 5, 1, 1)},
            "focal lengths must be 0.0001 to 1e.06 times the sides .*, got fx = 1e-300",
        ),
        ({"K": intrinsics(5, 5, 1e300, 1)}, r"the principal point must be within .*, got cx = 1e\+300"),
        ({"w2c": np.diag([1e200, 1e200, 1e200, 1])}, r"the pose must be within 1e\+15 of the origin"),
    ],
)
def test_cameras_beyond_reason(change, told):
    """Sizes, focal lengths and distances that no camera has end in one line, not in an overflow."""
    camera = Camera(K=intrinsics(5, 5, 4, 3), w2c=np.eye(4), width=8, height=6)
    with pytest.raises(ValueError, match=told):
        dataclasses.replace(camera, **change)


@pytest.mark.parametrize(("width", "height"), [(0, 10), (10, 0), (2**31, 2**31)])
def test_png_whose_header_states_no_size(tmp_path, width, height):
    """A PNG header of 0 x 10 or 2^31 x 2^31 pixels is refused as damaged, before anything is allocated."""
    path = tmp_path / "a.png"
    write_image(path, gradient())
    data = bytearray(path.read_bytes())
    data[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    path.write_bytes(data)
    for read in (drgs.data.images.image_size, drgs.data.images.read_image):
        with pytest.raises(ValueError, match=f"bytes can hold, its header says {width}x{height}"):
            read(path)
    write_transforms(tmp_path / "set", count=4, w=None, h=None)
    (tmp_path / "set" / "images" / "0.png").write_bytes(data)
    assert [view.image_path.name for view in load(tmp_path / "set").absent] == ["0.png"]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp"])
def test_sizes_of_headers(tmp_path, suffix):
    """The header of every format says what its decoder makes; one that says far more than the file can hold is refused
    before anything of that size is allocated.
    """
    path = tmp_path / f"a{suffix}"
    write_image(path, gradient()[:5, :7])
    height, width = drgs.data.images.read_image(path).shape[:2]
    assert stated_size(path) == (width, height) == (7, 5)
    if suffix == ".webp":  # 16,383 pixels a side at most, and no bound by bytes
        return
    data = bytearray(path.read_bytes())
    order = "big" if suffix in (".png", ".jpg") else "little"
    bytes_of = 2 if suffix in (".jpg", ".tiff") else 4
    size = [(7).to_bytes(bytes_of, order), (5).to_bytes(bytes_of, order)]
    for old in size:  # wherever the format has them
        data = data.replace(old, (30_000).to_bytes(bytes_of, order))
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"as many as its \d+ bytes can hold, its header says 30000x30000"):
        drgs.data.images.read_image(path)


def test_truncated_photograph(tmp_path, capfd, caplog):
    """The gray rest of a JPEG that was cut is not taken for the photo; the decoder itself prints nothing."""
    import cv2

    path = tmp_path / "a.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    cv2.imwrite(str(path), noise)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="its data end early; it is truncated or damaged"):
        drgs.data.images.read_image(path)
    path.write_bytes(data[:5] + bytes([data[5] - 6]) + data[6:])  # the first segment claims to end 6 bytes earlier
    assert drgs.data.images.read_image(path).shape == (64, 64, 3)
    assert "is damaged, part of it may be wrong (Corrupt JPEG data" in caplog.text
    assert not capfd.readouterr().err
