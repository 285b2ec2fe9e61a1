"""Claims of drgs.viewing and `drgs view` that need no browser: cameras, Gaussians, pictures, sessions, files."""

from __future__ import annotations

import dataclasses
import functools
import gc
import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install 'drgs[view]'")

from test_select_command import place  # noqa: F401 (a data set, and a run that chose its views)
from test_semantic_fit import dataset, run, taught  # noqa: F401 (a run with features)
from viewing_client import Client, decoded, gaussians

import drgs
from drgs import cli, fisher, gain
from drgs.cameras import Camera, intrinsics, look_at, orbit
from drgs.commands.options import View
from drgs.commands.scene_input import SceneInput
from drgs.commands.view import subject_of, watched_files
from drgs.data import load
from drgs.data.camera_path import read_camera_path
from drgs.display.pictures import map_colors
from drgs.files import load_state, save_state
from drgs.fitting import errors
from drgs.fitting.errors import run_error_record
from drgs.io.run import Run
from drgs.viewing import panel
from drgs.viewing.client import ClientGaussians, Pose, camera_of, looking, pose_of
from drgs.viewing.installation import view_command
from drgs.viewing.layers import ExpectedError, Uncertainty, bands, layers_of, rendered_in_bands, stages, tinted
from drgs.viewing.placed_views import PlacedView, Ranking, Score, Sight, placed_views_of, read_ranking, score_colors
from drgs.viewing.server import Viewer
from drgs.viewing.session import Session
from drgs.viewing.subject import FirstView, Subject
from drgs.viewing.worker import Worker

FAST = drgs.RenderSettings.preset("fast")


def blobs(means, **fields) -> drgs.Gaussians:
    n = len(means)
    given = {"quats": torch.eye(4)[[0] * n], "scales": torch.full((n, 3), 0.1), "opacities": torch.full((n,), 0.9)}
    given |= {"sh": torch.full((n, 1, 3), 1.5)} | fields
    return drgs.Gaussians.from_arrays(torch.as_tensor(means), **given)


def subject(means, **fields) -> Subject:
    """Looked at from z = -3; up is -y."""
    g = fields.pop("scene", None) or blobs(means)
    camera = Camera(
        K=intrinsics(150, 150, 80, 60), w2c=look_at((0, 0, -3), (0, 0, 0), (0, -1, 0)), width=160, height=120
    )
    given = {
        "name": "some/scene",
        "state": "",
        "count": len(means),
        "scene": g,
        "origin": np.zeros(3),
        "times": (),
        "settings": drgs.RenderSettings.preset,
        "layers": layers_of({}, (), 10_000),
        "placed_views": (),
        "ranking": None,
        "maps": {},
        "first": FirstView(pose_of(camera, np.zeros(3)), np.zeros(3), np.array([0.0, -1.0, 0.0])),
        "background": (0.0, 0.0, 0.0),
    }
    return Subject(**given | fields)


def finished(steps):
    """What a drawing returns."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


# ------------------------------------------------------------------------------------------------ cameras


@pytest.mark.parametrize("origin", [0.0, 1e6])
def test_poses_there_and_back(rng, origin):
    """A camera, as the client would have it, and back: every point falls on the pixel where it was, to 1e-6."""
    shift = np.full(3, origin)
    for _ in range(20):
        eye, target, up = rng.normal(size=(3, 3))
        camera = Camera(
            K=intrinsics(90.0, 120.0, 80, 60), w2c=look_at(eye + shift, target + shift, up), width=160, height=120
        )
        pose = pose_of(camera, shift)
        again = camera_of(pose, 160, 120, shift)
        points = target + shift + 0.1 * rng.normal(size=(30, 3))
        there, back = camera.project(points)[0], again.project(points)[0]
        np.testing.assert_allclose(back, there, atol=1e-6 if origin == 0 else 1e-5, rtol=0)
        assert pose.is_near(pose_of(again, shift))
        twice = camera_of(pose, 320, 240, shift).project(points)[0]
        np.testing.assert_allclose(twice, 2 * there, atol=1e-5)
        moved = dataclasses.replace(pose, position=pose.position + 1e-3)
        assert not pose.is_near(moved)
        assert not pose.is_near(None)


def test_axes_are_opencv(rng):
    """The identity looks along +z with +y down: a point at the right and below is right and below in the picture."""
    pose = Pose(np.array([1.0, 0, 0, 0]), np.zeros(3), 2 * np.arctan(0.5), 4 / 3)
    camera = camera_of(pose, 400, 300, np.zeros(3))
    pixel, depth = camera.project(np.array([[0.2, 0.1, 1.0]]))
    np.testing.assert_allclose(pixel[0], [200 + 0.2 * 300, 150 + 0.1 * 300])
    assert depth[0] == 1.0


def test_all_that_a_camera_sees_is_in_a_window_of_another_shape():
    """A wide photograph in a tall window keeps its width, in a wider one its height."""
    pose = Pose(np.array([1.0, 0, 0, 0]), np.zeros(3), 2 * np.arctan(0.5), 2.0)
    assert looking(pose, 4.0) == pytest.approx(pose.fov)
    assert np.tan(0.5 * looking(pose, 0.5)) * 0.5 == pytest.approx(0.5 * 2.0)
    assert looking(dataclasses.replace(pose, aspect=1e6), 1.0) < np.pi


# ---------------------------------------------------------------------------------------------- Gaussians


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e5])
def test_gaussians_of_the_client(rng, unit):
    """Centers, covariances, colors and opacities are those of the Gaussians whatever the unit of the world: the
    covariances to half a thousandth, as half floats have it."""
    n = 200
    scales = np.exp(rng.uniform(np.log(2e-3), 0, (n, 3))) * unit
    means = rng.normal(size=(n, 3)) * unit
    g = drgs.Gaussians.from_arrays(
        means, rng.normal(size=(n, 4)), scales, rng.uniform(0.1, 0.9, n), rng.normal(size=(n, 4, 3))
    )
    found = ClientGaussians.of(g)
    np.testing.assert_allclose(found.centers * found.scale, means, rtol=1e-5, atol=1e-6 * unit)
    halves = found.covariances.astype(np.float16).astype(np.float64)
    assert np.isfinite(halves).all()
    axes = drgs.ellipsoids.semi_axes(g.quats, g.scales).double().numpy()
    wanted = axes @ axes.transpose(0, 2, 1)
    size = np.abs(wanted).max((1, 2), keepdims=True)
    assert (np.abs(halves * found.scale**2 - wanted) / size).max() < 1e-3
    colors = (0.5 + drgs.ellipsoids.Y_00 * g.sh[:, 0]).clamp(0, 1).numpy()
    assert np.abs(found.rgbs / 255 - colors).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_allclose(found.opacities[:, 0], g.opacities, rtol=1e-6)


@pytest.mark.parametrize("log_scale", [-100.0, 0.0, 44.0, 88.0, 200.0])
def test_what_the_client_gets_is_finite(rng, log_scale):
    """One Gaussian of any size and place among others of size 1, or all of them: no NaN, nothing infinite."""
    for several in (1, 500):
        log_scales = torch.zeros(500, 3)
        log_scales[:several, :2] = log_scale
        means = torch.randn(500, 3)
        means[:several] *= 1e38
        g = drgs.Gaussians(
            means,
            torch.as_tensor(rng.normal(size=(500, 4))).float(),
            log_scales,
            torch.zeros(500),
            torch.zeros(500, 1, 3),
        )
        found = ClientGaussians.of(g)
        with np.errstate(over="raise"):
            halves = found.covariances.astype(np.float16)
        for x in (found.centers, halves, found.opacities, found.scale):
            assert np.isfinite(x).all()
        diagonal = np.diagonal(halves.astype(np.float64), axis1=1, axis2=2)
        assert (diagonal >= 0).all()


# ----------------------------------------------------------------------------------------------- pictures


def test_bands_make_the_whole_picture():
    """A picture in bands is the one that is drawn at once, and no band is larger than it may be."""
    g = blobs(torch.randn(20, 3) * 0.5)
    camera = orbit((0, 0, 0), 3.0, 5, width=90, height=70)[1]
    whole = drgs.render(g, camera, FAST)
    parts = bands(camera, 1000)
    assert len(parts) == 7
    assert max(part.width * part.height for part in parts) <= 1000
    found = [drgs.render(g, part, FAST).rgb for part in parts]
    assert (torch.cat(found) - whole.rgb).abs().max() < 1e-5
    assert (
        np.abs(finished(rendered_in_bands(g, camera, FAST, lambda out: out.depth.numpy())) - whole.depth.numpy()).max()
        < 1e-4
    )


def test_a_small_picture_comes_first():
    """Two sizes of the same view; a small window has one; no picture is larger than the window or than is allowed."""
    camera = orbit((0, 0, 0), 3.0, 1, width=1200, height=800)[0]
    first, last = stages(camera, 500_000)
    assert first.width * first.height <= 16_000 < 400_000 < last.width * last.height <= 500_000
    assert len(stages(camera.resized(120, 80), 500_000)) == 1
    assert stages(camera, 10_000_000)[-1].width == 1200
    ratio = lambda c: c.K[0, 0] / c.width  # noqa: E731
    assert ratio(first) == pytest.approx(ratio(last)) == pytest.approx(ratio(camera))


def test_layers_are_what_there_is(run):  # noqa: F811
    """Bare Gaussians have colors, depth and what is missing; features and labels come with a run that has some, in the
    colors of `drgs render`, and paint the client's Gaussians, too; of a run whose data set has gone there is still what
    its photographs said about errors."""
    plain = layers_of({}, (), 10_000)
    assert [layer.name for layer in plain] == ["rgb", "depth", "missing"]
    given = SceneInput.of(View(scene=run.run.path))
    looked = subject_of(View(scene=run.run.path), given)
    semantic = ["features", "labels", "overlay"]
    assert [layer.name for layer in looked.layers] == ["rgb", "depth", "missing", *semantic, "expected error"]
    for _ in looked.maps["expected error"].add_views(lambda: None):  # the record that the fit has left
        pass
    camera = camera_of(looked.first.pose, 40, 30, looked.origin)
    pictures = {layer.name: finished(layer.draw(looked.scene, camera, FAST)).picture for layer in looked.layers}
    assert all(x.shape == (30, 40, 3) and x.dtype == np.uint8 for x in pictures.values())
    out = drgs.render(given.gaussians, camera, FAST)
    assert np.abs(pictures["rgb"] - (255 * out.rgb.clamp(0, 1)).round().numpy()).max() <= 1
    from drgs.commands.semantic_pictures import picture_functions

    for name, painter in picture_functions(("features", "labels", "overlay"), given, Path("x")).items():
        assert np.array_equal(pictures[name], painter(out)), name
    brightness, alpha = pictures["missing"].sum(2).astype(float), out.alpha.numpy()
    ranks = [np.argsort(np.argsort(x.ravel())) for x in (brightness, 1 - alpha)]
    assert np.corrcoef(*ranks)[0, 1] > 0.95
    assert brightness[alpha == alpha.max()].max() < brightness[alpha == alpha.min()].min()
    tints = {layer.name: tinted(layer, given.gaussians) for layer in looked.layers}
    assert {name for name, tint in tints.items() if tint is not None} == {"features", "labels"}
    assert tints["labels"].shape == (len(given.gaussians), 3)
    assert any("no cameras: " in note for note in looked.notes)  # that data set was never on a disk


def test_uncertainty_is_that_of_fisher():
    """The map is `variance_map` with the information of all photographs; before these are added there is none."""
    g = blobs(torch.randn(12, 3) * 0.4)
    cameras = orbit((0, 0, 0), 3.0, 4, width=24, height=20)
    prior = gain.Prior(1.0)
    told = []
    made = Uncertainty(
        cameras[:3],
        lambda camera: fisher.diagonal(g, camera, FAST),
        lambda camera, weights: fisher.variance_map(g, camera, weights, FAST).numpy(),
        prior,
    )
    with pytest.raises(RuntimeError, match="all 3 views must be added first, 0 are"):
        made.map(cameras[3])
    for _ in made.add_views(lambda: told.append(made.done)):
        pass
    assert told == [1, 2, 3]
    assert made.is_complete
    H = fisher.diagonal(g, cameras[:3], FAST)
    wanted = fisher.variance_map(g, cameras[3], gain.variances(H, prior), FAST).numpy()
    np.testing.assert_allclose(made.map(cameras[3]), wanted, rtol=1e-3, atol=1e-6 * wanted.max())


def test_uncertainty_has_map_first():
    """Few pixels of few photographs, each for all that it stands for: soon there is about the map of all of them."""
    torch.manual_seed(0)
    g = blobs(torch.randn(40, 3) * 0.4)
    cameras = orbit((0, 0, 0), 3.0, 30, width=96, height=80)
    asked = []

    def said(camera):
        asked.append(camera.width * camera.height)
        return fisher.diagonal(g, camera, FAST)

    def mapped(camera, weights):
        return fisher.variance_map(g, camera, weights, FAST).numpy()

    made = Uncertainty(cameras, said, mapped, gain.Prior(1.0))
    steps = made.add_views(lambda: None)
    while not made.has_map:
        next(steps)
    assert len(asked) == 24
    assert max(asked) <= 2400
    assert not made.is_complete
    sketch = made.map(cameras[3])
    for _ in steps:
        pass
    assert made.is_complete
    assert asked[24:] == [96 * 80] * 30
    whole = made.map(cameras[3])
    seen = whole > 1e-3 * whole.max()
    assert np.median(np.abs(np.log(sketch[seen] / whole[seen]))) < 0.1
    assert len(list(Uncertainty(cameras, said, mapped, gain.Prior(1.0)).add_views(lambda: None, sketch=False))) == 30


def test_expected_error_is_read_or_made():
    """The record that there is serves at once; else a sketch of few pixels comes before that of the photographs, unless
    a fit has written one meanwhile."""
    g = blobs(torch.randn(12, 3) * 0.4)
    *cameras, other = orbit((0, 0, 0), 3.0, 4, width=24, height=20)
    gray = [torch.full((20, 24, 3), 0.5)] * 3
    record = drgs.error_record(g, cameras, gray, FAST)
    for there, asked, told in (
        ([record], [], [3]),
        ([None, None], [2400, None], [0, 3]),
        ([None, record], [2400], [0, 3]),
    ):
        made, said = [], []
        shown = ExpectedError(g, 3, iter(there).__next__, functools.partial(_made, record, made))
        with pytest.raises(RuntimeError, match="3 photographs must be looked at first"):
            shown.map(other)
        for _ in shown.add_views(functools.partial(_said, shown, said)):
            assert shown.has_map
        assert (made, said, shown.is_complete) == (asked, told, True)
        np.testing.assert_array_equal(shown.map(other), drgs.expected_error(g, other, record).sqrt().numpy())


def _made(record, made, pixels):
    made.append(pixels)
    return record


def _said(shown, said):
    said.append(shown.done)


# ------------------------------------------------------------------------------------------------- worker


def test_worker_leaves_what_is_no_longer_wanted():
    """A newer job under a key takes the place of the older one between two steps; what can wait comes last; an error
    ends its job alone."""
    seen, failed, begun, go = [], [], threading.Event(), threading.Event()
    worker = Worker(lambda key, error: failed.append((key, str(error))))

    def old():
        seen.append("old")
        begun.set()
        assert go.wait(20)
        yield
        seen.append("never")

    def steps(name, count):
        for k in range(count):
            seen.append(f"{name}{k}")
            yield

    def bad():
        raise ValueError("no")
        yield

    worker.put("a", old())
    assert begun.wait(20)
    worker.put("later", steps("later", 2), can_wait=True)
    worker.put("a", steps("new", 2))
    worker.put("b", steps("b", 2))
    worker.put("bad", bad())
    worker.put("gone", steps("gone", 1))
    worker.drop("gone")
    go.set()
    end = time.monotonic() + 20
    while worker.has("later") and time.monotonic() < end:
        time.sleep(0.01)
    assert seen == ["old", "new0", "b0", "new1", "b1", "later0", "later1"]
    assert failed == [("bad", "no")]
    assert worker.close(20.0)


# ------------------------------------------------------------------------------------------------ cameras of a run


def test_placed_views_of_a_run(place):  # noqa: F811
    """Views that were fitted to, and the others with the scores, parts and ranks that a selection states."""
    selection = json.loads((place / "run/selection.json").read_text())
    looked = subject_of(View(scene=place / "run"), SceneInput.of(View(scene=place / "run")))
    by_name = {placed.camera.name: placed for placed in looked.placed_views}
    assert sorted(by_name) == list("012345678")
    fitted = {view["name"] for key in ("start", "picks") for view in selection[key]}
    assert {name for name, placed in by_name.items() if placed.kind == "training"} == fitted
    last = selection["picks"][-1]
    for row in last["candidates"]:
        sight = by_name[row["name"]].best
        assert sight.score.total == row["score"]
        assert sight.score.parts == (row["parts"] or {})
        assert sight.score.rank == 1 + sum(other["score"] > row["score"] for other in last["candidates"])
        assert by_name[row["name"]].kind == ("training" if row["name"] in fitted else "candidate")
    assert [by_name[pick["name"]].best.pick for pick in selection["picks"]] == [1, 2]
    photograph = by_name["3"].best.photograph(12)
    view = next(view for view in load(place / "data").views if view.name == "3")
    np.testing.assert_allclose(photograph, view.checked().image(12, 12), atol=1e-6)
    assert {layer.name for layer in looked.layers} == {"rgb", "depth", "missing", "expected error", "uncertainty"}
    assert looked.state == "step 12 of 12"
    # It looks at what the photographs look at: the middle, from their distance, with their up.
    assert np.linalg.norm(looked.first.target) < 0.1
    assert looked.first.distance == pytest.approx(3.0, rel=0.05)
    np.testing.assert_allclose(looked.first.up, (0, 0, 1), atol=0.05)


def test_placed_views_of_drgs_select(place, monkeypatch, capsys):  # noqa: F811
    """Candidates on an orbit are of no data set: the file has their cameras, and `--selection` shows them."""
    monkeypatch.chdir(place)
    line = "select run --candidates orbit --count 5 -k 2 --criterion eig --blocks geometry -o orbit.json"
    assert cli.main(line.split()) == 0, capsys.readouterr().err
    ranking = read_ranking(place / "orbit.json")
    assert (ranking.title, len(ranking.cameras), len(ranking.picked)) == ("fisher, eig", 5, 2)
    args = View(scene=place / "run", selection=place / "orbit.json")
    looked = subject_of(args, SceneInput.of(args))
    candidates = [placed for placed in looked.placed_views if placed.kind == "candidate"]
    assert len(candidates) == 5
    best = max(candidates, key=lambda placed: placed.best.score.total)
    assert (best.best.score.rank, best.best.score.of, best.best.pick, best.best.photograph) == (1, 5, 1, None)
    colors, (low, high) = score_colors(candidates)
    assert high == best.best.score.total > low
    assert len({*colors}) == 5
    assert sum(best.best.score.parts.values()) == pytest.approx(best.best.score.total, rel=1e-6)
    text = panel.photograph(best, best.best)
    assert "rank 1 of 5" in text
    assert "log_scales" in text
    assert "no photograph" in text


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda x: x.pop("picks"), "must have the key 'picks'"),
        (lambda x: x["candidates"][0].update(score="a"), "score"),
        (lambda x: x["candidates"][0].update(parts={"means": "a"}), "parts"),
        (lambda x: x["candidates"][0].update(score=float("nan")), "score"),
        (lambda x: x["candidates"][0].update(camera={"name": "x"}), "width"),
        (lambda x: x["candidates"][0]["camera"].update(K=[[1.0]]), "K must be 3x3"),
        (lambda x: x["candidates"][0]["camera"].update(c2w=[[float("inf")] * 4] * 4), "c2w"),
        (lambda x: x["candidates"][0]["camera"].update(width=10**9, height=10**9), "2\\^31 pixels"),
    ],
)
def test_a_damaged_selection_is_refused(tmp_path, change, told):
    """In one line that names the file."""
    camera = {"name": "a", "width": 4, "height": 4, "K": np.eye(3).tolist(), "c2w": np.eye(4).tolist()}
    camera |= {"model": "pinhole", "distortion": []}
    row = {"name": "a", "score": 1.0, "parts": {"means": 1.0}, "camera": camera}
    value = {"command": "select", "policy": "fisher", "criterion": "eig", "picks": [{"name": "a"}], "candidates": [row]}
    path = tmp_path / "x.json"
    path.write_text(json.dumps(value))
    assert read_ranking(path).scores["a"] == Score(1.0, {"means": 1.0}, 1, 1)
    change(value)
    path.write_text(json.dumps(value))
    with pytest.raises(ValueError, match=rf"x.json.*{told}"):
        read_ranking(path)


def test_synchronous_cameras_are_one_station_each():
    """Views of one place at several times: one frustum, which shows the sight nearest to the time that is looked at."""
    still, other = orbit((0, 0, 0), 3.0, 2, width=8, height=8)
    views = [
        drgs.data.View(dataclasses.replace(camera, time=t), f"{k}_{t}")
        for t in (1.0, 0.0, 0.5)
        for k, camera in enumerate((still, other))
    ]
    scores = {"1_0.5": Score(2.0, {}, 1, 2), "1_0.0": Score(1.0, {}, 2, 2)}
    found = placed_views_of(views, ["0_0.0"], Ranking("fisher", scores, ("1_0.5",)))
    assert [placed.kind for placed in found] == ["training", "candidate"]
    assert [sight.camera.time for sight in found[1].sights] == [0.0, 0.5, 1.0]
    assert found[1].at(0.9).camera.name == "1_1.0"
    assert found[1].at(None) is found[1].best is found[1].sights[1]
    assert found[1].best.pick == 1


# ------------------------------------------------------------------------------------------------- panel

EVIL = "<script>alert(1)</script><img src=x onerror=alert(2)>&\"'{{}}`"


def test_what_files_say_is_escaped():
    """A scene, a view, a group, a note and a policy named like a program are text in the page."""
    camera = dataclasses.replace(orbit((0, 0, 0), 3.0, 1, width=8, height=8)[0], name=EVIL)
    score = Score(1.0, {EVIL: 1.0}, 1, 1)
    placed = PlacedView("candidate", (Sight(camera, None, score, 1),))
    looked = subject(torch.zeros(1, 3), name=EVIL, state=EVIL, notes=(EVIL,))
    texts = [panel.header(looked), panel.status(EVIL), panel.legend([placed], EVIL)]
    texts.append(panel.photograph(placed, placed.best))
    for text in texts:
        assert "<script" not in text
        assert "<img" not in text
        assert "&lt;script&gt;" in text


# ----------------------------------------------------------------------------------------------- sessions


@pytest.fixture
def viewers():
    """Starts viewers, and ends them."""
    made = []

    def start(*args, **options) -> Viewer:
        made.append(Viewer(*args, **{"preset": "fast"} | options))
        return made[-1]

    yield start
    for viewer in made:
        assert viewer.stop(30.0)


@pytest.fixture
def told(monkeypatch) -> list[str]:
    """All that sessions say in their panels. A client need not hear it all: of what is said in quick succession, viser
    sends the last."""
    texts = []
    say = Session.say

    def saying(self, text, scale=None):
        texts.append(text)
        say(self, text, scale)

    monkeypatch.setattr(Session, "say", saying)
    return texts


def html(client: Client, text: str, after: int = 0):
    """Wait until the panel says something that stays."""
    return client.wait(lambda m: text in str((m.get("props") or m.get("updates") or {}).get("content")), after=after)


def test_a_session_shows_gaussians_and_our_picture(viewers):
    """A browser is sent the Gaussians, and where its camera rests our picture of just what it sees; the Gaussians are
    hidden as long, and come back when it moves."""
    means = torch.tensor([[0.5, 0.3, 0.0], [-0.4, -0.2, 0.5]])
    looked = subject(means)
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position, 0.8)
        held = gaussians(client.wait(lambda m: m["type"] == "GaussianSplatsMessage"))
        assert held.shape == (2, 8)
        picture = client.picture()
        camera = camera_of(Pose(pose.wxyz, pose.position, 0.8, 160 / 120), *picture.shape[1::-1], np.zeros(3))
        wanted = (255 * drgs.render(looked.scene, camera, FAST).rgb.clamp(0, 1)).round().numpy()
        assert np.abs(picture.astype(int) - wanted).max() <= 1
        hidden = [m for m in client.heard if m["type"] == "SetSceneNodeVisibilityMessage" and m["name"] == "/gaussians"]
        assert [m["visible"] for m in hidden][-1] is False
        at = len(client.heard)
        client.look(pose.wxyz, np.array(pose.position) - (0, 0, 1), 0.8)
        shown = client.wait(lambda m: m["type"] == "SetSceneNodeVisibilityMessage" and m["visible"], after=at)
        assert shown["name"] == "/gaussians"
        assert len(np.argwhere(client.picture(after=at) > 60)) < len(np.argwhere(picture > 60))  # farther away


def test_a_camera_that_goes_on_gets_no_picture(viewers):
    """While it moves every tenth of a second nothing is drawn; the picture that comes is of where it has stopped."""
    looked = subject(torch.zeros(1, 3))
    viewer = viewers(looked)
    wxyz = looked.first.pose.wxyz
    with Client(viewer.port) as client:
        client.look(wxyz, (0, 0, -3))
        client.picture()
        at = len(client.heard)
        for k in range(8):
            client.look(wxyz, (0.1 * k, 0, -3))
            time.sleep(0.1)
        client.look(wxyz, (1.0, 0.0, -3))
        picture = client.picture(after=at)
        column = np.argwhere(picture.sum(2) > 60)[:, 1].mean()
        focal = 0.5 * picture.shape[0] / np.tan(0.4)
        assert column == pytest.approx(picture.shape[1] / 2 - focal / 3, abs=1.5)


def test_two_browsers_have_each_their_own_camera(viewers):
    """At once, of one scene: each gets the picture of its own camera, and its own layer."""
    looked = subject(torch.tensor([[0.3, 0.0, 0.0]]))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as one, Client(viewer.port) as two:
        one.look(pose.wxyz, (0, 0, -3))
        two.look(pose.wxyz, (0.6, 0, -3))
        left, right = (np.argwhere(x.picture().sum(2) > 60)[:, 1].mean() for x in (one, two))
        assert left > 85 > 75 > right
        at, other = len(one.heard), len(two.heard)
        one.choose("show", "missing")
        assert one.picture(after=at)[0, 0].min() > 100  # nothing is in the corner
        assert not [m for m in two.heard[other:] if m["type"] == "BackgroundImageMessage"]


def test_uncertainty_is_added_up_once_and_shown(place, viewers, told):  # noqa: F811
    """Asked for, it says how far it is, and then shows the map of the view."""
    args = View(scene=place / "run", preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position)
        client.picture()
        at = len(client.heard)
        client.choose("show", "uncertainty")
        picture = client.picture(after=at)
        counts = [text for text in told if text.endswith(" of 4 photographs added")]
        assert counts == [f"uncertainty of step 12 of 12: {done} of 4 photographs added" for done in range(5)]
        assert looked.maps["uncertainty"].is_complete
        camera = camera_of(Pose(pose.wxyz, pose.position, 0.8, 4 / 3), *picture.shape[1::-1], looked.origin)
        wanted, (low, high) = map_colors(looked.maps["uncertainty"].map(camera))
        html(client, f"{low:.3g} ", after=at)
        html(
            client,
            f" {high:.3g} variance of the color, as a multiple of the photographs&#x27; noise, logarithmic",
            after=at,
        )
        assert np.abs(picture.astype(int) - wanted).mean() < 1.0


def test_expected_error_of_a_run_is_shown(place, viewers, told):  # noqa: F811
    """The record of the fit is read, no photograph is; of a splat with its data set, the photographs are."""
    args = View(scene=place / "run", preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as client, pytest.MonkeyPatch.context() as patch:
        patch.setattr(errors, "frames_for", None)
        client.look(pose.wxyz, pose.position)
        client.picture()
        at = len(client.heard)
        client.choose("show", "expected error")
        picture = client.picture(after=at)
        counts = [text for text in told if text.endswith(" of 4 photographs added")]
        assert counts == [f"expected error of step 12 of 12: {done} of 4 photographs added" for done in (0, 4)]
        camera = camera_of(Pose(pose.wxyz, pose.position, 0.8, 4 / 3), *picture.shape[1::-1], looked.origin)
        record = run_error_record(Run(place / "run"), looked.settings("fast"))
        wanted, (_, high) = map_colors(drgs.expected_error(looked.scene, camera, record).sqrt().numpy())
        html(client, f" {high:.3g} error of a color between 0 and 1, logarithmic", after=at)
        assert np.abs(picture.astype(int) - wanted).mean() < 1.0
    args = View(scene=place / "scene.ply", train=str(place / "data"), info_pixels=200)
    shown = subject_of(args, SceneInput.of(args)).maps["expected error"]
    for _ in shown.add_views(lambda: None, sketch=False):
        pass
    assert shown.count == 9
    assert shown.map(camera).shape == (camera.height, camera.width)
    args = View(scene=place / "scene.ply", train=str(place / "cameras.json"))
    assert [*subject_of(args, SceneInput.of(args)).maps] == ["uncertainty"]


def uncertain(seed: int, hold, calls: list[int]) -> Subject:
    """Of three photographs; `hold` is called before the information of each is computed."""
    torch.manual_seed(seed)
    g = blobs(torch.randn(12, 3) * 0.4)
    cameras = orbit((0, 0, 0), 3.0, 3, width=24, height=20)

    def said(camera):
        calls.append(seed)
        hold()
        return fisher.diagonal(g, camera, FAST)

    def mapped(camera, weights):
        return fisher.variance_map(g, camera, weights, FAST).numpy()

    known = Uncertainty(cameras, said, mapped, gain.Prior(1.0))
    layers = layers_of({}, [known], 2_000)
    return subject(torch.zeros(12, 3), scene=g, state=f"step {seed}", maps={known.name: known}, layers=layers)


def test_a_map_that_was_begun_is_finished(viewers, told):
    """Checkpoints that come while the photographs are added up stop nothing: the map of the first is shown, with its
    step, then that of the last one; those between are passed over, and no photograph is added twice."""
    begun, go, calls, drawn = threading.Event(), threading.Event(), [], []

    def hold():
        (session,) = viewer.sessions.values()
        if len(calls) == 2:  # until the checkpoints have come
            drawn.append(session.drawn)
            begun.set()
            assert go.wait(60)
        if len(calls) == 4:  # until the browser has asked for the map of the first, or has it already
            end = time.monotonic() + 60
            while not viewer.worker.has((session, "picture")) and session.drawn == drawn[0] and time.monotonic() < end:
                time.sleep(0.01)

    subjects = [uncertain(seed, hold, calls) for seed in (1, 2, 3)]
    viewer = viewers(subjects[0])
    pose = subjects[0].first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position)
        client.picture()
        client.choose("show", "uncertainty")
        assert begun.wait(60)
        for later in subjects[1:]:
            viewer.replace(later)
        html(client, "step 3")
        at = len(client.heard)
        go.set()
        html(client, "uncertainty, fast: 51x38 in ", after=at)
        maps = [text.rpartition(" in ")[0] for text in told if text.startswith("uncertainty") and " in " in text]
        assert maps == ["uncertainty of step 1, fast: 51x38", "uncertainty, fast: 51x38"]
        picture = decoded([m for m in client.heard if m["type"] == "BackgroundImageMessage"][-1])
        camera = camera_of(Pose(pose.wxyz, pose.position, 0.8, 4 / 3), *picture.shape[1::-1], np.zeros(3))
        wanted, _ = map_colors(subjects[2].maps["uncertainty"].map(camera))
        assert np.abs(picture.astype(int) - wanted).mean() < 1.0
    assert calls == [1, 1, 1, 3, 3, 3]


def test_a_long_picture_says_how_long(viewers, told):
    """Of a picture in several bands: an estimate by the small one before it, then the share that is done."""
    looked = subject(torch.randn(300, 3))
    viewer = viewers(looked, preset="exact")
    with Client(viewer.port) as client:
        client.look(looked.first.pose.wxyz, looked.first.pose.position, width=640, height=480)
        html(client, "rgb, exact: 640x480 in ")
    drawn = [text for text in told if text.startswith("rgb, exact: drawing 640x480")]
    assert re.fullmatch(r"rgb, exact: drawing 640x480, about \d+ (s|min) \.\.\.", drawn[0])
    shares = [int(re.fullmatch(r".*: (\d+)%, about \d+ (?:s|min) left \.\.\.", text)[1]) for text in drawn[1:]]
    assert shares == sorted(shares)
    assert shares
    assert 0 < shares[0] < 50 < shares[-1] < 100


def test_a_click_flies_to_a_camera(place, viewers):  # noqa: F811
    """A click on a frustum moves the camera to where the photograph was taken, and shows what is known of it."""
    args = View(scene=place / "run", preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    viewer = viewers(looked)
    number = next(k for k, placed in enumerate(looked.placed_views) if placed.best.score and placed.kind == "candidate")
    placed = looked.placed_views[number]
    with Client(viewer.port) as client:
        client.look(looked.first.pose.wxyz, looked.first.pose.position)
        client.picture()
        at = len(client.heard)
        client.click(number)
        moved = client.wait(lambda m: m["type"] == "SetCameraPositionMessage", after=at)
        np.testing.assert_allclose(moved["position"], placed.camera.center, atol=1e-6)
        html(client, f"rank {placed.best.score.rank} of {placed.best.score.of}", after=at)
        client.wait(lambda m: "_data" in str(m.get("updates", {}).keys()), after=at)
        picture = client.picture(after=at)
        camera = dataclasses.replace(
            placed.camera, K=intrinsics(*[placed.camera.K[1, 1] * 5] * 2, 80, 60), width=160, height=120
        )
        wanted = (255 * drgs.render(looked.scene, camera, FAST).rgb.clamp(0, 1)).round().numpy()
        assert np.abs(picture.astype(int) - wanted).mean() < 1.0  # the same picture as where it flew to


def test_a_slider_moves_what_moves(viewers):
    """A scene with times has a slider and a button; the client gets the Gaussians of the time that is chosen, and
    playing goes through all of them."""

    class Moving:
        def at(self, time):
            return blobs(torch.tensor([[float(time), 0.0, 0.0]]))

        def parameters(self):
            return {}

    looked = subject(torch.zeros(1, 3), scene=Moving(), times=(0.0, 0.25, 0.5, 1.0))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, (0, 0, -3))
        left = np.argwhere(client.picture().sum(2) > 60)[:, 1].mean()
        at = len(client.heard)
        client.choose("time", 1.0)
        changed = client.wait(lambda m: "buffer" in str(m.get("updates", {}).keys()), after=at)
        center = np.frombuffer(changed["updates"]["buffer"], np.uint32).reshape(-1, 8)[0, :3].view(np.float32)
        made = ClientGaussians.of(looked.scene.at(1.0))
        np.testing.assert_allclose(center, made.centers[0])
        assert np.argwhere(client.picture(after=at).sum(2) > 60)[:, 1].mean() > left + 20
        at = len(client.heard)
        client.choose("play", True)
        seen = set()
        while len(seen) < 4:
            found = client.wait(lambda m: isinstance(m.get("updates", {}).get("value"), float), after=at)
            at = client.heard.index(found) + 1
            seen.add(round(found["updates"]["value"], 3))
        client.choose("play", True)
    with Client(viewers(subject(torch.zeros(1, 3))).port) as client:
        client.look(pose.wxyz, (0, 0, -3))
        client.picture()
        assert "time" not in client.labels()
        assert "show" in client.labels()


def test_a_camera_stays_where_it_is_in_the_world(viewers):
    """A file that is written again may be relative to another origin: the browser's 0 moves, its camera does not."""
    means, origin = torch.zeros(1, 3), np.array([500000.0, 5400000.0, 120.0])
    viewer = viewers(subject(means))
    with Client(viewer.port) as client:
        client.look((1, 0, 0, 0), (0, 0, -3))
        client.picture()
        at = len(client.heard)
        viewer.replace(subject(means, scene=blobs(means).replace(origin=origin), origin=origin))
        moved = client.wait(lambda m: m["type"] == "SetCameraPositionMessage", after=at)
    assert moved["position"] == pytest.approx((0, 0, -3) - origin, abs=1e-6)


@pytest.mark.parametrize("times", [(), (0.0, 0.5, 1.0)])
def test_a_flight_is_made_in_the_browser(viewers, tmp_path, times):
    """Keyframes where the camera is, with the time that is shown; a preview ends at the last one; what is saved is read
    by `drgs render --path`."""

    class Moving:
        def at(self, time):
            return blobs(torch.tensor([[float(time), 0.0, 0.0]]))

        def parameters(self):
            return {}

    fields = {"scene": Moving(), "times": times} if times else {}
    looked = subject(torch.zeros(1, 3), origin=np.array([10.0, 0, 0]), **fields)
    viewer = viewers(looked)
    identity = np.array([1.0, 0, 0, 0])
    with Client(viewer.port) as client:
        client.look(identity, (0, 0, -3))
        client.picture()
        client.choose("add keyframe", True)
        html(client, "1 keyframe")
        client.choose("seconds to the next", 0.5)
        if times:
            client.choose("time", 1.0)
        client.look(identity, (1, 0, -4), fov=0.5)
        client.choose("add keyframe", True)
        html(client, "2 keyframes, 0.5 s")
        client.look(identity, (5, 5, -4))
        at = len(client.heard)
        client.choose("add keyframe", True)
        html(client, "3 keyframes, 1.0 s", after=at)
        client.choose("drop the last", True)
        at = len(client.heard)
        html(client, "2 keyframes, 0.5 s", after=at)
        client.choose("fly", True)

        def has_arrived(m):
            return m["type"] == "SetCameraPositionMessage" and np.allclose(m["position"], (1, 0, -4))

        client.wait(has_arrived, after=at)
        client.choose("save flight.json", True)
        part = client.wait(lambda m: m["type"] == "FileTransferPart")
    path = tmp_path / "flight.json"
    path.write_bytes(part["content"])
    flight = read_camera_path(path)
    np.testing.assert_allclose([key.position for key in flight.keyframes], [[10, 0, -3], [11, 0, -4]], atol=1e-12)
    np.testing.assert_allclose([key.fov for key in flight.keyframes], np.degrees([0.8, 0.5]))
    assert [key.seconds for key in flight.keyframes] == [0.0, 0.5]
    assert [key.time for key in flight.keyframes] == ([0.0, 1.0] if times else [None, None])


def test_a_run_that_goes_on_is_shown(place, tmp_path, viewers):  # noqa: F811
    """Another checkpoint takes the place of what was shown: its step, its Gaussians, our picture of them."""
    shutil.copytree(place / "run", tmp_path / "run")
    args = View(scene=tmp_path / "run", preset="fast")
    from drgs.commands.view import _reload_job, _stamps

    viewer = viewers(subject_of(args, SceneInput.of(args)))
    before, pose = _stamps(watched_files(args)), viewer.subject.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position)
        html(client, "step 12 of 12")
        client.picture()
        at, state = len(client.heard), tmp_path / "run/state.safetensors"
        tensors, header = load_state(state)
        save_state(state, tensors, header | {"step": 13})
        assert _stamps(watched_files(args)) != before
        viewer.worker.put("files", _reload_job(args, viewer))
        html(client, "step 13 of 12", after=at)
        client.picture(after=at)
        state.write_bytes(b"broken")
        (tmp_path / "run/point_cloud.ply").unlink()
        at = len(client.heard)
        viewer.worker.put("files", _reload_job(args, viewer))
        html(client, "state.safetensors", after=at)
        client.look(pose.wxyz, np.array(pose.position) * 1.1)
        client.picture(after=at)  # what was there is still shown


@pytest.mark.parametrize(
    "bad",
    [
        {"wxyz": [0.0, 0.0, 0.0, 0.0]},
        {"wxyz": [float("nan")] * 4},
        {"wxyz": [1.0]},
        {"position": [float("inf"), 0.0, 0.0]},
        {"position": [1e300, 0.0, 0.0]},
        {"fov": 0.0},
        {"fov": float("nan")},
        {"fov": 4.0},
        {"image_height": 0},
        {"image_width": -5},
        {"image_width": 1 << 40},
        {"look_at": [float("nan")] * 3, "up_direction": [0.0, 0.0, 0.0]},
    ],
    ids=str,
)
def test_a_camera_that_is_none_is_left_out(viewers, bad, caplog, capfd):
    """Zeros, NaN and too few numbers in the place of a camera, from the first message on: nothing fails, and what is
    a camera again is drawn."""
    looked = subject(torch.zeros(1, 3))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position, other=bad)
        client.wait(lambda m: m["type"] == "GaussianSplatsMessage")
        client.look(pose.wxyz, pose.position)
        client.picture()
        client.look(pose.wxyz, pose.position, other=bad)
        at = len(client.heard)
        client.look(pose.wxyz, np.array(pose.position) - (0, 0, 1))
        picture = client.picture(after=at)
        assert np.isfinite(viewer.sessions.popitem()[1].pose.wxyz).all()
    assert picture.max() > 100
    assert not [record for record in caplog.records if record.exc_info]
    assert "Traceback" not in "".join(capfd.readouterr())


def test_messages_that_are_none_are_one_line(viewers, caplog, capfd):
    """What no page sends: unknown kinds, values of other types, bytes that are no message. The others go on."""
    looked = subject(torch.zeros(1, 3))
    viewer = viewers(looked)
    pose = looked.first.pose
    with Client(viewer.port) as other:
        other.look(pose.wxyz, pose.position)
        for data in (
            b"",
            b"\xc1",
            b"abc",
            "text",
            msgspec.msgpack.encode({"type": "NoSuch"}),
            msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
            b"\x93\x01\x02\x03",
        ):
            with Client(viewer.port) as client:
                client.look(pose.wxyz, pose.position)
                client.wait(lambda m: m["type"] == "GaussianSplatsMessage")
                client.send_bytes(data)
        for bad in ({"wxyz": "abcd"}, {"position": None}, {"fov": "wide"}, {"image_width": "x"}):
            with Client(viewer.port) as client:
                client.look(pose.wxyz, pose.position, other=bad)
        with Client(viewer.port) as client:
            client.look(pose.wxyz, pose.position)
            for label, value in (("show", 5), ("show", "nothing"), ("drawn by", "nothing"), ("our picture", "x")):
                client.choose(label, value)
            client.send(type="GuiUpdateMessage", uuid="nobody", updates={"value": 1})
            client.choose("drawn by", "fast")
            client.picture()
        other.picture()
    gc.collect()  # a task that has failed says so when it is freed
    assert not [record.getMessage() for record in caplog.records if record.exc_info or "\n" in record.getMessage()]
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.slow
def test_what_a_browser_leaves_is_freed(viewers):
    """Browsers that come and go leave neither a session nor what was sent to them, though Python's own search for
    circles of references is off meanwhile."""
    looked = subject(torch.randn(500, 3))
    viewer = viewers(looked)
    left = []
    gc.collect()
    gc.disable()
    try:
        for _ in range(6):
            with Client(viewer.port) as client:
                client.look(looked.first.pose.wxyz, looked.first.pose.position)
                client.picture()
                (session,) = viewer.sessions.values()
                left += [weakref.ref(x) for x in (session, session.client, session._gaussians, session.client.scene)]
                del session
            end = time.monotonic() + 30
            while viewer.sessions and time.monotonic() < end:
                time.sleep(0.01)
        end = time.monotonic() + 60
        while any(ref() is not None for ref in left) and time.monotonic() < end:
            time.sleep(0.05)
        assert [type(ref()).__name__ for ref in left if ref() is not None] == []
    finally:
        gc.enable()


# ---------------------------------------------------------------------------------------------- command


def test_view_ends_by_ctrl_c(place):  # noqa: F811
    """`drgs view` prints its address, serves it, and ends with one line and 130 within seconds, without a thread or a
    process left."""
    command = [sys.executable, "-m", "drgs", "view", str(place / "run"), "--port", "0", "--preset", "fast"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline()
        assert address.startswith("http://127.0.0.1:")
        assert "token" not in address
        port = int(address.split(":")[2].split("/")[0])
        with Client(port) as client:
            client.look((1, 0, 0, 0), (0, 0, -3))
            client.wait(lambda m: m["type"] == "GaussianSplatsMessage")
            process.send_signal(signal.SIGINT)
            began = time.monotonic()
            _, error = process.communicate(timeout=30)
        assert process.returncode == 130
        assert error.splitlines()[-1] == "drgs view: interrupted"
        assert "Traceback" not in error
        assert time.monotonic() - began < 60  # 1 to 2 s where the machine is free


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("missing.ply", "missing.ply"),
        ("scene.ply --port 70000", "--port must be in [0, 65535], got 70000"),
        ("scene.ply --token short", "--token must be 8 to 200"),
        ("scene.ply --max-pixels 1", "--max-pixels must be in [100, 16777216], got 1"),
        ("scene.ply --selection data/transforms.json", "transforms.json"),
        ("scene.ply --train nowhere", "nowhere"),
        ("scene.ply --host 198.51.100.1 --port 0", "must be an address of this machine that is free"),
    ],
)
def test_bad_options_are_one_line(place, monkeypatch, capsys, line, told):  # noqa: F811
    """Before anything is served; exit code 2."""
    monkeypatch.chdir(place)
    assert cli.main(["view", *line.split()]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert told in err


def test_without_viser_one_line_says_what_to_install(place, monkeypatch, capsys):  # noqa: F811
    """The extra is named, but not for a path that is not there; where a command names the next one, it is, too."""
    import importlib.util

    assert view_command(Path("a run")) == "drgs view 'a run'"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    monkeypatch.chdir(place)
    assert cli.main(["view", "scene.ply"]) == 2
    assert capsys.readouterr().err == "drgs view: viser must be installed, is not; pip install 'drgs[view]'\n"
    assert cli.main(["view", "missing.ply"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("drgs view: missing.ply: ")
    assert "viser" not in told
    assert view_command(Path("run")) == "drgs view run (after pip install 'drgs[view]')"
