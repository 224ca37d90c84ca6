"""The page: one HTML file that holds everything, and opens without a server or a network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

PAGE_NAME = "viewer.html"
# Parts of the script, in the order of their use.
_SCRIPTS = (
    "vectors.js",
    "data.js",
    "gl.js",
    "material.js",
    "shapes.js",
    "camera.js",
    "environment.js",
    "renderer.js",
    "state.js",
    "plots.js",
    "viewer.js",
    "panel.js",
    "pointer.js",
    "live.js",
    "main.js",
)


def _read(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text()


def safe_json(content: Any) -> str:
    """JSON that no text in it can end early: a page may hold it in a script element."""
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_page(content: Mapping[str, Any], title: str, *, live: bool = False) -> str:
    """HTML of the viewer.

    Parameters
    ----------
    content : ``materials``, and optionally ``pictures``, ``mesh`` and ``environment``
        (:mod:`mbtf_fit.viewer.content`, :mod:`mbtf_fit.viewer.extras`)
    title : shown by the browser
    live : whether the page may connect to the server that sent it
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    names = sorted(file.name for file in files(__package__).joinpath("page").iterdir())
    shaders = {name: _read(name) for name in names if name.endswith((".vert", ".frag"))}
    script = 'const CONTENT = JSON.parse(document.getElementById("content").textContent);\n'
    # Our own files: nothing in them is escaped.
    return environment.from_string(_read("viewer.html")).render(
        title=title,
        connect=Markup("'self'" if live else "'none'"),
        style=Markup(_read("viewer.css")),
        content=Markup(safe_json({**content, "shaders": shaders})),
        script=Markup(script + "\n".join(_read(name) for name in _SCRIPTS)),
    )
