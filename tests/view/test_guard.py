"""Access control of the page."""

from __future__ import annotations

import http.client
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.view.guard import MAX_BROWSERS, Guard, check_address, guarded
from mitsplat.view.page import Address, Page

TOKEN = "a-token"
PAGE = f"/{TOKEN}"


@pytest.mark.parametrize(
    ("host", "origin", "refused"),
    [
        ("localhost:8080", None, False),
        ("localhost", "http://localhost", False),
        ("localhost:9090", "http://localhost:9090", False),  # tunnel from another port
        ("127.0.0.1:8080", "http://127.0.0.1:8080", False),
        ("[::1]:8080", None, False),
        ("evil.example:8080", "http://evil.example:8080", True),  # DNS rebinding
        ("localhost:8080", "http://evil.example", True),
        ("localhost:8080", "http://localhost:3000", True),
        ("localhost:8080", "null", True),
        ("localhost:8080", "http://[", True),
        ("localhost:8080, localhost:8080", None, True),
        ("[", None, True),
        ("[::1", None, True),
        ("localhost:8080; script-src *", None, True),
        ("", None, True),
    ],
)
def test_a_local_page_accepts_names_of_this_machine_only(host, origin, refused):
    assert (Guard(TOKEN, local=True).rejection_reason(PAGE, host, origin) is not None) == refused


@pytest.mark.parametrize(
    ("host", "origin", "refused"),
    [
        ("host:1", None, False),
        ("host.example", "https://host.example", False),
        ("[fe80::1]:80", None, False),
        ("host:1", "http://evil.example", True),
        ("host:1; script-src *", None, True),
        ("[", None, True),
        ("", None, True),
    ],
)
def test_a_page_on_the_network_accepts_any_host_name(host, origin, refused):
    assert (Guard(TOKEN, local=False).rejection_reason(PAGE, host, origin) is not None) == refused


@pytest.mark.parametrize("local", [True, False])
@pytest.mark.parametrize(
    ("path", "refused"),
    [
        (PAGE, False),
        (f"{PAGE}/", False),
        (f"{PAGE}?websocket=ws://localhost:1{PAGE}", False),  # query written by viser's script
        ("/", True),
        (f"/?token={TOKEN}", True),
        (f"{PAGE}x", True),
        (f"/x{PAGE}", True),
        ("//[", True),
        ("/\udcff", True),
        (f"{PAGE}?websocket=ws://evil.example", True),
        (f"{PAGE}?websocket=ws://localhost:2{PAGE}", True),
        (f"{PAGE}?%77ebsocket=ws://evil.example", True),
        (f"{PAGE}?websocket=ws://localhost:1{PAGE}&websocket=ws://evil.example", True),
        (f"{PAGE}?playbackPath=http://evil.example/x.viser", True),
    ],
)
def test_paths_other_than_the_token_are_refused(path, refused, local):
    assert (Guard(TOKEN, local).rejection_reason(path, "localhost:1", None) is not None) == refused


def test_every_page_has_a_token_of_its_own():
    guards = [Guard.for_host(host) for host in ("localhost", "localhost", "127.0.0.1", "0.0.0.0")]
    assert [guard.local for guard in guards] == [True, True, True, False]
    assert len({guard.token for guard in guards}) == 4
    assert all(len(guard.token) >= 20 for guard in guards)


@pytest.fixture(params=["localhost", "0.0.0.0"])
def page(request) -> Iterator[Page]:
    page = Page("test", Address(request.param, 0), gaussians=10)
    yield page
    page.close()


def place(page: Page) -> str:
    """Return the path of the page's address."""
    return "/" + page.url.rpartition("/")[2]


def answer(page: Page, path: str, **headers: str) -> http.client.HTTPResponse:
    with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        response.read()
        return response


def status(page: Page, *lines: bytes) -> int:
    """Return the response status of a raw request."""
    with closing(socket.create_connection(("127.0.0.1", page.port), timeout=20)) as connection:
        connection.sendall(b"\r\n".join((*lines, b"", b"")))
        return int(connection.recv(100).split()[1])


def browser(page: Page, path: str, **options: object) -> ClientConnection:
    address = f"ws://127.0.0.1:{page.port}{path}"
    return connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, **options)


def test_requests_without_the_token_are_refused(page):
    assert answer(page, "/").status == 403
    assert answer(page, place(page)).status == 200
    for path in ("/../../../../../../etc/passwd", "/%2e%2e/%2e%2e/pyproject.toml", "/etc/passwd", "/index.html"):
        assert answer(page, path).status == 403
        assert answer(page, place(page) + path).status == 403
    with pytest.raises(InvalidStatus, match="403"):
        browser(page, "/")
    with pytest.raises(InvalidStatus, match="403"):
        browser(page, place(page), origin="http://evil.example")
    browser(page, place(page)).close()


def test_the_content_policy_allows_the_own_server_and_no_frame(page):
    headers = answer(page, place(page)).headers
    policy = dict(rule.split(" ", 1) for rule in headers["Content-Security-Policy"].split("; "))
    own = f"127.0.0.1:{page.port}"
    assert policy["connect-src"] == f"'self' ws://{own} wss://{own} blob: data:"
    assert policy["frame-ancestors"] == policy["default-src"] == policy["base-uri"] == "'none'"
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Set-Cookie"] is None


def test_pages_of_two_servers_work_at_the_same_time(page):
    """Cookies belong to a host and not to a port, so that no page may depend on one."""
    other = Page("other", Address("0.0.0.0", 0), gaussians=10)
    try:
        assert [answer(one, place(one)).status for one in (page, other, page)] == [200] * 3
        assert [answer(one, place(two)).status for one, two in ((page, other), (other, page))] == [403] * 2
        for one in (page, other):
            browser(one, place(one)).close()
    finally:
        other.close()


def test_malformed_requests_are_refused_without_an_error(page):
    get = b"GET " + place(page).encode() + b" HTTP/1.1"
    host = b"Host: localhost:1"
    assert status(page, get, host) == 200
    assert status(page, get, b"Host: [") == 403
    assert status(page, get) == 403
    assert status(page, get, host, host) == 403
    assert status(page, get, host, b"Origin: http://[") == 403
    assert status(page, get, host, b"Origin: http://localhost:1", b"Origin: null") == 403
    assert status(page, get, host, b"Accept-Encoding: gzip", b"Accept-Encoding: br") == 200
    assert status(page, b"GET //[ HTTP/1.1", host) == 403
    assert status(page, b"GET /\xff HTTP/1.1", host) == 403
    assert status(page, b"GET /%00 HTTP/1.1", host) == 403
    assert status(page, get.replace(b" HTTP", b"?a=" + b"x" * 7000 + b" HTTP"), host) == 403
    assert status(page, get, host, b"Upgrade: websocket", b"Upgrade: websocket") in (400, 426)
    assert status(page, get, host, b"Upgrade: h2c") in (400, 426)


def test_empty_requests_are_not_logged(page, caplog):
    for data in (b"", b"\r\n", b"\xff\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\nHost: "):
        with closing(socket.create_connection(("127.0.0.1", page.port), timeout=20)) as connection:
            connection.sendall(data)
    assert answer(page, place(page)).status == 200
    page.close()
    assert [record for record in caplog.records if record.exc_info] == []


def test_the_number_of_browsers_is_bounded(page):
    with ExitStack() as opened:
        first = [opened.enter_context(browser(page, place(page))) for _ in range(MAX_BROWSERS)]
        with pytest.raises(InvalidStatus, match="503"):
            browser(page, place(page))
        assert answer(page, place(page)).status == 503
        first[0].close()
        browser(page, place(page)).close()


def test_an_ipv6_address_has_brackets():
    try:
        page = Page("test", Address("::1", 0), gaussians=10)
    except InputError as error:
        pytest.skip(f"this machine has no such address: {error}")
    page.close()
    assert re.fullmatch(r"http://\[::1\]:\d+/[\w-]{20,}", page.url)


def test_a_page_without_a_guard_is_not_served():
    guard = Guard.for_host("localhost")
    with pytest.raises(MissingResourceError, match="access control does not work"), guarded(guard):
        pass


def test_addresses_that_cannot_be_listened_on_are_refused(page):
    with pytest.raises(InputError, match="free to listen on"):
        check_address("0.0.0.0", page.port)
    with pytest.raises(InputError, match="from 0 to 65535"):
        check_address("localhost", 65536)
