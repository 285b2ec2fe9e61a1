"""Contents of a run folder for its report, checked: log, metrics, selection and environment."""

from __future__ import annotations

import dataclasses
import datetime
from pathlib import Path
from typing import Any

from drgs.fitting.records import FitRecord, fit_record
from drgs.io.json_files import check_json, parse_json, read_json
from drgs.io.run import Run

_ADVICE = "restore the file, or leave it out"
_NUMBER = (None, float)
_EVENTS: dict[str, dict] = {
    "train": {"loss": _NUMBER, "psnr": _NUMBER, "gaussians": int, "seconds": float},
    "preview": {"test_psnr": _NUMBER},
    "done": {"seconds": float},
}
_SHOWN = {"name": str, "psnr": float}  # of a renderer in a view
_RENDERER = {"name": str, "mean": {"psnr": float}, "worst": _SHOWN, "views": [_SHOWN]}
_RENDERERS = {"split": str, "width": int, "height": int, "rows": [_RENDERER]}
_VIEWERS = {"split": str, "width": int, "height": int, "preset": str, "psnr": float, "own_psnr": float, "views": [str]}
_METRICS = {"split": str, "count": int, "gaussians": int, "mean": dict, "views": [{"name": str}], "reasons": dict}
_PICK = {"number": int, "step": int, "index": int, "name": str, "score": _NUMBER, "margin": _NUMBER, "seconds": float}
_PICK |= {"policy": str, "parts": dict, "candidates": [{"index": int, "name": str, "score": _NUMBER}]}
_PLACE = {"rank": int, "text": str, "origin": [float], "camera": dict}
_CAPTURE = {"batches": [{"findings": [{"text": str, "advice": str}]}]}
_SELECTION = {"start": [{"index": int, "name": str}], "picks": [_PICK], "pool": [str], "pool_leak": bool}


@dataclasses.dataclass(frozen=True)
class Account:
    """How a fit went.

    Attributes:
        run: Folder of the run.
        record: What config.json says.
        config: Content of config.json as it is.
        env: Content of env.json, which says what the fit ran on; empty without.
        events: Lines of log.jsonl, without the steps that a resumed fit did again.
        metrics: Content of metrics.json; None before there is one.
        selection: Content of selection.json of an active fit, else None.
        places: Picks of next.json, places for the next photographs; empty without.
        findings: Those of the last batch of capture/capture.json, what to do at the next shoot; empty without.
        wall: Seconds from each start of the fit to the last thing that it logged, pauses left out.
    """

    run: Run
    record: FitRecord
    config: dict[str, Any]
    env: dict[str, Any]
    events: list[dict[str, Any]]
    metrics: dict[str, Any] | None
    selection: dict[str, Any] | None
    wall: float
    places: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    findings: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def of(self, event: str) -> list[dict[str, Any]]:
        """The events of a name."""
        return [row for row in self.events if row["event"] == event]

    @property
    def step(self) -> int:
        """Steps done, by the log."""
        return max((row["step"] for row in self.events), default=0)

    @property
    def state(self) -> str:
        """Whether the fit is done, in words."""
        last = self.events[-1]["event"] if self.events else ""
        steps = f"{self.step:,} of {self.record.config.max_steps:,} steps"
        if last == "done":
            return f"finished, {steps}"
        return f"stopped at {steps}, --resume continues" if last == "interrupted" else f"at {steps}"


def account_of(run: Run) -> Account:
    """Read a run folder.

    Raises:
        FileNotFoundError: If it is no run folder.
        ValueError: If a file is damaged, or says something that no fit has written.
    """
    record = fit_record(run)
    metrics = _optional(run.path / "metrics.json", _METRICS)
    for row in [] if metrics is None else [metrics["mean"], *metrics["views"]]:
        _check_numbers(run.path / "metrics.json", {name: x for name, x in row.items() if name != "name"})
    for name, kind in {"renderers": _RENDERERS, "viewers": _VIEWERS}.items():
        if metrics is not None and metrics.get(name) is not None:
            check_json(str(run.path / "metrics.json"), metrics[name], kind, _ADVICE)
    selection = _optional(run.path / "selection.json", _SELECTION) if record.is_active else None
    for pick in [] if selection is None else selection["picks"]:
        _check_numbers(run.path / "selection.json", pick["parts"])
    env = _optional(run.path / "env.json", {}) or {}
    events, wall = _events(run)
    places = _optional(run.path / "next.json", {"picks": [_PLACE]}) or {"picks": []}
    batches = (_optional(run.path / "capture" / "capture.json", _CAPTURE) or {"batches": []})["batches"]
    findings = batches[-1]["findings"] if batches else []
    return Account(run, record, run.config(), env, events, metrics, selection, wall, places["picks"], findings)


def _optional(path: Path, kind: dict) -> dict[str, Any] | None:
    """A JSON object of at least these keys; None where there is no file."""
    if not path.is_file():
        return None
    value = read_json(path, "a file of a run", _ADVICE)
    check_json(str(path), value, kind, _ADVICE)
    return value


def _check_numbers(path: Path, values: dict) -> None:
    check_json(str(path), values, dict.fromkeys(values, _NUMBER), _ADVICE)


def _events(run: Run) -> tuple[list[dict[str, Any]], float]:
    """Events of the log without repeated steps of resumed fits and half-written lines; and the fit's seconds."""
    path = run.path / "log.jsonl"
    kept: list[dict[str, Any]] = []
    began = last = None
    wall = 0.0
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        event = parse_json(line, where, _ADVICE)
        check_json(where, event, {"event": str, "step": int, "time": str}, _ADVICE)
        check_json(where, event, _EVENTS.get(event["event"], {}), _ADVICE)
        try:
            now = datetime.datetime.fromisoformat(event["time"]).timestamp()
        except (ValueError, OverflowError, OSError):
            raise ValueError(f"{where}: time must be ISO 8601, got {event['time'][:40]!r}; {_ADVICE}") from None
        if event["event"] in ("resume", "start") or began is None or last is None:
            wall += 0.0 if began is None or last is None else last - began
            kept = [row for row in kept if row["step"] <= event["step"]]
            began = now
        kept.append(event)
        last = now
    return kept, wall if began is None or last is None else wall + last - began
