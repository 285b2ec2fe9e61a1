"""The photometric pose factor of examples/: its Jacobian is that of GTSAM's steps, and Gauss-Newton finds the pose."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.linalg import expm

import drgs
from drgs.cameras import intrinsics_from_fov, look_at
from examples import pose_factor

pytestmark = pytest.mark.core


def stepped(c2w, xi):
    """T exp(xi), xi = (rotation, translation) in the camera's axes."""
    (a, b, c), v = xi[:3], xi[3:]
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]], v
    return c2w @ expm(twist)


@pytest.fixture(scope="module")
def scene():
    make = np.random.default_rng(0)
    n = 30
    g = drgs.Gaussians.from_arrays(
        make.normal(size=(n, 3)).astype(np.float32) * 0.5,
        make.normal(size=(n, 4)),
        make.uniform(0.1, 0.25, (n, 3)),
        make.uniform(0.4, 0.9, n),
        make.normal(size=(n, 4, 3)) * 0.5,
    )
    w2c = look_at((0.4, -0.3, -3.0), (0, 0, 0), (0, -1, 0))
    camera = drgs.Camera(K=intrinsics_from_fov(50.0, 32, 24), w2c=w2c, width=32, height=24)
    return g, camera, drgs.render(g, camera).rgb


def test_jacobian_is_that_of_steps_in_the_cameras_axes(scene):
    """Central differences of T exp(xi) of the oracle; in `center` order, where no pixel jumps within the step."""
    g, camera, photograph = scene
    settings = drgs.RenderSettings.preset("exact", order="center")
    _, jacobian = pose_factor.linearize(g, camera, photograph, settings)
    for k in range(6):
        xi = 1e-3 * np.eye(6)[k]
        ends = []
        for sign in (1, -1):
            moved = dataclasses.replace(camera, w2c=np.linalg.inv(stepped(camera.c2w, sign * xi)))
            ends.append(drgs.reference.render(g, moved, settings).rgb.reshape(-1))
        expected = ((ends[0] - ends[1]) / 2e-3).numpy()
        # The differences are off by their third-order term.
        np.testing.assert_allclose(jacobian[:, k], expected, rtol=0, atol=1e-3 * np.abs(expected).max(), err_msg=str(k))


def test_gauss_newton_finds_the_pose(scene):
    """Through the function that `gtsam.CustomFactor` is given, from two degrees and five centimeters away."""
    g, camera, photograph = scene
    error = pose_factor.error_function(g, camera, photograph)
    factor = SimpleNamespace(keys=lambda: [7])
    c2w = stepped(camera.c2w, np.array([0.03, -0.02, 0.02, 0.03, -0.03, 0.03]))
    for _ in range(8):
        values = SimpleNamespace(atPose3=lambda key, at=c2w: SimpleNamespace(matrix=lambda: at))
        jacobians = [None]
        residual = error(factor, values, jacobians)
        np.testing.assert_array_equal(residual, error(factor, values))
        c2w = stepped(c2w, -np.linalg.lstsq(jacobians[0], residual, rcond=None)[0])
    assert np.abs(c2w - camera.c2w).max() < 1e-4
    spread = pose_factor.covariance(jacobians[0], 0.02)
    assert np.linalg.eigvalsh(spread).min() > 0


def test_in_a_graph_of_gtsam(scene):
    """Its optimizer finds the pose, and its marginal covariance is ours."""
    gtsam = pytest.importorskip("gtsam", reason="no GTSAM: pip install gtsam")
    g, camera, photograph = scene
    noise = gtsam.noiseModel.Isotropic.Sigma(photograph.numel(), 0.02)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(noise, [7], pose_factor.error_function(g, camera, photograph)))
    values.insert(7, gtsam.Pose3(camera.c2w).retract(np.array([0.03, -0.02, 0.02, 0.03, -0.03, 0.03])))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    pose = found.atPose3(7).matrix()
    assert np.abs(pose - camera.c2w).max() < 1e-4
    _, jacobian = pose_factor.linearize(g, dataclasses.replace(camera, w2c=np.linalg.inv(pose)), photograph)
    marginal = gtsam.Marginals(graph, found).marginalCovariance(7)
    np.testing.assert_allclose(marginal, pose_factor.covariance(jacobian, 0.02), rtol=1e-6, atol=1e-9 * marginal.max())


def test_covariance_is_pose_information_in_the_cameras_axes(scene):
    g, camera, photograph = scene
    _, jacobian = pose_factor.linearize(g, camera, photograph)
    A = pose_factor.adjoint(camera.c2w)
    expected = A.T @ drgs.fisher.pose_information(g, camera).numpy() @ A
    np.testing.assert_allclose(jacobian.T @ jacobian, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert torch.isfinite(torch.from_numpy(jacobian)).all()
