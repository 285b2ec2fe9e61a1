"""Tables on stdout that are whole at 80 columns and in a file: text is wrapped, numbers stay in one piece."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence

_GAP = "  "
_MIN_TEXT_WIDTH = 10  # columns of text, however many numbers there are


def show(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], texts: Sequence[str] = ()) -> None:
    """Print a table as wide as the terminal at most; 80 columns where there is none."""
    print("\n".join(lines(title, columns, rows, texts, shutil.get_terminal_size((80, 24)).columns)), flush=True)


def lines(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], texts: Sequence[str] = (), width: int = 80
) -> list[str]:
    """The lines of a table.

    Args:
        title: Text above the table; may be empty.
        columns: Headings of the columns; one may have several lines.
        rows: Cells of each row, as many as there are columns. A first cell that is too long has a line of its own.
        texts: Headings of the columns that hold text, besides the first; the others hold numbers.
        width: Largest number of characters a line.
    """
    heads = [name.split("\n") for name in columns]
    tall = max(map(len, heads))
    heads = [[""] * (tall - len(head)) + head for head in heads]
    is_text = [k == 0 or name in texts for k, name in enumerate(columns)]
    widths = [max(map(len, (*head, *(row[k] for row in rows)))) for k, head in enumerate(heads)]
    spare = width - len(_GAP) * (len(columns) - 1) - sum(w for w, text in zip(widths, is_text, strict=True) if not text)
    while sum(w for w, text in zip(widths, is_text, strict=True) if text) > spare:
        widest = max((k for k in range(len(columns)) if is_text[k]), key=lambda k: widths[k])
        if widths[widest] <= _MIN_TEXT_WIDTH:
            break
        widths[widest] -= 1

    def line(cells: Sequence[str]) -> str:
        placed = zip(cells, widths, is_text, strict=True)
        return _GAP.join(cell.ljust(w) if text else cell.rjust(w) for cell, w, text in placed).rstrip()

    found = textwrap.wrap(title, width)
    found += [line(cells) for cells in zip(*heads, strict=True)]
    found.append("-" * min(width, sum(widths) + len(_GAP) * (len(widths) - 1)))
    for first, *rest in rows:
        if len(first) > widths[0]:
            found += textwrap.wrap(first, width)
            first = ""
        cells = [
            textwrap.wrap(x, w) or [""] if text else [x]
            for x, w, text in zip(rest, widths[1:], is_text[1:], strict=True)
        ]
        for k in range(max(map(len, cells), default=1)):
            found.append(line([first if k == 0 else "", *(x[k] if k < len(x) else "" for x in cells)]))
    return found
