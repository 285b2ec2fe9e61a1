"""Claims of drgs.fitting.resume: a run is never lost, to a second fit, a damaged file, or what messages say."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
from test_train import config, dataset  # noqa: F401 (a fixture)

import drgs
from drgs import cli
from drgs.files import Run, load_state, save_ply, save_state
from drgs.fitting.records import load_run
from drgs.fitting.resume import PREVIOUS, run_files
from drgs.io import locks
from drgs.train import Trainer, fit


@pytest.fixture(scope="module")
def made(dataset, tmp_path_factory):  # noqa: F811
    """A finished run with a checkpoint before its last one."""
    folder = tmp_path_factory.mktemp("made") / "run"
    fit(dataset, folder, config(max_steps=6, save_every=3), progress=False)
    return folder


@pytest.fixture
def run(made, tmp_path):
    shutil.copytree(made, tmp_path / "run")
    return Run(tmp_path / "run")


def again(dataset, path, **fields):  # noqa: F811
    return fit(dataset, path, config(**{"max_steps": 6, "save_every": 3, **fields}), resume=True, progress=False)


def contents(folder) -> dict:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_two_fits_in_one_folder(dataset, run, capsys):  # noqa: F811
    """The second one is refused before it loads anything, whatever writes there; then it goes on."""
    owner = {**locks._this_process(), "pid": os.getppid(), "started": locks._started(os.getppid())}
    (run.path / locks.NAME).write_text(json.dumps({**owner, "command": "fit", "since": "today"}))
    before = contents(run.path)
    for line in (f"fit /nowhere -o {run.path} --resume", f"eval {run.path}", f"fit /nowhere -o {run.path}"):
        assert cli.main(line.split()) == 2
        error = capsys.readouterr().err
        assert f"`drgs fit` (process {os.getppid()} on " in error
        assert error.count("\n") == 1
    assert contents(run.path) == before
    (run.path / locks.NAME).unlink()
    again(dataset, run.path)
    assert not (run.path / locks.NAME).exists()


@pytest.mark.same_bits
def test_terminated_fit_saves_and_goes_on_with_the_same_bits(
    dataset,  # noqa: F811
    tmp_path,
    monkeypatch,
    capsys,
    two_threads,
):
    """SIGTERM during step 4 of 8: exit code 143, one line, a checkpoint, and the same end as without."""
    step = Trainer.step
    options = "--max-steps 8 --deterministic --sh-degree 1 --max-gaussians 80 --quiet"
    monkeypatch.setattr("drgs.data.load", lambda *_, **__: dataset)

    def terminated(self):
        if self.step_index == 4:
            signal.raise_signal(signal.SIGTERM)
        return step(self)

    assert cli.main(f"fit data -o {tmp_path / 'a'} {options}".split()) == 0
    monkeypatch.setattr(Trainer, "step", terminated)
    capsys.readouterr()
    assert cli.main(f"fit data -o {tmp_path / 'b'} {options}".split()) == 143
    assert capsys.readouterr().err == "drgs fit: terminated: saved at step 5, --resume continues\n"
    monkeypatch.setattr(Trainer, "step", step)
    assert load_state(tmp_path / "b" / "state.safetensors")[1]["step"] == 5
    assert cli.main(f"fit data -o {tmp_path / 'b'} {options} --resume".split()) == 0
    assert (tmp_path / "a" / "point_cloud.ply").read_bytes() == (tmp_path / "b" / "point_cloud.ply").read_bytes()
    assert not [p for p in (tmp_path / "b").rglob(".drgs*") if p.name != ".drgs.jsonl"]


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"x" * 99])
def test_damaged_checkpoint(dataset, run, caplog, damage):  # noqa: F811
    """The one before it is taken, the damaged one kept under another name; it ends where it would have."""
    data = damage(run.state.read_bytes())
    run.state.write_bytes(data)
    assert again(dataset, run.path).metrics["step"] == 6
    assert "must be a checkpoint" in caplog.text
    assert "resuming from the one before it, step 3" in caplog.text
    assert (run.path / "state.damaged.safetensors").read_bytes() == data
    assert load_state(run.state)[1]["step"] == 6
    again(dataset, run.path)


def test_no_checkpoint_that_can_be_read(dataset, run, tmp_path, monkeypatch, capsys):  # noqa: F811
    """The advice is one that works and keeps what there is, another folder, and not --resume without --resume."""
    monkeypatch.setattr("drgs.data.load", lambda *_, **__: dataset)
    for name in ("state.safetensors", PREVIOUS):
        (run.path / name).write_bytes(b"damaged")
    before = contents(run.path)
    line = ["fit", "data", "--max-steps", "2", "--quiet", "-o"]
    assert cli.main([*line, str(run.path), "--resume"]) == 2
    error = capsys.readouterr().err
    assert "fit into another run folder (-o), this one keeps its point_cloud.ply and log.jsonl" in error
    assert error.count("\n") == 1
    assert cli.main([*line, str(run.path)]) == 2
    assert "add --resume or choose another" in capsys.readouterr().err
    assert contents(run.path) == before
    assert cli.main([*line, str(tmp_path / "new")]) == 0


def test_finished_run_without_its_checkpoint_is_not_fitted_over(dataset, run):  # noqa: F811
    """Who deletes the large file to save space and resumes by mistake keeps the Gaussians."""
    run.state.unlink()
    (run.path / PREVIOUS).unlink()
    before = contents(run.path)
    with pytest.raises(ValueError, match="must hold a checkpoint to go on from, holds none; choose another run folder"):
        again(dataset, run.path)
    assert contents(run.path) == before


def test_checkpoint_of_a_backup(dataset, run):  # noqa: F811
    """An older checkpoint, put back by hand, is gone on from."""
    shutil.copy(run.path / PREVIOUS, run.state)
    (run.path / PREVIOUS).unlink()
    assert again(dataset, run.path).metrics["step"] == 6


@pytest.mark.parametrize("through_link", [False, True])
def test_folder_by_any_path(dataset, run, monkeypatch, tmp_path, through_link):  # noqa: F811
    """A run is gone on with by a path from the working directory, and by one through a link."""
    (tmp_path / "link").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert (run.path / PREVIOUS).is_file()
    assert again(dataset, Path("link/run" if through_link else "run")).metrics["step"] == 6


def test_edited_gaussians_stay(dataset, run):  # noqa: F811
    """A PLY that was cleaned by hand in the run folder is not replaced by resuming; moved away, resuming works."""
    g = drgs.load_ply(run.point_cloud)
    save_ply(g.replace(**{name: x[:10] for name, x in g.parameters().items()}), run.point_cloud)
    with pytest.raises(ValueError, match="point_cloud.ply: must not be replaced.*move it away or choose another"):
        again(dataset, run.path)
    assert len(drgs.load_ply(run.point_cloud)) == 10
    run.point_cloud.rename(run.path / "cleaned.ply")
    again(dataset, run.path)
    assert len(drgs.load_ply(run.point_cloud)) == len(g)


@pytest.mark.parametrize("name", [*run_files(), "renders/preview_000003.png", "renders/test/0.png"])
def test_files_of_others_stay(dataset, tmp_path, name):  # noqa: F811
    """Each name that a fit writes, in a folder that is no run, is refused before the first step."""
    file = tmp_path / "run" / name
    file.parent.mkdir(parents=True)
    file.write_text('{"mine": 1}')
    for resume in (False, True):
        with pytest.raises(ValueError, match=r"must not be replaced|must be a checkpoint, got"):
            fit(dataset, tmp_path / "run", config(max_steps=30), resume=resume, progress=False)
        assert file.read_text() == '{"mine": 1}'
        assert [p.name for p in (tmp_path / "run").rglob("*") if p.is_file()] == [file.name]


@pytest.mark.parametrize("name", ["config.json", "selection.json"])
def test_damaged_json_can_be_moved_away(dataset, run, name):  # noqa: F811
    """What the message advises works, and leads nowhere else."""
    (run.path / name).write_text("{")
    with pytest.raises(ValueError, match=f"{name}: must not be replaced.*move it away"):
        again(dataset, run.path)
    (run.path / name).rename(run.path / "away")
    assert again(dataset, run.path).metrics["step"] == 6


def test_copy_without_hidden_files(dataset, run):  # noqa: F811
    """Goes on: config.json says that the folder is a fit's."""
    (run.path / ".drgs.jsonl").unlink()
    again(dataset, run.path)
    again(dataset, run.path)


def test_outputs_are_checked_first(tmp_path, monkeypatch, capsys):
    """A file, or a folder that cannot be made, as -o: found out before anything is loaded, by every command."""
    (tmp_path / "file").write_text("mine")
    readers = (
        "commands.scene_input.SceneInput.at",
        "data.load",
        "commands.stress.rows",
        "files.load_ply",
    )
    for name in (f"drgs.{reader}" for reader in readers):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("loaded"))
    out = tmp_path / "file" / "x.json"
    for line in (
        "fit d -o {f}",
        "fit d -o {x}",
        "render s.ply -o {f}",
        "select s.ply --candidates orbit -o {x}",
        "fisher s.ply --train d -o {f}",
        "crossval s.ply -o {f}",
        "crossval s.ply --export {x}.npz",
        "crossval s.ply --export {f}",
        "tradeoff s.ply -o {x}",
        "stress --match 1 -o {f}",
        f"sfm {tmp_path} -o {{f}}",
        "demo -o {x}",
    ):
        assert cli.main(line.format(f=tmp_path / "file", x=out).split()) == 2, line
        error = capsys.readouterr().err
        assert str(tmp_path) in error
        assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_no_command_mixes_its_files_into_a_run(run, monkeypatch, capsys):  # noqa: F811
    """A run folder as -o is refused before anything is loaded; a single picture may be put there."""
    monkeypatch.setattr("drgs.commands.scene_input.SceneInput.at", lambda *_: pytest.fail("loaded"))
    before = sorted(run.path.iterdir())
    for line in ("fisher", "query --class wall", "crossval", "tradeoff", "render"):
        command, *options = line.split()
        assert cli.main([command, str(run.path), *options, "-o", str(run.path)]) == 2
        told = f"drgs {command}: {run.path}: -o must be another folder than that of a run, with whose files"
        assert capsys.readouterr().err.startswith(told)
    assert sorted(run.path.iterdir()) == before
    with pytest.raises(pytest.fail.Exception, match="loaded"):
        cli.main(["render", str(run.path), "--view", "a", "-o", str(run.path / "a.png")])


@pytest.mark.same_bits
@pytest.mark.parametrize("options", ["", "--views active --policy random --add 1 --every 2"], ids=["all", "active"])
def test_two_fits_leave_the_same_checkpoint(dataset, tmp_path, monkeypatch, capsys, two_threads, options):  # noqa: F811
    """Byte for byte: what the clock says is in the log, from where a resumed fit and `load_run` have it."""
    monkeypatch.setattr("drgs.data.load", lambda *_, **__: dataset)
    fixed = "--max-steps 6 --save-every 3 --deterministic --sh-degree 1 --max-gaussians 80 --no-report --quiet"
    for name in ("a", "b"):
        assert cli.main(f"fit data -o {tmp_path / name} {fixed} {options}".split()) == 0
    files = [(tmp_path / name / "state.safetensors").read_bytes() for name in ("a", "b")]
    assert files[0] == files[1]
    run = Run(tmp_path / "a")
    seconds = load_run(run).seconds
    logged = [event for event in run.events() if event["event"] == "checkpoint"]
    assert seconds == logged[-1]["seconds"] > 0
    # It goes on from there, and its picks still know what they took.
    assert cli.main(f"fit data -o {run.path} {fixed} {options} --resume".split()) == 0
    assert json.loads((run.path / "metrics.json").read_text())["seconds"] == seconds
    if options:
        picks = json.loads((run.path / "selection.json").read_text())["picks"]
        assert [pick["seconds"] for pick in picks] == [e["seconds"] for e in run.events() if e["event"] == "pick"]
        assert picks[0]["seconds"] > 0


def test_a_checkpoint_of_an_older_version_says_its_time_itself(dataset, run):  # noqa: F811
    """It is believed, and a log that cannot be read is no reason to refuse a run."""
    tensors, header = load_state(run.state)
    (run.path / "log.jsonl").write_text("no JSON\n")
    assert load_run(run).seconds is None
    save_state(run.state, tensors, {name: x for name, x in header.items() if name != "schema"} | {"seconds": 12.5})
    assert load_run(run).seconds == 12.5
