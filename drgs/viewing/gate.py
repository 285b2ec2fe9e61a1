"""Which requests the viewer answers: the origin of a request is checked before anything is computed.

A viewer that listens to this machine alone is still reached by every page that the browser on it has open. Such a
page may open a WebSocket to 127.0.0.1 (it states its own site as `Origin`), or have its own name resolve to 127.0.0.1
(the request then states that name as `Host`). Both are refused. One that listens to a network asks for a token, once
in the address, from then on in a cookie that scripts do not see.

It decides from a path and headers alone; `drgs.viewing.gated_viser` calls it.
"""

from __future__ import annotations

import dataclasses
import hmac
import http
import ipaddress
import re
import secrets
import socket
from typing import Any
from urllib.parse import parse_qs, urlsplit

_HOST = re.compile(r"(?:(?P<name>[A-Za-z0-9._-]{1,253})|\[(?P<address>[0-9A-Fa-f:.]{2,45})\])(?::\d{1,5})?")
_TOKEN = re.compile(r"[A-Za-z0-9_~.-]{8,200}")
# The client would connect to whatever server these name, and show what that says as a page of ours.
_LEADING_AWAY = ("websocket", "playbackPath")
# What viser and websockets read as one value, and those that they read as a list: nothing else of the headers is read
# but cookies, which other programs of this machine may have set to anything.
_ONCE = ("Host", "Origin", "Upgrade", "Accept-Encoding", "Sec-WebSocket-Key", "Sec-WebSocket-Version")
_LISTS = ("Connection", "Sec-WebSocket-Protocol", "Sec-WebSocket-Extensions")


@dataclasses.dataclass(frozen=True)
class Gate:
    """Conditions that a request must meet.

    Attributes:
        token: Token that the request must know; None: none is required, and requests must be to a name of this machine.
        cookie: Name of the cookie that keeps the token, with the port in it: cookies are of all ports of a host.
    """

    token: str | None = dataclasses.field(repr=False)
    cookie: str

    @classmethod
    def of(cls, host: str, port: int, token: str | None) -> Gate:
        """The gate of a viewer that listens at an address.

        Args:
            host: Name or address that the viewer listens at.
            port: Port that it listens at.
            token: Token that is required; None: none on this machine, else a random one.
        Raises:
            ValueError: If the token is short, or has characters that an address has another meaning for.
        """
        if token is not None and not _TOKEN.fullmatch(token):
            raise ValueError("view: --token must be 8 to 200 letters, digits or any of - _ . ~; choose another")
        if token is None and not is_loopback(host):
            token = secrets.token_urlsafe(24)
        return cls(token, f"drgs_view_{port}")

    def address(self, host: str, port: int) -> str:
        """The address to open in a browser."""
        try:
            name = ipaddress.ip_address(host)
            shown = socket.gethostname() if name.is_unspecified else f"[{host}]" if name.version == 6 else host
        except ValueError:
            shown = host or socket.gethostname()
        return f"http://{shown}:{port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, path: str, headers: Any) -> tuple[http.HTTPStatus, str] | None:
        """Why a request is not answered; None where it is.

        Args:
            path: Path of the request, with its query.
            headers: Headers of the request, as `websockets` has them.
        """
        if (problem := _malformed(path, headers)) is not None:
            return http.HTTPStatus.BAD_REQUEST, problem
        host = headers["Host"].lower()
        origins = headers.get_all("Origin")
        named = _HOST.fullmatch(host)
        if named is None:
            return http.HTTPStatus.BAD_REQUEST, "the request must name one host"
        if self.token is None and not is_loopback(named["name"] or named["address"]):
            return http.HTTPStatus.FORBIDDEN, "this viewer is for this machine only; say --token to reach it by a name"
        if origins and _site(origins[0]) != host:
            return http.HTTPStatus.FORBIDDEN, "pages of other sites may not talk to this viewer"
        query = _query(path)
        if any(name in query for name in _LEADING_AWAY):
            return http.HTTPStatus.FORBIDDEN, "the address must not lead the page to another server"
        if not self._knows(query.get("token", []), headers):
            return http.HTTPStatus.FORBIDDEN, "the address must have ?token=..., as drgs view has printed it"
        return None

    def answer(self, path: str, headers: Any) -> list[tuple[str, str]] | None:
        """Headers that lead a page with the token in its address to the one without, which has a cookie; else None."""
        if self.token is None or "token" not in _query(path):
            return None
        cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"
        return [("Location", "/"), ("Set-Cookie", cookie), ("Content-Length", "0"), *self.around(headers)]

    @staticmethod
    def around(headers: Any) -> list[tuple[str, str]]:
        """Headers of every answer: the page may contact no other server, and be in no frame of another page."""
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
        return any(hmac.compare_digest(_bytes(text), self.token.encode()) for text in known)


def is_loopback(host: str) -> bool:
    """Whether a name or an address is always this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _malformed(path: str, headers: Any) -> str | None:
    """Why a request is malformed, whoever sends it; None where it is not."""
    if not headers.get_all("Host"):
        return "the request must name one host"
    for name in _ONCE:
        if len(headers.get_all(name)) > 1:
            return f"the request must state {name} once"
    texts = [path, *(text for name in (*_ONCE, *_LISTS) for text in headers.get_all(name))]
    if not all(text.isascii() for text in texts):
        return "the request must be in ASCII"
    if not path.startswith("/"):
        return "the path must begin with /"
    return None


def _query(path: str) -> dict[str, list[str]]:
    """Query of a path as it came. No `urlsplit`: to that a path of two slashes names a host, and may be an error."""
    return parse_qs(path.partition("?")[2].partition("#")[0], keep_blank_values=True)


def _bytes(text: str) -> bytes:
    """Bytes of a header, which `websockets` has as lone surrogates beyond ASCII, or of whatever is in a query."""
    return text.encode(errors="surrogateescape")


def _site(origin: str) -> str:
    """Host and port of an origin; empty of one that has none, as that of a file."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""
