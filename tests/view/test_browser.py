"""Scene page in headless Chromium: loading, splats, and controls."""

from __future__ import annotations

import http.server
import io
import select
import shutil
import signal
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from ruamel.yaml import YAML

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.view.page import Address, Page
from mitsplat.view.scene_parts import ShownPart, ShownSplats
from tests.bodies import pose_at
from tests.capture.isolation.balls import capture_of_balls
from tests.conftest import box_asset, small_scene

pytestmark = pytest.mark.slow

LONG = 300.0  # seconds; an idle machine needs one
OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--window-size=1100,560"),
)
BEGIN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from mitsplat.cli import main; main()"
"""Runs the command with Ctrl-C enabled, also where the test runner ignores it."""
FEW_PICTURES = "const draw = window.requestAnimationFrame; window.requestAnimationFrame = f => setTimeout(draw, 200, f)"
"""Limits a page to five pictures per second. Without a GPU, a page that draws all the time would take every core."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("chromium and chromedriver are not installed: `make browser` does that on Debian")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    started.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": FEW_PICTURES})
    yield started
    started.quit()


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a scene of one red box."""
    folder = tmp_path_factory.mktemp("scene")
    box = box_asset("nut", (0.09, 0.09, 0.09))
    sh = np.tile(np.float32([1.7, -1.7, -1.7]), (12, 1, 1))
    scales = np.full((12, 3), 0.02, dtype=np.float32)
    red = Splats(box.splats.means, box.splats.quats, scales, np.full(12, 0.99), sh)
    small_scene(folder, [replace(box, splats=red)], [{"asset": "assets/nut"}], layouts=1, views=2)
    path = folder / "scene.yaml"
    data = YAML(typ="safe").load(path)
    data["shapes"] = [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}}]
    data["quality"] = "fast"
    YAML(typ="safe", pure=True).dump(data, path)
    return path


def until(what: Callable[[], Any]) -> Any:
    """Return the first true answer."""
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        if answer := what():
            return answer
        time.sleep(0.2)
    raise TimeoutError(what)


def screen(browser: Any) -> np.ndarray:
    """Return the screenshot (H, W, 3): the render on the left, splats in the middle, controls on the right.

    chromedriver ends a screenshot after 10 s, which a busy machine exceeds; it is then taken again.
    """
    from selenium.common.exceptions import TimeoutException

    def taken() -> bytes:
        with suppress(TimeoutException):
            return bytes(browser.get_screenshot_as_png())
        return b""

    return np.asarray(Image.open(io.BytesIO(until(taken))).convert("RGB")).astype(int)


def render(browser: Any) -> np.ndarray:
    return screen(browser)[:, :450]


def redness(pixels: np.ndarray) -> float:
    """Return the share of pixels that are roughly red."""
    return float(((pixels[..., 0] > 90) & (pixels[..., 1:] < 70).all(axis=-1)).mean())


@contextmanager
def served(browser: Any, path: Path) -> Iterator[None]:
    """Open the page of a path in the browser; the command must exit with status 0 on Ctrl-C."""
    command = [sys.executable, "-c", BEGIN, "view", str(path), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            browser.get(serving.stdout.readline().split()[1])
            yield
        except TimeoutError:
            browser.save_screenshot(str(path.with_name("browser.png")))
            raise
        finally:
            serving.send_signal(signal.SIGINT)
            assert serving.wait(LONG) == 0


def test_the_page_of_a_scene_works_in_chromium(browser, scene_file):
    with served(browser, scene_file):
        use_page(browser, scene_file)


def sphere_splats(count: int, scale: float, opacity: float, hue: tuple[int, int, int], *, seed: int = 0) -> Splats:
    """Return Gaussians of one size [m] and colour on a sphere with a radius of 5 cm."""
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    return Splats(
        0.05 * points / np.linalg.norm(points, axis=1, keepdims=True),
        np.tile(np.float32([0, 0, 0, 1]), (count, 1)),
        np.full((count, 3), scale, dtype=np.float32),
        np.full(count, opacity, dtype=np.float32),
        np.tile(3.4 * np.float32(hue) - 1.7, (count, 1, 1)),
    )


def test_all_of_several_large_clouds_are_shown(browser):
    """The browser sorts and draws the Gaussians of all clouds together, so that their number is limited together."""
    hues = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0)}
    parts = []
    for number, (name, hue) in enumerate(hues.items()):
        splats = sphere_splats(10_000, 1.6e-3, 0.99, hue, seed=number)
        parts.append(ShownPart(f"/splats/{name}", ShownSplats(splats), pose_at((0.11 * (number - 1.5), 0, 0))))
    page = Page("large clouds", Address(port=0), gaussians=4_000)
    try:
        page.show(parts)
        page.look_through(Camera.look_at((0, -0.6, 0.1), (0, 0, 0), width=290, height=560, fov_x=45))
        browser.get(page.url)

        def shown() -> bool:
            pixels = screen(browser)[:, 490:770]
            near = [(np.abs(pixels - 255 * np.array(hue)) < 90).all(axis=-1).mean() for hue in hues.values()]
            return min(near) > 0.005

        until(shown)
        assert "3,532 of 40,000 Gaussians are shown" in browser.find_element("tag name", "body").text
    finally:
        page.close()


def test_an_object_of_gaussians_smaller_than_a_pixel_is_shown(browser):
    """viser leaves out Gaussians smaller than about half a pixel."""
    splats = sphere_splats(20_000, 2e-4, 0.8, (1, 0, 0))
    page = Page("small Gaussians", Address(port=0), gaussians=20_000)
    try:
        page.look_through(Camera.look_at((0, -1.1, 0), (0, 0, 0), width=290, height=560, fov_x=25))
        page.show([ShownPart("/splats/red", ShownSplats(splats), np.eye(4))])
        browser.get(page.url)
        until(lambda: redness(screen(browser)[:, 490:770]) > 0.005)
    finally:
        page.close()


def faults(browser: Any) -> list[str]:
    """Return the browser's errors since the last call."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@contextmanager
def foreign_site(page_body: str) -> Iterator[tuple[str, str, list[str]]]:
    """Serve a page on another port with this body, its websocket as {own}, and record requests to it."""
    from websockets.sync.server import serve

    class Site(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            pass

    visits: list[str] = []
    sockets = serve(
        lambda connection: visits.append(connection.request.path),
        *("localhost", 0),
        select_subprotocol=lambda _, offered: offered[0] if offered else None,
    )
    own = f"ws://localhost:{sockets.socket.getsockname()[1]}"
    body = page_body.format(own=own).encode()
    site = http.server.ThreadingHTTPServer(("localhost", 0), Site)
    for server in (sockets, site):
        threading.Thread(target=server.serve_forever, daemon=True).start()
    with site:
        yield f"http://localhost:{site.server_port}/", own, visits
        site.shutdown()
    sockets.shutdown()


CONNECT = """
const [address, done] = arguments;
const socket = new WebSocket(address);
socket.onopen = () => done("open");
socket.onerror = () => done("refused");
"""


def test_another_site_cannot_frame_or_redirect_the_page(browser):
    page = Page("test", Address(port=0), gaussians=10)
    foreign = "websocket={own}"
    addresses = [page.url, f"{page.url}?{foreign}", f"{page.url.rpartition('/')[0]}/?{foreign}"]
    frames = "".join(f'<iframe src="{address}"></iframe>' for address in addresses)
    links = "".join(f'<p><a href="{address}">{address}</a></p>' for address in addresses)
    try:
        with foreign_site(frames + links) as (address, own, visits):
            for number in (1, 2):
                browser.get(address)
                time.sleep(1)
                browser.find_elements("css selector", "a")[number].click()
                until(lambda: "mitsplat view:" in browser.page_source)
            browser.get_log("browser")
            browser.get(address)
            until(lambda: any("frame-ancestors" in fault for fault in faults(browser)))
            assert not page._server.get_clients()
            browser.find_elements("css selector", "a")[0].click()  # a link with the token works
            until(page._server.get_clients)
            browser.refresh()
            until(lambda: page._server.get_clients() and "websocket=" in browser.current_url)
            assert faults(browser) == []
            assert browser.execute_async_script(CONNECT, own) == "refused"
            assert any("Content Security Policy" in fault for fault in faults(browser))
            assert visits == []
    finally:
        page.close()


def test_a_page_works_through_a_forwarded_port(browser):
    """The port is forwarded as by ``ssh -L 9090:localhost:8080``."""
    page = Page("test", Address(port=0), gaussians=10)
    try:
        with forwarded(page.port) as port:
            browser.get("about:blank")
            browser.get_log("browser")
            browser.get(page.url.replace(f":{page.port}/", f":{port}/"))
            until(page._server.get_clients)
            assert faults(browser) == []
    finally:
        page.close()


@contextmanager
def forwarded(target: int) -> Iterator[int]:
    """Forward a port of this machine to another one."""

    class Pipe(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            with socket.create_connection(("localhost", target)) as there:
                ends = {self.request: there, there: self.request}
                while True:
                    for end in select.select(list(ends), [], [])[0]:
                        if not (data := end.recv(1 << 16)):
                            return
                        ends[end].sendall(data)

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True

    with Server(("localhost", 0), Pipe) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


def test_a_click_on_a_capture_picks_the_object(browser, tmp_path):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    def yellow() -> float:
        pixels = screen(browser)[:, 480:770]
        return float(((pixels[..., :2] > 160).all(axis=-1) & (pixels[..., 2] < 60)).mean())

    def choice(says: str) -> Any:
        """Return the selection box while it has this value, otherwise None."""
        boxes = "[...document.querySelectorAll('input')]"
        return browser.execute_script(
            f"return {boxes}.find(box => box.value == arguments[0] && box.offsetParent)", says
        )

    capture_of_balls(tmp_path)
    with served(browser, tmp_path / "capture"):
        until(lambda: choice("nothing"))
        until(lambda: screen(browser)[:, 480:770].std() > 10)  # the points are drawn
        assert yellow() == 0
        choice("nothing").click()
        choice("nothing").send_keys(Keys.ARROW_DOWN, Keys.ENTER)
        until(lambda: choice("marks the object"))
        canvas = browser.find_elements(By.TAG_NAME, "canvas")[0]

        def picked() -> bool:
            ActionChains(browser).move_to_element(canvas).click().perform()
            time.sleep(1)
            return "--pick " in browser.find_element(By.TAG_NAME, "body").text

        until(picked)
        until(lambda: yellow() > 0.003)


def use_page(browser: Any, scene_file: Path) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    def text() -> str:
        return str(browser.find_element(By.TAG_NAME, "body").text)

    def changed(before: np.ndarray) -> bool:
        return "exact" in text() and bool(np.abs(render(browser) - before).mean() > 1)

    until(lambda: "exact" in text() and "blending-order error" in text())
    until(lambda: redness(screen(browser)[:, 490:770]) > 0.005)  # the red splats
    first = render(browser)
    assert redness(first) > 0.005
    written = [area.get_attribute("value") for area in browser.find_elements(By.TAG_NAME, "textarea")]
    assert not [text for text in written if "camera:" in text]  # the camera was not moved

    browser.find_element(By.CSS_SELECTOR, "[role=slider]").send_keys(Keys.ARROW_RIGHT)  # the next frame
    until(lambda: changed(first))
    second = render(browser)

    good = scene_file.read_text()
    data = YAML(typ="safe").load(good)
    data["camera"]["height"] = 0.8
    YAML(typ="safe", pure=True).dump(data, scene_file)
    until(lambda: changed(second))

    data["region"]["max"][2] = -1
    YAML(typ="safe", pure=True).dump(data, scene_file)
    until(lambda: "must be above min along z (got -1, min is 0.02)" in text())
    assert redness(screen(browser)[:, 490:770]) > 0.005  # the last valid scene remains
    scene_file.write_text(good)
    until(lambda: "must be above" not in text())
