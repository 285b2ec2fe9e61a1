"""Claims of drgs.fitting.metrics: values against their definitions, masks, and what is missing is null with a
reason.
"""

import dataclasses
import importlib.util
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from drgs.cameras import orbit
from drgs.commands.eval import print_table
from drgs.fitting import metrics
from drgs.fitting.frames import Frame
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core


def images(rng, height=40, width=50):
    a, b = (torch.from_numpy(rng.random((height, width, 3), dtype=np.float32)) for _ in range(2))
    return a, 0.8 * a + 0.2 * b


def test_psnr_is_its_definition(rng):
    """-10 log10(MSE), inside the mask where there is one, and 100 for equal images."""
    a, b = images(rng)
    assert metrics.psnr(a, b) == pytest.approx(-10 * math.log10(float(((a - b) ** 2).mean())), abs=1e-4)
    mask = torch.zeros(40, 50)
    mask[:, :10] = 1
    inside = float(((a - b)[:, :10] ** 2).mean())
    assert metrics.psnr(a, b, mask) == pytest.approx(-10 * math.log10(inside), abs=1e-4)
    assert metrics.psnr(a, a) == 100
    with pytest.raises(ValueError, match="the mask must keep at least one pixel"):
        metrics.psnr(a, b, torch.zeros(40, 50))


def test_ssim_is_the_published_window(rng):
    """Equals SSIM written out in float64 with an 11x11 window of sigma 1.5, without padding, to 1e-4."""
    a, b = images(rng)
    kernel = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    kernel = torch.outer(kernel, kernel)[None, None] / kernel.sum() ** 2

    def blur(x):
        return torch.nn.functional.conv2d(x.double().permute(2, 0, 1)[:, None], kernel)

    ma, mb = blur(a), blur(b)
    va, vb, vab = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    value = (2 * ma * mb + 1e-4) * (2 * vab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert metrics.ssim(a, b) == pytest.approx(float(value.mean()), abs=1e-4)
    assert metrics.ssim(a, a) == pytest.approx(1, abs=1e-5)


def test_ssim_equals_torchmetrics(rng):
    """torchmetrics' map away from the border, which it fills by reflection, to 1e-5."""
    try:
        from torchmetrics.functional.image import structural_similarity_index_measure
    except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision built for another torch
        pytest.skip(f"torchmetrics: {error}")
    a, b = images(rng)
    planes = [x.permute(2, 0, 1)[None] for x in (a, b)]
    options = {"sigma": 1.5, "kernel_size": 11, "data_range": 1.0, "return_full_image": True}
    _, values = structural_similarity_index_measure(*planes, **options)
    assert metrics.ssim(a, b) == pytest.approx(float(values[..., 5:-5, 5:-5].mean()), abs=1e-5)


def test_flip_orders_errors(rng):
    """0 for equal images, larger for a larger error, in [0, 1]."""
    a, b = images(rng)
    small, large = metrics.flip(0.9 * a + 0.1 * b, a), metrics.flip(b, a)
    assert metrics.flip(a, a) == pytest.approx(0, abs=1e-4)
    assert 0 < small < large < 1


def lpips_packages():
    """torchvision; skips where it or lpips cannot be imported."""
    try:
        import lpips  # noqa: F401
        import torchvision
    except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision built for another torch
        pytest.skip(f"no LPIPS: {error}")
    return torchvision


class Rendered:
    """Stands for an `Output`."""

    def __init__(self, rgb, alpha):
        self.rgb, self.alpha = rgb, alpha


def evaluate(monkeypatch, image, frames, alpha=None, **options):
    alpha = torch.ones(image.shape[:2]) if alpha is None and image is not None else alpha
    monkeypatch.setattr("drgs.fitting.metrics.render", lambda g, camera, settings: Rendered(image, alpha))
    return metrics.evaluate(None, frames, RenderSettings.preset("fast"), **options)


def frame(pixels, mask=None, name="a/b 1"):
    height, width = pixels.shape[:2]
    return Frame(name, orbit((0, 0, 0), 3, 1, width=width, height=height)[0], pixels, mask)


def test_evaluation_is_per_view_and_mean_with_pictures(rng, monkeypatch, tmp_path):
    """Means over views, pictures by name, LPIPS null with its reason."""
    a, b = images(rng)
    result = evaluate(monkeypatch, b, [frame(a), frame(b, name="c")], pictures=tmp_path)
    psnr = metrics.psnr(b, a)
    assert [v["psnr"] for v in result["views"]] == [pytest.approx(psnr), 100]
    assert result["mean"]["psnr"] == pytest.approx((psnr + 100) / 2)
    assert result["mean"]["lpips"] is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a_b_1.png", "c.png"]
    assert set(result["variants"]) == set(metrics.METRICS) == set(result["mean"]) == set(result["median"])


def test_medians_stand_beside_means(rng, monkeypatch):
    """One bad view of three pulls the mean and leaves the median; what a view lacks has neither."""
    a, b = images(rng)
    near = 0.9 * a + 0.1 * b
    result = evaluate(monkeypatch, a, [frame(near), frame(b), frame(near)])
    values = [row["psnr"] for row in result["views"]]
    assert result["median"]["psnr"] == values[0] == values[2] > result["mean"]["psnr"]
    assert result["median"]["lpips"] is None


def test_uncovered_is_a_share_of_the_mask(rng, monkeypatch):
    """Pixels with an opacity below 0.5, of those that count."""
    a, b = images(rng)
    alpha = torch.full((40, 50), 0.5)
    alpha[:10] = 0.49
    mask = torch.zeros(40, 50)
    mask[5:15] = 1
    shares = [row["uncovered"] for row in evaluate(monkeypatch, b, [frame(a), frame(a, mask)], alpha)["views"]]
    assert shares == [0.25, 0.5]


@pytest.mark.parametrize(
    ("installed", "expected"), [(True, "--lpips-weights FILE"), (False, "pip install 'drgs[lpips]'")]
)
def test_what_lpips_and_flip_need(rng, monkeypatch, installed, expected):
    """Weights are asked for where the package is installed, else the package; docs/install.md names both."""
    a, b = images(rng)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name if installed else None)
    result = evaluate(monkeypatch, b, [frame(a)])
    assert expected in result["reasons"]["lpips"]
    assert installed == ("--lpips-weights" in result["reasons"]["lpips"])
    assert installed == (result["mean"]["flip"] is not None) == ("flip" not in result["reasons"])


def test_lpips_is_spoken_of_where_it_was_asked_for(rng, monkeypatch, capsys):
    """Nothing of it is printed without weights, of held-out views or of none; with weights the reason of a null is."""
    a, b = images(rng)
    beside = {"split": "test", "renderers": None}
    for frames in ([frame(a)], []):
        result = evaluate(monkeypatch, b, frames)
        assert "lpips" in result["reasons"]
        print_table({**result, **beside, "count": len(frames)})
        assert "lpips" not in capsys.readouterr().out.lower()
    lpips = SimpleNamespace(backbone="alex")  # never called: the views are smaller than 64 pixels
    result = evaluate(monkeypatch, b, [frame(a)], lpips=lpips)
    print_table({**result, **beside, "count": 1}, lpips=True)
    assert "lpips: none (view a/b 1 is smaller than 64 pixels)" in capsys.readouterr().out


def test_masked_evaluation_ignores_what_is_outside(rng, monkeypatch):
    """Errors outside the mask change nothing."""
    a, b = images(rng)
    mask = torch.zeros(40, 50)
    mask[5:35, 5:45] = 1
    inside = torch.where(mask[..., None] > 0, a, b)
    row = evaluate(monkeypatch, inside, [frame(a, mask)])["views"][0]
    assert row["psnr"] == 100
    assert row["ssim"] == pytest.approx(1, abs=1e-5)
    assert row["flip"] == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("kind", ["alpha", "mask"])
def test_cut_out_objects_have_a_number_for_the_object_and_one_for_the_frame(rng, monkeypatch, capsys, kind):
    """Of a photograph nine tenths of which are empty, by its alpha channel or by an object's mask: the error of the
    object is not thinned by empty pixels, what is drawn where nothing is counts in the frame, and a view that the
    object fills has the same number twice. `uncovered` is of the object; tables name both.
    """
    a, b = images(rng)
    shown = torch.zeros(40, 50)
    shown[:10, :20] = 1
    told = {"alpha": shown} if kind == "alpha" else {"mask": shown, "is_object": True}
    photo = a * shown[..., None] if kind == "alpha" else a  # composited on the background, black
    cut = dataclasses.replace(frame(photo), **told)
    image = torch.where(shown[..., None] > 0, b, torch.zeros(3))
    image[30:32] = 0.5  # a floater
    result = evaluate(monkeypatch, image, [cut, frame(image, name="c")], alpha=0.4 + 0 * shown)
    row, full = result["views"]
    assert row["psnr_object"] == pytest.approx(metrics.psnr(b[:10, :20], a[:10, :20]))
    assert row["psnr_frame"] == pytest.approx(metrics.psnr(image, a * shown[..., None]))
    assert row["psnr"] == row["psnr_frame" if kind == "alpha" else "psnr_object"]
    assert row["uncovered"] == 1
    assert full["psnr_object"] == full["psnr_frame"] == full["psnr"]
    assert result["mean"]["psnr_object"] == pytest.approx((row["psnr_object"] + 100) / 2)
    monkeypatch.setattr("drgs.fitting.metrics.render", lambda g, camera, settings, outputs: Rendered(image, shown))
    monkeypatch.setattr("drgs.fitting.metrics.colors_only", lambda g, time: g)
    found = metrics.through_renderers(None, [cut], {"fast": RenderSettings.preset("fast")}, "test")
    assert found["rows"][0]["worst"] == {
        "name": "a/b 1",
        **{key: pytest.approx(row[key]) for key in ("psnr", "cc_psnr", "psnr_object", "psnr_frame")},
    }
    print_table({**result, "split": "test", "count": 2, "renderers": found})
    said = capsys.readouterr().out
    assert all(name in said for name in ("psnr_object  psnr_frame  cc_psnr", "the object", "the frame"))
    blank = dataclasses.replace(frame(0 * a), alpha=0 * shown)  # nothing of the object is in this view
    assert evaluate(monkeypatch, image, [blank])["views"][0]["psnr_object"] is None


def test_missing_metrics_say_why(rng, monkeypatch):
    """No held-out view, or images smaller than a window: None and a reason, never a number."""
    empty = evaluate(monkeypatch, None, [])
    assert set(empty["mean"].values()) == {None}
    assert empty["reasons"]["psnr"] == "no view is held out"
    a, b = images(rng, 8, 8)
    result = evaluate(monkeypatch, b, [frame(a)])
    assert result["mean"]["ssim"] is None
    assert "smaller than the 11x11 window" in result["reasons"]["ssim"]


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_lpips_reads_a_backbone_from_a_file(tmp_path, rng, name):
    """Random weights with torchvision's names load without a download, and give 0 for equal images."""
    torchvision = lpips_packages()
    build = {"alex": torchvision.models.alexnet, "vgg": torchvision.models.vgg16}[name]
    state = {k: v for k, v in build(weights=None).state_dict().items() if k.startswith("features")}
    torch.save(state, tmp_path / "w.pth")
    lpips = metrics.Lpips(tmp_path / "w.pth")
    a, b = images(rng, 64, 64)
    assert lpips.backbone == name
    assert lpips(a, a) == 0
    assert lpips(b, a) > 0
    first = next(lpips._model.net.parameters())
    assert torch.equal(first, state["features.0.weight"])


def test_bad_weights_are_refused(tmp_path):
    """Missing, damaged, foreign and incomplete files each have their line; nothing is unpickled."""
    lpips_packages()
    path = tmp_path / "w.pth"
    with pytest.raises(FileNotFoundError, match="must be weights of AlexNet or VGG16, found none"):
        metrics.Lpips(path)
    path.write_bytes(b"garbage")
    with pytest.raises(ValueError, match="must be readable weights"):
        metrics.Lpips(path)
    torch.save({"x": torch.zeros(1)}, path)
    with pytest.raises(ValueError, match="must be the state dictionary of torchvision's AlexNet or VGG16"):
        metrics.Lpips(path)
    torch.save({"features.0.weight": torch.zeros(64, 3, 11, 11)}, path)
    with pytest.raises(ValueError, match="must hold every convolution of alex"):
        metrics.Lpips(path)
    torch.save({"x": Malicious()}, path)
    with pytest.raises(ValueError, match="must be readable weights"):
        metrics.Lpips(path)


class Malicious:
    """Runs code when unpickled."""

    def __reduce__(self):
        return (print, ("unpickled",))


def test_color_correction_is_that_of_an_independent_solve():
    """Five fits by normal equations in float64, of the pixels that nothing saturates, give the same corrected image:
    measured 1e-12; the squared condition of these ten terms, 1e8, would allow 1e-8.
    """
    rng = np.random.default_rng(4)
    image = rng.uniform(0, 1, (20, 30, 3))
    target = np.clip(1.3 * image[..., ::-1] ** 2 + 0.1 * image + rng.normal(0, 0.02, image.shape) - 0.05, 0, 1)
    weights = rng.uniform(0, 1, (20, 30)) * (rng.uniform(0, 1, (20, 30)) > 0.2)
    eps = 0.5 / 255
    first, colors, wanted, w = image.reshape(-1, 3), image.reshape(-1, 3), target.reshape(-1, 3), weights.reshape(-1)
    inside = lambda x: (x >= eps) & (x <= 1 - eps)  # noqa: E731
    for _ in range(5):
        r, g, b = colors.T
        terms = np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)], axis=1)
        new = np.empty_like(colors)
        for c in range(3):
            rows = w * (inside(first[:, c]) & inside(colors[:, c]) & inside(wanted[:, c]))
            new[:, c] = terms @ np.linalg.solve(terms.T @ (rows[:, None] * terms), terms.T @ (rows * wanted[:, c]))
        colors = np.clip(new, 0, 1)
    got = metrics.color_corrected(*(torch.from_numpy(x) for x in (image, target, weights)))
    assert np.abs(got.reshape(-1, 3).numpy() - colors).max() < 1e-7


def test_color_correction_undoes_an_affine_change_of_color():
    """A photograph of another exposure, white balance and offset, nowhere saturated, is reached but for rounding."""
    image = torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(1))
    target = image * torch.tensor([0.5, 0.7, 0.4]) + torch.tensor([0.1, 0.05, 0.3])
    assert metrics.psnr(image, target) < 20
    assert metrics.cc_psnr(image, target) > 99
    outside = target.clone()
    outside[:, :4] = torch.rand(12, 4, 3, generator=torch.Generator().manual_seed(2))
    mask = torch.ones(12, 16)
    mask[:, :4] = 0
    assert metrics.cc_psnr(image, outside, mask) > 99
    assert metrics.cc_psnr(image, outside) < 40


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 3), (9, 9)])
@pytest.mark.parametrize("value", [None, 0.0, 0.4, 1.0])
def test_color_correction_of_little_or_constant_color_is_finite(height, width, value):
    """Identical images stay identical, be they tiny, of one color or saturated; of different constants one is made the
    other.
    """
    image = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1
    image = image if value is None else torch.full_like(image, value)
    assert metrics.cc_psnr(image, image) > 99
    other = torch.full_like(image, 0.7)
    corrected = metrics.color_corrected(image, other)
    assert torch.isfinite(corrected).all()
    assert metrics.cc_psnr(image, other) > 99


@pytest.mark.parametrize("ground", [0.0, 0.99, 1.0])
def test_color_correction_leaves_a_plain_ground_alone(ground):
    """An object of a twelfth of the view that is rendered too dark, on a ground that is right: the correction of the
    object alone would recolor the ground. The corrected view is never worse than the plain one.
    """
    generator = torch.Generator().manual_seed(3)
    target = torch.full((24, 24, 3), 0.0 if ground == 0 else 1.0)
    image = torch.full((24, 24, 3), ground)
    target[8:15, 8:15] = 0.3 + 0.2 * torch.rand(7, 7, 3, generator=generator)
    image[8:15, 8:15] = target[8:15, 8:15] * 0.8 + 0.05 * torch.randn(7, 7, 3, generator=generator)
    image = image.clamp(0, 1)
    plain, corrected = metrics.psnr(image, target), metrics.cc_psnr(image, target)
    assert 30 < plain <= corrected
