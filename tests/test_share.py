"""The page of `drgs share`: what it holds, its file, and where the viewer's code comes from."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import io
import json
import re
import shutil
import tarfile
import urllib.error

import numpy as np
import pytest
import torch
from test_report import Page
from test_select_command import place  # noqa: F401 (a data set, and a run that chose its views)
from test_semantic_fit import dataset, taught  # noqa: F401 (fixtures)
from test_semantic_fit import run as labelled_run  # noqa: F401 (a fixture)

import drgs
from drgs import cli
from drgs.cameras import orbit
from drgs.codecs import save_gaussians
from drgs.codecs.clustering import morton_order
from drgs.codecs.sog import load_sog
from drgs.commands.options import Share
from drgs.commands.share import shared_of
from drgs.fitting.errors import run_error_record
from drgs.fitting.records import load_run
from drgs.io.run import Run
from drgs.pages.sharing import npm
from drgs.pages.sharing.layers import GaussianScale, scale_layer
from drgs.pages.sharing.placing import upright_matrix
from drgs.pages.sharing.scene import _cameras
from drgs.pages.sharing.write import archive_of
from drgs.viewing.placed_views import Ranking, Score


def blobs(count: int = 300, degree: int = 3, seed: int = 0) -> drgs.Gaussians:
    """Gaussians of all sizes, colors and a few kinds of shine, in a box of about two units."""
    rng = np.random.default_rng(seed)
    each = (degree + 1) ** 2
    kinds = 0.2 * rng.normal(size=(20, each, 3))
    sh = kinds[rng.integers(20, size=count)] + 0.01 * rng.normal(size=(count, each, 3))
    sh[:, 0] = rng.normal(size=(count, 3))
    arrays = {
        "quats": rng.normal(size=(count, 4)),
        "scales": np.exp(rng.uniform(-4.5, -1.5, (count, 3))),
        "opacities": rng.uniform(0.1, 0.99, count),
        "sh": sh,
    }
    tensors = {name: torch.as_tensor(x, dtype=torch.float32) for name, x in arrays.items()}
    return drgs.Gaussians.from_arrays(torch.as_tensor(rng.normal(0, 0.5, (count, 3)), dtype=torch.float32), **tensors)


def write_viewer(folder) -> None:
    """A stand-in for the viewer's code where none of it runs: files of the names that a page takes."""
    for package in npm.PACKAGES:
        for name in package.files:
            path = folder / package.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"// {name}\nimport {{ x }} from './three.core.js';\n")


@pytest.fixture
def viewer(tmp_path, monkeypatch):
    """Pages take a stand-in for the viewer's code."""
    folder = tmp_path / "npm"
    write_viewer(folder)
    monkeypatch.setattr(npm, "cache_folder", lambda: folder)


def told(path) -> dict:
    """What a page says of its scene, in JSON."""
    return json.loads(re.search(r'id="scene">(.*?)</script>', path.read_text(), re.DOTALL)[1])


def part(path, kind: str, name: str) -> bytes:
    """One of the packed things in a page."""
    text = re.search(rf'class="{kind}" data-name="{re.escape(name)}">([^<]*)<', path.read_text())[1]
    return gzip.decompress(base64.b64decode(text))


def test_a_page_is_whole_by_itself(viewer, tmp_path, capsys):
    """Nothing is loaded from outside, modules import by names that the page has, and the Gaussians are the archive that
    `.sog` files are. The same scene is the same page, and its own page is replaced."""
    g = blobs()
    save_gaussians(g, tmp_path / "a.ply")
    assert cli.main(["share", str(tmp_path / "a.ply")]) == 0
    path = tmp_path / "a.html"
    assert f"300 Gaussians: {path}" in capsys.readouterr().out
    page = Page(path)
    assert not [attrs for _, attrs in page.tags for key in ("src", "href") if key in attrs]
    (policy,) = (attrs["content"] for attrs in page.all("meta") if "http-equiv" in attrs)
    assert "default-src 'none'" in policy
    assert "http" not in policy
    modules = {attrs["data-name"]: attrs for attrs in page.all("script") if attrs.get("class") == "module"}
    for name in modules:
        code = part(path, "module", name).decode()
        for imported in re.findall(r"""^import [^;]*? from ["']([^"']+)["'];""", code, re.MULTILINE):
            assert imported in modules or name == "three/core" or imported == "./three.core.js", (name, imported)
    assert "from 'three/core'" in part(path, "module", "three").decode()
    (tmp_path / "back.sog").write_bytes(part(path, "part", "gaussians"))
    assert len(load_sog(tmp_path / "back.sog")) == len(g)
    before = path.read_bytes()
    assert cli.main(["share", str(tmp_path / "a.ply"), "--quiet"]) == 0
    assert path.read_bytes() == before


def test_names_are_text(viewer, tmp_path):
    """A scene that is named like a program is a name, in the title and in what the page is told."""
    folder = tmp_path / "<img src=x onerror=alert(1)>"
    folder.mkdir()
    save_gaussians(blobs(20), folder / "<b>.ply")
    assert cli.main(["share", str(folder / "<b>.ply"), "-o", str(tmp_path / "x.html"), "--quiet"]) == 0
    page = Page(tmp_path / "x.html")
    assert not page.all("b")
    assert not page.all("img")
    assert page.texts["title"] == "<b>"


@pytest.mark.parametrize(
    ("arguments", "told_of"),
    [
        (["-o", "x.txt"], "must be named *.html"),
        (["-o", "other.html"], "must not be replaced, `drgs share` did not make it"),
        (["--moments", "1"], "--moments must be in [2, 200], got 1"),
        (["--selection", "none.json"], "none.json"),
    ],
)
def test_refusals(viewer, tmp_path, monkeypatch, capsys, arguments, told_of):
    monkeypatch.chdir(tmp_path)
    save_gaussians(blobs(20), tmp_path / "a.ply")
    (tmp_path / "other.html").write_text("<p>mine</p>")
    assert cli.main(["share", "a.ply", *arguments, "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told_of in line
    assert (tmp_path / "other.html").read_text() == "<p>mine</p>"
    assert not (tmp_path / "a.html").exists()


def test_without_a_network(tmp_path, monkeypatch, capsys):
    """Where the viewer's code is not there and cannot be fetched, one line says what to do, and no page is left."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def refuse(address, timeout):
        raise urllib.error.URLError("no route to host")

    monkeypatch.setattr(npm.urllib.request, "urlopen", refuse)
    save_gaussians(blobs(20), tmp_path / "a.ply")
    assert cli.main(["share", "a.ply", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "must be fetched once from https://registry.npmjs.org/three/-/three-" in line
    assert "no route to host; connect to the network, or copy " in line
    assert line.endswith(f"{tmp_path / 'cache' / 'drgs' / 'npm'} from a machine that has it")
    assert not (tmp_path / "a.html").exists()


def test_what_is_fetched_is_what_is_pinned(tmp_path, monkeypatch):
    """An archive with another hash is refused, and nothing of it is written; the one that is pinned is unpacked, its
    license with it."""
    packed = io.BytesIO()
    package = npm.Package("@some/thing", "1.2.3", "", {"thing": "dist/thing.js"})
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name in ("dist/thing.js", "dist/other.js", "LICENSE"):
            info = tarfile.TarInfo(f"package/{name}")
            info.size = len(name)
            archive.addfile(info, io.BytesIO(name.encode()))
    assert package.address == "https://registry.npmjs.org/@some/thing/-/thing-1.2.3.tgz"
    monkeypatch.setattr(npm, "PACKAGES", (package,))
    monkeypatch.setattr(npm.urllib.request, "urlopen", lambda address, timeout: io.BytesIO(packed.getvalue()))
    with pytest.raises(OSError, match=r"must have the SHA-512 .* it was changed on the way"):
        npm.fetch_into(tmp_path / "npm")
    assert not (tmp_path / "npm").exists()
    digest = base64.b64encode(npm.hashlib.sha512(packed.getvalue()).digest()).decode()
    monkeypatch.setattr(npm, "PACKAGES", (npm.dataclasses.replace(package, sha512=digest),))
    npm.fetch_into(tmp_path / "npm")
    found = {str(x.relative_to(tmp_path / "npm")) for x in (tmp_path / "npm").rglob("*") if x.is_file()}
    assert found == {"thing-1.2.3/dist/thing.js", "thing-1.2.3/LICENSE"}


def test_the_runs_own_file_by_its_name(viewer, place, tmp_path):  # noqa: F811
    """`-o RUN/scene.html` is the page of the run, which `drgs share RUN` replaces."""
    run = shutil.copytree(place / "run", tmp_path / "run")
    for more in (["-o", str(run / "scene.html")], []):
        assert cli.main(["share", str(run), *more, "--no-uncertainty", "--quiet"]) == 0
    assert '"scene.html"' in (run / ".drgs.jsonl").read_text()


def test_a_folder_without_a_name(viewer, tmp_path, monkeypatch, capsys):
    """`.` is no run: the line says so. Of a folder of Gaussians, the page has the folder's name."""
    folder = tmp_path / "trained" / "point_cloud" / "iteration_7"
    (tmp_path / "trained").mkdir()
    monkeypatch.chdir(tmp_path / "trained")
    assert cli.main(["share", ".", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'trained'}: must be a run folder, found no config.json" in line
    folder.mkdir(parents=True)
    save_gaussians(blobs(20), folder / "point_cloud.ply")
    assert cli.main(["share", ".", "--quiet"]) == 0
    assert Page(tmp_path / "trained.html").texts["title"] == "trained"


def test_picks_of_what_moves():
    """Of synchronous cameras, picks at the place of a fitted view and of views with higher scores are there; fitted
    ones are not."""
    views = [
        drgs.data.View(dataclasses.replace(camera, time=time), f"{k}_{time}")
        for time in (0.0, 0.5, 1.0)
        for k, camera in enumerate(orbit((0, 0, 0), 3.0, 2, width=8, height=8))
    ]
    scores = {view.name: Score(view.camera.time, {}, 1, 6) for view in views}
    cameras = _cameras(views, ["0_0.0", "1_1.0"], Ranking("", scores, ("1_1.0", "0_0.5", "1_0.5")))
    following = [(camera.name, camera.time) for kind, camera in cameras if kind == "next"]
    assert following == [("2. 0_0.5", 0.5), ("3. 1_0.5", 0.5)]


def test_where_harmonics_are(tmp_path):
    """The bytes that a page is told of are the archive's pictures of the palette and of its rows."""
    data, known = archive_of(blobs(500))
    assert known["each"] == 15
    for name in ("centroids", "labels"):
        assert data[slice(*known[name])][:4] == b"RIFF"
    assert known["rows"] <= 500
    assert archive_of(blobs(50, degree=0))[1] is None


def test_the_page_is_told_of_a_run(viewer, place, tmp_path):  # noqa: F811
    """Of a run: its photographs' cameras, upright, the picks of a selection, and what is uncertain; it is written into
    the run's folder."""
    assert cli.main(["share", str(place / "run"), "--quiet"]) == 0
    path = place / "run/scene.html"
    scene = told(path)
    kinds = [photo["kind"] for photo in scene["photos"]]
    shared = shared_of(Share(scene=place / "run", uncertainty=False))
    assert kinds.count("fitted") == sum(kind == "fitted" for kind, _ in shared.cameras) > 1
    assert kinds[scene["first"]] == "fitted"
    turn = np.array(scene["upright"]).reshape(4, 4).T[:3, :3]
    np.testing.assert_allclose(turn @ shared.up, [0, 1, 0], atol=1e-6)
    levels = np.frombuffer(part(path, "part", "scale"), np.uint8)
    assert scene["scale"]["name"] == "error"
    record = run_error_record(Run(place / "run"), load_run(place / "run").record.config.settings)
    values = record.of_gaussians.sqrt().numpy()[morton_order(shared.gaussians.means.numpy())]
    assert (np.diff(levels[np.argsort(values)].astype(int)) >= 0).all()
    assert values.min() * 0.999 < scene["scale"]["low"] < scene["scale"]["high"] < values.max() * 1.001
    path.unlink()


def test_without_photographs_a_page_has_what_cameras_leave_uncertain(viewer, place, tmp_path, caplog):  # noqa: F811
    """Of a splat with the photographs of a data set, the expected error; with cameras alone, the uncertainty; and a run
    whose photographs are gone has its record."""
    named = {}
    for train in ("data", "cameras.json"):
        path = tmp_path / f"{train}.html"
        words = [str(place / "scene.ply"), "--train", str(place / train), "-o", str(path), "--quiet"]
        assert cli.main(["share", *words]) == 0
        named[train] = told(path)["scale"]["name"]
    assert named == {"data": "error", "cameras.json": "uncertainty"}
    shutil.copytree(place / "run", tmp_path / "run")
    config = json.loads((tmp_path / "run/config.json").read_text())
    (tmp_path / "run/config.json").write_text(json.dumps(config | {"data": str(tmp_path / "gone")}))
    assert shared_of(Share(scene=tmp_path / "run")).scale.name == "error"
    (tmp_path / "run/errors.safetensors").unlink()
    assert shared_of(Share(scene=tmp_path / "run")).scale is None
    assert "the page goes without the expected error" in caplog.text


def test_photographs_to_take_next(viewer, place, tmp_path):  # noqa: F811
    """The picks of a selection are in the page in their order, behind the photographs, at one of which it opens."""
    picked, path = tmp_path / "selection.json", tmp_path / "x.html"
    run = str(place / "run")
    options = ["--candidates", "dome", "--count", "4", "-k", "2", "--quiet"]
    assert cli.main(["select", run, *options, "-o", str(picked)]) == 0
    names = [pick["name"] for pick in json.loads(picked.read_text())["picks"]]
    assert cli.main(["share", run, "--selection", str(picked), "--no-uncertainty", "--quiet", "-o", str(path)]) == 0
    scene = told(path)
    following = [photo["name"] for photo in scene["photos"] if photo["kind"] == "next"]
    assert following == [f"{k}. {name}" for k, name in enumerate(names, 1)]
    assert scene["photos"][scene["first"]]["kind"] == "fitted"
    assert "scale" not in scene


def test_what_does_not_carry_over_is_said(viewer, labelled_run, tmp_path, caplog):  # noqa: F811
    """A fit for renderers along rays alone looks otherwise in a page: one line of the log, and one of the page."""
    folder = tmp_path / "run"
    shutil.copytree(labelled_run.run.path, folder)
    config = json.loads((folder / "config.json").read_text())
    config["fit"]["renderers"] = ["fast"]
    (folder / "config.json").write_text(json.dumps(config))
    shared = shared_of(Share(scene=folder, uncertainty=False))
    assert "fitted for fast alone" in caplog.text
    assert any("gsplat" in line for line in shared.lines)


def test_classes_of_a_run(viewer, labelled_run, tmp_path):  # noqa: F811
    """Each Gaussian's class goes into the page in the order of the archive."""
    path = tmp_path / "x.html"
    assert cli.main(["share", str(labelled_run.run.path), "-o", str(path), "--no-uncertainty", "--quiet"]) == 0
    shared = shared_of(Share(scene=labelled_run.run.path, uncertainty=False))
    known, labels = shared.classes
    assert told(path)["classes"]["names"] == known["names"]
    order = morton_order(shared.gaussians.means.numpy())
    np.testing.assert_array_equal(np.frombuffer(part(path, "part", "classes"), "<u2"), labels[order])


def test_scale_of_a_layer():
    """Levels rise with the value, over three decades at most; one value alone has a scale, too."""
    values = np.geomspace(1e-6, 1.0, 1000)
    known, levels = scale_layer(GaussianScale("error", "", values), np.arange(1000))
    levels = np.frombuffer(levels, np.uint8)
    assert (np.diff(levels.astype(int)) >= 0).all()
    assert levels[0] == 0
    assert levels[-1] == 255
    assert known["high"] / known["low"] == pytest.approx(1e3)
    assert len(known["colors"]) == 256
    assert scale_layer(GaussianScale("error", "", np.full(5, 0.1)), np.arange(5))[0]["low"] < 0.11


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 1, 0), (0.6, 0, 0.8)])
def test_the_world_is_upright(up):
    turn = upright_matrix(np.array(up, float))
    np.testing.assert_allclose(turn[:3, :3] @ up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
