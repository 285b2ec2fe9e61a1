"""What torch can ask of a derivative that the renderer has not: it raises in one sentence, and never vanishes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

import drgs
from drgs import fisher, reference
from drgs.dynamics.hexplane import HexPlane
from drgs.dynamics.regularizers import plane_smoothness, time_l1
from drgs.integrator import render_rays

N = 6
EXACT = drgs.RenderSettings.preset("exact", extent=4.0)
_RNG = np.random.default_rng(5)
G = gaussians(_RNG, N, 1, 2).detach()
CAM = dataclasses.replace(camera(_RNG, (5, 4)))
CAM = dataclasses.replace(CAM, w2c=CAM.w2c.detach())
ORIGINS, DIRECTIONS = torch.tensor([[0.0, 0.0, -4.0]]), torch.tensor([[0.02, 0.01, 1.0], [0.0, 0.0, 1.0]])


class Shifted:
    """Gaussians that move along x: a scene of parameters of its own."""

    def __init__(self, means):
        self.means = means

    def at(self, time):
        """The Gaussians at a time."""
        return G.replace(means=self.means + torch.tensor([0.1 * (time or 0.0), 0, 0]))

    def parameters(self):
        """What `at` computes from."""
        return {"means": self.means}


def _rasterized(means):
    """gsplat's door."""
    viewmats, Ks = CAM.w2c[None].float(), torch.as_tensor(np.array(CAM.K), dtype=torch.float32)[None]
    colors = torch.linspace(0, 1, 3 * N).reshape(N, 3)
    return drgs.rasterization(means, G.quats, G.scales, G.opacities, colors, viewmats, Ks, 5, 4)[0]


DOORS = {
    "rgb": lambda means: drgs.render(G.replace(means=means), CAM, EXACT).rgb,
    "features": lambda means: drgs.render(G.replace(means=means), CAM, EXACT).features,
    "depth": lambda means: drgs.render(G.replace(means=means), CAM, EXACT).depth,
    "two cameras": lambda means: drgs.render(G.replace(means=means), [CAM, CAM], EXACT).rgb,
    "rays": lambda means: render_rays(G.replace(means=means), ORIGINS, DIRECTIONS).rgb,
    "rasterization": _rasterized,
    "a scene that moves": lambda means: drgs.render(Shifted(means), dataclasses.replace(CAM, time=0.5), EXACT).rgb,
}
TWICE = r"render: must be differentiated once, got a derivative of its derivative.*; take central differences"
BATCHED = r"must be computed one at a time, got a batch of torch.func.vmap.*; loop over it.*render_jvp"


def _one_line(error):
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("linear", [True, False], ids=["linear", "squared"])
@pytest.mark.parametrize("door", DOORS)
def test_a_second_derivative_raises(door, linear):
    """A gradient penalty never vanishes, be the loss linear in the image, where cotangents have no graph, or not; what
    asks for a graph and does not use it gets the gradient.
    """

    def loss(means):
        image = DOORS[door](means)
        return image.sum() if linear else image.square().sum()

    means = G.means.clone().requires_grad_()
    (plain,) = torch.autograd.grad(loss(means), means)
    (slope,) = torch.autograd.grad(loss(means), means, create_graph=True)
    assert slope.requires_grad
    assert float(plain.norm()) > 0
    torch.testing.assert_close(slope.detach(), plain, rtol=1e-5, atol=1e-6 * float(plain.abs().max()))
    with pytest.raises(NotImplementedError, match=TWICE) as error:
        slope.square().sum().backward()
    _one_line(error)
    with pytest.raises(NotImplementedError, match=TWICE):
        torch.autograd.grad(torch.autograd.grad(loss(means), means, create_graph=True)[0].sum(), means)


def test_a_second_derivative_raises_by_the_pose_and_the_cotangent():
    """By whatever the derivative depends on: another parameter, the pose, what the image was multiplied by."""
    pose = CAM.w2c.clone().requires_grad_()
    u = torch.ones(4, 5, 3, requires_grad=True)
    logits = G.logit_opacities.clone().requires_grad_()
    out = drgs.render(G.replace(logit_opacities=logits), dataclasses.replace(CAM, w2c=pose), EXACT)
    (slope,) = torch.autograd.grad((out.rgb * u).sum(), logits, create_graph=True)
    for x in (pose, u, logits):
        with pytest.raises(NotImplementedError, match=TWICE):
            torch.autograd.grad(slope.sum(), x, retain_graph=True)


@pytest.mark.every(3)
@pytest.mark.parametrize("door", DOORS)
def test_transforms_of_transforms_raise(door):
    """`torch.func.grad` of `grad` was 0; forward over reverse and reverse over forward had no derivative at all."""
    image = DOORS[door]
    inner = torch.func.grad(lambda means: image(means).sum())
    with pytest.raises(NotImplementedError, match=TWICE) as error:
        torch.func.grad(lambda means: inner(means).square().sum())(G.means)
    _one_line(error)
    v = torch.ones_like(G.means)
    with pytest.raises(NotImplementedError, match=TWICE):
        torch.func.jvp(inner, (G.means,), (v,))
    with pytest.raises(NotImplementedError, match=TWICE):
        torch.func.grad(lambda means: torch.func.jvp(image, (means,), (v,))[1].sum())(G.means)
    means = G.means.clone().requires_grad_()
    with torch.autograd.forward_ad.dual_level():
        dual = image(torch.autograd.forward_ad.make_dual(means, v))
        tangent = torch.autograd.forward_ad.unpack_dual(dual).tangent
    with pytest.raises(NotImplementedError, match=TWICE):
        tangent.sum().backward()


@pytest.mark.parametrize("transform", ["vmap", "jacrev", "jacfwd", "hessian"])
@pytest.mark.parametrize("door", DOORS)
def test_batches_of_torch_func_are_refused(door, transform):
    """In our words, with what to do instead."""
    image, given = DOORS[door], G.means[None].repeat(2, 1, 1) if transform == "vmap" else G.means
    asked = (lambda means: image(means).sum()) if transform == "hessian" else image
    with pytest.raises(NotImplementedError, match=BATCHED) as error:
        getattr(torch.func, transform)(asked)(given)
    _one_line(error)


def test_a_batch_of_cameras_or_cotangents_is_refused():
    """`vmap` over poses, intrinsics and rays, and `is_grads_batched`, whose cotangents are a batch."""
    K = torch.as_tensor(np.array(CAM.K))
    for call, x in (
        (lambda w2c: drgs.render(G, dataclasses.replace(CAM, w2c=w2c), EXACT).rgb, CAM.w2c),
        (lambda K: drgs.render(G, dataclasses.replace(CAM, K=K), EXACT).rgb, K),
        (lambda d: render_rays(G, ORIGINS, d).rgb, DIRECTIONS),
        (lambda v: drgs.render_jvp(G, CAM, {"means": v}, EXACT).rgb, G.means),
    ):
        with pytest.raises(NotImplementedError, match=BATCHED):
            torch.func.vmap(call)(torch.stack([x, x]))
    means = G.means.clone().requires_grad_()
    out = drgs.render(G.replace(means=means), CAM, EXACT).alpha
    with pytest.raises(NotImplementedError, match=BATCHED):
        torch.autograd.grad(out, means, torch.ones(2, *out.shape), is_grads_batched=True)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: drgs.render(G.to("meta"), CAM), "render: means must have numbers, got a tensor of shape"),
        (lambda: render_rays(G, ORIGINS.to("meta"), DIRECTIONS), "render_rays: origins must have numbers"),
        (
            lambda: drgs.render_jvp(G, CAM, {"means": G.means.to("meta")}),
            "render_jvp: tangent of means must have numbers",
        ),
        (lambda: _rasterized(G.means.to("meta")), "rasterization: means must have numbers"),
        (lambda: dataclasses.replace(CAM, w2c=CAM.w2c.to("meta")), "Camera: w2c must have numbers"),
        (lambda: dataclasses.replace(CAM, K=torch.eye(3, device="meta")), r"Camera: K must have .* shape \(3, 3\)"),
        (lambda: fisher.diagonal(G.to("meta"), [CAM]), "means must have numbers"),
        (lambda: reference.render(G.to("meta"), CAM, EXACT), "reference.render: means must have numbers"),
        (
            lambda: drgs.Gaussians.from_arrays(G.means.to("meta"), G.quats, G.scales, G.opacities, G.sh),
            "Gaussians.from_arrays: means must have numbers",
        ),
    ],
)  # fmt: skip
def test_meta_tensors_are_refused(call, told):
    """They have a shape and no numbers."""
    with pytest.raises(
        ValueError, match=told + ".*on the device meta, which has none; make it on cpu or cuda"
    ) as error:
        call()
    _one_line(error)


@pytest.mark.every(3)
@pytest.mark.filterwarnings("ignore::UserWarning:torch")
@pytest.mark.parametrize("door", ["rgb", "rays", "rasterization"])
def test_compiled_code_calls_them_as_they_are(door):
    """Same image, same gradient; `fullgraph=True` is told why it cannot be."""
    loss = lambda means: (2 * DOORS[door](means + 0.01)).sum()  # noqa: E731
    compiled = torch.compile(loss, backend="aot_eager")
    found = []
    for call in (loss, compiled):  # what a first render sets up is no part of a graph
        means = G.means.clone().requires_grad_()
        value = call(means)
        value.backward()
        found.append((value.detach(), means.grad))
    torch.testing.assert_close(found[1], found[0], rtol=1e-5, atol=1e-5)
    torch.compiler.reset()
    with pytest.raises(Exception, match=r"drgs: must be called outside of torch's graphs.*; leave fullgraph out"):
        torch.compile(loss, backend="eager", fullgraph=True)(G.means)
    torch.compiler.reset()


def test_compiled_code_makes_cameras():
    """Intrinsics are not taken for something other than numbers, and the pose has its gradient."""
    K = np.array(CAM.K)

    def loss(w2c):
        return drgs.render(G, drgs.Camera(K=K, w2c=w2c, width=5, height=4), EXACT).rgb.sum()

    found = []
    for call in (loss, torch.compile(loss, backend="aot_eager")):
        pose = CAM.w2c.clone().requires_grad_()
        call(pose).backward()
        found.append(pose.grad)
    torch.compiler.reset()
    torch.testing.assert_close(found[1], found[0], rtol=1e-5, atol=1e-5)


def test_penalties_on_a_field_too():
    """The smoothness of its planes is differentiated once; their distance from 1 has a second derivative, 0."""
    grid = HexPlane(2, (8,), 5, torch.tensor([[-1.0] * 3, [1.0] * 3]).double(), torch.tensor([0.0, 1.0]).double())
    planes = list(grid.parameters())
    with torch.no_grad():
        for x in planes:
            x.add_(torch.linspace(-1, 1, x.numel()).reshape(x.shape).cos())
    slopes = torch.autograd.grad(plane_smoothness(grid), planes, create_graph=True, allow_unused=True)
    with pytest.raises(NotImplementedError, match="must be differentiated once"):
        sum(x.square().sum() for x in slopes if x is not None).backward()
    slopes = torch.autograd.grad(time_l1(grid), planes, create_graph=True, allow_unused=True)
    sum(x.square().sum() for x in slopes if x is not None).backward()
    assert all(x.grad is None or float(x.grad.abs().max()) == 0 for x in planes)


@pytest.mark.parametrize("preset", ["exact", "mitsuba", "fast", "gsplat"])
def test_an_image_is_the_same_with_gradients_and_without(preset):
    """To the bit in exact order; in that of the centers to the rounding of float32 sums, as numerics.md says."""
    g = gaussians(np.random.default_rng(3), 200, 4, 3, scale=0.3)
    cam, settings = camera(np.random.default_rng(4), (24, 20)), drgs.RenderSettings.preset(preset)
    plain = drgs.render(g.detach(), dataclasses.replace(cam, w2c=cam.w2c.detach()), settings, "all")
    graph = drgs.render(g, cam, settings, "all")
    for name in ("rgb", "alpha", "depth", "features", "median_depth", "count", "visibility"):
        a, b = getattr(plain, name), getattr(graph, name).detach()
        exact = preset in ("exact", "mitsuba") and name != "visibility"  # summed by threads, in any order
        if exact or name in ("median_depth", "count"):
            assert torch.equal(a, b), name
        else:
            assert (a - b).abs().max() <= 3e-6 * b.abs().max(), name
