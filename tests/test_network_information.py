"""Fisher information of a deformation network: estimates against the dense Jacobian of a float64 torch path."""

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.deform import DeformationField, DynamicGaussians, FieldConfig
from drgs.information.semantics import SemanticMetric
from drgs.settings import RenderSettings

EXACT = RenderSettings.preset("exact")
BVH = RenderSettings.preset("exact", traversal="bvh")
TIME = 0.4


def swarm(start, std=0.5, dtype=torch.float32, motion=None, seed=0):
    """Gaussians that a field of 190 weights moves, none of whose parts is 0 unless `std` is."""
    config = FieldConfig(channels=2, resolution=3, time_resolution=3, levels=(1,), width=3, last_std=std)
    bounds = torch.stack([start.means.amin(0), start.means.amax(0)])
    field = DeformationField(config, bounds, seed=seed)
    with torch.no_grad():
        for name, x in field.named_parameters():
            if "grid" in name and bool((x == 1).all()):  # as planes of space and time are at the start
                x += 0.3 * torch.rand(x.shape, generator=torch.Generator().manual_seed(7))
    return DynamicGaussians(start, field.to(dtype), motion)


def drawn(seed=0, size=(16, 16), n=8, features=0, **options):
    """A scene that moves and a camera at a time, without a pixel of the oracle's that hangs on a near tie."""
    rng = np.random.default_rng(seed)
    for _ in range(50):
        g, cam = gaussians(rng, n, 1, scale=0.25), camera(rng, size)
        cam = dataclasses.replace(cam, time=TIME, w2c=cam.w2c.detach())
        if features:
            g = g.replace(features=torch.from_numpy(rng.normal(size=(n, features))).float())
        scene = swarm(g.detach(), **options)
        with torch.no_grad():
            out = reference.render(scene.at(TIME), cam, EXACT, tolerance=1e-5)
        if not out.ambiguous.any() and out.count.max() > 1:
            return scene, cam
    raise AssertionError("no scene without ties")


def groups_of(scene):
    """Group -> names."""
    names = [name for name in scene.parameters() if name.startswith("phi.")]
    return {group: [name for name in names if name.startswith(f"phi.{group}.")] for group in ("grid", "mlp")}


def dense(scene, cam, directions=None):
    """Group -> (pixels, C, P) float64 Jacobian by the oracle and torch: colors, and features along directions."""
    names = [name for own in groups_of(scene).values() for name in own]
    leaves = {name: x.detach().double() for name, x in scene.parameters().items()}
    phi = [leaves[name].requires_grad_() for name in names]
    field = DeformationField(scene.field.config, scene.field.grid.bounds).double()
    moved = DynamicGaussians(scene.gaussians, field, scene.motion).deform(leaves, cam.time)
    ends = [getattr(moved, name) for name in ("means", "quats", "log_scales")]
    # In two steps, as the field has no batched derivative: rows by Gaussians, Gaussians by weights.
    middle = [x.detach().requires_grad_() for x in ends]
    out = reference.render(moved.replace(means=middle[0], quats=middle[1], log_scales=middle[2]), cam, EXACT)
    rows = out.rgb if directions is None else torch.cat([out.rgb, out.features @ directions], -1)
    flat = rows.reshape(-1)
    first = torch.autograd.grad(flat, middle, torch.eye(len(flat), dtype=flat.dtype), is_grads_batched=True)
    first = torch.cat([x.flatten(1) for x in first], 1)
    second = [
        torch.autograd.grad(x, phi, retain_graph=True, materialize_grads=True) for end in ends for x in end.flatten()
    ]
    found = [first @ torch.stack([x.flatten() for x in own]) for own in zip(*second, strict=True)]
    by_name = {name: x.reshape(*rows.flatten(0, 1).shape, -1) for name, x in zip(names, found, strict=True)}
    return {group: torch.cat([by_name[name] for name in own], -1) for group, own in groups_of(scene).items()}


@pytest.fixture(scope="module")
def seen():
    """Scene, camera, and the dense Jacobian by group."""
    scene, cam = drawn()
    return scene, cam, dense(scene, cam)


def signs(draw, *shape):
    return torch.randint(0, 2, shape, generator=draw).double() * 2 - 1


def close(found, want, relative=2e-3):
    """Equal up to the float32 image's rounding: a part of the largest entry."""
    assert found.shape == want.shape
    assert float((found - want).abs().max()) <= relative * float(want.abs().max())


def test_columns_are_those_of_float64(seen):
    """d image / d phi through the bridge, forward mode, is that of the oracle behind torch's own field."""
    scene, cam, J = seen
    index, want = {}, []
    for group, names in groups_of(scene).items():
        shapes = [scene.parameters()[name].shape for name in names]
        parts = dict(zip(names, J[group].split([shape.numel() for shape in shapes], -1), strict=True))
        for name in names[::5]:
            place = int(parts[name].square().sum((0, 1)).argmax())
            index[name] = np.array([np.unravel_index(place, scene.parameters()[name].shape)])
            want.append(parts[name][..., place])
    found = fisher.jacobian_columns(scene, cam, index, EXACT).double().flatten(1, 2)
    close(found, torch.stack(want))
    assert float(torch.stack(want).abs().amax((1, 2)).min()) > 1e-3


@pytest.mark.parametrize(
    ("estimate", "mode"), [("diagonal", "reverse"), ("trace", "reverse"), ("trace", "forward"), ("paper", "reverse")]
)
def test_probes_are_what_they_are_said_to_be(seen, estimate, mode):
    """With the same random signs the dense Jacobian gives the same numbers, probe by probe."""
    scene, cam, J = seen
    K, draw = 2, torch.Generator().manual_seed(5)
    flat = {group: x.flatten(0, 1) for group, x in J.items()}
    both = torch.cat(list(flat.values()), 1)
    want = {group: 0.0 for group in J}
    if mode == "forward":
        for group, x in flat.items():
            want[group] = (signs(draw, K, x.shape[1]) @ x.T).square().sum() / K
    elif estimate == "paper":
        v = torch.cat([signs(draw, K, x.shape[1]) for x in flat.values()], 1)
        for group, x in flat.items():
            want[group] = (v @ both.T @ x).square().sum() / K
    else:
        for _ in range(K):
            u = signs(draw, cam.width * cam.height, 3).flatten()
            for group, x in flat.items():
                want[group] = want[group] + (u @ x).square() / K
        if estimate == "trace":
            want = {group: x.sum() for group, x in want.items()}
    found = fisher.network(scene, cam, EXACT, estimate=estimate, mode=mode, probes=K, seed=5)
    assert list(found) == ["grid", "mlp"]
    for group in want:
        assert found[group].dtype == torch.float64
        close(found[group], want[group])


def test_only_what_moves_tells_about_the_field(seen):
    """With a gate for each Gaussian, in between for some: that of the dense Jacobian, where half are still."""
    scene, cam, _ = seen
    gated = swarm(scene.gaussians, motion=torch.tensor([4.0, -4.0, 0.3, -0.3] * 2))
    J = dense(gated, cam)
    u = signs(torch.Generator().manual_seed(0), cam.width * cam.height, 3)
    found = fisher.network(gated, cam, EXACT, probes=1)
    for group, x in J.items():
        close(found[group], torch.einsum("pc,pck->k", u, x).square())
        assert float(x.abs().max()) > 1e-3


def spread(rows):
    """Variance of |rows z|^2 over random signs z, rows (m, n): 2 (|A|^2 - |diag A|^2) of A = rows^T rows."""
    gram = rows @ rows.T if len(rows) < rows.shape[1] else rows.T @ rows
    return 2 * (gram.square().sum() - rows.square().sum(0).square().sum())


def test_means_are_the_traces(seen):
    """Traces in both modes have tr H as their mean, the paper's estimator tr(H^2), which is something else."""
    scene, cam, J = seen
    K, few = 48, 16  # of one traversal
    flat = {group: x.flatten(0, 1) for group, x in J.items()}
    both = torch.cat(list(flat.values()), 1)
    reverse = fisher.network(scene, cam, EXACT, estimate="trace", probes=K)
    forward = fisher.network(scene, cam, EXACT, estimate="trace", mode="forward", probes=few)
    paper = fisher.network(scene, cam, EXACT, estimate="paper", probes=few)
    for group, x in flat.items():
        trace, H = float(x.square().sum()), both.T @ x  # columns of a group
        # 4 standard errors of a mean of K, by the estimator's own variance; 1 of 16,000 fails by chance.
        assert abs(float(reverse[group]) - trace) < 4 * float(spread(x.T) / K) ** 0.5
        assert abs(float(forward[group]) - trace) < 4 * float(spread(x) / few) ** 0.5
        own = 4 * float(spread(H.T) / few) ** 0.5
        assert abs(float(paper[group]) - float(H.square().sum())) < own
        assert not 0.5 < float(H.square().sum()) / trace < 2


def test_errors_fall_with_the_root_of_the_probes(seen):
    """The diagonal is unbiased, and its error is that of K independent probes, for few and for more."""
    scene, cam, J = seen
    flat = torch.cat([x.flatten(0, 1) for x in J.values()], 1)
    H = flat.square().sum(0)
    # Of one probe: Var (J_k u)^2 = 2 (H_k^2 - sum_p J_pk^4).
    sigma = (2 * (H.square() - flat.pow(4).sum(0))).sqrt()
    seeds = {2: range(100, 108), 16: range(200, 206)}
    errors = {}
    for K, own in seeds.items():
        found = [torch.cat(list(fisher.network(scene, cam, EXACT, probes=K, seed=seed).values())) for seed in own]
        z = [((x - H) / sigma * K**0.5)[sigma > 1e-6 * sigma.max()] for x in found]
        errors[K] = float(torch.stack(z).square().mean()) ** 0.5
        if K == 2:  # 16 probes, too
            assert float((torch.stack(found).mean(0) - H).abs().div(sigma / 16**0.5 + 1e-12).max()) < 5
    # 1 on average; of 6 or 8 seeds, whose entries are correlated, half more. Were errors not to fall, one would be 3.
    assert all(0.5 < x < 1.7 for x in errors.values()), errors


def test_decoded_features_tell_about_the_network():
    """Rows of colors and of decoded features: the sum of both diagonals, the latter in the decoder's metric."""
    scene, cam = drawn(3, (8, 7), features=4)
    decoder = torch.randn(6, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    metric = SemanticMetric(decoder.T @ decoder, weight=0.3)
    J = dense(scene, cam, decoder.T)
    truth = {g: x[:, :3].square().sum((0, 1)) + 0.3 * x[:, 3:].square().sum((0, 1)) for g, x in J.items()}
    P = metric.directions(scene.gaussians.features)
    reduced = dense(scene, cam, P)
    K, draw = 3, torch.Generator().manual_seed(0)
    want = dict.fromkeys(J, 0.0)
    scale = torch.tensor([1.0] * 3 + [0.3**0.5] * P.shape[1], dtype=torch.float64)
    for _ in range(K):
        u = signs(draw, cam.width * cam.height, 3 + P.shape[1]) * scale
        want = {g: want[g] + torch.einsum("pc,pck->k", u, x).square() / K for g, x in reduced.items()}
    found = fisher.network(scene, cam, EXACT, probes=K, semantics=metric)
    for group, x in reduced.items():
        told = (x * scale[:, None]).square().sum((0, 1))
        torch.testing.assert_close(told, truth[group])  # few channels, the same squares
        close(found[group], want[group])
    alone = fisher.network(scene, cam, EXACT, probes=K)
    none = fisher.network(scene, cam, EXACT, probes=K, semantics=metric, channel_weights=(0, 0, 0))
    assert float(none["mlp"].sum()) > 0
    assert not torch.allclose(alone["mlp"], found["mlp"])


@pytest.mark.parametrize("settings", [EXACT, BVH], ids=["tiles", "bvh"])
def test_double_scenes_far_from_zero(settings):
    """In float64 and a world that is moved to the camera before it is traced, H is that of the same scene near 0."""
    scene, cam = drawn(1)
    near = fisher.network(scene, cam, EXACT, probes=1)
    far = torch.tensor([1000.0, -500.0, 250.0], dtype=torch.float64)
    g = scene.gaussians.replace(**{n: x.double() for n, x in scene.gaussians.parameters().items()})
    moved = swarm(g.replace(means=g.means + far), dtype=torch.float64)
    w2c = np.array(cam.w2c.tolist())
    w2c[:3, 3] -= w2c[:3, :3] @ far.numpy()
    found = fisher.network(moved, dataclasses.replace(cam, w2c=w2c), settings, probes=1)
    for group in near:
        close(found[group], near[group], 2e-3)


def test_views_add_up_and_a_view_twice_is_twice_as_much(seen):
    """The same signs in each view: sums over views are sums of views, and equal views say the same."""
    scene, cam, _ = seen
    later = dataclasses.replace(cam, time=0.9)
    one, other = (fisher.network(scene, x, EXACT, probes=2)["mlp"] for x in (cam, later))
    torch.testing.assert_close(fisher.network(scene, [cam, later], EXACT, probes=2)["mlp"], one + other)
    torch.testing.assert_close(fisher.network(scene, [cam, cam], EXACT, probes=2)["mlp"], 2 * one)
    assert not torch.allclose(one, other, rtol=0.1)  # two times at one pose have their own information


@pytest.mark.parametrize("estimate", ["diagonal", "trace", "paper"])
def test_masks_weigh_rows(seen, estimate):
    """With the same random signs half of the light is a quarter of the information, none is none, and one channel of
    one pixel is one row of J.
    """
    scene, cam, J = seen
    ask = lambda **x: fisher.network(scene, cam, estimate=estimate, probes=2, **x)  # noqa: E731
    whole, power = ask(), 4 if estimate == "paper" else 2
    row = torch.zeros(cam.height * cam.width)
    brightest = int(torch.cat([x.square().sum((1, 2))[None] for x in J.values()]).sum(0).argmax())
    row[brightest] = 0.5
    one = {"channel_weights": (1.0, 0.0, 0.0), "masks": [row.reshape(cam.height, cam.width)]}
    for name, x in ask(**one).items():
        own = 0.25 * J[name][brightest, 0].square()
        if estimate == "paper":  # tr(H^2) of a single row g is |g|^4
            continue
        close(x, own if estimate == "diagonal" else own.sum())
    for value in (0.5, 0.0):
        found = ask(masks=[torch.full((cam.height, cam.width), value)])
        for name, x in whole.items():
            torch.testing.assert_close(found[name], value**power * x, rtol=1e-5, atol=1e-7)


def test_groups_that_have_none(seen):
    """Heads that are 0 hide the grid and all layers before them; last weights of 1e-4, or a step, show them."""
    scene, cam, _ = seen
    still = swarm(scene.gaussians, std=0.0)
    found = fisher.network(still, cam, EXACT, probes=1)
    assert float(found["grid"].abs().max()) == 0
    assert float(found["mlp"].max()) > 0
    for group, x in fisher.network(swarm(scene.gaussians, std=1e-4), cam, EXACT, probes=1).items():
        assert float(x.max()) > 0, group
    nobody = swarm(scene.gaussians, motion=torch.full((8,), -1.0))
    for estimate in ("diagonal", "paper"):
        for x in fisher.network(nobody, cam, EXACT, estimate=estimate, probes=1).values():
            assert float(x.abs().max()) == 0
    nothing = swarm(scene.gaussians).__class__(scene.gaussians.take([]), scene.field)
    assert float(fisher.network(nothing, cam, EXACT, probes=1)["mlp"].abs().max()) == 0
    assert float(fisher.network_variance_map(nothing, cam, {}, EXACT, probes=1).abs().max()) == 0


def test_groups_fill_while_a_field_is_fitted(seen):
    """After a few steps from the identity every group has information."""
    from drgs import render

    scene, cam, _ = seen
    fitted = swarm(scene.gaussians, std=0.0)
    target = render(scene, cam, EXACT, outputs=()).rgb.detach()
    optimizer = torch.optim.Adam(fitted.field.parameters(), lr=1e-2)
    for _ in range(3):
        optimizer.zero_grad()
        (render(fitted, cam, EXACT, outputs=()).rgb - target).square().mean().backward()
        optimizer.step()
    for group, x in fisher.network(fitted, cam, EXACT, probes=1).items():
        assert float(x.max()) > 0, group


def test_variance_map(seen):
    """The map's mean over probes is sum_k J_pk^2 weights_k in every pixel; its sum with weights of 1 is the trace."""
    scene, cam, J = seen
    K = 16
    weights = {group: torch.rand(x.shape[-1], dtype=torch.float64) for group, x in J.items()}
    found = fisher.network_variance_map(scene, cam, weights, EXACT, probes=K).double().flatten()
    rows = torch.cat([x * weights[group].sqrt() for group, x in J.items()], -1)  # (pixels, 3, P)
    want = rows.square().sum((1, 2))
    error = torch.stack([spread(x) for x in rows]).div(K).sqrt()
    seen_there = want > 1e-3 * want.max()
    z = ((found - want) / error)[seen_there]
    # Pixels are correlated; by their own variance none is 6 standard errors off, and they are 1 on average.
    assert float(z.abs().max()) < 6
    assert 0.4 < float(z.square().mean()) < 2.5
    one = fisher.network_variance_map(scene, cam, {"mlp": torch.ones(J["mlp"].shape[-1])}, EXACT, probes=K)
    trace = fisher.network(scene, cam, EXACT, estimate="trace", mode="forward", probes=K)
    assert float(one.sum()) == pytest.approx(float(J["mlp"].square().sum()), rel=0.5)
    assert float(trace["mlp"]) > 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, c: fisher.network(s.gaussians, c), "scene must have float parameters named phi.grid.* or phi.mlp.*"),
        (lambda s, c: fisher.network(s, c, estimate="hessian"), "estimate must be one of diagonal, trace, paper, got"),
        (lambda s, c: fisher.network(s, c, mode="forward"), "mode of estimate 'diagonal' must be reverse, got 'forw"),
        (lambda s, c: fisher.network(s, c, probes=0), "probes must be a whole number >= 1, got 0; try 16"),
        (lambda s, c: fisher.network(s, []), "there must be at least one camera, got none"),
        (lambda s, c: fisher.network(s, c, channel_weights=(1, 1)), "channel_weights must be 3 finite numbers >= 0"),
        (lambda s, c: fisher.network_variance_map(s, c, {"means": 1}), "weights must be of grid, mlp, got 'means'"),
        (lambda s, c: fisher.network_variance_map(s, c, {"mlp": torch.ones(3)}), r"weights of mlp must have shape"),
    ],
)
def test_refusals(seen, call, message):
    """In one line each."""
    scene, cam, _ = seen
    with pytest.raises(ValueError, match=r"^fisher\.network") as error:
        call(scene, cam)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
