"""From a path to a page that is served until it is interrupted."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.view.page import Address, Page
from mitsplat.view.scene_page import ScenePage

_LOOK = 0.3
"""How often a file is looked at for changes [s]."""


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
        path: A scene file.
        address: Where it is served.
        gaussians: Most Gaussians of a cloud that a browser is sent.
        allow_outside: Whether a scene may name files outside of its folder.
        ready: Told the page's address once it answers.

    Raises:
        InputError: If it is nothing that can be shown, or the address cannot be listened on.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    page = Page(path.name, address or Address(), gaussians=gaussians)
    try:
        shown = ScenePage(page, path, allow_outside=allow_outside)
        try:
            ready(page.url)
            while True:
                time.sleep(_LOOK)
                shown.check()
        except KeyboardInterrupt:
            return
        finally:
            shown.close()
    finally:
        page.close()
