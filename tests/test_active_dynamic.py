"""Active fits over (camera, time): which images are read and when, what is recorded, resuming, and bad options."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from test_active import Killed, opened, without_times  # noqa: F401  (a fixture)
from test_data import save, write_image
from test_dynamic_data import cameras, coded, write_poses, write_video

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, orbit
from drgs.data import load
from drgs.data.videos import VideoFrame
from drgs.files import Run, load_state
from drgs.fitting.active import ActiveViews
from drgs.fitting.config import SelectionConfig
from drgs.fitting.records import fitted_views
from drgs.fitting.timetable import Timetable
from drgs.select import select
from drgs.train import FitConfig, Trainer, fit

SIZE, CAMERAS, TIMES = 20, 5, 4


def write_swing(folder: Path) -> None:
    """A transforms.json data set: five cameras at four times each, of blobs half of which move; the first camera is
    the test split. Views are named camC/T.
    """
    generator = torch.Generator().manual_seed(3)
    n = 24
    means = torch.randn(n, 3, generator=generator) * 0.4
    blobs = drgs.Gaussians.from_arrays(
        means,
        torch.randn(n, 4, generator=generator),
        0.08 + 0.12 * torch.rand(n, 3, generator=generator),
        torch.full((n,), 0.9),
        torch.rand(n, 1, 3, generator=generator) * 3 - 1,
    )
    ring = orbit((0, 0, 0), 3.0, CAMERAS, width=SIZE, height=SIZE)
    K, frames = ring[0].K, {"train": [], "test": []}
    lens = {"w": SIZE, "h": SIZE, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    for t in range(TIMES):
        shift = torch.zeros(n, 3)
        shift[: n // 2, 1] = 0.3 * t / (TIMES - 1)
        moved = blobs.replace(means=means + shift)
        for c, camera in enumerate(ring):
            name = f"cam{c}/{t}.png"
            image = drgs.render(moved, camera, drgs.RenderSettings.preset("fast")).rgb
            write_image(folder / name, (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
            frame = {"transform_matrix": c2w_to_opengl(camera.c2w).tolist(), "time": t / (TIMES - 1)}
            frames["test" if c == 0 else "train"].append({"file_path": name, **frame})
    for split, listed in frames.items():
        save(folder, {**lens, "frames": listed}, f"transforms_{split}.json")


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swing")
    write_swing(folder)
    return folder


def lazily(folder: Path):
    return load(folder, lazy=True, points=False)


def config(**fields) -> FitConfig:
    """8 steps of the static stage and 16 of the dynamic one."""
    return FitConfig().replace(
        **{
            "renderers": ("fast",),
            "max_steps": 24,
            "static_share": 1 / 3,
            "max_gaussians": 60,
            "sh_degree": 1,
            "save_every": 1000,
            **fields,
        }
    )


def plan(**fields) -> SelectionConfig:
    return SelectionConfig().replace(**{"policy": "random", "schedule": "times", "every": 4, **fields})


def selection_of(run: Path) -> dict:
    return json.loads((run / "selection.json").read_text())


# ---- when, and among which


def test_numbers_are_those_of_the_paper(swing):
    """At 17,000 steps with 40 times: the static stage has 3,000, a pick comes every 200, the last of 39 at 10,800. A
    tenth of the steps has a tenth of all numbers.
    """
    view = lazily(swing).split()[0][0]
    views = [
        dataclasses.replace(view, name=f"{c}/{t}", camera=dataclasses.replace(view.camera, time=t / 39))
        for c in range(3)
        for t in range(40)
    ]
    for part in (1, 10):
        whole = FitConfig(max_steps=17_000 // part, selection=SelectionConfig())
        table = Timetable.of(views, whole, moves=True)
        assert (table.schedule, table.add, table.every, table.first) == ("times", 39, 200 // part, 3200 // part)
        assert [table.due(step // part) for step in (0, 3190, 3200, 3390, 3400, 10_790, 10_800, 17_000)] == [
            0, 0, 1, 1, 2, 38, 39, 39,
        ]  # fmt: skip
    assert [views[i].camera.time for i in table.start] == [0.0] * 3
    for number in range(39):
        there = [views[i] for i in table.left(number, table.start)]
        assert [view.name for view in there] == [f"{c}/{number + 1}" for c in range(3)]
    frequent = Timetable.of(views, FitConfig().replace(max_steps=1700, every=3), moves=True)
    assert frequent.first == 320, "the first pick waits for 200 of 17,000 steps, however often there is one"


def test_a_schedule_follows_from_what_is_fitted(swing):
    """`auto` is `times` where a deformation is fitted and `views` where none is."""
    views = lazily(swing).split()[0]
    assert [Timetable.of(views, FitConfig().replace(add=2), moves).schedule for moves in (True, False)] == [
        "times",
        "views",
    ]


@pytest.mark.slow
def test_one_camera_at_each_later_time(swing, tmp_path, opened):  # noqa: F811
    """All cameras at the first time, then one at each later time, in order; an image is opened once it is picked, and
    no other image of a training camera ever. What the fit found out by itself may be stated on resuming, not changed.
    """
    fit(lazily(swing), tmp_path / "run", config(selection=plan(every=None)), progress=False)
    record = selection_of(tmp_path / "run")
    assert [view["name"] for view in record["start"]] == [f"cam{c}/0" for c in range(1, CAMERAS)]
    picks = record["picks"]
    assert [pick["time"] for pick in picks] == pytest.approx([t / (TIMES - 1) for t in range(1, TIMES)])
    assert [pick["step"] for pick in picks] == [9, 10, 11]
    for t, pick in enumerate(picks, 1):
        assert [other["name"] for other in pick["candidates"]] == [f"cam{c}/{t}" for c in range(1, CAMERAS)]
        assert pick["name"] == f"cam{pick['index'] // TIMES + 1}/{t}"
        assert pick["seconds"] > 0
    assert (record["schedule"], record["add"], record["every"], record["initial"]) == ("times", 3, 1, 4)
    seen = {str(Path(text).relative_to(swing)) for text in opened if swing in Path(text).parents}
    images = {name.removesuffix(".png") for name in seen if name.endswith(".png")}
    assert images == {f"cam0/{t}" for t in range(TIMES)} | set(fitted_views(Run(tmp_path / "run")))
    for pick in picks:
        assert opened.index(str(swing / f"{pick['name']}.png")) > opened.index(f"picked {pick['name']}")
    stated = plan(add=TIMES - 1, every=1)
    fit(lazily(swing), tmp_path / "run", config(selection=stated), resume=True, progress=False)
    with pytest.raises(ValueError, match="must continue the same fit, add was 3 and is 2"):
        fit(lazily(swing), tmp_path / "run", config(selection=plan(add=2)), resume=True, progress=False)


@pytest.mark.slow
def test_pairs_are_picked_freely(swing, tmp_path):
    """Any camera at any later time, as many as the budget says; by default one for each later time. The command passes
    its options on.
    """
    line = f"fit {swing} -o {tmp_path / 'run'} --views active --schedule pairs --add 4 --every 2 --policy coverage"
    line += " --max-steps 24 --max-gaussians 60 --sh-degree 1 --quiet"
    assert cli.main(line.split()) == 0
    record = selection_of(tmp_path / "run")
    assert (record["schedule"], record["policy"]) == ("pairs", "coverage")
    later = {f"cam{c}/{t}" for c in range(1, CAMERAS) for t in range(1, TIMES)}
    assert {other["name"] for other in record["picks"][0]["candidates"]} == later
    names = [pick["name"] for pick in record["picks"]]
    assert len(set(names)) == 4
    assert set(names) <= later
    assert {other["name"] for other in record["picks"][3]["candidates"]} == later - set(names[:3])
    assert Timetable.of(lazily(swing).split()[0], config(selection=plan(schedule="pairs")), True).add == TIMES - 1


def test_one_camera_that_moves_about_begins_with_views_spread_in_time(swing, tmp_path):
    """With one photograph at each time nothing could be fitted to the first time: --initial says with how many views,
    and any other is a candidate, earlier ones included. Without it a line says so.
    """
    views = [view for view in lazily(swing).split()[0] if int(view.name[3]) == 1 + int(view.name[5]) % (CAMERAS - 1)]
    assert len({view.camera.time for view in views}) == len(views) == TIMES
    for schedule in ("times", "pairs"):
        with pytest.raises(ValueError, match="two cameras or more at the first time, got one, .*--initial, e.g. 4"):
            ActiveViews(views, config(selection=plan(schedule=schedule)), moves=True)
    for seed in range(4):
        active = plan(schedule="pairs", initial=3, start="seed", add=1)
        table = ActiveViews(views, config(selection=active, seed=seed), moves=True).timetable
        assert len(set(table.start)) == 3
        assert set(table.start) | set(table.left(0, table.start)) == set(range(TIMES))
    with pytest.raises(ValueError, match="at most the 1 training views besides the initial ones, got 10"):
        ActiveViews(views, config(selection=plan(schedule="pairs", initial=3)), moves=True)

    line = f"fit {swing} -o {tmp_path / 'run'} --views active --schedule pairs --initial 6 --start seed --add 2"
    line += " --every 2 --policy uniform --max-steps 24 --max-gaussians 60 --sh-degree 1 --quiet"
    assert cli.main(line.split()) == 0
    record = selection_of(tmp_path / "run")
    assert record["initial"] == 6
    start = fitted_views(Run(tmp_path / "run"))[:6]
    assert len({name.split("/")[1] for name in start}) == TIMES
    assert len(record["picks"][0]["candidates"]) == (CAMERAS - 1) * TIMES - 6


def test_the_first_pick_knows_of_the_field(swing, tmp_path):
    """The field begins at rest, where its first layers have no information; at the first pick both of its groups have
    some, in the pick and in every candidate, and the parts add up to the score.
    """
    active = plan(policy="fisher", blocks=("geometry", "deformation"), add=1, probes=2, info_pixels=100, every=1)
    fit(lazily(swing), tmp_path / "run", config(max_steps=12, field_preset="dnerf", selection=active), progress=False)
    (pick,) = selection_of(tmp_path / "run")["picks"]
    assert pick["blocks"] == ["geometry", "deformation"]
    for scored in (pick, *pick["candidates"]):
        assert scored["parts"]["grid"] > 0
        assert scored["parts"]["mlp"] > 0
        assert sum(scored["parts"].values()) == pytest.approx(scored["score"])
    best, second = sorted((other["score"] for other in pick["candidates"]), reverse=True)[:2]
    assert (pick["score"], pick["margin"]) == (best, pytest.approx(best - second))


# ---- resuming


@pytest.mark.slow
@pytest.mark.same_bits
def test_killed_fits_pick_the_same(swing, tmp_path, monkeypatch):
    """With `deterministic`, a fit killed in the static stage and between two picks ends in the same picks and bits."""
    import drjit as dr

    threads, cfg, active, whole = dr.thread_count(), config(deterministic=True, save_every=5), plan(), Trainer.step

    def run(name, resume=False):
        fit(lazily(swing), tmp_path / name, cfg.replace(selection=active), resume=resume, progress=False)

    def killed(self):
        if self.step_index in deaths:
            deaths.remove(self.step_index)
            raise Killed
        return whole(self)

    deaths = [6, 18]
    try:
        run("a")
        monkeypatch.setattr(Trainer, "step", killed)
        for number, saved in enumerate((5, 16)):
            with pytest.raises(Killed):
                run("b", resume=number > 0)
            assert load_state(tmp_path / "b/state.safetensors")[1]["step"] == saved
        run("b", resume=True)
    finally:
        dr.set_thread_count(threads)
    assert without_times(tmp_path / "a/selection.json") == without_times(tmp_path / "b/selection.json")
    assert (tmp_path / "a/point_cloud.ply").read_bytes() == (tmp_path / "b/point_cloud.ply").read_bytes()


# ---- options, and bad input


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"every": 8},
            "must have its 3 picks, one --every 8 steps after the static stage of 8, before step 24, the la",
        ),
        ({"add": 4}, "--schedule times must have --add of at most the 3 later times, got 4"),
        ({"schedule": "pairs", "add": 13}, "at most the 12 training views at later times, got 13"),
        ({"initial": 3}, "must begin with all cameras at the first time, got --initial 3; drop it"),
        ({"start": "seed"}, "must begin with all cameras at the first time, got --start seed; drop it"),
        ({"start": "seed", "schedule": "pairs"}, "got --start seed; drop it, or name --initial, too"),
        ({"pick_points": "uncovered"}, "must have --pick-points auto or none, got uncovered"),
        ({"schedule": "views", "add": 2}, "--schedule must be times or pairs where a deformation is fitted, got views"),
    ],
)
def test_what_does_not_go_together_is_one_line(swing, fields, message):
    with pytest.raises(ValueError, match=message) as error:
        ActiveViews(lazily(swing).split()[0], config(selection=plan(**fields)), moves=True)
    assert "\n" not in str(error.value)


def test_a_single_time_has_no_later_ones(swing):
    views = [view for view in lazily(swing).split()[0] if view.camera.time == 0.0]
    with pytest.raises(ValueError, match="--schedule times must have training views of two times or more, got one"):
        ActiveViews(views, config(selection=plan()))
    timeless = [dataclasses.replace(view, camera=dataclasses.replace(view.camera, time=None)) for view in views]
    with pytest.raises(ValueError, match="must have a time of every view, 'cam1/0' has none"):
        ActiveViews(timeless, config(selection=plan()))
    with pytest.raises(ValueError, match="must fit what moves, got --dynamics ignore"):
        ActiveViews(views, config(dynamics="ignore", selection=plan()))


def test_blocks_of_what_is_not_fitted_are_refused(swing, tmp_path):
    """Before the first step, and no run folder is begun."""
    still = config(dynamics="ignore")
    for block, why in (("semantic", "a fit without a teacher's maps"), ("deformation", "a fit of what is still")):
        active = plan(schedule="views", policy="fisher", add=2, blocks=("geometry", block))
        with pytest.raises(ValueError, match=f"blocks must be of what is fitted, got {block} for {why}; use geometry"):
            fit(lazily(swing), tmp_path / "run", still.replace(selection=active), progress=False)
        assert not (tmp_path / "run/config.json").exists()


# ---- policies over (camera, time)


def picks_of(policy: str, count_of_cameras: int, times: int, schedule: str, count: int) -> list[tuple[int, int]]:
    """(camera, time) of so many picks, cameras on a line one unit apart, all known at the first time."""
    K, known = intrinsics(20, 20, 8, 8), []

    def at(c: int, t: int) -> Camera:
        w2c = np.eye(4)
        w2c[0, 3] = -float(c)
        return Camera(K, w2c, 16, 16, name=f"cam{c}/{t}", time=t / (times - 1))

    scene, found = drgs.Gaussians.from_arrays([[0, 0, 5]], [[1, 0, 0, 0]], [[1] * 3], [0.5], np.zeros((1, 1, 3))), []
    for number in range(count):
        later = [number + 1] if schedule == "times" else range(1, times)
        pool = [(c, t) for t in later for c in range(count_of_cameras) if (c, t) not in found]
        train = [at(c, 0) for c in range(count_of_cameras)] + known
        best = select(scene, [at(c, t) for c, t in pool], train, 1, policy).picks[0]
        found.append(pool[best.index])
        known.append(at(*found[-1]))
    return found


def test_uniform_takes_every_camera_and_every_time_alike():
    """After as many picks as cameras each has been picked once, and the first ones are spread; of pairs, times too."""
    chosen = [c for c, _ in picks_of("uniform", 7, 15, "times", 14)]
    assert chosen[:3] == [3, 1, 5]
    assert sorted(chosen[:7]) == sorted(chosen[7:]) == list(range(7))
    pairs = picks_of("uniform", 3, 7, "pairs", 6)
    assert sorted(t for _, t in pairs) == [1, 2, 3, 4, 5, 6]
    assert pairs[0] == (1, 3)
    assert sorted(c for c, _ in pairs) == [0, 0, 1, 1, 2, 2]


def test_farthest_knows_that_a_camera_is_new_at_another_time():
    """The ends of the line first, not index 0 again and again; no camera twice in a row; pairs are spread in time."""
    chosen = [c for c, _ in picks_of("farthest", 7, 15, "times", 14)]
    assert set(chosen[:2]) == {0, 6}
    assert all(a != b for a, b in zip(chosen, chosen[1:], strict=False))
    assert len(set(chosen)) >= 5
    pairs = picks_of("farthest", 3, 7, "pairs", 6)
    assert pairs[0][1] == 6, "the last time is farthest from the first one"
    assert len({t for _, t in pairs}) >= 3


# ---- videos


def test_no_frame_of_a_video_is_decoded_before_it_is_picked(tmp_path, monkeypatch):
    """Of Neu3D's layout: the frames that are asked for are those of the test camera, of the first time and of picks."""
    for k in range(4):
        write_video(tmp_path / f"data/cam{k:02d}.mp4", [coded(i, k) for i in range(6)])
    write_poses(tmp_path / "data", cameras())
    seen, read = [], VideoFrame.read

    def spied(self):
        seen.append(f"{self.path.stem}/{self.index:04d}")
        return read(self)

    monkeypatch.setattr(VideoFrame, "read", spied)
    data = load(tmp_path / "data", lazy=True, points=False, times=3)
    assert not seen
    fit(data, tmp_path / "run", config(max_steps=12, selection=plan(every=3)), progress=False)
    record = selection_of(tmp_path / "run")
    assert [(pick["camera"], pick["time"]) for pick in record["picks"]] == [
        (pick["name"].split("/")[0], time) for pick, time in zip(record["picks"], (0.4, 1.0), strict=True)
    ]
    assert [view["camera"] for view in record["start"]] == ["cam01", "cam02", "cam03"]
    assert set(seen) == {"cam00/0000", "cam00/0002", "cam00/0005", *fitted_views(Run(tmp_path / "run"))}
