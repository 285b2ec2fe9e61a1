"""J^T of a view by a deformation network, from sums over the hits of each Gaussian, against a traversal for each image:
the adjoint of the compositor, which has its own tests against float64.
"""

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians
from test_network_information import TIME, swarm

from drgs import fisher
from drgs.dynamics.jacobian import TorchJacobian, scene_jacobian
from drgs.dynamics.lifespans import Lifespans
from drgs.information import network
from drgs.information.network import NetworkInformation, _Reduced, _Rows
from drgs.information.pullback import Pullback
from drgs.information.quantity import ViewContext
from drgs.information.semantics import SemanticMetric
from drgs.settings import RenderSettings
from drgs.tracing.call import Call

SIZE = (21, 13)  # no multiple of a tile
K = 3


def made(n=40, coefficients=4, features=0, seed=0, **options):
    rng = np.random.default_rng(seed)
    g = gaussians(rng, n, coefficients, scale=0.25).detach()
    g = g.replace(quats=g.quats * torch.from_numpy(rng.uniform(0.5, 3, (n, 1))).float())  # of any length
    if features:
        g = g.replace(features=torch.from_numpy(rng.normal(size=(n, features))).float())
    cam = camera(rng, SIZE)
    return swarm(g, **options), dataclasses.replace(cam, time=TIME, w2c=cam.w2c.detach())


def rows_of(scene, cam, settings, semantics=None, mask=None):
    """The rows of a view, each weighted by 1."""
    rows = _Rows.of("fisher.network", ViewContext(scene, cam, settings, mask), NetworkInformation(semantics=semantics))
    return dataclasses.replace(rows, weights=torch.ones_like(rows.weights))


def both(scene, cam, settings, semantics=None, mask=None):
    """Squared slopes of phi along random images, by sums over hits and by a traversal for each image."""
    names = [name for name in scene.parameters() if name.startswith("phi.")]
    seen = scene.at(TIME).detach()
    channels = 3
    if semantics is None:
        seen, deformed = seen.replace(features=None), scene
    else:
        deformed = _Reduced(scene, semantics.directions(seen.features))
        seen = deformed.reduced(seen)
        channels += seen.features.shape[1]
    images = torch.randn(K, cam.width * cam.height, channels, generator=torch.Generator().manual_seed(1))
    pull = Pullback(Call(seen, cam, settings, frozenset(), scene=deformed), names)
    shown = images if mask is None else images * mask.reshape(-1, 1)
    slopes = [pull(x[:, :3], x[:, 3:] if channels > 3 else None) for x in shown]
    want = {name: sum(x[name].square() for x in slopes) for name in names}
    rows = rows_of(scene, cam, settings, semantics, mask)
    jacobian = scene_jacobian(scene, TIME, names)
    assert jacobian.fields <= {"means", "quats", "log_scales", "logit_opacities"}
    return rows.squares_of_hits(jacobian, rows.hit_sums(jacobian, images)), want


def close(found, want):
    """Equal, and not because nothing reaches the image."""
    for group in ("grid", "mlp"):
        assert any(float(x.max()) > 0 for name, x in want.items() if group in name)
    assert found.keys() == want.keys()
    for name, x in found.items():
        assert float((x - want[name]).abs().max()) <= 4e-5 * float(want[name].max()) + 1e-12, name


@pytest.mark.every(3)
@pytest.mark.parametrize("preset", ["exact", "fast", "gsplat", "3dgut"])
def test_slopes_are_those_of_a_traversal_each(preset):
    """Also of colors that depend on the mean, and where some Gaussians stand still."""
    motion = torch.where(torch.arange(40) % 3 == 0, -1.0, 1.0)
    scene, cam = made(motion=motion)
    close(*both(scene, cam, RenderSettings.preset(preset)))


def test_a_mask_multiplies_the_rows():
    """As it does the images."""
    scene, cam = made()
    mask = torch.rand(cam.height, cam.width, generator=torch.Generator().manual_seed(2))
    close(*both(scene, cam, RenderSettings.preset("fast"), mask=mask * (mask > 0.3)))


class Plain:
    """A scene that says nothing of itself but what each has to: torch pulls every image back through its graph."""

    def __init__(self, scene):
        self.scene = scene

    def parameters(self):
        return self.scene.parameters()

    def at(self, time):
        return self.scene.at(time)

    def deform(self, parameters, time):
        return self.scene.deform(parameters, time)


def test_through_the_graph_of_any_scene():
    """The squares that a field finds for all images at once are those of torch's reverse mode, one after another."""
    scene, cam = made(motion=torch.linspace(-1, 2, 40))
    close(*both(Plain(scene), cam, RenderSettings.preset("fast")))
    index = torch.randperm(40, generator=torch.Generator().manual_seed(0))[:25].sort().values
    names = [name for name in scene.parameters() if name.startswith("phi.")]
    plain = TorchJacobian(scene, TIME, names)
    assert plain.fields == scene_jacobian(scene, TIME, names).fields
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,)}
    slopes = {name: torch.randn(5, 25, *shapes[name]) for name in plain.fields}
    want = plain.squared_vjps(index, slopes)
    found = scene_jacobian(scene, TIME, names).squared_vjps(index, slopes)
    for name in names:
        torch.testing.assert_close(found[name], want[name], rtol=1e-5, atol=1e-6 * float(want[name].max()))


def test_through_a_world_and_along_rays():
    """Traversal bvh, and SH that are evaluated along each ray."""
    scene, cam = made(seed=1)
    for settings in (
        RenderSettings.preset("exact", traversal="bvh"),
        RenderSettings.preset("exact", sh_direction="ray"),
    ):
        close(*both(scene, cam, settings))


def test_many_channels_of_features():
    """More semantic channels than one traversal carries beside the colors."""
    scene, cam = made(features=24, seed=2)
    mixed = torch.randn(24, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    metric = SemanticMetric(mixed @ mixed.T, weight=0.5, estimate="exact")
    close(*both(scene, cam, RenderSettings.preset("fast"), metric))


def test_those_that_live_for_a_time():
    """What is there for a time is as opaque as it is then."""
    scene, cam = made(seed=3)
    n = len(scene)
    lives = Lifespans(
        torch.linspace(0, 1, n), torch.full((n,), -1.0), 0.1 * torch.ones(n, 3), torch.zeros(n, 3), torch.zeros(n)
    )
    scene.lifespans = lives
    close(*both(scene, cam, RenderSettings.preset("fast")))


def test_nothing_in_sight():
    """A camera that looks away: slopes of 0, and of the right shapes."""
    scene, cam = made()
    w2c = np.array(cam.w2c.tolist())
    w2c[:3] = np.diag([1.0, -1.0, -1.0]) @ w2c[:3]
    away = dataclasses.replace(cam, w2c=w2c)
    names = ["phi.grid.0", "phi.mlp.means.3.weight"]
    for one in (scene, Plain(scene)):
        rows, jacobian = rows_of(one, away, RenderSettings.preset("exact")), scene_jacobian(one, TIME, names)
        slopes = rows.squares_of_hits(jacobian, rows.hit_sums(jacobian, torch.ones(2, away.width * away.height, 3)))
        assert {name: x.shape for name, x in slopes.items()} == {n: scene.parameters()[n].shape for n in names}
        assert all(float(x.abs().max()) == 0 for x in slopes.values())


class Tinted:
    """A scene of one's own, whose parameter changes colors, not places."""

    def __init__(self, start, tint):
        self.start = start
        self.tint = tint

    def parameters(self):
        return {**self.start.parameters(), "phi.mlp.tint": self.tint}

    def at(self, time):
        return self.deform(self.parameters(), time)

    def deform(self, parameters, time):
        fields = {name: x for name, x in parameters.items() if not name.startswith("phi.")}
        return self.start.replace(**{**fields, "sh": fields["sh"] * parameters["phi.mlp.tint"]})


def test_parameters_that_change_colors_are_asked_by_traversals():
    """Rows are of the geometry; what reaches the image otherwise still has its information."""
    scene, cam = made(seed=4)
    tinted = Tinted(scene.gaussians, torch.ones(3))
    settings = RenderSettings.preset("exact")
    assert scene_jacobian(tinted, TIME, ["phi.mlp.tint"]).fields == {"sh"}
    found = fisher.network(tinted, cam, settings, probes=512)["mlp"]
    assert float(found.min()) > 0
    by_columns = fisher.diagonal(tinted, cam, settings, "columns", groups=["phi.mlp.tint"])["phi.mlp.tint"]
    assert found.tolist() == pytest.approx(by_columns.tolist(), rel=0.25)  # sqrt(2 / 512) is 0.06


def test_more_images_than_are_held(monkeypatch):
    """They go through the view some at a time, and the information is the same."""
    scene, cam = made(seed=5)
    settings = RenderSettings.preset("fast")
    want = fisher.network(scene, cam, settings, probes=3)
    monkeypatch.setattr(network, "_FLOATS", 2 * cam.width * cam.height * 3)
    for group, x in fisher.network(scene, cam, settings, probes=3).items():
        assert float((x - want[group]).abs().max()) <= 1e-5 * float(want[group].abs().max())
