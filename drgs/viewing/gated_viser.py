"""viser's server behind the gate: the one module that uses private names of viser.

viser 1.1 has no public way to check a request before it is answered, to listen on a socket that is bound already, or to
refuse a tunnel. So, while its server starts, the name `websockets` in `viser.infra._infra` stands for a module whose
`serve` is ours (`guarded`): with the gate in front of viser's own handler, on our socket, and with an answer to what is
no request of HTTP. And the handlers of two private messages, by which a browser opens and closes a tunnel, are removed
(`gated_server`). pyproject.toml pins viser below 1.2; another version in which this does not hold raises, and
tests/test_view_gate.py fails as soon as `viser.ViserServer` takes arguments that it does not take now: one of them may
be the public way.
"""

from __future__ import annotations

import contextlib
import http
import io
import logging
import socket
import types
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from drgs.viewing.gate import Gate

if TYPE_CHECKING:
    import viser

_log = logging.getLogger(__name__)


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Args:
        host: Name or address to listen at.
        port: Port to listen at; 0 is any that is free.
    Raises:
        ValueError: If there is no such address here, or the port is taken.
    """
    if not 0 <= port < 1 << 16:
        raise ValueError(f"view: --port must be in [0, 65535], got {port}; choose another")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(
            f"view: --host {host} --port {port} must be an address of this machine that is free, got: {reason}; "
            "choose another port, or --port 0 for any"
        ) from None


def gated_server(gate: Gate, listening: socket.socket, host: str) -> viser.ViserServer:
    """Start viser's server on a bound socket, behind a gate, without tunnels.

    Args:
        gate: What each request must pass.
        listening: Socket that listens.
        host: Name or address that it listens at.
    Raises:
        RuntimeError: As `guarded`.
    """
    import viser
    from viser._messages import ShareUrlDisconnect, ShareUrlRequest

    with guarded(gate, listening), contextlib.redirect_stdout(io.StringIO()):  # viser prints where it listens
        server = viser.ViserServer(host, listening.getsockname()[1], verbose=False)
    # A tunnel to a server of somebody else's would lead around the gate.
    server._websock_server.unregister_handler(ShareUrlRequest)
    server._websock_server.unregister_handler(ShareUrlDisconnect)
    return server


@contextlib.contextmanager
def guarded(gate: Gate, listening: socket.socket) -> Iterator[None]:
    """Let a server that viser starts within the block listen at a socket, behind a gate.

    Raises:
        RuntimeError: If viser has started none through it: another version of viser, which is not to be trusted.
    """
    from viser.infra import _infra

    started = []

    def serve_guarded(
        handler: Any, host: Any, port: Any, *, process_request: Callable[..., Any], **options: Any
    ) -> Any:
        started.append(port)
        options |= {"process_request": _gated(gate, process_request), "create_connection": _Answering, "logger": _log}
        return serve(handler, sock=listening, **options)

    before = _infra.websockets
    shown = types.SimpleNamespace(**vars(before))
    shown.asyncio = types.SimpleNamespace(server=types.SimpleNamespace(serve=serve_guarded))
    _infra.websockets = shown  # type: ignore[assignment]  # its module, as far as it uses it
    try:
        yield
    finally:
        _infra.websockets = before
    if not started:
        raise RuntimeError("view: viser must start its server by websockets.asyncio.server.serve, has not")


class _Answering(ServerConnection):
    """A connection that answers what is no request of HTTP/1.1, too: by itself it would be closed without a word."""

    def send_data(self) -> None:
        """What the protocol has to send, behind our answer where it has given up reading a request."""
        error = self.protocol.handshake_exc
        self._given = getattr(self, "_given", False)
        if error is not None and self.protocol.state.name == "CONNECTING" and self.request is None and not self._given:
            self._given = True
            if "unsupported HTTP method" in str(error.__cause__):
                answer = _refused(http.HTTPStatus.METHOD_NOT_ALLOWED, "the method must be GET")
                answer.headers["Allow"] = "GET"
            else:
                answer = _refused(http.HTTPStatus.BAD_REQUEST, "this is no request that HTTP/1.1 knows")
            self.transport.write(answer.serialize())
        super().send_data()


def _gated(gate: Gate, process_request: Callable[..., Any]) -> Callable[..., Any]:
    """viser's answer to a request, where the gate has nothing against it."""
    import viser

    protocol = f"viser-v{viser.__version__}"

    def process(connection: Any, request: Request) -> Response | None:
        if found := gate.refusal(request.path, request.headers):
            return _refused(*found)
        if request.headers.get("Upgrade", "").lower() == "websocket":
            offered = ",".join(request.headers.get_all("Sec-WebSocket-Protocol"))
            if protocol not in (name.strip() for name in offered.split(",")):
                return _refused(http.HTTPStatus.BAD_REQUEST, f"the page must speak {protocol}; load it again")
        elif moved := gate.answer(request.path, request.headers):
            return Response(http.HTTPStatus.SEE_OTHER, "See Other", Headers(moved))
        try:
            response = process_request(connection, request)
        except (OSError, ValueError):  # no name of a file: too long, or with characters that none has
            response = _refused(http.HTTPStatus.NOT_FOUND, "there is no such page")
        if response is not None:
            for name, value in gate.around(request.headers):
                response.headers[name] = value
        return response

    return process


def _refused(status: http.HTTPStatus, why: str) -> Response:
    """An answer that says why there is none."""
    body = f"drgs view: {why}\n".encode()
    headers = Headers([("Content-Type", "text/plain; charset=utf-8"), ("Content-Length", str(len(body)))])
    headers["Connection"] = "close"
    return Response(status, status.phrase, headers, body)


def in_a_line(error: BaseException) -> str:
    """What an error says, with its kind, whatever lines it has."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _without_traceback(record: logging.LogRecord) -> bool:
    """Log errors of a client's messages in one line, without a traceback; failed handshakes not at all."""
    if record.exc_info and record.exc_info[1] is not None:
        record.msg = f"view: {record.getMessage()}: {in_a_line(record.exc_info[1])}"
        record.args = ()
        record.exc_info = None
        record.exc_text = None
        return "opening handshake failed" not in record.msg
    return True


_log.addFilter(_without_traceback)
