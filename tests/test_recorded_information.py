"""Information of a view by recorded steps is that of one that is traced anew, whatever changes between two of them."""

from __future__ import annotations

import torch
from test_recordings import BACKGROUNDS, nothing_recorded, scene, sized  # noqa: F401

import drgs
from drgs import fisher
from drgs.tracing import projection, tiles
from drgs.tracing.recordings import without_recordings
from drgs.tracing.walk import Part


def information(g, camera, settings, mask=None):
    """Diagonals, blocks and coverage of a view."""
    seen = g.detach()
    found = {
        "blocks": fisher.blocks(seen, camera, settings, masks=mask),
        "coverage": fisher.coverage(seen, camera, settings),
    }
    for method in ("exact", "fisherrf"):
        of = fisher.diagonal(seen, camera, settings, method, masks=mask)
        found |= {f"{method} {name}": x for name, x in of.items()}
    weights = {name: 1 / (x + 1) for name, x in of.items()}
    weighted = fisher.diagonal(seen, camera, settings, groups=("means", "sh"), channel_weights=(0.3, 0.5, 2.0))
    found |= {f"weighted {name}": x for name, x in weighted.items()}
    found |= {f"removal, {power}": fisher.removal_error(seen, camera, settings, power=power) for power in (2, 1)}
    return found | {"map": fisher.variance_map(seen, camera, weights, settings)}


def check_information(g, camera, settings, mask=None):
    """Information is what it is without recordings, but for the order of sums."""
    recorded = information(g, camera, settings, mask)
    with without_recordings():
        expected = information(g, camera, settings, mask)
    assert list(recorded) == list(expected)
    for name, x in expected.items():
        torch.testing.assert_close(recorded[name], x, rtol=1e-5, atol=1e-6 * float(x.abs().max()), msg=name)


def test_all_that_changes_between_the_information_of_two_views():
    """Likewise of information, which also depends on masks and on what a response's derivatives need."""
    fast, exact, inria = (drgs.RenderSettings.preset(name) for name in ("fast", "exact", "inria"))
    for settings in (fast, exact, inria):
        for seed, count, width, height in ((0, 60, 24, 16), (1, 44, 24, 16), (1, 44, 17, 31), (0, 60, 24, 16)):
            g, camera = scene(count, seed)
            check_information(g, sized(camera, width, height), settings.replace(background=BACKGROUNDS[seed]))
    g, camera = scene()
    camera = sized(camera, 24, 16)
    for value in (1.0, 0.3):
        mask = torch.full((16, 24), value)
        mask[:5] = 0
        check_information(g, camera, fast, [mask])
    check_information(g.replace(sh=g.sh[:, :1]), camera, fast)
    check_information(scene(dtype=torch.float64)[0], camera, fast)
    check_information(g, camera, fast.replace(extent=2.0, alpha_min=0.02))
    behind = camera.w2c.copy()
    behind[2, 3] = -100.0
    for settings in (fast, exact):
        check_information(g, sized(camera, 24, 16, behind), settings)
        check_information(scene(1)[0], sized(camera, 1, 1), settings)


def test_information_of_a_second_view_is_not_traced(monkeypatch):
    """Of a view with other numbers in the same arrays nothing is projected or walked by Python, and they count."""
    calls = []
    project, run = projection.project_screen, Part.run
    monkeypatch.setattr(projection, "project_screen", lambda *args: calls.append(1) or project(*args))
    monkeypatch.setattr(Part, "run", lambda *args, **kwargs: calls.append(1) or run(*args, **kwargs))
    g, camera = scene()
    seen, camera = g.detach(), sized(camera, 24, 16)
    for preset in ("fast", "exact", "inria"):
        settings = drgs.RenderSettings.preset(preset)
        first = fisher.diagonal(seen, camera, settings)
        assert calls
        fisher.diagonal(seen, camera, settings)  # Dr.Jit may record once more, for arrays that are aligned otherwise
        calls.clear()
        other = fisher.diagonal(seen.replace(sh=0.5 * seen.sh), camera, settings)
        assert not calls
        assert not torch.equal(first["means"], other["means"])


def test_several_bands(monkeypatch):
    """Rows of hits that are sorted band by band, whose sums are not recorded."""
    g, camera = scene()
    monkeypatch.setattr(tiles, "TABLES", 1 << 16)
    check_information(g, sized(camera, 32, 24), drgs.RenderSettings.preset("exact"))
