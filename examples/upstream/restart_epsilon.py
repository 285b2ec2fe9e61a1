"""`volprim_rf_basic`: restarting 1e-4 behind each entry loses hits. Needs mitsuba and numpy only; see README.md."""

import inspect

import drjit as dr
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

COUNT, RAYS, EXTENT = 1000, 1000, 3.0
SIGMA = np.array([0.02, 0.02, 0.001])  # flat, as fitted surfaces are
SCALE = 0.003  # length of traced directions: keeps the fault of ellipsoid_intersection.py out of the figures

rng = np.random.default_rng(0)
centers = np.concatenate([rng.uniform(-0.25, 0.25, (COUNT, 2)), rng.normal(0, 1e-3, (COUNT, 1))], 1).astype(np.float32)
start = np.concatenate([rng.uniform(-0.15, 0.15, (RAYS, 2)), np.full((RAYS, 1), -2.0)], 1).astype(np.float32)
shape = {
    "type": "ellipsoids",
    "centers": mi.TensorXf(centers),
    "scales": mi.TensorXf(np.tile(SIGMA, (COUNT, 1)).astype(np.float32)),
    "quaternions": mi.TensorXf(np.tile(np.array([0, 0, 0, 1], np.float32), (COUNT, 1))),
    "extent": EXTENT,
}
scene = mi.load_dict({"type": "scene", "shape": shape})

# Rays along +z at a wall in the plane z = 0: what they must hit is decided by x and y alone.
offsets = (start[:, None, :2].astype(np.float64) - centers[None, :, :2]) / SIGMA[:2]
power = (offsets**2).sum(2)
expected = power < (EXTENT * 0.999) ** 2  # grazing hits are left out
weight = np.exp(-0.5 * power)


def missing(epsilon: float) -> tuple[float, float]:
    """Shares of expected (ray, Gaussian) hits that are not found: of their number, and of their weights."""
    found = np.zeros((RAYS, COUNT), bool)
    z, active = mi.Float(start[:, 2]), mi.Bool(True)
    for _ in range(1000):
        origin = mi.Point3f(mi.Float(start[:, 0]), mi.Float(start[:, 1]), z)
        pi = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0, 0, SCALE)), active=active)
        active = active & pi.is_valid()
        ok = np.array(active)
        if not ok.any():
            break
        found[np.flatnonzero(ok), np.array(pi.prim_index)[ok]] = True
        z = dr.select(active, z + pi.t * SCALE + epsilon, z)
        dr.eval(z, active)
    lost = expected & ~found
    return lost.sum() / expected.sum(), weight[lost].sum() / weight[expected].sum()


print(f"mitsuba {mi.__version__}, drjit {dr.__version__}, libLLVM {dr.detail.llvm_version()}")
print(f"A wall of {COUNT} Gaussians of sigma {SIGMA}, {RAYS} rays. Expected: {expected.sum() / RAYS:.1f} hits a ray.\n")
shares = {epsilon: missing(epsilon) for epsilon in (1e-4, 1e-5, 1e-6)}
for epsilon, (number, weighted) in shares.items():
    print(f"restart {epsilon:g} behind the entry: got {1 - number:.1%} of the hits; weight lost {weighted:.1%}")
# The step is a literal in the integrator: read it there.
source = inspect.getsource(mi.ad.integrators.volprim_rf_basic)
verdict = "reproduced" if shares[1e-4][1] > 0.05 and "ray.d * 1e-4" in source else "not reproduced"
print(f"\n{verdict}: volprim_rf_basic's step of 1e-4 loses {shares[1e-4][1]:.0%} of the weight.")
