"""drgs: differentiable Gaussian rendering with Dr.Jit and Mitsuba 3, on any CPU; CUDA is written and not yet run.

    import drgs
    g = drgs.load_ply("point_cloud.ply")
    out = drgs.render(g, camera, drgs.RenderSettings.preset("exact"))

Importing this package imports none of its heavy dependencies; names load at first access.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from drgs import libllvm as _libllvm

__version__ = "0.1.0"

# Public name -> module that defines it.
_NAMES = {
    "Camera": "cameras",
    "DeformationField": "deform",
    "DynamicGaussians": "deform",
    "Gaussians": "ellipsoids",
    "RenderSettings": "settings",
    "load_gaussians": "codecs",
    "load_ply": "files",
    "rasterization": "rasterize",
    "render": "integrator",
    "render_jvp": "integrator",
    "save_gaussians": "codecs",
    "save_ply": "files",
}
_MODULES = frozenset(
    {
        "cameras",
        "cli",
        "crossval",
        "data",
        "deform",
        "ellipsoids",
        "files",
        "fisher",
        "gain",
        "integrator",
        "ladder",
        "metrics",
        "reference",
        "runtime",
        "select",
        "settings",
        "testing",
        "train",
    }
)

__all__ = [
    "Camera",
    "DeformationField",
    "DynamicGaussians",
    "Gaussians",
    "RenderSettings",
    "__version__",
    "data",
    "deform",
    "fisher",
    "gain",
    "load_gaussians",
    "load_ply",
    "rasterization",
    "reference",
    "render",
    "render_jvp",
    "runtime",
    "save_gaussians",
    "save_ply",
    "select",
]

if TYPE_CHECKING:
    from drgs import cameras as cameras
    from drgs import cli as cli
    from drgs import crossval as crossval
    from drgs import data, deform, fisher, gain, reference, runtime, select
    from drgs import ellipsoids as ellipsoids
    from drgs import files as files
    from drgs import integrator as integrator
    from drgs import ladder as ladder
    from drgs import metrics as metrics
    from drgs import settings as settings
    from drgs import testing as testing
    from drgs import train as train
    from drgs.cameras import Camera
    from drgs.codecs import load_gaussians, save_gaussians
    from drgs.deform import DeformationField, DynamicGaussians
    from drgs.ellipsoids import Gaussians
    from drgs.files import load_ply, save_ply
    from drgs.integrator import render, render_jvp
    from drgs.rasterize import rasterization
    from drgs.settings import RenderSettings

# Before anything can import drjit: it loads libLLVM at once, and the wrong one aborts the process.
_libllvm.prepare()


def __getattr__(name: str) -> Any:
    """Load public names and submodules at first access (PEP 562)."""
    if name in _NAMES:
        value = getattr(importlib.import_module(f"drgs.{_NAMES[name]}"), name)
    elif name in _MODULES:
        value = importlib.import_module(f"drgs.{name}")
    else:
        raise AttributeError(f"module 'drgs' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_NAMES, *_MODULES})
