"""A progress bar on a terminal, and nothing where stderr is a file or a pipe."""

from __future__ import annotations

import sys

__all__ = ["Bar"]


class Bar:
    """A bar on stderr for the length of a `with` block.

    Args:
        label: What is going on.
        total: How many steps.
        show: False for none at all.
    """

    def __init__(self, label: str, total: int, show: bool = True):
        self._label, self._total, self._bar = label, total, None
        self._show = show and sys.stderr.isatty()

    def __enter__(self) -> Bar:
        if self._show:
            from rich import progress
            from rich.console import Console

            self._bar = progress.Progress(
                progress.TextColumn("{task.description}"),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
                progress.TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self._label, total=self._total)
        return self

    def __exit__(self, *_) -> None:
        if self._bar:
            self._bar.stop()

    def advance(self) -> None:
        """One step more."""
        if self._bar:
            self._bar.advance(self._task)

    def update(self, done: int, total: int, label: str | None = None) -> None:
        """Set everything at once."""
        if self._bar:
            text = {} if label is None else {"description": label}
            self._bar.update(self._task, completed=done, total=total, **text)
