"""What `pip install` puts into site-packages."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from drgs.pages.sharing import npm

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> list[str]:
    """Names of the files in the wheel, built from a copy: setuptools leaves folders beside what it builds."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("drgs", "scenes"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    line = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "-w", out, source]
    subprocess.run(line, check=True, timeout=300)
    (built,) = out.glob("drgs-*.whl")
    return zipfile.ZipFile(built).namelist()


def test_one_package_at_the_top(wheel):
    """`scenes` would be anybody's name: another package's folder of that name must not meet ours."""
    tops = {name.split("/")[0] for name in wheel}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"drgs"}


def test_it_is_whole(wheel):
    """Every module and data file of the repository, the made scenes as `drgs.scenes`."""
    folders = {"drgs": ROOT / "drgs", "drgs/scenes": ROOT / "scenes"}
    wanted = {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for name, folder in folders.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert wanted <= set(wheel)


def test_it_has_the_viewer_of_shared_pages(wheel):
    """The packages of npm that a page is drawn by, each with its license."""
    try:
        npm.viewer_files()
    except OSError as error:
        pytest.skip(str(error))
    wanted = {f"drgs/pages/sharing/npm/{package.folder}/{name}" for package in npm.PACKAGES for name in package.files}
    assert wanted <= set(wheel)
    assert sum(name.endswith("/LICENSE") for name in wanted) == len(npm.PACKAGES) == 2
