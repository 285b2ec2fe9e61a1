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
from drgs.sharing.layers import moments_of
from drgs.sharing.write import write_page


def shared_of_run(run):  # noqa: F811
    """What its page shows, with a field that moves what may move: six steps have taught it next to nothing."""
    shared = shared_of(Share(scene=run.path, uncertainty=False, moments=5))
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weights in shared.moving.field.named_parameters():
            weights += (3.0 if name == "mlp.means.3.weight" else 0.2) * torch.randn_like(weights)
        shared.moving.gaussians.logit_opacities.add_(4.0)
    return dataclasses.replace(shared, gaussians=shared.moving.at(shared.times[0]).detach())


def test_moments(run):  # noqa: F811
    """Numbers of 16 bits say where what moves is at each moment, to their step; what stands still is left out."""
    shared = shared_of_run(run)
    order = morton_order(shared.gaussians.means.numpy())
    known, places, codes = moments_of(shared.moving, shared.times, shared.gaussians, order)
    places = np.frombuffer(places, "<u4")
    codes = np.frombuffer(codes, "<u2").reshape(len(shared.times), 10, len(places))
    low, high = np.array(known["low"]), np.array(known["high"])
    values = low[:, None] + (high - low)[:, None] * codes / 65535
    assert 0 < len(places) < len(shared.gaussians)  # the gates of five are open
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
