"""Fit neural materials to multi-resolution BTF data.

Public names are imported on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "FitConfig": "mbtf_fit.config",
    "FitResult": "mbtf_fit.training.fit",
    "Material": "mbtf_fit.material.material",
    "QueryDataset": "mbtf_fit.data.batches",
    "evaluate": "mbtf_fit.evaluation",
    "fit": "mbtf_fit.training.fit",
    "fit_jointly": "mbtf_fit.training.fit",
    "read_history": "mbtf_fit.training.fit_folder",
}

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
