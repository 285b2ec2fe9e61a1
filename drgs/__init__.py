"""drgs: differentiable Gaussian rendering with Dr.Jit and Mitsuba 3, on any CPU and on NVIDIA cards.

CUDA was run for half an hour, on H200 cards: docs/cuda.md.

    import drgs

    dataset = drgs.load_data("scene")
    drgs.fit(dataset, "runs/scene", drgs.FitConfig(max_steps=500))
    scene = drgs.load_run("runs/scene").scene
    train, others = dataset.split()
    image = drgs.render(scene, others[0].camera.undistorted()).rgb

    known = [view.camera.undistorted() for view in train]
    candidates = [view.camera.undistorted() for view in others]
    print(drgs.select_views(scene, candidates, known, k=1).picks[0].name)

    drgs.save_gaussians(scene, "scene.spz")

Importing this package imports none of its heavy dependencies; names and modules load at first access.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from drgs import runtime

__version__ = "0.2.0"

# Public name -> module that defines it, and after a colon its name there, where that is another one.
_NAMES = {
    "Camera": "cameras",
    "Dataset": "data",
    "DeformationField": "deform",
    "DynamicGaussians": "deform",
    "ErrorRecord": "information.expected_error",
    "FitConfig": "train",
    "Gaussians": "ellipsoids",
    "Planner": "planner",
    "Prior": "gain",
    "Region": "information.region",
    "RenderSettings": "settings",
    "Scoring": "select",
    "Selection": "select",
    "SelectionConfig": "train",
    "View": "data",
    "diagonal": "fisher",
    "error_record": "information.expected_error",
    "expected_error": "information.expected_error",
    "fit": "train",
    "load_data": "data:load",
    "load_gaussians": "codecs",
    "load_ply": "files",
    "load_run": "fitting.records",
    "prune": "pruning",
    "rasterization": "rasterize",
    "render": "integrator",
    "render_jvp": "integrator",
    "save_gaussians": "codecs",
    "save_ply": "files",
    "select_views": "select:select",
}
# Module that is reached as `drgs.NAME` -> where it is.
_MODULES = {
    "cameras": "cameras",
    "cli": "cli",
    "cluster": "cluster",
    "codecs": "codecs",
    "crossval": "lab.crossval",
    "data": "data",
    "deform": "deform",
    "display": "display",
    "dynamics": "dynamics",
    "ellipsoids": "ellipsoids",
    "evaluation": "fitting.evaluation",
    "features": "features",
    "files": "files",
    "fisher": "fisher",
    "fitting": "fitting",
    "gain": "gain",
    "information": "information",
    "integrator": "integrator",
    "lab": "lab",
    "ladder": "lab.ladder",
    "meshing": "meshing",
    "metrics": "fitting.metrics",
    "oracle": "oracle",
    "planner": "planner",
    "plugin": "plugin",
    "pruning": "pruning",
    "rasterize": "rasterize",
    "reference": "reference",
    "report": "pages.report",
    "select": "select",
    "selection": "selection",
    "settings": "settings",
    "sfm": "sfm",
    "sharing": "pages.sharing",
    "shutters": "cameras.shutters",
    "sizes": "cameras.sizes",
    "splats": "splats",
    "studies": "studies",
    "testing": "testing",
    "tracing": "tracing",
    "train": "train",
    "viewing": "viewing",
    "volume": "oracle.volume",
}

__all__ = [
    "Camera",
    "Dataset",
    "DeformationField",
    "DynamicGaussians",
    "ErrorRecord",
    "FitConfig",
    "Gaussians",
    "Planner",
    "Prior",
    "Region",
    "RenderSettings",
    "Scoring",
    "Selection",
    "SelectionConfig",
    "View",
    "__version__",
    "data",
    "deform",
    "diagonal",
    "error_record",
    "expected_error",
    "fisher",
    "fit",
    "gain",
    "load_data",
    "load_gaussians",
    "load_ply",
    "load_run",
    "prune",
    "rasterization",
    "reference",
    "render",
    "render_jvp",
    "runtime",
    "save_gaussians",
    "save_ply",
    "select",
    "select_views",
]

if TYPE_CHECKING:
    from drgs import cameras as cameras
    from drgs import cli as cli
    from drgs import cluster as cluster
    from drgs import codecs as codecs
    from drgs import data, deform, fisher, gain, reference, select
    from drgs import display as display
    from drgs import dynamics as dynamics
    from drgs import ellipsoids as ellipsoids
    from drgs import features as features
    from drgs import files as files
    from drgs import fitting as fitting
    from drgs import information as information
    from drgs import integrator as integrator
    from drgs import lab as lab
    from drgs import meshing as meshing
    from drgs import oracle as oracle
    from drgs import planner as planner
    from drgs import plugin as plugin
    from drgs import pruning as pruning
    from drgs import rasterize as rasterize
    from drgs import selection as selection
    from drgs import settings as settings
    from drgs import sfm as sfm
    from drgs import splats as splats
    from drgs import studies as studies
    from drgs import testing as testing
    from drgs import tracing as tracing
    from drgs import train as train
    from drgs import viewing as viewing
    from drgs.cameras import Camera
    from drgs.cameras import shutters as shutters
    from drgs.cameras import sizes as sizes
    from drgs.codecs import load_gaussians, save_gaussians
    from drgs.data import Dataset, View
    from drgs.data import load as load_data
    from drgs.deform import DeformationField, DynamicGaussians
    from drgs.ellipsoids import Gaussians
    from drgs.files import load_ply, save_ply
    from drgs.fisher import diagonal
    from drgs.fitting import evaluation as evaluation
    from drgs.fitting import metrics as metrics
    from drgs.fitting.records import load_run
    from drgs.gain import Prior
    from drgs.information.expected_error import ErrorRecord, error_record, expected_error
    from drgs.information.region import Region
    from drgs.integrator import render, render_jvp
    from drgs.lab import crossval as crossval
    from drgs.lab import ladder as ladder
    from drgs.oracle import volume as volume
    from drgs.pages import report as report
    from drgs.pages import sharing as sharing
    from drgs.planner import Planner
    from drgs.pruning import prune
    from drgs.rasterize import rasterization
    from drgs.select import Scoring, Selection
    from drgs.select import select as select_views
    from drgs.settings import RenderSettings
    from drgs.train import FitConfig, SelectionConfig, fit


class _ByPublicName(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports a module by its name in `_MODULES`, as in `from drgs.metrics import psnr`: the same module, no copy."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        public = name.removeprefix("drgs.")
        is_elsewhere = public != name and _MODULES.get(public, public) != public
        return importlib.util.spec_from_loader(name, self) if is_elsewhere else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(f"drgs.{_MODULES[spec.name.removeprefix('drgs.')]}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None  # importlib has just put that of the public name there
        module.__spec__ = module.__spec__.loader_state


# Last: modules that are where their names say never come here.
sys.meta_path.append(_ByPublicName())

# Before anything can import drjit: it loads libLLVM at once, and the wrong one aborts the process.
runtime.prepare()


def __getattr__(name: str) -> Any:
    """Load public names and submodules at first access (PEP 562)."""
    if name in _NAMES:
        module, _, attribute = _NAMES[name].partition(":")
        value = getattr(importlib.import_module(f"drgs.{module}"), attribute or name)
    elif name in _MODULES:
        value = importlib.import_module(f"drgs.{_MODULES[name]}")
    else:
        raise AttributeError(f"module 'drgs' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_NAMES, *_MODULES})
