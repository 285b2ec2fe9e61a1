"""Is a rasterizer's image right, are its gradients, and if not, what explains it?

The image is compared with our models until one with the rasterizer's conventions is found (conventions.py). There the
gradients of <u, image>, u of random signs, are compared group by group. Where they differ, a choice that is known to be
made on purpose may explain it; else the rasterizer's own central differences decide (differences.py):

    agreement          the gradient is the model's
    known deviation    it is the model's with a documented choice: view direction detached, clamped alpha passed through
    gradient bug       it disagrees with the rasterizer's own differences, or is not finite
    model difference   it agrees with them, and the model is another one
    undecided          too few differences converged, or a dump cannot be asked

The verdict of the whole is the worst of them; `other convention` if only conventions differ from what was claimed.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.lab import conventions
from drgs.lab.conventions import Model
from drgs.lab.crops import crops
from drgs.lab.judgement import Case, compared, judge
from drgs.lab.rasterizers import Dump, Rasterizer, cotangents, raw_of
from drgs.settings import RenderSettings

__all__ = ["VERDICTS", "Result", "crossval"]

VERDICTS = ("gradient bug", "undecided", "model difference", "other convention", "known deviation", "agreement")
_STARTS = ("gsplat", "inria", "fast", "exact", "mitsuba")  # of equally near ones the first is taken
_ORACLE_PAIRS = 4_000_000  # (pixel, Gaussian) pairs of a scene that the oracle takes as it is
_TOLERANCE = {torch.float64: 5e-4, torch.float32: 5e-3}
_SETTLED = {torch.float64: 1e-5, torch.float32: 1e-4}  # RMS of images that differ by rounding and its cut-offs
_ALPHA = 1e-4  # a mean difference of alpha that is worth a word


@dataclasses.dataclass(frozen=True)
class Result:
    """What `crossval` found.

    Attributes:
        report: Everything, JSON-serializable.
        images: A dict a view: `rasterizer`, `model`, `exact` (H, W, 3) arrays.
        model: The model at the rasterizer's conventions.
        gaussians, cameras: What was compared (a part of a large scene where the oracle is the reference).
    """

    report: dict
    images: list[dict[str, np.ndarray]]
    model: Model
    gaussians: Gaussians
    cameras: list[Camera]

    @property
    def verdict(self) -> str:
        """The worst of the groups' verdicts."""
        return self.report["verdict"]

    def lines(self) -> list[str]:
        """The findings, one a line."""
        r = self.report
        lines = [f"{r['rasterizer']}: {r['verdict']} (model: preset {r['preset']})", *r["scope"]]
        for c in r["conventions"]:
            lines.append(f"convention: {c['name']} is {c['found']}, expected {c['expected']}")
        for view in r["image"]["views"]:
            if abs(bias := view["alpha"]["bias"]) > _ALPHA:
                what = "lower: hits are missing" if bias < 0 else "higher"
                lines.append(f"view {view['view']}: alpha is {abs(bias):.1e} {what} on average")
        for name, group in r["groups"].items():
            what = group["verdict"] + (f": {group['why']}" if group["why"] else "")
            lines.append(f"{name}: {what}; relative difference {group['relative']:.2g}, cosine {group['cosine']:.6f}")
        return lines


def crossval(
    rasterizer: Rasterizer | Dump,
    g: Gaussians,
    cameras: list[Camera],
    preset: str = "auto",
    fields: dict | None = None,
    *,
    tolerance: float | None = None,
    entries: int = 10,
    seed: int = 0,
    advance: Callable[[str], None] | None = None,
) -> Result:
    """Compare a rasterizer with the model that it claims to compute.

    Args:
        rasterizer: From `drgs.lab.rasterizers.load`.
        g: The scene.
        cameras: Pinhole cameras of one image size.
        preset: What it claims to be, or `auto`: the preset whose image needs least to be explained.
        fields: Settings that replace the preset's, `background` among them.
        tolerance: Relative L2 difference of gradients that agree; default 5e-4, and 5e-3 in float32.
        entries: Parameters a group whose central differences are taken, where they are needed.
        seed: Of the cotangents.
        advance: Called with each stage's name.
    Raises:
        ValueError: If cameras differ in size, or the rasterizer's function fails.
    Reference:
        The reference is `drgs.render` (float32, its errors in docs/numerics.md); for our own renderers it is the
        float64 oracle, on a crop of every view of a large scene (crops.py).
    """
    say = advance or (lambda _: None)
    fields = dict(fields or {})
    if len(g) == 0:
        raise ValueError("crossval: the scene must have Gaussians, got 0")
    starts = [Model(RenderSettings.preset(name, **_legal(name, fields))) for name in _presets(rasterizer, preset)]
    background = starts[0].settings.background
    oracle = isinstance(rasterizer, Rasterizer) and rasterizer.preset is not None
    whole, asked, places = len(g), len(cameras), [None] * len(cameras)
    if oracle and len(g) * sum(c.width * c.height for c in cameras) > _ORACLE_PAIRS:
        say("crops")
        g, cameras, places = crops(g, cameras, starts[0].settings)
    dtype = getattr(rasterizer, "dtype", torch.float32)
    raw, signs = raw_of(g), cotangents(cameras, seed)
    say("images")
    if isinstance(rasterizer, Dump):
        pictures, alphas, signs = list(rasterizer.images), list(rasterizer.alphas), rasterizer.cotangents
    else:
        pairs = [rasterizer.image(raw, camera, background) for camera in cameras]
        pictures, alphas = ([pair[k] for pair in pairs] for k in range(2))
    if bad := [i for i, x in enumerate(pictures) if not torch.isfinite(x).all()]:
        raise ValueError(f"{rasterizer.name}: its image must be finite, view {bad[0]} has NaN or Inf")
    say("conventions")
    first = int(np.argmax([float(x.var()) for x in pictures]))  # the view that shows most

    @functools.cache
    def drawn_by(model: Model, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        return _drawn(model, raw, cameras[view], oracle)

    @functools.cache
    def ties_of(model: Model, view: int) -> torch.Tensor:
        say("near ties")
        return model.near_ties(raw, cameras[view])

    found = conventions.find(
        pictures[first], starts, lambda m: drawn_by(m, first)[0], lambda m: ties_of(m, first), _SETTLED[dtype]
    )
    model = found.model
    drawn = [drawn_by(model, view) for view in range(len(cameras))]
    if not any(bool(alpha.any()) for _, alpha in drawn):
        raise ValueError("crossval: the cameras must show Gaussians, none of them shows any; choose others")
    case = Case(rasterizer, raw, cameras, background, oracle, tolerance or _TOLERANCE[dtype], entries, first, say)
    beside = compared(case, model, signs, pictures, alphas, drawn, functools.partial(ties_of, model))
    views, agrees, groups = beside.views, beside.agrees, beside.groups
    judge(case, model, beside)
    worst = min((row["verdict"] for row in groups.values()), key=VERDICTS.index)
    if not agrees:
        worst = min(worst, "model difference", key=VERDICTS.index)
    elif found.findings:
        worst = min(worst, "other convention", key=VERDICTS.index)
    report = {
        "rasterizer": rasterizer.name,
        "verdict": worst,
        "preset": next(n for n, s in zip(_presets(rasterizer, preset), starts, strict=True) if s == found.start),
        "conventions": [dataclasses.asdict(finding) for finding in found.findings],
        "image": {"agrees": agrees, "before": found.before, "after": found.after, "views": views},
        "groups": groups,
        "reference": "float64 oracle" if oracle else "drgs.render",
        "gaussians": len(g),
        "of_gaussians": whole,
        "of_views": asked,
        "cameras": [camera.name for camera in cameras],
        "size": [cameras[0].width, cameras[0].height],
        "crops": places,
        "pixels": beside.ties.numel(),
        "near_ties": int(beside.ties.sum()),
        "near_ties_counted": beside.counted,
        "background": list(background),
        "tolerance": case.tolerance,
        "seed": seed,
        "settings": dataclasses.asdict(model.settings),
    }
    report["scope"] = _scope(report)
    say("pictures")
    exact, images = Model(RenderSettings.preset("exact", background=background)), []
    for picture, (same, _), camera in zip(pictures, drawn, cameras, strict=True):
        true, _ = _drawn(exact, raw, camera, False)
        images.append({"rasterizer": picture.numpy(), "model": same.numpy(), "exact": true.numpy()})
    return Result(report, images, model, g, cameras)


def _scope(r: dict) -> list[str]:
    """What was compared, one thing a line."""
    size = "{}x{}".format(*r["size"])
    views = f"{len(r['cameras'])} views" if len(r["cameras"]) > 1 else "1 view"
    if len(r["cameras"]) < r["of_views"]:
        views += f" ({r['of_views'] - len(r['cameras'])} more show nothing)"
    lines = [f"compared: {views} of {size} pixels, {r['gaussians']:,} Gaussians"]
    if r["crops"][0]:
        at = ", ".join(f"({crop['x']}, {crop['y']})" for crop in r["crops"])
        whole = "{}x{}".format(*r["crops"][0]["of"])
        lines = [
            f"compared: a crop of {size} pixels of {views} of {whole}, at {at}, where most is seen, and the "
            f"{r['gaussians']:,} of {r['of_gaussians']:,} Gaussians that are seen there: the float64 oracle is slow"
        ]
    if r["near_ties"]:
        what = "counted all the same, too little would be left" if r["near_ties_counted"] else "left out"
        lines.append(
            f"{r['near_ties']:,} of {r['pixels']:,} pixels hang on near ties that float32 cannot tell apart: {what}"
        )
    return lines


def _presets(rasterizer, preset: str) -> list[str]:
    if preset != "auto":
        return [preset]
    own = getattr(rasterizer, "preset", None)
    return [own] if own else list(_STARTS)


def _legal(name: str, fields: dict) -> dict:
    """The fields, for a preset that may not know all of them: with `auto` each preset takes what it can."""
    try:
        RenderSettings.preset(name, **fields)
    except NotImplementedError:
        return {k: v for k, v in fields.items() if k == "background"}
    return fields


def _drawn(model: Model, raw: dict, camera: Camera, oracle: bool) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():
        image, alpha = model.draw(raw, camera, oracle)
    return image.cpu(), alpha.cpu()
