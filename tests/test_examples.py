"""The scripts of `examples/` run, and show what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from drgs.libllvm import require_llvm

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
UPSTREAM = EXAMPLES / "upstream"
SHOWN_IN = "3.9.1"
NAMES = ("ellipsoid_intersection.py", "srgb_adjoint.py", "restart_epsilon.py", "coincident.py")


def run(script: Path, *arguments, folder=None) -> str:
    """What a script prints, run as users run it."""
    environ = {**os.environ, "DRJIT_LIBLLVM_PATH": require_llvm().path}
    command = [sys.executable, str(script), *map(str, arguments)]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=120, cwd=folder)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def shown(script: str) -> str:
    """Output of an upstream script that shows its fault."""
    return checked(script, run(UPSTREAM / script))


def checked(script: str, text: str) -> str:
    """The text, if the fault is shown in it. A newer Mitsuba may have repaired it: then the test is skipped."""
    version, verdict = re.match(r"mitsuba ([^ ,]+)", text)[1], text.splitlines()[-1]
    if verdict.startswith("not reproduced") and version != SHOWN_IN:
        pytest.skip(f"{script}: {verdict} (Mitsuba {version}): repaired upstream, README.md there must say so")
    assert verdict.startswith("reproduced: "), text
    return text


def test_a_repaired_fault_is_skipped_and_a_lost_one_fails():
    with pytest.raises(pytest.skip.Exception, match=r"Mitsuba 3\.10\.0.*repaired upstream"):
        checked("a.py", "mitsuba 3.10.0, drjit 1.6.0\n\nnot reproduced: up to 0 %")
    with pytest.raises(AssertionError):
        checked("a.py", f"mitsuba {SHOWN_IN}, drjit 1.5.0\n\nnot reproduced: up to 0 %")


def test_every_upstream_script_is_described_and_minimal():
    readme = (UPSTREAM / "README.md").read_text(encoding="utf-8")
    scripts = sorted(UPSTREAM.glob("*.py"))
    assert len(scripts) == 4
    for script in scripts:
        source = script.read_text(encoding="utf-8")
        assert f"## `{script.name}`" in readme
        assert len(source.splitlines()) <= 60
        assert set(re.findall(r"^(?:import|from) (\w+)", source, flags=re.M)) <= {
            "drjit",
            "mitsuba",
            "numpy",
            "inspect",
        }


def test_small_ellipsoids_are_missed():
    rows = re.findall(r"^ *([\d.]+) \| +\d+ \| +([\d.]+) +([\d.]+) \| +([\d.]+) +([\d.]+)", shown(NAMES[0]), flags=re.M)
    missed = {float(sigma): [float(x) for x in rest] for sigma, *rest in rows}
    assert missed[0.01][0] > 30
    assert missed[0.3][:2] == [0, 0]
    # With directions as long as the radius nothing is missed: the cause is the one that the script names.
    assert max(max(x[2:]) for x in missed.values()) < 0.05


def test_default_gradients_are_wrong_and_linear_ones_right():
    rows = re.findall(r"srgb_primitives=(\w+) +(\S+): expected ([\d.]+), got ([\d.]+)", shown(NAMES[1]))
    assert len(rows) == 4
    for srgb, _, expected, got in rows:
        error = abs(float(got) / float(expected) - 1)
        assert error > 1 if srgb == "True" else error < 2e-3


def test_restarting_loses_hits():
    rows = re.findall(
        r"restart (\S+) behind the entry: got ([\d.]+)% of the hits; weight lost ([\d.]+)%", shown(NAMES[2])
    )
    lost = {float(step): float(weight) for step, _, weight in rows}
    assert lost[1e-4] > 25
    assert lost[1e-6] < 3


def test_of_coincident_gaussians_one_is_seen():
    assert "1 of 4 coincident Gaussians are seen" in shown(NAMES[3])
