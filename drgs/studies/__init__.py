"""Studies: many fits as cells that are kept and resumed, their statistics, and what a page says of them."""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
