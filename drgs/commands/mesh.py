"""`drgs mesh`: a surface of triangles from a finished run or a file of Gaussians."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.origins import origin_text
from drgs.commands.convert import still
from drgs.commands.options import Mesh
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import check_lenses, evenly, known_views, one_a_place
from drgs.display.progress import Bar
from drgs.io.outputs import lock_folder
from drgs.meshing.extraction import mesh_of
from drgs.meshing.writing import MESH_SUFFIXES, save_mesh


def run(args: Mesh) -> None:
    """`drgs mesh SCENE -o FILE`."""
    settings = args.settings()
    suffix = args.output.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ValueError(
            f"{args.output}: -o must be a {', '.join(MESH_SUFFIXES)}, got {suffix or 'no suffix'}; rename it"
        )
    if importlib.util.find_spec("skimage") is None:
        raise ValueError("marching cubes need the package scikit-image, which is missing; pip install 'drgs[mesh]'")
    with lock_folder(args.output.parent, "mesh", [args.output.name], [args.scene, args.cameras or ""]):
        with Bar("reading", show=not args.quiet):
            given = SceneInput.of(args)
            gaussians = still(args, given).take(slice(given.far, None))
        if args.cameras is None and given.run is None:
            raise ValueError(
                "a file of Gaussians does not say its views: --cameras must name a data set, a run or a cameras.json"
            )
        lenses = given.keeps_lenses(args.undistort)
        known = known_views(args.cameras if given.run is None else None, args, given, lenses, args.info_pixels)
        seen = known if args.cameras is None else known_views(args.cameras, args, given, lenses, args.info_pixels)
        cameras = evenly(_places(seen.cameras), args.limit or len(seen.cameras))
        check_lenses("mesh", settings, cameras)
        with Bar("information" if args.meshing.crop else "depth", show=not args.quiet) as bar:
            mesh = mesh_of(
                gaussians,
                cameras,
                given.over_background(settings),
                args.meshing,
                known=_places(known.cameras),
                advance=lambda label, done, total: bar.update(done, total, label),
            )
        with Bar("writing", show=not args.quiet):
            save_mesh(mesh, args.output)
    if not args.quiet:
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        size = " x ".join(f"{x:.3g}" for x in np.asarray(high - low))
        print(
            f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, {size}, of {len(cameras)} views "
            f"({seen.source}), {args.meshing.depth} depth, voxels of {mesh.voxel:.3g}: {args.output}"
        )
        if mesh.origin.any():
            print(f"positions are relative to the offset {origin_text(mesh.origin)}, which the file states")


def _places(cameras: list[Camera]) -> list[Camera]:
    """Cameras without the times of their photographs, each place once: frames of a video have one."""
    return [dataclasses.replace(camera, time=None) for camera in one_a_place(cameras)]
