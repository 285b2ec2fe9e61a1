"""The unit of the world, and where its zero is, change no score: lambda is about positions in a length of the scene."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch
from scenes_random import gaussians
from test_network_information import swarm
from test_select import ring

from drgs.cameras import Camera
from drgs.commands.convert import uncertainty_columns
from drgs.deform import LENGTHS, DynamicGaussians
from drgs.ellipsoids import Gaussians
from drgs.fitting.near_planes import warn_of_near_planes
from drgs.fitting.renderers import ANY
from drgs.gain import Prior, information_gain, unit_length, variances
from drgs.information.network_groups import network_lengths
from drgs.information.nuisances import Nuisances
from drgs.io.checkpoint import save_state
from drgs.select import Scoring, select
from drgs.settings import RenderSettings

CRITERIA = ("v_opt", "eig", "logdet", "block_logdet")
ZERO = np.array([500_000.0, 5_400_000.0, 120.0])


def moved(g: Gaussians, scale: float, zero: np.ndarray) -> Gaussians:
    """The same scene, each point x of which is at scale x + zero."""
    sizes = g.log_scales + float(np.log(scale))
    return dataclasses.replace(g, means=scale * g.means, log_scales=sizes, origin=zero)


def moved_camera(camera: Camera, scale: float, zero: np.ndarray) -> Camera:
    """The camera that sees what this one saw."""
    w2c = camera.w2c.copy()
    w2c[:3, 3] = scale * w2c[:3, 3] - w2c[:3, :3] @ zero
    return dataclasses.replace(camera, w2c=w2c)


@pytest.fixture(scope="module")
def world():
    """20 Gaussians, 2 known views and 6 candidates."""
    rng = np.random.default_rng(3)
    return gaussians(rng, 20, 1, scale=0.25).detach(), ring(rng, 8)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_scores_do_not_depend_on_the_unit(world, criterion):
    """Scores, parts by group and picks of a scene in meters, millimeters and kilometers, elsewhere, are the same."""
    g, cameras = world
    ask = lambda g, cameras, **x: select(g, cameras[2:], cameras[:2], k=3, criterion=criterion, **x)  # noqa: E731
    plain = ask(g, cameras)
    assert plain.prior.length == unit_length(g, cameras)
    for scale, zero in ((1e-3, 0 * ZERO), (1.0, ZERO), (1e3, 1e3 * ZERO)):
        there = ask(moved(g, scale, zero), [moved_camera(x, scale, zero) for x in cameras])
        assert [x.index for x in there.picks] == [x.index for x in plain.picks]
        assert there.scores == pytest.approx(plain.scores, rel=1e-4)
        for found, wanted in zip(there.parts, plain.parts, strict=True):
            assert found == pytest.approx(wanted, rel=1e-3, abs=1e-5 * max(wanted.values()))
        assert there.prior.length == pytest.approx(scale * plain.prior.length, rel=1e-6)
    # In world units, whatever these are, the same scene has other scores.
    fixed = Prior(1e-2 if criterion == "v_opt" else 1e-6, length=1.0)
    other = ask(moved(g, 1e3, 0 * ZERO), [moved_camera(x, 1e3, 0 * ZERO) for x in cameras], prior=fixed)
    of_means = lambda found: [x.get("means", x.get("blocks")) for x in found.parts]  # noqa: E731
    assert of_means(other) != pytest.approx(of_means(plain), rel=1e-2)


def test_the_order_of_cameras_changes_no_bit(world):
    g, cameras = world
    assert unit_length(g, cameras) == unit_length(g, cameras[::-1]) == unit_length(g, [*cameras[3:], *cameras[:3]])


def test_one_camera_has_a_length(world):
    """Cameras at one place have no extent: the distance of what is there counts, and scales as well."""
    g, cameras = world
    one = unit_length(g, cameras[:1])
    away = (g.means.double() - torch.from_numpy(cameras[0].center)).norm(dim=1)
    assert one == pytest.approx(1.1 * np.median(away) / 5.6)
    millimeters = unit_length(moved(g, 1e3, ZERO), [moved_camera(cameras[0], 1e3, ZERO)] * 2)
    assert millimeters == pytest.approx(1e3 * one, rel=1e-6)


def test_length_of_the_prior():
    """lambda of means is in squared lengths; named groups are taken as they are, relative ones have no unit."""
    train = {"means": torch.full((2, 3), 4.0), "rotations": torch.full((2, 3), 4.0)}
    assert Prior(1e-2).per_group(train) == {"means": 1e-2, "rotations": 1e-2}
    assert Prior(1e-2, length=10).per_group(train) == {"means": 1e-4, "rotations": 1e-2}
    assert Prior(1e-2).over(10.0) == Prior(1e-2, length=10.0)
    assert Prior(1e-2, length=2).over(10.0) == Prior(1e-2, length=2.0)
    assert Prior(1e-2, groups={"means": 3.0}, length=10).per_group(train) == {"means": 3.0, "rotations": 1e-2}
    assert Prior(0.5, relative=True, length=10).per_group(train) == {"means": 2.0, "rotations": 2.0}
    assert float(variances(train, Prior(1.0, length=0.5))["means"][0, 0]) == 1 / 8
    # In another unit H is another number, and lambda follows it.
    other = {"means": train["means"] / 1e6, "rotations": train["rotations"]}
    gains = [information_gain(x, x, "logdet", Prior(2.0, length=y)).total for x, y in ((train, 1.0), (other, 1e3))]
    assert gains[0] == pytest.approx(gains[1])


@pytest.mark.parametrize("length", [0.0, -1.0, np.inf, np.nan, "1"])
def test_bad_length(length):
    with pytest.raises(ValueError, match="Prior: length must be above 0 and finite, got .*; leave it out, or try 1"):
        Prior(length=length)


def test_files_keep_the_length(tmp_path, world):
    """Uncertainty of a file that names its unit is in that unit; an older file counts in world units."""
    g, _ = world
    information = {"means": torch.zeros(len(g), 3, dtype=torch.float64)}
    for header, wanted in (({"length": 2.0}, 2 * np.sqrt(3)), ({}, np.sqrt(3))):
        save_state(tmp_path / "information.safetensors", information, header)
        found = uncertainty_columns(tmp_path / "information.safetensors", g, Prior(1.0))
        np.testing.assert_allclose(found["uncertainty_means"], wanted, rtol=1e-6)


def test_near_planes_that_cut_are_named(world, caplog):
    """A world in kilometers is said to be nearer than near planes, with the factor that mends it; others are not."""
    g, cameras = world
    renderers = {name: RenderSettings.preset(name) for name in ANY}
    told = {}
    for scale in (1.0, 1e3, 1e-3):
        there = moved(g, scale, 0 * ZERO)
        caplog.clear()
        seen = [moved_camera(x, scale, 0 * ZERO) for x in cameras]
        warn_of_near_planes(renderers, seen, there.means.double().numpy())
        told[scale] = caplog.text
    assert told[1.0] == told[1e3] == ""
    assert "inria 100% (near 0.2), gsplat 100% (near 0.01), 3dgut 100% (near 0.01); multiply" in told[1e-3]
    assert "by about 1000; exact and fast (--for drgs) have none" in told[1e-3]


@pytest.mark.parametrize("criterion", ["v_opt", "eig"])
def test_scenes_that_move_have_no_unit_either(criterion):
    """Weights of a network that move means are lengths: the same motion in millimeters has the same scores."""
    rng = np.random.default_rng(4)
    scene = swarm(gaussians(rng, 8, 1).detach())
    cameras = [dataclasses.replace(x, time=0.25 * i) for i, x in enumerate(ring(rng, 5))]
    found = []
    for scale in (1.0, 1e3):
        other = copy.deepcopy(scene.field)
        other.grid.bounds *= scale
        with torch.no_grad():
            for name, x in other.named_parameters():
                x *= scale if name in LENGTHS else 1.0
        there = DynamicGaussians(moved(scene.gaussians, scale, 0 * ZERO), other, scene.motion)
        seen = [moved_camera(x, scale, 0 * ZERO) for x in cameras]
        prior = Prior(1.0)  # beside which what is known of the network is little: lambda decides
        found.append(select(there, seen[2:], seen[:2], k=2, criterion=criterion, prior=prior, probes=4))
    assert [x.index for x in found[0].picks] == [x.index for x in found[1].picks]
    for near, far in zip(*(x.parts for x in found), strict=True):
        assert {"means", "mlp", "grid"} <= near.keys()
        assert far == pytest.approx(near, rel=1e-3, abs=1e-5 * max(near.values()))
    assert network_lengths(scene)["mlp"].sum() == 3 * 3 + 3  # of 3 numbers from 3 hidden ones


def test_unknown_poses_have_no_unit_either(world):
    """Poses that are eliminated, with a deviation in world units where one is named."""
    g, cameras = world
    for std in (None, (1e-3, 1e-2)):
        scores = []
        for scale in (1.0, 1e3, 1e-3):
            named = None if std is None else (std[0], scale * std[1])
            unknown = Nuisances(eliminate=("exposure", "pose"), pose_std=named)
            seen = [moved_camera(x, scale, 0 * ZERO) for x in cameras]
            there = moved(g, scale, 0 * ZERO)
            scores.append(select(there, seen[2:], seen[:2], scoring=Scoring(nuisances=unknown)).scores)
        assert scores[1] == pytest.approx(scores[0], rel=1e-4)
        assert scores[2] == pytest.approx(scores[0], rel=1e-4)
