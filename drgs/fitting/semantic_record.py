"""What a run knows about its teacher and its classes, so that it needs no data set to be asked about them.

`semantics` in config.json and in the checkpoint's header says what was fitted; `text_embeddings.npy` in the run folder
holds the embeddings of the classes, (K, C) float32 in NumPy's format, in the order of their names.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.io.json_files import check_json
from drgs.io.outputs import atomic_write

if TYPE_CHECKING:
    import torch

    from drgs.data import Dataset, Semantics, View
    from drgs.ellipsoids import Gaussians
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.fitting.config import FitConfig

__all__ = ["EMBEDDINGS", "SemanticRecord", "check_same_teacher"]

EMBEDDINGS = "text_embeddings.npy"
_KIND = {
    "teacher": str,
    "labels": str,
    "channels": int,
    "width": int,
    "map_size": [int],
    "classes": (None, [str]),
    "embeddings": bool,
}
_ADVICE = "restore the file, or fit again in another folder"


@dataclasses.dataclass(frozen=True)
class SemanticRecord:
    """What the features of a run were fitted to.

    Attributes:
        teacher: Name of the folder with the teacher's maps.
        labels: Name of the folder with the data set's own labels; empty without.
        channels: C, of the maps.
        width: D, features a Gaussian.
        map_size: (w, h) of the maps.
        classes: Names of classes 1..K, or None.
        embeddings: Whether the run has text embeddings of the classes.
    """

    teacher: str
    labels: str
    channels: int
    width: int
    map_size: tuple[int, int]
    classes: tuple[str, ...] | None
    embeddings: bool

    @classmethod
    def of(cls, dataset: Dataset, config: FitConfig, views: Sequence[View]) -> SemanticRecord | None:
        """What a fit of a data set with a config would record; None where it fits no features.

        Args:
            dataset: Data set that was loaded.
            config: Configuration of the fit.
            views: Those that may be read at the start: no other's map is looked at, as long as one of them has a map,
                and never that of a held-out view.
        """
        known = dataset.semantics if config.features.semantics == "auto" else None
        if known is None or not known.maps:
            return None
        train, _ = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)
        path = next((view.teacher_path for view in (*views, *train) if view.teacher_path is not None), None)
        if path is None:  # maps of held-out views alone teach nothing
            return None
        from drgs.features.teacher import read_map

        channels, height, width = read_map(path).shape
        # Without either file, classes would be the numbers that are found in all label images, of any view.
        classes = known.classes if known.class_file or known.embedding_file else None
        return cls(
            known.teacher,
            known.labels,
            channels,
            config.features.feature_width,
            (width, height),
            None if classes is None else classes.names,
            classes is not None and classes.embeddings is not None,
        )

    @classmethod
    def from_json(cls, value: Any, where: str) -> SemanticRecord | None:
        """The inverse of `to_json`; None where there is none.

        Raises:
            ValueError: If a field is missing or of another type, or a number is out of range.
        """
        if value is None:
            return None
        check_json(where, value, _KIND, _ADVICE)
        size, names = value["map_size"], value["classes"]
        if len(size) != 2 or min(value["channels"], value["width"], *size) < 1:
            raise ValueError(
                f"{where}: channels, width and the two numbers of map_size must be >= 1, got {value['channels']}, "
                f"{value['width']} and {size}; {_ADVICE}"
            )
        if names is not None and not (names and all(names)):
            raise ValueError(f"{where}: classes must be names, or null, got {names}; {_ADVICE}")
        fields = {name: value[name] for name in _KIND}
        return cls(**{**fields, "map_size": tuple(size), "classes": None if names is None else tuple(names)})

    def to_json(self) -> dict:
        """As config.json and the checkpoint's header hold it."""
        names = None if self.classes is None else list(self.classes)
        return {**dataclasses.asdict(self), "map_size": list(self.map_size), "classes": names}

    def write_embeddings(self, run: Path, semantics: Semantics | None) -> None:
        """Write `EMBEDDINGS` of a data set into a run folder, atomically, if there are any; no label image is read."""
        classes = semantics.classes if self.embeddings and semantics is not None else None
        if classes is None or classes.embeddings is None:
            return
        with atomic_write(run / EMBEDDINGS) as file:
            np.save(file, classes.embeddings.numpy(), allow_pickle=False)

    def read_classes(self, run: Path) -> Classes | None:
        """The classes, with their embeddings from the run folder.

        Raises:
            FileNotFoundError: If the embeddings are missing.
            ValueError: If they are damaged, or not those of these classes and channels.
        """
        import torch

        from drgs.data.checks import read_npy
        from drgs.features.segmentation import Classes

        if self.classes is None:
            return None
        if not self.embeddings:
            return Classes(self.classes)
        path = run / EMBEDDINGS
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: must hold the text embeddings of the run's classes, found none; {_ADVICE}"
            )
        array = read_npy(path)
        if array.shape != (len(self.classes), self.channels) or array.dtype != np.float32:
            raise ValueError(
                f"{path}: must be float32 of shape {(len(self.classes), self.channels)}, a row for each class, got "
                f"{array.dtype} of shape {array.shape}; {_ADVICE}"
            )
        try:
            return Classes(self.classes, torch.from_numpy(np.ascontiguousarray(array)))
        except ValueError as error:
            raise ValueError(f"{path}: {error}; {_ADVICE}") from None

    def decoder(self, networks: dict[str, dict[str, torch.Tensor]], gaussians: Gaussians, where: str) -> Decoder:
        """The fitted decoder.

        Args:
            networks: Networks that `drgs.fitting.networks.saved_networks` finds in a checkpoint.
            gaussians: Gaussians of the same checkpoint.
            where: It, for the message.
        Raises:
            ValueError: If there is none, or it does not go with the Gaussians' features or the teacher's channels.
        """
        from drgs.features.decoder import Decoder

        if "decoder" not in networks:
            raise ValueError(f"{where}: network 'decoder' must be there, as config.json says, found none; {_ADVICE}")
        decoder = Decoder.of_state(networks["decoder"], where)
        features = 0 if gaussians.features is None else gaussians.features.shape[1]
        if not (decoder.width == self.width == features and decoder.channels == self.channels):
            raise ValueError(
                f"{where}: the decoder must take {self.width} features to {self.channels} channels, as config.json "
                f"says, got one from {decoder.width} to {decoder.channels} for Gaussians with {features}; {_ADVICE}"
            )
        return decoder


def check_same_teacher(now: SemanticRecord | None, was: SemanticRecord | None, where: str) -> None:
    """Refuse to go on with another teacher, or with other classes, than a fit began with.

    Args:
        now: Record of the data set and the config; None where no features are fitted.
        was: Record of the checkpoint.
        where: It, for the message.
    Raises:
        ValueError: On the first field that differs.
    """
    new, old = ({} if record is None else record.to_json() for record in (now, was))
    for name in new | old:
        if new.get(name) != old.get(name):
            raise ValueError(
                f"{where}: --resume must continue the same fit, {name} of its semantics was {old.get(name)!r} and is "
                f"{new.get(name)!r}; repeat the options, restore the data set or choose another run folder"
            )
