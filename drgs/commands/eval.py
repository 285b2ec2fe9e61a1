"""`drgs eval`: how well a run shows views, those that it was not fitted to above all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drgs import data
from drgs.display import tables
from drgs.display.pictures import file_names
from drgs.files import Run
from drgs.fitting.frames import load_frames
from drgs.fitting.records import fit_record, fitted_views, load_run
from drgs.fitting.resume import claim_run
from drgs.fitting.stages import moving_labels
from drgs.metrics import METRICS, MOVING, VIEW_PICTURES, Lpips, evaluate, through_viewers, write_metrics

if TYPE_CHECKING:
    from drgs.commands.options import Eval
    from drgs.deform import DynamicGaussians
    from drgs.fitting.frames import Frame
    from drgs.fitting.records import LoadedRun
    from drgs.fitting.segments import Segmentation

__all__ = ["print_table", "run", "viewers_line"]

_NOISE = 0.1  # dB; two fits differ by that much


def run(args: Eval) -> None:
    """`drgs eval RUN`."""
    run = Run(args.run)
    recorded = fit_record(run)
    recorded.check_data(run.path)
    output = claim_run(run, "eval")
    loaded = load_run(run)
    g, scene = loaded.gaussians, loaded.scene
    config = recorded.config
    lpips = Lpips(args.lpips_weights) if args.lpips_weights else None
    # Of an active run, images may be missing that were never picked.
    dataset = data.load(
        recorded.data,
        test_every=config.test_every,
        test_offset=config.test_offset,
        times=config.times,
        test_cameras=config.test_cameras,
        background=config.settings.background,
        lazy=recorded.is_active,
        points=False,
        strict=args.strict,
        semantics=recorded.semantics is not None or bool(recorded.times),  # labels say what moves
    )
    train, test = dataset.split()
    if recorded.is_active:  # the rest of the training split was never seen
        fitted = fitted_views(run)
        train = [view for view in train if view.name in fitted]
    views = {"test": test, "train": train, "all": train + test}[args.split]
    if not views:
        raise ValueError(f"eval: split {args.split} must hold a view, holds none ({dataset.split_rule()}); use --split")
    frames = load_frames(views, config.max_pixels, config.mask)
    names = file_names([frame.name for frame in frames])
    kinds = VIEW_PICTURES if recorded.semantics else VIEW_PICTURES[:1]
    output.check(f"renders/{args.split}/{name}.{kind}" for name in names for kind in kinds)
    segmentation = _segmentation(loaded, dataset, frames)
    result = evaluate(
        scene,
        frames,
        config.settings,
        lpips=lpips,
        pictures=run.renders / args.split,
        segmentation=segmentation,
        moving=moving_labels(dataset) if recorded.times else frozenset(),
    )
    viewers = through_viewers(scene, frames, config.settings, args.split)
    written = write_metrics(
        run,
        args.split,
        frames,
        result,
        split_rule=dataset.split_rule(),
        gaussians=len(g),
        viewers=viewers,
        **({} if loaded.moving is None else {"motion": _who_moves(loaded.moving)}),
    )
    if not args.quiet:
        print_table(written)


def _segmentation(loaded: LoadedRun, dataset: data.Dataset, frames: list[Frame]) -> Segmentation | str | None:
    """What of the run's labels is measured.

    Raises:
        ValueError: If numbers in the data set's labels mean other classes than they did when the run was fitted.
    """
    record, known = loaded.record.semantics, dataset.semantics
    if record is None:
        return None
    from drgs.fitting.segments import segmentation_of

    now = known.classes if known is not None and (known.class_file or known.embedding_file) else None
    if now is not None and record.classes is not None and now.names != record.classes:
        raise ValueError(
            f"{dataset.path}: must have the classes that the run was fitted with ({', '.join(record.classes[:5])}, "
            f"...), has {', '.join(now.names[:5])}, ...; restore its class names"
        )
    return segmentation_of(loaded.gaussians, loaded.decoder, loaded.classes, record, frames)


def print_table(metrics: dict) -> None:
    """The metrics of `write_metrics` as tables on stdout, reasons of missing ones below, and what viewers show."""
    digits = {"psnr": ".2f", "psnr_moving": ".2f"}
    names = [name for name in (*METRICS, *MOVING) if metrics["mean"].get(name) is not None]
    rows = [*metrics["views"], {"name": "mean", **metrics["mean"]}]
    tables.show(
        f"{metrics['count']} {metrics['split']} views",
        ("view", *names),
        [(row["name"], *(_shown(row[name], digits.get(name, ".4f")) for name in names)) for row in rows],
    )
    if found := metrics.get("segmentation"):
        _print_segmentation(metrics, found)
    for name, reason in metrics["reasons"].items():
        print(f"{name}: none ({reason})")
    if metrics["viewers"]:
        print(viewers_line(metrics["viewers"]))
    if moved := metrics.get("motion"):
        print(_motion_line(moved, metrics["gaussians"]))


def _shown(value: float | None, digits: str) -> str:
    return "-" if value is None else f"{value:{digits}}"


def _who_moves(scene: DynamicGaussians) -> dict:
    moving = int(scene.moving.sum())
    return {"moving": moving, "share": moving / max(len(scene), 1)}


def _motion_line(moved: dict, count: int) -> str:
    """Who moves and, after a fit, what it saves that the others do not."""
    line = f"{moved['moving']:,} of {count:,} Gaussians move ({moved['share']:.1%})"
    if "seconds" not in moved:
        return line
    some, everything = (1000 * moved[key] for key in ("seconds", "seconds_all"))
    return f"{line}: deforming them takes {some:.1f} ms of a step, deforming all would take {everything:.1f} ms"


def _print_segmentation(metrics: dict, found: dict) -> None:
    """How well labels agree with their reference; the teacher's own beside it where that is the data set's."""
    names = {"labels": "the data set's labels", "teacher": "the teacher's labels, not the truth"}
    shown = {
        "pixel_accuracy": "pixel\naccuracy",
        "class_accuracy": "class\naccuracy",
        "miou": "mIoU",
        "miou_top7": "top-7\nmIoU",
    }
    rows = [(name, found[name]) for name in ("run", "teacher") if found[name] is not None]
    if rows:
        tables.show(
            f"Segmentation of {metrics['count']} {metrics['split']} views, reference: {names[found['reference']]} "
            f"({found['folder']})",
            ("", *shown.values()),
            [(name, *(f"{values[key]:.4f}" for key in shown)) for name, values in rows],
        )


def viewers_line(viewers: dict) -> str:
    """What `through_viewers` found, and what to do about it."""
    line = (
        f"In a viewer of PLY files (preset {viewers['preset']}, {viewers['width']}x{viewers['height']}): PSNR "
        f"{viewers['psnr']:.2f} dB instead of {viewers['own_psnr']:.2f} dB, mean of {len(viewers['views'])} "
        f"{viewers['split']} views"
    )
    if viewers["own_psnr"] - viewers["psnr"] <= _NOISE:
        return line
    return f"{line}; to train for viewers, fit with --preset {viewers['preset']}"
