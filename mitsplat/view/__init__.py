"""Interactive viewer in the browser for scenes, assets, datasets, captures and splat files.

Input: a path. Output: a page that is served until it is interrupted. The displayed parts are plain values
(:mod:`mitsplat.view.scene_parts`); the page sends only changed parts to a browser. A thread renders real previews for
the newest request only (:mod:`mitsplat.view.previews`). The library viser provides the page and draws splats and meshes
in the browser.
"""

from __future__ import annotations

from mitsplat.view.page import Address
from mitsplat.view.server import serve

__all__ = ["Address", "serve"]
