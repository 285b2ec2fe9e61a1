"""The extremes of the renderer, on this machine and backend, against the float64 oracle.

The oracle of `exact`, whatever its response, cuts nothing off: no extent, and no end of rays.

A row a case and traversal: the largest error of the image; the relative error of the worst block of gradients, of the
forward mode, and of the two against each other (`drgs.lab.accuracy.Errors`); the error of the exact Fisher diagonal
against the oracle's dense Jacobian, of the group's largest entry. It holds if all are within `BOUNDS` and everything is
finite.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
import warnings
from collections.abc import Callable, Iterator

import numpy as np
import torch

from drgs import fisher, reference
from drgs.cameras import Camera
from drgs.cameras.sizes import cropped
from drgs.ellipsoids import Gaussians
from drgs.gain import Information, Prior, information_gain
from drgs.lab.accuracy import FIELDS, Oracle, compare, entry_error, jacobian, squares
from drgs.lab.extremes import ExtremeCase, Refusal
from drgs.settings import RenderSettings

BOUNDS = {"image": 1e-5, "gradient": 1e-4, "forward": 1e-4, "duality": 1e-4, "fisher": 1e-4}
"""What `exact` claims; every case here is held to it, whatever its settings, but where `bvh` rounds or warns."""

_MAX_DENSE_ENTRIES = 3_000_000  # pixels^2 x Gaussians: the dense Jacobian of that takes the oracle a few seconds
_ROUNDING = 8 * 6e-8  # rounding of `bvh`, times distance / smallest sigma: docs/numerics.md

_CRITERIA = ("logdet", "eig", "trace_cov")


@dataclasses.dataclass(frozen=True)
class StressRow:
    """One case on one traversal.

    Attributes:
        case: Name of the case.
        traversal: Name of the traversal; `all` of a refusal.
        image, gradient, forward, duality, fisher: Errors that `BOUNDS` limits; None where there is none.
        group: Parameter group of the worst gradient.
        finite: Whether every output, derivative and entry of the information is; None where nothing was computed.
        verdict: `holds`, `warns` (refused or warned about, as documented) or `FAILS`.
        remark: What a reader should know, messages included.
        seconds: Time of the renderer, compilation of its kernels included.
    """

    case: str
    traversal: str
    image: float | None = None
    gradient: float | None = None
    group: str = ""
    forward: float | None = None
    duality: float | None = None
    fisher: float | None = None
    finite: bool | None = None
    verdict: str = "FAILS"
    remark: str = ""
    seconds: float = 0.0


def rows(case: ExtremeCase | Refusal) -> Iterator[StressRow]:
    """Measure a case on each of its traversals; what raises becomes a row."""
    if isinstance(case, Refusal):
        yield _caught(case.name, "all", lambda: refused(case))
        return
    truth = functools.cache(lambda: truth_of(case))  # takes longer than the renderer
    for traversal in case.traversals:
        yield _caught(case.name, traversal, lambda traversal=traversal: row_of(case, traversal, truth()))


def _caught(name: str, traversal: str, make: Callable[[], StressRow]) -> StressRow:
    try:
        return make()
    except Exception as error:  # whatever a backend does wrong must not end the run
        text = " ".join(str(error).split()) or "no message"
        return StressRow(name, traversal, remark=f"raised {type(error).__name__}: {text}")


@dataclasses.dataclass(frozen=True)
class Truth:
    """A case, and its images and derivatives by the oracle.

    Attributes:
        g: Gaussians of the scene, all leaves.
        cam: Camera of the scene, whose pose is a leaf.
        oracle: Images and derivatives of the oracle.
        view: Camera whose image is compared in Fisher information; None where none is.
        information: Group -> diagonal of the dense Jacobian's J^T J, of `view`.
        remark: What `view` leaves out, and why.
    """

    g: Gaussians
    cam: Camera
    oracle: Oracle
    view: Camera | None
    information: Information
    remark: str


def truth_of(case: ExtremeCase) -> Truth:
    """Build a case and compute it by the oracle."""
    rng = np.random.default_rng(3)
    settings = case.oracle_settings
    g, cam = case.build(rng)
    names = [name for name in FIELDS if case.depth or name != "depth"]
    # 1e-6: near ties of float32 keys, ten times its rounding.
    oracle = Oracle(g, cam, settings, rng, 1e-6, names)
    good = oracle.good
    out = oracle.out
    view = cam
    remark = ""
    whole = settings.culling == "extent" and settings.fov_clamp == "none"
    most = math.isqrt(_MAX_DENSE_ENTRIES // max(len(g), 1)) if whole else good.numel()
    if not good.all() and not whole:
        remark = "no Fisher error: some pixels are near a tie, and clamp and culling make a part another image"
        return Truth(g, cam, oracle, None, {}, remark)
    if not good.all() or good.numel() > most:
        view = _window(cam, good, most)
        why = "more would take the oracle long" if good.all() else "others are near a tie, or too many"
        remark = f"Fisher error of {view.width}x{view.height} pixels: {why}"
        out = reference.render(g, view, settings)
    return Truth(g, cam, oracle, view, squares(jacobian(g, out, features=True)), remark)


def row_of(case: ExtremeCase, traversal: str, truth: Truth) -> StressRow:
    """One row: every error of a case on `tiles` or `bvh`, and what they amount to."""
    g = truth.g
    cam = truth.cam
    oracle = truth.oracle
    settings = case.settings.replace(traversal=traversal)
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        errors = compare(g, cam, settings, oracle)
        information, sound, remark = _information(case, settings, truth)
    seconds = time.perf_counter() - start
    messages = sorted({str(w.message) for w in caught if "traversal='tiles'" in str(w.message)})
    group = max(errors.gradient, key=errors.gradient.get)
    values = {
        "image": max(errors.image.values(), default=0.0),
        "gradient": errors.gradient[group],
        "forward": errors.joint,
        "duality": errors.duality,
        "fisher": information,
    }
    finite = errors.finite and sound
    bounds = BOUNDS
    limits = ""
    if traversal == "bvh" and case.bvh == "rounds":
        bounds = _rounded(g, cam)
        limits = f"rounding of `bvh`: image within {bounds['image']:.0e}"
    # A comparison with NaN is False: what is not a number is not within a bound.
    broken = [f"{n} {x:.1e} > {bounds[n]:.0e}" for n, x in values.items() if x is not None and not x <= bounds[n]]
    expected = traversal == "bvh" and case.bvh == "warns"
    if expected and messages and finite:
        verdict = "warns"
        broken = []
    elif expected != bool(messages):
        verdict = "FAILS"
        broken = [*broken, "no warning" if expected else "a warning without need"]
    else:
        verdict = "FAILS" if broken or not finite else "holds"
    ties = 100 * float((~oracle.good).double().mean())
    parts = (
        *broken,
        case.remark,
        limits,
        *messages,
        f"{ties:.2g} % of pixels near a tie, left out" if ties else "",
        remark,
    )
    return StressRow(
        case.name,
        traversal,
        **values,
        group=group,
        finite=finite,
        verdict=verdict,
        remark="; ".join(part for part in parts if part),
        seconds=seconds,
    )


def _rounded(g: Gaussians, cam: Camera) -> dict[str, float]:
    """`BOUNDS` of hits in float32 world space; derivatives have four times the error, their squares twice that."""
    # A bound is a number: `float` of a tensor with a graph would warn.
    far = (g.means.detach().double() - torch.tensor(cam.center - g.origin)).norm(dim=1)
    unit = _ROUNDING * float((far / g.scales.detach().double().amin(1)).max())
    more = {"image": unit, "gradient": 4 * unit, "forward": 4 * unit, "fisher": 8 * unit}
    return {name: max(bound, more.get(name, 0.0)) for name, bound in BOUNDS.items()}


def _information(case: ExtremeCase, settings: RenderSettings, truth: Truth) -> tuple[float | None, bool, str]:
    """Error of the Fisher diagonal (and gains), whether all of it and of the blocks is finite, and a remark."""
    g, cam, view = truth.g, truth.cam, truth.view
    diagonal = fisher.diagonal(g, cam, settings)
    blocks = fisher.blocks(g, cam, settings)
    finite = all(bool(torch.isfinite(x).all()) for x in (*diagonal.values(), blocks))
    if view is None:
        return None, finite, truth.remark
    if view is not cam:
        diagonal = fisher.diagonal(g, view, settings)
    error = max(entry_error(diagonal[name], x) for name, x in truth.information.items())
    if not case.gain:
        return error, finite, truth.remark
    gain, remark = _gain(g, view, settings, case.oracle_settings, diagonal, truth.information)
    return max(error, gain), finite, remark


def _gain(
    g: Gaussians, cam: Camera, settings: RenderSettings, exactly: RenderSettings, H: Information, truth: Information
) -> tuple[float, str]:
    """Relative error of the gains of a second view for lambda = 0, and a remark; NaN if one is not defined.

    Args:
        exactly: Settings of the oracle.
        H, truth: Information of the first view, by the renderer and by the oracle.
    """
    K = cam.K.copy()
    K[0, 2] -= 0.6 * cam.width
    other = dataclasses.replace(cam, K=K)
    prior = Prior(value=0.0)
    Hc = fisher.diagonal(g, other, settings)
    true = squares(jacobian(g, reference.render(g, other, exactly), features=True))
    worst = 0.0
    informed = {name: x > 0 for name, x in truth.items()}
    for criterion in _CRITERIA:
        gain = information_gain(Hc, H, criterion, prior)
        want = 0.0
        for name, keep in informed.items():
            a, c = truth[name][keep], true[name][keep]
            terms = {"logdet": (c / a).log1p(), "eig": c / a, "trace_cov": 1 / a - 1 / (a + c)}
            want += float(terms[criterion].sum())
        worst = max(worst, abs(gain.total - want) / max(abs(want), 1e-12))  # a gain of 0 is compared absolutely
    left = {name: int((~keep).sum()) for name, keep in informed.items()}
    blocks = information_gain(
        {"blocks": fisher.blocks(g, other, settings)},
        {"blocks": fisher.blocks(g, cam, settings)},
        "block_logdet",
        prior,
    )
    if gain.left_out != left or not np.isfinite(blocks.total):
        return float("nan"), f"left out {gain.left_out}, the oracle {left}; block_logdet {blocks.total}"
    count = sum(left.values())
    total = sum(x.numel() for x in truth.values())
    return worst, f"gain of a second view (logdet, eig, trace_cov) {worst:.0e}, {count} of {total} entries left out"


def _window(cam: Camera, good: torch.Tensor, most: int) -> Camera:
    """The camera of the largest rectangle of good pixels, or of `most` pixels in its middle."""
    height, width = good.shape
    best = (0, 0, 0, 0, 0)
    heights = np.zeros(width, int)
    for bottom in range(height):
        heights = np.where(good[bottom].numpy(), heights + 1, 0)
        for left in range(width):
            low = height
            for right in range(left, width):
                low = min(low, heights[right])
                if low == 0 or low * (width - left) <= best[0]:
                    break
                best = max(best, (low * (right - left + 1), left, bottom + 1 - low, right - left + 1, low))
    _, x, y, w, h = (int(v) for v in best)
    width, height = (w, max(1, min(h, most // w))) if w <= most else (most, 1)
    return cropped(cam, x + (w - width) // 2, y + (h - height) // 2, width, height)


def refused(case: Refusal) -> StressRow:
    """The row of input that must raise ValueError, or be warned about, with one line that says why."""
    start = time.perf_counter()
    count = 0
    message = ""
    for call, text in case.attempts():
        count += 1
        messages = []
        result = None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                result = call()
            except ValueError as error:
                messages = [] if case.warns else [str(error)]
        if case.warns:
            messages = [str(w.message) for w in caught]
        message = next((x for x in messages if text in x and "\n" not in x), "")
        if not message:
            got = messages or f"{type(result).__name__} without a word"
            return StressRow(case.name, "all", remark=f"attempt {count}: must say {text!r}, got {got}")
    seconds = time.perf_counter() - start
    return StressRow(case.name, "all", verdict="warns", remark=f"{count} attempts, e.g. {message}", seconds=seconds)
