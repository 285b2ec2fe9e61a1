"""Is a rasterizer's image right, are its gradients, and if not, what explains it?

The image is compared with our models until one with the rasterizer's conventions is found (conventions.py). There the
gradients of <u, image>, u of random signs, are compared group by group: raw parameters, the pose of every view along
rigid motions (`viewmats`), and, in an image of many channels, plain `colors` (channels.py). Where they differ, a choice
that is known to be made on purpose may explain it; else the rasterizer's own central differences decide
(differences.py):

    agreement          the gradient is the model's
    known deviation    it is the model's with a documented choice: view direction detached, clamped alpha passed through
    gradient bug       it disagrees with the rasterizer's own differences, or is not finite
    model difference   it agrees with them, and the model is another one
    undecided          too few differences converged, or a dump cannot be asked

The verdict of the whole is the worst of them; `other convention` if only conventions differ from what was claimed. What
a rasterizer has no gradient of is not offered, and said so.
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
from drgs.lab.channels import wide_gradients
from drgs.lab.crops import crops
from drgs.lab.dumps import Dump, cotangents
from drgs.lab.image_errors import error_line
from drgs.lab.rasterizers import Rasterizer
from drgs.lab.raw import COLORS, POSE, raw_of, with_pose
from drgs.lab.reference_model import ReferenceModel
from drgs.lab.rows import Crop, GroupRow, ViewRow
from drgs.lab.verdicts import Case, compared, judge, with_errors
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
        groups: A row a group whose gradient was compared.
        views: A row a view.
        findings: Conventions that differ from the preset's.
        model: The model at the rasterizer's conventions.
        gaussians, cameras: What was compared (a part of a large scene where the oracle is the reference).
    """

    report: dict
    images: list[dict[str, np.ndarray]]
    groups: dict[str, GroupRow]
    views: list[ViewRow]
    findings: list[conventions.Finding]
    model: ReferenceModel
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
        for finding in self.findings:
            lines.append(f"convention: {finding.name} is {finding.found}, expected {finding.expected}")
        for view in self.views:
            if view.error is not None:
                lines.append(f"view {view.view}: {error_line(view.error, r['size'])}")
            if abs(bias := view.alpha.bias) > _ALPHA:
                what = "lower: hits are missing" if bias < 0 else "higher"
                lines.append(f"view {view.view}: alpha is {abs(bias):.1e} {what} on average")
        for name, group in self.groups.items():
            verdict = f"{group.verdict}: {group.why}" if group.why else group.verdict
            lines.append(f"{name}: {verdict}; relative difference {group.relative:.2g}, cosine {group.cosine:.6f}")
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
    channels: int = 6,
    advance: Callable[[str], None] | None = None,
) -> Result:
    """Compare a rasterizer with the model that it claims to compute.

    Args:
        rasterizer: From `drgs.lab.rasterizers.load_rasterizer`.
        g: The scene.
        cameras: Pinhole cameras of one image size.
        preset: What it claims to be, or `auto`: the preset whose image needs least to be explained.
        fields: Settings that replace the preset's, `background` among them.
        tolerance: Relative L2 difference of gradients that agree; default 5e-4, and 5e-3 in float32.
        entries: Parameters a group whose central differences are taken, where they are needed.
        seed: Of the cotangents.
        channels: Width of the plain colors whose gradient is compared, too; 0 for none.
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
    presets = _presets(rasterizer, preset)
    starts = [ReferenceModel(RenderSettings.preset(name, **_legal(name, fields))) for name in presets]
    background = starts[0].settings.background
    oracle = isinstance(rasterizer, Rasterizer) and rasterizer.preset is not None
    cameras = [c if c.name else dataclasses.replace(c, name=str(i)) for i, c in enumerate(cameras)]
    whole, asked = len(g), len(cameras)
    places: list[Crop | None] = [None] * asked
    if oracle and len(g) * sum(c.width * c.height for c in cameras) > _ORACLE_PAIRS:
        say("crops")
        g, cameras, cropped = crops(g, cameras, starts[0].settings)
        places = [*cropped]
    dtype = getattr(rasterizer, "dtype", torch.float32)
    raw = with_pose(raw_of(g))
    signs = cotangents(cameras, seed)
    say("images")
    if isinstance(rasterizer, Dump):
        pictures = list(rasterizer.images)
        alphas = list(rasterizer.alphas)
        signs = rasterizer.cotangents
    else:
        pairs = [rasterizer.image(raw, camera, background) for camera in cameras]
        pictures, alphas = ([pair[k] for pair in pairs] for k in range(2))
    if bad := [i for i, x in enumerate(pictures) if not torch.isfinite(x).all()]:
        raise ValueError(f"{rasterizer.name}: its image must be finite, view {bad[0]} has NaN or Inf")
    say("conventions")
    first = int(np.argmax([float(x.var()) for x in pictures]))  # the view that shows most

    @functools.cache
    def drawn_by(model: ReferenceModel, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        return _drawn(model, raw, cameras[view], oracle)

    @functools.cache
    def ties_of(model: ReferenceModel, view: int) -> torch.Tensor:
        say("near ties")
        return model.near_ties(raw, cameras[view])

    found = conventions.find(
        pictures[first], starts, lambda m: drawn_by(m, first)[0], lambda m: ties_of(m, first), _SETTLED[dtype]
    )
    model = found.model
    claimed = next(name for name, start in zip(presets, starts, strict=True) if start == found.start)
    drawn = [drawn_by(model, view) for view in range(len(cameras))]
    if not any(bool(alpha.any()) for _, alpha in drawn):
        raise ValueError("crossval: the cameras must show Gaussians, none of them shows any; choose others")
    case = Case(rasterizer, raw, cameras, background, oracle, tolerance or _TOLERANCE[dtype], entries, first, say)
    beside = compared(case, model, signs, pictures, alphas, drawn, functools.partial(ties_of, model))
    judge(case, model, beside)
    if not beside.agrees:
        say("what the error looks like")
        models = {"the model at its conventions": model} if found.findings else {}
        models |= {f"preset {claimed}": found.start}  # and what else may be meant
        models |= {f"preset {name}": start for name, start in zip(presets, starts, strict=True)}
        beside.views = with_errors(beside, pictures, models, drawn_by)
    not_offered = {} if POSE in beside.groups else {POSE: "its image has no gradient of them"}
    if channels:
        wide, reason = wide_gradients(case, model, beside, channels, seed, functools.partial(ties_of, model))
        beside.groups |= wide
        not_offered |= {COLORS: reason} if reason else {}
    worst = min((row.verdict for row in beside.groups.values()), key=VERDICTS.index)
    if not beside.agrees:
        worst = min(worst, "model difference", key=VERDICTS.index)
    elif found.findings:
        worst = min(worst, "other convention", key=VERDICTS.index)
    report = {
        "rasterizer": rasterizer.name,
        "verdict": worst,
        "preset": claimed,
        "conventions": [dataclasses.asdict(finding) for finding in found.findings],
        "image": {
            "agrees": beside.agrees,
            "before": found.before,
            "after": found.after,
            "views": [dataclasses.asdict(row) for row in beside.views],
        },
        "groups": {name: row.json() for name, row in beside.groups.items()},
        "not_offered": not_offered,
        "reference": "float64 oracle" if oracle else "drgs.render",
        "gaussians": len(g),
        "of_gaussians": whole,
        "of_views": asked,
        "cameras": [camera.name for camera in cameras],
        "size": [cameras[0].width, cameras[0].height],
        "crops": [None if place is None else dataclasses.asdict(place) for place in places],
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
    exact = ReferenceModel(RenderSettings.preset("exact", background=background))
    images = []
    for picture, (same, _), camera in zip(pictures, drawn, cameras, strict=True):
        true, _ = _drawn(exact, raw, camera, False)
        images.append({"rasterizer": picture.numpy(), "model": same.numpy(), "exact": true.numpy()})
    return Result(report, images, beside.groups, beside.views, found.findings, model, g, cameras)


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
    lines += [f"not compared: the gradient of {name}: {why}" for name, why in r["not_offered"].items()]
    return lines


def _presets(rasterizer: Rasterizer | Dump, preset: str) -> list[str]:
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


def _drawn(model: ReferenceModel, raw: dict, camera: Camera, oracle: bool) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():  # images alone are compared
        image, alpha = model.draw(raw, camera, oracle)
    return image.cpu(), alpha.cpu()
