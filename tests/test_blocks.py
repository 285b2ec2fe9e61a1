"""Claims of the tables of blocks, criteria and policies: a row is all there is to add, and nothing else knows names."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
import torch

import drgs
from drgs import runtime
from drgs.cameras import orbit
from drgs.checks import registry
from drgs.fitting.config import SelectionConfig
from drgs.gain import CRITERIA, Prior, ViewCriterion, criterion_named, information_gain, scorer
from drgs.information.blocks import SceneBlocks
from drgs.information.choices import BLOCK_NAMES, BLOCKS, CRITERION_NAMES, GAUSSIAN_GROUPS, POLICIES, POLICY_NAMES
from drgs.information.groups import GROUPS
from drgs.information.network_groups import NETWORK_GROUPS
from drgs.information.quantity import Quantity, ViewContext
from drgs.information.sums import add, together
from drgs.select import Cache, Scoring, select
from drgs.settings import RenderSettings
from examples.brightness_block import BRIGHTNESS

pytestmark = pytest.mark.core

FAST = RenderSettings.preset("fast")


@pytest.fixture(autouse=True)
def tables(monkeypatch):
    """Rows that a test adds go with it."""
    for table in (BLOCKS, CRITERIA, POLICIES):
        monkeypatch.setattr(table, "_rows", dict(table._rows))


@pytest.fixture(scope="module")
def world():
    """Gaussians and cameras around them."""
    draw = torch.Generator().manual_seed(3)
    normal = torch.randn(20, 3, generator=draw)
    g = drgs.Gaussians.from_arrays(
        0.5 * normal,
        torch.randn(20, 4, generator=draw),
        torch.full((20, 3), 0.15),
        torch.full((20,), 0.6),
        torch.randn(20, 1, 3, generator=draw),
    )
    return g, orbit((0, 0, 0), 3.0, 6, width=24, height=18)


def test_names_are_those_of_the_tables():
    """The names that types and help texts list are this package's rows, in their order."""
    for table, names in ((BLOCKS, BLOCK_NAMES), (CRITERIA, CRITERION_NAMES), (POLICIES, POLICY_NAMES)):
        assert tuple(table._rows) == names


def test_groups_of_the_blocks():
    """Together the blocks tell about all groups of Gaussians, those of a network, and the backdrop."""
    told = {name: set(BLOCKS[name].groups) for name in BLOCK_NAMES}
    assert told["geometry"] | told["semantic"] == {*GROUPS} == {*GAUSSIAN_GROUPS}
    assert {*GROUPS} - told["geometry"] == {"features"}
    assert {*GROUPS} - told["semantic"] == {"sh"}
    assert told["deformation"] == {*NETWORK_GROUPS}
    assert told["backdrop"] == {"backdrop"}


def test_tables_load_nothing_heavy():
    """Names of policies, criteria and blocks, and whether a criterion needs a pool, come without torch and Dr.Jit."""
    code = (
        "import sys; from drgs.information.choices import BLOCKS, POLICIES;"
        "from drgs.information.scoring import Scoring;"
        "from drgs.information.criteria import criterion_named; list(BLOCKS), list(POLICIES), Scoring().prior_of();"
        "assert criterion_named('v_opt').needs_pool; print([x for x in ('torch', 'drjit') if x in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_block_is_one_row(world):
    """It is scored, beside others or alone, kept in a cache, summed over known views and mapped, by its row alone."""
    g, cams = world
    BLOCKS["brightness"] = BRIGHTNESS
    scoring = Scoring("eig", FAST, prior=Prior(1.0), blocks=("geometry", "brightness"))
    cache = Cache()
    found = select(g, cams[2:], cams[:2], 2, scoring=scoring, cache=cache)
    again = select(g, cams[2:], cams[:2], 2, scoring=scoring, cache=cache)
    assert found.blocks == again.blocks == ["geometry", "brightness"]
    assert found.scores == again.scores
    assert again.computed == 0
    squares = [float(drgs.render(g, camera, FAST).rgb.double().square().sum()) for camera in cams]
    for i, parts in enumerate(found.parts):
        assert parts["brightness"] == pytest.approx(squares[2 + i] / (1 + squares[0] + squares[1]), rel=1e-6)
    apart = select(g, cams[2:], cams[:2], 1, scoring=dataclasses.replace(scoring, combine="zscore"))
    assert {name.partition(".")[0] for name in apart.parts[0]} == {"geometry", "brightness"}
    blocks = SceneBlocks.of(g, scoring, cams)
    said = blocks.information(cams[0])
    assert float(said["brightness"]["brightness"]) == pytest.approx(squares[0], rel=1e-6)
    H = together(said)
    assert list(H) == [*BLOCKS["geometry"].groups, "brightness"]
    maps = blocks.variance_maps(cams[0], {name: torch.ones_like(x) for name, x in H.items()})
    assert float(maps["brightness"].double().sum()) == pytest.approx(squares[0], rel=1e-5)
    weights = {name: torch.ones_like(x) for name, x in H.items()}
    assert torch.equal(blocks.variance_map(cams[0], weights), maps["geometry"] + maps["brightness"])
    assert "brightness" not in select(g, cams[2:], cams[:2], 1, settings=FAST).blocks  # counts where it is named
    with pytest.raises(ValueError, match="groups must be of blocks geometry, got brightness; add its block or drop it"):
        select(g, cams[2:], cams[:2], 1, settings=FAST, blocks=("geometry",), groups=("means", "brightness"))


def test_a_quantity_without_a_map_says_so(world):
    """In one line, with what is missing."""
    g, cams = world

    @dataclasses.dataclass(frozen=True)
    class Silent(Quantity):
        pass

    with pytest.raises(NotImplementedError, match="blocks: Silent must have a method `variance_map`, has none; add it"):
        Silent().variance_map(ViewContext(g, cams[0], FAST), {})


def test_sums_are_of_the_same_parameters():
    """What is added is of equal shapes, in float64; the total owns its tensors."""
    part = {"means": torch.ones(2, 3)}
    total: dict = {}
    add(total, part)
    add(total, part)
    assert total["means"].dtype == torch.float64
    assert float(total["means"].sum()) == 12
    assert float(part["means"].sum()) == 6
    with pytest.raises(
        ValueError, match=r"means must be of the same parameters in every view, got shapes \(2, 3\) and"
    ):
        add(total, {"means": torch.ones(3, 3)})


def test_a_criterion_is_one_row(world):
    """A function, or a `ViewCriterion` that says what it needs; v_opt written again scores and picks as v_opt."""
    g, cams = world
    CRITERIA["mine"] = ViewCriterion(lambda ratio, variance: ratio / (1 + ratio) * variance, True, True, prior=1e-2)
    own, usual = (select(g, cams[2:], cams[:2], 3, settings=FAST, criterion=name) for name in ("mine", "v_opt"))
    assert own.scores == pytest.approx(usual.scores, rel=1e-6 if runtime.backend().name == "cuda" else 1e-12)
    assert [pick.index for pick in own.picks] == [pick.index for pick in usual.picks]
    assert own.evaluations == usual.evaluations
    CRITERIA["plain"] = lambda ratio, variance: (ratio >= 1).double()
    assert not criterion_named("plain").scores_fall
    counted = select(g, cams[2:], cams[:2], 3, settings=FAST, criterion="plain")
    assert counted.evaluations == 4 + 3 + 2
    assert all(score == round(score) for score in counted.scores)
    H = {"means": torch.ones(2, 3)}
    assert information_gain(H, H, "plain", Prior(0.0)).total == 6
    with pytest.raises(ValueError, match="information_gain: pool must be given with criterion mine, got none"):
        scorer(H, "mine")


def test_a_criterion_of_a_module(world, tmp_path, monkeypatch):
    """`module:function` in Python, and on the command line; nothing is imported before views are scored by it."""
    g, cams = world
    (tmp_path / "my_criteria.py").write_text("def halved(ratio, variance):\n    return ratio / 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    scoring = Scoring("my_criteria:halved", FAST)
    SelectionConfig(scoring=Scoring("my_criteria:halved"))
    assert "my_criteria" not in sys.modules
    own = select(g, cams[2:], cams[:2], 1, scoring=scoring)
    eig = select(g, cams[2:], cams[:2], 1, settings=FAST, criterion="eig")
    assert own.scores == pytest.approx([score / 2 for score in eig.scores], rel=1e-12)
    with pytest.raises(
        ValueError, match="^select my_criteria:none: my_criteria must have a function none, has halved$"
    ):
        select(g, cams[2:], cams[:2], 1, settings=FAST, criterion="my_criteria:none")
    with pytest.raises(ValueError, match="^select: criterion must be one of v_opt, eig, .*got 'best'; choose one$"):
        Scoring("best")


def test_rows_of_other_packages(world, tmp_path, monkeypatch):
    """Entry points are known to Python and to records of options; they are no part of what is the default."""
    g, cams = world
    (tmp_path / "others.py").write_text(
        "from drgs.select import Selection\n"
        "def last(pool):\n"
        "    scores = list(map(float, range(len(pool.candidates))))\n"
        "    return Selection([pool.pick(len(scores) - 1, scores[-1])], scores)\n"
        "def halved(ratio, variance):\n    return ratio / 2\n"
    )
    info = tmp_path / "others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[drgs.policies]\nlast = others:last\n[drgs.criteria]\nhalved = others:halved\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    registry._entry_points.cache_clear()
    try:
        assert select(g, cams[2:], cams[:2], 1, "last").picks[0].index == 3
        assert SelectionConfig(policy="last", scoring=Scoring("halved")).policy == "last"
        assert select(g, cams[2:], cams[:2], 1, settings=FAST, criterion="halved").scores[0] > 0
        assert Scoring().criterion == "v_opt"
    finally:
        registry._entry_points.cache_clear()
        sys.modules.pop("others", None)
