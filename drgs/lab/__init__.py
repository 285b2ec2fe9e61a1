"""Measuring: rasterizers against models, settings against their cost, extremes against float64."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
