"""Models: one file each, found by :mod:`mbtf_fit.models.registry`. No file imports PyTorch before it
trains."""

from __future__ import annotations

import re
from pathlib import Path

# A class's line that gives its name, alone or before others.
_NAME = re.compile(r'^    name(?:, \w+)* = "([^"]+)"', re.MULTILINE)


def names_in(text: str) -> list[str]:
    """Names of the models that a file declares, read from its text: to import it takes longer than a help."""
    return _NAME.findall(text)


NAMES = tuple(
    name for path in sorted(Path(__file__).parent.glob("*.py")) for name in names_in(path.read_text())
)
