"""Random damage: every reader takes a changed file or refuses it in one line that names the file, and never crashes."""

from __future__ import annotations

import json
import random
import warnings
import zlib

import numpy as np
import pytest
import torch
from mutations import damaged_bytes, damaged_json
from test_data import write_colmap, write_image, write_llff, write_transforms
from test_dynamic_data import cameras, coded, write_poses, write_train_meta, write_video

from drgs.cameras import orbit
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.data.images import read_image
from drgs.data.point_ply import read_point_ply
from drgs.files import Run, load_ply, load_state, save_ply, save_state
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.frames import Frame
from drgs.fitting.records import check_checkpoint, fitted_views
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.io.journal import SCHEMA


def attempt(read, path, versions) -> None:
    """Read each damaged version of a file; count what was refused."""
    refused, unclear = 0, []
    for data in versions:
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # an overflow that NumPy reports is a value that should be refused
                read()
        except (ValueError, OSError, NotImplementedError) as error:
            refused += 1
            is_clear = "\n" not in str(error) and str(path.parent.parent) in str(error)
            if isinstance(error, UnicodeError) or not is_clear:
                unclear.append((error, data[:400]))
    assert not unclear
    assert refused, "damage that no reader notices shows nothing"


def looked_at(dataset) -> None:
    """Use what a data set says as commands do."""
    dataset.split()
    for view in dataset.views:
        camera = view.camera.undistorted().resized(4, 4)
        assert np.isfinite(camera.c2w).all()
        if view.is_checked:
            view.image(4, 4), view.mask(4, 4), view.depth(4, 4)


@pytest.fixture
def damage():
    """The damage of this test, the same in every run."""
    return random.Random(7)


def test_cameras_json(tmp_path, damage):
    """200 edits of a camera list."""
    path = tmp_path / "cameras.json"
    save_cameras_json(path, orbit((0, 0, 0), 3.0, 3, width=8, height=6))
    good = json.loads(path.read_text())
    attempt(lambda: load_cameras_json(path), path, (damaged_json(good, damage) for _ in range(200)))


@pytest.mark.parametrize("lens", ["OPENCV", "OPENCV_FISHEYE", None])
def test_transforms(tmp_path, damage, lens):
    """100 edits each of a calibrated, a fisheye and a Blender data set, opened or not."""
    write_image(tmp_path / "m.png", np.ones((16, 24), np.uint8))
    files = {"mask_path": "m.png", "depth_file_path": "m.png"}
    blender = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h")) | {"camera_angle_x": 0.7}
    top = {"camera_model": lens, "k1": 0.01, "depth_unit_scale_factor": 0.1} if lens else blender
    good = write_transforms(tmp_path, count=4, extra=files, **top)
    for lazy in (False, True):
        versions = (damaged_json(good, damage) for _ in range(50))
        attempt(lambda lazy=lazy: looked_at(load(tmp_path, lazy=lazy)), tmp_path / "transforms.json", versions)


def test_train_meta(tmp_path, damage):
    """60 edits of the lists of Dynamic 3D Gaussians, opened or not."""
    write_train_meta(tmp_path, cameras(3), times=2)
    path = tmp_path / "train_meta.json"
    good = json.loads(path.read_text())
    for lazy in (False, True):
        versions = (damaged_json(good, damage) for _ in range(30))
        attempt(lambda lazy=lazy: looked_at(load(tmp_path, lazy=lazy)), path, versions)


@pytest.mark.parametrize(("suffix", "code"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".mkv", "mp4v")])
def test_videos(tmp_path, damage, suffix, code):
    """25 versions of one video of three."""
    paths = [write_video(tmp_path / f"cam{k}{suffix}", [coded(i, k) for i in range(4)], code) for k in range(3)]
    write_poses(tmp_path, cameras(3))
    whole = paths[1].read_bytes()
    attempt(lambda: looked_at(load(tmp_path)), paths[1], (damaged_bytes(whole, damage) for _ in range(25)))


@pytest.mark.parametrize("text", [False, True])
def test_colmap(tmp_path, damage, text):
    """25 damaged versions of each file of a model."""
    for path in sorted(write_colmap(tmp_path, text).iterdir()):
        whole = path.read_bytes()
        attempt(lambda: looked_at(load(tmp_path, lazy=True)), path, (damaged_bytes(whole, damage) for _ in range(25)))
        path.write_bytes(whole)


def test_llff(tmp_path, damage):
    """150 damaged versions, most of them in the header."""
    write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    whole = path.read_bytes()
    versions = (damaged_bytes(whole, damage, damage.choice((0, 128))) for _ in range(150))
    attempt(lambda: looked_at(load(tmp_path, lazy=True)), path, versions)


def test_ply(tmp_path, damage):
    """100 damaged versions of Gaussians and of points each."""
    path = tmp_path / "a.ply"
    save_ply(GaussianRows.from_points(torch.rand(5, 3), torch.rand(5, 3)).gaussians().detach(), path)
    whole = path.read_bytes()
    head = whole.index(b"end_header") + 12
    for read in (load_ply, read_point_ply):
        versions = (damaged_bytes(whole, damage, damage.choice((0, head))) for _ in range(100))
        attempt(lambda read=read: read(path), path, versions)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff", ".bmp"])
def test_images(tmp_path, damage, capfd, suffix):
    """40 damaged versions of a photograph; the decoders' own messages stay off the terminal."""
    import cv2

    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (16, 16, 3), np.uint8))
    whole = path.read_bytes()
    versions = (damaged_bytes(whole, damage, damage.choice((0, 40))) for _ in range(40))
    attempt(lambda: read_image(path), path, versions)
    assert not capfd.readouterr().err


def test_run_records(tmp_path, damage):
    """150 edits of config.json and of selection.json each."""
    fit = FitConfig().to_json()
    good = {"schema": SCHEMA, "data": "/x", "train": ["a", "b"], "test": ["c"], "fit": fit}
    path = tmp_path / "config.json"
    attempt(lambda: fitted_views(Run(tmp_path)), path, (damaged_json(good, damage) for _ in range(150)))
    active = FitConfig(selection=SelectionConfig(add=1)).to_json()
    path.write_text(json.dumps(good | {"fit": active}))
    chosen = {"start": [{"index": 0, "name": "a"}], "picks": [{"index": 1, "name": "b", "score": 1.0}]}
    versions = (damaged_json(chosen, damage) for _ in range(150))
    attempt(lambda: fitted_views(Run(tmp_path)), tmp_path / "selection.json", versions)


def test_checkpoints(tmp_path, damage):
    """100 edits of a checkpoint's header, 50 of its bytes, 50 of its tensors."""
    from safetensors.torch import save

    cameras = orbit((0, 0, 0), 3.0, 3, width=8, height=6)
    frames = [Frame(f"v{i}", camera, torch.zeros(6, 8, 3)) for i, camera in enumerate(cameras)]
    config = FitConfig(max_steps=50)
    trainer = Trainer(config, frames, GaussianRows.from_points(torch.rand(9, 3), torch.rand(9, 3)), 1.0)
    trainer.step()
    tensors, header = trainer.state()
    header |= {"seconds": 1.0, "point_source": "x"}
    path = tmp_path / "state.safetensors"
    save_state(path, tensors, header)
    whole = path.read_bytes()
    tensors = {name: x.detach().contiguous() for name, x in tensors.items()}

    def read():
        loaded, head = load_state(path)
        check_checkpoint(path, loaded, head)
        Trainer.from_state(config, frames, loaded, head, str(path))

    def with_header(data: bytes) -> bytes:
        return save(tensors, {"drgs": data.decode("utf-8", "replace")})

    def with_another_tensor() -> bytes:
        name = damage.choice(sorted(tensors))
        x = tensors[name]
        others = [torch.zeros(0), torch.zeros(3, 3), x.reshape(-1)[:5].clone(), torch.zeros_like(x, dtype=torch.int32)]
        changed = tensors | {name: damage.choice(others)}
        if damage.random() < 0.3:
            del changed[name]
        return save(changed, {"drgs": json.dumps({"schema": SCHEMA, **header})})

    read()
    full = {"schema": SCHEMA, **header}
    attempt(read, path, (with_header(damaged_json(full, damage)) for _ in range(100)))
    attempt(read, path, (damaged_bytes(whole, damage, 4000) for _ in range(50)))
    attempt(read, path, (with_another_tensor() for _ in range(50)))


def test_json_has_limits(tmp_path):
    """Nesting, integers of thousands of digits, and files that are not UTF-8 end in one line."""
    path = tmp_path / "cameras.json"
    for data, told in (
        (b"[" * 200_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b"\xff\xfe[]", "must be valid JSON"),
        (zlib.compress(b"[]"), "must be valid JSON"),
    ):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=told) as error:
            load_cameras_json(path)
        assert "\n" not in str(error.value)
    entry = '{"width": 8, "height": 6, "fx": 9, "fy": 9, "position": [0, 0, %s], "rotation": [[1,0,0],[0,1,0],[0,0,1]]}'
    for digits in (30, 400, 5000):
        path.write_text("[" + entry % ("9" * digits) + "]")
        with pytest.raises(ValueError, match=r"position\[2\] must be a finite number|must be within 1e\+15"):
            load_cameras_json(path)
    path.write_bytes(b"\xef\xbb\xbf[" + (entry % "1").encode() + b"]")  # Windows' mark of UTF-8
    assert len(load_cameras_json(path)) == 1
