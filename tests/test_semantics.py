"""Labels, teacher maps and classes of data sets: what is found, what numbers mean, what is refused, what is opened."""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch
from test_data import BARREL, HEIGHT, WIDTH, gradient, write_colmap, write_image, write_llff, write_transforms

from drgs.cameras import Camera, intrinsics
from drgs.data import View, load
from drgs.data.semantics import read_class_names

WRITERS = {"transforms": write_transforms, "llff": write_llff, "colmap": write_colmap}
NAMES = ("wall", "floor", "lamp")


def stems(folder):
    """Of the images."""
    return sorted(path.stem for path in (folder / "images").iterdir())


def write_maps(folder, channels=6, size=(4, 3), name="rgb_feature_langseg", only=None):
    """A map of random numbers for each image."""
    (folder / name).mkdir(exist_ok=True)
    generator = torch.Generator().manual_seed(0)
    for stem in stems(folder) if only is None else only:
        values = torch.randn(channels, size[1], size[0], generator=generator).half()
        torch.save(values, folder / name / f"{stem}_fmap_CxHxW.pt")


def label_image(number=2):
    """0, 1 and `number` in blocks."""
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[:, 8:16], image[:, 16:] = 1, number
    return image


def write_labels(folder, name="semantic_class", prefix="", image=None):
    """The same label image for each image."""
    for stem in stems(folder):
        write_image(folder / name / f"{prefix}{stem}.png", label_image() if image is None else image)


def write_classes(folder, names=NAMES, ids=None):
    """`classes.json`."""
    rows = [{"id": k, "name": name} for k, name in zip(ids or range(1, len(names) + 1), names, strict=True)]
    (folder / "classes.json").write_text(json.dumps({"unlabelled": 0, "classes": rows}))


def write_embeddings(folder, rows=3, channels=6):
    """`text_embeddings.npy`, not of length 1."""
    np.save(folder / "text_embeddings.npy", 5 * np.eye(rows, channels) + 0.5)


def refused(folder, words, call=load, kind=ValueError):
    """Loading gives one line with these words."""
    with pytest.raises(kind) as error:
        call(folder)
    text = str(error.value)
    assert "\n" not in text
    assert words in text


# ------------------------------------------------------------------------------------------ what is found


@pytest.mark.parametrize("kind", list(WRITERS))
@pytest.mark.parametrize("lazy", [False, True])
def test_every_format_finds_maps_labels_and_classes(kind, lazy, tmp_path):
    """Folders beside the images, by the images' names; labels count from 1, embeddings have length 1."""
    WRITERS[kind](tmp_path)
    write_maps(tmp_path)
    write_labels(tmp_path)
    write_classes(tmp_path)
    write_embeddings(tmp_path)
    data = load(tmp_path, lazy=lazy)
    found = data.semantics
    assert (found.teacher, found.labels) == ("rgb_feature_langseg", "semantic_class")
    assert (found.channels, found.map_size) == (6, (4, 3))
    assert found.classes.names == NAMES
    torch.testing.assert_close(found.classes.embeddings.norm(dim=1), torch.ones(3))
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.teacher = "other"
    view = data.views[0].checked()
    assert view.labels().dtype == np.int64
    np.testing.assert_array_equal(view.labels(), label_image())
    assert view.teacher().shape == (6, 3, 4)
    assert view.teacher().dtype == torch.float16
    assert load(tmp_path, semantics=False).semantics is None


def test_a_models_own_folder(tmp_path):
    """`sparse/0` is named itself: the maps lie beside the images."""
    write_colmap(tmp_path)
    write_maps(tmp_path, name="sam_embeddings")
    data = load(tmp_path / "sparse" / "0")
    assert data.semantics.teacher == "sam_embeddings"
    assert data.semantics.classes is None
    assert data.views[0].labels() is None


def test_data_sets_without_semantics(tmp_path):
    """None, and methods of views that say so; whatever else lies there is not opened."""
    write_transforms(tmp_path)
    (tmp_path / "classes.json").write_text("no JSON")
    (tmp_path / "text_embeddings.npy").write_text("no array")
    data = load(tmp_path)
    assert data.semantics is None
    assert data.views[0].labels() is None
    assert data.views[0].teacher() is None


def test_only_labels(tmp_path):
    """Labels without teacher or names: classes are called by their numbers, and nothing has channels."""
    write_transforms(tmp_path)
    write_labels(tmp_path, "labels", image=label_image(41))
    found = load(tmp_path).semantics
    assert (found.teacher, found.labels, found.channels, found.map_size) == ("", "labels", None, None)
    assert found.classes.names == ("1", "41")
    assert found.classes.embeddings is None
    assert set(np.unique(load(tmp_path).views[0].labels())) == {0, 1, 2}


def test_names_up_to_the_first_dot_and_subfolders(tmp_path):
    """`0.right.png` has `0_fmap_CxHxW.pt` as in Feature 3DGS, or its own stem's; subfolders have their own."""
    data = write_transforms(tmp_path)
    for k, name in enumerate(("0.right.png", "a/1.png", "b/1.png")):
        write_image(tmp_path / "images" / name, gradient())
        data["frames"][k]["file_path"] = f"images/{name}"
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    write_maps(tmp_path, only=["0"])
    for k, part in enumerate("ab"):
        folder = tmp_path / "rgb_feature_langseg" / part
        folder.mkdir()
        torch.save(torch.full((6, 3, 4), float(k)), folder / "1_fmap_CxHxW.pt")
    views = load(tmp_path).views
    assert [view.teacher_path.parent.name for view in views] == ["rgb_feature_langseg", "a", "b"]
    assert [float(view.teacher()[0, 0, 0]) for view in views[1:]] == [0.0, 1.0]
    for part in "ab":
        (tmp_path / "rgb_feature_langseg" / part / "1_fmap_CxHxW.pt").unlink()
    write_maps(tmp_path, only=["1"])
    refused(tmp_path, "must belong to one image")


def test_some_views_have_maps(tmp_path, caplog):
    """Views without a map have none, and a line names those that one would train with."""
    write_transforms(tmp_path, count=5)
    write_maps(tmp_path, only=["0", "1", "2", "4"])
    data = load(tmp_path, test_every=4)
    assert [view.teacher() is None for view in data.views] == [False, False, False, True, False]
    assert "1 of the 3 training views have no map (3)" in caplog.text
    caplog.clear()
    (tmp_path / "rgb_feature_langseg" / "0_fmap_CxHxW.pt").unlink()
    (tmp_path / "rgb_feature_langseg" / "4_fmap_CxHxW.pt").unlink()
    write_maps(tmp_path, only=["3"])
    load(tmp_path, test_every=4)  # 0 and 4 are held out
    assert not caplog.text


def test_maps_of_another_scene(tmp_path):
    """No name fits: refused, with a name that would."""
    write_transforms(tmp_path)
    write_maps(tmp_path, only=["x", "y"])
    refused(tmp_path, "(as 0_fmap_CxHxW.pt), found 2 of others (x_fmap_CxHxW.pt, ...)")
    assert load(tmp_path, semantics=False).views


def test_folders_without_files_that_fit(tmp_path, caplog):
    """A teacher's folder that is still empty, and labels that are something else: a line each, and no semantics."""
    write_transforms(tmp_path)
    (tmp_path / "rgb_feature_langseg").mkdir()
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "0.txt").write_text("0 0.5 0.5 0.1 0.1")  # boxes of a detector
    assert load(tmp_path).semantics is None
    assert "rgb_feature_langseg: has no file for any image (as 0_fmap_CxHxW.pt)" in caplog.text
    assert "labels: has no file for any image (as 0.png)" in caplog.text


# ------------------------------------------------------------------------------------------ when files are opened


def test_lazy_loads_open_nothing(tmp_path):
    """Maps, labels, names and embeddings that are garbage do not matter before they are used."""
    write_transforms(tmp_path)
    write_maps(tmp_path)
    write_labels(tmp_path)
    write_classes(tmp_path)
    for path in [*tmp_path.glob("*/*.pt"), *tmp_path.glob("semantic_class/*"), tmp_path / "classes.json"]:
        path.write_text("garbage")
    data = load(tmp_path, lazy=True)
    for use in (
        lambda: data.semantics.channels,
        lambda: data.semantics.classes,
        data.views[0].teacher,
        data.views[0].labels,
    ):
        with pytest.raises(ValueError, match="must (be|hold)"):
            use()
    with pytest.raises(ValueError, match="0_fmap_CxHxW.pt: must be"):
        load(tmp_path)


def test_headers_of_maps_are_compared_at_once(tmp_path):
    """One map of another width is named; of another size it is not an error (photos may stand upright)."""
    write_transforms(tmp_path)
    write_maps(tmp_path)
    write_maps(tmp_path, size=(3, 5), only=["1"])
    assert [tuple(view.teacher().shape) for view in load(tmp_path).views] == [(6, 3, 4), (6, 5, 3), (6, 3, 4)]
    write_maps(tmp_path, channels=7, only=["1"])
    refused(tmp_path, "1_fmap_CxHxW.pt: must have 6 channels as 0_fmap_CxHxW.pt, got 7")
    view = load(tmp_path, lazy=True).views[1]
    with pytest.raises(ValueError, match="must have 6 channels"):
        view.teacher()


def test_a_map_that_is_far_larger_than_its_photograph(tmp_path):
    """Named at once, or lazily when it is used; photographs may be reduced to an eighth while their maps stay."""
    write_transforms(tmp_path)
    write_maps(tmp_path)
    camera = load(tmp_path).views[1].camera
    write_maps(tmp_path, size=(8 * camera.width, 8 * camera.height), only=["1"])
    assert load(tmp_path).views[1].teacher().shape[1] == 8 * camera.height
    write_maps(tmp_path, size=(8 * camera.width + 1, 8 * camera.height), only=["1"])
    refused(tmp_path, "1_fmap_CxHxW.pt: must have at most 8 cells a pixel along each side of its photograph of")
    with pytest.raises(ValueError, match=rf"got {8 * camera.width + 1}x{8 * camera.height} cells"):
        load(tmp_path, lazy=True).views[1].teacher()


def test_nan_in_a_map_is_found_when_it_is_used(tmp_path):
    """Loading reads headers only; the view names file and place."""
    write_transforms(tmp_path)
    write_maps(tmp_path)
    values = torch.zeros(6, 3, 4)
    values[2, 1, 3] = float("nan")
    torch.save(values, tmp_path / "rgb_feature_langseg" / "1_fmap_CxHxW.pt")
    views = load(tmp_path).views
    views[0].teacher()
    with pytest.raises(ValueError, match=r"1_fmap_CxHxW.pt: must be finite, got nan at channel 2, row 1, column 3"):
        views[1].teacher()


# ------------------------------------------------------------------------------------------ numbers and names


def test_sparse_numbers_become_labels(tmp_path):
    """Replica's numbers have gaps; 0 and 255 are no label; what no file names is refused."""
    write_transforms(tmp_path)
    write_classes(tmp_path, ids=(93, 7, 40))
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[:, :4], image[:, 4:8], image[:, 8:12], image[:, 12:16] = 40, 93, 7, 255
    write_labels(tmp_path, "semantic", image=image)
    view = load(tmp_path).views[0]
    assert view.labels()[0, ::4].tolist() == [3, 1, 2, 0, 0, 0]
    image[:, 20:] = 41
    image[:, 22:] = 44
    write_labels(tmp_path, "semantic", image=image)
    with pytest.raises(ValueError, match=r"semantic/0.png: must hold classes of .*classes.json, .* got 41, 44; name"):
        view.labels()


def test_16_bits_and_classes_at_0_and_255(tmp_path):
    """0 and 255 are classes where a file says so, 65535 is none in 16 bits; `Unlabelled` is no class."""
    write_transforms(tmp_path)
    (tmp_path / "classes.txt").write_text("# of a car\n0 Sky\n\n255 Road  surface\n11 Unlabelled\n300 Car\n")
    image = np.zeros((HEIGHT, WIDTH), np.uint16)
    image[:, 4:8], image[:, 8:12], image[:, 12:16], image[:, 16:] = 255, 11, 300, 65535
    write_labels(tmp_path, image=image)
    data = load(tmp_path)
    assert data.semantics.classes.names == ("Sky", "Road surface", "Car")
    assert data.views[0].labels()[0, ::4].tolist() == [1, 2, 0, 3, 0, 0]


def test_a_mask_has_no_classes_until_they_are_named(tmp_path, caplog):
    """Black and white says nothing by itself: a line tells how to say it."""
    write_transforms(tmp_path)
    write_labels(tmp_path, "labels", image=np.where(label_image() > 1, 255, 0).astype(np.uint8))
    data = load(tmp_path)
    assert data.semantics.classes is None
    assert "classes.txt" in caplog.text
    assert not data.views[0].labels().any()
    (tmp_path / "classes.txt").write_text("0 background\n255 object\n")
    assert set(np.unique(load(tmp_path).views[0].labels())) == {1, 2}


def test_labels_of_other_sizes(tmp_path):
    """Half the size is enlarged by the nearest pixel, another shape refused, another size asked for is unmixed."""
    write_transforms(tmp_path)
    write_labels(tmp_path, image=label_image(200)[::2, ::2])
    view = load(tmp_path).views[0]
    np.testing.assert_array_equal(view.labels(), np.array([0, 1, 2])[np.arange(WIDTH) // 8][None].repeat(HEIGHT, 0))
    assert set(np.unique(view.labels(17, 11))) == {0, 1, 2}
    write_labels(tmp_path, image=label_image(200)[:, :20])
    with pytest.raises(ValueError, match="must have the shape of its image"):
        view.labels()


def test_images_that_are_no_labels(tmp_path):
    """Colors are refused, gray in three channels is not."""
    write_transforms(tmp_path)
    write_labels(tmp_path, image=gradient())
    data = load(tmp_path, lazy=True)
    with pytest.raises(ValueError, match="one channel of class numbers, got 3 or a palette"):
        data.views[0].labels()
    write_labels(tmp_path, image=label_image()[..., None].repeat(3, 2))
    assert set(np.unique(load(tmp_path).views[0].labels())) == {0, 1, 2}


def test_embeddings_that_do_not_fit(tmp_path):
    """Another number of rows than names, another width than the maps, or no numbers at all."""
    write_transforms(tmp_path)
    write_maps(tmp_path)
    write_classes(tmp_path)
    write_embeddings(tmp_path, rows=4)
    refused(tmp_path, "must have a row for each of the 3 classes")
    write_embeddings(tmp_path, channels=5)
    refused(tmp_path, "must have 5 channels as text_embeddings.npy, got 6")
    for rows, words in (
        (np.zeros((3, 6)), "row 0 is not"),
        (np.full((3, 6), np.nan), "row 0 is not"),
        (np.zeros(6), "shape (6,)"),
        (np.ones((3, 6), int), "int64"),
    ):
        np.save(tmp_path / "text_embeddings.npy", rows)
        refused(tmp_path, words)
    (tmp_path / "classes.json").unlink()
    write_embeddings(tmp_path, rows=4)
    assert load(tmp_path).semantics.classes.names == ("1", "2", "3", "4")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("classes.json", "[", "valid JSON"),
        ("classes.json", "7", "must be a list of classes"),
        ("classes.json", "[]", "names none"),
        ("classes.json", '[{"id": "1", "name": "wall"}]', "class 0: id must be"),
        ("classes.json", '[{"id": 1}]', "class 0: it must have the key 'name'"),
        ("classes.json", '[{"id": 1, "name": "a"}, {"id": 1, "name": "b"}]', "class 1: must have a number of its own"),
        ("classes.json", '[" "]', "class 0: must have a name"),
        ("classes.txt", "0 Sky\nRoad\n", "line 2 must be `NUMBER NAME`"),
        ("classes.txt", "0 Sky\n0 Road\n", "line 2: must have a number of its own"),
        ("classes.txt", "9999999999 Sky\n", "at most 9 digits"),
        ("classes.txt", "0 void\n", "names none"),
        ("classes.txt", "\n", "names none"),
        ("classes.txt", "\udcff\udcfe", "UTF-8"),
        ("classes.txt", "x" * (1 << 20) + "\n", "1 MiB"),
    ],
)
def test_class_files_that_are_wrong(name, text, words, tmp_path):
    """One line, which names the place."""
    (tmp_path / name).write_bytes(text.encode(errors="surrogateescape"))
    refused(tmp_path / name, words, read_class_names)


def test_class_files_of_names_alone(tmp_path):
    """The first is 1."""
    (tmp_path / "classes.txt").write_text("floor\ncoffee table\n")
    (tmp_path / "classes.json").write_text('["floor", "coffee table"]')
    for name in ("classes.txt", "classes.json"):
        assert read_class_names(tmp_path / name) == ({1: "floor", 2: "coffee table"}, set())


# ------------------------------------------------------------------------------------------ lenses


def test_maps_and_labels_of_a_lens(tmp_path):
    """A map whose channels are ray directions of its cells, undistorted, shows a pinhole's; labels stay unmixed."""
    size = width, height = 60, 40
    camera = Camera(intrinsics(100, 105, 58.5, 41.25), np.eye(4), 120, 80, "opencv", BARREL)
    rays = camera.resized(*size).pixel_directions()
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(torch.from_numpy(np.moveaxis(rays, 2, 0).copy()).half(), path)
    stored = np.repeat([3, 200, 255, 9], 30)[None].repeat(80, 0).astype(np.uint8)
    write_image(tmp_path / "a.png", stored)
    view = View(camera, "a", label_path=tmp_path / "a.png", teacher_path=path)
    found = view.teacher()
    assert found.dtype == torch.float16
    expected = camera.undistorted().resized(*size).pixel_directions()
    # A cell is 0.02 of a unit wide; half precision steps by 0.0005 near 1, and borders repeat their last cell.
    error = np.abs(np.moveaxis(found.numpy(), 0, 2) - expected)[3:-3, 3:-3]
    assert error.max() < 1.5e-3
    assert np.abs(rays - expected)[3:-3, 3:-3].max() > 1e-2  # the lens is worth it
    assert set(np.unique(view.labels())) == {0, 3, 9, 200}
    pincushion = dataclasses.replace(camera, distortion=(0.5, 0.0, 0.0, 0.0))
    assert View(pincushion, "a", label_path=tmp_path / "a.png").labels()[0, 0] == 0  # outside the photo


def test_the_features_room_stays_closed(tmp_path):
    """Loading what has no maps imports nothing of `drgs.features`, in a process of its own."""
    import subprocess

    write_transforms(tmp_path)
    write_labels(tmp_path)
    program = (
        "import sys, drgs.data; data = drgs.data.load(sys.argv[1]);"
        "assert data.semantics.labels; data.views[0].labels();"
        "print([m for m in sys.modules if m.startswith('drgs.features') or m == 'torch'])"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.real_data
def test_labels_of_real_captures(data_dir):
    """Statue: a mask of 9 % of the pixels. Street: 11 of 12 lines are classes, and its photographs have a lens."""
    statue = load(data_dir / "statue")
    assert statue.semantics.classes.names == ("1",)
    share = np.mean([(view.labels() == 1).mean() for view in statue.views])
    assert share == pytest.approx(0.0866, abs=1e-4)
    street = load(data_dir / "street" / "sparse_dev" / "0")
    assert len(street.semantics.classes) == 11
    assert "Unlabelled" not in street.semantics.classes.names
    view = street.views[0]
    assert view.camera.is_distorted
    labels = view.labels()
    assert labels.shape == (360, 480)
    assert (labels > 0).mean() > 0.9
