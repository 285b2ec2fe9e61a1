"""Claims of components.poses: wrong poses are found again, the gauge holds, and runs remember what was refined."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_train import config, dataset  # noqa: F401 (a fixture)

import drgs
from drgs.cameras import Camera, intrinsics, look_at, orbit
from drgs.data.camera_lists import load_cameras_json
from drgs.files import Run, load_state
from drgs.fitting.components.poses import CAMERAS, PoseEvidence, Poses, motion, pose_network, refined_against
from drgs.fitting.frames import Frame
from drgs.fitting.records import fit_record
from drgs.settings import RenderSettings
from drgs.train import fit

FAST = RenderSettings.preset("fast")


def blobs(count=60, seed=1):
    """Gaussians of all colors around the origin."""
    make = np.random.default_rng(seed)
    return drgs.Gaussians.from_arrays(
        make.normal(size=(count, 3)).astype(np.float32) * 0.6,
        make.normal(size=(count, 4)),
        make.uniform(0.06, 0.2, (count, 3)),
        make.uniform(0.5, 0.95, count),
        make.normal(size=(count, 1, 3)) * 1.2,
    )


def off(camera, turn, move):
    """A camera turned about its center by a rotation vector, and moved, in world axes."""
    import cv2

    c2w = camera.c2w.copy()
    c2w[:3, :3] = cv2.Rodrigues(np.asarray(turn, float))[0] @ c2w[:3, :3]
    c2w[:3, 3] += move
    return dataclasses.replace(camera, w2c=np.linalg.inv(c2w))


def apart(a, b):
    """(degrees, units) between two cameras."""
    cosine = (np.trace(a.c2w[:3, :3] @ b.c2w[:3, :3].T) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.linalg.norm(a.c2w[:3, 3] - b.c2w[:3, 3])


@pytest.fixture(scope="module")
def photographs():
    """(Gaussians, six photographs with cameras that are wrong, the true cameras); errors have nothing in common."""
    g = blobs()
    true = [dataclasses.replace(c, name=f"v{k}") for k, c in enumerate(orbit((0, 0, 0), 3.0, 6, width=48, height=40))]
    turns, moves = np.random.default_rng(3).normal(size=(2, 6, 3)) * 0.01
    frames = []
    for camera, turn, move in zip(true, turns, 2 * moves, strict=True):
        with torch.no_grad():
            image = drgs.render(g, camera, FAST).rgb
        frames.append(Frame(camera.name, off(camera, turn, move), image))
    return g, frames, true


def test_motion_is_the_exponential():
    """Against SciPy's matrix exponential, near 0 and at a turn of a radian."""
    from scipy.linalg import expm

    for twist in ([1e-9, 0, 2e-9, 1, 2, 3], [0.6, -0.5, 0.6, -1, 0.3, 2], [0.01, 0.02, -0.01, 0, 0, 0.1]):
        (a, b, c), v = twist[:3], twist[3:]
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]], v
        found = motion(torch.tensor(twist, dtype=torch.float64)).numpy()
        assert np.abs(found - expm(generator)).max() < 1e-12


def test_poses_are_found_by_the_optimizer(photographs):
    """With the scene as it is, 40 steps a view leave a tenth of the errors, in what pictures show of them."""
    g, frames, true = photographs
    poses = Poses([frame.camera for frame in frames], 3.0, FAST, 2.0)
    poses.begin(g)
    network = pose_network(poses)  # its gauge is left alone: the scene stands still here, and holds it
    before, after = [], []
    for step in range(40 * len(frames)):
        frame = frames[step % len(frames)]
        network.set_rate(0.15 + 0.75 * step / (40 * len(frames)))
        network.optimizer.zero_grad(set_to_none=True)
        seen = poses(frame)
        loss = (drgs.render(g, seen.camera, FAST).rgb - frame.image()).abs().mean()
        loss.backward()
        network.optimizer.step()
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.6
    for frame, camera, now in zip(frames, true, poses.cameras(), strict=True):
        where = camera.project(points)[0]
        before.append(np.linalg.norm(frame.camera.project(points)[0] - where, axis=1).mean())
        after.append(np.linalg.norm(now.project(points)[0] - where, axis=1).mean())
    assert np.mean(before) > 0.5  # pixels
    assert np.mean(after) < 0.1 * np.mean(before)


def test_the_gauge_is_held(photographs):
    """A step of all cameras together is taken back whole; what they do not have in common stays as it is."""
    g, frames, _ = photographs
    poses = Poses([frame.camera for frame in frames], 3.0, FAST, 2.0)
    poses.begin(g)
    centers = np.stack([frame.camera.c2w[:3, 3] for frame in frames])
    middle = centers.mean(0)

    def put(turn, move, growth):
        with torch.no_grad():
            for row, x in enumerate(poses.coordinates):
                twist = np.concatenate([turn, move - np.cross(turn, middle) + growth * (centers[row] - middle)])
                x += torch.linalg.solve(poses._twist_of[row] @ poses.whitening[row], torch.tensor(twist))

    put(np.array([0.01, -0.02, 0.015]), np.array([0.03, 0.01, -0.02]), 0.02)
    assert poses.displacement()["moved"] > 0.02
    poses.hold_gauge()
    assert max(poses.displacement()[k] for k in ("degrees", "moved")) < 1e-9
    with torch.no_grad():
        for row, x in enumerate(poses.coordinates):
            x += torch.randn(6, generator=torch.Generator().manual_seed(row), dtype=torch.float64) * 0.01
    poses.hold_gauge()
    held = [x.detach().clone() for x in poses.coordinates]
    put(np.array([0.01, 0.01, 0.0]), np.array([0.0, 0.02, 0.02]), -0.01)
    poses.hold_gauge()
    for x, was in zip(poses.coordinates, held, strict=True):
        assert torch.allclose(x, was, atol=1e-9)


def test_no_camera_goes_further_than_its_reach(photographs):
    """What a pose is moved too far by is taken back until points in its picture move by the reach, root mean square."""
    g, frames, _ = photographs
    poses = Poses([frame.camera for frame in frames], 3.0, FAST, 0.5)
    poses.begin(g)
    means = g.means.detach().numpy()
    weights = np.append(g.logit_opacities.detach().sigmoid().numpy(), 1.0)
    with torch.no_grad():
        for row, z in enumerate(poses.coordinates):
            u = torch.randn(6, generator=torch.Generator().manual_seed(row), dtype=torch.float64) * 0.02
            z += torch.linalg.solve(poses.whitening[row], u)
    poses.hold_reach()
    for frame, now in zip(frames, poses.cameras(), strict=True):
        middle = frame.camera.c2w[:3, 3] + 3.0 * frame.camera.c2w[:3, 2]
        points = np.concatenate([means, middle[None]])
        apart_by = np.linalg.norm(now.project(points)[0] - frame.camera.project(points)[0], axis=1)
        assert np.sqrt(np.average(np.square(apart_by), weights=weights)) == pytest.approx(0.5, rel=0.05)


def test_a_camera_that_sees_nothing_has_a_reach(photographs):
    """Where the picture is empty when refinement begins, a step is bounded like any other."""
    g, frames, _ = photographs
    away = dataclasses.replace(frames[0].camera, w2c=np.diag([-1.0, 1, -1, 1]) @ frames[0].camera.w2c)
    poses = Poses([away, *(frame.camera for frame in frames[1:])], 3.0, FAST, 0.5)
    poses.begin(g)
    with torch.no_grad():
        poses.coordinates[0] += 5e-3  # a first step of Adam
    poses.hold_reach()
    middle = (away.c2w[:3, 3] + 3.0 * away.c2w[:3, 2])[None]
    moved = poses.cameras()[0].project(middle)[0] - away.project(middle)[0]
    assert 0 < np.linalg.norm(moved) < 0.6


def test_a_camera_is_refined_against_its_photograph(photographs):
    """With the scene as it is, a photograph gives its own pose back; the true one stays where it is."""
    g, frames, true = photographs
    found = refined_against(g, frames[0], FAST)
    wrong = apart(frames[0].camera, true[0])
    right = apart(found, true[0])
    assert right[0] < 0.05 * wrong[0]
    assert right[1] < 0.05 * wrong[1]
    stays = refined_against(g, dataclasses.replace(frames[0], camera=true[0]), FAST)
    assert max(apart(stays, true[0])) < 1e-4


def test_a_camera_is_refined_only_as_far_as_a_linear_model_holds(photographs):
    """One round Gaussian says next to nothing about turns around it: steps that would turn by many radians are none."""
    _, frames, _ = photographs
    camera = Camera(intrinsics(20.0, 20.0, 8.0, 8.0), look_at((0, 0, -3), (1e-7, 0, 0), (0, -1, 0)), 16, 16)
    alone = drgs.Gaussians.from_arrays(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.3),
        torch.tensor([0.9]),
        torch.ones(1, 1, 3),
    )
    pixels = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    frame = dataclasses.replace(frames[0], camera=camera, pixels=(255 * pixels).to(frames[0].pixels.dtype), mask=None)
    found = refined_against(alone, frame, FAST)
    assert apart(found, camera)[0] < 90


def test_stated_poses_until_it_begins(photographs):
    """Before the refinement, cameras are the data set's to the last bit but for rounding, and a gauge changes none."""
    _, frames, _ = photographs
    poses = Poses([frame.camera for frame in frames], 3.0, FAST, 2.0)
    poses.hold_gauge()
    assert not poses.has_begun
    assert poses.displacement() == {"cameras": 6, "degrees": 0.0, "moved": 0.0}


@pytest.mark.parametrize(("angle", "clear"), [(None, False), (1e-3, False), (0.02, True)])
def test_evidence(photographs, angle, clear):
    """An error of observations counts in pixels of the fit; without observations nothing is refined."""
    _, frames, _ = photographs
    found = PoseEvidence.of(angle, frames)
    assert found.is_clear is clear
    assert found.reach == (2.0 if angle is None else 3 * found.pixels)
    if angle is not None:
        assert found.pixels == pytest.approx(angle * frames[0].camera.K[0, 0])


@pytest.mark.same_bits
def test_a_fit_refines_and_everybody_sees_the_cameras(dataset, whole_and_resumed):  # noqa: F811
    """Stopped in its middle and resumed, a fit ends with the same cameras; a run's views are loaded with these,
    held-out views keep theirs, and information is asked for with poses eliminated.
    """
    settings = config(max_steps=20, save_every=5, poses="refined", deterministic=True)
    runs = whole_and_resumed(dataset, settings, 12)
    states = [load_state(run.state)[0] for run in runs]
    assert any(name.startswith("poses.") for name in states[0])
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    assert (runs[0].path / CAMERAS).read_bytes() == (runs[1].path / CAMERAS).read_bytes()
    assert runs[1].config()["poses"] == {"reprojection": None, "refined": True}
    record = fit_record(runs[0])
    assert record.estimated == ("pose",)
    told = json.loads((runs[0].path / "metrics.json").read_text())["poses"]
    assert told["degrees"] > 0
    assert {view["name"] for view in told["views"]} == set(record.test)
    found = {camera.name: camera for camera in load_cameras_json(runs[0].path / CAMERAS)}
    assert set(found) == set(record.train)
    copy = dataclasses.replace(dataset, views=[dataclasses.replace(view) for view in dataset.views])
    stated = {view.name: view.camera for view in dataset.views}
    train, test = record.with_refined_poses(copy).split()
    for view in train:
        assert np.abs(view.camera.w2c - found[view.name].w2c).max() < 1e-9
        assert np.abs(view.camera.w2c - stated[view.name].w2c).max() > 1e-6
    assert all(np.array_equal(view.camera.w2c, stated[view.name].w2c) for view in test)
    (runs[0].path / CAMERAS).unlink()
    with pytest.raises(FileNotFoundError, match="must hold the cameras that the fit has refined, found none"):
        fit_record(runs[0])


@pytest.mark.same_bits
def test_poses_stay_where_nothing_says_they_are_off(dataset, tmp_path):  # noqa: F811
    """A data set without observations: auto refines nothing and fits to the same bits as with fixed poses."""
    runs = []
    for use in ("auto", "fixed"):
        fit(dataset, tmp_path / use, config(max_steps=4, poses=use, deterministic=True), progress=False)
        runs.append(Run(tmp_path / use))
    assert runs[0].config()["poses"] == {"reprojection": None, "refined": False}
    assert "poses" not in runs[1].config()
    states = [load_state(run.state)[0] for run in runs]
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    assert not (runs[0].path / CAMERAS).exists()
