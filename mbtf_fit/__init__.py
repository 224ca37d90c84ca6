"""Fit neural materials to multi-resolution BTF data.

Public names are imported on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "FitConfig": "config",
    "FitResult": "fitting",
    "Material": "material",
    "evaluate": "evaluation",
    "fit": "fitting",
    "read_history": "fitting",
}

__all__ = ["FitConfig", "FitResult", "Material", "evaluate", "fit", "read_history"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
