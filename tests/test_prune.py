"""Pruning: what is removed, what never is, `drgs prune` with its files, and bad input."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch
from scenes_random import gaussians
from test_active import write_still
from test_data import write_image

import drgs
from drgs import cli, fisher
from drgs.cameras import orbit
from drgs.codecs import load_gaussians
from drgs.data import load
from drgs.data.camera_lists import save_cameras_json
from drgs.deform import FieldConfig
from drgs.files import save_ply
from drgs.fitting.components.table import held_components
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_frames
from drgs.fitting.losses import psnr
from drgs.io.checkpoint import load_state, save_state
from drgs.pruning import fit_on, prune
from drgs.settings import RenderSettings

FAST = RenderSettings.preset("fast")


@pytest.fixture(scope="module")
def scene():
    """Eighty Gaussians and cameras around them."""
    rng = np.random.default_rng(4)
    g = gaussians(rng, 80, 1, scale=0.2, spread=0.7).detach()
    return g, orbit((0, 0, 0), 3.0, 4, width=24, height=20)


def _psnr(g, cameras, images):
    """Mean PSNR, as a caller would measure it."""
    return float(np.mean([psnr(x, image) for x, image in zip(_images(g, cameras), images, strict=True)]))


def _images(g, cameras):
    return [drgs.render(g, camera, FAST).rgb.clamp(0, 1) for camera in cameras]


def test_one_round_removes_the_least_errors(scene):
    """Exactly as many as asked, those of the smallest error, and tells which."""
    g, cameras = scene
    found = prune(g, cameras, FAST, keep=0.25, rounds=1)
    error = fisher.removal_error(g, cameras, FAST, power=1.5)
    assert found.unseen == 0
    assert int(found.kept.sum()) == 20
    assert float(error[found.kept].min()) >= float(error[~found.kept].max())
    assert torch.equal(found.gaussians.means, g.means[found.kept])
    (only,) = found.rounds
    assert only.removed == 60
    assert only.error == pytest.approx(float(error[~found.kept].sum()))


def test_rounds_see_what_stands_for_each_other():
    """Of two Gaussians in one place each alone can go, and not both: a second round sees that."""
    places = [[0, 0, 0], [0, 0, 0], [0.6, 0, 0], [-0.6, 0, 0], [0, 0, 0.6], [0, 0, -0.6]]
    opacities = [0.99, 0.99, 0.7, 0.8, 0.9, 0.95]
    g = drgs.Gaussians.from_arrays(places, [[1, 0, 0, 0]] * 6, [[0.1] * 3] * 6, opacities, [[[1.0] * 3]] * 6)
    cameras = orbit((0, 0, 0), 3.0, 4, width=24, height=20)
    once = prune(g, cameras, FAST, keep=4 / 6, rounds=1)
    twice = prune(g, cameras, FAST, keep=4 / 6, rounds=2)
    assert once.kept.tolist() == [False, False, True, True, True, True]
    assert sorted(twice.kept[:2].tolist()) == [False, True]
    assert twice.kept[2:].tolist() == [False, True, True, True]


def test_what_no_view_shows_is_kept_unless_asked(scene):
    """It has error 0, the least of all, and yet stays."""
    g, cameras = scene
    means = g.means.clone()
    means[:30] += 100.0
    g = g.replace(means=means)
    found = prune(g, cameras, FAST, keep=0.5)
    assert found.unseen == 30
    assert bool(found.kept[:30].all())
    assert int(found.kept.sum()) == 30 + 25
    removed = prune(g, cameras, FAST, keep=0.5, unseen="remove")
    assert not removed.kept[:30].any()
    assert torch.equal(removed.kept[30:], found.kept[30:])


def test_a_loss_is_kept_to(scene):
    """As many go as the loss allows: it is not exceeded, and one twice as large takes more."""
    g, cameras = scene
    images = [(x + 0.05).clamp(0, 1) for x in _images(g, cameras)]
    start = _psnr(g, cameras, images)
    counts = []
    for loss in (0.25, 1.0):
        found = prune(g, cameras, FAST, loss=loss, images=images)
        reached = _psnr(found.gaussians, cameras, images)
        assert found.psnr == pytest.approx(start, abs=1e-3)
        assert found.rounds[-1].psnr == pytest.approx(reached, abs=1e-3)
        assert start - loss <= reached
        counts.append(len(found.gaussians))
    assert counts[1] < counts[0] < len(g)


def test_a_loss_is_of_images_with_their_exposure(scene):
    """Renderings at the half brightness of the images, where that is asked for, have the PSNR and the loss of both at
    full brightness.
    """
    g, cameras = scene
    images = [x.clamp(0, 0.9) for x in _images(g.replace(sh=0.8 * g.sh), cameras)]
    half = [0.5 * x for x in images]
    darker = [lambda out: dataclasses.replace(out, rgb=0.5 * out.rgb.clamp(0, 1))] * len(cameras)
    bright, dark = (
        prune(g, cameras, FAST, loss=0.5, images=images),
        prune(g, cameras, FAST, loss=0.5, images=half, as_photographs=darker),
    )
    assert dark.psnr == pytest.approx(bright.psnr + 20 * math.log10(2), abs=1e-3)
    assert torch.equal(dark.kept, bright.kept)


def test_masked_pixels_decide_nothing(scene):
    """A view whose mask is 0 shows nothing."""
    g, cameras = scene
    masks = [None, *[torch.zeros(20, 24)] * 3]
    one = prune(g, cameras[:1], FAST, keep=0.5)
    assert torch.equal(prune(g, cameras, FAST, keep=0.5, masks=masks).kept, one.kept)


def test_fitting_on_repairs(tmp_path):
    """It ends nearer to the photographs, with as many Gaussians; features and an origin stay."""
    g = write_still(tmp_path)
    frames = load_frames(load(tmp_path).views, 10_000, mask="ignore")
    spoiled = g.replace(sh=g.sh - 0.5, features=torch.ones(len(g), 3))
    config = FitConfig(renderers=("fast",), settings=FAST)
    images, cameras = [frame.image() for frame in frames], [frame.camera for frame in frames]
    better = fit_on(spoiled, frames, config, 30)
    assert _psnr(better, cameras, images) > _psnr(spoiled, cameras, images) + 1
    assert len(better) == len(g)
    assert torch.equal(better.features, spoiled.features)
    assert better.sh.shape == g.sh.shape
    shift = np.array([1e6, -2e6, 3e6])
    moved = []
    for frame in frames:
        w2c = frame.camera.w2c.copy()
        w2c[:3, 3] -= w2c[:3, :3] @ shift
        moved.append(dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, w2c=w2c)))
    there = fit_on(spoiled.replace(origin=shift), moved, config, 30)
    assert np.array_equal(there.origin, shift)
    torch.testing.assert_close(there.means, better.means, rtol=1e-3, atol=1e-3)


def test_fitting_on_adds_no_noise(tmp_path, monkeypatch):
    """A run that was fitted with exploration noise is made better, not explored."""
    g = write_still(tmp_path)
    frames = load_frames(load(tmp_path).views, 10_000, mask="ignore")
    monkeypatch.setattr("drgs.fitting.trainer.explore", lambda *_: pytest.fail("noise is added"))
    config = FitConfig(renderers=("fast",), settings=FAST).replace(noise=5e5)
    assert len(fit_on(g, frames, config, 2)) == len(g)


def test_fitting_on_keeps_to_exposures(tmp_path):
    """Photographs at 0.6 of the light make the scene no darker if their gains say so."""
    g = write_still(tmp_path)
    frames = load_frames(load(tmp_path).views, 10_000, mask="ignore")
    images, cameras = [frame.image() for frame in frames], [frame.camera for frame in frames]
    dark = [dataclasses.replace(frame, pixels=(0.6 * frame.pixels).to(frame.pixels.dtype)) for frame in frames]
    gains = {"exposure": {"log_gains": torch.full((len(dark), 3), math.log(0.6))}}
    (held,) = held_components([frame.name for frame in dark], gains, RenderSettings())
    config = FitConfig(renderers=("fast",), settings=FAST)
    kept = fit_on(g, dark, config, 20, components=[held])
    assert _psnr(kept, cameras, images) > _psnr(fit_on(g, dark, config, 20), cameras, images) + 5
    assert not held.module.log_gains.requires_grad
    for damaged in ({}, {"log_gains": torch.zeros(2, 3)}):
        with pytest.raises(ValueError, match="log_gains must have shape"):
            held_components(["a"], {"exposure": damaged}, RenderSettings())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({}, "either keep or loss must say"),
        ({"keep": 0.5, "loss": 0.1}, "got both"),
        ({"keep": 0.0}, "keep must be a share above 0 and below 1, got 0"),
        ({"keep": 1.0}, "to remove nothing, leave the scene as it is"),
        ({"loss": 0.0}, "loss must be above 0 dB"),
        ({"loss": 0.1}, "loss must have images"),
        ({"keep": 0.5, "rounds": 0}, "rounds must be a whole number >= 1"),
        ({"keep": 0.5, "unseen": "hide"}, "unseen must be 'keep' or 'remove'"),
    ],
)
def test_refuses_what_cannot_be(scene, arguments, word):
    g, cameras = scene
    with pytest.raises(ValueError, match=word):
        prune(g, cameras, FAST, **arguments)


def test_views_that_show_nothing(scene):
    g, cameras = scene
    with pytest.raises(ValueError, match="the 4 given ones show nothing"):
        prune(g.replace(means=g.means + 100), cameras, FAST, keep=0.5)


# -------------------------------------------------- the command


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, a run `run` on it, `scene.ply` and `cameras.json`."""
    folder = tmp_path_factory.mktemp("prune")
    save_ply(write_still(folder / "data"), folder / "scene.ply")
    config = FitConfig().replace(max_steps=12, max_gaussians=200)
    drgs.fit(load(folder / "data"), folder / "run", config, progress=False)
    save_cameras_json(folder / "cameras.json", orbit((0, 0, 0), 3.0, 5, width=24, height=20))
    return folder


def test_command_on_a_run(place, monkeypatch, capsys):
    """Gaussians in the format of the suffix, what it cost beside them and on stdout; once more over its own files."""
    monkeypatch.chdir(place)
    line = ["prune", "run", "--keep", "0.5", "--refit", "3", "-o", "out/small.spz"]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    record = json.loads((place / "out/small.json").read_text())
    count = record["gaussians"]
    assert len(load_gaussians(place / "out/small.spz")) == count["after"] < count["before"]
    assert count["after"] - count["unseen"] == round(0.5 * (count["before"] - count["unseen"]))
    assert set(record["psnr"]) == {"exact", "fast", "inria", "gsplat", "3dgut"}
    assert set(record["psnr"]["fast"]) == {"before", "pruned", "refitted"}
    assert record["split"] == "test"
    assert len(record["rounds"]) == 5
    assert "held-out views" in said
    assert f"{count['after']:,} of {count['before']:,} Gaussians" in said
    assert cli.main([*line, "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_command_makes_a_run_of_a_run(place, monkeypatch):
    """With all that its checkpoint has of each Gaussian, e.g. by the 3D filter; it can be measured."""
    monkeypatch.chdir(place)
    config = FitConfig().replace(max_steps=4, max_gaussians=60, filter_3d="on")
    drgs.fit(load(place / "data"), place / "filtered", config, progress=False)
    assert cli.main(["prune", "filtered", "--keep", "0.5", "--quiet", "-o", "half/run"]) == 0
    whole, half = drgs.load_run("filtered").gaussians, drgs.load_run("half/run").gaussians
    rows = {tuple(mean.tolist()): row for row, mean in enumerate(whole.means)}
    left = whole.take([rows[tuple(mean.tolist())] for mean in half.means])
    assert 0 < len(half) < len(whole)
    assert all(torch.equal(x, half.parameters()[name]) for name, x in left.parameters().items())
    tensors, _ = load_state(place / "half/run/state.safetensors")
    assert len(tensors["filter_3d"]) == len(tensors["adam.means.exp_avg"]) == len(half)
    assert not (place / "half/run/metrics.json").exists()
    assert cli.main(["eval", "half/run", "--quiet"]) == 0


def test_command_on_a_file(place, monkeypatch, capsys):
    """By the photographs of a data set, to a loss; the file that it is of is never replaced."""
    monkeypatch.chdir(place)
    line = ["prune", "scene.ply", "--data", "data", "--loss", "20dB", "--quiet"]
    before = (place / "scene.ply").read_bytes()
    assert cli.main([*line, "-o", "lossy.ply"]) == 0
    record = json.loads((place / "lossy.json").read_text())
    assert record["train_psnr"] - record["rounds"][-1]["psnr"] <= 20
    assert record["gaussians"]["after"] < 30
    assert cli.main([*line, "-o", "scene.ply"]) == 2
    assert "it is an input" in capsys.readouterr().err
    (place / "mine.ply").write_bytes(b"mine")
    assert cli.main([*line, "-o", "mine.ply"]) == 2
    assert "must not be replaced" in capsys.readouterr().err
    assert ((place / "scene.ply").read_bytes(), (place / "mine.ply").read_bytes()) == (before, b"mine")


def test_command_by_cameras_alone(place, monkeypatch, capsys):
    """Errors need no photographs; what it costs is then not told, and that is said."""
    monkeypatch.chdir(place)
    assert cli.main(["prune", "scene.ply", "--data", "cameras.json", "--keep", "0.5", "-o", "half.ply"]) == 0
    assert "cameras.json has no photographs: what it costs is not measured" in capsys.readouterr().out
    assert len(load_gaussians(place / "half.ply")) == 15
    assert json.loads((place / "half.json").read_text())["psnr"] == {}


def test_command_with_exposures(place, monkeypatch, capsys):
    """A run whose photographs have exposures is fitted on with those, and with no photographs but its own."""
    monkeypatch.chdir(place)
    config = FitConfig().replace(max_steps=6, max_gaussians=100, exposure="learned")
    run = drgs.fit(load(place / "data"), place / "uneven", config, progress=False).run
    tensors, header = load_state(run.state)
    gains = tensors["exposure.parameter.log_gains"]
    gains.copy_(torch.linspace(-0.5, 0.5, len(gains))[:, None].expand_as(gains))
    save_state(run.state, tensors, header)
    line = ["prune", "uneven", "--keep", "0.5", "--refit", "3", "--quiet", "-o", "even.ply"]
    assert cli.main(line) == 0
    record = json.loads((place / "even.json").read_text())
    assert record["refit"] == 3
    loaded = drgs.load_run("uneven")
    frames = {frame.name: frame for frame in load_frames(load(place / "data").views, config.data.max_pixels)}
    names = loaded.record.train
    (held,) = held_components(list(names), loaded.networks, loaded.record.config.settings)
    found: dict[bool, list[float]] = {True: [], False: []}
    for name in names:
        frame = frames[name]
        out = drgs.render(loaded.gaussians, frame.camera, FAST)
        for has_gain, shown in ((True, held.as_photograph(out, frame)), (False, out)):
            found[has_gain].append(psnr(shown.rgb.clamp(0, 1), frame.image(), frame.mask))
    assert record["train_psnr"] == pytest.approx(np.mean(found[True]), abs=1e-3)
    assert abs(np.mean(found[True]) - np.mean(found[False])) > 0.1
    shutil.copytree(place / "data", place / "other")
    (place / "other/images/1.png").rename(place / "other/images/strange.png")
    views = place / "other/transforms.json"
    views.write_text(views.read_text().replace("images/1.png", "images/strange.png"))
    assert cli.main([*line, "--data", "other"]) == 2
    assert "photographs whose exposure uneven has found" in capsys.readouterr().err


@pytest.fixture(scope="module")
def moving(place):
    """A run on the photographs of `data` at three times, with a field that has learned something."""
    shutil.copytree(place / "data", place / "film")
    views = json.loads((place / "film/transforms.json").read_text())
    for number, frame in enumerate(views["frames"]):
        frame["time"] = number % 3 / 2
    (place / "film/transforms.json").write_text(json.dumps(views))
    small = FieldConfig(channels=4, resolution=6, time_resolution=3, levels=(1,), width=16)
    config = FitConfig(renderers=("fast",)).replace(max_steps=6, max_gaussians=40)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FieldConfig, "preset", classmethod(lambda cls, name, times=None: small))
        run = drgs.fit(load(place / "film"), place / "moving", config, progress=False).run
    tensors, header = load_state(run.state)
    tensors["parameter.motion"] = torch.where(torch.arange(len(tensors["parameter.motion"])) % 2 == 0, 2.0, -2.0)
    tensors["deformation.mlp.parameter.means.3.bias"] += 0.2
    save_state(run.state, tensors, header)
    return run


def test_command_on_what_moves(place, moving, monkeypatch, capsys):
    """A run folder with fewer Gaussians, which move as they did; never over another run, nor into a file."""
    monkeypatch.chdir(place)
    line = ["prune", "moving", "--keep", "0.5", "-o"]
    assert cli.main([*line, "few"]) == 0
    record = json.loads((place / "few/prune.json").read_text())
    assert "of 2 held-out views" in (said := capsys.readouterr().out)
    assert f"{record['gaussians']['after']} of {record['gaussians']['before']} Gaussians: few" in said
    whole, few = drgs.load_run("moving"), drgs.load_run("few")
    assert len(few.gaussians) == record["gaussians"]["after"] < len(whole.gaussians)
    rows = {tuple(mean.tolist()): row for row, mean in enumerate(whole.gaussians.means)}
    left = whole.moving.take(torch.tensor([rows[tuple(mean.tolist())] for mean in few.gaussians.means]))
    for time in (0.0, 0.7):
        moved = few.moving.at(time)
        assert not torch.equal(moved.means, few.gaussians.means)
        assert all(torch.equal(x, moved.parameters()[name]) for name, x in left.at(time).parameters().items())
    assert few.step == whole.step
    there = {x.name for x in place.iterdir()}
    for output, options, word in (
        ("few", (), "holds a run already; choose another"),
        ("few.ply", (), "what moves must stay a run"),
        ("fewer", ("--refit", "3"), "--refit must have a file of Gaussians"),
    ):
        assert cli.main([*line, output, "--quiet", *options]) == 2
        assert word in capsys.readouterr().err
    assert {x.name for x in place.iterdir()} == there


def test_command_by_views_that_show_nothing(place, monkeypatch, capsys):
    """Exit code 2, and what is wrong with the views."""
    monkeypatch.chdir(place)
    save_cameras_json(place / "away.json", orbit((100, 0, 0), 3.0, 5, width=24, height=20))
    assert cli.main(["prune", "scene.ply", "--data", "away.json", "--keep", "0.5", "-o", "no.ply", "--quiet"]) == 2
    assert "the 5 given ones show nothing; check that they are of this scene" in capsys.readouterr().err
    assert not (place / "no.ply").exists()


def test_command_by_photographs_whose_mask_keeps_nothing(place, monkeypatch, capsys, caplog):
    """They are left out, held out or not, and named; with these alone there is nothing to go by."""
    monkeypatch.chdir(place)
    shutil.copytree("data", "masked")
    for name in ("0", "1"):  # held out, and not
        write_image(place / f"masked/masks/{name}.png", np.zeros((24, 24), np.uint8))
    line = ["prune", "run", "--data", "masked", "--quiet", "-o", "masked.ply"]
    assert cli.main([*line, "--keep", "0.5"]) == 0
    record = json.loads((place / "masked.json").read_text())
    assert "1" not in record["views"]["names"]
    assert all(math.isfinite(x) for x in record["psnr"]["fast"].values())
    assert "prune: masks must keep at least one pixel, those of 1 of" in caplog.text
    for path in (place / "masked/masks").iterdir():
        write_image(path, np.zeros((24, 24), np.uint8))
    assert cli.main([*line, "--keep", "0.5"]) == 2
    assert "masked: must hold a training view whose mask keeps a pixel" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("scene.ply", "--keep", "0.5"), "--data must name a data set"),
        (("scene.ply", "--data", "data"), "either --keep or --loss must say"),
        (("scene.ply", "--data", "data", "--keep", "0"), "--keep must be a share above 0 and below 1, got 0"),
        (("scene.ply", "--data", "data", "--keep", "1"), "leave the scene as it is"),
        (("scene.ply", "--data", "data", "--loss", "much"), "--loss must be a number of decibels"),
        (("scene.ply", "--data", "cameras.json", "--loss", "1"), "--loss must have photographs"),
        (("scene.ply", "--data", "cameras.json", "--keep", "0.5", "--refit", "3"), "--refit must have photographs"),
        (("scene.ply", "--data", "data", "--loss", "1e-9"), "none of its 30 Gaussians can go"),
        (("run", "--keep", "0.5", "-o", "small.stl"), "must end with"),
        (("scene.ply", "--data", "nowhere", "--keep", "0.5"), "nowhere"),
    ],
)
def test_command_refuses_in_one_line(place, arguments, word, monkeypatch, capsys):
    """Exit code 2, one line, and nothing written."""
    monkeypatch.chdir(place)
    there = {x.name for x in place.iterdir()}
    output = () if "-o" in arguments else ("-o", "no.ply")
    assert cli.main(["prune", *arguments, *output, "--quiet"]) == 2
    told = capsys.readouterr().err
    assert word in told
    assert told.count("\n") == 1, told
    assert {x.name for x in place.iterdir()} == there
