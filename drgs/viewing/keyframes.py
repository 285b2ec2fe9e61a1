"""Camera paths made in the browser: keyframes at its camera, their path in the scene, a preview, and the file of them.

The file goes to the browser as a download: nothing is written where the viewer runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.data.camera_path import CameraPath, Keyframe, camera_path_json
from drgs.viewing import panel

if TYPE_CHECKING:
    import viser

# Chosen by eye.
_DEFAULT_STEP = 2.0  # seconds from a keyframe to the next
_SHORTEST, _LONGEST = 0.1, 600.0  # of such a step
_MAX_KEYFRAMES = 100  # keyframes; of the longest steps they are less long than a file may say
_PATH_SEGMENTS = 24  # line segments of the drawn path, from a keyframe to the next
_PATH_COLOR = (66, 135, 245)  # RGB of the path and its keyframes: the blue of photographs
_PREVIEW_FRAME = 1 / 20  # seconds a frame of a preview


class KeyframeFolder:
    """The folder of the panel in which a camera path is made.

    Args:
        client: viser's handle of the browser.
        here: Function that returns where the browser's camera is, in the world, as a keyframe at 0 seconds.
        go: Function that moves the browser's camera, and its time, to a keyframe; and whether it is the last one.
        origin: Function that returns (3,) world coordinates of the browser's 0.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        here: Callable[[], Keyframe],
        go: Callable[[Keyframe, bool], None],
        origin: Callable[[], np.ndarray],
    ) -> None:
        self.client = client
        self.keyframes: list[Keyframe] = []
        self._here = here
        self._go = go
        self._origin = origin
        self._line: Any = None
        self._preview: asyncio.Task | None = None
        gui = client.gui
        with gui.add_folder("flight", expand_by_default=False):
            self._text = gui.add_html("")
            self._step = gui.add_number(
                "seconds to the next",
                _DEFAULT_STEP,
                min=_SHORTEST,
                max=_LONGEST,
                step=0.1,
                hint="From the last keyframe to the one that is added.",
            )
            self._loop = gui.add_checkbox("loop", False, hint="Whether the flight goes back to its first keyframe.")
            self._add = gui.add_button("add keyframe", hint="Where the camera is now, at the time that is shown.")
            self._drop = gui.add_button("drop the last")
            self._fly = gui.add_button("fly")
            self._save = gui.add_button("save flight.json", hint="For drgs render --path flight.json.")
        self._add.on_click(self._added)
        self._drop.on_click(self._dropped)
        self._fly.on_click(self._flown)
        self._save.on_click(self._saved)
        self._loop.on_update(self._looped)
        self._show()

    @property
    def flight(self) -> CameraPath:
        """The flight through the keyframes, of which there must be one at least."""
        return CameraPath(tuple(self.keyframes), loop=bool(self._loop.value) and len(self.keyframes) > 1)

    @property
    def is_flying(self) -> bool:
        """Whether a preview is going on."""
        return self._preview is not None

    def close(self) -> None:
        """End a preview."""
        if self._preview is not None:
            if self._preview is not asyncio.current_task():
                self._preview.cancel()
            self._preview = None
            self._fly.label = "fly"
            self._show_line(True)

    def forget(self, has_times: bool) -> None:
        """The subject has changed: keyframes stay, unless they have times and it has none, or the reverse."""
        if self.keyframes and (self.keyframes[0].time is not None) != has_times:
            self.close()
            self.keyframes = []
            self._show()

    # ------------------------------------------------------------------------------------- callbacks

    async def _added(self, _: Any) -> None:
        self.close()
        if len(self.keyframes) >= _MAX_KEYFRAMES:
            return
        step = self._step.value
        step = float(step) if isinstance(step, int | float) and _SHORTEST <= step <= _LONGEST else _DEFAULT_STEP
        seconds = self.keyframes[-1].seconds + step if self.keyframes else 0.0
        self.keyframes.append(dataclasses.replace(self._here(), seconds=seconds))
        self._show()

    async def _dropped(self, _: Any) -> None:
        self.close()
        del self.keyframes[-1:]
        self._show()

    async def _looped(self, _: Any) -> None:
        self._show()

    async def _saved(self, _: Any) -> None:
        if self.keyframes:
            self.client.send_file_download("flight.json", camera_path_json(self.flight), save_immediately=True)

    async def _flown(self, _: Any) -> None:
        if self._preview is not None:
            self.close()
        elif len(self.keyframes) > 1:
            self._fly.label = "stop"
            self._show_line(False)  # it leads through the camera
            self._preview = asyncio.create_task(self._previewed(self.flight))

    async def _previewed(self, flight: CameraPath) -> None:
        """Fly once, at the pace of the flight."""
        began = time.monotonic()
        while (gone := (time.monotonic() - began) / flight.seconds) < 1:
            self._go(flight.at(np.array([gone]))[0], False)
            await asyncio.sleep(_PREVIEW_FRAME)
        self._go(flight.at(np.array([1.0]))[0], True)
        self.close()

    def _show_line(self, is_shown: bool) -> None:
        if self._line is not None:
            self._line.visible = is_shown

    def _show(self) -> None:
        """Update the panel's text, and draw the path."""
        count = len(self.keyframes)
        long = f", {self.flight.seconds:.1f} s" if count > 1 else ""
        self._text.content = panel.status(f"{count} keyframe{'' if count == 1 else 's'}{long}")
        self._add.disabled = count >= _MAX_KEYFRAMES
        for button, least in ((self._drop, 1), (self._fly, 2), (self._save, 1)):
            button.disabled = count < least
        if self._line is not None:
            self._line.remove()
            self._line = None
        if count < 2:
            return
        shares = np.linspace(0.0, 1.0, _PATH_SEGMENTS * count)
        way = np.array([key.position for key in self.flight.at(shares)]) - self._origin()
        with contextlib.suppress(RuntimeError):  # the browser has gone
            self._line = self.client.scene.add_line_segments(
                "/flight", np.stack([way[:-1], way[1:]], axis=1), _PATH_COLOR, thickness=2.0, thickness_units="screen"
            )
            self._show_line(not self.is_flying)
