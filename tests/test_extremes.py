"""Every extreme that the renderer claims to stand, against the float64 oracle (docs/numerics.md prints the errors)."""

import numpy as np
import pytest
from scenes_extreme import CASES
from scenes_random import Oracle, compare


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.filterwarnings("ignore")
def test_extreme(case):
    """Finite everywhere, image and all gradients within the case's bounds, adjoint and forward mode consistent."""
    rng = np.random.default_rng(3)  # the scenes of docs/numerics.md
    g, cam = case.build(rng)
    errors = compare(g, cam, case.settings, Oracle(g, cam, case.settings, rng, 1e-6))
    assert errors.finite
    assert max(errors.image.values()) <= case.image
    assert max(errors.gradient.values()) <= case.gradient, errors.gradient
    assert errors.duality <= max(1e-4, case.gradient)
