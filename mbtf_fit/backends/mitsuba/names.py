"""Names and state that the plugin's modules share; imports no Mitsuba."""

from __future__ import annotations

from contextvars import ContextVar
from typing import TypeVar

from mbtf_core.config.settings import Settings, build
from mbtf_core.errors import UsageError
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT
from mbtf_gen.engine.types import Properties

BSDF_NAME = "mbtf"
INTEGRATOR_NAME = "mbtf_path"
S = TypeVar("S", bound=Settings)
VARIANTS = (CPU_VARIANT, CUDA_VARIANT)

# Whether the integrator that is tracing provides footprints to the BSDFs.
footprints_provided: ContextVar[bool] = ContextVar("footprints_provided", default=False)


def options_of(props: Properties, model: type[S], where: str) -> S:
    """The parameters of a plugin; Mitsuba's own report of a wrong one has several lines.

    Raises
    ------
    UsageError : one is unknown, missing or wrong
    """
    given = {name: props[name] for name in (*props.unqueried(), *model.model_fields) if name in props}
    return build(model, given, source=where, error=UsageError)
