"""One browser: its layer, its camera, and the pictures that it is sent.

While the camera moves the client draws Gaussians by itself. Where it rests for a moment our own picture is drawn, a
small one first, and lies behind everything else in the scene, whose Gaussians are hidden as long. All methods but
those that say otherwise run on viser's event loop, one after the other.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import math
import threading
import time
from collections.abc import Callable, Generator, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.data.camera_path import Keyframe
from drgs.display.pictures import to_bytes
from drgs.display.progress import duration
from drgs.viewing import panel
from drgs.viewing.client import ClientGaussians, Pose, camera_of, looking, pose_of
from drgs.viewing.keyframes import KeyframeFolder
from drgs.viewing.layers import ColorScale, Drawing, Drawings, Layer, over, stages, tinted
from drgs.viewing.placed_views import PlacedView, score_colors

if TYPE_CHECKING:
    import viser

    from drgs.cameras import Camera
    from drgs.viewing.subject import Subject
    from drgs.viewing.worker import Worker

REST = 0.3
"""Seconds that a camera rests before our picture is drawn."""

_PRESETS = ("exact", "fast", "gsplat", "3dgut")
# Sizes and seconds are chosen by eye.
_ROWS_INTERVAL = 1.0  # seconds between two updates of a picture that is being drawn
_PHOTO_WIDTH = 360  # pixels of a photograph's width in the panel
_ARROW_COLOR = (240, 60, 60)  # RGB of the arrow to a place for a next photograph
_FRUSTUM_SIZE = 0.05  # size of a camera's frustum, of its distance to the point that the view turns around
_MAX_FRUSTUM_COVER = 0.5  # share of half the view's narrower side: a frustum that reaches farther is hidden
_NARROW_WINDOW = 576  # pixels of a window's width up to which viser lays its panel over the view, as on a phone
_MAX_PLAYED_TIMES = 48  # times in one round of playing, at most
_FOV_RANGE = 1.0, 150.0  # degrees of a keyframe's field of view
_DEFAULT_WINDOW = 640, 480  # pixels of a window that has not reported its size
_PLAY_INTERVAL = 0.08  # seconds between two times that are played, at least: twelve a second


class Session:
    """A browser that has connected.

    Args:
        client: viser's handle of the browser.
        subject: The scene or run that is shown.
        worker: The thread that computes.
        preset: Preset that our pictures are drawn by at first.
        pixels: Largest number of pixels of a picture.
        need_map: Function that is called with the name of a layer which needs a map that is not complete.
        latest_complete: Function that returns the last subject whose map of a layer is complete; None before there is
            one.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        subject: Subject,
        worker: Worker,
        preset: str,
        pixels: int,
        need_map: Callable[[str], None],
        latest_complete: Callable[[str], Subject | None],
    ) -> None:
        self.client = client
        self.subject = subject
        self._worker = worker
        self._pixels = pixels
        self._need_map = need_map
        self._latest_complete = latest_complete
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()  # of what follows: the worker's thread reads whether its picture is still wanted
        self._wanted = 0  # number of the picture that is wanted; another one's is left
        self._is_closed = False
        self.drawn = 0  # pictures that were drawn to the end
        self._is_over = False  # our picture lies there, and the Gaussians are hidden
        self.scale: ColorScale | None = None  # of the picture that lies there
        self._gaussians: Any = None
        self._timer: asyncio.TimerHandle | None = None
        self._playing: asyncio.Task | None = None
        self._frusta: list[Any] = []
        self._reach = 0.0  # of a frustum, from its tip
        self._ways: Any = None  # arrows to places for next photographs
        self.time = subject.nearest_time(None)
        self._slider: Any = None
        self._button: Any = None
        self.pose, self.size = self._client_pose() or (subject.first.pose, _DEFAULT_WINDOW)
        self._has_begun = False  # has been at the first view
        self._widen()
        self._build(preset)
        self._send_gaussians()
        self._show_placed_views()
        self._draw_later()
        client.camera.on_update(self._camera_moved)

    def _widen(self) -> None:
        """Once the browser is at the first view: see all of its width in a window taller than that, as a phone's."""
        first, distance = self.subject.first.pose, self.subject.first.distance
        is_there = float(np.linalg.norm(self.pose.position - first.position)) <= 1e-3 * distance
        if self._has_begun or not is_there:
            return
        self._has_begun = True
        if self.pose.aspect < first.aspect:
            fov = looking(first, self.pose.aspect)
            self.client.camera.fov = fov
            self.pose = dataclasses.replace(self.pose, fov=fov)

    # ---------------------------------------------------------------------------------------- panel

    def _build(self, preset: str) -> None:
        """Build the panel."""
        gui = self.client.gui
        subject = self.subject
        is_narrow = self.size[0] <= _NARROW_WINDOW
        self._header = gui.add_html(panel.header(subject))
        names = [layer.name for layer in subject.layers]
        presets = list(dict.fromkeys([preset, *_PRESETS]))
        # Over a narrow window viser's panel lies open, over the picture: what is in it is folded instead.
        with gui.add_folder("settings", expand_by_default=False) if is_narrow else contextlib.nullcontext():
            self._layer = gui.add_dropdown("show", names, initial_value=names[0], hint=subject.layers[0].hint)
            self._preset = gui.add_dropdown(
                "drawn by", presets, initial_value=preset, hint="Settings of our picture, where the camera rests."
            )
            self._ours = gui.add_checkbox(
                "our picture", True, hint="Where the camera rests; else only what the browser draws by itself."
            )
        self._status = gui.add_html(panel.status(""))
        self._build_times()
        folder = gui.add_folder("cameras", visible=bool(subject.placed_views), expand_by_default=not is_narrow)
        with folder as self._cameras:
            self._are_shown = gui.add_checkbox("show", True, hint="Click on one to fly there.")
            self._legend = gui.add_html("")
        with gui.add_folder("view", visible=False) as self._view:
            self._about = gui.add_html("")
            self._photograph = gui.add_image(np.zeros((2, 2, 3), np.uint8), visible=False)
        self._flight = KeyframeFolder(self.client, self._keyframe, self._fly_to, lambda: self.subject.origin)
        for handle in (self._layer, self._preset, self._ours):
            handle.on_update(self._choice_made)
        self._are_shown.on_update(self._placed_views_toggled)

    def _build_times(self) -> None:
        """Build the slider and the button of what moves; neither where nothing does, or no longer."""
        gui, times = self.client.gui, self.subject.times
        self._stop_playing()
        for handle in (self._slider, self._button):
            if handle is not None:
                handle.remove()
        self._slider = self._button = None
        if len(times) < 2:
            return
        step = (times[-1] - times[0]) / 1000
        self._slider = gui.add_slider("time", times[0], times[-1], step, self.time)
        self._button = gui.add_button("play")
        self._slider.on_update(self._time_chosen)
        self._button.on_click(self._play_clicked)

    def show(self, subject: Subject) -> None:
        """Look at another subject, from where the camera is."""
        before = self.subject
        self.subject = subject
        self._header.content = panel.header(subject)
        names = tuple(layer.name for layer in subject.layers)
        if names != tuple(self._layer.options):
            self._layer.options = names
        if keeps := self._lacks_map() and self._latest_complete(self.layer.name) is not None:
            # An earlier checkpoint's map, and what is half drawn of it, stays until there is another.
            self._need_map(self.layer.name)
        else:
            self._hide()
        self.time = subject.nearest_time(self.time)
        self._flight.forget(len(subject.times) > 0)
        if subject.times != before.times:
            self._build_times()
        self._send_gaussians()
        has_moved = not np.array_equal(subject.origin, before.origin)
        if has_moved:  # the client's 0, but not where its camera is in the world
            self.client.camera.position = self.pose.position + before.origin - subject.origin
            self.pose, self.size = self._client_pose() or (self.pose, self.size)
        if has_moved or subject.placed_views is not before.placed_views:
            self._show_placed_views()
        if not keeps:
            self._draw_later()

    def say(self, text: str, scale: ColorScale | None = None) -> None:
        """Show a line of status in the panel. From any thread."""
        if not self._is_closed:
            self._status.content = panel.status(text, scale)

    def redraw(self) -> None:
        """Draw what is shown once more: something that it needs has become known."""
        self._draw_later(0.0)

    def close(self) -> None:
        """The browser has gone."""
        if self._timer:
            self._timer.cancel()
        if self._playing:
            self._playing.cancel()
        self._flight.close()
        with self._lock:
            self._wanted += 1
            self._is_closed = True
        for job in ("picture", "gaussians", "photograph"):
            self._worker.drop((self, job))

    # ------------------------------------------------------------------------------------- callbacks

    async def _choice_made(self, _: Any) -> None:
        layer = self.layer
        self._layer.hint = layer.hint
        self._hide()
        self._send_gaussians()
        self._draw_later(0.0)

    async def _camera_moved(self, _: Any) -> None:
        seen = self._client_pose()
        if seen is None:  # not a camera: what is shown stays
            return
        pose, size = seen
        if pose.is_near(self.pose) and size == self.size:
            return
        self.pose = pose
        self.size = size
        self._widen()
        self._show_frusta()
        self._hide()
        self._draw_later()

    async def _time_chosen(self, _: Any) -> None:
        if self._slider is None:  # what the browser sent before it knew that nothing moves any longer
            return
        wanted = self.subject.nearest_time(float(self._slider.value))
        if wanted != self.time:
            self.time = wanted
            self._hide()
            self._send_gaussians()
            self._draw_later()

    async def _play_clicked(self, _: Any) -> None:
        if self._button is None:  # as above
            return
        if self._playing is not None:
            self._stop_playing()
            self._draw_later()
            return
        self._button.label = "pause"
        self._playing = asyncio.create_task(self._play())

    def _stop_playing(self) -> None:
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
            self._button.label = "play"

    async def _play(self) -> None:
        """Go through all times, again and again, as fast as the Gaussians of each can be sent."""
        assert self._slider is not None
        first, last = self.subject.times[0], self.subject.times[-1]
        count = min(_MAX_PLAYED_TIMES, len(self.subject.times))
        times = np.linspace(first, last, max(count, 2))
        at = int(np.searchsorted(times, self.time or first))
        while True:
            at = (at + 1) % len(times)
            self.time = float(times[at])
            self._slider.value = self.time
            self._hide()
            self._send_gaussians()
            await asyncio.sleep(_PLAY_INTERVAL)
            while self._worker.has((self, "gaussians")):
                await asyncio.sleep(0.02)

    async def _placed_views_toggled(self, _: Any) -> None:
        self._show_frusta()

    # -------------------------------------------------------------------------------------- cameras

    def _show_placed_views(self) -> None:
        """Draw a frustum for each place, in the color of its score."""
        for frustum in self._frusta:
            frustum.remove()
        subject = self.subject
        self._frusta = []
        colors, _ = score_colors(subject.placed_views)
        self._cameras.visible = bool(subject.placed_views)
        self._legend.content = panel.legend(subject.placed_views, subject.ranking.title if subject.ranking else "")
        eyes = np.array([placed.camera.center - subject.origin for placed in subject.placed_views]).reshape(-1, 3)
        away = np.linalg.norm(eyes - subject.first.target, axis=1)
        size = _FRUSTUM_SIZE * (float(np.median(away)) if len(away) else 1.0) or 1.0
        for number, (placed, color) in enumerate(zip(subject.placed_views, colors, strict=True)):
            pose = pose_of(placed.camera, subject.origin)
            frustum = self.client.scene.add_camera_frustum(
                f"/cameras/{number}",
                pose.fov,
                pose.aspect,
                scale=size,
                thickness=1.5,
                thickness_units="screen",
                color=color,
                wxyz=pose.wxyz,
                position=pose.position,
                variant="filled",
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(self._clicked(placed))
            self._frusta.append(frustum)
        self._reach = size
        self._show_ways(size)
        self._show_frusta()

    def _show_ways(self, size: float) -> None:
        """Draw an arrow to each proposed next photograph, from the photograph that its directions refer to.

        Args:
            size: Reach of a frustum.
        """
        if self._ways is not None:
            self._ways.remove()
            self._ways = None
        picked = [sight for placed in self.subject.placed_views if (sight := placed.best).pick and sight.way]
        if not picked:
            return
        ends = [(np.array(sight.way.origin), sight.camera.center) for sight in picked if sight.way]
        points = np.array(ends, np.float64) - self.subject.origin
        self._ways = self.client.scene.add_arrows(
            "/ways",
            points.astype(np.float32),
            _ARROW_COLOR,
            shaft_radius=0.06 * size,
            head_radius=0.2 * size,
            head_length=0.5 * size,
        )

    def _show_frusta(self) -> None:
        """Show all frusta, or none, but for those that the camera stands in or near: they would cover what it sees."""
        near = self._reach / (_MAX_FRUSTUM_COVER * math.tan(0.5 * self.pose.fov) * min(1.0, self.pose.aspect))
        for frustum in self._frusta:
            away = float(np.linalg.norm(np.asarray(frustum.position) - self.pose.position))
            shown = self._are_shown.value and away > near
            if frustum.visible != shown:
                frustum.visible = shown
        if self._ways is not None and self._ways.visible != self._are_shown.value:
            self._ways.visible = self._are_shown.value

    def _clicked(self, placed: PlacedView) -> Callable[[Any], Any]:
        """Handle a click on a frustum."""

        async def clicked(_: Any) -> None:
            self.visit(placed)

        return clicked

    def visit(self, placed: PlacedView) -> None:
        """Fly to a place, and show what is known of it, with its photograph."""
        sight = placed.at(self.time)
        camera = self.client.camera
        pose = pose_of(sight.camera, self.subject.origin)
        with self.client.atomic():
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            camera.fov = looking(pose, self.size[0] / self.size[1])
        self.pose, self.size = self._client_pose() or (pose, self.size)  # what it sends back is no movement of its own
        self._show_frusta()
        if self._slider is not None and sight.camera.time is not None and self._playing is None:
            self._slider.value = self.subject.nearest_time(sight.camera.time)
        self._hide()
        self._draw_later()
        self._about.content = panel.photograph(placed, sight)
        self._view.visible = True
        self._photograph.visible = False
        if sight.photograph is not None:
            self._worker.put((self, "photograph"), self._read_photograph(sight.photograph))

    def _keyframe(self) -> Keyframe:
        """Where the camera is, as a keyframe of a flight."""
        pose = self.pose
        wxyz = pose.wxyz / np.linalg.norm(pose.wxyz)
        fov = float(np.clip(math.degrees(pose.fov), *_FOV_RANGE))
        return Keyframe(pose.position + self.subject.origin, wxyz, fov, 0.0, self.time)

    def _fly_to(self, key: Keyframe, is_last: bool) -> None:
        """Move the camera to a moment of a flight; what moves goes along as fast as it can be sent."""
        camera = self.client.camera
        with self.client.atomic():
            camera.position = key.position - self.subject.origin
            camera.wxyz = key.wxyz
            camera.fov = math.radians(key.fov)
        self.pose, self.size = self._client_pose() or (self.pose, self.size)
        self._hide()
        if self._slider is not None and key.time is not None:
            self._stop_playing()
            if is_last or not self._worker.has((self, "gaussians")):
                self._slider.value = self.subject.nearest_time(key.time)
        self._draw_later()

    def _read_photograph(self, read: Callable[[int], np.ndarray]) -> Iterator[None]:
        """Job: a photograph into the panel."""
        try:
            image = to_bytes(read(_PHOTO_WIDTH))
        except (OSError, ValueError) as error:
            self.say(str(error))
            return
        if self._is_closed:
            return
        self._photograph.image = image
        self._photograph.visible = True
        yield

    # ------------------------------------------------------------------------------------- pictures

    @property
    def layer(self) -> Layer:
        """The layer that is shown."""
        return self.subject.layer(self._layer.value)

    def _send_gaussians(self) -> None:
        self._worker.put((self, "gaussians"), self._gaussians_sent(self.subject, self.layer, self.time))

    def _gaussians_sent(self, subject: Subject, layer: Layer, time: float | None) -> Iterator[None]:
        """Job: the Gaussians of a time to the client, in the colors of the layer where it has any for them."""
        at_time = subject.scene.at(time)
        gaussians = ClientGaussians.of(at_time, tinted(layer, at_time))
        arrays = gaussians.centers, gaussians.covariances, gaussians.rgbs, gaussians.opacities
        with self._lock, self.client.atomic():
            if self._is_closed:
                return
            if self._gaussians is None:
                self._clear()
                self._gaussians = self.client.scene.add_gaussian_splats(
                    "/gaussians", *arrays, scale=gaussians.scale, visible=not self._is_over
                )
            else:
                self._gaussians.scale = gaussians.scale
                self._gaussians.set_gaussians(*arrays)
        yield

    def _clear(self) -> None:
        """Leave nothing behind the Gaussians but the background. From any thread, with the lock."""
        plain = np.broadcast_to(to_bytes(np.array(self.subject.background, np.float32)), (2, 2, 3))
        self.client.scene.set_background_image(np.ascontiguousarray(plain), format="png")

    def _hide(self) -> None:
        """Remove our picture: the camera has moved on."""
        if self._timer:
            self._timer.cancel()
        self._worker.drop((self, "picture"))
        with self._lock:
            self._wanted += 1
            if self._is_over:
                self._is_over = False
                self.scale = None
                with self.client.atomic():
                    self._clear()
                    if self._gaussians is not None:
                        self._gaussians.visible = True

    def _draw_later(self, seconds: float = REST) -> None:
        """Have our picture drawn if nothing happens for some time."""
        if self._timer:
            self._timer.cancel()
        self._timer = self._loop.call_later(seconds, self._draw)

    def _draw(self) -> None:
        """Have our picture drawn."""
        if self._playing is not None:
            return
        if not self._ours.value:
            self.say("")
            return
        subject = self.subject
        if self._lacks_map():
            name = self.layer.name
            self._need_map(name)
            earlier = self._latest_complete(name)
            if earlier is not None and name in earlier.maps:
                subject = earlier
            elif not subject.maps[name].has_map:
                return
        with self._lock:
            self._wanted += 1
            wanted = self._wanted
        # What is drawn is settled here: when the job begins, another subject may be shown, at another time.
        pose = dataclasses.replace(self.pose, position=self.pose.position + self.subject.origin)
        whole = camera_of(pose, *self.size, np.zeros(3), subject.nearest_time(self.time))
        steps = self._picture(wanted, subject, whole, subject.layer(self.layer.name), self._preset.value)
        self._worker.put((self, "picture"), steps)

    def _picture(self, wanted: int, subject: Subject, whole: Camera, layer: Layer, preset: str) -> Iterator[None]:
        """Job: pictures of what the camera sees, each larger than the one before."""
        began = time.perf_counter()
        settings = subject.settings(preset).for_pictures()
        rate = 0.0
        before: np.ndarray | None = None
        of = f" of {subject.state}" if subject is not self.subject and subject.state else ""
        for camera in stages(whole, min(self._pixels, layer.pixels or self._pixels)):
            text = f"{layer.name}{of}, {preset}: "
            pixels = camera.width * camera.height
            since = time.perf_counter()
            drawing = yield from self._with_progress(
                layer.draw(subject.scene, camera, settings),
                f"{text}drawing {camera.width}x{camera.height}",
                rate * pixels,
                functools.partial(self._show_rows, wanted, before, camera.height),
            )
            rate = (time.perf_counter() - since) / pixels
            if not self._show(wanted, drawing.picture, drawing.scale):
                return
            before = drawing.picture
            took = time.perf_counter() - began
            self.say(f"{text}{camera.width}x{camera.height} in {took:.1f} s", drawing.scale)
            yield
        self.drawn += 1

    def _show(self, wanted: int, picture: np.ndarray, scale: ColorScale | None) -> bool:
        """Lay a picture behind everything, in place of the Gaussians, unless another one is wanted; whether it is."""
        with self._lock:
            if wanted != self._wanted:
                return False
            self._is_over = True
            self.scale = scale
            with self.client.atomic():
                self.client.scene.set_background_image(picture, format="png")
                if self._gaussians is not None:
                    self._gaussians.visible = False
        return True

    def _show_rows(self, wanted: int, before: np.ndarray | None, height: int, rows: np.ndarray) -> None:
        """Lay the rows that are done over the smaller picture that lies there, if one does."""
        if before is not None:
            self._show(wanted, over(before, rows, height), self.scale)

    def _with_progress(
        self, steps: Drawings, text: str, expected: float, show: Callable[[np.ndarray], None]
    ) -> Generator[None, None, Drawing]:
        """Steps of a drawing, with its progress and the remaining time in the panel.

        Args:
            text: Name of what is drawn.
            expected: Seconds that it takes by the pixels of a picture before it; 0 where there was none.
            show: Shows the rows that are done, now and then.
        """
        self.say(f"{text}, about {duration(max(expected, 1))} ..." if expected else f"{text} ...")
        began = shown = time.perf_counter()
        while True:
            try:
                share, rows = next(steps)
            except StopIteration as end:
                return end.value
            now = time.perf_counter()
            left = (now - began) * (1 - share) / share
            if share < 1:
                if rows is not None and now - shown >= _ROWS_INTERVAL:
                    show(rows)
                    shown = now
                self.say(f"{text}: {share:.0%}, about {duration(max(left, 1))} left ...")
            yield

    def _lacks_map(self) -> bool:
        """Whether the layer shows what photographs say, and some have not been looked at."""
        shown = self.subject.maps.get(self.layer.name)
        return shown is not None and not shown.is_complete

    def _client_pose(self) -> tuple[Pose, tuple[int, int]] | None:
        """Pose of the client's camera and pixels of its window; None where it has reported no valid one."""
        camera = self.client.camera
        return Pose.stated(camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height)
