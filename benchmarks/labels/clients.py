"""Datasets read by the programs that use them, and compared with the manifest: numbers of objects, boxes and masks.

    python -m benchmarks.labels.clients [--dataset DATASET] [--environments /tmp/mitsplat-clients]

Each client is installed by pip into its own environment below ``--environments``, if it is not there. The BOP toolkit
is no package: its checkout is given by ``--bop-toolkit``. Clients that cannot be installed or imported are recorded as
not tried, with the reason. Without ``--dataset``, a small one is rendered. Clients fill polygons in their own ways, so
their IoU is recorded; all other masks must be equal.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import ROOT, figure, recording
from mitsplat.dataset.write import write_dataset
from mitsplat.images.masks import decode_rle
from mitsplat.scene.loading.scene_loading import load_scene

FORMATS = ["yolo", "yolo-detect", "coco", "coco-polygons", "bop"]
CLIENTS: dict[str, tuple[list[str], list[str]]] = {
    "pycocotools": (["pycocotools"], ["coco", "coco-polygons"]),
    "supervision": (["supervision", "pycocotools", "opencv-python-headless"], ["coco", "coco-polygons", "yolo"]),
    "ultralytics": (["torch==2.13.0", "ultralytics-opencv-headless~=8.4.190"], ["yolo", "yolo-detect"]),
    "datumaro": (["datumaro"], ["coco", "yolo-detect"]),
    "fiftyone": (["fiftyone", "pycocotools"], ["coco", "coco-polygons"]),
    "label_studio": (["label-studio-sdk"], ["yolo-detect"]),
    "bop_toolkit": (
        ["numpy", "scipy", "imageio", "pypng", "pytz", "tqdm", "opencv-python-headless", "pycocotools"],
        ["bop"],
    ),
    "torchvision": (["torch==2.13.0", "torchvision", "pycocotools"], ["coco", "coco-polygons"]),
}
"""Packages of each client, and the formats that it reads."""

_BOX_TOLERANCE = 0.05
"""Maximum difference of equal boxes [px]; the outline of YOLO ends 0.02 px before the edge of its box."""


def environment(folder: Path, client: str) -> Path:
    """Return the Python program of a client's environment, which is created if it is missing.

    Raises:
        RuntimeError: If pip fails.
    """
    python = folder / client / "bin/python"
    if not (folder / client / "complete").is_file():
        subprocess.run([sys.executable, "-m", "venv", str(folder / client)], check=True)
        command = [str(python), "-m", "pip", "install", "--quiet", *CLIENTS[client][0]]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        (folder / client / "complete").touch()
    return python


def read_by(python: Path, client: str, form: str, root: Path, toolkit: Path | None) -> dict[str, Any]:
    """Return what a client finds in a dataset, by image.

    Raises:
        RuntimeError: If it fails.
    """
    paths = {"PYTHONPATH": str(toolkit)} if toolkit is not None and client == "bop_toolkit" else {}
    with tempfile.TemporaryDirectory() as folder:
        out, script = Path(folder) / "found.json", ROOT / "benchmarks/labels/client_readers.py"
        done = subprocess.run(
            [str(python), str(script), client, form, str(root), str(out)],
            capture_output=True,
            text=True,
            env={**os.environ, **paths},
        )
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        found: dict[str, Any] = json.loads(out.read_text())
    return found


def expected_objects(root: Path) -> dict[str, list[tuple[str, list[int], np.ndarray]]]:
    """Return class, box and mask of the objects of each image in the manifest."""
    found = {}
    for line in (root / "manifest.jsonl").read_text().splitlines():
        record = json.loads(line)
        size = record["labels"]["size"][::-1]
        found[f"{record['index']:06d}"] = [
            (one["class"], one["box"], decode_rle({"size": size, "counts": one["rle"]}).astype(bool))
            for one in record["labels"]["instances"]
        ]
    return found


def compare(found: dict[str, Any], expected: dict[str, list[tuple[str, list[int], np.ndarray]]]) -> dict[str, Any]:
    """Count equal objects, boxes and masks, and return the smallest IoU of a mask."""
    counts: dict[str, Any] = {"objects": 0, "boxes": 0, "masks": 0, "with_mask": 0, "worst_iou": 1.0}
    for image, objects in expected.items():
        others = found.get(image, [])
        if [name for name, *_ in others] != [name for name, *_ in objects]:
            continue
        for (_, box, mask), (_, other, runs) in zip(objects, others, strict=True):
            counts["objects"] += 1
            counts["boxes"] += bool(np.abs(np.subtract(box, other)).max() <= _BOX_TOLERANCE)
            if runs is None:
                continue
            changes = np.zeros(mask.size, dtype=np.int64)
            changes[runs] = 1
            seen = (np.cumsum(changes) % 2).astype(bool).reshape(mask.shape)
            counts["with_mask"] += 1
            counts["masks"] += bool((seen == mask).all())
            iou = np.count_nonzero(seen & mask) / np.count_nonzero(seen | mask)
            counts["worst_iou"] = min(counts["worst_iou"], float(iou))
    return counts


def check(client: str, python: Path, root: Path, toolkit: Path | None) -> list[str]:
    """Compare all formats of a client, and return the formats that differ from the manifest."""
    expected = expected_objects(root)
    total, wrong = sum(map(len, expected.values())), []
    for form in CLIENTS[client][1]:
        counts = compare(read_by(python, client, form, root, toolkit), expected)
        masks = f"{counts['masks']} of {counts['with_mask']} masks equal, IoU >= {counts['worst_iou']:.4f}"
        print(
            f"{client:14} {form:14} {counts['objects']} of {total} objects, {counts['boxes']} boxes equal"
            + (f", {masks}" if counts["with_mask"] else "")
        )
        for name, value in counts.items():
            figure(value, "", client, form, name)
        exact = form in ("yolo", "coco-polygons") or counts["masks"] == counts["with_mask"]
        if counts["objects"] != total or counts["boxes"] != total or not exact:
            wrong.append(f"{client} {form}")
    return wrong


def main() -> None:
    """Print and record the comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help=f"dataset with the formats {', '.join(FORMATS)}")
    parser.add_argument("--environments", type=Path, default=Path("/tmp/mitsplat-clients"))
    parser.add_argument("--bop-toolkit", type=Path, help="checkout of the BOP toolkit")
    parser.add_argument("--clients", nargs="+", choices=CLIENTS, default=list(CLIENTS))
    options = parser.parse_args()
    ignore = "dataset", "environments", "bop_toolkit"
    with recording("labels.clients", parser, options, ignore=ignore), tempfile.TemporaryDirectory() as folder:
        root, wrong = options.dataset or Path(folder) / "dataset", []
        if options.dataset is None:
            size = {
                "output.width": 320,
                "output.height": 180,
                "output.formats": FORMATS,
                "output.validation": 0.5,
                "quality": "fast",
            }
            scene = load_scene(
                ROOT / "scenes/workcell.yaml", overrides={**size, "output.layouts": 2, "output.views": 2}
            )
            write_dataset(scene, root)
        figure(sum(map(len, expected_objects(root).values())), "", "objects")
        for client in options.clients:
            try:
                if client == "bop_toolkit" and options.bop_toolkit is None:
                    raise RuntimeError("it is no package, and --bop-toolkit gives no checkout")
                wrong += check(client, environment(options.environments, client), root, options.bop_toolkit)
            except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
                print(f"{client:14} not tried: {error}")
                figure(f"not tried: {error}", "", client)
        if wrong:
            sys.exit(f"these differ from the manifest: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
