"""Claims of drgs.fitting.components.skybox on a ball of Gaussians before painted hills that are far away."""

from __future__ import annotations

import dataclasses
import json
import math
import tracemalloc

import numpy as np
import pytest
import torch

import drgs
from drgs.cameras import intrinsics, look_at
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.ellipsoids import Gaussians
from drgs.files import load_ply, load_state, save_state
from drgs.fitting.components import skybox as skyboxes
from drgs.fitting.components.filter_3d import Filter3D
from drgs.fitting.components.poses import Poses
from drgs.fitting.components.skybox import RADIUS, Skybox, far_evidence, visible_share, why_not
from drgs.fitting.density import add_gaussians, explore, relocate
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.losses import Opacity, Scale, terms_of
from drgs.fitting.records import check_checkpoint
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer
from drgs.integrator import Output
from drgs.train import FitConfig, SelectionConfig, fit

WIDTH, HEIGHT = 48, 36
VIEWS = 14
FAST = drgs.RenderSettings.preset("fast")
FAR, NEAR = 1e4, 6.0
SETTINGS = {
    "max_steps": 120,
    "max_gaussians": 900,
    "sh_degree": 0,
    "renderers": ("fast", "gsplat"),
    "test_every": 7,
    "dc_rate": 0.02,
}


def painted(way: np.ndarray) -> np.ndarray:
    """(..., 3) colors of a sphere around the origin, of unit vectors (..., 3)."""
    x, y, z = np.moveaxis(way, -1, 0)
    return 0.5 + 0.3 * np.stack([np.sin(5 * x), np.cos(4 * y + z), np.sin(6 * z)], axis=-1)


def ball() -> Gaussians:
    """A red and green ball of radius 0.7 at the origin."""
    index = np.arange(2000) + 0.5
    z = 1 - index / 1000
    angle = math.pi * (1 + math.sqrt(5)) * index
    across = np.sqrt(1 - z * z)
    way = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    colors = painted(way) * (1.0, 1.0, 0.2)
    sh = torch.from_numpy((colors - 0.5) * math.sqrt(4 * math.pi)).float()
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(way), 1)
    means = torch.from_numpy(0.7 * way).float()
    return Gaussians.from_arrays(means, quats, torch.full((len(way), 3), 0.04), torch.full((len(way),), 0.95), sh)


def behind(camera: drgs.Camera, distance: float) -> torch.Tensor:
    """(H, W, 3) the painted sphere of radius `distance` as a camera inside sees it."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    way = np.stack([(x - WIDTH / 2) / 45, (y - HEIGHT / 2) / 45, np.ones_like(x)], axis=-1) @ camera.c2w[:3, :3].T
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    along = way @ camera.center
    met = camera.center + (np.sqrt(along**2 + distance**2 - camera.center @ camera.center) - along)[..., None] * way
    return torch.from_numpy(painted(met / distance)).float()


def photographs(distance: float = FAR) -> list[Frame]:
    """Photographs from an arc of radius 3, of which three and more look in most directions."""
    frames = []
    for i, angle in enumerate(np.linspace(0, 2.6, VIEWS)):
        eye = (3 * math.cos(angle), 3 * math.sin(angle), 0.6 * math.sin(3 * angle))
        pose = look_at(eye, target=(0, 0, 0), up=(0, 0, 1))
        matrix = intrinsics(45.0, 45.0, WIDTH / 2, HEIGHT / 2)
        camera = drgs.Camera(matrix, pose, width=WIDTH, height=HEIGHT, name=f"{i:02d}")
        out = drgs.render(ball(), camera, FAST)
        pixels = out.rgb + (1 - out.alpha)[..., None] * behind(camera, distance)
        frames.append(Frame(camera.name, camera, pixels.detach().clamp(0, 1)))
    return frames


def dataset_of(frames: list[Frame], folder, alpha: bool = False, mask: bool = False) -> Dataset:
    """The photographs in files, with gray points on the ball."""
    views = []
    for frame in frames:
        path = folder / f"{frame.name}.png"
        pixels = frame.pixels.numpy()
        if alpha:
            pixels = np.concatenate([pixels, np.full((HEIGHT, WIDTH, 1), 0.5, np.float32)], axis=2)
        write_png(path, pixels)
        masked = {}
        if mask:
            masked["mask_path"] = folder / f"mask_{frame.name}.png"
            write_png(masked["mask_path"], np.ones((HEIGHT, WIDTH), np.float32))
        views.append(View(camera=frame.camera, name=frame.name, image_path=path, **masked))
    points = ball().means[::5].double().numpy()
    return Dataset(folder, "transforms", views, points, np.full(points.shape, 0.5, np.float32), "made for a test")


def rows_with_skybox() -> GaussianRows:
    """60 Gaussians on the ball behind 40 of a shell."""
    frames = photographs()
    skybox = Skybox.around(frames, 3.3, 40)
    rows = GaussianRows.from_points(ball().means[:60], torch.full((60, 3), 0.5), 0.3)
    rows.add_far(skybox.rows())
    assert rows.far == len(skybox)
    return rows


def test_where_the_shell_is():
    """A tenth of the budget at most, one to two hundred extents away, where photographs look, without gaps, in the
    colors that are there.
    """
    frames = photographs()
    skybox = Skybox.around(frames, 3.3, 300)
    assert 270 <= len(skybox) <= 300
    distance = np.linalg.norm(skybox.means, axis=1) / 3.3
    assert distance.min() > 0.99 * RADIUS
    assert distance.max() < 2.01 * RADIUS
    alone = GaussianRows.from_points(ball().means[:1], torch.zeros(1, 3))
    alone.add_far(skybox.rows())
    shown = alone.gaussians().detach().take(slice(0, len(skybox)))
    for settings in (FAST, drgs.RenderSettings.preset("gsplat"), drgs.RenderSettings.preset("inria")):
        out = drgs.render(shown, frames[0].camera, settings)
        assert float(out.alpha.mean()) > 0.95
        assert float(out.alpha.min()) > 0.85  # in a corner, where the shell ends
        truth = behind(frames[0].camera, FAR)
        away = drgs.render(ball(), frames[0].camera, FAST).alpha < 0.01
        assert float((out.rgb - truth)[away].abs().mean()) < 0.1


def test_evidence_tells_far_from_near():
    """What is painted far away is agreed on, what is painted at twice the cameras' distance is not."""
    far, near = (far_evidence(photographs(distance), 3.3) for distance in (FAR, NEAR))
    assert far.is_clear
    assert far.share > 0.25
    assert not near.is_clear
    assert far.words().startswith("photographs agree on what is far away in ")
    assert far_evidence(photographs()[:2], 3.3).share == 0  # two tell nothing


@pytest.mark.parametrize(
    ("data", "background", "said"),
    [
        ({"alpha": True}, (0.0, 0.0, 0.0), "an alpha channel says"),
        ({"mask": True}, (0.0, 0.0, 0.0), "masks say"),
        ({}, (1.0, 1.0, 1.0), "the background has a color"),
    ],
    ids=["alpha", "mask", "background"],
)
def test_none_where_the_data_say_what_is_behind(tmp_path, data, background, said):
    """`auto` has none there, and `on` is refused in one line."""
    dataset = dataset_of(photographs(), tmp_path, **data)
    assert why_not(load_frames(dataset.views, 10**6), background).startswith(said)
    settings = FAST if background == (0.0, 0.0, 0.0) else drgs.RenderSettings.preset("fast", background=background)
    config = FitConfig().replace(**SETTINGS, skybox="auto", settings=settings).replace(max_steps=2)
    result = fit(dataset, tmp_path / "run", config, progress=False)
    assert "skybox" not in result.metrics
    recorded = result.run.config()["skybox"]
    assert set(recorded) == {"gaussians", "reason"}
    assert recorded["gaussians"] == 0
    assert recorded["reason"].startswith(said)
    with pytest.raises(ValueError, match="skybox must be off or auto here, got on") as error:
        fit(dataset, tmp_path / "other", config.replace(skybox="on"), progress=False)
    assert "\n" not in str(error.value)


def test_nothing_speaks_against_photographs():
    """Plain ones, and those of which only the corners are not valid."""
    frames = photographs()
    masked = [dataclasses.replace(frame, mask=torch.ones(HEIGHT, WIDTH)) for frame in frames]
    assert why_not(frames, (0.0, 0.0, 0.0)) is None
    assert why_not(masked, (0.0, 0.0, 0.0)) is None


@pytest.mark.slow
def test_held_out_views_are_better_and_the_file_has_it(tmp_path):
    """In fast and gsplat, by 2 dB and more; what is read from the PLY looks the same; all is recorded."""
    dataset = dataset_of(photographs(), tmp_path)
    shown = {}
    for use in ("off", "auto"):
        result = fit(dataset, tmp_path / use, FitConfig().replace(**SETTINGS, skybox=use), progress=False)
        shown[use] = {row["name"]: row["mean"]["psnr"] for row in result.metrics["renderers"]["rows"]}
    for name in ("fast", "gsplat"):
        assert shown["auto"][name] > shown["off"][name] + 2
    recorded = result.run.config()["skybox"]
    assert recorded["reason"] is None
    assert recorded["gaussians"] == result.metrics["skybox"]["gaussians"] > 80
    assert recorded["share"] > 0.2
    assert result.metrics["skybox"]["visible"] > 0.3
    assert len(result.gaussians) <= SETTINGS["max_gaussians"]
    camera = dataset.views[0].camera
    one, two = (drgs.render(x, camera, FAST).rgb for x in (result.gaussians, load_ply(result.run.point_cloud)))
    assert torch.allclose(one, two, atol=1e-6)
    away = result.gaussians.means.norm(dim=1)
    assert int((away > RADIUS).sum()) == recorded["gaussians"]


@pytest.mark.same_bits
def test_a_near_scene_has_the_bits_of_a_fit_without(tmp_path):
    """Nothing is far away: `auto` changes nothing."""
    dataset = dataset_of(photographs(NEAR), tmp_path)
    config = FitConfig().replace(**SETTINGS, deterministic=True).replace(max_steps=12)
    ends = [fit(dataset, tmp_path / use, config.replace(skybox=use), progress=False) for use in ("off", "auto")]
    off, auto = (end.run.config()["skybox"] for end in ends)
    assert off == {"gaussians": 0, "reason": "skybox is off"}
    assert auto["gaussians"] == 0
    assert auto["reason"] == "photographs do not clearly agree on what is far away"
    assert auto["share"] < 0.25
    one, two = (end.gaussians.parameters() for end in ends)
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.same_bits
def test_resumed_fit_has_the_same_bits(tmp_path):
    """A checkpoint knows which Gaussians are far away, and says so if it cannot be."""
    frames = photographs()
    config = FitConfig().replace(**SETTINGS, skybox="on", deterministic=True).replace(max_steps=30)
    rows = rows_with_skybox()
    whole = Trainer(config, frames, rows, 3.3)
    while whole.step_index < 12:
        whole.step()
    tensors, header = whole.state()
    header |= {"point_source": "the ball"}
    save_state(tmp_path / "state.safetensors", tensors, header)
    tensors, header = load_state(tmp_path / "state.safetensors")
    check_checkpoint(tmp_path / "state.safetensors", tensors, header)
    again = Trainer.from_state(config, frames, tensors, header, "here")
    for trainer in (whole, again):
        while trainer.step_index < 30:
            trainer.step()
    one, two = whole.rows.state(), again.rows.state()
    assert again.rows.far == rows.far
    assert all(torch.equal(one[name], two[name]) for name in one)
    with pytest.raises(ValueError, match=r"skybox must be in 1\.\.\d+, got 5000"):
        check_checkpoint(tmp_path / "x", tensors, {**header, "skybox": 5000})


def test_density_control_leaves_it_alone():
    """Transparent ones of it stay where they are, and no copy of it is made."""
    rows = rows_with_skybox()
    count = rows.far
    with torch.no_grad():
        rows.tensors["logit_opacities"][:5] = -9
        rows.tensors["logit_opacities"][count : count + 10] = -9
    before = rows.tensors["means"][:count].detach().clone()
    generator = torch.Generator().manual_seed(1)
    assert relocate(rows, 0.005, 0.01, generator) == 10
    assert add_gaussians(rows, 30, 0.005, 0.01, generator) == 30
    explore(rows, 1.6e-4, 3.3, 5e5, generator)
    assert torch.equal(rows.tensors["means"][:count].detach(), before)
    assert float(rows.tensors["means"][count:].detach().norm(dim=1).max()) < 10


def test_terms_leave_it_out():
    """Means of opacity and scale are those of the other Gaussians, and no gradient reaches it."""
    rows = rows_with_skybox()
    config = FitConfig().replace(**SETTINGS)
    gaussians = rows.gaussians()
    others = gaussians.take(slice(rows.far, None))
    output = Output(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH))
    frame = photographs()[0]
    plain, without = terms_of(config, 3.3), terms_of(config, 3.3, rows.far)
    for kind, name in ((Opacity, "logit_opacities"), (Scale, "log_scales")):
        of_all, of_others = (next(x for x in terms if isinstance(x, kind)) for terms in (plain, without))
        value = of_others(output, frame, gaussians)
        assert float(value.detach()) == pytest.approx(float(of_all(output, frame, others).detach()), rel=1e-6)
        gradient = torch.autograd.grad(value, rows.tensors[name], retain_graph=True)[0]
        assert float(gradient[: rows.far].abs().max()) == 0
        assert float(gradient[rows.far :].abs().min()) > 0


def test_what_shows_of_it():
    """Beside the ball the shell shows, and before it does not; of a mask nothing outside counts."""
    frames = photographs()
    near = ball()
    rows = GaussianRows(
        {name: x.detach() for name, x in near.parameters().items() if name != "sh"}
        | {"sh_dc": near.sh.detach(), "sh_rest": torch.zeros(len(near), 0, 3)}
    )
    rows.add_far(Skybox.around(frames, 3.3, 40).rows())
    all_of_it = rows.gaussians()
    is_open = [drgs.render(near, frame.camera, FAST).alpha < 0.5 for frame in frames]
    truth = float(torch.stack(is_open).float().mean())
    assert 0.3 < truth < 0.9
    assert visible_share(all_of_it, rows.far, frames, FAST) == pytest.approx(truth, abs=1e-6)
    masked = [dataclasses.replace(x, mask=mask.float()) for x, mask in zip(frames, is_open, strict=True)]
    assert visible_share(all_of_it, rows.far, masked, FAST) == 1


def test_it_comes_before_the_first_step():
    """Moments of an optimizer would be lost."""
    frames = photographs()
    config = FitConfig().replace(**SETTINGS)
    trainer = Trainer(config, frames, GaussianRows.from_points(ball().means[:60], torch.full((60, 3), 0.5)), 3.3)
    trainer.step()
    with pytest.raises(ValueError, match="a skybox must be there before the first step"):
        trainer.rows.add_far(Skybox.around(frames, 3.3, 40).rows())


def test_refused_where_views_are_chosen(tmp_path):
    """In one line, before anything is fitted."""
    config = FitConfig().replace(**SETTINGS, skybox="on").replace(selection=SelectionConfig())
    with pytest.raises(NotImplementedError, match="skybox must be off or auto where views are chosen on the way, got"):
        fit(dataset_of(photographs(), tmp_path), tmp_path / "run", config, progress=False)


def test_refused_where_things_move(tmp_path):
    """The same of photographs of two times; `auto` has none there."""
    dataset = dataset_of(photographs(), tmp_path)
    for i, view in enumerate(dataset.views):
        view.camera = dataclasses.replace(view.camera, time=float(i % 2))
    with pytest.raises(NotImplementedError, match="skybox must be off or auto where things move, got on"):
        fit(dataset, tmp_path / "run", FitConfig().replace(**SETTINGS, skybox="on"), progress=False)
    result = fit(dataset, tmp_path / "run", FitConfig().replace(**SETTINGS).replace(max_steps=4), progress=False)
    assert result.run.config()["skybox"] == {"gaussians": 0, "reason": "things move"}


def test_a_run_that_goes_on_keeps_the_reason(tmp_path):
    """And one of before, whose config.json has none, is read as it was."""
    dataset = dataset_of(photographs(NEAR), tmp_path)
    config = FitConfig().replace(**SETTINGS).replace(max_steps=4, save_every=2)
    run = fit(dataset, tmp_path / "run", config, progress=False).run
    recorded = run.config()
    assert recorded["skybox"]["reason"] == "photographs do not clearly agree on what is far away"
    fit(dataset, run.path, config, resume=True, progress=False)
    assert run.config()["skybox"] == recorded["skybox"]
    before = {name: x for name, x in recorded.items() if name != "skybox"}
    (run.path / "config.json").write_text(json.dumps(before))
    fit(dataset, run.path, config, resume=True, progress=False)
    assert "skybox" not in run.config()


@pytest.mark.slow
def test_as_many_as_there_may_be_and_evenly():
    """Never more; what is left out is left out evenly, whatever the lens: no picture has an empty side."""
    for count in (1, 37, 300):
        for width in (WIDTH, 40 * WIDTH):  # the second with a lens of few degrees
            frames = photographs()
            if width != WIDTH:
                for frame in frames:
                    K = frame.camera.K.copy()
                    K[:2, :2] *= 40
                    frame.camera = dataclasses.replace(frame.camera, K=K)
            shell = Skybox.around(frames, 3.3, count)
            assert 0 < len(shell) <= count
            if count == 300:
                assert len(shell) > 200
                pixels, depth = frames[0].camera.project(shell.means)
                inside = (depth > 0) & ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1)
                low, high = (pixels[inside] < np.array([WIDTH, HEIGHT]) / 2).sum(0), inside.sum()
                assert ((low > 0.25 * high) & (low < 0.75 * high)).all()


def test_many_photographs_and_directions_fit_into_memory(monkeypatch):
    """Colors are looked up some directions at a time, with the bits of all at once, in memory that does not grow with
    their number: 8,000 directions in 308 photographs are 30 MB of colors, and of their median several times that.
    """
    frames = photographs()
    whole = Skybox.around(frames, 3.3, 8000)
    many = 22 * frames
    monkeypatch.setattr(skyboxes, "_COLORS_AT_ONCE", 1 << 20)
    monkeypatch.setattr(skyboxes, "_POINTS_AT_ONCE", 1 << 10)
    parts = Skybox.around(frames, 3.3, 8000)
    for name in ("means", "colors", "scales"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    tracemalloc.start()
    try:
        colors = skyboxes._colors(many, whole.means)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert np.array_equal(colors, whole.colors)  # a median of each color 22 times
    assert peak < 12e6


def test_poses_have_the_reach_of_what_is_near():
    """Moving a camera does not move what is far away, which is left out of the bound of poses."""
    frames = photographs()
    rows = GaussianRows.from_points(ball().means[:50], torch.full((50, 3), 0.5))
    shifts = []
    for is_there in (False, True):
        if is_there:
            rows.add_far(Skybox.around(frames, 3.3, 400).rows())
        poses = Poses([frame.camera for frame in frames], 3.3, FAST, reach=1.0)
        poses.begin(rows.gaussians(), rows.far)
        shifts.append(poses.shifts)
    torch.testing.assert_close(*shifts, rtol=1e-12, atol=0)


def test_the_filter_of_what_no_camera_sees_is_of_what_is_near():
    """Not the filter of the shell, which would blur it away."""
    frames = photographs()
    near = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1e4]])  # the second behind, above or below all cameras
    shell = torch.from_numpy(Skybox.around(frames, 3.3, 50).means).float()
    plain, with_shell = Filter3D(), Filter3D()
    cameras = [frame.camera for frame in frames]
    plain.sample(near, cameras)
    with_shell.sample(torch.cat([shell, near]), cameras, len(shell))
    assert torch.equal(plain.variances, with_shell.variances[len(shell) :])
    assert plain.variances[0] == plain.variances[1]
