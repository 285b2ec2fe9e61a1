"""The ladder from a rasterizer to exact ray tracing: shares, both orders, scenes in which one rung is all."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import scenes_random
import torch

from drgs import integrator, reference
from drgs.lab.ladder import Pictures, constant_colors, ladder, sequences, table
from drgs.lab.parameters import PARAMETERS
from drgs.settings import RenderSettings

Preset = RenderSettings.preset
EXACT = Preset("exact")


def made(rng, size=(40, 30), **options):
    """A camera without gradients and Gaussians before it."""
    cam = scenes_random.camera(rng, size)
    cam = dataclasses.replace(cam, w2c=cam.w2c.detach().numpy())
    return scenes_random.gaussians(rng, **options).detach(), cam


def by_name(rows):
    return {row["rung"]: row for row in rows}


@pytest.fixture(scope="module")
def report():
    """INRIA's rasterizer on 150 Gaussians, two views, everything on."""
    rng = np.random.default_rng(5)
    g, cam = made(rng, n=150, K=4, scale=0.12)
    other = made(rng)[1]
    start = Preset("inria", background=(0.2, 0.1, 0.4))
    return ladder(g, [cam, other], start, crop=10), g, [cam, other], start


def test_shares_sum_to_one(report):
    """Image and every group, all pixels, crops and far end."""
    found = report[0]
    for part in (found["image"], found["crops"]):
        assert by_name(part["forward"]).keys() - {"rest"} == by_name(part["reverse"]).keys()
    for rows in (*(found[p][o] for p in ("image", "crops") for o in ("forward", "reverse")), found["far"]["forward"]):
        assert sum(row["share"] for row in rows) == pytest.approx(1, abs=1e-9)
        for name in PARAMETERS:
            assert sum(row["gradient"][name]["share"] for row in rows) == pytest.approx(1, abs=1e-9)
    assert found["image"]["total"]["rms"] > 1e-3
    json.dumps(found, allow_nan=False)


def test_total_is_the_difference_of_the_images(report):
    """Measured apart, all views, gradients with the stated cotangent."""
    found, g, cameras, start = report
    s = EXACT.replace(background=start.background)
    steps = [integrator.render(g, c, s).rgb.double() - integrator.render(g, c, start).rgb.double() for c in cameras]
    square = torch.cat([x.reshape(-1) for x in steps]).square().mean()
    assert found["image"]["total"]["rms"] == pytest.approx(float(square.sqrt()), rel=1e-6)
    rng, total = np.random.default_rng(0), 0
    for c in cameras:
        u = torch.tensor(rng.choice([-1.0, 1.0], (c.height, c.width, 3)))
        for settings, sign in ((s, 1), (start, -1)):
            means = g.means.clone().requires_grad_()
            (integrator.render(g.replace(means=means), c, settings).rgb.double() * u).sum().backward()
            total = total + sign * means.grad.double()
    assert found["image"]["total"]["gradient"]["means"]["norm"] == pytest.approx(float(total.norm()), rel=1e-4)


def test_crops_end_in_the_oracles(report):
    """From float32 at the start to float64 at `exact`, then to the volume, on the stated windows."""
    found, g, cameras, start = report
    s = EXACT.replace(background=start.background)
    ends = {"crops": (start, s), "far": (s, None)}
    for name, (first, last) in ends.items():
        squares = []
        for x, y, w, h in found["crops"]["windows"]:
            if name == "crops":
                a = integrator.render(g, cameras[0], first).rgb[y : y + h, x : x + w].double()
                b = reference.render(g, cameras[0], last, window=(x, y, w, h)).rgb
            else:
                a = reference.render(g, cameras[0], first, window=(x, y, w, h)).rgb
                b = reference.render_volume(g, cameras[0], first, window=(x, y, w, h)).rgb
            squares.append((b - a).square().reshape(-1))
        rms = float(torch.cat(squares).mean().sqrt())
        assert found[name]["total"]["rms"] == pytest.approx(rms, rel=1e-6)
    assert len(found["crops"]["windows"]) == 2


def test_float32_is_tiny(report):
    """Next to everything else; in both orders."""
    found = report[0]["crops"]
    for order in ("forward", "reverse"):
        row = by_name(found[order])["float32"]
        assert 0 < row["rms"] < 1e-6
        assert abs(row["share"]) < 1e-3
        assert all(abs(x["share"]) < 1e-2 for x in row["gradient"].values())


@pytest.mark.parametrize("preset", ["inria", "gsplat", "3dgut", "fast", "mitsuba"])
def test_orders_are_legal_and_meet(preset):
    """Every stop is legal (or it would raise), one rung switches its own fields once, both orders end in `exact`."""
    start = Preset(preset)
    forward, reverse = sequences(start, EXACT)
    assert forward[-1][1] == reverse[-1][1] == EXACT
    assert sorted(n for n, _ in forward) == sorted(n for n, _ in reverse)
    assert len({n for n, _ in forward}) == len(forward)
    if start.response == "ewa":
        names = [n for n, _ in reverse]
        assert names.index("near plane") > names.index("order") > names.index("EWA") > names.index("dilation")
        assert names[-1] == "alpha cut-offs"


def test_dilation_alone(rng):
    """A rasterizer that differs from another in its dilation only: that rung is all of it."""
    g, cam = made(rng, n=30)
    start = RenderSettings(response="ewa", dilation=0.3)
    forward, _ = sequences(start, start.replace(dilation=0.0))
    assert [name for name, _ in forward] == ["dilation"]
    # Toward exact: a telescope far away, so that EWA is exact, with one Gaussian, so that order is.
    far = dataclasses.replace(cam, K=np.array([[2e6, 0, 20], [0, 2e6, 15], [0, 0, 1]]), w2c=np.eye(4))
    one = g.take(slice(0, 1)).replace(
        means=torch.tensor([[0.0, 0.0, 1e6]]), log_scales=torch.tensor([[0.5, 0.8, 0.2]]), sh=g.sh[:1, :1]
    )
    found = ladder(one, [far], start, crop=8, volume=False)
    for order in ("forward", "reverse"):
        rows = by_name(found["image"][order])
        assert rows["dilation"]["share"] == pytest.approx(1, abs=1e-3)
        assert rows["EWA"]["of_total"] < 1e-3
        for name in ("means", "log_scales", "logit_opacities", "sh"):
            assert rows["dilation"]["gradient"][name]["share"] == pytest.approx(1, abs=5e-3), name


def test_order_alone(rng):
    """`exact` but for one depth a Gaussian: nothing else can matter."""
    g, cam = made(rng, n=60, scale=0.4)
    found = ladder(g, [cam], EXACT.replace(order="center"), crop=0)
    assert "crops" not in found
    assert "far" not in found
    for order in ("forward", "reverse"):
        assert [row["rung"] for row in found["image"][order]] == ["order"]
        assert found["image"][order][0]["share"] == pytest.approx(1, abs=1e-12)
    assert found["image"]["total"]["rms"] > 1e-3


def test_near_plane_alone(rng):
    """A rasterizer that leaves out what is near, and nothing else does."""
    g, cam = made(rng, n=40)
    z = (g.means @ torch.tensor(cam.w2c[:3, :3].T, dtype=torch.float32) + torch.tensor(cam.w2c[:3, 3]).float())[:, 2]
    start = EXACT.replace(near=float(z.median()))
    found = ladder(g, [cam], start, crop=8, volume=False)
    assert [row["rung"] for row in found["image"]["forward"]] == ["near plane"]
    assert found["image"]["total"]["rms"] > 1e-2


def test_starting_at_exact_has_nothing_to_share(rng):
    """No rungs, no shares, no division by 0; the far end is still there."""
    g, cam = made(rng, n=20)
    found = ladder(g, [cam], EXACT, crop=6)
    assert found["image"]["forward"] == []
    assert found["image"]["total"]["share"] is None
    assert [row["rung"] for row in found["far"]["forward"]] == ["response", "volume"]
    assert "beyond" in table(found)


def test_detached_direction(rng):
    """Same image; the means' gradient is that of colors computed from constants."""
    g, cam = made(rng, n=40, K=9)
    u = torch.tensor(rng.normal(size=(cam.height, cam.width, 3)))
    grads = []
    for detached in (False, True):
        means, sh = (x.clone().requires_grad_() for x in (g.means, g.sh))
        moving = g.replace(means=means, sh=sh)
        out = integrator.render(constant_colors(moving, cam) if detached else moving, cam, EXACT).rgb.double()
        grads.append((out.detach(), *torch.autograd.grad((out * u).sum(), (means, sh))))
    (image, means, sh), (same, without, sh_too) = grads
    torch.testing.assert_close(same, image, rtol=0, atol=1e-6)
    torch.testing.assert_close(sh_too, sh, rtol=1e-3, atol=1e-4)
    assert float((means - without).norm() / means.norm()) > 1e-3
    # The oracle's word: colors that do not know the mean.
    center = torch.tensor(cam.center)
    fixed = g.means.double() - center
    leaf = g.means.double().clone().requires_grad_()
    drawn = g.replace(means=leaf)
    colors = reference.sh_basis(fixed / fixed.norm(dim=1, keepdim=True), 9)[..., None].mul(g.sh.double()).sum(1)
    flat = drawn.replace(sh=((0.5 + colors).clamp(min=0) - 0.5)[:, None] * np.sqrt(4 * np.pi))
    want = torch.autograd.grad((reference.render(flat, cam, EXACT).rgb * u).sum(), leaf)[0]
    assert float((without.double() - want).norm() / want.norm()) < 1e-3


def test_shared_pictures_and_table(rng):
    """A second start reuses what it has in common; `advance` counts what is computed; the table has every rung."""
    g, cam = made(rng, n=30, size=(20, 16))
    calls = []
    pictures = Pictures(g, [cam], 6, advance=lambda: calls.append(1))
    found = ladder(g, [cam], Preset("fast"), volume=False, pictures=pictures)
    first = len(calls)
    ladder(g, [cam], Preset("fast"), volume=False, pictures=pictures)
    assert len(calls) == first > 10
    ladder(g, [cam], Preset("fast", extent=2.5), volume=False, pictures=pictures)
    assert first < len(calls) < 2 * first
    text = table(found)
    for row in (*found["image"]["forward"], *found["crops"]["forward"], *found["asides"]):
        assert f"| {row['rung']} |" in text


def test_no_gradients(rng):
    """Images only."""
    g, cam = made(rng, n=10, size=(12, 9))
    found = ladder(g, [cam], Preset("fast"), crop=64, gradients=False)
    assert found["crops"]["windows"] == [[0, 0, 12, 9]]
    assert found["groups"] == []
    assert all(row["gradient"] == {} for row in found["image"]["forward"])
    assert table(found)


def test_bad_arguments(rng):
    """One line each."""
    g, cam = made(rng, n=3)
    with pytest.raises(ValueError, match="ladder: there must be a camera and a Gaussian, got 0 and 3"):
        ladder(g, [], EXACT)
    with pytest.raises(ValueError, match="ladder: crop must be >= 0"):
        ladder(g, [cam], EXACT, crop=-1)
    with pytest.raises(ValueError, match="both ends must share background"):
        sequences(EXACT, EXACT.replace(background=(1, 1, 1)))
