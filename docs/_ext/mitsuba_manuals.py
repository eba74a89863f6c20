"""The markup that Mitsuba's plugins have in their docstrings: tables of parameters, and snippets in tabs."""

from __future__ import annotations

from docutils import nodes
from docutils.parsers.rst import roles
from docutils.parsers.rst.directives.tables import ListTable
from sphinx.application import Sphinx
from sphinx.directives.code import CodeBlock
from sphinx.util.docutils import SphinxDirective


class PluginParameters(ListTable):
    """``pluginparameters``: name, type and meaning of every parameter, as a table."""

    def run(self) -> list[nodes.Node]:
        """The table, its last column the widest."""
        self.options.setdefault("widths", [18, 10, 72])
        return list(super().run())


class Tabs(SphinxDirective):
    """``tabs``: the snippets one after the other."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """What the tabs hold."""
        return self.parse_content_to_nodes()


def setup(app: Sphinx) -> dict[str, bool]:
    """Sphinx's entry."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("tabs", Tabs)
    app.add_directive("code-tab", CodeBlock)
    roles.register_generic_role("monosp", nodes.literal)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
