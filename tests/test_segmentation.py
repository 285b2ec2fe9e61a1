"""Semantics beside the engine: decoder, classes and their scores, pictures."""

import json
import math
import pickle

import numpy as np
import pytest
import torch
import torchmetrics

from drgs.display.pictures import png_bytes
from drgs.features.decoder import Decoder, load_decoder, save_decoder
from drgs.features.pictures import (
    NO_LABEL,
    FeatureColors,
    label_colors,
    label_picture,
    mask_picture,
    overlay,
    with_legend,
)
from drgs.features.segmentation import SCORE_DEFINITIONS, Classes, classify, cosines, scores

pytestmark = pytest.mark.core

NAMES = ("wall", "floor", "chair", "table", "lamp")


def random_classes(count: int = 5, channels: int = 24) -> Classes:
    generator = torch.Generator().manual_seed(3)
    return Classes(NAMES[:count], torch.randn(count, channels, generator=generator))


# ------------------------------------------------------------------------------------------ decoder


def test_a_decoder_is_a_1x1_convolution():
    """What it computes, its state and its gradients are those of torch's Conv2d(D, C, 1) on the same features."""
    torch.manual_seed(0)
    decoder, convolution = Decoder(6, 10), torch.nn.Conv2d(6, 10, 1)
    assert {key: x.shape for key, x in decoder.state_dict().items()} == {
        "conv.weight": (10, 6, 1, 1),
        "conv.bias": (10,),
    }
    decoder.load_state_dict({f"conv.{key}": x for key, x in convolution.state_dict().items()})
    features = torch.randn(4, 5, 6, requires_grad=True)
    mine, theirs = decoder(features), convolution(features.permute(2, 0, 1)).permute(1, 2, 0)
    # One sum of six products in two orders: a few float32 roundings.
    torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)
    cotangent = torch.randn(4, 5, 10)
    (got,), (want,) = (torch.autograd.grad(y, features, cotangent) for y in (mine, theirs))
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)
    assert (decoder.width, decoder.channels) == (6, 10)


def test_metric_measures_decoded_changes():
    """g^T M g is the squared length of what a change g of a feature decodes to, without the bias."""
    torch.manual_seed(1)
    decoder = Decoder(6, 10)
    g = torch.randn(7, 6, dtype=torch.float64)
    decoded = g @ decoder.matrix.detach().double().T
    found = torch.einsum("ni,ij,nj->n", g, decoder.metric(), g)
    torch.testing.assert_close(found, decoded.square().sum(1), rtol=1e-12, atol=0)  # both in float64


def test_decoding_gaussians_first_misses_the_bias_of_what_is_not_covered():
    """Compositing decoded features is decoding composited ones but for (1 - alpha) b, as the module says."""
    torch.manual_seed(2)
    decoder, features, weights = Decoder(6, 10).double(), torch.randn(9, 6).double(), torch.rand(9).double() / 10
    pixel, before = (x.detach() for x in (decoder(weights @ features), weights @ decoder(features)))
    missing = (1 - weights.sum()) * decoder.bias.detach()
    torch.testing.assert_close(pixel - before, missing, rtol=1e-10, atol=1e-12)
    assert float(missing.abs().max()) > 1e-3


def test_decoder_files(tmp_path):
    """A decoder's file holds what Feature 3DGS's holds, gives the same bits back, and its widths are read from it."""
    torch.manual_seed(0)
    decoder, path = Decoder(6, 10), tmp_path / "decoder_chkpnt7000.pth"
    save_decoder(decoder, path)
    held = torch.load(path, weights_only=True)
    assert list(held) == ["conv.weight", "conv.bias"]
    read = load_decoder(path)
    assert all(torch.equal(x, read.state_dict()[key]) for key, x in decoder.state_dict().items())


class Evil:
    """Runs when it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


def test_decoder_files_of_others(tmp_path):
    """A pickle is not run; a missing, damaged, foreign or NaN file and another state are refused in one line."""
    path = tmp_path / "decoder.pth"
    with pytest.raises(FileNotFoundError, match="must be a decoder's state"):
        load_decoder(path)
    good = Decoder(3, 4).state_dict()
    cases = [
        (good | {"conv.bias": torch.zeros(5)}, r"shapes \(4, 3, 1, 1\) and \(5,\)"),
        (good | {"other": torch.zeros(5)}, "among 3 entries"),
        (good | {"conv.bias": torch.full((4,), math.nan)}, "must be finite"),
        ([1, 2], "shapes None and None"),
        ({"weight": torch.zeros(3)}, "shapes None and None"),
        ({"conv.weight": torch.zeros(4, 3, 3, 3), "conv.bias": torch.zeros(4)}, "name a decoder's file"),
    ]
    for state, message in cases:
        torch.save(state, path)
        with pytest.raises(ValueError, match=message) as caught:
            load_decoder(path)
        assert "\n" not in str(caught.value)
    torch.save(good, path)
    whole = path.read_bytes()
    for content in (pickle.dumps(Evil()), whole[: len(whole) // 2], b"", b"<html>", b"glTF    ", b"PK\x03\x04"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=str(path)) as caught:
            load_decoder(path)
        assert "\n" not in str(caught.value)


def test_a_decoder_refuses_other_widths():
    """Features of another width, and widths that are none, say so."""
    with pytest.raises(ValueError, match=r"must have 6 channels, got shape \(2, 5\)"):
        Decoder(6, 10)(torch.zeros(2, 5))
    for width, channels in ((0, 3), (3, True), (2.5, 3)):
        with pytest.raises(ValueError, match="must be a whole number >= 1"):
            Decoder(width, channels)


# ----------------------------------------------------------------------------------- classes, labels


def test_classify_takes_the_largest_cosine(monkeypatch):
    """Labels are those of brute force in float64, with a decoder and without, in chunks of any size, of half floats."""
    torch.manual_seed(4)
    classes, decoder = random_classes(), Decoder(6, 24)
    latent = 9 * torch.randn(7, 11, 6)  # the bias of a new decoder shall not decide
    decoded = decoder(latent).detach()
    unit = torch.nn.functional.normalize(decoded.double(), dim=-1)
    want = (unit @ classes.embeddings.double().T).argmax(-1) + 1
    assert set(want.unique().tolist()) == {1, 2, 3, 4, 5}
    for chunk in (1 << 22, 100):  # all at once, and a few pixels at a time
        monkeypatch.setattr("drgs.features.segmentation._CHUNK", chunk)
        assert torch.equal(classify(decoded, classes), want)
        assert torch.equal(classify(latent, classes, decoder), want)
        got = cosines(latent, classes.embeddings, decoder)
        # 24 products in float32.
        torch.testing.assert_close(got.double(), unit @ classes.embeddings.double().T, rtol=0, atol=1e-6)
    half = classify(decoded.half(), classes)
    assert float((half == want).float().mean()) > 0.9  # near ties may fall otherwise
    assert classify(decoded[:0], classes).shape == (0, 11)
    assert want.dtype == half.dtype == torch.int64
    assert torch.equal(cosines(torch.zeros(2, 24), classes.embeddings), torch.zeros(2, 5))


def test_classes_are_checked():
    """Names and embeddings belong together; rows become unit vectors; names are found whatever their case."""
    classes = random_classes()
    # float32's rounding of 1.
    torch.testing.assert_close(classes.embeddings.norm(dim=1), torch.ones(5), rtol=0, atol=1e-6)
    assert classes.labels_of(" Chair") == (3,)
    assert Classes(("screen", "door", "screen")).labels_of("screen") == (1, 3)
    assert len(classes) == 5
    cases = [
        (lambda: Classes("wall"), "names must be texts"),
        (lambda: Classes(()), "names must be texts"),
        (lambda: Classes(("a", "b"), torch.ones(3, 4)), "a row for each of the 2 names, got 3"),
        (lambda: Classes(("a", "b"), torch.tensor([[1.0], [0.0]])), "row 1 is not"),
        (lambda: Classes(("a",), torch.tensor([[math.nan]])), "row 0 is not"),
        (lambda: Classes(("a",), torch.ones(4)), "must be a .K, C. tensor"),
        (lambda: classes.labels_of("chaise"), "must be one of wall, floor, chair, table, lamp"),
        (lambda: classify(torch.zeros(2, 23), classes), "must have the features' 23 channels, got 24"),
        (lambda: classify(torch.zeros(2, 24), Classes(NAMES)), "have names only"),
        (lambda: classify(torch.zeros(2, 5), classes, Decoder(6, 24)), "the decoder's 6 channels, got 5"),
        (lambda: classify(torch.full((2, 24), math.nan), classes), "must be finite"),
        (lambda: cosines(torch.full((2, 24), math.inf), classes.embeddings), "must be finite"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_scores_by_hand():
    """Of two small images every number is what one counts on paper; unlabelled pixels do not count."""
    reference = [np.array([[1, 1, 1, 2], [2, 3, 0, 0]]), np.array([[1, 1], [2, 0]])]
    predicted = [np.array([[1, 1, 2, 2], [2, 4, 1, 4]]), np.array([[1, 0], [2, 5]])]
    found = scores(zip(predicted, reference, strict=True), 5)
    # Labelled pixels: 6 + 3; right: 2 + 2 of the first image, 1 + 1 of the second.
    assert (found["images"], found["pixels"]) == (2, 9)
    assert found["pixel_accuracy"] == pytest.approx(6 / 9)
    # Recall: class 1: 3 of 5, class 2: 3 of 3, class 3: 0 of 1.
    assert found["class_accuracy"] == pytest.approx((3 / 5 + 1 + 0) / 3)
    # IoU: class 1: 3 / 5; class 2: 3 / (3 + 1); class 3: 0; classes 4 and 5 are not in the reference.
    assert found["iou"] == [pytest.approx(3 / 5), pytest.approx(3 / 4), 0.0, None, None]
    assert found["miou"] == pytest.approx((3 / 5 + 3 / 4 + 0) / 3)
    # First image: labels 1, 2, 3, 4 occur: 2/3, 2/3, 0, 0; second: 1 and 2: 1/2 and 1.
    assert found["miou_top7"] == pytest.approx(((2 / 3 + 2 / 3) / 4 + 3 / 4) / 2)
    assert set(SCORE_DEFINITIONS) == set(found) - {"images", "pixels"}
    json.dumps(found)


def test_scores_are_those_of_torchmetrics():
    """Pixel accuracy, class accuracy and mIoU agree with an independent implementation on random labels."""
    generator = torch.Generator().manual_seed(5)
    reference = torch.randint(0, 12, (3, 20, 30), generator=generator)
    keep = torch.rand(reference.shape, generator=generator) < 0.6
    predicted = torch.where(keep, reference, torch.randint(1, 12, reference.shape, generator=generator)).clamp_min(1)
    found = scores(zip(predicted, reference, strict=True), 11)
    how = {"task": "multiclass", "num_classes": 12, "ignore_index": 0}
    micro = torchmetrics.Accuracy(**how, average="micro")(predicted, reference)
    macro = torchmetrics.Accuracy(**how, average="none")(predicted, reference)[1:].mean()
    iou = torchmetrics.JaccardIndex(**how, average="none")(predicted, reference)[1:]
    # torchmetrics counts in float32.
    assert found["pixel_accuracy"] == pytest.approx(float(micro), abs=1e-6)
    assert found["class_accuracy"] == pytest.approx(float(macro), abs=1e-6)
    assert found["iou"] == pytest.approx(iou.tolist(), abs=1e-6)
    assert found["miou"] == pytest.approx(float(iou.mean()), abs=1e-6)


def test_top7_leaves_out_what_is_rare():
    """Of nine labels the two rarest do not count; brute force over label masks, as the rule is published, agrees."""
    rng = np.random.default_rng(6)
    reference = np.sort(rng.choice(np.arange(1, 10), (40, 40), p=np.arange(1, 10) / 45), axis=1)
    predicted = np.where(rng.random(reference.shape) < 0.7, reference, rng.integers(1, 10, reference.shape))
    labels, counts = np.unique(np.concatenate([reference, predicted]), return_counts=True)
    top = labels[np.argsort(-counts, kind="stable")][:7]
    assert len(labels) == 9
    want = np.mean(
        [((predicted == k) & (reference == k)).sum() / ((predicted == k) | (reference == k)).sum() for k in top]
    )
    found = scores([(predicted, reference)], 9)
    assert found["miou_top7"] == pytest.approx(want, rel=1e-12)
    assert abs(found["miou_top7"] - found["miou"]) > 1e-3


def test_scores_refuse_what_has_none():
    """Shapes that differ, labels out of range or of floats, and references without a label say so, with the image."""
    one = np.ones((2, 2), int)
    cases = [
        ([(one, one), (one, np.ones((3, 2), int))], "image 1: prediction and reference must have one shape"),
        ([(one * 4, one)], r"labels of the prediction must be in \[0, 3\], got 4"),
        ([(one, -one)], r"labels of the reference must be in \[0, 3\], got -1"),
        ([(one * 1.0, one)], "the prediction must hold integers, got float64"),
        ([(one, one * 0)], "must label a pixel"),
        ([], "must label a pixel"),
    ]
    for pairs, message in cases:
        with pytest.raises(ValueError, match=message):
            scores(iter(pairs), 3)


# ----------------------------------------------------------------------------------------- pictures


def test_feature_colors_are_principal_components():
    """The three axes are those of NumPy's SVD; the same features have the same color whatever map they are in."""
    torch.manual_seed(7)
    weights = torch.tensor([5.0, 3.0, 2.0, 0.3, 0.2, 0.1])
    features = torch.randn(12, 15, 6) * weights
    colors = FeatureColors.of([features])
    unit = torch.nn.functional.normalize(features.reshape(-1, 6).double(), dim=1).numpy()
    axes = np.linalg.svd(unit - unit.mean(0), full_matrices=False)[2][:3]
    # Axes up to their sign, in float32.
    np.testing.assert_allclose(np.abs((colors.axes.numpy() * axes.T).sum(0)), 1, atol=1e-5)
    picture = colors.picture(features)
    assert picture.shape == (12, 15, 3)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(colors.picture(3 * features[:, ::2]), picture[:, ::2])  # length does not count
    again = FeatureColors.of([features])
    np.testing.assert_array_equal(again.picture(features), picture)
    for channel in range(3):  # about 1 % of the pixels at each end, and what rounds to it
        assert 0.005 < (picture[..., channel] == 0).mean() < 0.05
        assert 0.005 < (picture[..., channel] == 255).mean() < 0.05


def test_feature_colors_of_odd_maps():
    """Nothing is black; maps of one channel, of one value, and with NaN pixels give finite pictures; no map raises."""
    features = torch.ones(4, 4, 2)
    features[0, 0] = 0
    assert FeatureColors.of([features]).picture(features)[0, 0].tolist() == [0, 0, 0]
    torch.manual_seed(0)
    decoder = Decoder(2, 5)
    colors = FeatureColors.of([decoder(torch.randn(30, 2))])
    assert colors.picture(features, decoder).shape == (4, 4, 3)
    broken = torch.randn(4, 4, 5)
    broken[1, 1] = math.nan
    assert torch.isfinite(FeatureColors.of([broken, broken]).axes).all()
    for maps in ([], [torch.zeros(3, 3, 5)]):
        with pytest.raises(ValueError, match="must hold a feature"):
            FeatureColors.of(maps)


def test_label_colors_are_told_apart():
    """The colors of 40 classes, and of no label, are 20 CIELAB units apart or more; the first ones are fixed."""
    import cv2

    table = label_colors(40)
    assert table.shape == (41, 3)
    assert tuple(table[0]) == NO_LABEL
    lab = cv2.cvtColor(table[None].astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    distances = np.linalg.norm(lab[:, None] - lab[None], axis=2)[np.triu_indices(41, 1)]
    assert distances.min() > 20  # a difference of 2.3 is just seen, side by side
    np.testing.assert_array_equal(label_colors(7), table[:8])


def test_label_pictures():
    """Labels have their colors; an overlay mixes them, keeps what has no label, and darkens borders."""
    labels = np.array([[0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 1, 1], [2, 2, 1, 1]])
    table = label_colors(2)
    np.testing.assert_array_equal(label_picture(labels, 2), table[labels])
    photo = np.full((4, 4, 3), 0.5, np.float32)
    mixed = overlay(photo, labels, 2, strength=0.5)
    assert mixed[0, 0].tolist() == [128] * 3
    assert np.abs(mixed[3, 3].astype(int) - (0.5 * 128 + 0.5 * table[1])).max() <= 1
    assert (mixed[3, 1] < mixed[3, 0]).any()
    mask = mask_picture(photo, labels == 2)
    assert mask[3, 0].tolist() == [round(0.55 * 128 + 0.45 * c) for c in (255, 120, 0)]
    assert mask[0, 0].tolist() == [round(0.7 * 128)] * 3


def test_legends_fit():
    """A legend shows every class's color, in columns where the picture is low, and makes room for long names."""
    names = [f"class {k}" for k in range(1, 19)] + ["ß" * 60]
    for height in (10, 60, 480):
        picture = with_legend(np.zeros((height, 30, 3), np.uint8), names)
        assert len(picture) >= height
        seen = {tuple(color) for color in picture[:, 30:].reshape(-1, 3)}
        assert {tuple(color) for color in label_colors(19)[1:]} <= seen
        assert png_bytes(picture)
    only = with_legend(np.zeros((60, 30, 3), np.uint8), names, labels=[0, 3])
    seen = {tuple(color) for color in only[:, 30:].reshape(-1, 3)}
    assert {tuple(label_colors(19)[k]) for k in (0, 3)} <= seen
    assert tuple(label_colors(19)[4]) not in seen
