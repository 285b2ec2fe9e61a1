"""What density control reads of `drgs.rasterization`: gradients of projected means, signed and absolute."""

from __future__ import annotations

import pytest
import torch
from test_rasterize import arguments

import drgs


def brute_force(given, meta, camera, u, v, depth=False):
    """Gradients of <u, image> + <v, alpha> of one view by the projected means, (P, N, 2) for each pixel, in float64.

    Every pixel has projected means of its own, and sees them as the rasterizer's model says; conics, depths and
    opacities are those of `meta`.
    """
    rows, columns = torch.meshgrid(
        torch.arange(given["height"]) + 0.5, torch.arange(given["width"]) + 0.5, indexing="ij"
    )
    pixels = torch.stack([columns, rows], -1).reshape(-1, 1, 2).double()
    drawn = (meta["radii"][camera] > 0).all(-1)
    means2d = meta["means2d"][camera].detach().expand(len(pixels), -1, 2).clone().requires_grad_()
    order = meta["depths"][camera].argsort()
    x, y = (pixels - means2d)[:, order].unbind(-1)
    a, b, c = meta["conics"][camera][order].unbind(-1)
    response = torch.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)
    alpha = meta["opacities"][camera][order] * response
    alpha = torch.where(alpha > 0.999, 0.999, alpha)  # no gradient where clamped
    alpha = torch.where((alpha >= 1 / 255) & drawn[order], alpha, 0.0)
    left = torch.cumprod(1 - alpha, 1)
    alpha = torch.where(torch.cummax((left <= 1e-4).int(), 1)[0] > 0, 0.0, alpha)  # the ray has ended
    left = torch.cumprod(1 - alpha, 1)
    weights = alpha * torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    total = weights.sum(1, keepdim=True)
    image = weights @ given["colors"][order] + (1 - total) * given["backgrounds"][camera]
    if depth:
        image = torch.cat([image, weights @ meta["depths"][camera][order, None]], 1)
    loss = (image * u.reshape(len(pixels), -1)).sum() + (total * v.reshape(-1, 1)).sum()
    (found,) = torch.autograd.grad(loss, [means2d])
    return image.detach(), found


@pytest.mark.parametrize("channels", [1, 3, 40])
@pytest.mark.parametrize(
    "options",
    [{}, {"render_mode": "RGB+D"}, {"far_plane": 4.0, "near_plane": 2.0}, {"rasterize_mode": "antialiased"}],
    ids=["plain", "depth", "planes", "antialiased"],
)
def test_gradients_of_projected_means(options, channels):
    """Of every Gaussian and view: sums over pixels of the gradients and of their absolute values, in pixels."""
    given = arguments(n=14, width=22, height=17, channels=channels, cameras=2)
    given["opacities"][:3] = 1.0
    leaf = given["means"].clone().requires_grad_()
    image, alpha, meta = drgs.rasterization(**{**given, "means": leaf}, absgrad=True, **options)
    make = torch.Generator().manual_seed(4)
    u, v = (torch.randn(x.shape, generator=make, dtype=torch.float64) for x in (image, alpha))
    meta["means2d"].retain_grad()  # as gsplat's strategies do before the backward pass
    ((image * u).sum() + (alpha * v).sum()).backward()
    assert meta["means2d"].grad.shape == meta["means2d"].absgrad.shape == (2, 14, 2)
    depth = "render_mode" in options
    for camera in range(2):
        expected, by_pixel = brute_force(given, meta, camera, u[camera], v[camera], depth)
        assert float((image[camera].reshape(expected.shape) - expected).abs().max()) < 1e-4
        for name, wanted in (("grad", by_pixel.sum(0)), ("absgrad", by_pixel.abs().sum(0))):
            got = getattr(meta["means2d"], name)[camera]
            assert float(wanted.norm()) > 1
            assert float((got - wanted).norm()) < 2e-4 * float(wanted.norm()), name
            drawn = (meta["radii"][camera] > 0).all(-1)
            assert not got[~drawn].any()
        assert bool((meta["means2d"].absgrad[camera] >= 0.999 * meta["means2d"].grad[camera].abs()).all())


@pytest.mark.parametrize("packed", [True, False])
def test_meta_has_what_strategies_ask_for(packed):
    """The entries that gsplat's DefaultStrategy insists on, laid out as with `packed=False`."""
    given = arguments(n=5, channels=3, cameras=2)
    given["means"].requires_grad_()
    meta = drgs.rasterization(**given, packed=packed)[2]
    assert {"width", "height", "n_cameras", "radii", "gaussian_ids", "means2d"} <= set(meta)
    assert meta["gaussian_ids"] is None
    assert meta["radii"].shape == (2, 5, 2)
    assert meta["means2d"].requires_grad
