"""One step of the ladder (ladder.py): how large it is, as JSON and as a row of a table."""

from __future__ import annotations

import dataclasses

import torch

from drgs.lab.ladder_pictures import State

__all__ = ["Step", "table"]


@dataclasses.dataclass(frozen=True)
class Size:
    """How large a step's gradient by one parameter is; None where the divisor is 0.

    Attributes:
        norm: |step|.
        share: <step, total> / |total|^2.
        of_total: |step| / |total|.
        of_exact: |step| / |exact|.
    """

    norm: float
    share: float | None
    of_total: float | None
    of_exact: float | None

    @classmethod
    def of(cls, step: torch.Tensor, total: torch.Tensor, exact: torch.Tensor) -> Size:
        """Measure a step beside the whole way and the exact end, three tensors of one shape."""
        step, total, exact = (x.double().reshape(-1) for x in (step, total, exact))  # norms over millions of values
        whole = float(total.norm())
        truth = float(exact.norm())
        size = float(step.norm())
        return cls(
            norm=size,
            share=float(step @ total) / whole**2 if whole > 0 else None,
            of_total=size / whole if whole > 0 else None,
            of_exact=size / truth if truth > 0 else None,
        )


@dataclasses.dataclass(frozen=True)
class Step:
    """One rung; without its first two fields, the whole way.

    Attributes:
        rung: Name of the rung.
        switched: Field of the settings -> [before, after]; None of a step outside of the ladder.
        rms: Root of the mean square of the image's change, over pixels and channels.
        max: Largest change of the image.
        norm, share, of_total, of_exact: Size of the image's change, as `Size` says it of a gradient.
        gradient: Parameter -> `Size`; empty without gradients.
    """

    rung: str | None
    switched: dict | None
    rms: float
    max: float
    norm: float
    share: float | None
    of_total: float | None
    of_exact: float | None
    gradient: dict[str, Size]

    @classmethod
    def of(cls, step: State, total: State, exact: State, rung: str | None = None, switched: dict | None = None) -> Step:
        """Measure the difference that a step makes beside that of the whole way and the way's end."""
        return cls(
            rung=rung,
            switched=switched,
            rms=float(step.image.square().mean().sqrt()),
            max=float(step.image.abs().max()),
            **vars(Size.of(step.image, total.image, exact.image)),
            gradient={n: Size.of(x, total.gradient[n], exact.gradient[n]) for n, x in step.gradient.items()},
        )

    def to_json(self) -> dict:
        """As a report holds it."""
        row = dataclasses.asdict(self)
        return {name: x for name, x in row.items() if not (x is None and name in ("rung", "switched"))}

    @classmethod
    def from_json(cls, row: dict) -> Step:
        """As a report holds it."""
        gradient = {name: Size(**size) for name, size in row["gradient"].items()}
        return cls(**{"rung": None, "switched": None, **row, "gradient": gradient})


def table(report: dict) -> str:
    """Markdown of a report: image, gradients, crops.

    A pair is `stated order / reverse`, one number where they agree; gradients show shares, in asides |step| / |exact|.
    """
    groups = report["groups"]
    lines = _both(report["image"], groups, "all pixels")
    if "crops" in report:
        windows = ", ".join(f"{w}x{h} at ({x}, {y})" for x, y, w, h in report["crops"]["windows"])
        lines += ["", *_both(report["crops"], groups, f"crops {windows}")]
    if "far" in report:
        lines += ["", *_both({"reverse": [], **report["far"]}, groups, "beyond `exact`, crops")]
    lines += ["", "| aside, all pixels | RMS | max |" + "".join(f" {name}, of exact |" for name in groups)]
    lines += ["|---" * (3 + len(groups)) + "|"]
    for row in map(Step.from_json, report["asides"]):
        cells = [_percent(row.gradient[name].of_exact) for name in groups]
        lines.append(f"| {row.rung} | {row.rms:.1e} | {row.max:.1e} |" + "".join(f" {c} |" for c in cells))
    return "\n".join(lines)


def _both(part: dict, groups: list[str], what: str) -> list[str]:
    """Rows of one ladder: RMS and share of the image, shares of the gradients, `first order / reverse`."""
    forward, reverse = ([Step.from_json(row) for row in part[order]] for order in ("forward", "reverse"))
    back = {step.rung: step for step in reverse}
    total = Step.from_json(part["total"])
    lines = [f"| rung, {what} | RMS | max | share |" + "".join(f" {name} |" for name in groups)]
    lines.append("|---" * (4 + len(groups)) + "|")
    for step in forward:
        orders = [_shares(x, groups) for x in (step, back.get(step.rung)) if x is not None]
        # A number once where both orders agree on it.
        cells = [" / ".join(dict.fromkeys(pair)) for pair in zip(*orders, strict=True)]
        lines.append(f"| {step.rung} |" + "".join(f" {c} |" for c in cells))
    cells = [f"{total.rms:.1e}", f"{total.max:.1e}", "100 %"]
    cells += [f"|total| = {_percent(total.gradient[n].of_exact)} of |exact|".replace("|", "\\|") for n in groups]
    lines.append("| total |" + "".join(f" {c} |" for c in cells))
    return lines


def _shares(step: Step, groups: list[str]) -> list[str]:
    """The cells of a row behind its name."""
    shares = (step.share, *(step.gradient[name].share for name in groups))
    return [f"{step.rms:.1e}", f"{step.max:.1e}", *map(_percent, shares)]


def _percent(x: float | None) -> str:
    """Two digits below 1 %, none above 10."""
    if x is None:
        return "-"
    # Below 5e-5 two digits of a percent round to 0, and -0.00 says nothing.
    digits = 0 if abs(x) >= 0.1 or abs(x) < 5e-5 else 1 if abs(x) >= 0.01 else 2
    x = 0.0 if abs(x) < 5e-5 else x
    return f"{100 * x:.{digits}f} %"
