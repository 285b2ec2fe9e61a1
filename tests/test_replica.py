"""Replica in the layout of Semantic-NeRF, on sequences a few pixels large that the tests write themselves."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from test_data import gradient, write_colmap, write_image
from test_semantics import refused, write_maps

from drgs.cameras import look_at
from drgs.data import load
from drgs.sfm.points import initial_points

WIDTH, HEIGHT = 32, 24
NUMBERS = (0, 1, 2, 10, 11)


def poses(count=12):
    """Camera-to-world."""
    angles = np.linspace(0, 1.5, count)
    return np.array([np.linalg.inv(look_at((2 * np.cos(a), 2 * np.sin(a), 1.0), (0, 0, 0.5))) for a in angles])


def write_sequence(folder, numbers=NUMBERS, lines=12, text=None):
    """Frames, among them 2 and 10, whose names sort the other way; depth 1.5 m; classes 40 and 93 over none."""
    folder.mkdir(parents=True, exist_ok=True)
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[8:16], labels[16:] = 40, 93
    for n in numbers:
        write_image(folder / "rgb" / f"rgb_{n}.png", gradient(WIDTH, HEIGHT))
        write_image(folder / "depth" / f"depth_{n}.png", np.full((HEIGHT, WIDTH), 1500, np.uint16))
        write_image(folder / "semantic_class" / f"semantic_class_{n}.png", labels)
        write_image(folder / "semantic_class" / f"vis_sem_class_{n}.png", gradient(WIDTH, HEIGHT))
    rows = "\n".join(" ".join(f"{x:.18e}" for x in pose.ravel()) for pose in poses(lines))
    (folder / "traj_w_c.txt").write_text(rows + "\n" if text is None else text)
    return labels


def test_a_sequence(tmp_path):
    """Poses by frame number, order by number, 90 degrees across, depth in millimeters, labels without gaps."""
    labels = write_sequence(tmp_path)
    (tmp_path / "info_semantic.json").write_text(
        json.dumps({"classes": [{"id": 93, "name": "wall"}, {"id": 7, "name": "book"}, {"id": 40, "name": "floor"}]})
    )
    data = load(tmp_path, test_every=5, test_offset=2)  # what Semantic-NeRF tests on
    assert data.format == "replica"
    assert [view.name for view in data.views] == ["rgb_00", "rgb_01", "rgb_02", "rgb_10", "rgb_11"]
    assert [view.name for view in data.split()[1]] == ["rgb_02"]
    for view, n in zip(data.views, NUMBERS, strict=True):
        assert view.image_path.name == f"rgb_{n}.png"
        assert view.depth_path.name == f"depth_{n}.png"
        np.testing.assert_allclose(view.camera.c2w, poses()[n], atol=1e-12)
        np.testing.assert_allclose(view.camera.K, [[16, 0, 16], [0, 16, 12], [0, 0, 1]])
    corners = data.views[0].camera.pixel_directions()[0, [0, -1]] @ data.views[0].camera.c2w[:3, :3]
    # The outer edges of the first and last pixel see 90 degrees apart.
    np.testing.assert_allclose(corners[:, 0] / corners[:, 2], [-1 + 1 / WIDTH, 1 - 1 / WIDTH])
    np.testing.assert_allclose(data.views[0].depth(), 1.5)
    assert data.semantics.classes.names == ("wall", "book", "floor")
    np.testing.assert_array_equal(data.views[3].labels(), np.select([labels == 93, labels == 40], [1, 3], 0))
    points, _, source = initial_points(data, max_points=200)
    assert "5 depth maps" in source
    # Points lie 1.5 m before the camera that they come from.
    z = np.array([(points - view.camera.c2w[:3, 3]) @ view.camera.c2w[:3, 2] for view in data.views])
    np.testing.assert_allclose(np.abs(z - 1.5).min(axis=0), 0, atol=0.05)


def test_lazily_and_without_names(tmp_path):
    """The first training image gives all sizes; classes are called by their numbers."""
    write_sequence(tmp_path)
    (tmp_path / "rgb" / "rgb_0.png").write_text("held out: not opened")
    data = load(tmp_path, lazy=True)
    assert {(view.camera.width, view.camera.height) for view in data.views} == {(WIDTH, HEIGHT)}
    assert data.semantics.classes.names == ("40", "93")
    assert data.views[1].checked().image().shape == (HEIGHT, WIDTH, 3)


def test_with_maps_of_a_teacher(tmp_path):
    """Feature 3DGS's folder beside it, by the images' names; and in its own layout, beside a COLMAP model."""
    write_sequence(tmp_path / "sequence")
    write_maps(tmp_path / "sequence", only=[f"rgb_{n}" for n in NUMBERS])
    data = load(tmp_path / "sequence")
    assert [view.teacher_path.name for view in data.views] == [f"rgb_{n}_fmap_CxHxW.pt" for n in NUMBERS]
    write_colmap(tmp_path / "feature3dgs")
    write_maps(tmp_path / "feature3dgs", channels=512)
    write_image(tmp_path / "feature3dgs" / "rgb_feature_langseg" / "im0.png_feature_vis.png", gradient())
    torch.save({"pca": torch.zeros(3)}, tmp_path / "feature3dgs" / "rgb_feature_langseg" / "pca_dict.pt")
    found = load(tmp_path / "feature3dgs").semantics
    assert (found.channels, found.map_size, found.classes) == (512, (4, 3), None)


def test_rounded_poses_are_repaired(tmp_path):
    """Four digits are a rotation still."""
    text = "\n".join(" ".join(f"{x:.4f}" for x in pose.ravel()) for pose in poses())
    write_sequence(tmp_path, text=text)
    np.testing.assert_allclose(load(tmp_path).views[0].camera.c2w, poses()[0], atol=2e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "16 numbers a pose, got 0"),
        ("1 2 3", "16 numbers a pose, got 3"),
        ("1 0 0 x", "got other words"),
        (" ".join(["nan"] * 12 + ["0 0 0 1"]), "pose must be finite"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "pose 0"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1", "must end in 0 0 0 1, got 5 6 7 1"),
        ("\udcff\udcfe", "in UTF-8, got other bytes"),
    ],
)
def test_poses_that_are_wrong(text, words, tmp_path):
    """One line, which names the pose."""
    write_sequence(tmp_path, numbers=(0,), text="")
    (tmp_path / "traj_w_c.txt").write_bytes(text.encode(errors="surrogateescape"))
    refused(tmp_path, words)


def test_damaged_frames_are_named_and_left_out(tmp_path, caplog):
    """The others keep their poses, names and split; lazily none is looked at, and `strict` refuses."""
    write_sequence(tmp_path)
    whole = load(tmp_path, test_every=2)
    damaged = tmp_path / "rgb" / "rgb_2.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    left = load(tmp_path, test_every=2)
    assert f"1 of the 5 images that it lists are damaged ({damaged}); going on with the other 4" in caplog.text
    assert [view.name for view in left.views] == ["rgb_00", "rgb_01", "rgb_10", "rgb_11"]
    assert [view.name for view in left.absent] == ["rgb_02"]
    assert [view.name for view in left.split()[0]] == ["rgb_01", "rgb_10"]
    for one, other in zip(left.views, (view for view in whole.views if view.name != "rgb_02"), strict=True):
        np.testing.assert_array_equal(one.camera.w2c, other.camera.w2c)
        assert one.depth_path == other.depth_path
    assert len(load(tmp_path, lazy=True).views) == 5
    with pytest.raises(FileNotFoundError, match="1 of the 5 .* all must be there"):
        load(tmp_path, strict=True)


def test_folders_that_are_wrong(tmp_path):
    """No frames, a frame beyond the poses, two of one number, and the folder above sequences."""
    write_sequence(tmp_path / "room_0" / "Sequence_1", numbers=(0, 1, 2, 12))
    refused(tmp_path / "room_0", "name " + str(tmp_path / "room_0" / "Sequence_1"), kind=FileNotFoundError)
    sequence = tmp_path / "room_0" / "Sequence_1"
    refused(sequence, "frame 12 must have a pose")
    write_image(sequence / "rgb" / "rgb_012.png", gradient(WIDTH, HEIGHT))
    refused(sequence, "must be the only frame 12")
    for path in (sequence / "rgb").iterdir():
        path.rename(path.with_name(f"x{path.name}"))
    refused(sequence, "named rgb_0.png", kind=FileNotFoundError)
    (sequence / "rgb").rename(sequence / "color")
    refused(sequence, "in a folder `rgb`", kind=FileNotFoundError)
