"""Hostile machines: names with invalid encodings, full or read-only folders, few resources, and wrong clocks."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from benchmarks.scale.attack.attack import ANY, FINE, REFUSED, Attack
from benchmarks.scale.attack.images import noise_photos, png_sky
from benchmarks.scale.attack.samples import ROOT, Place

RENDER = ("mitsplat", "render", "scene.yaml", "-o", "made", "--workers", "1")
TWO = ("mitsplat", "render", "scene.yaml", "-o", "made", "--workers", "2")
_ODD = os.fsdecode(b"caf\xe9\xff")
"""A name that is not valid UTF-8."""
_MESH = "[{name: table, box: {size: [1, 1, 0.1], position: [0, 0, -0.05]}}, {name: a, mesh: mesh.stl}]"
_SKY = "[{kind: environment, image: sky.png}]"
_LONG = ("--seed", f"{'7':>120000}")
"""Arguments of 120 kB, more than a pipe buffers."""
_JUMPING_CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>

static long jump(void) {
    static const long jumps[] = {0, 86400, -86400, 1000000000, -1000000000};
    static unsigned calls;
    return jumps[calls++ % 5];
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(clock, now);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += jump();
    return failed;
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec found;
    (void)zone;
    int failed = clock_gettime(CLOCK_REALTIME, &found);
    now->tv_sec = found.tv_sec;
    now->tv_usec = found.tv_nsec / 1000;
    return failed;
}

time_t time(time_t *now) {
    struct timespec found;
    clock_gettime(CLOCK_REALTIME, &found);
    if (now) *now = found.tv_sec;
    return found.tv_sec;
}
"""
"""C library whose clock of the date jumps by days and decades at every call."""


def _scene(place: Place) -> None:
    place.scene()


def _odd_folder(what: str) -> Callable[[Place], object]:
    """Create valid input in a file or folder whose name is not valid UTF-8."""

    def build(place: Place) -> None:
        if what == "dataset":
            place.take_dataset().rename(place.inside / _ODD)
        elif what == "scene":
            place.scene().rename(place.inside / f"{_ODD}.yaml")
        elif what == "asset":
            place.take("nut")
            (place.inside / "nut").rename(place.inside / _ODD)
        elif what == "photos":
            noise_photos(place)
            (place.inside / "photos/1.png").rename(place.inside / f"photos/{_ODD}.png")
        else:
            place.take(what).rename(place.inside / f"{_ODD}{Path(what).suffix}")

    return build


def _odd_link(name: str, **changes: str) -> Callable[[Place], object]:
    """Create a valid scene or capture that reads a file or folder through a link to a name that is not valid UTF-8."""

    def build(place: Place) -> None:
        path = place.inside / name
        noise_photos(place)
        png_sky(place.inside / "sky.png")
        place.take("mesh.stl", "walk.avi")
        place.scene(**changes)
        path.rename(path.with_name(_ODD))
        path.symlink_to(_ODD)

    return build


def _odd_home(place: Place) -> None:
    """Create a scene in a folder behind a link."""
    home = place.inside / _ODD
    home.mkdir()
    place.scene().rename(home / "scene.yaml")
    (place.inside / "nut").rename(home / "nut")
    (place.inside / "home").symlink_to(_ODD)


def _odd_match(place: Place) -> None:
    """Create a pool of assets, one of which has a name that is not valid UTF-8."""
    place.scene(objects="[{pool: 'parts/*', count: 1}]")
    shutil.copytree(place.inside / "nut", place.inside / "parts" / _ODD)


def _odd_image(place: Place) -> None:
    place.scene(background="{images: skies}")
    (place.inside / "skies").mkdir()
    png_sky(place.inside / "skies" / f"{_ODD}.png")


def _odd_entry(place: Place) -> None:
    """Rename an image of a dataset to a name that is not valid UTF-8, also in its manifest."""
    dataset = place.take_dataset()
    manifest = dataset / "manifest.jsonl"
    manifest.write_text(manifest.read_text().replace("train/000000.png", "train/caf\\udce9.png"))
    (dataset / "images/train/000000.png").rename(dataset / "images/train" / os.fsdecode(b"caf\xe9.png"))


def _name_attacks() -> Iterator[Attack]:
    commands: tuple[tuple[str, str, tuple[str, ...], bool], ...] = (
        ("audit", "dataset", ("audit", _ODD), False),
        ("report", "dataset", ("report", _ODD), False),
        ("split", "dataset", ("split", _ODD), False),
        ("merge", "dataset", ("merge", _ODD, "-o", "made"), False),
        ("render", "scene", ("render", f"{_ODD}.yaml", "-o", "made", "--workers", "1"), False),
        ("render into", "", ("render", "scene.yaml", "-o", _ODD, "--workers", "1"), False),
        ("preview", "scene", ("preview", f"{_ODD}.yaml", "-o", f"{_ODD}.png"), False),
        ("check of a scene", "scene", ("check", f"{_ODD}.yaml"), False),
        ("check of an asset", "asset", ("check", _ODD), True),
        ("render of a Mitsuba scene", "scene.xml", ("render", f"{_ODD}.xml", "-o", "made.png"), True),
        ("import of a PLY", "a.ply", ("import", f"{_ODD}.ply", "-o", "made", "--size", "0.1"), True),
        ("import of a SOG", "a.sog", ("import", f"{_ODD}.sog", "-o", "made", "--size", "0.1"), True),
        ("bake", "mesh.stl", ("bake", f"{_ODD}.stl", "-o", "made", "--gaussians", "200"), False),
        ("capture of photographs", "photos", ("capture", "photos", "-o", "made"), True),
        ("capture of a video", "walk.avi", ("capture", f"{_ODD}.avi", "-o", _ODD), True),
    )
    for name, what, words, quick in commands:
        yield Attack(
            f"name: {name}, no UTF-8",
            "crash native code that expects text",
            _scene if not what else _odd_folder(what),
            [("mitsplat", *words)],
            ANY,
            quick=quick,
            seconds=90,
        )
    capture, home = ("mitsplat", "capture", "photos", "-o", "made"), ("mitsplat", "render", "home/scene.yaml")
    cases: tuple[tuple[str, Callable[[Place], object], tuple[str, ...], frozenset[int]], ...] = (
        ("folder of the scene behind a link", _odd_home, (*home, *RENDER[3:]), FINE),
        ("asset behind a link", _odd_link("nut"), RENDER, ANY),
        ("mesh behind a link", _odd_link("mesh.stl", shapes=_MESH), RENDER, ANY),
        ("image of a light behind a link", _odd_link("sky.png", lights=_SKY), RENDER, ANY),
        ("photograph behind a link", _odd_link("photos/1.png"), capture, ANY),
        ("folder of photographs behind a link", _odd_link("photos"), capture, ANY),
        ("video behind a link", _odd_link("walk.avi"), ("mitsplat", "capture", "walk.avi", "-o", "made"), ANY),
        ("asset of a pool", _odd_match, RENDER, REFUSED),
        ("image of a list", _odd_image, RENDER, REFUSED),
        ("file of a dataset, audit", _odd_entry, ("mitsplat", "audit", "dataset"), frozenset({1, 2})),
        ("file of a dataset, report", _odd_entry, ("mitsplat", "report", "dataset"), ANY),
        ("file of a dataset, merge", _odd_entry, ("mitsplat", "merge", "dataset", "-o", "made"), ANY),
        ("file of a dataset, split", _odd_entry, ("mitsplat", "split", "dataset", "--folds", "2"), ANY),
    )
    for name, build, words, status in cases:
        yield Attack(
            f"name: {name}, no UTF-8",
            "crash native code that expects text",
            build,
            [words],
            status,
            quick=False,
            seconds=90,
        )


def _shell(text: str, *words: str) -> tuple[str, ...]:
    """Return a command that a shell runs after another one."""
    return ("sh", "-c", f'{text} exec "$0" "$@"', "{mitsplat}", *words)


def _mounted(folder: str, size: str, *words: str) -> tuple[str, ...]:
    """Return a command with a small file system mounted at a folder; needs user namespaces."""
    return ("unshare", "-rm", *_shell(f"mkdir -p {folder} && mount -t tmpfs -o size={size} none {folder} &&", *words))


def _read_only(folder: str, *words: str) -> tuple[str, ...]:
    return ("unshare", "-rm", *_shell(f"mkdir -p {folder} && mount -t tmpfs -o ro none {folder} &&", *words))


def _installed_read_only(*words: str) -> tuple[str, ...]:
    """Return a command with read-only folders of mitsplat and of Python; needs user namespaces."""
    folders = " ".join(shlex.quote(str(folder)) for folder in (ROOT, Path(sys.prefix), Path(sys.base_prefix)))
    mount = f"for f in {folders}; do mount --bind $f $f && mount -o remount,bind,ro $f || exit 99; done;"
    return ("unshare", "-rm", *_shell(mount, *words))


def _rendered(place: Place, output: str) -> Iterable[str]:
    lines = place.inside / "made/manifest.jsonl"
    found = lines.read_text().count("\n") if lines.exists() else 0
    return [] if found == 2 else [f"the dataset has {found} of 2 frames"]


_DEAD_START = (
    "import os, sys\nif any('spawn_main' in word or 'forkserver' in word for word in sys.orig_argv):\n    {}\n"
)


def _start(text: str) -> Callable[[Place], object]:
    """Create a scene whose worker processes end or hang at their start."""

    def build(place: Place) -> None:
        place.scene()
        place.write("start/sitecustomize.py", _DEAD_START.format(text))

    return build


def _times(seconds: float) -> Callable[[Place], object]:
    """Set the modification time of every input."""

    def build(place: Place) -> None:
        place.take_dataset()
        for path in [place.inside, *place.inside.rglob("*")]:
            os.utime(path, (seconds, seconds))

    return build


def _jumping_clock(place: Place) -> None:
    place.scene()
    source = place.write("clock.c", _JUMPING_CLOCK)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", source.with_suffix(".so"), source, "-ldl"], check=True)


def _earlier_runs(place: Place) -> None:
    """Write records of runs in the future, as after the clock was set back."""
    dataset = place.take_dataset()
    for name in ("runs.jsonl", "timings.jsonl"):
        path = dataset / name
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            line.update(
                {
                    key: "2200-01-01T00:00:00+00:00"
                    for key, value in line.items()
                    if "20" in str(value)[:2] and isinstance(value, str)
                }
            )
        path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    os.utime(dataset / "runs.jsonl", (time.time() + 1e9,) * 2)


def _resumed_out_of_room(place: Place) -> None:
    place.scene(output="{width: 320, height: 240, layouts: 1, views: 40, formats: [yolo, coco, exr]}")


def _unprivileged(*words: str) -> tuple[str, ...]:
    return ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "{mitsplat}", *words)


def _open_to_all(place: Place) -> None:
    place.scene()
    for path in [place.root, place.inside, *place.inside.rglob("*")]:
        path.chmod(0o777)
    (place.root.parent).chmod(0o755)


def _readable_install() -> bool:
    """Return True if other users can read this Python."""
    folders = [Path(sys.executable), *Path(sys.executable).parents, *Path(os.path.realpath(sys.executable)).parents]
    return all(folder.stat().st_mode & 0o005 for folder in folders)


def _no_frames_lost(place: Place, output: str) -> Iterable[str]:
    return (
        [] if "room" in output or "space" in output else [f"it does not say that there is no room: {output[-300:]!r}"]
    )


_CACHE = {"XDG_CACHE_HOME": "{inside}/cache"}

ATTACKS = tuple(
    attack
    for attack in (
        *_name_attacks(),
        Attack(
            "cache: home is /, as nobody" if _readable_install() else "cache: home that cannot be written",
            "have renders refused",
            _open_to_all,
            [_unprivileged(*RENDER[1:])] if _readable_install() else [RENDER],
            FINE,
            quick=False,
            seconds=300,
            environment={"HOME": "/" if _readable_install() else "/proc", "XDG_CACHE_HOME": None},
            check=_rendered,
        ),
        Attack(
            "cache: below a file",
            "have renders refused",
            lambda p: (_scene(p), p.write("cache", "")),
            [RENDER],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "cache: in /proc",
            "have renders refused",
            _scene,
            [RENDER],
            FINE,
            quick=False,
            seconds=300,
            environment={"XDG_CACHE_HOME": "/proc/cache"},
            check=_rendered,
        ),
        Attack(
            "cache: read-only",
            "have renders refused",
            _scene,
            [_read_only("cache", *RENDER[1:])],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "cache: full",
            "have renders refused",
            _scene,
            [_mounted("cache", "16k", *RENDER[1:])],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "cache: full, with warp's simulation",
            "have renders refused",
            lambda p: p.scene(settle="{stepper: warp}"),
            [_mounted("cache", "16k", *RENDER[1:])],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "cache: of hostile files",
            "run or trust what lies in the cache",
            lambda p: (_scene(p), [p.write(f"cache/mitsplat/{n}", b"\xff" * 999) for n in ("a", "llvm", "gpus.json")]),
            [RENDER],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "disk: full from the start",
            "tear a dataset",
            _scene,
            [_mounted("made", "16k", *RENDER[1:])],
            REFUSED,
            quick=False,
            seconds=120,
            check=_no_frames_lost,
        ),
        Attack(
            "disk: fills during a run",
            "tear a dataset",
            _resumed_out_of_room,
            [_mounted("made", "3m", *RENDER[1:])],
            REFUSED,
            quick=False,
            seconds=180,
            check=_no_frames_lost,
        ),
        Attack(
            "disk: read-only",
            "tear a dataset",
            _scene,
            [_read_only("made", *RENDER[1:])],
            REFUSED,
            quick=False,
            seconds=120,
        ),
        Attack(
            "disk: full where temporary files go",
            "crash",
            lambda p: p.take("a.sog"),
            [_mounted("tmp", "4k", "import", "a.sog", "-o", "made", "--size", "0.1")],
            ANY,
            environment={"TMPDIR": "{inside}/tmp"},
        ),
        Attack(
            "workers: end as they start",
            "have the run wait for ever",
            _start("os._exit(9)"),
            [TWO],
            ANY,
            quick=False,
            seconds=150,
            environment={"PYTHONPATH": "{inside}/start"},
        ),
        Attack(
            "workers: end as they start, with a command line of 120 kB",
            "have the run wait for ever",
            _start("os._exit(9)"),
            [(*TWO, *_LONG)],
            ANY,
            quick=False,
            seconds=150,
            environment={"PYTHONPATH": "{inside}/start"},
        ),
        Attack(
            "workers: are killed as they start",
            "have the run wait for ever",
            _start("os.kill(os.getpid(), 9)"),
            [TWO],
            ANY,
            quick=False,
            seconds=150,
            environment={"PYTHONPATH": "{inside}/start"},
        ),
        Attack(
            "machine: warnings are errors",
            "end a finished run as a fault",
            _scene,
            [RENDER],
            FINE,
            quick=False,
            seconds=120,
            environment={"PYTHONWARNINGS": "error"},
            check=_rendered,
        ),
        Attack(
            "machine: warnings are errors, check",
            "end a check as a fault",
            _scene,
            [("mitsplat", "check", "scene.yaml")],
            frozenset({0, 1}),
            quick=False,
            environment={"PYTHONWARNINGS": "error"},
        ),
        Attack(
            "machine: 2 GB of addresses", "crash", _scene, [_shell("ulimit -v 2000000;", *RENDER[1:])], ANY, quick=False
        ),
        Attack(
            "machine: 32 open files",
            "crash",
            _scene,
            [_shell("ulimit -n 32;", *TWO[1:])],
            ANY,
            quick=False,
            seconds=120,
        ),
        Attack(
            "machine: files of 1 kB at most",
            "tear a dataset",
            _scene,
            [_shell("ulimit -f 2;", *RENDER[1:])],
            ANY,
            quick=False,
            seconds=120,
        ),
        Attack("machine: full standard output", "end as a fault", _scene, [_shell("exec >/dev/full;", "schema")], ANY),
        Attack("machine: closed standard output", "end as a fault", _scene, [_shell("exec >&-;", "schema")], ANY),
        Attack(
            "machine: closed standard streams",
            "end as a fault",
            lambda p: p.write("scene.yaml", "a"),
            [_shell("exec <&- >&- 2>/dev/null;", "schema")],
            ANY,
        ),
        Attack(
            "machine: ASCII terminal",
            "end as a fault",
            lambda p: p.scene(name="кирпич").rename(p.inside / "ж.yaml"),
            [("mitsplat", "check", "ж.yaml")],
            ANY,
            quick=False,
            environment={"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii", "PYTHONCOERCECLOCALE": "0"},
        ),
        Attack(
            "machine: current folder removed",
            "end as a fault",
            lambda p: p.take("a.ply"),
            [_shell("mkdir x && cd x && rmdir ../x;", "import", "{inside}/a.ply", "-o", "made", "--size", "0.1")],
            ANY,
        ),
        Attack(
            "machine: read-only installation",
            "have renders refused",
            _scene,
            [_installed_read_only(*RENDER[1:])],
            FINE,
            quick=False,
            seconds=300,
            environment=_CACHE,
            check=_rendered,
        ),
        Attack(
            "machine: read-only installation and cache",
            "have renders refused",
            _scene,
            [_installed_read_only(*RENDER[1:])],
            FINE,
            quick=False,
            seconds=300,
            environment={"HOME": "/proc", "XDG_CACHE_HOME": "/proc/cache"},
            check=_rendered,
        ),
        Attack(
            "machine: command line of 120 kB",
            "have workers wait for ever",
            _scene,
            [(*TWO, *_LONG)],
            FINE,
            quick=False,
            seconds=150,
            check=_rendered,
        ),
        Attack(
            "machine: no home folder",
            "end as a fault",
            _scene,
            [RENDER],
            FINE,
            quick=False,
            seconds=120,
            environment={"HOME": None, "XDG_CACHE_HOME": None},
            check=_rendered,
        ),
        Attack(
            "clock: files of the year 2200",
            "break a resumed run",
            _times(7.3e9),
            [("mitsplat", "render", "scene.yaml", "-o", "dataset", "--workers", "1")],
            FINE,
            quick=False,
        ),
        Attack(
            "clock: files of the year 1901",
            "break a resumed run",
            _times(-2.1e9),
            [("mitsplat", "render", "scene.yaml", "-o", "dataset", "--workers", "1")],
            FINE,
            quick=False,
        ),
        *(
            Attack(
                f"clock: jumps during a run, {name}",
                "hang, or tear a dataset",
                _jumping_clock,
                [command],
                FINE,
                quick=False,
                seconds=200,
                environment={"LD_PRELOAD": "{inside}/clock.so"},
                check=_rendered,
            )
            for name, command in (("one process", RENDER), ("two workers", TWO))
            if shutil.which("cc")
        ),
        Attack(
            "clock: set back between runs",
            "break a resumed run",
            _earlier_runs,
            [("mitsplat", "render", "scene.yaml", "-o", "dataset", "--workers", "1")],
            FINE,
            quick=False,
        ),
    )
    if shutil.which(attack.commands[-1][0]) or attack.commands[-1][0] == "mitsplat"
)
