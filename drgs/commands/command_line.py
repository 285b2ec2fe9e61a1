"""The command line: words to options, options to help, and files of `--config`; all by what fields say of themselves.

    words  ->  name of an option -> its value  ->  the frozen dataclass of the command, nested records inside
                     ^
    a file of --config, whose nested objects are the records of `drgs.fitting.config.FitConfig`

What an option is called, may be and means is stated once, where its field is declared (`drgs.checks.records`). Imports
nothing heavy.
"""

from __future__ import annotations

import dataclasses
import itertools
import shutil
import textwrap
import typing
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from drgs.checks.records import Option, hints_of, nearest, nested, options_in, stated, ways_of
from drgs.commands.options import Common
from drgs.commands.values import ORBIT_KEYS, override
from drgs.fitting.config import FitConfig
from drgs.fitting.renderers import AUTO
from drgs.io.json_files import read_json, read_toml
from drgs.settings import RenderSettings

HEADINGS = ("Run", "Data", "Views", "Quality", "Features", "Motion", "Rendering", "Machine")
"""Headings of help, in their order."""

_MOST_COLUMNS = 100  # columns of help, at most, in a wider terminal: longer lines read badly; chosen
_INDENT = 26  # columns of an option's name, before its text; chosen
_ADVICE = "correct the file"
_PRESET = "fast"  # as a fit has it
_ALSO_CALLED = {
    "--data": "--train",
    "--train": "--data",
    "--iterations": "--max-steps",
    "--iters": "--max-steps",
    "--max-steps": "--budget",
}
"""Options of other commands and of other trainers -> what they are called where only that is known."""


# ------------------------------------------------------------------------------------------------ words to options


def parsed_options(
    kind: type[Common], words: Sequence[str], commands: Mapping[str, type[Common]] = MappingProxyType({})
) -> Any:
    """The options of a command.

    Args:
        kind: Their dataclass.
        words: What follows the command's name on the command line.
        commands: All commands, to say which has an option that this one lacks.
    Raises:
        ValueError: If an option is unknown, has no value or a wrong one, or is missing; and as the dataclass says.
        OSError: If the file of --config cannot be read.
    """
    options = options_in(kind)
    line = _read(options, words, commands)
    given = _of_file(kind, line)
    for name, value in line.items():
        given[name] = (*given.get(name, ()), *value) if options[name].spec.repeat else value
    if missing := [option for name, option in options.items() if _is_required(option) and name not in given]:
        names = " and ".join(_flags(option).split(", ")[-1] for option in missing)
        raise ValueError(f"{missing[0].flag} must be given, is missing; add {names}")
    return nested(kind, None, kind.values(given, line))


def _read(options: Mapping[str, Option], words: Sequence[str], commands: Mapping[str, type[Common]]) -> dict[str, Any]:
    """Name of an option -> its value, of those that words name."""
    places = [option for option in options.values() if option.spec.positional]
    flags = {option.flag: option for option in options.values() if not option.spec.file_only and option not in places}
    short = {f"-{option.spec.short}": option for option in options.values() if option.spec.short}
    given: dict[str, Any] = {}
    alone: list[str] = []
    left = list(words)
    while left:
        word = left.pop(0)
        if word == "--":
            alone += left
            break
        if not _is_flag(word):
            alone.append(word)
            continue
        if word.startswith("--"):
            flag, equals, value = word.partition("=")
            flag = flag.replace("_", "-")
        else:
            flag, equals, value = word[:2], word[2:3], word[2:].removeprefix("=")
        option = flags.get(flag) or short.get(flag)
        is_no = option is None and flag.startswith("--no-") and "--" + flag[5:] in flags
        option = flags["--" + flag[5:]] if is_no else option
        if option is None or (is_no and option.hint is not bool):
            near = _nearest_option(flag, list(flags), [option.flag for option in places])
            owners = [name for name, other in commands.items() if flag in (x.flag for x in options_in(other).values())]
            of_others = f" (it is one of drgs {', '.join(owners)})" if owners else ""
            raise ValueError(f"{flag} must be an option of this command{of_others}, is none; {near}")
        if option.hint is bool:
            if equals:
                opposite = option.flag if is_no else f"--no-{option.flag[2:]}"
                raise ValueError(f"{flag} must be without a value, got {value!r}; drop it, or say {opposite}")
            given[option.name] = not is_no
            continue
        value = _values(option, [value] if equals else _taken(option, left))
        given[option.name] = (*given.get(option.name, ()), value) if option.spec.repeat else value
    for option in places:
        if alone:
            several = _kinds(option.hint)[-1:] == (Ellipsis,)
            given[option.name] = _values(option, alone if several else alone[:1])
            alone = [] if several else alone[1:]
    if alone:
        known = " ".join(option.flag for option in places) or "none"
        raise ValueError(
            f"arguments must be {known}, got {alone[0]!r} besides; drop it, or quote a path that has spaces"
        )
    return given


def _nearest_option(flag: str, flags: Sequence[str], places: Sequence[str]) -> str:
    """Advice for an unknown option: what it is called here, what stands alone, or the name that is most like it."""
    if (name := flag[2:].upper()) in places:
        return f"{name} has no option: it stands alone"
    if _ALSO_CALLED.get(flag) in flags:
        return f"did you mean {_ALSO_CALLED[flag]}?"
    return nearest(flag.lstrip("-"), [x[2:] for x in flags]).replace("did you mean ", "did you mean --")


def _is_flag(word: str) -> bool:
    """Whether a word names an option: numbers with a minus do not."""
    return word.startswith("--") or (len(word) > 1 and word[0] == "-" and word[1].isalpha())


def _taken(option: Option, left: list[str]) -> list[str]:
    """The words that are an option's value, taken from those that are left: one, or as many as a tuple has elements; of
    a tuple of any length all that can be elements.
    """
    kinds = () if option.spec.repeat or option.spec.commas else _kinds(option.hint)
    is_open = kinds[-1:] == (Ellipsis,)
    taken: list[str] = []
    while left and not _is_flag(left[0]) and (is_open or len(taken) < max(len(kinds), 1)):
        if is_open and taken and not _is_one(option, kinds[0], left[0]):
            break  # it stands alone
        taken.append(left.pop(0))
    return taken


def _is_one(option: Option, kind: Any, word: str) -> bool:
    """Whether a word is a value of a type."""
    try:
        _converted(option, kind, word)
    except ValueError:
        return False
    return True


def _values(option: Option, words: Sequence[str]) -> Any:
    """The value of an option by the words that state it."""
    kinds = _kinds(option.hint)
    if not words:
        raise ValueError(f"{option.flag} must have a value, {_metavar_of(option)}, got none; add it")
    if words[0] == option.spec.none:
        return () if option.spec.commas else None
    if option.spec.commas:
        return tuple(name.strip() for name in words[0].split(","))
    if not kinds or option.spec.repeat:
        return _converted(option, kinds[0] if kinds else option.hint, words[0])
    if kinds[-1] is Ellipsis:
        return tuple(_converted(option, kinds[0], word) for word in words)
    if len(words) != len(kinds):
        raise ValueError(f"{option.flag} must have {len(kinds)} values, got {' '.join(words)}; add the others")
    return tuple(_converted(option, kind, word) for kind, word in zip(kinds, words, strict=True))


def _kinds(hint: Any) -> tuple[Any, ...]:
    """The types of a tuple's elements, be it optional; empty for other types."""
    for kind in (hint, *typing.get_args(hint)):
        if typing.get_origin(kind) is tuple:
            return typing.get_args(kind)
    return ()


def _converted(option: Option, hint: Any, word: str) -> Any:
    """A word as a value of a type.

    Raises:
        ValueError: If it is none.
    """
    hint = next((kind for kind in _union(hint) if kind is not type(None)), hint)
    if typing.get_origin(hint) is Literal:
        choices = {str(x): x for x in typing.get_args(hint)}
        if word not in choices:
            raise ValueError(
                f"{option.flag} must be one of {', '.join(choices)}, got {word!r}; {nearest(word, choices)}"
            )
        return choices[word]
    kinds: dict[Any, tuple[Callable[[str], Any], str]] = {
        int: (int, "a whole number"),
        float: (float, "a number"),
        Path: (Path, "a path"),
    }
    convert, what = kinds.get(hint, (str, "a text"))
    try:
        return convert(word)
    except ValueError:
        raise ValueError(f"{option.flag} must be {what}, got {word!r}; correct it") from None


def _union(hint: Any) -> tuple[Any, ...]:
    """The types of a union; the type itself where it is none."""
    if typing.get_origin(hint) in (Literal, tuple):
        return (hint,)
    return typing.get_args(hint) or (hint,)


def _is_required(option: Option) -> bool:
    return option.default is dataclasses.MISSING


def words_of(option: Option, value: Any) -> list[str]:
    """The words of a command line that set an option: what `_read` reads its value from."""
    if isinstance(value, bool):
        return [option.flag if value else "--no-" + option.flag[2:]]
    if option.spec.commas:
        return [option.flag, ",".join(value) or option.spec.none or ""]
    several = value if isinstance(value, tuple | list) else [value]
    return [option.flag, *(repr(x) if isinstance(x, float) else str(x) for x in several)]


# ---------------------------------------------------------------------------------------------- files of --config


def config_fields(path: Path, line: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `FitConfig` and its records that a file states, by their names, as `FitConfig.replace` takes them.

    The file holds what `FitConfig.to_json` makes, or a part of it, or is a run's config.json; `settings` may name a
    `preset`, whose fields the others replace.

    Args:
        path: The file, or a run folder.
        line: Options of the command line, which alone may name functions of other packages.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no TOML or JSON, or names an unknown field, or a value has another type or is out of range,
            or is a function of another package that the command line does not name, too.
    """
    path = path / "config.json" if path.is_dir() else path
    kinds = {".json": read_json, ".toml": read_toml}
    if path.suffix.lower() not in kinds:
        raise ValueError(f"--config: must be a .toml or .json file, or a run folder, got {path}; rename it")
    value = kinds[path.suffix.lower()](path, "a configuration", _ADVICE)
    if isinstance(value, dict) and isinstance(value.get("fit"), dict):  # a run's own
        value = value["fit"]
    try:
        if isinstance(value, dict) and isinstance(value.get("settings"), dict):
            value = value | {"settings": _settings(value["settings"])}
        values = stated(FitConfig, value)
        nested(FitConfig, None, values)
    except (ValueError, NotImplementedError) as error:
        text = str(error).removeprefix(f"{FitConfig.where}: ")
        raise ValueError(f"{path}: {text}" + ("" if ";" in text else f"; {_ADVICE}")) from None
    names = {way: name for name, way in ways_of(FitConfig).items()}
    fields = {names[way]: x for way, x in values.items()}
    for name in ("policy", "criterion"):
        # Importing runs a module: that is for the person at the command line to ask for, not for a file from elsewhere.
        if ":" in str(fields.get(name, "")) and name not in line:
            raise ValueError(
                f"{path}: {name} must be a name in a file, got {fields[name]!r}, which would be imported; add "
                f"--{name} {fields[name]} if you trust it"
            )
    return fields


def _settings(fields: Mapping[str, Any]) -> dict[str, Any]:
    """All render settings of those that a file states."""
    known = hints_of(RenderSettings)
    if unknown := [name for name in fields if name not in {*known, "preset"}]:
        raise ValueError(f"settings must hold known fields, got {unknown[0]!r}; {nearest(unknown[0], known)}")
    lists = {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}
    return dataclasses.asdict(RenderSettings.preset(lists.pop("preset", _PRESET), **lists))


def _of_file(kind: type[Common], line: Mapping[str, Any]) -> dict[str, Any]:
    """Name of an option of a command -> its value in the file that --config names; what the command has no option for
    is passed over.
    """
    options = options_in(kind)
    path = line.get("config")
    if path is None or "overrides" not in options:  # `reproduce` lays the file over the fits of its scale
        return {}
    fields = config_fields(path, line)
    settings = fields.pop("settings", None)
    if settings is not None:
        preset, differences = settings.nearest_preset()
        # No preset says `auto`: naming fast would mean fast alone.
        if not (preset == _PRESET and tuple(fields.get("renderers", ())) == AUTO and "renderers" in options):
            fields["preset"] = preset
        if "background" in options:
            fields["background"] = settings.background
        elif settings.background != RenderSettings.background:
            differences = {**differences, "background": settings.background}
        fields["overrides"] = tuple(override(name, x) for name, x in differences.items())
    if fields.get("selection") is not None:
        fields["views"] = "active"
    return {name: x for name, x in fields.items() if name in options}


# ------------------------------------------------------------------------------------------------------------ help


def command_list(commands: Mapping[str, type[Common]]) -> str:
    """The page of `drgs --help`."""
    width = _width()
    lines = ["usage: drgs COMMAND [options]", ""]
    lines += ["Differentiable Gaussian rendering, exact gradients, any CPU.", "Version: drgs --version"]
    lines += ["", "Commands (drgs COMMAND --help says more)"]
    for name, kind in commands.items():
        lines += _entry(f"  {name}", " ".join((kind.__doc__ or "").split()), width, 14)
    return "\n".join(lines) + "\n"


def help_page(command: str, kind: type[Common], words: Sequence[str] = ()) -> str:
    """The page of a command: what it works on and where it writes first, then by headings.

    Args:
        command: Its name.
        kind: The dataclass of its options.
        words: What follows its name on the command line. With `--help-all` there are all options, else those that are
            not rare; of a file of `--config`, its values are shown as defaults.
    """
    width = _width()
    everything = "--help-all" in words
    options = {name: option for name, option in options_in(kind).items() if not option.spec.file_only}
    defaults = _of_file(kind, _config_of(words)) if "config" in options else {}
    shown = [option for option in options.values() if everything or not option.spec.rare]
    wanted = [option for option in shown if option.spec.positional]
    wanted += [option for option in shown if _is_required(option) and not option.spec.positional]
    usage = [_flags(option).split(", ")[-1] for option in wanted]
    lines = [f"usage: drgs {command} {' '.join([*usage, '[options]'])}", ""]
    lines += textwrap.wrap(" ".join((kind.__doc__ or "").split()), width)
    for heading in HEADINGS:
        inside = sorted((x for x in shown if x.heading == heading), key=lambda option: not option.spec.positional)
        lines += ["", heading] if inside else []
        for option in inside:
            lines += _entry(f"  {_flags(option)}", _text(option, defaults), width)
            if option.name == "orbit":
                for key in kind.orbit_keys:  # type: ignore[attr-defined]
                    lines += _entry(f"    {key}", ORBIT_KEYS[key], width)
    if left := len(options) - len(shown):
        lines += ["", f"{left} more: drgs {command} --help-all"]
    return "\n".join(lines) + "\n"


def _config_of(words: Sequence[str]) -> dict[str, Any]:
    """The file that words name by --config, whatever else they say, for a help page."""
    line: dict[str, Any] = {}
    for word, following in itertools.pairwise([*words, ""]):
        flag, equals, value = word.partition("=")
        if flag == "--config":
            line["config"] = Path(value if equals else following)
    return line


def _width() -> int:
    return min(shutil.get_terminal_size().columns, _MOST_COLUMNS)


def _flags(option: Option) -> str:
    """Spelling of an option in help: `-o, --output PATH`; of a positional one `DATA`."""
    metavar = _metavar_of(option)
    if option.spec.positional:
        return metavar if metavar.startswith("{") else option.flag
    flag = "--no-" + option.flag[2:] if option.hint is bool and option.default is True else option.flag
    return ", ".join([*([f"-{option.spec.short}"] if option.spec.short else []), flag]) + (
        f" {metavar}" if metavar else ""
    )


def _text(option: Option, defaults: Mapping[str, Any]) -> str:
    """What an option does, and its default where the text does not say it."""
    if _is_required(option):
        return option.spec.help + ("" if option.spec.positional else " (required)")
    value = defaults.get(option.name, option.default)
    if option.hint is bool:
        return option.spec.help
    default = ",".join(value or ()) if option.spec.commas else written(value)
    if option.spec.shown is not None and option.name not in defaults:
        default = option.spec.shown
    return option.spec.help + (f" (default: {default})" if default else "")


def _entry(head: str, text: str, width: int, indent: int = _INDENT) -> list[str]:
    """An option and its text, on as many lines as it takes."""
    wrapped = textwrap.wrap(text, max(width - indent, 30))
    if len(head) > indent - 2:
        return [head, *(" " * indent + line for line in wrapped)]
    first, *others = wrapped or [""]
    return [f"{head:<{indent}}{first}".rstrip(), *(" " * indent + line for line in others)]


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


def _metavar_of(option: Option) -> str:
    """What stands in help for the value of an option."""
    if option.spec.metavar:
        return option.spec.metavar
    return _metavar(option.hint)


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
