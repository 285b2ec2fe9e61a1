"""The gradients of an image of many channels: the same Gaussians with plain colors (N, D) instead of SH.

Rasterizers carry such channels along other paths than RGB (padding, chunks, a second pass), where gradients get lost.
One view is compared, on black. Of the geometry only what the RGB image has right is asked about again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch

from drgs.lab.dumps import Dump, cotangents, one_line
from drgs.lab.raw import COLORS, POSE, with_colors
from drgs.lab.reference_model import ReferenceModel
from drgs.lab.rows import GroupRow
from drgs.lab.verdicts import Case, Compared, compared, judge

__all__ = ["wide_gradients"]


def wide_gradients(
    case: Case, model: ReferenceModel, rgb: Compared, channels: int, seed: int, near_ties: Callable[[int], torch.Tensor]
) -> tuple[dict[str, GroupRow], str]:
    """Rows of an image of D channels, and why there are none.

    Args:
        case: What was compared in RGB.
        model: At the conventions that were found.
        rgb: What came of it.
        channels: D.
        seed: Of colors and cotangents.
        near_ties: View -> (H, W) bool.
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
    fixed = {name: x for name, x in case.raw.items() if name != POSE}
    raw = with_colors(fixed, channels, seed)
    black = (0.0,) * channels
    u = cotangents([camera], seed, channels)
    case.say(f"{channels} channels")
    try:
        picture, alpha = rasterizer.image(raw, camera, black)
        rasterizer.gradient(raw, camera, black, u[0])
    except Exception as error:  # whatever a function raises that knows three channels only
        return {}, f"it draws no image of {channels} channels: {one_line(error)}"
    wide = dataclasses.replace(case, raw=raw, cameras=[camera], background=black, first=0)
    with torch.no_grad():  # images alone are compared
        drawn = [tuple(x.cpu() for x in model.draw(raw, camera, case.oracle))]
    found = compared(wide, model, u, [picture], [alpha], drawn, lambda _: near_ties(case.first))
    right = [name for name, row in rgb.groups.items() if row.verdict == "agreement"]
    found.groups = {name: row for name, row in found.groups.items() if name == COLORS or name in right}
    judge(wide, model, found)
    rows = {COLORS: found.groups.pop(COLORS)}
    return rows | {f"{k}, {channels} channels": x for k, x in found.groups.items() if x.verdict != "agreement"}, ""
