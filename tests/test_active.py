"""Active fits: what is read and when, what is recorded, resuming, and one line for everything that can be wrong."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_data import HEIGHT, WIDTH, gradient, poses, save, write_colmap, write_image, write_llff, write_transforms

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, orbit
from drgs.data import load
from drgs.files import Run, load_state
from drgs.fitting import metrics
from drgs.fitting.active import ActiveViews
from drgs.fitting.config import SelectionConfig
from drgs.fitting.frames import load_frames
from drgs.fitting.records import fitted_views
from drgs.fitting.renderers import ANY
from drgs.fitting.timetable import initial_views
from drgs.information.prior import Prior
from drgs.train import FitConfig, Trainer, fit

SIZE = 24

# ---- spying on files. Audit hooks stay for ever, so that there is one, and it only looks while a test is spying.

_opened: list[str] | None = None
_is_hooked = False


def _hook(event, arguments):
    if _opened is not None and event == "open" and isinstance(arguments[0], (str, bytes, os.PathLike)):
        _opened.append(os.fsdecode(arguments[0]))


@pytest.fixture
def opened(monkeypatch):
    """Files opened since the test began, and ("picked NAME"), in order; by Python and by OpenCV."""
    import cv2

    from drgs.selection import policies

    global _opened, _is_hooked
    if not _is_hooked:
        sys.addaudithook(_hook)
        _is_hooked = True
    read, choose = cv2.imread, policies.choose
    seen = []

    def imread(path, *rest):
        seen.append(str(path))
        return read(path, *rest)

    def chosen(*arguments):
        selection = choose(*arguments)
        seen.extend(f"picked {pick.name}" for pick in selection.picks)
        return selection

    monkeypatch.setattr(cv2, "imread", imread)
    monkeypatch.setattr(policies, "choose", chosen)
    _opened = seen
    yield seen
    _opened = None


def reads(seen: list[str], folder: Path) -> dict[str, list[int]]:
    """View name -> places in `seen` at which one of its files below `folder` was opened."""
    found: dict[str, list[int]] = {}
    for place, text in enumerate(seen):
        path = Path(text)
        if folder in path.parents and path.parent != folder and "sparse" not in path.parts:
            found.setdefault(path.name.split(".")[0], []).append(place)
    return found


# ---- data


def write_still(folder: Path):
    """A transforms.json data set: nine views of blobs with depth maps and object masks, names 0..8. The blobs."""
    generator = torch.Generator().manual_seed(1)
    n = 30
    g = drgs.Gaussians.from_arrays(
        torch.randn(n, 3, generator=generator) * 0.4,
        torch.randn(n, 4, generator=generator),
        0.06 + 0.15 * torch.rand(n, 3, generator=generator),
        torch.full((n,), 0.9),
        torch.rand(n, 1, 3, generator=generator) * 3 - 1,
    )
    frames = []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=SIZE, height=SIZE)):
        out = drgs.render(g, camera)
        write_image(folder / f"images/{i}.png", (out.rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
        write_image(folder / f"masks/{i}.png", ((out.alpha > 0.5) * 255).to(torch.uint8).numpy())
        write_image(folder / f"depth/{i}.png", (out.depth * 1000).round().numpy().astype(np.uint16))
        files = {"file_path": f"images/{i}.png", "mask_path": f"masks/{i}.png", "depth_file_path": f"depth/{i}.png"}
        frames.append({**files, "transform_matrix": c2w_to_opengl(camera.c2w).tolist()})
    K = camera.K
    lens = {"w": SIZE, "h": SIZE, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    save(folder, {**lens, "frames": frames})
    return g


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    folder = tmp_path_factory.mktemp("still")
    write_still(folder)
    return folder


def lazily(folder, **options):
    return load(folder, **{"test_every": 4, "lazy": True, "points": False, **options})


def config(**fields):
    return FitConfig().replace(
        **{
            "renderers": ("fast",),
            "max_steps": 16,
            "max_gaussians": 60,
            "sh_degree": 1,
            "test_every": 4,
            "save_every": 1000,
            **fields,
        }
    )


def plan(**fields):
    return SelectionConfig().replace(**{"policy": "farthest", "initial": 2, "add": 2, "every": 4, **fields})


def test_renderers_are_taken_in_turn_while_views_are_picked(still, tmp_path, rendered):
    """Views that come on the way meet every renderer, too; the run is measured in each of them."""
    settings = config(renderers=("any",), max_steps=48, selection=plan(policy="fisher"))
    result = fit(lazily(still), tmp_path / "run", settings, progress=False)
    picked = [pick["name"] for pick in json.loads((tmp_path / "run/selection.json").read_text())["picks"]]
    assert len(picked) == 2
    assert {preset for preset, name in rendered if name in picked} == {"exact", "fast", "gsplat", "3dgut"}
    assert {row["name"] for row in result.metrics["renderers"]["rows"]} == set(ANY)


# ---- nothing is read before it is picked


@pytest.mark.parametrize("policy", ["fisher", "random"])
def test_transforms_files_are_opened_after_the_pick(still, tmp_path, opened, policy):
    """Image, mask and depth of a view are opened only once it is picked; of others never."""
    dataset = lazily(still)
    assert not reads(opened, still)
    fit(dataset, tmp_path / "run", config(selection=plan(policy=policy)), progress=False)
    picks = json.loads((tmp_path / "run/selection.json").read_text())["picks"]
    names = [pick["name"] for pick in picks]
    found = reads(opened, still)
    for name in names:
        assert min(found[name]) > opened.index(f"picked {name}")
    train, test = ([view.name for view in part] for part in dataset.split(4))
    start = [train[i] for i in initial_views([view.camera for view in dataset.split(4)[0]], 2)]
    assert set(found) == {*names, *start, *test}
    assert set(train) - set(found), "some view of the pool must be left unseen, else this shows nothing"
    assert not set(names) & set(test)


def test_colmap_files_are_opened_after_the_pick(tmp_path, opened):
    """COLMAP: the same, and neither points nor observations are read: both may be garbage."""
    data = tmp_path / "data"
    target = write_colmap(data, count=9)
    images = target / "images.bin"
    whole = bytearray(images.read_bytes())
    at = 8
    for _ in range(9):
        at = whole.index(b"\0", at + 64) + 9  # past id, pose, camera, name and count
        whole[at : at + 24 * 5] = b"\xff" * 24 * 5  # 5 observations: NaN at points that do not exist
        at += 24 * 5
    images.write_bytes(whole)
    (target / "points3D.bin").write_bytes(b"garbage")
    opened.clear()
    fit(lazily(data), tmp_path / "run", config(selection=plan()), progress=False)
    assert not [text for text in opened if "points3D" in text and str(data) in text]
    record = json.loads((tmp_path / "run/selection.json").read_text())
    assert [view["name"] for view in record["start"]] == ["im1", "im7"]
    assert [pick["name"] for pick in record["picks"]] == ["im3", "im5"]
    found = reads(opened, data)
    assert set(found) == {"im0", "im4", "im8", "im1", "im7", "im5", "im3"}  # every fourth one is held out
    for name in ("im5", "im3"):
        assert min(found[name]) > opened.index(f"picked {name}")


@pytest.mark.parametrize("kind", ["transforms", "llff", "colmap"])
def test_views_that_are_never_picked_may_be_broken(tmp_path, kind):
    """What no hook can see, reads by native code, would stumble here: other views' files hold no image."""
    write = {"transforms": write_transforms, "llff": write_llff, "colmap": write_colmap}[kind]
    write(tmp_path / "data", count=9)
    fit(lazily(tmp_path / "data"), tmp_path / "a", config(selection=plan()), progress=False)
    seen = fitted_views(Run(tmp_path / "a"))
    dataset = lazily(tmp_path / "data")
    for view in dataset.split(4)[0]:
        if view.name not in seen:
            view.image_path.write_bytes(b"no image")
    fit(lazily(tmp_path / "data"), tmp_path / "b", config(selection=plan()), progress=False)
    assert fitted_views(Run(tmp_path / "b")) == seen


def test_broken_files_are_found_when_picked(tmp_path):
    """A picked view is checked as any other: one line that names the file."""
    write_transforms(tmp_path / "data", count=9)
    write_image(tmp_path / "data/images/3.png", gradient(20, 20))
    with pytest.raises(ValueError, match=r"3.png must have the shape of its camera \(24x16\), got 20x20"):
        fit(lazily(tmp_path / "data"), tmp_path / "run", config(selection=plan(add=4, every=2)), progress=False)


def test_init_points_all_leaks_and_says_so(tmp_path):
    """The paper's rule takes the model's points, and config.json and selection.json say so; the default does not."""
    write_colmap(tmp_path / "data", count=9)
    whole = load(tmp_path / "data", test_every=4, lazy=True)
    for rule, leak in (("all", True), ("auto", False)):
        run = tmp_path / rule
        fit(whole, run, config(init_points=rule, selection=plan()), progress=False)
        assert Run(run).config()["pool_leak"] is leak
        assert json.loads((run / "selection.json").read_text())["pool_leak"] is leak
        assert ("COLMAP model" in Run(run).config()["points"]) is leak


def test_extent_comes_from_the_initial_views(still, tmp_path):
    """A camera far away that is not picked at the start changes nothing."""
    train = lazily(still).split(4)[0]
    result = fit(lazily(still), tmp_path / "run", config(selection=plan()), progress=False)
    centers = np.stack([train[i].camera.center for i in initial_views([view.camera for view in train], 2)])
    expected = 1.1 * np.linalg.norm(centers[0] - centers[1]) / 2
    assert load_state(result.run.state)[1]["extent"] == pytest.approx(expected)


# ---- lazy data sets


@pytest.mark.parametrize("text", [False, True])
def test_lazy_colmap_has_the_same_cameras(tmp_path, text):
    """Poses and intrinsics without points and observations are those of the whole model."""
    write_colmap(tmp_path, text)
    whole, poses_only = load(tmp_path), load(tmp_path, lazy=True, points=False)
    assert whole.points is not None
    assert poses_only.points is None
    for a, b in zip(whole.views, poses_only.views, strict=True):
        assert (a.name, a.camera.width, a.camera.height) == (b.name, b.camera.width, b.camera.height)
        np.testing.assert_array_equal(a.camera.w2c, b.camera.w2c)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)


def test_lazy_views_take_the_stated_size_until_checked(tmp_path, opened):
    """Images of half the stated size: K follows when the view is checked, and candidates are taken to be alike."""
    write_transforms(tmp_path, count=9, w=2 * WIDTH, h=2 * HEIGHT)
    dataset = lazily(tmp_path)
    assert not reads(opened, tmp_path)
    assert (dataset.views[0].camera.width, dataset.views[0].is_checked) == (2 * WIDTH, False)
    assert dataset.views[0].checked().camera.width == WIDTH
    views = ActiveViews(dataset.split()[0], config(selection=plan()))
    assert views.frames()[0].camera.width == WIDTH
    assert views._camera(3).width == WIDTH
    np.testing.assert_allclose(views._camera(3).K, load(tmp_path).views[0].camera.K)


def test_lazy_blender_opens_only_the_first_training_image(tmp_path, opened):
    """An angle and no size: all images have one size, and the first view of the fit has it."""
    frames = []
    for i, pose in enumerate(poses(5)):
        write_image(tmp_path / f"train/r_{i}.png", gradient())
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": c2w_to_opengl(np.linalg.inv(pose)).tolist()})
    save(tmp_path, {"camera_angle_x": 1.0, "frames": frames}, "transforms_train.json")
    dataset = lazily(tmp_path)
    assert set(reads(opened, tmp_path)) == {"r_0"}
    for a, b in zip(dataset.views, load(tmp_path).views, strict=True):
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
    save(tmp_path, {"fl_x": 20, "frames": frames}, "transforms_train.json")
    with pytest.raises(ValueError, match="frame 0: must state w and h beside intrinsics in pixels"):
        lazily(tmp_path)


def test_lazy_points_of_a_transforms_file_are_not_opened(tmp_path, opened):
    write_transforms(tmp_path, count=4, ply_file_path="gone.ply")
    assert lazily(tmp_path).points is None


# ---- choosing and recording


def test_initial_views_are_far_apart():
    """The first one, then farthest points; coincident centers still give different views."""
    K = intrinsics(20, 20, 8, 8)

    def at(x):
        w2c = np.eye(4)
        w2c[0, 3] = -x
        return Camera(K, w2c, 16, 16)

    assert initial_views([at(x) for x in (0.0, 1.0, 5.0, 2.6, 4.0)], 4) == [0, 2, 3, 1]
    assert initial_views([at(1.0)] * 3, 3) == [0, 1, 2]
    assert initial_views([at(x) for x in (0.0, 1.0, 5.0, 2.6, 4.0)], 3, first=3) == [3, 0, 2]


def test_the_seed_draws_the_first_view(still, tmp_path):
    """Every view can come first and about as often as others, the same for the same seed; the picks of `random` are
    those of a generator that the draw does not touch; selection.json and --resume know the rule.
    """
    train = lazily(still).split(4, 1)[0]
    starts = [ActiveViews(train, config(seed=seed, selection=plan(start="seed"))).chosen for seed in range(300)]
    counts = np.bincount([chosen[0] for chosen in starts], minlength=len(train))
    assert counts.min() > 300 / len(train) - 4 * np.sqrt(300 / len(train)), "four standard deviations of a fair draw"
    assert all(chosen == initial_views([view.camera for view in train], 2, chosen[0]) for chosen in starts)
    first = ActiveViews(train, config(seed=5, selection=plan(start="first")))
    drawn = ActiveViews(train, config(seed=5, selection=plan(start="seed")))
    assert (first.chosen[0], drawn.chosen) == (0, starts[5])
    assert torch.equal(first.state()[0]["policy_rng"], drawn.state()[0]["policy_rng"])

    seed = next(seed for seed, chosen in enumerate(starts) if chosen[0] != 0)
    fields = {"max_steps": 10, "test_offset": 1, "seed": seed}
    run, active = tmp_path / "run", plan(start="seed")
    data = lazily(still, test_offset=1)
    assert [view.name for view in data.split()[1]] == ["1", "5"]
    fit(data, run, config(**fields, selection=active), progress=False)
    record = json.loads((run / "selection.json").read_text())
    assert record["start"][0]["index"] == starts[seed][0] != 0
    assert record["start"][0]["name"] == train[starts[seed][0]].name
    assert record["start_rule"] == Run(run).config()["fit"]["selection"]["start"] == "seed"
    assert Run(run).config()["fit"]["data"]["test_offset"] == 1
    assert Run(run).config()["test"] == ["1", "5"]
    (run / "metrics.json").unlink()
    assert cli.main(["eval", str(run), "--quiet"]) == 0
    assert [view["name"] for view in json.loads((run / "metrics.json").read_text())["views"]] == ["1", "5"]
    for words, other in (
        ("start was 'seed' and is 'first'", config(**fields, selection=plan())),
        (
            "the data set, --test-every or --test-offset has changed",
            config(**{**fields, "test_offset": 2}, selection=active),
        ),
    ):
        with pytest.raises(ValueError, match=words):
            fit(lazily(still), run, other, resume=True, progress=False)


def test_selection_json_is_complete(still, tmp_path, monkeypatch):
    """Every pick with what it was chosen by and from; the run's log, config and metrics agree."""
    from drgs.selection import policies

    sizes, choose = [], policies.choose

    def chosen(policy, pool):
        sizes.append(
            (*({(c.width, c.height) for c in cameras} for cameras in (pool.candidates, pool.train)), len(pool.train))
        )
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", chosen)
    active = plan(policy="fisher", criterion="eig", prior=Prior(1e-3), blocks=("geometry",), info_pixels=100)
    result = fit(lazily(still), tmp_path / "run", config(selection=active), progress=False)
    assert sizes == [({(10, 10)}, {(10, 10)}, 2), ({(10, 10)}, {(10, 10)}, 3)]
    record = json.loads((tmp_path / "run/selection.json").read_text())
    assert {key: record[key] for key in ("policy", "criterion", "prior", "initial", "add", "every", "info_pixels")} == {
        "policy": "fisher", "criterion": "eig", "prior": 1e-3, "initial": 2, "add": 2, "every": 4, "info_pixels": 100,
    }  # fmt: skip
    assert [pick["step"] for pick in record["picks"]] == [4, 8]
    for number, pick in enumerate(record["picks"], 1):
        scores = {row["name"]: row["score"] for row in pick["candidates"]}
        assert len(scores) == 5 - number
        assert record["pool"][pick["index"]] == pick["name"]
        assert pick["score"] == scores[pick["name"]] == max(scores.values())
        assert sum(pick["parts"].values()) == pytest.approx(pick["score"])
        assert pick["margin"] == pytest.approx(pick["score"] - sorted(scores.values())[-2])
        assert {"means", "rotations", "log_scales", "logit_opacities", "sh"} == set(pick["parts"])
        assert pick["seconds"] > 0
        assert (pick["policy"], pick["criterion"], pick["prior"]["value"]) == ("fisher", "eig", 1e-3)
    events = [event for event in result.run.events() if event["event"] == "pick"]
    assert [(event["name"], event["step"]) for event in events] == [(p["name"], p["step"]) for p in record["picks"]]
    names = [view["name"] for view in (*record["start"], *record["picks"])]
    assert fitted_views(result.run) == names == result.metrics["fitted"]
    assert cli.main(["eval", str(result.run.path), "--split", "train"]) == 0
    assert {view["name"] for view in json.loads((tmp_path / "run/metrics.json").read_text())["views"]} == set(names)
    assert result.run.config()["fit"]["selection"]["scoring"]["criterion"] == "eig"
    assert set(result.run.config()["pool"]) >= set(names)


@pytest.mark.parametrize(("mask", "empty"), [("object", True), ("valid", False), ("ignore", True)])
def test_scores_know_masks(still, tmp_path, monkeypatch, mask, empty):
    """Known views are asked within their masks, reduced as their cameras are; outside of an object is emptiness."""
    from drgs.selection import policies

    pools, choose = [], policies.choose

    def chosen(policy, pool):
        pools.append(pool)
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", chosen)
    options = plan(policy="fisher", blocks=("geometry", "backdrop"), info_pixels=SIZE * SIZE // 4, add=1)
    fit(lazily(still), tmp_path / "run", config(mask=mask, selection=options), progress=False)
    pool = pools[0]
    assert pool.empty_outside is empty
    assert len(pool.masks) == len(pool.train) == 2
    for camera, found in zip(pool.train, pool.masks, strict=True):
        assert camera.width * camera.height <= SIZE * SIZE // 4
        if mask == "ignore":
            assert found is None
            continue
        assert tuple(found.shape) == (camera.height, camera.width)
        whole = cv2.imread(str(still / f"masks/{camera.name}.png"), cv2.IMREAD_GRAYSCALE) / 255
        assert float(found.mean()) == pytest.approx(whole.mean(), abs=0.02)
        assert 0 < float(found.mean()) < 1
    pick = json.loads((tmp_path / "run/selection.json").read_text())["picks"][0]
    assert pick["blocks"] == ["geometry", "backdrop"]
    assert all(row["parts"]["backdrop"] >= 0 for row in pick["candidates"])


@pytest.mark.same_bits
def test_held_out_views_are_measured_on_the_way(still, tmp_path, monkeypatch):
    """At the numbers of views that are asked for, just before the next pick: as drgs.fitting.metrics measures that
    model; the fit is the same to the bit, and one that is killed between measuring and saving ends alike.
    """
    how, pick, left, own = config(deterministic=True), ActiveViews.pick, [2], []
    plain = fit(lazily(still), tmp_path / "plain", how.replace(selection=plan()), progress=False)
    held_out = load_frames(lazily(still).split(how.data.test_every)[1], how.data.max_pixels, how.data.mask)

    def measuring(self, scene, *rest):
        own.append(metrics.evaluate(scene, held_out, how.settings)["mean"])
        return pick(self, scene, *rest)

    monkeypatch.setattr(ActiveViews, "pick", measuring)
    found = fit(lazily(still), tmp_path / "run", how.replace(selection=plan(measure=(2, 3))), progress=False)
    assert plain.run.point_cloud.read_bytes() == found.run.point_cloud.read_bytes()
    assert plain.metrics["mean"] == found.metrics["mean"]
    measured = json.loads((tmp_path / "run/selection.json").read_text())["measured"]
    assert [(x["views"], x["step"]) for x in measured] == [(2, 4), (3, 8)]
    named = {*metrics.METRICS, *metrics.OBJECT, "depth_error"}  # what is of masks and of depth maps, too
    assert set(measured[0]["mean"]) == set(measured[0]["median"]) == named
    assert [x["mean"] for x in measured] == own

    def killed(self, *arguments):
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        return pick(self, *arguments)

    monkeypatch.setattr(ActiveViews, "pick", killed)
    with pytest.raises(KeyboardInterrupt):
        fit(lazily(still), tmp_path / "killed", how.replace(selection=plan(measure=(2, 3))), progress=False)
    monkeypatch.setattr(ActiveViews, "pick", pick)
    again = fit(
        lazily(still), tmp_path / "killed", how.replace(selection=plan(measure=(2, 3))), resume=True, progress=False
    )
    assert json.loads((tmp_path / "killed/selection.json").read_text())["measured"] == measured
    assert again.metrics["mean"] == found.metrics["mean"]


def test_a_fit_that_begins_again_goes_on_with_its_schedules(still, tmp_path, monkeypatch):
    """Other Gaussians of the same degree of SH; steps and photographs go on, and points are not added besides. A run
    that is killed in between ends in the same bits.
    """
    made = torch.rand(2, 9, 3, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(ActiveViews, "new_start", lambda self: (made[0] + len(self.picks), made[1]))
    monkeypatch.setattr(ActiveViews, "points", None)
    how = config(deterministic=True, sh_every=0.01, refine_start=0.9)
    a = fit(lazily(still), tmp_path / "a", how.replace(selection=plan()), progress=False)
    assert len(a.gaussians) == 9
    assert a.gaussians.sh.shape[1] == 4
    assert float(a.gaussians.means.min()) > 1  # those of the second pick
    picks = [event for event in a.run.events() if event["event"] == "pick"]
    assert [(event["step"], event["points"]) for event in picks] == [(4, 9), (8, 9)]
    assert load_state(a.run.state)[1]["step"] == 16
    step = Trainer.step

    def killed(self):
        if self.step_index == 6:
            raise Killed
        return step(self)

    monkeypatch.setattr(Trainer, "step", killed)
    with pytest.raises(Killed):
        fit(lazily(still), tmp_path / "b", how.replace(selection=plan()), progress=False)
    monkeypatch.setattr(Trainer, "step", step)
    b = fit(lazily(still), tmp_path / "b", how.replace(selection=plan()), resume=True, progress=False)
    assert a.run.point_cloud.read_bytes() == b.run.point_cloud.read_bytes()


def test_picked_view_brings_points_where_nothing_is(still):
    """An even share of the budget, inside the mask; none where Gaussians cover the view, or when not wanted."""
    train = lazily(still).split(4)[0]
    views = ActiveViews(train, config(max_gaussians=80, selection=plan()))
    assert views.reserved == 2 * 20
    frame = views.frames()[-1]

    def one(z, scale):
        return drgs.Gaussians.from_arrays([[0, 0, z]], [[1, 0, 0, 0]], [[scale] * 3], [0.999], np.zeros((1, 1, 3)))

    points, colors, dense = views.points(frame, one(1e4, 0.1))
    assert dense
    assert points.shape == colors.shape == (20, 3)
    columns, rows = frame.camera.project(points.numpy())[0].astype(int).T
    assert (frame.mask.numpy()[rows, columns] > 0.5).all()
    assert np.linalg.norm(points.numpy(), axis=1).max() < 2  # the blobs, not the background
    assert len(views.points(frame, one(0.0, 50.0))[0]) == 0
    for quiet in (plan(pick_points="none"), plan()):
        leak = quiet.pick_points == "auto"
        views = ActiveViews(train, config(max_gaussians=80, init_points="all" if leak else "auto", selection=quiet))
        assert views.reserved == 0
        assert len(views.points(frame, one(1e4, 0.1))[0]) == 0


def test_points_of_picked_views_keep_to_the_budget(still, tmp_path):
    """Density control leaves room for the views to come, and nothing exceeds --max-gaussians."""
    cfg = config(max_steps=30, max_gaussians=60, refine_start=0.0)
    result = fit(lazily(still), tmp_path / "run", cfg.replace(selection=plan(add=3, every=6)), progress=False)
    events = result.run.events()
    counts = {event["step"]: event["gaussians"] for event in events if event["event"] == "density"}
    assert max(count for step, count in counts.items() if step < 6) <= 60 - 3 * 12
    assert max(count for step, count in counts.items() if step < 12) <= 60 - 2 * 12
    assert max(counts.values()) == len(result.gaussians) <= 60
    assert all(isinstance(event["points"], int) for event in events if event["event"] == "pick")


def test_fitted_views_of_other_runs(still, tmp_path):
    """A fit to all views has no selection.json; a damaged or missing one is named."""
    fit(load(still, test_every=4), tmp_path / "all", config(max_steps=2), progress=False)
    assert not (tmp_path / "all/selection.json").exists()
    assert fitted_views(Run(tmp_path / "all")) == ["1", "2", "3", "5", "6", "7"]
    fit(lazily(still), tmp_path / "run", config(selection=plan()), progress=False)
    (tmp_path / "run/selection.json").write_text('{"start": 3}')
    with pytest.raises(ValueError, match="selection.json: start must be a list, got 3; move it away"):
        fitted_views(Run(tmp_path / "run"))
    (tmp_path / "run/selection.json").unlink()
    with pytest.raises(FileNotFoundError, match="must be the record of the chosen views, found none"):
        fitted_views(Run(tmp_path / "run"))


# ---- resuming


class Killed(BaseException):
    """As if the process had been killed."""


def without_times(path: Path) -> dict:
    record = json.loads(path.read_text())
    for pick in record["picks"]:
        del pick["seconds"]
    return record


@pytest.mark.every(3)
@pytest.mark.parametrize("policy", ["fisher", "random"])
@pytest.mark.parametrize("moment", ["between picks", "between choosing and saving"])
@pytest.mark.same_bits
def test_killed_run_picks_the_same_views(still, tmp_path, monkeypatch, policy, moment, two_threads):
    """With `deterministic`, a run killed after or during its second pick ends in the same bits."""
    active, cfg = plan(policy=policy, add=3), config(deterministic=True)
    fit(lazily(still), tmp_path / "a", cfg.replace(selection=active), progress=False)
    step, state = Trainer.step, Trainer.state

    def killed_step(self):
        if self.step_index == 10 and moment == "between picks":
            raise Killed
        return step(self)

    def killed_state(self):
        if len(self.frames) == 4 and moment != "between picks":  # two at the start, and two picks
            raise Killed
        return state(self)

    monkeypatch.setattr(Trainer, "step", killed_step)
    monkeypatch.setattr(Trainer, "state", killed_state)
    with pytest.raises(Killed):
        fit(lazily(still), tmp_path / "b", cfg.replace(selection=active), progress=False)
    monkeypatch.undo()
    header = load_state(tmp_path / "b/state.safetensors")[1]
    assert (header["step"], len(header["active"]["picks"])) == (8, 2 if moment == "between picks" else 1)
    assert len(without_times(tmp_path / "b/selection.json")["picks"]) == len(header["active"]["picks"])
    fit(lazily(still), tmp_path / "b", cfg.replace(selection=active), resume=True, progress=False)
    assert without_times(tmp_path / "a/selection.json") == without_times(tmp_path / "b/selection.json")
    assert (tmp_path / "a/point_cloud.ply").read_bytes() == (tmp_path / "b/point_cloud.ply").read_bytes()
    assert not list((tmp_path / "b").rglob("*.tmp"))


def test_a_resumed_run_still_says_what_it_began_with(still, tmp_path):
    """Also once photographs have been picked."""
    active = config(selection=plan())
    began = fit(lazily(still), tmp_path / "run", active, progress=False).run.config()["train"]
    again = fit(lazily(still), tmp_path / "run", active, resume=True, progress=False).run
    assert again.config()["train"] == began
    assert fitted_views(again)[:2] == began
    assert len(fitted_views(again)) == 4


def test_bad_resumes_are_refused(still, tmp_path):
    """Another policy, or all views instead, cannot continue an active run."""
    fit(lazily(still), tmp_path / "run", config(selection=plan()), progress=False)
    with pytest.raises(ValueError, match="--resume must continue the same fit, policy was 'farthest' and is 'random'"):
        fit(lazily(still), tmp_path / "run", config(selection=plan(policy="random")), resume=True, progress=False)
    with pytest.raises(ValueError, match="--views was 'active' and is 'all'"):
        fit(load(still, test_every=4), tmp_path / "run", config(), resume=True, progress=False)
    fit(load(still, test_every=4), tmp_path / "all", config(), progress=False)
    with pytest.raises(ValueError, match="--views was 'all' and is 'active'"):
        fit(lazily(still), tmp_path / "all", config(selection=plan()), resume=True, progress=False)
    fewer = lazily(still)
    fewer.views = fewer.views[:7]
    with pytest.raises(
        ValueError, match="must have the same training views, the data set, --test-every or --test-offset has"
    ):
        fit(fewer, tmp_path / "run", config(selection=plan()), resume=True, progress=False)


# ---- the command, and bad input


def test_command(still, tmp_path, capsys, caplog):
    """`drgs fit --views active` passes its options on, opens lazily, and says what to do next."""
    line = f"fit {still} -o {tmp_path / 'run'} --views active --policy coverage --initial 3 --add 1 --every 3"
    more = "--max-steps 6 --max-gaussians 60 --test-every 4 --seed 5 --prior 1e-4 --relative-prior --info-pixels 90"
    assert cli.main([*line.split(), *more.split()]) == 0
    record = json.loads((tmp_path / "run/selection.json").read_text())
    assert (record["policy"], record["seed"], record["relative_prior"]) == ("coverage", 5, True)
    assert (len(record["start"]), len(record["picks"])) == (3, 1)
    out, err = capsys.readouterr()
    assert "added view" in err
    assert len(re.findall(r"initial points: (?!\d)", err + caplog.text)) == 1
    assert f"\nnext: drgs view {tmp_path / 'run'}; " in out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--views active --add 0", "add must be >= 1, got 0; without --views active all views are used"),
        ("--views active --initial 0", "initial must be a whole number in [1, 1000000000], got 0"),
        ("--views active --every 0", "every must be a whole number in [1, 1000000000], or None, got 0"),
        ("--views active --initial 7 --add 1", "--initial 7 and --add 1 must be at most the 6 views of the training"),
        ("--views active --initial 2 --add 5 --every 1", "--initial 2 and --add 5 must be at most the 6 views"),
        ("--views active --add 4 --every 5", "must be there before step 20, the last one would come at 20"),
        ("--views active --prior -1", "lambda (value) must be in [0, inf), got -1"),
        ("--views active --info-pixels 0", "--info-pixels must be a whole number in [1, 1000000000], or None, got 0"),
        (
            "--views active --add 2 --every 4 --measure 2 4",
            "--measure must be numbers of views that one more is added to",
        ),
        ("--views active --add 2 --every 4 --measure 2 --test-every 0", "--measure must have held-out views, got none"),
        ("--policy random", "--policy must have --views active, got --views all"),
        ("--views active --policy best", "policy must be one of fisher, fisherrf, "),
    ],
)
def test_bad_options_are_one_line(still, tmp_path, capsys, options, message):
    """Exit code 2, one line, and no run folder."""
    line = f"fit {still} -o {tmp_path / 'run'} --max-steps 20 --test-every 4 {options}"
    try:
        assert cli.main(line.split()) == 2
    except SystemExit as end:  # usage errors leave as argparse's do
        assert end.code == 2  # noqa: PT017
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_unknown_names_are_refused(still):
    """In Python, too; a policy of one's own that is not there before the first step, not at the first pick."""
    for field in ("policy", "criterion", "method"):
        with pytest.raises(ValueError, match=f"active: {field} must be one of .*, got 'best'"):
            SelectionConfig().replace(**{field: "best"})
    with pytest.raises(ValueError, match="at least one training view, got none"):
        ActiveViews([], config(selection=plan()))
    with pytest.raises(ValueError, match="--policy nosuch.module:fn: must be importable"):
        ActiveViews(lazily(still).split()[0], config(selection=plan(policy="nosuch.module:fn")))
