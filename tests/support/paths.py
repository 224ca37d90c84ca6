"""Folders of the project and of optional inputs beside it."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "assets"
# Texture sets that lie beside a checkout on some machines; tests that need them skip where they are missing.
SHARED = ROOT.parent / "shared"
