"""What a run holds is read by one function, from its checkpoint; its PLY stands in where that cannot be read."""

from __future__ import annotations

import json
import re

import pytest
import torch
from test_resume import dataset, made, run  # noqa: F401 (fixtures)

from drgs import cli
from drgs.commands.scene_input import SceneInput
from drgs.files import load_ply, load_state, save_ply, save_state
from drgs.fitting.records import load_run


def equal(a, b) -> bool:
    """Whether Gaussians have the same bits."""
    a, b = a.parameters(), b.parameters()
    return a.keys() == b.keys() and all(torch.equal(x, b[name]) for name, x in a.items())


def test_checkpoint_and_ply_hold_the_same_bits(run, caplog):  # noqa: F811
    """Of every parameter, at the degree of SH that the fit has reached, here none of the two that are its aim."""
    loaded = load_run(run)
    assert equal(loaded.gaussians, load_ply(run.point_cloud))
    assert loaded.gaussians.sh_degree == load_ply(run.point_cloud).sh_degree
    assert not any(x.requires_grad for x in loaded.gaussians.parameters().values())
    assert (loaded.step, loaded.record.config.max_steps) == (6, 6)
    assert equal(SceneInput.at(run.path).gaussians, loaded.gaussians)
    assert not caplog.text


def test_run_without_its_ply(run, dataset, monkeypatch, caplog):  # noqa: F811
    """Nothing is missing: commands read the checkpoint, and `eval` finds what the fit found."""
    found = json.loads((run.path / "metrics.json").read_text())["mean"]
    run.point_cloud.unlink()
    monkeypatch.setattr("drgs.data.load", lambda *_, **__: dataset)
    assert cli.main(["eval", str(run.path), "--quiet"]) == 0
    assert json.loads((run.path / "metrics.json").read_text())["mean"]["psnr"] == pytest.approx(found["psnr"])
    assert not caplog.text


def damaged(path) -> None:
    path.write_bytes(path.read_bytes()[:999])


def of_a_newer_version(path) -> None:
    tensors, header = load_state(path)
    save_state(path, tensors, header)
    path.write_bytes(path.read_bytes().replace(rb"schema\": 1", rb"schema\": 9", 1))


def not_finite(path) -> None:
    tensors, header = load_state(path)
    tensors["parameter.quats"][3, 0] = torch.nan
    save_state(path, tensors, header)


def short(path) -> None:
    tensors, header = load_state(path)
    save_state(path, {**tensors, "parameter.quats": tensors["parameter.quats"][1:]}, header)


def without_its_network(path) -> None:
    tensors, header = load_state(path)
    save_state(path, tensors, header | {"networks": ["field"]})


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda path: path.unlink(), "must be a checkpoint, found none"),
        (damaged, "must be a checkpoint, got "),
        (of_a_newer_version, "checkpoint schema must be 1, got 9"),
        (not_finite, "quats must be finite, got .* at index 3"),
        (without_its_network, "network 'field' must have parameters, got none"),
        (short, r"parameter\.quats must be torch\.float32 of shape"),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_run_without_a_checkpoint_is_its_ply(run, change, told, caplog):  # noqa: F811
    """One line names the checkpoint and what is wrong with it; without the PLY, too, it is the error."""

    change(run.state)
    loaded = load_run(run)
    assert equal(loaded.gaussians, load_ply(run.point_cloud))
    assert loaded.step is None
    assert len(caplog.messages) == 1
    assert re.search(rf"state\.safetensors: {told}.*; point_cloud\.ply is taken instead$", caplog.messages[0])
    assert "\n" not in caplog.messages[0]
    run.point_cloud.unlink()
    with pytest.raises(
        (ValueError, FileNotFoundError), match=told if run.state.exists() else "found none; the fit has"
    ):
        load_run(run)


def test_edited_ply_is_told_of(run, caplog):  # noqa: F811
    """The checkpoint is taken, whether the PLY was cleaned by hand or damaged."""
    g = load_run(run).gaussians
    save_ply(g.take(slice(0, 5)), run.point_cloud)
    assert equal(load_run(run).gaussians, g)
    damaged(run.point_cloud)
    assert equal(load_run(run).gaussians, g)
    assert len(caplog.messages) == 2
    assert all("point_cloud.ply: differs from state.safetensors (edited" in x for x in caplog.messages)


def test_a_run_holds_features_and_networks(run, caplog):  # noqa: F811
    """What a PLY has no room for comes from the checkpoint."""
    tensors, header = load_state(run.state)
    features, gain = torch.rand(len(tensors["parameter.means"]), 4), torch.rand(3)
    more = {"parameter.features": features, "affine.parameter.gain": gain, "affine.adam.gain.exp_avg": gain / 2}
    save_state(run.state, tensors | more, header | {"networks": ["affine"]})
    loaded = load_run(run)
    assert torch.equal(loaded.gaussians.features, features)
    assert loaded.networks.keys() == {"affine"}
    assert {name: x.tolist() for name, x in loaded.networks["affine"].items()} == {"gain": gain.tolist()}
    assert not caplog.text
    save_state(run.state, tensors | {"parameter.features": features[1:]}, header)
    assert load_run(run).gaussians.features is None
    assert "parameter.features must be torch.float32 of shape" in caplog.text


def test_gaussians_alone_are_no_run(run, tmp_path, capsys):  # noqa: F811
    """What needs a run says what there is for a splat, of a file and of a trainer's folder."""
    folder = tmp_path / "model/point_cloud/iteration_30"
    folder.mkdir(parents=True)
    run.point_cloud.rename(folder / "point_cloud.ply")
    for path in (folder / "point_cloud.ply", tmp_path / "model"):
        for command in ("report", "eval"):
            assert cli.main([command, str(path)]) == 2
            assert capsys.readouterr().err == (
                f"drgs {command}: {path}: must be a run folder, holds Gaussians alone; drgs fisher {path} --train DATA "
                "-o OUT says what error to expect of these, drgs render --cameras DATA -o OUT their PSNR\n"
            )
    other = tmp_path / "views.json"
    other.write_text("[]")
    assert cli.main(["eval", str(other)]) == 2
    assert "Gaussians alone" not in capsys.readouterr().err
