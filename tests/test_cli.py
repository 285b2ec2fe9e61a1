"""The `drgs` command: quick help, one line per error, exit codes, options that arrive."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import types
from pathlib import Path

import pytest

from drgs import cli
from drgs.runtime import libllvm

ROOT = Path(__file__).resolve().parent.parent


def _drgs(*arguments: str, **environ: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "drgs", *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environ},
        timeout=120,
    )


def _command(monkeypatch, name: str, run) -> None:
    """Replace the function behind a command."""
    monkeypatch.setitem(sys.modules, f"drgs.commands.{name}", types.SimpleNamespace(run=run))


def _raise(error: BaseException):
    def run(args):
        raise error

    return run


def test_help_is_quick_and_complete():
    """`drgs --help` names every command, prints nothing on stderr, and takes less than a third of the processor time
    that importing torch takes on the same machine (measured an eighth: 0.34 s of 2.6)."""
    helped = []
    for _ in range(3):
        start = _seconds_of_children()
        done = _drgs("--help")
        helped.append(_seconds_of_children() - start)
    start = _seconds_of_children()
    subprocess.run([sys.executable, "-c", "import torch"], check=True)
    imported = _seconds_of_children() - start
    assert done.returncode == 0
    assert done.stderr == ""
    assert all(f"\n  {name} " in done.stdout for name in cli.COMMANDS)
    assert min(helped) < imported / 3


def _seconds_of_children() -> float:
    """Processor time of the processes that have ended: other work on the machine does not count."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_command_help(name, capsys):
    """Each command's help lists its own options and the common ones."""
    with pytest.raises(SystemExit) as end:
        cli.main([name, "--help"])
    assert not end.value.code
    text = capsys.readouterr().out
    usage = text.splitlines()[0]
    assert usage.startswith(f"usage: drgs {name}")
    assert re.search(r" --\w+ .*[A-Z]+ [A-Z]+ \[", usage) is None, "what stands without an option comes first"
    assert all(option in text for option in ("--debug", "--quiet", "--variant", "--threads"))


def test_version(capsys):
    """`drgs --version` prints the package's version, which --help mentions."""
    import drgs

    assert cli.main(["--version"]) == 0
    assert capsys.readouterr() == (f"drgs {drgs.__version__}\n", "")
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert "drgs --version" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("capture photos -o x --max-steps 9", "--max-steps must be an option of this command (it is one of drgs fit"),
        ("fisher x --max-pixels 9", "--max-pixels must be an option of this command (it is one of drgs view, fit"),
        ("fit data -o x --max-steps -1", "drgs fit: --max-steps must be a whole number in [1, 1000000000], got -1"),
        ("prune scene.ply -o small.ply --keep 2", "drgs prune: --keep must be a share above 0 and below 1, got 2"),
        (
            "fisher x --data y",
            "(it is one of drgs prune, reproduce), is none; did you mean --train?",
        ),
        (
            "fit data -o x --iterations 9",
            "--iterations must be an option of this command, is none; did you mean --max-steps?",
        ),
        (
            "crossval --scene x",
            "--scene must be an option of this command, is none; SCENE has no option: it stands alone",
        ),
        ("cite nowhere", "drgs cite: nowhere: must be a run folder, nothing is there; check the path"),
        ("fit scene.ply -o x", "drgs view, fisher, select and prune take a fitted scene"),
        ("fit scene.spz -o x", "drgs view, fisher, select and prune take a fitted scene"),
    ],
)
def test_messages_name_what_was_typed(line, expected, capsys, monkeypatch, tmp_path):
    """Options as they are typed, the commands that have one, and what is where a path leads."""
    monkeypatch.chdir(tmp_path)
    for name in ("scene.ply", "scene.spz"):
        Path(name).write_bytes(b"ply\n" if name == "scene.ply" else b"NGSP")
    assert cli.main(line.split()) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.core
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("frobnicate", "got 'frobnicate'; none has a name like it"),
        ("rendr x", "got 'rendr'; did you mean render?"),
        ("fit DATA", "drgs fit: --output must be given, is missing; add --output PATH"),
        ("render", "drgs render: SCENE must be given, is missing; add SCENE"),
        (
            "render x --widht 3",
            "drgs render: --widht must be an option of this command, is none; did you mean --width?",
        ),
        ("render x --width a", "drgs render: --width must be a whole number, got 'a'; correct it"),
        ("render x --preset best", "'best'"),
        ("info --threads 0", "drgs info: setup: threads must be a whole number in [1, 4096]"),
    ],
)
def test_bad_usage(line, expected):
    """Bad usage: exit code 2, exactly one line on stderr, no traceback, nothing on stdout."""
    done = _drgs(*line.split(), COLUMNS="40")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert expected in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.core
def test_no_command(capsys):
    """Without a command its help, on stderr, and exit code 2."""
    assert cli.main([]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("usage: drgs COMMAND")
    assert "  fit " in shown.err


@pytest.mark.parametrize(
    "error",
    [
        ValueError("load_ply: must hold x,\n  got y"),
        FileNotFoundError("load_ply: must hold x, got y"),
        NotImplementedError("load_ply: must hold x, got y"),
        PermissionError("load_ply: must hold x, got y"),
    ],
)
def test_errors_are_one_line(monkeypatch, capsys, error):
    """Errors that tell the user what to do are printed as one line, exit code 2."""
    _command(monkeypatch, "demo", _raise(error))
    assert cli.main(["demo"]) == 2
    assert capsys.readouterr().err == "drgs demo: load_ply: must hold x, got y\n"


def test_debug_and_bugs_have_a_traceback(monkeypatch):
    """--debug lets the exception through; a bug (TypeError) is never dressed up as bad input."""
    _command(monkeypatch, "demo", _raise(ValueError("x")))
    with pytest.raises(ValueError, match="x"):
        cli.main(["demo", "--debug"])
    _command(monkeypatch, "demo", _raise(TypeError("bug")))
    with pytest.raises(TypeError, match="bug"):
        cli.main(["demo"])


def test_interrupt(monkeypatch, capsys):
    """Ctrl-C: one line, exit code 130, as a shell expects."""
    _command(monkeypatch, "demo", _raise(KeyboardInterrupt()))
    assert cli.main(["demo"]) == 130
    assert capsys.readouterr().err == "drgs demo: interrupted\n"


def test_exit_code_of_a_command(monkeypatch):
    """A command's own return value is the exit code; None is success."""
    _command(monkeypatch, "demo", lambda args: 3)
    assert cli.main(["demo"]) == 3
    _command(monkeypatch, "demo", lambda args: None)
    assert cli.main(["demo"]) == 0


def test_options_of_fit(monkeypatch):
    """Defaults and every spelling that docs/commands.md uses arrive in the dataclass."""
    got = []
    _command(monkeypatch, "fit", got.append)
    cli.main(["fit", "DATA", "-o", "RUN"])
    cli.main(["fit", "DATA", "--output", "RUN", "--max-steps", "7", "--resume", "--mask", "ignore"])
    assert (got[0].data, got[0].output) == (Path("DATA"), Path("RUN"))
    fit = got[0].fit
    assert (fit.max_steps, fit.data.max_pixels, fit.density.max_gaussians) == (3000, 130_000, 30_000)
    assert (fit.data.test_every, fit.sh_degree, fit.renderers) == (8, 3, ("auto",))
    assert (got[1].fit.max_steps, got[1].resume, got[1].fit.data.mask) == (7, True, "ignore")


def test_settings_from_options(monkeypatch):
    """--preset and repeated --set become RenderSettings, each value by its field's type."""
    got = []
    _command(monkeypatch, "render", lambda args: got.append(args.settings()))
    sets = ["order=center", "extent=none", "alpha_max=0.5", "background=1,0.5,0"]
    arguments = [part for text in sets for part in ("--set", text)]
    assert cli.main(["render", "scene.ply", "--preset", "fast", *arguments]) == 0
    (settings,) = got
    assert (settings.order, settings.extent, settings.alpha_max) == ("center", None, 0.5)
    assert settings.background == (1.0, 0.5, 0.0)
    assert settings.transmittance_min == 0.01  # of the preset


def test_background_of_fit(monkeypatch, capsys):
    """fit renders over the background that it composites photographs on."""
    got = []
    _command(monkeypatch, "fit", lambda args: got.append(args.fit.settings))
    assert cli.main(["fit", "DATA", "-o", "RUN", "--background", "1", "1", "1"]) == 0
    assert got[0].background == (1.0, 1.0, 1.0)
    assert cli.main(["fit", "DATA", "-o", "RUN", "--set", "background=1,1,1"]) == 2
    assert "--set background: must be --background here" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sigma=3", "--set: must be a render setting, got 'sigma=3'; known: response, order,"),
        ("order", "--set: must be KEY=VALUE, got 'order'"),
        ("alpha_max=high", "--set alpha_max: must be of type float, got 'high'"),
        ("background=1,x,0", "--set background: must be of type tuple[float, float, float], got"),
        ("order=random", "order must be one of center, ray, entry, got 'random'"),
        ("response=ewa", "response='ewa'"),
    ],
)
def test_bad_settings(monkeypatch, capsys, text, expected):
    """A bad --set names the fields, the type or the alternative, in one line."""
    _command(monkeypatch, "render", lambda args: args.settings() and None)
    assert cli.main(["render", "scene.ply", "--set", text]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("render s.ply --set order=foo", "order must be one of"),
        ("render s.ply --orbit foo=1", "--orbit: must be of a known key"),
        ("view s.ply --preset gsplat --set traversal=bvh", "use traversal='tiles'"),
        ("tradeoff s.ply --set foo=1", "--set: must be a render setting"),
        ("select s.ply --candidates orbit --policy foo", "policy must be one of"),
        ("select s.ply --candidates orbit --region foo", "region must be box:"),
        ("fisher s.ply --region box:1", "region must be box:"),
        ("fit data -o run --set order=entry", "use traversal='bvh'"),
        ("select s.ply --candidates orbit -k 0", "-k must be in [1, "),
        ("capture --more -o run -k 0", "-k must be in [1, "),
        ("capture photos -o run --budget 10", "--budget must be a time with its unit"),
        ("capture photos -o run --region foo", "--region must be box:"),
        ("render s.ply --format gif", "--format must be a list of png, jpg"),
        ("prune s.ply -o t.ply", "either --keep or --loss must say"),
        ("prune s.ply -o t.ply --keep 1", "--keep must be a share above 0 and below 1, got 1"),
        ("prune s.ply -o t.ply --loss -1", "--loss must be a number of decibels above 0"),
        ("prune s.ply -o t.ply --keep 0.5 --region foo", "--region must be box:"),
        ("teach data --model clip --size 3", "--size: must be WIDTHxHEIGHT"),
        ("teach data --model clip --scales 9", "--scales must be numbers from 0.1 to 8"),
        ("eval run --scale 0.5", "--scale must be in [1, 1000], got 0.5"),
        ("fit data -o run --max-steps 0", "--max-steps must be a whole number in [1, "),
    ],
)
def test_values_are_checked_before_libraries_are_loaded(monkeypatch, capsys, line, expected):
    """Which takes seconds: one line by the options alone."""
    monkeypatch.setattr(cli, "_run", lambda *_: pytest.fail("loaded"))
    assert cli.main(line.split()) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


def test_info_json():
    """`drgs info --json` prints one JSON object and nothing else."""
    done = _drgs("info", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["backend"]["variant"] == os.environ["DRGS_VARIANT"]
    assert set(report) >= {"drgs", "commit", "cpu", "llvm", "threads", "cuda", "optix", "packages"}


def test_info_plain(capsys):
    """`drgs info` prints one aligned line a fact."""
    assert cli.main(["info"]) == 0
    keys = [line.split("  ")[0] for line in capsys.readouterr().out.splitlines()]
    assert {"backend", "libLLVM", "threads", "CUDA", "OptiX", "mitsuba", "torch"} <= set(keys)


def test_info_without_a_backend(tmp_path):
    """No usable libLLVM: the report still appears, with one line why on stderr, exit code 2."""
    old = tmp_path / "libLLVM-15.so.1"
    old.touch()
    done = _drgs("info", "--json", DRJIT_LIBLLVM_PATH=str(old), DRGS_VARIANT="llvm_ad_rgb")
    assert done.returncode == 2
    assert json.loads(done.stdout)["backend"]["variant"] is None
    lines = done.stderr.splitlines()
    assert lines[-1] == (
        f"drgs info: DRJIT_LIBLLVM_PATH must name a libLLVM >= {libllvm.MINIMUM_LLVM}, "
        f"got 15 ({old}); correct it or unset it."
    )
    assert "Traceback" not in done.stderr
