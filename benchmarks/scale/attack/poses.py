"""Hostile cameras: COLMAP models, ``transforms.json`` and the folders of captures."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.samples import Place

CAPTURE = ("mitsplat", "capture", "photos", "-o", "made", "--poses", "model", "--kind", "environment")
TRANSFORMS = ("mitsplat", "capture", "photos", "-o", "made", "--poses", "transforms.json", "--kind", "environment")
FIT = ("mitsplat", "fit", "capture", "-o", "made", "--iterations", "1", "--gaussians", "50")


def _photos(folder: Path) -> None:
    folder.mkdir(parents=True)
    for index in range(4):
        pixels = np.random.default_rng(index).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{index}.png")


def colmap_capture(place: Place) -> Path:
    """Write four photographs and a valid COLMAP model of them in text; return the model's folder."""
    _photos(place.inside / "photos")
    points = range(1, 60)
    images = [
        f"{index + 1} 1 0 0 0 {0.1 * index} 0 1 1 {index}.png\n" + " ".join(f"{p % 60} {p % 40} {p}" for p in points)
        for index in range(4)
    ]
    place.write("model/cameras.txt", "1 PINHOLE 64 48 60 60 32 24\n")
    place.write("model/images.txt", "\n".join(images) + "\n")
    tracks = " ".join(f"{index + 1} {{0}}" for index in range(4))
    rows = [f"{p} {p % 7} {p % 5} {3 + p % 3} 9 9 9 0.1 " + tracks.format(p - 1) for p in points]
    place.write("model/points3D.txt", "\n".join(rows) + "\n")
    return place.inside / "model"


def capture_folder(place: Place) -> Path:
    """Write a valid capture of four photographs, beside a COLMAP model of them; return its folder."""
    from mitsplat.capture.capture import Capture, Photo
    from mitsplat.geometry.camera import Camera

    colmap_capture(place)
    photos = [
        Photo(
            f"{index}.png",
            place.inside / f"photos/{index}.png",
            Camera.look_at((0.1 * index, -1, 0.2), (0, 0, 0), width=64, height=48, fov_x=50),
            seen=np.arange(40, dtype=np.int32),
        )
        for index in range(4)
    ]
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    Capture(tuple(photos), points, np.full((40, 3), 99, np.uint8)).save(place.inside / "capture")
    return place.inside / "capture"


def _replaced(file: str, change: Callable[[str], str]) -> Callable[[Place], object]:
    def build(place: Place) -> None:
        path = colmap_capture(place) / file
        path.write_text(change(path.read_text()))

    return build


def _binary(file: str, data: bytes) -> Callable[[Place], object]:
    """Write a binary model with one given file."""

    def build(place: Place) -> None:
        model = colmap_capture(place)
        import pycolmap

        pycolmap.Reconstruction(str(model)).write_binary(str(model))
        for path in model.glob("*.txt"):
            path.unlink()
        (model / f"{file}.bin").write_bytes(data if data else (model / f"{file}.bin").read_bytes()[:-5])

    return build


def _linked(target: str, file: str) -> Callable[[Place], object]:
    def build(place: Place) -> None:
        model = colmap_capture(place)
        (model / file).unlink()
        (model / file).symlink_to(Path(target) if target.startswith("/") else place.outside / target)

    return build


_MANY = struct.pack("<Q", 1 << 62)
_ONE = struct.pack("<Q", 1)

MODELS: Mapping[str, Callable[[Place], object]] = {
    "cameras cut short": _binary("cameras", b""),
    "images cut short": _binary("images", b""),
    "points cut short": _binary("points3D", b""),
    "2^62 cameras": _binary("cameras", _MANY),
    "2^62 images": _binary("images", _MANY),
    "2^62 points": _binary("points3D", _MANY),
    "lens model 2^31": _binary("cameras", _ONE + struct.pack("<iiQQ", 1, 0x7FFFFFFF, 64, 48) + bytes(64)),
    "camera of 2^63 pixels": _binary(
        "cameras", _ONE + struct.pack("<iiQQdddd", 1, 1, 1 << 63, 1 << 63, 60, 60, 32, 24)
    ),
    "image with 2^62 points": _binary(
        "images", _ONE + struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 1, 1) + b"0.png\0" + _MANY
    ),
    "image whose name does not end": _binary(
        "images", _ONE + struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 1, 1) + b"a" * (1 << 24)
    ),
    "point with a track of 2^62": _binary("points3D", _ONE + struct.pack("<Q3d3Bd", 1, 0, 0, 1, 9, 9, 9, 0) + _MANY),
    "poses that are no number": _replaced(
        "images.txt", lambda text: text.replace("1 0 0 0 0.1", "nan nan nan nan inf")
    ),
    "quaternions of zero": _replaced("images.txt", lambda text: text.replace(" 1 0 0 0 ", " 0 0 0 0 ")),
    "poses 1e300 away": _replaced("images.txt", lambda text: text.replace("0 0.1 0 1", "0 1e300 -1e300 1e300")),
    "points that are no number": _replaced("points3D.txt", lambda text: text.replace(" 3 9 9 9", " nan 9 9 9")),
    "points 1e308 away": _replaced("points3D.txt", lambda text: text.replace(" 3 9 9 9", " 1e308 9 9 9")),
    "focal length 0": _replaced("cameras.txt", lambda text: text.replace("60 60", "0 0")),
    "focal length of no number": _replaced("cameras.txt", lambda text: text.replace("60 60", "nan nan")),
    "focal length 1e-300": _replaced("cameras.txt", lambda text: text.replace("60 60", "1e-300 1e300")),
    "camera of -64 pixels": _replaced("cameras.txt", lambda text: text.replace("64 48", "-64 -48")),
    "camera of 10^9 x 10^9 pixels": _replaced(
        "cameras.txt", lambda text: text.replace("64 48", "1000000000 1000000000")
    ),
    "unknown lens model": _replaced("cameras.txt", lambda text: text.replace("PINHOLE", "EVIL")),
    "too few parameters": _replaced("cameras.txt", lambda text: text.replace("60 60 32 24", "60")),
    "image of a camera that is not there": _replaced(
        "images.txt", lambda text: text.replace("1 1 0.png", "1 77 0.png")
    ),
    "image named with a path outside": _replaced(
        "images.txt", lambda text: text.replace("0.png", "../../outside/secret.png")
    ),
    "image named twice": _replaced("images.txt", lambda text: text.replace("1.png", "0.png")),
    "observation of a point that is not there": _replaced(
        "images.txt", lambda text: text.replace(" 59\n", " 999999999\n")
    ),
    "track of an image that is not there": _replaced("points3D.txt", lambda text: text.replace(" 4 ", " 4000000000 ")),
    "track of an observation that is not there": _replaced(
        "points3D.txt", lambda text: text.replace(" 1 0 2 0", " 1 4000000000 2 4000000000")
    ),
    "text that is not a model": _replaced("images.txt", lambda text: "\xff" * 100_000),
    "line of 20 million numbers": _replaced("images.txt", lambda text: text + "1 " * 20_000_000),
    "cameras linked to a secret": _linked("secret.txt", "cameras.txt"),
    "images linked to endless zeros": _linked("/dev/zero", "images.txt"),
    "points linked to endless zeros": _linked("/dev/zero", "points3D.txt"),
}


def _model_attacks() -> Iterator[Attack]:
    for name, build in MODELS.items():
        yield Attack(f"colmap: {name}", "crash COLMAP, fill memory or place cameras nowhere", build, [CAPTURE], ANY)


def transforms(place: Place, **changes: Any) -> None:
    """Write four photographs and their ``transforms.json``, with replaced keys of the first frame or of all."""
    _photos(place.inside / "photos")
    frames = [
        {"file_path": f"photos/{index}.png", "transform_matrix": np.eye(4).tolist(), **(changes if not index else {})}
        for index in range(4)
    ]
    place.write("transforms.json", json.dumps({"fl_x": 60.0, "w": 64, "h": 48, "frames": frames}))


TRANSFORM_FILES: Mapping[str, Callable[[Place], object]] = {
    "nested 100,000 deep": lambda p: (transforms(p), p.write("transforms.json", "[" * 100_000)),
    "matrix of no number": lambda p: transforms(p, transform_matrix=[[float("nan")] * 4] * 4),
    "matrix of zeros": lambda p: transforms(p, transform_matrix=[[0.0] * 4] * 4),
    "matrix of 1e308": lambda p: transforms(p, transform_matrix=[[1e308] * 4] * 4),
    "image of 10^9 x 10^9 pixels": lambda p: transforms(p, w=1e9, h=1e9),
    "image of 1e-9 pixels": lambda p: transforms(p, w=1e-9, h=1e-9),
    "angle of view 1e-300": lambda p: transforms(p, fl_x=None, camera_angle_x=1e-300),
    "distortion of 1e300": lambda p: transforms(p, k1=1e300, k2=-1e300),
    "path to a file outside": lambda p: transforms(p, file_path="../outside/secret.png"),
    "path with NUL": lambda p: transforms(p, file_path="a\0b"),
    "number of a million digits": lambda p: (
        transforms(p),
        p.write("transforms.json", '{"w": ' + "9" * 1_000_000 + ', "h": 48, "frames": []}'),
    ),
}


def _spec(change: Callable[[dict[str, Any]], object]) -> Callable[[Place], object]:
    """Write a capture with a changed ``capture.json``."""

    def build(place: Place) -> None:
        path = capture_folder(place) / "capture.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return build


def _array(name: str, values: np.ndarray[Any, Any]) -> Callable[[Place], object]:
    """Write a capture with one replaced array of its points."""

    def build(place: Place) -> None:
        folder = capture_folder(place)
        (path,) = folder.glob("*.npz")
        with np.load(path) as arrays:
            kept = dict(arrays)
        np.savez(path, **(kept | {name: values}))

    return build


CAPTURES: Mapping[str, Callable[[Place], object]] = {
    "file outside": _spec(lambda c: c["photos"][0].update(file="../../outside/secret.png")),
    "absolute file": _spec(lambda c: c["photos"][0].update(file="/etc/passwd")),
    "mask outside": _spec(lambda c: c["photos"][0].update(mask="../../outside/secret.png")),
    "camera of 10^9 pixels": _spec(lambda c: c["photos"][0]["camera"].update(width=10**9, height=10**9)),
    "camera of no number": _spec(lambda c: c["photos"][0]["camera"].update(fx=float("nan"))),
    "nested deep": _spec(lambda c: c.update(rejected=json.loads("[" * 900 + "]" * 900))),
    "points that are objects": _array("points", np.array([None, {}], dtype=object)),
    "points that are texts": _array("points", np.array(["a", "b"])),
    "points of no number": _array("points", np.full((40, 3), np.nan)),
    "points seen that are not there": _array("seen", np.full(160, 2**31 - 1, dtype=np.int32)),
    "points seen -1 times": _array("seen_counts", np.array([-1, 80, 80, 1])),
    "counts of 2^62": _array("seen_counts", np.array([2**62, 2**62, 2**62, 2**62 + 160], dtype=np.uint64)),
}

ATTACKS = (
    *_model_attacks(),
    *(
        Attack(f"transforms: {n}", "crash, fill memory or read outside", b, [TRANSFORMS], ANY)
        for n, b in TRANSFORM_FILES.items()
    ),
    *(Attack(f"capture: {n}", "crash, fill memory or read outside", b, [FIT], REFUSED) for n, b in CAPTURES.items()),
)
