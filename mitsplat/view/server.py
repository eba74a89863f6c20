"""Viewer server: from a path to a page that is served until it is interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mitsplat.asset import ASSET_FILE
from mitsplat.capture.capture import CAPTURE_FILE
from mitsplat.errors import InputError
from mitsplat.view.page import Address, Page

if TYPE_CHECKING:
    from mitsplat.view.scene_page import ScenePage

Kind = Literal["scene", "asset", "capture", "dataset", "splats"]

_BY_CONTENT: dict[str, Kind] = {ASSET_FILE: "asset", CAPTURE_FILE: "capture", "dataset.json": "dataset"}
SPLAT_SUFFIXES = (".ply", ".splat", ".ksplat", ".spz", ".sog")

_CHECK_INTERVAL = 0.3
"""Interval of checks for changes of a file [s]."""


def serve(
    path: str | Path,
    address: Address | None = None,
    *,
    gaussians: int = 300_000,
    allow_outside: bool = False,
    ready: Callable[[str], object] = lambda url: None,
) -> None:
    """Serve the page of a path until Ctrl-C.

    Args:
        path: Scene file, splat file, or folder of an asset, a capture or a dataset.
        address: Network address of the page.
        gaussians: Maximum number of Gaussians of all clouds together in the browser.
        allow_outside: Allow a scene to reference files outside its folder.
        ready: Callback with the address of the page, called when it is available.

    Raises:
        InputError: If the path cannot be displayed, or the address cannot be bound.
    """
    path = Path(path)
    kind = kind_of(path)
    page = Page(path.name, address or Address(), gaussians=gaussians)
    try:
        scene_page = _fill_page(page, path, kind, allow_outside)
        try:
            ready(page.url)
            while True:
                time.sleep(_CHECK_INTERVAL)
                if scene_page is not None:
                    scene_page.check()
        except KeyboardInterrupt:
            return
        finally:
            if scene_page is not None:
                scene_page.close()
    finally:
        page.close()


def _fill_page(page: Page, path: Path, kind: Kind, allow_outside: bool) -> ScenePage | None:
    """Fill the page with the content of a path, and return the page of a scene, which follows changes of its file.

    Only the modules of the kind are imported, for a fast start.
    """
    if kind == "scene":
        from mitsplat.view.scene_page import ScenePage  # fast start: renders, physics

        return ScenePage(page, path, allow_outside=allow_outside)
    from mitsplat.view import static_pages  # fast start: datasets and captures

    fill: dict[Kind, Callable[[Page, Path], object]] = {
        "asset": static_pages.show_asset,
        "capture": static_pages.CapturePage,
        "dataset": static_pages.DatasetPage,
        "splats": static_pages.show_splats,
    }
    fill[kind](page, path)
    return None


def kind_of(path: Path) -> Kind:
    """Return the kind of a path, by its suffix or by the content of its folder.

    Raises:
        InputError: If the path is missing or cannot be displayed.
    """
    if path.is_dir():
        for name, kind in _BY_CONTENT.items():
            if (path / name).is_file():
                return kind
        raise InputError(f"{path}: must be a folder with {', '.join(_BY_CONTENT)} (got none of these)")
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml") and path.name != ASSET_FILE:
        return "scene"
    if suffix in SPLAT_SUFFIXES:
        return "splats"
    raise InputError(
        f"{path}: must be a scene (.yaml), splats ({', '.join(SPLAT_SUFFIXES)}), or the folder of an asset, a capture "
        f"or a dataset (got {path.name})"
    )
