"""Access to the page: a token in its address, no other site's script, no frame around it, and few browsers at a time.

viser answers everyone who reaches its port, and has no hook for a check. Its server is made by ``websockets``, which
has two: ``process_request`` is called with every request, and ``create_connection`` makes the connections. The address
of the page is also that of its websocket: viser's client derives the one from the other. So a token in the path reaches
both, and no cookie is needed, which every port of a host would be sent.
"""

from __future__ import annotations

import http
import logging
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.view.client_messages import LARGEST, Connection, Pool

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

LOOPBACK = ("localhost", "127.0.0.1", "::1")
MOST_BROWSERS = 16
"""Most browsers that are connected at a time: each is sent all that is shown, and holds it until it has read it."""

_LOCAL = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d{1,5})?")
_HOST = re.compile(r"([\w.-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?", re.ASCII)
_POLICY = "; ".join(
    (
        "default-src 'none'",
        # viser's page is one file that unpacks its script, and sorts splats in WASM whose bindings are made by eval.
        "script-src 'unsafe-inline' 'unsafe-eval' blob:",
        "worker-src blob: data:",
        "style-src 'unsafe-inline'",
        "img-src 'self' blob: data:",
        "font-src data:",
        "connect-src 'self' ws://{host} wss://{host} blob: data:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)


@dataclass(frozen=True)
class Guard:
    """Conditions of a request.

    Attributes:
        token: Path of the page's address.
        local: Whether a request must also name this machine as its host, so that no foreign name that was made to lead
            here is answered.
    """

    token: str
    local: bool

    @classmethod
    def of_host(cls, host: str) -> Guard:
        """Make a new token for a server that listens on a host."""
        return cls(secrets.token_urlsafe(16), host in LOOPBACK)

    def refusal(self, path: str, host: str, origin: str | None) -> str | None:
        """Say why a request is refused, or None if it is not.

        Args:
            path: With what follows ``?``.
            host: Header ``Host``.
            origin: Header ``Origin``, which browsers send with scripts' requests.
        """
        if (_LOCAL if self.local else _HOST).fullmatch(host) is None:
            return "not asked for by the name of this machine" + (", localhost" if self.local else "")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "asked for by another site"
        place, _, query = path.partition("?")
        page = f"/{self.token}"
        if not secrets.compare_digest(_bytes(place.removesuffix("/")), _bytes(page)):
            return "the address must end in the token that `mitsplat view` printed"
        # viser's client adds the address of its own websocket, and connects to whichever it finds there.
        if query and query not in (f"websocket=ws://{host}{page}", f"websocket=wss://{host}{page}"):
            return "the address must have nothing behind the token"
        return None

    def answer_headers(self, host: str) -> dict[str, str]:
        """Headers of the page: it connects to its own server alone, and is shown in no other page."""
        return {
            "Content-Security-Policy": _POLICY.format(host=host),
            "X-Frame-Options": "DENY",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }


@contextmanager
def guarded(guard: Guard) -> Iterator[Pool]:
    """Make servers of ``websockets`` that start within ask the guard first.

    Yields:
        The pool whose jobs connections wait for, to be filled in once there is one.

    Raises:
        MissingResourceError: If none started, which leaves a page without a guard.
    """
    import websockets.asyncio.server as server  # optional: of the extra `view`
    from websockets.datastructures import Headers
    from websockets.http11 import Request

    start, started, pool = server.serve, [], Pool()

    def serve(*args: Any, process_request: Callable[[Any, Request], Response | None], **options: Any) -> Any:
        def ask(connection: Any, request: Request) -> Response | None:
            def header(name: str) -> str | None:
                return ", ".join(request.headers.get_all(name)) or None

            host = header("Host") or ""
            if reason := guard.refusal(request.path, host, header("Origin")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"mitsplat view: {reason}\n")
            if len(connection.server.connections) >= MOST_BROWSERS:
                text = f"mitsplat view: {MOST_BROWSERS} browsers have this page open, which is the most\n"
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
            if header("Upgrade") is not None:
                return None  # the websocket
            page = Request("/", Headers({"Accept-Encoding": header("Accept-Encoding") or ""}))
            response = process_request(connection, page)
            if response is not None:
                response.headers.update(guard.answer_headers(host))
            return response

        started.append(True)
        own = {"process_request": ask, "create_connection": partial(Connection, pool=pool), "logger": _logger()}
        return start(*args, **options | own | {"max_size": LARGEST})

    server.serve = serve
    try:
        yield pool
    finally:
        server.serve = start
    if not started:
        raise MissingResourceError("this viser cannot be guarded: install the one that mitsplat[view] asks for")


def _logger() -> logging.Logger:
    """Return the server's logger, without the traceback that each visitor who asks for no page would print."""
    logger = logging.getLogger(__name__)
    logger.addFilter(_is_no_handshake)
    return logger


def _is_no_handshake(record: logging.LogRecord) -> bool:
    return record.msg != "opening handshake failed"


def check_address(host: str, port: int) -> None:
    """Refuse an address that cannot be bound to.

    Raises:
        InputError: If the machine has no such address, or the port is taken.
    """
    if not 0 <= port < 2**16:
        raise InputError(f"--port must be from 0 to 65535 (got {port})")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--host and --port must be free to listen on (got {host}, {port}: {reason})") from error


def _bytes(text: str) -> bytes:
    """Text of a request, which may hold bytes that are no text."""
    return text.encode("utf-8", "surrogateescape")
