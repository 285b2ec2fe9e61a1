"""Imports by name: functions of `package.module:function`, and modules of a room at first access."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def modules_of(package: str) -> Callable[[str], Any]:
    """The `__getattr__` of a room whose modules are imported at first access, as `drgs.features.query`.

    Args:
        package: Full name of the room, its `__name__`.
    """

    def at_first_access(name: str) -> Any:
        if not name.startswith("_"):
            try:
                return importlib.import_module(f"{package}.{name}")
            except ModuleNotFoundError as error:
                if error.name != f"{package}.{name}":  # the module is there, and lacks something that is not installed
                    raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return at_first_access


def imported_function(option: str, text: str, or_else: str = "") -> Callable[..., Any]:
    """The function that `package.module:function` names; modules in the working directory are found, too.

    Only for what the caller of drgs typed: importing runs the module. Never for a name that a file holds.

    Args:
        option: Option that it was given with, e.g. `--policy`.
        text: The name.
        or_else: What else the option takes, for the message.
    Raises:
        ValueError: If it is no such name, importing fails, or there is no such function; one line.
    """
    module, colon, attribute = text.partition(":")
    if not (colon and module and attribute):
        own = f"; say {Path(text).stem}:FUNCTION in the folder of {Path(text).name}" if text.endswith(".py") else ""
        raise ValueError(f"{option} {text}: must be {or_else}package.module:function{own}")
    if "" not in sys.path:  # a function beside the user, also when `drgs` is an installed script
        sys.path.insert(0, "")
    try:
        code = importlib.import_module(module)
    except Exception as error:
        raise ValueError(
            f"{option} {text}: must be importable, got {type(error).__name__}: {error}; correct it, or run drgs in the "
            "folder that holds the module; its name is without .py"
        ) from error
    found = getattr(code, attribute, None)
    if not callable(found):
        functions = [value for value in vars(code).values() if inspect.isfunction(value) and value.__module__ == module]
        names = ", ".join(value.__name__ for value in functions if not value.__name__.startswith("_"))
        raise ValueError(f"{option} {text}: {module} must have a function {attribute}, has {names or 'none'}")
    return found
