"""The browser's cameras and Gaussians, as viser's client states and takes them, and ours.

Cameras of both have OpenCV's axes (+x right, +y down, +z forward); only the lens is said otherwise. Gaussians are sent
as centers, covariances in half floats, colors and opacities of 8 bits.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera, intrinsics
from drgs.data.camera_path import quaternion_of, rotation_of
from drgs.ellipsoids import Y_00, Gaussians, semi_axes

_WIDEST = math.radians(150.0)  # widest view of a client; a wider one is drawn so wide
_MAX_WINDOW = 1 << 15  # pixels of a side of a window
_MAX_COORDINATE = 1e30  # world units, largest coordinate: far beyond any scene, and within float32 (3e38)


@dataclasses.dataclass(frozen=True, eq=False)
class Pose:
    """A camera as viser has it, in the client's frame: the world's, moved by the origin of the Gaussians.

    Attributes:
        wxyz: (4,) quaternion of camera to world, not 0.
        position: (3,) center of the camera.
        fov: Vertical field of view in radians.
        aspect: Width over height.
    """

    wxyz: np.ndarray
    position: np.ndarray
    fov: float
    aspect: float

    @classmethod
    def stated(cls, wxyz: Any, position: Any, fov: Any, width: Any, height: Any) -> tuple[Pose, tuple[int, int]] | None:
        """The camera that a client states, and the pixels of its window; None where these are none.

        Whatever the client sent may be here: zeros, NaN, lists of another length, text.

        Args:
            wxyz: Quaternion of camera to world, of any length but 0.
            position: Center of the camera.
            fov: Vertical field of view in radians.
            width, height: Size of the window in pixels, at least 1.
        """
        try:
            given = np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in (wxyz, position, fov, width, height)])
        except (TypeError, ValueError):
            return None
        if given.shape != (10,) or not np.isfinite(given).all() or np.abs(given).max() > _MAX_COORDINATE:
            return None
        quaternion = given[:4]
        place = given[4:7]
        angle, across, down = given[7:]
        length = float(np.linalg.norm(quaternion))
        if (
            length < 1 / _MAX_COORDINATE
            or not 0 < angle < math.pi
            or not 1 <= min(across, down) <= max(across, down) <= _MAX_WINDOW
        ):
            return None
        size = int(across), int(down)
        return cls(quaternion / length, place, float(angle), size[0] / size[1]), size

    def is_near(self, other: Pose | None) -> bool:
        """Whether both show the same picture, to a small part of a pixel."""
        if other is None:
            return False
        reach = 1e-6 * (1.0 + float(np.abs(self.position).max()))  # what the client's float32 loses of a coordinate
        turn = abs(float(self.wxyz @ other.wxyz)) / float(np.linalg.norm(self.wxyz) * np.linalg.norm(other.wxyz))
        return bool(
            np.abs(self.position - other.position).max() < reach
            and 1 - turn < 1e-10
            and abs(self.fov - other.fov) < 1e-6
            and abs(self.aspect - other.aspect) < 1e-6
        )


def camera_of(pose: Pose, width: int, height: int, origin: np.ndarray, time: float | None = None) -> Camera:
    """The drgs camera of the client's view.

    Args:
        pose: Pose of the client's camera.
        width, height: Size of the image in pixels; the vertical field of view is exact, whatever it is.
        origin: (3,) origin of the Gaussians: world coordinates of the client's 0.
        time: Time of the view.
    """
    focal = 0.5 * height / math.tan(0.5 * min(pose.fov, _WIDEST))  # at 180 degrees the tangent is infinite
    K = intrinsics(focal * width / (height * pose.aspect), focal, width / 2, height / 2)
    w2c = np.eye(4)
    w2c[:3, :3] = rotation_of(pose.wxyz).T
    w2c[:3, 3] = -w2c[:3, :3] @ (np.asarray(pose.position, np.float64) + origin)
    return Camera(K=K, w2c=w2c, width=width, height=height, name="view", time=time)


def pose_of(camera: Camera, origin: np.ndarray) -> Pose:
    """The client's pose for a camera's view; an off-center optical axis and a lens are left out.

    Args:
        camera: Camera in the world.
        origin: (3,) origin of the Gaussians: world coordinates of the client's 0.
    """
    c2w = camera.c2w
    fov = 2 * math.atan(0.5 * camera.height / camera.K[1, 1])
    aspect = camera.width * camera.K[1, 1] / (camera.height * camera.K[0, 0])
    return Pose(quaternion_of(c2w[:3, :3]), c2w[:3, 3] - origin, fov, float(aspect))


def looking(pose: Pose, aspect: float) -> float:
    """The vertical field of view in radians in which a window of another shape shows all that a camera sees."""
    tangent = math.tan(0.5 * pose.fov)
    return min(2 * math.atan(tangent * max(1.0, pose.aspect / aspect)), _WIDEST)


_CLIENT_SIGMA = 64.0  # units of the client's lengths that the larger Gaussians have as their standard deviation
_LARGE_QUANTILE = 0.999  # quantile of the sizes that says which Gaussians those are
_MAX_COVARIANCE = 60_000.0  # largest entry of a covariance: half floats end at 65,504
_MIN_SIZE = 1e-30  # smallest size of the larger Gaussians, in the world's unit: its inverse is a float32, too


@dataclasses.dataclass(frozen=True, eq=False)
class ClientGaussians:
    """The arrays that viser's `add_gaussian_splats` takes.

    The client keeps covariances as half floats, from 6e-5 to 65,504 with all their digits: lengths are therefore
    multiplied so that a Gaussian of nearly the largest has a standard deviation of 64, and all down to 1/8000 of that
    are drawn as they are, those above 3.8 times that as large. All of it is finite, whatever the Gaussians are.

    Attributes:
        centers: (N, 3) float32, relative to the origin, in the client's lengths.
        covariances: (N, 3, 3) float32, in the client's lengths squared.
        rgbs: (N, 3) uint8 colors.
        opacities: (N, 1) float32 in [0, 1].
        scale: World units of a client's length, 1 / the factor that lengths were multiplied by.
    """

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray
    scale: float

    @classmethod
    def of(cls, g: Gaussians, rgbs: np.ndarray | None = None) -> ClientGaussians:
        """Convert Gaussians; they are sent relative to their origin.

        Args:
            g: Gaussians at one time.
            rgbs: (N, 3) uint8 colors; None: their color of degree 0, which is the mean over all directions.
        """
        with torch.no_grad():  # what a browser is sent has no derivative, and NumPy takes no tensor that has one
            scales = g.scales.double()  # may be infinite: float32 ends at the exponential of 88
            sizes = scales.amax(1).cpu().numpy()
            large = float(np.quantile(sizes, _LARGE_QUANTILE)) if len(sizes) else 1.0
            factor = _CLIENT_SIGMA / large if _MIN_SIZE < large < 1 / _MIN_SIZE else 1.0
            # An infinite scale times a 0 of the rotation would be NaN; the products stay below half floats' end.
            axes = semi_axes(g.quats.double(), (scales * factor).clamp_max(_MAX_COVARIANCE**0.5))
            covariances = (axes @ axes.transpose(1, 2)).float().clamp(-_MAX_COVARIANCE, _MAX_COVARIANCE).cpu().numpy()
            if rgbs is None:
                color = (0.5 + Y_00 * g.sh[:, 0]).clamp(0, 1)  # bytes would wrap around
                rgbs = (255 * color).round().to(torch.uint8).cpu().numpy()
            # Beyond float32 a center would be infinite, which the client draws nothing of, neighbors included.
            centers = (g.means.double() * factor).clamp(-_MAX_COORDINATE, _MAX_COORDINATE).float().cpu().numpy()
            opacities = g.opacities.float()[:, None].cpu().numpy()
        return cls(centers, covariances, rgbs, opacities, 1.0 / factor)
