"""How much of a rasterizer's difference to exact ray tracing each of its approximations explains.

From a rasterizer's settings to preset `exact` one thing is switched at a time, in a stated order and in its reverse,
and each step's image and gradient are kept. With the step ``s_k = y_k - y_{k-1}`` and ``total = y_end - y_start`` a
rung's share is ``<s_k, total> / |total|^2``: shares sum to 1, one above 1 or below 0 says that steps cancel, and the
two orders agree where steps do not interact. Gradients are ``J^T u`` of one fixed Rademacher cotangent u, group by
group in raw parameters.

The order is that of `RUNGS`. Its reverse is not always legal: dilation, culling and the field-of-view clamp exist
only in `ewa`, exact order along rays only outside of it (`drgs.settings.legal`). A rung that needs others takes them
with it: reversed, culling and dilation still come just before the EWA linearization, and that before the order.
`float32` is measured against the float64 oracle, on crops; `response` (peak to integral) and `volume` (sorted
compositing to the integral over summed densities) lie beyond `exact` and stay last.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs import reference
from drgs.integrator import render
from drgs.lab.rasterizers import PARAMETERS
from drgs.oracle import sh_colors
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.ellipsoids import Gaussians

__all__ = ["RUNGS", "Pictures", "ladder", "sequences", "table"]

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


@dataclasses.dataclass
class _State:
    """Pixels (P, 3), float64, and the gradient by group (empty without gradients)."""

    image: torch.Tensor
    gradient: dict[str, torch.Tensor]


class Pictures:
    """Images and gradients of one scene and its cameras, each computed once.

    Give the same one to several calls of `ladder` (other starts) to share what they have in common.

    Args:
        g: N Gaussians.
        cameras: Pinhole cameras, at least one.
        crop: Width and height in pixels of the crops of the first camera; 0 for none.
        seed: Of the cotangent.
        gradients: Whether J^T u is wanted.
        advance: Called after each image.
    """

    def __init__(self, g, cameras, crop=24, seed=0, gradients=True, advance: Callable[[], None] | None = None):
        if not len(cameras) or not len(g):
            raise ValueError(
                f"ladder: there must be a camera and a Gaussian, got {len(cameras)} and {len(g)}; give both"
            )
        if crop < 0:
            raise ValueError(f"ladder: crop must be >= 0 pixels, got {crop}; correct it")
        self.g, self.cameras, self.crop, self.gradients = g.detach(), list(cameras), crop, gradients
        self.advance = advance or (lambda: None)
        self.background = (0.0, 0.0, 0.0)
        rng = np.random.default_rng(seed)
        self.u = [torch.from_numpy(rng.choice([-1.0, 1.0], (c.height, c.width, 3))) for c in self.cameras]
        self.windows: list[tuple[int, int, int, int]] = []
        self._made: dict = {}

    def full(self, s: RenderSettings, detached: bool = False) -> _State:
        """All pixels of all cameras, by `drgs.render`; `detached`: colors ignore how the direction follows a mean."""
        return self._get(("full", s, detached), lambda: self._full(s, detached))

    def part(self, s: RenderSettings, kind: str) -> _State:
        """The crops: kind `float32` (`drgs.render`), `float64` (`reference.render`) or `volume`."""
        return self._get((kind, s), lambda: self._part(s, kind))

    def place_crops(self, s: RenderSettings) -> None:
        """The middle of the first camera's image and, if it does not overlap, the corner with the most opacity."""
        camera = self.cameras[0]
        width, height = min(self.crop, camera.width), min(self.crop, camera.height)
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        self.windows = [(x, y, width, height)]
        if x < width and y < height:
            return
        with torch.no_grad():
            alpha = render(self.g, camera, s, outputs=()).alpha
        corners = [(x, y) for y in (0, camera.height - height) for x in (0, camera.width - width)]
        x, y = max(corners, key=lambda at: float(alpha[at[1] : at[1] + height, at[0] : at[0] + width].sum()))
        self.windows.append((x, y, width, height))

    def _get(self, key, make) -> _State:
        if key not in self._made:
            self._made[key] = make()
            self.advance()
        return self._made[key]

    def _leaves(self) -> Gaussians:
        moving = {name: self.g.parameters()[name].clone().requires_grad_(self.gradients) for name in PARAMETERS}
        return self.g.replace(features=None, **moving)

    def _state(self, g, images: list, cotangents: list) -> _State:
        gradient = {}
        if self.gradients:
            loss = sum((image.double() * u).sum() for image, u in zip(images, cotangents, strict=True))
            leaves = [g.parameters()[name] for name in PARAMETERS]
            if loss.requires_grad:
                found = torch.autograd.grad(loss, leaves, allow_unused=True)
            else:
                found = [None] * len(leaves)
            for name, leaf, x in zip(PARAMETERS, leaves, found, strict=True):
                gradient[name] = torch.zeros_like(leaf) if x is None else x.detach().cpu()
        return _State(torch.cat([x.detach().cpu().double().reshape(-1, 3) for x in images]), gradient)

    def _full(self, s: RenderSettings, detached: bool) -> _State:
        states = []
        for camera, u in zip(self.cameras, self.u, strict=True):
            g = self._leaves()
            drawn = _detached(g, camera) if detached else g
            states.append(self._state(g, [render(drawn, camera, s, outputs=()).rgb.cpu()], [u]))
        return _sum(states)

    def _part(self, s: RenderSettings, kind: str) -> _State:
        camera, states = self.cameras[0], []
        for x, y, width, height in self.windows:
            rows, columns = slice(y, y + height), slice(x, x + width)
            g, window = self._leaves(), (x, y, width, height)
            with torch.set_grad_enabled(self.gradients):
                if kind == "float32":
                    image = render(g, camera, s, outputs=()).rgb.cpu()[rows, columns]
                elif kind == "float64":
                    image = reference.render(g, camera, s, window=window).rgb
                else:
                    image = reference.render_volume(g, camera, s, window=window).rgb
            states.append(self._state(g, [image], [self.u[0][rows, columns]]))
        return _sum(states)


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
        start: The rasterizer, for example `RenderSettings.preset("gsplat")`; its background stays.
        crop: Width and height in pixels of the crops, in the middle and in a corner; 0 leaves crops, and with them
            float32 and the far end, out.
        seed: Of the cotangent.
        volume: Also the far end, on the crops: response peak to integral, and sorting to the true volume.
        gradients: Also the gradients by group.
        advance: Called after each image that is computed.
        pictures: Of an earlier call with the same scene, cameras, crop and seed.
    Returns:
        A JSON-serializable dict. `image`: the ladder over all pixels in float32, with lists `forward` and `reverse` of
        rungs (rung, switched, rms, max, norm, share, of_total, of_exact; gradient by group, with the last four) and
        `total`.
        `crops`: `windows` and the same with `float32`, and under `far` the two rungs beyond `exact`. A row `rest` of
        the crops' forward order holds the rounding that float32 does at `exact` but not at the start: only both ends
        are in float64. `asides`: steps that belong to no ladder (see there).
    Raises:
        ValueError: If there is no camera or Gaussian, or a rung cannot be reached.
    """
    made = pictures or Pictures(g, cameras, crop, seed, gradients, advance)
    end = RenderSettings.preset("exact", background=start.background)
    if made.crop and not made.windows:
        made.place_crops(start)
    orders = sequences(start, end)
    report = {
        "start": dataclasses.asdict(start),
        "end": dataclasses.asdict(end),
        "gaussians": len(g),
        "views": len(cameras),
        "pixels": sum(c.width * c.height for c in cameras),
        "seed": seed,
        "groups": list(PARAMETERS) if gradients else [],
        "image": {"total": None},
        "crops": {"windows": [list(w) for w in made.windows], "total": None},
    }
    for name, steps in zip(("forward", "reverse"), orders, strict=True):
        names = [rung for rung, _ in steps]
        switched = [_switched(a, b) for a, b in pairwise([start, *(s for _, s in steps)])]
        states = [made.full(start), *(made.full(s) for _, s in steps)]
        report["image"][name], report["image"]["total"] = _rungs(names, switched, states)
        if not made.windows:
            continue
        states = [made.part(start, "float32"), *(made.part(s, "float32") for _, s in steps)]
        if name == "forward":
            rounding = _minus(made.part(start, "float64"), states[0])
            states = [states[0], *(_plus(state, rounding) for state in states), made.part(end, "float64")]
            names, switched = ["float32", *names, "rest"], [{}, *switched, {}]
        else:
            states, names, switched = [*states, made.part(end, "float64")], [*names, "float32"], [*switched, {}]
        report["crops"][name], report["crops"]["total"] = _rungs(names, switched, states)
    if not made.windows:
        del report["crops"]
    elif volume:
        integral = end.replace(response="integral")
        states = [made.part(end, "float64"), made.part(integral, "float64"), made.part(integral, "volume")]
        rungs, total = _rungs(list(_BEYOND), [_switched(end, integral), {}], states, states[0])
        report["far"] = {"forward": rungs, "total": total}
    report["asides"] = _asides(made, start, end)
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
    made = []
    for order in (names, names[::-1]):
        now, steps, done = start, [], set()
        for rung in _with_needs(order):
            if rung not in done and rung in names:
                now = now.replace(**changes[rung])
                steps.append((rung, now))
                done.add(rung)
        made.append(steps)
    return made[0], made[1]


def _with_needs(order: list[str]) -> list[str]:
    """Each rung behind those that it needs; repeated where a later one needs it too."""

    def whole(rung):
        needed = [n for n in order if n in _NEEDS.get(rung, ())]
        return [*(x for n in needed for x in whole(n)), rung]

    return [x for rung in order for x in whole(rung)]


def _switched(a: RenderSettings, b: RenderSettings) -> dict:
    """Field -> [before, after] where two settings differ."""
    pairs = {f.name: (getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)}
    return {name: list(pair) for name, pair in pairs.items() if pair[0] != pair[1]}


def _rungs(names, switched, states: list[_State], exact: _State | None = None) -> tuple[list[dict], dict]:
    """One entry a step, and the whole way."""
    exact, total = exact or states[-1], _minus(states[-1], states[0])
    rows = []
    for name, change, a, b in zip(names, switched, states[:-1], states[1:], strict=True):
        step = _minus(b, a)
        rows.append({"rung": name, "switched": change, **_step(step, total, exact)})
    return rows, _step(total, total, exact)


def _step(step: _State, total: _State, exact: _State) -> dict:
    """Sizes of one step."""
    gradient = {n: _relative(x, total.gradient[n], exact.gradient[n]) for n, x in step.gradient.items()}
    return {
        "rms": float(step.image.square().mean().sqrt()),
        "max": float(step.image.abs().max()),
        **_relative(step.image, total.image, exact.image),
        "gradient": gradient,
    }


def _relative(step: torch.Tensor, total: torch.Tensor, exact: torch.Tensor) -> dict:
    """|step|, <step, total> / |total|^2, |step| / |total|, |step| / |exact|; None where the divisor is 0."""
    step, total, exact = (x.double().reshape(-1) for x in (step, total, exact))
    whole, truth, size = float(total.norm()), float(exact.norm()), float(step.norm())
    return {
        "norm": size,
        "share": float(step @ total) / whole**2 if whole > 0 else None,
        "of_total": size / whole if whole > 0 else None,
        "of_exact": size / truth if truth > 0 else None,
    }


def _asides(made: Pictures, start: RenderSettings, end: RenderSettings) -> list[dict]:
    """Steps outside of the ladder, over all pixels, relative to `exact` and to the ladder's total.

    The gradient of the start without the direction's path (training code often detaches the direction that SH are
    evaluated in: the image stays), SH along rays instead of towards means, and the response, both from `exact`.
    """
    first, exact = made.full(start), made.full(end)
    total, steps = _minus(exact, first), {}
    if made.gradients and start.sh_direction == "gaussian" and made.g.sh.shape[1] > 1:
        steps["view direction detached"] = _minus(made.full(start, True), first)
    if made.g.sh.shape[1] > 1:
        steps["SH along rays"] = _minus(made.full(end.replace(sh_direction="ray")), exact)
    steps["response"] = _minus(made.full(end.replace(response="integral")), exact)
    return [{"rung": name, **_step(step, total, exact)} for name, step in steps.items()]


def _detached(g: Gaussians, camera: Camera) -> Gaussians:
    """The same image with colors computed beforehand, from directions that are constants."""
    offset = torch.from_numpy(np.asarray(camera.center, np.float64) - np.asarray(g.origin, np.float64))
    towards = g.means.detach().cpu().double() - offset
    base = (sh_colors(g.sh.cpu().double(), towards) - 0.5) * np.sqrt(4 * np.pi)
    return g.replace(sh=base.to(g.sh.dtype).to(g.sh.device)[:, None, :])


def _sum(states: list[_State]) -> _State:
    """Pixels joined, gradients added."""
    gradient = {name: sum(x.gradient[name] for x in states) for name in states[0].gradient}
    return _State(torch.cat([x.image for x in states]), gradient)


def _plus(a: _State, b: _State) -> _State:
    return _State(a.image + b.image, {name: x.double() + b.gradient[name].double() for name, x in a.gradient.items()})


def _minus(a: _State, b: _State) -> _State:
    return _State(a.image - b.image, {name: x.double() - b.gradient[name].double() for name, x in a.gradient.items()})


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
    for row in report["asides"]:
        cells = [_percent(row["gradient"][name]["of_exact"]) for name in groups]
        lines.append(f"| {row['rung']} | {row['rms']:.1e} | {row['max']:.1e} |" + "".join(f" {c} |" for c in cells))
    return "\n".join(lines)


def _both(part: dict, groups: list[str], what: str) -> list[str]:
    """Rows of one ladder: RMS and share of the image, shares of the gradients, `first order / reverse`."""
    back = {row["rung"]: row for row in part["reverse"]}
    lines = [f"| rung, {what} | RMS | max | share |" + "".join(f" {name} |" for name in groups)]
    lines.append("|---" * (4 + len(groups)) + "|")

    def pair(row, other, read, show):
        found = [show(read(x)) for x in (row, other) if x is not None]
        return " / ".join(dict.fromkeys(found))  # once where both orders agree

    for row in part["forward"]:
        other = back.get(row["rung"])
        cells = [
            pair(row, other, lambda x: x["rms"], "{:.1e}".format),
            pair(row, other, lambda x: x["max"], "{:.1e}".format),
            pair(row, other, lambda x: x["share"], _percent),
            *(pair(row, other, lambda x, n=name: x["gradient"][n]["share"], _percent) for name in groups),
        ]
        lines.append(f"| {row['rung']} |" + "".join(f" {c} |" for c in cells))
    total = part["total"]
    cells = [f"{total['rms']:.1e}", f"{total['max']:.1e}", "100 %"]
    cells += [f"|total| = {_percent(total['gradient'][n]['of_exact'])} of |exact|".replace("|", "\\|") for n in groups]
    lines.append("| total |" + "".join(f" {c} |" for c in cells))
    return lines


def _percent(x: float | None) -> str:
    """Two digits below 1 %, none above 10."""
    if x is None:
        return "-"
    digits = 0 if abs(x) >= 0.1 or abs(x) < 5e-5 else 1 if abs(x) >= 0.01 else 2
    x = 0.0 if abs(x) < 5e-5 else x
    return f"{100 * x:.{digits}f} %"
