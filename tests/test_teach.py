"""A CLIP model as a dense teacher, and `drgs teach`; the model is tiny and random, made here."""

import json
import math
import re
import shutil
import socket
import string
import sys
from pathlib import PurePosixPath

import cv2
import numpy as np
import pytest
import torch
from json_page import check

transformers = pytest.importorskip("transformers", reason="needs the extra teacher: pip install 'drgs[teacher]'")

from drgs import data  # noqa: E402 (after the reason to skip)
from drgs.cli import main  # noqa: E402
from drgs.commands import options  # noqa: E402
from drgs.features.encoders import MAP_NORM, SCALES, TEMPLATES, ClipEncoder  # noqa: E402
from drgs.features.teacher import read_map  # noqa: E402

CHANNELS, PATCH = 12, 8


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A folder as transformers saves it: CLIP of two layers with random weights, and a tokenizer of letters."""
    folder = tmp_path_factory.mktemp("clip")
    torch.manual_seed(0)
    size = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    signs = [*string.ascii_lowercase, *string.digits, "."]
    words = ["<|startoftext|>", "<|endoftext|>", *signs, *(f"{sign}</w>" for sign in signs)]
    tokens = {"vocab_size": len(words), "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    config = transformers.CLIPConfig(
        text_config={**size, **tokens},
        vision_config={**size, "image_size": 16, "patch_size": PATCH},
        projection_dim=CHANNELS,
    )
    made = transformers.CLIPModel(config)
    with torch.no_grad():  # the initial values of CLIP hardly differ from each other
        for x in made.parameters():
            x += 0.2 * torch.randn_like(x)
    made.save_pretrained(folder)
    tokenizer = transformers.CLIPTokenizer(vocab={word: i for i, word in enumerate(words)}, merges=[])
    tokenizer.save_pretrained(folder)
    return folder


@pytest.fixture
def capture(tmp_path):
    """Three photographs of 24x16 pixels with poses."""
    rng = np.random.default_rng(0)
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(3):
        picture = cv2.resize(rng.integers(0, 255, (4, 6, 3), np.uint8), (24, 16), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"images/view_{i}.png"), picture)
        pose = np.eye(4)
        pose[0, 3] = 0.3 * i
        frames.append({"file_path": f"images/view_{i}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 20.0, "fl_y": 20.0, "cx": 12.0, "cy": 8.0, "w": 24, "h": 16}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


def teach(capture, model, *more):
    """Exit code of `drgs teach`, with small maps at one scale."""
    return main(["teach", str(capture), "--model", str(model), "--size", "6x4", "--scales", "1", *map(str, more)])


# ------------------------------------------------------------------------------------------ encoder


def test_patches_attend_to_themselves_alone(model):
    """The map is what transformers' own layers give when a mask lets the last attention see only the diagonal."""
    encoder = ClipEncoder(model)
    torch.manual_seed(1)
    pixels = torch.randn(1, 3, 3 * PATCH, 5 * PATCH)
    vision = encoder._model.vision_model
    with torch.no_grad():
        hidden = vision.pre_layrnorm(vision.embeddings(pixels, interpolate_pos_encoding=True))
        hidden = vision.encoder.layers[0](hidden, None)
        alone = torch.full((1, 1, hidden.shape[1], hidden.shape[1]), -math.inf)
        alone[0, 0].fill_diagonal_(0)
        masked = vision.encoder.layers[1](hidden, alone)
        full = vision.encoder.layers[1](hidden, None)
        want, other = (encoder._model.visual_projection(vision.post_layernorm(x))[0, 1:] for x in (masked, full))
    found = encoder.patches(pixels)
    assert found.shape == (CHANNELS, 3, 5)
    # Float32 sums of 16 products in other orders.
    torch.testing.assert_close(found.reshape(CHANNELS, -1).T, want, rtol=1e-4, atol=1e-5)
    assert float((want - other).abs().max()) > 0.01


def test_maps_average_scales_and_mirrors(model):
    """At one scale, unmirrored and of the patches' size, a map is their unit vectors times 4; mirroring the photograph
    mirrors the map that is averaged with its mirror; scales are averaged.
    """
    encoder = ClipEncoder(model)
    image = np.random.default_rng(2).random((32, 48, 3), np.float32)  # 32 = 2 x 16: no resizing at scale 1
    plain = encoder.dense(image, (6, 4), [1.0], flip=False)
    normalized = (torch.from_numpy(image) - torch.from_numpy(encoder._mean)) / torch.from_numpy(encoder._std)
    patches = encoder.patches(normalized.permute(2, 0, 1)[None])
    torch.testing.assert_close(plain, MAP_NORM * torch.nn.functional.normalize(patches, dim=0), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(plain.norm(dim=0), torch.full((4, 6), MAP_NORM), rtol=1e-5, atol=0)
    both = encoder.dense(image, (6, 4), [1.0])
    torch.testing.assert_close(encoder.dense(image[:, ::-1], (6, 4), [1.0]), both.flip(2), rtol=1e-4, atol=1e-4)
    assert float((both - plain).abs().max()) > 0.01
    half = encoder.dense(image, (6, 4), [0.5], flip=False)
    mean = encoder.dense(image, (6, 4), [1.0, 0.5], flip=False)
    torch.testing.assert_close(mean, (plain + half) / 2, rtol=1e-4, atol=1e-5)


def test_texts_are_averages_of_templates(model):
    """Each name's embedding is the unit average of its templates', one text at a time, and names differ."""
    encoder = ClipEncoder(model)
    found = encoder.texts(["chair", "table"])
    tokenizer = transformers.CLIPTokenizer.from_pretrained(model, local_files_only=True)
    rows = []
    for text in TEMPLATES:
        with torch.no_grad():
            made = encoder._model.get_text_features(**tokenizer(text.format("table"), return_tensors="pt"))
        rows.append(torch.nn.functional.normalize(made.pooler_output[0], dim=0))
    want = torch.nn.functional.normalize(torch.stack(rows).mean(0), dim=0)
    torch.testing.assert_close(found[1], want, rtol=1e-4, atol=1e-5)  # padded to one length, or not
    assert float(found[0] @ found[1]) < 0.999
    torch.testing.assert_close(found.norm(dim=1), torch.ones(2), rtol=1e-5, atol=0)


# ------------------------------------------------------------------------------------------ command


def test_teach_writes_what_a_fit_finds(capture, model, monkeypatch, capsys):
    """Maps, embeddings and classes are found by the loader beside the photographs; no network is asked, and no file of
    the capture is touched.
    """

    def refuse(*_):
        raise AssertionError("asked the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    assert teach(capture, model, "--classes", "chair, table") == 0
    printed = capsys.readouterr()
    check("teach.json", json.loads((capture / "rgb_feature_langseg/teach.json").read_text()))
    check("classes.json", json.loads((capture / "classes.json").read_text()))
    assert "maps of 3 photographs, 12 channels" in printed.out
    assert "text embeddings of 2 classes" in printed.out
    assert {path: path.read_bytes() for path in before} == before
    dataset = data.load(capture)
    semantics = dataset.semantics
    assert (semantics.teacher, semantics.channels, semantics.map_size) == ("rgb_feature_langseg", CHANNELS, (6, 4))
    assert semantics.classes.names == ("chair", "table")
    encoder = ClipEncoder(model)
    torch.testing.assert_close(semantics.classes.embeddings, encoder.texts(["chair", "table"]), rtol=1e-5, atol=1e-6)
    for view in dataset.views:
        values = view.teacher()
        assert values.dtype == torch.float16
        want = encoder.dense(view.image(), (6, 4), [1.0])
        torch.testing.assert_close(values.float(), want, rtol=2e-3, atol=2e-3)  # half precision of numbers below 4


def test_maps_are_of_photographs_as_they_are(capture, model, capsys):
    """Of a lens, the file is the map of the bent photograph, which the loader straightens as it does the photograph;
    photographs in subfolders have maps in subfolders; two that differ in their endings only are refused.
    """
    path = capture / "transforms.json"
    poses = json.loads(path.read_text())
    (capture / "images/left").mkdir()
    shutil.move(capture / "images/view_0.png", capture / "images/left/view_0.png")
    poses["frames"][0]["file_path"] = "images/left/view_0.png"
    path.write_text(json.dumps(poses | {"k1": 0.3}))
    assert teach(capture, model, "--quiet") == 0
    view = next(view for view in data.load(capture).views if view.name.endswith("view_0"))
    photograph = cv2.imread(str(view.image_path))[..., ::-1].astype(np.float32) / 255
    want = ClipEncoder(model).dense(photograph, (6, 4), [1.0])
    torch.testing.assert_close(read_map(view.teacher_path).float(), want, rtol=2e-3, atol=2e-3)  # half precision
    assert float((view.teacher().float() - want).abs().max()) > 0.05
    assert view.teacher_path.parent.name == PurePosixPath(view.name).parent.name
    shutil.copy(capture / "images/view_2.png", capture / "images/view_1.jpg")
    poses["frames"][2]["file_path"] = "images/view_1.jpg"
    path.write_text(json.dumps(poses))
    assert teach(capture, model) == 2
    assert "must have a name of its own" in capsys.readouterr().err


def test_teach_goes_on_where_it_stopped(capture, model, monkeypatch, capsys):
    """A map that is missing is made, the others are not; other options make all anew, other classes only the texts, and
    another name of the model's folder nothing.
    """
    assert teach(capture, model, "--quiet") == 0
    maps = sorted((capture / "rgb_feature_langseg").glob("*.pt"))
    assert len(maps) == 3
    kept = {path: path.read_bytes() for path in maps}
    maps[1].unlink()
    made = []
    whole = ClipEncoder.dense

    def counted(self, *args):
        made.append(args[1])
        return whole(self, *args)

    monkeypatch.setattr(ClipEncoder, "dense", counted)
    assert teach(capture, model) == 0
    assert "2 of them made before" in capsys.readouterr().out
    assert len(made) == 1
    assert {path: path.read_bytes() for path in maps} == kept
    assert teach(capture, model, "--classes", "lamp") == 0
    assert teach(capture, model, "--classes", "lamp,rug") == 0
    assert len(made) == 1
    assert data.load(capture).semantics.classes.names == ("lamp", "rug")
    assert teach(capture, model) == 0  # the classes of before
    assert np.load(capture / "text_embeddings.npy").shape == (2, CHANNELS)
    assert teach(capture, model / ".." / model.name) == 0
    assert len(made) == 1
    assert {path: path.read_bytes() for path in maps} == kept
    assert teach(capture, model, "--no-flip") == 0
    assert len(made) == 4


def test_teach_writes_into_the_data_set_below(capture, model, tmp_path, capsys):
    """Of the folder above a data set, which archives are unpacked to: beside the photographs, where the loader looks;
    and of a file that is named, beside it.
    """
    assert teach(tmp_path, model) == 0
    assert str(capture / "rgb_feature_langseg") in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == [capture.name]
    assert data.load(tmp_path).semantics.teacher == "rgb_feature_langseg"
    assert teach(capture / "transforms.json", model) == 0
    assert "3 of them made before" in capsys.readouterr().out


def test_teach_replaces_nothing_of_others(capture, model, capsys):
    """Maps, embeddings and classes that are there stay as they are; the classes that the data set names are used."""
    (capture / "classes.txt").write_text("7 sofa\n9 lamp\n")
    assert teach(capture, model, "--classes", "lamp,sofa") == 2
    assert "must be the 2 classes of" in capsys.readouterr().err
    assert teach(capture, model) == 0
    assert not (capture / "classes.json").exists()
    assert data.load(capture).semantics.classes.names == ("sofa", "lamp")
    path = capture / "rgb_feature_langseg/view_0_fmap_CxHxW.pt"
    torch.save(torch.zeros(CHANNELS, 4, 6).half(), path)
    held = path.read_bytes()
    assert teach(capture, model) == 2
    assert "must not be replaced, `drgs teach` did not make it" in capsys.readouterr().err
    assert path.read_bytes() == held
    shutil.rmtree(capture / "rgb_feature_langseg")
    np.save(capture / "text_embeddings.npy", np.ones((2, 5)))
    assert teach(capture, model) == 2
    assert "text_embeddings.npy: must not be replaced" in capsys.readouterr().err
    assert not (capture / "rgb_feature_langseg").exists()


def test_models_that_are_none(capture, model, tmp_path, capsys):
    """No folder or weights, another kind of model, damaged or partial weights, no tokenizer: one line, no file."""
    before = sorted(capture.rglob("*"))

    def broken(name, change):
        folder = tmp_path / name
        shutil.copytree(model, folder)
        change(folder)
        return folder

    def retyped(folder, **fields):
        path = folder / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | fields))

    def partial(folder):
        from safetensors.torch import load_file, save_file

        held = load_file(folder / "model.safetensors")
        held.pop("visual_projection.weight")
        save_file(held, folder / "model.safetensors", {"format": "pt"})

    def pickled(folder):
        (folder / "model.safetensors").unlink()
        (folder / "pytorch_model.bin").write_bytes(b"cos\nsystem\n(S'false'\ntR.")

    weights = "model.safetensors"
    cases = [
        (tmp_path / "none", "must be a folder with a model, found none"),
        (broken("weights", lambda x: (x / weights).unlink()), "must hold the weights model.safetensors, found none"),
        (broken("kind", lambda x: retyped(x, model_type="siglip")), "model_type must be 'clip', got 'siglip'"),
        (broken("config", lambda x: (x / "config.json").unlink()), "found no config.json"),
        (broken("cut", lambda x: (x / weights).write_bytes((x / weights).read_bytes()[:900])), "must be weights of"),
        (broken("partial", partial), "1 are missing, visual_projection.weight first"),
        (broken("pickle", pickled), "must be weights of CLIP"),
        (broken("width", lambda x: retyped(x, projection_dim=13)), "cut|missing|must be weights"),
        (broken("tokens", lambda x: (x / "tokenizer.json").unlink()), "must hold a tokenizer"),
    ]
    for folder, message in cases:
        assert teach(capture, folder, "--classes", "chair") == 2
        error = capsys.readouterr().err
        assert re.search(message, error), error
        assert error.count("\n") == 1, error
        assert sorted(capture.rglob("*")) == before, message


def test_teach_without_transformers(capture, model, monkeypatch, capsys):
    """Where the package is missing, one line says how to get it."""
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert teach(capture, model) == 2
    assert capsys.readouterr().err == (
        "drgs teach: the package transformers must be installed for a teacher, it is not; "
        "run pip install 'drgs[teacher]'\n"
    )


def test_teach_refuses_bad_options(capture, model, capsys):
    """Sizes, scales and classes that cannot be, and data that is not there."""
    for more, message in (
        (["--size", "80"], "--size: must be WIDTHxHEIGHT"),
        (["--size", "0x4"], "--size must be 1x1 to 4096x4096"),
        (["--scales", "1,x"], "--scales must be numbers"),
        (["--scales", "0"], "--scales must be numbers"),
        (["--classes", " , "], "--classes must name a class"),
        (["--classes", "none.txt"], "found none"),
    ):
        assert teach(capture, model, *more) == 2
        assert message in capsys.readouterr().err
    assert teach(capture / "nowhere", model) == 2
    assert "found no such file or folder" in capsys.readouterr().err
    shutil.copytree(capture / "images", capture / "alone/images")
    assert teach(capture / "alone", capture / "nowhere") == 2  # before a model is looked for
    assert "must hold camera poses, found" in capsys.readouterr().err
    assert options.Teach.scales == ",".join(f"{scale:g}" for scale in SCALES)


def test_numbers_of_labels_are_not_named_by_a_teacher(capture, model, capsys):
    """Label images without a file of classes: --classes would call their numbers what they may not be."""
    (capture / "labels").mkdir()
    assert teach(capture, model, "--classes", "chair,table") == 2
    assert "found no classes.json; name them there" in capsys.readouterr().err
    assert not (capture / "classes.json").exists()
