"""pycolmap, imported in one place: at import it puts its own handler on SIGTERM, which prints a C++ stack."""

import pycolmap

from drgs.guards import interrupts

__all__ = ["pycolmap"]

interrupts.reinstall()
