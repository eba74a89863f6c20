"""A live view in the browser: what a scene, an asset, a dataset, a capture or a file of splats looks like, and why.

In: a path. Out: a page, served until it is interrupted. What is shown are plain values (``parts``), of which the page
sends a browser only what has changed; real renders come from a thread that works on the newest request alone
(``previews``). viser makes the page, and draws splats and meshes in the browser.
"""

from __future__ import annotations

from mitsplat.view.page import Address
from mitsplat.view.serve import serve

__all__ = ["Address", "serve"]
