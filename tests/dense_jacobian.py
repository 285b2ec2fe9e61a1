"""The dense Jacobian of the float64 oracle (`drgs.lab.accuracy`), and what tests of Fisher information make of it."""

from __future__ import annotations

import torch
from scenes_random import camera, gaussians

from drgs import reference
from drgs.lab.accuracy import entry_error as error
from drgs.lab.accuracy import jacobian, squares, turn, twist_basis

__all__ = ["GROUPS", "error", "feature_jacobian", "jacobian", "pose_jacobian", "scene", "squares", "stacked", "turn"]

GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh")


def scene(rng, settings, n=8, K=4, size=(12, 10), tries=50, **options):
    """A random scene without a pixel that hangs on a near tie, and its oracle output."""
    for _ in range(tries):
        g, cam = gaussians(rng, n, K, scale=0.25, **options), camera(rng, size)
        out = reference.render(g, cam, settings, tolerance=1e-5)
        if not out.ambiguous.any() and out.count.max() > 1:
            return g, cam, out
    raise AssertionError(f"no scene without ties in {tries}")


def stacked(J: dict) -> torch.Tensor:
    """(3 P, N, 13): the order of `fisher.blocks`."""
    base = J["sh"][:, :, 0]
    return torch.cat([J["means"], J["rotations"], J["log_scales"], J["logit_opacities"][..., None], base], -1)


def feature_jacobian(g, out) -> dict[str, torch.Tensor]:
    """Group of the geometry -> (P D, parameters...) derivative of the oracle's feature image."""
    names = ["means", "quats", "log_scales", "logit_opacities"]
    flat = out.features.reshape(-1)
    rows = torch.autograd.grad(
        flat, [getattr(g, name) for name in names], torch.eye(len(flat), dtype=flat.dtype), True, is_grads_batched=True
    )
    J = {name: x.double() for name, x in zip(names, rows, strict=True)}
    J["rotations"] = turn(g.quats.detach().double(), J.pop("quats"))
    return J


def pose_jacobian(cam, out) -> torch.Tensor:
    """(3 P, 6) derivative of the oracle's rgb along world-frame twists of the pose."""
    flat = out.rgb.reshape(-1)
    (rows,) = torch.autograd.grad(flat, cam.w2c, torch.eye(len(flat), dtype=flat.dtype), True, is_grads_batched=True)
    return torch.einsum("pij,kij->pk", rows, -cam.w2c.detach() @ twist_basis())
