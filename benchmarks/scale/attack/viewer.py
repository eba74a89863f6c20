"""Hostile clients of the viewer: pages of other sites, foreign host names, many clients and invalid messages."""

from __future__ import annotations

import http.client
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

from benchmarks.scale.attack.attack import FINE, SECRET_WORD, Attack
from benchmarks.scale.attack.samples import Place

_WAIT = 90.0
"""Time limit for the start of the viewer [s]."""
_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, -1.0, 0.5],
    "fov": 0.9,
    "near": 0.01,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
_CLIENTS = 150
_MESSAGE = 49 << 20
"""Size of the largest message sent [bytes]."""


def address(place: Place) -> str:
    """Return the address that the viewer printed, once it answers there."""
    until = time.monotonic() + _WAIT
    while time.monotonic() < until:
        found = re.search(r"http://\S+", (place.root / "output.txt").read_text(errors="replace"))
        if found:
            url = found[0].rstrip(".,)")
            try:
                socket.create_connection(_host(url), 1).close()
            except OSError:
                time.sleep(0.1)
                continue
            return url
        time.sleep(0.1)
    raise RuntimeError("the viewer printed no address")


def _host(url: str) -> tuple[str, int]:
    parts = urlsplit(url)
    return parts.hostname or "localhost", parts.port or 80


def ask(url: str, path: str | None = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of the page or another path of its server; ``host_`` is the header Host."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(*_host(url), timeout=30)
    connection.putrequest(
        "GET", path or f"{parts.path or '/'}{f'?{parts.query}' if parts.query else ''}", skip_host=True
    )
    connection.putheader("Host", headers.pop("host_", parts.netloc))
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()


def _joined(url: str, query: str) -> str:
    parts = urlsplit(url)
    return f"{parts.path or '/'}?{parts.query}{'&' if parts.query else ''}{query}"


def _alive(url: str) -> Iterator[str]:
    status, _, _ = ask(url)
    if status != 200:
        yield f"afterwards the page is answered with status {status}"


def _visits(place: Place) -> Iterator[str]:
    """Send requests from pages of other sites, and for names that resolve to this machine."""
    url = address(place)
    status, headers, _ = ask(url)
    if status != 200:
        yield f"the page is answered with status {status}"
    policy = headers.get("content-security-policy", "")
    if "frame-ancestors 'none'" not in policy or not re.search(r"connect-src [^;*]*(;|$)", policy):
        yield f"the page may be framed, or may connect anywhere: {policy[:100]!r}"
    for query in ("websocket=ws://attacker.example:9", "WEBSOCKET=ws://a", "a=1&websocket=ws%3A%2F%2Fattacker.example"):
        status, _, _ = ask(url, _joined(url, query))
        if status < 400 and "connect-src" not in policy:
            yield f"?{query} is answered with status {status}"
    for name, value in (("origin", "http://attacker.example"), ("host_", "attacker.example"), ("origin", "null")):
        status, _, _ = ask(url, **{name: value})
        if status not in (400, 403):
            yield f"a request with {name} {value} is answered with status {status}"
    for host in ("[", "]", "[::1", "localhost:x", "", "a" * 5000, "localhost@attacker.example"):
        status, _, _ = ask(url, host_=host)
        if status >= 500 or status < 400:
            yield f"a request of host {host[:20]!r} is answered with status {status}"
    status, _, _ = ask(url, "/")
    if status == 200:
        yield "who has no token sees the page"
    for path in ("/../../outside/secret.txt", "/%2e%2e/%2e%2e/outside/secret.txt", "//etc/passwd", "/\\..\\a", "/%00"):
        status, _, body = ask(url, path)
        if SECRET_WORD.encode() in body or b"root:" in body or status >= 500:
            yield f"{path} is answered with status {status}"
    yield from _alive(url)


def _connect(url: str, stack: ExitStack) -> Any:
    import viser
    from websockets.sync.client import connect

    return stack.enter_context(
        connect(
            url.replace("http://", "ws://"),
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            open_timeout=30,
            close_timeout=1,
        )
    )


def _sent(*messages: object) -> Callable[[Place], Iterator[str]]:
    """Send messages of a client, each over its own connection; bytes are sent unchanged."""

    def during(place: Place) -> Iterator[str]:
        import msgspec
        from websockets.exceptions import WebSocketException

        url = address(place)
        for message in messages:
            data = message if isinstance(message, bytes) else msgspec.msgpack.encode([message])
            try:
                with ExitStack() as stack:
                    connection = _connect(url, stack)
                    connection.send(data)
                    connection.send(msgspec.msgpack.encode(message) if not isinstance(message, bytes) else data)
                    time.sleep(1)
            except (OSError, WebSocketException):
                continue  # refused, as required
        time.sleep(1)
        yield from _alive(url)

    return during


def _crowd(place: Place) -> Iterator[str]:
    """Connect many clients that never read."""
    from websockets.exceptions import WebSocketException

    url = address(place)
    with ExitStack() as stack:
        for _ in range(_CLIENTS):
            try:
                _connect(url, stack)
            except (OSError, WebSocketException):
                break
        time.sleep(3)
    time.sleep(1)
    yield from _alive(url)


def _half_open(place: Place) -> Iterator[str]:
    """Open connections that never complete a request."""
    url = address(place)
    with ExitStack() as stack:
        for _ in range(_CLIENTS):
            one = stack.enter_context(socket.create_connection(_host(url), 5))
            one.sendall(b"GET / HTTP/1.1\r\nHost: ")
        time.sleep(2)
        yield from _alive(url)


_NAN, _INF = float("nan"), float("inf")


def _attack(name: str, tries: str, during: Callable[[Place], Iterator[str]], port: int) -> Attack:
    return Attack(
        f"viewer: {name}",
        tries,
        lambda place: place.take("nut"),
        [("mitsplat", "view", "nut", "--port", str(port))],
        FINE,
        seconds=150,
        quick=False,
        needs=("viser",),
        during=during,
        keep=("nut/asset.yaml", "nut/splats.ply"),
    )


ATTACKS = (
    _attack("pages of other sites", "take over the page, or see it", _visits, 18_081),
    _attack(
        "cameras of no sense",
        "end the viewer",
        _sent(
            _CAMERA | {"look_at": [_NAN, 0.0, 0.0]},
            _CAMERA | {"position": [_INF, 0.0, 0.0]},
            _CAMERA | {"wxyz": [0.0, 0.0, 0.0, 0.0]},
            _CAMERA | {"up_direction": [0.0, 0.0, 0.0]},
            _CAMERA | {"fov": -1.0},
            _CAMERA | {"image_width": 10**9, "image_height": 10**9},
            _CAMERA | {"image_width": 0, "image_height": 0},
            {"type": "ViewerCameraMessage"},
            {"type": "RunJavascriptMessage", "source": "1"},
            {"type": 5},
        ),
        18_082,
    ),
    _attack(
        "messages of rubbish",
        "end the viewer",
        _sent(b"", b"\xc1", b"\xff" * 1000, b"\x91" * 100_000 + b"\xc0", b"\xdd\xff\xff\xff\xff", b"\x81\xa4type\xa1a"),
        18_083,
    ),
    _attack("messages of 49 MB", "fill memory", _sent(*[b"\xc6" + bytes(_MESSAGE)] * 4), 18_084),
    _attack("150 clients", "fill memory", _crowd, 18_085),
    _attack("150 requests without end", "keep others out", _half_open, 18_086),
)
