"""Of coincident ellipsoids only one is found by restarting rays. Needs mitsuba and numpy only; see README.md."""

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

COPIES, SIZE = 4, 16
print(f"mitsuba {mi.__version__}, drjit {dr.__version__}, libLLVM {dr.detail.llvm_version()}")
print(f"{COPIES} equal Gaussians in one place (what 3DGS' densification makes when it clones), `volprim_rf_basic`")
print("in linear colors: each has the color 1 and the opacity 0.2. Central pixel, and the gradient by opacity.\n")

arrays = {
    "centers": np.zeros((COPIES, 3)),
    "scales": np.full((COPIES, 3), 0.3),
    "quaternions": np.tile([0, 0, 0, 1], (COPIES, 1)),
    "opacities": np.full((COPIES, 1), 0.2),
    "sh_coeffs": np.full((COPIES, 3), 0.5 / 0.28209479),
}
scene = mi.load_dict(
    {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
        "sensor": {
            "type": "perspective",
            "fov": 1,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
        },
        "shape": {"type": "ellipsoids", **{k: mi.TensorXf(v.astype(np.float32)) for k, v in arrays.items()}},
    }
)
params = mi.traverse(scene)
dr.enable_grad(params["shape.opacities"])
image = mi.render(scene, params, spp=1)
dr.backward(dr.mean(image, axis=None))
gradient = np.array(dr.grad(params["shape.opacities"]))
value = float(np.array(image)[SIZE // 2, SIZE // 2, 0])
together, reached = 1 - 0.8**COPIES, int((gradient != 0).sum())
print(f"pixel: expected {together:.3f} (one alone: 0.200), got {value:.3f}")
print(f"Gaussians with a gradient: expected {COPIES}, got {reached}")
verdict = "reproduced" if reached < COPIES and abs(value - together) > 0.05 else "not reproduced"
print(f"\n{verdict}: {reached} of {COPIES} coincident Gaussians are seen.")
