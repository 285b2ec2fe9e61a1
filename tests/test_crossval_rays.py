"""Rasterizers that evaluate Gaussians along rays: right ones agree through every lens, broken ones are named."""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import sys
import types

import numpy as np
import pytest
import torch
import torch_rasterizer
import torch_rays
from test_data import save, write_image
from torch_rays import DEFECTS, LENSES

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl
from drgs.cameras.shutters import SHUTTERS
from drgs.ellipsoids import Gaussians
from drgs.files import save_ply
from drgs.lab import rasterizers
from drgs.lab.crossval import crossval
from drgs.lab.ladder import ladder
from drgs.lab.parameters import MOTIONS, PARAMETERS, raw_of
from drgs.lab.rasterizers import function, load_rasterizer, ours
from drgs.settings import RenderSettings
from drgs.testing import assert_matches

pytestmark = pytest.mark.usefixtures("functions_in_float64")

BACKGROUND = (0.3, 0.6, 0.2)
# A rasterizer in plain torch is dense: what boxes of the unscented transform leave out is asked of one that has them.
FIELDS = {"background": BACKGROUND, "culling": "extent"}
PRESET = RenderSettings.preset("3dgut")
RIGHT = dataclasses.replace(
    torch_rays.CORRECT, alpha_max=PRESET.alpha_max, density_min=math.exp(-(PRESET.extent**2) / 2), between=False
)
# Of a convention or a lens: its name in the report, and what is found.
CONVENTIONS = {
    "tangential_sign": ("lens distortion", "tangential terms negated"),
    "lens_ignored": ("lens distortion", "ignored"),
    "plain_directions": ("ray direction in a Gaussian's frame", "not normalized"),
    "peaks_behind": ("peaks that count", "everywhere"),
    "sort_by_distance": ("depth sort key", "distance"),
    "alpha_clamp": ("alpha_max", "0.95"),
    "narrow_cutoff": ("extent", "2.5"),
    "stop_behind": ("stop rule", "after"),
}


def test_gsplat_is_asked_for_three_channels_along_rays():
    """Its kernels end the process for others; on the image plane it may have any number."""
    asked = []
    checked = rasterizers._three_channels_along_rays(lambda **given: asked.append(given["colors"].shape[-1]))
    checked(colors=torch.zeros(2, 3), with_eval3d=True)
    checked(colors=torch.zeros(2, 6))
    with pytest.raises(NotImplementedError, match="along rays its images have 3 channels, not 6"):
        checked(colors=torch.zeros(2, 6), with_eval3d=True)
    assert asked == [3, 6]


def _made(seed=0, lens="pinhole"):
    s = torch_rays.ray_scene(seed)
    g = Gaussians(**{name: s[name].float() for name in PARAMETERS})
    model, distortion = LENSES[lens]
    size = {"width": s["width"], "height": s["height"]}
    return g, Camera(K=s["K"].numpy(), w2c=s["viewmat"].numpy(), model=model, distortion=distortion, **size)


def _rolling(camera, shutter):
    """The camera with a shutter during which it turns and moves a little."""
    end = torch_rays.end_of(torch.tensor(camera.w2c)).numpy()
    return dataclasses.replace(camera, shutter=shutter, w2c_end=end)


def write_capture(folder, camera):
    """A transforms.json data set of one view, with the camera's lens."""
    names = ("k1", "k2", "p1", "p2", "k3") if camera.model == "opencv" else ("k1", "k2", "k3", "k4")
    K = camera.K
    write_image(folder / "images" / "a.png", np.zeros((camera.height, camera.width, 3), np.uint8))
    frame = {"file_path": "images/a.png", "transform_matrix": c2w_to_opengl(camera.c2w).tolist()}
    data = {"camera_model": camera.model.upper(), **dict(zip(names, camera.distortion, strict=True))}
    data |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": camera.width, "h": camera.height}
    save(folder, data | {"frames": [frame]})


def _checked(name, result):
    """What is said of a defect is what it is, and nothing else is."""
    defect, text = DEFECTS[name], "\n".join(result.lines())
    if name in CONVENTIONS:
        assert result.verdict == "other convention", text
        assert [(c["name"], c["found"]) for c in result.report["conventions"]] == [CONVENTIONS[name]], text
        assert all(row.verdict == "agreement" for row in result.groups.values()), text
        return
    assert not result.findings, text
    verdict = "known deviation" if name == "clamp_passes_gradient" else "gradient bug"
    assert result.verdict == verdict, text
    found = {group for group, row in result.groups.items() if row.verdict == verdict and "channels" not in group}
    if name == "clamp_passes_gradient":
        assert "clamped alpha passes its gradient" in text
        assert found <= {*defect.groups}, text
    else:  # what is wrong for the weights is so for the colors of six channels
        assert found == {*defect.groups, *(["colors"] if "sh" in defect.groups else [])}, text


@pytest.mark.every(3)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("lens", LENSES)
def test_a_right_one_agrees(lens, seed):
    """Image and every gradient are the preset's, through every lens."""
    g, camera = _made(seed, lens)
    result = crossval(function(torch_rays.rasterizer(RIGHT), "right"), g, [camera], "3dgut", FIELDS)
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert not result.findings
    assert result.report["image"]["after"] < 1e-6
    assert max(row.relative for row in result.groups.values()) < 1e-5
    assert {*result.groups} == {*PARAMETERS, "viewmats", "colors"}


@pytest.mark.parametrize("lens", ["pinhole", "opencv"])
def test_it_is_recognized(lens):
    """What it claims to be need not be said; of a lens, presets along rays are looked at only."""
    g, camera = _made(1, lens)
    result = crossval(function(torch_rays.rasterizer(RIGHT), "right"), g, [camera], "auto", FIELDS)
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert result.report["preset"] == "3dgut"


@pytest.mark.every(6)
@pytest.mark.parametrize(
    ("name", "lens"),
    [(name, "pinhole") for name, d in DEFECTS.items() if d.kind in ("gradient", "convention")]
    + [(name, "opencv") for name, d in DEFECTS.items() if d.kind == "lens"]
    + [("half_missing", "fisheye"), ("lens_ignored", "fisheye"), ("origin_detached", "opencv")],
)
def test_every_defect_is_named(name, lens):
    """A kernel that is broken is a gradient bug in its own groups; another convention is called by its name."""
    g, camera = _made(0, lens)
    _checked(name, crossval(function(torch_rays.broken(name, RIGHT), name), g, [camera], "3dgut", FIELDS))


@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("name", "shutter", "lens"),
    [
        ("right", "rolling_top_to_bottom", "pinhole"),
        ("right", "rolling_right_to_left", "opencv"),
        ("shutter_end_detached", "rolling_bottom_to_top", "pinhole"),
        ("eye_between_poses", "rolling_left_to_right", "fisheye"),
    ],
)
def test_a_shutter_of_the_camera(name, shutter, lens):
    """Both poses are compared, and the end that has no gradient is a bug where the other one has."""
    g, camera = _made(0, lens)
    camera = _rolling(camera, shutter)
    made = torch_rays.rasterizer(RIGHT) if name == "right" else torch_rays.broken(name, RIGHT)
    result = crossval(function(made, name), g, [camera], "3dgut", FIELDS)
    text = "\n".join(result.lines())
    assert {*MOTIONS} <= {*result.groups}, text
    wrong = [group for group, row in result.groups.items() if row.verdict == "gradient bug"]
    assert wrong == (["viewmats_rs"] if name == "shutter_end_detached" else []), text
    found = [(c["name"], c["found"]) for c in result.report["conventions"]]
    if name == "eye_between_poses":
        assert found == [("SH direction", "to the mean, from between both poses")], text
        assert result.verdict == "other convention", text
    else:
        assert not found, text
        assert result.verdict == ("agreement" if name == "right" else "gradient bug"), text


def test_a_shutter_is_given_in_the_functions_own_words():
    """Where a function's default is a member of an enumeration, as gsplat's, it is given a member of that."""
    kinds = enum.Enum("RollingShutterType", [name.upper() for name in SHUTTERS])
    given = []

    def rasterization(rolling_shutter=kinds.GLOBAL, with_ut=False, **arguments):
        given.append((rolling_shutter, with_ut))
        return torch_rays.rasterizer(RIGHT)(rolling_shutter=rolling_shutter, **arguments)

    g, camera = _made(0)
    camera = _rolling(camera, "rolling_left_to_right")
    function(rasterization, "own words").image(raw_of(g), camera, BACKGROUND)
    assert given[0] == (kinds.GLOBAL, False)  # asked for one Gaussian first
    assert given[-1] == (kinds.ROLLING_LEFT_TO_RIGHT, True)


@pytest.mark.parametrize("read", ["rolling_bottom_to_top", "global"])
def test_the_direction_of_a_shutter_is_a_convention(read):
    """A shutter that is read the other way, or not at all, is named."""
    g, camera = _made(0)

    def other(rolling_shutter="global", viewmats_rs=None, **arguments):
        if rolling_shutter != "global" and read == "global":
            rolling_shutter, viewmats_rs = read, None
        elif rolling_shutter != "global":
            rolling_shutter = read
        return torch_rays.rasterizer(RIGHT)(rolling_shutter=rolling_shutter, viewmats_rs=viewmats_rs, **arguments)

    result = crossval(function(other, read), g, [_rolling(camera, "rolling_top_to_bottom")], "3dgut", FIELDS)
    assert [(c["name"], c["found"]) for c in result.report["conventions"]] == [("shutter", read)]
    assert "gradient bug" not in [row.verdict for name, row in result.groups.items() if name not in MOTIONS]


def test_boxes_of_the_unscented_transform():
    """What gsplat's tiles leave out of a large Gaussian near the camera is a convention, if 3DGUT's is the claim."""
    g, camera = _made(0)
    cut, whole = (PRESET.replace(background=BACKGROUND, culling=culling) for culling in ("ut", "extent"))
    result = crossval(ours(cut, "cut"), g, [camera], "3dgut", FIELDS)
    assert [(c["name"], c["found"]) for c in result.report["conventions"]] == [("culling", "ut")]
    assert result.verdict == "other convention", "\n".join(result.lines())
    assert crossval(ours(whole, "whole"), g, [camera], "3dgut", FIELDS).verdict == "agreement"


@pytest.mark.slow
def test_projected_instead_of_along_rays():
    """A rasterizer of the other kind than its preset is named so, and not by what follows from it."""
    g, camera = _made(0)
    made = function(torch_rasterizer.rasterization, "projected")
    result = crossval(made, g, [camera], "3dgut", FIELDS, channels=0)
    found = {c["name"]: (c["expected"], c["found"]) for c in result.report["conventions"]}
    assert found["response"] == ("peak", "ewa"), "\n".join(result.lines())
    assert not {"dilation", "culling", "field-of-view clamp", "extent"} & {*found}
    assert result.report["image"]["after"] < 1e-5
    assert result.verdict == "other convention"

    result = crossval(
        function(torch_rays.rasterizer(RIGHT), "rays"), g, [camera], "gsplat", {"background": BACKGROUND}, channels=0
    )
    found = {c["name"]: c["found"] for c in result.report["conventions"]}
    assert found["response"] == "peak", "\n".join(result.lines())
    assert not {"dilation", "culling", "field-of-view clamp"} & {*found}
    assert result.verdict == "other convention"


@pytest.mark.every(3)
@pytest.mark.parametrize("lens", LENSES)
def test_our_own_preset(lens):
    """`drgs:3dgut` is held against the oracle through lenses, too, boxes included."""
    g, camera = _made(2, lens)
    result = crossval(load_rasterizer("drgs:3dgut"), g, [camera], "auto", {"background": BACKGROUND})
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert (result.report["preset"], result.report["reference"]) == ("3dgut", "float64 oracle")


@pytest.mark.slow
def test_assert_matches_along_rays():
    """The helper for other people's tests takes scenes with a lens."""
    g, camera = _made(1, "fisheye")
    allow = ("other convention",) if PRESET.culling == "ut" else ()  # which it does not have
    assert_matches(torch_rays.rasterizer(RIGHT), g, [camera], "3dgut", background=BACKGROUND, allow=allow)
    with pytest.raises(AssertionError, match="log_scales: gradient bug"):
        assert_matches(torch_rays.broken("scale_chain", RIGHT), g, [camera], "3dgut", background=BACKGROUND)


def test_assert_matches_calls_as_the_command_does():
    """A preset along rays is compared with Gaussians along rays, although no camera has a lens."""
    g, camera = _made(0)
    (result,) = assert_matches(drgs.rasterization, g, [camera], "3dgut", background=BACKGROUND, channels=0)
    assert not result.findings


def test_what_knows_no_lens_is_refused():
    """One line says which argument is missing, or that the preset draws no lens."""
    g, camera = _made(0, "opencv")

    def only_pinholes(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, backgrounds):
        options = {"sh_degree": sh_degree, "backgrounds": backgrounds}
        return torch_rasterizer.rasterization(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options
        )

    with pytest.raises(ValueError, match="must take camera_model for a camera of model 'opencv', does not") as error:
        crossval(function(only_pinholes, "pinholes"), g, [camera], "3dgut", FIELDS)
    assert "\n" not in str(error.value)
    made = function(torch_rays.rasterizer(RIGHT), "right")
    with pytest.raises(ValueError, match="must be pinholes for preset gsplat, a model of their image plane") as error:
        crossval(made, g, [camera], "gsplat", {"background": BACKGROUND})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_command_through_a_lens(tmp_path, lens):
    """With a preset along rays cameras keep their lens, without one they are pinholes, and the lens is tested apart."""
    g, camera = _made(0, lens)
    save_ply(g, tmp_path / "scene.ply")
    write_capture(tmp_path / "capture", camera)
    seen = []

    def rasterization(means, camera_model="pinhole", radial_coeffs=None, with_eval3d=False, **arguments):
        """Asked for one Gaussian first."""
        seen.append((camera_model, None if radial_coeffs is None else radial_coeffs.shape[-1], with_eval3d))
        options = {"camera_model": camera_model, "radial_coeffs": radial_coeffs}
        return torch_rays.rasterizer(RIGHT)(means=means, **options, **arguments)

    module = types.ModuleType("taken_down")
    module.rasterization = rasterization
    sys.modules["taken_down"] = module
    command = ["crossval", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "capture"), "--quiet"]
    command += ["--no-ladder", "--rasterizer", "taken_down:rasterization", "--set", "background=0.3,0.6,0.2"]
    try:
        out = tmp_path / "rays"
        assert cli.main([*command, "--preset", "3dgut", "--set", "culling=extent", "--strict", "-o", str(out)]) == 0
        through = ("fisheye", 4, True) if lens == "fisheye" else ("pinhole", 6, True)
        assert set(seen[1:]) == {through}
        assert json.loads((out / "crossval.json").read_text())["verdict"] == "agreement"
        seen.clear()
        assert cli.main([*command, "-o", str(tmp_path / "auto")]) == 0
        assert set(seen) == {("pinhole", None, False), through}  # the path of the lens is tested apart
    finally:
        del sys.modules["taken_down"]


@pytest.mark.slow
def test_the_ladder_goes_through_a_lens():
    """From `3dgut` to `exact`, and from `gsplat` with `3dgut` on the way, the image's shares sum to one."""
    g, camera = _made(0, "opencv")
    found = ladder(g, [camera], PRESET, crop=0, gradients=False)["image"]
    assert "EWA" not in {row["rung"] for row in found["forward"]}
    assert sum(row["share"] for row in found["forward"]) == pytest.approx(1, abs=1e-9)
    start = RenderSettings.preset("gsplat")
    asides = ladder(g, [camera.undistorted()], start, crop=0, gradients=False)["asides"]
    assert 0 < {row["rung"]: row["share"] for row in asides}["3dgut"] < 2


def test_a_lens_is_not_exported(tmp_path):
    """What is written for another machine is pinholes, and a lens is refused in one line."""
    g, camera = _made(0, "opencv")
    with pytest.raises(ValueError, match="cameras that are exported must be pinholes, got a lens or a rolling shutter"):
        rasterizers.export(tmp_path / "scene.npz", g, [camera], BACKGROUND, 0)
    save_ply(g, tmp_path / "scene.ply")
    write_capture(tmp_path / "capture", camera)
    command = ["crossval", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "capture"), "--quiet"]
    assert cli.main([*command, "--preset", "3dgut", "--export", str(tmp_path / "scene.npz")]) == 0


def test_an_image_that_shows_nothing():
    """Where the preset shows Gaussians and the rasterizer none, the rasterizer is told so, and not the cameras."""
    # In a world a thousand times smaller, directions that are not normalized leave nothing of any Gaussian.
    g, camera = _made(0)
    w2c = np.array(camera.w2c)
    w2c[:3, 3] *= 1e-3
    g = g.replace(means=g.means * 1e-3, log_scales=g.log_scales + math.log(1e-3))
    camera = dataclasses.replace(camera, w2c=w2c)

    def nothing(**arguments):
        return torch_rays.broken("plain_directions", RIGHT)(**arguments, near_plane=0.0)

    with pytest.raises(ValueError, match="shows the background alone where preset 3dgut shows some") as error:
        crossval(function(nothing, "nothing"), g, [camera], "3dgut", FIELDS | {"near": 0.0})
    assert "\n" not in str(error.value)
