"""Measuring: rasterizers against models, settings against their cost, extremes against float64."""
