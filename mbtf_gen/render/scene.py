"""The displaced tile, ready to be traced: its shape and its surface, centered on the origin.

Scene units: the longer side of the tile is 32 units, where single precision resolves 2e-6 and hit points are
exact enough for a ray offset of 8e-6 units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from mbtf_core.errors import InputError, reason
from mbtf_gen.geometry.heightfield import HeightGrid
from mbtf_gen.render.bsdf.plugin import SurfaceBSDF, surface_of
from mbtf_gen.render.emitter import SmoothedDirectional
from mbtf_gen.render.heightfield_tracer import HeightField
from mbtf_gen.render.path_tracer import World
from mbtf_gen.render.sensor import QuerySensor

LONG_SIDE = 32.0
# Rays begin this far above the reference plane, in units; it must exceed the rounding of the highest vertex.
CLEARANCE = 0.01


def register_plugins() -> None:
    """Make the project's plugins known to Mitsuba's loaders under the current variant: ``mbtf_queries``
    (sensor), ``mbtf_directional`` (emitter), ``mbtf_surface`` (BSDF)."""
    mi.register_sensor("mbtf_queries", lambda props: QuerySensor(props))
    mi.register_bsdf("mbtf_surface", lambda props: SurfaceBSDF(props))
    mi.register_emitter("mbtf_directional", lambda props: SmoothedDirectional(props))


@dataclass(frozen=True)
class Tile:
    """A displaced periodic tile, ready to be traced.

    Attributes
    ----------
    grid : its heights in tile widths
    unit : scene units per tile width
    world : what rays meet
    """

    grid: HeightGrid
    unit: float
    world: World

    @property
    def aspect(self) -> float:
        """H/W of the tile."""
        return self.grid.aspect


def _load_bsdf(bsdf: Mapping[str, Any]) -> Any:
    try:
        return mi.load_dict(dict(bsdf))
    except Exception as error:  # whatever the plugins raise about their parameters
        text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", reason(error, 250))
        raise InputError(f"Mitsuba does not take the BSDF '{bsdf.get('type')}' ({text})") from None


def unit_of(aspect: float) -> float:
    """Scene units per tile width."""
    return LONG_SIDE / max(1.0, aspect)


def build_tile(grid: HeightGrid, bsdf: Mapping[str, Any] | Any) -> Tile:
    """Tile of a height grid and a BSDF (a Mitsuba dictionary or object).

    Raises
    ------
    InputError : Mitsuba does not take the BSDF
    """
    register_plugins()
    unit = unit_of(grid.aspect)
    surface = surface_of(_load_bsdf(bsdf) if isinstance(bsdf, Mapping) else bsdf)
    return Tile(grid, unit, World(HeightField.of(grid, unit, surface.transmits), surface))
