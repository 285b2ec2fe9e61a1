"""A rasterizer in plain torch, which docs/tutorials/rasterizer.md checks, for few Gaussians. Needs no drgs: copy it.

gsplat's conventions and names of arguments; torch differentiates it. Every Gaussian meets every pixel.
"""

import torch


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, sh_degree=None, backgrounds=None
):
    """(C, H, W, 3) images, (C, H, W, 1) opacities and a dict, of C views."""
    images, alphas = [], []
    for i, (w2c, K) in enumerate(zip(viewmats, Ks, strict=True)):
        rgb = colors if sh_degree is None else shade(means, colors[:, : (sh_degree + 1) ** 2], w2c)
        image, light = view(means, quats, scales, opacities, rgb, w2c, K, width, height)
        images.append(image if backgrounds is None else image + light * backgrounds[i])
        alphas.append(1 - light)
    return torch.stack(images), torch.stack(alphas), {}


def view(means, quats, scales, opacities, colors, w2c, K, width, height):
    """One view without a background, and how much light is left behind it."""
    local = means @ w2c[:3, :3].T + w2c[:3, 3]
    order = torch.argsort(local[:, 2])
    order = order[local[order, 2] > 0.01]  # the near plane
    x, y, z = local[order].unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    zero = torch.zeros_like(z)
    # Covariance on the image: J W Sigma W^T J^T, J the Jacobian of the perspective, and 0.3 pixels^2 more.
    J = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], 1).reshape(-1, 2, 3)
    half = J @ w2c[:3, :3] @ (rotation(quats[order]) * scales[order][:, None, :])
    conic = inverse(half @ half.mT + 0.3 * torch.eye(2).to(half))
    columns, rows = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    pixels = torch.stack([columns, rows], -1).to(means)
    d = pixels[:, :, None] - torch.stack([fx * x / z + cx, fy * y / z + cy], 1)  # (H, W, N, 2)
    alpha = opacities[order] * torch.exp(-0.5 * torch.einsum("hwni,nij,hwnj->hwn", d, conic, d))
    alpha = torch.where(alpha < 1 / 255, 0, alpha.clamp(max=0.999))
    behind = torch.cumprod(1 - alpha, -1)
    front = torch.cat([torch.ones_like(behind[..., :1]), behind[..., :-1]], -1)
    return torch.einsum("hwn,nd->hwd", alpha * front, colors[order]), behind[..., -1:]


def shade(means, sh, w2c):
    """(N, 3) colors of (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16, seen from the camera."""
    x, y, z = torch.nn.functional.normalize(means + w2c[:3, :3].mT @ w2c[:3, 3], dim=1).unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [0.28209479 * torch.ones_like(x), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x]
    basis += [1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2 * zz - xx - yy), -1.09254843 * x * z]
    basis += [0.54627422 * (xx - yy), -0.59004359 * y * (3 * xx - yy), 2.89061144 * x * y * z]
    basis += [-0.45704580 * y * (4 * zz - xx - yy), 0.37317633 * z * (2 * zz - 3 * xx - 3 * yy)]
    basis += [-0.45704580 * x * (4 * zz - xx - yy), 1.44530572 * z * (xx - yy), -0.59004359 * x * (xx - 3 * yy)]
    return (0.5 + (torch.stack(basis[: sh.shape[1]], 1)[..., None] * sh).sum(1)).clamp(min=0)


def rotation(quats):
    """(N, 3, 3) of (N, 4) wxyz."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def inverse(covariance):
    """Of (N, 2, 2)."""
    return torch.linalg.inv(covariance)
