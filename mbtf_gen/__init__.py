"""Generate multi-resolution BTF (MBTF) data sets from displaced materials.

Public names are imported on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "Camera": "mbtf_gen.pictures.camera",
    "Dataset": "mbtf_gen.dataset.reader",
    "GeneratorConfig": "mbtf_gen.config.generator",
    "Geometry": "mbtf_gen.dataset.geometry",
    "Lattice": "mbtf_core.lattice",
    "LightKernel": "mbtf_gen.sampling.light_kernel",
    "MbtfError": "mbtf_core.errors",
    "Queries": "mbtf_gen.sampling.query_sampler",
    "generate": "mbtf_gen.generation",
    "load_material": "mbtf_gen.tile.loading",
    "render_reference": "mbtf_gen.pictures.reference",
    "repair": "mbtf_gen.repairs",
    "verify": "mbtf_gen.dataset.verify",
}

__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
