"""Output for people: progress, tables and pictures."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
