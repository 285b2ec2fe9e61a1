"""Findings about how a capture was taken, with advice for the next shoot."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something that is wrong with photographs or a video.

    Attributes:
        kind: Name of what it is: `turn`, `still`, `fast`, `blur`, `blank`, `overlap`, `poses`, `exposure`, `view`, or
            a part of the expected error.
        text: A sentence without a full stop that says where it is and what it is.
        advice: What to do about it, in the imperative.
    """

    kind: str
    text: str
    advice: str

    def line(self) -> str:
        """Both in one line."""
        return f"{self.text}; {self.advice}"
