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
import itertools
from collections.abc import Callable

import numpy as np
import torch

from drgs import conventions
from drgs.cameras import Camera
from drgs.conventions import Model
from drgs.differences import Differences, central
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.rasterizers import GROUPS, Dump, Rasterizer, cotangents, raw_of
from drgs.settings import RenderSettings

__all__ = ["VERDICTS", "Result", "crossval"]

VERDICTS = ("gradient bug", "undecided", "model difference", "other convention", "known deviation", "agreement")
_STARTS = ("gsplat", "inria", "fast", "exact", "mitsuba")  # of equally near ones the first is taken
_ORACLE_PAIRS = 4_000_000  # (pixel, Gaussian) pairs of a scene that the oracle takes as it is
_CROP = 32  # pixels a side of what it takes of a larger one; a multiple of the rasterizers' tiles
_PIXEL = 1e-3  # a pixel that differs by more hangs on a cut-off or on the order; if few do, they are left out
_FEW = 0.01
_IMAGE = 1e-3  # RMS of images that agree
_TOLERANCE = {torch.float64: 5e-4, torch.float32: 5e-3}
_SETTLED = {torch.float64: 1e-5, torch.float32: 1e-4}  # RMS of images that differ by rounding and its cut-offs
_ALPHA = 1e-4  # a mean difference of alpha that is worth a word
_ENOUGH = 3  # converged differences that a verdict needs
_OWN = 0.02  # relative difference from its own central differences that is a bug


@dataclasses.dataclass(frozen=True)
class Deviation:
    """A difference of gradients that is made on purpose.

    Attributes:
        name: In words.
        where: Where it is known from.
        change: Fields of the model that have it.
    """

    name: str
    where: str
    change: dict


_DETACHED = Deviation(
    "view direction of SH detached",
    "training code that evaluates SH on detached directions",
    {"direction_gradient": False},
)
_PASSED = Deviation("clamped alpha passes its gradient", "INRIA, backward.cu:977", {"alpha_max_gradient": "pass"})
_ZEROED = Deviation(
    "clamped alpha has no gradient", "gsplat, RasterizeToPixels3DGSDevice.cuh:155", {"alpha_max_gradient": "zero"}
)


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
        lines = [f"{r['rasterizer']}: {r['verdict']} (model: preset {r['preset']})"]
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
        rasterizer: From `drgs.rasterizers.load`.
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
        float64 oracle, on a part of a large scene.
    """
    say = advance or (lambda _: None)
    fields = dict(fields or {})
    if len(g) == 0:
        raise ValueError("crossval: the scene must have Gaussians, got 0")
    starts = [Model(RenderSettings.preset(name, **_legal(name, fields))) for name in _presets(rasterizer, preset)]
    background = starts[0].settings.background
    oracle = isinstance(rasterizer, Rasterizer) and rasterizer.preset is not None
    if oracle:
        g, cameras = _part(g, cameras, starts[0].settings)
    dtype = getattr(rasterizer, "dtype", torch.float32)
    tolerance = tolerance or _TOLERANCE[dtype]
    raw, u = raw_of(g), cotangents(cameras, seed)
    say("images")
    if isinstance(rasterizer, Dump):
        pictures, alphas, u = list(rasterizer.images), list(rasterizer.alphas), rasterizer.cotangents
    else:
        pairs = [rasterizer.image(raw, camera, background) for camera in cameras]
        pictures, alphas = ([pair[k] for pair in pairs] for k in range(2))
    if bad := [i for i, x in enumerate(pictures) if not torch.isfinite(x).all()]:
        raise ValueError(f"{rasterizer.name}: its image must be finite, view {bad[0]} has NaN or Inf")
    say("conventions")
    first = int(np.argmax([float(x.var()) for x in pictures]))  # the view that shows most
    found = conventions.find(pictures[first], raw, cameras[first], starts, oracle, _SETTLED[dtype])
    model = found.model
    drawn = [_drawn(model, raw, camera, oracle) for camera in cameras]
    if not any(bool(alpha.any()) for _, alpha in drawn):
        raise ValueError("crossval: the cameras must show Gaussians, none of them shows any; choose others")
    views = [_image_row(c, a, b, s, t) for c, a, b, (s, t) in zip(cameras, pictures, alphas, drawn, strict=True)]
    agrees = all(row["rms"] <= _IMAGE and row["share"] <= _FEW for row in views)
    if agrees and not isinstance(rasterizer, Dump):
        far = torch.stack([(a - s).abs().amax(-1) > _PIXEL for a, (s, _) in zip(pictures, drawn, strict=True)])
        u = u * ~far[..., None]
    groups = _judged(rasterizer, model, agrees, raw, cameras, background, u, first, oracle, tolerance, entries, say)
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
        "cameras": [camera.name for camera in cameras],
        "size": [cameras[0].width, cameras[0].height],
        "background": list(background),
        "tolerance": tolerance,
        "seed": seed,
        "settings": dataclasses.asdict(model.settings),
    }
    say("pictures")
    exact, images = Model(RenderSettings.preset("exact", background=background)), []
    for picture, (same, _), camera in zip(pictures, drawn, cameras, strict=True):
        true, _ = _drawn(exact, raw, camera, False)
        images.append({"rasterizer": picture.numpy(), "model": same.numpy(), "exact": true.numpy()})
    return Result(report, images, model, g, cameras)


def _judged(
    rasterizer, model: Model, agrees, raw, cameras, background, u, first, oracle, tolerance, entries, say
) -> dict:
    """Group -> how its gradient compares, with its verdict; `first` is the view that is asked for differences."""
    say("gradients")
    theirs = _gradients(rasterizer, raw, cameras, background, u)
    ours = _sum(model.gradient(raw, camera, w, oracle) for camera, w in zip(cameras, u, strict=True))
    groups = {name: _group_row(theirs[name], ours[name], tolerance) for name in GROUPS}
    if agrees:
        _known(groups, theirs, model, raw, cameras, u, oracle, tolerance)
    names = [name for name, row in groups.items() if row["verdict"] is None]
    if names and isinstance(rasterizer, Rasterizer):
        say("central differences")
        same = model if agrees else None
        _decide(groups, names, rasterizer, same, raw, cameras[first], background, u[first], entries)
    elif names:
        verdict, why = "undecided", "the image is of another model, a dump cannot be asked for central differences"
        if agrees:
            verdict, why = "gradient bug", "the image is the model's, the gradient is not"
        for name in names:
            groups[name] |= {"verdict": verdict, "why": why}
    return groups


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


def _part(g: Gaussians, cameras: list[Camera], settings: RenderSettings) -> tuple[Gaussians, list[Camera]]:
    """What the oracle can take: the middle of the first view and the Gaussians that it sees, if the scene is large."""
    if len(g) * sum(c.width * c.height for c in cameras) <= _ORACLE_PAIRS:
        return g, cameras
    camera = cameras[0]
    width, height = min(camera.width, _CROP), min(camera.height, _CROP)
    x, y = (16 * ((camera.width - width) // 32), 16 * ((camera.height - height) // 32))
    K = np.array(camera.K, float)
    K[:2, 2] -= x, y
    part = dataclasses.replace(camera, K=K, width=width, height=height)
    with torch.no_grad():
        seen = render(g, part, settings, outputs=("visibility",)).visibility.cpu() > 0
    index = torch.nonzero(seen)[:, 0]
    if len(index) == 0:
        raise ValueError(f"crossval: the middle of view {camera.name} must show Gaussians, shows none; use --cameras")
    fields = {name: getattr(g, name).detach()[index] for name in GROUPS}
    return Gaussians(**fields, origin=g.origin), [part]


def _drawn(model: Model, raw: dict, camera: Camera, oracle: bool) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():
        image, alpha = model.draw(raw, camera, oracle)
    return image.cpu(), alpha.cpu()


def _sum(parts) -> dict:
    total: dict = {}
    for part in parts:
        total = {name: x + total[name] if total else x for name, x in part.items()}
    return total


def _gradients(rasterizer, raw, cameras, background, u) -> dict:
    """Summed over views; None where there is none."""
    if isinstance(rasterizer, Dump):
        return dict(rasterizer.gradients)
    parts = [rasterizer.gradient(raw, camera, background, w) for camera, w in zip(cameras, u, strict=True)]
    return {name: None if parts[0][name] is None else sum(part[name] for part in parts) for name in GROUPS}


def _image_row(camera: Camera, image, alpha, same, same_alpha) -> dict:
    """How far two images are apart."""
    error = (image - same).abs().amax(-1)
    worst = torch.topk(error.reshape(-1), min(5, error.numel())).indices
    at = [
        {"x": int(i) % camera.width, "y": int(i) // camera.width, "difference": float(error.view(-1)[i])} for i in worst
    ]
    return {
        "view": camera.name,
        "rms": float((image - same).square().mean().sqrt()),
        "max": float(error.max()),
        "share": float((error > _PIXEL).double().mean()),
        "alpha": {
            "rms": float((alpha - same_alpha).square().mean().sqrt()),
            "bias": float((alpha - same_alpha).mean()),
        },
        "worst": at,
    }


def _group_row(theirs: torch.Tensor | None, ours: torch.Tensor, tolerance: float) -> dict:
    """How far two gradients are apart; `verdict` is None where that is still to be explained."""
    row = {"verdict": None, "why": "", "worst": []}
    if theirs is None:
        theirs, row["why"] = torch.zeros_like(ours), "the image does not depend on it"
    finite = torch.isfinite(theirs)
    if not finite.all():
        index = [int(i) for i in torch.nonzero(~finite)[0]]
        row |= {"verdict": "gradient bug", "why": f"not finite, first at {index}"}
        theirs = torch.where(finite, theirs, 0.0)
    a, b = theirs.reshape(-1), ours.reshape(-1)
    norm = float(b.norm())
    row["relative"] = float((a - b).norm()) / max(norm, 1e-12)
    row["cosine"] = float(a @ b / (a.norm() * b.norm()).clamp_min(1e-300)) if norm > 0 else float(not a.any())
    row["bias"] = float(a @ b) / max(norm, 1e-12) ** 2 - 1 if norm > 0 else 0.0
    row["max"] = float((a - b).abs().max())
    row["norm"] = norm
    each = (theirs - ours).reshape(len(ours), -1).norm(dim=1)
    for i in torch.topk(each, min(5, len(each))).indices:
        row["worst"].append({"gaussian": int(i), "difference": float(each[i])})
    if row["verdict"] is None and (row["relative"] <= tolerance or (norm < 1e-9 and row["max"] < 1e-9)):
        row["verdict"], row["why"] = "agreement", ""
    return row


def _known(groups, theirs, model: Model, raw, cameras, u, oracle, tolerance) -> None:
    """Explain what documented choices explain: the fewest of them that settle most groups."""
    open_ones = [name for name, row in groups.items() if row["verdict"] is None and theirs[name] is not None]
    if not open_ones:
        return
    clamp = _PASSED if model.settings.alpha_max_gradient == "zero" else _ZEROED
    choices = [_DETACHED] if raw["sh"].shape[1] > 1 else []
    choices += [clamp] if model.settings.alpha_max < 1 else []
    best: tuple[list, tuple] = ([], ())
    for size in range(1, len(choices) + 1):
        for chosen in itertools.combinations(choices, size):
            changed = model.replace(**{k: v for c in chosen for k, v in c.change.items()})
            ours = _sum(changed.gradient(raw, camera, w, oracle) for camera, w in zip(cameras, u, strict=True))
            settled = [n for n in open_ones if _group_row(theirs[n], ours[n], tolerance)["verdict"] == "agreement"]
            if len(settled) > len(best[0]):
                best = settled, chosen
    for name in best[0]:
        groups[name] |= {"verdict": "known deviation", "why": "; ".join(f"{c.name} ({c.where})" for c in best[1])}


def _decide(groups, names, rasterizer, model: Model | None, raw, camera, background, u, entries: int) -> None:
    """Ask the rasterizer's own central differences; `model` is given if the image is its."""
    found = rasterizer.gradient(raw, camera, background, u)
    found = {name: torch.zeros_like(raw[name]) if x is None else x for name, x in found.items()}
    wanted = found if model is None else model.gradient(raw, camera, u)
    chosen = {name: _entries(found[name], wanted[name], entries) for name in names}
    own = central(rasterizer, raw, camera, background, u, chosen)
    kept = rasterizer.gradient(raw, camera, background, u * own.kept[..., None])
    wanted = None if model is None else model.gradient(raw, camera, u * own.kept[..., None])
    for name in names:
        there = torch.zeros_like(raw[name]) if kept[name] is None else kept[name]
        row = _own_row(there, None if wanted is None else wanted[name], own, name)
        groups[name]["differences"] = row
        row["pixels_left_out"] = int((~own.kept).sum())
        if len(own.entries[name]) < _ENOUGH:
            groups[name] |= {"verdict": "undecided", "why": f"{row['left_out']} of its differences did not converge"}
        elif row["bug"]:
            groups[name] |= {"verdict": "gradient bug", "why": row["what"]}
        else:
            why = "agrees with its own central differences"
            why += "; its image is of another model" if model is None else ", which differ from the model's gradient"
            groups[name] |= {"verdict": "model difference", "why": why}


def _entries(theirs: torch.Tensor, ours: torch.Tensor, count: int) -> list[int]:
    """Where the two differ most, and where the gradient is largest: half of each."""
    a, b = torch.nan_to_num(theirs).reshape(-1), ours.reshape(-1)
    order = [torch.argsort(x.abs(), descending=True).tolist() for x in (a - b, b)]
    return list(dict.fromkeys(order[0][: count // 2] + order[1][:count]))[:count]


def _own_row(gradient: torch.Tensor, wanted: torch.Tensor | None, own: Differences, name: str) -> dict:
    """A gradient, and the model's if it has the same image, against central differences at their entries."""
    values, bars = own.values[name], own.uncertainty[name]
    there = gradient.reshape(-1)[own.entries[name]]
    error, size = float((there - values).norm()), float(values.norm())
    noise = float(bars.norm())
    ratios = there[values.abs() > 3 * bars] / values[values.abs() > 3 * bars]
    ratio = float(ratios.median()) if len(ratios) else float("nan")
    spread = float((ratios - ratio).abs().median()) if len(ratios) else float("nan")
    bug = error > _OWN * size + 3 * noise
    if wanted is not None:  # a small error, too, if the differences clearly side with the model
        other = float((wanted.reshape(-1)[own.entries[name]] - values).norm())
        bug |= error > 3 * max(noise, other)
    if not there.any() and bug:
        what = "it is 0, its own central differences are not"
    elif spread < 0.02 and abs(ratio - 1) > 0.02:
        what = f"it is {ratio:.3g} times its own central differences"
    else:
        what = f"it is off its own central differences by {error / max(size, 1e-300):.2g} of their size"
    return {
        "entries": own.entries[name],
        "central": values.tolist(),
        "uncertainty": bars.tolist(),
        "gradient": there.tolist(),
        "relative": error / max(size, 1e-300),
        "left_out": own.left_out[name],
        "bug": bool(bug),
        "what": what,
    }
