"""Writes the documentation's figures from recorded benchmark results, so that none is typed by hand.

    python -m benchmarks.figures            # writes docs/figures.md and docs/reliability.md
    python -m benchmarks.figures --check    # prints differences from the results, with status 1
    python -m benchmarks.figures --age      # prints the number of commits since each result

Pages are made from templates in ``benchmarks/templates``, where ``{{ ... }}`` stands for

* ``RESULT FIGURE FORMAT``: one figure in a Python format; ``*1000:.1f`` multiplies it first;
* ``cells RESULT FIGURE KEY:FORMAT ...``: table cells of the figures ``FIGURE.KEY``;
* ``caption RESULT ...``: command, machine, load and revision of results;
* ``revision RESULT``: the revision and its date;
* ``runs RESULT ...``: the same as a table; ``runs`` alone, of all results;
* ``detectors PLAN ARM ...``: a table of results of arms of ``benchmarks.detector``; ``detectors PLAN``, of all;
* ``detector PLAN ARM``: the mean precision of an arm; ``detector_interval PLAN ARM``: its 95 % interval;
* ``gain PLAN ARM BASELINE``: table cells of its gain over another arm, and the 95 % interval.

Missing figures are errors. ``sentences.md`` lists sentences of hand-written pages; each must occur in its page.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.detector.table import experiment_table, gain_cells, mean_precision, precision_interval
from benchmarks.record import MEASURED, RESULTS, ROOT, read_recorded
from benchmarks.scale.projection import project

TEMPLATES = ROOT / "benchmarks" / "templates"
PAGES = {"figures.md": "docs/figures.md", "reliability.md": "docs/reliability.md"}
SENTENCES = "sentences.md"
VIEWS, BYTES = 8, 2.5e5
"""Frames per layout and bytes per frame in the projection: those of the default scene."""

RENAMED_OPTIONS = {
    "mitsplat fit": {"--edge": "--max-size"},
    "python -m benchmarks.render.chart": {"--at": "--order-tolerance"},
}
"""Options that were renamed after a command was recorded, by the beginning of the command: old and present name."""

Results = Mapping[str, Mapping[str, Any]]


class FigureError(Exception):
    """A template names a figure that no result has."""


def read_results(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Read all results by name, and add the projection computed from them."""
    results = read_recorded(folder)
    results["projection"] = {"figures": projected(results)}
    return results


def projected(results: Results) -> dict[str, list[Any]]:
    """Compute the cost of a million images from the recorded times of a frame, its files and a layout."""
    frame = value_of(results, "render.frame", "whole_frame")
    rendering = max(frame) if isinstance(frame, list) else frame
    writing = value_of(results, "labels.cost", "yolo_coco.write")
    settle = value_of(results, "physics.settle-share", "mujoco.cpu")
    found = project(rendering + writing, BYTES, settle, VIEWS)
    figures: dict[str, list[Any]] = {
        "rendering": [rendering, "s"],
        "writing": [writing, "s"],
        "settle": [settle, "s"],
        "views": [VIEWS, ""],
        "megabytes": [BYTES / 1e6, "MB"],
        "each": [found.each, "s"],
        "limit": [found.limit, "1/s"],
        "most": [found.most, ""],
    }
    for row in found.rows:
        name = f"workers_{row.workers}"
        speed = f"{row.speed:.2f}" + (" (saturated)" if row.saturated else "")
        figures |= {f"{name}.speed": [speed, "1/s"], f"{name}.days": [row.days, ""], f"{name}.hours": [row.hours, ""]}
        figures[f"{name}.terabytes"] = [row.terabytes, "TB"]
    return figures


def value_of(results: Results, result: str, name: str) -> Any:
    """Return a figure without its unit."""
    if result not in results:
        raise FigureError(f"no result {result}")
    figures = results[result]["figures"]
    if name not in figures:
        raise FigureError(f"{result} has no figure {name}; it has {', '.join(figures)}")
    return figures[name][0]


def formatted(value: Any, spec: str) -> str:
    """Format a number, a (minimum, maximum) pair, or text; unknown values become a dash."""
    factor, _, form = spec.rpartition(":")
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        ends = list(dict.fromkeys(formatted(one, spec) for one in value))
        return " to ".join(ends)
    try:
        number = value * float(factor.removeprefix("*")) if factor else value
        return format(number, form).replace("%", " %").replace("-", "−")
    except ValueError as error:
        raise FigureError(f"{value} cannot be written as {spec}: {error}") from error


def present_command(result: Mapping[str, Any]) -> str:
    """Return the command of a result, with the present names of its options."""
    command = str(result["command"])
    for beginning, names in RENAMED_OPTIONS.items():
        if command.startswith(f"{beginning} "):
            command = " ".join(names.get(word, word) for word in command.split(" "))
    return command


def caption(result: Mapping[str, Any]) -> str:
    """Return the source of figures: command, machine, load and revision."""
    load, day = load_of(result), revision_of(result)
    text = f"`{present_command(result)}` on {machine_of(result)}" + (f", {load}" if load else "")
    if result["recorded"] == "transcribed":
        text += f"; taken over from the notes of revision {day}, not recorded anew since"
    else:
        text += f"; recorded at revision {day}{' with changes' if result.get('dirty') else ''}"
        text += f"; the run took {result['seconds']:.0f} s"
    return text + (f". {result['note']}" if result.get("note") else ".")


def revision_of(result: Mapping[str, Any]) -> str:
    """Return the revision and its date."""
    return f"{result['revision']} of {result['date']}"


def machine_of(result: Mapping[str, Any]) -> str:
    """Return processor, memory and GPU, where known."""
    machine = result["machine"]
    known = f"{machine['cores']} cores" if machine["cores"] else ""
    known += (" of " if known else "") + machine["processor"] if machine["processor"] else ""
    known += f" with {machine['memory_gib']} GiB" if machine["memory_gib"] else ""
    return " and ".join(part for part in (known, machine["gpu"]) if part)


def load_of(result: Mapping[str, Any]) -> str:
    """Return the load average at start and end, or the load given in notes."""
    load = result["load"]
    return f"load {load['start']} to {load['end']}" if load["start"] is not None else load.get("said") or ""


def runs(results: Iterable[Mapping[str, Any]]) -> str:
    """Return a table of results."""
    lines = ["| command | machine | load | revision | recorded |", "| --- | --- | --- | --- | --- |"]
    for result in results:
        if result["recorded"] == "transcribed":
            how = "taken over from notes"
        else:
            how = f"in {result['seconds']:.0f} s" + (", with changes" if result.get("dirty") else "")
        how += f". {result['note']}" if result.get("note") else ""
        load, day = load_of(result).removeprefix("load "), f"{result['revision']}, {result['date']}"
        lines.append(f"| `{present_command(result)}` | {machine_of(result)} | {load} | {day} | {how} |")
    return "\n".join(lines)


def filled(text: str, results: Results) -> str:
    """Fill a template with its figures."""

    def fill(match: re.Match[str]) -> str:
        words = match[1].split()
        try:
            match words:
                case ["runs"]:
                    return runs(result for result in results.values() if "command" in result)
                case ["detectors", *plan_and_arms]:
                    return experiment_table(results, *plan_and_arms)
                case ["detector", plan, arm, *figure] if len(figure) < 2:
                    return f"{mean_precision(results, plan, arm, *figure):.3f}"
                case ["detector_interval", plan, arm]:
                    return precision_interval(results, plan, arm)
                case ["gain", plan, arm, baseline]:
                    return gain_cells(results, plan, arm, baseline)
                case ["caption" | "runs" as what, *names] if names:
                    if missing := [name for name in names if "command" not in results.get(name, {})]:
                        raise FigureError(f"no result {missing[0]}")
                    if what == "runs":
                        return runs(results[name] for name in names)
                    return "  \n".join(f"*{caption(results[name])}*" for name in names)
                case ["revision", result]:
                    return revision_of(results[result])
                case ["cells", result, prefix, *cells] if cells:
                    pairs = [cell.partition(":") for cell in cells]
                    return " | ".join(
                        formatted(value_of(results, result, f"{prefix}.{key}"), spec) for key, _, spec in pairs
                    )
                case [result, name, spec]:
                    return formatted(value_of(results, result, name), spec)
                case [result, name]:
                    return formatted(value_of(results, result, name), "")
        except (FigureError, KeyError) as error:
            raise FigureError(f"{{{{ {match[1].strip()} }}}}: {error}") from None
        raise FigureError(f"{{{{ {match[1].strip()} }}}} is no figure")

    return re.sub(r"\{\{(.*?)\}\}", fill, text)


def wrapped(text: str, width: int = 120) -> str:
    """Wrap paragraphs of plain text to a width; list markers stay at the end of a line, not at the start."""
    blocks = text.split("\n\n")
    for place, block in enumerate(blocks):
        if block[:1].isalnum() or (block.startswith(("`", "[", "(")) and not block.startswith("```")):
            lines = textwrap.fill(" ".join(block.split()), width, break_long_words=False, break_on_hyphens=False)
            end = "\n" * (len(block) - len(block.rstrip("\n")))
            blocks[place] = re.sub(r"\n([-+*#>=]|\d+[.)]) ", r" \1\n", lines) + end
    return "\n\n".join(blocks)


def pages(results: Results) -> dict[Path, str]:
    """Return the expected text of every generated page."""
    found = {}
    for name, page in PAGES.items():
        text = wrapped(filled((TEMPLATES / name).read_text(encoding="utf-8"), results))
        found[ROOT / page] = (
            f"{text}\n<!-- Written by python -m benchmarks.figures: edit benchmarks/templates/{name} -->\n"
        )
    return found


def unsaid(results: Results) -> Iterable[str]:
    """Return the sentences that hand-written pages lack, or have with other figures; absent pages are ignored."""
    file = ""
    for line in filled((TEMPLATES / SENTENCES).read_text(encoding="utf-8"), results).splitlines():
        if line.startswith("# "):
            file = line[2:].strip()
        elif line.startswith("* "):
            path = ROOT / file
            words = path.read_text(encoding="utf-8").split() if path.exists() else line.split()
            if " ".join(line[2:].split()) not in " ".join(words):
                yield f"{file} should say: {line[2:]}"


def differences(results: Results) -> list[str]:
    """Return the differences between the documentation and the results."""
    found = [
        f"{path.relative_to(ROOT)} is not what the results give; run python -m benchmarks.figures"
        for path, text in pages(results).items()
        if not path.exists() or path.read_text(encoding="utf-8") != text
    ]
    return [*found, *unsaid(results)]


def print_ages(results: Results) -> None:
    """Print, for each result, the number of later commits that affect figures."""
    for name, result in results.items():
        if "command" in result:
            command = ["git", "-C", str(ROOT), "rev-list", "--count", f"{result['revision']}..HEAD", "--", *MEASURED]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            count = run.stdout.strip() if run.returncode == 0 else "unknown"
            print(f"{count:>8s} commits since {result['revision']} ({result['recorded']}): {name}")


def main() -> None:
    """Write or check the pages, or print ages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--age", action="store_true")
    options = parser.parse_args()
    try:
        results = read_results()
        if options.age:
            print_ages(results)
            return
        if not options.check:
            for path, text in pages(results).items():
                path.write_text(text, encoding="utf-8")
                print(f"written: {path.relative_to(ROOT)}")
        found = differences(results)
    except FigureError as error:
        sys.exit(str(error))
    for text in found:
        print(text, file=sys.stderr)
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
