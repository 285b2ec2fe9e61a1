"""Where a splat of nerfstudio is wrong, and which photograph to add to it, from what `ns-export` wrote.

    ns-export gaussian-splat --load-config RUN/config.yml --output-dir export
    cp RUN/dataparser_transforms.json export
    python examples/nerfstudio_export.py export/splat.ply DATA

DATA is what the run was trained on. nerfstudio turns, moves and scales its cameras; the file beside the splat says how.
`drgs fisher`, `select` and `view` take the same two paths (docs/tutorials/trained-splat.md).
"""

from __future__ import annotations

import sys
from pathlib import Path

import drgs
from drgs.commands.frames import in_frame_of_data
from drgs.fitting.frames import load_frames

PIXELS = 20_000  # of a photograph, at most


def main(export: Path, data: Path) -> tuple[list[float], list[float], str]:
    """Ask a splat about the views that are held out, every eighth.

    Returns:
        Of each the true and the expected root mean squared error, and the name of the one to add.
    """
    g = in_frame_of_data(drgs.load_gaussians(export), export, data)
    train, others = (load_frames(views, PIXELS) for views in drgs.load_data(data).split())
    settings = drgs.RenderSettings.preset("gsplat")  # what splatfacto is trained with
    record = drgs.error_record(g, [x.camera for x in train], [x.image() for x in train], settings)

    true, expected = [], []
    for x in others:
        shown = drgs.render(g, x.camera, settings).rgb.clamp(0, 1)
        true.append(float((shown - x.image()).square().mean().sqrt()))
        expected.append(float(drgs.expected_error(g, x.camera, record).mean().sqrt()))
        print(f"{x.name}: expected error {expected[-1]:.3f}, true error {true[-1]:.3f}")
    cameras = [[x.camera for x in frames] for frames in (others, train)]
    pick = drgs.select_views(g, *cameras, k=1, scoring=drgs.Scoring(settings=settings)).picks[0]
    print(f"photograph {others[pick.index].name} next")
    return true, expected, others[pick.index].name


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
