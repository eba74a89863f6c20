"""Access control of the page: a token in its address, no scripts of other sites, no frames, and few browsers at a time.

viser answers every request to its port and has no hook for access control. It uses a server of ``websockets``, which
has two hooks: ``process_request`` is called for every request, and ``create_connection`` makes the connections. viser's
client derives the address of its websocket from that of the page. So a token in the path protects both. No cookie is
needed; a browser would send a cookie to every port of a host.
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
from mitsplat.view.client_messages import MAX_MESSAGE_BYTES, Connection, MessageThreads

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOOPBACK = ("localhost", "127.0.0.1", "::1")
MAX_BROWSERS = 16
"""Maximum number of connected browsers; each uses memory for all displayed parts until it has received them."""

_LOCAL = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d{1,5})?")
_HOST = re.compile(r"([\w.-]+|\[[0-9A-Fa-f:.]+\])(:\d{1,5})?", re.ASCII)
_POLICY = "; ".join(
    (
        "default-src 'none'",
        # viser's page is one file that unpacks its script, and it sorts splats in WASM with bindings made by eval.
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
    """Conditions that a request must fulfil.

    Attributes:
        token: Path of the page's address.
        local: True if the header ``Host`` must name this machine. This rejects foreign names that resolve to this
            machine.
    """

    token: str
    local: bool

    @classmethod
    def for_host(cls, host: str) -> Guard:
        """Return a guard with a new token for a server that listens on ``host``."""
        return cls(secrets.token_urlsafe(16), host in LOOPBACK)

    def rejection_reason(self, path: str, host: str, origin: str | None) -> str | None:
        """Return the reason why a request is rejected, or None if it is accepted.

        Args:
            path: Path of the request with the query.
            host: Header ``Host``.
            origin: Header ``Origin``, which browsers add to requests of scripts.
        """
        if (_LOCAL if self.local else _HOST).fullmatch(host) is None:
            return "the host in the address is not this machine" + (", localhost" if self.local else "")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return "requested by another site"
        place, _, query = path.partition("?")
        page = f"/{self.token}"
        if not secrets.compare_digest(_bytes(place.removesuffix("/")), _bytes(page)):
            return "the address must end in the token that `mitsplat view` printed"
        # viser's client adds the address of its own websocket as a query, and connects to any address in it.
        if query and query not in (f"websocket=ws://{host}{page}", f"websocket=wss://{host}{page}"):
            return "the address must end after the token"
        return None

    def answer_headers(self, host: str) -> dict[str, str]:
        """Return the response headers of the page.

        They allow the page to connect only to its own server, and no other page to embed it.
        """
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
def guarded(guard: Guard) -> Iterator[MessageThreads]:
    """Make servers of ``websockets`` that start in this context apply the guard.

    Yields:
        The pool on whose jobs connections wait; the caller sets its threads.

    Raises:
        MissingResourceError: If no server started, so that the page would have no guard.
    """
    import websockets.asyncio.server as server  # optional dependency of the extra `view`
    from websockets.datastructures import Headers
    from websockets.http11 import Request

    start, started, pool = server.serve, [], MessageThreads()

    def serve(
        *args: Any, process_request: Callable[[ServerConnection, Request], Response | None], **options: Any
    ) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Response | None:
            def header(name: str) -> str | None:
                return ", ".join(request.headers.get_all(name)) or None

            host = header("Host") or ""
            if reason := guard.rejection_reason(request.path, host, header("Origin")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"mitsplat view: {reason}\n")
            if len(connection.server.connections) >= MAX_BROWSERS:
                text = f"mitsplat view: {MAX_BROWSERS} browsers have this page open, which is the maximum\n"
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
            if header("Upgrade") is not None:
                return None  # the websocket
            page = Request("/", Headers({"Accept-Encoding": header("Accept-Encoding") or ""}))
            response = process_request(connection, page)
            if response is not None:
                response.headers.update(guard.answer_headers(host))
            return response

        started.append(True)
        own = {"process_request": answer, "create_connection": partial(Connection, pool=pool), "logger": _logger()}
        return start(*args, **options | own | {"max_size": MAX_MESSAGE_BYTES})

    server.serve = serve
    try:
        yield pool
    finally:
        server.serve = start
    if not started:
        raise MissingResourceError(
            "access control does not work with this version of viser: install the version of mitsplat[view]"
        )


def _logger() -> logging.Logger:
    """Return a logger that omits the tracebacks of failed handshakes, which any visitor could cause."""
    logger = logging.getLogger(__name__)
    logger.addFilter(lambda record: record.msg != "opening handshake failed")
    return logger


def check_address(host: str, port: int) -> None:
    """Raise an error if the address cannot be bound.

    Raises:
        InputError: If the machine has no such address, or the port is in use.
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
    """Encode text of a request, which may contain bytes that are not text."""
    return text.encode("utf-8", "surrogateescape")
