"""Forward mode of one call: tangents of its inputs, pushed forward to tangents of its images."""

from __future__ import annotations

import drjit as dr
import torch

from drgs.runtime import memory
from drgs.settings import EPS_ALPHA
from drgs.tracing.bridge import to_drjit
from drgs.tracing.call import OF_VIEW, Call, Output, checked_pixel_rays, numbers
from drgs.tracing.pose import quaternion_product, rigid_pose, shifted, turned, twisted
from drgs.tracing.shutter import rolling_view


def push_forward(call: Call, tangents: dict) -> Output:
    """`render_jvp`: the images' tangents along those of the parameters."""
    columns, batched = _columns(call, tangents)
    what = f"{len(columns)} tangents of {call.pixels} pixels"
    each = memory.TANGENT + 4 * call.width  # of the features only their images: a lower bound
    needed = memory.frame_bytes(call.pixels, call.settings.traversal, call.width) + each * call.pixels * len(columns)
    memory.require("render_jvp", needed, what, "take fewer at a time", call.home.type == "cuda")
    if call.count == 0 or not columns:
        still = call.output(call.nothing())
        images = {name: getattr(still, name) for name in ("rgb", "alpha", "depth", "features")}
        lead = (len(columns),) if batched else ()
        return Output(**{n: x.new_zeros(*lead, *x.shape) for n, x in images.items() if x is not None})
    primal, images = _pushed(call, columns)
    outputs = [_shaped(call, primal, image) for image in images]
    if batched:
        return Output(**{name: torch.stack([o[name] for o in outputs]) for name in outputs[0]})
    return Output(**outputs[0])


def _columns(call: Call, tangents: dict) -> tuple[list[dict], bool]:
    """K dicts of tangents of the inputs, and whether there was a leading axis."""
    shapes = {name: tuple(x.shape) for name, x in call.inputs.items() if name not in OF_VIEW}
    if "quats" in shapes:
        shapes["rotations"] = (shapes["quats"][0], 3)
    shapes["camera"] = (6,)
    if call.pixel_rays is not None:
        shapes["rays"] = tuple(call.pixel_rays.shape)
    else:
        shapes["lens"] = call.camera.lens_parameters.shape
        if call.camera.is_rolling:
            shapes["camera_end"] = (6,)
    lengths = set()
    given = {}
    for name, x in tangents.items():
        if name not in shapes:
            raise ValueError(f"render_jvp: tangents must be named among {', '.join(shapes)}, got {name!r}")
        x = numbers("render_jvp", f"tangent of {name}", x).detach()  # nothing differentiates a tangent
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
        raise ValueError(f"render_jvp: all tangents must have the same leading axis, got {sorted(map(str, lengths))}")
    count = len(next(iter(given.values())))
    return [_column(call, {name: x[k] for name, x in given.items()}) for k in range(count)], lengths != {None}


def _column(call: Call, given: dict) -> dict:
    """Tangents of the inputs of one column: rotations become quaternion, a twist w2c and ray tangents."""
    column = {name: given[name].to(call.home) for name in call.inputs if name in given}
    if "rotations" in given:
        q = call.inputs["quats"].to(torch.float64)
        column["quats"] = column.get("quats", 0) + 0.5 * quaternion_product(given["rotations"].to(call.home), q)
    if call.free:
        return column | _free_column(call, given)
    if "lens" in given:
        lens = torch.from_numpy(call.camera.lens_parameters.copy())
        local, moved = torch.func.jvp(call.motion.directions, (lens,), (given["lens"].cpu(),))
        if "ray_shifts" in call.inputs:
            shifts = lambda directions: call.motion.shifts(directions, call.is_wide())  # noqa: E731
            column["ray_shifts"] = torch.func.jvp(shifts, (local,), (moved,))[1].to(call.home)
        if "ray_directions" in call.inputs:
            turn = rigid_pose(call.camera).detach()[:3, :3]  # numbers: where the derivative is taken
            column["ray_directions"] = (moved @ turn).to(call.home)
    if "camera" in given:
        twist = given["camera"]
        w2c = rigid_pose(call.camera).detach()  # numbers: where the derivative is taken
        # The inputs are of a re-centered world: w2c there is that of x + origin.
        column["w2c"] = shifted(twisted(w2c, twist), call.origin).to(call.home)
        if "ray_directions" in call.inputs:
            turning = turned(twist[:3], call.inputs["ray_directions"])
            column["ray_directions"] = column.get("ray_directions", 0) + turning
        if "ray_origins" in call.inputs:
            o = call.inputs["ray_origins"] + call.origin.to(call.home)
            column["ray_origins"] = turned(twist[:3], o) + twist[3:].to(call.home)
    return column


def _free_column(call: Call, given: dict) -> dict:
    """Tangents of w2c and of the rays of pixels that have no common origin."""
    column = {}
    if call.pixel_rays is not None:
        if "camera" in given:  # the rays are the caller's: what moves is from where colors are seen
            # Numbers: where the derivative is taken.
            moved = twisted(rigid_pose(call.camera).detach(), given["camera"])
            column["w2c"] = shifted(moved, call.origin).to(call.home)
        if "rays" in given:
            ways = lambda rays: checked_pixel_rays(rays, call.camera)[:2]  # noqa: E731
            _, (o, d) = torch.func.jvp(ways, (call.pixel_rays.detach(),), (given["rays"],))
            column |= {"ray_origins": o.to(call.home), "ray_directions": d.to(call.home)}
        return column
    camera = call.camera
    if not {"camera", "camera_end", "lens"} & set(given):
        return column
    poses = rigid_pose(camera).detach(), rigid_pose(camera, "w2c_end").detach()  # numbers, as above
    lens = torch.from_numpy(camera.lens_parameters.copy())

    def view(start: torch.Tensor, end: torch.Tensor, lens: torch.Tensor) -> tuple[torch.Tensor, ...]:
        local = call.motion.directions(lens) if "lens" in given else call.local_directions()
        pose, o, d = rolling_view(camera, start, end, local, call.zero)
        return shifted(pose, call.origin), o - call.origin, d

    twists = [
        twisted(pose, given[name]) if name in given else torch.zeros_like(pose)
        for pose, name in zip(poses, ("camera", "camera_end"), strict=True)
    ]
    primals = (*poses, lens)
    _, moved = torch.func.jvp(view, primals, (*twists, given.get("lens", torch.zeros_like(lens)).cpu()))
    return {name: x.to(call.home) for name, x in zip(("w2c", "ray_origins", "ray_directions"), moved, strict=True)}


def _pushed(call: Call, columns: list[dict]) -> tuple[dict, list[dict]]:
    """Primal images and K tangent images (flat Dr.Jit arrays)."""
    lib = call.lib
    inputs = {name: to_drjit(lib, x) for name, x in call.inputs.items()}
    buffers, carried = [], []
    for column in columns:
        # A fresh graph each time: the old tangents are gone.
        dr.disable_grad(inputs)
        dr.enable_grad(inputs if call.field is None else {name: inputs[name] for name in column})
        compositor, arguments = call.prepare(inputs)
        for name, x in inputs.items():
            if name in column:
                dr.set_grad(x, to_drjit(lib, column[name].to(call.inputs[name].dtype)))
        # A ray carries its direction, which is on the way to its SH basis, too: interior tangents are kept.
        dr.forward_to(*arguments, flags=dr.ADFlag.ClearEdges)
        buffers.append({"record": [lib.Float(dr.grad(x)) for x in arguments.record]})
        if arguments.sh is not None:
            buffers[-1]["sh"] = dr.grad(arguments.sh)
        if arguments.features is not None:
            buffers[-1]["features"] = dr.grad(arguments.features)
        carried.append([dr.grad(x) + dr.zeros(lib.Float, call.pixels) for x in arguments.carried])
        dr.eval(buffers[-1], carried[-1])
    # What is composited is the same for all columns; its tangents are carried along, not recorded.
    with dr.suspend_grad():
        primal = compositor.forward(*dr.detach(list(arguments)), keep=False, columns=len(columns))
        images = compositor.tangents(buffers, carried)
    dr.eval(images)
    return primal, images


def _shaped(call: Call, primal: dict, image: dict) -> dict:
    """One tangent of the `Output`."""
    tangent = {name: x.torch() for name, x in image.items()}
    out = {"rgb": tangent["rgb"].reshape(*call.shape, 3), "alpha": tangent["alpha"].reshape(call.shape)}
    if "depth" in tangent:
        # d(D / max(alpha, eps)) by the quotient rule; the denominator is constant where it is clamped.
        alpha = primal["alpha"].torch().to(torch.float64)
        free = alpha > EPS_ALPHA
        alpha = alpha.clamp_min(EPS_ALPHA)
        depth = primal["depth"].torch().to(torch.float64) / alpha
        change = (tangent["depth"] - depth * tangent["alpha"] * free) / alpha
        out["depth"] = change.to(torch.float32).reshape(call.shape)
    if call.width:
        out["features"] = tangent["features"].reshape(*call.shape, call.width)
    return {name: x.to(call.device) for name, x in out.items()}
