"""The `drgs` command: one level of subcommands, one line per error.

Each command's dataclass (options.py) is its option list; the work is done by `run` of the module in drgs.commands that
has the command's name, loaded only when the command runs, so that `drgs --help` imports nothing heavy. It takes the
dataclass and returns None or an exit code.

Exit codes: 0 done, 1 a wrong gradient (crossval) or a broken bound (stress), 2 bad usage or bad input (one line on
stderr), 129, 130 or 143 ended by SIGHUP, Ctrl-C or SIGTERM.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import sys
import typing
from typing import Annotated, Any, TextIO

import tyro
from tyro import MISSING
from tyro.conf import FlagCreatePairsOff, subcommand

import drgs
from drgs.cluster.options import check_options
from drgs.commands.config_file import config_fields, default_of, named_config
from drgs.commands.making_options import Capture, Demo, Mesh, Reproduce, Scene, Sfm, Teach
from drgs.commands.option_groups import Clustered
from drgs.commands.option_help import help_page
from drgs.commands.options import (
    Cite,
    Convert,
    Crossval,
    Eval,
    Fisher,
    Fit,
    Info,
    Query,
    Render,
    Report,
    Select,
    Share,
    Stress,
    Tradeoff,
    View,
)
from drgs.commands.renamed import as_written_now
from drgs.display.progress import Bar
from drgs.io import interrupts

__all__ = ["main"]


# Command -> its options. The work is done by `run` of the module of drgs.commands that has the command's name.
_OPTIONS = {
    "info": Info,
    "render": Render,
    "view": View,
    "fit": Fit,
    "eval": Eval,
    "report": Report,
    "share": Share,
    "select": Select,
    "fisher": Fisher,
    "query": Query,
    "convert": Convert,
    "mesh": Mesh,
    "crossval": Crossval,
    "tradeoff": Tradeoff,
    "stress": Stress,
    "capture": Capture,
    "sfm": Sfm,
    "teach": Teach,
    "scene": Scene,
    "reproduce": Reproduce,
    "demo": Demo,
    "cite": Cite,
}


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name, default `sys.argv[1:]`.
    Returns:
        The exit code. Bad usage and --help leave through SystemExit, as argparse does.
    """
    # Before torch starts them: OpenMP threads that spin between operations take cores from Dr.Jit's.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")  # the same of NumPy's, which else spin for 2^26 cycles
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv == ["--version"]:
        print(f"drgs {drgs.__version__}")
        return 0
    try:
        args = _parse_arguments(argv)
    except (ValueError, OSError) as error:
        _complain(argv[0], str(error))
        return 2
    from drgs.io import outputs  # not for --help

    name = next(name for name, options in _OPTIONS.items() if type(args) is options)
    logging.basicConfig(format="%(message)s", handlers=[_Stderr()])
    logging.getLogger("drgs").setLevel(logging.WARNING if args.quiet else logging.INFO)
    try:
        if not 0 <= getattr(args, "seed", 0) < 1 << 31:
            raise ValueError(f"--seed must be in [0, {(1 << 31) - 1}], got {args.seed}; choose another")
        if isinstance(args, Clustered):
            check_options(args.scheduler, args.workers)
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
    except (ValueError, NotImplementedError, OSError) as error:
        if args.debug:
            raise
        _complain(name, str(error) or type(error).__name__)
        return 2
    except (MemoryError, RuntimeError) as error:
        from drgs.guards.memory import is_out_of_memory

        if args.debug or not is_out_of_memory(error):
            raise
        told = str(error) if type(error) is MemoryError else ""  # others speak of single arrays
        _complain(name, told or "there must be more memory, none was left; free some, or ask for smaller views")
        return 2
    except KeyboardInterrupt as error:
        if args.debug:
            raise
        _complain(name, _ending(error))
        return interrupts.exit_code(error)


class _Stderr(logging.StreamHandler):
    """Writes to what sys.stderr is now: a bar that is being drawn puts itself there, and keeps below other lines."""

    @property
    def stream(self) -> TextIO:
        return sys.stderr

    @stream.setter
    def stream(self, _: TextIO) -> None:
        pass


def _parse_arguments(argv: list[str]) -> Any:
    """The dataclass of the command in argv; without one tyro lists the commands, or says what is wrong.

    Raises:
        SystemExit: After help, and on bad usage, which is told in one line.
        ValueError, OSError: If a file of --config cannot be read.
    """
    name = argv[0] if argv and argv[0] in _OPTIONS else None
    if name is None:
        commands: Any = typing.Union[  # noqa: UP007 (built at run time)
            tuple(Annotated[options, subcommand(name)] for name, options in _OPTIONS.items())
        ]
        about = "Differentiable Gaussian rendering, exact gradients, any CPU. Version: drgs --version."
        return _by_tyro(None, commands, args=argv, prog="drgs", description=about, config=(FlagCreatePairsOff,))
    options = _OPTIONS[name]
    words, notes = as_written_now(name, argv[1:])
    for note in notes:
        print(f"drgs {name}: {note}", file=sys.stderr)
    path = named_config(words) if hasattr(options, "config") else None
    default = None if path is None else default_of(options, config_fields(path, words), MISSING)
    if asked := {"-h", "--help", "--help-all"}.intersection(words):
        print(help_page(name, options, "--help-all" in asked, default), end="")
        raise SystemExit(0)
    known = {} if default is None else {"default": default}
    return _by_tyro(name, options, args=words, prog=f"drgs {name}", **known)


def _by_tyro(name: str | None, kind: Any, **how: Any) -> Any:
    """What tyro makes of words; its framed usage errors become one line."""
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(kind, **how)
    except SystemExit as end:
        if end.code:
            line = _one_line(errors.getvalue())
            _complain(name, f"{line} (see `drgs {f'{name} ' if name else ''}--help`)")
        raise


def _one_line(framed: str) -> str:
    """The message in tyro's box of box-drawing characters, with its first suggestion."""
    lines = [line.strip("╭╮╰╯│ ") for line in framed.splitlines()]
    sections: list[list[str]] = [[]]
    title = True
    for line in lines:
        if title and "─" in line:  # the box's upper edge carries only a title
            title = False
        elif set(line) == {"─"}:
            sections.append([])
        elif line and "─" not in line:
            sections[-1].append(line)
    message = " ".join(sections[0]) or "bad usage"
    message = message.split(" Got errors:")[0].rstrip(".")
    for section in sections[1:]:
        if section and section[0].startswith("Perhaps you meant"):
            message += f"; perhaps {section[1]}"
    return message


def _ending(error: KeyboardInterrupt) -> str:
    """`interrupted` or `terminated`, and what was saved."""
    word = "terminated" if isinstance(error, interrupts.Terminated) else "interrupted"
    return f"{word}: {error}" if str(error) else word


def _complain(command: str | None, message: str) -> None:
    """One line on stderr: `drgs COMMAND: message`; functions that are called as the command name it themselves."""
    where = f"drgs {command}" if command else "drgs"
    message = " ".join(message.removeprefix("drgs: ").removeprefix(f"{command}: ").split())
    print(f"{where}: {message}", file=sys.stderr)
