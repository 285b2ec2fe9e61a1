"""Surfaces from depth: fusion and marching cubes on what is known exactly, and `mesh_of` on Gaussians over a sphere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from drgs import cli
from drgs.cameras import Camera, intrinsics_from_fov, orbit
from drgs.data.camera_lists import save_cameras_json
from drgs.ellipsoids import Gaussians
from drgs.files import save_ply
from drgs.meshing.depths import DepthView, depth_views, footprint
from drgs.meshing.extraction import TriangleMesh, deviations_of, mesh_of, mesh_of_depths
from drgs.meshing.fusion import bricks_of, distances, sampled, surface
from drgs.meshing.options import POINTS, MeshOptions
from drgs.meshing.writing import save_mesh
from drgs.settings import RenderSettings

pytest.importorskip("skimage")
RADIUS = 0.5


def around(count: int = 8, size: int = 64) -> list[Camera]:
    """Cameras on three circles around the origin."""
    circles = [orbit((0, 0, 0), 2.0, count, elevation, width=size, height=size, fov=40) for elevation in (-50, 0, 50)]
    return [camera for circle in circles for camera in circle]


def ball_view(camera: Camera, radius: float = RADIUS) -> DepthView:
    """The exact depth of a ball at the origin, weighted by the cosine."""
    rays, origin = camera.pixel_directions(), camera.center
    b = rays @ origin
    inside = b**2 - origin @ origin + radius**2
    with np.errstate(invalid="ignore"):
        depth = np.where(inside > 0, -b - np.sqrt(inside), np.inf)
    normal = (origin + np.where(inside > 0, depth, 1.0)[..., None] * rays) / radius
    cosine = np.clip(-(normal * rays).sum(-1), 0.05, 1.0)
    rgb = np.clip(normal / 2 + 0.5, 0, 1).astype(np.float32)
    solid = np.isfinite(depth).astype(np.float32)
    return DepthView(camera, depth.astype(np.float32), cosine.astype(np.float32), solid, rgb)


def is_closed(mesh: TriangleMesh) -> bool:
    """Whether every edge is of two triangles that run along it in opposite directions."""
    edges = np.concatenate([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    there, counts = np.unique(edges, axis=0, return_counts=True)
    back = {tuple(edge) for edge in there[:, ::-1]}
    return bool((counts == 1).all()) and back == {tuple(edge) for edge in there}


def volume(mesh: TriangleMesh) -> float:
    """Signed volume; positive where triangles are counter-clockwise from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("fk,fk->f", a, np.cross(b, c)).sum() / 6)


def test_a_ball_of_exact_depth_is_closed_and_where_it_is():
    views = [ball_view(camera) for camera in around()]
    mesh = mesh_of_depths(views, MeshOptions(voxel=0.02, crop=0.0))
    off = np.linalg.norm(mesh.vertices, axis=1) - RADIUS
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert np.abs(off).mean() < 0.002
    assert np.abs(off).max() < 0.01  # of a voxel of 0.02
    # Colors are those of the surface there, which the views agree on.
    assert np.abs(mesh.colors - (mesh.vertices / RADIUS / 2 + 0.5)).mean() < 0.02
    assert mesh.views.min() >= 2
    assert mesh.areas().sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.02)


@pytest.mark.slow
def test_bricks_meet_without_a_seam():
    """Voxels so small that the ball is in many bricks, or so large that it is in one: the same ball."""
    views = [ball_view(camera) for camera in around(size=96)]
    for voxel, several in ((0.015, True), (0.08, False)):
        bricks = bricks_of(views, voxel, 4 * voxel)
        assert (len(bricks) > 27) == several
        mesh = mesh_of_depths(views, MeshOptions(voxel=voxel, crop=0.0))
        assert is_closed(mesh)
        assert len(np.unique(mesh.pieces())) == 1
        assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


def test_distances_are_along_rays_and_cut_off():
    camera = around()[0]
    view = ball_view(camera)
    forward = -camera.center / np.linalg.norm(camera.center)
    front = camera.center + (2.0 - RADIUS) * forward
    steps = np.array([-1.0, -0.1, -0.05, 0.0, 0.05, 0.1, 0.3])  # beyond the surface where positive
    values, weights = distances([view], front + steps[:, None] * forward, 0.1)
    assert values[:6] == pytest.approx([1, 1, 0.5, 0, -0.5, -1], abs=0.02)
    assert weights[6] == 0  # hidden
    assert (weights[:5] > 0).all()
    behind, w = distances([view], camera.center[None] - forward, 0.1)
    assert w[0] == 0
    assert behind[0] == 1


def test_what_hits_nothing_is_free():
    camera = around()[0]
    view = ball_view(camera)
    up = np.cross(camera.center, [0.0, 1.0, 0.0])
    beside = 0.6 * up[None] / np.linalg.norm(up)  # in the image, outside of the ball
    values, weights = distances([view], beside, 0.1)
    assert (values[0], weights[0]) == (1.0, 1.0)


def test_no_surface_across_an_edge():
    """Depth is not interpolated between an object and what is behind it."""
    camera = Camera(intrinsics_from_fov(60, 16, 16), np.eye(4), 16, 16)
    depth = np.where(np.arange(16) < 8, 1.0, 3.0)[None].repeat(16, 0).astype(np.float32)
    ones = np.ones_like(depth)
    view = DepthView(camera, depth, ones, ones, np.ones((16, 16, 3), np.float32))
    rays = camera.pixel_directions()[8]
    # Between the two: hidden by the left one, and the right one, which would say free, is too near to the edge for it.
    shares = np.array([1.0, 0.9, 0.6, 0.4, 0.1])[:, None]
    signed, _, _ = sampled(view, 2.0 * (shares * rays[7] + (1 - shares) * rays[8]), 0.1)
    assert signed[:3] == pytest.approx([-1, -1, -1], abs=0.02)
    assert np.isnan(signed[3:]).all()
    signed, _, _ = sampled(view, 2.0 * rays[[2, 12]], 0.1)
    assert signed == pytest.approx([-1, 1], abs=0.02)
    # On the surface behind, beside the edge: seen.
    signed, _, _ = sampled(view, 3.0 * rays[None, 8], 0.1)
    assert signed == pytest.approx([0], abs=1e-6)


def test_lenses_and_pinholes_give_the_same_ball():
    fisheye = [dataclasses.replace(camera, model="opencv_fisheye", distortion=(0.02, 0, 0, 0)) for camera in around()]
    mesh = mesh_of_depths([ball_view(camera) for camera in fisheye], MeshOptions(voxel=0.03, crop=0.0))
    assert is_closed(mesh)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).mean() < 0.004


def test_small_pieces_and_what_one_view_sees_are_left_out():
    views = [ball_view(camera) for camera in around()]
    speck = views[0].depth.copy()
    speck[2:5, 2:5] = 1.7
    views[0] = dataclasses.replace(views[0], depth=speck)
    options = MeshOptions(voxel=0.02, crop=0.0, min_views=1, min_piece=0.0)
    all_of_it = mesh_of_depths(views[:1], options)
    assert len(np.unique(all_of_it.pieces())) > 1
    assert len(np.unique(mesh_of_depths(views[:1], options.replace(min_piece=0.05)).pieces())) == 1
    with pytest.raises(ValueError, match="lower --min-views"):
        mesh_of_depths(views[:1], options.replace(min_views=2))


def test_crop_cuts_what_is_uncertain():
    views = [ball_view(camera) for camera in around()]
    views = [
        dataclasses.replace(view, spread=np.where(np.arange(64) < 32, 0.5, 0.001)[:, None].repeat(64, 1))
        for view in views
    ]
    whole = mesh_of_depths(views[8:16], MeshOptions(voxel=0.03, crop=0.0))
    lower = mesh_of_depths(views[8:16], MeshOptions(voxel=0.03, crop=1.0))
    assert whole.vertices[:, 2].max() > 0.4
    assert lower.vertices[:, 2].max() < 0.1  # the upper half of level pictures is uncertain
    assert lower.spread.max() <= 0.03


def test_too_many_voxels_are_refused_or_made_fewer():
    views = [ball_view(camera) for camera in around(4, 160)]
    most = 64 * POINTS
    with pytest.raises(ValueError, match="raise --max-voxels, or --voxel to about") as told:
        mesh_of_depths(views, MeshOptions(voxel=0.01, max_voxels=most))
    advised = float(str(told.value).split()[-1])
    mesh = mesh_of_depths(views, MeshOptions(max_voxels=most, crop=0.0))
    assert 0.9 * mesh.voxel < advised < 1.4 * mesh.voxel
    assert mesh.voxel > 2 * footprint(views)
    assert len(bricks_of(views, mesh.voxel, 4 * mesh.voxel)) * POINTS <= most


def test_options_are_refused_in_one_line():
    for fields, word in (
        ({"voxel": -1.0}, "voxel"),
        ({"depth": "first"}, "depth"),
        ({"trunc": 0.1}, "trunc"),
        ({"min_piece": 2.0}, "min_piece"),
        ({"max_voxels": 8 * POINTS}, "max_voxels"),
    ):
        with pytest.raises(ValueError, match=word) as told:
            MeshOptions(**fields)
        assert "\n" not in str(told.value)


def test_nothing_seen_is_said():
    view = ball_view(around()[0])
    empty = dataclasses.replace(view, depth=np.full_like(view.depth, np.inf))
    with pytest.raises(ValueError, match="something solid"):
        mesh_of_depths([empty], MeshOptions())
    with pytest.raises(ValueError, match="got none"):
        mesh_of(shell(10), [])
    assert surface([empty], 0.1, 0.4)[1].shape == (0, 3)


def shell(count: int = 2500) -> Gaussians:
    """Flat opaque Gaussians over the ball, their third axis along its normal."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    normal = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    # The shortest turn of z onto the normal.
    quats = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(count)], 1)
    spacing = RADIUS * np.sqrt(4 * np.pi / count)
    scales = np.array([[0.7 * spacing, 0.7 * spacing, 0.004]]).repeat(count, 0)
    return Gaussians.from_arrays(
        *(torch.from_numpy(x).float() for x in (RADIUS * normal, quats, scales)),
        torch.full((count,), 0.95),
        torch.from_numpy((normal / 2)[:, None] / 0.28209479).float(),
    )


@pytest.mark.every(2)
@pytest.mark.parametrize("kind", ["median", "expected"])
def test_gaussians_over_a_sphere(kind):
    mesh = mesh_of(shell(), around(6), RenderSettings.preset("fast"), MeshOptions(depth=kind, voxel=0.025))
    off = np.linalg.norm(mesh.vertices, axis=1) - RADIUS
    assert np.abs(off).mean() < 0.006
    assert np.quantile(np.abs(off), 0.99) < 0.02
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
    assert len(np.unique(mesh.pieces())) == 1
    assert np.abs(mesh.colors - (mesh.vertices / RADIUS / 2 + 0.5)).mean() < 0.05


def test_all_of_a_sphere_is_there():
    """Completeness: how far points of the true surface are from the mesh, at most."""
    from scipy.spatial import cKDTree

    mesh = mesh_of(shell(), around(6), RenderSettings.preset("fast"))
    truth = shell(5000).means.numpy()
    distances_to = cKDTree(mesh.vertices).query(truth)[0]
    assert 0.02 < mesh.voxel < 0.1  # two pixels of 0.023 where they meet the ball
    assert np.quantile(distances_to, 0.99) < mesh.voxel
    assert distances_to.max() < 2 * mesh.voxel


def test_what_only_views_elsewhere_know_is_cut():
    """Views from below are the known ones: what those from above show of the ball is cut away, the rest stays."""
    below = orbit((0, 0, 0), 2.0, 6, -50, width=48, height=48, fov=40)
    cameras, settings, options = around(6, 48), RenderSettings.preset("fast"), MeshOptions(voxel=0.04, crop=0.5)
    whole = mesh_of(shell(1000), cameras, settings, options.replace(crop=0.0), known=below)
    known = mesh_of(shell(1000), cameras, settings, options, known=below)
    assert whole.spread is None
    assert whole.vertices[:, 2].max() > 0.45
    assert known.vertices[:, 2].max() < 0.45
    assert known.vertices[:, 2].min() < -0.45
    assert 0.3 < known.areas().sum() / whole.areas().sum() < 0.95
    assert known.spread.max() <= 0.5 * known.voxel


def test_deviations_fall_with_views_and_are_at_most_the_scale():
    g = shell(200)
    cameras = around(3, 32)
    settings = RenderSettings.preset("fast")
    none = deviations_of(g, [], settings)
    assert torch.allclose(none, (3**0.5 * g.log_scales.double().exp().amax(1)))
    one, all_ = deviations_of(g, cameras[:1], settings), deviations_of(g, cameras, settings)
    assert (one <= none + 1e-12).all()
    assert (all_ <= one + 1e-12).all()
    assert float(all_.mean()) < 0.5 * float(none.mean())
    view = depth_views(g, cameras[:1], settings, "median", all_)[0]
    solid = np.isfinite(view.depth)
    # Its logarithm is a mean of theirs: between the least and the largest.
    assert view.spread[solid].min() >= 0.999 * float(all_.min())
    assert view.spread[solid].max() <= 1.001 * float(all_.max())


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_files_are_read_by_another_program(suffix, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    views = [ball_view(camera) for camera in around(4, 32)]
    mesh = mesh_of_depths(views, MeshOptions(voxel=0.05, crop=0.0))
    save_mesh(mesh, tmp_path / f"ball{suffix}")
    read = trimesh.load(tmp_path / f"ball{suffix}", force="mesh", process=False, maintain_order=True)
    assert read.faces.shape == mesh.faces.shape
    turn = np.array([-1, -1, 1]) if suffix == ".glb" else 1
    assert np.allclose(read.vertices * turn, mesh.vertices, atol=1e-5)
    assert read.is_watertight
    assert read.volume == pytest.approx(volume(mesh), rel=1e-3)
    if suffix == ".glb":  # beside its material
        (geometry,) = trimesh.load(tmp_path / "ball.glb", process=False, maintain_order=True).geometry.values()
        stored = np.asarray(geometry.visual.vertex_attributes["color"])
        colors = stored[:, :3] / np.iinfo(stored.dtype).max
    else:
        colors = np.asarray(read.visual.vertex_colors)[:, :3] / 255.0
    expected = mesh.colors
    if suffix == ".glb":  # linear there
        expected = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
    assert np.abs(colors - expected).max() < 0.01
    with pytest.raises(ValueError, match="rename it"):
        save_mesh(mesh, tmp_path / "ball.stl")
    assert [x.name for x in tmp_path.iterdir()] == [f"ball{suffix}"]


@pytest.fixture
def made(tmp_path):
    """Files of Gaussians over a ball and of cameras around it."""
    save_ply(shell(1000), tmp_path / "ball.ply")
    save_cameras_json(tmp_path / "cameras.json", around(4, 32))
    return tmp_path


def command(folder, *arguments: str) -> list[str]:
    """`drgs mesh` on the files of `made`."""
    return ["mesh", str(folder / "ball.ply"), "--cameras", str(folder / "cameras.json"), *arguments]


def test_the_command(made, capsys):
    import plyfile

    line = command(made, "-o", str(made / "out/mesh.ply"), "--preset", "fast", "--crop", "3")
    assert cli.main(line) == 0
    assert "of 12 views" in capsys.readouterr().out
    ply = plyfile.PlyData.read(made / "out/mesh.ply")
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], 1)
    faces = np.stack(ply["face"]["vertex_indices"])
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).mean() < 0.02
    assert ply["vertex"]["views"].min() >= 2
    assert (ply["vertex"]["spread"] > 0).all()
    assert faces.max() == len(vertices) - 1
    # Once more over its own file, but not over another's.
    assert cli.main([*line, "--quiet"]) == 0
    (made / "mine.ply").write_bytes(b"mine")
    assert cli.main(command(made, "-o", str(made / "mine.ply"), "--preset", "fast")) == 2
    assert (made / "mine.ply").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("-o", "mesh.stl"), "must be a .ply, .glb, .obj, got .stl"),
        (("-o", "mesh.ply", "--voxel", "1e-9"), "--voxel must be at least 0.125 of a pixel"),
        (("-o", "mesh.ply", "--voxel", "0.008", "--max-voxels", "320000"), "mesh: the lattice must have at most"),
        (("-o", "mesh.ply", "--min-views", "13"), "lower --min-views"),
        (("-o", "mesh.ply", "--crop", "1e-9"), "set --crop 0"),
        (("-o", "mesh.ply", "--limit", "0"), "--limit must be in [1, 1000000000], got 0"),
        (("-o", "mesh.ply", "--trunc", "-1"), "trunc"),
    ],
)
def test_what_cannot_be_is_one_line(made, arguments, word, capsys, monkeypatch):
    """Nothing is left behind, either: no file, and no lattice that was promised to be small."""
    monkeypatch.chdir(made)
    assert cli.main(command(made, *arguments, "--preset", "fast", "--quiet")) == 2
    told = capsys.readouterr().err
    assert word in told
    assert told.count("\n") == 1
    assert not list(made.glob("mesh.*"))


def test_too_fine_a_lattice_takes_no_memory():
    """Bricks are counted before any is made, and counting stops where there are too many."""
    import tracemalloc

    views = [ball_view(camera) for camera in around(4, 128)]
    tracemalloc.start()
    with pytest.raises(ValueError, match="the lattice must have at most"):
        mesh_of_depths(views, MeshOptions(voxel=0.002, max_voxels=10_000_000))  # 39 MB of its distances alone
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


def test_a_file_of_gaussians_needs_cameras(made, capsys):
    assert cli.main(["mesh", str(made / "ball.ply"), "-o", str(made / "mesh.obj"), "--quiet"]) == 2
    assert "--cameras must name" in capsys.readouterr().err
