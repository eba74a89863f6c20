"""Files of a frame's per-pixel maps: depth, normals, instances, classes and flow, and all layers as OpenEXR."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import OpenEXR

from mitsplat.formats.maps import depth_picture, depth_scale, encode_flow, normal_picture, semantic_picture
from mitsplat.frames.depth_sensor import measure_depth
from mitsplat.storage.files import library_errors

if TYPE_CHECKING:
    from mitsplat.formats.format import FrameFiles
    from mitsplat.frames.frame import Frame


def write_instances(files: FrameFiles) -> None:
    """Write the id map of a frame's labelled instances."""
    files.add_png(f"instances/{files.name}.png", files.labelled)


def write_semantic(files: FrameFiles) -> None:
    """Write a frame's class map."""
    picture = semantic_picture(files.frame.labels, files.ids, files.catalogue.class_names)
    files.add_png(f"semantic/{files.name}.png", picture)


def write_depth(files: FrameFiles) -> None:
    """Write a frame's depth map."""
    files.add_depth(f"depth/{files.name}.png")


def write_depth_sensor(files: FrameFiles) -> None:
    """Write the depth that the scene's depth sensor measures, and its unit as ``depth_sensor_scale`` [mm]."""
    assert files.catalogue.depth_sensor is not None  # noqa: S101 - guaranteed by the scene
    measured = measure_depth(files.frame, files.catalogue.depth_sensor)
    files.record["depth_sensor_scale"] = depth_scale(measured)
    files.add_png(f"depth-sensor/{files.name}.png", depth_picture(measured))


def write_normals(files: FrameFiles) -> None:
    """Write a frame's normal map."""
    files.add_png(f"normals/{files.name}.png", normal_picture(files.frame.layers.normal))


def write_flow(files: FrameFiles) -> None:
    """Write the flow to the next view of the frame's layout, if there is one."""
    if (flow := files.frame.flow) is not None:
        files.add_bytes(f"flow/{files.name}.flo", encode_flow(flow))


def write_exr(files: FrameFiles) -> None:
    """Write the layers of a frame as OpenEXR."""
    files.add(f"layers/{files.name}.exr", lambda path: save_exr(path, files.frame))


def save_exr(path: Path, frame: Frame) -> None:
    """Write the layers of a frame as channels of one scan-line OpenEXR file, 32 bits each."""
    names = {"depth": "Z", "alpha": "A"}
    axes = {"normal": "XYZ"}
    channels = {letter: frame.rgb[..., i] for i, letter in enumerate("RGB")}
    for layer in ("depth", "instance", "proxy_instance", "normal", "light", "alpha", "captured", "highlight"):
        values = getattr(frame.layers, layer)
        if values.ndim == 2:
            channels[names.get(layer, layer)] = values
        else:
            channels |= {f"{layer}.{axis}": values[..., i] for i, axis in enumerate(axes.get(layer, "RGB"))}
    kinds = {"f": np.float32, "u": np.uint32, "i": np.uint32, "b": np.uint32}
    contiguous = {name: np.ascontiguousarray(c, dtype=kinds[c.dtype.kind]) for name, c in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, contiguous) as file, library_errors(path):
        file.write(str(path))
