"""A reshaping of the code changes no result: fits, picks, information, a crossval and images against their record."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.core

ROOT = Path(__file__).parents[1]


@pytest.mark.same_bits
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the record is of x86-64")
def test_results_are_those_of_the_record(tmp_path):
    """The same bits where the libraries give those of a record, of an AMD EPYC or an Intel Xeon; else near one."""
    cpu = Path("/proc/cpuinfo")
    if not (cpu.is_file() and " avx2 " in cpu.read_text()):
        pytest.skip("the record is of machines with AVX2")
    command = [sys.executable, str(ROOT / "tests" / "same_bits.py"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    records = json.loads((ROOT / "tests" / "same_bits.json").read_text())
    assert [list(found)] * len(records) == [list(record) for record in records]
    control = found.pop("control")
    own = [record for record in records if record.pop("control") == control]
    for record in own:
        changed = [name for name, row in record.items() if row["hash"] not in (None, found[name]["hash"])]
        assert not changed, "if that was meant: python tests/same_bits.py FOLDER --write, and say why in the commit"
        for name, row in record.items():  # numbers of results whose hash another machine's --write has removed
            assert found[name]["numbers"] == pytest.approx(row["numbers"], rel=1e-4, abs=1e-9), name
    for name in found if not own else ():
        near = [pytest.approx(record[name]["numbers"], rel=0.1, abs=1e-3) for record in records]
        assert found[name]["numbers"] in near, name
