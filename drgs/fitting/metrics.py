"""Image metrics: how well Gaussians show views that they were not fitted to.

Metrics that cannot be computed are None with a reason, never left out. `DEFINITIONS` says exactly what each number is.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.display.pictures import file_names, write_png
from drgs.display.progress import Bar
from drgs.ellipsoids import Scene, colors_only
from drgs.fitting.depths import depth_error
from drgs.fitting.losses import psnr
from drgs.integrator import Output, render
from drgs.io.archives import check_archive
from drgs.io.journal import SCHEMA
from drgs.io.outputs import write_json
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.fitting.frames import Frame
    from drgs.fitting.segments import Segmentation
    from drgs.io.run import Run

    AsPhotograph = Callable[[Output, Frame], Output]

__all__ = [
    "DEPTH",
    "METRICS",
    "MOVING",
    "OBJECT",
    "DEFINITIONS",
    "TRAIN_VIEWS",
    "VIEW_PICTURES",
    "Lpips",
    "cc_psnr",
    "color_corrected",
    "evaluate",
    "flip",
    "most_views",
    "psnr",
    "renderers_table",
    "ssim",
    "through_renderers",
    "uncovered",
    "write_metrics",
]

DEFINITIONS = {
    "psnr": "dB, peak 1, one MSE over pixels and channels, inside the mask where there is one (where an alpha "
    "channel says what is empty, of the whole frame), at most 100",
    "cc_psnr": "as psnr, after the rendering's colors were corrected to the photograph: each channel by a least-squares"
    " fit of the products of two channels, the channels and 1, made five times and clipped to [0, 1], once to the "
    "pixels that are not saturated (within 0.5/255 of 0 or 1) in either image (multinerf's color_correct), and once to "
    "all pixels inside the mask, so that a plain background counts; the best of the two and of no correction",
    "ssim": "11x11 Gaussian window, sigma 1.5, no padding; both images black outside the mask",
    "ssim_padded": "as the training loss: 11x11, sigma 1.5, zero padding (INRIA); black outside the mask",
    "flip": "mean LDR-FLIP, 67 pixels a degree (flip-evaluator), lower is better; black outside the mask",
    "lpips": "LPIPS 0.1, images scaled to [-1, 1], lower is better; black outside the mask",
    "uncovered": "share of the pixels with an opacity below 0.5, of those that masks or alpha say show something; "
    "lower is better",
}
METRICS = tuple(DEFINITIONS)
OBJECT = {
    "psnr_object": "as psnr, of the pixels that show the object, by masks or alpha; of views that show it",
    "psnr_frame": "as psnr, of the whole frame: the photograph is the background where masks or alpha say nothing is",
}
"""What is measured beside `METRICS` where masks or alpha say what is empty: that is easy to show, and may be most."""
MOVING = {"psnr_moving": "as psnr, of the pixels whose label is a class that moves; of views that show one"}
"""What is measured beside `METRICS` where labels say what moves: a background that stands still hides the rest."""
DEPTH = {
    "depth_error": "mean of |z - z_map| / z_map over the pixels where the view's depth map knows z_map, inside the "
    "mask; lower is better; of views that have a map"
}
"""What is measured beside `METRICS` where the data set has depth maps in scene units."""
TRAIN_VIEWS = 8
"""Views, at most, that the shortest fits measure, and training photographs of a fit that holds out none; chosen for its
seconds."""
_STEPS_A_VIEW = 16
"""Steps of a fit for each view that it draws in several renderers: together about a fifth of the time of its steps."""
VIEW_PICTURES = ("png", "semantics.png")
"""Of a view: that of its colors and, of a run with features, that of its labels; what follows the view's file name."""
_NO_LPIPS = "needs the package lpips: pip install 'drgs[lpips]', and the weights that docs/install.md names"
_NO_FLIP = "needs the package flip-evaluator, which Python 3.14 has no wheel of: pip install flip-evaluator compiles it"
_NO_WEIGHTS = "needs the weights of a backbone: pass --lpips-weights FILE (torchvision's AlexNet or VGG16)"
_COVERED = 0.5  # opacity from which on more of a pixel is Gaussians than background
_LPIPS_MIN_SIDE = 64  # pixels: the AlexNet backbone pools smaller images to nothing
_SSIM_MIN_SIDE = 11  # pixels of a side of its window, which is not padded
_COLOR_FITS = 5  # fits of the color correction, each to the pixels that the one before left unsaturated; chosen
_SATURATED = 0.5 / 255  # distance from 0 or 1 within which a value of 8 bits says nothing


def cc_psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """`psnr` of the color-corrected image in dB: what is left of the error once exposure, white balance and tone agree.

    It is never below `psnr`: a correction that makes a view worse is not applied.

    Args:
        image, target: (H, W, 3) in [0, 1].
        mask: (H, W) weights in [0, 1], or None.
    """
    return psnr(color_corrected(image, target, mask), target, mask)


def color_corrected(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """An image with the colors of another, as far as one quadratic function of the color brings them there.

    Two fits are made. That to the pixels which neither image has saturated is right for photographs whose highlights
    are clipped; but a plain white or black background is saturated, too, and a correction that was not fitted to it may
    recolor it. So another fit is made to all pixels that count, and what has the least squared error is returned, the
    image itself among them.

    Args:
        image, target: (H, W, 3) in [0, 1].
        mask: (H, W) weights in [0, 1] of the least squares, or None.
    Returns:
        (H, W, 3) float64 in [0, 1].
    Reference:
        Mildenhall et al., "NeRF in the Dark", CVPR 2022; `color_correct` of multinerf.
    """
    # A measure, not a loss; channels first, which is twice as fast.
    colors, wanted = (np.ascontiguousarray(x.detach().double().reshape(-1, 3).numpy().T) for x in (image, target))
    weights = np.ones(colors.shape[1]) if mask is None else mask.double().reshape(-1).numpy()
    candidates = [colors, *(_corrected(colors, wanted, weights, saturated) for saturated in (False, True))]
    errors = [float((np.square(x - wanted) * weights).sum()) for x in candidates]
    return torch.from_numpy(candidates[int(np.argmin(errors))].T.copy()).reshape(image.shape)


def _corrected(colors: np.ndarray, wanted: np.ndarray, weights: np.ndarray, saturated: bool) -> np.ndarray:
    """(3, P) colors after the fits of `color_corrected`.

    Args:
        colors, wanted: (3, P) of the rendering and of the photograph.
        weights: (P,) of the squared errors.
        saturated: Whether saturated values are fitted, too.
    """
    usable = np.broadcast_to(weights > 0, colors.shape)
    is_fitted = usable if saturated else usable & _unsaturated(colors) & _unsaturated(wanted)
    terms = np.ones((10, colors.shape[1]))
    for _ in range(_COLOR_FITS):
        for row, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
            np.multiply(colors[i], colors[j], out=terms[row])
        terms[6:9] = colors
        chosen = is_fitted if saturated else is_fitted & _unsaturated(colors)
        # Channels with the same rows share their matrix.
        groups = [slice(0, 3)] if (chosen == chosen[0]).all() else [slice(c, c + 1) for c in range(3)]
        corrected = colors.copy()
        for channels in groups:
            rows = chosen[channels.start]
            if rows.any():
                # The normal equations, ten of them, take an eighth of the time of a decomposition of all rows. Their
                # solution of least norm is that of the rows, where there are fewer colors than terms.
                weighted = terms * (rows * weights)
                fitted = np.linalg.lstsq(weighted @ terms.T, weighted @ wanted[channels].T)[0]
                corrected[channels] = fitted.T @ terms
        colors = corrected.clip(0, 1)
    return colors


def _unsaturated(colors: np.ndarray) -> np.ndarray:
    """Which values are far enough from 0 and 1 to tell what was there."""
    return (colors >= _SATURATED) & (colors <= 1 - _SATURATED)


def ssim(image: torch.Tensor, target: torch.Tensor) -> float:
    """Structural similarity of (H, W, 3) images in [0, 1], at least 11x11 pixels, see `DEFINITIONS`."""
    return float(_ssim_map(image, target)[5:-5, 5:-5].mean())


def uncovered(alpha: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Share of the pixels that Gaussians cover less than half, see `DEFINITIONS`.

    Args:
        alpha: (H, W) opacities.
        mask: (H, W) weights in [0, 1], not all of them 0, or None.
    """
    bare = (alpha < _COVERED).double()
    return float(bare.mean() if mask is None else (bare * mask).sum() / mask.double().sum())


def flip(image: torch.Tensor, target: torch.Tensor) -> float:
    """Mean FLIP error of (H, W, 3) images in [0, 1] sRGB."""
    import flip_evaluator

    pair = (np.ascontiguousarray(x.numpy(), np.float32) for x in (target, image))
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", inputsRGB=True, applyMagma=False)
    return float(mean)


class Lpips:
    """LPIPS with the backbone in a file; only the heads ship with the `lpips` package.

    Args:
        weights: State dictionary of torchvision's AlexNet or VGG16, read with `weights_only`.
    Raises:
        FileNotFoundError: If the file, or the `lpips` package, is missing.
        ValueError: If it holds neither.
    """

    def __init__(self, weights: Path):
        weights = Path(weights)
        if not weights.is_file():
            raise FileNotFoundError(
                f"{weights}: must be weights of AlexNet or VGG16, found none; check --lpips-weights"
            )
        try:
            import lpips
        except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision built for another torch
            text = " ".join(str(error).split())
            raise FileNotFoundError(
                f"eval: LPIPS must have the packages lpips and torchvision, importing them failed ({text}); "
                "pip install 'drgs[lpips]', in versions that belong to this torch"
            ) from None
        state = _read_weights(weights)
        first = state.get("features.0.weight")
        shape = tuple(first.shape) if isinstance(first, torch.Tensor) else None
        backbones: dict[Any, str] = {(64, 3, 11, 11): "alex", (64, 3, 3, 3): "vgg"}
        self.backbone = backbones.get(shape)
        if self.backbone is None:
            raise ValueError(
                f"{weights}: must be the state dictionary of torchvision's AlexNet or VGG16, got features.0.weight of "
                f"shape {shape}; download alexnet-owt-7be5be79.pth or vgg16-397923af.pth"
            )
        # pnet_rand: build the backbone without downloading it.
        self._model = lpips.LPIPS(net=self.backbone, pnet_rand=True, verbose=False).eval()
        try:
            with torch.no_grad():  # leaves are overwritten
                # The slices keep torchvision's numbering: slice2.3.weight is features.3.weight.
                for name, parameter in self._model.net.named_parameters():
                    parameter.copy_(state["features." + name.split(".", 1)[1]])
        except (KeyError, RuntimeError) as error:
            text = " ".join(str(error).split())
            raise ValueError(f"{weights}: must hold every convolution of {self.backbone}, got {text}") from None

    @torch.no_grad()  # a measure, not a loss
    def __call__(self, image: torch.Tensor, target: torch.Tensor) -> float:
        """LPIPS of (H, W, 3) images in [0, 1]."""
        planes = (2 * x.permute(2, 0, 1)[None].float() - 1 for x in (image, target))
        return float(self._model(*planes))


def _read_weights(path: Path) -> dict:
    """The state dictionary in a file, which must not run code; empty if it holds something else."""
    with path.open("rb") as file:
        is_zip = file.read(2) == b"PK"  # torchvision's VGG16 is of the format before it
    if is_zip:
        check_archive(path)
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch's readers raise whatever the damage leads to
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise ValueError(f"{path}: must be readable weights, got {text}; download the file again") from None
    return state if isinstance(state, dict) else {}


def evaluate(
    g: Scene,
    frames: list[Frame],
    settings: RenderSettings,
    *,
    lpips: Lpips | None = None,
    pictures: Path | None = None,
    segmentation: Segmentation | str | None = None,
    moving: frozenset[int] = frozenset(),
    as_photograph: AsPhotograph | None = None,
) -> dict:
    """All metrics of the given views.

    Args:
        g: What is shown, as it is at the time of each view.
        frames: Photographs to compare with; may be empty.
        settings: Settings of `drgs.render`. Pixels outside a mask are black in both images.
        lpips: None reports LPIPS as None with a reason.
        pictures: Folder for one PNG a view: photograph, render, and error times 4, side by side; and, with a
            segmentation, NAME.semantics.png: labels, reference, features, and labels over the photograph.
        segmentation: Result of `drgs.fitting.segments.segmentation_of`; in words: why there is none.
        moving: Numbers of the classes that move; if there are any, views have `psnr_moving`, too.
        as_photograph: Changes a rendering as the camera would have (`drgs.fitting.components.exposure.Meter`).
    Returns:
        JSON-serializable: `views` (a list of name, size and metrics), `mean` and `median` over them, `variants`,
        `reasons` of what is None; of a run with features `segmentation` (`Segmentation.result`), whose views have
        `pixel_accuracy` and `miou`, too; and `scores`, every single number that there is: the means and, of a run with
        features, the scores of its labels.
    """
    measured = None if isinstance(segmentation, str) else segmentation
    views = []
    reasons = {}
    if lpips is None:
        reasons["lpips"] = _NO_WEIGHTS if importlib.util.find_spec("lpips") else _NO_LPIPS
    is_cut_out = any(frame.empty() is not None for frame in frames)
    has_depth = any(frame.depth is not None for frame in frames)
    with Bar("measuring views", len(frames)) as bar:
        for frame, file_name in zip(frames, file_names([frame.name for frame in frames]), strict=True):
            with torch.no_grad():  # pictures of whatever an optimizer may hold
                out = render(g if measured else colors_only(g, frame.camera.time), frame.camera, settings)
                out = out if as_photograph is None else as_photograph(out, frame)
            row, missing = _view_metrics(out, frame, settings.background if is_cut_out else None, lpips, moving)
            reasons |= missing
            if has_depth:
                row["depth_error"] = depth_error(out, frame, settings)
            if measured and out.features is not None:
                row |= measured.add(frame, out.features)
                if pictures is not None:
                    measured.write(pictures / f"{file_name}.semantics.png", frame, out.features)
            views.append(row)
            if pictures is not None:
                shown, target = _inside_mask(out, frame), frame.target()
                error = (4 * (shown - target).abs()).clamp(0, 1)
                write_png(pictures / f"{file_name}.png", torch.cat([target, shown, error], dim=1).numpy())
            bar.advance()
    variants = DEFINITIONS | (OBJECT if is_cut_out else {}) | (MOVING if moving else {}) | (DEPTH if has_depth else {})
    mean, median = _averages(views, variants)
    if not views:
        reasons |= dict.fromkeys(DEFINITIONS, "no view is held out")
    if moving and mean["psnr_moving"] is None:
        reasons["psnr_moving"] = "no view shows anything with the label of a class that moves"
    if lpips is not None:
        variants["lpips"] += f", {lpips.backbone} backbone"
    if as_photograph is not None:
        variants["psnr"] += "; renderings have the exposure that the camera would have chosen for them"
    result: dict[str, Any] = {"views": views, "mean": mean, "median": median, "variants": variants, "reasons": reasons}
    result["scores"] = dict(mean)
    if isinstance(segmentation, str):
        result["segmentation"] = None
        reasons["segmentation"] = segmentation
    elif segmentation is not None:
        labels = result["segmentation"] = segmentation.result()
        numbers = [name for name in labels["variants"] if name != "iou"]  # a list
        result["scores"] |= {name: labels["run"] and labels["run"][name] for name in numbers}
    return result


def _averages(
    views: list[dict[str, Any]], names: Iterable[str]
) -> tuple[dict[str, float | None], dict[str, float | None]]:
    """Mean and median of each metric over the views; None where it has none."""
    mean: dict[str, float | None] = {}
    median: dict[str, float | None] = {}
    for name in names:
        values = [row[name] for row in views if row[name] is not None]
        # Not every view shows the object or what moves; else a number that one view lacks has no average.
        there = values and (name in OBJECT | MOVING | DEPTH or len(values) == len(views))
        mean[name], median[name] = (sum(values) / len(values), float(np.median(values))) if there else (None, None)
    return mean, median


def _view_metrics(
    out: Output,
    frame: Frame,
    background: tuple[float, float, float] | None,
    lpips: Lpips | None,
    moving: frozenset[int],
) -> tuple[dict[str, Any], dict[str, str]]:
    """Name, size and metrics of one view, and the reasons of what is None.

    Args:
        out: The rendering.
        frame: The photograph.
        background: As `_photometric`.
        lpips, moving: As `evaluate`.
    """
    target = frame.target()
    image, shown = out.rgb.cpu().clamp(0, 1), _inside_mask(out, frame)
    height, width = target.shape[:2]
    reasons = {}
    row: dict[str, Any] = {"name": frame.name, "width": width, "height": height, **dict.fromkeys(METRICS)}
    row |= _photometric(image, frame, background)
    if moving:
        row["psnr_moving"] = _moving_psnr(image, frame, moving)
    weights = frame.object_weights()
    counted = frame.mask if weights is None or not bool((weights > 0).any()) else weights
    row["uncovered"] = uncovered(out.alpha.cpu(), counted)
    row["ssim_padded"] = float(_ssim_map(shown, target).mean())
    if importlib.util.find_spec("flip_evaluator"):
        row["flip"] = flip(shown, target)
    else:
        reasons["flip"] = _NO_FLIP
    if min(height, width) >= _SSIM_MIN_SIDE:
        row["ssim"] = ssim(shown, target)
    else:
        reasons["ssim"] = f"view {frame.name} is smaller than the 11x11 window"
    if lpips is not None and min(height, width) >= _LPIPS_MIN_SIDE:
        row["lpips"] = lpips(shown, target)
    elif lpips is not None:
        reasons["lpips"] = f"view {frame.name} is smaller than {_LPIPS_MIN_SIDE} pixels"
    return row, reasons


def _inside_mask(out: Output, frame: Frame) -> torch.Tensor:
    """(H, W, 3) colors of a rendering in [0, 1], black outside the photograph's mask."""
    image = out.rgb.cpu().clamp(0, 1)
    return image if frame.mask is None else image * frame.mask[..., None]


def _moving_psnr(image: torch.Tensor, frame: Frame, moving: frozenset[int]) -> float | None:
    """PSNR of the pixels whose label is among `moving`, inside the mask; None where there is none."""
    if frame.labels is None:
        return None
    chosen = torch.from_numpy(np.isin(frame.labels(), sorted(moving))).float()
    chosen = chosen if frame.mask is None else chosen * frame.mask
    return psnr(image, frame.image(), chosen) if bool((chosen > 0).any()) else None


def most_views(steps: int) -> int:
    """How many held-out views a fit of so many steps draws in several renderers; `drgs eval` draws all."""
    return max(TRAIN_VIEWS, steps // _STEPS_A_VIEW)


def through_renderers(
    g: Scene,
    frames: list[Frame],
    renderers: Mapping[str, RenderSettings],
    split: str,
    limit: int | None = None,
    as_photograph: AsPhotograph | None = None,
) -> dict | None:
    """How Gaussians look in several renderers, view by view, so that no mean hides one that fails.

    `exact` has the tolerance of pictures, 1/512: PSNR changes by less than 3e-4 dB, in half of the time.

    Rasterizers widen every Gaussian by 0.3 px^2 on the screen, so what differs depends on the image size: it is most
    where Gaussians are smaller than a pixel.

    Args:
        g: What is shown; what moves is drawn as it is at the time of each view, which a PLY cannot hold.
        frames: Photographs to compare with, at the size of the fit.
        renderers: Name -> settings, as `drgs.fitting.renderers.renderers_to_measure` says.
        split: Split of the frames, to be recorded.
        limit: Largest number of views, which are evenly spaced; None takes all.
        as_photograph: As of `evaluate`.
    Returns:
        JSON-serializable: `split`, `width` and `height` of the first view, `of` how many views these were taken, and
        `rows`, for each renderer its `name`, `mean` of each metric over the views, `worst` (the view of the lowest
        PSNR, of the object where masks or alpha say where it is) and `views`; None without frames.
    """
    if not frames:
        return None
    count = len(frames)
    if limit is not None:
        frames = frames[:: -(-count // limit)]
    rows = []
    is_cut_out = any(frame.empty() is not None for frame in frames)
    with Bar("views as each renderer draws them", len(renderers) * len(frames)) as bar:
        for name, settings in renderers.items():
            views: list[dict[str, Any]] = []
            for frame in frames:
                with torch.no_grad():  # pictures of whatever an optimizer may hold
                    seen = colors_only(g, frame.camera.time)
                    out = render(seen, frame.camera, settings.for_pictures(), outputs=())
                    out = out if as_photograph is None else as_photograph(out, frame)
                image = out.rgb.cpu().clamp(0, 1)
                background = settings.background if is_cut_out else None
                views.append({"name": frame.name, **_photometric(image, frame, background)})
                bar.advance()
            shown = {key: [row[key] for row in views if row[key] is not None] for key in views[0] if key != "name"}
            mean = {key: float(np.mean(values)) for key, values in shown.items() if values}
            by = "psnr_object" if "psnr_object" in mean else "psnr"
            worst = min((row for row in views if row[by] is not None), key=lambda row: row[by])
            rows.append({"name": name, "mean": mean, "worst": worst, "views": views})
    camera = frames[0].camera
    return {"split": split, "width": camera.width, "height": camera.height, "of": count, "rows": rows}


def _photometric(
    image: torch.Tensor, frame: Frame, background: tuple[float, float, float] | None
) -> dict[str, float | None]:
    """What every rendered view is measured by, whatever renderer drew it: those of `DEFINITIONS` that need colors
    alone and take no time.

    Args:
        image: (H, W, 3) in [0, 1].
        frame: The photograph of the view.
        background: RGB behind an object that masks or alpha cut out, for those of `OBJECT`, too; None without.
    """
    target = frame.image()
    row: dict[str, float | None] = {
        "psnr": psnr(image, target, frame.mask),
        "cc_psnr": cc_psnr(image, target, frame.mask),
    }
    if background is None:
        return row
    weights = frame.object_weights()
    counted = frame.mask if weights is None else weights  # no alpha channel: the object fills the frame
    row["psnr_object"] = psnr(image, target, counted) if counted is None or bool((counted > 0).any()) else None
    if frame.is_object and frame.mask is not None:
        mask = frame.mask[..., None]
        row["psnr_frame"] = psnr(image, target * mask + (1 - mask) * torch.tensor(background))
    else:
        row["psnr_frame"] = row["psnr"]
    return row


def renderers_table(metrics: Mapping[str, Any]) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """Title, head and rows of what `through_renderers` found; no rows where nothing was.

    Args:
        metrics: Content of metrics.json; older versions measured one renderer more than the run's own, as `viewers`.
    """
    keys = {"psnr": "PSNR", "cc_psnr": "color-corrected"}
    worst, by = "worst\nPSNR", "psnr"
    rows: list[tuple[str, ...]] = []
    if (measured := metrics.get("renderers")) and measured["rows"]:
        count = len(measured["rows"][0]["views"])
        # Older versions measured a part of the test views without saying so.
        total = measured.get("of", metrics.get("count") if measured["split"] == metrics.get("split") else None) or count
        if "psnr_object" in measured["rows"][0]["mean"]:
            keys = {"psnr_object": "PSNR of\nthe object", "psnr_frame": "PSNR of\nthe frame"} | keys
            del keys["psnr"]  # one of these two, by what says where the object is
            worst, by = "worst PSNR of\nthe object", "psnr_object"
        for row in measured["rows"]:
            means = (_decibels(row["mean"].get(key)) for key in keys)
            # The worst of some views may be far better than the worst of all.
            last = (_decibels(row["worst"].get(by)), row["worst"]["name"]) if count == total else ()
            rows.append((row["name"], *means, *last))
        head = ("renderer", *keys.values(), *((worst, "worst view") if count == total else ()))
        several = f"{count}" if count == total else f"{count} of {total}"
    elif measured := metrics.get("viewers"):
        values = {"the run's own": measured["own_psnr"], measured["preset"]: measured["psnr"]}
        rows = [(name, f"{value:.2f}") for name, value in values.items()]
        head = ("renderer", "PSNR")
        several = f"{len(measured['views'])}"
    else:
        return "", (), rows
    shown = f"{several} {measured['split']} views of {measured['width']}x{measured['height']}"
    return f"The same Gaussians in several renderers, {shown}", head, rows


def _decibels(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float | int) else "-"


def write_metrics(run: Run, split: str, frames: list[Frame], result: dict, **fields: Any) -> dict:
    """Write `metrics.json` of a run from the result of `evaluate`; returns what was written."""
    written = {"schema": SCHEMA, "split": split, "count": len(frames), **fields, **result}
    write_json(run.path / "metrics.json", written)
    return written


def _ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    from drgs.fitting.losses import ssim_map

    return ssim_map(image.double(), target.double())
