"""The page of `drgs COMMAND --help`: options in the order in which a person needs them, the everyday ones first.

All of it is read from the command's dataclass; what is stated here is only what goes where. Imports nothing heavy.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import shutil
import textwrap
import typing
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from drgs.commands.orbit_keys import ORBIT_KEYS
from drgs.commands.record_options import HIDDEN, OF_RECORD

__all__ = ["EVERYDAY", "HEADINGS", "Option", "help_page", "options_in", "written"]

_POSITIONAL = typing.get_args(Positional[int])[1]
_WIDEST = 100
_INDENT = 26  # columns of an option, before its text

HEADINGS = ("Run", "Data", "Views", "Quality", "Features", "Motion", "Rendering", "Machine")
"""Headings, in their order."""

_HEADING_OF_RECORD = {
    "FitConfig": "Run",
    "SavingConfig": "Run",
    "DataConfig": "Data",
    "SelectionConfig": "Views",
    "Scoring": "Views",
    "DensityConfig": "Quality",
    "RateConfig": "Quality",
    "LossConfig": "Quality",
    "FeatureConfig": "Features",
    "MotionConfig": "Motion",
}
"""Record -> the heading of its fields."""

_HEADING_OF_NAME = {
    **dict.fromkeys(("times", "test_cameras", "strict", "lpips_weights"), "Data"),
    **dict.fromkeys(("cameras", "candidates", "train", "selection", "views", "split", "limit", "count"), "Views"),
    **dict.fromkeys(("orbit", "time", "view", "frames", "prior", "relative_prior", "k"), "Views"),
    **dict.fromkeys(("renderers", "preset", "overrides", "background", "width", "height", "scale"), "Rendering"),
    **dict.fromkeys(("variant", "threads", "deterministic", "scheduler", "workers", "quiet", "debug"), "Machine"),
    **dict.fromkeys(("sh_degree", "filter_3d"), "Quality"),
}
"""Option -> its heading, where it is not its record's; of others it is the first."""

_COMMON = ("variant", "threads", "quiet", "debug")
EVERYDAY: dict[str, tuple[str, ...]] = {
    "fit": (
        *("data", "output", "config", "resume", "max_steps", "max_pixels", "test_every", "times", "mask", "views"),
        *("policy", "add", "max_gaussians", "sh_degree", "semantics", "dynamics", "renderers", "preset"),
        *("background", "seed"),
        *_COMMON,
    ),
    "select": (
        *("scene", "candidates", "k", "output", "config", "train", "split", "orbit", "count", "time", "policy"),
        *("criterion", "blocks", "prior", "info_pixels", "preset", "overrides", *_COMMON),
    ),
    "fisher": (
        *("scene", "output", "cameras", "train", "limit", "maps", "pose", "orbit", "count", "time", "method"),
        *("blocks", "prior", "preset", "overrides", *_COMMON),
    ),
    "render": (
        *("scene", "output", "format", "cameras", "orbit", "frames", "time", "view", "limit", "depth", "features"),
        *("labels", "preset", "overrides", "width", "height", *_COMMON),
    ),
    "view": (
        *("scene", "host", "port", "token", "open", "train", "selection", "orbit", "blocks", "prior", "max_pixels"),
        *("preset", "overrides", *_COMMON),
    ),
    "query": (
        *("scene", "output", "classes", "text_embedding", "threshold", "remove", "cameras", "orbit", "limit"),
        *("max_pixels", "preset", "overrides", *_COMMON),
    ),
    "crossval": (
        *("scene", "output", "rasterizer", "export", "ladder", "strict", "cameras", "orbit", "limit", "max_pixels"),
        *("preset", "overrides", *_COMMON),
    ),
    "tradeoff": (
        *("scene", "output", "max_error", "repeats", "seconds", "cameras", "orbit", "limit", "max_pixels"),
        *("preset", "overrides", *_COMMON),
    ),
}
"""Command -> what its `--help` shows, in this order under each heading; other commands show all that they have."""


@dataclasses.dataclass(frozen=True)
class Option:
    """A line of the page.

    Attributes:
        name: Name of the field.
        flags: Spelling on the command line: `-o, --output PATH`, of a positional argument `DATA`.
        text: What it does.
        default: Default in a person's spelling; empty where there is none or the text says it.
        heading: One of `HEADINGS`.
        positional, required: Whether it stands without a name, and whether it must.
    """

    name: str
    flags: str
    text: str
    default: str
    heading: str
    positional: bool
    required: bool


def help_page(command: str, kind: type, everything: bool = False, instance: Any = None) -> str:
    """The page of a command.

    Args:
        command: Its name.
        kind: The dataclass of its options.
        everything: All options, not only those of every day.
        instance: The options as a file of --config has them; their values are shown as defaults.
    """
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    found = {option.name: option for option in options_in(kind, instance)}
    order = [name for name in EVERYDAY.get(command, ()) if name in found]
    shown = [found[name] for name in order] or [*found.values()]
    if everything:
        shown = [*shown, *(option for option in found.values() if option not in shown)]
    wanted = [option for option in shown if option.positional or option.required]
    words = [option.flags.split(", ")[0] if option.positional else option.flags.split(", ")[-1] for option in wanted]
    described = " ".join((kind.__doc__ or "").split())
    lines = [f"usage: drgs {command} {' '.join([*words, '[options]'])}", "", *textwrap.wrap(described, width)]
    for heading in HEADINGS:
        inside = sorted((x for x in shown if x.heading == heading), key=lambda option: not option.positional)
        if inside:
            lines += ["", heading]
        for option in inside:
            lines += _lines(option, width)
            if option.name == "orbit":
                for key in kind.orbit_keys:  # type: ignore[attr-defined]
                    lines += _entry(f"    {key}", ORBIT_KEYS[key], width)
    left = len(found) - len(shown)
    if left:
        lines += ["", f"{left} more: drgs {command} --help-all"]
    return "\n".join(lines) + "\n"


def _lines(option: Option, width: int) -> list[str]:
    """Name and text of an option."""
    end = " (required)" if option.required and not option.positional else ""
    end = f" (default: {option.default})" if option.default else end
    return _entry(f"  {option.flags}", option.text + end, width)


def _entry(head: str, text: str, width: int) -> list[str]:
    wrapped = textwrap.wrap(text, max(width - _INDENT, 30))
    if len(head) > _INDENT - 2:
        return [head, *(" " * _INDENT + line for line in wrapped)]
    first, *others = wrapped or [""]
    return [f"{head:<{_INDENT}}{first}".rstrip(), *(" " * _INDENT + line for line in others)]


def options_in(kind: type, instance: Any = None) -> Iterator[Option]:
    """All options of a command that it has on its command line, those of its own first.

    Args:
        kind: The dataclass.
        instance: Options whose values are the defaults; None: the defaults are the dataclass's.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    texts = _texts(kind)
    fields = sorted(dataclasses.fields(kind), key=lambda field: field.name not in kind.__annotations__)
    for field in fields:
        if field.metadata.get(HIDDEN):
            continue
        marks = (
            typing.get_args(hints[field.name])[1:] if typing.get_origin(hints[field.name]) is typing.Annotated else ()
        )
        marks = tuple(x for mark in marks for x in (mark if isinstance(mark, tuple) else (mark,)))
        bare = typing.get_args(hints[field.name])[0] if marks else hints[field.name]
        said = {name: x for mark in marks for name in ("name", "help", "metavar") if (x := getattr(mark, name, None))}
        spec = next((mark for mark in marks if hasattr(mark, "str_from_instance")), None)
        aliases = [alias for mark in marks for alias in (getattr(mark, "aliases", None) or ())]
        positional = _POSITIONAL in marks
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        value = field.default if required or instance is None else getattr(instance, field.name)
        metavar = str(said.get("metavar") or _metavar(bare))
        option = "--" + str(said.get("name", field.name)).replace("_", "-")
        if bare is bool and value is True:
            option = "--no-" + option[2:]
        if positional:
            flags = metavar if metavar.startswith("{") else str(said.get("metavar", field.name.upper()))
        else:
            flags = ", ".join([*aliases, option]) + (f" {metavar}" if metavar else "")
        if required or bare is bool:
            default = ""
        elif spec is not None:
            default = "" if value is None else spec.str_from_instance(value)[0]
        else:
            default = written(value)
        of_record = _HEADING_OF_RECORD.get(field.metadata.get(OF_RECORD, ""), HEADINGS[0])
        heading = _HEADING_OF_NAME.get(field.name, of_record)
        text = str(said.get("help", texts.get(field.name, "")))
        yield Option(field.name, flags, text, default, heading, positional, required)


def written(value: Any) -> str:
    """A default as a person writes it: 3/17, 1.6e-4; empty for None and for nothing."""
    if value is None or value == ():
        return ""
    if isinstance(value, tuple):
        return " ".join(map(written, value))
    if not isinstance(value, float):
        return str(value)
    if value == int(value):
        return str(int(value))
    if len(repr(value)) > 12:
        near = Fraction(value).limit_denominator(1000)
        if float(near) == value:
            return str(near)
    if abs(value) >= 0.01:
        return repr(value)
    digits, _, power = f"{value:e}".partition("e")
    short = f"{digits.rstrip('0').rstrip('.')}e{int(power)}"
    return short if float(short) == value else repr(value)


def _metavar(hint: Any) -> str:
    """What stands for a value of a type."""
    origin, kinds = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return "{" + ",".join(map(str, kinds)) + "}"
    if origin is tuple:
        one = _metavar(kinds[0])
        return f"{one} [{one} ...]" if kinds[-1] is Ellipsis else " ".join(map(_metavar, kinds))
    if kinds:  # a union
        return "|".join(_metavar(kind) for kind in kinds if kind is not type(None))
    return {bool: "", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}[hint]


def _texts(kind: type) -> dict[str, str]:
    """Option -> the text that stands below its field, in the class or in one that it inherits from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base) and base.__module__.startswith("drgs."):
            found |= _stated_below(Path(inspect.getfile(base))).get(base.__name__, {})
    return found


@functools.cache
def _stated_below(path: Path) -> dict[str, dict[str, str]]:
    """Class -> field -> the text below it, of a module."""
    found: dict[str, dict[str, str]] = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            texts = found.setdefault(node.name, {})
            for field, text in zip(node.body, node.body[1:], strict=False):
                if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                    value = text.value if isinstance(text, ast.Expr) else None
                    if isinstance(value, ast.Constant) and isinstance(value.value, str):
                        texts[field.target.id] = " ".join(value.value.split())
    return found
