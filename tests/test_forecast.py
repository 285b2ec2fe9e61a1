"""How long rendering will take: the forecast is right where time is linear, and said where it matters."""

from __future__ import annotations

import types

import pytest
import torch

from drgs import cli
from drgs.cameras import orbit
from drgs.commands import render as render_command
from drgs.files import save_ply
from drgs.settings import RenderSettings


def test_forecast_is_right_where_time_is_linear(monkeypatch):
    """Views of 2 s and 1 ms a pixel, wherever it is."""
    clock = [0.0]

    def render(g, camera, settings, outputs):
        clock[0] += 2 + 1e-3 * camera.width * camera.height
        return types.SimpleNamespace(rgb=torch.zeros(1))

    monkeypatch.setattr(render_command, "render", render)
    monkeypatch.setattr(render_command, "time", types.SimpleNamespace(perf_counter=lambda: clock[0]))
    cameras = [*orbit((0, 0, 0), 3.0, 3, width=64, height=48), *orbit((0, 0, 0), 3.0, 1, width=7, height=1)]
    expected = 4 * 2 + 1e-3 * (3 * 64 * 48 + 7)
    assert render_command.forecast(None, cameras, RenderSettings()) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("options", "seconds", "expected"),
    [
        ("", 140.0, "exact, 2 views of 40x30 will take about 2 min on this machine; --preset fast"),
        ("", 42.0, "exact, 2 views of 40x30 will take about 42 s on this machine; --preset fast"),
        ("", 3.0, None),
        ("--preset fast", 140.0, None),
    ],
)
def test_render_says_what_exact_takes(monkeypatch, tmp_path, capsys, options, seconds, expected):
    """Before the first view, and only where it is worth a word."""
    import drgs

    g = drgs.Gaussians.from_arrays([[0.0, 0, 0]], [[1.0, 0, 0, 0]], [[0.3] * 3], [0.9], [[[0.5, 0.5, 0.5]]])
    save_ply(g, tmp_path / "g.ply")
    monkeypatch.setattr(render_command, "_FORECAST_PIXELS", 2 * 40 * 30)
    monkeypatch.setattr(render_command, "forecast", lambda *_: seconds)
    line = f"render {tmp_path / 'g.ply'} --frames 2 --width 40 -o {tmp_path / 'out'} {options}"
    assert cli.main(line.split()) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "will take" in line]
    assert bool(said) == (expected is not None)
    if expected:
        assert said[0].startswith(expected)
