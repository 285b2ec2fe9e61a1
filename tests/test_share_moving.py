"""What moves in the page of `drgs share`."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from test_dynamic_fit import _small_field, dataset, run  # noqa: F401 (fixtures)
from test_share_browser import BACKGROUND, CAMERAS, decibels, ours, picture, shown  # noqa: F401 (a fixture)
from test_view_browser import browsers, once_more  # noqa: F401 (a fixture)

from drgs.codecs.clustering import morton_order
from drgs.commands.options import Share
from drgs.commands.share import shared_of
from drgs.deform import DynamicGaussians
from drgs.dynamics.lifespans import Lifespans
from drgs.pages.sharing.layers import motion_layer
from drgs.pages.sharing.write import write_page


def shared_of_run(run):  # noqa: F811
    """What its page shows, with a field that moves what may move: six steps have taught it next to nothing."""
    shared = shared_of(Share(scene=run.path, uncertainty=False, moments=5))
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weights in shared.moving.field.named_parameters():
            weights += (3.0 if name == "mlp.means.3.weight" else 0.2) * torch.randn_like(weights)
        shared.moving.gaussians.logit_opacities.add_(4.0)
    moving = shared.moving.without_lifespans()
    return dataclasses.replace(shared, moving=moving, gaussians=moving.at(shared.times[0]).detach())


def test_moments(run):  # noqa: F811
    """Numbers of 16 bits say where what moves is at each moment, to their step; what stands still is left out."""
    shared = shared_of_run(run)
    order = morton_order(shared.gaussians.means.numpy())
    known, places, codes, lives = motion_layer(shared.moving, shared.times, shared.gaussians, order)
    places = np.frombuffer(places, "<u4")
    codes = np.frombuffer(codes, "<u2").reshape(len(shared.times), 10, len(places))
    low, high = np.array(known["low"]), np.array(known["high"])
    values = low[:, None] + (high - low)[:, None] * codes / 65535
    assert 0 < len(places) < len(shared.gaussians)  # the gates of five are open
    assert not np.frombuffer(lives, "<f4").any()  # all are always there
    for time, value in zip(shared.times, values, strict=True):
        with torch.no_grad():
            truth = shared.moving.at(time).means.numpy()[order][places].T
        step = ((high - low)[:3, None] / 65535).clip(1e-6)
        assert (np.abs(value[:3] - truth) < step).all()


@once_more
def test_a_moment_in_a_browser(shown, run, tmp_path):  # noqa: F811
    """At a moment that the page has, and at one between two, it draws what our `gsplat` draws of the Gaussians then."""
    times = tuple(np.linspace(*(float(x) for x in shared_of_run(run).moving.field.grid.span), 5))
    looked = shared_of_run(run)
    cameras = [("fitted", dataclasses.replace(at, time=times[0])) for at in CAMERAS[:1]]
    looked = dataclasses.replace(looked, cameras=cameras, times=times, background=BACKGROUND)
    write_page(looked, tmp_path / "x.html")
    pictures = []
    for time in (times[0], times[3], 0.5 * (times[3] + times[4])):
        page = shown(tmp_path / "x.html", f"bare&time={time}")
        pictures.append(picture(page))
        with torch.no_grad():
            truth = ours(looked.moving.at(time), CAMERAS[0])
        assert decibels(pictures[-1], truth) > 40
    assert decibels(pictures[0], truth) < decibels(pictures[-1], truth) - 6  # it has moved meanwhile


def with_lives(shared):
    """The same, half of it there for a time, and away from where it is at its birth."""
    scene = shared.moving
    n = len(scene)
    first, last = (float(x) for x in scene.field.grid.span)
    widths = torch.full((n,), 0.2 * (last - first)).log()
    widths[::2] = 5.0  # of spans of 1: always
    velocities = torch.tensor([0.6, 0.1, 0.0]).expand(n, 3) / (last - first)
    bent = torch.tensor([0.0, 0.4, 0.0]).expand(n, 3) / (last - first) ** 2
    lives = Lifespans(torch.linspace(first, last, n), widths, velocities, bent, torch.full((n,), first))
    return dataclasses.replace(shared, moving=DynamicGaussians(scene.gaussians, scene.field, scene.motion, lives))


def test_lives_of_a_page(run):  # noqa: F811
    """What is there for a time is told by numbers of its own; moments say where it would be all the time."""
    shared = with_lives(shared_of_run(run))
    order = morton_order(shared.gaussians.means.numpy())
    _, places, _, lives = motion_layer(shared.moving, shared.times, shared.gaussians, order)
    places, lives = np.frombuffer(places, "<u4"), np.frombuffer(lives, "<f4").reshape(9, -1)
    living = shared.moving.has_lifespan.numpy()[order]
    assert set(np.flatnonzero(living)) <= set(places.tolist())
    assert (lives[1] > 0).tolist() == living[places].tolist()
    held = shared.moving.lifespans
    held_rows = (held.centers, held.log_widths.exp(), *held.velocities.T, *held.accelerations.T, held.reference_times)
    for row, x in enumerate(held_rows):
        np.testing.assert_allclose(lives[row][living[places]], x.numpy()[order][places][living[places]], rtol=1e-6)


@once_more
def test_lives_in_a_browser(shown, run, tmp_path):  # noqa: F811
    """At two moments it draws what our `gsplat` draws of those that are there then, where they are."""
    shared = with_lives(shared_of_run(run))
    times = tuple(np.linspace(*(float(x) for x in shared.moving.field.grid.span), 5))
    cameras = [("fitted", dataclasses.replace(at, time=times[0])) for at in CAMERAS[:1]]
    looked = dataclasses.replace(shared, cameras=cameras, times=times, background=BACKGROUND)
    write_page(looked, tmp_path / "x.html")
    pictures = []
    for time in (times[3], times[1]):
        pictures.append(picture(shown(tmp_path / "x.html", f"bare&time={time}")))
        with torch.no_grad():
            assert decibels(pictures[-1], ours(looked.moving.at(time), CAMERAS[0])) > 38
    with torch.no_grad():
        assert decibels(pictures[0], ours(looked.moving.at(times[1]), CAMERAS[0])) < 32
