"""Which time each drawn view is of, and the Gaussians of each time as PLY files."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.codecs.ply import save_ply
from drgs.display.progress import Bar

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.scene_input import SceneInput
    from drgs.ellipsoids import Scene

__all__ = ["at_times", "named_view", "ply_names", "write_plys"]


def named_view(cameras: list[Camera], name: str | None, where: str) -> list[Camera]:
    """The camera of a name, or the first view of a camera of that name; all, where none is asked for.

    Raises:
        ValueError: If there is none.
    """
    if name is None:
        return cameras
    found = [camera for camera in cameras if camera.name == name or camera.name.startswith(f"{name}/")]
    if not found:
        known = list(dict.fromkeys(camera.name.rpartition("/")[0] or camera.name for camera in cameras))
        shown = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
        raise ValueError(f"--view must name one of the {len(cameras)} views of {where}: {shown}; got {name!r}")
    return found[:1]


def at_times(
    cameras: list[Camera], text: str | None, frames: int, given: SceneInput, is_film: bool = False
) -> list[Camera]:
    """The cameras with the times that they are drawn at.

    Args:
        cameras: The cameras of `--cameras`; at least one.
        text: What `--time` says; None: their own times or, where they have none, all times of the run, evenly.
        frames: How many of one camera, if the time alone moves.
        given: What is drawn; where it stands still, times mean nothing, and cameras stay as they are.
        is_film: Whether they are the frames of a film, each of which has its time; else equal poses count once.
    Returns:
        With one time, each pose once. With a range, the cameras in their order at times from its begin to its end; or
        `frames` times one camera, named by their numbers.
    Raises:
        ValueError: If nothing moves and there is a text, it is no time, or lies outside of the run's times.
    """
    if given.moving is None:
        if text is not None:
            raise ValueError("--time must have a scene that moves, this one stands still; drop it")
        return cameras
    times = given.record.times if given.record else ()
    first, last = (times[0], times[-1]) if times else (-math.inf, math.inf)
    if text is None:
        if all(camera.time is not None for camera in cameras):
            return cameras
        begin, end = first, last
    else:
        begin, end = _range(text)
        if not (first <= begin <= last and first <= end <= last):
            raise ValueError(f"--time must be in {first:g}..{last:g}, the times of the run, got {text!r}; correct it")
    if not is_film:
        poses = {(camera.w2c.tobytes(), camera.K.tobytes()): camera for camera in reversed(cameras)}
        cameras = list(reversed(poses.values()))  # synchronous cameras have a view for every time
    if begin == end:
        return [dataclasses.replace(camera, time=begin) for camera in cameras]
    if len(cameras) == 1 and not is_film:
        name = cameras[0].name or "view"
        cameras = [dataclasses.replace(cameras[0], name=f"{name}_{k:04d}") for k in range(frames)]
    moments = np.linspace(begin, end, len(cameras)) if len(cameras) > 1 else [begin]
    return [dataclasses.replace(camera, time=float(t)) for camera, t in zip(cameras, moments, strict=True)]


def _range(text: str) -> tuple[float, float]:
    """Begin and end of a range; one time is both."""
    try:
        ends = [float(part) for part in text.split("..")]
    except ValueError:
        ends = []
    if len(ends) not in (1, 2) or not all(math.isfinite(x) for x in ends):
        raise ValueError(f"--time must be a time or a range of two, e.g. 0.5 or 0..1, got {text!r}; correct it")
    return ends[0], ends[-1]


def ply_names(cameras: list[Camera]) -> dict[str, float | None]:
    """A file name for each distinct time, in the order of the cameras."""
    times = dict.fromkeys(camera.time for camera in cameras)
    return {f"gaussians_{k:04d}.ply": time for k, time in enumerate(times)}


def write_plys(scene: Scene, cameras: list[Camera], folder: Path, moving: bool, features: bool) -> list[dict]:
    """Write the Gaussians of each distinct time, every field as it is then.

    Args:
        scene: What is drawn.
        cameras: Cameras whose times count.
        folder: Folder of the files, which are named as `ply_names` says.
        moving: Whether only Gaussians that move, or are there for a time, are written.
        features: Whether they are written with their features, if they have any.
    Returns:
        JSON-serializable: file, time and number of Gaussians of each.
    Raises:
        ValueError: If only those that move are wanted, and none does.
    """
    from drgs.deform import DynamicGaussians

    chosen = scene.moving | scene.living if isinstance(scene, DynamicGaussians) else None
    if moving and (chosen is None or not bool(chosen.any())):
        raise ValueError("--moving must have a scene where something moves, nothing does here; drop it")
    names = ply_names(cameras)
    written = []
    with Bar("PLY files", len(names)) as bar:
        for name, time in names.items():
            seen = scene.at(time).detach()  # a file holds values
            seen = seen if features else seen.replace(features=None)
            seen = seen.take(chosen) if moving else seen
            save_ply(seen, folder / name)
            written.append({"file": name, "time": time, "gaussians": len(seen)})
            bar.advance()
    return written
