"""Claims of the page of `drgs share` in a real browser: it draws as our `gsplat`, and its controls do what they say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("playwright", reason="no playwright: pip install playwright")
pytest.importorskip("viser", reason="no viser: pip install 'drgs[view]'")  # what drives the browser is of its tests

from test_share import blobs
from test_view_browser import PATIENCE, browsers, once_more  # noqa: F401 (a fixture)

from drgs.cameras import Camera, intrinsics, look_at
from drgs.codecs import load_gaussians
from drgs.codecs.sog import encode_sog
from drgs.integrator import render
from drgs.pages.sharing import npm
from drgs.pages.sharing.layers import GaussianScale
from drgs.pages.sharing.write import Shared, write_page
from drgs.settings import RenderSettings

WIDTH, HEIGHT = 480, 320
BACKGROUND = (0.2, 0.3, 0.1)
GSPLAT = RenderSettings.preset("gsplat", background=BACKGROUND)


class Pages:
    """Opens pages from disk, and looks at what they complained of."""

    def __init__(self, browsers) -> None:  # noqa: F811
        self.browsers = browsers
        self._opened: list = []

    def __call__(self, path, fragment: str = "bare", width: int = WIDTH, height: int = HEIGHT):
        page = self.browsers.browser().new_page(viewport={"width": width, "height": height})
        self._opened.append((page, errors := []))
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: errors.append(request.url) if "://" in request.url[:8] else None)
        page.goto(f"{path.as_uri()}#{fragment}")
        page.wait_for_selector("body[data-state]", state="attached")
        settle(page)
        return page

    def end(self) -> None:
        """Close all."""
        opened, self._opened = self._opened, []
        for page, errors in opened:
            if not self.browsers.is_hung:
                page.close()
            assert all(error.startswith("file:///") and error.partition("#")[0].endswith(".html") for error in errors)


@pytest.fixture
def shown(browsers):  # noqa: F811
    try:
        npm.viewer_files()
    except OSError as error:
        pytest.skip(str(error))
    made = Pages(browsers)
    yield made
    with browsers.watched():
        made.end()


def settle(page) -> None:
    """Wait until nothing is left to be sorted or drawn."""
    page.wait_for_timeout(50)  # events of a mouse or a key may come a little later
    page.wait_for_selector("body[data-state=settled], body[data-state=failed]", state="attached")
    assert page.evaluate("document.body.dataset.state") == "settled", page.inner_text("#message")


def picture(page) -> np.ndarray:
    """(H, W, 3) RGB in [0, 1] of the page."""
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0


def camera(name: str, eye, **fields) -> Camera:
    """One that looks at the middle, its own optical axis off the middle of its picture."""
    K = intrinsics(420.0, 400.0, 0.55 * WIDTH, 0.47 * HEIGHT)
    given = {"K": K, "w2c": look_at(eye, (0, 0, 0), (0, -1, 0.2)), "width": WIDTH, "height": HEIGHT, "name": name}
    return Camera(**given | fields)


CAMERAS = [camera("a", (0.5, -0.6, -2.5)), camera("in the midst", (0.2, 0.1, -0.6)), camera("c", (2.0, -1.5, 1.0))]


def shared(g, **fields) -> Shared:
    given = {"title": "blobs", "lines": (), "gaussians": g, "cameras": [("fitted", c) for c in CAMERAS]}
    return Shared(**given | {"target": np.zeros(3), "up": np.array([0, -1.0, 0]), "background": BACKGROUND} | fields)


def ours(g, at: Camera) -> np.ndarray:
    with torch.no_grad():  # a picture
        return render(g, at, GSPLAT).rgb.clamp(0, 1).cpu().numpy()


def decibels(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(image - other).mean()))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@once_more
def test_it_draws_as_our_gsplat_does(shown, tmp_path, degree):
    """The Gaussians that the archive holds, at photographs' cameras: within the rounding to 8 bits, also in the
    midst of them, where those beside the picture are large. Those that went into the archive: 40 dB."""
    g = blobs(2000, degree)
    write_page(shared(g), tmp_path / "x.html")
    (tmp_path / "x.sog").write_bytes(encode_sog(g))
    held = load_gaussians(tmp_path / "x.sog")
    for at in CAMERAS[:2] if degree == 3 else CAMERAS[2:]:
        image = picture(shown(tmp_path / "x.html", f"bare&photo={at.name}"))
        assert decibels(image, ours(held, at)) > 50
        assert decibels(image, ours(g, at)) > 40


@once_more
def test_classes_and_layers(shown, tmp_path):
    """A class that is switched off is not drawn, in its colors or in those of a layer, and one that is switched on
    again is; a layer has the colors of its table."""
    g = blobs(400, 1)
    labels = np.where(g.means[:, 0].numpy() < 0, 1, 2)
    classes = {"names": ["left", "right"], "colors": [[0, 0, 0], [255, 0, 0], [0, 0, 255]]}, labels
    scale = GaussianScale("error", "a number of 1", np.geomspace(1e-3, 1e-1, len(g)))
    write_page(shared(g, classes=classes, scale=scale), tmp_path / "x.html")
    page = shown(tmp_path / "x.html", "photo=a", 1200, 400)
    clip = {"x": 500, "y": 0, "width": 600, "height": 400}  # beside the panel

    def seen() -> np.ndarray:
        settle(page)
        return cv2.imdecode(np.frombuffer(page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0

    everything = seen()
    page.get_by_text("classes", exact=True).first.click()
    box = page.get_by_label("left", exact=True)
    box.uncheck()
    half = seen()
    assert np.abs(half - everything).max() > 0.3
    layer = page.get_by_label("layer")
    layer.select_option("classes")
    blue = seen()
    background = np.array(BACKGROUND)
    drawn = np.abs(blue - background).max(2) > 0.3
    assert drawn.any()
    assert (blue[drawn][:, 0] < 0.25).all()  # nothing of the red class
    box.check()
    assert (seen()[..., 0] > 0.6).any()
    layer.select_option("error")
    assert page.get_by_text("a number of 1").is_visible()
    layer.select_option("colors")
    np.testing.assert_array_equal(seen(), everything)


@once_more
def test_cameras_and_keys(shown, tmp_path):
    """A tap on a camera goes to it, and the list says its name; keys move the camera; a drag turns it around what it
    looks at, upright."""
    g = blobs(200, 0)
    far = [camera("left", (-0.8, 0, 0.5)), camera("right", (0.8, 0, 0.5)), camera("first", (0, 0, -3.0))]
    write_page(shared(g, cameras=[("fitted", x) for x in far]), tmp_path / "x.html")
    page = shown(tmp_path / "x.html", "cameras&photo=first", 1000, 600)
    list_of_photos = page.get_by_label("photograph")
    first = picture(page)
    scale = min(1000 / WIDTH, 600 / HEIGHT)
    spot = (far[2].project(far[1].center[None])[0][0] - [WIDTH / 2, HEIGHT / 2]) * scale + [500, 300]
    page.mouse.click(*spot)
    settle(page)
    assert list_of_photos.evaluate("box => box.selectedOptions[0].textContent") == "right"
    assert np.abs(picture(page) - first).max() > 0.2
    page.get_by_text("back to the photograph").click()
    list_of_photos.select_option(label="first")
    settle(page)
    page.mouse.move(990, 590)  # off the controls
    np.testing.assert_array_equal(picture(page)[:, 400:], first[:, 400:])
    page.locator("canvas").focus()
    page.keyboard.down("w")
    page.wait_for_timeout(400)
    page.keyboard.up("w")
    settle(page)
    near = picture(page)
    assert np.abs(near - first)[:, 400:].max() > 0.1
    page.mouse.move(700, 500)
    page.mouse.down()
    page.mouse.move(760, 480, steps=4)
    page.mouse.up()
    settle(page)
    assert np.abs(picture(page) - near)[:, 400:].max() > 0.1


@once_more
def test_a_phone_sees_it(shown, tmp_path):
    """At 390x844 the panel is folded, opens, and leaves most of the window free."""
    write_page(shared(blobs(200, 0)), tmp_path / "x.html")
    page = shown(tmp_path / "x.html", "", 390, 844)
    box = page.locator("#panel").bounding_box()
    assert box["height"] < 80
    page.locator("#panel summary").first.click()
    box = page.locator("#panel").bounding_box()
    assert box["x"] + box["width"] <= 390
    assert box["height"] < 400
