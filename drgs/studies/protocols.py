"""The names of studies, and how an active fit of one is run: what is known at the start, and what happens at a pick.

Imports nothing heavy: the options of the command line read it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from drgs.fitting.config import InitPoints

ExperimentName = Literal["static", "dynamic", "prior", "blocks", "captures"]
StudyName = Literal["static", "dynamic", "captures"]
ProtocolName = Literal["paper", "blind", "fisherrf", "nbv-gym"]
StudyScale = Literal["tiny", "small", "paper"]


@dataclasses.dataclass(frozen=True)
class Protocol:
    """What the fit of a cell has beyond its study.

    Attributes:
        description: Description for pages.
        points: `init_points` of the fit's data.
        selection: Fields of `SelectionConfig` that replace those of the study.
        static: Whether it is only for loops that add views of one time.
    """

    description: str
    points: InitPoints
    selection: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    static: bool = False

    @property
    def leaks(self) -> bool:
        """Whether something of views that are never picked is known at the start."""
        return self.points == "all"


PROTOCOLS: Mapping[str, Protocol] = {
    "blind": Protocol("nothing of a view is read before it is picked", "views"),
    "paper": Protocol(
        "initial points of the whole data set, views that are never picked included (`pool_leak`)",
        "all",
    ),
    "fisherrf": Protocol(
        "as `blind`, and after each pick the Gaussians begin again, as in FisherRF's code (there at points of the "
        "whole data set)",
        "views",
        {"restart": "always"},
        static=True,
    ),
    "nbv-gym": Protocol("as `blind`, with 10 initial views", "views", {"initial": 10}, static=True),
}
"""Name -> protocol. The study says how many views are added and how often; at `paper` scale one every 200 steps."""
