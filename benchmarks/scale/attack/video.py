"""Hostile videos."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.images import bomb
from benchmarks.scale.attack.samples import Place

Build = Callable[[Place], object]
CAPTURE = ("mitsplat", "capture", "a.mp4", "-o", "made", "--frames", "3")
"""Settings with few frames: if a video can be decoded, structure from motion runs on them."""


def _file(make: Callable[[Place], str | bytes]) -> Build:
    return lambda place: place.write("a.mp4", make(place))


def _walk(change: Callable[[bytes], bytes]) -> Build:
    """Write the changed valid video; its format is detected from its content."""
    return lambda place: place.write("a.mp4", change((place.samples / "walk.avi").read_bytes()))


def _size(data: bytes, width: int, height: int) -> bytes:
    return data.replace(struct.pack("<II", 128, 96), struct.pack("<II", width, height))


def _pipe(place: Place) -> None:
    os.mkfifo(place.inside / "a.mp4")


def _sparse(place: Place) -> None:
    place.write("a.mp4", (place.samples / "walk.avi").read_bytes())
    os.truncate(place.inside / "a.mp4", 1 << 30)


VIDEOS: Mapping[str, Build] = {
    "list of files outside": _file(lambda p: f"ffconcat version 1.0\nfile '{p.outside}/secret.png'\nduration 9\n"),
    "playlist of files outside": _file(
        lambda p: f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile://{p.outside}/secret.png\n#EXT-X-ENDLIST\n"
    ),
    "playlist of a server": _file(lambda p: "#EXTM3U\n#EXTINF:9,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n"),
    "session of a server": _file(lambda p: "v=0\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n"),
    "program of ImageMagick": _file(lambda p: f"push graphic-context\nimage over 0,0 0,0 '{p.outside}/secret.png'\n"),
    "empty": _file(lambda p: b""),
    "zeros": _file(lambda p: bytes(1 << 20)),
    "picture bomb": _file(lambda p: bomb(40_000)),
    "raw video of 100,000 x 100,000": _file(lambda p: b"YUV4MPEG2 W100000 H100000 F30:1 C420\nFRAME\n" + bytes(999)),
    "raw video of 10^9 frames a second": _file(
        lambda p: b"YUV4MPEG2 W64 H48 F1000000000:1 C420\n" + (b"FRAME\n" + bytes(64 * 48 * 3 // 2)) * 20
    ),
    "raw video of 0 frames a second": _file(
        lambda p: b"YUV4MPEG2 W64 H48 F0:0 C420\n" + (b"FRAME\n" + bytes(64 * 48 * 3 // 2)) * 20
    ),
    "header that promises 2^31 frames": _walk(
        lambda d: d.replace(struct.pack("<I", 30), struct.pack("<I", 0x7FFFFFFF))
    ),
    "frames of 60,000 x 60,000": _walk(lambda d: _size(d, 60_000, 60_000)),
    "cut in half": _walk(lambda d: d[: len(d) // 2]),
    "index of rubbish": _walk(lambda d: d[:-400] + b"\xff" * 400),
    "frames of rubbish": _walk(lambda d: d[:3000] + b"\x5a" * (len(d) - 4000) + d[-1000:]),
    "chunk of 4 GB": _walk(lambda d: d[:4] + b"\xff\xff\xff\xff" + d[8:]),
    "pipe": _pipe,
    "1 GB of zeros at its end": _sparse,
}

DECODED = ("1 GB of zeros at its end", "frames of 60,000 x 60,000", "index of rubbish", "chunk of 4 GB")
"""Videos whose frames FFmpeg finds in spite of the damage."""

ATTACKS = tuple(
    Attack(
        f"video: {name}",
        "crash the decoder, fill memory or read outside",
        build,
        [CAPTURE],
        ANY if name in DECODED else REFUSED,
    )
    for name, build in VIDEOS.items()
)
