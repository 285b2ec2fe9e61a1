"""Frozen records that are nested by subject, whose fields are options of the command line.

A field is declared once, by `option`: its default, its text, its range, and how a command line spells it. From that are
read the command line and its help (`drgs.commands.command_line`), the ranges that a record checks, and, by the names
and types of the fields, configuration files and the run folder's config.json. A field that holds another record is
declared by `part`.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import sys
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

from drgs.checks.arguments import ArgumentError, check_fields, kind_of, must_be

TRANSIENT: Mapping[str, Any] = {"transient": True}
"""Metadata of a field that is computed at run time: no file holds it, and it is no option."""

_OPTION = "option"  # metadata: the `Spec` of a field
_PART = "part"  # metadata of a field that holds a record: its `_Part`
_FIRST_HEADING = "Run"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spec:
    """An option's text, range, flag and heading, beside its name, type and default.

    Attributes:
        help: What it does, in a sentence or two.
        within: Lowest and highest value, both allowed; of tuples, of each number.
        rare: Left out of `--help`; `--help-all` has it.
        heading: Heading of the help that it stands under; None: the `heading` of the class that declares it.
        flag: Its spelling on the command line where that is not the field's name: `for` is --for.
        short: A second spelling of one letter: `o` is -o.
        name: Its name among all fields of nested records, where another field has the same.
        metavar: What stands for its value in help; None: its type says it.
        shown: What help shows as its default; None: the default itself.
        positional: It has no flag: words of the command line that belong to no option are its value.
        repeat: A tuple of which every use of the flag adds an element.
        commas: A tuple that is written as one word, with commas between its elements.
        none: The word for None; with `commas`, for an empty tuple.
        file_only: No option, but a configuration file may state it.
    """

    help: str = ""
    within: tuple[float, float] | None = None
    rare: bool = False
    heading: str | None = None
    flag: str | None = None
    short: str | None = None
    name: str | None = None
    metavar: str | None = None
    shown: str | None = None
    positional: bool = False
    repeat: bool = False
    commas: bool = False
    none: str | None = None
    file_only: bool = False


class _Part(typing.NamedTuple):
    """The arguments of `part`."""

    only: frozenset[str] | None
    rare: bool


def option(default: Any = dataclasses.MISSING, help: str = "", **spec: Any) -> Any:
    """A field of a record or of a command's options: its default (left out: it is required), its text, and a `Spec`."""
    default = {"default_factory": dict} if default == {} else {"default": default}
    return dataclasses.field(**default, metadata={_OPTION: Spec(help=help, **spec)})


def part(default: Any, only: Iterable[str] | None = None, rare: bool = False) -> Any:
    """A field that holds a record.

    Args:
        default: The record, or None for one that may be missing.
        only: Names of the record's fields that are options here; None: all that it declares as such.
        rare: Whether `--help` leaves all of them out.
    """
    return dataclasses.field(default=default, metadata={_PART: _Part(None if only is None else frozenset(only), rare)})


def one_of(names: Iterable[str]) -> str:
    """What stands in help for a value that is one of these names, or `package.module:function` of one's own."""
    return "{" + ",".join(names) + "}|TEXT"


def same_option(kind: type, name: str, **changes: Any) -> Any:
    """A field like that of a record: same default, text and range, but for what is changed of its `Spec`."""
    field = next(field for field in dataclasses.fields(kind) if field.name == name)
    return dataclasses.field(
        default=field.default, metadata={_OPTION: dataclasses.replace(field.metadata[_OPTION], **changes)}
    )


@dataclasses.dataclass(frozen=True)
class Option:
    """A field of a record, or of one nested in it, that a command line or a configuration file can set.

    Attributes:
        name: Its name, unique in the whole record.
        path: Names of the fields that lead to it: ("data", "max_pixels").
        hint: Its type.
        default: Its default; `dataclasses.MISSING` where it is required.
        heading: Heading of the help that it stands under.
        spec: What the field says of itself.
    """

    name: str
    path: tuple[str, ...]
    hint: Any
    default: Any
    heading: str
    spec: Spec

    @property
    def flag(self) -> str:
        """Its spelling on the command line: --max-pixels; of a positional one, what stands for it: DATA."""
        if self.spec.positional:
            return self.spec.metavar or self.name.upper()
        return "--" + (self.spec.flag or self.name).replace("_", "-")

    @property
    def typed(self) -> str:
        """`flag`, or the short form of those that have one: -k."""
        return f"-{self.spec.short}" if self.spec.short else self.flag


@functools.cache
def options_in(kind: type) -> Mapping[str, Option]:
    """Name -> option, of a record or a command's options and all records nested in it; those that a class declares
    itself come before those that it inherits.
    """
    options: dict[str, Option] = {}
    for one in _options(kind, (), None, _Part(None, False)):
        assert one.name not in options, f"{kind.__name__}: {one.name} is the name of two options"
        options[one.name] = one
    return types.MappingProxyType(options)


def _options(kind: Any, path: tuple[str, ...], record: Any, shown: _Part) -> Iterable[Option]:
    """The options of a record whose values in `record`, where there is one, are the defaults."""
    hints = hints_of(kind)
    own = list(kind.__dict__.get("__annotations__", ()))
    place = lambda field: own.index(field.name) if field.name in own else len(own)  # noqa: E731
    for field in sorted(dataclasses.fields(kind), key=place):
        if shown.only is not None and field.name not in shown.only:
            continue
        default = _default(field) if record is None else getattr(record, field.name)
        spec = field.metadata.get(_OPTION)
        if field.name in hints and (inner := part_of(hints[field.name])) is not None:
            own_part = field.metadata.get(_PART, _Part(None, False))
            own_part = own_part._replace(rare=own_part.rare or shown.rare)
            yield from _options(inner, (*path, field.name), default, own_part)
        elif spec is not None:
            owner = next(base for base in kind.__mro__ if field.name in base.__dict__.get("__annotations__", {}))
            heading = spec.heading or owner.__dict__.get("heading", _FIRST_HEADING)
            name = spec.name or field.name
            spec = dataclasses.replace(spec, rare=spec.rare or shown.rare)
            yield Option(name, (*path, field.name), hints[field.name], default, heading, spec)


def _default(field: dataclasses.Field) -> Any:
    """The default of a field; `dataclasses.MISSING` where it has none."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def check_ranges(record: Any) -> None:
    """Raise ValueError unless the numbers of a command's options are in the ranges that their fields declare."""
    kind: Any = type(record)
    for field in dataclasses.fields(record):
        spec = field.metadata.get(_OPTION)
        if spec is None or spec.within is None:
            continue
        value = getattr(record, field.name)
        low, high = spec.within
        if value is not None and not low <= value <= high:
            flag = options_in(kind)[field.name].typed
            raise ValueError(f"{flag} must be in [{low:.15g}, {high:.15g}], got {value:.15g}; correct it")


class Record:
    """Base of frozen dataclasses whose fields may be records again.

    Names of fields are unique in all of them, so that `max_gaussians` says enough: `replace` takes any.

    Attributes:
        where: How messages call it. A message about a nested record names the one that holds it.
        heading: Heading of the help that its options stand under.
    """

    where: ClassVar[str] = ""
    heading: ClassVar[str] = _FIRST_HEADING

    def __post_init__(self) -> None:
        """Raise ValueError unless every field has its type and is in the range that it declares."""
        kind: Any = type(self)
        check_fields(self.where, self, _ranges_of(kind), _words_of(kind))

    def replace(self, **fields: Any) -> Self:
        """A copy with these fields, each of this record or of one nested in it.

        Raises:
            ArgumentError: If there is no field of a name.
            ValueError: As the records say.
        """
        kind: Any = type(self)
        ways = ways_of(kind)
        for name in fields:
            if name not in ways:
                raise ArgumentError(
                    f"{kind.__name__}: there must be a field of the name, got {name!r}; {nearest(name, ways)}"
                )
        return nested(kind, self, {ways[name]: value for name, value in fields.items()})

    def to_json(self) -> dict:
        """The nested object of a file: `from_json` reads it."""
        kind: Any = type(self)
        return {name: _plain(getattr(self, name)) for name in hints_of(kind)}

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """The inverse of `to_json`. A field of a nested record may also stand beside it.

        Raises:
            ValueError: If a field is unknown or has another type, and as the records say.
        """
        return nested(cls, None, stated(cls, value))


@functools.cache
def _ranges_of(kind: type) -> Mapping[str, tuple[float, float]]:
    return {name: spec.within for name, spec in _specs_of(kind).items() if spec.within is not None}


@functools.cache
def _words_of(kind: type) -> Mapping[str, str]:
    return {name: spec.none for name, spec in _specs_of(kind).items() if spec.none is not None and not spec.commas}


def _specs_of(kind: Any) -> dict[str, Spec]:
    """Field -> what it says of itself, of those that are options."""
    return {field.name: field.metadata[_OPTION] for field in dataclasses.fields(kind) if _OPTION in field.metadata}


def nested(kind: Any, base: Any, values: Mapping[tuple[str, ...], Any]) -> Any:
    """A record like `base` (None: with its defaults) with these values in it and in the records nested in it.

    Args:
        kind: Its class.
        base: A record of the class, or None.
        values: Path of a field -> its value. A nested record that is None is there with its defaults where a field of
            it has a value.
    """
    own: dict[str, Any] = {}
    inner: dict[str, dict[tuple[str, ...], Any]] = {}
    for (name, *rest), value in values.items():
        if rest:
            inner.setdefault(name, {})[tuple(rest)] = value
        else:
            own[name] = value
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name, changed in inner.items():
        part = part_of(hints_of(kind)[name])
        before = own[name] if name in own else _default(fields[name]) if base is None else getattr(base, name)
        try:
            own[name] = nested(part, before, changed)
        except ArgumentError:
            raise
        except ValueError as error:
            raise type(error)(_renamed(str(error), part, kind)) from None
    kept = {} if base is None else {name: getattr(base, name) for name in fields}
    return kind(**{**kept, **own})


def _renamed(message: str, inner: Any, kind: Any) -> str:
    """A message of a nested record as the record that holds it says it."""
    was, now = (getattr(each, "where", "") for each in (inner, kind))
    return f"{now}: {message.removeprefix(f'{was}: ')}" if was and now and message.startswith(f"{was}: ") else message


def nearest(name: str, known: Iterable[str]) -> str:
    """Advice for an unknown name: `did you mean max_gaussians?`."""
    near = difflib.get_close_matches(name, list(known), 1, 0.6)
    return f"did you mean {near[0]}?" if near else "none has a name like it"


@functools.cache
def hints_of(kind: type) -> Mapping[str, Any]:
    """Field -> its type, in their order; of records without those that are `TRANSIENT`."""
    space = vars(sys.modules[kind.__module__])
    hints: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if not field.metadata.get("transient"):
            alone = types.SimpleNamespace(__annotations__={field.name: field.type})
            hints |= typing.get_type_hints(alone, space)
    return types.MappingProxyType(hints)


@functools.cache
def ways_of(kind: type) -> Mapping[str, tuple[str, ...]]:
    """Field, of the record and of those nested in it -> the names that lead to it: max_pixels -> (data, max_pixels)."""
    hints = hints_of(kind)
    specs = {field.name: field.metadata.get(_OPTION) for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    ways: dict[str, tuple[str, ...]] = {
        (spec and spec.name) or name: (name,) for name, spec in specs.items() if name in hints
    }
    for name, hint in hints.items():
        if part := part_of(hint):
            for inner, way in ways_of(part).items():
                assert inner not in ways, f"{kind.__name__}: {inner} is the name of two fields"
                ways[inner] = (name, *way)
    return types.MappingProxyType(ways)


@functools.cache
def part_of(hint: Any) -> Any:
    """The record that a field of a type holds, be it optional; None of other types. A record is a dataclass with
    options, or with nested records that have some.
    """
    for kind in typing.get_args(hint) or (hint,):
        fields = dataclasses.fields(kind) if isinstance(kind, type) and dataclasses.is_dataclass(kind) else ()
        if any({_OPTION, _PART} & field.metadata.keys() for field in fields):
            return kind
    return None


def stated(kind: Any, value: Any, where: str | None = None) -> dict[tuple[str, ...], Any]:
    """What the nested object of a file states: path of a field -> its value, as `nested` takes them.

    A nested record that may be None and is stated has itself an entry, with its defaults.

    Args:
        kind: The record.
        value: The object.
        where: What messages begin with; None: as the record says.
    Raises:
        ValueError: If a field is unknown, or one that is a record is none.
    """
    where = kind.where if where is None else where
    must_be(where, "config", value, dict, f"as {kind.__name__}.to_json() makes it")
    hints, ways = hints_of(kind), ways_of(kind)
    values: dict[tuple[str, ...], Any] = {}
    for name, x in value.items():
        if name not in hints and name not in ways:
            raise ValueError(
                f"{where}: config must hold known fields, got {name!r}; {nearest(str(name), ways)} "
                "(or was it written by a newer drgs?)"
            )
        way = (name,) if name in hints else ways[name]
        hint = _hint(kind, way)
        inner = part_of(hint)
        may_be_none = type(None) in typing.get_args(hint)
        if inner is None:
            values[way] = _converted(where, name, x, hint)
        elif x is None and may_be_none:
            values[way] = None
        elif isinstance(x, dict):
            if may_be_none:
                values[way] = inner()
            values |= {(*way, *rest): y for rest, y in stated(inner, x, where).items()}
        else:
            raise ValueError(f"{where}: {name} must be an object with fields of {inner.__name__}, got {kind_of(x)}")
    return values


def _hint(kind: Any, way: tuple[str, ...]) -> Any:
    """The type of the field at the end of a way."""
    for name in way[:-1]:
        kind = part_of(hints_of(kind)[name])
    return hints_of(kind)[way[-1]]


def _converted(where: str, name: str, value: Any, hint: Any) -> Any:
    """A value of a file as its field holds it: an object becomes the dataclass that is meant, a list a tuple."""
    kinds = typing.get_args(hint) or (hint,)
    whole: Any = next((kind for kind in kinds if dataclasses.is_dataclass(kind)), None)
    if whole is None:
        return tuple(value) if isinstance(value, list) else value
    if not isinstance(value, dict):
        if value is None and type(None) in kinds:
            return None
        must_be(where, name, value, dict, f"the fields of a {whole.__name__}")
    known = hints_of(whole)
    if unknown := [key for key in value if key not in known]:
        raise ValueError(f"{where}: {name} must hold known fields, got {unknown[0]!r}; {nearest(unknown[0], known)}")
    return whole(**{key: tuple(x) if isinstance(x, list) else x for key, x in value.items()})


def _plain(value: Any) -> Any:
    """A value as JSON holds it."""
    if isinstance(value, Record):
        return value.to_json()
    if dataclasses.is_dataclass(value):
        kind: Any = type(value)
        return {name: _plain(getattr(value, name)) for name in hints_of(kind)}
    if isinstance(value, Mapping):
        return {key: _plain(x) for key, x in value.items()}
    return [_plain(x) for x in value] if isinstance(value, list | tuple) else value


def first_difference(mine: dict, theirs: dict) -> tuple[str, Any, Any] | None:
    """The first key, in the innermost of two JSON objects of the same keys, with other values, and both values."""
    for name, x in mine.items():
        y = theirs[name]
        if isinstance(x, dict) and isinstance(y, dict):
            if inner := first_difference(x, y):
                return inner
        elif x != y:
            return name, x, y
    return None
