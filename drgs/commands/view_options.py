"""The options of `drgs view`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional

from drgs.commands.option_groups import Around, Informed, Views
from drgs.commands.orbit_keys import ORBIT_KEYS
from drgs.commands.record_options import BLOCKS_TEXT
from drgs.information.choices import Block

__all__ = ["View"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Informed, Around, Views):
    """Look at a run or a Gaussian PLY in the browser, while it is fitted, too."""

    scene: Positional[Path]
    """A run folder, a 3DGS point_cloud.ply, or Gaussians in another format (docs/files.md)."""
    train: str | None = None
    """Known views, whose cameras are shown: a data set, a run, a cameras.json or selection.json; default the run's."""
    selection: Path | None = None
    """Scores of cameras, as drgs select writes them; default those of the run, if it chose its views."""
    blocks: Annotated[tuple[Block, ...] | None, BLOCKS_TEXT] = ("geometry", "backdrop")
    """What of an image tells, for the map of information: geometry, semantic, deformation, backdrop."""
    max_pixels: int = 500_000
    """Our pictures have at most this many pixels, whatever the window."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0: all of this machine's, for browsers of others, which then need a token."""
    port: int = 8080
    """Port to listen at; 0: any that is free."""
    token: str | None = None
    """What a browser must know; default nothing on this machine, else one that is made up and printed."""
    open: bool = False
    """Open the page in a browser, too."""
    orbit_keys: ClassVar[tuple[str, ...]] = tuple(key for key in ORBIT_KEYS if key != "fov")  # the browser has its own
