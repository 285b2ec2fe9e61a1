"""What of the events of a fit its owner is told at once, in a line each; all of them are in log.jsonl."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from drgs.fitting.transients import line_of

__all__ = ["told"]


def told(events: Iterable[dict]) -> Iterator[str]:
    """The lines of a step's events."""
    for event in events:
        kind = event["event"]
        if kind == "transients" and event["found"]:
            yield line_of(event)
        elif kind == "resolution":
            yield f"photographs of {event['width']}x{event['height']}"
        elif kind == "births":
            yield (
                f"{event['photographs']} of {event['of']} photographs show what is not there at most times; "
                f"{event['found']} Gaussians are born for a time (--lives off: none)"
                if event["found"]
                else "photographs agree with the scene at their times, nothing is born for a time"
            )
