"""The float64 oracle, for users: every ray against every Gaussian, and the true volume (`drgs.oracle`)."""

from drgs.oracle import sh_basis
from drgs.oracle.reference import ReferenceOutput, render
from drgs.oracle.volume import render_volume

__all__ = ["ReferenceOutput", "render", "render_volume", "sh_basis"]
