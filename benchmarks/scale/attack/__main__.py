"""Attack mitsplat with hostile files and machines, and print the verdict on each attack.

    python -m benchmarks.scale.attack [--list] [--only PATTERN] [--quick] [--jobs N] [--slowdown FACTOR]

An attack is repelled if its commands end with a status and an error sentence, within bounds of time and memory, and
neither change nor disclose anything outside of their folder. The exit status is 1 if an attack was not repelled. The
commands are those of ``mitsplat`` in the environment of this Python. Linux is required.
"""

from __future__ import annotations

import argparse
import fnmatch
import importlib
import pkgutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import benchmarks.scale.attack as package
from benchmarks.record import figure, recording
from benchmarks.scale.attack.attack import SECRET_COLOUR, SECRET_WORD, Attack, Verdict, judge
from benchmarks.scale.attack.samples import Place, Samples

_OWN = ("__main__", "attack", "samples")


def all_attacks() -> list[Attack]:
    """Return the attacks of every module, in the order of the modules' names."""
    names = sorted(module.name for module in pkgutil.iter_modules(package.__path__) if module.name not in _OWN)
    modules = [importlib.import_module(f"{package.__name__}.{name}") for name in names]
    return [attack for module in modules for attack in module.ATTACKS]


def verdicts(attacks: Sequence[Attack], jobs: int, slowdown: float) -> Iterator[tuple[Attack, Verdict]]:
    """Yield attacks and their verdicts, each run in a folder of its own, which is removed."""
    with tempfile.TemporaryDirectory(prefix="mitsplat-attack-") as folder, ThreadPoolExecutor(jobs) as pool:
        valid = Samples(Path(folder) / "samples")
        if not all(attack.quick for attack in attacks):
            valid.render_dataset()

        def held(attack: Attack) -> Verdict:
            with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as own:
                slower = replace(attack, seconds=slowdown * attack.seconds)
                return judge(slower, Place.make(Path(own), valid, SECRET_COLOUR, SECRET_WORD))

        yield from zip(attacks, pool.map(held, attacks), strict=True)


def main() -> None:
    """Select the attacks, run them and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="PATTERN", help="attacks whose name contains or matches it, such as 'xml*'")
    parser.add_argument("--quick", action="store_true", help="only attacks that render nothing")
    parser.add_argument("--list", action="store_true", help="print the attacks and run none")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel attacks")
    parser.add_argument("--slowdown", type=float, default=1.0, help="factor of all time limits, on a busy machine")
    options = parser.parse_args()
    wanted = [
        attack
        for attack in all_attacks()
        if (attack.quick or not options.quick)
        and (not options.only or options.only in attack.name or fnmatch.fnmatch(attack.name, options.only))
    ]
    if not wanted:
        parser.error(f"no attack is named like {options.only}")
    if options.list:
        for attack in wanted:
            print(f"{attack.name}: tries to {attack.tries}")
        return
    # A selection by name is not recorded.
    with (
        nullcontext()
        if options.only
        else recording("scale.attack", parser, options, ignore=("list", "jobs", "slowdown"))
    ):
        failed = measure(wanted, options.jobs, options.slowdown)
    sys.exit(1 if failed else 0)


def measure(wanted: Sequence[Attack], jobs: int, slowdown: float) -> int:
    """Run attacks, print a line for each, and record the counts; return the number of attacks not repelled."""
    begun = time.monotonic()
    absent = [attack for attack in wanted if attack.missing]
    done: list[tuple[Attack, Verdict]] = []
    print(f"{'attack':<64} {'verdict':<8} {'s':>6} {'MiB':>6}")
    for attack, verdict in verdicts([attack for attack in wanted if not attack.missing], jobs, slowdown):
        done.append((attack, verdict))
        word = "FAILED" if verdict.faults else "held"
        print(f"{attack.name:<64} {word:<8} {verdict.seconds:>6.1f} {verdict.mebibytes:>6.0f}", flush=True)
        for fault in verdict.faults:
            print(f"    {fault}", flush=True)
    for attack in absent:
        print(f"{attack.name:<64} not run: {attack.missing}")
    failed = sum(bool(verdict.faults) for _, verdict in done)
    figure(len(done), "", "attacks")
    figure(failed, "", "failed")
    figure(len(absent), "", "not run")
    kinds = sorted({attack.name.partition(":")[0] for attack, _ in done})
    figure(len(kinds), "", "kinds")
    for kind in kinds:
        figure(sum(attack.name.partition(":")[0] == kind for attack, _ in done), "", "of kind", kind)
    figure(max((verdict.seconds for _, verdict in done), default=0), "s", "longest")
    figure(max((verdict.mebibytes for _, verdict in done), default=0), "MiB", "largest")
    minutes = (time.monotonic() - begun) / 60
    print(f"attacks: {len(done)}; failed: {failed}; not run: {len(absent)}; minutes: {minutes:.1f}")
    return failed


if __name__ == "__main__":
    main()
