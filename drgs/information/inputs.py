"""Checks of the weights of pixels in Fisher information: masks of views and weights of channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.checks.arguments import ArgumentError, kind_of, must_be

Masks = Sequence[torch.Tensor | None] | None
"""Masks of several cameras: (H, W) in [0, 1] each, by which an image is multiplied before it is compared, or None."""


def mask_list(where: str, masks: Any, cameras: Sequence[Camera]) -> list[torch.Tensor | None]:
    """A mask or None for each camera; `ArgumentError` for another number of them, another size, or values."""
    if masks is None:
        return [None] * len(cameras)
    if not isinstance(masks, list | tuple) or len(masks) != len(cameras):
        got = f"{len(masks)}" if isinstance(masks, list | tuple) else kind_of(masks)
        raise ArgumentError(
            f"{where}: masks must be a list with one for each of {len(cameras)} cameras, got {got}; use None for a "
            "camera without a mask"
        )
    for index, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        if mask is None:
            continue
        must_be(where, f"masks[{index}]", mask, torch.Tensor, "(H, W) in [0, 1], or None")
        size = (camera.height, camera.width)
        if tuple(mask.shape) != size or not bool(((mask >= 0) & (mask <= 1)).all()):
            values = f" within {float(mask.min()):g} and {float(mask.max()):g}" if mask.numel() else ""
            raise ArgumentError(
                f"{where}: masks[{index}] must have its camera's shape {size} and values in [0, 1], got "
                f"{tuple(mask.shape)}{values}; resize or rescale it"
            )
    return list(masks)


def three_weights(where: str, channel_weights: Any) -> list[float]:
    """Those of R, G and B, finite and >= 0."""
    try:
        weights = [float(x) for x in channel_weights]
    except (TypeError, ValueError):
        weights = []
    if len(weights) != 3 or not all(math.isfinite(x) and x >= 0 for x in weights):
        raise ValueError(
            f"{where}: channel_weights must be 3 finite numbers >= 0, got {channel_weights}; e.g. (1, 1, 1)"
        )
    return weights
