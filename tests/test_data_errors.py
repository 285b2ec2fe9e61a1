"""Bad data sets: every one is refused in one line that says where, what and what to do."""

from __future__ import annotations

import json
import logging
import re
import struct

import numpy as np
import pytest
from test_data import (
    HEIGHT,
    WIDTH,
    gradient,
    poses,
    save,
    write_colmap,
    write_image,
    write_llff,
    write_transforms,
)

from drgs.data import load

pytestmark = pytest.mark.core


def one_line(error) -> None:
    """An error must be one line."""
    assert "\n" not in str(error.value)


def test_says_where_it_looked(tmp_path):
    """Nothing there, photos without poses, a wrong file."""
    with pytest.raises(FileNotFoundError, match="nowhere: must be a data set"):
        load(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"looked for transforms.json.*sparse/0.*npy") as error:
        load(tmp_path)
    one_line(error)
    write_image(tmp_path / "images" / "a.png", gradient())
    with pytest.raises(FileNotFoundError, match="found 1 photos without; run `drgs sfm"):
        load(tmp_path)
    (tmp_path / "x.txt").write_text("")
    with pytest.raises(ValueError, match="must be a folder, a transforms .json or an LLFF .npy"):
        load(tmp_path / "x.txt")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_colmap_lying_counts_allocate_nothing(tmp_path, name):
    """A claimed 10^12 records is refused by the size of the file."""
    path = write_colmap(tmp_path) / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", 10**12) + path.read_bytes()[8:])
    with pytest.raises(ValueError, match=f"{name}.bin: must hold the 1000000000000") as error:
        load(tmp_path)
    one_line(error)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_colmap_truncated_binaries(tmp_path, name):
    """Cut anywhere, a file is refused."""
    path = write_colmap(tmp_path) / f"{name}.bin"
    whole = path.read_bytes()
    for length in sorted({4, len(whole) // 2, len(whole) - 1}):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=f"{name}.bin: must hold .* truncated") as error:
            load(tmp_path)
        one_line(error)


def test_colmap_lying_lengths_inside_records(tmp_path):
    """Track and observation counts are checked as well."""
    target = write_colmap(tmp_path)
    points = target / "points3D.bin"
    data = bytearray(points.read_bytes())
    data[8 + 43 : 8 + 51] = struct.pack("<Q", 10**12)
    points.write_bytes(data)
    with pytest.raises(ValueError, match="the 1000000000000 track elements of points3D record 0"):
        load(tmp_path)
    images = target / "images.bin"
    data = images.read_bytes()
    end = data.index(b"im0.png\0") + 8
    images.write_bytes(data[:end] + struct.pack("<Q", 10**12) + data[end + 8 :])
    with pytest.raises(ValueError, match="the 1000000000000 observations of images record 0"):
        load(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "frames"])
def test_colmap_truncated_text(tmp_path, name):
    """A last word missing is refused."""
    path = write_colmap(tmp_path, text=True) / f"{name}.txt"
    text = path.read_text().rstrip()
    path.write_text(text[: text.rindex(" ")])
    with pytest.raises(ValueError, match="must (hold|be)") as error:
        load(tmp_path)
    one_line(error)


@pytest.mark.parametrize("text", [False, True])
def test_colmap_refuses_other_lenses_by_name(tmp_path, text):
    """FOV is not among our models."""
    write_colmap(tmp_path, text, model="FOV", params=[20, 20, 12, 8, 0.5])
    with pytest.raises(ValueError, match="must be one of SIMPLE_PINHOLE.*, got FOV") as error:
        load(tmp_path)
    one_line(error)


def test_colmap_bad_poses_and_missing_files(tmp_path):
    """NaN poses and absent images are named by index and name."""
    target = write_colmap(tmp_path)
    frames = target / "frames.bin"
    whole = frames.read_bytes()
    size = (len(whole) - 8) // 4  # of a frame: two numbers, quaternion, translation, its image
    at = 8 + size + 8 + 4 * 8
    data = bytearray(whole)
    data[at : at + 8] = struct.pack("<d", np.nan)
    frames.write_bytes(data)
    with pytest.raises(ValueError, match=r"image 1 \(im1.png\): the pose must be finite") as error:
        load(tmp_path)
    one_line(error)
    frames.write_bytes(whole)
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    (tmp_path / "images").rmdir()
    with pytest.raises(FileNotFoundError, match="must lie in a folder named images"):
        load(tmp_path)
    (target / "points3D.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"must hold points3D.bin, found none"):
        load(tmp_path)


def test_colmap_image_of_another_shape(tmp_path):
    """An image that cannot belong to its camera is refused."""
    write_colmap(tmp_path)
    write_image(tmp_path / "images" / "im3.png", gradient(30, 10))
    with pytest.raises(ValueError, match=r"image 3 .*\(24x16\), got 30x10"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fl_x": None, "fl_y": None}, "frame 0: must have fl_x or camera_angle_x"),
        ({"fl_x": "wide"}, 'frame 0: fl_x must be a finite number, got "wide"'),
        ({"fl_x": float("nan")}, "frame 0: fl_x must be a finite number, got NaN"),
        ({"fl_x": -3}, "focal lengths must be positive"),
        (
            {"camera_model": "FOV"},
            "camera_model must be one of .*got 'FOV'",
        ),
        ({"k4": 0.1}, "OPENCV takes k1, k2, k3, p1, p2, got k4 = 0.1"),
        ({"w": 100}, r"must have the shape of its camera \(100x16\), got 24x16"),
        ({"ply_file_path": "gone.ply"}, "must be a PLY point cloud, found none"),
    ],
)
def test_transforms_bad_fields(tmp_path, change, message):
    """Every field of the file has its message."""
    write_transforms(tmp_path, **change)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        load(tmp_path)
    one_line(error)


def test_transforms_bad_frames(tmp_path):
    """The first bad frame is named."""
    good = write_transforms(tmp_path)

    def attempt(message, kind=ValueError, **frame):
        data = json.loads(json.dumps(good))
        data["frames"][1].update(frame)
        save(tmp_path, data)
        with pytest.raises(kind, match=message) as error:
            load(tmp_path)
        one_line(error)

    pose = np.array(good["frames"][1]["transform_matrix"])
    bad = pose.copy()
    bad[0, 3] = np.inf
    attempt("frame 1: transform_matrix must be finite", transform_matrix=bad.tolist())
    attempt("frame 1: .*orthonormal to 1e-4", transform_matrix=(pose * [[2], [2], [2], [1]]).tolist())
    # Without its position, a transposed pose is a rotation, too: the inverse one.
    attempt("frame 1: transform_matrix must be .* by rows .* is it transposed", transform_matrix=pose.T.tolist())
    attempt("frame 1: transform_matrix must be 4x4", transform_matrix=[[1, 2], [3]])
    attempt("frame 1: mask_path names", FileNotFoundError, mask_path="gone.png")
    attempt("frame 1: file_path must be a text", file_path=7)
    for text, message in [
        ("{", "must be valid JSON"),
        ("[]", "list `frames`"),
        ('{"frames": []}', "list `frames`"),
    ]:
        (tmp_path / "transforms.json").write_text(text)
        with pytest.raises(ValueError, match=message) as error:
            load(tmp_path)
        one_line(error)


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_absent_images_are_named_and_left_out(tmp_path, caplog, write, lazy):
    """Of 10 images 2 are gone: said with their names, split of the others as before; with `strict`, or with fewer than
    3 left, refused. (An every-8th rule over what is left would move views from one split to the other.)
    """
    write(tmp_path, count=10)
    whole = load(tmp_path, test_every=3, lazy=lazy)
    names = [view.name for view in whole.views]
    images = [view.image_path for view in whole.views]
    for k in (1, 3):
        images[k].unlink()
    with caplog.at_level(logging.INFO):
        left = load(tmp_path, test_every=3, lazy=lazy)
    told = f"2 of the 10 images that it lists are not there ({images[1]}, {images[3]}); going on with the other 8"
    assert told in caplog.text
    assert [view.name for view in left.views] == [name for k, name in enumerate(names) if k not in (1, 3)]
    assert sorted(view.name for view in left.absent) == [names[1], names[3]]
    for one, other in zip(left.split(), whole.split(), strict=True):
        assert [view.name for view in one] == [view.name for view in other if view.image_path.is_file()]
    assert left.views[0].image(4, 4).shape == (4, 4, 3)
    with pytest.raises(FileNotFoundError, match=r"2 of the 10 .*; all must be there: restore them, or drop") as error:
        load(tmp_path, strict=True)
    one_line(error)
    for path in images[4:]:
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"8 of the 10 .*, \.\.\.\); at least 3 must be there") as error:
        load(tmp_path)
    one_line(error)


@pytest.mark.parametrize("write", [write_transforms, write_colmap])
def test_damaged_images_are_named_and_left_out(tmp_path, caplog, write):
    """As absent ones are, and as `drgs sfm` and `drgs capture` do: cut off, empty, or no image."""
    write(tmp_path, count=10)
    images = [view.image_path for view in load(tmp_path, test_every=3).views]
    data = images[1].read_bytes()
    for k, damaged in ((1, data[: len(data) // 2]), (3, b""), (5, b"no image")):
        images[k].write_bytes(damaged)
    left = load(tmp_path, test_every=3)
    told = f"3 of the 10 images that it lists are damaged ({images[1]}, {images[3]}, {images[5]}); going on with"
    assert told in caplog.text
    assert [view.image_path for view in left.views] == [path for k, path in enumerate(images) if k not in (1, 3, 5)]
    images[7].unlink()
    with pytest.raises(FileNotFoundError, match="4 of the 10 images that it lists are not there or damaged .*; all"):
        load(tmp_path, strict=True)


def test_transforms_rounded_poses_are_repaired(tmp_path):
    """Three digits are enough for a rotation."""
    data = write_transforms(tmp_path)
    for frame in data["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    save(tmp_path, data)
    np.testing.assert_allclose(load(tmp_path).views[2].camera.w2c, poses(3)[2], atol=5e-3)


def test_transforms_mixed_sizes_need_their_own_intrinsics(tmp_path):
    """Shared intrinsics cannot hold for two sizes."""
    data = write_transforms(tmp_path)
    write_image(tmp_path / "images" / "2.png", gradient(WIDTH // 2, HEIGHT // 2))
    with pytest.raises(ValueError, match="one size unless every frame.*12x8 at frame 2") as error:
        load(tmp_path)
    one_line(error)
    assert data["frames"]


def test_points_ply_that_lies(tmp_path):
    """Claimed counts, NaN and other files are refused."""
    write_transforms(tmp_path, ply_file_path="points.ply")
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "points.ply").write_bytes(header.encode() + bytes(24))
    with pytest.raises(ValueError, match=r"claims 1000000000000 vertex \(12000000000000 bytes\).*holds 24") as error:
        load(tmp_path)
    one_line(error)
    nan = header.replace("1000000000000", "2").encode() + struct.pack("<6f", 0, 0, 0, np.nan, 0, 0)
    (tmp_path / "points.ply").write_bytes(nan)
    with pytest.raises(ValueError, match="points must be finite, got NaN or Inf at index 1"):
        load(tmp_path)
    (tmp_path / "points.ply").write_bytes(b"solid")
    with pytest.raises(ValueError, match="must be a PLY file, got b'solid'"):
        load(tmp_path)


def test_llff_bad_input(tmp_path):
    """Lying headers, pickles, other shapes, NaN rows."""
    rows = write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"

    def attempt(message):
        with pytest.raises(ValueError, match=message) as error:
            load(tmp_path)
        one_line(error)

    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"(3, 17)", b"(3000000000, 17)").replace(b"         ", b"", 1))
    attempt(r"the header claims shape \(3000000000, 17\)")
    path.write_bytes(whole[:-8])
    attempt("it is truncated or damaged")
    path.write_bytes(b"\x93NUMPY")
    attempt("must be a .npy file")
    np.save(path, rows[:2])
    attempt("got 2 rows and 3 images")
    np.save(path, rows[:, :16])
    attempt(r"must have shape \(N, 17\), got \(3, 16\)")
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    attempt("must hold plain numbers, got dtype object")
    bad = rows.copy()
    bad[1, 3] = np.nan
    np.save(path, bad)
    attempt("got NaN or Inf in row 1")


def test_view_files_that_do_not_fit(tmp_path):
    """Masks, depths and images of other sizes are refused when read."""
    write_transforms(tmp_path, extra={"mask_path": "m.png", "depth_file_path": "d.png"})
    write_image(tmp_path / "m.png", np.zeros((10, 30), np.uint8))
    write_image(tmp_path / "d.png", gradient())
    view = load(tmp_path).views[0]
    with pytest.raises(ValueError, match=r"must have the shape of its image \(24x16\), got 30x10"):
        view.mask()
    with pytest.raises(ValueError, match="a depth map must have one channel"):
        view.depth()
    write_image(tmp_path / "images" / "0.png", gradient(20, 20))
    with pytest.raises(ValueError, match="must be 24x16 pixels as its camera, got 20x20"):
        view.image()


@pytest.mark.parametrize("key", ["file_path", "mask_path", "depth_file_path", "ply_file_path"])
@pytest.mark.parametrize("name", ["../secret.png", "images/../../secret.png", "/etc/hostname", "./../data2/x.png"])
def test_transforms_name_nothing_outside(tmp_path, key, name):
    """A data set from elsewhere opens no file of its user's."""
    folder = tmp_path / "data"
    top = {key: name} if key == "ply_file_path" else {}
    write_transforms(folder, extra={} if top else {key: name}, **top)
    write_image(tmp_path / "secret.png", gradient())
    with pytest.raises(ValueError, match=f"{key} must name a file in {folder}, got '{re.escape(name)}'; move or link"):
        load(folder)


def test_a_link_that_the_user_has_put_there_is_followed(tmp_path):
    """Photographs may lie on another disk, and absolute names may lead into the folder."""
    folder = tmp_path / "data"
    write_transforms(folder)
    (folder / "images").rename(tmp_path / "elsewhere")
    (folder / "images").symlink_to(tmp_path / "elsewhere")
    assert len(load(folder).views) == 3
    data = write_transforms(tmp_path / "data")
    data["frames"][0]["file_path"] = str(folder / data["frames"][0]["file_path"])
    save(folder, data)
    assert len(load(folder).views) == 3


def test_archives_with_broken_places(tmp_path):
    """A part before the beginning of its archive, or of a version that nobody writes: zipfile raises OSError and
    NotImplementedError, readers say so in a line.
    """
    from drgs.data.checks import read_npz
    from drgs.features.teacher import read_map
    from drgs.io.foreign import refuse_foreign

    path = tmp_path / "points.npz"
    np.savez(path, data=np.ones((2, 7)))
    whole = path.read_bytes()
    index = whole.rfind(b"PK\1\2")  # of a part: version at 6, place at 42; of the index at the end: its place at 16
    for at, value in ((index + 6, b"\xad\0"), (index + 42, b"\xf0\xff\xff\x7f"), (len(whole) - 6, b"\xff\xff\xff\x7f")):
        path.write_bytes(whole[:at] + value + whole[at + len(value) :])
        with pytest.raises(ValueError, match=r"points.npz: must hold an array 'data', got .*; save it with") as error:
            read_npz(path, "data")
        one_line(error)
        (tmp_path / "a_fmap_CxHxW.pt").write_bytes(path.read_bytes())
        refuse_foreign(path, "an .npz file")
        with pytest.raises(ValueError, match="a_fmap_CxHxW.pt: must "):
            read_map(tmp_path / "a_fmap_CxHxW.pt")


def test_messages_stay_short(tmp_path):
    """What a file says is shown by its beginning, however long it is."""
    from drgs.data.checks import read_npy

    write_transforms(tmp_path, fl_x="1" * 5000)
    np.save(tmp_path / "a.npy", np.ones(3))
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(data[:8] + b"\x88\x13" + b"{" * 5000 + data[128:])
    for read in (lambda: load(tmp_path), lambda: read_npy(tmp_path / "a.npy")):
        with pytest.raises(ValueError, match=r"must be") as error:
            read()
        one_line(error)
        assert len(str(error.value)) < 500
    write_transforms(tmp_path, camera_model="x" * 5000)
    with pytest.raises(ValueError, match=r"camera_model must be one of") as error:
        load(tmp_path)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(("column", "row"), [(2, None), (None, 1)])
def test_a_left_handed_frame_is_named_with_both_repairs(tmp_path, column, row):
    """Poses of a left-handed camera, or of a left-handed world, become the right ones by what the message says."""
    data = write_transforms(tmp_path)
    right = [view.camera.w2c for view in load(tmp_path).views]

    def turn(frame) -> None:  # there and back
        matrix = np.array(frame["transform_matrix"])
        if row is None:
            matrix[:, column] *= -1
        else:
            matrix[row] *= -1
        frame["transform_matrix"] = matrix.tolist()

    for frame in data["frames"]:
        turn(frame)
    save(tmp_path, data)
    repairs = (
        r"transforms.json: frame 0: .* got a reflection .*\(\+x right, \+y up, looking along -z\), negate .* column 3 "
        "of transform_matrix, .* if it is the world, .* negate one row of camera-to-world, position included"
    )
    with pytest.raises(ValueError, match=repairs) as error:
        load(tmp_path)
    one_line(error)
    for frame in data["frames"]:
        turn(frame)
    save(tmp_path, data)
    np.testing.assert_allclose([view.camera.w2c for view in load(tmp_path).views], right)


def test_a_left_handed_llff_pose_is_named_by_its_own_axes(tmp_path):
    """Whose columns are others."""
    rows = write_llff(tmp_path)
    rows[:, [2, 7, 12]] *= -1
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=r"reflection .*\(down, right, backward\).* column 3 of its 3x5") as error:
        load(tmp_path)
    one_line(error)


# --------------------------------------------------------------------------- what other programs leave


def text_model(folder):
    """Folder of a COLMAP model in text as programs of before rigs write it."""
    target = write_colmap(folder, text=True)
    for name in ("rigs", "frames"):
        (target / f"{name}.txt").unlink()
    return target


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize(
    "change",
    [
        lambda lines: lines[:-1],  # ends after the last pose
        lambda lines: lines[::2],  # poses alone
        lambda lines: [x for row in zip(lines[::2], lines[1::2], strict=True) for x in (row[0], "# seen", row[1])],
        lambda lines: ["\ufeff# caf\xe9", *lines],
    ],
)
def test_colmap_text_as_other_programs_write_it(tmp_path, change, points):
    """Missing lines of observations, comments anywhere and in any encoding, a byte order mark, sizes as 24.0."""
    target = text_model(tmp_path)
    images, cameras = target / "images.txt", target / "cameras.txt"
    lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
    images.write_bytes("\n".join([*change(lines), ""]).encode("utf-8" if "\ufeff" in change(lines)[0] else "latin-1"))
    cameras.write_bytes("# caf\xe9\n".encode("latin-1") + cameras.read_bytes().replace(b" 24 16 ", b" 24.0 16.0 "))
    dataset = load(tmp_path, points=points)
    assert [view.name for view in dataset.views] == ["im0", "im1", "im2", "im3"]
    np.testing.assert_allclose(dataset.views[3].camera.w2c, poses(4)[3], atol=1e-9)
    assert (dataset.points is not None) == points
    assert not points or len(dataset.points) == 5


def test_a_byte_order_mark_costs_no_tracks(tmp_path, caplog):
    """An editor of Windows writes it into each file of a model; which view shows which point is read all the same."""
    target = text_model(tmp_path)
    plain = load(tmp_path).tracks
    for path in target.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    found = load(tmp_path).tracks
    assert not caplog.messages
    np.testing.assert_array_equal(found[0], plain[0])
    assert found[1].keys() == plain[1].keys()
    assert all(np.array_equal(found[1][name], shown) for name, shown in plain[1].items())


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("cameras", 20.0, np.nan, "must (have|hold) finite .*, got nan"),
        ("cameras", 20.0, np.inf, "must (have|hold) finite .*, got inf"),
        ("cameras", "twice", "", "cameras....: must be as COLMAP writes it, each ID once"),
        ("images", "twice", "", "images....: must be as COLMAP writes it and fit to cameras...., each ID once"),
        ("points3D", "twice", "", "points3D....: must be as COLMAP writes it and fit to cameras.... and images"),
    ],
)
def test_colmap_says_which_file_is_wrong(tmp_path, text, name, old, new, told):
    """Never in the words of its C++ library."""
    target = text_model(tmp_path) if text else write_colmap(tmp_path)
    file = target / f"{name}{'.txt' if text else '.bin'}"
    data = file.read_bytes()
    if old == "twice" and text:
        rows = [line for line in data.splitlines() if not line.startswith(b"#")]
        data = b"\n".join([*rows, *rows[-2 if name == "images" else -1 :], b""])
    elif old == "twice":
        (count,) = struct.unpack("<Q", data[:8])
        size = (len(data) - 8) // count
        data = struct.pack("<Q", count + 1) + data[8:] + data[8 : 8 + size]
    else:
        ends = (b" 20 ", f" {new} ".encode()) if text else (struct.pack("<d", old), struct.pack("<d", new))
        assert ends[0] in data
        data = data.replace(*ends)
    file.write_bytes(data)
    with pytest.raises(ValueError, match=told) as error:
        load(tmp_path)
    one_line(error)
    assert file.name in str(error.value)
    assert not re.search(r"\.cc:|Check failed|range_check|::", str(error.value))


def test_colmap_rigs_that_fit_to_nothing(tmp_path, caplog):
    """Both are named; one alone is left out, as poses are in images.txt, too."""
    target = write_colmap(tmp_path, text=True)
    rigs, images = target / "rigs.txt", target / "images.txt"
    whole = images.read_text()
    images.write_text("# none\n")  # frames.txt has four
    with pytest.raises(ValueError, match=r"rigs.txt and frames.txt must be of one model with images.txt") as error:
        load(tmp_path)
    one_line(error)
    images.write_text(whole)
    rigs.write_text(rigs.read_text().replace("CAMERA", "LIDAR"))
    with pytest.raises(ValueError, match=r"rigs.txt and frames.txt must be of one model .*remove both") as error:
        load(tmp_path)
    one_line(error)
    rigs.unlink()
    assert len(load(tmp_path).views) == 4
    assert "has one of rigs.txt and frames.txt alone" in caplog.text


def test_colmap_points_as_a_ply(tmp_path):
    """`points3D.ply`, as 3DGS's code writes it, or the only PLY there; of several, which one to rename."""
    target = write_colmap(tmp_path)
    (target / "points3D.bin").unlink()
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {x}\n" for x in "xyz")
    (target / "pc.ply").write_text(f"{header}end_header\n1 2 3\n")
    (target / "other.ply").write_text(f"{header}end_header\n4 5 6\n")
    with pytest.raises(FileNotFoundError, match=r"of PLY files other.ply, pc.ply: rename the one .* points3D.ply"):
        load(tmp_path)
    (target / "other.ply").unlink()
    assert load(tmp_path).points.tolist() == [[1, 2, 3]]
    (target / "pc.ply").rename(target / "points3D.ply")
    assert load(tmp_path).points.tolist() == [[1, 2, 3]]
    assert load(tmp_path).point_source == "points3D.ply, 1 points"


@pytest.mark.parametrize("place", ["colmap", "colmap_sparse/0", "reconstruction/text/3", "scene/sparse/0"])
@pytest.mark.parametrize("photos", ["images", "input", ""])
def test_colmap_parts_in_other_places(tmp_path, place, photos):
    """The model where other programs put it, and photographs in another folder beside it."""
    target = write_colmap(tmp_path)
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    target.rename(tmp_path / place)
    if photos != "images":
        (tmp_path / "images").rename(tmp_path / "input")
    if not photos:
        for file in (tmp_path / "input").iterdir():
            file.rename(tmp_path / file.name)
    if photos == "images" or place.startswith("colmap"):
        views = load(tmp_path).views
        assert (len(views), views[0].image().shape) == (4, (HEIGHT, WIDTH, 3))
        return
    with pytest.raises(FileNotFoundError, match="must lie in a folder named images, found none"):
        load(tmp_path)  # a folder that nothing says is one of COLMAP's


def test_photographs_in_several_folders(tmp_path):
    """Without `images`, those of two sizes: which one to rename. Under other names: where they are."""
    write_colmap(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_2")
    (tmp_path / "images_4").mkdir()
    for file in (tmp_path / "images_2").iterdir():
        (tmp_path / "images_4" / file.name).write_bytes(file.read_bytes())
    with pytest.raises(
        FileNotFoundError, match=r"found them in .*images_2, .*images_4; rename the one to use to images"
    ):
        load(tmp_path)
    for folder in ("images_2", "images_4"):
        for file in (tmp_path / folder).iterdir():
            file.rename(file.with_name(f"x{file.name}"))
    with pytest.raises(
        FileNotFoundError, match=r"images of other names than 'im0.png' are in .*images_2; move or link"
    ):
        load(tmp_path)


def test_an_incomplete_model_beside_llff(tmp_path, caplog):
    """COLMAP's model without images.bin is none: the poses of LLFF are taken; alone it is said what is missing."""
    write_llff(tmp_path)
    target = write_colmap(tmp_path)
    (target / "images.bin").unlink()
    (tmp_path / "images" / "im3.png").unlink()
    for name in ("0", "1", "2"):
        (tmp_path / "images" / f"{name}.png").unlink()
    dataset = load(tmp_path)
    assert (dataset.format, len(dataset.views)) == ("llff", 3)
    assert "sparse/0: is no whole COLMAP model, the poses are those of" in caplog.text
    (tmp_path / "poses_bounds.npy").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"must hold images.bin, found none \(only cameras.bin, rigs.bin"
    ) as error:
        load(tmp_path)
    one_line(error)


@pytest.mark.parametrize("prefix", ["/home/somebody/scenes/x/", "C:\\Users\\x\\", "/", ".\\"])
def test_absolute_names_of_another_machine(tmp_path, prefix):
    """Files that lie here under the end of their names are taken, with their masks and the split."""
    data = write_transforms(tmp_path, extra={"mask_path": f"{prefix}m.png"})
    write_image(tmp_path / "m.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    slash = "\\" if "\\" in prefix else "/"
    for frame in data["frames"]:
        frame["file_path"] = prefix + frame["file_path"].replace("/", slash)
    data["test_filenames"] = [data["frames"][1]["file_path"]]
    save(tmp_path, data)
    train, test = load(tmp_path).split()
    assert [view.name for view in train] == ["0", "2"]
    assert [view.name for view in test] == ["1"]
    assert train[0].mask().all()


@pytest.mark.parametrize("prefix", ["/home/x/images/", "..\\images\\", "D:\\x\\"])
def test_names_of_another_machine_in_colmap(tmp_path, prefix):
    """As RealityCapture and others write them; what is in no folder of the data set is refused as before."""
    images = text_model(tmp_path) / "images.txt"
    images.write_text(images.read_text().replace(" im", f" {prefix}im"))
    assert [view.name for view in load(tmp_path).views] == ["im0", "im1", "im2", "im3"]
    images.write_text(images.read_text().replace(f"{prefix}im", "/etc/im"))
    for file in (tmp_path / "images").iterdir():
        file.rename(tmp_path / file.name.replace("im", "x"))
    with pytest.raises(ValueError, match=r"image 0 must name a file in .*images, got '/etc/im0.png'"):
        load(tmp_path)


def test_what_can_be_read_beside_is_named(tmp_path):
    """Names of another machine, of files that are not here, and a COLMAP model: the command that takes it."""
    write_colmap(tmp_path)
    data = write_transforms(tmp_path)
    for frame in data["frames"]:
        frame["file_path"] = f"/home/somebody/frame_{frame['file_path'][-5:]}"
    save(tmp_path, data)
    with pytest.raises(
        ValueError, match=r"must name a file in .*/home/somebody.*sparse/0 \(colmap\) can be read and has 4 .*`drgs fit"
    ) as error:
        load(tmp_path)
    one_line(error)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    with pytest.raises(ValueError, match=r"must name a file in .*; move or link the file there and name it so$"):
        load(tmp_path)


def test_several_data_sets_in_a_folder(tmp_path):
    """One is taken, as archives unpack; of several one must be named."""
    write_transforms(tmp_path / "lego" / "lego")
    assert len(load(tmp_path).views) == 3
    write_transforms(tmp_path / "lego" / "chair")
    with pytest.raises(FileNotFoundError, match=r"found several in it \(.*chair, .*lego\); name one of them") as error:
        load(tmp_path)
    one_line(error)


def test_masks_of_colmap_as_jpeg(tmp_path):
    """`NAME.jpg` in masks/, whose grays near black and white are what compression left."""
    write_colmap(tmp_path)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4:12, 5:19] = 255
    write_image(tmp_path / "masks" / "im0.jpg", mask)
    assert (load(tmp_path).views[0].mask() == mask / 255).mean() > 0.95
    assert set(np.unique(load(tmp_path).views[0].mask())) == {0, 1}
