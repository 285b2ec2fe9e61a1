"""`meta["means2d"]` is in the graph: its gradient is gsplat's, and gsplat's own density control runs on it."""

import pytest
import torch
from test_rasterize import arguments, needs_gsplat

import drgs


def losses(image, alpha):
    """A loss whose gradient differs from pixel to pixel."""
    make = torch.Generator().manual_seed(1)
    weights = torch.randn(image.shape, generator=make, dtype=torch.float64)
    return (image.double() * weights).sum() + alpha.double().square().sum()


@needs_gsplat
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_gradient_is_gsplats(mode, rasterize_mode):
    """In pixels, of every Gaussian and camera, that of gsplat's own torch code."""
    from examples import gsplat_torch

    given, options = arguments(cameras=2), {"render_mode": mode, "rasterize_mode": rasterize_mode}
    found = []
    for call in (drgs.rasterization, gsplat_torch.rasterization):
        means = given["means"].clone().requires_grad_()
        image, alpha, meta = call(**{**given, "means": means}, packed=False, **options)
        meta["means2d"].retain_grad()
        losses(image, alpha).backward()
        found.append((meta["means2d"], means.grad))
    (ours, own), (theirs, their_own) = found
    drawn = theirs.grad.abs().sum(-1) > 0
    assert float(drawn.double().mean()) > 0.3
    torch.testing.assert_close(ours[drawn], theirs[drawn], rtol=1e-6, atol=1e-6)
    assert float((ours.grad - theirs.grad).norm() / theirs.grad.norm()) < 2e-4
    assert float((own - their_own).norm() / their_own.norm()) < 2e-4


def test_leading_axes_have_gradients_too():
    """(2, C, N, 2), each scene's own."""
    given = arguments(n=20, cameras=2)
    both = {k: torch.stack([x, x]) if isinstance(x, torch.Tensor) else x for k, x in given.items()}
    found = []
    for each in (given, both):
        means = each["means"].clone().requires_grad_()
        image, _, meta = drgs.rasterization(**{**each, "means": means}, far_plane=5.0)
        image.square().sum().backward()
        found.append(meta["means2d"].grad)
    assert found[1].shape == (2, 2, 20, 2)
    assert float(found[0].abs().max()) > 0
    for half in found[1]:
        torch.testing.assert_close(half, found[0], rtol=1e-5, atol=1e-5)


def test_without_a_gradient_there_is_none():
    """No graph where none is asked for, along rays, and within torch.func."""
    given = arguments(n=10)
    assert not drgs.rasterization(**given)[2]["means2d"].requires_grad
    means = given["means"].clone().requires_grad_()
    assert not drgs.rasterization(**{**given, "means": means}, with_eval3d=True)[2]["means2d"].requires_grad
    with torch.no_grad():
        assert not drgs.rasterization(**{**given, "means": means})[2]["means2d"].requires_grad
    slope = torch.func.grad(lambda x: drgs.rasterization(**{**given, "means": x})[0].square().sum())(given["means"])
    (same,) = torch.autograd.grad(drgs.rasterization(**{**given, "means": means})[0].square().sum(), means)
    torch.testing.assert_close(slope, same, rtol=1e-5, atol=1e-5)


@needs_gsplat
def test_default_strategy_runs():
    """gsplat's DefaultStrategy, unchanged: it reads the gradients, and its first refinement makes more Gaussians."""
    from gsplat.strategy import DefaultStrategy

    given = arguments(n=30, channels=3)
    leaves = {name: given[name].float() for name in ("means", "quats")}
    leaves |= {"scales": given["scales"].float().log(), "opacities": torch.logit(given["opacities"].float())}
    leaves["colors"] = given["colors"].float()
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(x.clone()) for name, x in leaves.items()})
    optimizers = {name: torch.optim.Adam([x], lr=1e-3) for name, x in params.items()}
    strategy = DefaultStrategy(refine_start_iter=0, refine_every=2, grow_grad2d=1e-9, prune_opa=1e-6, verbose=False)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    fixed = {name: given[name].float() for name in ("viewmats", "Ks", "backgrounds")}
    sizes = {"width": given["width"], "height": given["height"]}
    counts = []
    torch.manual_seed(0)
    for step in range(5):
        shape = params["means"], params["quats"], params["scales"].exp(), torch.sigmoid(params["opacities"])
        image, alpha, info = drgs.rasterization(*shape, params["colors"], **fixed, **sizes, packed=False)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        losses(image, alpha).backward()
        assert info["means2d"].grad.shape == (1, len(params["means"]), 2)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        if step == 0:
            assert float(state["grad2d"].max()) > 0
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        counts.append(len(params["means"]))
    assert counts[0] == 30
    assert counts[-1] > 30
