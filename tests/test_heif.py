"""HEIC and AVIF, as phones make them: read like other photographs, upright, from structure from motion to a fit."""

from __future__ import annotations

import json
import shutil
import struct
import sys

import cv2
import numpy as np
import pytest
from PIL import Image
from test_sfm import corner  # noqa: F401 (a fixture)

from drgs.cli import main
from drgs.data import load
from drgs.data.images import MissingReader, heif_as_jpeg, image_size, list_images, read_image
from drgs.sfm.reconstruction import SfmOptions, run_sfm

pillow_heif = pytest.importorskip("pillow_heif")

MAKE, MODEL, ORIENTATION, EXIF, FOCAL, FOCAL_35 = 0x10F, 0x110, 0x112, 0x8769, 0x920A, 0xA405
SUFFIXES = ("heic", "avif")


def exif(orientation: int = 1, focal_35: int = 28) -> bytes:
    """What a phone notes."""
    data = Image.Exif()
    data[MAKE], data[MODEL], data[ORIENTATION] = "Maker", "Phone", orientation
    data.get_ifd(EXIF)[FOCAL] = 4.2
    data.get_ifd(EXIF)[FOCAL_35] = focal_35
    return data.tobytes()


def save(path, pixels, **options):
    """A photograph, nearly without loss, by the name's format."""
    pillow_heif.register_heif_opener()
    lossless = {"quality": -1, "chroma": 444} if path.suffix == ".heic" else {"quality": 100, "subsampling": "4:4:4"}
    Image.fromarray(pixels).save(path, **lossless, **options)


@pytest.fixture
def gradient():
    """(40, 64, 3): right is red, down is green."""
    y, x = np.mgrid[:40, :64]
    return np.stack([4 * x, 6 * y, np.full_like(x, 30)], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(("orientation", "turned"), [(1, 0), (6, 3), (3, 2), (8, 1)])
def test_pixels_are_those_that_are_shown(tmp_path, gradient, suffix, orientation, turned):
    """The container's rotation is applied, to the size as well."""
    path = tmp_path / f"IMG_1.{suffix.upper()}"
    save(tmp_path / f"a.{suffix}", gradient, exif=exif(orientation))
    (tmp_path / f"a.{suffix}").rename(path)
    expected = np.rot90(gradient, turned)
    assert list_images(tmp_path) == [path]
    assert image_size(path) == expected.shape[1::-1]
    image = read_image(path)
    assert image.dtype == np.uint8
    assert image.shape == expected.shape
    assert np.abs(image.astype(int) - expected).max() <= 3


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_other_modes(tmp_path, gradient, suffix):
    """Gray, alpha, and 10 bits, of which the highest 8 are read."""
    alpha = np.dstack([gradient, np.full(gradient.shape[:2], 128, np.uint8)])
    save(tmp_path / f"alpha.{suffix}", alpha)
    found = read_image(tmp_path / f"alpha.{suffix}")
    assert found.shape == alpha.shape
    assert np.abs(found.astype(int) - alpha).max() <= 3
    gray = np.ascontiguousarray(gradient[..., 0])
    save(tmp_path / f"gray.{suffix}", gray)
    found = read_image(tmp_path / f"gray.{suffix}")
    assert np.abs((found if found.ndim == 2 else found[..., 0]).astype(int) - gray).max() <= 3
    if suffix == "heic":
        deep = pillow_heif.from_bytes("RGB;16", gradient.shape[1::-1], (gradient.astype(np.uint16) * 257).tobytes())
        deep.save(tmp_path / "deep.heic", quality=-1, chroma=444)
        found = read_image(tmp_path / "deep.heic")
        assert found.dtype == np.uint8
        assert np.abs(found.astype(int) - gradient).max() <= 3


def test_a_phone_names_it_jpg(tmp_path, gradient):
    """Known by its content."""
    save(tmp_path / "a.heic", gradient)
    path = (tmp_path / "a.heic").rename(tmp_path / "IMG_2.JPG")
    assert read_image(path).shape == gradient.shape


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("cut", [0.3, 0.9])
def test_damage_is_one_line(tmp_path, gradient, suffix, cut):
    """A file that ends early, or in which bytes are others."""
    path = tmp_path / f"a.{suffix}"
    save(path, np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8))
    path.write_bytes(path.read_bytes()[: int(cut * path.stat().st_size)])
    with pytest.raises(ValueError, match=rf"a\.{suffix}: must be .*(HEIC or AVIF|decoded)") as error:
        read_image(path)
    assert "\n" not in str(error.value)


def test_damaged_exif_refuses_no_photograph(tmp_path, gradient):
    """It is not needed for the pixels."""
    path = tmp_path / "a.heic"
    save(path, gradient, exif=exif(6))
    data = path.read_bytes()
    assert data.count(b"MM\0*") == 1 or data.count(b"II*\0") == 1
    path.write_bytes(data.replace(b"MM\0*", b"zzzz").replace(b"II*\0", b"zzzz"))
    assert image_size(path) == (40, 64)
    assert np.abs(read_image(path).astype(int) - np.rot90(gradient, 3)).max() <= 3


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("side", [30_000, 2**31 - 1])
def test_a_claimed_size_is_not_allocated(tmp_path, gradient, suffix, side, monkeypatch):
    """What the header says is compared with what there is before anything is decoded."""
    path = tmp_path / f"a.{suffix}"
    save(path, gradient)
    data = path.read_bytes()
    at = data.index(b"ispe") + 8
    path.write_bytes(data[:at] + struct.pack(">II", side, side) + data[at + 8 :])
    with pytest.raises(ValueError, match=rf"a\.{suffix}: ") as error:
        read_image(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("command", ["sfm", "capture"])
def test_named_when_missing(tmp_path, gradient, monkeypatch, capsys, command):
    """One line with the extra, also where there are JPEGs beside; nothing is ignored, and no folder is made."""
    photos = tmp_path / "photos"
    photos.mkdir()
    save(photos / "IMG_9.HEIC".lower(), gradient)
    for name in ("a.jpg", "b.jpg"):
        assert cv2.imwrite(str(photos / name), gradient)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    assert main([command, str(photos), "-o", str(tmp_path / "scene")]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "img_9.heic: HEIC and AVIF photographs need the package pillow-heif, which is missing" in told[0]
    assert "pip install 'drgs[heic]'" in told[0]
    assert not (tmp_path / "scene").exists()


def test_a_data_set_is_not_damaged_where_the_reader_is_missing(tmp_path, gradient, monkeypatch):
    """One HEIC among JPEGs is not left out: the extra is named, as there is nothing wrong with the photograph."""
    frames = []
    for index in range(4):
        pose = np.eye(4)
        pose[:3, 3] = index, 0, 4
        name = f"{index}.{'heic' if index == 1 else 'jpg'}"
        assert cv2.imwrite(str(tmp_path / f"{index}.jpg"), gradient)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    save(tmp_path / "1.heic", gradient)
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(MissingReader, match=r"1\.heic: HEIC and AVIF .* pip install 'drgs\[heic\]'"):
        load(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "masked"), [("heic", False), ("avif", True), ("webp", False)])
def test_structure_from_motion(corner, tmp_path, suffix, masked):  # noqa: F811
    """Poses from photographs of a phone, two of them JPEGs, with the focal length that EXIF states; then a fit's data.

    A JPEG of the same pixels has the same camera at first. Masks have the photographs' names, whatever these are.
    """
    photos = tmp_path / "photos"
    photos.mkdir()
    stages = set()
    for index, path in enumerate(list_images(corner[0])):
        target = photos / f"{path.stem}.{suffix if index > 1 else 'jpg'}"
        pixels = cv2.imread(str(path))[..., ::-1]
        if target.suffix == ".webp":
            assert cv2.imwrite(str(target), pixels[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])
        elif target.suffix == ".jpg":
            Image.fromarray(pixels).save(target, quality=98, exif=exif(focal_35=42))
        else:
            save(target, np.ascontiguousarray(pixels), exif=exif(focal_35=42))
    before = {path: path.read_bytes() for path in photos.iterdir()}
    if masked:
        (tmp_path / "white").mkdir()
        for path in before:
            assert cv2.imwrite(str(tmp_path / f"white/{path.name}.png"), np.full((240, 320), 255, np.uint8))
    masks = tmp_path / "white" if masked else None
    summary = run_sfm(photos, tmp_path / "out", SfmOptions(masks=masks), progress=lambda stage, *_: stages.add(stage))
    assert (summary.registered, summary.missing) == (7, ())
    assert "decoding" in stages
    assert {path: path.read_bytes() for path in photos.iterdir()} == before
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".drgs.jsonl", "database.db", "images", *(["masks"] if masked else []), "sparse"
    ]  # fmt: skip
    dataset = load(tmp_path / "out")
    assert sorted(view.image_path.suffix for view in dataset.views) == sorted([".jpg"] * 2 + [f".{suffix}"] * 5)
    assert dataset.views[6].image().shape == (240, 320, 3)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_without_exif(tmp_path, gradient, suffix):
    """What messengers leave of a photograph is one, too."""
    save(tmp_path / f"a.{suffix}", gradient)
    (tmp_path / "b.jpg").write_bytes(heif_as_jpeg(tmp_path / f"a.{suffix}", 98))
    assert np.abs(read_image(tmp_path / "b.jpg").astype(float) - gradient).max() < 8  # 2 and 4 here, of JPEG
    assert not Image.open(tmp_path / "b.jpg").getexif()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_focal_length_of_exif(tmp_path, suffix, rng):
    """COLMAP begins with the same focal length as of a JPEG, turned or not."""
    pycolmap = pytest.importorskip("pycolmap")
    pixels = rng.integers(0, 255, (64, 96, 3)).astype(np.uint8)
    for orientation in (1, 6):
        save(tmp_path / f"a.{suffix}", pixels, exif=exif(orientation))
        (tmp_path / f"b.{suffix}").write_bytes(heif_as_jpeg(tmp_path / f"a.{suffix}", 95))
        Image.fromarray(pixels).save(tmp_path / "c.jpg", exif=exif(orientation))
        found, expected = (pycolmap.infer_camera_from_image(tmp_path / name) for name in (f"b.{suffix}", "c.jpg"))
        assert found.has_prior_focal_length
        assert found.params[0] == pytest.approx(expected.params[0])
        assert (found.width, found.height) == ((96, 64) if orientation == 1 else (64, 96))
        assert Image.open(tmp_path / f"b.{suffix}").getexif().get(ORIENTATION, 1) == 1


@pytest.mark.parametrize("named", ["images/IMG_{}.heic", "images/IMG_{}"])
def test_a_data_set_that_names_them(tmp_path, gradient, named):
    """A `transforms.json` whose images are HEIC, also where it leaves the suffix out."""
    (tmp_path / "images").mkdir()
    frames = []
    for index in range(3):
        save(tmp_path / f"images/IMG_{index}.heic", gradient)
        pose = np.eye(4)
        pose[:3, 3] = index, 0, 4
        frames.append({"file_path": named.format(index), "transform_matrix": pose.tolist()})
    stated = {"camera_angle_x": 0.8, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(stated))
    views = load(tmp_path).views
    assert [view.name for view in views] == ["IMG_0", "IMG_1", "IMG_2"]
    assert views[0].image().shape == (40, 64, 3)
    assert np.abs(views[0].image() * 255 - gradient).max() <= 3
    shutil.move(tmp_path / "images/IMG_0.heic", tmp_path / "images/IMG_0.HEIC")
    if not named.endswith("heic"):
        assert load(tmp_path).views[0].image_path.suffix == ".HEIC"
