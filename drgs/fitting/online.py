"""Online fit: photographs are added one at a time, as a robot takes them, to a trainer that begins with the first.

Where a photograph has a depth map, it brings points wherever the Gaussians leave it open, or stand behind what it
shows. Where none has, the fit begins with random points where two cameras look, and density control does the rest.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.data.camera_layout import scene_extent, scene_origin
from drgs.data.resampling import resize_area
from drgs.ellipsoids import Gaussians
from drgs.fitting.config import FitConfig
from drgs.fitting.depths import axis_cosines, renders_z
from drgs.fitting.frames import Frame
from drgs.fitting.records import check_checkpoint
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.integrator import render
from drgs.io.json_files import check_json
from drgs.sfm.proposals import propose_along_rays, random_subset

_log = logging.getLogger(__name__)

# Chosen, not tuned.
_FEWEST_PHOTOGRAPHS = 2  # photographs that a fit begins with, where none has a depth map
_OPEN_OPACITY = 0.5  # opacity below which a pixel gets new Gaussians
_BEHIND = 0.1  # relative difference of depths from which on the rendered surface is too far behind the depth map
_BUDGET_SHARE = 0.25  # of the free part of `max_gaussians`: what one photograph may add
_MOST_RANDOM_POINTS = 10_000  # random points at the start, at most

_STATE = {"config": dict, "rng": {"state": str, "inc": str, "has_uint32": int, "uinteger": int}, "fit": (None, dict)}
_WHOLE = re.compile("[0-9a-f]{1,32}")  # 128 bits


class OnlineFit:
    """A fit to which photographs are added one at a time.

    Attributes:
        config: Configuration of the fit. When its `max_steps` are done, they are doubled: schedules continue from their
            middle.
        trainer: The fit; None until there are points to begin with.
    """

    def __init__(self, config: FitConfig) -> None:
        """
        Args:
            config: Configuration of a static fit, without a selection.
        Raises:
            ValueError: If it is of another kind of fit.
        """
        if config.selection is not None:
            raise ValueError("Planner: config must have no selection, got one; leave it out, the planner chooses")
        self.config = config
        self.trainer: Trainer | None = None
        self._waiting: list[Frame] = []
        self._rng = np.random.default_rng(config.seed)

    def add(self, image: np.ndarray, camera: Camera, depth: np.ndarray | None = None) -> int:
        """Add a photograph; returns the number of Gaussians that are added for it.

        Args:
            image: (H, W, 3), uint8 or in [0, 1].
            camera: Its camera, of that size.
            depth: (H, W) z-depth in world units, 0 or NaN where it is unknown; None: there is none.
        """
        seen = at_most(camera, self.config.data.max_pixels)
        pixels = _reduced(image, seen)
        frame = Frame(camera.name, seen, torch.from_numpy(pixels))
        if self.trainer is not None:
            self.trainer.add_frame(frame)
            return 0 if depth is None else self._add_points(frame, depth)
        self._waiting.append(frame)
        if depth is not None:
            points, colors = self._back_projected(frame, depth, np.ones(depth.shape, bool), self._room())
            return self._begin(points, colors, dense=True)
        if len(self._waiting) < _FEWEST_PHOTOGRAPHS:
            return 0
        cameras = [one.camera.undistorted() for one in self._waiting]
        images = [lambda one=one: one.image().numpy() for one in self._waiting]
        most = min(self.config.density.max_gaussians, _MOST_RANDOM_POINTS)
        points, colors = propose_along_rays(cameras, images, [None] * len(cameras), most, self._rng)
        return self._begin(points, colors, dense=False)

    def drop(self, name: str) -> None:
        """Fit no longer to a photograph; the Gaussians stay."""
        if self.trainer is not None:
            self.trainer.drop_frame(name)

    def step(self) -> float | None:
        """One step of the fit; returns the PSNR of the photograph it saw, dB, None where it is not finite."""
        assert self.trainer is not None, "nothing to fit yet"
        if self.trainer.step_index >= self.trainer.config.max_steps:
            self.trainer.reschedule(2 * self.trainer.config.max_steps)
        return self.trainer.step().psnr

    def gaussians(self) -> Gaussians:
        """A copy of the Gaussians, which further steps leave alone."""
        assert self.trainer is not None, "nothing to show yet"
        g = self.trainer.gaussians()
        return g.replace(**{name: x.clone() for name, x in g.parameters().items()})

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any], list[Camera]]:
        """Tensors, which further steps leave alone, a header in JSON, and the cameras of the photographs."""
        frames = self._waiting if self.trainer is None else self.trainer.frames
        tensors = {f"photograph.{i}": frame.pixels for i, frame in enumerate(frames)}
        rng: Any = self._rng.bit_generator.state  # whose numbers have 128 bits, which few readers of JSON keep
        state = {name: f"{rng['state'][name]:x}" for name in ("state", "inc")}
        state |= {name: rng[name] for name in ("has_uint32", "uinteger")}
        fit = None
        if self.trainer is not None:
            more, fit = self.trainer.state()
            tensors |= {f"fit.{name}": x.clone() for name, x in more.items()}
            fit |= {"point_source": "photographs"}
        return tensors, {"config": self.config.to_json(), "rng": state, "fit": fit}, [one.camera for one in frames]

    @classmethod
    def from_state(
        cls, tensors: Mapping[str, torch.Tensor], header: dict, cameras: Sequence[Camera], where: Path
    ) -> OnlineFit:
        """The inverse of `state`.

        Raises:
            ValueError: If it is no such state, or damaged.
        """
        advice = "restore the file, or begin anew"
        check_json(str(where), header, _STATE, advice)
        for name in ("state", "inc"):
            if not _WHOLE.fullmatch(header["rng"][name]):
                raise ValueError(f"{where}: rng.{name} must be a hexadecimal number of 128 bits, is none; {advice}")
        if header["config"].get("selection") is not None:
            raise ValueError(f"{where}: config must have no selection, got one; {advice}")
        found = cls(FitConfig.from_json(header["config"]))
        found._rng.bit_generator.state = {
            "bit_generator": "PCG64",
            "state": {name: int(header["rng"][name], 16) for name in ("state", "inc")},
            "has_uint32": header["rng"]["has_uint32"],
            "uinteger": header["rng"]["uinteger"],
        }
        frames = []
        for i, camera in enumerate(cameras):
            pixels = tensors.get(f"photograph.{i}")
            shape = (camera.height, camera.width, 3)
            if pixels is None or pixels.dtype != torch.uint8 or tuple(pixels.shape) != shape:
                raise ValueError(f"{where}: photograph {i} must be 8 bits of shape {shape}, is not; {advice}")
            frames.append(Frame(camera.name, camera, pixels))
        if header["fit"] is None:
            found._waiting = frames
            return found
        own = {name.removeprefix("fit."): x for name, x in tensors.items() if name.startswith("fit.")}
        check_checkpoint(where, own, header["fit"])
        config = FitConfig.from_json(header["fit"]["config"])  # whose steps may be more by now
        if config.selection is not None:
            raise ValueError(f"{where}: config must have no selection, got one; {advice}")
        found.trainer = Trainer.from_state(config, frames, own, header["fit"], str(where))
        return found

    def _begin(self, points: np.ndarray, colors: np.ndarray, dense: bool) -> int:
        if not len(points):
            return 0
        cameras = [frame.camera for frame in self._waiting]
        origin = scene_origin("Planner", cameras, points)
        start = torch.from_numpy(points), torch.from_numpy(colors), *self.config.density.start_of(dense)
        rows = GaussianRows.from_points(*start, origin)
        extent = scene_extent(cameras, points)
        self.trainer = Trainer(self.config, self._waiting, rows, extent)
        self._waiting = []
        return len(points)

    def _room(self) -> int:
        """Largest number of Gaussians that a photograph may add."""
        there = 0 if self.trainer is None else len(self.trainer.rows)
        return int(_BUDGET_SHARE * max(self.config.density.max_gaussians - there, 0))

    def _add_points(self, frame: Frame, depth: np.ndarray) -> int:
        """Add Gaussians where a depth map shows surfaces that the present ones lack."""
        assert self.trainer is not None  # there are others
        seen = frame.camera
        with torch.no_grad():
            out = render(self.trainer.gaussians(), seen, self.config.settings, outputs=("median_depth",))
        assert out.median_depth is not None  # an output of this rendering
        z = out.median_depth.cpu()
        if not renders_z(self.config.settings):
            z = z * axis_cosines(seen)
        alpha, known = (resize_area(x.numpy(), *depth.shape[::-1]) for x in (out.alpha.cpu(), z))
        wanted = (alpha < _OPEN_OPACITY) | ((depth > 0) & (depth < (1 - _BEHIND) * known))
        share = wanted.mean()
        most = min(self._room(), int(share * _BUDGET_SHARE * self.config.density.max_gaussians))
        points, colors = self._back_projected(frame, depth, wanted, most)
        if len(points):
            self.trainer.add_points(
                torch.from_numpy(points), torch.from_numpy(colors), *self.config.density.start_of(True)
            )
        return len(points)

    def _back_projected(
        self, frame: Frame, depth: np.ndarray, wanted: np.ndarray, most: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points of wanted pixels whose depth is known, (P, 3), at most so many, and their colors (P, 3)."""
        known = np.flatnonzero(wanted & np.isfinite(depth) & (depth > 0))
        chosen = known[random_subset(len(known), most, self._rng)]
        camera = frame.camera.resized(depth.shape[1], depth.shape[0])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pixels that no ray belongs to, whose depth is unknown
            rays = camera.pixel_directions().reshape(-1, 3)[chosen]
        along = rays @ camera.c2w[:3, 2]
        points = camera.center + rays * (depth.reshape(-1)[chosen].astype(np.float64) / along)[:, None]
        colors = resize_area(frame.image().numpy(), depth.shape[1], depth.shape[0]).reshape(-1, 3)[chosen]
        return points, np.ascontiguousarray(colors, dtype=np.float32)


def _reduced(image: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W, 3) 8 bits of an image at the size of a camera."""
    values = image.astype(np.float32) / 255 if image.dtype == np.uint8 else image.astype(np.float32)
    return (resize_area(values, camera.width, camera.height).clip(0, 1) * 255).round().astype(np.uint8)
