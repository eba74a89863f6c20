"""Import of splat files from other programs: import, check, render and audit, each in a new process.

    python -m benchmarks.assets.imports ../shared/data/splats [--only hammer_100k] [--jobs 4] [--keep FOLDER]

FOLDER holds the `.splat` files named in FILES. Each import must have the requested size, stay upright in physics, and
be labelled in all images. The commands are those of the documentation.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.record import figure, recording
from mitsplat.asset import Asset

FILES: dict[str, tuple[float, list[str]]] = {
    "plant": (0.30, ["--flat-base", "--mass", "0.6"]),
    "academic_tarot_cards": (0.13, ["--without-table"]),
    "hammer_100k": (0.25, ["--mass", "0.7"]),
    "wingnut_100k": (0.06, []),
    "boot_100k": (0.24, ["--mass", "0.5"]),
    "teapot_100k": (0.20, ["--mass", "0.8"]),
    "torus_10k": (0.09, []),
    "spot_10k": (0.14, []),
    "cube_10k": (0.05, []),
}
"""Longest extent [m] and further options of each."""

UPRIGHT = 12.0
"""Largest angle of an object's own vertical to the world's [degrees]."""


def run(*words: object, folder: Path) -> tuple[int, str, float]:
    """Run the command mitsplat; return its exit status, output and CPU seconds."""
    command = [str(Path(sys.executable).with_name("mitsplat")), *map(str, words)]
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        return process.returncode, output.read(), used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=FILES, help="only this file")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel imports")
    parser.add_argument("--keep", type=Path, help="folder for assets, scenes and datasets")
    arguments = parser.parse_args()
    ignore = ("folder", "keep", "jobs")
    with recording("assets.imports", parser, arguments, ignore=ignore), tempfile.TemporaryDirectory() as made:
        work = arguments.keep or Path(made)
        work.mkdir(parents=True, exist_ok=True)
        names = [arguments.only] if arguments.only else list(FILES)
        with ThreadPoolExecutor(arguments.jobs) as pool:
            faults = pool.map(lambda name: one(name, (arguments.folder / f"{name}.splat").resolve(), work), names)
            if wrong := [fault for fault in faults if fault]:
                sys.exit("\n".join(wrong))


def one(name: str, file: Path, work: Path) -> str:
    """Import, check, render and audit one file and print the result; return the error, or an empty text."""
    size, options = FILES[name]
    scene, out = f"{name}.yaml", f"out/{name}"
    (work / scene).unlink(missing_ok=True)
    shutil.rmtree(work / out, ignore_errors=True)
    status, output, seconds = run(
        "import", file, "-o", f"assets/{name}", "--size", size, "--scene", scene, *options, folder=work
    )
    if status:
        return f"{name}: import ended with status {status}: {output}"
    warnings = output.count("warning: ")
    checked, findings, _ = run("check", scene, folder=work)
    rendered, told, rendering = run("render", scene, "-n", 2, "--size", "640x360", "-o", out, folder=work)
    if rendered:
        return f"{name}: render ended with status {rendered}: {told}"
    audited, violations, _ = run("audit", out, folder=work)
    asset = Asset.load(work / "assets" / name)
    if asset.mesh is None:
        return f"{name}: has no mesh"
    poses = [
        np.array(instance["world_from_object"])
        for path in sorted((work / out / "layouts").glob("*.json"))
        for instance in json.loads(path.read_text())["instances"]
    ]
    tilt = max(float(np.degrees(np.arccos(np.clip(pose[2, 2], -1, 1)))) for pose in poses)
    records = [json.loads(line) for line in (work / out / "manifest.jsonl").read_text().splitlines()]
    labelled = sum(bool(record["labels"]["instances"]) for record in records) / len(records)
    extent = float(asset.mesh.extents.max())
    print(
        f"{name}: {seconds:.0f} CPU s, {len(asset.splats)} Gaussians, {extent:.4f} m, {len(asset.pieces)} pieces, "
        f"{warnings} warnings, check {checked}, tilt {tilt:.1f} degrees, labelled {labelled:.0%}, audit {audited}",
        flush=True,
    )
    for text in (output, findings, violations):
        for line in text.splitlines():
            if line.startswith(("warning: ", "look", "up: ")):
                print(f"    {line}", flush=True)
    for value, unit, key in (
        (seconds, "s", "import cpu"),
        (rendering, "s", "render cpu"),
        (extent, "m", "extent"),
        (len(asset.splats), "", "gaussians"),
        (len(asset.pieces), "", "pieces"),
        (warnings, "", "warnings"),
        (findings.count("look  "), "", "findings"),
        (tilt, "degrees", "tilt"),
        (labelled, "", "labelled"),
        (audited, "", "audit status"),
    ):
        figure(value, unit, name, key)
    if abs(extent - size) > 1e-3 * size or tilt > UPRIGHT or labelled < 1 or audited:
        return f"{name}: is not of its size, not upright, not labelled everywhere, or wrong in its labels"
    return ""


if __name__ == "__main__":
    main()
