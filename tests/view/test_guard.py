"""Who may open the page."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from mitsplat.errors import InputError, MissingResourceError
from mitsplat.view.guard import COOKIE, Guard, check_address, guarded
from mitsplat.view.page import Address, Page

TOKEN = "a-token"


@pytest.mark.parametrize(
    ("path", "host", "origin", "refused"),
    [
        ("/", "localhost:8080", None, False),
        ("/", "127.0.0.1:8080", "http://127.0.0.1:8080", False),
        ("/", "[::1]:8080", None, False),
        ("/", "evil.example:8080", "http://evil.example:8080", True),  # a name that was made to lead here
        ("/", "localhost:8080", "http://evil.example", True),
        ("/", "localhost:8080", "http://localhost:3000", True),
        ("/", "localhost:8080", "null", True),
        ("/", "", None, True),
    ],
)
def test_without_a_token_this_machine_alone_may_ask(path, host, origin, refused):
    assert (Guard().refusal(path, host, origin, "") is not None) == refused


@pytest.mark.parametrize(
    ("path", "origin", "cookies", "refused"),
    [
        ("/", None, "", True),
        (f"/?token={TOKEN}", None, "", False),
        ("/?token=", None, "", True),
        ("/?token=ä", None, "", True),
        ("/", None, f"other=1; {COOKIE}={TOKEN}", False),
        ("/", None, f"{COOKIE}=x{TOKEN}", True),
        ("/", None, "\x00=;;", True),
        ("/", "http://host:1", f"{COOKIE}={TOKEN}", False),
        ("/", "http://evil.example", f"{COOKIE}={TOKEN}", True),
    ],
)
def test_elsewhere_a_token_is_asked_for(path, origin, cookies, refused):
    assert (Guard(TOKEN).refusal(path, "host:1", origin, cookies) is not None) == refused


def test_only_this_machine_needs_none():
    assert Guard.of_host("localhost") == Guard.of_host("127.0.0.1") == Guard(None)
    one, other = Guard.of_host("0.0.0.0"), Guard.of_host("0.0.0.0")
    assert len(one.token) >= 20
    assert one != other


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page("test", Address("0.0.0.0", 0), gaussians=10)
    yield page
    page.close()


def answer(page: Page, path: str, **headers: str) -> http.client.HTTPResponse:
    with closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        response.read()
        return response


def test_a_server_asks_its_visitors(page):
    token = page.url.partition("token=")[2]
    assert answer(page, "/").status == 403
    first = answer(page, f"/?token={token}")
    assert first.status == 200
    cookie = first.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    known = {"Cookie": cookie.partition(";")[0]}
    assert answer(page, "/", **known).status == 200
    for path in ("/../../../../../../etc/passwd", "/%2e%2e/%2e%2e/pyproject.toml", "/etc/passwd"):
        assert answer(page, path, **known).status == 404
    address = f"ws://127.0.0.1:{page.port}/"
    with pytest.raises(InvalidStatus, match="403"):
        connect(address)
    with pytest.raises(InvalidStatus, match="403"):
        connect(address, additional_headers=known, origin="http://evil.example")
    connect(address, additional_headers=known, subprotocols=["viser-v0"]).close()


def test_a_page_that_is_not_guarded_is_not_served():
    with pytest.raises(MissingResourceError, match="cannot be guarded"), guarded(Guard()):
        pass


def test_what_cannot_be_listened_on_is_refused(page):
    with pytest.raises(InputError, match="free to listen on"):
        check_address("0.0.0.0", page.port)
    with pytest.raises(InputError, match="from 0 to 65535"):
        check_address("localhost", 65536)


def test_no_browser_makes_the_server_open_a_tunnel(page):
    import viser

    assert not page._server._websock_server._incoming_handlers.get(viser._messages.ShareUrlRequest)
    assert Path(viser.__file__).is_file()
