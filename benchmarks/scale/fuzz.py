"""Damage valid files at random and read them: every reader must return, or fail with one sentence that names the file.

    python -m benchmarks.scale.fuzz [--minutes 10] [--seed 0] [--only NAME ...]

Each input is read in a child process with bounded memory and time, which detects crashes, hangs and excessive memory.
``tests/test_fuzz.py`` does the same for a few inputs of each reader.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import gaussforge
import numpy as np
import trimesh
from PIL import Image

from benchmarks.record import figure, recording
from mitsplat.asset import Asset
from mitsplat.capture.known_poses import read_poses
from mitsplat.capture.photo_masks import given_masks
from mitsplat.capture.photos import Prepared
from mitsplat.capture.video import choose_frames
from mitsplat.detector.detector_evaluation import coco_truth
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.training import write_data
from mitsplat.errors import InputError
from mitsplat.frames.untrusted_xml import check_xml
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.mesh_files.mesh_reading import read_mesh
from mitsplat.scene.loading.scene_loading import load_scene

MEMORY = 12 << 30
"""Address space of a child [bytes]; libraries reserve some of it without using it."""
SECONDS = 90
"""Time limit of one input [s]; the decoders of other formats have 60 s."""

_WORDS = (
    b"nan",
    b"inf",
    b"-1",
    b"0",
    b"1e999",
    b"4294967295",
    b"99999999999",
    b"*a",
    b"&a",
    b"!!python/object",
    b"../..",
)
_NUMBERS = (0, 1, -1, 0x7F, 0x7FFFFFFF, -0x80000000, 1 << 20, 1 << 28)


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        file: The file to damage, below the folder of samples.
        read: Reads it, given its folder.
        slow: True if it starts a process.
    """

    file: str
    read: Callable[[Path], object]
    slow: bool = False


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a damaged copy with changed bits, bytes, integers, digits, blocks or end."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        place = rng.randrange(len(found) + 1)
        # Headers determine most of the behaviour, and are short.
        if rng.random() < 0.5:
            place = min(place, rng.randrange(400))
        match rng.randrange(8):
            case 0 if place < len(found):
                found[place] ^= 1 << rng.randrange(8)
            case 1 if place < len(found):
                found[place] = rng.randrange(256)
            case 2 if place + 4 <= len(found):
                struct.pack_into(rng.choice("<>") + "i", found, place, rng.choice(_NUMBERS))
            case 3:
                found[place:place] = rng.choice(_WORDS)
            case 4:
                del found[place : place + rng.choice((1, 4, 50, 1000))]
            case 5:
                start = rng.randrange(len(found) + 1)
                found[place:place] = found[start : start + rng.choice((1, 8, 100))]
            case 6:
                digits = [i for i in range(place, min(place + 60, len(found))) if chr(found[i]).isdigit()]
                if digits:
                    found[digits[0] : digits[0] + 1] = rng.choice(_WORDS)
            case 7 if rng.random() < 0.3:
                del found[place:]
    return bytes(found)


def attempt(reader: Reader, folder: Path) -> str:
    """Read a damaged file; return "read", "refused", or the reader's fault."""
    try:
        reader.read(folder)
    except InputError as error:
        text = str(error)
        if "\n" in text.strip() or not text.strip() or str(folder) not in text:
            return f"its sentence does not name the file: {text!r}"
        return "refused"
    except Exception as error:  # noqa: BLE001 - that is what is looked for
        return f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
    return "read"


def make_samples(folder: Path) -> None:
    """Create valid files of every kind."""
    rng = np.random.default_rng(0)
    count = 40
    splats = Splats(
        means=rng.normal(0, 0.1, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.01, 0.05, (count, 3)),
        opacities=rng.uniform(0.6, 1, count),
        sh=rng.normal(0, 0.3, (count, 4, 3)),
    )
    box = trimesh.creation.box((0.02, 0.03, 0.01))
    coloured = replace(splats, sh=splats.sh[:, :1], materials=SplatMaterials.uniform(count))
    asset = Asset("nut", "nut", coloured, box, (box,))
    asset.save(folder / "nut")
    for suffix in ("splat", "spz"):
        splats.save(folder / f"a.{suffix}")
    ply = (folder / "nut/splats.ply").read_bytes()
    (folder / "a.ply").write_bytes(ply)
    for name in ("compressed.ply", "ksplat", "sog"):
        data = gaussforge.GaussForge().convert(ply, "ply", name).get("data")
        if data:
            (folder / f"a.{name}").write_bytes(data)
    for suffix in ("ply", "stl", "obj", "glb", "off"):
        box.export(folder / f"mesh.{suffix}")
    shutil.copy(Path(__file__).parents[2] / "scenes/workcell.yaml", folder / "workcell.yaml")
    (folder / "scene.yaml").write_text(
        "name: small\nobjects:\n  - {asset: nut, count: [1, 2]}\n"
        "region: {min: [-0.2, -0.2, 0.02], max: [0.2, 0.2, 0.2]}\n"
        "shapes:\n  - {name: table, box: {size: [1, 1, 0.1], position: [0, 0, -0.05]}, visible: true}\n"
        "camera: {kind: orbit, target: [0, 0, 0], radius: 0.5, height: 0.4}\n"
        "lights:\n  - {kind: area, position: [0.5, 0, 1]}\noutput: {width: 64, height: 48}\nseed: 7\n"
    )
    (folder / "scene.xml").write_text(
        '<scene version="3.9.0"><default name="spp" value="4"/><integrator type="path"/><sensor type="perspective">'
        '<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler></sensor>'
        '<shape type="ply"><string name="filename" value="mesh.ply"/></shape></scene>\n'
    )
    (folder / "photos").mkdir()
    (folder / "masks").mkdir()
    Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / "photos/a.png")
    Image.fromarray(np.uint8(255 * (np.arange(24 * 32).reshape(24, 32) % 32 > 9))).save(folder / "masks/a.png.png")
    rows = np.eye(4).tolist()
    frames = [{"file_path": f"photos/{name}.png", "transform_matrix": rows} for name in "ab"]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 40.0, "w": 32, "h": 24, "frames": frames}))
    (folder / "model").mkdir()
    (folder / "model/cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
    (folder / "model/images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n5 6 1\n2 1 0 0 0 0.1 0 1 1 b.png\n5 6 1\n")
    (folder / "model/points3D.txt").write_text("1 0 0 1 9 9 9 0.1 1 0 2 0\n")
    _labelled(folder, rng)
    noise = cv2.resize(rng.integers(0, 255, (24, 80, 3), dtype=np.uint8), None, fx=4, fy=4)
    writer = cv2.VideoWriter(str(folder / "walk.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (128, 96))
    for left in range(0, 120, 4):
        writer.write(noise[:, left : left + 128])
    writer.release()


def _labelled(folder: Path, rng: np.random.Generator) -> None:
    """Create a YOLO and a COCO folder."""
    for name in ("yolo/images", "yolo/labels", "coco"):
        (folder / name).mkdir(parents=True)
    for name in ("yolo/images/a.png", "coco/a.png"):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / name)
    (folder / "yolo/data.yaml").write_text("train: images\nval: images\nnames:\n  0: nut\n  1: bolt\n")
    (folder / "yolo/labels/a.txt").write_text("0 0.1 0.2 0.5 0.2 0.4 0.6\n1 0.5 0.5 0.9 0.5 0.7 0.9\n")
    runs = {"size": [24, 32], "counts": [100, 5, 19, 5, 639]}
    packed = {"size": [24, 32], "counts": "T35c00\\c0"}
    given = [([4, 4, 8, 8], [[4, 4, 12, 4, 8, 12]]), ([4, 4, 2, 5], runs), ([4, 4, 2, 5], packed)]
    annotations = [
        {"id": i, "image_id": 5, "category_id": 2, "bbox": box, "iscrowd": 0, "segmentation": segmentation}
        for i, (box, segmentation) in enumerate(given)
    ]
    images = [{"id": 5, "file_name": "a.png", "width": 32, "height": 24}]
    content = {"images": images, "annotations": annotations, "categories": [{"id": 2, "name": "nut"}]}
    (folder / "coco/labels.json").write_text(json.dumps(content))


def _read_labelled(folder: Path) -> None:
    """Read a labelled set and all values derived from it."""
    coco_truth(read_set(folder, "train"), masks=True)
    write_data([read_set(folder, "train")], folder.parent / "data")


def _transforms(folder: Path) -> None:
    from mitsplat.capture.nerf_transforms import parse_transforms, read_transforms

    path = folder / "transforms.json"
    content = parse_transforms(path)
    read_transforms(path, content, {frame.file_path: (32, 24) for frame in content.frames})


def _colmap(folder: Path) -> None:
    photos = [Prepared(f"{name}.png", folder / f"photos/{name}.png", (32, 24), 1, ()) for name in "ab"]
    read_poses(folder / "model", photos, folder / "work", base=folder)


def _masks(folder: Path) -> None:
    photo = Prepared("a.png", folder / "photos/a.png", (32, 24), 1, ())
    from mitsplat.capture.capture import Photo
    from mitsplat.geometry.camera import Camera

    camera = Camera.look_at((0, 0, -1), (0, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=40)
    make = given_masks(folder / "masks", {"a.png": photo}, {"a.png": camera})
    make(Photo("a.png", photo.file, camera))


READERS: Mapping[str, Reader] = {
    "splats .ply": Reader("a.ply", lambda folder: Splats.load(folder / "a.ply")),
    "splats .splat": Reader("a.splat", lambda folder: Splats.load(folder / "a.splat")),
    "splats .compressed.ply": Reader("a.compressed.ply", lambda f: Splats.load(f / "a.compressed.ply"), slow=True),
    "splats .spz": Reader("a.spz", lambda folder: Splats.load(folder / "a.spz"), slow=True),
    "splats .sog": Reader("a.sog", lambda folder: Splats.load(folder / "a.sog"), slow=True),
    "splats .ksplat": Reader("a.ksplat", lambda folder: Splats.load(folder / "a.ksplat"), slow=True),
    "asset.yaml": Reader("nut/asset.yaml", lambda folder: Asset.load(folder / "nut")),
    "materials.ply": Reader("nut/materials.ply", lambda folder: Asset.load(folder / "nut")),
    "scene .yaml": Reader("scene.yaml", lambda folder: load_scene(folder / "scene.yaml")),
    "scene .xml": Reader("scene.xml", lambda folder: check_xml(folder / "scene.xml")),
    "mesh .ply": Reader("mesh.ply", lambda folder: read_mesh(folder / "mesh.ply"), slow=True),
    "mesh .stl": Reader("mesh.stl", lambda folder: read_mesh(folder / "mesh.stl"), slow=True),
    "mesh .obj": Reader("mesh.obj", lambda folder: read_mesh(folder / "mesh.obj"), slow=True),
    "mesh .glb": Reader("mesh.glb", lambda folder: read_mesh(folder / "mesh.glb"), slow=True),
    "mesh .off": Reader("mesh.off", lambda folder: read_mesh(folder / "mesh.off"), slow=True),
    "transforms.json": Reader("transforms.json", _transforms),
    "COLMAP cameras": Reader("model/cameras.txt", _colmap, slow=True),
    "COLMAP images": Reader("model/images.txt", _colmap, slow=True),
    "mask": Reader("masks/a.png.png", _masks),
    "YOLO data.yaml": Reader("yolo/data.yaml", lambda folder: _read_labelled(folder / "yolo")),
    "YOLO labels": Reader("yolo/labels/a.txt", lambda folder: _read_labelled(folder / "yolo")),
    "YOLO image": Reader("yolo/images/a.png", lambda folder: _read_labelled(folder / "yolo")),
    "video": Reader("walk.avi", lambda f: choose_frames(f / "walk.avi", f / "frames", most=9, least=3), slow=True),
    "COCO labels": Reader("coco/labels.json", lambda folder: _read_labelled(folder / "coco")),
}


def _child(name: str, folder: Path, seed: int, deadline: float, pipe: Any) -> None:
    """Read inputs until the time limit; report each one first."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    reader = READERS[name]
    sample = (folder / reader.file).read_bytes()
    number = seed
    while time.monotonic() < deadline:
        number += 1
        (folder / reader.file).write_bytes(mutate(sample, random.Random(number)))
        pipe.send(number)
        signal.alarm(SECONDS)
        with open("/dev/null", "w") as nothing:  # noqa: PTH123
            kept, sys.stderr = sys.stderr, nothing
            found = attempt(reader, folder)
            sys.stderr = kept
        signal.alarm(0)
        pipe.send(found)
    (folder / reader.file).write_bytes(sample)


def fuzz(name: str, folder: Path, seed: int, seconds: float) -> Counter[str]:
    """Return counts of results of random inputs to one reader; print faults with the number of their input."""
    counts: Counter[str] = Counter()
    deadline, number = time.monotonic() + seconds, seed
    sample = (folder / READERS[name].file).read_bytes()
    while time.monotonic() < deadline:
        near, far = multiprocessing.Pipe()
        child = multiprocessing.get_context("fork").Process(target=_child, args=(name, folder, number, deadline, far))
        child.start()
        far.close()
        try:
            while True:
                number = near.recv()
                found = near.recv()
                counts[found if found in ("read", "refused") else "fault"] += 1
                if found not in ("read", "refused"):
                    print(f"{name}, input {number}: {found}", flush=True)
        except EOFError:
            child.join()
        if child.exitcode:
            counts["crash or hang"] += 1
            print(f"{name}, input {number}: the process ended with {child.exitcode}", flush=True)
        (folder / READERS[name].file).write_bytes(sample)
    return counts


def main() -> None:
    """Divide the time among the readers, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=list(READERS), choices=list(READERS))
    options = parser.parse_args()
    with recording("scale.fuzz", parser, options):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Test one reader after the other."""
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        make_samples(Path(folder))
        for name in options.only:
            counts = fuzz(name, Path(folder), options.seed, 60 * options.minutes / len(options.only))
            total += counts
            figure(sum(counts.values()), "", name, "inputs")
            print(f"{name}: {dict(sorted(counts.items()))}", flush=True)
    figure(sum(total.values()), "", "inputs")
    for outcome in ("read", "refused", "fault", "crash or hang"):
        figure(total[outcome], "", outcome)
    print(f"all: {sum(total.values())} inputs, {dict(sorted(total.items()))}")


if __name__ == "__main__":
    main()
