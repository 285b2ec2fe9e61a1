"""The color behind everything: its cells, its information, its variance, and what it is worth in a score."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import assert_same_sums
from test_network_information import drawn

import drgs
from drgs import fisher
from drgs.cameras import Camera, intrinsics_from_fov, look_at, orbit
from drgs.gain import Prior, information_gain, variances
from drgs.information.backdrop import CELLS, Sphere, backdrop_cells, backdrop_sphere
from drgs.information.diagonal import Diagonal
from drgs.information.quantity import ViewContext
from drgs.select import Cache, select
from drgs.settings import RenderSettings

SETTINGS = RenderSettings.preset("exact")


@pytest.fixture(scope="module")
def blob():
    """A single half-open Gaussian at the origin."""
    return drgs.Gaussians.from_arrays([[0.0, 0, 0]], [[1.0, 0, 0, 0]], [[0.3] * 3], [0.8], np.zeros((1, 1, 3)))


@pytest.fixture(scope="module")
def ring():
    return [
        dataclasses.replace(camera, name=f"{i}")
        for i, camera in enumerate(orbit((0, 0, 0), 3.0, 8, width=24, height=18))
    ]


def test_cells_are_about_as_large():
    """Directions all over the sphere fall into all cells; none is more than twice as large as another, and cameras in
    one place that look elsewhere agree about a direction.
    """
    K, size = intrinsics_from_fov(90.0, width=160, height=160), 160
    axes = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    cameras = [Camera(K, look_at((0, 0, 0), axis, np.roll(np.abs(axis), 1)), size, size) for axis in axes]
    solid = np.concatenate([(1 / np.linalg.norm(rays_of(c), axis=-1) ** 3).ravel() for c in cameras])
    areas = np.bincount(np.concatenate([backdrop_cells(c).numpy().ravel() for c in cameras]), solid, CELLS)
    assert areas.min() > 0
    assert areas.max() < 2 * areas.min()
    tilted = Camera(K, look_at((0, 0, 0), (1, 0.4, 0.2), (0, 0, 1)), size, size)
    direction = tilted.pixel_directions()[40, 70]
    pixel, _ = cameras[0].project(direction[None])
    column, row = np.floor(pixel[0]).astype(int)
    assert int(backdrop_cells(tilted)[40, 70]) == int(backdrop_cells(cameras[0])[row, column])


def rays_of(camera):
    """Directions of pixels whose part along the axis is 1."""
    rays = camera.pixel_directions()
    return rays / (rays @ camera.c2w[:3, 2])[..., None]


def test_cells_of_a_sphere():
    """Cameras that look at one place of it from elsewhere agree about its cell; very far away only directions count,
    and from its center as well; a camera outside has cells, too.
    """
    sphere, place = Sphere((0.5, -0.2, 0.1), 2.0), np.array([0.5, -0.2, 0.1]) + 2.0 * np.array([0.48, 0.6, 0.64])
    K = intrinsics_from_fov(40.0, 9, 9)
    eyes = [(0.5, -0.2, 0.1), (0.9, 0.4, -0.3), (-0.7, -0.5, 0.8)]
    cameras = [Camera(K, look_at(eye, place, (0, 0, 1)), 9, 9) for eye in eyes]
    assert len({int(backdrop_cells(camera, sphere)[4, 4]) for camera in cameras}) == 1
    assert len({int(backdrop_cells(camera)[4, 4]) for camera in cameras}) == 3
    torch.testing.assert_close(backdrop_cells(cameras[0], sphere), backdrop_cells(cameras[0]))
    torch.testing.assert_close(backdrop_cells(cameras[2], Sphere(sphere.center, 1e9)), backdrop_cells(cameras[2]))
    away = Camera(K, look_at((9.0, 0, 0), (20.0, 0, 0), (0, 0, 1)), 9, 9)
    assert int(backdrop_cells(away, sphere).min()) >= 0


def test_the_sphere_is_behind_what_is_seen(blob, ring):
    """As far away as surfaces are, cameras inside; where none are to be seen, infinitely far away."""
    wall = drgs.Gaussians.from_arrays([[0.0, 0, 0]], [[1.0, 0, 0, 0]], [[0.8] * 3], [0.999], np.zeros((1, 1, 3)))
    found = backdrop_sphere(wall, ring)
    centers = np.stack([camera.center for camera in ring])
    np.testing.assert_allclose(found.center, centers.mean(0), atol=1e-12)
    assert found.radius == pytest.approx(3, rel=0.01)
    aside = Camera(ring[0].K, look_at((0, 0, 43.0), (0, 0, 99.0), (0, 1, 0)), 24, 18)
    apart = np.linalg.norm(aside.center - ring[0].center)
    assert backdrop_sphere(wall, [ring[0], aside]).radius == pytest.approx(1.05 * apart / 2)
    moved = wall.replace(means=wall.means + torch.tensor([0.0, 0, 30.0]))
    looks = [Camera(ring[0].K, look_at((x, 0, 0), (0, 0, 30.0), (0, 1, 0)), 24, 18) for x in (-1.0, 1.0)]
    assert 25 < backdrop_sphere(moved, looks).radius < 31
    assert backdrop_sphere(blob.replace(logit_opacities=blob.logit_opacities - 9), ring) is None
    with pytest.raises(ValueError, match="backdrop_sphere: there must be at least one camera, got none"):
        backdrop_sphere(wall, [])


def test_the_policy_paints_on_the_sphere(blob, ring):
    """Scores are those of `drgs.fisher.backdrop` on the sphere of all views of the pool."""
    solid = blob.replace(logit_opacities=blob.logit_opacities + 5)
    sphere = fisher.backdrop_sphere(solid, ring)
    H, pool = (fisher.backdrop(solid, views, SETTINGS, sphere=sphere) for views in (ring[:2], ring))
    found = select(solid, ring[2:], ring[:2], blocks=("backdrop",))
    for camera, score in zip(ring[2:], found.scores, strict=True):
        Hc = fisher.backdrop(solid, camera, SETTINGS, sphere=sphere)
        want = (pool * (1 / (H + 1e-2) - 1 / (H + Hc + 1e-2))).sum()
        assert score == pytest.approx(float(want), rel=1e-5)
    weights = {"backdrop": torch.rand(CELLS, 3, dtype=torch.float64)}
    on = fisher.variance_map(solid, ring[3], weights, SETTINGS, sphere=sphere)
    total = (fisher.backdrop(solid, ring[3], SETTINGS, sphere=sphere) * weights["backdrop"]).sum()
    assert float(on.double().sum()) == pytest.approx(float(total), rel=1e-5)
    assert not torch.equal(on, fisher.variance_map(solid, ring[3], weights, SETTINGS))


def test_cameras_with_a_lens(blob, ring):
    """The radius is nearly that of pinholes; views with a lens are chosen by default where rays are traced."""
    bent = [dataclasses.replace(camera, model="opencv", distortion=(0.05, 0.0, 0.0, 0.0)) for camera in ring]
    solid = blob.replace(logit_opacities=blob.logit_opacities + 5)
    bent_sphere, sphere = backdrop_sphere(solid, bent), backdrop_sphere(solid, ring)
    assert bent_sphere.radius == pytest.approx(sphere.radius, rel=1e-4)
    assert np.array_equal(bent_sphere.center, sphere.center)
    found = select(solid, bent[2:], bent[:2], settings=RenderSettings.preset("exact", traversal="bvh"))
    assert found.blocks == ["geometry", "backdrop"]
    assert min(found.scores) > 0


def test_information_is_the_squared_derivative(blob, ring):
    """An image is linear in the background, with 1 - alpha; what a view says adds up over its pixels and over views."""
    camera, lit = ring[0], SETTINGS.replace(background=(1.0, 1.0, 1.0))
    with torch.no_grad():
        slope = (drgs.render(blob, camera, lit).rgb - drgs.render(blob, camera, SETTINGS).rgb)[..., 0].double()
    H = fisher.backdrop(blob, camera, SETTINGS)
    cells = backdrop_cells(camera)
    truth = torch.zeros(CELLS, dtype=torch.float64).index_add_(0, cells.flatten(), slope.square().flatten())
    torch.testing.assert_close(H, truth[:, None].expand(-1, 3), rtol=1e-4, atol=1e-5)
    assert 0.1 < float(H.sum()) / (3 * cells.numel()) < 1
    both = fisher.backdrop(blob, ring[:2], SETTINGS)
    torch.testing.assert_close(both, H + fisher.backdrop(blob, ring[1], SETTINGS))
    weighted = fisher.backdrop(blob, camera, SETTINGS, channel_weights=(1.0, 0.5, 0.0))
    torch.testing.assert_close(weighted, H * torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))


def test_variance_is_high_where_nothing_was_seen(blob, ring):
    """A pixel's variance adds up to `eig` of the group; what a known view has looked through is known."""
    known, new = ring[0], ring[4]
    H, prior = {"backdrop": fisher.backdrop(blob, known, SETTINGS)}, Prior(1e-2)
    found = fisher.variance_map(blob, new, variances(H, prior), SETTINGS)
    Hc = {"backdrop": fisher.backdrop(blob, new, SETTINGS)}
    assert float(found.double().sum()) == pytest.approx(information_gain(Hc, H, "eig", prior).total, rel=1e-5)
    again = fisher.variance_map(blob, known, variances(H, prior), SETTINGS)
    assert float(again.max()) < 0.1 * float(found.max())
    assert found[9, 12] < found[0, 0], "the blob hides what is behind it"


@pytest.mark.parametrize("criterion", ["eig", "logdet", "trace_cov", "v_opt"])
def test_empty_views_are_wanted(blob, ring, criterion):
    """Of views of a direction that was seen and of one that was not, the latter; of Gaussians alone they are alike."""
    train, candidates = ring[:1], [dataclasses.replace(ring[0], name="again"), ring[4]]
    found = select(blob, candidates, train, blocks=("geometry", "backdrop"), criterion=criterion, prior=Prior(1e-2))
    assert found.picks[0].name == "4"
    assert found.parts[1]["backdrop"] > 2 * found.parts[0]["backdrop"]
    assert found.blocks == ["geometry", "backdrop"]
    untold = select(blob, candidates, train, criterion=criterion, prior=Prior(1e-2))
    assert untold.scores == pytest.approx(found.scores, rel=1e-5), "it counts unless told otherwise"
    assert untold.blocks == found.blocks
    alone = select(blob, candidates, train, blocks=("geometry",), criterion=criterion, prior=Prior(1e-2))
    assert alone.scores[1] < 2 * alone.scores[0]


def test_masks_hide_what_is_behind(blob, ring):
    """A known view has not looked where its mask is 0, unless that is known to be empty."""
    train, candidates, blocks = ring[:1], [dataclasses.replace(ring[0], name="again"), ring[4]], ("backdrop",)
    left = torch.zeros(18, 24)
    left[:, :12] = 1
    part = fisher.backdrop(blob, train, SETTINGS, masks=[left])
    torch.testing.assert_close(
        part + fisher.backdrop(blob, train, SETTINGS, masks=[1 - left]), fisher.backdrop(blob, train)
    )
    ask = lambda **x: select(blob, candidates, train, blocks=blocks, prior=Prior(1e-2), **x).scores  # noqa: E731
    assert ask(masks=[left])[0] > 10 * ask()[0]
    assert ask(masks=[left], empty_outside=True) == ask()
    cache = Cache()
    for empty in (True, False):  # two answers about one view, which a cache keeps apart
        want = pytest.approx(ask(masks=[left], empty_outside=empty), rel=1e-6)
        assert ask(masks=[left], empty_outside=empty, cache=cache) == want


def test_z_scores_know_the_backdrop(blob, ring):
    """Scored alone, it is compared with the other candidates like any block."""
    ask = {"prior": Prior(1e-2), "settings": SETTINGS}
    both = select(blob, ring[1:], ring[:1], blocks=("geometry", "backdrop"), combine="zscore", **ask)
    alone = select(blob, ring[1:], ring[:1], blocks=("backdrop",), **ask)
    scores = np.array(alone.scores)
    parts = [part["backdrop.backdrop"] for part in both.parts]
    np.testing.assert_allclose(parts, (scores - scores.mean()) / scores.std(), rtol=1e-4)
    assert both.combine == "zscore"


def test_views_look_past_what_moves_at_their_time():
    """Of a scene that moves: the opacity at the camera's time."""
    scene, cam = drawn()
    for time in (0.0, 1.0):
        at = dataclasses.replace(cam, time=time)
        with torch.no_grad():
            frozen = scene.at(time)
        torch.testing.assert_close(fisher.backdrop(scene, at, SETTINGS), fisher.backdrop(frozen, at, SETTINGS))
    one, other = (fisher.backdrop(scene, dataclasses.replace(cam, time=t), SETTINGS) for t in (0.0, 1.0))
    assert not torch.equal(one, other)


def test_wrong_weights_are_refused(blob, ring):
    """Of another number of cells."""
    with pytest.raises(ValueError, match=r"weights of backdrop must have shape \(1536, 3\), got \(3,\)"):
        fisher.variance_map(blob, ring[0], {"backdrop": torch.ones(3)})
    with pytest.raises(ValueError, match="weights must be finite, got NaN or Inf"):
        fisher.variance_map(blob, ring[0], {"backdrop": torch.full((CELLS, 3), torch.inf)})
    with pytest.raises(ValueError, match="weights must be of backdrop, means"):
        fisher.variance_map(blob, ring[0], {"background": torch.ones(CELLS, 3)})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"blocks": ("backdrop",), "criterion": "block_logdet"}, "got backdrop; only Gaussians have blocks"),
        ({"groups": ("means", "backdrop"), "blocks": ("geometry",)}, "groups must be of blocks geometry, got backdrop"),
        ({"blocks": ("backdrop",), "method": "fisherrf"}, "got backdrop; use method exact"),
        ({"masks": [torch.ones(18, 24)], "information": dict}, "masks must be None with information"),
        ({"masks": []}, "one for each of 1 cameras, got 0"),
    ],
)
def test_wrong_questions_are_refused(blob, ring, options, message):
    """In one line."""
    with pytest.raises(ValueError, match=message):
        select(blob, ring[1:], ring[:1], **options)


@pytest.mark.parametrize("preset", ["exact", "fast"])
def test_opacity_of_the_diagonal(blob, ring, preset):
    """What the diagonal's traversal finds on its way is what a view is rendered with; other sizes are refused."""
    settings = RenderSettings.preset(preset)
    normal = torch.randn(50, 12, generator=torch.Generator().manual_seed(0))
    g = drgs.Gaussians(normal[:, :3], normal[:, 3:7], normal[:, 7:10] - 2, normal[:, 10], 0.3 * torch.ones(50, 1, 3))
    for scene in (blob, g):
        views = [ViewContext(scene, camera, settings) for camera in ring[:3]]
        parts = [Diagonal().compute(view) for view in views]
        diagonal = {name: sum(part[name] for part in parts) for name in parts[0]}
        found = [view.opacity for view in views]
        assert [x.shape for x in found] == [(18, 24)] * 3
        for opacity, camera in zip(found, ring, strict=False):
            np.testing.assert_allclose(opacity, drgs.render(scene, camera, settings).alpha, atol=6e-6)
        wanted = fisher.backdrop(scene, ring[:3], settings)
        given = fisher.backdrop(scene, ring[:3], settings, seen_opacity=found)
        np.testing.assert_allclose(given, wanted, rtol=1e-4, atol=1e-4)
        assert wanted.sum() > 100
        for name, x in fisher.diagonal(scene, ring[:3], settings).items():
            assert_same_sums(x, diagonal[name])
    with pytest.raises(ValueError, match="seen_opacity must be of the 2 views and their sizes"):
        fisher.backdrop(blob, ring[:2], settings, seen_opacity=found)


def test_a_pick_renders_no_view_for_its_opacity(blob, ring, monkeypatch):
    """The diagonal has it. What is rendered beside are the small pictures that say how far away the sphere is."""
    sizes, render = [], drgs.integrator.render

    def counted(scene, camera, *arguments, **options):
        sizes.append(camera.width * camera.height)
        return render(scene, camera, *arguments, **options)

    large = [camera.resized(96, 72) for camera in ring]
    wanted = select(blob, large[1:], large[:1], 2, settings=SETTINGS)
    monkeypatch.setattr(drgs.integrator, "render", counted)
    found = select(blob, large[1:], large[:1], 2, settings=SETTINGS)
    assert found.scores == pytest.approx(wanted.scores, rel=1e-5)
    assert len(found.picks) == len(wanted.picks)
    assert len(sizes) == len(large)
    assert max(sizes) <= 1200
    assert "backdrop" in found.blocks
