"""How much of a rasterizer's difference to exact ray tracing each of its approximations explains.

From a rasterizer's settings to preset `exact` one thing is switched at a time, in a stated order and in its reverse,
and each step's image and gradient are kept. With the step `s_k = y_k - y_{k-1}` and `total = y_end - y_start` a
rung's share is `<s_k, total> / |total|^2`: shares sum to 1, one above 1 or below 0 says that steps cancel, and the
two orders agree where steps do not interact. Gradients are `J^T u` of one fixed Rademacher cotangent u, group by
group in raw parameters.

The order is that of `RUNGS`. Its reverse is not always legal: dilation, culling and the field-of-view clamp exist
only in `ewa`, exact order along rays only outside of it (`drgs.settings.why_illegal`). A rung that needs others takes
them with it: reversed, culling and dilation still come just before the EWA linearization, and that before the order.
`float32` is measured against the float64 oracle, on crops; `response` (peak to integral) and `volume` (sorted
compositing to the integral over summed densities) lie beyond `exact` and stay last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from drgs import reference
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab.accuracy import gradient_by
from drgs.lab.parameters import PARAMETERS
from drgs.oracle import sh_colors
from drgs.settings import RenderSettings

__all__ = ["RUNGS", "Pictures", "State", "Step", "constant_colors", "ladder", "sequences", "table"]

RUNGS = {
    "float32": (),
    "alpha cut-offs": ("alpha_min", "alpha_max", "alpha_max_gradient"),
    "early stop": ("transmittance_min", "stop", "max_hits"),
    "near plane": ("near",),
    "culling": ("culling", "extent"),
    "dilation": ("dilation",),
    "EWA": ("response", "fov_clamp"),
    "depth key": ("depth_key",),
    "order": ("order", "traversal"),
    "SH direction": ("sh_direction",),
    "response": ("response",),
    "volume": (),
}
"""Name of a rung -> the settings that it switches, in the order that they are switched in."""

_NEEDS = {"EWA": ("dilation", "culling"), "order": ("EWA",)}
_BEYOND = ("response", "volume")


def ladder(
    g: Gaussians,
    cameras: list[Camera],
    start: RenderSettings,
    *,
    crop: int = 24,
    seed: int = 0,
    volume: bool = True,
    gradients: bool = True,
    advance: Callable[[], None] | None = None,
    pictures: Pictures | None = None,
) -> dict:
    """Attribute the difference between a rasterizer's settings and `exact` to single approximations.

    Args:
        g: N Gaussians.
        cameras: Pinhole cameras; the images of all are one vector. Crops are of the first.
        start: Settings of the rasterizer, for example `RenderSettings.preset("gsplat")`; its background stays.
        crop: Width and height in pixels of the crops, in the middle and in a corner; 0 leaves crops, and with them
            float32 and the far end, out.
        seed: Seed of the cotangent.
        volume: Whether the far end is measured, too, on the crops: response peak to integral, and sorting to the true
            volume.
        gradients: Whether gradients are measured, too, by group.
        advance: Called after each image that is computed.
        pictures: Images of an earlier call with the same scene, cameras, crop and seed, which are not computed again.
    Returns:
        A JSON-serializable dict. `image`: the ladder over all pixels in float32, with lists `forward` and `reverse` of
        rungs, and `total`, each as `ladder_table.Step` says.
        `crops`: `windows` and the same with `float32`, and under `far` the two rungs beyond `exact`. A row `rest` of
        the crops' forward order holds the rounding that float32 does at `exact` but not at the start: only both ends
        are in float64. `asides`: steps that belong to no ladder (see there).
    Raises:
        ValueError: If there is no camera or Gaussian, or a rung cannot be reached.
    """
    images = pictures or Pictures(g, cameras, crop, seed, gradients, advance)
    end = RenderSettings.preset("exact", background=start.background)
    if images.crop and not images.windows:
        images.place_crops(start)
    orders = sequences(start, end)
    report: dict[str, Any] = {
        "start": dataclasses.asdict(start),
        "end": dataclasses.asdict(end),
        "gaussians": len(g),
        "views": len(cameras),
        "pixels": sum(c.width * c.height for c in cameras),
        "seed": seed,
        "groups": list(PARAMETERS) if gradients else [],
        "image": {"total": None},
        "crops": {"windows": [list(w) for w in images.windows], "total": None},
    }
    for name, steps in zip(("forward", "reverse"), orders, strict=True):
        names = [rung for rung, _ in steps]
        switched = [_switched(a, b) for a, b in pairwise([start, *(s for _, s in steps)])]
        states = [images.full(start), *(images.full(s) for _, s in steps)]
        report["image"][name], report["image"]["total"] = _rungs(names, switched, states)
        if not images.windows:
            continue
        states = [images.part(start, "float32"), *(images.part(s, "float32") for _, s in steps)]
        if name == "forward":
            rounding = images.part(start, "float64") - states[0]
            states = [states[0], *(state + rounding for state in states), images.part(end, "float64")]
            names = ["float32", *names, "rest"]
            switched = [{}, *switched, {}]
        else:
            states = [*states, images.part(end, "float64")]
            names = [*names, "float32"]
            switched = [*switched, {}]
        report["crops"][name], report["crops"]["total"] = _rungs(names, switched, states)
    if not images.windows:
        del report["crops"]
    elif volume:
        integral = end.replace(response="integral")
        states = [images.part(end, "float64"), images.part(integral, "float64"), images.part(integral, "volume")]
        rungs, total = _rungs(list(_BEYOND), [_switched(end, integral), {}], states, states[0])
        report["far"] = {"forward": rungs, "total": total}
    report["asides"] = _asides(images, start, end)
    return report


def sequences(start: RenderSettings, end: RenderSettings) -> tuple[list, list]:
    """Both orders from `start` to `end` as lists of (rung, settings after it); rungs that change nothing are left out.

    Raises:
        ValueError: If a field differs that no rung switches.
    """
    changes = {
        rung: {name: getattr(end, name) for name in fields if getattr(end, name) != getattr(start, name)}
        for rung, fields in RUNGS.items()
        if rung not in _BEYOND
    }
    known = {name for fields in changes.values() for name in fields}
    missed = [name for name in _switched(start, end) if name not in known]
    if missed:
        raise ValueError(f"ladder: both ends must share {missed[0]}, no rung switches it; set it in both")
    names = [rung for rung, fields in changes.items() if fields]
    both = []
    for order in (names, names[::-1]):
        now = start
        steps = []
        done = set()
        for rung in _with_needs(order):
            if rung not in done and rung in names:
                now = now.replace(**changes[rung])
                steps.append((rung, now))
                done.add(rung)
        both.append(steps)
    return both[0], both[1]


def _with_needs(order: list[str]) -> list[str]:
    """Each rung behind those that it needs; repeated where a later one needs it too."""

    def whole(rung: str) -> list[str]:
        needed = [n for n in order if n in _NEEDS.get(rung, ())]
        return [*(x for n in needed for x in whole(n)), rung]

    return [x for rung in order for x in whole(rung)]


def _switched(a: RenderSettings, b: RenderSettings) -> dict:
    """Field -> [before, after] where two settings differ."""
    pairs = {f.name: (getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)}
    return {name: list(pair) for name, pair in pairs.items() if pair[0] != pair[1]}


def _rungs(
    names: list[str], switched: list[dict], states: list[State], exact: State | None = None
) -> tuple[list[dict], dict]:
    """One row a step, and one of the whole way, as JSON."""
    exact = exact or states[-1]
    total = states[-1] - states[0]
    ways = zip(names, switched, states[:-1], states[1:], strict=True)
    rows = [Step.of(b - a, total, exact, name, change).to_json() for name, change, a, b in ways]
    return rows, Step.of(total, total, exact).to_json()


def _asides(images: Pictures, start: RenderSettings, end: RenderSettings) -> list[dict]:
    """Steps outside of the ladder, over all pixels, relative to `exact` and to the ladder's total.

    The gradient of the start without the direction's path (training code often detaches the direction that SH are
    evaluated in: the image stays), SH along rays instead of towards means, and the response, both from `exact`. From a
    projected start also the step to preset `3dgut`, which evaluates the same Gaussians along rays and in the order of
    their centers: how far on the way that is.
    """
    first, exact = images.full(start), images.full(end)
    total = exact - first
    steps = {}
    if images.gradients and start.sh_direction == "gaussian" and images.g.sh.shape[1] > 1:
        steps["view direction detached"] = images.full(start, True) - first
    if start.planar:
        steps["3dgut"] = images.full(RenderSettings.preset("3dgut", background=start.background)) - first
    if images.g.sh.shape[1] > 1:
        steps["SH along rays"] = images.full(end.replace(sh_direction="ray")) - exact
    steps["response"] = images.full(end.replace(response="integral")) - exact
    return [Step.of(step, total, exact, name).to_json() for name, step in steps.items()]


# ------------------------------------------------------------------------------------------------- images and gradients


@dataclasses.dataclass
class State:
    """The image and gradients of one rasterizer, and differences of such.

    Attributes:
        image: (P, 3) float64, the pixels of all views.
        gradient: Parameter -> J^T u; empty without gradients.
    """

    image: torch.Tensor
    gradient: dict[str, torch.Tensor]

    def __add__(self, other: State) -> State:
        gradient = {name: x.double() + other.gradient[name].double() for name, x in self.gradient.items()}
        return State(self.image + other.image, gradient)

    def __sub__(self, other: State) -> State:
        gradient = {name: x.double() - other.gradient[name].double() for name, x in self.gradient.items()}
        return State(self.image - other.image, gradient)


class Pictures:
    """Images and gradients of one scene and its cameras, each computed once.

    Give the same one to several calls of `ladder` (other starts) to share what they have in common.

    Args:
        g: N Gaussians.
        cameras: Pinhole cameras, at least one.
        crop: Width and height in pixels of the crops of the first camera; 0 for none.
        seed: Seed of the cotangent.
        gradients: Whether J^T u is wanted.
        advance: Called after each image.
    """

    def __init__(
        self,
        g: Gaussians,
        cameras: Sequence[Camera],
        crop: int = 24,
        seed: int = 0,
        gradients: bool = True,
        advance: Callable[[], None] | None = None,
    ):
        if not len(cameras) or not len(g):
            raise ValueError(
                f"ladder: there must be a camera and a Gaussian, got {len(cameras)} and {len(g)}; give both"
            )
        if crop < 0:
            raise ValueError(f"ladder: crop must be >= 0 pixels, got {crop}; correct it")
        # Each picture makes leaves of its own; a graph behind these would be walked by each of them.
        self.g = g.detach()
        self.cameras = list(cameras)
        self.crop = crop
        self.gradients = gradients
        self.advance = advance or (lambda: None)
        rng = np.random.default_rng(seed)
        self.u = [torch.from_numpy(rng.choice([-1.0, 1.0], (c.height, c.width, 3))) for c in self.cameras]
        self.windows: list[tuple[int, int, int, int]] = []
        self._made: dict[tuple, State] = {}

    def full(self, s: RenderSettings, detached: bool = False) -> State:
        """All pixels of all cameras, by `drgs.render`; `detached`: colors ignore how the direction follows a mean."""
        return self._once(("full", s, detached), lambda: self._full(s, detached))

    def part(self, s: RenderSettings, kind: str) -> State:
        """The crops: kind `float32` (`drgs.render`), `float64` (`reference.render`) or `volume`."""
        return self._once((kind, s), lambda: self._part(s, kind))

    def place_crops(self, s: RenderSettings) -> None:
        """The middle of the first camera's image and, if it does not overlap, the corner with the most opacity."""
        camera = self.cameras[0]
        width, height = min(self.crop, camera.width), min(self.crop, camera.height)
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        self.windows = [(x, y, width, height)]
        if x < width and y < height:
            return
        with torch.no_grad():  # where a crop lies has no derivative
            alpha = render(self.g, camera, s, outputs=()).alpha
        corners = [(x, y) for y in (0, camera.height - height) for x in (0, camera.width - width)]
        x, y = max(corners, key=lambda at: float(alpha[at[1] : at[1] + height, at[0] : at[0] + width].sum()))
        self.windows.append((x, y, width, height))

    def _once(self, key: tuple, make: Callable[[], State]) -> State:
        if key not in self._made:
            self._made[key] = make()
            self.advance()
        return self._made[key]

    def _leaves(self) -> Gaussians:
        moving = {name: self.g.parameters()[name].clone().requires_grad_(self.gradients) for name in PARAMETERS}
        return self.g.replace(features=None, **moving)

    def _state(self, g: Gaussians, images: list[torch.Tensor], cotangents: list[torch.Tensor]) -> State:
        """Images as rows of pixels, and J^T u by backward mode where gradients are wanted."""
        gradient = {}
        if self.gradients:
            # In float64, so that rounding of the sum is no rung of the ladder.
            loss: Any = sum((image.double() * u).sum() for image, u in zip(images, cotangents, strict=True))
            slopes = gradient_by(loss, {name: g.parameters()[name] for name in PARAMETERS})
            gradient = {name: x.detach().cpu() for name, x in slopes.items()}
        # What is kept are numbers: a graph would hold every picture's intermediates.
        return State(torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in images]), gradient)

    def _full(self, s: RenderSettings, detached: bool) -> State:
        states = []
        for camera, u in zip(self.cameras, self.u, strict=True):
            g = self._leaves()
            drawn = constant_colors(g, camera) if detached else g
            states.append(self._state(g, [render(drawn, camera, s, outputs=()).rgb.cpu()], [u]))
        return _joined(states)

    def _part(self, s: RenderSettings, kind: str) -> State:
        """Both crops, in float32 by drawing the whole picture, in float64 by the oracle's window."""
        camera = self.cameras[0]
        states = []
        for x, y, width, height in self.windows:
            rows, columns = slice(y, y + height), slice(x, x + width)
            g = self._leaves()
            window = (x, y, width, height)
            with torch.set_grad_enabled(self.gradients):
                if kind == "float32":
                    image = render(g, camera, s, outputs=()).rgb.cpu()[rows, columns]
                elif kind == "float64":
                    image = reference.render(g, camera, s, window=window).rgb
                else:
                    image = reference.render_volume(g, camera, s, window=window).rgb
            states.append(self._state(g, [image], [self.u[0][rows, columns]]))
        return _joined(states)


def _joined(states: list[State]) -> State:
    """Pixels of all, and the sum of their gradients."""
    gradient: dict[str, Any] = {name: sum(x.gradient[name] for x in states) for name in states[0].gradient}
    return State(torch.cat([x.image for x in states]), gradient)


def constant_colors(g: Gaussians, camera: Camera) -> Gaussians:
    """The same image with colors computed beforehand, from directions that are constants."""
    offset = torch.from_numpy(np.asarray(camera.center, np.float64) - np.asarray(g.origin, np.float64))
    towards = g.means.detach().cpu().double() - offset  # this is the approximation: the mean gets nothing through it
    base = (sh_colors(g.sh.cpu().double(), towards) - 0.5) * np.sqrt(4 * np.pi)
    return g.replace(sh=base.to(g.sh.dtype).to(g.sh.device)[:, None, :])


# ------------------------------------------------------------------------------------------------------------ the table


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
