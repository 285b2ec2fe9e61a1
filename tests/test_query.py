"""`drgs query`: what a text means, among Gaussians and pixels."""

import json
import math

import numpy as np
import pytest
import torch

from drgs import Camera, Gaussians, load_ply, render, save_ply
from drgs.cli import main
from drgs.commands.query import read_embeddings
from drgs.commands.scene_input import SceneInput
from drgs.data.camera_lists import save_cameras_json
from drgs.features.decoder import Decoder, save_decoder
from drgs.features.query import TextQuery
from drgs.features.segmentation import Classes
from drgs.fitting.config import FitConfig
from drgs.fitting.records import FitRecord

NAMES = ("wall", "chair", "lamp")
WIDTH, CHANNELS = 3, 8


def embeddings() -> torch.Tensor:
    """Unit vectors with cosines of 0.6, as texts have."""
    rows = torch.eye(CHANNELS)[:3] * math.sqrt(0.4)
    rows[:, 7] = math.sqrt(0.6)
    return rows


def decoder() -> Decoder:
    """One channel a class: feature e_k decodes to the embedding of class k, exactly."""
    made = Decoder(WIDTH, CHANNELS)
    with torch.no_grad():
        made.conv.weight[:] = embeddings().T[:, :, None, None]
        made.conv.bias.zero_()
    return made


def scene() -> Gaussians:
    """A wall of 5 Gaussians at the left, a chair of 4 in the middle, a lamp of 1 at the right: flat, nearly opaque."""
    x = torch.tensor([-0.8, -0.8, -0.8, -0.8, -0.8, 0.0, 0.0, 0.0, 0.0, 0.8])
    y = torch.tensor([-0.6, -0.3, 0.0, 0.3, 0.6, -0.3, -0.1, 0.1, 0.3, 0.0])
    return Gaussians(
        means=torch.stack([x, y, torch.full_like(x, 3.0)], 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(10, 1),
        log_scales=torch.full((10, 3), math.log(0.12)),
        logit_opacities=torch.full((10,), 5.0),
        sh=torch.zeros(10, 1, 3),
        features=torch.eye(WIDTH)[[0] * 5 + [1] * 4 + [2]],
    )


@pytest.fixture
def files(tmp_path):
    """A PLY, its decoder, cameras and embeddings in files."""
    save_ply(scene(), tmp_path / "scene.ply")
    save_decoder(decoder(), tmp_path / "decoder.pth")
    K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    cameras = [Camera(K=K, w2c=np.eye(4), width=48, height=32, name=name) for name in ("left", "right")]
    save_cameras_json(tmp_path / "cameras.json", cameras)
    np.save(tmp_path / "chair.npy", embeddings()[1].numpy())
    torch.save(embeddings()[1:], tmp_path / "both.pt")
    return tmp_path


def query(files, *options, scene="scene.ply", decoder=True):
    """Exit code of `drgs query`."""
    how = ["--decoder", str(files / "decoder.pth")] if decoder else []
    out = ["-o", str(files / "out"), "--cameras", str(files / "cameras.json")]
    return main(["query", str(files / scene), *how, *out, *map(str, options)])


# ------------------------------------------------------------------------------------------- scores


def test_scores_by_hand():
    """Cosine, probability and selection of two features are what the formulas say in float64."""
    E, classes = embeddings().double(), Classes(NAMES, embeddings())
    features = torch.stack([E[1] + 0.1 * E[2], 3 * E[0]]).float()
    cosine = torch.nn.functional.normalize(features.double(), dim=1) @ E.T
    score, selected = TextQuery.of_vectors(embeddings()[1], threshold=0.9).score(features)
    torch.testing.assert_close(score.double(), cosine[:, 1], rtol=0, atol=1e-6)  # float32
    assert selected.tolist() == [True, False]
    probability = torch.softmax(cosine / 0.1, 1)
    both = TextQuery.of_classes(classes, ["chair", "lamp"], threshold=0.5, temperature=0.1)
    score, selected = both.score(features)
    torch.testing.assert_close(score.double(), probability[:, 1:].sum(1), rtol=0, atol=1e-5)  # float32, / 0.1
    assert selected.tolist() == [True, False]
    assert both.rule == "probability >= 0.5 (softmax over 3 texts, temperature 0.1)"
    largest = TextQuery.of_classes(classes, ["Lamp"])
    assert largest.score(features)[1].tolist() == [False, False]
    assert largest.score(embeddings())[1].tolist() == [False, False, True]
    assert largest.rule == "largest cosine of 3 texts"


def test_an_embedding_competes_with_what_means_something_else():
    """Without a threshold, a text stands against the classes; the class of the same embedding is left out of them."""
    classes = Classes(NAMES, embeddings())
    query = TextQuery.of_vectors(2 * embeddings()[1], classes)
    assert query.negatives.shape == (2, CHANNELS)
    assert query.score(embeddings())[1].tolist() == [False, True, False]
    torch.manual_seed(0)
    latent = torch.randn(6, WIDTH)
    coded, plain = query.score(latent, decoder()), query.score(decoder()(latent).detach())
    torch.testing.assert_close(coded[0], plain[0], rtol=1e-4, atol=1e-6)  # two orders of float32 sums, / 0.01
    assert torch.equal(coded[1], plain[1])


def test_queries_that_cannot_be():
    """Unknown classes, no competitor without a threshold, thresholds and temperatures out of range, other widths."""
    classes = Classes(NAMES, embeddings())
    cases = [
        (lambda: TextQuery.of_classes(classes, ["sofa"]), "class 'sofa': must be one of wall, chair, lamp"),
        (lambda: TextQuery.of_classes(classes, NAMES), "a threshold must be given where nothing else competes"),
        (lambda: TextQuery.of_classes(Classes(NAMES), ["wall"]), "must have text embeddings"),
        (lambda: TextQuery.of_vectors(torch.ones(CHANNELS)), "--threshold must be given"),
        (lambda: TextQuery.of_vectors(embeddings(), classes), "every class means the same"),
        (lambda: TextQuery.of_vectors(torch.ones(5), classes), "must have the features' 5 channels, got 8"),
        (lambda: TextQuery.of_vectors(torch.zeros(1, 5), threshold=0.2), "row 0 is not"),
        (lambda: TextQuery.of_vectors(torch.ones(5), threshold=1.5), r"in \[-1, 1\], got 1.5"),
        (lambda: TextQuery.of_classes(classes, ["wall"], threshold=-0.1), r"in \[0, 1\], got -0.1"),
        (lambda: TextQuery.of_classes(classes, ["wall"], temperature=0.0), "must be a number > 0"),
        (lambda: TextQuery.of_vectors(torch.ones(5), threshold=0.1).score(torch.ones(2, 3)), "3 channels .* got 5"),
        (
            lambda: TextQuery.of_vectors(torch.ones(5), threshold=0.1).score(torch.ones(2, WIDTH), decoder()),
            "8 channels of the decoded features, got 5",
        ),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------ command


def test_an_embedding_finds_its_gaussians_and_pixels(files, capsys):
    """The PLY holds the chair's Gaussians with all their bits, masks its pixels; removed, the others are left."""
    assert query(files, "--text-embedding", files / "chair.npy", "--threshold", "0.9") == 0
    line = capsys.readouterr().out
    assert "chair.npy (cosine >= 0.9): 4 of 10 Gaussians, in" in line
    found, g = load_ply(files / "out/selected.ply"), load_ply(files / "scene.ply")
    for name, x in g.take(slice(5, 9)).parameters().items():
        assert torch.equal(found.parameters()[name], x), name
    import cv2

    mask = cv2.imread(str(files / "out/left.mask.png"), cv2.IMREAD_GRAYSCALE)
    assert set(np.unique(mask)) == {0, 255}
    camera = Camera(K=np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), w2c=np.eye(4), width=48, height=32)
    chair = (
        render(g.take(slice(5, 9)), camera, SceneInput(g).settings("fast")).alpha >= 0.5
    )  # nothing is in front of it
    assert (mask > 0).sum() == int(chair.sum()) > 40
    np.testing.assert_array_equal(mask > 0, chair.numpy())
    report = json.loads((files / "out/query.json").read_text())
    assert report["score"] == "cosine"
    assert [view["pixels"] for view in report["views"]] == [int(chair.sum())] * 2
    picture = cv2.imread(str(files / "out/left.png"))
    assert picture.shape == (32, 48, 3)
    assert query(files, "--text-embedding", files / "both.pt", "--threshold", "0.9", "--remove", "--quiet") == 0
    assert len(load_ply(files / "out/rest.ply")) == 5
    assert capsys.readouterr().out == ""


def test_classes_of_a_run(files, monkeypatch, capsys):
    """A run's own decoder and classes are used; --class may be repeated, and says which classes there are."""
    given = SceneInput(scene(), decoder=decoder(), classes=Classes(NAMES, embeddings()))
    monkeypatch.setattr("drgs.commands.query.SceneInput.of", lambda args: given)
    assert query(files, "--class", "chair", "--class", "lamp", decoder=False) == 0
    assert "chair, lamp (largest cosine of 3 texts): 5 of 10 Gaussians" in capsys.readouterr().out
    assert len(load_ply(files / "out/selected.ply")) == 5
    assert query(files, "--class", "sofa", decoder=False) == 2
    assert capsys.readouterr().err == "drgs query: class 'sofa': must be one of wall, chair, lamp; correct it\n"
    assert query(files, "--class", "chair") == 2
    assert "--decoder is for a PLY" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("step", "max_steps", "rate", "needed"),
    [(20, 3000, 1e-3, 1000), (None, 20, 1e-3, 1000), (20, 20, 1e-2, 100), (1000, 3000, 1e-3, None), (6, 6, 0.2, None)],
)
def test_a_short_fit_is_told_how_many_steps_it_needs(files, monkeypatch, capsys, step, max_steps, rate, needed):
    """Where nothing is found: features that move by their rate a step are about 1 after 1 / rate steps."""
    g = scene().replace(features=torch.eye(WIDTH)[[0] * 10])  # all of them wall
    config = FitConfig().replace(max_steps=max_steps, feature_rate=rate)
    record = FitRecord(data=files, train=(), test=(), config=config)
    given = SceneInput(g, record=record, step=step, decoder=decoder(), classes=Classes(NAMES, embeddings()))
    monkeypatch.setattr("drgs.commands.query.SceneInput.of", lambda args: given)
    assert query(files, "--class", "lamp", decoder=False) == 2
    error = capsys.readouterr().err
    assert "a Gaussian must be selected, none of 10 is (largest cosine of 3 texts; " in error
    assert error.count("\n") == 1
    assert not (files / "out").exists()
    if needed is None:
        assert error.endswith("give a --threshold or look for something else\n")
        return
    assert (
        f"need about {needed:,} steps at --feature-rate {rate:g} to tell classes apart, this run has done 20" in error
    )
    assert error.endswith(f"fit with --max-steps {needed} or more\n")


def test_bad_queries_write_nothing(files, capsys):
    """Every mistake is one line and exit code 2, and leaves no file behind."""
    save_ply(scene().replace(features=None), files / "plain.ply")
    save_decoder(Decoder(WIDTH + 1, CHANNELS), files / "wide.pth")
    np.save(files / "short.npy", np.ones(CHANNELS - 1, np.float32))
    np.save(files / "whole.npy", np.ones(CHANNELS, np.int64))
    (files / "lying.npy").write_bytes((files / "chair.npy").read_bytes().replace(b"(8,), }", b"(8000000000000,), }"))
    (files / "empty.pt").write_bytes(b"")
    chair = ["--text-embedding", files / "chair.npy"]
    cases = [
        ((), {}, "one of --class and --text-embedding must be given, got neither"),
        ((*chair, "--class", "chair"), {}, "got both"),
        (("--class", "chair"), {}, "has no classes to take --class from"),
        (chair, {}, "--threshold must be given"),
        ((*chair, "--threshold", "0.9"), {"scene": "plain.ply"}, "must have semantic features, has none"),
        (
            (*chair, "--threshold", "0.9"),
            {"decoder": False},
            "which no decoder was given for, got 8; name theirs (--decoder)",
        ),
        ((*chair, "--threshold", "0.9", "--decoder", files / "wide.pth"), {"decoder": False}, "takes 4"),
        ((*chair, "--threshold", "0.9", "--decoder", files / "no.pth"), {"decoder": False}, "found none"),
        (("--text-embedding", files / "short.npy", "--threshold", "0.9"), {}, "must have the 8 channels"),
        (("--text-embedding", files / "whole.npy", "--threshold", "0.9"), {}, "must be floats of shape"),
        (("--text-embedding", files / "lying.npy", "--threshold", "0.9"), {}, "the header claims"),
        (("--text-embedding", files / "empty.pt", "--threshold", "0.9"), {}, "empty.pt: must be"),
        (("--text-embedding", files / "none.npy", "--threshold", "0.9"), {}, "found none"),
        ((*chair, "--threshold", "1"), {"scene": "scene.ply"}, "none of 10 is"),
        ((*chair, "--threshold", "-1", "--remove"), {}, "all 10 are selected"),
        ((*chair, "--threshold", "0.9", "--max-pixels", "0"), {}, "--max-pixels must be in"),
    ]
    # A feature that is not quite the chair's: the cosine of the best stays below 1.
    g = scene()
    save_ply(g.replace(features=g.features + 0.05 * torch.eye(WIDTH)[2]), files / "scene.ply")
    for options, how, message in cases:
        assert query(files, *options, **how) == 2, message
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == error.count("query: ") == 1
        assert not (files / "out").exists()


def test_embeddings_of_files(files):
    """A single vector and several, of half floats, from .npy and .pt."""
    assert torch.equal(read_embeddings(files / "chair.npy"), embeddings()[1:2])
    assert torch.equal(read_embeddings(files / "both.pt"), embeddings()[1:])
    torch.save(embeddings()[0].half(), files / "half.pt")
    assert read_embeddings(files / "half.pt").dtype == torch.float32
