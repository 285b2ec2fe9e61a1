"""Every path of a rasterizer is tested, or is said not to be: depth, culling, cameras, packed arrays, a lens."""

from __future__ import annotations

import json
import sys
import types

import numpy as np
import pytest
import torch
import torch_rasterizer
import torch_rays
from test_crossval_rays import FIELDS, RIGHT, write_capture
from test_crossval_rays import _made as ray_scene

import drgs
from drgs import cli
from drgs.data.camera_lists import save_cameras_json
from drgs.files import save_ply
from drgs.lab.crossval import crossval
from drgs.lab.paths import PATHS
from drgs.lab.rasterizers import function, load_rasterizer
from drgs.testing import assert_matches, random_scene

pytestmark = pytest.mark.usefixtures("functions_in_float64")

BACKGROUND = (0.3, 0.6, 0.2)


@pytest.fixture(scope="module")
def scene():
    """Few Gaussians and one small view."""
    return random_scene(0, count=30, width=32, height=24)


def _rows(call, scene, name="made", preset="gsplat"):
    """The result, and its rows by path."""
    g, cameras = scene
    made = call if not callable(call) else function(call, name)
    result = crossval(made, g, cameras, preset, {"background": BACKGROUND}, channels=0)
    return result, {row.path: row for row in result.paths}


def test_every_path_of_a_right_one(scene):
    """What can be tested agrees; the rest is named, with the command that would test it."""
    result, rows = _rows(torch_rasterizer.paths, scene)
    assert tuple(rows) == PATHS
    assert result.verdict == "agreement", "\n".join(result.lines())
    left = {path for path, row in rows.items() if row.status == "not tested"}
    assert left == {"lens", "rolling shutter", "hit distance d", "hit distance Ed", "batches", "antialiasing"} | {
        "wide channels"
    }
    assert all(rows[path].why and rows[path].how for path in left)
    assert "--cameras DATA_WITH_LENSES --preset 3dgut" in rows["lens"].how
    assert result.lines()[-1].startswith("not tested: lens, rolling shutter, hit distance d")


@pytest.mark.every(2)
@pytest.mark.parametrize(("name", "path"), [(name, d.path) for name, d in torch_rasterizer.PATH_DEFECTS.items()])
def test_a_broken_path_is_named(scene, name, path):
    """A path whose gradient is lost is wrong, although that of the colors is right."""
    defect = torch_rasterizer.PATH_DEFECTS[name]
    result, rows = _rows(defect.call, scene, name)
    wrong = {p for p, row in rows.items() if row.status == "wrong"}
    assert wrong == {*path}, "\n".join(result.lines())
    assert result.verdict == defect.verdict
    assert all(row.verdict == "agreement" for row in result.groups.values())
    assert f"{path[0]}: wrong: " in "\n".join(result.lines())


def test_assert_matches_tests_the_paths(scene):
    """The helper for other people's tests fails where the command does."""
    with pytest.raises(AssertionError, match="packed: wrong: the gradient of means"):
        assert_matches(torch_rasterizer.paths_packed_detached, *scene, preset="gsplat", channels=0)


def test_depth_modes_that_are_refused_or_of_another_shape(scene):
    """One line says that depth is refused; a function that names the mode and returns another shape is wrong."""

    def refuses(means, render_mode="RGB", **arguments):
        if render_mode != "RGB":
            raise NotImplementedError("colors only\nsorry")
        return torch_rasterizer.rasterization(means=means, **arguments)

    result, rows = _rows(refuses, scene)
    row = rows["depth RGB+D"]
    assert (row.status, result.verdict) == ("not tested", "agreement")
    assert row.why == "refused: raised NotImplementedError: colors only"

    def colors_alone(means, render_mode="RGB", **arguments):
        return torch_rasterizer.rasterization(means=means, **arguments)

    result, rows = _rows(colors_alone, scene)
    assert (rows["depth RGB+D"].status, result.verdict) == ("wrong", "model difference")
    assert rows["depth RGB+D"].why == "its image must have shape (1, 24, 32, 4), got (1, 24, 32, 3)"

    def of_one_camera(means, **arguments):
        image, alpha, info = torch_rasterizer.rasterization(means=means, **arguments)
        return image[0], alpha[0], info

    result, rows = _rows(of_one_camera, scene)
    assert (rows["several cameras in a call"].status, result.verdict) == ("wrong", "model difference")
    assert rows["several cameras in a call"].why == "its image must have shape (2, 24, 32, 3), got (24, 32, 3)"


def test_ours_has_every_path(scene):
    """drgs.rasterization agrees on all that an image plane has."""
    result, rows = _rows(drgs.rasterization, scene)
    assert result.verdict == "agreement", "\n".join(result.lines())
    left = {path for path, row in rows.items() if row.status == "not tested"}
    assert left == {"lens", "rolling shutter", "hit distance d", "hit distance Ed", "wide channels"}


def test_distances_to_hits():
    """Along rays, RGB+D and the distances of d and Ed agree; a distance whose gradient is halved does not."""
    g, camera = ray_scene(0)
    given = g, [camera], {"background": BACKGROUND}

    def halved(render_mode="RGB", **arguments):
        image, alpha, info = drgs.rasterization(render_mode=render_mode, **arguments)
        return (0.5 * (image + image.detach()) if render_mode == "d" else image), alpha, info

    for call, wrong in ((drgs.rasterization, set()), (halved, {"hit distance d"})):
        made = function(call, "made", True)
        result = crossval(made, g, [camera], "3dgut", given[2], channels=0)
        rows = {row.path: row for row in result.paths}
        assert {path for path, row in rows.items() if row.status == "wrong"} == wrong, "\n".join(result.lines())
        assert rows["hit distance Ed"].status == rows["depth RGB+D"].status == "agrees"


def test_a_lens_that_loses_the_geometry(tmp_path):
    """With --preset auto cameras are pinholes, and yet the lens that they had is tested."""
    g, camera = ray_scene(0, "opencv")
    result = crossval(function(torch_rays.lens_detached(RIGHT), "detached"), g, [camera], "3dgut", FIELDS, channels=0)
    assert result.verdict == "gradient bug"
    save_ply(g, tmp_path / "scene.ply")
    write_capture(tmp_path / "capture", camera)
    module = types.ModuleType("lost_lens")
    module.rasterization = torch_rays.lens_detached(RIGHT)
    sys.modules["lost_lens"] = module
    command = ["crossval", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "capture"), "--quiet"]
    command += ["--no-ladder", "--rasterizer", "lost_lens:rasterization", "--set", "background=0.3,0.6,0.2"]
    try:
        assert cli.main([*command, "-o", str(tmp_path / "out")]) == 1
    finally:
        del sys.modules["lost_lens"]
    report = json.loads((tmp_path / "out" / "crossval.json").read_text())
    row = next(row for row in report["paths"] if row["path"] == "lens")
    assert (row["status"], report["verdict"]) == ("wrong", "gradient bug")
    assert "means" in row["why"]


def test_the_command_says_what_it_did_not_test(scene, tmp_path, capsys):
    """The table is printed, stands in the page and in the JSON; the last line names what was not tested."""
    g, cameras = scene
    save_ply(g, tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "cameras.json", cameras)
    command = ["crossval", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--no-ladder"]
    command += ["--rasterizer", "torch_rasterizer:paths_index_shifted", "-o", str(tmp_path / "out")]
    assert cli.main([*command, "--set", "background=0.3,0.6,0.2", "--preset", "gsplat"]) == 1
    printed = capsys.readouterr().out
    assert "(not tested: lens, rolling shutter" in printed.splitlines()[-1]
    report = json.loads((tmp_path / "out" / "crossval.json").read_text())
    assert [row["path"] for row in report["paths"]] == list(PATHS)
    page = (tmp_path / "out" / "report.html").read_text()
    assert all(path in page for path in PATHS)


def test_the_command_says_the_same_hint_once(scene, tmp_path, capsys):
    """With the number of paths that it is for; in the JSON each has its own."""
    g, cameras = scene
    save_ply(g, tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "cameras.json", cameras[:1])
    command = ["crossval", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "cameras.json"), "--no-ladder"]
    assert cli.main([*command, "-o", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    rows = json.loads((tmp_path / "out" / "crossval.json").read_text())["paths"]
    alike = [row["path"] for row in rows if row["why"] == "presets are drawn without gsplat's arguments"]
    assert printed.count("presets are drawn without gsplat's arguments") == 1
    assert f"rasterize:rasterization ({len(alike)} paths)" in printed
    assert printed.count(f"not tested as {alike[0]}") == len(alike) - 1 > 10


def test_presets_and_dumps_say_so(scene):
    """What has no arguments of gsplat's is tested in one view alone."""
    g, cameras = scene
    result = crossval(load_rasterizer("drgs:gsplat"), g, cameras, "gsplat", {"background": BACKGROUND}, channels=0)
    rows = {row.path: row for row in result.paths}
    assert rows["pinhole"].status == "agrees"
    assert rows["packed"].how == "drgs crossval SCENE --rasterizer drgs.rasterize:rasterization"
    assert np.isfinite(result.report["image"]["after"])
    assert torch.isfinite(g.means).all()
