"""The region that `--region` names, of a command's scene and known views."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.information.region import Region, RegionText, masked_photographs

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch

    from drgs.cameras import Camera
    from drgs.commands.scene_input import SceneInput
    from drgs.commands.viewpoints import Source
    from drgs.settings import RenderSettings


def region_of(
    command: str, args: Any, given: SceneInput, source: Source, cameras: Sequence[Camera], settings: RenderSettings
) -> Region | None:
    """The region of `--region`; None without.

    Args:
        command: Name of the command, for messages.
        args: Options of a command with --region.
        given: The command's scene.
        source: Where its known views are from, whose photographs masks may be of.
        cameras: Cameras of these under the names of the views.
        settings: Settings of the renderer, by which masks are put on Gaussians.
    Raises:
        ValueError: If the text is none of a region, or the scene or its data set do not have what it names.
    """
    if args.region is None:
        return None

    def photographs(folder: Path) -> tuple[Sequence[torch.Tensor], Sequence[Camera]]:
        if source.kind == "list":
            raise ValueError(
                f"{command}: region masks:{folder} must be of photographs, {source.option} {source.text} is a list of "
                "cameras; name their data set or a run"
            )
        views = {view.name: view for view in source.dataset(args, given).views}
        lenses = given.keeps_lenses(args.undistort)
        photographed = [dataclasses.replace(views[camera.name], keeps_lens=lenses) for camera in cameras]
        return masked_photographs(folder, photographed, cameras, command)

    text = RegionText.of(args.region, command)
    return text.region(photographs, lambda: (given.classes, given.decoder), settings, command)
