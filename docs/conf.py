"""Sphinx's settings: pages in Markdown, with what is generated from the code filled in while they are read."""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent / "_ext")]

from mitsplat.version import __version__  # noqa: E402 - what lies beside this file comes first

project = "mitsplat"
author = "mitsplat developers"
copyright = author
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "generated",
]
exclude_patterns = ["_build", "_ext", "**.ipynb_checkpoints"]
templates_path: list[str] = []
html_static_path = ["_static"]
html_css_files = ["site.css"]

# Pages
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
suppress_warnings = ["mystnb.unknown_mime_type"]

# Notebooks are stored without outputs; NOTEBOOKS=1 runs them.
nb_execution_mode = "force" if os.environ.get("NOTEBOOKS") else "off"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

# Docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {
    **{name: name for name in ("BoolArray", "ByteImage", "Float32Array", "Float64Array", "Int32Array", "Int64Array")},
    **{"npt.ArrayLike": "ArrayLike", "LightSpec": "LightSpec", "CameraSpec": "CameraSpec"},
}
autodoc_class_signature = "mixed"
maximum_signature_line_length = 90
python_use_unqualified_type_names = True
napoleon_use_ivar = True
napoleon_use_rtype = False
# Names of other projects and of type aliases; those of mitsplat are looked up in the code, by ``generated``.
nitpick_ignore_regex = [(r"py:.*", r"(?!mitsplat\.|\.).*")]

# Appearance
html_theme = "furo"
html_title = "mitsplat"
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": False}
pygments_style = "friendly"
pygments_dark_style = "monokai"
