"""How the rays of a camera move with its lens: focal lengths, principal point, skew and distortion.

A ray is where the lens model meets a pixel, so that it is an inverse, and its derivative that of an implicit function:
where distort(u; coefficients) = K^-1 pixel, du = J^-1 (d(K^-1 pixel) - d distort) with J = d distort / d u at the ray;
of a radial model the same for the angle alone. Both are one step of Newton's from the ray, which is where it is
already: the value of such a step is that ray, and its derivative is exact. The rays of panoramas are an explicit
function of K.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from drgs.cameras import Camera
from drgs.cameras.lenses import LENS_MODELS, distorted, equirectangular, linear_part

# px by which a ray's projection may miss its pixel; beyond, the lens has no inverse there, and nothing moves
_MAX_RESIDUAL = 1e-3
_MIN_SLOPE = 1e-9  # a determinant or slope below has no inverse


class LensMotion:
    """The rays of a camera as a function of its lens, whose derivative is right at that lens.

    Args:
        camera: The camera.
        local: (P, 3) float64 unit directions through its pixels, in camera axes.
    """

    def __init__(self, camera: Camera, local: torch.Tensor) -> None:
        self.camera = camera
        self.local = local
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        self.pixels = [torch.from_numpy(x.reshape(-1)) for x in (columns, rows)]
        lens = torch.from_numpy(camera.lens_parameters.copy())
        plane = self._plane(lens)
        focal = float(max(camera.K[0, 0], camera.K[1, 1]))
        self.explicit = camera.model == "equirectangular"
        self.radial = LENS_MODELS[camera.model].radial
        if self.explicit:
            self.fixed = torch.zeros(len(local), dtype=torch.bool)
            return
        if self.radial:
            self.angle = torch.atan2(local[:, :2].norm(dim=1), local[:, 2])
            seen, self.slope = self.radial(self.angle, tuple(camera.distortion))
            plane = self._round(plane, tuple(camera.distortion))
            self.off: list[torch.Tensor] = [seen - torch.hypot(*plane)]
            self.fixed = ~((self.off[0].abs() * focal < _MAX_RESIDUAL) & (self.slope.abs() > _MIN_SLOPE))
            self.slope = torch.where(self.fixed, 1.0, self.slope)
            return
        self.at = [local[:, k] / local[:, 2] for k in range(2)]
        seen_at = lambda x, y: distorted(x, y, tuple(camera.distortion))  # noqa: E731
        units = [(1.0, 0.0), (0.0, 1.0)]
        columns_of = []
        for unit in units:
            tangent = tuple(torch.full_like(local[:, 0], t) for t in unit)
            pair: Any = torch.func.jvp(seen_at, tuple(self.at), tangent)
            seen, column = pair
            columns_of.append(column)
        # Rows: d distort_x, d distort_y by x and y.
        self.slopes = list(zip(*columns_of, strict=True))
        self.off = [a - b for a, b in zip(seen, plane, strict=True)]
        (a, b), (c, d) = self.slopes
        self.determinant = a * d - b * c
        near = (torch.hypot(*self.off) * focal < _MAX_RESIDUAL) & (self.determinant.abs() > _MIN_SLOPE)
        self.fixed = ~near
        self.determinant = torch.where(near, self.determinant, 1.0)

    def directions(self, lens: torch.Tensor) -> torch.Tensor:
        """(P, 3) float64 unit directions in camera axes, of `Camera.lens_parameters`, where they are the camera's."""
        plane = self._plane(lens)
        coefficients = tuple(lens[5:].unbind())
        if self.explicit:
            moved = torch.stack(equirectangular(*plane, torch), 1)
        elif self.radial:
            plane = self._round(plane, coefficients)
            squared = plane[0] * plane[0] + plane[1] * plane[1]
            off = squared > 0
            radius = torch.where(off, torch.where(off, squared, 1.0).sqrt(), 0.0)
            seen, _ = self.radial(self.angle, coefficients)
            angle = self.angle - (seen - radius - self.off[0]) / self.slope
            # On the axis a direction moves as its point of the plane does, over the slope there.
            factor = torch.where(off, angle.sin() / torch.where(off, radius, 1.0), 1.0 / self.slope)
            moved = torch.stack([plane[0] * factor, plane[1] * factor, angle.cos()], 1)
        else:
            seen = distorted(self.at[0], self.at[1], coefficients)
            rest = [a - b - c for a, b, c in zip(seen, plane, self.off, strict=True)]
            (a, b), (c, d) = self.slopes
            x = self.at[0] - (d * rest[0] - b * rest[1]) / self.determinant
            y = self.at[1] - (a * rest[1] - c * rest[0]) / self.determinant
            moved = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], 1), dim=1)
        return torch.where(self.fixed[:, None], self.local, moved)

    def shifts(self, directions: torch.Tensor, wide: bool) -> torch.Tensor:
        """(P, 3) what `directions` add to the rays of tiles: pixels of the pinhole camera, and the length |d| of
        directions with d_z = 1; of wide lenses, to directions.
        """
        if wide:
            return directions - self.local
        (fx, skew, _), (_, fy, _), _ = self.camera.K.tolist()
        x, y = ((directions[:, k] / directions[:, 2] - self.local[:, k] / self.local[:, 2]) for k in range(2))
        return torch.stack([fx * x + skew * y, fy * y, 1 / directions[:, 2] - 1 / self.local[:, 2]], 1)

    def _round(self, plane: tuple[torch.Tensor, torch.Tensor], coefficients: tuple) -> tuple:
        """Points of the plane before the linear part of a radial model."""
        c, d, e = linear_part(self.camera.model, coefficients)
        x, y = plane
        return (x - d * y) / (c - d * e), (c * y - e * x) / (c - d * e)

    def _plane(self, lens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """K^-1 times the pixels."""
        fx, fy, cx, cy, skew = lens[:5].unbind()
        y = (self.pixels[1] - cy) / fy
        return (self.pixels[0] - cx - skew * y) / fx, y
