"""Is a rasterizer's image right, are its gradients, and if not, what explains it? (`drgs.lab.crossval`)"""

from drgs.lab.crossval import VERDICTS, Result, crossval

__all__ = ["VERDICTS", "Result", "crossval"]
