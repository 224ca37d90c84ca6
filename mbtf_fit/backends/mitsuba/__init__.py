"""Fitted materials as Mitsuba BSDFs (``mbtf``), and a path tracer that provides their footprints
(``mbtf_path``).

    import mbtf_fit.backends.mitsuba
    mbtf_fit.backends.mitsuba.register("llvm_ad_rgb")
    import mitsuba as mi
    bsdf = mi.load_dict({"type": "mbtf", "material": "material/"})

Call ``register`` with a variant before the first import of Mitsuba, so that Dr.Jit uses the LLVM of this
installation. Importing this package registers the plugins with a variant that is already set. PyTorch is not
needed, and never imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from mbtf_fit.backends.mitsuba.registration import load_scene, register, variant_is_set

_PUBLIC = {
    "Evaluator": "evaluator",
    "StoredMaterial": "stored_material",
    "check_scene": "bsdf",
    "read_material": "stored_material",
}

__all__ = ["Evaluator", "StoredMaterial", "check_scene", "load_scene", "read_material", "register"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


if variant_is_set():
    register()
