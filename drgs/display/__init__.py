"""What people see: progress, tables and pictures."""

from drgs.guards.imports import modules_of

__getattr__ = modules_of(__name__)
