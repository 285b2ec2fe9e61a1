"""The Mitsuba integrator plugin `drgs`: `bvh` traversal under `mi.load_dict`, `mi.render` and Mitsuba's AD.

    import mitsuba as mi; mi.set_variant("llvm_ad_rgb")
    from drgs import plugin  # registers the integrator
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "drgs", "preset": "exact"},
                          "shape": drgs.ellipsoids.ellipsoids_shape(gaussians), "sensor": {...}})
    image = mi.render(scene, params=mi.traverse(scene), spp=16)

Any sensor, film and reconstruction filter. A box filter and one sample at the pixel center (sampler `stratified`,
`jitter` false) reproduce `drgs.render`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr

from drgs import runtime
from drgs.settings import RenderSettings
from drgs.tracing.arrays import Float, Lib, Mask, UInt32
from drgs.tracing.bvh import BvhTraversal
from drgs.tracing.composite import Composite, compositor_of
from drgs.tracing.projection import project_world

mi = runtime.mitsuba()

__all__ = ["DrgsIntegrator"]


class DrgsIntegrator(mi.ad.integrators.common.RBIntegrator):  # type: ignore[name-defined]
    """Radiance field of one `ellipsoids` shape.

    Plugin parameters: `preset` (default `exact`; its traversal is replaced by `bvh`) and any field of `RenderSettings`
    by name. The shape carries `opacities` (N, 1) in (0, 1) and `sh_coeffs` (N, 3 K), K by channel, as Mitsuba's own
    `volprim_rf_basic` reads them.

    Gradients:
        Forward and reverse, with respect to `data` (centers, scales, quaternions), `opacities` and `sh_coeffs` of the
        shape. Colors are linear and no transform is applied. Sensor parameters are not differentiated: use
        `drgs.render` with a pose that requires a gradient.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        fields: dict[str, Any] = {"traversal": "bvh"}
        preset = props.get("preset", "exact")
        for field in dataclasses.fields(RenderSettings):
            if field.name in props:
                fields[field.name] = props[field.name]
        if "background" in fields:  # Mitsuba makes a color of it
            fields["background"] = tuple(float(x) for x in fields["background"])
        self.settings = RenderSettings.preset(preset, **fields)
        self.pose = None

    def sample_rays(self, scene: Any, sensor: Any, *args: Any, **kwargs: Any) -> tuple:
        """Mitsuba's, remembering where the camera is: rays start on the near plane, not at the camera."""
        self.pose = sensor.world_transform().matrix
        return super().sample_rays(scene, sensor, *args, **kwargs)

    def sample(
        self, mode: dr.ADMode, scene: Any, sampler: Any, ray: Any, δL: Any, state_in: Any, active: Mask, **kwargs: Any
    ) -> tuple:
        """Radiance along rays (Primal), its forward derivative, or back-propagation of δL."""
        if mode == dr.ADMode.Primal:
            L, alpha = self._trace(scene, ray)
            return L, active & (alpha > 0), [], None
        # Mitsuba suspends AD around `sample`; this one differentiates by it.
        with dr.resume_grad():
            L, alpha = self._trace(scene, ray)
            if mode == dr.ADMode.Backward:
                dr.backward_from(dr.sum(dr.dot(L, dr.detach(δL))))  # δL is a number, the cotangent
                change = δL
            else:
                change = dr.forward_to(L)
        return change, active & (dr.detach(alpha) > 0), [], None  # a mask has no derivative

    def _trace(self, scene: Any, ray: Any) -> tuple[Any, Float]:
        """(Color3f, alpha) of every ray."""
        lib = runtime.dr_types()
        s = self.settings
        p, coefficients = _parameters(lib, scene)
        # Sensors are not differentiated.
        o, d = (list(dr.detach(v)) for v in (ray.o, dr.normalize(ray.d)))
        n = dr.width(ray)
        o, d = ([lib.Float(x) + dr.zeros(lib.Float, n) for x in v] for v in (o, d))
        w2c = [v for row in _camera_axes(lib, self.pose, o) for v in row]
        pose = dr.zeros(lib.Float64, 12)
        for k, v in enumerate(w2c):
            dr.scatter(pose, v, lib.UInt32(k))
        traversal = BvhTraversal(lib, s, project_world(lib, p, pose, s, coefficients), n)
        compositor, arguments = compositor_of(lib, s, traversal, p, coefficients, o, d)
        out = dr.custom(Composite, compositor, *arguments, dr.grad_enabled(p))
        i = dr.arange(lib.UInt32, n)
        return mi.Color3f(*[dr.gather(lib.Float, out["rgb"], 3 * i + c) for c in range(3)]), out["alpha"]

    def to_string(self) -> str:
        """Mitsuba's text of a scene."""
        return f"DrgsIntegrator[{self.settings}]"


@runtime.exactly
def _camera_axes(lib: Lib, pose: Any, origins: list[Float]) -> list[list[Float]]:
    """Rows of w2c: of the sensor (whose x and y point the other way), or at the first ray's origin in world axes."""
    # Float64, as a pose of `Call` is: what is projected with it cancels in float32 far from the origin.
    if pose is None:
        axes = [[lib.Float64(float(r == c)) for c in range(3)] for r in range(3)]
        center = [lib.Float64(dr.gather(lib.Float, x, 0)) for x in origins]
    else:
        axes = [[lib.Float64(pose[c, r]) * (1 if r == 2 else -1) for c in range(3)] for r in range(3)]
        axes = [[x * dr.rsqrt(sum(y * y for y in row)) for x in row] for row in axes]
        center = [lib.Float64(pose[c, 3]) for c in range(3)]
    return [[*row, -sum(x * y for x, y in zip(row, center, strict=True))] for row in axes]


def _parameters(lib: Lib, scene: Any) -> tuple[dict[str, Float], int]:
    """Raw parameter arrays of the scene's `ellipsoids` shape, attached to its AD graph."""
    shapes = [s for s in scene.shapes() if s.is_ellipsoids()]
    if len(shapes) != 1:
        raise ValueError(f"drgs integrator: the scene must have exactly one ellipsoids shape, got {len(shapes)}")
    params = mi.traverse(shapes[0])
    missing = [name for name in ("opacities", "sh_coeffs") if name not in params]
    if missing:
        raise ValueError(
            f"drgs integrator: the ellipsoids shape must have the attribute {missing[0]!r}; "
            "drgs.ellipsoids.ellipsoids_shape makes such a shape"
        )
    data, opacity, sh = params["data"], params["opacities"], params["sh_coeffs"]
    count = dr.width(data) // 10

    def columns(width: int) -> tuple[UInt32, UInt32]:
        j = dr.arange(lib.UInt32, count * width)
        return j // width * 10, j % width

    row, k = columns(3)
    p = {"means": dr.gather(lib.Float, data, row + k)}
    p["log_scales"] = dr.log(dr.gather(lib.Float, data, row + k + 3))
    row, k = columns(4)
    p["quats"] = dr.gather(lib.Float, data, row + 6 + (k + 3) % 4)  # xyzw to wxyz
    opacity = dr.clip(opacity, 1e-30, 1 - 6e-8)  # the logit of 0 and 1 is infinite; 6e-8: the last float32 below 1
    p["logit_opacities"] = dr.log(opacity) - dr.log(1 - opacity)
    p["sh"] = sh
    return p, dr.width(sh) // (3 * count)


mi.register_integrator("drgs", lambda props: DrgsIntegrator(props))
