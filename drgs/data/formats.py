"""A format of data sets: a row of `drgs.data.LOADERS`."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from drgs.data.dataset import Dataset


@dataclasses.dataclass(frozen=True)
class Format:
    """How data sets of one format are recognized and read.

        LINES = Format(lambda path: (path / "views.txt").is_file(), load_lines, looks_for=("views.txt",))

    Attributes:
        recognizes: Whether a folder, or a file that was named itself, is such a data set; it opens no images. Formats
            are tried in the order of the table.
        load: `load(path, ...)` makes the `Dataset`. By the names of its parameters it says which options of
            `drgs.data.load` mean something to the format: of `background`, `lazy`, `points`, `strict`, `test_every`,
            `test_offset`, `times` and `test_cameras` it gets those alone.
        looks_for: Files and folders by which the format is recognized, for the message when none is.
        suffix: Suffix, with its dot, of files that are such a data set whatever their names are, where no format
            recognizes them.
    """

    recognizes: Callable[[Path], bool]
    load: Callable[..., Dataset]
    looks_for: tuple[str, ...] = ()
    suffix: str = ""

    def read(self, name: str, path: Path, options: Mapping[str, Any]) -> Dataset:
        """The data set.

        Options that the loader has no parameter for are left out: commands have one set of options for all formats, and
        `times`, say, means nothing to photographs of what stands still. Nothing else is left out: a parameter that is
        no option, as a mistyped one, would keep its default for ever, and is refused.

        Args:
            name: Name of the row, for messages.
            path: Folder or file that `recognizes` has said yes to.
            options: All options of `drgs.data.load` that are for loaders.
        Raises:
            ValueError: If the loader has another parameter, or returns no `Dataset`; else what it raises.
        """
        _, *parameters = inspect.signature(self.load).parameters
        if unknown := [parameter for parameter in parameters if parameter not in options]:
            raise ValueError(
                f"load: the loader of format {name!r} must take a path and, of the options, any of "
                f"{', '.join(options)}, has a parameter {unknown[0]}; rename or remove it"
            )
        dataset = self.load(path, **{parameter: options[parameter] for parameter in parameters})
        if not isinstance(dataset, Dataset):
            raise ValueError(
                f"load: the loader of format {name!r} must return a drgs.data.Dataset, got {type(dataset).__name__}; "
                "return Dataset(path, name, views)"
            )
        return dataset
