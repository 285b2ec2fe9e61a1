"""Information about gsplat's tensors is that of the Gaussians and cameras that they stand for."""

import math

import pytest
import torch
from test_rasterize import arguments

import drgs
from drgs import fisher
from drgs.cameras import Camera
from drgs.ellipsoids import Gaussians

pytestmark = pytest.mark.core

GSPLAT = drgs.RenderSettings.preset("gsplat")
SIZE = {"n": 30, "width": 24, "height": 20}


def tensors(**options):
    """Arguments of `drgs.rasterization`, and the same views as Cameras."""
    given = arguments(**SIZE, **options)
    poses = zip(given["Ks"].numpy(), given["viewmats"].numpy(), strict=True)
    return given, [Camera(K=K, w2c=w2c, width=24, height=20) for K, w2c in poses]


def scene(given, sh):
    """The same Gaussians through `from_arrays`."""
    return Gaussians.from_arrays(*(given[name] for name in ("means", "quats", "scales", "opacities")), sh)


@pytest.mark.parametrize("method", ["exact", "fisherrf"])
def test_spherical_harmonics_are_those_of_gaussians(method):
    """Groups, shapes and numbers, over two views each with its background; bands above `sh_degree` are left out."""
    given, cameras = tensors(cameras=2)
    given["sh_degree"] = 1
    found = fisher.diagonal(**given, method=method)
    g, want = scene(given, given["colors"][:, :4]), {}
    for camera, background in zip(cameras, given["backgrounds"].tolist(), strict=True):
        part = fisher.diagonal(g, camera, GSPLAT.replace(background=tuple(background)), method)
        want = {name: want.get(name, 0) + x for name, x in part.items()}
    assert list(found) == list(want)
    assert tuple(found["sh"].shape) == (30, 4, 3)
    for name, x in want.items():
        # The logits are taken of float64 opacities here and there, in another order of operations.
        torch.testing.assert_close(found[name], x, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
def test_plain_colors_are_squares_of_central_differences(channels):
    """The first three channels say all that is said about the geometry, and a fourth is a feature, whatever its color.

    Against central differences of `drgs.rasterization`'s own image for three Gaussians: steps of 0.01 leave errors of
    their square, and rounding of 1e-7 / 0.02, well below a per cent.
    """
    given, _ = tensors(channels=channels, seed=3)
    given["colors"] = given["colors"] - 0.3
    found = fisher.diagonal(**given, settings=GSPLAT.replace(transmittance_min=0, alpha_min=0, culling="extent"))
    n = min(3, channels)
    assert tuple(found["sh"].shape) == (30, 1, n)
    assert ("features" in found) == (channels > 3)
    preset = GSPLAT.replace(transmittance_min=0, alpha_min=0, culling="extent")
    squares = []
    for i in range(0, 30, 10):
        for name, group in (("opacities", "logit_opacities"), ("colors", "sh")):
            images = []
            for sign in (1, -1):
                moved = given[name].clone()
                if name == "opacities":
                    moved[i] = torch.sigmoid(torch.logit(moved[i]) + sign * 0.01)
                else:
                    moved[i, 0] += sign * 0.01 * math.sqrt(1 / (4 * math.pi))
                images.append(drgs.rasterization(**{**given, name: moved}, preset=preset)[0][..., :n])
            square = float(((images[0] - images[1]) / 0.02).square().sum())
            squares.append(square)
            got = float(found[group].reshape(30, -1)[i, 0])
            assert got == pytest.approx(square, rel=0.01, abs=1e-5), (name, i)
    assert min(sorted(squares)[-2:]) > 0.01  # otherwise nothing was compared


def test_one_scene_at_a_time():
    """Leading axes, and colors that differ between views, are refused in one line."""
    given, _ = tensors()
    with pytest.raises(ValueError, match="must be of one scene whose colors are the same in every view") as error:
        fisher.diagonal(**{**given, "colors": given["colors"][None]})
    assert "\n" not in str(error.value)
    batch = {k: x[None] if isinstance(x, torch.Tensor) else x for k, x in given.items()}
    with pytest.raises(ValueError, match="must be of one scene"):
        fisher.diagonal(**batch)
    with pytest.raises(ValueError, match=r"fisher.diagonal: scales must be in \[0, inf\)"):
        fisher.diagonal(**{**given, "scales": -given["scales"]})
