"""Splats that other programs trained: their checkpoints are read, and their frames found by the photographs."""

import dataclasses
import json
import logging

import numpy as np
import plyfile
import pytest
import torch
from splat_encoders import zipped
from test_active import write_still

from drgs import cli
from drgs.codecs import load_gaussians
from drgs.commands.frames import _moved, in_frame_of_data
from drgs.data import load
from drgs.ellipsoids import Gaussians
from drgs.files import save_ply

# a frame that nobody would guess: x -> 0.3 TURN x + SHIFT
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
SHIFT, SCALE = np.array([4.0, -7.0, 2.0]), 0.3


@pytest.fixture(autouse=True)
def info(caplog):
    """The log has lines of information, too."""
    caplog.set_level(logging.INFO, logger="drgs")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, nine photographs of blobs and points at them; the blobs."""
    folder = tmp_path_factory.mktemp("frames")
    blobs = write_still(folder / "data")
    points = np.empty(len(blobs), [(name, "f4") for name in "xyz"])
    for name, x in zip("xyz", blobs.means.T, strict=True):
        points[name] = x
    plyfile.PlyData([plyfile.PlyElement.describe(points, "vertex")]).write(str(folder / "data/points.ply"))
    poses = json.loads((folder / "data/transforms.json").read_text())
    (folder / "data/transforms.json").write_text(json.dumps(poses | {"ply_file_path": "points.ply"}))
    return folder / "data", blobs


def normalization(data):
    """(4, 4) by which simple_trainer of gsplat moves a world, from the description of its steps.

    The mean up of the cameras becomes -y, the median of the points on their axes nearest to 0 becomes the center and
    their median distance from it 1; then the principal axes of the points become x, y and z, and of two ways to stand
    the one in which z of most points is below its mean.
    """
    dataset = load(data)
    c2w = np.array([view.camera.c2w for view in dataset.views])
    up = -c2w[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    axis = np.cross(up, [0, -1, 0])
    sine, cosine = np.linalg.norm(axis), -up[1]
    x, y, z = axis / sine
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + sine * K + (1 - cosine) * K @ K
    places, forward = c2w[:, :3, 3] @ turn.T, c2w[:, :3, 2] @ turn.T
    nearest = places - np.einsum("ni,ni->n", places, forward)[:, None] * forward
    center = np.median(nearest, axis=0)
    scale = 1 / np.median(np.linalg.norm(places - center, axis=1))
    points = scale * (dataset.points @ turn.T - center)
    middle = np.median(points, axis=0)
    axes = np.linalg.svd(points - middle - (points - middle).mean(0))[2]
    axes[2] *= np.linalg.det(axes)
    if np.median((points - middle) @ axes[2]) > np.mean((points - middle) @ axes[2]):
        axes[1:] *= -1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * axes @ turn, -axes @ (scale * center + middle)
    return matrix


def places(g: Gaussians) -> torch.Tensor:
    """(N, 3) float32 means in the world, as checkpoints without an origin hold them."""
    return (g.means.double() + torch.from_numpy(g.origin)).float()


def parts_of(similarity):
    """Rotation, translation and scale of a (4, 4)."""
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    return similarity[:3, :3] / scale, similarity[:3, 3], scale


def save_simple_trainer(folder, g, ranks: int = 1):
    """Results of gsplat's simple_trainer, of the Gaussians shared among ranks."""
    (folder / "ckpts").mkdir(parents=True)
    for rank in range(ranks):
        part = g.take(slice(rank, None, ranks))
        splats = {"means": places(part), "scales": part.log_scales, "quats": part.quats}
        splats |= {"opacities": part.logit_opacities, "sh0": part.sh[:, :1], "shN": part.sh[:, 1:]}
        for step in (6999, 29999):
            torch.save({"step": step, "splats": splats}, folder / f"ckpts/ckpt_{step}_rank{rank}.pt")


def save_splatfacto(folder, g):
    """A run of nerfstudio's splatfacto, as far as it is read."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    values = {"means": places(g), "scales": g.log_scales, "quats": g.quats, "opacities": g.logit_opacities[:, None]}
    values |= {"features_dc": g.sh[:, 0], "features_rest": g.sh[:, 1:]}
    pipeline = {f"_model.gauss_params.{name}": x for name, x in values.items()} | {"_model.other": torch.zeros(1)}
    torch.save({"step": 9, "pipeline": pipeline, "optimizers": {}}, folder / "nerfstudio_models/step-000000009.ckpt")


def assert_alike(found, blobs):
    for name, x in blobs.parameters().items():
        y = found.parameters()[name]
        if name == "quats":
            x, y = (torch.nn.functional.normalize(q, dim=1) for q in (x, y))
            y = y * (x * y).sum(1, keepdim=True).sign()
        torch.testing.assert_close(y, x, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_checkpoint_of_gsplat_in_its_normalized_world(place, tmp_path, caplog, ranks):
    """The results folder names the last step, all ranks are read, and photographs show which frame it is in."""
    data, blobs = place
    save_simple_trainer(tmp_path / "results", _moved(blobs, *parts_of(normalization(data))), ranks)
    order = torch.cat([torch.arange(len(blobs))[rank::ranks] for rank in range(ranks)])
    found = in_frame_of_data(load_gaussians(tmp_path / "results"), tmp_path / "results", data)
    assert_alike(found, blobs.take(order))
    assert "by gsplat's normalization of its cameras and points" in caplog.text
    assert ("read with those of ranks 1 to 2" in caplog.text) == (ranks == 3)


def test_a_run_of_splatfacto(place, tmp_path, caplog):
    """What the run states of its frame is found from any of its folders."""
    data, blobs = place
    save_splatfacto(tmp_path / "run", _moved(blobs, TURN, SCALE * SHIFT, SCALE))
    stated = {"transform": np.c_[TURN, SHIFT].tolist(), "scale": SCALE}
    (tmp_path / "run/dataparser_transforms.json").write_text(json.dumps(stated))
    for name in ("run", "run/nerfstudio_models", "run/nerfstudio_models/step-000000009.ckpt"):
        caplog.clear()
        assert_alike(in_frame_of_data(load_gaussians(tmp_path / name), tmp_path / name, data), blobs)
        assert "dataparser_transforms.json" in caplog.text
        assert "dB at 3 photographs" in caplog.text


def test_a_model_of_inria_on_a_data_set_that_was_moved(place, tmp_path, caplog):
    """Its cameras.json has the photographs' names: their poses say where its world lies."""
    data, blobs = place
    cloud = tmp_path / "model/point_cloud/iteration_30000/point_cloud.ply"
    cloud.parent.mkdir(parents=True)
    save_ply(_moved(blobs, TURN, SHIFT, SCALE), cloud)
    cameras = []
    for i, view in enumerate(load(data).views):
        c2w = view.camera.c2w
        size = {
            "width": view.camera.width,
            "height": view.camera.height,
            "fx": view.camera.K[0, 0],
            "fy": view.camera.K[1, 1],
        }
        position, rotation = SCALE * TURN @ c2w[:3, 3] + SHIFT, TURN @ c2w[:3, :3]
        name = {"id": i, "img_name": view.name}
        cameras.append({**name, **size, "position": position.tolist(), "rotation": rotation.tolist()})
    (tmp_path / "model/cameras.json").write_text(json.dumps(cameras))
    for scene in (tmp_path / "model", cloud):
        assert_alike(in_frame_of_data(load_gaussians(scene), scene, data), blobs)
    assert "model/cameras.json" in caplog.text


def test_a_splat_that_fits_stays(place, tmp_path, caplog):
    """Bit for bit; and what is in a frame that nothing states is said not to show the photographs."""
    data, blobs = place
    save_ply(blobs, tmp_path / "own.ply")
    own = load_gaussians(tmp_path / "own.ply")
    assert in_frame_of_data(own, tmp_path / "own.ply", data) is own
    assert "own.ply: " in caplog.text
    assert "another" not in caplog.text
    moved = _moved(blobs, TURN, SHIFT, SCALE)
    assert in_frame_of_data(moved, tmp_path / "own.ply", data) is moved
    assert "whose mean color has" in caplog.text
    assert "put dataparser_transforms.json of its run beside it" in caplog.text


def test_the_command_says_how_well_it_fits(place, tmp_path, caplog):
    """`drgs fisher` of a checkpoint needs the data set alone."""
    data, blobs = place
    save_simple_trainer(tmp_path / "results", blobs)
    line = ["fisher", str(tmp_path / "results"), "--train", str(data), "--limit", "1", "--preset", "fast"]
    assert cli.main([*line, "--blocks", "geometry", "-o", str(tmp_path / "out")]) == 0
    assert "dB at 3 photographs of" in caplog.text


def test_a_page_of_a_splat_and_its_data_set(place, tmp_path, caplog, capsys):
    """`drgs share --train`: in the data set's frame, with the photographs' cameras and the errors that they show."""
    data, blobs = place
    save_simple_trainer(tmp_path / "results", _moved(blobs, *parts_of(normalization(data))))
    line = ["share", str(tmp_path / "results"), "--train", str(data), "-o", str(tmp_path / "page.html")]
    assert cli.main(line) == 0
    assert "by gsplat's normalization" in caplog.text
    assert "scale 0.00 MB" in capsys.readouterr().out
    assert "30 Gaussians, with 9 photographs." in (tmp_path / "page.html").read_text()
    assert cli.main([*line, "--no-uncertainty"]) == 0
    assert "scale" not in capsys.readouterr().out


def test_checkpoints_that_are_refused(place, tmp_path):
    """One line each: a pickle with more than tensors, a network's colors, other tensors, what ends early or lies."""
    _, blobs = place

    def refused(match, state=None, name="ckpt_1_rank0.pt", data=None):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        if data is None:
            torch.save(state, path)
        else:
            path.write_bytes(data)
        with pytest.raises(ValueError, match=match) as error:
            load_gaussians(path)
        assert str(error.value).count("\n") == 0

    splats = {"means": blobs.means, "scales": blobs.log_scales, "quats": blobs.quats}
    splats |= {"opacities": blobs.logit_opacities, "sh0": blobs.sh[:, :1], "shN": blobs.sh[:, 1:]}
    refused("must be a checkpoint of tensors alone, got", {"splats": splats, "camera": dataclasses.replace(blobs)})
    refused("colors must be SH, are of a network", {"splats": {"means": blobs.means, "colors": blobs.means}})
    refused("must be a checkpoint of gsplat's simple_trainer or of splatfacto, holds model", {"model": {}})
    refused(
        "must hold a tensor of floats 'quats', got none", {"splats": {k: x for k, x in splats.items() if k != "quats"}}
    )
    refused("means must be finite, got .* at index 0", {"splats": splats | {"means": blobs.means / 0}})
    refused(
        "SH must have 1, 4, 9 or 16 coefficients, got 3", {"splats": splats | {"shN": torch.zeros(len(blobs), 2, 3)}}
    )
    refused(
        "means must be what the file holds, .* are claimed",
        {"splats": splats | {"means": torch.zeros(1).expand(10**9, 3)}},
    )
    refused("must be a whole file", data=b"PK\x03\x04" + bytes(40))
    pickle = zipped({"archive/data.pkl": b"cos\nsystem\n(S'false'\ntR.", "archive/version": b"3"})
    refused("run `ns-export gaussian-splat --load-config", name="nerfstudio_models/step-1.ckpt", data=pickle)
