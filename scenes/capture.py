"""A still life as somebody captures it: auto exposure, a white wall, a shadow, a passer-by, poses that are a bit wrong.

The table of `drgs.scenes.still_life` stands before a wall, and somebody walks around it with a camera. Each thing that
real captures have, and that a static scene does not explain, is an ingredient that can be left out, and its truth lies
beside the photographs:

- **Exposure and white balance.** A photograph is the linear light times a gain per channel, through a tone curve that
  is a power (1 / 2.2), clipped and rounded to 8 bits. So its values are those of a camera with fixed exposure times
  exp(log gain), exactly, until they are clipped. Half of a view's brightness is taken out by its gain, as auto exposure
  does, the rest drifts from photograph to photograph, white balance slowly. Log gains (of values, natural) have zero
  mean over the training photographs in each channel.
- **A white wall** behind the table, one color without texture, in place of wallpaper.
- **The photographer's shadow.** In known photographs a body and a head stand behind the camera and in the light of the
  lamp: the shadow is path traced.
- **A passer-by** stands between table and wall in known photographs, and throws a shadow, too.
- **Poses.** Those of the training photographs are stated wrong by a known amount. Held-out photographs keep true poses:
  one with a wrong pose measures nothing. The errors hold no motion and no scale that all cameras have in common, so a
  model of the training photographs lies where the held-out ones look for it.

Held-out photographs show neither shadow nor passer-by; their exposure is as that of the others.

World: meters, +z up, table top at z = 0, the wall at y = 0.95. Files, in COLMAP's layout:

- images/NNN.png (8 bits), sparse/0 (COLMAP model, text): stated poses, observations in the photographs as they are, and
  points where their rays meet under the stated poses, so that reprojection errors show how wrong poses are,
- truth/shadow/NNN.png, truth/passer_by/NNN.png: 255 where a pixel is changed by more than what `_CHANGED` says,
- truth.json (docs/run-files.md), params.json.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from drgs import runtime, scenes
from drgs.scenes import grid, join, labelled, mix, noise, output, revolve, spline, still_life, tube
from drgs.scenes.colmap import project, sparse_points, write_model
from drgs.scenes.furniture import MATTE

__all__ = ["TEST_EVERY", "generate"]

_VERSION = 1  # bump when a file changes: finished folders of another version are made again
TEST_EVERY = 8  # the split that `drgs fit` makes by default: every eighth photograph is held out, from the first
_FOV_X = 55.0  # degrees across the image width
_MAX_DEPTH = 4  # vertices of a path after the camera
_EXPOSURE = 0.55  # factor on radiance of a camera with fixed exposure
_GAMMA = 2.2  # tone curve: value = light^(1 / 2.2)
_POINTS = 4000  # sparse points that are drawn
_PIXEL = 0.2  # standard deviation of what is observed, in pixels
_CENTER = np.array([0.0, 0.0, 0.13])  # what the camera looks at
_WALL = 0.95  # y of the wall
_FLOOR = -0.75  # z of the floor
_LAMP = np.array([-0.6, -5.0, 2.5])
_ADAPTED = 0.5  # share of a view's brightness, as a log, that auto exposure takes out
_DRIFT = 0.26  # standard deviation of what exposure does besides, in log light
_BALANCE = np.array([0.24, 0.06, 0.36])  # amplitudes of the drift of white balance in log light: red, green, blue
_CHANGED = 0.02  # change of a value, as a mean over 3x3 pixels and channels, from which on a pixel counts as changed


def _parts(seed, wall):
    """Arguments of `scenes.shape` of what stands there in every photograph."""
    rng = np.random.default_rng([seed, 31])
    x, z = np.meshgrid((6.0, -6.0), (_FLOOR, 2.6))
    sheet = grid(np.stack([-x, 0 * x + _WALL, z], -1))
    yield "wall", sheet, MATTE, (226, 225, 221) if wall == "white" else still_life.wallpaper(rng)
    plane = np.stack(np.meshgrid((-6.0, 6.0), (-4.0, _WALL), _FLOOR), -1)[:, :, 0]
    yield "floor", grid(plane), MATTE, still_life.stone(rng)
    yield from still_life.table(rng)
    yield from still_life.objects(rng)


def _standing(seed, wall):
    """Entries of a Mitsuba scene: what is there in every photograph, and the lights."""
    runtime.mitsuba()  # sets the variant that shapes are of
    return {part[0]: scenes.shape(*part) for part in _parts(seed, wall)} | _lights()


def _lights():
    """A lamp behind the photographer, so that shadows fall into the picture, and a bright sky."""
    mi = runtime.mitsuba()
    to_world = mi.ScalarTransform4f().look_at(_LAMP.tolist(), [0, 0.4, 0.1], [0, 0, 1]).scale([0.28, 0.28, 1])
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [480.0, 430.0, 355.0]}, "sampling_weight": 0.75}
    sky = {"type": "rgb", "value": [0.25, 0.27, 0.31]}
    return {
        "lamp": {"type": "rectangle", "to_world": to_world, "emitter": lamp},
        "sky": {"type": "constant", "radiance": sky, "sampling_weight": 0.25},
    }


def _body(at, height, turn):
    """Meshes of a person who stands at `at` (x, y): head, trunk with arms, legs; the names say what is what."""
    shoulder = height - 0.32
    trunk = [(0.0, 0.8), (0.13, 0.8), (0.16, 0.9), (0.15, 1.05), (0.19, shoulder - 0.05), (0.17, shoulder)]
    trunk = spline(np.array([*trunk, (0.06, shoulder + 0.05), (0.055, shoulder + 0.11)]), 40)
    phi = np.linspace(-np.pi / 2, np.pi / 2, 30)
    head = np.stack([0.085 * np.cos(phi), 0.115 * np.sin(phi)], 1)
    foot = np.array([*at, _FLOOR])
    side = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0])
    yield "head", revolve(head, foot + (0, 0, height - 0.115), segments=40)
    yield "trunk", revolve(trunk, foot, segments=48)
    arms = []
    for way in (-1, 1):
        arm = [way * 0.15 * side + (0, 0, shoulder - 0.04), way * 0.23 * side + (0, 0, shoulder - 0.2)]
        arm = spline(foot + np.array([*arm, way * 0.24 * side + (0, 0, 0.75)]), 16)
        arms.append(tube(arm, 0.05))
    yield "arms", join(arms)
    legs = [tube(spline(foot + way * 0.08 * side + np.array([(0, 0, 0.0), (0, 0, 0.85)]), 8), 0.08) for way in (-1, 1)]
    yield "legs", join(legs)


def _person(rng, at, height, turn):
    """Arguments of `scenes.shape` of a person in a striped shirt."""
    shirt, other = rng.integers(30, 220, (2, 3))
    stripes = np.where((np.arange(256) % 32 < 16)[:, None, None], shirt, other).repeat(64, 1)
    paints = {
        "head": mix((176, 122, 92), (70, 44, 30), np.linspace(1, 0, 64)[:, None].repeat(64, 1) > 0.55),
        "trunk": stripes * (0.85 + 0.3 * noise(rng, 256, 64, 12)[..., None]),
        "arms": shirt,
        "legs": (44, 52, 84),
    }
    for name, mesh in _body(at, height, turn):
        yield f"person_{name}", mesh, MATTE, paints[name], True


def _head(c2w):
    """(3,) top of the head of who holds a camera: behind it, and a little above."""
    back = -c2w[:2, 2] / np.linalg.norm(c2w[:2, 2])
    return c2w[:3, 3] + np.array([*(0.30 * back), 0.22])


def _photographer(c2w):
    """Arguments of `scenes.shape` of who holds a camera."""
    *at, top = _head(c2w)
    turn = np.degrees(np.arctan2(-c2w[0, 2], c2w[1, 2]))
    for name, mesh in _body(at, top - _FLOOR, turn):
        yield f"photographer_{name}", mesh, MATTE, (72, 66, 62), True


class _Cast:
    """Who is in which photograph.

    Attributes:
        held_out: Numbers of the photographs that are held out.
        shadow, passer_by: Those that have one, in order.
    """

    def __init__(self, poses, seed, shadow, passer_by):
        views = len(poses)
        rng = np.random.default_rng([seed, 32])
        self.held_out = list(range(0, views, TEST_EVERY))
        train = [k for k in range(views) if k not in self.held_out]
        count = max(1, round(len(train) / 8))
        # The nearer the ray from the lamp through a head comes to the things on the table, the more of the shadow is
        # in the picture.
        ray = np.array([_head(pose) for pose in poses]) - _LAMP
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.linalg.norm(np.cross(ray, _CENTER - _LAMP), axis=1)
        self.shadow = sorted(sorted(train, key=lambda k: across[k])[:count]) if shadow else []
        rest = [k for k in train if k not in self.shadow]
        self.passer_by = sorted(rng.choice(rest, min(count, len(rest)), replace=False).tolist()) if passer_by else []
        self._people = {k: rng.uniform((-0.22, 1.55, -40), (0.22, 1.75, 40)) for k in self.passer_by}
        self._seed = seed
        self._poses = poses

    def extra(self, k):
        """Arguments of `scenes.shape` of who is there in a photograph alone."""
        pose = self._poses[k]
        if k in self.shadow:
            yield from _photographer(pose)
        if k in self.passer_by:
            shift, height, turn = self._people[k]
            ahead = _CENTER[:2] - pose[:2, 3]
            x = pose[0, 3] + ahead[0] * (0.72 - pose[1, 3]) / max(ahead[1], 0.2) + shift
            rng = np.random.default_rng([self._seed, 33])  # the same clothes in all photographs
            yield from _person(rng, (float(np.clip(x, -0.9, 0.9)), 0.72), height, turn)


def _trace(folder, built, cast, K, poses, size, spp, seed, progress):
    """Trace every view that is not finished: what the camera sees and, where somebody is there, what it saw without."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "path", "max_depth": _MAX_DEPTH, "rr_depth": 3})
    camera = scenes.sensor(K, *size)
    spp = scenes.strata(spp)
    empty = built(())
    for k, c2w in enumerate(poses):
        path = folder / "light" / f"{k:03d}.npz"
        if not path.exists():
            scenes.aim(camera, c2w)
            light = {"seen": empty}
            if k in cast.shadow or k in cast.passer_by:
                light = {"seen": built(cast.extra(k)), "empty": empty}
            depth = scenes.z_depth(light["seen"], K, c2w, *size)
            # With the same seed, a pixel has the same paths where nobody stands in their way: what differs is real.
            light = {name: scenes.traced(s, camera, integrator, spp, seed * 65536 + k) for name, s in light.items()}
            hidden = folder / "light" / ".part.npz"
            np.savez(hidden, depth=depth, **light)
            hidden.replace(path)
        if progress is not None:
            progress(k + 1, len(poses))


def _values(light):
    """Values in [0, inf) of a camera with fixed exposure; what is above 1 is clipped after gains."""
    return (np.maximum(light, 0) * _EXPOSURE) ** (1 / _GAMMA)


def _log_gains(means, train, seed):
    """(views, 3) natural log gains of values: auto exposure and the drift of white balance, zero mean in training.

    Args:
        means: (views,) mean light of each view, as a fixed camera sees it.
        train: Numbers of the training photographs.
    """
    rng = np.random.default_rng([seed, 34])
    views = len(means)
    light = -_ADAPTED * np.log(means)[:, None] + _DRIFT * rng.standard_normal((views, 1))
    periods, phase = rng.uniform(0.8, 1.6, 3), rng.uniform(0, 2 * np.pi, 3)
    along = np.arange(views)[:, None] / views
    balance = _BALANCE * (np.sin(2 * np.pi * (periods * along) + phase) + 0.3 * rng.standard_normal((views, 3)))
    gains = (light + balance) / _GAMMA  # light^(1 / 2.2): a factor on light is this factor on values
    return gains - gains[train].mean(0)


def _wrong_poses(poses, train, degrees, meters, seed):
    """Stated poses (views, 4, 4): each of the training cameras turned about its center and moved.

    Turns have a root mean square of `degrees`, moves of `meters`. What all cameras have in common is taken out of
    both: the mean turn, and of the moves the mean, a rotation about the middle of the cameras and a change of scale.
    """
    import cv2

    if not (degrees or meters):
        return poses
    rng = np.random.default_rng([seed, 35])
    turns, moves = rng.standard_normal((2, len(train), 3))
    arms = poses[train, :3, 3] - poses[train, :3, 3].mean(0)
    turns -= turns.mean(0)
    moves -= moves.mean(0)
    common = [np.cross(axis, arms).ravel() for axis in np.eye(3)] + [arms.ravel()]
    basis = np.linalg.qr(np.stack(common, 1))[0]
    moves = (moves.ravel() - basis @ (basis.T @ moves.ravel())).reshape(-1, 3)
    turns *= np.radians(degrees) / np.sqrt((turns**2).sum(1).mean())
    moves *= meters / np.sqrt((moves**2).sum(1).mean())
    stated = poses.copy()
    for k, turn, move in zip(train, turns, moves, strict=True):
        stated[k, :3, :3] = cv2.Rodrigues(turn)[0] @ poses[k, :3, :3]
        stated[k, :3, 3] += move
    return stated


def _write_mask(path, empty, seen):
    """255 where two pictures of values differ."""
    import cv2

    change = cv2.blur(np.abs(np.minimum(seen, 1) - np.minimum(empty, 1)).mean(2).astype(np.float32), (3, 3))
    path.parent.mkdir(parents=True, exist_ok=True)
    output.write_png(path, (255 * (change > _CHANGED)).astype(np.uint8))


def _triangulate(K, poses, points):
    """Move points to where the rays of their observations meet, in least squares, under the poses that are stated.

    So a model is as consistent as structure from motion would make it, and its reprojection errors are those of
    observations and poses. Points that were matched wrongly stay.
    """
    normal = np.zeros((len(points.xyz), 3, 3))
    right = np.zeros((len(points.xyz), 3))
    for c2w, (ids, pixels) in zip(poses, points.tracks, strict=True):
        ray = np.concatenate([pixels, np.ones((len(ids), 1))], 1) @ np.linalg.inv(K).T @ c2w[:3, :3].T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        # A pixel is wider farther away: distances to the ray count in units of that to the point.
        weight = 1 / ((points.exact[ids] - c2w[:3, 3]) ** 2).sum(1)
        across = weight[:, None, None] * (np.eye(3) - ray[:, :, None] * ray[:, None])
        np.add.at(normal, ids, across)
        np.add.at(right, ids, across @ c2w[:3, 3])
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    points.xyz = np.where(points.outlier[:, None], points.xyz, found)


def _errors(K, poses, points):
    """(n,) mean reprojection error of each point in pixels, under the poses that are stated."""
    total = np.zeros(len(points.xyz))
    count = np.zeros(len(points.xyz))
    for c2w, (ids, pixels) in zip(poses, points.tracks, strict=True):
        error = np.linalg.norm(project(K, c2w, points.xyz[ids])[0] - pixels, axis=1)
        np.add.at(total, ids, error)
        np.add.at(count, ids, 1)
    return total / np.maximum(count, 1)


def _finish(folder, cast, K, poses, size, seed, exposure, pose_error):
    """Develop the photographs, and write the model and the truth."""
    views = len(poses)
    names = [f"{k:03d}.png" for k in range(views)]
    train = [k for k in range(views) if k not in cast.held_out]
    light = [np.load(folder / "light" / f"{k:03d}.npz") for k in range(views)]
    light = [{name: part[name] for name in part.files} for part in light]
    means = np.array([part["seen"].mean() for part in light])
    gains = _log_gains(means, train, seed) if exposure == "auto" else np.zeros((views, 3))
    images = []
    (folder / "images").mkdir(exist_ok=True)
    for k, part in enumerate(light):
        values = _values(part["seen"])
        images.append((np.clip(values * np.exp(gains[k]), 0, 1) * 255 + 0.5).astype(np.uint8))
        output.write_png(folder / "images" / names[k], images[-1][..., ::-1])  # as BGR
        for kind, who in (("shadow", cast.shadow), ("passer_by", cast.passer_by)):
            if k in who:
                _write_mask(folder / "truth" / kind / names[k], _values(part["empty"]), values)
    # Points are seen where they are; their observations are of the photographs, from where these were taken.
    none = np.zeros(size[::-1], np.uint8)
    points = sparse_points(K, poses, lambda k: (images[k], light[k]["depth"], none), _POINTS, seed, _PIXEL)
    stated = _wrong_poses(poses, train, *pose_error, seed)
    (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    _triangulate(K, stated, points)
    errors = _errors(K, stated, points)
    write_model(folder / "sparse" / "0", K, stated, names, *size, points, errors)
    truth = {
        "held_out": [names[k] for k in cast.held_out],
        "log_gains": {name: gain.tolist() for name, gain in zip(names, gains, strict=True)},
        "shadow": {names[k]: f"truth/shadow/{names[k]}" for k in cast.shadow},
        "passer_by": {names[k]: f"truth/passer_by/{names[k]}" for k in cast.passer_by},
        "camera_to_world": {name: pose.tolist() for name, pose in zip(names, poses, strict=True)},
        "pose_error": {"degrees": pose_error[0], "meters": pose_error[1]},
    }
    output.write_file(folder / "truth.json", (json.dumps(truth, indent=1) + "\n").encode())
    shutil.rmtree(folder / "light")  # last: until then an interrupted call goes on with it


def generate(
    out_dir,
    views=28,
    width=240,
    height=180,
    spp=25,
    seed=0,
    exposure="auto",
    wall="white",
    shadow=True,
    passer_by=True,
    pose_error=(0.4, 0.006),
    progress=None,
) -> Path:
    """Make the data set, unless `out_dir` already holds it; an interrupted call is continued.

    Args:
        out_dir: Folder to make. It appears when it is complete. One made here with other parameters is replaced;
            anything else that is not empty is refused.
        views: Number of photographs; every eighth, from the first, is held out.
        width, height: Image size in pixels.
        spp: Light paths a pixel.
        seed: Seed of the scene, poses, light paths, gains, who is in which photograph, and errors.
        exposure: `auto`, or `fixed`: log gains are 0.
        wall: `white`, or `paper`: with flowers and pictures.
        shadow: Whether the photographer's shadow is in some photographs.
        passer_by: Whether somebody passes by in some others.
        pose_error: Root mean square of the errors of training poses: (degrees, meters).
        progress: Function that is called with (views done, views) after each view.
    Returns:
        `out_dir` as a Path.
    Raises:
        ValueError: If a number is out of range or `out_dir` holds something else.
    """
    where = "drgs.scenes.capture"
    values = {"views": views, "width": width, "height": height, "spp": spp, "seed": seed}
    output.check_numbers(values, where)
    if views < 4:
        raise ValueError(f"{where}: views must be at least 4, got {views}; choose more")
    for name, value, known in (("exposure", exposure, ("auto", "fixed")), ("wall", wall, ("white", "paper"))):
        if value not in known:
            raise ValueError(f"{where}: {name} must be {' or '.join(known)}, got {value!r}; choose one")
    pose_error = tuple(float(v) for v in pose_error)
    if len(pose_error) != 2 or not (0 <= pose_error[0] <= 10 and 0 <= pose_error[1] <= 0.1):
        raise ValueError(
            f"{where}: pose_error must be degrees from 0 to 10 and meters from 0 to 0.1, "
            f"got {pose_error}; choose others"
        )
    parameters = {"scene": "capture", "version": _VERSION, **values, "exposure": exposure, "wall": wall}
    parameters |= {"shadow": bool(shadow), "passer_by": bool(passer_by), "pose_error": list(pose_error)}

    def fill(folder):
        mi = runtime.mitsuba()
        (folder / "light").mkdir(exist_ok=True)
        standing = _standing(seed, wall)

        def built(extra):
            return mi.load_dict({"type": "scene"} | standing | {part[0]: scenes.shape(*part) for part in extra})

        K = labelled.intrinsics(width, height, _FOV_X)
        poses = scenes.dome(views, seed, _CENTER, 1.15, 105.0, (14.0, 26.0, 38.0))
        cast = _Cast(poses, seed, shadow, passer_by)
        size = width, height
        _trace(folder, built, cast, K, poses, size, spp, seed, progress)
        _finish(folder, cast, K, poses, size, seed, exposure, pose_error)

    return output.publish(Path(out_dir), parameters, fill, where)
