"""What a fit has besides photographs and Gaussians is a component: one file, and one row of a table.

The first is examples/vignette.py, which docs/extending.md shows. Others are written here, in a few lines, as a file of
their own would be.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_times import Drift
from test_train import FAST, config, dataset, random_rows, scene  # noqa: F401 (a fixture)

from drgs import cli
from drgs.cameras import orbit
from drgs.codecs.ply import load_ply
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.fitting.components.base import Component, Setup
from drgs.fitting.components.table import COMPONENTS
from drgs.fitting.config import SelectionConfig
from drgs.fitting.density import add_gaussians, relocate
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.metrics import evaluate
from drgs.fitting.networks import Network, saved_networks
from drgs.fitting.records import check_checkpoint, load_run
from drgs.fitting.resume import run_files
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import StepResult, Trainer
from drgs.integrator import render
from drgs.io.checkpoint import load_state, save_state
from drgs.selection import policies
from drgs.train import fit

VIGNETTE = Path(__file__).parents[1] / "examples" / "vignette.py"


@pytest.fixture
def vignette(tmp_path, monkeypatch):
    """The class of the example, and its row in the table."""
    (tmp_path / "vignette_of_the_example.py").write_text(VIGNETTE.read_text())
    monkeypatch.syspath_prepend(str(tmp_path))
    kind = importlib.import_module("vignette_of_the_example").Vignette
    COMPONENTS["vignette"] = kind
    yield kind
    del COMPONENTS["vignette"]
    del sys.modules["vignette_of_the_example"]


@pytest.fixture
def darkened(tmp_path):
    """A folder of photographs, of which 0, 3, 6, ... are a third darker in their corners."""
    import cv2
    from same_bits import write_photographs

    folder = tmp_path / "photographs"
    write_photographs(folder)
    for path in sorted((folder / "images").glob("*.png"))[::3]:
        image = cv2.imread(str(path)).astype(np.float64)
        y, x = (np.linspace(-1, 1, side) ** 2 / 2 for side in image.shape[:2])
        cv2.imwrite(str(path), image * (1 - (y[:, None] + x) / 3)[..., None])
    return folder


def command(folder: Path, run: Path, *more: str) -> int:
    quick = "--max-steps 40 --max-gaussians 80 --test-every 0 --sh-degree 0 --semantics ignore --deterministic --quiet"
    return cli.main(["fit", str(folder), "-o", str(run), *quick.split(), "--for", "fast", *more])


@pytest.mark.same_bits
def test_a_vignette_is_one_file_and_one_row(vignette, darkened, tmp_path, monkeypatch, capsys):
    """It is fitted, saved, and resumed to the same bits after the fit was killed; config.json, metrics.json and the
    report page have its lines; beside gains of photographs it is refused in one line."""
    assert command(darkened, tmp_path / "whole") == 0
    step = Trainer.step

    def killed(self):
        if self.step_index == 23:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(Trainer, "step", killed)
    assert command(darkened, tmp_path / "killed", "--save-every", "10") == 130
    monkeypatch.setattr(Trainer, "step", step)
    assert load_state(tmp_path / "killed" / "state.safetensors")[1]["step"] == 20
    assert command(darkened, tmp_path / "killed", "--save-every", "10", "--resume") == 0
    one, other = (load_state(tmp_path / name / "state.safetensors") for name in ("whole", "killed"))
    assert one[0].keys() == other[0].keys()
    assert all(torch.equal(x, other[0][name]) for name, x in one[0].items())
    assert one[1]["networks"] == ["vignette"]
    strengths = one[0]["vignette.parameter.strengths"]
    assert bool((strengths != 0).all())
    for name in ("whole", "killed"):
        run = tmp_path / name
        assert json.loads((run / "config.json").read_text())["vignette"] == {"photographs": len(strengths)}
        mean = json.loads((run / "metrics.json").read_text())["vignette"]["mean"]
        assert mean == pytest.approx(float(strengths.mean()))
        page = (run / "report.html").read_text()
        assert "corners of photographs are darker by" in page
        assert f"{mean:.1%}" in page
    assert load_run(tmp_path / "whole").networks.keys() == {"vignette"}
    capsys.readouterr()
    assert command(darkened, tmp_path / "refused", "--exposure", "points") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"vignette must be off where each photograph has an exposure of its own, got on: .*; use", line)
    assert not (tmp_path / "refused" / "config.json").exists()


def test_a_vignette_is_fitted_to_photographs_that_join(vignette, darkened, tmp_path):
    """In an active fit every photograph that is picked gets a strength of its own."""
    active = ("--views", "active", "--initial", "3", "--add", "2", "--every", "10", "--no-report")
    assert command(darkened, tmp_path / "run", *active) == 0
    tensors, header = load_state(tmp_path / "run" / "state.safetensors")
    assert len(header["views"]) == len(tensors["vignette.parameter.strengths"]) == 5


def test_without_the_row_a_run_with_it_is_refused(vignette, darkened, tmp_path):
    """The checkpoint has a network that nobody knows: one line, no traceback; what it shows can be looked at."""
    assert command(darkened, tmp_path / "run", "--no-report") == 0
    others = [kind for name, kind in COMPONENTS.items() if name != "vignette"]
    from drgs.fitting.frames import load_dataset
    from drgs.fitting.records import fit_record
    from drgs.io.run import Run

    record = fit_record(Run(tmp_path / "run"))
    data = load_dataset(darkened, record.config)
    with pytest.raises(ValueError, match=r"networks were \['vignette'\] and are \[\]; repeat"):
        fit(data, tmp_path / "run", record.config, components=others, resume=True, progress=False)


def test_files_of_a_component_are_files_of_a_run(monkeypatch):
    """Whoever checks, copies or removes what a fit has written knows those of a component that was added, too."""

    class Noted(Component):
        name = "noted"
        files = ("noted.json",)

    assert {"config.json", "text_embeddings.npy", "refined_cameras.json"} < set(run_files())
    monkeypatch.setitem(COMPONENTS, "noted", Noted)
    assert "noted.json" in run_files()


class Corrected(Component):
    """A network that corrects what is rendered."""

    name = "corrected"

    def __init__(self) -> None:
        self.networks = [Network("affine", Affine(), lambda part: 1e-2 * (1 - part))]

    def as_photograph(self, out, frame):
        return dataclasses.replace(out, rgb=self.networks[0].module(out.rgb))


class Painted(Component):
    """Features that a term compares with the photograph."""

    name = "painted"
    rates = {"features": 1e-2}

    def __init__(self) -> None:
        self.terms = [Near()]

    def start(self, fit, setup):
        fit.rows.add_tensor("features", torch.zeros(len(fit.rows), 3))


class Affine(torch.nn.Module):
    """A gain and an offset a color channel, as a camera's white balance has."""

    def __init__(self):
        super().__init__()
        self.gain, self.offset = (torch.nn.Parameter(torch.full((3,), value)) for value in (1.1, 0.0))
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.gain * rgb + self.offset


class Near:
    """Features are the photograph, weighted by depth; the first view has none."""

    name = "near"
    outputs = ("depth", "count")

    def __call__(self, output, frame, gaussians):
        if frame.name == "1":
            return None
        return ((output.features - frame.target()) * output.depth[..., None]).square().mean()


def trainer_of(dataset, state=None, kinds=(Corrected, Painted)) -> Trainer:  # noqa: F811
    """A fit with both components: new, or from a checkpoint."""
    cfg = config(max_steps=20, refine_start=0.1, refine_every=0.1, max_gaussians=50)
    frames, components = load_frames(dataset.split()[0], cfg.data.max_pixels, cfg.data.mask), [kind() for kind in kinds]
    if state is not None:
        return Trainer.from_state(cfg, frames, *state, "here", components)
    points, colors = torch.from_numpy(dataset.points), torch.from_numpy(dataset.colors)
    rows, train = GaussianRows.from_points(points, colors), dataset.split()[0]
    setup = Setup(dataset, cfg, train, [], train, (), components, frames=frames)
    return Trainer(cfg, frames, rows, 3.0, components, setup)


def steps(trainer: Trainer, count: int) -> list[StepResult]:
    return [trainer.step() for _ in range(count)]


@pytest.mark.same_bits
def test_components_of_a_callers_own_are_resumed_to_the_bit(dataset, tmp_path):  # noqa: F811
    """A term, features and a network take part in every step, and a checkpoint in the middle changes no bit."""
    whole, first = trainer_of(dataset), trainer_of(dataset)
    rows = steps(whole, 20)
    assert rows[-1].loss < rows[0].loss
    assert len(whole.rows) > len(dataset.points)
    features = whole.gaussians().features
    assert features.shape == (len(whole.rows), 3)
    assert bool(features.any())
    told = {row.view: set(row.terms) for row in rows}
    assert told["1"] == {"photometric", "opacity", "scale"}
    assert told["2"] == {"photometric", "near", "opacity", "scale"}
    assert rows[5].loss == pytest.approx(sum(rows[5].terms.values()), rel=1e-5)
    steps(first, 9)
    tensors, header = first.state()
    path = tmp_path / "state.safetensors"
    save_state(path, tensors, {**header, "seconds": 1.0, "point_source": "x"})
    saved = load_state(path)
    check_checkpoint(path, *saved)
    network = first.networks[0].module.state_dict()
    assert network["calls"] == 9
    assert not torch.equal(network["gain"], Affine().gain)
    assert all(torch.equal(x, network[name]) for name, x in saved_networks(*saved)["affine"].items())
    second = trainer_of(dataset, saved)
    steps(second, 11)
    one, other = whole.state()[0], second.state()[0]
    assert one.keys() == other.keys()
    assert {"affine.parameter.gain", "affine.adam.gain.exp_avg", "parameter.features"} <= one.keys()
    assert [name for name, x in one.items() if not torch.equal(x, other[name])] == []


def test_a_scene_that_moves_is_fitted_at_the_times_of_its_views(rng):
    """Velocities, one row a Gaussian, are found from views at several times, to a third (measured: 4 %)."""
    truth = random_rows(12, dead=0)
    velocities = torch.from_numpy(rng.normal(size=(12, 3)).astype(np.float32)) * 0.3

    class Moving(Component):
        name = "moving"
        rates = {**dict.fromkeys(truth.tensors, 0.0), "velocities": lambda part: 0.05 * (1 - part)}

        def scene(self, fit, scene):
            return Drift(scene, fit.rows.tensors["velocities"])

    scene = Drift(truth.gaussians().detach(), velocities)
    cfg = config(max_steps=60, ssim_weight=0.0, outside_weight=0.0, opacity_weight=0.0, scale_weight=0.0)
    cameras = orbit((0, 0, 0), 3.0, 6, width=32, height=32)
    views = [dataclasses.replace(camera, time=time) for time in (0.0, 0.5, 1.0) for camera in cameras]
    with torch.no_grad():
        frames = [Frame(f"{i}", view, render(scene, view, FAST).rgb) for i, view in enumerate(views)]
    rows = GaussianRows({**truth.tensors, "velocities": torch.zeros(12, 3)})
    trainer = Trainer(cfg.replace(sh_degree=0, refine_stop=0.0), frames, rows, 3.0, [Moving()])
    steps(trainer, 60)
    error = (rows.tensors["velocities"].detach() - velocities).norm(dim=1)
    assert float(error.median()) < float(velocities.norm(dim=1).median()) / 3
    assert torch.equal(rows.tensors["means"], truth.tensors["means"])


def test_a_fit_without_networks_says_nothing_of_them(dataset):  # noqa: F811
    """Checkpoints of plain fits are what they were."""
    cfg = config()
    frames = load_frames(dataset.split()[0], cfg.data.max_pixels, cfg.data.mask)
    rows = GaussianRows.from_points(torch.from_numpy(dataset.points), torch.from_numpy(dataset.colors))
    tensors, header = Trainer(cfg, frames, rows, 3.0).state()
    fields = "means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"
    assert tensors.keys() == {"rng", "queue", *(f"parameter.{name}" for name in fields)}
    assert header.keys() == {"step", "bad_steps", "start_count", "extent", "views", "config"}


def test_components_that_do_not_fit_are_refused(dataset):  # noqa: F811
    """Another network or one of another shape, a tensor without a rate, names that clash: one line each."""
    trainer = trainer_of(dataset)
    trainer.step()
    state = trainer.state()

    def load(*networks):
        class Other(Component):
            name = "other"

            def __init__(self):
                self.networks = list(networks)

        return trainer_of(dataset, state, (Other, Painted))

    with pytest.raises(ValueError, match=r"^here: --resume .*networks were \['affine'\] and are \[\]; repeat"):
        load()
    with pytest.raises(ValueError, match=r"^here: affine\.parameter\.weight must have shape \(2, 2\), got none; "):
        load(Network("affine", torch.nn.Linear(2, 2), 1e-2))
    with pytest.raises(ValueError, match="every tensor must have a learning rate, features has none"):
        trainer_of(dataset, state, (Corrected,))
    for names in (("rng",), ("a", "a"), ("parameter.x",), ("adam.sh_dc",), ("a", "a.parameter")):
        with pytest.raises(ValueError, match="networks must have names of their own"):
            load(*(Network(name, Affine(), 1e-2) for name in names))
    trainer.terms = []
    trainer._queue = torch.tensor([[frame.name for frame in trainer.frames].index("1")])
    with pytest.raises(ValueError, match="a view must have a term of the loss, 1 has none"):
        trainer.step()


class Tied(torch.nn.Module):
    """Two names of one tensor, as autoencoders have them."""

    def __init__(self):
        super().__init__()
        self.there, self.back = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
        self.back.weight = self.there.weight


def test_tied_weights_are_saved_under_each_name(tmp_path):
    """They come back equal, with the moments of the one parameter that they are, and still tied."""
    first, second = (Network("tied", Tied(), 1e-2) for _ in range(2))
    first.module.there(first.module.back(torch.ones(3, 2))).sum().backward()
    first.optimizer.step()
    save_state(tmp_path / "x", first.state(), {"networks": ["tied"]})
    tensors, _ = load_state(tmp_path / "x")
    second.restore(tensors, "here")
    assert second.module.there.weight is second.module.back.weight
    assert torch.equal(second.module.there.weight, first.module.there.weight)
    one, other = first.state(), second.state()
    assert one.keys() == other.keys()
    assert "tied.adam.there.weight.exp_avg" in one
    assert all(torch.equal(x, other[name]) for name, x in one.items())


def test_a_step_that_is_not_finite_leaves_networks_alone(dataset):  # noqa: F811
    """A NaN that only a network's gradient has skips the step of all."""
    trainer = trainer_of(dataset)
    steps(trainer, 2)
    trainer.networks[0].module.gain.register_hook(lambda gradient: gradient * torch.nan)
    before = {name: x.clone() for name, x in trainer.networks[0].state().items() if not name.endswith("calls")}
    assert trainer.step().events[-1]["event"] == "skipped"
    after = trainer.networks[0].state()
    assert [name for name, x in before.items() if not torch.equal(x, after[name])] == []


@pytest.mark.parametrize("kind", ["relocate", "add"])
def test_rows_of_any_tensor_follow_density_control(kind):
    """A copy has the features, and whatever else has a row, of the Gaussian that it copies; moments start at 0."""
    plain = random_rows()
    ids = torch.arange(30.0)
    rows = GaussianRows({**plain.tensors, "features": ids[:, None].repeat(1, 4), "phases": ids})
    for x in rows.tensors.values():
        x.grad = torch.ones_like(x)
    rows.optimizer.step()
    means = rows.tensors["means"].detach().clone()
    generator = torch.Generator().manual_seed(0)
    if kind == "relocate":
        assert relocate(rows, 0.005, 0.0, generator) == 10
        new = torch.arange(10)
    else:
        assert add_gaussians(rows, 12, 0.005, 0.0, generator) == 12
        new = torch.arange(30, 42)
    source = torch.cdist(rows.tensors["means"].detach()[new], means).argmin(1)
    assert len(source.unique()) > 3
    assert torch.equal(rows.tensors["phases"].detach()[new], source.float())
    assert torch.equal(rows.gaussians().features.detach()[new], source[:, None].repeat(1, 4).float())
    for name in ("features", "phases"):
        moment = rows.optimizer.state[rows.tensors[name]]["exp_avg"]
        assert moment.shape == rows.tensors[name].shape
        assert not moment[new].any()
        assert bool(moment[10:30].all())


def test_points_of_a_new_view_have_rows_of_every_tensor(dataset):  # noqa: F811
    """What points do not say is 0: higher SH coefficients and features."""
    trainer = trainer_of(dataset)
    steps(trainer, 3)
    trainer.rows.raise_sh_degree()
    count, degree = len(trainer.rows), trainer.rows.sh_degree
    trainer.add_points(torch.rand(5, 3), torch.rand(5, 3), 0.1, 1.0)
    g = trainer.gaussians()
    assert (len(g), g.sh_degree) == (count + 5, degree)
    assert not g.features[-5:].any()
    assert not g.sh[-5:, 1:].any()
    steps(trainer, 1)


class Wind(torch.nn.Module):
    """One velocity that all Gaussians have."""

    def __init__(self):
        super().__init__()
        self.velocity = torch.nn.Parameter(torch.zeros(3))


def blown(folder):
    """Nine views, at three times in turn, of Gaussians that move by (0.6, 0, 0) in a unit of time."""
    truth, views = scene(), []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=24, height=24)):
        camera = dataclasses.replace(camera, time=i % 3 / 2)
        image = render(Drift(truth, torch.tensor([0.6, 0, 0])), camera, FAST).rgb
        write_png(folder / f"{i}.png", image.numpy())
        views.append(View(camera=camera, name=str(i), image_path=folder / f"{i}.png"))
    points = truth.means.double().numpy()
    return Dataset(folder, "transforms", views, points, np.full((len(truth), 3), 0.5, np.float32), "made for a test")


def test_a_moving_fit_is_looked_at_as_it_moves(tmp_path, monkeypatch):
    """Picks, previews and metrics see the scene at the times of the views; the PLY holds it at rest."""
    data, wind = blown(tmp_path), Wind()
    with torch.no_grad():
        wind.velocity += torch.tensor([0.6, 0, 0])  # fitted already, so that a few steps are enough
    cfg = config(max_steps=6, max_gaussians=60, init_points="all", dc_rate=0.2, dynamics="ignore")

    class Blown(Component):
        name = "blown"

        def __init__(self):
            self.networks = [Network("wind", wind, 1e-3)]

        def scene(self, fit, scene):
            return Drift(scene, wind.velocity)

    active = SelectionConfig().replace(initial=3, add=1, every=3, pick_points="uncovered")
    chosen_of, real = list[object](), policies.choose

    def choose(policy, pool):
        chosen_of.append(pool.scene)
        return real(policy, pool)

    monkeypatch.setattr(policies, "choose", choose)
    result = fit(data, tmp_path / "run", cfg.replace(selection=active), components=[Blown], progress=False)
    frames = load_frames(data.split()[1], cfg.data.max_pixels, cfg.data.mask)
    moving = Drift(result.gaussians, wind.velocity.detach())
    shown, at_rest = (evaluate(x, frames, cfg.settings)["mean"]["psnr"] for x in (moving, result.gaussians))
    assert shown > at_rest + 1
    previews = [event["test_psnr"] for event in result.run.events() if event["event"] == "preview"]
    for told in (result.metrics["mean"]["psnr"], previews[-1]):
        assert told == pytest.approx(shown, abs=1e-3)
    assert torch.equal(load_ply(result.run.point_cloud).means, result.gaussians.means)
    assert [type(scene) for scene in chosen_of] == [Drift]
    assert load_run(result.run).networks.keys() == {"wind"}
