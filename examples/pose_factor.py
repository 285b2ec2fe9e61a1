"""A photometric factor for pose graphs: residual, Jacobian and information of one view, all in one forward-mode call.

    import gtsam
    from examples.pose_factor import error_function
    noise = gtsam.noiseModel.Isotropic.Sigma(3 * width * height, 0.05)
    graph.add(gtsam.CustomFactor(noise, [key], error_function(gaussians, camera, photograph)))

Poses are GTSAM's `Pose3`: camera to world, axes right, down, forward, and a step is taken on the right, T <- T exp(xi),
xi = (rotation, translation) in the camera's own axes. drgs differentiates along twists of the world,
T <- exp(xi_w) T; xi_w = Ad(T) xi turns one into the other. Nothing of GTSAM is imported here: `linearize` serves Ceres,
g2o or a plain Gauss-Newton step as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

import drgs
from drgs import fisher


def linearize(
    gaussians: drgs.Gaussians,
    camera: drgs.Camera,
    photograph: torch.Tensor,
    settings: drgs.RenderSettings | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Residual and Jacobian of an image at a camera's pose.

    Args:
        gaussians: Gaussians of the scene.
        camera: Camera at the pose that is linearized at.
        photograph: (H, W, 3) photograph, values as the Gaussians' colors.
        settings: Render settings; default preset `exact`.
    Returns:
        (3 H W,) float64 render minus photograph, and (3 H W, 6) its derivative along a step in the camera's axes,
        rotation (radians) first, then translation (world units).
    """
    rendered = drgs.render(gaussians.detach(), camera, settings, outputs=()).rgb
    columns = fisher.jacobian_columns(gaussians, camera, {"camera": range(6)}, settings)[..., :3]
    of_world = columns.reshape(6, -1).double().cpu().numpy().T
    residual = (rendered.cpu().double() - photograph.double()).reshape(-1).numpy()
    return residual, of_world @ adjoint(camera.c2w)


def adjoint(c2w: np.ndarray) -> np.ndarray:
    """(6, 6) from a twist in the camera's axes to the same motion as a twist of the world, rotation first."""
    R, (x, y, z) = c2w[:3, :3], c2w[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, np.zeros((3, 3))], [cross @ R, R]])


def covariance(jacobian: np.ndarray, sigma: float) -> np.ndarray:
    """(6, 6) of the pose, for noise of standard deviation `sigma` in every channel.

    Raises:
        numpy.linalg.LinAlgError: If the view says nothing about some motion.
    """
    return sigma**2 * np.linalg.inv(jacobian.T @ jacobian)


def error_function(
    gaussians: drgs.Gaussians,
    camera: drgs.Camera,
    photograph: torch.Tensor,
    settings: drgs.RenderSettings | None = None,
) -> Callable:
    """What `gtsam.CustomFactor` calls: (factor, values, jacobians or None) -> residual."""

    def error(factor, values, jacobians=None) -> np.ndarray:
        c2w = np.asarray(values.atPose3(factor.keys()[0]).matrix())
        here = dataclasses.replace(camera, w2c=np.linalg.inv(c2w))
        if jacobians is None:
            rendered = drgs.render(gaussians.detach(), here, settings, outputs=()).rgb
            return (rendered.cpu().double() - photograph.double()).reshape(-1).numpy()
        residual, jacobians[0] = linearize(gaussians, here, photograph, settings)
        return residual

    return error
