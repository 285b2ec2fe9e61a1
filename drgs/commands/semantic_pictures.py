"""Pictures of the semantics of one rendered view: features, labels, and labels over the colors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from drgs.commands.scene_input import SceneInput
from drgs.integrator import Output

PICTURE_KINDS = ("features", "labels", "overlay")
OPAQUE = 0.5
"""Opacity from which on a pixel has a label: more of it is Gaussians than background."""

PictureFunction = Callable[["Output"], np.ndarray]
"""Output of `drgs.render`, features included -> (H, W, 3) uint8."""


def picture_functions(kinds: Iterable[str], given: SceneInput, scene: Path) -> dict[str, PictureFunction]:
    """The function that makes each kind of picture.

    Args:
        kinds: Names in `PICTURE_KINDS`.
        given: The Gaussians, with the decoder and the classes of their run.
        scene: The file or run that they are from, for messages.
    Raises:
        ValueError: If they have no features, or there is no decoder or no class to call them by.
    """
    kinds = tuple(kinds)
    if not kinds:
        return {}
    features = given.gaussians.features
    decoder = given.decoder
    classes = given.classes
    if features is None:
        raise ValueError(
            f"{scene}: --{kinds[0]} must have Gaussians with semantic features, these have none; fit a data set with a "
            "teacher's maps, or leave the option out"
        )
    from drgs.features.pictures import label_picture, overlay
    from drgs.features.segmentation import classify
    from drgs.fitting.segments import feature_colors

    functions: dict[str, PictureFunction] = {}
    if "features" in kinds:
        colors = feature_colors(given.gaussians, decoder)
        functions["features"] = lambda out: colors.picture(_features(out), decoder)
    if {"labels", "overlay"} & {*kinds}:
        if classes is None or classes.embeddings is None or (given.run is not None and decoder is None):
            raise ValueError(
                f"{scene}: --{next(kind for kind in kinds if kind != 'features')} must have a run with a decoder and "
                "text embeddings of classes, has not; fit a data set that has text_embeddings.npy"
            )
        known = classes
        count = len(classes)

        def labels(out: Output) -> np.ndarray:
            """(H, W) labels; 0 where the opacity is low and the decoder's bias alone would decide."""
            return np.where(out.alpha.cpu() < OPAQUE, 0, classify(_features(out), known, decoder))

        functions["labels"] = lambda out: label_picture(labels(out), count)
        functions["overlay"] = lambda out: overlay(out.rgb.cpu().clamp(0, 1).numpy(), labels(out), count)
    return {kind: functions[kind] for kind in kinds}


def _features(out: Output) -> torch.Tensor:
    assert out.features is not None  # the Gaussians have some
    return out.features
