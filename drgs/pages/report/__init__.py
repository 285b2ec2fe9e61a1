"""The report of a fit as one self-contained page: contents of its run folder, charts and pictures."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
