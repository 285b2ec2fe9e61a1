"""Mitsuba's `volprim_rf_basic` as a torch function with gsplat's arguments, to hold it against others.

    drgs crossval scene.ply --cameras cameras.json --rasterizer examples.volprim_adapter:volprim_rf_basic -o out

`volprim_rf_basic` is the integrator as shipped, which converts its result from sRGB to linear light;
`volprim_rf_basic_linear` is the same with `srgb_primitives=False`. One sample a pixel, at its center. The integrator
knows neither background nor alpha: alpha is the image of the same Gaussians in white, and the background is put behind.
Gradients are Mitsuba's own (its `render_backward`), torch adds the normalization of quaternions.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
import torch

from drgs import runtime
from drgs.cameras import Camera
from drgs.ellipsoids import Y_00


def volprim_rf_basic(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
    """(C,H,W,3) image, (C,H,W,1) alpha, {}: with the sRGB step on, as shipped. See `rasterize`."""
    return rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height, srgb=True, **options)


def volprim_rf_basic_linear(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
    """(C,H,W,3) image, (C,H,W,1) alpha, {}: with `srgb_primitives=False`. See `rasterize`."""
    return rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height, srgb=False, **options)


def rasterize(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    *,
    srgb,
    sh_degree=None,
    backgrounds=None,
    near_plane=0.01,
    **unused,
):
    """Images of N Gaussians from C pinhole cameras.

    Args:
        means: (N, 3), world frame.
        quats: (N, 4) wxyz.
        scales: (N, 3) standard deviations.
        opacities: (N,).
        colors: (N, K, 3) SH coefficients when `sh_degree` is given, else (N, 3).
        viewmats: (C, 4, 4) world to camera, OpenCV axes.
        Ks: (C, 3, 3) in pixels, square pixels.
        width, height: Pixels.
        srgb: Mitsuba's `srgb_primitives`.
        sh_degree: 0..3 or None.
        backgrounds: (C, 3) or None for black.
        near_plane: Distance at which rays start.
        **unused: Other options of gsplat are ignored.
    Returns:
        (C, H, W, 3) image, (C, H, W, 1) alpha, {}; float32.
    Gradients:
        Reach means, quats, scales, opacities and colors.
    """
    unit = torch.nn.functional.normalize(quats, dim=-1)[:, [1, 2, 3, 0]]  # Mitsuba's order is xyzw
    data = torch.cat([means, scales, unit], 1)
    sh = (colors - 0.5)[:, None] / Y_00 if sh_degree is None else colors[:, : (sh_degree + 1) ** 2]
    white = torch.full((len(means), 1, 3), 0.5 / Y_00)
    images, alphas = [], []
    for i, (pose, K) in enumerate(zip(viewmats, Ks, strict=True)):
        camera = Camera(K=_numpy(K), w2c=_numpy(pose), width=width, height=height)
        image = _Volprim.apply(data, opacities, sh, camera, near_plane, srgb)
        alpha = _Volprim.apply(data, opacities, white, camera, near_plane, False)[..., :1]
        if backgrounds is not None:
            image = image + (1 - alpha) * backgrounds[i].to(image)
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), {}


def _numpy(x) -> np.ndarray:
    return torch.as_tensor(x).detach().cpu().double().numpy()


class _Volprim(torch.autograd.Function):
    """`mi.render` of (N, 10) data, (N,) opacities and (N, K, 3) coefficients, and its `render_backward`."""

    @staticmethod
    def forward(ctx, data, opacities, sh, camera, near, srgb):
        mi = runtime.mitsuba()
        arrays = {"data": data, "opacities": opacities[:, None], "sh_coeffs": sh.reshape(len(sh), -1)}
        tensors = {k: mi.TensorXf(np.ascontiguousarray(_numpy(v), np.float32)) for k, v in arrays.items()}
        sensor = camera.to_mitsuba(near=near)
        sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}  # pixel centers
        integrator = {"type": "volprim_rf_basic", "srgb_primitives": srgb}
        shape = {"type": "ellipsoids", **tensors}
        ctx.scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "shape": shape})
        ctx.like = [(x.dtype, x.shape) for x in (data, opacities, sh)]
        image = np.array(mi.render(ctx.scene, spp=1))[..., :3]
        return torch.from_numpy(np.ascontiguousarray(image, np.float32))

    @staticmethod
    def backward(ctx, cotangent):
        mi = runtime.mitsuba()
        params = mi.traverse(ctx.scene)
        keys = ["shape.data", "shape.opacities", "shape.sh_coeffs"]
        params.keep(keys)
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        u = mi.TensorXf(np.ascontiguousarray(_numpy(cotangent), np.float32))
        ctx.scene.integrator().render_backward(ctx.scene, params, u, sensor=0, spp=1)
        found = [np.array(dr.grad(params[key]), np.float32) for key in keys]
        for key in keys:
            dr.disable_grad(params[key])
        gradients = [torch.from_numpy(x).reshape(s).to(d) for x, (d, s) in zip(found, ctx.like, strict=True)]
        return *gradients, None, None, None
