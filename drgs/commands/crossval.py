"""`drgs crossval`: a rasterizer against the model that it claims to compute, as tables, JSON and an HTML report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drgs import runtime
from drgs.cameras.origins import origin_text
from drgs.cameras.sizes import at_most
from drgs.commands.options import Crossval
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import views_to_sample
from drgs.display import tables
from drgs.display.progress import Bar
from drgs.fitting.resume import lock_output
from drgs.io.journal import SCHEMA
from drgs.io.outputs import check_file, write_json, write_whole
from drgs.lab import ladder, rasterizers
from drgs.lab.crossval import Result, crossval
from drgs.lab.paths import PathRow
from drgs.lab.report import html


def run(args: Crossval) -> int:
    """`drgs crossval SCENE`: 1 if a gradient or a path is wrong, with --strict if anything differs."""
    inputs = [args.scene, args.cameras or "", args.rasterizer]
    if args.export is None:
        lock_output(args.output, "crossval", ["report.html", "crossval.json"], inputs)
    elif args.export.suffix != ".npz":
        raise ValueError(f"--export {args.export}: must end with .npz, got {args.export.suffix or 'no suffix'}")
    else:
        check_file(args.export, "crossval", inputs, rasterizers.is_export)
    given = SceneInput.of(args)
    g, fields = given.colors, given.fields
    along_rays = rasterizers.is_along_rays(args.preset, args.rasterizer)
    # A model of the image plane has no lens, and what is written for another machine is pinholes.
    seen, source = views_to_sample(args, given, lenses=True)
    keep_lenses = along_rays and args.export is None
    cameras = [at_most(camera if keep_lenses else camera.undistorted(), args.max_pixels) for camera in seen]
    if args.export is not None:
        rasterizers.export(args.export, g, cameras, given.background, args.seed)
        if not args.quiet:
            print(f"{len(g)} Gaussians, {len(cameras)} views of {cameras[0].width}x{cameras[0].height}: {args.export}")
            if np.any(g.origin):
                print(f"positions are relative to the offset {origin_text(g.origin)}, which the file states")
        return 0
    rasterizer = rasterizers.load_rasterizer(args.rasterizer, g, cameras, fields, along_rays)
    with Bar("crossval", show=not args.quiet) as bar:

        def advance(stage: str) -> None:
            bar.update(0, label=f"crossval, {stage}")

        lenses = [at_most(camera, args.max_pixels) for camera in seen if camera.is_distorted]
        result = crossval(
            rasterizer,
            g,
            cameras,
            args.preset,
            fields,
            seed=args.seed,
            lenses=lenses if args.preset == "auto" else None,
            advance=advance,
        )
        report = {"schema": SCHEMA, "command": "crossval", "scene": str(args.scene), "source": source} | result.report
        table = ""
        if args.ladder:
            advance("ladder")
            report["ladder"] = ladder.ladder(result.gaussians, result.cameras, result.model.settings, seed=args.seed)
            table = ladder.table(report["ladder"])
    report["env"] = runtime.info()
    write_whole(args.output / "report.html", html(report, result.images, table).encode())
    write_json(args.output / "crossval.json", report)
    if not args.quiet:
        _print(result, args)
    wrong = result.verdict == "gradient bug" or any(row.status == "wrong" for row in result.paths)
    bad = wrong or (args.strict and result.verdict != "agreement")
    return int(bad)


def _print(result: Result, args: Crossval) -> None:
    """What was found, on stdout."""
    report = result.report
    rows = []
    for name, row in result.groups.items():
        numbers = f"{row.relative:.1e}", f"{row.cosine:.6f}", f"{row.bias:+.1e}"
        rows.append((name, row.verdict, *numbers, row.why))
    title = f"{report['rasterizer']} against preset {report['preset']} ({report['reference']})"
    tables.show(title, ("group", "verdict", "relative", "cosine", "bias", "why"), rows, texts=("verdict", "why"))
    for line in report["scope"]:
        print(line)
    for line in result.lines():
        if line.startswith(("convention:", "view ")):
            print(line)
    rms = max(view.rms for view in result.views)
    share = max(view.share for view in result.views)
    print(f"image at these conventions: RMS {rms:.1e}, {share:.2%} of the pixels off by more than 0.001")
    columns = ("path", "status", "why, and what would test it")
    tables.show("paths of the rasterizer", columns, _path_rows(result.paths), texts=columns[1:])
    left = result.not_tested()
    print(f"{report['verdict']}{f' ({left})' if left else ''}: {args.output / 'report.html'}, crossval.json")


def _path_rows(paths: Sequence[PathRow]) -> list[tuple[str, str, str]]:
    """The rows of the table of paths: what several have in common is said once, with how many they are."""
    texts = ["; ".join(x for x in (path.why, path.how) if x) for path in paths]
    rows, said = list[tuple[str, str, str]](), dict[str, str]()
    for path, text in zip(paths, texts, strict=True):
        shown = f"as {said[text]}" if text in said else text
        if text and text not in said and (count := texts.count(text)) > 1:
            said[text] = path.path
            shown += f" ({count} paths)"
        rows.append((path.path, path.status, shown))
    return rows
