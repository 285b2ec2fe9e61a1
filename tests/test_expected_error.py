"""The expected error of a pixel: against dense sums of the float64 oracle, and that what is wrong is told."""

from __future__ import annotations

import dataclasses
import json
import math

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from scenes_random import camera

import drgs
from drgs import reference
from drgs.cameras import orbit
from drgs.checks.arguments import ArgumentError
from drgs.fitting.semantic_errors import wrong_label
from drgs.information.backdrop import backdrop_cells
from drgs.information.expected_error import (
    ANGLE,
    NEW_DIRECTION,
    OFF_DIAGONAL,
    PARTS,
    PIVOT,
    UNSEEN,
    error_parts,
    residual_record,
)
from drgs.settings import RenderSettings


@pytest.fixture
def settings():
    return RenderSettings.preset("exact", background=(0.2, 0.5, 0.7))


def seen(g, cam, settings):
    """(pixels, N) weights and (H, W, 3) colors of the oracle."""
    every = dataclasses.replace(g.detach(), features=torch.eye(len(g)))
    out = reference.render(every, cam, settings)
    return out.features.reshape(-1, len(g)).detach(), out.rgb.detach()


def noisy(rng, image):
    """A photograph that is not what is rendered."""
    return (image + torch.from_numpy(rng.normal(0, 0.1, tuple(image.shape)))).clamp(0, 1).float()


@pytest.mark.core
def test_brute_force(rng, settings):
    """Every part, from the oracle's weights and its Jacobian, of two views of different masks."""
    g, cam, out = dense.scene(rng, settings, K=4)
    others = [camera(rng, (12, 10)) for _ in range(2)]
    masks = [None, torch.from_numpy(rng.uniform(size=(others[1].height, others[1].width))).float()]
    images, told, pixels, behind, contrast = [], [], [], [0.0, 0.0], [0.0, 0.0]
    H = {name: 0.0 for name in dense.GROUPS}
    sphere = drgs.fisher.backdrop_sphere(g, others)
    cells = torch.zeros(1536, dtype=torch.float64)
    for other, mask in zip(others, masks, strict=True):
        w, rgb = seen(g, other, settings)
        images.append(noisy(rng, rgb))
        e = (rgb.clamp(0, 1) - images[-1]).square().mean(2).reshape(-1)
        m = torch.ones(len(e), dtype=torch.float64) if mask is None else mask.double().reshape(-1)
        T = 1 - w.sum(1)
        pixels.append((w * m[:, None]).sum(0))
        told.append((w * (m * e)[:, None]).sum(0))
        behind = [behind[0] + float((T * m).sum()), behind[1] + float((T * m * e).sum())]
        far = (images[-1] - torch.tensor(settings.background)).square().mean(2).reshape(-1)
        contrast = [contrast[0] + float(m.sum()), contrast[1] + float((far * m).sum())]
        J = dense.jacobian(g, reference.render(g, other, settings))
        H = {
            name: H[name] + dense.squares({name: x * m.repeat_interleave(3).reshape(-1, *[1] * (x.ndim - 1))})[name]
            for name, x in J.items()
        }
        cells.index_add_(0, backdrop_cells(other, sphere).flatten(), (T * m).square())
    mean = float((sum(told).sum() + behind[1]) / (sum(pixels).sum() + behind[0]))
    misfit = (sum(told) + mean) / (sum(pixels) + 1)
    towards = lambda c: torch.nn.functional.normalize(g.means.detach().double() - torch.from_numpy(c.center), dim=1)  # noqa: E731
    near = [
        torch.exp(-0.5 * (torch.arccos((towards(cam) * towards(o)).sum(1).clamp(-1, 1)) / ANGLE).square())
        for o in others
    ]
    n = sum(k * x for k, x in zip(near, pixels, strict=True))
    fitted = sum(k * x for k, x in zip(near, told, strict=True)) / (n + 1)
    w, _ = seen(g, cam, settings)
    T = 1 - w.sum(1)
    J = dense.jacobian(g, out)
    variance = 0.0
    for name, x in J.items():
        prior = drgs.gain.unit_length(g, others) ** -2 if name == "means" else 1.0
        per = misfit.reshape(-1, *[1] * (x.ndim - 2)) / (H[name] + prior)
        variance = variance + (x.square() * per).flatten(1).sum(1).reshape(-1, 3).sum(1)
    truth = {
        "misfit": w @ fitted + T * NEW_DIRECTION * (behind[1] + mean) / (behind[0] + 1),
        "direction": w @ (NEW_DIRECTION * misfit / (n + 1)),
        "information": OFF_DIAGONAL / 3 * variance,
        "unseen": UNSEEN * contrast[1] / contrast[0] * T.square() / (cells[backdrop_cells(cam, sphere)].flatten() + 1),
    }
    record = drgs.error_record(g, others, images, settings, masks=masks)
    assert float((record.misfit - misfit).abs().max()) <= 1e-4 * float(misfit.max())
    found = error_parts(g, cam, record)
    assert tuple(found) == tuple(truth) == PARTS
    for name, x in truth.items():
        assert float((found[name].reshape(-1) - x).abs().max()) <= 2e-4 * float(x.max()), name
    total = drgs.expected_error(g, cam, record)
    assert total.shape == (cam.height, cam.width)
    assert total.dtype == torch.float32
    torch.testing.assert_close(total, sum(found.values()))


@pytest.fixture(scope="module")
def ring():
    """A ball of Gaussians, and eight cameras around it."""
    rng = np.random.default_rng(3)
    means = rng.normal(size=(60, 3))
    means *= 0.5 / np.linalg.norm(means, axis=1, keepdims=True)
    colors = rng.uniform(-1, 1, (60, 1, 3))
    quats = np.tile([1.0, 0, 0, 0], (60, 1))
    g = drgs.Gaussians.from_arrays(means, quats, np.full((60, 3), 0.15), np.full(60, 0.9), colors)
    return g, orbit((0, 0, 0), 3.0, 8, width=32, height=24)


def photographs(g, cameras, settings=None):
    return [drgs.render(g, c, settings, outputs=()).rgb.clamp(0, 1) for c in cameras]


def test_the_unit_and_the_zero_of_the_world_do_not_matter(ring):
    """The same in kilometers, somewhere else."""
    g, cameras = ring
    images = photographs(g.replace(sh=-g.sh), cameras[:4])
    near = drgs.expected_error(g, cameras[5], drgs.error_record(g, cameras[:4], images))
    zero = np.array([5e5, 5.4e6, 120.0])
    other = g.replace(means=g.means * 1e-3, log_scales=g.log_scales + math.log(1e-3), origin=zero)
    moved = []
    for c in cameras:
        w2c = c.w2c.copy()
        w2c[:3, 3] = w2c[:3, 3] * 1e-3 - w2c[:3, :3] @ zero
        moved.append(dataclasses.replace(c, w2c=w2c))
    far = drgs.expected_error(other, moved[5], drgs.error_record(other, moved[:4], images))
    assert float((far - near).abs().max()) <= 1e-3 * float(near.max())


def test_calibration(ring, rng):
    """Power and pivot, from what a record of the other views says of a quarter of the second of three views."""
    g, cameras = ring
    cameras = cameras[:3]
    images = [noisy(rng, x * (1 + 0.2 * k)) for k, x in enumerate(photographs(g, cameras))]
    masks = [torch.from_numpy(rng.uniform(size=(24, 32))).float() for _ in cameras]
    record = drgs.error_record(g, cameras, images, masks=masks)
    others = drgs.error_record(g, [cameras[0], cameras[2]], [images[0], images[2]], masks=[masks[0], masks[2]])
    assert (others.pivot, others.power) == (1, 1)  # two views say too little of each other
    parts = error_parts(g, cameras[1], others)
    n = (parts["misfit"] + parts["direction"])[:12, :16].double()
    shown = drgs.render(g, cameras[1], outputs=()).rgb
    e = (shown.clamp(0, 1) - images[1]).square().mean(2)[:12, :16].double()
    w = masks[1][:12, :16].double() / masks[1][:12, :16].sum()
    powers = torch.linspace(0.25, 1.6, 2000, dtype=torch.float64)
    minus = torch.stack([(w * e * n**-p).sum().log() + p * (w * n.log()).sum() for p in powers])
    assert record.power == pytest.approx(float(powers[minus.argmin()]), abs=2e-3)
    assert 0.26 < record.power < 1.59
    assert record.pivot == pytest.approx(PIVOT * float((w * n).sum()), rel=1e-4)
    plain = drgs.expected_error(g, cameras[1], dataclasses.replace(record, power=1.0))
    found = error_parts(g, cameras[1], record)
    total = drgs.expected_error(g, cameras[1], record)
    below = plain < record.pivot
    assert 0.1 < float(below.double().mean()) < 1
    torch.testing.assert_close(total[below], (record.pivot * (plain / record.pivot) ** record.power)[below])
    torch.testing.assert_close(total[~below], plain[~below])
    torch.testing.assert_close(total, sum(found.values()))  # parts keep their shares


@pytest.mark.parametrize("preset", ["exact", "fast"])
def test_sums_of_views_add_up(preset, ring):
    """What two views say is what each says; no view is kept but its sums, and its place."""
    g, cameras = ring
    settings = RenderSettings.preset(preset)
    images = [(x + 0.1 * k).clamp(0, 1) for k, x in enumerate(photographs(g, cameras[:2], settings), 1)]
    sphere = drgs.fisher.backdrop_sphere(g, cameras[:2])
    both = drgs.error_record(g, cameras[:2], images, settings, sphere=sphere)
    each = [drgs.error_record(g, c, [x], settings, sphere=sphere) for c, x in zip(cameras, images, strict=False)]
    torch.testing.assert_close(both.weights, torch.cat([x.weights for x in each], 1))
    torch.testing.assert_close(both.residuals, torch.cat([x.residuals for x in each], 1))
    torch.testing.assert_close(both.behind, each[0].behind + each[1].behind)
    for name, x in both.information.items():
        torch.testing.assert_close(x, each[0].information[name] + each[1].information[name])
    twice = drgs.error_record(g, [cameras[0], cameras[0]], [images[0], images[0]], settings, sphere=sphere)
    assert twice.places.shape == (1, 3)
    torch.testing.assert_close(twice.residuals, 2 * each[0].residuals)


def test_many_views_share_places(ring):
    """A record of more views than places is no larger, and has all of their pixels."""
    g, _ = ring
    cameras = orbit((0, 0, 0), 3.0, 80, width=8, height=6)
    record = drgs.error_record(g, cameras, photographs(g, cameras), RenderSettings.preset("exact"))
    assert record.weights.shape == record.residuals.shape == (60, 64)
    assert record.views == 80
    one = drgs.fisher.coverage(g, cameras)  # sum w^2 <= sum w
    assert bool((record.weights.double().sum(1) >= one * (1 - 1e-5)).all())


def test_a_wrong_color_is_told(ring):
    """A Gaussian whose color is wrong in training views has the largest misfit, and its pixels of another view, too."""
    g, cameras = ring
    train, other = [c for k, c in enumerate(cameras) if k != 2], cameras[2]
    which = int(drgs.render(g, other, outputs="visibility").visibility.argmax())
    wrong = g.sh.clone()
    wrong[which] += 2.0
    wrong = g.replace(sh=wrong)
    record = drgs.error_record(wrong, train, photographs(g, train))
    assert int(record.misfit.argmax()) == which
    parts = error_parts(wrong, other, record)
    told = (parts["misfit"] + parts["direction"]).flatten()
    true, shown = (drgs.render(x, other, outputs=()).rgb.clamp(0, 1) for x in (g, wrong))
    top = (true - shown).square().mean(2).flatten().argsort(descending=True)[:20]
    assert float(told[top].mean()) > 3 * float(told.mean())


def test_a_new_direction_is_told(ring):
    """The part of the direction is larger the farther a view is from the photographed ones; unseen cells, too."""
    g, cameras = ring
    images = [(x + 0.05).clamp(0, 1) for x in photographs(g, cameras[:1])]
    record = drgs.error_record(g, cameras[:1], images)
    direction = [float(error_parts(g, c, record)["direction"].mean()) for c in (cameras[0], cameras[1], cameras[4])]
    assert direction[0] < 0.3 * direction[1]
    assert direction[1] <= 1.5 * direction[2]
    unseen = [float(error_parts(g, c, record)["unseen"].mean()) for c in (cameras[0], cameras[4])]
    assert unseen[0] < 0.5 * unseen[1]


def test_units(ring):
    """An even error of 0.1 in all training views is told as one of that size where they look from; ten times smaller
    residuals are a root that is ten times smaller.
    """
    g, cameras = ring
    shown = photographs(g, cameras)
    errors = []
    for size in (0.1, 0.01):
        record = drgs.error_record(g, cameras, [torch.where(x > 0.5, x - size, x + size) for x in shown])
        assert math.sqrt(record.mean_misfit) == pytest.approx(size, rel=1e-3)
        parts = error_parts(g, cameras[0], record)
        covered = drgs.render(g, cameras[0], outputs=()).alpha > 0.95
        errors.append(float((parts["misfit"] + parts["direction"])[covered].mean().sqrt()))
    assert 0.05 < errors[0] < 0.2
    assert errors[0] == pytest.approx(10 * errors[1], rel=1e-2)


def test_state(ring):
    """A record goes through tensors and JSON."""
    g, cameras = ring
    images = photographs(g.replace(sh=-g.sh), cameras[:4])
    record = drgs.error_record(g, cameras[:4], images, RenderSettings.preset("fast"))
    assert record.power != 1
    tensors, header = record.to_state()
    again = drgs.ErrorRecord.from_state(tensors, json.loads(json.dumps(header)))
    assert again.settings == record.settings
    assert again.sphere == record.sphere
    assert torch.equal(drgs.expected_error(g, cameras[3], again), drgs.expected_error(g, cameras[3], record))


class Sliding:
    """Gaussians that move along x."""

    def __init__(self, g, speed):
        self.g, self.speed = g, speed

    def at(self, time):
        return self.g.replace(means=self.g.means + torch.tensor([self.speed * (time or 0.0), 0, 0]))

    def parameters(self):
        return self.g.parameters()


def test_what_moves(ring):
    """Each view is compared with the scene at its time."""
    g, cameras = ring
    timed = [dataclasses.replace(camera, time=k / 7) for k, camera in enumerate(cameras)]
    moving, still = Sliding(g, 0.5), Sliding(g, 0.0)
    images = photographs(moving, timed)
    right, wrong = (drgs.error_record(x, timed[:4], images[:4]) for x in (moving, still))
    assert right.mean_misfit < 1e-9 < 1e-4 < wrong.mean_misfit
    assert float(drgs.expected_error(still, timed[4], wrong).mean()) > 1e-4
    plain = drgs.error_record(g, cameras[:4], images[:4])
    torch.testing.assert_close(wrong.residuals, plain.residuals)


def test_no_gaussians():
    """Of nothing, all is unseen, and as wrong everywhere, by which nothing can be calibrated."""
    g = drgs.Gaussians.from_arrays(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3))
    )
    cameras = orbit((0, 0, 0), 3.0, 4, width=8, height=6)
    record = drgs.error_record(g, cameras[:3], [torch.full((6, 8, 3), 0.5)] * 3)
    assert record.power == 1
    error = drgs.expected_error(g, cameras[3], record)
    assert bool(torch.isfinite(error).all())
    assert float(error.min()) > 0


BAD = {
    "no view": (lambda c, x: ([], []), "there must be at least one camera, got none"),
    "no image": (lambda c, x: (c, x[:1]), "images must be a list with one for each of 2 cameras, got 1"),
    "size": (lambda c, x: (c, [x[0], x[1][:5]]), r"images\[1\] must be \(24, 32, 3\) like its camera"),
    "bytes": (lambda c, x: (c, [(y * 255).byte() for y in x]), "divide bytes by 255"),
    "NaN": (lambda c, x: (c, [x[0], x[1] * float("nan")]), r"images\[1\] must be finite floats"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_views(name, ring):
    """One line says what is wrong."""
    g, cameras = ring
    change, message = BAD[name]
    with pytest.raises(ValueError, match=message) as caught:
        drgs.error_record(g, *change(cameras[:2], photographs(g, cameras[:2])))
    assert "\n" not in str(caught.value)


def test_no_residual_and_another_scene(ring):
    """Views all of whose pixels are masked have no residual; a record is of one scene."""
    g, cameras = ring
    images = photographs(g, cameras[:2])
    with pytest.raises(ValueError, match="masks must leave a pixel whose residual counts"):
        drgs.error_record(g, cameras[:2], images, masks=[torch.zeros(24, 32)] * 2)
    record = drgs.error_record(g, cameras[:2], images)
    few = drgs.Gaussians(**{name: x[:59] for name, x in g.parameters().items()})
    with pytest.raises(ValueError, match="scene must be that of the record, with 60 Gaussians, got 59"):
        drgs.expected_error(few, cameras[2], record)
    with pytest.raises(ArgumentError, match="what drgs.error_record returns"):
        drgs.expected_error(g, cameras[2], None)


def test_residuals_of_another_kind(rng, settings):
    """Labels that are right or wrong: every part, from the oracle's weights, of two views of different masks."""
    g, cam, _ = dense.scene(rng, settings, K=4)
    others = [camera(rng, (12, 10)) for _ in range(2)]
    masks = [None, torch.from_numpy(rng.uniform(size=(others[1].height, others[1].width))).float()]
    residuals = [torch.from_numpy(rng.integers(0, 2, (c.height, c.width))).float() for c in others]
    told, pixels, behind = [], [], [0.0, 0.0]
    for other, mask, residual in zip(others, masks, residuals, strict=True):
        w, _ = seen(g, other, settings)
        m = torch.ones(len(w), dtype=torch.float64) if mask is None else mask.double().reshape(-1)
        e, T = residual.double().reshape(-1), 1 - w.sum(1)
        pixels.append((w * m[:, None]).sum(0))
        told.append((w * (m * e)[:, None]).sum(0))
        behind = [behind[0] + float((T * m).sum()), behind[1] + float((T * m * e).sum())]
    mean = float((sum(told).sum() + behind[1]) / (sum(pixels).sum() + behind[0]))
    misfit = (sum(told) + mean) / (sum(pixels) + 1)
    towards = lambda c: torch.nn.functional.normalize(g.means.detach().double() - torch.from_numpy(c.center), dim=1)  # noqa: E731
    near = [
        torch.exp(-0.5 * (torch.arccos((towards(cam) * towards(o)).sum(1).clamp(-1, 1)) / ANGLE).square())
        for o in others
    ]
    n = sum(k * x for k, x in zip(near, pixels, strict=True))
    w, _ = seen(g, cam, settings)
    T = 1 - w.sum(1)
    fitted = sum(k * x for k, x in zip(near, told, strict=True)) / (n + 1)
    truth = {
        "misfit": w @ fitted + T * NEW_DIRECTION * (behind[1] + mean) / (behind[0] + 1),
        "direction": w @ (NEW_DIRECTION * misfit / (n + 1)),
        "unseen": 0.7 * T.square(),
    }
    record = residual_record(g, others, residuals, 0.7, settings, masks=masks)
    found = error_parts(g, cam, record)
    assert not found.pop("information").any()
    for name, x in truth.items():
        assert float((found[name].reshape(-1) - x).abs().max()) <= 2e-4 * float(x.max()), name
    tensors, header = record.to_state()
    again = drgs.ErrorRecord.from_state(tensors, json.loads(json.dumps(header)))
    assert torch.equal(drgs.expected_error(g, cam, again), drgs.expected_error(g, cam, record))


def test_a_wrong_label_is_told(ring):
    """Where all labels are wrong in training views, the next from there is expected to be; so are a half, and none."""
    g, cameras = ring
    covered = drgs.render(g, cameras[2], outputs=()).alpha > 0.98
    assert covered.any()
    for wrong in (0.0, 0.5, 1.0):
        residual = torch.full((24, 32), wrong)
        told = wrong_label(g, cameras[2], residual_record(g, cameras, [residual] * len(cameras), 0.5))
        assert told.max() <= 1
        assert float(told[covered].mean()) == pytest.approx(wrong, abs=0.15)


@pytest.mark.parametrize(
    ("residuals", "empty", "message"),
    [
        (torch.zeros(24, 31), 1.0, r"must be \(24, 32\) like its camera"),
        (-torch.ones(24, 32), 1.0, "must be finite and >= 0, got -1 to -1"),
        ([torch.zeros(24, 32)] * 2, 1.0, "one for each of 1 cameras, got 2"),
        (torch.zeros(24, 32), math.nan, "empty_residual must be a finite number"),
    ],
)
def test_residuals_are_checked(ring, residuals, empty, message):
    """One line says what must hold."""
    g, cameras = ring
    with pytest.raises(ArgumentError, match=message):
        residual_record(g, cameras[0], residuals, empty)
