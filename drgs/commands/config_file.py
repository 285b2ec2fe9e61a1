"""`--config FILE`: fields of a fit's configuration from a TOML or JSON file, or from a run.

The file holds what `drgs.fitting.config.FitConfig.to_json` makes, or a part of it: fields that it leaves out stay as
they are. `settings` may name a `preset`, whose fields the others replace. Imports nothing heavy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drgs.commands.overrides import override
from drgs.fitting.config import FitConfig, recorded_config
from drgs.fitting.renderers import AUTO
from drgs.guards.records import Record, hints_of, nearest, part_of, stated
from drgs.io.json_files import read_json, read_toml
from drgs.settings import RenderSettings

__all__ = ["config_fields", "default_of", "named_config"]

_ADVICE = "correct the file"
_PRESET = "fast"  # as a fit has it


def named_config(words: Sequence[str]) -> Path | None:
    """The file that a command line names by --config, the last one if there are several; None if none."""
    found = None
    for word, following in zip(words, [*words[1:], None], strict=True):
        option, equals, value = word.partition("=")
        if option == "--config":
            found = value if equals else following
    return None if found is None else Path(found)


def config_fields(path: Path, words: Sequence[str] = ()) -> dict[str, Any]:
    """The fields that a file states, by their names in `FitConfig` and its parts.

    Where it has a selection, `selection` is among them, and its fields beside it.

    Args:
        path: The file, or a run folder.
        words: Words of the command line, which alone may name functions of other packages.
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
    try:
        if isinstance(value, dict) and isinstance(value.get("fit"), dict):  # a run's own
            fields = _fields_of(recorded_config(value["fit"], value.get("active") or None))
        else:
            if isinstance(value, dict) and isinstance(value.get("settings"), dict):
                settings = dict(value["settings"])
                if unknown := [name for name in settings if name not in {*hints_of(RenderSettings), "preset"}]:
                    near = nearest(unknown[0], hints_of(RenderSettings))
                    raise ValueError(f"settings must hold known fields, got {unknown[0]!r}; {near}")
                lists = {name: tuple(x) if isinstance(x, list) else x for name, x in settings.items()}
                made = RenderSettings.preset(lists.pop("preset", _PRESET), **lists)
                value = value | {"settings": dataclasses.asdict(made)}
            fields = stated(FitConfig, value)
        FitConfig.of(**fields)
    except (ValueError, NotImplementedError) as error:
        text = str(error).removeprefix(f"{FitConfig.where}: ")
        raise ValueError(f"{path}: {text}" + ("" if ";" in text else f"; {_ADVICE}")) from None
    for name in ("policy", "criterion"):
        # Importing runs a module: that is for the person at the command line to ask for, not for a file from elsewhere.
        if ":" in str(fields.get(name, "")) and not any(word.partition("=")[0] == f"--{name}" for word in words):
            raise ValueError(
                f"{path}: {name} must be a name in a file, got {fields[name]!r}, which would be imported; add "
                f"--{name} {fields[name]} if you trust it"
            )
    return fields


def default_of(options: type, fields: Mapping[str, Any], required: Any) -> Any:
    """The options of a command as they are where its command line says nothing, with the fields of a file.

    Args:
        options: The dataclass of the command.
        fields: Result of `config_fields`; what the command has no use for is passed over.
        required: What stands for an option that has no default.
    """
    given = dict(fields)
    settings = given.pop("settings", None)
    if settings is not None:
        preset, differences = settings.nearest_preset()
        # `auto` is said by no preset: naming fast would mean fast alone.
        if not (preset == _PRESET and tuple(given.get("renderers", ())) == AUTO and hasattr(options, "renderers")):
            given["preset"] = preset
        given["overrides"] = tuple(override(name, x) for name, x in differences.items())
        if hasattr(options, "background"):
            given["background"] = settings.background
        elif settings.background != RenderSettings.background:
            given["overrides"] += (override("background", settings.background),)
    if "prior" in given:
        prior = given.pop("prior")
        if prior is not None:
            given |= {"prior": prior.value, "relative_prior": prior.relative, "prior_groups": dict(prior.groups)}
    if given.pop("selection", None) is not None:
        given["views"] = "active"
    own = {field.name: field for field in dataclasses.fields(options)}
    bare = [
        name
        for name, field in own.items()
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    ]
    return options(**dict.fromkeys(bare, required) | {name: x for name, x in given.items() if name in own})


def _fields_of(record: Record) -> dict[str, Any]:
    """All fields of a record and of its parts, by their names."""
    found: dict[str, Any] = {}
    for name, hint in hints_of(type(record)).items():
        value = getattr(record, name)
        if part_of(hint) is None or value is None or name == "selection":
            found[name] = value
        if isinstance(value, Record):
            found |= _fields_of(value)
    return found
