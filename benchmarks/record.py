"""Keeps what a benchmark measures as ``benchmarks/results/NAME.json``, from which the documentation's figures are made.

    with recording("render.frame", parser, options):
        ...
        figure(0.52, "s", "whole frame")

Takes only the standard library, so that scripts in environments without mitsplat can use it too.
"""

from __future__ import annotations

import argparse
import datetime
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
"""What decides figures: a change of these that is not committed makes a revision a changed one."""

_open: list[dict[str, list[Any]]] = []


def slug(text: object) -> str:
    """A word of lower-case letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", str(text).lower()).strip("_")


def figure(value: Any, unit: str, *path: object) -> None:
    """Keep a figure of the benchmark that is being recorded, if one is.

    Args:
        value: A number, some text, or a pair of the least and the most.
        unit: Such as ``s``, ``dB`` or ``MiB``; empty for counts, ratios and shares.
        path: Words that name it, from the general to the particular.
    """
    if _open:
        _open[-1][".".join(map(slug, path))] = [_plain(value), unit]


def _plain(value: Any) -> Any:
    """As JSON has it: numbers of six digits, an infinite one as text, and nothing for what is no number."""
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


def name_of(benchmark: str, parser: argparse.ArgumentParser, options: argparse.Namespace, ignore: Sequence[str]) -> str:
    """The benchmark, its positional arguments, and the options that are not as by default.

    Of a path only the name counts, and options in ``ignore`` do not.
    """
    parts = [benchmark]
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
    """Write the figures of a run when it ends well, in place of those of the same command.

    Args:
        benchmark: Its module below ``benchmarks``.
        parser: Knows what is positional and what is as by default.
        options: What was asked for.
        ignore: Options that change no figure, such as where pictures go.
        gpu: Whether it runs on one.
        command: Words that start it, if they are not ``python -m benchmarks.`` and the module.
        folder: Where to.
    """
    figures: dict[str, list[Any]] = {}
    at, load, cpu = revision(), os.getloadavg()[0], cpu_seconds()
    start = time.monotonic()
    _open.append(figures)
    try:
        yield
    finally:
        _open.pop()
    words = command or ("python", "-m", f"benchmarks.{benchmark}")
    write_result(
        name_of(benchmark, parser, options, ignore),
        {
            "command": shlex.join([*words, *sys.argv[1:]]),
            "recorded": "run",
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            **at,
            "machine": machine(gpu),
            "load": {"start": round(load, 1), "end": round(os.getloadavg()[0], 1)},
            "seconds": round(time.monotonic() - start, 1),
            "cpu_seconds": round(cpu_seconds() - cpu, 1),
        },
        figures,
        folder,
    )


def write_result(name: str, about: Mapping[str, Any], figures: Mapping[str, Sequence[Any]], folder: Path) -> None:
    """Write one file, a figure a line; where that is not possible say so, for the figures were printed."""
    lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(row, ensure_ascii=False)}" for key, row in figures.items())
    head = json.dumps(about, indent=1, ensure_ascii=False).removesuffix("\n}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(f'{head},\n "figures": {{\n{lines}\n }}\n}}\n', encoding="utf-8")
    except OSError as error:
        print(f"the result was not kept: {error}", file=sys.stderr)


def revision(folder: Path = ROOT) -> dict[str, Any]:
    """The commit, how many led to it, and whether files that decide figures differ; unknown outside of a checkout."""
    try:
        commit = _said("git", "-C", str(folder), "rev-parse", "--short=9", "HEAD")
        number = int(_said("git", "-C", str(folder), "rev-list", "--count", "HEAD"))
        changed = bool(_said("git", "-C", str(folder), "status", "--porcelain", "--", *MEASURED))
    except (OSError, subprocess.CalledProcessError):
        return {"revision": "unknown", "commits": None, "changed": None}
    return {"revision": commit, "commits": number, "changed": changed}


def machine(gpu: bool) -> dict[str, Any]:
    """Processor, those of its cores that this process may run on, memory [GiB], and the GPU where one is used."""
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
        names = _said(program, "--query-gpu=name", "--format=csv,noheader") if program else ""
    except (OSError, subprocess.CalledProcessError):
        names = ""
    return names.partition("\n")[0] or "unknown"


def _said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def cpu_seconds() -> float:
    """Of this process and of its children that have ended [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
