"""`drgs render -o NAME.mp4`: one film, or one picture, and nothing beside it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.display.pictures import file_names

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.options import Render

__all__ = ["LoneFile", "lone_file"]

_FILMS = ("mp4", "webm")
_PICTURES = ("png", "jpg", "exr")
_MORE = ("depth", "features", "labels", "overlay", "moving")  # options that write more files


@dataclasses.dataclass(frozen=True)
class LoneFile:
    """A film, or a picture, that is written alone.

    Attributes:
        path: Path of the file, as it was given.
    """

    path: Path

    @property
    def folder(self) -> Path:
        """Folder of the file."""
        return self.path.parent

    @property
    def name(self) -> str:
        """Name of the file in its folder."""
        return self.path.name

    @property
    def stem(self) -> str:
        """Name of the film, or of the view, without its suffix."""
        return self.path.stem

    @property
    def format(self) -> str:
        """What it is written as."""
        return self.path.suffix[1:]

    def named(self, cameras: list[Camera]) -> list[Camera]:
        """The cameras, the one of a picture by the name of the file.

        Raises:
            ValueError: If a picture would be of several cameras.
        """
        if self.format in _FILMS:
            return cameras
        if len(cameras) != 1:
            raise ValueError(
                f"{self.path}: must be a folder for {len(cameras)} views, a file holds one; name a folder, or choose "
                "with --view or --limit 1"
            )
        return [dataclasses.replace(cameras[0], name=self.stem)]


def lone_file(args: Render) -> LoneFile | None:
    """The file that `-o` names; None where it names a folder: one that is there, or a name without such a suffix.

    Raises:
        ValueError: If `--format`, or an option that writes more files, says otherwise; or for a picture's name that
            would be written otherwise.
    """
    path = args.output
    known = (*_FILMS, *_PICTURES)
    if path.suffix[1:].lower() not in known or path.is_dir():
        return None
    if path.suffix[1:] not in known:
        raise ValueError(f"{path}: must end in {path.suffix.lower()} in small letters; rename it")
    found = LoneFile(path)
    if args.format not in (None, found.format):
        raise ValueError(
            f"render: --format must be left out with -o {path}, got {args.format!r}; drop it, or name a folder"
        )
    for name in _MORE:
        if getattr(args, name):
            raise ValueError(f"render: --{name} must have a folder to write into, -o {path} is one file; name a folder")
    if found.format in _PICTURES and file_names([found.stem]) != [found.stem]:
        raise ValueError(f"{path}: must have a name of letters, digits, - _ and . alone; rename it")
    return found
