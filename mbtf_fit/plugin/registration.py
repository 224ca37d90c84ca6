"""Makes the plugins known to Mitsuba."""

from __future__ import annotations

import sys
from typing import Any

from mbtf_gen.errors import EngineError, MbtfError, UsageError

BSDF_NAME = "mbtf"
INTEGRATOR_NAME = "mbtf_path"
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")

# The plugins' classes derive from classes of one variant.
_registered: str | None = None
# What the last plugin said against its parameters; Mitsuba passes on no more than its text.
last_error: MbtfError | None = None


def variant_is_set() -> bool:
    """Has this process chosen a variant of Mitsuba?"""
    mitsuba = sys.modules.get("mitsuba")
    return mitsuba is not None and mitsuba.variant() is not None


def register() -> None:
    """Register ``mbtf`` and ``mbtf_path`` with the current variant; a second call does nothing.

    Raises
    ------
    UsageError : no variant is set, or one that the plugins do not run in
    EngineError : they are registered with another variant already
    """
    global _registered
    if not variant_is_set():
        raise UsageError("no variant of Mitsuba is set", cure='call mitsuba.set_variant("llvm_ad_rgb") first')
    import mitsuba as mi

    variant = mi.variant()
    if variant == _registered:
        return
    if variant not in VARIANTS:
        raise UsageError(
            f"the plugin '{BSDF_NAME}' does not run in the variant {variant}",
            cure=f"set {VARIANTS[0]} or {VARIANTS[1]}",
        )
    if _registered is not None:
        raise EngineError(
            f"the plugin '{BSDF_NAME}' is registered with the variant {_registered}",
            cure="use one variant per process",
        )
    from .bsdf import MbtfBSDF
    from .integrator import ConePath

    mi.register_bsdf(BSDF_NAME, lambda props: _made(MbtfBSDF, props))
    mi.register_integrator(INTEGRATOR_NAME, lambda props: _made(ConePath, props))
    _registered = variant


def _made(plugin: Any, props: Any) -> Any:
    global last_error
    try:
        return plugin(props)
    except MbtfError as error:
        last_error = error
        raise
