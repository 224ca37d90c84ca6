"""Fitted materials as Mitsuba BSDFs (``mbtf``), and a path tracer that provides their footprints
(``mbtf_path``).

    import mbtf_fit.mitsuba_plugin
    mbtf_fit.mitsuba_plugin.register("llvm_ad_rgb")
    import mitsuba as mi
    bsdf = mi.load_dict({"type": "mbtf", "material": "material/"})

Import this package before Mitsuba, or call ``register`` with a variant: Dr.Jit looks for its LLVM when it is
first imported. Therefore the import of this package, alone among the packages, sets ``DRJIT_LIBLLVM_PATH`` and
``DRJIT_CACHE_DIR`` where they are unset. If Mitsuba was imported first with an LLVM that is too old,
:func:`register` raises an ``EngineError``.

Importing this package registers the plugins with a variant that is already set. PyTorch is not needed, and
never imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from mbtf_gen.render.llvm import use_shipped_llvm

use_shipped_llvm()

_PUBLIC = {
    "Evaluator": "evaluator",
    "StoredMaterial": "material_arrays",
    "check_scene": "bsdf",
    "load_scene": "scene",
    "read_material": "material_arrays",
    "register": "registration",
}

__all__ = ["Evaluator", "StoredMaterial", "check_scene", "load_scene", "read_material", "register"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _register_if_set() -> None:
    from mbtf_fit.mitsuba_plugin.registration import register, variant_is_set

    if variant_is_set():
        register()


_register_if_set()
