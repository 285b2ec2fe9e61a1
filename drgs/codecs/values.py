"""What several formats share: bytes of opacity, colors as SH, axes, and the Gaussians that come of decoded arrays.

A byte stands for all values that round to it. Where its own value has no finite logit or logarithm (an opacity of 0 or
255, a scale of 0), it becomes the middle of those: the largest error is least there, and writing it again gives the
same byte.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from drgs.cameras.origins import origin_near
from drgs.ellipsoids import LOGIT_ENDS, Y_00, Gaussians
from drgs.runtime.memory import require

SH_COUNTS = (1, 4, 9, 16)
"""Coefficients of a color up to degree 0, 1, 2 and 3."""
# Step of float32 at the middle of a scene, in its size: a tenth of a pixel of a picture 1,000 wide is lost from there.
_LOST = 1e-4
_log = logging.getLogger(__name__)
_END_VALUE = 0.25 / 255  # the middle of what rounds to an end: [0, 0.5 / 255] or [254.5 / 255, 1]
# Powers of x, y and z in each basis function, modulo 2: what turns its sign when an axis turns.
_ODD = np.array([
    (0, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0),
    (1, 1, 0), (0, 1, 1), (0, 0, 0), (1, 0, 1), (0, 0, 0),
    (0, 1, 0), (1, 1, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 0, 1), (1, 0, 0),
])  # fmt: skip


def check_count(path: Path, count: int, coefficients: int) -> None:
    """Raise ValueError if a file's Gaussians, of so many SH coefficients a color, do not fit into memory."""
    # Twice: an array as it is decoded, and what it becomes.
    require(str(path), 8 * count * (11 + 3 * coefficients), f"{count} Gaussians", "take a smaller file")


def assembled(
    path: Path, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray
) -> Gaussians:
    """Gaussians of decoded arrays, as float32.

    Args:
        path: The file, for messages.
        means, quats, log_scales, logits, sh: The fields of `Gaussians`, of any floating type.
    Raises:
        ValueError: If a value is not finite or a quaternion is 0 (the first index is named).
    """
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
        parts = (means, quats, log_scales, logits, sh)
        mu, q, s, o, c = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in parts)
    made = Gaussians(mu, q, s, o, c)
    made.validate(str(path))
    note_lost(path, made)
    return made


def logits_of_bytes(opacity: np.ndarray) -> np.ndarray:
    """Logits of opacities in 255ths; 0 is taken for 0.25 / 255 and 255 for 254.75 / 255, logits of -6.93 and 6.93."""
    table = np.arange(256) / 255.0
    table[[0, 255]] = _END_VALUE, 1.0 - _END_VALUE
    return (np.log(table) - np.log1p(-table))[opacity]


def logits_of_opacities(opacity: np.ndarray) -> np.ndarray:
    """Logits of float32 opacities; 0 and 1 become `LOGIT_ENDS`, others outside are NaN."""
    # float64: 1 - x of float32 has no digits left next to 1.
    x = opacity.astype(np.float64)
    # 0 and 1, whose logarithms are infinite, are replaced below; what is outside becomes NaN and is refused.
    with np.errstate(invalid="ignore", divide="ignore"):
        logits = np.log(x) - np.log1p(-x)
    return np.where(x == 0, LOGIT_ENDS[0], np.where(x == 1, LOGIT_ENDS[1], logits))


def log_of_scales(path: Path, scales: np.ndarray, least: float) -> np.ndarray:
    """Logarithms of linear standard deviations.

    Args:
        path: The file, for the message.
        scales: (N, 3), >= 0.
        least: What 0 is taken for.
    Raises:
        ValueError: If one is negative or not finite (the first index is named).
    """
    with np.errstate(invalid="ignore"):  # of half floats that are none
        scales = scales.astype(np.float64)
    bad = ~(np.isfinite(scales) & (scales >= 0)).all(1)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"{path}: scales must be finite and >= 0, got {scales[i].tolist()} at index {i} ({int(bad.sum())} of "
            f"{len(scales)}); export the file again"
        )
    return np.log(np.where(scales == 0, least, scales))


def dc_of_colors(colors: np.ndarray) -> np.ndarray:
    """(N, 1, 3) SH coefficients of degree 0 of (N, 3) colors in [0, 1]."""
    return ((colors - 0.5) / Y_00)[:, None, :]


def quats_of_smallest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions of their three smaller components.

    Args:
        largest: (N,) position of the component that is not stored, 0 to 3; it is >= 0.
        others: (N, 3) the rest, in their order.
    """
    n = len(largest)
    quats = np.empty((n, 4))
    stored = np.arange(4)[None, :] != largest[:, None]
    quats[stored] = others.reshape(-1)
    # Squares of three smaller components are 3/4 at most, but a file may claim more than 1.
    quats[np.arange(n), largest] = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(1)))
    return quats


def smallest_of_quats(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The arguments of `quats_of_smallest` of (N, 4) quaternions of any length but 0."""
    q = quats / np.abs(quats).max(axis=1, keepdims=True, initial=0.0)  # first, so that no square under- or overflows
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    largest = np.abs(q).argmax(1)
    q *= np.where(np.take_along_axis(q, largest[:, None], 1) < 0, -1, 1)
    return largest, q[np.arange(4)[None, :] != largest[:, None]].reshape(-1, 3)


def spread(g: Gaussians) -> tuple[np.ndarray, float]:
    """Middle (3,) of the means, and their median distance from it, of which floaters change nothing; N >= 1.

    Where Gaussians are in one place, the median of their largest standard deviations is taken for that.
    """
    means = g.means.detach().cpu().double().numpy()  # measured, not optimized
    middle = np.median(means, axis=0)
    width = float(np.median(g.log_scales.detach().double().amax(1).exp().cpu().numpy()))
    distance = float(np.median(np.linalg.norm(means - middle, axis=1)))
    return middle, max(distance, width, 1e-12 * float(np.abs(middle).max()))


def note_lost(path: Path, g: Gaussians) -> None:
    """Say in the log that float32 positions of a file stand so far from 0 that they have lost detail."""
    if not len(g):
        return
    middle, size = spread(g)
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    if step > _LOST * size:
        _log.warning(
            "%s: float32 positions around %s have steps of %.2g, which has cost detail of a scene %.2g wide; "
            "export it again relative to an offset, or as a PLY with double positions",
            path,
            " ".join(f"{x:g}" for x in middle),
            step,
            size,
        )


def recentered(g: Gaussians) -> Gaussians:
    """The same Gaussians with float32 means: float64 ones that stand far from 0 become relative to another origin."""
    means, origin = g.means, g.origin
    if means.dtype == torch.float64 and len(g) and bool(torch.isfinite(means).all()):
        shift = origin_near(*spread(g))
        means, origin = means - torch.from_numpy(shift).to(means.device), origin + shift
    return g.replace(means=means.float(), origin=origin)


def flipped(g: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    """Gaussians in axes of which some point the other way: means, origin, rotations and SH; no digit changes.

    Args:
        g: The Gaussians.
        signs: 1 or -1 for x, y and z, of product 1 (a half turn) or -1 (a mirror).
    """
    s = np.asarray(signs)
    flips = np.prod(np.where(_ODD[: g.sh.shape[1]] == 1, s, 1), axis=1)
    x, y, z = (int(v) for v in s)
    return g.replace(
        means=g.means * torch.tensor(signs, dtype=g.means.dtype),
        origin=g.origin * s + 0.0,  # no -0
        quats=g.quats * torch.tensor([1, y * z, x * z, x * y], dtype=g.quats.dtype),
        sh=g.sh * torch.from_numpy(flips).to(g.sh.dtype)[None, :, None],
    )
