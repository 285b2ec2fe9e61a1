"""Rendering from several Python threads, and in processes that are forked or spawned."""

from __future__ import annotations

import concurrent.futures
import gc
import multiprocessing
import subprocess
import sys
import threading
import time
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import torch
from scenes_random import camera, gaussians

from drgs import fisher, runtime
from drgs.integrator import render, render_jvp
from drgs.runtime.threads import fewer_torch_threads
from drgs.settings import RenderSettings
from drgs.tracing.call import Call

HERE = Path(__file__).parent
SETTINGS = RenderSettings.preset("fast")


def everything(seed: int) -> list[torch.Tensor]:
    """Image, gradients of every group and the pose, and a tangent image, of a scene of its own."""
    rng = np.random.default_rng(seed)
    g, cam = gaussians(rng, 8 + seed, 4), camera(rng, (9 + seed, 7))
    out = render(g, cam, SETTINGS)
    (out.rgb.square().sum() + out.depth.sum()).backward()
    pushed = render_jvp(g, cam, {"means": torch.ones_like(g.means), "sh": torch.ones_like(g.sh)}, SETTINGS)
    return [out.rgb.detach(), pushed.rgb, cam.w2c.grad, *(x.grad for x in g.parameters().values())]


@pytest.mark.slow
def test_two_workers(two_threads):
    """With two threads of Dr.Jit images, gradients, tangents and information are those of one, to rounding."""
    rng = np.random.default_rng(3)
    g, cam = gaussians(rng, 40, 4), camera(rng, (80, 60))  # several packets a worker

    def found() -> list[torch.Tensor]:
        fresh = g.detach()
        for x in fresh.parameters().values():
            x.requires_grad_()
        out = render(fresh, cam, SETTINGS)
        out.rgb.square().sum().backward()
        pushed = render_jvp(fresh, cam, {"means": torch.ones_like(fresh.means)}, SETTINGS)
        sums = fisher.diagonal(fresh, cam, SETTINGS)
        return [out.rgb.detach(), pushed.rgb, *sums.values(), *(x.grad for x in fresh.parameters().values())]

    got = found()
    dr.set_thread_count(1)
    for a, b in zip(got, found(), strict=True):
        # Sums of some thousand float32 terms, in another order.
        assert float((a - b).abs().max()) <= 1e-5 * float(b.abs().max())


@pytest.mark.slow
def test_four_threads(monkeypatch):
    """Forward, backward and forward mode of four scenes at once equal those of one thread.

    To rounding of float32: additions of one worker come in one order. Threads are made to meet where each hands its
    images to torch; now only one of them ever gets there.
    """
    want, trace = [everything(seed) for seed in range(4)], Call.trace
    failed, pair, together = [], threading.Barrier(2), []

    def meet(scene, **inputs):
        images = trace(scene, **inputs)
        try:
            pair.wait(2)
            together.append(scene)
        except threading.BrokenBarrierError:
            pass
        return images

    def work(seed):
        try:
            for a, b in zip(everything(seed), want[seed], strict=True):
                torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)
        except Exception as error:
            failed.append(error)

    monkeypatch.setattr(Call, "trace", meet)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed, failed[0]
    assert not together


def _run(script: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, cwd=HERE)


SCENE = """
import os, sys
import numpy as np
from drgs.lab.accuracy import random_camera, random_gaussians
from drgs import fisher
from drgs.integrator import render
from drgs.tracing.call import Call
from drgs.settings import RenderSettings

def draw():
    rng = np.random.default_rng(0)
    g, cam = random_gaussians(rng, 300, 1).detach(), random_camera(rng, (200, 150))
    return render(g, cam, RenderSettings.preset("fast"), outputs=()).rgb

def in_child():
    if (child := os.fork()) == 0:
        try:
            print("drawn", float(draw().mean()) > 0, flush=True)
        except NotImplementedError as problem:
            print("refused:", problem, flush=True)
        os._exit(0)  # as multiprocessing ends its children; Dr.Jit's own end would wait for its threads
    assert os.waitpid(child, 0)[1] == 0
"""


def test_forks():
    """A child forked before the first render renders; one forked behind it refuses, in one line, and ends.

    Before, the latter waited for workers that only its parent has. On a card both refuse: it was in use.
    """
    done = _run(SCENE + "in_child()\ndraw()\nin_child()\ndraw()\n")
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first == "drawn True" or runtime.backend().name == "cuda"
    for line in [second] if first == "drawn True" else [first, second]:
        assert line.startswith("refused: drgs: a process must not render when it was forked from one that has rendered")
        assert "spawn" in line


def test_a_child_of_a_child():
    """It is forked without a word, too."""
    done = _run("import os, drgs\nif not os.fork():\n    os.fork()\n")
    assert (done.returncode, done.stderr) == (0, "")


def test_backward_in_another_thread():
    """One that comes back, as torch's own for what is on a card, gets the gradients of the thread that has rendered."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        for name in ("fast", "exact", "fast", "gsplat"):
            settings, found = RenderSettings.preset(name), []
            for differentiate in (lambda loss: loss.backward(), lambda loss: pool.submit(loss.backward).result()):
                rng = np.random.default_rng(1)
                g, cam = gaussians(rng, 20, 1), camera(rng, (18, 14))
                differentiate(render(g, cam, settings).rgb.square().sum())
                found.append(g.means.grad)
            torch.testing.assert_close(*found)


def test_spawn():
    """`multiprocessing`'s spawn starts processes that render, from one that has."""
    want = everything(0)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        got = pool.apply(everything, (0,))
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)


GARBAGE = """
import concurrent.futures, gc, sys, time
import drjit as dr
import numpy as np
import torch
from drgs import fisher, runtime
from drgs.integrator import render
from drgs.lab.accuracy import random_camera, random_gaussians
from drgs.settings import RenderSettings

SETTINGS = RenderSettings.preset("fast")
rng = np.random.default_rng(0)
g, cam = random_gaussians(rng, 10, 1), random_camera(rng, (18, 14))
lib = dr.llvm.ad

@runtime.alone
def leave_cycles():
    for _ in range(5):
        numbers = lib.Float(torch.ones(7))
        dr.enable_grad(numbers)
        cycle = [numbers * numbers]  # the graph alone keeps the numbers
        cycle.append(cycle)

def work(_):
    fisher.diagonal(g.detach(), cam, SETTINGS, "probes", probes=2)
    render(g.detach(), cam, SETTINGS)

work(0)
gc.collect()
gc.freeze()
sys.setswitchinterval(5e-4)
with concurrent.futures.ThreadPoolExecutor(4) as pool:
    running, end = [], time.monotonic() + 6
    while time.monotonic() < end:
        running = [each for each in running if not each.done() or each.result() is not None]
        running += [pool.submit(work, 0) for _ in range(6 - len(running))]
        leave_cycles()  # as `dr.wrap` does
        gc.collect()
        render(g, cam, SETTINGS)  # whose graph nobody wants
print("ended")
"""


@pytest.mark.slow
def test_graphs_end_beside_computations():
    """Garbage in cycles, and images that are dropped, of one thread do not stop others that compute, nor itself."""
    done = _run(GARBAGE)
    assert done.stdout == "ended\n", done.stderr


def test_the_garbage_collector_waits():
    """It does not run by itself while something is computed, and is as it was afterwards; computations wait for it."""
    seen = []

    @runtime.alone
    def compute() -> None:
        seen.append(gc.isenabled())

    compute()
    assert gc.isenabled()
    gc.disable()
    compute()
    assert not gc.isenabled()
    gc.enable()
    assert seen == [False, False]

    class Garbage:
        """Takes a while to be collected, and tells whether another thread computed meanwhile."""

        def __init__(self) -> None:
            self.itself = self

        def __del__(self) -> None:
            thread.start()
            time.sleep(0.2)
            seen.append(thread.is_alive())

    thread = threading.Thread(target=compute)
    Garbage()
    gc.collect()
    thread.join(30)
    assert seen == [False, False, True, False]
    assert gc.isenabled()


def test_a_pick_within_a_fit_has_half_of_torchs_threads():
    """Not a quarter; and all of them afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(8)
    try:
        with fewer_torch_threads():
            with fewer_torch_threads():
                assert torch.get_num_threads() == 4
            assert torch.get_num_threads() == 4
        assert torch.get_num_threads() == 8
    finally:
        torch.set_num_threads(before)
