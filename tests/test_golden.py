"""What must stay as it is while the package is rebuilt, beside the bits of test_same_bits.py: what every command is
parsed into, and a run folder and a checkpoint of version 0.2.0 that are read and gone on with.

    python tests/test_golden.py      makes tests/golden anew; the commit says what changed and why
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.core

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
# The shortest line of every command.
LINES = (
    "info",
    "render run",
    "view run",
    "fit data -o run",
    "fit data -o run --views active --add 5 --exposure auto --poses refined --skybox on --max-steps 300",
    "eval run",
    "report run",
    "share run",
    "prune run --keep 0.5 -o b.ply",
    "select run --candidates orbit",
    "fisher run",
    "query run --class wall",
    "convert a.ply b.spz",
    "mesh run -o mesh.glb",
    "crossval a.ply --cameras cameras.json",
    "tradeoff a.ply",
    "stress",
    "capture photos -o run",
    "sfm photos -o data",
    "teach data --model clip",
    "scene room -o room",
    "reproduce static -o study",
    "demo",
    "cite",
)
QUICK = ("--max-steps", "24", "--save-every", "6", "--max-gaussians", "80", "--feature-width", "4", "--sh-degree", "1")
QUICK += ("--test-every", "4", "--no-report", "--quiet")
EVERYTHING = ("--exposure", "learned", "--poses", "refined", "--skybox", "on", "--transients", "mask")
EVERYTHING += ("--filter-3d", "on")


def parsed(line: str) -> dict:
    """Name of an option -> its value, of every option that a line of words is parsed into, as JSON has it."""
    from drgs import cli
    from drgs.checks.records import options_in

    def plain(value):
        if isinstance(value, list | tuple):
            return [plain(x) for x in value]
        if isinstance(value, dict):
            return {str(key): plain(x) for key, x in value.items()}
        return value if value is None or isinstance(value, bool | int | float | str) else str(value)

    args = cli._parse_arguments(line.split())
    values = {}
    for name, option in options_in(type(args)).items():
        value = args
        for step in option.path:
            if value is None:  # a record that no option names would have the defaults, but for lambda
                value = None if name == "value" else option.default
                break
            value = getattr(value, step)
        values[name] = plain(value)
    if "value" in values:  # of the prior, which is --prior and --relative-prior
        values |= {"prior": values.pop("value"), "relative_prior": values.pop("relative")}
    return values


def test_commands_are_parsed_as_before():
    """Every option of every command has the name and the default that it had."""
    before = json.loads((GOLDEN / "options.json").read_text())
    assert list(before) == list(LINES)
    for line in LINES:
        assert json.loads(json.dumps(parsed(line))) == before[line], line


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A copy of the golden files, as the working directory: photographs, a finished run, a run that was stopped."""
    shutil.copytree(GOLDEN, tmp_path / "golden")
    monkeypatch.chdir(tmp_path / "golden")


def test_a_finished_run_is_read(place):
    """Its Gaussians are rendered, and worth on the held-out views what they were."""
    from drgs import cli

    before = json.loads(Path("run/metrics.json").read_text())
    assert cli.main(["eval", "run", "--quiet"]) == 0
    after = json.loads(Path("run/metrics.json").read_text())
    assert after["mean"]["psnr"] == pytest.approx(before["mean"]["psnr"], abs=0.01)
    assert cli.main(["select", "run", "--candidates", "orbit", "--count", "4", "-o", "picks.json", "--quiet"]) == 0
    assert len(json.loads(Path("picks.json").read_text())["picks"]) == 1


def test_a_stopped_run_goes_on(place):
    """From its checkpoint to the last step; it is worth what a fit is that was not stopped."""
    from drgs import cli

    assert cli.main(["fit", "still", "-o", "stopped", *QUICK, "--resume"]) == 0
    psnr = [json.loads(Path(f"{run}/metrics.json").read_text())["mean"]["psnr"] for run in ("run", "stopped")]
    assert psnr[1] == pytest.approx(psnr[0], abs=0.5)


def test_a_stopped_run_with_everything_goes_on(place):
    """Gains, poses, a skybox, transients and a low-pass filter are read from its checkpoint, and reported."""
    from drgs import cli

    assert cli.main(["fit", "still", "-o", "everything", *QUICK, *EVERYTHING, "--resume"]) == 0
    metrics = json.loads(Path("everything/metrics.json").read_text())
    assert {"poses", "skybox"} <= set(metrics)
    assert Path("everything/refined_cameras.json").is_file()


def make() -> None:
    """The golden files, in this version."""
    import os

    from same_bits import write_photographs

    from drgs import cli
    from drgs.train import Trainer

    shutil.rmtree(GOLDEN, ignore_errors=True)
    GOLDEN.mkdir()
    (GOLDEN / "options.json").write_text(json.dumps({line: parsed(line) for line in LINES}, indent=1) + "\n")
    os.chdir(GOLDEN)
    write_photographs(Path("still"))
    assert cli.main(["fit", "still", "-o", "run", *QUICK]) == 0
    step = Trainer.step

    def stopped(self):
        if self.step_index == 12:
            raise KeyboardInterrupt
        return step(self)

    Trainer.step = stopped
    assert cli.main(["fit", "still", "-o", "stopped", *QUICK]) == 130
    assert cli.main(["fit", "still", "-o", "everything", *QUICK, *EVERYTHING]) == 130
    for run in (Path("run"), Path("stopped"), Path("everything")):
        shutil.rmtree(run / "renders")
        # Data beside the run, not where this checkout lies; the list of files knows them by their hashes.
        config, listed = run / "config.json", run / ".drgs.jsonl"
        before = hashlib.sha256(config.read_bytes()).hexdigest()
        config.write_text(config.read_text().replace(str(GOLDEN / "still"), "still"))
        listed.write_text(listed.read_text().replace(before, hashlib.sha256(config.read_bytes()).hexdigest()))


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    make()
