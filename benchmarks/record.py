"""Records the figures of benchmarks in ``benchmarks/results``, from which pages of the documentation are generated.

    with recording("render.frame", parser, options):
        ...
        figure(0.52, "s", "whole frame")

Each benchmark has one file, ``BENCHMARK.jsonl``, with a line for each configuration: the arguments that change figures.
A run replaces the line of its configuration. A run from a checkout with uncommitted changes prints its figures, but is
not recorded and ends with an error. ``MITSPLAT_RECORD=0`` runs a benchmark without recording.

The module needs the standard library only, because scripts in environments without mitsplat import it.
"""

from __future__ import annotations

import argparse
import datetime
import fcntl
import json
import math
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SHOWN = "results", "templates", "figures.py", "again.py", "README.md"
MEASURED = "mitsplat", "plugins", "scenes", "benchmarks", *(f":!benchmarks/{name}" for name in SHOWN)
"""Paths that determine figures: uncommitted changes of these prevent recording."""
RECORDS = os.environ.get("MITSPLAT_RECORD") != "0"
"""False if figures are printed only."""

_open: list[dict[str, list[Any]]] = []


def slug(text: object) -> str:
    """Return a word of lower-case letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", str(text).lower()).strip("_")


def figure(value: Any, unit: str, *path: object) -> None:
    """Add a figure to the benchmark that is being recorded, if there is one.

    Args:
        value: A number, some text, or a (minimum, maximum) pair.
        unit: Such as ``s``, ``dB`` or ``MiB``; empty for counts, ratios and shares.
        path: Words of its name, from general to specific.
    """
    if _open:
        _open[-1][".".join(map(slug, path))] = [_plain(value), unit]


def _plain(value: Any) -> Any:
    """Return a value as JSON stores it: numbers of six digits, infinity as text, NaN as None."""
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence):
        return [_plain(one) for one in value]
    number = float(value)
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "∞" if number > 0 else "-∞"
    return int(number) if number == int(number) else float(f"{number:.6g}")


def configuration_of(parser: argparse.ArgumentParser, options: argparse.Namespace, ignore: Sequence[str] = ()) -> str:
    """Return the positional arguments and the options that differ from their defaults, as one word.

    A path is represented by its name only. Options in ``ignore`` are omitted.
    """
    parts = []
    for action in parser._actions:
        if action.dest in ("help", *ignore):
            continue
        value = getattr(options, action.dest)
        if action.option_strings and value == action.default:
            continue
        values = [] if value is True or value is None else value if isinstance(value, list) else [value]
        words = [slug(Path(one).stem if isinstance(one, Path) or "/" in str(one) else one) for one in values]
        parts.append("_".join([slug(action.dest), *words] if action.option_strings else words))
    return "-".join(part for part in parts if part)


@contextmanager
def recording(
    benchmark: str,
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    *,
    ignore: Sequence[str] = (),
    gpu: bool = False,
    command: Sequence[str] | None = None,
    folder: Path = RESULTS,
) -> Iterator[None]:
    """Record the figures of a run that ends without an exception, in place of those of the same configuration.

    Args:
        benchmark: Module below ``benchmarks``.
        parser: Argument parser with the defaults.
        options: Parsed arguments.
        ignore: Options that change no figure, such as the folder for pictures.
        gpu: True if the benchmark uses a GPU.
        command: Command of the benchmark, if it is not ``python -m benchmarks.`` and the module.
        folder: Folder of the results.

    Raises:
        SystemExit: At the end of a run from a checkout with uncommitted changes.
    """
    figures: dict[str, list[Any]] = {}
    at, load, cpu = revision(), os.getloadavg()[0], cpu_seconds()
    if refused := refusal() if RECORDS else None:
        print(refused, file=sys.stderr)
    start = time.monotonic()
    _open.append(figures)
    try:
        yield
    finally:
        _open.pop()
    if refused:
        sys.exit(refused)
    if not RECORDS:
        return
    words = command or ("python", "-m", f"benchmarks.{benchmark}")
    about = {
        "command": shlex.join([*words, *sys.argv[1:]]),
        "recorded": "run",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "revision": at,
        "machine": machine(gpu),
        "load": {"start": round(load, 1), "end": round(os.getloadavg()[0], 1)},
        "seconds": round(time.monotonic() - start, 1),
        "cpu_seconds": round(cpu_seconds() - cpu, 1),
    }
    write_result(benchmark, configuration_of(parser, options, ignore), {**about, "figures": figures}, folder)


def write_result(benchmark: str, configuration: str, result: Mapping[str, Any], folder: Path) -> None:
    """Replace the line of a configuration; print a message if that fails, because the figures were printed."""
    line = json.dumps({"configuration": configuration, **result}, ensure_ascii=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"{benchmark}.jsonl").open("a+", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # several runs of the detector experiment end at the same time
            file.seek(0)
            lines = {json.loads(line)["configuration"]: line for line in file.read().splitlines()}
            lines[configuration] = line
            file.truncate(0)
            file.writelines(f"{lines[key]}\n" for key in sorted(lines))
    except OSError as error:
        print(f"the result was not recorded: {error}", file=sys.stderr)


def read_recorded(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Read all results, by benchmark and configuration: ``render.frame``, ``render.frame-ten``."""
    return {
        "-".join(filter(None, (path.stem, result["configuration"]))): result
        for path in sorted(folder.glob("*.jsonl"))
        for result in map(json.loads, path.read_text(encoding="utf-8").splitlines())
    }


def refusal(folder: Path = ROOT) -> str | None:
    """Return the reason why a run from a checkout is not recorded, or None if it has no uncommitted changes."""
    try:
        changes = _output_of("git", "-C", str(folder), "status", "--porcelain", "--", *MEASURED).splitlines()
    except (OSError, subprocess.CalledProcessError):
        return None
    if not changes:
        return None
    more = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    return (
        f"error: {folder}: results are recorded only without uncommitted changes (got {changes[0].split()[-1]}{more}); "
        "commit them, or set MITSPLAT_RECORD=0 to print figures without recording"
    )


def revision(folder: Path = ROOT) -> str:
    """Return the commit; ``unknown`` outside of a checkout."""
    try:
        return _output_of("git", "-C", str(folder), "rev-parse", "--short=9", "HEAD")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def machine(gpu: bool) -> dict[str, Any]:
    """Describe the machine: processor, cores available to this process, memory [GiB], and the GPU if one is used."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": names[0] if names else "unknown",
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": round(memory),
        "gpu": _gpu() if gpu else None,
    }


def _gpu() -> str:
    program = shutil.which("nvidia-smi")
    try:
        names = _output_of(program, "--query-gpu=name", "--format=csv,noheader") if program else ""
    except (OSError, subprocess.CalledProcessError):
        names = ""
    return names.partition("\n")[0] or "unknown"


def _output_of(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def cpu_seconds() -> float:
    """Return the processor time of this process and of its children that have ended [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
