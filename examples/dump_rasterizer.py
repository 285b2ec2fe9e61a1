"""Runs a rasterizer once and writes what `drgs crossval --rasterizer dump.npz` compares. Needs no drgs: copy it.

    python dump_rasterizer.py scene.npz dump.npz

`scene.npz` comes from `drgs crossval --export scene.npz`. N Gaussians, C views, B coefficients: means (N,3), quats
(N,4) wxyz, log_scales (N,3), logit_opacities (N,), sh (N,B,3), viewmat (C,4,4), K (C,3,3), width, height,
background (3,), cotangent (C,H,W,3). `dump.npz` repeats them, so that it tells its scene, and adds image (C,H,W,3),
alpha (C,H,W), and the gradient of sum <cotangent, image> by raw parameter and by viewmat, shaped as these: grad_means,
grad_quats, ..., grad_viewmat (which may be left out).
"""

import sys

import numpy as np
import torch
from gsplat import rasterization  # yours instead, and the call below where its arguments differ

scene = dict(np.load(sys.argv[1]))
x = {k: torch.tensor(v, device="cuda" if torch.cuda.is_available() else "cpu") for k, v in scene.items()}
names = ("means", "quats", "log_scales", "logit_opacities", "sh", "viewmat")
raw = [x[k].requires_grad_() for k in names]
width, height, views = int(x["width"]), int(x["height"]), len(x["viewmat"])
splats = (raw[0], raw[1], raw[2].exp(), raw[3].sigmoid(), *raw[4:], x["K"])
options = {"sh_degree": round(raw[4].shape[1] ** 0.5) - 1, "backgrounds": x["background"].repeat(views, 1)}
image, alpha, *_ = rasterization(*splats, width, height, **options)
image.backward(x["cotangent"])
scene |= {"image": image.detach().cpu().numpy(), "alpha": alpha.detach().cpu().numpy().reshape(views, height, width)}
offered = [name for name in names if name != "viewmat" or x[name].grad is not None]
scene |= {f"grad_{k}": (torch.zeros_like(x[k]) if x[k].grad is None else x[k].grad).cpu().numpy() for k in offered}
np.savez_compressed(sys.argv[2], **scene)
