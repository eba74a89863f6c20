"""Opening of untrusted USD stages, and the missing package.

A stage composes files: sublayers, references, payloads and packages. They may lie in the folder of the stage and in its
subfolders only. Layers are opened one by one and their file names checked before USD composes them.
"""

from __future__ import annotations

import os
import re
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from mitsplat.errors import InputError, MissingResourceError

if TYPE_CHECKING:
    from pxr import Sdf, Usd

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
_MAX_LAYERS = 1000
_ENVIRONMENT = ("PXR_PLUGINPATH_NAME", "PXR_AR_DEFAULT_SEARCH_PATH", "PXR_USD_WINDOWS_DLL_PATH")


def is_usd(path: Path) -> bool:
    """Return True if a file has a suffix of USD."""
    return path.suffix.lower() in USD_SUFFIXES


def require_usd() -> None:
    """Check that OpenUSD is installed.

    Raises:
        MissingResourceError: If it is not.
    """
    if find_spec("pxr") is None:
        raise MissingResourceError("USD files need OpenUSD: pip install 'mitsplat[usd]'")


def open_confined(path: Path) -> Usd.Stage:
    """Open a stage whose files all lie in its folder, without plugins and search paths of the environment.

    Call it in a child process with limited memory and time: USD reads files in C++.

    Raises:
        InputError: If a layer lies outside of the folder, is missing or damaged, or takes values from clips.
    """
    for name in _ENVIRONMENT:
        os.environ.pop(name, None)
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"
    from pxr import Tf, Usd  # optional, and slow to import

    _check_layers(path)
    try:
        return Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise InputError(f"{path}: cannot be composed ({_first_line(error)})") from None


def _check_layers(path: Path) -> None:
    """Check the files of a stage, layer by layer."""
    from pxr import Ar, Sdf, Tf  # optional

    folder = path.parent.resolve()
    pending, seen = [str(path.absolute())], set[str]()
    while pending:
        identifier = pending.pop()
        if identifier in seen:
            continue
        seen.add(identifier)
        if len(seen) > _MAX_LAYERS:
            raise InputError(f"{path}: must have at most {_MAX_LAYERS} layers (got more)")
        file = Path(Ar.SplitPackageRelativePathOuter(identifier)[0])
        if not file.is_absolute():  # USD found no such file beside the layer, and would search the current folder
            raise InputError(f"{path}: no such file: {folder / file}")
        if not file.resolve().is_relative_to(folder):
            raise InputError(f"{path}: files of a stage must lie in its folder; flatten the stage (got {file})")
        if not file.is_file():
            raise InputError(f"{path}: no such file: {file}")
        if file.suffix.lower() not in USD_SUFFIXES:
            raise InputError(f"{path}: layers must be {', '.join(USD_SUFFIXES)} (got {file})")
        try:
            layer = Sdf.Layer.FindOrOpen(identifier)
        except Tf.ErrorException as error:
            raise InputError(
                f"{_shown(path, identifier)}: not a USD file that can be read ({_first_line(error)})"
            ) from None
        if layer is None:
            raise InputError(f"{_shown(path, identifier)}: not a USD file that can be read")
        named = {*layer.GetCompositionAssetDependencies(), *layer.GetExternalAssetDependencies()}
        for name in sorted(filter(None, named)):
            if "://" in name or "`" in name:
                raise InputError(
                    f"{_shown(path, identifier)}: must name files, not addresses or expressions (got {name})"
                )
            pending.append(Sdf.ComputeAssetPathRelativeToLayer(layer, name))
        clips: list[str] = []
        layer.Traverse("/", partial(_find_clips, layer, clips))
        if clips:
            raise InputError(f"{_shown(path, identifier)}: value clips are not supported (got those of {clips[0]})")


def _shown(path: Path, identifier: str) -> str:
    """Return the name of a layer for messages: that of the stage as it was given."""
    return str(path) if identifier == str(path.absolute()) else f"{path}: {identifier}"


def _find_clips(layer: Sdf.Layer, found: list[str], path: Sdf.Path) -> None:
    """Append the path of a prim that takes values from clips."""
    spec = layer.GetObjectAtPath(path)
    if spec is not None and spec.HasInfo("clips"):
        found.append(str(path))


def _first_line(error: Exception) -> str:
    """Return the cause that an error of USD states."""
    found = re.search(r": '(.*)'", str(error), re.DOTALL)
    return " ".join((found[1] if found else str(error)).split())
