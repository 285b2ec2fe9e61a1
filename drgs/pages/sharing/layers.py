"""Layers of a page, a value for each Gaussian: its class, its expected error, its place at other times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.display.pictures import inferno
from drgs.display.progress import Bar
from drgs.gain import variances
from drgs.information.blocks import MAP_PRIOR, SceneBlocks
from drgs.information.scoring import Scoring
from drgs.information.sums import add, together

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.deform import DynamicGaussians
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.information.expected_error import ErrorRecord
    from drgs.information.nuisances import Nuisances
    from drgs.settings import RenderSettings

_NUM_COLORS = 256  # entries of the table of colors: a Gaussian's is one byte
_MOST_DECADES = 3.0  # range of a scale, at most, as in the report's maps; chosen
_LEAST = 1e-12  # stands for 0 on a logarithmic scale, far below all that is measured
_STILL_CHANGE = 1e-3  # least change that is stored, of the scene's extent, a quaternion or a log scale; chosen


def classes_layer(
    features: torch.Tensor, classes: Classes, decoder: Decoder | None
) -> tuple[dict[str, Any], np.ndarray]:
    """Names and colors of classes, and the class of each Gaussian: (N,) from 1 on.

    Args:
        features: (N, C) of the Gaussians.
        classes: Classes with embeddings.
        decoder: What makes a teacher's features of these.
    """
    from drgs.features.pictures import label_colors
    from drgs.features.segmentation import classify

    labels = classify(features, classes, decoder).numpy()
    known = {"names": list(classes.names), "colors": label_colors(len(classes)).tolist()}
    return known, labels


@dataclasses.dataclass(frozen=True, eq=False)
class GaussianScale:
    """A number for each Gaussian, which a layer shows on a logarithmic scale.

    Attributes:
        name: Name of the layer.
        text: What the number is, and its unit.
        values: (N,) >= 0.
    """

    name: str
    text: str
    values: np.ndarray


def error_of(record: ErrorRecord) -> GaussianScale:
    """How wrong the color of each Gaussian is expected to be, from where photographs show it."""
    text = "expected error of a color between 0 and 1, seen from where the photographs were taken"
    return GaussianScale("error", text, record.of_gaussians.sqrt().cpu().numpy())


def uncertainty_of(
    scene: Scene, cameras: Sequence[Camera], settings: RenderSettings, nuisances: Nuisances
) -> GaussianScale:
    """The standard deviation of each Gaussian's position given the cameras of photographs that are not there.

    That of its center for unit noise of the photographs' colors, in scene units: the square root of
    the sum over its three coordinates of 1 / (H + lambda), as `drgs convert --uncertainty` writes it.

    Args:
        scene: What was fitted.
        cameras: Cameras of the photographs, at the size at which information is computed.
        settings: How it is drawn.
        nuisances: Unknowns of the photographs, eliminated from what they say.
    """
    scoring = Scoring(settings=settings, blocks=("geometry",), nuisances=nuisances)
    blocks = SceneBlocks.of(scene, scoring, cameras, "share")
    total: dict[str, torch.Tensor] = {}
    with Bar("uncertainty", len(cameras)) as bar:
        for camera in cameras:
            add(total, together(blocks.information(camera)))
            bar.advance()
    values = variances(total, MAP_PRIOR.in_scene(scene, cameras))["means"].sum(1).sqrt().cpu().numpy()
    return GaussianScale("uncertainty", "standard deviation of a center for noise of 1, in scene units", values)


def scale_layer(shown: GaussianScale, order: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """Name, ends, colors and meaning of a logarithmic scale, and the level of each Gaussian on it: uint8.

    The scale covers the values between the 1st and the 99th percentile, at most three decades; what is beyond has the
    color of its end.

    Args:
        shown: The numbers.
        order: (N,) the archive's order of the Gaussians.
    """
    values = np.log10(np.maximum(shown.values[order], _LEAST))
    least, high = np.percentile(values, [1, 99])
    low = max(least, high - _MOST_DECADES)
    high = max(high, low + 1e-3)  # of one value, too, the scale has a length to divide by
    shares = (np.clip(values, low, high) - low) / (high - low)
    known = {
        "low": float(10.0**low),
        "high": float(10.0**high),
        "name": shown.name,
        "text": shown.text,
        "colors": inferno(np.linspace(0, 1, _NUM_COLORS)[None])[0].tolist(),
    }
    return known, np.rint((_NUM_COLORS - 1) * shares).astype(np.uint8).tobytes()


def motion_layer(moving: DynamicGaussians, times: Sequence[float], rest: Gaussians, order: np.ndarray) -> tuple:
    """Where the Gaussians that move are at each of some times, in 16 bits a number, and when they are there.

    Args:
        moving: The Gaussians and what moves them.
        times: Ascending.
        rest: Those that the page's archive holds.
        order: (N,) the archive's order of them.
    Returns:
        JSON that the page reads; indices of what moves in the archive's order, uint32; (T, 10, M) uint16 means, log
        scales and quaternions (wxyz) of these, as if they were there all the time, each within its own range; and
        (9, M) float32 center and width in time (0: always there), velocity, acceleration and reference time, which a
        page adds.
    """
    numbers = []
    lifespans, limited = moving.lifespans, moving.has_lifespan.cpu().numpy()[order]
    moving = moving.without_lifespans()
    with torch.no_grad(), Bar("moments", len(times)) as bar:  # values, to be written
        for time in times:
            numbers.append(_numbers(moving.at(time))[:, order])
            bar.advance()
    values = np.stack(numbers)  # (T, 10, N)
    quats = values[:, 6:]
    quats *= np.where((quats * quats[:1]).sum(1, keepdims=True) < 0, -1, 1)  # q and -q are one turn: the nearer one
    still = _numbers(rest)[:, order]
    extent = np.ptp(still[:3], axis=1).max()
    scale = np.array([extent] * 3 + [1.0] * 7)[:, None]
    moves = ((np.ptp(values, axis=0) / scale).max(0) > _STILL_CHANGE) | (
        (np.abs(values[0] - still) / scale).max(0) > _STILL_CHANGE
    )
    places = np.flatnonzero(moves | limited)
    values = values[:, :, places]
    low = values.min((0, 2)) if len(places) else np.zeros(10)
    high = values.max((0, 2)) if len(places) else np.zeros(10)
    span = np.where(high > low, high - low, 1.0)[:, None]
    codes = np.rint((values - low[:, None]) / span * 65535)
    known = {"times": [float(x) for x in times], "count": len(places), "low": low.tolist(), "high": high.tolist()}
    there = np.zeros((9, len(places)))
    if lifespans is not None:
        columns = (
            lifespans.centers,
            lifespans.log_widths.exp(),
            *lifespans.velocities.T,
            *lifespans.accelerations.T,
            lifespans.reference_times,
        )
        values = np.stack([x.detach().double().cpu().numpy() for x in columns])[:, order][:, places]
        there = np.where(limited[places], values, 0.0)
    return known, places.astype("<u4").tobytes(), codes.astype("<u2").tobytes(), there.astype("<f4").tobytes()


def _numbers(g: Gaussians) -> np.ndarray:
    """(10, N) means, log scales and quaternions of length 1."""
    quats = torch.nn.functional.normalize(g.quats.detach().double(), dim=1)
    return torch.cat([g.means.detach().double(), g.log_scales.detach().double(), quats], 1).T.cpu().numpy()
