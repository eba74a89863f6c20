"""Execution of one attack: runs commands in a folder of its own, measures their processes, and evaluates the result."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from benchmarks.scale.attack.samples import Place

ANY = frozenset({0, 1, 2, 3, 4})
"""Exit statuses of `mitsplat` without a crash: success, findings, invalid input, missing dependency, partial result."""
REFUSED = frozenset({2, 3})
FINE = frozenset({0})

SECRET_COLOUR = (255, 0, 255)
"""Colour of every pixel of the image that no command may read."""
SECRET_WORD = "WITNESS-OF-READING"
"""Word of the text files that no command may read."""

_LINGER = 3.0
"""Time limit for child processes to end after their parent [s]."""
_PAGE = os.sysconf("SC_PAGE_SIZE")
_PICTURES = (".png", ".jpg", ".jpeg")
_EMBEDDED = re.compile(rb"data:image/(?:png|jpeg);base64,([A-Za-z0-9+/=]+)")
_SENTENCE = 2000
"""Maximum length of an error sentence [characters]."""


@dataclass(frozen=True)
class Attack:
    """A hostile input, and the rules that its commands must obey.

    Attributes:
        name: Kind and variant, such as ``xml: link in a subfolder``.
        tries: Harm that the input attempts, a clause.
        build: Makes the input below ``place.inside``.
        commands: Run one after the other in ``place.inside``; ``mitsplat`` is the first word of most, and ``{inside}``,
            ``{outside}`` and ``{samples}`` are filled in.
        status: Permitted exit statuses of the last command. The others must exit with 0.
        seconds: Bound on the time of each command.
        mebibytes: Bound on the resident memory of a command and all its children.
        quick: True if it needs no rendering and takes a few seconds.
        environment: Variables of the commands, None to remove one.
        keep: Files below ``place.inside`` that must not change.
        needs: Packages without which it is skipped.
        check: Returns violations beyond the common rules.
        during: Called with the place while the last command runs, which is ended afterwards; returns violations.
    """

    name: str
    tries: str
    build: Callable[[Place], object]
    commands: Sequence[Sequence[str]]
    status: frozenset[int] = ANY
    seconds: float = 60
    mebibytes: float = 2500
    quick: bool = True
    environment: Mapping[str, str | None] = field(default_factory=dict)
    keep: Sequence[str] = ()
    needs: Sequence[str] = ()
    check: Callable[[Place, str], Iterable[str]] | None = None
    during: Callable[[Place], Iterable[str]] | None = None

    @property
    def missing(self) -> str | None:
        """Return the reason why it cannot run here, or None."""
        absent = [name for name in self.needs if importlib.util.find_spec(name) is None]
        return f"{', '.join(absent)} is not installed" if absent else None


@dataclass(frozen=True)
class Verdict:
    """Result of an attack.

    Attributes:
        faults: Violated rules, none if the attack was repelled.
        seconds: Time of all commands.
        mebibytes: Largest resident memory of a command and its children.
        last_line: Last line of standard error.
    """

    faults: tuple[str, ...]
    seconds: float
    mebibytes: float
    last_line: str


@dataclass
class Ended:
    """A command that has ended, or was stopped for ``reason``, with status None."""

    status: int | None
    seconds: float
    mebibytes: float
    output: str
    errors: str
    reason: str = ""
    left: int = 0


def judge(attack: Attack, place: Place) -> Verdict:
    """Build the input, run the commands and compare the files around them before and after."""
    attack.build(place)
    kept = {name: _fingerprint(place.inside / os.fsdecode(name)) for name in attack.keep}
    before, inputs = list(_tree(place.outside)), {path for path, _ in _tree(place.inside)}
    faults: list[str] = []
    seconds = mebibytes = 0.0
    last_line = ""
    for number, words in enumerate(attack.commands):
        last = number == len(attack.commands) - 1
        ended = run(filled(words, place), place, attack, during=attack.during if last else None, faults=faults)
        seconds, mebibytes = seconds + ended.seconds, max(mebibytes, ended.mebibytes)
        last_line = (ended.errors.strip().splitlines() or [""])[-1]
        faults += _offences(ended, attack.status if last else FINE, stopped=last and attack.during is not None)
        if SECRET_WORD in ended.output + ended.errors:
            faults.append("it prints text of a file outside")
        if faults:
            break
        if attack.check is not None and last:
            faults += attack.check(place, ended.output + ended.errors)
    after = list(_tree(place.outside))
    faults += [f"outside/{path} was changed, made or removed" for path in sorted(_differing(before, after))[:3]]
    faults += [f"{name} was changed" for name, was in kept.items() if _fingerprint(place.inside / name) != was]
    faults += [f"{path} shows what lies outside" for path in _leaks(place.inside, inputs)]
    faults += [f"{path} was made, which no command names" for path in _unnamed(attack, place, inputs)]
    return Verdict(tuple(faults), seconds, mebibytes, last_line)


def filled(words: Sequence[str], place: Place) -> list[str]:
    """Fill a place's folders into the words of a command."""
    program = str(Path(sys.executable).with_name("mitsplat"))
    names = {"{inside}": place.inside, "{outside}": place.outside, "{samples}": place.samples, "{mitsplat}": program}
    found = [program if word == "mitsplat" and index == 0 else word for index, word in enumerate(words)]
    for name, value in names.items():
        found = [word.replace(name, str(value)) for word in found]
    return found


def run(
    words: Sequence[str],
    place: Place,
    attack: Attack,
    *,
    during: Callable[[Place], Iterable[str]] | None = None,
    faults: list[str] | None = None,
) -> Ended:
    """Run a command within the bounds of an attack; end all its processes when it exceeds one."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    for name, value in attack.environment.items():
        environment.pop(name, None)
        if value is not None:
            (environment[name],) = filled([value], place)
    output, errors = place.root / "output.txt", place.root / "errors.txt"
    begun, peak, reason, known = time.monotonic(), 0.0, "", set[int]()
    with output.open("wb") as out, errors.open("wb") as err:
        process = subprocess.Popen(
            words,
            cwd=place.inside,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            start_new_session=True,
        )
        try:
            while process.poll() is None and not reason:
                known |= set(family(process.pid, known))
                peak = max(peak, sum(map(resident, known)) / 2**20)
                if time.monotonic() - begun > attack.seconds:
                    reason = f"it did not end within {attack.seconds:.0f} s"
                elif peak > attack.mebibytes:
                    reason = f"it takes more than {attack.mebibytes:.0f} MiB"
                elif during is not None and faults is not None:
                    faults += during(place)
                    known |= set(family(process.pid, known))
                    peak = max(peak, sum(map(resident, known)) / 2**20)
                    break
                time.sleep(0.02)
            stopped = process.poll() is None
            left = [] if stopped else _lingering(known, process.pid)
        finally:
            end(known | {process.pid})
            process.wait()
    return Ended(
        None if stopped else process.returncode,
        time.monotonic() - begun,
        peak,
        output.read_text(errors="replace"),
        errors.read_text(errors="replace"),
        reason,
        len(left),
    )


def family(process: int, known: Iterable[int] = ()) -> Iterator[int]:
    """Return a process and its descendants, and those of known processes."""
    waiting, seen = [process, *known], set[int]()
    while waiting:
        one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        try:
            tasks = list(Path(f"/proc/{one}/task").iterdir())
            waiting += [int(child) for task in tasks for child in (task / "children").read_text().split()]
        except OSError:
            continue
        yield one


def resident(process: int) -> int:
    """Return the resident memory of a process [bytes], without memory-mapped files; 0 if it has ended."""
    try:
        _, pages, shared, *_ = Path(f"/proc/{process}/statm").read_text().split()
    except (OSError, ValueError):
        return 0
    return (int(pages) - int(shared)) * _PAGE + _shared_memory(process)


def _shared_memory(process: int) -> int:
    """Return the resident memory that is shared without a file [bytes], such as arrays for workers."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0
    found = re.search(r"RssShmem:\s+(\d+) kB", status)
    return int(found[1]) << 10 if found else 0


def end(processes: Iterable[int]) -> None:
    """Kill processes started here."""
    for process in processes:
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            continue


def _lingering(known: set[int], session: int) -> list[int]:
    """Return processes that still run some time after the end of their session's leader."""
    until = time.monotonic() + _LINGER
    while left := [one for one in known | set(_in_session(session)) if resident(one)]:
        if time.monotonic() > until:
            break
        time.sleep(0.05)
    known.update(left)
    return left


def _in_session(session: int) -> Iterator[int]:
    """Return the processes of a session."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session:
            yield int(path.parent.name)


def _offences(ended: Ended, allowed: frozenset[int], *, stopped: bool) -> Iterator[str]:
    """Return violations of the rules for every command."""
    text = ended.errors + ended.output
    if ended.reason:
        yield ended.reason
    elif ended.status is None:
        if not stopped:
            yield "it was stopped"
    elif ended.status not in allowed:
        expected = " or ".join(map(str, sorted(allowed)))
        last_line = (text.strip().splitlines() or ["nothing"])[-1]
        yield f"it exits with status {ended.status}, not {expected}: {last_line:.300}"
    if "Traceback (most recent call last)" in text:
        yield "it prints a traceback"
    if "internal error of mitsplat" in text:
        yield "it is a fault of mitsplat"
    if ended.status in (2, 3, 4):
        lines = [line for line in ended.errors.splitlines() if line.startswith("mitsplat: ")]
        usage = ended.errors.startswith("Usage: ")
        if not usage and (not lines or len(lines[-1]) > _SENTENCE or "\0" in lines[-1]):
            yield f"it does not end in a sentence: {ended.errors.strip()[-200:]!r}"
    if ended.left:
        yield f"it leaves {ended.left} processes"


def _tree(folder: Path) -> Iterator[tuple[str, str]]:
    """Return every entry below a folder, without following links, with its fingerprint."""
    for path in sorted(folder.rglob("*")):
        yield str(path.relative_to(folder)), _fingerprint(path)


def _fingerprint(path: Path) -> str:
    """Return kind and content of a file, a link or a folder."""
    try:
        if path.is_symlink():
            return f"link to {path.readlink()}"
        if path.is_file():
            return hashlib.sha256(path.read_bytes()).hexdigest() if path.stat().st_size < 1 << 26 else "large"
        return "folder" if path.is_dir() else "other" if path.exists() else "absent"
    except OSError as error:
        return f"unreadable: {error.errno}"


def _unnamed(attack: Attack, place: Place, inputs: set[str]) -> Iterator[str]:
    """Return new files and folders beside the input with unexpected names.

    Expected names start with a name in the attack, or with ``out``.
    """
    words = " ".join(
        [*(word for command in attack.commands for word in command), *map(str, attack.environment.values())]
    )
    names = tuple(Path(word).name.partition(".")[0] or word for word in words.split() if word.strip("./"))
    for path in sorted(place.inside.iterdir()):
        if path.name not in inputs and not path.name.startswith((*names, "out")):
            yield path.name


def _differing(before: Sequence[tuple[str, str]], after: Sequence[tuple[str, str]]) -> set[str]:
    return {path for path, _ in set(before) ^ set(after)}


def _leaks(folder: Path, inputs: set[str]) -> Iterator[str]:
    """Return new files below a folder that contain the secret image or the secret word."""
    for name, _ in list(_tree(folder)):
        path = folder / name
        if name in inputs or path.is_symlink() or not path.is_file() or path.stat().st_size > 1 << 26:
            continue
        data = path.read_bytes()
        pictures = [data] if path.suffix.lower() in _PICTURES else []
        pictures += [base64.b64decode(found) for found in _EMBEDDED.findall(data)]
        if SECRET_WORD.encode() in data or any(map(_shows_secret, pictures)):
            yield name


def _shows_secret(data: bytes) -> bool:
    """Return True if a quarter of an image has the hue of the secret image, which is improbable for noise."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return False
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    return bool(np.mean((red > 60) & (blue > 60) & (2 * green < np.minimum(red, blue))) > 0.25)
