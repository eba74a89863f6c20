"""Hostile ONNX networks, as models of depth and of masks, and pickled weights."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping

from benchmarks.scale.attack.attack import REFUSED, Attack
from benchmarks.scale.attack.images import noise_photos
from benchmarks.scale.attack.poses import capture_folder
from benchmarks.scale.attack.samples import Place

Build = Callable[[Place], object]
DEPTH = (
    "mitsplat",
    "fit",
    "capture",
    "-o",
    "made",
    "--depth-model",
    "a.onnx",
    "--iterations",
    "1",
    "--gaussians",
    "50",
)
MASKS = ("mitsplat", "capture", "photos", "-o", "made", "--poses", "model", "--mask-model", "a.onnx")


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def field(number: int, value: int | bytes | str) -> bytes:
    """Encode one field of a message of Protocol Buffers."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def tensor(name: str, shape: tuple[int, ...], raw: bytes | None, external: Mapping[str, str] | None = None) -> bytes:
    """Encode a tensor of floats, with its numbers inline or in another file."""
    data = b"".join(field(1, edge) for edge in shape) + field(2, 1) + field(8, name)
    if external is not None:
        entries = b"".join(field(13, field(1, key) + field(2, value)) for key, value in external.items())
        return data + entries + field(14, 1)
    return data + (b"" if raw is None else field(9, raw))


def _value(name: str, shape: tuple[int | str, ...], kind: int = 1) -> bytes:
    dims = b"".join(field(1, field(1, edge) if isinstance(edge, int) else field(2, edge)) for edge in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def node(kind: str, inputs: tuple[str, ...], output: str, attributes: bytes = b"") -> bytes:
    """Encode an operation of a network."""
    return b"".join(field(1, name) for name in inputs) + field(2, output) + field(4, kind) + attributes


def network(nodes: list[bytes], initializers: list[bytes] | None = None, edge: int | str = 28) -> bytes:
    """Encode a network from an image ``image`` to ``depth``."""
    graph = b"".join(field(1, one) for one in nodes) + field(2, "graph")
    graph += b"".join(field(5, one) for one in initializers or [])
    graph += field(11, _value("image", (1, 3, edge, edge))) + field(12, _value("depth", (1, 1, edge, edge)))
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13))


def _added(initializer: bytes) -> bytes:
    """Encode a network that adds weights to the mean of the colours."""
    channels = field(5, field(1, "axes") + field(8, 1) + field(20, 7))
    return network([node("Add", ("image", "w"), "sum"), node("ReduceMean", ("sum",), "depth", channels)], [initializer])


def external_weights(location: str, length: int = 4) -> Callable[[Place], bytes]:
    """Return a function that writes a network with its weights in a file."""
    return lambda place: _added(
        tensor(
            "w",
            (1, 1, 1, 1),
            None,
            {"location": location.replace("{outside}", str(place.outside)), "offset": "0", "length": str(length)},
        )
    )


def _linked(place: Place) -> bytes:
    (place.inside / "w.bin").symlink_to(place.outside / "numbers.bin")
    return external_weights("w.bin")(place)


def _subgraphs(depth: int) -> bytes:
    graph = field(2, "g")
    for _ in range(depth):
        attribute = field(1, "then_branch") + field(6, graph) + field(20, 5)
        graph = field(1, node("If", ("image",), "depth", field(5, attribute))) + field(2, "g")
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))


NETWORKS: Mapping[str, Callable[[Place], bytes]] = {
    "numbers from a path with ..": external_weights("../outside/numbers.bin"),
    "numbers from an absolute path": external_weights("{outside}/numbers.bin"),
    "numbers from a link": _linked,
    "numbers from a file that ends early": external_weights("../outside/numbers.bin", 1 << 40),
    "numbers from endless zeros": external_weights("/dev/zero", 1 << 40),
    "weights that are a million times as many as given": lambda p: _added(tensor("w", (1 << 20, 1 << 20), bytes(64))),
    "weights of 2^62": lambda p: _added(tensor("w", (1 << 31, 1 << 31), None)),
    "weights of -1": lambda p: _added(tensor("w", (-1, -1), bytes(64))),
    "picture of 2^40 pixels": lambda p: network([node("Identity", ("image",), "depth")], edge=1 << 20),
    "result of 2^40 numbers": lambda p: network(
        [node("ConstantOfShape", ("s",), "depth")],
        [field(1, 2) + field(2, 7) + field(8, "s") + field(9, struct.pack("<qq", 1 << 20, 1 << 20))],
    ),
    "graphs nested 200 deep": lambda p: _subgraphs(200),
    "graphs nested 5,000 deep": lambda p: _subgraphs(5_000),
    "operation that is not there": lambda p: network([node("Evil", ("image",), "depth")]),
    "operation of itself": lambda p: network([node("Add", ("image", "depth"), "depth")]),
    "empty": lambda p: b"",
    "rubbish": lambda p: b"\xff" * 100_000,
    "cut in half": lambda p: _added(tensor("w", (1, 1, 1, 1), bytes(4)))[:60],
    "pickle": lambda p: b"cos\nmkdir\n(S'executed'\ntR.",
}


def _depth(make: Callable[[Place], bytes]) -> Build:
    def build(place: Place) -> None:
        capture_folder(place)
        (place.outside / "numbers.bin").write_bytes(struct.pack("<16f", *range(16)))
        place.write("a.onnx", make(place))

    return build


def _masks(make: Callable[[Place], bytes]) -> Build:
    def build(place: Place) -> None:
        _depth(make)(place)
        if not (place.inside / "photos").exists():
            noise_photos(place)

    return build


def _pipe(place: Place) -> None:
    _depth(lambda _: b"")(place)
    (place.inside / "a.onnx").unlink()
    os.mkfifo(place.inside / "a.onnx")


def _attacks() -> Iterator[Attack]:
    for name, make in NETWORKS.items():
        yield Attack(
            f"onnx: depth model, {name}",
            "read outside, crash or fill memory",
            _depth(make),
            [DEPTH],
            REFUSED,
            needs=("onnxruntime",),
            mebibytes=6000,
        )
    for name in ("numbers from a path with ..", "numbers from a link", "weights of 2^62", "rubbish"):
        yield Attack(
            f"onnx: mask model, {name}",
            "read outside, crash or fill memory",
            _masks(NETWORKS[name]),
            [MASKS],
            REFUSED,
            needs=("onnxruntime", "rembg"),
            mebibytes=6000,
        )
    yield Attack("onnx: depth model, pipe", "wait for ever", _pipe, [DEPTH], REFUSED)


def _pickled(place: Place) -> None:
    place.take_dataset()
    place.write("a.pt", f"cos\nmkdir\n(S'{place.outside}/executed'\ntR.".encode())


ATTACKS = (
    *_attacks(),
    Attack(
        "weights: pickle that makes a folder",
        "run code",
        _pickled,
        [("mitsplat", "train", "dataset", "-o", "made", "--weights", "a.pt", "--device", "cpu")],
        REFUSED,
        quick=False,
    ),
)
