"""Claims of drgs.fitting.resolution: what steps see is small at first, and nothing else knows of it."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import test_dynamic_fit
import torch
from test_active import plan
from test_semantic_fit import MAP, semantic_trainer, taught  # noqa: F401 (a fixture)
from test_train import SIZE, config, dataset, masked, trainer_of  # noqa: F401 (a fixture)

from drgs.cameras import Camera, intrinsics, look_at
from drgs.deform import FieldConfig
from drgs.files import Run, load_state
from drgs.fitting import metrics, resolution, trainer
from drgs.fitting.components.base import Setup
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.losses import ssim_map
from drgs.fitting.resolution import Resolution, halved_size, updates_of
from drgs.selection import policies
from drgs.train import FitConfig, Trainer, fit


def photograph(width: int, height: int, rng: np.random.Generator, **fields) -> Frame:
    """Noise, of a camera that looks at the origin past the middle of its image."""
    pose = look_at((0.3, 0.2, -3.0), (0, 0, 0), (0, -1, 0))
    camera = Camera(intrinsics(60.0, 70.0, 0.4 * width, 0.55 * height), pose, width, height)
    return Frame("a", camera, torch.from_numpy(rng.random((height, width, 3), np.float32)), **fields)


@pytest.fixture
def seen(monkeypatch):
    """(width, height, time) of every picture that a step has rendered."""
    found = []
    render = trainer.render

    def spied(gaussians, camera, *rest, **options):
        found.append((camera.width, camera.height, camera.time))
        return render(gaussians, camera, *rest, **options)

    monkeypatch.setattr(trainer, "render", spied)
    return found


def test_sizes_follow_from_the_step_alone():
    """Two halvings go in equal shares of the first half of the steps; without any there is nothing to tell."""
    schedule = Resolution(2, 12)
    assert [schedule.halvings(step) for step in range(12)] == [2] * 3 + [1] * 3 + [0] * 6
    assert [Resolution(0, 12).halvings(step) for step in range(12)] == [0] * 12
    assert {Resolution(16, 2).halvings(step) for step in (1, 2)} == {0}


def test_each_size_is_told_once(rng):
    """At the first step that has it, the last of those that a very short fit goes through at once."""
    frames = [photograph(101, 75, rng)]
    told = {step: Resolution(2, 12).events(step, frames) for step in range(12)}
    assert {step: events[0]["halvings"] for step, events in told.items() if events} == {0: 2, 3: 1, 6: 0}
    assert told[0] == [{"event": "resolution", "halvings": 2, "width": 25, "height": 18}]
    assert [(told[step][0]["width"], told[step][0]["height"]) for step in (3, 6)] == [(50, 37), (101, 75)]
    assert not any(Resolution(0, 12).events(step, frames) for step in range(12))
    assert [len(Resolution(8, 2).events(step, frames)) for step in range(2)] == [1, 1]


def test_no_picture_is_smaller_than_the_window_of_ssim():
    """The window's width, measured on the map of a picture that differs in one pixel, is where halving stops."""
    image = torch.full((41, 41, 1), 0.5)
    other = image.clone()
    other[20, 20] = 0.9
    assert int((ssim_map(image, other) < 1 - 1e-9).any(0).sum()) == resolution._LEAST
    assert [halved_size(504, 378, times) for times in range(4)] == [(504, 378), (252, 189), (126, 94), (63, 47)]
    assert halved_size(504, 378, 16) == (15, 11)
    assert halved_size(44, 100, 16) == (11, 25)
    assert halved_size(43, 100, 16) == (21, 50)
    assert halved_size(21, 100, 16) == (21, 100)
    assert halved_size(5, 5, 1) == (5, 5)


@pytest.mark.parametrize("size", [(96, 64), (101, 75)], ids=["even", "odd"])
def test_means_are_kept(rng, size):
    """Of pixels, mask and alpha, to float32's rounding (measured 1e-7), to half a level of 256 where pixels are bytes;
    the types stay."""
    mask = torch.from_numpy((rng.random(size[::-1]) > 0.3).astype(np.float32))
    frame = photograph(*size, rng, mask=mask, is_object=True, alpha=mask)
    small = Resolution(2, 12).resized(0, frame, 0)
    assert small.pixels.shape == (size[1] // 4, size[0] // 4, 3)
    assert torch.allclose(small.pixels.mean((0, 1)), frame.pixels.mean((0, 1)), rtol=0, atol=2e-6)
    assert float(small.mask.mean()) == pytest.approx(float(mask.mean()), abs=2e-6)
    assert torch.equal(small.alpha, small.mask)
    assert 0 <= float(small.mask.min()) < float(small.mask.max()) <= 1
    assert small.is_object
    eight = dataclasses.replace(frame, pixels=(frame.pixels * 255).round().to(torch.uint8))
    bytes_seen = Resolution(2, 12).resized(0, eight, 0)
    assert bytes_seen.pixels.dtype == torch.uint8
    assert torch.allclose(bytes_seen.image(), small.pixels, rtol=0, atol=1.01 / 255)
    assert torch.allclose(bytes_seen.image().mean((0, 1)), small.pixels.mean((0, 1)), rtol=0, atol=0.5 / 255)


def test_the_camera_shows_the_same_at_the_same_place(rng):
    """Points are at the same share of width and height, at the same depth, also where halves are rounded."""
    frame = photograph(101, 75, rng)
    points = rng.normal(size=(50, 3))
    before, depth = frame.camera.project(points)
    for step in (0, 3):
        camera = Resolution(2, 12).resized(0, frame, step).camera
        after, same = camera.project(points)
        assert np.allclose(after / (camera.width, camera.height), before / (101, 75), rtol=1e-12, atol=1e-12)
        assert np.array_equal(same, depth)


def test_a_pixel_is_transient_where_any_of_its_own_is(rng):
    """One pixel in the corner of a block makes the block's one; a mask that is renewed is seen at once."""
    transient = torch.zeros(64, 96, dtype=torch.bool)
    transient[7, 12] = True
    schedule, frame = Resolution(1, 12), photograph(96, 64, rng, transient=transient)
    assert schedule.resized(0, frame, 0).transient.nonzero().tolist() == [[3, 6]]
    frame.transient = ~transient
    assert schedule.resized(0, frame, 1).transient.all()
    frame.transient = None
    assert schedule.resized(0, frame, 2).transient is None


def test_pictures_are_made_once_a_size_and_then_dropped(rng):
    """The same tensor at every visit; none of a size that is over, and at its own size the photograph itself."""
    schedule, frames = Resolution(2, 12), [photograph(96, 64, rng) for _ in range(3)]
    first = [schedule.resized(i, frame, 0).pixels for i, frame in enumerate(frames)]
    assert all(schedule.resized(i, frame, 2).pixels is first[i] for i, frame in enumerate(frames))
    assert not torch.equal(first[0], first[1])
    assert schedule.resized(1, frames[1], 3).pixels.shape == (32, 48, 3)
    assert list(schedule._kept) == [1]
    assert schedule.resized(1, frames[1], 6) is frames[1]
    assert not schedule._kept
    assert Resolution(0, 12).resized(0, frames[0], 0) is frames[0]


def test_small_pictures_are_those_of_their_camera_once_a_photograph_is_dropped(dataset):  # noqa: F811
    """Indices of those behind it change."""
    made = trainer_of(dataset, config(num_downscales=1))
    for i, frame in enumerate(made.frames):
        made.resolution.resized(i, frame, 0)
    made.drop_frame(made.frames[1].name)
    kept = made.resolution.resized(1, made.frames[1], 0)
    assert torch.equal(kept.pixels, Resolution(1, 60).resized(0, made.frames[1], 0).pixels)


def test_a_step_has_several_updates_until_it_sees_whole_photographs(rng):
    """Small ones in the first half, quarters until 0.8 of the steps; with one update a step there are no quarters."""
    schedule, frames = Resolution(1, 20, 3), [photograph(101, 75, rng)]
    assert [schedule.updates(step) for step in range(20)] == [3] * 16 + [1] * 4
    assert [schedule.halvings(step) for step in range(20)] == [1] * 10 + [0] * 10
    assert [schedule.has_parts(step) for step in range(20)] == [False] * 10 + [True] * 6 + [False] * 4
    told = {step: events[0] for step in range(20) if (events := schedule.events(step, frames))}
    assert {step: (e["width"], e["height"], e["updates"]) for step, e in told.items()} == {
        0: (50, 37, 3),
        10: (51, 38, 3),
        16: (101, 75, 1),
    }
    assert schedule.describe(told[10]) == "photographs of 51x38, 3 a step"
    assert schedule.describe(told[16]) == "photographs of 101x75"
    assert [Resolution(0, 20, 3).has_parts(step) for step in range(20)] == [True] * 16 + [False] * 4
    assert not any(Resolution(1, 20).has_parts(step) for step in range(20))


@pytest.mark.parametrize("size", [(96, 64), (101, 75)], ids=["even", "odd"])
def test_quarters_are_parts_of_the_photograph(rng, size):
    """Pixels, mask, alpha and what is transient are those that the quarter's camera shows, and all four are drawn."""
    width, height = size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    place = torch.from_numpy(np.stack([x, y, 0 * x], -1).astype(np.float32))
    plane = place[..., 0] + width * place[..., 1]
    frame = dataclasses.replace(
        photograph(*size, rng), pixels=place, mask=plane, alpha=plane, transient=plane.long() % 2 == 1
    )
    generator = torch.Generator().manual_seed(0)
    points = rng.normal(size=(50, 3))
    whole, depth = frame.camera.project(points)
    corners = set()
    for _ in range(40):
        part = Resolution(0, 10, 2).seen(0, frame, 0, generator)
        corner = part.pixels[0, 0, :2].tolist()
        corners.add(tuple(corner))
        assert part.pixels.shape == ((height + 1) // 2, (width + 1) // 2, 3)
        assert (part.camera.height, part.camera.width) == part.pixels.shape[:2]
        assert torch.equal(part.pixels[..., 0] + width * part.pixels[..., 1], part.mask)
        assert torch.equal(part.alpha, part.mask)
        assert torch.equal(part.transient, part.mask.long() % 2 == 1)
        after, same = part.camera.project(points)
        assert np.allclose(after + corner, whole, rtol=1e-12, atol=1e-9)
        assert np.array_equal(same, depth)
    assert corners == {(x, y) for x in (0, width // 2) for y in (0, height // 2)}


def test_updates_of_a_step_see_other_photographs(dataset, seen, monkeypatch):  # noqa: F811
    """Steps go on counting as they did: schedules, density control and renderers by step, photographs by update."""
    made = trainer_of(dataset, config(max_steps=10, updates_per_step=3))
    names = []
    next_view = made._next_view

    def spied() -> int:
        names.append(next_view())
        return names[-1]

    monkeypatch.setattr(made, "_next_view", spied)
    results = [made.step() for _ in range(10)]
    assert made.step_index == 10
    assert [side for side, *_ in seen] == [SIZE // 2] * 24 + [SIZE] * 2
    count = len(made.frames)
    assert all(sorted(names[k : k + count]) == list(range(count)) for k in range(0, 26 - count, count))
    assert [result.view for result in results] == [made.frames[names[k]].name for k in [*range(2, 24, 3), 24, 25]]


def test_large_photographs_have_several_updates_by_default(dataset, tmp_path, monkeypatch):  # noqa: F811
    """Of a plain fit; config.json says so, and a fit that was stopped goes on with it, whatever is large then."""
    monkeypatch.setattr(resolution, "LARGE", SIZE * SIZE)

    def updates(folder: str, steps: int = 4, **use) -> int:
        given = {name: use.pop(name) for name in ("resume", "begin") if name in use}
        fit(dataset, tmp_path / folder, config(max_steps=steps, **use), progress=False, **given)
        return Run(tmp_path / folder).config()["fit"]["data"]["updates_per_step"]

    assert updates("large") == resolution.UPDATES
    assert updates("active", 12, selection=plan()) == 1
    assert updates("again", begin=tmp_path / "large" / "state.safetensors") == 1
    assert updates("stated", updates_per_step=2) == 2
    assert updates("many", max_gaussians=SIZE * SIZE // 2 + 1) == 1
    monkeypatch.setattr(resolution, "LARGE", SIZE * SIZE + 1)
    assert updates("large", resume=True) == resolution.UPDATES
    assert updates("small") == 1


@pytest.mark.parametrize(
    ("field", "on", "off"),
    [
        ("teacher", {}, {"semantics": "ignore"}),
        ("depth", {"depth": "auto"}, {}),
        ("relative_depth", {"depth": "on"}, {}),
    ],
)
def test_maps_are_not_fitted_to_by_parts(dataset, rng, field, on, off):  # noqa: F811
    """A quarter of a photograph would be compared with the whole map of a teacher, or of depth."""
    frames = [photograph(32, 24, rng, **{field: lambda: None})]

    def updates(**use) -> int:
        return updates_of(Setup(dataset, config(**use), [], [], [], (), [], frames=frames))

    with pytest.raises(ValueError, match=r"updates_per_step must be 1 where .* fitted to, got 3; leave it out"):
        updates(updates_per_step=3, **on)
    assert updates(updates_per_step=3, **off) == 3
    assert updates(updates_per_step=1, **on) == updates(**on) == 1


def test_steps_alone_see_small_pictures(dataset, tmp_path, seen):  # noqa: F811
    """Steps render 16 pixels until half of them are done, then 32; pictures and PSNR of the run, which are those of its
    Gaussians, have 32 throughout, and the log says when which size began."""
    settings = config(max_steps=20, num_downscales=1)
    result = fit(dataset, tmp_path / "run", settings, progress=False)
    assert [side for side, *_ in seen] == [SIZE // 2] * 10 + [SIZE] * 10
    told = [(e["step"], e["halvings"], e["width"]) for e in result.run.events() if e["event"] == "resolution"]
    assert told == [(0, 1, SIZE // 2), (10, 0, SIZE)]
    assert cv2.imread(str(result.run.renders / "preview_000002.png")).shape == (SIZE, 2 * SIZE, 3)
    assert cv2.imread(str(result.run.renders / "test" / "8.png")).shape[0] == SIZE
    held_out = load_frames(dataset.split()[1], settings.data.max_pixels)
    assert held_out[0].camera.width == SIZE
    again = metrics.evaluate(result.gaussians, held_out, settings.settings)
    assert result.metrics["mean"]["psnr"] == pytest.approx(again["mean"]["psnr"], abs=1e-4)
    assert result.run.config()["fit"]["data"]["num_downscales"] == 1


def test_without_it_nothing_is_told_or_kept(dataset):  # noqa: F811
    """The default: no event, and steps see the photographs themselves."""
    made = trainer_of(dataset, config())
    events = [event["event"] for _ in range(3) for event in made.step().events]
    assert "resolution" not in events
    assert not made.resolution._kept


@pytest.mark.same_bits
@pytest.mark.parametrize(("updates", "stop"), [(1, 7), (3, 12)], ids=["whole", "parts"])
def test_a_resumed_fit_has_the_same_bits(dataset, whole_and_resumed, seen, updates, stop):  # noqa: F811
    """Stopped while steps see small photographs, or parts of them, a run ends as one without a stop."""
    use = {"num_downscales": 1, "updates_per_step": updates, "deterministic": True}
    runs = whole_and_resumed(dataset, config(max_steps=20, save_every=5, **use), stop)
    states = [load_state(run.state)[0] for run in runs]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    small = 10 if updates == 1 else 16 * updates
    assert [side for side, *_ in seen][: small + 4] == [SIZE // 2] * small + [SIZE] * 4


@pytest.mark.slow
@pytest.mark.same_bits
def test_everything_goes_on_with_the_same_bits(dataset):  # noqa: F811
    """Masks, gains, poses, the 3D filter and what is transient together: from a checkpoint after the first look, while
    pictures are small, to some steps at the full size."""
    use = {"exposure": "learned", "poses": "refined", "filter_3d": "on", "transients": "mask"}
    settings = config(max_steps=80, num_downscales=1, **use)

    frames = trainer_of(masked(dataset), settings).frames
    made = Trainer(settings, frames, trainer_of(dataset, settings).rows, 3.0)
    made.component("exposure").use(settings, frames)
    made.component("poses").use(made, 2.0)
    told = [event["event"] for _ in range(33) for event in made.step().events]
    assert "transients" in told
    frames = trainer_of(masked(dataset), settings).frames
    tensors, header = made.state()
    tensors = {name: x.clone() for name, x in tensors.items()}
    again = Trainer.from_state(settings, frames, tensors, json.loads(json.dumps(header)), "checkpoint")
    ends = []
    for each in (made, again):
        told = [event for _ in range(10) for event in each.step().events if event["event"] == "resolution"]
        assert told == [{"event": "resolution", "halvings": 0, "width": SIZE, "height": SIZE}]
        ends.append(each.state()[0])
        assert {camera.width for camera in each.component("poses").module.cameras()} == {SIZE}
    assert ends[0].keys() == ends[1].keys()
    assert all(torch.equal(x, ends[1][name]) for name, x in ends[0].items())
    assert {name.split(".")[0] for name in ends[0]} >= {"exposure", "poses", "filter_3d"}


@pytest.mark.slow
def test_reach_and_information_of_poses_are_of_the_full_size(dataset, seen):  # noqa: F811
    """Refinement that begins while steps see small pictures begins with the same numbers as without; only the step
    itself is small."""
    found = []
    for times in (0, 1):
        settings = config(max_steps=20, num_downscales=times)
        plain = trainer_of(dataset, settings)
        made = Trainer(settings, plain.frames, plain.rows, 3.0)
        made.component("poses").use(made, 2.0)
        poses = made.component("poses").module
        made.step_index = 3  # the first at which poses are fitted
        made.step()
        assert poses.has_begun
        assert {camera.width for camera in poses.cameras()} == {SIZE}
        found.append((poses.shifts, poses.whitening))
    assert [side for side, *_ in seen] == [SIZE, SIZE // 2]
    assert all(torch.equal(x, y) for x, y in zip(*found, strict=True))


@pytest.mark.parametrize("size", ["image", "teacher"])
def test_teacher_maps_stay_as_they_are(taught, seen, size):  # noqa: F811
    """Features learn from maps of their own size, at which they are compared, while pictures are small."""
    made = semantic_trainer(taught, num_downscales=1, feature_resolution=size)
    before = made.rows.tensors["features"].detach().clone()
    steps = [made.step() for _ in range(6)]
    assert made.frames[0].teacher().shape[1:] == (MAP, MAP)
    assert all(step.terms["features"] > 0 for step in steps)
    assert not torch.equal(made.rows.tensors["features"], before)
    assert {side for side, *_ in seen} == {SIZE // 2}


def test_what_moves_keeps_its_times(tmp_path, seen, monkeypatch):
    """The static stage and the begin of the dynamic one see small pictures, each at the time of its photograph."""
    monkeypatch.setattr(resolution, "_LEAST", 8)
    small = {"channels": 4, "resolution": 6, "time_resolution": 3, "levels": (1,), "width": 16}
    monkeypatch.setattr(FieldConfig, "preset", classmethod(lambda cls, name, times=None: cls(**small)))
    data = test_dynamic_fit.made(tmp_path / "data")
    result = fit(data, tmp_path / "run", test_dynamic_fit.config(num_downscales=1, max_steps=24), progress=False)
    assert [size for *size, _ in seen] == [[10, 8]] * 12 + [[20, 16]] * 12
    assert {time for *_, time in seen[:8]} == {0.0}  # the static stage has a third of the steps
    assert len({time for *_, time in seen[8:12]}) > 1
    assert result.metrics["motion"]["moving"] > 0


def test_views_are_chosen_at_the_full_size(dataset, tmp_path, seen, monkeypatch):  # noqa: F811
    """Candidates and views seen so far have 32 pixels while steps have 16, also of a new photograph."""
    cameras, choose = [], policies.choose

    def spied(policy, pool):
        cameras.extend([*pool.candidates, *pool.train])
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", spied)
    settings = config(max_steps=20, num_downscales=1, selection=plan())
    result = fit(dataset, tmp_path / "run", settings, progress=False)
    assert {camera.width for camera in cameras} == {SIZE}
    assert [side for side, *_ in seen] == [SIZE // 2] * 10 + [SIZE] * 10
    picks = json.loads((result.run.path / "selection.json").read_text())["picks"]
    assert [pick["step"] for pick in picks] == [4, 8]


def test_another_number_is_another_fit(dataset, tmp_path):  # noqa: F811
    """--resume with another one is refused in one line; so is one that is out of range."""
    fit(dataset, tmp_path / "run", config(max_steps=2, num_downscales=1), progress=False)
    with pytest.raises(ValueError, match="--resume must continue the same fit, num_downscales was 1 and is 2"):
        fit(dataset, tmp_path / "run", config(max_steps=2, num_downscales=2), resume=True, progress=False)
    for wrong in (-1, 17, 0.5):
        with pytest.raises(ValueError, match="fit: num_downscales must be"):
            FitConfig().replace(num_downscales=wrong)
    assert Run(tmp_path / "run").config()["fit"]["data"]["num_downscales"] == 1
