"""Claims of `drgs view` in a real browser: it draws, its picture and ours agree, and its controls do what they say."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import http.server
import shutil
import threading
import time

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install 'drgs[view]'")
pytest.importorskip("playwright", reason="no playwright: pip install playwright")

import psutil
from playwright import sync_api
from test_select_command import place  # noqa: F401 (a data set, and a run that chose its views)
from test_view import EVIL, blobs, subject

from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.commands import view
from drgs.commands.options import View
from drgs.commands.scene_input import SceneInput
from drgs.commands.view import subject_of, watched_files
from drgs.data.camera_path import read_camera_path, rotation_of
from drgs.files import load_state, save_state
from drgs.viewing.client import camera_of, pose_of
from drgs.viewing.server import Viewer
from drgs.viewing.session import REST
from drgs.viewing.subject import FirstView

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTH, HEIGHT = 640, 480
PATIENCE = 120_000  # ms; the machine may be busy, and draws WebGL by software
HANGS = 240.0  # s that a test may take before its browser counts as hung; the longest takes half a minute beside others


class Browsers:
    """Chromium, started when it is asked for, and once more after it was ended."""

    def __init__(self) -> None:
        self._driver = self._launched = None
        self.is_hung = False

    def browser(self):
        if self._launched is None:
            flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
            self._driver = sync_api.sync_playwright().start()
            self._launched = self._driver.chromium.launch(executable_path=CHROMIUM, args=flags)
        return self._launched

    @contextlib.contextmanager
    def watched(self):
        """Within, what waits for a browser that never answers gets an error: the browser is killed, and its driver."""
        done = threading.Event()

        def watch() -> None:
            if not done.wait(HANGS):
                self.is_hung = True
                for process in psutil.Process().children(recursive=True):
                    if process.name().startswith(("chrom", "node")):
                        with contextlib.suppress(psutil.Error):
                            process.kill()

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()

    def end(self) -> None:
        """End both; of what was killed nothing is left to be ended in order."""
        with contextlib.suppress(Exception) if self.is_hung else contextlib.nullcontext(), self.watched():
            if self._launched is not None:
                self._launched.close()
            if self._driver is not None:
                self._driver.stop()
        self._driver = self._launched = None
        self.is_hung = False


def once_more(test):
    """A test whose browser hung is done again in a new one: a Chromium that draws by software may hang.

    Where the second one hangs, too, the test fails.
    """

    @functools.wraps(test)
    def run(shown, **fixtures):
        try:
            with shown.browsers.watched():
                return test(shown, **fixtures)
        except Exception:
            if not shown.browsers.is_hung:
                raise
        shown.end()
        shown.browsers.end()
        with shown.browsers.watched():
            return test(shown, **fixtures)

    return run


@pytest.fixture(scope="module")
def browsers():
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    made = Browsers()
    yield made
    made.end()


class Shown:
    """Opens viewers in pages, and ends both."""

    def __init__(self, browsers: Browsers) -> None:
        self.browsers = browsers
        self._opened: list = []

    def __call__(self, looked, width=WIDTH, height=HEIGHT, **options):
        viewer = Viewer(looked, **{"preset": "fast", "pixels": 60_000} | options)
        self._opened.append((viewer, None, errors := []))
        page = self.browsers.browser().new_page(viewport={"width": width, "height": height})
        self._opened[-1] = viewer, page, errors
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(viewer.address)
        rests(page, viewer)
        return viewer, page

    def end(self) -> None:
        """Close all, and look at what the pages complained of."""
        opened, self._opened = self._opened, []
        for viewer, page, errors in opened:
            if page is not None and not self.browsers.is_hung:
                page.close()
            assert viewer.stop(60.0)
            assert not errors


@pytest.fixture
def shown(browsers):
    made = Shown(browsers)
    yield made
    try:
        with browsers.watched():
            made.end()
    except sync_api.Error:
        if not browsers.is_hung:
            raise
    if browsers.is_hung:  # the test is over, and the next one gets another
        browsers.end()


def text(page, name: str) -> str:
    return page.evaluate(f"(document.getElementById('drgs-{name}') || {{}}).innerText || ''")


def session_of(viewer):
    """Of the only page."""
    (found,) = viewer.sessions.values()
    return found


def rests(page, viewer, more_than: int = 0) -> int:
    """Wait until more than so many of our pictures are drawn to the end, and nothing is left to draw; how many are."""
    end = time.monotonic() + PATIENCE / 1000
    while time.monotonic() < end:
        page.wait_for_timeout(REST * 1000 + 300)  # what was just done begins to be drawn; the browser decodes
        session = next(iter(viewer.sessions.values()), None)
        if session and session.drawn > more_than and not viewer.worker.has((session, "picture")):
            page.wait_for_timeout(400)
            return session.drawn
    raise AssertionError(f"never drawn: {text(page, 'status')!r}")


def picture(page) -> np.ndarray:
    """(H, W, 3) RGB of the page, with what lies over the scene (panel, a word about WebGL) in black."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    image[:240] = 0
    image[:, 320:] = 0
    return image


def bright(page) -> np.ndarray:
    """(x, y) of the middle of what is green, once two pictures in a row show the same: a small one comes first, and the
    browser draws when it has time.
    """
    end = time.monotonic() + PATIENCE / 1000
    before = None
    while time.monotonic() < end:
        image = picture(page)
        weight = np.clip(image[..., 1] - image[..., 0] - 40, 0, None)
        if weight.max() > 60 and np.array_equal(image, before):
            rows, columns = np.indices(weight.shape) + 0.5
            return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        before = image
        page.wait_for_timeout(300)
    raise AssertionError(f"nothing green is seen at rest, at most {weight.max()}")


def choose(page, before: str, after: str) -> None:
    page.locator(f'input[value="{before}"]').locator("visible=true").first.click()
    page.get_by_role("option", name=after, exact=True).locator("visible=true").first.click()


@once_more
def test_the_browser_and_we_draw_the_same(shown):
    """A Gaussian off the middle is where its projection says in the browser's picture and in ours, to a pixel: so both
    have the same cameras. Another layer is another picture. A scene named like a program is a name."""
    sh = torch.tensor([[[-1.7, 1.7, -1.7]]])
    g = blobs(torch.tensor([[-0.55, 0.45, 0.2]]), sh=sh, scales=torch.full((1, 3), 0.06))
    looked = subject(torch.zeros(1, 3), scene=g, name=EVIL)
    viewer, page = shown(looked)
    where = camera_of(looked.first.pose, WIDTH, HEIGHT, np.zeros(3)).project(g.means.numpy())[0][0]
    assert 40 < where[0] < 280
    assert 280 < where[1] < 440
    np.testing.assert_allclose(bright(page), where, atol=1.0)
    ours = picture(page)
    count = session_of(viewer).drawn
    page.locator('input[type="checkbox"]').locator("visible=true").first.click()  # our picture
    page.wait_for_function("document.getElementById('drgs-status').innerText.trim() === ''")
    page.wait_for_timeout(1500)
    theirs = picture(page)
    np.testing.assert_allclose(bright(page), where, atol=1.0)
    assert not np.array_equal(ours, theirs)
    page.locator('input[type="checkbox"]').locator("visible=true").first.click()
    count = rests(page, viewer, count)
    choose(page, "rgb", "missing")
    rests(page, viewer, count)
    assert text(page, "status").startswith("missing, fast: ")
    assert np.abs(picture(page) - ours).mean() > 20
    assert page.evaluate("document.getElementById('drgs-header').querySelectorAll('script, img').length") == 0
    assert EVIL in text(page, "header")


@once_more
def test_the_browser_draws_what_is_far_away(shown):
    """Where a skybox may be: 50,000 times as far as what is looked at, with a Gaussian that is small beside it."""
    looked = subject(torch.zeros(1, 3))
    first = looked.first
    way = np.array([-0.55, 0.45, 0.2]) - first.pose.position
    times = 5e4 * first.distance / np.linalg.norm(way)
    means = torch.from_numpy(np.stack([np.zeros(3), first.pose.position + times * way])).float()
    scales = torch.tensor([[0.02], [0.06 * times]]).expand(2, 3)
    sh = torch.tensor([[[-1.7, -1.7, -1.7]], [[-1.7, 1.7, -1.7]]])
    looked = subject(means, scene=blobs(means, sh=sh, scales=scales))
    viewer, page = shown(looked)
    where = camera_of(looked.first.pose, WIDTH, HEIGHT, np.zeros(3)).project(means.numpy())[0][1]
    np.testing.assert_allclose(bright(page), where, atol=1.0)
    page.locator('input[type="checkbox"]').locator("visible=true").first.click()  # our picture
    page.wait_for_function("document.getElementById('drgs-status').innerText.trim() === ''")
    page.wait_for_timeout(1500)
    np.testing.assert_allclose(bright(page), where, atol=1.0)


@once_more
def test_a_click_on_a_camera_shows_it(shown, place):  # noqa: F811
    """A click on a frustum flies there and opens what is known of it; a checkpoint that a fit writes meanwhile is
    noticed and shown, with its step."""
    args = View(scene=place / "run", preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    placed = next(placed for placed in looked.placed_views if placed.kind == "candidate")
    tip, middle = placed.camera.center, looked.first.target
    body = tip + placed.camera.c2w[:3, :3] @ np.array([0.0, 0.0, 0.1])
    # From behind it, so that it is at the left and below, where neither the panel nor a word about WebGL is.
    eye = middle + 1.5 * (tip - middle)
    behind = Camera(K=intrinsics_from_fov(60, 4, 3), w2c=look_at(eye, tip, looked.first.up), width=4, height=3)
    right, down, forward = behind.c2w[:3, :3].T
    target = eye + 2 * (forward + 0.25 * right - 0.2 * down)
    behind = dataclasses.replace(behind, w2c=look_at(eye, target, looked.first.up))
    looked = dataclasses.replace(looked, first=FirstView(pose_of(behind, looked.origin), target, looked.first.up))
    viewer, page = shown(looked)
    first = picture(page)
    where = camera_of(looked.first.pose, WIDTH, HEIGHT, looked.origin).project(body[None])[0][0]
    assert 20 < where[0] < 300
    assert 240 < where[1] < 460
    count = session_of(viewer).drawn
    page.mouse.click(*where)
    page.wait_for_function("(document.getElementById('drgs-photograph') || {}).innerText")
    shown_text = text(page, "photograph")
    assert shown_text.startswith(placed.camera.name)
    assert f"rank {placed.best.score.rank} of {placed.best.score.of}" in shown_text
    # What the browser had sent before may come after the click, and once more moves the camera for a moment.
    end = time.monotonic() + 30
    while np.abs(session_of(viewer).pose.position - tip).max() > 1e-3 and time.monotonic() < end:
        page.wait_for_timeout(50)
    np.testing.assert_allclose(session_of(viewer).pose.position, tip, atol=1e-3)
    page.wait_for_function("[...document.images].some(image => image.naturalWidth === 24)")  # the photograph
    rests(page, viewer, count)
    assert np.abs(picture(page) - first).max() > 20
    # a fit goes on
    stamps = view._stamps(watched_files(args))
    stop = threading.Event()

    def watch():
        while not stop.wait(0.5):
            if view._stamps(watched_files(args)) != stamps:
                viewer.worker.put("files", view._reload_job(args, viewer))
                return

    thread = threading.Thread(target=watch)
    thread.start()
    state = place / "run/state.safetensors"
    tensors, header = load_state(state)
    save_state(state, tensors, header | {"step": 1234})
    try:
        page.wait_for_function("document.getElementById('drgs-header').innerText.includes('step 1,234')")
    finally:
        stop.set()
        thread.join()
        save_state(state, tensors, header)


@once_more
def test_a_flight_is_downloaded(shown, tmp_path):
    """Two keyframes of where the page looks, saved by the browser as a file that `drgs render --path` reads."""
    looked = subject(torch.zeros(1, 3))
    viewer, page = shown(looked)
    page.get_by_text("flight", exact=True).click()
    for _ in range(2):
        page.get_by_role("button", name="add keyframe").click()
    page.wait_for_function("document.body.innerText.includes('2 keyframes, 2.0 s')")
    with page.expect_download() as download:
        page.get_by_role("button", name="save flight.json").click()
    download.value.save_as(tmp_path / "flight.json")
    assert download.value.suggested_filename == "flight.json"
    keys = read_camera_path(tmp_path / "flight.json").keyframes
    assert [key.seconds for key in keys] == [0.0, 2.0]
    for key in keys:
        np.testing.assert_allclose(key.position, looked.first.pose.position, atol=1e-5)
        np.testing.assert_allclose(rotation_of(key.wxyz), rotation_of(looked.first.pose.wxyz), atol=1e-5)


@once_more
def test_a_phone_sees_the_scene(shown, place):  # noqa: F811
    """At 390x844 the panel leaves most of the window free, the first view has all of its width, and no frustum lies
    over a quarter of it; what is folded in the panel opens."""
    args = View(scene=place / "run", preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    viewer, page = shown(looked, 390, 844)
    page.wait_for_function("document.getElementById('drgs-status').getBoundingClientRect().bottom <= 844")
    top = page.evaluate("document.getElementById('drgs-header').getBoundingClientRect().top")
    assert top > 844 * 0.66
    session = session_of(viewer)
    width = np.tan(session.pose.fov / 2) * session.pose.aspect
    first = looked.first.pose
    assert width == pytest.approx(np.tan(first.fov / 2) * first.aspect, rel=0.01)
    assert any(frustum.visible for frustum in session._frusta)
    for frustum in session._frusta:
        away = np.linalg.norm(np.asarray(frustum.position) - session.pose.position)
        assert frustum.visible == (session._reach / away < 0.5 * width)
    page.get_by_text("settings", exact=True).click()
    page.locator('input[value="rgb"]').locator("visible=true").first.wait_for()


@once_more
def test_the_slider_moves_the_scene(shown):
    """By keys and by playing: what moves is elsewhere in the picture."""

    class Moving:
        def at(self, moment):
            sh = torch.tensor([[[-1.7, 1.7, -1.7]]])
            means = torch.tensor([[-0.75 + 0.4 * float(moment), 0.45, 0.2]])
            return blobs(means, sh=sh, scales=torch.full((1, 3), 0.06))

        def parameters(self):
            return {}

    looked = subject(torch.zeros(1, 3), scene=Moving(), times=(0.0, 0.5, 1.0))
    viewer, page = shown(looked)
    left = bright(page)[0]
    slider = page.get_by_role("slider").first
    slider.focus()
    session = session_of(viewer)
    count = session.drawn
    page.keyboard.press("End")
    rests(page, viewer, count)
    assert session.time == pytest.approx(1.0, abs=0.01)
    assert bright(page)[0] > left + 30
    page.get_by_role("button", name="play").click()
    seen = set()
    end = time.monotonic() + PATIENCE / 1000
    while len(seen) < 3 and time.monotonic() < end:
        seen.add(round(session.time, 2))
        page.wait_for_timeout(50)
    assert seen == {0.0, 0.5, 1.0}
    count = session.drawn
    page.get_by_role("button", name="pause").click()
    rests(page, viewer, count)


@once_more
def test_a_page_of_another_site_cannot_listen(shown, tmp_path):
    """A page that another port of this machine serves does not get the viewer's socket."""
    viewer, _ = shown(subject(torch.zeros(1, 3)))
    (tmp_path / "index.html").write_text("<p>another site</p>")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args, **options):
            super().__init__(*args, directory=str(tmp_path), **options)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        page = shown.browsers.browser().new_page()
        page.goto(f"http://127.0.0.1:{other.server_address[1]}/index.html")
        outcome = page.evaluate(
            """port => new Promise(done => {
                const socket = new WebSocket(`ws://127.0.0.1:${port}/`, "viser-v1.1.1");
                socket.onopen = () => done("open");
                socket.onerror = () => done("refused");
                setTimeout(() => done("no answer"), 60000);
            })""",
            viewer.port,
        )
        page.close()
        other.shutdown()
    assert outcome == "refused"
