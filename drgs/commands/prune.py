"""`drgs prune`: the Gaussians that photographs need, in a file of any format, and what leaving out the others costs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.codecs import check_suffix, origin_file, save_gaussians
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import Source, check_lenses, warn_of_unseen
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.fitting.components.base import Checkpoint, Component
from drgs.fitting.components.exposure import ExposureComponent
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.metrics import TRAIN_VIEWS, through_renderers
from drgs.fitting.records import fitted_views
from drgs.fitting.renderers import renderers_to_measure
from drgs.io.checkpoint import load_state, state_header
from drgs.io.journal import SCHEMA
from drgs.io.outputs import lock_folder, write_json
from drgs.io.run import Run
from drgs.pruning import check_amount, fit_on, prune

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.commands.options import Prune
    from drgs.data import View
    from drgs.ellipsoids import Gaussians
    from drgs.pruning import Pruned
    from drgs.settings import RenderSettings

__all__ = ["run"]


def run(args: Prune) -> None:
    """`drgs prune SCENE -o FILE`."""
    settings = args.settings()  # refuses what cannot be, before anything is read, as all up to the lock
    loss = None if args.loss is None else _decibels(args.loss)
    check_amount("prune", args.keep, loss)
    suffix = check_suffix("prune", args.output)
    report = args.output.name[: -len(suffix)] + ".json"
    names = [args.output.name, origin_file(args.output).name, report]
    with lock_folder(args.output.parent, "prune", names, [args.scene, args.data or ""]):
        with Bar("reading", show=not args.quiet):
            given = SceneInput.of(args)
            _check_scene(args, given)
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
        exposures = _exposures(args, given, views)
        with Bar("prune", show=not args.quiet):
            pruned = prune(
                given.gaussians,
                views.cameras,
                settings,
                keep=args.keep,
                loss=loss,
                images=None if views.train is None else [frame.image() for frame in views.train],
                masks=None if views.train is None else [frame.mask for frame in views.train],
                semantics=given.semantics(),
                unseen=args.unseen,
                **({} if args.rounds is None else {"rounds": args.rounds}),
            )
            if bool(pruned.kept.all()):
                raise ValueError(
                    f"{args.scene}: something must be left out, but none of its {len(pruned.kept)} Gaussians can go; "
                    "allow more --loss, lower --keep, or say --unseen remove"
                )
            stages = {"before": given.gaussians, "pruned": pruned.gaussians}
            if args.refit and views.train is not None:
                far = int(pruned.kept[: _skybox(given)].sum())
                config = given.record.config if given.record else _config_over(given)
                stages["refitted"] = fit_on(pruned.gaussians, views.train, config, args.refit, far, exposures)
            costs = views.measured(stages, given, settings, lenses)
            *_, left = stages.values()
            save_gaussians(left, args.output)
            write_json(args.output.with_name(report), _record(args, pruned, views, settings, costs))
    if not args.quiet:
        _print(args, pruned, views, costs)


def _decibels(text: str) -> float:
    """The number of `0.1dB`, `0.1 dB` or `0.1`."""
    try:
        return float(text.strip().lower().removesuffix("db"))
    except ValueError:
        raise ValueError(f"--loss must be a number of decibels above 0, e.g. 0.1dB, got {text!r}; correct it") from None


def _check_scene(args: Prune, given: SceneInput) -> None:
    """Raise ValueError where a scene cannot be pruned, or not be fitted on."""
    if given.moving is not None:
        raise ValueError(
            f"{args.scene}: must stand still, as a file holds Gaussians of one time, but moves; "
            "drgs.fisher.removal_error has the errors, summed over times"
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
    """

    cameras: list[Camera]
    train: list[Frame] | None
    held_out: list[Frame]
    source: str

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
            return cls(cameras if lenses else [camera.undistorted() for camera in cameras], None, [], text)
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
            return load_frames(views, pixels, config.mask, "off" if lenses else "on")

        with Bar("photographs", show=not args.quiet):
            seen, held_out = frames(train), frames(test)
        return cls([frame.camera for frame in seen], seen, held_out, text)

    def measured(
        self, stages: dict[str, Gaussians], given: SceneInput, settings: RenderSettings, lenses: bool
    ) -> dict[str, dict[str, float]]:
        """Renderer -> stage -> mean PSNR in dB: of held-out views, or else of some of those that decide; of the object
        where masks or alpha say where it is. Nothing without photographs.
        """
        frames = self.held_out or self.train
        if frames is None:
            return {}
        renderers = renderers_to_measure(("fast",), given.settings("fast"), "all", lenses)
        found: dict[str, dict[str, float]] = {name: {} for name in renderers}
        for stage, gaussians in stages.items():
            measured: Any = through_renderers(
                gaussians, frames, renderers, self.measured_split, None if self.held_out else TRAIN_VIEWS
            )
            for row in measured["rows"]:
                found[row["name"]][stage] = row["mean"].get("psnr_object", row["mean"]["psnr"])
        return found

    @property
    def measured_split(self) -> str:
        """What is measured: `test`, or `train` where nothing is held out."""
        return "test" if self.held_out else "train"


def _exposures(args: Prune, given: SceneInput, views: _Views) -> list[Component]:
    """The gains by which `--refit` compares photographs, of a run that has found one for each; they stay.

    Raises:
        ValueError: If a photograph is none of the run's.
    """
    if not args.refit or views.train is None or given.run is None or "exposure" not in given.estimated:
        return []
    checkpoint = Checkpoint(*load_state(given.run.state), str(given.run.state))
    known = checkpoint.header["views"]
    if other := next((frame.name for frame in views.train if frame.name not in known), None):
        raise ValueError(
            f"--refit must have photographs whose exposure {args.scene} has found, {other!r} of {views.source} is not "
            "among these; leave --data or --refit out"
        )
    return [ExposureComponent.held(checkpoint, given.background)]


def _skybox(given: SceneInput) -> int:
    """How many of the first Gaussians are a run's skybox."""
    if given.run is None or given.step is None:
        return 0
    return state_header(given.run.state).get("skybox", 0)


def _config_over(given: SceneInput) -> FitConfig:
    """How a file's Gaussians are fitted on: as any fit, over the background that --set says."""
    config = FitConfig()
    return config.replace(settings=config.settings.replace(background=given.background))


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
        "asked": {"keep": args.keep, "loss": args.loss},
        "rounds": [dataclasses.asdict(x) for x in pruned.rounds],
        "train_psnr": pruned.psnr,
        "refit": args.refit,
        "settings": dataclasses.asdict(settings),
        "split": views.measured_split,
        "psnr": costs,
    }


def _print(args: Prune, pruned: Pruned, views: _Views, costs: dict[str, dict[str, float]]) -> None:
    """Print what it cost, what no view shows, and where the Gaussians are."""
    stages: Sequence[str] = list(next(iter(costs.values()), {}))
    if costs:
        kind = "held-out" if views.held_out else "training"
        count = len(views.held_out) or min(len(views.cameras), TRAIN_VIEWS)
        rows = []
        for name, row in costs.items():
            last = row[stages[-1]] - row["before"]
            rows.append((name, *(f"{row[stage]:.2f}" for stage in stages), f"{last:+.2f}"))
        tables.show(f"PSNR in dB of {count} {kind} views", ("renderer", *stages, "change"), rows)
    else:
        print(f"{views.source} has no photographs: what it costs is not measured (--data names a data set)")
    if pruned.unseen:
        what = "were removed" if args.unseen == "remove" else "are kept (--unseen remove removes them)"
        print(f"{pruned.unseen:,} Gaussians are shown by none of the {len(views.cameras)} training views: they {what}")
    size = args.output.stat().st_size / 1e6
    print(f"{len(pruned.gaussians):,} of {len(pruned.kept):,} Gaussians: {args.output} ({size:.2f} MB)")
