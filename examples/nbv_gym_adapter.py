"""View selectors of nbv_gym (Nerfstudio) in drgs, and the policies of drgs as one of its selectors.

nbv_gym (github.com/chengine/nbv_gym) asks a selector

    select_views(active_indices, remaining_indices, num_to_select, **context) -> indices

where `context` has `datamanager` and `model` of Nerfstudio. Theirs in ours, for `drgs select` and `drgs fit`:

    drgs fit DATA --views active --policy examples.nbv_gym_adapter:nearest_first -o RUN

runs `NearestFirst` below; for a selector of nbv_gym's own, write a line like that of `nearest_first`. Its context here
is the camera part of a data manager (`train_dataset.cameras[i:i + 1]`: camera_to_worlds, fx, fy, cx, cy, width,
height), which is all that selectors by poses look at, and no `model`: those that score by their own splats need
Nerfstudio's, and nbv_gym's then draw at random, or fail.

Ours in theirs: `DrgsViewSelector(policy="fisher")` takes the place of a selector in nbv_gym's configuration. It reads
Splatfacto's `gauss_params` and the cameras. Both directions were tested on objects of these shapes, not in Nerfstudio.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import torch

from drgs.cameras import Camera, c2w_from_opengl, c2w_to_opengl, intrinsics
from drgs.ellipsoids import Gaussians
from drgs.select import Pool, Selection, select


class ViewSelector(Protocol):
    """What nbv_gym calls a view selector."""

    def select_views(
        self, active_indices: list[int], remaining_indices: list[int], num_to_select: int, **context: Any
    ) -> list[int]:
        """Indices among the remaining ones, the best first."""


# ------------------------------------------------------------------------------------------------------ theirs in ours


def policy_of(selector: ViewSelector) -> Callable[[Pool], Selection]:
    """A policy of drgs that asks a selector; the known views come first in its numbering, then the candidates.

    It is asked once for all k views of a pick, and gives no scores: the table of `drgs select` shows its ranks.
    """

    def policy(pool: Pool) -> Selection:
        known, count = len(pool.train), len(pool.candidates)
        cameras = Cameras([*pool.train, *pool.candidates])
        context = {"datamanager": SimpleNamespace(train_dataset=SimpleNamespace(cameras=cameras)), "model": None}
        remaining = list(range(known, known + count))
        chosen = selector.select_views(list(range(known)), remaining, pool.k, **context)
        if len(chosen) < pool.k or len(set(chosen)) < len(chosen) or not set(chosen) <= set(remaining):
            raise ValueError(
                f"{type(selector).__name__}: must choose {pool.k} of the {count} remaining views, got {chosen[:10]}"
            )
        ranks = {index - known: rank for rank, index in enumerate(chosen)}
        scores = [float(pool.k - ranks[i]) if ranks.get(i, pool.k) < pool.k else 0.0 for i in range(count)]
        picks = [pool.pick(index - known, float(pool.k - rank)) for rank, index in enumerate(chosen[: pool.k])]
        return Selection(picks, scores, evaluations=count)

    return policy


class Cameras:
    """The part of Nerfstudio's `Cameras` that selectors by poses look at, of pinhole cameras of drgs."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = list(cameras)
        poses = [c2w_to_opengl(np.linalg.inv(camera.w2c))[:3] for camera in cameras]
        self.camera_to_worlds = torch.from_numpy(np.stack(poses)).float()
        numbers = torch.tensor([[c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2], c.width, c.height] for c in cameras])
        self.fx, self.fy, self.cx, self.cy, self.width, self.height = numbers.float()[:, :, None].unbind(1)

    def __len__(self) -> int:
        return len(self._cameras)

    def __getitem__(self, index: slice) -> Cameras:
        return Cameras(self._cameras[index])


@dataclasses.dataclass
class NearestFirst:
    """A selector as nbv_gym writes them: the views nearest to the one that was added last."""

    def select_views(
        self, active_indices: list[int], remaining_indices: list[int], num_to_select: int, **context: Any
    ) -> list[int]:
        """Choose by camera centers, in world units."""
        cameras = context["datamanager"].train_dataset.cameras
        centers = {i: cameras[i : i + 1].camera_to_worlds[0, :3, 3] for i in (*active_indices, *remaining_indices)}
        last = centers[active_indices[-1]] if active_indices else torch.zeros(3)
        return sorted(remaining_indices, key=lambda i: float((centers[i] - last).norm()))[:num_to_select]


nearest_first = policy_of(NearestFirst())


# ------------------------------------------------------------------------------------------------------ ours in theirs


class DrgsViewSelector:
    """A policy of drgs as a selector of nbv_gym.

    Args:
        policy: Name in `drgs.select.POLICIES`.
        max_pixels: Largest size that views are scored at.
        fields: Fields of `drgs.select.Scoring`, e.g. criterion="eig".
    """

    def __init__(self, policy: str = "fisher", max_pixels: int = 76_800, **fields: Any) -> None:
        self.policy, self.max_pixels, self.fields = policy, max_pixels, fields

    def select_views(
        self, active_indices: list[int], remaining_indices: list[int], num_to_select: int, **context: Any
    ) -> list[int]:
        """Indices among the remaining ones, the best first; `context` has Nerfstudio's `model` and `datamanager`."""
        if not remaining_indices:
            return []
        cameras = context["datamanager"].train_dataset.cameras
        candidates = [camera_of(cameras[i : i + 1], self.max_pixels) for i in remaining_indices]
        train = [camera_of(cameras[i : i + 1], self.max_pixels) for i in active_indices]
        count = min(max(1, num_to_select), len(candidates))
        found = select(gaussians_of(context["model"]), candidates, train, count, self.policy, **self.fields)
        return [remaining_indices[pick.index] for pick in found.picks]


def gaussians_of(model: Any) -> Gaussians:
    """Splatfacto's parameters: log-scales, logits of opacities, quaternions wxyz, SH of color - 0.5, as in drgs."""
    found = {name: value.detach().cpu().float() for name, value in dict(model.gauss_params).items()}
    sh = torch.cat([found["features_dc"][:, None], found["features_rest"]], dim=1)
    return Gaussians(found["means"], found["quats"], found["scales"], found["opacities"].reshape(-1), sh)


def camera_of(camera: Any, max_pixels: int) -> Camera:
    """One of Nerfstudio's pinhole cameras, reduced to so many pixels at most; undistort others first."""
    numbers = {
        name: float(getattr(camera, name).reshape(-1)[0]) for name in ("fx", "fy", "cx", "cy", "width", "height")
    }
    width, height = round(numbers["width"]), round(numbers["height"])
    c2w = np.eye(4)
    c2w[:3] = camera.camera_to_worlds[0].detach().cpu().double().numpy()
    found = Camera(
        K=intrinsics(numbers["fx"], numbers["fy"], numbers["cx"], numbers["cy"]),
        w2c=np.linalg.inv(c2w_from_opengl(c2w)),
        width=width,
        height=height,
    )
    scale = min(1.0, (max_pixels / (width * height)) ** 0.5)
    return found.resized(max(1, round(width * scale)), max(1, round(height * scale)))
