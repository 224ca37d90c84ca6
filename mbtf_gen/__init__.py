"""Generate multi-resolution BTF (MBTF) data sets from displaced materials.

Public names are imported on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "Camera": "mbtf_core.pictures",
    "Dataset": "mbtf_core.data.dataset",
    "GeneratorConfig": "mbtf_gen.config.generator",
    "Geometry": "mbtf_core.data.geometry",
    "Lattice": "mbtf_core.data.lattice",
    "LightKernel": "mbtf_gen.sampling.light_kernel",
    "MbtfError": "mbtf_core.errors",
    "Queries": "mbtf_gen.sampling.query_sampler",
    "generate": "mbtf_gen.generation.run",
    "load_material": "mbtf_gen.tile.loading",
    "render_reference": "mbtf_gen.pictures.reference",
    "repair": "mbtf_gen.generation.repair",
    "verify": "mbtf_core.data.verify",
}

__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
