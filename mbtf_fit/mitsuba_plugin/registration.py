"""Makes the plugins known to Mitsuba."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from typing import Any

from mbtf_core.errors import EngineError, MbtfError, UsageError
from mbtf_gen.render.runtime import CPU_VARIANT, CUDA_VARIANT, refuse_old_llvm

BSDF_NAME = "mbtf"
INTEGRATOR_NAME = "mbtf_path"
VARIANTS = (CPU_VARIANT, CUDA_VARIANT)

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
    EngineError : they are registered with another variant already, or Dr.Jit has bound to an old
        LLVM
    """
    global _registered
    if not variant_is_set():
        raise UsageError("no variant of Mitsuba is set", hint='call mitsuba.set_variant("llvm_ad_rgb") first')
    import mitsuba as mi

    variant = mi.variant()
    if variant == _registered:
        return
    if variant not in VARIANTS:
        raise UsageError(
            f"the plugin '{BSDF_NAME}' does not run in the variant {variant}",
            hint=f"set {VARIANTS[0]} or {VARIANTS[1]}",
        )
    if _registered is not None:
        raise EngineError(
            f"the plugin '{BSDF_NAME}' is registered with the variant {_registered}",
            hint="use one variant per process",
        )
    if variant == CPU_VARIANT:
        refuse_old_llvm()
    from mbtf_fit.mitsuba_plugin.bsdf import MbtfBSDF
    from mbtf_fit.mitsuba_plugin.integrator import ConePath

    mi.register_bsdf(BSDF_NAME, lambda props: _made(MbtfBSDF, props))
    mi.register_integrator(INTEGRATOR_NAME, lambda props: _made(ConePath, props))
    _registered = variant


def refuse_unknown(props: Any, known: Sequence[str], where: str) -> None:
    """Refuse a parameter that a plugin does not have; Mitsuba would say so in a report of several lines.

    Raises
    ------
    UsageError : there is one
    """
    unknown = sorted(set(props.unqueried()) - set(known))
    if unknown:
        near = difflib.get_close_matches(unknown[0], known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"it has: {', '.join(known)}"
        raise UsageError(f"has no parameter '{unknown[0]}'", where=where, hint=hint)


def _made(plugin: Any, props: Any) -> Any:
    global last_error
    try:
        return plugin(props)
    except MbtfError as error:
        last_error = error
        raise
