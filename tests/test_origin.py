"""Worlds far from 0: where their origin is, fits that do not depend on it, and files that keep it."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from test_data import write_colmap, write_llff, write_transforms
from test_dynamic_fit import _small_field  # noqa: F401 (a fixture that is used by itself)
from test_dynamic_fit import config as moving_config
from test_dynamic_fit import made as filmed
from test_train import FAST, config, dataset, scene  # noqa: F401 (a fixture)

import drgs
from drgs.cameras.origins import origin_near, origin_of_text, origin_text
from drgs.codecs import load_gaussians, origin_file, save_gaussians
from drgs.data import Dataset, load
from drgs.data.camera_layout import scene_origin
from drgs.deform import DynamicGaussians
from drgs.files import load_ply, load_state, save_ply, save_state
from drgs.fitting.appearing import find_new_gaussians
from drgs.fitting.components.filter_3d import Filter3D
from drgs.fitting.components.motion import MotionComponent
from drgs.fitting.components.poses import Poses
from drgs.fitting.components.skybox import Skybox
from drgs.fitting.config import SelectionConfig
from drgs.fitting.frames import load_frames
from drgs.fitting.online import OnlineFit
from drgs.fitting.records import load_run
from drgs.fitting.rows import GaussianRows
from drgs.train import fit

FAR = np.array([5e6, -3e6, 120.0])
UTM = np.array([500000.0, 5400000.0, 120.0])
FORMATS = ("ply", "compressed.ply", "spz", "sog", "splat", "glb")


def moved(data: Dataset, offset: np.ndarray, scale: float = 1.0) -> Dataset:
    """The same data set in a world that is scaled and then moved, with its origin."""

    def place(view):
        c2w = view.camera.c2w
        c2w[:3, 3] = scale * c2w[:3, 3] + offset
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = c2w[:3, :3].T, -c2w[:3, :3].T @ c2w[:3, 3]
        return dataclasses.replace(view, camera=dataclasses.replace(view.camera, w2c=w2c))

    views = [place(view) for view in data.views]
    points = scale * data.points + offset
    origin = scene_origin("test", [view.camera for view in views], points)
    return dataclasses.replace(data, views=views, points=points, origin=origin)


def world(g: drgs.Gaussians) -> np.ndarray:
    """(N, 3) means in the world."""
    return g.means.double().numpy() + g.origin


# ------------------------------------------------------------------------------------------------------- where it is


def test_origin_is_0_near_0_and_a_short_decimal_elsewhere():
    """Within ten extents it is 0; beyond, within half a power of ten below the extent, and text gives it back."""
    assert not origin_near(np.array([6.0, 0, 0]), 0.6).any()
    for middle, extent, want in (
        ([500001.234, 5400002.5, 119.7], 3.0, "500001 5400002 120"),
        ([500001.234, 5400002.5, 119.7], 0.004, "500001.234 5400002.5 119.7"),
        ([500001.234, 5400002.5, -19.7], 400.0, "500000 5400000 0"),
    ):
        origin = origin_near(np.array(middle), extent)
        assert origin_text(origin) == want
        np.testing.assert_array_equal(origin_of_text("here", want), origin)
        assert np.abs(origin - middle).max() <= extent / 2


@pytest.mark.parametrize("kind", ["colmap", "transforms", "llff"])
def test_loaders_find_the_origin_and_keep_cameras_in_the_world(tmp_path, kind, caplog):
    """The same function for all: near 0 there is none, far away the log says where it is."""
    if kind == "colmap":
        pycolmap = pytest.importorskip("pycolmap")
        model = write_colmap(tmp_path)
    else:
        {"transforms": write_transforms, "llff": write_llff}[kind](tmp_path)
    near = load(tmp_path)
    assert not near.origin.any()
    if kind == "colmap":
        reconstruction = pycolmap.Reconstruction(model)
        reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
        reconstruction.write_binary(model)
    elif kind == "transforms":
        stated = json.loads((tmp_path / "transforms.json").read_text())
        for frame in stated["frames"]:
            for row, shift in zip(frame["transform_matrix"], UTM, strict=False):
                row[3] += shift
        (tmp_path / "transforms.json").write_text(json.dumps(stated))
    else:
        rows = np.load(tmp_path / "poses_bounds.npy")
        rows[:, [3, 8, 13]] += UTM
        np.save(tmp_path / "poses_bounds.npy", rows)
    with caplog.at_level(logging.INFO, logger="drgs"):
        far = load(tmp_path)
    assert f"relative to an origin at {origin_text(far.origin)}" in caplog.text
    centers = np.stack([view.camera.center for view in far.views])
    assert np.linalg.norm(far.origin - centers.mean(axis=0)) < np.ptp(centers, axis=0).max()
    np.testing.assert_allclose(centers - UTM, [view.camera.center for view in near.views], atol=1e-8)
    if kind == "colmap":
        np.testing.assert_allclose(far.points - UTM, near.points, atol=1e-8)


def test_a_world_that_float64_cannot_hold_is_refused(tmp_path):
    """Cameras a unit apart at 1e14: one line says where, by how much, and what to do."""
    rows = write_llff(tmp_path)
    rows[:, 3] += 1e14
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=r"must stand where float64 holds 0\.001 of a pixel, got '.*' 1e\+14 from 0"):
        load(tmp_path)


def test_a_camera_relative_to_an_origin_sees_what_it_saw():
    """Points less the origin are projected where the points were; with a rolling shutter of a camera that only moves,
    too.
    """
    pose = drgs.cameras.look_at(UTM + (3, 0, 1), UTM)
    end = drgs.cameras.look_at(UTM + (3, 0.2, 1), UTM + (0, 0.2, 0))
    K = drgs.cameras.intrinsics(40.0, 40.0, 16.0, 16.0)
    still = drgs.Camera(K, pose, 32, 32)
    rolling = dataclasses.replace(still, shutter="rolling_top_to_bottom", w2c_end=end)
    points = UTM + np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    for camera in (still, rolling):
        moved_camera = camera.relative_to(UTM)
        np.testing.assert_allclose(moved_camera.project(points - UTM)[0], camera.project(points)[0], atol=1e-6)
        assert camera.relative_to(np.zeros(3)) is camera


# -------------------------------------------------------------------------------------------------------------- fits


@pytest.mark.same_bits
def test_a_fit_does_not_depend_on_where_the_world_is(dataset, tmp_path):  # noqa: F811
    """PSNR within 0.05 dB at 5e6 from 0, with poses refined and a filter; files and a resumed fit keep the origin."""
    options = config(poses="refined", filter_3d="on", skybox="off", save_every=30)
    near = fit(dataset, tmp_path / "near", options, progress=False)
    far = fit(moved(dataset, FAR), tmp_path / "far", options, progress=False)
    assert far.metrics["mean"]["psnr"] == pytest.approx(near.metrics["mean"]["psnr"], abs=0.05)
    assert far.metrics["poses"]["moved"] == pytest.approx(near.metrics["poses"]["moved"], rel=0.05)
    assert near.run.config().get("origin") is None
    assert "origin" not in load_state(near.run.state)[1]
    origin = far.gaussians.origin
    assert far.run.config()["origin"] == load_state(far.run.state)[1]["origin"] == origin.tolist()
    assert float(far.gaussians.means.abs().max()) < 10
    for found in (load_run(far.run).gaussians, load_ply(far.run.point_cloud)):
        np.testing.assert_array_equal(found.origin, origin)
        assert torch.equal(found.means, far.gaussians.means)
    tensors, header = load_state(far.run.path / "state.previous.safetensors")
    save_state(far.run.state, tensors, header)
    again = fit(moved(dataset, FAR), tmp_path / "far", options, resume=True, progress=False)
    assert torch.equal(again.gaussians.means, far.gaussians.means)
    more = fit(moved(dataset, FAR + 3), tmp_path / "more", config(max_steps=1), begin=far.run.state, progress=False)
    np.testing.assert_array_equal(more.gaussians.origin, origin)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_fit_does_not_depend_on_the_unit_of_the_world(dataset, tmp_path, scale):  # noqa: F811
    """A scene in kilometers or in millimeters, moved as well."""
    options = config(max_steps=40)
    near = fit(dataset, tmp_path / "near", options, progress=False)
    far = fit(
        moved(dataset, 1e5 * scale * np.array([5.0, -3.0, 1.0]), scale), tmp_path / "far", options, progress=False
    )
    assert far.metrics["mean"]["psnr"] == pytest.approx(near.metrics["mean"]["psnr"], abs=0.05)


def test_an_active_fit_picks_the_same_views(dataset, tmp_path):  # noqa: F811
    """By information. (Without one of two views that are as far from the first, so that the start is no tie.)"""
    data = dataclasses.replace(dataset, views=[view for view in dataset.views if view.name != "6"])
    options = config(max_steps=40, selection=SelectionConfig(initial=2, add=2, every=10), init_points="all")
    picks = []
    for name, there in (("near", data), ("far", moved(data, FAR))):
        run = fit(there, tmp_path / name, options, progress=False).run
        record = json.loads((run.path / "selection.json").read_text())
        picks.append([pick["name"] for pick in record["picks"]])
    assert picks[0] == picks[1]


def test_a_field_moves_gaussians_alike_wherever_the_world_is(tmp_path):
    """Its box is of the world, the means are relative. (Fits to these few pixels end a tenth of a dB apart by the last
    bit of anything.)
    """
    data = filmed(tmp_path / "data")
    means = []
    for origin in (np.zeros(3), FAR):
        points = torch.from_numpy(data.points + origin)
        rows = GaussianRows.from_points(points, torch.full((12, 3), 0.5), origin=origin)
        motion = MotionComponent()
        motion.times = (0.0, 0.5, 1.0)
        motion.begin_field(moving_config(), rows, 3.0)
        for x in motion.field.parameters():
            torch.nn.init.normal_(x, std=0.3, generator=torch.Generator().manual_seed(0))
        np.testing.assert_allclose(motion.field.grid.bounds.mean(0).numpy() - origin, data.points.mean(0), atol=1.0)
        means.append(DynamicGaussians(rows.gaussians(), motion.field, rows.tensors["motion"]).at(0.7).means.detach())
    assert float((means[0] - rows.tensors["means"].detach()).abs().max()) > 1e-3
    np.testing.assert_allclose(means[0], means[1], atol=1e-5)


def test_what_is_found_beside_moving_gaussians_is_relative_to_them(tmp_path):
    """Places that only some photographs show, in the frame of the Gaussians, wherever the world is."""
    data = filmed(tmp_path / "data", way=1.5)
    still = scene().take(slice(0, 3))
    found = []
    for there in (data, dataclasses.replace(moved(data, FAR), origin=FAR)):
        frames = load_frames(there.views, 10**6)
        g = still.replace(origin=there.origin)
        found.append(find_new_gaussians(frames, g, FAST, 3.0, 200, torch.Generator().manual_seed(0)).points)
    assert len(found[0]) > 20
    assert len(found[0]) == len(found[1])
    assert float((found[0] - found[1]).norm(dim=1).median()) < 1e-3


def test_components_measure_in_the_world(dataset):  # noqa: F811
    """Sampling rates, reaches of poses and shells of a skybox are those of the world near 0."""
    known = []
    for data in (dataset, dataclasses.replace(moved(dataset, FAR), origin=FAR)):
        frames = load_frames(data.views, 10**6)
        rows = GaussianRows.from_points(torch.from_numpy(data.points), torch.full((40, 3), 0.5), origin=data.origin)
        filters, poses = Filter3D(), Poses([frame.camera for frame in frames], 3.0, FAST, 1.0)
        filters.sample(rows.places(), [frame.camera for frame in frames])
        poses.begin(rows.gaussians())
        sky = Skybox.around(frames, 3.0, 30).rows(data.origin)["means"]
        known.append((rows.tensors["means"].detach(), filters.variances, poses.shifts, poses.whitening, sky))
    for near, far in zip(*known, strict=True):
        np.testing.assert_allclose(far.numpy(), near.numpy(), rtol=1e-3, atol=1e-5)


def test_an_online_fit_has_an_origin(dataset):  # noqa: F811
    """Photographs that come one at a time, with depth maps."""
    data = moved(dataset, UTM)
    online = OnlineFit(config())
    depth = np.full((32, 32), 3.0)
    for view in data.views[:2]:
        online.add(view.image(), view.camera, depth)
    g = online.gaussians()
    assert g.origin.any()
    assert np.abs(g.means.numpy()).max() < 10
    assert np.linalg.norm(world(g) - UTM, axis=1).max() < 10


# ------------------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_keep_the_origin(tmp_path, suffix, caplog):
    """Positions are as exact as at 0, the origin comes back, and the log names file and offset."""
    g = scene()
    for name, origin in (("near", np.zeros(3)), ("far", np.array([500000.1, -5400000, 120]))):
        with caplog.at_level(logging.INFO, logger="drgs"):
            save_gaussians(g.replace(origin=origin), tmp_path / f"{name}.{suffix}")
    near, far = (load_gaussians(tmp_path / f"{name}.{suffix}") for name in ("near", "far"))
    assert torch.equal(near.means, far.means)
    assert torch.equal(near.quats, far.quats)
    assert not near.origin.any()
    assert far.origin.tolist() == [500000.1, -5400000, 120]
    assert f"far.{suffix}: positions are relative to the offset 500000.1 -5400000 120, " in caplog.text
    assert "near" not in caplog.text.replace("nearest", "") or "near.splat" not in caplog.text
    # Written once more, without an origin: nothing beside it says where the former one was.
    save_gaussians(g, tmp_path / f"far.{suffix}")
    assert not load_gaussians(tmp_path / f"far.{suffix}").origin.any()


def test_a_file_without_an_origin_has_the_bytes_that_it_had(tmp_path):
    """No comment, no field, no text beside it."""
    g = scene()
    for suffix in FORMATS:
        save_gaussians(g, tmp_path / f"a.{suffix}")
        assert b"offset" not in (tmp_path / f"a.{suffix}").read_bytes()[:4096].replace(b"byteOffset", b"")
        assert not origin_file(tmp_path / f"a.{suffix}").exists()


def test_spz_states_the_offset_in_its_own_axes(tmp_path):
    """y and z of an SPZ point the other way: offset and positions alike, also as stored."""
    save_gaussians(scene().replace(origin=UTM), tmp_path / "a.spz")
    assert b"offset 500000 -5400000 -120\0" in (tmp_path / "a.spz").read_bytes()[:60]
    stored = load_gaussians(tmp_path / "a.spz", as_stored=True)
    assert stored.origin.tolist() == [500000, -5400000, -120]
    np.testing.assert_allclose(world(stored) * (1, -1, -1), world(scene().replace(origin=UTM)), atol=2e-4)
    import gzip

    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[:4] == b"NGSP"


def double_ply(path: Path, g: drgs.Gaussians, kind: str = "double", comment: str = "") -> Path:
    """A PLY of Gaussians with x, y and z of another type, in the world."""
    import plyfile

    save_ply(g.replace(origin=np.zeros(3)), path)
    vertex = plyfile.PlyData.read(path)["vertex"].data
    kinds = [(name, {"double": "<f8", "float": "<f4"}[kind] if name in "xyz" else "<f4") for name in vertex.dtype.names]
    rows = np.empty(len(g), kinds)
    for name in vertex.dtype.names:
        rows[name] = vertex[name]
    for i, name in enumerate("xyz"):
        rows[name] = world(g)[:, i]
    comments = [comment] if comment else []
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<", comments=comments).write(path)
    return path


def test_another_file_in_the_place_of_an_offset_is_kept(tmp_path):
    """A format without room for an offset is not written then; an offset of an earlier file is replaced."""
    g = drgs.Gaussians.from_arrays(np.zeros((1, 3)), [[1, 0, 0, 0]], np.ones((1, 3)), [0.5], np.zeros((1, 1, 3)))
    path = tmp_path / "a.splat"
    save_gaussians(g.replace(origin=UTM), path)
    save_gaussians(g, path)
    assert not load_gaussians(path).origin.any()
    origin_file(path).write_text("my notes")
    written = path.read_bytes()
    with pytest.raises(ValueError, match="the offset must be three finite numbers .*, got 'my notes'"):
        save_gaussians(g.replace(means=g.means + 1), path)
    assert origin_file(path).read_text() == "my notes"
    assert path.read_bytes() == written


def test_double_positions_of_a_ply_keep_their_digits(tmp_path, caplog):
    """An origin is found for them; those near 0, or relative to an offset, have none, or that."""
    g = scene().replace(origin=UTM + 0.25)
    with caplog.at_level(logging.INFO, logger="drgs"):
        back = load_ply(double_ply(tmp_path / "a.ply", g))
    np.testing.assert_allclose(world(back), world(g), atol=1e-6)
    assert back.means.dtype == torch.float32
    assert f"a.ply: stands far from 0: positions are relative to {origin_text(back.origin)} now" in caplog.text
    near = load_ply(double_ply(tmp_path / "b.ply", scene()))
    assert not near.origin.any()
    assert torch.equal(near.means, scene().means)
    stated = load_ply(double_ply(tmp_path / "c.ply", scene(), comment="offset 1000 2000 3"))
    assert stated.origin.tolist() == [1000, 2000, 3]
    assert torch.equal(stated.means, scene().means)


def test_float_positions_far_from_0_are_told_of(tmp_path, caplog):
    """They keep what they hold; in UTM coordinates that is steps of half a meter."""
    back = load_ply(double_ply(tmp_path / "a.ply", scene().replace(origin=UTM), "float"))
    assert not back.origin.any()
    assert "float32 positions around 500000 5.4e+06 120" in caplog.text
    assert "steps of 0.5" in caplog.text
    caplog.clear()
    load_ply(double_ply(tmp_path / "b.ply", scene().replace(origin=np.array([30.0, 0, 0])), "float"))
    assert not caplog.text


@pytest.mark.parametrize("text", ["nan 0 0", "1 2", "1 2 3 4", "1e300 0 0", "1 two 3", "inf 0 0"])
def test_odd_offsets_are_refused(tmp_path, text):
    """In a header, a meta.json, the comment of a gzip stream and the text beside a file; prose is none."""
    path = double_ply(tmp_path / "a.ply", scene(), comment=f"offset {text}")
    with pytest.raises(ValueError, match="a.ply: comment offset: the offset must be three finite numbers"):
        load_ply(path)
    save_gaussians(scene(), tmp_path / "a.splat")
    origin_file(tmp_path / "a.splat").write_text(text)
    with pytest.raises(ValueError, match=r"a\.splat\.offset\.xyz: the offset must be three finite numbers"):
        load_gaussians(tmp_path / "a.splat")
    prose = double_ply(tmp_path / "b.ply", scene(), comment="offset of the camera: none")
    assert not load_ply(prose).origin.any()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_spz_of_a_small_and_of_a_large_world(tmp_path, scale, caplog):
    """More bits behind the point in kilometers, fewer in millimeters: a thousandth of the scene at most."""
    g = scene()
    g = g.replace(means=scale * g.means, log_scales=g.log_scales + np.log(scale))
    if scale > 1:  # standard deviations of 100 mm are within the format
        g = g.replace(log_scales=g.log_scales.clamp(max=5.5))
    with caplog.at_level(logging.INFO, logger="drgs"):
        save_gaussians(g, tmp_path / "a.spz")
    back = load_gaussians(tmp_path / "a.spz")
    assert float((back.means - g.means).abs().max()) < 1e-3 * scale
    assert ("bits behind the point, 12 are too few" in caplog.text) == (scale < 1)
    with pytest.raises(ValueError, match=r"standard deviations of 4\.5e-05 to .* write a \.ply or \.sog"):
        save_gaussians(g.replace(log_scales=g.log_scales - np.log(1e5 * scale)), tmp_path / "b.spz")


def test_spz_of_a_scene_that_is_small_beside_what_it_reaches_to(tmp_path):
    """One Gaussian 2,000 km away leaves two bits behind the point for a scene of half a meter: refused."""
    g = scene()
    g = g.replace(means=torch.cat([g.means[1:], torch.tensor([[2e6, 0.0, 0.0]])]))
    with pytest.raises(ValueError, match=r"steps of a hundredth of a scene at most, got 0\.25 for one of size 0\.5"):
        save_gaussians(g, tmp_path / "a.spz")


def test_convert_keeps_the_origin(tmp_path):
    """From a run's file to each format, and back."""
    from drgs import cli

    save_ply(scene().replace(origin=UTM), tmp_path / "a.ply")
    for suffix in FORMATS[1:]:
        assert cli.main(["convert", str(tmp_path / "a.ply"), str(tmp_path / f"b.{suffix}"), "--quiet"]) in (0, None)
        assert cli.main(["convert", str(tmp_path / f"b.{suffix}"), str(tmp_path / "c.ply"), "--quiet"]) in (0, None)
        np.testing.assert_array_equal(load_ply(tmp_path / "c.ply").origin, UTM)


# ------------------------------------------------------------------------------------------------------------ banana


@pytest.mark.slow
def test_a_capture_in_utm_coordinates(tmp_path, data_dir):
    """`banana` moved to UTM coordinates has its PSNR within 0.05 dB, its views picked, and its files."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(data_dir / "banana" / "sparse" / "0")
    reconstruction.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    (tmp_path / "utm/sparse/0").mkdir(parents=True)
    reconstruction.write_binary(tmp_path / "utm/sparse/0")
    (tmp_path / "utm/images").symlink_to(data_dir / "banana" / "images")
    options = config(max_steps=60, max_gaussians=2000, max_pixels=10_000, init_points="all")
    results = [
        fit(load(path), tmp_path / name, options, progress=False)
        for name, path in (("near", data_dir / "banana"), ("far", tmp_path / "utm"))
    ]
    near, far = (result.metrics["mean"]["psnr"] for result in results)
    assert far == pytest.approx(near, abs=0.05)
    g = results[1].gaussians
    for suffix in FORMATS:
        save_gaussians(g, tmp_path / f"a.{suffix}")
        back = load_gaussians(tmp_path / f"a.{suffix}")
        np.testing.assert_array_equal(back.origin, g.origin)
        assert np.abs(np.median(world(back), axis=0) - np.median(world(g), axis=0)).max() < 0.05
