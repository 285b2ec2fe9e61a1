"""What `exact` claims, against rays that nothing is cut off from: a table and a file of docs/numerics.md.

    python benchmarks/claims.py [--scenes 10]      benchmarks/claims.json; largest errors over so many scenes of a kind
    python benchmarks/claims.py --page             measures nothing

The oracle has no extent and ends no ray. Images are rendered without a depth: tiles leave out most tails then.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as for every command: torch's threads shall not spin

import numpy as np
import studies
import torch
from pages import fill_between
from studies import ROOT
from where import ran

from drgs import fisher, reference, render, render_jvp
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians
from drgs.lab.accuracy import (
    Oracle,
    entry_error,
    jacobian,
    leaves,
    pose_gradient,
    random_camera,
    random_gaussians,
    relative,
    squares,
)
from drgs.settings import RenderSettings
from drgs.studies.tables import markdown_table, paragraph

RESULTS = ROOT / "benchmarks" / "claims.json"
PAGE = ROOT / "docs" / "numerics.md"
DATA = ROOT / "docs" / "data" / "claims.csv"
SETTINGS = {
    "tiles": {},
    "bvh": {"traversal": "bvh"},
    "`integral`, tiles": {"response": "integral"},
    "`integral`, bvh": {"response": "integral", "traversal": "bvh"},
    "`ewa`": {"response": "ewa", "order": "center"},
}
"""What differs from preset `exact`."""
IMAGES = ("rgb", "alpha", "features")
COLUMNS = {
    "image": "image",
    "means": "means",
    "quats": "quaternions",
    "log_scales": "log-scales",
    "logit_opacities": "logits",
    "sh": "SH",
    "features": "features",
    "camera": "pose",
    "lens": "lens",
    "forward": "forward mode",
    "fisher": "Fisher diagonal",
}
SHOWN = {
    "image": ["image"],
    "worst gradient": [key for key in COLUMNS if key not in ("image", "forward", "fisher")],
    "forward mode": ["forward"],
    "Fisher diagonal": ["fisher"],
}
"""Columns of the page, over all settings of a traversal; the data file has all of `COLUMNS` and settings."""

Scene = tuple[Gaussians, Camera]


def ordinary(rng: np.random.Generator) -> Scene:
    """10 to 25 Gaussians of all shapes and opacities."""
    shape = {"anisotropy": rng.choice([0.1, 0.5, 1.2]), "opacity": rng.choice([1.0, 3.0])}
    return random_gaussians(rng, int(rng.integers(10, 26)), 4, 2, **shape), random_camera(rng, (16, 11), skew=0.1)


def faint(rng: np.random.Generator) -> Scene:
    """Every opacity between 1e-8 and 1e-4."""
    g, cam = ordinary(rng)
    with torch.no_grad():  # leaves are changed in place
        g.logit_opacities[:] = torch.logit(10.0 ** torch.tensor(rng.uniform(-8, -4, len(g)))).float()
    return g, cam


def needles(rng: np.random.Generator) -> Scene:
    """30:1, a tenth of a pixel thin: most pixels that see one see its tails."""
    g = random_gaussians(rng, 20, 4, 2)
    with torch.no_grad():  # likewise
        g.log_scales[:, 1:] -= math.log(30)
    return g, random_camera(rng, (16, 11))


def fisheye(rng: np.random.Generator) -> Scene:
    """A fisheye that sees 175 degrees from side to side."""
    width, height = 24, 20
    cam = random_camera(rng, (width, height), center=(width / 2, height / 2))
    f = 0.5 * width / math.radians(87.5)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    cam = dataclasses.replace(cam, K=K, model="opencv_fisheye", distortion=(0.0, 0.0, 0.0, 0.0))
    return random_gaussians(rng, 20, 4, 2), cam


def fisheye_inside(rng: np.random.Generator) -> Scene:
    """The same lens in the midst of the scene."""
    _, cam = fisheye(rng)
    g = random_gaussians(rng, 25, 4, 2, scale=0.3, spread=4.0)
    with torch.no_grad():  # likewise
        g.means.add_(torch.tensor(cam.center, dtype=torch.float32))
    return g, cam


def tails_alone(rng: np.random.Generator) -> Scene:
    """A pinhole that sees 175 degrees, to which the scene is smaller than a pixel: no pixel sees more than tails."""
    cam = random_camera(rng, (24, 20))
    K = cam.K.copy()
    K[0, 0] = K[1, 1] = 12 / math.tan(math.radians(87.5))
    return random_gaussians(rng, 20, 4, 2), dataclasses.replace(cam, K=K)


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "random": ordinary,
    "opacities of 1e-8 to 1e-4": faint,
    "needles, 30:1": needles,
    "fisheye, 175 degrees": fisheye,
    "fisheye, camera inside": fisheye_inside,
    "tails alone": tails_alone,
}


def errors(g: Gaussians, cam: Camera, settings: RenderSettings, rng: np.random.Generator) -> dict[str, float]:
    """Errors by the names of `COLUMNS`, of a scene.

    Pixels that hang on a near tie are left out; with them the Fisher diagonal.
    """
    true = settings.replace(transmittance_min=0.0)
    oracle = Oracle(g, cam, true, rng, 1e-6, IMAGES)
    inputs = leaves(g, cam)
    lens = None if settings.planar else torch.tensor(cam.lens_parameters, requires_grad=True)
    if lens is not None:
        inputs |= {"lens": lens}
    out = render(g, cam, settings, outputs=(), lens=lens)
    loss = sum((getattr(out, name).double() * u).sum() for name, u in oracle.u.items())
    found = dict(zip(inputs, torch.autograd.grad(loss, list(inputs.values())), strict=True))
    found["camera"] = pose_gradient(cam.w2c, found["camera"])
    wanted = dict(oracle.back)
    if lens is not None:
        wanted["lens"] = by_lens(g, cam, true, oracle)
    off = {name: relative(found[name].double(), x, 1e-300) for name, x in wanted.items()}
    images = [(getattr(out, n).double() - getattr(oracle.out, n))[oracle.good] for n in ("rgb", "alpha")]
    off["image"] = max(float(x.detach().abs().max()) for x in images)  # an error is a number
    moved = render_jvp(g, cam, oracle.v, settings, outputs=())
    pair = (
        torch.cat([x[oracle.good].double().reshape(-1) for x in some])
        for some in ([getattr(moved, name) for name in oracle.u], oracle.push.values())
    )
    off["forward"] = relative(*pair, 1e-300)
    if oracle.good.all():
        diagonal = fisher.diagonal(g, cam, settings)
        truth = squares(jacobian(g, reference.render(g, cam, true), features=True))
        off["fisher"] = max(entry_error(diagonal[name] / x.max(), x / x.max()) for name, x in truth.items())
    return off


def by_lens(g: Gaussians, cam: Camera, settings: RenderSettings, oracle: Oracle) -> torch.Tensor:
    """The oracle's derivative by the lens: by its rays, times central differences of the camera's."""
    directions = torch.tensor(cam.pixel_directions(), requires_grad=True)
    unit = torch.nn.functional.normalize(directions, dim=-1)
    plain = Camera(K=cam.K, w2c=cam.w2c.detach(), width=cam.width, height=cam.height)  # a pose without a graph
    rays = torch.tensor(cam.center).expand(unit.shape), unit
    out = reference.render(g.detach(), plain, settings, rays=rays)  # nor have Gaussians one
    loss = sum((getattr(out, name) * u).sum() for name, u in oracle.u.items())
    (slope,) = torch.autograd.grad(loss, directions)
    at = cam.lens_parameters
    slopes = []
    for k in range(len(at)):
        step = 1e-5 * max(abs(at[k]), 0.1 if k >= 5 else 1.0)
        ends = (cam.with_lens(at + sign * step * np.eye(len(at))[k]).pixel_directions() for sign in (1, -1))
        slopes.append(float((slope * torch.tensor(np.subtract(*ends))).sum()) / (2 * step))
    return torch.tensor(slopes, dtype=torch.float64)


def measure(count: int) -> dict[str, Any]:
    """The largest errors of each kind of scene with each settings, over `count` scenes."""
    rows = []
    for kind, build in SCENES.items():
        for name, fields in SETTINGS.items():
            if name == "`ewa`" and "fisheye" in kind:
                continue  # a model of a pinhole's image plane
            settings = RenderSettings.preset("exact", **fields)
            worst: dict[str, float] = {}
            for seed in range(count):
                rng = np.random.default_rng(seed)
                for key, value in errors(*build(rng), settings, rng).items():
                    worst[key] = max(worst.get(key, 0.0), value)
            rows.append({"scene": kind, "settings": name, **worst})
            print(rows[-1], flush=True)
    return {**ran(), "scenes": count, "rows": rows}


def cell(value: float | None) -> str:
    """A number of the table."""
    return "-" if value is None else f"{value:.0e}"


def text(result: dict[str, Any]) -> str:
    """What the page says."""
    told = (
        f"`python benchmarks/claims.py`, {result['machine']}, {result['date']}, commit {result['commit']}: the "
        f"largest error of preset `exact` over {result['scenes']} scenes of each kind, absolute for images, relative "
        "in norm for derivatives, for the Fisher diagonal to its group's largest entry ([every parameter group and "
        "response](data/claims.csv))."
    )
    lines = []
    for kind in SCENES:
        rows = [row for row in result["rows"] if row["scene"] == kind]
        both = [[row for row in rows if ("bvh" in row["settings"]) == on_bvh] for on_bvh in (False, True)]
        worst = ([max(x[key] for x in some for key in keys if key in x) for some in both] for keys in SHOWN.values())
        lines.append([kind, *(" / ".join(map(cell, pair)) for pair in worst)])
    return f"{paragraph(told)}\n\n{markdown_table(['`tiles` / `bvh`', *SHOWN], lines)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10, help="scenes of each kind")
    parser.add_argument("--page", action="store_true", help="measure nothing, write what there is")
    args = parser.parse_args()
    if not args.page:
        studies.write_rows(RESULTS, measure(args.scenes))
    result = studies.read_rows(RESULTS, None)
    heads = ["scene", "settings", *COLUMNS]
    rows = [[row["scene"], row["settings"], *(cell(row.get(key)) for key in COLUMNS)] for row in result["rows"]]
    studies.write_csv(DATA, [heads, *rows])
    fill_between(PAGE, "claims", text(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
