"""The notebook of examples/ runs cell by cell, says what its text claims, and is committed with small outputs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

PATH = Path(__file__).resolve().parent.parent / "examples" / "next_views.ipynb"
BOOK = json.loads(PATH.read_text(encoding="utf-8"))
CODE = [cell for cell in BOOK["cells"] if cell["cell_type"] == "code"]


def test_it_is_committed_with_its_outputs():
    """Every cell that shows something has it, in the order of running, without an error; all of it is small."""
    assert PATH.stat().st_size < 500_000
    assert [cell["execution_count"] for cell in CODE] == list(range(1, len(CODE) + 1))
    for cell in CODE:
        kinds = [output["output_type"] for output in cell["outputs"]]
        assert "error" not in kinds
        source = "".join(cell["source"])
        assert ("plt.show()" in source) == ("display_data" in kinds), source
        assert ("print(" in source) <= ("stream" in kinds), source


def test_it_runs(monkeypatch, capsys):
    """Cell by cell; the derivatives agree, and picks by information leave least of what they go by."""
    plt = pytest.importorskip("matplotlib.pyplot", reason="the notebook draws: pip install 'drgs[report]'")
    plt.switch_backend("Agg")
    shown = []
    monkeypatch.setattr(plt, "show", lambda: (shown.append(len(plt.get_fignums())), plt.close("all")))
    names: dict = {"__name__": "__main__"}
    for number, cell in enumerate(CODE, 1):
        exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
    capsys.readouterr()
    assert shown
    assert all(count == 1 for count in shown)
    assert names["forward"] == pytest.approx(names["reverse"], rel=1e-4)
    assert names["central"][5] == pytest.approx(names["reverse"], rel=1e-4)
    left = {policy: names["left"]([0, 1, *chosen]) for policy, chosen in names["picks"].items()}
    assert left["fisher"] < min(left["farthest"], left["random"])
