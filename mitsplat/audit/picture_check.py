"""Audit of a frame's pictures, which are read by OpenCV and compared with the masks of the manifest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, Int64Array
from mitsplat.audit.dataset_check import FileCheck
from mitsplat.audit.decoded_frame import DecodedFrame, bounds_of
from mitsplat.images.picture_files import read_picture


def check_image(frame: DecodedFrame, path: Path) -> Iterator[str]:
    """Yield the violations of the frame's picture."""
    image = read_picture(path)
    width, height = frame.size
    if image is None:
        yield "cannot be read as an image"
    elif image.shape[:2] != (height, width):
        yield f"is {image.shape[1]}x{image.shape[0]} px, its labels are for {width}x{height}"
    elif np.ptp(frame.ids) > 0 and (image == image[:1, :1]).all():  # masks without an outline allow a plain backdrop
        yield "has one colour only, but its masks have outlines"


def _check_copy(frame: DecodedFrame, path: Path) -> Iterator[str]:
    """Check that a format's picture is the frame's picture under a second name."""
    image = f"images/{frame.split}/{frame.image_name}"
    if frame.record["files"][path.relative_to(frame.root).as_posix()] != frame.record["files"].get(image):
        yield f"is not the picture {image}"


def read_16_bits(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.uint16] | None:
    """Read a picture of 16 bits; return None if it does not have this shape."""
    picture = read_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.shape != shape:
        return None
    return picture.astype(np.uint16, copy=False)


def _check_grey(
    frame: DecodedFrame, path: Path, find_wrong: Callable[[Int64Array], BoolArray], reference: str
) -> Iterator[str]:
    """Check a grey picture of 8 or 16 bits by a function that returns a mask of its wrong pixels."""
    picture = read_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != frame.size[::-1]:
        yield "cannot be read as a grey image of the frame's size"
    elif count := np.count_nonzero(find_wrong(picture.astype(np.int64))):
        yield f"{count} pixels differ from {reference}"


def _check_instances(frame: DecodedFrame, path: Path) -> Iterator[str]:
    return _check_grey(frame, path, lambda ids: ids != frame.ids, "the masks")


def _check_semantic(frame: DecodedFrame, path: Path) -> Iterator[str]:
    void = 255 if len(frame.content["classes"]) < 255 else 65535
    return _check_grey(
        frame,
        path,
        lambda classes: (classes != frame.classes) & ~((classes == void) & (frame.ids == 0)),
        "the masks' classes",
    )


def segment_picture(frame: DecodedFrame, path: Path) -> Int64Array | None:
    """Read the ids (H, W) of a panoptic picture, R + 256 G + 65536 B as in panopticapi."""
    picture = read_picture(path)
    if picture is None or picture.shape[:2] != frame.size[::-1]:
        return None
    blue, green, red = (picture[..., channel].astype(np.int64) for channel in range(3))
    return np.asarray(red + 256 * green + 65536 * blue)


def _check_panoptic(frame: DecodedFrame, path: Path) -> Iterator[str]:
    ids = segment_picture(frame, path)
    if ids is None:
        yield "cannot be read as an image of the frame's size"
        return
    environment = frame.record.get("environment")
    wrong = (ids != frame.ids) & ~((frame.ids == 0) & (ids == (environment or {"id": 0})["id"]))
    if wrong.any():
        yield f"{np.count_nonzero(wrong)} pixels differ from the masks"
    elif environment is not None:
        mask = ids == environment["id"]
        box, stated = list(bounds_of(mask)), environment["box"]
        if box != stated or np.count_nonzero(mask) != environment["area"]:
            yield f"its environment has the box {box}, not {stated} as in the manifest, or another area"


def _check_depth(frame: DecodedFrame, path: Path) -> Iterator[str]:
    picture = read_16_bits(path, frame.size[::-1])
    if picture is None:
        yield "cannot be read as a 16-bit image of the frame's size"
    elif frame.has_splat_labels and (missing := np.count_nonzero((frame.ids > 0) & (picture == 0))):
        yield f"{missing} pixels of instances have no depth"


def _check_bop(frame: DecodedFrame, path: Path) -> Iterator[str]:
    """Check a picture of a BOP scene; unknown names are reported by the check of the list of files."""
    folder = path.parent.name
    if folder == "rgb":
        yield from _check_copy(frame, path)
    elif folder == "depth":
        yield from _check_depth(frame, path)
    else:
        names = [f"{frame.index:06d}_{position:06d}" for position in range(len(frame.instances))]
        if path.stem in names:
            mask = frame.full_mask(frame.instances[names.index(path.stem)], amodal=folder == "mask")
            yield from _check_grey(frame, path, lambda picture: (picture > 0) != mask, "the manifest's mask")


CHECKS: dict[str, FileCheck] = {
    "images/": check_image,
    **{f"{folder}/": _check_copy for folder in ("yolo-detect/images", "yolo-obb/images", "yolo-pose/images")},
    "instances/": _check_instances,
    "semantic/": _check_semantic,
    "panoptic/": _check_panoptic,
    "depth/": _check_depth,
    "bop/": _check_bop,
}
"""Check functions of pictures, by folder."""
