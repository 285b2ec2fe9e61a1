"""Build step of setuptools: the viewer's code from npm goes into the wheel, with its licenses, so that `drgs share`
needs no network.

The code (5 MB of three.js and Spark, pinned by version and hash in npm.py) is not in the repository, so a wheel is the
one place where it is fetched before a user's machine. `build_py` is setuptools' public hook for files that are made at
build time; without a network the wheel goes without them, and says so. Nothing of drgs can be imported here: its
dependencies are not installed while a wheel is built, so npm.py is loaded by its path.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType

from setuptools.command.build_py import build_py


class BuildWithViewer(build_py):
    """`build_py`, and the packages of `drgs.pages.sharing.npm` beside the modules."""

    def run(self) -> None:
        """Fetch the viewer's code; without a network warn, and leave it to `drgs share`."""
        super().run()
        if self.editable_mode:
            return
        try:
            viewer = _npm().viewer_files()
        except OSError as error:
            self.warn(f"the wheel goes without the viewer of `drgs share`: {error}")
            return
        for package in _npm().PACKAGES:
            for name in package.files:
                target = Path(self.build_lib) / "drgs" / "pages" / "sharing" / "npm" / package.folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(viewer / package.folder / name, target)


def _npm() -> ModuleType:
    """Load npm.py by its path, without importing drgs."""
    name = "_drgs_sharing_npm"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("npm.py"))
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]
