"""Tables: whole at 80 columns, whatever the names are."""

from __future__ import annotations

import pytest

from drgs.display import tables

LONG = "IMG_20231012_123456_a_name_that_is_rather_long_[bold].JPG"


@pytest.mark.parametrize("name", ["0", "frame_000123", LONG, f"{LONG} {LONG}"])
def test_nothing_is_cut_off(name):
    """Every number of the widest table that drgs prints stands in one piece at 80 columns; names wrap."""
    numbers = ("1.234e+06", "1.23e+04", "12.3", "45.6", "12.2", "12.2", "99.9")
    columns = ("view", "score", "margin", "means %", "rot. %", "scales %", "opac. %", "sh %")
    found = tables.lines("fisher: 1 of 9 views", columns, [(name, *numbers), ("last", *numbers)])
    assert max(map(len, found)) <= 80
    assert "…" not in "".join(found)
    assert [line.split()[-7:] for line in found if "1.234e+06" in line] == [list(numbers)] * 2
    assert name.replace(" ", "") in "".join(found).replace(" ", "")
    assert {line.index("45.6") for line in found if "45.6" in line} == {found[1].index("rot. %") + 2}


def test_text_wraps_between_words():
    """Text besides the first column wraps, too, and says all of it."""
    why = "the gradient of a clamped alpha is zero in one and passes in the other (gsplat, line 155)"
    row = ("logit_opacities", "known deviation", "1.2e-04", "0.999999", "+1.2e-05", why)
    columns = ("group", "verdict", "relative", "cosine", "bias", "why")
    found = tables.lines("", columns, [row], ("verdict", "why"))
    assert max(map(len, found)) <= 80
    assert all(word in "\n".join(found) for part in row for word in part.split())


def test_headings_of_several_lines():
    """Headings stand on their columns, at the bottom."""
    found = tables.lines("", ("setting", "time\nforward"), [("fast", "0.5")])
    assert [line.rstrip() for line in found[:2]] == ["            time", "setting  forward"]
    assert found[-1] == "fast         0.5"
