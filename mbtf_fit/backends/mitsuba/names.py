"""Names and state that the plugin's modules share; imports no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from contextvars import ContextVar

from mbtf_core.errors import UsageError
from mbtf_core.paths import suggest_name
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT
from mbtf_gen.engine.types import Properties

BSDF_NAME = "mbtf"
INTEGRATOR_NAME = "mbtf_path"
VARIANTS = (CPU_VARIANT, CUDA_VARIANT)

# Whether the integrator that is tracing provides footprints to the BSDFs.
footprints_provided: ContextVar[bool] = ContextVar("footprints_provided", default=False)


def refuse_unknown(props: Properties, known: Sequence[str], where: str) -> None:
    """Refuse a parameter that a plugin does not have, in one line; Mitsuba's own report has several.

    Raises
    ------
    UsageError : there is one
    """
    unknown = sorted(set(props.unqueried()) - set(known))
    if unknown:
        hint = suggest_name(unknown[0], known) or f"it has: {', '.join(known)}"
        raise UsageError(f"has no parameter '{unknown[0]}'", where=where, hint=hint)
