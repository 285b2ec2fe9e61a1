"""Cameras, and the one place where camera conventions convert.

Conventions, stated once for the whole project:

- Camera axes are OpenCV's: +x right, +y down, +z forward (COLMAP and gsplat agree).
- `w2c` (4,4) maps homogeneous world points to camera points, `c2w` is its inverse.
- `K` (3,3) is `[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]` in pixels. The image spans [0, width] x [0, height]; the
  center of pixel (column i, row j) lies at (i + 0.5, j + 0.5). Resizing an image by s therefore multiplies fx, cx (and
  fy, cy) by s exactly. OpenCV functions that resample images count pixel centers at integers, so they get
  `cx - 0.5, cy - 0.5`; functions on points need no shift.
- Lens models are those of lenses.py. Distortion is OpenCV's: model `opencv` with (k1, k2, p1, p2[, k3[, k4, k5, k6[,
  s1, s2, s3, s4]]]), model `opencv_fisheye` with (k1, k2, k3, k4) on the angle; `pinhole` has none. `ftheta`, which is
  NVIDIA's, has (k1, ..., k5, c, d, e): r = k1 a + ... + k5 a^5 of the angle a to the axis, in the direction of (x, y),
  times [[c, d], [e, 1]], then K; `ftheta_inverse` has the same with a = k1 r + ... + k5 r^5. `equirectangular` has
  none: K takes (longitude, latitude), in radians, to pixels, so that fx = width / (2 pi), fy = height / pi and a
  principal point in the middle make a panorama of 360 degrees.
- Other frames are converted at the border by the functions here: OpenGL / Blender / Nerfstudio cameras (+x right, +y
  up, looking along -z), LLFF `poses_bounds` columns (down, right, backward) and Mitsuba cameras (+x left, +y up,
  looking along +z). World axes never change, only the camera's.
"""

from __future__ import annotations

import dataclasses
import numbers
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drgs.cameras.checks import (
    IMAGE_MAX,
    as_numpy,
    check_proportions,
    check_shutter,
    check_turn,
    checked_distortion,
    checked_intrinsics,
    checked_pose,
    checked_time,
    is_tensor,
    read_only,
)
from drgs.cameras.lenses import LENS_MODELS
from drgs.cameras.origins import decimals
from drgs.cameras.shutters import BY_COLUMN, FORWARD, line_poses, line_times, points_in_moving_camera, turn_between
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.runtime import uncompiled

__all__ = [
    "Camera",
    "at_first_time",
    "c2w_from_llff",
    "c2w_from_opengl",
    "c2w_to_mitsuba",
    "c2w_to_opengl",
    "camera_list",
    "cameras_of_one_size",
    "check_camera",
    "intrinsics",
    "intrinsics_from_fov",
    "look_at",
    "orbit",
    "places_in_time",
    "rigid",
    "some_cameras",
]

_ROUNDING = 1e-14  # of a float64 rotation; what is less orthonormal was rounded in a file or an optimizer
# An undistorted pixel must come back to itself; beyond this many pixels the lens model has no inverse there.
_INVERSE_TOLERANCE = 1e-3
_SHOWN = 80  # characters of a name in messages
# Which line of a rolling shutter sees a point is solved by turns: pose of the line, line of the projection.
_SHUTTER_ROUNDS = 30  # at most
_SAME_LINE = 1e-8  # lines; a smaller change between two rounds ends them


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera: intrinsics, pose, image size and lens. See the module text for conventions.

        K = drgs.cameras.intrinsics(60.0, 60.0, 32.0, 24.0)
        pose = drgs.cameras.look_at((3, 0, -1), target=(0, 0, 0), up=(0, -1, 0))
        camera = drgs.Camera(K, pose, width=64, height=48)

    Attributes:
        K: (3,3) float64 intrinsics in pixels.
        w2c: (4,4) world to camera; float64 NumPy, or a torch tensor, kept as it is so that gradients reach it. A
            rotation that rounding has left not quite orthonormal is read as the nearest one, and the camera stays
            where it is; see `rigid`.
        width, height: Image size in pixels.
        model: `pinhole`, `opencv`, `opencv_fisheye`, `ftheta`, `ftheta_inverse` or `equirectangular`.
        distortion: Coefficients of the model, in the order above; empty for `pinhole` and `equirectangular`.
        name: Name in messages and of files.
        time: Time at which the view was taken, in the scene's unit of time (0 to 1 over a sequence in most data sets),
            or None where that does not matter.
        shutter: One of `drgs.cameras.shutters.SHUTTERS`: `global`, or which way lines of the image are exposed while
        the camera
            moves from w2c to w2c_end, e.g. `rolling_top_to_bottom`.
        w2c_end: (4,4) world to camera when the last line is exposed, as w2c; None of a global shutter. The pose of each
            line is between the two: shutters.py.
    Raises:
        ValueError: K, w2c, size, model, distortion, time or shutter is not what it must be.
    """

    K: np.ndarray
    w2c: Any
    width: int
    height: int
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()
    name: str = ""
    time: float | None = None
    shutter: str = "global"
    w2c_end: Any = None

    @uncompiled
    def __post_init__(self) -> None:
        must_be("Camera", "name", self.name, str, "it becomes a file name")
        where = f"Camera {self.name[:_SHOWN]!r}" if self.name else "Camera"
        put = lambda field, value: object.__setattr__(self, field, value)  # noqa: E731 (the dataclass is frozen)
        put("K", checked_intrinsics(where, self.K))
        check_shutter(where, self.shutter, self.w2c_end)
        for name in ("w2c", *(["w2c_end"] if self.is_rolling else [])):
            pose = checked_pose(where, getattr(self, name), name)
            if is_tensor(getattr(self, name)):
                continue
            if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > _ROUNDING:
                pose = pose.copy()
                pose[:3, :3], pose[:3, 3] = rigid(pose)
            put(name, read_only(pose))
        if self.is_rolling:
            check_turn(where, float(np.linalg.norm(turn_between(self._rigid()[0], self._rigid("w2c_end")[0]))))
        for axis in ("width", "height"):
            value = getattr(self, axis)
            is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
            if not (is_number and 1 <= value < np.inf and int(value) == value):
                raise ValueError(f"{where}: {axis} must be a whole number of pixels >= 1, got {value!r}; correct it")
            put(axis, int(value))
        if self.width * self.height > IMAGE_MAX:
            shown = "x".join(str(side) if side <= 10**12 else "10^12 or more" for side in (self.width, self.height))
            raise ValueError(f"{where}: an image must have at most 2^31 pixels, got {shown}; correct its size")
        check_proportions(where, self.K, (self.width, self.height))
        put("distortion", checked_distortion(where, self.model, self.distortion))
        put("time", checked_time(where, self.time))

    @property
    def c2w(self) -> np.ndarray:
        """(4,4) float64 camera to world (detached)."""
        rotation, translation = self._rigid()
        c2w = np.eye(4)
        c2w[:3, :3] = rotation.T
        c2w[:3, 3] = -rotation.T @ translation
        return c2w

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 camera center in the world (detached)."""
        return self.c2w[:3, 3]

    @property
    def is_distorted(self) -> bool:
        """Whether the lens differs from a pinhole (a fisheye with zero coefficients still does)."""
        return LENS_MODELS[self.model].guide != "plane" or any(self.distortion)

    @property
    def is_rolling(self) -> bool:
        """Whether lines of the image are exposed one after the other, each from a pose of its own."""
        return self.shutter != "global"

    @property
    def lens_parameters(self) -> np.ndarray:
        """(5 + D,) float64: fx, fy, cx, cy, skew, and the D coefficients of the distortion."""
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *self.distortion])

    def with_lens(self, parameters: Any) -> Camera:
        """The same camera with other `lens_parameters`, an array or a tensor (detached)."""
        values = np.asarray(as_numpy(parameters), np.float64)
        expected = 5 + len(self.distortion)
        if values.shape != (expected,):
            raise ValueError(
                f"Camera.with_lens: parameters must have shape ({expected},) as lens_parameters of a {self.model} "
                f"camera with {len(self.distortion)} coefficients, got {values.shape}; see Camera.lens_parameters"
            )
        fx, fy, cx, cy, skew, *distortion = values.tolist()
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return dataclasses.replace(self, K=K, distortion=tuple(distortion))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with an image of another size; K is scaled exactly. Itself if it has that size."""
        if (width, height) == (self.width, self.height):
            return self
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return dataclasses.replace(self, K=scale @ self.K, width=width, height=height)

    def undistorted(self) -> Camera:
        """The pinhole camera of the same K, size and pose. Itself if it is one."""
        if self.model == "pinhole":
            return self
        return dataclasses.replace(self, model="pinhole", distortion=())

    def relative_to(self, origin: np.ndarray) -> Camera:
        """The same camera in a world whose 0 is `origin` (3,), as means of Gaussians are; itself if that is 0.

        A rolling shutter has the same poses at its first and its last line (between them: shutters.py). Gradients of a
        pose that is a tensor pass.
        """
        origin = np.asarray(origin, np.float64)
        if not origin.any():
            return self
        poses = ("w2c", "w2c_end") if self.is_rolling else ("w2c",)
        return dataclasses.replace(self, **{name: _relative(getattr(self, name), origin) for name in poses})

    def pixel_directions(self) -> np.ndarray:
        """(H,W,3) float64 unit world directions through the pixel centers, lens and shutter included.

        Warns, with their number, about pixels that the lens model cannot undistort.
        """
        local = self.local_directions()
        # Not `@`: the threads of NumPy's BLAS spin for 25 ms after it, on the cores that render next.
        if not self.is_rolling:
            return np.einsum("hwk,jk->hwj", local, self.c2w[:3, :3])
        turns = self.line_poses()[:, :3, :3]
        return np.einsum("hwk,wkj->hwj" if self.shutter in BY_COLUMN else "hwk,hkj->hwj", local, turns)

    def pixel_origins(self) -> np.ndarray:
        """(H,W,3) float64 points that the rays of `pixel_directions` start from: the camera center, of a rolling
        shutter that of each line.
        """
        if not self.is_rolling:
            return np.broadcast_to(self.center, (self.height, self.width, 3))
        poses = self.line_poses()
        centers = -np.einsum("tkj,tk->tj", poses[:, :3, :3], poses[:, :3, 3])
        by_line = centers[None] if self.shutter in BY_COLUMN else centers[:, None]
        return np.broadcast_to(by_line, (self.height, self.width, 3))

    def line_poses(self) -> np.ndarray:
        """(T,4,4) float64 poses of the lines of a rolling shutter (detached)."""
        start, end = (_homogeneous(*self._rigid(name)) for name in ("w2c", "w2c_end"))
        return line_poses(start, end, line_times(self.shutter, self.width, self.height))

    def local_directions(self) -> np.ndarray:
        """(H,W,3) float64 unit directions through the pixel centers in camera axes, lens included; warns as
        `pixel_directions`.
        """
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        return self._camera_directions(pixels).reshape(self.height, self.width, 3)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points, lens included.

        Args:
            points: (P,3) world points.
        Returns:
            pixels (P,2) float64 and camera z (P,). Pixels are NaN where z <= 0, except for fisheye lenses and
            panoramas, which may see behind themselves. Of a rolling shutter, where a line sees the point at the pose
            that it has itself; z is of that pose.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        rotation, translation = self._rigid()
        if not self.is_rolling:
            local = points @ rotation.T + translation
            return self._project_local(local), local[:, 2]
        start, end = (_homogeneous(*self._rigid(name)) for name in ("w2c", "w2c_end"))
        axis, lines = (0, self.width) if self.shutter in BY_COLUMN else (1, self.height)
        at = points_in_moving_camera(start, end, points)
        times = np.full(len(points), 0.5)
        for _ in range(_SHUTTER_ROUNDS):
            local = at(times)
            pixels = self._project_local(local)
            found = (pixels[:, axis] - 0.5) / (lines - 1) if lines > 1 else times
            found = found if self.shutter in FORWARD else 1 - found
            found = np.where(np.isfinite(found), np.clip(found, 0.0, 1.0), times)
            moved = np.abs(found - times).max(initial=0.0) * lines
            times = found
            if moved < _SAME_LINE:
                break
        return pixels, local[:, 2]

    def contains(self, pixels: np.ndarray, depth: np.ndarray | None = None, margin: float = 0.0) -> np.ndarray:
        """(P,) bool: which pixels, as `project` gives them, lie in the image.

        Args:
            pixels: (P,2); NaN lies nowhere.
            depth: (P,) camera z: what is not in front of the camera is not in its image. None, to leave that to the
                lens: fisheyes and panoramas see behind themselves.
            margin: Pixels that they must lie from the border; negative: that they may lie beyond it.
        """
        size = np.array([self.width, self.height])
        inside = np.all((pixels >= margin) & (pixels < size - margin), axis=1)
        return inside if depth is None else np.logical_and(depth > 0, inside)

    def to_mitsuba(self, near: float = 1e-2, far: float = 1e4) -> dict:
        """A Mitsuba `perspective` sensor as a dictionary for `mi.load_dict` (box filter, one sample a pixel).

        Mitsuba's film has square pixels, so fx and fy may differ by no more than 0.1 pixel at the image border.

        Args:
            near, far: Clip distances in scene units. Mitsuba's rays start at the near plane.
        Raises:
            ValueError: the camera is distorted, skewed or has pixels that are not square.
        """
        import mitsuba as mi

        fx, fy = self.K[0, 0], self.K[1, 1]
        problem = None
        if self.is_distorted:
            problem = f"an undistorted camera, got model {self.model}; use camera.undistorted()"
        elif self.is_rolling:
            problem = f"a global shutter, got {self.shutter}; trace camera.pixel_origins() and pixel_directions()"
        elif self.K[0, 1] != 0.0:
            problem = f"zero skew, got {self.K[0, 1]:g}; trace camera.pixel_directions()"
        elif abs(fx / fy - 1.0) * self.height / 2 > 0.1:
            problem = f"square pixels, got fx {fx:g}, fy {fy:g}; trace camera.pixel_directions()"
        if problem:
            raise ValueError(f"Camera.to_mitsuba: Mitsuba's perspective sensor needs {problem}")
        return {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(c2w_to_mitsuba(self.c2w)),
            "fov_axis": "x",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * self.width / fx))),
            # Mitsuba offsets the film against the axis, not the axis on the film: both signs turn.
            "principal_point_offset_x": float(0.5 - self.K[0, 2] / self.width),
            "principal_point_offset_y": float(0.5 - self.K[1, 2] / self.height),
            "near_clip": near,
            "far_clip": far,
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": 1},
        }

    def _rigid(self, name: str = "w2c") -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3,3) and translation (3,) of w2c, or of w2c_end, in float64 (detached)."""
        pose = getattr(self, name)
        w2c = as_numpy(pose).astype(np.float64)
        return rigid(w2c) if is_tensor(pose) else (w2c[:3, :3], w2c[:3, 3])

    def _camera_directions(self, pixels: np.ndarray) -> np.ndarray:
        """(P,3) unit directions in the camera's frame through pixels (P,2)."""
        directions = LENS_MODELS[self.model].unproject(self._normalized(pixels), self.distortion)
        if self.is_distorted:
            error = np.linalg.norm(self._project_local(directions) - pixels, axis=1)
            bad = int(np.count_nonzero(~(error < _INVERSE_TOLERANCE)))
            if bad:
                warnings.warn(
                    f"Camera {self.name[:_SHOWN]!r}: the {self.model} lens cannot be inverted at {bad} of "
                    f"{len(pixels)} pixels; their rays are approximate, mask them or check the coefficients",
                    stacklevel=3,
                )
        return directions

    def _project_local(self, local: np.ndarray) -> np.ndarray:
        """Pixels (P,2) of camera-frame points (P,3)."""
        plane = LENS_MODELS[self.model].project(local, self.distortion)
        return plane @ self.K[:2, :2].T + self.K[:2, 2]

    def _normalized(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (P,2) on the image plane at z = 1, the lens still in them."""
        y = (pixels[:, 1] - self.K[1, 2]) / self.K[1, 1]
        x = (pixels[:, 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return np.stack([x, y], axis=-1)


# -------------------------------------------------- poses


def _homogeneous(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(4,4) of a rotation and a translation."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def _relative(pose: Any, origin: np.ndarray) -> Any:
    """(4,4) of the pose that takes x where `pose` takes x + origin; in float64, for far from 0 the two cancel."""
    if is_tensor(pose):
        pose = pose.double()
        shift, last = pose.new_tensor(origin.tolist()), pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    else:
        shift, last = origin, np.array([0.0, 0.0, 0.0, 1.0])
    return pose + (pose[:, :3] @ shift)[:, None] * last


def rigid(w2c: Any) -> tuple[Any, Any]:
    """The rigid motion that a world-to-camera matrix means: nearest rotation (3,3) and translation (3,).

    Files and float32 leave rotations orthonormal to 1e-5 or 1e-7 only. Then R^-1 and R^T are two things, and whoever
    takes rays from one and projections from the other sees two pictures: of a camera 100 units from the origin they
    differ by tenths of a pixel. The camera stays where it is, at the point that w2c maps to 0.

    Args:
        w2c: (4,4) or (3,4), NumPy or torch; gradients pass, and what they have across rigid motions is gone.
    """
    R = w2c[:3, :3]
    t = w2c[:3, 3]
    inverse, rotation = R.T, R
    for _ in range(3):  # Newton's iterations: an error e becomes e^2
        inverse = 2 * inverse - inverse @ R @ inverse
        rotation = 1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation
    return rotation, rotation @ (inverse @ t)


# -------------------------------------------------- frames

_OPENGL_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_MITSUBA_FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


def c2w_from_opengl(c2w: np.ndarray) -> np.ndarray:
    """OpenGL / Blender / Nerfstudio camera-to-world (4,4) to OpenCV's."""
    return np.asarray(c2w, dtype=np.float64) @ _OPENGL_FLIP


def c2w_to_opengl(c2w: np.ndarray) -> np.ndarray:
    """OpenCV camera-to-world (4,4) to OpenGL's (also Blender's and Nerfstudio's)."""
    return np.asarray(c2w, dtype=np.float64) @ _OPENGL_FLIP


def c2w_from_llff(pose: np.ndarray) -> np.ndarray:
    """LLFF pose (3,4) or (3,5), camera axes in columns (down, right, backward), to an OpenCV camera-to-world (4,4)."""
    pose = np.asarray(pose, dtype=np.float64)
    c2w = np.eye(4)
    c2w[:3, 0] = pose[:, 1]
    c2w[:3, 1] = pose[:, 0]
    c2w[:3, 2] = -pose[:, 2]
    c2w[:3, 3] = pose[:, 3]
    return c2w


def c2w_to_mitsuba(c2w: np.ndarray) -> np.ndarray:
    """OpenCV camera-to-world (4,4) to Mitsuba's `to_world`."""
    return np.asarray(c2w, dtype=np.float64) @ _MITSUBA_FLIP


# -------------------------------------------------------------------------------------------------
# making cameras


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """(3,3) float64 K from focal lengths and principal point in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=np.float64)


def intrinsics_from_fov(fov: float, width: int, height: int, axis: str = "x") -> np.ndarray:
    """(3,3) K of a centered camera with square pixels.

    Args:
        fov: Full field of view along `axis` in degrees, between 0 and 180.
        width, height: Image size in pixels.
        axis: `x` or `y`.
    """
    if not 0.0 < fov < 180.0:
        raise ValueError(f"intrinsics_from_fov: fov must lie between 0 and 180 degrees, got {fov}; correct it")
    if axis not in ("x", "y"):
        raise ValueError(f"intrinsics_from_fov: axis must be x or y, got {axis!r}; choose one")
    focal = 0.5 * (width if axis == "x" else height) / np.tan(np.radians(fov) / 2)
    return intrinsics(focal, focal, width / 2, height / 2)


def look_at(eye: Any, target: Any, up: Any = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(4,4) float64 w2c of a camera at `eye` looking at `target`, `up` (world) pointing up in its image."""
    eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
    forward = target - eye
    right = np.cross(forward, up)
    # Below this angle between the two, in radians, rounding decides what is right.
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise ValueError(
            f"look_at: eye, target and up must not lie on one line, got {eye}, {target}, {up}; move one of them"
        )
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    w2c[:3, 3] = -rotation @ eye
    return w2c


def orbit(
    center: Any,
    radius: float,
    n: int,
    elevation: float = 20.0,
    *,
    width: int = 640,
    height: int = 480,
    fov: float = 45.0,
    up: Any = (0.0, 0.0, 1.0),
) -> list[Camera]:
    """Cameras on a circle around a point, all looking at it.

    Args:
        center: (3,) the point looked at.
        radius: Distance of every camera from it, in scene units.
        n: Number of cameras, evenly spaced; the last one does not repeat the first.
        elevation: Degrees above the plane through `center` that is orthogonal to `up`.
        width, height: Image size in pixels.
        fov: Horizontal field of view in degrees.
        up: (3,) world direction that points up; scenes straight out of COLMAP usually have (0, -1, 0).
    """
    if n < 1 or not radius > 0:
        raise ValueError(f"orbit: n must be >= 1 and radius > 0, got {n} and {radius}; correct them")
    center = np.asarray(center, dtype=np.float64)
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    # Any direction orthogonal to up serves as azimuth 0; the world axis least aligned with up is
    # the stable choice.
    first = np.cross(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]), axis)
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    K = intrinsics_from_fov(fov, width, height)
    rise = np.radians(elevation)
    cameras = []
    for index in range(n):
        turn = 2 * np.pi * index / n
        outward = np.cos(rise) * (np.cos(turn) * first + np.sin(turn) * second) + np.sin(rise) * axis
        w2c = look_at(center + radius * outward, center, axis)
        cameras.append(Camera(K=K, w2c=w2c, width=width, height=height, name=f"orbit_{index:04d}"))
    return cameras


def places_in_time(cameras: Sequence[Camera]) -> np.ndarray:
    """Where cameras stand, and when, in numbers whose distances can be compared.

    Args:
        cameras: Cameras, at least one of them; what has no time has time 0.
    Returns:
        (N, 4) center and time, each divided by its own range: the largest distance between two centers is as far as
        the first time is from the last one.
    """
    centers = np.stack([camera.center for camera in cameras])
    times = np.array([[camera.time or 0.0] for camera in cameras])
    size = max(float(np.linalg.norm(centers - center, axis=1).max()) for center in centers)
    return np.c_[centers / (size or 1.0), times / (float(np.ptp(times)) or 1.0)]


def at_first_time(cameras: Sequence[Camera]) -> list[int]:
    """Indices of the cameras at the first time, where these show the scene; else, or without times, of all.

    Synchronous cameras are all there at the first time. Of one that walks around, or of a few that go together, the
    first time shows little, and all times show what stands still, which is most of a scene: held-out views of a kitchen
    with free poses had 16.3 dB by the first time and 20.8 by all.

    Args:
        cameras: Cameras, at least one.
    Returns:
        Of those at the first time, where they are at several places, and at half of all places or more.
    """
    times = sorted({camera.time for camera in cameras if camera.time is not None})
    every = list(range(len(cameras)))
    if len(times) < 2:
        return every
    first = [i for i in every if cameras[i].time == times[0]]
    centers = np.stack([camera.center for camera in cameras])
    centers = centers.round(decimals(centers))
    places, others = (len(np.unique(some, axis=0)) for some in (centers[first], centers))
    return first if places > 1 and 2 * places >= others else every


# -------------------------------------------------- checks of arguments

_MAKE = "drgs.Camera(K=K, w2c=w2c, width=width, height=height) makes one"


def check_camera(where: str, camera: Any) -> None:
    """Raise `ArgumentError` unless this is one Camera; a list of them gets the advice to loop over it."""
    several = isinstance(camera, list | tuple) and all(isinstance(x, Camera) for x in camera)
    hint = f"it takes one view at a time: [drgs.{where}(..., camera, ...) for camera in cameras]"
    must_be(where, "camera", camera, Camera, hint if several else _MAKE)


def camera_list(where: str, name: str, cameras: Any) -> list[Camera]:
    """One Camera or several as a list; `ArgumentError` for anything else."""
    if isinstance(cameras, Camera):
        return [cameras]
    if isinstance(cameras, str | bytes | dict) or not isinstance(cameras, Iterable):
        raise ArgumentError(f"{where}: {name} must be a Camera or a list of them, got {kind_of(cameras)}; {_MAKE}")
    cameras = list(cameras)
    for index, camera in enumerate(cameras):
        must_be(where, f"{name}[{index}]", camera, Camera, _MAKE)
    return cameras


def some_cameras(where: str, cameras: Any) -> list[Camera]:
    """The same, at least one; ValueError for none."""
    cameras = camera_list(where, "cameras", cameras)
    if not cameras:
        raise ValueError(f"{where}: there must be at least one camera, got none; pass one or more")
    return cameras


def cameras_of_one_size(where: str, cameras: Any) -> list[Camera]:
    """A list of at least one Camera, all of one image size; the first one that differs is named."""
    cameras = camera_list(where, "camera", cameras)
    if not cameras:
        raise ArgumentError(f"{where}: a list of cameras must have at least one, got none; pass one or more")
    sizes = [(camera.width, camera.height) for camera in cameras]
    for index, (width, height) in enumerate(sizes):
        if (width, height) != sizes[0]:
            raise ArgumentError(
                f"{where}: cameras of a list must have one image size, got {sizes[0][0]}x{sizes[0][1]} and "
                f"camera[{index}] with {width}x{height}; render each size by itself"
            )
    return cameras
