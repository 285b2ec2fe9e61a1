"""The dense Jacobian of the float64 oracle, and what follows from it, for tests of Fisher information."""

from __future__ import annotations

import torch
from scenes_random import camera, gaussians, twist_basis

from drgs import reference

GROUPS = ("means", "rotations", "log_scales", "logit_opacities", "sh")


def scene(rng, settings, n=8, K=4, size=(12, 10), tries=50, **options):
    """A random scene without a pixel that hangs on a near tie, and its oracle output."""
    for _ in range(tries):
        g, cam = gaussians(rng, n, K, scale=0.25, **options), camera(rng, size)
        out = reference.render(g, cam, settings, tolerance=1e-5)
        if not out.ambiguous.any() and out.count.max() > 1:
            return g, cam, out
    raise AssertionError(f"no scene without ties in {tries}")


def jacobian(g, out) -> dict[str, torch.Tensor]:
    """Group -> (3 P, parameters...) float64 derivative of the oracle's rgb."""
    flat = out.rgb.reshape(-1)
    leaves = [x for name, x in g.parameters().items() if name != "features"]
    names = [name for name in g.parameters() if name != "features"]
    rows = _rows(flat, leaves)
    J = {
        name: torch.zeros(len(flat), *x.shape, dtype=torch.float64) if row is None else row.double()
        for name, x, row in zip(names, leaves, rows, strict=True)
    }
    J["rotations"] = turn(g.quats.detach().double(), J.pop("quats"))
    return {name: J[name] for name in GROUPS}


def turn(quats, slope) -> torch.Tensor:
    """(..., N, 3) derivative by a world-frame rotation R <- exp([w]x) R of one by the quaternion (..., N, 4)."""
    w, x, y, z = quats.unbind(1)
    moves = torch.stack(  # dq/dw_k = (0, e_k) q / 2, written out
        [torch.stack([-x, w, -z, y], 1), torch.stack([-y, z, w, -x], 1), torch.stack([-z, -y, x, w], 1)], 1
    )
    return 0.5 * torch.einsum("...nq,nkq->...nk", slope, moves)


def stacked(J: dict) -> torch.Tensor:
    """(3 P, N, 13): the order of `fisher.blocks`."""
    base = J["sh"][:, :, 0]
    return torch.cat([J["means"], J["rotations"], J["log_scales"], J["logit_opacities"][..., None], base], -1)


def squares(J: dict) -> dict[str, torch.Tensor]:
    """The diagonal of J^T J by group."""
    return {name: x.square().sum(0) for name, x in J.items()}


def error(a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest difference, relative to the largest entry of b."""
    return float((a - b).abs().max() / b.abs().max().clamp_min(1e-12))


def pose_jacobian(cam, out) -> torch.Tensor:
    """(3 P, 6) derivative of the oracle's rgb along world-frame twists of the pose."""
    (rows,) = _rows(out.rgb.reshape(-1), [cam.w2c])
    return torch.einsum("pij,kij->pk", rows, -cam.w2c.detach() @ twist_basis())


def _rows(flat, leaves):
    identity = torch.eye(len(flat), dtype=flat.dtype)
    return torch.autograd.grad(flat, leaves, identity, True, is_grads_batched=True, allow_unused=True)
