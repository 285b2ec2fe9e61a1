"""`drgs convert`, the folders of other programs, and columns that viewers leave out."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from splat_samples import sog_scene, write_sample
from test_deform import dynamic
from test_query import decoder, embeddings, scene

import drgs
from drgs import cli
from drgs.cameras import orbit
from drgs.codecs import load_gaussians, save_gaussians
from drgs.commands.convert import label_column, still, uncertainty_columns
from drgs.commands.options import Convert
from drgs.commands.scene_input import SceneInput
from drgs.data.camera_lists import save_cameras_json
from drgs.features.segmentation import Classes
from drgs.files import load_ply, load_state, save_ply, save_state
from drgs.gain import Prior


def convert(*words) -> int:
    return cli.main(["convert", *map(str, words)])


def fisher(words: str) -> int:
    return cli.main(["fisher", *words.split()])


def render(words: str) -> int:
    return cli.main(["render", *words.split()])


def test_every_pair_of_formats(tmp_path, rng, capsys):
    """What is read, to what is written; a second run replaces what the first made, and nothing else."""
    for name in ("v2.spz", "a.splat", "a.sog", "packed.ply", "a.glb"):
        write_sample(tmp_path / name, name, rng)
        for suffix in ("ply", "spz", "glb"):
            for _ in range(2):
                assert convert(tmp_path / name, tmp_path / f"out/{name}.{suffix}") == 0
            assert "Gaussians, SH degree" in capsys.readouterr().out
            assert len(load_gaussians(tmp_path / f"out/{name}.{suffix}")) == len(load_gaussians(tmp_path / name))
    (tmp_path / "out/mine.ply").write_bytes(b"mine")
    assert convert(tmp_path / "a.glb", tmp_path / "out/mine.ply") == 2
    assert (tmp_path / "out/mine.ply").read_bytes() == b"mine"
    assert convert(tmp_path / "a.glb", tmp_path / "a.glb") == 2
    assert "must not be read and replaced, it is an input" in capsys.readouterr().err


def test_infinite_logits_of_splat_transform(tmp_path, caplog):
    """The PLY that it writes of an .spz, whose ends of opacity are infinite logits, becomes that .spz again; and is
    drawn and differentiated.
    """
    logits = torch.tensor([9.0, 9, 9, -12, -12, *np.linspace(-3, 3, 7)])
    n, generator = len(logits), torch.Generator().manual_seed(0)
    made = drgs.Gaussians.from_arrays(
        *(torch.randn(n, k, generator=generator) for k in (3, 4)),
        torch.ones(n, 3),
        logits.sigmoid(),
        torch.zeros(n, 1, 3),
    )
    save_gaussians(made, tmp_path / "a.spz")
    assert convert(tmp_path / "a.spz", tmp_path / "b.ply") == 0
    written = plyfile.PlyData.read(tmp_path / "b.ply", mmap=False)
    written["vertex"]["opacity"][:3], written["vertex"]["opacity"][3:5] = np.inf, -np.inf
    written.write(tmp_path / "c.ply")
    caplog.clear()
    assert convert(tmp_path / "c.ply", tmp_path / "d.spz") == 0
    assert [x for x in caplog.messages if "opacities" in x] == [
        f"{tmp_path}/c.ply: 5 of 12 opacities are 0 or 1 (infinite logits), read as logits of -104.7 and 18.0"
    ]
    assert (tmp_path / "d.spz").read_bytes() == (tmp_path / "a.spz").read_bytes()
    g = load_gaussians(tmp_path / "c.ply")
    g = g.replace(logit_opacities=g.logit_opacities.requires_grad_())
    image = drgs.render(g, orbit((0, 0, 0), 8.0, 1, width=24, height=16)[0]).rgb
    image.sum().backward()
    assert torch.isfinite(image).all()
    assert torch.isfinite(g.logit_opacities.grad).all()


_WRITTEN = r"must end with \.ply, \.compressed\.ply, \.spz, \.splat, \.sog, \.glb, got"


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("b.xyz",), rf"b.xyz {_WRITTEN} .xyz; choose one of these"),
        (("b.usdz",), rf"b.usdz {_WRITTEN} .usdz; choose one of these"),
        (
            ("b.KSPLAT",),
            rf"{_WRITTEN} .ksplat, a format that drgs reads and does not write; write b.ply, .*: "
            "`node util/create-ksplat.js b.ply b.KSPLAT` of ",
        ),
        (("c/meta.json",), rf"meta.json {_WRITTEN} .json; choose one of these"),
        (("b.spz", "--labels"), "--labels must have a .ply to write to"),
        (("b.ply", "--labels"), "--labels must have a run that was fitted with classes"),
        (("b.ply", "--time", "0"), "--time must have a scene that moves"),
        (("b.ply", "--as-stored"), "--as-stored must have an .spz"),
        (("b.ply", "--uncertainty", "gone.safetensors"), "must be a checkpoint, found none"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_written(tmp_path, rng, monkeypatch, capsys, words, match):
    """One line, exit code 2, and no file."""
    import re

    monkeypatch.chdir(tmp_path)
    write_sample(tmp_path / "a.splat", "a.splat", rng)
    assert convert("a.splat", *words) == 2
    line = capsys.readouterr().err
    assert re.search(match, line), line
    assert line.count("\n") == 1
    assert "rename" not in line
    assert not list(tmp_path.glob("[bc]*"))


def test_as_stored_is_the_other_half_of_the_turn(tmp_path, rng):
    """The PLY of an .spz whose writer left out the turn has its numbers."""
    write_sample(tmp_path / "a.spz", "v3.spz", rng)
    assert convert(tmp_path / "a.spz", tmp_path / "b.ply", "--as-stored") == 0
    assert torch.equal(load_ply(tmp_path / "b.ply").means, load_gaussians(tmp_path / "a.spz", as_stored=True).means)


def test_information_becomes_columns_that_are_left_out(tmp_path, rng, caplog):
    """sqrt of the sum of 1 / (H + lambda) over a group; other groups and viewers know nothing of it."""
    write_sample(tmp_path / "a.splat", "a.splat", rng)
    g = load_gaussians(tmp_path / "a.splat")
    H = {"means": torch.rand(5, 3).double(), "logit_opacities": torch.rand(5).double(), "backdrop": torch.rand(9)}
    save_state(tmp_path / "information.safetensors", H, {"groups": list(H)})
    words = ("--uncertainty", tmp_path / "information.safetensors", "--prior", "0.5")
    assert convert(tmp_path / "a.splat", tmp_path / "b.ply", *words) == 0
    vertex = plyfile.PlyData.read(tmp_path / "b.ply")["vertex"]
    assert [p.name for p in vertex.properties][-2:] == ["uncertainty_means", "uncertainty_logit_opacities"]
    wanted = (1 / (H["means"] + 0.5)).sum(1).sqrt().numpy()
    np.testing.assert_allclose(vertex["uncertainty_means"], wanted, rtol=1e-6)
    np.testing.assert_allclose(vertex["uncertainty_logit_opacities"], (H["logit_opacities"] + 0.5) ** -0.5, rtol=1e-6)
    with caplog.at_level(logging.WARNING):
        back = load_ply(tmp_path / "b.ply")
    assert not caplog.records
    assert all(torch.equal(x, back.parameters()[name]) for name, x in g.parameters().items())
    with pytest.raises(ValueError, match=r"must be about these 3 Gaussians, its group means has shape \(5, 3\)"):
        uncertainty_columns(tmp_path / "information.safetensors", g.take(slice(3)), Prior())
    save_state(tmp_path / "other.safetensors", {"phi": torch.zeros(2)}, {})
    with pytest.raises(ValueError, match="must hold information of Gaussians, holds phi"):
        uncertainty_columns(tmp_path / "other.safetensors", g, Prior())


def test_information_that_the_command_wrote(tmp_path, monkeypatch):
    """`drgs fisher` and then `drgs convert --uncertainty`: what no view saw keeps the prior's deviation."""
    monkeypatch.chdir(tmp_path)
    g = scene().replace(features=None)
    far = g.means.clone()
    far[9] = torch.tensor([0.0, 0.0, -50.0])  # behind the camera
    save_ply(g.replace(means=far), "scene.ply")
    cameras = orbit((0, 0, 3), 3.0, 1, width=24, height=20)
    save_cameras_json("cameras.json", cameras)
    assert fisher("scene.ply --train cameras.json --limit 1 -o out --quiet") == 0
    assert convert("scene.ply", "b.ply", "--uncertainty", "out/information.safetensors", "--prior", "4") == 0
    column = plyfile.PlyData.read("b.ply")["vertex"]["uncertainty_means"]
    H, header = load_state("out/information.safetensors")
    unseen = (H["means"] == 0).all(1).numpy()
    assert 0 < unseen.sum() < 10
    known_before = header["length"] * math.sqrt(3 / 4)
    np.testing.assert_allclose(column[unseen], known_before, rtol=1e-6)
    assert (column[~unseen] < known_before).all()


def test_labels_are_those_of_the_largest_cosine(tmp_path, caplog):
    """A byte a Gaussian, and the names in the header."""
    g, names = scene(), ("wall", "chair", "lamp  post\nend_header")
    given = SceneInput(g, decoder=decoder(), classes=Classes(names, embeddings()))
    labels, comments = label_column(Path("run"), given, g)
    save_gaussians(g, tmp_path / "a.ply", extra={"label": labels}, comments=comments)
    ply = plyfile.PlyData.read(tmp_path / "a.ply")
    assert ply["vertex"]["label"].tolist() == [1] * 5 + [2] * 4 + [3]
    assert ply["vertex"]["label"].dtype == np.uint8
    assert ply.comments == ["label 1 wall", "label 2 chair", "label 3 lamp post end_header"]
    with caplog.at_level(logging.WARNING):
        assert load_ply(tmp_path / "a.ply").features is not None
    assert not caplog.records
    save_ply(g, tmp_path / "b.ply", extra={"label": labels * 1000})
    assert plyfile.PlyData.read(tmp_path / "b.ply")["vertex"]["label"].tolist() == (labels * 1000).tolist()


def test_a_scene_that_moves_is_converted_at_a_time(tmp_path):
    """Of a run whose Gaussians move, --time says when; without it, the command that writes all times is named."""
    scene_ = dynamic(scene().replace(features=None), None)
    given = SceneInput(scene_.gaussians, moving=scene_)
    args = Convert(scene=tmp_path / "run", out=tmp_path / "a.ply", time=0.7)
    found = still(args, given)
    assert torch.equal(found.means, scene_.at(0.7).means)
    assert not torch.equal(found.means, scene_.gaussians.means)
    with pytest.raises(ValueError, match="--time must say when; `drgs render --format ply`"):
        still(dataclasses.replace(args, time=None), given)


def test_extra_columns_that_cannot_be(tmp_path):
    """Names that a viewer might take for its own, other lengths, NaN, negative labels."""
    g = scene()
    for name, values, match in (
        ("opacity", np.zeros(10), "extra columns must be named uncertainty_"),
        ("uncertainty_a b", np.zeros(10), "extra columns must be named uncertainty_"),
        ("uncertainty_x", np.zeros(9), "have 10 values"),
        ("uncertainty_x", np.full(10, np.nan), "uncertainty_x must be finite, got nan at index 0"),
        ("label", np.full(10, -1), r"label must be in 0..65535, got -1..0"),
    ):
        with pytest.raises(ValueError, match=match):
            save_ply(g, tmp_path / "a.ply", extra={name: values})
    with pytest.raises(ValueError, match=r"label must go into a .ply, .glb has no room"):
        save_gaussians(g, tmp_path / "a.glb", extra={"label": np.zeros(10, int)})


def test_a_model_folder_of_inria(tmp_path, monkeypatch, capsys):
    """The highest iteration by number; cameras.json for --cameras; cfg_args, a line of Python, is not run."""
    monkeypatch.chdir(tmp_path)
    model = tmp_path / "model"
    for iteration, count in ((7000, 3), (30000, 7), (900, 5)):
        save_ply(
            scene().replace(features=None).take(slice(count)),
            model / f"point_cloud/iteration_{iteration}/point_cloud.ply",
        )
    (model / "point_cloud/iteration_99999").mkdir()  # nothing was saved there
    (model / "cfg_args").write_text("__import__('pathlib').Path('run').write_text('it')")
    save_cameras_json(model / "cameras.json", orbit((0, 0, 3), 3.0, 2, width=24, height=20))
    assert len(load_gaussians(model)) == 7
    assert render("model --cameras model --format png --set order=center -o out") == 0
    assert len(list((tmp_path / "out").glob("*.png"))) == 2
    assert not (tmp_path / "run").exists()
    for path in model.glob("point_cloud/*/point_cloud.ply"):
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"must hold iteration_\*/point_cloud.ply, holds none"):
        load_gaussians(model)


def test_an_export_of_splatfacto(tmp_path):
    """Its comments and order of columns; with colors as RGB, the option that exports SH is named."""
    g = scene().replace(features=None)
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    columns = [g.means, torch.zeros(10, 3), g.sh[:, 0], g.logit_opacities[:, None], g.log_scales, g.quats]

    def write(names, table):
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            "comment Generated by Nerfstudio 1.1.5",
            "comment Vertical Axis: z",
        ]
        lines += [f"element vertex {len(table)}", *(f"property float {name}" for name in names), "end_header\n"]
        (tmp_path / "splat.ply").write_bytes("\n".join(lines).encode() + table.numpy().astype("<f4").tobytes())

    write(names, torch.cat(columns, 1))
    back = load_gaussians(tmp_path / "splat.ply")
    assert all(torch.equal(x, back.parameters()[name]) for name, x in g.parameters().items())
    colors = [name.replace("f_dc_0", "red").replace("f_dc_1", "green").replace("f_dc_2", "blue") for name in names]
    write(colors, torch.cat(columns, 1))
    with pytest.raises(
        ValueError, match="its colors are RGB: export it with `ns-export gaussian-splat --ply-color-mode"
    ):
        load_gaussians(tmp_path / "splat.ply")


@pytest.mark.parametrize("name", ["scene.spz", "scene.sog", "folder"])
def test_commands_take_every_format(tmp_path, rng, monkeypatch, capsys, name):
    """`drgs render` draws what `drgs.render` would; the same door (`SceneInput.at`) is that of all commands."""
    monkeypatch.chdir(tmp_path)
    if name == "folder":
        (tmp_path / name).mkdir()
        meta, images, _ = sog_scene(rng)
        for file, data in {"meta.json": json.dumps(meta).encode(), **images}.items():
            (tmp_path / name / file).write_bytes(data)
    else:
        write_sample(tmp_path / name, {"scene.spz": "v3.spz", "scene.sog": "a.sog"}[name], rng)
    assert render(f"{name} --frames 1 --width 16 --format png --set order=center -o out --quiet") == 0, (
        capsys.readouterr().err
    )
    assert len(list((tmp_path / "out").glob("*.png"))) == 1
