"""Sphinx directive ``schema``: tables of the data format, from the schema that the programs use.

In a page of Markdown::

    ```{schema} arrays
    ```

prints the stored arrays; ``geometry`` those of ``geometry.exr``, ``conventions`` the manifest's conventions.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mbtf_core.data import schema as shard_schema
from mbtf_core.data.schema import ARRAYS, CONVENTIONS, GEOMETRY, ArraySpec

Cell = list[nodes.Node]


def _code(*words: str) -> Cell:
    cell: Cell = []
    for word in words:
        cell += [nodes.Text(" "), nodes.literal(word, word)]
    return cell[1:]


def _text(text: str) -> Cell:
    return [nodes.Text(text)]


def _array_row(spec: ArraySpec) -> list[Cell]:
    return [_code(spec.name), _text(spec.unit), _code(*spec.channels), _text(spec.meaning)]


def _table(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> nodes.table:
    def row(cells: Sequence[Cell]) -> nodes.row:
        return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", *cell)) for cell in cells))

    group = nodes.tgroup(cols=len(header))
    group += [nodes.colspec(colwidth=1) for _ in header]
    group += nodes.thead("", row([_text(title) for title in header]))
    group += nodes.tbody("", *(row(cells) for cells in rows))
    return nodes.table("", group, classes=["colwidths-auto"])


class SchemaDirective(SphinxDirective):
    """``schema``; see the module."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The table.

        Raises
        ------
        docutils.parsers.rst.DirectiveError
            If there is no such part of the schema.
        """
        self.env.note_dependency(inspect.getfile(shard_schema))
        name = self.arguments[0]
        if name == "conventions":
            rows = [[_code(key), _text(meaning)] for key, meaning in CONVENTIONS.items()]
            return [_table(("key", "meaning"), rows)]
        specs = {"arrays": ARRAYS, "geometry": GEOMETRY}.get(name)
        if specs is None:
            raise self.error(f"no part {name!r} of the schema: arrays, geometry, conventions")
        header = ("array", "unit", "components, and channels in EXR", "meaning")
        return [_table(header, [_array_row(spec) for spec in specs])]


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_directive("schema", SchemaDirective)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
