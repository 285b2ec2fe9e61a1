"""Claims of drgs.viewing.gate: who may talk to the viewer, by requests as they come over the wire."""

from __future__ import annotations

import http.client
import inspect
import socket

import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install 'drgs[view]'")

from test_view import subject
from viewing_client import PROTOCOL, Client
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from drgs.viewing.gate import Gate, is_loopback
from drgs.viewing.gated_viser import bound_socket, guarded
from drgs.viewing.server import Viewer

TOKEN = "a-token-of-the-test"


@pytest.fixture(scope="module")
def open_viewer():
    viewer = Viewer(subject(torch.zeros(1, 3)))
    yield viewer
    assert viewer.stop(20.0)


@pytest.fixture(scope="module")
def closed_viewer():
    viewer = Viewer(subject(torch.zeros(1, 3)), token=TOKEN)
    yield viewer
    assert viewer.stop(20.0)


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.body = response.read()
    connection.close()
    return response


def joined(port: int, path: str = "/", **options) -> int:
    """The status that a WebSocket handshake ends with."""
    try:
        with connect(f"ws://127.0.0.1:{port}{path}", subprotocols=[PROTOCOL], **options):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_a_page_of_this_machine_is_served(open_viewer):
    """By any name of this machine and any port, which a tunnel may have changed; nobody may frame it."""
    for host in (f"127.0.0.1:{open_viewer.port}", "localhost:9999", "localhost", "[::1]:80", "127.1.2.3"):
        answer = get(open_viewer.port, Host=host)
        assert (answer.status, b"<html" in answer.body.lower()) == (200, True), host
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        assert f"ws://{host} " in answer.headers["Content-Security-Policy"]
        assert answer.headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "192.168.0.7:8080", "127.0.0.1.evil.example"]
)
def test_another_name_of_this_machine_is_refused(open_viewer, host):
    """A site whose name resolves to this machine (DNS rebinding) gets neither a page nor a socket."""
    answer = get(open_viewer.port, Host=host)
    assert (answer.status, b"<html" in answer.body.lower()) == (403, False)
    assert b"drgs view: this viewer is for this machine only" in answer.body
    raw = f"GET / HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    raw += "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    with socket.create_connection(("127.0.0.1", open_viewer.port), 20) as wire:
        wire.sendall(f"{raw}Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode())
        assert wire.recv(64).startswith(b"HTTP/1.1 403 ")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://localhost.evil.example", "http://127.0.0.1:1", "file://", "x"]
)
def test_pages_of_other_sites_get_no_socket(open_viewer, origin):
    """A browser says which page opens a socket; only the viewer's own may. Port 1 of this machine is another site."""
    assert joined(open_viewer.port, origin=origin) == 403


def test_the_own_page_and_programs_get_a_socket(open_viewer):
    """The page's origin is the host that it asks; programs state none."""
    assert joined(open_viewer.port, origin=f"http://127.0.0.1:{open_viewer.port}") == 101
    assert joined(open_viewer.port) == 101


def test_requests_with_no_or_several_hosts_are_refused(open_viewer):
    """What a proxy and the viewer could read differently is not answered."""
    for hosts in (
        "",
        "Host: a\r\nHost: localhost\r\n",
        "Host: localhost/../x\r\n",
        "Host: localhost\r\nOrigin: a\r\nOrigin: b\r\n",
    ):
        with socket.create_connection(("127.0.0.1", open_viewer.port), 20) as wire:
            wire.sendall(f"GET / HTTP/1.1\r\n{hosts}\r\n".encode())
            assert wire.recv(64).startswith(b"HTTP/1.1 400 "), hosts


@pytest.mark.parametrize(
    "query", ["?websocket=ws://evil.example", "?a=1&playbackPath=https://evil.example/x", "?websocket"]
)
def test_links_that_lead_the_page_away_are_refused(open_viewer, closed_viewer, query):
    """viser's page would connect to any server that its address names, and show what that says as ours."""
    assert get(open_viewer.port, f"/{query}").status == 403
    cookie = f"{closed_viewer.gate.cookie}={TOKEN}"
    assert get(closed_viewer.port, f"/{query}", Cookie=cookie).status == 403


def test_without_the_token_nothing_is_answered(closed_viewer):
    """Neither the page nor a socket; a wrong token, a prefix of it or another port's cookie is none."""
    port = closed_viewer.port
    wrong = [{}, {"Cookie": f"{closed_viewer.gate.cookie}={TOKEN[:-1]}"}, {"Cookie": f"drgs_view_1={TOKEN}"}]
    for headers in wrong:
        assert get(port, **headers).status == 403
        assert joined(port, additional_headers=headers) == 403
    for query in ("?token=", "?token=wrong", f"?token={TOKEN[:-1]}", f"?Token={TOKEN}"):
        assert get(port, f"/{query}").status == 403
        assert joined(port, f"/{query}") == 403
    assert b"?token=" in get(port).body
    assert TOKEN.encode() not in get(port).body


def test_the_token_becomes_a_cookie(closed_viewer):
    """The address with the token leads to one without; the cookie that comes with it opens page and socket, of any
    host name, but for pages of other sites."""
    port = closed_viewer.port
    moved = get(port, f"/?token={TOKEN}", Host="some.machine:8080")
    assert (moved.status, moved.headers["Location"], moved.body) == (303, "/", b"")
    cookie = moved.headers["Set-Cookie"]
    assert {"HttpOnly", "SameSite=Lax"} <= {part.strip() for part in cookie.split(";")}
    known = {"Cookie": f"other=1; {cookie.split(';')[0]}"}
    assert get(port, Host="some.machine:8080", **known).status == 200
    assert joined(port, additional_headers=known, origin=f"http://127.0.0.1:{port}") == 101
    assert joined(port, additional_headers=known, origin="http://evil.example") == 403
    assert joined(port, f"/?token={TOKEN}") == 101


def test_a_viewer_for_others_asks_for_a_token(monkeypatch):
    """Where it listens to more than this machine, a token of 24 random bytes is made up, and printed in the address."""
    for host in ("0.0.0.0", "::", "192.168.1.2", "some.machine", ""):
        gate = Gate.of(host, 8080, None)
        assert len(gate.token) >= 32, host
        assert gate.address(host, 8080).endswith(f":8080/?token={gate.token}")
        assert gate.token not in repr(gate)
    assert Gate.of("0.0.0.0", 1, None).token != Gate.of("0.0.0.0", 1, None).token
    for host in ("127.0.0.1", "localhost", "::1", "127.3.4.5"):
        assert is_loopback(host)
        assert Gate.of(host, 8080, None).token is None
    assert Gate.of("127.0.0.1", 8080, TOKEN).address("127.0.0.1", 8080) == f"http://127.0.0.1:8080/?token={TOKEN}"
    for token in ("short", "a b c d e f g", "&&&&&&&&&&", "x" * 201, "ü" * 10):
        with pytest.raises(ValueError, match="--token must be 8 to 200"):
            Gate.of("127.0.0.1", 8080, token)


def test_a_socket_that_cannot_be_had():
    """A port that is taken, and no address of this machine: one line each."""
    told = r"--host 127.0.0.1 --port \d+ must be .*in use.*; choose another port"
    with bound_socket("127.0.0.1", 0) as taken, pytest.raises(ValueError, match=told):
        bound_socket("127.0.0.1", taken.getsockname()[1])
    with pytest.raises(ValueError, match="--host 198.51.100.1 --port 0 must be an address of this machine"):
        bound_socket("198.51.100.1", 0)
    with pytest.raises(ValueError, match=r"--port must be in \[0, 65535\], got 70000"):
        bound_socket("127.0.0.1", 70000)


def test_no_tunnel_is_opened(open_viewer):
    """viser offers to make a scene public by a tunnel; who asks for that gets none."""
    with Client(open_viewer.port) as client:
        client.look((1, 0, 0, 0), (0, 0, -3))
        client.wait(lambda m: m["type"] == "GuiHtmlMessage")
        client.send(type="ShareUrlRequest")
        client.look((1, 0, 0, 0), (0, 0, -4))
        client.picture()
    assert open_viewer._server._share_tunnel is None
    assert not {m["type"] for m in client.heard} & {"ShareUrlUpdated"}


def test_viser_has_no_public_way_yet():
    """Fails when viser's server takes other arguments: if one checks requests or is a socket, `gated_viser` goes."""
    import viser

    known = ["self", "host", "port", "label", "verbose", "_deprecated_kwargs"]
    assert list(inspect.signature(viser.ViserServer.__init__).parameters) == known


def test_a_server_that_goes_another_way_is_noticed():
    """Were viser to start its server by other means, the gate would say so instead of standing beside it."""
    gate = Gate.of("127.0.0.1", 1, None)
    with (
        bound_socket("127.0.0.1", 0) as listening,
        pytest.raises(RuntimeError, match="has not"),
        guarded(gate, listening),
    ):
        pass


# ------------------------------------------------------------------------------------------------ odd requests

UPGRADE = (
    b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SPOKEN = b"Sec-WebSocket-Protocol: " + PROTOCOL.encode() + b"\r\n"
ODD_LINES = [
    *(
        f"GET {path} HTTP/1.1".encode("utf-8", "surrogatepass")
        for path in (
            "/%00",
            "/%ff",
            "/" + "a" * 300,
            "/" + "%61" * 300,
            "/" + "a" * 9000,
            "/" + "a/" * 3000,
            "//[",
            "//[::1",
            "//[x]/?a",
            "http://[/",
            "http://localhost/",
            "*",
            "?",
            "/?" + "&" * 3000,
            "/?token=%ff",
            "/?token[=x",
            "/?%ed%a0%80",
            "/ü",
            "/?token=ü",
            "/\ud800",
            "/..",
            "/%2e%2e/",
            "/..%5c..",
            "/assets",
            "/%zz",
            "/a b",
            "",
            "/\x01",
            "/#",
            "/%0d%0aX: y",
        )
    ),
    *(
        f"{method} / HTTP/1.1".encode()
        for method in ("POST", "HEAD", "OPTIONS", "CONNECT", "get", "GËT", "", "GET GET")
    ),
    *(f"GET / {version}".encode() for version in ("HTTP/1.0", "HTTP/2.0", "", "HTTP/1.1 x")),
    b"\x16\x03\x01\x02\x00\x01\x00",  # what a browser sends for https://
]
ODD_HEADERS = [
    *(
        b"Host: " + host
        for host in (
            b"[:::]",
            b"[1:2]",
            b"[127.0.0.1]",
            b"[..]",
            b"[1::1::1]",
            b"[:]",
            b"localhost:",
            b"localhost:999999",
            b"..",
            b"",
            b"local\xfchost",
            "local\u2100host".encode(),
            b"a" * 400,
            b"\x00",
            b"localhost\r\nHost: localhost",
        )
    ),
    *(
        b"Host: localhost\r\nCookie: " + cookie
        for cookie in (
            b"%s=\xfc",
            b"%s=\xed\xa0\x80",
            b"%s",
            b"%s=a=b",
            b"=",
            b";" * 3000,
            b"\x00",
            b"%s=" + b"x" * 9000,
        )
    ),
    *(
        b"Host: localhost\r\n" + lines
        for lines in (
            b"Origin: http://[",
            b"Origin: \xfc",
            b"Origin: ",
            b"Upgrade: \xfc",
            b"Upgrade: websocket\r\nUpgrade: websocket",
            b"Accept-Encoding: a\r\nAccept-Encoding: b",
            b"Accept-Encoding: \xfc",
            b"Connection: \xfc\r\nUpgrade: websocket",
            UPGRADE + b"Upgrade: x",
            UPGRADE + UPGRADE.strip(),
            UPGRADE + b"Sec-WebSocket-Protocol: \xfc",
            UPGRADE + b"Sec-WebSocket-Protocol: viser-v0",
            UPGRADE + SPOKEN + b"Sec-WebSocket-Extensions: ;;;",
            UPGRADE.replace(b"dGhl", b"!!!!") + SPOKEN.strip(),
            UPGRADE.replace(b"13", b"x") + SPOKEN.strip(),
            b"Content-Length: x",
            b"Content-Length: 5",
            b"Transfer-Encoding: chunked",
            b"no header",
            b" folded: 1",
            b"\xfc: 1",
            b"X: 1\r\n" * 200,
        )
    ),
]


def answered(port: int, request: bytes) -> tuple[int, bytes]:
    """The status and all bytes of the answer to a request as it stands."""
    with socket.create_connection(("127.0.0.1", port), 20) as wire:
        wire.sendall(request)
        said = wire.recv(1 << 16)
    assert said.startswith(b"HTTP/1.1 "), (request[:200], said[:200])
    return int(said[9:12]), said


@pytest.mark.parametrize("guard", ["open", "token"])
def test_odd_requests_are_answered_and_not_failed_on(open_viewer, closed_viewer, guard, caplog, capfd):
    """Whatever the path, the host, the cookie, the method or the upgrade is, the answer says what is wrong with it (or
    is the page, or that there is none), and nothing is printed or logged with a traceback."""
    viewer = {"open": open_viewer, "token": closed_viewer}[guard]
    cookie = viewer.gate.cookie.encode()
    known = b"Host: localhost\r\nCookie: " + cookie + b"=" + TOKEN.encode() + b"\r\n"
    requests = [line + b"\r\n" + known + more + b"\r\n" for line in ODD_LINES for more in (b"", UPGRADE + SPOKEN)]
    for headers in ODD_HEADERS:
        there = headers.replace(b"%s", cookie).strip(b"\r\n")
        requests += [b"GET / HTTP/1.1\r\n" + there + b"\r\n" + more + b"\r\n" for more in (b"", UPGRADE + SPOKEN)]
    found = {request: answered(viewer.port, request)[0] for request in requests}
    odd = {
        request[:150]: status for request, status in found.items() if status not in (101, 200, 303, 400, 403, 404, 405)
    }
    assert not odd
    assert {400, 403, 404, 405} <= {*found.values()}
    assert all(status == 405 for request, status in found.items() if request.startswith((b"POST / ", b"HEAD / ")))
    assert not [record for record in caplog.records if record.exc_info]
    assert capfd.readouterr() == ("", "")
    assert get(viewer.port, Host="localhost", Cookie=(cookie + b"=" + TOKEN.encode()).decode()).status == 200


def test_cookies_of_other_programs_do_not_matter(closed_viewer):
    """Cookies are of all ports of a host: another program's may hold any bytes beside ours."""
    cookie = closed_viewer.gate.cookie.encode() + b"=" + TOKEN.encode()
    for other in (b"a=\xfc\xff", "b=\u2100".encode(), b"=", b";;;", b"c=\xed\xa0\x80"):
        request = b"GET / HTTP/1.1\r\nHost: localhost\r\nCookie: " + other + b"; " + cookie + b"\r\n\r\n"
        assert answered(closed_viewer.port, request)[0] == 200, other


def test_a_page_of_another_viser_is_told_to_load_again(open_viewer):
    """A page that was left open while the program became another version; it was printed on our stdout before."""
    status, said = answered(
        open_viewer.port,
        b"GET / HTTP/1.1\r\nHost: localhost\r\n" + UPGRADE + b"Sec-WebSocket-Protocol: viser-v0.0.1\r\n\r\n",
    )
    assert status == 400
    assert f"must speak {PROTOCOL}; load it again".encode() in said
