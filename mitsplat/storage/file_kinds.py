"""File kinds by name, for error messages about files of the wrong kind."""

from __future__ import annotations

from pathlib import Path

from mitsplat.errors import InputError

_SPLATS = "splats, which an asset.yaml names under `splats:`; `mitsplat chart` renders them"
_MESH = "a mesh, of which `mitsplat bake` makes an asset"
_PICTURE = "a picture"
_DRAWING = "solids of a CAD program: export them from there as a mesh, .glb with its colours, or .stl"
_BY_SUFFIX = {
    **dict.fromkeys((".splat", ".ksplat", ".spz", ".sog"), _SPLATS),
    **dict.fromkeys((".stl", ".obj", ".glb", ".gltf", ".off", ".3mf", ".dae"), _MESH),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff"), _PICTURE),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".sldprt", ".ipt", ".fcstd"), _DRAWING),
    ".ply": "splats or a mesh: an asset.yaml names it under `splats:` or `mesh:`",
    ".xml": "a Mitsuba scene, which `mitsplat render` renders",
    ".yaml": "a scene or an asset.yaml",
    ".yml": "a scene or an asset.yaml",
}
_BY_CONTENT = {
    "asset.yaml": "an asset, which a scene names under `objects:`; `mitsplat check` looks at it",
    "dataset.json": "a dataset, which `mitsplat report` shows",
    "capture.json": "a capture, which `mitsplat fit` takes",
}


def refuse_others(path: Path, wanted: str, *suffixes: str) -> None:
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
        what = next((text for name, text in _BY_CONTENT.items() if (path / name).is_file()), None)
        raise InputError(f"{path}: must be {wanted} (got a folder{f': {what}' if what else ''})")
    suffix = path.suffix.lower()
    if path.is_file() and suffix in _BY_SUFFIX and suffix not in suffixes:
        raise InputError(f"{path}: must be {wanted} (got {_BY_SUFFIX[suffix]})")
