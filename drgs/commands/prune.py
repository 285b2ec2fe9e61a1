"""`drgs prune`: the Gaussians that photographs need, as a file or a run, and what leaving out the others costs."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.codecs import check_suffix, origin_file, save_gaussians
from drgs.commands.options import Prune
from drgs.commands.regions import region_of
from drgs.commands.scene_input import SELECTION, SceneInput
from drgs.commands.values import parsed_decibels
from drgs.commands.viewpoints import Source, check_lenses, warn_of_unseen
from drgs.data import View
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians, Scene
from drgs.fitting.components.base import Checkpoint, Component, RunViews
from drgs.fitting.components.table import COMPONENTS, component_files, held_components
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame, load_frames, measurable
from drgs.fitting.metrics import TRAIN_VIEWS, through_renderers
from drgs.fitting.networks import saved_networks
from drgs.fitting.records import fitted_views, is_run, of_some
from drgs.fitting.renderers import renderers_to_measure
from drgs.information.region import Region
from drgs.integrator import Output
from drgs.io.checkpoint import load_state, save_state
from drgs.io.journal import SCHEMA
from drgs.io.outputs import lock_folder, write_json, write_whole
from drgs.io.run import Run
from drgs.pruning import ROUNDS, Pruned, fit_on, prune
from drgs.settings import RenderSettings

_NOTED = 0.1  # dB lost in some renderer from which on it is said how to win them back: what can be seen; chosen


def _copied() -> tuple[str, ...]:
    """Files of a run that hold for it with fewer Gaussians, too."""
    return ("config.json", "env.json", "log.jsonl", SELECTION, *component_files())


def run(args: Prune) -> None:
    """`drgs prune SCENE -o FILE`, or of a run `-o FOLDER`."""
    settings = args.settings()
    loss = None if args.loss is None else parsed_decibels(args.loss)
    output = _Output.of(args)
    with lock_folder(output.report.parent, "prune", output.names, [args.scene, args.data or ""]):
        with Bar("reading", show=not args.quiet):
            given = SceneInput.of(args)
            _check_scene(args, given, output)
            checkpoint = _checkpoint(args, given, output)
        settings = given.over_background(settings)
        lenses = given.keeps_lenses(args.undistort)
        views = _Views.of(args, given, lenses)
        if views.train is None and (loss is not None or args.refit):
            option = "--refit" if loss is None else "--loss"
            raise ValueError(
                f"{option} must have photographs, {args.data} has cameras alone; name a data set by --data"
            )
        check_lenses("prune", settings, views.cameras)
        warn_of_unseen(given.gaussians, views.cameras)
        held, as_photograph = _as_left(args, given, views, checkpoint)
        region = region_of("prune", args, given, views.origin, views.cameras, settings)
        with Bar("prune", show=not args.quiet):
            pruned = prune(
                given.scene,
                views.cameras,
                settings,
                keep=args.keep,
                loss=loss,
                images=None if views.train is None else [frame.image() for frame in views.train],
                masks=None if views.train is None else [frame.mask for frame in views.train],
                as_photographs=[functools.partial(_through, held, frame) for frame in views.train or ()],
                semantics=given.semantics(),
                unseen=args.unseen,
                region=region,
                rounds=args.rounds or ROUNDS,
            )
            if bool(pruned.kept.all()):
                raise ValueError(
                    f"{args.scene}: something must be left out, but none of its {len(pruned.kept)} Gaussians can go; "
                    "allow more --loss, lower --keep, or say --unseen remove"
                )
            stages = {"before": given.scene, "pruned": pruned.gaussians}
            if args.refit and views.train is not None and isinstance(pruned.gaussians, Gaussians):
                far = int(pruned.kept[: given.far].sum())
                # A file's Gaussians are fitted on as any fit, over the background that --set says.
                config = given.record.config if given.record else FitConfig()
                if given.record is None:
                    config = config.replace(settings=config.settings.replace(background=given.background))
                frames = _shown(views.train, region, given, settings)
                stages["refitted"] = fit_on(pruned.gaussians, frames, config, args.refit, far, held)
            costs = views.measured(stages, given, settings, lenses, region, as_photograph)
            *_, left = stages.values()
            output.write(left, given, checkpoint, pruned.kept)
            write_json(output.report, _record(args, pruned, views, settings, costs))
    if not args.quiet:
        _print(args, pruned, views, costs, output)


@dataclasses.dataclass(frozen=True)
class _Output:
    """What is written.

    Attributes:
        scene: A file of Gaussians, or a run folder.
        report: The JSON file about it.
        names: All files, in the folder of the report.
    """

    scene: Path
    report: Path
    names: list[str]

    @classmethod
    def of(cls, args: Prune) -> _Output:
        """What `-o` names: of a run, a name without a suffix is a run folder.

        Raises:
            ValueError: If a suffix is no format's, or a folder holds a run already.
        """
        path = args.output
        if not path.suffix and is_run(args.scene):
            if is_run(path):
                raise ValueError(f"{path}: must be a new run folder, holds a run already; choose another")
            return cls(path, path / "prune.json", [*_copied(), "state.safetensors", "point_cloud.ply", "prune.json"])
        report = path.with_name(path.name[: -len(check_suffix("prune", path))] + ".json")
        return cls(path, report, [path.name, origin_file(path).name, report.name])

    @property
    def is_run(self) -> bool:
        """Whether it is a run folder."""
        return self.report.parent == self.scene

    @property
    def gaussians(self) -> Path:
        """The file that has them."""
        return Run(self.scene).state if self.is_run else self.scene

    def write(self, scene: Scene, given: SceneInput, checkpoint: Checkpoint | None, kept: torch.Tensor) -> None:
        """Write what is left; of a run, its checkpoint and what it says of itself, but nothing that was measured."""
        if not self.is_run or given.run is None or checkpoint is None:
            save_gaussians(scene.at(None), self.scene)
            return
        run, fewer = Run(self.scene), of_some(checkpoint, kept)
        for name in _copied():
            if (given.run.path / name).is_file():
                write_whole(run.path / name, (given.run.path / name).read_bytes())
        save_state(run.state, dict(fewer.tensors), dict(fewer.header))
        save_gaussians(given.gaussians.take(kept).replace(features=None), run.point_cloud)


def _checkpoint(args: Prune, given: SceneInput, output: _Output) -> Checkpoint | None:
    """The run's, where something of it beside its Gaussians is needed or may be of use.

    Raises:
        FileNotFoundError, ValueError: If it is missing or damaged.
    """
    needed = output.is_run or args.refit and given.estimated
    if given.run is None or given.step is None and not needed:  # there is the PLY alone
        return None
    return Checkpoint(*load_state(given.run.state), str(given.run.state))


def _check_scene(args: Prune, given: SceneInput, output: _Output) -> None:
    """Raise ValueError where a scene cannot be pruned, not be fitted on, or not be written."""
    if given.moving is not None and not output.is_run:
        raise ValueError(
            f"{args.scene}: what moves must stay a run, since a file holds Gaussians of one time, got -o "
            f"{args.output}; name a folder, and make files of it by drgs convert --time"
        )
    if output.is_run and args.refit:
        raise ValueError(
            f"--refit must have a file of Gaussians to write, got the run folder -o {args.output}; leave it out"
        )
    if given.run is None and args.data is None:
        raise ValueError(
            "a file of Gaussians has no record of its views: --data must name a data set, a run or a cameras.json"
        )


@dataclasses.dataclass(frozen=True)
class _Views:
    """Views that a scene is pruned by, and those by which it is measured.

    Attributes:
        cameras: What decides.
        train: Their photographs; None where there are cameras alone.
        held_out: Photographs of other views.
        source: Where they come from, in words.
        origin: Where they come from.
    """

    cameras: list[Camera]
    train: list[Frame] | None
    held_out: list[Frame]
    source: str
    origin: Source

    @classmethod
    def of(cls, args: Prune, given: SceneInput, lenses: bool) -> _Views:
        """Those that options name, at the size of the fit.

        Raises:
            FileNotFoundError, ValueError: If there are none, or a file is damaged.
        """
        text = str(given.run.path) if args.data is None and given.run else str(args.data)
        source = Source.of("--data", text, (), given)
        if source.kind == "list":
            cameras = source.listed()
            return cls(cameras if lenses else [camera.undistorted() for camera in cameras], None, [], text, source)
        dataset = source.dataset(args, given, lazy=False)
        record = source.record or given.record
        config = record.config.data if record else FitConfig().data
        train, test = dataset.split(*([config.test_every, config.test_offset] if record else []))
        if source.kind == "run":
            fitted = set(fitted_views(Run(Path(source.text)), source.record))
            train = [view for view in train if view.name in fitted]
        if not train:
            raise ValueError(
                f"{text}: must hold a training view, holds none ({dataset.split_rule()}); name another set"
            )

        def frames(views: list[View]) -> list[Frame]:
            for view in views:
                view.background = given.background  # behind photographs with an alpha channel
            pixels = args.max_pixels or config.max_pixels
            return measurable(load_frames(views, pixels, config.mask, "off" if lenses else "on"), "prune")

        with Bar("photographs", show=not args.quiet):
            seen, held_out = frames(train), frames(test)
        if not seen:
            raise ValueError(
                f"{text}: must hold a training view whose mask keeps a pixel, its {len(train)} masks keep none; mend "
                "them, or name another set"
            )
        return cls([frame.camera for frame in seen], seen, held_out, text, source)

    def measured(
        self,
        stages: dict[str, Scene],
        given: SceneInput,
        settings: RenderSettings,
        lenses: bool,
        region: Region | None = None,
        as_photograph: Callable[[Output, Frame], Output] | None = None,
    ) -> dict[str, dict[str, float]]:
        """Renderer -> stage -> mean PSNR in dB: of held-out views, or else of some of those that decide; of the object
        where masks or alpha say where it is, of the pixels that show a region where there is one. Nothing without
        photographs.
        """
        frames = self.held_out or self.train
        if frames is None:
            return {}
        whole = {frame.name: frame for frame in frames}  # a camera exposes for all that it sees
        seen = None if as_photograph is None else lambda out, frame: as_photograph(out, whole[frame.name])
        frames = _shown(frames, region, given, settings)
        renderers = renderers_to_measure(("fast",), given.settings("fast"), "all", lenses)
        found: dict[str, dict[str, float]] = {name: {} for name in renderers}
        for stage, scene in stages.items():
            measured: Any = through_renderers(
                scene, frames, renderers, self.measured_split, None if self.held_out else TRAIN_VIEWS, seen
            )
            for row in measured["rows"]:
                found[row["name"]][stage] = row["mean"].get("psnr_object", row["mean"]["psnr"])
        return found

    @property
    def measured_split(self) -> str:
        """What is measured: `test`, or `train` where nothing is held out."""
        return "test" if self.held_out else "train"


def _as_left(
    args: Prune, given: SceneInput, views: _Views, checkpoint: Checkpoint | None
) -> tuple[list[Component], Callable[[Output, Frame], Output] | None]:
    """What the run's fit has renderings go through before it compares them with its photographs, exposures, and before
    they are measured; nothing where other photographs are compared.

    Raises:
        ValueError: If `--refit` is to compare others.
    """
    if views.train is None or given.record is None or checkpoint is None:
        return [], None
    frames, names = views.train, checkpoint.header["views"]
    networks, settings = saved_networks(checkpoint.tensors, checkpoint.header), given.record.config.settings
    held = held_components(names, networks, given.over_background(settings))
    if held and (other := next((frame.name for frame in frames if frame.name not in names), None)):
        if args.refit:
            raise ValueError(
                f"--refit must have photographs whose exposure {args.scene} has found, {other!r} of {views.source} is "
                "not among these; leave --data or --refit out"
            )
        return [], None
    run = RunViews(given.scene, settings, bool(given.record.refined), [], [], [], names, lambda: frames, networks)
    options: dict[str, Any] = {}
    for component in COMPONENTS.values():
        options |= component.run_evaluation(run)
    return held, options.get("as_photograph")


def _through(held: list[Component], frame: Frame, out: Output) -> Output:
    """A rendering as the fit compares it with a photograph."""
    for component in held:
        out = component.as_photograph(out, frame)
    return out


def _shown(frames: list[Frame], region: Region | None, given: SceneInput, settings: RenderSettings) -> list[Frame]:
    """The photographs that show a region, each pixel weighed by how much of it does; all of them without one.

    Raises:
        NothingOfRegion: If none does.
    """
    if region is None:
        return frames
    shares = region.shares(given.scene, [frame.camera for frame in frames], settings, "prune").shares
    masks = (x if frame.mask is None else frame.mask * x for frame, x in zip(frames, shares, strict=True))
    # What is outside is not empty, but does not count.
    shown = (
        dataclasses.replace(frame, mask=x, is_object=False, alpha=None) for frame, x in zip(frames, masks, strict=True)
    )
    return [frame for frame in shown if frame.mask is not None and bool((frame.mask > 0).any())]


def _record(
    args: Prune, pruned: Pruned, views: _Views, settings: RenderSettings, costs: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """Contents of the JSON file beside the Gaussians."""
    return {
        "schema": SCHEMA,
        "command": "prune",
        "scene": str(args.scene),
        "views": {"source": views.source, "names": [camera.name for camera in views.cameras]},
        "gaussians": {"before": len(pruned.kept), "after": len(pruned.gaussians), "unseen": pruned.unseen},
        "unseen": args.unseen,
        "region": args.region,
        "asked": {"keep": args.keep, "loss": args.loss},
        "rounds": [dataclasses.asdict(x) for x in pruned.rounds],
        "train_psnr": pruned.psnr,
        "refit": args.refit,
        "settings": dataclasses.asdict(settings),
        "split": views.measured_split,
        "psnr": costs,
    }


def _print(args: Prune, pruned: Pruned, views: _Views, costs: dict[str, dict[str, float]], output: _Output) -> None:
    """Print what it cost, what no view shows, and where the Gaussians are."""
    stages: Sequence[str] = list(next(iter(costs.values()), {}))
    if costs:
        kind = "held-out" if views.held_out else "training"
        of = "" if args.region is None else f", of the pixels that show {args.region}"
        count = len(views.held_out) or min(len(views.cameras), TRAIN_VIEWS)
        rows = []
        for name, row in costs.items():
            last = row[stages[-1]] - row["before"]
            rows.append((name, *(f"{row[stage]:.2f}" for stage in stages), f"{last:+.2f}"))
        tables.show(f"PSNR in dB of {count} {kind} views{of}", ("renderer", *stages, "change"), rows)
        if not args.refit and min(row[stages[-1]] - row["before"] for row in costs.values()) < -_NOTED:
            print("--refit 200 fits what is left for 200 steps more, which wins most of that back (docs/prune.md)")
    else:
        print(f"{views.source} has no photographs: what it costs is not measured (--data names a data set)")
    if pruned.unseen:
        what = "were removed" if args.unseen == "remove" else "are kept (--unseen remove removes them)"
        print(f"{pruned.unseen:,} Gaussians are shown by none of the {len(views.cameras)} training views: they {what}")
    size = output.gaussians.stat().st_size / 1e6
    print(f"{len(pruned.gaussians):,} of {len(pruned.kept):,} Gaussians: {args.output} ({size:.2f} MB)")
