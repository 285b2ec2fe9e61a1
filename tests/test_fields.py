"""Scenes whose Gaussians come out of a network: gradients, tangents and information of its weights."""

from __future__ import annotations

import concurrent.futures
import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import assert_same_sums, camera, gaussians

from drgs import fisher
from drgs.ellipsoids import DeformableScene, Gaussians
from drgs.fisher import SemanticMetric
from drgs.integrator import render, render_jvp
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast", transmittance_min=1e-10)
BVH = RenderSettings.preset("exact", traversal="bvh")


class Swarm:
    """Means that a small network moves, by where they are and when; it is the identity for no scene of the tests."""

    def __init__(self, start: Gaussians, seed: int = 0):
        draw = torch.Generator().manual_seed(seed)
        shapes = {"in.weight": (3, 4), "in.bias": (3,), "out.weight": (3, 3)}
        self.start = start.detach()
        dtype = start.means.dtype
        self.weights = {n: 0.3 * torch.randn(s, generator=draw, dtype=dtype) for n, s in shapes.items()}

    def parameters(self):
        return self.start.parameters() | self.weights

    def at(self, time):
        return self.deform(self.parameters(), time)

    def deform(self, parameters, time):
        p = dict(parameters)
        weights = {name: p.pop(name) for name in self.weights}
        x = torch.cat([p["means"], torch.zeros_like(p["means"][:, :1]) + time], 1)
        hidden = torch.tanh(x @ weights["in.weight"].T + weights["in.bias"])
        return self.start.replace(**{**p, "means": p["means"] + 0.1 * hidden @ weights["out.weight"].T})


@pytest.fixture
def view(rng):
    """A scene and a camera at a time."""
    cam = dataclasses.replace(camera(rng, (18, 14)), time=0.4)
    return Swarm(gaussians(rng, 10, 4)), dataclasses.replace(cam, w2c=cam.w2c.detach())


def test_gradients_pass_the_network(view):
    """Reverse mode through `render(scene)` is torch's through the network, then that of the Gaussians."""
    scene, cam = view
    assert isinstance(scene, DeformableScene)
    assert not isinstance(scene.start, DeformableScene)
    weight = scene.weights["in.weight"].requires_grad_()
    image = render(scene, cam, FAST).rgb
    cotangent = torch.randn(image.shape)
    (found,) = torch.autograd.grad((image * cotangent).sum(), weight)
    there = scene.at(cam.time)
    means = there.means.detach().requires_grad_()
    (slope,) = torch.autograd.grad((render(there.replace(means=means), cam, FAST).rgb * cotangent).sum(), means)
    (want,) = torch.autograd.grad((there.means * slope).sum(), weight)
    assert torch.equal(found, want)


@pytest.mark.parametrize("settings", [FAST, BVH], ids=["tiles", "bvh"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tangents_of_weights(rng, view, settings, dtype):
    """A tangent of a weight is the Gaussians' along what it does to them; other parameters and the pose add to it."""
    scene, cam = view
    scene = Swarm(scene.start.replace(means=scene.start.means.to(dtype)))
    given = {name: torch.randn(scene.parameters()[name].shape, dtype=dtype) for name in ("in.weight", "means", "sh")}
    twist = torch.randn(6)
    found = render_jvp(scene, cam, {**given, "camera": twist}, settings)
    parameters = scene.parameters()
    along = {name: given.get(name, torch.zeros_like(x)) for name, x in parameters.items()}
    moved = torch.func.jvp(lambda p: scene.deform(p, cam.time).parameters(), (parameters,), (along,))[1]
    want = render_jvp(scene.at(cam.time), cam, {**moved, "camera": twist}, settings)
    for name in ("rgb", "alpha", "depth"):
        # The same operations on the same numbers, but that float32 weights pass through float32 tangents.
        torch.testing.assert_close(getattr(found, name), getattr(want, name), rtol=1e-5, atol=1e-5)
    assert float(found.rgb.abs().max()) > 0.01


def test_tangent_is_the_difference(view):
    """Forward mode by a weight is the central difference of images, in float64 means on a smooth scene."""
    scene, cam = view
    settings = RenderSettings(order="center", extent=8.0)
    v, h = torch.randn(3, 3), 2e-3

    def image(step):
        moved = {**scene.parameters(), "out.weight": scene.weights["out.weight"] + step * v}
        return render(scene.deform(moved, cam.time), cam, settings).rgb.double()

    difference = (image(h) - image(-h)) / (2 * h)
    found = render_jvp(scene, cam, {"out.weight": v}, settings).rgb.double()
    # float32 images, 1e-7 / h = 5e-5 a pixel; the third derivative's h^2 is smaller.
    assert float((found - difference).abs().max()) < 2e-3 * float(found.abs().max()) + 2e-4


def test_information_of_weights(view):
    """By columns the squares of the Jacobian's columns; probes have that as their mean."""
    scene, cam = view
    groups = ["in.bias", "out.weight"]
    H = fisher.diagonal(scene, cam, FAST, "columns", groups=groups)
    for name in groups:
        rows = np.argwhere(np.ones(scene.weights[name].shape))
        columns = fisher.jacobian_columns(scene, cam, {name: rows}, FAST).double()
        torch.testing.assert_close(H[name].flatten(), columns.square().sum((1, 2, 3)))
        assert float(H[name].min()) > 0
    still = fisher.diagonal(scene.at(cam.time), cam, FAST)
    assert_same_sums(fisher.diagonal(scene, cam, FAST)["means"], still["means"])
    probed = fisher.diagonal(scene, cam, FAST, "probes", groups=groups, probes=64)
    for name in groups:
        # Relative error sqrt(2 / 64) = 0.18 an entry; four times that of the worst, 1.5 times that of their mean.
        ratio = probed[name] / H[name]
        assert float((ratio - 1).abs().max()) < 0.7, name
        assert abs(float(ratio.mean()) - 1) < 0.27, name


@pytest.mark.parametrize("name", ["camera", "rotations", "w2c", "ray_origins", "ray_directions"])
def test_names_of_the_view_are_refused(view, name):
    """A parameter named like what belongs to the view would be taken for it, and the other way round."""
    scene, cam = view
    scene.parameters = lambda: {**scene.start.parameters(), **scene.weights, name: torch.zeros(6)}
    calls = (
        lambda: render_jvp(scene, cam, {"means": torch.zeros(10, 3)}, FAST),
        lambda: fisher.diagonal(scene, cam, FAST, "probes", groups=["in.bias"], probes=1),
    )
    scene.at = lambda time: scene.start
    for call in calls:
        with pytest.raises(ValueError, match=rf"^scene\.parameters\(\): names .* got '{name}'; rename it, e\.g\. "):
            call()


class Chosen(Swarm):
    """A swarm that only some of its means follow, by a list of integers."""

    chosen = torch.tensor([0, 3, 4])

    def parameters(self):
        return {**super().parameters(), "chosen": self.chosen}

    def deform(self, parameters, time):
        p = dict(parameters)
        chosen = p.pop("chosen")
        moved = super().deform(p, time)
        return moved.replace(means=p["means"].index_copy(0, chosen, moved.means[chosen]))


def test_integers_stay_integers(view):
    """They index in `deform` under every derivative, and have neither tangent nor group."""
    _, cam = view
    scene = Chosen(view[0].start)
    H = {m: fisher.diagonal(scene, cam, FAST, m, groups=["in.bias"], probes=2) for m in ("columns", "probes")}
    assert all(float(x["in.bias"].min()) > 0 for x in H.values())
    with pytest.raises(ValueError, match="tangents must be named among .* got 'chosen'"):
        render_jvp(scene, cam, {"chosen": torch.zeros(3)}, FAST)
    with pytest.raises(ValueError, match="groups must be among .* got 'chosen'"):
        fisher.diagonal(scene, cam, FAST, "columns", groups=["chosen"])


def test_errors_of_a_field_are_told_as_they_are(view):
    """What `deform` refuses arrives as it was said, not as Dr.Jit's error; so does what has no forward mode."""
    scene, cam = view
    told, deform = ValueError("Swarm: time must be at most 1, got 2; wrap it"), scene.deform

    def fails(parameters, time):
        raise told

    calls = (
        lambda: render_jvp(scene, cam, {"in.bias": torch.ones(3)}, FAST),
        lambda: fisher.diagonal(scene, cam, FAST, "probes", groups=["in.bias"], probes=1),
    )
    seen = deform(scene.parameters(), cam.time)
    scene.at, scene.deform = (lambda time: seen), fails
    for call in calls:
        with pytest.raises(ValueError, match=r"^Swarm: time must be") as error:
            call()
        assert error.value is told


def test_threads_take_turns(view):
    """Forward and reverse mode through the bridge from four threads at once give what one thread gives."""
    scene, cam = view
    tangent = {"out.weight": torch.ones(3, 3)}

    def work(_):
        pushed = render_jvp(scene, cam, tangent, FAST).rgb
        return pushed, fisher.diagonal(scene, cam, FAST, "probes", groups=["in.bias"], probes=2)["in.bias"]

    want = work(0)
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        for found in pool.map(work, range(8)):
            # Two threads of Dr.Jit add in any order.
            torch.testing.assert_close(found, want, rtol=1e-4, atol=1e-5)


def test_refusals(view):
    """Closed forms know nothing of a network, and Gaussians have no weights."""
    scene, cam = view
    with pytest.raises(ValueError, match="method of group 'in.bias' must be 'columns' or 'probes', got 'exact'"):
        fisher.diagonal(scene, cam, FAST, groups=["in.bias"])
    with pytest.raises(ValueError, match="groups must be among means"):
        fisher.diagonal(scene.start, cam, FAST, "columns", groups=["in.bias"])
    with pytest.raises(ValueError, match=r"named among means, .* got 'weight'"):
        render_jvp(scene, cam, {"weight": torch.zeros(3)}, FAST)


class Anchored(Swarm):
    """Three anchors, each with copies of itself: its tensors are not as long as its Gaussians', but called the same."""

    copies = 2

    def __init__(self, start):
        super().__init__(start.take(range(3)))

    def deform(self, parameters, time):
        p = dict(parameters)
        for name in self.weights:
            p.pop(name)
        many = {name: torch.cat([x] * self.copies) for name, x in p.items()}
        return Gaussians(
            **{**many, "means": many["means"] * torch.linspace(1, 1.5, len(many["means"])).to(many["means"])[:, None]}
        )


def test_a_name_means_the_scene_everywhere(view):
    """A group of a name in `parameters()` is the scene's tensor, in `diagonal` and in `jacobian_columns`."""
    scene, cam = Anchored(view[0].start.replace(features=torch.ones(10, 4))), view[1]
    groups = ["means", "rotations", "logit_opacities", "features"]
    H = fisher.diagonal(scene, cam, FAST, "columns", groups=groups)
    for name, shape in zip(groups, ((3, 3), (3, 3), (3,), (3, 4)), strict=True):
        columns = fisher.jacobian_columns(scene, cam, {name: np.argwhere(np.ones(shape))}, FAST).double()
        squares = columns[..., 3:] if name == "features" else columns[..., :3]
        torch.testing.assert_close(H[name], squares.square().sum((1, 2, 3)).reshape(shape))
        assert float(H[name].max()) > 0
    probed = fisher.diagonal(scene, cam, FAST, "probes", groups=groups[:3], probes=64)
    for name, found in probed.items():
        assert abs(float(found.sum() / H[name].sum()) - 1) < 0.27, name  # as above
    with pytest.raises(ValueError, match=r"index of means must be rows of 2 integers below \(3, 3\)"):
        fisher.jacobian_columns(scene, cam, {"means": [[3, 0]]}, FAST)
    with pytest.raises(ValueError, match=r"group 'means' must be .* got 'exact'; .* pass scene\.at\(time\)$"):
        fisher.diagonal(scene, cam, FAST, groups=["means"])
    with pytest.raises(ValueError, match="group 'features' must be 'columns', got 'probes'"):
        fisher.diagonal(scene, cam, FAST, "probes", groups=["features"])


class Colored(Swarm):
    """Its network moves features and nothing else."""

    def deform(self, parameters, time):
        p = dict(parameters)
        weights = {name: p.pop(name) for name in self.weights}
        hidden = torch.tanh(p["means"] @ weights["in.weight"].T[:3] + time * weights["in.bias"])
        return self.start.replace(**{**p, "features": p["features"] + hidden @ weights["out.weight"].T})


def test_semantic_information_of_weights(view):
    """Weights that only features depend on are told about by decoded features: by columns, and by probes on average."""
    scene, cam = Colored(view[0].start.replace(features=torch.ones(10, 3))), view[1]
    metric = SemanticMetric(torch.eye(3, dtype=torch.float64))
    groups = ["in.bias", "out.weight"]
    H = fisher.diagonal(scene, cam, FAST, "columns", groups=groups, semantics=metric)
    probed = fisher.diagonal(scene, cam, FAST, "probes", groups=groups, probes=64, semantics=metric)
    for name in groups:
        assert float(H[name].min()) > 0
        assert abs(float((probed[name] / H[name]).mean()) - 1) < 0.27, name  # as above
        assert not fisher.diagonal(scene, cam, FAST, "probes", groups=groups, probes=1)[name].any()


def test_every_sum_takes_scenes_that_move(view):
    """Each camera sees the Gaussians of its time."""
    scene, cam = view
    views = [cam, dataclasses.replace(cam, time=0.9)]
    for summed in (fisher.blocks, fisher.coverage):
        want = sum(summed(scene.at(each.time), each, FAST) for each in views)
        assert_same_sums(summed(scene, views, FAST), want)
    weights = fisher.diagonal(scene, cam, FAST)
    weights = {name: weights[name] for name in ("log_scales", "sh")}
    there = scene.at(cam.time)
    assert_same_sums(*(fisher.variance_map(of, cam, weights, FAST) for of in (scene, there)))
    assert_same_sums(*(fisher.pose_information(of, cam, FAST) for of in (scene, there)))


class Growing(Swarm):
    """At time 0 nobody is there, later the first few."""

    def deform(self, parameters, time):
        return super().deform(parameters, time).take(range(round(10 * time)))


def test_scenes_that_grow(view):
    """What they say about a weight adds up, from an empty view on; there is no sum about their Gaussians."""
    scene, cam = Growing(view[0].start), view[1]
    views = [dataclasses.replace(cam, time=time) for time in (0.0, 0.4, 0.9)]
    late = fisher.diagonal(scene, views[1:], FAST, "columns", groups=["in.bias"])["in.bias"]
    assert float(late.min()) > 0
    assert torch.equal(fisher.diagonal(scene, views, FAST, "columns", groups=["in.bias"])["in.bias"], late)
    for summed in (fisher.diagonal, fisher.blocks, fisher.coverage):
        for some in (views, views[1:]):
            with pytest.raises(ValueError, match=rf"^fisher\.{summed.__name__}: a scene must have as many Gaussians"):
                summed(scene, some, FAST)
