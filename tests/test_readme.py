"""The README and the page of commands are run: commands on a tiny scene, Python block by block, names looked up."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from doc_pages import ROOT, blocks, commands, elsewhere, make_folder, smaller

from drgs import cli

_PAGE = ROOT / "README.md"
_COMMANDS = ROOT / "docs/commands.md"
README = _PAGE.read_text(encoding="utf-8")


def _commands() -> list[list[str]]:
    return commands(blocks(_COMMANDS))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the README speaks of, see `doc_pages.make_folder`."""
    return make_folder(tmp_path_factory.mktemp("readme"))


def test_every_command_is_shown():
    """The list of commands is complete."""
    assert {command[0] for command in _commands()} == set(cli.COMMANDS)


@pytest.mark.slow
def test_commands_run(folder, monkeypatch, capsys):
    """The commands run in the order of their page, then those of the README, each on what those before have left."""
    monkeypatch.chdir(folder)
    for command in [*_commands(), *commands(blocks(_PAGE))]:
        if elsewhere(command):
            cli._parse_arguments(command)
            continue
        code = cli.main(smaller(command))
        captured = capsys.readouterr()
        assert code == 0, f"{command}: {captured.err}"
        if "-o" in command:
            path = folder / command[command.index("-o") + 1]
            assert path.is_file() or any(path.iterdir()), command


def test_quiet_commands_print_nothing(folder, monkeypatch, capsys):
    """With --quiet the files are the result."""
    monkeypatch.chdir(folder)
    done = set()
    for command in _commands():
        if command[0] not in ("fit", "eval", "render", "select", "fisher") or command[0] in done:
            continue
        done.add(command[0])
        is_there = (folder / "runs/scene").exists()  # of the test before, which is slow
        new = ["-o", "runs/quiet"] if command[0] == "fit" and is_there else []
        assert cli.main([*smaller(command), *new, "--quiet"]) == 0
        captured = capsys.readouterr()
        assert (captured.out, captured.err) == ("", ""), command


def test_python_runs(tmp_path):
    """Each Python block runs by itself, in a process and a folder of its own, and leaves no file."""
    started = []
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    for number, block in enumerate(block.text for block in blocks(_PAGE) if block.language == "python"):
        place = tmp_path / str(number)
        place.mkdir()
        command = [sys.executable, "-c", block]
        started.append((place, subprocess.Popen(command, cwd=place, env=environ, stderr=subprocess.PIPE, text=True)))
    assert len(started) == 1
    for place, process in started:
        _, error = process.communicate(timeout=300)
        assert process.returncode == 0, error
        assert not any(place.iterdir())


def test_presets_and_settings_exist():
    """The list names every preset, and nothing else."""
    from drgs.settings import PRESETS

    listed = (ROOT / "docs/conventions.md").read_text(encoding="utf-8").split("## Presets")[1].split("## ")[0]
    assert sorted(re.findall(r"\*\*`(\w+)`\*\*", listed)) == sorted(PRESETS)
