"""`drgs query`: Gaussians, and pixels of views, that match a text."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import torch

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.codecs import save_gaussians
from drgs.commands.options import Query
from drgs.commands.scene_input import SceneInput
from drgs.commands.semantic_pictures import OPAQUE
from drgs.commands.viewpoints import check_lenses, views_to_sample
from drgs.data.camera_lists import camera_to_json
from drgs.data.checks import read_npy
from drgs.display import pictures
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians
from drgs.features.decoder import Decoder, load_decoder
from drgs.features.pictures import mask_picture
from drgs.features.query import TEMPERATURE, TextQuery
from drgs.features.teacher import read_tensor
from drgs.fitting.resume import lock_output
from drgs.integrator import render
from drgs.io.journal import SCHEMA
from drgs.io.outputs import write_json
from drgs.settings import RenderSettings


def run(args: Query) -> None:
    """`drgs query SCENE`."""
    settings = args.settings()
    if bool(args.classes) == (args.text_embedding is not None):
        got = "both" if args.classes else "neither"
        raise ValueError(f"one of --class and --text-embedding must be given, got {got}; say what to look for")
    ply = "rest.ply" if args.remove else "selected.ply"
    inputs = [args.scene, args.text_embedding or "", args.decoder or "", args.cameras or ""]
    output = lock_output(args.output, "query", ["query.json", ply], inputs)
    given = SceneInput.of(args)
    settings = given.over_background(settings)
    g = given.gaussians
    decoder = _decoder(args, given)
    query = _query(args, given)
    with Bar("scores", show=not args.quiet):
        score, selected = query.score(g.features, decoder)
    count = int(selected.sum())
    kept = g.take(~selected if args.remove else selected)
    largest = float(score.max()) if len(g) else 0.0
    _check_not_empty(len(g), count, largest, query, args.remove, _advice_of_short_fit(given))
    cameras, source = views_to_sample(args, given, given.keeps_lenses(args.undistort))
    check_lenses("query", settings, cameras)
    pixels = args.max_pixels or (given.record.config.data.max_pixels if given.record else None)
    if pixels is not None:
        cameras = [at_most(camera, pixels) for camera in cameras]
    names = pictures.file_names([camera.name for camera in cameras])
    output.check(f"{name}.{kind}" for name in names for kind in ("mask.png", "png"))
    views = []
    with Bar("query", len(cameras), not args.quiet) as bar:
        for camera, name in zip(cameras, names, strict=True):
            views.append(_view(g, camera, settings, query, decoder, args.output, name))
            bar.advance()
    save_gaussians(kept, args.output / ply)
    report = {
        "schema": SCHEMA,
        "command": "query",
        "scene": str(args.scene),
        "wanted": list(args.classes) or str(args.text_embedding),
        "score": query.score_name,
        "rule": query.rule,
        "threshold": query.threshold,
        "temperature": None if query.negatives is None else query.temperature,
        "gaussians": {"all": len(g), "selected": count, "written": len(kept)},
        "file": ply,
        "source": source,
        "settings": dataclasses.asdict(settings),
        "views": views,
    }
    write_json(args.output / "query.json", report)
    args.say(_summary(args, report))


def read_embeddings(path: Path) -> torch.Tensor:
    """(K, C) float32 text embeddings from a .npy or .pt file of (C,) or (K, C).

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it holds anything else; nothing in it is run.
    """
    vectors: Any = torch.from_numpy(read_npy(path)) if path.suffix.lower() == ".npy" else read_tensor(path)
    if not vectors.is_floating_point() or vectors.ndim not in (1, 2) or 0 in vectors.shape:
        raise ValueError(
            f"{path}: text embeddings must be floats of shape (C,) or (K, C), got {vectors.dtype} of shape "
            f"{tuple(vectors.shape)}; save one row a text"
        )
    return vectors.float().reshape(-1, vectors.shape[-1])


def _decoder(args: Query, given: SceneInput) -> Decoder | None:
    """The decoder of the features, or None where they are the teacher's own; ValueError where there are no features."""
    g, decoder = given.gaussians, given.decoder
    if g.features is None:
        raise ValueError(
            f"{args.scene}: must have semantic features, has none; fit a data set with a teacher's maps (drgs teach)"
        )
    if args.decoder is not None:
        if decoder is not None:
            raise ValueError(f"{args.decoder}: --decoder is for a PLY, {args.scene} has its own; leave it out")
        decoder = load_decoder(args.decoder)
    if decoder is not None and decoder.width != g.features.shape[1]:
        raise ValueError(
            f"{args.decoder or args.scene}: the decoder must take the {g.features.shape[1]} features of a Gaussian, "
            f"takes {decoder.width}; name the one that was fitted with them"
        )
    return decoder


def _query(args: Query, given: SceneInput) -> TextQuery:
    """The query of the command line."""
    temperature = TEMPERATURE if args.temperature is None else args.temperature
    if args.text_embedding is not None:
        vectors = read_embeddings(args.text_embedding)
        return TextQuery.of_vectors(vectors, given.classes, args.threshold, temperature)
    if given.classes is None:
        raise ValueError(f"{args.scene}: has no classes to take --class from; use --text-embedding FILE")
    return TextQuery.of_classes(given.classes, args.classes, args.threshold, temperature)


def _advice_of_short_fit(given: SceneInput) -> str:
    """What to do, if a run has done fewer steps than its features need to tell classes apart; else "".

    They begin at 0 and move by their learning rate a step, Adam's: to about 1 in 1 / rate steps. Measured in
    docs/semantic.md: of the made room at the rate of 1e-3 they have just begun to differ after 242 steps, and tell
    classes apart after 1,000.
    """
    if given.record is None:
        return ""
    done = given.record.config.max_steps if given.step is None else given.step
    rate = given.record.config.features.feature_rate
    if rate <= 0 or done >= (needed := math.ceil(1 / rate)):
        return ""
    return (
        f"features begin at 0 and need about {needed:,} steps at --feature-rate {rate:g} to tell classes apart, this "
        f"run has done {done:,}: fit with --max-steps {needed} or more"
    )


def _check_not_empty(total: int, selected: int, largest: float, query: TextQuery, remove: bool, too_short: str) -> None:
    """Raise ValueError where the PLY would hold no Gaussian; `too_short`: what to do about the fit, if anything."""
    if selected == 0:
        advice = f"{'give a' if query.threshold is None else 'lower'} --threshold or look for something else"
        raise ValueError(
            f"a Gaussian must be selected, none of {total} is ({query.rule}; the largest {query.score_name} is "
            f"{largest:.3g}); {too_short or advice}"
        )
    if remove and selected == total:
        raise ValueError(
            f"a Gaussian must be left, all {total} are selected ({query.rule}); raise --threshold or leave --remove out"
        )


def _view(
    g: Gaussians,
    camera: Camera,
    settings: RenderSettings,
    query: TextQuery,
    decoder: Decoder | None,
    folder: Path,
    name: str,
) -> dict:
    """Mask and picture of a view, and its row of query.json."""
    with torch.no_grad():  # a picture, not optimized
        out = render(g, camera, settings, ())
    _, selected = query.score(out.features, decoder)
    mask = (selected & (out.alpha.cpu() >= OPAQUE)).numpy()
    files = [f"{name}.mask.png", f"{name}.png"]
    pictures.write_png(folder / files[0], mask[..., None].repeat(3, 2).astype("uint8") * 255)
    pictures.write_png(folder / files[1], mask_picture(out.rgb.cpu().numpy(), mask))
    return {"camera": camera_to_json(camera), "files": files, "pixels": int(mask.sum()), "of": mask.size}


def _summary(args: Query, report: dict) -> str:
    counts, views = report["gaussians"], report["views"]
    pixels, total = (sum(view[key] for view in views) for key in ("pixels", "of"))
    wanted = ", ".join(args.classes) if args.classes else args.text_embedding.name
    verb = "removed, the others are in" if args.remove else "in"
    return (
        f"{wanted} ({report['rule']}): {counts['selected']} of {counts['all']} Gaussians, {verb} "
        f"{args.output / report['file']}; {pixels} of {total} pixels ({pixels / max(total, 1):.1%}) of {len(views)} "
        "views"
    )
