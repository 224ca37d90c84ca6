"""The tile as a scene: its geometry and its BSDF, centered on the origin.

Scene units: the longer side of the tile is 32 units. There single precision resolves 2e-6 units, which
suffices for a ray offset of 8e-6 units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from mbtf_core.errors import InputError, reason
from mbtf_gen.engine.types import BSDF
from mbtf_gen.render.bsdf.plugin import PartSurface, SurfaceBSDF, surface_of
from mbtf_gen.render.directional_light import SmoothedDirectional
from mbtf_gen.render.sensor import QuerySensor
from mbtf_gen.tile.heights import HeightGrid
from mbtf_gen.tile.protocol import Tile
from mbtf_gen.tile.tracers.protocol import TileGeometry

LONG_SIDE = 32.0
# Rays start this far above the reference plane, in units: more than the rounding of the highest vertex.
CLEARANCE = 0.01


def register_plugins() -> None:
    """Register the plugins with Mitsuba's current variant: ``mbtf_queries`` (sensor), ``mbtf_directional``
    (emitter), ``mbtf_surface`` (BSDF)."""
    mi.register_sensor("mbtf_queries", lambda props: QuerySensor(props))
    mi.register_bsdf("mbtf_surface", lambda props: SurfaceBSDF(props))
    mi.register_emitter("mbtf_directional", lambda props: SmoothedDirectional(props))


@dataclass(frozen=True)
class TileScene:
    """A periodic tile as a scene.

    Attributes
    ----------
    aspect : H/W of the tile
    unit : scene units per tile width
    geometry : geometry in scene units
    surface : Surface, PartSurface or MitsubaSurface; reflection, see :mod:`mbtf_gen.render.bsdf.surface`
    """

    aspect: float
    unit: float
    geometry: TileGeometry
    surface: Any


def unit_of(aspect: float) -> float:
    """Scene units per tile width."""
    return LONG_SIDE / max(1.0, aspect)


def build_scene(
    shape: Tile | HeightGrid, bsdf: Mapping[str, Any] | BSDF | Sequence[Mapping[str, Any]]
) -> TileScene:
    """Build the scene of a tile.

    Parameters
    ----------
    shape : the shape, in tile widths
    bsdf : mapping, mitsuba.BSDF or sequence of mapping; a Mitsuba dictionary, or a loaded BSDF; one
        dictionary per part of a mesh or kind of yarn

    Raises
    ------
    InputError : Mitsuba rejects the BSDF
    """
    surface, unit = load_surface(bsdf), unit_of(shape.aspect)
    return TileScene(shape.aspect, unit, shape.trace(unit, surface.transmits), surface)


def load_surface(bsdf: Mapping[str, Any] | BSDF | Sequence[Mapping[str, Any]]) -> Any:
    """Surface, PartSurface or MitsubaSurface of what :func:`build_scene` takes; errors as there."""
    register_plugins()
    if isinstance(bsdf, Sequence):
        return PartSurface([surface_of(_loaded(part)) for part in bsdf])
    return surface_of(_loaded(bsdf) if isinstance(bsdf, Mapping) else bsdf)


def _loaded(bsdf: Mapping[str, Any]) -> BSDF:
    try:
        return mi.load_dict(dict(bsdf))
    except Exception as error:  # whatever the plugins raise about their parameters
        text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", reason(error, 250))
        raise InputError(f"Mitsuba rejects the BSDF '{bsdf.get('type')}' ({text})") from None
