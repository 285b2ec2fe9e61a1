"""What every test gets: fixed seeds, one thread, a clean slate afterwards, and skips that say why.

The suite runs on the backend that DRGS_VARIANT names (default LLVM, so that a machine with a card
tests the CPU unless asked otherwise). Nothing heavy is imported until a test does so itself.
"""

from __future__ import annotations

import atexit
import gc
import logging
import os
import random
import shutil
import signal
import sys
import tempfile
import zlib
from pathlib import Path

import pytest

from drgs.runtime.libllvm import prepare

prepare()  # tests may import drjit before drgs
# Before torch or Dr.Jit is imported, and inherited by the processes that tests start. One thread: sums of several
# differ in their last digits, which some tests compare; the suite's processes share the cores already.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "DRGS_THREADS"), "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # OpenMP threads that spin take cores from Dr.Jit's
os.environ.setdefault("DRGS_VARIANT", "llvm_ad_rgb")

# Matches that fits keep are those of one test, and leave nothing behind; the viewer's code is the user's.
_cache = Path(tempfile.mkdtemp(prefix="drgs-cache-"))
atexit.register(shutil.rmtree, _cache, ignore_errors=True)
(_cache / "drgs").mkdir()
_npm = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "drgs" / "npm"
if _npm.is_dir():
    (_cache / "drgs" / "npm").symlink_to(_npm)
os.environ["XDG_CACHE_HOME"] = str(_cache)

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser):
    """`--slow` runs the tests marked slow as well."""
    parser.addoption("--slow", action="store_true", help="run tests marked slow")


def pytest_collection_modifyitems(config, items):
    """Cases of a test that is marked `every(n)` are slow but for each n-th, counted from the first; slow tests are
    skipped before their fixtures are made.
    """
    counts: dict[str, int] = {}
    for item in items:
        marker = item.get_closest_marker("every")
        if marker:
            name = item.nodeid.partition("[")[0]
            count = counts[name] = counts.get(name, -1) + 1
            if count % marker.args[0]:
                item.add_marker("slow")
        if item.get_closest_marker("slow") and not config.getoption("--slow"):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A test that ends its process, as one does that hangs, fails once, and all others are run."""
    if config.getoption("dist") != "loadfile":
        return None
    from scheduling import FilesOnce

    return FilesOnce(config, log)


@pytest.fixture(autouse=True)
def _skip_by_marker(request):
    if request.node.get_closest_marker("same_bits") and os.environ["DRGS_VARIANT"] == "cuda_ad_rgb":
        pytest.skip("on a card the order of sums, and so their last bits, is another in each run")
    if request.node.get_closest_marker("cuda"):
        from drgs import runtime

        usable, reason = runtime.cuda_status()
        if not usable:
            pytest.skip(f"no CUDA: {reason}")


@pytest.fixture(autouse=True)
def _isolated(request):
    """Seed everything from the test's own name; put back what a test may change."""
    seed = zlib.crc32(request.node.nodeid.encode())
    random.seed(seed)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(seed)
    shutil.rmtree(_cache / "drgs" / "matches", ignore_errors=True)
    environ, directory, path = dict(os.environ), os.getcwd(), list(sys.path)
    logger = logging.getLogger("drgs")  # of which a command sets the level
    level = logger.level
    flags = _flags()
    yield
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(directory)
    sys.path[:] = path
    logger.setLevel(level)
    if "drjit" in sys.modules:
        # A kernel still running would write into buffers that the next test reuses.
        sys.modules["drjit"].sync_thread()
        for flag, value in flags.items():
            sys.modules["drjit"].set_flag(flag, value)
    if "torch" in sys.modules:
        torch = sys.modules["torch"]
        torch.set_grad_enabled(True)
        torch.set_default_dtype(torch.float32)
        torch.use_deterministic_algorithms(False)


@pytest.fixture(autouse=True, scope="module")
def _memory_is_given_back():
    """Dr.Jit keeps freed arrays for arrays of the same size: over all files of tests that is 4 GB a process."""
    yield
    if "drjit" in sys.modules:
        gc.collect()
        sys.modules["drjit"].flush_malloc_cache()


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch):
    """They come with time: on a busy machine they would get in between what tests expect on stderr."""
    from drgs.display import progress

    for name in ("FIRST", "EVERY", "LEAST_OFTEN"):
        monkeypatch.setattr(progress, name, 3600.0)


def _flags() -> dict:
    """Dr.Jit's settings that a test may switch; empty while Dr.Jit is not imported."""
    if "drjit" not in sys.modules:
        return {}
    dr = sys.modules["drjit"]
    names = ("Debug", "FastMath", "KernelHistory", "OptimizeLoops", "SymbolicLoops")
    return {getattr(dr.JitFlag, name): dr.flag(getattr(dr.JitFlag, name)) for name in names}


@pytest.fixture
def functions_in_float64(monkeypatch):
    """Rasterizers in torch are compared on the CPU: a card would give them float32, of which fewer central differences
    converge.
    """
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture
def two_threads():
    """Dr.Jit and torch have two threads each during the test."""
    import drjit as dr
    import torch

    before = dr.thread_count(), torch.get_num_threads()
    dr.set_thread_count(2)
    torch.set_num_threads(2)
    yield
    dr.set_thread_count(before[0])
    torch.set_num_threads(before[1])


@pytest.fixture
def rng(request):
    """A NumPy generator whose seed is the test's name: the same numbers alone and in the suite."""
    import numpy as np

    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture(scope="session")
def data_dir():
    """Folder of real data sets: DRGS_DATA, or ../shared/data beside the checkout."""
    folder = Path(os.environ.get("DRGS_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} does not exist (set DRGS_DATA)")
    return folder


@pytest.fixture(autouse=True)
def _nothing_is_ignored():
    """Tests that run in the background, or under nohup, ignore signals, and so would the processes that they start."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def made(monkeypatch):
    """Name of a class -> how many `Camera`s and `RenderSettings` the test has made so far, each validated."""
    from drgs.cameras import Camera
    from drgs.settings import RenderSettings

    counts = {"Camera": 0, "RenderSettings": 0}
    for kind in (Camera, RenderSettings):

        def counted(self, check=kind.__post_init__, name=kind.__name__):
            counts[name] += 1
            check(self)

        monkeypatch.setattr(kind, "__post_init__", counted)
    return counts


@pytest.fixture
def rendered(monkeypatch):
    """(preset, photograph) of every step of a fit, as it is rendered."""
    import drgs.fitting.trainer as module

    render = module.render
    seen: list[tuple[str, str]] = []

    def spied(gaussians, camera, settings, **options):
        seen.append((settings.nearest_preset()[0], camera.name))
        return render(gaussians, camera, settings, **options)

    monkeypatch.setattr(module, "render", spied)
    return seen


@pytest.fixture
def whole_and_resumed(tmp_path):
    """Runs of one fit: without a stop, and stopped before step `at`, then resumed."""
    from resuming import stopped_and_resumed

    from drgs.files import Run
    from drgs.train import fit

    def runs(dataset, settings, at):
        fit(dataset, tmp_path / "whole", settings, progress=False)
        stopped_and_resumed(lambda: dataset, tmp_path / "parts", settings, at)
        return Run(tmp_path / "whole"), Run(tmp_path / "parts")

    return runs
