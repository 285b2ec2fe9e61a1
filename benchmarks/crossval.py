"""What `drgs crossval` says of correct and broken rasterizers and of outside code: rows, and docs/crossval.md of them.

    python benchmarks/crossval.py [--only alarms|poses|broken|paths|rays|eval3d|outside] [--seeds 50] [--page]

Correct ones, for false alarms (`alarms`): our presets against the oracle, and gsplat's own torch code (examples/) where
it is installed. Each seed has its cotangents and its view of a real scene, and the crop of it that the command takes.
Rows are kept in crossval.json, crossval_poses.json and crossval_broken.json: a run that was stopped goes on. `poses`:
the same for gradients of poses and of colors of six channels, four seeds each.

Other paths than a view's colors (`paths`): a right rasterizer with depth modes, several cameras and packed arrays,
copies of it that are broken on one path, and one along rays whose lens loses the geometry. Rows in crossval_paths.json.

Along rays (`rays`, `eval3d`): the right rasterizer of tests/torch_rays.py and copies that are broken on purpose, and
gsplat 1.6's own torch code (examples/gsplat_eval3d.py), through a pinhole, OpenCV's lens and a fisheye. Rows are kept
in crossval_rays.json and crossval_eval3d.json; those of gsplat's code are made where gsplat 1.6 can be imported.

Outside code: gsplat's again, and Mitsuba's `volprim_rf_basic`. Scenes: random ones, and of real scenes (DRGS_DATA) the
2,000 Gaussians that weigh most in a view of 64x48 pixels (250 at 48x40 for the broken ones, which are dense). These
rows are docs/data/crossval-outside.csv itself.

The page's table, its picture and the other docs/data/crossval-*.csv are made of the rows; where rows were made is said
on the page by hand.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import math
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import studies
import torch
from pages import fill_between  # noqa: E402
from studies import DATA, ROOT

import sys  # isort: skip

sys.path[:0] = [str(ROOT / "tests")]

import torch_rasterizer  # noqa: E402
import torch_rays  # noqa: E402

import drgs  # noqa: E402
from drgs.cameras import Camera  # noqa: E402
from drgs.cameras.sizes import at_most  # noqa: E402
from drgs.commands.orbits import OrbitShape, scene_orbit  # noqa: E402
from drgs.data import load as load_data  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.files import load_ply  # noqa: E402
from drgs.lab.crossval import VERDICTS, Result, crops, crossval  # noqa: E402
from drgs.lab.parameters import PARAMETERS, POSE_END, raw_of, with_pose  # noqa: E402
from drgs.lab.rasterizers import cotangents, function, load_rasterizer  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402
from drgs.testing import random_scene  # noqa: E402

BACKGROUND = (0.3, 0.6, 0.2)
PAGE = ROOT / "docs" / "crossval.md"
CSV = ROOT / "docs" / "data"
GROUPS = (*PARAMETERS, "viewmats", "colors")
OUTSIDE_GSPLAT = "examples.gsplat_torch:rasterization"
OUTSIDE = {
    "gsplat 1.5.3, its torch code": (OUTSIDE_GSPLAT, "gsplat"),
    "volprim_rf_basic, sRGB step off": ("examples.volprim_adapter:volprim_rf_basic_linear", "mitsuba"),
    "volprim_rf_basic, as shipped": ("examples.volprim_adapter:volprim_rf_basic", "mitsuba"),
}


SPLATS = {"wolf": "wolf/wolf.ply", "train_1000": "train_1000/train-1000.ply"}
FITS = ("banana", "office", "statue")
FIT = ("--max-pixels", "25000", "--max-steps", "600")
CORRECT = ("drgs:exact", "drgs:fast", "drgs:inria", "drgs:gsplat", OUTSIDE_GSPLAT)
CHOSEN_ON = ("wolf", "banana")  # where it was chosen what counts as a near tie: fewer seeds
FEWER = 8
DOCUMENTED = ("view_direction_detached", "clamp_passes_gradient")  # are choices, and no bug
BROKEN = Path(__file__).with_name("crossval_broken.json")
ROWS = Path(__file__).with_suffix(".json")
POSES = Path(__file__).with_name("crossval_poses.json")
PATHS = Path(__file__).with_name("crossval_paths.json")
RAYS = Path(__file__).with_name("crossval_rays.json")
EVAL3D = Path(__file__).with_name("crossval_eval3d.json")
OWN_EVAL3D = "examples.gsplat_eval3d:rasterization"
RAY_SEEDS = 2
RAY_FIELDS = {"background": BACKGROUND, "culling": "extent"}  # dense code has no boxes of the unscented transform
RAY_SPLATS = 100  # of a real scene those that weigh most: the rasterizer in torch is dense
POSE_SEEDS = 4
MOVING = ("covariance_off_diagonal", "background_gradient", "clamp_passes_gradient")  # are wrong for the pose, too


def real_scenes(runs: Path) -> dict[str, tuple]:
    """Name -> (Gaussians, cameras) of the splats, from an orbit, and of short fits of captures, from their views."""
    scenes = {}
    for name, path in SPLATS.items():
        if (DATA / "splats" / path).exists():
            g = load_ply(DATA / "splats" / path)
            scenes[name] = g, scene_orbit(g, 50, width=163, height=122, fixed=OrbitShape(elevation=10.0))
    for name in FITS:
        if not (DATA / name).exists():
            continue
        run = runs / f"crossval-{name}"
        if not (run / "point_cloud.ply").exists():
            command = [sys.executable, "-m", "drgs", "fit", DATA / name, "-o", run, *FIT]
            subprocess.run([str(part) for part in command], check=True, cwd=ROOT)
        views = load_data(DATA / name, lazy=True, points=False).views
        cameras = [dataclasses.replace(view.camera.undistorted(), name=view.name) for view in views]
        scenes[name] = load_ply(run / "point_cloud.ply"), [at_most(camera, 20_000) for camera in cameras]
    if not scenes:
        raise SystemExit(f"no real scene in {DATA}; set DRGS_DATA")
    return scenes


def heaviest(g: Gaussians, camera: Camera, count: int) -> tuple:
    """The Gaussians that weigh most in one view."""
    weight = drgs.render(g, camera, outputs=("visibility",)).visibility
    index = torch.topk(weight, min(count, len(g))).indices
    return Gaussians(**{name: getattr(g, name)[index] for name in PARAMETERS}), [camera]


def wolf(count: int, width: int, height: int) -> tuple | None:
    """The Gaussians of the wolf that weigh most in one view."""
    path = DATA / "splats" / SPLATS["wolf"]
    if not path.exists():
        return None
    g = load_ply(path)
    camera = scene_orbit(g, 8, width=width, height=height, fixed=OrbitShape(fov=70, elevation=10.0))[0]
    return heaviest(g, camera, count)


def alarms(runs: Path, seeds: int) -> None:
    """Verdicts of `seeds` seeds on each real scene."""
    rows = studies.read_rows(ROWS, {})
    scenes = real_scenes(runs)
    names = [n for n in CORRECT if n.startswith("drgs:") or importlib.util.find_spec("gsplat")]
    for seed in range(seeds):
        for scene, (g, cameras) in scenes.items():
            for name in names if seed < (FEWER if scene in CHOSEN_ON else seeds) else ():
                key = f"{name} {scene} {seed}"
                if key not in rows:
                    rows[key] = _alarm(name, g, cameras[seed % len(cameras)], seed)
                    studies.write_rows(ROWS, rows)
                    print(key, rows[key]["verdict"], f"{rows[key]['seconds']:.1f} s", flush=True)


def poses(runs: Path) -> None:
    """The pose's gradient and that of six channels, on each real scene."""
    rows = studies.read_rows(POSES, {})
    scenes = real_scenes(runs)
    names = [n for n in CORRECT if n.startswith("drgs:") or importlib.util.find_spec("gsplat")]
    for seed in range(POSE_SEEDS):
        for scene, (g, cameras) in scenes.items():
            for name in names:
                key = f"{name} {scene} {seed}"
                if key not in rows:
                    rows[key] = _alarm(name, g, cameras[(7 * seed + 3) % len(cameras)], seed)
                    studies.write_rows(POSES, rows)
                    print(key, rows[key], flush=True)


def _alarm(name: str, g: Gaussians, camera: Camera, seed: int) -> dict:
    """What is said of one rasterizer on one view's crop."""
    fields = {"background": BACKGROUND}
    start = time.process_time()
    views = [camera]
    if not name.startswith("drgs:"):  # what the command crops for ours is cropped for it here: it is slow
        g, views, _ = crops(g, views, RenderSettings.preset("gsplat", **fields))
    found = crossval(load_rasterizer(name, fields=fields), g, views, "auto", fields, seed=seed).report
    return {
        "verdict": found["verdict"],
        "view": camera.name,
        "relative": [found["groups"][group]["relative"] for group in PARAMETERS],
        "pose": found["groups"].get("viewmats", {}).get("relative"),
        "colors": found["groups"].get("colors", {}).get("relative"),
        "gaussians": found["gaussians"],
        "near_ties": found["near_ties"],
        "pixels": found["pixels"],
        "seconds": time.process_time() - start,
    }


def shrunk(scene: tuple, factor: float) -> tuple:
    """The same picture of a world in other units."""
    g, (camera,) = scene
    w2c = camera.w2c.copy()
    w2c[:3, 3] *= factor
    g = g.replace(means=g.means * factor, log_scales=g.log_scales + math.log(factor))
    return g, [dataclasses.replace(camera, w2c=w2c)]


def broken(runs: Path) -> None:
    """Every defect on every scene."""
    scenes = small_scenes(runs)
    rows = studies.read_rows(BROKEN, {})
    for name in ("correct", *torch_rasterizer.DEFECTS):
        for scene, (g, cameras) in scenes.items():
            key = f"{name} {scene}"
            if key not in rows:
                rows[key] = _found(name, g, cameras)
                studies.write_rows(BROKEN, rows)
                print(key, rows[key], flush=True)


def _found(name: str, g: Gaussians, cameras: list[Camera]) -> dict:
    """What is said of a defect, and whether it is that: its kind, and the very groups whose gradient is wrong."""
    right = function(torch_rasterizer.rasterization, "correct")
    defect = torch_rasterizer.DEFECTS.get(name)
    made = right if defect is None else function(defect.make(), name)
    found = crossval(made, g, cameras, "gsplat", {"background": BACKGROUND})
    groups = {v: sorted(n for n, row in found.report["groups"].items() if row["verdict"] == v) for v in VERDICTS}
    named = [f"{c['name']}: {c['found']}" for c in found.report["conventions"]]
    named += groups["gradient bug"] + groups["known deviation"]
    shown = defect is not None and (defect.kind == "beside" or not _same(right, made, g, cameras[0]))
    if not shown:
        good = found.verdict == "agreement"
    elif defect.kind in ("gradient", "beside"):
        wrong = {*defect.groups, *(["viewmats"] if name in MOVING else [])}
        good = set(groups["gradient bug"]) == wrong
        if name in DOCUMENTED:
            good = found.verdict == "known deviation" and set(groups["known deviation"]) <= wrong
    else:
        good = found.verdict == "other convention"
    verdict = found.verdict if shown or defect is None or not good else "not shown"
    return {"verdict": verdict, "right": good, "named": named, "near_ties": found.report["near_ties"]}


def _same(a, b, g: Gaussians, camera: Camera) -> bool:
    """Whether two rasterizers' images and gradients of a view are equal, bit for bit."""
    raw = with_pose(raw_of(g), camera.is_rolling)
    u = cotangents([camera], 0)[0]
    if not torch.equal(*(x.image(raw, camera, BACKGROUND)[0] for x in (a, b))):
        return False
    slopes = [x.gradient(raw, camera, BACKGROUND, u) for x in (a, b)]
    return all(y is not None and torch.equal(x, y) for x, y in zip(*(s.values() for s in slopes), strict=True))


def small_scenes(runs: Path) -> dict[str, tuple]:
    """Name -> (Gaussians, cameras): three random scenes, and what weighs most in a view of each real one."""
    scenes = {f"random {seed}": random_scene(seed) for seed in range(3)}
    for name, (g, cameras) in real_scenes(runs).items():
        camera = cameras[0].resized(48, 40)
        scenes[name] = wolf(250, 48, 40) if name == "wolf" else heaviest(g, camera, 250)
    return scenes


def paths(runs: Path) -> None:
    """Every defect of a path, and the right rasterizer, on every scene; a lost geometry, through every lens."""
    rows = studies.read_rows(PATHS, {})

    def keep(key: str, found: Result, verdict: str, wrong: tuple[str, ...]) -> None:
        rows[key] = _path_row(found, verdict, wrong)
        studies.write_rows(PATHS, rows)
        print(key, rows[key], flush=True)

    for scene, (g, cameras) in small_scenes(runs).items():
        for name in ("right", *torch_rasterizer.PATH_DEFECTS):
            if (key := f"{name} {scene}") not in rows:
                defect = torch_rasterizer.PATH_DEFECTS.get(name)
                made = function(torch_rasterizer.paths if defect is None else defect.call, name)
                expected = ("agreement", ()) if defect is None else (defect.verdict, defect.path)
                found = crossval(made, g, cameras, "gsplat", {"background": BACKGROUND})
                if found.verdict == "agreement" and defect and not _shows_in_depth(made, g, cameras[0]):
                    expected = ("not shown", ())
                keep(key, found, *expected)
    for scene, (g, camera) in ray_scenes().items():
        if camera.is_distorted:
            for name, made, verdict, wrong in (
                ("right_lens", torch_rays.rasterizer(right_rays()), "agreement", ()),
                ("lens_detached", torch_rays.lens_detached(right_rays()), "gradient bug", ("lens",)),
            ):
                if (key := f"{name} {scene}") not in rows:
                    own, views = function(made, name), [camera.undistorted()]
                    keep(key, crossval(own, g, views, "3dgut", RAY_FIELDS, lenses=[camera]), verdict, wrong)


def _shows_in_depth(made, g: Gaussians, camera: Camera) -> bool:
    """Whether a defect changes a bit of the gradient of an image with depth: in some views no alpha is clamped."""
    raw = with_pose(raw_of(g), camera.is_rolling)
    u = torch.cat([cotangents([camera], 0)[0]] * 2, -1)[..., :4]

    def slopes(rasterizer) -> list:
        def draw(raw: dict, camera: Camera, background: tuple) -> tuple:
            images, alphas = rasterizer.several([raw], [camera], [background], {"render_mode": "RGB+D"}, 4)
            return images[0, 0], alphas[0, 0]

        return list(dataclasses.replace(rasterizer, draw=draw).gradient(raw, camera, BACKGROUND, u).values())

    right = slopes(function(torch_rasterizer.paths, "right"))
    return any(not torch.equal(x, y) for x, y in zip(right, slopes(made), strict=True) if x is not None)


def _path_row(found: Result, verdict: str, wrong: tuple[str, ...]) -> dict:
    """What is said of the paths of a rasterizer, and whether it is that."""
    named = [row.path for row in found.paths if row.status == "wrong"]
    single = all(row.verdict == "agreement" for row in found.groups.values())  # the colors of one view are right
    said = "not shown" if verdict == "not shown" else found.verdict
    good = said == verdict and set(named) == set(wrong) and single
    return {"verdict": said, "right": good, "named": named, "not_tested": found.not_tested()}


def ray_scenes() -> dict[str, tuple]:
    """Name -> (Gaussians, camera): made for rays, through every lens, and the wolf."""
    scenes = {}
    for lens, (model, distortion) in torch_rays.LENSES.items():
        for seed in range(RAY_SEEDS):
            s = torch_rays.ray_scene(seed)
            g = Gaussians(**{name: s[name].float() for name in PARAMETERS})
            size = {"width": s["width"], "height": s["height"]}
            camera = Camera(K=s["K"].numpy(), w2c=s["viewmat"].numpy(), model=model, distortion=distortion, **size)
            scenes[f"{lens} {seed}"] = g, camera
    real = wolf(RAY_SPLATS, 32, 24)
    if real:
        scenes["wolf"] = real[0], real[1][0]
    return scenes


def right_rays() -> torch_rays.RayModel:
    """The right rasterizer along rays, with the constants of preset `3dgut`."""
    s = RenderSettings.preset("3dgut")
    density = 0.0 if s.extent is None else math.exp(-(s.extent**2) / 2)
    return dataclasses.replace(torch_rays.CORRECT, alpha_max=s.alpha_max, density_min=density, between=False)


def rays() -> None:
    """Every rasterizer along rays that is broken on purpose, and the right one."""
    rows = studies.read_rows(RAYS, {})
    for name in ("right", *torch_rays.DEFECTS):
        for scene, (g, camera) in ray_scenes().items():
            key = f"{name} {scene}"
            if key not in rows:
                rows[key] = _ray_row(name, g, camera)
                studies.write_rows(RAYS, rows)
                print(key, rows[key], flush=True)


def _ray_row(name: str, g: Gaussians, camera: Camera) -> dict:
    """What is said of a rasterizer along rays, and whether it is that."""
    right = right_rays()
    defect = torch_rays.DEFECTS.get(name)
    drawn = torch_rays.rasterizer(right) if defect is None else torch_rays.broken(name, right)
    good, made = function(torch_rays.rasterizer(right), "right"), function(drawn, name)
    moves = defect is not None and defect.kind == "shutter"
    if moves:
        end = torch_rays.end_of(torch.tensor(camera.w2c)).numpy()
        camera = dataclasses.replace(camera, shutter="rolling_top_to_bottom", w2c_end=end)
    start = time.process_time()
    try:
        found = crossval(made, g, [camera], "3dgut", RAY_FIELDS)
    except ValueError as error:  # a rasterizer that draws nothing at all is refused
        return {"verdict": "refused", "right": "shows the background alone" in str(error), "named": [], "seconds": 0.0}
    seconds = time.process_time() - start
    groups = {v: sorted(n for n, row in found.report["groups"].items() if row["verdict"] == v) for v in VERDICTS}
    # What is found of another model's image explains a part of it only.
    conventions = found.report["conventions"] if found.report["image"]["agrees"] else []
    named = [f"{c['name']}: {c['found']}" for c in conventions]
    named += groups["gradient bug"] + groups["known deviation"]
    shown = defect is not None and not _same(good, made, g, camera)
    if not shown:
        is_right = found.verdict == "agreement"
    elif name in DOCUMENTED:
        is_right = found.verdict == "known deviation"
    elif defect.kind == "gradient":
        is_right = {*groups["gradient bug"]} - {"colors"} == {*defect.groups}
    elif moves and defect.groups:
        is_right = {*groups["gradient bug"]} == {POSE_END}
    elif moves and found.verdict == "known deviation":  # the other eye, where the image does not show it
        is_right = "from between both poses" in " ".join(row.why for row in found.groups.values())
    else:
        is_right = found.verdict == "other convention" and len(found.findings) == 1
    verdict = found.verdict if shown or defect is None or not is_right else "not shown"
    return {"verdict": verdict, "right": is_right, "named": named, "seconds": seconds}


def eval3d() -> None:
    """gsplat 1.6's own torch code along rays beside preset `3dgut` and the rasterizer in plain torch.

    Rows that are kept need no gsplat.
    """
    rows = studies.read_rows(EVAL3D, {})
    for scene, (g, camera) in ray_scenes().items():
        if scene not in rows:
            rows[scene] = _eval3d_row(g, camera)
            studies.write_rows(EVAL3D, rows)
            print(scene, rows[scene], flush=True)


def _eval3d_row(g: Gaussians, camera: Camera) -> dict:
    """gsplat's torch code on one view."""
    theirs = load_rasterizer(OWN_EVAL3D)
    # What preset 3dgut may have otherwise: the clamp and the density that gsplat's functions have.
    fields = RAY_FIELDS | {"alpha_max": 0.99, "extent": math.sqrt(-2 * math.log(0.0113))}
    found = crossval(theirs, g, [camera], "3dgut", fields)
    plain = torch_rays.rasterizer(dataclasses.replace(torch_rays.CORRECT, behind=True))
    apart = {"plain": _apart(theirs, function(plain, "plain"), g, camera), "rolling": (0.0, 0.0)}
    for shutter in torch_rays.SHUTTERS:
        end = torch_rays.end_of(torch.tensor(camera.w2c)).numpy()
        moving = dataclasses.replace(camera, shutter=shutter, w2c_end=end)
        found_now = _apart(theirs, function(plain, "plain"), g, moving)
        apart["rolling"] = tuple(max(x) for x in zip(apart["rolling"], found_now, strict=True))
    rolled = crossval(theirs, g, [moving], "3dgut", fields)
    return {
        "rolling_conventions": [f"{c['name']}: {c['found']}" for c in rolled.report["conventions"]],
        "rolling_verdict": rolled.verdict,
        "rolling_rms": rolled.views[0].rms,
        "rolling_gradient": max(row.relative for row in rolled.groups.values()),
        "conventions": [f"{c['name']}: {c['found']}" for c in found.report["conventions"]],
        "verdict": found.verdict,
        "rms": found.views[0].rms,
        "groups": {name: row.relative for name, row in found.groups.items()},
        **apart,
    }


def _apart(a, b, g: Gaussians, camera: Camera) -> tuple[float, float]:
    """Largest difference of two rasterizers' images, and the largest relative one of a group's gradient."""
    raw = with_pose(raw_of(g), camera.is_rolling)
    u = cotangents([camera], 0)[0]
    images = [x.image(raw, camera, BACKGROUND)[0] for x in (a, b)]
    slopes = [x.gradient(raw, camera, BACKGROUND, u) for x in (a, b)]
    pairs = zip(slopes[0].values(), slopes[1].values(), strict=True)
    return float((images[0] - images[1]).abs().max()), max(float((x - y).norm() / y.norm()) for x, y in pairs)


def outside() -> None:
    """Rasterizers of others: writes the rows of those that are installed."""
    heads = ["rasterizer", "scene", "preset", "conventions", "rms", "pixels_off", "alpha_bias", "verdict"]
    lines = [[*heads, *GROUPS, "gradient_bugs", "seconds"]]
    scenes = {f"random {seed}": random_scene(seed, aspect=1.0) for seed in range(3)}
    scenes["random 0, 10 times smaller"] = shrunk(scenes["random 0"], 0.1)
    real = wolf(2000, 64, 48)
    if real:
        scenes["wolf"] = real
    for label, (name, preset) in OUTSIDE.items():
        if "gsplat" in name and importlib.util.find_spec("gsplat") is None:
            print("gsplat is not installed: left out")
            continue
        for place, (g, cameras) in scenes.items():
            start = time.perf_counter()
            found = crossval(load_rasterizer(name), g, cameras, preset, {"background": BACKGROUND})
            seconds = time.perf_counter() - start
            view = found.report["image"]["views"][0]
            odd = "; ".join(f"{c['name']}: {c['found']}" for c in found.report["conventions"])
            image = [f"{view['rms']:.0e}", f"{view['share']:.1%}", f"{view['alpha']['bias']:+.0e}"]
            groups = found.report["groups"]
            apart = [f"{groups[x]['relative']:.0e}" if x in groups else "" for x in GROUPS]
            wrong = " ".join(x for x in GROUPS if x in groups and groups[x]["verdict"] == "gradient bug")
            lines.append([label, place, preset, odd, *image, found.verdict, *apart, wrong, f"{seconds:.0f}"])
            print(lines[-1], flush=True)
    studies.write_csv(CSV / "crossval-outside.csv", lines)


# ------------------------------------------------------------------------------------------------------------ the page


def judged(*groups: dict) -> str:
    """How many verdicts are as they should be, of all."""
    rows = [row for group in groups for row in group.values()]
    return f"{sum(row['right'] for row in rows)} of {len(rows)}"


def agreed(*groups: dict) -> str:
    """The same of correct rasterizers."""
    rows = [row for group in groups for row in group.values()]
    return f"{sum(row['verdict'] == 'agreement' for row in rows)} of {len(rows)}"


def summary() -> str:
    """What the page is about, a sentence or two a study."""
    correct, posed, wrong, along, other = (studies.read_rows(path, {}) for path in (ROWS, POSES, BROKEN, RAYS, PATHS))
    largest = max(max(row["relative"]) for row in correct.values())
    wrongly = ", ".join(
        f"`{name}` on {scene}" for name, _, scene in (k.partition(" ") for k in wrong if not wrong[k]["right"])
    )
    defects, rays = len(torch_rasterizer.DEFECTS), len(torch_rays.DEFECTS)
    return paragraph(
        f"Of verdicts on [correct rasterizers](data/crossval-correct.csv) and five real scenes "
        f"{agreed(correct, posed)} are right, with gradients that differ by {largest:.0e} at most; on two correct ones "
        f"and their [{defects}](data/crossval-broken.csv) and, along rays, [{rays}](data/crossval-rays.csv) broken "
        f"copies {judged(wrong, along)} (wrong is {wrongly}); on [copies that are broken on one "
        f"path](data/crossval-paths.csv) {judged(other)}."
    )


def correct_lines() -> Iterator[list[str]]:
    """Every verdict about a correct rasterizer."""
    yield ["study", "rasterizer", "scene", "seed", "view", "verdict", *GROUPS, "near_ties", "pixels", "gaussians"]
    for study, path in (("alarms", ROWS), ("poses", POSES)):
        for key, row in studies.read_rows(path, {}).items():
            apart = [*row["relative"], row.get("pose"), row.get("colors")]
            numbers = ["" if x is None else f"{x:.0e}" for x in apart]
            sizes = [str(row[name]) for name in ("near_ties", "pixels", "gaussians")]
            yield [study, *key.split(" "), row["view"], row["verdict"], *numbers, *sizes]


def broken_lines(path: Path, right: str, defects: dict) -> Iterator[list[str]]:
    """Every broken rasterizer: what is wrong with it, and what is said of it on each scene."""
    rows = studies.read_rows(path, {})
    scenes = [key.removeprefix(f"{right} ") for key in rows if key.startswith(f"{right} ")]
    yield ["rasterizer", "what is wrong", *scenes, "named", "verdicts that are wrong"]
    for name in (right, *defects):
        found = {scene: rows[f"{name} {scene}"] for scene in scenes}
        named = dict.fromkeys(word for row in found.values() for word in row["named"])
        wrong = [scene for scene, row in found.items() if not row["right"]]
        what = "nothing" if name == right else defects[name].what
        yield [name, what, *(row["verdict"] for row in found.values()), "; ".join(named), " ".join(wrong)]


def path_lines() -> Iterator[list[str]]:
    """Every defect of a path: what is wrong, and the paths that are named."""
    what = {name: x.what for name, x in torch_rasterizer.PATH_DEFECTS.items()} | {"right": "nothing"}
    what |= {"right_lens": "nothing", "lens_detached": "means, quats and scales are detached where there is a lens"}
    yield ["rasterizer", "what is wrong", "scene", "verdict", "wrong paths", "right"]
    for key, row in studies.read_rows(PATHS, {}).items():
        name, _, scene = key.partition(" ")
        yield [name, what[name], scene, row["verdict"], "; ".join(row["named"]), "yes" if row["right"] else "no"]


def eval3d_lines() -> Iterator[list[str]]:
    """gsplat's torch code along rays, one line a scene."""
    plain = ["torch_image", "torch_gradient", "torch_shutter_image", "torch_shutter_gradient"]
    rolled = [f"shutter_{name}" for name in ("conventions", "verdict", "rms", "gradient")]
    yield ["scene", "conventions", "rms", "verdict", *GROUPS, *plain, *rolled]
    for scene, row in studies.read_rows(EVAL3D, {}).items():
        apart = [f"{x:.0e}" for x in (*(row["groups"][name] for name in GROUPS), *row["plain"], *row["rolling"])]
        last = ["; ".join(row["rolling_conventions"]), row["rolling_verdict"]]
        last += [f"{row[name]:.0e}" for name in ("rolling_rms", "rolling_gradient")]
        yield [scene, "; ".join(row["conventions"]), f"{row['rms']:.0e}", row["verdict"], *apart, *last]


def page() -> None:
    """The paragraph and the data files, of the rows that there are."""
    studies.write_csv(CSV / "crossval-correct.csv", correct_lines())
    studies.write_csv(CSV / "crossval-broken.csv", broken_lines(BROKEN, "correct", torch_rasterizer.DEFECTS))
    studies.write_csv(CSV / "crossval-paths.csv", path_lines())
    studies.write_csv(CSV / "crossval-rays.csv", broken_lines(RAYS, "right", torch_rays.DEFECTS))
    studies.write_csv(CSV / "crossval-eval3d.csv", eval3d_lines())
    fill_between(PAGE, "verdicts", summary())


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=["alarms", "poses", "broken", "paths", "rays", "eval3d", "outside"])
    parser.add_argument("--seeds", type=int, default=50, help="of every correct rasterizer on every real scene")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs", help="where fits are kept")
    parser.add_argument(
        "--page", action="store_true", help="measure nothing, write the page of the rows that there are"
    )
    args = parser.parse_args()
    makers = {
        "alarms": lambda: alarms(args.runs, args.seeds),
        "poses": lambda: poses(args.runs),
        "broken": lambda: broken(args.runs),
        "paths": lambda: paths(args.runs),
        "rays": rays,
        "eval3d": eval3d,
        "outside": outside,
    }
    for part, make in makers.items():
        if not args.page and args.only in (None, part):
            make()
            print(f"{part}: {studies.stamp('crossval')}")
    page()


if __name__ == "__main__":
    main()
