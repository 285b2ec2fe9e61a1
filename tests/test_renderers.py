"""A fit that must look right in several renderers: which is due at a step, what options mean, and what is measured."""

from __future__ import annotations

import json
from collections import Counter

import pytest
from test_active import write_still
from test_train import SIZE, config, dataset, trainer_of  # noqa: F401

from drgs import cli
from drgs.commands.eval import print_table
from drgs.commands.report import fit_command
from drgs.fitting import metrics
from drgs.fitting.config import FitConfig
from drgs.fitting.evaluation import evaluate_run
from drgs.fitting.frames import load_frames
from drgs.fitting.metrics import renderers_table
from drgs.fitting.renderers import ANY, RendererSchedule, renderers_to_measure
from drgs.fitting.resume import lock_run
from drgs.settings import RenderSettings
from drgs.train import Trainer, fit

FAST = RenderSettings.preset("fast")


def schedule(*names: str, settings: RenderSettings = FAST) -> RendererSchedule:
    return RendererSchedule.of(names, settings)


def presets_at(found: RendererSchedule) -> Counter:
    """Preset -> how many steps of the fit have it."""
    return Counter(found.settings_at(step).nearest_preset()[0] for step in range(800))


# --------------------------------------------------------------------------------------------------- the schedule


def test_a_mix_takes_its_presets_in_turn():
    """Presets that are named come in their order; `drgs` and `viewers` are made of what their names say; `any` gives
    every renderer that is not a twin of another its share, the dear one the smallest.
    """
    found = schedule("inria", "exact", "fast")
    names = [found.settings_at(step).nearest_preset()[0] for step in range(6)]
    assert names == ["inria", "exact", "fast", "inria", "exact", "fast"]
    assert set(presets_at(schedule("drgs"))) == {"exact", "fast"}
    assert set(presets_at(schedule("viewers"))) == {"gsplat", "inria"}
    shares = presets_at(schedule("any"))
    assert {"exact", "fast", "gsplat", "3dgut"} <= set(shares) <= set(ANY)
    assert min(shares, key=shares.get) == "exact"


def test_auto_is_any_unless_settings_say_otherwise():
    """Settings that are not those of `fast` are rendered with alone, as `fast` is where it is named."""
    assert schedule("auto") == schedule("any")
    other = RenderSettings.preset("gsplat", max_hits=5)
    for names, settings in ((("auto",), other), (("gsplat",), other), (("fast",), FAST)):
        found = schedule(*names, settings=settings)
        assert found.all_settings == (settings,)
        assert found.settings_at(7) == settings


def test_exact_among_others_has_a_tolerance_and_alone_none():
    """One step of several is not worth the time of digits that the next ones undo; a fit for `exact` alone is exact."""
    for names in (("any",), ("drgs",), ("exact", "gsplat")):
        by_preset = {found.nearest_preset()[0]: found for found in schedule(*names).all_settings}
        tolerance = by_preset.pop("exact").tolerance
        assert tolerance is not None
        assert 1e-3 < tolerance < 0.1
        assert all(found == RenderSettings.preset(name) for name, found in by_preset.items())
    exact = RenderSettings.preset("exact")
    assert schedule("exact", settings=exact).all_settings == (exact,)


def test_the_background_is_of_all():
    """Photographs are composited on it, whatever draws the Gaussians."""
    white = FAST.replace(background=(1.0, 1.0, 1.0))
    found = schedule("auto", settings=white)
    assert len(found.all_settings) > 1
    assert {settings.background for settings in found.all_settings} == {white.background}


@pytest.mark.parametrize("views", [1, 2, 3, 4, 8])
def test_every_view_meets_every_renderer(views, dataset):  # noqa: F811
    """However many views there are, of which the cycle may be a multiple: their order is new in every epoch."""
    trainer = trainer_of(dataset, config(renderers=("any",), max_steps=400))
    trainer.frames = (trainer.frames * 2)[:views]
    met = Counter()
    for step in range(400):
        met[trainer._next_view(), trainer.renderers.settings_at(step)] += 1
    assert len(met) == views * len(trainer.renderers.all_settings)


def test_a_step_renders_what_is_due(dataset, monkeypatch):  # noqa: F811
    """The trainer asks its schedule for each step, a fit that goes on with the same ones."""
    import drgs.fitting.trainer as module

    render, seen = module.render, []
    monkeypatch.setattr(module, "render", lambda g, camera, s, **k: (seen.append(s), render(g, camera, s, **k))[1])
    cfg = config(renderers=("gsplat", "fast", "3dgut"))
    trainer = trainer_of(dataset, cfg)
    for _ in range(4):
        trainer.step()
    again = Trainer.from_state(cfg, trainer.frames, *trainer.state(), "run")
    for _ in range(2):
        again.step()
    wanted = ("gsplat", "fast", "3dgut", "gsplat", "fast", "3dgut")
    assert seen == [RenderSettings.preset(name) for name in wanted]


# ------------------------------------------------------------------------------------------ what a fit is asked for


def _fit(*words: str) -> FitConfig:
    return cli._parse_arguments(["fit", "scene", "-o", "out", *words]).fit


@pytest.mark.parametrize(
    ("words", "renderers", "preset"),
    [
        ((), ("auto",), "fast"),
        (("--for", "any"), ("any",), "fast"),
        (("--for", "viewers"), ("viewers",), "gsplat"),
        (("--for", "gsplat"), ("gsplat",), "gsplat"),
        (("--for", "exact,inria"), ("exact", "inria"), "exact"),
        (("--for", "exact,fast"), ("exact", "fast"), "fast"),
        (("--preset", "fast"), ("fast",), "fast"),
        (("--preset", "gsplat"), ("auto",), "gsplat"),
        (("--preset", "exact", "--for", "any"), ("any",), "exact"),
        (("--preset", "gsplat", "--for", "gsplat"), ("gsplat",), "gsplat"),
    ],
)
def test_what_options_mean(words, renderers, preset):
    """`--for` says what the fit is for, `--preset` alone the same of one renderer; both together what draws the run's
    own pictures. The command that repeats a fit says so again.
    """
    found = _fit(*words, "--background", "1", "0", "0")
    assert found.renderers == renderers
    assert found.settings == RenderSettings.preset(preset, background=(1.0, 0.0, 0.0))
    line, beyond = fit_command(found, "scene", "out")
    assert not beyond
    again = cli._parse_arguments(line.split()[1:]).fit
    assert again.difference(found) is None
    assert again.settings == found.settings


def test_a_file_means_what_options_mean(tmp_path):
    """Of a mix, of `auto`, and of settings alone, in a file that `to_json` wrote or a person."""
    file = tmp_path / "a.json"
    for made in (FitConfig(), _fit("--for", "any"), _fit("--preset", "fast"), _fit("--for", "exact,inria")):
        file.write_text(json.dumps(made.to_json()))
        assert _fit("--config", str(file)) == made
    file.write_text('{"settings": {"preset": "fast"}}')
    assert _fit("--config", str(file)).renderers == ("fast",)
    assert _fit("--config", str(file), "--for", "drgs").renderers == ("drgs",)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--for", "gsplt"), "renderers must be one of auto, any, drgs, viewers, or of exact, .*, got 'gsplt'"),
        (("--for", "any,fast"), "or presets, each once, got any,fast"),
        (("--for", "fast,fast"), "each once, got fast,fast"),
        (("--for", "gsplat", "--preset", "exact"), "gsplat must have the settings of that preset, got those of exact"),
        (("--for", "any", "--set", "extent=4"), "any must have the settings of presets, got extent=4.0; name a single"),
    ],
)
def test_contradictions_are_one_line(words, told):
    with pytest.raises(ValueError, match=told) as error:
        _fit(*words)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------------------------------------------- what is seen


def test_a_fit_is_measured_in_what_it_is_for(dataset, tmp_path, capsys, monkeypatch):  # noqa: F811
    """The rows are those of evaluating with each preset, over the background of the fit; the worst view is named; the
    table is printed. `drgs eval` measures what it is asked for, in all views.
    """
    background = (0.1, 0.2, 0.3)
    settings = RenderSettings.preset("fast", background=background)
    cfg = config(max_steps=9, settings=settings, renderers=("drgs",))
    result = fit(dataset, tmp_path / "run", cfg, progress=False)
    found = result.metrics["renderers"]
    assert [row["name"] for row in found["rows"]] == ["exact", "fast", "gsplat"]
    frames = load_frames(dataset.split()[1], SIZE * SIZE)
    for row in found["rows"]:
        model = RenderSettings.preset(row["name"], background=background)
        want = metrics.evaluate(result.gaussians, frames, model)
        assert row["mean"]["psnr"] == pytest.approx(want["mean"]["psnr"], abs=1e-3)
        assert row["worst"] == min(row["views"], key=lambda view: view["psnr"])
        assert [view["name"] for view in row["views"]] == ["0", "8"]
    print_table(result.metrics)
    said = capsys.readouterr().out
    assert f"in several renderers, 2 test views of {SIZE}x{SIZE}" in said
    assert f"gsplat  {found['rows'][2]['mean']['psnr']:.2f}" in " ".join(said.split(" ")).replace("    ", "  ")
    monkeypatch.setattr("drgs.data.load", lambda path, **_: dataset)
    for asked, names in {"all": list(ANY), "inria": ["fast", "inria"], None: ["exact", "fast", "gsplat"]}.items():
        with lock_run(result.run, "eval") as claimed:
            again = evaluate_run(result.run, claimed, "train", renderer=asked)["renderers"]
        assert [row["name"] for row in again["rows"]] == names
        assert [len(row["views"]) for row in again["rows"]] == [7] * len(names)


def test_a_fit_without_held_out_views_is_measured_in_some(dataset, tmp_path):  # noqa: F811
    """At its end in those that it saw, at most 8 of them, evenly spaced."""
    found = fit(dataset, tmp_path / "run", config(max_steps=1, test_every=0), progress=False).metrics["renderers"]
    assert found["split"] == "train"
    assert [len(row["views"]) for row in found["rows"]] == [5, 5]  # every second of nine, `fast` and what viewers show
    assert found["of"] == 9
    assert metrics.through_renderers(None, [], {}, "test") is None


def test_a_short_fit_draws_some_of_many_held_out_views(dataset, tmp_path, monkeypatch):  # noqa: F811
    """All of them take longer than its steps; the table then has no worst view."""
    monkeypatch.setattr(metrics, "TRAIN_VIEWS", 2)
    found = fit(dataset, tmp_path / "run", config(max_steps=1, test_every=2), progress=False).metrics
    assert (found["count"], found["renderers"]["of"]) == (5, 5)
    assert [len(row["views"]) for row in found["renderers"]["rows"]] == [2, 2]
    assert "2 of 5 test views" in renderers_table(found)[0]
    assert metrics.most_views(1600) == 100


def test_own_settings_have_a_row_of_their_own():
    """With the fields that they replace, and not twice."""
    other = FAST.replace(extent=4.0)
    assert list(renderers_to_measure(("auto",), other)) == ["fast extent=4.0", "gsplat"]
    assert list(renderers_to_measure(("gsplat",), RenderSettings.preset("gsplat"))) == ["gsplat"]
    assert list(renderers_to_measure(("auto",), FAST)) == list(ANY)


def test_what_older_versions_measured_is_shown():
    """One renderer beside the run's own, without views; a part of the views, whose worst is not that of all."""
    viewers = {"preset": "gsplat", "psnr": 20.0, "own_psnr": 24.5, "split": "test", "views": ["a"]}
    title, head, rows = renderers_table({"viewers": viewers | {"width": 4, "height": 3}})
    assert rows == [("the run's own", "24.50"), ("gsplat", "20.00")]
    assert "1 test views of 4x3" in title
    assert head == ("renderer", "PSNR")
    view = {"name": "a", "psnr": 20.0, "cc_psnr": 21.0}
    row = {"name": "fast", "mean": {"psnr": 20.0, "cc_psnr": 21.0}, "worst": view, "views": [view]}
    some = {"split": "test", "width": 4, "height": 3, "rows": [row]}
    for count, title, last in ((1, "1 test views", ("20.00", "a")), (10, "1 of 10 test views", ())):
        found = renderers_table({"renderers": some, "split": "test", "count": count})
        assert title in found[0]
        assert found[2] == [("fast", "20.00", "21.00", *last)]
    assert renderers_table({"viewers": None})[2] == renderers_table({"renderers": None})[2] == []


def test_a_fit_says_which_renderers_it_takes_in_turn(tmp_path, capsys):
    """A line before the first step; none with a single renderer."""
    write_still(tmp_path / "data")
    for words, said in (((), True), (("--preset", "fast"), False)):
        run = str(tmp_path / f"run{said}")
        words = ["fit", str(tmp_path / "data"), "-o", run, "--max-steps", "1", "--no-report", *words]
        assert cli.main(words) == 0
        assert ("every step has one of the renderers gsplat, fast, 3dgut, exact" in capsys.readouterr().err) == said
