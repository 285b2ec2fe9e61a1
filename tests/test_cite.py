"""`drgs cite`: what a run used is in its BibTeX, what it did not use is not, and no entry is malformed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from drgs import cli
from drgs.commands import cite
from drgs.fitting.components.semantics import SemanticRecord
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.io.journal import SCHEMA
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

    def write(
        preset: str = "fast",
        active: SelectionConfig | None = None,
        lpips: float | None = None,
        filter_3d: str = "off",
        **fields,
    ):
        settings = RenderSettings.preset("fast" if preset == "any" else preset)
        config = FitConfig(settings=settings, renderers=(preset,), selection=active, filter_3d=filter_3d)
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
        ({"preset": "any"}, {"moenneloccoz2024raytracing", "zwicker2001ewa", "ye2025gsplat", "wu2025threedgut"}),
        ({"preset": "inria"}, {"zwicker2001ewa"}),
        ({"preset": "exact"}, {"moenneloccoz2024raytracing"}),
        ({"filter_3d": "on"}, {"moenneloccoz2024raytracing", "yu2024mipsplatting"}),
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
        (SelectionConfig().replace(criterion="eig"), {"jiang2024fisherrf"}),
        (SelectionConfig().replace(criterion="logdet"), {"wilson2025popgs"}),
        (SelectionConfig().replace(criterion="block_logdet"), {"wilson2025popgs"}),
        (SelectionConfig().replace(policy="fisherrf"), {"jiang2024fisherrf"}),
        (SelectionConfig().replace(method="fisherrf"), {"ash2021bait", "jiang2024fisherrf"}),
        (SelectionConfig().replace(policy="moments"), {"ewen2025moments"}),
        (SelectionConfig().replace(policy="farthest"), set()),
        (SelectionConfig().replace(policy="random", method="fisherrf"), set()),
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
    """Every field of its kind is there and says something, braces are balanced, nothing is outside of ASCII."""
    for key, text in cite._entries().items():
        comment, first, *lines, last = text.splitlines()
        kind = re.fullmatch(rf"@(\w+)\{{{key},", first)[1]
        fields = dict(re.fullmatch(r"  (\w+) = \{(.+)\},", line).groups() for line in lines)
        assert comment.startswith("% "), key
        assert last == "}", key
        assert text.isascii(), key
        assert text.count("{") == text.count("}"), key
        assert _NEEDS[kind] <= set(fields), key
        assert re.fullmatch(r"(20\d\d)?", fields.get("year", "")), key


def test_what_is_cited_is_what_is_in_the_file():
    """Each key that the code cites has its entry, each entry is cited by something, and none is there twice."""
    names = re.findall(r"^@\w+\{(\w+),$", Path(cite.__file__).with_name("references.bib").read_text(), flags=re.M)
    assert sorted(names) == sorted([*cite._EVERY_USE, *cite._RUNS])


def test_every_entry_is_printed_as_it_stands(monkeypatch):
    """In the order of the code, a blank line between two; the program's own has its version besides."""
    from drgs import runtime

    monkeypatch.setattr(cite, "_used", lambda folder: None)
    monkeypatch.setattr(cite, "_RUNS", dict.fromkeys(cite._RUNS, lambda used: True))
    version = f"  version = {{{runtime.version()}}},\n"
    printed = cite.cited(Path("run"))
    assert printed.count(version) == 1
    file = Path(cite.__file__).with_name("references.bib").read_text()
    assert printed.replace(version, "") + "\n" == file


def test_what_is_no_run(tmp_path, capsys):
    """One line, exit code 2."""
    assert cli.main(["cite", str(tmp_path)]) == 2
    assert re.fullmatch(r"drgs cite: .*must be a run folder.*\n", capsys.readouterr().err)


def test_the_list_without_a_run_loads_no_torch():
    """It is printed at once."""
    code = "import sys; from drgs.commands.cite import cited; cited(None); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=300).returncode == 0
