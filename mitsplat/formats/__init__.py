"""Labels as files that others read: YOLO, COCO, Pascal VOC, BOP, COLMAP, maps and EXR.

In: a :class:`~mitsplat.frames.frame.Frame`. Out: its files in every format asked for, and what describes all frames,
written frame by frame. A format is one module here and one entry in :mod:`.registry`.
"""

from __future__ import annotations

from mitsplat.formats.registry import Catalogue, CollectionWriter, write_frame

__all__ = ["Catalogue", "CollectionWriter", "write_frame"]
