"""Viewer under load: many browsers that never read, messages of 49 MB, requests without a token, and killed browsers.

    python -m benchmarks.scale.viewer [--scene scenes/workcell.yaml] [--browsers 150] [--megabytes 49] [--killed 100]

The viewer is a process of ``mitsplat view``, whose memory and threads are read from the system. Its page is requested
five times per second during the test. Finally a browser connects and reads everything shown, and Ctrl-C ends the
viewer.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from benchmarks.record import ROOT, figure, recording

BEGIN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from mitsplat.cli import main; main()"
CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": [0.0, 1.0, 0.0, 0.0], "position": [0.0, 0.0, 1.5], "look_at": [0.0, 0.0, 0.0]},
    **{"up_direction": [0.0, 1.0, 0.0], "fov": 0.9, "near": 0.01, "far": 1000.0},
    **{"image_height": 560, "image_width": 320},
}


class Probe:
    """Requests the page until stopped, and monitors the memory of the process.

    Attributes:
        longest: Longest time to an answer [s].
        answers: Number of answers by status.
        peak: Largest resident memory [MiB].
    """

    def __init__(self, url: str, pid: int) -> None:
        self._url, self._pid = url, pid
        self.longest, self.peak = 0.0, 0.0
        self.answers: Counter[int] = Counter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Probe:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.2):
            start = time.perf_counter()
            self.answers[status(self._url)] += 1
            self.longest = max(self.longest, time.perf_counter() - start)
            self.peak = max(self.peak, process_values(self._pid)[0])


def status(url: str) -> int:
    """Return the status of the answer to a request; 0 without an answer."""
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            answer.read()
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return 0


def process_values(pid: int) -> tuple[float, int, int]:
    """Return resident memory [MiB], threads and open files of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    values = {key: value.split() for key, _, value in (line.partition(":") for line in lines)}
    files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return int(values["VmRSS"][0]) / 1024, int(values["Threads"][0]), files


async def joined(url: str) -> ClientConnection:
    """Connect as a browser, and send its camera."""
    address = url.replace("http://", "ws://")
    options: dict[str, Any] = {"max_size": None, "compression": None, "open_timeout": 60}
    browser = await connect(address, subprotocols=[f"viser-v{viser.__version__}"], **options)  # type: ignore[list-item]
    await browser.send(msgspec.msgpack.encode(CAMERA))
    return browser


async def crowd(url: str, count: int, size: int) -> Counter[str]:
    """Connect browsers that never read, let each send a large message, and count the outcomes."""
    ends: Counter[str] = Counter()
    opened: list[ClientConnection] = []
    for result in await asyncio.gather(*(joined(url) for _ in range(count)), return_exceptions=True):
        if isinstance(result, BaseException):
            ends[f"refused {result.response.status_code}" if isinstance(result, InvalidStatus) else "failed"] += 1
        else:
            opened.append(result)
    ends["connected"] = len(opened)
    await asyncio.sleep(3)
    message = b"x" * size
    for browser in opened:
        with contextlib.suppress(ConnectionClosed):
            await browser.send(message)
            await browser.wait_closed()
        ends[f"closed {browser.close_code}"] += 1
    return ends


async def shown_camera(browser: ClientConnection) -> dict[str, Any]:
    """Return the camera that the page sends to a new browser, in the form of a browser's message."""
    places: dict[str, Any] = {}
    while len(places) < 2:
        data = bytes(await browser.recv())
        packed = zstandard.ZstdDecompressor().decompress(data[16 : 16 + int.from_bytes(data[8:16], "little")])
        for message in msgspec.msgpack.decode(packed)["messages"]:
            if message["type"] in ("SetCameraPositionMessage", "SetCameraLookAtMessage"):
                places |= {key: message[key] for key in ("position", "look_at") if key in message}
    return CAMERA | places


async def kill_browsers(url: str, count: int) -> None:
    """Connect one browser after another, move its camera, and break the connection during the rendering."""
    for number in range(count):
        browser = await joined(url)
        start = await shown_camera(browser)
        x, y, z = start["position"]
        for camera in (start, start | {"position": [x, y, z + 0.001 * (number + 1)]}):
            await browser.send(msgspec.msgpack.encode(camera))
        await asyncio.sleep(0.02 * (number % 10))
        browser.transport.abort()


async def read_all(url: str) -> float:
    """Connect and read until nothing arrives for a second; return the size of the data read [MiB]."""
    browser, size = await joined(url), 0
    with contextlib.suppress(TimeoutError):
        while True:
            size += len(await asyncio.wait_for(browser.recv(), 1.0 if size else 60.0))
    await browser.close()
    return size / 2**20


@contextlib.contextmanager
def served(scene: Path) -> Iterator[tuple[str, int, Callable[[], int]]]:
    """Yield address and process of a viewer, and a function that ends it as by Ctrl-C and returns its status."""
    command = [sys.executable, "-P", "-c", BEGIN, "view", str(scene), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:

        def end() -> int:
            viewer.send_signal(signal.SIGINT)
            return viewer.wait(120)

        try:
            yield str(viewer.stdout.readline()).split()[1], viewer.pid, end  # type: ignore[union-attr]
        finally:
            viewer.kill()


def main() -> None:
    """Measure, and print a line per phase."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes" / "workcell.yaml")
    parser.add_argument("--browsers", type=int, default=150)
    parser.add_argument("--megabytes", type=int, default=49)
    parser.add_argument("--killed", type=int, default=100)
    options = parser.parse_args()
    with recording("scale.viewer", parser, options), served(options.scene) as (url, pid, end):
        shown = asyncio.run(read_all(url))
        figure(shown, "MiB", "sent to a browser")
        time.sleep(20)  # wait for the first images
        begin = process_values(pid)
        phases: dict[str, Callable[[], object]] = {
            "crowd": lambda: asyncio.run(crowd(url, options.browsers, options.megabytes << 20)),
            "strangers": lambda: Counter(status(url.rpartition("/")[0] + "/") for _ in range(options.browsers)),
            "killed": lambda: asyncio.run(kill_browsers(url, options.killed)),
            "killed again": lambda: asyncio.run(kill_browsers(url, options.killed)),
        }
        for name, phase in phases.items():
            with Probe(url, pid) as probe:
                counts = phase()
            time.sleep(5)
            memory, threads, files = process_values(pid)
            load_text = f"page {dict(probe.answers)} in at most {probe.longest:.2f} s; peak {probe.peak:.0f} MiB"
            left = f"after it {memory:.0f} MiB, {threads} threads, {files} files (began with {begin})"
            print(f"{name}: {dict(counts) if isinstance(counts, Counter) else 'done'}; {load_text}; {left}", flush=True)
            figure(probe.longest, "s", name, "longest answer")
            figure(probe.peak - begin[0], "MiB", name, "peak above begin")
            figure(memory - begin[0], "MiB", name, "left above begin")
            figure(threads - begin[1], "", name, "threads above begin")
            figure(files - begin[2], "", name, "files above begin")
            if isinstance(counts, Counter):
                for what, count in counts.items():
                    figure(count, "", name, what)
        figure(asyncio.run(read_all(url)), "MiB", "sent to a browser at the end")
        result = end()
        figure(result, "", "exit status")
        print(f"exit status {result}")


if __name__ == "__main__":
    main()
