"""Hostile meshes, as objects of scenes and as input of bakes."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Mapping

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.images import bomb, zeros
from benchmarks.scale.attack.samples import Build, Place, file_of


def _zipped(outer: str, inner: str, size: int) -> Build:
    """Return an archive of one file of zeros."""

    def build(place: Place) -> str:
        with (
            zipfile.ZipFile(place.inside / outer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
            archive.open(inner, "w", force_zip64=True) as file,
        ):
            file.write(bytes(80) + struct.pack("<I", size // 50) if inner.endswith("stl") else b"")
            for _ in range(size >> 24):
                file.write(bytes(1 << 24))
        return outer

    return build


def _sparse(name: str, head: bytes, size: int) -> Build:
    """Write a sparse file of zeros."""

    def build(place: Place) -> str:
        path = place.write(name, head)
        with path.open("r+b") as file:
            file.truncate(size)
        return name

    return build


def _glb(content: dict[str, object]) -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, **content}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text


def _gltf(uri: str, count: int = 3) -> str:
    """Write a glTF mesh with its numbers in another file."""
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "buffers": [{"uri": uri, "byteLength": 12 * count}],
            "bufferViews": [{"buffer": 0, "byteLength": 12 * count}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        }
    )


def _ply(vertices: int, faces: int, kind: str = "binary_little_endian") -> str:
    return (
        f"ply\nformat {kind} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )


def _textured(uri: str) -> Build:
    """Write an OBJ mesh whose material names a texture."""

    def build(place: Place) -> str:
        place.write("m.mtl", f"newmtl a\nmap_Kd {uri.replace('{outside}', str(place.outside))}\n")
        text = (place.samples / "mesh.obj").read_text()
        faces = "\n".join(line for line in text.splitlines() if line.startswith("v "))
        place.write(
            "m.obj",
            f"mtllib m.mtl\n{faces}\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n"
            + "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in _BOX),
        )
        return "m.obj"

    return build


_BOX = (
    (2, 4, 1),
    (5, 2, 1),
    (1, 4, 3),
    (3, 5, 1),
    (2, 8, 4),
    (6, 2, 5),
    (6, 8, 2),
    (4, 8, 3),
    (7, 5, 3),
    (3, 8, 7),
    (7, 6, 5),
    (8, 6, 7),
)
_XML_BOMB = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e0 "xxxxxxxxxx">'
    + "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    + "]><model>&e9;</model>"
)


def _three_mf(place: Place) -> str:
    with zipfile.ZipFile(place.inside / "m.3mf", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", _XML_BOMB)
    return "m.3mf"


MESHES: Mapping[str, tuple[str, Build]] = {
    "zip of an STL of 2 GB": ("fill memory", _zipped("m.zip", "m.stl", 2 << 30)),
    "zip of an OBJ of 1 GB": ("fill memory", _zipped("m.zip", "m.obj", 1 << 30)),
    "zip of a path outside": ("read outside", _zipped("m.zip", "../../outside/m.stl", 1 << 24)),
    "3MF of 1 GB": ("fill memory", _zipped("m.3mf", "3D/3dmodel.model", 1 << 30)),
    "3MF with entities that multiply": ("fill memory", _three_mf),
    "STL that promises 2^32 faces": (
        "fill memory",
        file_of("m.stl", lambda: bytes(80) + b"\xff\xff\xff\xff" + bytes(50)),
    ),
    "STL of 8 GB": ("fill memory", _sparse("m.stl", bytes(80) + struct.pack("<I", (8 << 30) // 50), 8 << 30)),
    "OBJ of 8 GB": ("fill memory", _sparse("m.obj", b"v 0 0 0\n", 8 << 30)),
    "PLY that promises 10^10 vertices": ("fill memory", file_of("m.ply", lambda: _ply(10**10, 1))),
    "PLY that promises 10^18 faces": ("fill memory", file_of("m.ply", lambda: _ply(0, 10**18))),
    "PLY in text that promises 10^9 vertices": (
        "fill memory",
        file_of("m.ply", lambda: _ply(10**9, 1, "ascii") + "0 0 0\n"),
    ),
    "OFF that promises 10^12 faces": (
        "fill memory",
        file_of("m.off", lambda: "OFF\n1000000000000 1000000000000 0\n0 0 0\n"),
    ),
    "OBJ face of vertex 10^12": ("crash", file_of("m.obj", lambda: "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000000\n")),
    "OBJ of no numbers": ("crash", file_of("m.obj", lambda: "v nan nan nan\n" * 8 + "f 1 2 3\nf 2 3 4\nf 5 6 7\n")),
    "OBJ of infinite size": (
        "fill memory",
        file_of(
            "m.obj", lambda: "v 1e300 0 0\nv 0 1e300 0\nv 0 0 1e300\nv 0 0 0\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"
        ),
    ),
    "OBJ of 3 million faces in a line": (
        "take long",
        file_of("m.obj", lambda: "v 0 0 0\n" * 9 + "f " + "1 " * 3_000_000),
    ),
    "glTF with numbers from outside": ("read outside", file_of("m.gltf", lambda: _gltf("../outside/secret.png"))),
    "glTF with numbers from endless zeros": ("fill memory", file_of("m.gltf", lambda: _gltf("/dev/zero"))),
    "glTF that promises 10^12 vertices": ("fill memory", file_of("m.gltf", lambda: _gltf("data:,", 10**12))),
    "GLB chunk of 4 GB": (
        "fill memory",
        file_of("m.glb", lambda: _glb({})[:12] + struct.pack("<I4s", 0xFFFFFFFF, b"JSON")),
    ),
    "GLB nested 100,000 deep": (
        "crash",
        file_of(
            "m.glb",
            lambda: (
                lambda t: struct.pack("<4sII", b"glTF", 2, 20 + len(t)) + struct.pack("<I4s", len(t), b"JSON") + t
            )(b"[" * 100_000),
        ),
    ),
    "COLLADA with entities that multiply": ("fill memory", file_of("m.dae", lambda: _XML_BOMB)),
    "link to endless zeros": ("fill memory", lambda place: (place.inside / "m.stl").symlink_to("/dev/zero") or "m.stl"),
    "HDF5 named as a mesh": ("crash", file_of("m.stl", lambda: b"\x89HDF\r\n\x1a\n" + bytes(4096))),
}


_READ = ("OBJ of infinite size", "OBJ of 3 million faces in a line")
"""Meshes that are readable, with findings of the check."""


def _in_scene(build: Build) -> Callable[[Place], object]:
    """Write a scene with the mesh as a shape."""

    def made(place: Place) -> None:
        name = build(place)
        place.scene(shapes=f"[{{name: a, mesh: {name}}}]")

    return made


def _bake(name: str) -> tuple[str, ...]:
    return ("mitsplat", "bake", name, "-o", "made", "--gaussians", "500")


_BAKED = {
    "zip of an STL of 2 GB": "m.zip",
    "STL that promises 2^32 faces": "m.stl",
    "PLY that promises 10^10 vertices": "m.ply",
    "glTF with numbers from outside": "m.gltf",
    "COLLADA with entities that multiply": "m.dae",
}

ATTACKS = (
    *(
        Attack(
            f"mesh: {name}",
            tries,
            _in_scene(build),
            [("mitsplat", "check", "scene.yaml")],
            ANY if name in _READ else REFUSED,
        )
        for name, (tries, build) in MESHES.items()
    ),
    *(
        Attack(f"bake: {name}", MESHES[name][0], MESHES[name][1], [_bake(file)], REFUSED)
        for name, file in _BAKED.items()
    ),
    Attack(
        "bake: texture outside",
        "read outside",
        _textured("../outside/secret.png"),
        [_bake("m.obj")],
        REFUSED,
        quick=False,
    ),
    Attack(
        "bake: texture bomb",
        "fill memory",
        lambda place: (_textured("bomb.png")(place), place.write("bomb.png", bomb(40_000))),
        [_bake("m.obj")],
        ANY,
        seconds=120,
        quick=False,
    ),
    Attack(
        "bake: texture that is a PNG text of 1 GB",
        "fill memory",
        lambda place: (_textured("bomb.png")(place), place.write("bomb.png", zeros(1 << 30))),
        [_bake("m.obj")],
        ANY,
        seconds=120,
        quick=False,
    ),
)
