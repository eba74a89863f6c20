"""Writers of label files: YOLO, COCO, BOP, COLMAP, maps and EXR.

In: a :class:`~mitsplat.frames.frame.Frame`. Out: its files in every requested format, and the files that describe all
frames, which grow frame by frame. A format is one module here and one entry in :mod:`.registry`;
``CONTRIBUTING.md`` lists the further steps.
"""

from __future__ import annotations

from mitsplat.formats.registry import Catalogue, CollectionWriter, write_frame

__all__ = ["Catalogue", "CollectionWriter", "write_frame"]
