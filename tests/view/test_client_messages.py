"""Browser messages that a viewer accepts, and those that it drops."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from mitsplat.view.client_messages import MAX_MESSAGE_BYTES, is_expected
from mitsplat.view.page import Address, Page

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0.0, 0.0, -1.5],
    "fov": 0.9,
    "near": 0.01,
    "far": 1000,
    "image_height": 560,
    "image_width": 320.5,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, -1.0, 0.0],
}
CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage",
    "name": "/cameras/0",
    "instance_index": None,
    "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1.0],
    "screen_pos": [0.5, 0.5],
    "modifier": None,
    "owner": "",
}
POINTER = {key: value for key, value in CLICK.items() if key in ("ray_origin", "ray_direction", "modifier")} | {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "screen_pos": [[0.5, 0.5]],
}
HANDLE = {"type": "TransformControlsUpdateMessage", "name": "/handle", "wxyz": [1, 0, 0, 0], "position": [0, 0, 1]}
NAN, INF = float("nan"), float("inf")


def packed(message: Any) -> bytes:
    return msgspec.msgpack.encode(message)


def control(**updates: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": "abc", "updates": updates}


@pytest.mark.parametrize(
    "message",
    [
        *(CAMERA, CLICK, POINTER, HANDLE),
        *({"type": f"TransformControlsDrag{end}Message", "name": "/handle", "owner": ""} for end in ("Start", "End")),
        *(control(value=value) for value in (True, 3, 0.5, "next", "line\n" * 100, [0.1, 0, 2])),
    ],
    ids=str,
)
def test_messages_of_the_page_are_accepted(message):
    assert is_expected(packed(message))
    viser._messages.Message.deserialize(packed(message))  # fails if viser renames it


@pytest.mark.parametrize(
    "message",
    [
        *(CAMERA | {key: [NAN, 0, 0]} for key in ("look_at", "position", "up_direction")),
        CAMERA | {"wxyz": [NAN, 0, 0, 0]},
        CAMERA | {"wxyz": [0, 0, 0, 0]},
        CAMERA | {"wxyz": [1, 0, 0]},
        CAMERA | {"up_direction": [0, 0, 0]},
        CAMERA | {"look_at": CAMERA["position"]},
        CAMERA | {"look_at": [1e300, 0, 0]},
        CAMERA | {"position": [0, 0]},
        CAMERA | {"position": "123"},
        CAMERA | {"position": ["1", "2", "3"]},
        CAMERA | {"position": None},
        *(CAMERA | {"fov": fov} for fov in (NAN, INF, "wide", None)),
        CAMERA | {"else": 1},
        {key: value for key, value in CAMERA.items() if key != "fov"},
        CLICK | {"ray_direction": [0, 0, 0]},
        POINTER | {"ray_origin": None},
        POINTER | {"event_type": "rect-select"},
        POINTER | {"screen_pos": [[0, 0]] * 1000},
        HANDLE | {"position": [INF, 0, 0]},
        *(control(value=value) for value in (NAN, [NAN, 0, 0], [1] * 100, {"a": 1}, None, b"x", "x" * 20_000, 1e300)),
        control(sync_cb=5),
        control(value=1, update_cb=[]),
        control(),
        {"type": "ShareUrlRequest"},
        {"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "b"},
        {"type": "GetRenderResponseMessage", "payload": b"x"},
        {"type": "SceneNodeUpdateMessage", "name": "/", "updates": {}},
        *({"type": kind} for kind in ("Message", "", None, 5, [])),
        *({}, [], 5, None, "ViewerCameraMessage"),
    ],
    ids=str,
)
def test_other_messages_are_dropped(message):
    assert not is_expected(packed(message))


@pytest.mark.parametrize("raw", ["text", b"", b"\xc1", b"\x91" * 60_000, b"\xdd\xff\xff\xff\xff", packed(CAMERA)[:-3]])
def test_bytes_that_are_not_a_message_are_dropped(raw):
    assert not is_expected(raw)


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page("test", Address(port=0), gaussians=10)
    yield page
    page.close()


def joined(page: Page) -> ClientConnection:
    """Connect a browser that has sent its camera."""
    address = page.url.replace("http://", "ws://")
    browser = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)
    browser.send(packed(CAMERA))
    return browser


def until(what: Callable[[], Any]) -> Any:
    """Return the first true answer."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        if answer := what():
            return answer
        time.sleep(0.02)
    raise TimeoutError(what)


def test_a_dropped_message_does_not_end_the_connection(page):
    seen: list[float] = []
    box = page.gui.add_number("strength", 1.0)
    box.on_update(lambda _: seen.append(box.value))
    with joined(page) as browser:
        until(page._server.get_clients)
        browser.send("text")
        for message in (CAMERA | {"look_at": [NAN, 0, 0]}, {"type": "ShareUrlRequest"}, control(sync_cb=5)):
            browser.send(packed(message))
        browser.send(packed(control(value=NAN) | {"uuid": box._impl.uuid}))
        browser.send(packed(control(value=4) | {"uuid": box._impl.uuid}))
        until(lambda: seen)
        assert seen == [4.0]
        (client,) = page._server.get_clients().values()
        assert client.camera.look_at == pytest.approx((0, 0, 0))


def test_a_large_message_closes_its_own_connection_only(page):
    with joined(page) as other, joined(page) as browser:
        until(lambda: len(page._server.get_clients()) == 2)
        browser.send(b"x" * (MAX_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed, match="1009"):
            while True:
                browser.recv(timeout=20)
        until(lambda: len(page._server.get_clients()) == 1)
        other.ping().wait(20)


def test_messages_are_read_no_faster_than_they_are_handled(page):
    """The number of jobs that wait for a thread is bounded, however many messages a browser sends."""
    held: Future[None] = Future()
    page.on_move(lambda camera: held.result())
    start = page._server.initial_camera
    start.position, start.look_at = CAMERA["position"], CAMERA["look_at"]
    threads = page._server._thread_executor
    with joined(page) as browser:
        until(page._server.get_clients)
        for _ in range(100):
            browser.send(packed(CAMERA))
        until(lambda: threads._work_queue.qsize() > 0)  # all threads are busy
        time.sleep(0.5)
        waiting = threads._work_queue.qsize()
        held.set_result(None)
    assert waiting < 10
