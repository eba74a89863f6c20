"""Hostile splat files, as input of imports."""

from __future__ import annotations

import gzip
import json
import os
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.images import bomb
from benchmarks.scale.attack.samples import Build, Place, file_of


def _changed(name: str, change: Callable[[bytes], bytes]) -> Build:
    """Write a changed valid file."""

    def build(place: Place) -> str:
        place.write(name, change((place.samples / name).read_bytes()))
        return name

    return build


def _sog(files: Mapping[str, bytes | int]) -> Build:
    """Write an archive; a number stands for as many zeros."""

    def build(place: Place) -> str:
        with zipfile.ZipFile(place.inside / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in files.items():
                archive.writestr(name, bytes(data) if isinstance(data, int) else data)
        return "a.sog"

    return build


def _spz(count: int, rest: bytes = b"") -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0) + rest)


def _special(name: str, make: Callable[[str], object]) -> Build:
    def build(place: Place) -> str:
        make(str(place.inside / name))
        return name

    return build


def _sparse(path: str) -> None:
    with open(path, "wb") as file:  # noqa: PTH123
        file.truncate(64 << 30)


_META = {"version": 2, "count": 10**12, "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["a.webp", "b.webp"]}}

SPLATS: Mapping[str, tuple[str, Build]] = {
    "PLY that promises 10^11": (
        "fill memory",
        _changed("a.ply", lambda d: d.replace(b"vertex 40", b"vertex 99999999999")),
    ),
    "PLY of no numbers": ("crash", _changed("a.ply", lambda d: d[:-400] + b"\xff\xff\xff\x7f" * 100)),
    "PLY header of 10 MB": ("take long", file_of("a.ply", lambda: b"ply\n" + b"comment a\n" * 1_000_000)),
    "PLY with 100,000 properties": (
        "take long",
        file_of(
            "a.ply",
            lambda: (
                "ply\nformat ascii 1.0\nelement vertex 1\n"
                + "".join(f"property float p{i}\n" for i in range(100_000))
                + "end_header\n"
            ),
        ),
    ),
    "PLY of lists": (
        "crash",
        file_of(
            "a.ply",
            lambda: "ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty list uchar int x\nend_header\n",
        ),
    ),
    "PLY cut short": ("crash", _changed("a.ply", lambda d: d[: len(d) // 2])),
    "SPZ of 2^32": ("fill memory", file_of("a.spz", lambda: _spz(0xFFFFFFFF))),
    "SPZ bomb": ("fill memory", file_of("a.spz", lambda: gzip.compress(bytes(1 << 30), 1))),
    "SPZ in SPZ": ("crash", file_of("a.spz", lambda: gzip.compress(_spz(40)))),
    "SPZ cut short": ("crash", _changed("a.spz", lambda d: d[:-9])),
    "SOG bomb": ("fill memory", _sog({"meta.json": 1 << 28})),
    "SOG with a path outside": ("write outside", _sog({"../../outside/made": b"x", "meta.json": b"{}"})),
    "SOG that promises 10^12": ("fill memory", _sog({"meta.json": json.dumps(_META).encode()})),
    "SOG with a picture bomb": (
        "fill memory",
        _sog({"meta.json": json.dumps(_META | {"count": 9}).encode(), "a.webp": bomb(20_000), "b.webp": bomb(20_000)}),
    ),
    "SOG nested 100,000 deep": ("crash", _sog({"meta.json": b"[" * 100_000})),
    "SOG of 100,000 files": ("take long", _sog({f"{i}": b"" for i in range(100_000)})),
    "KSPLAT damaged": ("crash", _changed("a.ksplat", lambda d: d[:8] + b"\xff" * 64 + d[72:])),
    "KSPLAT cut short": ("crash", _changed("a.ksplat", lambda d: d[:100])),
    "compressed PLY that promises 10^9": (
        "fill memory",
        _changed("a.compressed.ply", lambda d: d.replace(b"vertex 40", b"vertex 1000000000")),
    ),
    "SPLAT of 64 GB": ("fill memory", _special("a.splat", _sparse)),
    "SPLAT of zeros": ("crash", file_of("a.splat", lambda: bytes(32 * 1000))),
    "SPLAT of no numbers": ("crash", file_of("a.splat", lambda: b"\xff" * 3200)),
    "SPLAT of 31 bytes": ("crash", file_of("a.splat", lambda: bytes(31))),
    "named pipe": ("wait for ever", _special("a.ply", os.mkfifo)),
    "link to endless zeros": ("fill memory", _special("a.splat", lambda path: Path(path).symlink_to("/dev/zero"))),
    "folder": ("crash", _special("a.ply", os.mkdir)),
}


def _suffix(name: str) -> str:
    return {"named pipe": "a.ply", "folder": "a.ply", "link to endless zeros": "a.splat"}.get(
        name, "a.compressed.ply" if name.startswith("compressed") else f"a.{name.split()[0].lower()}"
    )


ATTACKS = (
    *(
        Attack(
            f"splats: {name}",
            tries,
            build,
            [("mitsplat", "import", _suffix(name), "-o", "made", "--size", "0.1")],
            ANY if name == "SPLAT of zeros" else REFUSED,
        )
        for name, (tries, build) in SPLATS.items()
    ),
    Attack(
        "splats: asset that names a file outside",
        "read outside",
        lambda place: (
            place.take("nut"),
            place.write(
                "nut/asset.yaml",
                (place.samples / "nut/asset.yaml").read_text().replace("splats.ply", "../../outside/secret.txt"),
            ),
        ),
        [("mitsplat", "check", "nut")],
        REFUSED,
    ),
    Attack(
        "splats: asset whose splats are linked elsewhere",
        "read outside",
        lambda place: (
            place.take("nut"),
            (place.inside / "nut/splats.ply").unlink(),
            (place.inside / "nut/splats.ply").symlink_to(place.outside / "secret.txt"),
        ),
        [("mitsplat", "check", "nut")],
        REFUSED,
    ),
)
