"""Views and formats, on data sets a few pixels large that the tests write themselves."""

from __future__ import annotations

import dataclasses
import json
import warnings

import numpy as np
import pytest

from drgs.cameras import Camera, c2w_to_opengl, intrinsics, look_at
from drgs.data import Dataset, View, load, scene_extent
from drgs.data.masks import read_mask

pytestmark = pytest.mark.core

cv2 = pytest.importorskip("cv2")
WIDTH, HEIGHT = 24, 16
K = intrinsics(20, 22, 11.0, 8.5)
BARREL = (-0.2, 0.05, 1e-3, -2e-3)


def poses(count: int) -> list[np.ndarray]:
    """w2c of cameras on an arc that look at the origin."""
    angles = np.linspace(0, 1.5, count)
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0)) for a in angles]


def gradient(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """An image whose red is the column and whose green is the row."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.linspace(0, 255, width)[None]
    image[..., 1] = np.linspace(0, 255, height)[:, None]
    return image


def write_image(path, image) -> None:
    """Write RGB, RGBA or one channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = [2, 1, 0, 3][: image.shape[2]] if image.ndim == 3 else ...
    assert cv2.imwrite(str(path), image[..., order] if image.ndim == 3 else image)


def write_colmap(folder, text: bool = False, count: int = 4, model: str = "PINHOLE", params=None):
    """A model of ``count`` images that see the same 5 points, and its images."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction()
    params = params or [20, 22, 11.0, 8.5]
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    points = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2], [0.1, 0.1, 0.1]])
    for index, pose in enumerate(poses(count)):
        image = pycolmap.Image(name=f"im{index}.png", keypoints=np.zeros((5, 2)), camera_id=1, image_id=index + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        write_image(folder / "images" / f"im{index}.png", gradient())
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for image_id in range(1, count + 1):
            track.add_element(image_id, index)
        reconstruction.add_point3D(point, track, np.array([255, 51 * index, 0], np.uint8))
    target = folder / "sparse" / "0"
    target.mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(target)
    return target


def write_transforms(folder, count: int = 3, extra: dict | None = None, **top) -> dict:
    """A transforms.json data set; ``extra`` goes to every frame, None drops a key."""
    frames = []
    for index, pose in enumerate(poses(count)):
        write_image(folder / "images" / f"{index}.png", gradient())
        c2w = c2w_to_opengl(np.linalg.inv(pose))
        frame = {"file_path": f"images/{index}.png", "transform_matrix": c2w.tolist()}
        frames.append({**frame, **(extra or {})})
    data = {"fl_x": 20, "fl_y": 22, "cx": 11.0, "cy": 8.5, "w": WIDTH, "h": HEIGHT, **top}
    data = {key: value for key, value in data.items() if value is not None}
    data["frames"] = frames
    save(folder, data)
    return data


def save(folder, data, name: str = "transforms.json") -> None:
    """Write JSON."""
    (folder / name).write_text(json.dumps(data))


def write_llff(folder, count: int = 3) -> np.ndarray:
    """An LLFF data set; returns its rows."""
    rows = []
    for index, pose in enumerate(poses(count)):
        c2w = np.linalg.inv(pose)
        matrix = np.stack([c2w[:3, 1], c2w[:3, 0], -c2w[:3, 2], c2w[:3, 3], (HEIGHT, WIDTH, 20.0)], axis=1)
        rows.append([*matrix.ravel(), 0.5, 9.0])
        write_image(folder / "images" / f"{index}.png", gradient())
    rows = np.array(rows)
    np.save(folder / "poses_bounds.npy", rows)
    return rows


# --------------------------------------------------------------------------- formats


@pytest.mark.parametrize("text", [False, True])
def test_colmap_binary_and_text(tmp_path, text):
    """Poses, intrinsics, points and colors come through, by both kinds of file."""
    write_colmap(tmp_path, text)
    # A folder may hold more photos than the model lists.
    write_image(tmp_path / "images" / "unlisted.png", gradient())
    dataset = load(tmp_path)
    assert (dataset.format, len(dataset.views)) == ("colmap", 4)
    assert [view.name for view in dataset.views] == ["im0", "im1", "im2", "im3"]
    for view, pose in zip(dataset.views, poses(4), strict=True):
        np.testing.assert_allclose(view.camera.w2c, pose, atol=1e-9)
        np.testing.assert_allclose(view.camera.K, K)
        assert view.camera.model == "pinhole"
    np.testing.assert_allclose(sorted(dataset.points[:, 0]), [0, 0, 0, 0.1, 0.2])
    np.testing.assert_allclose(dataset.colors[1], [1, 0.2, 0])
    assert "5 points" in dataset.point_source


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "."])
def test_colmap_places(tmp_path, place):
    """A model is found where COLMAP and Nerfstudio put it, or named itself."""
    target = write_colmap(tmp_path)
    moved = tmp_path / "moved"
    target.rename(moved)
    (tmp_path / "sparse").rmdir()
    final = tmp_path / place
    final.parent.mkdir(parents=True, exist_ok=True)
    if place == ".":
        for file in moved.iterdir():
            file.rename(tmp_path / file.name)
    else:
        moved.rename(final)
    assert len(load(tmp_path).views) == 4
    assert len(load(final).views) == 4  # the model's own folder may be named


@pytest.mark.parametrize(
    ("model", "params", "lens", "distortion"),
    [
        ("SIMPLE_PINHOLE", [20, 12, 8], "pinhole", ()),
        ("SIMPLE_RADIAL", [20, 12, 8, 0.1], "opencv", (0.1, 0, 0, 0)),
        ("SIMPLE_RADIAL", [20, 12, 8, 0.0], "pinhole", ()),
        ("RADIAL", [20, 12, 8, 0.1, 0.02], "opencv", (0.1, 0.02, 0, 0)),
        ("OPENCV", [20, 20, 12, 8, 0.1, 0.02, 1e-3, 2e-3], "opencv", (0.1, 0.02, 1e-3, 2e-3)),
        (
            "OPENCV_FISHEYE",
            [20, 20, 12, 8, 0.1, 0.02, 1e-3, 2e-3],
            "opencv_fisheye",
            (0.1, 0.02, 1e-3, 2e-3),
        ),
        (
            "FULL_OPENCV",
            [20, 20, 12, 8, 0.1, 0.02, 1e-3, 2e-3, 0.03, 0.01, 0.02, 0.03],
            "opencv",
            (0.1, 0.02, 1e-3, 2e-3, 0.03, 0.01, 0.02, 0.03),
        ),
        ("SIMPLE_RADIAL_FISHEYE", [20, 12, 8, 0.1], "opencv_fisheye", (0.1, 0, 0, 0)),
        ("RADIAL_FISHEYE", [20, 12, 8, 0.1, 0.02], "opencv_fisheye", (0.1, 0.02, 0, 0)),
        ("SIMPLE_FISHEYE", [20, 12, 8], "opencv_fisheye", (0, 0, 0, 0)),
        ("FISHEYE", [20, 21, 12, 8], "opencv_fisheye", (0, 0, 0, 0)),
        ("EQUIRECTANGULAR", [WIDTH, HEIGHT], "equirectangular", ()),
    ],
)
def test_colmap_lenses_project_as_pycolmap_does(tmp_path, model, params, lens, distortion):
    """Our camera projects where COLMAP's does, for every model."""
    pycolmap = pytest.importorskip("pycolmap")
    write_colmap(tmp_path, model=model, params=params)
    camera = load(tmp_path).views[0].camera
    assert (camera.model, camera.distortion) == (lens, distortion)
    local = np.array([[0.3, -0.2, 1.0], [-0.1, 0.25, 1.2]])
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    world = (local - camera.w2c[:3, 3]) @ camera.w2c[:3, :3]
    np.testing.assert_allclose(camera.project(world)[0], theirs.img_from_cam(local), atol=1e-9)


def test_transforms_with_masks_and_depth(tmp_path):
    """OpenGL poses, masks and millimeter depths."""
    write_transforms(tmp_path, extra={"mask_path": "m.png", "depth_file_path": "d.png"})
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 12:] = 255
    write_image(tmp_path / "m.png", mask)
    write_image(tmp_path / "d.png", np.full((HEIGHT, WIDTH), 2500, np.uint16))
    dataset = load(tmp_path)
    view = dataset.views[1]
    assert (dataset.format, view.name, view.camera.model) == ("transforms", "1", "pinhole")
    np.testing.assert_allclose(view.camera.w2c, poses(3)[1], atol=1e-9)
    np.testing.assert_allclose(view.camera.K, K)
    np.testing.assert_allclose(view.image() * 255, gradient(), atol=1e-4)
    np.testing.assert_array_equal(view.mask(12, 8), np.repeat([[0.0] * 6 + [1.0] * 6], 8, axis=0))
    np.testing.assert_allclose(view.depth(6, 4), 2.5)
    assert view.image(12, 8).dtype == view.depth().dtype == view.mask().dtype == np.float32


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_mask_with_an_opaque_alpha_channel_is_black_and_white(tmp_path, dtype):
    """Alpha that is 1 throughout says nothing; alpha that is not is the mask, whatever the colors are."""
    white = np.iinfo(dtype).max
    kept = np.zeros((HEIGHT, WIDTH), dtype)
    kept[:, 12:] = white
    every = np.full_like(kept, white)
    for name, channels in (("opaque", (kept, kept, kept, every)), ("cut", (every, every, every, kept))):
        write_image(tmp_path / f"{name}.png", np.dstack(channels))
        np.testing.assert_array_equal(read_mask(tmp_path / f"{name}.png"), kept / white)


def test_a_mask_is_within_its_bounds_at_every_size(tmp_path):
    """Averages of ones can be 1 + 1e-7 in float32, which picks of views refuse: as of `head`, at 34x34."""
    write_image(tmp_path / "m.png", np.full((104, 104), 255, np.uint8))
    view = View(Camera(K, np.eye(4), 104, 104), "a", mask_path=tmp_path / "m.png")
    for size in range(8, 104):
        mask = view.mask(size, size)
        assert mask.dtype == np.float32
        assert 1 - 1e-6 < mask.min() <= mask.max() <= 1


def test_transforms_depth_units(tmp_path):
    """npy depths are in scene units unless the file says otherwise."""
    data = write_transforms(tmp_path, extra={"depth_file_path": "d.npy"})
    np.save(tmp_path / "d.npy", np.full((HEIGHT, WIDTH), 2.5, np.float32))
    np.testing.assert_allclose(load(tmp_path).views[0].depth(), 2.5)
    save(tmp_path, {**data, "depth_unit_scale_factor": 0.1})
    np.testing.assert_allclose(load(tmp_path).views[0].depth(), 0.25)


def test_transforms_blender_split_without_suffix(tmp_path):
    """Blender's files: three splits, no suffix, an angle for a focal length."""
    angle = 2 * np.arctan(0.5 * WIDTH / 20)
    for shade, split in enumerate(("train", "test", "val")):
        write_image(tmp_path / split / "r_0.png", gradient() // (1 + shade))
        frame = {"file_path": f"./{split}/r_0", "transform_matrix": np.eye(4).tolist()}
        data = {"camera_angle_x": angle, "frames": [frame]}
        save(tmp_path, data, f"transforms_{split}.json")
    dataset = load(tmp_path)
    train, test = dataset.split()
    assert [view.name for view in train] == ["train/r_0"]
    assert [view.name for view in test] == ["test/r_0"]
    assert dataset.split_rule() == "as the data set's files say"
    np.testing.assert_allclose(train[0].camera.K, intrinsics(20, 20, 12, 8))
    np.testing.assert_allclose(train[0].camera.c2w[:3, 2], [0, 0, -1])


def test_transforms_lenses(tmp_path):
    """Coefficients go by the camera model that is named."""
    data = write_transforms(tmp_path, k1=0.1, k2=0.02, p1=1e-3, p2=2e-3)
    camera = load(tmp_path).views[0].camera
    assert (camera.model, camera.distortion) == ("opencv", (0.1, 0.02, 1e-3, 2e-3, 0.0))
    save(tmp_path, {**data, "camera_model": "OPENCV_FISHEYE", "k4": 0.5})
    camera = load(tmp_path).views[0].camera
    assert (camera.model, camera.distortion) == ("opencv_fisheye", (0.1, 0.02, 0.0, 0.5))
    save(tmp_path, {"camera_model": "EQUIRECTANGULAR", "frames": data["frames"]})
    panorama = load(tmp_path).views[0].camera
    assert (panorama.model, panorama.distortion) == ("equirectangular", ())
    assert 2 * np.pi * panorama.K[0, 0] == panorama.width
    assert np.pi * panorama.K[1, 1] == panorama.height
    save(tmp_path, {**data, "camera_model": "PINHOLE"})
    assert load(tmp_path).views[0].camera.model == "pinhole"


def test_transforms_scale_k_to_smaller_images(tmp_path):
    """Images of half the size halve K."""
    write_transforms(tmp_path, w=2 * WIDTH, h=2 * HEIGHT)
    camera = load(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.K[:2, 2], [5.5, 4.25])


def test_transforms_mixed_sizes_with_their_own_intrinsics(tmp_path):
    """Sizes may differ when every frame has its own intrinsics."""
    own = {"fl_x": 20, "w": WIDTH, "h": HEIGHT, "cx": 12, "cy": 8}
    data = write_transforms(tmp_path, extra=own)
    write_image(tmp_path / "images" / "1.png", gradient(30, 10))
    data["frames"][1].update({"w": 30, "h": 10, "cx": 15, "cy": 5})
    save(tmp_path, data)
    assert [view.camera.width for view in load(tmp_path).views] == [WIDTH, 30, WIDTH]


def test_transforms_points(tmp_path):
    """The point cloud that the file names is read with its colors."""
    write_transforms(tmp_path, ply_file_path="points.ply")
    header = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        "end_header\n"
    )
    (tmp_path / "points.ply").write_text(header + "0 1 2 255 0 51\n3 4 5 0 0 0\n")
    dataset = load(tmp_path)
    np.testing.assert_allclose(dataset.points, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_allclose(dataset.colors[0], [1, 0, 0.2])
    assert dataset.point_source == "points.ply, 2 points"


def test_llff(tmp_path):
    """Axes and the height, width, focal column."""
    write_llff(tmp_path)
    dataset = load(tmp_path)
    assert (dataset.format, len(dataset.views)) == ("llff", 3)
    for view, pose in zip(dataset.views, poses(3), strict=True):
        np.testing.assert_allclose(view.camera.w2c, pose, atol=1e-9)
        np.testing.assert_allclose(view.camera.K, intrinsics(20, 20, WIDTH / 2, HEIGHT / 2))
    assert len(load(tmp_path / "poses_bounds.npy").views) == 3


# ----------------------------------------------------------------------------- views


def test_split_is_every_eighth_by_name():
    """The rule and its words, and what it refuses."""
    views = [View(Camera(K, np.eye(4), WIDTH, HEIGHT), name=f"{i:02d}") for i in range(17)]
    dataset = Dataset("x", "test", views[::-1])
    train, test = dataset.split()
    assert [view.name for view in test] == ["00", "08", "16"]
    assert len(train) == 14
    assert dataset.split_rule() == "views sorted by name, index % 8 == 0 held out"
    assert len(dataset.split(test_every=0)[0]) == 17
    assert [view.name for view in dataset.split(test_every=5)[1]] == ["00", "05", "10", "15"]
    with pytest.raises(ValueError, match=r"test_every must be 0 \(none\) or >= 2, got 1"):
        dataset.split(test_every=1)
    assert [view.name for view in dataset.split(8, 3)[1]] == ["03", "11"]
    assert dataset.split_rule(8, 3) == "views sorted by name, index % 8 == 3 held out"
    offset = Dataset("x", "test", views, test_offset=1)
    assert [view.name for view in offset.split()[1]] == ["01", "09"]
    assert [view.name for view in offset.split(test_every=5)[1]] == ["00", "05", "10", "15"]
    for every, value in ((8, 8), (8, -1), (0, 1)):
        with pytest.raises(ValueError, match=f"test_offset must be in 0..{max(every, 1) - 1} with .*, got {value}"):
            dataset.split(every, value)
    with pytest.raises(ValueError, match="test_offset must be the index of one of the 17 views, got 17; lower it"):
        dataset.split(20, 17)
    stated = [dataclasses.replace(view, split="test" if view.name < "02" else "train") for view in views]
    assert [view.name for view in Dataset("x", "test", stated).split(8, 3)[1]] == ["00", "01"], "the files' own wins"
    assert len(Dataset("x", "test", views[:1]).split()[0]) == 1


def test_load_reads_no_pixels(tmp_path):
    """A damaged picture hurts only when it is asked for."""
    write_transforms(tmp_path)
    image = tmp_path / "images" / "1.png"
    image.write_bytes(image.read_bytes()[:40])  # the header survives, the pixels do not
    views = load(tmp_path).views
    views[0].image()
    with pytest.raises(ValueError, match="1.png: must be an image, could not be decoded"):
        views[1].image()


def test_image_composites_alpha_and_reads_16_bits(tmp_path):
    """Alpha goes on the background; 16 bits have the range of 8."""
    write_transforms(tmp_path)
    image = np.dstack([gradient(), np.full((HEIGHT, WIDTH), 51, np.uint8)])
    write_image(tmp_path / "images" / "0.png", image)
    write_image(tmp_path / "images" / "1.png", gradient().astype(np.uint16) * 257)
    views = load(tmp_path, background=(1.0, 0.0, 0.5)).views
    expected = gradient() / 255 * 0.2 + np.array([0.8, 0, 0.4])
    np.testing.assert_allclose(views[0].image(), expected, atol=1e-6)
    np.testing.assert_allclose(views[1].image(), gradient() / 255, atol=1e-6)


def test_alpha_comes_with_the_image(tmp_path):
    """Reduced by area as the image is; of three channels, and where all is covered, there is none."""
    write_transforms(tmp_path)
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[:, 3:] = 255
    write_image(tmp_path / "images" / "0.png", np.dstack([gradient(), alpha]))
    write_image(tmp_path / "images" / "1.png", np.dstack([gradient(), np.full_like(alpha, 255)]))
    views = load(tmp_path).views
    image, found = views[0].image_and_alpha(WIDTH // 2, HEIGHT // 2)
    np.testing.assert_array_equal(image, views[0].image(WIDTH // 2, HEIGHT // 2))
    np.testing.assert_allclose(found[0], [0, 0.5] + [1] * (WIDTH // 2 - 2), atol=1e-6)
    assert [view.image_and_alpha()[1] for view in views[1:3]] == [None, None]


def test_alpha_of_a_lens_is_undistorted(tmp_path):
    """As the image is; what the photograph did not see is not known to be empty."""
    write_transforms(tmp_path)
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[:, WIDTH // 2 :] = 255
    write_image(tmp_path / "images" / "0.png", np.dstack([np.repeat(alpha[..., None], 3, 2), alpha]))
    view = load(tmp_path).views[0]
    view.camera = dataclasses.replace(view.camera, model="opencv", distortion=(0.3, 0.0, 0.0, 0.0))
    image, found = view.image_and_alpha()
    seen = view.mask() > 0
    assert not seen.all()
    np.testing.assert_array_equal(found[~seen], 1)
    inside = seen & (np.abs(np.arange(WIDTH) - WIDTH / 2) > 3)
    np.testing.assert_allclose(found[inside], image[..., 0][inside], atol=0.05)


def test_image_resizes_by_area(tmp_path):
    """Half size is the mean of 2x2 pixels."""
    write_transforms(tmp_path)
    expected = gradient().reshape(8, 2, 12, 2, 3).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(load(tmp_path).views[0].image(12, 8), expected, atol=1e-6)


@pytest.mark.parametrize(("model", "distortion"), [("opencv", BARREL), ("opencv_fisheye", (0.05, 0.01, 0.0, 0.0))])
def test_undistorted_image_shows_the_right_rays(tmp_path, model, distortion):
    """A photo whose colors are its ray directions, undistorted, must show a pinhole's
    directions.
    """
    width, height = 120, 80
    camera = Camera(intrinsics(100, 105, 58.5, 41.25), np.eye(4), width, height, model, distortion)
    to_color = lambda camera: camera.pixel_directions() * [0.8, 0.8, 0] + 0.5  # noqa: E731
    write_image(tmp_path / "a.png", np.round(to_color(camera) * 65535).astype(np.uint16))
    view = View(camera, "a", image_path=tmp_path / "a.png")
    image, mask = view.image(), view.mask()
    seen = slice(None) if mask is None else mask > 0
    expected = to_color(camera.undistorted())
    # One pixel off would be 0.008; borders interpolate against repeated pixels.
    inner = np.zeros((height, width), bool)
    inner[4:-4, 4:-4] = True
    inner &= True if mask is None else seen
    assert np.abs(image - expected)[inner].max() < 1e-3


def test_undistorted_masks_and_depths_stay_unmixed_and_unseen_pixels_are_masked(tmp_path):
    """No value appears that was not stored, and nothing is made up outside the photo."""
    camera = Camera(K, np.eye(4), WIDTH, HEIGHT, "opencv", (0.5, 0.0, 0.0, 0.0))
    depth = np.where(np.arange(WIDTH) < 12, 1000, 3000)[None].repeat(HEIGHT, 0)
    write_image(tmp_path / "d.png", depth.astype(np.uint16))
    write_image(tmp_path / "m.png", (depth > 2000).astype(np.uint8))  # stored as 0 and 1
    view = View(camera, "a", depth_path=tmp_path / "d.png", depth_scale=1e-3)
    assert set(np.unique(view.depth(10, 7).round(5))) <= {0.0, 1.0, 3.0}
    assert view.mask()[0, 0] == 0  # pincushion: the corner lies outside the photo
    assert view.mask()[8, 11] == 1
    assert view.depth()[0, 0] == 0
    view.mask_path = tmp_path / "m.png"
    assert set(np.unique(view.mask())) == {0.0, 1.0}
    assert view.mask()[8, 5] == 0


def test_scene_extent():
    """3DGS's rule, and what a single camera gets."""
    cameras = [Camera(K, pose, WIDTH, HEIGHT) for pose in poses(5)]
    centers = np.array([camera.center for camera in cameras])
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scene_extent(cameras) == pytest.approx(1.1 * spread)
    assert scene_extent(cameras[:1]) == 1.0
    points = cameras[0].center + [[0, 0, 2], [0, 3, 0], [5, 0, 0]]
    assert scene_extent(cameras[:1], points) == pytest.approx(3.3)


def test_barrel_lens_that_folds_back_is_masked():
    """Past the fold a photo shows something else: masked, without a warning."""
    camera = Camera(intrinsics(20, 20, 12, 8), np.eye(4), WIDTH, HEIGHT, "opencv", (-1.0, 0, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mask = View(camera, "a").mask()
    assert mask[0, 0] == 0
    assert mask[8, 12] == 1


def test_views_of_one_name_are_told_apart(tmp_path):
    """`a.png` beside `a.jpg`, in a folder that has an `a_2.png` already: three names, in LLFF as in COLMAP."""
    rows = write_llff(tmp_path)
    for index, name in enumerate(("a.jpg", "a.png", "a_2.png")):
        (tmp_path / "images" / f"{index}.png").unlink()
        write_image(tmp_path / "images" / name, gradient())
    assert len(rows) == 3
    assert [view.name for view in load(tmp_path).views] == ["a", "a_3", "a_2"]
    target = write_colmap(tmp_path / "colmap", count=2)
    images = target / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"im1.png\0", b"im0.jpg\0"))
    (tmp_path / "colmap" / "images" / "im1.png").rename(tmp_path / "colmap" / "images" / "im0.jpg")
    assert sorted(view.name for view in load(tmp_path / "colmap").views) == ["im0", "im0_2"]


def test_depth_by_nerfcapture_keys(tmp_path):
    """`depth_path` and `integer_depth_scale` (NeRFCapture, SplaTAM, instant-ngp): 19660 of 65535 units of 10 m are 3 m,
    under either key of the file; nerfstudio's unit may say the same, not another.
    """
    write_image(tmp_path / "d.png", np.full((HEIGHT, WIDTH), 19660, np.uint16))
    np.save(tmp_path / "d.npy", np.full((HEIGHT, WIDTH), 3.0))
    scale = {"integer_depth_scale": 10 / 65535}
    for key, name in (("depth_path", "d.png"), ("depth_file_path", "d.png"), ("depth_path", "d.npy")):
        write_transforms(tmp_path, extra={key: name}, **scale)
        assert load(tmp_path).views[0].depth()[3, 4] == pytest.approx(3.0, abs=1e-3)
    write_transforms(tmp_path, extra={"depth_path": "d.png"}, depth_unit_scale_factor=1e-3, **scale)
    with pytest.raises(ValueError, match=r"unit of depth maps must be stated once, got depth_unit.* 0.001 and integer"):
        load(tmp_path)
    write_transforms(tmp_path, extra={"depth_path": "d.png"}, integer_depth_scale=0)
    with pytest.raises(ValueError, match=r"integer_depth_scale must be in \(0, 1e\+09\), got 0"):
        load(tmp_path)


def test_keys_of_depths_and_masks_that_are_not_read(tmp_path, caplog):
    """Said once a file, not ignored without a word."""
    write_transforms(tmp_path, extra={"depth": "d.npy", "mask": 1, "mask_path": None})
    load(tmp_path)
    assert caplog.text.count("the keys 'depth', 'mask' of frames are not read") == 1


@pytest.mark.parametrize("key", ["confidence_file_path", "confidence_path"])
def test_depth_of_no_confidence_is_unknown(tmp_path, key):
    """ARKit's levels 0, 1, 2, in a map of another size; depth in meters as `.npy`."""
    np.save(tmp_path / "d.npy", np.full((HEIGHT, WIDTH), 3.0, np.float32))
    levels = np.repeat([0, 1, 2, 2], WIDTH // 8)[None].repeat(HEIGHT // 2, 0)
    write_image(tmp_path / "c.png", levels.astype(np.uint8))
    write_transforms(tmp_path, extra={"depth_file_path": "d.npy", key: "c.png"})
    depth = load(tmp_path).views[0].depth()
    assert (depth[:, : WIDTH // 4] == 0).all()
    assert (depth[:, WIDTH // 4 :] == 3).all()


def test_relative_depth_is_no_depth(tmp_path):
    """SDFStudio's `mono_depth_path`: numbers as stored, NaN where unknown, and nothing in scene units."""
    values = np.linspace(-1, 1, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    values[3, 4] = np.inf
    np.save(tmp_path / "m.npy", values)
    write_transforms(tmp_path, extra={"mono_depth_path": "m.npy"})
    view = load(tmp_path).views[0]
    assert view.depth() is None
    expected = np.where(np.isinf(values), np.nan, values).astype(np.float32)
    np.testing.assert_array_equal(view.relative_depth(), expected)
    np.save(tmp_path / "m.npy", np.ones((HEIGHT, WIDTH, 3)))
    with pytest.raises(ValueError, match=r"m.npy: a depth map must have one channel, got shape"):
        view.relative_depth()


@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("twin", ["listed again", "link", "bytes", "suffix", "format"])
def test_a_photograph_counts_once(tmp_path, caplog, twin, lazy):
    """Listed twice, or under two names, by a link or a copy, in one format or two: one view, held out or trained on."""
    data = write_transforms(tmp_path, count=5)
    photo = tmp_path / "images" / "2.png"
    name = {"listed again": "2.png", "suffix": "2.jpg", "format": "z.jpg"}.get(twin, "z.png")
    if twin == "link":
        (photo.parent / name).symlink_to(photo)
    elif twin == "bytes":
        (photo.parent / name).write_bytes(photo.read_bytes())
    elif name.endswith(".jpg"):
        write_image(photo.parent / name, gradient())
    data["frames"].append({**data["frames"][2], "file_path": f"images/{name}"})
    save(tmp_path, data)
    dataset = load(tmp_path, test_every=2, lazy=lazy)
    assert [view.name for view in dataset.views] == ["0", "1", "2", "3", "4"]
    again = "z" if "z" in name else "2_2"
    assert f"1 of the 6 photographs are listed again ({again} is the same as 2)" in caplog.text


def test_a_photograph_of_two_splits_is_held_out(tmp_path):
    """Unless nothing were left to train on: then it is trained on. What is only in `val` beside `test` stays where it
    was.
    """
    data = write_transforms(tmp_path, count=4)
    names = [frame["file_path"] for frame in data["frames"]]
    (tmp_path / "transforms.json").unlink()
    for train, val, test, expected in (
        (names, names[:1], names[2:], (["0", "1"], ["2", "3"])),
        (names, names[:1], [], (["1", "2", "3"], ["0"])),
        (names, [], names, (["0", "1", "2", "3"], [])),
    ):
        for split, chosen in (("train", train), ("val", val), ("test", test)):
            path = tmp_path / f"transforms_{split}.json"
            path.unlink(missing_ok=True)
            if chosen:
                save(tmp_path, {**data, "frames": [f for f in data["frames"] if f["file_path"] in chosen]}, path.name)
        assert tuple([view.name for view in part] for part in load(tmp_path).split()) == expected


@pytest.mark.parametrize("write", [write_colmap, write_llff])
def test_copies_in_other_formats_count_once(tmp_path, write):
    """COLMAP gives two copies of one photograph nearly the same pose, LLFF's rows may have the same one."""
    if write is write_colmap:
        images = write(tmp_path) / "images.txt"
        pytest.importorskip("pycolmap").Reconstruction(images.parent).write_text(images.parent)
        for file in images.parent.glob("*.bin"):
            file.unlink()
        (images.parent / "rigs.txt").unlink()
        (images.parent / "frames.txt").unlink()
        lines = [line for line in images.read_text().splitlines() if not line.startswith("#")]
        words = lines[0].split()
        words[0], words[5], words[9] = "9", f"{float(words[5]) + 1e-3:.9f}", "z.png"
        images.write_text("\n".join([*lines, " ".join(words), ""]) + "\n")
        first = "im0"
    else:
        rows = write(tmp_path)
        np.save(tmp_path / "poses_bounds.npy", np.concatenate([rows, rows[:1]]))
        first = "0"
    source = tmp_path / "images" / f"{first}.png"
    (tmp_path / "images" / "z.png").write_bytes(source.read_bytes())
    names = [view.name for view in load(tmp_path).views]
    assert first in names
    assert "z" not in names
