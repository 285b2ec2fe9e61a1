"""Behind drgs.fisher, drgs.gain and drgs.select: rows of the Jacobian, their squares, greedy selection."""

from drgs.guards.imports import modules_of

__getattr__ = modules_of(__name__)
