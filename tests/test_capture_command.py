"""`drgs capture`: from photographs to a report, stopped in every step and resumed, within a budget, in two batches; and
what it says of bad input.

The photographs are of three textured walls that meet in a corner, small ones; features are found in them once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import shutil
import types
import urllib.error
import urllib.request

import json_page
import numpy as np
import pytest
import torch

import drgs.data
from drgs import cli
from drgs.capturing import budget, diagnosis
from drgs.capturing import capture as capture_object
from drgs.capturing import fit as capture_fit
from drgs.capturing.budget import FEWEST_STEPS, Pacer
from drgs.capturing.capture import Photographs
from drgs.capturing.record import CaptureRecord
from drgs.commands import values
from drgs.commands.capture import capture_photographs, run
from drgs.commands.options import Capture
from drgs.data import load
from drgs.data.dataset import HELD_OUT, write_held_out
from drgs.display.progress import Bar, duration
from drgs.files import Run, load_state
from drgs.fitting.config import FitConfig
from drgs.pages.sharing import npm
from drgs.sfm.findings import Finding
from drgs.train import SelectionConfig, Trainer, fit

pytest.importorskip("pycolmap")
cv2 = pytest.importorskip("cv2")

from test_sfm import add_bad_entries, corner_camera, corner_photo, corner_walls, write_photo  # noqa: E402
from test_share import write_viewer  # noqa: E402

STEPS = 40
CONFIG = FitConfig().replace(max_steps=STEPS, max_pixels=2000, max_gaussians=400, renderers=("fast",), skybox="off")


@pytest.fixture(scope="module", autouse=True)
def viewer(tmp_path_factory):
    """Pages to send take a stand-in for the viewer's code, which is nowhere to be fetched from."""
    folder = tmp_path_factory.mktemp("npm")
    write_viewer(folder / "there")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(npm, "cache_folder", lambda: folder / "there")
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """`first` with six photographs along an arc, `more` with the two that come after them."""
    folder = tmp_path_factory.mktemp("photographs")
    walls = corner_walls(np.random.default_rng(5))
    for index in range(8):
        part = folder / ("first" if index < 6 else "more")
        part.mkdir(exist_ok=True)
        write_photo(part / f"IMG_{index}.png", corner_photo(corner_camera(index), walls)[0])
    return folder


@contextlib.contextmanager
def stopped_at(label: str, done: int = 1):
    """Ctrl-C once a bar of this name has come so far; 0: where it begins."""
    enter, update = Bar.__enter__, Bar.update

    def refused(bar):
        if bar.label == label and not done:
            raise KeyboardInterrupt
        return enter(bar)

    def stopped(bar, now, total=None, other=None, text=None):
        update(bar, now, total, other, text)
        if bar.label == label and now >= max(done, 1):
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bar, "__enter__", refused)
        patch.setattr(Bar, "update", stopped)
        with pytest.raises(KeyboardInterrupt):
            yield


@contextlib.contextmanager
def stopped_at_step(step: int):
    """A process that is killed in the middle of the fit: nothing is saved on the way out."""
    original = Trainer.step

    def killed(self):
        if self.step_index == step:
            raise KeyboardInterrupt
        return original(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", killed)
        with pytest.raises(KeyboardInterrupt):
            yield


def steps_of(folder) -> list[str]:
    return [step.name for step in CaptureRecord.read(folder / "capture").batch.steps]


@pytest.fixture(scope="module")
def captured(photographs, tmp_path_factory):
    """A capture that was stopped in the middle of each of its steps."""
    folder = tmp_path_factory.mktemp("captured") / "run"
    options = {"output": folder, "quiet": True}
    first = Capture(paths=(photographs / "first",), **options)
    again = Capture(resume=True, **options)
    with stopped_at("sharpness"):
        capture_photographs(first, CONFIG)
    assert steps_of(folder) == []
    with stopped_at("features"):
        capture_photographs(again, CONFIG)
    assert steps_of(folder) == ["photos"]
    with stopped_at_step(STEPS // 2):
        capture_photographs(again, CONFIG)
    assert steps_of(folder) == ["photos", "poses"]
    with stopped_at("maps of the expected error"):
        capture_photographs(Capture(paths=(photographs / "first",), resume=True, **options), CONFIG)
    assert steps_of(folder) == ["photos", "poses", "fit"]
    capture_photographs(again, CONFIG)
    return folder


@pytest.fixture(scope="module")
def joined(captured, photographs, tmp_path_factory):
    """The same with two more photographs, stopped in each step, too; and its state before."""
    folder = tmp_path_factory.mktemp("joined") / "run"
    shutil.copytree(captured, folder, symlinks=True)
    options = {"output": folder, "quiet": True}
    with stopped_at("sharpness"):
        run(Capture(paths=(photographs / "more",), add=True, **options))
    again = Capture(resume=True, **options)
    with stopped_at("features"):
        run(again)
    before = load(folder / "capture/scene")
    with stopped_at("what poses say", 0):  # they have been joined, the record does not know yet
        run(again)
    assert steps_of(folder) == ["photos"]
    with stopped_at("Gaussians of the earlier fit", 0):  # the run has made room, and has nothing of its own yet
        run(again)
    assert steps_of(folder) == ["photos", "poses"]
    assert not (folder / "config.json").exists()
    assert (folder / "capture/before.safetensors").is_file()
    with stopped_at_step(5):
        run(again)
    with stopped_at("maps of the expected error"):
        run(again)
    run(again)
    return folder, before


def test_every_step_goes_on(captured, photographs, tmp_path):
    """Nothing is done twice or lost: the fit ends with the same bits as one that was never stopped."""
    assert steps_of(captured) == ["photos", "poses", "fit", "report", "share"]
    scene = load(captured / "capture/scene")
    assert [view.name for view in scene.views] == [f"IMG_{index}" for index in range(6)]
    fit(scene, tmp_path / "run", CONFIG, progress=False)
    (found, header), (wanted, _) = (load_state(Run(x).state) for x in (captured, tmp_path / "run"))
    assert header["step"] == STEPS
    assert found.keys() == wanted.keys()
    assert all(torch.equal(x, wanted[name]) for name, x in found.items())
    assert "IMG_0" in (captured / "report.html").read_text()
    record = json.loads((captured / "capture/capture.json").read_text())
    assert record["batches"][0]["inputs"][0][0] == str((photographs / "first/IMG_0.png").resolve())


def test_each_photograph_is_decoded_once(tmp_path, monkeypatch):
    """And the data set is loaded once, from the first look at the photographs to the page."""
    walls = corner_walls(np.random.default_rng(5))
    (tmp_path / "photos").mkdir()
    for index in range(3):
        write_photo(tmp_path / f"photos/IMG_{index}.png", corner_photo(corner_camera(index), walls)[0])
    decoded, loaded, read, load_data = [], [], cv2.imread, drgs.data.load

    def counted(path, *flags):
        decoded.append(os.path.basename(path))
        return read(path, *flags)

    def counted_load(path, **options):
        dataset = load_data(path, **options)
        loaded.append(dataset)
        return dataset

    monkeypatch.setattr(cv2, "imread", counted)
    monkeypatch.setattr(drgs.data, "load", counted_load)
    capture_photographs(Capture(paths=(tmp_path / "photos",), output=tmp_path / "run", quiet=True), CONFIG)
    assert steps_of(tmp_path / "run")[-1] == "share"
    assert sorted(name for name in decoded if name.startswith("IMG_")) == ["IMG_0.png", "IMG_1.png", "IMG_2.png"]
    assert len(loaded) == 1


def test_photographs_are_kept_while_there_is_room(tmp_path, monkeypatch):
    """The first ones, until their files change or they are given back; they cannot be written to."""
    paths = [tmp_path / f"{index}.png" for index in range(3)]
    for path in paths:
        cv2.imwrite(str(path), np.full((10, 10, 3), 7, np.uint8))
    monkeypatch.setattr(capture_object, "_KEPT_BYTES", 700)
    photographs = Photographs()
    first = [photographs.decode(path) for path in paths]
    again = [photographs.decode(path) for path in paths]
    assert [a is b for a, b in zip(first, again, strict=True)] == [True, True, False]
    with pytest.raises(ValueError, match="read-only"):
        first[0][0] = 1
    cv2.imwrite(str(paths[0]), np.full((12, 10, 3), 7, np.uint8))
    assert photographs.decode(paths[0]).shape == (12, 10, 3)
    photographs.forget()
    assert photographs.decode(paths[1]) is not first[1]
    with pytest.raises(FileNotFoundError, match="must be an image, found none"):
        photographs.decode(tmp_path / "none.png")


def cut_off(*_, **__):
    """A download that ends before its archive does."""
    return io.BytesIO(b"the beginning")


def no_network(*_, **__):
    raise urllib.error.URLError("no network")


@pytest.mark.parametrize(("answer", "reason"), [(no_network, "no network"), (cut_off, "must have the SHA-512")])
def test_the_page_to_send_may_be_out_of_reach(captured, tmp_path, monkeypatch, capsys, answer, reason):
    """Without the viewer's code the capture ends well, and says why there is no page; later there is one."""
    folder = tmp_path / "run"
    shutil.copytree(captured, folder, symlinks=True)
    record = CaptureRecord.read(folder / "capture")
    record.batch.steps.pop()
    record.write()
    (folder / "scene.html").unlink()

    there = npm.cache_folder
    monkeypatch.setattr(npm, "cache_folder", lambda: tmp_path / "none")
    monkeypatch.setattr(urllib.request, "urlopen", answer)
    run(Capture(output=folder, resume=True))
    told = capsys.readouterr().out
    assert "share: not written, " in told
    assert reason in told
    assert steps_of(folder) == ["photos", "poses", "fit", "report"]
    monkeypatch.setattr(npm, "cache_folder", there)
    run(Capture(output=folder, resume=True))
    assert (folder / "scene.html").is_file()
    assert steps_of(folder)[-1] == "share"


def test_what_is_told(captured, capsys):
    """A line for each step, what to do at the next shoot, and what to do now."""
    run(Capture(output=captured, resume=True))
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[:5]] == ["photos", "poses", "fit", "report", "share"]
    assert "6 of 6 photographs have a pose" in lines[1]
    assert "400 Gaussians after 40 steps, held-out PSNR" in lines[2]
    assert "at the next shoot: only 6 photographs have a pose; take thirty to eighty" in "\n".join(lines)
    assert "drgs capture --more -o" in lines[-1]


def test_next_photographs_come_with_the_advice_of_the_capture(captured, tmp_path, capsys):
    """--more repeats what the capture has advised, before its places; without a run it says which one is missing."""
    folder = shutil.copytree(captured, tmp_path / "run", symlinks=True)
    run(Capture(output=folder, more=True, k=1))
    lines = capsys.readouterr().out.splitlines()
    advice = CaptureRecord.read(folder / "capture").batch.advice()
    assert lines[: len(advice)] == advice
    assert "only 6 photographs have a pose" in advice[0]
    assert lines[len(advice) + 1].startswith("1. go where IMG_")
    for words in (["photos"], []):
        told = refused(["--more", *words, "-o", tmp_path / "none"], capsys)
        assert told.endswith(
            f"-o must be a run with --more, found none; make it first by drgs capture PHOTOS -o {tmp_path / 'none'}"
        )
    assert not (tmp_path / "none").exists()


def test_steps_that_follow_the_clock_are_told(captured, tmp_path, monkeypatch, capsys):
    """Once when their number first changes, and beside what was planned at the end."""
    monkeypatch.setattr(capture_fit, "plan_fit", lambda *_: budget.FitPlan(2000, 400, 10, 1.0))
    monkeypatch.setattr(capture_fit, "Pacer", lambda *_: lambda done, of: 9 if done < 5 else 8)
    paths = (captured / "capture/scene",)
    capture_photographs(Capture(paths=paths, output=tmp_path / "run", budget="60s"), CONFIG)
    out, err = capsys.readouterr()
    assert "Gaussians after 8 steps (10 were planned, the budget allowed 8), held-out PSNR" in out
    assert err.count("steps in place of") == 1
    assert "step 1: 9 steps in place of 10, as the time left allows" in err


@pytest.mark.slow
def test_further_photographs(joined, captured):
    """They join the world that was there; held-out views stay the same; the fit begins with the Gaussians that exist,
    and knows more afterwards.
    """
    folder, before = joined
    after = load(folder / "capture/scene")
    old = {view.name: view.camera.w2c for view in before.views}
    assert {view.name for view in after.views} == {*old, "IMG_6", "IMG_7"}
    for view in after.views:
        if view.name in old:
            np.testing.assert_allclose(view.camera.w2c, old[view.name], atol=1e-6)
    config = Run(folder).config()
    assert config["test"] == Run(captured).config()["test"] == ["IMG_0"]
    assert config["train"] == [f"IMG_{index}" for index in range(1, 8)]
    assert config["points"].startswith("400 Gaussians of an earlier fit")
    assert "It began with the Gaussians of another fit" in (folder / "report.html").read_text()
    first = json.loads((captured / "metrics.json").read_text())["mean"]["psnr"]
    second = json.loads((folder / "metrics.json").read_text())
    assert second["step"] == STEPS // 2
    assert second["mean"]["psnr"] > first - 0.3  # 20 steps later
    batches = CaptureRecord.read(folder / "capture").batches
    assert len(batches) == 2
    assert [step.name for step in batches[1].steps] == ["photos", "poses", "fit", "report", "share"]
    assert f"{first:.2f} dB before" in batches[1].steps[2].line
    assert not (folder / "capture/before.safetensors").exists()
    of_budgets = {"poses", "max_image_size", "fit", "max_gaussians", "max_steps", "after"}
    record = json.loads((folder / "capture/capture.json").read_text())
    absent = (*of_budgets, "capture", "kept", "cleared")
    json_page.check("capture.json", record, elsewhere=("config",), absent=absent)
    json_page.check("held_out.json", json.loads((folder / "capture/scene" / HELD_OUT).read_text()))


@pytest.mark.same_bits
def test_further_photographs_end_with_the_same_bits(joined, captured, tmp_path):
    """As a fit that was never stopped, from the checkpoint that the first photographs left."""
    folder, _ = joined
    assert CaptureRecord.read(folder / "capture").batch.plan["before"]["views"] == 5
    density = dataclasses.replace(CONFIG.density, max_gaussians=560)  # as 7 photographs to 5
    config = CONFIG.replace(max_steps=STEPS // 2, density=density)
    fit(load(folder / "capture/scene"), tmp_path / "run", config, progress=False, begin=Run(captured).state)
    found, wanted = (load_state(Run(x).state)[0] for x in (folder, tmp_path / "run"))
    assert all(torch.equal(x, wanted[name]) for name, x in found.items())


@pytest.mark.slow
def test_many_that_join_are_fitted_anew(captured, photographs, tmp_path, monkeypatch, capsys):
    """With all steps, from points, and a line says so; the checkpoint of before does not stay behind."""
    monkeypatch.setattr(capture_fit, "NEW_FIT_SHARE", 0.3)
    folder = tmp_path / "run"
    shutil.copytree(captured, folder, symlinks=True)
    run(Capture(output=folder, paths=(photographs / "more",), add=True))
    assert "fit: from the beginning, 2 photographs to fit to have joined 5" in capsys.readouterr().out
    config = Run(folder).config()
    assert "begin" not in config
    assert "COLMAP" in config["points"]
    assert json.loads((folder / "metrics.json").read_text())["step"] == STEPS
    assert config["fit"]["density"]["max_gaussians"] == 560
    assert config["test"] == ["IMG_0"]
    assert not (folder / "capture/before.safetensors").exists()


def test_new_places_get_points(captured, tmp_path):
    """Points of the data set that photographs which join show are added, as far as there is room."""
    scene = load(captured / "capture/scene")
    write = Run(captured).config()
    left = [view for view in scene.views if view.name in write["train"][:2]]
    # Two photographs, and Gaussians at points that are far from all others: the rest is open.
    near = np.argsort(np.linalg.norm(scene.points - scene.points[0], axis=1))[:50]
    few = load(captured / "capture/scene", test_every=0)
    few.views, few.points, few.colors = left, scene.points[near], scene.colors[near]
    fit(few, tmp_path / "few", CONFIG.replace(max_steps=2), progress=False)
    result = fit(
        scene, tmp_path / "run", CONFIG.replace(max_steps=2), progress=False, begin=tmp_path / "few/state.safetensors"
    )
    assert len(result.gaussians) > 100
    assert "points that new photographs show" in result.run.config()["points"]
    began = result.run.config()["begin"]
    assert began == str(tmp_path / "few/state.safetensors")
    fit(scene, tmp_path / "run", CONFIG.replace(max_steps=2), progress=False, resume=True)
    assert result.run.config()["begin"] == began


def test_fits_that_cannot_begin_so(captured, tmp_path):
    """A damaged checkpoint is refused, and a fit that chooses its views."""
    scene = load(captured / "capture/scene")
    (tmp_path / "bad").write_bytes(b"no checkpoint")
    with pytest.raises(ValueError, match="bad"):
        fit(scene, tmp_path / "run", CONFIG, progress=False, begin=tmp_path / "bad")
    chosen = CONFIG.replace(selection=SelectionConfig())
    with pytest.raises(ValueError, match="begin must be None where views are chosen on the way"):
        fit(scene, tmp_path / "run", chosen, progress=False, begin=Run(captured).state)


def test_held_out_views_are_named(captured, tmp_path):
    """By a file beside the data set, which says so until it is deleted; a bad one is refused in one line."""
    shutil.copytree(captured / "capture/scene", tmp_path / "scene", symlinks=True)
    write_held_out(tmp_path / "scene", ["IMG_2", "IMG_4"], "capture")
    train, test = load(tmp_path / "scene").split()
    assert [view.name for view in test] == ["IMG_2", "IMG_4"]
    assert len(train) == 4
    write_held_out(tmp_path / "scene", [], "capture")
    assert load(tmp_path / "scene").split()[1] == []
    write_held_out(tmp_path / "scene", ["IMG_9"], "capture")
    with pytest.raises(ValueError, match="test must name views of the data set, got 'IMG_9'"):
        load(tmp_path / "scene")
    (tmp_path / "scene" / HELD_OUT).write_text("{}")
    with pytest.raises(ValueError, match=HELD_OUT):
        load(tmp_path / "scene")


# ---------------------------------------------------------------------------------------------- bad input


def refused(line: list, capsys) -> str:
    """What the command says, in one line."""
    assert cli.main(["capture", *map(str, line)]) == 2
    err = capsys.readouterr().err.strip()
    assert err.count("\n") == 0, err
    return err


def test_bad_photographs(photographs, tmp_path, capsys):
    """One alone, one that is damaged, and those that have nothing in common."""
    first = photographs / "first"
    assert "must be at least 3 photographs, got 1" in refused([first / "IMG_0.png", "-o", tmp_path / "a"], capsys)
    (tmp_path / "damaged").mkdir()
    for index in range(2):
        shutil.copy(first / f"IMG_{index}.png", tmp_path / "damaged")
    whole = (first / "IMG_3.png").read_bytes()
    (tmp_path / "damaged/IMG_3.jpg").write_bytes(whole[: len(whole) // 3])
    assert "IMG_3.jpg" in refused([tmp_path / "damaged", "-o", tmp_path / "b", "--quiet"], capsys)
    assert "must be photographs or a video, found none" in refused([tmp_path / "no", "-o", tmp_path / "c"], capsys)
    assert "must be photographs" in refused(["-o", tmp_path / "d"], capsys)
    (tmp_path / "run").mkdir()
    for name in ("config.json", "log.jsonl"):
        (tmp_path / "run" / name).write_text("{}")
    assert "is a run; add photographs to it" in refused([tmp_path / "run", "-o", tmp_path / "f"], capsys)
    assert not (tmp_path / "f").exists()
    told = refused([first, "-o", tmp_path / "e", "--length", "IMG_0 IMG_1 1 m"], capsys)
    assert told.endswith("--length must have --more, which it is for, got 'IMG_0 IMG_1 1 m'; drop it")
    assert not (tmp_path / "e").exists()
    assert "--budget must be a time with its unit" in refused([first, "-o", tmp_path / "e", "--budget", "10"], capsys)


def test_one_that_is_bad_stops_nothing(photographs, tmp_path, caplog):
    """The user's own file is named; what ended before there were poses is begun anew by the same command."""
    photos = shutil.copytree(photographs / "first", tmp_path / "photos")
    wanted = add_bad_entries(photos, photos / "IMG_0.png")
    args = Capture(paths=(photos,), output=tmp_path / "run", quiet=True)
    with stopped_at("features"):
        capture_photographs(args, CONFIG)
    assert steps_of(tmp_path / "run") == ["photos"]
    linked = sorted(path.name for path in (tmp_path / "run/capture/photos").iterdir())
    assert linked == [f"IMG_{index}.png" for index in range(6)]
    told = "\n".join(caplog.messages)
    for name, text in wanted.items():
        assert any(
            line.startswith(f"left out: {photos}") and name in line and text in line for line in caplog.messages
        ), told
    assert str(tmp_path / "run") not in told
    with stopped_at("sharpness"):
        capture_photographs(dataclasses.replace(args, paths=(photographs / "first",)), CONFIG)
    assert steps_of(tmp_path / "run") == []


def test_photographs_without_overlap(tmp_path, capsys):
    """What connects none of them is said, and what would help."""
    (tmp_path / "noise").mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (60, 80, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"noise/{index}.png"), noise)
    text = refused([tmp_path / "noise", "-o", tmp_path / "run", "--quiet"], capsys)
    assert "could be connected; take more photos with smaller steps" in text
    assert steps_of(tmp_path / "run") == ["photos"]


def test_folders_of_others(captured, photographs, tmp_path, capsys):
    """A capture goes into a new folder or on with its own; into nobody else's."""
    first, more = photographs / "first", photographs / "more"
    three = sorted(first.iterdir())[:3]
    assert "holds a capture already; add --resume or --add" in refused([first, "-o", captured], capsys)
    assert "the photographs changed" in refused([*three, "-o", captured, "--resume"], capsys)
    assert "--seed was 0 and is 1" in refused(["-o", captured, "--resume", "--seed", 1], capsys)
    assert "--add must have a capture to add to" in refused([more, "-o", tmp_path / "new", "--add"], capsys)
    assert "not in the capture yet, got none" in refused([first, "-o", captured, "--add"], capsys)
    assert "it holds a capture; add --resume to go on with it" in refused(["-o", captured], capsys)
    assert "--resume must have a capture to go on with" in refused(["-o", tmp_path / "none", "--resume"], capsys)
    assert "must be a new folder, or that of a capture" in refused(
        [first, "-o", _fit_alone(captured, tmp_path)], capsys
    )
    (tmp_path / "own/capture/photos").mkdir(parents=True)
    (tmp_path / "own/capture/photos/holiday.txt").write_text("mine")
    assert "must not be replaced" in refused([first, "-o", tmp_path / "own"], capsys)
    assert (tmp_path / "own/capture/photos/holiday.txt").read_text() == "mine"
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut/capture").mkdir()
    (tmp_path / "cut/capture/capture.json").write_text('{"schema": 1, "batches": []}')
    assert "batches must be one or more" in refused([first, "-o", tmp_path / "cut", "--resume"], capsys)


def _fit_alone(captured, tmp_path):
    """A run that `drgs fit` could have made."""
    shutil.copytree(captured, tmp_path / "fit", symlinks=True, ignore=shutil.ignore_patterns("capture"))
    return tmp_path / "fit"


def test_photographs_that_join_nothing(captured, tmp_path, capsys):
    """They change nothing, and others can be added afterwards."""
    folder = tmp_path / "run"
    shutil.copytree(captured, folder, symlinks=True)
    (tmp_path / "noise").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise/elsewhere.png"), noise)
    state = (folder / "state.safetensors").read_bytes()
    text = refused([tmp_path / "noise", "-o", folder, "--add", "--quiet"], capsys)
    assert "none of 1 could be connected" in text
    assert (folder / "state.safetensors").read_bytes() == state
    cv2.imwrite(str(tmp_path / "noise/other.png"), noise[::-1])
    os.remove(tmp_path / "noise/elsewhere.png")
    assert "none of 1 could be connected" in refused([tmp_path / "noise", "-o", folder, "--add", "--quiet"], capsys)
    assert len(CaptureRecord.read(folder / "capture").batches) == 2


# ---------------------------------------------------------------------------------------- held-out views


def test_a_view_that_nothing_else_shows(rng):
    """It is told with what it does to the mean, also of two held-out views; of none where all are alike or near."""
    near = [types.SimpleNamespace(name=f"{i}", camera=corner_camera(i)) for i in range(9)]
    turned = corner_camera(4)
    turned = dataclasses.replace(turned, w2c=np.diag([-1.0, 1.0, -1.0, 1.0]) @ turned.w2c)
    views = [*near, types.SimpleNamespace(name="away", camera=turned)]
    dataset = types.SimpleNamespace(views=views, times=())
    train = [f"{i}" for i in range(9) if i != 4]
    (found,) = diagnosis.of_views(dataset, train, {"4": 28.0, "away": 8.0})
    assert "view away has 8.0 dB, the others 28.0, and their mean is 18.0 dB, without it 28.0: the nea" in found.text
    assert "looks from elsewhere, maybe nothing else shows what it does" in found.text
    assert found.advice == "take two or three photographs around where away was taken"
    (found,) = diagnosis.of_views(dataset, train, {"away": 8.0})
    assert found.text.startswith("held-out view away has 8.0 dB, and is the only one: the nearest photograph")
    assert diagnosis.of_views(dataset, train, {"4": 8.0}) == []
    assert diagnosis.of_views(dataset, train, {"4": 28.0, "away": 26.0}) == []
    metrics = {"split": "test", "views": [{"name": "away", "psnr": 8.0}, {"name": "4", "psnr": None}]}
    assert diagnosis.of_held_out(dataset, train, metrics) == diagnosis.of_views(dataset, train, {"away": 8.0})
    assert diagnosis.of_held_out(dataset, train, {**metrics, "split": "train"}) == []
    (found,) = diagnosis.of_views(dataset, [name for name in train if name != "6"], {"4": 20.0, "6": 28.0})
    assert found.advice.startswith("look at it in the report")


def test_a_fit_tells_of_such_a_view(captured, tmp_path, monkeypatch, capsys):
    """As a capture does."""
    asked = []
    found = [Finding("view", "held-out view away has 8.0 dB", "take two")]
    monkeypatch.setattr("drgs.commands.fit.of_held_out", lambda *args: asked.append(args) or found)
    options = "--max-steps 2 --max-pixels 2000 --max-gaussians 100 --for fast --skybox off --no-report"
    assert cli.main(["fit", str(captured / "capture/scene"), "-o", str(tmp_path / "run"), *options.split()]) == 0
    assert "\nnote: held-out view away has 8.0 dB; take two\nnext: drgs view" in capsys.readouterr().out
    ((_, train, metrics),) = asked
    assert train == [f"IMG_{index}" for index in range(1, 6)]
    assert metrics["split"] == "test"


# ------------------------------------------------------------------------------------------------- budget


class MadeStopwatch(budget.Stopwatch):
    """A machine of a given speed, whose clock moves by what is timed on it."""

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def seconds(self, pixels: int, gaussians: int) -> float:
        return (0.01 + 1e-6 * pixels + 1e-6 * gaussians) / self.speed

    def step(self, train, dataset, config, is_first):
        each = self.seconds(config.data.max_pixels, config.density.max_gaussians)
        self.time += 12 * each
        return each


def large_views() -> types.SimpleNamespace:
    """What a plan has to know of a data set of photographs of 12 megapixels."""
    view = types.SimpleNamespace(camera=types.SimpleNamespace(width=4000, height=3000))
    return types.SimpleNamespace(split=lambda *rule: ([view] * 35, [view] * 5))


@pytest.mark.parametrize("speed", [0.2, 1.0, 10.0])
def test_a_plan_fits_its_budget(speed):
    """As many steps as there is time for, with larger photographs and more Gaussians where there is more."""
    sizes = []
    for left in (60, 300, 1200, 7200):
        watch = MadeStopwatch(speed)
        found = budget.plan_fit(large_views(), FitConfig(), left, stopwatch=watch)
        each = watch.seconds(found.max_pixels, found.max_gaussians)
        assert found.seconds == pytest.approx(found.max_steps * each)
        used = watch.time + found.seconds + found.after
        assert used <= left or found.max_steps == 100
        sizes.append((found.max_pixels, found.max_gaussians, found.max_steps))
        # Planned for nearly all of it, unless it is of the largest size.
        assert used > 0.5 * left or found.max_pixels == 430_000
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


def test_a_plan_leaves_gaussians_where_they_are():
    """Of a fit that goes on there are at least as many as before."""
    found = budget.plan_fit(large_views(), FitConfig(), 60, least=50_000, stopwatch=MadeStopwatch(1.0))
    assert found.max_gaussians == 50_000


@pytest.mark.parametrize("slower", [0.1, 0.3, 0.5, 1.0, 2.0, 4.0])
def test_a_fit_keeps_to_its_budget(slower):
    """Its number of steps follows the clock: on a machine that is 4 times as slow as planned, too, and where steps take
    three times as long as at the start once all Gaussians are there.
    """
    now, planned, end = 0.0, 1000, 1000.0
    pacer = Pacer(end, planned, lambda: now)
    done, total = 0, planned
    while done < total:
        now += slower * 0.5 * (0.5 + min(1.0, done / total / 0.5))
        done += 1
        total = pacer(done, total)
    assert now < 1.02 * end
    assert now > 0.9 * end or (slower < 0.5 and total == 4 * planned)


def test_a_budget_that_is_not_enough(photographs):
    """The plan says what it takes instead, and a fit that begins too late has its fewest steps, not one."""
    poses = budget.PosePlan(480, 240.0)
    assert budget.planned_poses(poses, 292, 50.0, 60.0) == (
        "60 s are not enough and are exceeded: poses of 292 photographs take about 4 min even at 480 pixels, and "
        "the smallest fit follows; --budget 10min leaves time for a fit, fewer photographs take less"
    )
    enough = budget.planned_poses(poses, 292, 590.0, 600.0)
    assert enough.startswith(
        "plan for 10 min: 292 photographs at 480 pixels for poses, about 4 min; then a fit as large"
    )
    late = budget.plan_fit(large_views(), FitConfig(), -239.0, stopwatch=MadeStopwatch(1.0))
    assert late.max_steps == FEWEST_STEPS
    told = late.line(-239.0, 299.0)
    assert told.startswith(
        "the budget is used up: the smallest fit has 100 steps at 12000 pixels with up to 8000 Gauss"
    )
    assert told.endswith(f"about {duration(299.0 + late.seconds + late.after)} in all")
    assert late.line(5.0, 55.0).startswith("only 5 s of the budget are left: the smallest fit has 100 steps")
    assert (
        budget.FitPlan(12_000, 8_000, 600, 30.0, 9.0)
        .line(45.0, 15.0)
        .startswith("plan for the 45 s left: 600 steps at")
    )
    now, done, total = 0.0, 0, late.max_steps
    pacer = Pacer(-239.0, late.max_steps, lambda: now)
    while done < total:
        now, done = now + 0.1, done + 1
        total = pacer(done, total)
    assert done == FEWEST_STEPS


def test_poses_are_planned(photographs):
    """Smaller photographs in less time, and more time for more of them."""
    few = budget._pose_seconds(10, 1.0, 0.1, 1.0)
    assert budget._pose_seconds(50, 1.0, 0.1, 1.0) > 5 * few
    assert budget._pose_seconds(10, 1.0, 0.1, 0.5) < few
    names = [f"IMG_{index}.png" for index in range(6)]
    found = budget.plan_poses(photographs / "first", names, 1e6)
    assert found.max_image_size == 320  # the photographs' own


def test_frames_are_planned(tmp_path):
    """As many as there is time for, at least twenty, at most what is asked for."""
    video = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 10, (96, 64))
    image = np.random.default_rng(0).integers(0, 255, (64, 300, 3), np.uint8)
    for index in range(30):
        writer.write(np.ascontiguousarray(image[:, index : index + 96]))
    writer.release()
    assert budget.plan_frames(video, 0, 150, 1e7) == 150
    assert budget.plan_frames(video, 0, 150, 1e-3) == 20
    assert budget.plan_frames(video, 0, 8, 1e-3) == 8


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10min", 600), ("1.5h", 5400), (" 2 m ", 120)])
def test_budgets(text, seconds):
    assert values.seconds_of_budget(text) == seconds


@pytest.mark.parametrize("text", ["10", "ten minutes", "5s", "-3min", "1e9h", ""])
def test_bad_budgets(text):
    with pytest.raises(ValueError, match="--budget must be"):
        values.seconds_of_budget(text)
