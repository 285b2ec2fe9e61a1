"""`drgs scene`: data sets whose geometry, labels and teacher are known, path traced on this machine."""

from __future__ import annotations

import importlib
import json
import shlex
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from drgs.commands.overrides import parsed_size
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from drgs.commands.making_options import Scene

__all__ = ["maker_of", "run"]

_ONLY = {  # options that not every scene has
    "--views": ("room", "still_life"),
    "--cameras": ("kitchen",),
    "--times": ("kitchen",),
    "--teacher-size": ("room", "kitchen"),
    "--test-every": ("room",),
}


def run(args: Scene) -> None:
    """`drgs scene room -o DATA`."""
    given = {
        "--views": args.views,
        "--cameras": args.cameras,
        "--times": args.times,
        "--teacher-size": args.teacher_size,
        "--test-every": args.test_every,
    }
    for option, value in given.items():
        if value is not None and args.name not in _ONLY[option]:
            scenes = " and ".join(f"`drgs scene {name}`" for name in _ONLY[option])
            raise ValueError(f"{option}: is for {scenes}, not for {args.name}; leave it out")
    names = ("views", "cameras", "times", "spp", "test_every")
    numbers = {"seed": args.seed} | {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.size is not None:
        numbers |= _pair("--size", args.size, "width", "height")
    if args.teacher_size is not None:
        numbers |= _pair("--teacher-size", args.teacher_size, "teacher_width", "teacher_height")
    maker = maker_of(args.name)
    with Bar("path tracing", show=not args.quiet) as bar:
        folder = maker.generate(args.output, **numbers, progress=bar.update)
    if not args.quiet:
        _say(args.name, folder, maker, numbers)


def maker_of(name: str) -> ModuleType:
    """The module that makes a data set.

    Raises:
        FileNotFoundError: In a checkout without links.
    """
    try:
        return importlib.import_module(f"drgs.scenes.{name}")
    except ImportError:
        raise FileNotFoundError(
            "drgs/scenes must be a link to the folder scenes, it is not; clone with links (git config core.symlinks "
            "true), or install the wheel"
        ) from None


def _say(name: str, folder: Path, maker: ModuleType, numbers: dict[str, int]) -> None:
    """What was made, and what to do next."""
    every = ""
    if name != "still_life":
        right = json.loads((folder / "teacher.json").read_text())["pixel_accuracy"]
        if name == "room":
            held_out = f"{len((folder / 'test_views.txt').read_text().split())} test views"
            every = f" --test-every {numbers.get('test_every', maker.TEST_EVERY)}"
        else:
            held_out = f"{len(maker.MOVING)} of them move"
        print(f"{len(maker.CLASSES)} classes, {held_out}, teacher right at {100 * right:.1f} % of the pixels")
    print(f"next: drgs fit {shlex.quote(str(folder))} -o RUN{every}")


def _pair(option: str, text: str, *names: str) -> dict[str, int]:
    """Name -> number of a WIDTHxHEIGHT."""
    return dict(zip(names, parsed_size(option, text), strict=True))
