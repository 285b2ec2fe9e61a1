"""Data sets of what moves, written by the tests themselves: videos of 32x24 pixels and 6 frames."""

from __future__ import annotations

import json
import re
import shutil
import struct

import cv2
import numpy as np
import pytest
import torch

from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, look_at
from drgs.data import load, transforms, video_decoding
from drgs.data.videos import VideoFrame, read_video
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_frames, warn_of_late_cameras
from drgs.sfm.points import initial_points

WIDTH, HEIGHT, FRAMES = 32, 24, 6
FOCAL = 30.0
POINT = np.array([0.1, -0.2, 0.3])  # of the scene, painted where cameras see it


def cameras(count=4):
    """Before the origin, on an arc, of the videos' size."""
    K = intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    eyes = [(2.5 * np.sin(a), -2.5 * np.cos(a), 0.6) for a in np.linspace(-0.5, 0.5, count)]
    return [Camera(K, look_at(eye, (0, 0, 0)), WIDTH, HEIGHT) for eye in eyes]


def coded(index, camera=0):
    """An image that says its numbers: 8 stripes, black or white, which no codec mistakes."""
    bits = [(index + 8 * camera) >> bit & 1 for bit in range(8)]
    stripes = np.repeat(np.array(bits, np.uint8) * 215 + 20, WIDTH // 8)
    return np.ascontiguousarray(np.broadcast_to(stripes[None, :, None], (HEIGHT, WIDTH, 3)))


def decoded(image):
    """(camera, index) of an image, of 8 bits or of floats in [0, 1]."""
    stripes = image.reshape(HEIGHT, 8, WIDTH // 8, 3).mean(axis=(0, 2, 3)) * (1 if image.dtype == np.uint8 else 255)
    return divmod(int((stripes > 128) @ 2 ** np.arange(8)), 8)


def write_video(path, images, code="mp4v", rate=30):
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), rate, images[0].shape[1::-1])
    for image in images:
        writer.write(image)
    writer.release()
    return path


def write_poses(path, views, scale=1.0):
    """LLFF's rows: axes down, right, backward in columns; for images `scale` times as large."""
    rows = []
    for view in views:
        right, down, forward, eye = view.c2w[:3].T
        size = np.array([HEIGHT, WIDTH, FOCAL]) * scale
        rows.append([*np.stack([down, right, -forward, eye, size], axis=1).ravel(), 1.0, 9.0])
    np.save(path / "poses_bounds.npy", np.array(rows))


@pytest.fixture(scope="module")
def neu3d(tmp_path_factory):
    """Four cameras; treat as read-only."""
    folder = tmp_path_factory.mktemp("neu3d")
    for k in range(4):
        write_video(folder / f"cam{k:02d}.mp4", [coded(i, k) for i in range(FRAMES)])
    write_poses(folder, cameras())
    return folder


def test_videos_of_synchronous_cameras(neu3d):
    """A view a camera and frame, named and timed alike, with the frame that its name says; the first camera is held out
    at all times, whatever `test_every` says, and the words that are recorded say so.
    """
    data = load(neu3d, test_every=3)
    assert data.format == "neu3d"
    assert [view.name for view in data.views] == [f"cam{k:02d}/{i:04d}" for k in range(4) for i in range(FRAMES)]
    assert data.times == tuple(i / 5 for i in range(FRAMES))
    assert data.frames == tuple(range(FRAMES))
    assert data.is_dynamic
    assert data.camera_names == ("cam00", "cam01", "cam02", "cam03")
    train, test = data.split()
    assert {view.camera_name for view in train} == {"cam01", "cam02", "cam03"}
    assert [view.name for view in test] == [f"cam00/{i:04d}" for i in range(FRAMES)]
    assert data.split_rule() == "camera cam00 held out at all times"
    for index in (23, 0, 13, 8):  # in no order: back, forth, another video
        view = data.views[index]
        assert view.frame == VideoFrame(neu3d / f"cam{index // 6:02d}.mp4", index % 6)
        assert view.camera.time == (index % 6) / 5
        assert decoded(view.image()) == (index // 6, index % 6)


@pytest.mark.parametrize(("times", "numbers"), [(1, (0,)), (2, (0, 5)), (4, (0, 2, 3, 5)), (40, tuple(range(6)))])
def test_frames_are_spread_over_the_whole_video(neu3d, times, numbers):
    """As many as asked for, the first and the last among them, all if there are no more; one alone does not move."""
    data = load(neu3d, times=times)
    assert data.frames == numbers
    assert [view.frame.index for view in data.views[: len(numbers)]] == list(numbers)
    # Frame 2 of 0 ... 5 is at 2/5 of the video, not at 1/3, though it is the second of four.
    assert data.times == tuple(number / 5 for number in numbers)
    assert data.is_dynamic == (times > 1)
    assert data.split_rule() == "camera cam00 held out at all times"


def test_folders_of_frames_in_place_of_videos(neu3d, tmp_path):
    """As 4DGaussians takes them out of the videos: same views, same cameras, calibrated for the size of the images."""
    for k in range(4):
        (tmp_path / f"cam{k:02d}" / "images").mkdir(parents=True)
        for i in range(FRAMES):
            cv2.imwrite(str(tmp_path / f"cam{k:02d}" / "images" / f"{i:04d}.png"), coded(i, k))
    write_poses(tmp_path, cameras(), scale=2)
    data, videos = load(tmp_path, times=3), load(neu3d, times=3)
    assert data.format == "neu3d"
    assert data.split_rule() == "camera cam00 held out at all times"
    assert decoded(data.views[5].image()) == (1, 5)
    for a, b in zip(data.views, videos.views, strict=True):
        assert (a.name, a.camera.time) == (b.name, b.camera.time)
        np.testing.assert_allclose(a.camera.w2c, b.camera.w2c, atol=1e-12)
        np.testing.assert_allclose(a.camera.K, b.camera.K)
    shutil.rmtree(tmp_path / "cam02")
    assert "got 4 rows and 3 folders of frames" in refused(tmp_path)


def test_maps_of_a_teacher_are_written_where_they_are_found(neu3d, tmp_path):
    """`drgs teach` names the map of a frame as the loader looks for it."""
    from drgs.commands import teach

    shutil.copytree(neu3d, tmp_path, dirs_exist_ok=True)
    files = teach._files(load(tmp_path, times=2).views)
    for number, name in enumerate(files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        torch.save(torch.full((2, 3, 4), float(number)), tmp_path / name)
    again = load(tmp_path, times=2)
    assert [view.teacher_path for view in again.views] == [tmp_path / name for name in files]
    assert len(files) == 8


def test_which_cameras_are_held_out(neu3d):
    """Cameras that are named are held out instead; none leaves it to `test_every`; a config wins over the data set."""
    data = load(neu3d, test_cameras=("cam03", "cam01"))
    assert {view.camera_name for view in data.split()[1]} == {"cam01", "cam03"}
    assert data.split_rule() == "cameras cam01, cam03 held out at all times"
    assert {view.camera_name for view in data.split(test_cameras=("cam02",))[1]} == {"cam02"}
    none = load(neu3d, test_cameras=(), test_every=8)
    assert [view.name for view in none.split()[1]] == ["cam00/0000", "cam01/0002", "cam02/0004"]
    config = FitConfig().replace(test_cameras=("cam02",), times=3)
    assert FitConfig.from_json(config.to_json()) == config
    for cameras, text in ((("cam9",), "among cam00"), (("cam00", "cam01", "cam02", "cam03"), "must leave a camera")):
        with pytest.raises(ValueError, match=text):
            load(neu3d, test_cameras=cameras)


def test_poses_of_videos_in_llff_axes(tmp_path):
    """A point of the scene is where the videos show it, though the poses are stated for images four times as large."""
    views = cameras()
    for k, view in enumerate(views):
        (pixel,), _ = view.project(POINT[None])
        distance = np.hypot(*np.moveaxis(np.indices((HEIGHT, WIDTH)) + 0.5 - pixel[::-1, None, None], 0, 0))
        spot = np.repeat((255 * np.exp(-0.5 * (distance / 2) ** 2)).astype(np.uint8)[..., None], 3, axis=2)
        write_video(tmp_path / f"cam{k:02d}.avi", [spot] * 2, "MJPG")
    write_poses(tmp_path, views, scale=4)
    for view in load(tmp_path, lazy=True).views:
        image = view.image()[..., 0] ** 2  # of the background, a codec's noise remains
        found = [(image * (grid + 0.5)).sum() / image.sum() for grid in np.indices(image.shape)]
        (pixel,), depth = view.camera.project(POINT[None])
        assert depth > 0
        # Rounding to 8 bits and the codec move the middle of a spot of 2 pixels by some hundredths of a pixel.
        np.testing.assert_allclose(pixel, found[::-1], atol=0.15)


@pytest.mark.parametrize(("suffix", "code"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".webm", "VP80"), (".mkv", "mp4v")])
def test_frames_of_every_container(tmp_path, suffix, code):
    """40 frames are counted by their packets, and each that is asked for is the one that is read, wherever the reader
    was before.
    """
    path = write_video(tmp_path / f"v{suffix}", [coded(i) for i in range(40)], code)
    assert read_video(path).count == len(read_video(path).stamps) == 40
    for index in (39, 0, 20, 19, 21, 22, 1, 38):
        assert decoded(VideoFrame(path, index).read()) == divmod(index, 8)


def test_packets_that_do_not_say_what_is_shown(neu3d, monkeypatch):
    """Where decoded frames have other time stamps than packets, as in AVI files whose frames refer to later ones, all
    are decoded once to be counted, and those that are asked for are the right ones.
    """
    real = cv2.VideoCapture

    class Shifted:
        def __init__(self, path, backend, options=()):
            self.real, self.shift = real(path, backend, options), 0 if options else 1

        def get(self, name):
            value = self.real.get(name)
            last = self.shift and name == cv2.CAP_PROP_POS_MSEC and value > 160
            return 0.0 if last else value + 33 * self.shift if name == cv2.CAP_PROP_POS_MSEC else value

        def __getattr__(self, name):
            return getattr(self.real, name)

    monkeypatch.setattr(cv2, "VideoCapture", Shifted)
    file, told = (neu3d / "cam02.mp4", (0, 0), True), []
    video = video_decoding.walk(*file, report=told.append)
    assert (video["count"], video["stamps"]) == (FRAMES, [])
    for index in (4, 2, 5, 0, 3):
        assert decoded(video_decoding.frame(*file, index, report=told.append)) == (2, index)


def test_a_seek_that_ends_elsewhere_is_noticed(neu3d, monkeypatch):
    """A reader that seeks to another frame than asked for is not believed: its frames are decoded from the start."""
    real = cv2.VideoCapture

    class Careless:
        def __init__(self, *args):
            self.real = real(*args)

        def set(self, name, value):
            return self.real.set(name, max(0, value - 2) if name == cv2.CAP_PROP_POS_FRAMES else value)

        def __getattr__(self, name):
            return getattr(self.real, name)

    monkeypatch.setattr(cv2, "VideoCapture", Careless)
    monkeypatch.setattr(video_decoding, "_NEAR", 0)
    for index in (4, 2, 5, 0, 3):
        found = video_decoding.frame(neu3d / "cam02.mp4", (0, 1), True, index, report=lambda _: None)
        assert decoded(found) == (2, index)


def test_points_come_from_the_first_frame_of_training_cameras(neu3d, monkeypatch):
    """No other frame is decoded, and none of the camera that is held out."""
    read, real = set(), VideoFrame.read

    def recorded(frame):
        read.add((frame.path.stem, frame.index))
        return real(frame)

    monkeypatch.setattr(VideoFrame, "read", recorded)
    data = load(neu3d, test_cameras=("cam02",))
    for source in (data, data.split()[0]):
        read.clear()
        points, colors, words = initial_points(source, max_points=100)
        assert len(points) == len(colors) == 100
        assert "3 cameras" in words
        assert read == {("cam00", 0), ("cam01", 0), ("cam03", 0)}


def write_dnerf(folder, times):
    """Blender's layout with times: paths without a suffix, an image with alpha, a camera at a pose of its own each."""
    for split, values in times.items():
        frames = []
        for k, (view, time) in enumerate(zip(cameras(len(values)), values, strict=True)):
            path = folder / split / f"r_{k:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.dstack([coded(k), np.full((HEIGHT, WIDTH), 255, np.uint8)]))
            pose = c2w_to_opengl(view.c2w).tolist()
            frame = {"file_path": f"./{split}/r_{k:03d}", "rotation": 0.1, "transform_matrix": pose}
            frames.append(frame if time is None else frame | {"time": time})
        data = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(data))


def test_dnerf(tmp_path):
    """Each photograph has the time that its frame states, in whatever order, and views may share one; the files say
    which are for testing, and `times` leaves none out.
    """
    write_dnerf(tmp_path, {"train": (0.6, 0.0, 1.0, 0.6), "val": (0.3, 0.7), "test": (0.25, 0.75)})
    data = load(tmp_path, times=2)
    assert data.format == "transforms"
    train, test = data.split()
    assert [(view.name, view.camera.time) for view in train] == [
        ("train/r_000", 0.6),
        ("train/r_001", 0.0),
        ("train/r_002", 1.0),
        ("train/r_003", 0.6),
    ]
    assert [view.camera.time for view in test] == [0.25, 0.75]
    assert data.times == (0.0, 0.25, 0.3, 0.6, 0.7, 0.75, 1.0)
    assert data.is_dynamic
    assert data.camera_names == data.frames == ()
    for view, expected in zip(train, cameras(4), strict=True):
        np.testing.assert_allclose(view.camera.w2c, expected.w2c, atol=1e-12)
        np.testing.assert_allclose(view.camera.K, expected.K)
    assert decoded(train[2].image()) == (0, 2)
    # One camera at a time: points come from all of its views.
    assert "4 cameras" in initial_points(train, max_points=50)[2]


def test_transforms_of_synchronous_cameras(tmp_path, monkeypatch):
    """Frames with times in folders named as cameras are those of cameras, of which the first is held out; of these no
    image is opened, where one is for its size.
    """
    views = write_frames(tmp_path, count=3, numbers=(0, 1))
    frames = [
        {
            "file_path": f"cam{k:02d}/frame_{i:05d}.png",
            "transform_matrix": c2w_to_opengl(views[k].c2w).tolist(),
            "time": 0.5 * i,
        }
        for i in range(2)
        for k in range(3)
    ]
    top = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL}
    (tmp_path / "transforms.json").write_text(json.dumps(top | {"frames": frames}))
    data = load(tmp_path)
    assert data.camera_names == ("cam00", "cam01", "cam02")
    assert data.split_rule() == "camera cam00 held out at all times"
    assert {view.camera_name for view in load(tmp_path, test_cameras=("cam02",)).split()[1]} == {"cam02"}
    for k in range(3):
        for i in range(2):
            label = tmp_path / "semantic_class" / f"cam{k:02d}" / f"semantic_class_{i:04d}.png"
            label.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(label), np.full((HEIGHT, WIDTH), 1 + k + 3 * i, np.uint8))
    for view in load(tmp_path).views:
        assert int(view.labels()[0, 0]) == 1 + int(view.camera_name[3:]) + 3 * int(view.name[-1])
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    for options, first in (({}, "cam01"), ({"test_cameras": ("cam01", "cam00")}, "cam02")):
        with monkeypatch.context() as patch:
            opened = []
            patch.setattr(transforms, "image_size", lambda path, opened=opened: opened.append(path) or (WIDTH, HEIGHT))
            load(tmp_path, lazy=True, semantics=False, **options)
        assert opened == [tmp_path / first / "frame_00000.png"]
    still = [{key: value for key, value in frame.items() if key != "time"} for frame in frames]
    (tmp_path / "transforms.json").write_text(json.dumps(top | {"frames": still}))
    assert load(tmp_path).camera_names == ()


def test_times_that_cannot_be(tmp_path, caplog):
    """A view without a time among others is refused, a test view after all training views told of; views of one time
    stand still, with no word about those without.
    """
    write_dnerf(tmp_path, {"train": (0.0, None, 1.0), "test": (0.5,)})
    with pytest.raises(ValueError, match=r"1 have none \(as view 'train/r_001'\); state all"):
        load(tmp_path)
    write_dnerf(tmp_path, {"train": (0.0, 0.5, 1.0), "test": (0.5, 1.5)})
    assert load(tmp_path).is_dynamic
    assert "1 of the 2 test views are before or after all training views (0 to 1), as 'test/r_001'" in caplog.text
    write_dnerf(tmp_path, {"train": (0.5, 0.5, 0.5), "test": (None,)})
    assert not load(tmp_path).is_dynamic
    with pytest.raises(ValueError, match="test_cameras must be left out where views are of no named cameras"):
        load(tmp_path, test_cameras=("r_000",))


def write_frames(folder, count=4, numbers=range(FRAMES), digits=5):
    """A folder of frames a camera, and the cameras."""
    for k in range(count):
        for i in numbers:
            path = folder / f"cam{k:02d}" / f"frame_{i:0{digits}d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), coded(i, k))
    return cameras(count)


def write_model(folder, views, names, tracks=()):
    """A COLMAP model with an image of each view, and points seen by the images of `tracks` (indices)."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
        )
    )
    for index, (view, name) in enumerate(zip(views, names, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.ones(2)) for _ in tracks])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view.w2c[:3, :3]), view.w2c[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, pose)
    for place, seen in enumerate(tracks):
        elements = [pycolmap.TrackElement(image_id=index + 1, point2D_idx=place) for index in seen]
        reconstruction.add_point3D([float(place), 0, 0], pycolmap.Track(elements=elements), [255, 0, 51])
    folder.mkdir(parents=True)
    reconstruction.write_binary(folder)


@pytest.mark.parametrize(
    ("place", "name"),
    [("sparse/0", "cam{:02d}.png"), ("sparse", "cam{:02d}/frame_00000.png"), ("sparse_", "image{}.jpg")],
)
def test_folders_of_frames(tmp_path, place, name):
    """Frames by camera, with the pose of the image that COLMAP calls like it; points are those that two cameras show
    that are not held out.
    """
    views = write_frames(tmp_path)
    tracks = [(0, 1), (1, 2, 3), (0, 3), (2, 3), (0, 1, 3)]
    # COLMAP's numbers are in another order than the cameras' names.
    order = [2, 0, 3, 1]
    tracks = [[order.index(k) for k in seen] for seen in tracks]
    write_model(tmp_path / place, [views[k] for k in order], [name.format(k) for k in order], tracks)
    data = load(tmp_path)
    assert data.format == "cameras"
    assert [view.name for view in data.views] == [f"cam{k:02d}/{i:04d}" for k in range(4) for i in range(FRAMES)]
    assert data.split_rule() == "camera cam00 held out at all times"
    assert data.times == tuple(i / 5 for i in range(FRAMES))
    for index, view in enumerate(data.views):
        np.testing.assert_allclose(view.camera.w2c, views[index // 6].w2c, atol=1e-12)
    assert decoded(data.views[15].image()) == (2, 3)
    np.testing.assert_allclose(sorted(data.points[:, 0]), [1, 3, 4])
    np.testing.assert_allclose(data.colors, [[1, 0, 0.2]] * 3, atol=1e-6)
    assert data.point_source == f"COLMAP model {place}, 3 points of 3 cameras"
    assert len(load(tmp_path, test_cameras=()).points) == 5
    assert load(tmp_path, points=False, times=3).frames == (0, 2, 5)


def test_a_model_says_which_photographs_show_a_point(tmp_path):
    """Tracks are kept by the names of photographs, in the order of the points; a photograph without one has none."""
    tracks = [(0, 1), (1, 2), (0, 2, 1)]
    names = [f"{k}.png" for k in "cabd"]  # COLMAP's numbers are in another order than the names
    write_model(tmp_path / "sparse", cameras(4), names, tracks)
    (tmp_path / "images").mkdir()
    for name in names:
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    data = load(tmp_path)
    assert {name: list(shown) for name, shown in data.tracks[1].items()} == {
        "c": [0, 2],
        "a": [0, 1, 2],
        "b": [1, 2],
        "d": [],
    }
    np.testing.assert_allclose(data.tracks[0], data.points)
    assert load(tmp_path, points=False).tracks is None


def test_cameras_that_move(tmp_path):
    """Where a model has other poses for later frames of a camera, the first one is not taken for all of them."""
    write_frames(tmp_path, count=2, numbers=(0, 1))
    names = [f"cam{k:02d}/frame_{i:05d}.png" for k in range(2) for i in range(2)]
    views = cameras(2)
    write_model(tmp_path / "sparse", [views[0], views[0], views[1], views[1]], names)
    assert len(load(tmp_path).views) == 4
    shutil.rmtree(tmp_path / "sparse")
    write_model(tmp_path / "sparse", cameras(), names)
    told = "cam00 has other poses in cam00/frame_00000.png and cam00/frame_00001.png; move the folders into images/"
    assert told in refused(tmp_path)
    for name in ("cam00", "cam01"):
        (tmp_path / "images").mkdir(exist_ok=True)
        (tmp_path / name).rename(tmp_path / "images" / name)
    for view, camera in zip(load(tmp_path).views, cameras(), strict=True):
        np.testing.assert_allclose(view.camera.w2c, camera.w2c, atol=1e-12)


def test_numbers_of_frames_may_be_times_of_a_clock(tmp_path):
    """Nanoseconds are told apart by all of their digits; names without a number at their end are refused."""
    views, stamps = cameras(2), (1_699_999_999_900_000_000, 1_700_000_000_000_000_000, 1_700_000_000_400_000_000)
    write_frames(tmp_path, count=2, numbers=stamps)
    write_model(tmp_path / "sparse", views, ["cam00.png", "cam01.png"])
    data = load(tmp_path)
    assert data.frames == stamps
    np.testing.assert_allclose(data.times, (0, 0.2, 1))
    for file in sorted(tmp_path.glob("cam*/*.png")):
        file.rename(file.with_stem(f"{file.stem}_left"))
    assert "cam00: must hold frames whose names end in their number" in refused(tmp_path)


def write_train_meta(folder, views, times=FRAMES, name="train_meta.json", first=0, **changed):
    """Dynamic 3D Gaussians' layout; `first` is the number of the first camera."""
    rows = [[f"{first + k}/{i:06d}.png" for k in range(len(views))] for i in range(times)]
    for i in range(times):
        for k in range(len(views)):
            path = folder / "ims" / rows[i][k]
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), coded(i, first + k))
    data = {
        "w": WIDTH,
        "h": HEIGHT,
        "k": [[view.K.tolist() for view in views]] * times,
        "w2c": [[view.w2c.tolist() for view in views]] * times,
        "fn": rows,
        "cam_id": [[first + k for k in range(len(views))]] * times,
        **changed,
    }
    (folder / name).write_text(json.dumps(data))


def test_train_meta(tmp_path):
    """A view a camera and time, with the pose of the list, and the points of the archive; the first camera is held out
    unless another file has cameras for testing.
    """
    views = cameras(5)
    write_train_meta(tmp_path, views[:3])
    rows = np.c_[np.random.default_rng(0).uniform(-0.2, 0.2, (7, 3)), np.full((7, 3), 0.5), np.ones(7)]
    np.savez(tmp_path / "init_pt_cld.npz", data=rows)
    data = load(tmp_path, times=3)
    assert data.format == "train_meta"
    assert [view.name for view in data.views] == [f"{k}/{i:04d}" for k in range(3) for i in (0, 2, 5)]
    assert data.times == (0.0, 0.4, 1.0)
    assert data.split_rule() == "camera 0 held out at all times"
    assert decoded(data.views[4].image()) == (1, 2)
    np.testing.assert_allclose(data.views[4].camera.w2c, views[1].w2c, atol=1e-12)
    np.testing.assert_allclose(data.points, rows[:, :3])
    write_train_meta(tmp_path, views[3:], name="test_meta.json", first=3)
    data = load(tmp_path / "train_meta.json")
    assert data.split_rule() == "as the data set's files say"
    assert {view.camera_name for view in data.split()[1]} == {"3", "4"}
    assert {view.camera_name for view in load(tmp_path, test_cameras=("1",)).split()[1]} == {"1"}


@pytest.mark.parametrize("points", [True, False])
def test_w2c_the_wrong_way_round(tmp_path, points):
    """Matrices from camera to world are refused, because the points are not where cameras look, or without points,
    because cameras do not look at one place.
    """
    views = cameras()
    if points:
        np.savez(tmp_path / "init_pt_cld.npz", data=np.c_[np.eye(3) * 0.1, np.ones((3, 4))])
    write_train_meta(tmp_path, views)
    load(tmp_path)
    write_train_meta(tmp_path, views, w2c=[[view.c2w.tolist() for view in views]] * FRAMES)
    with pytest.raises(ValueError, match=r"w2c must be world to camera: so, \d+% of the .*; invert the matrices"):
        load(tmp_path)


def test_the_fly(data_dir):
    """w2c of the real data is world to camera: tracked 3D points lie where 2D points of the images are, which are on a
    grid of 7.5 pixels, so that half of them are more than 2.5 pixels away at best.
    """
    folder = data_dir / "fly"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    data, tracked = load(folder, lazy=True), np.load(folder / "points.npz")
    assert (len(data.views), len(data.times), data.camera_names) == (105, 15, tuple("0123456"))
    errors = []
    for view in data.views:
        camera, time = map(int, view.name.split("/"))
        found = tracked["points2d"][camera, time]
        pixels, _ = view.camera.project(tracked["points3d"][time])
        seen = (found != 0).all(axis=1)
        errors.append(np.linalg.norm(pixels - found[:, ::-1] * (960, 480), axis=1)[seen])
    assert np.median(np.concatenate(errors)) < 4


def write_semantics(folder, label="{}/semantic_class_{:04d}.png", feature="cam{:02d}_{:04d}_fmap_CxHxW.pt"):
    """Labels and maps of every frame of the four videos, both with numbers that say which."""
    for k in range(4):
        for i in range(FRAMES):
            path = folder / "semantic_class" / label.format(f"cam{k:02d}", i)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 1 + (k + i) % 3, np.uint8))
            path = folder / "rgb_feature_langseg" / feature.format(k, i)
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.save(torch.full((2, 3, 4), float(10 * k + i)), path)
    names = [{"id": 1, "name": "table"}, {"id": 2, "name": "tongs"}, {"id": 3, "name": "ball"}]
    (folder / "classes.json").write_text(json.dumps({"classes": names}))
    np.save(folder / "text_embeddings.npy", np.eye(3, 2, dtype=np.float32) + 0.1)
    (folder / "moving_classes.json").write_text(json.dumps(["ball", "tongs"]))


@pytest.mark.parametrize(
    ("label", "feature"),
    [
        ("{}/semantic_class_{:04d}.png", "cam{:02d}_{:04d}_fmap_CxHxW.pt"),
        ("{}/{:d}.png", "cam{:02d}/{:04d}_fmap_2x3x4.pt"),
        ("{}_{:04d}.png", "cam{:02d}/frame_{:05d}_fmap_CxHxW.pt"),
    ],
)
def test_labels_and_maps_of_cameras_and_times(neu3d, tmp_path, label, feature):
    """Each frame has the label image and the map of its camera and its number in the video, also where not all frames
    are used; a file says which classes move.
    """
    shutil.copytree(neu3d, tmp_path, dirs_exist_ok=True)
    write_semantics(tmp_path, label, feature)
    write_image = tmp_path / "semantic_class" / "cam00" / "vis_semantic_class_0000.png"  # a picture, no label
    write_image.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(write_image), coded(1))
    data = load(tmp_path, times=3)
    assert data.semantics.moving == ("ball", "tongs")
    assert len(data.semantics.maps) == len(data.semantics.label_images) == 12
    for view in data.views:
        camera, index = int(view.camera_name[3:]), view.frame.index
        assert float(view.teacher().mean()) == 10 * camera + index
        assert set(np.unique(view.labels())) == {1 + (camera + index) % 3}
    (tmp_path / "moving_classes.json").write_text('["ball", "cup"]')
    with pytest.raises(
        ValueError, match=r"moving_classes\.json: must name classes of .*classes\.json, got 'cup'; corr"
    ):
        load(tmp_path)


def test_two_labels_of_one_frame(neu3d, tmp_path):
    """Which one counts is not guessed."""
    shutil.copytree(neu3d, tmp_path, dirs_exist_ok=True)
    write_semantics(tmp_path)
    cv2.imwrite(str(tmp_path / "semantic_class" / "cam01" / "0003.png"), np.ones((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(ValueError, match="must be the only one of its frame, .*; remove one") as error:
        load(tmp_path)
    assert "\n" not in str(error.value)


def test_segments_say_what_moves(tmp_path):
    """Dynamic 3D Gaussians' `seg` becomes labels, whose class 1 moves; nothing of a view is masked."""
    write_train_meta(tmp_path, cameras(3), times=2)
    for path in sorted((tmp_path / "ims").rglob("*.png")):
        target = tmp_path / "seg" / path.relative_to(tmp_path / "ims")
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), (np.indices((HEIGHT, WIDTH))[1] < 10).astype(np.uint8))
    data = load(tmp_path)
    assert data.semantics.moving == ("1",)
    assert data.views[3].label_path == tmp_path / "seg" / "1" / "000001.png"
    assert data.views[3].labels().sum() == 10 * HEIGHT
    assert data.views[3].mask() is None


def test_points_of_a_model_of_the_first_frame(neu3d, tmp_path, caplog):
    """Beside videos, a COLMAP model whose images are named by the cameras gives the points that two training cameras
    show; one with other poses is told of and left out.
    """
    shutil.copytree(neu3d, tmp_path, dirs_exist_ok=True)
    names, tracks = [f"cam{k:02d}.png" for k in range(4)], [(0, 1), (1, 2, 3), (0, 3), (2, 3)]
    write_model(tmp_path / "frame0" / "sparse" / "0", cameras(), names, tracks)
    data = load(tmp_path)
    assert data.format == "neu3d"
    np.testing.assert_allclose(sorted(data.points[:, 0]), [1, 3])
    assert data.point_source == "COLMAP model frame0/sparse/0, 2 points of 3 cameras"
    np.testing.assert_allclose(sorted(load(tmp_path, test_cameras=("cam03",)).points[:, 0]), [0, 1])
    assert load(tmp_path, points=False).points is None
    assert not caplog.text
    shutil.rmtree(tmp_path / "frame0")
    one = shutil.copytree(neu3d, tmp_path / "one", ignore=shutil.ignore_patterns("cam0[123]*"))
    write_poses(one, cameras()[:1])
    write_model(one / "sparse", cameras()[:1], names[:1])
    load(one)
    assert "another pose" not in caplog.text
    write_model(tmp_path / "sparse" / "0", cameras()[::-1], names, tracks)
    assert load(tmp_path).points is None
    assert "sparse/0: has another pose of cam00 than the data set; its points are left out" in caplog.text


# ------------------------------------------------------------------------------------------------ bad input


def refused(folder, kind=ValueError, **options):
    """The one line in which a data set is refused."""
    with pytest.raises(kind) as error:
        load(folder, **options)
    text = str(error.value)
    assert "\n" not in text
    assert ": " in text
    assert "; " in text
    return text


@pytest.fixture
def copied(neu3d, tmp_path):
    """The four videos and their poses, to be changed."""
    return shutil.copytree(neu3d, tmp_path / "data")


def test_poses_for_another_number_of_cameras(copied, caplog):
    """Rows name no video, so that a missing one would give all others wrong poses; so would names in another order than
    that of their numbers, which is told.
    """
    (copied / "cam01.mp4").unlink()
    assert "got 4 rows and 3 videos" in refused(copied)
    for name in ("cam02", "cam03"):
        (copied / f"{name}.mp4").rename(copied / f"{name.replace('0', '')}.mp4")
    write_poses(copied, cameras(3))
    shutil.copy(copied / "cam3.mp4", copied / "cam10.mp4")
    (copied / "cam00.mp4").unlink()
    load(copied)
    assert "rows are those of cam10, cam2, cam3, ..., in the order of the letters" in caplog.text
    (copied / "cam10.mp4").rename(copied / "camera.avi")
    (copied / "camera.avi").write_bytes(b"")
    assert "camera.avi: must be a video" in refused(copied)


def test_names_of_other_systems(copied, tmp_path):
    """Letters of either case, spaces, accents and links; a name that no file can have is that of a missing one."""
    for k in range(4):
        (copied / f"cam{k:02d}.mp4").rename(copied / f"Cam {k} \u00e9.MP4")
    (copied / "Cam 1 \u00e9.MP4").rename(tmp_path / "x.mp4")
    (copied / "Cam 1 \u00e9.MP4").symlink_to(tmp_path / "x.mp4")
    data = load(copied, test_cameras=("Cam 2 \u00e9",))
    assert data.split_rule() == "camera Cam 2 \u00e9 held out at all times"
    assert decoded(data.views[FRAMES + 1].image()) == (1, 1)
    names = [["a" * 1000 + ".png", "1/000000.png", "2/000000.png", "3/000000.png"]]
    write_train_meta(tmp_path, cameras(), times=1, fn=names)
    assert [view.name for view in load(tmp_path).absent] == ["0/0000"]


def test_a_video_that_is_turned(copied):
    """Phones state a quarter turn in the header: the size is that of the frames as they are shown."""
    path = copied / "cam02.mp4"
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    assert data[start : start + 4] == (1 << 16).to_bytes(4, "big")
    data[start : start + 20] = struct.pack(">5i", 0, 1 << 16, 0, -(1 << 16), 0)
    path.write_bytes(data)
    assert (read_video(path).width, read_video(path).height) == (HEIGHT, WIDTH)
    assert VideoFrame(path, 1).read().shape == (WIDTH, HEIGHT, 3)
    assert "must have the shape of its camera (32x24), got 24x32" in refused(copied)


def test_videos_of_different_length(copied, caplog):
    """What all of them show is used, and told; `strict` refuses."""
    write_video(copied / "cam02.mp4", [coded(i, 2) for i in range(4)])
    data = load(copied)
    assert data.frames == (0, 1, 2, 3)
    assert data.times[-1] == 1.0
    assert "different length (cam02.mp4 has 4 frames, cam00.mp4 6); frames from 4 on are left out" in caplog.text
    assert "videos must be of one length" in refused(copied, strict=True)


def test_videos_of_different_rates(copied, caplog):
    """Frames of one number would not be of one time: this is told."""
    load(copied)
    assert not caplog.text
    write_video(copied / "cam02.mp4", [coded(i, 2) for i in range(FRAMES)], rate=60)
    load(copied)
    assert "videos must have one frame rate, 6 frames take 83 ms in cam02.mp4 and 167 ms in cam00.mp4" in caplog.text


def test_a_video_of_another_shape(copied):
    """Its focal length would belong to nothing; one of another size alone is calibrated for that size."""
    write_video(copied / "cam02.mp4", [np.zeros((HEIGHT, HEIGHT, 3), np.uint8)] * FRAMES)
    assert "camera cam02" in refused(copied)
    write_video(copied / "cam02.mp4", [np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)] * FRAMES)
    np.testing.assert_allclose(load(copied).views[13].camera.K[0], [2 * FOCAL, 0, WIDTH])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "begins as none of them"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
        (b"#EXTM3U\n#EXTINF:10,\nfile:///etc/passwd\n", "begins as none of them"),
        (b"\0\0\0\x18ftypmp42" + bytes(400), "could not be opened"),
        (b"\x1aE\xdf\xa3" + bytes(400), "could not be opened"),
    ],
)
def test_what_is_no_video(copied, content, told, capfd):
    """It is named, in one line, and nothing of the decoder's gets through; a playlist is not followed."""
    (copied / "cam02.mp4").write_bytes(content)
    text = refused(copied)
    assert "cam02.mp4: " in text
    assert told in text
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("suffix", "code"), [(".avi", "MJPG"), (".mkv", "mp4v"), (".webm", "VP80")])
def test_a_video_that_ends_early(copied, suffix, code, capfd):
    """One whose index was at the end cannot be opened; one whose frames are missing has fewer than its header claims.
    Nothing of the decoder's gets through.
    """
    data = (copied / "cam02.mp4").read_bytes()
    (copied / "cam02.mp4").write_bytes(data[: len(data) // 2])
    assert "cam02.mp4: must be a video, could not be opened" in refused(copied)
    (copied / "cam02.mp4").unlink()
    path = write_video(copied / f"cam02{suffix}", [coded(i) for i in range(40)], code)
    capfd.readouterr()  # what the writer had to say
    path.write_bytes(path.read_bytes()[: 6 * path.stat().st_size // 10])
    assert "must hold the 40 frames that its header claims, holds" in refused(copied)
    assert capfd.readouterr().err == ""


def test_the_size_in_a_header_is_not_believed(copied):
    """10^10 pixels, in the stream's header and in the file's, are not the size that the frames have."""
    path = write_video(copied / "cam02.avi", [coded(i) for i in range(FRAMES)], "MJPG")
    (copied / "cam02.mp4").unlink()
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"avih", 8 + 32), (b"strf", 8 + 4)):
        start = data.index(mark) + offset
        assert int.from_bytes(data[start : start + 4], "little") == WIDTH
        data[start : start + 8] = (10**5).to_bytes(4, "little") * 2
    path.write_bytes(data)
    view = load(copied).views[2 * FRAMES + 3]
    assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
    assert decoded(view.image()) == (0, 3)


@pytest.mark.parametrize("claim", [2**31 - 1, 2])
def test_the_number_of_frames_in_a_header_is_not_believed(tmp_path, claim):
    """Too many are refused before anything is made for them; too few are counted."""
    path = write_video(tmp_path / "a.avi", [coded(i) for i in range(FRAMES)], "MJPG")
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"avih", 8 + 16), (b"strh", 8 + 32)):  # dwTotalFrames and dwLength
        start = data.index(mark) + offset
        assert int.from_bytes(data[start : start + 4], "little") == FRAMES
        data[start : start + 4] = claim.to_bytes(4, "little")
    path.write_bytes(data)
    if claim == 2:
        assert read_video(path).count == FRAMES
        assert decoded(VideoFrame(path, 5).read()) == (0, 5)
    else:
        with pytest.raises(ValueError, match="must hold the 2147483647 frames that its header claims, holds 6"):
            read_video(path)


def test_a_damaged_frame(copied):
    """A frame that cannot be decoded is refused by its number, as is one beyond the end."""
    path = write_video(copied / "cam02.avi", [coded(i, 2) for i in range(FRAMES)], "MJPG")
    data = bytearray(path.read_bytes())
    starts = [i for i in range(len(data)) if data[i : i + 4] == b"00dc" and data[i + 8 : i + 10] == b"\xff\xd8"]
    assert len(starts) == FRAMES
    data[starts[3] + 8 : starts[4]] = bytes(starts[4] - starts[3] - 8)
    path.write_bytes(data)
    (copied / "cam02.mp4").unlink()
    assert re.search(r"cam02\.avi: frame 3 of 6 must be decoded, could not be \(.+\); it is truncated", refused(copied))
    with pytest.raises(ValueError, match="frame 6 must be there, the video has 6"):
        VideoFrame(copied / "cam01.mp4", 6).read()


@pytest.mark.parametrize("times", [0, -1, 2.5, True, "all", None])
def test_a_number_of_times_that_cannot_be(neu3d, times):
    """In one line, before anything is read."""
    assert "times must be a whole number >= 1" in refused(neu3d, times=times)
    with pytest.raises(ValueError, match="fit: times must be a whole number"):
        FitConfig().replace(times=times)


def test_frames_that_are_missing(tmp_path, caplog):
    """A frame that one camera lacks is absent, and times stay those of the others; `strict` refuses. Frames of several
    sizes in one camera are refused, two of one number, and a camera without a pose.
    """
    views = write_frames(tmp_path)
    names = [f"cam{k:02d}.png" for k in range(4)]
    write_model(tmp_path / "sparse_", views, names)
    (tmp_path / "cam02" / "frame_00003.png").unlink()
    (tmp_path / "cam01" / "notes.txt").write_text("no frame")
    data = load(tmp_path)
    assert [view.name for view in data.absent] == ["cam02/0003"]
    assert len(data.views) == 23
    assert data.times == tuple(i / 5 for i in range(FRAMES))
    assert "1 of the 24 images that it lists are not there" in caplog.text
    assert "cam02/frame_00003.png" in refused(tmp_path, FileNotFoundError, strict=True)
    cv2.imwrite(str(tmp_path / "cam02" / "frame_00003.png"), np.zeros((HEIGHT * 2, WIDTH * 2, 3), np.uint8))
    assert "must be 32x24 pixels as the other frames of camera cam02, got 64x48" in refused(tmp_path)
    (tmp_path / "cam02" / "frame_00003.png").rename(tmp_path / "cam02" / "f_2.png")
    assert "must be the only frame 2 of its camera" in refused(tmp_path)
    (tmp_path / "cam02" / "f_2.png").unlink()
    shutil.rmtree(tmp_path / "sparse_")
    write_model(tmp_path / "sparse_", views[:3], names[:3])
    assert load(tmp_path).camera_names == ("cam00", "cam01", "cam02")
    assert "has no image of 1 of the 4 cameras (cam03); going on without them" in caplog.text
    assert "name its images by their cameras" in refused(tmp_path, FileNotFoundError, strict=True)
    shutil.rmtree(tmp_path / "sparse_")
    write_model(tmp_path / "sparse_", views, ["a.png", "b.png", "c.png", "d.png"])
    assert "must have images named by their cameras" in refused(tmp_path)


@pytest.mark.parametrize("layout", ["frames", "train_meta"])
def test_frames_that_are_damaged(tmp_path, caplog, layout):
    """As those that are missing, of a folder a camera and of Dynamic 3D Gaussians' list; lazily none is looked at."""
    if layout == "frames":
        write_model(tmp_path / "sparse_", write_frames(tmp_path), [f"cam{k:02d}.png" for k in range(4)])
        damaged, name = tmp_path / "cam02" / "frame_00003.png", "cam02/0003"
    else:
        write_train_meta(tmp_path, cameras(4))
        damaged, name = tmp_path / "ims/2/000003.png", "2/0003"
    damaged.write_bytes(damaged.read_bytes()[:60])
    data = load(tmp_path)
    assert [view.name for view in data.absent] == [name]
    assert len(data.views) == 23
    assert data.times == tuple(i / 5 for i in range(FRAMES))
    assert "1 of the 24 images that it lists are damaged" in caplog.text
    assert "all must be there" in refused(tmp_path, FileNotFoundError, strict=True)
    assert len(load(tmp_path, lazy=True).views) == 24


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"k": []}, "k, w2c, fn and cam_id must be lists of one length by time, got k 0, w2c 2"),
        ({"cam_id": [[0, 1]] * 2}, "time 0: k, w2c, fn and cam_id must name the same cameras"),
        ({"cam_id": [[0, 1, 1]] * 2}, "time 0, camera 1: must be there once"),
        ({"cam_id": [["a", 1, 2]] * 2}, "cam_id[0][0] must be a whole number"),
        ({"fn": [["../a.png", "1/0.png", "2/0.png"]] * 2}, "fn must name an image inside ims"),
        ({"w2c": [[np.eye(3).tolist()] * 3] * 2}, "w2c must be 4x4 finite numbers"),
        ({"w2c": [[(2 * np.eye(4)).tolist()] * 3] * 2}, "camera 0"),
        ({"k": [[[[1, 0, "x"]] * 3] * 3] * 2}, "k must be 3x3 finite numbers"),
        ({"w": 10**9}, "camera 0"),
        ({"h": -4}, "camera 0"),
        ({"fn": 3}, "fn must be a list"),
        ({key: [[], []] for key in ("k", "w2c", "fn", "cam_id")}, "must list at least one camera"),
    ],
)
def test_lists_that_cannot_be(tmp_path, changed, told):
    """What is wrong is named by its place in the file."""
    write_train_meta(tmp_path, cameras(3), times=2, **changed)
    text = refused(tmp_path)
    assert "train_meta.json" in text
    assert told in text


def test_points_that_are_none(tmp_path):
    """An archive that is none, or has other arrays, or claims more than it holds, is named."""
    write_train_meta(tmp_path, cameras(3), times=2)
    path = tmp_path / "init_pt_cld.npz"
    for write in (
        lambda: path.write_bytes(b"PK\x03\x04 no archive"),
        lambda: np.savez(path, other=np.zeros((3, 7))),
        lambda: np.savez(path, data=np.zeros(7)),
        lambda: np.savez(path, data=np.array([{}])),
        lambda: np.savez(path, data=np.full((3, 7), np.nan)),
    ):
        write()
        assert "init_pt_cld.npz" in refused(tmp_path)
    write_train_meta(tmp_path, cameras(3), times=2, name="test_meta.json", first=1)
    assert "must have other cameras than train_meta.json, 1 is in both" in refused(tmp_path, points=False)


def test_what_is_almost_a_data_set(neu3d, tmp_path):
    """Videos or frames without poses, and videos of other names, are told what they lack; the file of poses may be
    named itself.
    """
    assert len(load(neu3d / "poses_bounds.npy").views) == 4 * FRAMES
    write_video(tmp_path / "take1.mp4", [coded(0)])
    assert "found 1 videos without; write poses_bounds.npy" in refused(tmp_path, FileNotFoundError)
    write_poses(tmp_path, cameras(1))
    assert "must be named cam00.mp4, cam01.mp4, ..., got take1.mp4" in refused(tmp_path, FileNotFoundError)
    write_frames(tmp_path / "frames", count=2, numbers=(0,))
    assert "found frames of 2 cameras (cam00, ...) without; run COLMAP" in refused(
        tmp_path / "frames", FileNotFoundError
    )


@pytest.mark.parametrize(
    ("spoil", "options", "told"),
    [
        (lambda p: write_video(p / "cam02.mp4", [coded(0)] * 2), "--strict", "videos must be of one length"),
        (lambda p: (p / "cam02.mp4").write_bytes((p / "cam02.mp4").read_bytes()[:600]), "", "cam02.mp4: must be"),
        (lambda p: write_poses(p, cameras(5)), "", "got 5 rows and 4 videos"),
        (lambda p: write_dnerf(p, {"train": (0.0, float("nan"), 1.0)}), "", "time must be a finite number"),
        (lambda p: write_dnerf(p, {"train": (0.0, None, 1.0)}), "", "must have a time, 1 have none"),
        (lambda p: None, "--times 0", "times must be a whole number"),
        (lambda p: None, "--poses auto", "poses must be fixed where things move, got auto"),
        (lambda p: None, "--transients mask", "transients must be keep where things move, got mask"),
        (lambda p: None, "--test-cameras cam00,cam9", "must be among cam00, cam01, cam02, cam03, got 'cam9'"),
    ],
)
def test_fit_refuses(copied, spoil, options, told, capsys):
    """One line on stderr, exit code 2, and nothing written."""
    spoil(copied)
    before = sorted(copied.parent.rglob("*"))
    assert cli.main(["fit", str(copied), "-o", str(copied.parent / "run"), "--quiet", *options.split()]) == 2
    text = capsys.readouterr().err
    assert told in text
    assert text.count("\n") == 1
    assert sorted(copied.parent.rglob("*")) == before


@pytest.mark.parametrize("late", [0, 10, -6])
def test_a_camera_that_is_out_of_step_is_named(tmp_path, caplog, late):
    """Something that moves at changing speed, seen by four cameras, one of which starts ten frames late or six early:
    a fit warns of that one with the shift, to a frame, and of none where all are in step.
    """
    speed = np.convolve(np.random.default_rng(0).uniform(0, 1, 80), np.ones(5) / 5, "same") ** 3
    angle = 12 * np.cumsum(speed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for k in range(4):
        places = angle[np.arange(20, 60) + (late if k == 2 else 0)] + k
        shown = [np.hypot(x - 16 - 9 * np.sin(a), y - 12 - 7 * np.cos(a)) < 4 for a in places]
        write_video(tmp_path / f"data/cam{k:02d}.mp4", [np.repeat(200 * np.uint8(d)[..., None], 3, 2) for d in shown])
    write_poses(tmp_path / "data", cameras())
    if late == 10:
        words = ["fit", str(tmp_path / "data"), "-o", str(tmp_path / "run"), "--max-steps", "1", "--no-report"]
        assert cli.main([*words, "--for", "fast", "--max-gaussians", "500", "--quiet"]) == 0
    else:
        dataset = load(tmp_path / "data")
        warn_of_late_cameras(dataset, load_frames(dataset.views, WIDTH * HEIGHT))
    said = [line for line in caplog.messages if "seems to start" in line]
    if not late:
        assert not said
        return
    (line,) = said
    count = int(re.search(r"camera cam02 seems to start (\d+) frames ", line)[1])
    assert abs(count - abs(late)) <= 1
    assert ("late:" in line and "of the other cameras, or" in line) == (late > 0)
