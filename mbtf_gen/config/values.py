"""Types of values that several files of materials have."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mbtf_core.data.schema import Tiling
from mbtf_core.errors import UsageError


def _gray(value: Any) -> Any:
    return (value, value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
# A linear color: three numbers, or one for gray.
Rgb = Annotated[tuple[Share, Share, Share], BeforeValidator(_gray)]

# How rays find a height field: cell by cell, or as triangles by Mitsuba.
Tracer = Literal["heightfield", "mesh"]
# How a normal map and the slopes of the mesh add up.
NormalMode = Literal["residual", "absolute", "off"]


def no_tiling(given: Tiling | None) -> Tiling:
    """``none``: only maps are made tileable.

    Raises
    ------
    UsageError : a method for maps is given
    """
    if given not in (None, "none"):
        raise UsageError("is for height maps, not for fibers and triangles", where="--make-tileable")
    return "none"
