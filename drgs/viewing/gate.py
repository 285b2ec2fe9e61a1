"""Who may talk to the viewer: what comes in is asked where it is from before anything is answered.

A viewer that listens to this machine alone is still reached by every page that the browser on it has open. Such a
page may open a WebSocket to 127.0.0.1 (it states its own site as `Origin`), or have its own name resolve to 127.0.0.1
(the request then states that name as `Host`). Both are refused. One that listens to a network asks for a token, once
in the address, from then on in a cookie that scripts do not see.

viser has no place for such questions, so its call of `websockets`' `serve` is led through here (`guarded`): to the
socket that was bound before, and with our question in front of its own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hmac
import http
import ipaddress
import re
import secrets
import socket
import types
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

__all__ = ["Gate", "bound_socket", "guarded", "is_loopback"]

_HOST = re.compile(r"[A-Za-z0-9._-]{1,253}(:\d{1,5})?|\[[0-9A-Fa-f:.]{2,45}\](:\d{1,5})?")
_TOKEN = re.compile(r"[A-Za-z0-9_~.-]{8,200}")
# The client would connect to whatever server these name, and show what that says as a page of ours.
_LEADING_AWAY = ("websocket", "playbackPath")


@dataclasses.dataclass(frozen=True)
class Gate:
    """What a request must be like.

    Attributes:
        token: What it must know; None asks for none, and takes only requests to a name of this machine.
        cookie: Name of the cookie that keeps the token, with the port in it: cookies are of all ports of a host.
    """

    token: str | None = dataclasses.field(repr=False)
    cookie: str

    @classmethod
    def of(cls, host: str, port: int, token: str | None) -> Gate:
        """The gate of a viewer that listens at an address.

        Args:
            host, port: The address.
            token: The one to ask for; None: none on this machine, else one that nobody can guess.
        Raises:
            ValueError: If the token is short, or has characters that an address has another meaning for.
        """
        if token is not None and not _TOKEN.fullmatch(token):
            raise ValueError("view: --token must be 8 to 200 letters, digits or any of - _ . ~; choose another")
        if token is None and not is_loopback(host):
            token = secrets.token_urlsafe(24)
        return cls(token, f"drgs_view_{port}")

    def address(self, host: str, port: int) -> str:
        """What is opened in a browser."""
        try:
            name = ipaddress.ip_address(host)
            shown = socket.gethostname() if name.is_unspecified else f"[{host}]" if name.version == 6 else host
        except ValueError:
            shown = host or socket.gethostname()
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, path: str, headers: Any) -> tuple[http.HTTPStatus, str] | None:
        """Why a request is not answered; None where it is.

        Args:
            path: With its query.
            headers: As `websockets` has them.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]) or len(origins) > 1:
            return http.HTTPStatus.BAD_REQUEST, "the request must name one host"
        host = hosts[0].lower()
        if self.token is None and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return http.HTTPStatus.FORBIDDEN, "this viewer is for this machine only; say --token to reach it by a name"
        if origins and _site(origins[0]) != host:
            return http.HTTPStatus.FORBIDDEN, "pages of other sites may not talk to this viewer"
        query = parse_qs(urlsplit(path).query, keep_blank_values=True)
        if any(name in query for name in _LEADING_AWAY):
            return http.HTTPStatus.FORBIDDEN, "the address must not lead the page to another server"
        if not self._knows(query.get("token", []), headers):
            return http.HTTPStatus.FORBIDDEN, "the address must have ?token=..., as drgs view has printed it"
        return None

    def answer(self, path: str, headers: Any) -> list[tuple[str, str]] | None:
        """Headers that lead a page with the token in its address to the one without, which has a cookie; else None."""
        if self.token is None or "token" not in parse_qs(urlsplit(path).query):
            return None
        cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
        return [("Location", "/"), ("Set-Cookie", cookie), ("Content-Length", "0"), *self.around(headers)]

    @staticmethod
    def around(headers: Any) -> list[tuple[str, str]]:
        """Headers of every answer: a page that talks to nobody else, in no frame of another one."""
        host = headers.get_all("Host")[0]
        policy = f"connect-src 'self' ws://{host} wss://{host} data: blob:; frame-ancestors 'none'; base-uri 'none'"
        return [
            ("Content-Security-Policy", policy),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
        ]

    def _knows(self, given: list[str], headers: Any) -> bool:
        if self.token is None:
            return True
        pairs = (part.strip().partition("=") for line in headers.get_all("Cookie") for part in line.split(";"))
        known = [*given, *(value for name, _, value in pairs if name == self.cookie)]
        return any(hmac.compare_digest(text.encode(), self.token.encode()) for text in known)


def is_loopback(host: str) -> bool:
    """Whether a name or an address is always this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bound_socket(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Args:
        host: A name or an address.
        port: 0 is any that is free.
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


@contextlib.contextmanager
def guarded(gate: Gate, listening: socket.socket) -> Iterator[None]:
    """For the length of the block, a server that viser starts listens at a socket, behind a gate.

    Raises:
        RuntimeError: If viser has started none through it: another version of viser, which is not to be trusted.
    """
    from viser.infra import _infra
    from websockets.asyncio.server import serve

    led = []

    def behind(handler: Any, host: Any, port: Any, *, process_request: Callable[..., Any], **options: Any) -> Any:
        led.append(port)
        return serve(handler, sock=listening, process_request=_asked(gate, process_request), **options)

    before = _infra.websockets
    shown = types.SimpleNamespace(**vars(before))
    shown.asyncio = types.SimpleNamespace(server=types.SimpleNamespace(serve=behind))
    _infra.websockets = shown  # type: ignore[assignment]  # its module, as far as it uses it
    try:
        yield
    finally:
        _infra.websockets = before
    if not led:
        raise RuntimeError("view: viser must start its server by websockets.asyncio.server.serve, has not")


def _asked(gate: Gate, process_request: Callable[..., Any]) -> Callable[..., Any]:
    """viser's answer to a request, where the gate has nothing against it."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    def process(connection: Any, request: Any) -> Any:
        if found := gate.refusal(request.path, request.headers):
            status, why = found
            body = f"drgs view: {why}\n".encode()
            said = Headers([("Content-Type", "text/plain; charset=utf-8"), ("Content-Length", str(len(body)))])
            said["Connection"] = "close"
            return Response(status, status.phrase, said, body)
        upgrades = request.headers.get("Upgrade", "").lower() == "websocket"
        if not upgrades and (moved := gate.answer(request.path, request.headers)):
            return Response(http.HTTPStatus.SEE_OTHER, "See Other", Headers(moved))
        response = process_request(connection, request)
        if response is not None:
            for name, value in gate.around(request.headers):
                response.headers[name] = value
        return response

    return process


def _site(origin: str) -> str:
    """Host and port of an origin; empty of one that has none, as that of a file."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
