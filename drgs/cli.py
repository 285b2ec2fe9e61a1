"""The `drgs` command: one level of subcommands, one line per error.

What each command can be asked for stands in `commands/options.py`; the work is done by `run` of the module in
drgs.commands that has the command's name, loaded only when the command runs, so that `drgs --help` imports nothing
heavy. It takes the options and returns None or an exit code.

Exit codes: 0 done, 1 a wrong gradient (crossval) or a broken bound (stress), 2 bad usage or bad input (one line on
stderr), 129, 130 or 143 ended by SIGHUP, Ctrl-C or SIGTERM.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
from typing import Any, TextIO

import drgs
from drgs.checks.records import nearest, options_in
from drgs.commands.command_line import command_list, help_page, parsed_options
from drgs.commands.options import COMMANDS, Common
from drgs.display.progress import Bar
from drgs.io import interrupts

__all__ = ["main"]

_HELP = {"-h", "--help", "--help-all"}


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name, default `sys.argv[1:]`.
    Returns:
        The exit code. Help leaves through SystemExit, as argparse does.
    """
    # Before torch starts them: OpenMP threads that spin between operations take cores from Dr.Jit's.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")  # the same of NumPy's, which else spin for 2^26 cycles
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv == ["--version"]:
        print(f"drgs {drgs.__version__}")
        return 0
    if not argv:
        print(command_list(COMMANDS), end="", file=sys.stderr)
        return 2
    name = argv[0] if argv[0] in COMMANDS else None
    try:
        args = _parse_arguments(argv)
    except (ValueError, NotImplementedError, OSError) as error:
        _complain(name, str(error))
        return 2
    logging.basicConfig(format="%(message)s", handlers=[_Stderr()])
    logging.getLogger("drgs").setLevel(logging.WARNING if args.quiet else logging.INFO)
    try:
        return _run(argv[0], args)
    except (ValueError, NotImplementedError, OSError) as error:
        if args.debug:
            raise
        _complain(name, str(error) or type(error).__name__)
        return 2
    except (MemoryError, RuntimeError) as error:
        from drgs.runtime.memory import is_out_of_memory

        if args.debug or not is_out_of_memory(error):
            raise
        said = str(error) if type(error) is MemoryError else ""  # others speak of single arrays
        _complain(name, said or "there must be more memory, none was left; free some, or ask for smaller views")
        return 2
    except KeyboardInterrupt as error:
        if args.debug:
            raise
        _complain(name, _ending(error))
        return interrupts.exit_code(error)


def _run(name: str, args: Common) -> int:
    """Run a command with its options, under a progress bar, and clean up what it was writing where it is ended."""
    from drgs.io import outputs  # not for --help

    with interrupts.handled(outputs.clean, lambda error: f"drgs {name}: {_ending(error)}\n"):
        try:
            # Whatever a command does without a bar of its own is not silent either.
            with Bar(f"drgs {name}", show=not args.quiet, lines_only=True):
                with Bar("loading libraries"):
                    if args.variant != "auto" or args.threads is not None:
                        # Only when asked for: a command that needs no backend shall not load one.
                        from drgs import runtime

                        runtime.setup(args.variant, args.threads)
                    command = importlib.import_module(f"drgs.commands.{name}")
                return command.run(args) or 0
        finally:
            outputs.release_all()


def _parse_arguments(argv: list[str]) -> Any:
    """The options of the command that argv names first.

    Raises:
        SystemExit: After help.
        ValueError, OSError: On bad usage, and if a file of --config cannot be read.
    """
    if argv[0] not in COMMANDS and argv[0] not in _HELP:
        known = ", ".join(COMMANDS)
        raise ValueError(f"the command must be one of {known}, got {argv[0]!r}; {nearest(argv[0], COMMANDS)}")
    name, *words = argv
    if _HELP.intersection(argv):
        print(help_page(name, COMMANDS[name], words) if name in COMMANDS else command_list(COMMANDS), end="")
        raise SystemExit(0)
    return parsed_options(COMMANDS[name], words, COMMANDS)


class _Stderr(logging.StreamHandler):
    """Writes to what sys.stderr is now: a bar that is being drawn puts itself there, and keeps below other lines."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, _: TextIO) -> None:
        pass


def _ending(error: KeyboardInterrupt) -> str:
    """`interrupted` or `terminated`, and what was saved."""
    word = "terminated" if isinstance(error, interrupts.Terminated) else "interrupted"
    return f"{word}: {error}" if str(error) else word


def _complain(command: str | None, message: str) -> None:
    """One line on stderr: `drgs COMMAND: message`; functions that are called as the command name it themselves."""
    where = f"drgs {command}" if command else "drgs"
    message = " ".join(message.removeprefix("drgs: ").removeprefix(f"{command}: ").split())
    kind: Any = COMMANDS.get(command or "")
    options = options_in(kind) if kind else {}
    typed = {name: option.typed for name, option in options.items() if not option.spec.positional}
    subject, must, rest = message.partition(" must ")
    if must and {*typed, "either", "or"}.issuperset(subject.split()):  # what a function calls by its arguments' names
        message = " ".join(typed.get(word, word) for word in subject.split()) + must + rest
    print(f"{where}: {message}", file=sys.stderr)
