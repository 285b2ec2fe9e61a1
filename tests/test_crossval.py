"""Broken rasterizers are found out, each by its name and its groups, and a correct one is not accused."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch_rasterizer
from torch_rasterizer import DEFECTS

import drgs
from drgs import cli
from drgs.cameras import Camera
from drgs.commands.orbits import scene_orbit
from drgs.commands.values import OrbitShape
from drgs.data.camera_lists import save_cameras_json
from drgs.ellipsoids import Gaussians
from drgs.files import load_ply, save_ply
from drgs.lab import rasterizers
from drgs.lab.crossval import crossval
from drgs.lab.parameters import PARAMETERS, depth_of, posed, raw_of, with_pose
from drgs.lab.rasterizers import function
from drgs.lab.verdicts import central
from drgs.testing import assert_matches, random_scene

pytestmark = pytest.mark.usefixtures("functions_in_float64")

BACKGROUND = (0.3, 0.6, 0.2)
# Documented choices: they are named, and no bug.
CHOSEN = {
    "view_direction_detached": "view direction of SH detached",
    "clamp_passes_gradient": "clamped alpha passes its gradient",
}
# What is wrong for the projection is wrong for the pose, too.
MOVING = ("covariance_off_diagonal", "background_gradient")
# What a report must say of those that draw another image.
CONVENTIONS = {
    "quaternion_order": "quaternion order",
    "rotation_transposed": "rotation",
    "sort_by_distance": "depth sort key",
    "pixel_center": "pixel center",
    "channels_swapped": "channel order",
    "compensated_opacity": "dilation compensation",
    "no_dilation": "dilation",
    "background_ignored": "background",
    "opacity_logits": "activation of opacities",
    "sh_phase": "SH sign",
    "sh_direction_reversed": "SH direction",
    "early_stop": "transmittance_min",
}


def _made(seed):
    """A random scene of the broken rasterizers' own making."""
    s = torch_rasterizer.random_scene(seed)
    g = Gaussians(**{name: s[name].float() for name in PARAMETERS})
    camera = Camera(K=s["K"].numpy(), w2c=s["viewmat"].numpy(), width=s["width"], height=s["height"])
    return g, [camera], tuple(float(x) for x in s["background"])


def _tied(contrast, seed=0):
    """A plane of Gaussians, as good as across the view: float32 depths are equal, float64 order is not the index's.

    `contrast`: of the colors of the plane, which the order makes visible. Behind it and beside it is what ties nowhere.
    """
    rng, plane, others = np.random.default_rng(seed), 24, 12
    n = plane + others
    x, y = np.sort(rng.uniform(-1.6, -0.4, plane)), rng.uniform(-1.2, 1.2, plane)
    means = np.concatenate([np.stack([x, y, np.full(plane, 3.0)], 1), rng.uniform((-1, -2, 2), (3, 2, 7), (others, 3))])
    colors = 0.4 * rng.normal(size=(n, 4, 3))
    colors[:plane] *= contrast
    g = Gaussians(
        means=torch.tensor(means).float(),
        quats=torch.tensor(rng.normal(size=(n, 4))).float(),
        log_scales=torch.tensor(math.log(0.2) + 0.4 * rng.normal(size=(n, 3))).float(),
        logit_opacities=torch.tensor(rng.normal(size=n) - 2.0 * (np.arange(n) < plane)).float(),
        sh=torch.tensor(colors).float(),
    )
    w2c = np.eye(4)
    w2c[:3, :3] = [[1, 0, 1e-9], [0, 1, 0], [-1e-9, 0, 1]]  # the last of the plane is the nearest
    return g, [Camera(K=np.array([[16.0, 0, 12], [0, 16, 10], [0, 0, 1]]), w2c=w2c, width=24, height=20)]


def _check(name, g, cameras, background, preset):
    """A defect is found, as what it is and where it is; nothing else is."""
    defect = DEFECTS[name]
    result = crossval(function(defect.make(), name), g, cameras, preset, {"background": background})
    report, text = result.report, "\n".join(result.lines())
    wrong = {group for group, row in report["groups"].items() if row["verdict"] == "gradient bug"}
    if defect.kind == "gradient" and name in CHOSEN:
        assert result.verdict == "known deviation", text
        known = {group for group, row in report["groups"].items() if row["verdict"] == "known deviation"}
        assert known, text
        assert known <= {*defect.groups, "viewmats"}, text
        assert CHOSEN[name] in text
        assert not report["conventions"], text
    elif defect.kind in ("gradient", "beside"):
        assert result.verdict == "gradient bug", text
        assert wrong == {*defect.groups, *(["viewmats"] if name in MOVING else [])}, text
        assert not report["not_offered"], text
        assert not report["conventions"], text
    else:
        assert result.verdict == "other convention", text
        assert [c["name"] for c in report["conventions"]] == [CONVENTIONS[name]], text
        assert all(row["verdict"] == "agreement" for row in report["groups"].values()), text


@pytest.mark.every(5)
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param(name, seed, marks=[pytest.mark.slow] if seed == 2 else [])
        for name, d in DEFECTS.items()
        for seed in range(1 if d.kind == "beside" else 3)
    ],
)
def test_every_defect_is_named(name, seed):
    """What is broken is named with the right groups and kind, on three random scenes (one for pose and channels)."""
    _check(name, *_made(seed), "gsplat")


@pytest.mark.every(3)
@pytest.mark.parametrize("preset", ["gsplat", "auto"])
@pytest.mark.parametrize("seed", range(4))
def test_no_false_alarm(seed, preset):
    """A correct rasterizer agrees, and is recognized."""
    g, cameras, background = _made(seed)
    result = crossval(
        function(torch_rasterizer.rasterization, "correct"), g, cameras, preset, {"background": background}
    )
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert result.report["preset"] == "gsplat"
    assert not result.report["conventions"]
    assert result.report["image"]["after"] < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["early_stop", "quaternion_order", "opacity_detached", "pixel_center"])
def test_preset_is_found_beside_a_defect(name):
    """What a rasterizer claims to be need not be said."""
    g, cameras, background = _made(5)
    result = crossval(function(DEFECTS[name].make(), name), g, cameras, "auto", {"background": background})
    assert result.report["preset"] == "gsplat"
    assert [c["name"] for c in result.report["conventions"]] == ([CONVENTIONS[name]] if name in CONVENTIONS else [])
    assert (result.verdict == "gradient bug") == (name == "opacity_detached")


@pytest.mark.every(7)
@pytest.mark.real_data
@pytest.mark.parametrize("name", ["correct", *DEFECTS])
def test_a_real_scene(data_dir, name):
    """The same on the Gaussians of a real scan that matter most to a small view of it."""
    path = data_dir / "splats" / "wolf" / "wolf.ply"
    if not path.exists():
        pytest.skip(f"no wolf: {path}")
    g = load_ply(path)
    camera = scene_orbit(g, 8, width=48, height=40, fixed=OrbitShape(fov=70, elevation=10.0))[0]
    weight = drgs.render(g, camera, outputs=("visibility",)).visibility
    index = torch.topk(weight, 250).indices
    g = Gaussians(**{field: getattr(g, field)[index] for field in PARAMETERS})
    if name == "correct":
        made = function(torch_rasterizer.rasterization, name)
        result = crossval(made, g, [camera], "gsplat", {"background": BACKGROUND})
        assert result.verdict == "agreement", "\n".join(result.lines())
        return
    # A defect that this view does not show cannot be found in it.
    raw, made = raw_of(g), [function(f, name) for f in (torch_rasterizer.rasterization, DEFECTS[name].make())]
    u = rasterizers.cotangents([camera], 0)[0]
    images = [x.image(raw, camera, BACKGROUND)[0] for x in made]
    gradients = [x.gradient(raw, camera, BACKGROUND, u) for x in made]
    same = all(b is not None and torch.equal(a, b) for a, b in zip(*(x.values() for x in gradients), strict=True))
    if torch.equal(*images) and same:
        pytest.skip("this view does not show it: nothing is clamped, or behind the camera")
    _check(name, g, [camera], BACKGROUND, "gsplat")


def test_what_is_not_offered_is_no_fault():
    """A rasterizer without gradients of poses, and of three channels only, agrees; the report says what it lacks."""
    g, cameras, background = _made(0)

    def fixed(viewmats, colors, sh_degree, **arguments):
        pose = torch.tensor(viewmats.numpy())  # raises if it wants a gradient
        return torch_rasterizer.rasterization(viewmats=pose, colors=colors, sh_degree=sh_degree, **arguments)

    result = crossval(function(fixed, "fixed"), g, cameras, "gsplat", {"background": background})
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert list(result.groups) == list(PARAMETERS)
    text = "\n".join(result.lines())
    assert "not compared: the gradient of viewmats: its image has no gradient of them" in text
    assert "not compared: the gradient of colors: it draws no image of 6 channels" in text


def test_channels_that_do_not_move_the_geometry():
    """Gradients that are right in RGB and lost behind the third channel are named, by group."""
    g, cameras, background = _made(0)

    def split(means, colors, backgrounds, sh_degree=None, **arguments):
        def draw(means, part):
            behind = backgrounds[:, part] if sh_degree is None else backgrounds
            shown = colors[:, part] if sh_degree is None else colors
            return torch_rasterizer.rasterization(
                means=means, colors=shown, backgrounds=behind, sh_degree=sh_degree, **arguments
            )

        image, alpha, info = draw(means, slice(0, 3))
        if sh_degree is None:
            image = torch.cat([image, draw(means.detach(), slice(3, None))[0]], -1)
        return image, alpha, info

    result = crossval(function(split, "split"), g, cameras, "gsplat", {"background": background})
    assert result.verdict == "gradient bug"
    assert [name for name, row in result.groups.items() if row.verdict != "agreement"] == ["means, 6 channels"]


def test_pose_is_differentiated_along_motions():
    """A gradient by the 4x4 matrix, taken along the six motions, is the change of the matrix itself.

    To 1e-6 of it: central differences with a step of 1e-4.
    """
    g, (camera,), _ = _made(1)
    raw, slope = with_pose(raw_of(g)), torch.randn(4, 4, generator=torch.Generator().manual_seed(0)).double()
    (got,) = rasterizers.along_motions(g, [camera], slope[None])
    for k in range(6):
        ends = [posed(raw | {"viewmats": sign * 1e-4 * torch.eye(6).double()[k]}, camera).w2c for sign in (1, -1)]
        for w2c in ends:
            torch.testing.assert_close(w2c[:3, :3] @ w2c[:3, :3].T, torch.eye(3).double(), rtol=0, atol=1e-12)
        assert float(got[k]) == pytest.approx(float((slope * (ends[0] - ends[1])).sum() / 2e-4), rel=1e-6)
    # The second half is a translation by the median depth.
    assert float((ends[0] - ends[1])[:3, 3].norm()) == pytest.approx(2e-4 * depth_of(raw, camera), rel=1e-6)


def test_two_faults_at_once():
    """A convention and a wrong gradient are told apart."""
    broken = torch_rasterizer.rasterizer(
        dataclasses.replace(
            torch_rasterizer.CORRECT,
            **DEFECTS["quaternion_order"].fields,
            **DEFECTS["opacity_detached"].fields,
        )
    )
    g, cameras, background = _made(0)
    result = crossval(function(broken, "both"), g, cameras, "gsplat", {"background": background})
    assert result.verdict == "gradient bug"
    assert [c["name"] for c in result.report["conventions"]] == ["quaternion order"]
    assert [n for n, row in result.report["groups"].items() if row["verdict"] == "gradient bug"] == ["logit_opacities"]


def test_cutoffs_are_fitted():
    """Numbers that are on no list are found."""
    odd = torch_rasterizer.rasterizer(
        dataclasses.replace(torch_rasterizer.CORRECT, dilation=0.17 / 0.3)
    )  # of the usual
    g, cameras, background = _made(1)
    result = crossval(function(odd, "odd"), g, cameras, "gsplat", {"background": background})
    (finding,) = result.report["conventions"]
    assert finding["name"] == "dilation"
    assert abs(result.model.settings.dilation - 0.17) < 2e-3


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_central_differences(dtype):
    """They converge to the derivative, cut-offs and all, and say how well."""
    g, (camera,), background = _made(3)
    raw = raw_of(g)

    def only(**arguments):
        means = arguments["means"]
        if means.dtype != dtype:
            raise TypeError(f"{dtype} only")
        return torch_rasterizer.rasterization(**arguments)

    made = function(only, "only")
    assert made.dtype == dtype
    u = rasterizers.cotangents([camera], 0)[0]
    wanted = made.gradient(raw, camera, background, u)
    entries = {name: torch.topk(wanted[name].abs().reshape(-1), 5).indices.tolist() for name in PARAMETERS}
    own = central(made, raw, camera, background, u, entries)
    there = made.gradient(raw, camera, background, u * own.kept[..., None])
    assert own.kept.double().mean() > 0.8
    for name in PARAMETERS:
        assert len(own.entries[name]) >= 3
        error = (there[name].reshape(-1)[own.entries[name]] - own.values[name]).abs()
        size = own.values[name].abs().max()
        assert (error <= own.uncertainty[name] + 1e-5 * size).double().mean() >= 0.8
        assert error.max() <= (1e-5 if dtype == torch.float64 else 5e-3) * size, name


def test_entries_that_jump_are_left_out():
    """A Gaussian that is there or not: what its own jump leaves says nothing, and is not called agreement."""

    def blinking(means, width, height, **arguments):
        image, alpha, info = torch_rasterizer.rasterization(means=means, width=width, height=height, **arguments)
        shown = (1e5 * means[0, 0]).floor().remainder(2) == 0
        return image * torch.where(shown, 1.0, 0.5), alpha, info

    g, (camera,), background = _made(0)
    made, raw = function(blinking, "blinking"), raw_of(g)
    own = central(made, raw, camera, background, rasterizers.cotangents([camera], 0)[0], {"means": [0]})
    assert own.entries["means"] == []
    assert own.left_out["means"] == 1
    assert not own.kept.all()


@pytest.mark.slow
def test_a_model_beside_another():
    """A rasterizer that is far from what it claims is another model, or undecided; no bug is made up."""
    g, cameras = random_scene(0, count=40, width=32, height=24)
    result = crossval(rasterizers.load_rasterizer("drgs:inria"), g, cameras, "exact", {"background": BACKGROUND})
    assert result.verdict in ("model difference", "undecided"), "\n".join(result.lines())


def test_cameras_that_show_nothing():
    """Nothing is compared where there is nothing to see."""
    g, (camera,) = random_scene(0, count=40, width=32, height=24)
    w2c = np.diag([-1.0, 1, -1, 1]) @ np.array(camera.w2c)
    w2c[2, 3] -= 1000
    away = dataclasses.replace(camera, w2c=w2c)
    with pytest.raises(ValueError, match="must show Gaussians"):
        crossval(function(torch_rasterizer.rasterization, "correct"), g, [away], "gsplat")


@pytest.mark.every(4)
@pytest.mark.parametrize("preset", ["exact", "fast", "inria", "gsplat", "3dgut"])
def test_our_own_presets_agree_with_the_oracle(preset):
    """`drgs:PRESET` is held against float64."""
    g, cameras = random_scene(1)
    result = crossval(rasterizers.load_rasterizer(f"drgs:{preset}"), g, cameras, "auto", {"background": BACKGROUND})
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert result.report["reference"] == "float64 oracle"
    assert result.report["preset"] == preset


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.05, 0.0])
def test_near_ties_are_no_difference(contrast, monkeypatch):
    """Where depths tie within float32 either order is right: it is no convention, and no other model.

    Pixels without ties are compared as ever: there a wrong gradient is still found.
    """
    g, cameras = _tied(contrast)
    ours = rasterizers.load_rasterizer("drgs:gsplat")
    result = crossval(ours, g, cameras, "gsplat", {"background": BACKGROUND})
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert 0 < result.report["near_ties"] < 0.6 * result.report["pixels"]
    assert "hang on near ties" in "\n".join(result.lines())

    def halved(raw, camera, background):
        raw = raw | {"sh": raw["sh"].detach() + 0.5 * (raw["sh"] - raw["sh"].detach())}
        return ours.draw(raw, camera, background)

    wrong = dataclasses.replace(ours, draw=halved)
    found = crossval(wrong, g, cameras, "gsplat", {"background": BACKGROUND}).report["groups"]
    assert [name for name, row in found.items() if row["verdict"] == "gradient bug"] == ["sh"]
    assert "0.5 times" in found["sh"]["why"]

    # If they were not left out, it would be said what is not so: this is what the test is about.
    monkeypatch.setattr(
        "drgs.lab.conventions.ReferenceModel.near_ties", lambda *_: torch.zeros(20, 24, dtype=torch.bool)
    )
    # (Colors of six channels are random: they show the order whatever the contrast is.)
    found = crossval(ours, g, cameras, "gsplat", {"background": BACKGROUND}, channels=0)
    assert found.verdict == "model difference"
    # A tilt of 1e-9 to the other side makes the same order and is taken for a convention, unless there is no contrast.
    assert bool(found.findings) == (contrast > 0)


@pytest.mark.slow
def test_crops_show_something():
    """Of a scene too large for the oracle, each view is looked at where most is seen, and the report says so."""
    g, (camera,) = random_scene(0)
    parts = {name: getattr(g, name) for name in PARAMETERS}
    many = Gaussians(**{name: x.repeat(6, *[1] * (x.dim() - 1)) for name, x in parts.items()})  # six of each
    many = many.replace(means=many.means + torch.randn(len(many), 3, generator=torch.manual_seed(0)) * 0.02)
    # A view eight times as wide and high: what is seen lies in its lower right corner.
    K = np.array(camera.K)
    K[:2, 2] += 120, 96
    wide = dataclasses.replace(camera, K=K, width=160, height=128)
    w2c = np.array(camera.w2c)
    w2c[0, 3] -= 0.5
    away = np.diag([-1.0, 1, -1, 1]) @ np.array(camera.w2c)
    away[2, 3] -= 1000
    cameras = [dataclasses.replace(wide, w2c=x, name=n) for n, x in (("one", wide.w2c), ("empty", away), ("two", w2c))]
    result = crossval(rasterizers.load_rasterizer("drgs:gsplat"), many, cameras, "auto", {"background": BACKGROUND})
    report = result.report
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert report["cameras"] == ["one", "two"]
    assert report["size"] == [32, 32]
    assert [crop["of"] for crop in report["crops"]] == [[160, 128]] * 2
    assert all(crop["x"] >= 80 and crop["y"] >= 64 for crop in report["crops"])
    assert report["of_gaussians"] == len(many) >= report["gaussians"] > 0
    assert all(float(image["rasterizer"].std()) > 0.05 for image in result.images)
    text = "\n".join(report["scope"])
    assert "a crop of 32x32 pixels of 2 views (1 more show nothing) of 160x128, at (" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    "fields",
    [{"response": "integral"}, {"order": "center", "extent": 3.0}, {"traversal": "bvh", "sh_direction": "ray"}],
    ids=lambda f: next(iter(f)),
)
def test_settings_hold_for_both_sides(fields):
    """What --set says changes the rasterizer of ours and the oracle alike."""
    g, cameras = random_scene(2, count=40, width=32, height=24)
    fields = {"background": BACKGROUND, **fields}
    result = crossval(rasterizers.load_rasterizer("drgs:exact", fields=fields), g, cameras, "exact", fields)
    assert result.verdict == "agreement", "\n".join(result.lines())
    assert result.model.settings.background == BACKGROUND


def test_assert_matches():
    """The helper for other people's tests passes what is right, and says what is wrong."""
    results = assert_matches(torch_rasterizer.rasterization, preset="gsplat", seeds=(0, 1))
    assert [r.verdict for r in results] == ["agreement"] * 2
    assert_matches("torch_rasterizer:defect_view_direction_detached", preset="gsplat", seeds=(0,))
    with pytest.raises(AssertionError, match="known deviation"):
        assert_matches(torch_rasterizer.defect_view_direction_detached, preset="gsplat", seeds=(0,), allow=())
    with pytest.raises(AssertionError, match="logit_opacities: gradient bug"):
        assert_matches(torch_rasterizer.defect_opacity_detached, preset="gsplat", seeds=(0,))
    with pytest.raises(ValueError, match="must be among"):
        assert_matches(torch_rasterizer.rasterization, allow=("anything",))
    with pytest.raises(ValueError, match="both be given"):
        assert_matches(torch_rasterizer.rasterization, random_scene()[0])


# ------------------------------------------------------------------------------------ command and files


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with `scene.ply` and `cameras.json` of one view."""
    folder = tmp_path_factory.mktemp("crossval")
    g, cameras = random_scene(0, count=40, width=32, height=24)
    save_ply(g, folder / "scene.ply")
    save_cameras_json(folder / "cameras.json", cameras)
    return folder


def _run(folder, *options, output="out"):
    command = ["crossval", str(folder / "scene.ply"), "--cameras", str(folder / "cameras.json"), "--quiet"]
    return cli.main([*command, "--set", "background=0.3,0.6,0.2", "-o", str(folder / output), *options])


def test_command(folder):
    """Exit codes, JSON and one HTML file that loads nothing."""
    assert _run(folder, "--rasterizer", "torch_rasterizer:rasterization") == 0
    report = json.loads((folder / "out" / "crossval.json").read_text())
    assert report["verdict"] == "agreement"
    assert report["ladder"]
    assert report["scope"] == ["compared: 1 view of 32x24 pixels, 40 Gaussians"]
    page = (folder / "out" / "report.html").read_text()
    assert "agreement" in page
    assert report["scope"][0] in page
    assert "data:image/png;base64," in page
    assert "http://" not in page
    assert "https://" not in page
    assert "<script" not in page
    wrong = ("--no-ladder", "--rasterizer", "torch_rasterizer:defect_opacity_detached")
    assert _run(folder, *wrong, output="wrong") == 1
    page = (folder / "wrong" / "report.html").read_text()
    assert "gradient bug" in page
    assert "its own central differences" in page
    known = ("--no-ladder", "--rasterizer", "torch_rasterizer:defect_view_direction_detached")
    assert _run(folder, *known, output="known") == 0
    assert _run(folder, *known, "--strict", output="known") == 1
    odd = ("--no-ladder", "--rasterizer", "torch_rasterizer:defect_pixel_center")
    assert _run(folder, *odd, output="odd") == 0
    assert _run(folder, *odd, "--strict", output="odd") == 1


def _dump(folder, call, name):
    """What the script for another machine writes, with a rasterizer of ours in place of gsplat."""
    with np.load(folder / "scene.npz") as file:
        s = dict(file)
    raw = {k: torch.tensor(s[k], dtype=torch.float64).requires_grad_() for k in (*PARAMETERS, "viewmat")}
    image, alpha, _ = call(
        raw["means"],
        raw["quats"],
        raw["log_scales"].exp(),
        raw["logit_opacities"].sigmoid(),
        raw["sh"],
        raw["viewmat"],
        torch.tensor(s["K"]).double(),
        int(s["width"]),
        int(s["height"]),
        sh_degree=2,
        backgrounds=torch.tensor(s["background"])[None].double(),
    )
    (image * torch.tensor(s["cotangent"])).sum().backward()
    s |= {"image": image.detach().float().numpy(), "alpha": alpha[..., 0].detach().float().numpy()}
    s |= {f"grad_{k}": np.zeros(x.shape, np.float32) if x.grad is None else x.grad.numpy() for k, x in raw.items()}
    np.savez(folder / name, **s)
    return s


def test_dumps(folder):
    """A file from another machine is compared; a file of something else is refused with one line."""
    assert _run(folder, "--export", str(folder / "scene.npz")) == 0
    arrays = _dump(folder, torch_rasterizer.rasterization, "good.npz")
    assert _run(folder, "--no-ladder", "--rasterizer", str(folder / "good.npz")) == 0
    assert json.loads((folder / "out" / "crossval.json").read_text())["verdict"] == "agreement"
    _dump(folder, torch_rasterizer.defect_opacity_detached, "bad.npz")
    assert _run(folder, "--no-ladder", "--rasterizer", str(folder / "bad.npz")) == 1
    report = json.loads((folder / "out" / "crossval.json").read_text())
    assert report["groups"]["logit_opacities"]["verdict"] == "gradient bug"
    assert report["groups"]["means"]["verdict"] == "agreement"
    assert report["groups"]["viewmats"]["verdict"] == "agreement"
    assert list(report["not_offered"]) == ["colors"]
    np.savez(folder / "turned.npz", **{**arrays, "grad_viewmat": -arrays["grad_viewmat"]})
    assert _run(folder, "--no-ladder", "--rasterizer", str(folder / "turned.npz")) == 1
    report = json.loads((folder / "out" / "crossval.json").read_text())
    assert [k for k, row in report["groups"].items() if row["verdict"] != "agreement"] == ["viewmats"]
    from safetensors.numpy import save_file

    # An export may be written again; a dump, which holds an export's arrays and more, is the user's.
    assert _run(folder, "--export", str(folder / "scene.npz")) == 0
    assert _run(folder, "--export", str(folder / "good.npz")) == 2
    save_file({k: np.atleast_1d(np.ascontiguousarray(x)) for k, x in arrays.items()}, folder / "good.safetensors")
    assert _run(folder, "--no-ladder", "--rasterizer", str(folder / "good.safetensors")) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": lambda x: x + 1}, "of the same scene, cameras and background, its means differs"),
        ({"viewmat": lambda x: x + 0.1}, "its viewmat differs"),
        ({"quats": lambda x: x[:-1]}, "quats must have shape"),
        ({"image": lambda x: x[:, :-1]}, "image must have shape"),
        ({"grad_sh": lambda x: x[:, :1]}, "grad_sh must have shape"),
        ({"grad_viewmat": lambda x: x[:, :3]}, "grad_viewmat must have shape"),
        ({"cotangent": None}, "cotangent is missing"),
        ({"image": lambda x: np.where(np.arange(3) == 1, np.nan, x)}, "image must be finite, is nan at"),
    ],
)
def test_bad_dumps(folder, tmp_path, capsys, change, message):
    """Dumps of other scenes, of wrong shapes, without an array or with NaN: one line, exit code 2, nothing written."""
    assert _run(folder, "--export", str(folder / "scene.npz")) == 0
    arrays = _dump(folder, torch_rasterizer.rasterization, "good.npz")
    for name, f in change.items():
        if f is None:
            del arrays[name]
        else:
            arrays[name] = f(arrays[name])
    np.savez(tmp_path / "dump.npz", **arrays)
    capsys.readouterr()
    assert _run(folder, "--rasterizer", str(folder / "scene.npz"), output="nothing") == 2
    assert "holds the scene alone, as --export writes it" in capsys.readouterr().err
    assert _run(folder, "--rasterizer", str(tmp_path / "dump.npz"), output="nothing") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (folder / "nothing").exists()


def test_nan_gradient_in_a_dump_is_a_finding(folder):
    """A gradient that is not finite is what one looks for."""
    assert _run(folder, "--export", str(folder / "scene.npz")) == 0
    arrays = _dump(folder, torch_rasterizer.rasterization, "good.npz")
    arrays["grad_means"] = arrays["grad_means"].copy()
    arrays["grad_means"][3, 1] = np.nan
    np.savez(folder / "nan.npz", **arrays)
    assert _run(folder, "--no-ladder", "--rasterizer", str(folder / "nan.npz")) == 1
    row = json.loads((folder / "out" / "crossval.json").read_text())["groups"]["means"]
    assert row["why"] == "not finite, first at [3, 1]"


_BAD = """
import torch
def raises(**arguments):
    raise RuntimeError("two\\nlines")
def number(**arguments):
    return 3
def arrays(width, height, **arguments):
    import numpy
    return numpy.zeros((1, height, width, 3)), numpy.zeros((1, height, width, 1)), {}
def shape(width, height, **arguments):
    return torch.zeros(1, width, height, 3), torch.zeros(1, width, height, 1), {}
def constant(width, height, means, **arguments):
    return torch.zeros(1, height, width, 3, dtype=means.dtype), torch.zeros(1, height, width, 1, dtype=means.dtype), {}
def nan(width, height, means, **arguments):
    image, alpha, info = constant(width, height, means)
    return image / 0 + means.sum(), alpha, info
def hole(**arguments):
    image, alpha, info = nan(**arguments)
    image = image.nan_to_num()
    image[0, 5, 3:5, 1] = float("inf")
    return image, alpha, info
def nan_alpha(width, height, means, **arguments):
    image, alpha, info = constant(width, height, means)
    alpha[0, 7, 2:4] = float("nan")
    return image + means.sum(), alpha, info
not_a_function = 3
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bad_rasterizers:raises", "raised RuntimeError: two"),
        ("bad_rasterizers:number", "must return (image, alpha, info), got int"),
        ("bad_rasterizers:arrays", "its image must be a torch tensor, got ndarray"),
        ("bad_rasterizers:shape", "its image must have shape (1, 24, 32, 3)"),
        ("bad_rasterizers:constant", "must be differentiable by torch"),
        ("bad_rasterizers:nan", "its image must be finite"),
        ("bad_rasterizers:hole", "has NaN or Inf in 2 of 768 pixels, first at (3, 5); correct the rasterizer"),
        ("bad_rasterizers:nan_alpha", "its alpha must be finite, view random_0 has NaN or Inf in 2 of 768 pixels"),
        ("bad_rasterizers:not_a_function", "must have a function not_a_function, has raises, number"),
        ("bad_rasterizers:missing", "must have a function missing, has raises, number"),
        ("no_such_module:f", "must be importable, got ModuleNotFoundError"),
        ("drgs:nothing", "must be drgs:ewa or drgs: and one of exact"),
        ("nonsense", "must be drgs:PRESET, gsplat, a file .npz or .safetensors, or package.module:function"),
        ("mine.py", "package.module:function; say mine:FUNCTION in the folder of mine.py"),
        ("missing.npz", "must be a file, there is none"),
        ("scene.txt.npz", "must be a .npz file of arrays"),
    ],
)
def test_bad_rasterizers(folder, tmp_path, monkeypatch, capsys, name, message):
    """What cannot be compared is refused with one line and exit code 2."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "bad_rasterizers.py").write_text(_BAD)
    (tmp_path / "scene.txt.npz").write_text("no archive")
    sys.modules.pop("bad_rasterizers", None)
    assert _run(folder, "--rasterizer", name) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_gsplat_is_asked_for_politely(folder, capsys):
    """Without gsplat, or without a card, one line says what to do."""
    if torch.cuda.is_available():
        pytest.skip("a CUDA card: gsplat may run")
    assert _run(folder, "--rasterizer", "gsplat") == 2
    assert "gsplat" in capsys.readouterr().err


def test_a_function_beside_the_user(folder, tmp_path):
    """A module in the working directory is found by the installed command."""
    tests = Path(torch_rasterizer.__file__).parent
    (tmp_path / "mine.py").write_text(f"import sys; sys.path.append({str(tests)!r}); from torch_rasterizer import *")
    command = ["crossval", str(folder / "scene.ply"), "--cameras", str(folder / "cameras.json"), "--no-ladder"]
    options = ["--rasterizer", "mine:rasterization", "-o", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-m", "drgs", *command, *options], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "agreement" in done.stdout
