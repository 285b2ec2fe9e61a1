"""Work in other processes, on this machine or on many: views that are scored, cells of a study. By Dask."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
