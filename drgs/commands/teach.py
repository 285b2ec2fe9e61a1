"""`drgs teach`: features of a local CLIP model for each photograph of a data set, as files that `drgs fit` reads.

Everything is written into the data set's own folder, beside its photographs, where the loader and Feature 3DGS look:
`rgb_feature_langseg/NAME_fmap_CxHxW.pt` for each photograph, `text_embeddings.npy` and, where the data set names no
classes yet, `classes.json`. Nothing that is there is replaced but what this command wrote: a teacher's maps or
embeddings of somebody else are refused. An interrupted command is resumed where it stopped; with another model or other
options all maps of this command are made anew.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shlex
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs import data
from drgs.commands.values import parsed_cells, parsed_scales
from drgs.data.semantics import CLASS_FILES, read_class_names
from drgs.data.sidecars import EMBEDDINGS, LABEL_FOLDERS, TEACHER_FOLDERS
from drgs.display.progress import Bar
from drgs.features.encoders import TEMPLATES, ClipEncoder
from drgs.fitting.config import DataConfig
from drgs.io.journal import SCHEMA
from drgs.io.json_files import read_json
from drgs.io.outputs import LockedFolder, atomic_write, lock_folder, write_json

if TYPE_CHECKING:
    from drgs.commands.options import Teach
    from drgs.data import View

_FOLDER = TEACHER_FOLDERS[0]
_RECORD = f"{_FOLDER}/teach.json"
_CLASSES = CLASS_FILES[0]
_LONGER_SIDE = 80  # cells of the longer side of a map, by default; chosen


def run(args: Teach) -> None:
    """`drgs teach DATA`."""
    size = None if args.size is None else parsed_cells(args.size)
    scales = parsed_scales(args.scales)
    if not args.data.exists():
        raise FileNotFoundError(f"{args.data}: must be a data set, found no such file or folder; check the path")
    times = DataConfig.times if args.times is None else args.times
    # Before the folder is locked: it may be one below that was named, where the loader looks for maps.
    dataset = data.load(args.data, points=False, strict=args.strict, semantics=False, times=times)
    folder = dataset.path if dataset.path.is_dir() else dataset.path.parent
    output = lock_folder(folder, "teach", inputs=[args.model])
    output.remove_unfinished(_FOLDER)
    _check_no_other_files(output)
    names = _names(args, output)
    files = _files(dataset.views)
    with Bar("loading the model", show=not args.quiet):
        on_cuda = args.variant != "llvm_ad_rgb" and torch.cuda.is_available()
        encoder = ClipEncoder(args.model, "cuda" if on_cuda else "cpu")
        digest = _digest(encoder)
    record = {
        "schema": SCHEMA,
        "command": "teach",
        "method": "MaskCLIP: CLIP with the value path of its last attention alone",
        "model": {"folder": str(args.model), "weights": encoder.weights.name, "sha256": digest},
        "channels": encoder.channels,
        "size": size or f"longer side {_LONGER_SIDE}",
        "scales": scales,
        "flip": args.flip,
        "classes": names,
        "templates": TEMPLATES,
    }
    texts = encoder.texts(names) if names else None  # before anything is written: there may be no tokenizer
    _write_record(output, record)
    if texts is not None:
        _write_texts(output, texts, names)
    with Bar("maps that are there", show=not args.quiet):  # each of them is hashed
        left = [(name, view) for name, view in files.items() if not output.is_ours(output.path / name)]
    with Bar("teach", len(files), not args.quiet, done=len(files) - len(left)) as bar:
        for name, view in left:
            made = encoder.dense(_photograph(view), size or _size(view), scales, args.flip)
            with atomic_write(output.path / name) as file:
                torch.save(made.half(), file)
            bar.advance()
    if not args.quiet:
        print(_summary(folder, len(files), len(left), encoder.channels, names))
        print(f"next: drgs fit {shlex.quote(str(args.data))} -o RUN")


def _check_no_other_files(output: LockedFolder) -> None:
    """Raise ValueError where a teacher's files are there that this command did not write."""
    folder = output.path / _FOLDER
    if not folder.is_dir() or folder.is_symlink():
        output.check([_FOLDER])
    paths = [*sorted(folder.rglob("*")), output.path / EMBEDDINGS]
    other = next((path for path in paths if path.is_file() and not output.is_ours(path, ("teach",))), None)
    if other is not None:
        raise ValueError(
            f"{other}: must not be replaced, `drgs teach` did not make it; the data set has a teacher, move its files "
            "away"
        )


def _names(args: Teach, output: LockedFolder) -> list[str]:
    """The classes that texts are made of: those of --classes, else those that the data set names, if any."""
    held = next((output.path / name for name in CLASS_FILES if (output.path / name).is_file()), None)
    if held is not None and output.is_ours(held, ("teach",)):
        held = None if args.classes is not None else held
    known = [] if held is None else list(read_class_names(held)[0].values())
    if args.classes is None:
        return known
    path = Path(args.classes)
    if path.is_file() or path.suffix in (".txt", ".json"):
        names = list(read_class_names(path)[0].values())
    else:
        names = [name.strip() for name in args.classes.split(",") if name.strip()]
    labels = next((output.path / name for name in LABEL_FOLDERS if (output.path / name).is_dir()), None)
    if held is None and labels is not None and not (output.path / _CLASSES).exists():
        raise ValueError(
            f"{labels}: the numbers in label images must have names before a teacher's classes get numbers, found no "
            f"{_CLASSES}; name them there, or in classes.txt, and leave out --classes"
        )
    if not names:
        raise ValueError(f"--classes must name a class or more, got {args.classes!r}; say e.g. chair,table,lamp")
    if held is not None and names != known:
        raise ValueError(f"--classes must be the {len(known)} classes of {held} in its order, are not; leave it out")
    return names


def _digest(encoder: ClipEncoder) -> str:
    """SHA-256 of the model's configuration and weights."""
    total = hashlib.sha256()
    for path in (encoder.folder / "config.json", encoder.weights):
        with path.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def _files(views: list[View]) -> dict[str, View]:
    """The file of each view's map, below the data set's folder, as the loader matches them."""
    files: dict[str, View] = {}
    for view in views:
        if not view.has_image:
            continue
        below = PurePosixPath(_FOLDER) / PurePosixPath(view.name).parent
        name = str(below / f"{view.stem}_fmap_CxHxW.pt")
        if name in files:
            raise ValueError(
                f"{view.image_path}: must have a name of its own, {files[name].image_path} has the same but for its "
                "ending; put them into subfolders"
            )
        files[name] = view
    if not files:
        raise ValueError("the data set must have photographs, has none; name another")
    return files


def _write_record(output: LockedFolder, record: dict) -> None:
    """Write the record of the maps to come; maps of another record are deleted first."""
    path = output.path / _RECORD
    held = read_json(path) if path.is_file() else {}
    wanted = json.loads(json.dumps(record))
    before = _of_maps(held)
    if any(before.get(key) != value for key, value in _of_maps(wanted).items()):
        if (output.path / _FOLDER).is_dir():
            output.remove(output.path / _FOLDER)
        output.remove(output.path / EMBEDDINGS)
    if held != wanted:
        write_json(path, record)


def _of_maps(record: dict) -> dict:
    """What a record says that maps depend on: not the texts, nor where the model lies, whose SHA-256 is compared."""
    maps = {key: value for key, value in record.items() if key not in ("classes", "templates")}
    if isinstance(maps.get("model"), dict):
        maps["model"] = {key: value for key, value in maps["model"].items() if key != "folder"}
    return maps


def _write_texts(output: LockedFolder, texts: torch.Tensor, names: list[str]) -> None:
    """text_embeddings.npy, and classes.json where there is no file of classes but ours."""
    held = next((output.path / name for name in CLASS_FILES if (output.path / name).is_file()), None)
    if held is None or output.is_ours(held, ("teach",)):
        classes = [{"id": number, "name": name} for number, name in enumerate(names, 1)]
        write_json(output.path / _CLASSES, {"schema": SCHEMA, "command": "teach", "unlabelled": 0, "classes": classes})
    with atomic_write(output.path / EMBEDDINGS) as file:
        np.save(file, texts.numpy())


def _photograph(view: View) -> np.ndarray:
    """The photograph as it lies on disk, (H, W, 3) in [0, 1]: the loader straightens maps as it does photographs."""
    return dataclasses.replace(view, camera=view.camera.undistorted()).image()


def _size(view: View) -> tuple[int, int]:
    """(w, h) of a view's map: its photograph's shape."""
    width, height = view.camera.width, view.camera.height
    factor = _LONGER_SIDE / max(width, height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _summary(folder: Path, count: int, made: int, channels: int, names: list[str]) -> str:
    before = f", {count - made} of them made before" if made < count else ""
    texts = f"; text embeddings of {len(names)} classes" if names else "; no classes: name some with --classes"
    return f"maps of {count} photographs, {channels} channels{before}: {folder / _FOLDER}{texts}"
