"""A race of policies: who leaves, when, and that cells of those are not run."""

from __future__ import annotations

import numpy as np
import pytest
from test_reproduce import still  # noqa: F401
from test_study import row_of

from drgs.studies import cells as engine
from drgs.studies.cells import Metric, Study, run_cells
from drgs.studies.experiments import study_of
from drgs.studies.plan import plan_of
from drgs.studies.rows import Cell, append_row, cell_of, read_study
from drgs.studies.statistics import decided, over_views
from drgs.train import FitConfig


def rows_of(units: int, protocol: str = "blind", **differences: float) -> list[dict]:
    """Three scenes in turn; a policy's PSNR is that of `ours` and its difference, with noise of 0.3 dB."""
    rng = np.random.default_rng(0)
    found = []
    for unit in range(units):
        scene = f"scene-{unit % 3}"
        base = 20 + rng.normal()
        found.append(row_of(scene, policy="ours", seed=unit, psnr=base))
        for label, difference in differences.items():
            found.append(row_of(scene, policy=label, seed=unit, psnr=base + difference + 0.3 * rng.normal()))
    return [{**row, "protocol": protocol} for row in found]


def test_who_leaves():
    """Whoever is clearly worse or better; not who is level, nor before six units, nor by other protocols' rows."""
    rows = rows_of(9, worse=-1.0, better=1.0, level=0.0)
    found = decided(rows, "ours", "blind")
    assert found.keys() == {"worse", "better"}
    assert found["worse"].startswith("worse has left after 9 units: -0.98 dB [")
    assert " against ours, on average over numbers of views." in found["worse"]
    assert decided(rows_of(5, worse=-1.0), "ours", "blind") == {}
    assert decided(rows, "ours", "paper") == {}
    assert decided([row for row in rows if row["policy"] != "ours"], "ours", "blind") == {}


def test_all_numbers_of_views_count():
    """The mean of what was measured on the way and at the end; a row without the metric has none."""
    row = row_of(psnr=20.0, curve={"3": {"psnr": 10.0}, "6": {"psnr": 15.0}, "8": {"psnr": None}})
    assert over_views(row, "psnr")["metrics"] == {"psnr": 15.0}
    assert over_views({**row, "metrics": {"psnr": None}}, "psnr")["metrics"] == {"psnr": None}
    rows = rows_of(9, late=-1.0)
    early = [
        {**row, "curve": {"3": {"psnr": row["metrics"]["psnr"] + 2.0}}} if row["policy"] == "late" else
        {**row, "curve": {"3": {"psnr": row["metrics"]["psnr"]}}}
        for row in rows
    ]  # fmt: skip
    assert decided(rows, "ours", "blind").keys() == {"late"}
    assert decided(early, "ours", "blind") == {}, "level on average"


def test_cells_of_who_has_left_are_not_run(tmp_path, monkeypatch):
    """They are passed over, told once; a study without a race runs them."""
    study = Study("tiny", lambda scene, split: tmp_path, {"ours": {}, "worse": {}, "level": {}}, FitConfig(),
                  (Metric("psnr", "PSNR"),), "ours", race=True)  # fmt: skip
    path = tmp_path / "rows.jsonl"
    for row in rows_of(9, worse=-1.0, level=0.0):
        append_row(path, row)
    ran = []

    def fake(study, cell, runs, progress=False):
        ran.append(cell.policy)
        return {**row_of(cell.scene, policy=cell.policy, seed=cell.seed, psnr=20.0), "seconds": 1.0}

    monkeypatch.setattr(engine, "run_cell", fake)
    cells = [Cell("s", (8, 0), "seed", x, "blind", seed) for seed in (90, 91) for x in ("ours", "worse", "level")]
    said: list[str] = []
    assert run_cells(study, cells, tmp_path, path, said.append) == ([], {})
    assert ran == ["ours", "level"] * 2
    assert sum("worse has left" in line for line in said) == 1
    assert {cell_of(row)[1] for row in read_study(path)} >= set(cells[:1])
    plain = Study("tiny", study.folder, study.policies, study.fit, study.metrics, "ours")
    run_cells(plain, cells, tmp_path, path, said.append)
    assert ran[4:] == ["worse"] * 2


def test_units_of_captures(still, tmp_path):  # noqa: F811
    """Seeds outermost, two splits in turn, without labels or a teacher; others race with the default."""
    plan = plan_of("captures", "tiny", tmp_path, [still], seeds=3, split=(4, 1), protocol="blind")
    count = len(plan.experiment.policies)
    assert [cell.split for cell in plan.cells[::count]] == [(4, 1), (4, 3), (4, 1)]
    assert len({(cell.split, cell.seed) for cell in plan.cells}) == 3
    assert plan.study.race
    assert plan.study.reference == "geometry+backdrop, v_opt"
    assert not study_of("static", "tiny", tmp_path).race
    assert plan.notes == (), "nothing is said of features, of which there are none"
    fit = plan.study.config_of(plan.cells[0])
    assert (fit.features.semantics, fit.selection.measure) == ("ignore", (3,))
    with pytest.raises(ValueError, match="--policy must be one of: random; uniform"):
        plan_of("captures", "tiny", tmp_path, policies=["joint"])
