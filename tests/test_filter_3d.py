"""Claims of components.filter_3d: the formulas in float64, and fits whose pictures and files have the filter."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_train import config, dataset, scene, trainer_of  # noqa: F401 (a fixture)

import drgs
from drgs.cameras import Camera, intrinsics, look_at
from drgs.commands.eval import run as run_eval
from drgs.commands.options import Eval
from drgs.ellipsoids import semi_axes
from drgs.files import load_state, save_state
from drgs.fitting.components.filter_3d import VARIANCES, Filter3D, filtered, sampling_rates
from drgs.fitting.evaluation import evaluate_run
from drgs.fitting.records import check_checkpoint, load_run
from drgs.fitting.resume import lock_run
from drgs.io.run import Run
from drgs.train import Trainer, fit


def camera(depth: float, focal: float = 50.0) -> Camera:
    """64x48 pixels, at (0, 0, -depth), looking along z."""
    return Camera(intrinsics(focal, focal, 32.0, 24.0), look_at((0, 0, -depth), (0, 0, 0), (0, -1, 0)), 64, 48)


def covariances(g: drgs.Gaussians) -> torch.Tensor:
    axes = semi_axes(g.quats.double(), g.log_scales.double().exp())
    return axes @ axes.transpose(1, 2)


def test_it_is_a_convolution_that_keeps_each_integral():
    """Covariances get v I, opacities sqrt(|S| / |S'|), as matrices in float64, from far below to far above S."""
    g = scene()
    g = g.replace(log_scales=g.log_scales.double(), logit_opacities=g.logit_opacities.double())
    variances = torch.logspace(-6, 2, len(g), dtype=torch.float64)
    shown = filtered(g, variances)
    wanted = covariances(g) + variances[:, None, None] * torch.eye(3, dtype=torch.float64)
    assert torch.allclose(covariances(shown), wanted, rtol=1e-9, atol=1e-12)
    ratio = (torch.linalg.det(covariances(g)) / torch.linalg.det(wanted)).sqrt()
    opacities = g.logit_opacities.double().sigmoid() * ratio
    assert torch.allclose(shown.logit_opacities.double().sigmoid(), opacities, rtol=1e-9, atol=0)
    assert torch.equal(shown.means, g.means)
    assert torch.equal(shown.sh, g.sh)


def test_no_variance_changes_nothing():
    """Log scales keep their bits, logits all but the last, whatever they are."""
    g = scene(3).replace(logit_opacities=torch.tensor([-30.0, 0.5, 17.0]))
    shown = filtered(g, torch.zeros(3))
    assert torch.equal(shown.log_scales, g.log_scales)
    assert torch.allclose(shown.logit_opacities, g.logit_opacities, rtol=3e-7, atol=0)


def test_gradients_are_those_of_finite_differences():
    """By log scales and logits, also where the filter is much wider than the Gaussian, and where it is none."""
    g = scene(5)
    variances = torch.tensor([0.0, 1e-4, 0.01, 1.0, 1e-2], dtype=torch.float64)

    def shown(log_scales: torch.Tensor, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        made = filtered(g.replace(log_scales=log_scales, logit_opacities=logits), variances)
        return made.log_scales, made.logit_opacities

    at = [x.double().requires_grad_() for x in (g.log_scales, torch.tensor([-4.0, 0.0, 2.0, -1.0, 9.0]))]
    assert torch.autograd.gradcheck(shown, at)


def test_the_camera_that_samples_most_finely_counts():
    """f / z, its largest over the cameras that see a mean; 0 behind all of them, beside their images, and of none."""
    cameras = [camera(4.0), camera(2.0, 20.0)]
    means = np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, -3.0], [0, 0, -5.0], [40.0, 0, 0]])
    assert sampling_rates(means, cameras) == pytest.approx([50 / 4, 50 / 5, 50 / 1, 0, 0])
    assert sampling_rates(means, []).tolist() == [0] * 5


def test_a_mean_a_little_beside_an_image_is_seen():
    """Up to 15 % of its side, as far as its Gaussian may reach in."""
    beside = lambda share: [[(0.5 + share) * 64 * 4.0 / 50, 0, 0]]  # noqa: E731
    assert sampling_rates(np.array(beside(0.14)), [camera(4.0)])[0] > 0
    assert sampling_rates(np.array(beside(0.16)), [camera(4.0)])[0] == 0


def test_what_lenses_see_beside_and_behind_is_sampled_by_its_distance():
    """A fisheye and a panorama have pixels a radian, wherever they look."""
    plain = camera(4.0, 20.0)
    means = np.array([[0, 0, 0], [0.01, 0, -4.2], [3.0, 0, -4.0]])
    fisheye = dataclasses.replace(plain, model="opencv_fisheye", distortion=(0.0,) * 4)
    assert sampling_rates(means, [fisheye]) == pytest.approx([20 / 4, 0, 20 / 3])
    K = intrinsics(64 / (2 * np.pi), 48 / np.pi, 32.0, 24.0)
    around = dataclasses.replace(plain, K=K, model="equirectangular")
    focal = 48 / np.pi
    assert sampling_rates(means, [around]) == pytest.approx([focal / 4, focal / np.hypot(0.2, 0.01), focal / 3])


def test_what_nobody_sees_has_the_widest_filter():
    """The variance is 0.2 / nu^2; there is none where nothing is seen at all."""
    module = Filter3D()
    module.sample(torch.tensor([[0, 0, 0], [0, 0, 1.0], [0, 0, -9.0]]), [camera(4.0)])
    assert module.variances.tolist() == pytest.approx([0.2 * (4 / 50) ** 2, 0.2 * (5 / 50) ** 2, 0.2 * (5 / 50) ** 2])
    module.sample(torch.tensor([[0, 0, -9.0]]), [camera(4.0)])
    assert module.variances.tolist() == [0]


def test_a_run_shows_and_saves_the_filtered_ones(dataset, tmp_path):  # noqa: F811
    """PLY, result and loaded run are the same bits, none narrower than sqrt(0.2) pixels in any photograph; what is
    fitted are narrower ones."""
    run = fit(dataset, tmp_path / "run", config(filter_3d="on"), progress=False)
    shown, held = load_run(run.run).gaussians, drgs.load_ply(run.run.point_cloud)
    for name, x in run.gaussians.parameters().items():
        assert torch.equal(x, shown.parameters()[name])
        assert torch.equal(x, held.parameters()[name])
    tensors, _ = load_state(run.run.state)
    rates = 1 / torch.from_numpy(sampling_rates(shown.means.numpy(), [v.camera for v in dataset.split()[0]]))
    narrowest = shown.scales.amin(1)
    assert bool((narrowest.square() >= tensors[VARIANCES] * (1 - 1e-6)).all())
    # Rates are of the last density control, since when Gaussians have moved a little.
    assert torch.allclose(tensors[VARIANCES].double(), 0.2 * rates.square(), rtol=0.1)
    assert bool((tensors["parameter.log_scales"].exp() < shown.scales).all())
    assert run.run.config()["fit"]["filter_3d"] == "on"


def test_rates_follow_density_control(dataset):  # noqa: F811
    """After a step with density control there is a variance a Gaussian, of where it was then; later steps keep them."""
    trainer = trainer_of(dataset, config(filter_3d="on"))
    before = trainer.component("filter_3d").filter.variances
    assert len(before) == len(trainer.rows)
    while not any(event["event"] == "density" and event["added"] for event in trainer.step().events):
        pass
    after = trainer.component("filter_3d").filter.variances
    assert len(after) == len(trainer.rows) > len(before)
    trainer.step()
    assert torch.equal(trainer.component("filter_3d").filter.variances, after)
    trainer.add_points(torch.zeros(2, 3), torch.zeros(2, 3), 0.1, 1.0)
    assert len(trainer.scene()) == len(trainer.rows) == len(after) + 2


@pytest.mark.same_bits
def test_a_resumed_fit_keeps_its_rates(dataset, tmp_path):  # noqa: F811
    """Between two times of density control a checkpoint goes on to the same bits; one without its rates is refused."""
    whole = trainer_of(dataset, config(filter_3d="on"))
    for _ in range(21):
        whole.step()
    tensors, header = whole.state()
    path = tmp_path / "state.safetensors"
    save_state(path, tensors, header | {"point_source": "here"})
    tensors, header = load_state(path)
    check_checkpoint(path, tensors, header)
    again = Trainer.from_state(whole.config, whole.frames, tensors, header, "here")
    for _ in range(9):
        whole.step()
        again.step()
    one, two = whole.state()[0], again.state()[0]
    assert all(torch.equal(one[name], two[name]) for name in one)
    with pytest.raises(ValueError, match="filter_3d must be torch.float32 of shape"):
        check_checkpoint(path, {name: x for name, x in tensors.items() if name != VARIANCES}, header)
    with pytest.raises(ValueError, match="filter_3d was 'on' and is 'off'"):
        Trainer.from_state(config(), whole.frames, tensors, header, "here")


def test_without_it_there_is_nothing_of_it(dataset):  # noqa: F811
    """The Gaussians are the rows themselves, and a checkpoint has no rates."""
    trainer = trainer_of(dataset, config())
    assert trainer.component("filter_3d").filter is None
    assert VARIANCES not in trainer.state()[0]
    assert torch.equal(trainer.gaussians().log_scales, trainer.rows.tensors["log_scales"])


def test_it_is_refused_where_things_move(dataset, tmp_path):  # noqa: F811
    """Rates of Gaussians at rest are not those of Gaussians that move; where nothing moves it is not asked."""
    for i, view in enumerate(dataset.views):
        view.camera = dataclasses.replace(view.camera, time=float(i))
    with pytest.raises(NotImplementedError, match="filter_3d must be off where things move, got on: .*; leave"):
        fit(dataset, tmp_path / "run", config(filter_3d="on"), progress=False)
    still = config(filter_3d="on", dynamics="ignore", max_steps=1)
    fit(dataset, tmp_path / "still", still, progress=False)


def test_eval_measures_larger_pictures(dataset, tmp_path, monkeypatch):  # noqa: F811
    """`drgs eval --scale 2` of a fit to a quarter of the pixels has all of them, and says so; more there are not."""
    monkeypatch.setattr("drgs.data.load", lambda path, **_: dataset)
    fit(dataset, tmp_path / "run", config(max_steps=5, max_pixels=256), progress=False)
    before = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (before["views"][0]["width"], before.get("scale")) == (16, None)
    run_eval(Eval(run=tmp_path / "run", scale=2.0))
    after = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (after["views"][0]["width"], after["views"][0]["height"], after["scale"]) == (32, 32, 2.0)
    assert after["renderers"]["width"] == 32
    with pytest.raises(ValueError, match="eval: scale must be at most 2, since photograph 0 has 32x32 pixels, got 3"):
        run_eval(Eval(run=tmp_path / "run", scale=3.0))
    with pytest.raises(ValueError, match=r"--scale must be in \[1, 1000\], got 0.5"):
        Eval(run=tmp_path / "run", scale=0.5)
    run = Run(tmp_path / "run")
    with pytest.raises(ValueError, match="eval: scale must be at least 1, got 0.5"):
        evaluate_run(run, lock_run(run, "eval"), scale=0.5)
