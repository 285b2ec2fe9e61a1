"""`drgs tradeoff` on a tiny scene: every row, errors that grow with the cut-offs, advice that its numbers support."""

from __future__ import annotations

import json
import sys
import typing

import numpy as np
import pytest
import torch
from scenes_random import gaussians

from drgs import cli, fisher, reference
from drgs.cameras import orbit
from drgs.commands import tradeoff
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.files import load_ply, save_ply
from drgs.integrator import render
from drgs.lab.tradeoff import measure, measure_full
from drgs.lab.tradeoff_advice import USES, recommend
from drgs.lab.tradeoff_rows import (
    TRADEOFF_VARIANTS,
    GroupInformation,
    Interval,
    Measured,
    TradeoffRow,
    WorstErrors,
    interval,
)
from drgs.settings import RenderSettings

BUDGETS = (1e-12, 1e-5, 1e-3, 1e-1, 10.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`scene.ply`, opaque enough that rays stop early; `cameras.json`; `away.json`, which sees nothing of it."""
    folder = tmp_path_factory.mktemp("tradeoff")
    g = gaussians(np.random.default_rng(5), 40, scale=0.4).detach()
    save_ply(g.replace(logit_opacities=g.logit_opacities + 3), folder / "scene.ply")
    save_ply(g.take(slice(0, 0)), folder / "empty.ply")
    views = orbit((0, 0, 0), 4.0, 2, width=20, height=16, fov=40)
    save_cameras_json(folder / "cameras.json", views)
    save_cameras_json(folder / "away.json", orbit((1e3, 0, 0), 1.0, 2, width=20, height=16))
    return folder


def command(place, output, *options, scene="scene.ply", cameras="cameras.json"):
    """Exit code."""
    parts = ["tradeoff", place / scene, "--cameras", place / cameras, "-o", output, "--quiet", *options]
    return cli.main([str(part) for part in parts])


@pytest.fixture(scope="module")
def report(place):
    """Of all rows."""
    assert command(place, place / "out", "--repeats", 1, "--max-error", *BUDGETS) == 0
    return json.loads((place / "out" / "tradeoff.json").read_text())


def rows(report) -> dict:
    return {row["name"]: row for row in report["rows"]}


def few(monkeypatch, *names):
    """Measure only these rows."""
    kept = tuple(v for v in TRADEOFF_VARIANTS if v.name in ("exact", *names))
    assert len(kept) == 1 + len(names)
    monkeypatch.setattr(tradeoff, "TRADEOFF_VARIANTS", kept)


def test_rows_are_complete(report):
    """A row a setting; every number there, or a reason why not."""
    names = [variant.name for variant in TRADEOFF_VARIANTS]
    assert [row["name"] for row in report["rows"]] == names
    assert len(set(names)) == len(names)
    for row in report["rows"]:
        assert row["kind"] in ("approximation", "model", "resolution", "precision")
        assert row["skipped"] is None, row["name"]
        assert row["image"]["max"] >= row["image"]["p999"] >= 0
        assert row["gradient"]["worst"] >= 0
        assert row["seconds"]["forward"] > 0
        assert row["ratio"]["forward_backward"] > 0
        assert (row["information"] is None) == ("information" in row["notes"])
    without = {row["name"] for row in report["rows"] if row["by"] == "view" and row["information"] is None}
    assert without == set()
    assert all(row["information"] is None for row in report["rows"] if row["by"] != "view")


def test_every_value_of_a_setting_is_measured():
    """Each value that a setting can be chosen from is switched on in a row, at least by a preset."""
    made = [RenderSettings.preset(v.preset, **v.fields) for v in TRADEOFF_VARIANTS]
    for name, hint in typing.get_type_hints(RenderSettings).items():
        if typing.get_origin(hint) is typing.Literal:
            assert {getattr(settings, name) for settings in made} == set(typing.get_args(hint)), name
    assert {settings.response for settings in made} == {"peak", "integral", "ewa"}


def test_exact_is_the_unit(report):
    """exact: error 0, ratio 1; against the oracle as good as is claimed; other rows carry that error on top."""
    exact, oracle = report["rows"][0], rows(report)["float64 oracle"]
    assert exact["image"]["max"] == exact["gradient"]["worst"] == exact["information"]["l1"] == 0
    assert set(exact["ratio"].values()) == {1.0}
    assert 0 < report["own"]["image"] <= 1e-5
    assert 0 < report["own"]["gradient"] <= 1e-4
    assert report["own"]["image"] == oracle["image"]["max"]
    assert exact["errors"] == report["own"]
    row = rows(report)["extent=3"]
    worst = max(row["image"]["rms"], row["image"]["p999"])
    assert row["errors"]["image"] == pytest.approx(worst + report["own"]["image"])


def test_errors_are_what_they_say(report, place):
    """One row computed again, from the public functions."""
    g, cameras = load_ply(place / "scene.ply"), load_cameras_json(place / "cameras.json")
    row, off, H = rows(report)["extent=2.5"], [], []
    for settings in (RenderSettings.preset("exact", extent=2.5), RenderSettings.preset("exact")):
        off.append(torch.stack([render(g, camera, settings, outputs=()).rgb for camera in cameras]).double())
        H.append([fisher.diagonal(g, camera, settings)["means"] for camera in cameras])
    difference = (off[0] - off[1]).abs()
    assert row["image"]["rms"] == pytest.approx(float(difference.square().mean().sqrt()), rel=1e-5)
    assert row["image"]["max"] == pytest.approx(float(difference.max()), rel=1e-5)
    assert row["image"]["psnr"] == pytest.approx(-20 * np.log10(row["image"]["rms"]))
    l1 = sum((a - b).abs().sum() for a, b in zip(*H, strict=True)) / sum(b.sum() for b in H[1])
    assert row["information"]["groups"]["means"]["l1"] == pytest.approx(float(l1), rel=1e-4)


@pytest.mark.slow
def test_gradient_error_is_the_jacobians(place, monkeypatch):
    """Over many cotangents, the mean squared relative error is that of the Jacobian in the Frobenius norm."""
    g = load_ply(place / "scene.ply").take(slice(0, 5))
    camera = load_cameras_json(place / "cameras.json")[0].resized(5, 4)
    index = {"log_scales": [(i, k) for i in range(5) for k in range(3)]}
    fast, exact = (
        fisher.jacobian_columns(g, camera, index, RenderSettings.preset(*p)).double() for p in (["fast"], ["exact"])
    )
    variants = tuple(v for v in TRADEOFF_VARIANTS if v.name in ("exact", "fast"))
    found = [
        measure(g, [camera], variants, repeats=0, seed=seed).rows[1].gradient.groups["log_scales"] for seed in range(40)
    ]
    want = float((fast - exact).norm() / exact.norm())
    assert np.median(found) == pytest.approx(want, rel=0.3)


@pytest.mark.parametrize("key", ["extent", "transmittance_min", "alpha_min"])
def test_errors_grow_with_the_cut_off(report, key):
    """Wider cut-offs: larger errors of image, gradient and information."""
    single = [v for v in TRADEOFF_VARIANTS if v.preset == "exact" and set(v.fields) == {key} and v.share == 1]
    single.sort(key=lambda v: -v.fields[key] if key == "extent" else v.fields[key])
    assert len(single) >= 3
    found = [rows(report)[v.name] for v in single]
    for numbers in (
        [row["image"]["rms"] for row in found],
        [row["gradient"]["all"] for row in found],
        [row["information"]["l1"] for row in found],
    ):
        assert numbers == sorted(numbers)
        assert numbers[-1] > 10 * numbers[0]
        assert numbers[-1] > 1e-4


def test_lower_resolution(report):
    """Half the pixels a side: a coarser image, and information of the same size."""
    half, quarter = (rows(report)[f"exact, {name} resolution"] for name in ("half", "quarter"))
    assert 0 < half["image"]["rms"] < quarter["image"]["rms"]
    assert half["information"]["l1"] < 1.5


@pytest.mark.parametrize("use", USES)
def test_advice_follows_from_the_numbers(report, use):
    """Within the budget, and with a gain: all of its interval is faster than exact, and than exact's own scatter."""
    clock, kinds = USES[use]
    picks = [pick for pick in report["recommended"] if pick["use"] == use]
    assert [pick["budget"] for pick in picks] == list(BUDGETS)
    valid = [r for r in report["rows"] if r["share"] == 1 and r["by"] == "view"]
    worst = {
        r["name"]: max(r["errors"][k] for k in kinds) for r in valid if None not in [r["errors"][k] for k in kinds]
    }
    sure = min(1, report["scatter"][clock]["low"])
    for pick in picks:
        within = [r for r in valid if worst.get(r["name"], np.inf) <= pick["budget"]]
        if not within:
            assert pick["name"] is None
            assert f"{min(worst.values()):.1e}" in pick["reason"]
            continue
        assert pick["error"] == worst[pick["name"]] <= pick["budget"]
        times = [r["full"][clock] for r in within if clock in r["full"]]
        if pick["gain"]:
            assert pick["high"] < sure
            assert pick["low"] <= pick["ratio"] <= pick["high"]
            assert pick["ratio"] in [t["ratio"] for t in times]
        else:
            assert pick["name"] == "exact"
            assert "no measurable gain" in pick["reason"]
            assert all(t["high"] >= sure for t in times)
    assert picks[0]["name"] is None  # below float32
    assert picks[-1]["name"] is not None


def test_what_leads_is_timed_as_it_is_drawn(report):
    """Times at the cameras' own size, of exact and of the fastest settings; exact is the unit there, too."""
    for clock, found in report["full"].items():
        assert found["size"] == found["drawn"] == [20, 16]
        assert found["names"][:2] == ["exact", "fast"]
        for row in report["rows"]:
            assert (clock in row["full"]) == (row["name"] in found["names"])
            if clock in row["full"]:
                times = row["full"][clock]
                assert times["low"] <= times["ratio"] <= times["high"]
                assert times["seconds"] > 0
                assert times["rounds"] == found["rounds"] >= 3
        assert rows(report)["exact"]["full"][clock]["low"] == rows(report)["exact"]["full"][clock]["high"] == 1
    assert "forward" in report["full"]


@pytest.mark.slow
def test_size_is_what_is_drawn_or_what_fits(place, monkeypatch):
    """Errors are of views of --max-pixels, times of the views themselves or what the seconds allow, which is said."""
    few(monkeypatch, "fast")
    large = [camera.resized(80, 64) for camera in load_cameras_json(place / "cameras.json")]
    save_cameras_json(place / "large.json", large)
    options = ("--repeats", 1, "--max-pixels", 320)
    assert command(place, place / "large", *options, cameras="large.json") == 0
    report = json.loads((place / "large" / "tradeoff.json").read_text())
    assert [(view["width"], view["height"]) for view in report["views"]] == [(20, 16)] * 2
    assert report["full"]["forward"]["size"] == report["full"]["forward"]["drawn"] == [80, 64]

    g, variants = load_ply(place / "scene.ply"), tuple(v for v in TRADEOFF_VARIANTS if v.name in ("exact", "fast"))

    def timed(seconds):
        monkeypatch.setattr("drgs.lab.tradeoff.clocked", lambda work: (None, seconds))  # whatever is done
        return measure_full(measured, g, large, BUDGETS, 1, 60.0, 0, lambda text: None)["forward"]

    for _ in range(10):  # beside other work times may scatter so much that nothing leads
        measured = measure(g, [camera.resized(20, 16) for camera in large], variants, repeats=1)
        smaller = timed(8.0)
        if smaller.names:
            break
    assert [20, 16] < smaller.size < smaller.drawn == [80, 64]
    assert 1 <= smaller.rounds < 3
    assert tradeoff._size(smaller).endswith("(of 80x64: --seconds)")
    row, scatter = measured.rows[1], measured.scatter["forward"]
    assert row.full["forward"].low <= scatter.low  # a ratio of 1, as wide as equal work scatters
    assert row.full["forward"].high >= scatter.high
    assert timed(100.0).names == []


def test_intervals_of_the_median():
    """All of fewer than six ratios; of more, what a sign test leaves: 95 % of medians of equal work lie around 1."""
    assert interval([]) is None
    assert interval([0.9, 1.2, 1.0]) == Interval(ratio=1.0, low=0.9, high=1.2, rounds=3)
    found = interval([x / 10 for x in range(1, 13)])  # of twelve: from the third to the tenth
    assert (found.low, found.high) == (0.3, 1.0)
    rng = np.random.default_rng(0)
    inside = [found.low <= 1 <= found.high for found in map(interval, rng.normal(1, 0.1, (2000, 9)).tolist())]
    assert 0.95 <= np.mean(inside) <= 0.97  # between the second and the eighth of nine: 96.1 %


def test_jitter_is_no_gain():
    """Of settings that do exact's own work none is recommended, however the times fall; real gains are."""
    times = lambda low, ratio, high: Interval(ratio=ratio, low=low, high=high, rounds=5)  # noqa: E731
    row = lambda name, span, error: TradeoffRow(  # noqa: E731
        name=name, kind="x", errors=WorstErrors(image=error), times={"forward": times(*span)}
    )
    exact, same, half = (
        row("exact", (1, 1, 1), 1e-7),
        row("same", (0.9, 0.92, 0.96), 1e-7),
        row("half", (0.4, 0.5, 0.6), 1e-4),
    )
    scatter = {"forward": times(0.93, 1.0, 1.06)}
    made = lambda *rows: Measured(list(rows), WorstErrors(), scatter, 1.0, 5, "wall")  # noqa: E731
    picks = recommend(made(exact, same, half), "image", [1e-9, 1e-5, 1e-3])
    assert picks[0].name is None
    assert picks[1].name == "exact"
    assert not picks[1].gain
    assert picks[1].reason == "no measurable gain over exact"
    assert picks[2].name == "half"
    assert picks[2].gain
    # At full size half is no faster: that is what counts.
    half.full = {"forward": times(0.9, 1.0, 1.1)}
    assert not recommend(made(exact, same, half), "image", [1e-3])[0].gain
    # One as fast and more exact is preferred.
    half.full = {}
    finer = row("finer", (0.55, 0.57, 0.59), 1e-6)
    assert recommend(made(exact, same, half, finer), "image", [1e-3])[0].name == "finer"


def test_flags_can_be_used(report):
    """What is recommended parses into the settings that were measured."""
    for pick in report["recommended"]:
        if pick["name"]:
            args = cli._parse_arguments(["render", "x.ply", *pick["flags"].split()])
            assert vars(args.settings()) == vars(RenderSettings(**rows(report)[pick["name"]]["settings"]))


def test_files(report, place):
    """A page with every row, a picture, and nothing else."""
    assert sorted(x.name for x in (place / "out").glob("[!.]*")) == ["tradeoff.json", "tradeoff.md", "tradeoff.png"]
    page = (place / "out" / "tradeoff.md").read_text()
    assert all(f"| {name} |" in page for name in rows(report))
    assert report["command"] == "tradeoff"
    assert report["env"]["backend"]["variant"] == "llvm_ad_rgb" or report["env"]["cuda"]["available"]


def test_what_cannot_be_is_skipped(place, monkeypatch, capsys):
    """Illegal combinations with the user's --set, and rows that are the same, say why; the rest is measured."""
    names = ("inria", "response=ewa order=center", "traversal=bvh", "extent=3", "extent=4", "fast extent=4")
    few(monkeypatch, *names)
    options = ("--set", "order=ray", "--set", "near=0.1", "--set", "extent=3", "--repeats", 1)
    assert command(place, place / "skips", *options) == 0
    report = json.loads((place / "skips" / "tradeoff.json").read_text())
    why = {name: row["skipped"] for name, row in rows(report).items()}
    assert "one depth per Gaussian" in why["inria"]
    assert "near" in why["traversal=bvh"]
    assert "the same as exact" in why["extent=3"]
    assert why["exact"] is why["extent=4"] is why["fast extent=4"] is why["response=ewa order=center"] is None
    assert report["fields"] == {"order": "ray", "near": 0.1, "extent": 3}
    assert rows(report)["fast extent=4"]["settings"]["near"] == 0.1
    assert "--set near=0.1" in rows(report)["fast extent=4"]["flags"]
    assert "extent=3" not in rows(report)["fast extent=4"]["flags"]
    assert report["own"]["image"] is None
    assert "one depth per Gaussian" in (place / "skips" / "tradeoff.md").read_text()


def test_a_step_that_raises_is_skipped(place, monkeypatch):
    """A setting that fails does not take the others with it."""
    few(monkeypatch, "fast", "order=center")
    real = render

    def fails(g, camera, settings, outputs=()):
        if settings.alpha_max < 1:
            raise RuntimeError("no\nluck")
        return real(g, camera, settings, outputs)

    monkeypatch.setattr("drgs.lab.tradeoff.render", fails)
    assert command(place, place / "fails", "--repeats", 1) == 0
    found = rows(json.loads((place / "fails" / "tradeoff.json").read_text()))
    assert found["fast"]["skipped"] == "no luck"
    assert found["order=center"]["skipped"] is None


def test_own_error_sees_a_wrong_truth(place, monkeypatch):
    """If exact were wrong, its error against the oracle would say so, and no small budget would be met."""
    few(monkeypatch, "float64 oracle")
    real = reference.render

    def brighter(g, *args, **options):
        return real(g.replace(sh=g.sh * 1.01), *args, **options)

    monkeypatch.setattr("drgs.reference.render", brighter)
    assert command(place, place / "wrong", "--repeats", 1) == 0
    report = json.loads((place / "wrong" / "tradeoff.json").read_text())
    assert report["own"]["image"] > 1e-3
    assert all(pick["name"] is None for pick in report["recommended"] if pick["budget"] == 1e-4)


def test_tables_and_no_matplotlib(place, monkeypatch, capsys, caplog):
    """The tables on stdout; without matplotlib one line before the work instead of the plot, exit code 0."""
    few(monkeypatch, "fast", "float64 oracle")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    parts = ("tradeoff", place / "scene.ply", "--cameras", place / "cameras.json", "-o", place / "plain")
    assert cli.main([*map(str, parts), "--repeats", "1", "--max-error", "1e-9"]) == 0
    text = capsys.readouterr().out
    assert "no plot will be drawn: matplotlib is not installed; pip install 'drgs[report]'" in caplog.messages[0]
    assert "no setting is within it, the least error is" in text
    assert not (place / "plain" / "tradeoff.png").exists()


def test_a_plot_takes_nothing_with_it(place, monkeypatch, capsys):
    """Dollar signs of a path are no formula; whatever else a plot fails of, what was measured is there."""
    few(monkeypatch, "fast")
    scene, draw, drawn = "scene $\\frac{$.ply", tradeoff.plot, []
    (place / scene).write_bytes((place / "scene.ply").read_bytes())

    def fail(*arguments):
        drawn.append(draw(*arguments))
        raise ValueError("no plot")

    monkeypatch.setattr(tradeoff, "plot", fail)
    assert command(place, place / "failed", "--repeats", 1, scene=scene) == 2
    assert "no plot" in capsys.readouterr().err
    assert drawn == [True]
    assert rows(json.loads((place / "failed" / "tradeoff.json").read_text())).keys() == {"exact", "fast"}
    assert "| fast |" in (place / "failed" / "tradeoff.md").read_text()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"options": ("--max-error", "0")}, "--max-error must be finite numbers > 0, got 0"),
        ({"options": ("--max-error", "1e-3", "-1")}, "--max-error must be finite numbers > 0, got 0.001 -1"),
        ({"options": ("--max-error", "nan")}, "--max-error must be finite numbers > 0, got nan"),
        ({"options": ("--repeats", "0")}, "--repeats must be in [1, 1000], got 0"),
        ({"options": ("--preset", "fast")}, "--preset must be exact"),
        ({"options": ("--set", "dilation=1")}, "dilation belongs to response='ewa'"),
        ({"scene": "empty.ply"}, "must hold at least one Gaussian"),
        ({"cameras": "away.json"}, "one of 2 cameras must show a Gaussian, all are empty"),
        ({"scene": "none.ply"}, "none.ply"),
    ],
)
def test_bad_input(place, capsys, options, expected):
    """One line, exit code 2, no files."""
    assert command(place, place / "bad", *options.pop("options", ()), **options) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert expected in text
    assert not list((place / "bad").glob("*"))


def test_groups_without_a_derivative_have_no_error(place):
    """Rotating a sphere changes nothing: its rounding is not taken for an error of 100 %."""
    g = load_ply(place / "scene.ply")
    g = g.replace(log_scales=g.log_scales[:, :1].expand(-1, 3).contiguous())
    variants = tuple(v for v in TRADEOFF_VARIANTS if v.name in ("exact", "extent=4"))
    row = measure(g, load_cameras_json(place / "cameras.json"), variants, repeats=0).rows[1]
    assert row.gradient.groups["quats"] is None
    assert row.information.groups["rotations"] == GroupInformation(None, None)
    assert 0 < row.gradient.worst < 0.2
