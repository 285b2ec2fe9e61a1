"""Poses of training photographs that are fitted beside the scene, where the data set's own residual says they are off.

A photograph has a twist xi (6,), world frame, rotation first: its camera is exp(xi) c2w of the one that the data set
states. Rendering differentiates the pose exactly, so its gradient comes with that of the Gaussians, at no other cost.

**Coordinates.** u = (rotation, move of the camera's center in units of the scene's extent), a linear map of xi. A pixel
says much about some combinations of the six and little about others (a turn and a sideways move nearly cancel), so that
one rate for all of them is too large here or too small there. What Adam sees is z, u = W z, W W^T = (H + damping)^-1,
where H (6, 6) is the Fisher information of the camera's own pose at the step that refinement begins with, a mean over
pixels and channels, from forward-mode derivatives of a small picture: a unit step of any z changes the picture as much.

**Gauge.** What all cameras do together (turn, move, grow about their middle: 7 numbers) the scene can undo: photographs
say nothing about it, and held-out cameras would no longer fit. After every step, u of all photographs is projected to
the complement of the 7 tangents of this group: held exactly in u, for motions of first order.

**Reach.** A few photographs can be fitted better by cameras that are far off and Gaussians that suit them. So no camera
may go further than the data set's own residual says it can be wrong: what its pose moves the Gaussians in its picture
by, root mean square, is at most `_REACH_FACTOR` times the median reprojection error, but for what the gauge then adds.
Where the data set brings none, it is `_UNKNOWN_REACH` pixels.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs.cameras.sizes import at_most
from drgs.data.camera_lists import save_cameras_json
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians, Scene, colors_only
from drgs.fitting.components.base import Checkpoint, Component, Conflict, Fit, RunViews, Setup
from drgs.fitting.losses import psnr
from drgs.fitting.networks import Network
from drgs.integrator import render, render_jvp
from drgs.tracing.pose import cross_matrix

if TYPE_CHECKING:
    from pathlib import Path

    from drgs.cameras import Camera
    from drgs.fitting.frames import Frame
    from drgs.settings import RenderSettings

POSE_NETWORK = "poses"
"""Name of the poses in a checkpoint."""
CAMERAS = "refined_cameras.json"
"""File of a run with the cameras of its training photographs, as refined."""

# Where nothing measured is named: chosen, not tuned.
_CLEAR_PIXELS = 0.5  # pixels of the fit: median reprojection error from which on refining pays (docs/one-model.md)
_BEGIN, _END = 0.15, 0.9  # fractions of the fit between which poses are fitted: geometry first, and last alone
_RATE = 5e-3  # learning rate of z at the start: root mean square change of the picture's colors in a step; falls to 0
_DAMPING = 1e-2  # of the mean eigenvalue of H, so that W exists where a picture says nothing about a direction
_INFORMATION_PIXELS = 4096  # pixels of the picture whose H preconditions a pose: no more accuracy is needed
_REACH_FACTOR = 3.0  # times the reprojection error: bundle adjustment has hidden some of a pose's error in its points
_NEAR_SHARE = 0.25  # of the median depth: what is nearer may be a floater, whose shift would stand for the picture's
_LEAST_INFORMATION = 1e-4  # of H, at least: an empty picture has none, and its first step would be unbounded
_UNKNOWN_REACH = 2.0  # pixels of the fit, where a data set says nothing about its poses
_REFINING_STEPS = 12  # steps at most of a camera that is refined against one photograph
_MOST_TURN = 0.5  # radians of such a step, at most: farther away the linear model of the rotation is wrong


@dataclasses.dataclass(frozen=True)
class PoseEvidence:
    """What a data set says about its poses before the fit.

    Attributes:
        pixels: Median distance of observations from where the model's points are projected to, in pixels of the
            fit's photographs; None where the data set brings no such model.
    """

    pixels: float | None

    @classmethod
    def of(cls, angle: float | None, frames: Sequence[Frame]) -> PoseEvidence:
        """
        Args:
            angle: `Dataset.reprojection`, or None.
            frames: The training photographs.
        """
        if angle is None:
            return cls(None)
        return cls(angle * float(np.median([float(frame.camera.K[0, 0]) for frame in frames])))

    @property
    def reach(self) -> float:
        """How far a refined pose may move what its picture shows, root mean square in pixels of the fit."""
        return _UNKNOWN_REACH if self.pixels is None else _REACH_FACTOR * self.pixels

    @property
    def is_clear(self) -> bool:
        """Whether poses are worth refining."""
        return self.pixels is not None and self.pixels > _CLEAR_PIXELS

    def words(self) -> str:
        """What was found, in words."""
        if self.pixels is None:
            return "the data set brings no observations that would say how wrong they are"
        return f"points are {self.pixels:.2f} px (median) from where photographs show them, at the size of the fit"

    def to_json(self, refined: bool) -> dict:
        """What config.json says: the evidence, and whether poses are refined."""
        return {"reprojection": self.pixels, "refined": refined}


class Poses(torch.nn.Module):
    """Twists of the cameras of training photographs.

    Attributes:
        names: V names of photographs.
        coordinates: V times z (6,), float64; 0 is the pose that the data set states.
        whitening: (V, 6, 6) float64, the matrices W; 0 before the refinement has begun.
        shifts: (V, 6, 6) float64, mean over the Gaussians in a picture, by opacity, of D^T D, where D (2, 6) is what u
            moves them by in pixels; 0 before the refinement has begun.
        reach: Float64 scalar, how far a pose may move what its picture shows, root mean square in pixels.
    """

    whitening: torch.Tensor
    shifts: torch.Tensor
    reach: torch.Tensor

    def __init__(self, cameras: Sequence[Camera], extent: float, settings: RenderSettings, reach: float = 0.0) -> None:
        """
        Args:
            cameras: V pinhole cameras of the photographs, named as these, as the data set states them.
            extent: Extent of the scene, its unit of length.
            settings: What information is computed with.
            reach: The reach; of a resumed fit it is the checkpoint's.
        """
        super().__init__()
        self.names = [camera.name for camera in cameras]
        self._rows = {name: row for row, name in enumerate(self.names)}
        self._cameras = list(cameras)
        self._settings = settings
        self._extent = extent
        self.coordinates = torch.nn.ParameterList(torch.zeros(6, dtype=torch.float64) for _ in cameras)
        self.register_buffer("whitening", torch.zeros(len(cameras), 6, 6, dtype=torch.float64))
        self.register_buffer("shifts", torch.zeros(len(cameras), 6, 6, dtype=torch.float64))
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64))
        self._place()

    def _place(self) -> None:
        """What follows from where the cameras of all photographs are stated to be."""
        centers = torch.tensor(np.stack([camera.c2w[:3, 3] for camera in self._cameras]))
        self._twist_of = torch.stack([_twist_of_u(center, self._extent) for center in centers])
        self._common = _common_motions(centers, self._extent)

    @property
    def has_begun(self) -> bool:
        """Whether information has been computed, and poses may be other than stated."""
        return bool(self.whitening.any())

    def begin(self, gaussians: Gaussians, far: int = 0) -> None:
        """Compute W of every photograph, and what its pose moves its picture by, from what the Gaussians are now.

        Args:
            gaussians: The Gaussians.
            far: How many of the first are far away: where a camera stands makes no difference to how they look.
        """
        with Bar("information about poses", len(self._cameras)) as bar:
            for row in range(len(self._cameras)):
                self._look(row, gaussians, far)
                bar.advance()

    def _look(self, row: int, gaussians: Gaussians, far: int) -> None:
        """W of a photograph, and what its pose moves its picture by; arguments as of `begin`."""
        camera = self._cameras[row]
        # A metric of steps, not part of the loss.
        means = gaussians.means[far:].detach().cpu().double() + torch.from_numpy(gaussians.origin)
        opacities = gaussians.logit_opacities[far:].detach().cpu().double().sigmoid()
        tangents = {"camera": self._twist_of[row].T.contiguous()}
        small = at_most(camera, _INFORMATION_PIXELS)
        changes = render_jvp(gaussians, small, tangents, self._settings, outputs=()).rgb.double().reshape(6, -1)
        information = changes @ changes.T / changes.shape[1]
        damping = _DAMPING * information.trace() / 6 + _LEAST_INFORMATION
        lower = torch.linalg.cholesky(information + damping * torch.eye(6, dtype=torch.float64))
        self.whitening[row] = torch.linalg.inv(lower).T
        moved, weights = _moved(means, opacities, camera, self._extent)
        moved = moved @ self._twist_of[row]
        self.shifts[row] = torch.einsum("n,nki,nkj->ij", weights, moved, moved) / weights.sum()

    def join(self, camera: Camera, gaussians: Gaussians, far: int = 0) -> None:
        """One photograph more, whose pose is as stated until it is fitted.

        The gauge is held over it, too, from now on. That moves no camera: the tangents of all cameras, restricted to
        those that were there, span what theirs do, and the newcomer's u is 0.

        Args:
            camera: Its pinhole camera, named as it.
            gaussians: The Gaussians, which are used only once refinement has begun.
            far: How many of the first are far away, as of `begin`.
        """
        begun = self.has_begun
        row = len(self.names)
        self.names.append(camera.name)
        self._rows[camera.name] = row
        self._cameras.append(camera)
        self.coordinates.append(torch.nn.Parameter(torch.zeros(6, dtype=torch.float64)))
        nothing = torch.zeros(1, 6, 6, dtype=torch.float64)
        self.whitening, self.shifts = torch.cat([self.whitening, nothing]), torch.cat([self.shifts, nothing])
        self._place()
        if begun:
            self._look(row, gaussians, far)

    def forward(self, frame: Frame) -> Frame:
        """The photograph with its camera as it is now; gradients reach its pose."""
        w2c = self._w2c(self._rows[frame.name])
        return dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, w2c=w2c))

    def _w2c(self, row: int) -> torch.Tensor:
        """(4, 4) float64 pose of a photograph as it is now; differentiated."""
        twist = self._twist_of[row] @ self.whitening[row] @ self.coordinates[row]
        return torch.tensor(self._cameras[row].w2c) @ motion(-twist)

    def camera(self, name: str) -> Camera:
        """A photograph's camera at the size of the fit, with the pose as it is now, without a graph."""
        stated = self._cameras[self._rows[name]]
        if not self.has_begun:
            return stated
        with torch.no_grad():  # a number to be read
            w2c = self._w2c(self._rows[name])
        return dataclasses.replace(stated, w2c=w2c.numpy())

    def cameras(self) -> list[Camera]:
        """All cameras of the photographs, as `camera` has them."""
        return [self.camera(name) for name in self.names]

    def hold(self) -> None:
        """Keep the poses within their reach, then hold the gauge, which may move a camera a little past it."""
        self.hold_reach()
        self.hold_gauge()

    def hold_reach(self) -> None:
        """Take every pose back towards the stated one, until its picture moves by the reach at most."""
        if not self.has_begun:
            return
        with torch.no_grad():  # a bound, no step
            u = self._u()
            square = torch.einsum("vi,vij,vj->v", u, self.shifts, u).clamp_min(0)  # 0 but for rounding
            # A pose that is as stated moves nothing, and 0 / 0 would be no number.
            factors = (self.reach / square.sqrt().clamp_min(1e-300)).clamp_max(1)
            for x, factor in zip(self.coordinates, factors, strict=True):
                x *= factor

    def hold_gauge(self) -> None:
        """Take out of all poses what moves, turns or scales all cameras together."""
        if not self.has_begun:
            return
        with torch.no_grad():  # a gauge, no step
            common = self._common @ (self._common.T @ self._u().reshape(-1))
            back = torch.linalg.solve(self.whitening, common.reshape(-1, 6, 1))[..., 0]
            for x, shift in zip(self.coordinates, back, strict=True):
                x -= shift

    def _u(self) -> torch.Tensor:
        """(V, 6) turns and moves of all cameras."""
        return (self.whitening @ torch.stack(list(self.coordinates))[..., None])[..., 0]

    def words(self) -> str:
        """What became of the poses, in one line."""
        moved = self.displacement()
        return (
            f"poses: {moved['cameras']} cameras were turned by {moved['degrees']:.3g} degrees and moved by "
            f"{moved['moved']:.3g} (root mean square, world units); {CAMERAS} has them"
        )

    def displacement(self) -> dict:
        """How far the cameras are from where the data set states them, as `displacement` says it."""
        return displacement(self._cameras, self.cameras())


def displacement(stated: Sequence[Camera], now: Sequence[Camera]) -> dict:
    """How far cameras are from others: how many `cameras`, `degrees` of turns and world units that centers have `moved`
    (root mean squares)."""
    turns, moves = [], []
    for a, b in zip(stated, now, strict=True):
        # |R - I| is 2 sqrt 2 sin(angle / 2); the cosine of a small angle would have lost it.
        chord = float(np.linalg.norm(b.c2w[:3, :3] - a.c2w[:3, :3])) / math.sqrt(8)
        turns.append(math.degrees(2 * math.asin(min(1.0, chord))))
        moves.append(float(np.linalg.norm(b.c2w[:3, 3] - a.c2w[:3, 3])))
    rms = lambda values: float(np.sqrt(np.mean(np.square(values))))  # noqa: E731
    return {"cameras": len(turns), "degrees": rms(turns), "moved": rms(moves)}


def pose_network(poses: Poses) -> Network:
    """Poses of photographs as a part of a fit: their optimizer, rate, reach and gauge."""
    return Network(POSE_NETWORK, poses, _rate, constraint=poses.hold)


def is_due(part: float) -> bool:
    """Whether poses are fitted when the fraction `part` of a fit is done."""
    return _BEGIN <= part < _END


def _rate(part: float) -> float:
    """Learning rate of z: from its first value to 0 while poses are fitted."""
    return _RATE * (_END - part) / (_END - _BEGIN) if is_due(part) else 0.0


def refined_against(scene: Scene, frame: Frame, settings: RenderSettings) -> Camera:
    """The camera of a photograph, refined against it by Gauss-Newton's steps with the scene as it is.

    For measuring only: what a held-out view shows apart from the error of its pose. A step that does not lower the
    squared error, or turns the camera too far for a linear model, is tried again with more damping (Levenberg).

    Args:
        scene: What is shown.
        frame: A photograph with its camera, the first guess.
        settings: Settings of `drgs.render`.
    """
    camera = frame.camera
    twist_of = _twist_of_u(torch.tensor(camera.c2w[:3, 3]), 1.0)
    damping = 1e-3
    error, left = _difference(scene, frame, camera, settings)
    for _ in range(_REFINING_STEPS):
        changes = render_jvp(scene, camera, {"camera": twist_of.T.contiguous()}, settings, outputs=()).rgb.double()
        rows = _inside(changes, frame).reshape(6, -1)
        information = rows @ rows.T
        scaled = information + damping * information.diagonal().diag() + 1e-12 * torch.eye(6, dtype=torch.float64)
        u = torch.linalg.solve(scaled, rows @ left)
        if float(u[:3].norm()) > _MOST_TURN:
            damping *= 10
            continue
        w2c = torch.tensor(camera.w2c) @ motion(-(twist_of @ u))
        moved = dataclasses.replace(camera, w2c=w2c.numpy())
        now, rest = _difference(scene, frame, moved, settings)
        if now < error:
            gained = error - now
            camera, error, left, damping = moved, now, rest, damping / 10
            if gained < 1e-4 * error:
                break
        else:
            damping *= 10
    return camera


def _difference(scene: Scene, frame: Frame, camera: Camera, settings: RenderSettings) -> tuple[float, torch.Tensor]:
    """The squared error of a photograph, and what its pixels lack."""
    with torch.no_grad():  # derivatives are computed in forward mode
        image = render(scene, camera, settings).rgb.cpu()
    left = _inside((frame.image() - image).double(), frame).reshape(-1)
    return float(left @ left), left


def _inside(values: torch.Tensor, frame: Frame) -> torch.Tensor:
    """(..., H, W, 3) values, 0 outside of the mask."""
    return values if frame.mask is None else values * frame.mask.double()[..., None]


def _twist_of_u(center: torch.Tensor, extent: float) -> torch.Tensor:
    """(6, 6) of u -> xi for a camera at `center`: a twist (w, v) moves the center by w x c + v."""
    out = torch.eye(6, dtype=torch.float64)
    out[3:, :3] = cross_matrix(center)  # v = extent u_move + c x w
    out[3:, 3:] *= extent
    return out


def _moved(
    means: torch.Tensor, opacities: torch.Tensor, camera: Camera, extent: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """What a twist of a camera moves its picture by.

    Returns:
        (N, 2, 6) pixels by which the N of `means` (P, 3) in the picture move, and their weights (N,), which are
        opacities (P,). The last of them is a point in the middle of the picture at the distance `extent`, of weight 1:
        a pose has a reach where the picture shows nothing, too.
    """
    w2c = torch.tensor(camera.w2c)
    K = torch.tensor(camera.K)
    middle = torch.tensor([[0.0, 0.0, extent]], dtype=torch.float64)
    inside = torch.cat([means @ w2c[:3, :3].T + w2c[:3, 3], middle])
    weights = torch.cat([opacities, torch.ones(1, dtype=torch.float64)])
    depth = inside[:, 2].clamp_min(1e-12)  # those behind are left out below
    pixels = inside[:, :2] / depth[:, None] * K.diagonal()[:2] + K[:2, 2]
    sides = torch.tensor([camera.width, camera.height])
    seen = (inside[:, 2] > 0) & ((pixels > 0) & (pixels < sides)).all(1)
    seen &= depth >= _NEAR_SHARE * depth[seen].median() if seen.any() else seen
    seen[-1] = True  # an off-center principal point may have put it outside
    inside = inside[seen]
    x, y, depth = inside.unbind(1)
    zero = torch.zeros_like(depth)
    projection = torch.stack(
        [
            torch.stack([K[0, 0] / depth, zero, -K[0, 0] * x / depth**2], 1),
            torch.stack([zero, K[1, 1] / depth, -K[1, 1] * y / depth**2], 1),
        ],
        1,
    )
    # The camera's twist (w, v) moves a point p of the world against it, by -(w x p + v): p x w - v.
    points = (inside - w2c[:3, 3]) @ w2c[:3, :3]
    axes = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    arms = torch.linalg.cross(points[:, None].expand_as(axes), axes).transpose(1, 2)
    against = torch.cat([arms, -axes], 2)
    return projection @ w2c[:3, :3] @ against, weights[seen]


def _common_motions(centers: torch.Tensor, extent: float) -> torch.Tensor:
    """(6 V, 7) orthonormal: the u of all cameras under common turns, moves, and a change of scale."""
    arms = (centers - centers.mean(0)) / extent
    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        columns.append(torch.cat([axis.expand_as(arms), torch.linalg.cross(axis.expand_as(arms), arms)], 1))
    for axis in torch.eye(3, dtype=torch.float64):
        columns.append(torch.cat([torch.zeros_like(arms), axis.expand_as(arms)], 1))
    columns.append(torch.cat([torch.zeros_like(arms), arms], 1))
    return torch.linalg.qr(torch.stack([x.reshape(-1) for x in columns], 1))[0]


def motion(twist: torch.Tensor) -> torch.Tensor:
    """(4, 4) exp of a twist (6,), rotation first; differentiated.

    The series of sin(a) / a, (1 - cos a) / a^2 and (a - sin a) / a^3, whose closed forms lose all digits at 0: within
    1e-12 up to turns of one radian.
    """
    square = twist[:3].square().sum()
    factors = []
    for first in (1, 2, 3):  # 1 / first! - a^2 / (first + 2)! + ...
        terms = [(-1) ** k / math.factorial(first + 2 * k) * square**k for k in range(8)]
        factors.append(torch.stack(terms).sum())
    w = cross_matrix(twist[:3])
    eye = torch.eye(3, dtype=twist.dtype)
    rotation = eye + factors[0] * w + factors[1] * (w @ w)
    along = eye + factors[1] * w + factors[2] * (w @ w)
    top = torch.cat([rotation, (along @ twist[3:])[:, None]], 1)
    return torch.cat([top, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=twist.dtype)])


def refined_scores(scene: Scene, frames: list[Frame], settings: RenderSettings) -> dict:
    """PSNR of views whose cameras are refined against their own photographs first, with the scene as it is.

    What a view lacks apart from the error of its pose: no number to compare with those of other programs.

    Returns:
        `psnr_refined`, the mean in dB, and `views`, a list of name and `psnr_refined`; empty without views.
    """
    views = []
    with Bar("refining held-out cameras", len(frames)) as bar:
        for frame in frames:
            camera = refined_against(scene, frame, settings)
            with torch.no_grad():  # a measure
                image = render(colors_only(scene, camera.time), camera, settings).rgb.cpu().clamp(0, 1)
            views.append({"name": frame.name, "psnr_refined": psnr(image, frame.image(), frame.mask)})
            bar.advance()
    if not views:
        return {}
    return {"psnr_refined": float(np.mean([view["psnr_refined"] for view in views])), "views": views}


class PosesComponent(Component):
    """Poses of training photographs as a part of a fit: `poses` refined, or auto, where the data set says they are off.

    Attributes:
        module: The poses; None where they stay as the data set states them.
        evidence: What the data set says of them; None where nobody looked, and of a fit that is resumed.
    """

    name = "poses"
    option = ("poses", "fixed")
    where = "where poses are optimized"
    files = (CAMERAS,)
    record_kinds = {"poses": {"refined": bool}}
    # A field explains a camera's error as well, and the photographs of one camera at many times have one pose.
    conflicts = (
        Conflict(
            "motion",
            "what moves would explain their errors, too",
            "leave --poses out, or refine them on photographs of what stands still (--dynamics ignore)",
        ),
    )

    def __init__(self) -> None:
        self.module: Poses | None = None
        self.evidence: PoseEvidence | None = None

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        use = setup.config.data.poses
        return None if use == "fixed" else use

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`."""
        use = fit.config.data.poses
        if use == "fixed":
            return
        with Bar("poses") as bar:
            # Observations of views that are not picked yet are not used.
            all_seen = not setup.is_active or fit.config.data.init_points == "all"
            self.evidence = PoseEvidence.of(setup.dataset.reprojection if all_seen else None, fit.frames)
            is_on = use == "refined" or self.evidence.is_clear
            bar.note(f"poses: {self.evidence.words()}; {'refined with the scene' if is_on else 'fixed'}")
        if is_on:
            self.use(fit, self.evidence.reach)

    def use(self, fit: Fit, reach: float = 0.0) -> None:
        """From now on poses are fitted; `reach` as of `Poses`."""
        self.module = Poses([frame.camera for frame in fit.frames], fit.extent, fit.config.settings, reach)
        self.networks = [pose_network(self.module)]
        self.nuisance = "pose"

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`."""
        if POSE_NETWORK in checkpoint.header.get("networks", ()):
            self.use(fit)

    def before_step(self, fit: Fit) -> list[dict]:
        """See `Component`."""
        if self.module is not None and is_due(fit.part) and not self.module.has_begun:
            self.module.begin(fit.gaussians(), fit.rows.far)
        return []

    def frame(self, fit: Fit, frame: Frame) -> Frame:
        """See `Component`: gradients reach the pose while poses are fitted."""
        if self.module is None:
            return frame
        return self.module(frame) if is_due(fit.part) else dataclasses.replace(frame, camera=self.camera(frame))

    def camera(self, frame: Frame) -> Camera:
        """See `Component`."""
        return frame.camera if self.module is None else self.module.camera(frame.name)

    def join(self, fit: Fit, frame: Frame, setup: Setup) -> list[dict]:
        """See `Component`."""
        if (poses := self.module) is not None:
            self.networks[0].extend(lambda: poses.join(frame.camera, fit.gaussians(), fit.rows.far))
        return []

    def write_files(self, folder: Path) -> None:
        """See `Component`."""
        if self.module is not None:
            save_cameras_json(folder / CAMERAS, self.module.cameras())

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        refined = self.module is not None
        if self.evidence is not None:
            return {"poses": self.evidence.to_json(refined)}
        if fit.config.data.poses == "fixed":
            return {}
        # The config.json of a fit that is resumed may have been moved away.
        return {"poses": before.get("poses", {"reprojection": None, "refined": refined})}

    def metrics(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        if self.module is None:
            return {}
        with Bar("poses") as bar:
            bar.note(self.module.words())
        scores = refined_scores(fit.scene(), held_out, fit.config.settings)
        return {"poses": {**self.module.displacement(), **scores}}

    @classmethod
    def run_metrics(cls, run: RunViews) -> dict[str, Any]:
        """See `Component`."""
        if not run.refined:
            return {}
        scores = refined_scores(run.scene, run.held_out, run.settings)
        return {"poses": {**displacement(run.stated, run.cameras), **scores}}
