"""Texts stored beside the tests, compared to the letter.

After a change of wording that is meant, write them anew and look at the difference::

    UPDATE_SNAPSHOTS=1 .venv/bin/python -m pytest tests/unit/test_messages_wording.py
    git diff tests/snapshots
"""

from __future__ import annotations

import os
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "snapshots"
UPDATE = "UPDATE_SNAPSHOTS"


def check_snapshot(name: str, text: str) -> None:
    """Compare a text with the stored one of that name, or store it where the environment asks for that."""
    path = FOLDER / f"{name}.txt"
    if os.environ.get(UPDATE):
        FOLDER.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    stored = path.read_text(encoding="utf-8") if path.exists() else ""
    assert text == stored, f"{path} differs; if the new wording is meant, run again with {UPDATE}=1"
