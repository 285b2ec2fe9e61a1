"""Python blocks of the guides run, each by itself."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parent.parent / "docs"
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{k}")
    for page in [*sorted(DOCS.glob("for-*.md")), DOCS / "files.md"]
    for k, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.M | re.S))
]


@pytest.mark.parametrize("block", BLOCKS)
def test_block_runs(block, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # for files that a block writes
    exec(compile(block, "docs", "exec"), {})
    assert capsys.readouterr().out.strip()
