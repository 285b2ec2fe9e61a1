"""`drgs scene`: data sets whose geometry, labels and teacher are known, path traced on this machine."""

from __future__ import annotations

import importlib
import inspect
import json
import shlex
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from drgs.checks.records import options_in
from drgs.commands.command_line import words_of
from drgs.commands.values import parsed_size
from drgs.display.progress import Bar
from drgs.io.json_files import read_json

if TYPE_CHECKING:
    from drgs.commands.options import Scene

_ONLY = {  # options that not every scene has
    "views": ("capture", "room", "still_life"),
    "cameras": ("kitchen", "hall"),
    "times": ("kitchen", "hall"),
    "teacher_size": ("room", "kitchen", "hall"),
    "test_every": ("room",),
    "free": ("room", "still_life", "kitchen", "hall"),
    "exposure": ("capture",),
    "wall": ("capture",),
    "shadow": ("capture",),
    "passer_by": ("capture",),
    "pose_error": ("capture",),
}


def run(args: Scene) -> None:
    """`drgs scene room -o DATA`."""
    for name, owners in _ONLY.items():
        option, value = options_in(type(args))[name], getattr(args, name)
        if value != option.default and args.name not in owners:
            scenes = " and ".join(f"`drgs scene {owner}`" for owner in owners)
            raise ValueError(f"{words_of(option, value)[0]}: is for {scenes}, not for {args.name}; leave it out")
    names = ("views", "cameras", "times", "spp", "test_every", "exposure", "wall")
    numbers: dict[str, Any] = {"seed": args.seed} | {
        name: getattr(args, name) for name in names if getattr(args, name) is not None
    }
    if args.free:
        numbers["free"] = True
    if args.name == "capture":
        numbers |= {"shadow": args.shadow, "passer_by": args.passer_by}
    if args.pose_error is not None:
        numbers["pose_error"] = _pose_error(args.pose_error)
    if args.size is not None:
        numbers |= _pair("--size", args.size, "width", "height")
    if args.teacher_size is not None:
        numbers |= _pair("--teacher-size", args.teacher_size, "teacher_width", "teacher_height")
    maker = maker_of(args.name)
    stamp = args.output / "params.json"
    before = _made_before(stamp, args.name, maker, numbers)
    with Bar("path tracing", show=not args.quiet) as bar:
        folder = maker.generate(args.output, **numbers, progress=bar.update)
    if args.quiet:
        return
    if stamp.read_bytes() == before:
        print(f"{folder}: already complete")
    _print_result(args.name, folder, maker, numbers)


def _made_before(stamp: Path, name: str, maker: ModuleType, numbers: dict[str, Any]) -> bytes | None:
    """The params.json of an output folder that holds the same data set; None where it holds none that was made.

    Raises:
        ValueError: If it holds another data set, which `generate` would replace.
    """
    if not stamp.is_file():
        return None
    made = read_json(stamp, "the parameters of a made data set", "choose another folder (-o)")
    if not isinstance(made, dict) or "scene" not in made:  # somebody else's, which `generate` refuses
        return None
    defaults = {key: one.default for key, one in inspect.signature(maker.generate).parameters.items()}
    del defaults["out_dir"], defaults["progress"]
    for key, value in {"scene": name, **defaults, **numbers}.items():
        value = list(value) if isinstance(value, tuple) else value
        if (other := made.get(key, defaults.get(key))) != value:
            raise ValueError(
                f"{stamp.parent}: -o must be a new folder or hold the same data set, holds one with {key} {other!r}, "
                f"not {value!r}; choose another folder or delete this one"
            )
    return stamp.read_bytes()


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


def _pose_error(text: str) -> tuple[float, float]:
    """Degrees and meters of --pose-error."""
    try:
        degrees, meters = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--pose-error: must be DEGREES,METERS, got {text!r}; write 0.4,0.006") from None
    return degrees, meters


def _print_result(name: str, folder: Path, maker: ModuleType, numbers: dict[str, Any]) -> None:
    """Print what there is, and the next command."""
    from drgs.fitting.config import FitConfig  # they take seconds to load, that wrong options need not wait for
    from drgs.fitting.frames import load_dataset

    config, chosen = FitConfig(), ""  # options of the fit that the data set needs
    if name == "room":
        config = config.replace(test_every=numbers.get("test_every", maker.TEST_EVERY))
        chosen = f" --test-every {config.data.test_every}"
    times = numbers.get("times", 0)
    if config.data.times is not None and times > config.data.times:
        config = config.replace(times=times)
        chosen = f" --times {times}"
    dataset = load_dataset(folder, config, lazy=True, points=False, semantics=False)
    train, test = dataset.split()
    camera = (train or test)[0].camera
    print(f"{len(train) + len(test)} views of {camera.width}x{camera.height}, {len(test)} held out")
    if name == "capture":
        truth = json.loads((folder / "truth.json").read_text())
        print(
            f"{len(truth['shadow'])} photographs with a shadow, {len(truth['passer_by'])} with a passer-by; the truth "
            "is in truth.json"
        )
    elif name != "still_life":
        right = json.loads((folder / "teacher.json").read_text())["pixel_accuracy"]
        moving = "" if name == "room" else f"{len(maker.MOVING)} of them move, "
        print(f"{len(maker.CLASSES)} classes, {moving}teacher right at {100 * right:.1f} % of the pixels")
    print(f"next: drgs fit {shlex.quote(str(folder))} -o RUN{chosen}")


def _pair(option: str, text: str, *names: str) -> dict[str, int]:
    """Name -> number of a WIDTHxHEIGHT."""
    return dict(zip(names, parsed_size(option, text), strict=True))
