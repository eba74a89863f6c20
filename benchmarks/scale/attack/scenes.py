"""Hostile scene files: YAML that exhausts its reader, names, counts, sizes and patterns."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.scale.attack.attack import ANY, REFUSED, Attack
from benchmarks.scale.attack.images import png_sky
from benchmarks.scale.attack.samples import SCENE, Place

Build = Callable[[Place], object]

CHECK = ("mitsplat", "check", "scene.yaml")
RENDER = ("mitsplat", "render", "scene.yaml", "-o", "made", "-n", "1", "--workers", "1")
EXPORT = ("mitsplat", "export", "scene.yaml", "-o", "made.xml")


def _text(content: str | bytes) -> Build:
    return lambda place: place.write("scene.yaml", content)


def _keys(**changes: str) -> Build:
    return lambda place: place.scene(**changes)


def _tree(place: Place) -> None:
    """Create the folders ``deep``, three in each down to seven levels: 3,280 in all."""
    level = [place.inside / "deep"]
    for _ in range(7):
        level = [folder / name for folder in level for name in "abc"]
    for folder in level:
        folder.mkdir(parents=True)


def _pattern(key: str) -> Build:
    def build(place: Place) -> None:
        _tree(place)
        pattern = f"deep/{'**/' * 9}*.png"
        png_sky(place.inside / "deep/a/sky.png")
        if key == "pool":
            place.scene(objects=f"[{{pool: 'deep/{'**/' * 9}nut', count: 1}}]")
        elif key == "light":
            place.scene(lights=f"[{{kind: environment, pool: ['{pattern}']}}]")
        elif key == "image":
            place.scene(lights=f"[{{kind: environment, image: '{pattern}'}}]")
        else:
            place.scene(output=f"{{width: 64, height: 48}}\nbackdrop: {{images: '{pattern}'}}")

    return build


def _looped(place: Place) -> None:
    """Write a folder with links to itself, and a pattern through them."""
    (place.inside / "deep").mkdir()
    for name in "abcd":
        (place.inside / "deep" / name).symlink_to(place.inside / "deep")
    place.scene(objects="[{pool: 'deep/*/*/*/*/*/*/*/*/*/*/*/*/nut', count: 1}]")


def _outside(key: str) -> Build:
    def build(place: Place) -> None:
        secret = place.outside / "secret.png"
        (place.inside / "linked.png").symlink_to(secret)
        name = {
            "link": "linked.png",
            "dots": "../outside/secret.png",
            "absolute": str(secret),
            "pattern": "../outside/*.png",
        }[key]
        place.scene(lights=f"[{{kind: environment, image: '{name}'}}]")

    return build


def _pipe(place: Place) -> None:
    os.mkfifo(place.inside / "scene.yaml")


def _zero(place: Place) -> None:
    Path(place.inside / "scene.yaml").symlink_to("/dev/zero")


def _name_outside(place: Place) -> None:
    place.scene(name="../../outside/made")


def _class(text: str) -> Build:
    return lambda place: place.scene(objects=f'[{{asset: nut, count: 1, class_name: "{text}"}}]')


_OUTPUT = "layouts: 1, views: 2, formats: [yolo, coco]}"

TEXTS: Mapping[str, Build] = {
    "aliases that multiply": _text(
        "".join(["a0: &a0 [x]\n", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10))])
    ),
    "alias of itself": _text("a: &a [*a]\n"),
    "merge keys that multiply": _text(
        "".join(
            ["a0: &a0 {x: 1}\n", *(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 50)}]}}\n" for i in range(1, 20))]
        )
    ),
    "nested 100,000 deep": _text("[" * 100_000),
    "nested 100,000 deep in blocks": _text("- " * 100_000),
    "16 MB": _text("name: " + "a" * (16 << 20)),
    "number of a million digits": _keys(seed="9" * 1_000_000),
    "number of 5,000 digits": _keys(seed="9" * 5_000),
    "number of a million hexadecimal digits": _keys(seed="0x" + "f" * 1_000_000),
    "number with a million colons": _keys(seed="1" + ":59" * 300_000),
    "number 1e400": _keys(region="{min: [-1e400, 0, 0], max: [1e400, 1, 1]}"),
    "no number": _keys(region="{min: [.nan, 0, 0], max: [.nan, 1, 1]}"),
    "date in place of a number": _keys(seed="2001-13-45T99:99:99Z"),
    "duplicate keys": _text(SCENE + SCENE),
    "keys of other kinds": _text("? [a, b]\n: 1\n? {c: d}\n: 2\n"),
    "NUL": _text("name: a\0b\n"),
    "UTF-16": _text(SCENE.encode("utf-16")),
    "bytes that are no text": _text(b"name: \xff\xfe\xfa\n"),
    "lone surrogate": _text('name: "\\ud800"\n'),
    "tag of Python": _text("name: !!python/name:os\n"),
    "tag of binary data": _text("name: !!binary " + "A" * 1_000_000),
    "directive": _text("%YAML 9.9\n%TAG ! tag:evil,2000:\n---\nname: !evil a\n"),
    "several documents": _text("---\nname: a\n" * 10_000),
    "line of 4 MB of spaces": _text("name:" + " " * 4_000_000 + "a\n"),
    "pipe": _pipe,
    "link to endless zeros": _zero,
    "folder": lambda place: (place.inside / "scene.yaml").mkdir(),
}

VALUES: Mapping[str, tuple[str, Build]] = {
    "10^9 objects": ("fill memory", _keys(objects="[{asset: nut, count: 1000000000}]")),
    "10^9 layouts": ("fill memory", _keys(output="{width: 64, height: 48, layouts: 1000000000, views: 2}")),
    "10^9 views": ("fill memory", _keys(output="{width: 64, height: 48, layouts: 1, views: 1000000000}")),
    "image of 10^6 x 10^6": ("fill memory", _keys(output=f"{{width: 1000000, height: 1000000, {_OUTPUT}")),
    "image of 8,000 x 6,000": ("fill memory", _keys(output=f"{{width: 8000, height: 6000, {_OUTPUT}")),
    "image of 10^300": ("crash", _keys(output=f"{{width: {10**300}, height: {10**300}, {_OUTPUT}")),
    "10^9 lights": ("fill memory", _keys(lights="[{kind: area, position: [0.5, 0, 1], count: 1000000000}]")),
    "region of 10^300 m": ("crash", _keys(region="{min: [-1e300, -1e300, 0.02], max: [1e300, 1e300, 1e300]}")),
    "table of 10^300 m": (
        "crash",
        _keys(shapes="[{name: t, box: {size: [1e300, 1e300, 1e300], position: [0, 0, -1e300]}}]"),
    ),
    "camera 10^300 m away": ("crash", _keys(camera="{kind: orbit, target: [0, 0, 0], radius: 1e300, height: 1e300}")),
    "time of 10^300 s": ("take long", _keys(settle="{max_time: 1e300}")),
    "pattern of nine times any depth": ("take long", _pattern("pool")),
    "pattern of light images": ("take long", _pattern("image")),
    "pattern of light pools": ("take long", _pattern("light")),
    "pattern of backdrops": ("take long", _pattern("backdrop")),
    "pattern through links that go round": ("take long", _looped),
    "pattern of 3 MB": ("take long", _keys(objects=f"[{{pool: '{'*/' * 1_500_000}', count: 1}}]")),
    "pattern of open brackets": ("take long", _keys(objects=f"[{{pool: '{'[' * 100_000}', count: 1}}]")),
    "pattern of many stars": ("take long", _keys(objects=f"[{{pool: '{'*a' * 60}b', count: 1}}]")),
    "image through a link": ("read outside", _outside("link")),
    "image through ..": ("read outside", _outside("dots")),
    "image by its absolute path": ("read outside", _outside("absolute")),
    "image by a pattern": ("read outside", _outside("pattern")),
    "class with a line feed": ("break files of labels", _class("a\\nb")),
    "class with a carriage return": ("break files of labels", _class("a\\r\\nb")),
    "class with NUL": ("break files of labels", _class("a\\0b")),
    "class with U+2028": ("break files of labels", _class("a\\u2028b")),
    "class with U+0085": ("break files of labels", _class("a\\u0085b")),
    "class with an escape": ("break a terminal", _class("a\\e[31mb")),
    "class of a lone surrogate": ("break files of labels", _class("a\\ud800b")),
    "class that turns the direction of text": ("break files of labels", _class("a\\u202eb")),
    "class of 5,000 letters": ("break file names", _class("a" * 5_000)),
    "class that is a path": ("write outside", _class("../../outside/made")),
}

_WRONG = ("read outside", "break files of labels", "break a terminal")
"""Harm for which a scene must be refused; for others, the check may also print warnings."""
_MAY_BE_GOOD = "class that turns"


ATTACKS = (
    *(
        Attack(f"yaml: {name}", "crash, fill memory or take long", build, [CHECK], REFUSED)
        for name, build in TEXTS.items()
    ),
    *(
        Attack(
            f"scene: {name}",
            tries,
            build,
            [CHECK],
            REFUSED if tries in _WRONG and not name.startswith(_MAY_BE_GOOD) else ANY,
        )
        for name, (tries, build) in VALUES.items()
    ),
    Attack("scene: render of 8,000 x 6,000", "fill memory", VALUES["image of 8,000 x 6,000"][1], [RENDER], REFUSED),
    Attack("scene: export of 8,000 x 6,000", "fill memory", VALUES["image of 8,000 x 6,000"][1], [EXPORT], ANY),
    Attack(
        "scene: check of 100,000 layouts",
        "take long",
        _keys(output="{width: 64, height: 48, layouts: 100000, views: 2}"),
        [CHECK],
        ANY,
        mebibytes=1500,
        quick=False,
    ),
    Attack(
        "scene: name that leads outside",
        "write outside",
        _name_outside,
        [("mitsplat", "render", "scene.yaml", "-n", "1", "--workers", "1")],
        ANY,
        quick=False,
    ),
    Attack(
        "scene: class that is a path, in all formats",
        "write outside",
        lambda p: p.scene(
            objects="[{asset: nut, count: 1, class_name: '../../../outside/made'}]",
            output="{width: 64, height: 48, layouts: 1, views: 1, formats: [yolo, coco, bop, colmap]}",
        ),
        [RENDER],
        ANY,
        quick=False,
        seconds=120,
    ),
    Attack(
        "scene: settled 200 objects",
        "take long",
        _keys(objects="[{asset: nut, count: 200}]", region="{min: [-0.2, -0.2, 0.02], max: [0.2, 0.2, 0.5]}"),
        [("mitsplat", "settle", "scene.yaml")],
        ANY,
        quick=False,
        seconds=400,
    ),
)
