"""The rasterizer that `crossval` is tested with, and its broken copies: each is broken as it says and no further."""

import dataclasses
import math
import types

import oracle_rasterizers
import pytest
import torch
import torch_rasterizer as tr

import drgs
from drgs import reference

SEEDS = (0, 1, 2)
KINDS = {kind: [name for name, d in tr.DEFECTS.items() if d.kind == kind] for kind in ("gradient", "convention")}
KINDS["convention"] += [name for name, d in tr.DEFECTS.items() if d.kind == "cutoff"]


def cotangent(seed, scene):
    make = torch.Generator().manual_seed(seed)
    shape = (scene["height"], scene["width"], 3)
    return torch.randint(0, 2, shape, generator=make).to(torch.float64) * 2 - 1


def relative(a, b):
    return float((a.double() - b.double()).norm() / b.double().norm())


def views_of(scene):
    raw = {name: scene[name].float() for name in tr.GROUPS}
    camera = drgs.Camera(
        K=scene["K"].numpy(), w2c=scene["viewmat"].numpy(), width=scene["width"], height=scene["height"]
    )
    background = tuple(scene["background"].tolist())
    return raw, camera, drgs.RenderSettings.preset("gsplat", background=background)


@pytest.mark.parametrize("seed", SEEDS)
def test_image_is_the_numpy_oracles(seed):
    scene = tr.random_scene(seed, n=40, width=40, height=24)
    image, alpha = tr.draw(tr.rasterization, scene)
    arrays = {name: scene[name].numpy() for name in ("means", "quats", "sh", "K")}
    rgb, expected, count, _ = oracle_rasterizers.gsplat(
        **arrays,
        scales=scene["log_scales"].exp().numpy(),
        opacities=torch.sigmoid(scene["logit_opacities"]).numpy(),
        w2c=scene["viewmat"].numpy(),
        width=scene["width"],
        height=scene["height"],
        background=scene["background"].numpy(),
    )
    assert count.max() > 5
    assert float((image - torch.from_numpy(rgb)).abs().max()) < 1e-9
    assert float((alpha - torch.from_numpy(expected)).abs().max()) < 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_image_and_gradient_are_drgs(seed):
    """Its float64 oracle, and its renderer in float32, wherever neither hangs on a near tie."""
    scene = tr.random_scene(seed)
    raw, camera, settings = views_of(scene)
    leaves = {name: x.clone().requires_grad_() for name, x in raw.items()}
    oracle = reference.render(drgs.Gaussians(**leaves), camera, settings)
    good = ~oracle.ambiguous
    assert good.float().mean() > 0.9
    u = cotangent(seed, scene) * good[..., None]
    expected = torch.autograd.grad(oracle.rgb, list(leaves.values()), u)
    exact = oracle.rgb.detach()
    out = drgs.render(drgs.Gaussians(**leaves), camera, settings)
    ours = torch.autograd.grad(out.rgb, list(leaves.values()), u.float())
    image, found = tr.gradients(tr.rasterization, scene, u)
    assert float((image - exact)[good].abs().max()) < 1e-9
    assert float((image - out.rgb.detach())[good].abs().max()) < 1e-5
    for name, x, y in zip(tr.GROUPS, expected, ours, strict=True):
        # The oracle's gradients come back in the parameters' float32.
        assert relative(found[name], x) < 5e-7, name
        assert relative(y, found[name]) < 1e-5, name


def test_float32_stays_float32():
    scene = tr.random_scene(0)
    single = {name: x.float() if isinstance(x, torch.Tensor) else x for name, x in scene.items()}
    image, gradient = tr.gradients(tr.rasterization, single, cotangent(0, scene).float())
    assert image.dtype == torch.float32
    assert all(x.dtype == torch.float32 and torch.isfinite(x).all() for x in gradient.values())
    exact, _ = tr.draw(tr.rasterization, scene)
    assert float((image - exact).abs().median()) < 1e-5


def test_cameras_come_stacked_and_colors_plain():
    """Two cameras at once are each alone; colors (N, 3) are used as they are; unknown options are ignored."""
    a, b = (tr.random_scene(seed) for seed in (0, 1))
    arrays = a["means"], a["quats"], a["log_scales"].exp(), torch.sigmoid(a["logit_opacities"])
    colors = a["sh"][:, 0].abs()

    def draw(views):
        poses, Ks = (torch.stack([x[name] for x in views]) for name in ("viewmat", "K"))
        return tr.rasterization(*arrays, colors, poses, Ks, 48, 40, packed=False)

    both, alpha, _ = draw([a, b])
    assert both.shape == (2, 40, 48, 3)
    assert alpha.shape == (2, 40, 48, 1)
    for i, view in enumerate((a, b)):
        image, _, _ = draw([view])
        assert torch.equal(image[0], both[i])
    ones, alpha, _ = tr.rasterization(*arrays, torch.ones_like(colors), a["viewmat"][None], a["K"][None], 48, 40)
    torch.testing.assert_close(ones, alpha.expand_as(ones), rtol=0, atol=1e-12)


def test_nothing_in_view_is_background():
    scene = tr.random_scene(0)
    scene["means"] = scene["means"] - 100 * scene["viewmat"][2, :3]
    image, gradient = tr.gradients(tr.rasterization, scene, cotangent(0, scene))
    assert torch.equal(image, scene["background"].expand_as(image))
    assert all(not x.any() for x in gradient.values())


def test_degree_beyond_the_coefficients_is_refused():
    s = tr.random_scene(0)
    with pytest.raises(ValueError, match="degree 3 must have more coefficients than 9"):
        tr.rasterization(
            s["means"],
            s["quats"],
            s["log_scales"],
            s["logit_opacities"],
            s["sh"],
            s["viewmat"][None],
            s["K"][None],
            48,
            40,
            sh_degree=3,
        )


def test_every_defect_is_a_function_of_the_module():
    assert len(tr.DEFECTS) >= 20
    for name, defect in tr.DEFECTS.items():
        function = getattr(tr, f"defect_{name}")
        assert isinstance(function, types.FunctionType)
        assert function is tr.broken(name) is defect.make()
        assert len(defect.fields) == 1, name
        assert set(defect.groups) <= {"viewmats", "colors"} if defect.kind == "beside" else set(tr.GROUPS)
        assert bool(defect.groups) == (defect.kind in ("gradient", "beside")), name
        assert defect.words


@pytest.mark.parametrize("name", KINDS["gradient"])
def test_gradient_defect_leaves_the_image_and_changes_its_groups(name):
    for seed in SEEDS:
        scene = tr.random_scene(seed)
        u = cotangent(seed, scene)
        image, right = tr.gradients(tr.rasterization, scene, u)
        same, wrong = tr.gradients(tr.broken(name), scene, u)
        assert torch.equal(same, image)
        for group in tr.GROUPS:
            if group not in tr.DEFECTS[name].groups:
                assert torch.equal(wrong[group], right[group]), (seed, group)
            elif name == "nan_culled":
                bad = wrong[group].isnan().all(1)
                assert bad.any()
                assert torch.equal(wrong[group][~bad], right[group][~bad])
                assert not right[group][bad].any()
            else:
                # Only few pixels are clamped, and there the derivative of exp(-rho^2 / 2) is small.
                least = 1e-6 if name == "clamp_passes_gradient" else 1e-2
                assert relative(wrong[group], right[group]) > least, (seed, group)


@pytest.mark.parametrize("name", KINDS["convention"])
def test_convention_defect_changes_the_image(name):
    for seed in SEEDS:
        scene = tr.random_scene(seed)
        image, _ = tr.draw(tr.rasterization, scene)
        other, _ = tr.draw(tr.broken(name), scene)
        assert float((other - image).abs().max()) > 1e-3, seed


def _uncut(fields, count):
    """A rasterizer without cut-offs, and `count` Gaussians in it, as a function of their raw parameters."""
    without = {"alpha_min": 0.0, "alpha_max": 1.0, "transmittance_min": 0.0, "extend": math.inf}
    function = tr.rasterizer(dataclasses.replace(tr.CORRECT, **{**without, **fields}))
    scene = tr.random_scene(0, n=40, width=8, height=6)
    for name in tr.GROUPS:
        scene[name] = scene[name][20 : 20 + count]
    scene["logit_opacities"] = scene["logit_opacities"].clamp(-1, 1)
    leaves = [scene[name].clone().requires_grad_() for name in tr.GROUPS]
    return lambda *raw: tr.draw(function, {**scene, **dict(zip(tr.GROUPS, raw, strict=True))})[0], leaves


def slope_errors(draw, leaves) -> dict[str, float]:
    """Group -> |<gradient, v> - central difference along v| / (|gradient| |v|), for random v, worst of three."""
    make = torch.Generator().manual_seed(1)
    image = draw(*leaves)
    assert image.detach().std() > 1e-2
    u = torch.randn(image.shape, generator=make, dtype=torch.float64)
    gradient = torch.autograd.grad(image, leaves, u, allow_unused=True, materialize_grads=True)
    errors = {}
    with torch.no_grad():
        for i, name in enumerate(tr.GROUPS):
            for _ in range(3):
                v = torch.randn(leaves[i].shape, generator=make, dtype=torch.float64)
                sides = [draw(*leaves[:i], leaves[i] + h * v, *leaves[i + 1 :]) for h in (1e-5, -1e-5)]
                slope = float(((sides[0] - sides[1]) * u).sum()) / 2e-5
                error = abs(float((gradient[i] * v).sum()) - slope) / max(float(gradient[i].norm() * v.norm()), 1e-12)
                errors[name] = max(error, errors.get(name, 0.0))
    return errors


@pytest.mark.parametrize("name", [None, *KINDS["convention"]])
def test_gradient_agrees_with_its_own_finite_differences(name):
    errors = slope_errors(*_uncut(tr.DEFECTS[name].fields if name else {}, 4))
    assert max(errors.values()) < 1e-7, errors


@pytest.mark.parametrize("name", [x for x in KINDS["gradient"] if x not in ("clamp_passes_gradient", "nan_culled")])
def test_gradient_defect_disagrees_with_its_finite_differences(name):
    """In its groups and in no other. Without a clamp and without culled Gaussians the two left out are no defects."""
    errors = slope_errors(*_uncut(tr.DEFECTS[name].fields, 4))
    for group, error in errors.items():
        assert error > 1e-3 if group in tr.DEFECTS[name].groups else error < 1e-7, (group, errors)
