"""Sphinx configuration of the documentation; ``make docs`` builds it with every warning an error."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import latex2mathml.converter
from docutils import nodes

sys.path.insert(0, str(Path(__file__).parents[1]))

project = "mbtf"
author = "the mbtf authors"
copyright = "the mbtf authors, Apache-2.0"
release = version = installed_version("mbtf")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "attrs_inline", "colon_fence"]
myst_heading_anchors = 3
source_suffix = {".md": "markdown"}
root_doc = "index"
exclude_patterns = ["_build"]
templates_path: list[str] = []

html_theme = "furo"
html_title = "mbtf"
html_static_path = ["extensions/formulas.css"]
html_css_files = ["formulas.css"]
html_theme_options = {"navigation_with_keys": True}

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_numpy_docstring = True
napoleon_use_rtype = False
# The options of configurations are listed in reference/configuration.md.
autodoc_default_options = {"members": True, "exclude-members": "model_config"}
nitpicky = False
# Type hints name classes as their module knows them; two packages have a `Material`.
suppress_warnings = ["ref.python"]

_SECTIONS = {"Parameters", "Other Parameters", "Attributes", "Returns", "Yields", "Raises"}
# Docstrings are wrapped at this column or later, so an entry that would have held its next word is no
# entry that goes on.
_WRAPPED = 94


def _is_numpydoc(entry: str, following: str) -> bool:
    """Does an entry ``name : type`` have its description indented below it?

    The older form ``name : meaning`` goes on below only where its line is full.
    """
    words = following.split()
    if not words or not following.startswith("    "):
        return False
    return len(entry.rstrip()) + 1 + len(words[0]) <= _WRAPPED


def _entries_without_types(
    app: object, what: str, name: str, item: object, options: object, lines: list[str]
) -> None:
    """Rewrite entries ``name : meaning``, whose meaning napoleon would take for a type.

    Entries of numpydoc, ``name : type`` with an indented description, stay as they are.
    """
    out: list[str] = []
    inside = False
    for number, line in enumerate(lines):
        following = lines[number + 1] if number + 1 < len(lines) else ""
        if following.strip() and set(following.strip()) == {"-"}:
            inside = line.strip() in _SECTIONS
        entry = re.fullmatch(r"(\S[^:]*?) : (.*)", line) if inside else None
        if entry is None or _is_numpydoc(line, following):
            out.append(line)
        else:
            out += [entry[1], f"    {entry[2]}"]
    lines[:] = out


def _mathml(writer: Any, node: Any, display: str) -> None:
    """Formulas as MathML, which browsers show by themselves: pages load nothing from elsewhere."""
    formula = latex2mathml.converter.convert(node.astext(), display=display)
    # Browsers know bold letters, but not the attribute.
    bold = re.compile(r'<mi mathvariant="bold">([a-z])</mi>')
    formula = bold.sub(lambda found: f"<mi>{chr(0x1D41A + ord(found[1]) - ord('a'))}</mi>", formula)
    writer.body.append(formula)
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Called by Sphinx. Docstrings are read before napoleon does."""
    app.add_html_math_renderer(
        "mathml",
        inline_renderers=(lambda writer, node: _mathml(writer, node, "inline"), None),
        block_renderers=(lambda writer, node: _mathml(writer, node, "block"), None),
    )
    app.connect("autodoc-process-docstring", _entries_without_types, priority=400)
