"""Claims of photographs that are cut out, by masks or an alpha channel: what is outside, and what is behind."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_active import SIZE, write_still
from test_data import write_image

from drgs import cli
from drgs.cameras import orbit
from drgs.commands.command_line import parsed_options
from drgs.commands.options import Fit
from drgs.data import Dataset, View, load
from drgs.data.images import read_image
from drgs.data.view_checks import default_background
from drgs.fitting.frames import load_frames


@pytest.mark.parametrize("kind", ["mask", "alpha"])
def test_masks_of_some_photographs_say_nothing_of_the_outside(tmp_path, caplog, kind):
    """The others show what is there: 3 of 9 photographs with masks, or cut out by an alpha channel, are taken as
    `valid`, which a line says with their number; `--mask object` holds where it is said, with a warning. With masks of
    all of them nothing is outside.
    """
    folder = tmp_path / "data"
    write_still(folder)
    whole = load_frames(load(folder).views, SIZE * SIZE)
    assert all(frame.is_object for frame in whole)
    described = json.loads((folder / "transforms.json").read_text())
    for index, view in enumerate(described["frames"]):
        if kind == "alpha" or index % 3:
            del view["mask_path"]
        if kind == "alpha" and index % 3 == 0:
            rgb, mask = (read_image(folder / f"{part}/{index}.png") for part in ("images", "masks"))
            write_image(folder / f"images/{index}.png", np.dstack([rgb, mask]))
    (folder / "transforms.json").write_text(json.dumps(described))
    frames = load_frames(load(folder).views, SIZE * SIZE)
    assert [frame.mask is not None for frame in frames] == [True, False, False] * 3
    assert all(frame.empty() is None for frame in frames)
    assert torch.equal(frames[3].mask, whole[3].mask)
    for mask, said in (
        ("auto", "it is taken as unknown (--mask valid)"),
        ("object", "--mask object says nevertheless"),
    ):
        words = ["fit", str(folder), "-o", str(tmp_path / mask), "--max-steps", "1", "--no-report", "--mask", mask]
        assert cli.main([*words, "--for", "fast", "--test-every", "0"]) == 0
        out = caplog.text
        caplog.clear()
        assert "3 of 9 training photographs have a mask or an alpha channel" in out
        assert said in out


def discs(folder, ground):
    """A data set of Blender's layout: three RGBA photographs of discs that are shaded darker at their rims, whose
    half-transparent pixels are mixed with a ground, or with nothing where it is None.
    """
    generator = np.random.default_rng(0)
    views = []
    y, x = np.mgrid[:96, :96] + 0.5
    for index, camera in enumerate(orbit((0, 0, 0), 3.0, 3, width=96, height=96)):
        image = np.zeros((96, 96, 4))
        for row, column in ((24, 24), (24, 72), (72, 24), (72, 72)):
            distance = np.hypot(y - row - generator.uniform(-1, 1), x - column)
            alpha = np.clip((18 - distance) / 2, 0, 1)  # two pixels wide
            shaded = generator.uniform(0.2, 0.8, 3) * np.clip(1.2 - 0.3 * (distance / 18) ** 4, 0, 1)[..., None]
            mixed = shaded if ground is None else alpha[..., None] * shaded + (1 - alpha[..., None]) * ground
            image = np.where(alpha[..., None] > 0, np.dstack([mixed, alpha]), image)
        path = folder / f"{index}.png"
        write_image(path, (255 * image).round().astype(np.uint8))
        views.append(View(camera, f"{index}", image_path=path))
    return Dataset(folder, "transforms", views)


def test_edges_say_what_photographs_were_cut_out_of(tmp_path):
    """Half-transparent pixels that are clearly mixed with black or white decide, before the layout; those of the
    object's own color and those mixed with gray leave it to the layout, also of a file that is named, and without alpha
    nothing is said.
    """
    grounds = {"own": (None, "white, as"), "gray": (0.5, "white, as")}
    grounds |= {"black": (0.0, "black, which half"), "white": (1.0, "white, which half")}
    for name, (ground, said) in grounds.items():
        (tmp_path / name).mkdir()
        data = discs(tmp_path / name, ground)
        color, reason = default_background(data)
        assert reason.startswith(said), name
        assert color == (float("white" in reason),) * 3
        assert default_background(data, lazy=True)[1].startswith("white, as")  # opens no photograph
        for file, said_of_file in (("transforms_train.json", "white, as"), ("transforms.json", "black")):
            named = dataclasses.replace(data, path=tmp_path / name / file)
            assert default_background(named, lazy=True)[1].startswith(said_of_file)
        (tmp_path / name / "transforms.json").touch()  # another layout
        assert default_background(data, lazy=True) == ((0.0, 0.0, 0.0), "black")
    write_still(tmp_path / "opaque")
    assert default_background(load(tmp_path / "opaque")) == ((0.0, 0.0, 0.0), "")


def test_a_fit_of_blenders_layout_is_on_white(tmp_path, caplog):
    """Which it says; --background wins; a run goes on with its own, whatever that was."""
    folder = tmp_path / "data"
    write_still(folder)
    described = json.loads((folder / "transforms.json").read_text())
    for index, view in enumerate(described["frames"]):
        del view["mask_path"], view["depth_file_path"]
        rgb, mask = (read_image(folder / f"{part}/{index}.png") for part in ("images", "masks"))
        write_image(folder / f"images/{index}.png", np.dstack([rgb, mask]))
    (folder / "transforms.json").unlink()
    (folder / "transforms_train.json").write_text(json.dumps(described))

    def background(run, *words):
        caplog.clear()
        words = ["fit", str(folder), "-o", str(tmp_path / run), "--no-report", "--for", "fast", *words]
        with caplog.at_level("INFO", "drgs"):
            assert cli.main(words) == 0
        return json.loads((tmp_path / run / "config.json").read_text())["fit"]["settings"]["background"]

    assert background("plain", "--max-steps", "1") == [1, 1, 1]
    assert "white, as readers of Blender's and D-NeRF's data sets take it (--background says another" in caplog.text
    assert "1 1 1 is behind them" in caplog.text
    assert background("told", "--max-steps", "1", "--background", "0", "0", "0") == [0, 0, 0]
    assert "as readers of Blender's and D-NeRF's data sets take it" not in caplog.text
    assert background("told", "--max-steps", "1", "--resume") == [0, 0, 0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("max_steps = 5", None),
        ("[settings]\nbackground = [0, 0, 0]", (0, 0, 0)),
    ],
)
def test_a_file_says_the_background_or_leaves_it_open(tmp_path, text, expected):
    """A file without settings leaves it to the photographs; black that is said is black."""
    (tmp_path / "fit.toml").write_text(text)
    args = parsed_options(Fit, ["scene", "-o", "run", "--config", str(tmp_path / "fit.toml")])
    assert args.background == expected
    assert args.fit.settings.background == (0, 0, 0)
