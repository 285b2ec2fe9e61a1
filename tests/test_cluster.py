"""Workers: real processes, which find the same bits, however many they are and whichever of them is killed."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("distributed", reason="needs pip install 'drgs[cluster]'")

from scenes_random import camera, gaussians
from test_active import write_still
from test_network_information import swarm

from drgs import cli
from drgs.cameras import orbit
from drgs.cluster import connect, payloads
from drgs.cluster.agreement import Disagreement, check_agreement, statement
from drgs.cluster.cells import run_cells_on
from drgs.cluster.connect import opened
from drgs.cluster.options import check_address
from drgs.cluster.payloads import Missing, Payload, keep, opened_payload
from drgs.data.camera_lists import save_cameras_json
from drgs.files import save_ply
from drgs.fitting.config import FitConfig
from drgs.information.scoring import Scoring
from drgs.information.semantics import SemanticMetric
from drgs.select import Cache, select
from drgs.settings import RenderSettings
from drgs.studies.cells import Metric, Study, run_cell
from drgs.studies.rows import Cell, cell_of, read_study

ROOT = Path(__file__).resolve().parents[1]
FAST = RenderSettings.preset("fast")
LIMIT = 300  # seconds of a test, on a machine that does other things, too


@pytest.fixture(autouse=True)
def _limit():
    """Nothing hangs: a test that takes too long fails."""

    def late(*_):
        pytest.fail(f"took longer than {LIMIT} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def cluster():
    """One worker at first; tests ask for more."""
    with opened(workers=1) as found:
        yield found


def scaled(cluster, count: int):
    """The cluster with so many workers or more."""
    if len(cluster.workers()) < count:
        cluster._local.scale(count)
        cluster.client.wait_for_workers(count, timeout=100)
    return cluster


@pytest.fixture(scope="module")
def moving():
    """A scene with features that moves, one that stands still, and seven small views."""
    rng = np.random.default_rng(4)
    still = gaussians(rng, 12, 1).detach()
    still = still.replace(features=torch.from_numpy(rng.normal(size=(12, 3)).astype(np.float32)))
    found = []
    for number in range(7):
        cam = camera(rng, (16, 16))
        found.append(dataclasses.replace(cam, time=number / 6, name=f"v{number}", w2c=cam.w2c.detach()))
    return swarm(still), still, found


def same(one, other) -> None:
    """Two selections are of the same bits, but for the seconds."""
    a, b = ({**dataclasses.asdict(x), "seconds": 0} for x in (one, other))
    assert a == b


CASES = {
    "v_opt": ({}, {"k": 3}),
    "not lazy": ({"criterion": "eig", "blocks": ("geometry",)}, {"k": 3, "lazy": False}),
    "lazy": ({"criterion": "eig", "blocks": ("geometry",)}, {"k": 3, "lazy": True}),
    "semantic": ({"criterion": "logdet", "blocks": ("geometry", "semantic")}, {}),
    "blocks": ({"criterion": "block_logdet"}, {}),
    "fisherrf": ({}, {"policy": "fisherrf"}),
    "coverage": ({}, {"policy": "coverage"}),
    "moments": ({}, {"policy": "moments", "k": 2}),
}


def run_case(name, still, views, workers=None, **more):
    scoring, others = CASES[name]
    weights = torch.arange(15.0, dtype=torch.float64).reshape(5, 3).sin()
    semantics = SemanticMetric(weights.T @ weights)
    fields = {"k": 1, "policy": "fisher", **others, **more}
    mask = torch.ones(views[1].height, views[1].width)
    mask[:, :5] = 0.25
    scored = Scoring(settings=FAST, semantics=semantics, **scoring)
    masks = [None, mask] if fields["policy"] != "moments" else None
    return select(still, views[2:], views[:2], scoring=scored, masks=masks, workers=workers, **fields)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.same_bits
def test_one_worker_finds_the_bits_of_none(cluster, moving, name):
    """Every policy that asks for information: picks, margins, scores, parts and notes are those of this process."""
    _, still, cams = moving
    same(run_case(name, still, cams, cluster), run_case(name, still, cams))


def test_a_deformation_and_z_scores(cluster, moving):
    """A scene that moves travels with its network; a trace beside another block is asked of candidates only."""
    scene, _, cams = moving

    def run(**fields):
        blocks = ("geometry", "deformation")
        return select(scene, cams[1:4], cams[:1], 1, settings=FAST, probes=2, blocks=blocks, **fields)

    for fields in ({"criterion": "eig"}, {"network": "trace"}):
        same(run(workers=cluster, **fields), run(**fields))


@pytest.mark.parametrize("count", [2, 3])
def test_more_workers_find_the_same(cluster, moving, count):
    """Two and three processes; those that have just started have not got the scene yet, and are sent it."""
    _, still, cams = moving
    scaled(cluster, count).views.clear()
    most = []
    for name in ("v_opt", "blocks"):
        watch = lambda *_: most.append(len(cluster.client.futures))  # noqa: E731
        same(run_case(name, still, cams, cluster, progress=watch), run_case(name, still, cams))
    assert len(cluster.views) == count, "all of them worked"
    assert max(most) <= 2 * count, "no more views are on their way than two for each worker"


def test_a_cache_asks_workers_for_what_it_lacks(cluster, moving):
    """Views that it holds are not computed again, and a view that comes twice is computed once."""
    _, still, cams = moving
    cache, cluster_cache = Cache(), Cache()
    for train in (cams[:2], cams[:3], [*cams[:2], cams[4]]):
        fields = {"criterion": "eig", "settings": FAST, "blocks": ("geometry",)}
        one = select(still, [cams[3], cams[3], cams[5]], train, cache=cache, **fields)
        same(one, select(still, [cams[3], cams[3], cams[5]], train, cache=cluster_cache, workers=cluster, **fields))
    assert (cache.hits, cache.misses) == (cluster_cache.hits, cluster_cache.misses)


@pytest.mark.parametrize("size", [0, 20_000])
def test_a_cache_that_is_too_small_asks_workers_again(cluster, moving, size):
    """What it had when a call began may be pushed out before its turn: each view still gets its own answer."""
    _, still, cams = moving
    cache = Cache(max_bytes=size)
    for order in ([0, 1, 2, 3, 4], [4, 2, 2, 0, 3], [3, 1, 0, 4, 2]):
        views = [cams[2 + i] for i in order]
        found = select(still, views, cams[:2], settings=FAST, cache=cache, workers=cluster)
        alone = select(still, views, cams[:2], settings=FAST)
        assert (found.scores, found.parts) == (alone.scores, alone.parts)
        assert cache.bytes <= size
    assert (cache.hits > 5) == (size > 0)


def test_memory_that_is_short_asks_twice(cluster, moving, monkeypatch):
    """Where not all views fit into memory at once, v_opt asks for candidates again, of workers as of this process."""
    from drgs.selection import greedy

    monkeypatch.setattr(greedy, "_fits", lambda *_: False)
    _, still, cams = moving
    before = sum(cluster.views.values())
    fields = {"settings": FAST, "blocks": ("geometry",)}
    found = select(still, cams[2:], cams[:2], workers=cluster, **fields)
    assert sum(cluster.views.values()) - before == 2 + 5 + 5
    same(found, select(still, cams[2:], cams[:2], **fields))


def test_an_error_of_a_worker_is_that_of_this_process(cluster, moving):
    """One line, of the same kind and with the same words."""
    _, still, cams = moving
    broken = still.replace(means=still.means * float("nan"))
    said = []
    for workers in (None, cluster):
        with pytest.raises(ValueError, match="must be finite") as error:
            select(broken, cams[2:], cams[:2], settings=FAST, blocks=("geometry",), workers=workers)
        said.append(str(error.value))
    assert said[0] == said[1]
    with pytest.raises(ValueError, match="workers must be None with information, got both"):
        select(still, cams[2:], cams[:2], information=lambda camera: {}, workers=cluster)


def test_a_killed_worker_costs_its_views(cluster, moving, monkeypatch):
    """SIGKILL in the middle: what it was computing is computed by another one, and nothing else changes."""
    _, still, cams = moving
    scaled(cluster, 2)
    cams = [*cams, *(dataclasses.replace(cam, name=f"again {cam.name}") for cam in cams)]
    slow, hers, killed = _Slow(0.3), {}, []

    told, really = [], cluster.result

    def result(future, what):
        said = really(future, what)
        told.append((future.key, said["address"]))
        if len(told) == 3:
            processing = cluster.client.processing()
            address = next(one for one, keys in processing.items() if keys)
            hers[address] = set(processing[address])
            nanny = next(n for n in cluster._local.workers.values() if n.worker_address == address)
            killed.append(nanny.pid)
            os.kill(nanny.pid, signal.SIGKILL)
        return said

    monkeypatch.setattr(cluster, "result", result)
    answers = list(cluster.each(still, FAST, [(slow, cam, None) for cam in cams]))
    assert [float(answer["which"]) for answer in answers] == [slow.number(cam) for cam in cams]
    (address, keys), (pid,) = *hers.items(), killed
    assert not _runs(pid)
    redone = [by for key, by in told if key in keys]
    assert redone, "it had views"
    assert address not in redone, "others did them"
    monkeypatch.undo()
    same(run_case("v_opt", still, cams, cluster), run_case("v_opt", still, cams))


@dataclasses.dataclass
class _Slow:
    """A quantity that takes its time."""

    seconds: float

    @staticmethod
    def number(cam) -> float:
        return float(np.asarray(cam.w2c).sum())

    def compute(self, view):
        time.sleep(self.seconds)
        return {"which": torch.tensor(self.number(view.camera), dtype=torch.float64)}


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


# ---- payloads


def test_payloads_bring_closures_and_tensors():
    """Functions without a name, parameters of networks, and what shares memory with nothing; the same bits."""
    x = torch.randn(4, 3, dtype=torch.float64).T  # not contiguous
    network = torch.nn.Linear(2, 2)
    factor = 3
    payload = Payload.of({"f": lambda y: y * factor, "x": x, "network": network, "empty": torch.zeros(0, 3)})
    for piece in payload.pieces():
        keep(*piece)
    found = opened_payload(payload.digest)
    assert found is opened_payload(payload.digest)
    assert found["f"](2) == 6
    assert torch.equal(found["x"], x)
    assert found["empty"].shape == (0, 3)
    weight = found["network"].weight
    assert isinstance(weight, torch.nn.Parameter)
    assert weight.requires_grad
    assert torch.equal(weight, network.weight)
    assert Payload.of(x).digest == Payload.of(x.clone()).digest
    with pytest.raises(ValueError, match="cluster: what is sent to workers must be picklable, dict is not"):
        Payload.of({"lock": threading.Lock()})


def test_a_worker_keeps_the_last_few(monkeypatch):
    """Payloads come in pieces, in any order; those that were not used for longest make room, and are missing then."""
    monkeypatch.setattr(payloads, "_PIECE_BYTES", 10)
    made = [Payload.of(f"payload {i}") for i in range(payloads._MAX_PAYLOADS + 1)]
    assert len(made[0].pieces()) > 1
    for i, payload in enumerate(made):
        for piece in reversed(payload.pieces()):
            with pytest.raises(Missing, match=payload.digest):
                opened_payload(payload.digest)
            keep(*piece)
        assert opened_payload(payload.digest) == f"payload {i}"
    with pytest.raises(Missing):
        opened_payload(made[0].digest)
    assert opened_payload(made[1].digest) == "payload 1"


# ---- who may take part


def test_addresses():
    """HOST:PORT, also as Dask writes it."""
    assert check_address("node7:8786") == check_address("tcp://node7:8786") == "tcp://node7:8786"
    assert check_address("[::1]:8786") == "tcp://[::1]:8786"
    for bad in ("node7", "node7:", ":8786", "node7:0", "node7:99999", "tls://node7:8786", "http://node7:80/x", ""):
        with pytest.raises(ValueError, match="--scheduler must be HOST:PORT, got '"):
            check_address(bad)


def test_what_must_agree_is_named():
    """Worker, what it has and what it must have; code that was installed from elsewhere is the same code."""
    ours = statement()["must"]
    assert ours["threads"] == "1"
    check_agreement("w", statement(), ours)
    other = {**ours, "drgs": re.sub(r"commit \S+,", "commit unknown,", ours["drgs"])}
    check_agreement("w", {"must": other}, ours)
    for name, value, line in (
        ("drgs", "0.1", r"worker w must have drgs .* \(commit .*, code \w{8}\), has 0\.1; install the same on both"),
        ("numpy", "1.9", r"must have numpy \d.*, has 1\.9; install numpy"),
        ("distributed", "2020.1", r"must have distributed 20.*, has 2020\.1; install"),
        ("variant", "cuda_ad_rgb", r"must have the variant llvm_ad_rgb, has cuda_ad_rgb; set DRGS_VARIANT"),
        ("threads", "4", r"must have threads of Dr\.Jit 1, has 4; start it with DRGS_THREADS=1"),
    ):
        with pytest.raises(Disagreement, match=line) as error:
            check_agreement("w", {"must": {**ours, name: value}}, ours)
        assert "\n" not in str(error.value)


def started(path: Path, *options: str, **environ: str) -> subprocess.Popen:
    """`dask worker`, as one starts it by hand, with a log of its own."""
    command = [sys.executable, "-m", "dask", "worker", *options, "--no-dashboard", "--local-directory", str(path)]
    with (path / "log").open("ab") as log:
        # Not from the checkout: `python -m` looks for modules in the working directory first.
        return subprocess.Popen(
            command, cwd=path, env={**os.environ, **environ}, stdout=log, stderr=log, start_new_session=True
        )


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler without workers: host and port."""
    from distributed import LocalCluster

    made = LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", host="127.0.0.1", silence_logs=logging.CRITICAL)
    yield made.scheduler_address.removeprefix("tcp://")
    made.close(timeout=10)


@pytest.mark.every(3)
@pytest.mark.parametrize("what", ["code", "threads", "tasks"])
def test_workers_of_another_kind_are_refused(scheduler, tmp_path, what):
    """Real ones, started by hand: of a copy of the package with one line changed, with two Dr.Jit threads, or with two
    threads for tasks.
    """
    environ, options, line = {"PYTHONPATH": str(ROOT)}, ["--nthreads", "1"], ""
    if what == "code":
        shutil.copytree(ROOT / "drgs", tmp_path / "drgs", ignore=shutil.ignore_patterns("__pycache__"))
        file = tmp_path / "drgs/__init__.py"
        file.write_text(re.sub(r'__version__ = "[^"]+"', '__version__ = "9.9.9"', file.read_text()))
        environ["PYTHONPATH"] = str(tmp_path)
        line = r"worker odd .*must have drgs .*, has 9\.9\.9 \(commit unknown, code \w+\); install the same on both"
    elif what == "threads":
        environ["DRGS_THREADS"] = "2"
        line = r"worker odd .*must have threads of Dr\.Jit 1, has 2; start it with DRGS_THREADS=1"
    else:
        options, line = (
            ["--nthreads", "2"],
            r"worker odd .*must do one task at a time, does 2; start it with --n",
        )
    process = started(tmp_path, scheduler, *options, "--name", "odd", "--no-nanny", **environ)
    try:
        with pytest.raises(Disagreement, match=line) as error, opened(scheduler):
            raise AssertionError("it was let in")
        assert "\n" not in str(error.value)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_nobody_there(tmp_path, monkeypatch, capsys):
    """A port that nobody listens at, and one that never answers: one line, exit code 2, in the seconds that it says."""
    monkeypatch.setattr(connect, "CONNECT_SECONDS", 2.0)
    save_ply(gaussians(np.random.default_rng(0), 5, 1).detach(), tmp_path / "scene.ply")
    save_cameras_json(tmp_path / "known.json", orbit((0, 0, 0), 3.0, 2, width=16, height=16))
    given = [
        str(tmp_path / "scene.ply"),
        "--candidates",
        "orbit",
        "--train",
        str(tmp_path / "known.json"),
        "--count",
        "2",
    ]
    with socket.socket() as silent, socket.socket() as closed:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        closed.bind(("127.0.0.1", 0))
        for port in (silent.getsockname()[1], closed.getsockname()[1]):
            began = time.monotonic()
            where = ["-o", str(tmp_path / "o.json"), "--scheduler", f"127.0.0.1:{port}"]
            assert cli.main(["select", *given, *where]) == 2
            assert time.monotonic() - began < 15
            said = capsys.readouterr().err
            line = rf"drgs select: cluster: a Dask scheduler must answer at 127\.0\.0\.1:{port}, none did in 2 s; .*\n"
            assert re.fullmatch(line, said)
    assert not (tmp_path / "o.json").exists()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--scheduler", "host"], "--scheduler must be HOST:PORT, got 'host'"),
        (["--workers", "0"], "--workers must be in [1, 1024], got 0"),
        (["--scheduler", "host:1", "--workers", "2"], "--scheduler must be without --workers, got both"),
    ],
)
def test_bad_options(tmp_path, capsys, options, line):
    """One line before anything is read, here of files that are not there."""
    for command in (["select", "no.ply", "--candidates", "orbit"], ["fit", "no", "-o", "r", "--views", "active"]):
        assert cli.main([*command, *options]) == 2
        said = capsys.readouterr().err
        assert line in said
        assert said.count("\n") == 1
    assert cli.main(["fit", "no", "-o", str(tmp_path / "r"), "--workers", "2"]) == 2
    assert "--scheduler and --workers must have --views active, got --views all" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", ["select no.ply --candidates orbit", "fit no -o r --views active", "reproduce static -o r"]
)
def test_without_dask(tmp_path, command):
    """One line that names the extra, before anything is loaded: torch alone takes seconds."""
    script = (
        "import sys\n"
        "sys.modules['dask'] = None  # as if it were not installed\n"
        "from drgs import cli\n"
        "code = cli.main(sys.argv[1:])\n"
        "print(code, 'torch' in sys.modules, 'drjit' in sys.modules)\n"
    )
    line = [sys.executable, "-c", script, *command.split(), "--workers", "2"]
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, env=environ, cwd=tmp_path, text=True, capture_output=True, timeout=LIMIT)
    name = command.split()[0]
    assert done.stderr == f"drgs {name}: cluster: dask must be installed, is not; pip install 'drgs[cluster]'\n"
    assert done.stdout == "2 False False\n"
    assert not [*tmp_path.iterdir()]


# ---- workers that do not start

_STARTS = "    with opened(workers=1) as c:\n        print('started', flush=True)\n"


@pytest.mark.every(4)
@pytest.mark.parametrize(
    ("what", "told"),
    [
        ("SIGKILL", "one was killed (SIGKILL), as systems do that have no memory left; "),
        ("SIGTERM", "one was ended by SIGTERM; look at what it printed before"),
        ("exit", "one ended with exit code 3; look at what it printed before"),
        ("unguarded", "each runs the script that starts it once more, which must do so below `if __name__ == "),
    ],
)
def test_a_worker_that_does_not_start(tmp_path, what, told):
    """Real processes that are killed, end, or run their parent's script as they start: one line says which it was."""
    end = {"exit": "os._exit(3)", "unguarded": "pass"}.get(what, f"os.kill(os.getpid(), signal.{what})")
    # Python runs this module in each process as it starts; workers are those that multiprocessing has spawned.
    (tmp_path / "sitecustomize.py").write_text(
        f"import os, signal, sys\nif any('spawn_main' in word for word in sys.orig_argv):\n    {end}\n"
    )
    guard = "if True:\n" if what == "unguarded" else "if __name__ == '__main__':\n"
    (tmp_path / "script.py").write_text(f"from drgs.cluster.connect import opened\n{guard}{_STARTS}")
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    line = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(line, env=environ, text=True, capture_output=True, timeout=LIMIT)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("Traceback") == 1, "of the script alone"
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ConnectionError: cluster: --workers 1 must all start, did not: {told}")
    assert ("__main__" in last) == (what == "unguarded")


# ---- commands


@pytest.fixture(scope="module")
def still_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cluster")
    save_ply(write_still(folder / "data"), folder / "scene.ply")
    return folder


def test_an_active_fit_and_a_selection_join_a_cluster(cluster, still_folder, tmp_path, monkeypatch, capsys):
    """`fit --views active --scheduler` picks what it picks by itself; `select --scheduler` ranks as `select` does."""
    monkeypatch.chdir(tmp_path)
    there = cluster.client.scheduler.address.removeprefix("tcp://")
    data, scores = str(still_folder / "data"), []
    fitting = "--views active --add 1 --every 2 --max-steps 4 --max-gaussians 60 --deterministic --no-report --quiet"
    for name, options in (("alone", []), ("joined", ["--scheduler", there])):
        assert cli.main(["fit", data, "-o", name, *fitting.split(), *options]) == 0, capsys.readouterr().err
        select_line = ["select", name, "--candidates", data, "-k", "2", "--quiet", "-o", f"{name}.json", *options]
        assert cli.main(select_line) == 0, capsys.readouterr().err
        chosen = json.loads((tmp_path / name / "selection.json").read_text())
        picks = [(pick["name"], pick["score"], pick["candidates"]) for pick in chosen["picks"]]
        ranked = json.loads((tmp_path / f"{name}.json").read_text())
        scores.append((picks, ranked["candidates"], [pick["margin"] for pick in ranked["picks"]]))
    assert scores[0] == scores[1]
    assert capsys.readouterr().err == ""


# ---- cells


def folder_of(folder: Path, scene: str, split: tuple[int, int]) -> Path:
    return folder


def study_of(folder: Path, **fields) -> Study:
    """Three policies, many short steps."""
    few = {"initial": 2, "add": 1, "every": 3}
    return Study(
        name="tiny",
        folder=functools.partial(folder_of, folder),
        policies={name: {"policy": name} for name in ("farthest", "random", "uniform")},
        fit=FitConfig().replace(
            **{
                "renderers": ("fast",),
                "max_steps": 12,
                "max_gaussians": 60,
                "sh_degree": 1,
                "save_every": 4,
                **few,
                **fields,
            }
        ),
        metrics=(Metric("psnr", "PSNR", 2),),
        reference="random",
    )


@pytest.mark.slow
@pytest.mark.same_bits
def test_a_killed_worker_costs_the_steps_since_its_checkpoint(cluster, still_folder, tmp_path):
    """Three cells on two workers, one of which is killed once it has written a checkpoint: all rows come, the cell goes
    on where it was, and ends with the numbers of a cell that nobody disturbed.
    """
    scaled(cluster, 2)
    study = study_of(still_folder / "data", max_steps=24)
    cells = study.cells([("still", (4, 1), "first", "blind", 0)])
    run = tmp_path / "runs" / study.name / cells[0].name
    said, killed = [], []

    def kill():
        """The worker that has the first cell, as soon as there is a checkpoint."""
        while not (run / "state.safetensors").is_file():
            time.sleep(0.01)
        pid = json.loads((run / ".drgs.lock").read_text())["pid"]
        os.kill(pid, signal.SIGKILL)
        killed.append(pid)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    rows = tmp_path / "rows.jsonl"
    assert run_cells_on(cluster, study, cells, tmp_path / "runs", rows, said.append) == ([], {})
    killer.join(1)
    assert killed
    assert killed[0] != os.getpid()
    found = {cell_of(row)[1]: row for row in read_study(rows)}
    assert set(found) == set(cells)
    events = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [event["step"] > 0 for event in events if event["event"] == "resume"] == [True]
    alone = run_cell(study, cells[0], tmp_path / "alone")
    assert found[cells[0]]["metrics"] == alone["metrics"]
    assert found[cells[0]]["picks"] == alone["picks"]
    begun = [line for line in said if re.fullmatch(rf"1 of 3: {re.escape(cells[0].name)} on worker .*", line)]
    assert len(begun) == 2
    assert ", again: " in begun[1]
    assert sum(", worker " in line and "PSNR" in line for line in said) == 3
    again: list[str] = []
    assert run_cells_on(cluster, study, cells, tmp_path / "runs", rows, again.append) == ([], {})
    assert again == []
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == [study.name], "nothing is left over"


def test_cells_that_fail_or_are_taken(cluster, still_folder, tmp_path, monkeypatch):
    """A closure names the data set; one cell's data is missing, one finds no memory left, and one is being written by
    this process.
    """
    from drgs.files import Run
    from drgs.fitting.resume import lock_run

    place = still_folder / "data"
    study = study_of(place)

    def folder(scene, split):
        if scene == "huge":
            raise MemoryError("huge: there must be more memory")
        return place if scene == "still" else place / scene

    study = dataclasses.replace(study, folder=folder)
    cells = [Cell(scene, (4, 1), "first", "random", "blind", 0) for scene in ("gone", "still", "huge")]
    said: list[str] = []
    with lock_run(Run(tmp_path / study.name / cells[1].name), "fit", resume=True):
        taken, failed = run_cells_on(cluster, study, cells, tmp_path, tmp_path / "rows.jsonl", said.append)
    assert (taken, set(failed)) == ([cells[1]], {cells[0], cells[2]})
    assert failed[cells[2]] == "huge: there must be more memory"
    assert "gone" in failed[cells[0]]
    assert any(line.startswith(f"{cells[0].name}: failed: ") and "gone" in line for line in said)
    assert any(f"process {os.getpid()} on " in line for line in said)
    monkeypatch.setattr("drgs.cluster.cells.sees", _sees_nothing)
    with pytest.raises(ValueError, match=r"cluster: worker .* must see the folder of the runs, .*; put it on a file"):
        run_cells_on(cluster, study, cells, tmp_path, tmp_path / "rows.jsonl", said.append)


@pytest.mark.slow
def test_a_cell_is_not_bound_to_workers_that_end(cluster, still_folder, tmp_path, monkeypatch):
    """The lock of a cell names another machine, whose only worker ends before it takes the cell: another worker has it
    then, and says that it is taken.
    """
    study = study_of(still_folder / "data")
    cell = study.cells([("still", (4, 1), "first", "blind", 0)])[0]
    lock = tmp_path / study.name / cell.name / ".drgs.lock"
    lock.parent.mkdir(parents=True)
    lock.write_text(json.dumps({"pid": 1, "host": "elsewhere", "command": "fit", "since": "today"}))
    near = iter([["tcp://127.0.0.1:9"], []])
    monkeypatch.setattr(cluster, "workers_of", lambda host: next(near))
    said: list[str] = []
    assert run_cells_on(cluster, study, [cell], tmp_path, tmp_path / "rows.jsonl", said.append) == ([cell], {})
    begun = [line for line in said if " on worker " in line]
    assert len(begun) == 2
    assert begun[1].endswith(", again"), "and not that somebody who is there has gone"


def _sees_nothing(token: str) -> bool:
    return False


# ---- the end


@pytest.mark.slow
def test_workers_end_with_their_client():
    """However it ends: by itself, while a worker that has died is started anew, by Ctrl-C in the middle of a task, or
    killed. Dask says nothing of its own.
    """
    script = (
        "import os, sys, time\n"
        "from drgs.cluster.connect import opened\n"
        "if __name__ == '__main__':\n"
        "    with opened(workers=1) as c:\n"
        "        print(*c.client.run(os.getpid).values(), flush=True)\n"
        "        if sys.argv[1] == 'ends anew':\n"
        "            (nanny,) = c._local.workers.values()\n"
        "            os.kill(nanny.pid, 9)\n"
        "            while nanny.pid or nanny.process.status.name != 'starting':\n"
        "                pass\n"
        "        if sys.argv[1] == 'busy':\n"
        "            c.result(c.submit(time.sleep, 60), 'a nap')\n"
        "        time.sleep(60 if sys.argv[1] == 'idle' else 0)\n"
    )
    for how, number in (("busy", signal.SIGINT), ("idle", signal.SIGKILL), ("ends", None), ("ends anew", None)):
        command = [sys.executable, "-c", script, how]
        environ = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            command, env=environ, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        pid = int(process.stdout.readline())
        if number is not None:
            time.sleep(0.5)
            os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
        said = process.communicate(timeout=30)[1]
        for _ in range(100):
            if not _runs(pid):
                break
            time.sleep(0.1)
        assert not _runs(pid), how
        assert "distributed" not in said or how == "busy", said  # the traceback of the interrupt names where it was
        if how.startswith("ends"):
            assert said == ""
