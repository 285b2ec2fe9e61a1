"""Ranges that numbers of a fit's configuration lie in, ends included."""

__all__ = ["COUNT", "FADING", "OPACITY", "RATE", "FRACTION", "WEIGHT"]

COUNT = (1, 10**9)
FRACTION = (0.0, 1.0)
RATE = (0.0, 1e6)
FADING = (1e-30, 1e6)  # of rates whose logarithms are interpolated
WEIGHT = (0.0, 1e6)
OPACITY = (1e-6, 1 - 1e-6)  # its logit is finite in float32
