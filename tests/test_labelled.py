"""Data sets with a teacher made from labelled captures, on captures of a few pixels that the tests write."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_data import HEIGHT, WIDTH, poses, write_colmap, write_image, write_llff

from benchmarks import labelled
from drgs.data import load
from drgs.scenes import teacher


def write_captures(folder, count=6):
    """`statue` and `street` as they lie in the shared data."""
    (folder / "statue").mkdir(parents=True)
    write_llff(folder / "statue", count=count)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4:12, 6:16] = 1
    street = np.full((HEIGHT, WIDTH), 3, np.uint8)  # road, between them cars, unlabelled in the last rows
    street[:4], street[6:10, :12], street[14:] = 0, 8, 11
    write_colmap(folder / "street", count=count, model="SIMPLE_RADIAL", params=[20.0, 12.0, 8.0, -0.1])
    (folder / "street" / "sparse").rename(folder / "street" / "sparse_dev")
    names = [
        "Sky",
        "Building",
        "Pole",
        "Road",
        "Pavement",
        "Tree",
        "SignSymbol",
        "Fence",
        "Car",
        "Pedestrian",
        "Bicyclist",
        "Unlabelled",
    ]
    (folder / "street" / "classes.txt").write_text("".join(f"{k} {name}\n" for k, name in enumerate(names)))
    for k in range(count):
        write_image(folder / "statue" / "labels" / f"{k}.png", mask)
        write_image(folder / "street" / "labels" / f"im{k}.png", street)
    return mask, street


def test_statue(tmp_path):
    """Two thirds have maps of the teacher, the others are for testing and have labels only; cameras stay."""
    mask, _ = write_captures(tmp_path)
    out = labelled.generate("statue", tmp_path / "out", offset=1, teacher_size=(12, 8), data=tmp_path)
    data = load(out, test_every=2)
    train, test = data.split()
    assert [view.name for view in test] == ["1", "4"]
    assert [view.name for view in train] == ["0", "2", "3", "5"]
    assert all(view.teacher() is None for view in test)
    assert data.semantics.map_size == (12, 8)
    assert data.semantics.classes.names == ("background", "statue")
    for view, pose in zip(sorted(data.views, key=lambda view: view.name), poses(6), strict=True):
        np.testing.assert_allclose(view.camera.w2c, pose, atol=1e-9)
        np.testing.assert_array_equal(view.labels(), mask + 1)
        assert view.mask() is None
    vectors = np.load(out / "text_embeddings.npy")
    found = [teacher.read_labels(view.teacher().float().numpy(), vectors, (WIDTH, HEIGHT)) for view in train]
    right = np.mean([(labels == mask + 1).mean() for labels in found])
    # The noise model leaves 80 to 90 % right; at 12x8 cells, edges take more.
    assert 0.6 < right < 0.97
    counted = json.loads((out / "labelled.json").read_text())
    assert counted["teacher"]["pixel_accuracy"] == pytest.approx(right)
    assert counted["pixels"]["statue"] == pytest.approx(mask.mean())
    assert counted["points"] == 0


def test_street(tmp_path):
    """Points and lens come along, unlabelled pixels are 0, what moves is counted and masked where that is asked for."""
    _, street = write_captures(tmp_path)
    out = labelled.generate("street", tmp_path / "out", mask_moving=True, data=tmp_path)
    data = load(out)
    assert len(data.points) == 5
    assert [view.name for view in data.split()[1]] == ["im0", "im3"]
    view = data.views[1]
    assert view.camera.model == "opencv"
    assert view.camera.distortion[0] == pytest.approx(-0.1)
    np.testing.assert_array_equal(np.unique(view.labels()), [0, 1, 4, 9])
    assert view.teacher().shape == (512, 4, 6)
    middle = view.mask()[8]
    assert middle[2] == 0
    assert middle[20] == 1
    counted = json.loads((out / "labelled.json").read_text())
    assert counted["moving"] == pytest.approx((street == 8).sum() / (street < 11).sum())
    assert counted["unlabelled"] == pytest.approx((street == 11).mean())
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    labelled.generate("street", out, mask_moving=True, data=tmp_path)
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*")}


def test_what_is_refused(tmp_path):
    """A split that is none, a mask of nothing, a capture that is not there, a folder of somebody else's."""
    write_captures(tmp_path)
    with pytest.raises(ValueError, match="offset must be 0 to 2, got 3"):
        labelled.generate("statue", tmp_path / "out", offset=3, data=tmp_path)
    with pytest.raises(ValueError, match="no class that moves"):
        labelled.generate("statue", tmp_path / "out", mask_moving=True, data=tmp_path)
    with pytest.raises(FileNotFoundError, match="must be a data set"):
        labelled.generate("statue", tmp_path / "out", data=tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="must be a new folder"):
        labelled.generate("statue", tmp_path / "statue", data=tmp_path)


def test_a_teacher_without_space_takes_classes_for_their_partners():
    """Where everything is a lawn, what is wrong is called a meadow, never a pond; about a tenth is."""
    names = ("lawn", "meadow", "pond")
    confusions = teacher.Confusions({"lawn": "meadow", "meadow": "pond", "pond": "lawn"}, (("lawn", "meadow"),))
    vectors = teacher.embeddings(names, 0, confusions)
    cosines = vectors @ vectors.T
    assert cosines[0, 1] > 0.72 > cosines[0, 2]  # 0.8 and 0.6 +- 0.03 in 512 dimensions
    labels = np.ones((60, 80), np.uint8)
    found = [
        teacher.read_labels(teacher.feature_map(labels, None, names, (80, 60), 0, k, confusions), vectors)
        for k in range(4)
    ]
    shares = [np.mean(np.array(found) == k) for k in (1, 2, 3)]
    # 10.8 % of a map are patches, each of some hundred cells: 4 maps have 7 to 15 %.
    assert 0.06 < shares[1] < 0.16
    assert shares[2] < 0.005
