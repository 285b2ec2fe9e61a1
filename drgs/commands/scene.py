"""`drgs scene`: data sets whose geometry, labels and teacher are known, path traced on this machine."""

from __future__ import annotations

import importlib
import json
from typing import TYPE_CHECKING

from drgs.commands.overrides import parsed_size
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from drgs.commands.options import Scene

__all__ = ["run"]


def run(args: Scene) -> None:
    """`drgs scene room -o DATA`."""
    numbers = {"seed": args.seed} | _pair("--size", args.size, "width", "height")
    numbers |= {name: value for name, value in (("views", args.views), ("spp", args.spp)) if value is not None}
    for option, value in (("--teacher-size", args.teacher_size), ("--test-every", args.test_every)):
        if value is not None and args.name != "room":
            raise ValueError(f"{option}: is for `drgs scene room`, not for a still life; leave it out")
    numbers |= {} if args.test_every is None else {"test_every": args.test_every}
    if args.teacher_size is not None:
        numbers |= _pair("--teacher-size", args.teacher_size, "teacher_width", "teacher_height")
    try:
        maker = importlib.import_module(f"scenes.{args.name}")
    except ImportError:
        raise FileNotFoundError(
            "scene: the package `scenes` must be installed, it is not; run `pip install -e .` in a checkout"
        ) from None
    with Bar("path tracing", show=not args.quiet) as bar:
        folder = maker.generate(args.output, **numbers, progress=bar.update)
    if args.quiet:
        return
    if args.name == "room":
        right = json.loads((folder / "teacher.json").read_text())["pixel_accuracy"]
        tested = len((folder / "test_views.txt").read_text().split())
        print(f"{len(maker.CLASSES)} classes, {tested} test views, teacher right at {100 * right:.1f} % of the pixels")
        print(f"next: drgs fit {folder} -o RUN --test-every {numbers.get('test_every', maker.TEST_EVERY)}")
    else:
        print(f"next: drgs fit {folder} -o RUN")


def _pair(option: str, text: str, *names: str) -> dict[str, int]:
    """Name -> number of a WIDTHxHEIGHT."""
    return dict(zip(names, parsed_size(option, text), strict=True))
