"""Frames by recorded steps are those that are traced anew, whatever changes between two of them."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import numpy as np
import pytest
import torch

import drgs
from drgs import runtime
from drgs.testing import random_scene
from drgs.tracing import projection, recordings, tiles
from drgs.tracing.composite import Compositor
from drgs.tracing.recordings import padded, replay, without_recordings

pytestmark = pytest.mark.core

BACKGROUNDS = ((0.0, 0.0, 0.0), (0.2, 0.4, 0.7))


@pytest.fixture(autouse=True)
def nothing_recorded(monkeypatch):
    """Recordings of this test alone."""
    monkeypatch.setattr(recordings, "_held", type(recordings._held)())


def scene(count=60, seed=0, dtype=torch.float32):
    """The first Gaussians of a random scene, as leaves, and its first camera."""
    g, views = random_scene(seed)
    assert len(g) >= count
    own = {name: x[:count].detach().clone() for name, x in g.parameters().items() if name != "features"}
    own["means"] = own["means"].to(dtype)
    return drgs.Gaussians(**{name: x.requires_grad_() for name, x in own.items()}), views[0]


def sized(camera, width, height, w2c=None):
    """A camera of another size that sees about the same."""
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return drgs.Camera(K=K, w2c=camera.w2c if w2c is None else w2c, width=width, height=height)


def frame(g, camera, settings, outputs=()):
    """Images and gradients of a frame."""
    for x in g.parameters().values():
        x.grad = None
    out = drgs.render(g, camera, settings, outputs=outputs)
    images = {name: getattr(out, name) for name in ("rgb", "alpha", "depth", "median_depth", "count")}
    images = {name: x for name, x in images.items() if x is not None}
    loss = out.rgb.square().mean() + 0.1 * out.alpha.mean() + (0 if out.depth is None else 0.01 * out.depth.mean())
    loss.backward()
    found = {name: x.detach().clone() for name, x in images.items()}
    found |= {f"gradient of {name}": x.grad.clone() for name, x in g.parameters().items()}
    return found, out.certificate


def assert_same(recorded, traced):
    """The same images to the last bit, and gradients but for the order of sums."""
    (found, certificate), (expected, its) = recorded, traced
    assert certificate == its
    assert list(found) == list(expected)
    for name, x in expected.items():
        if name.startswith("gradient"):
            torch.testing.assert_close(found[name], x, rtol=1e-4, atol=1e-5 * float(x.abs().max()))
        else:
            assert torch.equal(found[name], x), name


def check(g, camera, settings, outputs=()):
    """A frame is what it is without recordings."""
    recorded = frame(g, camera, settings, outputs)
    with without_recordings():
        assert_same(recorded, frame(g, camera, settings, outputs))


def test_all_that_changes_between_two_frames():
    """Numbers of Gaussians and pixels, entries of lists, scenes, poses, settings and outputs; and back again."""
    fast, exact = (drgs.RenderSettings.preset(name) for name in ("fast", "exact"))
    for settings in (fast, exact):
        for seed in (0, 1):
            for count, width, height in ((60, 24, 16), (44, 24, 16), (44, 17, 31), (60, 24, 16)):
                g, camera = scene(count, seed)
                for background in BACKGROUNDS:
                    check(g, sized(camera, width, height), settings.replace(background=background))
    g, camera = scene()
    camera = sized(camera, 24, 16)
    near = {"extent": 2.0}, {"extent": 3.5}, {"near": 0.3}, {"alpha_min": 0.02}, {"max_hits": 3}, {"depth_key": "z"}
    for fields in near:
        check(g, camera, fast.replace(**fields))
    for name in ("gsplat", "inria", "fast"):
        for outputs in ((), ("depth",), ("median_depth", "count")):
            check(g, camera, drgs.RenderSettings.preset(name), outputs)
    check(g, camera, exact.replace(tolerance=1e-3))
    check(g, camera, exact, ("depth",))


def test_a_second_frame_is_not_traced(monkeypatch):
    """With other numbers in the same arrays nothing is projected by Python, and the numbers count."""
    calls = []
    project = projection.project_screen
    monkeypatch.setattr(projection, "project_screen", lambda *args: calls.append(1) or project(*args))
    settings = drgs.RenderSettings.preset("fast")
    g, camera = scene()
    camera = sized(camera, 24, 16)
    first, _ = frame(g, camera, settings)
    assert calls
    frame(g, camera, settings)  # Dr.Jit may record once more, for arrays that are aligned otherwise
    calls.clear()
    with torch.no_grad():
        g.logit_opacities.sub_(0.5)
        g.sh.mul_(0.9)
    other, _ = frame(g, camera, settings)
    assert not calls
    assert not torch.equal(first["rgb"], other["rgb"])
    with without_recordings():
        assert torch.equal(other["rgb"], frame(g, camera, settings)[0]["rgb"])
    assert calls


def test_poses_and_float64():
    """The pose has its gradient, and means in float64 have theirs."""
    settings = drgs.RenderSettings.preset("fast")
    found = []
    for recorded in (True, True, False):
        g, camera = scene(dtype=torch.float64)
        w2c = torch.tensor(camera.w2c, requires_grad=True)
        moved = sized(camera, 24, 16, w2c)
        if recorded:
            drgs.render(g, moved, settings, outputs=()).rgb.square().sum().backward()
        else:
            with without_recordings():
                drgs.render(g, moved, settings, outputs=()).rgb.square().sum().backward()
        assert g.means.grad.dtype == torch.float64
        found.append((w2c.grad, g.means.grad))
    for pose, means in found[:2]:
        torch.testing.assert_close(pose, found[2][0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(means, found[2][1], rtol=1e-4, atol=1e-6)


def test_nothing_seen_and_one_gaussian():
    """Lists without an entry, and scenes of a single Gaussian."""
    for name in ("fast", "exact"):
        settings = drgs.RenderSettings.preset(name)
        g, camera = scene()
        behind = camera.w2c.copy()
        behind[2, 3] = -100.0
        check(g, sized(camera, 24, 16, behind), settings)
        check(scene(1)[0], sized(camera, 24, 16), settings)
        check(g, sized(camera, 1, 1), settings)


def test_several_bands(monkeypatch):
    """Rows of hits that are sorted band by band."""
    settings = drgs.RenderSettings.preset("exact")
    g, camera = scene()
    camera = sized(camera, 32, 24)
    whole, _ = frame(g, camera, settings)
    monkeypatch.setattr(tiles, "TABLES", 1 << 16)
    check(g, camera, settings)
    assert torch.equal(frame(g, camera, settings)[0]["rgb"], whole["rgb"])


def test_large_boxes(monkeypatch):
    """Pairs of a tile and a Gaussian that are tested, and blocks of tiles that are tested first."""
    g, camera = scene()
    camera = sized(camera, 90, 70)
    for tested, blocks in ((1e9, 1e9), (0, 1e9), (0, 0)):
        monkeypatch.setattr(tiles, "_TEST_TILES_FROM", tested)
        monkeypatch.setattr(tiles, "_TEST_BLOCKS_FROM", blocks)
        for name in ("fast", "exact", "inria"):
            check(g, camera, drgs.RenderSettings.preset(name))


def test_few_are_kept(monkeypatch):
    """The steps that were used least recently go, and are recorded again."""
    monkeypatch.setattr(recordings, "_MAX_RECORDINGS", 3)
    settings = drgs.RenderSettings.preset("fast")
    for _ in range(2):
        for count in (20, 60):
            g, camera = scene(count)
            check(g, sized(camera, 24, 16), settings)
            assert len(recordings._held) <= 3


def test_a_second_backward_pass():
    """With `retain_graph`; its gradient is that of the first."""
    g, camera = scene()
    out = drgs.render(g, sized(camera, 24, 16), drgs.RenderSettings.preset("fast"), outputs=())
    loss = out.rgb.square().mean()
    loss.backward(retain_graph=True)
    once = g.means.grad.clone()
    loss.backward()
    torch.testing.assert_close(g.means.grad, 2 * once, rtol=1e-5, atol=1e-9)


def test_threads_take_turns():
    """What one thread has recorded another one launches."""
    settings = drgs.RenderSettings.preset("fast")
    g, camera = scene()
    camera = sized(camera, 24, 16)
    first, _ = frame(g, camera, settings)

    def own(_):
        mine = drgs.Gaussians(**{n: x.detach().clone().requires_grad_() for n, x in g.parameters().items()})
        return frame(mine, camera, settings)[0]

    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(own, range(6)):
            assert torch.equal(found["rgb"], first["rgb"])
            torch.testing.assert_close(found["gradient of means"], first["gradient of means"], rtol=1e-4, atol=1e-7)


def repeated(what, a):
    """Numbers 11 times for every 10, which is no multiple of their width."""
    width = dr.width(a["x"])
    i = dr.arange(type(dr.uint32_array_t(a["x"])(0)), width * 11 // 10)
    return what * dr.gather(type(a["x"]), a["x"], i % width)


def test_sizes_that_follow_from_no_width():
    """Dr.Jit alone would launch as many lanes as it has recorded."""
    lib = runtime.dr_types()
    for factor in (2.0, 3.0):
        for width in (10, 40, 20, 40):
            x = np.arange(width, dtype=np.float32)
            found = replay(repeated, factor, {"x": lib.Float(x)}).numpy()
            np.testing.assert_array_equal(found, factor * x[np.arange(width * 11 // 10) % width])


def borrowed(what, a):
    """Takes an array from elsewhere."""
    return a["x"] + ELSEWHERE[0]


ELSEWHERE: list = []


def test_arrays_from_elsewhere_are_refused():
    """What would be recorded as a constant is an error."""
    lib = runtime.dr_types()
    ELSEWHERE[:] = [lib.Float(np.array([1.0, 2.0, 3.0]))]
    with pytest.raises(RuntimeError, match="recording a frozen function"):
        replay(borrowed, None, {"x": lib.Float(np.array([1.0, 2.0, 4.0]))})
    ELSEWHERE.clear()


def test_an_interrupt_while_recording(monkeypatch):
    """It comes out as itself, forward and backward, and the next frame is whole."""
    settings = drgs.RenderSettings.preset("fast")
    g, camera = scene()
    camera = sized(camera, 24, 16)

    def interrupted(*_):
        raise KeyboardInterrupt

    for name in ("composited", "adjoint"):
        recordings._held.clear()
        with monkeypatch.context() as patch:
            patch.setattr(Compositor, name, interrupted)
            with pytest.raises(KeyboardInterrupt):
                frame(g, camera, settings)
        check(g, camera, settings)


def test_padded():
    """Eight widths between two powers of two, none shorter than asked."""
    for count in range(1, 5000):
        assert count <= padded(count) <= max(1.125 * count + 16, 16)
    assert len({padded(count) for count in range(1025, 2049)}) == 8


def test_tails_left_out_of_recorded_lists():
    """Lists of `exact` leave out what a tile need not look at, unless depth is wanted, as where frames are traced."""
    normal = torch.randn(3000, 11, generator=torch.Generator().manual_seed(0))
    shape = {"means": 0.5 * normal[:, :3], "quats": normal[:, 3:7], "log_scales": 0.3 * normal[:, 7:10] - 4}
    own = {**shape, "logit_opacities": normal[:, 10], "sh": torch.full((3000, 1, 3), 0.3)}
    g = drgs.Gaussians(**{name: x.clone().requires_grad_() for name, x in own.items()})
    w2c = np.eye(4)
    w2c[2, 3] = 3
    camera = drgs.Camera(K=np.array([[100.0, 0, 48], [0, 100, 32], [0, 0, 1]]), w2c=w2c, width=96, height=64)
    settings = drgs.RenderSettings.preset("exact")
    check(g, camera, settings)
    pairs = [frame(g, camera, settings, outputs)[1]["pairs"] for outputs in ((), ("depth",))]
    assert 0 < pairs[0] < pairs[1]


BESIDE = """
import threading, time
import drjit as dr, numpy as np, torch
import drgs
from drgs import runtime

n = 200
draw = torch.Generator().manual_seed(0)
normal = torch.randn(n, 11, generator=draw)
tensors = {"means": 0.5 * normal[:, :3], "quats": normal[:, 3:7], "log_scales": 0.3 * normal[:, 7:10] - 2.5}
tensors |= {"logit_opacities": normal[:, 10], "sh": torch.zeros(n, 1, 3)}
w2c = np.eye(4)
w2c[2, 3] = 3
camera = drgs.Camera(K=np.array([[20.0, 0, 10], [0, 20, 7], [0, 0, 1]]), w2c=w2c, width=20, height=15)
lib, done = runtime.dr_types(), False

def other():
    while not done:
        dr.sum(dr.sin(lib.Float(np.arange(1000, dtype=np.float32))))[0]

thread = threading.Thread(target=other)
thread.start()
end = time.monotonic() + 4
count = 0
while time.monotonic() < end:
    count = count % 100 + 1
    own = {name: x[: 100 + count].clone().requires_grad_() for name, x in tensors.items()}
    drgs.render(drgs.Gaussians(**own), camera, drgs.RenderSettings.preset("fast")).rgb.sum().backward()
done = True
thread.join()
"""


@pytest.mark.skipif(runtime.backend().name == "cuda", reason="Dr.Jit's threads on a card have scopes of their own")
def test_a_thread_that_uses_dr_jit_beside_does_not_hang():
    """Frames are recorded while another thread, which knows nothing of drgs, computes with Dr.Jit."""
    done = subprocess.run([sys.executable, "-c", BESIDE], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
