"""Building blocks of the Mitsuba scenes that generate posed data sets.

Paint is float32 sRGB in [0, 255], (height, width, 3). A mesh is a tuple of positions (n, 3), faces
(m, 3), texture coordinates (n, 2) with v = 0 at the bottom of the picture, and unit normals (n, 3)
that point outward. Cameras here are OpenCV's: +x right, +y down, +z forward, pixel centers at +0.5.
"""

from __future__ import annotations

import json

import numpy as np

from drgs.display.srgb import linear_from_srgb, srgb_from_linear
from drgs.io import interrupts
from drgs.scenes.output import DEPTH_UNIT, write_depth, write_png

__all__ = [
    "noise", "mix", "ramp", "spline", "grid", "revolve", "tube", "join", "turned", "box_corners",
    "box", "material", "shape", "dome", "sensor", "aim", "z_depth", "first_hits", "encode_srgb", "strata",
    "write_views", "axes", "pinhole_keys", "opengl",
]  # fmt: skip


# ---------------------------------------------------------------------------------- paint
def noise(rng, height, width, cells, octaves=4, stretch=1.0):
    """Value noise in [0, 1], (height, width); repeats in x, so that it closes around a revolution.

    Args:
        cells: Lattice cells across the width in the first octave.
        stretch: Lattice cells per unit of y, relative to x.
    """
    import cv2

    total = np.zeros((height, width), np.float32)
    weight = 0.0
    for octave in range(octaves):
        nx = min(cells << octave, width)
        ny = int(max(2, min(height, round(nx * stretch * height / width))))
        lattice = np.tile(rng.random((ny, nx), dtype=np.float32), (1, 3))
        wide = cv2.resize(lattice, (3 * width, height), interpolation=cv2.INTER_CUBIC)
        total += 0.5**octave * wide[:, width : 2 * width]  # only the middle third has no seam
        weight += 0.5**octave
    return np.clip((total / weight - 0.5) * 1.6 + 0.5, 0, 1)  # with more contrast; cubic interpolation overshoots


def mix(a, b, t):
    """Blend (1 - t) a + t b of two colors or pictures; t is (h, w)."""
    t = np.asarray(t, np.float32)[..., None]
    return np.asarray(a, np.float32) * (1 - t) + np.asarray(b, np.float32) * t


def ramp(t, *colors):
    """Colors (h, w, 3) looked up along t (h, w) in [0, 1], linear between equidistant stops."""
    stops = np.linspace(0, 1, len(colors))
    channels = [np.interp(t, stops, [c[k] for c in colors]) for k in range(3)]
    return np.stack(channels, -1).astype(np.float32)


# --------------------------------------------------------------------------------- meshes
def spline(points, count):
    """Catmull-Rom curve through control points (n, k) -> (count, k), evenly spaced by length."""
    p = np.asarray(points, np.float64)
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    s = np.linspace(0, len(p) - 3, 16 * count)
    i = np.minimum(s.astype(int), len(p) - 4)
    t = (s - i)[:, None]
    a = p[i]
    b = p[i + 1]
    c = p[i + 2]
    d = p[i + 3]
    curve = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.linspace(0, length[-1], count)
    return np.stack([np.interp(at, length, column) for column in curve.T], 1)


def grid(points, closed=False, uv=None):
    """Mesh of a grid of points (rows, columns, 3), smooth; `closed`: last column = first column."""
    rows, cols = points.shape[:2]
    du = np.gradient(points, axis=1)
    if closed:
        du[:, 0] = du[:, -1] = points[:, 1] - points[:, -2]
    normals = np.cross(du, np.gradient(points, axis=0))
    for pole, beside in ((0, 1), (-1, -2)):  # a row shrunk to one point has no normal of its own
        if np.ptp(points[pole], axis=0).max() < 1e-9:
            normals[pole] = normals[beside].mean(0)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-20)  # of faces without an area: 0
    if uv is None:
        uv = np.stack(np.meshgrid(np.linspace(0, 1, cols), np.linspace(0, 1, rows)), -1)
    k = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    faces = np.stack([k, k + 1, k + cols + 1, k, k + cols + 1, k + cols], 1).reshape(-1, 3)
    return points.reshape(-1, 3), faces, uv.reshape(-1, 2), normals.reshape(-1, 3)


def revolve(profile, center=(0, 0, 0), turn=(0, 0, 0), segments=72, bumps=None):
    """Surface of revolution about z, then turned, then moved.

    Args:
        profile: (rows, 2) radius and z, upward on an outer side, downward on an inner one.
        center: (3,) shift in meters.
        turn: Rotation vector in degrees.
        segments: Number of faces around the axis.
        bumps: (rows, segments) relative change of the radius, or None.
    """
    import cv2

    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radius = np.repeat(profile[:, :1], segments + 1, 1)
    if bumps is not None:
        radius = radius * (1 + np.concatenate([bumps, bumps[:, :1]], 1))
    z = np.repeat(profile[:, 1:], segments + 1, 1)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)
    rotation = cv2.Rodrigues(np.radians(np.asarray(turn, np.float64)))[0]
    return grid(points @ rotation.T + np.asarray(center), closed=True)


def tube(path, radius, segments=12):
    """Tube along a polyline (n, 3), open at its ends."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, (0.31, 0.87, 0.38))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[None, :, None]
    ring = np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None]
    return grid(path[:, None] + radius * ring, closed=True)


def join(meshes):
    """One mesh of several."""
    offsets = np.cumsum([0] + [len(m[0]) for m in meshes[:-1]])
    faces = [m[1] + first for m, first in zip(meshes, offsets, strict=True)]
    points, uv, normals = (np.concatenate([m[k] for m in meshes]) for k in (0, 2, 3))
    return points, np.concatenate(faces), uv, normals


def turned(points, degrees):
    """Points (..., 3) turned about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def box_corners(size, center, turn):
    """Corners (2, 2, 2, 3) of a box turned about z by degrees, indexed by the side of x, y, z."""
    sides = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1) * np.asarray(size)
    return turned(sides, turn) + np.asarray(center)


def box(size, center, turn):
    """A box with flat faces, painted by a picture of 3x2 cells.

    The cells are top, bottom, front in the upper row and back, right, left in the lower one.
    """
    p = box_corners(size, center, turn).reshape(8, 3)
    corners = ((1, 5, 3, 7), (4, 0, 6, 2), (0, 4, 1, 5), (6, 2, 7, 3), (4, 6, 5, 7), (2, 0, 3, 1))
    faces = []
    for k, quad in enumerate(corners):  # lower left, lower right, upper left, upper right
        u = k % 3 / 3
        v = 0.5 - k // 3 / 2
        e = 2e-3  # lookups stay inside their cell: at its border a texture is mixed with the neighbor
        uv = np.meshgrid((u + e, u + 1 / 3 - e), (v + e, v + 0.5 - e))
        faces.append(grid(p[list(quad)].reshape(2, 2, 3), uv=np.stack(uv, -1)))
    return join(faces)


# -------------------------------------------------------------------------------- Mitsuba
def material(bsdf, paint, two_sided=False):
    """A Mitsuba BSDF of what `shape` takes; it can be shared, which saves the tables of a `roughplastic`."""
    import mitsuba as mi

    if paint is not None:
        paint = np.asarray(paint) if np.ndim(paint) == 3 else np.full((2, 2, 3), paint)
        paint = np.clip(paint + 0.5, 0, 255).astype(np.uint8)
        key = "reflectance" if bsdf["type"] == "diffuse" else "diffuse_reflectance"
        bsdf = {**bsdf, key: {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(paint))}}
    if two_sided:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    return mi.load_dict(bsdf)


def shape(name, mesh, bsdf, paint=None, two_sided=False, glow=None):
    """A Mitsuba mesh.

    Args:
        name: Identifier of the shape.
        mesh: Positions, faces, texture coordinates and normals.
        bsdf: Dict of a `diffuse`, `roughplastic` or conductor plugin, or a `material` that was made of it.
        paint: Picture (h, w, 3) or one color (3,) for its (diffuse) reflectance, or None.
        two_sided: Whether its back is painted as well; costs time, so only for open sheets.
        glow: Pair of what it radiates from its front (linear radiance (3,), or a factor on its picture, decoded) and
            its share of the light paths; None: nothing.
    """
    import mitsuba as mi

    points, faces, uv, normals = mesh
    props = mi.Properties()
    if glow is not None:
        value, weight = glow
        radiance = {"type": "rgb", "value": list(value)} if np.ndim(value) else _lit(paint, value)
        props["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": radiance, "sampling_weight": weight})
    props["mesh_bsdf"] = material(bsdf, paint, two_sided) if isinstance(bsdf, dict) else bsdf
    has = {"has_vertex_normals": True, "has_vertex_texcoords": True}
    out = mi.Mesh(name, len(points), len(faces), props=props, **has)
    params = mi.traverse(out)
    uv = np.stack([uv[:, 0], 1 - uv[:, 1]], 1)  # Mitsuba's v = 0 is the first row of the picture
    for key, value in (("positions", points), ("normals", normals), ("texcoords", uv)):
        params["vertex_" + key] = mi.Float(np.ascontiguousarray(value, np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    params.update()
    return out


def _lit(paint, factor):
    """A texture of the linear radiance that a picture stands for, times a factor."""
    import mitsuba as mi

    linear = linear_from_srgb(np.clip(paint / 255.0, 0, 1)) * factor
    bitmap = mi.Bitmap(np.ascontiguousarray(linear, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


def sensor(K, width, height):
    """A Mitsuba pinhole camera with intrinsics K (3, 3) in pixels, fx = fy; `aim` sets its pose."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * width / K[0, 0]))),
            "fov_axis": "x",
            "near_clip": 0.01,
            # How far the film is moved, hence against the move of the principal point on it.
            "principal_point_offset_x": float(0.5 - K[0, 2] / width),
            "principal_point_offset_y": float(0.5 - K[1, 2] / height),
            "sampler": {"type": "multijitter"},  # half the noise of independent samples here
            "film": {**film, "pixel_format": "rgb", "component_format": "float32"},
        }
    )


def traced(scene, camera, integrator, spp, seed):
    """(height, width, 3) linear radiance of a view.

    Mitsuba makes a RuntimeError of what is raised inside: a signal ends the command there.
    """
    import mitsuba as mi

    with interrupts.in_native_code():
        return np.asarray(mi.render(scene, sensor=camera, integrator=integrator, spp=spp, seed=seed))


def aim(sensor, c2w):
    """Give a sensor the pose c2w (4, 4). Mitsuba's camera has +x to the left and +y up."""
    import mitsuba as mi

    params = mi.traverse(sensor)
    params["to_world"] = mi.Transform4f((c2w @ np.diag([-1.0, -1.0, 1.0, 1.0])).astype(np.float32))
    params.update()


def z_depth(scene, K, c2w, width, height):
    """Depth (height, width) along the optical axis at the pixel centers; 0 where nothing is hit."""
    return first_hits(scene, K, c2w, width, height)[0]


def first_hits(scene, K, c2w, width, height):
    """(depth, shape), each (height, width): `z_depth`, and the number that Dr.Jit has for the shape, 0 for none."""
    import drjit as dr
    import mitsuba as mi

    y, x = np.mgrid[:height, :width] + 0.5
    d = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    d = (d.reshape(-1, 3) @ c2w[:3, :3].T).astype(np.float32)  # unnormalized: its t is the z-depth
    origin = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in c2w[:3, 3]))
    ray = mi.Ray3f(origin, mi.Vector3f(*(mi.Float(d[:, k].copy()) for k in range(3))))
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    t = hit.t.numpy()
    number = dr.reinterpret_array(mi.UInt32, hit.shape).numpy()
    return np.where(np.isfinite(t), t, 0).reshape(height, width), number.reshape(height, width)


def axes(forward):
    """Axes (3, 3) of a camera, in columns right, down, forward: level, along a unit vector, with +z up."""
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], 1)


def dome(views, seed, center, distance, arc, elevations):
    """Jittered camera-to-world matrices (views, 4, 4) on a dome, looking at its center.

    Neighbors in index are neighbors in azimuth; counting starts inside the arc, so that the first
    view, which every split holds out, does not lie at its end.

    Args:
        center: (3,) target in meters.
        distance: Distance from the origin in meters.
        arc: Degrees of azimuth covered around the -y axis.
        elevations: Elevations in degrees, cycled through from view to view.
    """
    rng = np.random.default_rng([seed, 1])
    poses = np.tile(np.eye(4), (views, 1, 1))
    for i, jitter in enumerate(rng.uniform(-1, 1, (views, 7))):
        part = ((i + 0.5) / views + 0.31) % 1.0
        azimuth = np.radians(-90 + arc * (part - 0.5) + 2.0 * jitter[0])
        elevation = np.radians(elevations[i % len(elevations)] + 3.0 * jitter[1])
        level = np.cos(elevation)
        eye = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        eye *= distance * (1 + 0.07 * jitter[2])
        forward = center + 0.03 * distance * jitter[3:6] - eye
        forward /= np.linalg.norm(forward)
        right, down, _ = axes(forward).T
        roll = np.radians(3.0 * jitter[6])
        poses[i, :3, 0] = np.cos(roll) * right + np.sin(roll) * down
        poses[i, :3, 1] = np.cos(roll) * down - np.sin(roll) * right
        poses[i, :3, 2] = forward
        poses[i, :3, 3] = eye
    return poses


def encode_srgb(linear):
    """Linear radiance to 8-bit sRGB."""
    linear = np.clip(linear, 0, 1)  # what is brighter is overexposed
    return (srgb_from_linear(linear) * 255 + 0.5).astype(np.uint8)


# ------------------------------------------------------------------------------- data set
def pinhole_keys(K, width, height):
    """What a transforms.json says of a camera of intrinsics K (3, 3) in pixels."""
    size = {"w": width, "h": height}
    return {"camera_model": "OPENCV", "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **size}


def opengl(c2w):
    """Camera to world (4, 4) as a transforms.json has it: OpenGL's axes, in lists."""
    return (c2w @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def strata(spp):
    """`spp`, rounded up to what the sampler of `sensor` can divide a pixel into."""
    side = int(np.ceil(np.sqrt(spp)))
    return side * (side - (side * (side - 1) >= spp))


def write_views(folder, scene, K, poses, width, height, *, spp, max_depth, exposure, seed=0, progress=None):
    """Path trace `scene` and write Nerfstudio's layout: images/, depth/, transforms.json.

    Args:
        folder: Existing folder.
        K: (3, 3) intrinsics in pixels.
        poses: (views, 4, 4) camera-to-world, OpenCV axes.
        spp: Light paths a pixel; rounded up to a whole number of strata.
        max_depth: Vertices of a path after the camera.
        exposure: Factor on radiance before the sRGB curve.
        progress: Called as progress(views done, views) after each view.
    """
    import mitsuba as mi

    spp = strata(spp)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 3})
    camera = sensor(K, width, height)
    frames = []
    for sub in ("images", "depth"):
        (folder / sub).mkdir(exist_ok=True)
    for i, c2w in enumerate(poses):
        name = f"{i:03d}.png"
        if not (folder / "images" / name).exists():  # written last: with it, the view is finished
            aim(camera, c2w)
            image = encode_srgb(traced(scene, camera, integrator, spp, seed * 65536 + i) * exposure)
            write_depth(folder / "depth" / name, z_depth(scene, K, c2w, width, height))
            write_png(folder / "images" / name, image[..., ::-1])  # as BGR
        frames.append(
            {
                "file_path": f"images/{name}",
                "depth_file_path": f"depth/{name}",
                "transform_matrix": opengl(c2w),
            }
        )
        if progress is not None:
            progress(i + 1, len(poses))
    transforms = {
        **pinhole_keys(K, width, height),
        "depth_unit_scale_factor": DEPTH_UNIT,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(transforms, indent=1) + "\n")
