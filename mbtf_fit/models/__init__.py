"""Models: one file each, or classes of other packages, found by :mod:`mbtf_fit.models.registry`. No file
imports PyTorch before it trains."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from pathlib import Path

from mbtf_core.files.atomic import file_sha256

# A class's line that gives its name, alone or before others.
_NAME = re.compile(r'^    name(?:, \w+)* = "([^"]+)"', re.MULTILINE)

FOREIGN = {point.name: point for point in entry_points(group="mbtf.models")}
"""Entry points of other packages that give a model, by its name."""


def file_and_class(name: str) -> tuple[str, str] | None:
    """The path and the class of a model that is given by them, ``FILE.py:CLASS``; None for other names."""
    file, _, wanted = name.rpartition(":")
    return (file, wanted) if file.endswith(".py") else None


def code_of(name: str) -> dict[str, str]:
    """SHA-256 of the file of such a model, by ``model``; nothing for other names."""
    found = file_and_class(name)
    return {} if found is None else {"model": file_sha256(Path(found[0]))}


def names_in(text: str) -> list[str]:
    """Names of the models that a file declares, read from its text: to import it takes longer than a help."""
    return _NAME.findall(text)


NAMES = (
    *(name for path in sorted(Path(__file__).parent.glob("*.py")) for name in names_in(path.read_text())),
    *FOREIGN,
)
"""The models by name. Every file of this folder is read, so that a new model is one new file."""
