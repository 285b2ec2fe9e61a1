"""What `pip install` puts into site-packages, and that it works there without extras."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from drgs.runtime.libllvm import require_llvm

ROOT = Path(__file__).resolve().parent.parent
LARGEST = 100_000  # bytes of a file: twice the largest, a module


def built(hook: str, source: Path, out: Path) -> Path:
    """What a hook of the build backend (PEP 517) makes of a source tree."""
    script = f"from setuptools import build_meta; print('built', build_meta.build_{hook}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=source, check=True, capture_output=True, timeout=300)
    return out / done.stdout.decode().split("built ")[-1].strip()


@pytest.fixture(scope="module")
def distributions(tmp_path_factory) -> tuple[Path, Path]:
    """The wheel and the sdist, built from a copy: setuptools leaves folders beside what it builds."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("out")
    rules = [line.split() for line in (ROOT / "MANIFEST.in").read_text().splitlines()]
    folders = [name for rule in rules if rule and rule[0] == "graft" for name in rule[1:]]
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("drgs", *folders):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignored)
    for path in ROOT.iterdir():
        if path.is_file() and path.name != ".git":
            shutil.copy(path, source / path.name)
    return built("wheel", source, out), built("sdist", source, out)


@pytest.fixture(scope="module")
def wheel(distributions) -> dict[str, zipfile.ZipInfo]:
    """Name -> file of the wheel."""
    return {info.filename: info for info in zipfile.ZipFile(distributions[0]).infolist()}


def test_one_package_at_the_top(wheel):
    """`scenes` would be anybody's name: another package's folder of that name must not meet ours."""
    tops = {name.split("/")[0] for name in wheel}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"drgs"}


def test_it_is_whole(wheel):
    """Every module and data file of the repository, the made scenes as `drgs.scenes`; and nothing else."""
    folders = {"drgs": ROOT / "drgs", "drgs/scenes": ROOT / "scenes"}
    wanted = {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for name, folder in folders.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert wanted == {name for name in wheel if name.startswith("drgs/")}


def test_it_is_small(wheel):
    """No pictures, fonts, tables of studies or code of others, which one command would need: modules and pages."""
    assert max(wheel.values(), key=lambda info: info.file_size).file_size < LARGEST
    kinds = {Path(name).suffix for name in wheel if name.startswith("drgs/")}
    assert kinds == {".py", ".html", ".js", ".bib", ".typed"}


@pytest.mark.slow
def test_the_sdist_builds_the_same_wheel(distributions, tmp_path):
    """File by file; only the list of files has no set order."""
    wheel, sdist = distributions
    shutil.unpack_archive(sdist, tmp_path, filter="data")
    again = built("wheel", tmp_path / sdist.name.removesuffix(".tar.gz"), tmp_path)
    first, second = (zipfile.ZipFile(path) for path in (wheel, again))
    assert sorted(first.namelist()) == sorted(second.namelist())
    for name in first.namelist():
        assert first.read(name) == second.read(name), name


# ------------------------------------------------------------------------------------------- installed without extras


@pytest.fixture(scope="module")
def bare(distributions, tmp_path_factory) -> Path:
    """An environment with the wheel and what it requires without extras, linked from the one that runs the tests."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True, timeout=300)
    (site,) = folder.glob("lib/python*/site-packages")
    with zipfile.ZipFile(distributions[0]) as archive:
        archive.extractall(site)
    wanted, linked = required(importlib.metadata.distribution("drgs").requires or ()), set()
    while wanted - linked:
        name = (wanted - linked).pop()
        linked.add(name)
        found = importlib.metadata.distribution(name)
        wanted |= required(found.requires or ())
        for top in {file.parts[0] for file in found.files or ()} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(found.locate_file(top))
    return folder / "bin" / "python"


def required(lines) -> set[str]:
    """Names of requirements that are installed here, of those without an extra."""
    names = {re.match(r"[\w.-]+", line)[0] for line in lines if "extra ==" not in line}
    return {name for name in names if any(importlib.metadata.distributions(name=name))}


def drgs(python: Path, folder: Path, line: str, code: int = 0) -> str:
    """What a command of the bare environment prints to stderr, run in a folder."""
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environ |= {"DRJIT_LIBLLVM_PATH": require_llvm().path, "PYTHONNOUSERSITE": "1"}
    command = [python, "-m", "drgs", *line.split(), "--quiet"]
    done = subprocess.run(command, cwd=folder, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stderr
    return done.stderr


@pytest.mark.slow
def test_without_extras_it_makes_fits_and_renders(bare, tmp_path):
    """A still life of 8 photographs; then each command that needs an extra says so in one line, and leaves nothing."""
    drgs(bare, tmp_path, "scene still_life -o still --size 32x24 --views 8 --spp 1")
    drgs(bare, tmp_path, "fit still -o run --max-steps 20 --max-gaussians 200 --max-pixels 700")
    drgs(bare, tmp_path, "render run --frames 2 --width 32 -o film")
    assert len([*(tmp_path / "film").glob("*.png")]) == 2
    (tmp_path / "weights.pth").touch()
    (tmp_path / "photos").mkdir()
    for index in range(3):
        (tmp_path / f"photos/{index}.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    left = sorted(tmp_path.rglob("*"))
    for line, extra in (
        ("view run", "view"),
        ("mesh run -o mesh.glb", "mesh"),
        ("teach still --model photos", "teacher"),
        ("eval run --lpips-weights weights.pth", "lpips"),
        ("render run --frames 2 --format mp4 -o flight", "video"),
        ("select run --candidates dome --count 3 -k 1 --workers 2 -o picks.json", "cluster"),
        ("sfm photos -o poses", "heic"),
    ):
        told = drgs(bare, tmp_path, line, code=2)
        assert told.count("\n") == 1, line
        assert f"pip install 'drgs[{extra}]'" in told, line
        assert sorted(tmp_path.rglob("*")) == left, line
    assert "pip install 'drgs[report]'" in drgs(bare, tmp_path, "report run -o page.html")
