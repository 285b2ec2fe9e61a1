"""`volprim_rf_basic`: its default `srgb_primitives=True` gives wrong gradients. Needs mitsuba, numpy; see README.md."""

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

STEP = 1e-2  # of an opacity of 0.5 and of a coefficient of 0.3: the difference quotients are the same at half of it


def scene_with(srgb: bool):
    """One Gaussian of sigma 0.3 at distance 4, seen through 8 x 8 pixel centers."""
    one = {"centers": [[0, 0, 0]], "scales": [[0.3, 0.3, 0.3]], "quaternions": [[0, 0, 0, 1]]}
    one |= {"opacities": [[0.5]], "sh_coeffs": [[0.3, 0.0, -0.3]]}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic", "srgb_primitives": srgb},
            "sensor": {
                "type": "perspective",
                "fov": 15,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
                "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
            },
            "shape": {"type": "ellipsoids", **{k: mi.TensorXf(np.array(v, np.float32)) for k, v in one.items()}},
        }
    )


print(f"mitsuba {mi.__version__}, drjit {dr.__version__}, libLLVM {dr.detail.llvm_version()}")
print("Derivative of the image's mean. Expected: central differences. Got: mi.render's reverse mode.\n")
worst = {}
for srgb in (True, False):
    for key, index in (("shape.opacities", 0), ("shape.sh_coeffs", 0)):
        scene = scene_with(srgb)
        params = mi.traverse(scene)
        params.keep([key])
        start = np.array(params[key])
        dr.enable_grad(params[key])
        dr.backward(dr.mean(mi.render(scene, params, spp=1), axis=None))
        got = float(np.array(dr.grad(params[key]))[index])
        sides = []
        for sign in (1, -1):
            moved = start.copy()
            moved[index] += sign * STEP
            params[key] = mi.Float(moved)
            params.update()
            sides.append(np.array(mi.render(scene, spp=1)).mean(dtype=np.float64))
        expected = (sides[0] - sides[1]) / (2 * STEP)
        worst[srgb] = max(worst.get(srgb, 0), abs(got / expected - 1))
        print(f"srgb_primitives={srgb!s:5} {key}[{index}]: expected {expected:.5f}, got {got:.5f}")

verdict = "reproduced" if worst[True] > 0.05 else "not reproduced"
print(f"\n{verdict}: off by up to {worst[True]:.0%} with the default, {worst[False]:.1%} with srgb_primitives=False.")
