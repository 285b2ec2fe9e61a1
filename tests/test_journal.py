"""JSON lines that survive a crash: the tail of a killed process, damage, several writers, and what 0.2.0 wrote."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from drgs.capturing.record import CaptureRecord
from drgs.files import Run
from drgs.io.journal import Journal, check_schema

pytestmark = pytest.mark.core


def test_a_tail_that_a_killed_process_left(tmp_path):
    """It is no row, even where it could be read, and the next row replaces it."""
    journal = Journal(tmp_path / "a.jsonl")
    assert journal.rows() == []
    journal.append({"a": 1})
    for tail in (b'{"a": 2}', b'{"a": ', b"\x00\xff"):
        with journal.path.open("ab") as file:
            file.write(tail)
        assert journal.rows() == [{"a": 1}]
    journal.append({"a": 3})
    assert journal.path.read_bytes() == b'{"a": 1}\n{"a": 3}\n'


def test_other_damage(tmp_path):
    """Is named by its line, or left out where a reader says so."""
    journal = Journal(tmp_path / "a.jsonl")
    journal.path.write_bytes(b'{"a": 1}\n{"a"\n\n{"b": 2}\n')
    with pytest.raises(ValueError, match=r"a\.jsonl, line 2: must be valid JSON"):
        journal.rows()
    with pytest.raises(ValueError, match=r"a\.jsonl: line 2 must be a thing, is not"):
        journal.rows(lambda row: row["a"], "a thing")
    assert journal.rows(skip_damaged=True) == [{"a": 1}, {"b": 2}]
    assert journal.rows(lambda row: row["a"], skip_damaged=True) == [{"a": 1}]


def test_rows_that_are_not_needed(tmp_path):
    """Are not written; the file is as it was."""
    journal = Journal(tmp_path / "a.jsonl", durable=True)
    for _ in range(2):
        journal.append({"a": 1}, unless=lambda rows: {"a": 1} in rows)
    assert journal.rows() == [{"a": 1}]


def test_several_writers(tmp_path):
    """Four processes append 200 lines each to one file: none is lost or broken."""
    code = (
        "import sys; from pathlib import Path; from drgs.io.journal import Journal\n"
        "for i in range(200): Journal(Path(sys.argv[1])).append({'by': sys.argv[2], 'i': i, 'long': 'x' * 5000})\n"
    )
    path = tmp_path / "a.jsonl"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(path), str(k)]) for k in range(4)]
    assert [writer.wait() for writer in writers] == [0] * 4
    rows = Journal(path).rows()
    assert sorted((row["by"], row["i"]) for row in rows) == sorted((str(k), i) for k in range(4) for i in range(200))


def test_versions(tmp_path):
    """One that is not known is refused in one line."""
    check_schema(tmp_path, {"schema": 2}, (1, 2), "schema", "fit again")
    for value, got in (({"schema": 3}, "3"), ({"schema": True}, "True"), ({}, "None"), ([], "'list'")):
        with pytest.raises(ValueError, match=rf"schema must be 1 or 2, got {got}; fit again"):
            check_schema(tmp_path, value, (1, 2), "schema", "fit again")


def test_files_of_0_2_0(tmp_path):
    """Its log with half a line at the end, and its record of a capture."""
    line = '{"schema": 1, "time": "2026-11-20T10:00:00.000+00:00", "event": "start", "step": 0}'
    (tmp_path / "log.jsonl").write_text(f'{line}\n{{"schema": 1, "ti')
    run = Run(tmp_path)
    assert [event["event"] for event in run.events()] == ["start"]
    run.log("resume", step=1)
    assert [event["event"] for event in run.events()] == ["start", "resume"]
    batch = {
        "inputs": [["/photos/IMG_0.png", 100, 1]],
        "options": {"frames": 150, "masks": None, "seed": 0},
        "steps": [{"name": "photos", "line": "6 photographs", "seconds": 0.5}],
        "findings": [{"kind": "poses", "text": "few", "advice": "take more"}],
        "plan": {},
        "handover": "",
        "result": {},
    }
    record = {"schema": 1, "command": "capture", "batches": [batch]}
    (tmp_path / "capture.json").write_text(json.dumps(record))
    read = CaptureRecord.read(tmp_path)
    assert read.batch.step("photos").line == "6 photographs"
    read.write()
    assert json.loads((tmp_path / "capture.json").read_text()) == record
    (tmp_path / "capture.json").write_text(json.dumps(record | {"schema": 7}))
    with pytest.raises(ValueError, match=r"capture\.json: schema must be 1, got 7; capture into another folder"):
        CaptureRecord.read(tmp_path)
