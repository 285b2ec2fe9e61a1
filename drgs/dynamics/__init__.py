"""What a scene that moves is computed with: planes of a field, and what keeps them smooth."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
