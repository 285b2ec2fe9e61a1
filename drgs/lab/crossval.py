"""Is a rasterizer's image right, are its gradients, and if not, what explains it?

The image is compared with our models until one with the rasterizer's conventions is found (conventions.py). There the
gradients of <u, image>, u of random signs, are compared group by group: raw parameters, the pose of every view along
rigid motions (`viewmats`), and, in an image of many channels, plain `colors`. Where they differ, a choice that is known
to be made on purpose may explain it; else the rasterizer's own central differences decide (verdicts.py):

    agreement          the gradient is the model's
    known deviation    it is the model's with a documented choice: view direction detached, clamped alpha passed through
    gradient bug       it disagrees with the rasterizer's own differences, or is not finite
    model difference   it agrees with them, and the model is another one
    undecided          too few differences converged, or a dump has none

Then the other paths to an image are tested, depth and packed arrays among them (paths.py).

The verdict of the whole is the worst of all; `other convention` if only conventions differ from what was claimed. What
a rasterizer has no gradient of is not offered, and said so.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import cropped
from drgs.ellipsoids import Gaussians
from drgs.integrator import render
from drgs.lab import conventions
from drgs.lab.conventions import ReferenceModel
from drgs.lab.image_errors import error_line
from drgs.lab.parameters import COLORS, MOTIONS, PARAMETERS, around_origin, raw_of, with_colors, with_pose
from drgs.lab.paths import PathRow, path_rows, status_of
from drgs.lab.rasterizers import Dump, Rasterizer, cotangents, one_line
from drgs.lab.verdicts import VERDICTS, Case, Compared, GroupRow, ViewRow, compared, judge, with_errors
from drgs.settings import RenderSettings

__all__ = ["VERDICTS", "Crop", "Result", "crops", "crossval"]

_STARTS = ("gsplat", "inria", "3dgut", "fast", "exact", "mitsuba")  # the first of equally near ones is taken
# (pixel, Gaussian) pairs up to which the oracle takes a scene whole; larger ones are cropped. Chosen: bounds seconds
_ORACLE_PAIRS = 4_000_000
_TOLERANCE = {torch.float64: 5e-4, torch.float32: 5e-3}  # relative L2 difference of gradients that agree
_SETTLED = {torch.float64: 1e-5, torch.float32: 1e-4}  # RMS of images that differ by rounding and its cut-offs
# mean difference of alpha from which on it is reported; chosen, ten times `_SETTLED` of float64
_ALPHA_TOLERANCE = 1e-4
_EMPTY = "crossval: the cameras must show Gaussians, none of them shows any; choose others"
_CROP_SIDES = (32, 16, 8)  # pixels of a side of a crop: the largest that the oracle can take
_CROP_STEP = 16  # pixels between the places that are tried for a crop: gsplat's tiles stay where they are
_CROP_PAIRS = 1_000_000  # (pixel, Gaussian) pairs of a crop that take the oracle seconds: image and gradient, by CPU


@dataclasses.dataclass(frozen=True)
class Crop:
    """The place of a crop in its view: a corner, its size, and the view's (width, height), in pixels."""

    x: int
    y: int
    width: int
    height: int
    of: list[int]


@dataclasses.dataclass(frozen=True)
class Result:
    """What `crossval` returns.

    Attributes:
        report: All of the comparison, JSON-serializable.
        images: A dict a view: `rasterizer`, `model`, `exact` (H, W, 3) arrays.
        groups: Group -> its row, of each group whose gradient was compared.
        views: A row a view.
        findings: Conventions that differ from the preset's.
        model: The model at the rasterizer's conventions.
        gaussians: Gaussians that were compared (a part of a large scene where the oracle is the reference), in a world
            whose 0 is their origin.
        cameras: Views that were compared, as they were cropped, in that world.
        paths: A row a path of the rasterizer: tested or not, and what was found.
    """

    report: dict
    images: list[dict[str, np.ndarray]]
    groups: dict[str, GroupRow]
    views: list[ViewRow]
    findings: list[conventions.Finding]
    model: ReferenceModel
    gaussians: Gaussians
    cameras: list[Camera]
    paths: list[PathRow]

    @property
    def verdict(self) -> str:
        """The worst of the verdicts on groups and paths."""
        return self.report["verdict"]

    def not_tested(self) -> str:
        """One line on the paths that were not tested; empty if there is none."""
        names = [row.path for row in self.paths if row.status == "not tested"]
        return f"not tested: {', '.join(names)}" if names else ""

    def lines(self) -> list[str]:
        """The findings, one a line."""
        r = self.report
        lines = [f"{r['rasterizer']}: {r['verdict']} (model: preset {r['preset']})", *r["scope"]]
        for finding in self.findings:
            lines.append(f"convention: {finding.name} is {finding.found}, expected {finding.expected}")
        for view in self.views:
            if view.error is not None:
                lines.append(f"view {view.view}: {error_line(view.error, r['size'])}")
            if abs(bias := view.alpha.bias) > _ALPHA_TOLERANCE:
                what = "lower: hits are missing" if bias < 0 else "higher"
                lines.append(f"view {view.view}: alpha is {abs(bias):.1e} {what} on average")
        for name, group in self.groups.items():
            verdict = f"{group.verdict}: {group.why}" if group.why else group.verdict
            lines.append(f"{name}: {verdict}; relative difference {group.relative:.2g}, cosine {group.cosine:.6f}")
        lines += [row.line() for row in self.paths if row.status == "wrong"]
        return [*lines, self.not_tested()] if self.not_tested() else lines


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
    paths: bool = True,
    lenses: list[Camera] | None = None,
    advance: Callable[[str], None] | None = None,
) -> Result:
    """Compare a rasterizer with the model that it claims to compute.

    Args:
        rasterizer: The rasterizer, as `drgs.lab.rasterizers.load_rasterizer` returns it.
        g: Gaussians of the scene. A function is given means and poses relative to their origin.
        cameras: Cameras of one image size; lenses are of presets along rays.
        preset: Preset that it claims to be, or `auto`: the one whose image needs least to be explained.
        fields: Settings that replace the preset's, `background` among them.
        tolerance: Relative L2 difference of gradients that agree; default 5e-4, and 5e-3 in float32.
        entries: Number of parameters a group whose central differences are taken, where they are needed.
        seed: Seed of the cotangents.
        channels: Width of the plain colors whose gradient is compared, too; 0 for none.
        paths: Whether the other paths of a function are tested, too: depth, several cameras, packed arrays and so on.
        lenses: Cameras with a lens where `cameras` are pinholes: the first that has one is compared with preset
            `3dgut`, if the function's signature names `radial_coeffs`.
        advance: Function that is called with each stage's name.
    Raises:
        ValueError: If cameras differ in size, have a lens that the preset does not draw, or the rasterizer's function
            fails.
    Reference:
        The reference is `drgs.render` (float32, its errors in docs/numerics.md); for our own renderers it is the
        float64 oracle, on a crop of every view of a large scene (`crops`).
    """
    say = advance or (lambda _: None)
    if len(g) == 0:
        raise ValueError("crossval: the scene must have Gaussians, got 0")
    of_lenses = [camera.relative_to(g.origin) for camera in lenses or []]
    g, cameras = around_origin(g, cameras)
    starts = _starting_models(rasterizer, preset, fields or {}, cameras)
    first_start = next(iter(starts.values()))
    background = first_start.settings.background
    oracle = isinstance(rasterizer, Rasterizer) and rasterizer.preset is not None
    cameras = [c if c.name else dataclasses.replace(c, name=str(i)) for i, c in enumerate(cameras)]
    given = g, cameras
    places: list[Crop] | list[None] = [None] * len(cameras)
    if oracle and len(g) * sum(c.width * c.height for c in cameras) > _ORACLE_PAIRS:
        say("crops")
        g, cameras, places = crops(g, cameras, first_start.settings)
    dtype = getattr(rasterizer, "dtype", torch.float32)
    raw = with_pose(raw_of(g), any(c.is_rolling for c in cameras))
    say("images")
    pictures, alphas, signs = _images(rasterizer, raw, cameras, background, seed)
    say("conventions")
    first = int(np.argmax([float(x.var()) for x in pictures]))  # the view that shows most

    @functools.cache
    def rendered_by(model: ReferenceModel, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        return _rendered(model, raw, cameras[view], oracle)

    @functools.cache
    def ties_of(model: ReferenceModel, view: int) -> torch.Tensor:
        say("near ties")
        return model.near_ties(raw, cameras[view])

    search = conventions.find(
        pictures[first],
        list(starts.values()),
        lambda m: rendered_by(m, first)[0],
        lambda m: ties_of(m, first),
        _SETTLED[dtype],
        lambda m: m.suits(cameras[first], len(g)),
    )
    model = search.model
    claimed = next(name for name, start in starts.items() if start == search.start)
    drawn = [rendered_by(model, view) for view in range(len(cameras))]
    _check_shown(rasterizer, claimed, drawn, lambda view: rendered_by(search.start, view)[1])
    tolerance = tolerance or _TOLERANCE[dtype]
    ties = functools.partial(ties_of, model)
    case = Case(rasterizer, raw, cameras, background, oracle, tolerance, entries, first, seed, ties, say)
    comparison = compared(case, model, signs, pictures, alphas, drawn)
    not_offered = _explain(case, model, comparison, channels)
    if not comparison.agrees:
        say("what the error looks like")
        comparison.views = with_errors(comparison, pictures, _meant(search, claimed, starts), rendered_by)
    report = _report(case, comparison, search, claimed, given, places, not_offered)
    rows: list[PathRow] = []
    if paths:
        lens = _lens_row(rasterizer, g, of_lenses, fields or {}, seed)
        rows = path_rows(case, model, comparison, report["verdict"], not_offered.get(COLORS, ""), lens)
        verdicts = [row.verdict for row in rows if row.verdict]
        report["verdict"] = min((report["verdict"], *verdicts), key=VERDICTS.index)
    report["paths"] = [dataclasses.asdict(row) for row in rows]
    say("pictures")
    images = _beside(case, pictures, drawn)
    return Result(report, images, comparison.groups, comparison.views, search.findings, model, g, cameras, rows)


def _explain(case: Case, model: ReferenceModel, comparison: Compared, channels: int) -> dict[str, str]:
    """Give all groups their verdicts, those of wide colors, too; returns why there are none of the others, by group."""
    judge(case, model, comparison)
    missing = [name for name in MOTIONS if name in case.raw and name not in comparison.groups]
    not_offered = dict.fromkeys(missing, "its image has no gradient of them")
    if channels:
        wide, reason = _wide_gradients(case, model, comparison, channels)
        comparison.groups |= wide
        not_offered |= {COLORS: reason} if reason else {}
    return not_offered


def _starting_models(
    rasterizer: Rasterizer | Dump, preset: str, fields: dict, cameras: list[Camera]
) -> dict[str, ReferenceModel]:
    """Preset -> model: what the rasterizer may claim to be, of what can draw the cameras.

    Raises:
        ValueError: If cameras have a lens and every preset is a model of the image plane.
    """
    own = getattr(rasterizer, "preset", None)
    names = [preset] if preset != "auto" else [own] if own else list(_STARTS)
    starts = {name: ReferenceModel(RenderSettings.preset(name, **_legal(name, fields))) for name in names}
    if not any(c.is_distorted or c.is_rolling for c in cameras):
        return starts
    along_rays = {name: start for name, start in starts.items() if not start.settings.planar}
    if not along_rays:
        raise ValueError(
            f"crossval: cameras must be pinholes for preset {names[0]}, a model of their image plane, got a lens "
            "or a rolling shutter; use undistorted cameras, or a preset along rays (3dgut, exact, fast)"
        )
    return along_rays


def _meant(
    search: conventions.SearchResult, claimed: str, starts: dict[str, ReferenceModel]
) -> dict[str, ReferenceModel]:
    """Name in words -> model: the one that was found first, then what else may be meant."""
    found = {"the model at its conventions": search.model} if search.findings else {}
    presets = {claimed: search.start} | starts
    return found | {f"preset {name}": start for name, start in presets.items()}


def _lens_row(
    rasterizer: Rasterizer | Dump, g: Gaussians, cameras: list[Camera], fields: dict, seed: int
) -> PathRow | None:
    """What is said of a function on the first camera that has a lens, along rays; None if there is none."""
    seen = [camera for camera in cameras if camera.is_distorted]
    if not seen or not isinstance(rasterizer, Rasterizer):
        return None
    how = f"drgs crossval SCENE --cameras DATA --preset 3dgut --rasterizer {rasterizer.name}"
    if "radial_coeffs" not in rasterizer.named:
        why = "its signature does not name radial_coeffs, cameras were undistorted"
        return PathRow("lens", "not tested", why, how)
    try:
        legal = _legal("3dgut", fields)
        found = crossval(rasterizer, g, seen[:1], "3dgut", legal, seed=seed, channels=0, paths=False)
    except ValueError as error:
        return PathRow("lens", "not tested", f"refused: {one_line(error)}", how)
    if found.verdict == "undecided":
        return PathRow("lens", "not tested", "undecided", how)
    what = [f"{x.name} is {x.found}" for x in found.findings]
    what += [f"{name}: {x.verdict}: {x.why}" for name, x in found.groups.items() if x.verdict != "agreement"]
    return PathRow("lens", status_of(found.verdict), "; ".join(["with preset 3dgut", *what]), "", found.verdict)


def _images(
    rasterizer: Rasterizer | Dump, raw: dict, cameras: list[Camera], background: tuple, seed: int
) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
    """The rasterizer's images and alphas, one a view, and (C, H, W, 3) cotangents: random signs, or a dump's own.

    Raises:
        ValueError: If an image or an alpha has NaN or Inf.
    """
    if isinstance(rasterizer, Dump):
        pictures, alphas, signs = list(rasterizer.images), list(rasterizer.alphas), rasterizer.cotangents
    else:
        pairs = [rasterizer.image(raw, camera, background) for camera in cameras]
        pictures, alphas = ([pair[k] for pair in pairs] for k in range(2))
        signs = cotangents(cameras, seed)
    for camera, picture, alpha in zip(cameras, pictures, alphas, strict=True):
        for what, wrong in (("image", (~torch.isfinite(picture)).any(-1)), ("alpha", ~torch.isfinite(alpha))):
            if len(bad := wrong.nonzero()):
                y, x = bad[0].tolist()
                raise ValueError(
                    f"{rasterizer.name}: its {what} must be finite, view {camera.name} has NaN or Inf in {len(bad)} of "
                    f"{wrong.numel()} pixels, first at ({x}, {y}); correct the rasterizer"
                )
    return pictures, alphas, signs


def _check_shown(
    rasterizer: Rasterizer | Dump,
    claimed: str,
    drawn: list[tuple[torch.Tensor, torch.Tensor]],
    alpha_of_start: Callable[[int], torch.Tensor],
) -> None:
    """Raise ValueError if the model that was found shows no Gaussian in any view.

    Args:
        rasterizer: The rasterizer.
        claimed: Name of the preset that it claims to be.
        drawn: Image and alpha of the model, of each view.
        alpha_of_start: Function of a view's index: (H, W) alpha of that preset.
    """
    if any(bool(alpha.any()) for _, alpha in drawn):
        return
    if any(bool(alpha_of_start(view).any()) for view in range(len(drawn))):
        raise ValueError(
            f"{rasterizer.name}: its image must show Gaussians, shows the background alone where preset {claimed} "
            "shows some; correct the rasterizer"
        )
    raise ValueError(_EMPTY)


def _beside(
    case: Case, pictures: list[torch.Tensor], drawn: list[tuple[torch.Tensor, torch.Tensor]]
) -> list[dict[str, np.ndarray]]:
    """`Result.images`: those of the rasterizer, of the model, and of preset `exact`."""
    exact = ReferenceModel(RenderSettings.preset("exact", background=case.background))
    true = [_rendered(exact, case.raw, camera, False)[0] for camera in case.cameras]
    rows = zip(pictures, [image for image, _ in drawn], true, strict=True)
    return [dict(zip(("rasterizer", "model", "exact"), (x.numpy() for x in row), strict=True)) for row in rows]


def _report(
    case: Case,
    comparison: Compared,
    search: conventions.SearchResult,
    claimed: str,
    given: tuple[Gaussians, list[Camera]],
    places: list[Crop] | list[None],
    not_offered: dict[str, str],
) -> dict:
    """`Result.report`; `given` are the scene and the cameras before anything was cropped."""
    worst = min((row.verdict for row in comparison.groups.values()), key=VERDICTS.index)
    if not comparison.agrees:
        worst = min(worst, "model difference", key=VERDICTS.index)
    elif search.findings:
        worst = min(worst, "other convention", key=VERDICTS.index)
    report = {
        "rasterizer": case.rasterizer.name,
        "verdict": worst,
        "preset": claimed,
        "conventions": [dataclasses.asdict(finding) for finding in search.findings],
        "image": {
            "agrees": comparison.agrees,
            "before": search.before,
            "after": search.after,
            "views": [dataclasses.asdict(row) for row in comparison.views],
        },
        "groups": {name: row.json() for name, row in comparison.groups.items()},
        "not_offered": not_offered,
        "reference": "float64 oracle" if case.oracle else "drgs.render",
        "gaussians": len(case.raw["means"]),
        "of_gaussians": len(given[0]),
        "of_views": len(given[1]),
        "cameras": [camera.name for camera in case.cameras],
        "size": [case.cameras[0].width, case.cameras[0].height],
        "crops": [None if place is None else dataclasses.asdict(place) for place in places],
        "pixels": comparison.ties.numel(),
        "near_ties": int(comparison.ties.sum()),
        "near_ties_counted": comparison.counted,
        "background": list(case.background),
        "tolerance": case.tolerance,
        "seed": case.seed,
        "settings": dataclasses.asdict(search.model.settings),
    }
    report["scope"] = _scope(report)
    return report


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
            f"{r['near_ties']:,} of {r['pixels']:,} pixels hang on near ties that float32 cannot resolve: {what}"
        )
    lines += [f"not compared: the gradient of {name}: {why}" for name, why in r["not_offered"].items()]
    return lines


def _legal(name: str, fields: dict) -> dict:
    """The fields, for a preset that may not know all of them: with `auto` each preset takes what it can."""
    try:
        RenderSettings.preset(name, **fields)
    except NotImplementedError:
        return {k: v for k, v in fields.items() if k == "background"}
    return fields


def _rendered(model: ReferenceModel, raw: dict, camera: Camera, oracle: bool) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.no_grad():  # images alone are compared
        image, alpha = model.draw(raw, camera, oracle)
    return image.cpu(), alpha.cpu()


# ------------------------------------------------------------------------- crops of large scenes


def crops(g: Gaussians, cameras: list[Camera], settings: RenderSettings) -> tuple[Gaussians, list[Camera], list[Crop]]:
    """The most varied square of each view, and the Gaussians that any of them sees.

    Squares have 32 pixels a side, or 16 or 8 where the oracle would take long over what one of them sees.

    Args:
        g: Gaussians of the scene.
        cameras: Pinhole cameras of one image size.
        settings: Settings of the images that are compared.
    Returns:
        The Gaussians; a camera a view that shows anything; and where each crop lies.
    Raises:
        ValueError: If no view shows a Gaussian.
    """
    drawn = []
    for camera in cameras:
        image, visible = _rendered_by_drgs(g, camera, settings)
        if bool(visible.any()):
            drawn.append((camera, image))
    if not drawn:
        raise ValueError(_EMPTY)
    for side in _CROP_SIDES:
        parts = []
        places = []
        in_crops = []
        for camera, image in drawn:
            width, height = min(camera.width, side), min(camera.height, side)
            x, y = _most_varied(image, width, height)
            parts.append(cropped(camera, x, y, width, height))
            places.append(Crop(x, y, width, height, [camera.width, camera.height]))
            in_crops.append(_rendered_by_drgs(g, parts[-1], settings)[1])
        if max(int(x.sum()) for x in in_crops) * side**2 <= _CROP_PAIRS:
            break
    index = torch.nonzero(torch.stack(in_crops).any(0))[:, 0]
    # Leaves of their own: gradients are to end here, not at the parameters of the whole scene.
    fields = {name: getattr(g, name).detach()[index] for name in PARAMETERS}
    return Gaussians(**fields, origin=g.origin), parts, places


def _rendered_by_drgs(g: Gaussians, camera: Camera, settings: RenderSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 4) color and alpha, and (N,) bool, which Gaussians are visible."""
    with torch.no_grad():  # a crop's place has no derivative
        out = render(g, camera, settings, outputs=("visibility",))
    assert out.visibility is not None  # among the outputs
    return torch.cat([out.rgb, out.alpha[..., None]], -1).cpu(), out.visibility.cpu() > 0


def _most_varied(image: torch.Tensor, width: int, height: int) -> tuple[int, int]:
    """Corner (x, y) of the crop of an (H, W, 4) image whose colors and alpha vary most."""
    x = image.double().permute(2, 0, 1)[None]  # the difference of two squares cancels in float32 where little varies

    def mean(values: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(values, (height, width), stride=_CROP_STEP)

    variance = (mean(x * x) - mean(x) ** 2).sum(1)[0]
    row, column = divmod(int(variance.argmax()), variance.shape[1])
    return _CROP_STEP * column, _CROP_STEP * row


# ------------------------------------------------------------------------- images of many channels


def _wide_gradients(case: Case, model: ReferenceModel, rgb: Compared, channels: int) -> tuple[dict[str, GroupRow], str]:
    """Gradients of an image of D channels: the same Gaussians with plain colors (N, D) instead of SH.

    Rasterizers carry such channels along other paths than RGB (padding, chunks, a second pass), where gradients get
    lost. One view is compared, on black. Of the geometry only what the RGB image has right is compared again.

    Args:
        case: What was compared in RGB.
        model: The model at the conventions that were found.
        rgb: The comparison in RGB.
        channels: Number D of channels.
    Returns:
        The row `colors`, and `GROUP, D channels` for every other group whose gradient is wrong here and was right in
        RGB; or nothing, and the reason.
    """
    rasterizer, camera = case.rasterizer, case.cameras[case.first]
    if isinstance(rasterizer, Dump):
        return {}, "a dump has no image of them"
    if not rgb.agrees:
        return {}, "its image is of another model"
    if (model.channels, model.transfer) != ("rgb", "none") or tuple(model.settings.background) not in (
        tuple(case.background),
        (0.0, 0.0, 0.0),
    ):
        return {}, "what it does to colors is a convention of three channels"
    fixed = {name: x for name, x in case.raw.items() if name not in MOTIONS}
    raw = with_colors(fixed, channels, case.seed)
    black = (0.0,) * channels
    u = cotangents([camera], case.seed, channels)
    case.say(f"{channels} channels")
    try:
        picture, alpha = rasterizer.image(raw, camera, black)
        rasterizer.gradient(raw, camera, black, u[0])
    except Exception as error:  # whatever a function raises that knows three channels only
        return {}, f"it draws no image of {channels} channels: {one_line(error)}"
    wide = case.of_view(raw=raw, background=black)
    drawn = [_rendered(model, raw, camera, case.oracle)]
    wider = compared(wide, model, u, [picture], [alpha], drawn)
    right = [name for name, row in rgb.groups.items() if row.verdict == "agreement"]
    wider.groups = {name: row for name, row in wider.groups.items() if name == COLORS or name in right}
    judge(wide, model, wider)
    rows = {COLORS: wider.groups.pop(COLORS)}
    return rows | {f"{k}, {channels} channels": x for k, x in wider.groups.items() if x.verdict != "agreement"}, ""
