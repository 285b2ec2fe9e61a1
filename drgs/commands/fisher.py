"""`drgs fisher`: where a scene is wrong, information of known views about every Gaussian, and maps of both.

Where the known views have photographs, the first map of a view is the error that is expected of each pixel, in units of
color (`drgs.expected_error`). Two more are sums over the parameters k of squared derivatives J_pk of a pixel p, with H
the information of the known views and Hc that of the view itself:

    variance    sum_k J_pk^2 / (H_k + lambda): predictive variance of the pixel for unit noise; its sum is `eig`
    share       sum_k J_pk^2 / Hc_k log(1 + Hc_k / (H_k + lambda)): the pixel's share of the view's `logdet`

With --eliminate, H and Hc are what is left of both, the map of the variance is that of a picture whose own exposure and
pose are known, so that its sum is more than `eig`, and shares go by J_pk^2 / sum_p J_pk^2.

The rows of J are the pixel's colors and, where the scene has features, its decoded features; the parameters are those
of the Gaussians and, where a network moves them, the network's, estimated by random probes. Where several blocks count
there is a map of each beside that of all, whose sum it is a part of.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs import fisher
from drgs.cameras import Camera
from drgs.commands.options import Fisher
from drgs.commands.regions import region_of
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import Known, Source, check_lenses, evenly, known_views, views_to_compare, with_times
from drgs.data.camera_lists import camera_to_json
from drgs.display import pictures, tables
from drgs.display.progress import Bar
from drgs.ellipsoids import Scene
from drgs.fitting.config import FitConfig
from drgs.fitting.errors import error_record_of_views, run_error_record
from drgs.fitting.resume import lock_output
from drgs.gain import Information, Prior, check, information_gain, variances
from drgs.information.blocks import MAP_PRIOR, SceneBlocks
from drgs.information.expected_error import PARTS, ErrorRecord, error_parts
from drgs.information.maps import fisherrf_map, moments_map
from drgs.information.scoring import Scoring
from drgs.information.sums import add, together
from drgs.integrator import render
from drgs.io.checkpoint import save_state
from drgs.io.journal import SCHEMA
from drgs.io.outputs import LockedFolder, write_json
from drgs.settings import RenderSettings

KINDS = ("variance", "share")  # of maps
_LARGE_VIEW = 100_000  # pixels of a view from which on a smaller size is advised: photographs, not fits. Chosen
_log = logging.getLogger(__name__)


def run(args: Fisher) -> None:
    """`drgs fisher SCENE`."""
    settings = args.settings()
    prior = args.scoring.prior or MAP_PRIOR
    inputs = [args.scene, args.train or "", args.cameras or ""]
    output = lock_output(args.output, "fisher", ["information.safetensors", "fisher.json"], inputs)
    given = SceneInput.of(args)
    settings = given.over_background(settings)
    text = args.train
    if text is None and given.run is None:
        if args.cameras in (None, "orbit", "dome"):
            raise ValueError(
                "a file of Gaussians has no record of its views: --train or --cameras must name a data set, a run or a "
                "cameras.json, e.g. --train FOLDER, the photographs and poses that it was trained on"
            )
        text = args.cameras
    known = known_views(text, args, given, given.keeps_lenses(args.undistort), args.info_pixels)
    known = dataclasses.replace(known, cameras=with_times(known.cameras, args, given))
    views, source = known.cameras, known.source
    if args.cameras is not None:
        views, source = views_to_compare("--cameras", args.cameras, args, given, known, fresh=False)
    views = evenly(with_times(views, args, given), args.limit)
    check_lenses("fisher", settings, [*known.cameras, *views])
    pixels = max((camera.width * camera.height for camera in (*known.cameras, *views)), default=0)
    if args.info_pixels is None and pixels > _LARGE_VIEW:
        args.say(f"views of {pixels} pixels: --info-pixels {pixels // 10} takes half of the time or less")
    scoring = given.scoring(args.scoring, settings)
    region = region_of("fisher", args, given, Source.known(text, given), known.cameras, settings)
    shown = None if region is None else region.shares(given.scene, views, settings, "fisher")
    with Bar("information", len(known.cameras) + len(views), not args.quiet) as bar:
        errors = _errors(args, given, known, settings)
        maps = InformationMaps(args.scene, given, scoring, prior, known, views, source, args.pose, args.maps, errors)
        if region is not None and shown is not None:
            maps = dataclasses.replace(maps, region=region.text, shares=shown.shares)
        groups, rows = maps.write(output, bar.advance)
    if not args.quiet:
        _print(args, known, groups, rows, source)
        if shown is not None and shown.note:
            print(f"note: {shown.note}")


def _errors(args: Fisher, given: SceneInput, known: Known, settings: RenderSettings) -> ErrorRecord | None:
    """What the photographs of the known views say about errors; None, with a line, where there are none."""
    if args.train is None and given.run is not None:
        return run_error_record(given.run, settings, known.pixels)
    if not known.views:
        _log.warning(
            "%s: has no photographs: only information is written, no expected error, which needs their residuals; "
            "name a data set by --train",
            known.source,
        )
        return None
    config = FitConfig() if given.record is None else given.record.config
    data = config.data.replace(undistort="off" if known.lenses else "on")
    return error_record_of_views(given.scene, list(known.views), settings, data, known.pixels)


@dataclasses.dataclass(frozen=True)
class InformationMaps:
    """Information of known views about every Gaussian, and maps of the uncertainty in other views.

    Attributes:
        path: File or run that the scene is of.
        given: The scene.
        scoring: What counts, how it is computed, and the settings that views are rendered with.
        prior: lambda; its unit of positions is, unless it has one, that of the known views.
        known: Known views.
        views: Views that maps are of.
        source: Where they come from, in words.
        pose: Whether to compute the information of each of these views about its own pose, too.
        compare: Whether to write a picture of each view beside its maps of several rules, too.
        errors: What the photographs of the known views say about errors; None: there are none.
        region: The text of a region whose pixels are told apart; None: there is none.
        shares: (H, W) of each view: how much of each pixel shows it.
    """

    path: Path
    given: SceneInput
    scoring: Scoring
    prior: Prior
    known: Known
    views: list[Camera]
    source: str
    pose: bool = False
    compare: bool = False
    errors: ErrorRecord | None = None
    region: str | None = None
    shares: Sequence[torch.Tensor] = ()

    def write(
        self, output: LockedFolder, advance: Callable[[], None] = lambda: None
    ) -> tuple[dict[str, GroupSummary], list[MappedView]]:
        """Write information.safetensors, fisher.json and the maps; what they hold of groups and views, in numbers.

        Args:
            output: The folder.
            advance: Called after each view.
        Raises:
            ValueError: If a block is named that the scene does not have, or a file of another program is in the way.
        """
        settings, cameras = self.scoring.settings, self.known.cameras
        blocks = SceneBlocks.of(self.given.scene, self.scoring, [*cameras, *self.views], "fisher")
        prior = self.prior.in_scene(self.given.scene, cameras)
        compared = ComparedMaps(self.given.scene, settings, self.prior.over(1.0)) if self.compare else None
        names = pictures.file_names([camera.name for camera in self.views])
        kinds = [*(["error"] if self.errors else []), *_map_kinds(blocks.names), *(["maps"] if compared else [])]
        kinds += ["region"] if self.shares else []
        output.check(f"{name}.{kind}.png" for name in names for kind in kinds)
        by_block: dict[str, dict[str, torch.Tensor]] = {}
        for camera in cameras:
            for block, part in blocks.information(camera).items():
                check(f"fisher: view {camera.name}", part)
                add(by_block.setdefault(block, {}), part)
            if compared:
                compared.know(camera)
            advance()
        H = together(by_block)
        rows = []
        for number, (camera, name) in enumerate(zip(self.views, names, strict=True)):
            share = self.shares[number].numpy() if self.shares else None
            row = _view(output.path, blocks, camera, name, H, prior, compared, self.pose, share)
            if self.errors:
                parts = {part: x.numpy() for part, x in error_parts(self.given.scene, camera, self.errors).items()}
                error = np.sqrt(sum(parts.values()))
                files = [f"{name}.error.png", *row.files]
                pictures.write_png(output.path / files[0], pictures.map_picture(error))
                row = dataclasses.replace(row, files=files, error=ErrorSummary.of(parts))
                if share is not None and row.region is not None and row.region.pixels:
                    rmse = float((share * error**2).sum(dtype=np.float64) / row.region.pixels) ** 0.5
                    row = dataclasses.replace(row, region=dataclasses.replace(row.region, rmse=rmse))
            rows.append(row)
            advance()
        groups = {name: GroupSummary.of(x, by_block, name) for name, x in H.items()}
        header = {"groups": list(H), "views": [camera.name for camera in cameras], "settings": settings}
        save_state(
            output.path / "information.safetensors", H, header | {"blocks": list(by_block), "length": prior.length}
        )
        write_json(output.path / "fisher.json", self._report(blocks, prior, groups, rows))
        return groups, rows

    def _report(
        self, blocks: SceneBlocks, prior: Prior, groups: dict[str, GroupSummary], rows: list[MappedView]
    ) -> dict[str, Any]:
        """Contents of fisher.json."""
        scoring = self.scoring
        is_probed = "deformation" in blocks.names or scoring.method == "probes"
        return {
            "schema": SCHEMA,
            "command": "fisher",
            "scene": str(self.path),
            "gaussians": len(self.given.gaussians),
            "method": scoring.method,
            "prior": prior.to_json(),
            "blocks": list(blocks.names),
            "semantics": blocks.metric.to_json() if blocks.metric else None,
            **blocks.scoring.nuisances.if_any(),
            "probes": scoring.probes if is_probed else None,
            "settings": dataclasses.asdict(scoring.settings),
            "pixels": self.known.pixels,
            "region": self.region,
            "misfit": self.errors.mean_misfit**0.5 if self.errors else None,
            "known": {"source": self.known.source, "names": [camera.name for camera in self.known.cameras]},
            "groups": {name: dataclasses.asdict(row) for name, row in groups.items()},
            "source": self.source,
            "views": [row.to_json() for row in rows],
        }


def _map_kinds(names: Sequence[str]) -> list[str]:
    """Kinds of the maps of these blocks, as in the names of their files."""
    parts = ["", *(f"{block}." for block in names)] if len(names) > 1 else [""]
    return [part + kind for part in parts for kind in KINDS]


@dataclasses.dataclass(frozen=True)
class GroupSummary:
    """Summary of the known views' information about a group of parameters.

    Attributes:
        shape: Shape of the information.
        sum: Sum of the entries.
        median_of_positive: Median of the entries above 0; None where there are none.
        zero: Number of entries that are 0: nothing is known of these parameters.
        blocks: Block of the image -> sum of the entries that come from it.
    """

    shape: list[int]
    sum: float
    median_of_positive: float | None
    zero: int
    blocks: dict[str, float]

    @classmethod
    def of(cls, x: torch.Tensor, by_block: dict[str, Information], name: str) -> GroupSummary:
        """The summary of a group's information, which each block has a part in."""
        positive = x[x > 0]
        median = float(positive.median()) if positive.numel() else None
        parts = {block: float(part[name].sum()) if name in part else 0.0 for block, part in by_block.items()}
        return cls(list(x.shape), float(x.sum()), median, int((x == 0).sum()), parts)


@dataclasses.dataclass(frozen=True)
class MapSummary:
    """A map in three numbers."""

    sum: float
    mean: float
    max: float

    @classmethod
    def of(cls, values: np.ndarray) -> MapSummary:
        """The summary of an (H, W) map."""
        return cls(float(values.sum(dtype=np.float64)), float(values.mean()), float(values.max()))


@dataclasses.dataclass(frozen=True)
class ErrorSummary:
    """What error is expected of a view.

    Attributes:
        rmse: Root of the mean squared error of its pixels, units of color.
        parts: Share of each part in its mean squared error.
    """

    rmse: float
    parts: dict[str, float]

    @classmethod
    def of(cls, parts: dict[str, np.ndarray]) -> ErrorSummary:
        """The summary of the (H, W) variances of each part."""
        means = {name: float(x.mean(dtype=np.float64)) for name, x in parts.items()}
        total = sum(means.values())
        return cls(total**0.5, {name: x / total if total else 0.0 for name, x in means.items()})


@dataclasses.dataclass(frozen=True)
class RegionSummary:
    """What a view says of a region, its pixels weighed by how much of each shows it.

    Attributes:
        pixels: Sum of the shares.
        variance: Mean of the map `variance` over them; None where no pixel shows any of it, as `rmse`.
        rmse: Root of the mean squared error that is expected of them, units of color; None without photographs, too.
    """

    pixels: float
    variance: float | None
    rmse: float | None = None

    @classmethod
    def of(cls, share: np.ndarray, variance: np.ndarray) -> RegionSummary:
        """The summary of (H, W) shares and a map."""
        pixels = float(share.sum(dtype=np.float64))
        return cls(pixels, float((share * variance).sum(dtype=np.float64)) / pixels if pixels else None)


@dataclasses.dataclass(frozen=True)
class PoseSummary:
    """A view's information about its own pose: a 6x6 matrix and its eigenvalues, ascending."""

    information: list[list[float]]
    eigenvalues: list[float]


@dataclasses.dataclass(frozen=True)
class MappedView:
    """What a view shows.

    Attributes:
        name, camera: Name and camera of the view.
        files: Names of the files with its maps.
        gain: What it would add to the known views, by criterion.
        variance, share: Its maps, of all blocks together.
        blocks: Block of the image -> kind -> the map of that block alone.
        error: The error that is expected of it; None where there are no photographs of the known views.
        region: What it says of the region; None without one.
        pose: What it says about its own pose, with --pose; else None.
    """

    name: str
    camera: Camera
    files: list[str]
    gain: dict[str, float]
    variance: MapSummary
    share: MapSummary
    blocks: dict[str, dict[str, MapSummary]]
    error: ErrorSummary | None = None
    region: RegionSummary | None = None
    pose: PoseSummary | None = None

    def to_json(self) -> dict[str, Any]:
        """As fisher.json holds it."""
        fields = dataclasses.asdict(self) | {"camera": camera_to_json(self.camera)}
        return {name: value for name, value in fields.items() if value is not None}


def map_weights(
    H: Information, candidate: Information, prior: Prior, rows: Information | None = None
) -> tuple[Information, Information]:
    """Weights of `drgs.fisher.variance_map` for the two maps of the module's text.

    Args:
        H, candidate: Information of the known views and of the view shown, same groups.
        prior: lambda; parameters with H + lambda = 0 weigh nothing.
        rows: The sums of the squared derivatives of the view shown, where its own unknowns have been eliminated from
            `candidate`: what is left of a score is shared among pixels in proportion to these. None: they are it.
    Returns:
        Those of `variance` and of `share`.
    """
    variance = variances(H, prior)
    share = {}
    for name in H:
        Hc = candidate[name].double()
        if rows is not None:
            squares = rows[name].double()
            share[name] = torch.where(squares > 0, (Hc * variance[name]).log1p() / squares, 0.0)
            continue
        # log(1 + x) / Hc tends to the variance where the view says nothing about a parameter.
        share[name] = torch.where(Hc > 0, (Hc * variance[name]).log1p() / Hc, variance[name])
    return variance, share


def _view(
    folder: Path,
    scene_blocks: SceneBlocks,
    camera: Camera,
    name: str,
    H: Information,
    prior: Prior,
    compared: ComparedMaps | None,
    has_pose: bool,
    share: np.ndarray | None = None,
) -> MappedView:
    """Write the maps of one view; returns its part of the report. `share` is how much of each pixel shows a region."""
    Hc = together(scene_blocks.information(camera))
    rows = together(scene_blocks.with_unknowns().information(camera)) if scene_blocks.scoring.nuisances.names else None
    weights = dict(zip(KINDS, map_weights(H, Hc, prior, rows), strict=True))
    maps = {
        kind: {block: x.numpy() for block, x in scene_blocks.variance_maps(camera, of_kind).items()}
        for kind, of_kind in weights.items()
    }
    files = []
    totals = {}
    for kind, parts in maps.items():
        totals[kind] = sum(parts.values())
        shown = {"": totals[kind]} | ({f"{block}.": x for block, x in parts.items()} if len(parts) > 1 else {})
        for prefix, values in shown.items():
            files.append(f"{name}.{prefix}{kind}.png")
            pictures.write_png(folder / files[-1], pictures.map_picture(values))
    if compared:
        files.append(f"{name}.maps.png")
        pictures.write_png(folder / files[-1], compared.row(camera, maps["variance"]))
    of_region = None
    if share is not None:
        files.append(f"{name}.region.png")
        pictures.write_png(folder / files[-1], pictures.map_picture(share))
        of_region = RegionSummary.of(share, totals["variance"])
    pose = None
    if has_pose:
        information = fisher.pose_information(scene_blocks.scene, camera, scene_blocks.scoring.settings)
        pose = PoseSummary(information.tolist(), torch.linalg.eigvalsh(information).tolist())
    gain = {criterion: information_gain(Hc, H, criterion, prior).total for criterion in ("logdet", "eig")}
    blocks = {block: {kind: MapSummary.of(maps[kind][block]) for kind in KINDS} for block in scene_blocks.names}
    summaries = (MapSummary.of(totals[kind]) for kind in KINDS)
    return MappedView(camera.name, camera, files, gain, *summaries, blocks, region=of_region, pose=pose)


def _print(args: Fisher, known: Known, groups: dict[str, GroupSummary], views: list[MappedView], source: str) -> None:
    """Print what is expected of views, and the information, as tables."""
    rows = []
    for view in views:
        if view.error is not None:
            shares = (f"{share:.0%}" for share in view.error.parts.values())
            psnr = -20 * math.log10(view.error.rmse) if view.error.rmse > 0 else math.inf
            rows.append((view.name, f"{view.error.rmse:.3g}", f"{psnr:.1f}", *shares))
    if rows:
        tables.show(f"expected error ({source})", ("view", "of a color", "expected PSNR", *PARTS), rows)
    rows = []
    for view in views:
        if view.region is not None:
            told = [f"{x:.3g}" if x is not None else "-" for x in (view.region.rmse, view.region.variance)]
            rows.append((view.name, f"{view.region.pixels:.1f}", *told))
    if rows:
        tables.show(f"region {args.region} ({source})", ("view", "pixels", "expected error", "mean variance"), rows)
    rows = []
    several = blocks if len(blocks := tuple(next(iter(groups.values())).blocks)) > 1 else ()
    for name, row in groups.items():
        share = f"{row.zero / max(math.prod(row.shape), 1):.1%}"
        shape = "x".join(map(str, row.shape))
        rows.append(
            (name, shape, f"{row.sum:.4g}", f"{row.median_of_positive or 0:.4g}", share, *_shares(row.blocks, several))
        )
    title = f"information of {len(known.cameras)} views ({known.source})"
    tables.show(title, ("group", "shape", "sum", "median\n> 0", "nothing\nknown", *_percent(several)), rows)
    rows = []
    for row in views:
        values = row.pose.eigenvalues if row.pose else []
        numbers = (row.gain["eig"], row.gain["logdet"], row.variance.mean, *values[:1], *values[-1:])
        parts = _shares({block: maps["variance"].sum for block, maps in row.blocks.items()}, several)
        rows.append((row.name, *(f"{x:.3g}" for x in numbers), *parts))
    poses = ("pose: least", "most") if args.pose else ()
    columns = ("view", "eig", "logdet", "mean variance", *poses, *(f"eig: {x}" for x in _percent(several)))
    tables.show(f"views ({source})", columns, rows)
    if args.pose:
        print("pose: information about the least and the best known of its six directions; fisher.json has all six")
    files = sum(len(row.files) for row in views)
    print(f"information.safetensors, fisher.json and {files} maps: {args.output}")
    if any(view.error for view in views):
        print(f"where views are expected to be wrong: {args.output / '*.error.png'}")


def _percent(several: tuple[str, ...]) -> tuple[str, ...]:
    """Columns of the blocks, where there are several."""
    return tuple(f"{block if len(several) < 3 else block[:4] + '.'} %" for block in several)  # of 80 columns


def _shares(blocks: dict[str, float], several: tuple[str, ...]) -> tuple[str, ...]:
    """Share of each block in a sum, for the columns of a table."""
    total = sum(blocks.values())
    return tuple(f"{100 * blocks[block] / total:.1f}" if total else "-" for block in several)


# ---------------------------------------------------------------------------------- maps of several rules, side by side


_ENLARGED_BELOW = 200  # pixels of width, below which a picture is enlarged by a whole number


class ComparedMaps:
    """Maps of `moments`, of `fisherrf` and of every block, of views that are compared with known ones.

    Args:
        scene: The scene that is seen.
        settings: Settings of the renderer.
        prior: lambda of FisherRF, whose positions are in world units.
    """

    def __init__(self, scene: Scene, settings: RenderSettings, prior: Prior) -> None:
        self.scene = scene
        self.settings = settings
        self.prior = prior
        self.known: dict[str, torch.Tensor] = {}  # as FisherRF's code computes it

    def know(self, camera: Camera) -> None:
        """Add a known view."""
        add(self.known, fisher.diagonal(self.scene, camera, self.settings, "fisherrf"))

    def row(self, camera: Camera, blocks: dict[str, np.ndarray]) -> np.ndarray:
        """(H, W, 3) uint8: the view as it is rendered, then the maps, each on a scale of its own.

        Args:
            camera: The camera of the view.
            blocks: Block -> (H, W) variance map.
        """
        with torch.no_grad():  # a picture
            seen = self.scene.at(camera.time)
        image = render(seen.replace(features=None), camera, self.settings, outputs=()).rgb.cpu().numpy()
        maps = {
            "moments": moments_map(seen, camera, self.settings).numpy(),
            "fisherrf": fisherrf_map(seen, camera, self.known, self.prior, self.settings).numpy(),
            **blocks,
        }
        times = max(1, -(-_ENLARGED_BELOW // camera.width))
        large = lambda x: np.repeat(np.repeat(x, times, 0), times, 1)  # noqa: E731
        when = "" if camera.time is None else f" at {camera.time:g}"
        panels = [pictures.caption(large(image), f"{camera.name or 'view'}{when}")]
        panels += [pictures.caption(pictures.map_picture(large(x)), name) for name, x in maps.items()]
        return np.concatenate(panels, axis=1)
