"""`drgs fisher`: what known views say about every Gaussian, and what other views would still find uncertain.

Two maps a view, both sums over the parameters k of squared derivatives J_pk of a pixel p, with H the information of the
known views and Hc that of the view itself:

    variance    sum_k J_pk^2 / (H_k + lambda): predictive variance of the pixel for unit noise; its sum is `eig`
    share       sum_k J_pk^2 / Hc_k log(1 + Hc_k / (H_k + lambda)): the pixel's share of the view's `logdet`
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from drgs import fisher
from drgs.commands.given import Given
from drgs.commands.viewpoints import check_counts, evenly, known_views, other_views
from drgs.data.camera_lists import described
from drgs.display import pictures, tables
from drgs.display.progress import Bar
from drgs.files import SCHEMA, save_state, write_json
from drgs.fisher import Information
from drgs.gain import Prior, check, information_gain, variances
from drgs.guards.outputs import claim

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.options import Fisher
    from drgs.commands.viewpoints import Known
    from drgs.ellipsoids import Gaussians
    from drgs.settings import RenderSettings

__all__ = ["map_weights", "run"]


def run(args: Fisher) -> None:
    """`drgs fisher SCENE`."""
    check_counts(args)
    args.settings()  # refuses what cannot be, before anything is read
    prior = Prior(value=args.prior, relative=args.relative_prior)
    inputs = [args.scene, args.train or "", args.cameras or ""]
    output = claim(args.output, "fisher", ["information.safetensors", "fisher.json"], inputs)
    given = Given.of(args)
    settings = given.settings(args.preset)
    text = args.train
    if text is None and given.run is None:
        if args.cameras in (None, "orbit", "dome"):
            raise ValueError(
                "a PLY has no record of its views: --train or --cameras must name a data set, a run or a cameras.json"
            )
        text = args.cameras
    known = known_views(text, args, given)
    views, source = known.cameras, known.source
    if args.cameras is not None:
        views, source = other_views("--cameras", args.cameras, args, given, known, fresh=False)
    views = evenly(views, args.limit)
    names = pictures.file_names([camera.name for camera in views])
    output.check(f"{name}.{kind}.png" for name in names for kind in ("variance", "share"))
    with Bar("information", len(known.cameras) + len(views), not args.quiet) as bar:
        H: Information = {}
        for camera in known.cameras:
            part = fisher.diagonal(given.gaussians, camera, settings, args.method)
            check(f"fisher: view {camera.name}", part)
            H = {name: x + H[name] if H else x for name, x in part.items()}
            bar.advance()
        rows = []
        for camera, name in zip(views, names, strict=True):
            rows.append(_view(args, given.gaussians, camera, settings, name, H, prior))
            bar.advance()
    groups = {name: GroupSummary.of(x) for name, x in H.items()}
    header = {"groups": list(H), "views": [camera.name for camera in known.cameras], "settings": settings}
    save_state(args.output / "information.safetensors", H, header)
    report = {
        "schema": SCHEMA,
        "command": "fisher",
        "scene": str(args.scene),
        "gaussians": len(given.gaussians),
        "method": args.method,
        "prior": {"value": args.prior, "relative": args.relative_prior},
        "settings": dataclasses.asdict(settings),
        "pixels": known.pixels,
        "known": {"source": known.source, "names": [camera.name for camera in known.cameras]},
        "groups": {name: dataclasses.asdict(row) for name, row in groups.items()},
        "source": source,
        "views": [row.to_json() for row in rows],
    }
    write_json(args.output / "fisher.json", report)
    if not args.quiet:
        _print(args, known, groups, rows, source)


@dataclasses.dataclass(frozen=True)
class GroupSummary:
    """What the known views say about a group of parameters: a summary of its information's entries."""

    shape: list[int]
    sum: float
    median_of_positive: float | None
    zero: int

    @classmethod
    def of(cls, x: torch.Tensor) -> GroupSummary:
        """Of the information of a group."""
        positive = x[x > 0]
        median = float(positive.median()) if positive.numel() else None
        return cls(list(x.shape), float(x.sum()), median, int((x == 0).sum()))


@dataclasses.dataclass(frozen=True)
class MapSummary:
    """A map in three numbers."""

    sum: float
    mean: float
    max: float


@dataclasses.dataclass(frozen=True)
class PoseSummary:
    """What a view says about its own pose: a 6x6 matrix, and its eigenvalues, the least first."""

    information: list[list[float]]
    eigenvalues: list[float]


@dataclasses.dataclass(frozen=True)
class MappedView:
    """What a view shows.

    Attributes:
        name, camera: The view's.
        files: Its maps.
        gain: What it would add to the known views, by criterion.
        variance, share: Its maps.
        pose: With --pose, else None.
    """

    name: str
    camera: Camera
    files: list[str]
    gain: dict[str, float]
    variance: MapSummary
    share: MapSummary
    pose: PoseSummary | None

    def to_json(self) -> dict[str, Any]:
        """As fisher.json holds it."""
        fields = {name: getattr(self, name) for name in ("name", "camera", "files", "gain")}
        fields |= {"camera": described(self.camera)}
        fields |= {name: dataclasses.asdict(getattr(self, name)) for name in ("variance", "share")}
        return fields | ({} if self.pose is None else {"pose": dataclasses.asdict(self.pose)})


def map_weights(H: Information, candidate: Information, prior: Prior) -> tuple[Information, Information]:
    """Weights of `drgs.fisher.variance_map` for the two maps of the module's text.

    Args:
        H, candidate: Information of the known views and of the view shown, same groups.
        prior: lambda; parameters with H + lambda = 0 weigh nothing.
    Returns:
        Those of `variance` and of `share`.
    """
    variance, share = variances(H, prior), {}
    for name in H:
        Hc = candidate[name].double()
        # log(1 + x) / Hc tends to the variance where the view says nothing about a parameter.
        share[name] = torch.where(Hc > 0, (Hc * variance[name]).log1p() / Hc, variance[name])
    return variance, share


def _view(
    args: Fisher, g: Gaussians, camera: Camera, settings: RenderSettings, name: str, H: Information, prior: Prior
) -> MappedView:
    """Maps of one view, and what it says."""
    Hc = fisher.diagonal(g, camera, settings, args.method)
    # Maps are of the image's colors; features have an image of their own.
    parts = map_weights(*({k: x for k, x in y.items() if k != "features"} for y in (H, Hc)), prior)
    files, maps = [], []
    for kind, weights in zip(("variance", "share"), parts, strict=True):
        values = fisher.variance_map(g, camera, weights, settings).numpy()
        files.append(f"{name}.{kind}.png")
        pictures.write_png(args.output / files[-1], pictures.map_picture(values))
        maps.append(MapSummary(float(values.sum(dtype=np.float64)), float(values.mean()), float(values.max())))
    pose = None
    if args.pose:
        found = fisher.pose_information(g, camera, settings)
        pose = PoseSummary(found.tolist(), torch.linalg.eigvalsh(found).tolist())
    gain = {criterion: information_gain(Hc, H, criterion, prior).total for criterion in ("logdet", "eig")}
    return MappedView(camera.name, camera, files, gain, *maps, pose)


def _print(args: Fisher, known: Known, groups: dict[str, GroupSummary], views: list[MappedView], source: str) -> None:
    """What was found, as tables on stdout."""
    rows = []
    for name, row in groups.items():
        share = f"{row.zero / max(math.prod(row.shape), 1):.1%}"
        shape = "x".join(map(str, row.shape))
        rows.append((name, shape, f"{row.sum:.4g}", f"{row.median_of_positive or 0:.4g}", share))
    title = f"information of {len(known.cameras)} views ({known.source})"
    tables.show(title, ("group", "shape", "sum", "median > 0", "nothing known"), rows)
    rows = []
    for row in views:
        values = row.pose.eigenvalues if row.pose else []
        numbers = (row.gain["eig"], row.gain["logdet"], row.variance.mean, *values[:1], *values[-1:])
        rows.append((row.name, *(f"{x:.3g}" for x in numbers)))
    columns = ("view", "eig", "logdet", "mean variance", *(("pose: least", "most") if args.pose else ()))
    tables.show(f"views ({source})", columns, rows)
    if args.pose:
        print("pose: information about the least and the best known of its six directions; fisher.json has all six")
    files = sum(len(row.files) for row in views)
    print(f"information.safetensors, fisher.json and {files} maps: {args.output}")
