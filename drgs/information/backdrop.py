"""An unknown color behind everything: where the Gaussians are transparent, a view still has something to learn.

Information is about Gaussians that exist. Where a view shows none, a pixel is as unknown as it can be, and its variance
was 0. With a color b_c behind everything, one for each cell c of directions, known to a variance of 1 / lambda before
any view, a pixel p of the cell c is S_p + (1 - alpha_p) b_c: linear, so that the information of a view about b_c is

    H_c = sum_{p in c} (1 - alpha_p)^2

in each of the three channels, whatever b is. The colors are painted on a sphere around all cameras, about as far away
as the farthest surfaces that they show: what one view has seen of it, another one from elsewhere need not see again.
Cells are those of a cube around its center whose faces have 16x16 of them, spaced evenly in angle (Ronchi et al., "The
'cubed sphere'", 1996): 1,536, of 4 to 6 degrees.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from drgs.cameras.origins import decimals
from drgs.cameras.sizes import at_most
from drgs.ellipsoids import Scene, colors_only
from drgs.information.complement import remaining
from drgs.information.nuisances import NO_NUISANCES, Nuisances
from drgs.information.quantity import Quantity, ViewContext
from drgs.information.sums import Information
from drgs.settings import RenderSettings

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.information.semantics import SemanticMetric

BACKDROP = "backdrop"  # the group of its information
_OPACITY, _TAKEN = "opacity", "taken"  # names of what is computed of one view
_CELLS_PER_EDGE = 16  # cells along an edge of the cube, of 4 to 6 degrees; chosen
CELLS = 6 * _CELLS_PER_EDGE**2
_DEPTH_PIXELS = 1200  # pixels of a view's depth image, such as 40 x 30: a quantile needs no detail
_DEPTH_VIEWS = 16  # views whose depth is rendered, at most: the cost does not grow with the number of candidates
_FAST = RenderSettings.preset("fast")  # measures depth along the ray, as `ewa` does not
_SURFACE_ALPHA = 0.5  # opacity from which on the median depth is that of a surface
_RADIUS_QUANTILE = 0.95  # quantile of all depths that is the radius: a few floaters do not decide it; chosen
_MIN_RADIUS_RATIO = 1.05  # of the distance of the outermost camera, at least: cameras are inside, not on the sphere


ComputeViews = Callable[[Quantity, Sequence["Camera"]], Iterable[Information]]
"""(quantity, cameras) -> what is computed of each view, as `drgs.selection.pool.Pool.compute_each`."""


@dataclasses.dataclass(frozen=True)
class Sphere:
    """The sphere that carries the unknown colors, in world units.

    Attributes:
        center: x, y, z.
        radius: Distance of what is painted from the center, > 0.
    """

    center: tuple[float, float, float]
    radius: float


def backdrop_sphere(
    scene: Scene,
    cameras: Sequence[Camera],
    compute: ComputeViews | None = None,
) -> Sphere | None:
    """The sphere that the backdrop is painted on; None: infinitely far away, if no view shows a surface.

    Its center is the mean of the camera centers. Its radius, in world units, is nearly the largest distance of the
    surfaces that the views show, each at its time, and at least reaches around all cameras. Of more than 16 cameras 16
    count, evenly spaced in the order of their centers.

    It depends on the scene and on all of these cameras, in whatever order. So it moves as candidates come and go, with
    the bits that a single call would find; `drgs.select.Cache` keeps the opacity of views apart from it.

    Args:
        scene: The scene that is seen.
        cameras: The cameras that see it.
        compute: Computes a quantity of views, in place of one after another here (`Pool.compute_each`).
    Raises:
        ValueError: If there is no camera.
    """
    if not cameras:
        raise ValueError("fisher.backdrop_sphere: there must be at least one camera, got none")
    centers = np.stack([camera.center for camera in cameras])
    # Of the cameras, not of their order, which the last bits of a running sum depend on.
    center = np.array([math.fsum(along) / len(cameras) for along in centers.T.tolist()])
    if len(cameras) > _DEPTH_VIEWS:
        digits = decimals(centers)
        in_order = sorted(cameras, key=lambda camera: _place(camera, digits))
        cameras = [in_order[i * len(cameras) // _DEPTH_VIEWS] for i in range(_DEPTH_VIEWS)]
    quantity = SurfaceDepths()
    if compute is not None:
        computed = compute(quantity, cameras)
    else:
        computed = (quantity.compute(ViewContext(scene, camera, _FAST)) for camera in cameras)
    solid = np.concatenate([one["depths"].numpy() for one in computed])
    if not len(solid):
        return None
    outermost = float(np.linalg.norm(centers - center, axis=1).max())
    radius = max(float(np.quantile(solid, _RADIUS_QUANTILE)), _MIN_RADIUS_RATIO * outermost)
    return Sphere((float(center[0]), float(center[1]), float(center[2])), radius)


def _place(camera: Camera, digits: int) -> tuple[list, list, float]:
    """Where a camera is, to so many decimals, which way it looks, and its time: no two orders of the same cameras are
    sorted differently.
    """
    place = (camera.center.round(digits) + 0.0).tolist()  # + 0.0: -0 and 0 are equal
    return place, camera.w2c.tolist(), -math.inf if camera.time is None else camera.time


@dataclasses.dataclass(frozen=True)
class SurfaceDepths(Quantity):
    """{"depths": (P,)}: depths of surfaces (alpha of at least a half) in a small rendering of a view."""

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """Float32 on the CPU."""
        from drgs.integrator import render  # loads Dr.Jit, which poses alone need not have

        with torch.no_grad():  # a distance is a number
            plain = colors_only(view.scene, view.camera.time)
            small = at_most(view.camera, _DEPTH_PIXELS)
            out = render(plain, small, _FAST, outputs=("median_depth",))
        assert out.median_depth is not None
        return {"depths": out.median_depth[(out.alpha >= _SURFACE_ALPHA) & (out.median_depth > 0)].cpu()}

    def key(self, camera: Camera, settings: RenderSettings) -> Hashable:
        """Whatever the settings are."""
        return self


def backdrop_cells(camera: Camera, sphere: Sphere | None = None) -> torch.Tensor:
    """(H, W) int64: the cell that each pixel's ray leaves the sphere through; of None, that of its direction."""
    rays = np.ascontiguousarray(camera.pixel_directions().reshape(-1, 3).T)  # x, y and z each in one piece
    if sphere:
        start = (camera.center - np.array(sphere.center)) / sphere.radius
        along = start[0] * rays[0] + start[1] * rays[1] + start[2] * rays[2]
        # Not below 0: a ray of a camera outside that misses has no crossing, and takes the place where it is nearest.
        rays *= np.sqrt(np.maximum(along**2 + 1 - start @ start, 0.0)) - along
        rays += start[:, None]
    axis = np.abs(rays).argmax(0)
    cells = np.empty(len(axis), np.int64)
    for k in range(3):  # the faces across each axis
        (seen,) = (axis == k).nonzero()
        along, *others = (rays[(k + step) % 3][seen] for step in range(3))
        # Evenly in angle, in [0, 2]; the edge of a face, 2, would be cell 16.
        even = (np.arctan(x / np.abs(along)) * 4 / np.pi + 1 for x in others)
        first, second = ((x / 2 * _CELLS_PER_EDGE).astype(np.int64).clip(0, _CELLS_PER_EDGE - 1) for x in even)
        cells[seen] = ((2 * k + (along < 0)) * _CELLS_PER_EDGE + first) * _CELLS_PER_EDGE + second
    return torch.from_numpy(cells.reshape(camera.height, camera.width))


def _open(opacity: torch.Tensor) -> torch.Tensor:
    """(H, W) float64: (1 - alpha)^2.

    In float64, where 1 - alpha of a float32 alpha is exact. A sum of weights may exceed 1 by rounding: clamped, so that
    no pixel is more open the more it is covered.
    """
    return (1 - opacity.double().cpu()).clamp(min=0).square()


def painted_opacity(
    opacity: torch.Tensor,
    camera: Camera,
    channel_weights: Sequence[float],
    mask: torch.Tensor | None = None,
    sphere: Sphere | None = None,
    taken: torch.Tensor | None = None,
) -> torch.Tensor:
    """(1536, 3) float64 H_c of a view of a known opacity (H, W), in each channel, times the channel's weight; with a
    mask (H, W) of its square; less what the view's own unknowns explain.

    Args:
        taken: (pixels, 3, r) of the unknowns, as `drgs.information.elimination.backdrop_taken` gives them; None: none.
    """
    total = torch.zeros(CELLS, dtype=torch.float64)
    open_ = _open(opacity)
    if mask is not None:
        open_ = open_ * mask.detach().double().cpu().square()
    cells = backdrop_cells(camera, sphere).flatten()
    total.index_add_(0, cells, open_.flatten())
    shown = total[:, None] * torch.tensor(channel_weights, dtype=torch.float64)
    if taken is None:
        return shown
    lost = torch.zeros(CELLS, *taken.shape[1:], dtype=torch.float64)
    # The same clamp as of `_open`, and 1 - alpha in float64, as there.
    rows = taken.double() * (1 - opacity.double().cpu()).clamp(min=0).reshape(-1, 1, 1)
    lost.index_add_(0, cells, rows)
    return remaining(shown, lost.square().sum(-1))


def backdrop_variance(
    view: ViewContext, weights: torch.Tensor, channel_weights: Sequence[float], sphere: Sphere | None = None
) -> torch.Tensor:
    """(H, W) float32 (1 - alpha)^2 times the weights (1536, 3) of the pixel's cell, summed over weighted channels.

    Raises:
        ValueError: If a weight is not finite.
    """
    if not bool(torch.isfinite(weights).all()):
        raise ValueError("fisher.variance_map: weights must be finite, got NaN or Inf; raise lambda above 0")
    each = weights.double().cpu() @ torch.tensor(channel_weights, dtype=torch.float64)
    return (_open(view.opacity) * each[backdrop_cells(view.camera, sphere)]).float()


@dataclasses.dataclass(frozen=True)
class Backdrop(Quantity):
    """About the color behind all Gaussians: {"backdrop": (1536, 3)}, as of `drgs.fisher.backdrop`.

    What is computed of a view is its opacity, with what its unknowns take where any are eliminated: these do not depend
    on the other views, around which the sphere is. They are painted on it when views are added up.

    Attributes:
        sphere: What the color is painted on; None: infinitely far away.
        empty_outside: Whether it is known that nothing is outside of masks, so that the view has shown it.
        channel_weights: Inverse noise variances of R, G and B.
        semantics: The metric of the features, which show where the camera stands, too; None: only colors do.
        nuisances: Unknowns of the view that are eliminated.
    """

    sphere: Sphere | None = None
    empty_outside: bool = False
    channel_weights: Sequence[float] = (1.0, 1.0, 1.0)
    semantics: SemanticMetric | None = None
    nuisances: Nuisances = NO_NUISANCES
    where: ClassVar[str] = "fisher.backdrop"

    @property
    def signed(self) -> tuple[str, ...]:
        """What unknowns take are directions, of either sign."""
        return (_TAKEN,)

    def key(self, camera: Camera, settings: RenderSettings) -> Hashable:
        """Without the sphere, and what is known outside of masks."""
        return dataclasses.replace(self, sphere=None, empty_outside=False), settings

    def of_part(self) -> Backdrop:
        """Where pixels outside of masks are left out, although they are known to be empty."""
        return dataclasses.replace(self, empty_outside=False)

    def compute(self, view: ViewContext) -> dict[str, torch.Tensor]:
        """The view's opacity, (H, W), and what its unknowns take."""
        computed = {_OPACITY: view.opacity}
        if self.nuisances.names:
            from drgs.information.elimination import backdrop_taken  # loads Dr.Jit, which poses alone need not have

            taken = backdrop_taken(view, self.channel_weights, self.semantics, self.nuisances)
            computed |= {} if taken is None else {_TAKEN: taken}
        return computed

    def summand(self, computed: Information, camera: Camera, mask: torch.Tensor | None) -> dict[str, torch.Tensor]:
        """Painted on the sphere."""
        painted = dict(computed)
        mask = None if self.empty_outside else mask
        opacity, taken = painted.pop(_OPACITY), painted.pop(_TAKEN, None)
        painted[BACKDROP] = painted_opacity(opacity, camera, self.channel_weights, mask, self.sphere, taken)
        return painted

    def variance_map(self, view: ViewContext, weights: Information) -> torch.Tensor:
        """`drgs.fisher.variance_map` of the color behind."""
        if BACKDROP not in weights:
            return torch.zeros(view.camera.height, view.camera.width)
        return backdrop_variance(view, weights[BACKDROP], self.channel_weights, self.sphere)
