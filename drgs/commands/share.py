"""`drgs share`: a scene as one HTML file that opens from disk."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.origins import origin_text
from drgs.commands.options import Share
from drgs.commands.orbits import scene_orbit
from drgs.commands.report import dataset_of, is_same_place, written_by
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import known_views
from drgs.ellipsoids import Gaussians
from drgs.fitting.records import is_run, load_run
from drgs.fitting.resume import lock_run
from drgs.io.foreign import refuse_foreign
from drgs.io.outputs import check_file
from drgs.io.run import Run
from drgs.pages.sharing.page import SHARED_BY
from drgs.pages.sharing.scene import FILE, scene_of_file, scene_of_run
from drgs.pages.sharing.write import Shared, write_page
from drgs.viewing.placed_views import read_ranking

_DEFAULT_SIZE = 960, 640  # pixels of the first view of a scene without photographs: about the shape of a screen; chosen


def run(args: Share) -> None:
    """`drgs share SCENE`."""
    if args.scene.name in ("", ".."):
        args = dataclasses.replace(args, scene=args.scene.resolve())  # `.` has no name, which file and title take
    path = _output(args)
    is_inside = is_run(args.scene) and path == args.scene / FILE
    with lock_run(Run(args.scene), "share") if is_inside else contextlib.nullcontext() as held:
        if held is not None:
            held.check([FILE])
        shared = shared_of(args)
        sizes = write_page(shared, path)
    if not args.quiet:
        shown = ", ".join(f"{name} {size / 1e6:.2f} MB" for name, size in sizes.items())
        print(f"{len(shared.gaussians)} Gaussians: {path} ({path.stat().st_size / 1e6:.2f} MB: {shown})")
        if np.any(shared.gaussians.origin):
            print(f"positions are relative to the offset {origin_text(shared.gaussians.origin)}, which the page states")


def _output(args: Share) -> Path:
    """The file to write, which outside of a run is free or a page that this command wrote."""
    path = args.output
    if is_run(args.scene) and (path is None or is_same_place(path, args.scene / FILE)):
        return args.scene / FILE
    path = path or args.scene.with_suffix(".html")
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: must be named *.html, which is what is written; choose another (-o)")
    inputs = [args.scene / "config.json" if args.scene.is_dir() else args.scene, args.selection or ""]
    check_file(path, "share", inputs, written_by(SHARED_BY))
    return path


def shared_of(args: Share) -> Shared:
    """Contents of the page of a command line.

    Raises:
        FileNotFoundError, ValueError: If a file that was named is not there or damaged.
    """
    ranking = None
    if args.selection is not None:
        refuse_foreign(args.selection, "a selection")
        ranking = read_ranking(args.selection)
    if not is_run(args.scene):
        given = SceneInput.at(args.scene).in_frame_of(args)
        if not len(given.gaussians):
            raise ValueError(
                f"{args.scene}: there must be at least one Gaussian, got none; fit longer, or name another"
            )
        known = None if args.train is None else known_views(args.train, args, given)
        return scene_of_file(
            given.gaussians,
            args.scene.stem,
            _overview_camera,
            ranking,
            given.background,
            photographs=known.cameras if known else (),
            views=known.views if known else (),
            uncertainty=args.uncertainty,
        )
    if args.train is not None:
        raise ValueError("--train must be left out of a run, which knows its photographs; drop it")
    run = Run(args.scene)
    loaded = load_run(run)
    return scene_of_run(
        run,
        dataset_of(loaded.record, "the page goes without the photographs' cameras"),
        loaded=loaded,
        ranking=ranking,
        around=_overview_camera,
        moments=args.moments,
        uncertainty=args.uncertainty,
    )


def _overview_camera(gaussians: Gaussians) -> Camera:
    """A camera that sees all Gaussians."""
    width, height = _DEFAULT_SIZE
    return scene_orbit(gaussians, 1, width=width, height=height)[0]
