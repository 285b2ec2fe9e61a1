"""`drgs select`: cameras ranked by information gain about a scene, as a table and as JSON."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.commands.options import Select
from drgs.commands.regions import region_of
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import Known, Source, check_lenses, known_views, views_to_compare, with_times
from drgs.data.camera_lists import camera_to_json
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.information.criteria import criterion_named
from drgs.information.scoring import Scoring
from drgs.io.journal import SCHEMA
from drgs.io.outputs import check_file, write_json
from drgs.select import Refine, Selection, policy_named, select
from drgs.selection.policies import check_region

_SHORT = {
    "rotations": "rot.",
    "log_scales": "scales",
    "logit_opacities": "opac.",
    "backdrop": "back.",
}  # a table has 80 columns
_SHOWN = 3  # names that a note repeats: it is one line


def run(args: Select) -> None:
    """`drgs select SCENE --candidates ...`."""
    settings = args.settings()
    refine = _refine(args)
    check_region(args.region, args.policy)
    check_file(args.output, "select", [args.scene, args.train or "", args.candidates])
    policy_named(args.policy)
    criterion_named(args.scoring.criterion, "--criterion")
    given = SceneInput.of(args)
    settings = given.over_background(settings)
    scoring = given.scoring(args.scoring, settings)
    known = known_views(args.train, args, given, given.keeps_lenses(args.undistort), args.info_pixels)
    candidates, source = views_to_compare("--candidates", args.candidates, args, given, known, fresh=True)
    candidates = with_times(candidates, args, given)
    train = with_times(known.cameras, args, given)
    check_lenses("select", settings, [*train, *candidates])
    region = region_of("select", args, given, Source.known(args.train, given), train, settings)
    views = len(known.cameras) + len(candidates)
    with args.cluster() as workers, Bar("information", views, not args.quiet) as bar:
        selection = select(
            given.scene,
            candidates,
            train,
            args.k,
            args.policy,
            scoring=scoring,
            halving=args.halving,
            rng=torch.Generator().manual_seed(args.seed),
            progress=bar.update,
            workers=workers,
            refine=refine,
            region=region,
        )
    report = _report(args, given, scoring, selection, known, candidates, source)
    write_json(args.output, report)
    if not args.quiet:
        print_picks(report, selection, args.output)


def _report(
    args: Select,
    given: SceneInput,
    scoring: Scoring,
    selection: Selection,
    known: Known,
    candidates: list[Camera],
    source: str,
) -> dict[str, Any]:
    """Contents of the JSON file."""
    shown = [{"index": i, "name": camera.name} for i, camera in enumerate(candidates)]
    timely = [{**one, "time": camera.time} for one, camera in zip(shown, candidates, strict=True)]
    cameras = [{"camera": camera_to_json(camera)} for camera in candidates]
    picks = selection.picks_json(shown, cameras)
    for record, pick in zip(picks, selection.picks, strict=True):
        if pick.camera is not None:
            record |= {"camera": camera_to_json(pick.camera), "start": pick.start}
    return {
        "schema": SCHEMA,
        "command": "select",
        "scene": str(args.scene),
        "gaussians": len(given.gaussians),
        "policy": args.policy,
        "criterion": args.scoring.criterion if args.policy == "fisher" else None,
        "method": args.scoring.method,
        "prior": selection.prior_json(scoring, args.policy),
        "region": args.region,
        **selection.blocks_json(),
        **(scoring.nuisances.if_any() if args.policy == "fisher" else {}),
        "seed": args.seed,
        "settings": dataclasses.asdict(scoring.settings),
        "pixels": known.pixels,
        "known": {"source": known.source, "names": [camera.name for camera in known.cameras]},
        "source": source,
        "picks": [{"rank": rank, **pick} for rank, pick in enumerate(picks, 1)],
        "candidates": selection.candidates_json(timely, cameras),
        "left_out": selection.left_out,
        "notes": selection.notes,
        "evaluations": selection.evaluations,
        "seconds": selection.seconds,
    }


def _refine(args: Select) -> Refine | None:
    """How far picks are moved, as the options say.

    Raises:
        ValueError: If a number is out of range, or the box is none.
    """
    if not args.refine:
        if args.refine_box is not None:
            raise ValueError(
                "--refine-box must have --refine COUNT, without which picks stay; add it, e.g. --refine 40"
            )
        return None
    box = None
    if args.refine_box is not None:
        try:
            box = tuple(float(x) for x in args.refine_box.split(","))
        except ValueError:
            raise ValueError(
                f"--refine-box must be six numbers with commas between, got {args.refine_box!r}; correct it"
            ) from None
    return Refine(evaluations=args.refine, box=box)


def print_picks(report: dict, selection: Selection, output: Path) -> None:
    """Print the picks with each group's part of the score, and notes."""
    title = report["policy"] + (f" ({report['criterion']})" if report["policy"] == "fisher" else "")
    compared = selection.combine == "zscore"
    rows = []
    groups = selection.blocks if compared else list(selection.picks[0].parts)
    for pick in selection.picks:
        margin = "-" if pick.margin is None else f"{pick.margin:.3g}"
        if compared:
            parts = [f"{sum(x for name, x in pick.parts.items() if name.startswith(f'{b}.')):.2f}" for b in groups]
        else:
            parts = [f"{100 * pick.parts[name] / pick.score:.1f}" if pick.score else "-" for name in groups]
        rows.append((pick.name, f"{pick.score:.4g}", margin, *parts))
    tables.show(
        f"{title}: {len(selection.picks)} of {len(report['candidates'])} views, {report['source']}",
        ("view", "score", "margin", *(f"{name}: z" if compared else f"{_SHORT.get(name, name)} %" for name in groups)),
        rows,
    )
    for pick in selection.picks:
        if pick.camera is not None and pick.start is not None:
            print(f"{pick.name}: moved, its score is {pick.score:.4g} instead of {pick.start:.4g}")
    empty = [pick.name for pick in selection.picks if not compared and pick.parts.get("backdrop", 0) > pick.score / 2]
    if empty:
        more = f" and {len(empty) - _SHOWN} more" if len(empty) > _SHOWN else ""
        print(
            f"note: most of the score of {', '.join(empty[:_SHOWN])}{more} is of pixels where no Gaussian is "
            "(backdrop): right for a whole scene; where only what is modeled counts, add --blocks geometry"
        )
    for note in selection.notes:
        print(f"note: {note}")
    known = report["known"]
    print(f"{len(known['names'])} known views ({known['source']}); {report['seconds']:.1f} s: {output}")
