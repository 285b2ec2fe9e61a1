"""`drgs convert`: Gaussians of a file or a run in another format, and in a PLY what is known of each."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.codecs import check_suffix, load_gaussians, origin_file, save_gaussians
from drgs.commands.scene_input import SceneInput
from drgs.display.progress import Bar
from drgs.gain import Prior, check, variances
from drgs.information.groups import GROUPS
from drgs.io.checkpoint import load_state
from drgs.io.outputs import lock_folder

if TYPE_CHECKING:
    from drgs.commands.options import Convert
    from drgs.ellipsoids import Gaussians


def run(args: Convert) -> None:
    """`drgs convert IN OUT`."""
    suffix = check_suffix("convert", args.out)
    wanted = [name for name, is_asked in (("--uncertainty", args.uncertainty), ("--labels", args.labels)) if is_asked]
    if wanted and suffix != ".ply":
        raise ValueError(
            f"{wanted[0]} must have a .ply to write to, {suffix} has no room for columns; convert to a .ply"
        )
    prior = Prior(args.prior)
    names = [args.out.name, origin_file(args.out).name]
    with lock_folder(args.out.parent, "convert", names, [args.scene, args.uncertainty or ""]):
        with Bar("reading", show=not args.quiet):
            given = _given(args)
        g = still(args, given)
        extra: dict[str, np.ndarray] = {}
        comments: tuple[str, ...] = ()
        if args.uncertainty is not None:
            extra |= uncertainty_columns(args.uncertainty, g, prior)
        if args.labels:
            extra["label"], comments = label_column(args.scene, given, g)
        with Bar("writing", show=not args.quiet):
            save_gaussians(g, args.out, extra=extra, comments=comments)
    if not args.quiet:
        columns = f", with {', '.join(extra)}" if extra else ""
        size = args.out.stat().st_size
        print(
            f"{len(g)} Gaussians, SH degree {g.sh_degree}{columns}: {args.out} ({size / max(len(g), 1):.1f} bytes each)"
        )


def _given(args: Convert) -> SceneInput:
    """What is converted."""
    if not args.as_stored:
        return SceneInput.at(args.scene)
    if args.scene.suffix.lower() != ".spz":
        raise ValueError(f"--as-stored must have an .spz, whose axes are others than those of a PLY, got {args.scene}")
    return SceneInput(load_gaussians(args.scene, as_stored=True))


def still(args: Convert, given: SceneInput) -> Gaussians:
    """The Gaussians; of a scene that moves, as they are at --time.

    Raises:
        ValueError: If something moves and there is no time, or the other way round.
    """
    if given.moving is None:
        if args.time is not None:
            raise ValueError("--time must have a scene that moves, this one stands still; drop it")
        return given.gaussians
    if args.time is None:
        raise ValueError(
            f"{args.scene}: moves, so that --time must say when; `drgs render --format ply` writes a PLY for each time"
        )
    return given.moving.at(args.time).detach()  # a file holds values: NumPy takes no tensor with a gradient


def uncertainty_columns(path: Path, g: Gaussians, prior: Prior) -> dict[str, np.ndarray]:
    """What information leaves uncertain of each Gaussian: (N,) float32, a column a group.

    The square root of the sum of 1 / (H + lambda) over a group's numbers: with a prior of lambda, the standard
    deviation of the mean in scene units, of log scales, and so on.

    Args:
        path: File `information.safetensors` that `drgs fisher` wrote.
        g: Gaussians that it is about.
        prior: Prior lambda.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no such file, or about other Gaussians.
    """
    information, header = load_state(path)
    known = {name: information[name] for name in GROUPS if name in information}
    for name, x in known.items():
        if x.ndim == 0 or len(x) != len(g):
            raise ValueError(
                f"{path}: must be about these {len(g)} Gaussians, its group {name} has shape {tuple(x.shape)}; run "
                "`drgs fisher` on the scene that is converted"
            )
    if not known:
        raise ValueError(
            f"{path}: must hold information of Gaussians, holds {', '.join(information)[:80] or 'nothing'}"
        )
    check(str(path), known)
    # An older file does not say in which unit positions counted: it was that of the world.
    found = variances(known, prior.over(header.get("length") or 1.0))
    return {f"uncertainty_{name}": x.reshape(len(g), -1).sum(1).sqrt().float().numpy() for name, x in found.items()}


def label_column(path: Path, given: SceneInput, g: Gaussians) -> tuple[np.ndarray, tuple[str, ...]]:
    """(N,) class 1..K of each Gaussian, that of the largest cosine, and a line of the header for each name.

    Args:
        path: Path that was named, for the message.
        given: The run, with its decoder and its classes.
        g: Gaussians of the run.
    Raises:
        ValueError: If it has no classes with embeddings, or no features.
    """
    from drgs.features.segmentation import classify  # not for those that have none

    classes = given.classes
    if g.features is None or classes is None or classes.embeddings is None:
        raise ValueError(f"{path}: --labels must have a run that was fitted with classes, this has none; drop it")
    labels = classify(g.features, classes, given.decoder).numpy()
    return labels, tuple(f"label {k} {name}" for k, name in enumerate(classes.names, 1))
