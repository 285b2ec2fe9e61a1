"""Valid files of every format that drgs reads, a few pixels large: what the fuzzers damage (benchmarks/fuzz.py)."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from drgs.cameras import Camera, c2w_to_opengl, intrinsics, look_at
from drgs.ellipsoids import Gaussians

__all__ = [
    *("CAMERAS", "CLASSES", "COLMAP_BINARY", "COLMAP_TEXT", "DECODERS", "DUMPS", "IMAGES", "LLFF", "PIXELS", "PLY"),
    *("POINTS", "REPLICA", "RUNS", "TEACHER", "TRAIN_META", "TRANSFORMS", "VIDEOS", "dumped"),
]

_ROOT = Path(__file__).resolve().parent.parent
_W = 12
_H = 8
_K = intrinsics(10, 11, 6.0, 4.0)
_VIEWS = 4


def _poses(count: int = _VIEWS) -> list[np.ndarray]:
    """World-to-camera matrices on an arc that look at the origin."""
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0)) for a in np.linspace(0, 1.5, count)]


def _picture(kind: type = np.uint8, channels: int = 3) -> np.ndarray:
    values = np.random.default_rng(1).integers(0, np.iinfo(kind).max, (_H, _W, channels), endpoint=True)
    return values.astype(kind)[..., 0] if channels == 1 else values.astype(kind)


def _write(path: Path, picture: np.ndarray, *options: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture, list(options)), path


def _json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def gaussians(count: int = 5, degree: int = 1, features: int = 0) -> Gaussians:
    """Gaussians around the origin."""
    draw = torch.Generator().manual_seed(degree)
    normal = functools.partial(torch.randn, generator=draw)
    more = {"features": normal(count, features)} if features else {}
    sh = 0.1 * normal(count, (degree + 1) ** 2, 3)
    return Gaussians(normal(count, 3), normal(count, 4), normal(count, 3) - 2, normal(count), sh, **more)


# ------------------------------------------------------------------------------------ PLY


def _ply(degree: int, features: int = 0, text: bool = False, order: str = "<", face: bool = False) -> Any:
    def write(folder: Path) -> None:
        import plyfile

        from drgs.files import save_ply

        save_ply(gaussians(degree=degree, features=features), folder / "point_cloud.ply")
        if not (text or face or order != "<"):
            return
        ply = plyfile.PlyData.read(str(folder / "point_cloud.ply"), mmap=False)  # it is written anew
        elements = [ply["vertex"]]
        if face:
            rows = np.array([([0, 1, 2], 1.5), ([3, 4], 2.5)], dtype=[("vertex_indices", "O"), ("quality", "f4")])
            elements.insert(0, plyfile.PlyElement.describe(rows, "face", val_types={"vertex_indices": "i4"}))
        plyfile.PlyData(elements, text=text, byte_order="=" if text else order).write(str(folder / "point_cloud.ply"))

    return write


def _points(text: bool, colors: str, face: bool = False) -> Any:
    def write(folder: Path) -> None:
        import plyfile

        kinds = [(axis, "f4") for axis in "xyz"] + [(name, colors) for name in ("red", "green", "blue") if colors]
        rows = np.zeros(6, kinds)
        rows["x"] = np.linspace(-1, 1, 6)
        elements = [plyfile.PlyElement.describe(rows, "vertex")]
        if face:
            faces = np.array([([0, 1, 2],), ([3, 4],)], dtype=[("vertex_indices", "O")])
            elements.append(plyfile.PlyElement.describe(faces, "face", val_types={"vertex_indices": "i4"}))
        plyfile.PlyData(elements, text=text).write(str(folder / "points.ply"))

    return write


PLY = (_ply(0), _ply(1, 3), _ply(3), _ply(0, text=True), _ply(0, order=">"), _ply(0, 2, face=True))
POINTS = (_points(False, "u1"), _points(True, "u1", True), _points(False, "f4", True), _points(False, ""))


# ------------------------------------------------------------------------------------ data sets


def _colmap(text: bool, model: str = "PINHOLE", params: tuple = (10, 11, 6.0, 4.0), folders: bool = False) -> Any:
    """A model of 4 images that see 5 points; with `folders`, of synchronous cameras."""

    def write(folder: Path) -> None:
        import pycolmap

        made = pycolmap.Reconstruction()
        camera = pycolmap.Camera(model=model, width=_W, height=_H, params=list(params), camera_id=1)
        made.add_camera_with_trivial_rig(camera)
        for index, pose in enumerate(_poses()):
            name = f"cam{index:02d}.png" if folders else f"im{index}.png"
            image = pycolmap.Image(name=name, keypoints=np.zeros((5, 2)), camera_id=1, image_id=index + 1)
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
            for frame in range(2) if folders else ():
                _write(folder / f"cam{index:02d}" / f"{frame:04d}.png", _picture())
            if not folders:
                _write(folder / "images" / name, _picture())
        for index in range(5):
            track = pycolmap.Track()
            for image_id in range(1, _VIEWS + 1):
                track.add_element(image_id, index)
            made.add_point3D(np.eye(5, 3)[index] * 0.2, track, np.array([255, 51 * index, 0], np.uint8))
        target = folder / "sparse" / "0"
        target.mkdir(parents=True)
        (made.write_text if text else made.write_binary)(target)

    return write


_OPENCV = ("OPENCV", (10, 11, 6, 4, 0.1, 0.01, 1e-3, 1e-3))
_FISHEYE = ("OPENCV_FISHEYE", (10, 11, 6, 4, 0.1, 0.01, 1e-3, 1e-3))
COLMAP_BINARY = (_colmap(False), _colmap(False, *_OPENCV), _colmap(False, folders=True))
COLMAP_TEXT = (_colmap(True), _colmap(True, *_FISHEYE), _colmap(True, folders=True))


def _transforms(folder: Path) -> None:
    """Nerfstudio's, with a lens, masks, depth maps and points."""
    lens = {"camera_model": "OPENCV", "k1": 0.05, "k2": 0.01, "p1": 1e-3, "p2": 1e-3}
    frames = []
    for index, pose in enumerate(_poses()):
        _write(folder / "images" / f"{index}.png", _picture())
        _write(folder / "masks" / f"{index}.png", np.full((_H, _W), 255, np.uint8))
        np.save(folder / "masks" / f"{index}.npy", np.ones((_H, _W), np.float32))
        names = {"mask_path": f"masks/{index}.png", "depth_file_path": f"masks/{index}.npy"}
        matrix = c2w_to_opengl(np.linalg.inv(pose)).tolist()
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": matrix, "time": index / 3, **names})
    _points(False, "u1")(folder)
    sizes = {"fl_x": 10, "fl_y": 11, "cx": 6.0, "cy": 4.0, "w": _W, "h": _H, "ply_file_path": "points.ply"}
    split = {"train_filenames": [f["file_path"] for f in frames[1:]], "val_filenames": ["images/0.png"]}
    _json(folder / "transforms.json", {**sizes, **lens, **split, "frames": frames})


def _blender(folder: Path) -> None:
    """Splits in files of their own, angles, no suffixes."""
    for split in ("train", "test"):
        frames = []
        for index, pose in enumerate(_poses()):
            _write(folder / split / f"r_{index}.png", _picture(channels=4))
            matrix = c2w_to_opengl(np.linalg.inv(pose)).tolist()
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": matrix, "time": index / 3})
        _json(folder / f"transforms_{split}.json", {"camera_angle_x": 0.9, "frames": frames})


TRANSFORMS = (_transforms, _blender)


def _rows() -> np.ndarray:
    from drgs.scenes.videos import llff_rows

    return llff_rows(_K, np.linalg.inv(np.array(_poses())), _W, _H, np.tile([0.5, 9.0], (_VIEWS, 1)))


def _llff(folder: Path) -> None:
    for index in range(_VIEWS):
        _write(folder / "images" / f"{index}.png", _picture())
    np.save(folder / "poses_bounds.npy", _rows())


def _neu3d(folder: Path) -> None:
    """Folders of frames, with a row a camera."""
    for index in range(_VIEWS):
        for frame in range(2):
            _write(folder / f"cam{index:02d}" / "images" / f"{frame:04d}.png", _picture())
    np.save(folder / "poses_bounds.npy", _rows())


LLFF = (_llff, _neu3d)


def _train_meta(folder: Path) -> None:
    for name, cameras in (("train_meta.json", (0, 1, 2)), ("test_meta.json", (3,))):
        meta: dict[str, Any] = {"w": _W, "h": _H, "k": [], "w2c": [], "fn": [], "cam_id": []}
        for time in range(2):
            meta["k"].append([_K.tolist() for _ in cameras])
            meta["w2c"].append([_poses()[c].tolist() for c in cameras])
            meta["fn"].append([f"{c}/{time:06d}.png" for c in cameras])
            meta["cam_id"].append(list(cameras))
            for c in cameras:
                _write(folder / "ims" / str(c) / f"{time:06d}.png", _picture())
        _json(folder / name, meta)
    np.savez(folder / "init_pt_cld.npz", data=np.random.default_rng(1).uniform(0, 0.5, (20, 7)))


TRAIN_META = (_train_meta,)


def _replica(folder: Path) -> None:
    rows = [" ".join(f"{x:.9g}" for x in np.linalg.inv(pose).ravel()) for pose in _poses()]
    for index in range(_VIEWS):
        _write(folder / "rgb" / f"rgb_{index}.png", _picture())
        _write(folder / "depth" / f"depth_{index}.png", _picture(np.uint16, 1))
    (folder / "traj_w_c.txt").write_text("\n".join(rows) + "\n")


REPLICA = (_replica,)


def _cameras(folder: Path) -> None:
    from drgs.data.camera_lists import save_cameras_json

    cameras = [Camera(_K, pose, _W, _H, name=f"im{k}", time=k / 3) for k, pose in enumerate(_poses())]
    save_cameras_json(folder / "cameras.json", cameras)


def _inria(folder: Path) -> None:
    rows = [{"id": 0, "img_name": "a", "width": _W, "height": _H, "fx": 10, "fy": 11.5}]
    _json(folder / "cameras.json", [row | {"position": [0, 1, 2], "rotation": np.eye(3).tolist()} for row in rows])


CAMERAS = (_cameras, _inria)


def _map(values: torch.Tensor) -> Any:
    return lambda folder: torch.save(values, folder / "im0_fmap_CxHxW.pt")


TEACHER = (
    _map(torch.linspace(0, 1, 2 * 3 * 4).reshape(2, 3, 4).half()),
    _map(torch.linspace(0, 1, 2 * 4 * 5).reshape(2, 4, 5)[:, :3]),  # as SAM's: a part of a larger one
)


def _labelled(names: str) -> Any:
    """A data set with labels, and a file that says what they mean."""

    def write(folder: Path) -> None:
        _transforms(folder)
        for index in range(_VIEWS):
            _write(folder / "semantic_class" / f"{index}.png", np.full((_H, _W), index % 3, np.uint8))
            (folder / "sam_embeddings").mkdir(exist_ok=True)
            torch.save(torch.ones(4, 2, 3), folder / "sam_embeddings" / f"{index}_fmap_CxHxW.pt")
        rows = [{"id": 1, "name": "wall"}, {"id": 2, "name": "cup"}, {"id": 3, "name": "void"}]
        if names == "classes.txt":
            (folder / names).write_text("1 wall\n2 cup\n3 void\n")
        else:
            _json(folder / names, {"classes": rows} if names == "info_semantic.json" else ["wall", "cup"])
        np.save(folder / "text_embeddings.npy", np.eye(2, 4, dtype=np.float32))
        _json(folder / "moving_classes.json", ["cup"])

    return write


CLASSES = tuple(map(_labelled, ("classes.json", "classes.txt", "info_semantic.json")))


# ------------------------------------------------------------------------------------ pixels


def _image(name: str, picture: np.ndarray, *options: int) -> Any:
    return lambda folder: _write(folder / name, picture, *options)


def _of_a_phone(name: str) -> Any:
    """A turned photograph with EXIF, in tiles, as HEIC or AVIF."""

    def write(folder: Path) -> None:
        import pillow_heif
        from PIL import Image

        pillow_heif.register_heif_opener()
        exif = Image.Exif()
        exif[0x112] = 6  # the orientation
        picture = np.random.default_rng(1).integers(0, 255, (100, 140, 3)).astype(np.uint8)
        tiles = {"tile_size": 64} if name.endswith(".heic") else {}
        Image.fromarray(picture).save(folder / name, quality=30, exif=exif.tobytes(), **tiles)

    return write


IMAGES = (
    _image("a.png", _picture()),
    _image("a.png", _picture(np.uint16, 1)),
    _image("a.png", _picture(channels=4)),
    _image("a.jpg", _picture()),
    _image("a.jpg", _picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 1),
    _image("a.webp", _picture()),
    _image("a.webp", _picture(channels=4), cv2.IMWRITE_WEBP_QUALITY, 101),
    _image("a.tiff", _picture(np.uint16)),
    _image("a.tiff", _picture(), cv2.IMWRITE_TIFF_COMPRESSION, 1),
    _image("a.bmp", _picture()),
    _of_a_phone("a.heic"),
    _of_a_phone("a.avif"),
)


def _pixels(folder: Path) -> None:
    """A photograph with mask, depth and label, of a lens."""
    _labelled("classes.txt")(folder)
    for unused in folder.glob("*/[123]*"):
        if unused.parent.name not in ("images", "sam_embeddings"):
            unused.unlink()
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"][1:]:
        del frame["mask_path"], frame["depth_file_path"]
    _write(folder / "masks" / "0_depth.png", _picture(np.uint16, 1))
    data["frames"][0]["depth_file_path"] = "masks/0_depth.png"
    _json(folder / "transforms.json", data)


PIXELS = (_pixels,)


def _video(name: str, codec: str) -> Any:
    def write(folder: Path) -> None:
        writer = cv2.VideoWriter(str(folder / name), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), 30, (32, 24))
        frame = np.random.default_rng(1).integers(0, 255, (24, 32, 3), np.uint8)
        for index in range(6):
            writer.write(np.roll(frame, index, axis=1))
        writer.release()

    return write


VIDEOS = (
    *(_video("a.mp4", "mp4v"), _video("a.mp4", "FFV1"), _video("a.avi", "MJPG"), _video("a.avi", "XVID")),
    *(_video("a.webm", "VP80"), _video("a.mkv", "mp4v"), _video("a.webm", "VP90")),
)


# ------------------------------------------------------------------------------------ what drgs writes

_SIZE = {"width": 32, "height": 24, "spp": 1, "seed": 1}
_FIT = "--max-gaussians 40 --sh-degree 1 --deterministic --no-report --quiet"
_FITS = {
    "static": ("still_life", {"views": 6}, "--max-steps 4 --save-every 2"),
    "active": ("still_life", {"views": 6}, "--max-steps 4 --views active --add 2 --every 1"),
    "semantic": ("room", {"views": 6, "teacher_width": 6, "teacher_height": 4}, "--max-steps 2 --feature-width 4"),
    "dynamic": ("kitchen", {"cameras": 4, "times": 3}, "--max-steps 8 --semantics ignore --field-preset dnerf"),
}


def _fit(kind: str) -> Any:
    """A run folder of `drgs fit` on a made scene; kept in runs/fuzz/fits for the next time."""

    def write(folder: Path) -> None:
        import importlib
        import shutil

        scene, size, options = _FITS[kind]
        kept = _ROOT / "runs" / "fuzz" / "fits"
        data = importlib.import_module(f"drgs.scenes.{scene}").generate(kept / scene, **_SIZE, **size)
        line = [sys.executable, "-m", "drgs", "fit", str(data), "-o", str(kept / kind), *_FIT.split(), *options.split()]
        if not (kept / kind / "metrics.json").is_file():
            subprocess.run([*line, "--resume"], check=True, env={**os.environ, "PYTHONPATH": str(_ROOT)}, timeout=600)
        shutil.copytree(kept / kind, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*previous*", "renders"))

    return write


RUNS = tuple(map(_fit, _FITS))


@functools.cache
def dumped() -> tuple[Gaussians, list[Camera], tuple]:
    """The scene of the dumps."""
    return gaussians(3), [Camera(_K, pose, _W, _H) for pose in _poses(2)], (0.0, 0.0, 0.0)


def _dump(suffix: str, pose: bool) -> Any:
    def write(folder: Path) -> None:
        from drgs.lab.parameters import PARAMETERS
        from drgs.lab.rasterizers import cotangents, scene_arrays

        scene = scene_arrays(*dumped())
        count = len(dumped()[1])
        arrays = {**scene, **{f"grad_{name}": np.ones_like(scene[name]) for name in PARAMETERS}}
        arrays |= {"image": np.ones((count, _H, _W, 3), np.float32), "alpha": np.ones((count, _H, _W), np.float32)}
        arrays["cotangent"] = cotangents(dumped()[1], 0).float().numpy()
        if pose:
            arrays["grad_viewmat"] = np.ones((count, 4, 4), np.float32)
        if suffix == ".npz":
            np.savez(folder / "dump.npz", **arrays)
        else:
            from safetensors.numpy import save_file

            save_file({name: np.ascontiguousarray(x) for name, x in arrays.items()}, folder / "dump.safetensors")

    return write


DUMPS = (_dump(".npz", True), _dump(".safetensors", False))


def _decoder(folder: Path) -> None:
    from drgs.features.decoder import Decoder, save_decoder

    torch.manual_seed(0)
    save_decoder(Decoder(3, 5), folder / "decoder.pth")


DECODERS = (_decoder,)
