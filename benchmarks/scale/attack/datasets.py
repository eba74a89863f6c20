"""Hostile datasets: links to the outside, damaged records, and replaced files."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.scale.attack.attack import ANY, Attack
from benchmarks.scale.attack.images import bomb
from benchmarks.scale.attack.samples import Place

Build = Callable[[Place], object]

AUDIT = ("mitsplat", "audit", "dataset")
REPORT = ("mitsplat", "report", "dataset")
SPLIT = ("mitsplat", "split", "dataset", "--folds", "2")
MERGE = ("mitsplat", "merge", "dataset", "-o", "made")
RESUME = ("mitsplat", "render", "scene.yaml", "-o", "dataset", "--workers", "1")
REPLACE = (*RESUME, "--overwrite")


def _linked(name: str) -> Build:
    """Move a file or folder of a dataset outside, and leave a link to it."""

    def build(place: Place) -> None:
        path = place.take_dataset() / name
        target = place.outside / f"target-{path.name}"
        if path.exists():
            shutil.move(path, target)
        else:
            target.write_text("Not a file of a dataset.\n")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(target)

    return build


def _hostile_link(name: str) -> Build:
    """Replace a file of a dataset by a link to an unrelated text."""

    def build(place: Place) -> None:
        path = place.take_dataset() / name
        path.unlink(missing_ok=True)
        path.symlink_to(place.outside / "secret.yaml")

    return build


_WRITERS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "split": (SPLIT, ("manifest.jsonl", ".lock", "fold0_train.txt", "runs.jsonl", "data.yaml")),
    "report": (REPORT, ("report.html", "manifest.jsonl")),
    "merge": (MERGE, ("manifest.jsonl", ".lock", "runs.jsonl")),
    "render": (
        RESUME,
        (
            "manifest.jsonl",
            ".lock",
            "runs.jsonl",
            "timings.jsonl",
            "dataset.json",
            "contact_sheet.jpg",
            "annotations",
            "images/train",
            "labels",
            "layouts",
            "scene",
            "scene/scene.yaml",
        ),
    ),
    "overwrite": (REPLACE, ("manifest.jsonl", ".lock", "labels", "images", "annotations/instances_train.json")),
}


def _link_attacks() -> Iterator[Attack]:
    for name, (command, files) in _WRITERS.items():
        for file in files:
            yield Attack(
                f"link: {name} where {file} leads outside",
                "change a file outside of the dataset",
                _linked(file),
                [command],
                ANY,
                quick=False,
            )
        for file in (".lock", "manifest.jsonl") if name in ("merge", "render") else ():
            yield Attack(
                f"link: {name} where {file} is another text",
                "change a text outside of the dataset",
                _hostile_link(file),
                [command],
                ANY,
                quick=False,
            )


def _out_is_link(place: Place) -> None:
    _scene_only(place)
    (place.inside / "dataset").symlink_to(place.outside / "folder")


def _scene_only(place: Place) -> None:
    place.scene()


def _torn_input(place: Place) -> None:
    path = place.take_dataset() / "manifest.jsonl"
    with path.open("ab") as file:
        file.write(b'{"index": 2, "torn')


def _notes(place: Place) -> None:
    dataset = place.take_dataset()
    for name in ("labels/notes.txt", "labels/train/notes.txt", "images/train/mine.png"):
        (dataset / name).write_text("Not made by mitsplat.\n")


def _records(change: Callable[[dict[str, Any]], object]) -> Build:
    """Change the first record of a dataset's manifest."""

    def build(place: Place) -> None:
        path = place.take_dataset() / "manifest.jsonl"
        first, *rest = path.read_text().splitlines()
        record = json.loads(first)
        change(record)
        path.write_text("\n".join([json.dumps(record), *rest]) + "\n")

    return build


def _replaced(name: str, content: Callable[[], bytes]) -> Build:
    def build(place: Place) -> None:
        path = place.take_dataset() / name
        path.unlink(missing_ok=True)
        path.write_bytes(content())

    return build


def _large(name: str, head: bytes = b"") -> Build:
    """Replace a file of a dataset by a sparse file of 3 GB."""

    def build(place: Place) -> None:
        path = place.take_dataset() / name
        path.write_bytes(head)
        os.truncate(path, 3 << 30)

    return build


def _pipe(name: str) -> Build:
    def build(place: Place) -> None:
        path = place.take_dataset() / name
        path.unlink(missing_ok=True)
        os.mkfifo(path)

    return build


def _image(place: Place) -> str:
    return "images/train/000000.png"


def _linked_image(place: Place) -> None:
    path = place.take_dataset() / _image(place)
    path.unlink()
    path.symlink_to(place.outside / "secret.png")


def _deep() -> bytes:
    return b"[" * 100_000 + b"]" * 100_000


def _set(*keys: str, value: Any) -> Callable[[dict[str, Any]], object]:
    def change(record: dict[str, Any]) -> None:
        for key in keys:
            record[key] = value

    return change


BUILDS: Mapping[str, tuple[str, Build, tuple[str, ...]]] = {
    "description nested 100,000 deep": (
        "crash",
        _replaced("dataset.json", _deep),
        ("audit", "resume"),
    ),
    "manifest nested 100,000 deep": (
        "crash",
        _replaced("manifest.jsonl", lambda: _deep() + b"\n"),
        ("audit", "resume"),
    ),
    "layout nested 100,000 deep": ("crash", _replaced("layouts/0000.json", _deep), ("audit", "resume")),
    "annotations nested 100,000 deep": ("crash", _replaced("annotations/instances_train.json", _deep), ("audit",)),
    "timings nested 100,000 deep": ("crash", _replaced("timings.jsonl", lambda: _deep() + b"\n"), ("report", "merge")),
    "runs nested 100,000 deep": (
        "crash",
        _replaced("runs.jsonl", lambda: _deep() + b"\n"),
        ("report", "merge", "resume"),
    ),
    "manifest of no objects": (
        "crash",
        _replaced("manifest.jsonl", lambda: b'1\n[]\nnull\n"a"\n'),
        ("audit", "resume"),
    ),
    "manifest of empty objects": (
        "crash",
        _replaced("manifest.jsonl", lambda: b"{}\n{}\n"),
        ("audit", "resume"),
    ),
    "manifest of bytes": (
        "crash",
        _replaced("manifest.jsonl", lambda: b"\xff\xfe\0" * 99 + b"\n"),
        ("audit", "resume"),
    ),
    "line without index": ("crash", _records(lambda r: r.pop("index")), ("audit", "resume")),
    "line without files": ("crash", _records(lambda r: r.pop("files", None)), ("audit", "resume")),
    "line without split": ("crash", _records(lambda r: r.pop("split")), ("audit", "resume")),
    "line without instances": ("crash", _records(lambda r: r.pop("instances", None)), ("audit", "report")),
    "line without camera": ("crash", _records(lambda r: r.pop("camera", None)), ("audit", "report")),
    "index 10^300": ("fill memory", _records(_set("index", value=10**300)), ("audit", "resume")),
    "index -1": ("crash", _records(_set("index", value=-1)), ("audit", "resume")),
    "index of no number": ("crash", _records(_set("index", value=float("nan"))), ("audit", "resume")),
    "index as text": ("crash", _records(_set("index", value="../../outside/secret")), ("audit", "resume")),
    "layout 10^9": ("crash", _records(_set("layout", value=10**9)), ("audit", "split")),
    "split that leads outside": (
        "write outside",
        _records(_set("split", value="../../../outside")),
        ("audit", "split"),
    ),
    "files that lead outside": (
        "read outside",
        _records(_set("files", value=["../outside/secret.png", "/etc/passwd"])),
        ("audit", "report"),
    ),
    "files that are no list": ("crash", _records(_set("files", value={"a": 1})), ("audit", "report")),
    "description that is a pipe": ("wait for ever", _pipe("dataset.json"), ("audit", "resume")),
    "manifest that is a pipe": ("wait for ever", _pipe("manifest.jsonl"), ("audit", "resume")),
    "image that is a pipe": ("wait for ever", _pipe("images/train/000000.png"), ("audit", "report")),
    "label that is a pipe": ("wait for ever", _pipe("labels/train/000000.txt"), ("audit",)),
    "scene that is a pipe": ("wait for ever", _pipe("scene/scene.yaml"), ("audit", "report")),
    "lock that is a pipe": ("wait for ever", _pipe(".lock"), ("split", "merge", "resume")),
    "description of 3 GB": ("fill memory", _large("dataset.json"), ("audit", "split")),
    "manifest line of 3 GB": ("fill memory", _large("manifest.jsonl"), ("audit", "resume")),
    "image of 3 GB": ("fill memory", _large("images/train/000000.png"), ("audit", "report")),
    "labels of 3 GB": ("fill memory", _large("labels/train/000000.txt"), ("audit",)),
    "annotations of 3 GB": ("fill memory", _large("annotations/instances_train.json", b"{"), ("audit",)),
    "image bomb": ("fill memory", _replaced("images/train/000000.png", lambda: bomb(40_000)), ("audit", "report")),
    "image linked to a secret": ("show a picture from outside", _linked_image, ("report", "audit")),
}

_COMMANDS = {"audit": AUDIT, "report": REPORT, "split": SPLIT, "merge": MERGE, "resume": RESUME}


def _record_attacks() -> Iterator[Attack]:
    for name, (tries, build, commands) in BUILDS.items():
        for command in commands:
            yield Attack(f"dataset: {command}, {name}", tries, build, [_COMMANDS[command]], ANY, quick=False)


def _markup(place: Place) -> None:
    dataset = place.take_dataset()
    hostile = "</td><script>alert(7)</script><img src=x onerror=alert(7)>"
    path = dataset / "manifest.jsonl"
    path.write_text(path.read_text().replace('"nut"', json.dumps(hostile)))
    description = dataset / "dataset.json"
    description.write_text(
        description.read_text().replace('"nut"', json.dumps(hostile)).replace('"nuts"', json.dumps(hostile))
    )


def _no_script(place: Place, output: str) -> Iterable[str]:
    page = place.inside / "dataset/report.html"
    text = page.read_text() if page.exists() else ""
    return (
        ["report.html holds a script of a class's name"] if "<script>alert(7)" in text or "<img src=x" in text else []
    )


def _linked_shards(place: Place) -> None:
    """Create two shards, one of which is a link to a folder outside."""
    dataset = place.take_dataset()
    shutil.move(dataset, place.outside / "shard")
    Path(place.inside / "dataset").symlink_to(place.outside / "shard")


ATTACKS = (
    *_link_attacks(),
    Attack(
        "link: render into a link to a folder",
        "write outside",
        _out_is_link,
        [RESUME],
        ANY,
        quick=False,
        seconds=90,
        check=lambda place, output: (),
    ),
    Attack("link: merge of a linked shard", "change an input", _linked_shards, [MERGE], ANY, quick=False),
    Attack(
        "dataset: merge, torn last line",
        "cut an input",
        _torn_input,
        [MERGE],
        ANY,
        quick=False,
        keep=("dataset/manifest.jsonl", "dataset/runs.jsonl", "dataset/dataset.json"),
    ),
    Attack(
        "dataset: overwrite, files of others",
        "have notes removed",
        _notes,
        [REPLACE],
        ANY,
        quick=False,
        keep=("dataset/labels/notes.txt", "dataset/labels/train/notes.txt", "dataset/images/train/mine.png"),
    ),
    *_record_attacks(),
    Attack(
        "dataset: report, class with markup",
        "run a script in the page",
        _markup,
        [REPORT],
        ANY,
        quick=False,
        check=_no_script,
    ),
)
