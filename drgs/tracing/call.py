"""One call of the renderer: its tensors, what Dr.Jit makes of them, and the images in torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import drjit as dr
import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera
from drgs.checks.arguments import ArgumentError, kind_of, must_be
from drgs.checks.derivatives import check_has_numbers, unwrapped
from drgs.ellipsoids import DeformableScene, Gaussians
from drgs.runtime import memory
from drgs.settings import EPS_ALPHA, RenderSettings
from drgs.tracing import projection, recordings
from drgs.tracing.arrays import UInt32
from drgs.tracing.composite import Arguments, Composite, Compositor, compositor_of
from drgs.tracing.frames import Frame, View
from drgs.tracing.free_rays import FreeRays
from drgs.tracing.lens_motion import LensMotion
from drgs.tracing.lens_rays import lens_of
from drgs.tracing.pose import local_directions, rigid_pose, shifted
from drgs.tracing.primitives import Screen
from drgs.tracing.responses import response_of
from drgs.tracing.shutter import rolling_view
from drgs.tracing.tiles import TILE, TileTraversal
from drgs.tracing.unscented import unscented_boxes
from drgs.tracing.walk import Traversal

OF_VIEW = (
    "w2c",
    "ray_origins",
    "ray_directions",
    "ray_shifts",
    "mean_offsets",
    "mean_absolute",
    "strains",
)  # inputs that are no parameters of the scene
_RECORDED_INPUTS = {"means", "quats", "log_scales", "logit_opacities", "sh", "w2c"}
_RECORDED_OUTPUTS = {"depth", "median", "count"}


@dataclasses.dataclass(frozen=True, eq=False)
class Output:
    """The images of one view (torch tensors; None where not in `outputs`); of a list of views with a leading axis.
    t* is the distance along the ray at which a Gaussian is hit, w its weight, T the transmittance.

    Attributes:
        rgb: (H, W, 3) linear blend of the colors, background included, not clamped.
        alpha: (H, W) sum w = 1 - T_end.
        depth: (H, W) sum w t* / max(alpha, 1e-10), distance along the ray (`ewa`: the Gaussians' own depth).
        median_depth: (H, W) t* where T first falls to 0.5, 0 where it never does; not differentiated.
        count: (H, W) int32, composited hits.
        visibility: (N,) sum of w over all pixels; not differentiated.
        features: (H, W, D) when the Gaussians have features.
        certificate: Counters: `pairs`, entries of the lists of tiles; `rays`, and `redone`, rays that were traced again
            because their buffer of hits was too short for exact order. Absent where they do not apply; a list of them
            for a list of views.
    """

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    count: torch.Tensor | None = None
    visibility: torch.Tensor | None = None
    features: torch.Tensor | None = None
    certificate: dict | list[dict] = dataclasses.field(default_factory=dict)


class Call:
    """One call of `render`.

    Args:
        gaussians: Gaussians at the time of the view.
        camera: None where there are rays.
        want: Extra outputs: `depth`, `median`, `count`, `visibility`.
        rays: Origins and directions, (..., 3) each, instead of the camera's.
        scene: The scene that the Gaussians are of, if derivatives by its parameters are wanted instead of by theirs.
        timed: Whether derivatives by the scene's time are wanted, too.
        couple: The argument `couple_features` of `render`.
        lens: The camera's `lens_parameters`, if derivatives by them are wanted.
        pixel_rays: (H, W, 6) origin and direction of each pixel, in the world, instead of those that the camera has.
        of_means: `mean_offsets`, `mean_absolute` and `strains` of `drgs.integrator.render_with_offsets`, by name; None
            of those that are not wanted.
        oriented: The features, (N, 3), are axes that are turned towards each ray: `Channels.oriented`.
    Attributes:
        inputs: Torch tensors by name, what is differentiated: raw parameters of the Gaussians or of the scene, perhaps
            `time`, `w2c` (12 floats), rays where they are traced.
        field: Takes the scene's parameters to the Gaussians'; None where inputs are those of the Gaussians themselves.
        shape: Shape of the images: (H, W), or that of the rays.
        extra: Outputs without a derivative, after `trace`.
        certificate: What becomes `Output.certificate`, after `trace`.
        pixel_rays: Float64 of the argument.
        motion: How rays move with the lens, if derivatives by it are wanted.
        free: Pixels have rays without a common origin.
        origin: (3,) float64, what was taken off the world: x_world = x + origin.
        zero: (3,) float64, the Gaussians' own origin, about which a rolling shutter's poses are interpolated.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera | None,
        settings: RenderSettings,
        want: frozenset,
        rays=None,
        scene: DeformableScene | None = None,
        couple: bool = True,
        timed: bool = False,
        lens: torch.Tensor | None = None,
        pixel_rays: torch.Tensor | np.ndarray | None = None,
        of_means: Mapping[str, torch.Tensor | None] | None = None,
        oriented: bool = False,
    ):
        self.lib = runtime.dr_types()
        self.settings = settings
        self.camera = camera
        self.want = want
        must_be("render", "couple_features", couple, bool, "True or False")
        self.couple = couple
        self.oriented = oriented
        self.free = camera is not None and (pixel_rays is not None or camera.is_rolling)
        if settings.planar:
            _check_planar(settings, camera, self.free, pixel_rays is not None)
        self.pixel_rays = None if pixel_rays is None else numbers("render", "rays", pixel_rays)
        self.table: FreeRays | None = None
        self.holes: UInt32 | None = None
        self.home = torch.device("cuda") if runtime.backend().name == "cuda" else torch.device("cpu")
        if rays is not None:
            rays = checked_rays(*rays, settings)
        self._check_memory(gaussians, rays)
        gaussians.validate("render")
        self.device = gaussians.means.device
        self.zero = torch.from_numpy(np.array(gaussians.origin, np.float64))
        middle = None
        if (settings.traversal == "bvh" or self.free) and gaussians.means.dtype == torch.float64 and len(gaussians):
            # World records are float32, so a world far from 0 is moved there; where to has no derivative.
            middle = gaussians.means.detach().mean(0)
            origin = np.asarray(gaussians.origin, np.float64) + [float(x) for x in middle]
            gaussians = gaussians.replace(means=gaussians.means - middle, origin=origin)
        given = gaussians.parameters()
        self.field = None
        if scene is not None:
            fields = given
            given = {name: self._move(x) for name, x in scene.parameters().items()}
            _check_names(given)
            fixed = {name: x for name, x in given.items() if not x.is_floating_point()}
            given = {name: x for name, x in given.items() if name not in fixed}
            if timed:
                given["time"] = torch.tensor(float(camera.time), dtype=torch.float64)
            from drgs.tracing.field import Field  # only scenes that move need it

            self.field = Field(scene, camera.time, fields, middle, fixed)
        self.inputs = {name: self._move(x) for name, x in given.items()}
        self.inputs |= {name: self._move(x) for name, x in (of_means or {}).items() if x is not None}
        self.count = len(gaussians)
        self.coefficients = gaussians.sh.shape[1]
        self.width = 0 if gaussians.features is None else gaussians.features.shape[1]
        self.origin = torch.from_numpy(np.asarray(gaussians.origin, np.float64))
        pose = self._set_pose_and_rays(rays, lens)
        self.inputs["w2c"] = self._move(shifted(pose, self.origin))
        self.pixels = int(np.prod(self.shape))
        self.extra = {}
        self.certificate = {}

    def _set_pose_and_rays(self, rays, lens: torch.Tensor | None) -> torch.Tensor:
        """Set the shape, and rays where they are traced; returns the pose whose depths count.

        Args:
            rays, lens: Arguments of the call.
        """
        camera, settings = self.camera, self.settings
        if rays is not None:
            o, d = rays
            self.shape = tuple(d.shape[:-1])
            o, d = o.reshape(-1, 3), torch.nn.functional.normalize(d.reshape(-1, 3), dim=1)
            # Rays have no camera: depth keys are of the first origin, and so are colors that are the same for all rays.
            seen_from = o[0].detach() if len(o) else torch.zeros(3, dtype=torch.float64)
            if self.coefficients > 1 and settings.sh_direction == "gaussian" and len(o):
                if bool((o != seen_from).any()):
                    raise ValueError(
                        "render_rays: origins must be one and the same with SH of degree 1 to 3 and "
                        "sh_direction='gaussian', which has one color for all rays, got several; use "
                        "settings.replace(sh_direction='ray')"
                    )
                seen_from = o.mean(0)
            pose = torch.cat([torch.eye(3, dtype=torch.float64), -seen_from.double()[:, None]], 1)
            pose = torch.cat([pose, torch.eye(4, dtype=torch.float64)[3:]])
            self._set_rays(o - self.origin, d)
            return pose
        self.shape = (camera.height, camera.width)
        pose = rigid_pose(camera)
        local = self._moving(lens) if lens is not None else None
        if self.free:
            return self._set_free_rays(pose, local)
        if settings.traversal == "bvh" or settings.sh_direction == "ray":
            local_rays, known = self._local_rays_and_mask()
            d = (local_rays if local is None else local) @ pose[:3, :3]
            center = -(pose[:3, 3] @ pose[:3, :3]) - self.origin
            self._set_rays(center.expand(d.shape), d)
            if settings.traversal == "bvh":  # tiles know them by the lens
                self._set_holes(unwrapped(known, lambda x: x.cpu().numpy()))
        return pose

    def _set_holes(self, known: np.ndarray) -> None:
        """Mark the pixels without a ray, by (P, 1) bool of those that have one."""
        if not known.all():
            self.holes = self.lib.UInt32(known[:, 0].astype(np.uint32))

    def _check_memory(self, gaussians, rays):
        """Refuse what cannot fit before anything is allocated for it."""
        camera = self.camera
        pixels = rays[1].numel() // 3 if rays is not None else camera.width * camera.height
        size = f"{pixels} rays" if rays is not None else f"an image of {camera.width}x{camera.height} pixels"
        width = 0 if gaussians.features is None else gaussians.features.shape[1]
        gradients = torch.is_grad_enabled() and any(x.requires_grad for x in gaussians.parameters().values())
        needed = memory.frame_bytes(pixels, self.settings.traversal, width, gradients)
        memory.require("render", needed, size, "render a smaller one", self.home.type == "cuda")

    def _moving(self, lens: torch.Tensor) -> torch.Tensor:
        """(P, 3) directions in camera axes that move with the lens, which tiles get as shifts."""
        camera = self.camera
        if self.settings.planar:
            raise NotImplementedError(
                "render: derivatives by the lens must be of a response along rays, got "
                f"{self.settings.response!r}; use preset exact, fast or 3dgut"
            )
        self.motion = LensMotion(camera, self.local_directions())
        local = self.motion.directions(lens)
        if self.settings.traversal == "tiles" and not self.free:
            self.inputs["ray_shifts"] = self._move(self.motion.shifts(local, self.is_wide()))
        return local

    def local_directions(self) -> torch.Tensor:
        """(P, 3) directions in camera axes, any finite numbers for pixels without a ray."""
        return self._local_rays_and_mask()[0]

    def _local_rays_and_mask(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(P, 3) directions in camera axes, and (P, 1) bool, false for pixels without a ray."""
        d = local_directions(self.camera)
        known = torch.isfinite(d).all(1, keepdim=True)
        return torch.where(known, d, torch.tensor([0.0, 0.0, 1.0], dtype=d.dtype)), known

    def is_wide(self) -> bool:
        """Whether the camera's lens is a wide one."""
        table = lens_of(self.lib, self.camera, TILE)
        return table is not None and table.wide

    def _set_free_rays(self, start: torch.Tensor, local: torch.Tensor | None) -> torch.Tensor:
        """Set rays of their own for all pixels, and return the pose whose depths count.

        Args:
            start: (3, 4) pose of the camera; of a rolling shutter that of the first line.
            local: (P, 3) directions in camera axes that move with the lens, if they do.
        """
        camera = self.camera
        if self.pixel_rays is None:
            local_rays, known = self._local_rays_and_mask()
            ends = start, rigid_pose(camera, "w2c_end")
            pose, o, d = rolling_view(camera, *ends, local_rays if local is None else local, self.zero)
        else:
            pose = start
            o, d, known = checked_pixel_rays(self.pixel_rays, camera)
        o = o - self.origin
        self._set_rays(o, d)
        # Where rays are is a number: lists have no derivative.
        seen_from = shifted(pose, self.origin).reshape(3, 4)
        o, d, known, seen_from = (unwrapped(x.detach(), lambda x: x.cpu().numpy()) for x in (o, d, known, seen_from))
        self._set_holes(known)
        if self.holes is not None:
            d = np.where(known, d, np.nan)
        if self.settings.traversal == "tiles":
            self.table = FreeRays(self.lib, camera, TILE, o, d, seen_from, self.holes)
        return pose

    def _set_rays(self, o, d):
        if self.settings.traversal == "bvh" or self.free:
            self.inputs["ray_origins"] = self._move(o)
        self.inputs["ray_directions"] = self._move(d)

    def _move(self, x):
        return x.to(self.home).contiguous()

    @property
    def image_names(self) -> list[str]:
        """Names of the images that `trace` returns."""
        return ["rgb", "alpha", *(["depth"] if "depth" in self.want else []), *(["features"] if self.width else [])]

    # -- Dr.Jit side ------------------------------------------------------------------------------------------------

    def trace(self, **inputs) -> dict:
        """Dr.Jit tensors to a dict of flat images, with AD."""
        compositor, arguments = self.prepare(inputs)
        images = dr.custom(Composite, compositor, *arguments, dr.grad_enabled(inputs))
        self.extra = compositor.extra
        self.certificate = compositor.certificate
        return images

    @property
    def is_recorded(self) -> bool:
        """Whether frames of this kind are made of recorded steps (frames.py)."""
        return recordings.are_on() and (
            self.settings.traversal == "tiles"
            and self.settings.culling != "ut"
            and type(response_of(self.settings)).__module__.startswith("drgs.tracing.")
            and set(self.inputs) == _RECORDED_INPUTS
            and self.want <= _RECORDED_OUTPUTS
            and not self.camera.is_distorted
            and self.field is None
            and self.table is None
            and not self.oriented
        )

    def frame(self, inputs: dict, needed: tuple[str, ...]) -> Frame:
        """The images by recorded steps, with gradients by the inputs that are named."""
        s, camera = self.settings, self.camera
        K = camera.K
        size = camera.width, camera.height
        plain = s if not any(s.background) else s.replace(background=(0.0, 0.0, 0.0))
        view = View(plain, response_of(s), *size, self.coefficients, self.want, needed)
        pinhole = tuple(float(v) for v in (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]))
        frame = Frame(view, s, pinhole, inputs)
        self.extra = frame.extra
        self.certificate = frame.certificate
        return frame

    def prepare(self, inputs: dict) -> tuple[Compositor, Arguments]:
        """Project the Gaussians into the view: its `Compositor`, and the arguments of its `forward`."""
        lib, s = self.lib, self.settings
        p = {name: x.array for name, x in self.fields(inputs).items()}
        if s.traversal == "bvh":
            from drgs.tracing.bvh import BvhTraversal  # the only one that needs Mitsuba

            projected = projection.project_world(lib, p, p["w2c"], s, self.coefficients)
            traversal: Traversal = BvhTraversal(lib, s, projected, self.pixels, self.holes)
        else:
            K = self.camera.K
            size = (self.camera.width, self.camera.height)
            pinhole = [dr.opaque(lib.Float64, float(v)) for v in (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2])]
            lens = self.table or lens_of(lib, self.camera, TILE)
            cull = None
            if s.culling == "ut":
                seen_by = self.camera.relative_to(self.zero.numpy())
                cull = lambda g: unscented_boxes(lib, g, seen_by, self.origin - self.zero)  # noqa: E731
            given = lib, p, p["w2c"]
            if self.table is not None:
                screen = Screen(pinhole, *size, None, None, lens)
                projected = projection.project_world(*given, s, self.coefficients, screen, cull)
            else:
                projected = projection.project_screen(*given, pinhole, s, *size, self.coefficients, lens, cull)
            # A depth is relative to what a pixel has, be it next to nothing, and a count has every hit.
            trimmed = not self.want & {"depth", "count"}
            traversal = TileTraversal(lib, s, projected, pinhole, *size, trimmed, lens)
        rays = [self._column(p, name) for name in OF_VIEW[1:4]]
        return compositor_of(
            lib,
            s,
            traversal,
            p,
            self.coefficients,
            *rays,
            want=self.want,
            width=self.width,
            couple=self.couple,
            oriented=self.oriented,
        )

    def fields(self, inputs: dict) -> dict:
        """Raw fields of the Gaussians by name, and what is known of the view: the inputs, through the field if any."""
        if self.field is None:
            return inputs
        view = {name: x for name, x in inputs.items() if name in OF_VIEW}
        return self.field({name: x for name, x in inputs.items() if name not in OF_VIEW}) | view

    def _column(self, p: dict, name: str) -> list | None:
        """Three (P,) float32 columns of origins or directions of rays; None where there are none among the inputs."""
        if name not in p:
            return None
        lib = self.lib
        i = dr.arange(lib.UInt32, self.pixels)
        # Hits are found in float32; the world of float64 means was re-centered before.
        return [lib.Float(dr.gather(lib.Float64, p[name], 3 * i + k)) for k in range(3)]

    # -- torch side -------------------------------------------------------------------------------------------------

    def output(self, images: dict) -> Output:
        """Shape the flat images."""
        back = lambda x, *tail: x.reshape(*self.shape, *tail).to(self.device)  # noqa: E731
        outputs = {"rgb": back(images["rgb"], 3), "alpha": back(images["alpha"])}
        if "depth" in images:
            outputs["depth"] = back(images["depth"]) / outputs["alpha"].clamp_min(EPS_ALPHA)
        if self.width:
            outputs["features"] = back(images["features"], self.width)
        if "median" in self.extra:
            outputs["median_depth"] = back(self.extra["median"].torch())
        if "count" in self.extra:
            outputs["count"] = back(self.extra["count"].torch().to(torch.int32))
        if "visibility" in self.extra:
            outputs["visibility"] = self.extra["visibility"].torch().to(self.device)
        return Output(**outputs, certificate=dict(self.certificate))

    def nothing(self) -> dict:
        """Flat images of no Gaussians, or without pixels: the background, with a derivative of 0."""
        pixels = self.pixels
        sizes = {"median": pixels, "count": pixels, "visibility": self.count}
        self.extra = {name: dr.zeros(self.lib.Float, sizes[name]) for name in self.want & set(sizes)}
        zero = 0 * sum(x.sum().to(torch.float32) for x in self.inputs.values())
        flat = {"alpha": pixels, "features": pixels * self.width} | ({"depth": pixels} if "depth" in self.want else {})
        images = {name: zero.expand(size) for name, size in flat.items()}
        return {"rgb": zero + torch.tensor(self.settings.background, device=self.home).repeat(pixels), **images}


def _check_planar(settings: RenderSettings, camera: Camera, is_free: bool, has_rays: bool) -> None:
    """Refuse views that a model of the image plane does not have: lenses, rays of their own, rolling shutters."""
    if camera.is_distorted:
        raise NotImplementedError(
            f"render: response={settings.response!r} is a model of a pinhole's image plane, got a camera of model "
            f"{camera.model!r} with distortion; use camera.undistorted(), or a response along rays "
            "(--preset exact, fast or 3dgut)"
        )
    if is_free:
        raise NotImplementedError(
            f"render: response={settings.response!r} is a model of a pinhole's image plane, got "
            f"{'rays' if has_rays else 'a rolling shutter'}; use a response along rays "
            "(--preset exact, fast or 3dgut)"
        )


def _check_names(parameters: dict) -> None:
    """Refuse a scene's parameter that has the name of what belongs to the view: their tangents would be mixed."""
    for name in parameters:
        if name in (*OF_VIEW, "camera", "camera_end", "lens", "rays", "rotations", "time", "phi"):
            raise ArgumentError(
                f"scene.parameters(): names must not be those of the view or of rotations, got {name!r}; rename "
                f"it, e.g. {name + '_of_scene'!r}"
            )


def numbers(where: str, name: str, x) -> torch.Tensor:
    """A float64 tensor of anything that torch takes for an array."""
    if isinstance(x, torch.Tensor):
        check_has_numbers(where, name, x)
    try:
        return torch.as_tensor(x).to(torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise ArgumentError(f"{where}: {name} must be an array of numbers, got {kind_of(x)}") from None


def checked_pixel_rays(x: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Float64 origins and unit directions (P, 3) of a caller's rays, and (P, 1) bool, false for pixels without a ray.

    Raises:
        ValueError: If there is not one ray a pixel, or a number is not finite; a direction of 0 is no ray.
    """
    expected = (camera.height, camera.width, 6)
    if tuple(x.shape) != expected:
        raise ValueError(
            f"render: rays must have shape {expected}, an origin and a direction for each pixel of the camera, got "
            f"{tuple(x.shape)}; give the camera their size"
        )
    bad = ~torch.isfinite(x.detach()).all(-1)  # a check has no derivative
    if bool(bad.any()):
        at = bad.nonzero()[0].tolist()
        raise ValueError(
            f"render: rays must be finite, got {x.detach()[tuple(at)].tolist()} at pixel {at}; a direction of 0 is "
            "no ray"
        )
    o, d = x.reshape(-1, 6).split(3, 1)
    squared = (d * d).sum(1, keepdim=True)
    there = squared.detach() > 0  # whether a pixel has a ray has no derivative
    # What stands for a ray must be one.
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=d.dtype, device=d.device)
    return o, torch.where(there, d / torch.where(there, squared, 1.0).sqrt(), forward), there


def checked_rays(origins, directions, settings: RenderSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Float64 tensors of rays that can be traced, broadcast to one shape."""
    o, d = (numbers("render_rays", n, x) for n, x in (("origins", origins), ("directions", directions)))
    for name, x in (("origins", o), ("directions", d)):
        if x.ndim == 0 or x.shape[-1] != 3:
            raise ValueError(f"render_rays: {name} must have shape (..., 3), got {tuple(x.shape)}")
        bad = ~torch.isfinite(x).all(-1) if name == "origins" else ~((x.norm(dim=-1) > 0) & torch.isfinite(x).all(-1))
        if bool(bad.any()):
            at = tuple(bad.nonzero()[0].tolist())
            must = "finite" if name == "origins" else "finite and not 0"
            raise ValueError(f"render_rays: {name} must be {must}, got {x[at].tolist()} at index {list(at)}; drop them")
    try:
        o, d = torch.broadcast_tensors(o, d)
    except RuntimeError:
        raise ValueError(
            "render_rays: origins and directions must have shapes that broadcast, got "
            f"{tuple(o.shape)} and {tuple(d.shape)}; give one of each a ray, or one origin"
        ) from None
    if settings.near > 0 or (settings.order == "center" and settings.depth_key == "z"):
        raise ValueError(
            "render_rays: near and depth_key='z' are about a camera's axis, rays have none, got "
            f"near={settings.near:g}, depth_key={settings.depth_key!r}; use near=0 and depth_key='distance'"
        )
    return o, d
