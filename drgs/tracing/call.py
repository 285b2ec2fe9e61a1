"""One call of the renderer: its tensors, and the Dr.Jit function from them to images."""

from __future__ import annotations

import dataclasses

import drjit as dr
import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera, rigid
from drgs.guards import memory
from drgs.guards.arguments import ArgumentError, kind_of
from drgs.tracing import projection
from drgs.tracing.composite import Composite, View
from drgs.tracing.tiles import build
from drgs.tracing.walk import tile_part

__all__ = ["EPS_ALPHA", "Output", "Scene", "quaternion_product", "to_drjit"]

EPS_ALPHA = 1e-10


@dataclasses.dataclass(frozen=True, eq=False)
class Output:
    """What one view shows (torch tensors; None where not asked for); of a list of views with a leading axis.

    Attributes:
        rgb: (H, W, 3) linear blend of the colors, background included, not clamped.
        alpha: (H, W) sum w = 1 - T_end.
        depth: (H, W) sum w t* / max(alpha, 1e-10), distance along the ray (`ewa`: the Gaussians' own depth).
        median_depth: (H, W) t* where T first falls to 0.5, 0 where it never does; not differentiated.
        count: (H, W) int32, composited hits.
        visibility: (N,) sum of w over all pixels; not differentiated.
        features: (H, W, D) when the Gaussians have features.
        certificate: Of exact order: `rays`, `redone` (rays walked again, along sorted lists); `pairs` listed. Of a
            list of views one for each.
    """

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    count: torch.Tensor | None = None
    visibility: torch.Tensor | None = None
    features: torch.Tensor | None = None
    certificate: dict | list[dict] = dataclasses.field(default_factory=dict)


class Scene:
    """One call of `render`: its tensors, and the Dr.Jit function from them to images.

    Attributes:
        inputs: Torch tensors by name: the raw parameters, `w2c` (12 floats), rays where they are traced.
        view: The `View` of the last `prepare`.
    """

    def __init__(self, gaussians, camera, settings, want, rays=None):
        self.t, self.settings, self.camera, self.want = runtime.dr_types(), settings, camera, want
        if settings.traversal == "tiles" and camera.is_distorted:
            raise NotImplementedError(
                f"render: traversal='tiles' must have a pinhole camera, got model {camera.model!r} with distortion; "
                "use traversal='bvh' (true rays) or camera.undistorted()"
            )
        self.home = torch.device("cuda") if runtime.backend().name == "cuda" else torch.device("cpu")
        self._check_memory(gaussians, rays)
        gaussians.validate("render")
        self.device = gaussians.means.device
        if settings.traversal == "bvh" and gaussians.means.dtype == torch.float64 and len(gaussians):
            # World records are float32, so a world far from 0 is moved there.
            middle = gaussians.means.detach().mean(0)
            origin = np.asarray(gaussians.origin, np.float64) + [float(x) for x in middle]
            gaussians = gaussians.replace(means=gaussians.means - middle, origin=origin)
        self.inputs = {name: self._move(x) for name, x in gaussians.parameters().items()}
        self.count, self.coefficients = len(gaussians), gaussians.sh.shape[1]
        self.width = 0 if gaussians.features is None else gaussians.features.shape[1]
        origin = torch.from_numpy(np.asarray(gaussians.origin, np.float64))
        if rays is not None:
            o, d = _checked_rays(*rays, settings)
            self.shape = tuple(d.shape[:-1])
            o = o.expand(d.shape).reshape(-1, 3)
            d = torch.nn.functional.normalize(d.reshape(-1, 3), dim=1)
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, 3] = -(o[0].detach() if len(o) else torch.zeros(3))
            self._set_rays(o - origin, d)
        else:
            self.shape = (camera.height, camera.width)
            pose = self._pose()
            if settings.traversal == "bvh" or settings.sh_direction == "ray":
                local = torch.from_numpy(_local_directions(camera))
                d = local @ pose[:3, :3]
                center = -(pose[:3, 3] @ pose[:3, :3]) - origin
                self._set_rays(center.expand(d.shape), d)
        # The world of the means is re-centered: x_world = x + origin.
        shift = pose[:3, 3] + pose[:3, :3] @ origin
        self.inputs["w2c"] = self._move(torch.cat([pose[:3, :3], shift[:, None]], 1).reshape(-1))
        self.view = None

    def _check_memory(self, gaussians, rays):
        """Refuse what cannot fit before anything is allocated for it."""
        camera = self.camera
        pixels = torch.as_tensor(rays[1]).numel() // 3 if rays is not None else camera.width * camera.height
        size = f"{pixels} rays" if rays is not None else f"an image of {camera.width}x{camera.height} pixels"
        width = 0 if gaussians.features is None else gaussians.features.shape[1]
        gradients = torch.is_grad_enabled() and any(x.requires_grad for x in gaussians.parameters().values())
        needed = memory.frame_bytes(pixels, self.settings, width, gradients)
        memory.require("render", needed, size, "render a smaller one", self.home.type == "cuda")

    def _pose(self):
        """(3, 4) of w2c in float64, as the rigid motion that it means; a copy of an array, which may be read-only."""
        w2c = self.camera.w2c
        if not isinstance(w2c, torch.Tensor):
            return torch.tensor(w2c).to(torch.float64)[:3]
        # The camera has checked it, but an optimizer may have moved it since.
        bad = ~torch.isfinite(w2c.detach())
        if bool(bad.any()):
            at = bad.nonzero()[0].tolist()
            raise ValueError(
                f"render: the pose must be finite, got {float(w2c[tuple(at)]):g} at {at}; go back to the last good one"
            )
        rotation, translation = rigid(w2c.to(torch.float64))
        return torch.cat([rotation, translation[:, None]], 1)

    def _set_rays(self, o, d):
        if self.settings.traversal == "bvh":
            self.inputs["ray_origins"] = self._move(o)
        self.inputs["ray_directions"] = self._move(d)

    def _move(self, x):
        return x.to(self.home).contiguous()

    # -- Dr.Jit side ------------------------------------------------------------------------------------------------

    def trace(self, **inputs) -> dict:
        """Dr.Jit tensors to a dict of flat images, with AD."""
        view, arguments = self.prepare(inputs)
        return dr.custom(Composite, *arguments)

    def prepare(self, inputs):
        """The `View` and the arguments of `Composite`."""
        t, s = self.t, self.settings
        p = {name: x.array for name, x in inputs.items()}
        along_ray = s.sh_direction == "ray"
        coefficients = 0 if along_ray else self.coefficients
        world = s.traversal == "bvh"
        if world:
            from drgs.tracing import bvh

            projected = projection.project_world(t, p, p["w2c"], s, coefficients)
            parts_of, length = bvh.parts_of, None
        else:
            K = self.camera.K
            pinhole = [dr.opaque(t.Float64, float(v)) for v in (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2])]
            projected = projection.project_screen(
                t, p, p["w2c"], pinhole, s, self.camera.width, self.camera.height, coefficients
            )
            parts_of, length = self._tile_parts, _ray_length(t, pinhole)
        lanes, pixels = [], int(np.prod(self.shape))
        if along_ray or world:
            i = dr.arange(t.UInt32, pixels)
            direction = [t.Float(dr.gather(t.Float64, p["ray_directions"], 3 * i + k)) for k in range(3)]
            if along_ray:
                lanes += projection.sh_basis(direction, self.coefficients)
                lanes[0] = lanes[0] + dr.zeros(t.Float, pixels)
            if world:
                lanes += [t.Float(dr.gather(t.Float64, p["ray_origins"], 3 * i + k)) for k in range(3)] + direction
        view = self.view = View(
            t,
            s,
            pixels,
            projected,
            self.coefficients if along_ray else 0,
            self.width,
            self.want,
            parts_of,
            length,
            world,
        )
        keep = dr.grad_enabled(p)
        sh = t.Float(p["sh"]) if along_ray else None
        features = t.Float(p["features"]) if self.width else None
        return view, (view, projected.record, sh, features, lanes, keep)

    def _tile_parts(self, view, model, buffer, ray_of, share):
        """Tile lists (once a view) and the pixels that walk them."""
        t, camera = self.t, self.camera
        if view.lists is None:
            view.lists = build(t, view.projected, self.settings, camera.width, camera.height, buffer)
            view.certificate["pairs"] = view.lists.pairs
        size = camera.width, camera.height
        return [tile_part(t, model, buffer, view.lists, self.settings, *size, ray_of, share)]

    # -- torch side -------------------------------------------------------------------------------------------------

    def output(self, images: dict) -> Output:
        """Shape the flat images."""
        back = lambda x, *tail: x.reshape(*self.shape, *tail).to(self.device)  # noqa: E731
        made = {"rgb": back(images["rgb"], 3), "alpha": back(images["alpha"])}
        if "depth" in images:
            made["depth"] = back(images["depth"]) / made["alpha"].clamp_min(EPS_ALPHA)
        if self.width:
            made["features"] = back(images["features"], self.width)
        extra = self.view.extra
        if "median" in extra:
            made["median_depth"] = back(extra["median"].torch())
        if "count" in extra:
            made["count"] = back(extra["count"].torch().to(torch.int32))
        if "visibility" in extra:
            made["visibility"] = extra["visibility"].torch().to(self.device)
        return Output(**made, certificate=dict(self.view.certificate))

    def nothing(self) -> dict:
        """Flat images of no Gaussians: the background, with a derivative of 0."""
        t, pixels = self.t, int(np.prod(self.shape))
        self.view = View(t, self.settings, pixels, None, 0, self.width, self.want, None, None, False)
        sizes = {"median": pixels, "count": pixels, "visibility": 0}
        self.view.extra.update({name: dr.zeros(t.Float, sizes[name]) for name in self.want & set(sizes)})
        zero = 0 * sum(x.sum().to(torch.float32) for x in self.inputs.values())
        flat = {"alpha": pixels, "features": pixels * self.width} | ({"depth": pixels} if "depth" in self.want else {})
        images = {name: zero.expand(size) for name, size in flat.items()}
        return {"rgb": zero + torch.tensor(self.settings.background, device=self.home).repeat(pixels), **images}

    def jvp(self, tangents: dict) -> Output:
        """`render_jvp`."""
        columns, batched = self._tangents(tangents)
        pixels = int(np.prod(self.shape))
        what = f"{len(columns)} tangents of {pixels} pixels"
        needed = memory.frame_bytes(pixels, self.settings, self.width) + memory.TANGENT * pixels * len(columns)
        memory.require("render_jvp", needed, what, "take fewer at a time", self.home.type == "cuda")
        if self.count == 0:
            still = self.output(self.nothing())
            images = {name: getattr(still, name) for name in ("rgb", "alpha", "depth", "features")}
            lead = (len(columns),) if batched else ()
            return Output(**{n: x.new_zeros(*lead, *x.shape) for n, x in images.items() if x is not None})
        return _jvp_output(self, self._push_forward(columns), batched)

    def _tangents(self, tangents):
        """K dicts of tangents of the inputs, and whether there was a leading axis."""
        shapes = {
            name: tuple(x.shape)
            for name, x in self.inputs.items()
            if name not in ("w2c", "ray_origins", "ray_directions")
        }
        shapes |= {"rotations": (self.count, 3), "camera": (6,)}
        lengths, given = set(), {}
        for name, x in tangents.items():
            if name not in shapes:
                raise ValueError(f"render_jvp: tangents must be named among {', '.join(shapes)}, got {name!r}")
            x = _numbers(f"render_jvp: tangent of {name}", x).detach()
            if tuple(x.shape) == shapes[name]:
                lengths.add(None)
                x = x[None]
            elif tuple(x.shape[1:]) == shapes[name]:
                lengths.add(len(x))
            else:
                raise ValueError(
                    f"render_jvp: tangent of {name} must have shape {shapes[name]} or (K, ...), got {tuple(x.shape)}"
                )
            given[name] = x
        if len(lengths) != 1:
            raise ValueError(
                f"render_jvp: all tangents must have the same leading axis, got {sorted(map(str, lengths))}"
            )
        columns = [
            self._column({name: x[k] for name, x in given.items()}) for k in range(len(next(iter(given.values()))))
        ]
        return columns, lengths != {None}

    def _column(self, given: dict) -> dict:
        """Tangents of the inputs of one column: rotations become quaternion, a twist w2c and ray tangents."""
        column = {name: given[name].to(self.home) for name in self.inputs if name in given}
        if "rotations" in given:
            q = self.inputs["quats"].to(torch.float64)
            column["quats"] = column.get("quats", 0) + 0.5 * quaternion_product(given["rotations"].to(self.home), q)
        if "camera" in given:
            omega, v = given["camera"][:3], given["camera"][3:]
            twist = torch.zeros(4, 4, dtype=torch.float64)
            twist[:3, :3], twist[:3, 3] = _cross_matrix(omega), v
            w2c = self._pose().detach()
            change = -w2c @ twist  # c2w <- exp(xi) c2w is w2c <- w2c exp(-xi)
            origin = torch.linalg.solve(
                w2c[:3, :3], (self.inputs["w2c"].cpu().detach().reshape(3, 4)[:, 3] - w2c[:3, 3])
            )
            shift = change[:3, 3] + change[:3, :3] @ origin
            column["w2c"] = torch.cat([change[:3, :3], shift[:, None]], 1).reshape(-1).to(self.home)
            if "ray_directions" in self.inputs:
                d = self.inputs["ray_directions"]
                column["ray_directions"] = torch.cross(omega.to(self.home).expand_as(d), d, dim=1)
            if "ray_origins" in self.inputs:
                o = self.inputs["ray_origins"] + origin.to(self.home)
                column["ray_origins"] = torch.cross(omega.to(self.home).expand_as(o), o, dim=1) + v.to(self.home)
        return column

    def _push_forward(self, columns: list[dict]) -> tuple[dict, list[dict]]:
        """Primal images and K tangent images (flat Dr.Jit arrays)."""
        t = self.t
        inputs = {name: to_drjit(t, x) for name, x in self.inputs.items()}
        buffers, lanes = [], []
        arguments = None
        for column in columns:
            # A fresh graph each time: the old tangents are gone.
            dr.disable_grad(inputs)
            dr.enable_grad(inputs)
            _, arguments = self.prepare(inputs)
            _, record, sh, features, lane, _ = arguments
            for name, x in inputs.items():
                if name in column:
                    dr.set_grad(x, to_drjit(t, column[name].to(self.inputs[name].dtype)))
            # A ray's direction is a lane and on the way to its SH basis: interior tangents are kept.
            dr.forward_to(record, sh, features, lane, flags=dr.ADFlag.ClearEdges)
            buffers.append({"record": [t.Float(dr.grad(x)) for x in record]})
            if sh is not None:
                buffers[-1]["sh"] = dr.grad(sh)
            if features is not None:
                buffers[-1]["features"] = dr.grad(features)
            lanes.append([dr.grad(x) + dr.zeros(t.Float, self.view.pixels) for x in lane])
            dr.eval(buffers[-1], lanes[-1])
        arguments = dr.detach(list(arguments[1:5]))
        operation = Composite()
        with dr.suspend_grad():
            primal = operation.eval(self.view, *arguments, False)
            images = operation.tangents(buffers, lanes)
        dr.eval(images)
        return primal, images


def _jvp_output(scene: Scene, pushed, batched: bool) -> Output:
    primal, images = pushed
    outputs = []
    alpha = primal["alpha"].torch().to(torch.float64)
    # d(D / max(alpha, eps)) by the quotient rule; the denominator is constant where it is clamped.
    free, alpha = alpha > EPS_ALPHA, alpha.clamp_min(EPS_ALPHA)
    for image in images:
        made = {name: x.torch() for name, x in image.items()}
        out = {"rgb": made["rgb"].reshape(*scene.shape, 3), "alpha": made["alpha"].reshape(scene.shape)}
        if "depth" in made:
            depth = primal["depth"].torch().to(torch.float64) / alpha
            change = (made["depth"] - depth * made["alpha"] * free) / alpha
            out["depth"] = change.to(torch.float32).reshape(scene.shape)
        if scene.width:
            out["features"] = made["features"].reshape(*scene.shape, scene.width)
        outputs.append({name: x.to(scene.device) for name, x in out.items()})
    if batched:
        return Output(**{name: torch.stack([o[name] for o in outputs]) for name in outputs[0]})
    return Output(**outputs[0])


def _numbers(what, x):
    """A float64 tensor of anything that torch takes for an array."""
    try:
        return torch.as_tensor(x).to(torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise ArgumentError(f"{what} must be an array of numbers, got {kind_of(x)}") from None


def _checked_rays(origins, directions, settings):
    """Float64 tensors of rays that can be traced."""
    o, d = (_numbers(f"render_rays: {n}", x) for n, x in (("origins", origins), ("directions", directions)))
    for name, x in (("origins", o), ("directions", d)):
        if x.ndim == 0 or x.shape[-1] != 3:
            raise ValueError(f"render_rays: {name} must have shape (..., 3), got {tuple(x.shape)}")
        bad = ~torch.isfinite(x).all(-1) if name == "origins" else ~((x.norm(dim=-1) > 0) & torch.isfinite(x).all(-1))
        if bool(bad.any()):
            at = tuple(bad.nonzero()[0].tolist())
            must = "finite" if name == "origins" else "finite and not 0"
            raise ValueError(f"render_rays: {name} must be {must}, got {x[at].tolist()} at index {list(at)}; drop them")
    if settings.near > 0 or (settings.order == "center" and settings.depth_key == "z"):
        raise ValueError(
            "render_rays: near and depth_key='z' are about a camera's axis, rays have none, got "
            f"near={settings.near:g}, depth_key={settings.depth_key!r}; use near=0 and depth_key='distance'"
        )
    return o, d


def to_drjit(t, x):
    """A torch tensor as a Dr.Jit tensor of its precision, without its graph."""
    return (t.TensorXf64 if x.dtype == torch.float64 else t.TensorXf)(x.detach().contiguous())


def _ray_length(t, pinhole):
    """|d| of a pinhole ray with d_z = 1."""
    fx, skew, cx, fy, cy = (t.Float(v) for v in pinhole)
    dr.make_opaque(fx, skew, cx, fy, cy)

    def length(x, y):
        v = (y - cy) / fy
        u = (x - cx - skew * v) / fx
        return dr.sqrt(dr.fma(u, u, dr.fma(v, v, 1)))

    return length


def _local_directions(camera: Camera) -> np.ndarray:
    """(H * W, 3) float64 unit directions in camera axes, distortion included."""
    identity = dataclasses.replace(camera, w2c=np.eye(4))
    return np.asarray(identity.pixel_directions(), np.float64).reshape(-1, 3)


def _cross_matrix(w):
    zero = w.new_zeros(())
    return torch.stack(
        [torch.stack([zero, -w[2], w[1]]), torch.stack([w[2], zero, -w[0]]), torch.stack([-w[1], w[0], zero])]
    )


def quaternion_product(w, q):
    """(0, w) * q for (N, 3) and (N, 4) wxyz."""
    s, v = q[:, :1], q[:, 1:]
    return torch.cat([-(w * v).sum(1, keepdim=True), s * w + torch.cross(w, v, dim=1)], 1)
