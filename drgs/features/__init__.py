"""Semantics of Gaussians: teacher maps, the decoder, classes and labels, their pictures, and queries."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
