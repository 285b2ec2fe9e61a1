"""How much of a rasterizer's difference to exact ray tracing each of its approximations explains.

From a rasterizer's settings to preset `exact` one thing is switched at a time, in a stated order and in its reverse,
and each step's image and gradient are kept. With the step `s_k = y_k - y_{k-1}` and `total = y_end - y_start` a
rung's share is `<s_k, total> / |total|^2`: shares sum to 1, one above 1 or below 0 says that steps cancel, and the
two orders agree where steps do not interact. Gradients are `J^T u` of one fixed Rademacher cotangent u, group by
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
from typing import Any

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.lab.ladder_pictures import Pictures, State
from drgs.lab.ladder_table import Step, table
from drgs.lab.raw import PARAMETERS
from drgs.settings import RenderSettings

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
    made = pictures or Pictures(g, cameras, crop, seed, gradients, advance)
    end = RenderSettings.preset("exact", background=start.background)
    if made.crop and not made.windows:
        made.place_crops(start)
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
            rounding = made.part(start, "float64") - states[0]
            states = [states[0], *(state + rounding for state in states), made.part(end, "float64")]
            names = ["float32", *names, "rest"]
            switched = [{}, *switched, {}]
        else:
            states = [*states, made.part(end, "float64")]
            names = [*names, "float32"]
            switched = [*switched, {}]
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
        now = start
        steps = []
        done = set()
        for rung in _with_needs(order):
            if rung not in done and rung in names:
                now = now.replace(**changes[rung])
                steps.append((rung, now))
                done.add(rung)
        made.append(steps)
    return made[0], made[1]


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


def _asides(made: Pictures, start: RenderSettings, end: RenderSettings) -> list[dict]:
    """Steps outside of the ladder, over all pixels, relative to `exact` and to the ladder's total.

    The gradient of the start without the direction's path (training code often detaches the direction that SH are
    evaluated in: the image stays), SH along rays instead of towards means, and the response, both from `exact`. From a
    projected start also the step to preset `3dgut`, which evaluates the same Gaussians along rays and in the order of
    their centers: how far on the way that is.
    """
    first, exact = made.full(start), made.full(end)
    total = exact - first
    steps = {}
    if made.gradients and start.sh_direction == "gaussian" and made.g.sh.shape[1] > 1:
        steps["view direction detached"] = made.full(start, True) - first
    if start.planar:
        steps["3dgut"] = made.full(RenderSettings.preset("3dgut", background=start.background)) - first
    if made.g.sh.shape[1] > 1:
        steps["SH along rays"] = made.full(end.replace(sh_direction="ray")) - exact
    steps["response"] = made.full(end.replace(response="integral")) - exact
    return [Step.of(step, total, exact, name).to_json() for name, step in steps.items()]
