"""Hostile images: OpenEXR, photographs, masks, depth maps and images of lights."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.poses import capture_folder
from benchmarks.scale.attack.samples import Place

Build = Callable[[Place], object]

CHECK = ("mitsplat", "check", "scene.yaml")
LIGHTS = ("mitsplat", "lights", "sky.exr", "-o", "lights.yaml")
FIT = ("mitsplat", "fit", "capture", "-o", "made", "--depths", "depths", "--iterations", "1")
CAPTURE = ("mitsplat", "capture", "photos", "-o", "made")


def png(width: int, height: int, rows: bytes, kind: int = 2, bits: int = 8, extra: bytes = b"") -> bytes:
    """Return a PNG of a stated size with arbitrary compressed rows."""
    head = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def chunk(name: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def zeros(count: int) -> bytes:
    """Return compressed zeros without holding them in memory."""
    packer, block = zlib.compressobj(9), bytes(1 << 20)
    parts = [packer.compress(block) for _ in range(count >> 20)]
    return b"".join([*parts, packer.compress(bytes(count & 0xFFFFF)), packer.flush()])


def png_sky(path: Path) -> None:
    """Return a valid panorama."""
    Image.fromarray(np.full((8, 16, 3), 128, np.uint8)).save(path)


def bomb(edge: int) -> bytes:
    """Return a valid black PNG of one bit per pixel, a thousand times smaller than its pixels."""
    return png(edge, edge, zeros(edge * (edge // 8 + 1)), kind=0, bits=1)


def exr(attributes: Mapping[str, tuple[str, bytes]], flags: int = 0, rest: bytes = b"") -> bytes:
    """Return an OpenEXR file of one part with these attributes in addition to the required ones."""
    channel = b"".join(name + b"\0" + struct.pack("<iBxxxii", 2, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<iiii", 0, 0, 15, 7)
    known = {
        "channels": ("chlist", channel),
        "compression": ("compression", b"\x03"),
        "dataWindow": ("box2i", window),
        "displayWindow": ("box2i", window),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", struct.pack("<ff", 0, 0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
    } | dict(attributes)
    rows = [
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
        for name, (kind, data) in known.items()
    ]
    return struct.pack("<II", 20000630, 2 | flags) + b"".join(rows) + b"\0" + rest


def _window(left: int, top: int, right: int, bottom: int) -> dict[str, tuple[str, bytes]]:
    data = struct.pack("<iiii", left, top, right, bottom)
    return {"dataWindow": ("box2i", data), "displayWindow": ("box2i", data)}


def _valid(channels: str = "RGB", value: float = 1.0) -> bytes:
    """Return a valid OpenEXR file of a small panorama."""
    import OpenEXR

    pixels = {name: np.full((8, 16), value, np.float32) for name in channels}
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"mitsplat-attack-{os.getpid()}.exr"
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, pixels) as file:
        file.write(str(path))
    data = path.read_bytes()
    path.unlink()
    return data


def _many_channels() -> bytes:
    name = (b"c%06d" % number for number in range(200_000))
    return b"".join(one + b"\0" + struct.pack("<iBxxxii", 2, 0, 1, 1) for one in name) + b"\0"


_TILES = struct.pack("<IIB", 0x7FFFFFFF, 0x7FFFFFFF, 2)
_TINY = struct.pack("<IIB", 1, 1, 0)
_DEEP = {
    "type": ("string", b"deepscanline"),
    "version": ("int", b"\1\0\0\0"),
    "chunkCount": ("int", b"\xff\xff\xff\x7f"),
    "maxSamplesPerPixel": ("int", b"\xff\xff\xff\x7f"),
    "name": ("string", b"a"),
}

EXRS: Mapping[str, Callable[[], bytes]] = {
    "empty": lambda: b"",
    "cut after the header": lambda: exr({}),
    "cut in half": lambda: _valid()[: len(_valid()) // 2],
    "damaged pixels": lambda: _valid()[:-90] + b"\xff" * 90,
    "window of 2^50 pixels": lambda: exr(_window(0, 0, (1 << 30) - 1, (1 << 20) - 1), rest=bytes(64)),
    "window from -2^31 to 2^31": lambda: exr(_window(-(1 << 31), -(1 << 31), (1 << 31) - 1, (1 << 31) - 1)),
    "window that ends before it begins": lambda: exr(_window(9, 9, -9, -9), rest=bytes(512)),
    "offsets that lead outside": lambda: exr({}, rest=b"\xff" * 4096),
    "deep": lambda: exr(_DEEP, flags=0x800, rest=bytes(4096)),
    "tiles of 2^62 pixels": lambda: exr({"tiles": ("tiledesc", _TILES)}, flags=0x200, rest=bytes(4096)),
    "2^40 tiles": lambda: exr(
        {"tiles": ("tiledesc", _TINY), **_window(0, 0, (1 << 20) - 1, (1 << 20) - 1)}, flags=0x200, rest=bytes(64)
    ),
    "parts without end": lambda: exr(_DEEP, flags=0x1000, rest=exr(_DEEP)[8:] * 2000),
    "200,000 channels": lambda: exr({"channels": ("chlist", _many_channels())}, rest=bytes(4096)),
    "attribute of -1 bytes": lambda: exr({})[:-1] + b"x\0string\0\xff\xff\xff\xff",
    "attribute of 2 GB": lambda: exr({})[:-1] + b"x\0string\0\xff\xff\xff\x7fab",
    "channel names with control characters": lambda: _valid().replace(b"R\0", b"\x1b\0"),
    "infinite radiance": lambda: _valid(value=float("inf")),
    "only not-a-number": lambda: _valid(value=float("nan")),
    "alpha alone": lambda: _valid("A"),
}


_EVERYWHERE = ("window of 2^50 pixels", "damaged pixels", "deep", "empty")
"""Variants that are also tried with lights of scenes, which use the reader of panoramas."""
_DEPTHS = (
    *_EVERYWHERE,
    "cut in half",
    "offsets that lead outside",
    "2^40 tiles",
    "200,000 channels",
    "attribute of 2 GB",
)
"""Variants that are also tried with depth maps, which use another reader."""


def _exr_attacks() -> Iterator[Attack]:
    for name, make in EXRS.items():

        def sky(place: Place, make: Callable[[], bytes] = make) -> None:
            place.write("sky.exr", make())
            place.scene(lights="[{kind: environment, image: sky.exr}]")

        def depth(place: Place, make: Callable[[], bytes] = make) -> None:
            capture_folder(place)
            for index in range(4):
                place.write(f"depths/{index}.exr", make().replace(b"R\0", b"Z\0"))

        tries = "crash the reader of OpenEXR, or fill memory"
        refused = ANY if "characters" in name else REFUSED
        yield Attack(f"exr: panorama, {name}", tries, sky, [LIGHTS], refused)
        if name in _EVERYWHERE:
            yield Attack(f"exr: light, {name}", tries, sky, [CHECK], REFUSED)
        if name in _DEPTHS:
            yield Attack(f"exr: depth map, {name}", tries, depth, [FIT], REFUSED)


def jpeg(exif: bytes = b"", icc: bytes = b"") -> bytes:
    """Return a valid photograph of noise."""
    file = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(file, "JPEG", exif=exif, icc_profile=icc or None)
    return file.getvalue()


def _exif(entries: list[tuple[int, int, int, bytes]], tail: bytes = b"") -> bytes:
    """Return an EXIF block with entries of tag, type, count and value; ``tail`` follows the directory."""
    rows = b"".join(struct.pack("<HHI", *entry[:3]) + entry[3].ljust(4, b"\0")[:4] for entry in entries)
    return b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", len(entries)) + rows + struct.pack("<I", 8) + tail


PHOTOS: Mapping[str, tuple[str, Callable[[], bytes]]] = {
    "png of 40,000x40,000 black pixels": ("a.png", lambda: bomb(40_000)),
    "png that promises 2^62 pixels": ("a.png", lambda: png(0x7FFFFFFF, 0x7FFFFFFF, zeros(1 << 20))),
    "png of 13,000x13,000 in colour": ("a.png", lambda: png(13_000, 13_000, zeros(13_000 * 39_001))),
    "png with a text of 1 GB": (
        "a.png",
        lambda: png(64, 48, zeros(48 * 193), extra=chunk(b"zTXt", b"a\0\0" + zeros(1 << 30))),
    ),
    "png with a colour profile of 1 GB": (
        "a.png",
        lambda: png(64, 48, zeros(48 * 193), extra=chunk(b"iCCP", b"a\0\0" + zeros(1 << 30))),
    ),
    "png with 200,000 texts": ("a.png", lambda: png(64, 48, zeros(48 * 193), extra=chunk(b"tEXt", b"a\0b") * 200_000)),
    "png without pixels": ("a.png", lambda: png(64, 48, b"")),
    "png of no width": ("a.png", lambda: png(0, 48, zeros(48))),
    "jpeg of 65,500x65,500": ("a.jpg", lambda: jpeg().replace(b"\x00\x30\x00\x40\x03", b"\xff\xdc\xff\xdc\x03", 1)),
    "jpeg cut short": ("a.jpg", lambda: jpeg()[:400]),
    "jpeg with an EXIF directory that is its own next": ("a.jpg", lambda: jpeg(_exif([(0x8769, 4, 1, b"\x08\0\0\0")]))),
    "jpeg with an EXIF value of 4 GB": ("a.jpg", lambda: jpeg(_exif([(0x10F, 2, 0xFFFFFFF0, b"\x08\0\0\0")]))),
    "jpeg with EXIF orientation 65535": ("a.jpg", lambda: jpeg(_exif([(0x112, 3, 1, b"\xff\xff")]))),
    "jpeg with EXIF orientation as text": ("a.jpg", lambda: jpeg(_exif([(0x112, 2, 4, b"abc\0")]))),
    "jpeg with EXIF focal length 1/0": (
        "a.jpg",
        lambda: jpeg(
            _exif(
                [(0x8769, 4, 1, b"\x1a\0\0\0")],
                struct.pack("<HHHII", 1, 0x920A, 5, 1, 44) + bytes(4) + struct.pack("<II", 1, 0),
            )
        ),
    ),
    "jpeg with EXIF of 60 kB of 0xff": ("a.jpg", lambda: jpeg(b"Exif\0\0II*\0\x08\0\0\0" + b"\xff" * 60_000)),
    "jpeg with a damaged colour profile": ("a.jpg", lambda: jpeg(icc=b"\xff" * 500)),
    "tiff of 2^32 strips": (
        "a.tif",
        lambda: (
            b"II*\0\x08\0\0\0"
            + struct.pack("<H", 5)
            + b"".join(
                struct.pack("<HHII", *row)
                for row in (
                    (256, 4, 1, 0xFFFFFF),
                    (257, 4, 1, 0xFFFFFF),
                    (258, 3, 1, 8),
                    (273, 4, 0xFFFFFFFF, 8),
                    (279, 4, 0xFFFFFFFF, 8),
                )
            )
            + bytes(4)
        ),
    ),
    "tiff whose directory is its own next": (
        "a.tif",
        lambda: b"II*\0\x08\0\0\0" + struct.pack("<H", 1) + struct.pack("<HHII", 256, 4, 1, 9) + b"\x08\0\0\0",
    ),
    "webp cut short": ("a.webp", lambda: b"RIFF\xff\xff\xff\x7fWEBPVP8L\xff\xff\xff\x7f/\xff\xff\xff\xff"),
    "bmp of -2^31 rows": (
        "a.bmp",
        lambda: (
            b"BM"
            + struct.pack("<IHHI", 0x7FFFFFFF, 0, 0, 54)
            + struct.pack("<IiiHHIIiiII", 40, 0x7FFFFFFF, -(1 << 31), 1, 24, 0, 0, 1, 1, 0, 0)
        ),
    ),
    "program named as a photograph": ("a.jpg", lambda: b"#!/bin/sh\ntouch executed\n"),
    "PostScript named as a photograph": (
        "a.png",
        lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(x) run\n",
    ),
    "HDR header of 2^31 pixels": (
        "a.png",
        lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2147483647 +X 2147483647\n",
    ),
}


def noise_photos(place: Place, folder: str = "photos", count: int = 4) -> None:
    """Write valid photographs without common features."""
    for index in range(count):
        pixels = np.random.default_rng(index).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        path = place.inside / folder / f"{index}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)


def _photo_attacks() -> Iterator[Attack]:
    for name, (file, make) in PHOTOS.items():

        def photos(place: Place, file: str = file, make: Callable[[], bytes] = make) -> None:
            noise_photos(place, count=2)
            place.write(f"photos/{file}", make())

        yield Attack(f"photo: {name}", "crash the reader of photographs, or fill memory", photos, [CAPTURE], ANY)


def _masks(make: Callable[[], bytes]) -> Build:
    def build(place: Place) -> None:
        capture_folder(place)
        for index in range(4):
            place.write(f"masks/{index}.png.png", make())

    return build


def _capture_picture(name: str, data: Callable[[], bytes]) -> Build:
    def build(place: Place) -> None:
        folder = capture_folder(place)
        (folder / name).unlink()
        (folder / name).write_bytes(data())

    return build


def _linked_capture(place: Place) -> None:
    folder = capture_folder(place)
    (folder / "images/0.png").unlink()


def _linked_photos(place: Place) -> None:
    noise_photos(place)


def _pipe_photo(place: Place) -> None:
    noise_photos(place)
    os.mkfifo(place.inside / "photos/pipe.png")


def _odd_names(place: Place) -> None:
    noise_photos(place)
    for name in (
        "new\nline.png",
        "\x1b[31mred.png",
        "-rf.png",
        "$(touch executed).png",
        "%d.png",
        "é.png",
        "a" * 240 + ".png",
    ):
        (place.inside / "photos" / name).write_bytes((place.inside / "photos/1.png").read_bytes())


def _depth(name: str, data: Callable[[], bytes]) -> Build:
    def build(place: Place) -> None:
        capture_folder(place)
        place.write(f"depths/{name}", data())

    return build


def _npy(shape: str, kind: str = "<f4") -> bytes:
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head


def _lit(file: str, make: Callable[[], bytes]) -> Build:
    def build(place: Place) -> None:
        place.write(file, make())
        place.scene(lights=f"[{{kind: environment, image: {file}}}]")

    return build


ATTACKS = (
    *_exr_attacks(),
    *_photo_attacks(),
    Attack("photo: linked folders that go round", "follow links without end", _linked_photos, [CAPTURE], ANY),
    Attack("photo: named pipe", "wait for ever", _pipe_photo, [CAPTURE], ANY),
    Attack("photo: names with control characters", "break lists of names", _odd_names, [CAPTURE], ANY),
    Attack(
        "photo: picture of a capture that is linked elsewhere",
        "show a picture from outside of the capture",
        _linked_capture,
        [("mitsplat", "fit", "capture", "-o", "made", "--iterations", "1", "--gaussians", "50")],
        REFUSED,
    ),
    Attack(
        "photo: bomb in a capture",
        "fill memory",
        _capture_picture("images/1.png", lambda: bomb(40_000)),
        [("mitsplat", "fit", "capture", "-o", "made", "--iterations", "1", "--gaussians", "50")],
        REFUSED,
    ),
    Attack(
        "photo: bomb as a mask",
        "fill memory",
        _masks(lambda: bomb(40_000)),
        [(*CAPTURE, "--poses", "model", "--masks", "masks")],
        ANY,
    ),
    Attack(
        "depth: array of 2^60 numbers",
        "fill memory",
        _depth("0.npy", lambda: _npy("(1073741824, 1073741824)")),
        [FIT],
        REFUSED,
    ),
    Attack("depth: array of -1 numbers", "crash", _depth("0.npy", lambda: _npy("(-1, -1)")), [FIT], REFUSED),
    Attack(
        "depth: array of texts", "crash", _depth("0.npy", lambda: _npy("(1, 1)", "<U9") + bytes(36)), [FIT], REFUSED
    ),
    Attack(
        "depth: header that is a program",
        "run code",
        _depth("0.npy", lambda: _npy("__import__('os').mkdir('executed')")),
        [FIT],
        REFUSED,
    ),
    Attack("depth: PNG bomb", "fill memory", _depth("0.png", lambda: bomb(40_000)), [FIT], REFUSED),
    Attack("light: PNG bomb", "fill memory", _lit("sky.png", lambda: bomb(100_000)), [CHECK], REFUSED),
    Attack(
        "light: HDR of 2^62 pixels",
        "fill memory",
        _lit("sky.hdr", lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2147483647 +X 2147483647\n"),
        [CHECK],
        REFUSED,
    ),
    Attack(
        "light: PFM of 10^18 pixels",
        "fill memory",
        _lit("sky.pfm", lambda: b"PF\n999999999 999999999\n-1.0\n"),
        [CHECK],
        REFUSED,
    ),
)
