"""Process that reads a COLMAP text model with pycolmap: ``python -m mitsplat.audit.colmap_worker MODEL POINTS``.

It prints one line of JSON for each image, by ascending id: the image's properties as read by pycolmap, and the pixels
at which its camera sees POINTS, a JSON list of points in its frame. pycolmap gets :data:`PIECE` images at a time, so
that memory use does not grow with the number of images.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

zlib.compress(b"before pycolmap")

import numpy as np  # noqa: E402
import pycolmap  # noqa: E402

PIECE = 10_000


def main(model: Path, points: list[list[float]]) -> None:
    """Print the properties of all images."""
    with (model / "images.txt").open() as file, tempfile.TemporaryDirectory() as folder:
        for name in ("cameras.txt", "points3D.txt"):
            shutil.copyfile(model / name, Path(folder) / name)
        lines = (line for line in file if not line.startswith("#"))
        while piece := list(islice(lines, 2 * PIECE)):
            (Path(folder) / "images.txt").write_text("".join(piece))
            for line in describe(Path(folder), points):
                sys.stdout.write(line + "\n")


def describe(folder: Path, points: list[list[float]]) -> Iterator[str]:
    """Yield the images of a piece of a model as JSON."""
    piece = pycolmap.Reconstruction(folder)
    for number in sorted(piece.images):
        image = piece.images[number]
        camera = piece.cameras[image.camera_id]
        yield json.dumps(
            {
                "id": number,
                "name": image.name,
                "camera_from_world": image.cam_from_world().matrix().tolist(),
                "size": [camera.width, camera.height],
                "pixels": [np.ravel(camera.img_from_cam(np.array(point))).tolist() for point in points],
            }
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), json.loads(sys.argv[2]))
