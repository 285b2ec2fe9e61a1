"""The viewer: viser behind the gate, with a session for every browser."""

from __future__ import annotations

import contextlib
import functools
import gc
import io
import logging
from collections.abc import Hashable, Iterator
from typing import Any

from drgs.viewing.gate import Gate
from drgs.viewing.gated_viser import bound_socket, gated_server, in_a_line
from drgs.viewing.layers import PhotographMap
from drgs.viewing.session import Session
from drgs.viewing.subject import Subject
from drgs.viewing.worker import Worker

_log = logging.getLogger(__name__)

_NEAR = 1e-3  # times the distance to the orbit center: where the client's pictures begin
# Times that distance: where they end. A skybox is up to 200 extents of the cameras away, of which the orbit distance
# may be a small part. What is near is resolved by the nearer number alone.
_FAR = 1e5
# Keys of jobs that can wait; that of a map has the layer's name, too.
_MAP_JOB = "map of photographs"
_FREEING_JOB = "memory of closed browsers"


class Viewer:
    """A viewer that listens from the time it is made.

    Args:
        subject: The subject that is shown first.
        host: Name or address to listen at.
        port: Port to listen at; 0 is any that is free.
        token: Token that a browser must know; None: none on this machine, else one that is made up.
        preset: Preset that our pictures are drawn by at first.
        pixels: Largest number of pixels of a picture.
    Raises:
        ValueError: If there is no such address, the port is taken, or the token is none.
    """

    def __init__(
        self,
        subject: Subject,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        preset: str = "exact",
        pixels: int = 500_000,
    ) -> None:
        listening = bound_socket(host, port)
        try:
            self.port = listening.getsockname()[1]
            self.gate = Gate.of(host, self.port, token)
            self.address = self.gate.address(host, self.port)
            self.subject = subject
            self._preset = preset
            self._pixels = pixels
            self.sessions: dict[int, Session] = {}
            self._latest_complete: dict[str, Subject] = {}  # layer -> the last one whose map is complete
            self._server = gated_server(self.gate, listening, host)
        except BaseException:
            listening.close()
            raise
        self._server.get_event_loop().set_exception_handler(self._on_loop_error)
        self.worker = Worker(self._failed)
        self._place()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    def replace(self, subject: Subject) -> None:
        """Show another subject in all browsers. From any thread."""
        self.subject = subject
        self._each(lambda session: session.show(subject))

    def say(self, text: str) -> None:
        """Say something in all panels. From any thread."""
        self._each(lambda session: session.say(text))

    def stop(self, seconds: float = 1.0) -> bool:
        """Close everything; whether nothing is being computed any more."""
        self._each(lambda session: session.close())
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it has stopped
            self._server.stop()
        return self.worker.close(seconds)

    def _place(self) -> None:
        """Set viser's first camera and the page's appearance."""
        subject, server = self.subject, self._server
        first = subject.first
        bright = sum(subject.background) > 1.5
        server.gui.configure_theme(dark_mode=not bright, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("drgs view")
        server.scene.set_up_direction(first.up)
        camera = server.initial_camera
        camera.position = first.pose.position
        camera.look_at = first.target
        camera.up = first.up
        camera.fov = first.pose.fov
        distance = first.distance or 1.0
        camera.near = _NEAR * distance
        camera.far = _FAR * distance

    async def _connected(self, client: Any) -> None:
        self.sessions[client.client_id] = Session(
            client,
            self.subject,
            self.worker,
            self._preset,
            self._pixels,
            self._need_map,
            self._latest_complete.get,
        )

    async def _disconnected(self, client: Any) -> None:
        if session := self.sessions.pop(client.client_id, None):
            session.close()
            self.worker.put(_FREEING_JOB, self._freeing(), can_wait=True)

    @staticmethod
    def _freeing() -> Iterator[None]:
        """Job: free what a browser that has gone leaves. viser's handles and a session hold each other, the Gaussians
        and the pictures that were sent with them, and Python by itself looks for such circles too late: tens of
        browsers' were kept."""
        gc.collect()
        yield

    def _need_map(self, name: str) -> None:
        """Begin to look at the photographs for a layer, unless that is done or under way."""
        shown = self.subject.maps.get(name)
        if shown is not None and not shown.is_complete and not self.worker.has((_MAP_JOB, name)):
            self.worker.put((_MAP_JOB, name), self._looking(name), can_wait=True)

    def _looking(self, name: str) -> Iterator[None]:
        """Job: what photographs say for a layer; panels that show it say how far it is.

        What was begun of a checkpoint is finished though a fit has gone on since, and its map shown; then it is the
        newest one's turn. A fit that saves faster than this would else never have a map.
        """
        while True:
            subject = self.subject
            if (looked := subject.maps.get(name)) is None or looked.is_complete:
                return
            say_progress = functools.partial(self._say_progress, subject, looked)
            say_progress()
            yield
            shown = looked.has_map
            for _ in looked.add_views(say_progress, sketch=name not in self._latest_complete):
                if looked.has_map and not looked.is_complete and not shown:
                    shown = True
                    self._redraw(name)
                yield
            self._latest_complete[name] = subject
            self._redraw(name)
            if not self._waiting(name):
                return

    def _redraw(self, name: str) -> None:
        """Draw the map once more in each browser that shows it."""
        self._each(lambda session: session.redraw() if session.layer.name == name else None)

    def _say_progress(self, subject: Subject, looked: PhotographMap) -> None:
        """Say in the panels of those who wait for it how many photographs have been added."""
        of = f" of {subject.state}" if subject.state else ""
        if looked.has_map and not looked.is_complete:
            of += ", a sketch of few pixels"
        for session in self._waiting(looked.name):
            session.say(f"{looked.name}{of}: {looked.done} of {looked.count} photographs added", session.scale)

    def _waiting(self, name: str) -> list[Session]:
        return [session for session in list(self.sessions.values()) if session.layer.name == name]

    def _each(self, call: Any) -> None:
        """Call a function with each session, on viser's event loop."""

        def run() -> None:
            for session in list(self.sessions.values()):
                call(session)

        with contextlib.suppress(RuntimeError):  # the loop has ended: there is nobody left
            self._server.get_event_loop().call_soon_threadsafe(run)

    @staticmethod
    def _on_loop_error(_: Any, context: dict[str, Any]) -> None:
        """Log one line where viser, or a session, could not handle a browser's message."""
        error = context.get("exception")
        _log.warning("view: %s", context.get("message") if error is None else in_a_line(error))

    def _failed(self, key: Hashable, error: Exception) -> None:
        """A job has ended by an error: said in the log, and in the panel of the browser that it was for."""
        text = str(error) or type(error).__name__
        if not isinstance(error, (ValueError, OSError, NotImplementedError)):
            _log.warning("view: %s", text, exc_info=error)
        else:
            _log.warning("view: %s", text)
        if isinstance(key, tuple) and isinstance(key[0], Session):
            key[0].say(text)
        else:
            self.say(text)
