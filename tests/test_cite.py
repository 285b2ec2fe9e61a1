"""`drgs cite`: what a run used is in its BibTeX, what it did not use is not, and no entry is malformed."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from drgs import cli
from drgs.commands import cite
from drgs.files import SCHEMA
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.semantic_record import SemanticRecord
from drgs.settings import RenderSettings

CORE = {"drgs", "jakob2022drjit", "mitsuba3", "kerbl2023gaussians", "li2025nextbestview"}
FIT = CORE | {"kheradmand2024mcmc", "wang2004ssim", "andersson2020flip"}
_NEEDS = {
    "article": {"author", "title", "journal", "year"},
    "inproceedings": {"author", "title", "booktitle", "year"},
    "software": {"author", "title"},
}


def keys(text: str) -> set[str]:
    return set(re.findall(r"^@\w+\{(\w+),$", text, flags=re.M))


@pytest.fixture
def run(tmp_path):
    """Writes the record of a fit; what it does not say is as a plain fit of a transforms.json has it."""

    def write(preset: str = "fast", active: SelectionConfig | None = None, lpips: float | None = None, **fields):
        config = FitConfig(settings=RenderSettings.preset(preset), selection=active)
        record = {"schema": SCHEMA, "command": "fit", "data": "scene", "format": "transforms", "train": ["a"]}
        record |= {"test": ["b"], "fit": config.to_json(), **fields}
        if active is not None:
            record |= {"pool": ["a"]}
        (tmp_path / "config.json").write_text(json.dumps(record))
        (tmp_path / "metrics.json").write_text(json.dumps({"mean": {"psnr": 20.0, "lpips": lpips}}))
        return tmp_path

    return write


def test_without_a_run_the_core_is_printed(capsys):
    assert cli.main(["cite"]) == 0
    assert keys(capsys.readouterr().out) == CORE


def test_a_plain_fit(run, capsys):
    """Peaks along rays; poses from elsewhere; no views chosen."""
    assert cli.main(["cite", str(run())]) == 0
    assert keys(capsys.readouterr().out) == FIT | {"moenneloccoz2024raytracing"}


@pytest.mark.parametrize(
    ("asked", "more"),
    [
        ({"preset": "gsplat"}, {"zwicker2001ewa", "ye2025gsplat"}),
        ({"preset": "inria"}, {"zwicker2001ewa"}),
        ({"preset": "exact"}, {"moenneloccoz2024raytracing"}),
        ({"format": "colmap"}, {"moenneloccoz2024raytracing", "schoenberger2016sfm"}),
        ({"lpips": 0.0}, {"moenneloccoz2024raytracing", "zhang2018lpips"}),
        ({"times": [0.0, 1.0]}, {"moenneloccoz2024raytracing", "wu2024fourd"}),
    ],
)
def test_what_a_fit_used(run, asked, more):
    assert keys(cite.cited(run(**asked))) == FIT | more


@pytest.mark.parametrize(
    ("active", "more"),
    [
        (SelectionConfig(), {"ash2021bait"}),
        (SelectionConfig.of(criterion="eig"), {"jiang2024fisherrf"}),
        (SelectionConfig.of(criterion="logdet"), {"wilson2025popgs"}),
        (SelectionConfig.of(criterion="block_logdet"), {"wilson2025popgs"}),
        (SelectionConfig.of(policy="fisherrf"), {"jiang2024fisherrf"}),
        (SelectionConfig.of(method="fisherrf"), {"ash2021bait", "jiang2024fisherrf"}),
        (SelectionConfig.of(policy="moments"), {"ewen2025moments"}),
        (SelectionConfig.of(policy="farthest"), set()),
        (SelectionConfig.of(policy="random", method="fisherrf"), set()),
    ],
)
def test_how_views_were_chosen(run, active, more):
    assert keys(cite.cited(run(active=active))) == FIT | {"moenneloccoz2024raytracing"} | more


def test_a_fit_with_a_teacher(run):
    """Features were distilled."""
    taught = SemanticRecord("rgb_feature_langseg", "", 512, 128, (80, 60), None, False)
    more = {"moenneloccoz2024raytracing", "zhou2024feature3dgs"}
    assert keys(cite.cited(run(semantics=taught.to_json()))) == FIT | more


def test_entries_are_well_formed():
    """Each key once, every field of its kind there, braces balanced, nothing outside of ASCII."""
    for work in cite._WORKS:
        text = cite._entry(work)
        assert text.isascii(), work.key
        assert _NEEDS[work.kind] <= set(work.fields), work.key
        assert text.count("{") == text.count("}"), work.key
        for name, value in work.fields.items():
            assert value, (work.key, name)
        assert re.fullmatch(r"(20\d\d)?", work.fields.get("year", "")), work.key
    assert len({work.key for work in cite._WORKS}) == len(cite._WORKS)


def test_what_is_no_run(tmp_path, capsys):
    """One line, exit code 2."""
    assert cli.main(["cite", str(tmp_path)]) == 2
    assert re.fullmatch(r"drgs cite: .*must be a run folder.*\n", capsys.readouterr().err)


def test_the_list_without_a_run_loads_no_torch():
    """It is printed at once."""
    code = "import sys; from drgs.commands.cite import cited; cited(None); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=300).returncode == 0
