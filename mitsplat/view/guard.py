"""Who may open the page: whoever is on this machine, or has the token, and no other site's script in their browser.

viser answers everyone who reaches its port, and has no hook for a check. Its server is made by ``websockets``, which
has one, ``process_request``: it is given a check of ours, which runs before viser's own.
"""

from __future__ import annotations

import http
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from mitsplat.errors import InputError, MissingResourceError

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

LOOPBACK = ("localhost", "127.0.0.1", "::1")
COOKIE = "mitsplat-view"


@dataclass(frozen=True)
class Guard:
    """What a request must have.

    Attributes:
        token: That the page's address ends in, and that the browser sends back as a cookie from then on. None where
            only this machine can ask: then a request must name it as its host, so that no foreign name that was made to
            lead here is answered.
    """

    token: str | None = None

    @classmethod
    def of_host(cls, host: str) -> Guard:
        """A new token, unless only this machine is bound to."""
        return cls(None if host in LOOPBACK else secrets.token_urlsafe(16))

    def refusal(self, path: str, host: str, origin: str | None, cookies: str) -> str | None:
        """Why a request is refused, or None.

        Args:
            path: With what follows ``?``.
            host: Header ``Host``.
            origin: Header ``Origin``, which browsers send with scripts' requests.
            cookies: Header ``Cookie``.
        """
        if origin is not None and urlsplit(origin).netloc != host:
            return "asked for by another site"
        if self.token is None:
            name = urlsplit(f"//{host}").hostname
            return None if name in LOOPBACK else "not asked for by the name of this machine, localhost"
        if self.invited(path) or secrets.compare_digest(_cookie(cookies).encode(), self.token.encode()):
            return None
        return "the address must end in ?token= and the token that `mitsplat view` printed"

    def invited(self, path: str) -> bool:
        """Whether an address has the token."""
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        return self.token is not None and secrets.compare_digest(given.encode(), self.token.encode())


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Servers of ``websockets`` that start within ask the guard first.

    Raises:
        MissingResourceError: If none started, which leaves a page without a guard.
    """
    import websockets.asyncio.server as server  # optional: of the extra `view`

    start, started = server.serve, []

    def serve(*args: Any, process_request: Callable[[Any, Request], Response | None], **options: Any) -> Any:
        def ask(connection: Any, request: Request) -> Response | None:
            headers = request.headers
            reason = guard.refusal(
                request.path, headers.get("Host", ""), headers.get("Origin"), headers.get("Cookie", "")
            )
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"mitsplat view: {reason}\n")
            response = process_request(connection, request)
            if response is not None and guard.invited(request.path):
                response.headers["Set-Cookie"] = f"{COOKIE}={guard.token}; HttpOnly; SameSite=Strict; Path=/"
            return response

        started.append(True)
        return start(*args, process_request=ask, **options)

    server.serve = serve
    try:
        yield
    finally:
        server.serve = start
    if not started:
        raise MissingResourceError("this viser cannot be guarded: install the one that mitsplat[view] asks for")


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


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""
