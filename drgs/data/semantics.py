"""Classes of a data set: a teacher's feature maps, label images, and the names of their numbers."""

from __future__ import annotations

import dataclasses
import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.checks import read_npy, read_text
from drgs.data.images import read_image
from drgs.display.progress import Bar
from drgs.io.json_files import check_json, read_json

if TYPE_CHECKING:
    from collections.abc import Iterable

    import torch

    from drgs.cameras import Camera
    from drgs.features.segmentation import Classes

SEGMENTS = "seg"
"""Folder of Dynamic 3D Gaussians' labels, in which 1 is what moves."""
_NUMBERS = 1 << 16  # what a pixel of a label image can say
_SHOWN = 5  # class names that a message names
_FINER = 8  # times: photographs are reduced so far (images_8) while their maps stay

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Semantics:
    """Classes of a data set: feature maps, label images and names. Files are opened by the properties, at first use.

    Attributes:
        teacher: Name of the folder of the teacher's maps, empty without.
        labels: Name of the folder of the label images, empty without.
        maps, label_images: The files of the views that have one, in the order of the views.
        class_file, embedding_file: Files of names and text embeddings, or None.
        moving_file: File that names the classes of things that move, or None.
    """

    teacher: str = ""
    labels: str = ""
    maps: tuple[Path, ...] = ()
    label_images: tuple[Path, ...] = ()
    class_file: Path | None = None
    embedding_file: Path | None = None
    moving_file: Path | None = None

    @functools.cached_property
    def channels(self) -> int | None:
        """C of the teacher's maps, by the text embeddings if there are any, else by the first map; None without."""
        if not self.maps:
            return None
        return self._embeddings.shape[1] if self._embeddings is not None else self._first.shape[0]

    @functools.cached_property
    def map_size(self) -> tuple[int, int] | None:
        """(w, h) of the first map, by its header; None without."""
        return (self._first.shape[2], self._first.shape[1]) if self.maps else None

    @functools.cached_property
    def classes(self) -> Classes | None:
        """The classes, of which labels are the numbers from 1.

        Where no file names them, they are called by the numbers that the label images hold (all of which are read), or
        by the rows of the text embeddings. None where there is neither.

        Raises:
            FileNotFoundError, ValueError: A file that is none of its kind, or not as many embeddings as names.
        """
        from drgs.features.segmentation import Classes

        names = tuple(self._numbers.values())
        if not names:
            return None
        rows = self._embeddings
        if rows is not None and len(rows) != len(names):
            source = self.class_file or self.labels
            raise ValueError(
                f"{self.embedding_file}: must have a row for each of the {len(names)} classes of {source}, "
                f"got {len(rows)}; make both from one list"
            )
        return Classes(names, rows)

    @functools.cached_property
    def moving(self) -> tuple[str, ...] | None:
        """Names of the classes of things that move; None where nothing says.

        Raises:
            FileNotFoundError, ValueError: A file that is no list of names, or names no class.
        """
        if self.moving_file is None:
            return self.classes.names if self.labels == SEGMENTS and self.classes else None
        names = read_json(self.moving_file, "a list of class names", 'write ["tongs", ...]')
        check_json(str(self.moving_file), names, [str], 'write ["tongs", ...]')
        known = self.classes.names if self.classes else ()
        if unknown := [name for name in names if name not in known]:
            raise ValueError(
                f"{self.moving_file}: must name classes of {self.class_file or self.labels or self.teacher}, got "
                f"{unknown[0][:80]!r}; correct it"
            )
        return tuple(names)

    def checked(self, maps: Iterable[tuple[Path, Camera]]) -> Semantics:
        """The same, with the headers of all maps and the classes compared.

        Args:
            maps: The maps and the cameras of their photographs.
        Raises:
            FileNotFoundError, ValueError: A file that is none of its kind, or as `check_map`.
        """
        if self.maps:
            from drgs.features.teacher import read_map

            for path, camera in maps:
                self.check_map(read_map(path), path, camera)
            _ = self.classes
        elif self.class_file:  # labels alone: without a file, their numbers would be looked for in all of them
            _ = self._numbers
        if self.moving_file:
            _ = self.moving
        return self

    def check_map(self, values: torch.Tensor, path: Path, camera: Camera) -> None:
        """Raise ValueError unless a map has the channels of the others, and cells of no more than its photograph has.

        Args:
            values: (C, h, w).
            path: File of the map, for the message.
            camera: Camera of the photograph, which may have been reduced since the map was made.
        """
        if values.shape[0] != self.channels:
            like = self.embedding_file or self.maps[0]
            raise ValueError(
                f"{path}: must have {self.channels} channels as {like.name}, got {values.shape[0]}; "
                "make all maps and embeddings with one teacher"
            )
        height, width = values.shape[1:]
        if width > _FINER * camera.width or height > _FINER * camera.height:
            raise ValueError(
                f"{path}: must have at most {_FINER} cells a pixel along each side of its photograph of "
                f"{camera.width}x{camera.height}, got {width}x{height} cells; make the map from this photograph"
            )

    def numbered(self, raw: np.ndarray, path: Path) -> np.ndarray:
        """(H, W) int64 labels from the pixels of a label image.

        Args:
            raw: (H, W) uint8 or uint16.
            path: File of the image, for the message.
        Raises:
            ValueError: Numbers that are no class.
        """
        table = self._table.copy()
        last = np.iinfo(raw.dtype).max
        table[last] = max(table[last], 0)
        labels = table[raw]
        if labels.min() < 0:
            found = np.unique(raw[labels < 0])
            shown = ", ".join(map(str, found[:_SHOWN])) + (", ..." if len(found) > _SHOWN else "")
            raise ValueError(
                f"{path}: must hold classes of {self.class_file or self.labels}, or 0 or {last} for none, "
                f"got {shown}; name them there"
            )
        return labels

    @functools.cached_property
    def _table(self) -> np.ndarray:
        """Label of each number that a pixel can say: -1 for those that are no class."""
        table = np.full(_NUMBERS, -1, np.int64)
        table[[0, *(number for number in self._named[1] if 0 <= number < _NUMBERS)]] = 0
        for label, number in enumerate(self._numbers, 1):
            if 0 <= number < _NUMBERS:
                table[number] = label
        return table

    @functools.cached_property
    def _named(self) -> tuple[dict[int, str], set[int]]:
        """Number -> name of the classes, and the numbers of what is none."""
        if self.class_file is not None:
            return read_class_names(self.class_file)
        if self._embeddings is not None:
            return {number: str(number) for number in range(1, len(self._embeddings) + 1)}, set()
        return {int(number): str(number) for number in _numbers_in(self.label_images)}, set()

    @property
    def _numbers(self) -> dict[int, str]:
        return self._named[0]

    @functools.cached_property
    def _embeddings(self) -> torch.Tensor | None:
        """(K, C) float32 of length 1 each, or None."""
        if self.embedding_file is None:
            return None
        import torch

        rows = read_npy(self.embedding_file)
        if rows.ndim != 2 or rows.dtype.kind != "f" or 0 in rows.shape:
            raise ValueError(
                f"{self.embedding_file}: must be a row of floats a class, got shape {rows.shape} of {rows.dtype}; "
                "save (classes, channels) floats"
            )
        # float64: squares of float16 embeddings overflow from 256 on.
        lengths = np.linalg.norm(rows.astype(np.float64), axis=1)
        bad = np.flatnonzero(~(np.isfinite(lengths) & (lengths > 0)))
        if len(bad):
            raise ValueError(f"{self.embedding_file}: must be finite and not 0, row {bad[0]} is not; make it again")
        return torch.from_numpy((rows / lengths[:, None]).astype(np.float32))

    @functools.cached_property
    def _first(self) -> torch.Tensor:
        from drgs.features.teacher import read_map

        return read_map(self.maps[0])


def plain_labels(path: Path) -> np.ndarray:
    """A label image as stored, (H, W) uint8 or uint16.

    Raises:
        FileNotFoundError, ValueError: No image, or one of colors or floats.
    """
    raw = read_image(path)
    if raw.ndim == 3 and (raw[..., :1] == raw[..., :3]).all():
        raw = raw[..., 0]
    if raw.ndim != 2:
        raise ValueError(
            f"{path}: a label image must have one channel of class numbers, got {raw.shape[2]} or a palette of colors; "
            "convert it"
        )
    if raw.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: a label image must have 8 or 16 bits a pixel, got {raw.dtype}; convert it")
    return raw


def _numbers_in(paths: tuple[Path, ...]) -> list[int]:
    """The numbers in label images, without 0 and the largest one."""
    numbers: set[int] = set()
    with Bar("classes in labels", len(paths)) as bar:
        for path in paths:
            raw = plain_labels(path)
            numbers |= set(np.unique(raw).tolist()) - {0, np.iinfo(raw.dtype).max}
            bar.advance()
    if paths and not numbers:
        _log.warning(
            "%s: label images hold only 0 and the largest number, which are no class; name them in classes.txt beside "
            "the folder (`0 background`, `255 object`)",
            paths[0].parent,
        )
    return sorted(numbers)


CLASS_FILES = ("classes.json", "classes.txt", "info_semantic.json")
# Names of what is no class, case aside.
NO_CLASS = ("unlabelled", "unlabeled", "void", "ignore", "undefined", "none")
_LARGEST = 1 << 20  # bytes; a thousand classes take some 20 KB
_ADVICE = 'write {"classes": [{"id": 1, "name": "wall"}, ...]}'


def read_class_names(path: Path) -> tuple[dict[int, str], set[int]]:
    """The classes that a file names, in its order.

    JSON: an object with `classes`, a list of objects with `id` and `name` (drgs, Replica), or a list of names,
    which are 1, 2, .... Text: a line a class, `NUMBER NAME`, or names alone, which are 1, 2, ....

    Returns:
        Number in label images -> name; and the numbers of what is no class (`NO_CLASS`).
    Raises:
        FileNotFoundError: No such file.
        ValueError: Not that layout, a number twice, or no class at all.
    """
    read = _json_rows if path.suffix == ".json" else _text_rows
    names: dict[int, str] = {}
    void: set[int] = set()
    for where, number, name in read(path):
        if number in names or number in void:
            raise ValueError(f"{where}: must have a number of its own, {number} is there twice; correct it")
        if name.casefold() in NO_CLASS:
            void.add(number)
        else:
            names[number] = name
    if not names:
        raise ValueError(f"{path}: must name at least one class, names none; {_ADVICE}")
    return names, void


def _json_rows(path: Path) -> list[tuple[str, int, str]]:
    """(where, number, name) of each class of a JSON file."""
    data = read_json(path, "a file of class names", _ADVICE)
    rows = data.get("classes") if isinstance(data, dict) else data
    if not isinstance(rows, list):
        raise ValueError(f"{path}: must be a list of classes, or an object with one named `classes`; {_ADVICE}")
    classes = []
    for index, row in enumerate(rows):
        where = f"{path}: class {index}"
        if not isinstance(row, str):
            check_json(where, row, {"id": int, "name": str}, _ADVICE)
        number, name = (index + 1, row) if isinstance(row, str) else (row["id"], row["name"])
        classes.append((where, number, _name(where, name)))
    return classes


def _text_rows(path: Path) -> list[tuple[str, int, str]]:
    """(where, number, name) of each line of a text file; empty lines and those that begin with # are left out."""
    lines = read_text(path, "a file of class names", _LARGEST).splitlines()
    rows = [(number, line.split()) for number, line in enumerate(lines, 1)]
    rows = [(number, words) for number, words in rows if words and not words[0].startswith("#")]
    numbered = [words[0].isascii() and words[0].isdigit() and len(words) > 1 for _, words in rows]
    if any(numbered) and not all(numbered):
        line = rows[numbered.index(False)][0]
        raise ValueError(f"{path}: line {line} must be `NUMBER NAME` as other lines are, is not; correct it")
    classes = []
    for index, (line, words) in enumerate(rows, 1):
        where = f"{path}: line {line}"
        if any(numbered) and len(words[0]) > 9:
            raise ValueError(f"{where} must begin with a number of at most 9 digits, does not; correct it")
        number, name = (int(words[0]), " ".join(words[1:])) if any(numbered) else (index, " ".join(words))
        classes.append((where, number, _name(where, name)))
    return classes


def _name(where: str, name: str) -> str:
    name = " ".join(name.split())
    if not name:
        raise ValueError(f"{where}: must have a name, it is empty; correct it")
    return name
