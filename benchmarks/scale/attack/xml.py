"""Mitsuba scenes that name files outside of their folder, or exhaust the machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.images import png_sky
from benchmarks.scale.attack.samples import Place

FILM = (
    '<integrator type="direct"/><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/>'
    '<integer name="height" value="12"/></film><sampler type="independent"><integer name="sample_count" value="4"/>'
    "</sampler></sensor>"
)


def picture(value: str, name: str = "filename") -> str:
    """Return a sky that shows an image in every direction."""
    return f'<emitter type="envmap"><string name="{name}" value="{value}"/></emitter>'


def scene(body: str, head: str = "") -> str:
    """Return a Mitsuba scene of 16x12 pixels."""
    return f'{head}<scene version="3.9.0">{FILM}{body}</scene>'


def _files(**texts: str) -> Callable[[Place], object]:
    """Write files below ``scene/``, with ``/`` written as ``__``, and the folder ``scene/sub/deep``."""

    def build(place: Place) -> None:
        (place.inside / "scene/sub/deep").mkdir(parents=True)
        for name, text in texts.items():
            place.write(f"scene/{name.replace('__', '/')}.xml", text.replace("{outside}", str(place.outside)))

    return build


def _link(name: str, target: str, body: str) -> Callable[[Place], object]:
    """Write a scene beside a link to a file or a folder outside."""

    def build(place: Place) -> None:
        (place.inside / "scene/sub/deep").mkdir(parents=True)
        (place.inside / "scene" / name).symlink_to(place.outside / target)
        place.write("scene/a.xml", scene(body))

    return build


def _pipe(name: str, body: str) -> Callable[[Place], object]:
    def build(place: Place) -> None:
        (place.inside / "scene").mkdir()
        os.mkfifo(place.inside / "scene" / name)
        if name != "a.xml":
            place.write("scene/a.xml", scene(body))

    return build


def _encoded(encoding: str, body: str) -> Callable[[Place], object]:
    def build(place: Place) -> None:
        head = f'<?xml version="1.0" encoding="{encoding}"?>'
        place.write("scene/a.xml", scene(body.replace("{outside}", str(place.outside)), head).encode(encoding))

    return build


_DOCTYPE = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'
_INNER = f'<scene version="3.9.0">{picture("{outside}/secret.png")}</scene>'

_SECRET = '<string name="filename" value="../../outside/secret.txt"/>'


def _decoys(**texts: str) -> Callable[[Place], object]:
    """Write files as :func:`_files` does, and harmless ones where a text-based reader would look for them."""

    def build(place: Place) -> None:
        _files(**texts)(place)
        png_sky(place.inside / "scene/ok.png")
        place.write("scene/inner.xml", '<scene version="3.9.0"/>')
        (place.inside / "scene/sub/ok.png").symlink_to(place.outside / "secret.png")

    return build


CONFINED: Mapping[str, Callable[[Place], object]] = {
    "path with one ..": lambda p: (
        p.write("scene/a.xml", scene(picture("../secret.png"))),
        (p.inside / "secret.png").symlink_to(p.outside / "secret.png"),
    ),
    "path with two ..": _files(a=scene(picture("../../outside/secret.png"))),
    "path with three ..": _files(a=scene(picture("sub/../../../outside/secret.png"))),
    "path from the current folder": _files(a=scene(picture("../outside/secret.png"))),
    "absolute path": _files(a=scene(picture("{outside}/secret.png"))),
    "path in character references": _files(a=scene(picture("&#46;&#46;/&#x2e;./outside/secret.png"))),
    "path with spaces around": _files(a=scene(picture(" ../../outside/secret.png "))),
    "path with doubled slashes": _files(a=scene(picture("..//..//outside//secret.png"))),
    "path through a file": _files(a=scene(picture("a.xml/../../../outside/secret.png"))),
    "path through a folder that is not there": _files(a=scene(picture("none/../../../outside/secret.png"))),
    "link": _link("ok.png", "secret.png", picture("ok.png")),
    "link in a folder": _link("sub/ok.png", "secret.png", picture("sub/ok.png")),
    "linked folder": _link("sub/out", ".", picture("sub/out/secret.png")),
    "path element, then ..": _files(a=scene(f'<path value="sub/deep"/>{picture("../../../../outside/secret.png")}')),
    "path element, then .. less deep": _files(a=scene(f'<path value="sub"/>{picture("../../../outside/secret.png")}')),
    "path element, then a link": _link("sub/ok.png", "secret.png", f'<path value="sub"/>{picture("ok.png")}'),
    "path element twice": _files(
        a=scene(f'<path value="sub"/><path value="deep"/>{picture("../../../../outside/secret.png")}')
    ),
    "path element to outside": _files(a=scene(f'<path value="{{outside}}"/>{picture("secret.png")}')),
    "path element to a linked folder": _link("out", ".", f'<path value="out"/>{picture("secret.png")}'),
    "path element from an include": _files(
        a=scene('<include filename="sub/b.xml"/>' + picture("../../../outside/secret.png")),
        sub__b='<scene version="3.9.0"><path value="sub"/></scene>',
    ),
    "include in a path element's folder": _files(
        a=scene('<path value="sub"/><include filename="inner.xml"/>'), sub__inner=_INNER
    ),
    "include with a document type": _files(
        a=scene('<path value="sub"/><include filename="inner.xml"/>'), sub__inner=_DOCTYPE + _INNER
    ),
    "link behind a harmless picture": _decoys(a=scene(f'<path value="sub"/>{picture("ok.png")}')),
    "include behind a harmless one": _decoys(
        a=scene('<path value="sub"/><include filename="inner.xml"/>'), sub__inner=_DOCTYPE + _INNER
    ),
    "include from an include": _files(
        a=scene('<include filename="sub/b.xml"/>'),
        sub__b='<scene version="3.9.0"><include filename="sub/inner.xml"/></scene>',
        sub__inner=_INNER,
    ),
    "include outside": _link("b.xml", "secret.txt", '<include filename="b.xml"/>'),
    "parameter": _files(a=scene(f'<default name="f" value="{{outside}}/secret.png"/>{picture("$f")}')),
    "parameter in two parts": _files(
        a=scene(f'<default name="d" value="{{outside}}"/><default name="n" value="secret"/>{picture("$d/$n.png")}')
    ),
    "parameter by default": _files(a=scene(f'<default name="d" value=".."/>{picture("$d/../outside/secret.png")}')),
    "entity": _files(a=scene(picture("&b;"), '<!DOCTYPE a [<!ENTITY b "../../outside/secret.png">]>')),
    "UTF-16": _encoded("utf-16", picture("{outside}/secret.png")),
    "UTF-32": _encoded("utf-32", picture("{outside}/secret.png")),
    "Latin-1": _encoded("latin-1", picture("{outside}/secret.png")),
    "texture of a lamp": _files(
        a=scene(
            '<shape type="sphere"><float name="radius" value="5"/><boolean name="flip_normals" value="true"/>'
            '<emitter type="area"><texture type="bitmap" name="radiance"><string name="filename" '
            'value="../../outside/secret.png"/></texture></emitter></shape>'
        )
    ),
    "spectrum": _files(
        a=scene('<emitter type="constant"><spectrum name="radiance" filename="../../outside/secret.txt"/></emitter>')
    ),
    "volume": _files(
        a=scene(f'<medium type="heterogeneous"><volume name="albedo" type="gridvolume">{_SECRET}</volume></medium>')
    ),
    "measured material": _files(a=scene(f'<shape type="sphere"><bsdf type="measured">{_SECRET}</bsdf></shape>')),
    "splats": _files(a=scene(f'<shape type="splats">{_SECRET}</shape>')),
}

HEAVY: Mapping[str, Callable[[Place], object]] = {
    "billion laughs": _files(
        a=scene(
            "&e9;",
            "<!DOCTYPE a ["
            + '<!ENTITY e0 "x">'
            + "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
            + "]>",
        )
    ),
    "10,000 elements deep": _files(a=scene("<a>" * 10_000 + "</a>" * 10_000)),
    "include of itself": _files(a=scene('<include filename="a.xml"/>')),
    "includes that double": _files(
        **{
            f"b{i}": '<scene version="3.9.0">' + f'<include filename="b{i + 1}.xml"/>' * 2 + "</scene>"
            for i in range(40)
        },
        b40='<scene version="3.9.0"/>',
        a=scene('<include filename="b0.xml"/>'),
    ),
    "include of endless zeros": _files(a=scene('<include filename="/dev/zero"/>')),
    "picture of 10^10 pixels": _files(a=scene("").replace('"16"', '"100000"').replace('"12"', '"100000"')),
    "picture of 2^62 pixels": _files(a=scene("").replace('"16"', '"2147483647"').replace('"12"', '"2147483647"')),
    "named pipe": _pipe("a.xml", ""),
    "texture that is a named pipe": _pipe("pipe.png", picture("pipe.png")),
    "include that is a named pipe": _pipe("pipe.xml", '<include filename="pipe.xml"/>'),
    "mesh that promises 2^31 faces": lambda p: (
        p.write(
            "scene/m.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 2147483647\nproperty float x\n"
            "property float y\nproperty float z\nelement face 2147483647\n"
            "property list uchar int vertex_indices\nend_header\n",
        ),
        p.write("scene/a.xml", scene('<shape type="ply"><string name="filename" value="m.ply"/></shape>')),
    ),
    "plugin that is not there": _files(a=scene('<shape type="../../evil"/>')),
    "no scene": _files(a="<html/>"),
}


def _attacks() -> Iterator[Attack]:
    for name, build in CONFINED.items():
        yield Attack(
            f"xml: {name}",
            "render a picture from outside of the scene's folder",
            build,
            [("mitsplat", "render", "scene/a.xml", "-o", "made.png")],
            ANY,
        )
    for name, build in HEAVY.items():
        yield Attack(
            f"xml: {name}",
            "fill memory, wait for ever or crash Mitsuba",
            build,
            [("mitsplat", "render", "scene/a.xml", "-o", "made.png")],
            ANY if "itself" in name else REFUSED,
        )
    yield Attack(
        "xml: absolute scene, path with two ..",
        "render a picture from outside of the scene's folder",
        CONFINED["path with two .."],
        [("mitsplat", "render", "{inside}/scene/a.xml", "-o", "made.png")],
        ANY,
    )
    yield Attack(
        "xml: linked scene",
        "render a picture beside the link's target",
        _linked_scene,
        [("mitsplat", "render", "scene/link.xml", "-o", "made.png")],
        ANY,
    )


def _linked_scene(place: Place) -> None:
    (place.outside / "a.xml").write_text(scene(picture("secret.png")))
    (place.inside / "scene").mkdir()
    Path(place.inside / "scene/link.xml").symlink_to(place.outside / "a.xml")


ATTACKS = tuple(_attacks())
