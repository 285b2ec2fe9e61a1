"""Claims of docs/extending.md: the package that the page makes, once installed, is known to commands by its names."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from doc_pages import ROOT, blocks, make_folder

import drgs
from drgs.cameras import orbit

PAGE = ROOT / "docs/extending.md"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder for the path that holds `my_package` as the page writes it, with what `pip install` makes of its
    pyproject.toml: the names of its entry points.
    """
    folder = tmp_path_factory.mktemp("site")
    package = folder / "my_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (project,) = (tomllib.loads(block.text) for block in blocks(PAGE) if block.language == "toml")
    for block in blocks(PAGE):
        if found := re.match(r"# (my_package/\w+\.py)\n", block.text):
            (folder / found[1]).write_text(block.text)
    for name in ("brightness_block", "lines_loader", "narrow_response", "rows_codec", "vignette"):
        shutil.copy(ROOT / f"examples/{name}.py", package)
    name, version = project["project"]["name"], project["project"]["version"]
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = []
    for group, points in project["project"]["entry-points"].items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """`scene` and `point_cloud.ply`, as pages have them, and `lines`, a data set in the page's format."""
    made = make_folder(tmp_path_factory.mktemp("scene"))
    g = drgs.load_ply(made / "point_cloud.ply")
    (made / "lines").mkdir()
    rows = []
    for k, camera in enumerate(orbit((0, 0, 0), 3.0, 6, width=32, height=24, up=(0, -1, 0))):
        pixels = (drgs.render(g, camera).rgb.clamp(0, 1) * 255).byte().numpy()
        cv2.imwrite(str(made / f"lines/{k}.png"), pixels[..., ::-1])
        rows.append(" ".join(map(str, [f"{k}.png", camera.K[0, 0], *camera.center, 0, 0, 0])))
    (made / "lines/views.txt").write_text("\n".join(rows))
    return made


def command(site: Path | None, folder: Path, *words: str) -> subprocess.CompletedProcess:
    """`drgs` in a process of its own, with the package installed or without."""
    path = [str(ROOT), *([str(site)] if site else []), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
    line = [sys.executable, "-m", "drgs", *words]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


def done(site: Path | None, folder: Path, *words: str) -> str:
    found = command(site, folder, *words)
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_the_page_is_a_package(site):
    """Every entry point that it names is in a module that it shows."""
    for value in re.findall(r" = (\S+:\S+)", next(site.glob("*.dist-info/entry_points.txt")).read_text()):
        module, _, attribute = value.partition(":")
        assert re.search(
            rf"^(def |class )?{attribute}\b", (site / f"{module.replace('.', '/')}.py").read_text(), flags=re.M
        )


def test_a_policy_and_a_criterion_by_name(site, folder):
    """`drgs select --policy directions`, and `--criterion doubled`, whose scores are whole numbers."""
    words = ("select", "point_cloud.ply", "--candidates", "scene", "--train", "cameras.json", "--k", "2", "--quiet")
    done(site, folder, *words, "--policy", "directions", "-o", "out/directions.json")
    found = json.loads((folder / "out/directions.json").read_text())
    assert found["policy"] == "directions"
    assert len({pick["index"] for pick in found["picks"]}) == 2
    done(site, folder, *words, "--criterion", "doubled", "-o", "out/doubled.json")
    scores = [x["score"] for x in json.loads((folder / "out/doubled.json").read_text())["picks"]]
    assert all(score == round(score) for score in scores)
    assert scores[0] > 0


def test_a_data_set_in_a_script(folder, monkeypatch):
    """The loader's views, by a row of the table; it gets the option that it has a parameter for."""
    from examples.lines_loader import LINES

    monkeypatch.setattr(drgs.data.LOADERS, "_rows", {**drgs.data.LOADERS._rows, "lines": LINES})
    dataset = drgs.load_data(folder / "lines", background=(1.0, 1.0, 1.0))
    assert [view.name for view in dataset.views] == [str(k) for k in range(6)]
    assert dataset.views[0].background == (1.0, 1.0, 1.0)
    assert dataset.views[0].image().shape == (24, 32, 3)


@pytest.mark.slow
def test_a_data_set_and_a_response_by_name(site, folder):
    """`drgs fit` of a folder in the new format, and `drgs render --set response=narrow` of what it made."""
    done(site, folder, "fit", "lines", "-o", "runs/lines", "--max-steps", "6", "--max-gaussians", "200", "--quiet")
    record = json.loads((folder / "runs/lines/config.json").read_text())
    assert len([*record["train"], *record["test"]]) == 6
    words = ("render", "runs/lines", "--frames", "1", "--width", "24", "--quiet")
    done(site, folder, *words, "--set", "response=narrow", "-o", "out/narrow")
    done(site, folder, *words, "-o", "out/peak")
    narrow, peak = (
        cv2.imread(str(next((folder / "out" / name).rglob("*.png")))).astype(np.float64) for name in ("narrow", "peak")
    )
    assert narrow.shape == peak.shape
    assert narrow.mean() < peak.mean()  # thinner Gaussians before black


@pytest.mark.slow
def test_a_codec_by_name(site, folder):
    """`drgs convert` writes the new format, and reads it by its mark."""
    done(site, folder, "convert", "point_cloud.ply", "out/cloud.rows", "--quiet")
    done(site, folder, "convert", "out/cloud.rows", "out/again.ply", "--quiet")
    assert len(drgs.load_ply(folder / "out/again.ply")) == len(drgs.load_ply(folder / "point_cloud.ply"))


@pytest.mark.slow
def test_without_the_package_the_names_are_refused(folder):
    """It is the installed package that adds them: without it each command says in one line what there is."""
    for words, told in (
        (("fit", "lines", "-o", "runs/none"), "must hold camera poses"),
        (("render", "point_cloud.ply", "--set", "response=narrow", "-o", "out/none"), "response must be one of peak"),
        (("convert", "point_cloud.ply", "out/none.rows"), ".sog, .glb, got .rows; choose"),
    ):
        found = command(None, folder, *words, "--quiet")  # no progress: a busy machine says how long it takes
        assert found.returncode == 2
        assert told in found.stderr
        assert len(found.stderr.splitlines()) == 1
