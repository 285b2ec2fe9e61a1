"""What is fuzzed (benchmarks/fuzz.py, tests/test_fuzz.py): every reader of drgs, the valid files that it is shown at
first, and what an error may be. Another reader is one more line of `TARGETS`, and a function that writes its files.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import os
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import fuzz_codecs as codecs
import fuzz_seeds as seeds
from fuzz_formats import mutate

from drgs.checks.arguments import ArgumentError

__all__ = ["TARGETS", "Bench", "Target", "fault_of"]

_ALLOWED = (ValueError, ArgumentError, FileNotFoundError, NotImplementedError)
_LONGEST = 2000  # characters of a message


@dataclasses.dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        name: Name of the reader, as tables have it.
        seeds: Functions that write valid files into an empty folder each.
        files: Patterns of the files that are damaged, below that folder.
        read: Reads the folder.
    """

    name: str
    seeds: tuple[Callable[[Path], Any], ...]
    files: tuple[str, ...]
    read: Callable[[Path], Any]


def fault_of(error: BaseException, folder: Path) -> str | None:
    """What is wrong with an error that a reader raised; None if nothing is."""
    if type(error) not in _ALLOWED:
        return f"{type(error).__name__} instead of ValueError"
    text = str(error)
    if "\n" in text or not text.strip() or len(text) > _LONGEST:
        return "a message that is not one line"
    if str(folder) not in text:
        return "a message that does not name the file"
    if "traceback" in text.lower():
        return "a message with a traceback"
    return None


class Bench:
    """The files of a target in a folder of their own, of which one is damaged at a time.

    Args:
        target: The reader.
        scratch: Empty folder, best in memory.
        made: Folders that hold valid files already, in place of those that the target's functions write.
    Attributes:
        files: (folder, path, bytes) of the valid files that are damaged.
    """

    def __init__(self, target: Target, scratch: Path, made: list[Path] | None = None) -> None:
        self.target = target
        if made is None:
            made = [scratch / f"seed{index}" for index in range(len(target.seeds))]
            for folder, write in zip(made, target.seeds, strict=True):
                folder.mkdir(parents=True)
                write(folder)
        self._folders = made
        self.files = [
            (folder, path, path.read_bytes())
            for folder in made
            for path in sorted(folder.rglob("*"))
            if path.is_file() and any(fnmatch.fnmatch(str(path.relative_to(folder)), x) for x in target.files)
        ]
        if not self.files:
            raise ValueError(f"{target.name}: must have files to be damaged, has none; correct its patterns")
        # Large files are slow to write and hold mostly numbers.
        self._weights = [1 / (1 + len(data) / 20_000) for _, _, data in self.files]
        self._changed: tuple[Path, bytes] | None = None
        self._clock = 0

    def check(self) -> None:
        """Read the valid files: what cannot be read shows nothing."""
        for folder in self._folders:
            self.target.read(folder)

    def place(self, number: int) -> tuple[Path, Path, bytes]:
        """Put a numbered input into its place; returns its folder, its file and its bytes."""
        draw = Random(f"{self.target.name} {number}")
        folder, path, data = draw.choices(self.files, self._weights)[0]
        others = [other for _, p, other in self.files if p.suffix == path.suffix]
        data = mutate(data, path.suffix, draw, others)
        self.put(path, data)
        return folder, path, data

    def put(self, path: Path, data: bytes) -> None:
        """Write a file in the place of a valid one; the one before is restored."""
        if self._changed is not None and self._changed[0] != path:
            self._write(*self._changed)
        self._changed = path, next(held for _, p, held in self.files if p == path)
        self._write(path, data)

    def _write(self, path: Path, data: bytes) -> None:
        path.write_bytes(data)
        self._clock += 1  # a time of its own, since readers may remember what a file was at a time
        os.utime(path, ns=(self._clock, self._clock))

    def read(self, folder: Path) -> tuple[str, str | None, BaseException | None]:
        """What the reader makes of a folder: how it ended, what is wrong with that (None: nothing), and its error."""
        try:
            self.target.read(folder)
        except Exception as error:  # noqa: BLE001 (any kind of it is what is looked for)
            return type(error).__name__, fault_of(error, folder), error
        return "read", None, None


# ------------------------------------------------------------------------------------ readers


def _ply(folder: Path) -> None:
    from drgs.files import load_ply

    load_ply(folder / "point_cloud.ply")


def _gaussians(folder: Path) -> None:
    from drgs.codecs import load_gaussians

    (path,) = folder.iterdir()
    load_gaussians(path)


def _scene(folder: Path) -> None:
    from drgs.codecs import load_gaussians

    load_gaussians(folder)


def _points(folder: Path) -> None:
    from drgs.data.point_ply import read_point_ply

    read_point_ply(folder / "points.ply")


def _data(folder: Path) -> None:
    from drgs.data import load

    load(folder)


def _lazy(folder: Path) -> None:
    from drgs.data import load

    load(folder)
    dataset = load(folder, lazy=True, points=False)  # of what is whole, without what is not needed
    dataset.split()
    for view in dataset.views:
        _ = view.camera.undistorted().resized(4, 4).c2w  # as commands do


def _cameras(folder: Path) -> None:
    from drgs.data.camera_lists import load_cameras_json

    load_cameras_json(folder / "cameras.json")


def _teacher(folder: Path) -> None:
    from drgs.features.teacher import used_map

    for path in folder.iterdir():
        used_map(path)


def _classes(folder: Path) -> None:
    from drgs.data import load

    data = load(folder)
    if data.semantics is not None:
        _ = data.semantics.classes, data.semantics.moving, data.semantics.map_size
        data.views[0].labels()


def _image(folder: Path) -> None:
    from drgs.data.images import image_size, read_image

    for path in folder.iterdir():
        image_size(path)
        read_image(path)


def _pixels(folder: Path) -> None:
    from drgs.data import load

    view = load(folder).views[0]
    view.image(), view.mask(), view.depth(), view.labels()


def _video(folder: Path) -> None:
    from drgs.data.videos import VideoFrame, list_videos, read_video

    for path in list_videos(folder):
        video = read_video(path)
        for index in {0, video.count // 2, video.count - 1}:
            VideoFrame(path, index).read()


def _run(folder: Path) -> None:
    from drgs.files import Run
    from drgs.fitting.records import fitted_views, is_run, load_run
    from drgs.pages.report.account import account_of

    run = Run(folder)
    is_run(folder)
    errors = []
    for reader in (load_run, fitted_views, account_of, Run.events):
        try:
            reader(run)
        except Exception as error:  # noqa: BLE001 (all of them are asked, the worst answer counts)
            errors.append(error)
    for error in sorted(errors, key=lambda e: fault_of(e, folder) is None):
        raise error


def _dump(folder: Path) -> None:
    from drgs.lab.rasterizers import is_export, read_dump

    for path in folder.glob("dump.*"):
        is_export(path)
        read_dump(path, *seeds.dumped())


def _decoder(folder: Path) -> None:
    from drgs.features.decoder import load_decoder

    load_decoder(folder / "decoder.pth")


TARGETS: dict[str, Target] = {
    target.name: target
    for target in (
        Target("3DGS PLY", seeds.PLY, ("*.ply",), _ply),
        Target("SPZ", codecs.SPZ, ("*.spz",), _gaussians),
        Target(".splat", codecs.SPLAT, ("*.splat",), _gaussians),
        Target(".ksplat", codecs.KSPLAT, ("*.ksplat",), _gaussians),
        Target("compressed PLY", codecs.PACKED_PLY, ("*.ply",), _gaussians),
        Target("SOG", codecs.SOG, ("*.sog",), _gaussians),
        Target("SOG folder", codecs.SOG_FOLDER, ("meta.json", "*.webp"), _scene),
        Target("GLB", codecs.GLB, ("*.glb",), _gaussians),
        Target("3DGS model folder", codecs.MODEL, ("*.ply",), _scene),
        Target("PLY point cloud", seeds.POINTS, ("*.ply",), _points),
        Target("COLMAP binary", seeds.COLMAP_BINARY, ("*.bin",), _lazy),
        Target("COLMAP text", seeds.COLMAP_TEXT, ("*.txt",), _lazy),
        Target("transforms.json", seeds.TRANSFORMS, ("*.json",), _lazy),
        Target("poses_bounds.npy", seeds.LLFF, ("*.npy",), _data),
        Target("train_meta.json", seeds.TRAIN_META, ("*.json", "*.npz"), _data),
        Target("traj_w_c.txt", seeds.REPLICA, ("*.txt",), _data),
        Target("cameras.json", seeds.CAMERAS, ("*.json",), _cameras),
        Target("teacher maps", seeds.TEACHER, ("*.pt",), _teacher),
        Target("classes", seeds.CLASSES, ("*classes.*", "info_semantic.json", "text_embeddings.npy"), _classes),
        Target("photographs", seeds.IMAGES, ("*.*",), _image),
        Target("masks, depths, labels", seeds.PIXELS, ("*/0*.png", "masks/0.npy"), _pixels),
        Target("videos", seeds.VIDEOS, ("*.mp4", "*.avi", "*.webm", "*.mkv"), _video),
        Target("run folders", seeds.RUNS, ("*.json", "log.jsonl", "state.safetensors", "*.npy", "*.ply"), _run),
        Target("rasterizer dumps", seeds.DUMPS, ("dump.*",), _dump),
        Target("decoders", seeds.DECODERS, ("*.pth",), _decoder),
    )
}
