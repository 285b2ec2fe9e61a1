"""What studies can be asked for; imports nothing heavy, for the options of the command line read it."""

from __future__ import annotations

from typing import Literal

__all__ = ["ExperimentName", "ProtocolName", "StudyName", "StudyScale"]

ExperimentName = Literal["static", "dynamic", "prior", "blocks", "captures"]
StudyName = Literal["static", "dynamic", "captures"]
ProtocolName = Literal["paper", "blind", "fisherrf", "nbv-gym"]
StudyScale = Literal["tiny", "small", "paper"]
