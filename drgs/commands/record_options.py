"""Options that are fields of a record: name, type, default and help text are the record's, and stated there alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Annotated, Any

from tyro.conf import Fixed, Suppress, arg
from tyro.constructors import PrimitiveConstructorSpec

from drgs.guards.records import Record, hints_of, part_of, texts_of
from drgs.information.choices import Criterion, Policy

__all__ = ["BLOCKS_TEXT", "CAMERAS_TEXT", "CARRIED", "HIDDEN", "OF_RECORD", "options_of"]

OF_RECORD = "record"
"""Metadata of an option that is a field of a record: the name of that."""
HIDDEN = "hidden"
"""Metadata of a field that no option sets, but a file of --config does."""


def _names(metavar: str, unset: str = "", empty: str | None = None) -> Any:
    """How an option takes several names, as one text with commas.

    Args:
        metavar: What help shows for it.
        unset: What help shows where nothing is chosen; names are checked where they are used.
        empty: Word for no name at all; None: there is none.
    """
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda texts: (
            () if texts[0] == empty else tuple(name.strip() for name in texts[0].split(","))
        ),
        is_instance=lambda x: x is None or isinstance(x, tuple),
        str_from_instance=lambda x: [unset if x is None else ",".join(x) or empty or ""],
    )


BLOCKS_TEXT: Any = _names("BLOCK,BLOCK", unset="all there is")
CAMERAS_TEXT: Any = _names("CAMERA,CAMERA|none", unset="the first", empty="none")
CARRIED: Any = Suppress[Fixed[Any]]
"""Type of a field that no option sets."""

_SPECS = {
    "blocks": BLOCKS_TEXT,
    "test_cameras": CAMERAS_TEXT,
    "eliminate": _names("UNKNOWN,UNKNOWN|none", unset="as the fit", empty="none"),
    "renderers": _names("any|drgs|viewers|PRESET,PRESET"),
}
_SPELLINGS = {"renderers": "for"}  # where an option has another name than its field
# Help shows the names; a function of one's own has another.
_TYPES: dict[str, Any] = {"policy": Policy | str, "criterion": Criterion | str}
_CARRIED = ("weights", "groups")  # mappings and lists of names, which a file says better than a line


def options_of(kind: type[Record], only: Collection[str] = (), without: Collection[str] = ()) -> Any:
    """A dataclass to inherit from, with an option a field of a record and of its parts.

    Groups and their weights have no option: they are carried along, and files of --config set them.

    Args:
        kind: The record.
        only: Fields that become options; none: all but those of `without`.
        without: Fields that do not, and parts that are left out as a whole.
    """
    fields = list[tuple[str, Any, Any]]()
    _collect(kind, kind(), set(only), set(without), fields)
    return dataclasses.make_dataclass(f"{kind.__name__}Options", fields, frozen=True, kw_only=True)


def _collect(kind: type, record: Any, only: set[str], without: set[str], fields: list) -> None:
    texts = texts_of(kind)
    for name, hint in hints_of(kind).items():
        part = part_of(hint)
        if name in without:
            continue
        if part is not None:
            _collect(part, getattr(record, name) or part(), only, without, fields)
        elif not only or name in only:
            fields.append((name, *_option(kind, name, hint, getattr(record, name), texts[name])))


def _option(kind: type, name: str, hint: Any, default: Any, text: str) -> tuple[Any, Any]:
    """Type and field of an option."""
    if name in _CARRIED:
        usual = {"default_factory": dict} if isinstance(default, dict) else {"default": default}
        return CARRIED, dataclasses.field(**usual, metadata={HIDDEN: True})
    marks = (_SPECS[name],) if name in _SPECS else ()
    return Annotated[(_TYPES.get(name, hint), arg(name=_SPELLINGS.get(name), help=text), *marks)], dataclasses.field(
        default=default, metadata={OF_RECORD: kind.__name__}
    )
