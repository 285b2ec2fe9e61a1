"""Behind drgs.train: photographs, losses, steps, density control, views chosen on the way."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
