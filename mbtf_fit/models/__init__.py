"""Models: one file each, found by :mod:`mbtf_fit.models.registry`. No file imports PyTorch before it
trains."""

from __future__ import annotations

import re
from pathlib import Path


def _names() -> tuple[str, ...]:
    """Names of the models, read from the text of their files: to import them takes longer than a help."""
    texts = (path.read_text() for path in sorted(Path(__file__).parent.glob("*.py")))
    return tuple(name for text in texts for name in re.findall(r'^    name = "(.+)"$', text, re.MULTILINE))


NAMES = _names()
