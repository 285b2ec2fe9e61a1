"""What moves in the page of `drgs share`."""

from __future__ import annotations

import numpy as np
import torch
from test_dynamic_fit import _small_field, dataset, run  # noqa: F401 (fixtures)

from drgs.codecs.clustering import morton_order
from drgs.commands.options import Share
from drgs.commands.share import shared_of
from drgs.sharing.layers import moments_of


def test_moments(run):  # noqa: F811
    """Numbers of 16 bits say where what moves is at each moment, to their step; what stands still is left out."""
    shared = shared_of(Share(scene=run.path, uncertainty=False, moments=5))
    torch.manual_seed(0)
    with torch.no_grad():
        for weights in shared.moving.field.parameters():  # six steps have taught it to move next to nothing
            weights += 0.3 * torch.randn_like(weights)
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
