"""What a path is, told by its name: for the sentence on one that was given where another kind is wanted."""

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
    """Refuse a folder, or a file whose suffix is that of another kind; what is not there is for its reader to refuse.

    Args:
        path: What was given.
        wanted: What is wanted instead.
        suffixes: Those that may be what is wanted.

    Raises:
        InputError: Which says what it is.
    """
    if path.is_dir():
        what = next((text for name, text in _BY_CONTENT.items() if (path / name).is_file()), None)
        raise InputError(f"{path}: must be {wanted} (got a folder{f': {what}' if what else ''})")
    suffix = path.suffix.lower()
    if path.is_file() and suffix in _BY_SUFFIX and suffix not in suffixes:
        raise InputError(f"{path}: must be {wanted} (got {_BY_SUFFIX[suffix]})")
