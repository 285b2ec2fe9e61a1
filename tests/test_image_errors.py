"""What the error of an image looks like: each pattern is named with its numbers, and what is none is not."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import torch_rasterizer
from torch_rasterizer import DEFECTS

import drgs
from drgs import cli
from drgs.data.camera_lists import save_cameras_json
from drgs.files import save_ply
from drgs.lab.crossval import crossval
from drgs.lab.image_errors import PATTERNS, pattern_of
from drgs.lab.rasterizers import function
from drgs.testing import random_scene

BACKGROUND = (0.3, 0.6, 0.2)


@pytest.fixture(scope="module")
def drawn():
    """A right image (H, W, 3), its alpha, and its parts: what Gaussians add, and how much is seen of the background."""
    g, (camera,) = random_scene(0)
    out = drgs.render(g, camera, drgs.RenderSettings.preset("gsplat", background=BACKGROUND))
    image, alpha = (x.detach().double().numpy() for x in (out.rgb, out.alpha))
    seen = (1 - alpha)[..., None]
    assert 0.05 < seen.mean() < 0.9
    return image, alpha, image - seen * BACKGROUND, seen


def _smooth(image):
    """Its mean of 3x3 pixels."""
    wide = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = image.shape[:2]
    return sum(wide[y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9


def _noise(image, size=0.05):
    return size * np.random.default_rng(0).normal(size=image.shape)


def _left(image):
    """Two columns at half their brightness."""
    return np.where(np.arange(image.shape[1])[:, None] < 2, 0.5, 1.0) * image


def _steep(image):
    """Noise where the image is steepest."""
    slope = sum((x**2).sum(-1) for x in np.gradient(image, axis=(0, 1)))
    return image + _noise(image) * (slope > np.quantile(slope, 0.92))[..., None]


def _dots(image):
    """Noise in every fiftieth pixel."""
    return image + _noise(image) * (np.arange(image[..., 0].size).reshape(image.shape[:2]) % 50 == 0)[..., None]


@pytest.mark.parametrize(
    ("change", "name", "words"),
    [
        (lambda x, a, front, seen: x[::-1], "flipped", "mirrored top to bottom"),
        (lambda x, a, front, seen: x[::-1, ::-1], "flipped", "turned by half a turn"),
        (lambda x, a, front, seen: x[..., [2, 1, 0]], "channels", "its channels in the order BGR"),
        (lambda x, a, front, seen: 0.9 * x, "factor", "times 0.9"),
        (lambda x, a, front, seen: x - 0.05, "offset", "plus -0.05"),
        (lambda x, a, front, seen: 0.5 * front + seen * BACKGROUND, "foreground", "what its Gaussians add times 0.5"),
        (lambda x, a, front, seen: front, "background", "its background (0.3, 0.6, 0.2) missing"),
        (
            lambda x, a, front, seen: front + seen * (1.0, 0.5, 0.2),
            "background",
            "its background (1, 0.5, 0.2) instead of (0.3, 0.6, 0.2)",
        ),
        (lambda x, a, front, seen: x.clip(0) ** 1.5, "transfer", "to the power of 1.5"),
        (lambda x, a, front, seen: np.roll(x, 1, 1), "shift", "moved by 1.00 pixels to the right"),
        (
            lambda x, a, front, seen: np.roll(x, (2, -3), (0, 1)),
            "shift",
            "moved by 3.00 pixels to the left and 2.00 pixels down",
        ),
        (lambda x, a, front, seen: 0.5 * (x + np.roll(x, -1, 0)), "shift", "moved by 0.5"),
        (lambda x, a, front, seen: _smooth(x), "blur", "blurred by 0.85 pixels"),
        (lambda x, a, front, seen: x * (1.0, 0.8, 1.1), "channel factors", "its channels times (1, 0.8, 1.1)"),
        (lambda x, a, front, seen: x + (0.0, 0.1, -0.1), "channel offsets", "its channels plus (0, 0.1, -0.1)"),
        (
            lambda x, a, front, seen: np.where((np.arange(48) < 20)[:, None], x, 0.25),
            "blank",
            "with nothing but (0.25, 0.25, 0.25) in the pixels that are off",
        ),
        (lambda x, a, front, seen: _left(x), "border", "but off along its left side: 100% of the error is there"),
        (lambda x, a, front, seen: _steep(x), "edges", "but off at edges: the steepest 10% of its pixels have 100%"),
        (lambda x, a, front, seen: _dots(x), "few pixels", "but off in few pixels: 5% of them have 100% of the error"),
        (lambda x, a, front, seen: x + _noise(x), "none", "no known pattern"),
    ],
    ids=lambda x: x if x in PATTERNS else "",
)
def test_every_pattern_is_named(drawn, change, name, words):
    """With its numbers; a hundredth of the pixels that do not count may be anything."""
    image, alpha, *parts = drawn
    wrong, counts = np.array(change(image, alpha, *parts)), np.ones(alpha.shape, bool)
    counts[::10, ::10], wrong[::10, ::10] = False, 7.0
    found = pattern_of(wrong, image, alpha, BACKGROUND, counts)
    assert found.name == name, found
    assert found.what.startswith(words)
    if name == "none":
        assert np.isnan(found.explained)
    else:
        assert 0.9 <= found.explained <= 1


def test_a_magnification_is_told_from_a_shift(drawn):
    """The same scene through a lens that is 3 % longer is magnified about the middle."""
    g, (camera,) = random_scene(0)
    image, alpha, *_ = drawn
    K = np.array(camera.K)
    middle = np.array([camera.width / 2, camera.height / 2])
    K[:2, 2] = middle + 1.03 * (K[:2, 2] - middle)
    K[[0, 1], [0, 1]] *= 1.03
    settings = drgs.RenderSettings.preset("gsplat", background=BACKGROUND)
    longer = drgs.Camera(K=K, w2c=camera.w2c, width=camera.width, height=camera.height)
    wrong = drgs.render(g, longer, settings).rgb.detach().double().numpy()
    found = pattern_of(wrong, image, alpha, BACKGROUND, np.ones(alpha.shape, bool))
    assert found.name == "zoom"
    assert float(found.what.split()[1]) == pytest.approx(1.03, abs=0.01)


def test_a_wrong_image_is_located_and_described():
    """Of two views without a name one is dimmed in a box: that view is named by its number, with its pixels, the worst
    one's colors, and nothing of the other. What needs no conventions is said of the preset.
    """
    g, (camera,) = random_scene(0, count=40, width=32, height=24)
    views = [drgs.Camera(K=camera.K, w2c=camera.w2c, width=32, height=24) for _ in range(2)]
    calls = []

    def dimmed(viewmats, **arguments):
        image, alpha, info = torch_rasterizer.rasterization(viewmats=viewmats, **arguments)
        calls.append(viewmats)
        weight = torch.ones_like(alpha)
        weight[:, 5:11, 8:21] = 0.5
        return image * (weight if float(viewmats[0, 0, 3].detach()) > 1e-3 else 1), alpha, info

    moved = np.array(camera.w2c)
    moved[0, 3] = 0.5
    still = np.array(camera.w2c)
    still[0, 3] = 0.0
    pair = [drgs.Camera(K=view.K, w2c=x, width=32, height=24) for view, x in zip(views, (still, moved), strict=True)]
    result = crossval(function(dimmed, "dimmed"), g, pair, "gsplat", {"background": BACKGROUND}, channels=0)
    assert calls
    assert result.verdict == "model difference"
    assert result.views[0].error is None
    error = result.views[1].error
    assert (error.pixels, error.box) == (6 * 13, [8, 5, 20, 10])
    assert (result.views[0].view, result.views[1].view) == ("0", "1")
    worst = result.images[1]["model"][error.y, error.x]
    np.testing.assert_allclose(error.model, worst, rtol=1e-6)
    np.testing.assert_allclose(error.rasterizer, worst / 2, rtol=1e-4)
    (line,) = [line for line in result.lines() if line.startswith("view ")]
    assert line.startswith(
        "view 1: 78 of 768 pixels are off by more than 0.001, in x 8 to 20 and y 5 to 10, most at "
        f"({error.x}, {error.y}): ("
    )


def test_a_shift_is_not_taken_for_half_of_it():
    """A whole pixel to the right is what it is, though a pixel center at 0 explains a half of it."""
    g, cameras = random_scene(0, count=40, width=32, height=24)

    def moved(**arguments):
        image, alpha, info = torch_rasterizer.rasterization(**arguments)
        return torch.roll(image, 1, 2), alpha, info

    result = crossval(function(moved, "moved"), g, cameras, "gsplat", {"background": BACKGROUND}, channels=0)
    (line,) = [line for line in result.lines() if line.startswith("view ") and "off" in line]
    assert "it looks like the image of preset gsplat, moved by 1.00 pixels to the right, which explains 100.0%" in line


def test_what_agrees_has_no_error():
    """Neither an image at another convention, nor a wrong gradient, is said to be off."""
    g, cameras = random_scene(0, count=40, width=32, height=24)
    for name in ("channels_swapped", "opacity_detached"):
        made = function(DEFECTS[name].make(), name)
        result = crossval(made, g, cameras, "gsplat", {"background": BACKGROUND}, channels=0)
        assert [view.error for view in result.views] == [None]
        assert "pixels are off" not in "\n".join(result.lines())


def test_command_says_it(tmp_path, monkeypatch, capsys):
    """On stdout, in crossval.json and in report.html."""
    g, cameras = random_scene(0, count=40, width=32, height=24)
    save_ply(g, tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "cameras.json", cameras)
    (tmp_path / "dim_rasterizer.py").write_text(
        "import torch_rasterizer\n"
        "def dim(**arguments):\n"
        "    image, alpha, info = torch_rasterizer.rasterization(**arguments)\n"
        "    return 0.75 * image, alpha, info\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["--cameras", str(tmp_path / "cameras.json"), "--no-ladder", "--preset", "gsplat"]
    words += ["--rasterizer", "dim_rasterizer:dim", "--set", "background=0.3,0.6,0.2", "-o", str(tmp_path / "out")]
    assert cli.main(["crossval", str(tmp_path / "scene.ply"), *words]) == 0
    told = "768 of 768 pixels are off by more than 0.001, in x 0 to 31 and y 0 to 23, most at ("
    ends = "it looks like the image of preset gsplat, times 0.75, which explains 100.0% of the squared error"
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("view random_0: 768")]
    assert line.startswith(f"view random_0: {told}")
    assert line.endswith(ends)
    assert line in (tmp_path / "out/report.html").read_text()
    (view,) = json.loads((tmp_path / "out/crossval.json").read_text())["image"]["views"]
    assert view["error"]["pattern"] == "factor"
    assert view["error"]["what"] == "the image of preset gsplat, times 0.75"
    assert view["error"]["box"] == [0, 0, 31, 23]


def test_where_nothing_counts_there_is_no_error(rng):
    """Nothing is divided by an error of 0."""
    image, alpha = rng.random((6, 5, 3)), np.ones((6, 5))
    for wrong, counts in ((image, np.ones((6, 5), bool)), (image + 1, np.zeros((6, 5), bool))):
        found = pattern_of(wrong, image, alpha, (0.0, 0.0, 0.0), counts)
        assert (found.name, found.what) == ("none", "no error where pixels count")
