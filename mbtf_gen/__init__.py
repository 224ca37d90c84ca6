"""Generate multi-resolution BTF (MBTF) data sets from displaced materials.

Public names are imported on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from .llvm import use_shipped_llvm

# Dr.Jit reads the library's path once, when it is first imported: before that, say where ours lies.
use_shipped_llvm()

_PUBLIC = {
    "Camera": "camera",
    "Dataset": "dataset",
    "GeneratorConfig": "config",
    "Lattice": "levels",
    "LightKernel": "light",
    "MbtfError": "errors",
    "Queries": "queries",
    "generate": "generation",
    "load_material": "material",
    "render_reference": "reference",
    "repair": "repairs",
    "verify": "verification",
}

__all__ = [
    "Camera",
    "Dataset",
    "GeneratorConfig",
    "Lattice",
    "LightKernel",
    "MbtfError",
    "Queries",
    "generate",
    "load_material",
    "render_reference",
    "repair",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
