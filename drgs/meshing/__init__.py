"""A surface of triangles from Gaussians: their depth in many views, fused, cut to what is known, and written."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
