"""Files of a dataset: image, YOLO label and EXR of one frame; COCO annotations and ``data.yaml`` of all of them.

The formats, by their names in a scene file's ``output.formats``:

``yolo``
    ``labels/<split>/NNNNNN.txt``, one line per instance: class index and the outline of
    :func:`mitsplat.label.outline`, normalised to [0, 1]; ``data.yaml`` for Ultralytics.
``coco``
    ``annotations/instances_<split>.json``: boxes, areas and run-length masks. File names are relative to
    ``images/<split>``, category ids are class indices + 1.
``exr``
    ``layers/<split>/NNNNNN.exr``: linear R, G, B; A (opacity); Z (depth along the camera's axis [m], 0 = nothing);
    instance and proxy_instance (ids); normal.X/Y/Z (world); light.R/G/B; and the frame's further layers by name.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.label import Labels

if TYPE_CHECKING:
    from mitsplat.frame import Frame
    from mitsplat.spec import Output

Record = dict[str, Any]
"""The line of one frame in ``manifest.jsonl``."""

FORMATS = ("yolo", "coco", "exr")
SPLITS = ("train", "val")


def write_file(path: Path, write: Callable[[Path], object]) -> str:
    """Make a file by ``write(temporary path)``, then move it to ``path`` at once and for good.

    Returns:
        The SHA-256 of the content.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    write(temporary)
    with temporary.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
    temporary.replace(path)
    return digest


def write_text(path: Path, text: str) -> str:
    """Write UTF-8 text by :func:`write_file`."""
    return write_file(path, lambda temporary: temporary.write_bytes(text.encode()))


def write_frame(frame: Frame, root: Path, output: Output) -> Record:
    """Write the files of one frame below ``root`` and describe it, its files included, as a line of the manifest."""
    plan = frame.plan
    name = f"{plan.split}/{frame.index:06d}"
    files = {f"images/{name}.{output.image}": lambda path: path.write_bytes(encode_image(frame.image, output))}
    if "yolo" in output.formats:
        files[f"labels/{name}.txt"] = lambda path: path.write_text(yolo_lines(frame.labels))
    if "exr" in output.formats:
        files[f"layers/{name}.exr"] = lambda path: write_exr(path, frame)
    return {
        "index": frame.index,
        "layout": plan.layout,
        "view": plan.view,
        "split": plan.split,
        "seed": plan.seed,
        "files": {file: write_file(root / file, write) for file, write in files.items()},
        "draws": dict(frame.draws),
        "camera": {
            "width": frame.camera.width,
            "height": frame.camera.height,
            "intrinsics": frame.camera.intrinsics.tolist(),
            "distortion": list(frame.camera.distortion),
            "world_from_camera": frame.camera.world_from_camera.tolist(),
        },
        "labels": frame.labels.to_json(),
        "rest": frame.layout.to_json()["certificate"],
    }


def encode_image(image: npt.NDArray[np.uint8], output: Output) -> bytes:
    """An RGB image (H, W, 3) as PNG or JPEG.

    PNG takes OpenCV's defaults (one filter, run-length strategy): a third of the time of its explicit level 3 for 5 to
    10 % more bytes on noisy frames.
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, output.jpeg_quality] if output.image == "jpg" else []
    done, data = cv2.imencode(f".{output.image}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as {output.image}")
    return bytes(data)


def yolo_lines(labels: Labels) -> str:
    """Lines of a YOLO segmentation label: class index, then x and y of the outline's vertices in [0, 1]."""
    return "".join(
        f"{label.class_index} {' '.join(f'{value:.6f}' for value in polygon.ravel())}\n"
        for label in labels.instances
        for polygon in [label.polygon / (labels.width, labels.height)]
    )


def write_exr(path: Path, frame: Frame) -> None:
    """Write the layers of a frame as channels of one scan-line OpenEXR file, 32 bits each."""
    import OpenEXR

    fixed = ("depth", "instance", "proxy_instance", "normal", "light")
    layers = {**{name: getattr(frame, name) for name in fixed}, **frame.layers}
    names = {"depth": "Z", "alpha": "A"}
    axes = {"normal": "XYZ"}
    channels = {letter: frame.rgb[..., i] for i, letter in enumerate("RGB")}
    for layer, values in layers.items():
        if values.ndim == 2:
            channels[names.get(layer, layer)] = values
        else:
            channels |= {f"{layer}.{axis}": values[..., i] for i, axis in enumerate(axes.get(layer, "RGB"))}
    kinds = {"f": np.float32, "u": np.uint32, "i": np.uint32, "b": np.uint32}
    contiguous = {name: np.ascontiguousarray(c, dtype=kinds[c.dtype.kind]) for name, c in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, contiguous) as file:
        file.write(str(path))


def write_collection(root: Path, records: Iterable[Record], class_names: Sequence[str], formats: Iterable[str]) -> None:
    """Write what describes a whole dataset, from the ``records`` of its frames, which are iterated several times."""
    if "yolo" in formats:
        write_text(root / "data.yaml", data_yaml(class_names, {record["split"] for record in records}))
    if "coco" in formats:
        (root / "annotations").mkdir(exist_ok=True)
        for split in SPLITS:
            chosen = (record for record in records if record["split"] == split)
            write_text(root / f"annotations/instances_{split}.json", json.dumps(coco(chosen, class_names)))


def data_yaml(class_names: Sequence[str], splits: Iterable[str]) -> str:
    """Description of a dataset for Ultralytics.

    It has no ``path``: Ultralytics then resolves the splits against the file's own folder, wherever it is run.
    """
    present = [split for split in SPLITS if split in splits]
    lines = ["# Paths are relative to this file."]
    for split in SPLITS:
        if split in present or not present:
            lines.append(f"{split}: images/{split}")
        else:
            lines.append(f"{split}: images/{present[0]} # there are no images for {split}; Ultralytics wants some")
    lines += ["names:", *(f"  {i}: {json.dumps(name, ensure_ascii=False)}" for i, name in enumerate(class_names))]
    return "\n".join(lines) + "\n"


def coco(records: Iterable[Record], class_names: Sequence[str]) -> dict[str, Any]:
    """COCO instance annotations of some frames; image ids are frame indices."""
    images: list[Mapping[str, Any]] = []
    annotations: list[Mapping[str, Any]] = []
    for record in records:
        width, height = record["labels"]["size"]
        image = next(Path(file).name for file in record["files"] if file.startswith("images/"))
        images.append({"id": record["index"], "file_name": image, "width": width, "height": height})
        for label in record["labels"]["instances"]:
            x0, y0, x1, y1 = label["box"]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": record["index"],
                    "category_id": label["class_index"] + 1,
                    "bbox": [x0, y0, x1 - x0, y1 - y0],
                    "area": label["area"],
                    "iscrowd": 0,
                    "segmentation": {"size": [height, width], "counts": label["rle"]},
                }
            )
    categories = [{"id": i, "name": name, "supercategory": "object"} for i, name in enumerate(class_names, start=1)]
    return {"images": images, "annotations": annotations, "categories": categories}
