"""The first Gaussians of a fit: at points of the data set or of its training views, or those of another fit."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.data import Dataset, View, scene_extent
from drgs.display.progress import Bar
from drgs.fitting.components.base import Setup
from drgs.fitting.components.table import components_of
from drgs.fitting.near_planes import warn_of_near_planes
from drgs.fitting.records import check_checkpoint
from drgs.fitting.renderers import renderers_to_measure
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.io.checkpoint import load_state
from drgs.sfm.guided import Matches
from drgs.sfm.points import at_first, initial_points

if TYPE_CHECKING:
    from pathlib import Path

    from drgs.fitting.config import FitConfig
    from drgs.fitting.frames import Frame

_log = logging.getLogger("drgs.train")


def start(setup: Setup, begin: Path | None = None) -> tuple[Trainer, str]:
    """Make a trainer at step 0; and the source of its Gaussians, in words.

    Args:
        setup: The fit's setup with its photographs; its points are set here.
        begin: Checkpoint whose Gaussians it begins with; None: with points.
    """
    config, dataset = setup.config, setup.dataset
    if begin is None:
        rows, source = _rows_at_points(setup)
        _warn_of_masks(setup)
    else:
        with Bar("Gaussians of the earlier fit") as bar:
            rows, source = begin_with(begin, setup.frames, dataset.points, dataset.colors, config)
            bar.note(f"begins with {source}")
        setup.points = rows.places()[rows.far :].numpy()
    cameras = [frame.camera for frame in setup.frames]
    extent = scene_extent(cameras, setup.points)
    warn_of_near_planes(renderers_to_measure(config.renderers, config.settings), cameras, setup.points)
    return Trainer(config, setup.frames, rows, extent, list(setup.components), setup), source


def start_plain(dataset: Dataset, views: list[View], frames: list[Frame], config: FitConfig) -> Trainer:
    """A trainer at step 0 of a static fit without a teacher, to measure its speed.

    Args:
        dataset, views, frames: The data set, its training views, and their photographs.
        config: Configuration of the fit.
    """
    return start(Setup(dataset, config, views, [], views, (), components_of(), frames=frames))[0]


def _rows_at_points(setup: Setup) -> tuple[GaussianRows, str]:
    """The first Gaussians, and where their points come from: by default, of an active fit, from its first views."""
    config, dataset, is_active = setup.config, setup.dataset, setup.is_active
    # Points that a data set brings along may have seen all its views; ours are made from the training views alone.
    given = config.data.init_points in (("all",) if is_active else ("auto", "all")) and dataset.points is not None
    seen = setup.views
    for component in setup.components:
        seen = component.initial_views(seen)
    matches = Matches()
    with Bar("initial points") as bar:
        points, colors, source = initial_points(
            dataset if given else seen,
            config.seed,
            config.density.max_gaussians - setup.reserved,
            bar.stage,
            matches,
            None if is_active else seen,
        )
        bar.note(f"{len(points)} initial points: {source}")
    # Who goes on with matches takes their pictures for the first of all views, which those of one time need not be.
    is_of_all = not given and len(at_first(seen)) == len(setup.views)
    setup.points, setup.matches = points, matches if is_of_all else None
    dense = not given and any(view.depth_path is not None for view in seen)
    kind = config.density.start_of(dense)
    made = GaussianRows.from_points(torch.from_numpy(points), torch.from_numpy(colors), *kind, dataset.origin)
    return made, source


def _warn_of_masks(setup: Setup) -> None:
    """Log how much masks and alpha channels leave out, where that may be unintended."""
    config, frames = setup.config, setup.frames
    partial = {view.name for view in setup.dataset.views if not view.empty_outside}
    masked = sum(frame.name in partial and (frame.mask is not None or frame.alpha is not None) for frame in frames)
    if masked and config.data.mask in ("auto", "object"):
        is_object = config.data.mask == "object"
        _log.warning(
            "%d of %d training photographs have a mask or an alpha channel, and the others show what is outside: %s",
            masked,
            len(frames),
            "--mask object says nevertheless that nothing is there; leave it out, or mask all of them"
            if is_object
            else "it is taken as unknown (--mask valid); mask all of them, or say --mask ignore to use all pixels",
        )
    if empty := [x for x in (frame.empty() for frame in frames) if x is not None]:
        share = float(sum(x.sum() for x in empty)) / sum(frame.pixels[..., 0].numel() for frame in frames)
        color = " ".join(f"{x:g}" for x in config.settings.background)
        transparent = any(frame.alpha is not None for frame in frames)
        _log.info(
            "%.0f %% of the training pixels show nothing, by masks or alpha: %s is behind them%s%s",
            100 * share,
            color,
            " (--background; readers of D-NeRF's and Blender's data sets take 1 1 1)"
            if transparent and not any(config.settings.background)
            else "",
            "; until the end PSNR counts them, too" if transparent else "",
        )


def begin_with(
    checkpoint: Path,
    frames: list[Frame],
    points: np.ndarray | None,
    colors: np.ndarray | None,
    config: FitConfig,
) -> tuple[GaussianRows, str]:
    """The Gaussians of a checkpoint, and as many of the points that new photographs show as there is room for.

    Points where Gaussians are, too, are not left out: what was fitted to few photographs may be in the wrong place, and
    nothing else would bring it to the right one. On `banana`, six photographs that joined eight, 200 steps: 27.9 dB
    with the points, 27.3 dB with copies of Gaussians instead.

    Args:
        checkpoint: File of a static fit.
        frames: Training photographs, of which the checkpoint names those that are not new.
        points, colors: (P, 3) of the data set, in the same world; None where it has none.
        config: Configuration of the new fit.
    Returns:
        The Gaussians, without moments of an optimizer, and where they come from, in words.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or of a fit with features or to what moves.
    """
    tensors, header = load_state(checkpoint)
    check_checkpoint(checkpoint, tensors, header)
    old = GaussianRows.from_state(tensors, header)
    names = {"means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"}
    if other := sorted({*old.tensors} - names):
        raise ValueError(
            f"{checkpoint}: a fit must go on from Gaussians with colors alone, these have {other[0]}; fit anew"
        )
    rows = GaussianRows(old.tensors, old.origin)
    rows.far = old.far
    before = len(rows)
    new = [frame for frame in frames if frame.name not in header["views"]]
    room = config.density.max_gaussians - before
    if points is not None and colors is not None and new and room > 0:
        shown = _shown_points(new, points)
        shown = np.sort(np.random.default_rng(config.seed).permutation(shown)[:room])
        if len(shown):
            chosen = torch.from_numpy(points[shown]), torch.from_numpy(colors[shown])
            made = GaussianRows.from_points(*chosen, *config.density.start_of(False), rows.origin)
            more = made.take(torch.arange(len(shown)))
            del more["sh_rest"]  # 0 up to the degree that the others have
            rows.append(more)
    source = f"{before} Gaussians of an earlier fit, and {len(rows) - before} points that new photographs show"
    _log.info("%s", source)
    return rows, source


def _shown_points(frames: list[Frame], points: np.ndarray) -> np.ndarray:
    """Indices of points that lie in at least one of the photographs."""
    is_shown = np.zeros(len(points), bool)
    for frame in frames:
        pixels, depth = frame.camera.project(points)
        is_shown |= frame.camera.contains(pixels, depth)
    return np.flatnonzero(is_shown)
