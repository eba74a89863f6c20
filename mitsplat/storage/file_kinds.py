"""File kinds by name, and checks of names and kinds."""

from __future__ import annotations

import os
from pathlib import Path

from mitsplat.errors import InputError

_SPLATS = "a splat file: enter it in an asset.yaml under `splats:`"
_MESH = "a mesh: `mitsplat bake` makes an asset from it"
_PICTURE = "an image"
_DRAWING = "a CAD file: export it as a mesh, .glb with colours or .stl"
_BY_SUFFIX = {
    **dict.fromkeys((".splat", ".ksplat", ".spz", ".sog"), _SPLATS),
    **dict.fromkeys((".stl", ".obj", ".glb", ".gltf", ".off", ".3mf", ".dae"), _MESH),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff"), _PICTURE),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".sldprt", ".ipt", ".fcstd"), _DRAWING),
    ".ply": "splats or a mesh: enter it in an asset.yaml under `splats:` or `mesh:`",
    ".xml": "a Mitsuba scene: `mitsplat render` renders it",
    ".yaml": "a scene or an asset.yaml",
    ".yml": "a scene or an asset.yaml",
}
_BY_CONTENT = {
    "asset.yaml": "the folder of an asset: enter it in a scene under `objects:`; `mitsplat check` checks it",
    "dataset.json": "the folder of a dataset: `mitsplat report` describes it",
    "capture.json": "the folder of a capture: `mitsplat fit` fits splats to it",
}


def refuse_other_kinds(path: Path, wanted: str, *suffixes: str) -> None:
    """Refuse a folder, or an existing file whose suffix belongs to another kind of file.

    A missing file is not refused here, but by its reader.

    Args:
        path: Given path.
        wanted: Description of the expected kind.
        suffixes: Accepted suffixes.

    Raises:
        InputError: If the path is of another kind; the message names the kind.
    """
    if path.is_dir():
        found = next((text for name, text in _BY_CONTENT.items() if (path / name).is_file()), "a folder")
        raise InputError(f"{path}: must be {wanted} (got {found})")
    suffix = path.suffix.lower()
    if path.is_file() and suffix in _BY_SUFFIX and suffix not in suffixes:
        raise InputError(f"{path}: must be {wanted} (got {_BY_SUFFIX[suffix]})")


def check_name(path: str | Path) -> None:
    """Refuse a path that is not valid UTF-8. Native libraries reject such paths or abort the process.

    Raises:
        InputError: If it is not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"names of files and folders must be UTF-8 (got {os.fsencode(path)!r})") from None
