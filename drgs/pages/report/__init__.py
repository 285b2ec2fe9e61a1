"""What a fit looked like, as one self-contained page: what its folder says, charts, pictures, and the page itself."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
