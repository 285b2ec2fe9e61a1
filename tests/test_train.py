"""Claims of drgs.train and drgs.fitting (trainer, density, losses) on a tiny scene that is made of Gaussians."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

import drgs
import drgs.commands.fit
from drgs.cameras import orbit
from drgs.commands.eval import run as run_eval
from drgs.data import Dataset, View
from drgs.display.pictures import write_png
from drgs.ellipsoids import Gaussians
from drgs.files import load_state
from drgs.fitting.adam import Adam
from drgs.fitting.density import add_gaussians, divide, explore, relocate
from drgs.fitting.frames import Frame, load_frames
from drgs.fitting.losses import Outside, Photometric, padded_ssim, ssim_map
from drgs.fitting.rows import GaussianRows
from drgs.integrator import Output
from drgs.train import FitConfig, Trainer, fit

SIZE = 32
FAST = drgs.RenderSettings.preset("fast")


def scene(n=40, seed=0):
    """Colored blobs in the unit ball."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=generator) * 0.35
    colors = torch.rand(n, 3, generator=generator)
    quats = torch.randn(n, 4, generator=generator)
    scales = 0.06 + 0.1 * torch.rand(n, 3, generator=generator)
    return Gaussians.from_arrays(means, quats, scales, torch.full((n,), 0.9), (colors - 0.5) * math.sqrt(4 * math.pi))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Nine views of the scene with object masks, and points near the true means."""
    folder = tmp_path_factory.mktemp("scene")
    g, views = scene(), []
    for i, camera in enumerate(orbit((0, 0, 0), 3.0, 9, width=SIZE, height=SIZE)):
        out = drgs.render(g, camera, FAST)
        write_png(folder / f"{i}.png", out.rgb.numpy())
        write_png(folder / f"mask_{i}.png", (out.alpha > 0.5).float()[..., None].repeat(1, 1, 3).numpy())
        views.append(View(camera=camera, name=str(i), image_path=folder / f"{i}.png"))
    rng = np.random.default_rng(0)
    points = g.means.double().numpy() + 0.05 * rng.standard_normal((len(g), 3))
    return Dataset(folder, "transforms", views, points, np.full((len(g), 3), 0.5, np.float32), "made for a test")


def masked(dataset):
    views = [View(**{**vars(v), "mask_path": dataset.path / f"mask_{v.name}.png"}) for v in dataset.views]
    return Dataset(dataset.path, "transforms", views, dataset.points, dataset.colors, "made for a test")


def config(**fields):
    """A short fit, by one renderer: rates are higher than the defaults, which are made for thousands of steps."""
    short = {
        "renderers": ("fast",),
        "max_steps": 60,
        "max_gaussians": 80,
        "sh_degree": 1,
        "save_every": 25,
        "dc_rate": 0.03,
    }
    return FitConfig().replace(**{**short, "means_rate": (1e-3, 1e-4), **fields})


def trainer_of(dataset, cfg):
    frames = load_frames(dataset.split()[0], cfg.data.max_pixels, cfg.data.mask)
    points, colors = torch.from_numpy(dataset.points), torch.from_numpy(dataset.colors)
    return Trainer(cfg, frames, GaussianRows.from_points(points, colors, cfg.density.initial_opacity), 3.0)


def test_fit_improves_and_leaves_a_complete_run(dataset, tmp_path):
    """Loss falls, PSNR rises in training (> 2 dB; measured: 3.4) and held out (> 1; 1.7), every file is there."""
    result = fit(dataset, tmp_path / "run", config(max_steps=150), progress=False)
    run = result.run
    names = {p.name for p in run.path.iterdir()}
    assert names == {
        "config.json", "env.json", "log.jsonl", "metrics.json", "state.safetensors", "state.previous.safetensors",
        "point_cloud.ply", "errors.safetensors", "renders", ".drgs.jsonl",
    }  # fmt: skip
    events = run.events()
    train = [e for e in events if e["event"] == "train"]
    previews = [e for e in events if e["event"] == "preview"]
    assert train[-1]["loss"] < 0.6 * train[0]["loss"]
    assert train[-1]["psnr"] > train[0]["psnr"] + 2
    assert previews[-1]["test_psnr"] > previews[0]["test_psnr"] + 1  # the first one is after 15 steps
    assert {e["event"] for e in events} >= {"start", "density", "sh_degree", "checkpoint", "done"}
    assert all(e["schema"] == 1 for e in events)
    assert len(result.gaussians) == 80
    assert result.gaussians.sh_degree == 1
    assert len(drgs.load_ply(run.point_cloud)) == 80
    written = json.loads((run.path / "metrics.json").read_text())
    assert written["mean"]["psnr"] == pytest.approx(previews[-1]["test_psnr"], abs=1e-3)
    assert written["mean"]["lpips"] is None
    assert "lpips" in written["reasons"]["lpips"]
    assert [v["name"] for v in written["views"]] == run.config()["test"] == ["0", "8"]
    assert len(list(run.renders.glob("preview_*.png"))) == 10
    assert (run.renders / "test" / "8.png").is_file()


def test_eval_command_repeats_the_metrics(dataset, tmp_path, monkeypatch, capsys):
    """`drgs eval` measures from the files what `fit` measured."""
    from drgs.commands.options import Eval

    result = fit(dataset, tmp_path / "run", config(max_steps=5), progress=False)
    monkeypatch.setattr("drgs.data.load", lambda path, **_: dataset)
    run_eval(Eval(run=tmp_path / "run"))
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert again["mean"]["psnr"] == pytest.approx(result.metrics["mean"]["psnr"], abs=1e-3)
    assert {k: again[k] for k in ("step", "bad_steps", "seconds")} == {
        "step": 5,
        "bad_steps": 0,
        "seconds": result.seconds,
    }
    said = capsys.readouterr().out
    assert "2 test views" in said
    run_eval(Eval(run=tmp_path / "run", split="train"))
    again = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (again["split"], again["count"]) == ("train", 7)


def test_photographs_whose_mask_keeps_nothing_are_not_compared(dataset, tmp_path, monkeypatch, caplog):
    """A fit and `drgs eval` leave them out and name them, where they are held out and where nothing else is."""
    from drgs.commands.options import Eval

    write_png(tmp_path / "black.png", np.zeros((SIZE, SIZE, 3), np.float32))
    black = {"mask_path": tmp_path / "black.png"}
    views = [View(**{**vars(v), **(black if v.name in ("0", "1") else {})}) for v in dataset.views]
    made = Dataset(dataset.path, "transforms", views, dataset.points, dataset.colors, "made for a test")
    result = fit(made, tmp_path / "run", config(max_steps=2), progress=False)
    assert "fit: masks must keep at least one pixel, those of 1 of 2 views keep none (0);" in caplog.text
    assert [view["name"] for view in result.metrics["views"]] == ["8"]
    assert result.run.config()["test"] == ["0", "8"]
    monkeypatch.setattr("drgs.data.load", lambda path, **_: made)
    for split, count in (("train", 6), ("test", 1)):
        run_eval(Eval(run=tmp_path / "run", split=split))
        assert json.loads((tmp_path / "run" / "metrics.json").read_text())["count"] == count
    views[8] = View(**{**vars(views[8]), **black})
    with pytest.raises(ValueError, match="eval: split test must hold a view whose mask keeps a pixel, the 2 masks"):
        run_eval(Eval(run=tmp_path / "run"))
    alone = Dataset(dataset.path, "transforms", views[:3], dataset.points, dataset.colors, "made for a test")
    result = fit(alone, tmp_path / "alone", config(max_steps=2, test_every=0), progress=False)
    assert [view["name"] for view in result.metrics["renderers"]["rows"][0]["views"]] == ["2"]
    assert "those of 2 of 3 views keep none (0, 1);" in caplog.text


@pytest.mark.same_bits
def test_resumed_run_equals_an_uninterrupted_one(dataset, tmp_path, monkeypatch, two_threads):
    """With `deterministic`, interrupting at step 33 and resuming gives the same PLY, bit for bit."""
    cfg = config(deterministic=True)
    fit(dataset, tmp_path / "a", cfg, progress=False)
    step = Trainer.step

    def interrupt(self):
        if self.step_index == 32:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C during step 32: done once the step is
        return step(self)

    monkeypatch.setattr(Trainer, "step", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fit(dataset, tmp_path / "b", cfg, progress=False)
    monkeypatch.setattr(Trainer, "step", step)
    assert load_state(tmp_path / "b" / "state.safetensors")[1]["step"] == 33
    fit(dataset, tmp_path / "b", cfg, resume=True, progress=False)
    assert (tmp_path / "a" / "point_cloud.ply").read_bytes() == (tmp_path / "b" / "point_cloud.ply").read_bytes()
    events = [json.loads(x)["event"] for x in (tmp_path / "b" / "log.jsonl").read_text().splitlines()]
    assert events.index("interrupted") < events.index("resume") < events.index("done")


def test_killed_run_leaves_no_half_written_file(dataset, tmp_path, monkeypatch):
    """A run that dies while it writes its checkpoint keeps the previous one, and resumes from it."""
    cfg = config(max_steps=40, save_every=10)
    replace, calls = os.replace, []

    def die(source, target):
        calls.append(target)
        if str(target).endswith("state.safetensors") and sum(str(t).endswith("/state.safetensors") for t in calls) == 2:
            raise SystemExit(9)  # as if killed between writing and renaming
        replace(source, target)

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(SystemExit):
        fit(dataset, tmp_path / "run", cfg, progress=False)
    monkeypatch.setattr(os, "replace", replace)
    assert load_state(tmp_path / "run" / "state.safetensors")[1]["step"] == 10
    result = fit(dataset, tmp_path / "run", cfg, resume=True, progress=False)
    assert result.metrics["step"] == 40
    assert not [p for p in (tmp_path / "run").rglob("*.tmp")]


def test_resume_without_a_checkpoint_starts_over(dataset, tmp_path):
    """`--resume` in a script works on the first start too."""
    assert fit(dataset, tmp_path / "run", config(max_steps=2), resume=True, progress=False).metrics["step"] == 2


def test_bad_resumes_are_refused(dataset, tmp_path):
    """Another config, another data set, or a run folder in use each have their line."""
    fit(dataset, tmp_path / "run", config(max_steps=2), progress=False)
    with pytest.raises(ValueError, match="must be a new run folder, holds a run already"):
        fit(dataset, tmp_path / "run", config(max_steps=2), progress=False)
    with pytest.raises(ValueError, match="--resume must continue the same fit, seed was 0 and is 1"):
        fit(dataset, tmp_path / "run", config(max_steps=2, seed=1), resume=True, progress=False)
    fewer = Dataset(dataset.path, "transforms", dataset.views[:5], dataset.points, dataset.colors)
    with pytest.raises(ValueError, match="must have the same training views"):
        fit(fewer, tmp_path / "run", config(max_steps=2), resume=True, progress=False)


def test_bad_configs_are_refused(dataset, tmp_path):
    """Options out of range, unknown fields of a config.json, and data without views or points."""
    for field, value in {"max_steps": 0, "mask": "soft", "init_points": "x", "sh_degree": 4, "seed": -1}.items():
        with pytest.raises(ValueError, match=f"fit: {field} must be"):
            FitConfig().replace(**{field: value})
    with pytest.raises(ValueError, match="config must hold known fields, got 'foo'"):
        FitConfig.from_json({"foo": 1})
    assert FitConfig.from_json(config().to_json()) == config()
    with pytest.raises(ValueError, match="at least one training view, got none"):
        fit(Dataset(dataset.path, "transforms", []), tmp_path / "run", config(), progress=False)
    assert not (tmp_path / "run").exists()


def test_mask_keeps_the_outside_empty(dataset, tmp_path):
    """With object masks nothing is fitted outside: mean opacity there < 0.1 (measured: 0.03)."""
    data = masked(dataset)
    result = fit(data, tmp_path / "run", config(max_steps=120), progress=False)
    frames = load_frames(data.split()[1], SIZE * SIZE)
    assert all(f.is_object for f in frames)
    assert result.run.config()["masks"] == ["object"]
    for frame in frames:
        alpha = drgs.render(result.gaussians, frame.camera, FAST).alpha
        assert float((alpha * (1 - frame.mask)).sum() / (1 - frame.mask).sum()) < 0.1
    assert all(f.mask is None for f in load_frames(data.views, 100, "ignore"))
    assert not any(f.is_object for f in load_frames(data.views, 100, "valid"))


def test_alpha_keeps_what_is_transparent_empty(dataset, tmp_path, caplog):
    """Where photographs are transparent nothing is fitted: mean opacity there < 0.1 (measured: 0.04). The fit says what
    color is behind them.

    Black Gaussians before a black background are what colors alone do not forbid: with --mask ignore it is 0.84.
    """
    views, points = [], np.random.default_rng(0).uniform(-1, 1, (80, 3)).astype(np.float32)
    for view in dataset.views:
        out = drgs.render(scene(), view.camera, FAST)
        path = tmp_path / f"{view.name}.png"
        write_png(path, torch.cat([out.rgb / out.alpha.clamp(min=1e-3)[..., None], out.alpha[..., None]], 2).numpy())
        views.append(View(camera=view.camera, name=view.name, image_path=path))
    data = Dataset(tmp_path, "transforms", views, points, np.zeros((80, 3), np.float32), "made for a test")
    opacity = {}
    for mask in ("auto", "ignore"):
        options = config(max_steps=120, mask=mask, initial_opacity=0.5, opacity_weight=0.0)
        with caplog.at_level("INFO", "drgs"):
            result = fit(data, tmp_path / mask, options, progress=False)
        frames = load_frames(data.split()[1], SIZE * SIZE)
        empty = [frame.empty() for frame in frames]
        shown = [drgs.render(result.gaussians, frame.camera, FAST).alpha for frame in frames]
        opacity[mask] = float(
            sum((a * b).sum() for a, b in zip(shown, empty, strict=True)) / sum(map(torch.sum, empty))
        )
        assert result.run.config()["masks"] == ["alpha" if mask == "auto" else "none"]
    assert opacity["auto"] < 0.1 < opacity["ignore"]
    assert "by masks or alpha: 0 0 0 is behind them (--background; readers of D-NeRF's" in caplog.text
    np.testing.assert_array_equal(frames[0].target(), frames[0].image())  # all of it is compared


def test_images_are_reduced_with_their_cameras(dataset):
    """At most max_pixels, K scaled with the image."""
    frame = load_frames(dataset.views[:1], 300)[0]
    assert frame.pixels.shape == (17, 17, 3)
    assert (frame.camera.width, frame.camera.height) == (17, 17)
    assert frame.camera.K[0, 0] == pytest.approx(dataset.views[0].camera.K[0, 0] * 17 / SIZE)


def test_bad_gradients_skip_the_step_and_ten_end_the_fit(dataset):
    """A NaN costs one step, leaves no trace in parameters, and is counted; ten in a row end the fit."""
    trainer = trainer_of(dataset, config(noise=0.0))
    good = trainer.terms

    class Bad(Photometric):
        def __call__(self, output, frame, gaussians):
            return super().__call__(output, frame, gaussians) * math.nan

    trainer.step()
    before = trainer.gaussians().means.clone()
    trainer.terms = [Bad(0.2)]
    row = trainer.step()
    assert [e["event"] for e in row.events if e["event"] == "skipped"] == ["skipped"]
    assert torch.equal(before, trainer.gaussians().means)
    trainer.terms = good
    trainer.step()
    assert trainer.bad_steps == 1
    trainer.terms = [Bad(0.2)]
    for _ in range(9):
        trainer.step()
    with pytest.raises(ValueError, match="fit: loss and gradients must be finite, were not for 10 steps in a row"):
        trainer.step()


def test_every_view_is_seen_once_an_epoch(dataset):
    """Random order without repetition."""
    trainer = trainer_of(dataset, config())
    seen = [trainer._next_view() for _ in range(21)]
    assert all(sorted(seen[i : i + 7]) == list(range(7)) for i in (0, 7, 14))
    assert seen[:7] != seen[7:14]


# ---- Adam


@pytest.mark.parametrize("fused", [True, None])
def test_adam_is_that_of_torch(fused):
    """The same bits and the same state, parameters without a gradient among them."""
    found = []
    for kind in (Adam, torch.optim.Adam):
        moved, still = torch.linspace(-1, 1, 50).requires_grad_(), torch.ones(3).requires_grad_()
        optimizer = kind([{"params": [moved, still]}], lr=0.1, eps=1e-15, fused=fused)
        for _ in range(4):
            optimizer.zero_grad(set_to_none=True)
            (moved.square() * torch.arange(50)).sin().sum().backward()
            optimizer.step()
        found.append({"x": moved.detach(), **optimizer.state[moved]})
        assert torch.equal(still, torch.ones(3))
        assert still not in optimizer.state
    assert found[0].keys() == found[1].keys()
    assert all(torch.equal(x, found[1][name]) for name, x in found[0].items())


def test_steps_do_not_load_the_compiler():
    """Rows and networks step, with gradients of a rendering; torch's compiler takes as long to load as torch."""
    code = (
        "import sys, torch, drgs\n"
        "from drgs.cameras import orbit; from drgs.fitting.networks import Network; from drgs.fitting.rows import *\n"
        "rows = GaussianRows.from_points(torch.eye(3), torch.eye(3))\n"
        "network = Network('a', torch.nn.Linear(3, 3), 0.1)\n"
        "rgb = drgs.render(rows.gaussians(), orbit((0, 0, 0), 3.0, 1, width=8, height=8)[0]).rgb\n"
        "network.module(rgb).sum().backward()\n"
        "for optimizer in (rows.optimizer, network.optimizer): optimizer.step()\n"
        "print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


# ---- density control


def profile(opacity, scale, n, x):
    return 1 - (1 - opacity * torch.exp(-x * x / (2 * scale * scale))) ** n


@pytest.mark.parametrize("n", [1, 2, 7, 51])
def test_division_keeps_center_and_integral(n):
    """n copies have the center's opacity and the integral of one Gaussian, to 1e-9 (measured: 9e-13)."""
    x = torch.linspace(-14, 14, 2001, dtype=torch.float64)
    for opacity in (0.01, 0.5, 0.99, 0.9999):
        new, factor = divide(torch.tensor([opacity], dtype=torch.float64), torch.tensor([n]))
        copies = profile(new, factor, n, x)
        assert float(copies.max()) == pytest.approx(opacity, abs=1e-9)
        assert float(torch.trapezoid(copies, x)) == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-9)


def random_rows(n=30, dead=10):
    g = scene(n)
    rows = GaussianRows.from_points(g.means, torch.full((n, 3), 0.5), opacity=0.8)
    with torch.no_grad():
        rows.tensors["log_scales"].copy_(g.log_scales)
        rows.tensors["quats"].copy_(g.quats)
        rows.tensors["sh_dc"].copy_(g.sh)
        rows.tensors["logit_opacities"][:dead] = -9.0
    for x in rows.tensors.values():
        x.grad = torch.ones_like(x)
    rows.set_rates(dict.fromkeys(rows.tensors, 0.0))
    rows.optimizer.step()
    return rows


@pytest.mark.parametrize("kind", ["relocate", "add"])
def test_relocation_keeps_the_picture(kind):
    """Dead Gaussians move, or new ones come, and alpha stays within 0.05 (mean; measured: 0.01)."""
    rows, camera = random_rows(), orbit((0, 0, 0), 3.0, 1, width=SIZE, height=SIZE)[0]
    before = drgs.render(rows.gaussians().detach(), camera, FAST)
    generator = torch.Generator().manual_seed(0)
    if kind == "relocate":
        assert relocate(rows, 0.005, 0.01, generator) == 10
        assert relocate(rows, 0.005, 0.01, generator) == 0
        assert len(rows) == 30
    else:
        assert add_gaussians(rows, 12, 0.005, 0.01, generator) == 12
        assert len(rows) == 42
    after = drgs.render(rows.gaussians().detach(), camera, FAST)
    assert float((after.alpha - before.alpha).abs().mean()) < 0.05
    assert float((after.rgb - before.rgb).abs().mean()) < 0.05


def test_copies_are_jittered_and_start_without_moments():
    """No two Gaussians coincide, and moments are 0 exactly where something was replaced or added."""
    rows = random_rows()
    source_opacity = rows.tensors["logit_opacities"].detach().clone()
    relocate(rows, 0.005, 0.1, torch.Generator().manual_seed(0))
    means = rows.tensors["means"].detach()
    assert float(torch.pdist(means).min()) > 1e-4
    first = rows.optimizer.state[rows.tensors["means"]]["exp_avg"]
    assert torch.equal(first[:10], torch.zeros(10, 3))
    assert bool((first[10:] != 0).all())
    divided = (rows.tensors["logit_opacities"].detach() != source_opacity)[10:]
    opacity_moment = rows.optimizer.state[rows.tensors["logit_opacities"]]["exp_avg_sq"][10:]
    assert torch.equal(opacity_moment == 0, divided)
    add_gaussians(rows, 5, 0.005, 0.1, torch.Generator().manual_seed(0))
    for x in rows.tensors.values():
        state = rows.optimizer.state[x]
        assert state["exp_avg"].shape == x.shape
        if x.numel():
            assert not state["exp_avg"][-5:].any()


def test_density_control_without_anything_to_do():
    """No Gaussian dead, all dead, or none to add: nothing happens."""
    generator = torch.Generator().manual_seed(0)
    assert relocate(random_rows(dead=0), 0.005, 0.1, generator) == 0
    assert relocate(random_rows(5, dead=5), 0.005, 0.1, generator) == 0
    assert add_gaussians(random_rows(), -3, 0.005, 0.1, generator) == 0


def test_noise_moves_only_the_transparent():
    """Opaque Gaussians stay where the gradient put them, whatever the unit of length."""
    moved = []
    for unit in (1.0, 1000.0):
        rows = random_rows()
        with torch.no_grad():
            rows.tensors["means"] *= unit
            rows.tensors["log_scales"] += math.log(unit)
        before = rows.tensors["means"].detach().clone()
        explore(rows, 1.6e-4, 5.0 * unit, 5e5, torch.Generator().manual_seed(0))
        moved.append((rows.tensors["means"].detach() - before) / unit)
    assert torch.equal(moved[0][10:], torch.zeros(20, 3))
    assert bool((moved[0][:10] != 0).all())
    assert torch.allclose(moved[0], moved[1], rtol=1e-3, atol=1e-6)


def test_growing_the_degree_keeps_rows_and_moments():
    """New SH coefficients are 0, old ones and their moments stay."""
    rows = random_rows()
    rows.raise_sh_degree()
    with torch.no_grad():
        rows.tensors["sh_rest"].copy_(torch.randn(30, 3, 3))
    old = rows.tensors["sh_rest"].detach().clone()
    rows.raise_sh_degree()
    assert (rows.sh_degree, rows.gaussians().sh.shape) == (2, (30, 9, 3))
    assert torch.equal(rows.tensors["sh_rest"].detach()[:, :3], old)
    assert not rows.tensors["sh_rest"].detach()[:, 3:].any()
    rows.raise_sh_degree()
    assert rows.sh_degree == 3


def test_initial_scales_are_neighbor_distances():
    """sqrt(mean squared distance to the 3 nearest), as 3DGS; coincident points stay apart from 0."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9], [9, 9, 9]])
    rows = GaussianRows.from_points(points, torch.zeros(6, 3))
    scales = rows.tensors["log_scales"].detach().exp()[:, 0]
    assert float(scales[0]) == pytest.approx(math.sqrt(14 / 3), rel=1e-5)
    same = GaussianRows.from_points(torch.zeros(5, 3), torch.zeros(5, 3)).tensors["log_scales"]
    assert bool(torch.isfinite(same).all())
    assert torch.isfinite(GaussianRows.from_points(torch.zeros(1, 3), torch.zeros(1, 3)).tensors["log_scales"]).all()


# ---- losses


def test_ssim_gradient_is_the_derivative(rng):
    """The adjoint by hand equals central differences in float64."""
    x = torch.from_numpy(rng.random((13, 9, 3))).requires_grad_()
    y = torch.from_numpy(rng.random((13, 9, 3)))
    assert torch.autograd.gradcheck(lambda a: padded_ssim(a, y), x)


def test_ssim_is_zero_padded(rng):
    """The loss equals SSIM written out with a padded 11x11 convolution, to 1e-5."""
    x, y = (torch.from_numpy(rng.random((40, 50, 3), dtype=np.float32)) for _ in range(2))
    y = 0.7 * x + 0.3 * y
    kernel = torch.exp(-((torch.arange(11.0) - 5) ** 2) / (2 * 1.5**2))
    kernel = torch.outer(kernel, kernel)[None, None] / kernel.sum() ** 2

    def blur(a):
        return torch.nn.functional.conv2d(a.permute(2, 0, 1)[:, None], kernel, padding=5)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    want = ((2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()
    assert float(padded_ssim(x, y)) == pytest.approx(float(want), abs=1e-5)
    assert torch.equal(padded_ssim(x, y), ssim_map(x, y).permute(2, 0, 1).mean())


def test_loss_sees_only_the_mask(rng):
    """Outside the mask colors have no gradient and opacity has."""
    rgb, target = (torch.from_numpy(rng.random((20, 20, 3), dtype=np.float32)) for _ in range(2))
    alpha = torch.full((20, 20), 0.5, requires_grad=True)
    mask = torch.zeros(20, 20)
    mask[:10] = 1
    rgb.requires_grad_()
    shown, frame = Output(rgb, alpha), Frame("a", None, target, mask, is_object=True)
    (Photometric(0.2)(shown, frame, None) + Outside(1.0)(shown, frame, None)).backward()
    assert not rgb.grad[10:].any()
    assert bool((rgb.grad[:10] != 0).any())
    assert not alpha.grad[:10].any()
    assert bool((alpha.grad[10:] > 0).all())
    valid = dataclasses.replace(frame, is_object=False)
    assert Outside(1.0)(shown, valid, None) is None
    covered = torch.zeros(20, 20)
    covered[:, :5] = 1
    assert torch.equal(dataclasses.replace(valid, alpha=covered).empty(), 1 - covered)
    assert torch.equal(dataclasses.replace(frame, alpha=covered).empty(), 1 - mask * covered)
    exact = torch.zeros(12, 12, 3)
    assert float(Photometric(0.2)(Output(exact, alpha), Frame("a", None, exact), None)) == pytest.approx(0, abs=1e-6)
