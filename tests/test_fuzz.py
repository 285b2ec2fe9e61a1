"""Readers under damaged files: a few hundred of the millions of inputs that benchmarks/fuzz.py reads, every time."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from random import Random

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

import fuzz
from fuzz_formats import mutate
from fuzz_targets import TARGETS, Bench, Target, fault_of
from test_report import active  # noqa: F401 (a fixture)

from drgs.cameras import orbit
from drgs.files import load_state, save_state
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame
from drgs.fitting.records import check_checkpoint
from drgs.fitting.rows import GaussianRows
from drgs.fitting.trainer import Trainer

EXAMPLES = {"videos": 25, "masks, depths, labels": 60, "COLMAP text": 100, "COLMAP binary": 100}
EXAMPLES |= dict.fromkeys(("classes", "train_meta.json", "poses_bounds.npy", "transforms.json"), 100)
"""Of readers that take more than a few milliseconds; of others 200."""
pytestmark = pytest.mark.filterwarnings("ignore:Duplicate name")  # of archives that have a part twice


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A reader's files, made once."""
    made: dict[str, Bench] = {}

    def of(name: str, seeds: list[Path] | None = None) -> Bench:
        if name not in made:
            made[name] = Bench(TARGETS[name], tmp_path_factory.mktemp("fuzz"), seeds)
            made[name].check()
        return made[name]

    return of


def hold(bench: Bench, examples: int) -> None:
    """Whatever is damaged, a reader returns or raises one line that names the file."""

    @settings(max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=HealthCheck)
    @given(number=st.integers(0, 2**31))
    def check(number):
        folder, path, _ = bench.place(number)
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # a value that overflows in NumPy should be refused
            _, fault, error = bench.read(folder)
        assert fault is None, f"input {number}, {path.name}: {fault}: {error!r}"

    check()


@pytest.mark.parametrize("name", [name for name in TARGETS if name != "run folders"])
def test_a_reader_under_damage(bench, name, caplog):
    """Every reader, on files that are damaged by bytes and by what their format is made of."""
    hold(bench(name), EXAMPLES.get(name, 200))


def test_run_folders_under_damage(bench, active, caplog):  # noqa: F811
    """The same of a run folder, of a fit in which views were chosen."""
    hold(bench("run folders", [active]), 150)


def test_a_checkpoint_to_resume_under_damage(tmp_path):
    """What `--resume` reads, beyond what other readers of a run do: moments of the optimizer, the order of views."""
    cameras = orbit((0, 0, 0), 3.0, 3, width=8, height=6)
    frames = [Frame(f"v{i}", camera, torch.zeros(6, 8, 3)) for i, camera in enumerate(cameras)]
    config = FitConfig(max_steps=50)
    trainer = Trainer(config, frames, GaussianRows.from_points(torch.rand(9, 3), torch.rand(9, 3)), 1.0)
    trainer.step()
    tensors, header = trainer.state()
    header |= {"seconds": 1.0, "point_source": "x"}
    path = tmp_path / "state.safetensors"
    save_state(path, tensors, header)
    whole, draw = path.read_bytes(), Random(7)

    def read():
        loaded, head = load_state(path)
        check_checkpoint(path, loaded, head)
        Trainer.from_state(config, frames, loaded, head, str(path))

    def with_another_tensor() -> None:
        name = draw.choice(sorted(tensors))
        x = tensors[name].detach()
        others = [torch.zeros(0), torch.zeros(3, 3), x.reshape(-1)[:5].clone(), torch.zeros_like(x, dtype=torch.int32)]
        changed = tensors | {name: draw.choice(others)}
        if draw.random() < 0.3:
            del changed[name]
        save_state(path, changed, header)

    read()
    faults, refused = {}, 0
    for number in range(200):
        if number % 4:
            path.write_bytes(mutate(whole, path.suffix, Random(number), [whole]))
        else:
            with_another_tensor()
        try:
            read()
        except Exception as error:  # noqa: BLE001 (any kind of it is what is looked for)
            refused += 1
            if fault := fault_of(error, tmp_path):
                faults[number] = fault, error
    assert not faults
    assert refused > 100


def test_inputs_are_damaged_and_then_restored(bench):
    """Nearly every input differs from the valid file, and no two files are damaged at once."""
    it = bench("COLMAP text")
    differ = 0
    for number in range(50):
        folder, path, data = it.place(number)
        held = {p: d for _, p, d in it.files}
        differ += data != held[path]
        assert path.read_bytes() == data
        assert all(p.read_bytes() == held[p] for p in held if p != path)
    assert differ >= 45


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (ValueError("/d/a.ply: must be a PLY, got none; copy it"), None),
        (FileNotFoundError("/d/a.ply: must be there; copy it"), None),
        (KeyError("/d/a.ply"), "KeyError instead of ValueError"),
        (UnicodeDecodeError("utf-8", b"/d", 0, 1, "x"), "UnicodeDecodeError instead of ValueError"),
        (MemoryError(), "MemoryError instead of ValueError"),
        (ValueError("/d/a.ply: must\nbe"), "a message that is not one line"),
        (ValueError("must be a PLY"), "a message that does not name the file"),
    ],
)
def test_what_counts_as_a_fault(error, fault):
    """One line that names the file, of the few kinds that commands answer with exit code 2."""
    assert fault_of(error, Path("/d")) == fault


WORKER = """
import mmap, os, sys
sys.path[:0] = [{benchmarks!r}]
import fuzz_targets, fuzz_worker

CALLS = []

def read(folder):
    CALLS.append(folder)
    if len(CALLS) == 1:  # the valid file
        return
    number = int(sys.argv[2]) + len(CALLS) - 2
    if number == 0:
        raise KeyError(str(folder))
    if number == 1:
        mmap.mmap(-1, 3 << 29).close()  # not touched
    if number == 2:
        os.abort()

write = lambda folder: (folder / "a.txt").write_bytes(b"1 2 3")
fuzz_targets.TARGETS["bad"] = fuzz_targets.Target("bad", (write,), ("a.txt",), read)
fuzz_worker.main()
"""


def test_what_a_bad_reader_does_is_found(tmp_path, monkeypatch, capsys):
    """A wrong exception, memory beyond all measure and a crash, in a real process, each with the file that did it; the
    count goes on behind them.
    """
    (tmp_path / "worker.py").write_text(WORKER.format(benchmarks=str(Path(fuzz.__file__).parent)))
    monkeypatch.setattr(fuzz, "WORKER", tmp_path / "worker.py")
    monkeypatch.setattr(fuzz, "FINDINGS", tmp_path / "findings")
    row: dict = {}
    fuzz.Reader("bad", row).go_on(6, 120)
    assert (row["inputs"], row["findings"], row["crashes"], row["hangs"]) == (6, 2, 1, 0)
    assert row["ends"] == {"read": 3}  # of the process that crashed, what it had not told is lost
    kept = tmp_path / "findings" / "bad"
    told = [(kept / f"{number}.log").read_text() for number in range(3)]
    assert "KeyError instead of ValueError" in told[0]
    assert "asks for 1.5 GiB for" in told[1]
    assert "crash (-6)" in told[2]
    assert "Fatal Python error: Aborted" in told[2]
    bad = Target("bad", (lambda folder: (folder / "a.txt").write_bytes(b"1 2 3"),), ("a.txt",), lambda _: None)
    bench = Bench(bad, tmp_path / "again")
    for number in range(3):
        assert (kept / f"{number}.txt").read_bytes() == bench.place(number)[2]
