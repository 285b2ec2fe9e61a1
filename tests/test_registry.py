"""Claims of drgs.checks.registry: rows load when asked for, come from other packages, too, and errors name them."""

from __future__ import annotations

import sys

import pytest

from drgs.checks import registry
from drgs.checks.registry import Registry

pytestmark = pytest.mark.core


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A folder on the path that holds an installed package `others` with entry points of group `drgs.test`."""
    (tmp_path / "others.py").write_text("def twice(x):\n    return 2 * x\n")
    info = tmp_path / "others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[drgs.test]\ntwice = others:twice\nplain = others:twice\nbroken = others:none\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    registry._entry_points.cache_clear()
    yield
    registry._entry_points.cache_clear()
    sys.modules.pop("others", None)


def test_rows_load_when_they_are_asked_for():
    """A row written as a name is imported once, at the first question; names alone import nothing."""
    sys.modules.pop("colorsys", None)
    table = Registry("test", "drgs.test", {"plain": abs, "late": "colorsys:rgb_to_hsv"})
    assert list(table) == ["plain", "late"]
    assert "late" in table
    assert "colorsys" not in sys.modules
    assert table["late"] is table["late"] is sys.modules["colorsys"].rgb_to_hsv
    assert table["plain"] is abs


def test_other_packages_add_rows(package):
    """Entry points follow the package's own rows, which they cannot replace; a script assigns, and replaces."""
    table = Registry("test", "drgs.test", {"plain": abs})
    assert list(table) == ["plain", "twice", "broken"]
    assert len(table) == 3
    assert table["twice"](3) == 6
    assert table["plain"] is abs
    table["plain"] = table["more"] = round
    assert list(table) == ["plain", "twice", "more", "broken"]
    assert table["plain"] is round
    del table["more"]
    assert "more" not in table


def test_a_broken_entry_point_is_one_line(package):
    with pytest.raises(ValueError, match=r"^test 'broken' of others: must be importable, got AttributeError: "):
        Registry("test", "drgs.test", {})["broken"]


def test_rows_of_one_type(package):
    """Where rows must have a type, another one is refused when it is assigned, or found in another package."""
    table = Registry("test", "drgs.test", {"plain": 1}, int)
    table["more"] = 2
    with pytest.raises(ValueError, match=r"^test 'less': must be a builtins.int, got str; make one of it$"):
        table["less"] = "2"
    assert "less" not in table
    with pytest.raises(ValueError, match=r"^test 'twice' of others: must be a builtins.int, got function; "):
        table["twice"]


def test_names_that_a_user_types(package):
    """A row, or a function of any module; else the line that lists all rows."""
    table = Registry("test", "drgs.test", {"plain": abs})
    assert table.find("--test", "plain") is abs
    assert table.find("--test", "twice")(1) == 2
    assert table.find("--test", "others:twice")(2) == 4
    line = "--test: test must be one of plain, twice, broken, or package.module:function, got 'plane'; choose one"
    with pytest.raises(ValueError, match=f"^{line}$"):
        table.find("--test", "plane")
    with pytest.raises(KeyError):
        table["plane"]
