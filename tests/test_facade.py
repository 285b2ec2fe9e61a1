"""Claims of `import drgs`: everything is reached from it, at first access, and what docstrings show runs."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import subprocess
import sys
import textwrap
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from doc_pages import make_folder

import drgs
from drgs.cameras import orbit


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """`scene`, a data set, and `point_cloud.ply`, Gaussians."""
    return make_folder(tmp_path_factory.mktemp("facade"))


def test_every_module_is_reached():
    """Each module of the package's own folder is an attribute of it, and each attribute that is promised loads."""
    found = {path.stem for path in Path(drgs.__file__).parent.glob("*.py") if not path.stem.startswith("_")}
    assert found <= {*drgs._MODULES}
    assert all(isinstance(getattr(drgs, name), types.ModuleType) for name in [*drgs._MODULES, "runtime"])


def test_a_plain_import_is_enough():
    """In a fresh process a module, a function and a type are there without another import; others are not loaded."""
    code = (
        "import sys, drgs\n"
        "assert not {'torch', 'numpy', 'drgs.train'} & set(sys.modules)\n"
        "assert callable(drgs.train.fit) and drgs.train.fit is drgs.fit\n"
        "assert drgs.features.segmentation and drgs.data.load is drgs.load_data\n"
        "assert drgs.select.select is drgs.select_views and drgs.lab.crossval.crossval\n"
        "assert drgs.fitting.records.load_run is drgs.load_run\n"
        "assert not {'drgs.viewing', 'drgs.cluster.connect'} & set(sys.modules)\n"
        "assert not hasattr(drgs.features, 'nothing') and not hasattr(drgs.features, '_nothing')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", sorted(name for name, place in drgs._MODULES.items() if name != place))
def test_a_module_is_imported_by_its_public_name(name):
    """`from drgs.metrics import psnr` works wherever the module stands, and gives that module, not a second copy."""
    module = importlib.import_module(f"drgs.{name}")
    assert module is importlib.import_module(f"drgs.{drgs._MODULES[name]}") is getattr(drgs, name)
    assert module.__spec__.name == module.__name__ == f"drgs.{drgs._MODULES[name]}"
    with pytest.raises(ModuleNotFoundError, match=f"drgs.data.{name}'"):
        importlib.import_module(f"drgs.data.{name}")


def test_what_users_import_is_public():
    """The journey from photographs to the next view, and the types that its functions take, are in `__all__`."""
    wanted = (
        "fit load_data load_run select_views rasterization render render_jvp diagonal load_gaussians save_gaussians"
    )
    types_ = "Camera Gaussians DynamicGaussians DeformationField RenderSettings FitConfig SelectionConfig Scoring Prior"
    assert {*wanted.split(), *types_.split(), "Selection", "Dataset", "View"} <= set(drgs.__all__)
    assert set(drgs.__all__) <= set(dir(drgs))
    with pytest.raises(AttributeError, match="module 'drgs' has no attribute 'rendr'"):
        _ = drgs.rendr


def examples(text: str) -> list[str]:
    """Indented blocks of a docstring before its first section."""
    before = re.split(r"^(?:Args|Attributes|Returns|Raises):$", text, maxsplit=1, flags=re.M)[0]
    found = re.findall(r"(?:(?<=\n\n)|^)((?: {4}.*\n?|\n(?= {4}))+)", before, flags=re.M)
    return [textwrap.dedent(block) for block in found]


def test_examples_of_docstrings_run(folder, tmp_path, monkeypatch):
    """What the docstrings of public names show, on a tiny scene; a fit takes few steps, whatever it says."""
    monkeypatch.chdir(folder)
    g = drgs.load_ply("point_cloud.ply")
    cameras = orbit((0, 0, 0), 3.0, 5, width=32, height=24, up=(0, -1, 0))
    known = {
        **{"drgs": drgs, "torch": torch, "dataclasses": dataclasses},
        **{"camera": cameras[0], "cameras": cameras, "width": 32, "height": 24},
        **{"means": g.means, "quats": g.quats, "scales": g.log_scales.exp(), "sh": g.sh},
        **{"opacities": g.logit_opacities.sigmoid(), "rgb": torch.rand(len(g), 3), "photograph": torch.rand(24, 32, 3)},
        "photographs": [torch.rand(24, 32, 3)] * 5,
        "viewmats": torch.from_numpy(np.stack([camera.w2c for camera in cameras])).float(),
        "Ks": torch.from_numpy(np.stack([camera.K for camera in cameras])).float(),
    }
    shown = set()
    drgs.fit(
        drgs.load_data("scene"), "runs/scene", drgs.FitConfig().replace(max_steps=6, max_gaussians=100), progress=False
    )
    names = sorted(name for name in drgs.__all__ if not isinstance(getattr(drgs, name), types.ModuleType))
    for name, owner in [("drgs", drgs), *((name, getattr(drgs, name)) for name in names)]:
        for block in examples(inspect.getdoc(owner) or ""):
            text = re.sub(r"max_steps=\d+", "max_steps=6", block)
            text = text.replace('"runs/scene", drgs', f'"{tmp_path / name}", drgs')  # a folder that holds no run yet
            exec(compile(text, f"docstring of {name}", "exec"), {**known, "g": g.detach()})
            shown.add(name)
    assert shown >= {"drgs", "fit", "load_data", "load_run", "select_views", "rasterization", "render", "render_jvp"}
    assert shown >= {"diagonal", "load_gaussians", "save_gaussians", "load_ply", "save_ply", "Camera", "Gaussians"}
