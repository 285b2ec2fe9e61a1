"""Gaussians that a field moves: the field itself, and images, derivatives and information through it."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.deform import DeformationField, Deltas, DynamicGaussians, FieldConfig
from drgs.dynamics.regularizers import plane_smoothness, time_l1, time_smoothness
from drgs.ellipsoids import DeformableScene, Gaussians
from drgs.integrator import render, render_jvp
from drgs.selection.cache import Cache, camera_key
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast", transmittance_min=1e-10)
SMOOTH = RenderSettings(order="center", extent=8.0, transmittance_min=1e-10)
CONFIG = FieldConfig(channels=3, resolution=4, time_resolution=5, width=8, depth=2, last_std=0.3)


def plain(field: DeformationField, means: torch.Tensor, time: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """The field once more, by `grid_sample` and torch's own layers."""
    low, high = field.grid.bounds.to(means.dtype)
    first, last = field.grid.span.to(means.dtype)
    time = ((time - first) / (last - first)).expand(len(means))
    x = 2 * torch.cat([(means - low) / (high - low), time[:, None]], 1) - 1
    levels, planes = [], list(field.grid)
    for level in range(0, len(planes), 6):
        product = 1
        for plane, axes in zip(planes[level:], ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)), strict=False):
            where = x[None, None][..., list(axes)]
            found = torch.nn.functional.grid_sample(
                plane.movedim(2, 0)[None], where, align_corners=True, padding_mode="border"
            )
            product = product * found[0, :, 0].T
        levels.append(product)
    hidden = field.mlp["trunk"](torch.cat(levels, 1))
    return tuple(field.mlp[name](hidden) for name in ("means", "quats", "log_scales"))


def dynamic(g: Gaussians, motion: torch.Tensor | None = None, config: FieldConfig = CONFIG) -> DynamicGaussians:
    """A scene whose planes of time are no longer 1."""
    means = g.means.detach().double() + torch.from_numpy(g.origin)
    field = DeformationField(config, torch.stack([means.amin(0), means.amax(0)]), (0.0, 2.0))
    draw = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for plane in field.grid:
            plane.copy_(torch.rand(plane.shape, generator=draw) + 0.5)
    return DynamicGaussians(g, field.to(g.means.dtype), motion)


@pytest.fixture
def view(rng):
    """A scene of ten Gaussians, of which seven move, and a camera at a time within a cell."""
    cam = dataclasses.replace(camera(rng, (18, 14)), time=0.7)
    scene = dynamic(gaussians(rng, 10, 4).detach(), torch.linspace(-1, 2.5, 10))
    return scene, dataclasses.replace(cam, w2c=cam.w2c.detach())


def double(scene: DynamicGaussians) -> DynamicGaussians:
    """The same scene in float64."""
    g = scene.gaussians.replace(**{name: x.double() for name, x in scene.gaussians.parameters().items()})
    field = DeformationField(scene.field.config, scene.field.grid.bounds, tuple(scene.field.grid.span.tolist()))
    field.double().load_state_dict(scene.field.state_dict())
    return DynamicGaussians(g, field, None if scene.motion is None else scene.motion.double())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lookup_is_that_of_grid_sample(dtype):
    """Deltas of places inside, on the border and outside, and their gradients, are those by `grid_sample`; forward mode
    is the transpose of reverse mode."""
    field = DeformationField(CONFIG, [[0, -1, 2], [3, 1, 2.5]], (1.0, 3.0)).to(dtype)
    draw = torch.Generator().manual_seed(0)
    means = torch.rand(40, 3, generator=draw, dtype=dtype) * 6 - 2
    means[:2] = field.grid.bounds.to(dtype)
    weights = dict(field.named_parameters())
    inputs = ({name: x.detach() for name, x in weights.items()}, means, torch.tensor(1.3, dtype=dtype))
    leaves = [*weights.values(), *(x.clone().requires_grad_() for x in inputs[1:])]
    # float32: rounding of ten operations; a derivative by a place is larger than the features by the cells' inverse.
    close = {"rtol": 1e-4, "atol": 1e-4} if dtype is torch.float32 else {"rtol": 1e-10, "atol": 1e-12}
    want = plain(field, *leaves[-2:])
    evaluate = lambda *given: tuple(field.evaluate(*given))  # noqa: E731
    found, pull = torch.func.vjp(evaluate, *inputs)
    torch.testing.assert_close(found, want, **close)
    cotangent = tuple(torch.randn(x.shape, generator=draw, dtype=dtype) for x in want)
    slopes = torch.autograd.grad(want, leaves, cotangent)
    by_weights, by_means, by_time = pull(cotangent)
    # Exactly on the border `grid_sample` has the derivative from outside, the field that from inside.
    assert not slopes[-2][:2].any()
    assert by_means[:2].any()
    torch.testing.assert_close(by_means[2:], slopes[-2][2:], **close)
    torch.testing.assert_close([*by_weights.values(), by_time], [*slopes[:-2], slopes[-1]], **close)
    along = {name: torch.randn(x.shape, generator=draw, dtype=dtype) for name, x in weights.items()}
    moved = (along, torch.randn(40, 3, generator=draw, dtype=dtype), torch.tensor(0.7, dtype=dtype))
    _, pushed = torch.func.jvp(evaluate, inputs, moved)
    forward = sum(float((a * b).sum()) for a, b in zip(pushed, cotangent, strict=True))
    pairs = [*((by_weights[name], x) for name, x in along.items()), (by_means, moved[1]), (by_time, moved[2])]
    assert forward == pytest.approx(sum(float((a * b).sum()) for a, b in pairs), rel=10 * close["rtol"])
    assert abs(forward) > 0.1


def test_derivative_by_time_at_a_node():
    """It is that of the next cell, of the last one at the last time; between nodes that of both sides."""
    field = DeformationField(CONFIG, [[0, 0, 0], [1, 1, 1]], (0.0, 2.0)).double()  # nodes at 0, 0.5, 1, 1.5, 2
    draw = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for plane in field.grid:
            plane.copy_(torch.rand(plane.shape, generator=draw))
    means = torch.rand(6, 3, generator=draw, dtype=torch.float64)
    h = 1e-6

    def at(time):
        return torch.cat(tuple(field(means, time)), 1).detach()

    for time, sides in ((0.0, (1,)), (0.5, (1,)), (0.7, (-1, 1)), (2.0, (-1,))):
        _, found = torch.func.jvp(
            lambda t: torch.cat(tuple(field(means, t)), 1), (torch.tensor(time).double(),), (torch.ones(()).double(),)
        )
        for side in sides:
            # One-sided differences: h times the second derivative.
            torch.testing.assert_close(found, (at(time + side * h) - at(time)) / (side * h), rtol=1e-3, atol=1e-4)
    left = (at(0.5) - at(0.5 - h)) / h
    right = (at(0.5 + h) - at(0.5)) / h
    assert float((left - right).abs().max()) > 0.01  # a kink, or the test says nothing


def test_depth_counts_the_layers_of_the_trunk():
    """As many layers as it says, one at least."""
    sizes = {"channels": 3, "resolution": 4, "time_resolution": 5, "width": 8}
    bounds = [[0.0] * 3, [1.0] * 3]
    for depth in (1, 2, 3):
        field = DeformationField(FieldConfig(**sizes, depth=depth), bounds)
        assert sum(isinstance(layer, torch.nn.Linear) for layer in field.mlp["trunk"]) == depth
    for wrong in (0, -1, False):
        with pytest.raises(ValueError, match=r"FieldConfig: depth must be a whole number >= 1, got"):
            FieldConfig(**sizes, depth=wrong)


def test_identity_at_the_start(view):
    """A new field moves nothing at any time, to the bit; its gradients are those of the heads' last layers alone, and
    with `last_std` of all weights."""
    scene, cam = view
    sizes = {"channels": 3, "resolution": 4, "time_resolution": 5, "width": 8}
    for std in (0.0, 1e-4):
        new = dynamic(scene.gaussians, config=FieldConfig(**sizes, last_std=std))
        image = render(new, cam, FAST).rgb
        image.square().sum().backward()
        informed = {name for name, x in new.field.named_parameters() if x.grad is not None and x.grad.any()}
        names = {name for name, _ in new.field.named_parameters()}
        if std == 0:
            there = new.at(1.1).parameters()
            assert all(torch.equal(x, there[name]) for name, x in scene.gaussians.parameters().items())
            assert informed == {f"mlp.{head}.3.{kind}" for head in Deltas._fields for kind in ("weight", "bias")}
        else:
            assert informed == names


def test_still_gaussians_cost_and_change_nothing(view, monkeypatch):
    """Below a gate of 0.5 a Gaussian keeps its bits and the field does not hear of it; above, it moves by 2 gate - 1
    times the field's deltas, continuously from 0; without `motion` by all of them."""
    scene, cam = view
    heard, evaluate = [], DeformationField.evaluate
    monkeypatch.setattr(
        DeformationField,
        "evaluate",
        lambda self, w, means, *rest: heard.append(means) or evaluate(self, w, means, *rest),
    )
    seen, moving = scene.at(cam.time), scene.moving
    assert [int(moving.sum())] == [len(x) for x in heard] == [7]
    everyone = DynamicGaussians(scene.gaussians, scene.field).at(cam.time)
    factor = (2 * torch.sigmoid(scene.motion) - 1).clamp_min(0)[:, None]
    for name in Deltas._fields:
        start, now, fully = (getattr(x, name) for x in (scene.gaussians, seen, everyone))
        assert torch.equal(start[~moving], now[~moving])
        torch.testing.assert_close(now, start + factor * (fully - start))
        assert float((now - start)[moving].detach().abs().amax(1).median()) > 1e-4
    for name in ("logit_opacities", "sh"):
        assert getattr(seen, name) is getattr(scene.gaussians, name)
    nobody = DynamicGaussians(scene.gaussians, scene.field, torch.full((10,), -1.0))
    for name, x in nobody.at(cam.time).parameters().items():
        assert torch.equal(x, scene.gaussians.parameters()[name])


def test_a_field_is_in_world_units(view):
    """Far from 0, with float64 means or an origin of their own, the field sees the same places: `bvh`, which moves the
    world to where the Gaussians are, renders what `tiles` does, and all the image of the scene near 0; derivatives
    by the weights, too."""
    near, cam = view
    far = np.array([1e5, -2e5, 5e4])
    w2c = cam.w2c.clone()
    w2c[:3, 3] -= w2c[:3, :3] @ torch.from_numpy(far)
    there = dataclasses.replace(cam, w2c=w2c)
    g = near.gaussians
    shifted = g.replace(means=g.means.double() + torch.from_numpy(far))
    along = {name: torch.ones_like(near.parameters()[name]) for name in ("phi.grid.0", "phi.mlp.means.3.weight")}
    want = render(near, cam, SMOOTH).rgb
    pushed = render_jvp(near, cam, along, SMOOTH).rgb
    for moved in (shifted, g.replace(origin=far)):
        field = DeformationField(CONFIG, near.field.grid.bounds + torch.from_numpy(far), (0.0, 2.0))
        weights = {k: v for k, v in near.field.state_dict().items() if k != "grid.bounds"}
        field.load_state_dict(weights, strict=False)
        scene = DynamicGaussians(moved, field, near.motion)
        for settings in (SMOOTH, dataclasses.replace(SMOOTH, traversal="bvh")):
            # float32 images; at 2e5 float64 keeps 3e-11 of a place.
            torch.testing.assert_close(render(scene, there, settings).rgb, want, rtol=1e-4, atol=1e-5)
            found = render_jvp(scene, there, {k: v.to(scene.parameters()[k]) for k, v in along.items()}, settings).rgb
            torch.testing.assert_close(found, pushed, rtol=1e-3, atol=1e-3 * float(pushed.abs().max()))


def test_derivatives_of_the_image(view):
    """d image / d phi and d image / d t, forward and reverse, against a float64 path in plain torch (the oracle behind
    `grid_sample`) and against its differences."""
    scene, cam = view
    exact = double(scene)
    phi = {name: x for name, x in exact.parameters().items() if name.startswith("phi.")}

    def image(time):
        g = exact.gaussians
        deltas = plain(exact.field, g.means, time)
        factor = (2 * torch.sigmoid(exact.motion) - 1).clamp_min(0)[:, None]
        moved = {n: getattr(g, n) + factor * d for n, d in zip(Deltas._fields, deltas, strict=True)}
        return reference.render(g.replace(**moved), cam, SMOOTH).rgb

    def image_along(step):
        with torch.no_grad():
            for name, x in phi.items():
                x.add_(step * along[name.removeprefix("phi.")].double())
            return image(time)

    draw = torch.Generator().manual_seed(3)
    time = torch.tensor(cam.time, dtype=torch.float64, requires_grad=True)
    want = image(time)
    cotangent = torch.randn(want.shape, generator=draw, dtype=torch.float64)
    slopes = torch.autograd.grad(want, [*phi.values(), time], cotangent)
    largest = float(max(x.abs().max() for x in slopes))
    # Reverse, through torch.
    leaves = [*(x for n, x in scene.parameters().items() if n in phi), torch.tensor(cam.time, requires_grad=True)]
    out = render(scene.at(leaves[-1]), cam, SMOOTH).rgb
    # float32 against float64: 1e-7 of the image and 3e-6 of the gradients were measured.
    torch.testing.assert_close(out.double(), want, rtol=1e-5, atol=1e-6)
    for found, slope in zip(torch.autograd.grad(out, leaves, cotangent.float()), slopes, strict=True):
        torch.testing.assert_close(found.double(), slope, rtol=1e-4, atol=3e-5 * largest)
    # Forward, through the bridge: along all weights at once, and along the time.
    along = {n.removeprefix("phi."): torch.randn(x.shape, generator=draw).float() for n, x in phi.items()}
    pushed = render_jvp(scene, cam, {"phi": along}, SMOOTH).rgb.double()
    product = sum(float((s * x).sum()) for s, x in zip(slopes, along.values(), strict=False))
    assert float((pushed * cotangent).sum()) == pytest.approx(product, rel=1e-4, abs=1e-4 * largest)
    by_time = render_jvp(scene, cam, {"time": torch.tensor(1.0)}, SMOOTH).rgb.double()
    assert float((by_time * cotangent).sum()) == pytest.approx(float(slopes[-1]), rel=1e-4, abs=1e-4 * largest)
    h = 1e-6  # a kink of ReLU lies within 1e-5
    with torch.no_grad():
        difference = (image(time + h) - image(time - h)) / (2 * h)
    above, below = image_along(h), image_along(-2 * h)
    for found, differs in ((by_time, difference), (pushed, (above - below) / (2 * h))):
        # h^2 times third derivatives, and float32 as above.
        torch.testing.assert_close(found, differs, rtol=1e-4, atol=3e-5 * float(differs.abs().max()))
        assert float(differs.abs().max()) > 0.01
    # K tangents at once, and names as they are in `parameters()`.
    both = {f"phi.{n}": torch.stack([x, 0 * x]) for n, x in along.items()} | {"time": torch.tensor([0.0, 2.0])}
    found = render_jvp(scene, cam, both, SMOOTH).rgb.double()
    torch.testing.assert_close(
        found, torch.stack([pushed, 2 * by_time]), rtol=1e-4, atol=1e-5 * float(pushed.abs().max())
    )


def test_information_knows_time_and_weights(view):
    """Two times at one pose have their own information; the cache gives neither for the other, nor for other
    weights."""
    scene, cam = view
    later = dataclasses.replace(cam, time=1.8)
    groups, cache = ["phi.grid.4", "phi.mlp.trunk.0.weight"], Cache()

    def asked(camera):
        if (kept := cache.find(scene, camera_key(camera))) is not None:
            return kept
        computed = fisher.diagonal(scene, camera, FAST, "probes", groups=groups, probes=2)
        cache.keep(scene, camera_key(camera), computed)
        return computed

    first, second = asked(cam), asked(later)
    for name in groups:
        assert float(first[name].max()) > 0
        assert not torch.allclose(first[name], second[name], rtol=0.01)
    # The plane (t, y) has a row for each node in time: a view tells of those beside its own.
    assert first["phi.grid.4"].flatten(1).any(1).tolist() == [False, True, True, False, False]
    assert second["phi.grid.4"].flatten(1).any(1).tolist() == [False, False, False, True, True]
    assert asked(cam) is first
    assert asked(later) is second
    with torch.no_grad():
        scene.field.grid[0].mul_(1.5)
    assert asked(cam) is not first
    assert (cache.hits, cache.misses) == (2, 3)


def test_what_is_not_finite_is_named(view):
    """NaN in a weight, a gate, a delta or a mean stops at the door, with the name of what was NaN."""
    scene, cam = view
    calls = (
        lambda: render(scene, cam, FAST),
        lambda: render_jvp(scene, cam, {"time": torch.tensor(1.0)}, FAST),
        lambda: fisher.diagonal(scene, cam, FAST, "probes", groups=["phi.grid.0"], probes=1),
    )
    for name in ("phi.grid.3", "phi.mlp.quats.1.bias", "motion", "means"):
        x = scene.parameters()[name]
        with torch.no_grad():
            held = x.clone()
            x[1] = float("nan")
        for call in calls:
            with pytest.raises(
                ValueError, match=rf"^DynamicGaussians\.at: {name} must be finite, got nan at index \[1"
            ):
                call()
        with torch.no_grad():
            x.copy_(held)
    with torch.no_grad():
        scene.parameters()["phi.mlp.means.1.bias"].fill_(100)
        scene.parameters()["phi.mlp.means.3.weight"].fill_(1e38)
    with pytest.raises(ValueError, match=r"^DynamicGaussians\.at: deltas of means must be finite"):
        render(scene, cam, FAST)


def test_bad_input(view):
    """One line each: what must hold, what was got, what to do."""
    scene, cam = view
    box = [[0, 0, 0], [1, 1, 1]]
    for call, message in (
        (lambda: render(scene, dataclasses.replace(cam, time=None), FAST), "the view must have a time, got None; set"),
        (lambda: scene.at(2.1), r"DeformationField: time must be in \[0, 2\], the span of the field, got 2\.1; ask"),
        (lambda: scene.at(float("nan")), "time must be in"),
        (lambda: FieldConfig(resolution=1), "FieldConfig: resolution must be a whole number >= 2, got 1; choose"),
        (lambda: FieldConfig(levels=()), "FieldConfig: levels must be whole numbers >= 1, got"),
        (lambda: FieldConfig.preset("hypernerf"), "preset must be among neu3d, dnerf, got 'hypernerf'"),
        (
            lambda: DeformationField(CONFIG, box[::-1]),
            r"bounds must be \(2, 3\), lowest and highest corner, finite, got",
        ),
        (lambda: DeformationField(CONFIG, [[0, 0, 0], [1, 1, float("inf")]]), "bounds must be"),
        (lambda: DeformationField(CONFIG, box, (1.0, 0.0)), "span must be the first and the last time, finite, got"),
        (lambda: DynamicGaussians(scene.gaussians, scene.field, torch.zeros(3)), "motion must be 10 floats, one a"),
        (lambda: DynamicGaussians(scene.field, scene.gaussians), "gaussians must be"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    tangents = {"phi": {"nothing": torch.zeros(3)}}
    with pytest.raises(ValueError, match="tangents must be named among .* got 'phi.nothing'"):
        render_jvp(scene, cam, tangents, FAST)
    assert isinstance(scene, DeformableScene)


def test_static_scenes_run_no_deformation_code(view, monkeypatch):
    """Gaussians that do not move are rendered and differentiated where neither the field nor its bridge can be
    imported (nor is it with what users import: tests/test_architecture.py)."""
    scene, cam = view
    for name in ("drgs.deform", "drgs.dynamics.hexplane", "drgs.tracing.field"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it raises ImportError
    still, tangent = scene.gaussians, {"means": torch.ones(10, 3)}
    render(still.replace(means=still.means.clone().requires_grad_()), cam, FAST).rgb.sum().backward()
    render_jvp(still, cam, tangent, FAST)
    fisher.diagonal(still, cam, FAST)
    with pytest.raises(ImportError):
        render_jvp(scene, cam, tangent, FAST)


def _far(g):
    return g, [[-1e-3] * 3, [1e-3] * 3], {}  # all means lie outside


def _flat(g):
    return g.replace(means=g.means * torch.tensor([1.0, 1.0, 0.0])), None, {}


def _point(g):
    return g.replace(means=0 * g.means), None, {}


def _alone(g):
    return g.take([0]), None, {}


def _nobody(g):
    return g.take([]), [[0] * 3, [1] * 3], {}


def _wide(g):
    return g, None, {"channels": 512, "levels": (1,)}


def _coarse(g):
    return g, [[-1e30] * 3, [1e30] * 3], {"resolution": 2, "time_resolution": 2, "levels": (1, 2, 4, 8)}


@pytest.mark.parametrize("extreme", [_far, _flat, _point, _alone, _nobody, _wide, _coarse])
def test_extremes(view, extreme):
    """Images, gradients by everything and tangents of the time are finite, at both ends of the span and within; what
    can have a gradient has one."""
    g, bounds, fields = extreme(view[0].gaussians)
    if bounds is None:
        bounds = torch.stack([g.means.amin(0), g.means.amax(0)])
    config = FieldConfig(
        **{"channels": 3, "resolution": 4, "time_resolution": 5, "width": 8, "last_std": 0.1, **fields}
    )
    field = DeformationField(config, bounds, (-1.0, 3.0))
    with torch.no_grad():
        for plane in field.grid:
            plane.add_(0.1 * torch.rand(plane.shape))
    g = g.replace(**{name: x.clone().requires_grad_() for name, x in g.parameters().items()})
    scene = DynamicGaussians(g, field, torch.full((len(g),), 1.0, requires_grad=True))
    for time in (-1.0, 0.3, 3.0):
        cam = dataclasses.replace(view[1], time=time)
        image = render(scene, cam, FAST).rgb
        image.square().sum().backward()
        pushed = render_jvp(scene, cam, {"time": torch.tensor(1.0)}, FAST).rgb
        assert torch.isfinite(image).all()
        assert torch.isfinite(pushed).all()
    slopes = {name: x.grad for name, x in scene.parameters().items() if x.grad is not None}
    assert all(torch.isfinite(x).all() for x in slopes.values())
    if len(g):
        assert all(slopes[f"phi.grid.{k}"].any() for k in range(6))
        assert (
            float(fisher.diagonal(scene, cam, FAST, "probes", groups=["phi.grid.3"], probes=1)["phi.grid.3"].max()) > 0
        )


def test_one_time(view):
    """A field of one time is asked at that one; nothing is known of how it goes on."""
    scene, cam = view
    field = DeformationField(CONFIG, scene.field.grid.bounds, (0.7, 0.7))
    one = DynamicGaussians(scene.gaussians, field)
    assert not torch.equal(one.at(0.7).means, scene.gaussians.means)
    assert not render_jvp(one, cam, {"time": torch.tensor(1.0)}, FAST).rgb.any()
    with pytest.raises(ValueError, match=r"time must be in \[0\.7, 0\.7\], the span of the field, got 0\.8"):
        one.at(0.8)


def test_regularizers():
    """Each is what its formula says in plain torch, value and gradient; 0 for planes that are as smooth as it asks."""
    grid = DeformationField(CONFIG, [[0, 0, 0], [1, 1, 1]]).double().grid
    draw = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for plane in grid:
            plane.copy_(torch.randn(plane.shape, generator=draw))

    def bend(x, axis):
        return torch.diff(x, n=2, dim=axis).square().mean()

    space, times = [x for k, x in enumerate(grid) if k % 6 < 3], [x for k, x in enumerate(grid) if k % 6 >= 3]
    for found, want in (
        (time_smoothness, lambda: sum(bend(x, 0) for x in times)),
        (plane_smoothness, lambda: sum((bend(x, 0) + bend(x, 1)) / 2 for x in space)),
        (time_l1, lambda: sum((1 - x).abs().mean() for x in times)),
    ):
        pairs = [torch.autograd.grad(3 * f, grid, materialize_grads=True) for f in (found(grid), want())]
        torch.testing.assert_close(*pairs)
        torch.testing.assert_close(found(grid), want())
        assert float(want()) > 1
    with torch.no_grad():
        for plane in grid:
            rows, columns = torch.arange(plane.shape[0]), torch.arange(plane.shape[1])
            plane.copy_((1 + 2.0 * rows[:, None] + 3.0 * columns)[..., None])
    assert float(time_smoothness(grid)) < 1e-20
    assert float(plane_smoothness(grid)) < 1e-20
    short = DeformationField(dataclasses.replace(CONFIG, time_resolution=2, resolution=2), [[0, 0, 0], [1, 1, 1]]).grid
    assert float(time_smoothness(short)) == 0.0
    assert float(time_l1(short)) == 0.0
    time_smoothness(short).backward()
