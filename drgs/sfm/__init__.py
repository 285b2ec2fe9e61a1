"""Structure from motion by COLMAP, and points of photographs whose poses are known.

It reads photographs by `drgs.data`, which knows nothing of it.
"""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
