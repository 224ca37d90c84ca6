"""Writes the tables of the pages from configurations, operations and the schema of the data: run it after a
change::

    python docs/extensions/write_tables.py

Tables stand between a comment that names them and the next one::

    <!-- configuration mbtf_fit.config.FitConfig only=training skip=training.blur,data -->
    <!-- end -->
    <!-- schema arrays -->
    <!-- end -->
    <!-- operations all -->
    <!-- end -->
"""

from __future__ import annotations

import re
from pathlib import Path

from configuration_reference import cell, configuration, table

from mbtf_core.data.schema import ARRAYS, CONVENTIONS, GEOMETRY
from mbtf_fit.ops import Operation

DOCS = Path(__file__).parents[1]
PAGES = (
    DOCS / "reference" / "configuration.md",
    DOCS / "reference" / "data-format.md",
    DOCS / "how-to" / "add-a-model.md",
)
_TABLE = re.compile(r"(<!-- (configuration|schema|operations) ([^>]*) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def schema(name: str) -> str:
    """The stored ``arrays``, those of ``geometry``, or the manifest's ``conventions``."""
    if name == "conventions":
        return "\n".join(f"- `{key}`: {cell(text)}" for key, text in CONVENTIONS.items())
    rows = [
        [f"`{a.name}`", cell(a.unit), " ".join(f"`{c}`" for c in a.channels), cell(a.meaning)]
        for a in {"arrays": ARRAYS, "geometry": GEOMETRY}[name]
    ]
    return table(("array", "unit", "components, and channels in EXR", "meaning"), rows)


def operations() -> str:
    """All operations, with their arguments."""
    return "\n".join(f"- `{k.signature()}`: {cell(k.summary())}" for k in Operation.kinds())


def written(page: str) -> str:
    """A page with its tables as they are now."""

    def replaced(found: re.Match[str]) -> str:
        name, *options = found[3].split()
        if found[2] == "configuration":
            keys = (option.partition("=") for option in options)
            text = configuration(name, **{key: value.split(",") for key, _, value in keys})
        else:
            text = schema(name) if found[2] == "schema" else operations()
        return f"{found[1]}\n{text}\n\n{found[5]}"

    return _TABLE.sub(replaced, page)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(written(path.read_text(encoding="utf-8")), encoding="utf-8")
