"""Gaussians that are there for a time: what they look like at it, derivatives and information, and where a fit finds
them."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, reference
from drgs.cameras import at_first_time, orbit
from drgs.data import Dataset, View
from drgs.deform import DeformationField, DynamicGaussians, FieldConfig
from drgs.display.pictures import write_png
from drgs.dynamics.lifespans import LIFESPAN_PARAMETERS, Lifespans, is_limited, logit_at
from drgs.ellipsoids import Gaussians
from drgs.files import load_state, save_state
from drgs.fitting.appearing import NewGaussians, agreed_trajectories, find_new_gaussians
from drgs.fitting.components import lifespans
from drgs.fitting.components.exposure import Exposure
from drgs.fitting.components.lifespans import REFERENCE_TIMES, LifespansComponent, LifetimeTerm
from drgs.fitting.components.motion import WARM_UP
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.records import load_run
from drgs.fitting.rows import GaussianRows
from drgs.fitting.stages import dynamic_stage, shows_first_time, spacing
from drgs.integrator import render, render_jvp
from drgs.settings import RenderSettings
from drgs.train import FitConfig, Trainer, fit

FAST = RenderSettings.preset("fast", transmittance_min=1e-10)
SMOOTH = RenderSettings(order="center", extent=8.0, transmittance_min=1e-10)
SPAN = (0.0, 2.0)


def field_of(g: Gaussians) -> DeformationField:
    config = FieldConfig(channels=3, resolution=4, time_resolution=5, width=8, last_std=0.3)
    means = g.means.detach().double()
    return DeformationField(config, torch.stack([means.amin(0), means.amax(0)]), SPAN).to(g.means.dtype)


def scene_of(g: Gaussians, generator: torch.Generator) -> DynamicGaussians:
    """The last three of ten are always there; of the others some move by the field, too."""
    rand = lambda *shape: torch.rand(*shape, generator=generator, dtype=g.means.dtype)  # noqa: E731
    widths = (0.2 + 0.6 * rand(10)).log()
    widths[7:] = math.log(30.0)
    lives = Lifespans(2 * rand(10), widths, 0.4 * rand(10, 3) - 0.2, rand(10, 3) - 0.5, 2 * rand(10))
    return DynamicGaussians(g, field_of(g), torch.linspace(-1, 2.5, 10).to(g.means.dtype), lives)


@pytest.fixture
def view(rng):
    cam = dataclasses.replace(camera(rng, (18, 14)), time=0.7)
    scene = scene_of(gaussians(rng, 10, 4).detach(), torch.Generator().manual_seed(1))
    return scene, dataclasses.replace(cam, w2c=cam.w2c.detach())


def plain(scene: DynamicGaussians, time: float | torch.Tensor) -> Gaussians:
    """The Gaussians at a time once more, from the equations, in float64."""
    base = DynamicGaussians(scene.gaussians, scene.field, scene.motion).at(time)
    lives = scene.lifespans
    there = torch.sigmoid(base.logit_opacities) * torch.exp(
        -0.5 * ((time - lives.centers) / lives.log_widths.exp()) ** 2
    )
    ahead = (time - lives.reference_times)[:, None]
    ends = lives.log_widths.exp() < 10 * (SPAN[1] - SPAN[0])
    return base.replace(
        means=base.means
        + torch.where(ends[:, None], lives.velocities * ahead + lives.accelerations * ahead**2 / 2, 0.0),
        logit_opacities=torch.where(ends, torch.log(there / (1 - there)), base.logit_opacities),
    )


def double(scene: DynamicGaussians) -> DynamicGaussians:
    g = scene.gaussians.replace(**{name: x.double() for name, x in scene.gaussians.parameters().items()})
    field = DeformationField(scene.field.config, scene.field.grid.bounds, SPAN).double()
    field.load_state_dict(scene.field.state_dict())
    return DynamicGaussians(g, field, scene.motion.double(), Lifespans(*[x.double() for x in scene.lifespans]))


def test_opacity_and_place_at_a_time(view):
    """They are those of the equations; what is always there keeps its bits at all times."""
    scene, _ = view
    exact = double(scene)
    for time in (0.0, 0.7, 2.0):
        found, want = exact.at(time), plain(exact, time)
        torch.testing.assert_close(found.means, want.means, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found.logit_opacities, want.logit_opacities, rtol=1e-9, atol=1e-9)
        now, rest = scene.at(time), DynamicGaussians(scene.gaussians, scene.field, scene.motion).at(time)
        for name, x in now.parameters().items():
            assert torch.equal(x[7:], rest.parameters()[name][7:])
    assert is_limited(scene.lifespans.log_widths, 2.0).tolist() == [True] * 7 + [False] * 3


@pytest.mark.parametrize("logit", [-90.0, -20.0, 0.0, 20.0, 80.0])
@pytest.mark.parametrize("distance", [0.0, 1e-3, 1.0, 30.0, 1e4])
def test_logits_at_the_extremes(logit, distance):
    """However opaque, transparent or long ago, logit and derivatives are finite, and right where float64 tells."""
    lives = Lifespans(torch.zeros(1), torch.zeros(1), torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1))
    x = torch.tensor([logit], requires_grad=True)
    time = torch.tensor(distance, requires_grad=True)
    found = logit_at(x, lives, time)
    slopes = torch.autograd.grad(found.sum(), [x, time])
    assert all(bool(torch.isfinite(part).all()) for part in (found, *slopes))
    a = -np.logaddexp(0.0, -float(logit)) - 0.5 * float(distance) ** 2
    want = a - np.log(-np.expm1(a))
    # From a logit of 69 on nothing but the logit grows: 1 - opacity is below 1e-30.
    assert float(found.detach()) == pytest.approx(min(want, 30 * math.log(10)), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("preset", ["exact", "fast", "gsplat"])
def test_forward_is_the_transpose_of_reverse(view, preset):
    """Of every new parameter, through the bridge and through torch, in each renderer; none is 0."""
    scene, cam = view
    settings = RenderSettings.preset(preset)
    draw = torch.Generator().manual_seed(2)
    leaves = [x.clone().requires_grad_() for x in scene.lifespans[:4]]
    live = DynamicGaussians(
        scene.gaussians, scene.field, scene.motion, Lifespans(*leaves, scene.lifespans.reference_times)
    )
    image = render(live, cam, settings).rgb
    cotangent = torch.randn(image.shape, generator=draw)
    slopes = torch.autograd.grad(image, leaves, cotangent)
    for name, slope in zip(LIFESPAN_PARAMETERS, slopes, strict=True):
        along = torch.randn(slope.shape, generator=draw)
        pushed = float((render_jvp(scene, cam, {name: along}, settings).rgb * cotangent).sum())
        size = float((slope.abs() * along.abs()).sum())
        assert pushed == pytest.approx(float((slope * along).sum()), abs=2e-4 * size)
        assert size > 0.01
        assert not slope[7:].any()  # always there


def test_derivatives_against_the_reference(view):
    """Of an image in float64 from the equations, by every new parameter and by the time."""
    scene, cam = view
    exact = double(scene)
    leaves = [x.clone().requires_grad_() for x in exact.lifespans[:4]]
    time = torch.tensor(cam.time, dtype=torch.float64, requires_grad=True)
    lives = Lifespans(*leaves, exact.lifespans.reference_times)
    image = reference.render(
        plain(DynamicGaussians(exact.gaussians, exact.field, exact.motion, lives), time), cam, SMOOTH
    )
    draw = torch.Generator().manual_seed(3)
    cotangent = torch.randn(image.rgb.shape, generator=draw, dtype=torch.float64)
    want = torch.autograd.grad(image.rgb, [*leaves, time], cotangent)
    own = [x.clone().requires_grad_() for x in scene.lifespans[:4]]
    live = DynamicGaussians(
        scene.gaussians, scene.field, scene.motion, Lifespans(*own, scene.lifespans.reference_times)
    )
    moment = torch.tensor(cam.time, requires_grad=True)
    found = torch.autograd.grad(render(live.at(moment), cam, SMOOTH).rgb, [*own, moment], cotangent.float())
    for slope, other in zip(found, want, strict=True):
        torch.testing.assert_close(slope.double(), other, rtol=1e-3, atol=1e-4 * float(other.abs().max()))


def test_information_of_lives(view):
    """Exact columns are the squares of forward derivatives of single parameters; nothing is told of what is always
    there."""
    scene, cam = view
    found = fisher.diagonal(scene, cam, FAST, "columns", groups=list(LIFESPAN_PARAMETERS))
    for name in LIFESPAN_PARAMETERS:
        x = scene.parameters()[name]
        for index in (0, 3, 8):
            along = torch.zeros_like(x)
            along[(index, 1) if x.ndim == 2 else index] = 1
            want = float(render_jvp(scene, cam, {name: along}, FAST).rgb.double().square().sum())
            got = float(found[name][(index, 1) if x.ndim == 2 else index])
            assert got == pytest.approx(want, rel=1e-3, abs=1e-9)
        assert not found[name][7:].any()
        assert float(found[name].max()) > 0


def test_what_is_wrong_is_named(view):
    """The tensor, what must hold and what was got."""
    scene, cam = view
    short = scene.lifespans._replace(velocities=torch.zeros(10))
    with pytest.raises(
        ValueError, match=r"lifespans\.velocities must be floats of shape \(10, 3\), got torch\.float32 of"
    ):
        DynamicGaussians(scene.gaussians, scene.field, scene.motion, short)
    for name in LIFESPAN_PARAMETERS:
        x = scene.parameters()[name].clone()
        x[1] = math.nan
        names = ("centers", "log_widths", "velocities", "accelerations")
        damaged = scene.lifespans._replace(**{names[LIFESPAN_PARAMETERS.index(name)]: x})
        with pytest.raises(ValueError, match=rf"DynamicGaussians\.at: {name} must be finite, got nan at index \[1"):
            render(DynamicGaussians(scene.gaussians, scene.field, scene.motion, damaged), cam, FAST)


# ------------------------------------------------------------------------------------------ a ball that flies

TIMES = tuple(k / 11 for k in range(12))
FLIGHT = 2.2  # way of the ball, whose diameter is 0.3: 0.7 of it from one time to the next, and 7 in all


def room() -> Gaussians:
    """A wall of large blobs."""
    draw = torch.Generator().manual_seed(0)
    x, y = torch.meshgrid(torch.linspace(-1.5, 1.5, 5), torch.linspace(-1.5, 1.5, 5), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((25,), 0.6)], 1)
    sh = (0.3 + 0.3 * torch.rand(25, 3, generator=draw) - 0.5) * math.sqrt(4 * math.pi)
    return Gaussians.from_arrays(means, torch.eye(4)[[0] * 25], torch.full((25, 3), 0.4), torch.full((25,), 0.95), sh)


def ball(time: float, way: float = FLIGHT) -> Gaussians:
    """A ball before the wall, from left to right."""
    mean = torch.tensor([[way * (time - 0.5), 0.3 * math.sin(3 * time) * min(way, 1.0), -0.4]])
    sh = (torch.tensor([[1.0, 0.2, 0.1]]) - 0.5) * math.sqrt(4 * math.pi)
    return Gaussians.from_arrays(mean, torch.eye(4)[[0]], torch.full((1, 3), 0.1), torch.tensor([0.95]), sh)


def together(a: Gaussians, b: Gaussians) -> Gaussians:
    return a.replace(**{name: torch.cat([x, b.parameters()[name]]) for name, x in a.parameters().items()})


def standing(x: float, time: float) -> SimpleNamespace:
    """What counts of a camera: where it stands, and when."""
    return SimpleNamespace(center=np.array([x, 0.0, 0.0]), time=time)


def filmed(folder, cameras_a_time: int, way: float = FLIGHT, shown: tuple[float, float] = (0.0, 1.0)) -> Dataset:
    """Six places in turn, or all at each time; the wall's points. The ball is there between two times."""
    folder.mkdir(parents=True)
    around = orbit((0, 0, 0), 3.0, 24, width=32, height=32, up=(0, 0, -1), elevation=60.0)[::4]
    views = []
    for k, time in enumerate(TIMES):
        for j in range(cameras_a_time):
            name = f"r_{k:02d}_{j}"
            place = (5 * k + j) % len(around)  # neighbors in time are apart in place
            seen = dataclasses.replace(around[place], time=time, name=name)
            is_there = shown[0] <= time <= shown[1]
            picture = render(together(room(), ball(time, way)) if is_there else room(), seen, FAST).rgb
            write_png(folder / f"{name}.png", picture.clamp(0, 1).numpy())
            views.append(View(camera=seen, name=name, image_path=folder / f"{name}.png", split="train"))
    wall = room()
    colors = (0.5 + wall.sh[:, 0] / math.sqrt(4 * math.pi)).numpy()
    return Dataset(folder, "transforms", views, wall.means.double().numpy(), colors, "made")


@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("cameras_a_time", "near"),
    [(1, 0.15), (6, 0.15)],
    ids=["one camera at a time", "six cameras"],
)
def test_births_are_where_the_ball_is(tmp_path, cameras_a_time, near):
    """Residuals alone tell where it is at each time, to a part of its own size, and how fast it goes."""
    dataset = filmed(tmp_path / "data", cameras_a_time)
    frames = load_frames(dataset.views, 10**6)
    found = find_new_gaussians(frames, room(), FAST, 3.0, 500, torch.Generator().manual_seed(0))
    assert len({round(float(t) * 11) for t in found.times}) >= 11  # of 12 times
    away, speed = [], []
    for point, time, velocity in zip(found.points, found.times, found.velocities, strict=True):
        away.append(float((point - ball(float(time)).means[0]).norm()))
        speed.append(float(velocity[0]))
    assert float(np.median(away)) < near
    assert float(np.quantile(away, 0.9)) < 0.3
    if cameras_a_time == 1:  # with six of one time, one place agrees whatever the velocity
        assert float(np.median(speed)) == pytest.approx(FLIGHT, rel=0.25)


def test_at_five_diameters_a_frame(tmp_path):
    """Nothing of it overlaps from one time to the next; cameras of the same time tell where it is."""
    dataset = filmed(tmp_path / "data", 6, way=2.2 * 7.5)
    visible = [view for view in dataset.views if abs(float(ball(view.camera.time, 16.5).means[0, 0])) < 1.2]
    frames = load_frames(dataset.views, 10**6)
    found = find_new_gaussians(frames, room(), FAST, 3.0, 500, torch.Generator().manual_seed(0))
    times = {view.camera.time for view in visible}
    assert len(times) == 2  # it is in the pictures at two of twelve times: 1.5 apart, five of its diameters
    assert times <= set(found.times.tolist())
    for time in times:
        points = found.points[found.times == time]
        assert float((points - ball(time, 16.5).means[0]).norm(dim=1).median()) < 0.15


def test_nothing_is_added_where_nothing_is_missing(tmp_path):
    """Of a scene that shows what photographs do."""
    frames = load_frames(filmed(tmp_path / "data", 2, way=0.0).views, 10**6)
    still = together(room(), ball(0.5, 0.0))
    found = find_new_gaussians([frames[k] for k in (0, 1, 2)], still, FAST, 3.0, 500, torch.Generator().manual_seed(0))
    assert not len(found.points)


def test_exposure_is_nothing_that_moves(tmp_path):
    """Photographs that are darker show nothing else where what is rendered is made as dark."""
    frames = load_frames(filmed(tmp_path / "data", 6, way=0.0).views[:6], 10**6)
    for frame in frames:
        frame.pixels = 0.6 * frame.image()
    still, found = together(room(), ball(0.5, 0.0)), []
    for exposure in (None, lambda out, frame: dataclasses.replace(out, rgb=0.6 * out.rgb)):
        draw = torch.Generator().manual_seed(0)
        found.append(len(find_new_gaussians(frames, still, FAST, 3.0, 500, draw, exposure).points))
    assert found[0] > 0
    assert found[1] == 0


def test_exposure_of_photographs_larger_than_what_is_compared():
    """Gains of a fit reach a rendering that is smaller than the photograph, its mask and its alpha channel."""
    still, frames = together(room(), ball(0.5, 0.0)), []
    around = orbit((0, 0, 0), 3.0, 24, width=140, height=100, up=(0, 0, -1), elevation=60.0)[:3]
    for seen, name in zip(around, "abc", strict=True):
        seen = dataclasses.replace(seen, time=0.5, name=name)
        picture = 0.6 * render(still, seen, FAST).rgb.clamp(0, 1)
        whole = torch.ones(100, 140)
        frames.append(Frame(name, seen, picture, whole, is_object=True, alpha=(255 * whole).to(torch.uint8)))
    exposure = Exposure(list("abc"), np.full((3, 3), math.log(0.6)), learned=True)
    found = find_new_gaussians(frames, still, FAST, 3.0, 500, torch.Generator().manual_seed(0), exposure)
    assert not len(found.points)


def test_places_of_a_thing_tell_how_it_goes_on():
    """A ball goes round in a circle; velocities of places on it are off by a quarter, and nothing is known of how they
    change. Places of its whole way agree on where it is twelve times later, to about half of its radius."""
    draw = torch.Generator().manual_seed(0)
    times = torch.arange(40, dtype=torch.float64).repeat_interleave(20)
    radius, count = 0.3, len(times)

    def way(later: float) -> torch.Tensor:
        angle = 0.05 * (times.float() + later)
        return 1.8 * torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], 1)

    sides = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    places = NewGaussians(
        points=way(0) + radius * sides,
        colors=torch.full((count, 3), 0.5),
        times=times,
        velocities=(way(0.5) - way(-0.5)) + 0.013 * torch.randn(count, 3, generator=draw),
        accelerations=torch.zeros(count, 3),
        sizes=torch.full((count,), 0.02),
        confirmed=torch.ones(count),
        photographs=40,
    )
    off = []
    for found in (places, agreed_trajectories(places, 3.0, 1.0)):
        predicted = 12 * found.velocities + 72 * found.accelerations
        off.append(float((predicted - (way(12) - way(0))).norm(dim=1).median()))
    assert off[0] > radius
    assert off[1] < 0.7 * radius  # measured: 0.53, with other draws up to 0.56


def config(**fields) -> FitConfig:
    short = {"renderers": ("fast",), "max_steps": 240, "max_gaussians": 200, "sh_degree": 1, "save_every": 1000}
    rates = {"means_rate": (1e-3, 1e-4), "dc_rate": 0.02, "static_share": 0.2, "initial_opacity": 0.8}
    return FitConfig().replace(**{**short, **rates, **fields})


@pytest.fixture(autouse=True)
def _small_field(monkeypatch):
    """A field of some hundred numbers, whatever the preset."""
    small = {"channels": 4, "resolution": 6, "time_resolution": 6, "levels": (1,), "width": 16}
    monkeypatch.setattr(FieldConfig, "preset", classmethod(lambda cls, name, times=None: cls(**small)))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """One camera at each time."""
    return filmed(tmp_path_factory.mktemp("flies") / "data", 1)


def of_the_ball(scene, times=TIMES) -> float:
    """Mean error of the pixels that show the ball, from a place that no photograph was taken from."""
    between = orbit((0, 0, 0), 3.0, 24, width=32, height=32, up=(0, 0, -1), elevation=60.0)[2]
    errors = []
    for time in times[1:-1]:
        seen = dataclasses.replace(between, time=time)
        want = render(together(room(), ball(time)), seen, FAST).rgb
        where = (want - render(room(), seen, FAST).rgb).abs().amax(2) > 0.1
        errors.append(float((render(scene, seen, FAST).rgb - want)[where].abs().mean()))
    return float(np.mean(errors))


@pytest.mark.slow
def test_a_fit_shows_what_flies(dataset, tmp_path):
    """From where no photograph was taken, at a third of the error of a fit without lives; the run keeps them, and says
    how many there are."""
    found = {}
    for lives in ("auto", "off"):
        result = fit(dataset, tmp_path / lives, config(lives=lives), progress=False)
        found[lives] = of_the_ball(load_run(result.run).scene)
        assert ("living" in result.metrics["motion"]) == (lives == "auto")
    assert found["auto"] < 0.33 * found["off"]  # measured: see the closing assertion
    scene = load_run(fit(dataset, tmp_path / "short", config(max_steps=60), progress=False).run).scene
    assert int(scene.has_lifespan.sum()) > 0
    assert not scene.gaussians.sh[scene.has_lifespan][:, 1:].any()  # one color in all directions


@pytest.mark.slow
def test_what_appears_and_vanishes(tmp_path):
    """A lamp that is on for a third of the time is seen then, and not before or after; it comes and goes within two
    times between photographs, for opacity is a bell in time.
    """
    dataset = filmed(tmp_path / "data", 6, way=0.0, shown=(0.35, 0.65))
    scene = load_run(fit(dataset, tmp_path / "run", config(max_steps=600), progress=False).run).scene
    between = orbit((0, 0, 0), 3.0, 24, width=32, height=32, up=(0, 0, -1), elevation=60.0)[2]
    lit, dark = together(room(), ball(0.5, 0.0)), room()
    where = (render(lit, between, FAST).rgb - render(dark, between, FAST).rgb).abs().amax(2) > 0.1
    for time in TIMES:
        if abs(abs(time - 0.5) - 0.15) < 2 / 11 and not 0.4 < time < 0.6:
            continue  # it comes or goes
        seen = dataclasses.replace(between, time=time)
        image = render(scene, seen, FAST).rgb
        away = [float((image - render(x, seen, FAST).rgb)[where].abs().mean()) for x in (lit, dark)]
        is_on = 0.35 < time < 0.65
        assert away[not is_on] < 0.4 * away[is_on], time  # measured: at most 0.2


@pytest.mark.slow
@pytest.mark.same_bits
def test_a_fit_that_was_stopped_ends_with_the_same_bits(dataset, tmp_path):
    """Lifespans are in the checkpoint; damaged ones are refused, with their name."""
    how = config(max_steps=60, deterministic=True, save_every=30)
    whole = fit(dataset, tmp_path / "whole", how, progress=False).run
    step = Trainer.step
    with pytest.MonkeyPatch.context() as patch:

        def until(self):
            if self.step_index == 40:
                raise KeyboardInterrupt
            return step(self)

        patch.setattr(Trainer, "step", until)
        with pytest.raises(KeyboardInterrupt):
            fit(dataset, tmp_path / "parts", how, progress=False)
    parts = fit(dataset, tmp_path / "parts", how, resume=True, progress=False).run
    wanted, _ = load_state(whole.state)
    found, header = load_state(parts.state)
    assert {"parameter.births", *(f"parameter.{name}" for name in LIFESPAN_PARAMETERS)} <= set(wanted)
    assert all(torch.equal(x, wanted[name]) for name, x in found.items())
    parts.point_cloud.unlink()  # else it would be shown instead
    nan = torch.full_like(found["parameter.births"], math.nan)
    for name, bad in (("velocities", torch.zeros(3, 3)), ("life_centers", nan)):
        save_state(parts.state, found | {f"parameter.{name}": bad}, header)
        with pytest.raises(ValueError, match=rf"state\.safetensors: \S*{name} must be"):
            load_run(parts)


def test_what_the_static_stage_shows(tmp_path):
    """The first time where three photographs or more are of it, also when there are no others yet; else all times.

    Of poses that are of one time each, the first time shows a part of the scene alone.
    """
    one, six = (filmed(tmp_path / str(n), n).views for n in (1, 6))
    assert not shows_first_time(one)
    assert shows_first_time(six)
    assert shows_first_time([view for view in six if view.camera.time == 0])
    poses = [SimpleNamespace(camera=standing(x, x // 4)) for x in range(12)]
    assert not shows_first_time(poses)
    assert at_first_time([pose.camera for pose in poses[:8]]) == [0, 1, 2, 3]
    assert at_first_time([pose.camera for pose in poses]) == [*range(12)]


def test_only_lives_that_other_times_confirm_are_lengthened():
    """One that is shorter than the time between two photographs is left as it is."""
    widths = torch.tensor([0.05, 0.3]).log().requires_grad_()
    rows = SimpleNamespace(tensors={REFERENCE_TIMES: torch.zeros(2), LIFESPAN_PARAMETERS[1]: widths})
    loss = LifetimeTerm(rows, 0.1, 2.0)(None, None, None)
    assert float(loss) == pytest.approx(2 * 0.1 / 0.3 / 2)
    loss.backward()
    assert float(widths.grad[0]) == 0
    assert float(widths.grad[1]) == pytest.approx(-2 * 0.1 / 0.3 / 2)


def test_the_search_is_made_once_and_says_what_was_added(monkeypatch):
    """Also where photographs that join change when it is due, and where most places have no room."""
    draw = torch.Generator().manual_seed(0)
    points, one = torch.randn(5, 3, generator=draw), torch.ones(5)
    still = {"velocities": torch.zeros(5, 3), "accelerations": torch.zeros(5, 3), "sizes": 0.1 * one}
    places = NewGaussians(points, torch.full((5, 3), 0.5), 0.5 * one, confirmed=one, photographs=2, **still)
    monkeypatch.setattr(lifespans, "find_new_gaussians", lambda *_: places)
    how = config(max_gaussians=10)
    stage = dynamic_stage(how)
    frames = [SimpleNamespace(camera=standing(x, time)) for x, time in ((0, 0.0), (1, 0.5), (2, 1.0))]
    component, part = LifespansComponent((0.0, 0.5, 1.0)), dict.fromkeys(("scene", "photographs"), list)
    rows = GaussianRows.from_points(torch.randn(9, 3, generator=draw), torch.rand(9, 3, generator=draw), 0.8)
    rows.add_tensor("motion", torch.zeros(9))  # as the field has added it
    fit_of_these = SimpleNamespace(
        config=how, frames=frames, rows=rows, step_index=stage.begin, reserved=0, extent=1.0, generator=draw,
        as_photograph=None, components=[], **part,
    )  # fmt: skip
    (event,) = component.before_density(fit_of_these)
    assert (event["found"], event["added"], event["gaussians"]) == (5, 1, 10)
    assert "1 Gaussians with a limited lifetime are added, 4 more have no room" in component.describe(event)
    fit_of_these.frames = [*(SimpleNamespace(camera=standing(x, 0.0)) for x in (1, 2, 3)), *frames]
    assert shows_first_time(fit_of_these.frames)
    fit_of_these.step_index += round(WARM_UP * stage.length)
    assert component.before_density(fit_of_these) == []


def test_time_between_photographs():
    assert spacing([0.0, 1.0, 1.0, 3.0, 4.0]) == 1.0
    assert spacing([2.0, 2.0]) == 1.0
