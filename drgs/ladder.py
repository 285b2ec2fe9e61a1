"""What each approximation of a rasterizer explains of its difference to exact ray tracing (`drgs.lab.ladder`)."""

from drgs.lab.ladder import RUNGS, Pictures, ladder, sequences, table

__all__ = ["RUNGS", "Pictures", "ladder", "sequences", "table"]
