"""Arguments of the wrong kind: one sentence that names the function and the argument and says what to pass."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import drgs
from drgs import cli, fisher
from drgs.cameras import intrinsics, look_at
from drgs.gain import information_gain
from drgs.select import select

pytestmark = pytest.mark.core

CAM = drgs.Camera(K=intrinsics(9, 9, 4, 3), w2c=look_at((0, 0, -3), (0, 0, 0), (0, -1, 0)), width=8, height=6)
EXACT = drgs.RenderSettings.preset("exact")


def arrays() -> dict:
    """Two Gaussians as `from_arrays` takes them."""
    return {
        "means": np.zeros((2, 3)),
        "quats": np.eye(4)[:2],
        "scales": np.full((2, 3), 0.1),
        "opacities": np.full(2, 0.5),
        "sh": np.zeros((2, 3)),
    }


G = drgs.Gaussians.from_arrays(**arrays())
RAW = G.parameters()
LISTED = "it takes one view at a time"


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: drgs.render_jvp(G, [CAM, CAM], {}), rf"camera must be a Camera, got a list of 2 \(Camera\); {LISTED}"),
        (lambda: drgs.render(G, [CAM, None]), r"render: camera\[1\] must be a Camera, got None"),
        (lambda: drgs.render(G, []), "render: a list of cameras must have at least one, got none"),
        (
            lambda: drgs.render(G, [CAM, CAM, CAM.resized(8, 4)]),
            rf"must have one image size, got {CAM.width}x{CAM.height} and camera\[2\] with 8x4; render each size",
        ),
        (lambda: drgs.render(CAM, G), "render: gaussians must come first and the camera second"),
        (lambda: drgs.render("scene.ply", CAM), r"must be a Gaussians, got the str 'scene.ply'; drgs.load_ply"),
        (lambda: drgs.render(G.means, CAM), r"gaussians must be a Gaussians, got a Tensor of shape \(2, 3\)"),
        (lambda: drgs.render(G, CAM.w2c), r"camera must be a Camera, got a ndarray of shape \(4, 4\)"),
        (lambda: drgs.render(G, CAM, "exact"), "settings must be a RenderSettings, got the str 'exact'; .*preset"),
        (lambda: drgs.render(G, EXACT, CAM), "camera must be a Camera, got a value of type RenderSettings"),
        (lambda: drgs.render(G, CAM, EXACT, 3), "outputs must be an Iterable, got the int 3"),
        (lambda: drgs.render_jvp(G, CAM, torch.zeros(6)), "tangents must be a Mapping, got a Tensor of shape"),
        (lambda: drgs.render_jvp(G, CAM, {"camera": "x"}), "render_jvp: tangent of camera must be an array of numbers"),
        (lambda: drgs.reference.render(CAM, G, EXACT), "reference.render: gaussians must come first"),
        (lambda: drgs.reference.render(G, CAM, "exact"), "settings must be a RenderSettings, got the str"),
        (lambda: drgs.reference.render_volume(G, 3), "camera must be a Camera, got the int 3"),
        (lambda: drgs.integrator.render_rays(CAM, [0, 0, 0], [0, 0, 1]), "render_rays: gaussians must be a Gaussians"),
        (lambda: drgs.integrator.render_rays(G, "x", [0, 0, 1]), "render_rays: origins must be an array of numbers"),
        (lambda: fisher.diagonal(CAM, G), "fisher.diagonal: gaussians must be a Gaussians, got a value of type Camera"),
        (lambda: fisher.diagonal(G.means, CAM), "fisher.diagonal: tensors must be passed by name, got one by place"),
        (lambda: fisher.diagonal(G, CAM, means=G.means), "must get Gaussians and cameras or the tensors of both"),
        (lambda: fisher.diagonal(means=G.means), "fisher.diagonal: tensors must include quats, as drgs.rasterization"),
        (lambda: fisher.diagonal(packed=True), "tensors must be among means, quats, .* got packed; drop it"),
        (lambda: fisher.diagonal(G, "orbit"), "cameras must be a Camera or a list of them, got the str 'orbit'"),
        (lambda: fisher.diagonal(G, [CAM, None]), r"fisher.diagonal: cameras\[1\] must be a Camera, got None"),
        (lambda: fisher.diagonal(G, CAM, "fast"), "settings must be a RenderSettings"),
        (lambda: fisher.diagonal(G, CAM, channel_weights=2), "channel_weights must be 3 finite numbers"),
        (lambda: fisher.blocks(G, 3), "fisher.blocks: cameras must be a Camera or a list of them, got the int 3"),
        (lambda: fisher.coverage(None, CAM), "fisher.coverage: gaussians must be a Gaussians, got None"),
        (lambda: fisher.variance_map(G, CAM, [1]), "fisher.variance_map: weights must be a Mapping"),
        (lambda: fisher.jacobian_columns(G, CAM, "camera"), "index must be a Mapping, got the str 'camera'"),
        (lambda: fisher.pose_information(G, [CAM]), "pose_information: camera must be a Camera, got a list"),
        (lambda: select(G, CAM.w2c, [CAM]), r"select: candidates\[0\] must be a Camera, got a ndarray"),
        (lambda: select([CAM], [CAM], [CAM]), "select: gaussians must be a Gaussians, got a list of 1"),
        (lambda: select(G, [CAM], None), "select: train must be a Camera or a list of them, got None"),
        (lambda: information_gain(torch.zeros(3), {}, "eig"), "information_gain: candidate must be a Mapping"),
        (lambda: information_gain({}, {}, "eig", 1e-6), "information_gain: prior must be a Prior, got the float 1e-06"),
        (lambda: drgs.load_ply(3), "load_ply: path must be a str or PathLike, got the int 3"),
        (lambda: drgs.save_ply("a.ply", G), "save_ply: gaussians must come first and the path second"),
        (lambda: drgs.save_ply(G, None), "save_ply: path must be a str or PathLike, got None"),
        (lambda: drgs.RenderSettings.preset(EXACT), "RenderSettings.preset: name must be a str"),
        (lambda: dataclasses.replace(CAM, K=[["a"] * 3] * 3), "Camera: K must be an array of numbers, got a list of 3"),
        (lambda: dataclasses.replace(CAM, w2c=None), "Camera: w2c must have shape"),
        (lambda: dataclasses.replace(CAM, distortion=0.1), "Camera: distortion must hold numbers, got the float 0.1"),
        (lambda: dataclasses.replace(CAM, name=7), "Camera: name must be a str, got the int 7"),
        (lambda: drgs.Gaussians(**(RAW | {"means": np.zeros((2, 3))})), "means must be a Tensor, got a ndarray"),
        (lambda: drgs.Gaussians(**(RAW | {"sh": None})), "Gaussians: sh must be a Tensor, got None"),
        (lambda: drgs.Gaussians(**(RAW | {"quats": RAW["quats"].half()})), "quats must be float32 or float64, got"),
        (lambda: drgs.Gaussians(**(RAW | {"sh": RAW["sh"].to("meta")})), "must be on one device, got means on"),
        (lambda: drgs.Gaussians.from_arrays(**(arrays() | {"sh": [[1], [2, 3]]})), "sh must be an array of numbers"),
        (lambda: drgs.Gaussians.from_arrays(**(arrays() | {"means": G})), "means must be an array of numbers"),
    ],
)  # fmt: skip
def test_wrong_kinds_get_a_sentence(call, told):
    """A TypeError, which the command line takes for bad input too: one line, what was wanted, what was got."""
    with pytest.raises((TypeError, ValueError), match=told) as error:
        call()
    assert "\n" not in str(error.value)
    assert isinstance(error.value, ValueError), "the command line would show a traceback"


def test_a_single_name_is_a_list_of_one():
    """`outputs="count"` and `groups="means"` are not taken letter by letter."""
    assert drgs.render(G, CAM, outputs="count").count is not None
    assert set(fisher.diagonal(G, CAM, groups="means")) == {"means"}


def test_the_command_line_shows_one_line(monkeypatch, capsys):
    """An argument of the wrong kind that reaches a function from a command: exit code 2."""
    from test_cli import _command

    _command(monkeypatch, "demo", lambda args: drgs.render(G, []))
    assert cli.main(["demo"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
